"""Rank decisions at points of the constraint manifold: zero is a number, and its size is known.

Entries far below the size of the terms that made them are zero; the rest is equilibrated, so that units do not
matter, and eliminated with complete pivoting in extended precision where the platform has it. A pivot is then
zero (rounding of extended precision), or resolvable in double precision, or between: ill-conditioned.
"""

from dataclasses import dataclass

import numpy as np

ENTRY = 1e-12  # an entry below this fraction of its terms' size is zero
RESOLVED = 1e-10  # an equilibrated pivot above this can be divided by in double precision
EXTENDED = np.finfo(np.longdouble).eps < 1e-18
NOISE = 3e-17 if EXTENDED else 1e-13  # an equilibrated pivot below this is zero


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

    Returns
    -------
    scaled, row_factors, column_factors
    """
    a = np.array(matrix, dtype=np.longdouble)
    rows, columns = np.ones(a.shape[0], dtype=a.dtype), np.ones(a.shape[1], dtype=a.dtype)
    for _ in range(6):
        for axis, factors in ((1, rows), (0, columns)):
            if not a.size:
                break
            largest = np.abs(a).max(axis=axis)
            scale = 1.0 / np.sqrt(np.where(largest > 0, largest, 1.0))
            factors *= scale
            a = a * (scale[:, None] if axis else scale[None, :])
    return a, rows, columns


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
    a, _, _ = equilibrate(matrix)
    rows, columns, pivots = list(range(a.shape[0])), list(range(a.shape[1])), []
    for k in range(min(a.shape)):
        rest = np.abs(a[k:, k:])
        i, j = np.unravel_index(np.argmax(rest), rest.shape)
        if not rest[i, j] > 0:
            break
        i, j = i + k, j + k
        a[[k, i]], rows[k], rows[i] = a[[i, k]], rows[i], rows[k]
        a[:, [k, j]], columns[k], columns[j] = a[:, [j, k]], columns[j], columns[k]
        pivots.append(float(np.abs(a[k, k])))
        a[k + 1 :, k:] -= np.outer(a[k + 1 :, k] / a[k, k], a[k, k:])
        a[k + 1 :, k] = 0.0
    rank = next((k for k, p in enumerate(pivots) if p <= resolved), len(pivots))
    kept = min(pivots[:rank], default=np.inf)
    return Rank(rank, kept, max(pivots[rank:], default=0.0), tuple(rows[:rank]), tuple(columns[:rank]))


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
    return generic(decide_each(values, sizes))


def decide_each(values, sizes):
    """The rank at each point, of values (m, n, N) with sizes of the same shape: a list of Rank."""
    return [decide(clean(values[:, :, i], sizes[:, :, i])) for i in range(values.shape[2])]


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
    scaled, row_factors, column_factors = equilibrate(np.vstack([rows, target[None, :]]))
    a, b = scaled[:-1].astype(float), scaled[-1].astype(float)
    c = np.zeros(len(a))
    if len(a):
        residual = scaled[-1].copy()
        for _ in range(3):  # refined in extended precision
            step = np.linalg.lstsq(a.T, residual.astype(float), rcond=1e-11)[0]
            c = c + step
            residual = scaled[-1] - c.astype(np.longdouble) @ scaled[:-1]
    else:
        residual = scaled[-1]
    left = float(np.abs(residual).max(initial=0.0)) / max(float(np.abs(b).max(initial=0.0)), 1e-300)
    return c * (row_factors[:-1] / row_factors[-1]).astype(float), left


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
