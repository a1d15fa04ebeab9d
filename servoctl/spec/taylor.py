"""Truncated Taylor arithmetic over CasADi expressions: derivatives of any order at polynomial cost.

A `Tape` is the instruction list of SX expressions. `Series` runs it on truncated power series in one
variable, coefficient by coefficient, with the usual recurrences (O(k) operations for coefficient k of a
product). The coefficients are SX expressions, when a derivative is to be derived, or NumPy arrays over
many points, when it is to be evaluated: the same recurrences serve both. Coefficients are *normalised*:
coefficient k of f is f^(k)/k!.
"""

import math
from typing import NamedTuple

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError
from servoctl.spec.elementary import apply, select


class Node(NamedTuple):
    """One primitive operation: `kind`, the nodes it takes, and a constant or a function's name."""

    kind: str
    args: tuple = ()
    data: object = None


# y' = sum of g * a' with y_0 = f(a_0): each function with such a rule is one "quadrature" node
_BINARY = {ca.OP_FMIN: "fmin", ca.OP_FMAX: "fmax", ca.OP_IF_ELSE_ZERO: "gate"}
_PLAIN = {ca.OP_ADD: "add", ca.OP_SUB: "sub", ca.OP_MUL: "mul", ca.OP_DIV: "div"}  # of two, without a branch
_UNARY = {ca.OP_NEG: "neg", ca.OP_SQ: "sq", ca.OP_SQRT: "sqrt", ca.OP_FABS: "fabs", ca.OP_ASSIGN: "copy"}
_CONSTANT = {
    ca.OP_LT: "lt", ca.OP_LE: "le", ca.OP_EQ: "eq", ca.OP_NE: "ne", ca.OP_AND: "logic_and", ca.OP_OR: "logic_or",
    ca.OP_NOT: "logic_not", ca.OP_SIGN: "sign",
}  # fmt: skip
_FUNCTION = {
    ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_SIN: "sin", ca.OP_COS: "cos", ca.OP_TAN: "tan", ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos", ca.OP_ATAN: "atan", ca.OP_SINH: "sinh", ca.OP_COSH: "cosh", ca.OP_TANH: "tanh",
    ca.OP_ASINH: "asinh", ca.OP_ACOSH: "acosh", ca.OP_ATANH: "atanh", ca.OP_EXPM1: "expm1", ca.OP_LOG1P: "log1p",
    ca.OP_ERF: "erf",
}  # fmt: skip
_REFUSED = {
    ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_FMOD: "fmod", ca.OP_REMAINDER: "remainder",
    ca.OP_COPYSIGN: "copysign", ca.OP_ERFINV: "erfinv",
}  # fmt: skip


class Tape:
    """The primitive operations that compute `expressions` from `symbols`.

    Parameters
    ----------
    symbols : sequence of SX scalars
        The inputs, in the order in which series are given for them.
    expressions : sequence of SX scalars
        The outputs.

    Raises
    ------
    SpecificationError
        If an expression holds an operation that has no derivative (floor, fmod, ...).
    """

    def __init__(self, symbols, expressions):
        self.nodes = []
        self.n_inputs = len(symbols)
        self.switches = []  # differences whose sign decides a branch
        function = ca.Function(
            "tape", [ca.vertcat(*symbols)] if symbols else [ca.SX(0, 1)], [ca.densify(ca.vertcat(*expressions))]
        )
        self.inputs = [self._add("input", data=i) for i in range(self.n_inputs)]
        self._pairs = {}
        self.outputs = [None] * len(expressions)
        self._read(function)

    def _add(self, kind, *args, data=None):
        self.nodes.append(Node(kind, args, data))
        return len(self.nodes) - 1

    def _read(self, function):
        work, nodes = {}, self.nodes
        read, taken, made = function.instruction_id, function.instruction_input, function.instruction_output
        for k in range(function.n_instructions()):
            op, inputs = read(k), taken(k)
            if op == ca.OP_OUTPUT:
                self.outputs[made(k)[1]] = work[inputs[0]]
                continue
            place = made(k)[0]
            if op in _PLAIN:
                nodes.append(Node(_PLAIN[op], (work[inputs[0]], work[inputs[1]])))
                work[place] = len(nodes) - 1
            elif op == ca.OP_INPUT:
                work[place] = self.inputs[inputs[1]]
            elif op == ca.OP_CONST:
                work[place] = self._add("const", data=function.instruction_constant(k))
            else:
                work[place] = self._operation(op, [work[i] for i in inputs])
        zero = None
        for i, node in enumerate(self.outputs):
            if node is None:
                zero = self._add("const", data=0.0) if zero is None else zero
                self.outputs[i] = zero

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


def _is_zero(c):
    return c.__class__ in _NUMBERS and c == 0


_NUMBERS = (float, int)


def _dot(pairs):
    total = 0.0
    for a, b in pairs:
        if not (_is_zero(a) or _is_zero(b)):
            product = a * b
            total = product if _is_zero(total) else total + product
    return total


def _plus(a, b):
    return b if _is_zero(a) else a if _is_zero(b) else a + b


def _inner_first(k, first=0):
    """Indices first..k of a product's terms, those with the latest coefficients last: the others are known earlier."""
    return sorted(range(first, k + 1), key=lambda j: max(j, k - j))


class Series:
    """A tape run on truncated power series, one coefficient at a time.

    `inputs[i]` is the list of coefficients of input i; before `advance()` computes coefficient k, each
    must hold at least k + 1 entries. `outputs[i]` are the coefficients of output i so far. Branches are taken by
    coefficient 0 of what is compared; `decided` may give other values for nodes, at which to take them.
    """

    def __init__(self, tape, inputs, decided=None):
        self.tape = tape
        self.inputs = inputs
        self.c = [[] for _ in tape.nodes]
        self.k = 0
        self.decided = decided or {}

    def _first(self, node):
        """The value of a node by which branches are taken."""
        return self.decided[node] if node in self.decided else self.c[node][0]

    @property
    def outputs(self):
        """The coefficients of each output so far (list of lists)."""
        return [self.c[node] for node in self.tape.outputs]

    def advance(self):
        """Compute the next coefficient of every node."""
        k, c = self.k, self.c
        if k == 0:
            self._start()
        else:
            for i, node in enumerate(self.tape.nodes):
                c[i].append(self._coefficient(node, i, k))
        self.k += 1

    def _start(self):
        """Coefficient 0 of every node: its value, without the recurrences."""
        c, inputs = self.c, self.inputs
        for i, (kind, args, data) in enumerate(self.tape.nodes):
            if kind == "mul":
                a, b = c[args[0]][0], c[args[1]][0]
                value = 0.0 if _is_zero(a) or _is_zero(b) else a * b
            elif kind == "add":
                value = _plus(c[args[0]][0], c[args[1]][0])
            elif kind == "sub":
                a, b = c[args[0]][0], c[args[1]][0]
                value = a if _is_zero(b) else -1.0 * b if _is_zero(a) else a - b
            elif kind == "neg":
                a = c[args[0]][0]
                value = 0.0 if _is_zero(a) else -a
            elif kind == "input":
                value = inputs[data][0]
            elif kind == "const":
                value = data
            else:
                value = self._coefficient(self.tape.nodes[i], i, 0)
            c[i].append(value)

    def replace_last(self, coefficients):
        """Recompute the last coefficient after the inputs' last coefficients changed.

        Parameters
        ----------
        coefficients : dict
            Input index to its new last coefficient.
        """
        for i, value in coefficients.items():
            self.inputs[i][self.k - 1] = value
        for c in self.c:
            c.pop()
        self.k -= 1
        self.advance()

    def _coefficient(self, node, i, k):
        c, kind = self.c, node.kind
        if kind == "input":
            return self.inputs[node.data][k]
        if kind == "const":
            return node.data if k == 0 else 0.0
        if kind == "quad":
            return self._quadrature(node, k)
        if kind == "constant":
            return apply(node.data, *(self._first(j) for j in node.args)) if k == 0 else 0.0
        a = c[node.args[0]]
        if kind == "neg":
            return 0.0 if _is_zero(a[k]) else -a[k]
        if kind == "scale":
            return a[k] * node.data
        if kind == "copy":
            return a[k]
        if kind == "sq":
            return self._square(a, k)
        if kind == "sqrt":
            y = c[i]
            if k == 0:
                return apply("sqrt", a[0])
            rest = _plus(a[k], -1.0 * _dot((y[j], y[k - j]) for j in range(1, k)))
            return 0.0 if _is_zero(rest) else rest / (2.0 * y[0])
        if kind == "power":
            return self._constant_power(a, c[i], node.data, k)
        if kind == "fabs":
            return select(self._first(node.args[0]) >= 0, a[k], -a[k])
        b = c[node.args[1]]
        if kind == "add":
            return _plus(a[k], b[k])
        if kind == "sub":
            return a[k] if _is_zero(b[k]) else _plus(a[k], -1.0 * b[k]) if _is_zero(a[k]) else a[k] - b[k]
        if kind == "mul":
            return _dot((a[j], b[k - j]) for j in _inner_first(k))
        if kind == "div":
            y = c[i]
            rest = _plus(a[k], -1.0 * _dot((y[j], b[k - j]) for j in _inner_first(k) if j < k))
            return 0.0 if _is_zero(rest) else rest / b[0]
        if kind == "gate":
            return 0.0 if _is_zero(b[k]) else select(a[0] != 0, b[k], 0.0)
        first = self._first(node.args[0]) <= self._first(node.args[1])
        return select(first, *((a[k], b[k]) if kind == "fmin" else (b[k], a[k])))

    @staticmethod
    def _square(a, k):
        if k == 0:
            return 0.0 if _is_zero(a[0]) else a[0] * a[0]
        inner = a[k // 2] * a[k // 2] if k % 2 == 0 and not _is_zero(a[k // 2]) else 0.0
        return _plus(inner, 2.0 * _dot((a[j], a[k - j]) for j in reversed(range((k + 1) // 2))))

    @staticmethod
    def _constant_power(a, y, exponent, k):
        if k == 0:
            return a[0] ** exponent
        total = _dot(((exponent * (k - j) - j) * a[k - j], y[j]) for j in range(k) if not _is_zero(a[k - j]))
        if _is_zero(total):
            return 0.0
        vanishes = a[0] if k < exponent else sum(apply("fabs", c) for c in a)  # the power of a zero is zero
        return select(vanishes == 0, 0.0, total / (k * a[0]))

    def _quadrature(self, node, k):
        name, slopes = node.data
        if k == 0:
            return apply(name, *(self.c[j][0] for j in node.args))
        total = 0.0
        for argument, slope in zip(node.args, slopes, strict=True):
            a, g = self.c[argument], self.c[slope]
            total = _plus(total, _dot((j * a[j], g[k - j]) for j in _inner_first(k, 1) if not _is_zero(a[j])))
        return total if k == 1 or _is_zero(total) else total / k


def evaluate(tape, inputs):
    """Values of a tape's outputs and the size of the terms that made them.

    The size of a sum is the sum of the sizes, of a product |a| size(b) + size(a) |b|, of y = f(a)
    |y| + |f'(a)| size(a): rounding is of the order of the machine's epsilon times the size, so an output far
    below its size is zero. Runs in the precision of `inputs`.

    Parameters
    ----------
    tape : Tape
    inputs : (n_inputs, N) array
        Values of the inputs at N points.

    Returns
    -------
    values, sizes : (n_outputs, N) arrays
    """
    inputs = np.asarray(inputs)
    series = Series(tape, [[row] for row in inputs])
    with np.errstate(all="ignore"):
        series.advance()
        v = [c[0] for c in series.c]
        size = [abs(x) for x in v]
        for i, (kind, args, _) in enumerate(tape.nodes):
            if kind == "mul":
                a, b = args
                size[i] = abs(v[a]) * size[b] + size[a] * abs(v[b])
            elif kind in ("add", "sub"):
                size[i] = size[args[0]] + size[args[1]]
            elif kind not in ("input", "const", "constant"):
                size[i] = _size(tape.nodes[i], i, v, size)
    result = np.empty((2, len(tape.outputs), *inputs.shape[1:]), dtype=inputs.dtype)
    for row, output in enumerate(tape.outputs):
        result[0, row], result[1, row] = v[output], size[output]
    return result[0], result[1]


def _size(node, i, v, size):
    kind, a = node.kind, node.args
    if kind == "quad":
        return np.abs(v[i]) + sum(np.abs(np.nan_to_num(v[g])) * size[j] for j, g in zip(a, node.data[1], strict=True))
    if kind in ("neg", "copy", "fabs"):
        return size[a[0]]
    if kind == "scale":
        return abs(node.data) * size[a[0]]
    if kind == "sq":
        return 2.0 * np.abs(v[a[0]]) * size[a[0]]
    if kind in ("sqrt", "power"):
        exponent = 0.5 if kind == "sqrt" else node.data
        return np.abs(v[i]) * (1.0 + abs(exponent) * size[a[0]] / np.maximum(np.abs(v[a[0]]), np.finfo(float).tiny))
    if kind == "div":
        return (size[a[0]] + np.abs(v[i]) * size[a[1]]) / np.abs(v[a[1]])
    if kind == "gate":
        return np.where(v[a[0]] != 0, size[a[1]], 0.0)
    return np.where((v[a[0]] <= v[a[1]]) == (kind == "fmin"), size[a[0]], size[a[1]])
