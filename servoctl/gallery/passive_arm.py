"""A planar arm of two links whose second joint is passive and elastic."""

from math import pi

import casadi as ca

from servoctl import spec as sv


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
    q = sv.coordinates("q1 q2")  # rad, rad (relative)
    q1, q2 = q
    dq1, dq2 = q.d(1)

    elbow = p.l * ca.vertcat(ca.cos(q1), ca.sin(q1))
    centre = elbow + p.l / 2 * ca.vertcat(ca.cos(q1 + q2), ca.sin(q1 + q2))
    S = (
        sv.rigid_body(q, p.m, (0, 0, p.I), position=elbow / 2, rates=(0, 0, dq1))
        + sv.rigid_body(q, p.m, (0, 0, p.I), position=centre, rates=(0, 0, dq1 + dq2))
    )  # fmt: skip
    path = sv.paths.rest_to_rest(q.t, 0.0, pi / 2, duration=2.0, smoothness=4)
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.c * q2**2 / 2,
        forces={"q2": -p.d * dq2},
        actuators={"torque": q1},
        parameters=p,
    )
    return mechanism, sv.Program({"angle": q1 + p.Gamma * q2 - path}, by="actuators")
