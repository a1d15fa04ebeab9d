"""Options of simulations and studies that make no sense: each is refused with what is wrong, before anything runs."""

import numpy as np
import pytest
from refusals import refused, warned
from scenes import POINT, POINT_PROGRAM

import servoctl as sv
from benchmarks.literature import dae_comparison, formulation_cost
from benchmarks.literature.guided_arm import guided_arm
from servoctl.methods.choice import as_method
from servoctl.study import tradeoff as module

ADAPTIVE = ("Taylor", "RadauIIA", "DOP853", "Radau", "LSODA")
SPAN = (0.0, 0.2)


@pytest.fixture(scope="module")
def scene(wheel):
    return wheel


def _point():
    model = sv.derive(POINT, POINT_PROGRAM)
    return model, model.start(), (0.0, 1.0)


def stopped(fact, make):
    with refused(sv.errors.SpecificationError, fact):
        make()


@pytest.mark.parametrize("method", ADAPTIVE)
@pytest.mark.parametrize("name", ["rtol", "atol"])
def test_tolerances(method, name, scene):
    for value in (0.0, 1e-300, -1e-6, np.nan, np.inf, 2.0, "1e-6", [1e-6], True):
        stopped(f"{name}=", lambda value=value: sv.simulate(*scene, SPAN, method=as_method(method, **{name: value})))


@pytest.mark.parametrize("method", ["RK4", "RadauIIA"])
def test_steps(method, scene):
    for value in (0, -1, np.nan, np.inf, "a", True, 1e-320, 1e-10):
        stopped("step=", lambda value=value: sv.simulate(*scene, SPAN, method=as_method(method, step=value)))
    run = sv.simulate(*scene, SPAN, method=as_method(method, step=np.float32(0.05)))
    assert run.success and run.counters["steps"] == 4


@pytest.mark.parametrize("times", ["a", ["a"], [np.nan, 0.1], [0.0, np.inf], [None], {"t": 1}])
def test_times_of_samples(times, scene):
    stopped("t_eval=", lambda: sv.simulate(*scene, SPAN, t_eval=times))


@pytest.mark.parametrize("span", [(0.0, 0.2), (0.2, 0.0), (3e4, 3e4 + 0.2)])
@pytest.mark.parametrize("method", [*ADAPTIVE, "RK4"])
def test_times_of_samples_that_rounding_puts_beyond_the_span_are_its_ends(method, span, scene):
    model, x = scene[0], scene[1].values
    ends = [np.nextafter(span[0], 2 * span[0] - span[1]), np.nextafter(span[1], 2 * span[1] - span[0])]
    run = sv.simulate(model, x, span, method, t_eval=[ends[0], np.mean(span), ends[1]])
    assert run.t.tolist() == [span[0], np.mean(span), span[1]]
    assert sv.simulate_many(model, x, None, span, method, t_eval=[*ends, span[1]], executor=1).t.tolist() == [*span]


def test_whole_numbers(scene):
    for options in ({"order": True}, {"order": 5.0}, {"order": "a"}, {"jets": True}, {"jets": 2.5}):
        stopped(next(iter(options)), lambda options=options: sv.simulate(*scene, SPAN, method=sv.methods.Taylor(**options)))
    run = sv.simulate(*scene, SPAN, method=sv.methods.Taylor(order=np.int64(8), jets=np.int64(3)), t_eval=[0.0, 0.2])
    assert "d3theta" in run.names
    for every in (True, 0, 1.0):
        stopped("every", lambda every=every: sv.methods.Project(every))
    stopped("True", lambda: sv.methods.Poles(True))


def test_what_a_study_is_asked_for(scene):
    for options in ({"methods": []}, {"drift": []}):
        refused_study = {"methods": ["RK4"], "drift": [None]} | options
        with refused(sv.errors.SpecificationError, "methods", "drift"):
            sv.tradeoff(*scene, SPAN, **refused_study)
    study = sv.tradeoff(*scene, SPAN, {"RK4": 0.1}, sv.methods.Project(2))
    assert study["drift"].tolist() == ["project 2"]
    for options in ({"error": 0}, {"error": "a"}, {"seconds": -1.0}, {"error": np.nan}):
        stopped(next(iter(options)), lambda options=options: study.recommend(**options))


def test_ctrl_c_ends_a_study_and_keeps_its_rows(scene, monkeypatch):
    real = module.simulated

    def interrupted(*given, **options):
        if given[3] == sv.methods.RungeKutta(4, step=0.02):

            def stop(t):
                raise KeyboardInterrupt

            options["progress"] = stop
        return real(*given, **options)

    monkeypatch.setattr(module, "simulated", interrupted)
    study = sv.tradeoff(*scene, SPAN, dict.fromkeys(("RK4", "RK8"), [0.1, 0.05, 0.02]), [None])
    assert study.where(method="RK4")["value"].tolist() == [0.1, 0.05] and 0.1 in study.where(method="RK8")["value"]
    assert np.all(np.isfinite(study["error"])) and study.meta["message"] == "interrupted"
    assert "interrupted" in repr(study).splitlines()[0]


def test_what_comparisons_are_asked_for(gallery_model):
    model = gallery_model("two-cars")
    start = model.start()
    for options in ({"steps": "a"}, {"steps": []}, {"steps": [np.nan]}, {"steps": [1e-300]}, {"steps": [2.0]}):
        stopped("steps=", lambda options=options: dae_comparison(model, start, (0.0, 1.0), **options))
    stopped("t_span=", lambda: dae_comparison(model, start, (0.0,)))
    with refused(sv.errors.SpecificationError, "t_span=(1.0, 0.0)"):
        dae_comparison(model, model.start(t=1.0), (1.0, 0.0), steps=[0.1])
    with refused(sv.errors.SpecificationError, "forms=[]"):
        dae_comparison(model, start, (0.0, 1.0), forms=[])
    for cases in ([], [3], [("a", 1)]):
        stopped("cases=", lambda cases=cases: formulation_cost(guided_arm, cases))


def test_what_a_stability_map_is_asked_for(scene):
    model, start = scene
    with refused(sv.errors.SpecificationError, "run=None"):
        sv.stability(model, None)
    found = sv.stability(model, sv.simulate(model, start, SPAN, method=sv.methods.RungeKutta(4, step=0.01)))
    for step in (0.0, -1.0, np.nan, [0.1, 0.0]):
        stopped("step=", lambda step=step: found.radius("RK4", step))


@pytest.mark.parametrize("method", ["RK4", "DOP853", "RadauIIA"])
def test_error_dynamics_backwards_in_time(method, scene):
    model, start = scene
    end = sv.simulate(model, start, SPAN, method=sv.methods.Taylor(rtol=1e-13, atol=1e-15), drift="project")
    there = end.jets[: len(start.values), -1]
    with refused(sv.errors.SpecificationError, "'project'", row="x_c"):
        sv.simulate(model, there, SPAN[::-1], method=method, drift=0.05)
    growing = sv.methods.Poles({row: [20.0] * count for row, count in model.reduction.raised.items() if count})
    back = sv.simulate(model, there, SPAN[::-1], method=method, drift=growing)
    assert back.jets[: len(there), -1] == pytest.approx(start.values, abs=1e-7)


# --- poles, tolerances of scipy's methods, starts of studies


def test_poles_by_row_are_finite_numbers_that_damp(scene):
    for poles in ([np.nan, -1.0], ["a", "b"], "ab", None, [[-1.0, -1.0]]):
        stopped("'string'", lambda poles=poles: sv.simulate(*scene, SPAN, drift=sv.methods.Poles({"string": poles})))
    stopped("no row", lambda: sv.methods.Poles({}))
    with refused(sv.errors.SpecificationError, row="string"):
        sv.simulate(*scene, SPAN, drift=sv.methods.Poles({"string": [1.0, -2.0]}))


@pytest.mark.parametrize("method", ["RK45", "DOP853"])
def test_poles_that_take_an_explicit_method_a_million_steps_are_told(method, scene):
    def ended(t):
        raise TimeoutError

    with warned("-1e+08 1/s", method):
        with pytest.raises(TimeoutError):
            sv.simulate(*scene, SPAN, method=method, drift=1e-8, progress=ended)


def test_tolerances_that_scipy_would_replace_are_refused(scene):
    for method in ("RK45", "DOP853", "Radau"):
        with refused(sv.errors.SpecificationError, "rtol=1e-15", "2.22e-14"):
            sv.simulate(*scene, SPAN, method=as_method(method, rtol=1e-15))
    assert sv.simulate(*scene, SPAN, method=sv.methods.Taylor(rtol=1e-15)).success
    stopped("at most 1", lambda: sv.tradeoff(*scene, SPAN, {"DOP853": [10.0, 1e-6]}, [None]))


def test_studies_refuse_a_start_off_the_constraints(scene):
    model, start = scene
    off = start.values + 1e-3
    with pytest.raises(sv.errors.InconsistentStart):
        sv.tradeoff(model, off, SPAN, ["Taylor"], ["project"])
    with pytest.raises(sv.errors.InconsistentStart):
        dae_comparison(model, off, SPAN, steps=[0.1])


def test_a_comparison_of_one_form_and_method(scene):
    found = dae_comparison(*scene, SPAN, [0.1], "projected", "BE")
    assert [(row["form"], row["method"]) for row in found.rows()] == [("projected", "BE")]


def test_what_a_figure_of_stability_is_asked_for(scene):
    found = sv.stability(scene[0], sv.simulate(*scene, SPAN, method=sv.methods.RungeKutta(4, step=0.01)))
    for poles in ("abc", 10.0, [10.0], [-1.0, 2.0], [np.nan, 1.0]):
        stopped("poles=", lambda poles=poles: found.plot("RK4", poles))
    stopped("step=", lambda: found.growth("RK4", "abc"))
    left, right = found.plot("RK4", [100.0, 10.0]).axes[:2]
    assert list(left.lines[0].get_xdata()) == list(right.lines[0].get_xdata()) == [10.0, 100.0]


@pytest.mark.parametrize("count", [2**63 + 10**6, 2**64, 1e300, 10**400, 10**9 + 1], ids=["2**63", "2**64", "1e300", "10**400", "1e9"])
def test_counts_stay_within_what_the_loops_can_hold(count):
    """Counts enter C as 64 bits: beyond them a loop would end the process, or do something else in silence."""
    for name in ("delay", "substeps"):
        with refused(sv.errors.SpecificationError, name):
            sv.Timing(**{name: count})
    plan = sv.simulate(*_point())
    run = sv.close(sv.plant(POINT), sv.feedforward(plan, sv.plant(POINT), rate=50.0), plan.state(0.0), (0.0, 0.2))
    with refused(sv.errors.SpecificationError, "every"):
        sv.close_many(run, {"m": [2.0]}, record=["x"], every=count)
    with refused(sv.errors.SpecificationError, "integration steps", samples=20, substeps=10**9):
        law = sv.feedforward(plan, sv.plant(POINT), rate=50.0)
        sv.close(sv.plant(POINT), law, plan.state(0.0), (0.0, 0.4), timing=sv.Timing(substeps=10**9))


def test_values_of_a_call_hash_like_they_compare():
    pairs = [
        (sv.methods.Poles({"X": [-5.0, -6.0]}), sv.methods.Poles({"X": [-5.0, -6.0]}), sv.methods.Poles({"X": [-5.0, -7.0]})),
        (sv.methods.Poles(0.1), sv.methods.Poles(0.1), sv.methods.Poles(0.2)),
        (sv.Sensors({"x": 1e-3}, seed=1), sv.Sensors({"x": 1e-3}, seed=1), sv.Sensors({"x": 1e-3}, seed=2)),
        (sv.Timing(100.0, 1), sv.Timing(100.0, 1), sv.Timing(100.0, 2)),
    ]
    for first, same, other in pairs:
        assert first == same and hash(first) == hash(same) and len({first, same, other}) == 2
