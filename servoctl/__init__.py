"""servoctl: program (servo) constraints of any order become reduced dynamics, required actuation and a motion.

A specification flows one way: Mechanism and Program, by `derive`, become a Model; `simulate` makes it a Run;
`verify` proves the run against the full mechanism.
"""

from servoctl import figures, interop, spec
from servoctl import figures as plots
from servoctl.control import disturbances
from servoctl.control.close import close
from servoctl.control.conditions import Sensors, Timing
from servoctl.control.feedforward import feedforward
from servoctl.control.inverse_dynamics import computed
from servoctl.control.law import Controller, Law
from servoctl.control.limits import LimitReport, limit_report, limited
from servoctl.control.lqr import lqr
from servoctl.control.observer import output_feedback
from servoctl.control.pd import pd
from servoctl.control.result import Closed
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
from servoctl.export.c import export_c
from servoctl.internal_dynamics import InternalDynamics, internal_dynamics
from servoctl.inversion.choice import inverse
from servoctl.inversion.output import MinimumPhase, minimum_phase
from servoctl.inversion.relaxed import relaxed
from servoctl.inversion.report import Report, report
from servoctl.methods.choice import (
    Adaptive,
    Algebraic,
    Bounded,
    MinimalCoordinates,
    Poles,
    Project,
    RadauIIA,
    RungeKutta,
    Sundials,
    Taylor,
)
from servoctl.methods.events import Event
from servoctl.methods.stability import sampled_bound
from servoctl.model.model import Model, derive
from servoctl.plants.plant import Plant, plant
from servoctl.run import Run, load
from servoctl.sensitivities.identification import Identification, identify
from servoctl.sensitivities.sensitivity import Sensitivity, sensitivity
from servoctl.simulation import simulate
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
from servoctl.study.cases import grid, monte_carlo
from servoctl.study.close_many import Batch, close_many
from servoctl.study.load import load_study
from servoctl.study.many import Motions, simulate_many
from servoctl.study.stability_map import StabilityMap, stability
from servoctl.study.sweep import merge, sweep
from servoctl.study.table import Study
from servoctl.study.tradeoff import TradeOff, tradeoff
from servoctl.verification import Verification, verify
from servoctl.version import __version__ as __version__

__all__ = [
    "Adaptive",
    "Algebraic",
    "Batch",
    "Bounded",
    "Closed",
    "Controller",
    "Coordinates",
    "Event",
    "Identification",
    "InconsistentStart",
    "IntegrationStopped",
    "InternalDynamics",
    "Law",
    "LimitExceeded",
    "LimitReport",
    "Mechanism",
    "MinimalCoordinates",
    "MinimumPhase",
    "Model",
    "Motions",
    "NameUnknown",
    "NotRealisable",
    "Parameters",
    "Plant",
    "Poles",
    "Program",
    "Project",
    "RadauIIA",
    "Report",
    "Run",
    "RungeKutta",
    "Sensitivity",
    "Sensors",
    "ServoError",
    "SingularProgram",
    "SpecificationError",
    "StabilityMap",
    "Study",
    "Sundials",
    "Taylor",
    "TimeLaw",
    "Timing",
    "TradeOff",
    "UnstableInternalDynamics",
    "Verification",
    "body_rates",
    "close",
    "close_many",
    "computed",
    "coordinates",
    "derive",
    "disturbances",
    "export_c",
    "fastest",
    "feedforward",
    "figures",
    "grid",
    "identify",
    "internal_dynamics",
    "interop",
    "inverse",
    "limit_report",
    "limited",
    "load",
    "load_study",
    "lqr",
    "merge",
    "minimum_phase",
    "monte_carlo",
    "output_feedback",
    "parameters",
    "particle",
    "paths",
    "pd",
    "plant",
    "plots",
    "relaxed",
    "report",
    "rigid_body",
    "sampled_bound",
    "sensitivity",
    "simulate",
    "simulate_many",
    "spec",
    "stability",
    "sweep",
    "tradeoff",
    "verify",
]
