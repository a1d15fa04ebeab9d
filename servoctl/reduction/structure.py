"""Differentiation index, relative degrees, zeros at infinity and essential orders, decided numerically.

Along a motion, J_N = ∂(φ, ..., φ^(N))/∂(u, ..., u^(N)) on the plant's jets has the ranks R_N; σ_N = R_N - R_(N-1) is
the number of zeros at infinity of order at most N. Everything is computed with normalised Taylor coefficients,
which changes no rank.
"""

from collections import Counter
from dataclasses import dataclass, replace
from math import factorial

import casadi as ca
import numpy as np

from servoctl.jets.series import Flow
from servoctl.reduction.manifold import solve
from servoctl.reduction.ranks import clean, decide, solve_clean
from servoctl.reduction.rows import Row

INDEPENDENT = 1e-7  # equilibrated pivots of J above this count
AT_REST = 1e-13  # a jet below this fraction of the largest is zero, not small
DEPTHS = (2, 4, 6, 8, 12, 16, 24, 32)  # values of N, tried until J_N shows all zeros at infinity


@dataclass(frozen=True)
class Local:
    """The structure at one point of a motion; attributes as in `Structure`."""

    relative_degree: tuple
    decoupling_rank: int
    zeros_at_infinity: tuple
    essential_orders: tuple
    index: int
    margin: float


@dataclass(frozen=True)
class Structure:
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
        Smallest equilibrated pivot that counts in any of the ranks.
    realisation : {"orthogonal", "mixed", "tangential", "undecided", "ideal"}
        Rank of P full, between, or zero; "undecided" if the largest N does not show all zeros at infinity.
    at : tuple of (float, Local)
        The structure at each instant [s].
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

    @property
    def uniform(self):
        """Whether the structure is the same at every instant."""
        return len({replace(local, margin=0.0) for _, local in self.at}) <= 1

    def __repr__(self):
        k = len(self.residuals)
        if self.index is None and not self.zeros_at_infinity:
            return "Structure: not computed; index and relative degrees are defined for residuals of order 0, 1 or 2"
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
        if not self.uniform:
            typical = _most_common([local for _, local in self.at])
            other = [(t, a) for t, a in self.at if replace(a, margin=0.0) != typical]
            lines.append(
                f"  it differs at {len(other)} of {len(self.at)} instants, first t = {other[0][0]:.4g} s: relative "
                f"degrees {other[0][1].relative_degree}, zeros at infinity {other[0][1].zeros_at_infinity}"
            )
        return "\n".join(lines)


def structure(reduction, t=None, jets=None, values=None):
    """Decide index, relative degrees, zeros at infinity and essential orders at points of a motion.

    Parameters
    ----------
    reduction : Reduction
    t : (N,) array, optional
        Instants of a motion [s]; default: the seeded points of the reduction.
    jets : (n_z, N) array, optional
        q, γ', ..., γ^(s̄) there.
    values : (n_p,) array, optional
        Parameters.

    Returns
    -------
    Structure
    """
    names = tuple(reduction.program.residuals)
    orders = [reduction.original[name].order for name in names]
    if reduction.program.by == "ideal" or max(orders) > 2:
        return _by_orders(reduction, names, orders)
    points = reduction.points if t is None else _points(reduction, t, jets, values)
    locals_ = _locals(reduction, points)
    typical = _most_common(locals_)
    rank_P = typical.decoupling_rank if any(r <= 2 for r in typical.relative_degree) else 0
    kind = "orthogonal" if rank_P == len(names) else "tangential" if rank_P == 0 else "mixed"
    kind = kind if typical.relative_degree else "undecided"
    margin = min(local.margin for local in locals_)
    at = tuple(zip(np.asarray(points.t, dtype=float).tolist(), locals_, strict=True))
    return Structure(
        names, typical.relative_degree, typical.decoupling_rank, typical.zeros_at_infinity, typical.essential_orders,
        typical.index, margin, kind, at,
    )  # fmt: skip


def _most_common(locals_):
    return Counter(replace(local, margin=0.0) for local in locals_).most_common(1)[0][0]


def _by_orders(reduction, names, orders):
    """Ideal programs: the reaction acts through G, so residuals of order s <= 2 meet it after 2 - s derivatives."""
    degrees = tuple(max(0, 2 - s) for s in orders)
    plain = reduction.program.by == "ideal" and max(orders) <= 2 and not reduction.hidden
    index = 1 + max(degrees) if plain else None
    return Structure(
        names, degrees, len(names) if plain else 0, tuple(sorted(degrees)) if plain else (),
        degrees if plain else (), index, reduction.rank.kept, "ideal", (),
    )  # fmt: skip


def _points(reduction, t, jets, values):
    """Points of a motion from its samples."""
    q, z = reduction.mechanism.q, np.array(jets, dtype=np.longdouble)
    for k in range(1, (len(z) - q.nq) // q.n + 1):
        z[q.nq + (k - 1) * q.n : q.nq + k * q.n] /= factorial(k)
    sample = reduction.points
    values = sample.values if values is None else values
    return replace(sample, t=np.asarray(t, dtype=np.longdouble), z=z, values=values, residual=np.zeros(len(t)))


def _locals(reduction, points):
    for depth in DEPTHS:
        locals_ = _at_depth(reduction, points, depth)
        if locals_ is not None:
            return locals_
    return [Local((), 0, (), (), None, 0.0)] * len(points.t)


def _at_depth(reduction, points, depth):
    """The structure at each point from J_N with N = depth, or None where N is too small."""
    q, k = reduction.mechanism.q, len(reduction.program.residuals)
    level = depth + 2
    z = np.zeros((q.nq + level * q.n, len(points.t)), dtype=np.longdouble)
    shared = min(len(z), len(points.z))
    z[:shared] = points.z[:shared]
    flow = Flow(q, reduction.rows, level, points)
    z, _ = solve(flow, points.t, z)
    for part in (z[: q.nq], z[q.nq :]):
        part[np.abs(part) < AT_REST * np.maximum(1.0, np.abs(part).max(axis=0))] = 0.0
    result = []
    for J in np.moveaxis(clean(*_input_jacobian(reduction, points, z, depth)), -1, 0):
        result.append(_local(J, k, depth))
        if result[-1] is None:
            return None
    return result


def _input_jacobian(reduction, points, z, depth):
    """J and the sizes of its entries, (k, N+1, k, N+1, points): coefficient j of row i by coefficient l of input a."""
    mechanism, q = reduction.mechanism, reduction.mechanism.q
    k, level, n_points = len(reduction.program.residuals), depth + 2, len(points.t)
    B = reduction.realisation.B
    inputs = ca.SX.sym("u", B.shape[1])
    material = [row for row in reduction.original.values() if row.kind == "material"]
    program = [reduction.original[name] for name in reduction.program.residuals]
    flow = Flow(q, [], level, points)
    series = flow.series(ca.vertcat(reduction.multipliers, ca.vec(ca.densify(B))).elements(), points.t, z, depth)
    u, b = series[: B.shape[1]], series[B.shape[1] :].reshape(B.shape[1], q.n, depth + 1, n_points)
    signals = {s.element_hash(): [u[i, j] for j in range(depth + 1)] for i, s in enumerate(inputs.elements())}
    balance = (mechanism.balance - B @ inputs).elements()
    rows = [
        *(Row(e, 2, name, "dynamics") for name, e in zip(q.jet_names(1), balance, strict=True)),
        *material,
        *program,
    ]
    flow = Flow(q, rows, level, points, signals, real=np.longdouble)
    _, jacobian = flow(points.t, z)
    columns = slice(q.nq + q.n, None)
    place = {equation: e for e, equation in enumerate(flow.equations)}
    plant = [place[a, i] for i in range(depth + 1) for a in range(q.n)]
    bound = [place[q.n + m, i + 2 - row.order] for i in range(depth + 1) for m, row in enumerate(material)]
    first = q.n + len(material)
    J = np.zeros((k, depth + 1, k, depth + 1, n_points), dtype=np.longdouble)
    sizes = np.zeros_like(J)
    for p in range(n_points):
        motion = _response(jacobian[:, columns, p], b[..., p], plant, bound, k, depth)
        for i in range(k):
            for j in range(depth + 1):
                if (first + i, j) in place:
                    row = jacobian[place[first + i, j], columns, p]
                    J[i, j, ..., p] = (row @ motion).reshape(k, depth + 1)
                    sizes[i, j, ..., p] = (np.abs(row) @ np.abs(motion)).reshape(k, depth + 1)
    return J, sizes


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
    """The structure from J (k, N+1, k, N+1) at one point, or None where N is too small."""
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
