"""Elimination without a choice of pivots: the inertia first, then what the constraints feel of it.

The balance M γ'' = f + B μ and the constraints G γ'' = d give

    γ'' = M⁻¹f + M⁻¹B μ,    (G M⁻¹B) μ = d - G M⁻¹f.

With an ideal reaction, B = Gᵀ, and with the least actuation, B = E W⁻¹(G M⁻¹E)ᵀ, the matrix G M⁻¹B is symmetric and
positive definite like M, wherever the rows are independent. Elimination by the diagonal is then stable in any order.
With other actuators its rows are made orthogonal. Either way a pivot vanishes only where the rank is lost: no
coordinates are chosen as dependent, and no motion leaves the choice behind (range-space method: Benzi, Golub and
Liesen, Acta Numerica 14 (2005), section 5).
"""

from dataclasses import field, replace

import casadi as ca
import numpy as np

from servoctl.reduction.appell import NEGATIVE, Realisation
from servoctl.reduction.ranks import clean, decide_all, eliminate, orthogonal
from servoctl.values import frozen

OF_CHOICE = "choice of dependent"  # in the names of pivots by which the balances on virtual displacements divide


@frozen
class RangeSpace(Realisation):
    """A reaction whose multipliers follow from the matrix G M⁻¹B; no coordinate is dependent."""

    G: ca.SX = None  # (b, n), leading gradients of the constraints, in the order of the columns of B
    mass: ca.SX = None  # (n, n)
    order: tuple = ()  # of the constraints in the elimination: material ones first
    sizes: tuple = field(default=(), repr=False)  # M (n, n, N) and G M⁻¹B (b, b, N) at points

    def solve(self, force, second):
        """γ'' (n, 1) and μ (b, 1) of M γ'' = force + B μ, G γ'' = second, and pivots of the size of singular values."""
        b, order = self.B.shape[1], list(self.order)
        moved, pivots = eliminate(self.mass, ca.horzcat(self.B, force), self.sizes[0], diagonal=True)
        felt = self.G @ moved
        system = felt[order, order], (second - felt[:, b])[order], self.sizes[1][np.ix_(order, order)]
        mu, others = eliminate(*system, diagonal=True) if self.definite else orthogonal(*system)
        mu = mu[np.argsort(order).tolist()]
        squares = [*pivots, *others] if self.definite else pivots
        roots = [ca.sign(p) * ca.sqrt(ca.fabs(p)) for p in squares]
        return moved[:, b] + moved[:, :b] @ mu, mu, roots if self.definite else [*roots, *others]

    def multipliers(self, balance):
        """μ with B μ = r, (b,) SX, as M γ'' = B μ - r has the solution γ'' = 0."""
        return self.solve(-balance, ca.SX.zeros(self.B.shape[1]))[1] if len(self.order) else ca.SX(0, 1)


def applies(reduction):
    """Whether the balance and the constraints determine γ'': s̄ = 2, and no row of (3.18) is differentiated."""
    dynamics = [row for row in reduction.rows if row.kind == "dynamics"]
    return reduction.top == 2 and all(row.order == 2 and not row.derivation for row in dynamics)


def without_choice(reduction):
    """The same rows, and systems that are solved without a choice of pivots: the inertia first, or orthogonal rows."""
    cascade = reduction.cascade and replace(reduction.cascade, orthogonal=True)
    return replace(_by_inertia(reduction) or reduction, orthogonal=True, cascade=cascade)


def _by_inertia(reduction):
    """The reduction by `RangeSpace`; None where M is not definite at its points, or the constraints give γ'' alone."""
    r, q = reduction, reduction.mechanism.q
    constraints = [row for row in r.rows if row.kind != "dynamics"]
    k, B = sum(row.kind == "program" for row in constraints), r.realisation.B
    if not (r.free and r.cascade is None and applies(r) and len(constraints) == B.shape[1] > 0 and len(r.points.t)):
        return None
    order = (*range(k, len(constraints)), *range(k))
    G, mass = ca.vertcat(*(row.gradient(q) for row in constraints)), r.mechanism.mass
    M, left, right = (np.moveaxis(clean(*r.points.matrix(m)), 2, 0).astype(float) for m in (mass, G, B))
    if not _definite(M):
        return None
    felt = left @ np.linalg.solve(M, right)
    sizes = tuple(np.moveaxis(m, 0, 2) for m in (M, felt))
    if decide_all(sizes[1], np.abs(sizes[1]))[0].rank < len(order):
        return None
    definite = _definite_by_blocks(felt[:, order][:, :, order], len(order) - k)
    kinds = {"B": B, "actuation": r.realisation.actuation, "dependent": (), "independent": tuple(range(q.n))}
    form = {"G": G, "mass": mass, "definite": definite, "order": order, "sizes": sizes}
    pivots = tuple((name, pivot) for name, pivot in r.pivots if not name.startswith(OF_CHOICE))
    return replace(r, realisation=RangeSpace(**kinds, numbers=r.realisation.numbers, **form), pivots=pivots)


def _definite_by_blocks(matrices, m):
    """Whether the first m rows and columns of matrices (N, b, b), and what elimination by them leaves, are definite."""
    first, rest = matrices[:, :m, :m], matrices[:, m:, m:]
    if m:
        if not _definite(first):
            return False
        rest = rest - matrices[:, m:, :m] @ np.linalg.solve(first, matrices[:, :m, m:])
    return _definite(rest)


def _definite(matrices):
    """Whether matrices (N, m, m) are symmetric and positive definite."""
    diagonal = np.einsum("pii->pi", matrices)
    if not (diagonal > 0).all():
        return False
    sizes = np.sqrt(diagonal)
    scaled = matrices / sizes[:, :, None] / sizes[:, None, :]
    if not np.isfinite(scaled).all() or np.abs(scaled - scaled.swapaxes(1, 2)).max(initial=0.0) > NEGATIVE:
        return False
    return bool(np.linalg.eigvalsh(scaled).min(initial=1.0) > NEGATIVE)
