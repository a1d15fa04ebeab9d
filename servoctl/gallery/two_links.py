"""Planar arms of two links: both joints driven or the shoulder alone, in gravity; or an elastic elbow, without."""

from math import pi

import casadi as ca

import servoctl as sv


def two_link_arm():
    """The end point of an arm moves along a straight line from (0.6, 0.4) to (0.2, 0.9) m in 2 s, by both joints.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "shoulder" and "elbow" [N m]; y points up.
    """
    p = sv.parameters(m1=4.0, m2=3.0, l1=0.6, l2=0.5, I1=0.12, I2=0.07, g=9.81)  # kg, kg, m, m, kg m^2, kg m^2, m/s^2
    q = sv.coordinates("q1 q2", units="rad rad")  # from the horizontal, relative
    end, S, height, shapes = _links(q, (p.m1, p.m2), (p.l1, p.l2), (p.I1, p.I2))
    path = sv.paths.rest_to_rest(start=(0.6, 0.4), end=(0.2, 0.9), duration=2.0, smoothness=2)
    r = q.references(X=path[0], Y=path[1])
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.g * height,
        actuators=dict(zip(("shoulder", "elbow"), q, strict=True)),
        outputs={"X_end": end[0], "Y_end": end[1]},
        units={"X_end": "m", "Y_end": "m"},
        shapes=shapes,
        parameters=p,
    )
    return mechanism, sv.Program({"X": end[0] - r.X, "Y": end[1] - r.Y}, by="actuators")


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
    q = sv.coordinates("q1 q2", units="rad rad")  # from the horizontal, relative
    q1, _ = q
    end_point, S, height, shapes = _links(q, (p.m1, p.m2), (p.l1, p.l2), (p.I1, p.I2))
    degree = ca.pi / 180
    r = q.references(angle=sv.paths.rest_to_rest(start * degree, end * degree, duration=duration, smoothness=2))
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.g * height,
        forces={"q2": -p.d * q.d(1)[1]},
        actuators={"shoulder": q1},
        outputs={"X_end": end_point[0], "Y_end": end_point[1]},
        units={"X_end": "m", "Y_end": "m"},
        shapes=shapes,
        parameters=p,
    )
    return mechanism, sv.Program({"angle": q1 - r.angle}, by="actuators")


def passive_arm(Gamma=0.3):
    """q1 + Γ q2 turns by 90° in 2 s, by the torque of the first joint alone; no gravity.

    Two equal homogeneous links. The internal dynamics are stable for Γ < 0.4 and unstable above; at Γ = 0.4 the
    leading coefficient 0.2 (1 - cos q2) vanishes in the straight pose.

    Parameters
    ----------
    Gamma : float
        Weight of the passive joint in the output; 0.5 gives roughly the angle of the arm's tip.

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "torque" [N m] on q1.
    """
    p = sv.parameters(m=1.0, l=1.0, I=1 / 12, c=10.0, d=1.0, Gamma=Gamma)  # kg, m, kg m^2, N m/rad, N m s/rad, 1
    q = sv.coordinates("q1 q2", units="rad rad")  # the second is relative
    q1, q2 = q
    _, S, _, shapes = _links(q, (p.m, p.m), (p.l, p.l), (p.I, p.I))
    r = q.references(angle=sv.paths.rest_to_rest(0.0, pi / 2, duration=2.0, smoothness=4))
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.c * q2**2 / 2,
        forces={"q2": -p.d * q.d(1)[1]},
        actuators={"torque": q1},
        shapes=shapes,
        parameters=p,
    )
    return mechanism, sv.Program({"angle": q1 + p.Gamma * q2 - r.angle}, by="actuators")


def _links(q, masses, lengths, inertias):
    """Position of the end [m], the Gibbs function, the sum of masses times heights [kg m], and shapes."""
    q1, q2 = q
    dq1, dq2 = q.d(1)
    (m1, m2), (l1, l2), (I1, I2) = masses, lengths, inertias
    along = [ca.vertcat(ca.cos(a), ca.sin(a)) for a in (q1, q1 + q2)]
    elbow = l1 * along[0]
    end = elbow + l2 * along[1]
    middle = elbow + l2 / 2 * along[1]
    S = sv.rigid_body(q, m1, (0, 0, I1), position=elbow / 2, rates=(0, 0, dq1))
    S += sv.rigid_body(q, m2, (0, 0, I2), position=middle, rates=(0, 0, dq1 + dq2))
    shapes = {"base": [(0, 0)], "first link": [(0, 0), elbow], "second link": [elbow, end], "end": [end]}
    return end, S, m1 * elbow[1] / 2 + m2 * middle[1], shapes
