"""Laws under limits: every limit holds, residuals give way as asked, and the report says which."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scenes import CRANE

import servoctl as sv
from servoctl.gallery import cars, two_link_arm


def planned(build, span, **guess):
    mechanism, program = build()
    model = sv.derive(mechanism, program)
    return sv.simulate(model, model.start(guess=guess), span), mechanism


@pytest.fixture(scope="module")
def crane(crane_plan):
    return crane_plan, CRANE


@pytest.fixture(scope="module")
def arm():
    return planned(two_link_arm, (0.0, 2.0), q1=-0.4, q2=1.5)


def error(run):
    return np.hypot(run.residual["X"][0], run.residual["Z"][0])


@pytest.mark.parametrize("limits", [{"trolley": 100.0}, {"hoist": (-1000.0, 0.0)}])
def test_a_plan_beyond_its_actuators_stays_bounded_and_the_report_says_why(crane, limits):
    plan, mechanism = crane
    nominal, machine = sv.plant(mechanism), sv.plant(mechanism, limits=limits)
    base = sv.lqr(plan, nominal, integral=True)
    runs = [sv.close(machine, law, plan.state(0.0), (0.0, 8.0)) for law in (base, sv.limited(base, machine))]
    (name,) = limits
    low, high = machine.limits[name]
    for run in runs:
        assert low <= run[name].min() and run[name].max() <= high
    clipped, allocated = map(error, runs)
    assert allocated.max() < 0.8 * clipped.max() < 2.0 and allocated[-1] < 0.2
    report = sv.limit_report(runs[1])
    assert {row[0] for row in report.rows} == {"X", "Z"} and report.limits[name] > 0.3
    assert report.overload[:3] == (name, *plan.extrema(name)[0])


def test_the_report_solves_for_the_factor_that_would_keep_the_limits(crane):
    plan, mechanism = crane
    machine = sv.plant(mechanism, limits={"trolley": 100.0})
    law = sv.limited(sv.lqr(plan, sv.plant(mechanism)), machine)
    run = sv.close(machine, law, plan.state(0.0), (0.0, 2.0))
    report = sv.limit_report(run, {"t_span": (0.0, 6.0), "guess": {"l": 4.0}})
    model = sv.derive(mechanism, plan.model.reduction.program.slowed(mechanism.q, report.slower))
    slower = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 6.0 * report.slower))
    assert max(abs(value) for _, value in slower.extrema("trolley")) == pytest.approx(100.0, rel=1e-5)
    assert f"factor {report.slower:.5g}" in repr(report)


def test_within_the_limits_nothing_changes(crane):
    plan, mechanism = crane
    machine = sv.plant(mechanism, limits={"trolley": 200.0}, rate_limits={"hoist": 1e5})
    base = sv.lqr(plan, machine)
    runs = [sv.close(machine, law, plan.state(0.0), (0.0, 8.0)) for law in (base, sv.limited(base, machine))]
    assert runs[0].states == pytest.approx(runs[1].states, rel=0.0, abs=1e-14), "compiled and interpreted laws"
    assert not sv.limit_report(runs[1]).rows and not sv.limit_report(runs[1]).limits


def test_rate_limits_hold_from_sample_to_sample(crane):
    plan, mechanism = crane
    machine = sv.plant(mechanism, rate_limits={"trolley": 150.0})
    law = sv.limited(sv.lqr(plan, sv.plant(mechanism), integral=True), machine)
    run = sv.close(machine, law, plan.state(0.0) + [0.05, 0, 0, 0, 0, 0], (0.0, 8.0))
    assert np.abs(np.diff(run["trolley"])).max() <= 1.5 * (1 + 1e-12)
    assert "trolley" in sv.limit_report(run).limits


def test_the_allocation_is_the_least_of_its_cost(arm):
    """Against a search over the admissible inputs, at one sample."""
    plan, mechanism = arm
    machine = sv.plant(mechanism, limits={"shoulder": (0.0, 20.0), "elbow": 3.0})
    law = sv.limited(sv.computed(plan, sv.plant(mechanism), rate=200.0), machine)
    y = plan.state(0.4) + [0.02, 0.03, 0.1, -0.2]
    x, row = np.concatenate([y, law.state]), law.schedule_at(0.4)
    u = law.step(0.4, x, row)[:2]
    wanted = law.step.law.step(0.4, y, law.step.law.schedule_at(0.4))[:2]
    assert wanted[0] > 20.0
    H = row[-4:].reshape(2, 2)
    grid = np.array(np.meshgrid(np.linspace(0, 20, 401), np.linspace(-3, 3, 401))).reshape(2, -1)
    costs = np.einsum("in,ij,jn->n", grid - wanted[:, None], H, grid - wanted[:, None])
    own = (u - wanted) @ H @ (u - wanted)
    assert own <= costs.min() * (1 + 1e-9) and own >= costs.min() * 0.999


@pytest.mark.parametrize(
    "limits, spared, ratio",
    [
        ({"shoulder": (0.0, 29.0), "elbow": 10.0}, "X", 2.0),
        ({"shoulder": 40.0, "elbow": (-1.0, 10.0)}, "X", 1.4),
        ({"shoulder": 40.0, "elbow": (-1.0, 10.0)}, "Y", 1.04),
    ],
)
def test_priority_decides_which_residual_gives_way(arm, limits, spared, ratio):
    plan, mechanism = arm
    machine = sv.plant(mechanism, limits=limits)
    base = sv.computed(plan, sv.plant(mechanism), rate=200.0)
    other = "Y" if spared == "X" else "X"
    worst = []
    for asked in ({"priority": [spared, other]}, {}, {"priority": [other, spared]}):
        run = sv.close(machine, sv.limited(base, machine, **asked), plan.state(0.0), (0.0, 2.0))
        worst.append(np.abs(run.residual[spared][0]).max())
        for name, (low, high) in machine.limits.items():
            assert low <= run[name].min() and run[name].max() <= high
    assert worst == sorted(worst) and worst[2] > ratio * worst[0]


def test_a_rope_that_cannot_push(crane):
    """A load that starts high falls as fast as the rope lets it: without the bound the law would push."""
    plan, mechanism = crane
    machine = sv.plant(mechanism, limits={"hoist": (-3000.0, 3000.0)})
    base = sv.lqr(plan, machine)
    start = plan.state(0.0) - np.array([0.0, 2.0, 0, 0, 0, 0])
    free, kept = (
        sv.close(machine, law, start, (0.0, 4.0))
        for law in (base, sv.limited(base, machine, bounds={"tension": (0.0, None)}))
    )
    assert free["tension"].min() < -100.0
    assert kept["tension"].min() > -1e-6 * 1000.0
    assert "tension" in sv.limit_report(kept).limits
    assert error(kept)[-1] < 0.2


def test_limits_and_bounds_that_exclude_each_other_stop_with_both_named(crane):
    plan, mechanism = crane
    machine = sv.plant(mechanism, limits={"hoist": (-100.0, 0.0)})
    law = sv.limited(sv.lqr(plan, sv.plant(mechanism)), machine, bounds={"tension": (500.0, None)})
    with refused(sv.errors.LimitExceeded, "hoist -100 .. 0", "tension 500", bounds=("tension",)):
        sv.close(machine, law, plan.state(0.0), (0.0, 1.0))


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_slacks_do_not_depend_on_the_units_of_inputs(unit):
    """Forces in N and in kN, of which the plan uses far less than one: h²/(2m) of the largest, after the horizon h."""
    q = sv.coordinates("x y")
    x, y = q
    mass = sv.particle(q, 2.0, ca.vertcat(x, y))
    mechanism = sv.Mechanism(q, gibbs=mass, actuators={"a": unit * x, "b": unit * y})
    path = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0)).X
    model = sv.derive(mechanism, sv.Program({"X": x - path, "Y": y}))
    plan = sv.simulate(model, model.start(), (0.0, 2.0))
    plant = sv.plant(mechanism, rate_limits={"a": 1e3 / unit})
    law = sv.limited(sv.feedforward(plan, plant, rate=50.0), plant)
    used = unit * np.abs(plan["a"]).max()
    X, Y = law.allocation.slack_sizes
    assert X == pytest.approx(0.5**2 / (2 * 2.0) * used, rel=1e-9)
    assert Y == pytest.approx(1e-3 * X, rel=0.1)  # of an input that the plan leaves idle


class Failing:
    """A law that meets an impossible bound after a while."""

    def start(self):
        def law(t, y):
            if t > 0.255:
                raise sv.errors.LimitExceeded(f"At t = {t:g} s it is too much.")
            return {"trolley": 0.0, "hoist": -981.0}

        return law


def test_the_motion_before_a_limit_that_cannot_be_kept_is_in_the_error(crane, monkeypatch):
    plan, mechanism = crane
    plant = sv.plant(mechanism)
    for compiled in (True, False):
        if not compiled:
            monkeypatch.setattr(type(plant.function("ode")), "native", lambda self, *_: None)
        with pytest.raises(sv.errors.LimitExceeded) as caught:
            sv.close(plant, Failing(), plan.state(0.0), (0.0, 1.0), timing=sv.Timing(rate=100.0))
        run = caught.value.run
        assert run.t[-1] == pytest.approx(0.25) and not run.success and "raised LimitExceeded" in repr(run)


def test_a_first_actuation_beyond_the_limits_starts_at_the_limit(crane):
    """The plan starts with -981 N of a hoist that gives 900, and changes slowly."""
    plan, mechanism = crane
    machine = sv.plant(mechanism, limits={"hoist": (-900.0, 0.0)}, rate_limits={"hoist": 1000.0})
    law = sv.limited(sv.lqr(plan, sv.plant(mechanism)), machine)
    run = sv.close(machine, law, plan.state(0.0), (0.0, 0.5))
    assert run["hoist"] == pytest.approx(-900.0) and run.controller_states[-1, 0] == -900.0


def test_anti_windup_holds_the_integrators_whatever_they_are_called(crane):
    plan, mechanism = crane
    machine = sv.plant(mechanism, limits={"trolley": 60.0})
    law = sv.lqr(plan, sv.plant(mechanism), integral=True)
    renamed, without = replace(law, state_names=("first", "second")), replace(law, integrators=())
    laws = [sv.limited(each, machine) for each in (law, renamed, without)]
    runs = [sv.close(machine, each, plan.state(0.0), (0.0, 6.0)) for each in laws]
    assert runs[0].states == pytest.approx(runs[1].states, rel=0.0, abs=1e-14), "compiled and interpreted laws"
    assert np.abs(runs[2].controller_states[:2]).max() > 2 * np.abs(runs[0].controller_states[:2]).max()


def test_an_estimator_predicts_from_what_was_applied(crane):
    plan, mechanism = crane
    machine = sv.plant(mechanism, limits={"trolley": 120.0})
    nominal = sv.plant(mechanism)
    observed = sv.output_feedback(sv.lqr(plan, nominal, integral=True), nominal, {"x": 1e-3, "l": 1e-3, "theta": 1e-3})
    runs = [sv.close(machine, law, plan.state(0.0), (0.0, 8.0)) for law in (observed, sv.limited(observed, machine))]
    assert error(runs[1]).max() < error(runs[0]).max()


def test_bad_input(crane):
    plan, mechanism = crane
    law, machine = sv.lqr(plan, sv.plant(mechanism)), sv.plant(mechanism, limits={"trolley": 100.0})
    with refused(sv.errors.SpecificationError, "limits"):
        sv.limited(law, sv.plant(mechanism))
    with refused(sv.errors.NameUnknown, name="tensoin", match="tension"):
        sv.limited(law, machine, bounds={"tensoin": (0.0, None)})
    for bound in ((0.0, 1.0, 2.0), (1.0, 0.0), (None, None), "all"):
        with refused(sv.errors.SpecificationError, name="tension"):
            sv.limited(law, machine, bounds={"tension": bound})
    with refused(sv.errors.NameUnknown, name="Y"):
        sv.limited(law, machine, priority=["Y"])
    for options in ({"weights": {"X": 1.0}, "priority": ["X"]}, {"weights": {"X": 0.0}}, {"horizon": 0.0}):
        with pytest.raises(sv.errors.SpecificationError):
            sv.limited(law, machine, **options)
    for priority in ("X", 3, ["X", "X"]):
        with refused(sv.errors.SpecificationError, "priority"):
            sv.limited(law, machine, priority=priority)
    with refused(sv.errors.SpecificationError, "limited by weight"):
        sv.limited(sv.limited(law, machine), machine)
    with refused(sv.errors.SpecificationError, "function"):
        sv.limited(lambda t, y: [0.0, 0.0], machine)
    slow = sv.plant(mechanism, limits={"trolley": 100.0}, lag={"trolley": 0.1, "hoist": 0.1})
    with refused(sv.errors.SpecificationError, "trolley, hoist", name="tension"):
        sv.limited(sv.lqr(plan, slow), slow, bounds={"tension": (0.0, None)})
    with refused(sv.errors.NameUnknown, name="trolley"):
        sv.limited(sv.lqr(plan, slow), machine)
    with refused(sv.errors.SpecificationError, "None"):
        sv.limit_report(plan)
    run = sv.close(machine, sv.limited(law, machine), plan.state(0.0), (0.0, 0.1))
    for scene in ({}, "crane", {"t_span": (0.0, 6.0), "gues": {"l": 4.0}}):
        with refused(sv.errors.SpecificationError, "scene"):
            sv.limit_report(run, scene)
    with refused(sv.errors.SpecificationError, "lqr, time-varying"):
        sv.limit_report(sv.close(machine, law, plan.state(0.0), (0.0, 0.1)))


@pytest.mark.parametrize("columns", [1, 5, 1000])
def test_a_handmade_law_is_limited_whatever_its_schedule(crane, columns):
    plan, mechanism = crane
    machine = sv.plant(mechanism, limits={"trolley": 10.0})
    law = sv.Law(
        "own", ("x",), machine.inputs, 100.0, 0.0, lambda t, x, row: [100.0 * t, row[0]],
        -981.0 - np.arange(columns)[None], plan=plan,
    )  # fmt: skip
    run = sv.close(machine, sv.limited(law, machine), plan.state(0.0), (0.0, 0.3))
    assert np.allclose(run["trolley"], np.minimum(100.0 * run.t, 10.0), rtol=1e-14)
    assert np.array_equal(run.command["hoist"][:10], -981.0 - np.minimum(np.arange(10), columns - 1))
    with refused(sv.errors.SpecificationError, "1 s", "0 s"):
        sv.limited(replace(law, t0=1.0), machine)
    assert len(repr(sv.limited(law, machine)).splitlines()) <= 5, "a law's repr holds no other repr"


def test_single_input_plans_are_only_clipped():
    plan, mechanism = planned(cars, (0.0, 2.0))
    machine = sv.plant(mechanism, limits={"force": 250.0})
    base = sv.computed(plan, sv.plant(mechanism), rate=200.0)
    runs = [sv.close(machine, law, plan.state(0.0), (0.0, 4.0)) for law in (base, sv.limited(base, machine))]
    assert np.abs(runs[0].states - runs[1].states).max() < 1e-9
