"""A mass that slides on an inclined guide of a driven car (Seifried and Blajer, 2013)."""

from math import pi

import casadi as ca

import servoctl as sv
from servoctl.errors import unknown


def mass_on_car(alpha=pi / 4, damping=1.0, coordinates="relative"):
    """The mass's horizontal position z moves from 0.5 to 2.5 m in 3 s.

    The relative degree depends on the guide and its damper: 4 for alpha = 0 without, 3 with damping, 2 beyond.

    Parameters
    ----------
    alpha : float
        Inclination of the guide [rad].
    damping : float
        Of the guide [N s/m].
    coordinates : {"relative", "absolute"}
        (x, s), s along the guide; or (x, x_m, y_m) with the material constraint "guide".

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "force" [N] on the car.

    Raises
    ------
    NameUnknown
        If the coordinates are named otherwise.
    """
    p = sv.parameters(m_1=1.0, m_2=2.0, k=5.0, d=damping, alpha=alpha)  # kg, kg, N/m, N s/m, rad
    cosine, sine = ca.cos(p.alpha), ca.sin(p.alpha)
    if coordinates == "relative":
        q = sv.coordinates("x s", units="m m")
        x, s = q
        mass = ca.vertcat(x + s * cosine, s * sine)
        constraints = {}
    elif coordinates == "absolute":
        q = sv.coordinates("x x_m y_m", units="m m m")
        x, x_m, y_m = q
        mass = ca.vertcat(x_m, y_m)
        s = (x_m - x) * cosine + y_m * sine
        constraints = {"guide": sine * (x_m - x) - cosine * y_m}
    else:
        raise unknown(coordinates, ("relative", "absolute"), "choice of coordinates")
    r = q.references(z=sv.paths.rest_to_rest(0.5, 2.5, duration=3.0, smoothness=6))
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m_1, x) + sv.particle(q, p.m_2, mass),
        potential=p.k * s**2 / 2,
        forces=-p.d * q.dt(s) * ca.gradient(s, ca.vertcat(*q)),
        actuators={"force": x},
        constraints=constraints,
        shapes={
            "rail": [(-1.0, 0.0), (4.0, 0.0)],
            "car": sv.shapes.box((x, 0), 0.5, 0.2),
            "guide": [(x - 0.9 * cosine, -0.9 * sine), (x + 0.9 * cosine, 0.9 * sine)],
            "spring": sv.shapes.spring((x, 0), mass, 0.1),
            "mass": [mass],
        },
        parameters=p,
    )
    return mechanism, sv.Program({"z": mass[0] - r.z}, by="actuators")
