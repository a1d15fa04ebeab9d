"""Tapes: the primitive operations of SX expressions, read once and evaluated at many points.

Elementary functions of expressions or numbers come first, then the tape; below them its values at many points, with
the sizes of the terms that made them.
"""

import math
import operator
import sys
from functools import cached_property
from math import factorial
from typing import NamedTuple

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError

REAL = np.longdouble
JETS = 40  # highest derivative of a reference that rows may contain: chains of a dozen cars and springs need 30
MOST_SQUARED = 64  # the largest whole exponent that is written as squares and products

# Mode 0 is the default of CasADi 3.8: NumPy's functions of symbols work, each with a warning. Mode -1 gives no warning.
if hasattr(ca.GlobalOptions, "getNumpyMode") and ca.GlobalOptions.getNumpyMode() == 0:
    ca.GlobalOptions.setNumpyMode(-1)

_NUMPY = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "expm1": np.expm1,
    "log1p": np.log1p,
    "sign": np.sign,
    "fabs": np.abs,
    "atan2": np.arctan2,
    "power": np.power,
    "lt": lambda a, b: 1.0 * (a < b),
    "le": lambda a, b: 1.0 * (a <= b),
    "eq": lambda a, b: 1.0 * (a == b),
    "ne": lambda a, b: 1.0 * (a != b),
    "logic_and": lambda a, b: 1.0 * ((a != 0) & (b != 0)),
    "logic_or": lambda a, b: 1.0 * ((a != 0) | (b != 0)),
    "logic_not": lambda a: 1.0 * (a == 0),
}
_CASADI = {name: getattr(ca, name) for name in _NUMPY} | {"erf": ca.erf}


def _erf(x):
    from scipy.special import erf

    return erf(np.asarray(x, dtype=float))


_NUMPY["erf"] = _erf


def apply(name, *args):
    """The function `name` of SX expressions, or of numbers and arrays; `name` may be a function of arrays itself."""
    if callable(name):
        return name(*args)
    functions = _CASADI if any(isinstance(a, ca.SX) for a in args) else _NUMPY
    return functions[name](*args)


def _arithmetic(name, code):
    """A binary operation on SX expressions, or on numbers and arrays."""
    numeric, binary, symbolic = getattr(operator, name), ca.SX.binary, ca.SX

    # SX.binary skips CasADi's search for a common type, which takes ten times as long as the operation.
    def operation(a, b):
        return binary(code, a, b) if a.__class__ is symbolic or b.__class__ is symbolic else numeric(a, b)

    return operation


add = _arithmetic("add", ca.OP_ADD)
subtract = _arithmetic("sub", ca.OP_SUB)
multiply = _arithmetic("mul", ca.OP_MUL)
divide = _arithmetic("truediv", ca.OP_DIV)


def select(condition, yes, no):
    """`yes` where `condition` is not zero, else `no`; works on SX expressions and on arrays."""
    if any(isinstance(a, ca.SX) for a in (condition, yes, no)):
        return ca.if_else(condition, yes, no)
    return np.where(condition, yes, no)


def holds(a):
    """Whether an SX condition (as 1 or 0; a comparison is that itself) or the entries of an array differ from zero."""
    return a if isinstance(a, ca.SX) and a.op() in _TRUTHS else a != 0


def finite(a):
    """Whether an SX expression, as 1 or 0, or the entries of an array are finite."""
    return ca.fabs(a) <= sys.float_info.max if isinstance(a, ca.SX) else np.isfinite(a)


class Node(NamedTuple):
    """One primitive operation: `kind`, the nodes it takes, and a constant or a function's name."""

    kind: str
    args: tuple = ()
    data: object = None


_BINARY = {ca.OP_FMIN: "fmin", ca.OP_FMAX: "fmax", ca.OP_IF_ELSE_ZERO: "gate"}
_ARITHMETIC_NODES = {ca.OP_ADD: "add", ca.OP_SUB: "sub", ca.OP_MUL: "mul", ca.OP_DIV: "div"}
_UNARY = {ca.OP_NEG: "neg", ca.OP_SQ: "sq", ca.OP_SQRT: "sqrt", ca.OP_FABS: "fabs", ca.OP_ASSIGN: "copy"}
_CONSTANT = {  # piecewise constant: their derivatives are zero
    ca.OP_LT: "lt",
    ca.OP_LE: "le",
    ca.OP_EQ: "eq",
    ca.OP_NE: "ne",
    ca.OP_AND: "logic_and",
    ca.OP_OR: "logic_or",
    ca.OP_NOT: "logic_not",
    ca.OP_SIGN: "sign",
}
_TRUTHS = {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT}
_FUNCTION = {  # y' = sum of g * a' with y_0 = f(a_0): each is one "quadrature" node
    ca.OP_EXP: "exp",
    ca.OP_LOG: "log",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_ASINH: "asinh",
    ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh",
    ca.OP_EXPM1: "expm1",
    ca.OP_LOG1P: "log1p",
    ca.OP_ERF: "erf",
}
_REFUSED = {
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_FMOD: "fmod",
    ca.OP_REMAINDER: "remainder",
    ca.OP_COPYSIGN: "copysign",
    ca.OP_ERFINV: "erfinv",
    ca.OP_CALL: "a function that CasADi calls, such as an interpolant",
}
_GROWING = {"exp", "expm1", "sinh", "cosh"}  # functions that leave the range of doubles
_OPTIONS = {"allow_free": True, "live_variables": False, "max_io": 10**9}  # operations fill new places in order


class Tape:
    """The primitive operations that compute `expressions`, SX scalars.

    `symbols` are the inputs in the order of their values, by default all symbols of the expressions. Each node takes
    nodes before it, except the slopes of "quad" nodes; `outputs` are the nodes of the expressions. Raises
    SpecificationError for an operation that has no derivative (floor, fmod, ...).
    """

    def __init__(self, symbols, expressions):
        function = ca.Function("tape", [], list(expressions), _OPTIONS)
        free = function.free_sx()
        self.symbols = list(free if symbols is None else symbols)
        self.nodes, self._pairs = [], {}
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

    @cached_property
    def _plans(self):
        return {}

    def plan_of(self, first):
        """The `Plan` of what computes the first outputs, so many or all, and `growing` at its places, (n, 1) array."""
        if first not in self._plans:
            count = len(self.nodes) if first is None else self.needed(first)
            plan = self.plan if first is None else Plan(self.nodes[:count])
            growing = np.empty((count, 1), dtype=bool)
            growing[plan.place, 0] = self.growing[:count]
            self._plans[first] = plan, growing
        return self._plans[first]

    def needed(self, first):
        """The number of leading nodes that compute the first outputs, so many of them."""
        count = i = 1 + max(self.outputs[:first], default=-1)
        while i:
            i -= 1
            if self.nodes[i].kind == "quad":
                last = max(self.nodes[i].data[1])
                count, i = (1 + last, 1 + last) if last >= count else (count, i)
        return count

    @cached_property
    def growing(self):
        """Whether each node has a function that may overflow among its arguments (list of bool)."""
        result = []
        for kind, args, data in self.nodes:
            result.append((kind == "quad" and data[0] in _GROWING) or any(result[i] for i in args))
        return result

    def _add(self, kind, *args, data=None):
        self.nodes.append(Node(kind, args, data))
        return len(self.nodes) - 1

    def _read(self, function, symbols):
        """Append the instructions of a function, whose free symbols have the nodes `symbols`."""
        work, nodes, symbols = [], self.nodes, iter(symbols)
        code, operands = function.instruction_id, function.instruction_input
        for k in range(function.n_instructions()):
            op = code(k)
            if op in _ARITHMETIC_NODES:
                a, b = operands(k)
                work.append(len(nodes))
                nodes.append(Node(_ARITHMETIC_NODES[op], (work[a], work[b])))
            elif op == ca.OP_OUTPUT:
                self.outputs[function.instruction_output(k)[0]] = work[operands(k)[0]]
            elif op == ca.OP_PARAMETER:
                work.append(next(symbols))
            elif op == ca.OP_CONST:
                work.append(self._add("const", data=function.instruction_constant(k)))
            else:
                work.append(self._operation(op, [work[i] for i in operands(k)]))

    def _operation(self, op, a):
        if op in _BINARY:
            return self._add(_BINARY[op], a[0], a[1])
        if op in _UNARY:
            return self._add(_UNARY[op], a[0])
        if op == ca.OP_COPYSIGN and a[0] == a[1]:  # the sign of itself, by which emitted series keep a condition apart
            return a[0]
        if op in _CONSTANT:
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
        name = _REFUSED.get(op, f"CasADi operation {op}")
        raise SpecificationError(
            f"The expression uses {name}.",
            "Expressions of a program or mechanism are differentiated in time, and this operation has no derivative.",
            do="Write its formula in SX; a table over the time is a path, sv.paths.spline(times, points)."
            if op == ca.OP_CALL
            else "Use if_else, fmin, fmax or fabs: each of their branches is differentiated.",
            operation=name,
        )

    def _power(self, base, exponent):
        node = self.nodes[exponent]
        if node.kind != "const":
            return self._symbolic_power(base, exponent)
        c = node.data
        if not math.isfinite(c):
            raise SpecificationError(f"The expression has the exponent {c}.", "Exponents are finite.", exponent=c)
        if c != int(c) or abs(c) > MOST_SQUARED:
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
        """y = a^b with y' = (b y/a) a' + (y ln a) b'. Where b is constant, ln a has the factor zero and drops out."""
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
            # sin is node n, cos n + 1, and -sin n + 2: each uses lower coefficients of the other.
            n = len(self.nodes)
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
        """The node of dy/da for y = name(a), which may refer to y."""
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


class Plan:
    """An order of a tape's nodes in which each group of equal operations is evaluated by one call of NumPy.

    `place` (n_nodes,) is the place of each node in it. `constants` are (places, values), `inputs` (places, indices),
    and `groups` (kind, data, slice of places, places of the operands (operands, size)), with squares as products.
    `slopes` has for each group of kind "quad", by its first place, the places of dy/da for each operand, (size,)
    arrays.
    """

    def __init__(self, nodes):
        sorts, sort, depth = {}, [], []
        for kind, args, data in nodes:
            if args:
                a, b = depth[args[0]], depth[args[-1]]
                depth.append(1 + (a if a > b else b))
                key = ("mul", None) if kind == "sq" else (kind, data[0] if kind == "quad" else data)
            else:
                depth.append(0)
                key = kind, None
            sort.append(sorts.setdefault(key, len(sorts)))
        order = np.lexsort((sort, depth))
        self.place = np.empty(len(nodes), dtype=int)
        self.place[order] = np.arange(len(nodes))
        changes = np.diff(np.array([depth, sort])[:, order]).any(axis=0)
        bounds = [0, *(1 + np.flatnonzero(changes)).tolist(), len(nodes)] if nodes else [0]
        ends = [[args[k] if args else 0 for _, args, _ in nodes] for k in (0, -1)]
        operands = self._places(ends)[:, order]
        sorts, order = list(sorts), order.tolist()
        self.constants, self.inputs, self.groups, self.slopes = ([], []), ([], []), [], {}
        for first, last in zip(bounds[:-1], bounds[1:], strict=True):
            kind, data = sorts[sort[order[first]]]
            _, args, _ = nodes[order[first]]
            if not args:
                leaves = self.constants if kind == "const" else self.inputs
                leaves[0].extend(range(first, last))
                leaves[1].extend(nodes[i].data for i in order[first:last])
                continue
            count = 2 if kind == "mul" else len(args)
            self.groups.append((kind, data, slice(first, last), operands[:count, first:last].copy()))
            if kind == "quad":
                slopes = zip(*(nodes[i].data[1] for i in order[first:last]), strict=True)
                self.slopes[first] = [self._places(column) for column in slopes]

    @cached_property
    def grouped(self):
        """Groups as nodes, and their places: nodes of kind "gather" collect operands from places of all groups."""
        nodes, places, quadratures = [], [], []

        def gather(some):
            nodes.append(Node("gather"))
            places.append(some)
            return len(nodes) - 1

        for kind, data, here, operands in self.groups:
            args = tuple(map(gather, operands))
            quadratures += [len(nodes)] if kind == "quad" else []
            nodes.append(Node(kind, args, data))
            places.append(here)
        for i in quadratures:  # slopes may be operations that follow
            slopes = tuple(map(gather, self.slopes[places[i].start]))
            nodes[i] = nodes[i]._replace(data=(nodes[i].data, slopes))
        return nodes, places

    def _places(self, nodes):
        return self.place[np.asarray(nodes, dtype=int)]

    def values(self, inputs, operations=None):
        """Values of all nodes at N points, (n_nodes, N), from values of the inputs, (n_inputs, N).

        `operations` are functions by kind of node; default: `VALUE`.
        """
        operations = VALUE if operations is None else operations
        v = np.empty((len(self.place), *inputs.shape[1:]), dtype=inputs.dtype)
        places, constants = self.constants
        v[places] = np.array(constants)[:, None]
        places, indices = self.inputs
        v[places] = inputs[indices]
        for kind, data, here, operands in self.groups:
            values = v.take(operands, axis=0)
            if kind in _ARITHMETIC:
                _ARITHMETIC[kind](*values, out=v[here])
            else:
                v[here] = operations[kind](data, *values)
        return v

    def sizes(self, v):
        """Sizes of the terms of all nodes, (n_nodes, N), from the values; see `evaluate`."""
        magnitude = np.abs(v)
        size = magnitude.copy()
        slopes = np.nan_to_num(magnitude) if self.slopes else magnitude
        for kind, data, here, operands in self.groups:
            parts = size.take(operands, axis=0)
            if kind in ("add", "sub"):
                np.maximum(np.hypot(*parts), magnitude[here], out=size[here])
            elif kind == "mul":
                a, b = magnitude.take(operands, axis=0)
                np.hypot(a * parts[1], parts[0] * b, out=size[here])
            elif kind == "quad":
                for slope, part in zip(self.slopes[here.start], parts, strict=True):
                    size[here] += slopes.take(slope, axis=0) * part
            elif kind != "constant":
                size[here] = _SIZE[kind](data, magnitude[here], *v.take(operands, axis=0), *parts)
        return np.where(np.isfinite(size), size, np.nan)  # what has no size is comparable to nothing


def _power_size(exponent, y, a, size):
    return y * (1.0 + abs(exponent) * size / np.maximum(np.abs(a), np.finfo(float).tiny))


_ARITHMETIC = {"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative}
VALUE = {
    "copy": lambda _, a: a,
    "scale": lambda factor, a: a * factor,
    "sqrt": lambda _, a: np.sqrt(a),
    "fabs": lambda _, a: np.abs(a),
    "power": lambda exponent, a: a**exponent,
    "gate": lambda _, a, b: np.where(a != 0, b, 0.0),
    "fmin": lambda _, a, b: np.where(a <= b, a, b),
    "fmax": lambda _, a, b: np.where(a <= b, b, a),
    "constant": apply,
    "quad": apply,
}
_SIZE = {  # from the magnitude of y, and values and sizes of the operands
    "div": lambda _, y, a, b, size_a, size_b: np.hypot(size_a, y * size_b) / np.abs(b),
    "neg": lambda _, y, a, size: size,
    "copy": lambda _, y, a, size: size,
    "fabs": lambda _, y, a, size: size,
    "scale": lambda factor, y, a, size: abs(factor) * size,
    "sqrt": lambda _, y, a, size: _power_size(0.5, y, a, size),
    "power": _power_size,
    "gate": lambda _, y, a, b, size_a, size_b: np.where(a != 0, size_b, 0.0),
    "fmin": lambda _, y, a, b, size_a, size_b: np.where(a <= b, size_a, size_b),
    "fmax": lambda _, y, a, b, size_a, size_b: np.where(a <= b, size_b, size_a),
}


def evaluate(tape, inputs, operations=None):
    """Values of a tape's outputs and the sizes of their terms, (n_outputs, N), for inputs (n_inputs, N).

    The size of a + b is the root of the sum of squares of size(a) and size(b), as for independent errors, and at least
    |a + b|; that of a b is the same root for |a| size(b) and size(a) |b|, that of y = f(a) is |y| + |f'(a)| size(a).
    Rounding errors are about the machine's epsilon times the size, so an output far below its size is zero. Sums
    instead of roots would grow exponentially along a chain of rotations, whose errors do not. The precision is that of
    `inputs`; `operations` are functions by kind of node, by default `VALUE`.
    """
    outputs = tape.plan.place[tape.outputs]
    with np.errstate(all="ignore"):
        v = tape.plan.values(np.asarray(inputs), operations)
        return v[outputs], tape.plan.sizes(v)[outputs]


def column_of(i, k):
    """The column of coefficient k of the reference i in an instant, after the time."""
    return 1 + i * (JETS + 1) + k


class Scalars:
    """SX scalars on one tape, with the places of their symbols in jet space.

    `places` says what each symbol is; see `Coordinates.where`. `others` are element hashes of symbols outside jet
    space, besides the parameters, which are evaluated as zero. An instant is a row of numbers: the time, then the
    Taylor coefficients 0 .. JETS of each reference.
    """

    def __init__(self, q, parameters, expressions, others=()):
        self.expressions, self.tape = expressions, Tape(None, expressions)
        self._last = None, None  # inputs, and the values of all nodes
        self.places = [q.where(s) for s in self.tape.symbols]
        names = [p.element_hash() for p in parameters]
        self._top = 1 + max([-1, *(place[2] for place in self.places if place and place[0] == "r")])  # references used
        instant = 1 + len(names)
        first = {"t": instant, "q": instant + 1 + self._top * (JETS + 1)}
        self._rows, self._factors = [], np.ones((len(self.places), 1))
        for i, (symbol, place) in enumerate(zip(self.tape.symbols, self.places, strict=True)):
            if place is None:
                key = symbol.element_hash()
                self._rows.append(0 if key in others else 1 + names.index(key))
            else:
                kind, level, k = place
                if kind == "r":
                    row = instant + column_of(k, level)
                else:
                    row = k + (first["q"] + q.nq + (level - 1) * q.n if kind == "w" else first[kind])
                self._rows.append(row)
                self._factors[i] = factorial(level)

    def inputs(self, t, z, values):
        """Values of the symbols (n, N) at instants t (N, 1 + R) and jets z (nz, N); jets of a higher level are zero."""
        first, known = 1 + len(values), 1 + self._top * (JETS + 1)
        sources = np.empty((first + known + len(z), len(t)), dtype=REAL)
        sources[0], sources[1:first], sources[first + known :] = 0.0, values[:, None], z
        sources[first : first + known] = np.reshape(t, (len(t), -1))[:, :known].T
        return sources[[row if row < len(sources) else 0 for row in self._rows]] * self._factors

    def values(self, t, z, values):
        """Values of the scalars (len, N)."""
        return self._nodes(t, z, values)[self.tape.plan.place[self.tape.outputs]]

    def evaluate(self, t, z, values):
        """Values and sizes of the scalars (2, len, N); see `evaluate`."""
        nodes = self._nodes(t, z, values)
        with np.errstate(all="ignore"):
            sizes = self.tape.plan.sizes(nodes)
        return np.array([nodes, sizes])[:, self.tape.plan.place[self.tape.outputs]]

    def _nodes(self, t, z, values):
        """Values of all nodes of the tape, cached for the last points."""
        inputs = self.inputs(t, z, values)
        last, nodes = self._last
        if not np.array_equal(inputs, last):
            with np.errstate(all="ignore"):
                nodes = self.tape.plan.values(inputs)
            self._last = inputs, nodes
        return nodes


class Book:
    """The scalars of earlier calls: no expression is put on a second tape."""

    def __init__(self):
        self._places = {}  # element hash: its Scalars, and its index among them

    def find(self, q, parameters, expressions):
        """The scalars that hold expressions; expressions that no call has seen before share a new tape.

        A list of (Scalars, indices among them, indices in `expressions`).
        """
        hashes = [e.element_hash() for e in expressions]
        new = {h: e for h, e in zip(hashes, expressions, strict=True) if h not in self._places}
        if new:
            scalars = Scalars(q, parameters, list(new.values()))
            self._places |= {h: (scalars, i) for i, h in enumerate(new)}
        by_scalars = {}
        for at, (scalars, i) in enumerate(map(self._places.get, hashes)):
            sources, targets = by_scalars.setdefault(scalars, ([], []))
            sources.append(i)
            targets.append(at)
        return [(scalars, *places) for scalars, places in by_scalars.items()]
