"""Rank decisions at points of the constraint manifold: zero is a number, and its size is known.

Entries far below the size of the terms that made them are zero; the rest is equilibrated, so that units do not
matter, and eliminated with complete pivoting in extended precision where the platform has it. A pivot is then
zero (rounding of extended precision), or resolvable in double precision, or between: ill-conditioned.
"""

from dataclasses import dataclass

import numpy as np

from servoctl.tolerances import CUTOFF, ENTRY, NOISE, REFINEMENTS, RESOLVED, TINY

SWEEPS = 6  # of equilibration, each takes the root of what is left: entries of 1e±30 come within a factor of 3


@dataclass(frozen=True)
class Rank:
    """A rank and how clear it is.

    Attributes
    ----------
    rank : int
    kept : float
        Smallest equilibrated pivot that counts (inf if none).
    dropped : float
        Largest equilibrated pivot that does not count (0 if none).
    rows, columns : tuple of int
        The pivots' places, best first.
    """

    rank: int
    kept: float
    dropped: float
    rows: tuple
    columns: tuple

    @property
    def clear(self):
        """Whether every pivot is either zero or resolved."""
        return self.kept > RESOLVED and self.dropped <= NOISE


def clean(values, sizes):
    """Values with every entry that is rounding in the size of its terms set to zero."""
    return np.where(np.abs(values) <= ENTRY * sizes, 0.0, values)


def equilibrate(matrix):
    """Scale rows and columns so that the largest entries are near 1; zero rows and columns stay.

    Parameters
    ----------
    matrix : (..., m, n) array

    Returns
    -------
    scaled, row_factors, column_factors
        (..., m, n), (..., m) and (..., n) arrays.
    """
    a = np.array(matrix, dtype=np.longdouble)
    rows, columns = np.ones(a.shape[:-1], dtype=a.dtype), np.ones(a.shape[:-2] + a.shape[-1:], dtype=a.dtype)
    for _ in range(SWEEPS if a.size else 0):
        for axis, factors in ((-1, rows), (-2, columns)):
            largest = np.abs(a).max(axis=axis)
            scale = 1.0 / np.sqrt(np.where(largest > 0, largest, 1.0))
            factors *= scale
            a *= np.expand_dims(scale, axis)
    return a, rows, columns


def column_sizes(matrix):
    """Largest entries of the columns of a matrix (m, n, ...) whose rows are divided by their own: (n, ...) array."""
    rows = np.abs(matrix).max(axis=1, keepdims=True, initial=0.0)
    return np.abs(matrix / np.where(rows > 0, rows, 1.0)).max(axis=0, initial=0.0)


def decide(matrix, resolved=RESOLVED):
    """The rank of one matrix, by equilibration and complete pivoting.

    Parameters
    ----------
    matrix : (m, n) array, entries cleaned
    resolved : float
        Pivots above it count.

    Returns
    -------
    Rank
    """
    return decide_each(np.asarray(matrix)[:, :, None], resolved)[0]


def decide_each(matrices, resolved=RESOLVED):
    """The rank of each of N matrices (see `decide`).

    Parameters
    ----------
    matrices : (m, n, N) array
        With entries cleaned.

    Returns
    -------
    list of Rank
    """
    a, _, _ = equilibrate(np.moveaxis(matrices, 2, 0))
    count, m, n = a.shape
    each, least = np.arange(count), min(m, n)
    rows, columns = np.tile(np.arange(m), (count, 1)), np.tile(np.arange(n), (count, 1))
    pivots, open_ = np.zeros((count, least)), np.ones(count, dtype=bool)
    for k in range(least):
        rest = np.abs(a[:, k:, k:]).reshape(count, -1)
        place = rest.argmax(axis=1)
        open_ &= rest[each, place] > 0
        if not open_.any():
            break
        i, j = place // (n - k) + k, place % (n - k) + k
        for array, other in ((a, i), (rows, i), (a.swapaxes(1, 2), j), (columns, j)):
            array[each, other], array[:, k] = array[:, k].copy(), array[each, other]
        pivot = np.where(open_, a[:, k, k], 1.0)
        pivots[:, k] = np.where(open_, np.abs(pivot), 0.0)
        a[:, k + 1 :, k + 1 :] -= (a[:, k + 1 :, k] / pivot[:, None])[:, :, None] * a[:, None, k, k + 1 :]
    ranks = (pivots > resolved).astype(int).cumprod(axis=1).sum(axis=1).tolist()
    return [
        Rank(r, min(p[:r], default=np.inf), max(p[r:], default=0.0), tuple(i[:r]), tuple(j[:r]))
        for r, p, i, j in zip(ranks, pivots.tolist(), rows.tolist(), columns.tolist(), strict=True)
    ]


def decide_all(values, sizes):
    """The generic rank over several points: that of the point with the highest rank, then the clearest.

    Parameters
    ----------
    values, sizes : (m, n, N) arrays
        The matrix and the sizes of its entries at N points.

    Returns
    -------
    Rank
        `kept` is the smallest over the points of that rank, `dropped` the largest over all points.
    index : int
        The point with the largest smallest kept pivot.
    """
    return generic(decide_each(clean(values, sizes)))


def generic(ranks):
    """What `decide_all` returns, from the ranks at each point."""
    top = max(r.rank for r in ranks)
    best = max((i for i, r in enumerate(ranks) if r.rank == top), key=lambda i: ranks[i].kept)
    same = [r for r in ranks if r.rank == top]
    chosen = ranks[best]
    kept, dropped = min(r.kept for r in same), max(r.dropped for r in same)
    return Rank(top, kept, dropped, chosen.rows, chosen.columns), best


def combination(rows, target):
    """Coefficients c with c @ rows = target, and what is left over, relative to the target.

    Parameters
    ----------
    rows : (m, n) array
    target : (n,) array

    Returns
    -------
    c : (m,) array
    left : float
    """
    scaled, row_factors, _ = equilibrate(np.vstack([rows, target[None, :]]))
    c, left = refined(scaled[:-1], scaled[-1], CUTOFF)
    largest = float(np.abs(scaled[-1].astype(float)).max(initial=0.0))
    return c * (row_factors[:-1] / row_factors[-1]).astype(float), left / max(largest, TINY)


def refined(rows, target, cutoff):
    """Least squares c @ rows = target, refined in extended precision: c (m,) and the largest residual."""
    c, residual = np.zeros(len(rows)), target.copy()
    for _ in range(REFINEMENTS if len(rows) else 0):
        c = c + np.linalg.lstsq(rows.T.astype(float), residual.astype(float), rcond=cutoff)[0]
        residual = target - c.astype(np.longdouble) @ rows
    return c, float(np.abs(residual).max(initial=0.0))


def solve_clean(matrix, right):
    """Solve A X = B in extended precision, with every difference that is rounding in its terms set to zero.

    What vanishes in exact arithmetic is then zero in the solution.

    Parameters
    ----------
    matrix : (n, n) array
    right : (n, m) array

    Returns
    -------
    (n, m) array
    """
    a, row_factors, column_factors = equilibrate(matrix)
    b = np.asarray(right, dtype=np.longdouble) * row_factors[:, None]
    n = len(a)
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(a[k:, k])))
        a[[k, pivot]], b[[k, pivot]] = a[[pivot, k]], b[[pivot, k]]
        factor = a[k + 1 :, k] / a[k, k]
        a[k + 1 :, k:] = _difference(a[k + 1 :, k:], np.outer(factor, a[k, k:]))
        b[k + 1 :] = _difference(b[k + 1 :], np.outer(factor, b[k]))
    for k in reversed(range(n)):
        b[k] /= a[k, k]
        b[:k] = _difference(b[:k], np.outer(a[:k, k], b[k]))
    return b * column_factors[:, None]


def _difference(a, b):
    """a - b, zero where it is rounding."""
    result = a - b
    return np.where(np.abs(result) <= ENTRY * (np.abs(a) + np.abs(b)), 0.0, result)
