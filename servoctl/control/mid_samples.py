"""Residuals of order 2 and more along a closed loop, in the middle of each sample.

Under held inputs the derivatives of an acceleration are almost zero inside samples, and pulses between them: just after
a sample an acceleration is half a sample ahead of a plan that moves, and a residual of order 3 shows nothing.
"""

import numpy as np

from servoctl.control.residuals import as_read, known_residuals

WINDOW = 0.1  # s of a difference quotient: noise σ of F becomes √2 σ/H in the first, √6 σ/H² in the second


def program_rows(run):
    """Residuals of the plan's program along a loop, (levels, N) by name; without those for which it is too short."""
    known, powers = known_residuals(run.plan.model, run.plant), as_read(run.plan.model)[1]
    rows = known.levels(run.t, np.pad(run.states, [(0, run.plant.mechanism.q.n * (known.order - 1)), (0, 0)]), run.plan)
    late = {name: order for name, order in zip(known.names, known.orders, strict=True) if order > 1 or name in powers}
    if late:
        t, jets = _middles(run, known.order)
        at = known.levels(t, jets, run.plan)
    for name, order in late.items():
        k, edge = powers.get(name, 0), (order > 2) * (order + 1) // 2
        row = at[name][:, edge : len(t) - edge]
        row = np.vstack([row, quotient(row[0], k, run.loop.period)]) if 0 < k < row.shape[1] else row
        rows[name] = _widened(row, len(run.t))
    return {name: row for name, row in rows.items() if row.size}


def _middles(run, order):
    """Middles (N - 1,), and jets there: by polynomials, by the plant, from order 3 on by differences of velocities."""
    plant, x, h, t = run.plant, run.states, run.loop.period, run.t[:-1] + run.loop.period / 2
    nq, n, (start, middle, end) = plant.mechanism.q.nq, plant.mechanism.q.n, (run.p_within(i)[:, :-1] for i in range(3))
    ode = plant.function("ode")
    change = ode.grid(run.t[:-1], x[:, :-1], start) - ode.grid(run.t[1:], x[:, 1:], end)
    x = (x[:, :-1] + x[:, 1:]) / 2 + h / 8 * change[: len(x)]
    levels = [x, plant.function("accelerations").grid(t, x, middle)]
    for k in range(2, order):
        level = np.diff(run.states[nq : nq + n], k) / h**k
        if k % 2 == 0:  # those at samples, by the cubic through four of them
            level = (9 * (level[:, 1:-2] + level[:, 2:-1]) - level[:, :-3] - level[:, 3:]) / 16
        levels.append(_widened(level, len(t)) if level.size else np.full((n, len(t)), np.nan))
    return t, np.vstack(levels)


def _widened(values, count):
    """Values (n, M) as count columns, the first and the last of them repeated on either side."""
    before = (count - values.shape[-1]) // 2
    after = count - values.shape[-1] - before
    return np.concatenate([values[..., :1].repeat(before, -1), values, values[..., -1:].repeat(after, -1)], axis=-1)


def quotient(e, k, period):
    """The k-th difference quotient of e (N > k,) about each instant, over windows of 0.1 s, in short loops a k-th."""
    steps = max(min(round(WINDOW / period), (len(e) - 1) // k), 1)
    values = e
    for _ in range(k):
        values = (values[steps:] - values[:-steps]) / (steps * period)
    return _widened(values, len(e))
