"""A particle whose jerk keeps its magnitude: a program of order 3, quadratic in the highest derivatives."""

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
