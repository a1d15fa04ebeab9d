"""What "passed" does not say: that a plan or a loop is sensible. A sentence each, the gravest first."""

from functools import partial

import casadi as ca
import numpy as np

from servoctl.control.reference import of_plan
from servoctl.markup import digits
from servoctl.methods.transient import first_transient
from servoctl.run import AGREES
from servoctl.simulation import simulated

TIMES, SAMPLES = 10, 3  # an order of magnitude, of which a reader should know; of a loop in a time constant
LOOKS = 50  # states along a motion at which its modes are asked for


def of_run(run):
    """Sentences on a run with its model, those that hold."""
    grown = dict(run.verdict) if not callable(run.verdict) else {}  # known where there is something to know
    steps, count = run.counters.get("steps", 0), len(run.t)
    between = f"{steps:,} steps for {count:,} samples: peaks may lie between them; take more samples (t_eval)"
    said = [
        first_transient(run, partial(simulated, run.model)), _heavy(run), *_beyond(run, run.model.reduction.mechanism),
        grown.get("text", "") * (grown.get("verdict") == "unstable"), between * bool(steps > TIMES * count),
    ]  # fmt: skip
    return tuple(filter(None, said))


def of_loop(closed):
    """Sentences on a closed loop, those that hold."""
    fast = fastest(closed.plant, closed.t, closed.states, closed.inputs) / closed.law.rate
    slow = f"{digits(1 / (fast or 1), 2)} samples of the loop in the fastest time constant of the plant"
    said = [*_beyond(closed, closed.plant.mechanism), _off(closed), slow * bool(fast * SAMPLES > 1)]
    return tuple(filter(None, said))


def _number(value, run, name):
    return f"{digits(float(value), 4)} {run.unit(name)}".rstrip()


def _heavy(run):
    """On a force above TIMES the weights at the first state and quarter turns from it, beside the inertias moved."""
    mechanism = run.model.reduction.mechanism
    names = [name for name in mechanism.actuators if name in run.names]
    q, p, weight = mechanism.q, mechanism.parameters, mechanism.weight
    for g in (symbol for name, symbol in zip(p.names, p.symbols, strict=True) if name == "g"):
        weight = weight - ca.substitute(weight, g, 0)  # springs are none
    if weight.is_zero() or not names:
        return ""
    parts = [ca.densify(e) for e in (weight, ca.sqrt(ca.diag(mechanism.mass)), mechanism.E)]
    f = ca.Function("weights", [q.t, ca.vertcat(*map(q.jet, range(3))), ca.vertcat(*p.symbols)], parts)
    turns = np.eye(q.nq + 2 * q.n)[:, : q.nq][:, [mechanism.units.get(name) != "m" for name in q.names]] * np.pi / 2
    states = np.append(run.jets[: q.nq, 0], np.zeros(2 * q.n))[:, None] + np.hstack([0 * turns[:, :1], turns])
    weights, inertia, E = (np.array(e) for e in f(run.t[0], states, run.model.parameters[: len(p.names)]))
    moved, least = np.array([np.nanargmax(np.abs(run[name])) for name in names]), np.finfo(float).tiny
    forces = np.array([run[name][k] for name, k in zip(names, moved, strict=True)])
    E = np.abs(E[:, [mechanism.actuators.index(name) for name in names]]) / np.maximum(inertia[:, :1], least)
    with np.errstate(all="ignore"):
        times = np.abs(forces) * E.max(axis=0) / np.nanmax(np.abs(weights) / inertia)
    a = int(np.argmax(np.nan_to_num(times, posinf=0.0)))
    told = f"{names[a]} is {_number(forces[a], run, names[a])} at t = {run.t[moved[a]]:.4g} s"
    return f"{told}, {times[a]:.0f} times the weights" * bool(TIMES < times[a] < np.inf)


def _beyond(run, mechanism):
    """On each signal beyond a limit that the mechanism declares: forces, then coordinates, then others."""
    order = [*mechanism.actuators, *mechanism.inputs, *mechanism.q.names, *mechanism.limits]
    for name in sorted(mechanism.limits.keys() & {*run.names}, key=order.index):
        (low, high), values = mechanism.limits[name], run[name]
        k = int(np.nanargmax(np.maximum(values - high, low - values)))
        limit = high if values[k] > high else low
        if abs(values[k] - np.clip(values[k], low, high)) > AGREES * max(abs(limit), np.ptp(values)):
            value, most = (_number(v, run, name) for v in (values[k], limit))
            yield f"{name} is {value} at t = {run.t[k]:.4g} s, beyond its limit of {most}"


def path(run, residual):
    """What time makes of a residual at the first state of a run: its values at the samples, (N,)."""
    model, q = run.model, run.model.reduction.mechanism.q
    orders = range(max(q.order(residual), 0) + 1)
    jets = [run[name][0] if name in run.jet_names else 0.0 for k in orders for name in q.jet_names(k)]
    symbols = ca.vertcat(*model.reduction.mechanism.parameters.symbols)
    f = ca.Function("residual", [q.t, ca.vertcat(*(q.jet(k) for k in orders)), symbols], [ca.densify(residual)])
    return np.array(f(run.t[None], np.tile(np.array(jets)[:, None], len(run.t)), model.parameters))[0]


def period(t, values):
    """The mean period of a path [s] by its turning points; infinite with fewer than three of them."""
    change = np.diff(values)
    moves = np.flatnonzero(np.abs(change) > AGREES * np.ptp(values))
    turns = t[moves[1:][np.diff(np.sign(change[moves])) != 0]]
    return 2 * np.ptp(turns) / (len(turns) - 1) if len(turns) > 2 else np.inf


def fastest(plant, t, x, u):
    """The rate of the fastest mode that swings or grows [1/s], at states (n_x, N) of a plant under inputs (m, N)."""
    some = np.unique(np.linspace(0, len(t) - 1, LOOKS).astype(int))
    A, _ = plant.linearised(t[some], x[:, some], u[:, some])
    values = np.linalg.eigvals(A[np.isfinite(A).all(axis=(1, 2))])
    return float(np.maximum(np.abs(values.imag), values.real).max(initial=0.0))


def least_rate(plan, plant):
    """The rate of a loop with SAMPLES in the fastest time constant of a plan and its path, rounded up [Hz]."""
    plant, residuals = of_plan(plan, plant), plan.model.reduction.program.residuals.values()
    x, u = (np.array([plan[name] for name in names]) for names in (plant.state_names, plant.inputs))
    rates = [fastest(plant, plan.t, x, u), *(2 * np.pi / period(plan.t, path(plan, e)) for e in residuals)]
    digit = 10.0 ** (np.floor(np.log10(SAMPLES * max(rates) or 1.0)) - 1)
    return float(np.ceil(SAMPLES * max(rates) / digit) * digit)


def _off(closed):
    """On the largest error beside the size of its path, where it is no small part of that."""
    said, plan = {0.0: ""}, closed.plan
    for name, residual in plan.model.reduction.program.residuals.items() if plan and plan.model else ():
        values = path(plan, residual) if name in closed.residual else np.zeros(1)
        off = float(np.abs(closed.residual[name][0]).max()) / np.ptp(values) if np.ptp(values) else 0.0
        count = period(plan.t, values) * closed.law.rate
        each = f"{digits(count, 2)} samples of the loop in a period of the plan; " * bool(np.isfinite(count))
        said[off] = f"{each}the error of {name} is {digits(off, 2)} times the path's own size"
    return said[max(said)] * bool(max(said) * TIMES > 1)
