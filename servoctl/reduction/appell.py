"""Eq. (3.18): the balance on the virtual displacements on which the unknown reaction does no work.

The reaction is B μ. With the quasi-coordinates split into dependent ones D and independent ones I,
A = ∂γ_D/∂γ_I = -B_D⁻ᵀ B_Iᵀ and T = [A; 1] spans ker Bᵀ. For B = Gᵀ the rows of Tᵀ r = 0 are (3.18) as printed.
"""

from dataclasses import dataclass, replace
from itertools import combinations, islice

import casadi as ca
import numpy as np

from servoctl.errors import NotRealisable, SpecificationError, unknown
from servoctl.reduction.ranks import clean, decide_all, decide_each, eliminate, equilibrate

NEGATIVE = 1e-9  # eigenvalues of a scaled inertia matrix below minus this are no rounding errors
NAMED = 1e-6  # components of a direction below this fraction of the largest are not named in an error
SPLITS = 100  # choices of dependent coordinates that are tried where the first leads to a contradiction
LONGEST_SEARCH = 2  # times n: no relative degree exceeds the number of plant states


@dataclass(frozen=True)
class Realisation:
    """Who supplies the reaction B μ, and which quasi-coordinates depend on the others.

    Attributes
    ----------
    B : (n, b) SX
        Directions of the reaction: the program's first, then those of material constraints.
    actuation : (m, k) SX or None
        Matrix by which the first k multipliers give u; None for an ideal program.
    dependent, independent : tuple of int
        Indices of the quasi-coordinates.
    numbers : (b, n, N) array
        Bᵀ at the points where the split was chosen.
    decided : tuple of Row
        Rows whose relative degrees weight redundant actuators.
    """

    B: ca.SX
    actuation: object
    dependent: tuple
    independent: tuple
    numbers: np.ndarray
    decided: tuple = ()

    def __repr__(self):
        return f"Realisation({self.B.shape[1]} directions, dependent coordinates {self.dependent})"

    def dynamics(self, balance):
        """Tᵀ r, one SX scalar per independent coordinate, and the pivots divided by, here and in the multipliers."""
        if not self.dependent:
            return ca.vertsplit(balance[list(self.independent)]), []
        transposed = self.B.T
        a, pivots = eliminate(
            transposed[:, list(self.dependent)],
            -transposed[:, list(self.independent)],
            self.numbers[:, list(self.dependent)],
        )
        virtual = zip(self.independent, (a.T @ balance[list(self.dependent)]).elements(), strict=True)
        return [balance[i] + reaction for i, reaction in virtual], [p for p in pivots if ca.symvar(p)]

    def splits(self):
        """Splits into dependent and independent coordinates: the chosen one, and others regular at some points."""
        yield self
        every = range(self.B.shape[0])
        for dependent in islice(combinations(every, len(self.dependent)), SPLITS):
            ranks = decide_each(self.numbers[:, list(dependent)])
            regular = [p for p, rank in enumerate(ranks) if rank.rank == len(dependent)]
            if regular and dependent != self.dependent:
                independent = tuple(i for i in every if i not in dependent)
                numbers = self.numbers[:, :, regular]
                yield replace(self, dependent=dependent, independent=independent, numbers=numbers)

    def multipliers(self, balance):
        """μ with B_D μ = r_D, (b,) SX."""
        rows = list(self.dependent)
        if not rows:
            return ca.SX(0, 1)
        return eliminate(self.B[rows, :], balance[rows], self.numbers[:, rows].swapaxes(0, 1))[0]


def realisation(mechanism, program, constraints, points):
    """The realisation of a program by ideal reactions or by the mechanism's actuators.

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
    constraints : list of Row
        Program rows and material rows, the latter of full row rank.
    points : Points
        Points on the manifold of the constraints.

    Returns
    -------
    Realisation

    Raises
    ------
    NotRealisable
        If the residuals outnumber the independent actuators, or the actuators cannot move them independently.
    """
    q = mechanism.q
    G, G_m = (
        ca.vertcat(ca.SX(0, q.n), *(row.gradient(q) for row in constraints if row.kind == kind))
        for kind in ("program", "material")
    )
    if program.by == "ideal":
        directions, actuation, decided = G.T, None, ()
    else:
        directions, actuation, decided = _actuator_directions(mechanism, program, constraints, points)
    B = ca.horzcat(directions, G_m.T)
    numbers, sizes = points.matrix(B.T)
    rank, best = decide_all(numbers, sizes)
    if rank.rank < B.shape[1]:
        raise NotRealisable(
            f"The directions of the actuators {', '.join(mechanism.actuators)} and of the material constraints are "
            f"dependent (rank {rank.rank} of {B.shape[1]}).",
            "Actuators and material constraints act in independent directions.",
            do="Remove an actuator or a constraint.",
            actuators=list(mechanism.actuators),
            rank=rank.rank,
            directions=B.shape[1],
        )
    dependent = tuple(sorted(rank.columns))
    independent = tuple(i for i in range(q.n) if i not in dependent)
    cleaned = clean(numbers, sizes)
    regular = [p for p, rank in enumerate(decide_each(cleaned[:, list(dependent)])) if rank.rank == len(cleaned)]
    return Realisation(B, actuation, dependent, independent, cleaned[:, :, regular or [best]], decided)


def _actuator_directions(mechanism, program, constraints, points):
    """E, or E W⁻¹Pᵀ where there are more actuators than residuals; the matrix of the actuation; the rows behind P.

    With as many independent actuators as residuals, as for two motors on one trolley, the program determines E u; P is
    then any matrix with the row space of E, and W⁻¹Pᵀμ the u of least norm.
    """
    q = mechanism.q
    k, m = len(program.residuals), len(mechanism.actuators)
    material = [row for row in constraints if row.kind == "material"]
    both = ca.horzcat(mechanism.E, *(row.gradient(q).T for row in material))
    rank = decide_all(*points.matrix(both.T))[0].rank if both.shape[1] else 0
    independent = rank - len(material)
    if k > independent:
        raise NotRealisable(
            f"The program has {k} residual{'s' * (k != 1)} ({', '.join(program.residuals)}), and the mechanism "
            f"{independent} independent actuators ({', '.join(mechanism.actuators) or 'none'}).",
            "A program needs at least as many independent actuators as residuals.",
            nearest=f"{independent} residuals, or by='ideal'." if independent else "by='ideal'.",
            do="Add actuators or remove residuals.",
            residuals=list(program.residuals),
            actuators=list(mechanism.actuators),
            independent=independent,
        )
    unknown_weights = [w for w in program.weights if w not in mechanism.actuators]
    if unknown_weights:
        raise unknown(unknown_weights[0], mechanism.actuators, "actuator")
    if k == m:
        return mechanism.E, ca.SX.eye(m), ()
    inverse_weights = ca.diag(ca.vertcat(*(1 / ca.SX(program.weights.get(name, 1.0)) for name in mechanism.actuators)))
    if k == independent:
        actuation = inverse_weights @ _row_space(mechanism, material, points, k).T
        return mechanism.E @ actuation, actuation, ()
    P, decided = decoupling(mechanism, [row for row in constraints if row.kind == "program"], material, points)
    rank_P = decide_all(*points.matrix(P))[0].rank
    if rank_P < k:
        raise NotRealisable(
            f"The decoupling matrix has rank {rank_P} for {k} residuals and {m} actuators.",
            "Redundant actuators are weighted at each instant, which needs a decoupling matrix of full row rank.",
            nearest=f"{k} actuators, for which hidden constraints are derived.",
            do="Remove actuators, or program other outputs.",
            residuals=list(program.residuals),
            actuators=list(mechanism.actuators),
            rank=rank_P,
        )
    actuation = inverse_weights @ P.T
    return mechanism.E @ actuation, actuation, decided


def _row_space(mechanism, material, points, k):
    """k independent rows of E, beside material rows of N E: what the inputs do to the motion, (k, m) SX."""
    rows = mechanism.E
    if material:
        rows, _ = plant_accelerations(mechanism, material, rows, ca.SX.zeros(len(material), rows.shape[1]), points)
    return rows[sorted(decide_all(*points.matrix(rows))[0].rows[:k]), :]


def decoupling(mechanism, rows, material, points):
    """P = ∂φ^(r)/∂u (k, m), with each residual differentiated along the plant until the actuation appears; the rows.

    For relative degree 2 P = G N E with N = M⁻¹, or T_m(T_mᵀMT_m)⁻¹T_mᵀ beside material rows.
    """
    q = mechanism.q
    acceleration = q.jet(2)
    rest = ca.substitute(mechanism.balance, acceleration, ca.SX.zeros(q.n))
    second = ca.vertcat(*(q.derivatives([row.expression], 2 - row.order)[-1][0] for row in material))
    second = ca.substitute(second, acceleration, ca.SX.zeros(q.n)) if material else ca.SX(0, 1)
    still = ca.SX.zeros(len(material), mechanism.E.shape[1])
    moves, _ = plant_accelerations(mechanism, material, mechanism.E, still, points)
    drift, _ = plant_accelerations(mechanism, material, -rest, -second, points)
    result, decided = [], []
    for row in rows:
        expression = q.derivatives([row.expression], max(0, 2 - row.order))[-1][0] if row.order < 2 else row.expression
        level = max(row.order, 2)
        for _ in range(LONGEST_SEARCH * q.n):
            coefficients = ca.jacobian(expression, q.jet(level)) @ moves
            if np.any(clean(*points.matrix(coefficients))) or level > 2:
                break
            row = row.resting_on(coefficients.T, ca.SX.ones(coefficients.numel()))
            expression = q.derivatives([ca.substitute(expression, acceleration, drift)], 1)[-1][0]
        result.append(coefficients)
        decided.append(row)
    return ca.cse(ca.vertcat(*result)), tuple(decided)


def _saddle(mechanism, material):
    """[M G_mᵀ; G_m 0]."""
    n, k = mechanism.q.n, len(material)
    G = ca.vertcat(*(row.gradient(mechanism.q) for row in material)) if material else ca.SX(0, n)
    return ca.vertcat(ca.horzcat(mechanism.mass, G.T), ca.horzcat(G, ca.SX.zeros(k, k)))


def plant_accelerations(mechanism, material, forces, second, points):
    """γ'' of the plant, the upper part of [M G_mᵀ; G_m 0] [γ''; -λ] = [forces; second], (n, columns) SX; the pivots."""
    matrix = _saddle(mechanism, material)
    numbers = clean(*points.matrix(matrix))
    solution, pivots = eliminate(matrix, ca.vertcat(forces, second), numbers)
    return solution[: mechanism.q.n, :], pivots


def require_inertia(mechanism, material, points):
    """Refuse an inertia matrix that is negative, or singular on the displacements that material constraints allow.

    Raises
    ------
    SpecificationError
        Naming the coordinates of the direction without inertia, or with a negative one.
    """
    require_positive(mechanism, points)
    q, n = mechanism.q, mechanism.q.n
    values, sizes = points.matrix(_saddle(mechanism, material))
    rank, best = decide_all(values, sizes)
    if rank.rank < len(values):
        cleaned = clean(values, sizes)[:, :, best].astype(float)
        null = np.linalg.svd(cleaned)[2][-1][:n]
        names = [q.jet_names(1)[i] for i in np.flatnonzero(np.abs(null) > NAMED * np.abs(null).max())]
        raise SpecificationError(
            f"The mass matrix is singular: a direction of {', '.join(names)} has no inertia.",
            "M = ∂²S/∂γ''² is positive definite on the displacements that material constraints allow.",
            do="Check the masses, the inertias and the values of their parameters, or remove a coordinate.",
            names=names,
        )


def require_positive(mechanism, points):
    """Refuse an inertia matrix by which S is negative in a direction.

    Raises
    ------
    SpecificationError
        Naming the coordinates of the direction, and the parameters that are negative.
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
    parameters = zip(points.parameters, points.values, strict=True)
    negative = {symbol.name(): float(value) for symbol, value in parameters if value < 0}
    listed = ", ".join(f"{name} = {value:g}" for name, value in negative.items())
    raise SpecificationError(
        f"The mass matrix is negative in a direction of {', '.join(names)}"
        + (f", with {listed}." if negative else "."),
        "M = ∂²S/∂γ''² is positive definite: masses and moments of inertia are positive.",
        do="Check the masses, the inertias and the values of their parameters.",
        names=names,
        negative=negative,
    )
