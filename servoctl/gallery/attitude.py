"""A satellite that three reaction wheels turn, and the attitude of a body by a unit quaternion."""

import casadi as ca

import servoctl as sv

AXIS = (1.0, 2.0, 2.0)  # of the satellite's turn


def reaction_wheels(turn=120.0, duration=20.0):
    """Three wheels turn a satellite from rest to rest, about an axis that is none of its principal axes.

    The angular momentum of all bodies together stays zero: the rate s of a wheel, relative to the satellite, is
    -J ω/J_w, of the satellite's rate ω and inertia J about the wheel's axis, its wheel included.

    Parameters
    ----------
    turn : float
        About (1, 2, 2) [degrees].
    duration : float
        [s]

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "motor1", "motor2", "motor3" [N m], between the satellite and its wheels.
    """
    p = sv.parameters(J1=30.0, J2=40.0, J3=50.0, J_w=0.1)  # kg m^2: of the satellite and its wheels, of a wheel
    plain = sv.coordinates("e0 e1 e2 e3 a1 a2 a3", units="1 1 1 1 rad rad rad")  # quaternion of the body, wheels
    e = ca.vertcat(*list(plain)[:4])
    V = ca.diagcat(quaternion_rates(e), ca.SX.eye(3))
    q = plain.with_quasi_velocities("w1 w2 w3 s1 s2 s3", V, invariants={"unit": ca.sumsqr(e) - 1})
    w, s = ca.vertcat(*q.w()[:3]), ca.vertcat(*q.w()[3:])
    dw, ds = ca.vertcat(*q.w(1)[:3]), ca.vertcat(*q.w(1)[3:])
    momentum = ca.vertcat(p.J1, p.J2, p.J3) * w + p.J_w * s  # N m s, along the body's axes
    S = ca.dot(dw, ca.vertcat(p.J1, p.J2, p.J3) * dw) / 2 + p.J_w * ca.dot(ds, ds / 2 + dw)
    S += ca.dot(dw, ca.cross(w, momentum))  # (3.11) of the satellite and its wheels
    turned = sv.paths.rest_to_rest(q.t, 0.0, turn * ca.pi / 180, duration=duration, smoothness=2)
    axes = attitude(e)
    axles = ca.horzsplit(axes)
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        actuators={f"motor{i + 1}": ca.SX.eye(6)[:, 3 + i] for i in range(3)},
        shapes={f"axle {i + 1}": [(0, 0, 0), 0.6 * axle] for i, axle in enumerate(axles)}
        | {
            f"wheel {i + 1}": sv.shapes.disc(0.6 * axle, 0.15, angle, (axles[i - 2], axles[i - 1]))[:-1]
            for i, (axle, angle) in enumerate(zip(axles, list(plain)[4:], strict=True))
        }
        | {"pointer": [1.2 * axles[2]]},
        units=dict.fromkeys(q.velocity_names, "rad/s"),
        parameters=p,
    )
    residuals = sv.programs.orientation("turn", axes, sv.rotations.turn(turned, AXIS))
    return mechanism, sv.Program(residuals, by="actuators")


def quaternion_rates(e):
    """The matrix (4, 3) of e' = V ω for a unit quaternion e, from the body's to the inertial axes, and body rates ω."""
    e0, e1, e2, e3 = ca.vertsplit(e)
    rows = [[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) / 2


def attitude(e):
    """The rotation matrix of a unit quaternion; its columns are the body's axes."""
    cross = ca.skew(e[1:])
    return ca.SX.eye(3) + 2 * e[0] * cross + 2 * cross @ cross
