"""servoctl: programs (servo constraints) of any order become the motion of a machine, its actuation, a controller.

A specification flows one way: Mechanism and Program, by `derive`, become a Model; `simulate` makes it a Run;
`verify` proves the run against the full mechanism.
"""

from importlib import import_module

from servoctl.version import __version__ as __version__

HOMES = {  # of each public name: the module that defines it, or that it is; imported when the name is used
    "Adaptive": "methods.choice",
    "Algebraic": "methods.choice",
    "Batch": "study.batch",
    "Bounded": "methods.choice",
    "Closed": "control.result",
    "Controller": "control.law",
    "Coordinates": "spec.coordinates",
    "Design": "inversion.design",
    "Event": "methods.events",
    "Frame": "robots.robot",
    "Identification": "sensitivities.identification",
    "InconsistentStart": "errors",
    "IntegrationStopped": "errors",
    "InternalDynamics": "growth",
    "Law": "control.law",
    "LimitExceeded": "errors",
    "LimitReport": "control.limits",
    "Mechanism": "spec.mechanism",
    "MinimumPhase": "inversion.output",
    "Model": "model.model",
    "NameUnknown": "errors",
    "NotRealisable": "errors",
    "Parameters": "spec.parameters",
    "Plant": "plants.plant",
    "Poles": "methods.choice",
    "Program": "spec.program",
    "Project": "methods.choice",
    "RadauIIA": "methods.choice",
    "Report": "inversion.report",
    "Robot": "robots.robot",
    "Run": "run",
    "RungeKutta": "methods.choice",
    "Sensitivity": "sensitivities.sensitivity",
    "Sensors": "control.conditions",
    "ServoError": "errors",
    "SingularProgram": "errors",
    "SpecificationError": "errors",
    "StabilityMap": "study.stability_map",
    "Study": "study.table",
    "Taylor": "methods.choice",
    "TimeLaw": "control.time_law",
    "Timing": "control.conditions",
    "TradeOff": "study.tradeoff",
    "UnstableInternalDynamics": "errors",
    "Verification": "verification",
    "body_rates": "spec.bodies",
    "close": "control.close",
    "close_many": "study.close_many",
    "computed": "control.inverse_dynamics",
    "coordinates": "spec.coordinates",
    "derive": "model.model",
    "design": "inversion.design",
    "disturbances": "control.disturbances",
    "export_c": "export.c",
    "fastest": "control.time_law",
    "feedforward": "control.feedforward",
    "figures": "figures",
    "grid": "study.cases",
    "held": "robots.contact",
    "identify": "sensitivities.identification",
    "internal_dynamics": "growth",
    "interop": "interop",
    "inverse": "inversion.choice",
    "limit_report": "control.limits",
    "limited": "control.limits",
    "load": "study.load",
    "loop": "robots.contact",
    "lqr": "control.lqr",
    "minimum_phase": "inversion.output",
    "monte_carlo": "study.cases",
    "output_feedback": "control.observer",
    "parameters": "spec.parameters",
    "particle": "spec.bodies",
    "paths": "spec.paths",
    "pd": "control.pd",
    "plant": "plants.plant",
    "plots": "figures",
    "programs": "programs",
    "relaxed": "inversion.relaxed",
    "report": "inversion.report",
    "rigid_body": "spec.bodies",
    "rotations": "spec.rotations",
    "sampled_bound": "methods.stability",
    "sensitivity": "sensitivities.sensitivity",
    "shapes": "spec.shapes",
    "simulate": "simulation",
    "simulate_many": "study.many",
    "spec": "spec",
    "stability": "study.stability_map",
    "sweep": "study.sweep",
    "tradeoff": "study.tradeoff",
    "urdf": "robots.robot",
    "verify": "verification",
}
__all__ = sorted(HOMES)


def __getattr__(name):
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"{__name__}.{HOMES[name]}")
    globals()[name] = value = getattr(module, name, module)
    return value


def __dir__():
    return sorted({*globals(), *HOMES})
