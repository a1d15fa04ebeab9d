"""Types of what the functions of the package return, for annotations and `isinstance`."""

from servoctl.control.law import Controller
from servoctl.control.limits import LimitReport
from servoctl.control.result import Closed
from servoctl.control.time_law import TimeLaw
from servoctl.growth import InternalDynamics
from servoctl.inversion.design import Design
from servoctl.inversion.output import MinimumPhase
from servoctl.inversion.report import Report
from servoctl.model.model import Model
from servoctl.model.start import State
from servoctl.model.streaming import Feedforward
from servoctl.plants.plant import Plant
from servoctl.robots.robot import Frame, Robot
from servoctl.run import Run
from servoctl.sensitivities.identification import Identification
from servoctl.sensitivities.sensitivity import Sensitivity
from servoctl.spec.coordinates import Coordinates
from servoctl.spec.parameters import Parameters
from servoctl.study.batch import Batch
from servoctl.study.stability_map import StabilityMap
from servoctl.study.table import Study
from servoctl.study.tradeoff import TradeOff
from servoctl.verification import Verification

__all__ = [
    "Batch",
    "Closed",
    "Controller",
    "Coordinates",
    "Design",
    "Feedforward",
    "Frame",
    "Identification",
    "InternalDynamics",
    "LimitReport",
    "MinimumPhase",
    "Model",
    "Parameters",
    "Plant",
    "Report",
    "Robot",
    "Run",
    "Sensitivity",
    "StabilityMap",
    "State",
    "Study",
    "TimeLaw",
    "TradeOff",
    "Verification",
]
