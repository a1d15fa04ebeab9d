"""More cranes: one that slews, two trolleys with a beam, and one whose rope has a fixed length. Z points down."""

from math import pi

import casadi as ca

import servoctl as sv


def rotary_crane():
    """A jib, a trolley on it and a hoist move the load by a quarter turn, 1 m out and 1 m up, in 8 s.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "slew" [N m], "trolley" [N] and "hoist" [N]. The rope points along
        (sin θ, cos θ sin φ, cos θ cos φ), a chart that is regular while |θ| < 90°.
    """
    p = sv.parameters(J=500.0, m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81)  # kg m^2, kg, kg, kg, m/s^2
    q = sv.coordinates("psi r l theta phi", units="rad m m rad rad")
    psi, r, l, theta, phi = q
    trolley = r * ca.vertcat(ca.cos(psi), ca.sin(psi), 0)
    rope = ca.vertcat(ca.sin(theta), ca.cos(theta) * ca.sin(phi), ca.cos(theta) * ca.cos(phi))
    load = trolley + l * rope
    (s,) = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=8.0, smoothness=6))
    path = ca.vertcat((3 + s) * ca.cos(pi / 2 * s), (3 + s) * ca.sin(pi / 2 * s), 5 - s)
    machine = sv.rigid_body(q, 0.0, (0, 0, p.J), rates=(0, 0, q.d(1)[0])) + sv.particle(q, p.m_hoist, l)
    above = ca.vertcat(load[0], load[1], -load[2])
    mechanism = sv.Mechanism(
        q,
        gibbs=machine + sv.particle(q, p.m_trolley, trolley) + sv.particle(q, p.m_load, load),
        potential=-p.m_load * p.g * load[2],
        actuators={"slew": psi, "trolley": r, "hoist": l},
        outputs={
            "tension": p.m_load * (p.g * rope[2] - ca.dot(q.dt(load, 2), rope)),
            **{name: load[i] for i, name in enumerate("XYZ")},
        },
        shapes={
            "jib": [(0, 0, -6), (0, 0, 0), 5 * ca.vertcat(ca.cos(psi), ca.sin(psi), 0)],
            "trolley": [trolley],
            "rope": [trolley, above],
            "load": [above],
        },
        parameters=p,
        units=dict.fromkeys("XYZ", "m") | {"tension": "N"},
    )
    return mechanism, sv.Program({name: load[i] - path[i] for i, name in enumerate("XYZ")}, by="actuators")


def beam_crane():
    """Two trolleys, 2 m apart, and two hoists carry a beam, level, by 4 m to the side and 1 m up in 6 s.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "trolley1", "trolley2", "hoist1", "hoist2" [N]; the ropes are material constraints.
    """
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_beam=200.0, b=1.0, g=9.81)  # kg, kg, kg, half of the length [m]
    q = sv.coordinates("x1 x2 l1 l2 X Z phi", units="m m m m m m rad")
    x1, x2, l1, l2, X, Z, phi = q
    half = p.b * ca.vertcat(ca.cos(phi), ca.sin(phi))
    ends = [ca.vertcat(X, Z) - half, ca.vertcat(X, Z) + half]
    ropes = [end - ca.vertcat(x, 0) for end, x in zip(ends, (x1, x2), strict=True)]
    S = sv.rigid_body(q, p.m_beam, (0, 0, p.m_beam * p.b**2 / 3), position=(X, Z), rates=(0, 0, q.d(1)[6]))
    S += sum(sv.particle(q, p.m_trolley, x) for x in (x1, x2)) + sum(sv.particle(q, p.m_hoist, l) for l in (l1, l2))
    path = sv.paths.rest_to_rest(start=(1.0, 4.0), end=(5.0, 3.0), duration=6.0, smoothness=4)
    r = q.references(X=path[0], Z=path[1])
    above = [ca.vertcat(end[0], -end[1]) for end in ends]
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=-p.m_beam * p.g * Z,
        actuators={"trolley1": x1, "trolley2": x2, "hoist1": l1, "hoist2": l2},
        constraints={f"rope{i}": ca.dot(d, d) - l**2 for i, (d, l) in enumerate(zip(ropes, (l1, l2), strict=True), 1)},
        shapes={
            "rail": [(-0.5, 0), (6.5, 0)],
            **{f"trolley {i}": sv.shapes.box((x, 0), 0.4, 0.2) for i, x in enumerate((x1, x2), 1)},
            **{f"rope {i}": [(x, 0), end] for i, (x, end) in enumerate(zip((x1, x2), above, strict=True), 1)},
            "beam": above,
            "centre": [(X, -Z)],
        },
        parameters=p,
    )
    rows = {"X": X - r.X, "Z": Z - r.Z, "level": phi, "apart": x2 - x1 - 2 * p.b}
    return mechanism, sv.Program(rows, by="actuators")


def fixed_rope_crane(tool=5.0):
    """A trolley moves a tool by 2 m in 4 s; it is 1 m below a load that swings on a rod of 4 m.

    A point above the load leaves an oscillation free. With the tool below it, at a distance d from the trolley, the
    internal dynamics have the poles ±sqrt(g/(d - l)).

    Parameters
    ----------
    tool : float
        Distance of the tool from the trolley [m].

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "cart" [N].
    """
    p = sv.parameters(m_cart=10.0, m_load=100.0, l=4.0, tool=tool, g=9.81)  # kg, kg, m, m, m/s^2
    q = sv.coordinates("x theta", units="m rad")
    x, theta = q
    along = ca.vertcat(ca.sin(theta), -ca.cos(theta))
    cart = ca.vertcat(x, 0)
    load, end = cart + p.l * along, cart + p.tool * along
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m_cart, x) + sv.particle(q, p.m_load, load),
        potential=p.m_load * p.g * load[1],
        actuators={"cart": x},
        outputs={"X_tool": end[0]},
        units={"X_tool": "m"},
        shapes={
            "rail": [(-1, 0), (3, 0)],
            "trolley": sv.shapes.box((x, 0), 0.6, 0.2),
            "load": sv.shapes.disc(load, 0.3),
            "rod": [cart, end],
            "tool": [end],
        },
        parameters=p,
    )
    r = q.references(X=sv.paths.rest_to_rest(0.0, 2.0, duration=4.0))
    return mechanism, sv.Program({"tool": end[0] - r.X}, by="actuators")
