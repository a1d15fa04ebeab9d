"""Arms that bend: a joint with an elastic gear and friction, and a link of elastic segments."""

from itertools import accumulate

import casadi as ca

import servoctl as sv
from servoctl.errors import SpecificationError


def flexible_joint(friction=2.0):
    """A link in gravity turns by 90 degrees in 1 s, by a motor behind an elastic gear, with friction on both sides.

    The motor's angle follows from the link's acceleration and the torque from its fourth derivative; friction is
    tanh(rate/0.1 rad/s), smooth enough for both.

    Parameters
    ----------
    friction : float
        Largest torque of dry friction on the link [N m]; half of it acts on the motor.

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "torque" [N m] on the motor.
    """
    p = sv.parameters(m=5.0, l=0.5, I=1.7, J=0.2, k=500.0, c=friction, g=9.81)  # kg, m, kg m^2, kg m^2, N m/rad, N m
    q = sv.coordinates("link motor", units="rad rad")  # from the horizontal, behind the gear
    link, motor = q
    rubbing = ca.tanh(ca.vertcat(*q.d(1)) / 0.1)
    r = q.references(angle=sv.paths.rest_to_rest(-ca.pi / 2, 0.0, duration=1.0, smoothness=4))
    end, hand = (ca.vertcat(ca.cos(angle), ca.sin(angle)) for angle in (link, motor))
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.I, link) + sv.particle(q, p.J, motor),
        potential=p.m * p.g * p.l * ca.sin(link) + p.k * (link - motor) ** 2 / 2,
        forces=-ca.vertcat(p.c, p.c / 2) * rubbing,
        actuators={"torque": motor},
        shapes={
            "rotor": sv.shapes.disc((0, 0), 0.1, motor),
            "motor's angle": [0.1 * hand, 0.3 * hand],
            "link": [(0, 0), 2 * p.l * end],
            "end": [2 * p.l * end],
        },
        parameters=p,
    )
    return mechanism, sv.Program({"angle": link - r.angle}, by="actuators")


def elastic_link(n=4):
    """The hub of an elastic link turns by 90 degrees in 1 s, without gravity; n rods with springs between them follow.

    The first rod's spring is on the hub. Together they bend as a beam does: the internal dynamics are a clamped beam's
    vibration, whose slowest frequency tends to 3.516 sqrt(EI/(m l³)) with n.

    Parameters
    ----------
    n : int
        Number of rods, at least 1.

    Returns
    -------
    Mechanism, Program
        Realised by the actuator "torque" [N m] on the hub. Outputs "X", "Y" of the tip [m].

    Raises
    ------
    SpecificationError
        If there is no rod.
    """
    if n < 1:
        raise SpecificationError(f"A link of {n} rods.", "It has one at least.", nearest="n = 1.", n=n)
    p = sv.parameters(J=0.2, m=2.0, l=1.0, EI=20.0, tau=0.002)  # kg m^2 of the hub, kg, m, N m^2, s
    names = ["hub", *(f"bend{i}" for i in range(1, n + 1))]  # each from the one before
    q = sv.coordinates(" ".join(names), units="rad " * (n + 1))
    hub, *bends = q
    mass, length = p.m / n, p.l / n
    springs = p.EI / length * ca.DM([2.0] + [1.0] * (n - 1))  # N m/rad: the first bends over half a rod
    joints, S = [ca.SX.zeros(2)], sv.particle(q, p.J, hub)
    for angle in list(accumulate(q))[1:]:
        joints.append(joints[-1] + length * ca.vertcat(ca.cos(angle), ca.sin(angle)))
        middle = (joints[-1] + joints[-2]) / 2
        S += sv.rigid_body(q, mass, (0, 0, mass * length**2 / 12), position=middle, rates=(0, 0, q.dt(angle)))
    r = q.references(angle=sv.paths.rest_to_rest(0.0, ca.pi / 2, duration=1.0, smoothness=2))
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=ca.dot(springs, ca.vertcat(*bends) ** 2) / 2,
        forces=-p.tau * ca.vertcat(0, springs * ca.vertcat(*q.d(1)[1:])),
        actuators={"torque": hub},
        outputs={"X": joints[-1][0], "Y": joints[-1][1]},
        units={"X": "m", "Y": "m"},
        shapes={"hub": sv.shapes.disc((0, 0), 0.08, hub), "link": joints, "tip": [joints[-1]]},
        parameters=p,
    )
    return mechanism, sv.Program({"angle": hub - r.angle}, by="actuators")
