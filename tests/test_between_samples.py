"""A motion is known between its samples: samples are output, and decide nothing."""

import pickle

import casadi as ca
import numpy as np
import pytest
from referred import crane

import servoctl as sv

FEW = np.linspace(0.0, 1.0, 5)


def particle(path, forces=0.0):
    """A mass of 1 kg that follows a path or a formula of q.t, and one of 2 kg beside it under a force."""
    q = sv.coordinates("x y")
    x, y = q
    residual = x - (q.references(X=path).X if isinstance(path, sv.paths.Path) else path(q))
    bodies = sv.particle(q, 1.0, x) + sv.particle(q, 2.0, y)
    mechanism = sv.Mechanism(q, bodies, forces={"y": forces(q) if forces else -y}, actuators={"F": x})
    return sv.derive(mechanism, sv.Program({"X": residual}))


def simulated(model, method=None, t_eval=FEW, **options):
    return sv.simulate(model, model.start(guess={"y": 0.0}), (0.0, 1.0), method, t_eval=t_eval, **options)


@pytest.mark.parametrize("method", [None, "DOP853", "RadauIIA", "RK8"])
@pytest.mark.parametrize("width", [1e-2, 1e-4, 1e-6])
def test_the_peak_of_a_pulse_that_is_a_path_is_found(method, width):
    path = sv.paths.rest_to_rest(0.0, width**2, duration=width, smoothness=4, t_start=0.5)
    s = min(np.roots([14, -14, 3]))  # of x'' = 4 s^3 (1 - s)^3 (1 - 2s) times a constant, which is greatest there
    inside = path.jets(0.5 + width * np.array([s]), 2)[2, 0]
    (_, low), (t, high) = simulated(particle(path), method).extrema("F")
    assert high == pytest.approx(inside[0], rel=1e-9) and low == pytest.approx(-high, rel=1e-9)
    assert t == pytest.approx(0.5 + width * s, abs=1e-4 * width)


@pytest.mark.parametrize("width", [1e-2, 1e-3])
def test_the_peak_of_a_pulse_that_is_a_formula_is_found_down_to_a_thousandth_of_the_span(width):
    model = particle(lambda q: width**2 * ca.exp(-(((q.t - 0.5123) / width) ** 2)))
    (t, low), _ = simulated(model).extrema("F")
    assert low == pytest.approx(-2.0, rel=1e-6) and t == pytest.approx(0.5123, abs=1e-3 * width)


@pytest.mark.parametrize("frequency", [5, 50, 500, 5000])
def test_samples_on_the_zeros_of_a_sine_hide_no_peak(frequency):
    size = (2 * np.pi * frequency) ** 2
    run = simulated(particle(lambda q: ca.sin(2 * np.pi * frequency * q.t)), t_eval=np.linspace(0.0, 1.0, 11))
    assert np.abs(run["F"]).max() < 1e-6 * size
    assert [value for _, value in run.extrema("F")] == pytest.approx([-size, size], rel=1e-9)


@pytest.mark.parametrize("method", ["Taylor", "DOP853", "RadauIIA", sv.methods.RungeKutta(8, step=1e-3)])
def test_a_motion_between_few_samples_is_that_of_many(method):
    model = particle(lambda q: ca.sin(30 * q.t), lambda q: -100 * q[1])
    start, t = model.start(guess={"y": 0.3}), np.linspace(0.0, 1.0, 777)
    run = sv.simulate(model, start, (0.0, 1.0), method, t_eval=FEW)
    w = np.sqrt(50.0)  # of 2 y'' = -100 y
    y = start["y"] * np.cos(w * t) + start["dy"] / w * np.sin(w * t)
    z = run.at(t)
    assert np.abs(z[0] - np.sin(30 * t)).max() < 1e-8 and np.abs(z[1] - y).max() < 1e-8
    assert np.abs(z[4] + 900 * np.sin(30 * t)).max() < 1e-5
    assert np.array_equal(run.at(FEW), run.jets[: len(z)]) and np.array_equal(run.at(0.25), run.jets[: len(z), 1])
    assert np.array_equal(pickle.loads(pickle.dumps(run)).at(t), z)


def test_a_motion_backwards_is_known_between_its_samples():
    model = particle(lambda q: ca.sin(3 * q.t))
    run = sv.simulate(model, model.start(t=1.0, guess={"y": 0.0}), (1.0, 0.0), t_eval=[1.0, 0.0])
    t = np.linspace(1.0, 0.0, 50)
    assert np.abs(run.sampled(t)["F"] + 9 * np.sin(3 * t)).max() < 1e-8
    assert run.extrema("F")[0] == pytest.approx((np.pi / 6, -9.0), abs=1e-6)


def test_the_law_of_a_plan_with_few_samples_is_that_of_many(crane_plans):
    few, many, plant = crane_plans
    laws = [sv.lqr(plan, plant, rate=500.0) for plan in (few, many)]
    one, other = (sv.close(plant, law, many.state(0.0), (0.0, 6.0)) for law in laws)
    assert np.abs(one["x"] - other["x"]).max() < 1e-9 and np.abs(one.input["trolley"] - other.input["trolley"]).max() < 1e-6


@pytest.fixture
def crane_plans():
    model = crane()
    start = model.start(guess={"l": 4.0})
    few, many = (sv.simulate(model, start, (0.0, 6.0), t_eval=np.linspace(0.0, 6.0, n)) for n in (3, 1001))
    return few, many, sv.plant(model.reduction.mechanism)


def swinging():
    """A pendulum on a cart that moves, 20 s from 2.9 rad: three samples tell nothing of it."""
    model = particle(lambda q: ca.sin(q.t), lambda q: -40 * ca.sin(q[1]) - 0.8 * q.d(1)[1] + 0.02 * (q[0] - q[1]))
    return model, model.start(y=2.9, dy=0.0)


def test_a_saved_run_has_its_samples_alone(tmp_path):
    model = particle(lambda q: ca.sin(3 * q.t))
    run = simulated(model, t_eval=np.linspace(0.0, 1.0, 101))
    again = sv.load(run.save(tmp_path / "run"), model)
    assert again.steps == () and again.at(0.123) == pytest.approx(run.at(0.123), abs=1e-9)
    assert again.extrema("F")[1] == pytest.approx(run.extrema("F")[1], abs=1e-6)


def test_samples_that_do_not_resolve_a_motion_tell_nothing_of_it(tmp_path, monkeypatch):
    model, start = swinging()
    run = sv.simulate(model, start, (0.0, 20.0), t_eval=np.linspace(0.0, 20.0, 3))
    again = sv.load(run.save(tmp_path / "run"), model)
    assert run.internal["verdict"] != "inconclusive" and run.extrema("y")[1][1] == pytest.approx(2.9, abs=1e-9)
    monkeypatch.setattr("servoctl.methods.motion.MOST_KEPT", 100.0)
    unkept = sv.simulate(model, start, (0.0, 20.0), t_eval=np.linspace(0.0, 20.0, 3))
    for other in (again, unkept):
        assert other.steps == () and other.extrema("y")[1] == (0.0, 2.9)
        found = sv.internal_dynamics(other)
        assert found.verdict == "inconclusive" and "more samples" in found.cause
    assert "interpolated between samples" in unkept.message


@pytest.mark.parametrize("method", ["DOP853", "RK45", "Radau"])
def test_a_longest_step_finds_what_would_be_stepped_over(method):
    width = 1e-4
    model = particle(lambda q: 0 * q.t, lambda q: ca.exp(-(((q.t - 0.51234) / width) ** 2)) / width)
    run = simulated(model, method, max_step=width)
    assert run["dy"][-1] == pytest.approx(np.sqrt(np.pi) / 2, rel=1e-4)
    assert max(np.abs(np.diff(piece.t)).max() for piece in run.steps) <= width * (1 + 1e-9)


@pytest.mark.parametrize("given", [0.0, -1e-3, 1e-17, np.nan, "short"])
def test_a_longest_step_that_is_none_is_refused(given):
    with pytest.raises(sv.errors.SpecificationError, match="max_step"):
        simulated(particle(lambda q: ca.sin(q.t)), max_step=given)


def test_an_instant_outside_the_run_is_refused():
    run = simulated(particle(lambda q: ca.sin(q.t)))
    for t in (1.5, [0.5, -0.1], np.array([0.0, 2.0])):
        with pytest.raises(sv.errors.SpecificationError, match="outside the run"):
            run.at(t)


def pair(damping, stiffness):
    """Two masses between a spring and a damper, whose relative motion decays fast: stiff."""
    q, p = sv.coordinates("a b"), sv.parameters(k=stiffness)
    (a, b), (da, db) = q, q.d(1)
    bodies, spring = sv.particle(q, 1.0, a) + sv.particle(q, 2.0, b), p.k * (b - a) ** 2 / 2
    forces = {"a": damping * (db - da), "b": -damping * (db - da)}
    mechanism = sv.Mechanism(q, bodies, potential=spring, forces=forces, actuators={"F": b}, parameters=p)
    return sv.derive(mechanism, sv.Program({"y": a - ca.sin(q.t)}))


@pytest.mark.parametrize(("damping", "stiffness"), [(0.1, 2e4), (1e-5, 2.0)])
def test_many_stiff_motions_are_as_right_as_one(damping, stiffness):
    model, t = pair(damping, stiffness), np.linspace(0.0, 2.0, 11)
    start = model.start(guess={"b": 0.0})
    batch = sv.simulate_many(model, start, {"k": [stiffness]}, (0.0, 2.0), t_eval=t, progress=False)
    fine = sv.simulate(model, start, (0.0, 2.0), sv.methods.RadauIIA(rtol=1e-12), t_eval=t)
    assert np.abs(batch.trace["F"][:, 0] - fine["F"]).max() < 1e-5


def test_a_named_method_says_that_stability_limits_its_steps():
    model = pair(0.1, 2e4)
    run = sv.simulate(model, model.start(guess={"b": 0.0}), (0.0, 2.0), "Taylor", t_eval=[0.0, 2.0])
    assert "stability, not accuracy, limits the steps of Taylor" in run.message and "RadauIIA" in run.message


def test_events_of_a_narrow_signal_are_found_with_steps_as_short(width=1e-4):
    q = sv.coordinates("x")
    (x,) = q
    outputs = {"g": ca.exp(-((x / width) ** 2))}
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, x), actuators={"F": x}, outputs=outputs)
    model = sv.derive(mechanism, sv.Program({"X": x - ca.sin(3 * q.t)}))
    event = {"near": sv.Event("g", 0.5)}
    run = sv.simulate(model, model.start(t=0.1), (0.1, 6.0), events=event, t_eval=[0.1, 6.0], max_step=3e-4)  # a step shows a tenth of it
    at = np.arcsin(width * np.sqrt(np.log(2.0))) / 3
    expected = np.sort(np.add.outer(np.arange(1, 6) * np.pi / 3, [-at, at]).ravel())
    assert run.t_events["near"] == pytest.approx(expected, abs=1e-10)


def test_a_multiple_root_is_one_event():
    model = particle(lambda q: ca.sin(q.t))
    run = simulated(model, events={"flat": sv.Event(lambda t, x: (t - 0.7) ** 3)})
    assert run.t_events["flat"] == pytest.approx([0.7], abs=1e-4)


@pytest.mark.parametrize("method", [sv.methods.RungeKutta(8, step=0.01), "Taylor", "RadauIIA", "DOP853"])
def test_a_force_by_the_principal_angle_jumps_where_the_angle_does(method):
    q = sv.coordinates("x")
    (x,) = q
    plant = sv.plant(sv.Mechanism(q, sv.particle(q, 1.0, x), forces={"x": -ca.atan2(ca.sin(3 * x), ca.cos(3 * x))}))
    run = sv.simulate(plant, {"x": 0.2, "dx": 2.0}, (0.0, 5.0), method)
    t, state, turn = 0.0, np.array([0.2, 2.0]), 0  # x'' = -3 (x - 2 pi turn / 3) until the angle passes half a turn
    w = np.sqrt(3.0)
    while True:
        middle, edge = 2 * np.pi * turn / 3, np.pi / 3
        a, b = state[0] - middle, state[1] / w
        size, phase = np.hypot(a, b), np.arctan2(b, a)
        wait = (phase - np.arccos(edge / size)) / w  # on the way up
        wait = wait if wait > 1e-9 else np.inf
        if t + wait > 5.0:
            break
        t, state = t + wait, np.array([middle + edge, np.sqrt(state[1] ** 2 + 3 * (a**2 - edge**2))])
        turn += 1
    x_end = middle + size * np.cos(w * (5.0 - t) - phase)
    assert run["x"][-1] == pytest.approx(x_end, abs=1e-6)


@pytest.mark.parametrize("method", ["Taylor", "DOP853", "RadauIIA", "RK8"])
def test_switches_that_follow_ever_faster_end_with_words(method):
    """Each half swing takes sqrt(3/7) of the time of the one before; together they last for 3.377 s."""
    q = sv.coordinates("x")
    (x,), (dx,) = q, q.d(1)
    plant = sv.plant(sv.Mechanism(q, sv.particle(q, 1.0, x), forces={"x": -5 * ca.sign(x) - 2 * ca.sign(dx)}))
    with pytest.raises(sv.errors.IntegrationStopped, match="stays at the switch") as caught:
        sv.simulate(plant, {"x": 1.0, "dx": 0.0}, (0.0, 10.0), method)
    last = np.sqrt(2 / 3) + np.sqrt(6.0) * (1 / 7 + 21**-0.5) / (1 - np.sqrt(3 / 7))
    assert last - 0.03 < caught.value.details["t"] < last + 5e-3
    assert caught.value.run.t[-1] > 3.3


def test_a_signal_that_jumps_costs_no_search_without_end():
    q = sv.coordinates("x")
    (x,) = q
    outputs = {"jump": ca.if_else(x > 0.3, 1, 0), "edge": ca.sqrt(x - 0.5)}
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, x), actuators={"F": x}, outputs=outputs)
    model = sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}))
    run, calls = sv.simulate(model, model.start(), (0.0, 1.0), t_eval=[0.0, 1.0]), []
    counted = type(run).sampled
    type(run).sampled = lambda self, t: calls.append(len(t)) or counted(self, t)
    try:
        assert [value for _, value in run.extrema("jump")] == [0.0, 1.0]
        assert run.extrema("edge")[0][1] == pytest.approx(0.0, abs=1e-4)
    finally:
        type(run).sampled = counted
    assert sum(calls) < 20_000


def test_what_ends_a_motion_ends_what_is_known_of_it():
    model = particle(lambda q: ca.sin(q.t))
    for method in (None, "DOP853", "RK8"):
        event = {"end": sv.Event("y", 0.5, terminal=True)}
        run = sv.simulate(model, model.start(guess={"y": 1.0}), (0.0, 3.0), method, events=event, t_eval=[0.0, 0.5, 3.0])
        assert run.status == 1 and run.span == (0.0, run.t[-1])
        with pytest.raises(sv.errors.SpecificationError, match="outside the run"):
            run.at(run.t[-1] + 0.1)
        assert run.events["end"].at(0.2) == pytest.approx(run.at(0.2))


def test_instants_in_another_order_are_refused():
    run = simulated(particle(lambda q: ca.sin(q.t)))
    with pytest.raises(sv.errors.SpecificationError, match="another order"):
        run.sampled([0.5, 0.2])


@pytest.mark.parametrize("method", ["LSODA", "Radau"])
def test_no_implicit_method_is_told_that_stability_limits_it(method):
    model = pair(0.1, 2e4)
    run = sv.simulate(model, model.start(guess={"b": 0.0}), (0.0, 2.0), method, t_eval=[0.0, 2.0])
    assert run.message == "finished"


def test_a_bounded_motion_takes_no_longest_step(gallery_model):
    model = gallery_model("cart-pole")
    with pytest.raises(sv.errors.SpecificationError, match="max_step"):
        sv.simulate(model, model.start(), (0.0, 2.0), "bounded", max_step=0.1)
