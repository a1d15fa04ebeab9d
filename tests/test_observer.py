"""Output feedback: a Kalman filter along the plan."""

import numpy as np
import pytest

import servoctl as sv
from servoctl.mechanisms import overhead_crane, two_link_arm

GUST = {"theta": lambda t: 60.0 * (2.0 < t < 2.5)}
SENSORS = {"x": 1e-3, "l": 1e-3, "theta": 1e-3}


@pytest.fixture(scope="module")
def crane():
    mechanism, program = overhead_crane()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0))
    return plan, sv.plant(mechanism), sv.plant(mechanism, m_load=115.0)


def worst(run):
    return np.hypot(run.residual["X"][0], run.residual["Z"][0])


def test_estimates_replace_the_velocities(crane):
    """15 % more load and a gust, positions measured alone: nearly as good as the whole state."""
    plan, nominal, machine = crane
    law = sv.lqr(plan, nominal, integral=True)
    observed = sv.output_feedback(law, nominal, SENSORS)
    assert observed.measures == ("x", "l", "theta")
    full, partial = (
        worst(sv.close(machine, given, plan.state(0.0), (0.0, 8.0), disturbance=GUST)) for given in (law, observed)
    )
    assert full.max() < partial.max() < 0.06
    assert partial[-1] < 3e-3


def test_the_filter_forgets_a_wrong_start(crane):
    """On the nominal machine the estimated error of each state becomes its true one."""
    plan, nominal, _ = crane
    law = sv.output_feedback(sv.lqr(plan, nominal), nominal, SENSORS)
    start = plan.state(0.0) + [0.1, 0.05, 0.02, 0.1, -0.1, 0.05]
    run = sv.close(nominal, law, start, (0.0, 8.0))
    k = 300
    true = np.array([run[name][k] for name in nominal.state_names]) - plan.state(run.t[k])
    assert run.memory[:, k] == pytest.approx(true, abs=2e-3)
    assert worst(run)[-1] < 0.05 * worst(run)[0]


def test_noisier_sensors_are_trusted_less(crane):
    plan, nominal, _ = crane
    law = sv.lqr(plan, nominal)
    radii = [
        sv.output_feedback(law, nominal, {name: s for name in SENSORS}).info["spectral radius of the filter"]
        for s in (1e-4, 1e-3, 1e-2)
    ]
    assert radii == sorted(radii) and radii[-1] < 1


def test_noise_costs_less_than_differencing_would(crane):
    plan, nominal, machine = crane
    law = sv.output_feedback(sv.lqr(plan, nominal, integral=True), nominal, SENSORS)
    run = sv.close(machine, law, plan.state(0.0), (0.0, 8.0), noise=SENSORS, seed=3)
    quiet = sv.close(machine, law, plan.state(0.0), (0.0, 8.0))
    assert 0 < np.abs(worst(run) - worst(quiet)).max() < 5e-3


def test_bad_input(crane):
    plan, nominal, _ = crane
    law = sv.lqr(plan, nominal)
    with pytest.raises(sv.NameUnknown, match="theta"):
        sv.output_feedback(law, nominal, {"tetha": 1e-3})
    for noise in ({}, None, {"x": 0.0}):
        with pytest.raises(sv.SpecificationError):
            sv.output_feedback(law, nominal, noise)
    with pytest.raises(sv.SpecificationError, match="lqr"):
        sv.output_feedback(sv.feedforward(plan, nominal), nominal, SENSORS)
    with pytest.raises(sv.ServoError, match="seen by the measured"):
        sv.output_feedback(law, nominal, {"dx": 1e-3})


def test_velocities_alone_do_not_tell_where_an_arm_without_gravity_is():
    mechanism, program = two_link_arm()
    model = sv.derive(mechanism, program).with_parameters(g=0.0)
    plan = sv.simulate(model, model.start(guess={"q1": -0.4, "q2": 1.5}), (0.0, 2.0))
    nominal = sv.plant(mechanism, g=0.0)
    with pytest.raises(sv.ServoError, match="seen by the measured"):
        sv.output_feedback(sv.lqr(plan, nominal), nominal, {"dq1": 1e-3, "dq2": 1e-3})
