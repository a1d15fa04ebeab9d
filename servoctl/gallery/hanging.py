"""A cart with a double pendulum that hangs from it."""

import casadi as ca

import servoctl as sv


def double_pendulum():
    """A cart moves by 2 m from rest to rest in 4 s; two equal pendulums hang from it and swing freely.

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "force" [N] on the cart. Outputs "X", "Y" of the lower bob [m], Y up. The internal
        dynamics are the double pendulum's, of the frequencies sqrt((2 ± √2) g/l) about the hanging pose.
    """
    p = sv.parameters(M=5.0, m=1.0, l=0.8, g=9.81)  # kg, kg, m, m/s^2
    q = sv.coordinates("x upper lower", units="m rad rad")  # angles from the vertical
    x, upper, lower = q
    first = ca.vertcat(x + p.l * ca.sin(upper), -p.l * ca.cos(upper))
    second = first + p.l * ca.vertcat(ca.sin(lower), -ca.cos(lower))
    r = q.references(cart=sv.paths.rest_to_rest(0.0, 2.0, duration=4.0, smoothness=2))
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.M, x) + sv.particle(q, p.m, first) + sv.particle(q, p.m, second),
        potential=p.m * p.g * (first[1] + second[1]),
        actuators={"force": x},
        outputs={"X": second[0], "Y": second[1]},
        units={"X": "m", "Y": "m"},
        shapes={
            "rail": [(-0.5, 0), (2.5, 0)],
            "cart": sv.shapes.box((x, 0), 0.5, 0.2),
            "rods": [(x, 0), first, second],
            "upper bob": [first],
            "lower bob": [second],
        },
        parameters=p,
    )
    return mechanism, sv.Program({"cart": x - r.cart}, by="actuators")
