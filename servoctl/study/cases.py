"""Cases of a sweep: grids, random draws, tables of columns; plain dicts of parameters."""

import itertools
import math
from collections.abc import Mapping

from servoctl.checks import plain, whole
from servoctl.errors import SpecificationError

DRAWS, CASES = 0, 1  # first spawn key: random numbers of the parameters, and those that a case draws for itself
FAILURE = ("error", "message", "facts")  # columns of what went wrong
RESERVED = ("case", *FAILURE, "rng")


def grid(**values) -> list[dict]:
    """All combinations of values: the last name varies fastest.

    Parameters
    ----------
    **values : sequence of float
        Values of each parameter by name, SI; a single number is kept fixed.

    Returns
    -------
    list of dict

    Raises
    ------
    SpecificationError
        For an empty sequence.
    """
    columns = {name: _column(name, value) for name, value in values.items()}
    return [dict(zip(columns, row, strict=True)) for row in itertools.product(*columns.values())]


def monte_carlo(n: int, /, *, seed: int, **distributions) -> list[dict]:
    """Random cases; case i depends on the seed and on i alone, so that more cases begin with the same ones.

    Parameters
    ----------
    n : int
        Number of cases.
    seed : int
        Of the random numbers.
    **distributions : number, callable or frozen distribution of scipy.stats
        By parameter: a number is kept fixed, `rng -> number` is called with a numpy Generator, and a distribution is
        drawn from. Each name has a stream of its own: one more name changes none of the others.

    Returns
    -------
    list of dict

    Raises
    ------
    SpecificationError
        If n or the seed is no whole number, or a distribution is none of the above.
    """
    n, seed = whole("n", n), whole("seed", seed)
    draws = {name: _draw(name, distribution) for name, distribution in distributions.items()}
    return [{name: draw(generator(seed, DRAWS, i, name)) for name, draw in draws.items()} for i in range(n)]


def generator(seed, kind, index, name=""):
    """The numpy Generator of one case, whatever cases come before it and wherever they run.

    A stream for each seed, kind (`DRAWS` or `CASES`), index of the case and name of the parameter.
    """
    import numpy as np

    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(kind, index, *name.encode())))


def as_cases(cases):
    """Cases in the order given, from dicts or from a dict of columns, each a dict of Python's own kinds of values."""
    if isinstance(cases, Mapping):
        columns = {name: _column(name, values) for name, values in cases.items()}
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) > 1:
            raise SpecificationError(
                f"The columns of the cases have the lengths {', '.join(f'{n}: {k}' for n, k in lengths.items())}.",
                "A dict of columns has one value per case in each.",
                do="Give columns of one length, or all combinations by grid(...).",
                lengths=lengths,
            )
        cases = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    cases = [_case(i, case) for i, case in enumerate(cases)]
    if not cases:
        raise SpecificationError(
            "There is no case.", "A sweep needs at least one.", do="Add cases, as by grid(m=[1.0, 2.0])."
        )
    for i, case in enumerate(cases):
        if set(case) != set(cases[0]):
            raise SpecificationError(
                f"Case {i} has the parameters {', '.join(case)}, case 0 {', '.join(cases[0])}.",
                "All cases of a sweep have the same parameters, so that they form one table.",
                do="Give every case every parameter.",
                case=i,
            )
    return cases


def _case(i, case):
    if not isinstance(case, Mapping):
        raise SpecificationError(
            f"Case {i} is {case!r}.", "A case is a dict of parameters.", do='Give {"m_load": 100.0}.', case=i
        )
    values = {}
    for name, value in case.items():
        if not isinstance(name, str) or not name.isidentifier() or name in RESERVED:
            raise SpecificationError(
                f"Case {i} has a parameter named {name!r}.",
                f"A parameter's name is a word, and none of {', '.join(RESERVED)}.",
                do="Choose another name.",
                name=name,
            )
        values[name] = plain(value)
        if values[name] is None or (isinstance(values[name], float) and not math.isfinite(values[name])):
            raise SpecificationError(
                f"Parameter {name} of case {i} is {value!r}.",
                "A parameter is a finite number, a text, or True or False: one cell of a table.",
                do="Give an index or a name, and look up what it stands for inside the case.",
                name=name,
                case=i,
            )
    return values


def _column(name, values):
    if isinstance(values, str) or not hasattr(values, "__iter__"):
        return [values]
    column = list(values)
    if not column:
        raise SpecificationError(
            f"{name} has no values.", "Each parameter of a grid or table has at least one.", do="Add some.", name=name
        )
    return column


def _draw(name, distribution):
    if plain(distribution) is not None:
        return lambda rng: distribution
    if hasattr(distribution, "rvs"):
        return _checked(name, lambda rng: plain(distribution.rvs(random_state=rng)))
    if hasattr(distribution, "sample"):
        return _checked(name, lambda rng: plain(distribution.sample(rng=rng)))
    if callable(distribution):
        return _checked(name, distribution)
    raise SpecificationError(
        f"The distribution of {name} is {distribution!r}.",
        "A distribution is a number, a function of a random generator, or a frozen distribution of scipy.stats.",
        do="Give lambda rng: rng.normal(100.0, 5.0).",
        name=name,
    )


def _checked(name, draw):
    """The same draw; what numpy or scipy refuse to draw from names the parameter."""

    def draw_checked(rng):
        try:
            return draw(rng)
        except (TypeError, ValueError) as error:
            raise SpecificationError(
                f"{name} cannot be drawn: {error}.",
                "A distribution is drawn from with a numpy Generator, for each case.",
                do="Correct its numbers.",
                name=name,
            ) from error

    return draw_checked
