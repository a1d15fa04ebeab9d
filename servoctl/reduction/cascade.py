"""Cascades: rows in block triangular form, whose blocks are solved one after the other along the motion.

The path of the last of N cars determines its motion; its balance then holds only the next car's place, that car's
balance the place of the one after it, and so on. Each block of rows determines as many coordinates from jets of those
before it. Taylor coefficients of a motion follow block by block, those of the first blocks up to the levels that later
ones contain: what one expression of all rows would repeat at every level is computed once, and the work is polynomial in
the number of blocks (block triangular forms: Pothen and Fan, ACM TOMS 16 (1990) 303-324; coefficients: see
`servoctl.methods.taylor`).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import factorial

import casadi as ca
import numpy as np

from servoctl.jets.identity import spread
from servoctl.jets.series import Motion, Series, is_zero, shifted
from servoctl.jets.tape import REAL, Tape, add, divide, multiply
from servoctl.reduction.hidden import _derivative_name, complete
from servoctl.reduction.ranks import clean, decide_each, eliminate, generic, solve_clean
from servoctl.reduction.rows import dependence, leading, merge_uses

DEEP = 4  # derivatives of a residual in a row: from these on a cascade takes fewer operations than one expression
SHALLOW = 2  # derivatives that blocks take of each other, below which no row can be as deep
NEWTON_STEPS = 100  # to the coordinates of a block
NEWTON_SOLVED = 1e-17  # relative step at which they are solved
SETTLED = 1e-15  # relative last step of points that count as solved
REPEATED = 2  # solutions of a level, in which rows are affine: the second takes away rounding


@dataclass(frozen=True)
class Block:
    """Rows, and the coordinates that they determine from jets of those of earlier blocks.

    Attributes
    ----------
    rows : tuple of Row
        A row's order is that of the highest jets of the block's own coordinates; its expression holds jets of earlier
        ones, of any order.
    places : tuple of int
        The rows' places in the reduction.
    columns : tuple of int
        Quasi-velocities of the block.
    coordinates : tuple of int
        Coordinates whose rates follow from these and earlier ones.
    """

    rows: tuple
    places: tuple
    columns: tuple
    coordinates: tuple

    def leading(self, q):
        """∂ψ/∂γ^(order) in the block's own quasi-velocities, square SX."""
        return ca.vertcat(*(row.gradient(q) for row in self.rows))[:, list(self.columns)]


@dataclass(frozen=True)
class Cascade:
    """Blocks in the order in which they are solved.

    Attributes
    ----------
    q : Coordinates
    blocks : tuple of Block
    """

    q: object
    blocks: tuple

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

    def solved(self, points, level):
        """Points whose jets up to a level satisfy the rows, with those of earlier blocks that this takes."""
        depths, q = self.depths(level), self.q
        z = np.zeros((q.nq + max(depths) * q.n, len(points.t)), dtype=REAL)
        z[: min(len(z), len(points.z))] = points.z[: len(z)]
        with np.errstate(all="ignore"):
            motion = _Numbers(self, points, z)
            for k, block in enumerate(self.blocks):
                motion.follow(block, depths[k])
        z = motion.z()
        return replace(points, z=z).take(np.flatnonzero(np.isfinite(z).all(axis=0) & motion.converged))

    def along(self, points, given, level, correct=False):
        """The motion by jets up to a given level, and Newton steps to its coordinates where it is `correct`ed first.

        Parameters
        ----------
        points : Points
            With the jets of `solved`, at which pivots are chosen.
        given : int
            The jets up to this level are symbols; 0 for coordinates alone.
        level : int
            To which jets are computed.
        correct : bool, optional
            Whether coordinates become those after a Newton step. Rows have order 0 then.

        Returns
        -------
        Expressions
        """
        motion = Expressions(self, points, given, correct)
        for block, depth in zip(self.blocks, self.depths(level), strict=True):
            motion.follow(block, depth)
        return motion


class _Series:
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

    Attributes
    ----------
    gamma, place : dict of int to list
        Coefficients k of γ (n,) and of q (nq,).
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
        rates = None if self.q.plain else _Series(self, 1, [moving[i] for i in block.coordinates])
        groups = []
        for order in sorted({row.order for row in block.rows}):
            members = [a for a, row in enumerate(block.rows) if row.order == order]
            groups.append((_Series(self, order, [block.rows[a].expression for a in members]), members))
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
        return _Series(self, 0, entries).advance()


class Expressions(_Follow):
    """A motion by symbols of its first jets.

    Attributes
    ----------
    levels : dict of int to SX
        By place of the row: ψ^(given - order), as a function of t, q, ..., γ^(given).
    newton : (nq,) SX
        The Newton step to the coordinates.
    pivots : list of SX
        Of each block's elimination.
    """

    def __init__(self, cascade, points, given, correct):
        q, level = cascade.q, max(cascade.depths(given))
        gamma = {k: [divide(s, float(factorial(k))) for s in q.gamma(k)] for k in range(1, given + 1)}
        place = {0: list(q), **({k: list(gamma[k]) for k in gamma} if q.plain else {})}
        super().__init__(cascade, gamma, place)
        self.points, self.given, self.correct, self.matrix = points, given, correct, None
        self.levels, self.newton, self.pivots = {}, [ca.SX(0)] * q.nq, []

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
        if active and level > self.given:
            yield self._solved(block, level, active)

    def _solved(self, block, level, active):
        """γ_[level] of a block (or, for the level 0, its Newton step)."""
        first = level == 0 or self.matrix is None
        if first:
            leading = block.leading(self.q)
            self.matrix = ca.SX(leading.sparsity(), ca.vertcat(ca.SX(0, 1), *self.values(leading.nonzeros())))
        right = ca.vertcat(*(ca.SX(c) for c in self.right(level, active).values()))
        numbers = clean(*self.points.matrix(block.leading(self.q)))
        solution, pivots = eliminate(self.matrix, right, numbers)
        if first and level:
            self.pivots += pivots
        return [0.0 if x.is_zero() else x for x in solution.elements()]

    def _correct(self, block, active):
        """The Newton step to the coordinates of a block."""
        V = self.q.V[list(block.coordinates), list(block.columns)]
        V = ca.SX(V.sparsity(), ca.vertcat(ca.SX(0, 1), *self.values(V.nonzeros())))
        step = V @ ca.vertcat(*map(ca.SX, self._solved(block, 0, active)))
        for i, x in zip(block.coordinates, step.elements(), strict=True):
            self.newton[i], self.place[0][i] = x, add(self.place[0][i], x)
        self.matrix = None  # which may depend on them
        for series, _ in active:
            series.repeat()


class _Numbers(_Follow):
    """Motions near points, in numbers: jets (nz, N) that change as little as the rows demand."""

    def __init__(self, cascade, points, z):
        q = cascade.q
        gamma = {k: list(z[q.nq + (k - 1) * q.n :][: q.n]) for k in range(1, 1 + (len(z) - q.nq) // q.n)}
        place = {k: list(z[: q.nq] if k == 0 else np.zeros((q.nq, z.shape[1]), dtype=REAL)) for k in range(len(gamma) + 1)}
        super().__init__(cascade, gamma, place)
        self.points, self.sizes = points, points.sizes(0)
        self.known = dict(zip((s.element_hash() for s in points.parameters), points.values, strict=True))
        self.converged = np.ones(len(points.t), dtype=bool)

    def coefficient(self, symbol, j):
        place = self.q.where(symbol)
        if place is None:
            return float(self.known[symbol.element_hash()]) if j == 0 else 0.0
        return self.points.t.astype(REAL) if place[0] == "t" and j == 0 else super().coefficient(symbol, j)

    def z(self):
        """The jets (nz, N)."""
        return np.vstack([self.place[0], *(self.gamma[k] for k in sorted(self.gamma))])

    def steps(self, block, level, active):
        """Changes of γ_[level] of a block until its rows hold; coordinates move by Newton's method."""
        if level:
            yield from (self._step(block, level, active) for _ in range(REPEATED if active else 0))
            return
        longest = np.zeros(len(self.points.t))
        for _ in range(NEWTON_STEPS if active else 0):
            longest = self._moved(block, self._step(block, level, active))
            for series, _ in active:
                series.repeat()
            if np.all(longest <= NEWTON_SOLVED):
                break
        self.converged &= longest < SETTLED

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
        return np.array([_least(matrix[:, :, p], right[:, p]) for p in range(right.shape[1])]).T


def _least(matrix, right):
    """The least solution of a regular or underdetermined system of numbers."""
    if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
        return np.full(matrix.shape[1], np.nan)
    if matrix.shape[0] == matrix.shape[1]:
        return solve_clean(matrix, right[:, None])[:, 0]
    return np.linalg.lstsq(matrix.astype(float), right.astype(float), rcond=None)[0].astype(REAL)


def completed(q, rows, context, starts):
    """Rows with their hidden constraints, by blocks where the expression of a row would hold high derivatives.

    Parameters
    ----------
    q : Coordinates
    rows : list of Row
        n rows, as for `hidden.complete`, whose results come first.
    context : Context
    starts : Points

    Returns
    -------
    rows : list of Row
    rank : Rank
    points : Points
    pivots : list of (str, SX)
    cascade : Cascade or None
        None where rows have no such form, or no high derivatives.
    """
    blocks = triangular(q, rows)
    last = max((k for k, block in enumerate(blocks) if not _determines(q, block)), default=0)
    head, tail = blocks[: last + 1], blocks[last + 1 :]
    if tail and _ahead(q, blocks, last) >= SHALLOW:
        places = sorted(a for block in head for a in block.places)
        some, _, points, pivots = complete(q, [rows[a] for a in places], context, starts)
        columns, coordinates = (sum((getattr(b, part) for b in head), ()) for part in ("columns", "coordinates"))
        found = _by_blocks(q, rows, Cascade(q, (Block(tuple(some), tuple(places), columns, coordinates), *tail)), points)
        if found is not None:
            return *found[:3], pivots, found[3]
    return *complete(q, rows, context, starts), None


def _by_blocks(q, rows, cascade, points):
    """Rows, their rank, points and the cascade; None if it is shallow, or does not determine the motion."""
    head, *tail = cascade.blocks
    rows, explicit = list(rows), {}
    for row, a in zip(head.rows, head.places, strict=True):
        rows[a] = row
    orders = [[row.order for row in block.rows] for block in cascade.blocks]
    if not all(row.affine for row in head.rows) or any(
        min(some) < max(map(max, orders[:k])) - 1 for k, some in enumerate(orders) if k
    ):
        return None
    points = cascade.solved(points, max(2, *map(max, orders)))
    regular = np.ones(len(points.t), dtype=bool)
    for block in tail:
        ranks = decide_each(clean(*points.matrix(block.leading(q)))) if len(points.t) else []
        regular &= np.array([rank.rank == len(block.rows) and rank.clear for rank in ranks], dtype=bool)
    points = points.take(np.flatnonzero(regular))
    if not len(points.t):
        return None
    cascade = replace(cascade, blocks=(head, *_told(q, cascade, rows, points)))
    if max(count for block in cascade.blocks[1:] for row in block.rows for count in row.uses.values()) < DEEP:
        return None
    for order in {row.order for block in cascade.blocks[1:] for row in block.rows}:
        motion = cascade.along(points, order, order)
        for block in cascade.blocks[1:]:
            for row, a in zip(block.rows, block.places, strict=True):
                if row.order == order:
                    explicit[a] = _explicit(q, row, motion, a)
    rows = [explicit.get(a, row) for a, row in enumerate(rows)]
    rank, _ = generic(decide_each(leading(q, rows, points)[0]))
    return (rows, rank, points, cascade) if rank.rank == len(rows) and rank.clear else None


def _explicit(q, row, motion, place):
    """A row as a function of t, q, ..., γ^(order): higher jets by those of earlier blocks."""
    gradient = row.gradient(q)
    slopes = ca.SX(gradient.sparsity(), ca.vertcat(ca.SX(0, 1), *motion.values(gradient.nonzeros())))
    return replace(row, expression=ca.cse(motion.levels[place]), slopes=ca.densify(slopes), parts=())


def _told(q, cascade, rows, points):
    """The blocks beyond the first, whose rows tell of which rows they are combinations, and what they use."""
    blocks, known = [], list(cascade.blocks[0].rows)
    for k, block in enumerate(cascade.blocks[1:], 1):
        told = []
        for a, row in enumerate(block.rows):
            jets = {m: order for (b, m), order in cascade.jets[k].items() if b == a}
            uses = [(other.uses, max(order - other.order, 0)) for m, order in jets.items() for other in [*cascade.blocks[:1], *blocks][m].rows]
            top = max([row.order, *jets.values()])
            story = _story(q, row, known, top, points) if top > row.order else ""
            told.append(replace(row, uses=merge_uses((row.uses, 0), *uses), story=story))
        blocks.append(replace(block, rows=tuple(told)))
        known += told
    return blocks


def _story(q, row, known, top, points):
    """The combination of known rows by which the highest jets of a row cancel."""
    values = [points.matrix(other.gradient(q)) for other in known] + [points.matrix(row.gradient(q, top))]
    support, _ = dependence(np.concatenate([clean(*pair) for pair in values]), first=len(known))
    names = [_derivative_name(known[a], top - known[a].order) for a in support[:-1]]
    return f"{row.name} with {', '.join(names)}" if names else row.name


def _determines(q, block):
    """Whether the leading gradients of a block's rows are independent and do not change with what they determine."""
    gradient = block.leading(q)
    own = {("w", row.order, c) for row in block.rows for c in block.columns if row.order}
    if any(q.where(s) in own for s in ca.symvar(gradient)):
        return False
    values = spread(gradient.nonzeros())
    numbers = np.zeros((*gradient.shape, values.shape[1]))
    numbers[tuple(gradient.sparsity().get_triplet())] = values
    numbers = numbers[:, :, np.isfinite(values).all(axis=0)]
    return numbers.shape[2] > 0 and generic(decide_each(numbers))[0].rank == len(numbers)


def _ahead(q, blocks, last):
    """How far rows differentiate those of earlier blocks, beyond what happens up to block `last`."""
    jets, ahead = Cascade(q, tuple(blocks)).jets, [0] * len(blocks)
    for k in range(last + 1, len(blocks)):
        for (_, m), order in jets[k].items():
            lowest = min(row.order for row in blocks[m].rows) if m > last else 0
            ahead[k] = max(ahead[k], ahead[m] + order - lowest)
    return max(ahead)


def triangular(q, rows):
    """Rows and the quasi-velocities in them as blocks, each square, in which later ones do not occur in earlier rows.

    Parameters
    ----------
    q : Coordinates
    rows : list of Row

    Returns
    -------
    list of Block
        Empty where rows cannot be matched with quasi-velocities.
    """
    of_place = _rates(q)
    contents = []
    for row in rows:
        places = [q.where(s) for s in ca.symvar(row.expression)]
        contents.append({c for kind, _, i in filter(None, places) if kind != "t" for c in (of_place[i] if kind == "q" else [i])})
    matched = _matching(contents, q.n)
    if len(rows) != q.n or None in matched:
        return []
    components = _components([[matched[c] for c in sorted(some)] for some in contents])
    blocks, known, moved = [], set(), set()
    for component in components:
        columns = {c for c in range(q.n) if matched[c] in component}
        known |= columns
        here = [i for i in range(q.nq) if i not in moved and of_place[i] <= known]
        moved |= set(here)
        own = tuple(replace(rows[a], order=_own_order(q, rows[a], columns), parts=()) for a in sorted(component))
        blocks.append(Block(own, tuple(sorted(component)), tuple(sorted(columns)), tuple(here)))
    return blocks


def _own_order(q, row, columns):
    """The highest order of the jets of some quasi-velocities in a row, 0 for none."""
    places = filter(None, map(q.where, ca.symvar(row.expression)))
    return max((order for kind, order, i in places if kind == "w" and i in columns), default=0)


def _rates(q):
    """For each coordinate the quasi-velocities that move it, also by way of other coordinates."""
    moved = [{j for j in range(q.n) if q.V.sparsity().has_nz(i, j)} for i in range(q.nq)]
    seen = [{q.where(s)[2] for s in ca.symvar(ca.vertcat(ca.vec(q.V[i, :]), q.h[i])) if (q.where(s) or ("",))[0] == "q"} for i in range(q.nq)]
    for _ in range(q.nq):
        moved = [some.union(*(moved[m] for m in seen[i])) for i, some in enumerate(moved)]
    return moved


def _matching(contents, count):
    """For each of `count` columns the row that is matched with it, None for none; `contents` are columns by row."""
    matched = [None] * count

    def place(a, tried):
        for c in sorted(contents[a] - tried):
            tried.add(c)
            if matched[c] is None or place(matched[c], tried):
                matched[c] = a
                return True
        return False

    for a in range(len(contents)):
        place(a, set())
    return matched


def _components(successors):
    """Strongly connected components of a graph, each after those to which it leads (Tarjan)."""
    index, low, stack, result = {}, {}, [], []

    def visit(a):
        index[a] = low[a] = len(index)
        stack.append(a)
        for b in successors[a]:
            if b not in index:
                visit(b)
                low[a] = min(low[a], low[b])
            elif b in stack:
                low[a] = min(low[a], index[b])
        if low[a] == index[a]:
            component = set()
            while a not in component:
                component.add(stack.pop())
            result.append(component)

    for a in range(len(successors)):
        if a not in index:
            visit(a)
    return result
