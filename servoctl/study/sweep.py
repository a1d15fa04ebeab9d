"""Many cases of one computation, on any executor: the same table whatever computes it, and no failure lost."""

import contextlib
import functools
import inspect
import json
import multiprocessing
import pickle
import signal
import threading
from collections.abc import Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed

import numpy as np

from servoctl.checks import plain, whole
from servoctl.codegen.function import compiling_at_once
from servoctl.control.result import Closed
from servoctl.errors import ServoError, SpecificationError
from servoctl.progress import progress_bar
from servoctl.run import Run
from servoctl.study.cases import CASES, FAILURE, RESERVED, as_cases, generator
from servoctl.study.checkpoint import Checkpoint, identity
from servoctl.study.table import Study, machine

INTERRUPTED = 1  # status of a run that Ctrl-C ended


def sweep(case, cases, *, executor=None, seed=None, checkpoint=None, shard=None, progress=None) -> Study:
    """Compute every case and gather the numbers in one table.

    The table is the same, bit for bit, however many workers compute it and in whatever order, on processors of one
    kind. A case that raises becomes a row with the error in place of its numbers.

    Main arguments

    Parameters
    ----------
    case : callable
        `case(**parameters)` returns a dict of numbers and texts, or a Run, of which the extrema and final values of
        actuators and outputs and the largest residual are taken. Where it has a parameter `rng`, it is given a numpy
        Generator that depends on the seed and the case's index alone. For processes it is a function of a module's
        top level; it derives what it needs itself (`functools.cache` keeps models in each process).
    cases : sequence of dict, or dict of sequences
        Parameters of each case, such as from `grid` or `monte_carlo`, or a column for each.
    executor : concurrent.futures.Executor, optional
        Threads, processes, loky, or Dask's `client.get_executor()`; default: this process, one case after the other.
        It is not shut down.
    seed : int, optional
        Of `rng`; needed where the case draws random numbers, refused where it does not.

    Other arguments

    checkpoint : str or Path, optional
        File to which finished rows are appended; a sweep of the same cases, seed and function goes on where it ends.
    shard : (i, n), optional
        Compute only part i of n, i = 1 .. n: the cases with index i - 1, i - 1 + n, ... `merge` joins the parts.
    progress : bool, optional
        Show a progress bar; default: on a terminal, for work of more than a second.

    Returns
    -------
    Study
        Columns case (the index), the parameters, the numbers, error, message and facts. Ctrl-C returns what is done;
        a pool that dies leaves rows that say so.

    Raises
    ------
    SpecificationError
        For cases that form no table, a seed that is missing or not used, a shard that does not exist, a case that
        cannot be sent to processes, a checkpoint of another sweep.
    ServoError
        If the pool died before a single case was finished, or the checkpoint cannot be written.
    """
    cases = as_cases(cases)
    seed = _seed(case, seed)
    mine = range(len(cases)) if shard is None else _part(shard, len(cases))
    require_fitting(case, cases[0], seed)
    _require_sendable(case, executor)
    name = name_of(case)
    key = identity(f"{_module_of(case)}.{name}", cases, seed)
    work = _in_turn if executor is None else functools.partial(_on, executor)
    lost, interrupted = {}, False
    with Checkpoint(checkpoint, key) as disk:
        rows = {row["case"]: row for row in disk.rows if row["case"] in mine}
        todo = [(i, cases[i]) for i in mine if i not in rows]
        with progress_bar("sweep", progress, len(mine), initial=len(rows), unit="case") as bar:
            try:
                for i, row, finished in work(case, todo, seed):
                    (rows if finished else lost)[i] = row
                    if finished:
                        disk.add(row)
                    bar.update()
            except KeyboardInterrupt:
                interrupted = True
    if lost and not rows:
        raise _died(next(iter(lost.values())), len(mine))
    meta = {"case": name, "identity": key, "seed": seed, "count": len(cases), "shard": list(shard) if shard else None}
    meta |= {"parameters": list(cases[0]), "lost": sorted(lost), "interrupted": interrupted, "machine": machine()}
    columns = _columns(cases, rows | lost)
    return Study("sweep", columns, meta | {"message": _message(columns, meta, len(mine))})


def merge(studies) -> Study:
    """The shards of a sweep as one table, in the order of the cases.

    Parameters
    ----------
    studies : sequence of Study
        From `sweep` with the same cases, seed and function. Of a case that occurs twice the finished row is taken.

    Returns
    -------
    Study

    Raises
    ------
    SpecificationError
        If there is none, or they belong to different sweeps.
    """
    studies = [studies] if isinstance(studies, Study) else list(studies)
    keys = {getattr(study, "meta", {}).get("identity") for study in studies}  # that only a sweep has
    if len(keys) != 1 or None in keys:
        raise SpecificationError(
            f"{len(studies)} studies of {len(keys)} different sweeps are to be merged.",
            "Shards of one sweep have the same cases, seed and function.",
            do="Merge the shards of each sweep by themselves.",
        )
    rows, lost = {}, set()
    for study in studies:
        for row in study.rows():
            if row["case"] in study.meta["lost"]:
                lost.add(row["case"])
                rows.setdefault(row["case"], row)
            else:
                rows[row["case"]] = row
    lost -= {i for study in studies for i in study["case"].tolist() if i not in study.meta["lost"]}
    names = dict.fromkeys(name for study in studies for name in study.columns if name not in FAILURE)
    columns = {name: [rows[i].get(name) for i in sorted(rows)] for name in (*names, *FAILURE)}
    meta = studies[0].meta | {"shard": None, "lost": sorted(lost)}
    meta["interrupted"] = any(study.meta["interrupted"] for study in studies) and len(rows) < meta["count"]
    return Study("sweep", columns, meta | {"message": _message(columns, meta, meta["count"])})


def evaluate(case, index, parameters, seed):
    """One row: case (the index), and the numbers of a case, or how it failed: error, message, facts (JSON)."""
    if multiprocessing.parent_process() is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent: a case is whole or not computed
    drawn = {} if seed is None else {"rng": generator(seed, CASES, index)}
    try:
        with compiling_at_once():  # compiled and interpreted results differ by rounding: all are compiled
            numbers = _numbers(case(**parameters, **drawn), parameters)
    except (Exception, SystemExit) as error:
        facts = json.dumps(getattr(error, "details", {}), default=str)
        return {"case": index, "error": type(error).__name__, "message": str(error), "facts": facts}
    return {"case": index, "numbers": numbers}


def _numbers(result, parameters):
    numbers = dict(result) if isinstance(result, Mapping) else summary(result)
    for name, value in numbers.items():
        if name in parameters or name in RESERVED or plain(value) is None:
            raise SpecificationError(
                f"The case returned {name} = {value!r}.",
                f"A case returns numbers and texts, by names other than its parameters' and {', '.join(RESERVED)}.",
                do="Rename it, or take one number of it.",
                name=name,
            )
    return {str(name): plain(value) for name, value in numbers.items()}


def summary(run):
    """Numbers of a run for a row.

    Parameters
    ----------
    run : Run or Closed

    Returns
    -------
    dict of str to float
        NAME_min, NAME_max and NAME_end of actuators and outputs; of a plan the largest residual over all rows and
        levels, of a closed loop the largest and the last one of each row, RESIDUAL_worst and RESIDUAL_last; t_end [s].

    Raises
    ------
    SpecificationError
        If it is neither.
    """
    if isinstance(run, Closed):
        numbers = _extrema(run, (*run.plant.inputs, *run.plant.mechanism.outputs))
        errors = {name: np.abs(levels[0]) for name, levels in run.residual.items()}
        numbers |= {f"{name}_worst": float(error.max()) for name, error in errors.items()}
        numbers |= {f"{name}_last": float(error[-1]) for name, error in errors.items()}
    elif isinstance(run, Run):
        if run.status == INTERRUPTED:
            raise KeyboardInterrupt
        known = run.names if run.model is None else (*run.model.actuators, *run.model.outputs)
        numbers = _extrema(run, [name for name in known if name in run.names])
        numbers["residual"] = max((float(np.abs(run.residual[name]).max()) for name in run.residual), default=0.0)
    else:
        raise SpecificationError(
            f"The case returned {type(run).__name__}.",
            "A case returns numbers by name, a Run, or the run of a closed loop.",
            do="Return one of these.",
        )
    return {**numbers, "t_end": float(run.t[-1])}


def _extrema(run, names):
    numbers = {}
    for name in names:
        values = run[name]
        numbers |= {f"{name}_min": values.min(), f"{name}_max": values.max(), f"{name}_end": values[-1]}
    return {name: float(value) for name, value in numbers.items()}


# --- where cases are computed


def _in_turn(case, todo, seed):
    """Rows (index, row, finished) computed here."""
    with _noticing() as pressed:
        for i, parameters in todo:
            row = evaluate(case, i, parameters, seed)
            if pressed:
                raise KeyboardInterrupt  # which the case took for the end of its own simulation
            yield i, row, True


def _on(executor, case, todo, seed):
    """Rows as an executor finishes them; a case that it could not finish has a row that says why."""
    futures, unsent = {}, {}
    try:
        for i, parameters in todo:
            try:
                futures[executor.submit(evaluate, case, i, parameters, seed)] = i
            except RuntimeError as error:  # the pool has died, or was shut down
                unsent[i] = error
        for future in as_completed(futures):
            try:
                yield futures[future], future.result(), True
            except Exception as error:
                yield futures[future], _lost(futures[future], error), False
    except (KeyboardInterrupt, GeneratorExit):
        for future in futures:
            future.cancel()
        raise
    yield from ((i, _lost(i, error), False) for i, error in unsent.items())


def _lost(index, error):
    message = f"The executor did not finish this case: {error}" if str(error) else "The executor did not finish this."
    return {"case": index, "error": type(error).__name__, "message": message, "facts": "{}"}


@contextlib.contextmanager
def _noticing():
    """A list that is not empty once Ctrl-C was pressed, even where the interrupt is caught inside."""
    pressed = []
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield pressed
        return

    def press(number, frame):
        pressed.append(number)
        signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, press)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


# --- what was given


def name_of(case):
    """The name of a case's function, with the arguments that functools.partial has bound."""
    if isinstance(case, functools.partial):
        bound = [*map(repr, case.args), *(f"{k}={v!r}" for k, v in sorted(case.keywords.items()))]
        return f"{name_of(case.func)}({', '.join(bound)})"
    return getattr(case, "__qualname__", type(case).__qualname__)


def _module_of(case):
    case = case.func if isinstance(case, functools.partial) else case
    return getattr(case, "__module__", type(case).__module__)


def _seed(case, seed):
    try:
        draws = "rng" in inspect.signature(case).parameters
    except (TypeError, ValueError) as error:
        raise SpecificationError(
            f"The case is {case!r}.", "A case is a function of its parameters.", do="Give a function."
        ) from error
    if draws == (seed is not None):
        return None if seed is None else whole("seed", seed)
    given = f"seed = {seed!r} was given" if seed is not None else "No seed was given"
    raise SpecificationError(
        f"{given}, and the case {name_of(case)} has {'a' if draws else 'no'} parameter rng.",
        "A case that draws random numbers takes them from rng, a numpy Generator made of the seed and its index.",
        do="Give a seed." if draws else "Leave the seed out, or draw from rng; monte_carlo(n, seed=...) has its own.",
        seed=seed,
    )


def _part(shard, count):
    try:
        i, n = (whole("shard", part) for part in shard)
    except (TypeError, ValueError):
        i = n = 0
    if not 1 <= i <= n:
        raise SpecificationError(
            f"shard = {shard!r}.", "A shard (i, n) is part i of n, from 1 to n.", do="Give (1, 4).", shard=shard
        )
    return range(i - 1, count, n)


def require_fitting(case, parameters, seed):
    """Refuse parameters that the case's function does not take, before all cases fail by them."""
    drawn = {} if seed is None else {"rng": None}
    try:
        inspect.signature(case).bind(**parameters, **drawn)
    except TypeError as error:
        call = f"{name_of(case)}{inspect.signature(case)}"
        raise SpecificationError(
            f"The cases have the parameters {', '.join(parameters)} for {call}: {error}.",
            "A case is called with its parameters by name.",
            do="Name the function's arguments as the parameters are named.",
            parameters=list(parameters),
        ) from error


def _require_sendable(case, executor):
    """Refuse, before anything is computed, what is no executor, and what processes could not receive."""
    if not isinstance(executor, Executor | None):
        raise SpecificationError(
            f"executor={executor!r} was given.",
            "Cases are computed here, or on an executor of concurrent.futures.",
            do="Give an executor that is open, such as concurrent.futures.ThreadPoolExecutor(2).",
        )
    if not isinstance(executor, ProcessPoolExecutor):
        return
    try:
        pickle.dumps(case)
    except Exception as error:
        raise SpecificationError(
            f"The case {name_of(case)} cannot be sent to another process: {error}.",
            "A process receives a function by its name: it is at the top level of a module, and holds no model.",
            do="Move it there, and derive the model inside of it, kept by functools.cache, or use loky or Dask.",
            case=name_of(case),
        ) from error


# --- what comes out


def _message(columns, meta, count):
    failed, lost = sum(error != "" for error in columns["error"]), len(meta["lost"])
    parts = [f"{len(columns['case']) - failed} of {count} cases finished"]
    parts += [f"{failed - lost} failed"] if failed > lost else []
    parts += [f"{lost} not finished by the executor"] if lost else []
    parts += ["interrupted: what was computed is kept"] if meta["interrupted"] else []
    return ", ".join(parts)


def _died(row, count):
    return ServoError(
        f"The executor finished none of {count} cases. {row['error']}: {row['message']}",
        "A worker imports the module of the case, computes it and sends its numbers back.",
        do='Let a script start its work below if __name__ == "__main__", and check the memory that a case needs.',
        error=row["error"],
    )


def _columns(cases, rows):
    """The table of rows in the order of their cases."""
    rows = [rows[i] for i in sorted(rows)]
    results = dict.fromkeys(name for row in rows for name in row.get("numbers", ()))
    columns = {"case": [row["case"] for row in rows]}
    columns |= {name: [cases[row["case"]][name] for row in rows] for name in cases[0]}
    columns |= {name: [row.get("numbers", {}).get(name) for row in rows] for name in results}
    return columns | {name: np.array([row.get(name, "") for row in rows], dtype=str) for name in FAILURE}
