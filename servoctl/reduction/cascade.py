"""Cascades: rows in block triangular form, whose blocks are solved one after the other along the motion.

The path of the last of N cars determines its motion; its balance then holds only the next car's place, that car's
balance the place of the one after it, and so on. Each block of rows determines as many coordinates from jets of those
before it. Taylor coefficients of a motion follow block by block, those of the first blocks up to the levels that later
ones contain. What expressions of the rows would repeat at every level is computed once, so that the work is polynomial
in the number of blocks (block triangular forms: Pothen and Fan, ACM TOMS 16 (1990) 303-324; coefficients: see
`servoctl.methods.taylor`).
"""

from dataclasses import replace
from functools import cached_property
from math import factorial

import casadi as ca
import numpy as np

from servoctl.jets.series import Motion, Series, is_zero, shifted
from servoctl.jets.tape import REAL, Tape, add, column_of, divide, multiply
from servoctl.reduction.ranks import clean, eliminate, orthogonal, solve_clean
from servoctl.values import frozen

PLACING = 100  # Newton steps to the coordinates of a block, each of at most their size
PLACED = 1e-17  # relative step at which they are solved
NEARLY_PLACED = 1e-15  # relative last step of points that count
TWICE = 2  # least-squares solutions of a level, in which rows are affine: the second takes away rounding


@frozen
class Block:
    """Rows, and the coordinates that they determine from jets of those of earlier blocks.

    A row's order is that of the highest jets of the block's own coordinates; its expression holds jets of earlier ones,
    of any order.
    """

    rows: tuple
    places: tuple  # of the rows in the reduction
    columns: tuple  # quasi-velocities of the block
    coordinates: tuple  # those whose rates follow from these and earlier ones

    def leading(self, q):
        """∂ψ/∂γ^(order) in the block's own quasi-velocities, square SX."""
        return ca.vertcat(*(row.gradient(q) for row in self.rows))[:, list(self.columns)]


@frozen
class Cascade:
    """Blocks in the order in which they are solved."""

    q: object
    blocks: tuple
    orthogonal: bool = False  # whether blocks are solved without a choice of pivots

    @property
    def rows(self):
        """The rows of all blocks."""
        return [row for block in self.blocks for row in block.rows]

    def __repr__(self):
        return f"Cascade(blocks of {', '.join(str(len(block.rows)) for block in self.blocks)} rows)"

    @cached_property
    def _known(self):
        """The block of each quasi-velocity and of each coordinate, by (kind, index)."""
        known = {("w", c): k for k, block in enumerate(self.blocks) for c in block.columns}
        return known | {("q", c): k for k, block in enumerate(self.blocks) for c in block.coordinates}

    @cached_property
    def jets(self):
        """For each block the highest order of jets of each earlier block in each of its rows: {(row, block): order}."""
        return [self._jets(k, block) for k, block in enumerate(self.blocks)]

    def _jets(self, k, block):
        found = {}
        for a, row in enumerate(block.rows):
            for kind, order, i in filter(None, map(self.q.where, ca.symvar(row.expression))):
                m = self._known.get((kind, i), k)
                if m < k:
                    found[a, m] = max(order, found.get((a, m), 0))
        return found

    def depths(self, level):
        """The level to which jets of each block are needed, so that all follow up to a level."""
        depths = [level] * len(self.blocks)
        for k in reversed(range(len(self.blocks))):
            for (a, m), order in self.jets[k].items():
                depths[m] = max(depths[m], order + depths[k] - self.blocks[k].rows[a].order)
        return depths

    def continued(self, points, level, given=-1):
        """Jets near points that satisfy the rows up to a level; those of earlier blocks reach as far as this takes.

        Jets up to the level `given` stay as they are, by default none. Returns q and normalised Taylor coefficients
        (nz, N), as in `Points`, and whether each point is solved, (N,).
        """
        depths, q = self.depths(level), self.q
        z = np.zeros((q.nq + max(depths) * q.n, len(points.t)), dtype=REAL)
        shared = min(len(z), len(points.z))
        z[:shared] = points.z[:shared]
        with np.errstate(all="ignore"):
            motion = _Numbers(self, points, z, given)
            for block, depth in zip(self.blocks, depths, strict=True):
                motion.follow(block, depth)
        z = motion.z()
        return z, np.isfinite(z).all(axis=0) & motion.converged

    def solved(self, points, level):
        """The points that satisfy the rows up to a level, from others near them."""
        z, solved = self.continued(points, level)
        return replace(points, z=z).take(np.flatnonzero(solved))

    def along(self, points, given, level, correct=False, errors=None):
        """The motion by jets up to a given level, and Newton steps to its coordinates where it is `correct`ed first.

        Jets up to the level `given` are symbols, 0 for coordinates alone; further ones are computed up to `level`.
        Pivots are chosen at `points`, which have the jets of `solved`. With Newton steps rows have order 0. `errors` by
        place of a row is what is added to ψ^(given + 1 - order), as by error dynamics.
        """
        motion = Expressions(self, points, given, correct)
        motion.errors = errors or {}
        for block, depth in zip(self.blocks, self.depths(level), strict=True):
            motion.follow(block, depth)
        return motion


class Running:
    """Expressions along a motion, one coefficient after the other; that of index j belongs to the level j + order."""

    def __init__(self, motion, order, expressions):
        self.motion, self.order = motion, order
        self.symbols = ca.symvar(ca.vertcat(ca.SX(0, 1), *expressions))
        self.series = Series(Tape(self.symbols, expressions), [[] for _ in self.symbols])

    def advance(self):
        """The next coefficients."""
        for symbol, coefficients in zip(self.symbols, self.series.inputs, strict=True):
            coefficients.append(self.motion.coefficient(symbol, self.series.k))
        self.series.advance()
        return self.last

    def repeat(self):
        """The last coefficients by other ones of the motion."""
        j = self.series.k - 1
        self.series.replace_last({i: self.motion.coefficient(s, j) for i, s in enumerate(self.symbols)})
        return self.last

    @property
    def last(self):
        """The last coefficients."""
        return [c[-1] for c in self.series.outputs]


class _Follow(Motion):
    """A motion whose coefficients follow block by block.

    `gamma` and `place` have by k the coefficients k of γ, a list of n, and of q, a list of nq.
    """

    def __init__(self, cascade, gamma, place):
        super().__init__(cascade.q)
        self.gamma, self.place = gamma, place

    def coordinate(self, i, j):
        return self.place[j][i]

    def velocity(self, i, level, j):
        return shifted(self.gamma[level + j][i], level, j)

    def follow(self, block, depth):
        """The coefficients of a block up to a level."""
        moving = self.q.V @ self.q.jet(1) + self.q.h
        rates = None if self.q.plain else Running(self, 1, [moving[i] for i in block.coordinates])
        groups = []
        for order in sorted({row.order for row in block.rows}):
            members = [a for a, row in enumerate(block.rows) if row.order == order]
            groups.append((Running(self, order, [block.rows[a].expression for a in members]), members))
        for level in range(depth + 1):
            active = [(series, members) for series, members in groups if series.order <= level]
            self._move(block, level, rates and rates.advance)
            for series, _ in active:
                series.advance()

            for step in self.steps(block, level, active):
                for i, x in zip(block.columns, step, strict=True):
                    self.gamma[level][i] = x if is_zero(self.gamma[level][i]) else add(self.gamma[level][i], x)
                self._move(block, level, rates and rates.repeat)
                for series, _ in active:
                    series.repeat()

    def _move(self, block, level, rates):
        """Coefficients of q by those of γ: q' = V w + h."""
        if level == 0:
            return
        coefficients = rates() if rates else [self.gamma[level][i] for i in block.coordinates]
        for i, c in zip(block.coordinates, coefficients, strict=True):
            self.place[level][i] = c if is_zero(c) or not rates else divide(c, level)

    @staticmethod
    def right(level, active):
        """The right sides -(j!/level!) ψ_j of the active rows, by row."""
        pairs = {}
        for series, members in active:
            scale = -factorial(level - series.order) / factorial(level)
            pairs |= {a: 0.0 if is_zero(c) else multiply(c, scale) for a, c in zip(members, series.last, strict=True)}
        return dict(sorted(pairs.items()))

    def values(self, entries):
        """Values of SX scalars by the coefficients 0 of all jets."""
        return Running(self, 0, entries).advance()


class Expressions(_Follow):
    """A motion by symbols of its first jets.

    `levels` has by place of the row ψ^(given - order), as a function of t, q, ..., γ^(given); `newton` is the Newton
    step to the coordinates, a list of nq SX. `pivots` are those of each block's elimination.
    """

    def __init__(self, cascade, points, given, correct):
        q = cascade.q
        gamma = {k: [divide(s, float(factorial(k))) for s in q.gamma(k)] for k in range(1, given + 1)}
        place = {0: list(q), **({k: list(gamma[k]) for k in gamma} if q.plain else {})}
        super().__init__(cascade, gamma, place)
        self.points, self.given, self.correct, self.matrix, self.errors = points, given, correct, None, {}
        self.orthogonal = cascade.orthogonal
        self.levels, self.newton, self.pivots = {}, [ca.SX(0)] * q.nq, []
        self.passed_on = {cascade.blocks[m].places for jets in cascade.jets for _, m in jets}

    def jet(self, k):
        """γ^(k), or q, of this motion, SX."""
        return ca.vertcat(*(self.place[0] if k == 0 else [c * float(factorial(k)) for c in self.gamma[k]]))

    def rates(self, k):
        """q^(k), SX."""
        return ca.vertcat(*(c * float(factorial(k)) for c in self.place[k]))

    def _grow(self, level):
        for coefficients, size in ((self.gamma, self.q.n), (self.place, self.q.nq)):
            if level not in coefficients:
                coefficients[level] = [0.0] * size

    def _move(self, block, level, rates):
        self._grow(level)
        super()._move(block, level, rates)

    def steps(self, block, level, active):
        """The change of γ_[level] of a block: what its rows demand beyond the given levels."""
        if level == 0:
            self.matrix = None
        if level == self.given:
            for series, members in active:
                for a, c in zip(members, series.last, strict=True):
                    self.levels[block.places[a]] = ca.SX(c) * float(factorial(level - series.order))
        if level == 0 and self.correct:
            self._correct(block, active)
        if level > self.given and sum(len(members) for _, members in active) == len(block.rows):
            yield self._solved(block, level, active)

    def _solved(self, block, level, active):
        """γ_[level] of a block (or, for the level 0, its Newton step)."""
        first = level == 0 or self.matrix is None
        if first:
            leading = block.leading(self.q)
            self.matrix = ca.SX(leading.sparsity(), ca.vertcat(ca.SX(0, 1), *self.values(leading.nonzeros())))
        right = {a: ca.SX(c) for a, c in self.right(level, active).items()}
        for a in right if level == self.given + 1 else ():
            right[a] -= self.errors.get(block.places[a], 0.0) / factorial(level)
        right = ca.vertcat(*right.values())
        numbers = clean(*self.points.matrix(block.leading(self.q)))
        solution, pivots = (orthogonal if self.orthogonal else eliminate)(self.matrix, right, numbers)
        if first and level:
            self.pivots += pivots
        return [0.0 if x.is_zero() else x for x in solution.elements()]

    def _correct(self, block, active):
        """The Newton step to the coordinates of a block; jets that later blocks need are those after it."""
        V = self.q.V[list(block.coordinates), list(block.columns)]
        V = ca.SX(V.sparsity(), ca.vertcat(ca.SX(0, 1), *self.values(V.nonzeros())))
        step = V @ ca.vertcat(*map(ca.SX, self._solved(block, 0, active)))
        for i, x in zip(block.coordinates, step.elements(), strict=True):
            self.newton[i] = x
            if block.places in self.passed_on:
                self.place[0][i] = add(self.place[0][i], x)
        self.matrix = None  # which may depend on them
        for series, _ in active:
            series.repeat()


class _Numbers(_Follow):
    """Motions near points, in numbers: jets (nz, N) that change as little as the rows demand."""

    def __init__(self, cascade, points, z, given):
        q = cascade.q
        gamma = {k: list(z[q.nq + (k - 1) * q.n :][: q.n]) for k in range(1, 1 + (len(z) - q.nq) // q.n)}
        place = {k: list(np.zeros((q.nq, z.shape[1]), dtype=REAL)) for k in gamma}
        super().__init__(cascade, gamma, {0: list(z[: q.nq]), **place})
        self.points, self.sizes, self.given = points, points.sizes(0), given
        self.known = dict(zip((s.element_hash() for s in points.parameters), points.values, strict=True))
        self.converged = np.ones(len(points.t), dtype=bool)

    def coefficient(self, symbol, j):
        place = self.q.where(symbol)
        if place is None:
            return float(self.known[symbol.element_hash()]) if j == 0 else 0.0
        return self.points.t.astype(REAL) if place[0] == "t" and j == 0 else super().coefficient(symbol, j)

    def reference(self, i, level, j):
        """Coefficient j of r_i^(level) at the points, (N,)."""
        return shifted(self.points.instants[:, column_of(i, level + j)].astype(REAL), level, j)

    def z(self):
        """The jets (nz, N)."""
        return np.vstack([self.place[0], *(self.gamma[k] for k in sorted(self.gamma))])

    def steps(self, block, level, active):
        """Changes of γ_[level] of a block until its rows hold; coordinates move by Newton's method."""
        if level <= self.given or not active:
            return
        if level:
            square = sum(len(members) for _, members in active) == len(block.columns)
            yield from (self._step(block, level, active) for _ in range(1 if square else TWICE))
            return
        for _ in range(PLACING):
            longest = self._moved(block, self._step(block, level, active))
            for series, _ in active:
                series.repeat()
            if np.all(longest <= PLACED):
                break
        self.converged &= longest < NEARLY_PLACED

    def _moved(self, block, step):
        """Move the coordinates of a block by a step (b, N), shortened; its largest relative size (N,)."""
        V = self.q.V[list(block.coordinates), list(block.columns)]
        numbers = np.zeros((*V.shape, len(self.points.t)), dtype=REAL)
        for i, j, value in zip(*V.sparsity().get_triplet(), self.values(V.nonzeros()), strict=True):
            numbers[i, j] = value
        step = np.einsum("ijp,jp->ip", numbers, step)
        here = np.array([self.place[0][i] for i in block.coordinates])
        longest = np.max(np.abs(step) / (self.sizes[list(block.coordinates)][:, None] + np.abs(here)), axis=0)
        for i, x in zip(block.coordinates, here + step / np.maximum(1.0, longest), strict=True):
            self.place[0][i] = x
        return longest

    def _step(self, block, level, active):
        """The least steps (b, N) of γ_[level] by which the active rows vanish."""
        right = self.right(level, active)
        leading = block.leading(self.q)[list(right), :]
        matrix = np.zeros((*leading.shape, len(self.points.t)), dtype=REAL)
        for i, j, value in zip(*leading.sparsity().get_triplet(), self.values(leading.nonzeros()), strict=True):
            matrix[i, j] = value
        right = np.array([c + np.zeros(len(self.points.t), dtype=REAL) for c in right.values()])
        if matrix.shape[:2] == (1, 1):
            return right / matrix[0]
        return np.array([_nearest_solution(matrix[:, :, p], right[:, p]) for p in range(right.shape[1])]).T


def _nearest_solution(matrix, right):
    """The least solution of a regular or underdetermined system of numbers."""
    if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
        return np.full(matrix.shape[1], np.nan)
    if matrix.shape[0] == matrix.shape[1]:
        return solve_clean(matrix, right[:, None])[:, 0]
    return np.linalg.lstsq(matrix.astype(float), right.astype(float), rcond=None)[0].astype(REAL)
