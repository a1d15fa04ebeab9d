"""Inertia of bodies: with symbols in place of numbers, and refused where no distribution of mass has it."""

import casadi as ca
import numpy as np

from servoctl.checks import named
from servoctl.errors import SpecificationError
from servoctl.robots.description import Inertial
from servoctl.robots.joints import identifier
from servoctl.spec.parameters import Parameters

TRIANGLE = 1e-6  # part of the largest principal moment by which it may exceed the sum of the others: rounded files
NEGATIVE = 1e-9  # part of the largest principal moment below zero that is rounding


def with_symbols(description, links):
    """Parameters of symbolic links, and the inertia of all links."""
    inertials, numbers, names = dict(description.links), {}, set()
    for link in links:
        if named(link, inertials, "link") not in numbers:
            names.add(name := identifier(link, names))
            numbers[link] = {f"{name}_{key}": value for key, value in _numbers_of(inertials[link]).items()}
    parameters = Parameters({name: value for own in numbers.values() for name, value in own.items()})
    for link, values in numbers.items():
        own = [getattr(parameters, name) for name in values]
        mass, centre, (ixx, ixy, ixz, iyy, iyz, izz) = own[0], ca.vertcat(*own[1:4]), own[4:]
        inertia = ca.vertcat(ca.horzcat(ixx, ixy, ixz), ca.horzcat(ixy, iyy, iyz), ca.horzcat(ixz, iyz, izz))
        inertials[link] = Inertial(mass, ca.SX.zeros(3), inertia).moved(ca.DM.eye(3), centre)
    return parameters, inertials


def _numbers_of(inertial):
    """Mass, centre of mass and inertia about it."""
    mass = float(inertial.mass)
    centre = np.zeros(3) if not mass else np.array(inertial.moment).ravel() / mass
    inertia = np.array(inertial.inertia) - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    moments = {f"i{'xyz'[i]}{'xyz'[j]}": float(inertia[i, j]) for i in range(3) for j in range(i, 3)}
    return {"mass": mass, **dict(zip(("cx", "cy", "cz"), map(float, centre), strict=True)), **moments}


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
    followed = {body.mimic[0] for body, moves in zip(tree.bodies, carried, strict=True) if body.mimic and moves}
    for body, moves in zip(tree.bodies, carried, strict=True):
        if moves or body.mimic or body.joint and body.joint.name in followed:
            continue
        name = body.joint.name if body.joint else None
        raise SpecificationError(
            f"The {f'joint {name!r}' if name else 'free base'} moves no mass: neither link {body.name!r} nor what "
            "hangs on it has inertia.",
            "Each degree of freedom has inertia.",
            do="Give a link an <inertial>" + (f", or lock the joint, lock={{{name!r}: 0.0}}." if name else "."),
            joint=name,
        )


def _refuse_inertia(body, mass, moment, inertia):
    if not (np.isfinite(mass) and np.isfinite(moment).all() and np.isfinite(inertia).all()):
        raise SpecificationError(
            f"The inertia of the body of link {body.name!r} is beyond the range of numbers.",
            "Mass, first moment and inertia about the joint are finite in double precision.",
            do="Correct the numbers of its links, in kg and m.",
            link=body.name,
        )
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
