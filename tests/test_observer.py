"""Output feedback: a Kalman filter along the plan."""

import numpy as np
import pytest
from refusals import refused
from scenes import CRANE

import servoctl as sv
from servoctl.control.reference import Reference
from servoctl.control.sampling import discretised
from servoctl.gallery import gallery, two_link_arm

GUST = {"theta": lambda t: 60.0 * (2.0 < t < 2.5)}
SENSORS = {"x": 1e-3, "l": 1e-3, "theta": 1e-3}


@pytest.fixture(scope="module")
def crane(crane_plan):
    return crane_plan, sv.plant(CRANE), sv.plant(CRANE, m_load=115.0)


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
    assert run.controller_states[:, k] == pytest.approx(true, abs=2e-3)
    assert worst(run)[-1] < 0.05 * worst(run)[0]


def test_noisier_sensors_are_trusted_less(crane):
    plan, nominal, _ = crane
    law = sv.lqr(plan, nominal)
    radii = [
        sv.output_feedback(law, nominal, {name: s for name in SENSORS}).info["spectral radius of the filter"]
        for s in (1e-4, 1e-3, 1e-2)
    ]
    assert radii == sorted(radii) and radii[-1] < 1


class Differencing:
    """Feedback of velocities that are differences of the measured coordinates."""

    def __init__(self, law, names):
        self.law, self.names = law, names

    def start(self):
        controller, before = self.law.start(), {}

        def law(t, y):
            for name in self.names:
                y[f"d{name}"] = (y[name] - before.get(name, y[name])) * self.law.rate
                before[name] = y[name]
            return controller(t, y)

        return law


def test_noise_costs_less_than_differencing_would(crane):
    plan, nominal, machine = crane
    law = sv.lqr(plan, nominal, integral=True)
    costs = []
    for given in (sv.output_feedback(law, nominal, SENSORS), Differencing(law, SENSORS)):
        noisy, quiet = (
            sv.close(machine, given, plan.state(0.0), (0.0, 8.0), timing=sv.Timing(rate=100.0), sensors=sensors, plan=plan)
            for sensors in (sv.Sensors(noise=SENSORS, seed=3), sv.Sensors())
        )
        costs.append(np.std(noisy.commands - quiet.commands, axis=1))
        assert np.abs(worst(noisy) - worst(quiet)).max() < 5e-3
    assert np.all(2 * costs[0] < costs[1]), "the actuators are spared"


def test_gains_are_those_of_python_control_and_of_the_recursion(crane):
    import control

    plan, nominal, _ = crane
    A, _ = discretised(*Reference(plan, nominal, 100.0).linearised(), 0.01)
    C, W, V = np.eye(6)[:3], np.diag([1e-8] * 3 + [1e-2] * 3), 1e-6 * np.eye(3)
    L = gains(sv.output_feedback(sv.lqr(plan, nominal), nominal, SENSORS), 6, 3)
    predictor, P, _ = control.dlqe(A[0], np.eye(6), C, W, V)
    assert A[0] @ L[0] == pytest.approx(predictor, rel=1e-9, abs=1e-12)
    for k in range(400):
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        assert L[k] == pytest.approx(K, rel=1e-7, abs=1e-10)
        P = A[k] @ (np.eye(6) - K @ C) @ P @ (np.eye(6) - K @ C).T @ A[k].T + A[k] @ K @ V @ K.T @ A[k].T + W


def gains(law, n_x, n_y):
    """L of each sample, from the law's table [u_ff; x_ref; K; L; A; B]."""
    m = len(law.inputs)
    first = m + n_x + m * n_x
    return law.schedule[first : first + n_x * n_y].T.reshape(-1, n_x, n_y)


def test_a_filter_on_constrained_states_is_that_of_their_tangent_spaces():
    """The rope as a material constraint: against a covariance in all coordinates, projected at each sample."""
    scene = gallery["overhead-crane-redundant"]
    mechanism, program = scene.build()
    model = sv.derive(mechanism, program)
    plan, plant = sv.simulate(model, model.start(guess=scene.guess), (0.0, 4.0)), sv.plant(mechanism)
    sensors = {"x": 1e-3, "X": 1e-3, "Z": 1e-3}
    law = sv.output_feedback(sv.lqr(plan, plant), plant, sensors)
    reference = Reference(plan, plant, 100.0)
    A, _ = discretised(*reference.linearised(), 0.01)
    J = (
        plant.function("constraints_jacobian")
        .grid(reference.t, reference.x, plant.p())
        .reshape(8, 2, -1)
        .transpose(2, 1, 0)
    )
    project = np.eye(8) - np.linalg.pinv(J) @ J
    C, W, V = np.eye(8)[[0, 2, 3]], np.diag([1e-8] * 4 + [1e-2] * 4), 1e-6 * np.eye(3)
    P = project[0] @ W @ project[0]
    for _ in range(5000):  # steady at the start
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        P = project[0] @ (A[0] @ (P - K @ C @ P) @ A[0].T + W) @ project[0]
    for k, L in enumerate(gains(law, 8, 3)[:300]):
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        assert L == pytest.approx(K, rel=1e-6, abs=1e-8)
        P = project[k + 1] @ (A[k] @ (P - K @ C @ P) @ A[k].T + W) @ project[k + 1]
    assert law.info["spectral radius of the filter"] < 1.0
    run = sv.close(plant, law, plan.state(0.0), (0.0, 4.0), sensors=sv.Sensors(noise=sensors, seed=1))
    assert np.abs(np.einsum("kij,jk->ki", J, run.controller_states)).max() < 1e-12 and worst(run).max() < 0.01


def test_bad_input(crane):
    plan, nominal, _ = crane
    law = sv.lqr(plan, nominal)
    with refused(sv.errors.NameUnknown, name="tetha", match="theta"):
        sv.output_feedback(law, nominal, {"tetha": 1e-3})
    for noise in ({}, None, {"x": 0.0}):
        with pytest.raises(sv.errors.SpecificationError):
            sv.output_feedback(law, nominal, noise)
    with refused(sv.errors.SpecificationError, "feedforward"):
        sv.output_feedback(sv.feedforward(plan, nominal), nominal, SENSORS)
    with refused(sv.errors.SpecificationError, "output feedback"):
        sv.output_feedback(sv.output_feedback(law, nominal, SENSORS), nominal, SENSORS)
    slow = sv.plant(nominal.mechanism, lag={"trolley": 0.05})
    for pair in ((law, slow), (sv.lqr(plan, slow), nominal)):
        with refused(sv.errors.SpecificationError, "trolley"):
            sv.output_feedback(*pair, SENSORS)
    with refused(sv.errors.SpecificationError, "0.05 s"):
        sv.output_feedback(law, sv.plant(nominal.mechanism, delay=0.05), SENSORS)
    with refused(sv.errors.ServoError, "Riccati"):
        sv.output_feedback(law, nominal, {"dx": 1e-3})


def test_velocities_alone_do_not_tell_where_an_arm_without_gravity_is():
    mechanism, program = two_link_arm()
    model = sv.derive(mechanism, program).with_parameters(g=0.0)
    plan = sv.simulate(model, model.start(guess={"q1": -0.4, "q2": 1.5}), (0.0, 2.0))
    nominal = sv.plant(mechanism, g=0.0)
    with refused(sv.errors.ServoError, "Riccati"):
        sv.output_feedback(sv.lqr(plan, nominal), nominal, {"dq1": 1e-3, "dq2": 1e-3})
