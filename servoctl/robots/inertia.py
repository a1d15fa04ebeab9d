"""Inertia of bodies: with symbols in place of numbers, and refused where no distribution of mass has it."""

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError, unknown
from servoctl.robots.description import Inertial
from servoctl.robots.joints import identifier
from servoctl.spec.parameters import Parameters

TRIANGLE = 1e-6  # part of the largest principal moment by which it may exceed the sum of the others: rounded files
NEGATIVE = 1e-9  # part of the largest principal moment below zero that is rounding


def with_symbols(description, links):
    """Parameters of symbolic links, and the inertia of all links."""
    inertials, defaults = dict(description.links), {}
    for link in links:
        if link not in inertials:
            raise unknown(link, inertials, "link")
        defaults |= _numbers_of(link, inertials[link])
    parameters = Parameters(defaults)
    for link in links:
        own = [getattr(parameters, name) for name in _numbers_of(link, inertials[link])]
        mass, centre, (ixx, ixy, ixz, iyy, iyz, izz) = own[0], ca.vertcat(*own[1:4]), own[4:]
        inertia = ca.vertcat(ca.horzcat(ixx, ixy, ixz), ca.horzcat(ixy, iyy, iyz), ca.horzcat(ixz, iyz, izz))
        inertials[link] = Inertial(mass, ca.SX.zeros(3), inertia).moved(ca.DM.eye(3), centre)
    return parameters, inertials


def _numbers_of(link, inertial):
    """Mass, centre of mass and inertia about it of a link, by the names of their parameters."""
    base, mass = identifier(link), float(inertial.mass)
    centre = np.zeros(3) if not mass else np.array(inertial.moment).ravel() / mass
    inertia = np.array(inertial.inertia) - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    moments = {f"i{'xyz'[i]}{'xyz'[j]}": float(inertia[i, j]) for i in range(3) for j in range(i, 3)}
    numbers = {"mass": mass, **dict(zip(("cx", "cy", "cz"), map(float, centre), strict=True)), **moments}
    return {f"{base}_{key}": value for key, value in numbers.items()}


def require_possible(tree, parameters):
    """Refuse bodies that no distribution of mass has, and joints that move no mass."""
    numbers = ca.DM(list(parameters.defaults.values()))
    carried = [False] * len(tree.bodies)
    for i in reversed(range(len(tree.bodies))):
        body = tree.bodies[i]
        parts = [ca.SX(part) for part in (body.inertial.mass, body.inertial.moment, body.inertial.inertia)]
        mass, moment, inertia = (
            np.array(value)
            for value in ca.Function("f", [ca.vertcat(ca.SX(0, 1), *parameters.symbols)], parts).call([numbers])
        )
        _refuse_inertia(body, mass.item(), moment.ravel(), inertia)
        carried[i] = carried[i] or bool(mass.item() or inertia.any())
        if body.parent is not None:
            carried[body.parent] = carried[body.parent] or carried[i]
        if not carried[i]:
            raise SpecificationError(
                f"The joint {body.joint!r} moves no mass: neither link {body.name!r} nor what hangs on it has inertia.",
                "Each degree of freedom has inertia.",
                do=f"Lock it, lock={{{body.joint!r}: 0.0}}, or give a link an <inertial>.",
                joint=body.joint,
            )


def _refuse_inertia(body, mass, moment, inertia):
    centre = moment / mass if mass else np.zeros(3)
    about = inertia - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    principal, axes = np.linalg.eigh((about + about.T) / 2)
    excess = principal[2] - principal[0] - principal[1]
    if principal[0] >= -NEGATIVE * abs(principal[2]) and excess <= TRIANGLE * abs(principal[2]):
        return
    spread = np.maximum(principal.sum() / 2 - principal, 0.0)  # of mass along the principal axes
    possible = axes @ np.diag(spread.sum() - spread) @ axes.T
    values = ", ".join(f"i{'xyz'[i]}{'xyz'[j]}={possible[i, j]:.4g}" for i in range(3) for j in range(i, 3))
    raise SpecificationError(
        f"The body of link {body.name!r} has the principal moments of inertia {principal[0]:.4g}, {principal[1]:.4g}, "
        f"{principal[2]:.4g} kg m^2 about its centre of mass.",
        "None is negative, and each is at most the sum of the two others; links on fixed joints count as one body.",
        f"{values}.",
        do="Correct the <inertia> of its links.",
        link=body.name,
        principal=principal.tolist(),
        possible=possible.tolist(),
    )
