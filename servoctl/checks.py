"""Checks of input: expressions, kinds and names first, numbers below. Each returns the value in one form or raises.

All raise `SpecificationError`, with the name and the value in its `details`. What is read by a name is one signal,
wherever it is read: `distinct` keeps the names of a mechanism and its program apart, `meant` takes their short forms.
"""

import math
import os
import re
from collections.abc import Iterable, Mapping, Set
from pathlib import Path

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError, unknown

ON_SAMPLE = 1e-6  # rounding of a sampling instant [periods], or of a count
MOST_CASES = 10**6  # of one sweep: some gigabytes of parameters and rows
MOST_JETS = 40  # level of jets, and order of a series: higher ones are functions too large to build
LEAST_TOLERANCE = 1e-30  # of an integrator: far below the rounding of doubles, and its square is one
MOST_COUNT = 10**9  # samples, steps or rows: products of two such counts fit into the 64 bits of C
LONGEST_NAME = 255  # bytes of a file's name in common file systems
MOST_MEMORY = 8e9  # bytes for all samples: the memory of common machines
SUFFIXES = {
    "actuator": "_input",
    "actuator or rate": "_input",
    "output": "_output",
    "parameter": "_parameter",
    "reference": "_reference",
    "residual": "_residual",
    "row": "_residual",
}
OF_REACTIONS = ("multiplier_", "reaction_")  # how names of their components begin


def column(value, what, *sizes):
    """A list of SX scalars from a scalar, a sequence, or an SX column, of one of the sizes if some are given."""
    try:
        if isinstance(value, (list, tuple)):
            value = ca.vertcat(*map(_real, value)) if value else ca.SX(0, 1)
        flat = ca.densify(ca.vec(ca.SX(_real(value))))
        items = flat.elements()
    except Exception as error:  # CasADi raises several types here, none of which helps the designer
        kind = type(value).__name__
        raise SpecificationError(
            f"{what} is a {kind}, not an expression.",
            "Specifications are numbers, or CasADi SX expressions of the coordinates, references, parameters and t.",
            do="Write r = q.references(X=path), and r.X here."
            if kind.endswith("Path")
            else "Build it from the symbols with CasADi's functions (ca.sin, ca.sqrt, ca.vertcat, ...).",
            what=what,
            type=kind,
        ) from error
    if sizes and len(items) not in sizes:
        rule = f"It has {' or '.join(map(str, sizes))}."
        raise SpecificationError(f"{what} has {len(items)} entries.", rule, what=what, entries=len(items), sizes=sizes)
    if _holds_no_number(flat):
        raise SpecificationError(
            f"{what} holds NaN or infinity.",
            "Functions of math and most of numpy turn symbols into NaN without a warning.",
            do="Use CasADi's functions on symbols: ca.sin instead of math.sin, ca.norm_2 instead of np.linalg.norm.",
            what=what,
        )
    return items


def _real(value):
    """The value, of NumPy in double precision; TypeError for truth values and complex numbers, which CasADi takes."""
    kind = getattr(getattr(value, "dtype", None), "kind", "O")
    if isinstance(value, (bool, complex)) or kind in "bc":
        raise TypeError("a truth value or a complex number is no number")
    return value.astype(float) if kind == "f" else value


def matrix(value, what, *shapes):
    """An SX matrix of one of the shapes from a number, a matrix, an array, or nested sequences."""
    try:
        if isinstance(value, (list, tuple)):
            rows = (map(_real, row) if isinstance(row, (list, tuple)) else [ca.SX(_real(row))] for row in value)
            value = ca.vertcat(*(ca.horzcat(*row) for row in rows))
        result = ca.SX(_real(value))
    except Exception as error:  # CasADi raises several types here
        rule, do = "It must be a matrix of numbers and expressions.", "Give rows of equal length."
        raise SpecificationError(f"{what} is {value!r}.", rule, do=do, what=what) from error
    column(ca.vec(result), what)
    if shapes and result.shape not in shapes:
        rule = f"Its shape is {' or '.join(map(str, shapes))}."
        raise SpecificationError(f"{what} has the shape {result.shape}.", rule, what=what, shape=result.shape)
    return result


def _holds_no_number(expression):
    """Whether a constant in an SX column is NaN or infinite."""
    f = ca.Function("f", [], [expression], {"allow_free": True})
    constants = (f.instruction_constant(k) for k in range(f.n_instructions()) if f.instruction_id(k) == ca.OP_CONST)
    return any(not math.isfinite(c) for c in constants)


def mapping(value, what):
    """A dict with text keys, from a dict or None; `what` begins the message: "The limits"."""
    if value is None:
        return {}
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        rule, do = "They are given by name.", "Give a dict with text keys."
        raise SpecificationError(f"{what} are {repr(value)[:150]}.", rule, do=do, what=what, value=value)
    return value


def require_kind(kind, name, value, source):
    """The value, if it is of a kind: a class or a tuple of classes, made by `source` ("sv.derive(...)")."""
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        raise SpecificationError(
            f"{name} has the type {type(value).__name__}.",
            f"It must be a {' or '.join(one.__name__ for one in kinds)}.",
            do=f"Make one by {source}.",
            name=name,
            type=type(value).__name__,
        )
    return value


def without_effect(options, where):
    """Refuse the names of options that are given where they do nothing: `where` ends the sentence, "for a Law"."""
    if options:
        raise SpecificationError(
            f"{', '.join(options)} {'was' if len(options) == 1 else 'were'} given {where}.",
            "This would have no effect.",
            do="Leave it out.",
            options=options,
        )


def text(name, value):
    """The value, if it is a text of whole characters."""
    if not isinstance(value, str) or any("\ud800" <= letter <= "\udfff" for letter in value):
        said = f"{name}={repr(value)[:150]} was given."
        raise SpecificationError(said, "It is a text of whole characters.", name=name, value=value)
    return value


def texts(value, what):
    """A tuple of texts from one text or a sequence of texts; `what` begins the message: "The names of signals"."""
    value = (value,) if isinstance(value, str) else value
    if not isinstance(value, (list, tuple)) or not all(isinstance(text, str) for text in value):
        rule, do = "They are a text, or a list of texts.", 'Write "x" or ["x", "y"].'
        raise SpecificationError(f"{what} are {repr(value)[:150]}.", rule, do=do, what=what, value=value)
    return tuple(value)


def as_list(value):
    """A list from an iterable in order; None from anything else: text, symbols, dicts, sets."""
    if isinstance(value, (str, bytes, Mapping, Set)) or not isinstance(value, Iterable):
        return None
    try:
        return list(value)
    except Exception:  # CasADi's symbols have __iter__, which raises
        return None


def antiderivative(name, names):
    """(q, k) of the k-th derivative of a signal, or None."""
    match = re.fullmatch(r"d([2-9]|[1-9]\d+)?(\D.*)", name)
    return (match[2], int(match[1] or 1)) if match and match[2] in names else None


def distinct(kind, names, others, bases=()):
    """The names under which what is of one kind is read: {name: name, or NAME_input where a signal has that name}.

    Signals are the others, and time derivatives of these and of `bases`. Refused if the longer name is taken, too.
    """
    read, names = {}, tuple(names)
    for name in names:
        taken = name in others or antiderivative(name, (*others, *bases)) or name.startswith(OF_REACTIONS)
        read[name] = name + SUFFIXES[kind] * bool(taken)
        if taken and (read[name] in others or read[name] in names):
            raise SpecificationError(
                f"The {kind} {name!r} has the name of another signal, and {read[name]!r} is taken, too.",
                "What is read by a name is one signal.",
                do="Rename one of them.",
                name=name,
                taken=read[name],
            )
    return read


def meant(name, names, kind):
    """The one of the names of a kind that a name means, where only this kind can be meant; None if there is none."""
    suffix = SUFFIXES.get(kind, "")
    forms = (name, f"{name}{suffix}", name.removesuffix(suffix)) if isinstance(name, str) else ()
    return next((form for form in forms if form in names), None)


def rows_read(rows, signals):
    """The rows by the names under which their residuals are read beside signals: {X or X_residual: X}."""
    return {long: row for row, long in distinct("residual", rows, signals).items()}


def named(value, names, what):
    """The one of the names that is meant, or `NameUnknown`; `what` they name: "signal"."""
    if (found := meant(value, names, what)) is None:
        raise unknown(value, names, what)
    return found


def by_name(values, names, what, given):
    """A dict whose keys mean some of the names, by these; `given` begins the message: "The limits"."""
    found = {}
    for name, value in mapping(values, given).items():
        if (full := named(name, names, what)) in found:
            rule, do = "What is given by name is given once.", "Leave one of them out."
            raise SpecificationError(f"{given} have {full!r} twice, once by its short name.", rule, do=do, name=full)
        found[full] = value
    return found


def as_path(value, what="The path"):
    """A `Path` from text or a path that file systems accept."""
    try:
        path = Path(value)
        fits = all(len(os.fsencode(part)) <= LONGEST_NAME and "\0" not in part for part in path.parts)
    except (TypeError, UnicodeEncodeError):
        fits = False
    if not fits or isinstance(value, str) and not value.strip():
        raise SpecificationError(
            f"{what} is {value!r}"[:200] + ".",
            f"It is text or a path whose parts have at most {LONGEST_NAME} bytes and no null character.",
            path=value,
        )
    return path


def as_numbers(value):
    """An array of float from a number or an array-like of numbers; NaN from anything else, text among it."""
    try:
        truths = isinstance(value, (list, tuple)) and any(isinstance(x, (bool, np.bool_)) for x in value)
        array = np.asarray(value, dtype=object if truths else None)
        if array.dtype.kind == "O":
            array = np.array([x if is_number(x) else math.nan for x in array.ravel()]).reshape(array.shape)
        return array.astype(float) if array.dtype.kind in "iuf" else np.full(array.shape, math.nan)
    except Exception:  # CasADi raises types of its own for symbols
        return np.array(math.nan)


def as_complex(values):
    """An array (k,) or more of complex numbers, as poles, from a number or an array-like; NaN from anything else."""
    try:
        array = np.atleast_1d(np.asarray(values))
    except Exception:  # CasADi raises types of its own for symbols
        array = np.full(1, np.nan)
    return array.astype(complex) if array.dtype.kind in "iufc" else np.full(array.shape, complex(math.nan))


def array_of(name, value, *sizes):
    """An array of finite numbers with these sizes, None for any; a new array, or `value` itself."""
    array = as_numbers(value)
    right = array.ndim == len(sizes) and all(n in (None, m) for n, m in zip(sizes, array.shape, strict=True))
    if not right or not np.isfinite(array).all():
        shape = ", ".join("N" if n is None else str(n) for n in sizes) + ("," if len(sizes) == 1 else "")
        raise SpecificationError(
            f"{name} is {repr(value)[:150]}, of the shape {array.shape}.",
            f"It is an array of finite numbers of the shape ({shape}).",
            name=name,
            shape=array.shape,
            expected=sizes,
        )
    return array


def is_number(value):
    """Whether a value is a finite number of Python or NumPy; True and False are not."""
    if not isinstance(value, (int, float, np.integer, np.floating)) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an int beyond the largest float
        return False


def _is_real(value):
    """Whether a value is a finite or infinite number of Python or NumPy."""
    return is_number(value) or isinstance(value, (float, np.floating)) and not math.isnan(value)


def is_whole(value):
    """Whether a value is an integer of Python or NumPy; True and False are not."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def plain(value):
    """A number, text or truth value as Python's bool, int, float or str; None for anything else."""
    value = value.item() if getattr(value, "ndim", None) == 0 else value
    return value if isinstance(value, (bool, int, float, str)) else None


def finite(name, value, what="value"):
    """A finite float from a number; `what` it is, in the singular: "limit", "noise"."""
    number = _as_float(value)
    if not math.isfinite(number):
        a = "An" if what[0] in "aeiou" else "A"
        raise SpecificationError(
            f"The {what} {name!r} is {value!r}.",
            f"{a} {what} must be a finite number.",
            name=name,
            type=type(value).__name__,
        )
    return number


def _as_float(value):
    """A float from a number, NaN from anything else."""
    try:
        return math.nan if isinstance(value, (str, bytes)) else float(_real(value))
    except Exception:  # CasADi raises its own types for symbols
        return math.nan


def within(name, value, least=-math.inf, most=math.inf, above=-math.inf, given=""):
    """A finite float from a number, at least `least`, at most `most` and greater than `above`.

    `given` begins the message, by default "NAME=VALUE was given."
    """
    number = _as_float(value)
    if not (math.isfinite(number) and least <= number <= most and number > above):
        sides = {"greater than": above, "at least": least, "at most": most}
        rule = " and ".join(f"{words} {bound:g}" for words, bound in sides.items() if math.isfinite(bound))
        nearest = min(max(number, least), most)
        raise SpecificationError(
            given or f"{name}={repr(value)[:150]} was given.",
            f"It is a finite number {rule}.",
            nearest=f"{name}={nearest:g}." if above < nearest != number else "",
            name=name,
            value=value,
        )
    return number


def positive(name, value):
    """A positive finite float from a number."""
    return within(name, value, above=0.0)


def positives(name, values, do, fewest=1, most=np.inf):
    """An array of at least `fewest` positive numbers, none above `most`, from a number or an array-like."""
    numbers = as_numbers(values)
    if numbers.size < fewest or not np.all(np.isfinite(numbers) & (numbers > 0) & (numbers <= most)):
        count = "It must be a positive number, or several" if fewest == 1 else f"Give at least {fewest}, all positive"
        rule = count + ("." if most == np.inf else f", each at most {most:g}.")
        raise SpecificationError(f"{name}={values!r} was given.", rule, do=do, name=name, value=values)
    return numbers


def whole(name, value, least=0, most=math.inf):
    """An int from a whole number between `least` and `most`: from 1000.0, too, but not from True."""
    number = int(value) if is_number(value) or is_whole(value) else least - 1
    if not least <= number <= most or number != value:
        rule = f"It must be a whole number, at least {least}{f' and at most {most}' if most < math.inf else ''}."
        raise SpecificationError(
            f"{name}={value!r} was given."[:200],
            rule,
            nearest=f"{name}={min(max(number, least), most)}." if is_number(value) else "",
            name=name,
            value=value,
            least=least,
            most=most,
        )
    return number


def tolerance(name, value, most):
    """A float up to `most` that is not below what integrators can compute with."""
    return within(name, value, LEAST_TOLERANCE, most)


def positive_number(name, value, most=np.inf):
    """A positive float up to `most` from a number."""
    return within(name, value, most=most, above=0.0)


def whole_of(name, value, valid):
    """An int out of `valid`, a range or a tuple of int; 5.0 is none."""
    if not (is_whole(value) and value in valid):
        span = f"from {valid[0]} to {valid[-1]}" if isinstance(valid, range) else f"out of {', '.join(map(str, valid))}"
        raise SpecificationError(
            f"{name}={repr(value)[:150]} was given.",
            f"It is a whole number {span}.",
            nearest=f"{name}={min(valid, key=lambda n: (abs(n - value), -n))}." if is_number(value) else "",
            **{name: value},
        )
    return int(value)


def whole_multiple(number, what, of):
    """A number that is whole to rounding, as an int of at least 0: `what` ("delay") is counted in `of` ("samples")."""
    number = finite(what, number)
    nearest = max(round(number), 0)
    if abs(number - nearest) > ON_SAMPLE * max(1.0, 1e-6 * abs(number)):
        raise SpecificationError(
            f"{what} makes {number:.9g} {of}.",
            f"It must be a whole number of {of}, at least 0.",
            nearest=f"{nearest}.",
            what=what,
            number=number,
        )
    return nearest


def interval(name, value, what):
    """The interval (low, high) of a name as floats, infinite on an open side; `what` it is: "limit", "bound".

    A number c means (-c, c); None leaves a side open.
    """
    sides = [-value, value] if is_number(value) else as_list(value)
    if sides is None or len(sides) != 2 or not all(side is None or _is_real(side) for side in sides):
        sides = [np.nan, np.nan]
    low, high = (open if side is None else float(side) for side, open in zip(sides, (-np.inf, np.inf), strict=True))
    if not low < high or np.isinf([low, high]).all():
        raise SpecificationError(
            f"The {what} of {name!r} is {value!r}.",
            f"A {what} is an interval: low < high with None on an open side, or a positive number c for (-c, c).",
            nearest=f"({high:g}, {low:g})." if -np.inf < high < low < np.inf else "",
            name=name,
            value=value,
        )
    return low, high


def numbers_by_name(values, names, what, meaning, low=-np.inf, positive=False):
    """Finite numbers by name, none below `low`: each `what` ("actuator") has a `meaning` ("lag")."""
    numbers = {}
    for name, value in by_name(values, names, what, f"The {meaning}s").items():
        number, given = finite(name, value, meaning), f"The {meaning} of {name!r} is {value!r}."
        numbers[name] = within(name, number, low, above=0.0 if positive else -math.inf, given=given)
    return numbers


def as_span(t_span, forward=False):
    """A time span as two different finite numbers [s]; with `forward`, t1 must exceed t0."""
    ends = as_numbers(t_span)
    t0, t1 = map(float, ends) if ends.shape == (2,) else (np.nan, np.nan)
    finite = math.isfinite(t0) and math.isfinite(t1)
    if not finite or t0 == t1 or (forward and t1 < t0):
        raise SpecificationError(
            f"t_span={t_span!r} was given.",
            f"It must be two different finite times (t0, t1) [s]{', with t0 < t1' if forward else ''}.",
            nearest=f"({t1:g}, {t0:g})." if finite and t1 < t0 else "",
            t_span=t_span,
        )
    return t0, t1


def require_memory(samples, numbers, given):
    """Refuse samples, each of so many `numbers`, that do not fit into memory; `given` begins the message."""
    memory = 8.0 * samples * numbers
    if memory > MOST_MEMORY:
        raise SpecificationError(
            f"{given}: {samples:.4g} samples, which take {memory / 1e9:.3g} GB.",
            f"All samples are held in memory, at most {MOST_MEMORY / 1e9:g} GB.",
            nearest=f"{MOST_MEMORY / (8 * numbers):.3g} samples.",
            do="Lower the rate, or shorten the time span.",
            samples=float(samples),
            memory=memory,
        )
