"""Sine and cosine of eight points at once, and of one, against extended precision; blocks of Newton's iteration."""

import ctypes

import casadi as ca
import mpmath
import numpy as np
import pytest
from test_compiled_functions import P1, X2, T, along, function, newton_model

from servoctl.codegen import compiler, emit
from servoctl.codegen import function as functions
from servoctl.codegen.emit import SHARED, WIDE
from servoctl.codegen.function import compiled

TINY, LAST_SMALL = 1e-300, np.nextafter(1e5, 0)


@pytest.fixture(autouse=True)
def grids_compile(monkeypatch):
    monkeypatch.setattr(functions, "MANY_POINTS", 0)


def points(model, t, x, p):
    """Outputs (n_y, N) point by point, in compiled code."""
    at, state, parameters, y, call = model.buffer()
    parameters[:], columns = p, []
    for at[0], state[:] in zip(t, x.T, strict=True):
        call()
        columns.append(y.copy())
    return np.array(columns).T


def at_points(model, x):
    """A function for a loop to call in C: its sine and cosine are in line."""
    return points(model, np.zeros(x.shape[1]), x, [0.0])


def on_grid(model, x):
    return model.grid(0.0, x, [0.0])


UNREDUCED = np.concatenate([np.linspace(0.77, 0.8, 50), np.nextafter(0.785, [0, 1]), [0.785]])  # up to 0.785 and beyond
BOTH = pytest.mark.parametrize(("loops", "evaluated"), [((), on_grid), (("law",), at_points)], ids=["lanes", "one"])


@BOTH
def test_sine_and_cosine_are_within_two_units(loops, evaluated):
    rng = np.random.default_rng(2)
    turns = np.arange(-60, 61) * np.pi / 2
    a = np.concatenate([rng.uniform(-10, 10, 200), rng.uniform(-1e5, 1e5, 100), UNREDUCED, -UNREDUCED, turns, np.nextafter(turns, 99),
                        63661 * np.pi / 2 + np.linspace(-1e-9, 1e-9, 5), [0.0, -0.0, TINY, -TINY, LAST_SMALL, 1e-5]])
    y = evaluated(compiled(function(ca.sin(X2[0]), ca.cos(X2[0])), "circular", loops=loops), np.vstack([a, a]))
    with mpmath.workdps(40):
        exact = np.array([[float(f(mpmath.mpf(v))) for v in a] for f in (mpmath.sin, mpmath.cos)])
    np.testing.assert_array_max_ulp(y, exact, maxulp=2)
    np.testing.assert_array_equal(np.signbit(y[0, -6:-4]), [False, True])


@BOTH
def test_arguments_that_are_large_or_not_finite_do_not_disturb_other_points(loops, evaluated):
    a = np.array([0.3, np.nan, 1e300, np.inf, 0.3, -1e6, 1e5, 2.0])
    y = evaluated(compiled(function(ca.sin(X2[0]), ca.cos(X2[0])), "large", loops=loops), np.vstack([a, a]))
    with np.errstate(invalid="ignore"):
        np.testing.assert_allclose(y, [np.sin(a), np.cos(a)], rtol=4e-16, atol=0)


def test_the_sine_of_a_point_is_the_library_s_where_no_loop_calls_it():
    f = function(ca.sin(X2[0]))
    assert "s_sin(" in emit.emit(f, "f", ("law",))
    assert "s_sin" not in emit.emit(f, "f") and "s_sin" not in emit.function(f, "f", emit.PORTABLE)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 15, 16, 300])
def test_a_grid_of_any_length_equals_points(n):
    x, rng = X2, np.random.default_rng(n)
    model = compiled(function(x[0] / (1 + x[1] ** 2) + T, ca.sin(P1 * x[0]) ** 2, ca.fmax(x[0], x[1])), "any")
    t, x = rng.normal(size=n), rng.normal(size=(2, n))
    np.testing.assert_allclose(model.grid(t, x, [3.0]), points(model, t, x, [3.0]), rtol=1e-15, atol=1e-16)
    p = rng.normal(size=(1, n))
    each = np.array([model(*at) for at in zip(t, x.T, p.T, strict=True)]).T
    np.testing.assert_allclose(model.grid(t, x, p), each, rtol=1e-15, atol=1e-16)


def test_a_point_does_not_depend_on_its_place_in_a_grid():
    model = compiled(function(ca.sin(X2[0]) * ca.exp(X2[1])), "place")
    x = np.tile([[0.7], [0.2]], 21)
    assert len(set(model.grid(0.0, x, [0.0])[0].tolist())) == 1


IN_USE = """
#include <stdint.h>
int64_t in_use(void (*grid)(int64_t, const double *, const double *, const double *, int64_t, double *), double *v)
{
    uint32_t low, high;
    grid(8, v, v, v, 0, v + 64);
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(1));
    return low;
}
"""


@pytest.mark.usefixtures("c_compiler")
@pytest.mark.skipif("xgetbv1" not in compiler.features(), reason="the processor does not report registers in use")
def test_a_grid_leaves_no_long_register_in_use():
    model, values = compiled(function(X2[0] * X2[1], X2[0] + T), "registers"), np.ones(128)
    model.grid(0.0, np.zeros((2, 8)), [0.0])
    probe = compiler.library(IN_USE)
    grid = ctypes.cast(model._lanes.native("grid"), ctypes.c_void_p)
    upper_halves = 1 << 2 | 1 << 6  # of ymm and of zmm registers
    assert not probe.in_use(grid, values.ctypes.data_as(ctypes.c_void_p)) & upper_halves


def test_shared_divisors_are_inverted_once():
    x = ca.SX.sym("x", SHARED + 1)
    divisor = 1 + x[SHARED] ** 2
    for n in (SHARED - 1, SHARED):
        f = function(*(x[i] / divisor for i in range(n)), x=x)
        scalar = emit.emit(f, "f").split('#include "lanes.h"')[0]
        assert scalar.count(" / ") == (1 if n >= SHARED else n)


def test_long_functions_have_no_copy_for_eight_points():
    value = X2[0]
    for _ in range(WIDE + 1):
        value = ca.sin(value)
    assert '"lanes.h"' not in emit.emit(function(value), "long")


# --- Newton's iteration, block by block


def kepler():
    x = ca.SX.sym("x", 2)
    return newton_model(ca.vertcat(x[0] - P1 * ca.sin(x[0]) - T, x[1] * ca.cos(x[0]) - 1 / 2), x, "kepler", x[0] * x[1])


SCATTERED = np.sort(np.append(0, np.random.default_rng(5).uniform(0, 1, 200)))


@pytest.mark.parametrize("t", [np.linspace(0, 1, 500), np.linspace(1, 0, 300), SCATTERED])
def test_blocks_equal_points(t, backend):
    model = kepler()
    x0 = [1.2, 1.4] if t[0] else [0.0, 0.5]
    x, y, iterations = along(model, t, x0, [0.4])
    assert x.shape[1] == t.size and model.backend == backend
    at = x0
    for k, now in enumerate(t):
        alone, rest, _ = along(model, np.array([now]), at, [0.4])
        at = alone[:, 0]
        conditions = 1 + np.abs([at[0], at[1] * np.tan(at[0])])  # x1 = 1 / (2 cos x0)
        assert np.all(np.abs(x[:, k] - at) <= 5e-16 * conditions)
        np.testing.assert_allclose(y[2:, k], rest[2:, 0], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(x[0] - 0.4 * np.sin(x[0]), t, rtol=0, atol=5e-16)


def test_points_between_nodes_take_two_evaluations(backend):
    t, model = np.linspace(0, 1, 801), kepler()
    nodes, _ = model.continuation([0.0, 1.0], [0.0, 0.5], [0.4], 0.02, 1000)
    assert model.newton(t, nodes, [0.4])[1] <= 2.1 * t.size


@pytest.mark.parametrize("last", range(190, 199))
def test_a_block_ends_where_its_solution_ends(last, backend):
    x = ca.SX.sym("x")
    model = newton_model(x**2 - (1 - T), x, "fold_in_block")
    t = np.append(np.linspace(0, 0.6, last), np.linspace(1.01, 1.6, 150))
    solution, y, _ = along(model, t, [0.9], [0.0])
    assert solution.shape[1] == y.shape[1] == last
    np.testing.assert_allclose(solution[0], np.sqrt(1 - t[:last]), rtol=1e-14)


def test_a_kink_within_a_block_is_followed(backend):
    x = ca.SX.sym("x")
    path = ca.fabs(T - 0.5)
    model = newton_model(x + x**3 - path - path**3, x, "kink")
    for t in (np.linspace(0, 1, 200), np.linspace(0, 1, 23)):
        solution, _, _ = along(model, t, [0.5], [0.0])
        np.testing.assert_allclose(solution[0], np.abs(t - 0.5), rtol=0, atol=1e-15)


def test_far_predictions_are_not_trusted(backend):
    x = ca.SX.sym("x")
    model = newton_model(ca.sin(x - 40 * ca.sin(7 * T)), x, "many_roots")  # a root every pi
    t = np.linspace(0, 2, 2001)
    solution, _, _ = along(model, t, [0.0], [0.0])
    np.testing.assert_allclose(solution[0], 40 * np.sin(7 * t), rtol=0, atol=1e-13)
