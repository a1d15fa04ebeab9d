"""A particle at constant speed in gravity."""

import casadi as ca

import servoctl as sv
from servoctl.errors import unknown


def constant_speed(realisation="ideal"):
    """An ideal reaction or a horizontal force keeps |v|² at 5² m²/s².

    From a horizontal start the ideal motion has the heading -arcsin tanh(g t / v). A horizontal force does not act on
    the fall; it grows without bound towards t = v/g, where the motion ends.

    Parameters
    ----------
    realisation : {"ideal", "horizontal"}
        "horizontal": by the actuator "thrust" [N] on x.

    Returns
    -------
    Mechanism, Program

    Raises
    ------
    NameUnknown
        If the realisation is another word.
    """
    if realisation not in ("ideal", "horizontal"):
        raise unknown(realisation, ("ideal", "horizontal"), "realisation")
    p = sv.parameters(m=1.0, g=9.81, v=5.0)  # kg, m/s^2, m/s
    q = sv.coordinates("x y", units="m m")  # y up
    x, y = q
    dx, dy = q.d(1)
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m, ca.vertcat(x, y)),
        potential=p.m * p.g * y,
        actuators={"thrust": x},
        shapes={"particle": [(x, y)]},
        parameters=p,
    )
    by = "ideal" if realisation == "ideal" else "actuators"
    return mechanism, sv.Program({"speed": dx**2 + dy**2 - p.v**2}, by=by)
