"""What "passed" does not say: that a plan or a loop is sensible. A sentence each, the gravest first."""

from functools import partial

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.codegen.paths import arguments
from servoctl.control.lqr import COMPARED
from servoctl.control.reference import of_plan
from servoctl.markup import digits
from servoctl.methods.transient import first_transient
from servoctl.run import AGREES
from servoctl.simulation import simulated
from servoctl.spec.references import function_of

TIMES, SAMPLES = 10, 3  # of the weights, of the samples; of a loop in a time constant, and of its error in its path


def of_run(run):
    """Sentences on a run with its model, those that hold."""
    mechanism, steps, count = run.model.reduction.mechanism, run.counters.get("steps", 0), len(run.t)
    grown = {} if callable(run.verdict) else run.verdict  # known where there is something to know
    return tuple(
        filter(
            None,
            [
                first_transient(run, partial(simulated, run.model)),
                *_heavy(run, mechanism),
                *_past_limits(run, mechanism),
                grown["text"] if grown.get("verdict") == "unstable" else "",
                f"{steps:,} steps for {count:,} samples (t_eval): peaks may lie between"
                if steps > TIMES * count
                else "",
            ],
        )
    )


def of_loop(closed):
    """Sentences on a closed loop, those that hold."""
    rate = _fastest(closed.plant, closed.t, closed.states, closed.inputs)
    few = f"{digits(closed.law.rate / (rate or 1), 2)} samples of the loop in the plant's fastest time constant"
    few = few if rate * SAMPLES > closed.law.rate else ""
    return tuple(filter(None, [*_past_limits(closed, closed.plant.mechanism), _off_path(closed), few]))


def _peak(run, name, excess):
    """A signal where it exceeds most, in words, and its index there."""
    k = int(np.nanargmax(excess))
    return f"{name} is {f'{digits(float(run[name][k]), 4)} {run.unit(name)}'.rstrip()} at t = {run.t[k]:.4g} s", k


def _heavy(run, mechanism):
    """On forces above TIMES the weights at the first state and quarter turns from it, beside the inertias they move.

    Weights are those that a shift of any coordinate by 2π leaves, full turns and lengths alike; springs are not.
    """
    q, p = mechanism.q, mechanism.parameters
    scaled = [ca.densify(e / ca.sqrt(ca.diag(mechanism.mass))) for e in (mechanism.weight, *ca.horzsplit(mechanism.E))]
    state, names = ca.vertcat(*map(q.jet, range(3))), run.model.reduction.references
    f = function_of(q, names, "weights", state, ca.vertcat(*p.symbols), *scaled)
    shifts = np.hstack([part * np.pi * np.eye(q.nq) for part in (0.0, 0.5, 2.0)])
    states = np.vstack([run.jets[: q.nq, :1] + shifts, np.zeros((2 * q.n, shifts.shape[1]))])
    values = f.call(arguments(f, run.t[0], states, run.model.p))
    still, turned, whole = np.hsplit(np.nan_to_num(np.abs(values[0]), posinf=0.0), 3)
    turned = np.hstack([still, turned]).max(axis=1)
    weight = turned[np.abs(whole - still).max(axis=1) <= AGREES * turned].max(initial=0.0)
    for name, effect in zip(mechanism.actuators, values[1:], strict=False):
        sizes = np.abs(run[name]) if name in run.names else np.zeros(1)
        most = np.nanmax(sizes) * np.nan_to_num(np.abs(effect), posinf=0.0).max()
        if weight and most > TIMES * weight:
            yield f"{_peak(run, name, sizes)[0]}, {most / weight:.0f} times the weights"


def _past_limits(run, mechanism):
    """On each signal beyond a limit that the mechanism declares."""
    for name, (low, high) in mechanism.limits.items():
        values = run[name] if name in run.names else np.zeros(0)
        excess = np.maximum(values - high, low - values)
        if np.nanmax(excess, initial=0.0) > AGREES * np.ptp(values):
            told, k = _peak(run, name, excess)
            yield f"{told}, beyond its limit of {digits(high if values[k] > high else low, 4)}"


def path(run, residual):
    """How far time moves a residual at the first state of a run, and the mean rate of its swings [rad/s], 0 without."""
    q, p = run.model.reduction.mechanism.q, run.model.reduction.mechanism.parameters
    k = max(q.order(residual), 0)
    jets = np.zeros((q.nq + k * q.n, len(run.t)))
    jets[: len(run.jets)] = run.jets[: len(jets), :1]
    state, names = ca.vertcat(*map(q.jet, range(k + 1))), run.model.reduction.references
    f = compiled(function_of(q, names, "path", state, ca.vertcat(*p.symbols), ca.densify(residual)), "path")
    values = f.grid(run.t, jets, run.model.p[: f.n_p])[0]
    change, size = np.diff(values), float(np.ptp(values))
    moves = np.flatnonzero(np.abs(change) > AGREES * size)
    turns = run.t[moves[1:][np.diff(np.sign(change[moves])) != 0]]
    return size, np.pi * (len(turns) - 1) / np.ptp(turns) if len(turns) > 2 else 0.0


def _fastest(plant, t, x, u):
    """The rate of the fastest mode that swings or grows [1/s], at states (n_x, N) of a plant under inputs (m, N)."""
    some = np.unique(np.linspace(0, len(t) - 1, COMPARED).astype(int))
    A, _ = plant.linearised(t[some], x[:, some], u[:, some])
    values = np.linalg.eigvals(A[np.isfinite(A).all(axis=(1, 2))])
    return float(np.maximum(np.abs(values.imag), values.real).max(initial=0.0))


def least_rate(plan, plant):
    """The rate of a loop with SAMPLES in the fastest time constant of a plan and its path [Hz], to two digits."""
    plant, residuals = of_plan(plan, plant), plan.model.reduction.program.residuals.values()
    x, u = (np.array([plan[name] for name in names]) for names in (plant.state_names, plant.inputs))
    rate = SAMPLES * max([_fastest(plant, plan.t, x, u), *(path(plan, residual)[1] for residual in residuals)])
    digit = 10.0 ** (np.floor(np.log10(rate or 1.0)) - 1)
    return float(np.ceil(rate / digit) * digit)


def _off_path(closed):
    """On the largest error beside the size of its path, where three of it exceed that."""
    plan, said = closed.plan, {0.0: ""}
    residuals = plan.model.reduction.program.residuals if plan is not None and plan.model else {}
    for name in residuals.keys() & {*closed.residual}:
        size, rate = path(plan, residuals[name])
        off = float(np.abs(closed.residual[name][0]).max()) / (size or np.inf)
        count = f"{digits(2 * np.pi * closed.law.rate / (rate or 1), 2)} samples per period of the plan; " * bool(rate)
        said[off] = f"{count}the loop's error of {name} is {digits(off, 2)} times the path's own size"
    return said[max(said)] * bool(max(said) * SAMPLES > 1)
