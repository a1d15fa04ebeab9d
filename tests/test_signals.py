"""Parameters that are functions of time in a closed loop: wind that enters drag by its square."""

import pickle

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import solve_ivp

import servoctl as sv

DRAG = {"m": 2.0, "k": 0.4, "wind": 0.0}
CALM = (0.0, 0.0)


def carriage():
    """A mass with a pendulum that is blown at by the wind, on a program that holds both."""
    p, q = sv.parameters(**DRAG, l=1.5, g=9.81), sv.coordinates("x phi")
    x, phi = q
    bob = ca.vertcat(x + p.l * ca.sin(phi), -p.l * ca.cos(phi))
    relative = p.wind - q.dt(bob[0])
    drag = p.k * relative * ca.fabs(relative)
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.m, x) + sv.particle(q, 1.0, bob), potential=p.g * bob[1], parameters=p,
        forces={"x": drag, "phi": drag * p.l * ca.cos(phi)}, actuators={"force": x, "torque": phi},
        outputs={"drag": drag},
    )  # fmt: skip
    path = sv.paths.rest_to_rest(start=(0.0, 0.0), end=(1.0, 0.3), duration=1.5, smoothness=4)
    r = q.references(x=path[0], phi=path[1])
    model = sv.derive(mechanism, sv.Program({"x": x - r.x, "phi": phi - r.phi}, by="actuators"))
    return sv.simulate(model, model.start(0.0), (0.0, 1.5)), sv.plant(mechanism)


def blowing(t):
    return 6.0 * np.sin(3.0 * t)


@pytest.fixture(scope="module")
def loop():
    plan, plant = carriage()
    law = sv.lqr(plan, plant, integral=True)
    return sv.close(plant, law, plan.state(0.0), (0.0, 2.0), disturbance={"wind": blowing, "x": 0.3})


def free_mass(potential=None, forces=None):
    """A mass that the wind blows away, k(w - v)|w - v|, and a law that does nothing."""
    p, q = sv.parameters(**DRAG), sv.coordinates("x")
    (x,), (dx,) = q, q.d(1)
    relative = p.wind - dx
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.m, x), potential=potential and potential(p, x), parameters=p,
        forces={"x": p.k * relative * ca.fabs(relative)} if forces is None else forces(p, x, dx), actuators={"force": x},
    )  # fmt: skip
    return sv.plant(mechanism)


def blown(plant, disturbance, span=(0.0, 4.0), x0=CALM, substeps=2):
    timing = sv.Timing(rate=100.0, substeps=substeps)
    return sv.close(plant, lambda t, y: [0.0], x0, span, timing=timing, disturbance=disturbance)


@pytest.mark.parametrize("wind", [5.0, sv.disturbances.step(5.0, 0.0), lambda t: 5.0 + 0.0 * t])
def test_a_mass_in_steady_wind_takes_its_speed_by_the_closed_form(wind):
    run = blown(free_mass(), {"wind": wind})
    assert np.abs(run["dx"] - (5.0 - 5.0 / (1.0 + 0.2 * 5.0 * run.t))).max() < 1e-8
    assert np.array_equal(run.disturbance["wind"], np.full(len(run.t), 5.0))
    assert np.array_equal(run.disturbance["x"], np.zeros(len(run.t)))


def test_wind_that_turns_equals_an_independent_integration():
    run = blown(free_mass(), {"wind": blowing, "x": 1.0}, substeps=20)

    def rates(t, x):
        relative = blowing(t) - x[1]
        return [x[1], (0.4 * relative * abs(relative) + 1.0) / 2.0]

    independent = solve_ivp(rates, (0.0, 4.0), CALM, t_eval=run.t, rtol=1e-11, atol=1e-12, max_step=0.01)
    assert np.abs(run.states - independent.y).max() < 1e-8  # the drag has a kink where wind and mass are equally fast


def test_prescribed_accelerations_of_the_ground_are_signals():
    p, q = sv.parameters(m=2.0, ground=0.0), sv.coordinates("x")
    (x,) = q
    gibbs = p.m * (q.d(2)[0] + p.ground) ** 2 / 2
    plant = sv.plant(sv.Mechanism(q, gibbs=gibbs, parameters=p, actuators={"force": x}))
    run = blown(plant, {"ground": lambda t: 3.0 * np.cos(2.0 * t)})
    assert np.abs(run["x"] + 0.75 * (1.0 - np.cos(2.0 * run.t))).max() < 1e-8


def test_a_loop_under_wind_is_verified_with_its_power(loop):
    found = sv.verify(loop)
    assert found.passed, found
    assert "loop power halved" in found.numbers
    relative = loop.disturbance["wind"] - (loop["dx"] + 1.5 * np.cos(loop["phi"]) * loop["dphi"])
    assert np.abs(loop["drag"] - 0.4 * relative * np.abs(relative)).max() < 1e-12
    assert np.abs(loop["drag"]).max() > 5.0
    again = pickle.loads(pickle.dumps(loop))
    assert np.array_equal(again["drag"], loop["drag"])


def test_energy_that_depends_on_a_signal_has_no_balance_of_power():
    plant = free_mass(lambda p, x: p.wind * x**2 / 2, lambda p, x, dx: {"x": -p.k * dx})
    run = blown(plant, {"wind": lambda t: 3.0 + np.sin(5.0 * t)}, x0=(1.0, 0.0))
    found = sv.verify(run)
    assert found.passed
    assert "wind" in str(found)


def test_many_loops_scale_the_wind_of_each(loop):
    factors = np.array([1.0, 0.0, -1.0, 2.0, 0.5])
    masses = np.array([2.0, 2.0, 2.5, 1.5, 2.0])
    many = sv.close_many(loop, {"gust": factors, "m": masses}, scale={"wind": "gust"})
    for i in range(len(factors)):
        disturbance = {"wind": lambda t, f=factors[i]: f * blowing(t), "x": 0.3}
        plant = sv.plant(loop.plant.mechanism, m=masses[i])
        one = sv.close(plant, loop.law, loop.states[:, 0], (0.0, 2.0), disturbance=disturbance)
        for name in ("x", "phi", "dphi"):
            assert many[f"final {name}"][i] == pytest.approx(one[name][-1], abs=1e-11)
            assert many[f"max |{name}|"][i] == pytest.approx(np.abs(one[name]).max(), abs=1e-11)
    assert np.ptp(many["final phi"]) > 1e-3
    with refused(sv.errors.SpecificationError, "scale", name="wind"):
        sv.close_many(loop, {"wind": factors})


def test_material_constraints_hold_under_wind():
    p, q = sv.parameters(**DRAG, l=2.0, g=9.81), sv.coordinates("X Z")
    X, Z = q
    relative = p.wind - q.d(1)[0]
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.m, ca.vertcat(X, Z)), potential=-p.m * p.g * Z, parameters=p,
        forces={"X": p.k * relative * ca.fabs(relative)}, constraints={"rope": X**2 + Z**2 - p.l**2},
        actuators={"force": X},
    )  # fmt: skip
    run = blown(sv.plant(mechanism), {"wind": 4.0}, (0.0, 60.0), (0.0, 2.0, 0.0, 0.0))
    assert np.arctan2(run["X"][-1], run["Z"][-1]) == pytest.approx(np.arctan(0.4 * 16.0 / (2.0 * 9.81)), abs=2e-2)
    assert np.abs(run.residual["rope"]).max() < 1e-9
    with refused(sv.errors.SpecificationError, "constraints", name="l"):
        blown(sv.plant(mechanism), {"l": 2.0}, (0.0, 1.0), (0.0, 2.0, 0.0, 0.0))


def test_parameters_of_inertia_and_unknown_names_are_refused():
    with refused(sv.errors.SpecificationError, "inertia", name="m"):
        blown(free_mass(), {"m": lambda t: 2.0 + t})
    with refused(sv.errors.NameUnknown, match="wind", valid=("x", "m", "k", "wind")):
        blown(free_mass(), {"wnd": 1.0})


def test_python_control_has_the_signal_as_an_input(loop):
    pytest.importorskip("control")
    plant, x = free_mass(), np.array([0.0, 1.5])
    system = sv.interop.nlsys(plant, disturbed=["wind"])
    assert system.input_labels == ["force", "disturbance wind"]
    assert system.dynamics(0.0, x, [0.0, 4.0])[1] == pytest.approx(0.4 * 2.5**2 / 2.0, rel=1e-14)
    windy = sv.plant(plant.mechanism, wind=4.0)
    linear = sv.interop.linearise(windy, 0.0, x, disturbed=["wind"])
    assert linear.A[1, 1] == pytest.approx(-0.4 * 2.5, rel=1e-13)
    assert linear.B[1, 1] == pytest.approx(0.4 * 2.5, rel=1e-13)
    closed = sv.interop.linearise(loop, float(loop.t[30]))
    assert "disturbance wind" in closed.input_labels
    now = sv.plant(loop.plant.mechanism, wind=loop.disturbance["wind"][30])
    alone = sv.interop.linearise(
        now, float(loop.t[30]), loop.states[:, 30], loop.inputs[:, 30], rate=100.0, disturbed=["wind"]
    )
    column = closed.B[:, closed.input_labels.index("disturbance wind")]
    rows = [closed.state_labels.index(f"plant_{name}") for name in loop.plant.state_names]
    assert np.abs(column[rows] - alone.B[:, -1]).max() < 1e-15 < 1e-4 < np.abs(column).max()
