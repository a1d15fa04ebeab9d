"""Sparse symbolic elimination with pivots chosen numerically.

A system A X = B of SX expressions is eliminated with static pivots: at given points the pivot with the least
fill-in (Markowitz) among those of sufficient size is taken. Entries that vanish at every point are left out,
so the operations follow the numerical structure. Every pivot is returned: its size along a motion tells when
the choice has become bad.
"""

import casadi as ca
import numpy as np

from servoctl.errors import SingularProgram
from servoctl.jets.elementary import divide, multiply, subtract
from servoctl.reduction.ranks import equilibrate
from servoctl.tolerances import ENTRY

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
    n, m = right.shape
    system = _System(matrix, right, numbers)
    order = [system.step() for _ in range(n)]
    solution, rows, rhs = [None] * n, system.rows, system.rhs
    for i, j in reversed(order):
        others = [(a, solution[c]) for c, (a, _) in rows[i].items() if c != j]
        solution[j] = [_back(rhs[i][k], [(a, x[k]) for a, x in others], rows[i][j][0]) for k in range(m)]
    pivots = [rows[i][j][0] for i, j in order]
    if m != 1:
        return ca.vertcat(*(ca.horzcat(*row) for row in solution)) if m else ca.SX(n, 0), pivots
    return ca.vertcat(*(row[0] for row in solution)), pivots


class _System:
    """Rows that are still to be eliminated, with what the choice of pivots needs to know of them.

    Attributes
    ----------
    rows : list of dict
        For each row its entries by column, an SX scalar and its numbers.
    rhs : list of lists of SX
    """

    def __init__(self, matrix, right, numbers):
        n = matrix.shape[0]
        scaled = np.moveaxis(equilibrate(np.moveaxis(numbers, 2, 0))[0], 0, 2).astype(float)
        entries = dict(zip(zip(*matrix.sparsity().get_triplet(), strict=True), matrix.nonzeros(), strict=True))
        self.rows = [{} for _ in range(n)]
        for i, j in zip(*(places.tolist() for places in np.nonzero(np.any(scaled, axis=2))), strict=True):
            self.rows[i][j] = entries[i, j], scaled[i, j]
        self.rhs = (
            [right[i, :].elements() for i in range(n)] if right.shape[1] != 1 else [[b] for b in right.elements()]
        )
        self.open = dict.fromkeys(range(n))
        self.members = [{} for _ in range(n)]  # of each column: open rows that have an entry there
        for i, row in enumerate(self.rows):
            for j in row:
                self.members[j][i] = None
        self.candidates = [self._large(row) for row in self.rows]

    @staticmethod
    def _large(row):
        """Columns whose entries may be pivots, with their sizes."""
        if not row:
            return []
        sizes = np.abs([number for _, number in row.values()]).min(axis=1).tolist()
        least = THRESHOLD * max(sizes)
        return [(j, size) for j, size in zip(row, sizes, strict=True) if size >= least and size > 0.0]

    def step(self):
        """Eliminate by the pivot with the least fill-in, and return its row and column."""
        i, j = self._pivot()
        row = self.rows[i]
        del self.open[i]
        for c in row:
            del self.members[c][i]
        for r in self.members[j]:
            self._subtract(r, row, self.rhs[i], j)
            self.candidates[r] = self._large(self.rows[r])
        self.members[j] = {}
        return i, j

    def _pivot(self):
        least, place = None, None
        for i in self.open:
            fill = len(self.rows[i]) - 1
            for j, size in self.candidates[i]:
                key = (fill * (len(self.members[j]) - 1), -size)
                if least is None or key < least:
                    least, place = key, (i, j)
        if place is None:
            raise SingularProgram(
                "A system of equations is singular at the points where its pivots are chosen.",
                "Pivots are chosen where the equations have full rank.",
                do="Give derive a guess near the motion.",
            )
        return place

    def _subtract(self, r, pivot_row, pivot_right, j):
        row, right, (pivot, number) = self.rows[r], self.rhs[r], pivot_row[j]
        entry, entry_number = row.pop(j)
        factor, factor_number = divide(entry, pivot), entry_number / number
        for c, (a, a_number) in pivot_row.items():
            if c == j:
                continue
            old, old_number = row.get(c, (_ZERO, 0.0))
            change = factor_number * a_number
            new = old_number - change
            if (np.abs(new) <= ENTRY * (np.abs(old_number) + np.abs(change))).all():
                if row.pop(c, None) is not None:
                    del self.members[c][r]
            else:
                row[c] = (subtract(old, multiply(factor, a)), new)
                self.members[c][r] = None
        for k, b in enumerate(pivot_right):
            if not b.is_zero():
                right[k] = subtract(right[k], multiply(factor, b))


_ZERO = ca.SX(0)


def _back(value, terms, pivot):
    for a, x in terms:
        if not x.is_zero():
            value = subtract(value, multiply(a, x))
    return value if value.is_zero() else divide(value, pivot)
