"""servoctl: programs (servo constraints) of any order become the motion of a machine, its actuation, a controller.

A specification flows one way: Mechanism and Program, by `derive`, become a Model; `simulate` makes it a Run;
`verify` proves the run against the full mechanism.
"""

from importlib import import_module

from servoctl.version import __version__ as __version__

HOMES = {  # of each public name: the module that defines it, or that it is; imported when the name is used
    "Event": "methods.events",
    "Law": "control.law",
    "Mechanism": "spec.mechanism",
    "Program": "spec.program",
    "Sensors": "control.conditions",
    "Timing": "control.conditions",
    "body_rates": "spec.bodies",
    "close": "control.close",
    "close_many": "study.close_many",
    "computed": "control.inverse_dynamics",
    "coordinates": "spec.coordinates",
    "curves": "spec.curves",
    "derive": "model.model",
    "design": "inversion.design",
    "disturbances": "control.disturbances",
    "errors": "errors",
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
    "methods": "methods",
    "minimum_phase": "inversion.output",
    "monte_carlo": "study.cases",
    "output_feedback": "control.observer",
    "parameters": "spec.parameters",
    "particle": "spec.bodies",
    "paths": "spec.paths",
    "pd": "control.pd",
    "plant": "plants.plant",
    "programs": "programs",
    "relaxed": "inversion.relaxed",
    "report": "inversion.report",
    "rigid_body": "spec.bodies",
    "rotations": "spec.rotations",
    "sampled_bound": "control.companion",
    "sensitivity": "sensitivities.sensitivity",
    "shapes": "spec.shapes",
    "simulate": "simulation",
    "simulate_many": "study.many",
    "stability": "study.stability_map",
    "sweep": "study.sweep",
    "tradeoff": "study.tradeoff",
    "types": "types",
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
