"""Bodies that roll without slipping: a disc on the ground, and a ball on a turntable."""

import casadi as ca

import servoctl as sv


def rolling_disc(radius=0.3):
    """A thin homogeneous disc rolls on the ground: its contact is a program that ideal reactions realise.

    In steady precession the lean λ stays and the centre goes around a circle at the rate Ω. With the rate of rotation
    s about the axle, g tan λ = a Ω (3 s/2 + Ω sin(λ)/4), and the circle has the radius a s/Ω.

    Parameters
    ----------
    radius : float
        a [m]

    Returns
    -------
    Mechanism, Program
        Residuals "height" of order 0, "rolling_x" and "rolling_y" of order 1. The heading psi turns about the vertical,
        the lean is the angle from it to the disc, positive to the left.
    """
    p = sv.parameters(m=1.0, a=radius, g=9.81)  # kg, m, m/s^2
    q = sv.coordinates("x y z psi lean phi", units="m m m rad rad rad")  # z up
    x, y, z, psi, lean, phi = q
    dx, dy, _, dpsi, dlean, dphi = q.d(1)
    along, left = ca.vertcat(ca.cos(psi), ca.sin(psi), 0), ca.vertcat(-ca.sin(psi), ca.cos(psi), 0)
    up = ca.sin(lean) * left + ca.cos(lean) * ca.vertcat(0, 0, 1)  # from the contact to the centre
    centre, rotation = ca.vertcat(x, y, z), dphi - dpsi * ca.sin(lean)  # rad/s, about the axle
    rates = (
        dpsi * ca.cos(lean) * ca.cos(phi) - dlean * ca.sin(phi),
        -dpsi * ca.cos(lean) * ca.sin(phi) - dlean * ca.cos(phi),
        rotation,
    )
    rolling = ca.vertcat(dx, dy) - p.a * (rotation * along + dlean * ca.cos(lean) * left)[:2]
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.rigid_body(q, p.m, p.m * p.a**2 * ca.vertcat(0.25, 0.25, 0.5), position=centre, rates=rates),
        potential=p.m * p.g * z,
        shapes={"disc": sv.shapes.disc(centre, p.a, phi, (up, along)), "contact": [centre - p.a * up]},
        parameters=p,
    )
    residuals = {"height": z - p.a * ca.cos(lean), "rolling_x": rolling[0], "rolling_y": rolling[1]}
    return mechanism, sv.Program(residuals, by="ideal")


def ball_on_turntable(rate=3.0):
    """A motor turns a table at a constant rate; a homogeneous ball rolls on it, around a circle at 2/7 of that rate.

    Place and velocity at the start determine the circle alone.

    Parameters
    ----------
    rate : float
        Of the table [rad/s].

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "motor" [N m]. Rolling is the material constraints "rolling_x" and "rolling_y"; alpha
        and beta are the integrals of the ball's angular velocity about the axes x and y.
    """
    p = sv.parameters(m=0.5, a=0.05, J=0.4)  # kg, m, kg m^2 of the table
    q = sv.coordinates("x y alpha beta table", units="m m rad rad rad")
    x, y, _, _, table = q
    dx, dy, dalpha, dbeta, dtable = q.d(1)
    ball = sv.rigid_body(q, p.m, 2 / 5 * p.m * p.a**2 * ca.SX.ones(3), position=(x, y), rates=(dalpha, dbeta, 0))
    centre = ca.vertcat(x, y, p.a)
    mechanism = sv.Mechanism(
        q,
        gibbs=ball + sv.particle(q, p.J, table),
        actuators={"motor": table},
        constraints={"rolling_x": dx - p.a * dbeta + dtable * y, "rolling_y": dy + p.a * dalpha - dtable * x},
        shapes={
            "table": sv.shapes.disc((0, 0, 0), 0.8, table, ((1, 0, 0), (0, 1, 0)))[:-1],  # open: its rim alone
            "ball": sv.shapes.disc(centre, p.a, None, ((1, 0, 0), (0, 1, 0))),
            "centre": [centre],
        },
        parameters=p,
    )
    return mechanism, sv.Program({"rate": table - rate * q.t}, by="actuators")
