"""Residuals of order 2 and more along a closed loop, in the middle of each sample or by differences.

Under held inputs the derivatives of an acceleration are almost zero inside samples, and pulses between them: just after
a sample an acceleration is half a sample ahead of a plan that moves, and a residual of order 3 shows nothing.
"""

import numpy as np

from servoctl.control.residuals import further_residuals, known_residuals

WINDOW = 0.1  # s of a difference quotient: noise σ of F becomes √2 σ/H in the first, √6 σ/H² in the second


def program_rows(run, accelerations):
    """Residuals of the plan's program along a loop, (levels, N) by name, in the order of the program.

    `accelerations` (n, N) are those right after the samples.
    """
    model, plant = run.plan.model, run.plant
    known, further = known_residuals(model, plant), further_residuals(model, plant)
    rows = known.levels(run.t, np.vstack([run.states, accelerations]))
    late = [name for name, k in zip(known.names, known.orders, strict=True) if k > 1 or name in known.integrated]
    if len(run.t) < 2:
        return {name: row for name, row in rows.items() if name not in known.integrated}
    if late:
        t, jets = _middles(run)
        at, along = known.levels(t, jets), known.along(run.plan, t)
        for name in late:
            row, k = at[name] - along.get(name, 0.0), known.integrated.get(name, 0)
            row = np.vstack([row, quotient(row[0], k, run.loop.period)]) if k else row
            rows[name] = np.concatenate([row, row[:, -1:]], axis=1)
    if further and len(run.t) > (inner := 2 * (max(further.orders) // 2)):
        edge = inner // 2
        at = further.levels(run.t[edge : len(run.t) - edge], _differences(run, max(further.orders), edge))
        rows |= {name: _widened(row, len(run.t)) for name, row in at.items()}
    return {name: rows[name] for name in (*model.reduction.program.names, *rows) if name in rows}


def _middles(run):
    """Instants (N - 1,), and states and accelerations (n_x + n, N - 1) there: polynomials through states and rates."""
    plant, x, h = run.plant, run.states, run.loop.period
    starts, ends, t = run.p_within(0)[:, :-1], run.p_within(2)[:, :-1], run.t[:-1] + h / 2
    ode = plant.function("ode")
    first, last = ode.grid(run.t[:-1], x[:, :-1], starts), ode.grid(run.t[1:], x[:, 1:], ends)
    middle = (x[:, :-1] + x[:, 1:]) / 2 + h / 8 * (first - last)[: len(x)]
    return t, np.vstack([middle, plant.function("accelerations").grid(t, middle, run.p_within(1)[:, :-1])])


def _differences(run, order, edge):
    """States and jets γ'' to γ^(order) at samples but some at either edge, by central differences of velocities."""
    nq, n, count = run.plant.mechanism.q.nq, run.plant.mechanism.q.n, len(run.t) - 2 * edge
    levels = [run.states]
    for k in range(1, order):
        level = np.diff(run.states[nq : nq + n], k, axis=1) / run.loop.period**k
        levels.append((level[:, 1:] + level[:, :-1]) / 2 if k % 2 else level)  # odd ones are those between samples
    cuts = [(level.shape[1] - count) // 2 for level in levels]
    return np.vstack([level[:, cut : cut + count] for level, cut in zip(levels, cuts, strict=True)])


def _widened(values, count):
    """Values (n, M) as count columns, the first and the last of them repeated on either side."""
    before = (count - values.shape[-1]) // 2
    after = count - values.shape[-1] - before
    return np.concatenate([values[..., :1].repeat(before, -1), values, values[..., -1:].repeat(after, -1)], axis=-1)


def quotient(e, k, period):
    """The k-th difference quotient of e (N,) about each instant, over windows of 0.1 s or a k-th of a shorter loop."""
    steps = max(min(round(WINDOW / period), (len(e) - 1) // k), 1)
    values = e
    for _ in range(k):
        values = (values[steps:] - values[:-steps]) / (steps * period)
    return _widened(values, len(e)) if len(values) else np.full(len(e), np.nan)
