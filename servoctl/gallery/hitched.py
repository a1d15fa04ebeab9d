"""A wheeled robot that pulls two trailers, whose path is programmed by the curvature that the last one follows."""

import casadi as ca

import servoctl as sv


def trailers(radius=2.0, duration=4.0, speed=1.0):
    """The last of two trailers goes from a straight line into a circle, at constant speed.

    Each trailer is coupled to the middle of the axle before it. The curvature κ = tan(theta1 - theta2)/l2 of the last
    one's path determines the angles and, by its derivatives, the steering. Its rate is programmed: the hidden
    constraint of κ itself would divide by κ', which is zero on lines and circles.

    Parameters
    ----------
    radius : float
        Of the circle of the last trailer [m].
    duration : float
        Of the change of its curvature [s].
    speed : float
        Of the last trailer [m/s].

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "drive" [N] and "steer" [N m] of the robot. Quasi-velocities: the speed v of the last
        trailer, the yaw rate r of the robot.
    """
    p = sv.parameters(m=20.0, J=1.0, m_t=10.0, J_t=0.5, l1=0.8, l2=0.8)  # kg, kg m^2, kg, kg m^2, m, m
    xy = sv.coordinates("X Y theta0 theta1 theta2", units="m m rad rad rad")  # X, Y of the last axle
    X, Y, *angles = xy
    ahead = [ca.vertcat(ca.cos(angle), ca.sin(angle)) for angle in angles]
    bend, last_bend = angles[0] - angles[1], angles[1] - angles[2]
    kappa = ca.tan(last_bend) / p.l2  # 1/m, of the last axle's path
    turns = [ca.tan(bend) / p.l1 / ca.cos(last_bend), kappa]  # 1/m, of the trailers
    q = xy.with_quasi_velocities("v r", ca.horzcat(ca.vertcat(ahead[2], 0, *turns), ca.SX.eye(5)[:, 2]))
    v, r = q.w()
    last = ca.vertcat(X, Y)
    axles = [last + p.l2 * ahead[2] + p.l1 * ahead[1], last + p.l2 * ahead[2], last]

    S = sv.rigid_body(q, p.m, (0, 0, p.J), position=axles[0], rates=(0, 0, r))
    for turn, axle in zip(turns, axles[1:], strict=True):
        S += sv.rigid_body(q, p.m_t, (0, 0, p.J_t), position=axle, rates=(0, 0, turn * v))
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        actuators={"drive": (1 / (ca.cos(bend) * ca.cos(last_bend)), 0), "steer": (0, 1)},
        shapes=_boxes_on_axles(axles, angles),
        units={"v": "m/s", "r": "rad/s", "drive": "N"},
        parameters=p,
    )
    r = q.references(curvature=sv.paths.rest_to_rest(0.0, 1 / radius, duration=duration, smoothness=4))
    residuals = {"curvature": q.dt(kappa - r.curvature), "speed": v - speed}
    return mechanism, sv.Program(residuals, by="actuators")


def _boxes_on_axles(axles, angles):
    """The bars, a box on each axle, and the last axle's middle."""
    boxes = {
        f"body {i}": sv.shapes.box(axle, length, 0.3, angle)
        for i, (axle, angle, length) in enumerate(zip(axles, angles, (0.6, 0.35, 0.35), strict=True))
    }
    return {"bars": axles} | boxes | {"last axle": [axles[-1]]}
