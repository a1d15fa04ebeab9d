"""Mechanisms and programs that several test modules share; `conftest` derives and simulates them once."""

import servoctl as sv
from servoctl.gallery import gallery

CRANE, CRANE_PROGRAM = gallery["overhead-crane"].build()
ROPE = gallery["overhead-crane-redundant"].build()[0]

CERTIFIED = (  # scenes that every method and treatment of drift is tested on; the others are verified once, by default
    "overhead-crane", "winch-crane", "crane-3d", "two-cars", "three-cars", "vtol", "overhead-crane-redundant",
    "winch-crane-redundant", "crane-3d-redundant", "mass-on-car-absolute", "mass-on-car", "passive-arm", "pendubot",
    "vtol-centre", "two-link-arm", "appell-hamel", "two-cars-ideal", "constant-speed", "spiral", "wheeled-robot",
    "appell-hamel-squared", "constant-speed-horizontal",
)  # fmt: skip

KINDS = (  # flat, redundant, internal dynamics, unstable ones, ideal, rolling, order 3, quasi-velocities, an end
    "overhead-crane", "crane-3d-redundant", "mass-on-car", "vtol-centre", "two-cars-ideal", "appell-hamel", "spiral",
    "wheeled-robot", "appell-hamel-squared",
)  # fmt: skip


def point_mass(smoothness=3):
    """A driven mass of 2 kg that moves by 1 m in 1 s."""
    p = sv.parameters(m=2.0)
    q = sv.coordinates("x")
    (x,) = q
    r = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=smoothness))
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, x), actuators={"force": x}, parameters=p)
    return mechanism, sv.Program({"X": x - r.X}, by="actuators")


POINT, POINT_PROGRAM = point_mass()
