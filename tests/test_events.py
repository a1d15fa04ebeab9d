"""Events: instants at which signals cross values, against closed forms, by every method."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError

METHODS = ("Taylor", "RadauIIA", "RK4", "RK8", "DOP853", "RK45", "Radau", "LSODA")
g, UP = 9.81, 10.0


@pytest.fixture(scope="module")
def ball():
    """A mass thrown upwards, as a plant without inputs."""
    q = sv.coordinates("x y")
    x, y = q
    return sv.plant(sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=g * y, outputs={"height": y**2}))


THROWN = {"x": 0.0, "y": 0.0, "dx": 1.0, "dy": UP}
LANDS = sv.Event("y", terminal=True, direction=-1)


@pytest.mark.parametrize("method", METHODS)
def test_a_ball_lands(ball, method):
    events = {"lands": LANDS, "top": sv.Event("dy"), "at 1 m": sv.Event("x", 1.0), "rises": sv.Event("dy", 0.0, 0, 1)}
    run = sv.simulate(ball, THROWN, (0.0, 5.0), method, events=events)
    end = 2 * UP / g
    assert (run.status, run.success) == (1, True) and "lands" in run.message
    assert run.t[-1] == pytest.approx(end, abs=1e-10) == run.t_events["lands"][0]
    assert abs(run["y"][-1]) < 1e-13
    assert run.t_events["top"] == pytest.approx([end / 2], abs=1e-10)
    assert run.t_events["at 1 m"] == pytest.approx([1.0], abs=1e-10)
    assert not len(run.t_events["rises"])
    assert run.events["top"]["y"] == pytest.approx([UP**2 / (2 * g)], abs=1e-7)
    assert "lands" in repr(run)


@pytest.mark.parametrize("method", METHODS)
def test_two_roots_in_one_step_are_found(ball, method):
    """The ball is above a line just below its highest point for 2 sqrt(2 d / g)."""
    below = 1e-3
    run = sv.simulate(ball, THROWN, (0.0, 2.0), method, events=sv.Event("y", UP**2 / (2 * g) - below), t_eval=[0.0, 2.0])
    (t,) = run.t_events.values()
    assert t == pytest.approx(UP / g + np.sqrt(2 * below / g) * np.array([-1.0, 1.0]), abs=1e-6)


@pytest.mark.parametrize("t_eval", [None, [0.0, 1.0, 2.0, 3.0]])
@pytest.mark.parametrize("method", ["Taylor", "RK8", "DOP853", "RadauIIA"])
def test_the_event_is_the_last_sample(ball, method, t_eval):
    run = sv.simulate(ball, THROWN, (0.0, 5.0), method, events=LANDS, t_eval=t_eval)
    assert run.t[-1] == run.t_events["y = 0"][0]
    assert t_eval is None or run.t[:-1] == pytest.approx([0.0, 1.0, 2.0])
    assert np.isfinite(run.jets).all()


def test_functions_with_the_attributes_of_scipy(ball):
    def high(t, x):
        return x[1] - 2.0

    high.terminal = 2
    run = sv.simulate(ball, THROWN, (0.0, 5.0), events=high)
    assert run.t_events["high = 0"] == pytest.approx((UP + np.array([-1, 1]) * np.sqrt(UP**2 - 4 * g)) / g)
    assert run.t[-1] == run.t_events["high = 0"][1]


def test_a_motion_that_starts_on_an_event_goes_on(ball):
    first = sv.simulate(ball, THROWN, (0.0, 5.0), events=sv.Event("y", 2.0, terminal=True))
    again = sv.simulate(ball, first.jets[:4, -1], (first.t[-1], 5.0), events=sv.Event("y", 2.0, terminal=True))
    assert again.t[-1] == pytest.approx((UP + np.sqrt(UP**2 - 4 * g)) / g, abs=1e-10)


def test_backwards_directions_are_those_of_the_motion(ball):
    """Backwards in time the ball of y = -5 t rises from y = 0."""
    start = {"x": 0.0, "y": 0.0, "dx": 1.0, "dy": -5.0}
    events = {"rises": sv.Event("y", 0.5, direction=1, terminal=True), "falls": sv.Event("y", 0.5, direction=-1)}
    run = sv.simulate(ball, start, (0.0, -2.0), events=events)
    s = (5.0 - np.sqrt(25.0 - g)) / g  # y = 5 s - g s²/2 with s = -t
    assert run.t[-1] == pytest.approx(-s, abs=1e-10)
    assert not len(run.t_events["falls"])


def test_a_pendulum_turns_over():
    """|θ| = π from energy above the separatrix; its instant by an elliptic integral."""
    from scipy.special import ellipk

    q = sv.coordinates("a")
    (a,) = q
    S = sv.particle(q, 1.0, (ca.sin(a), ca.cos(a)))
    plant = sv.plant(sv.Mechanism(q, gibbs=S, potential=-g * ca.cos(a)))
    speed = 1.2 * 2 * np.sqrt(g)
    half = 2 / speed * ellipk(4 * g / speed**2)  # from the lowest point to the highest one
    for sign in (1.0, -1.0):
        events = lambda t, x: abs(x[0]) - np.pi  # noqa: E731
        events.terminal = True
        run = sv.simulate(plant, {"a": 0.0, "da": sign * speed}, (0.0, 5.0), sv.methods.Taylor(), events=events)
        assert run.t[-1] == pytest.approx(half, abs=1e-10)
    both = [sv.Event("a", np.pi), sv.Event("a", 3 * np.pi), sv.Event("a", 9.0)]
    run = sv.simulate(plant, {"a": 0.0, "da": speed}, (0.0, 4 * half), sv.methods.Taylor(), events=both)
    assert np.concatenate(list(run.t_events.values()))[:2] == pytest.approx([half, 3 * half], abs=1e-10)


@pytest.fixture(scope="module")
def slack():
    """A crane whose load is lowered ever faster, Z = 4 + t⁴/2: its rope goes slack where Z'' = g."""
    q = sv.coordinates("x l theta")
    x, l, theta = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    S = sv.particle(q, 10.0, x) + sv.particle(q, 5.0, l) + sv.particle(q, 100.0, load)
    tension = 100.0 * (g - q.dt(load, 2)[1]) / ca.cos(theta)
    actuators = {"trolley": x, "hoist": l}
    crane = sv.Mechanism(q, S, potential=-100 * g * load[1], actuators=actuators, outputs={"tension": tension})
    model = sv.derive(crane, sv.Program({"X": load[0], "Z": load[1] - 4 - q.t**4 / 2}))
    return model, model.start(guess={"l": 4.0})


@pytest.mark.parametrize("method", [None, "Taylor", "DOP853", "RadauIIA", "RK8"])
@pytest.mark.parametrize("t_eval", [None, [0.0, 2.0]])
def test_a_rope_goes_slack(slack, method, t_eval):
    """The program is singular there, so that the event ends the motion before it fails."""
    model, start = slack
    events = {"slack": sv.Event("tension", terminal=True, direction=-1), "half": sv.Event("tension", 50 * g)}
    run = sv.simulate(model, start, (0.0, 2.0), method, events=events, t_eval=t_eval)
    assert run.t[-1] == pytest.approx(np.sqrt(g / 6), abs=1e-9)
    assert run.t_events["half"] == pytest.approx([np.sqrt(g / 12)], abs=1e-9)
    assert run.success and abs(run["tension"][-1]) < 1e-6


def test_events_of_rates_actuations_residuals_and_time(slack):
    model, start = slack
    events = [sv.Event("d2l", 3.0), sv.Event("hoist", -500.0), lambda t, x: t - 0.7]
    run = sv.simulate(model, start, (0.0, 1.2), events=events)
    assert run.t_events["d2l = 3"] == pytest.approx([np.sqrt(0.5)], abs=1e-12)
    t = run.t_events["hoist = -500"]
    assert 5 * 6 * t**2 - 100 * (g - 6 * t**2) == pytest.approx(-500.0, abs=1e-9)  # the hoist itself is not lifted
    assert run.t_events["<lambda> = 0"] == pytest.approx([0.7], abs=1e-14)


def test_events_of_a_bounded_motion():
    from test_bounded import arm

    model = arm(0.5)
    whole = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), events=sv.Event("q2", -0.2))
    (times,) = whole.t_events.values()
    assert len(times) == 2
    assert [whole.state(t)[1] for t in times] == pytest.approx([-0.2, -0.2], abs=1e-10)
    ended = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), events=sv.Event("q2", -0.2, terminal=2))
    assert ended.t[-1] == pytest.approx(times[1], abs=1e-12)


def test_a_switch_and_an_event_in_one_motion():
    """A mass slides against friction -3 sign(x') with 10 m/s and crosses 5 m; then rests at 50/3 m."""
    q = sv.coordinates("x")
    (x,) = q
    friction = {"x": -3.0 * ca.sign(q.d(1)[0])}
    plant = sv.plant(sv.Mechanism(q, gibbs=sv.particle(q, 1.0, x), forces=friction))
    for method in ("Taylor", "DOP853", "RK8"):
        run = sv.simulate(plant, [0.0, 10.0], (0.0, 3.0), method, events={"far": sv.Event("x", 5.0)})
        assert run.t_events["far"] == pytest.approx([(10 - np.sqrt(70.0)) / 3], abs=1e-9)


def test_an_accuracy_and_events(ball):
    run = sv.simulate(ball, THROWN, (0.0, 5.0), accuracy=1e-8, events=LANDS)
    assert run.t[-1] == pytest.approx(2 * UP / g, abs=1e-12) and "y = 0" in run.message


def test_events_travel_in_files(ball, tmp_path):
    run = sv.simulate(ball, THROWN, (0.0, 5.0), events=LANDS)
    loaded = sv.load(run.save(tmp_path / "run"))
    assert loaded.t_events["y = 0"] == run.t_events["y = 0"]
    assert loaded.events["y = 0"]["dy"] == run.events["y = 0"]["dy"] and loaded.status == 1
    assert sv.load(tmp_path / "run", run.model).events["y = 0"]["height"] == run.events["y = 0"]["height"]


@pytest.mark.parametrize(
    "events, kind, details",
    [
        ("yy", NameUnknown, {"name": "yy"}),
        (sv.Event("d5y"), NameUnknown, {"name": "d5y"}),
        (sv.Event("d3height"), SpecificationError, {"signal": "d3height"}),
        ([sv.Event("y"), sv.Event("y")], SpecificationError, {"names": ["y = 0", "y = 0"]}),
        (3.0, SpecificationError, {"signal": 3.0}),
        (lambda t, x: None, SpecificationError, {}),
    ],
)
def test_events_that_are_none(ball, events, kind, details):
    with refused(kind, **details):
        sv.simulate(ball, THROWN, (0.0, 5.0), events=events)


@pytest.mark.parametrize("numbers", [{"value": np.nan}, {"direction": "up"}, {"terminal": -1}, {"terminal": 0.5}])
def test_numbers_of_events(numbers):
    with pytest.raises(SpecificationError):
        sv.Event("y", **numbers)
