"""A plant under inputs that are functions of time, by every method."""

import math
import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import servoctl as sv
from servoctl.errors import SpecificationError

START = {"x": 0.0, "theta": 0.3, "dx": 0.0, "dtheta": 0.0}


@pytest.fixture(scope="module")
def crane():
    q, p = sv.coordinates("x theta"), sv.parameters(m=1.0, l=2.0)
    x, theta = q
    load = ca.vertcat(x + p.l * ca.sin(theta), -p.l * ca.cos(theta))
    return sv.Mechanism(
        q, gibbs=sv.particle(q, 3.0, x) + sv.particle(q, p.m, load), potential=9.81 * p.m * load[1], parameters=p,
        actuators={"trolley": x}, outputs={"X": load[0], "jerk": q.d(3)[0], "snap": q.d(4)[1]},
    )  # fmt: skip


@pytest.fixture(scope="module")
def machine(crane):
    """With other numbers, damping and a force."""
    simple = sv.Mechanism(
        crane.q, gibbs=crane._gibbs, potential=crane.potential, parameters=crane.parameters,
        actuators={"trolley": list(crane.q)[0]}, outputs={"X": crane.outputs["X"]},
    )  # fmt: skip
    return sv.plant(simple, m=1.5, damping={"theta": 0.3}, forces={"x": -0.2 * crane.q.d(1)[0]})


def reference(plant, force, t=2.0):
    solution = solve_ivp(
        lambda t, x: plant.rates(t, x, [force(t)]), (0.0, t), [*START.values()], "DOP853", rtol=1e-12, atol=1e-13
    )
    return solution.y[:, -1]


def ends(run):
    return [run[name][-1] for name in START]


@pytest.mark.parametrize("method", [None, "RadauIIA", "RK8", "LSODA"])
def test_every_method_moves_a_plant(machine, method):
    t = machine.mechanism.q.t
    run = sv.simulate(machine, START, (0.0, 2.0), method, inputs={"trolley": 5 * ca.sin(t)})
    assert ends(run) == pytest.approx(reference(machine, lambda t: 5 * np.sin(t)), abs=1e-7)
    assert run["trolley"] == pytest.approx(5 * np.sin(run.t), abs=1e-14)
    assert run["X"] == pytest.approx(run["x"] + 2.0 * np.sin(run["theta"]), abs=1e-14)
    states = np.array([run[name] for name in START])
    rates = [machine.rates(t, x, [u]) for t, x, u in zip(run.t, states.T, run["trolley"], strict=True)]
    assert [run["d2x"], run["d2theta"]] == pytest.approx(np.array(rates).T[2:], abs=1e-6)
    assert "trolley" in repr(run) and "no program" in repr(run.model)
    if method is None:
        assert sv.verify(run).passed


PUSH = sv.paths.rest_to_rest(0.0, 3.0, 1.5)
FORCES = {
    "number": (lambda q: -1.5, lambda t: -1.5),
    "function": (lambda q: lambda t: 2 * t - ca.cos(t), lambda t: 2 * t - np.cos(t)),
    "path": (lambda q: q.references(push=PUSH).push, PUSH),
    "none": (lambda q: None, lambda t: 0.0),
}


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("kind", FORCES)
def test_inputs_are_numbers_expressions_paths_or_functions(machine, kind):
    make, force = FORCES[kind]
    value = make(machine.mechanism.q)
    inputs = {} if value is None else {"trolley": value}
    run = sv.simulate(machine, [*START.values()], (0.0, 2.0), inputs=inputs)
    assert ends(run) == pytest.approx(reference(machine, force), abs=1e-7)


STEP = sv.paths.polynomials([0.0, 0.7, 2.0], [[0.0, 3.0]])
PATHS = {"smooth": PUSH, "a step": STEP, "a line": 3.0 * sv.paths.polynomials([0.0, 1.0], [[-1.0], [1.0]], before="continue",
                                                                            after="continue")}  # fmt: skip


@pytest.mark.parametrize("limits", [{}, {"trolley": (-1.0, 2.0)}], ids=["free", "limited"])
@pytest.mark.parametrize("method", [None, "RK8"])
def test_inputs_are_paths_which_change_nothing_but_a_table(machine, method, limits):
    """Pieces between breaks and limits are smooth: SciPy's motions from one to the next are exact."""
    plant, models = sv.plant(machine.mechanism, limits=limits), []
    low, high = limits.get("trolley", (-np.inf, np.inf))
    for path in PATHS.values():
        run = sv.simulate(plant, START, (0.0, 2.0), method, inputs={"trolley": path})
        assert run["trolley"] == pytest.approx(np.clip(path(run.t), low, high), abs=1e-14)
        x, cuts = [*START.values()], np.unique([0.0, *(k for k in run.knots if 0.0 < k < 2.0), 2.0])
        for a, b in zip(cuts[:-1], cuts[1:], strict=True):
            x = solve_ivp(
                lambda t, x, b=b, u=path: plant.rates(t, x, [np.clip(u(min(t, b - 1e-12)), low, high)]), (a, b), x, "DOP853",
                rtol=1e-12, atol=1e-13,
            ).y[:, -1]  # fmt: skip
        assert ends(run) == pytest.approx(x, abs=1e-9)
        assert sv.verify(run).passed
        models.append(run.model)
    assert all(model.function("ode") == models[0].function("ode") for model in models), "nothing is compiled for another path"
    assert machine.mechanism.q.family.paths.keys() <= {"push"}, "the plant's coordinates keep their references"


LIMITS = {"trolley": (-1.0, 2.0)}


@pytest.mark.parametrize("limits", [{}, LIMITS], ids=["free", "limited"])
def test_a_spline_of_scipy_is_an_input(machine, limits):
    curve = CubicSpline([0.0, 0.4, 1.1, 2.0], [0.0, 4.0, -3.0, 1.0])
    plant = sv.plant(machine.mechanism, limits=limits)
    run = sv.simulate(plant, START, (0.0, 2.0), inputs={"trolley": curve})
    assert run["trolley"] == pytest.approx(np.clip(curve(run.t), *limits.get("trolley", (-np.inf, np.inf))), abs=1e-13)


@pytest.mark.parametrize("limits", [{}, LIMITS], ids=["free", "limited"])
@pytest.mark.parametrize("formula", [lambda t: ca.if_else(t < 0.5, 10, -10), lambda t: ca.fmax(t - 0.5, 0)])
def test_a_formula_that_switches_with_the_time_is_refused_with_and_without_limits(machine, limits, formula):
    plant = sv.plant(machine.mechanism, limits=limits)
    for value in (formula, formula(machine.mechanism.q.t)):
        with refused(SpecificationError, "A switch in the input 'trolley' is decided by the time alone", "sv.paths"):
            sv.simulate(plant, START, (0.0, 2.0), inputs={"trolley": value})


def test_references_of_inputs_have_names_that_the_user_knows(machine):
    path = sv.paths.rest_to_rest(0.0, sv.parameters(reach=1.0).reach, 1.5)
    with refused(SpecificationError, "The path of the reference 'trolley' contains reach"):
        sv.simulate(machine, START, (0.0, 2.0), inputs={"trolley": path})
    q = sv.coordinates("x")
    r = q.references(push=PUSH, time=PUSH)
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, [q[0]]), forces={"x": r.push + r.time}, actuators={"push": q[0]})
    for force, names in ((PUSH, {"push", "time", "push_path"}), (ca.sin(q.t), {"push", "time", "time_path"})):
        run = sv.simulate(sv.plant(mechanism, limits={"push": (-1.0, 1.0)}), {"x": 0.0, "dx": 0.0}, (0.0, 1.5), inputs={"push": force})
        assert run.model.paths.keys() == names
        force = PUSH(run.t) if isinstance(force, sv.paths.Path) else np.sin(run.t)
        assert run["d2x"] == pytest.approx(2 * PUSH(run.t) + np.clip(force, -1.0, 1.0), abs=1e-9)


def test_inputs_stay_within_their_limits(machine):
    plant = sv.plant(machine.mechanism, limits={"trolley": (-1.0, 2.0)})
    run = sv.simulate(plant, START, (0.0, 6.0), inputs={"trolley": 5 * ca.sin(machine.mechanism.q.t)})
    assert run["trolley"] == pytest.approx(np.clip(5 * np.sin(run.t), -1.0, 2.0), abs=1e-14)
    assert ends(run) == pytest.approx(reference(plant, lambda t: np.clip(5 * np.sin(t), -1.0, 2.0), 6.0), abs=1e-5)
    assert sv.verify(run).passed


@pytest.mark.parametrize("method", [None, "RK4"])
def test_a_plant_that_falls_has_no_internal_dynamics(machine, method):
    """Errors grow near upright, but no program leaves that motion free."""
    times = np.linspace(0.0, 4.0, 41)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = sv.simulate(machine, START | {"theta": 3.1}, (0.0, 4.0), method, inputs={"trolley": 0.0}, t_eval=times)
    assert run.internal == {} and np.array_equal(run.t, times)
    assert sv.internal_dynamics(run).verdict == "unstable", "of errors near upright"
    assert sv.verify(run).passed


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("part", ["a force", "an input", "states", "parameters"])
def test_wrong_runs_of_a_plant_do_not_pass(machine, part):
    t = machine.mechanism.q.t
    run = sv.simulate(machine, START, (0.0, 2.0), inputs={"trolley": 5 * ca.sin(t)})
    model, others = run.model, {
        "a force": sv.plant(machine.mechanism, m=1.5, damping={"theta": 0.3}), "parameters": machine.mechanism,
    }  # fmt: skip
    if part in others:
        plant = others[part] if part == "a force" else sv.plant(others[part], damping={"theta": 0.3})
        model = sv.simulate(plant, START, (0.0, 0.1), inputs={"trolley": 5 * ca.sin(t)}).model
    if part == "an input":
        model = sv.simulate(machine, START, (0.0, 0.1), inputs={"trolley": 5.01 * ca.sin(t)}).model
    jets = run.jets if part != "states" else run.jets * np.where(np.arange(len(run.t)) == 500, 1.001, 1.0)
    assert not sv.verify(replace(run, model=model, jets=jets, variants=(), stored={}, stored_residual={})).passed


def test_material_constraints_hold_in_a_driven_plant():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 1.0, ca.vertcat(x, y)), potential=9.81 * y, constraints={"rod": x**2 + y**2 - 1},
        actuators={"push": x},
    )  # fmt: skip
    plant = sv.plant(mechanism)
    run = sv.simulate(plant, [1.0, 0.0, 0.0, 0.0], (0.0, 2.0), drift="project", inputs={"push": 0.5})

    def swing(t, s):
        return [s[1], -0.5 * np.sin(s[0]) - 9.81 * np.cos(s[0])]

    angle = solve_ivp(swing, (0.0, 2.0), [0.0, 0.0], "DOP853", rtol=1e-12, atol=1e-13).y[0, -1]
    assert [run["x"][-1], run["y"][-1]] == pytest.approx([np.cos(angle), np.sin(angle)], abs=1e-6)
    assert sv.verify(run).passed
    with refused(sv.errors.InconsistentStart, "rod"):
        sv.simulate(plant, [1.1, 0.0, 0.0, 0.0], (0.0, 2.0))


@pytest.mark.parametrize(("inputs", "kind", "details"), [
    ({"winch": 1.0}, sv.errors.NameUnknown, {"name": "winch"}),
    ({"trolley": lambda t: math.floor(t)}, sv.errors.SpecificationError, {}),
    ({"trolley": "full"}, sv.errors.SpecificationError, {"type": "str"}),
    ({"trolley": np.nan}, sv.errors.SpecificationError, {"what": "the input 'trolley'"}),
    ({"trolley": [1.0, 2.0]}, sv.errors.SpecificationError, {"entries": 2}),
    (7.0, sv.errors.SpecificationError, {}),
])  # fmt: skip
def test_other_inputs_are_refused(machine, inputs, kind, details):
    with refused(kind, **details):
        sv.simulate(machine, START, (0.0, 1.0), inputs=inputs)


@pytest.mark.parametrize("option", [{"lag": {"trolley": 0.1}}, {"delay": 0.1}, {"rate_limits": {"trolley": 1.0}}])
def test_actuators_that_do_not_act_at_once_are_refused(machine, option):
    with refused(sv.errors.SpecificationError, name=next(iter(option))):
        sv.simulate(sv.plant(machine.mechanism, **option), START, (0.0, 1.0))


def test_simulate_says_what_it_takes(machine, gallery_model):
    for other in (machine.mechanism, 3, None):
        with refused(sv.errors.SpecificationError, type=type(other).__name__):
            sv.simulate(other, START, (0.0, 1.0))
    model = gallery_model("overhead-crane")
    with refused(sv.errors.SpecificationError, "inputs", type="Model"):
        sv.simulate(model, model.start(), (0.0, 1.0), inputs={"trolley": 0.0})


def test_outputs_of_higher_order_in_a_closed_loop(crane):
    """With the input held, jerk and snap are total derivatives of the accelerations."""
    model = sv.derive(
        sv.Mechanism(crane.q, gibbs=crane._gibbs, potential=crane.potential, parameters=crane.parameters,
                     actuators={"trolley": list(crane.q)[0]}),
        sv.Program({"x": list(crane.q)[0] - crane.q.references(x=sv.paths.rest_to_rest(0.0, 1.0, 2.0)).x}),
    )  # fmt: skip
    plan = sv.simulate(model, model.start(theta=0.1, dtheta=0.0), (0.0, 2.0), t_eval=np.linspace(0, 2, 201))
    plant = sv.plant(crane)
    closed = sv.close(plant, sv.lqr(plan, plant, rate=100), plan.state(0.0), (0.0, 2.0), plan=plan)
    k, h = 70, 1e-4
    x, u = closed.states[:, k], closed.inputs[:, k]

    def accelerations(s):  # on the motion with this input, near the sample
        solution = solve_ivp(lambda t, x: plant.rates(t, x, u), (0.0, s), x, "DOP853", rtol=1e-13, atol=1e-14)
        return plant.rates(0.0, solution.y[:, -1], u)[2:]

    before, now, after = (accelerations(s) for s in (-h, 0.0, h))
    assert closed["jerk"][k] == pytest.approx((after[0] - before[0]) / (2 * h), abs=1e-5)
    assert closed["snap"][k] == pytest.approx((after[1] - 2 * now[1] + before[1]) / h**2, abs=1e-2)


def test_a_plant_of_one_coordinate_moves():
    q = sv.coordinates("x")
    (x,), (dx,) = q, q.d(1)
    mechanism = sv.Mechanism(q, gibbs=q.d(2)[0] ** 2, potential=x**2, forces={"x": -0.1 * dx}, actuators={"F": x})
    run = sv.simulate(sv.plant(mechanism), [0.5, 1.0], (0.0, 3.0), inputs={"F": 0.3})
    decay, rate = 0.025, np.sqrt(1.0 - 0.025**2)  # of 2 x'' + 0.1 x' + 2 x = 0.3
    a, t = 0.35, run.t
    expected = 0.15 + np.exp(-decay * t) * (a * np.cos(rate * t) + (1.0 + decay * a) / rate * np.sin(rate * t))
    assert run["x"] == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("name", ["damping", "forces", "mechanism", "limits", "rate_limits", "lag", "delay"])
def test_a_parameter_may_have_the_name_of_an_option(name):
    q, p = sv.coordinates("x"), sv.parameters(**{name: 2.0})
    mechanism = sv.Mechanism(q, sv.particle(q, getattr(p, name), q["x"]), actuators={"F": q["x"]}, parameters=p)
    r = q.references(path=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=2))
    program = sv.Program({"path": q["x"] - r.path})
    run = sv.relaxed(sv.plant(mechanism), program, (0.0, 1.0))
    assert np.abs(run["F"]).max() == pytest.approx(2.0 * 10 / np.sqrt(3), rel=0.05)  # of the quintic
