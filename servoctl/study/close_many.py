"""Thousands of closed loops of one plant and one law, with other numbers in each, in one compiled call."""

from dataclasses import dataclass, replace

import numpy as np

from servoctl.checks import as_span, mapping, whole, whole_multiple
from servoctl.codegen.function import Compiled
from servoctl.control.batch import Gathered, run_batch, unit
from servoctl.control.close import CONSISTENT, Conditions, close, noisy, prepared, require_names, steps
from servoctl.control.feedback import Residuals
from servoctl.control.law import Law
from servoctl.control.tracking import require_plant
from servoctl.errors import InconsistentStart, IntegrationStopped, ServoError, SpecificationError, unknown
from servoctl.study.cases import CASES, as_cases, generator
from servoctl.study.table import Study, machine, table

SEEDS = 2**31  # the seed of a case is below


@dataclass(frozen=True, eq=False)
class Batch:
    """The results of many closed loops; made by `close_many`.

    `batch["max |theta|"]` is a column of the table, (N,), `batch.trace["theta"]` is (K, N).

    Attributes
    ----------
    study : Study
        A row per case: its numbers, the seed of its noise, and for each state, input and residual (order <= 1) the
        largest size over all samples, the root mean square and the value at the end; "error" and "message" tell of
        loops that ended early, whose results are NaN.
    t : (K,) array
        Instants of the traces [s].
    trace : dict of str to (K, N) array
        What was asked for by `record`.
    """

    study: Study
    t: np.ndarray
    trace: dict

    def __len__(self):
        return len(self.study)

    def __getitem__(self, name):
        return self.study[name]

    def __repr__(self):
        failed = int(np.sum(self.study["error"] != ""))
        told = f"{len(self)} closed loops, {failed} ended early; {self.study.meta['law']}"
        traced = f"  traces of {', '.join(self.trace)}: {len(self.t)} samples" if self.trace else "  no traces"
        shown = [name for name in self.study.columns if not name.startswith(("rms", "final", "message"))][:8]
        return "\n".join([f"Batch: {told}"[:120], traced[:120], *table(self.study, shown, most=5)])


def close_many(
    plant, law, x0, t_span, cases, *, delay=0, noise=None, seed=None, quantisation=None, disturbance=None, scale=None,
    substeps=None, plan=None, record=(), every=1, threads=None,
):  # fmt: skip
    """Run closed loops of one plant and one law with other numbers in each: what `close` does, thousands of times.

    The loops run in compiled code, in the lanes of vectors and on threads; without a compiler one after the other. Each
    equals `close` of its numbers to rounding, and depends neither on the cases beside it nor on threads.

    Main arguments

    Parameters
    ----------
    plant : Plant
    law : Law
        Of the toolkit, an expression: neither a function of Python nor a limited law; those go by `sweep`.
    x0 : array or dict of str to float
        State at the start, as `close` takes it, where a case does not say otherwise.
    t_span : (t0, t1)
        [s]
    cases : dict of str to (N,) array, or sequence of dict
        What differs, by name: parameters of the plant ("m_load", "damping x" where it has that damping), states at the
        start ("theta"), and columns that `scale` names. `monte_carlo` and `grid` make them.

    Other arguments

    delay : int
        Samples from the measurement to the input.
    noise : dict of str to float, optional
        Standard deviation of the noise by measured state.
    seed : int, optional
        Of all cases' noise; default 0. Each case has a seed of its own, by its index alone: the column "seed", with
        which `close` repeats it. It is what `rng.integers(2**31)` gives first in a `sweep` of this seed.
    quantisation : dict of str to float, optional
        Step of the measurement by measured state.
    disturbance : dict of str to callable or float, optional
        Generalised forces by coordinate (or quasi-velocity), the same in all cases
    scale : dict of str to str, optional
        but for a factor: by disturbance the column of the cases that has it.
    substeps : int, optional
        Integration steps per sample, for all cases; default: as `close` takes them for the case that needs most.
    plan : Run, optional
        The run whose program's residuals are gathered; default the law's own.
    record : sequence of str
        States, inputs and residuals ("residual X") of which traces are kept
    every : int
        at every so many samples.
    threads : int, optional
        Default: one per core.

    Returns
    -------
    Batch

    Raises
    ------
    NameUnknown
        For a name that plant, law or cases do not have.
    SpecificationError
        For a law that is no expression, and for values that make no sense.
    InconsistentStart
        If material constraints do not hold at the start of a case.
    """
    _require(plant, law)
    plan, columns = law.plan if plan is None else plan, _columns(cases)
    conditions = _conditions(disturbance, noise, quantisation, seed)
    arguments = (plant, law, x0, as_span(t_span, forward=True), whole_multiple(delay, "delay", "samples"), conditions)
    loop, numbers = _prepared(arguments, substeps, columns, mapping(scale, "The scales"))
    derived = _unit(plant, law, plan, loop)
    traced, every = _traced(record, derived.names, every)
    seeds = _seeds(conditions, len(columns[next(iter(columns))]))
    own_noise = seeds and (lambda case: noisy(conditions.noise, law.measures, loop.samples + 1, seeds[case]))
    threads = threads if threads is None else whole("threads", threads, least=1)
    found = run_batch(derived, loop, numbers, own_noise, traced, every, threads)
    if found is None:
        found = _one_by_one(plant, law, plan, derived, loop, numbers, conditions, seeds, traced, every)
    meta = {"law": law.name, "rate": law.rate, "substeps": loop.substeps, "delay": loop.delay, "machine": machine()}
    study = _study(columns, seeds, derived.names, found, {"t_span": list(as_span(t_span, forward=True))} | meta)
    t = loop.t0 + np.arange(len(found.trace)) * every * loop.period
    return Batch(study, t, dict(zip(record, np.moveaxis(found.trace, 1, 0), strict=True)))


def _require(plant, law):
    require_plant(plant)
    if not isinstance(law, Law) or not isinstance(law.step, Compiled):
        what = f"The law {law.name!r}" if isinstance(law, Law) else f"A {type(law).__name__}"
        raise SpecificationError(
            f"{what} was given, which answers in Python.",
            "Loops run side by side in compiled code, laws among it.",
            nearest="sv.sweep(case, cases), whose cases may close any loop.",
            do="Use it, or a law of the toolkit without allocation.",
        )
    require_names(law, plant)


def _conditions(disturbance, noise, quantisation, seed):
    if not noise and seed is not None:
        raise SpecificationError("A seed was given without noise.", "The seed is that of the noise.", do="Remove it.")
    given = {"disturbances": disturbance, "noise": noise, "quantisation": quantisation}
    by_name = (dict(mapping(values, f"The {what}")) for what, values in given.items())
    return Conditions(*by_name, 0 if seed is None else whole("seed", seed))


def _prepared(arguments, substeps, columns, scale):
    """What the loops have in common, and their own parameters, starts and factors of disturbances."""
    plant, law, *_, conditions = arguments
    loop = prepared(*arguments, substeps)
    numbers = _numbers(plant, columns, loop, conditions.disturbance, scale)
    _require_consistent(plant, loop.t0, *numbers[:2])
    if substeps is None:
        substeps = _most_steps(plant, law, loop, *numbers[:2])
        loop = loop if substeps == loop.substeps else prepared(*arguments, substeps)
    return loop, numbers


def _unit(plant, law, plan, loop):
    residuals = None if plan is None else Residuals(plan.model, plant)
    return unit(plant, law, tuple(loop.disturbed.tolist()), residuals if residuals and residuals.names else None)


def _seeds(conditions, n):
    """The seed of each case's noise; None without noise."""
    if not conditions.noise:
        return None
    return [int(generator(conditions.seed, CASES, i).integers(SEEDS)) for i in range(n)]


def _columns(cases):
    """Numbers by name, (N,) each."""
    if not isinstance(cases, dict):
        rows = as_cases(cases)
        cases = {name: [row[name] for row in rows] for name in rows[0]}
    try:
        columns = {name: np.array(values, dtype=float) for name, values in cases.items()}
    except (TypeError, ValueError):
        columns = {}
    sizes = {values.shape for values in columns.values()}
    one = len(sizes) == 1 and all(len(shape) == 1 and shape[0] for shape in sizes)
    if not one or not all(np.isfinite(v).all() for v in columns.values()):
        raise SpecificationError(
            f"The cases {', '.join(map(str, cases)) or '(none)'} are no columns of finite numbers of one length.",
            "A batch has one finite number per case in each column.",
            nearest='{"m_load": np.linspace(90.0, 110.0, 1000)}.',
            do="Give such columns, or dicts.",
        )
    return columns


def _numbers(plant, columns, loop, disturbance, scale):
    """Parameters (n_c, N), states at the start (n_x, N) and factors of the disturbances (n_d, N)."""
    for name, column in scale.items():
        if name not in disturbance:
            raise unknown(name, disturbance, "disturbance")
        if column not in columns:
            raise unknown(column, columns, "column of the cases")
    n = len(next(iter(columns.values())))
    parameters = (
        *plant.mechanism.parameters.names,
        *(f"damping {name}" for name in plant.disturbable if name in plant.damping),
    )
    found = np.repeat(plant.parameters[:, None], n, axis=1), np.repeat(loop.x0[:, None], n, axis=1)
    for name, values in columns.items():
        if name in scale.values():
            continue
        if name not in (*parameters, *plant.state_names):
            raise unknown(name, (*parameters, *plant.state_names, *scale.values()), "parameter, state or scale")
        if name in parameters:
            found[0][parameters.index(name)] = values
        else:
            found[1][plant.state_names.index(name)] = values
    factors = [columns[scale[name]] if name in scale else np.ones(n) for name in disturbance]
    return *found, np.array(factors).reshape(len(factors), n)


def _require_consistent(plant, t0, constants, starts):
    if not plant.constrained:
        return
    rest = np.zeros((len(plant.inputs) + len(plant.disturbable), starts.shape[1]))
    values = np.abs(plant.function("constraints").grid(t0, starts, np.vstack([constants, rest])))
    values = values / np.maximum(1.0, np.abs(starts).max(axis=0))
    row, case = np.unravel_index(int(np.argmax(values)), values.shape)
    if values[row, case] > CONSISTENT:
        raise InconsistentStart(
            f"{plant.constraint_names()[row]} is {values[row, case]:.3g} at the start of case {case}.",
            "Nature keeps material constraints and their rates at zero.",
            do="Give each case a start that satisfies them.",
            case=int(case),
        )


def _most_steps(plant, law, loop, constants, starts):
    """Integration steps per sample of the case with the fastest eigenvalue at the start."""
    n_x, n = starts.shape
    inputs = np.repeat(loop.idle[:, None], n, axis=1)
    p = np.vstack([constants, inputs, np.zeros((len(plant.disturbable), n))])
    both = plant.function("jacobian").grid(loop.t0, starts, p).reshape(-1, n_x, n).transpose(2, 1, 0)
    A = np.where(np.isfinite(both[:, :, :n_x]), both[:, :, :n_x], 0.0)
    case = int(np.argmax(np.abs(np.linalg.eigvals(A)).max(axis=1)))
    slowest = replace(plant, parameters=constants[:, case])
    return max(loop.substeps, steps(slowest, law.period, None, loop.t0, starts[:, case], loop.idle)[0])


def _index(name, names):
    if name not in names:
        raise unknown(name, names, "signal")
    return names.index(name)


def _traced(record, names, every):
    if isinstance(record, str) or every != 1 and not len(record):
        raise SpecificationError(
            f"record={record!r} and every={every!r} were given.",
            "Signals whose traces are kept are named one by one; without any there is none to thin out.",
            nearest='record=["theta"], every=10.',
            do="Name them.",
        )
    return [_index(name, names) for name in record], whole("every", every, least=1)


def _one_by_one(plant, law, plan, derived, loop, numbers, conditions, seeds, traced, every):
    """The same by `close`, where there is no compiler."""
    constants, starts, factors = numbers
    n, size = starts.shape[1], len(derived.names)
    lost = np.full((2, n), np.inf)
    found = np.full((3, size, n), np.nan)
    trace = np.full((loop.samples // every + 1 if traced else 0, len(traced), n), np.nan)
    span_ = (loop.t0, loop.t0 + loop.samples * loop.period)
    for i in range(n):
        forces = {
            name: _scaled(f, factor)
            for (name, f), factor in zip(conditions.disturbance.items(), factors[:, i], strict=True)
        }
        own = {"noise": conditions.noise, "seed": seeds[i]} if seeds else {}
        try:
            run = close(
                replace(plant, parameters=constants[:, i]), law, starts[:, i], span_, delay=loop.delay, **own,
                quantisation=conditions.quantisation, disturbance=forces, substeps=loop.substeps, plan=plan,
            )  # fmt: skip
        except ServoError as error:
            if error.run is None:
                raise
            lost[0 if isinstance(error, IntegrationStopped) else 1, i] = error.details["t"]
            continue
        residuals = [run.residual[name][0] for name in (derived.residuals.names if derived.residuals else ())]
        values = np.vstack([run.states, run.inputs, *residuals])
        found[:, :, i] = np.abs(values).max(axis=1), np.sqrt(np.mean(values**2, axis=1)), values[:, -1]
        trace[:, :, i] = values[traced, ::every].T if traced else 0.0
    return Gathered(*lost, *found, trace)


def _scaled(f, factor):
    return (lambda t: factor * f(t)) if callable(f) else factor * f


def _study(columns, seeds, names, found, meta):
    """The table; results of a loop that ended early are NaN."""
    early = np.minimum(found.state_lost, found.law_lost)
    ended = np.isfinite(early)
    of_law = found.law_lost < found.state_lost
    results = {}
    for i, name in enumerate(names):
        results |= {f"max |{name}|": found.largest[i], f"rms {name}": found.rms[i], f"final {name}": found.last[i]}
    results = {name: np.where(ended, np.nan, values) for name, values in results.items()}
    errors = np.where(ended, np.where(of_law, "ServoError", "IntegrationStopped"), "")
    what = np.where(of_law, "the law's answer", "the state")
    messages = [f"{w} is not finite at t = {t:.6g} s" if e else "" for w, t, e in zip(what, early, ended, strict=True)]
    own = {"case": np.arange(len(early))} | columns | ({"seed": np.array(seeds)} if seeds else {})
    return Study("batch", own | results | {"error": errors, "message": np.array(messages)}, meta)
