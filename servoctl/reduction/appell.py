"""Eq. (3.18): the balance on the virtual displacements on which the unknown reaction does no work.

The reaction is B μ. With the quasi-coordinates split into dependent ones D and independent ones I,
A = ∂γ_D/∂γ_I = -B_D⁻ᵀ B_Iᵀ and T = [A; 1] spans ker Bᵀ. For B = Gᵀ the rows of Tᵀ r = 0 are (3.18) as printed.
"""

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError
from servoctl.reduction.ranks import clean, decide_all, eliminate, equilibrate
from servoctl.values import frozen

NEGATIVE = 1e-9  # eigenvalues of a scaled inertia matrix below minus this are no rounding errors
NAMED = 1e-6  # components of a direction below this fraction of the largest are not named in an error


@frozen
class Realisation:
    """Who supplies the reaction B μ, and which quasi-coordinates depend on the others."""

    B: ca.SX  # (n, b), directions of the reaction: the program's first, then those of material constraints
    actuation: object  # (m, k) SX A, by which the first k multipliers give u = u_wish + A μ; None for an ideal program
    dependent: tuple  # indices of quasi-coordinates
    independent: tuple  # indices of the others
    numbers: np.ndarray  # (b, n, N), Bᵀ at the points where the split was chosen
    definite: bool = False  # whether μ follows from a definite matrix, whose pivots have no sign to change
    settled: tuple = ()  # where the program leaves actuation open, the rows that hold whichever is taken
    unreached: tuple = ()  # independent quasi-coordinates whose balance no actuator enters: the settled rows contain it

    def __repr__(self):
        return f"Realisation({self.B.shape[1]} directions, dependent coordinates {self.dependent})"

    def dynamics(self, balance):
        """Tᵀ r by independent coordinate, without unreached ones, and the pivots divided by, as in the multipliers."""
        virtual, pivots = self.virtual(balance)
        rows = zip(self.independent, virtual.elements(), strict=True)
        return {i: row for i, row in rows if i not in self.unreached}, pivots

    def virtual(self, forces):
        """Tᵀ f for columns f (n, columns) SX, (n - b, columns) SX, and the pivots divided by."""
        dependent, independent, transposed = list(self.dependent), list(self.independent), self.B.T
        if not dependent:
            return forces, []
        a, pivots = eliminate(transposed[:, dependent], -transposed[:, independent], self.numbers[:, dependent])
        return forces[independent, :] + a.T @ forces[dependent, :], [p for p in pivots if ca.symvar(p)]

    def multipliers(self, balance):
        """μ with B_D μ = r_D, (b,) SX."""
        rows = list(self.dependent)
        if not rows:
            return ca.SX(0, 1)
        return eliminate(self.B[rows, :], balance[rows], self.numbers[:, rows].swapaxes(0, 1))[0]


def saddle(mechanism, material):
    """[M G_mᵀ; G_m 0]."""
    n, k = mechanism.q.n, len(material)
    G = ca.vertcat(*(row.gradient(mechanism.q) for row in material)) if material else ca.SX(0, n)
    return ca.vertcat(ca.horzcat(mechanism.mass, G.T), ca.horzcat(G, ca.SX.zeros(k, k)))


def plant_solution(mechanism, material, forces, second, points):
    """[γ''; -λ] of [M G_mᵀ; G_m 0] [γ''; -λ] = [forces; second], (n + k, columns) SX; the pivots."""
    matrix = saddle(mechanism, material)
    numbers = clean(*points.matrix(matrix))
    return eliminate(matrix, ca.vertcat(forces, second), numbers)


def require_inertia(mechanism, material, points):
    """Refuse an inertia matrix that is negative, or singular on the displacements that material constraints allow.

    The SpecificationError names the coordinates of the direction without inertia, or with a negative one.
    """
    require_positive(mechanism, points)
    q, n = mechanism.q, mechanism.q.n
    values, sizes = points.matrix(saddle(mechanism, material))
    rank, best = decide_all(values, sizes)
    if rank.rank < len(values):
        cleaned = clean(values, sizes)[:, :, best].astype(float)
        null = np.linalg.svd(cleaned)[2][-1][:n]
        names = [q.jet_names(1)[i] for i in np.flatnonzero(np.abs(null) > NAMED * np.abs(null).max())]
        raise SpecificationError(
            f"The mass matrix is singular: a direction of {', '.join(names)} has no inertia.",
            "M = ∂²S/∂γ''² is positive definite on the displacements that material constraints allow.",
            do="Check the masses, the inertias and the values of their parameters, or remove a coordinate. The "
            "parameter of a path as a coordinate has unit inertia and an actuator.",
            names=names,
        )


def require_positive(mechanism, points):
    """Refuse an inertia matrix by which S is negative in a direction.

    The SpecificationError names the coordinates of the direction, and the parameters that are negative.
    """
    matrices = np.moveaxis(clean(*points.matrix(mechanism.mass)), 2, 0)
    scaled, rows, columns = equilibrate(matrices)
    size = np.sqrt(rows * columns)
    scaled = (size[:, :, None] * matrices * size[:, None, :]).astype(float)
    values, directions = np.linalg.eigh(scaled[np.isfinite(scaled).all(axis=(1, 2))])
    if not values.min(initial=0.0) < -NEGATIVE:
        return
    k = int(np.argmin(values[:, 0]))
    direction = np.abs(directions[k, :, 0])
    names = [mechanism.q.jet_names(1)[i] for i in np.flatnonzero(direction > NAMED * direction.max())]
    parameters = zip(mechanism.parameters.names, points.values, strict=True)
    negative = {name: float(value) for name, value in parameters if value < 0}
    listed = ", ".join(f"{name} = {value:g}" for name, value in negative.items())
    raise SpecificationError(
        f"The mass matrix is negative in a direction of {', '.join(names)}"
        + (f", with {listed}." if negative else "."),
        "M = ∂²S/∂γ''² is positive definite: masses and moments of inertia are positive.",
        do="Check the masses, the inertias and the values of their parameters.",
        names=names,
        negative=negative,
    )
