"""Models that are derived once for all tests, and numbers from expressions."""

import os
import sys
import warnings

import casadi as ca
import numpy as np
import pytest

if os.environ.get("SERVOCTL_TESTS_LONGDOUBLE") == "double":  # of this size on Windows and on ARM under macOS
    np.longdouble = np.float64

from scenes import CRANE, CRANE_PROGRAM, POINT, POINT_PROGRAM

import servoctl as sv
from servoctl.codegen import compiler, function
from servoctl.gallery import gallery
from servoctl.model.model import derive

os.environ["SERVOCTL_MEMO"] = "none"  # tests derive themselves what they test
with warnings.catch_warnings():  # of a CC that names no program
    warnings.simplefilter("ignore")
    compiler._warned = compiler.compiler() is None  # without one the whole suite runs in CasADi


@pytest.fixture
def c_compiler(monkeypatch):
    """The system's compiler, also where the suite runs without one by choice."""
    if os.environ.get("SERVOCTL_COMPILER") == "none":
        monkeypatch.delenv("SERVOCTL_COMPILER")
    if compiler.compiler() is None:
        pytest.skip("needs a compiler")


@pytest.fixture(params=("c", "casadi"))
def backend(request, monkeypatch):
    """Compiled code in every grid and loop, and CasADi where there is no compiler."""
    monkeypatch.setattr(function, "GRID_POINTS", 0)
    if request.param == "c":
        request.getfixturevalue("c_compiler")
    else:
        monkeypatch.setenv("SERVOCTL_COMPILER", "none")
        monkeypatch.setattr(compiler, "_warned", True)
    return request.param


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The current folder is an empty one, and what a scene file adds to the import path is forgotten."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


@pytest.fixture(scope="session")
def gallery_model():
    """A function from a gallery name to its model, derived at the first call."""
    models = {}

    def model(name):
        if name not in models:
            models[name] = derive(*gallery[name].build())
        return models[name]

    return model


@pytest.fixture(scope="session")
def crane_plan():
    """The overhead crane's motion over 8 s: the path ends at 6 s."""
    model = derive(CRANE, CRANE_PROGRAM)
    return sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0))


@pytest.fixture(scope="session")
def plan(crane_plan):
    """The crane's motion, in modules that have no other."""
    return crane_plan


@pytest.fixture(scope="session")
def point_plan():
    """The point mass's motion over 2 s: the path ends at 1 s."""
    model = derive(POINT, POINT_PROGRAM)
    return sv.simulate(model, model.start(), (0.0, 2.0))


@pytest.fixture(scope="session")
def wheel(gallery_model):
    """The Appell-Hamel mechanism and its start."""
    model, scene = gallery_model("appell-hamel"), gallery["appell-hamel"]
    return model, model.start(guess=scene.guess, **scene.start)


def pendulum(unit=1.0, guess=True):
    """A pendulum in x and y, its rod of 1 m a material constraint, with lengths in 1/unit metres; a cart beside it."""
    p = sv.parameters(m=1.0, g=9.81 * unit, length=unit)
    q = sv.coordinates("s x y")
    s, x, y = q
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m, (x, y)) + sv.particle(q, 2.0, (s,)),
        potential=p.m * p.g * y,
        actuators={"force": s},
        constraints={"rod": x**2 + y**2 - p.length**2},
        parameters=p,
    )
    program = sv.Program({"cart": s - 0.1 * unit * ca.sin(q.t)})
    return sv.derive(mechanism, program, guess={"y": -unit} if guess else {}, keep=["x", "y"])


def words(text):
    """The text without its line breaks."""
    return " ".join(text.split())


def relative(found, expected):
    """Largest error, of the largest value."""
    return np.abs(np.asarray(found) - np.asarray(expected)).max() / max(np.abs(expected).max(), 1e-300)


def numbers(expressions, values):
    """Values (n,) of SX expressions for a dict from symbol names to numbers."""
    expressions = ca.densify(ca.vertcat(*expressions))
    symbols = ca.symvar(expressions)
    return np.array(ca.Function("f", symbols, [expressions]).call([values[s.name()] for s in symbols])[0]).ravel()


def at_random(q, parameters=None, seed=0, low=0.3, high=1.2, level=4):
    """Numbers by name for t, the jets up to a level and the parameters."""
    names = ["t", *(name for k in range(level + 1) for name in q.jet_names(k))]
    values = dict(zip(names, np.random.default_rng(seed).uniform(low, high, len(names)), strict=True))
    return values | ({} if parameters is None else parameters.defaults)


def motion(model, t=0.0, guess=None, **held):
    """A consistent state at t with its next derivatives: the jets Z, (n_z,); pivots chosen again where they vanish."""
    state = model.start(t, guess=guess, **held)
    if model.flat and model.reduction.top == 2:
        y = model.function("path")(t, state.values[: model.nq], model.parameters)
        first = model.nq if model.reduction.mechanism.q.plain else 3 * model.nq  # of γ' (see `Equations.path`)
        return np.concatenate([state.values, y[first + model.n :][: model.n]])
    n_x = len(state.values)
    rates = model.function("ode")(t, state.values, model.parameters)[:n_x]
    if not np.all(np.isfinite(rates)):
        near = model.near(t, np.append(state.values, np.zeros(model.n)))
        rates = near.function("ode")(t, state.values, model.parameters)[:n_x]
    return np.append(state.values, rates[-model.n :])


def signal(model, kind, t, jets):
    """A group of signals by name at one instant."""
    names, function = model.signals(kind)
    return dict(zip(names, function(t, jets, model.parameters), strict=True))


def pytest_collection_modifyitems(items):
    """Tests with "RadauIIA" among their parameters use the compiler: its steps are C code."""
    for item in items:
        if "RadauIIA" in item.name and hasattr(item, "fixturenames"):
            item.fixturenames.append("c_compiler")
