"""Target trajectories: values, derivatives at and between the knots, splines, time laws, bad input."""

import math
from fractions import Fraction

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from refusals import refused
from scipy.interpolate import CubicSpline, make_interp_spline

import servoctl as sv
from servoctl.codegen import emit
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.spec import paths
from servoctl.spec.coordinates import coordinates

T, P = ca.SX.sym("t"), ca.SX.sym("p")
S9 = {5: 126, 6: -420, 7: 540, 8: -315, 9: 70}
S13 = {7: 1716, 8: -9009, 9: 20020, 10: -24024, 11: 16380, 12: -6006, 13: 924}


def derivatives(path, order):
    """A function of times (N,) giving path, path', ..., path^(order) as an (order + 1, dim, N) array."""
    rows = [path]
    for _ in range(order):
        rows.append(ca.cse(ca.jacobian(rows[-1], T)))
    f = ca.Function("derivatives", [T], [ca.horzcat(*rows)])

    def evaluate(times):
        values = [np.array(f(float(t))).T for t in np.atleast_1d(times)]
        return np.stack(values, axis=-1)

    return evaluate


def step(k, sigma, order=0):
    """Derivative of the regularised incomplete beta function I_sigma(k + 1, k + 1), in 60 digits."""
    powers = {k + 1 + j: math.comb(k + j, j) * math.comb(2 * k + 1, k - j) * (-1) ** j for j in range(k + 1)}
    with mp.workdps(60):
        terms = (c * mp.ff(n, order) * mp.mpf(float(sigma)) ** (n - order) for n, c in powers.items() if n >= order)
        return float(mp.fsum(terms))


@pytest.mark.parametrize("k", range(9))
def test_rest_to_rest_has_k_vanishing_derivatives_at_both_ends(k):
    f = derivatives(paths.rest_to_rest(T, 2.0, -1.0, duration=3.0, smoothness=k, t_start=1.0), k)
    peaks = np.abs(f(np.linspace(1.0, 4.0, 101))).max(axis=2)[:, 0]
    for t, end in ((1.0, 2.0), (np.nextafter(1.0, 2.0), 2.0), (np.nextafter(4.0, 3.0), -1.0), (4.0, -1.0)):
        values = f(t)[:, 0, 0]
        assert abs(values[0] - end) < 1e-15
        assert np.all(np.abs(values[1:]) < 1e-14 * peaks[1:])
    for t, end in ((0.999, 2.0), (-50.0, 2.0), (4.001, -1.0), (1e6, -1.0)):
        assert np.array_equal(f(t)[:, 0, 0], [end] + [0.0] * k)


@pytest.mark.parametrize("k", [0, 1, 4, 6, 12, 20])
def test_rest_to_rest_is_the_incomplete_beta_function(k):
    f = ca.Function("f", [T], [paths.rest_to_rest(T, 0.0, 1.0, duration=1.0, smoothness=k)])
    near_ends = np.logspace(-8, -1, 15)
    for sigma in np.concatenate([near_ends, np.linspace(0.0, 1.0, 41), 1.0 - near_ends]):
        exact = float(mp.betainc(k + 1, k + 1, 0, mp.mpf(float(sigma)), regularized=True))
        assert abs(float(f(sigma)) - exact) < 1e-15
        assert abs(step(k, sigma) - exact) < 1e-15


@pytest.mark.parametrize("k", [4, 8, 20])
def test_derivatives_by_taylor_arithmetic_are_exact_to_the_scale_of_each(k):
    q = coordinates("x")
    order = 12
    path = paths.rest_to_rest(q.t, 0.0, 1.0, duration=1.0, smoothness=k)
    f = ca.Function("f", [q.t], [q.dt(path, j) for j in range(1, order + 1)])
    sigmas = np.concatenate([np.linspace(0.01, 0.99, 50), [1e-6, 1e-3, 1 - 1e-3, 1 - 1e-6]])
    exact = np.array([[step(k, s, j) for j in range(1, order + 1)] for s in sigmas])
    values = np.array([[float(v) for v in f(s)] for s in sigmas])
    peaks = np.abs(exact).max(axis=0)
    smooth = peaks > 0  # the polynomial has degree 2k + 1
    assert np.all(np.abs(values - exact)[:, smooth].max(axis=0) < 1e-14 * peaks[smooth])


@pytest.mark.parametrize(("k", "coefficients"), [(4, S9), (6, S13)])
def test_rest_to_rest_is_the_printed_polynomial(k, coefficients):
    f = ca.Function("f", [T], [paths.rest_to_rest(T, 0.0, 1.0, duration=1.0, smoothness=k)])
    for sigma in np.linspace(0.0, 1.0, 2 * k + 3):
        printed = sum(c * Fraction(float(sigma)) ** n for n, c in coefficients.items())
        assert abs(float(f(sigma)) - float(printed)) < 1e-15


def test_rest_to_rest_of_vectors_and_symbols():
    distance, duration = ca.SX.sym("distance"), ca.SX.sym("duration")
    path = paths.rest_to_rest(T, (0.0, 4.0), (distance, 2.0), duration, smoothness=6, t_start=distance)
    assert path.shape == (2, 1)
    f = ca.Function("f", [T, distance, duration], [path])
    assert np.allclose(np.array(f(6.0, 5.0, 2.0)).T, [2.5, 3.0], rtol=0, atol=1e-15)
    assert float(paths.rest_to_rest(0.5, 0.0, 3.0, duration=1)) == 1.5
    assert paths.rest_to_rest(T, np.zeros(3), ca.DM([1, 2, 3]), 1.0).shape == (3, 1)


@pytest.mark.parametrize("k", [1, 2, 4, 6])
def test_trapezoid_cruises_and_is_smooth(k):
    f = derivatives(paths.trapezoid(T, 2.0, duration=6.0, ramp=1.5, smoothness=k, t_start=1.0), k + 1)
    speed = 2.0 / 4.5
    cruise = f(np.linspace(2.5, 5.5, 7))[:, 0]
    assert np.allclose(cruise[0], speed * (np.linspace(1.5, 4.5, 7) - 0.75), rtol=0, atol=1e-14)
    assert np.allclose(cruise[1], speed, rtol=0, atol=1e-14)
    assert np.allclose(f([0.0, 1.0, 7.0, 99.0])[:2, 0], [[0, 0, 2, 2], [0, 0, 0, 0]], rtol=0, atol=1e-14)
    ramp = np.linspace(1.0, 2.5, 31)
    assert np.allclose(f(ramp)[1, 0], [speed * step(k - 1, (t - 1.0) / 1.5) for t in ramp], rtol=0, atol=1e-14)
    peaks = np.abs(f(np.linspace(1.0, 7.0, 601))).max(axis=2)[:, 0]
    for knot in (1.0, 2.5, 5.5, 7.0):
        before, on, after = f([knot - 1e-9, knot, knot + 1e-9])[: k + 1, 0].T
        assert np.all(np.abs([on - before, after - on]) < 2e-9 * peaks[1:] + 1e-13 * peaks[:-1])


def test_trapezoid_without_cruise_is_a_triangle():
    f = derivatives(paths.trapezoid(T, 1.0, duration=2.0, ramp=1.0, smoothness=1), 1)
    assert np.allclose(f([0.5, 1.0, 1.5, 2.0])[:, 0], [[0.125, 0.5, 0.875, 1.0], [0.5, 1.0, 0.5, 0.0]], atol=1e-15)


def test_circle_along_a_time_law():
    s = paths.rest_to_rest(T, 0.0, 1.0, duration=6.0, smoothness=4)
    f = derivatives(paths.circle(2 * ca.pi * s, (0.0, 1.0), 0.5), 4)
    values = f(np.linspace(-1.0, 7.0, 41))
    assert np.allclose(np.hypot(values[0, 0], values[0, 1] - 1.0), 0.5, rtol=0, atol=1e-15)
    assert np.allclose(f(3.0)[0, :, 0], [-0.5, 1.0], rtol=0, atol=1e-15)
    for t in (0.0, 6.0):
        assert np.allclose(f(t)[:, :, 0], [[0.5, 1.0]] + [[0.0, 0.0]] * 4, rtol=0, atol=1e-13)


def test_circle_in_space_lies_in_the_plane_of_its_axes():
    f = ca.Function("f", [T], [paths.circle(T, (1.0, 2.0, 3.0), 2.0, axes=((0, 0.6, 0.8), (1, 0, 0)))])
    assert np.allclose(np.array(f(0.0)).T, [1.0, 3.2, 4.6])
    assert np.allclose(np.array(f(np.pi / 2)).T, [3.0, 2.0, 3.0])


def test_line_goes_from_start_to_end():
    f = ca.Function("f", [T], [paths.line(T, (1.0, 2.0, 0.0), (3.0, 1.0, 5.0))])
    assert np.allclose([np.array(f(s))[:, 0] for s in (0.0, 0.5, 1.0)], [[1, 2, 0], [2, 1.5, 2.5], [3, 1, 5]])


TIMES = np.array([0.5, 1.5, 2.0, 4.0, 5.0, 5.7, 6.9])
POINTS = np.random.default_rng(7).normal(size=(7, 2))


@pytest.mark.parametrize("ends", ["rest", "natural"])
@pytest.mark.parametrize("k", [0, 1, 2, 3, 4, 6])
def test_spline_passes_through_its_points_and_is_smooth(k, ends):
    f = derivatives(paths.spline(T, TIMES, POINTS, smoothness=k, ends=ends), k + 1)
    assert np.allclose(f(TIMES)[0].T, POINTS, rtol=0, atol=1e-12)
    peaks = np.abs(f(np.linspace(0.5, 6.9, 401))).max(axis=(1, 2))
    for knot in TIMES:
        before, on, after = np.moveaxis(f([knot - 1e-9, knot, knot + 1e-9])[: k + 1], 2, 0)
        allowed = 2e-9 * peaks[1:, None] + 1e-12 * peaks[:-1, None]
        assert np.all(np.abs(on - before) < allowed) and np.all(np.abs(after - on) < allowed)


def test_spline_at_rest_holds_its_ends():
    f = derivatives(paths.spline(T, TIMES, POINTS, smoothness=3), 3)
    for t, end in ((-9.0, POINTS[0]), (0.5, POINTS[0]), (6.9, POINTS[-1]), (99.0, POINTS[-1])):
        assert np.allclose(f(t)[:, :, 0], [end] + [[0.0, 0.0]] * 3, rtol=0, atol=1e-11)


def test_spline_of_two_points_is_rest_to_rest():
    grid = np.linspace(-1.0, 4.0, 51)
    f = derivatives(paths.spline(T, [0.0, 3.0], [[1.0, 2.0], [0.0, 5.0]], smoothness=4), 4)
    g = derivatives(paths.rest_to_rest(T, (1.0, 2.0), (0.0, 5.0), duration=3.0, smoothness=4), 4)
    assert np.allclose(f(grid), g(grid), rtol=0, atol=1e-11)


def test_natural_cubic_spline_is_scipys():
    f = derivatives(paths.spline(T, TIMES, POINTS[:, 0], smoothness=2, ends="natural"), 2)
    reference = CubicSpline(TIMES, POINTS[:, 0], bc_type="natural")
    grid = np.linspace(0.0, 7.5, 76)
    assert np.allclose(f(grid)[:, 0], [reference(grid, j) for j in range(3)], rtol=0, atol=1e-12)


def test_spline_along_a_time_law_has_the_lower_class():
    s = paths.trapezoid(T, 1.0, duration=4.0, ramp=1.0, smoothness=2)
    f = derivatives(paths.spline(s, [0.0, 0.3, 1.0], [[0.0, 0.0], [1.0, 2.0], [3.0, 1.0]], 4, "natural"), 2)
    assert np.allclose(f([-1.0, 0.0, 4.0, 9.0])[:, :, :].transpose(2, 0, 1)[:, 1:], 0.0, rtol=0, atol=1e-13)
    assert np.allclose(f(4.0)[0, :, 0], [3.0, 1.0], rtol=0, atol=1e-14)


def test_spline_takes_a_derivative_by_taylor_arithmetic_as_by_jacobians():
    q = coordinates("x")
    path = paths.spline(q.t, TIMES, POINTS[:, 0], smoothness=3)
    by_series = ca.Function("f", [q.t], [q.dt(path, 3)])
    by_jacobians = derivatives(ca.substitute(path, q.t, T), 3)
    for t in (0.0, 0.5, 0.9, 2.0, 4.4, 5.0, 6.9, 8.0):
        assert abs(float(by_series(t)) - by_jacobians(t)[3, 0, 0]) < 1e-10


@pytest.mark.parametrize("ends", ["rest", "natural"])
@pytest.mark.parametrize("smoothness, most", [(0, 1e-13), (2, 1e-12), (4, 1e-9), (6, 1e-6)])
def test_a_spline_through_parameters_is_that_through_their_numbers(ends, smoothness, most):
    """Via points, times, or both as symbols: the same values and derivatives up to the class."""
    grid = np.linspace(0.2, 7.3, 43)
    expected = derivatives(paths.spline(T, TIMES, POINTS, smoothness, ends), smoothness)(grid)
    times, points = ca.SX.sym("times", len(TIMES)), ca.SX.sym("points", *POINTS.shape)
    symbols, numbers = ca.veccat(times, points), np.concatenate([TIMES, np.ravel(POINTS, order="F")])
    rows = [points[i, :].T for i in range(len(TIMES))]
    nested = [points[i, :].elements() for i in range(len(TIMES))]
    for a, b in ((TIMES, points), (TIMES, rows), (times, POINTS), (times.elements(), nested)):
        path = ca.substitute(paths.spline(T, a, b, smoothness, ends), symbols, ca.DM(numbers))
        miss = np.abs(derivatives(path, smoothness)(grid) - expected).max(axis=(1, 2))
        assert np.all(miss <= most * np.abs(expected).max(axis=(1, 2)))


@pytest.mark.parametrize("ends", ["rest", "natural"])
@pytest.mark.parametrize("smoothness", [0, 1, 3, 5])
@pytest.mark.parametrize("count", [9, 40])
def test_a_spline_through_many_parameters_is_that_through_their_numbers(ends, smoothness, count):
    rng = np.random.default_rng(count)
    times, points = np.cumsum(10 ** rng.uniform(-0.3, 0.3, count)), rng.normal(size=(count, 2))
    grid = np.concatenate([times, np.linspace(times[0] - 1.0, times[-1] + 1.0, 60)])
    expected = derivatives(paths.spline(T, times, points, smoothness, ends), smoothness)(grid)
    symbols = ca.SX.sym("points", *points.shape)
    path = ca.substitute(paths.spline(T, times, symbols, smoothness, ends), symbols, ca.DM(points))
    found = derivatives(path, smoothness)(grid)
    size = np.abs(expected).max(axis=(1, 2))
    assert np.all(np.abs(found - expected).max(axis=(1, 2)) <= 1e-10 * size)


def test_operations_through_parameters_are_in_proportion_to_their_number():
    def operations(n):
        times, points = np.linspace(0.0, 6.0, n), ca.SX.sym("points", n)
        path = paths.spline(T, times, points, 3)
        return emit.operations(ca.Function("f", [T, ca.SX(0, 1), points], [ca.vertcat(path, ca.jtimes(path, T, 1.0))]))

    few, some, many = (operations(n) for n in (50, 100, 400))
    assert (many - some) / 300 == pytest.approx((some - few) / 50, rel=0.05)
    assert (many - some) / 300 < 35


def test_a_spline_through_parameters_at_very_uneven_times_is_refused():
    times = np.cumsum(np.array([1.0, 1e-9, 1.0, 1.0, 1e-9, 1.0, 1.0, 1.0, 1e-9, 1.0]))
    with refused(sv.errors.SpecificationError, degree=13):
        paths.spline(T, times, ca.SX.sym("points", len(times)), 6)


def test_a_plan_through_twelve_parameters_pushes_as_its_spline_does():
    q = sv.coordinates("a")
    (a,) = q
    names = [f"via_{k}" for k in range(12)]
    p = sv.parameters(m=2.0, duration=6.0, **dict.fromkeys(names, 0.0))
    law = np.linspace(0.0, 1.0, 12)
    path = paths.spline(q.t / p.duration, law, [getattr(p, name) for name in names], 3, "natural")
    machine = sv.Mechanism(q, gibbs=sv.particle(q, p.m, a), actuators={"F": a}, parameters=p)
    model = sv.derive(machine, sv.Program({"X": a - path}, by="actuators"))
    for duration in (6.0, 3.0):
        points = np.sin(duration * law)
        values = dict(zip(names, points, strict=True))
        changed = model.with_parameters(duration=duration, **values)
        run = sv.simulate(changed, changed.start(), (0.0, duration), t_eval=np.linspace(0.0, duration, 61))
        zeros = [(order, [0.0]) for order in (3, 4)]
        curve = make_interp_spline(duration * law, points[:, None], k=5, bc_type=(zeros, zeros))
        np.testing.assert_allclose(run["F"], 2.0 * curve(run.t, nu=2)[:, 0], atol=1e-8)
        assert sv.verify(run).passed


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: paths.rest_to_rest(T, 0, 1, duration=-2.0), ["duration=-2", "greater than 0"]),
        (lambda: paths.rest_to_rest(T, 0, 1, duration=0), ["duration=0", "greater than 0"]),
        (lambda: paths.rest_to_rest(T, 0, 1, duration=np.nan), ["duration holds NaN"]),
        (lambda: paths.rest_to_rest(T, (0, np.inf), (1, 2), 1.0), ["start holds NaN or infinity"]),
        (lambda: paths.rest_to_rest(T, (0, 1), (1, 2, 3), 1.0), ["start has 2", "end has 3"]),
        (lambda: paths.rest_to_rest(T, (), (), 1.0), ["start has the shape (0,)"]),
        (lambda: paths.rest_to_rest(T, np.eye(2), np.eye(2), 1.0), ["start has the shape (2, 2)"]),
        (lambda: paths.rest_to_rest(T, 0, 1, 1.0, smoothness=3.5), ["smoothness=3.5", "whole number", "smoothness=3."]),
        (lambda: paths.rest_to_rest(T, 0, 1, 1.0, smoothness=-1), ["smoothness=-1", "from 0", "smoothness=0"]),
        (lambda: paths.rest_to_rest(T, 0, 1, 1.0, smoothness=True), ["smoothness=True"]),
        (lambda: paths.rest_to_rest(T, 0, 1, 1.0, smoothness="C4"), ["smoothness='C4'"]),
        (lambda: paths.rest_to_rest(np.linspace(0, 1, 50), 0, 1, 1.0), ["t has 50 entries"]),
        (lambda: paths.rest_to_rest(ca.MX.sym("t"), 0, 1, 1.0), ["t is a MX"]),
        (lambda: paths.rest_to_rest(coordinates("x y"), 0, 1, 1.0), ["t has 2 entries"]),
        (lambda: paths.trapezoid(T, 1, duration=2.0, ramp=1.5), ["1.5 s", "2 s", "A ramp of 1 s"]),
        (lambda: paths.trapezoid(T, 1, duration=2.0, ramp=1.0, smoothness=0), ["smoothness=0", "from 1", "smoothness=1"]),
        (lambda: paths.circle(T, (0, 0), -1.0), ["radius=-1", "greater than 0"]),
        (lambda: paths.circle(T, (0, 0, 0), 1.0), ["3 entries", "no axes"]),
        (lambda: paths.circle(T, (0, 0, 0), 1.0, ((1, 0), (0, 1))), ["centre has 3", "axes[0] has 2"]),
        (lambda: paths.circle(T, (0, 0), 1.0, ((1, 0), (1, 1))), ["orthonormal"]),
        (lambda: paths.circle(T, (0, 0), 1.0, 5), ["axes are 5", "pair"]),
        (lambda: paths.spline(T, [0, 1, 1], [0, 1, 2]), ["times 1 and 2 are 1 and 1", "increase strictly"]),
        (lambda: paths.spline(T, [0, 1, 2], [0, 1]), ["(3,)", "(2,)", "one point for each"]),
        (lambda: paths.spline(T, [0], [1]), ["(1,)", "at least two"]),
        (lambda: paths.spline(T, [0, 1], [0, np.nan]), ["finite numbers"]),
        (lambda: paths.spline(T, [0, 1], [0, T]), ["points contain t", "rest_to_rest"]),
        (lambda: paths.spline(T, [0, 1], [[0, 1], [2]]), ["finite numbers"]),
        (lambda: paths.spline(T, [0, T], [0, 1]), ["times contain t"]),
        (lambda: paths.spline(T, [0, P, 1], [[0, 1], [P, 2], [3]]), ["points[2] has 1"]),
        (lambda: paths.spline(T, [0, P], [0, P, 1]), ["(2,)", "(3,)", "one point for each"]),
        (lambda: paths.spline(T, [0, P, P, 2], [0, 1, 2, 3]), ["times 1 and 2", "increase strictly"]),
        (lambda: paths.spline(T, [0, P], [0, 1], 7), ["smoothness=7", "to 6", "smoothness=6"]),
        (lambda: paths.spline(T, [0, 1], [0, ca.MX.sym("p")]), ["finite numbers"]),
        (lambda: paths.spline(T, [0, 1], [P, P / 0]), ["NaN or infinity"]),
        (lambda: paths.spline(T, [0, 1, 2], [0, 1, 0], 6, "natural"), ["3 points", "4 points", "smoothness=4"]),
        (lambda: paths.spline(T, [0, 1e-5, 1], [0, 1, 0], 4), ["degree 9 misses", "1e+05 times its shortest"]),
        (lambda: paths.spline(T, [0, 1e-300, 1], [0, 1, 0], 4), ["degree 9 misses"]),
    ],
)
def test_bad_input_is_refused_with_the_facts(make, facts):
    with pytest.raises(SpecificationError) as caught:
        make()
    assert [fact for fact in facts if fact not in str(caught.value)] == []
    assert caught.value.details


def test_unknown_spline_end_shows_the_nearest():
    with refused(NameUnknown, name="naturl", match="natural"):
        paths.spline(T, [0, 1], [0, 1], ends="naturl")


@pytest.mark.parametrize("smoothness", [101, 2**63, 10**400])
def test_smoothness_has_a_largest_value(smoothness):
    makers = (
        lambda: paths.rest_to_rest(T, 0, 1, duration=1.0, smoothness=smoothness),
        lambda: paths.trapezoid(T, 1.0, 1.0, 0.2, smoothness=smoothness),
        lambda: paths.spline(T, [0.0, 1.0], [0.0, 1.0], smoothness=smoothness),
    )
    for make in makers:
        with pytest.raises(SpecificationError) as caught:
            make()
        assert caught.value.details["smoothness"] == smoothness and "100" in str(caught.value)
    assert ca.symvar(paths.rest_to_rest(T, 0, 1, duration=1.0, smoothness=100))
