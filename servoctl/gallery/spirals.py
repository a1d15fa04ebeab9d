"""A particle in the plane whose curvature obeys a program of any order."""

from math import factorial

import casadi as ca

import servoctl as sv
from servoctl.errors import SpecificationError


def spiral(order=3, c=None):
    """An ideal reaction keeps the n-th time derivative of the path's curvature at c, n = order - 2.

    κ = (x'y'' - y'x'')/|v|³ holds second derivatives, so the program has order n + 2. The reaction does no work: the
    speed stays. From speed 1 and rest curvature the heading is c t^(n+1)/(n+1)! (for n = 1 Cornu's spiral).

    Parameters
    ----------
    order : int
        Of the program, at least 2 (a circle).
    c : float, optional
        [1/(m s^n)]; default (n+1)!/2^(n+1), for a heading of 1 rad after 2 s.

    Returns
    -------
    Mechanism, Program

    Raises
    ------
    SpecificationError
        If the order is below 2.
    """
    if order < 2:
        raise SpecificationError(
            f"A spiral of order {order}.", "Curvature has order 2.", nearest="order = 2, a circle.", order=order
        )
    n = order - 2
    p = sv.parameters(m=1.0, c=factorial(n + 1) / 2 ** (n + 1) if c is None else c)  # kg, 1/(m s^n)
    q = sv.coordinates("x y", units="m m")
    x, y = q
    dx, dy = q.d(1)
    ddx, ddy = q.d(2)
    curvature = (dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5  # 1/m
    S = sv.particle(q, p.m, ca.vertcat(x, y))
    mechanism = sv.Mechanism(q, gibbs=S, shapes={"particle": [(x, y)]}, parameters=p)
    return mechanism, sv.Program({"curvature": q.dt(curvature, n) - p.c}, by="ideal")
