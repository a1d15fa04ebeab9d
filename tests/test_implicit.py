"""Radau IIA: the tableau, orders, stiff scenes, exact Jacobians, projection, reversed time, stops, compilers."""

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import Radau, solve_ivp
from scipy.integrate._ivp import radau as scipy_radau

import servoctl as sv
from servoctl.codegen import compiler
from servoctl.gallery import gallery
from servoctl.methods.choice import as_method
from servoctl.methods.radau import basis, radau
from servoctl.model.equations import invariant_names

pytestmark = pytest.mark.usefixtures("c_compiler")

STATE = ("x", "y", "z", "phi", "theta", "dphi", "dtheta")
ZERO = {"x": 0.0, "y": 0.0, "phi": 0.0, "theta": 0.0}
ORDERS = (5, 9, 13)


@pytest.fixture(scope="module")
def model(gallery_model):
    return gallery_model("appell-hamel")


@pytest.fixture(scope="module")
def start(model):
    return model.start(dphi=1.0, dtheta=2.0, **ZERO)


@pytest.fixture(scope="module", params=[1e7, 1e9])
def stiff(request):
    """Two cars with a stiff spring, the first on its path: model, start, stiffness."""
    m = sv.derive(*gallery["two-cars-ideal"].build(stiffnesses=[request.param]))
    return m, m.start(x2=0.0, dx2=0.0), request.param


def follower(t, stiffness):
    """x2 of the slow motion behind a stiff spring: x1 - gap - r x1'' + r^2 x1'''' with r = m2/k, up to r^3."""
    y2, y0, y4 = (cf.rest_to_rest(t, order, 0.5, 2.5, 2.0, 6) for order in (2, 0, 4))
    r = 2.0 / stiffness
    return y0 - 0.5 - r * y2 + r**2 * y4


def error(run, at=slice(None)):
    reference = cf.appell_hamel(run.t)
    return max(np.abs(run[name] - reference[name])[at].max() for name in STATE)


# the method ----------------------------------------------------------------------------------------------------------


def test_tableau_of_order_5_is_that_of_scipy():
    c, _, _, _, mu, e = radau(5)
    np.testing.assert_allclose(c, scipy_radau.C, rtol=0, atol=1e-15)
    np.testing.assert_allclose(mu @ [1, 1j], [scipy_radau.MU_REAL, scipy_radau.MU_COMPLEX], rtol=1e-14)
    np.testing.assert_allclose(e, scipy_radau.E, rtol=1e-13)


@pytest.mark.parametrize("order", ORDERS)
def test_tableau_integrates_its_order_and_is_stiffly_accurate(order):
    c, rate, from_pairs, to_pairs, mu, _ = radau(order)
    a = np.linalg.inv(rate)
    for k in range(1, order + 1):
        assert abs(a[-1] @ c ** (k - 1) - 1 / k) < 1e-13
    blocks = np.zeros_like(rate)
    blocks[0, 0] = mu[0, 0]
    for q, (re, im) in enumerate(mu[1:]):
        blocks[2 * q + 1 : 2 * q + 3, 2 * q + 1 : 2 * q + 3] = [[re, -im], [im, re]]
    assert np.abs(from_pairs @ blocks @ to_pairs - rate).max() < 1e-11 * np.abs(rate).max()
    np.testing.assert_allclose(basis(c, c), np.eye(len(c)), atol=1e-12)


@pytest.mark.parametrize(("order", "steps"), [(5, (10, 20, 40, 80)), (9, (4, 5, 7, 9)), (13, (2, 3, 4))])
def test_order(order, steps, model, start):
    runs = [sv.simulate(model, start, (0.0, 2.0), method=sv.methods.RadauIIA(order=order, step=2.0 / k)) for k in steps]
    assert [run.counters["steps"] for run in runs] == list(steps)
    errors = [error(run, -1) for run in runs]
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert abs(slope - order) < (0.3 if order == 5 else 0.25 * order), (slope, errors)


@pytest.mark.parametrize("order", ORDERS)
def test_error_follows_the_tolerance_at_all_samples(order, model, start):
    tolerances = (1e-4, 1e-6, 1e-8, 1e-10)
    runs = [
        sv.simulate(model, start, (0.0, 2.0), method=sv.methods.RadauIIA(order=order, rtol=r, atol=r / 100)) for r in tolerances
    ]
    errors = [error(run) for run in runs]
    assert all(e <= 100 * r for e, r in zip(errors, tolerances, strict=True)), errors
    assert errors == sorted(errors, reverse=True)
    assert [r.counters["steps"] for r in runs] == sorted(r.counters["steps"] for r in runs)


def test_tabulated_states_and_default_order(model, start):
    run = sv.simulate(model, start, (0.0, 2.0), method="RadauIIA", t_eval=[0.5, 1.0, 2.0])
    for k, values in enumerate(cf.APPELL_HAMEL_STATES.values()):
        np.testing.assert_allclose([run[name][k] for name in STATE], values, rtol=0, atol=1e-8)
    assert run.counters["steps"] < 20
    assert set(run.counters) >= {"steps", "rejected", "nfev", "njev", "nlu"}


# stiff scenes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ORDERS)
def test_stiff_spring_takes_steps_of_the_motion_and_not_of_the_spring(order, stiff):
    model, start, stiffness = stiff
    run = sv.simulate(model, start, (0.0, 2.0), method=sv.methods.RadauIIA(order=order, rtol=1e-7, atol=1e-9))
    assert np.abs(run["x2"] - follower(run.t, stiffness)).max() < 1e-7
    limit = 2.0 * np.sqrt(stiffness / 2.0) / 2.8  # steps of RK4 at the limit of stability
    assert run.counters["steps"] < (0.2 if stiffness < 1e8 else 0.02) * limit


def test_stiff_spring_against_scipy(stiff):
    model, start, _ = stiff
    f, slopes, n = model.function("ode"), model.function("ode_jacobian"), len(start.values)
    reference = solve_ivp(
        lambda t, x: f(t, x, model.p)[:n],
        (0.0, 1.0),
        start.values,
        method=Radau,
        jac=lambda t, x: slopes(t, x, model.p).reshape(n, n).T,
        rtol=1e-7,
        atol=1e-9,
    )
    run = sv.simulate(model, start, (0.0, 1.0), method=sv.methods.RadauIIA(order=5, rtol=1e-7, atol=1e-9))
    np.testing.assert_allclose(run.jets[:n, -1], reference.y[:, -1], rtol=0, atol=1e-7)
    assert run.counters["steps"] <= 1.3 * (len(reference.t) - 1)


@pytest.mark.parametrize("poles", [False, True])
def test_jacobian_is_that_of_differences(poles, model, start):
    rng = np.random.default_rng(5)
    f = model.function("ode_poles" if poles else "ode")
    slopes = model.function("ode_poles_jacobian" if poles else "ode_jacobian")
    n = len(start.values)
    p = np.append(model.p, rng.uniform(1.0, 9.0, f.n_p - len(model.p)))
    x, h = start.values + rng.uniform(-0.2, 0.2, n), 1e-6
    numeric = [(f(0.3, x + h * e, p) - f(0.3, x - h * e, p))[:n] / (2 * h) for e in np.eye(n)]
    np.testing.assert_allclose(slopes(0.3, x, p).reshape(n, n), numeric, rtol=1e-7, atol=1e-7)


# drift, direction, knots, stops --------------------------------------------------------------------------------------


def test_projection_keeps_the_constraints_and_poles_keep_the_motion(model, start):
    loose = sv.methods.RadauIIA(order=5, rtol=1e-5, atol=1e-7)
    free = sv.simulate(model, start, (0.0, 5.0), loose)
    held = sv.simulate(model, start, (0.0, 5.0), method=loose, drift="project")
    assert max(np.abs(r).max() for r in residuals(held)) <= 1e-9
    assert max(np.abs(r).max() for r in residuals(free)) > 1e-8
    seldom = sv.simulate(model, start, (0.0, 5.0), method=loose, drift=sv.methods.Project(every=3))
    assert seldom.counters["projections"] == seldom.counters["steps"] // 3
    assert error(sv.simulate(model, start, (0.0, 2.0), method="RadauIIA", drift=0.1)) < 1e-8


def residuals(run):
    model = run.model
    f, m = model.function("invariants"), len(invariant_names(model))
    return f.grid(run.t, run.jets[: len(model.state_names)], model.p)[:m]


def test_backwards(model, start):
    n = len(start.values)
    there = sv.simulate(model, start, (0.0, 2.0), method=sv.methods.RadauIIA(rtol=1e-11, atol=1e-13))
    back = sv.simulate(model, there.jets[:n, -1], (2.0, 0.0), method=sv.methods.RadauIIA(rtol=1e-11, atol=1e-13))
    assert np.all(np.diff(back.t) < 0)
    assert np.abs(back.jets[:n, -1] - start.values).max() < 1e-10


def test_steps_end_at_knots(stiff):
    model, start, stiffness = stiff
    run = sv.simulate(model, start, (0.0, 2.5), method=sv.methods.RadauIIA(rtol=1e-7, atol=1e-9))
    after = run.t >= 2.0
    assert {2.0} & {*run.knots} & {*run.t[1:-1]} and np.abs(run["x2"][after] - 2.0).max() < 1e-8


@pytest.mark.parametrize("options", [{}, {"order": 5}, {"order": 9}, {"step": 1e-2}])
@pytest.mark.parametrize("drift", [None, "project"])
def test_stops_when_the_wheel_stops(options, drift, gallery_model):
    squared = gallery_model("appell-hamel-squared")
    at = squared.start(guess={"dx": 0.5}, dphi=1.0, dtheta=2.0, **ZERO)
    with pytest.raises(sv.errors.SingularProgram) as caught:
        sv.simulate(squared, at, (0.0, 2.0), method=sv.methods.RadauIIA(**options), drift=drift)
    assert abs(caught.value.details["t"] - cf.WHEEL_STOPS) < options.get("step", 1e-3)
    assert "speed" in caught.value.details["rows"] and "dphi" in caught.value.details["zero"]
    assert caught.value.run.t[-1] <= caught.value.details["t"]


def test_escape_is_told():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, ca.vertcat(x, y)))
    escaping = sv.derive(mechanism, sv.Program({"growth": q.d(1)[0] - x**2}, by="ideal"), keep=["y"])
    with pytest.raises(sv.errors.IntegrationStopped) as caught:
        sv.simulate(escaping, escaping.start(x=1.0, y=0.0, dy=0.0), (0.0, 2.0), method="RadauIIA")
    assert abs(caught.value.details["t"] - 1.0) < 1e-3
    assert 0.9 < caught.value.run.t[-1] < 1.0 + 1e-6


def test_options():
    for options in ({"order": 7}, {"jets": 3}):
        with pytest.raises(sv.errors.SpecificationError) as caught:
            as_method("RadauIIA", **options)
        assert caught.value.details == options
    with refused(sv.errors.SpecificationError, "step=-1", name="step", value=-1.0):
        as_method("RadauIIA", step=-1.0)


# without a compiler --------------------------------------------------------------------------------------------------


def test_without_a_compiler_scipys_method_is_named(start, monkeypatch):
    monkeypatch.setenv("SERVOCTL_COMPILER", "none")
    monkeypatch.setattr(compiler, "_warned", True)
    model = sv.derive(*gallery["appell-hamel"].build())
    for step in (None, 0.01):
        with pytest.raises(sv.errors.SpecificationError, match="'Radau'"):
            sv.simulate(model, start, (0.0, 0.1), method=sv.methods.RadauIIA(step=step))
    assert sv.simulate(model, start, (0.0, 0.1), method="Radau").success
