"""Many motions at once: equal to `simulate` case by case, failures as rows, and what does not fit the lanes."""

import pickle
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from threading import Thread

import casadi as ca
import numpy as np
import pytest
from conftest import derived_alike  # workers compile as tests do
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, ServoError, SpecificationError
from servoctl.gallery import gallery
from servoctl.methods import lanes
from servoctl.model.full import affirmed
from servoctl.simulation import simulated

SEED = 4


def pendulum(force=lambda a, t, p: 0.0):
    """A pendulum of length 1 under a force, on a cart that its program holds."""
    q = sv.coordinates("x a")
    x, a = q
    p = sv.parameters(m=1.0, g=9.81, k=0.5)
    S = sv.particle(q, p.m, (x + ca.sin(a), -ca.cos(a)))
    forces = {"a": force(a, q.t, p)}
    potential = -p.m * p.g * ca.cos(a)
    mechanism = sv.Mechanism(q, gibbs=S, potential=potential, forces=forces, actuators={"F": x}, parameters=p)
    return sv.derive(mechanism, sv.Program({"rest": x}))


def each_equals_simulate(model, many, start, span, method, rtol=1e-12):
    """Every case, its traces and its number of steps are those of `simulate`."""
    names = [name for name in model.numbers if name in many.study.columns]
    for i, row in enumerate(many.study.rows()):
        one = model.with_parameters(**{name: row[name] for name in names})
        x0 = start(i, one) if callable(start) else start
        run = simulated(one, x0, span, method, t_eval=np.union1d(many.t, span[1])[:: 1 if span[1] > span[0] else -1])
        assert row["error"] == "" and row["steps"] == run.counters["steps"]
        for name in model.state_names:
            size = np.abs(run[name]).max() + 1e-300
            assert row[f"final {name}"] == pytest.approx(run[name][-1], abs=rtol * size)
            if len(many.t):
                np.testing.assert_allclose(many.trace[name][:, i], run[name][np.isin(run.t, many.t)], atol=rtol * size)


def in_lanes(monkeypatch):
    """Forbid the ordinary method."""
    def refuse(*_, **__):
        raise AssertionError("a case left the lanes")

    monkeypatch.setattr("servoctl.study.many.simulated", refuse)


@pytest.mark.parametrize("span", [(0.0, 2.0), (1.0, -0.5)])
def test_parameters_in_lanes_equal_simulate(span, gallery_model, monkeypatch, c_compiler):
    scene, model = gallery["appell-hamel"], gallery_model("appell-hamel")
    start = model.start(t=span[0], **scene.start, guess=scene.guess)
    values = model.numbers["M"] * np.random.default_rng(SEED).uniform(0.8, 1.2, 11)
    assert lanes.fits(model)
    with monkeypatch.context() as patch:
        in_lanes(patch)
        many = sv.simulate_many(model, start, {"M": values}, span, t_eval=np.linspace(*span, 7), executor=2)
    each_equals_simulate(model, many, start, span, sv.methods.Taylor())


@pytest.mark.parametrize("method", [sv.methods.Taylor(), sv.methods.Taylor(8, rtol=1e-5, atol=1e-7), sv.methods.Taylor(jets=9, rtol=1e-10, atol=1e-12)])
def test_starts_by_name_and_by_state_equal_simulate(method, monkeypatch, c_compiler):
    model = pendulum()
    angles = np.append(np.random.default_rng(SEED).uniform(-3, 3, 9), [0.0, np.pi])
    with monkeypatch.context() as patch:
        in_lanes(patch)
        many = sv.simulate_many(model, {"a": angles, "da": 0.1}, None, (0.0, 3.0), method)
        states = np.array([model.start(a=a, da=0.1).values for a in angles]).T
        again = sv.simulate_many(model, states, None, (0.0, 3.0), method, executor=1)
    assert np.array_equal(many["final a"], again["final a"])
    each_equals_simulate(model, many, lambda i, one: one.start(a=angles[i], da=0.1), (0.0, 3.0), method)


def test_starts_by_name_follow_for_all_cases_at_once(gallery_model, monkeypatch, c_compiler):
    """They are those of `Model.start`, without a call of it where the held values leave a linear problem."""
    scene, wheel = gallery["appell-hamel"], gallery_model("appell-hamel")
    crane, n = gallery_model("overhead-crane"), 5
    held = {name: value + 0.1 * np.arange(n) for name, value in scene.start.items()}
    parameters = {"b": wheel.numbers["b"] * np.linspace(0.5, 2.0, n)}
    expected = [
        wheel.with_parameters(b=b).start(**{name: v[i] for name, v in held.items()}).values
        for i, b in enumerate(parameters["b"])
    ]
    nearest = crane.start().values
    monkeypatch.setattr("servoctl.model.model.Model.start", lambda *_, **__: pytest.fail("a start by itself"))
    many = sv.simulate_many(wheel, held, parameters, (0.0, 0.1), t_eval=[0.0])
    found = np.array([many.trace[name][0] for name in wheel.state_names]).T
    np.testing.assert_allclose(found, expected, atol=1e-13)
    monkeypatch.undo()
    many = sv.simulate_many(crane, {}, {"m_load": [90.0, 110.0]}, (0.0, 0.1), t_eval=[0.0])
    np.testing.assert_allclose([many.trace[name][0, 1] for name in crane.state_names], nearest, atol=1e-13)


def test_starts_with_several_solutions_are_those_of_start(monkeypatch):
    """The angle of a rod whose height is given has two: each case takes the one that `Model.start` names."""
    model = held_pendulum(lambda q, p: ca.sin(p.f * q.t))
    many = sv.simulate_many(model, {}, {"r": [1.0, 1.5]}, (0.0, 0.2), t_eval=[0.0])
    for i, r in enumerate((1.0, 1.5)):
        assert many.trace["a"][0, i] == pytest.approx(model.with_parameters(r=r).start()["a"], abs=1e-12)


def test_a_case_depends_neither_on_others_nor_on_threads(c_compiler):
    model = pendulum()
    angles = np.random.default_rng(SEED).uniform(-3, 3, 300)
    all_ = sv.simulate_many(model, {"a": angles, "da": 0.0}, None, (0.0, 1.0), executor=2)
    some = sv.simulate_many(model, {"a": angles[100:103], "da": 0.0}, None, (0.0, 1.0), executor=1)
    assert np.array_equal(all_["final a"][100:103], some["final a"])


@pytest.mark.parametrize("quick", [0.0, 1e5, 4e5, lanes.IN_CALLER])
@pytest.mark.parametrize("n", [1, 3, 8, 1000])
def test_what_the_calling_thread_leaves_others_compute(quick, n, monkeypatch, c_compiler):
    """Short work starts no thread; of long work the cases that were begun are computed again, to the same bits."""
    started, angles = [], np.random.default_rng(SEED).uniform(-3, 3, n)
    problems = [(pendulum(), {"a": angles, "da": 0.0}, None, (0.0, 1.0)),
                (held_pendulum(lambda q, p: ca.sin(p.f * q.t)), {"a": 0.9}, {"f": angles}, (0.0, 1.0))]  # fmt: skip
    problems[1] = (problems[1][0], problems[1][0].start(guess={"a": 0.9}), *problems[1][2:])
    expected = [sv.simulate_many(*problem, t_eval=[0.3, 0.9]) for problem in problems]
    most = lanes.IN_CALLER
    monkeypatch.setattr(lanes, "IN_CALLER", quick)
    monkeypatch.setattr(lanes, "Thread", lambda **_: started.append(1) or Thread(**_))
    in_lanes(monkeypatch)
    for problem, result in zip(problems, expected, strict=True):
        same_motions(sv.simulate_many(*problem, t_eval=[0.3, 0.9], executor=3), result)
    assert bool(started) == (quick < most and (n == 1000 or quick == 0))


@pytest.mark.parametrize(
    "force",
    [
        lambda a, t, p: ca.exp(-((100 * (a - 1.0)) ** 2)),  # a bump that no series sees from afar
        lambda a, t, p: p.k * ca.tanh(50 * a),
        lambda a, t, p: p.k * 1e-4 / (a**2 + 1e-4),
        lambda a, t, p: p.k * ca.sqrt(a**2 + 1e-6),
        lambda a, t, p: -p.k * ca.fabs(a),
        lambda a, t, p: p.k * ca.sin(t),
    ],
)
def test_what_a_step_may_hide_does_not_fit_into_lanes(force):
    assert not lanes.fits(pendulum(force))


def test_what_a_step_may_hide_stays_out_of_the_lanes():
    model = pendulum(lambda a, t, p: ca.exp(-((100 * (a - 1.0)) ** 2)))
    many = sv.simulate_many(model, {"a": [0.4, 1.3], "da": 0.0}, {"k": [0.5, 0.7]}, (0.0, 1.0), t_eval=[0.5])
    angles = [0.4, 1.3]
    each_equals_simulate(model, many, lambda i, one: one.start(a=angles[i], da=0.0), (0.0, 1.0), sv.methods.Taylor())


@pytest.mark.parametrize("force", [lambda a, t, p: -p.k * a**3, lambda a, t, p: p.k * ca.sin(3 * a) * a + ca.exp(p.k)])
def test_polynomials_and_functions_of_parameters_fit(force):
    assert lanes.fits(pendulum(force))


def test_singular_programs_are_rows_among_others():
    """A squared constraint of the gallery: its gradient vanishes on the way, and `simulate` says so."""
    scene = gallery["constant-speed-horizontal"]
    model = sv.derive(*scene.build())
    start = model.start(**scene.start, guess=scene.guess)
    with pytest.raises(sv.errors.SingularProgram) as caught:
        simulated(model, start, (0.0, 10.0), sv.methods.Taylor())
    many = sv.simulate_many(model, start, {"m": [model.numbers["m"]] * 3}, (0.0, 10.0))
    assert list(many["error"]) == ["SingularProgram"] * 3 and np.isnan(many["steps"]).all()
    assert many["message"][0] == str(caught.value)


def test_starts_that_violate_the_program_are_rows(gallery_model):
    scene, model = gallery["appell-hamel"], gallery_model("appell-hamel")
    good = model.start(**scene.start, guess=scene.guess).values
    bad = good.copy()
    bad[model.state_names.index("dx")] += 0.5
    many = sv.simulate_many(model, np.array([good, bad, good]).T, None, (0.0, 0.5))
    assert list(many["error"]) == ["", "InconsistentStart", ""]
    assert many["final x"][0] == many["final x"][2] and np.isnan(many["final x"][1])


def test_other_ranks_leave_the_lanes():
    """With k = 0 the force of a spring vanishes, and nothing else; a mass that is negative is a row."""
    model = pendulum(lambda a, t, p: -p.k * a)
    many = sv.simulate_many(model, {"a": 0.3, "da": 0.0}, {"k": [0.5, 0.0], "m": [1.0, -1.0]}, (0.0, 0.5))
    assert many["error"][0] == "" and many["error"][1] == "SpecificationError"


def test_small_and_large_motions_take_the_tolerances_of_simulate(c_compiler):
    model = pendulum(lambda a, t, p: -p.k * a)
    angles = np.array([1e-9, 1e-3, 1.0, 0.0])
    many = sv.simulate_many(model, {"a": angles, "da": 0.0}, None, (0.0, 2.0))
    each_equals_simulate(model, many, lambda i, one: one.start(a=angles[i], da=0.0), (0.0, 2.0), sv.methods.Taylor())


def test_other_methods_run_one_by_one(gallery_model):
    scene, model = gallery["appell-hamel"], gallery_model("appell-hamel")
    start = model.start(**scene.start, guess=scene.guess)
    values = model.numbers["M"] * np.array([0.9, 1.1])
    many = sv.simulate_many(model, start, {"M": values}, (0.0, 0.5), "RK4", t_eval=[0.0, 0.5])
    for i, value in enumerate(values):
        run = sv.simulate(model.with_parameters(M=value), start, (0.0, 0.5), "RK4", t_eval=[0.0, 0.5])
        assert many.trace["x"][:, i] == pytest.approx(run["x"], abs=1e-12)


@pytest.mark.parametrize(
    ("name", "span"),
    [("overhead-crane", (0.0, 6.0)), ("overhead-crane", (4.0, 1.0)), ("crane-3d", (0.0, 2.0)), ("two-cars", (0.0, 2.0)),
     ("winch-crane-redundant", (0.5, 2.0))],
)
def test_plans_over_parameters_equal_simulate(name, span, gallery_model, monkeypatch, c_compiler):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(t=span[0], **scene.start, guess=scene.guess)
    parameters = {p: model.numbers[p] * np.array([0.9, 1.0, 1.2]) for p in [*model.numbers][:2]}
    assert lanes.plans_fit(model)
    with monkeypatch.context() as patch:
        in_lanes(patch)
        many = sv.simulate_many(model, start, parameters, span, t_eval=np.linspace(*span, 11), executor=2)
        final = sv.simulate_many(model, start, parameters, span)
    each_equals_simulate(model, many, start, span, None)
    name = f"final {model.state_names[0]}"
    np.testing.assert_allclose(many[name], final[name], rtol=1e-12)


def held_pendulum(path, quasi=False, height=lambda t: 0.5 + 0.1 * ca.cos(t)):
    """A pendulum of length r on a trolley; its place and height are programmed."""
    q = sv.coordinates("x a")
    x, a = q
    p = sv.parameters(m=1.0, r=1.0, g=9.81, T=2.0, f=1.0)
    if quasi:
        q = q.with_quasi_velocities("u w", [[1, ca.cos(a)], [0, 1]])
    S = sv.particle(q, 1.0, (x,)) + sv.particle(q, p.m, (x + p.r * ca.sin(a), -p.r * ca.cos(a)))
    potential = -p.m * p.g * p.r * ca.cos(a)
    mechanism = sv.Mechanism(q, gibbs=S, potential=potential, actuators={"F": x, "M": a}, parameters=p)
    height = p.r * ca.cos(a) - height(q.t)
    return sv.derive(mechanism, sv.Program({"place": x + p.r * ca.sin(a) - path(q, p), "height": height}))


@pytest.mark.parametrize("quasi", [False, True])
def test_plans_whose_motion_depends_on_parameters(quasi, monkeypatch, c_compiler):
    """r cos a = 0.5 + 0.1 cos t, x = sin(f t) - r sin a."""
    model = held_pendulum(lambda q, p: ca.sin(p.f * q.t), quasi)
    start = model.start(guess={"a": 0.9})
    r, f = np.linspace(0.7, 2.0, 9), np.linspace(0.5, 3.0, 9)
    with monkeypatch.context() as patch:
        in_lanes(patch)
        many = sv.simulate_many(model, start, {"r": r, "f": f}, (0.0, 2.0), t_eval=[0.3, 1.7])
    t = np.array([[0.3], [1.7]])
    a = np.arccos((0.5 + 0.1 * np.cos(t)) / r)
    np.testing.assert_allclose(many.trace["a"], a, atol=1e-12)
    np.testing.assert_allclose(many.trace["x"], np.sin(f * t) - r * np.sin(a), atol=1e-12)
    a = np.arccos((0.5 + 0.1 * np.cos(2.0)) / r)
    da = 0.1 * np.sin(2.0) / (r * np.sin(a))
    np.testing.assert_allclose(many["final w" if quasi else "final da"], da, atol=1e-11)
    dx = f * np.cos(2 * f) - r * np.cos(a) * da
    np.testing.assert_allclose(many["final u"] + np.cos(a) * da if quasi else many["final dx"], dx, atol=1e-11)


@pytest.mark.parametrize("height", [lambda t: 0.6, lambda t: 0.6 + 1e-12 * ca.sin(t), lambda t: 0.6 + 0.1 * ca.sin(t)])
@pytest.mark.parametrize("quasi", [False, True])
def test_what_stays_constant_keeps_the_derivation(height, quasi):
    """Velocities that a program keeps at zero are rounding at all points, and no reason to derive again."""
    model = held_pendulum(lambda q, p: ca.sin(p.f * q.t), quasi, height)
    values = model.parameters.copy()
    values[[*model.numbers].index("r")] = 1.3
    assert affirmed(model, values[:, None]).all() and derived_alike(model, values)
    assert model.with_parameters(r=1.3).reduction is model.reduction
    with refused(SpecificationError):
        model.with_parameters(m=-1.0)


def test_plans_with_other_knots_and_without_solutions():
    """Paths of other durations leave the compiled plans, and where the rod is too short there is no plan."""
    model = held_pendulum(lambda q, p: q.references(place=sv.paths.rest_to_rest(0.0, 1.0, duration=p.T)).place)
    start = model.start(guess={"a": 0.9})
    many = sv.simulate_many(model, start, {"T": [2.0, 1.0, 2.0], "r": [1.0, 1.0, 0.5]}, (0.0, 1.5), t_eval=[0.8])
    assert list(many["error"] != "") == [False, False, True]
    for i, T in enumerate((2.0, 1.0)):
        run = simulated(model.with_parameters(T=T), start, (0.0, 1.5), t_eval=[0.8, 1.5])
        assert many.trace["x"][0, i] == pytest.approx(run["x"][0], abs=1e-12)
        assert many["final x"][i] == pytest.approx(run["x"][1], abs=1e-12)


def test_an_interrupt_leaves_the_finished_cases(monkeypatch):
    model = pendulum(lambda a, t, p: p.k * ca.sin(t))
    calls = []

    def stops(*arguments, **options):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return simulated(*arguments, **options)

    monkeypatch.setattr("servoctl.study.many.simulated", stops)
    many = sv.simulate_many(model, {"a": [0.1, 0.2, 0.3, 0.4], "da": 0.0}, None, (0.0, 0.1))
    assert list(many["case"]) == [0, 1] and many.study.meta["interrupted"]


def test_an_interrupt_ends_the_lanes_at_once(monkeypatch, c_compiler):
    """The cases that were finished are kept, and no case is computed by itself afterwards."""
    def stop(bar, count):
        raise KeyboardInterrupt

    monkeypatch.setattr("servoctl.methods.lanes.SHOWN_EVERY", 1e-4)
    monkeypatch.setattr("servoctl.progress._NoBar.update", stop)
    in_lanes(monkeypatch)
    angles = np.random.default_rng(SEED).uniform(-1, 1, 20_000)
    model = pendulum()
    start = model.start(a=0.1, da=0.0)
    many = sv.simulate_many(model, start, {"k": 0.5 + 0.01 * angles}, (0.0, 30.0), executor=1)
    assert many.study.meta["interrupted"] and 0 < len(many) < len(angles)
    assert np.isfinite(many["final a"]).all()


def test_progress_counts_the_cases(monkeypatch, c_compiler):
    counts = []
    monkeypatch.setattr("servoctl.progress._NoBar.update", lambda bar, count: counts.append(count))
    model = pendulum(lambda a, t, p: p.k * ca.sin(t))
    sv.simulate_many(model, {"a": [0.1, 0.2, 0.3], "da": 0.0}, None, (0.0, 0.1), progress=False)
    assert np.cumsum(counts)[-1] >= 3


def test_without_a_compiler_the_results_are_the_same(monkeypatch, c_compiler):
    model, starts = pendulum(), {"a": [0.3, 2.0], "da": 0.0}
    many = sv.simulate_many(model, starts, None, (0.0, 1.0))
    monkeypatch.setenv("SERVOCTL_COMPILER", "none")
    again = sv.simulate_many(pendulum(), starts, None, (0.0, 1.0))
    assert again["final a"] == pytest.approx(many["final a"], rel=1e-12)


@pytest.mark.parametrize(
    ("changed", "kind", "facts"),
    [
        ({"starts": {"a": [0.1, 0.2], "da": [0.0]}}, SpecificationError, {"lengths": [1, 2]}),
        ({"starts": np.zeros((3, 2))}, SpecificationError, {}),
        ({"starts": {"a": [np.nan], "da": 0.0}}, SpecificationError, {}),
        ({"starts": {"a": [0.1] * 3, "da": 0.0}, "parameters": {"k": [1.0, 2.0]}}, SpecificationError,
         {"lengths": [2, 3]}),
        ({"t_eval": [2.0]}, SpecificationError, {"t_eval": [2.0]}),
        ({"executor": 0}, SpecificationError, {}),
        ({"executor": "two"}, SpecificationError, {}),
    ],
)
def test_bad_input(changed, kind, facts):
    model = pendulum()
    given = {"starts": {"a": 0.1, "da": 0.0}, "parameters": None, "t_span": (0.0, 1.0)} | changed
    with refused(kind, facts):
        sv.simulate_many(model, **given)


def test_names_that_are_no_parameters_are_rows():
    many = sv.simulate_many(pendulum(), {"a": 0.1, "da": 0.0}, {"mass": [1.0, 2.0]}, (0.0, 0.1))
    assert list(many["error"]) == ["NameUnknown"] * 2


def test_motions_of_a_mechanism_as_given_stay_in_the_lanes(gallery_model, monkeypatch, c_compiler):
    """Rates that rows determine are judged by what they add to the coordinates, at every tolerance."""
    scene, model = gallery["appell-hamel"], gallery_model("appell-hamel")
    start = model.start(**scene.start, guess=scene.guess)
    in_lanes(monkeypatch)
    for method in (sv.methods.Taylor(8, rtol=1e-4), sv.methods.Taylor(20, rtol=1e-13, atol=1e-13)):
        many = sv.simulate_many(model, start, {"M": [4.0, 5.0, 6.0]}, (0.0, 2.0), method)
        assert list(many["error"]) == [""] * 3


def test_derivations_are_affirmed_for_each_set_of_parameters_by_itself(gallery_model):
    model = gallery_model("appell-hamel")
    names = list(model.numbers)
    values = np.tile(model.parameters[:, None], 7)
    values[names.index("M")] = [5.0, 4.0, -50.0, np.nan, 6.0, 1e-3, 5.5]
    values[names.index("b"), 4] = 0.0
    found = affirmed(model, values)
    assert found.tolist() == [True, True, False, False, found[4], found[5], True]
    assert found.tolist() == [affirmed(model, column[:, None])[0] for column in values.T]
    for column in values[:, found].T:
        assert derived_alike(model, column)


@pytest.mark.parametrize(
    "name", ["appell-hamel", "overhead-crane", "winch-crane", "mass-on-car", "wheeled-robot", "four-bar"]
)
def test_derivations_are_affirmed_at_once_where_they_hold(name, gallery_model):
    """Parameters of the balances, of the constraints, and of both; what is affirmed is what a derivation gives."""
    model, rng = gallery_model(name), np.random.default_rng(SEED)
    columns = np.tile(model.parameters[:, None], 12 * len(model.numbers))
    factors = np.append(rng.uniform(0.5, 2.0, 7), [0.0, 1e-9, 1e3, -1.0, np.nan])
    for k in range(len(model.numbers)):
        columns[k, 12 * k : 12 * k + 12] *= factors
    both = model.parameters[:, None] * rng.uniform(0.9, 1.1, (len(model.numbers), 20))
    for values in (*np.split(columns, len(model.numbers), axis=1), both):
        found = affirmed(model, values)
        assert found.tolist() == [affirmed(model, column[:, None])[0] for column in values.T]
        assert all(derived_alike(model, column) for column in values[:, found][:, -2:].T)
    assert found.sum() > 10


def signals_equal_runs(model, many, start, span, method=None, names=None):
    """Every signal of a run, along the traces and at the end, is that of `simulate` for the case."""
    columns = [name for name in model.numbers if name in many.study.columns]
    for i, row in enumerate(many.study.rows()):
        one = model.with_parameters(**{name: row[name] for name in columns})
        x0 = start(i, one) if callable(start) else start
        run = simulated(one, x0, span, method, t_eval=np.union1d(many.t, span[1])[:: 1 if span[1] > span[0] else -1])
        assert tuple(many.trace) == run.names
        for name in names or run.names:
            within = {"rtol": 0, "atol": 1e-10 * np.abs(run[name]).max() + 1e-13, "err_msg": name}
            np.testing.assert_allclose(many.trace[name][:, i], run[name][: len(many.t)], **within)
            np.testing.assert_allclose(many[f"final {name}"][i], run[name][-1], **within)


@pytest.mark.parametrize(
    ("name", "span", "count"),
    [("overhead-crane", (0.0, 6.0), 0), ("crane-3d", (2.0, 0.0), 5),
     ("rolling-disc", (0.0, 0.5), 5), ("reaction-wheels", (0.0, 0.3), 5), ("constant-jerk", (0.0, 0.2), 5)],
)
def test_motions_have_the_signals_of_a_run(name, span, count, gallery_model):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(t=span[0], **scene.start, guess=scene.guess)
    parameters = {p: model.numbers[p] * np.array([0.9, 1.2]) for p in [*model.numbers][:1]}
    many = sv.simulate_many(model, start, parameters, span, t_eval=np.linspace(span[0], span[1] * 0.5, count))
    signals_equal_runs(model, many, start, span)


def test_signals_of_motions_by_themselves_and_of_errors():
    """Plans with other knots have models of their own; where there is no motion there is no force."""
    model = held_pendulum(lambda q, p: q.references(place=sv.paths.rest_to_rest(0.0, 1.0, duration=p.T)).place)
    start = model.start(guess={"a": 0.9})
    cases = {"T": [2.0, 1.0, 2.0, 2.0], "r": [1.0, 1.0, 0.5, 1.1], "m": [1.0, 2.0, 3.0, 4.0]}
    many = sv.simulate_many(model, start, cases, (0.0, 1.5), t_eval=[0.8])
    assert np.isnan(many.trace["F"][0]).tolist() == np.isnan(many["final F"]).tolist() == [False, False, True, False]
    for i in (0, 1, 3):
        case = {name: values[i] for name, values in cases.items()}
        run = simulated(model.with_parameters(**case), start, (0.0, 1.5), t_eval=[0.8, 1.5])
        np.testing.assert_allclose([many.trace["F"][0, i], many["final F"][i]], run["F"], rtol=1e-10)
    again = pickle.loads(pickle.dumps(many))
    np.testing.assert_allclose(again.trace["M"], many.trace["M"], rtol=1e-12)


def test_forces_of_a_pendulum_against_their_closed_form(c_compiler):
    """The force that holds the cart is m sin a (g cos a + a'^2), which its rates follow; more points than one call takes."""
    model = pendulum()
    t = np.linspace(0.0, 1.0, 201)
    m = np.linspace(0.5, 2.0, 600)
    many = sv.simulate_many(model, {"a": 1.0, "da": 0.0}, {"m": m}, (0.0, 1.0), sv.methods.Taylor(jets=4), t_eval=t)
    a, da, dda = (many.trace[name] for name in ("a", "da", "d2a"))
    np.testing.assert_allclose(dda, -9.81 * np.sin(a), atol=1e-11)
    np.testing.assert_allclose(many.trace["F"], m * (np.cos(a) * dda - np.sin(a) * da**2), atol=1e-10)
    few = sv.simulate_many(model, {"a": 1.0, "da": 0.0}, {"m": m[:2]}, (0.0, 1.0), sv.methods.Taylor(jets=4), t_eval=t[:3])
    d3a = -9.81 * np.cos(few.trace["a"]) * few.trace["da"]
    np.testing.assert_allclose(few.trace["d3a"], d3a, atol=1e-10)
    rate = np.cos(few.trace["a"]) * d3a - 3 * np.sin(few.trace["a"]) * few.trace["da"] * few.trace["d2a"]
    rate = m[:2] * (rate - np.cos(few.trace["a"]) * few.trace["da"] ** 3)
    np.testing.assert_allclose(few.trace["dF"], rate, atol=1e-9)


def test_unknown_signals_of_motions():
    many = sv.simulate_many(pendulum(), {"a": [0.1, 0.2], "da": 0.0}, None, (0.0, 0.1))
    for read in (lambda: many.trace["force"], lambda: many["final force"], lambda: many["F"]):
        with refused(NameUnknown):
            read()


def same_motions(some, others):
    """Bit for bit, where a NaN equals a NaN."""
    assert list(some.study.columns) == list(others.study.columns)
    for name in some.study.columns:
        np.testing.assert_array_equal(some[name], others[name])
    for name in some.trace:
        np.testing.assert_array_equal(some.trace[name], others.trace[name])


def compile_as_tests_do():
    """What a spawned worker calls first: the name leads it to this module, and so to conftest."""


SPAWNED = partial(ProcessPoolExecutor, mp_context=get_context("spawn"), initializer=compile_as_tests_do)


@pytest.mark.parametrize("pool", [ThreadPoolExecutor, SPAWNED])
def test_an_executor_computes_the_same_bits(pool, gallery_model, c_compiler):
    """Lanes, plans of one model and of several, starts of all forms, and cases that fail."""
    rod = held_pendulum(lambda q, p: q.references(place=sv.paths.rest_to_rest(0.0, 1.0, duration=p.T)).place)
    angles = np.linspace(-2.0, 2.0, 4)
    states = np.array([angles * 0, angles, angles * 0, angles])
    free, wheel = pendulum(), gallery_model("appell-hamel")
    scene = gallery["appell-hamel"]
    kicked = pendulum(lambda a, t, p: p.k * ca.sin(t))
    problems = [
        (free, {"a": angles, "da": 0.1}, None, (0.0, 1.0)),
        (free, states, {"k": 1.0 + angles}, (0.0, 1.0)),
        (wheel, wheel.start(**scene.start, guess=scene.guess), {"M": [4.0, -5.0, 6.0]}, (0.0, 0.5)),
        (rod, rod.start(guess={"a": 0.9}), {"T": [2.0, 1.0, 2.0], "r": [1.0, 1.0, 0.5]}, (0.0, 1.5)),
        (kicked, {"a": [0.1, 0.2], "da": 0.0}, None, (0.0, 0.1)),
    ]
    with pool(2) as executor:
        for problem in problems:
            options = {"t_eval": [problem[3][1] / 2], "progress": False}
            same_motions(sv.simulate_many(*problem, **options, executor=executor), sv.simulate_many(*problem, **options))


class Broken(Executor):
    """It loses all calls but the first `good`, and has Ctrl-C meet the one with the index `interrupted`."""

    def __init__(self, good, interrupted=None):
        self.good, self.interrupted, self.calls = good, interrupted, 0

    def submit(self, function, *arguments):
        future, self.calls = Future(), self.calls + 1
        if self.calls == self.interrupted:
            raise KeyboardInterrupt
        if self.calls > self.good:
            future.set_exception(BrokenExecutor("a worker died"))
        else:
            future.set_result(function(*arguments))
        return future


def test_cases_that_an_executor_loses_are_rows():
    problem = (pendulum(), {"a": [0.1, 0.2, 0.3], "da": 0.0}, None, (0.0, 0.1))
    many = sv.simulate_many(*problem, executor=Broken(2))
    assert many["error"].tolist() == ["", "", "BrokenExecutor"] and np.isnan(many["final F"][2])
    assert many["final a"][:2].tolist() == sv.simulate_many(*problem)["final a"][:2].tolist()
    with refused(ServoError, {"cases": 3, "error": "BrokenExecutor"}):
        sv.simulate_many(*problem, executor=Broken(0))
    with pytest.raises(KeyboardInterrupt):
        sv.simulate_many(*problem, executor=Broken(3, interrupted=2))


def test_an_executor_that_was_shut_down_is_refused():
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with refused(ServoError, {"cases": 2}):
        sv.simulate_many(pendulum(), {"a": [0.1, 0.2], "da": 0.0}, None, (0.0, 0.1), executor=executor)


def test_a_disc_far_from_the_origin_rolls_as_at_it(gallery_model):
    """Its angles have a tolerance of their own, in lanes, too."""
    model, scene, t = gallery_model("rolling-disc"), gallery["rolling-disc"], np.linspace(0.0, 2.0, 11)
    near, far = (sv.simulate_many(model, scene.start | {"x": x}, None, (0.0, 2.0), t_eval=t) for x in (0.0, 1e7))
    for name in ("lean", "psi", "dphi"):
        assert far.trace[name] == pytest.approx(near.trace[name], abs=1e-7), name
