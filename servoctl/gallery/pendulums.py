"""Pendulums on a driven cart, arm or beam, and a gymnast whose momentum is programmed."""

from math import pi

import casadi as ca

import servoctl as sv


def cart_pole():
    """A cart moves by 1 m in 2 s, and a pole balances on it.

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "force" [N] on the cart; theta is zero where the pole is upright.
    """
    p = sv.parameters(m_cart=1.0, m_pole=0.2, l=0.5, g=9.81)  # kg, kg, m, m/s^2
    q = sv.coordinates("x theta", units="m rad")
    x, theta = q
    tip = ca.vertcat(x + p.l * ca.sin(theta), p.l * ca.cos(theta))
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m_cart, x) + sv.particle(q, p.m_pole, tip),
        potential=p.m_pole * p.g * tip[1],
        actuators={"force": x},
        shapes={
            "rail": [(-0.5, 0), (1.5, 0)],
            "cart": sv.shapes.box((x, 0), 0.3, 0.15),
            "pole": [(x, 0), tip],
            "tip": [tip],
        },
        parameters=p,
    )
    r = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0))
    return mechanism, sv.Program({"X": x - r.X}, by="actuators")


def furuta_pendulum(damping=0.005):
    """A driven arm turns by 90 degrees in 2 s about the vertical, and a pendulum hangs at its end.

    Parameters
    ----------
    damping : float
        Of the pendulum's joint [N m s/rad].

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "torque" [N m] on the arm; the pendulum swings across the arm.
    """
    p = sv.parameters(J=0.02, m=0.2, arm=0.4, l=0.3, g=9.81, d=damping)  # kg m^2, kg, m, m, m/s^2, N m s/rad
    q = sv.coordinates("phi theta", units="rad rad")  # hanging at zero
    phi, theta = q
    along, across = ca.vertcat(ca.cos(phi), ca.sin(phi), 0), ca.vertcat(-ca.sin(phi), ca.cos(phi), 0)
    end = p.arm * along
    bob = end + p.l * (ca.sin(theta) * across - ca.cos(theta) * ca.vertcat(0, 0, 1))
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.rigid_body(q, 0.0, (0, 0, p.J), rates=(0, 0, q.d(1)[0])) + sv.particle(q, p.m, bob),
        potential=p.m * p.g * bob[2],
        forces={"theta": -p.d * q.d(1)[1]},
        actuators={"torque": phi},
        shapes={"arm": [(0, 0, -0.4), (0, 0, 0), end], "rod": [end, bob], "bob": [bob]},
        parameters=p,
    )
    r = q.references(angle=sv.paths.rest_to_rest(0.0, pi / 2, duration=2.0))
    return mechanism, sv.Program({"angle": phi - r.angle}, by="actuators")


def ball_and_beam(tilt=0.05):
    """A beam tilts in 0.5 s, and a ball rolls down on it.

    Parameters
    ----------
    tilt : float
        [rad]

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "torque" [N m] on the beam, which turns about its middle.
    """
    p = sv.parameters(m=0.1, radius=0.02, J_beam=0.05, g=9.81)  # kg, m, kg m^2, m/s^2
    q = sv.coordinates("r theta", units="m rad")  # r along the beam
    r, theta = q
    centre = r * ca.vertcat(ca.cos(theta), ca.sin(theta))
    spin = q.d(1)[1] - q.d(1)[0] / p.radius
    ball = sv.rigid_body(q, p.m, (0, 0, 0.4 * p.m * p.radius**2), position=centre, rates=(0, 0, spin))
    half = 0.8 * ca.vertcat(ca.cos(theta), ca.sin(theta))
    normal = p.radius * ca.vertcat(-ca.sin(theta), ca.cos(theta))
    mechanism = sv.Mechanism(
        q,
        gibbs=ball + sv.rigid_body(q, 0.0, (0, 0, p.J_beam), rates=(0, 0, q.d(1)[1])),
        potential=p.m * p.g * centre[1],
        actuators={"torque": theta},
        shapes={
            "beam": [-half - normal, half - normal],
            "ball": sv.shapes.disc(centre, p.radius, theta - r / p.radius),
        },
        parameters=p,
    )
    r = q.references(tilt=sv.paths.rest_to_rest(0.0, -tilt, duration=0.5))
    return mechanism, sv.Program({"tilt": theta - r.tilt}, by="actuators")


def acrobot(gain=-2.0):
    """The swing of a two-link gymnast dies out: the momentum about the bar is proportional to the bend of the hip.

    Parameters
    ----------
    gain : float
        Momentum over the angle of the hip [kg m²/s]; a positive one builds the swing up.

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "hip" [N m]; the bar's joint is passive, and y points up.
    """
    p = sv.parameters(m1=4.0, m2=3.0, l1=0.6, l2=0.5, I1=0.12, I2=0.07, g=9.81)  # kg, kg, m, m, kg m^2, kg m^2, m/s^2
    q = sv.coordinates("q1 q2", units="rad rad")  # from the horizontal, relative
    q1, q2 = q
    first, second = (ca.vertcat(ca.cos(a), ca.sin(a)) for a in (q1, q1 + q2))
    hip, middle = p.l1 * first, p.l1 * first + p.l2 / 2 * second
    S = sv.rigid_body(q, p.m1, (0, 0, p.I1), position=hip / 2, rates=(0, 0, q.d(1)[0]))
    S += sv.rigid_body(q, p.m2, (0, 0, p.I2), position=middle, rates=(0, 0, sum(q.d(1))))
    feet = hip + p.l2 * second
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.g * (p.m1 * hip[1] / 2 + p.m2 * middle[1]),
        actuators={"hip": q2},
        shapes={"bar": [(0, 0)], "trunk": [(0, 0), hip], "legs": [hip, feet], "feet": [feet]},
        parameters=p,
    )
    return mechanism, sv.Program(sv.programs.momentum("momentum", mechanism, "q1", gain * q2), by="actuators")
