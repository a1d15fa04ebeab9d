"""Tapes: the primitive operations of SX expressions, read once and run many times."""

import math
from functools import cached_property
from typing import NamedTuple

import casadi as ca

from servoctl.errors import SpecificationError
from servoctl.jets.evaluation import Plan


class Node(NamedTuple):
    """One primitive operation: `kind`, the nodes it takes, and a constant or a function's name."""

    kind: str
    args: tuple = ()
    data: object = None


_BINARY = {ca.OP_FMIN: "fmin", ca.OP_FMAX: "fmax", ca.OP_IF_ELSE_ZERO: "gate"}
_PLAIN = {ca.OP_ADD: "add", ca.OP_SUB: "sub", ca.OP_MUL: "mul", ca.OP_DIV: "div"}  # of two, without a branch
_UNARY = {ca.OP_NEG: "neg", ca.OP_SQ: "sq", ca.OP_SQRT: "sqrt", ca.OP_FABS: "fabs", ca.OP_ASSIGN: "copy"}
_CONSTANT = {
    ca.OP_LT: "lt", ca.OP_LE: "le", ca.OP_EQ: "eq", ca.OP_NE: "ne", ca.OP_AND: "logic_and", ca.OP_OR: "logic_or",
    ca.OP_NOT: "logic_not", ca.OP_SIGN: "sign",
}  # fmt: skip
_FUNCTION = {  # y' = sum of g * a' with y_0 = f(a_0): each is one "quadrature" node
    ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_SIN: "sin", ca.OP_COS: "cos", ca.OP_TAN: "tan", ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos", ca.OP_ATAN: "atan", ca.OP_SINH: "sinh", ca.OP_COSH: "cosh", ca.OP_TANH: "tanh",
    ca.OP_ASINH: "asinh", ca.OP_ACOSH: "acosh", ca.OP_ATANH: "atanh", ca.OP_EXPM1: "expm1", ca.OP_LOG1P: "log1p",
    ca.OP_ERF: "erf",
}  # fmt: skip
_REFUSED = {
    ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_FMOD: "fmod", ca.OP_REMAINDER: "remainder",
    ca.OP_COPYSIGN: "copysign", ca.OP_ERFINV: "erfinv",
}  # fmt: skip


_OPTIONS = {"allow_free": True, "live_variables": False}  # every instruction has its own place


class Tape:
    """The primitive operations that compute `expressions`.

    Parameters
    ----------
    symbols : sequence of SX scalars or None
        The inputs, in the order of their values; None for all that the expressions hold.
    expressions : sequence of SX scalars
        The outputs.

    Attributes
    ----------
    symbols : list of SX scalars
    nodes : list of Node
        Each takes nodes before it, except the slopes of "quad" nodes.
    outputs : list of int
        Nodes of the expressions.
    switches : list of (int, int or None)
        Differences whose sign decides a branch.

    Raises
    ------
    SpecificationError
        If an expression holds an operation that has no derivative (floor, fmod, ...).
    """

    def __init__(self, symbols, expressions):
        function = ca.Function("tape", [], list(expressions), _OPTIONS)
        free = function.free_sx()
        self.symbols = list(free if symbols is None else symbols)
        self.nodes, self.switches, self._pairs = [], [], {}
        inputs = {s.element_hash(): self._add("input", data=i) for i, s in enumerate(self.symbols)}
        self.outputs = [None] * len(expressions)
        self._read(function, [inputs[s.element_hash()] for s in free])
        if None in self.outputs:
            zero = self._add("const", data=0.0)
            self.outputs = [zero if node is None else node for node in self.outputs]

    @cached_property
    def plan(self):
        """How the tape is run on numbers."""
        return Plan(self.nodes)

    def needed(self, first):
        """How many nodes are needed for so many first outputs."""
        count = i = 1 + max(self.outputs[:first], default=-1)
        while i:
            i -= 1
            if self.nodes[i].kind == "quad":
                last = max(self.nodes[i].data[1])
                count, i = (1 + last, 1 + last) if last >= count else (count, i)
        return count

    def _add(self, kind, *args, data=None):
        self.nodes.append(Node(kind, args, data))
        return len(self.nodes) - 1

    def _read(self, function, symbols):
        """Append the instructions; their symbols come in the order of `symbols`."""
        work, nodes, symbols = [], self.nodes, iter(symbols)
        read, taken = function.instruction_id, function.instruction_input
        for k in range(function.n_instructions()):
            op = read(k)
            if op in _PLAIN:
                a, b = taken(k)
                work.append(len(nodes))
                nodes.append(Node(_PLAIN[op], (work[a], work[b])))
            elif op == ca.OP_OUTPUT:
                self.outputs[function.instruction_output(k)[0]] = work[taken(k)[0]]
            elif op == ca.OP_PARAMETER:
                work.append(next(symbols))
            elif op == ca.OP_CONST:
                work.append(self._add("const", data=function.instruction_constant(k)))
            else:
                work.append(self._operation(op, [work[i] for i in taken(k)]))

    def _operation(self, op, a):
        if op in _BINARY:
            if op in (ca.OP_FMIN, ca.OP_FMAX):
                self.switches.append((a[0], a[1]))
            return self._add(_BINARY[op], a[0], a[1])
        if op in _UNARY:
            if op == ca.OP_FABS:
                self.switches.append((a[0], None))
            return self._add(_UNARY[op], a[0])
        if op in _CONSTANT:
            if op in (ca.OP_LT, ca.OP_LE, ca.OP_SIGN):
                self.switches.append((a[0], a[1] if op != ca.OP_SIGN else None))
            return self._add("constant", *a[: 1 if op in (ca.OP_NOT, ca.OP_SIGN) else 2], data=_CONSTANT[op])
        if op == ca.OP_TWICE:
            return self._add("scale", a[0], data=2.0)
        if op == ca.OP_INV:
            return self._add("div", self._add("const", data=1.0), a[0])
        if op in (ca.OP_POW, ca.OP_CONSTPOW):
            return self._power(a[0], a[1])
        if op == ca.OP_HYPOT:
            return self._add("sqrt", self._add("add", self._add("sq", a[0]), self._add("sq", a[1])))
        if op == ca.OP_ATAN2:
            r2 = self._add("add", self._add("sq", a[0]), self._add("sq", a[1]))
            gy, gx = self._add("div", a[1], r2), self._add("neg", self._add("div", a[0], r2))
            return self._add("quad", a[0], a[1], data=("atan2", (gy, gx)))
        if op in _FUNCTION:
            return self._function(_FUNCTION[op], a[0])
        raise SpecificationError(
            f"The expression uses {_REFUSED.get(op, f'CasADi operation {op}')}.",
            "A program or mechanism is differentiated in time; this operation has no derivative.",
            do="Write it with if_else, fmin, fmax or fabs, whose branches are differentiated.",
        )

    def _power(self, base, exponent):
        node = self.nodes[exponent]
        if node.kind != "const":
            return self._symbolic_power(base, exponent)
        c = node.data
        if not math.isfinite(c):
            raise SpecificationError(
                f"The expression raises to the power {c}.", "An exponent is finite.", do="Check the expression."
            )
        if c != int(c) or abs(c) > 64:
            return self._add("power", base, data=c)
        result, square, n = None, base, abs(int(c))
        while n:
            if n & 1:
                result = square if result is None else self._add("mul", result, square)
            n >>= 1
            if n:
                square = self._add("sq", square)
        one = self._add("const", data=1.0)
        result = one if result is None else result
        return self._add("div", one, result) if c < 0 else result

    def _symbolic_power(self, base, exponent):
        """y = a^b with y' = (b y/a) a' + (y ln a) b'; the logarithm does not enter where b does not change."""
        n = len(self.nodes)
        y = self._add("quad", base, exponent, data=None)
        by_base = self._add("div", self._add("mul", exponent, y), base)
        by_exponent = self._add("mul", y, self._function("log", base))
        self.nodes[n] = Node("quad", (base, exponent), ("power", (by_base, by_exponent)))
        return y

    def _function(self, name, a):
        if (name, a) in self._pairs:
            return self._pairs[name, a]
        if name in ("sin", "cos", "sinh", "cosh"):
            hyperbolic = name.endswith("h")
            s, c = ("sinh", "cosh") if hyperbolic else ("sin", "cos")
            n = len(self.nodes)  # sin is node n, cos n + 1, and -sin n + 2: each uses the other's lower coefficients
            self._pairs[s, a] = self._add("quad", a, data=(s, (n + 1,)))
            self._pairs[c, a] = self._add("quad", a, data=(c, (n if hyperbolic else n + 2,)))
            if not hyperbolic:
                self._add("neg", n)
            return self._pairs[name, a]
        n = len(self.nodes)
        y = self._pairs[name, a] = self._add("quad", a, data=None)
        self.nodes[n] = Node("quad", (a,), (name, (self._slope(name, a, y),)))
        return y

    def _slope(self, name, a, y):
        """The node of dy/da for y = name(a); it may use y itself."""
        one = self._add("const", data=1.0)
        if name == "exp":
            return y
        if name == "expm1":
            return self._add("add", y, one)
        if name == "log":
            return self._add("div", one, a)
        if name == "log1p":
            return self._add("div", one, self._add("add", one, a))
        if name == "tan":
            return self._add("add", one, self._add("sq", y))
        if name == "tanh":
            return self._add("sub", one, self._add("sq", y))
        if name == "erf":
            gauss = self._function("exp", self._add("neg", self._add("sq", a)))
            return self._add("scale", gauss, data=2.0 / math.sqrt(math.pi))
        square = self._add("sq", a)
        if name in ("atan", "atanh"):
            return self._add("div", one, self._add("add" if name == "atan" else "sub", one, square))
        if name == "acosh":
            return self._add("div", one, self._add("sqrt", self._add("sub", square, one)))
        root = self._add("sqrt", self._add("add" if name == "asinh" else "sub", one, square))
        slope = self._add("div", one, root)
        return self._add("neg", slope) if name == "acos" else slope
