"""What a designer may give: numbers, intervals, columns, names; each check returns the value in one form or raises.

Expressions first, numbers below. All raise `SpecificationError`, with what was given in its `details`.
"""

import math

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError, unknown

ON_SAMPLE = 1e-6  # of a period: how far from an instant of sampling, or a count from a whole number, rounding may lead
MOST_MEMORY = 8e9  # bytes for the numbers of all samples: as much as common machines have


def column(value, what, size=None):
    """A list of SX scalars from a scalar, a sequence, or an SX column; `size` is the length that it must have."""
    try:
        if isinstance(value, (list, tuple)):
            value = ca.vertcat(*value) if value else ca.SX(0, 1)
        flat = ca.densify(ca.vec(ca.SX(value)))
        items = flat.elements()
    except Exception as error:  # CasADi raises several types here, none of which helps the designer
        raise SpecificationError(
            f"{what} is a {type(value).__name__}, not an expression.",
            "Specifications are CasADi SX expressions of the coordinates, parameters and t, or numbers.",
            do="Build it from the symbols with CasADi's own functions (ca.sin, ca.sqrt, ca.vertcat, ...).",
            what=what,
        ) from error
    if size is not None and len(items) != size:
        raise SpecificationError(
            f"{what} has {len(items)} entries.", f"It needs {size}.", do="Give one entry each.", what=what
        )
    if any(_holds_no_number(item) for item in items):
        raise SpecificationError(
            f"{what} holds NaN or infinity.",
            "Functions of math and most of numpy turn symbols into NaN without a word.",
            nearest="ca.sin instead of math.sin, ca.norm_2 instead of np.linalg.norm.",
            do="Use CasADi's functions on symbols.",
            what=what,
        )
    return items


def matrix(value, what):
    """An SX matrix from a number, an SX matrix, an array, or nested sequences of scalars."""
    try:
        if isinstance(value, (list, tuple)):
            value = ca.vertcat(*(ca.horzcat(*row) if isinstance(row, (list, tuple)) else ca.SX(row) for row in value))
        result = ca.SX(value)
    except Exception as error:  # CasADi raises several types here
        raise SpecificationError(
            f"{what} is {value!r}.",
            "It is a matrix of numbers and expressions.",
            do="Give rows of equal length.",
            what=what,
        ) from error
    column(ca.vec(result), what)
    return result


def _holds_no_number(expression):
    """Whether a constant in an SX scalar is NaN or infinite."""
    f = ca.Function("f", [], [expression], {"allow_free": True})
    constants = (f.instruction_constant(k) for k in range(f.n_instructions()) if f.instruction_id(k) == ca.OP_CONST)
    return any(not math.isfinite(c) for c in constants)


def mapping(value, what):
    """A dict with text for keys, from a dict or None; `what` begins the message: "The limits"."""
    if value is None:
        return {}
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise SpecificationError(
            f"{what} are {repr(value)[:150]}.", "They go by name.", do="Give a dict with text for keys.", what=what
        )
    return value


def is_number(value):
    """Whether a value is a finite number, Python's or NumPy's; True and False are none."""
    numbers = (int, float, np.integer, np.floating)
    return isinstance(value, numbers) and not isinstance(value, bool) and bool(np.isfinite(value))


def is_whole(value):
    """Whether a value is a whole number, Python's or NumPy's; True and False are none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def plain(value):
    """A number, text or truth value of Python's own kinds, or None."""
    value = value.item() if getattr(value, "ndim", None) == 0 else value
    return value if isinstance(value, (bool, int, float, str)) else None


def finite(name, value, what="value"):
    """A finite float from a number."""
    try:
        number = math.nan if isinstance(value, (str, bytes, complex)) else float(value)
    except Exception:  # CasADi raises its own types for symbols
        number = math.nan
    if not math.isfinite(number):
        raise SpecificationError(f"The {what} {name!r} is {value!r}.", f"A {what} is a finite number.", name=name)
    return number


def positive(name, value):
    """A positive finite float from a number."""
    number = finite(name, value)
    if number <= 0:
        raise SpecificationError(f"{name} = {number:g} was given.", f"The {name} is positive.", name=name, value=number)
    return number


def positives(name, values, do, fewest=1, most=np.inf):
    """Positive finite numbers as an array, from a number or an array-like, at least `fewest`, each at most `most`."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        numbers = np.zeros(1)
    if numbers.size < fewest or not np.all(np.isfinite(numbers) & (numbers > 0) & (numbers <= most)):
        count = "It is a positive number, or several" if fewest == 1 else f"It is {fewest} positive numbers or more"
        bound = "" if most == np.inf else f", at most {most:g}"
        raise SpecificationError(f"{name}={values!r} was given.", f"{count}{bound}.", do=do, name=name, value=values)
    return numbers


def whole(name, value, least=0):
    """An int from a whole number (1000.0 is one, True is none) that is not below `least`."""
    try:
        number = least - 1 if isinstance(value, (bool, str, bytes)) else int(value)
    except (TypeError, ValueError, OverflowError):
        number = least - 1
    if number < least or number != value:
        raise SpecificationError(
            f"{name}={value!r} was given.", f"It is a whole number, at least {least}.", name=name, value=value
        )
    return number


def positive_number(name, value, most=np.inf):
    """A positive number up to `most` as a float; text and truth values are none."""
    if not (is_number(value) and 0 < value <= most):
        raise SpecificationError(
            f"{name}={value!r} was given.",
            f"It is a positive number{f', at most {most:g}' if np.isfinite(most) else ''}.",
            nearest=f"{name}={most:g}." if is_number(value) and value > most else "",
            **{name: value},
        )
    return float(value)


def whole_of(name, value, valid):
    """An int out of `valid`, a range or a tuple of int; 5.0 is none."""
    if not (is_whole(value) and value in valid):
        span = f"from {valid[0]} to {valid[-1]}" if isinstance(valid, range) else f"out of {', '.join(map(str, valid))}"
        raise SpecificationError(
            f"{name}={value!r} was given.",
            f"It is a whole number {span}.",
            nearest=f"{name}={min(valid, key=lambda number: abs(number - value))}." if is_number(value) else "",
            **{name: value},
        )
    return int(value)


def whole_multiple(number, what, of):
    """How many whole units a number is, to rounding, at least 0: `what` is counted ("delay"), `of` what ("samples")."""
    number = finite(what, number)
    nearest = max(round(number), 0)
    if abs(number - nearest) > ON_SAMPLE * max(1.0, 1e-6 * abs(number)):
        raise SpecificationError(
            f"{what} makes {number:.9g} {of}.",
            f"It is a whole number of {of}, at least 0.",
            nearest=f"{nearest}.",
            number=number,
        )
    return nearest


def interval(name, value, what):
    """The interval (low, high) of a name as floats, infinite on a side that is open.

    A number c stands for (-c, c), None leaves a side open; `what` it is, in the singular: "limit", "bound".
    """
    try:
        low, high = (-value, value) if np.ndim(value) == 0 else value
        low, high = -np.inf if low is None else float(low), np.inf if high is None else float(high)
    except (TypeError, ValueError):
        low = high = np.nan
    if not low < high or np.isinf([low, high]).all():
        raise SpecificationError(
            f"The {what} of {name!r} is {value!r}.",
            f"A {what} is an interval: a pair with low < high, None on an open side, or a positive number for both.",
            nearest=f"({high:g}, {low:g})." if -np.inf < high < low < np.inf else "",
            name=name,
            value=value,
        )
    return low, high


def numbers_by_name(values, names, what, meaning, low=-np.inf, positive=False):
    """Finite numbers by name, none below `low`; `what` has them ("actuator"), `meaning` is what they are ("lag")."""
    numbers = {}
    for name, value in mapping(values, f"The {meaning}s").items():
        if name not in names:
            raise unknown(name, names, what)
        numbers[name] = number = finite(name, value, meaning)
        if number < low or (positive and number <= 0):
            raise SpecificationError(
                f"The {meaning} of {name!r} is {number:g}.",
                f"A {meaning} is {'positive' if positive else 'not negative'}.",
                do="Leave it out, or change the number.",
                name=name,
                value=number,
            )
    return numbers


def as_span(t_span, forward=False):
    """A span of time as two different finite numbers [s]; `forward` allows no other than t1 > t0."""
    try:
        t0, t1 = map(float, t_span)
    except (TypeError, ValueError):
        t0 = t1 = np.nan
    if not (np.isfinite(t0) and np.isfinite(t1)) or t0 == t1 or (forward and t1 < t0):
        raise SpecificationError(
            f"t_span={t_span!r} was given.",
            "It goes from t0 to a later t1 [s]." if forward else "A span is two different finite times [s].",
            nearest=f"({t1:g}, {t0:g})." if t1 < t0 else "",
            do="" if t1 < t0 else "Give (0.0, 2.0).",
            t_span=t_span,
        )
    return t0, t1


def require_memory(samples, numbers, given):
    """Refuse more samples than fit into memory: of each, so many numbers are kept; `given` begins the message."""
    memory = 8.0 * samples * numbers
    if memory > MOST_MEMORY:
        raise SpecificationError(
            f"{given}: {samples:.4g} samples, which take {memory / 1e9:.3g} GB.",
            f"The numbers of all samples are kept, in {MOST_MEMORY / 1e9:g} GB at most.",
            nearest=f"{MOST_MEMORY / (8 * numbers):.3g} samples.",
            do="Lower the rate, or shorten the time.",
            samples=float(samples),
        )
