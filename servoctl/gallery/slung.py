"""Quadrotors that carry a load on a rope, in a plane and in space; the load follows a path."""

import casadi as ca

import servoctl as sv


def slung_load():
    """A quadrotor in a vertical plane; its load moves from (0, -1.2) to (4, 0.3) m in 4 s.

    The load's position is a flat output: the rope points along the load's acceleration less gravity, the rotors along
    what the rope and the quadrotor's own acceleration need, so that the moment contains the path's sixth derivative.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "thrust" [N] and "moment" [N m]. Outputs "X", "Z" of the load [m], Z up.
    """
    p = sv.parameters(m=1.0, J=0.02, m_load=0.5, L=1.2, g=9.81)  # kg, kg m^2, kg, m, m/s^2
    q = sv.coordinates("x z theta alpha", units="m m rad rad")  # z up, alpha of the rope from the vertical
    x, z, theta, alpha = q
    load = ca.vertcat(x + p.L * ca.sin(alpha), z - p.L * ca.cos(alpha))
    S = sv.rigid_body(q, p.m, (0, 0, p.J), position=(x, z), rates=(0, 0, q.d(1)[2])) + sv.particle(q, p.m_load, load)
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.g * (p.m * z + p.m_load * load[1]),
        actuators={"thrust": ca.vertcat(-ca.sin(theta), ca.cos(theta), 0, 0), "moment": theta},
        outputs={"X": load[0], "Z": load[1]},
        units={"X": "m", "Z": "m", "thrust": "N"},
        shapes={"body": sv.shapes.box((x, z), 0.8, 0.1, theta), "rope": [(x, z), load], "load": [load]},
        parameters=p,
    )
    path = sv.paths.rest_to_rest(start=(0.0, -1.2), end=(4.0, 0.3), duration=4.0, smoothness=6)
    r = q.references(across=path[0], up=path[1])
    return mechanism, sv.Program({"across": load[0] - r.across, "up": load[1] - r.up}, by="actuators")


def slung_load_3d():
    """A quadrotor in space; its load rises by 1 m along a quarter turn of 2 m in 5 s, and the nose keeps its heading.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "thrust" [N] along the third axis of the body, and "roll", "pitch", "yaw" [N m] about
        its axes. Its attitude is psi about z, then theta about y, then phi about x; the rope points along
        (sin α, -cos α sin β, -cos α cos β). Outputs "X", "Y", "Z" of the load [m], Z up.
    """
    p = sv.parameters(m=1.0, J=0.02, J_z=0.04, m_load=0.5, L=1.2, g=9.81)  # kg, kg m^2, kg m^2, kg, m, m/s^2
    q = sv.coordinates("x y z alpha beta psi theta phi", units="m m m rad rad rad rad rad")  # z up
    x, y, z, alpha, beta, *angles = q
    body = ca.vertcat(x, y, z)
    rope = ca.vertcat(ca.sin(alpha), -ca.cos(alpha) * ca.sin(beta), -ca.cos(alpha) * ca.cos(beta))
    load = body + p.L * rope
    axes = ca.SX.eye(3)
    for angle, axis in zip(angles, ((0, 0, 1), (0, 1, 0), (1, 0, 0)), strict=True):
        axes = axes @ sv.rotations.turn(angle, axis)
    rates = sv.body_rates(q, axes)
    S = sv.rigid_body(q, p.m, (p.J, p.J, p.J_z), position=body, rates=rates) + sv.particle(q, p.m_load, load)
    turning = ca.jacobian(rates, ca.vertcat(*q.d(1))).T  # a column for each moment
    (s,) = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=5.0, smoothness=6))
    turn = sv.curves.circle(ca.pi / 2 * (s - 1), centre=(0.0, 2.0), radius=2.0)
    path = ca.vertcat(turn, sv.curves.line(s, -1.2, -0.2))
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.g * (p.m * z + p.m_load * load[2]),
        actuators={"thrust": ca.vertcat(axes[:, 2], ca.SX(5, 1))}
        | dict(zip(("roll", "pitch", "yaw"), ca.horzsplit(turning), strict=True)),
        outputs=dict(zip("XYZ", load.elements(), strict=True)),
        units=dict.fromkeys("XYZ", "m") | {"thrust": "N"} | dict.fromkeys(("roll", "pitch", "yaw"), "N m"),
        shapes={f"arm {i + 1}": [body - 0.4 * axes[:, i], body + 0.4 * axes[:, i]] for i in (0, 1)}
        | {"rope": [body, load], "load": [load]},
        parameters=p,
    )
    residuals = sv.programs.follow_point("load", load, path) | {"heading": q["psi"]}
    return mechanism, sv.Program(residuals, by="actuators")
