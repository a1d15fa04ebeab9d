"""A bicycle, or car, on a figure eight."""

import casadi as ca

import servoctl as sv


def bicycle(width=8.0, lap=16.0):
    """The rear axle of a bicycle without lean follows a figure eight, by its speed and its curvature.

    The wheels do not slip sideways: the quasi-velocities are the speed v of the rear axle and the steering rate s.

    Parameters
    ----------
    width : float
        Half the length of the eight [m].
    lap : float
        Time of a lap [s].

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "drive" [N] and "steer" [N m].
    """
    p = sv.parameters(m=80.0, J=8.0, J_steer=0.2, base=1.1, ahead=0.5)  # kg, kg m^2, kg m^2, m, m
    plain = sv.coordinates("x y psi delta", units="m m rad rad")
    x, y, psi, delta = plain
    ahead = ca.vertcat(ca.cos(psi), ca.sin(psi))
    turn = ca.tan(delta) / p.base  # 1/m
    q = plain.with_quasi_velocities("v s", [[ahead[0], 0], [ahead[1], 0], [turn, 0], [0, 1]])
    v, s = q.w()
    rear = ca.vertcat(x, y)
    front, wheel = rear + p.base * ahead, 0.3 * ca.vertcat(ca.cos(psi + delta), ca.sin(psi + delta))
    S = sv.rigid_body(q, p.m, (0, 0, p.J), position=rear + p.ahead * ahead, rates=(0, 0, v * turn))
    S += sv.rigid_body(q, 0.0, (0, 0, p.J_steer), rates=(0, 0, v * turn + s))
    w = 2 * ca.pi / lap
    path = width * ca.vertcat(ca.sin(w * q.t), ca.sin(2 * w * q.t) / 2)
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        actuators={"drive": (1, 0), "steer": (0, 1)},
        shapes={
            "frame": [rear, front],
            "rear wheel": [rear - 0.3 * ahead, rear + 0.3 * ahead],
            "front wheel": [front - wheel, front + wheel],
            "rear": [rear],
        },
        parameters=p,
        units={"v": "m/s", "s": "rad/s"},
    )
    velocity, acceleration = q.dt(path, 1), q.dt(path, 2)
    speed = ca.norm_2(velocity)
    curvature = (velocity[0] * acceleration[1] - velocity[1] * acceleration[0]) / speed**3
    return mechanism, sv.Program({"speed": v - speed, "curvature": turn - curvature}, by="actuators")
