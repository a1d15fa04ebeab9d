"""Sparse symbolic elimination with pivots chosen numerically.

A system A X = B of SX expressions is eliminated with static pivots: at given points the pivot with the least
fill-in (Markowitz) among those of sufficient size is taken. Entries that vanish at every point are left out,
so the operations follow the numerical structure. Every pivot is returned: its size along a motion tells when
the choice has become bad.
"""

import casadi as ca
import numpy as np

from servoctl.errors import SingularProgram
from servoctl.reduction.ranks import ENTRY, equilibrate

THRESHOLD = 0.1  # a pivot may be this much smaller than the largest candidate of its row, after equilibration


def eliminate(matrix, right, numbers):
    """Solve A X = B symbolically.

    Parameters
    ----------
    matrix : (n, n) SX
    right : (n, m) SX
    numbers : (n, n, N) array
        A at N points, cleaned of rounding.

    Returns
    -------
    solution : (n, m) SX
    pivots : list of SX scalars
        In the order of elimination.

    Raises
    ------
    SingularProgram
        If A is singular at a point.
    """
    n, m = matrix.shape[0], right.shape[1]
    scaled = np.stack([equilibrate(numbers[:, :, i])[0] for i in range(numbers.shape[2])], axis=2).astype(float)
    rows = [{j: (matrix[i, j], scaled[i, j]) for j in range(n) if np.any(scaled[i, j])} for i in range(n)]
    rhs = [[right[i, j] for j in range(m)] for i in range(n)]
    open_rows, order, pivots = set(range(n)), [], []
    for _ in range(n):
        i, j = _pivot(rows, open_rows)
        open_rows.remove(i)
        order.append((i, j))
        pivot, number = rows[i][j]
        pivots.append(pivot)
        for r in open_rows:
            if j in rows[r]:
                _subtract(rows[r], rhs[r], rows[i], rhs[i], j, pivot, number)
    solution = [None] * n
    for i, j in reversed(order):
        pivot = rows[i][j][0]
        solution[j] = [
            _back(rhs[i][k], [(a, solution[c][k]) for c, (a, _) in rows[i].items() if c != j], pivot) for k in range(m)
        ]
    return ca.vertcat(*(ca.horzcat(*row) for row in solution)) if m else ca.SX(n, 0), pivots


def _back(value, terms, pivot):
    for a, x in terms:
        if not x.is_zero():
            value = value - a * x
    return value if value.is_zero() else value / pivot


def _subtract(row, right, pivot_row, pivot_right, j, pivot, number):
    entry, entry_number = row.pop(j)
    factor, factor_number = entry / pivot, entry_number / number
    for c, (a, a_number) in pivot_row.items():
        if c == j:
            continue
        old, old_number = row.get(c, (ca.SX(0), 0.0 * a_number))
        new = old_number - factor_number * a_number
        if np.all(np.abs(new) <= ENTRY * (np.abs(old_number) + np.abs(factor_number * a_number))):
            row.pop(c, None)
        else:
            row[c] = (old - factor * a, new)
    for k, b in enumerate(pivot_right):
        if not b.is_zero():
            right[k] = right[k] - factor * b


def _pivot(rows, open_rows):
    counts = {}
    for i in open_rows:
        for j in rows[i]:
            counts[j] = counts.get(j, 0) + 1
    best, found = None, None
    for i in sorted(open_rows):
        if not rows[i]:
            continue
        sizes = {j: np.min(np.abs(v)) for j, (_, v) in rows[i].items()}
        largest = max(sizes.values())
        for j, size in sizes.items():
            if size < THRESHOLD * largest or size == 0.0:
                continue
            key = ((len(rows[i]) - 1) * (counts[j] - 1), -size)
            if best is None or key < best:
                best, found = key, (i, j)
    if found is None:
        raise SingularProgram(
            "A system of equations is singular at the points where its pivots are chosen.",
            "Pivots are chosen where the equations have full rank.",
            do="Give derive a guess near the motion.",
        )
    return found
