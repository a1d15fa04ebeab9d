"""A wheeled robot whose path is programmed by the rate at which its curvature changes."""

import casadi as ca

import servoctl as sv


def wheeled_robot(turn=90.0, speed=1.0, duration=4.0):
    """At constant speed, the curvature κ = r/v of the path grows and falls: dκ/dt = c sin(2πt/T), a smooth turn.

    The wheels do not slip sideways: the quasi-velocities are the speed v and the yaw rate r. The program has the
    orders 1 and 2. The turn takes the time T and changes the heading by `turn`; then the robot goes straight on.

    Parameters
    ----------
    turn : float
        Change of the heading [degrees].
    speed : float
        [m/s]
    duration : float
        T [s]

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "drive" [N] and "steer" [N m].
    """
    p = sv.parameters(m=20.0, J=1.5, speed=speed)  # kg, kg m^2, m/s
    xy = sv.coordinates("x y psi", units="m m rad")
    psi = list(xy)[2]
    q = xy.with_quasi_velocities("v r", [[ca.cos(psi), 0], [ca.sin(psi), 0], [0, 1]])
    x, y, _ = q
    centre, ahead, side = ca.vertcat(x, y), ca.vertcat(ca.cos(psi), ca.sin(psi)), ca.vertcat(-ca.sin(psi), ca.cos(psi))
    v, r = q.w()

    c = turn * ca.pi / 180 * 2 * ca.pi / (speed * duration**2)  # 1/(m s): heading change = c v T^2/(2π)
    phase = sv.paths.rest_to_rest(0.0, 2 * ca.pi, duration=duration, smoothness=0)  # at a constant rate
    rate = c * ca.sin(q.references(phase=phase).phase)
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.rigid_body(q, p.m, (0, 0, p.J), position=(x, y), rates=(0, 0, r)),
        actuators={"drive": (1, 0), "steer": (0, 1)},
        outputs={"curvature": r / v},
        units={"v": "m/s", "r": "rad/s", "curvature": "1/m"},
        shapes={
            "axle": [centre - 0.25 * side, centre + 0.25 * side],
            "body": sv.shapes.box(centre + 0.2 * ahead, 0.6, 0.35, psi),
            "heading": [centre, centre + 0.5 * ahead],
            "centre": [centre],
        },
        parameters=p,
    )
    return mechanism, sv.Program({"speed": v - p.speed, "clothoid": q.dt(r / v) - rate}, by="actuators")
