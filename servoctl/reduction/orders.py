"""The orders of rows, and their leading gradients, settled at points of the manifold."""

from dataclasses import replace

import casadi as ca
import numpy as np

from servoctl.reduction.elimination import eliminate
from servoctl.reduction.manifold import sample
from servoctl.reduction.ranks import clean, combination, decide, equilibrate, refined
from servoctl.reduction.row import merge_uses
from servoctl.tolerances import DEPENDENT, ENTRY

TAKES_PART = 1e-12  # coefficient times the largest entry of a row: below this the row is no part of a combination
SUPPORTS = 1e-9  # equilibrated coefficient, at any point, above which a row is part of a dependence
BASIS_CUTOFF = 1e-12  # singular values of rows found independent, against the largest


def leading(q, rows, points):
    """The cleaned leading matrix L at points, (rows, n, N), and the sizes of its entries."""
    values, sizes = points.matrix(ca.vertcat(*(row.gradient(q) for row in rows)))
    return clean(values, sizes), sizes


def settle_alone(q, rows, context):
    """Each row settled without others (see `settle`), most of them by one look at all leading gradients.

    Returns
    -------
    list of (Row, (n, N) array or None)
        With the values of its leading gradient at the points, where this look was enough.
    """
    levels = [q.order(row.expression) for row in rows]
    settled = [None] * len(rows)
    for level in set(levels) - {-1}:
        members = [a for a, order in enumerate(levels) if order == level and rows[a].order <= level]
        points = sample(q, [], level, context)
        gradients = [rows[a].gradient(q, level) for a in members]
        points.read([*(rows[a].expression for a in members), *(e for g in gradients for e in g.nonzeros())])
        values = clean(*points.matrix(ca.vertcat(*gradients)))
        for a, slopes, numbers in zip(members, gradients, values, strict=True):
            if np.any(numbers):
                affine = q.order(slopes) < level or _affine(q, rows[a].expression, level, points)
                settled[a] = replace(rows[a], order=level, affine=affine), numbers
    return [pair or (settle(q, row, [], context)[0], None) for pair, row in zip(settled, rows, strict=True)]


def settle(q, row, others, context, starts=None):
    """Find the order on which a row depends on the manifold of the others, and free it of false symbols.

    From its highest symbol downwards: jets on which the row does not depend there are set to zero; jets that
    the other rows determine are replaced by what those rows say.

    Parameters
    ----------
    q : Coordinates
    row : Row
        Its `order` is an upper bound.
    others : list of Row
    starts : Points, optional
        Where to look for points.

    Returns
    -------
    Row
        With its true order (-1 for none), or `None` if no point satisfies the others.
    points : Points
    """
    level = max([row.order, q.order(row.expression), 0, *(other.order for other in others)])
    points = sample(q, others, level, context, starts=starts)
    if not len(points.t):
        return None, points
    for j in range(q.order(row.expression), -1, -1):
        values, sizes = points.matrix(row.gradient(q, j))
        values = clean(values, sizes)[0]
        if np.any(values):
            lower = [other for other in others if other.order < j or (other.order == j and other.affine and j > 0)]
            replaced = _replace(q, row, j, values, lower, points)
            if replaced is None:
                return replace(row, order=j, affine=_affine(q, row.expression, j, points)), points
            row = replaced
        elif j > 0:
            row = _drop(q, row, q.gamma(j), points)
    if q.order(row.expression) == 0 and not np.any(clean(*points.matrix(row.gradient(q, 0)))):
        return replace(row, order=-1), points
    return replace(row, order=max(q.order(row.expression), -1)), points


def _drop(q, row, symbols, points):
    """The row with jets on which it does not depend set to zero; unchanged if its value would change."""
    expression = ca.substitute(row.expression, ca.vertcat(*symbols), ca.SX.zeros(len(symbols)))
    values, sizes = points.evaluate([expression, row.expression])
    same = np.abs(values[0] - values[1]) <= ENTRY * (sizes[0] + sizes[1])
    return replace(row, expression=expression) if np.all(same) else row


def _affine(q, expression, j, points):
    if j == 0:
        return True
    jets = q.jet(j)
    second = ca.jacobian(ca.vec(ca.jacobian(expression, jets)), jets)
    if not second.nnz():
        return True
    values, sizes = points.evaluate(second.nonzeros())
    return not np.any(clean(values, sizes))


def _replace(q, row, j, values, lower, points):
    """The row with γ^(j) replaced by what the lower rows say, or None where they do not determine it."""
    if not lower:
        return None
    numbers, _ = leading(q, lower, points)
    support = set()
    for p in range(values.shape[1]):
        c, left = combination(numbers[:, :, p], values[:, p])
        if left > DEPENDENT:
            return None
        support |= set(np.flatnonzero(np.abs(c * np.abs(numbers[:, :, p]).max(axis=1).astype(float)) > TAKES_PART))
    chosen = _independent([lower[a] for a in sorted(support)], numbers[sorted(support)])
    if not chosen or any(other.order == j and not other.affine for other, _ in chosen):
        return None
    rows, numbers = [other for other, _ in chosen], np.array([n for _, n in chosen])
    columns = sorted(decide(numbers[:, :, 0]).columns)
    jets = q.gamma(j)
    zero = ca.SX.zeros(len(jets))
    raised = ca.vertcat(*(q.derivatives([other.expression], j - other.order)[-1][0] for other in rows))
    rest = ca.substitute(raised, ca.vertcat(*jets), zero)
    matrix = ca.vertcat(*(other.gradient(q) for other in rows))[:, columns]
    solution, _ = eliminate(matrix, -rest, numbers[:, columns])
    full = ca.SX.zeros(len(jets))
    full[columns] = solution
    uses = merge_uses((row.uses, 0), *((other.uses, j - other.order) for other in rows))
    return replace(row, expression=ca.cse(ca.substitute(row.expression, ca.vertcat(*jets), full)), uses=uses)


def _independent(rows, numbers):
    """A largest independent subset of rows, with their numbers."""
    independent = []
    for row, number in zip(rows, numbers, strict=True):
        trial = [*independent, (row, number)]
        if decide(np.array([n[:, 0] for _, n in trial])).rank == len(trial):
            independent = trial
    return independent


def dependence(q, rows, numbers):
    """One dependent row and the combination of others that gives its leading gradient.

    Rows are taken in the order given; the first that depends on those before it is reported.

    Parameters
    ----------
    numbers : (rows, n, N) array
        The leading matrix at points of the same rank.

    Returns
    -------
    support : list of int
        Indices of the rows of the combination, the dependent one last.
    weights : (len(support),) array
        Equilibrated size of each row's coefficient, smallest over the points; 1 for the dependent row.
    """
    scaled = np.moveaxis(equilibrate(np.moveaxis(numbers, 2, 0))[0], 0, 2)
    basis = []
    for b in range(len(rows)):
        coefficients, left = [], []
        for p in range(scaled.shape[2]):
            c, rest = refined(scaled[basis, :, p], scaled[b, :, p], BASIS_CUTOFF)
            coefficients.append(np.abs(c))
            left.append(rest)
        if max(left) > DEPENDENT:
            basis.append(b)
            continue
        size = np.array(coefficients)
        support = [a for i, a in enumerate(basis) if size[:, i].max(initial=0.0) > SUPPORTS]
        weights = [size[:, i].min(initial=np.inf) for i, a in enumerate(basis) if a in support]
        return [*support, b], np.array([*weights, 1.0])
    return [], np.array([])

