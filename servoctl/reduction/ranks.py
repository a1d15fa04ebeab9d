"""Ranks at points of the constraint manifold, and symbolic elimination with pivots chosen at such points.

Entries far below the size of their terms are zero. The rest is equilibrated, so that units do not matter, and
eliminated with complete pivoting, in extended precision where the platform has it. A pivot is then zero (rounding of
extended precision), or resolved in double precision, or between these: ill-conditioned.

Symbolic elimination keeps its pivots for all later instants: it takes the pivot with the least fill-in (Markowitz)
among those of sufficient size at the points, and leaves out entries that vanish identically. It returns the pivots,
whose size along a motion shows when the choice has become bad. Then rows that are made orthogonal one after the other
solve the system without a choice, with some more operations.
"""

import casadi as ca
import numpy as np

from servoctl.errors import SingularProgram
from servoctl.jets.identity import identical_zeros
from servoctl.jets.tape import divide, multiply, subtract
from servoctl.tolerances import CUTOFF, ENTRY, NOISE, REFINEMENTS, RESOLVED, TINY
from servoctl.values import frozen

THRESHOLD = 0.1  # least size of a pivot, relative to the largest entry of its equilibrated row
LARGE, THIN = 40, 0.25  # rows and columns of a matrix, and its share of nonzero entries, for sparse elimination
SWEEPS = 6  # of equilibration; each takes the square root of the remaining factors: 1e±30 comes within a factor of 3


@frozen
class Rank:
    """A rank and how clear it is."""

    rank: int
    kept: float  # smallest equilibrated pivot that counts; inf if none does
    dropped: float  # largest equilibrated pivot that does not count; 0 if all do
    rows: tuple  # of the pivots that count, in the order of elimination
    columns: tuple  # likewise

    @property
    def clear(self):
        """Whether every pivot is either zero or resolved."""
        return self.kept > RESOLVED and self.dropped <= NOISE


def clean(values, sizes):
    """Values with zeros for all entries that are rounding errors of their terms, whose sizes are given."""
    return np.where(np.abs(values) <= ENTRY * sizes, 0.0, values)


def equilibrate(matrix):
    """Scale rows and columns so that the largest entries are near 1; zero rows and columns stay.

    Returns the scaled matrices (..., m, n) with the factors of rows (..., m) and of columns (..., n).
    """
    a = np.array(matrix, dtype=np.longdouble)
    rows, columns = np.ones(a.shape[:-1], dtype=a.dtype), np.ones(a.shape[:-2] + a.shape[-1:], dtype=a.dtype)
    if not a.any():
        return a, rows, columns
    *each, i, j = places = np.nonzero(a)
    entries = a[places]
    for _ in range(SWEEPS):
        for factors, place in ((rows, (*each, i)), (columns, (*each, j))):
            largest = np.zeros_like(factors)
            np.maximum.at(largest, place, np.abs(entries))
            scale = 1.0 / np.sqrt(np.where(largest > 0, largest, 1.0))
            factors *= scale
            entries *= scale[place]
    a[places] = entries
    return a, rows, columns


def column_sizes(matrix):
    """Largest entries (n, ...) of the columns of a matrix (m, n, ...) whose rows are scaled to largest entry 1."""
    rows = np.abs(matrix).max(axis=1, keepdims=True, initial=0.0)
    return np.abs(matrix / np.where(rows > 0, rows, 1.0)).max(axis=0, initial=0.0)


def decide(matrix, resolved=RESOLVED):
    """The rank of one matrix (m, n); see `decide_each`."""
    return decide_each(np.asarray(matrix)[:, :, None], resolved)[0]


def decide_each(matrices, resolved=RESOLVED):
    """The rank of each of N matrices (m, n, N), whose entries are cleaned, by equilibration and complete pivoting.

    Equilibrated pivots above `resolved` count.
    """
    a, _, _ = equilibrate(np.moveaxis(matrices, 2, 0))
    thin = min(a.shape[1:]) >= LARGE and np.count_nonzero(a) <= THIN * a.size
    pivots, rows, columns = map(np.array, zip(*map(_sparse_pivots, a), strict=True)) if thin else _dense_pivots(a)
    ranks = (pivots > resolved).astype(int).cumprod(axis=1).sum(axis=1).tolist()
    return [
        Rank(r, min(p[:r], default=np.inf), max(p[r:], default=0.0), tuple(i[:r]), tuple(j[:r]))
        for r, p, i, j in zip(ranks, pivots.tolist(), rows.tolist(), columns.tolist(), strict=True)
    ]


def _dense_pivots(a):
    """Sizes of the pivots (N, min(m, n)) of complete pivoting, rows (N, m) and columns (N, n) in their order.

    Eliminates the matrices a (N, m, n) in place, all at a time.
    """
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
    return pivots, rows, columns


def _sparse_pivots(a):
    """The same pivots, rows and columns of one matrix (m, n); changes the entries that are not zero alone."""
    m, n = a.shape
    rows, columns, pivots = np.arange(m), np.arange(n), np.zeros(min(m, n))
    largest = np.abs(a).max(axis=1, initial=0.0)  # of each row that is left
    for k in range(min(m, n)):
        i = k + largest[k:].argmax()
        if not largest[i] > 0:
            break
        j = k + np.abs(a[i, k:]).argmax()
        for array, other in ((a, i), (rows, i), (largest, i), (a.T, j), (columns, j)):
            array[[k, other]] = array[[other, k]]
        pivots[k] = np.abs(a[k, k])
        below, right = (k + 1 + np.flatnonzero(entries) for entries in (a[k + 1 :, k], a[k, k + 1 :]))
        a[np.ix_(below, right)] -= (a[below, k] / a[k, k])[:, None] * a[k, right]
        largest[below] = np.abs(a[below, k + 1 :]).max(axis=1, initial=0.0)
    return pivots, rows, columns


def decide_all(values, sizes):
    """The generic rank over several points, which is the highest, and the index of the clearest point that has it.

    Values and sizes are those of the entries, (m, n, N). The clearest point is that whose smallest kept pivot is
    largest; `kept` is the smallest and `dropped` the largest over all points of that rank.
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


def sizeable_columns(matrix, columns, inertia):
    """Independent columns of a matrix (b, n) at a point: the given ones, or others in the metric of the inertia (n,).

    Equilibration makes a column that is about to vanish as large as any other; with the inertia of its coordinate it is
    small.
    """
    if not len(columns) or not (inertia > 0).all():
        return columns
    scaled = (matrix / np.sqrt(inertia)).astype(float)
    scaled /= np.linalg.norm(scaled, axis=1, keepdims=True)
    others = _independent_columns(scaled, len(columns))
    given, best = (np.linalg.svd(scaled[:, some], compute_uv=False)[-1] for some in (columns, others))
    return columns if given >= THRESHOLD * best else others


def _independent_columns(matrix, count):
    """So many columns of a matrix (m, n): each the longest beside those before it (QR with column pivoting)."""
    rest, chosen = matrix.copy(), []
    for _ in range(count):
        lengths = np.linalg.norm(rest, axis=0)
        chosen.append(int(np.argmax(lengths)))
        direction = rest[:, chosen[-1]] / lengths[chosen[-1]]
        rest -= np.outer(direction, direction @ rest)
    return chosen


def combination(rows, target):
    """Coefficients c (m,) with c @ rows = target, of rows (m, n), and the residual relative to the target."""
    scaled, row_factors, _ = equilibrate(np.vstack([rows, target[None, :]]))
    c, residual = refined(scaled[:-1], scaled[-1], CUTOFF)
    largest = float(np.abs(scaled[-1].astype(float)).max(initial=0.0))
    return c * (row_factors[:-1] / row_factors[-1]).astype(float), residual / max(largest, TINY)


def refined(rows, target, cutoff):
    """Least squares c @ rows = target, refined in extended precision: c (m,) and the largest residual."""
    c, residual = np.zeros(len(rows)), target.copy()
    for _ in range(REFINEMENTS if len(rows) else 0):
        c = c + np.linalg.lstsq(rows.T.astype(float), residual.astype(float), rcond=cutoff)[0]
        residual = target - c.astype(np.longdouble) @ rows
    return c, float(np.abs(residual).max(initial=0.0))


def solve_clean(matrix, right):
    """Solve A X = B in extended precision, with zeros for all differences that are rounding errors of their terms.

    Entries that vanish in exact arithmetic are then zero in the solution (n, m).
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
    """a - b, zero where it is a rounding error."""
    result = a - b
    return np.where(np.abs(result) <= ENTRY * (np.abs(a) + np.abs(b)), 0.0, result)


def pivot_order(matrix, numbers):
    """Pivots ((row, column), ...) of a matrix (m, n) SX in their order, chosen by its numbers (m, n, N) at points."""
    n = matrix.shape[0]
    system = _System(matrix, ca.SX(n, 0), numbers)
    with np.errstate(all="ignore"):
        return tuple(system.step() for _ in range(n))


def eliminate(matrix, right, numbers, diagonal=False, order=(), in_order=False):
    """Solve A X = B symbolically: the solution (n, m) SX, and the pivots in the order of elimination.

    Pivots are chosen by `numbers` (n, n, N), A at N points cleaned of rounding, unless `order` has the row and column
    of each. If `diagonal`, they are diagonal entries, as is stable for definite matrices. If `in_order`, among pivots
    of the same fill-in the one of the first row is taken instead of the largest: chains of bodies are eliminated from
    end to end, with less fill-in later. Raises SingularProgram if A is singular at a point.
    """
    n, m = right.shape
    system = _System(matrix, right, numbers, diagonal, in_order)
    with np.errstate(all="ignore"):  # at some random points a pivot has no value
        order = [system.step(*pivot) for pivot in order or [()] * n]
    solution, rows, rhs = [None] * n, system.rows, system.rhs
    for i, j in reversed(order):
        others = [(a, solution[c]) for c, (a, _) in rows[i].items() if c != j]
        solution[j] = [_back(rhs[i][k], [(a, x[k]) for a, x in others], rows[i][j][0]) for k in range(m)]
    pivots = [rows[i][j][0] for i, j in order]
    if m != 1:
        return ca.vertcat(*(ca.horzcat(*row) for row in solution)) if m else ca.SX(n, 0), pivots
    return ca.vertcat(*(row[0] for row in solution)), pivots


def orthogonal(matrix, right, numbers):
    """Solve A X = B symbolically without a choice of pivots: the solution (n, m) SX, and the pivots.

    Each row is made orthogonal to those before it, its right side with it (modified Gram-Schmidt), after columns were
    scaled by `numbers` (n, n, N), A at N points. Pivots are the norms of what is left of the rows, the last one with
    the sign of det A: they vanish only where A is singular.
    """
    n = matrix.shape[0]
    columns = equilibrate(np.moveaxis(numbers, 2, 0))[2].astype(float)
    scale = ca.diag(ca.DM(np.exp(np.log(columns).mean(axis=0))))
    rows, units, pivots = ca.horzcat(matrix @ scale, right), [], []
    for row in ca.vertsplit(rows):
        for unit in units:
            along = ca.dot(row[:n], unit[:n])
            row = row if along.is_zero() else row - along * unit
        pivots.append(ca.norm_2(row[:n]))
        units.append(row / pivots[-1])
    solution = ca.SX(n, right.shape[1])
    for unit in reversed(units):
        solution += unit[:n].T @ (unit[n:] - unit[:n] @ solution)
    if n:
        pivots[-1] = _determinant(ca.vertcat(*units[:-1], row)[:, :n])
    return scale @ solution, pivots


def _determinant(rest):
    """The determinant of rows (n, n) SX, orthonormal but for the last one, by reflections to the axes (Householder)."""
    result = ca.SX(1)
    while rest.shape[0] > 1:
        side = ca.if_else(rest[0, 0] < 0, -1, 1)
        normal = rest[0, :]
        normal[0] += side
        rest = (rest - (rest @ normal.T) @ normal / ca.fabs(normal[0]))[1:, 1:]
        result *= side
    return result * rest


class _System:
    """A system under elimination.

    `rows` has for each row its entries by column: an SX scalar, and its equilibrated numbers at the points where pivots
    are chosen. What is zero at all of them is left out if it vanishes identically. `candidates` are the columns whose
    entries may be pivots; `open` lists the rows that were no pivot rows yet, `members` those of a column.
    """

    def __init__(self, matrix, right, numbers, diagonal=False, in_order=False):
        n, self.diagonal, self.in_order = matrix.shape[0], diagonal, in_order
        scaled = np.moveaxis(equilibrate(np.moveaxis(numbers, 2, 0))[0], 0, 2).astype(float)
        entries = list(zip(*matrix.sparsity().get_triplet(), matrix.nonzeros(), strict=True))
        doubtful = [(i, j, entry) for i, j, entry in entries if not scaled[i, j].any()]
        vanishing = identical_zeros([entry for _, _, entry in doubtful])
        zeros = {(i, j) for (i, j, _), zero in zip(doubtful, vanishing, strict=True) if zero}
        self.rows = [{} for _ in range(n)]
        for i, j, entry in entries:
            if (i, j) not in zeros:
                self.rows[i][j] = entry, scaled[i, j]
        self.rhs = (
            [right[i, :].elements() for i in range(n)] if right.shape[1] != 1 else [[b] for b in right.elements()]
        )
        self.open = dict.fromkeys(range(n))
        self.members = [{} for _ in range(matrix.shape[1])]
        for i, row in enumerate(self.rows):
            for j in row:
                self.members[j][i] = None
        self.candidates = [self._large(i) for i in range(n)]

    def _large(self, i):
        """The candidates of row i: a size is the smallest over the points."""
        row = self.rows[i]
        if self.diagonal:
            row = {i: row[i]} if i in row else {}
        if not row:
            return []
        sizes = np.abs([number for _, number in row.values()]).min(axis=1).tolist()
        least = THRESHOLD * max(sizes)
        return [(j, size) for j, size in zip(row, sizes, strict=True) if size >= least and size > 0.0]

    def step(self, *pivot):
        """Eliminate by a pivot, by default that with the least fill-in, and return its row and column.

        Among these a number is taken, if there is one: it cannot vanish, and less depends on it.
        """
        i, j = pivot or self._pivot()
        row = self.rows[i]
        del self.open[i]
        for c in row:
            del self.members[c][i]
        for r in self.members[j]:
            self._subtract(r, row, self.rhs[i], j)
            self.candidates[r] = self._large(r)
        self.members[j] = {}
        return i, j

    def _pivot(self):
        least, place = None, None
        for i in self.open:
            fill = len(self.rows[i]) - 1
            for j, size in self.candidates[i]:
                new = fill * (len(self.members[j]) - 1)
                if least is None or new <= least[0]:
                    variable = not self.rows[i][j][0].is_constant()
                    key = (new, 0, 0) if self.in_order else (new, variable, -size)
                    if least is None or key < least:
                        least, place = key, (i, j)
        if place is None:
            raise SingularProgram(
                "A system of equations is singular at the points where its pivots are chosen.",
                "Elimination needs equations of full rank.",
                do="Pass guess={...} near the motion to derive.",
                rows=list(self.open),
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
            left, numbers = subtract(old, multiply(factor, a)), _difference(old_number, factor_number * a_number)
            if not numbers.any() and identical_zeros([left])[0]:
                if row.pop(c, None) is not None:
                    del self.members[c][r]
            else:
                row[c] = left, numbers
                self.members[c][r] = None
        for k, b in enumerate(pivot_right):
            if not b.is_zero():
                right[k] = subtract(right[k], multiply(factor, b))


_ZERO = ca.SX(0)  # of entries that are left out


def _back(value, terms, pivot):
    for a, x in terms:
        if not x.is_zero():
            value = subtract(value, multiply(a, x))
    return value if value.is_zero() else divide(value, pivot)
