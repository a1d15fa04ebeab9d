"""Many closed loops at once: each equals `close` of its numbers, on any number of lanes and threads."""

from dataclasses import replace

import casadi as ca
import mpmath
import numpy as np
import pytest
from conftest import relative
from refusals import refused
from scenes import CRANE

import servoctl as sv
from servoctl.codegen import compiler, emit
from servoctl.control import batch
from servoctl.gallery import gallery

N = 32
GUST = sv.disturbances.gust(1.0, 1.0, 1.5)


@pytest.fixture(scope="module")
def cases():
    rng = np.random.default_rng(1)
    return {
        "m_load": rng.uniform(85.0, 115.0, N), "damping x": rng.uniform(0.0, 10.0, N),
        "theta": rng.uniform(-0.05, 0.05, N), "wind": rng.uniform(0.0, 60.0, N),
    }  # fmt: skip


def alone(plant, law, plan, cases, i, seed=None, **given):
    """One case by `close`."""
    x0 = dict(zip(CRANE.q.names + CRANE.q.jet_names(1), plan.state(0.0), strict=True)) | {"theta": cases["theta"][i]}
    changed = {"m_load": cases["m_load"][i]}
    own = sv.plant(
        CRANE, damping={"x": cases["damping x"][i]}, limits=plant.limits, rate_limits=plant.rate_limits, lag=plant.lag,
        delay=plant.delay, **changed,
    )  # fmt: skip
    wind = sv.disturbances.gust(cases["wind"][i], 1.0, 1.5)
    sensors = replace(given["sensors"], seed=seed)
    return sv.close(own, law, x0, disturbance={"x": wind}, **given | {"sensors": sensors})


LOOPS = {
    "plain": ({}, {}),
    "noise, delay and limits": (
        {"limits": {"trolley": 120.0}, "rate_limits": {"hoist": 2e4}},
        {"sensors": sv.Sensors(noise={"theta": 1e-4, "x": 1e-4}, seed=3), "timing": sv.Timing(delay=2, substeps=5)},
    ),
    "lag, transport and quantisation": (
        {"lag": {"hoist": 0.01}, "delay": {"trolley": 0.011}}, {"sensors": sv.Sensors(quantisation={"l": 1e-4})}
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", LOOPS)
def test_each_case_equals_the_loop_alone(plan, cases, what):
    of_plant, of_loop = LOOPS[what]
    plant = sv.plant(CRANE, damping={"x": 5.0}, **of_plant)
    law = sv.lqr(plan, replace(plant, delay={}), rate=200.0, integral=True)
    given = {"t_span": (0.0, 4.0), "sensors": sv.Sensors(), "timing": sv.Timing(substeps=5), **of_loop}
    seeded = bool(given["sensors"].noise)
    one = sv.close(plant, law, plan.state(0.0), disturbance={"x": GUST}, **given)
    many = sv.close_many(one, cases, scale={"x": "wind"}, record=("theta", "trolley", "residual X"), every=10)
    assert len(many) == N and not np.any(many["error"] != "")
    limited = False
    for i in range(N):
        run = alone(plant, law, plan, cases, i, int(many["seed"][i]) if seeded else None, **given)
        limited |= bool(np.any(run.active["trolley"]))
        signals = {name: run[name] for name in plant.state_names}
        signals |= {f"input {name}" if name in signals else name: run.input[name] for name in plant.inputs}
        signals |= {f"residual {name}": run.residual[name][0] for name in ("X", "Z")}
        for name, values in signals.items():
            size = np.abs(values).max()
            numbers = [many[f"max |{name}|"][i], many[f"rms {name}"][i], many[f"final {name}"][i]]
            assert np.abs(np.array(numbers) - [size, np.sqrt(np.mean(values**2)), values[-1]]).max() <= 1e-12 * max(
                size, 1
            )
        for name, trace in many.trace.items():
            assert relative(trace[:, i], signals[name][::10]) < 1e-10
    assert limited == ("limits" in of_plant)
    assert many.t == pytest.approx(run.t[::10])


def test_lanes_and_threads_do_not_change_a_case(plan, cases, monkeypatch):
    plant = sv.plant(CRANE, damping={"x": 5.0})
    law = sv.lqr(plan, plant, rate=100.0)
    sensors, timing = sv.Sensors(noise={"theta": 1e-3}, seed=7), sv.Timing(substeps=2)
    one = sv.close(
        plant, law, plan.state(0.0), (0.0, 2.0), sensors=sensors, timing=timing, disturbance={"x": GUST}
    )  # fmt: skip
    few = {name: values[:5] for name, values in cases.items()}

    def results(cases, **options):
        study = sv.close_many(one, cases, scale={"x": "wind"}, **options).study
        return np.array([study[name] for name in study.columns if name not in ("error", "message", "facts", "case")])

    everything = results(cases, executor=1)
    assert np.array_equal(results(cases, executor=3), everything)
    assert np.array_equal(results(few), everything[:, :5])
    for n in (1, 4, 8):
        monkeypatch.setattr(batch, "lanes", lambda n=n: n)
        assert results(cases) == pytest.approx(everything, rel=1e-12, abs=1e-14)


def test_without_a_compiler_the_loops_are_closed_one_by_one(plan, cases, monkeypatch):
    plant = sv.plant(CRANE, damping={"x": 5.0})
    law = sv.lqr(plan, plant, rate=100.0)
    few = {name: values[:3] for name, values in cases.items()}
    sensors = sv.Sensors(noise={"theta": 1e-3}, seed=7)
    one = sv.close(plant, law, plan.state(0.0), (0.0, 0.5), sensors=sensors, disturbance={"x": GUST})
    there = sv.close_many(one, few, scale={"x": "wind"}, record=("x",))
    monkeypatch.setattr(batch.Unit, "library", lambda self, n: None)
    alone = sv.close_many(one, few, scale={"x": "wind"}, record=("x",))
    assert list(alone.study.columns) == list(there.study.columns)
    assert alone.trace["x"] == pytest.approx(there.trace["x"], rel=1e-12)
    for name in alone.study.columns:
        if name not in ("error", "message", "facts"):
            assert alone[name] == pytest.approx(there[name], rel=1e-11, abs=1e-13), name


LAWS = {
    "computed": lambda plan, plant: sv.computed(plan, plant, rate=100.0),
    "estimating": lambda plan, plant: sv.output_feedback(sv.lqr(plan, plant, 100.0), plant, {"x": 1e-3, "l": 1e-3, "theta": 1e-3}),
}  # fmt: skip


@pytest.mark.parametrize("name", LAWS)
def test_laws_of_the_toolkit(plan, name):
    plant = sv.plant(CRANE)
    law = LAWS[name](plan, plant)
    loads = np.linspace(90.0, 110.0, 9)
    given = (law, plan.state(0.0), (0.0, 1.0))
    many = sv.close_many(sv.close(plant, *given, timing=sv.Timing(substeps=2)), {"m_load": loads})
    for i in (0, 8):
        run = sv.close(sv.plant(CRANE, m_load=loads[i]), *given, timing=sv.Timing(substeps=2))
        for state, row in zip(plant.state_names, run.states, strict=True):
            assert many[f"final {state}"][i] == pytest.approx(row[-1], rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("what", ["weights", "bounds and noise", "estimator and lag"])
def test_limited_laws_in_lanes_are_those_alone(plan, what, monkeypatch):
    lag = {"hoist": 0.02} if what == "estimator and lag" else {}
    machine = {"limits": {"trolley": 100.0}, "rate_limits": {"hoist": 2e3}, "lag": lag}
    plant, free = sv.plant(CRANE, **machine), sv.plant(CRANE)
    law, given = sv.lqr(plan, free, rate=100.0, integral=True), {}
    if what == "estimator and lag":
        law = sv.output_feedback(sv.lqr(plan, free, 100.0), free, {"x": 1e-3, "l": 1e-3, "theta": 1e-3})
    bounds = {"tension": (0.0, 1100.0)} if what == "bounds and noise" else None
    if bounds:
        given = {"sensors": sv.Sensors(noise={"theta": 1e-3}, seed=3)}
    law = sv.limited(law, sv.plant(CRANE, limits=plant.limits, rate_limits=plant.rate_limits), bounds=bounds)
    loads, span = np.linspace(90.0, 112.0, 11), (0.0, 3.0)
    timing = sv.Timing(substeps=2, delay=1)
    many = sv.close_many(
        sv.close(plant, law, plan.state(0.0), span, timing=timing, **given), {"m_load": loads}, record=["trolley"]
    )
    assert not np.any(many["error"] != "")
    active = 0
    for i in (0, 5, 10):
        seeded = {"sensors": replace(given["sensors"], seed=int(many["seed"][i]))} if given else {}
        own = sv.plant(CRANE, m_load=loads[i], **machine)
        run = sv.close(own, law, plan.state(0.0), span, timing=timing, **seeded)
        active += np.count_nonzero(run.signal["limit trolley"])
        assert relative(many.trace["trolley"][:, i], run.input["trolley"]) < 1e-8
        assert many["rms theta"][i] == pytest.approx(np.sqrt(np.mean(run["theta"] ** 2)), rel=1e-9)
    assert active > 50


def test_limits_that_no_inputs_keep_are_rows(plan):
    plant = sv.plant(CRANE, limits={"hoist": (-1150.0, -850.0)})
    law = sv.limited(sv.lqr(plan, plant, rate=100.0), plant, bounds={"tension": (850.0, 1100.0)})
    given, starts = (law, plan.state(0.0), (0.0, 0.5)), np.array([0.0, 0.0, 6.0, 0.0])
    many = sv.close_many(sv.close(plant, *given), {"dtheta": starts})
    x0 = dict(zip(plant.state_names, plan.state(0.0), strict=True)) | {"dtheta": 6.0}
    with pytest.raises(sv.errors.LimitExceeded) as caught:
        sv.close(plant, law, x0, (0.0, 0.5))
    assert many["error"].tolist() == ["", "", "LimitExceeded", ""]
    assert many["message"][2] == str(caught.value) and np.isnan(many["final x"][2])


def test_a_long_plant_is_called_not_written_into_the_steps(plan, cases, monkeypatch):
    plant = sv.plant(CRANE, damping={"x": 5.0})
    short, long = [], []
    for inlined, kept in ((batch.INLINED, short), (0, long)):
        monkeypatch.setattr(batch, "INLINED", inlined)
        one = sv.close(plant, sv.lqr(plan, plant, rate=100.0), plan.state(0.0), (0.0, 1.0))
        kept += [sv.close_many(one, {"m_load": cases["m_load"]})["max |theta|"]]
    assert long[0] == pytest.approx(short[0], rel=1e-13)


def test_any_number_of_vectors_gives_the_same(plan, cases, monkeypatch):
    plant = sv.plant(CRANE, damping={"x": 5.0}, delay={"trolley": 0.02})
    law = sv.lqr(plan, replace(plant, delay={}), rate=100.0)
    one = sv.close(plant, law, plan.state(0.0), (0.0, 1.0), timing=sv.Timing(delay=1))
    found = []
    for vectors in (1, 2, 3):
        monkeypatch.setattr(batch, "VECTORS", vectors)
        monkeypatch.setattr(batch, "_UNITS", {})
        found += [sv.close_many(one, {"m_load": cases["m_load"]}, record=["theta"], every=7)]
    for other in found[:2]:
        assert other["rms theta"] == pytest.approx(found[2]["rms theta"], rel=1e-13)
        assert other.trace["theta"] == pytest.approx(found[2].trace["theta"], rel=1e-10, abs=1e-15)


def test_lost_states_and_commands_are_dated_at_their_samples(plan):
    """Not only where lanes look whether all is finite; a lost command may leave the state finite, within a limit."""
    plant = sv.plant(CRANE, damping={"x": 1.0}, limits={"trolley": 1e4, "hoist": 1e4})
    law = sv.lqr(plan, plant, rate=100.0)
    schedule = law.schedule.copy()
    schedule[8:, 70] = 1e308  # far from the plan the command is infinite at this sample
    law = replace(law, schedule=schedule)
    span, timing = (0.0, 1.5), sv.Timing(substeps=1)
    starts, damping = np.where(np.arange(20) % 7 == 2, 100.0, 0.0), np.where(np.arange(20) % 7 == 3, 1e5, 1.0)
    one = sv.close(plant, law, plan.state(0.0), span, timing=timing)
    many = sv.close_many(one, {"x": starts, "damping x": damping}, record=["x"])
    assert [many["error"][i] for i in (0, 2, 3, 4)] == ["", "ServoError", "IntegrationStopped", ""]
    for i in (2, 3):
        x0 = dict(zip(CRANE.q.names + CRANE.q.jet_names(1), plan.state(0.0), strict=True)) | {"x": starts[i]}
        with pytest.raises(sv.errors.ServoError) as caught:
            sv.close(sv.plant(CRANE, damping={"x": damping[i]}, limits=plant.limits), law, x0, span, timing=timing)
        assert f"t = {caught.value.details['t']:.6g} s" in many["message"][i]
    assert relative(many.trace["x"][:, 0], one["x"]) < 1e-10 and np.array_equal(many.trace["x"][:, 0], many.trace["x"][:, 4])


def test_cases_keep_their_seeds_when_there_are_more(plan):
    plant = sv.plant(CRANE)
    pd = sv.pd(plan, plant, rate=50.0, kp={"trolley": 100.0, "hoist": 100.0}, kd={"trolley": 50.0, "hoist": 50.0})
    one = sv.close(plant, pd, plan.state(0.0), (0.0, 0.1), sensors=sv.Sensors(noise={"x": 1e-3}, seed=4))
    seeds = [sv.close_many(one, {"m_load": np.full(n, 100.0)})["seed"] for n in (3, 9)]
    assert np.array_equal(seeds[0], seeds[1][:3]) and len(set(seeds[1])) == 9
    study = sv.sweep(lambda m, rng: {"first": float(rng.integers(2**31))}, {"m": [1.0, 2.0, 3.0]}, seed=4)
    assert np.array_equal(study["first"], seeds[0])


def test_a_loop_that_diverges_is_a_row_and_disturbs_no_other(plan):
    plant = sv.plant(CRANE, damping={"x": 1.0})
    law = sv.lqr(plan, plant, rate=100.0)
    damping = np.full(9, 1.0)
    damping[4] = 1e5  # steps of 10 ms are far too long for it
    given = (law, plan.state(0.0), (0.0, 8.0))
    many = sv.close_many(sv.close(plant, *given, timing=sv.Timing(substeps=1)), {"damping x": damping})
    with pytest.raises(sv.errors.IntegrationStopped) as caught:
        sv.close(sv.plant(CRANE, damping={"x": 1e5}), *given, timing=sv.Timing(substeps=1))
    assert many["error"].tolist() == [""] * 4 + ["IntegrationStopped"] + [""] * 4
    assert f"t = {caught.value.details['t']:.6g} s" in many["message"][4]
    assert np.isnan(many["final x"][4]) and np.ptp(np.delete(many["final x"], 4)) == 0


@pytest.mark.parametrize("name", ["overhead-crane-redundant", "wheeled-robot"])
def test_material_constraints_are_held(name):
    mechanism, program = gallery[name].build()
    model = sv.derive(mechanism, program)
    scene = gallery[name]
    plan = sv.simulate(model, model.start(guess=scene.guess, **scene.start), (0.0, 1.0))
    plant = sv.plant(mechanism)
    law = sv.lqr(plan, plant, rate=100.0)
    parameter = next(n for n in mechanism.parameters.names if n.startswith("m"))
    values = mechanism.parameters.defaults[parameter] * np.linspace(0.9, 1.1, 9)
    given = (law, plan.state(0.0), (0.0, 1.0))
    many = sv.close_many(sv.close(plant, *given, timing=sv.Timing(substeps=2)), {parameter: values})
    for i in (0, 8):
        own = sv.plant(mechanism, **{parameter: values[i]})
        run = sv.close(own, *given, timing=sv.Timing(substeps=2))
        for row, state in zip(run.states, plant.state_names, strict=True):
            assert many[f"max |{state}|"][i] == pytest.approx(np.abs(row).max(), rel=1e-11, abs=1e-13)


def test_the_steps_are_those_of_the_case_that_needs_most(plan):
    plant = sv.plant(CRANE, damping={"x": 5.0})
    law = sv.feedforward(plan, plant, rate=50.0)
    given = (law, plan.state(0.0), (0.0, 0.1))
    many = sv.close_many(sv.close(plant, *given), {"damping x": [1.0, 900.0]})
    alone = [sv.close(sv.plant(CRANE, damping={"x": c}), *given).loop.substeps for c in (1.0, 900.0)]
    assert alone[0] < alone[1] == many.study.meta["substeps"]


@pytest.mark.skipif(compiler.compiler() is None, reason="needs a compiler")
@pytest.mark.parametrize("n", [1, 4, 8])
def test_sine_and_cosine_of_the_lanes_are_within_two_units(n):
    import ctypes

    rng = np.random.default_rng(4)
    near = np.arange(-40, 41) * np.pi / 2
    a = np.concatenate(
        [rng.uniform(-1e5, 1e5, 400), rng.uniform(-4, 4, 200), near, np.nextafter(near, 1e9), [1e5, -3e7, 1e22, 0.0]]
    )
    a = np.resize(a, -(-len(a) // 8) * 8)
    x = ca.SX.sym("x", 1)
    f = ca.Function("f", [ca.SX.sym("t"), x, ca.SX(0, 1)], [ca.vertcat(ca.sin(x), ca.cos(x))])
    unit = f"#define W_LANES {n}\n{emit.unit({'NAME': 'sines'})}{emit.include('lanes.h')}"
    text = unit + emit.function(f, "circular", emit.LANES) + (
        "void all(int64_t n, const double *a, double *y)\n{\n    for (int64_t k = 0; k < n; k += W_LANES) {\n"
        "        W v[2], w = *(const U *)(a + k);\n        circular(w, &w, &w, v);\n"
        "        *(U *)(y + k) = v[0];\n        *(U *)(y + n + k) = v[1];\n    }\n}\n"
    )
    library = compiler.library(text, level="-O3")
    y = np.empty((2, len(a)))
    library.all(ctypes.c_int64(len(a)), *(ctypes.c_void_p(array.ctypes.data) for array in (a, y)))
    with mpmath.workdps(60):
        exact = np.array([[float(f(mpmath.mpf(float(v)))) for v in a] for f in (mpmath.sin, mpmath.cos)])
    np.testing.assert_array_max_ulp(y, exact, maxulp=2)


# bad input ------------------------------------------------------------------------------------------------------------


def test_laws_in_python_are_sent_to_sweep(plan):
    plant = sv.plant(CRANE)
    one = sv.close(plant, lambda t, y: [0.0, -981.0], plan.state(0.0), (0.0, 0.1), timing=sv.Timing(rate=50.0))
    with refused(sv.errors.SpecificationError, "sv.sweep"):
        sv.close_many(one, {"m_load": [100.0]})
    with refused(sv.errors.SpecificationError, "Closed"):
        sv.close_many(plan, {"m_load": [100.0]})


BAD = {
    "unknown column": (sv.errors.NameUnknown, {"mload": [1.0]}, {}, {"match": "m_load"}),
    "other lengths": (sv.errors.SpecificationError, {"m_load": [1.0, 2.0], "theta": [0.0]}, {}, "cases"),
    "a negative mass": (sv.errors.SpecificationError, {"m_load": [90.0, -90.0, 110.0]}, {}, "m_load = -90"),
    "a truth value": (sv.errors.SpecificationError, {"m_load": [90.0, True]}, {}, "cases"),
    "texts": (sv.errors.SpecificationError, {"m_load": ["90.0"]}, {}, "cases"),
    "not finite": (sv.errors.SpecificationError, {"m_load": [np.nan]}, {}, {"name": "m_load"}),
    "no case": (sv.errors.SpecificationError, {}, {}, {"cases": 0}),
    "empty columns": (sv.errors.SpecificationError, {"m_load": []}, {}, {"name": "m_load"}),
    "every without traces": (sv.errors.SpecificationError, {"m_load": [100.0]}, {"every": 5}, "every=5"),
    "a name alone": (sv.errors.SpecificationError, {"m_load": [100.0]}, {"record": "theta"}, "record='theta'"),
    "scale of no disturbance": (sv.errors.NameUnknown, {"m_load": [1.0]}, {"scale": {"x": "m_load"}}, {"name": "x"}),
    "scale without its column": (sv.errors.NameUnknown, {"m_load": [1.0]}, {"scale": {"theta": "w"}}, {"name": "w"}),
    "trace of nothing": (sv.errors.NameUnknown, {"m_load": [100.0]}, {"record": ("thet",)}, {"match": "theta"}),
    "every": (sv.errors.SpecificationError, {"m_load": [100.0]}, {"record": ("theta",), "every": 0}, "every=0"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_refused(plan, what):
    kind, cases, given, fact = BAD[what]
    plant = sv.plant(CRANE)
    law = sv.lqr(plan, plant, rate=50.0)
    one = sv.close(plant, law, plan.state(0.0), (0.0, 0.2), disturbance={"theta": 1.0})
    with refused(kind, fact):
        sv.close_many(one, cases, **given)


def test_starts_off_the_constraints_are_refused():
    mechanism, program = gallery["overhead-crane-redundant"].build()
    scene = gallery["overhead-crane-redundant"]
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(guess=scene.guess, **scene.start), (0.0, 1.0))
    plant = sv.plant(mechanism)
    law = sv.lqr(plan, plant, rate=100.0)
    name = plant.state_names[0]
    start = plan.state(0.0)[0]
    one = sv.close(plant, law, plan.state(0.0), (0.0, 0.1))
    with refused(sv.errors.InconsistentStart, case=1):
        sv.close_many(one, {name: [start, start + 0.1]})
