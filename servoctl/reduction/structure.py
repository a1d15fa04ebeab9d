"""Differentiation index, relative degrees, zeros at infinity and essential orders, decided numerically.

Along a motion, J_N = ∂(φ, ..., φ^(N))/∂(u, ..., u^(N)) on the plant's jets has the ranks R_N; σ_N = R_N - R_(N-1) is
the number of zeros at infinity of order at most N. Everything is computed with normalised Taylor coefficients,
which changes no rank.
"""

from collections import Counter
from dataclasses import replace

import casadi as ca
import numpy as np

from servoctl.jets.series import Flow
from servoctl.markup import Shown
from servoctl.reduction.appell import Realisation
from servoctl.reduction.manifold import solve
from servoctl.reduction.ranks import clean, decide, decide_all, decide_each, solve_clean
from servoctl.reduction.rows import Row, balances
from servoctl.tolerances import ENTRY, TINY
from servoctl.values import frozen

INDEPENDENT = 1e-7  # equilibrated pivots of J above this count
ACTS = 1e-7  # cosine of an angle between actuators and normals above which it is no right angle
AT_REST = 1e-13  # a jet below this fraction of the largest is zero, not small
LEAVES = 1e-6  # change of a state, relative to its size, beyond which no motion of the program passes through it
DEPTHS = (2, 4, 6, 8, 12, 16, 24, 32)  # values of N, tried until J_N shows all zeros at infinity


@frozen
class Local:
    """The structure at one point of a motion; attributes as in `Structure`.

    Attributes
    ----------
    zero : tuple of str
        Jets that vanish there, of those on which the ranks depend.
    """

    relative_degree: tuple
    decoupling_rank: int
    zeros_at_infinity: tuple
    essential_orders: tuple
    index: int
    margin: float
    zero: tuple = ()

    @property
    def decided(self):
        """The structure without what varies from point to point."""
        return replace(self, margin=0.0, zero=())

    def named(self, residuals):
        """How a printed structure names the values at this point."""
        pairs = zip(residuals, self.relative_degree, strict=False)
        degrees = ", ".join(f"{name} {r}" for name, r in pairs) or "not decided"
        zeros = ", ".join(map(str, self.zeros_at_infinity)) or "not decided"
        where = f" (where {' and '.join(f'{name} = 0' for name in self.zero)})" if self.zero else ""
        return f"relative degrees {degrees}, zeros at infinity {zeros}{where}"


UNDECIDED = Local((), 0, (), (), None, 0.0)


@frozen
class Structure(Shown):
    """Index and orders of a program realised by actuators (or by an ideal reaction) along a motion.

    Attributes
    ----------
    residuals : tuple of str
    relative_degree : tuple of int
        For each residual the lowest derivative that contains the actuation.
    decoupling_rank : int
        Rank of the decoupling matrix P; k where a vector relative degree exists.
    zeros_at_infinity : tuple of int
        Orders n'_i of the zeros at infinity, ascending.
    essential_orders : tuple of int
        ε_i: the path of residual i needs class C^ε_i.
    index : int or None
        Differentiation index, 1 + max n'_i; None for residuals of order above 2.
    margin : float
        Smallest equilibrated pivot that counts in any of the ranks, those of the reduction among them.
    realisation : {"orthogonal", "mixed", "tangential", "undecided", "ideal"}
        Rank of P full, between, or zero; "undecided" if the largest N does not show all zeros at infinity.
    at : tuple of (float, Local)
        The structure at each instant [s].
    start : (float, Local) or None
        The structure at a start, where that was asked for.
    """

    residuals: tuple
    relative_degree: tuple
    decoupling_rank: int
    zeros_at_infinity: tuple
    essential_orders: tuple
    index: object
    margin: float
    realisation: str
    at: tuple
    start: tuple | None = None

    @property
    def uniform(self):
        """Whether the structure is the same at every instant."""
        return len({local.decided for _, local in self.at}) <= 1

    def __repr__(self):
        k = len(self.residuals)
        if not self.at and not self.zeros_at_infinity:
            return "Structure: not computed; index and relative degrees are defined for residuals of order 0, 1 or 2"
        if not self.zeros_at_infinity:
            return (
                f"Structure: not decided; J_N shows fewer than {k} zeros at infinity up to N = {DEPTHS[-1]}, or its "
                f"ranks are below {INDEPENDENT:.0e}"
            )
        vector = "a vector relative degree exists" if self.decoupling_rank == k else "no vector relative degree"
        pairs = ", ".join(f"{name} {r}" for name, r in zip(self.residuals, self.relative_degree, strict=False))
        essential = ", ".join(f"{name} {r}" for name, r in zip(self.residuals, self.essential_orders, strict=False))
        lines = [
            f"Structure: index {'not defined' if self.index is None else self.index}; {self.realisation} realisation",
            f"  relative degrees: {pairs or 'none'}; decoupling matrix of rank {self.decoupling_rank} of {k}: {vector}",
            f"  zeros at infinity: {', '.join(map(str, self.zeros_at_infinity)) or 'not computed'}",
            f"  essential orders (class that each path needs): {essential or 'not computed'}",
            f"  smallest pivot counted {self.margin:.1e}",
        ]
        return "\n".join([*lines, *self._differences()])

    def _differences(self):
        """Lines on the instants at which the structure is another one."""
        typical, lines = _most_common([local for _, local in self.at]) if self.at else None, []
        other = [(t, a) for t, a in self.at if a.decided != typical]
        if other:
            (t, first), count = other[0], f"{len(other)} of {len(self.at)} instants"
            lines.append(f"  it differs at {count}, first t = {t:.4g} s: {first.named(self.residuals)}")
        if self.start is not None and self.start[1].decided != typical:
            t, local = self.start
            lost = local.zeros_at_infinity and local.zeros_at_infinity != self.zeros_at_infinity
            lines.append(f"  at the start nearest zero, t = {t:.4g} s: {local.named(self.residuals)}")
            lines += ["    the motion's relative degrees are lost there: the program is singular"] if lost else []
        return lines


@frozen
class Directions:
    """What the actuators do to the program at one instant, in the inertia metric.

    Attributes
    ----------
    cosines : tuple of float
        Of the principal angles between the directions of the actuators and the normals of the program, beside material
        constraints; descending. They are singular values of the decoupling matrix of residuals of relative degree 2 in
        orthonormal directions, and free of units: all 1 for an orthogonal realisation, 0 for a tangential one.
    actuators : tuple of str
        Actuators in the directions that change no residual.
    residuals : tuple of str
        Residuals in the directions that no actuator changes.
    """

    cosines: tuple
    actuators: tuple
    residuals: tuple

    @property
    def angle(self):
        """The largest angle between the actuators and the normals [rad]."""
        return float(np.arccos(np.clip(min(self.cosines, default=1.0), 0.0, 1.0)))

    @property
    def margin(self):
        """The smallest cosine that counts."""
        return min((c for c in self.cosines if c > ACTS), default=0.0)


def directions(reduction, t, jets, values):
    """The `Directions` of actuators and of the program at each instant of a motion.

    For a program realised by actuators, at t (N,) [s] with jets (n_z, N) and parameters `values` (n_p,).
    """
    mechanism, q = reduction.mechanism, reduction.mechanism.q
    points = points_of(reduction, t, jets, values)
    rows = reduction.original.values()
    groups = [[row.gradient(q) for row in rows if row.kind == kind] for kind in ("program", "material")]
    matrices = (mechanism.mass, mechanism.E, *(ca.vertcat(ca.SX(0, q.n), *group).T for group in groups))
    numbers = [np.moveaxis(clean(*points.matrix(matrix)), -1, 0).astype(float) for matrix in matrices]
    return [_directions(mechanism, reduction.program.names, *each) for each in zip(*numbers, strict=True)]


def margins(reduction, t, jets, values):
    """Smallest equilibrated pivot of the leading matrix at each instant of a motion, (N,).

    It is 0 where the matrix is singular, and NaN where it has no value. Where it is regular, orders and zeros at
    infinity are those of the reduction. The motion is t (N,) [s] with jets (n_z, N) and parameters `values` (n_p,).
    """
    t, jets = np.asarray(t, dtype=float), np.asarray(jets, dtype=float)
    numbers = clean(*points_of(reduction, t, jets, values).matrix(reduction.leading))
    known = np.isfinite(numbers).all(axis=(0, 1))
    ranks = decide_each(np.where(known, numbers, 0.0), INDEPENDENT)
    smallest = np.array([rank.kept if rank.rank == len(numbers) else 0.0 for rank in ranks])
    return np.where(known, smallest, np.nan)


def _directions(mechanism, names, mass, E, G, G_m):
    """The directions at one instant, from M (n, n), E (n, m), Gᵀ (n, k) and G_mᵀ (n, k_m)."""
    if not all(np.isfinite(matrix).all() for matrix in (mass, E, G, G_m)):
        return Directions((), (), ())
    values, vectors = np.linalg.eigh(mass)
    root = np.where(values > 0, 1 / np.sqrt(np.maximum(values, TINY)), 0.0)[:, None] * vectors.T
    tied = _basis(root @ G_m)[0]
    (U, of_actuators), (N, of_residuals) = (_basis(A - tied @ (tied.T @ A)) for A in (root @ E, root @ G))
    left, cosines, right = np.linalg.svd(U.T @ N)
    count = int((cosines > ACTS).sum())
    idle, open_ = of_actuators @ left[:, count:], of_residuals @ right[count:].T
    padded = np.append(cosines, np.zeros(max(N.shape[1] - len(cosines), 0)))
    return Directions(tuple(padded.tolist()), _taking_part(mechanism.actuators, idle), _taking_part(names, open_))


def _basis(A):
    """Q (n, r) orthonormal, and C (m, r) with A C = Q, for the columns of A (n, m) scaled to length one."""
    lengths = np.linalg.norm(A, axis=0)
    scaled = A / np.where(lengths > 0, lengths, 1.0)
    U, s, V = np.linalg.svd(scaled, full_matrices=False)
    count = int((s > INDEPENDENT * s.max(initial=0.0)).sum()) if s.size else 0
    return U[:, :count], V[:count].T / s[:count]


def _taking_part(names, combinations):
    """The names whose rows of the combinations (len, j), of unit vectors, are not zero."""
    sizes = np.abs(combinations).max(axis=1, initial=0.0)
    return tuple(name for name, size in zip(names, sizes, strict=True) if size > LEAVES * sizes.max())


@np.errstate(all="ignore")  # a residual may have no value at a point: nothing is decided there
def structure(reduction, t=None, jets=None, values=None, start=None):
    """Decide index, relative degrees, zeros at infinity and essential orders at points of a motion.

    The points are instants t (N,) [s] with jets q, γ', ..., γ^(s̄) (n_z, N) and parameters `values` (n_p,); by default
    the seeded points of the reduction. `start` is a time [s] and a state (n_x,) at which the structure is decided as
    well.
    """
    names = tuple(reduction.program.residuals)
    orders = [reduction.original[name].order for name in names]
    if not names or reduction.program.by == "ideal" or max(orders) > 2:
        return _by_orders(reduction, names, orders)
    points = reduction.points if t is None else points_of(reduction, t, jets, values)
    locals_ = _locals(reduction, points, t is not None)
    if start is not None:
        t0, state = start
        start = float(t0[0, 0]), _locals(reduction, points_of(reduction, t0, state[:, None], values), True)[0]
    typical = _most_common(locals_)
    if t is not None:
        locals_ = _without_rounded(locals_, typical, margins(reduction, t, jets, values))
    rank_P = typical.decoupling_rank if any(r <= 2 for r in typical.relative_degree) else 0
    kind = "orthogonal" if rank_P == len(names) else "tangential" if rank_P == 0 else "mixed"
    kind = kind if typical.relative_degree else "undecided"
    margin = min(reduction.rank.kept, *(local.margin for local in locals_))
    at = tuple(zip(np.asarray(points.t, dtype=float).tolist(), locals_, strict=True))
    return Structure(
        names,
        typical.relative_degree,
        typical.decoupling_rank,
        typical.zeros_at_infinity,
        typical.essential_orders,
        typical.index,
        margin,
        kind,
        at,
        start,
    )


def _without_rounded(locals_, typical, pivots):
    """The structure at points of a motion, undecided where rounding has decided.

    Where the leading matrix is regular, zeros at infinity are those of the reduction everywhere. Near a rest, relative
    errors of small jets are large, and ranks of the large matrices J_N may come out too high.
    """
    kept = []
    for local, pivot in zip(locals_, pivots, strict=True):
        rounded = pivot > 0 and local.zeros_at_infinity != typical.zeros_at_infinity
        kept.append(replace(UNDECIDED, margin=local.margin, zero=local.zero) if rounded else local)
    return kept


def _most_common(locals_):
    return Counter(local.decided for local in locals_).most_common(1)[0][0]


def _by_orders(reduction, names, orders):
    """Ideal programs: the reaction acts through G, so residuals of order s <= 2 meet it after 2 - s derivatives."""
    degrees = tuple(max(0, 2 - s) for s in orders)
    plain = names and reduction.program.by == "ideal" and max(orders) <= 2 and not reduction.hidden
    index = 1 + max(degrees) if plain else None
    return Structure(
        names,
        degrees,
        len(names) if plain else 0,
        tuple(sorted(degrees)) if plain else (),
        degrees if plain else (),
        index,
        reduction.rank.kept,
        "ideal",
        (),
    )


def points_of(reduction, t, jets, values):
    """Points of a motion from its samples."""
    sample = reduction.points
    return sample.at(t, np.asarray(jets, dtype=np.longdouble), sample.values if values is None else values)


def _locals(reduction, points, states):
    """The structure at each point, by the smallest N that shows all zeros at infinity there.

    Points are starts of the search for a motion, or `states` of one.
    """
    zero = _vanishing_jets(reduction, points)
    result = [replace(UNDECIDED, zero=names) for names in zero]
    left = np.arange(len(points.t))
    enough = sum(depth < 2 * reduction.mechanism.q.n for depth in DEPTHS) + 1  # no order exceeds the plant's states
    for depth in DEPTHS[:enough]:
        if not len(left):
            break
        locals_ = _at_depth(reduction, points.take(left), depth, states)
        for p, local in zip(left, locals_, strict=True):
            if local is not None:
                result[p] = replace(local, zero=zero[p])
        left = left[[local is None for local in locals_]]
    return result


def _vanishing_jets(reduction, points):
    """For each point the names of those jets in L and B that are zero there."""
    q = reduction.mechanism.q
    entries = ca.vertcat(ca.vec(ca.densify(reduction.leading)), ca.vec(ca.densify(reduction.realisation.B)))
    places = [q.where(s) for s in ca.symvar(entries)]
    places = sorted((level, i) for kind, level, i in filter(None, places) if kind in "qw")
    values = {q.jet_names(level)[i]: points.jet(level)[i] for level, i in places}
    limits = {name: AT_REST * max(1.0, float(np.abs(v).max())) for name, v in values.items()}
    return [tuple(name for name, v in values.items() if abs(v[p]) <= limits[name]) for p in range(len(points.t))]


def _at_depth(reduction, points, depth, states):
    """The structure at each point from J_N with N = depth, None where N is too small; a larger J_N contains it."""
    k = len(reduction.program.residuals)
    z = _jets(reduction, points, depth + 2, states)
    numbers, sizes = _input_jacobian(reduction, points, z, depth)
    finite = np.isfinite(numbers).all(axis=(0, 1, 2, 3))
    matrices = np.moveaxis(clean(numbers, sizes), -1, 0)
    return [_local(J, k, depth) if known else UNDECIDED for J, known in zip(matrices, finite, strict=True)]


def _jets(reduction, points, level, states):
    """Jets of the program's motion near each point up to a level, (nz, N); through it, where points are states.

    Through a state at which the program is singular there may be no motion; the jets there are those of the plant under
    constant inputs.
    """
    q = reduction.mechanism.q
    z = np.zeros((q.nq + level * q.n, len(points.t)), dtype=np.longdouble)
    shared, state = min(len(z), len(points.z)), q.nq + q.n
    z[:shared] = points.z[:shared]
    if reduction.cascade is None:
        solved, residual = solve(Flow(q, reduction.rows, level, points), points.instants, z)
    else:
        deeper, good = reduction.cascade.continued(replace(points, z=z), level)
        solved, residual = deeper[: len(z)], np.where(good, 0.0, np.inf)
    change = np.abs(solved[:state] - z[:state]) / (1.0 + np.abs(z[:state]))
    for p in np.flatnonzero(~(np.maximum(change.max(axis=0), residual) < LEAVES)) if states else ():
        solved[:, p] = _plant_jets(reduction, points.take([p]), z[:, [p]], level)[:, 0]
    for part in (solved[: q.nq], solved[q.nq :]):
        part[np.abs(part) < AT_REST * np.maximum(1.0, np.abs(part).max(axis=0))] = 0.0
    return solved


def _plant_jets(reduction, point, z, level):
    """Jets of the plant at one point, under the constant inputs nearest to those of an equilibrium."""
    q, k, balance = reduction.mechanism.q, len(reduction.program.residuals), reduction.balance
    z = z.copy()
    z[q.nq + q.n :] = 0.0
    point = replace(point, z=z)
    B = reduction.realisation.B
    numbers, static = point.matrix(B)[0][:, :, 0], point.evaluate(balance.elements())[0][:, 0]
    if not (np.isfinite(numbers).all() and np.isfinite(static).all()):
        return z  # no force is defined there: the point keeps its velocities
    u = np.linalg.lstsq(numbers.astype(float), static.astype(float), rcond=None)[0][:k]
    material = [row for row in reduction.original.values() if row.kind == "material"]
    G = B[:, k:].T
    dependent = sorted(decide_all(*point.matrix(G))[0].columns) if material else []
    independent = [i for i in range(q.n) if i not in dependent]
    split = Realisation(G.T, None, tuple(dependent), tuple(independent), clean(*point.matrix(G)))
    forced, _ = split.dynamics(balance - B[:, :k] @ u)
    return solve(Flow(q, [*material, *balances(q, forced)], level, point), point.instants, z)[0]


def _input_jacobian(reduction, points, z, depth):
    """J and the sizes of its entries, (k, N+1, k, N+1, points): coefficient j of row i by coefficient l of input a."""
    q, k, level, n_points = reduction.mechanism.q, len(reduction.program.residuals), depth + 2, len(points.t)
    B = reduction.realisation.B
    inputs = ca.SX.sym("u", B.shape[1])
    material = [row for row in reduction.original.values() if row.kind == "material"]
    program = [reduction.original[name] for name in reduction.program.residuals]
    flow = Flow(q, [], level, points)
    series = flow.series(ca.vertcat(reduction.multipliers, ca.vec(ca.densify(B))).elements(), points.instants, z, depth)
    u, b = series[: B.shape[1]], series[B.shape[1] :].reshape(B.shape[1], q.n, depth + 1, n_points)
    signals = {s.element_hash(): [u[i, j] for j in range(depth + 1)] for i, s in enumerate(inputs.elements())}
    balance = (reduction.balance - B @ inputs).elements()
    rows = [
        *(Row(e, 2, name, "dynamics") for name, e in zip(q.jet_names(1), balance, strict=True)),
        *material,
        *program,
    ]
    flow = Flow(q, rows, level, points, signals, real=np.longdouble)
    columns = slice(q.nq + q.n, None)
    jacobian = _without_rounding(flow(points.instants, z)[1][:, columns])
    place = {equation: e for e, equation in enumerate(flow.equations)}
    plant = [place[a, i] for i in range(depth + 1) for a in range(q.n)]
    bound = [place[q.n + m, i + 2 - row.order] for i in range(depth + 1) for m, row in enumerate(material)]
    first = q.n + len(material)
    J = np.zeros((k, depth + 1, k, depth + 1, n_points), dtype=np.longdouble)
    sizes = np.zeros_like(J)
    for p in range(n_points):
        motion = _response(jacobian[..., p], b[..., p], plant, bound, k, depth)
        for i in range(k):
            for j in range(depth + 1):
                if (first + i, j) in place:
                    row = jacobian[place[first + i, j], :, p]
                    J[i, j, ..., p] = (row @ motion).reshape(k, depth + 1)
                    sizes[i, j, ..., p] = (np.abs(row) @ np.abs(motion)).reshape(k, depth + 1)
    return J, sizes


def _without_rounding(matrices):
    """Matrices (m, n, N) without entries that are rounding errors beside the others of their rows and columns."""
    scaled = np.abs(matrices).astype(float)
    for axis in (1, 0):
        largest = scaled.max(axis=axis, keepdims=True)
        scaled /= np.where(largest > 0, largest, 1.0)
    return np.where(scaled <= ENTRY, 0.0, matrices)


def _response(jacobian, b, plant, bound, k, depth):
    """The change of the jets above the state per change of the inputs' coefficients, (n (N+1), k (N+1)).

    Coefficient by coefficient, so that no coefficient answers to a later input: the saddle point matrix of
    [γ_[i+2]; -μ_[i]] is the same for all.
    """
    total, n, size = b.shape[0], b.shape[1], depth + 1
    k_m = total - k
    rows = jacobian[[*plant, *bound]]
    order = [*(i * n + a for i in range(size) for a in range(n))]
    motion = np.zeros((n * size, k, size), dtype=np.longdouble)
    reaction = np.zeros((k_m, size, k, size), dtype=np.longdouble)
    for i in range(size):
        members = [*order[i * n : (i + 1) * n], *(n * size + i * k_m + m for m in range(k_m))]
        block = rows[members][:, i * n : (i + 1) * n]
        matrix = np.block([[block[:n], -b[k:, :, 0].T], [block[n:], np.zeros((k_m, k_m))]])
        right = np.zeros((n + k_m, k, size), dtype=np.longdouble)
        for j in range(i + 1):
            right[:n, :, j] += b[:k, :, i - j].T
            if j < i:
                right[:n] += np.einsum("am,mkl->akl", b[k:, :, i - j].T, reaction[:, j])
        right -= np.einsum("ac,ckl->akl", rows[members][:, : i * n], motion[: i * n])
        solution = solve_clean(matrix, right.reshape(n + k_m, -1)).reshape(n + k_m, k, size)
        motion[i * n : (i + 1) * n], reaction[:, i] = solution[:n], solution[n:]
    return motion.reshape(n * size, k * size)


def _local(J, k, depth):
    """The structure from J (k, N+1, k, N+1) at one point, or None where N is too small or J has no value."""
    if not np.all(np.isfinite(J)):
        return None
    size = depth + 1
    squares = [J[:, : N + 1, :, : N + 1].reshape(k * (N + 1), k * (N + 1)) for N in range(size)]
    ranks = [decide(square, INDEPENDENT) for square in squares]
    sigma = np.diff([0, *(rank.rank for rank in ranks)])
    if sigma[-1] < k:
        return None
    zeros = tuple(j for j, count in enumerate(np.diff([0, *sigma])) for _ in range(int(count)))
    degrees = tuple(int(np.flatnonzero(np.abs(J[i]).max(axis=(1, 2)) > 0)[0]) for i in range(k))
    decoupling = decide(np.array([J[i, r, :, 0] for i, r in enumerate(degrees)]), INDEPENDENT)
    essential = tuple(_essential(J, i, k, size) for i in range(k))
    margin = min(rank.kept for rank in (*ranks, decoupling))
    return Local(degrees, decoupling.rank, zeros, essential, 1 + max(zeros), float(margin))


def _essential(J, i, k, size):
    """The smallest c for which u is determined without the derivatives of residual i above c."""
    first = np.zeros((k, k, size))
    first[np.arange(k), np.arange(k), 0] = 1.0
    for c in range(size):
        without = np.array([J[a, j].ravel() for a in range(k) for j in range(size) if a != i or j <= c])
        both = np.vstack([without, first.reshape(k, -1)])
        if decide(both, INDEPENDENT).rank == decide(without, INDEPENDENT).rank:
            return c
    return size
