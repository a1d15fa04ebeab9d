"""python-control: nonlinear and linear systems by name, against the toolkit's own loops and numpy."""

import warnings

import control
import numpy as np
import pytest
from refusals import refused
from scenes import CRANE, ROPE
from scipy.optimize import brentq

import servoctl as sv
from servoctl import interop
from servoctl.control.sampling import discretised
from servoctl.errors import NameUnknown, ServoError, SpecificationError
from servoctl.gallery import gallery, mass_on_car

CAR, CAR_PROGRAM = mass_on_car(alpha=0.0)
SUDDEN = {"x": 0.1, "l": 4.0, "theta": -0.05, "dx": 0.0, "dl": 0.1, "dtheta": 0.0}


@pytest.fixture(scope="module")
def car_plan():
    model = sv.derive(CAR, CAR_PROGRAM)
    return sv.simulate(model, model.start(guess={"x": 0.5}, s=0.0), (0.0, 6.0))


@pytest.fixture(autouse=True)
def no_warnings():
    """Of signals that are left unconnected, among others; what control itself uses that NumPy gives up is its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="control")
        yield


def respond(system, t, inputs=0.0, x0=0.0, **options):
    inputs = np.zeros((system.ninputs, len(t))) if np.ndim(inputs) == 0 else inputs
    return control.input_output_response(system, t, inputs, x0, **options)


def same(found, run, names, tolerance=1e-9):
    for name in names:
        assert np.abs(found.outputs[found.output_labels.index(name)] - run[name]).max() < tolerance, name


# closed loops: interconnect against close ------------------------------------------------------------------------------


@pytest.mark.parametrize("integral", [None, True])
def test_interconnect_of_plant_and_lqr_is_close_on_the_crane(plan, integral):
    law = sv.lqr(plan, sv.plant(CRANE), rate=50.0, integral=integral)
    machine = sv.plant(CRANE, m_load=115.0)
    run = sv.close(machine, law, SUDDEN, (0.0, 4.0), timing=sv.Timing(substeps=4))
    loop = control.interconnect(
        [interop.nlsys(machine, rate=50.0, substeps=4), interop.nlsys(law)],
        inputs=[], outputs=[*machine.state_names, *machine.mechanism.outputs, *law.inputs],
    )  # fmt: skip
    found = respond(loop, run.t, x0=np.append(run.states[:, 0], law.state))
    assert loop.state_labels[:6] == [f"plant_{name}" for name in machine.state_names]
    same(found, run, [*machine.state_names, *machine.mechanism.outputs, *machine.inputs])


def test_a_closed_run_becomes_its_loop_with_noise_disturbance_limits_delays_and_lag(plan):
    plant = sv.plant(CRANE, lag={"trolley": 0.05})
    law = sv.lqr(plan, plant, rate=50.0, integral=True)
    limits = {"limits": {"trolley": 140.0}, "rate_limits": {"hoist": 400.0}}
    machine = sv.plant(CRANE, m_load=115.0, lag={"trolley": 0.06}, delay={"hoist": 0.03}, **limits)
    run = sv.close(
        machine,
        law,
        plan.state(0.0),
        (0.0, 3.0),
        sensors=sv.Sensors(noise={"x": 1e-3, "dtheta": 1e-3}, quantisation={"l": 1e-3}),
        timing=sv.Timing(delay=2, substeps=4),
        disturbance={"theta": lambda t: 60.0 * (1.0 < t < 1.5)},
    )
    assert all(np.any(run.active[name]) for name in machine.inputs), "both limits are met"
    loop = interop.nlsys(run)
    inputs = np.zeros((loop.ninputs, len(run.t)))
    for name, values in run.disturbance.items():
        inputs[loop.input_labels.index(f"disturbance {name}")] = values
    for name, values in zip(law.measures, run.loop.noise.T, strict=True):
        label = f"noise {'lagged ' if name in law.inputs else ''}{name}"
        inputs[loop.input_labels.index(label)] = values
    found = respond(loop, run.t, inputs, interop.start(run))
    same(found, run, [name for name in machine.state_names if name != "trolley"])
    same(found, {"lagged trolley": run["trolley"]}, ["lagged trolley"])
    same(found, {f"command {name}": run.command[name] for name in law.inputs}, [f"command {n}" for n in law.inputs])


def test_material_constraints_are_held_in_a_sampled_plant():
    run_plant = sv.plant(ROPE)
    system = interop.nlsys(run_plant, rate=100.0, disturbed=("x",))
    model = sv.derive(*gallery["overhead-crane-redundant"].build())
    x0 = model.start(guess={"l": 4.0}).values[: run_plant.n_x]
    found = respond(system, np.arange(101) / 100, np.zeros((system.ninputs, 101)), x0)
    values = run_plant.function("constraints").grid(found.time, found.states, run_plant.p())
    assert np.abs(values).max() < 1e-9 and np.abs(found.states[:, -1] - x0).max() > 0.1


def test_a_limited_law_is_a_system_too(plan):
    machine = sv.plant(CRANE, m_load=115.0, limits={"trolley": 120.0})
    law = sv.limited(sv.lqr(plan, sv.plant(CRANE), rate=20.0), machine)
    run = sv.close(machine, law, plan.state(0.0), (0.0, 3.0), timing=sv.Timing(substeps=4))
    assert np.any(run.signal["limit trolley"])
    found = respond(interop.nlsys(run), run.t, x0=interop.start(run))
    same(found, run, machine.state_names)


def test_feedforward_alone_is_a_loop_without_measurement(plan):
    run = sv.close(sv.plant(CRANE), sv.feedforward(plan, sv.plant(CRANE)), plan.state(0.0), (0.0, 1.0))
    loop = interop.nlsys(run)
    assert loop.input_labels == ["disturbance x", "disturbance l", "disturbance theta"]
    same(respond(loop, run.t, x0=interop.start(run)), run, ["x", "theta"])


# models and plants in continuous time ----------------------------------------------------------------------------------


def test_a_model_follows_its_program_and_names_its_actuation(plan):
    model = plan.model
    system = interop.nlsys(model)
    assert system.input_labels == [] and system.state_labels == list(model.state_names)
    assert system.output_labels == [*model.state_names, "trolley", "hoist", *model.outputs]
    t = np.linspace(0.0, 1.0, 11)
    found = respond(
        system, t, x0=plan.at(0.0)[: len(model.state_names)], solve_ivp_kwargs={"rtol": 1e-10, "atol": 1e-12}
    )
    expected = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 1.0), t_eval=t)
    same(found, expected, system.output_labels, 1e-5)


def test_parameters_go_by_name_at_run_time(plan):
    plant, u = interop.nlsys(sv.plant(CRANE)), np.array([10.0, -900.0])
    x = np.array([0.1, 3.0, 0.2, 0.3, -0.1, 0.4])
    assert plant.params["m_load"] == 100.0
    assert np.array_equal(plant.dynamics(0.0, x, u, {"m_load": 115.0}), sv.plant(CRANE, m_load=115.0).rates(0.0, x, u))


def test_limits_of_magnitude_hold_in_continuous_time():
    machine = sv.plant(CRANE, limits={"trolley": 5.0})
    x, system = np.array([0.1, 3.0, 0.2, 0.3, -0.1, 0.4]), interop.nlsys(machine, disturbed="theta")
    assert system.input_labels == ["trolley", "hoist", "disturbance theta"]
    found = system.dynamics(0.0, x, np.array([20.0, -900.0, 7.0]))
    assert np.array_equal(found, machine.rates(0.0, x, [5.0, -900.0], [0.0, 0.0, 7.0]))


# exact linearisation ---------------------------------------------------------------------------------------------------


def test_poles_of_the_mass_on_a_car():
    car = interop.linearise(sv.plant(CAR), 0.0, {"x": 0.5, "s": 0.0, "dx": 0.0, "ds": 0.0}, disturbed=("s",))
    m_1, m_2, k, d = 1.0, 2.0, 5.0, 1.0
    expected = np.roots([m_2 * m_1 / (m_1 + m_2), d, k])  # (m_1 m_2/(m_1 + m_2)) s'' + d s' + k s = 0
    found = np.sort_complex(car.poles())
    assert np.abs(found - np.sort_complex(np.append(expected, [0, 0]))).max() < 1e-6
    assert (car.input_labels, car.output_labels) == (["force", "disturbance s"], ["x", "s", "dx", "ds"])
    assert car.state_labels == ["x", "s", "dx", "ds"] and car.name == "plant"
    step = control.step_response(car[2, 0], np.linspace(0, 60.0, 2001))
    slope = np.polyfit(step.time[-500:], step.outputs[-500:], 1)[0]
    assert step.output_labels == ["dx"] and slope == pytest.approx(1 / (m_1 + m_2), rel=1e-4)  # F/(m_1 + m_2)


def test_linearisation_is_that_of_differences_of_the_nonlinear_system(plan):
    x, u = np.array([0.1, 3.0, 0.2, 0.3, -0.1, 0.4, 5.0]), [10.0, -900.0]
    plant = sv.plant(CRANE, lag={"trolley": 0.1})
    forces = ("l", "theta")
    exact = interop.linearise(plant, 0.0, x, u, disturbed=forces)
    near = interop.nlsys(plant, disturbed=forces).linearize(x, np.append(u, [0.0, 0.0]), eps=1e-6)
    for matrix in "ABCD":
        assert np.allclose(getattr(exact, matrix), getattr(near, matrix), rtol=1e-5, atol=1e-4), matrix
    assert exact.output_labels[:7] == ["x", "l", "theta", "dx", "dl", "dtheta", "lagged trolley"]
    sampled = interop.linearise(plant, 0.0, x, u, rate=40.0)
    A, B = discretised(exact.A[None], exact.B[None, :, :2], 1 / 40.0)
    assert sampled.dt == 1 / 40.0 and np.allclose(sampled.A, A[0]) and np.allclose(sampled.B, B[0])
    scipy = control.c2d(control.ss(exact.A, exact.B[:, :2], np.eye(7), 0), 1 / 40.0)
    assert np.allclose(sampled.A, scipy.A, atol=1e-12) and np.allclose(sampled.B, scipy.B, atol=1e-12)


def test_a_model_linearised_tells_how_the_actuation_depends_on_the_state(car_plan):
    model, t = car_plan.model, 1.0
    x = car_plan.at(t)[: len(model.state_names)]
    exact = interop.linearise(model, t, x)
    near = interop.nlsys(model).linearize(x, [], t=t, eps=1e-6)
    assert exact.output_labels == interop.nlsys(model).output_labels and "force" in exact.output_labels
    assert np.abs(exact.A - near.A).max() < 1e-4 and np.abs(exact.C - near.C).max() < 1e-3


def test_margins_of_an_lqr_loop_at_the_end_of_the_plan(car_plan):
    plant = sv.plant(CAR)
    law = sv.lqr(car_plan, plant, rate=100.0)
    end, K = car_plan.t[-1], law.info["gains"][-1]
    own = interop.linearise(plant, end, car_plan.state(end), [car_plan["force"][-1]], rate=100.0)
    gain = interop.loop_gain(own, interop.linearise(law, end), "force")

    def L(w):
        zeta = np.exp(1j * np.atleast_1d(w) / 100.0)[:, None, None]
        return (K @ np.linalg.solve(zeta * np.eye(4) - own.A, own.B[None] + 0j))[:, 0, 0]

    w = np.geomspace(1e-2, np.pi * 100, 20_001)
    response = control.frequency_response(gain, w)
    _, pm, _, _, wgc, _ = control.stability_margins(response)  # not by the polynomial's roots, which rounding moves
    sm = np.abs(1 + response.magnitude * np.exp(1j * response.phase)).min()
    places = np.flatnonzero(np.diff(np.sign(np.abs(L(w)) - 1)))
    crossings = np.array([brentq(lambda v: abs(L(v)[0]) - 1, w[i], w[i + 1], xtol=1e-12) for i in places])
    phases = np.abs(np.angle(-L(crossings), deg=True))
    nearest = int(np.argmin(phases))
    assert pm == pytest.approx(phases[nearest], abs=1e-5)
    assert wgc == pytest.approx(crossings[nearest], rel=1e-6)
    assert sm == pytest.approx(np.abs(1 + L(w)).min(), rel=1e-6)
    magnitude = control.frequency_response(gain, w[::400]).magnitude
    assert np.abs(magnitude / np.abs(L(w[::400])) - 1).max() < 1e-9
    assert 45 < pm and sm > 0.5  # LQR: at least 60 degrees in continuous time


def test_forbidden_directions_are_poles_at_zero_at_rest(plan):
    hanging = {"trolley": 0.0, "hoist": -981.0}
    crane = interop.linearise(sv.plant(CRANE), 0.0, plan.state(0.0), hanging)
    model = sv.derive(*gallery["overhead-crane-redundant"].build())
    start = model.start(guess={"l": 4.0}).values
    rope = interop.linearise(sv.plant(ROPE), 0.0, start[: 2 * model.n], hanging)
    assert rope.nstates == crane.nstates + 2
    moving = [[p for p in np.sort_complex(system.poles()) if abs(p) > 1e-3] for system in (crane, rope)]
    assert len(moving[0]) == 2 and np.allclose(*moving)
    assert np.linalg.matrix_rank(control.ctrb(rope.A, rope.B), tol=1e-9) == crane.nstates


@pytest.mark.parametrize("actuator", ["trolley", "hoist"])
def test_margins_of_one_loop_of_the_crane_with_the_other_closed(plan, actuator):
    plant, t, rate = sv.plant(CRANE), 4.0, 100.0
    law = sv.lqr(plan, plant, rate=rate)
    (own,), (fed,) = interop.along(plant, plan, [t], rate=rate), interop.along(law, plan, [t])
    w = np.geomspace(0.1, 0.99 * np.pi * rate, 4000)
    _, pm, _, _, wgc, _ = control.stability_margins(control.frd(interop.loop_gain(own, fed, actuator), w))
    K, i = law.info["gains"][round(t * rate)], law.inputs.index(actuator)
    zeta = np.exp(1j * w / rate)[:, None, None]
    both = K @ np.linalg.solve(zeta * np.eye(6) - own.A, own.B[None] + 0j)  # L of both loops
    j = 1 - i
    L = both[:, i, i] - both[:, i, j] * both[:, j, i] / (1 + both[:, j, j])
    crossings = np.flatnonzero(np.diff(np.sign(np.abs(L) - 1)))
    phases = np.abs(np.angle(-L[crossings], deg=True))
    assert pm == pytest.approx(phases.min(), abs=0.2) and pm > 45
    assert wgc == pytest.approx(w[crossings[np.argmin(phases)]], rel=3e-3)


def test_poles_of_the_closed_loop_are_those_of_the_gains(plan):
    plant = sv.plant(CRANE)
    law = sv.lqr(plan, plant, rate=50.0, integral=True)
    run = sv.close(plant, law, plan.state(0.0), (0.0, 10.0))
    loop = interop.linearise(run, 10.0)
    radius = np.abs(loop.poles()).max()
    assert isinstance(loop, control.StateSpace) and loop.dt == 1 / 50.0
    assert radius == pytest.approx(law.info["spectral radius at its end"], rel=1e-6) and radius < 1
    assert "plant_theta" in loop.state_labels and "law_integral of X_residual" in loop.state_labels
    assert {"disturbance theta", "noise x"} <= set(loop.input_labels)
    at_rest = loop.dcgain()[:, loop.input_labels.index("disturbance theta")]
    x, theta = (at_rest[loop.output_labels.index(name)] for name in ("x", "theta"))
    assert abs(x + 2.0 * theta) < 1e-9 < abs(theta)  # a constant moment tilts the rope, and leaves the load in place


def test_margins_tell_the_delay_at_which_the_loop_is_lost(car_plan):
    plant = sv.plant(CAR)
    law, end = sv.lqr(car_plan, plant, rate=100.0), car_plan.t[-1]
    own = interop.linearise(plant, end, car_plan.state(end), rate=100.0)
    gain = interop.loop_gain(own, interop.linearise(law, end), "force")
    w = np.geomspace(1e-2, np.pi * 100, 20_001)
    _, pm, _, _, wgc, _ = control.stability_margins(control.frequency_response(gain, w))
    samples = np.deg2rad(pm) / wgc * 100.0
    stable = [
        np.abs(interop.linearise(sv.close(plant, law, car_plan.state(0.0), (0.0, 6.0), timing=t), end).poles()).max() < 1
        for t in (sv.Timing(delay=int(np.floor(samples))), sv.Timing(delay=int(np.ceil(samples))))
    ]
    assert stable == [True, False]


def test_along_a_run_one_system_after_another(plan):
    plant = sv.plant(CRANE)
    law = sv.lqr(plan, plant, rate=50.0)
    times = [0.0, 2.0, 4.0]
    every = zip(times, interop.along(plant, plan, times, rate=50.0), interop.along(law, plan, times), strict=True)
    for t, own, fed in every:
        assert own.dt == fed.dt and fed.input_labels == list(law.measures) and fed.nstates == 0
        assert np.allclose(-fed.D, law.info["gains"][round(50 * t)])
    run = sv.close(plant, law, plan.state(0.0), (0.0, 4.0))
    from_run = list(interop.along(plant, run, [2.0]))[0]
    A, B = plant.linearised(2.0, run.state(2.0)[:, None], run.inputs[:, [100]])
    assert np.allclose(from_run.A, A[0]) and np.allclose(from_run.B, B[0])
    assert [system.nstates for system in interop.along(plan.model, plan, times)] == [6, 6, 6]


def test_output_feedback_and_computed_laws_are_linearised(car_plan, plan):
    plant = sv.plant(CRANE)
    filtered = sv.output_feedback(sv.lqr(plan, plant, rate=50.0), plant, {"x": 1e-3, "l": 1e-3, "theta": 1e-3})
    for law in (filtered, sv.computed(plan, plant)):
        t, z = 2.0, law.state + 0.0
        exact, y = (
            interop.linearise(law, t),
            np.array([plan.state(t)[plant.state_names.index(n)] for n in law.measures]),
        )
        near = interop.nlsys(law).linearize(z, y, t=t, eps=1e-6)
        scale = max(np.abs(exact.D).max(), 1.0)
        assert np.abs(exact.D - near.D).max() < 1e-4 * scale and np.abs(exact.A - near.A).max() < 1e-4
        assert exact.state_labels == list(law.state_names) and exact.output_labels == ["trolley", "hoist"]


# what cannot be --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("action", "error", "fact"),
    [
        (lambda c: interop.nlsys(c["plan"]), SpecificationError, "Run"),
        (lambda c: interop.linearise(3, 0.0), SpecificationError, "int"),
        (lambda c: interop.nlsys(c["law"], rate=10.0), SpecificationError, "rate"),
        (lambda c: interop.nlsys(c["late"]), SpecificationError, "transport delay"),
        (lambda c: interop.nlsys(sv.plant(CRANE), substeps=3), SpecificationError, "substeps"),
        (lambda c: interop.nlsys(sv.plant(CRANE, rate_limits={"hoist": 9.0})), SpecificationError, "limits of rate"),
        (lambda c: interop.nlsys(c["late"], rate=33.0), SpecificationError, {"name": "trolley"}),
        (lambda c: interop.nlsys(sv.plant(CRANE), disturbed=["thet"]), NameUnknown, {"match": "theta"}),
        (lambda c: interop.start(c["plan"]), SpecificationError, "Closed"),
        (lambda c: interop.linearise(sv.plant(CRANE), 0.0), SpecificationError, "6 "),
        (lambda c: interop.linearise(sv.plant(CRANE), 0.0, SUDDEN, [1.0]), SpecificationError, "trolley, hoist"),
        (lambda c: interop.linearise(sv.plant(CRANE), 0.0, SUDDEN, {"hoist": 1.0}), NameUnknown, {"name": "trolley"}),
        (lambda c: list(interop.along(sv.plant(CRANE), c["plan"], [9.0])), SpecificationError, "0 to 8 s"),
        (lambda c: interop.loop_gain(interop.linearise(sv.plant(CRANE), 0.0, SUDDEN), interop.linearise(c["law"], 0.0),
                                     "trolley"), SpecificationError, "0.02 s"),
        (lambda c: interop.loop_gain(sv.plant(CRANE), c["law"], "trolley"), SpecificationError, "Plant"),
        (lambda c: interop.linearise(c["late"], 0.0, SUDDEN), SpecificationError, "0.05 s"),
        (lambda c: interop.linearise(c["law"], 0.0, rate=3.0), SpecificationError, "Law"),
        (lambda c: interop.linearise(c["law"], 0.003), SpecificationError, {"t": 0.003}),
        (lambda c: interop.linearise(c["law"], 0.0, controller_state=[1.0]), SpecificationError, "(1,)"),
        (lambda c: interop.linearise(c["plan"].model, 0.0, [1.0]), SpecificationError, "6 "),
        (lambda c: list(interop.along(3, c["plan"], [0.0])), SpecificationError, "int"),
        (lambda c: list(interop.along(c["law"], c["plan"], [])), SpecificationError, "times"),
        (lambda c: interop.linearise(sv.plant(CRANE), "now", SUDDEN), SpecificationError, {"name": "t"}),
        (lambda c: c["law"].schedule_at(np.nan), SpecificationError, {"name": "t"}),
        (lambda c: interop.loop_gain(interop.linearise(sv.plant(CRANE), 0.0, SUDDEN, rate=50.0),
                                     interop.linearise(c["law"], 0.0), "troley"), NameUnknown, {"match": "trolley"}),
    ],
)  # fmt: skip
def test_what_is_refused(plan, action, error, fact):
    given = {"plan": plan, "law": sv.lqr(plan, sv.plant(CRANE), rate=50.0), "late": sv.plant(CRANE, delay=0.05)}
    with refused(error, fact):
        action(given)


def test_laws_without_expressions_are_refused_where_these_are_needed(plan):
    machine = sv.plant(CRANE, limits={"trolley": 120.0})
    law = sv.limited(sv.lqr(plan, sv.plant(CRANE), rate=20.0), machine)
    with refused(SpecificationError, "limited by weight"):
        interop.linearise(law, 0.0)

    class Own:
        def start(self):
            return lambda t, y: [0.0, -1128.0]

    run = sv.close(sv.plant(CRANE), Own(), SUDDEN, (0.0, 0.1), timing=sv.Timing(rate=100.0))
    with refused(SpecificationError, "'Own'"):
        interop.nlsys(run)


def test_a_model_whose_pivots_vanish_says_so(gallery_model):
    model = gallery_model("overhead-crane")
    with refused(ServoError, t=1.0):
        interop.nlsys(model).dynamics(1.0, np.zeros(6), [])


def test_a_plant_is_linearised_along_a_plan_that_has_fewer_coordinates():
    """A pendulum beside a cart is left out of the plan, and of what is linearised along it."""
    q = sv.coordinates("x phi")
    x, phi = q
    gibbs = sv.particle(q, 3.0, (x,)) + sv.particle(q, 2.0, (phi,))
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=4.0 * phi**2, actuators={"F": x})
    model = sv.derive(mechanism, sv.Program({"X": x - q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0)).X}))
    plan, plant = sv.simulate(model, model.start(), (0.0, 2.0)), sv.plant(mechanism)
    systems = list(interop.along(plant, plan, [0.5, 1.5]))
    for system in systems:
        assert system.state_labels == ["x", "dx"] and system.input_labels == ["F"]
        assert system.A == pytest.approx(np.array([[0, 1], [0, 0]])) and system.B[1, 0] == pytest.approx(1 / 3)
    law = list(interop.along(sv.lqr(plan, plant, 50.0), plan, [0.5]))[0]
    assert list(law.input_labels) == list(systems[0].state_labels)


@pytest.mark.parametrize("disturbed", ["x", ["x"], {"x": 1.0}])
def test_disturbances_of_a_model_are_refused_however_they_are_given(disturbed):
    model = sv.derive(*mass_on_car())
    with refused(SpecificationError, "disturbed"):
        interop.nlsys(model, disturbed=disturbed)
    interop.nlsys(model, disturbed=[])
