"""Programs on the jerk: of a particle, whose magnitude is constant, and of a trolley, which has none."""

import casadi as ca

import servoctl as sv


def constant_jerk(magnitude=2.0):
    """An ideal reaction keeps the magnitude of a particle's jerk, in gravity.

    The reaction lies along the jerk. It is m (a - g) for the acceleration a, so that a - g grows along a direction e
    that stays: a = g + (c + J t) e, and the path is a cubic one.

    Parameters
    ----------
    magnitude : float
        J [m/s^3]

    Returns
    -------
    Mechanism, Program
        Residual "jerk" of order 3 [m/s^3].
    """
    p = sv.parameters(m=1.0, g=9.81, J=magnitude)  # kg, m/s^2, m/s^3
    q = sv.coordinates("x y", units="m m")  # y up
    place = ca.vertcat(*q)
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m, place),
        potential=p.m * p.g * place[1],
        shapes={"particle": [place]},
        parameters=p,
    )
    return mechanism, sv.Program(sv.programs.jerk_norm("jerk", q, place, p.J), by="ideal")


def jerkless_trolley():
    """A trolley with a swinging rod has no jerk: an ideal reaction, a force on the trolley, keeps its acceleration.

    Seen from the trolley, the rod swings in the constant gravity g - a: from rest in the vertical it comes to
    2 arctan(a/g), and back. Constraints of higher order on several bodies are Liu's subject; this machine is not his.

    Returns
    -------
    Mechanism, Program
        Ideal realisation, of order 3.
    """
    p = sv.parameters(M=3.0, m=2.0, l=1.0, g=9.81)  # kg, kg, m, m/s^2
    q = sv.coordinates("x theta", units="m rad")  # the rod hangs at zero
    x, theta = q
    direction = ca.vertcat(-ca.sin(theta), -ca.cos(theta))
    centre = ca.vertcat(x, 0) + p.l / 2 * direction
    S = sv.particle(q, p.M, x)
    S += sv.rigid_body(q, p.m, (0, 0, p.m * p.l**2 / 12), position=centre, rates=(0, 0, -q.d(1)[1]))
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.m * p.g * centre[1],
        shapes={
            "rail": [(-0.5, 0), (13, 0)],
            "trolley": sv.shapes.box((x, 0), 0.5, 0.25),
            "rod": [(x, 0), ca.vertcat(x, 0) + p.l * direction],
        },
        parameters=p,
    )
    return mechanism, sv.Program({"jerk": q.d(3)[0]}, by="ideal")
