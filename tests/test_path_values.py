"""Paths as values: jets against exact rationals and SciPy, classes, joins and sums, S-curves, fits, bad input."""

import math
import pickle
import subprocess
import sys
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy import interpolate as si

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.spec.paths import Path, as_path, fit, function, polynomials, rest_to_rest, s_curve, spline, trapezoid
from servoctl.spec.paths.limited import within_limits

RNG = np.random.default_rng(28)
TIMES = np.array([0.5, 1.5, 2.0, 4.0, 5.0, 5.7, 6.9, 8.0, 8.6, 9.5, 10.0, 11.2])
POINTS = RNG.normal(size=(12, 2))


def step_powers(k):
    """Coefficients by powers of sigma of the regularised incomplete beta function I_sigma(k + 1, k + 1)."""
    powers = [0] * (2 * k + 2)
    for j in range(k + 1):
        powers[k + 1 + j] = math.comb(k + j, j) * math.comb(2 * k + 1, k - j) * (-1) ** j
    return powers


def exact(powers, sigma, order):
    """Derivatives 0 .. order of a polynomial at a rational number, as fractions."""
    row = [Fraction(c) for c in powers]
    for i in range(min(order, len(row) - 1) + 1):
        for j in reversed(range(i, len(row) - 1)):
            row[j] += sigma * row[j + 1]
    return [math.factorial(k) * (row[k] if k < len(row) else 0) for k in range(order + 1)]


def off(found, expected):
    """The largest error of each derivative, (order + 1,), relative to its largest value."""
    found, expected = (np.asarray(a).reshape(len(a), -1) for a in (found, expected))
    size = np.abs(expected).max(axis=1)
    return np.abs(found - expected).max(axis=1) / np.where(size > 0, size, 1.0)


def by_scipy(curve, t, order):
    return np.array(
        [np.moveaxis(np.asarray(curve(t, nu=k)), curve.axis, 0).reshape(len(t), -1).T for k in range(order + 1)]
    )


def piecewise_sum(breaks, table, t, order):
    """Derivatives of bare polynomials in PPoly's convention, by SciPy."""
    return by_scipy(si.PPoly(table, breaks), t, order)


# jets ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("t_start, duration", [(0.0, 1.0), (0.0, 6.0), (1.1, 2.3), (1e6, 0.7)])
@pytest.mark.parametrize("k", [0, 4, 6, 10, 15, 20])
def test_jets_are_those_of_exact_rationals(k, t_start, duration):
    path = rest_to_rest(0.0, 1.0, duration, smoothness=k, t_start=t_start)
    first, last = path.breaks[[0, -1]]
    near = np.logspace(-9, -2, 8) * (last - first)
    t = np.unique(np.concatenate([np.linspace(first, last, 41), first + near, last - near, path.breaks[:-1]]))
    t = t[t < last]
    length = Fraction(float(last)) - Fraction(float(first))
    told = [exact(step_powers(k), (Fraction(float(x)) - Fraction(float(first))) / length, k) for x in t]
    expected = np.array([[value / length**n for n, value in enumerate(jets)] for jets in told], dtype=float).T
    rounded = 1.0 if np.finfo(np.longdouble).eps < np.finfo(float).eps else 4.0  # cuts are corrected in long doubles
    assert off(path.jets(t, k), expected).max() < 1e-14 * rounded


@pytest.mark.parametrize("k", [1, 4, 6, 10, 15, 20])
def test_the_jets_of_a_trapezoid_are_those_of_exact_rationals(k):
    path = trapezoid(2.0, 6.0, 1.5, smoothness=k)
    t = np.unique(np.concatenate([np.linspace(0.0, 5.99, 61), [1e-6, 1.5 - 1e-6, 4.5, 4.5 + 1e-6, 6.0 - 1e-6]]))
    speed, rows = Fraction(2) / Fraction(9, 2), []
    integral = [0, *(Fraction(c, j + 1) for j, c in enumerate(step_powers(k - 1)))]
    for x in map(Fraction, t.tolist()):
        ramp, part = Fraction(3, 2), min(x, 6 - x, Fraction(3, 2))
        jets = [speed * ramp ** (1 - n) * v for n, v in enumerate(exact(integral, part / ramp, k))]
        if part == ramp:
            jets = [speed * (x - ramp / 2), speed] + [Fraction(0)] * (k - 1)
        elif x > 3:
            jets = [2 * (n == 0) - (-1) ** n * v for n, v in enumerate(jets)]
        rows.append(jets)
    assert off(path.jets(t, k), np.array(rows, dtype=float).T).max() < 1e-14
    assert np.all(path.jets([-1.0, 9.0], k)[0, 0] == path.jets([0.0, 6.0], k)[0, 0])
    assert path.classes[np.isfinite(path.classes)].tolist() == [k] * 4


def test_values_have_the_shape_of_their_instants():
    path = rest_to_rest((0.0, 4.0), (5.0, 2.0), 6.0)
    assert path(3.0).tolist() == pytest.approx([2.5, 3.0], abs=1e-15) and path([0.0, 6.0, 9.0]).shape == (2, 3)
    assert path.jets(3.0, 4).shape == (5, 2, 1) and path.jets(np.zeros(7), 0).shape == (1, 2, 7)
    x, z = path
    assert (len(path), path.dim, x.dim) == (2, 2, 1) and x == path[0] == path[-2] != z
    assert (
        np.ndim(x(3.0)) == 0
        and x([1.0, 2.0]).shape == (2,)
        and np.array_equal(z.jets(2.0, 3)[:, 0], path.jets(2.0, 3)[:, 1])
    )


def test_at_a_break_the_piece_that_begins_counts_and_at_the_end_the_last_one():
    path = polynomials([0.0, 1.0, 3.0], [[1.0, -2.0], [0.0, 1.0]], before="hold", after="hold")
    assert path([0.0, 1.0, 3.0]).tolist() == [0.0, 1.0, -3.0]
    assert path.jets([-1.0, 0.0, 1.0, 3.0, 4.0], 1)[1, 0].tolist() == [0.0, 1.0, -2.0, -2.0, 0.0]


def test_a_long_path_of_many_samples_keeps_its_digits():
    t = np.linspace(0.0, 1000.0, 100_001)
    curve = si.make_interp_spline(t, np.sin(t), k=5)
    path = as_path(curve)
    at = RNG.uniform(0.0, 1000.0, 999)
    assert off(path.jets(at, 2), by_scipy(curve, at, 2)).max() < 1e-11
    held = path.breaks.nbytes + path.coefficients.nbytes + path.classes.nbytes
    assert held <= 3 * (100_001 * 8 + 100_000 * 6 * 8) and np.all(path.classes[1:-1] >= 4)


# classes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 3, 5, 8, 9, 13])
def test_the_class_of_a_spline_is_its_degree_less_the_multiplicity_of_a_knot(degree):
    inner = np.array([1.0, 2.0, 2.0, 3.0])[: 2 if degree == 1 else 4]
    inner = np.unique(inner) if degree == 1 else inner
    knots = np.concatenate([[0.0] * (degree + 1), inner, [4.0] * (degree + 1)])
    curve = si.BSpline(knots, RNG.normal(size=(len(knots) - degree - 1, 3)), degree)
    path = as_path(curve)
    expected = {x: degree - int(np.sum(inner == x)) for x in inner}
    assert {x: int(c) for x, c in zip(path.breaks[1:-1], path.classes[1:-1], strict=True) if c < np.inf} == expected
    t = np.linspace(0.0, 4.0, 83)[:-1]
    assert path.dim == 3 and off(path.jets(t, degree), by_scipy(curve, t, degree)).max() < 1e-11


KINDS = {
    "CubicSpline": (lambda: si.CubicSpline(TIMES, POINTS), 2),
    "rate of a CubicSpline": (lambda: si.CubicSpline(TIMES, POINTS).derivative(), 1),
    "natural": (lambda: si.CubicSpline(TIMES, POINTS[:, 0], bc_type="natural"), 2),
    "Akima1DInterpolator": (lambda: si.Akima1DInterpolator(TIMES, POINTS), 1),
    "PchipInterpolator": (lambda: si.PchipInterpolator(TIMES, POINTS), 1),
    "CubicHermiteSpline": (lambda: si.CubicHermiteSpline(TIMES, POINTS, POINTS[::-1]), 1),
    "make_interp_spline": (lambda: si.make_interp_spline(TIMES, POINTS, k=5), 4),
    "degree 9": (lambda: si.make_interp_spline(TIMES, POINTS, k=9), 8),
    "make_lsq_spline": (lambda: si.make_lsq_spline(TIMES, POINTS, [0.5] * 4 + [5.0] + [11.2] * 4), 2),
    "PPoly": (lambda: si.PPoly(RNG.normal(size=(4, 11, 2)), TIMES), -1),
    "PPoly of a spline": (lambda: si.PPoly.from_spline(si.make_interp_spline(TIMES, POINTS[:, 1], k=5)), 4),
    "BPoly": (lambda: si.BPoly(RNG.normal(size=(4, 11, 2)), TIMES), -1),
    "from_derivatives": (lambda: si.BPoly.from_derivatives(TIMES, RNG.normal(size=(12, 3))), 2),
    "columns first": (lambda: si.CubicSpline(TIMES, POINTS.T, axis=1), 2),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_scipy_makes_has_its_values_derivatives_and_class(kind):
    make, expected = KINDS[kind]
    curve = make()
    path = as_path(curve)
    first, last = path.breaks[[0, -1]]
    t = np.sort(np.concatenate([RNG.uniform(first, last, 60), path.breaks[:-1]]))
    degree = path.coefficients.shape[2] - 1
    assert off(path.jets(t, degree), by_scipy(curve, t, degree)).max() < 3e-12
    inner = path.classes[1:-1]
    assert set(inner[np.isfinite(inner)]) == {expected}
    assert as_path(path) == path and (path.before, path.after) == (None, None)


def test_splines_of_degree_nine_and_more_do_not_crash():
    script = """
import numpy as np
from scipy.interpolate import make_interp_spline
from servoctl.spec.paths import as_path
t = np.linspace(0.0, 5.0, 40)
for degree in (9, 11, 13, 15):  # older SciPy interpolates by odd degrees alone
    path = as_path(make_interp_spline(t, np.sin(t), k=degree))
    print(path.coefficients.shape[2], np.abs(path(t) - np.sin(t)).max() < 1e-13)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["10", "True", "12", "True", "14", "True", "16", "True"]


@pytest.mark.parametrize("jump", range(5))
def test_the_class_of_bare_polynomials_is_counted(jump):
    """(t - 1)^jump is added from t = 1 on: derivative `jump` jumps."""
    smooth = np.array([0.3, -1.0, 2.0, 0.5, -0.7, 1.0])  # highest power first, about 0
    moved = np.polynomial.polynomial.Polynomial(smooth[::-1])(np.polynomial.Polynomial([1.0, 1.0])).coef[::-1].copy()
    moved[-1 - jump] += 1.0
    path = polynomials([0.0, 1.0, 2.5], np.stack([smooth, moved], axis=1))
    assert path.classes[path.breaks == 1.0].tolist() == [jump - 1]


@pytest.mark.parametrize("jump, expected", [(3e-7, 0), (3e-8, np.inf)])
def test_a_jump_counts_from_1e_7_of_a_derivative_on(jump, expected):
    path = polynomials([0.0, 1.0, 2.0], [[1.0, 1.0 + jump], [0.0, 1.0]])
    assert path.classes[1] == expected


def test_a_class_that_is_stated_is_not_counted():
    times = np.linspace(0.0, 1.0, 502)
    bare = si.PPoly.from_spline(si.make_interp_spline(times, np.sin(9 * times), k=5))
    with refused(SpecificationError, 497, pieces=497, most=300):
        as_path(bare)
    assert set(as_path(bare, smoothness=4).classes[1:-1]) == {4}
    with refused(SpecificationError, "CubicSpline"):
        as_path(si.CubicSpline(TIMES, POINTS), smoothness=2)


def test_monomials_of_class_nine_keep_their_class():
    """SciPy's monomials have lost digits of the ninth derivative, not so many that it seems to jump."""
    powers = np.array(step_powers(9), dtype=float)[::-1, None]
    rest = np.zeros((20, 1))
    table = np.concatenate([rest, powers, rest], axis=1)
    table[-1, 2] = 1.0
    path = polynomials([-1.0, 0.0, 1.0, 2.0], table)
    assert path.classes[np.isin(path.breaks, (0.0, 1.0))].tolist() == [9, 9]
    t = np.linspace(0.0, 0.999, 55)
    told = np.array([exact(step_powers(9), Fraction(float(x)), 9) for x in t], dtype=float).T
    assert off(path.jets(t, 9), told).max() < 1e-7


def test_a_cut_is_a_break_of_class_infinity_and_leaves_small_terms():
    path = rest_to_rest(0.0, 1.0, 1.0, smoothness=20)
    assert len(path.breaks) > 4 and np.isinf(path.classes[1:-1]).all() and path.classes[[0, -1]].tolist() == [20, 20]
    assert np.abs(path.coefficients).sum(axis=2).max() < 4.0
    line = polynomials([0.0, 1.0], [[2.0], [1.0]])
    assert len(line.breaks) == 2 and line.classes.tolist() == [0, 0]


# before, after -------------------------------------------------------------------------------------------------------


def test_outside_its_breaks_a_path_holds_goes_on_or_repeats():
    table = [[1.0], [0.0], [1.0]]  # 1 + t^2 from 0 to 2
    t = np.array([-1.0, 0.5, 3.0])
    hold = polynomials([0.0, 2.0], table, before="hold", after="hold").jets(t, 2)[:, 0]
    assert np.allclose(hold, [[1.0, 1.25, 5.0], [0.0, 1.0, 0.0], [0.0, 2.0, 0.0]], rtol=0, atol=1e-14)
    on = polynomials([0.0, 2.0], table, before="continue", after="continue").jets(t, 2)[:, 0]
    assert np.allclose(on, [1.0 + t**2, 2 * t, 2.0 + 0 * t], rtol=0, atol=1e-14)
    again = polynomials([0.0, 2.0], table, before="periodic", after="periodic")
    assert np.allclose(again([-1.0, 0.5, 3.0, 2.0, 4.5]), [2.0, 1.25, 2.0, 1.0, 1.25], rtol=0, atol=1e-14)
    assert again.classes.tolist() == [-1, -1]


def test_only_a_wish_to_repeat_counts_of_scipys_extrapolation():
    closed = np.append(POINTS[:-1], POINTS[:1], axis=0)
    for wish, rule in ((True, None), (False, None), ("periodic", "periodic")):
        path = as_path(si.CubicSpline(TIMES, closed, bc_type="periodic", extrapolate=wish))
        assert (path.before, path.after) == (rule, rule)
    curve = si.CubicSpline(TIMES, closed, bc_type="periodic", extrapolate="periodic")
    t = np.linspace(-20.0, 30.0, 71)
    assert off(path.jets(t, 2), by_scipy(curve, t, 2)).max() < 1e-12
    assert path.classes[[0, -1]].tolist() == [2, 2]


def test_a_path_of_which_nothing_was_said_outside_is_held_as_far_as_its_derivatives_vanish():
    bare = polynomials([0.0, 1.0], np.array(step_powers(2), dtype=float)[::-1, None])
    assert bare.classes[[0, -1]].tolist() == [2, 2]
    assert np.array_equal(bare.jets([-1.0, 3.0], 2)[:, 0], [[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    with refused(SpecificationError, "t = 3 s", "derivative 3", t=3.0, end=1.0):
        bare.jets([0.5, 3.0], 3)
    moving = as_path(si.CubicSpline(TIMES, POINTS))
    with refused(SpecificationError, "t = -1 s", "derivative 1", t=-1.0, end=0.5):
        moving([2.0, -1.0])
    curve = si.CubicSpline(TIMES, POINTS)
    assert as_path(curve, before="continue", after="continue")(-1.0) == pytest.approx(curve(-1.0))


# joins and sums ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0, 2, 4, 10])
def test_derivatives_that_vanish_by_the_class_of_a_held_end_are_no_rounding(k):
    path = rest_to_rest((0.0, 0.1), (3**0.5, 1.0), 4.0, smoothness=k)
    jets = path.jets([0.0, 4.0], k + 1)
    assert not jets[1 : k + 1].any() and jets[k + 1].all()
    assert np.abs(jets[0] - np.transpose([path(-1.0), path(5.0)])).max() < 1e-15


def test_sums_and_multiples_are_those_of_polynomials():
    a = polynomials([0.0, 1.0, 3.0], RNG.normal(size=(4, 2)), before="continue", after="continue")
    b = polynomials([-1.0, 1.0, 1.7, 4.0], RNG.normal(size=(6, 3)), before="continue", after="continue")
    t = np.sort(RNG.uniform(-2.0, 5.0, 99))
    for path, expected in (
        (a + b, a.jets(t, 5) + b.jets(t, 5)),
        (a - b, a.jets(t, 5) - b.jets(t, 5)),
        (2.5 * a, 2.5 * a.jets(t, 5)),
        (np.float64(1.5) * b, 1.5 * b.jets(t, 5)),
        (-a, -a.jets(t, 5)),
    ):
        assert off(path.jets(t, 5), expected).max() < 1e-13
    total = a + b
    assert total.breaks.tolist() == [-1.0, 0.0, 1.0, 1.7, 3.0, 4.0] or set(total.breaks) >= {
        -1.0,
        0.0,
        1.0,
        1.7,
        3.0,
        4.0,
    }
    classes = dict(zip(total.breaks, total.classes, strict=True))
    assert [classes[x] for x in (0.0, 1.0, 1.7, 3.0)] == [np.inf, -1, -1, np.inf]


def test_constants_are_added_to_the_value_alone():
    path = rest_to_rest((0.0, 1.0), (2.0, 3.0), 4.0)
    moved = path + (1.0, -1.0)
    t = np.linspace(-1.0, 5.0, 25)
    assert np.allclose(moved(t), path(t) + np.array([[1.0], [-1.0]]), rtol=0, atol=1e-15)
    assert np.array_equal(moved.jets(t, 3)[1:], path.jets(t, 3)[1:]) and (1.0, -1.0) + path == moved
    assert np.allclose((1.0 - path[0])(t), 1.0 - path[0](t), rtol=0, atol=1e-15)


def test_sums_of_paths_that_hold_and_go_on_are_right_outside():
    held = rest_to_rest(0.0, 1.0, 2.0, t_start=1.0)
    line = polynomials([0.0, 2.5], [[0.5], [0.0]], before="continue", after="continue")
    repeated = polynomials([0.0, 2.0], [[1.0], [0.0]], before="periodic", after="periodic")
    t = np.linspace(-9.0, 12.0, 85)
    for path, expected in (
        (held + held.at_rate(2.0), held.jets(t, 3) + held.at_rate(2.0).jets(t, 3)),
        (repeated + 2 * repeated, 3 * repeated.jets(t, 3)),
    ):
        assert off(path.jets(t, 3), expected).max() < 1e-13
    inside = t[(t >= 0.0) & (t < 3.0)]
    assert off((held + line).jets(inside, 3), held.jets(inside, 3) + line.jets(inside, 3)).max() < 1e-13
    with refused(
        SpecificationError, t=-9.0, end=0.0
    ):  # one stands still, the other goes on: together, nothing was said
        (held + line)(t)
    both = held + held.at_rate(2.0)
    assert both.classes[both.breaks == 2.0].tolist() == [4] and both.classes[[0, -1]].tolist() == [4, 4]
    with refused(SpecificationError, "periodic", "1 .. 3 s (hold)"):
        held + repeated
    with refused(SpecificationError, t=0.375, end=2.0):  # the middle of a piece beyond a path that cannot be held
        as_path(si.CubicSpline([2.0, 3.0, 4.0], [0.0, 1.0, 0.0])) + rest_to_rest(0.0, 1.0, 1.5)


def test_a_sum_merges_breaks_that_differ_by_rounding():
    a, b = rest_to_rest(0.0, 1.0, 0.3), rest_to_rest(0.0, 1.0, 0.1 + 0.2)
    total = a + b
    assert np.diff(total.breaks).min() > 1e-3 and total(0.3) == pytest.approx(2.0, abs=1e-14)


@pytest.mark.parametrize("apart, breaks", [(3e-13, 3), (3e-14, 2)])
def test_breaks_are_two_from_1e_13_of_an_instant_on(apart, breaks):
    total = rest_to_rest(0.0, 1.0, 1.0, smoothness=1) + rest_to_rest(0.0, 1.0, 1.0 + apart, smoothness=1)
    assert len(total.breaks) == breaks


def test_one_path_follows_another():
    there = rest_to_rest((0.0, 1.0), (2.0, 3.0), 4.0, smoothness=4)
    back = rest_to_rest((2.0, 3.0), (0.0, 0.0), 1.5, smoothness=6, t_start=-7.0)
    path = there.then(back)
    t = np.linspace(-1.0, 7.0, 81)
    expected = np.where(t < 4.0, there.jets(t, 4), back.jets(t - 11.0, 4))
    assert off(path.jets(t, 4), expected).max() < 1e-14
    assert path.classes[path.breaks == 4.0].tolist() == [4] and path.breaks[-1] == 5.5
    assert there.then(back + (0.0, 0.1)).classes[path.breaks == 4.0].tolist() == [-1]
    fast = polynomials([0.0, 1.0], [[2.0], [0.0]])
    joint = fast.then(polynomials([0.0, 1.0], [[3.0], [2.0], [2.0]]))
    assert joint.classes[1] == 1 and (joint.before, joint.after) == (None, None)


def test_at_another_rate_the_same_values_come_sooner():
    path = spline(TIMES, POINTS, smoothness=3)
    t = np.linspace(0.5, 4.0, 33)
    rate = 2.0 ** np.arange(4)[:, None, None]
    assert off(path.at_rate(2.0).jets(t, 3), rate * path.jets(0.5 + 2 * (t - 0.5), 3)).max() < 1e-13
    assert np.array_equal(path.at_rate(4.0).coefficients, path.coefficients)
    assert np.array_equal(path.at_rate(4.0).classes, path.classes)


# makers --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ends", ["rest", "natural"])
@pytest.mark.parametrize("k", [0, 1, 2, 4, 6])
def test_a_spline_is_the_one_through_its_points_with_the_derivatives_that_vanish_at_its_ends(k, ends):
    """Pieces of degree 2m + 1 and class 2m through n points: m derivatives that vanish at each end leave one."""
    path = spline(TIMES, POINTS, smoothness=k, ends=ends)
    m = k if ends == "rest" else (k + 1) // 2
    assert path.coefficients.shape[-1] == 2 * m + 2
    sizes = np.abs(path.jets(np.linspace(0.5, 11.2, 400), 2 * m)).max(axis=(1, 2))
    assert np.abs(path(TIMES) - POINTS.T).max() < 1e-12
    after, before = path.jets(TIMES[1:-1], 2 * m), path.jets(np.nextafter(TIMES[1:-1], 0.0), 2 * m)
    assert (np.abs(after - before).max(axis=(1, 2)) < 1e-11 * sizes).all()
    vanishing = slice(1, m + 1) if ends == "rest" else slice(m + 1, 2 * m + 1)
    at_ends = path.jets(np.array([TIMES[0], TIMES[-1]]), 2 * m)[vanishing]
    assert (np.abs(at_ends).max(axis=(1, 2)) < 1e-11 * sizes[vanishing]).all()
    assert set(path.classes[np.isin(path.breaks, TIMES[1:-1])]) == {2 * m}
    assert path.classes[[0, -1]].tolist() == [k, k] if ends == "rest" else np.isinf(path.classes[[0, -1]]).all()


@pytest.mark.parametrize("k, most", [(4, 1e-12), (10, 1e-10), (20, 1e-7)])  # as far as SciPy's equations are solved
def test_a_spline_of_two_points_is_rest_to_rest(k, most):
    path, straight = (
        spline([1.0, 4.0], [0.0, 2.0], smoothness=k),
        rest_to_rest(0.0, 2.0, 3.0, smoothness=k, t_start=1.0),
    )
    t = np.linspace(0.0, 5.0, 101)
    assert off(path.jets(t, k), straight.jets(t, k)).max() < most


LIMITS = [  # distance, speed, acceleration, jerk, and the duration by hand
    (5.0, 1.0, 2.0, 8.0, 5.0 + 0.5 + 0.25),  # all limits are reached: L/v + v/a + a/j
    (5.0, 1.0, 4.0, 3.0, 5.0 + 2 * math.sqrt(1.0 / 3.0)),  # not that of acceleration: L/v + 2 sqrt(v/j)
    (1.0, 10.0, 1.0, 4.0, 2 * (0.125 + math.sqrt(0.125**2 + 1.0))),  # not that of speed
    (1.0, 10.0, 10.0, 4.0, 4 * (1.0 / 8.0) ** (1 / 3)),  # that of jerk alone
]


@pytest.mark.parametrize("distance, speed, acceleration, jerk, duration", LIMITS)
def test_an_s_curve_keeps_its_limits_in_the_least_time(distance, speed, acceleration, jerk, duration):
    path = s_curve(1.0, 1.0 - distance, speed, acceleration, jerk, t_start=2.0)
    assert path.breaks[-1] - path.breaks[0] == pytest.approx(duration, rel=1e-12)
    t = np.linspace(2.0, path.breaks[-1], 4001)
    for order, limit in ((1, speed), (2, acceleration), (3, jerk)):
        assert np.abs(path.jets(t, order)[order]).max() <= limit * (1 + 1e-12)
    jerks = path.jets((path.breaks[1:] + path.breaks[:-1]) / 2, 4)
    assert (
        np.abs(np.abs(jerks[3]) * (np.abs(jerks[3]) - jerk)).max() < 1e-10 * jerk**2 and np.abs(jerks[4]).max() == 0.0
    )
    assert path([0.0, 99.0]) == pytest.approx([1.0, 1.0 - distance], abs=1e-13)
    assert set(path.classes) == {2} and np.abs(path.jets(path.breaks[[0, -1]], 2)[1:]).max() < 1e-12


def test_an_s_curve_of_a_vector_runs_along_the_line():
    path = s_curve((0.0, 4.0), (3.0, 0.0), 1.0, 2.0, 8.0)
    t = np.linspace(0.0, path.breaks[-1], 201)
    jets = path.jets(t, 3)
    assert np.allclose(jets[:, 0] * 4 + (jets[:, 1] - 4.0 * (np.arange(4) == 0)[:, None]) * 3, 0.0, rtol=0, atol=1e-12)
    assert np.linalg.norm(jets[1], axis=0).max() == pytest.approx(1.0, abs=1e-12)


# fits ----------------------------------------------------------------------------------------------------------------


def sine(k, rate=1.0):
    return lambda t: [rate**j * math.sin(rate * t + j * math.pi / 2) for j in range(k + 1)]


@pytest.mark.parametrize("k, tolerance", [(0, 1e-6), (1, 1e-9), (2, 1e-9), (4, 1e-9), (6, 1e-8), (10, 1e-6)])
def test_a_function_with_its_derivatives_is_fitted_within_the_tolerance(k, tolerance):
    path = function(sine(k), (0.0, 10.0), k, tolerance)
    t = np.linspace(0.0, 9.999, 777)
    expected = [np.sin(t + j * np.pi / 2) for j in range(k + 1)]
    assert off(path.jets(t, k), expected).max() < 2 * tolerance
    assert (
        off(path.jets(path.breaks[:-1], k), [np.sin(path.breaks[:-1] + j * np.pi / 2) for j in range(k + 1)]).max()
        < 1e-7
    )
    assert set(path.classes[1:-1]) <= {k} and f"order {k}" in repr(path)


def test_a_composition_is_fitted():
    """A circle along a time law, with its derivatives by the chain rule."""
    law = rest_to_rest(0.0, 2 * math.pi, 6.0, smoothness=4)

    def circle(t):
        a, da, d2a = law.jets(t, 2)[:, 0, 0]
        c, s = math.cos(a), math.sin(a)
        return [[c, s], [-s * da, c * da], [-c * da**2 - s * d2a, -s * da**2 + c * d2a]]

    path = function(circle, (0.0, 6.0), smoothness=2, before="hold", after="hold")
    t = np.linspace(-1.0, 7.0, 333)
    assert np.abs(path(t) - [np.cos(law(t)), np.sin(law(t))]).max() < 1e-9
    assert path.classes[[0, -1]].tolist() == [2, 2] and path.dim == 2


@pytest.mark.parametrize("wrong", [1, 2, 3])
def test_a_function_whose_derivatives_do_not_fit_is_refused_by_the_defect(wrong):
    def f(t):
        jets = sine(4)(t)
        jets[wrong] *= 1.001
        return jets

    with refused(SpecificationError, f"derivative {wrong}", order=wrong) as caught:
        function(f, (0.0, 3.0))
    assert 1e-4 < caught.value.details["defect"] < 1e-1


@pytest.mark.parametrize("wrong, blamed", [(4e-6, "defect"), (3e-7, "error")])
def test_a_defect_of_1e_6_is_no_rounding(wrong, blamed):
    with pytest.raises(SpecificationError) as caught:
        function(lambda t: [math.sin(t), (1.0 + wrong) * math.cos(t)], (0.0, 3.0), 1)
    assert blamed in caught.value.details


def test_a_tolerance_below_rounding_is_refused_with_what_can_be_reached():
    with refused(SpecificationError, "rounding") as caught:
        function(sine(4), (0.0, 10.0), tolerance=1e-13)
    error = caught.value.details["error"]
    assert 1e-12 < error < 1e-9
    function(sine(4), (0.0, 10.0), tolerance=2 * error)


@pytest.mark.parametrize("k", [0, 1, 2, 3, 4, 6, 9])
def test_noisy_samples_are_fitted_within_their_noise(k):
    t = np.linspace(0.0, 10.0, 1001)
    clean = np.stack([np.sin(t), np.cos(2 * t)], axis=1)
    path = fit(t, clean + 1e-3 * RNG.normal(size=clean.shape), k, tolerance=1e-3)
    assert np.abs(path(t).T - clean).max() < 5e-3 and path.classes[1:-1].min() >= k
    assert len(path.breaks) < (400 if k == 0 else 120)
    largest = [float(x) for x in repr(path).split(": ")[-1].split(", ")]
    found = np.abs(path.jets(np.linspace(0.0, 9.99999, 20001), k)).max(axis=(1, 2))
    assert len(largest) == k + 1 and largest == pytest.approx(found, rel=0.05)


def test_a_fit_of_one_column_is_that_of_fitpack():
    t, noise = np.linspace(0.0, 10.0, 501), RNG.normal(size=501)
    path = fit(t, np.sin(t) + 0.01 * noise, tolerance=0.01)
    curve = si.UnivariateSpline(t, np.sin(t) + 0.01 * noise, k=5, s=0.99 * 501 * 1e-4)
    assert np.abs(path(t) - curve(t)).max() < 1e-12 and set(curve.get_knots()) <= set(path.breaks)


# values --------------------------------------------------------------------------------------------------------------


def test_paths_are_frozen_compare_by_their_fields_and_print_shortly(tmp_path):
    a, b = rest_to_rest((0.0, 1.0), (2.0, 3.0), 4.0), rest_to_rest((0.0, 1.0), (2.0, 3.0), 4.0)
    assert a == b and hash(a) == hash(b) and a != rest_to_rest((0.0, 1.0), (2.0, 3.0), 4.1) and a != 5
    assert len(repr(a).splitlines()) == 2 and "2 components" in repr(a) and "class 4" in repr(a)
    with pytest.raises(AttributeError):
        a.breaks = b.breaks
    with pytest.raises(ValueError):
        a.breaks[0] = 1.0
    axes = a.plot(3)
    assert axes.shape == (4,) and len(axes[0].lines) == 2
    axes[0].figure.savefig(tmp_path / "path.png")


def test_paths_pickle_into_another_process(tmp_path):
    paths = [rest_to_rest(0.0, 1.0, 2.0), spline(TIMES, POINTS), fit(TIMES, POINTS[:, 0], 2, tolerance=0.1)]
    (tmp_path / "paths").write_bytes(pickle.dumps(paths))
    script = f"""
import pickle, pathlib
paths = pickle.loads(pathlib.Path({str(tmp_path / "paths")!r}).read_bytes())
pathlib.Path({str(tmp_path / "again")!r}).write_bytes(pickle.dumps(paths))
print([path(1.3).tolist() for path in paths], [path.breaks.flags.writeable for path in paths])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str([path(1.3).tolist() for path in paths]) + " [False, False, False]"
    again = pickle.loads((tmp_path / "again").read_bytes())
    assert again == paths and [repr(path) for path in again] == [repr(path) for path in paths]


# bad input -----------------------------------------------------------------------------------------------------------

ONE, TWO = rest_to_rest(0.0, 1.0, 1.0), rest_to_rest((0.0, 1.0), (1.0, 2.0), 1.0)
AGAIN = polynomials([0.0, 1.0], [[0.0], [1.0]], before="periodic", after="periodic")
REFUSED = [
    (lambda: polynomials([0.0, 1.0, 1.0], np.ones((2, 2))), ["breaks 1 and 2 are 1, 1"], {"index": 2}),
    (lambda: polynomials([0.0, 2.0, 1.0], np.ones((2, 2))), ["breaks 1 and 2 are 2, 1"], {"index": 2}),
    (lambda: polynomials([0.0], np.ones((2, 0))), ["1 breaks"], {}),
    (lambda: polynomials([0.0, np.nan], np.ones((2, 1))), ["breaks"], {"name": "breaks"}),
    (lambda: polynomials([0.0, 1.0], np.ones((2, 3))), ["(2, 3)", "(degree + 1, 1)"], {"shape": (2, 3), "pieces": 1}),
    (lambda: polynomials([0.0, 1.0], np.ones(2)), ["(2,)"], {"pieces": 1}),
    (lambda: polynomials([0.0, 1.0], [[1.0], [np.nan]]), ["1 of them finite"], {"pieces": 1}),
    (lambda: polynomials([0.0, 1.0], [[1.0]], before="stay"), ["'stay'", "'hold'"], {"before": "stay"}),
    (lambda: polynomials([0.0, 1.0], [[1.0]], before="periodic"), ["both sides", "before='periodic', after='periodic'"], {"after": None}),
    (lambda: polynomials([0.0, 1.0], [[1.0]], smoothness=1.5), ["smoothness=1.5"], {"smoothness": 1.5}),
    (lambda: Path([0.0, 1.0], np.ones((2, 1, 3)), [0, 0]), ["(2, 1, 3)", "sv.paths.polynomials"], {"breaks": 2}),
    (lambda: Path([0.0, 1.0], np.ones((1, 1, 3)), [0, 0, 0]), ["3 classes"], {"breaks": 2}),
    (lambda: Path([0.0, 1.0], np.ones((1, 1, 3)), [0, np.nan]), ["classes"], {"name": "classes"}),
    (lambda: as_path(5.0), ["float"], {"type": "float"}),
    (lambda: as_path(ca.SX.sym("t")), ["SX"], {"type": "SX"}),
    (lambda: as_path(si.interp1d(TIMES, TIMES)), ["interp1d"], {"type": "interp1d"}),
    (lambda: as_path(si.PPoly([[1j]], [0.0, 1.0])), ["complex"], {"type": "PPoly"}),
    (lambda: ONE(np.nan), ["t is [nan]"], {"name": "t"}),
    (lambda: ONE("x"), ["t is ['x']"], {"name": "t"}),
    (lambda: ONE.plot(-1), ["order=-1"], {"value": -1}),
    (lambda: ONE([[0.0, 1.0]]), ["(1, 2)"], {"name": "t"}),
    (lambda: ONE.jets(0.5, -1), ["order=-1", "order=0"], {"value": -1}),
    (lambda: ONE.jets(0.5, 2.5), ["order=2.5"], {"value": 2.5}),
    (lambda: ONE + TWO, ["1 component", "2", "path[i]"], {"dimensions": (1, 2)}),
    (lambda: ONE + AGAIN, ["0 .. 1 s (periodic)", "in one span, or none"], {}),
    (lambda: TWO + 1.0, ["2 components", "1"], {"dimensions": (2, 1)}),
    (lambda: ONE.then(5), ["int"], {"name": "other"}),
    (lambda: ONE - None, ["[None]"], {}),
    (lambda: TWO.then(ONE), ["2 components"], {"dimensions": (2, 1)}),
    (lambda: ONE + [np.nan], ["nan"], {}),
    (lambda: ONE * ONE, ["multiple of a path"], {"name": "factor"}),
    (lambda: np.ones(3) * ONE, ["multiple of a path"], {"name": "factor"}),
    (lambda: AGAIN.then(ONE), ["periodic"], {"after": "periodic"}),
    (lambda: ONE.at_rate(0.0), ["factor=0"], {"value": 0.0}),
    (lambda: TWO[2], ["component=2", "component=1"], {"component": 2}),
    (lambda: TWO["x"], ["component='x'"], {"component": "x"}),
    (lambda: rest_to_rest(0.0, 1.0, 0.0), ["duration=0", "greater than 0"], {"name": "duration"}),
    (lambda: rest_to_rest((0.0, 1.0), 1.0, 1.0), ["start has 2", "end has 1", "Give both as many"], {"start": 2, "end": 1}),
    (lambda: rest_to_rest(np.inf, 1.0, 1.0), ["start"], {"name": "start"}),
    (lambda: rest_to_rest(0.0, 1.0, 1.0, smoothness=101), ["smoothness=101", "to 100"], {"smoothness": 101}),
    (lambda: rest_to_rest(0.0, 1.0, 1.0, t_start=1e300), ["breaks 0 and 1"], {"index": 1}),
    (lambda: trapezoid(np.nan, 2.0, 0.5), ["distance"], {"name": "distance"}),
    (lambda: rest_to_rest((), (), 1.0), ["(2, 0, 10)"], {"shape": (2, 0, 10)}),
    (lambda: trapezoid(1.0, 2.0, 1.5), ["1.5 s", "A ramp of 1 s"], {"ramp": 1.5, "duration": 2.0}),
    (lambda: trapezoid(1.0, 2.0, 1.0, smoothness=0), ["smoothness=0", "smoothness=1"], {"smoothness": 0}),
    (lambda: s_curve(0.0, 0.0, 1.0, 1.0, 1.0), ["both [0.0]"], {"start": [0.0]}),
    (lambda: s_curve(0.0, 1e15, 1.0, 1.0, 1.0), ["1e+15 s", "rises for 1 s"], {"rise": 1.0}),
    (lambda: polynomials([0.0, 1.0], [[1.0]], before={"x": 1.0}), ["before={'x': 1.0}"], {"after": None}),
    (lambda: s_curve(0.0, 1.0, 1.0, -1.0, 1.0), ["acceleration=-1"], {"name": "acceleration"}),
    (lambda: spline([0.0, 1.0, 1.0], [0.0, 1.0, 2.0]), ["times 1 and 2 are 1, 1"], {"index": 2}),
    (lambda: spline([0.0, 1.0], [0.0, 1.0, 2.0]), ["(2,)", "(3,)"], {"points": (3,)}),
    (lambda: spline([0.0, 1.0], [0.0, np.nan]), ["finite"], {}),
    (lambda: spline([0.0, 1.0, 2.0], [0.0, 1.0, 0.0], smoothness=6, ends="natural"), ["smoothness=4"], {"points": 3}),
    (lambda: spline([0.0, 1e-5, 1.0], [0.0, 1.0, 0.0], smoothness=4), ["degree 9 misses"], {"degree": 9}),
    (lambda: spline([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], smoothness=100), ["degree 201 misses"], {"degree": 201}),
    (lambda: function(5, (0.0, 1.0)), ["f", "int"], {"name": "f"}),
    (lambda: function(lambda t: t, (0.0, 1.0)), ["smoothness 4"], {"smoothness": 4}),
    (lambda: function(lambda t: [t, np.nan], (0.0, 1.0), 1), ["nan"], {"t": 0.0}),
    (lambda: function(lambda t: "x", (0.0, 1.0), 1), ["'x'"], {"t": 0.0}),
    (lambda: function(sine(1), (1.0, 0.0), 1), ["(0, 1)"], {}),
    (lambda: function(lambda t: [abs(t - 1 / 3), np.sign(t - 1 / 3)], (0.0, 1.0), 1), ["derivative 1"], {"order": 1}),
    (lambda: fit([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], tolerance=0.1), ["3 samples", "6"], {"samples": 3}),
    (lambda: fit(TIMES, POINTS, tolerance=[0.1, 0.1, 0.1]), ["(3,)", "(2,)"], {"name": "tolerance"}),
    (lambda: fit(TIMES, TIMES, tolerance=0.0), ["tolerance=0"], {"name": "tolerance"}),
    (lambda: fit(TIMES, POINTS, 8, tolerance=1e-6), ["tolerance=1e-06"], {"tolerance": 1e-6}),
    (lambda: fit(TIMES[::-1], POINTS, tolerance=0.1), ["times 0 and 1"], {"index": 1}),
]  # fmt: skip


@pytest.mark.parametrize("make, facts, details", REFUSED)
def test_bad_input_is_refused_with_the_facts(make, facts, details):
    with refused(SpecificationError, *facts, **details):
        make()


def test_an_unknown_spline_end_shows_the_nearest():
    with refused(NameUnknown, name="naturl", match="natural"):
        spline([0.0, 1.0], [0.0, 1.0], ends="naturl")


def test_where_a_path_rests_its_derivatives_are_zero_to_the_last_bit():
    there = rest_to_rest(0.0, 3**0.5, duration=4.0)
    path = there.then(rest_to_rest(3**0.5, 12**0.5, duration=3.0))
    jets = path.jets([0.0, 4.0, 7.0], 5)[:, 0]
    assert not jets[1:5].any() and (jets[5] != 0.0).all() and jets[0].tolist() == [0.0, 3**0.5, 12**0.5]


@pytest.mark.parametrize("outside", ["hold", "continue", "periodic"])
@pytest.mark.parametrize("sides", [(-1.0, 2.0), (-np.inf, 0.5), (0.3, np.inf)])
def test_within_limits_a_path_is_cut_off_exactly(outside, sides):
    rng, t = np.random.default_rng(1), np.linspace(-3.0, 5.0, 2001)
    path = polynomials([0.0, 0.5, 1.3, 2.0], 3.0 * rng.normal(size=(5, 3)), before=outside, after=outside)
    found = within_limits(path, *sides)
    assert np.abs(found(t) - path(t).clip(*sides)).max() < 1e-12 and found.classes.min() >= -1


Q = sv.coordinates("x")
OLD = {
    "rest_to_rest": (lambda: rest_to_rest(Q.t, 0.0, 5.0, duration=6.0), "sv.paths.rest_to_rest(0.0, 5.0, duration=6.0)"),
    "by place": (lambda: rest_to_rest(Q.t, 0.0, 5.0, 6.0, 4), "sv.paths.rest_to_rest(0.0, 5.0, 6.0, smoothness=4)"),
    "without a duration": (lambda: rest_to_rest(Q.t, 0, 1), "sv.paths.rest_to_rest(0, 1, duration=...)"),
    "without a ramp": (lambda: trapezoid(2 * Q.t, 1.0, 6.0), "sv.paths.trapezoid(1.0, 6.0, ramp=...)"),
    "spline": (lambda: spline(Q.t, [0, 1], [0, 2], ends="natural"), "sv.paths.spline([0, 1], [0, 2], ends='natural')"),
    "trapezoid": (lambda: trapezoid(t=Q.t, distance=1.0, duration=6.0, ramp=1.0), "distance=1.0, duration=6.0, ramp=1.0"),
}  # fmt: skip


@pytest.mark.parametrize("name", OLD)
def test_a_time_before_the_other_arguments_is_refused_with_the_line_to_write(name):
    make, line = OLD[name]
    with refused(SpecificationError, line, "q.references(X="):
        make()
    with pytest.raises(TypeError, match="smothness"):
        rest_to_rest(0.0, 5.0, 6.0, smothness=4)


def test_what_moved_elsewhere_is_named():
    for name, where in (("line", "sv.curves.line"), ("circle", "sv.curves.circle"), ("piecewise", "sv.paths.polynomials")):
        with pytest.raises(AttributeError, match=where):
            getattr(sv.paths, name)
    assert not hasattr(sv.paths, "unknown") and not hasattr(sv.rotations, "unknown")
    with pytest.raises(AttributeError, match=r"sv.rotations has no 'spline'.*sv.rotations.vectors"):
        sv.rotations.spline  # noqa: B018
