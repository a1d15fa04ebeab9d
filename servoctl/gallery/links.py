"""Arms of n equal links whose end point is guided ideally: a plane one and a spatial one.

Each comes in joint angles, where the inertia matrix is full, or in coordinates of each body with the joints as
material constraints, where everything is sparse and operation counts grow like n.
"""

from itertools import accumulate

import casadi as ca

import servoctl as sv
from servoctl.errors import SpecificationError, unknown

COORDINATES = ("joints", "bodies")


def planar_arm(n=3, coordinates="joints", acceleration=(0.0, 0.0)):
    """n homogeneous rods hang in a vertical plane; an ideal reaction programs the acceleration of the last one's end.

    Parameters
    ----------
    n : int
        Number of links, at least 2.
    coordinates : {"joints", "bodies"}
        The joint angles theta1, theta2, ... [rad], the first from the horizontal; or x1, y1, phi1, x2, ...: each rod's
        centre [m] and inclination [rad], with material constraints "joint 1 x", "joint 1 y", ...
    acceleration : (2,) sequence of float
        Of the end point [m/s²]. The residuals are of second order: its position and velocity at the start are free.

    Returns
    -------
    Mechanism, Program
        Ideal realisation: residuals "X", "Y". Outputs "X", "Y" of the end point [m], y up.

    Raises
    ------
    SpecificationError
        If there are fewer than two links.
    NameUnknown
        If the coordinates are named otherwise.
    """
    _check(n, coordinates, 2)
    p = _parameters()
    if coordinates == "joints":
        q = sv.coordinates(_names("theta", n), units="rad " * n)
        inclinations, centres = list(accumulate(q)), None
    else:
        q = sv.coordinates(_names("x y phi", n), units="m m rad " * n)
        xs, ys, inclinations = (list(q)[i::3] for i in range(3))
        centres = [ca.vertcat(x, y) for x, y in zip(xs, ys, strict=True)]
    halves = [p.l / 2 * ca.vertcat(ca.cos(phi), ca.sin(phi)) for phi in inclinations]
    joint, constraints = ca.SX.zeros(2), {}
    if centres is None:
        centres = []
        for half in halves:
            centres.append(joint + half)
            joint = joint + 2 * half
    else:
        for i, (centre, half) in enumerate(zip(centres, halves, strict=True)):
            gap = centre - half - joint
            constraints |= {f"joint {i + 1} x": gap[0], f"joint {i + 1} y": gap[1]}
            joint = centre + half
    place, height = ca.vertcat(*centres), sum(centre[1] for centre in centres)
    *_, second = q.derivatives([*place.elements(), *inclinations, *joint.elements()], 2)
    moved, turned, end = ca.vertcat(*second[: 2 * n]), ca.vertcat(*second[2 * n : 3 * n]), second[3 * n :]
    mechanism = sv.Mechanism(
        q,
        gibbs=(p.m * ca.sumsqr(moved) + p.m * p.l**2 / 12 * ca.sumsqr(turned)) / 2,
        potential=p.m * p.g * height,
        constraints=constraints,
        outputs={"X": joint[0], "Y": joint[1]},
        units={"X": "m", "Y": "m"},
        shapes={
            "base": [(0, 0)],
            "links": [centres[0] - halves[0], *(c + half for c, half in zip(centres, halves, strict=True))],
            "end": [joint],
        },
        parameters=p,
    )
    residuals = {name: a - target for name, a, target in zip("XY", end, acceleration, strict=True)}
    return mechanism, sv.Program(residuals, by="ideal")


def spatial_arm(n=3, coordinates="joints"):
    """n homogeneous rods turn about axes z, y, z, y, ... of the link before; the end of the last is not accelerated.

    Parameters
    ----------
    n : int
        Number of links, at least 3.
    coordinates : {"joints", "bodies"}
        The joint angles theta1, theta2, ... [rad]; or these, and for each link the integrals a, b, c [rad] of its
        angular velocity and x, y, z [m] of its joint's velocity along its axes, whose rates the material constraints
        "joint 1 a", ... equate to those by the link before.

    Returns
    -------
    Mechanism, Program
        Ideal realisation. Residuals "X", "Y", "Z": acceleration of the end point along the axes of the last link, of
        which x runs along the rod; z of the base points up.

    Raises
    ------
    SpecificationError
        If there are fewer than three links.
    NameUnknown
        If the coordinates are named otherwise.
    """
    _check(n, coordinates, 3)
    p = _parameters()
    joints = coordinates == "joints"
    names, units = ("theta", "rad ") if joints else ("theta a b c x y z", "rad rad rad rad m m m ")
    q = sv.coordinates(_names(names, n), units=units * n)
    width = 1 if joints else 7
    angles, rates = list(q)[::width], q.d(1)
    rod = ca.vertcat(p.l, 0, 0)
    spin, speed, gravity = ca.SX.zeros(3), ca.SX.zeros(3), ca.vertcat(0, 0, -p.g)
    twists, wrenches, constraints = [], [], {}
    for i, angle in enumerate(angles):
        turn = _turn(angle, i % 2)
        handed = ca.vertcat(turn @ spin, turn @ (speed + (ca.cross(spin, rod) if i else 0)))
        handed[1 if i % 2 else 2] += rates[width * i]
        twist = handed if joints else ca.vertcat(*rates[width * i + 1 : width * (i + 1)])
        if not joints:
            names = (f"joint {i + 1} {letter}" for letter in "abcxyz")
            constraints |= dict(zip(names, (twist - handed).elements(), strict=True))
        spin, speed, gravity = twist[:3], twist[3:], turn @ gravity
        twists.append(twist)
        wrenches.append(ca.vertcat(ca.cross(rod / 2, p.m * gravity), p.m * gravity))
    twists, changes = q.derivatives(ca.vertcat(*twists).elements(), 1)
    S, inertia = 0, p.m * p.l**2 / 12 * ca.vertcat(0, 1, 1)
    for i in range(0, 6 * n, 6):
        spin, speed, turned, moved = (ca.vertcat(*v[j : j + 3]) for v in (twists, changes) for j in (i, i + 3))
        joint = moved + ca.cross(spin, speed)
        centre, end = (joint + _about_joint(spin, turned, part * rod) for part in (0.5, 1.0))
        S += p.m * ca.sumsqr(centre) / 2 + ca.dot(turned, inertia * turned / 2 + ca.cross(spin, inertia * spin))
    forces = ca.jtimes(ca.vertcat(*twists), ca.vertcat(*rates), ca.vertcat(*wrenches), True)
    shapes = _placed(angles, rod)
    mechanism = sv.Mechanism(q, gibbs=S, forces=forces, constraints=constraints, shapes=shapes, parameters=p)
    return mechanism, sv.Program(dict(zip("XYZ", end.elements(), strict=True)), by="ideal")


def _placed(angles, rod):
    """The links of the spatial arm by their joints."""
    axes, joints = ca.SX.eye(3), [ca.SX.zeros(3)]
    for i, angle in enumerate(angles):
        axes = axes @ _turn(angle, i % 2).T
        joints.append(joints[-1] + axes @ rod)
    return {"base": [(0, 0, 0)], "links": joints, "end": joints[-1:]}


def _check(n, coordinates, least):
    if n < least:
        raise SpecificationError(
            f"An arm of {n} links.", f"Its end point needs {least} joints.", nearest=f"n = {least}.", n=n
        )
    if coordinates not in COORDINATES:
        raise unknown(coordinates, COORDINATES, "kind of coordinates")


def _parameters():
    return sv.parameters(m=1.0, l=0.5, g=9.81)  # kg, m, m/s^2


def _names(letters, n):
    return " ".join(f"{letter}{i}" for i in range(1, n + 1) for letter in letters.split())


def _turn(angle, about_y):
    """The rotation of components along the axes of a link to those along the axes of the next link."""
    s, c = ca.sin(angle), ca.cos(angle)
    rows = [[c, 0, -s], [0, 1, 0], [s, 0, c]] if about_y else [[c, s, 0], [-s, c, 0], [0, 0, 1]]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))


def _about_joint(spin, turned, arm):
    """The acceleration of a point of a body relative to that of its joint."""
    return ca.cross(turned, arm) + ca.cross(spin, ca.cross(spin, arm))
