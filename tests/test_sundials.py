"""CVODES and IDAS through CasADi: tabulated states, the form before elimination, reversed time, knots, stops, refusals."""

import os
import signal
import threading

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.methods.choice import as_method
from servoctl.methods.sundials import sundials_solver

STATE = ("x", "y", "z", "phi", "theta", "dphi", "dtheta")
ZERO = {"x": 0.0, "y": 0.0, "phi": 0.0, "theta": 0.0}
METHODS = ("CVODES", "IDAS")
TIGHT = {"rtol": 1e-11, "atol": 1e-13}

pytestmark = pytest.mark.parametrize("method", METHODS)


@pytest.fixture(scope="module")
def model(gallery_model):
    return gallery_model("appell-hamel")


@pytest.fixture(scope="module")
def start(model):
    return model.start(dphi=1.0, dtheta=2.0, **ZERO)


@pytest.mark.parametrize("drift", [None, 0.5])
def test_tabulated_states(method, drift, model, start):
    run = sv.simulate(model, start, (0.0, 2.0), method=as_method(method, **TIGHT), drift=drift, t_eval=[0.5, 1.0, 2.0])
    for k, values in enumerate(cf.APPELL_HAMEL_STATES.values()):
        np.testing.assert_allclose([run[name][k] for name in STATE], values, rtol=0, atol=1e-8)
    assert run.t.tolist() == [0.5, 1.0, 2.0] and run.counters["steps"] > 50


def test_error_follows_the_tolerance(method, model, start):
    errors = []
    for rtol in (1e-5, 1e-7, 1e-9):
        run = sv.simulate(model, start, (0.0, 2.0), method=as_method(method, rtol=rtol, atol=rtol / 100))
        reference = cf.appell_hamel(run.t)
        errors.append(max(np.abs(run[name] - reference[name]).max() for name in STATE))
    assert errors == sorted(errors, reverse=True) and errors[0] > 100 * errors[-1] and errors[-1] < 1e-6


@pytest.mark.parametrize("drift", [None, 0.5])
def test_idas_knows_nothing_of_the_elimination(method, drift, model):
    """Its equations are the rows themselves: L γ^(s̄) + rest, which vanishes at what the elimination finds."""
    parts = sundials_solver(model, method, drift is not None).parts
    assert ("alg" in parts) == (method == "IDAS")
    if method == "IDAS":
        assert parts["z"].numel() == parts["alg"].numel() == model.n


def test_backwards(method, model, start):
    n = len(start.values)
    there = sv.simulate(model, start, (0.0, 2.0), method=as_method(method, **TIGHT))
    back = sv.simulate(model, there.jets[:n, -1], (2.0, 0.0), method=as_method(method, **TIGHT))
    assert np.all(np.diff(back.t) < 0)
    assert np.abs(back.jets[:n, -1] - start.values).max() < 1e-8


def test_knots(method, gallery_model):
    model = gallery_model("two-cars-ideal")
    start = model.start(x2=0.0, dx2=0.0)
    run = sv.simulate(model, start, (0.0, 3.0), method=as_method(method, **TIGHT))
    reference = sv.simulate(model, start, (0.0, 3.0), method=sv.Taylor(rtol=1e-13, atol=1e-15))
    assert set(model.knots) & set(run.t[1:-1])
    assert np.abs(run.jets[:4] - reference.jets[:4]).max() < 1e-8


@pytest.mark.parametrize("scene", ["overhead-crane", "three-cars", "pendubot"])
def test_steep_starts(method, scene, gallery_model):
    """Accelerations that leave rest along a path of high order are no obstacle to the first step."""
    model, scene = gallery_model(scene), gallery[scene]
    start = model.start(**scene.start, guess=scene.guess)
    run = sv.simulate(model, start, scene.t_span, method=method)
    reference = sv.simulate(model, start, scene.t_span, method=sv.Taylor(rtol=1e-13, atol=1e-15), t_eval=run.t)
    sizes = 1.0 + np.abs(reference.jets).max(axis=1, keepdims=True)
    assert run.success and (np.abs(run.jets - reference.jets) / sizes)[: len(start.values)].max() < 1e-6


def test_stops_when_the_wheel_stops(method, gallery_model):
    squared = gallery_model("appell-hamel-squared")
    at = squared.start(guess={"dx": 0.5}, dphi=1.0, dtheta=2.0, **ZERO)
    with pytest.raises(sv.SingularProgram) as caught:
        sv.simulate(squared, at, (0.0, 1.0), method=method)
    assert abs(caught.value.details["t"] - cf.WHEEL_STOPS) < 1e-3
    assert "speed" in caught.value.details["rows"]
    assert 0.6 < caught.value.run.t[-1] <= caught.value.details["t"]


def test_failure_keeps_what_was_computed(method):
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, ca.vertcat(x, y)))
    escaping = sv.derive(mechanism, sv.Program({"growth": q.d(1)[0] - x**2}, by="ideal"), keep=["y"])
    with pytest.raises(sv.IntegrationStopped) as caught:
        sv.simulate(
            escaping, escaping.start(x=1.0, y=0.0, dy=0.0), (0.0, 1.2), method=as_method(method, rtol=1e-6, atol=1e-8)
        )
    run = caught.value.run
    assert 0.9 < run.t[-1] < 1.01
    early = run.t < 0.9
    np.testing.assert_allclose(run["x"][early], 1 / (1 - run.t[early]), rtol=1e-3)


def test_an_integrator_that_cannot_be_made_leaves_the_start(method, model, start, monkeypatch):
    """A run keeps nothing in the solver, which models share between threads."""
    solver = sundials_solver(model, method)
    kept = dict(vars(solver))
    given = (np.linspace(0.0, 0.1, 5), start.values, np.zeros(model.n), model.parameters, 1e-6, 1e-8)
    assert solver.run(*given)[1]["steps"] > 0 and vars(solver) == kept

    def broken(*_):
        raise RuntimeError("no memory")

    monkeypatch.setattr(ca, "integrator", broken)
    x, counts = type(solver)(model.equations, method).run(*given)
    assert x[:, 0].tolist() == start.values.tolist() and x.shape[1] == 1 and counts == {}


def test_projection_is_refused_with_the_reason(method, model, start):
    with refused(sv.SpecificationError, "project", method):
        sv.simulate(model, start, (0.0, 1.0), method=method, drift="project")


@pytest.fixture
def interruptible():
    """SIGINT raises KeyboardInterrupt, also where the shell started the tests in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_is_no_failure_of_the_integrator(method, model, start, interruptible):
    sv.simulate(model, start, (0.0, 0.1), method=method)  # compiled
    threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    run = sv.simulate(model, start, (0.0, 3000.0), method=as_method(method, **TIGHT))  # tens of seconds
    assert run.status == 1 and not run.success and "interrupted" in run.message
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
