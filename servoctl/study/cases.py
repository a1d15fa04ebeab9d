"""Cases of a sweep: dicts of parameters from grids, random draws or columns."""

import itertools
import math
from collections.abc import Mapping

import numpy as np

from servoctl.checks import MOST_CASES, as_list, plain, whole
from servoctl.errors import SpecificationError

CASES = 1  # third word of the counters from which cases draw; noise of measurements has 0
FAILURE = ("error", "message", "facts")  # columns of cases that failed
RESERVED = ("case", *FAILURE, "rng")


def grid(**values) -> list[dict]:
    """All combinations of values: the last name varies fastest.

    Parameters
    ----------
    **values : sequence of float
        Values of each parameter by name, SI; a single number is the same in all cases.

    Returns
    -------
    list of dict

    Raises
    ------
    SpecificationError
        For an empty sequence, and for more than `MOST_CASES` combinations.
    """
    _require_few(math.prod(len(value) for value in values.values() if isinstance(value, range)))
    columns = {name: _column(name, value) for name, value in values.items()}
    _require_few(math.prod(map(len, columns.values())))
    return [dict(zip(columns, row, strict=True)) for row in itertools.product(*columns.values())]


def monte_carlo(n: int, /, *, seed: int, **distributions) -> list[dict]:
    """Random cases; case i depends on the seed and on i alone, so that a larger n adds cases and changes none.

    Parameters
    ----------
    n : int
        Number of cases.
    seed : int
        Seed of the random numbers.
    **distributions : number, callable or frozen distribution of scipy.stats
        Distribution of each parameter by name: a number is the same in all cases; a callable is called with a numpy
        Generator and returns a number. Each name has its own random stream: one more name changes none of the others.

    Returns
    -------
    list of dict

    Raises
    ------
    SpecificationError
        If n or the seed is not a whole number, n is larger than `MOST_CASES`, or a distribution is none of the above.
    """
    n, seed = whole("n", n), whole("seed", seed)
    _require_few(n)
    draws = {name: _draw(name, distribution) for name, distribution in distributions.items()}
    return [{name: _value(name, draw, _stream(seed, i, name)) for name, draw in draws.items()} for i in range(n)]


def _require_few(n):
    if n > MOST_CASES:
        raise SpecificationError(
            f"{min(n, 1e300):.4g} cases were requested.",
            f"At most {MOST_CASES:,} cases form one table: each is held in memory.",
            do="Take fewer values, or several sweeps.",
            cases=n,
            most=MOST_CASES,
        )


def _stream(seed, index, name):
    """A numpy Generator for each seed, index of the case and name of the parameter."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0, index, *name.encode())))


def generator(seed, index):
    """The numpy Generator of a case, for each seed and index, by counter: Philox 4x64-10.

    It does not depend on other cases, their order, or where they run.
    """
    return np.random.Generator(np.random.Philox(key=seed % 2**128, counter=[0, index, CASES, 0]))


def as_cases(cases):
    """Cases as dicts of Python's int, float, str and bool, from a sequence of dicts or a dict of columns."""
    if isinstance(cases, Mapping):
        columns = {name: _column(name, values) for name, values in cases.items()}
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) > 1:
            raise SpecificationError(
                f"The columns of the cases have the lengths {', '.join(f'{n}: {k}' for n, k in lengths.items())}.",
                "All columns must have one value for each case.",
                do="For all combinations of values use grid(...).",
                lengths=lengths,
            )
        cases = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    rows = as_list(cases)
    if rows is None:
        raise SpecificationError(
            f"The cases are {cases!r}.",
            "Cases are a sequence of dicts of parameters, or a dict of columns.",
            do='Give them as grid(m=[1.0, 2.0]) or {"m": [1.0, 2.0]}.',
            type=type(cases).__name__,
        )
    cases = [_case(i, case) for i, case in enumerate(rows)]
    if not cases:
        raise SpecificationError("There is no case.", do="Give at least one, as by grid(m=[1.0, 2.0]).", cases=0)
    for i, case in enumerate(cases):
        if set(case) != set(cases[0]):
            raise SpecificationError(
                f"Case {i} has the parameters {', '.join(case)}; case 0 has {', '.join(cases[0])}.",
                "All cases of a sweep must have the same parameters, as they form one table.",
                case=i,
                parameters=list(case),
                expected=list(cases[0]),
            )
    return cases


def as_columns(cases):
    """Columns by name, (N,) arrays or lists, from what `as_cases` takes; arrays of finite numbers as they are."""
    columns = cases if isinstance(cases, Mapping) else {}
    if columns and all(map(_are_numbers, columns.values())) and len(set(map(len, columns.values()))) == 1:
        _case(0, {name: column[0] for name, column in columns.items()})  # which checks the names
        return dict(columns)
    rows = as_cases(cases)
    return {name: [row[name] for row in rows] for name in rows[0]}


def _are_numbers(column):
    """Whether a column is an array (N,) of finite numbers."""
    numeric = isinstance(column, np.ndarray) and column.ndim == 1 and column.dtype.kind in "iuf"
    return numeric and len(column) > 0 and bool(np.isfinite(column).all())


def _case(i, case):
    if not isinstance(case, Mapping):
        raise SpecificationError(
            f"Case {i} is {case!r}.",
            "A case must be a dict of parameters.",
            do='Give a dict such as {"m_load": 100.0}.',
            case=i,
        )
    values = {}
    for name, value in case.items():
        if not isinstance(name, str) or name in RESERVED:
            raise SpecificationError(
                f"Case {i} has a parameter named {name!r}.",
                f"Names of parameters are texts; {', '.join(RESERVED)} are reserved.",
                do="Choose another name.",
                name=name,
                case=i,
            )
        values[name] = _entry(name, value, f" of case {i}", case=i)
    return values


def _entry(name, value, where="", **details):
    """The value of a parameter as Python's int, float, str or bool."""
    entry = plain(value)
    if entry is None or (isinstance(entry, float) and not math.isfinite(entry)):
        raise SpecificationError(
            f"Parameter {name}{where} is {repr(value)[:150]}.",
            "A parameter must be a finite number, a text, or True or False.",
            do="Leave the case out."
            if isinstance(entry, float)
            else "Give an index or a name, and look the object up inside the case.",
            name=name,
            **details,
        )
    return entry


def _column(name, values):
    column = as_list(values)
    column = [_entry(name, value) for value in ([values] if column is None else column)]
    if not column:
        raise SpecificationError(f"{name} has no values.", "Each parameter needs at least one.", name=name)
    return column


def _draw(name, distribution):
    """The function of a numpy Generator that draws one value."""
    if plain(distribution) is not None:
        value = _entry(name, distribution)
        return lambda rng: value
    if hasattr(distribution, "rvs"):
        return lambda rng: plain(distribution.rvs(random_state=rng))
    if hasattr(distribution, "sample"):
        return lambda rng: plain(distribution.sample(rng=rng))
    if callable(distribution):
        return distribution
    raise SpecificationError(
        f"The distribution of {name} is {distribution!r}.",
        "It must be a number, a function of a numpy Generator, or a frozen distribution of scipy.stats.",
        do="Give a function such as lambda rng: rng.normal(100.0, 5.0).",
        name=name,
    )


def _value(name, draw, rng):
    """One value of a parameter; an error of numpy or scipy names the parameter."""
    try:
        return draw(rng)
    except (TypeError, ValueError) as error:
        raise SpecificationError(
            f"{name} cannot be drawn: {error}.",
            "Each case draws one number from the distribution with a numpy Generator.",
            name=name,
        ) from error
