"""Checks of a run against the full mechanism, and of a closed loop against its power balance."""

from dataclasses import dataclass, field, replace

import numpy as np

from servoctl.checks import whole
from servoctl.control.loop import FINISHED, run_loop
from servoctl.control.result import Closed
from servoctl.model.equations import residual_rows
from servoctl.model.model import Model
from servoctl.run import Run, require_model

LIMITS = {
    "acceleration": 1e-9,
    "segments": 1e-6,  # adaptive integration at 1e-11 of a motion that is interpolated between samples
    "power": 1e-8,
    "energy": 1e-5,  # power integrated over samples by splines
    "multiplier form": 1e-9,
    "residual": 1e-6,
}
INTEGRATED = 1e-6  # limit for numbers that drift disturbs: γ'' is integrated itself, or rows are hidden
LOOP_LIMITS = {"loop power": 1e-3, "loop constraints": 1e-8, "loop limits": 1e-12, "loop repeated": 1e-9}  # relative
CONVERGES, EXACT = 0.7, 1e-10  # largest defect with steps half as long, relative to the other; defect that is rounding
WORDS = {
    "acceleration": "accelerations of the full mechanism under the actuation",
    "segments": "states after restarted segments of the full mechanism",
    "power": "power balance dE/dt = sum of force times velocity",
    "energy": "energy against the integrated power",
    "multiplier form": "(3.18) against the form with multipliers",
    "outside": "part of the ideal reaction outside the actuators' reach",
    "loop power": "energy gained less the work of all forces",
    "loop power halved": "the same with steps half as long",
    "loop constraints": "material constraints, values and rates",
    "loop limits": "inputs beyond their limits",
    "loop repeated": "states of the loop when it is run again",
}


@dataclass(frozen=True)
class Verification:
    """Errors of a run against the full mechanism, all of them relative.

    Attributes
    ----------
    numbers : dict of str to float
        "acceleration": largest error of γ'' of the mechanism under the actuation at any sample, relative to the
        largest γ'' of the run;
        "segments": largest error of the state after restarted segments;
        "power": largest error of dE/dt = Σ force·velocity; "energy": of its integral over the samples;
        "multiplier form": largest disagreement of (3.18) with the form that has multipliers;
        "outside": part of an ideal reaction that the mechanism's actuators cannot exert;
        "residual NAME": largest residual at any level, relative to 1 plus the largest jet of the level's order.
    failures : tuple of str
        Names of numbers that exceed their limits.
    notes : tuple of str
        Checks that do not apply, and why.
    limits : dict of str to float
        Largest value of each number that passes.
    """

    numbers: dict
    failures: tuple = ()
    notes: tuple = ()
    limits: dict = field(default_factory=dict)

    @property
    def passed(self):
        """Whether every number is within its limit."""
        return not self.failures

    def __repr__(self):
        residuals = {k: v for k, v in self.numbers.items() if k.startswith("residual ")}
        worst = max(residuals, key=residuals.get, default=None)
        lines = [f"Verification: {'passed' if self.passed else 'FAILED: ' + ', '.join(self.failures)}"]
        lines += [f"  {WORDS[key]}: {self._number(key)}" for key in WORDS if key in self.numbers]
        if worst:
            name = worst.removeprefix("residual ")
            lines.append(f"  largest residual at any level: {self._number(worst)} ({name})")
        lines += [f"  {note}" for note in self.notes]
        return "\n".join(lines[:12])

    def _number(self, key):
        allowed = f" (allowed {self.limits[key]:.2g})" if key in self.failures and key in self.limits else ""
        return f"{self.numbers[key]:.1e}{allowed}"


def verify(model: Model | Closed, run: Run | None = None, segments: int = 20) -> Verification:
    """Check a run against the full mechanism, not the reduced model.

    The mechanism's accelerations under the required actuation are compared with the run's at every sample. The
    mechanism is integrated in segments restarted from the run, no longer than the fastest unstable time constant.
    Residuals are evaluated at every level, dE/dt is compared with the power of all forces, and (3.18) with the form
    that has multipliers.

    A closed loop is verified by `verify(closed)`: its energy against the work of inputs, disturbances and friction,
    with two lengths of step; material constraints; limits.

    Parameters
    ----------
    model : Model or Closed
    run : Run
        Of this model; omitted for a closed loop.
    segments : int
        Number of restarted segments, at least 1.

    Returns
    -------
    Verification

    Raises
    ------
    SpecificationError
        If the run is not of this model, or segments is not a whole number of at least 1.
    """
    segments = whole("segments", segments, least=1)
    if run is None and isinstance(model, Closed):
        return _verify_loop(model)
    require_model(model, run, "verify")
    good = np.flatnonzero(np.all(np.isfinite(run.jets), axis=0))
    limits, notes = dict(LIMITS), []
    if model.reduction.top > 2 or (model.reduction.hidden and not model.flat):
        limits |= dict.fromkeys(("acceleration", "power", "multiplier form"), INTEGRATED)
    inputs = run.signals("inputs")[1][:, good]
    numbers = {
        "acceleration": _acceleration(model, run, good, inputs),
        "segments": _segments(model, run, good, inputs, segments),
        **_balance(run, good, limits, notes),
        "multiplier form": _multiplier_form(model, run, good),
    }
    if model.ideal and model.actuators:
        numbers["outside"] = _outside(model, run, good)
    numbers |= {f"residual {name}": _relative_residual(run, name, good) for name in run.residual}
    if not run.success:
        notes.append("the run did not reach its end: errors grow near a singularity")
    limits = {key: limits.get("residual" if key.startswith("residual ") else key, np.inf) for key in numbers}
    return _judged(numbers, limits, notes)


def _judged(numbers, limits, notes):
    failures = tuple(key for key, value in numbers.items() if not value <= limits[key])
    return Verification(numbers, failures, tuple(notes), limits)


def _balance(run, good, limits, notes):
    """Errors of power and energy if the balance applies; adds to limits and notes."""
    rate, work, size, of_time = run.signals("power")[1][:, good]
    largest = max(np.abs(size).max(), np.abs(rate).max(), 1e-300)
    if np.abs(of_time).max() >= 1e-9 * largest:
        notes.append("power balance: not applicable, the inertia terms depend on time or on more than wᵀMw/2")
        return {}
    energy, sampling = _energy(run, good, work)
    if limits["energy"] < energy <= sampling:
        notes.append("the samples are too far apart to integrate the power more accurately")
        limits["energy"] = sampling
    return {"power": float(np.abs(rate - work).max() / largest), "energy": energy}


def _acceleration(model, run, good, inputs):
    """Largest error of the mechanism's γ'' under the inputs, relative to the largest γ'' of the run."""
    n, nq = model.n, model.nq
    states = np.vstack([run.jets[: nq + n, good], inputs])
    rates = model.function("plant").grid(run.t[good], states, model.parameters)
    acceleration = run.jets[nq + n : nq + 2 * n, good]
    return float(np.abs(rates[nq:] - acceleration).max() / max(np.abs(acceleration).max(), 1e-300))


def _energy(run, good, work):
    """Largest difference between the energy gained and the integrated power, relative to the energy's range.

    The second number is the part that the samples cannot resolve: the change if every other sample is left out.
    """
    from scipy.interpolate import CubicSpline

    order = np.argsort(run.t[good])
    t, energy, work = run.t[good][order], run["energy"][good][order], work[order]
    if len(t) < 5:
        return 0.0, np.inf
    gained = CubicSpline(t, work).antiderivative()(t)
    coarse = CubicSpline(t[::2], work[::2]).antiderivative()(t[::2])
    scale = max(np.ptp(energy), np.ptp(gained), 1e-3 * np.abs(energy).max(), 1e-12)
    error = np.abs((energy - energy[0]) - (gained - gained[0])).max() / scale
    return float(error), float(np.abs(coarse - gained[::2]).max() / scale)


def _relative_residual(run, name, good):
    """Largest residual over levels, each relative to 1 plus the largest jet of its own order at that instant."""
    model, row = run.model, residual_rows(run.model.reduction).get(name)
    worst = 0.0
    for order, level in enumerate(run.residual[name][:, good], start=row.order if row else 0):
        first = model.nq + (order - 1) * model.n if order else 0
        jets = run.jets[first : model.nq + order * model.n, good]
        worst = max(worst, float((np.abs(level) / (1.0 + np.abs(jets).max(axis=0))).max(initial=0.0)))
    return worst


def _segments(model, run, good, u, count):
    """Largest relative error of the mechanism's state after segments restarted from the run."""
    from scipy.integrate import solve_ivp

    n, nq, p, plant = model.n, model.nq, model.parameters, model.function("plant")
    t, states = run.t[good], run.jets[: nq + n, good]
    if len(t) < 3:
        return 0.0
    size = np.abs(states).max(axis=1) + 1e-3 * np.abs(states).max() + 1e-12
    worst = 0.0
    last = len(t) - (2 if run.success else 3)  # next to a singularity the actuation cannot be interpolated
    for i in np.unique(np.linspace(0, max(last, 0), count).astype(int)):
        stop = _segment_end(model, run, good, i, u[:, i])
        inputs = run.variant(good[i]).signals("inputs")[1]

        def rates(s, x, inputs=inputs):
            return plant(s, np.concatenate([x, inputs(s, run.at(s)[: inputs.n_x], p)]), p)[: nq + n]

        segment = solve_ivp(rates, (t[i], t[stop]), states[:, i], method="DOP853", rtol=1e-11, atol=1e-13 * size)
        worst = max(worst, float(np.max(np.abs(segment.y[:, -1] - states[:, stop]) / size)))
    return worst


def _segment_end(model, run, good, i, u):
    """The last of five samples within the fastest unstable time constant, one variant and one piece of the paths."""
    t = run.t[good]
    x = run.jets[: model.nq + model.n, good[i]]
    limit = 1.0 / max(_fastest_unstable(model, model.function("plant"), t[i], x, u), 1e-12)
    stop = i + 1
    while (
        stop < min(len(t) - 1, i + 5)
        and abs(t[stop + 1] - t[i]) <= limit
        and run.variant(good[stop + 1]) is run.variant(good[i])
        and not any(min(t[i], t[stop + 1]) < k < max(t[i], t[stop + 1]) for k in run.knots)
    ):
        stop += 1
    return stop


def _fastest_unstable(model, plant, t, x, u):
    """The largest real part of the mechanism's linearised open-loop eigenvalues, by central differences."""

    def rates(x):
        return plant(t, np.concatenate([x, u]), model.parameters)[: len(x)]

    steps = np.diag(1e-6 * (1.0 + np.abs(x)))
    matrix = np.array([(rates(x + step) - rates(x - step)) / (2 * step[i]) for i, step in enumerate(steps)]).T
    return float(np.linalg.eigvals(matrix).real.max()) if np.all(np.isfinite(matrix)) else np.inf


def _multiplier_form(model, run, good):
    """Largest error of (γ'', μ) in [M -B; C 0] [γ''; μ] = ..., and against its solution if that is unique.

    Hidden rows make the matrix singular; then only the residual of the equations is taken.
    """
    n, nq = model.n, model.nq
    multipliers = run.signals("all_multipliers")[1]
    accelerations = run.jets[nq + n : nq + 2 * n]
    unique, size = 0.0, np.abs(accelerations[:, good]).max()
    residuals, terms = [], []
    for first, end, variant in run.variants or ((0, len(run.t), model),):
        matrices, rights = variant.multiplier_form(run.t[first:end], run.jets[: len(model.jet_names), first:end])
        for k in good[(good >= first) & (good < end)] - first:
            unknowns = np.concatenate([accelerations[:, first + k], multipliers[:, first + k]])
            a, b = matrices[..., k], rights[:, k]
            residuals.append(np.abs(a @ unknowns - b))
            terms.append(np.abs(a) @ np.abs(unknowns) + np.abs(b))
            if not model.reduction.hidden and a.shape[0] == a.shape[1]:
                rows = np.maximum(np.abs(a).max(axis=1), 1e-300)[:, None]
                columns = np.maximum(np.abs(a / rows).max(axis=0), 1e-300)
                solution = np.linalg.solve(a / rows / columns, b / rows[:, 0]) / columns
                unique = max(unique, float(np.abs(solution[:n] - unknowns[:n]).max() / max(size, 1e-300)))
    largest = np.max(terms, axis=0)
    return max(unique, float(np.max(np.max(residuals, axis=0) / np.where(largest > 0, largest, 1.0))))


def _outside(model, run, good):
    """Largest part of the ideal reaction outside the actuators' directions, relative to the reaction."""
    values = run.signals("reach")[1][:, good]
    n, worst = model.n, 0.0
    for column in values.T:
        reaction, E = column[:n], column[n:].reshape(-1, n).T
        outside = reaction - E @ np.linalg.lstsq(E, reaction, rcond=None)[0]
        worst = max(worst, float(np.abs(outside).max()))
    return worst / max(np.abs(values[:n]).max(), 1e-300)


def _verify_loop(closed):
    """Power balance, material constraints and limits of a closed loop.

    The loop is run again by the same method with the work of inputs, disturbances and friction as one more state. The
    energy gained less this work is an integration error, which shrinks with the steps. A force that acts on the plant
    but is missing in the balance, or the other way round, leaves a defect that does not shrink.
    """
    plant, numbers, limits, notes = closed.plant, {}, dict(LOOP_LIMITS), []
    defect, numbers["loop repeated"] = _defect(closed, 1)
    if plant.equations.unbalanced:
        notes.append(f"power balance: not applicable, {plant.equations.unbalanced}")
    elif numbers["loop repeated"] <= limits["loop repeated"]:
        numbers["loop power"] = defect
        numbers["loop power halved"] = _defect(closed, 2)[0]
        limits["loop power halved"] = max(CONVERGES * defect, EXACT)
    if plant.constrained:
        largest = max(np.abs(closed.residual[name]).max() for name in plant.constraint_names())
        numbers["loop constraints"] = float(largest / max(1.0, np.abs(closed.states).max()))
    if plant.limits or plant.rate_limits:
        numbers["loop limits"] = _excess(closed)
    return _judged(numbers, limits, notes)


def _defect(closed, finer):
    """Defect of the power balance of the loop, with steps shorter by a whole factor, and difference of its states.

    The defect is the largest |E - E0 - W| relative to the range of the energy; the states are compared with those of
    the run, relative to their sizes.
    """
    plant, loop = closed.plant, closed.loop
    substeps = loop.substeps * finer
    again = replace(
        loop,
        samples=len(closed.t) - 1,
        substeps=substeps,
        x0=np.append(loop.x0, 0.0),
        disturbance=closed.conditions.forces(loop.t0, loop.period / substeps, loop.samples * substeps),
        transport=None if loop.transport is None else loop.transport * finer,
    )
    status, x, *_ = run_loop(plant.function("ode_power"), closed.law.begin(), again)
    if status != FINISHED:
        return np.inf, np.inf
    states, work = x[:, :-1].T, x[:, -1]
    energy = plant.function("power").grid(closed.t, states, closed.p)[0]
    scale = max(np.ptp(energy), np.ptp(work), 1e-6 * np.abs(energy).max(), 1e-12)
    size = np.abs(closed.states).max(axis=1, keepdims=True) + 1e-9
    return (
        float(np.abs(energy - energy[0] - work).max() / scale),
        float((np.abs(states - closed.states) / size).max()),
    )


def _excess(closed):
    """Largest excess of an input over its limits or its rate limits, relative to these."""
    loop, excesses = closed.loop, [0.0]
    if loop.low is not None:
        for u, low, high in zip(closed.inputs, loop.low, loop.high, strict=True):
            size = max([abs(v) for v in (low, high) if np.isfinite(v)], default=1.0) or 1.0
            excesses += [(u.max() - high) / size, (low - u.min()) / size]
    if loop.change is not None:
        limited = loop.change < np.inf
        most, inputs = loop.change[limited], closed.inputs[limited]
        changes = np.abs(np.diff(np.column_stack([loop.initial_input[limited], inputs]), axis=1)).max(axis=1)
        excesses += list((changes - most) / (np.abs(inputs).max(axis=1) + most))
    return float(max(excesses))
