"""Rows ψ = 0, their orders on the manifold of other rows, and dependences among their leading gradients."""

from dataclasses import field, replace
from functools import reduce

import casadi as ca
import numpy as np

from servoctl.errors import SingularProgram, SpecificationError
from servoctl.jets.branches import shown
from servoctl.jets.identity import identical_zeros
from servoctl.jets.series import Flow
from servoctl.reduction.manifold import POINTS_SEED, ROUNDED, anywhere, sample, solve
from servoctl.reduction.ranks import clean, combination, decide, eliminate, equilibrate, refined, sizeable_columns
from servoctl.tolerances import DEPENDENT, ENTRY
from servoctl.values import frozen

TAKES_PART = 1e-12  # of the terms of a gradient: a row with a smaller multiple is no part of the combination
SUPPORTS = 1e-13  # equilibrated coefficient, at any point, above which a row is part of a dependence
BASIS_CUTOFF = 1e-12  # relative singular value of independent rows below which a direction is left out
VANISHED = 1e-5  # gradient on a row's solutions, relative to random points, below which the row is a square
SQUARE_STEPS = 40  # Newton steps towards these solutions; for a square each only halves the distance
SOLVED = 1e-3  # scaled residual of points at which the gradient of a possible square is judged
FELT = 1e-9  # a term above this fraction of a row's parts is not their rounding
SAME_DEPTH = 20  # nested operations to which factors are compared
BESIDE = 0.5  # relative distance of the points with which solutions are compared


@frozen
class Balance:
    """The key of the balance r, beside the names of residuals."""


@frozen
class Row:
    """One scalar equation ψ(t, q, γ', ..., γ^(order)) = 0.

    Its order `rests` on slopes that vanish at the points of its derivation if these do not vanish identically: they may
    be active elsewhere. `parts` are terms whose sum ψ is, where these may cancel: beside them rounding of folded
    constants is zero. `slopes` is a leading gradient that differs from ∂ψ/∂γ^(order) by multiples of other rows' only.
    Jets of quasi-velocities outside `columns` are functions of time.
    """

    expression: ca.SX
    order: int  # highest k with ∂ψ/∂γ^(k) ≠ 0 on the manifold; 0 for q alone, -1 for t alone
    name: str
    kind: str  # its origin: "program", "material" or "dynamics"
    affine: bool = True  # in γ^(order)
    derivation: str = ""  # the combination that it is, if it is a hidden constraint
    uses: dict = field(default_factory=dict)  # highest derivative of each residual, and of the balance, in ψ
    parts: tuple = field(default=(), repr=False, compare=False)  # SX
    rests: bool = field(default=False, repr=False)
    slopes: object = field(default=None, repr=False)  # (1, n) SX, or None
    columns: tuple | None = field(default=None, repr=False)  # quasi-velocities whose jets count; None: all
    _gradients: dict = field(default_factory=dict, repr=False, compare=False)

    def gradient(self, q, level=None):
        """∂ψ/∂γ^(level), (1, n) SX; for level 0 ∂ψ/∂q · V. Default level: the order, for the leading gradient."""
        level = self.order if level is None else level
        if self.slopes is not None and level == self.order:
            return self.slopes
        key = self.expression.element_hash(), level, self.columns
        if key not in self._gradients:
            slopes = ca.jacobian(self.expression, q.jet(level))
            slopes = slopes if level or q.plain else slopes @ q.V
            if self.columns is not None:
                some, slopes = slopes[:, list(self.columns)], ca.SX(1, q.n)
                slopes[:, list(self.columns)] = some
            self._gradients[key] = self.expression, slopes
        return self._gradients[key][1]

    def own(self, q, level):
        """Symbols of the jets γ^(level) that count."""
        jets = q.gamma(level)
        return jets if self.columns is None else tuple(jets[i] for i in self.columns)

    def __repr__(self):
        return f"Row({self.name}: {self.kind}, order {self.order}{', ' + self.derivation if self.derivation else ''})"


def balances(q, expressions):
    """Rows of (3.18) from their expressions by index of the independent quasi-coordinate."""
    names = q.force_names
    return [
        Row(e, max(q.order(e), 0), f"balance of {names[i]}", "dynamics", uses={Balance(): 0})
        for i, e in expressions.items()
    ]


def omitted(written, rows):
    """What rows leave out of equations as they are written, where their orders rest on slopes: SX by name."""
    return {row.name: written[row.name] - row.expression for row in rows if row.rests}


def merge_uses(*parts):
    """The highest number of differentiations of each residual among (uses, extra differentiations) pairs."""
    total = {}
    for uses, extra in parts:
        for name, count in uses.items():
            total[name] = max(total.get(name, 0), count + extra)
    return total


def row_levels(q, rows, top):
    """Total time derivatives of each row of orders 0 .. top - o_a, but at least the row, by its expression."""
    rows, by_count, found = list(rows), {}, {}  # rows that are differentiated equally often share their terms
    for a, row in enumerate(rows):
        by_count.setdefault(max(0, top - row.order), []).append(a)
    for count, some in by_count.items():
        derivatives = q.derivatives([rows[a].expression for a in some], count)
        found |= zip(some, map(list, zip(*derivatives, strict=True)), strict=True)
    return [found[a] for a in range(len(rows))]


def as_rows(q, named, kind, context):
    """Rows of residuals by name, of kind "program" or "material", with their true orders.

    Raises SpecificationError if a residual depends on no coordinate, and SingularProgram if it is a square: its
    gradient vanishes wherever the residual does.
    """
    rows = [Row(q.on_spheres(e), max(q.order(e), 0), name, kind, uses={name: 0}) for name, e in named.items()]
    settled = settle_rows(q, rows, context)
    for row, slopes in settled:
        if row.order < 0:
            raise SpecificationError(
                f"The residual {row.name!r} depends on no coordinate.",
                "A constraint restricts the motion.",
                do="Write it with the symbols of the mechanism's coordinates.",
                name=row.name,
            )
        _refuse_square(q, row, context, slopes)
    return [row for row, _ in settled]


def _refuse_square(q, row, context, slopes=None):
    """Refuse a residual whose gradient vanishes wherever the residual does, such as φ² = 0.

    `slopes` are values of the gradient at points, where they are known.
    """
    gradient = row.gradient(q)
    # The solutions determine only the highest jets: a gradient without these is as large there as anywhere,
    if row.order > 0 and q.order(gradient) < row.order:
        return
    # and so is an entry without any coordinate.
    if slopes is not None:
        sizes, columns = np.abs(slopes), gradient.sparsity().get_triplet()[1]
        clear = np.all(sizes > VANISHED * sizes.max(axis=0), axis=1)
        if any(clear[i] and q.order(e) < 0 for i, e in zip(columns, gradient.nonzeros(), strict=True)):
            return
    start = sample(q, [], row.order, context)
    flow = Flow(q, [row], row.order, start)
    z, residual = solve(flow, start.instants, start.z, iterations=SQUARE_STEPS)
    end = replace(start, z=z)
    before, after = (np.abs(points.matrix(gradient)[0]).max(axis=(0, 1)) for points in (start, end))
    # A gradient also vanishes if it changes by its own size where rounding of the row's terms moves the solution.
    way, left = np.abs(z - start.z).max(axis=0), ROUNDED * values_and_sizes(row, end)[1][0]
    vanished, solved = (after < VANISHED * before) | ((way > 0) & (after**2 * way < left * before)), residual < SOLVED
    if solved.any() and vanished[solved].all():
        if not _regular_nearby(flow, row, end.take(np.flatnonzero(solved))):
            raise vanishing_gradient(row)


def _regular_nearby(flow, row, points):
    """Whether a row's gradient at its solutions is no smaller than beside them, where all of it is small.

    At a regular solution Newton's method has converged, as far as the rounding of the row's terms allows; towards that
    of a square its steps only halve the distance.
    """
    t, z = points.instants, points.z
    residual, slopes = flow(t, z)
    beside = z * (1.0 + np.random.default_rng(POINTS_SEED).uniform(-BESIDE, BESIDE, z.shape))
    here, there = np.abs(slopes[0]).max(axis=0), np.abs(flow(t, beside)[1][0]).max(axis=0)
    left = np.maximum(np.abs(residual[0]), ROUNDED * values_and_sizes(row, points)[1][0])
    with np.errstate(all="ignore"):
        steps = np.abs(left * slopes[0]) / (slopes[0] ** 2).sum(axis=0)
    converged = np.all(steps <= VANISHED * np.abs(z), axis=0)
    return bool(np.any(converged & (here > VANISHED * there)))


def vanishing_gradient(row):
    """The error of a row without a gradient where it holds; it names a factor that the row has more than once."""
    found = factors(row.expression)
    factor = next((f for i, f in enumerate(found) if _among(f, found[:i])), None)
    because = "" if factor is None else f": it has the factor {shown(factor)} more than once"
    return SingularProgram(
        f"The gradient of row {row.name!r} vanishes on its own solutions, or has no value there{because}.",
        "A constraint φ = 0 needs a gradient there; φ², |φ| and 1 - cos φ have none, and determine no direction of the "
        "motion.",
        do=f"Write {row.name!r} so that it changes sign, with a gradient, at its solutions: φ in place of φ² or of "
        "1 - cos φ, one residual for each direction in place of a distance, and without a factor that is a speed.",
        row=row.name,
        **({} if factor is None else {"factor": shown(factor)}),
    )


def _among(factor, others):
    """Whether a factor is one of some others."""
    return any(ca.is_equal(factor, other, SAME_DEPTH) for other in others)


def factors(expression):
    """Factors of an SX scalar that are no constants, repeated ones as often as they occur."""
    operation = expression.op()
    inner = [expression.dep(i) for i in range(expression.n_dep())]
    if operation == ca.OP_MUL:
        return [f for e in inner for f in factors(e)]
    if operation == ca.OP_SQ:
        return 2 * factors(inner[0])
    if operation in (ca.OP_NEG, ca.OP_TWICE, ca.OP_DIV):
        return factors(inner[0])
    if operation in (ca.OP_POW, ca.OP_CONSTPOW) and inner[1].is_constant() and float(inner[1]) >= 2:
        return 2 * factors(inner[0])
    return [expression] if ca.symvar(expression) else []


def alternatives(q, row, context):
    """Factors of a row that have zeros about the guess, in words, where there are several: it holds by any of them."""
    found = [f for f in factors(row.expression) if q.order(f) >= 0]
    found = [f for i, f in enumerate(found) if not _among(f, found[:i])]
    rest = []
    if len(found) == 1:  # perhaps a sum whose terms have a jet in common
        jets = [s for s in _perhaps_factors(q, found[0]) if ca.substitute(found[0], s, 0).is_zero()]
        found, rest = [*jets, reduce(ca.SX.__truediv__, jets, found[0])], ["the rest"]
    if len(found) < 2:
        return []
    words = [*map(shown, found[: len(found) - len(rest)]), *rest]
    values = anywhere(q, max(map(q.order, found)), context).evaluate(found)[0]
    crossed = [word for word, v in zip(words, values, strict=True) if v.min() < 0 < v.max()]
    return crossed if len(crossed) > 1 else []


def _perhaps_factors(q, expression):
    """The jets at whose zeros an SX scalar is zero, or has no value, for some values of its other symbols."""
    symbols = ca.symvar(expression)
    jets = [i for i, s in enumerate(symbols) if q.is_jet(s)]
    z = np.tile(0.8 + 0.5 * np.sin(1.0 + np.arange(len(symbols)))[:, None], len(jets))  # numbers without relations
    z[jets, range(len(jets))] = 0.0
    values = ca.Function("e", [ca.vertcat(*symbols)], [expression])(z).full().ravel() if jets else []
    return [symbols[i] for i, value in zip(jets, values, strict=True) if not abs(value) > 0]


def leading(q, rows, points):
    """The leading matrix L at points, (rows, n, N), with rounding set to zero, and the sizes of its entries."""
    values, sizes = points.matrix(ca.vertcat(*(row.gradient(q) for row in rows)))
    return clean(values, sizes), sizes


def settle_rows(q, rows, context):
    """The true order of each row by itself; see `settle`.

    For most rows one evaluation of all leading gradients decides, and `settle` treats the rest. Each row comes with the
    values (n, N) of its leading gradient at the points, None if that evaluation did not decide.
    """
    levels = [q.order(row.expression) for row in rows]
    settled = [None] * len(rows)
    for level in set(levels) - {-1}:
        members = [a for a, order in enumerate(levels) if order == level and rows[a].order <= level]
        points = sample(q, [], level, context)
        gradients = [rows[a].gradient(q, level) for a in members]
        points.read([*(rows[a].expression for a in members), *(e for g in gradients for e in g.nonzeros())])
        values = clean(*points.matrix(ca.vertcat(*gradients)))
        for a, numbers in zip(members, values, strict=True):
            if np.any(numbers):
                settled[a] = _of_order(q, rows[a], level, points), numbers
    return [pair or (settle(q, row, [], context)[0], None) for pair, row in zip(settled, rows, strict=True)]


def settle(q, row, others, context, starts=None):
    """Determine the order of a row on the manifold of other rows, and eliminate jets that it only seems to contain.

    From the highest jet downwards: a jet with a zero gradient is set to zero, and a jet that the other rows determine
    is replaced by their solution. The row's own `order` is an upper bound. Returns the row with its true order, -1 for
    none, or None if no point satisfies the other rows, and points of their manifold, for which `starts` are starts.
    """
    level = max([row.order, q.order(row.expression), 0, *(other.order for other in others)])
    points = sample(q, others, level, context, starts=starts)
    if not len(points.t):
        return None, points
    for j in range(q.order(row.expression), -1, -1):
        values = slopes(q, row, j, points)
        if np.any(values):
            lower = [other for other in others if other.order < j or (other.order == j and other.affine and j > 0)]
            eliminated = _eliminated(q, row, j, values, lower, points, context)
            if eliminated is None:
                return _of_order(q, row, j, points), points
            row = eliminated
        if j > 0:
            row = replace(row, rests=row.rests or _may_live(row.gradient(q, j)))
            row = _without(q, row, row.own(q, j), points)
    if row.columns is not None:
        return replace(row, order=-1), points
    if q.order(row.expression) == 0 and not np.any(slopes(q, row, 0, points)):
        return replace(row, order=-1), points
    return replace(row, order=max(q.order(row.expression), -1)), points


def slopes(q, row, j, points):
    """∂ψ/∂γ^(j) at points (n, N), zero where it is rounding beside the slopes of the row's parts."""
    values, sizes = points.matrix(row.gradient(q, j))
    values = clean(values, sizes)[0]
    if not row.parts or not np.any(values) or _is_felt(q, row, j, values, points):
        return values
    gradients = [ca.jacobian(part, q.jet(j)) for part in row.parts]
    parts, _ = points.matrix(ca.vertcat(*(g if j or q.plain else g @ q.V for g in gradients)))
    return clean(values, np.abs(parts).max(axis=0))


def _is_felt(q, row, j, values, points):
    """Whether slopes times their jets are no rounding of the row's parts: then the slopes themselves are none."""
    if values.shape != points.jet(j).shape:
        return False
    return bool(np.any(np.abs(values * points.jet(j)) > FELT * values_and_sizes(row, points)[1]))


def values_and_sizes(row, points):
    """Values and sizes (1, N) of a row at points, the sizes at least those of its parts."""
    values, sizes = points.evaluate([row.expression])
    return values, np.maximum(sizes, np.abs(points.evaluate(list(row.parts))[0]).max(axis=0, initial=0.0))


def _without(q, row, symbols, points):
    """The row with jets set to zero, or to one where it divides by them; the row itself if that changes its value."""
    (value,), (size,) = values_and_sizes(row, points)
    for constant in (ca.SX.zeros(len(symbols)), ca.SX.ones(len(symbols))):
        expression, *parts = _substituted(row, symbols, constant)
        (without,), _ = points.evaluate([expression])
        if np.all(np.abs(value - without) <= ENTRY * size):
            return replace(row, expression=expression, parts=tuple(parts))
    return row


def _substituted(row, symbols, values):
    """The expression and the parts of a row with symbols replaced."""
    return ca.substitute([row.expression, *row.parts], [ca.vertcat(*symbols)], [values])


def _of_order(q, row, j, points):
    """The row with order j, and whether it is affine in γ^(j); rows of order 0 count as affine."""
    row, jets = replace(row, order=j, affine=True), q.jet(j)
    if j == 0 or q.order(row.gradient(q)) < j:
        return row
    second = ca.jacobian(row.gradient(q).T, jets)
    rests = _may_live(second)
    if np.any(clean(*points.evaluate(second.nonzeros()))) or (j > 1 and rests):
        return replace(row, affine=False)
    return replace(row, rests=row.rests or rests)


def _may_live(slopes):
    """Whether slopes that are zero at points may be active elsewhere, as they do not vanish identically."""
    return not identical_zeros([e for e in slopes.nonzeros() if not e.is_zero()]).all()


def _eliminated(q, row, j, values, lower, points, context):
    """The row with jets γ^(j) replaced by the solution of lower rows, or None where these do not determine it."""
    if not lower:
        return None
    numbers, _ = leading(q, lower, points)
    support, size = set(), points.matrix(row.gradient(q, j))[1].max()
    for p in range(values.shape[1]):
        c, left = combination(numbers[:, :, p], values[:, p])
        if left > DEPENDENT:
            return None
        parts = np.abs(c[:, None] * numbers[:, :, p])
        support |= set(np.flatnonzero(parts.max(axis=1) > TAKES_PART * size))
    basis = []
    for a in sorted(support):
        if decide(numbers[[*basis, a], :, 0]).rank == len(basis) + 1:
            basis.append(a)
    rows, numbers = [lower[a] for a in basis], numbers[basis]
    if not rows or any(other.order == j and not other.affine for other in rows):
        return None
    columns = solved_columns(q, numbers[:, :, 0], decide(numbers[:, :, 0]), context)
    jets = q.jet(j)[columns]
    raised = ca.vertcat(*(q.derivatives([other.expression], j - other.order)[-1][0] for other in rows))
    rest = ca.substitute(raised, jets, ca.SX.zeros(len(columns)))
    matrix = ca.vertcat(*(other.gradient(q) for other in rows))[:, columns]
    solution, _ = eliminate(matrix, -rest, numbers[:, columns])
    uses = merge_uses((row.uses, 0), *((other.uses, j - other.order) for other in rows))
    expression, *parts = _substituted(row, ca.vertsplit(jets), solution)
    return replace(row, expression=ca.cse(expression), uses=uses, parts=tuple(parts))


def solved_columns(q, matrix, rank, context):
    """The columns in which independent rows (k, n) of a rank are solved: by the inertia, where it is known."""
    columns = list(rank.columns)
    if context.saddle is not None:
        inertia = clean(*anywhere(q, 2, context).matrix(ca.diag(context.saddle)[: q.n]))[:, 0].mean(axis=1)
        columns = sizeable_columns(matrix, columns, inertia)
    return sorted(columns)


def dependence(numbers, first=0):
    """The first row whose leading gradient is a combination of those before it, and that combination.

    `numbers` (rows, n, N) is the leading matrix at points of the same rank; dependent rows before `first` are left out.
    Returns the indices of the combined rows, the dependent one last, none if no row is dependent; and of each the
    smallest size of its equilibrated coefficient over the points, 1 for the dependent row.
    """
    scaled = np.moveaxis(equilibrate(np.moveaxis(numbers, 2, 0))[0], 0, 2)
    basis = []
    for b in range(len(scaled)):
        coefficients, left = [], []
        for p in range(scaled.shape[2]):
            c, rest = refined(scaled[basis, :, p], scaled[b, :, p], BASIS_CUTOFF)
            coefficients.append(np.abs(c))
            left.append(rest)
        if max(left) > DEPENDENT:
            basis.append(b)
            continue
        if b < first:
            continue
        size = np.array(coefficients)
        support = [a for i, a in enumerate(basis) if size[:, i].max(initial=0.0) > SUPPORTS]
        weights = [size[:, i].min(initial=np.inf) for i, a in enumerate(basis) if a in support]
        return [*support, b], np.array([*weights, 1.0])
    return [], np.array([])
