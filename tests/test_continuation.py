"""Flat programs by continuation: the branch of the solution, samples as output only, singularities on the way."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from test_compiled_functions import T, function

import servoctl as sv
from servoctl.codegen import loops
from servoctl.codegen.function import compiled
from servoctl.gallery import gallery
from servoctl.jets.branches import Branches

TIP = {  # paths of the tip of an arm with two links of length 1
    "spiral": lambda t: (1.5 * ca.cos(np.pi * t), 1.5 * (1 + 0.1 * t) * ca.sin(np.pi * t)),
    "circle": lambda t: (1.2 * ca.cos(2 * np.pi * t), 1.2 * ca.sin(2 * np.pi * t)),
    "beside": lambda t: (0.3 + 1.2 * ca.cos(2 * np.pi * t), 0.2 + 1.2 * ca.sin(2 * np.pi * t)),
    "near": lambda t: (0.02, 1.5 * ca.cos(2 * t)),
    "nearer": lambda t: (1e-3, 1.5 * ca.cos(2 * t)),
    "through": lambda t: (ca.SX(0), 1.5 * ca.cos(2 * t)),
    "cusp": lambda t: (1.0 + 0.1 * ((t - 1) ** 2) ** 0.75, 0.4 + 0 * t),  # with an infinite acceleration at t = 1 s
    "away": lambda t: (1.0 + 0.6 * t, 0.4 + 0 * t),
    "breaks": sv.paths.spline([0.0, 0.7, 1.1, 3.0], [[1.2, 0.1], [0.3, 0.9], [-0.5, 1.3], [-1.0, -0.8]], smoothness=4),
}


@cache
def arm(path):
    """Model of an arm with two masses of 1 kg, at the middle of the first link and, heavy, at the tip; its tip's places (2, N) at times (N,)."""
    q = sv.coordinates("a b")
    a, b = q
    middle = ca.vertcat(ca.cos(a), ca.sin(a)) / 2
    tip = 2 * middle + ca.vertcat(ca.cos(a + b), ca.sin(a + b))
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 1.0, middle) + sv.particle(q, 1.0, tip), potential=9.81 * tip[1],
        actuators={"u": a, "v": b},
    )  # fmt: skip
    places = TIP[path]
    if isinstance(places, sv.paths.Path):
        x, y = q.references(X=places[0], Y=places[1])
    else:
        x, y = map(ca.SX, places(q.t))
        f = ca.Function("path", [q.t], [ca.vertcat(x, y)])
        places = lambda t: np.array(f.map(len(t))(t[None]))  # noqa: E731
    return sv.derive(mechanism, sv.Program({"X": tip[0] - x, "Y": tip[1] - y})), places


def angles(path, t, elbow):
    """The angles in closed form, with all turns, (2, N)."""
    dense = np.linspace(t[0], t[-1], 400 * len(t) + 20001)
    x, y = arm(path)[1](dense)
    b = elbow * 2 * np.arccos(np.hypot(x, y) / 2)
    a = np.unwrap(np.arctan2(y, x)) - b / 2
    if t[-1] < t[0]:
        dense, a, b = dense[::-1], a[::-1], b[::-1]
    return np.array([np.interp(t, dense, a), np.interp(t, dense, b)])


def begin(path, elbow, t=0.0):
    x, y = arm(path)[1](np.array([t]))[:, 0]
    b = elbow * 2 * np.arccos(np.hypot(x, y) / 2)
    return arm(path)[0].start(t=t, guess={"a": np.arctan2(y, x) - b / 2, "b": b})


def moved(path, t_eval=None, elbow=1, span=(0.0, 3.0)):
    return sv.simulate(arm(path)[0], begin(path, elbow, span[0]), span, t_eval=t_eval)


SAMPLES = [[3.0], [1.7, 1.701, 3.0], np.linspace(0, 3, 1001), np.append(np.arange(0, 3, 0.45), 3.0)]
BRANCHES = [("circle", 1), ("nearer", -1), ("breaks", 1)]


@pytest.mark.parametrize(("path", "elbow"), BRANCHES)
def test_samples_do_not_decide_the_branch(path, elbow):
    fine = np.linspace(0.0, 3.0, 13)
    end = angles(path, fine, elbow)[:, -1]
    for t_eval in SAMPLES:
        run = moved(path, t_eval, elbow)
        assert [run["a"][-1], run["b"][-1]] == pytest.approx(end, abs=1e-9)
        assert np.abs(run.residual["X"][0]).max() < 1e-13 and np.abs(run.residual["Y"][0]).max() < 1e-13


def test_the_arm_near_its_base_ends_on_its_own_elbow():
    for count in (2, 51, 1001):
        run = moved("near", np.linspace(0, 3, count))
        assert [run["a"][-1], run["b"][-1]] == pytest.approx([0.790, 1.533], abs=1e-3)
        assert run.counters["steps"] == moved("near", [3.0]).counters["steps"]


@pytest.mark.parametrize("path", ["nearer"])
def test_samples_are_output_only(path):
    """The same motion at other instants: the forces, too."""
    whole = moved(path, np.linspace(0, 3, 601))
    for part in (slice(None, None, 37), slice(5, 400, 3), slice(300, 301)):
        some = moved(path, whole.t[part])
        for name in ("a", "b", "da", "u", "v"):
            assert some[name] == pytest.approx(whole[name][part], rel=1e-12, abs=1e-12 * np.abs(whole[name]).max())


def test_irregular_samples_are_those_of_the_closed_form():
    t = np.sort(np.random.default_rng(3).uniform(0.0, 3.0, 700))
    for path in ("spiral", "near"):
        run = moved(path, t)
        x, y = arm(path)[1](t)
        assert run["b"] == pytest.approx(2 * np.arccos(np.hypot(x, y) / 2), abs=1e-12)


@pytest.mark.parametrize("path", ["spiral", "near"])
def test_backwards(path):
    forward = moved(path)
    model, state = forward.model, forward.state(3.0)
    back = sv.simulate(model, sv.simulate(model, forward.start, (0.0, 3.0)).jets[:4, -1], (3.0, 0.0), t_eval=[2.0, 0.0])
    assert [back["a"][-1], back["b"][-1]] == pytest.approx([forward["a"][0], forward["b"][0]], abs=1e-10)
    assert state == pytest.approx(forward.jets[:4, -1], abs=1e-12)


def torque(path, t, elbow, h=1e-3):
    """The moment of the forces on both masses about the base; their accelerations by differences."""
    x, y = arm(path)[1](t + h * np.arange(-2.0, 3.0))
    first = np.arctan2(y, x) - elbow * np.arccos(np.hypot(x, y) / 2)
    second = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / (12 * h**2)
    masses = (x, y, 9.81), (np.cos(first) / 2, np.sin(first) / 2, 0.0)
    return sum(x[2] * (y @ second + g) - y[2] * (x @ second) for x, y, g in masses)


@pytest.mark.parametrize("elbow", [1, -1])
def test_no_sample_falls_on_the_zero_of_a_pivot(elbow):
    """The tip crosses the axes at samples, where pivots of one choice vanish."""
    run = moved("spiral", elbow=elbow, span=(0.0, 2.0))
    for name in ("u", "v"):
        assert np.abs(np.diff(run[name], 3)).max() < 1e-3  # garbage at one sample would be 1 or more
    for t in (0.5, 1.0, 1.5):
        assert run["u"][run.t == t] == pytest.approx([torque("spiral", t, elbow)], abs=1e-6)
    if elbow > 0:
        assert -12.56 < run["u"][run.t == 1.0] < -12.55
    assert sv.verify(run).passed


def test_a_law_made_of_such_a_plan_holds_the_tip():
    run = moved("spiral", span=(0.0, 2.0))
    plant = sv.plant(run.model.reduction.mechanism)
    for rate, most in ((1000, 1e-6), (100, 1e-4)):
        closed = sv.close(plant, sv.lqr(run, plant, rate=rate), run.state(0.0), (0.0, 2.0), plan=run)
        assert max(np.abs(values[0]).max() for values in closed.residual.values()) < most


def test_the_start_repeats_the_branch():
    runs = [moved("near", elbow=elbow) for elbow in (1, -1)]
    assert runs[0]["b"][0] > 0 > runs[1]["b"][0]
    for run in runs:
        assert sv.simulate(run.model, run.start, (0.0, 3.0)) == run
        assert f"b = {run['b'][0]:.4g}" in run.details
    late = moved("near", [2.9])  # without a sample at the start
    assert sv.simulate(late.model, late.start, (0.0, 3.0), t_eval=[2.9]) == late


def test_true_singularities_end_the_plan():
    with refused(sv.errors.SingularProgram) as caught:
        moved("through", [0.1, 2.9])
    assert caught.value.details["t"] == pytest.approx(np.pi / 4, abs=1e-6)
    with refused(sv.errors.SingularProgram) as caught:  # beyond the reach
        moved("away", [0.1, 2.9])
    assert caught.value.details["t"] == pytest.approx((np.sqrt(4 - 0.16) - 1) / 0.6, abs=1e-6)
    assert caught.value.details["zero"] == ["b"] and list(caught.value.run.t) == [0.1]


@pytest.mark.parametrize("count", [3, 201, 1001])
def test_a_sample_without_finite_accelerations_ends_the_plan(count, backend):
    arm.cache_clear()  # a model keeps its compiled functions
    with refused(sv.errors.IntegrationStopped, "t = 1 s", "power") as caught:
        sv.simulate(arm("cusp")[0], begin("cusp", 1), (0.0, 2.0), t_eval=np.linspace(0.0, 2.0, count))
    run = caught.value.run
    assert run.t[-1] < 1.0 and len(run.t) == count // 2 and np.isfinite(run.jets).all()


def test_a_plan_of_many_with_such_a_sample_is_not_finished(c_compiler):
    model, start = arm("cusp")[0], begin("cusp", 1)
    many = sv.simulate_many(model, start, None, (0.0, 2.0), t_eval=np.linspace(0.0, 2.0, 201))
    assert many["error"] == ["IntegrationStopped"] and "t = 1 s" in many["message"][0]


def test_a_step_does_not_jump_over_the_zero_of_a_pivot():
    """(x² - p²)/2 with p = cos t: both branches x = ± p are smooth, and meet where the pivot x vanishes."""
    x, p = ca.SX.sym("x"), ca.cos(T)
    rate = -p * ca.sin(T) / x
    second = ca.jacobian(rate, T) + ca.jacobian(rate, x) * rate
    f = compiled(function((p**2 - x**2) / (2 * x), rate, second, x, x=x), "meeting", ("newton",), sizes={"pivots": 1})
    nodes, _ = f.continuation([0.0, 4.0], [1.0], [0.0], 0.08, 1000)
    assert 1.5 < nodes[-1, 0] < np.pi / 2 and nodes[-1, 1] > 0
    assert nodes[:, 1] == pytest.approx(np.cos(nodes[:, 0]), abs=1e-9)


def test_followed_decides_how_many_steps_a_circle_takes():
    """x = sin wt: the prediction errs by (wh)³/6 of a way wh."""
    x, w = ca.SX.sym("x"), 2 * np.pi
    f = compiled(function(ca.sin(w * T) - x, w * ca.cos(w * T), -(w**2) * ca.sin(w * T), x=x), "sine", ("newton",))
    nodes, _ = f.continuation([0.0, 10.0], [0.0], [0.0], 1.0, 1000)
    expected = 10 * w / np.sqrt(6 * loops.FOLLOWED)
    assert expected / 2 < len(nodes) < 3 * expected


def test_a_short_path_in_a_long_span_is_followed(gallery_model):
    """The load moves for 6 s of a thousand million."""
    model, scene = gallery_model("overhead-crane"), gallery["overhead-crane"]
    times = np.linspace(0.0, 7.0, 29)
    expected = sv.simulate(model, model.start(guess=scene.guess), (0.0, 7.0), t_eval=times)
    run = sv.simulate(model, model.start(guess=scene.guess), (0.0, 1e9), t_eval=[*times, 1e9])
    assert run.jets[:, :-1] == pytest.approx(expected.jets, abs=1e-10) and run["x"][-1] == pytest.approx(5.0, abs=1e-12)


def test_a_second_plan_does_not_look_for_switches_again(monkeypatch):
    model = sv.derive(*gallery["overhead-crane"].build())
    looked, smooth = [], Branches.smooth
    monkeypatch.setattr(Branches, "smooth", lambda *given, **rest: looked.append(1) or smooth(*given, **rest))
    monkeypatch.setattr(model._store, "recall", lambda name, build: build())
    for changed in (model, model, model.with_parameters(m_load=120.0)):
        sv.simulate(changed, changed.start(guess={"l": 4.0}), (0.0, 1.0), t_eval=[0.0, 1.0], progress=False)
    assert len(looked) == 1


def test_the_forces_of_many_instants_are_compiled_with_the_same_bits(c_compiler):
    model = sv.derive(*gallery["overhead-crane"].build())
    start, t = model.start(guess={"l": 4.0}), np.linspace(0.0, 8.0, 3001)
    few = sv.simulate(model, start, (0.0, 8.0), t_eval=t[::10], progress=False)["trolley"]
    assert model.signals("actuation")[1].backend == "casadi"
    first, again = (sv.simulate(model, start, (0.0, 8.0), t_eval=t, progress=False)["trolley"] for _ in range(2))
    assert model.signals("actuation")[1].backend == "c"
    np.testing.assert_array_equal(again, first)
    np.testing.assert_allclose(first[::10], few, rtol=0, atol=1e-12 * np.abs(few).max())
