"""Ctrl-C in compiled loops: they answer before their end, keep what was computed, and pauses change no bit."""

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scenes import CRANE

import servoctl as sv
from servoctl import simulation
from servoctl.codegen import compiler
from servoctl.control import batch
from servoctl.control import loop as loops
from servoctl.gallery import gallery


@pytest.fixture
def ctrl_c():
    """A function that sends SIGINT to this process after some seconds."""
    before, timers = signal.signal(signal.SIGINT, signal.default_int_handler), []

    def after(seconds):
        timers.append(threading.Timer(seconds, lambda: os.kill(os.getpid(), signal.SIGINT)))
        timers[-1].start()

    yield after
    for timer in timers:
        timer.cancel()
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def law(plan):
    return sv.lqr(plan, sv.plant(CRANE), rate=500.0, integral=True)


@pytest.fixture(scope="module")
def wheel_model():
    scene = gallery["appell-hamel"]
    model = sv.derive(*scene.build())
    return model, model.start(**scene.start, guess=scene.guess)


LONG = [sv.methods.RungeKutta(4, step=2e-6), sv.methods.RungeKutta(8, step=2e-6), "Taylor", "RadauIIA", "DOP853"]


@pytest.mark.parametrize("method", LONG, ids=str)
def test_an_integration_of_minutes_is_interrupted_and_kept(wheel_model, method, ctrl_c, c_compiler):
    model, start = wheel_model
    short = sv.methods.RungeKutta(method.order, step=1e-3) if isinstance(method, sv.methods.RungeKutta) else method
    sv.simulate(model, start, (0.0, 0.1), short, progress=False)  # compiled
    end = 100.0 if isinstance(method, sv.methods.RungeKutta) else 1e6
    ctrl_c(0.2)
    run = sv.simulate(model, start, (0.0, end), method, progress=False)
    assert (run.status, run.success) == (1, False) and "interrupted" in run.message
    assert len(run.t) and run.t[-1] < end and np.all(np.isfinite(run.jets[: len(start.values)]))


@pytest.mark.parametrize("method", [None, "algebraic"])
def test_a_computed_motion_is_kept_when_interrupted_at_its_end(wheel_model, method, ctrl_c, monkeypatch):
    model, start = wheel_model
    if method is not None:
        model = sv.derive(*gallery["overhead-crane"].build())
        start = model.start()
    started = simulation._as_started
    monkeypatch.setattr(simulation, "_as_started", lambda *given: signal.raise_signal(signal.SIGINT) or started(*given))
    ctrl_c(60.0)
    run = sv.simulate(model, start, (0.0, 1.0), method)
    assert (run.status, run.success) == (1, False) and "interrupted" in run.message and run.t[-1] == 1.0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("while_", ["quiet", "internal_dynamics"])
def test_a_motion_is_kept_when_its_growth_is_judged(wheel_model, while_, ctrl_c, monkeypatch):
    model, start = wheel_model
    monkeypatch.setattr(simulation, "quiet", lambda _: False)
    monkeypatch.setattr(simulation, while_, lambda *_: signal.raise_signal(signal.SIGINT))
    ctrl_c(60.0)
    run = sv.simulate(model, start, (0.0, 1.0), t_eval=[0.0, 0.5, 1.0])
    assert (run.status, run.success) == (1, False) and "interrupted at its end" in run.message
    assert run.t.tolist() == [0.0, 0.5, 1.0] and sv.internal_dynamics(run) is not None


@pytest.mark.parametrize(
    "substeps, span", [(1000, (0.0, 100.0)), (10**8, (0.0, 0.02))], ids=["many samples", "long samples"]
)
def test_a_closed_loop_of_minutes_is_interrupted_and_kept(plan, law, substeps, span, ctrl_c):
    plant, x0 = sv.plant(CRANE), plan.state(0.0)
    sv.close(plant, law, x0, (0.0, 0.1))  # compiled
    ctrl_c(0.2)
    run = sv.close(plant, law, x0, span, timing=sv.Timing(substeps=substeps))
    assert (run.status, run.success) == (1, False) and "interrupted" in run.message and "kept" in run.message
    assert len(run.t) and run.t[-1] < span[1] and np.isfinite(run.states).all() and np.isfinite(run.commands).all()
    assert "interrupted" in repr(run)


def test_what_is_kept_of_a_closed_loop_is_what_it_computes(plan, law, ctrl_c):
    plant, x0, timing = sv.plant(CRANE), plan.state(0.0), sv.Timing(substeps=1000)
    whole = sv.close(plant, law, x0, (0.0, 0.04), timing=timing)
    ctrl_c(0.3)
    part = sv.close(plant, law, x0, (0.0, 100.0), timing=timing)
    n = min(len(part.t), len(whole.t))
    np.testing.assert_array_equal(part.states[:, :n], whole.states[:, :n])
    np.testing.assert_array_equal(part.inputs[:, :n], whole.inputs[:, :n])


@pytest.mark.parametrize("compiled", [True, False])
def test_a_law_in_python_is_interrupted_and_the_loop_kept(plan, compiled, monkeypatch):
    if not compiled:
        monkeypatch.setenv("SERVOCTL_COMPILER", "none")
        monkeypatch.setattr(compiler, "_warned", True)
    plant, calls = sv.plant(CRANE), []

    def law(t, state):
        calls.append(t)
        if len(calls) == 31:
            raise KeyboardInterrupt
        return {"trolley": 0.0, "hoist": -981.0}

    run = sv.close(plant, law, plan.state(0.0), (0.0, 4.0), timing=sv.Timing(rate=100.0))
    assert run.status == 1 and len(run.t) == 30 and np.isfinite(run.states).all()


def test_an_interruption_before_the_first_sample_has_nothing_to_keep(plan):
    def law(t, state):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sv.close(sv.plant(CRANE), law, plan.state(0.0), (0.0, 1.0), timing=sv.Timing(rate=100.0))


LOOPS = {
    "plain": ({}, {}),
    "noise, delay and limits": (
        {"limits": {"trolley": 120.0}, "rate_limits": {"hoist": 2e4}},
        {"sensors": sv.Sensors(noise={"theta": 1e-4}, seed=3), "timing": sv.Timing(delay=2, substeps=5)},
    ),
    "lag and transport": (
        {"lag": {"hoist": 0.01}, "delay": {"trolley": 0.011}}, {"sensors": sv.Sensors(quantisation={"l": 1e-4})}
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", LOOPS)
@pytest.mark.parametrize("steps", [1, 3, 64])
def test_pauses_change_no_bit(plan, what, steps, monkeypatch):
    of_plant, of_loop = LOOPS[what]
    plant = sv.plant(CRANE, damping={"x": 5.0}, **of_plant)
    law = sv.lqr(plan, replace(plant, delay={}), rate=200.0, integral=True)
    given = {"disturbance": {"x": sv.disturbances.gust(20.0, 0.2, 0.4)}, **of_loop}
    whole = sv.close(plant, law, plan.state(0.0), (0.0, 1.0), **given)
    monkeypatch.setattr(loops, "FIRST_PIECE", steps)
    monkeypatch.setattr(loops, "PIECE", 0.0)
    paused = sv.close(plant, law, plan.state(0.0), (0.0, 1.0), **given)
    for name in ("t", "states", "inputs", "commands", "measurements", "controller_states"):
        np.testing.assert_array_equal(getattr(paused, name), getattr(whole, name), err_msg=name)
    assert paused.success


def test_many_loops_are_interrupted_and_the_finished_ones_kept(plan, law, ctrl_c, c_compiler, monkeypatch):
    run = sv.close(sv.plant(CRANE), law, plan.state(0.0), (0.0, 8.0), timing=sv.Timing(substeps=20))
    sv.close_many(run, {"m_load": np.linspace(90.0, 110.0, 16)})  # compiled
    loads = np.linspace(90.0, 110.0, 60_000)

    def threads(number):  # from here on the loops run
        ctrl_c(0.5)
        return ThreadPoolExecutor(number)

    with monkeypatch.context() as patched:
        patched.setattr(batch, "ThreadPoolExecutor", threads)
        many = sv.close_many(run, {"m_load": loads}, record=["theta"], every=100, executor=2)
    assert many.study.meta["interrupted"] and 0 < len(many) < len(loads)
    case = many["case"]
    np.testing.assert_array_equal(many["m_load"], loads[case])
    few = case[[0, len(case) // 2, -1]]
    again = sv.close_many(run, {"m_load": loads[few]}, record=["theta"], every=100)
    for i, at in enumerate((0, len(case) // 2, -1)):
        assert many["max |theta|"][at] == again["max |theta|"][i]
        np.testing.assert_array_equal(many.trace["theta"][:, at], again.trace["theta"][:, i])
    assert not again.study.meta["interrupted"]
