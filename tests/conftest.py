"""Models that are derived once for all tests, numbers from expressions, and the first tier.

`pytest` runs the first tier, `pytest --all` every test; a file or a test that is named is run whole. The first tier has
the first case of each function that `tests/left.txt` does not list; a line there is a function, or a file that is not
even imported. The third tier has the other cases of the functions in `tests/by_hand.txt`, the second has the rest.
`tests/tiers.py` measures and writes both lists, so that a new test is in the first tier until it is found to be slow.
"""

import os
import sys
import warnings
from contextvars import ContextVar
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when casadi is imported; matrices are small, and threads would wait

import casadi as ca
import numpy as np
import pytest

if os.environ.get("SERVOCTL_TESTS_LONGDOUBLE") == "double":  # of this size on Windows and on ARM under macOS
    np.longdouble = np.float64

from scenes import CRANE, CRANE_PROGRAM, POINT, POINT_PROGRAM

import servoctl as sv
from servoctl.codegen import compiler, function
from servoctl.gallery import gallery
from servoctl.model.full import on_manifold
from servoctl.model.model import derive
from servoctl.model.points import place_of, with_place
from servoctl.model.variants import derived_near

os.environ["SERVOCTL_MEMO"] = "none"  # tests derive themselves what they test
compiler.choice = ContextVar("compiled", default=True)  # and compare bits, so that loops are compiled at their first use
FULLY_OPTIMISED, function.FULLY_OPTIMISED = function.FULLY_OPTIMISED, 0  # they compile much and run shortly: -O1
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


@pytest.fixture
def as_shipped(monkeypatch):
    """Optimised as users have it: rounding shows in printed digits."""
    monkeypatch.setattr(function, "FULLY_OPTIMISED", FULLY_OPTIMISED)


@pytest.fixture
def uncompiled(monkeypatch):
    """No compiler, where each model is evaluated too few times to be worth compiling."""
    monkeypatch.setenv("SERVOCTL_COMPILER", "none")
    monkeypatch.setattr(compiler, "_warned", True)


@pytest.fixture(params=("c", "casadi"))
def backend(request, monkeypatch):
    """Compiled code in every grid and loop, and CasADi where there is no compiler."""
    monkeypatch.setattr(function, "MANY_POINTS", 0)
    request.getfixturevalue("c_compiler" if request.param == "c" else "uncompiled")
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


lean = pytest.mark.skipif(not hasattr(ca.GlobalOptions, "getNumpyMode"), reason="CasADi before 3.8 merges fewer operations")


def needs(module):
    """A module of an extra, or a skip that says which one."""
    return pytest.importorskip(module, reason=f"needs {module}, which is in the extra 'test-all'")


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


def along(q, expression, t):
    """An expression with the numbers of its references, and their derivatives up to the second, at an instant [s]."""
    jets = [(q.family.jet(name, k), path.jets(t, 2)[k, 0]) for name, path in q.family.paths.items() for k in range(3)]
    symbols, values = zip(*jets, strict=True) if jets else ((), ())
    return ca.substitute(expression, ca.vertcat(*symbols), ca.DM(values)) if jets else expression


def at_random(q, parameters=None, seed=0, low=0.3, high=1.2, level=4):
    """Numbers by name for t, the jets up to a level and the parameters."""
    names = ["t", *(name for k in range(level + 1) for name in q.jet_names(k))]
    values = dict(zip(names, np.random.default_rng(seed).uniform(low, high, len(names)), strict=True))
    return values | ({} if parameters is None else parameters.defaults)


def motion(model, t=0.0, guess=None, **held):
    """A consistent state at t with its next derivatives: the jets Z, (n_z,); pivots chosen again where they vanish."""
    state = model.start(t, guess=guess, **held)
    if model.flat and model.reduction.top == 2:
        y = model.function("path")(t, state.values[: model.nq], model.p)
        first = model.nq if model.reduction.mechanism.q.plain else 3 * model.nq  # of γ' (see `Equations.path`)
        return np.concatenate([state.values, y[first + model.n :][: model.n]])
    n_x = len(state.values)
    rates = model.function("ode")(t, state.values, model.p)[:n_x]
    if not np.all(np.isfinite(rates)):
        near = derived_near(model, t, np.append(state.values, np.zeros(model.n)))
        rates = near.function("ode")(t, state.values, model.p)[:n_x]
    return np.append(state.values, rates[-model.n :])


def signal(model, kind, t, jets):
    """A group of signals by name at one instant."""
    names, function = model.signals(kind)
    return dict(zip(names, function(t, jets, model.p), strict=True))


def derived_alike(model, values):
    """Whether a derivation with parameters (n_p,) has the same orders, and the model the rates that it gives."""
    r = model.reduction
    own = model._of(r.mechanism, r.program, r.context.guess, None, values)
    if sorted(row.order for row in own.reduction.rows) != sorted(row.order for row in r.rows):
        return False
    points, functions = own.reduction.points, [m.function("ode") for m in (model, own)]
    t, p = points.t.astype(float), with_place(place_of(own, functions), values)
    x = on_manifold(own, t, np.vstack([points.jet(k) for k in range(r.top)]).astype(float), p)
    here, there = (f.grid(t, x, p)[: len(x)] for f in functions)
    return bool(np.all(np.abs(here - there) <= 1e-6 * (1.0 + np.abs(there))))


# tiers ---------------------------------------------------------------------------------------------------------------

TESTS = Path(__file__).parent
LEFT = set(TESTS.joinpath("left.txt").read_text(encoding="utf-8").split())
BY_HAND = {line.split()[1] for line in TESTS.joinpath("by_hand.txt").read_text(encoding="utf-8").splitlines()}
TIER, FURTHER = pytest.StashKey(), pytest.StashKey()  # the tier that is run; cases that the first one leaves


def pytest_addoption(parser):
    """The tiers; without one of these the first is run."""
    group = parser.getgroup("tiers", "Tiers, where no file or test is named (CONTRIBUTING.md)")
    group.addoption("--all", dest="tier", action="store_const", const="all", default="first", help="every test")
    group.addoption("--second", dest="tier", action="store_const", const="second", help="what a change must pass, too")
    group.addoption("--third", dest="tier", action="store_const", const="third", help="what is run by hand")


def pytest_configure(config):
    """What is named is run whole."""
    tier, folder = config.option.tier, config.invocation_params.dir
    every = all(TESTS.is_relative_to(os.path.abspath(folder / argument)) for argument in config.args)
    if not every and tier in ("second", "third"):
        raise pytest.UsageError(f"--{tier} takes its tests from lists; a file or test that is named is run whole without it.")
    config.stash[TIER] = tier if every else "all"


def pytest_ignore_collect(collection_path, config):
    """Files that the first tier leaves are not imported."""
    if config.stash[TIER] == "first" and collection_path.relative_to(TESTS).as_posix() in LEFT:
        return True


def tier_of(name, is_first):
    """The tier of a case of a test function, which may be its first one."""
    if is_first and not LEFT & {name, name.partition("::")[0]}:
        return "first"
    return "third" if name in BY_HAND else "second"


def pytest_collection_modifyitems(config, items):
    """Take a tier; tests with "RadauIIA" among their parameters use the compiler, as its steps are C code."""
    tier, names, taken, left = config.stash[TIER], set(), [], []
    for item in items:
        name = item.nodeid.partition("[")[0].removeprefix("tests/")
        (taken if tier in ("all", tier_of(name, name not in names)) else left).append(item)
        names.add(name)
        if "RadauIIA" in item.name and hasattr(item, "fixturenames"):
            item.fixturenames.append("c_compiler")
    config.stash[FURTHER] = len(left)
    config.hook.pytest_deselected(items=left)
    items[:] = taken


def pytest_sessionfinish(session):
    """A worker of xdist tells what it left."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["further"] = session.config.stash.get(FURTHER, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    """What a worker of xdist told; they all collect the same."""
    node.config.stash[FURTHER] = getattr(node, "workeroutput", {}).get("further", 0)


def pytest_terminal_summary(terminalreporter, config):
    """Say what the first tier left."""
    if config.stash[TIER] == "first":
        files = sum("::" not in name for name in LEFT)
        left = f"{config.stash.get(FURTHER, 0)} cases that are slow or further ones of their functions, and {files} files"
        terminalreporter.write_line(f"This is the first tier of the tests; left to pytest --all: {left}.")
