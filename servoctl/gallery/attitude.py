"""Satellites whose attitude is a unit quaternion: one that reaction wheels turn, one whose tumbling is braked."""

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
    path = sv.paths.rest_to_rest(0.0, turn * ca.pi / 180, duration=duration, smoothness=2)
    r = q.references(turn=path)
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
    residuals = sv.programs.orientation("turn", axes, sv.rotations.turn(r.turn, AXIS))
    return mechanism, sv.Program(residuals, by="actuators")


def tumbling_satellite(decay=0.1, weights="inertia"):
    """Three torques take the energy out of a satellite's tumbling, by the generalised inverse of one row.

    With the inertia's inverse as the weight they act along the angular momentum, whose direction in space does not
    change; its magnitude falls by exp(-decay t). The body goes through the attitudes of its free motion, and arrives
    at time t where that is at (1 - exp(-decay t))/decay. The plain pseudoinverse acts along the rates instead.

    Servo constraints by generalised inverses are Bajodah's subject; the satellite and its numbers are not his.

    Parameters
    ----------
    decay : float
        Half the rate of the energy's decay [1/s].
    weights : "inertia" or None
        Of the torques; None is the pseudoinverse.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "torque1", "torque2", "torque3" [N m]; of order 1, quadratic in the velocities.
    """
    p = sv.parameters(J1=30.0, J2=40.0, J3=50.0, E=4.0, decay=decay)  # kg m^2, J at the start, 1/s
    plain = sv.coordinates("e0 e1 e2 e3", units="1 1 1 1")  # quaternion of the body
    e = ca.vertcat(*plain)
    q = plain.with_quasi_velocities("w1 w2 w3", quaternion_rates(e), invariants={"unit": ca.sumsqr(e) - 1})
    w, dw = ca.vertcat(*q.w()), ca.vertcat(*q.w(1))
    J = ca.vertcat(p.J1, p.J2, p.J3)
    momentum = J * w  # N m s, along the body's axes
    energy = ca.dot(w, momentum) / 2
    axes = attitude(e)
    outputs = {f"momentum_{name}": entry for name, entry in zip("xyz", ca.vertsplit(axes @ momentum), strict=True)}
    mechanism = sv.Mechanism(
        q,
        gibbs=ca.dot(dw, J * dw) / 2 + ca.dot(dw, ca.cross(w, momentum)),  # (3.11)
        actuators={f"torque{i + 1}": ca.SX.eye(3)[:, i] for i in range(3)},
        outputs=outputs,
        shapes={f"axis {i + 1}": [(0, 0, 0), 0.6 * axle] for i, axle in enumerate(ca.horzsplit(axes))}
        | {"pointer": [1.2 * axes[:, 2]]},
        units=dict.fromkeys(q.velocity_names, "rad/s") | dict.fromkeys(outputs, "N m s"),
        parameters=p,
    )
    return mechanism, sv.Program({"energy": energy - p.E * ca.exp(-2 * p.decay * q.t)}, weights=weights)


def quaternion_rates(e):
    """The matrix (4, 3) of e' = V ω for a unit quaternion e, from the body's to the inertial axes, and body rates ω."""
    e0, e1, e2, e3 = ca.vertsplit(e)
    rows = [[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) / 2


def attitude(e):
    """The rotation matrix of a unit quaternion; its columns are the body's axes."""
    cross = ca.skew(e[1:])
    return ca.SX.eye(3) + 2 * e[0] * cross + 2 * cross @ cross
