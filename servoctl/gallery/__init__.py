"""The gallery: mechanisms with programs, ready to derive and simulate.

::

    from servoctl.gallery import gallery
    scene = gallery["overhead-crane"]
    model = sv.derive(*scene.build())
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)

A user's file serves as a scene if it defines `scene()`, which returns (Mechanism, Program), and optionally START,
GUESS, T_SPAN and UNITS with the meanings of `start`, `guess`, `t_span` and `units` below.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module

BUILDERS = {  # name of a function: its module in this package, imported when it is used
    "appell_hamel": "rolling",
    "cars": "springs",
    "constant_speed": "speed",
    "crane_3d": "cranes",
    "mass_on_car": "guides",
    "overhead_crane": "cranes",
    "passive_arm": "two_links",
    "pendubot": "two_links",
    "planar_arm": "links",
    "spatial_arm": "links",
    "spiral": "spirals",
    "two_link_arm": "two_links",
    "vtol": "aircraft",
    "wheeled_robot": "wheels",
    "winch_crane": "cranes",
}
__all__ = ["Scene", "gallery", *BUILDERS]


def __getattr__(name):
    if name not in BUILDERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{BUILDERS[name]}"), name)


def __dir__():
    return sorted({*globals(), *BUILDERS})


def _built(name, *arguments, **options):
    return __getattr__(name)(*arguments, **options)


@dataclass(frozen=True)
class Scene:
    """A mechanism with a program, initial values and a time span.

    Parameters
    ----------
    build : callable
        Returns (Mechanism, Program).
    description : str
        One sentence.
    start : dict of str to float
        Free initial values by name, SI.
    guess : dict of str to float
        Guesses of the other initial values by name, SI.
    t_span : (2,) tuple of float
        [s]
    units : dict of str to str
        Unit of each coordinate, actuator and output, by name.
    """

    build: Callable
    description: str
    start: dict = field(default_factory=dict)
    guess: dict = field(default_factory=dict)
    t_span: tuple = (0.0, 1.0)
    units: dict = field(default_factory=dict)


def _units(text):
    """Units by name, from names followed by their unit in brackets."""
    return {name: unit for names, unit in re.findall(r"([^\[]+)\[([^]]+)\]", text) for name in names.split()}


_APPELL_HAMEL = {
    "start": {"x": 0.0, "y": 0.0, "phi": 0.0, "theta": 0.0, "dphi": 1.0, "dtheta": 2.0},
    "guess": {"dx": 0.5, "dy": 0.6},
    "t_span": (0.0, 2.0),
    "units": _units("x y z [m] phi theta [rad] tension [N]"),
}

gallery = {
    "appell-hamel": Scene(
        partial(_built, "appell_hamel"),
        "The Appell-Hamel mechanism, linear rolling constraints, ideal (Emami et al.).",
        **_APPELL_HAMEL,
    ),
    "appell-hamel-squared": Scene(
        partial(_built, "appell_hamel", "squared"),
        "The paper's squared form (4.4): singular when the wheel stops, at 0.698 s.",
        **_APPELL_HAMEL,
    ),
    "overhead-crane": Scene(
        partial(_built, "overhead_crane"),
        "A trolley and a hoist carry a load along a straight path.",
        guess={"l": 4.0},
        t_span=(0.0, 8.0),
        units=_units("x l X Z [m] theta [rad] trolley hoist tension [N]"),
    ),
    "overhead-crane-redundant": Scene(
        partial(_built, "overhead_crane", coordinates="redundant"),
        "The same crane in redundant coordinates, its rope a material constraint.",
        guess={"l": 4.0, "Z": 4.0},
        t_span=(0.0, 8.0),
        units=_units("x l X Z [m] trolley hoist tension [N]"),
    ),
    "winch-crane": Scene(
        partial(_built, "winch_crane"),
        "Blajer's crane: a trolley and a winch carry a load.",
        guess={"beta": 40.0},
        t_span=(0.0, 6.0),
        units=_units("x X Z [m] beta theta [rad] trolley [N] winch [N m] tension [N]"),
    ),
    "winch-crane-redundant": Scene(
        partial(_built, "winch_crane", "redundant"),
        "The winch crane in redundant coordinates, its rope a material constraint.",
        guess={"beta": 40.0, "Z": 4.0},
        t_span=(0.0, 6.0),
        units=_units("x [m] beta [rad] X Z [m] trolley [N] winch [N m] tension [N]"),
    ),
    "crane-3d": Scene(
        partial(_built, "crane_3d"),
        "A bridge, a trolley and a hoist lift a load along a quarter turn.",
        guess={"l": 5.0},
        t_span=(0.0, 6.0),
        units=_units("x y l X Y Z [m] theta phi [rad] bridge trolley hoist tension [N]"),
    ),
    "crane-3d-redundant": Scene(
        partial(_built, "crane_3d", "redundant"),
        "The three-dimensional crane in redundant coordinates, its rope a material constraint.",
        guess={"l": 5.0, "Z": 5.0},
        t_span=(0.0, 6.0),
        units=_units("x y l X Y Z [m] bridge trolley hoist tension [N]"),
    ),
    "two-cars": Scene(
        partial(_built, "cars"),
        "Two cars joined by a spring: the first follows a path, the second is driven.",
        t_span=(0.0, 2.0),
        units=_units("x1 x2 [m] force [N]"),
    ),
    "two-cars-ideal": Scene(
        partial(_built, "cars", by="ideal"),
        "The same program by an ideal reaction, which acts on the first car: another motion.",
        start={"x2": 0.0, "dx2": 0.0},
        t_span=(0.0, 2.0),
        units=_units("x1 x2 [m] force [N]"),
    ),
    "three-cars": Scene(
        partial(_built, "cars", 3),
        "Three cars joined by springs: the first follows a path, the last is driven; index 7.",
        t_span=(0.0, 2.0),
        units=_units("x1 x2 x3 [m] force [N]"),
    ),
    "mass-on-car": Scene(
        partial(_built, "mass_on_car"),
        "A mass on an inclined guide of a driven car follows a path; two internal states.",
        start={"s": 0.0, "ds": 0.0},
        t_span=(0.0, 6.0),
        units=_units("x s [m] force [N]"),
    ),
    "mass-on-car-absolute": Scene(
        partial(_built, "mass_on_car", coordinates="absolute"),
        "The same mass and car in absolute coordinates, the guide a material constraint.",
        start={"x": 0.5, "dx": 0.0},
        t_span=(0.0, 6.0),
        units=_units("x x_m y_m [m] force [N]"),
    ),
    "spiral": Scene(
        partial(_built, "spiral"),
        "A particle whose curvature grows steadily: Cornu's spiral, a program of order 3.",
        start={"x": 0.0, "y": 0.0, "dx": 1.0, "dy": 0.0, "d2y": 0.0},
        t_span=(0.0, 2.0),
        units=_units("x y [m]"),
    ),
    "constant-speed": Scene(
        partial(_built, "constant_speed"),
        "A particle kept at constant speed in gravity by an ideal reaction.",
        start={"x": 0.0, "y": 0.0, "dy": 0.0},
        guess={"dx": 5.0},
        t_span=(0.0, 1.0),
        units=_units("x y [m] thrust [N]"),
    ),
    "constant-speed-horizontal": Scene(
        partial(_built, "constant_speed", "horizontal"),
        "The same program by a horizontal force: it ends at v/g = 0.510 s.",
        start={"x": 0.0, "y": 0.0, "dy": 0.0},
        guess={"dx": 5.0},
        t_span=(0.0, 1.0),
        units=_units("x y [m] thrust [N]"),
    ),
    "passive-arm": Scene(
        partial(_built, "passive_arm"),
        "An arm with an elastic passive joint turns by 90 degrees; two stable internal states.",
        start={"q2": 0.0, "dq2": 0.0},
        t_span=(0.0, 3.0),
        units=_units("q1 q2 [rad] torque [N m]"),
    ),
    "vtol": Scene(
        partial(_built, "vtol"),
        "The flat point of an aircraft with tilted thrusters follows a path.",
        t_span=(0.0, 4.0),
        units=_units("x z [m] theta [rad] u1 u2 [N]"),
    ),
    "vtol-centre": Scene(
        partial(_built, "vtol", "centre"),
        "Its centre of mass instead: the internal dynamics are unstable.",
        start={"theta": 0.0, "dtheta": 0.0},
        t_span=(0.0, 1.0),
        units=_units("x z [m] theta [rad] u1 u2 [N]"),
    ),
    "two-link-arm": Scene(
        partial(_built, "two_link_arm"),
        "The end point of an arm with two driven joints moves along a line, in gravity.",
        guess={"q1": -0.4, "q2": 1.5},
        t_span=(0.0, 2.0),
        units=_units("q1 q2 [rad] shoulder elbow [N m] X_end Y_end [m]"),
    ),
    "pendubot": Scene(
        partial(_built, "pendubot"),
        "The shoulder of a two-link arm swings it up by 90 degrees; the elbow is passive.",
        start={"q2": 0.0, "dq2": 0.0},
        t_span=(0.0, 3.0),
        units=_units("q1 q2 [rad] shoulder [N m] X_end Y_end [m]"),
    ),
    "wheeled-robot": Scene(
        partial(_built, "wheeled_robot"),
        "A wheeled robot turns by 90 degrees at constant speed; the rate of its path's curvature is programmed.",
        start={"x": 0.0, "y": 0.0, "psi": 0.0, "r": 0.0},
        guess={"v": 1.0},
        t_span=(0.0, 5.0),
        units=_units("x y [m] psi [rad] drive [N] steer [N m] curvature [1/m]"),
    ),
}
