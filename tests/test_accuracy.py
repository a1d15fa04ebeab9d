"""simulate(..., accuracy=...): the error of the motion against an independent method, and what is refused."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from refusals import refused, warned

import servoctl as sv
from servoctl.errors import LimitExceeded, SpecificationError
from servoctl.gallery import gallery
from servoctl.methods import accuracy as rule
from servoctl.methods import choice
from servoctl.methods.choice import as_method
from servoctl.shell.main import main

ASKED = [
    ("appell-hamel", 1e-4), ("spiral", 1e-6), ("two-cars-ideal", 1e-9), ("passive-arm", 1e-9), ("wheeled-robot", 1e-9),
]  # fmt: skip
SOLVED = ("overhead-crane", "winch-crane-redundant", "three-cars", "vtol")


@pytest.fixture(scope="module")
def independent(gallery_model):
    """A function from a gallery name to a motion by scipy's DOP853 on the reduced rates, without servoctl's loops."""
    found = {}

    def motion(name):
        if name not in found:
            model, scene = gallery_model(name), gallery[name]
            start = model.start(t=scene.t_span[0], guess=scene.guess, **scene.start)
            run = sv.simulate(
                model, start, scene.t_span, sv.methods.Adaptive("DOP853", rtol=3e-14, atol=1e-15), t_eval=times(scene)
            )
            found[name] = (model, start, run)
        return found[name]

    return motion


def times(scene):
    return np.linspace(*scene.t_span, 41)


@pytest.mark.parametrize("name, accuracy", ASKED)
def test_the_motion_is_as_accurate_as_asked(name, accuracy, independent):
    model, start, exact = independent(name)
    run = sv.simulate(model, start, gallery[name].t_span, accuracy=accuracy, t_eval=times(gallery[name]))
    assert run.method == "Taylor" and "two tolerances agree" in run.message
    assert rule.motion_error(model, run.jets, exact.jets) <= accuracy
    coarse = sv.simulate(
        model, start, gallery[name].t_span, sv.methods.Adaptive("RK45", rtol=1e-2, atol=1e-2), t_eval=times(gallery[name])
    )
    assert rule.motion_error(model, coarse.jets, exact.jets) > 1e-9  # the measure tells a coarse motion


@pytest.mark.parametrize("name", SOLVED)
def test_what_is_not_integrated_is_exact_at_every_instant(name, independent):
    model, start, exact = independent(name)
    run = sv.simulate(model, start, gallery[name].t_span, accuracy=1e-9, t_eval=times(gallery[name]))
    assert run.method == "algebraic"
    assert rule.motion_error(model, run.jets, exact.jets) <= 1e-9


def test_the_error_is_relative_to_each_component_and_its_level(gallery_model):
    model = gallery_model("overhead-crane")  # x l theta, dx dl dtheta
    reference = np.array([[10.0, 5.0], [1e-6, 0.0], [1.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], *[[7.0, 7.0]] * 3])
    for row, size in ((0, 10.0), (1, 1e-2), (2, 1.0), (3, 1.0)):
        jets = reference.copy()
        jets[row, 1] += 1e-3 * size
        assert rule.motion_error(model, jets, reference) == pytest.approx(1e-3)
    jets = reference.copy()
    jets[6:] = 0.0  # accelerations are no part of the state
    assert rule.motion_error(model, jets, reference) == 0.0


def test_jets_and_samples_go_with_an_accuracy(gallery_model):
    model, scene = gallery_model("appell-hamel"), gallery["appell-hamel"]
    run = sv.simulate(
        model,
        model.start(guess=scene.guess, **scene.start),
        (0.0, 0.5),
        sv.methods.Taylor(jets=4),
        accuracy=1e-6,
        t_eval=[0.5],
    )
    assert run.t.tolist() == [0.5] and np.isfinite(run["d4theta"]).all()


@pytest.mark.parametrize(
    "given",
    [
        {"method": "RK4"},
        {"method": sv.methods.Taylor()},
        {"method": sv.methods.Taylor(8, jets=3)},
        {"method": sv.methods.Taylor(rtol=1e-6)},
        {"drift": "project"},
    ],
    ids=str,
)
def test_an_accuracy_leaves_nothing_else_to_choose(given, gallery_model):
    model, scene = gallery_model("appell-hamel"), gallery["appell-hamel"]
    start = model.start(guess=scene.guess, **scene.start)
    with refused(SpecificationError, "accuracy=1e-06", next(iter(given))) as caught:
        sv.simulate(model, start, (0.0, 1.0), accuracy=1e-6, **given)
    assert caught.value.details == given


@pytest.mark.parametrize("accuracy", [0.0, -1e-6, 1e-16, 1.0, np.nan, "fine", [1e-6]], ids=str)
def test_an_accuracy_is_a_small_number(accuracy, gallery_model):
    model, scene = gallery_model("appell-hamel"), gallery["appell-hamel"]
    start = model.start(guess=scene.guess, **scene.start)
    with refused(SpecificationError, "accuracy", "1e-13", "0.1"):
        sv.simulate(model, start, (0.0, 1.0), accuracy=accuracy)


def test_an_accuracy_may_be_a_number_of_numpy(gallery_model):
    model, scene = gallery_model("appell-hamel"), gallery["appell-hamel"]
    start = model.start(guess=scene.guess, **scene.start)
    assert "two tolerances agree" in sv.simulate(model, start, (0.0, 0.2), accuracy=np.float32(1e-6)).message


@pytest.mark.parametrize("given", [{"rtol": 1e-6}, {"atol": 1e-6}], ids=str)
@pytest.mark.parametrize("method", ["RK4", "RK8"])
def test_a_tolerance_is_refused_where_it_is_not_used(method, given):
    with refused(SpecificationError, next(iter(given)), method) as caught:
        as_method(method, **given)
    assert caught.value.details == given


def test_where_rounding_hides_the_motion_the_accuracy_is_refused(gallery_model):
    model, scene = gallery_model("appell-hamel"), gallery["appell-hamel"]
    start = model.start(guess=scene.guess, **scene.start)
    random, asked = np.random.default_rng(3), []

    def spoilt(method, drift, *_):
        asked.append(method.rtol)
        run = sv.simulate(model, start, (0.0, 0.5), method, drift=drift, t_eval=[0.0, 0.5])
        return replace(run, jets=run.jets * (1.0 + 1e-6 * random.standard_normal(run.jets.shape)))

    with refused(LimitExceeded, accuracy=1e-9) as error:
        rule.accurate(spoilt, model, 1e-9)
    assert asked == sorted(asked, reverse=True) and asked[-1] == rule.FINEST and len(set(asked)) == len(asked)
    assert 1e-8 < error.value.details["reached"] < 1e-5 and error.value.run is not None


def test_the_command_passes_the_accuracy_on(tmp_path, monkeypatch):
    given = {}

    def simulate(model, start, span, **options):
        given.update(options)
        raise LimitExceeded("enough")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sv, "simulate", simulate)
    assert main(["run", "appell-hamel", "--accuracy", "1e-6"]) == 2
    assert given == {"accuracy": 1e-6}


@pytest.mark.parametrize("accuracy", [1e-2, 1e-6, 1e-10])
def test_a_motion_is_never_compared_with_itself(accuracy):
    """y'' = k (x - y) with x on a sine: y = 0.9 sin t is exact, errors grow as exp(3t)."""
    q, k = sv.coordinates("x y"), 9.0
    x, y = q
    ddx, ddy = q.d(2)
    mechanism = sv.Mechanism(q, gibbs=(ddx**2 + ddy**2) / 2, potential=-k * (x - y) ** 2 / 2, actuators={"F": x})
    model = sv.derive(mechanism, sv.Program({"x": x - ca.sin(q.t)}))
    start = model.start(y=0.0, dy=k / (k + 1))
    with refused(LimitExceeded, accuracy=accuracy) as caught:
        sv.simulate(model, start, (0.0, 15.0), accuracy=accuracy)
    assert caught.value.details["growth"] > 1e10
    with warned("unstable over these 2 s"):
        run = sv.simulate(model, start, (0.0, 2.0), accuracy=accuracy)
    assert run.success and np.abs(run["y"] - 0.9 * np.sin(run.t)).max() < accuracy


def damped(damping, stiffness):
    """A mass on a spring and a damper on a driven cart: y'' + d y' + k y = -x'', x = sin 2t, linear with constants."""
    q = sv.coordinates("x y")
    (x, y), (ddx, ddy), dy = q, q.d(2), q.d(1)[1]
    mechanism = sv.Mechanism(
        q, gibbs=(ddx**2 + (ddx + ddy) ** 2) / 2, potential=stiffness * y**2 / 2, forces={"y": -damping * dy},
        actuators={"F": x},
    )  # fmt: skip
    return sv.derive(mechanism, sv.Program({"x": x - ca.sin(2 * q.t)}))


def elongation(t, damping, stiffness, y0):
    """The closed form of y from y(0) = y0 at rest."""
    roots = np.roots([1.0, damping, stiffness]).astype(complex)
    forced = 4.0 / ((2j) ** 2 + damping * 2j + stiffness)  # of 4 exp(2it), whose imaginary part is the force
    first = np.array([y0 - forced.imag, -(2j * forced).imag])
    free = np.linalg.solve(np.vstack([np.ones(2), roots]), first)
    return (np.exp(np.outer(t, roots)) @ free).real + (forced * np.exp(2j * t)).imag


@pytest.mark.parametrize(
    "damping, stiffness, end, method",
    [
        (1e3, 1.0, 10.0, "RadauIIA"),
        (3e3, 1e6, 10.0, "RadauIIA"),
        (0.1, 1.0, 10.0, "Taylor"),
        (10.0, 1.0, 100.0, "Taylor"),
    ],
)
def test_stiff_motions_are_integrated_implicitly(damping, stiffness, end, method):
    model = damped(damping, stiffness)
    run = sv.simulate(model, model.start(y=0.1, dy=0.0), (0.0, end), accuracy=1e-8)
    plain = sv.simulate(model, model.start(y=0.1, dy=0.0), (0.0, end))
    assert run.method == plain.method == method
    expected = elongation(run.t, damping, stiffness, 0.1)
    assert np.abs(run["y"] - expected).max() <= 1e-8 * np.abs(expected).max()
    assert np.abs(plain["y"] - expected).max() <= 1e-6 * np.abs(expected).max()
    if method == "RadauIIA":
        assert "stability, not accuracy, limits the steps of Taylor" in plain.message
        explicit = sv.simulate(model, run.state(0.0), (0.0, end), sv.methods.Taylor(rtol=1e-9, atol=1e-9), drift="project")
        assert explicit.counters["steps"] > 10 * run.counters["steps"]


@pytest.mark.parametrize("largest", [0, 300])
def test_stiff_defaults_need_neither_series_nor_a_compiler(backend, largest, monkeypatch):
    """Without a compiler the default once ended with "method='RadauIIA' was given"; large equations stayed explicit."""
    monkeypatch.setattr(choice, "LARGE_FOR_SERIES", largest)
    model = damped(1e3, 1.0)
    run = sv.simulate(model, model.start(y=0.1, dy=0.0), (0.0, 10.0))
    assert run.method == {"c": "RadauIIA", "casadi": "Radau"}[backend]
    assert f"limits the steps of {'Taylor' if largest else 'DOP853'}" in run.message
    expected = elongation(run.t, 1e3, 1.0, 0.1)
    assert np.abs(run["y"] - expected).max() <= 1e-6 * np.abs(expected).max()
