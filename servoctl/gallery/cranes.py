"""Cranes whose load follows a path: a planar one, one with a winch, and a three-dimensional one.

Each comes in relative coordinates (rope length and angles) or in redundant ones, where the load has Cartesian
coordinates and the rope is a material constraint. Z points down. The tension of the rope is an output, and
so is the load's position [m] where it is not among the coordinates.
"""

from math import pi

import casadi as ca

import servoctl as sv
from servoctl.errors import unknown

COORDINATES = ("relative", "redundant")


def overhead_crane(duration=6.0, coordinates="relative"):
    """A trolley and a hoist carry the load along a straight path, from (0, 4) to (5, 2) m.

    Parameters
    ----------
    duration : float
        Of the path [s]; the path holds its end afterwards.
    coordinates : {"relative", "redundant"}
        (x, l, theta), or (x, l, X, Z) with the material constraint "rope".

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "trolley" [N], on x, and "hoist" [N], on l. Output "tension" of the rope [N].

    Raises
    ------
    NameUnknown
        If the coordinates are named otherwise.
    """
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81)  # kg, m/s^2
    if _relative(coordinates):
        q = sv.coordinates("x l theta", units="m m rad")
        x, l, theta = q
        hung = _hanging(ca.vertcat(x, 0), l, ca.vertcat(ca.sin(theta), ca.cos(theta)))
    else:
        q = sv.coordinates("x l X Z", units="m m m m")  # Z down
        x, l, X, Z = q
        hung = _roped(ca.vertcat(x, 0), l, ca.vertcat(X, Z))
    machine = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l)
    path = sv.paths.rest_to_rest(start=(0.0, 4.0), end=(5.0, 2.0), duration=duration, smoothness=4)
    target = ca.vertcat(*q.references(X=path[0], Z=path[1]))
    shapes = _plane_shapes(x, hung[0], (-0.5, 5.5))
    return _following(q, p, machine, hung, {"trolley": x, "hoist": l}, target, shapes)


def winch_crane(coordinates="relative"):
    """Blajer's crane: a trolley and a winch carry the load from (0, 4) to (1, 5) m in 6 s.

    Parameters
    ----------
    coordinates : {"relative", "redundant"}
        (x, beta, theta), or (x, beta, X, Z) with the material constraint "rope"; the rope's length is r·beta.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "trolley" [N], on x, and "winch" [N m], on beta: positive pays out. Output
        "tension" of the rope [N]. Singular where the tension vanishes.

    Raises
    ------
    NameUnknown
        If the coordinates are named otherwise.
    """
    p = sv.parameters(m_trolley=10.0, J=0.1, r=0.1, m_load=100.0, g=9.81)  # kg, kg m^2, m, kg, m/s^2
    if _relative(coordinates):
        q = sv.coordinates("x beta theta", units="m rad rad")
        x, beta, theta = q
        hung = _hanging(ca.vertcat(x, 0), p.r * beta, ca.vertcat(ca.sin(theta), ca.cos(theta)))
    else:
        q = sv.coordinates("x beta X Z", units="m rad m m")  # Z down
        x, beta, X, Z = q
        hung = _roped(ca.vertcat(x, 0), p.r * beta, ca.vertcat(X, Z))
    machine = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.J, beta)
    path = sv.paths.rest_to_rest(start=(0.0, 4.0), end=(1.0, 5.0), duration=6.0, smoothness=6)
    target = ca.vertcat(*q.references(X=path[0], Z=path[1]))
    shapes = {"drum": sv.shapes.disc((x, 0), 2 * p.r, beta)} | _plane_shapes(x, hung[0], (-1.5, 2.5))
    return _following(q, p, machine, hung, {"trolley": x, "winch": beta}, target, shapes)


def crane_3d(coordinates="relative"):
    """A bridge, a trolley on it and a hoist lift the load from 5 to 3 m below along a quarter turn of 3 m, in 6 s.

    Parameters
    ----------
    coordinates : {"relative", "redundant"}
        (x, y, l, theta, phi), or (x, y, l, X, Y, Z) with the material constraint "rope". The rope points along
        (sin θ, cos θ sin φ, cos θ cos φ), a chart that is regular while |θ| < 90°.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "bridge" [N], on x, "trolley" [N], on y, and "hoist" [N], on l. Output "tension" of
        the rope [N]. m_bridge is all that moves with x, m_trolley all that moves with y, but the load.

    Raises
    ------
    NameUnknown
        If the coordinates are named otherwise.
    """
    p = sv.parameters(m_bridge=20.0, m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81)  # kg, m/s^2
    if _relative(coordinates):
        q = sv.coordinates("x y l theta phi", units="m m m rad rad")
        x, y, l, theta, phi = q
        rope = ca.vertcat(ca.sin(theta), ca.cos(theta) * ca.sin(phi), ca.cos(theta) * ca.cos(phi))
        hung = _hanging(ca.vertcat(x, y, 0), l, rope)
    else:
        q = sv.coordinates("x y l X Y Z", units="m m m m m m")  # Z down
        x, y, l, X, Y, Z = q
        hung = _roped(ca.vertcat(x, y, 0), l, ca.vertcat(X, Y, Z))
    machine = sv.particle(q, p.m_bridge, x) + sv.particle(q, p.m_trolley, y) + sv.particle(q, p.m_hoist, l)
    (s,) = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=6.0, smoothness=6))
    turn = sv.curves.circle(pi / 2 * (s - 1), centre=(0.0, 3.0), radius=3.0)
    target = ca.vertcat(turn, sv.curves.line(s, 5.0, 3.0))
    (X, Y, Z), low, high = ca.vertsplit(hung[0]), -0.5, 3.5
    shapes = {
        "left rail": [(low, low, 0), (high, low, 0)],
        "right rail": [(low, high, 0), (high, high, 0)],
        "bridge": [(x, low, 0), (x, high, 0)],
        "trolley": [(x, y, 0)],
        "rope": [(x, y, 0), (X, Y, -Z)],
        "load": [(X, Y, -Z)],
    }
    return _following(q, p, machine, hung, {"bridge": x, "trolley": y, "hoist": l}, target, shapes)


def _relative(coordinates):
    if coordinates not in COORDINATES:
        raise unknown(coordinates, COORDINATES, "choice of coordinates")
    return coordinates == "relative"


def _hanging(trolley, length, rope):
    """Position of a load on a rope along a unit vector, that vector, and no material constraint."""
    return trolley + length * rope, rope, {}


def _roped(trolley, length, load):
    """Position of a load with Cartesian coordinates, the rope's direction, and the rope as material constraint."""
    offset = load - trolley
    return load, offset / length, {"rope": ca.dot(offset, offset) - length**2}


def _plane_shapes(x, load, rail):
    """Rail, trolley, rope and load of a crane in a plane; its load's second coordinate points down."""
    load = ca.vertcat(load[0], -load[1])
    return {
        "rail": [(end, 0) for end in rail],
        "trolley": sv.shapes.box((x, 0), 0.6, 0.2),
        "rope": [(x, 0), load],
        "load": [load],
    }


def _following(q, p, machine, hung, actuators, target, shapes):
    """The crane whose load, as `_hanging` or `_roped` give it, follows a target; the last axis points down."""
    load, rope, constraints = hung
    weight = p.m_load * p.g
    tension = weight * rope[-1] - p.m_load * ca.dot(q.dt(load, 2), rope)  # N, of m (g e - a) along the rope
    axes = "XZ" if load.numel() == 2 else "XYZ"
    positions = {} if constraints else {name: load[i] for i, name in enumerate(axes)}
    mechanism = sv.Mechanism(
        q,
        gibbs=machine + sv.particle(q, p.m_load, load),
        potential=-weight * load[-1],
        actuators=actuators,
        constraints=constraints,
        outputs={"tension": tension} | positions,
        units={"tension": "N"} | dict.fromkeys(positions, "m"),
        shapes=shapes,
        parameters=p,
    )
    return mechanism, sv.Program({name: load[i] - target[i] for i, name in enumerate(axes)}, by="actuators")
