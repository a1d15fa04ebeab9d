"""Planar arms of two links in gravity: both joints driven, or the shoulder alone."""

import casadi as ca

from servoctl import spec as sv


def two_link_arm():
    """The end point of an arm moves along a straight line from (0.6, 0.4) to (0.2, 0.9) m in 2 s, by both joints.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "shoulder" and "elbow" [N m]; y points up.
    """
    p = sv.parameters(m1=4.0, m2=3.0, l1=0.6, l2=0.5, I1=0.12, I2=0.07, g=9.81)  # kg, kg, m, m, kg m^2, kg m^2, m/s^2
    q = sv.coordinates("q1 q2")  # rad from the horizontal, rad (relative)
    elbow, end, S, potential = _links(q, p)
    path = sv.paths.rest_to_rest(q.t, start=(0.6, 0.4), end=(0.2, 0.9), duration=2.0, smoothness=2)
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=potential,
        actuators=dict(zip(("shoulder", "elbow"), q, strict=True)),
        outputs={"X_end": end[0], "Y_end": end[1]},
        parameters=p,
    )
    return mechanism, sv.Program({"X": end[0] - path[0], "Y": end[1] - path[1]}, by="actuators")


def pendubot(start=-90.0, end=0.0, duration=3.0, damping=0.05):
    """The shoulder turns along a rest-to-rest path by its motor; the elbow is passive.

    The internal dynamics are a pendulum: damped about the hanging pose of the second link, unstable about the upright
    one. Equal angles of 90° hold the upright pose, an equilibrium that a law has to stabilise.

    Parameters
    ----------
    start, end : float
        Angles of the first link from the horizontal [degrees].
    duration : float
        [s]
    damping : float
        Of the elbow [N m s/rad].

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "shoulder" [N m]; y points up.
    """
    p = sv.parameters(m1=4.0, m2=3.0, l1=0.6, l2=0.5, I1=0.12, I2=0.07, g=9.81, d=damping)
    q = sv.coordinates("q1 q2")  # rad from the horizontal, rad (relative)
    q1, _ = q
    _, end_point, S, potential = _links(q, p)
    degree = ca.pi / 180
    path = sv.paths.rest_to_rest(q.t, start * degree, end * degree, duration=duration, smoothness=2)
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=potential,
        forces={"q2": -p.d * q.d(1)[1]},
        actuators={"shoulder": q1},
        outputs={"X_end": end_point[0], "Y_end": end_point[1]},
        parameters=p,
    )
    return mechanism, sv.Program({"angle": q1 - path}, by="actuators")


def _links(q, p):
    """Positions of elbow and end [m], the Gibbs function and the potential [J]."""
    q1, q2 = q
    dq1, dq2 = q.d(1)
    along = [ca.vertcat(ca.cos(a), ca.sin(a)) for a in (q1, q1 + q2)]
    elbow = p.l1 * along[0]
    end = elbow + p.l2 * along[1]
    middle = elbow + p.l2 / 2 * along[1]
    S = sv.rigid_body(q, p.m1, (0, 0, p.I1), position=elbow / 2, rates=(0, 0, dq1))
    S += sv.rigid_body(q, p.m2, (0, 0, p.I2), position=middle, rates=(0, 0, dq1 + dq2))
    return elbow, end, S, p.g * (p.m1 * elbow[1] / 2 + p.m2 * middle[1])
