"""A one-legged hopper in flight, whose limbs turn its trunk."""

import casadi as ca

import servoctl as sv

HANGING = {"leg": -1.57, "left": 2.6, "right": 0.5}  # rad from the trunk's axis across, at the start


def hopper():
    """The leg swings by 1.2 rad in 0.5 s of flight, the arms by 0.6 rad; the trunk turns, as nothing turns the whole.

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "hip", "left_shoulder", "right_shoulder" [N m]; z points up.
    """
    p = sv.parameters(m=20.0, J=0.6, m_leg=5.0, l_leg=0.4, m_arm=1.5, l_arm=0.35, g=9.81)  # kg, kg m^2, kg, m, ...
    q = sv.coordinates("x z phi leg left right", units="m m rad rad rad rad")  # limbs relative
    x, z, phi, *limbs = q
    centre = ca.vertcat(x, z)
    masses, lengths = (p.m_leg, p.m_arm, p.m_arm), (p.l_leg, p.l_arm, p.l_arm)
    ends = [centre + l * ca.vertcat(ca.cos(phi + a), ca.sin(phi + a)) for a, l in zip(limbs, lengths, strict=True)]
    S = sv.rigid_body(q, p.m, (0, 0, p.J), position=centre, rates=(0, 0, q.d(1)[2]))
    S += sum(sv.particle(q, m, end) for m, end in zip(masses, ends, strict=True))
    height = p.m * z + sum(m * end[1] for m, end in zip(masses, ends, strict=True))
    swings = zip(HANGING.items(), (1.2, 0.6, 0.6), strict=True)
    paths = {name: sv.paths.rest_to_rest(start, start + by, duration=0.5) for (name, start), by in swings}
    r = q.references(**paths)
    mechanism = sv.Mechanism(
        q,
        gibbs=S,
        potential=p.g * height,
        actuators=dict(zip(("hip", "left_shoulder", "right_shoulder"), limbs, strict=True)),
        shapes={
            "ground": [(-0.2, -0.6), (1.4, -0.6)],
            "trunk": sv.shapes.box(centre, 0.25, 0.5, phi),
            **{name: [centre, end] for name, end in zip(HANGING, ends, strict=True)},
            "centre": [centre],
        },
        parameters=p,
    )
    return mechanism, sv.Program({name: q[name] - r[name] for name in paths}, by="actuators")
