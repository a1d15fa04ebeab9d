"""Programs of order 3: the curvature of an arm's path, and the magnitude of a satellite's acceleration."""

import casadi as ca

import servoctl as sv


def clothoid_arm(speed=0.25, growth=4.0):
    """The end of an arm of two links moves at constant speed, and the curvature of its path grows steadily.

    Parameters
    ----------
    speed : float
        [m/s]
    growth : float
        Of the curvature [1/(m s)].

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "shoulder" and "elbow" [N m], in a horizontal plane: orders 1 and 3.
    """
    p = sv.parameters(m=2.0, l=0.5, I=1 / 24, speed=speed, growth=growth)  # kg, m, kg m^2, m/s, 1/(m s)
    q = sv.coordinates("q1 q2", units="rad rad")  # the second is relative
    q1, q2 = q
    first, second = (ca.vertcat(ca.cos(a), ca.sin(a)) for a in (q1, q1 + q2))
    elbow, end = p.l * first, p.l * (first + second)
    S = sv.rigid_body(q, p.m, (0, 0, p.I), position=elbow / 2, rates=(0, 0, q.d(1)[0]))
    S += sv.rigid_body(q, p.m, (0, 0, p.I), position=elbow + p.l / 2 * second, rates=(0, 0, sum(q.d(1))))
    velocity, acceleration = q.dt(end, 1), q.dt(end, 2)
    curvature = (velocity[0] * acceleration[1] - velocity[1] * acceleration[0]) / ca.dot(velocity, velocity) ** 1.5
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        actuators={"shoulder": q1, "elbow": q2},
        outputs={"X": end[0], "Y": end[1], "curvature": curvature},
        units={"X": "m", "Y": "m", "curvature": "1/m"},
        shapes={"base": [(0, 0)], "first link": [(0, 0), elbow], "second link": [elbow, end], "end": [end]},
        parameters=p,
    )
    program = sv.programs.constant_speed("speed", q, end, p.speed)
    program |= {"clothoid": q.dt(curvature) - p.growth}
    return mechanism, sv.Program(program, by="actuators")


def steady_satellite():
    """A satellite leaves the lowest point of an ellipse, and the magnitude of its acceleration does not change.

    Returns
    -------
    Mechanism, Program
        Ideal realisation, of order 3: the acceleration is perpendicular to its rate.
    """
    p = sv.parameters(m=100.0, mu=3.986e14)  # kg, m^3/s^2
    q = sv.coordinates("x y", units="m m")
    place = ca.vertcat(*q)
    acceleration = q.dt(place, 2)
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m, place),
        potential=-p.m * p.mu / ca.norm_2(place),
        shapes={"earth": sv.shapes.disc((0, 0), 6.37e6), "satellite": [place]},
        parameters=p,
    )
    return mechanism, sv.Program({"steady": ca.dot(acceleration, q.dt(place, 3))}, by="ideal")
