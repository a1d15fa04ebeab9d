"""The Appell-Hamel mechanism of Emami, Zohoor and Sohrabpour, section 4."""

import casadi as ca

import servoctl as sv
from servoctl.errors import unknown


def appell_hamel(form="linear"):
    """A wheel whose rotation pays out the string of a particle, under the constraints of the paper (4.1)-(4.5).

    Parameters
    ----------
    form : {"linear", "squared"}
        "linear" rolls by (4.1), (4.2). "squared" is (4.4): the squared speed of the wheel's centre and
        its direction. Squaring makes the program singular wherever the wheel stops, φ' = 0.

    Returns
    -------
    Mechanism, Program
        Ideal realisation. Output "tension" of the string [N].

    Raises
    ------
    NameUnknown
        If the form is another word.

    Notes
    -----
    z points down, which the paper does not say. S is (4.7) without its term in φ'²θ'², which holds no acceleration
    (its coefficient is -I_x + 2 I_y + a² M, not the printed one).
    """
    p = sv.parameters(m=1.0, M=2.0, I_x=0.2, I_y=0.25, a=0.5, b=0.2, rho=0.3, g=9.81)  # kg, kg m^2, m, m/s^2
    q = sv.coordinates("x y z phi theta", units="m m m rad rad")  # z down
    _, _, z, phi, theta = q
    dx, dy, _, dphi, dtheta = q.d(1)
    ddx, ddy, ddz, ddphi, ddtheta = q.d(2)

    S = (p.m * (ddx**2 + ddy**2 + ddz**2) + (p.I_y + p.a**2 * p.M) * ddphi**2 + p.I_x * ddtheta**2) / 2  # (4.7)
    dx_o = dx + p.rho * dtheta * ca.sin(theta)  # m/s, velocity of the wheel's centre (4.2)
    dy_o = dy - p.rho * dtheta * ca.cos(theta)
    if form == "linear":
        rolling = {"x_c": dx_o - p.a * dphi * ca.cos(theta), "y_c": dy_o - p.a * dphi * ca.sin(theta)}  # (4.1)
    elif form == "squared":
        rolling = {
            "speed": dx_o**2 + dy_o**2 - p.a**2 * dphi**2,  # (4.4a)
            "direction": dx * ca.sin(theta) - dy * ca.cos(theta) + p.rho * dtheta,  # (4.4b)
        }
    else:
        raise unknown(form, ("linear", "squared"), "form of the program")

    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=-p.m * p.g * z,
        outputs={"tension": p.m * (p.g - ddz)},
        parameters=p,
        shapes=_shapes(q, p),
        units={"tension": "N"},
    )
    return mechanism, sv.Program(rolling | {"string": z + p.b * phi}, by="ideal")  # (4.5)


def _shapes(q, p):
    """The wheel, whose axle is at height 0, the frame that trails it with a pulley, the string and its particle."""
    x, y, z, phi, theta = q
    ahead, pulley = ca.vertcat(ca.cos(theta), ca.sin(theta), 0), (x, y, 1.0)
    centre = ca.vertcat(x, y, 0) - p.rho * ahead
    return {
        "wheel": sv.shapes.disc(centre, p.a, -phi, ((ca.cos(theta), ca.sin(theta), 0), (0, 0, 1))),
        "frame": [centre, (x, y, 0), pulley],
        "string": [pulley, (x, y, -z)],
        "particle": [(x, y, -z)],
    }
