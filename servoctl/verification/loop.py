"""Checks of a closed loop: run again, by its power balance, constraints and limits."""

from dataclasses import replace

import numpy as np
from casadi import depends_on

from servoctl.control.loop import FINISHED, run_loop
from servoctl.errors import SpecificationError
from servoctl.tolerances import ENTRY
from servoctl.verification.result import judged, largest, numbers

LOOP_LIMITS = {"loop power": 1e-3, "loop constraints": 1e-8, "loop limits": 1e-12, "loop repeated": 1e-9}  # relative
CONVERGES, EXACT = 0.7, 1e-10  # largest defect with steps half as long, relative to the other; defect that is rounding


def verify_loop(closed):
    """Repetition, power balance, material constraints and limits of a closed loop.

    The loop is run again, and all signals are compared; and once more by the same method with the work of inputs,
    disturbances and friction as one more state. The energy gained less this work is an integration error, which shrinks
    with the steps. A force that acts on the plant but is missing in the balance, or the other way round, leaves a
    defect that does not shrink.
    """
    plant, found, limits, notes = closed.plant, {}, dict(LOOP_LIMITS), []
    _require_signals(closed)
    found["loop repeated"] = _repeated(closed)
    unbalanced = plant.equations.unbalanced or _driven(closed)
    if unbalanced:
        notes.append(f"power balance: not applicable, {unbalanced}")
    elif found["loop repeated"] <= limits["loop repeated"]:
        found["loop power"], rounding = _defect(closed, 1)
        found["loop power halved"], _ = _defect(closed, 2)
        limits["loop power halved"] = max(CONVERGES * found["loop power"], EXACT, rounding)
    if plant.constrained:
        worst = max(largest(closed.residual[name]) for name in plant.constraint_names())
        found["loop constraints"] = worst / max(1.0, np.abs(closed.states).max())
    if plant.limits or plant.rate_limits:
        found["loop limits"] = _excess(closed)
    return judged(found, {name: limits[name] for name in found}, notes)


def _driven(closed):
    """Why dE/dt is not the power of the forces, where the energy depends on a disturbed parameter; "" elsewhere."""
    mechanism = closed.plant.mechanism
    p = mechanism.parameters
    names = [name for name, s in zip(p.names, p.symbols, strict=True) if depends_on(mechanism.energy, s)]
    disturbed = ", ".join(name for name in names if name in closed.conditions.disturbance)
    return f"the energy depends on {disturbed}, which is disturbed" if disturbed else ""


def _require_signals(closed):
    """Refuse signals that are not one column for each sample of the loop."""
    names = ("states", "inputs", "commands", "measurements", "controller_states", "signals")
    shapes = {name: np.shape(getattr(closed, name)) for name in names}
    t, count = numbers(closed.t, 1), np.size(closed.t)
    arrays = [numbers(getattr(closed, name), 2) for name in names]
    if t is None or not 1 <= count <= closed.loop.samples + 1 or any(a is None or a.shape[1] != count for a in arrays):
        raise SpecificationError(
            f"The closed loop has {count} times of the shape {np.shape(closed.t)}, and signals of the shapes {shapes}.",
            f"Each signal has a column for each sample, at most {closed.loop.samples + 1}.",
            do="Pass a closed loop as sv.close returns it.",
            times=np.shape(closed.t),
            **shapes,
        )


def _again(closed, finer=1):
    """The loop of the law under its conditions, with steps shorter by a whole factor."""
    loop, law = closed.loop, closed.law
    forces = closed.conditions.forces(loop.t0, loop.period / loop.substeps, loop.samples * loop.substeps, finer)
    return replace(loop, samples=len(closed.t) - 1, z0=law.state, table=law.schedule.T, **forces)


def _repeated(closed):
    """Largest difference of a signal from that of the loop when it is run again, relative to the signal's size."""
    loop, law = _again(closed), closed.law
    status, x, law_x, law_y, inputs = run_loop(closed.plant, law.begin(), loop)
    if status != FINISHED:
        return np.inf
    m, n_y, n_z = loop.n_u, len(law.measures), len(law.state)
    pairs = [
        (closed.states, x.T),
        (closed.inputs, inputs.T),
        (closed.commands, law_y[:, :m].T),
        (closed.measurements, law_x[: len(x), :n_y].T),
        (closed.controller_states, law_x[: len(x), n_y:].T),
        (closed.signals, law_y[:, m + n_z :].T),
        (closed.t[None] - loop.t0, np.arange(len(x))[None] * loop.period),
    ]
    return max(_difference(np.asarray(given), again) for given, again in pairs)


def _difference(given, again):
    """Largest difference of rows of signals (k, N), relative to the largest value of each."""
    if given.shape != again.shape:
        return np.inf
    size = np.abs(again).max(axis=1, initial=0.0, keepdims=True)
    return largest((given - again) / np.where(size > 0, size, 1.0))


def _defect(closed, finer):
    """Defect |E - E0 - W| of the power balance with steps shorter by a factor, and the rounding of energy.

    Both are relative to the range of the energy.
    """
    plant, loop = closed.plant, _again(closed, finer)
    loop = replace(loop, x0=np.append(loop.x0, 0.0))
    status, x, *_ = run_loop(plant, closed.law.begin(), loop, rates="ode_power")
    if status != FINISHED:
        return np.inf, 0.0
    states, work = x[:, :-1].T, x[:, -1]
    energy = plant.function("power").grid(closed.t, states, closed.p)[0]
    scale = max(np.ptp(energy), np.ptp(work), 1e-6 * np.abs(energy).max(), 1e-12)
    return largest((energy - energy[0] - work) / scale), ENTRY * np.abs(energy).max() / scale


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
