"""Expressions with kinks and jumps, written as smooth expressions with a branch as a parameter.

On either side of a switching function g = 0 an expression with |g|, sign g, min, max or a comparison is smooth. With a
parameter b in place of the decision, 1 for g > 0 and 0 for g < 0, it is smooth everywhere, and equal to the original as
long as b is right. The angle atan2(y, x) jumps by 2π behind the origin; written as b π + atan2((-1)ᵇ y, (-1)ᵇ x), with
whole b, its jump lies opposite to the direction b π, and b follows the angle round and round.
"""

from itertools import count
from typing import NamedTuple

import casadi as ca
import numpy as np

from servoctl.tolerances import LAST_EXPONENT

_SIDES = {
    ca.OP_FABS: lambda b, x, y: (2 * b - 1) * x,
    ca.OP_SIGN: lambda b, x, y: 2 * b - 1,
    ca.OP_FMIN: lambda b, x, y: ca.if_else(b, y, x),
    ca.OP_FMAX: lambda b, x, y: ca.if_else(b, x, y),
    ca.OP_LT: lambda b, x, y: 1 - b,
    ca.OP_LE: lambda b, x, y: 1 - b,
}  # the operation on x and y where b says whether x > y
_SWITCHING = {*_SIDES, ca.OP_ATAN2}
MOST_TURNS = 4  # of an angle's factor, relative to the smallest: beyond, products of vectors grow long
_NARROW = 0.5**0.5  # an angle is followed up to 135° on either side of its branch


class Switch(NamedTuple):
    """A decision that the motion may change."""

    branch: ca.SX  # the parameter b
    function: ca.SX  # the switching function, which is not negative where b is right
    other: ca.SX  # the branch beyond its zero
    text: str  # where it changes, in the designer's names
    angle: bool = False  # whether b counts half turns, instead of sides
    rests: bool = False  # whether b = 1/2 stands for the zero of the switching function itself: |0| = 0 and sign 0 = 0


def has_switches(expressions):
    """Whether an SX column of expressions holds an operation with branches."""
    f, last = ca.Function("branches", [], [expressions], {"allow_free": True, "live_variables": False}), set()
    places = 0
    for k in range(f.n_instructions()):
        op, operands = f.instruction_id(k), f.instruction_input(k)
        if op == ca.OP_OUTPUT:
            continue
        if op in _SWITCHING and not last.intersection(operands):
            return True
        if op == ca.OP_CONST and abs(f.instruction_constant(k)) == LAST_EXPONENT:
            last.add(places)
        places += 1
    return False


def contains(f, *operations):
    """Whether an SX function contains one of some operations, such as ``casadi.OP_ERFINV``."""
    return any(f.instruction_id(k) in operations for k in range(f.n_instructions()))


class Branches:
    """Smooth expressions in place of ones with branches that depend on some of their symbols.

    `moves` says of a symbol whether branches may change along a motion that changes it; `taken` are names that branches
    must not have.
    """

    def __init__(self, moves, taken=()):
        self.taken = taken
        self.moves, self.switches, self._angles, self._functions = moves, [], {}, []

    def smooth(self, expressions, angles=""):
        """SX scalars with branches as parameters.

        `angles` by atan2 are "continuous" ones, or "principal" ones, which jump; without it they stay as they are.
        """
        if not expressions:
            return []
        merged = ca.densify(ca.cse(ca.vertcat(*expressions)))
        if not has_switches(merged):
            return merged.elements()
        work, original, moves = [], [], []  # smooth values, the same with their decisions, whether these may change

        def value(op, operands):
            original.append(apply_code(op, *(original[i] for i in operands)))
            moves.append(any(moves[i] for i in operands))
            decides = op in _SIDES or (angles != "" and op == ca.OP_ATAN2)
            decides &= not any(_ends_an_exponent(original[i]) for i in operands)
            if not (moves[-1] and decides):
                return apply_code(op, *(work[i] for i in operands))
            pairs = [(work[i], original[i]) for i in operands]
            return self._angle(*pairs, angles) if op == ca.OP_ATAN2 else self._side(op, *pairs)

        def leaf(expression, symbol):
            original.append(expression)
            moves.append(symbol and self.moves(expression))
            return expression

        return replayed(merged.elements(), work, leaf, value)

    def _side(self, op, x, y=None):
        """|x|, sign x, or an operation that compares x with y; pairs of smooth and original expressions."""
        (x, x0), (y, y0) = x, y or (ca.SX(0), ca.SX(0))
        rests = op in (ca.OP_FABS, ca.OP_SIGN)
        if x.is_constant() and not y.is_constant():  # the same decision as that of y against the constant
            return _SIDES[op](1 - self._branch(y - x, y0 - x0, rests), x, y)
        return _SIDES[op](self._branch(x - y, x0 - y0, rests), x, y)

    def _angle(self, y, x, kind):
        """The continuous angle of (x, y), or the principal one, which turns back by 2π behind the origin."""
        (y, y0), (x, x0) = y, x
        key = y.element_hash(), x.element_hash(), kind
        if key not in self._angles:
            b = self._parameter()
            sign = ca.cos(ca.pi * b)
            ahead = sign * x + _NARROW * ca.sqrt(x**2 + y**2)
            turned = b + ca.if_else(sign * y >= 0, 1, -1)
            if kind == "principal":
                back = ca.logic_and(b != 0, b * y < ahead)
                ahead, turned = ca.if_else(back, b * y, ahead), ca.if_else(back, -b, turned)
            self.switches.append(Switch(b, ahead, turned, f"the angle of ({_words(x0)}, {_words(y0)})", angle=True))
            self._angles[key] = b, sign
        b, sign = self._angles[key]
        return ca.pi * b + ca.atan2(sign * y, sign * x)

    def _parameter(self):
        """A parameter for the next branch."""
        names = (f"branch_{i}" for i in count(len(self.switches)))
        return ca.SX.sym(next(name for name in names if name not in self.taken))

    def _branch(self, g, original, rests):
        """The branch parameter of a switching function, one for equal functions."""
        for i, known in self._functions:
            if ca.is_equal(known, g, 3):
                self.switches[i] = self.switches[i]._replace(rests=rests and self.switches[i].rests)
                return self.switches[i].branch
        b = self._parameter()
        at_zero = b == 0.5
        function = ca.if_else(at_zero, -ca.fabs(g), (2 * b - 1) * g)
        other = ca.if_else(at_zero, g > 0, 1 - b)
        self._functions.append((len(self.switches), g))
        self.switches.append(Switch(b, function, other, f"{_words(original)} = 0", rests=rests))
        return b


def _ends_an_exponent(value):
    """Whether a value is the constant at which exponents stay (see `overflow`), which is no switch."""
    return value.is_constant() and abs(float(value)) == LAST_EXPONENT


def without_turns(expression):
    """An expression that is a sum with angles atan2(y, x), zero also where it differs from zero by whole turns.

    φ = c (θ_1 + k_2 θ_2 + ...) + r with whole k_j is c times the angle of the vector e^(i r/c) z_1 z_2^(k_2) ..., where
    z = x + i y. Written as that angle, φ has the same derivatives, and jumps only opposite to its zeros. An expression
    that is no such sum is returned as it is.
    """
    if not contains(ca.Function("angles", [], [expression], {"allow_free": True}), ca.OP_ATAN2):
        return expression
    work, angles = [], []  # symbols in place of angles, with y and x

    def value(op, operands):
        arguments = [work[i] for i in operands]
        if op != ca.OP_ATAN2 or not any(map(ca.symvar, arguments)):
            return apply_code(op, *arguments)
        angles.append((ca.SX.sym(f"angle_{len(angles)}"), *arguments))
        return angles[-1][0]

    (whole,) = replayed([ca.cse(expression)], work, lambda leaf, symbol: leaf, value)
    slopes = [ca.simplify(ca.jacobian(whole, angle)) for angle, *_ in angles]
    if not all(c.is_constant() for c in slopes) or all(c.is_zero() for c in slopes):
        return expression
    factors = np.array([float(c) for c in slopes])
    factor = factors[np.argmin(np.where(factors == 0, np.inf, np.abs(factors)))]
    turns = factors / factor
    if np.any(turns % 1) or np.abs(turns).max() > MOST_TURNS:
        return expression
    symbols = ca.vertcat(*(angle for angle, *_ in angles))
    rest = ca.substitute(whole, symbols, ca.SX.zeros(len(angles))) / factor
    x, y = ca.cos(rest), ca.sin(rest)
    for (_, sine, cosine), k in zip(angles, turns, strict=True):
        for _ in range(abs(int(k))):
            x, y = x * cosine - np.sign(k) * y * sine, y * cosine + np.sign(k) * x * sine
    result = 2 * factor * ca.atan(y / (x + ca.sqrt(x**2 + y**2)))
    for symbol, sine, cosine in reversed(angles):  # of angles inside other angles
        result = ca.substitute(result, symbol, ca.atan2(sine, cosine))
    return result


_EDGES = {
    ca.OP_ASIN: ("asin", (-1.0, 1.0)),
    ca.OP_ACOS: ("acos", (-1.0, 1.0)),
    ca.OP_ATANH: ("atanh", (-1.0, 1.0)),
    ca.OP_ACOSH: ("acosh", (1.0,)),
    ca.OP_SQRT: ("sqrt", (0.0,)),
    ca.OP_LOG: ("log", (0.0,)),
    ca.OP_POW: ("a power", (0.0,)),
    ca.OP_CONSTPOW: ("a power", (0.0,)),
}


def domain_edges(expressions):
    """Where functions in expressions cease to be smooth: in words, an argument (SX), and its value at the edge."""
    work, result = [], []

    def value(op, operands):
        arguments = [work[i] for i in operands]
        name, edges = _EDGES.get(op, ("", ()))
        words = f"the argument of {name}, {_words(arguments[0])}, reaches"
        result.extend((f"{words} {edge:g}, where its domain ends", arguments[0], edge) for edge in edges)
        if op in (ca.OP_DIV, ca.OP_INV):
            result.append((f"it divides by {_words(arguments[-1])}, which reaches zero", arguments[-1], 0.0))
        if op == ca.OP_TAN:
            result.append((f"the argument of tan, {_words(arguments[0])}, passes a pole", ca.cos(arguments[0]), 0.0))
        if op == ca.OP_ATAN2:
            angle = f"the angle atan2({', '.join(map(_words, arguments))}) passes pi"
            result.append((angle, ca.fmax(ca.fabs(arguments[0]), arguments[1]), 0.0))
        return apply_code(op, *arguments)

    replayed(expressions, work, lambda expression, symbol: expression, value)
    return result


_STEEP = {
    *(ca.OP_POW, ca.OP_CONSTPOW, ca.OP_SQRT, ca.OP_EXP, ca.OP_LOG, ca.OP_SINH, ca.OP_COSH, ca.OP_TANH),
    *(ca.OP_ATAN, ca.OP_ASINH, ca.OP_ERF, ca.OP_ATAN2, ca.OP_HYPOT, ca.OP_DIV, ca.OP_INV, ca.OP_EXPM1, ca.OP_LOG1P),
}  # not sin and cos, which are as steep everywhere


def steep_arguments(expressions):
    """The arguments near whose zeros functions in expressions may change much in a short time: a list of SX.

    A bump exp(-(k z)²), a blend tanh(k z) or a pole 1/(z² + a²) is narrow about z = 0; sines, cosines and whole powers
    are not.
    """
    work, result = [], {}

    def value(op, operands):
        arguments = [work[i] for i in operands]
        if op in _STEEP and not _whole_power(op, arguments):
            steep = arguments[1:] if op == ca.OP_DIV else arguments
            result.update((a.element_hash(), a) for a in steep if not a.is_constant())
        return apply_code(op, *arguments)

    replayed(expressions, work, lambda expression, symbol: expression, value)
    return list(result.values())


def _whole_power(op, arguments):
    if op in (ca.OP_POW, ca.OP_CONSTPOW) and arguments[1].is_constant():
        exponent = float(arguments[1])
        return exponent >= 0 and exponent == round(exponent)
    return False


_SIZES = {
    ca.OP_ADD: lambda a, b: a + b,
    ca.OP_SUB: lambda a, b: a + b,
    ca.OP_MUL: lambda a, b: a * b,
    ca.OP_NEG: lambda a: a,
    ca.OP_TWICE: lambda a: 2 * a,
    ca.OP_SQ: lambda a: a**2,
}  # magnitudes of sums and products from those of their operands


def size_of_terms(expression):
    """The sum of the magnitudes of an expression's terms, multiplied out."""
    return sizes_of_terms([expression])[0]


def sizes_of_terms(expressions):
    """The sums of the magnitudes of several expressions' terms, which share their operations: a list of SX scalars."""
    values, sizes = [], []

    def size(op, operands):
        values.append(apply_code(op, *(values[i] for i in operands)))
        if op == ca.OP_DIV:
            return sizes[operands[0]] / ca.fabs(values[operands[1]])
        return _SIZES[op](*(sizes[i] for i in operands)) if op in _SIZES else ca.fabs(values[-1])

    def leaf(expression, symbol):
        values.append(expression)
        return ca.fabs(expression)

    return replayed(expressions, sizes, leaf, size)


def replayed(expressions, work, leaf, value):
    """The outputs of expressions whose operations are taken one by one; `work` receives all values in their order.

    `leaf` gives the value of a symbol (True) or a constant (False), `value` that of an operation on places of `work`.
    """
    f = ca.Function("operations", [], list(expressions), {"allow_free": True, "live_variables": False})
    free, outputs = iter(f.free_sx()), [ca.SX(0)] * len(expressions)
    for k in range(f.n_instructions()):
        op, operands = f.instruction_id(k), f.instruction_input(k)
        if op == ca.OP_OUTPUT:
            outputs[f.instruction_output(k)[0]] = work[operands[0]]
        elif op == ca.OP_PARAMETER:
            work.append(leaf(next(free), True))
        elif op == ca.OP_CONST:
            work.append(leaf(ca.SX(f.instruction_constant(k)), False))
        else:
            work.append(value(op, operands))
    return outputs


def apply_code(op, *operands):
    """The operation of CasADi with a code, of SX scalars."""
    return ca.SX.unary(op, *operands) if len(operands) == 1 else ca.SX.binary(op, *operands)


def _words(expression):
    """An expression as in `shown`, without the brackets around it."""
    text = shown(expression)
    return text[1:-1] if text.startswith("(") and text.endswith(")") and text.count("(") == 1 else text


def shown(expression, longest=40):
    """An SX scalar in the designer's names.

    Where that is long, functions of t alone are f(t); where it is still long, the names are left.
    """
    for text in (str(expression), str(_without_paths(expression))):
        if "@" not in text and len(text) <= longest:
            return text
    return f"a function of {', '.join(s.name() for s in ca.symvar(expression))}"


def _without_paths(expression):
    """An SX scalar with f(t) in place of functions of t alone."""
    work, timed, path = [], [], ca.SX.sym("f(t)")  # for each value whether it depends on t alone; None for a number

    def leaf(value, symbol):
        timed.append(value.name() == "t" if symbol else None)
        return value

    def value(op, operands):
        moves = any(timed[i] is False for i in operands)
        timed.append(False if moves else True if any(timed[i] for i in operands) else None)
        return apply_code(op, *(path if moves and timed[i] and work[i].n_dep() else work[i] for i in operands))

    return replayed([expression], work, leaf, value)[0]
