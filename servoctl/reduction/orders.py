"""Whether what the orders of rows rest on still vanishes, at other parameters or along a motion.

A slope that vanishes where a row is derived lowers the row's order. If it does not vanish identically, it may come
alive: a gear that is blended in at 3 s, a coupling beyond x = 2, a parameter that was zero. It then counts against the
terms of the row, times the size of the jet in which it is the slope.
"""

from dataclasses import replace
from math import factorial

import numpy as np

from servoctl.jets.series import Flow
from servoctl.reduction.manifold import ON_MANIFOLD, solve
from servoctl.tolerances import ENTRY

DRIFTED = 1e-6  # of its terms: a slope below this may be due to the drift of a motion; above it is judged on the manifold


def first_alive(reduction, t, jets, values):
    """The first sample of a motion at which the order of a row is another one.

    Parameters
    ----------
    reduction : Reduction
    t : (N,) array
        [s]
    jets : (n_z, N) array
        q, γ', ..., up to γ^(s̄) at least.
    values : (n_p,) array

    Returns
    -------
    int or None
        The index of the sample.
    str
        Name of the row; empty if there is no such sample.
    """
    names, zeros = _vanishing(reduction)
    if not names or not len(t):
        return None, ""
    q, level = reduction.mechanism.q, _level(reduction, zeros)
    size = (len(jets) - q.nq) // q.n
    factorials = np.concatenate([np.ones(q.nq), *(np.full(q.n, factorial(k)) for k in range(1, size + 1))])
    points = replace(reduction.points, t=t, z=jets / factorials[:, None], values=values, residual=np.zeros(len(t)))
    points = points if size >= level else _on_manifold(reduction, points, level)
    usual = np.maximum(_largest(points, zeros), _largest(_on_manifold(reduction, reduction.points, level), zeros))
    suspects = np.flatnonzero(_alive(points, zeros, usual, DRIFTED).any(axis=0))
    if not len(suspects):
        return None, ""
    alive = _alive(_on_manifold(reduction, points.take(suspects), level), zeros, usual, DRIFTED, ENTRY)
    confirmed = np.flatnonzero(alive.any(axis=0))
    if not len(confirmed):
        return None, ""
    return int(suspects[confirmed[0]]), names[int(np.argmax(alive[:, confirmed[0]]))]


def orders_hold(reduction, points):
    """Whether all orders of a reduction are the same at points of its manifold with other parameters."""
    names, zeros = _vanishing(reduction)
    return not names or not _alive(points, zeros, np.maximum(_largest(points, zeros), 1.0), ENTRY).any()


def _vanishing(reduction):
    """The row's name of each vanishing slope; slopes, jets and expressions."""
    each = {}
    for row in (*reduction.original.values(), *reduction.rows):
        for slope, jet, expression in row.vanishing:
            each[slope.element_hash(), jet.element_hash()] = row.name, slope, jet, expression
    names, *zeros = zip(*each.values(), strict=True) if each else ((), (), (), ())
    return names, zeros


def _level(reduction, zeros):
    """The highest jets of the rows and of what vanishes."""
    order = reduction.mechanism.q.order
    return max(reduction.top, *(order(e) for part in zeros for e in part))


def _largest(points, zeros):
    """The largest size of each jet at points, (slopes, 1)."""
    return np.nan_to_num(np.abs(points.evaluate(zeros[1])[0])).max(axis=1, keepdims=True, initial=0.0)


def _alive(points, zeros, usual, share, drift=None):
    """Whether slopes (slopes, N) exceed their rounding or drift, and with the usual jets a share of the row's terms."""
    (slopes, sizes), (_, terms) = points.evaluate(zeros[0]), points.evaluate(zeros[2])
    slopes = np.abs(slopes)
    return (slopes > (share if drift is None else drift) * sizes) & (slopes * usual > share * terms)


def _on_manifold(reduction, points, level):
    """The points of the rows' manifold nearest to points, with jets up to a level; points without such stay."""
    q = reduction.mechanism.q
    z = np.zeros((q.nq + level * q.n, len(points.t)), dtype=points.z.dtype)
    shared = min(len(z), len(points.z))
    z[:shared] = points.z[:shared]
    start = replace(points, z=z)
    solved, residual = solve(Flow(q, reduction.rows, level, start), start.t, z)
    return replace(start, z=np.where(residual < ON_MANIFOLD, solved, z))
