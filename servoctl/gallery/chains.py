"""Closed chains: a four-bar linkage, and a platform on eight ropes."""

import itertools

import casadi as ca

import servoctl as sv


def four_bar():
    """The crank of a four-bar linkage makes a full turn from rest to rest in 3 s; the loop is a material constraint.

    By Grashof's rule the crank turns fully; the rocker swings between the poses where crank and coupler are in line.

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "torque" [N m] of the crank. Outputs "X", "Y" of the coupler's tracing point [m].
    """
    p = sv.parameters(a=0.2, b=0.6, c=0.5, d=0.6, density=5.0, g=9.81)  # m: crank, coupler, rocker, base; kg/m
    q = sv.coordinates("crank coupler rocker", units="rad rad rad")  # from the horizontal
    S, height, tips = 0, 0, []
    starts = (ca.SX.zeros(2), None, ca.vertcat(p.d, 0))
    for start, length, angle, rate in zip(starts, (p.a, p.b, p.c), q, q.d(1), strict=True):
        start = tips[-1] if start is None else start
        tips.append(start + length * ca.vertcat(ca.cos(angle), ca.sin(angle)))
        mass, middle = p.density * length, (start + tips[-1]) / 2
        S += sv.rigid_body(q, mass, (0, 0, mass * length**2 / 12), position=middle, rates=(0, 0, rate))
        height += mass * middle[1]
    pin, joint, end = tips
    across = ca.vertcat(pin[1] - joint[1], joint[0] - pin[0])
    traced = (pin + joint) / 2 + across / 2
    r = q.references(turn=sv.paths.rest_to_rest(0.0, 2 * ca.pi, duration=3.0, smoothness=3))
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.g * height,
        actuators={"torque": q["crank"]},
        constraints={"loop_x": joint[0] - end[0], "loop_y": joint[1] - end[1]},
        outputs={"X": traced[0], "Y": traced[1]},
        units={"X": "m", "Y": "m"},
        shapes={
            "base": [(0, 0), (p.d, 0)],
            "crank": [(0, 0), pin],
            "coupler": [pin, joint],
            "arm": [(pin + joint) / 2, traced],
            "rocker": [(p.d, 0), end],
            "traced": [traced],
        },
        parameters=p,
    )
    return mechanism, sv.Program({"turn": q["crank"] - r.turn}, by="actuators")


def cable_robot(pretension=500.0):
    """Eight ropes from the corners of a room move a platform by 0.47 m and turn it by 0.1 rad, in 3 s.

    Eight tensions for six residuals: of all that move the platform, those nearest to the pretension are taken. It is
    chosen so that no rope goes slack.

    Parameters
    ----------
    pretension : float
        Of all ropes [N].

    Returns
    -------
    Mechanism, Program
        Realised by the tensions "rope1" ... "rope8" [N], those of the upper corners first. z points up.
    """
    p = sv.parameters(m=20.0, Jx=0.6, Jy=0.8, Jz=1.0, g=9.81)  # kg, kg m^2, m/s^2
    q = sv.coordinates("x y z roll pitch yaw", units="m m m rad rad rad")
    x, y, z, roll, pitch, yaw = q
    centre = ca.vertcat(x, y, z)
    tilted = sv.rotations.turn(pitch, (0, 1, 0)) @ sv.rotations.turn(roll, (1, 0, 0))
    turned = sv.rotations.turn(yaw, (0, 0, 1)) @ tilted
    ropes = {}
    for i, (up, side, front) in enumerate(itertools.product((1, -1), repeat=3), 1):
        corner = ca.vertcat(2.0 * front, 1.5 * side, 1.5 * up)
        fixed = ca.vertcat(0.4 * front * up, 0.3 * side, -0.15 * up)  # the upper ropes cross the lower ones
        ropes[f"rope{i}"] = [corner, centre + turned @ fixed]
    path = sv.paths.rest_to_rest((0.0,) * 6, (0.3, 0.2, 0.3, 0.0, 0.0, 0.1), duration=3.0, smoothness=2)
    r = q.references(**{name: path[i] for i, name in enumerate(q.names)})
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.rigid_body(q, p.m, (p.Jx, p.Jy, p.Jz), position=centre, rotation=turned),
        potential=p.m * p.g * z,
        actuators={name: -ca.norm_2(corner - point) for name, (corner, point) in ropes.items()},
        units=dict.fromkeys(ropes, "N"),
        shapes=ropes | {"platform": [ropes[f"rope{i}"][1] for i in (5, 6, 8, 7, 5)], "centre": [centre]},
        parameters=p,
    )
    residuals = {name: q[name] - r[name] for name in q.names}
    return mechanism, sv.Program(residuals, toward=dict.fromkeys(ropes, pretension), by="actuators")
