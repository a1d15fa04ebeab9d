"""Paths as values: what a program follows, known with its derivatives, from ends, points, functions, samples, SciPy.

A path is a piecewise polynomial of time::

    path = sv.paths.rest_to_rest(start=(0.0, 4.0), end=(5.0, 2.0), duration=6.0, smoothness=4)
    path(3.0), path.jets(3.0, order=4), path[0] + 1.0, path.then(back), path.at_rate(0.5)

`rest_to_rest`, `trapezoid` and `spline` take parameters of a mechanism in place of numbers: a `ParametricPath`. Curves
along a path are in `sv.curves`.
"""

from servoctl.spec.paths.fit import fit, function
from servoctl.spec.paths.makers import polynomials, rest_to_rest, s_curve, spline, trapezoid
from servoctl.spec.paths.parametric import ParametricPath
from servoctl.spec.paths.scipy_paths import as_path
from servoctl.spec.paths.value import Path

_ELSEWHERE = {"circle": "sv.curves.circle", "line": "sv.curves.line", "piecewise": "sv.paths.polynomials"}

__all__ = [
    "ParametricPath",
    "Path",
    "as_path",
    "fit",
    "function",
    "polynomials",
    "rest_to_rest",
    "s_curve",
    "spline",
    "trapezoid",
]


def __getattr__(name):
    where = f" It is {_ELSEWHERE[name]} now." if name in _ELSEWHERE else ""
    raise AttributeError(f"sv.paths has no {name!r}.{where}")
