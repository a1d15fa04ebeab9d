"""The sampled closed loop: sampling, hold, delays, limits, noise; feedforward and PD; bad input."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import along, numbers
from refusals import refused
from scenes import CRANE, POINT, ROPE

import servoctl as sv
from servoctl.control import loop as sampled
from servoctl.errors import InconsistentStart
from servoctl.gallery import gallery

# the loop against a recursion -----------------------------------------------------------------------------------------


def recursion(gain, x, rate, count, m=2.0, delay=0, late=0.0, low=-np.inf, high=np.inf, change=np.inf, d=0.0, **y):
    """The sampled loop of a point mass under u = -gain·y, exactly: states (2, count + 1), inputs (count + 1,)."""
    h, noise, quantum = 1.0 / rate, y.get("noise", np.zeros((count + 1, 2))), y.get("quantum")
    states, commands, inputs = [np.array(x, dtype=float)], [], []
    for k in range(count + 1):
        measured = states[-1] + noise[k]
        measured = measured if quantum is None else quantum * np.rint(measured / quantum)
        commands.append(-gain @ measured)
        u = np.clip(commands[k - delay] if k >= delay else 0.0, low, high)
        before = inputs[-1] if inputs else 0.0
        inputs.append(np.clip(u, before - change, before + change))
        arriving = [(inputs[-2] if len(inputs) > 1 else 0.0, late), (inputs[-1], h - late)]
        if k < count:
            position, speed = states[-1]
            for u, span in arriving:
                a = (u + d) / m
                position, speed = position + speed * span + a * span**2 / 2, speed + a * span
            states.append(np.array([position, speed]))
    return np.array(states).T, np.array(inputs)


LOOPS = {
    "plain": ({}, {}, {}),
    "delay of two samples": ({}, {"timing": {"delay": 2}}, {"delay": 2}),
    "limits": ({"limits": {"force": (-3.0, 5.0)}}, {}, {"low": -3.0, "high": 5.0}),
    "limits of rate": ({"rate_limits": {"force": 40.0}}, {}, {"change": 2.0}),
    "both": (
        {"limits": {"force": 3.0}, "rate_limits": {"force": 40.0}}, {"timing": {"delay": 1}},
        {"low": -3.0, "high": 3.0, "change": 2.0, "delay": 1},
    ),
    "transport delay": ({"delay": 0.02}, {"timing": {"substeps": 5}}, {"late": 0.02}),
    "constant force": ({}, {"disturbance": {"x": 1.5}}, {"d": 1.5}),
    "quantisation": ({}, {"sensors": sv.Sensors(quantisation={"x": 0.01, "dx": 0.02})}, {"quantum": np.array([0.01, 0.02])}),
}  # fmt: skip


@pytest.mark.parametrize("what", LOOPS)
def test_a_loop_is_what_its_recursion_says(what):
    of_plant, of_loop, of_recursion = LOOPS[what]
    gain = np.array([20.0, 9.0])
    run = sv.close(
        sv.plant(POINT, **of_plant),
        lambda t, y: [-gain @ [y["x"], y["dx"]]],
        [1.0, 0.5],
        (0.0, 3.0),
        **of_loop | {"timing": sv.Timing(rate=20.0, **of_loop.get("timing", {}))},
    )
    states, inputs = recursion(gain, [1.0, 0.5], 20.0, 60, **of_recursion)
    assert run.states == pytest.approx(states, abs=1e-12)
    assert run["force"] == pytest.approx(inputs, abs=1e-11)
    assert sv.verify(run).passed


def test_noise_is_what_was_added_and_seeded():
    law = lambda t, y: [-20.0 * y["x"] - 9.0 * y["dx"]]  # noqa: E731
    timing, sensors = sv.Timing(rate=20.0), [sv.Sensors(noise={"x": 0.01}, seed=seed) for seed in (5, 5, 6)]
    runs = [sv.close(sv.plant(POINT), law, [1.0, 0.0], (0.0, 100.0), sensors=s, timing=timing) for s in sensors]
    added = runs[0].measured["x"] - runs[0]["x"]
    assert np.array_equal(runs[0].states, runs[1].states) and not np.array_equal(runs[0].states, runs[2].states)
    assert added.std() == pytest.approx(0.01, rel=0.05)
    assert abs(np.corrcoef(added[1:], added[:-1])[0, 1]) < 0.06
    assert np.array_equal(runs[0].measured["dx"], runs[0]["dx"])


def test_a_lag_follows_its_command_exponentially():
    plant = sv.plant(POINT, lag={"force": 0.1})
    run = sv.close(plant, lambda t, y: [4.0], [0.0, 0.0], (0.0, 1.0), timing=sv.Timing(rate=50.0, substeps=4))
    assert run["force"] == pytest.approx(4.0 * (1 - np.exp(-run.t / 0.1)), abs=1e-6)
    assert run.input["force"] == pytest.approx(4.0)


def test_the_active_limit_is_named():
    plant = sv.plant(POINT, limits={"force": (-3.0, 5.0)}, rate_limits={"force": 40.0})
    asked = {0: 1.0, 1: 9.0, 2: 9.0, 3: 9.0, 4: 4.0, 5: 4.0, 6: -9.0, 7: -9.0, 8: -9.0, 9: -9.0, 10: -9.0}
    run = sv.close(plant, lambda t, y: [asked[round(20 * t)]], [0.0, 0.0], (0.0, 0.5), timing=sv.Timing(rate=20.0))
    assert run["force"].tolist() == pytest.approx([1.0, 3.0, 5.0, 5.0, 4.0, 4.0, 2.0, 0.0, -2.0, -3.0, -3.0])
    assert run.active["force"].tolist() == [0, 2, 1, 1, 0, 0, -2, -2, -2, -1, -1]
    assert "limited during 72.7 %" in repr(run)
    assert run.command["force"].tolist() == pytest.approx(list(asked.values()))


# sampled poles --------------------------------------------------------------------------------------------------------


def grows(product, delay):
    """Whether the point mass under two poles at -p, sampled with p·h = product, goes astray."""
    p, m = 1.0, 2.0
    law = lambda t, y: [-m * (p**2 * y["x"] + 2 * p * y["dx"])]  # noqa: E731
    timing = sv.Timing(rate=1 / product, delay=delay, substeps=1)
    run = sv.close(sv.plant(POINT), law, [1.0, 0.0], (0.0, 400 * product), timing=timing)
    size = np.abs(run.states).max(axis=0)
    return size[-50:].max() > size[150:200].max()


@pytest.mark.parametrize(("delay", "limit"), [(0, 1.0), (1, 0.4262)])
def test_pole_placement_goes_unstable_where_the_period_is_too_long(delay, limit):
    low, high = 0.5 * limit, 1.5 * limit
    assert not grows(low, delay) and grows(high, delay)
    for _ in range(8):
        middle = (low + high) / 2
        low, high = (low, middle) if grows(middle, delay) else (middle, high)
    assert low == pytest.approx(limit, rel=0.02)


@pytest.mark.parametrize(("product", "fast"), [(0.98, False), (1.02, True), (30.0, True)])
def test_gains_too_fast_for_their_rate_are_refused(point_plan, product, fast):
    p = 20.0
    gains = {"kp": {"force": 2.0 * p**2}, "kd": {"force": 2.0 * 2 * p}}
    if fast:
        with refused(sv.errors.ServoError, "0.6752"):
            sv.pd(point_plan, sv.plant(POINT), rate=p / product, **gains)
    else:
        law = sv.pd(point_plan, sv.plant(POINT), rate=p / product, **gains)
        assert law.info["largest spectral radius along the plan"] < 1.0


# laws from a plan -----------------------------------------------------------------------------------------------------


def worst(run):
    return max(np.abs(run.residual[name][0]).max() for name in ("X", "Z"))


def test_a_held_feedforward_takes_the_middle_of_the_sample(crane_plan):
    plant, x0 = sv.plant(CRANE), crane_plan.state(0.0)
    middle = sv.feedforward(crane_plan, plant, 50.0)
    times = middle.t0 + np.arange(401) / 50.0
    start = replace(middle, schedule=np.array([np.interp(times, crane_plan.t, crane_plan[a]) for a in middle.inputs]))
    errors = {name: worst(sv.close(plant, law, x0, (0.0, 6.0))) for name, law in (("middle", middle), ("start", start))}
    assert 20 < errors["start"] / errors["middle"] < 2000
    finer = worst(sv.close(plant, sv.feedforward(crane_plan, plant, 100.0), x0, (0.0, 6.0)))
    assert errors["middle"] / finer == pytest.approx(4.0, rel=0.1), "of second order in the period"


@pytest.mark.parametrize("actuator", [{"lag": {"trolley": 0.1, "hoist": 0.05}}, {"delay": {"trolley": 0.03}}])
def test_feedforward_meets_lag_and_transport_delay(crane_plan, actuator):
    plant, x0 = sv.plant(CRANE, **actuator), crane_plan.state(0.0)
    knowing = worst(sv.close(plant, sv.feedforward(crane_plan, plant), x0, (0.0, 6.0)))
    ignorant = worst(sv.close(plant, sv.feedforward(crane_plan, sv.plant(CRANE)), x0, (0.0, 6.0)))
    assert knowing < 1e-3 and ignorant > 50 * knowing


def test_pd_brings_the_actuated_displacements_back(crane_plan):
    plant = sv.plant(CRANE)
    law = sv.pd(crane_plan, plant, kp={"trolley": 2000.0, "hoist": 5000.0}, kd={"trolley": 800.0, "hoist": 1500.0})
    assert law.measures == ("x", "l", "dx", "dl")
    x = crane_plan.state(0.0) + [0.05, 0.02, 0.0, 0.1, 0.0, 0.0]
    u = law(0.0, dict(zip(plant.state_names, x, strict=True)))
    ahead = sv.feedforward(crane_plan, plant)(0.0, {})
    assert u - ahead == pytest.approx([-2000.0 * 0.05 - 800.0 * 0.1, -5000.0 * 0.02], rel=1e-9)
    run = sv.close(sv.plant(CRANE, m_load=115.0), law, crane_plan.state(0.0), (0.0, 8.0))
    assert np.abs(run.error["x"]).max() < 0.05 and np.abs(run.error["l"]).max() < 0.05


@pytest.mark.parametrize("rate", [100.0, 400.0, 1000.0])
@pytest.mark.parametrize("actuator", ["trolley", "hoist"])
def test_an_actuator_without_gains_is_not_called_unstable(crane_plan, actuator, rate):
    """What it moves is a chain of two integrators: an eigenvalue 1 twice, which rounding moves by the root of 1e-16."""
    law = sv.pd(crane_plan, sv.plant(CRANE), kp={actuator: 2000.0}, kd={actuator: 800.0}, rate=rate)
    assert law.rate == rate


@pytest.mark.parametrize("sensors", [None, sv.Sensors(quantisation={"dl": 1e-3})])
@pytest.mark.parametrize("make", [
    lambda plan, plant: sv.pd(plan, plant, kp={"trolley": 2000.0}, kd={"trolley": 800.0}),
    lambda plan, plant: sv.pd(plan, plant, kp={"trolley": 2e3, "hoist": 5e3}, kd={"trolley": 8e2, "hoist": 15e2}),
    sv.lqr, sv.feedforward,
])  # fmt: skip
def test_measurements_are_the_states_that_a_law_measures(crane_plan, make, sensors, monkeypatch):
    """They are logged only where sensors alter them; the loop may pause after any step."""
    plant, x0 = sv.plant(CRANE, m_load=110.0), crane_plan.state(0.0) + 0.01
    law = make(crane_plan, plant)
    sensors = sensors if "dl" in law.measures else None
    run = sv.close(plant, law, x0, (0.0, 1.0), sensors=sensors)
    assert list(run.measured) == list(law.measures)
    for name, values in run.measured.items():
        step = sensors.quantisation.get(name) if sensors else None
        assert np.array_equal(values, run[name] if step is None else step * np.rint(run[name] / step))
    monkeypatch.setattr(sampled, "FIRST_PIECE", 7)
    monkeypatch.setattr(sampled, "PIECE", 1e-9)
    paused = sv.close(plant, law, x0, (0.0, 1.0), sensors=sensors)
    assert np.array_equal(paused.states, run.states) and np.array_equal(paused.measurements, run.measurements)
    monkeypatch.setattr(type(plant.function("ode")), "native", lambda self, *_: None)
    interpreted = sv.close(plant, law, x0, (0.0, 1.0), sensors=sensors)
    assert interpreted.states == pytest.approx(run.states, abs=1e-10)


@pytest.mark.parametrize("is_compiled", [True, False])
def test_measurements_and_states_are_not_changed(is_compiled, monkeypatch):
    plant = sv.plant(POINT)
    if not is_compiled:
        monkeypatch.setattr(type(plant.function("ode")), "native", lambda self, *_: None)
    run = sv.close(plant, lambda t, y: [-y["x"] - y["dx"]], [1.0, 0.5], (0.0, 1.0), timing=sv.Timing(rate=20.0))
    assert np.array_equal(run.measurements, run.states)
    for array in (run.measurements, run.states):  # which may be one
        with pytest.raises(ValueError, match="read-only"):
            array[:] = np.nan


def test_a_law_with_a_controller_state_is_started(crane_plan):
    plant = sv.plant(CRANE)
    law = sv.lqr(crane_plan, plant, integral=True)
    with refused(sv.errors.SpecificationError, "law.start", "integral of X"):
        law(0.0, crane_plan.state(0.0))
    run = sv.close(sv.plant(CRANE, m_load=115.0), law, crane_plan.state(0.0), (0.0, 1.0))
    controller = law.start()
    by_hand = [controller(t, run.measurements[:, k]) for k, t in enumerate(run.t)]
    assert np.transpose(by_hand) == pytest.approx(run.commands, rel=1e-12)
    assert controller.state == pytest.approx(
        run.controller_states[:, -1] + 0.01 * np.array([run.residual[n][0, -1] for n in "XZ"])
    )


# three ways to run a loop ---------------------------------------------------------------------------------------------


def conditions(plan):
    plant = sv.plant(
        CRANE, m_load=115.0, limits={"trolley": 140.0}, rate_limits={"hoist": 3000.0}, lag={"trolley": 0.02},
        delay={"hoist": 0.02},
    )  # fmt: skip
    gust = sv.disturbances.gust(60.0, 0.5, 1.0, rise=0.1)
    options = {
        "timing": sv.Timing(delay=1),
        "sensors": sv.Sensors(noise={"x": 1e-3}, seed=3),
        "disturbance": {"theta": gust, "x": lambda t: 2.0 * (t > 0.3)},
    }
    return plant, plan.state(0.0), (0.0, 1.5), options


def test_a_law_called_back_in_python_gives_the_same_loop(crane_plan):
    plant, x0, span, options = conditions(crane_plan)
    law = sv.lqr(crane_plan, sv.plant(CRANE), integral=True)
    called_back = replace(law, step=lambda t, x, row: law.step(t, x, row))
    a, b = (sv.close(plant, each, x0, span, **options) for each in (law, called_back))
    assert b.states == pytest.approx(a.states, rel=1e-13, abs=1e-13)
    assert b.controller_states == pytest.approx(a.controller_states, rel=1e-13, abs=1e-15)


def test_the_loop_without_a_compiler_is_the_same(crane_plan, monkeypatch):
    plant, x0, span, options = conditions(crane_plan)
    law = sv.lqr(crane_plan, sv.plant(CRANE), integral=True)
    a = sv.close(plant, law, x0, span, **options)
    monkeypatch.setattr(type(plant.function("ode")), "native", lambda self, *_: None)
    b = sv.close(plant, law, x0, span, **options)
    assert b.states == pytest.approx(a.states, rel=1e-9, abs=1e-11)
    assert b.inputs == pytest.approx(a.inputs, rel=1e-9, abs=1e-9)
    assert [v.tolist() for v in b.active.values()] == [v.tolist() for v in a.active.values()]


class Counting:
    """A law with a state of its own, which its start resets."""

    def start(self):
        calls = iter(range(10**6))
        return lambda t, y: {"force": -5.0 * y["x"] - 0.01 * next(calls)}


def test_a_users_law_is_started_in_each_run():
    timing = sv.Timing(rate=50.0)
    a, b = (sv.close(sv.plant(POINT), Counting(), [1.0, 0.0], (0.0, 1.0), timing=timing) for _ in range(2))
    assert np.array_equal(a.states, b.states) and sv.verify(a).passed


# the balance ----------------------------------------------------------------------------------------------------------


def test_the_energy_is_the_work_of_all_forces(crane_plan):
    plant, x0, span, options = conditions(crane_plan)
    proof = sv.verify(sv.close(plant, sv.lqr(crane_plan, sv.plant(CRANE)), x0, span, **options))
    assert proof.passed and proof.numbers["loop power"] < 1e-6 and proof.numbers["loop limits"] == 0.0


def test_the_balance_knows_what_it_applies_to():
    """A free swing has no power at all; a belt that moves a mass does work that no actuator did."""
    x0 = {"x": 0.0, "l": 4.0, "theta": 0.3, "dx": 0.0, "dl": 0.0, "dtheta": 0.0}
    timing = sv.Timing(rate=100.0, substeps=10)
    rigid = sv.close(sv.plant(CRANE), lambda t, y: [0.0, 0.0], x0, (0.0, 0.5), timing=timing)
    proof = sv.verify(rigid)
    assert proof.passed and proof.numbers["loop power"] < 1e-6
    q = sv.coordinates("x y")
    belt = {"belt": q.d(1)[1] - 0.5 * ca.cos(q.t)}
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, list(q)), actuators={"force": [1, 0]}, constraints=belt)
    timing = sv.Timing(rate=100.0)
    run = sv.close(sv.plant(mechanism), lambda t, y: [0.1], [0.0, 0.0, 0.0, 0.5], (0.0, 3.0), timing=timing)
    proof = sv.verify(run)
    assert run["y"] == pytest.approx(0.5 * np.sin(run.t), abs=1e-9)
    assert proof.passed and "constraint 'belt' moves by itself" in proof.notes[0] and "loop power" not in proof.numbers


def test_a_loop_starts_on_its_material_constraints():
    """Next to them as far as measured states are, and no farther; relative to states larger than 1."""
    q = sv.coordinates("x y")
    belt = {"belt": q.d(1)[1] - 0.5 * ca.cos(q.t)}
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, list(q)), actuators={"force": [1, 0]}, constraints=belt)
    plant, timing = sv.plant(mechanism), sv.Timing(rate=100.0)

    def started(x, off):
        return sv.close(plant, lambda t, y: [0.0], [x, 0.0, 0.0, 0.5 + off], (0.0, 0.1), timing=timing)

    for x, off in ((0.0, 5e-7), (10.0, 5e-6)):
        assert started(x, off).success
        with refused(InconsistentStart, "belt", name="belt"):
            started(x, 10 * off)


def test_a_balance_that_does_not_close_is_found(crane_plan):
    plant, x0, span, options = conditions(crane_plan)
    run = sv.close(plant, sv.lqr(crane_plan, sv.plant(CRANE)), x0, span, **options)
    lighter = replace(run, plant=sv.plant(CRANE, m_load=114.0, lag={"trolley": 0.02}))
    assert "loop power halved" in sv.verify(lighter).failures, "energy of 114 kg, motion of 115 kg"
    calm = replace(run, conditions=replace(run.conditions, disturbance={"theta": 1.0, "x": 0.0}))
    assert sv.verify(calm).failures == ("loop repeated",)
    assert "loop limits" in sv.verify(replace(run, inputs=1.2 * run.inputs)).failures


# bad input ------------------------------------------------------------------------------------------------------------

LAW = lambda t, y: [0.0]  # noqa: E731


class Idle:
    def start(self):
        return 3


def close(plant=None, law=LAW, x0=(0.0, 0.0), span=(0.0, 1.0), rate=20.0, delay=0, substeps=None, **options):
    timing = sv.Timing(rate, delay, substeps)
    return sv.close(sv.plant(POINT) if plant is None else plant, law, x0, span, timing=timing, **options)


BAD = {
    "no plant": (lambda: close(plant=POINT), sv.errors.SpecificationError, "sv.plant"),
    "no law": (lambda: close(law=3.0), sv.errors.SpecificationError, "float"),
    "no rate": (lambda: close(rate=None), sv.errors.SpecificationError, "rate"),
    "negative rate": (lambda: close(rate=-5.0), sv.errors.SpecificationError, "-5"),
    "time that is no sample": (lambda: close(span=(0.0, 1.01)), sv.errors.SpecificationError, {"number": 20.2}),
    "time backwards": (lambda: close(span=(1.0, 0.0)), sv.errors.SpecificationError, "(1.0, 0.0)"),
    "half a delay": (lambda: close(delay=0.5), sv.errors.SpecificationError, {"name": "delay", "value": 0.5}),
    "negative delay": (lambda: close(delay=-1), sv.errors.SpecificationError, {"name": "delay", "value": -1}),
    "half a step": (lambda: close(substeps=1.5), sv.errors.SpecificationError, {"name": "substeps", "value": 1.5}),
    "no step": (lambda: close(substeps=0), sv.errors.SpecificationError, "substeps"),
    "transport between steps": (
        lambda: close(plant=sv.plant(POINT, delay=0.02), substeps=1), sv.errors.SpecificationError, {"name": "force"},
    ),
    "noise on nothing": (lambda: close(sensors=sv.Sensors(noise={"y": 0.1})), sv.errors.NameUnknown, {"valid": ("x", "dx")}),
    "negative noise": (lambda: close(sensors=sv.Sensors(noise={"x": -0.1})), sv.errors.SpecificationError, "-0.1"),
    "seed of nothing": (lambda: close(sensors=sv.Sensors(seed=3)), sv.errors.SpecificationError, "seed"),
    "odd seed": (lambda: close(sensors=sv.Sensors(noise={"x": 0.1}, seed=0.5)), sv.errors.SpecificationError, "seed=0.5"),
    "noise of a number": (lambda: sv.Sensors(noise=0), sv.errors.SpecificationError, "noise"),
    "quantisation of a text": (lambda: sv.Sensors(quantisation=""), sv.errors.SpecificationError, "quantisation"),
    "quantised nothing": (lambda: close(sensors=sv.Sensors(quantisation={"y": 0.1})), sv.errors.NameUnknown, {"valid": ("x", "dx")}),
    "disturbance of nothing": (lambda: close(disturbance={"dx": LAW}), sv.errors.NameUnknown, {"name": "dx"}),
    "disturbance of text": (lambda: close(disturbance={"x": "gust"}), sv.errors.SpecificationError, {"name": "x"}),
    "disturbance of NaN": (lambda: close(disturbance={"x": lambda t: np.nan * t}), sv.errors.SpecificationError, {"name": "x"}),
    "disturbance of lists": (lambda: close(disturbance={"x": lambda t: [1, 2]}), sv.errors.SpecificationError, {"name": "x"}),
    "start off the rope": (
        lambda: close(plant=sv.plant(ROPE), law=lambda t, y: [0.0, 0.0], x0=[0.0, 4.0, 1.0, 4.0, 0.0, 0.0, 0.0, 0.0]),
        sv.errors.InconsistentStart, {"values": {"rope": 1.0, "D(rope)": 0.0}},
    ),
    "start of NaN": (lambda: close(x0=[np.nan, 0.0]), sv.errors.SpecificationError, {"names": ("x", "dx")}),
    "law of two inputs": (lambda: close(law=lambda t, y: [0.0, 1.0]), sv.errors.SpecificationError, "force"),
    "law of an odd name": (lambda: close(law=lambda t, y: {"forc": 0.0}), sv.errors.NameUnknown, {"match": "force"}),
    "law of NaN": (lambda: close(law=lambda t, y: [np.nan if t > 0.52 else 0.0]), sv.errors.ServoError, {"t": 0.55}),
    "law that is a class": (lambda: close(law=Counting), sv.errors.SpecificationError, "type"),
    "law that starts nothing": (lambda: close(law=Idle()), sv.errors.SpecificationError, "'Idle'"),
    "plan of no model": (lambda: close(plan=3.0), sv.errors.SpecificationError, "float"),
    "sensors of a dict": (lambda: close(sensors={"noise": {"x": 0.1}}), sv.errors.SpecificationError, "sv.Sensors"),
    "seed of text": (lambda: close(sensors=sv.Sensors(noise={"x": 0.1}, seed="")), sv.errors.SpecificationError, "seed=''"),
    "seed of no noise": (lambda: close(sensors=sv.Sensors(noise={}, seed=1)), sv.errors.SpecificationError, "seed"),
    "lag far below the period": (
        lambda: close(plant=sv.plant(POINT, lag={"force": 1e-6})), sv.errors.SpecificationError, "1e+06 1/s",
    ),
    "force without a slope": (
        lambda: close(plant=sv.plant(POINT, forces={"x": -ca.sqrt(ca.fabs(POINT.q.d(1)[0]))})),
        sv.errors.SpecificationError, "substeps",
    ),
    "law that fails": (lambda: close(law=lambda t, y: [y["z"]]), KeyError, "z"),
}  # fmt: skip


def test_sensors_and_timing_are_values():
    sensors, timing = sv.Sensors(noise={"x": 1}, seed=3), sv.Timing(rate=100, delay=2.0)
    assert sensors == sv.Sensors({"x": 1.0}, {}, 3) and timing == sv.Timing(100.0, 2, None)
    assert pickle.loads(pickle.dumps((sensors, timing))) == (sensors, timing)
    with pytest.raises(AttributeError):
        timing.delay = 1


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_refused_by_name(what):
    call, kind, fact = BAD[what]
    with refused(kind, fact):
        call()


def test_what_was_computed_before_a_law_failed_is_kept():
    with pytest.raises(sv.errors.ServoError) as caught:
        close(law=lambda t, y: [np.nan if t > 0.52 else 1.0])
    assert caught.value.run.t[-1] == pytest.approx(0.5) and not caught.value.run.success
    with pytest.raises(KeyError) as caught:
        close(law=lambda t, y: [y["z"] if t > 0.52 else 1.0])
    assert caught.value.run.t[-1] == pytest.approx(0.5) and "raised KeyError" in caught.value.run.message
    with pytest.raises(sv.errors.ServoError) as caught:
        close(law=lambda t, y: [np.nan])
    assert "no samples" in repr(caught.value.run.to_run()) and "0 samples" in repr(caught.value.run)


def test_a_loop_that_diverges_stops_with_its_motion():
    with refused(sv.errors.IntegrationStopped, "3.15 s") as caught:
        close(
            plant=sv.plant(POINT, forces={"x": 1e6 * next(iter(POINT.q))}), x0=(1.0, 1.0), span=(0.0, 50.0), substeps=1
        )
    assert np.isfinite(caught.value.run.states).all() and len(caught.value.run.t) > 1


def handmade(step=lambda t, x, row: [-x[0], -981.0], **other):
    inputs = tuple(CRANE.actuators)
    return replace(sv.Law("own", ("x",), inputs, 100.0, 0.0, step, np.zeros((1, 3))), **other)


@pytest.mark.parametrize("answer", [[1.0], [1.0, 2.0, 3.0], None, "ab"])
def test_a_handmade_law_that_answers_otherwise_is_refused(crane_plan, answer):
    law = handmade(lambda t, x, row: answer)
    for ask in (lambda: law(0.0, [0.0]), lambda: sv.close(sv.plant(CRANE), law, crane_plan.state(0.0), (0.0, 0.1))):
        with refused(sv.errors.SpecificationError, "2 numbers", t=0.0):
            ask()


@pytest.mark.parametrize("measurement", ["a", None, {"x": None}, [0.0, 1.0]])
def test_what_is_no_measurement_is_refused(measurement):
    with refused(sv.errors.SpecificationError, names=("x",)):
        handmade()(0.0, measurement)


def test_a_law_is_asked_at_times_and_has_a_rate():
    with refused(sv.errors.SpecificationError, name="t"):
        handmade()(np.nan, [0.0])
    with refused(sv.errors.SpecificationError, name="rate", value=0.0):
        handmade(rate=0.0)


def test_laws_refuse_plans_and_plants_that_do_not_fit(point_plan, crane_plan, tmp_path):
    with refused(sv.errors.NameUnknown, name="x"):
        sv.feedforward(point_plan, sv.plant(gallery["two-cars"].build()[0]))
    with refused(sv.errors.SpecificationError, "Run", "plan"):
        sv.feedforward(sv.load(point_plan.save(tmp_path / "plan")), sv.plant(POINT))
    with refused(sv.errors.SpecificationError, "50 Hz", "100 Hz"):
        law, timing = sv.feedforward(point_plan, sv.plant(POINT)), sv.Timing(rate=50.0)
        sv.close(sv.plant(POINT), law, [0, 0], (0.0, 1.0), timing=timing)
    with refused(sv.errors.SpecificationError, "0.005 s", number=0.5):
        sv.close(sv.plant(POINT), sv.feedforward(point_plan, sv.plant(POINT)), [0, 0], (0.005, 1.005))
    with refused(sv.errors.SpecificationError, "2 s", "10 s"):
        sv.feedforward(point_plan, sv.plant(POINT), rate=0.1)
    law = sv.pd(point_plan, sv.plant(POINT), kp={"force": 100.0}, kd={"force": 20.0})
    for wrong in ({"schedule": law.schedule[:2]}, {"state": np.zeros(1)}, {"measures": ()}, {"initial_input": np.zeros(2)}):
        with refused(sv.errors.SpecificationError, law.name):
            replace(law, **wrong)
    rough = sv.plant(POINT, forces={"x": -ca.sqrt(ca.fabs(POINT.q.d(1)[0]))})
    with refused(sv.errors.ServoError, "plant", t=pytest.approx(1.005)):
        sv.pd(point_plan, rough, kp={"force": 100.0})
    for make in (sv.feedforward, sv.pd, sv.lqr, sv.computed):
        with refused(sv.errors.SpecificationError, "Mechanism", "sv.plant"):
            make(point_plan, POINT)
    with refused(sv.errors.SpecificationError, "kp", "'force'"):
        sv.pd(point_plan, sv.plant(POINT), kp={"force": [1.0, 2.0]})
    with refused(sv.errors.NameUnknown, name="forc", match="force"):
        sv.pd(point_plan, sv.plant(POINT), kp={"forc": 1.0})
    with refused(sv.errors.NameUnknown, name="trolley"):
        sv.close(sv.plant(POINT), sv.feedforward(crane_plan, sv.plant(CRANE)), [0, 0], (0.0, 1.0))


def test_an_ideal_plan_is_no_command():
    mechanism, program = gallery["two-cars-ideal"].build()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(guess={"x2": 0.0}), (0.0, 0.1))
    with refused(sv.errors.NotRealisable, "ideal"):
        sv.feedforward(plan, sv.plant(mechanism))


def test_more_samples_than_fit_into_memory_are_refused_with_their_number():
    scene = gallery["overhead-crane"]
    model = sv.derive(*scene.build())
    plan = sv.simulate(model, model.start(t=2.0, guess=scene.guess), (2.0, 1e9))
    plant = sv.plant(model.reduction.mechanism)
    for build in (
        lambda: sv.lqr(plan, plant),
        lambda: sv.close(plant, lambda t, y: [0.0, -981.0], plan.state(2.0), (0.0, 1e9), timing=sv.Timing(100.0)),
    ):
        with refused(sv.errors.SpecificationError, "GB", samples=pytest.approx(1e11, rel=1e-8)):
            build()


def test_residuals_of_order_2_are_those_of_the_accelerations():
    """On its plan, a robot keeps the rate of its curvature up to the hold, in the middle of each sample."""
    scene = gallery["wheeled-robot"]
    model = sv.derive(*scene.build())
    plan = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)
    plant = sv.plant(model.reduction.mechanism)
    worst = []
    for rate in (100.0, 200.0):
        run = sv.close(plant, sv.feedforward(plan, plant, rate=rate), plan.state(0.0), scene.t_span)
        assert run.residual["clothoid"].shape == (1, len(run.t))
        worst.append(np.abs(run.residual["clothoid"]).max())
    assert max(worst) < 1e-12
    plant = sv.plant(model.reduction.mechanism, J=1.65)
    run = sv.close(plant, sv.feedforward(plan, plant, rate=100.0), plan.state(0.0), scene.t_span)
    k, parameters = 40, dict(zip(plant.mechanism.parameters.names, plant.parameters, strict=False))
    t, p = run.t[k] + run.loop.period / 2, run.p[:, k]
    middle = sampled.hold(plant.function("ode"), run.t[k], run.states[:, k], [(0.0, run.loop.period / 2, (p, p, p))])
    jets = np.append(middle, plant.function("accelerations")(t, middle, p))
    names = (*plant.state_names, *model.reduction.mechanism.q.jet_names(2))
    values = {"t": t} | parameters | dict(zip(names, jets, strict=True))
    residual = along(model.reduction.mechanism.q, model.reduction.program.residuals["clothoid"], t)
    expected = numbers([residual], values)
    assert run.residual["clothoid"][:, k] == pytest.approx(expected, abs=1e-12) and abs(expected[0]) > 1e-3


def test_a_closed_run_is_saved_and_loaded(crane_plan, tmp_path):
    plant, x0, span, options = conditions(crane_plan)
    run = sv.close(plant, sv.lqr(crane_plan, sv.plant(CRANE), integral=True), x0, span, **options)
    back = sv.load(run.save(tmp_path / "closed"))
    for name in ("theta", "trolley", "d2theta", "tension"):
        assert np.array_equal(back[name], run[name])
    assert np.array_equal(back["command hoist"], run.command["hoist"])
    assert np.array_equal(back["measured x"], run.measured["x"])
    assert np.array_equal(back.residual["X"], run.residual["X"])
    assert len(repr(run).splitlines()) <= 8 and len(repr(run.law).splitlines()) <= 12
    with refused(sv.errors.NameUnknown, name="thetta", match="theta"):
        run["thetta"]
    with refused(sv.errors.SpecificationError, "0.005 s"):
        run.state(0.005)


def test_a_closed_run_travels_as_itself(crane_plan):
    plant, x0, span, options = conditions(crane_plan)
    law = sv.lqr(crane_plan, sv.plant(CRANE), integral=True)
    gust = {"x": sv.disturbances.gust(60.0, 0.2, 0.5)}
    run = sv.close(plant, law, x0, span, **options | {"disturbance": gust})
    text = str(run)
    content = pickle.dumps(run)
    sent = pickle.loads(content)
    assert sent == run and sent.conditions == run.conditions and pickle.loads(pickle.dumps(sent)) == run
    assert str(sent) == text and b"_evaluations" not in content, "evaluated signals stay at home"
    assert np.array_equal(sent["d2theta"], run["d2theta"]) and np.array_equal(sent.residual["Z"], run.residual["Z"])
    again = sv.close(sent.plant, sent.law, x0, span, **options | {"disturbance": gust}, plan=sent.plan)
    assert np.array_equal(again.states, run.states)
    with refused(sv.errors.SpecificationError, "'x'", what="disturbance of 'x'"):
        pickle.dumps(sv.close(plant, law, x0, span, **options | {"disturbance": {"x": lambda t: 0.0}}))
    with refused(sv.errors.SpecificationError, what="law '<lambda>'"):
        pickle.dumps(sv.close(plant, lambda t, y: [0.0, 0.0], x0, span, timing=sv.Timing(rate=100.0)))


def test_a_loop_that_starts_mid_plan_waits_with_the_plans_present_actuation(crane_plan):
    """The inputs before the first command arrives: those of the plan at the loop's start, not at its own."""
    nominal = sv.plant(CRANE)
    law = sv.feedforward(crane_plan, nominal)
    run = sv.close(nominal, law, crane_plan.state(3.0), (3.0, 3.5), timing=sv.Timing(delay=4))
    k = int(np.argmin(np.abs(crane_plan.t - 3.0)))
    assert crane_plan.t[k] == pytest.approx(3.0, abs=1e-12)
    timing = sv.Timing(rate=100.0, delay=4)
    own = sv.close(nominal, law.start(), crane_plan.state(3.0), (3.0, 3.5), timing=timing, plan=crane_plan)
    for loop in (run, own):
        assert loop["trolley"][:4] == pytest.approx(np.full(4, crane_plan["trolley"][k]), rel=1e-9)


def test_a_loop_says_which_residuals_it_does_not_evaluate():
    q = sv.coordinates("x y")
    x, y = q
    body = sv.Mechanism(q, sv.particle(q, 1.0, (x, y)), actuators={"fx": x, "fy": y})
    model = sv.derive(body, sv.Program({"jerk": q.d(3)[0] - 1.0, "level": y}))  # no F is known of this row
    plan = sv.simulate(model, model.start(), (0.0, 0.5), t_eval=np.linspace(0.0, 0.5, 51))
    law = sv.lqr(plan, sv.plant(body))
    loop = sv.close(sv.plant(body), law, plan.state(0.0), (0.0, 0.5))
    assert list(loop.residual) == ["jerk", "level"] and np.abs(loop.residual["jerk"]).max() < 5e-3
    loop = sv.close(sv.plant(body), law, plan.state(0.0), (0.0, 0.01))
    assert list(loop.residual) == ["level"] and "too few samples: jerk" in repr(loop)
