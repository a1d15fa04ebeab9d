"""Methods of integration and treatments of drift, with their settings, for `simulate`."""

from servoctl.methods.choice import (
    Adaptive,
    Algebraic,
    Bounded,
    Poles,
    Project,
    RadauIIA,
    RungeKutta,
    Taylor,
)

__all__ = [
    "Adaptive",
    "Algebraic",
    "Bounded",
    "Poles",
    "Project",
    "RadauIIA",
    "RungeKutta",
    "Taylor",
]
