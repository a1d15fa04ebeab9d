"""Algorithms that are kept here because importing scipy takes longer than most motions: step for step those of scipy."""

import numpy as np
import pytest
from scipy.integrate import DOP853, RK45
from scipy.optimize import brentq, minimize_scalar
from test_surface import LATE, loaded

from servoctl.methods import brent
from servoctl.methods.dop853 import DormandPrince8
from servoctl.methods.runge_kutta import tableau


def kepler(t, y):
    return np.array([y[2], y[3], *(-y[:2] / np.hypot(y[0], y[1]) ** 3)])


def kicked(t, y):
    return np.array([np.cos(50 * t), np.sign(np.sin(9 * t))])


PROBLEMS = {  # rates, start, y there, end, rtol, atol
    "eccentric ellipse": (kepler, 0.0, [0.1, 0.0, 0.0, 4.2], 5.0, 1e-9, 1e-11),
    "backwards, tolerances of each entry": (lambda t, y: -y, 0.0, [1.0, 2.0], -3.0, 1e-6, np.array([1e-8, 1e-3])),
    "at rest": (lambda t, y: 0 * y, 0.0, [0.0, 0.0], 1.0, 1e-9, 1e-11),
    "jumps of the rates": (kicked, 0.0, [0.0, 0.0], 1.0, 1e-9, 1e-11),
    "stability limits the steps": (lambda t, y: -1e3 * (y - np.cos(t)), 0.0, [0.0], 0.2, 1e-9, 1e-11),
    "no span": (lambda t, y: -y, 1.0, [1.0], 1.0, 1e-9, 1e-11),
    "escapes at t = 1": (lambda t, y: y**2, 0.0, [1.0], 2.0, 1e-9, 1e-11),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS)
def test_dop853_takes_the_steps_of_scipy(problem):
    rates, t, y, end, rtol, atol = problem
    own, exact = DormandPrince8(rates, t, y, end, rtol, atol), DOP853(rates, t, np.array(y), end, rtol=rtol, atol=atol)
    while own.status == exact.status == "running":
        assert (own.step() is None) == (exact.step() is None)
        assert own.t == pytest.approx(exact.t, rel=1e-12) and own.y == pytest.approx(exact.y, rel=1e-11, abs=1e-13)
        if own.status != "failed":
            times = np.linspace(own.t_old, own.t, 5)
            assert own.dense_output()(times) == pytest.approx(exact.dense_output()(times), rel=1e-11, abs=1e-13)
        assert own.nfev == exact.nfev
    assert own.status == exact.status


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_dop853_ends_where_the_rates_are_no_numbers():
    solver = DormandPrince8(lambda t, y: np.where(t > 0.5, np.nan, 1.0) + 0 * y, 0.0, [0.0], 1.0, 1e-9, 1e-11)
    while solver.status == "running":
        solver.step()
    assert solver.status == "failed" and solver.t <= 0.5


@pytest.mark.parametrize("name, method", [("RK5", RK45), ("RK8", DOP853)])
def test_tableaus_are_those_of_scipy(name, method):
    (a, b, c), s = tableau(name), method.n_stages
    assert a[:, : method.A.shape[1]] == pytest.approx(method.A[:s, :s], rel=1e-15)
    assert b == pytest.approx(method.B[:s], rel=1e-15) and c == pytest.approx(method.C[:s], rel=1e-15)


@pytest.mark.parametrize("seed", range(40))
def test_a_root_and_a_minimum_are_those_of_scipy(seed):
    rng = np.random.default_rng(seed)
    c, s = rng.standard_normal(5) * 10.0 ** rng.integers(-3, 4, 5), rng.standard_normal(2)
    a, b = rng.uniform(-3, 3, 2)

    def f(x):
        return c[0] + c[1] * x + c[2] * np.sin(3 * x + s[0]) + c[3] * x**3 + c[4] * abs(x - s[1])

    within = 1e-9 * abs(b - a)
    expected = minimize_scalar(f, bounds=sorted((a, b)), method="bounded", options={"xatol": within})
    x, value = brent.least(f, a, b, within)
    assert x == pytest.approx(expected.x, abs=1e-7) and value == pytest.approx(expected.fun, rel=1e-12, abs=1e-7)
    middle = (f(a) + f(b)) / 2  # which f takes between a and b
    root = brent.root(lambda x: f(x) - middle, a, b, 1e-14)
    assert root == pytest.approx(brentq(lambda x: f(x) - middle, a, b, xtol=1e-14), rel=1e-13, abs=1e-13)


def test_a_root_at_an_end_and_a_jump():
    assert brent.root(lambda x: x - 1.0, 1.0, 2.0, 1e-14) == 1.0
    assert brent.root(lambda x: x - 2.0, 1.0, 2.0, 1e-14) == 2.0
    assert brent.root(lambda x: -1.0 if x < 0.3 else 1.0, 0.0, 1.0, 1e-14) == pytest.approx(0.3, abs=1e-13)
    assert brent.least(lambda x: abs(x - 0.3), 1.0, 0.0, 1e-12)[0] == pytest.approx(0.3, abs=1e-8)


def test_an_integrated_motion_with_an_event_loads_no_scipy():
    script = """
import casadi as ca, servoctl as sv
q = sv.coordinates("x y")
x, y = q
bob = sv.particle(q, 1.0, (x, y))
rod = sv.Mechanism(q, gibbs=bob, potential=9.81 * y, constraints={"rod": x**2 + y**2 - 1})
plant = sv.plant(rod)
for method in ("DOP853", "RK5", "RK8"):
    run = sv.simulate(plant, {"x": 0.6, "y": -0.8, "dx": 0.0, "dy": 0.0}, (0.0, 2.0), method, events={"lowest": "x"})
    assert run.success and len(run.events["lowest"].t) == 2
"""
    assert "scipy" not in loaded(script, LATE)
