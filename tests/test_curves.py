"""Curves along a reference or a formula of time: circles and lines, and their bad input."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import SpecificationError

T = ca.SX.sym("t")


def test_a_circle_along_a_reference_is_as_smooth_as_its_path():
    q = sv.coordinates("x y")
    path = sv.paths.rest_to_rest(0.0, 1.0, duration=6.0, smoothness=4)
    r = q.references(s=path)
    point = sv.curves.circle(2 * ca.pi * r.s, (0.0, 1.0), 0.5)
    rates = [point, *(ca.vertcat(*q.derivatives(point.elements(), k)[-1]) for k in range(1, 5))]
    f = ca.Function("f", [r.d(k)[0] for k in range(5)], [ca.horzcat(*rates)])

    def values(t):
        return np.array(f(*path.jets(t, 4)[:, 0])).T

    for t in np.linspace(-1.0, 7.0, 41):
        x, y = values(t)[0]
        assert abs(np.hypot(x, y - 1.0) - 0.5) < 1e-15
    assert np.allclose(values(3.0)[0], [-0.5, 1.0], rtol=0, atol=1e-15)
    for t in (0.0, 6.0):
        assert np.allclose(values(t), [[0.5, 1.0]] + [[0.0, 0.0]] * 4, rtol=0, atol=1e-13)


def test_a_circle_in_space_lies_in_the_plane_of_its_axes():
    f = ca.Function("f", [T], [sv.curves.circle(T, (1.0, 2.0, 3.0), 2.0, axes=((0, 0.6, 0.8), (1, 0, 0)))])
    assert np.allclose(np.array(f(0.0)).T, [1.0, 3.2, 4.6])
    assert np.allclose(np.array(f(np.pi / 2)).T, [3.0, 2.0, 3.0])


def test_a_line_goes_from_start_to_end():
    f = ca.Function("f", [T], [sv.curves.line(T, (1.0, 2.0, 0.0), (3.0, 1.0, 5.0))])
    assert np.allclose([np.array(f(s))[:, 0] for s in (0.0, 0.5, 1.0)], [[1, 2, 0], [2, 1.5, 2.5], [3, 1, 5]])


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: sv.curves.circle(T, (0, 0), -1.0), ["radius=-1", "greater than 0"]),
        (lambda: sv.curves.circle(T, (0, 0, 0), 1.0), ["3 entries", "no axes"]),
        (lambda: sv.curves.circle(T, (0, 0, 0), 1.0, ((1, 0), (0, 1))), ["centre has 3", "axes[0] has 2", "Give all"]),
        (lambda: sv.curves.circle(T, (0, 0), 1.0, ((1, 0), (1, 1))), ["orthonormal", "Give two unit vectors"]),
        (lambda: sv.curves.circle(T, (0, 0), 1.0, 5), ["axes are 5", "pair", "axes=((1, 0, 0), (0, 1, 0))"]),
        (lambda: sv.curves.line(T, (0, 1), (1, 2, 3)), ["start has 2", "end has 3"]),
        (lambda: sv.curves.line(T, (), ()), ["start has the shape (0,)", "a list of coordinates"]),
        (lambda: sv.curves.line(T, np.eye(2), np.eye(2)), ["start has the shape (2, 2)"]),
        (lambda: sv.curves.line(T, (0, np.inf), (1, 2)), ["start holds NaN or infinity"]),
        (lambda: sv.curves.line(np.linspace(0, 1, 50), 0, 1), ["s has 50 entries"]),
        (lambda: sv.curves.line(ca.MX.sym("s"), 0, 1), ["s is a MX"]),
        (lambda: sv.curves.circle(sv.coordinates("x y"), (0, 0), 1.0), ["angle has 2 entries"]),
    ],
)
def test_bad_input_is_refused_with_the_facts(make, facts):
    with refused(SpecificationError, *facts):
        make()
