"""Computed actuation: exact linearisation, dynamic extension, sampled poles, refusals."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused, warned
from scenes import point_mass

import servoctl as sv
from servoctl.control.companion import sampled_bound
from servoctl.control.inverse_dynamics import _Extension, sampled_radius
from servoctl.gallery import cars, gallery, mass_on_car, vtol

ORDERS = {  # zeros at infinity of the program's outputs (theory), which exact linearisation reaches
    "two-link-arm": (2, 2),
    "mass-on-car-absolute": (2,),
    "crane-3d": (4, 4, 4),
    "wheeled-robot": (1, 1),
}


def planned(name):
    scene = gallery[name]
    model = sv.derive(*scene.build())
    return sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span), scene


@pytest.mark.parametrize("name", ORDERS)
def test_on_the_plan_the_law_asks_for_the_plans_actuation(name):
    plan, _ = planned(name)
    plant = sv.plant(plan.model.reduction.mechanism)
    law = sv.computed(plan, plant, rate=1000.0)
    assert tuple(law.info["orders"].values()) == ORDERS[name]
    size = max(np.abs(plan[actuator]).max() for actuator in law.inputs)
    first = len(plant.parameters) + 1
    for k in range(0, len(plan.t), 100):  # samples of the law
        row = law.schedule_at(plan.t[k]).copy()
        row[first : first + len(law.inputs)] = 0.0  # what is added for the middle of the sample
        y = np.append(plan.state(plan.t[k]), law.state)
        u = law.step(plan.t[k], y, row)[: len(law.inputs)]
        assert u == pytest.approx([plan[actuator][k] for actuator in law.inputs], abs=3e-8 * max(size, 1.0))


def test_residuals_decay_as_the_poles_say():
    """Two joints: each residual obeys φ'' + 2φ'/T + φ/T² = 0 from any start, up to the hold at 2 kHz."""
    plan, _ = planned("two-link-arm")
    plant, T = sv.plant(plan.model.reduction.mechanism), 0.1
    law = sv.computed(plan, plant, rate=2000.0, poles=T)
    start = plan.state(0.0) + [0.02, -0.03, 0.0, 0.0]
    run = sv.close(plant, law, start, (0.0, 2.0))
    for name in ("X", "Y"):
        e, de = run.residual[name][:, 0]
        expected = (e + (de + e / T) * run.t) * np.exp(-run.t / T)
        assert np.abs(run.residual[name][0] - expected).max() < 0.01 * abs(e)
        assert abs(run.residual[name][0][-1]) < 1e-3 * abs(e)  # the hold of a moving path leaves 3e-6 m


def test_the_crane_follows_by_dynamic_extension(crane_plan):
    """Hidden rows: the law keeps two derivatives of one residual; on the nominal machine errors of the start decay."""
    plant = sv.plant(crane_plan.model.reduction.mechanism)
    law = sv.computed(crane_plan, plant, rate=200.0)
    assert len(law.state) == 2 and set(law.info["relative degree"].values()) == {2}
    run = sv.close(plant, law, crane_plan.state(0.0) + np.array([0.05, -0.02, 0.01, 0, 0, 0]), (0.0, 8.0))
    error = np.hypot(run.residual["X"][0], run.residual["Z"][0])
    assert error[0] > 0.03 and error[-1] < 1e-5


def test_the_hold_of_a_moving_path_costs_an_error_of_second_order(crane_plan):
    plant = sv.plant(crane_plan.model.reduction.mechanism)
    worst = []
    for rate in (50.0, 100.0):
        run = sv.close(plant, sv.computed(crane_plan, plant, rate=rate), crane_plan.state(0.0), (0.0, 6.0))
        worst.append(np.hypot(run.residual["X"][0], run.residual["Z"][0]).max())
    assert worst[0] / worst[1] == pytest.approx(4.0, rel=0.1) and worst[1] < 1e-4


def arm_residual(plan, rate, delay):
    plant = sv.plant(plan.model.reduction.mechanism)
    law = sv.computed(plan, plant, rate=rate, delay=delay)
    run = sv.close(plant, law, plan.state(0.0), (0.0, 2.0), timing=sv.Timing(delay=delay))
    return max(np.abs(run.residual[name][0]).max() for name in ("X", "Y"))


def test_late_commands_are_those_of_the_time_when_they_are_held():
    """By d samples too late the plan's actuation would cost an error of first order: 4e-4 m at 200 Hz."""
    plan, _ = planned("two-link-arm")
    prompt = arm_residual(plan, 200.0, 0)
    for delay, room in ((1, 1.2), (2, 3.0)):
        late = [arm_residual(plan, rate, delay) for rate in (200.0, 400.0)]
        assert late[0] / late[1] == pytest.approx(4.0, rel=0.1) and late[0] < room * prompt


def test_a_lag_needs_a_path_of_the_next_class():
    """Its command holds one derivative more than the plan's actuation, which this path has not."""
    plan, _ = planned("two-link-arm")
    plant = sv.plant(plan.model.reduction.mechanism, lag={"shoulder": 0.02, "elbow": 0.02})
    with refused(sv.errors.SpecificationError, name="X", needs=3, has=2, t=0.0):
        sv.computed(plan, plant)


@pytest.mark.parametrize("unit", [1.0, 1e-12])
def test_choices_of_the_extension_do_not_depend_on_units(unit):
    """The third row depends on both others, one of them in units of its own."""
    base = np.array([[1.0, 2.0, 0.0], [0.0, 1.0, 3.0], [1.0, 3.0, 3.0]])
    D = (np.array([1.0, unit, 1.0])[:, None] * base)[:, :, None]
    given = SimpleNamespace(values=lambda D, beside=True: (D, np.abs(D)), rank=lambda: 2)
    assert _Extension._needed(given, D, [0, 1], [0, 2], [2]).tolist() == [True, True]
    random = np.random.default_rng(0)
    for _ in range(10):
        along = np.einsum("irk,rjk->ijk", random.standard_normal((3, 2, 8)), random.standard_normal((2, 3, 8)))
        scaled = np.array([1.0, unit, 1.0])[:, None, None] * along
        assert _Extension._pivots(given, scaled) == _Extension._pivots(given, along)


def test_behind_a_lagging_actuator_the_hold_costs_an_error_of_second_order_too():
    """What is added until the middle of a sample is that of the command u + T du/dt, not of u alone."""
    plan, _ = planned("two-cars")
    plant = sv.plant(plan.model.reduction.mechanism, lag={"force": 0.2})
    start, worst = np.append(plan.state(0.0), plan["force"][0]), []
    for rate in (200.0, 400.0):
        run = sv.close(plant, sv.computed(plan, plant, rate=rate, poles=0.2), start, (0.0, 2.0))
        worst.append(np.abs(run.residual["car 1"][0]).max())
    assert worst[0] / worst[1] == pytest.approx(4.0, rel=0.1) and worst[1] < 1e-5


def test_unstable_internal_dynamics_are_refused_with_a_pointer():
    model = sv.derive(*vtol("centre"))
    with warned("unstable over these 0.5 s"):
        plan = sv.simulate(model, model.start(theta=0.0, dtheta=0.0), (0.0, 0.5))
    with refused(sv.errors.UnstableInternalDynamics, "lqr", states=("theta", "dtheta"), eigenvalue=pytest.approx(15.09, abs=0.01)):
        sv.computed(plan, sv.plant(model.reduction.mechanism))


# sampled poles ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("rho", [2, 3, 4, 5])
def test_the_radius_of_held_feedback_reaches_one_at_the_bound(rho, delay):
    bound = sampled_bound(rho, delay)
    assert sampled_radius([-0.999 * bound] * rho, 1.0, delay) < 1 < sampled_radius([-1.001 * bound] * rho, 1.0, delay)


LOOPS = {  # name: (mechanism and program, held at the start, lag of the actuator [s], rate [Hz])
    2: (lambda: point_mass(smoothness=4), {}, {}, 100.0),
    3: (lambda: mass_on_car(0.0, 1.0), {"s": 0.0}, {}, 400.0),
    4: (cars, {}, {}, 50.0),
    5: (cars, {}, {"force": 0.2}, 500.0),
}


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("rho", LOOPS)
def test_loops_turn_unstable_where_the_bound_says_within_two_per_cent(rho, delay):
    build, held, lag, rate = LOOPS[rho]
    mechanism, program = build()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(**held), (0.0, 8.0))
    plant = sv.plant(mechanism, lag=lag)
    law = sv.computed(plan, plant, rate=rate, poles=10.0)
    (name,) = law.info["orders"]
    assert law.info["orders"][name] == rho
    first = len(plant.parameters) + 1 + len(law.inputs)  # the rows of the poles, before the jets of references
    grows = []
    for share in (0.98, 1.02):
        pole = share * sampled_bound(rho, delay) * rate
        schedule = law.schedule.copy()
        schedule[first : first + rho] = np.poly([-pole] * rho)[:0:-1, None]
        start = np.append(plan.state(7.0), [plan["force"][-1]] * len(lag))
        start[0] += 1e-3
        placed, timing = replace(law, schedule=schedule), sv.Timing(delay=delay)
        run = sv.close(plant, placed, start, (7.0, 7.0 + 1600 / rate), timing=timing)
        error = np.abs(run.residual[name][0])
        grows.append(error[-200:].max() > error[600:800].max())
    assert grows == [False, True]


@pytest.mark.parametrize("delay", [0, 1])
def test_poles_too_fast_for_the_rate_are_refused_with_the_number(crane_plan, delay):
    plant = sv.plant(crane_plan.model.reduction.mechanism)
    bound = sampled_bound(4, delay)
    with refused(sv.errors.SpecificationError, f"{bound * 50:.4g}", name="X", bound=pytest.approx(bound, rel=1e-9)):
        sv.computed(crane_plan, plant, rate=50.0, poles=1 / (1.01 * bound * 50), delay=delay)
    sv.computed(crane_plan, plant, rate=50.0, poles=1 / (0.99 * bound * 50), delay=delay)


def test_bad_input(crane_plan):
    plant = sv.plant(crane_plan.model.reduction.mechanism)
    wrong = {"name": "X", "order": 4}
    for poles, fact in (
        ({"X": [-1.0, -1.0]}, wrong), ({"X": [-1 + 1j] * 4, "Z": [-1.0] * 4}, wrong), ([-1.0] * 4, "'X'"),
    ):  # fmt: skip
        with refused(sv.errors.SpecificationError, fact):
            sv.computed(crane_plan, plant, poles=poles)
    with refused(sv.errors.SpecificationError, name="X", order=4):
        sv.computed(crane_plan, plant, poles={"X": "fast", "Z": [-1.0] * 4})
    with refused(sv.errors.SpecificationError, name="X"):
        sv.computed(crane_plan, plant, poles={"X": [1.0] * 4, "Z": [-1.0] * 4})
    for delay in (0.5, -1, "one", True):
        with refused(sv.errors.SpecificationError, "delay"):
            sv.computed(crane_plan, plant, delay=delay)
    with refused(sv.errors.SpecificationError, "0.05 s"):
        sv.computed(crane_plan, sv.plant(plant.mechanism, delay=0.05))
    with refused(sv.errors.NameUnknown, name="x", match="X"):
        sv.computed(crane_plan, plant, poles={"x": [-1.0] * 4})
    with refused(sv.errors.SpecificationError, "plant", "plan", plan=crane_plan.model.reduction.mechanism.q.names):
        heavier = {"actuators": {"trolley": [1, 0, 0], "hoist": [0, 0, 1]}, "parameters": plant.mechanism.parameters}
        other = sv.Mechanism(plant.mechanism.q, balance=2 * plant.mechanism.balance, **heavier)
        sv.computed(crane_plan, sv.plant(other))


def test_a_plant_of_an_equal_mechanism_is_inverted(crane_plan):
    """A mechanism that travelled by pickle, or was built again, has other symbols of the same names."""
    mechanism = crane_plan.model.reduction.mechanism
    law = sv.computed(crane_plan, sv.plant(mechanism))
    for other in (pickle.loads(pickle.dumps(mechanism)), gallery["overhead-crane"].build()[0]):
        assert other is not mechanism
        copy = sv.computed(crane_plan, sv.plant(other))
        assert copy.info["orders"] == law.info["orders"] and copy.state_names == law.state_names
        x = np.append(crane_plan.state(0.5), [0.1] * len(law.state))
        column = law.schedule_at(0.5)
        assert np.array_equal(copy.schedule_at(0.5), column)
        assert np.allclose(copy.answer(0.5, x, column), law.answer(0.5, x, column), rtol=1e-12)
