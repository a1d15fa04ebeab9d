"""The proof of a closed loop: its energy against the work of all forces, its constraints and its limits."""

from dataclasses import replace

import numpy as np

from servoctl.control.close import begin, disturbed
from servoctl.control.loop import FINISHED, run_loop
from servoctl.verification import Verification

HELD, WITHIN = 1e-8, 1e-12  # material constraints along a loop; limits, relative to the limit
CONVERGES, EXACT = 0.7, 1e-10  # of the defect with steps half as long, relative to the other; what is rounding
LARGEST = 1e-3  # of the balance, relative to the energy turned over


def balance(closed):
    """Check a closed loop: power balance, material constraints, limits.

    The loop is run again with the work of inputs, disturbances and friction as one more state, by the same method: the
    energy gained less this work is an error of integration, which shrinks with the steps. A force that the plant feels
    and the balance does not know, or the other way round, leaves a defect that does not.

    Parameters
    ----------
    closed : Closed

    Returns
    -------
    Verification
    """
    plant, numbers, notes = closed.plant, {}, []
    limits = {"loop power": LARGEST, "loop constraints": HELD, "loop limits": WITHIN, "loop repeated": 1e-9}
    defect, repeated = _defect(closed, 1)
    numbers["loop repeated"] = repeated
    if plant.equations.unbalanced:
        notes.append(f"power balance: not applicable, {plant.equations.unbalanced}")
    elif repeated <= limits["loop repeated"]:
        numbers["loop power"] = defect
        numbers["loop power halved"] = _defect(closed, 2)[0]
        limits["loop power halved"] = max(CONVERGES * defect, EXACT)
    if plant.constrained:
        found = [np.abs(closed.residual[name]).max() for name in plant.constraint_names()]
        numbers["loop constraints"] = float(max(found) / max(1.0, np.abs(closed.states).max()))
    if plant.limits or plant.rate_limits:
        numbers["loop limits"] = _excess(closed)
    failures = tuple(key for key, value in numbers.items() if not value <= limits[key])
    return Verification(numbers, failures, tuple(notes), limits)


def _defect(closed, finer):
    """Largest |E - E0 - W| relative to the energy turned over, of the loop with steps shorter by a whole factor.

    Returns
    -------
    defect : float
    repeated : float
        Largest difference of the states from those of the run, relative to their sizes.
    """
    plant, loop = closed.plant, closed.loop
    substeps = loop.substeps * finer
    again = replace(
        loop,
        samples=len(closed.t) - 1,
        substeps=substeps,
        x0=np.append(loop.x0, 0.0),
        disturbance=disturbed(closed.conditions.disturbance, loop.t0, loop.period / substeps, loop.samples * substeps),
        transport=None if loop.transport is None else loop.transport * finer,
    )
    begin(closed.law)
    status, x, *_ = run_loop(plant.function("ode_power"), closed.law.step, again)
    if status != FINISHED:
        return np.inf, np.inf
    states, work = x[:, :-1].T, x[:, -1]
    p = plant.p(closed._arriving, closed._disturbances)
    energy = plant.function("power").grid(closed.t, states, p)[0]
    scale = max(np.ptp(energy), np.ptp(work), 1e-6 * np.abs(energy).max(), 1e-12)
    size = np.abs(closed.states).max(axis=1, keepdims=True) + 1e-9
    return (
        float(np.abs(energy - energy[0] - work).max() / scale),
        float((np.abs(states - closed.states) / size).max()),
    )


def _excess(closed):
    """How far an input lies beyond its limits or its limits of rate, relative to these."""
    loop, worst = closed.loop, 0.0
    if loop.low is not None:
        for u, low, high in zip(closed.inputs, loop.low, loop.high, strict=True):
            size = max([abs(v) for v in (low, high) if np.isfinite(v)], default=1.0) or 1.0
            worst = max(worst, (u.max() - high) / size, (low - u.min()) / size)
    if loop.change is not None:
        steps = np.abs(np.diff(np.column_stack([loop.idle, closed.inputs]), axis=1)).max(axis=1)
        sizes = np.abs(closed.inputs).max(axis=1) + loop.change
        worst = max(
            [
                worst,
                *(float((s - c) / size) for s, c, size in zip(steps, loop.change, sizes, strict=True) if c < np.inf),
            ]
        )
    return float(worst)
