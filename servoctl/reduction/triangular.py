"""Block triangular form of rows: blocks each of which determines coordinates from jets of those before it.

A hidden constraint that combines others is differentiated again with them, so that its size grows exponentially with
their depth. In block triangular form a row stays as it is: the jets of earlier coordinates that it holds follow from
their own rows (see `servoctl.reduction.cascade`).
"""

from dataclasses import replace

import casadi as ca
import numpy as np

from servoctl.errors import ServoError
from servoctl.jets.identity import spread, vanish
from servoctl.reduction.cascade import Block, Cascade
from servoctl.reduction.hidden import Deep, complete, in_words
from servoctl.reduction.ranks import clean, decide_each, generic
from servoctl.reduction.rows import dependence, leading, merge_uses
from servoctl.tolerances import DEPENDENT, ENTRY

SHALLOW = 3  # derivatives of a residual or a balance in rows that are one expression each
DIGITS = 10  # decimal digits of the weights of rows


def completed(q, rows, context, starts):
    """Rows with their hidden constraints, by blocks where the expression of a row would hold high derivatives.

    Takes n rows, and returns what `hidden.complete` does, followed by the cascade: None where rows have no such form,
    or no high derivatives.
    """
    try:
        return *complete(q, rows, context, starts, most=SHALLOW), None
    except Deep as deep:
        found = _by_blocks(q, rows, context, starts)
        return found or (*complete(q, rows, context, so_far=deep.so_far), None)


def _by_blocks(q, rows, context, starts):
    """What `completed` returns, with a cascade; None where the rows have no such form."""
    blocks, pivots, points = [], [], starts
    found = triangular(q, rows)
    if not all(_determines(q, block) for block in found[1:]):
        found = max(found, triangular(q, recombined(q, rows)), key=len)
    if len(found) < 2:
        return None
    for block in found:
        if not _determines(q, block):
            try:
                some, _, points, of_block = complete(q, _alone(block, blocks), context, points)
            except ServoError:  # as all rows together show
                return None
            pivots += of_block
            block = replace(block, rows=tuple(replace(row, columns=None) for row in some))
        if not _follows(q, block, blocks):
            return None
        blocks.append(block)
    if len(blocks) < 2:
        return None
    cascade = Cascade(q, tuple(blocks))
    points = _regular(q, cascade, cascade.solved(points, max(2, *(row.order for row in cascade.rows))))
    return _explicit(q, rows, cascade, points, pivots) if len(points.t) else None


def _alone(block, earlier):
    """The rows of a block, for which the jets of earlier coordinates are functions of time."""
    return [replace(row, columns=block.columns if earlier else None) for row in block.rows]


def _follows(q, block, earlier):
    """Whether jets of a block follow, from the orders of its rows on, wherever those of earlier blocks are known."""
    highest = max(row.order for other in (*earlier, block) for row in other.rows)
    return all(
        row.affine and row.order >= highest - 1 and _own_order(q, row, block.columns) <= row.order for row in block.rows
    )


def _regular(q, cascade, points):
    """The points at which each block determines its coordinates."""
    regular = np.ones(len(points.t), dtype=bool)
    for block in cascade.blocks if len(points.t) else ():
        ranks = decide_each(clean(*points.matrix(block.leading(q))))
        regular &= np.array([rank.rank == len(block.rows) and rank.clear for rank in ranks])
    return points.take(np.flatnonzero(regular))


def _explicit(q, rows, cascade, points, pivots):
    """The rows as functions of t, q, ..., γ^(order), higher jets by those of earlier blocks; see `completed`."""
    rows, cascade = list(rows), _with_uses(q, rows, cascade, points)
    motions = {order: cascade.along(points, order, order) for order in {row.order for row in cascade.rows}}
    for k, block in enumerate(cascade.blocks):
        for row, a in zip(block.rows, block.places, strict=True):
            rows[a] = _in_own_jets(q, row, motions[row.order], a) if k else row
    rank, _ = generic(decide_each(leading(q, rows, points)[0]))
    return (rows, rank, points, pivots, cascade) if rank.rank == len(rows) and rank.clear else None


def _in_own_jets(q, row, motion, place):
    """A row as a function of t, q, ..., γ^(order)."""
    gradient = row.gradient(q)
    slopes = ca.SX(gradient.sparsity(), ca.vertcat(ca.SX(0, 1), *motion.values(gradient.nonzeros())))
    return replace(row, expression=ca.cse(motion.levels[place]), slopes=ca.densify(slopes), parts=())


def _with_uses(q, rows, cascade, points):
    """The cascade, whose rows say of which rows they are combinations, and what they use."""
    blocks, known = [], {}
    for k, block in enumerate(cascade.blocks):
        of_block = []
        for a, row in enumerate(block.rows):
            jets = {m: order for (b, m), order in cascade.jets[k].items() if b == a}
            uses = [(other.uses, max(order - other.order, 0)) for m, order in jets.items() for other in blocks[m].rows]
            of_block.append(replace(row, uses=merge_uses((row.uses, 0), *uses)))
        pairs = dict(zip(block.places, of_block, strict=True))
        known |= {a: row for a, row in pairs.items() if not row.derivation}
        open_ = [a for a in block.places if k or a not in known]
        while open_:
            derivations = {a: _derivation(q, pairs[a], rows[a], known, points) for a in open_}
            now = {a for a in open_ if derivations[a]} or set(open_)
            pairs |= {a: replace(pairs[a], derivation=derivations[a] or pairs[a].derivation) for a in now if k}
            known |= {a: pairs[a] for a in now}
            open_ = [a for a in open_ if a not in now]
        blocks.append(replace(block, rows=tuple(pairs.values())))
    return replace(cascade, blocks=tuple(blocks))


def _derivation(q, row, whole, known, points):
    """The combination of the `whole` row and known rows, by place, by which a row's order is lower; "" for none."""
    others = sorted(known.items(), key=lambda pair: (pair[1].kind == "dynamics", pair[1].order, pair[0]))
    others = [other for _, other in others if other.name != row.name]
    if row.order == whole.order:
        return row.derivation
    values = [clean(*points.matrix(other.gradient(q))) for other in [*others, whole]]
    support, _ = dependence(np.concatenate(values), first=len(others))
    return in_words(row, [others[a] for a in support[:-1]], whole.order) if support else ""


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


def triangular(q, rows):
    """Rows and the quasi-velocities in them as blocks, each square, in which later ones do not occur in earlier rows.

    Empty where rows cannot be matched with quasi-velocities, and these with coordinates.
    """
    moved_by = _moved_by(q)
    contents = [_contents(q, row, moved_by) for row in rows]
    matched = _matching(contents, q.n)
    if not q.n == q.nq == len(rows) or None in matched:
        return []
    blocks, known, moved = [], set(), set()
    for component in _components([[matched[c] for c in sorted(some)] for some in contents]):
        columns = {c for c in range(q.n) if matched[c] in component}
        known |= columns
        here = [i for i in range(q.nq) if i not in moved and moved_by[i] <= known]
        moved |= set(here)
        own = tuple(_own(q, rows[a], columns) for a in sorted(component))
        blocks.append(Block(own, tuple(sorted(component)), tuple(sorted(columns)), tuple(here)))
    return blocks


def recombined(q, rows):
    """Rows of which constant combinations replace some, where these hold rates of coordinates known before alone.

    Balances of joint coordinates, or of velocities between bodies, are sums of those of single bodies.
    """
    slopes, rows, known, left = _slopes_anywhere(q, rows), list(rows), set(), list(range(len(rows)))
    while left:
        unknown, here = [c for c in range(q.n) if c not in known], slopes[left, 0]
        weights, pivots = _combinations(slopes[left][:, 1:, unknown].reshape(len(left), -1))
        values, sizes = (np.einsum("wa,acp->wcp", *pair) for pair in ((weights, here), (abs(weights), abs(here))))
        new = {c for c in unknown if np.any(np.abs(values[:, c]) > ENTRY * sizes[:, c])}
        if len(new) != len(weights) or not new:
            break
        known |= new
        some = [_combined(q, [rows[a] for a in left], w, i, known) for w, i in zip(weights, pivots, strict=True)]
        if None in some:
            break
        for i, row in zip(pivots, some, strict=True):
            rows[left[i]] = row
        left = [a for i, a in enumerate(left) if i not in pivots]
    return rows


def _slopes_anywhere(q, rows):
    """∂ψ/∂γ^(k) at random points, (rows, levels, n, N); of the level 0 ∂ψ/∂q V."""
    levels = 1 + max(row.order for row in rows)
    gradients = ca.vertcat(*(row.gradient(q, k) for row in rows for k in range(levels)))
    values = spread(gradients.nonzeros())
    numbers = np.zeros((*gradients.shape, values.shape[1]))
    numbers[tuple(gradients.sparsity().get_triplet())] = values
    return numbers.reshape(len(rows), levels, q.n, -1)[..., np.isfinite(values).all(axis=0)]


def _combinations(matrix):
    """Combinations of rows that vanish, in reduced echelon form, (r, rows), and the place of the 1 in each."""
    sizes = np.abs(matrix).max(axis=1, initial=0.0)
    scaled = matrix / np.where(sizes > 0, sizes, 1.0)[:, None]
    U, s, _ = np.linalg.svd(scaled)
    null, pivots = U[:, int((s > DEPENDENT * s.max(initial=0.0)).sum()) :].T / np.where(sizes > 0, sizes, 1.0), []
    for k in range(len(null)):
        pivots.append(int(np.argmax(np.abs(null[k]))))
        null[k] /= null[k, pivots[k]]
        others = [i for i in range(len(null)) if i != k]
        null[others] -= null[others][:, [pivots[k]]] * null[k]
    return np.round(null, DIGITS), pivots


def _combined(q, rows, weights, pivot, known):
    """Row `pivot` with others added, in which other jets than those of known quasi-velocities cancel; or None."""
    moved_by, whole = _moved_by(q), sum(float(w) * row.expression for w, row in zip(weights, rows, strict=True) if w)
    needs = {"t": lambda i: set(), "r": lambda i: set(), "q": lambda i: moved_by[i], "w": lambda i: {i}}
    places = [(s, q.where(s)) for s in ca.symvar(whole)]
    others = [s for s, place in places if place and not needs[place[0]](place[2]) <= known]
    expression = ca.substitute(whole, ca.vertcat(*others), ca.SX.zeros(len(others))) if others else whole
    if not vanish(spread([expression - whole])).all():
        return None
    uses = merge_uses(*((row.uses, 0) for w, row in zip(weights, rows, strict=True) if w))
    return replace(rows[pivot], expression=expression, uses=uses, parts=())


def _contents(q, row, moved_by):
    """The quasi-velocities whose jets, or whose coordinates, are in a row."""
    places = [q.where(s) for s in ca.symvar(row.expression)]
    each = [moved_by[i] if kind == "q" else {i} for kind, _, i in filter(None, places) if kind in "qw"]
    return set().union(*each)


def _own(q, row, columns):
    """A row of which some quasi-velocities are unknown, with its order in these."""
    order = _own_order(q, row, columns)
    if order == row.order:
        return row
    own = replace(row, order=order, parts=(), columns=tuple(sorted(columns)))
    jets = {s.element_hash() for s in own.own(q, order)} if order else set()
    affine = not any(s.element_hash() in jets for s in ca.symvar(own.gradient(q)))
    return replace(own, affine=affine, columns=None)


def _own_order(q, row, columns):
    """The highest order of the jets of some quasi-velocities in a row, 0 for none."""
    places = filter(None, map(q.where, ca.symvar(row.expression)))
    return max((order for kind, order, i in places if kind == "w" and i in columns), default=0)


def _moved_by(q):
    """For each coordinate the quasi-velocities that move it, also by way of other coordinates."""
    moved = [{j for j in range(q.n) if q.V.sparsity().has_nz(i, j)} for i in range(q.nq)]
    places = [[q.where(s) for s in ca.symvar(ca.horzcat(q.V[i, :], q.h[i]))] for i in range(q.nq)]
    others = [[place[2] for place in filter(None, some) if place[0] == "q"] for some in places]
    for _ in range(q.nq):
        moved = [some.union(*(moved[m] for m in seen)) for some, seen in zip(moved, others, strict=True)]
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
