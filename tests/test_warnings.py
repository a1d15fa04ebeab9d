"""No warning of CasADi or NumPy reaches a user: what they warn of is decided, or refused, by servoctl itself."""

import warnings

import casadi as ca
import numpy as np
import pytest

import servoctl as sv
from servoctl.errors import ServoError


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "The residual '.*' is a product")  # which the products here are
        yield


def point(residuals, by="actuators"):
    """A point mass in the plane, driven along both axes, under residuals of (t, x, y)."""
    q = sv.coordinates("x y")
    p = sv.parameters(m=1.0)
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, (x, y)), actuators={"f": x, "g": y}, parameters=p)
    return mechanism, sv.Program(residuals(q.t, x, y), by=by)


AWKWARD = {
    "a product that is zero in two ways": lambda t, x, y: {"a": (x - t) * y, "b": y - t},
    "two products": lambda t, x, y: {"a": (x - t) * y, "b": x * y},
    "a pole": lambda t, x, y: {"a": (x - t) / y},
    "a root at the edge of its domain": lambda t, x, y: {"a": ca.sqrt(x) - t},
    "a logarithm outside its domain": lambda t, x, y: {"a": ca.log(x - 1) - t},
    "an angle outside its domain": lambda t, x, y: {"a": ca.asin(x) - t},
    "exponentials": lambda t, x, y: {"a": ca.exp(100 * x) - ca.exp(t)},
}


@pytest.mark.parametrize("by", ["actuators", "ideal"])
@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_residuals_are_derived_or_refused_in_silence(name, by):
    try:
        model = sv.derive(*point(AWKWARD[name], by))
        assert repr(model.structure()) and repr(model)
        run = sv.simulate(model, model.start(), (0.0, 0.1))
        assert np.all(np.isfinite(run["x"]))
    except ServoError as error:
        assert str(error)


def test_a_structure_that_is_not_found_says_so():
    """On x y = 0 and (x - t) y = 0, that is y = 0, the residuals determine no input."""
    structure = sv.derive(*point(AWKWARD["two products"])).structure()
    assert structure.index is None and structure.relative_degree == ()
    assert structure.realisation == "undecided" and "not decided" in repr(structure)


@pytest.mark.parametrize("function", [np.sin, np.sqrt, np.abs, np.exp, np.tanh])
def test_functions_of_numpy_on_symbols_are_those_of_casadi(function):
    def residuals(t, x, y):
        return {"a": y - function(1.0 + x), "b": x - ca.sin(t)}

    model = sv.derive(*point(residuals))
    run = sv.simulate(model, model.start(guess={"y": 1.0}), (0.0, 0.5))
    assert run["y"] == pytest.approx(function(1.0 + np.sin(run.t)), rel=1e-12)


def test_extremes_between_crowded_samples_are_found_in_silence():
    """A polynomial through samples of which two nearly coincide has no full rank in double precision."""
    model = sv.derive(*point(lambda t, x, y: {"a": x - ca.sin(t), "b": y}))
    crowded = np.unique(np.concatenate([np.linspace(0.0, 3.0, 13), np.pi / 2 + 1e-13 * np.arange(4)]))
    run = sv.simulate(model, model.start(), (0.0, 3.0), t_eval=crowded)
    _, (when, largest) = run.extrema("x")
    assert largest == pytest.approx(1.0, rel=1e-6) and when == pytest.approx(np.pi / 2, abs=1e-3)
