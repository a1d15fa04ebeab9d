"""A planar vertical take-off aircraft with tilted thrusters."""

from math import radians

import casadi as ca

import servoctl as sv
from servoctl.errors import unknown

POINTS = ("flat", "centre")


def vtol(point="flat"):
    """A point of the aircraft moves from (0, 0) to (5, 2) m in 4 s, by two thrusters.

    Parameters
    ----------
    point : {"flat", "centre"}
        "flat": the point J sin(tilt) / (M (l cos(tilt) + h sin(tilt))) above the centre of mass, whose motion
        determines everything. "centre": the centre of mass itself; the internal dynamics are then unstable.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "u1", "u2" [N], the thrusts at the wing tips.

    Raises
    ------
    NameUnknown
        If the point is named otherwise.

    Notes
    -----
    The usual benchmark form: the tilt turns the difference of the thrusts sideways, and the factor cos(tilt) of
    their sum is left out.
    """
    if point not in POINTS:
        raise unknown(point, POINTS, "point of the aircraft")
    p = sv.parameters(M=50.0, J=25.0, l=1.0, h=0.1, tilt=radians(5.0), g=9.81)  # kg, kg m^2, m, m, rad, m/s^2
    q = sv.coordinates("x z theta", units="m m rad")  # z up
    x, z, theta = q
    across = ca.vertcat(ca.cos(theta), ca.sin(theta))
    along = ca.vertcat(-ca.sin(theta), ca.cos(theta))
    arm = p.l * ca.cos(p.tilt) + p.h * ca.sin(p.tilt)

    height = 0 if point == "centre" else p.J * ca.sin(p.tilt) / (p.M * arm)
    followed = ca.vertcat(x, z) + height * along
    path = sv.paths.rest_to_rest(start=(0.0, 0.0), end=(5.0, 2.0), duration=4.0, smoothness=4)
    r = q.references(X=path[0], Z=path[1])
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.rigid_body(q, p.M, (0, 0, p.J), position=(x, z), rates=(0, 0, q.d(1)[2])),
        potential=p.M * p.g * z,
        actuators={
            "u1": ca.vertcat(along + ca.sin(p.tilt) * across, arm),
            "u2": ca.vertcat(along - ca.sin(p.tilt) * across, -arm),
        },
        units={"u1": "N", "u2": "N"},
        shapes={
            "wings": [ca.vertcat(x, z) + side * p.l * across + p.h * along for side in (-1, 0, 1)],
            "left thruster": _thruster(ca.vertcat(x, z) - p.l * across + p.h * along, along, across, p.tilt),
            "right thruster": _thruster(ca.vertcat(x, z) + p.l * across + p.h * along, along, -across, p.tilt),
            "fuselage": sv.shapes.box((x, z), 0.5, 0.3, theta),
            "followed": [followed],
        },
        parameters=p,
    )
    return mechanism, sv.Program({"X": followed[0] - r.X, "Z": followed[1] - r.Z}, by="actuators")


def _thruster(tip, along, across, tilt):
    """A line from a wing tip along its thrust."""
    return [tip, tip - 0.3 * (ca.cos(tilt) * along + ca.sin(tilt) * across)]
