"""Rows ψ = 0, their orders on the manifold of other rows, and dependences among their leading gradients."""

from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from servoctl.errors import SingularProgram, SpecificationError
from servoctl.jets.series import Flow
from servoctl.reduction.manifold import POINTS_SEED, sample, solve
from servoctl.reduction.ranks import clean, combination, decide, eliminate, equilibrate, refined
from servoctl.tolerances import DEPENDENT, ENTRY

TAKES_PART = 1e-12  # coefficient times the largest entry of a row: below this the row is no part of a combination
SUPPORTS = 1e-9  # equilibrated coefficient, at any point, above which a row is part of a dependence
BASIS_CUTOFF = 1e-12  # singular values of rows found independent, against the largest
VANISHED = 1e-5  # of a row's gradient at random points: what is left of it on its solutions, if it is a square
SQUARE_STEPS = 40  # of Newton's method towards them, which for a square only halves the way at each
SOLVED = 1e-3  # scaled residual of points at which the gradient of a possible square is looked at
BESIDE = 0.5  # relative distance of the points with which solutions are compared


@dataclass(frozen=True)
class Balance:
    """The balance r among the expressions that rows are made of, or one component of it.

    Attributes
    ----------
    component : str
        Name of a coordinate or quasi-velocity; empty for all of them.
    """

    component: str = ""

    def __str__(self):
        return f"the force on {self.component}" if self.component else "the balance"


@dataclass(frozen=True)
class Row:
    """One scalar equation ψ(t, q, γ', ..., γ^(order)) = 0.

    Attributes
    ----------
    expression : SX scalar
    order : int
        Highest level on which it depends on the manifold; 0 for q alone, -1 for neither q nor a jet.
    name : str
    kind : {"program", "material", "dynamics"}
        Where it came from.
    affine : bool
        Whether it is affine in γ^(order).
    story : str
        What was done to it, if it is a hidden constraint.
    uses : dict of (str or Balance) to int
        Highest derivative of each program residual, and of the balance, in it.
    """

    expression: ca.SX
    order: int
    name: str
    kind: str
    affine: bool = True
    story: str = ""
    uses: dict = field(default_factory=dict)
    _gradients: dict = field(default_factory=dict, repr=False, compare=False)

    def gradient(self, q, level=None):
        """∂ψ/∂γ^(level), (1, n) SX; for level 0 ∂ψ/∂q · V. Default: the row's own order, its leading gradient."""
        level = self.order if level is None else level
        key = self.expression.element_hash(), level
        if key not in self._gradients:
            slopes = ca.jacobian(self.expression, q.jet(level))
            self._gradients[key] = self.expression, slopes if level or q.plain else slopes @ q.V
        return self._gradients[key][1]

    def __repr__(self):
        return f"Row({self.name}: {self.kind}, order {self.order}{', ' + self.story if self.story else ''})"


def merge_uses(*parts):
    """The highest number of differentiations of each residual among (uses, extra differentiations) pairs."""
    total = {}
    for uses, extra in parts:
        for name, count in uses.items():
            total[name] = max(total.get(name, 0), count + extra)
    return total


def as_rows(q, named, kind, context):
    """Rows of named residuals with their true orders."""
    rows = [Row(e, max(q.order(e), 0), name, kind, uses={name: 0}) for name, e in named.items()]
    settled = settle_alone(q, rows, context)
    for row, slopes in settled:
        if row.order < 0:
            raise SpecificationError(
                f"The residual {row.name!r} depends on no coordinate.",
                "A constraint restricts the motion.",
                do="Use the symbols of the mechanism's coordinates.",
                name=row.name,
            )
        _refuse_square(q, row, context, slopes)
    return [row for row, _ in settled]


def _refuse_square(q, row, context, slopes=None):
    """Refuse a residual whose gradient vanishes where the residual does: φ² = 0 and its like.

    A gradient without the highest jets is as large on the solutions, which determine these alone, as elsewhere; and
    so is an entry that holds no coordinate. `slopes` are the values of the gradient at the points, where known.
    """
    slope = row.gradient(q)
    if row.order > 0 and q.order(slope) < row.order:
        return
    if slopes is not None:
        sizes, columns = np.abs(slopes), slope.sparsity().get_triplet()[1]
        clear = np.all(sizes > VANISHED * sizes.max(axis=0), axis=1)
        if any(clear[i] and q.order(e) < 0 for i, e in zip(columns, slope.nonzeros(), strict=True)):
            return
    start = sample(q, [], row.order, context)
    flow = Flow(q, [row], row.order, start)
    z, residual = solve(flow, start.t, start.z, iterations=SQUARE_STEPS)
    sizes = []
    for jets in (start.z, z):
        values, _ = replace(start, z=jets).matrix(row.gradient(q))
        sizes.append(np.abs(values).max(axis=(0, 1)))
    solved = residual < SOLVED
    if solved.any() and np.all(sizes[1][solved] < VANISHED * sizes[0][solved]):
        if not _regular_nearby(flow, start.t[solved], z[:, solved]):
            raise vanishing_gradient(row)


def _regular_nearby(flow, t, z):
    """Whether a gradient is small on a row's solutions z only as all is small there: it is no smaller than beside them.

    Newton's method has converged at a regular solution; at that of a square its steps only halve the way.
    """
    residual, slopes = flow(t, z)
    beside = z * (1.0 + np.random.default_rng(POINTS_SEED).uniform(-BESIDE, BESIDE, z.shape))
    here, there = np.abs(slopes[0]).max(axis=0), np.abs(flow(t, beside)[1][0]).max(axis=0)
    with np.errstate(all="ignore"):
        steps = np.abs(residual[0] * slopes[0]) / (slopes[0] ** 2).sum(axis=0)
    converged = np.all(steps <= VANISHED * np.abs(z), axis=0)
    return bool(np.any(converged & (here > VANISHED * there)))


def vanishing_gradient(row):
    """The error of a row whose gradient vanishes wherever the row holds."""
    return SingularProgram(
        f"The gradient of row {row.name!r} vanishes on its own solutions.",
        "A constraint is regular: a squared one, like φ² = 0, says nothing about the directions in which φ grows.",
        do=f"Write {row.name!r} so that it changes sign where it is crossed: what was squared, not its square.",
        row=row.name,
    )


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
