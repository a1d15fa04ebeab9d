"""Sweeps: a function called for many cases, on any executor; the table does not depend on who computes it."""

import functools
import inspect
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor

import numpy as np

from servoctl.checks import plain, whole
from servoctl.control.result import Closed
from servoctl.errors import SpecificationError
from servoctl.progress import progress_bar
from servoctl.run import Run
from servoctl.study.batch import failure, failures
from servoctl.study.cases import RESERVED, as_cases, generator
from servoctl.study.executor import computed, require_some
from servoctl.study.table import Study, machine

INTERRUPTED = 1  # status of a Run or Closed that Ctrl-C ended


def sweep(
    case: Callable,
    cases: Sequence[Mapping] | Mapping[str, Sequence],
    *,
    executor: Executor | None = None,
    seed: int | None = None,
    progress: bool | None = None,
) -> Study:
    """Compute every case and gather the numbers in one table.

    On processors of one kind the table is the same, bit for bit, for any number of workers and any order. A case that
    raises becomes a row with the error instead of numbers. Where cases are motions of one model, or loops of one plant,
    that differ in numbers alone, `simulate_many` and `close_many` compute them in vector lanes, 1,000 times as fast.

    Parameters
    ----------
    case : callable
        `case(**parameters)` returns a dict of numbers and texts, or a Run, which gives the extrema and final values of
        its actuators and outputs and its largest residual. If it has a parameter `rng`, that is a numpy Generator
        which depends on the seed and the index of the case alone. For processes it must be at the top level of a
        module, and derive its models itself (`functools.cache` holds them in each process).
    cases : sequence of dict, or dict of sequences
        Parameters of each case, such as from `grid` or `monte_carlo`, or a column of values for each parameter.
    executor : concurrent.futures.Executor, optional
        Threads, processes, loky, or Dask's `client.get_executor()`; default: this process, one case after the other.
        It is not shut down.
    seed : int, optional
        Seed of `rng`; required if the case has a parameter `rng`, refused otherwise.
    progress : bool, optional
        Show a progress bar; default: on a terminal, for work of more than a second.

    Returns
    -------
    Study
        Columns: case (the index), the parameters, the numbers, error, message and facts. After Ctrl-C it has the
        finished cases; cases that a dead pool did not finish have that error.

    Raises
    ------
    SpecificationError
        For cases that form no table, a seed that is missing or unused, and a case that cannot be sent to processes.
    ServoError
        If the pool died before the first case was finished.
    """
    cases = as_cases(cases)
    seed = _fitting_seed(case, cases[0], seed)
    _require_sendable(case, executor)
    rows, calls = {}, {i: (case, i, parameters, seed) for i, parameters in enumerate(cases)}
    with progress_bar("sweep", progress, len(cases), unit="case") as bar:

        def take(i, row):
            rows[i] = row
            bar.update()

        unfinished, interrupted = computed(evaluate, calls, executor, take)
    require_some(unfinished, rows, len(cases))
    meta = {"case": name_of(case), "seed": seed, "count": len(cases), "parameters": list(cases[0])}
    meta |= {"lost": sorted(unfinished), "interrupted": interrupted, "machine": machine()}
    columns = _columns(cases, rows | unfinished)
    return Study("sweep", columns, meta | {"message": _message(columns, meta)})


def evaluate(case, index, parameters, seed):
    """One row: the numbers of a case, or its error, message and facts (JSON)."""
    random = {} if seed is None else {"rng": generator(seed, index)}
    try:
        numbers = _results(case(**parameters, **random), parameters)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit and GeneratorExit, too: no case ends the sweep
        return failure(error)
    return {"numbers": numbers}


def _results(result, parameters):
    numbers = dict(result) if isinstance(result, Mapping) else summary(result)
    for name, value in numbers.items():
        if name in parameters or name in RESERVED or plain(value) is None or _beyond(value):
            raise SpecificationError(
                f"The case returned {name} = {'a whole number beyond 1e308' if _beyond(value) else repr(value)}.",
                f"A case returns numbers and texts. The names of its parameters and {', '.join(RESERVED)} are taken.",
                do="Choose another name, or return single numbers instead of an array.",
                name=name,
            )
    return {str(name): plain(value) for name, value in numbers.items()}


def _beyond(value):
    """Whether a whole number is too large for any array of numbers."""
    return isinstance(value, int) and abs(value) > sys.float_info.max


def summary(run):
    """Numbers of a Run or Closed by name: NAME_min, NAME_max and NAME_end of actuators and outputs, and t_end [s].

    A plan has `residual`, the largest over all rows and levels; a closed loop NAME_worst and NAME_last of each row.
    """
    if getattr(run, "status", None) == INTERRUPTED:
        raise KeyboardInterrupt
    if isinstance(run, Closed):
        numbers = _extrema(run, (*run.plant.inputs, *run.plant.mechanism.outputs))
        errors = {name: np.abs(levels[0]) for name, levels in run.residual.items()}
        numbers |= {f"{name}_worst": float(error.max()) for name, error in errors.items()}
        numbers |= {f"{name}_last": float(error[-1]) for name, error in errors.items()}
    elif isinstance(run, Run):
        known = run.names if run.model is None else (*run.model.actuators, *run.model.outputs)
        numbers = _extrema(run, [name for name in known if name in run.names])
        numbers["residual"] = max((float(np.abs(run.residual[name]).max()) for name in run.residual), default=0.0)
    else:
        kind, rule = type(run).__name__, "A case returns a dict of numbers, a Run, or the run of a closed loop."
        raise SpecificationError(f"The case returned {kind}.", rule, type=kind)
    return {**numbers, "t_end": float(run.t[-1])}


def _extrema(run, names):
    ends = {"min": np.min, "max": np.max, "end": lambda values: values[-1]}
    return {f"{name}_{end}": float(of(run[name])) for name in names for end, of in ends.items()}


# --- checks of the input


def name_of(case):
    """The name of a case's function, with the arguments bound by functools.partial."""
    if isinstance(case, functools.partial):
        bound = [*map(repr, case.args), *(f"{k}={v!r}" for k, v in sorted(case.keywords.items()))]
        return f"{name_of(case.func)}({', '.join(bound)})"
    return getattr(case, "__qualname__", type(case).__qualname__)


def _fitting_seed(case, parameters, seed):
    """The seed of a case with these parameters; refuses parameters that its function does not have, and no seed."""
    try:
        signature = inspect.signature(case)
    except (TypeError, ValueError) as error:
        raise SpecificationError(
            f"The case is {case!r}.", "A case must be a function of its parameters.", type=type(case).__name__
        ) from error
    draws = "rng" in signature.parameters
    if draws != (seed is not None):
        given = f"seed = {seed!r} was given" if seed is not None else "No seed was given"
        raise SpecificationError(
            f"{given}, and the case {name_of(case)} has {'a' if draws else 'no'} parameter rng.",
            "The seed is that of rng, the numpy Generator from which a case draws its random numbers.",
            do="Give a seed."
            if draws
            else "Leave the seed out, or draw from rng; monte_carlo(n, seed=...) has its own.",
            seed=seed,
            draws=draws,
        )
    try:
        signature.bind(**parameters, **({"rng": None} if draws else {}))
    except TypeError as error:
        raise SpecificationError(
            f"The cases have the parameters {', '.join(parameters)} for {name_of(case)}{signature}: {error}.",
            "The function is called with the parameters by name.",
            parameters=list(parameters),
            case=name_of(case),
        ) from error
    return whole("seed", seed) if draws else None


def _require_sendable(case, executor):
    """Refuse what is not an executor, and a case that processes cannot receive, before anything is computed."""
    if not isinstance(executor, Executor | None):
        raise SpecificationError(
            f"executor={executor!r} was given.",
            "It must be an executor of concurrent.futures, or None for this process.",
            do="Give an open executor, such as concurrent.futures.ThreadPoolExecutor(2).",
            type=type(executor).__name__,
        )
    if not isinstance(executor, ProcessPoolExecutor):
        return
    try:
        pickle.dumps(case)
    except Exception as error:
        raise SpecificationError(
            f"The case {name_of(case)} cannot be sent to another process: {error}.",
            "A process imports the function by its name from a module.",
            do="Move it to a module's top level and derive its model there (functools.cache), or use loky or Dask.",
            case=name_of(case),
        ) from error


# --- the table


def _message(columns, meta):
    failed, lost = sum(error != "" for error in columns["error"]), len(meta["lost"])
    parts = [f"{len(columns['case']) - failed} of {meta['count']} cases finished"]
    parts += [f"{failed - lost} failed"] if failed > lost else []
    parts += [f"{lost} not finished by the executor"] if lost else []
    parts += ["interrupted"] if meta["interrupted"] else []
    return ", ".join(parts)


def _columns(cases, rows):
    """The table of rows in the order of their cases."""
    which, found = sorted(rows), {i: row.get("numbers", {}) for i, row in rows.items()}
    columns = {"case": which} | {name: [cases[i][name] for i in which] for name in cases[0]}
    columns |= {name: [found[i].get(name) for i in which] for name in dict.fromkeys(n for i in which for n in found[i])}
    return columns | failures(rows, which)
