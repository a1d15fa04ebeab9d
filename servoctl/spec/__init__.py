"""What the designer says: coordinates, bodies, mechanisms, programs, paths."""

from servoctl.spec import paths, rotations, shapes
from servoctl.spec.bodies import body_rates, particle, rigid_body
from servoctl.spec.coordinates import Coordinates, coordinates
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.parameters import Parameters, parameters
from servoctl.spec.program import Program

__all__ = [
    "Coordinates",
    "Mechanism",
    "Parameters",
    "Program",
    "body_rates",
    "coordinates",
    "parameters",
    "particle",
    "paths",
    "rigid_body",
    "rotations",
    "shapes",
]
