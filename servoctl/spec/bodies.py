"""Gibbs-Appell functions of particles (3.8) and rigid bodies (3.11)."""

import casadi as ca
import numpy as np

from servoctl.checks import column, matrix, require_kind
from servoctl.errors import SpecificationError
from servoctl.jets.identity import spread
from servoctl.spec.coordinates import Coordinates, require_order
from servoctl.tolerances import ENTRY


def particle(q: Coordinates, mass, position):
    """The Gibbs-Appell function of a particle, S = m a·a / 2 (3.8).

    Parameters
    ----------
    q : Coordinates
    mass : SX or float
        [kg]
    position : SX scalar, column or sequence
        Cartesian position in an inertial frame [m], one to three entries; a function of q and t.

    Returns
    -------
    SX scalar
        [N m/s^2]

    Raises
    ------
    SpecificationError
        If the position is no expression or depends on velocities.
    """
    require_kind(Coordinates, "q", q, 'sv.coordinates("x y")')
    position = ca.vertcat(*column(position, "the particle's position", 1, 2, 3))
    require_order(q, position, "the particle's position", 0)
    acceleration = q.dt(position, 2)
    (mass,) = column(mass, "the mass", 1)
    return mass * ca.dot(acceleration, acceleration) / 2


def rigid_body(q: Coordinates, mass, inertia, position=None, rotation=None, rates=None):
    """The Gibbs-Appell function of a rigid body (3.11), about its centre of mass or a fixed point.

    S = m a·a/2 + α·Jα/2 + α·(ω × Jω), with ω, α and J in the body's axes.

    Parameters
    ----------
    q : Coordinates
    mass : SX or float
        [kg]; 0 or `position=None` for a body that turns about a fixed point.
    inertia : (3, 3) or (3,) SX or sequence
        Inertia matrix, or its diagonal, about the centre of mass (or the fixed point), body axes [kg m^2].
    position : (2,) or (3,) SX or sequence, optional
        Position of the centre of mass in an inertial frame [m].
    rotation : (3, 3) SX, optional
        Rotation matrix R(q, t) from body to inertial axes; the body rates are taken from RᵀR'.
    rates : (3,) SX or sequence, optional
        Body rates ω [rad/s], along the body's axes, as expressions of the velocities; give this or `rotation`.

    Returns
    -------
    SX scalar

    Raises
    ------
    SpecificationError
        If neither or both of `rotation` and `rates` are given, a shape is wrong, or no rotation has these rates.
    """
    if (rotation is None) == (rates is None):
        raise SpecificationError(
            f"rigid_body got {'neither' if rates is None else 'both'} of rotation and rates.",
            "The body rates follow from one of them.",
            do="Pass rotation=R(q) or rates=ω(q, q').",
            both=rates is not None,
        )
    require_kind(Coordinates, "q", q, 'sv.coordinates("x y")')
    column(mass, "the mass", 1)
    omega = body_rates(q, rotation) if rates is None else ca.vertcat(*column(rates, "rates", 3))
    alpha, J = q.dt(omega), matrix(inertia, "the inertia", (3, 3), (3, 1), (1, 3))
    J = J if J.shape == (3, 3) else ca.diag(J)
    spin = ca.dot(alpha, J @ alpha) / 2 + ca.dot(alpha, ca.cross(omega, J @ omega))
    if rates is not None and q.order(J) < 0 and not ca.depends_on(J, q.t):
        _refuse_rates(q, omega, alpha, J)
    return spin if position is None else particle(q, mass, position) + spin


def body_rates(q: Coordinates, rotation):
    """Body rates ω [rad/s] of a rotation matrix R from body to inertial axes: RᵀR' is the cross product by ω.

    Parameters
    ----------
    q : Coordinates
    rotation : (3, 3) SX

    Returns
    -------
    (3,) SX
    """
    require_kind(Coordinates, "q", q, 'sv.coordinates("x y")')
    rotation = matrix(rotation, "the rotation", (3, 3))
    spin = rotation.T @ ca.reshape(q.dt(ca.vec(rotation)), 3, 3)
    return ca.vertcat(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]) / 2


def lagrange(q, kinetic):
    """Vᵀ(d/dt ∂T/∂q' - ∂T/∂q) of T(q, γ'), continued to all q' by w = V⁺(q' - h): (n,) SX."""
    w, v = ca.vertcat(*q.gamma(1)), ca.SX.sym("v", q.nq)
    if q.plain:
        momentum = ca.gradient(kinetic, w)
        slope = ca.gradient(kinetic, ca.vertcat(*q))
    else:
        square = q.n == q.nq  # normal equations have the square of its condition, as in metres and millimetres
        left = ca.solve(q.V, v - q.h) if square else ca.ldl_solve(q.V.T @ (v - q.h), *ca.ldl(q.V.T @ q.V))
        continued = ca.substitute(kinetic, w, left)
        back = q.V @ w + q.h
        momentum = ca.substitute(ca.gradient(continued, v), v, back)
        slope = ca.substitute(ca.gradient(continued, ca.vertcat(*q)), v, back)
    return q.V.T @ (q.dt(momentum) - slope)


def _refuse_rates(q, omega, alpha, J):
    """Refuse rates with which ∂S/∂γ'' of a body is not Lagrange's equation, where γ' spans the motions of q."""
    if q.nq - q.n != len(q.spheres):
        return
    acceleration, symbols = ca.vertcat(*q.gamma(2)), ca.vertcat(*ca.symvar(J))
    numbers = ca.Function("J", [symbols], [J])(np.random.default_rng(0).uniform(1.0, 2.0, symbols.numel())).full()
    if np.diff(np.linalg.eigvalsh(numbers)).min() > ENTRY * np.abs(numbers).max():  # else its axes may turn in the body
        J = ca.SX([[2.0, 0.3, 0.4], [0.3, 3.0, 0.5], [0.4, 0.5, 4.0]])
    gyroscopic = ca.gradient(ca.dot(alpha, ca.cross(omega, J @ omega)), acceleration)
    off = ca.gradient(ca.dot(alpha, J @ alpha) / 2, acceleration) + gyroscopic
    off = off - lagrange(q, ca.dot(omega, J @ omega) / 2)
    both = ca.horzcat(off, off - 2 * gyroscopic)
    body, mirrored = np.nan_to_num(spread(q.on_spheres(both).elements())).reshape(2, -1).any(axis=1)
    if body:
        raise SpecificationError(
            f"The rates are those along {'axes of no body' if mirrored else 'the inertial axes, or left-handed'}.",
            "Body rates ω = W q' of a rotation have ∂W_i/∂q_j - ∂W_j/∂q_i = W_i × W_j: S then agrees with ω·Jω/2.",
            do="Pass rotation=R, or the rates Rᵀω along the body's axes, which are right-handed.",
            inertial=not mirrored,
        )
