"""Thousands of closed loops of one plant and one law with different numbers, in one compiled call."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from servoctl.checks import MOST_COUNT, as_numbers, mapping, require_kind, whole
from servoctl.codegen.function import Compiled
from servoctl.control.batch import Gathered, run_batch, unit
from servoctl.control.close import close, require_consistent
from servoctl.control.conditions import Timing, index, steps
from servoctl.control.noise import first_words
from servoctl.control.residuals import Residuals, program_residuals
from servoctl.control.result import Closed
from servoctl.errors import IntegrationStopped, ServoError, SpecificationError, unknown
from servoctl.plants.equations import equations_at
from servoctl.spec.references import require_fixed
from servoctl.study.batch import Batch, failure, of_finished
from servoctl.study.cases import CASES, as_columns
from servoctl.study.executor import computed, whole_run

SEEDS = 2**31  # seeds of cases are below this


def close_many(
    run: Closed,
    cases: Mapping[str, ArrayLike] | Sequence[Mapping[str, float]],
    *,
    scale: Mapping[str, str] | None = None,
    record: Sequence[str] = (),
    every: int = 1,
    executor: int | None = None,
) -> Batch:
    """Run a closed loop thousands of times, with different numbers in each case.

    The loops run in compiled code, in the lanes of vectors and on threads; without a compiler one after the other. The
    result of a case equals that of `close` to rounding, and depends neither on other cases nor on threads. If `Timing`
    leaves the substeps open, all cases take those of the case with the fastest eigenvalue.

    Parameters
    ----------
    run : Closed
        A loop run by `close`. Its plant, law, start, span, sensors, timing, disturbances and plan hold for all cases,
        except for the numbers in `cases`. Its law must be compiled, alone or under `limited`: functions go by `sweep`.
    cases : dict of str to (N,) array, or sequence of dict
        Numbers by name: parameters of the plant ("m_load", "damping x" if it has that damping), initial states
        ("theta"), and columns for `scale`. `monte_carlo` and `grid` make them. With noise each case has a seed that
        depends on that of the run and its index only: the column "seed", with which `close` repeats the case. It is the
        first `rng.integers(2**31)` in a `sweep` with this seed.
    scale : dict of str to str, optional
        Column of `cases` whose values multiply a disturbance, by disturbance.
    record : sequence of str
        States, inputs and residuals ("residual X") to trace.
    every : int
        Traces have every n-th sample.
    executor : int, optional
        The number of threads in this process, default: one per core. Unlike `simulate_many` it takes no executor of
        processes: disturbances may be functions that none can be sent.

    Returns
    -------
    Batch
        Its table has the numbers, the seed of the noise, and for each state, input and residual (order <= 1) the
        largest size over all samples, the root mean square and the value at the end; its traces are those of `record`.
        After Ctrl-C it holds the finished cases, with `meta["interrupted"]` True.

    Raises
    ------
    NameUnknown
        For a name that plant, law or cases do not have.
    SpecificationError
        For a law that is not compiled, and for invalid values.
    InconsistentStart
        If the initial state of a case violates a material constraint.
    """
    _require(run)
    columns = _columns(cases)
    numbers = _case_numbers(run, columns, mapping(scale, "The scales"))
    run = _at_all(run, numbers[0])
    loop = _resolved(run, *numbers[:2])
    derived = _unit(run)
    traced, every = _traced(record, derived.names, every)
    seeds = _seeds(run.conditions.sensors, len(columns[next(iter(columns))]))
    threads = executor if executor is None else whole("executor", executor, least=1)
    gathered = None
    if not run.plant.equations.rests:  # else each loop is judged by itself
        step = run.law.step.native("step") if run.law.allocation else None
        placed = _numbers_of(run.plant, numbers[0])[: run.plant.at_u]
        gathered = run_batch(derived, loop, (placed, *numbers[1:]), _noise(run, seeds), traced, every, threads, step)
    if gathered is None:
        gathered = _one_by_one(run, derived, loop, numbers, seeds, traced, every)
    meta = {
        "t_span": [loop.t0, loop.t0 + loop.samples * loop.period],
        "by": run.law.name,
        "rate": run.law.rate,
        "substeps": loop.substeps,
        "delay": loop.delay,
        "units": run.units,
    }
    reasons = _reasons(run, loop, numbers, seeds, gathered) if run.law.allocation else {}
    study = _study(columns, seeds, derived.names, gathered, meta, reasons)
    t, traces = loop.t0 + np.arange(len(gathered.trace)) * every * loop.period, gathered.trace[..., study["case"]]
    return Batch(study, t, dict(zip(record, np.moveaxis(traces, 1, 0), strict=True)))


def _require(run):
    require_kind(Closed, "run", run, "sv.close(...)")
    if not isinstance((run.law.allocation or run).law.step, Compiled):
        raise SpecificationError(
            f"The law {run.law.name!r} is computed in Python.",
            "Many loops run in compiled code, with their law.",
            do="Use a compiled law, as of sv.lqr, or sv.sweep, whose cases may close any loop.",
            name=run.law.name,
        )


def _at_all(run, constants):
    """The loop of a plant whose equations hold for the constants (n_c, N) of all cases."""
    equations = run.plant.equations
    parameters = constants[: len(equations.values)]
    equations.require_inertia(parameters)
    again = equations_at(equations, parameters)
    return run if again is equations else replace(run, plant=replace(run.plant, equations=again))


def _resolved(run, constants, starts):
    """The loop with substeps for the case with the fastest eigenvalue."""
    plant, law, loop = run.plant, run.law, run.loop
    require_consistent(plant, loop.t0, starts, _numbers_of(plant, constants))
    if run.conditions.timing.substeps is not None:
        return loop
    substeps = _most_steps(plant, law, loop, constants, starts)
    if substeps == loop.substeps:
        return loop
    transport = steps(plant, law.period, substeps, loop.t0, loop.x0, loop.initial_input)[1]
    forces = run.conditions.forces(loop.t0, law.period / substeps, loop.samples * substeps)
    return replace(loop, substeps=substeps, transport=transport, **forces)


def _numbers_of(plant, constants, u=None):
    """The vectors p (n_p, N) of a plant with other parameters (n_c, N) and the same inputs u (m,), default 0."""
    p = np.repeat(plant.p(u)[:, None], constants.shape[1], axis=1)
    p[plant.at_u - len(constants) : plant.at_u] = constants
    return p


def _unit(run):
    residuals = None if run.plan is None else _residuals_of_state(run.plan.model, run.plant)
    return unit(run.plant, run.law, tuple(run.loop.disturbed.tolist()), residuals)


@lru_cache(32)
def _residuals_of_state(model, plant):
    """The residuals of a program that are functions of the state; None if there are none."""
    order, rows = model.reduction.mechanism.q.order, program_residuals(model)
    residuals = Residuals(model, plant, rows={name: e for name, e in rows.items() if order(e) <= 1})
    return residuals if residuals.names else None


def _seeds(sensors, n):
    """The seed of each case's noise; None without noise."""
    if not sensors.noise:
        return None
    words = first_words(sensors.seed or 0, CASES, n)
    return (words % 2**32 * SEEDS // 2**32).tolist()  # as numpy's Generator.integers(SEEDS) of the same words


def _noise(run, seeds):
    """Standard deviations (n_y,) of the measurements, and keys (N, 2) of the cases' noise; None without noise."""
    if seeds is None:
        return None
    keys = np.zeros((len(seeds), 2), dtype=np.uint64)
    keys[:, 0] = seeds  # below 2^64: see `noise.key`
    return run.conditions.sensors.deviations(run.law.measures), keys


def _columns(cases):
    """Numbers by name, (N,) each."""
    columns = {name: as_numbers(values) for name, values in as_columns(cases).items()}
    unfit = [name for name, values in columns.items() if not np.isfinite(values).all()]
    if unfit or not columns:
        raise SpecificationError(
            f"The cases have no numbers by the names {', '.join(unfit)}." if unfit else "The cases have no columns.",
            "Each column has one finite number per case.",
            do='Pass such columns, as {"m_load": np.linspace(90.0, 110.0, 1000)}, or dicts.',
            names=unfit,
        )
    return columns


def _case_numbers(run, columns, scale):
    """Parameters (n_c, N), initial states (n_x, N) and factors of the disturbances (n_d, N)."""
    plant, disturbance = run.plant, run.conditions.disturbance
    for name, column in scale.items():
        index(name, tuple(disturbance), "disturbance")
        index(column, tuple(columns), "column of the cases")
    n = len(next(iter(columns.values())))
    damped = (f"damping {name}" for name in plant.disturbable if name in plant.damping)
    parameters = (*plant.mechanism.parameters.names, *damped)
    constants = np.repeat(plant.parameters[:, None], n, axis=1)
    starts = np.repeat(run.loop.x0[:, None], n, axis=1)
    for name, values in columns.items():
        if name in parameters and name in disturbance:
            raise SpecificationError(
                f"The cases have the number {name!r}, which is disturbed in the loop.",
                "A disturbed parameter is a function of time.",
                do=f'Multiply the function in each case: scale={{"{name}": column}}.',
                name=name,
            )
        if name in parameters:
            require_fixed(plant.paths, plant.mechanism.parameters, [name], "Cases of a loop have their own")
            constants[parameters.index(name)] = values
        elif name in plant.state_names:
            starts[plant.state_names.index(name)] = values
        elif name not in scale.values():
            raise unknown(name, (*parameters, *plant.state_names, *scale.values()), "parameter, state or scale")
    factors = [columns[scale[name]] if name in scale else np.ones(n) for name in disturbance]
    return constants, starts, np.array(factors).reshape(len(factors), n)


def _most_steps(plant, law, loop, constants, starts):
    """Integration steps per sample of the case with the fastest eigenvalue at the start."""
    n_x, n = starts.shape
    p = _numbers_of(plant, constants, loop.initial_input)
    both = plant.function("jacobian").grid(loop.t0, starts, p).reshape(-1, n_x, n).transpose(2, 1, 0)
    A = np.where(np.isfinite(both[:, :, :n_x]), both[:, :, :n_x], 0.0)
    case = int(np.argmax(np.abs(np.linalg.eigvals(A)).max(axis=1)))
    slowest = replace(plant, parameters=constants[:, case])
    return max(loop.substeps, steps(slowest, law.period, None, loop.t0, starts[:, case], loop.initial_input)[0])


def _traced(record, names, every):
    every = whole("every", every, least=1, most=MOST_COUNT)
    if not isinstance(record, (list, tuple)) or every != 1 and not len(record):
        raise SpecificationError(
            f"record={record!r} and every={every!r} were given.",
            "record is a sequence of names; every thins out their traces.",
            do='Pass names: record=["theta"], every=10.',
            record=record,
            every=every,
        )
    return [index(name, names, "signal") for name in record], every


def _one_by_one(run, derived, loop, numbers, seeds, traced, every):
    """The same by `close`, for want of a compiler."""
    n, size = numbers[1].shape[1], len(derived.names)
    lost = np.full((2, n), np.nan)
    results = np.full((3, size, n), np.nan)
    trace = np.full((loop.samples // every + 1 if traced else 0, len(traced), n), np.nan)

    def compute(i):
        ended = np.full(2, np.inf)
        try:
            one = _one(run, loop, *(part[:, i] for part in numbers), seeds[i] if seeds else None)
        except ServoError as error:
            if error.run is None:
                raise
            ended[0 if isinstance(error, IntegrationStopped) else 1] = error.details["t"]
            return ended, np.nan, np.nan
        whole_run(one)
        residuals = [one.residual[name][0] for name in (derived.residuals.names if derived.residuals else ())]
        values = np.vstack([one.states, one.inputs, *residuals])
        found = np.abs(values).max(axis=1), np.sqrt(np.mean(values**2, axis=1)), values[:, -1]
        return ended, found, values[traced, ::every].T if traced else 0.0

    def take(i, found):
        lost[:, i], results[:, :, i], trace[:, :, i] = found

    computed(compute, {i: (i,) for i in range(n)}, None, take)
    return Gathered(*lost, *results, trace)


def _one(run, loop, constants, start, factors, seed):
    """The loop of one case, by `close`."""
    conditions = run.conditions
    forces = zip(conditions.disturbance.items(), factors, strict=True)
    return close(
        replace(run.plant, parameters=constants),
        run.law,
        start,
        (loop.t0, loop.t0 + loop.samples * loop.period),
        sensors=replace(conditions.sensors, seed=seed),
        timing=Timing(delay=loop.delay, substeps=loop.substeps),
        disturbance={name: _scaled(force, factor) for (name, force), factor in forces},
        plan=run.plan,
    )


def _scaled(f, factor):
    known = {name: getattr(f, name) for name in ("edges", "longest") if hasattr(f, name)}
    return type("Scaled", (), {"__call__": lambda _, t: factor * f(t), **known})() if callable(f) else factor * f


def _reasons(run, loop, numbers, seeds, gathered):
    """The errors of cases whose law found no inputs, by index."""
    errors = {}
    for i in np.flatnonzero(gathered.law_lost < gathered.state_lost):
        try:
            _one(run, loop, *(part[:, i] for part in numbers), seeds[i] if seeds else None)
        except ServoError as error:
            errors[int(i)] = error
    return errors


def _study(columns, seeds, names, gathered, meta, reasons):
    """The table of the finished cases; results of a loop that ended early are NaN."""
    early, of_law = np.minimum(gathered.state_lost, gathered.law_lost), gathered.law_lost < gathered.state_lost
    errors = {i: _ended(early[i], of_law[i]) for i in np.flatnonzero(np.isfinite(early)).tolist()}
    errors |= {i: failure(error) for i, error in reasons.items()}
    parts = {"max |{}|": gathered.largest, "rms {}": gathered.rms, "final {}": gathered.last}
    results = {of.format(name): row for of, rows in parts.items() for name, row in zip(names, rows, strict=True)}
    results = {name: np.where(np.isfinite(early), np.nan, values) for name, values in results.items()}
    columns = columns | ({"seed": np.array(seeds)} if seeds else {}) | results
    return of_finished("closed loops", ~np.isnan(gathered.state_lost), columns, errors, meta)


def _ended(t, of_law):
    """The columns of a failure at the time t, of the law or of the state."""
    error, what = ("ServoError", "the law's answer") if of_law else ("IntegrationStopped", "the state")
    return {"error": error, "message": f"{what} is not finite at t = {t:.6g} s", "facts": json.dumps({"t": t})}
