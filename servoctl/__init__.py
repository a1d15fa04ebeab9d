"""servoctl: program (servo) constraints of any order become reduced dynamics, required actuation and a motion.

A specification flows one way: Mechanism and Program, by `derive`, become a Model; `simulate` makes it a Run;
`verify` proves the run against the full mechanism.
"""

from servoctl import plots, spec
from servoctl.control.time_law import TimeLaw, fastest
from servoctl.errors import (
    InconsistentStart,
    IntegrationStopped,
    LimitExceeded,
    NameUnknown,
    NotRealisable,
    ServoError,
    SingularProgram,
    SpecificationError,
    UnstableInternalDynamics,
)
from servoctl.model.model import Model, derive
from servoctl.simulation.drift import poles, project
from servoctl.simulation.internal import InternalDynamics, internal_dynamics
from servoctl.simulation.run import Run, load
from servoctl.simulation.simulate import simulate
from servoctl.simulation.verify import Verification, verify
from servoctl.spec import (
    Coordinates,
    Mechanism,
    Parameters,
    Program,
    body_rates,
    coordinates,
    parameters,
    particle,
    paths,
    rigid_body,
)

__version__ = "0.1.0"

__all__ = [
    "Coordinates",
    "InconsistentStart",
    "InternalDynamics",
    "IntegrationStopped",
    "LimitExceeded",
    "Mechanism",
    "Model",
    "NameUnknown",
    "NotRealisable",
    "Parameters",
    "Program",
    "Run",
    "ServoError",
    "SingularProgram",
    "SpecificationError",
    "TimeLaw",
    "UnstableInternalDynamics",
    "Verification",
    "body_rates",
    "coordinates",
    "derive",
    "fastest",
    "internal_dynamics",
    "load",
    "parameters",
    "particle",
    "paths",
    "plots",
    "poles",
    "project",
    "rigid_body",
    "simulate",
    "spec",
    "verify",
]
