"""The gallery: mechanisms with programs, ready to derive and simulate.

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

from servoctl.gallery.appell_hamel import appell_hamel
from servoctl.gallery.cars import cars
from servoctl.gallery.constant_speed import constant_speed
from servoctl.gallery.cranes import crane_3d, overhead_crane, winch_crane
from servoctl.gallery.links import planar_arm, spatial_arm
from servoctl.gallery.mass_on_car import mass_on_car
from servoctl.gallery.spirals import spiral
from servoctl.gallery.two_links import passive_arm, pendubot, two_link_arm
from servoctl.gallery.vtol import vtol
from servoctl.gallery.wheeled_robot import wheeled_robot

__all__ = [
    "Scene",
    "appell_hamel",
    "cars",
    "constant_speed",
    "crane_3d",
    "gallery",
    "mass_on_car",
    "overhead_crane",
    "passive_arm",
    "pendubot",
    "planar_arm",
    "spatial_arm",
    "spiral",
    "two_link_arm",
    "vtol",
    "wheeled_robot",
    "winch_crane",
]


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
        appell_hamel, "The Appell-Hamel mechanism, linear rolling constraints, ideal (Emami et al.).", **_APPELL_HAMEL
    ),
    "appell-hamel-squared": Scene(
        partial(appell_hamel, "squared"),
        "The paper's own form (4.4): singular when the wheel stops, at 0.698 s.",
        **_APPELL_HAMEL,
    ),
    "overhead-crane": Scene(
        overhead_crane,
        "A trolley and a hoist carry a load along a straight path.",
        guess={"l": 4.0},
        t_span=(0.0, 8.0),
        units=_units("x l X Z [m] theta [rad] trolley hoist tension [N]"),
    ),
    "overhead-crane-redundant": Scene(
        partial(overhead_crane, coordinates="redundant"),
        "The same crane in redundant coordinates, its rope a material constraint.",
        guess={"l": 4.0, "Z": 4.0},
        t_span=(0.0, 8.0),
        units=_units("x l X Z [m] trolley hoist tension [N]"),
    ),
    "winch-crane": Scene(
        winch_crane,
        "Blajer's crane: a trolley and a winch carry a load.",
        guess={"beta": 40.0},
        t_span=(0.0, 6.0),
        units=_units("x X Z [m] beta theta [rad] trolley [N] winch [N m] tension [N]"),
    ),
    "winch-crane-redundant": Scene(
        partial(winch_crane, "redundant"),
        "The winch crane in redundant coordinates, its rope a material constraint.",
        guess={"beta": 40.0, "Z": 4.0},
        t_span=(0.0, 6.0),
        units=_units("x [m] beta [rad] X Z [m] trolley [N] winch [N m] tension [N]"),
    ),
    "crane-3d": Scene(
        crane_3d,
        "A bridge, a trolley and a hoist lift a load along a quarter turn.",
        guess={"l": 5.0},
        t_span=(0.0, 6.0),
        units=_units("x y l X Y Z [m] theta phi [rad] bridge trolley hoist tension [N]"),
    ),
    "crane-3d-redundant": Scene(
        partial(crane_3d, "redundant"),
        "The three-dimensional crane in redundant coordinates, its rope a material constraint.",
        guess={"l": 5.0, "Z": 5.0},
        t_span=(0.0, 6.0),
        units=_units("x y l X Y Z [m] bridge trolley hoist tension [N]"),
    ),
    "two-cars": Scene(
        cars,
        "Two cars joined by a spring: the first follows a path, the second is driven.",
        t_span=(0.0, 2.0),
        units=_units("x1 x2 [m] force [N]"),
    ),
    "two-cars-ideal": Scene(
        partial(cars, by="ideal"),
        "The same program by an ideal reaction, which acts on the first car: another motion.",
        start={"x2": 0.0, "dx2": 0.0},
        t_span=(0.0, 2.0),
        units=_units("x1 x2 [m] force [N]"),
    ),
    "three-cars": Scene(
        partial(cars, 3),
        "Three cars joined by springs: the first follows a path, the last is driven; index 7.",
        t_span=(0.0, 2.0),
        units=_units("x1 x2 x3 [m] force [N]"),
    ),
    "mass-on-car": Scene(
        mass_on_car,
        "A mass on an inclined guide of a driven car follows a path; two internal states.",
        start={"s": 0.0, "ds": 0.0},
        t_span=(0.0, 6.0),
        units=_units("x s [m] force [N]"),
    ),
    "mass-on-car-absolute": Scene(
        partial(mass_on_car, coordinates="absolute"),
        "The same mass and car in absolute coordinates, the guide a material constraint.",
        start={"x": 0.5, "dx": 0.0},
        t_span=(0.0, 6.0),
        units=_units("x x_m y_m [m] force [N]"),
    ),
    "spiral": Scene(
        spiral,
        "A particle whose curvature grows steadily: Cornu's spiral, a program of order 3.",
        start={"x": 0.0, "y": 0.0, "dx": 1.0, "dy": 0.0, "d2y": 0.0},
        t_span=(0.0, 2.0),
        units=_units("x y [m]"),
    ),
    "constant-speed": Scene(
        constant_speed,
        "A particle kept at constant speed in gravity by an ideal reaction.",
        start={"x": 0.0, "y": 0.0, "dy": 0.0},
        guess={"dx": 5.0},
        t_span=(0.0, 1.0),
        units=_units("x y [m] thrust [N]"),
    ),
    "constant-speed-horizontal": Scene(
        partial(constant_speed, "horizontal"),
        "The same program by a horizontal force: it ends at v/g = 0.510 s.",
        start={"x": 0.0, "y": 0.0, "dy": 0.0},
        guess={"dx": 5.0},
        t_span=(0.0, 1.0),
        units=_units("x y [m] thrust [N]"),
    ),
    "passive-arm": Scene(
        passive_arm,
        "An arm with an elastic passive joint turns by 90 degrees; two stable internal states.",
        start={"q2": 0.0, "dq2": 0.0},
        t_span=(0.0, 3.0),
        units=_units("q1 q2 [rad] torque [N m]"),
    ),
    "vtol": Scene(
        vtol,
        "The flat point of an aircraft with tilted thrusters follows a path.",
        t_span=(0.0, 4.0),
        units=_units("x z [m] theta [rad] u1 u2 [N]"),
    ),
    "vtol-centre": Scene(
        partial(vtol, "centre"),
        "Its centre of mass instead: the internal dynamics are unstable.",
        start={"theta": 0.0, "dtheta": 0.0},
        t_span=(0.0, 1.0),
        units=_units("x z [m] theta [rad] u1 u2 [N]"),
    ),
    "two-link-arm": Scene(
        two_link_arm,
        "The end point of an arm with two driven joints moves along a line, in gravity.",
        guess={"q1": -0.4, "q2": 1.5},
        t_span=(0.0, 2.0),
        units=_units("q1 q2 [rad] shoulder elbow [N m] X_end Y_end [m]"),
    ),
    "pendubot": Scene(
        pendubot,
        "The shoulder of a two-link arm swings it up by 90 degrees; the elbow is passive.",
        start={"q2": 0.0, "dq2": 0.0},
        t_span=(0.0, 3.0),
        units=_units("q1 q2 [rad] shoulder [N m] X_end Y_end [m]"),
    ),
    "wheeled-robot": Scene(
        wheeled_robot,
        "A wheeled robot turns by 90 degrees at constant speed; the rate of its path's curvature is programmed.",
        start={"x": 0.0, "y": 0.0, "psi": 0.0, "r": 0.0},
        guess={"v": 1.0},
        t_span=(0.0, 5.0),
        units=_units("x y [m] psi [rad] drive [N] steer [N m] curvature [1/m]"),
    ),
}
