"""Relaxed plans against closed forms, the exact inverse, other integrators, and what limits allow."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import solve_ivp, trapezoid
from scipy.optimize import approx_fprime
from test_bounded import flexible_link

import servoctl as sv
from servoctl.control.nonlinear import IPOPT, LONGEST
from servoctl.errors import InconsistentStart, IntegrationStopped, LimitExceeded, NameUnknown, SpecificationError
from servoctl.gallery import overhead_crane
from servoctl.inversion.relaxed import DEFECT, FACTOR, FIRST, Relaxation
from servoctl.inversion.transcription import WATCHED, Mesh, Transcription, bernstein
from servoctl.study.load import load

rest_to_rest = sv.paths.rest_to_rest


def fixed_rope_crane():
    """A cart of 10 kg under a force, a load of 100 kg on a rope of 4 m, which goes 5 m in 6 s."""
    q, p = sv.coordinates("x theta"), sv.parameters(M=10.0, m=100.0, L=4.0, g=9.81)
    x, theta = q
    load = ca.vertcat(x + p.L * ca.sin(theta), -p.L * ca.cos(theta))
    tension = p.m * (p.g * ca.cos(theta) + p.L * q.d(1)[1] ** 2 - ca.sin(theta) * q.d(2)[0])
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.M, x) + sv.particle(q, p.m, load), potential=p.m * p.g * load[1], parameters=p,
        actuators={"cart": x}, outputs={"tension": tension},
    )  # fmt: skip
    return mechanism, sv.Program({"X": load[0] - q.references(X=rest_to_rest(0.0, 5.0, 6.0)).X})


@pytest.fixture(scope="module")
def crane():
    mechanism, program = fixed_rope_crane()
    return sv.plant(mechanism), program


@pytest.fixture(scope="module")
def plan(crane):
    return sv.relaxed(*crane, (0.0, 6.0), weight=1e-8)


@pytest.fixture(scope="module")
def coarse(crane):
    return sv.relaxed(*crane, (0.0, 6.0), weight=1e-6)


@pytest.fixture(scope="module")
def front(crane):
    return sv.relaxed(*crane, (0.0, 6.0), weight=[1e-12, 1e-10, 1e-8, 1e-6])


def integrated(run, plant, t_eval=None):
    """States of the plant under the run's inputs, by SciPy."""
    pieces = [run.t[0], *run.knots, run.t[-1]]
    paths = [run.model.paths[name] for name in plant.inputs]
    x = np.array([run[name][0] for name in plant.state_names])
    for a, b in zip(pieces[:-1], pieces[1:], strict=True):
        middle = (a + b) / 2  # inside, so that a piece is smooth

        def rates(t, x, a=a, b=b, middle=middle):
            return plant.rates(t, x, [path(t) for path in paths])

        x = solve_ivp(rates, (a, b), x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return x


# --- the fixed-rope crane, which no exact inverse moves from rest to rest


def test_the_error_falls_with_the_weight_as_known(front):
    """Worst errors of the load [mm] by an independent relaxation with IPOPT."""
    known = {1e-6: 21.6, 1e-8: 0.238, 1e-10: 0.0028, 1e-12: 0.0001}
    assert front["weight"].tolist() == [1e-12, 1e-10, 1e-8, 1e-6]
    for weight, largest in zip(front["weight"], front["largest X"], strict=True):
        assert 1e3 * largest == pytest.approx(known[weight], rel=0.02, abs=1.5e-5)
    assert front["largest cart"][0] <= 132.98
    assert np.all(np.diff(front["effort"]) < 0)  # a front: less error costs more effort
    assert front["iterations"].max() <= 10
    assert front["defect"].max() <= DEFECT


def test_a_plan_is_a_verified_run_of_the_plant(plan, crane):
    plant, _ = crane
    assert plan.success and "X 0.00024" in plan.message
    verification = sv.verify(plan)
    assert verification.passed and any("X is at most 0.00024" in note for note in verification.notes)
    assert plan.residual["X"].shape == (1, len(plan.t))
    X = plan["x"] + 4.0 * np.sin(plan["theta"])
    s = np.clip(plan.t / 6.0, 0.0, 1.0)
    target = 5.0 * s**5 * (126 - 420 * s + 540 * s**2 - 315 * s**3 + 70 * s**4)
    assert plan.residual["X"][0] == pytest.approx(X - target, abs=1e-12)
    ends = np.array([plan[name][[0, -1]] for name in plant.state_names])
    assert ends == pytest.approx(np.array([[0, 5], [0, 0], [0, 0], [0, 0]]), abs=1e-12)
    assert np.degrees(np.abs(plan["theta"]).max()) == pytest.approx(7.66, abs=5e-3)
    assert plan["dcart"] == pytest.approx(np.gradient(plan["cart"], plan.t), abs=1.0)


def test_other_integrators_give_the_same_motion(plan, crane):
    end = [plan[name][-1] for name in crane[0].state_names]
    assert integrated(plan, crane[0]) == pytest.approx(np.array(end), abs=1e-7)
    for method in (sv.methods.Taylor(), sv.methods.RadauIIA()):
        again = sv.simulate(plan.model, plan.start, (0.0, 6.0), method, t_eval=plan.t)
        assert again["theta"] == pytest.approx(plan["theta"], abs=1e-7)


def test_the_cost_is_least_at_the_own_weight(front):
    """The plan of a weight costs less under it than plans of other weights do."""
    for weight in front["weight"]:
        costs = front["rms X"] ** 2 * 6.0 / weight + front["effort"]
        assert costs[front["weight"] == weight] <= costs.min() * (1 + 1e-6)


def test_a_plan_is_saved_and_loaded_with_its_model(plan, tmp_path):
    again = load(plan.save(tmp_path / "plan"), plan.model)
    assert again == plan and again.residual["X"] == pytest.approx(plan.residual["X"])


def test_laws_follow_a_plan(plan, crane):
    plant, _ = crane
    law = sv.lqr(plan, plant, rate=200.0, integral=True)
    heavier = sv.plant(plant.mechanism, m=105.0)
    loop = sv.close(heavier, law, plan.state(0.0), (0.0, 6.0))
    error = loop["x"] + 4.0 * np.sin(loop["theta"]) - np.interp(loop.t, plan.t, plan["x"] + 4.0 * np.sin(plan["theta"]))
    assert np.abs(error).max() < 0.05
    feedforward = sv.close(plant, sv.feedforward(plan, plant, rate=500.0), plan.state(0.0), (0.0, 6.0))
    assert feedforward["x"][-1] == pytest.approx(5.0, abs=5e-3)


def test_the_default_weight_keeps_the_program_to_a_thousandth(crane):
    run = sv.relaxed(*crane, (0.0, 6.0))
    assert 1e-6 < np.abs(run.residual["X"]).max() / 5.0 < 1e-3


def test_effort_is_counted_from_the_wish(crane, coarse):
    plant, program = crane
    wish = sv.Program(program.residuals, toward={"cart": 60 * ca.sin(4 * plant.mechanism.q.t)})
    run = sv.relaxed(plant, wish, (0.0, 6.0), weight=1e-6)

    def cost(run):
        return trapezoid(run.residual["X"][0] ** 2 / 1e-6 + (run["cart"] - 60 * np.sin(4 * run.t)) ** 2, run.t)

    assert cost(run) < 0.99 * cost(coarse)


# --- limits and bounds


def test_limits_hold_at_all_instants(crane):
    run = sv.relaxed(*crane, (0.0, 6.0), weight=1e-6, limits={"cart": 110.0, "dcart": 400.0})
    dense = run.model.paths["cart"](np.linspace(0.0, 6.0, 20_001))
    assert 110.0 - 1e-3 < np.abs(dense).max() <= 110.0 + 1e-9
    assert np.abs(np.diff(dense)).max() / (6.0 / 20_000) <= 400.0 + 1e-4
    assert sv.verify(run).passed


@pytest.mark.parametrize("bounds, values", [
    ({"theta": np.radians(6.0)}, lambda run: np.degrees(np.abs(run["theta"]).max()) / 6.0),
    ({"d2theta": 0.25}, lambda run: np.abs(run["d2theta"]).max() / 0.25),
    ({"X": (-0.004, None)}, lambda run: -run.residual["X"].min() / 0.004),
])  # fmt: skip
def test_bounds_hold_at_their_instants(crane, coarse, bounds, values):
    assert values(coarse) > 1.001
    run = sv.relaxed(*crane, (0.0, 6.0), weight=1e-6, bounds=bounds)
    edges = np.array([0.0, *run.knots, 6.0])
    instants = (edges[:-1, None] + np.diff(edges)[:, None] * np.arange(WATCHED) / WATCHED).ravel()
    there, plant = run.sampled(instants), crane[0]
    u = run.model.paths["cart"]
    states = there.jets[:4]  # interpolated accelerations have errors where inputs have corners
    rates = [plant.rates(t, x, [u(t)]) for t, x in zip(instants, states.T, strict=True)]
    assert values(replace(there, jets=np.vstack([states, np.transpose(rates)[2:]]))) <= 1.0 + 1e-6
    excess = values(run) - 1.0
    assert excess < 1e-2
    assert ("exceeds its bound" in run.message) == (excess > 1e-6)


def test_a_bound_keeps_the_rope_of_a_flat_crane_taut():
    """3 m down in 1.2 s: more than free fall for a while, where the exact inverse is singular."""
    mechanism, _ = overhead_crane()
    x, l, theta = mechanism.q
    path = rest_to_rest((0.0, 2.0), (1.0, 5.0), 1.2)
    r = mechanism.q.references(across=path[0], below=path[1])
    program = sv.Program({"X": x + l * ca.sin(theta) - r.across, "Z": l * ca.cos(theta) - r.below})
    task = {"start": {"l": 2.0}, "bounds": {"tension": (100.0, None)}, "weight": 2e-8}
    run = sv.inverse(mechanism, program, (0.0, 1.2), **task)
    assert "relaxed, as the exact plan ends: The program is singular at t = 0.2" in run.message
    assert 95.0 < run["tension"].min() < 101.0 and sv.verify(run).passed
    Z = run["l"] * np.cos(run["theta"])
    fall = np.gradient(np.gradient(Z, run.t), run.t)[2:-2]
    assert fall.max() < 9.81  # a load on a taut rope falls less than freely
    with refused(sv.errors.SingularProgram):
        sv.inverse(mechanism, program, (0.0, 1.2), start={"l": 2.0})


def test_a_speed_within_its_bound(crane, coarse):
    speed = 0.97 * np.abs(coarse["dx"]).max()
    run = sv.relaxed(*crane, (0.0, 6.0), weight=1e-6, bounds={"dx": speed})
    assert 0.99 * speed < np.abs(run["dx"]).max() < 1.001 * speed


@pytest.mark.parametrize("options, kind, facts", [
    ({"bounds": {"cart": 10.0}}, SpecificationError, {"name": "cart"}),
    ({"bounds": {"dcart": 10.0}}, SpecificationError, {"name": "dcart"}),
    ({"bounds": {"x": (0.1, None)}}, LimitExceeded, {"name": "x", "t": 0.0, "value": 0.0}),
    ({"bounds": {"x": (None, 4.0)}}, LimitExceeded, {"name": "x", "t": 6.0, "limit": (-np.inf, 4.0)}),
    ({"bounds": {"dtheta": (0.1, 1.0)}}, LimitExceeded, {"name": "dtheta", "value": 0.0}),
])  # fmt: skip
def test_bounds_that_no_input_can_keep_are_refused_at_once(crane, options, kind, facts):
    with refused(kind, facts["name"], **facts):
        sv.relaxed(*crane, (0.0, 6.0), weight=1e-6, **options)


def test_material_constraints_and_quasi_velocities_change_nothing(plan):
    q = sv.coordinates("x X Z")  # the load by its position
    x, X, Z = q
    S = sv.particle(q, 10.0, x) + sv.particle(q, 100.0, ca.vertcat(X, Z))
    rope = ((X - x) ** 2 + Z**2 - 16.0) / 2
    absolute = sv.Mechanism(q, gibbs=S, potential=981.0 * Z, actuators={"cart": x}, constraints={"rope": rope})
    program = sv.Program({"X": X - q.references(X=rest_to_rest(0.0, 5.0, 6.0)).X})
    run = sv.relaxed(sv.plant(absolute), program, (0.0, 6.0), weight=1e-8, start={"Z": -4.0})
    assert run.sampled(plan.t)["cart"] == pytest.approx(plan["cart"], abs=1e-3)
    assert (run["X"] - run["x"]) ** 2 + run["Z"] ** 2 == pytest.approx(16.0, abs=1e-8)
    assert sv.verify(run).passed

    q = sv.coordinates("x theta").with_quasi_velocities("u v", [[1, 0], [-2 * ca.cos(0.3), 1]])
    x, theta = q
    load = ca.vertcat(x + 4.0 * ca.sin(theta), -4.0 * ca.cos(theta))
    S = sv.particle(q, 10.0, x) + sv.particle(q, 100.0, load)
    other = sv.Mechanism(q, gibbs=S, potential=981.0 * load[1], actuators={"cart": x})
    program = sv.Program({"X": load[0] - q.references(X=rest_to_rest(0.0, 5.0, 6.0)).X})
    run = sv.relaxed(sv.plant(other), program, (0.0, 6.0), weight=1e-8)
    assert run.sampled(plan.t)["cart"] == pytest.approx(plan["cart"], abs=1e-3)
    assert sv.verify(run).passed


def test_a_residual_of_third_order(crane):
    """The cart's jerk follows a path, with the states at the end given."""
    plant, _ = crane
    q = plant.mechanism.q
    path = rest_to_rest(0.0, 5.0, 6.0)
    (jerk,) = q.references(along=path).d(3)
    end, largest = {"x": 5.0, "theta": 0.0, "dx": 0.0, "dtheta": 0.0}, []
    for weight in (1e-3, 1e-4):
        run = sv.relaxed(plant, sv.Program({"jerk": q.d(3)[0] - jerk}), (0.0, 6.0), weight=weight, end=end)
        missed = run.residual["jerk"][0]
        measured = np.gradient(run["d2x"], run.t)
        target = path.jets(run.t, 3)[3, 0]
        assert np.percentile(np.abs(measured - target - missed), 95) < 0.01  # the input has corners
        assert run["x"][-1] == pytest.approx(5.0, abs=1e-9) and sv.verify(run).passed
        largest.append(np.sqrt(np.mean(missed**2)))
    assert largest[1] < largest[0]


def test_limits_and_friction_of_the_plant_hold():
    mechanism, program = fixed_rope_crane()
    plant = sv.plant(mechanism, damping={"theta": 20.0}, forces={"x": -5.0 * mechanism.q.d(1)[0]},
                     limits={"cart": 140.0}, rate_limits={"cart": 300.0}, lag={"cart": 0.05}, delay=0.02)  # fmt: skip
    run = sv.relaxed(plant, program, (0.0, 6.0), weight=1e-8)
    assert np.abs(run["cart"]).max() <= 140.0 and run["cart"][0] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(run.residual["X"]).max() < 1e-3
    x = integrated(run, sv.plant(mechanism, damping={"theta": 20.0}, forces={"x": -5.0 * mechanism.q.d(1)[0]}))
    assert x == pytest.approx(np.array([5.0, 0.0, 0.0, 0.0]), abs=1e-6)


# --- machines whose internal dynamics are unstable or that are singular at rest


def ball_and_beam():
    q, p = sv.coordinates("r alpha"), sv.parameters(m=0.11, J=0.02, g=9.81)
    r, alpha = q
    dr, dalpha = q.d(1)
    kinetic = 1.4 * p.m * dr**2 / 2 + (p.m * r**2 + p.J) * dalpha**2 / 2
    mechanism = sv.Mechanism(
        q, kinetic=kinetic, potential=p.m * p.g * r * ca.sin(alpha), parameters=p, actuators={"torque": alpha}
    )
    return mechanism, sv.Program({"r": r - q.references(r=rest_to_rest(-0.3, 0.3, 3.0)).r}), (0.0, 3.0), 1e-6, 0.6


def cart_pole():
    q, p = sv.coordinates("x theta"), sv.parameters(M=1.0, m=0.2, L=0.5, g=9.81)
    x, theta = q
    bob = ca.vertcat(x + p.L * ca.sin(theta), p.L * ca.cos(theta))
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.M, x) + sv.particle(q, p.m, bob), potential=p.m * p.g * bob[1], parameters=p,
        actuators={"force": x},
    )  # fmt: skip
    to = q.references(x=rest_to_rest(0.0, 1.0, 2.0, t_start=1.5))
    return mechanism, sv.Program({"x": x - to.x}), (0.0, 5.0), 1e-6, 1.0


def furuta():
    q, p = sv.coordinates("phi theta"), sv.parameters(J=0.01, m=0.1, r=0.2, l=0.15, g=9.81)
    phi, theta = q
    across = p.l * ca.sin(theta)
    bob = ca.vertcat(
        p.r * ca.cos(phi) - across * ca.sin(phi), p.r * ca.sin(phi) + across * ca.cos(phi), p.l * ca.cos(theta)
    )
    speed = ca.jacobian(bob, q.jet(0)) @ q.jet(1)
    kinetic = p.J * q.d(1)[0] ** 2 / 2 + p.m * ca.dot(speed, speed) / 2
    mechanism = sv.Mechanism(
        q, kinetic=kinetic, potential=p.m * p.g * bob[2], parameters=p, actuators={"torque": phi}
    )
    program = sv.Program({"phi": phi - q.references(phi=rest_to_rest(0.0, np.pi / 2, 1.0, t_start=1.0)).phi})
    return mechanism, program, (0.0, 3.0), 1e-4, np.pi / 2


def acrobot():
    q, p = sv.coordinates("q1 q2"), sv.parameters(m=1.0, l=1.0, g=9.81)  # angles from upright
    first, second = q
    ddq = q.d(2)
    centres = [p.l / 2 * ca.vertcat(ca.sin(first), ca.cos(first))]
    centres += [2 * centres[0] + p.l / 2 * ca.vertcat(ca.sin(first + second), ca.cos(first + second))]
    turning = p.m * p.l**2 / 12 * (ddq[0] ** 2 + (ddq[0] + ddq[1]) ** 2) / 2
    mechanism = sv.Mechanism(
        q, gibbs=sum(sv.particle(q, p.m, c) for c in centres) + turning, parameters=p,
        potential=p.m * p.g * (centres[0][1] + centres[1][1]), actuators={"elbow": second},
    )  # fmt: skip
    to = q.references(q2=rest_to_rest(0.0, 0.6, 2.0, t_start=3.0))
    return mechanism, sv.Program({"q2": second - to.q2}), (0.0, 8.0), 1e-7, 0.6


@pytest.mark.parametrize("scene", [ball_and_beam, cart_pole, furuta, acrobot])
def test_the_plant_follows_the_plan(scene):
    mechanism, program, span, weight, stroke = scene()
    plant = sv.plant(mechanism)
    run = sv.relaxed(plant, program, span, weight=weight)
    (name,) = program.names
    if scene is acrobot:  # whose errors grow by e^40 in the span: a law about the plan holds the plant
        law = sv.lqr(run, plant, rate=1000.0)
        loop = sv.close(plant, law, run.state(0.0), span)
        assert np.abs(loop["q2"] - np.interp(loop.t, run.t, run["q2"])).max() < 1e-3 * stroke
    else:
        again = sv.simulate(run.model, run.start, span, sv.methods.Taylor(rtol=1e-12, atol=1e-14), t_eval=run.t)
        assert np.abs(again.residual[name]).max() < 1e-3 * stroke
    assert np.abs(run.residual[name]).max() < 1e-3 * stroke
    assert sv.verify(run).passed


def test_stiff_machines_are_solved_in_a_few_iterations():
    """Eight segments, the first solution, with modes of 650 rad/s in intervals of 0.09 s."""
    mechanism, program = flexible_link(8)
    relaxation = Relaxation(sv.plant(mechanism), program, (0.0, 2.2), {}, None, None, "rest")
    plan = relaxation._solved(relaxation._first(relaxation._mesh()), [FIRST * relaxation._usual_weights()])
    assert plan.iterations[0] <= 5


# --- towards the exact inverse


def test_a_minimum_phase_plan_tends_to_the_exact_inverse_in_proportion_to_the_weight():
    """A passive joint between two links: error and internal dynamics alike."""
    q, p = sv.coordinates("q1 q2"), sv.parameters(m=6.875, l=1.0, I=0.57, c=50.0, d=5.0)
    first, second = q
    (dd1, dd2), along = q.d(2), [ca.vertcat(ca.cos(a), ca.sin(a)) for a in (first, first + second)]
    centres = [p.l / 2 * along[0], p.l * along[0] + p.l / 2 * along[1]]
    mechanism = sv.Mechanism(
        q, gibbs=sum(sv.particle(q, p.m, c) for c in centres) + p.I * (dd1**2 + (dd1 + dd2) ** 2) / 2, parameters=p,
        potential=p.c * second**2 / 2, forces={"q2": -p.d * q.d(1)[1]}, actuators={"motor": first},
    )  # fmt: skip
    program = sv.Program({"y": first + 0.3 * second - q.references(y=rest_to_rest(0.0, np.pi / 2, 2.0)).y})
    model = sv.derive(mechanism, program)
    exact = sv.simulate(model, model.start(), (0.0, 6.0))
    errors = []
    for weight in (1e-8, 1e-9):
        run = sv.relaxed(sv.plant(mechanism), program, (0.0, 6.0), weight=weight)
        moving = (run.t > 0.5) & (run.t < 3.0)
        swing = run["q2"] - np.interp(run.t, exact.t, exact["q2"])
        errors.append([np.abs(values[moving]).max() for values in (run.residual["y"][0], swing)])
    assert np.log10(np.divide(*errors)) == pytest.approx(np.ones(2), abs=0.1)


def test_two_trolleys_with_hoists_carry_a_beam():
    q, p = sv.coordinates("x1 x2 X Z phi"), sv.parameters(mt=20.0, M=200.0, J=60.0, b=1.5, g=9.81)
    x1, x2, X, Z, phi = q
    half = p.b * ca.vertcat(ca.cos(phi), ca.sin(phi))
    ropes = [ca.norm_2(ca.vertcat(X, Z) + side * half - ca.vertcat(x, 0)) for side, x in ((-1, x1), (1, x2))]
    masses = sv.particle(q, p.mt, x1) + sv.particle(q, p.mt, x2) + sv.particle(q, p.M, ca.vertcat(X, Z))
    mechanism = sv.Mechanism(
        q, gibbs=masses + p.J * q.d(2)[4] ** 2 / 2, potential=-p.M * p.g * Z, parameters=p,
        actuators={"trolley1": x1, "trolley2": x2, "hoist1": ropes[0], "hoist2": ropes[1]},
    )  # fmt: skip
    path = rest_to_rest((0.0, 5.0, 0.0), (4.0, 4.0, 0.3), 5.0)
    r = q.references(X=path[0], Z=path[1], phi=path[2])
    program = sv.Program({"X": X - r.X, "Z": Z - r.Z, "phi": phi - r.phi, "gap": x2 - x1 - 3.0})
    start = {"x1": -1.5, "x2": 1.5, "X": 0.0, "Z": 5.0, "phi": 0.0}
    run = sv.relaxed(sv.plant(mechanism), program, (0.0, 5.0), weight=1e-10, start=start)
    assert sv.verify(run).passed
    assert max(np.abs(run.residual[name]).max() for name in program.names) < 2e-5
    assert run["hoist1"][0] + run["hoist2"][0] == pytest.approx(-200.0 * 9.81, rel=1e-3)
    again = sv.simulate(run.model, run.start, (0.0, 5.0), sv.methods.Taylor(), t_eval=run.t)
    assert again["X"] == pytest.approx(run["X"], abs=1e-6)


# --- bad input


def test_refusals(crane):
    plant, program = crane
    span = (0.0, 6.0)
    with refused(NameUnknown, "'Y'", "X"):
        sv.relaxed(plant, program, span, weight={"Y": 1e-8})
    with refused(NameUnknown, match="cart"):
        sv.relaxed(plant, program, span, weight=1e-8, limits={"kart": 1.0})
    with refused(NameUnknown, match="theta"):
        sv.relaxed(plant, program, span, weight=1e-8, bounds={"thet": 1.0})
    with refused(SpecificationError, "1", name="X", weight=1e3):  # mm²/N²
        sv.relaxed(plant, program, span, weight=1e3)
    with refused(SpecificationError, "X", "t = 3", t=3.0):
        sv.relaxed(plant, program, (0.0, 3.0), weight=1e-8)
    with refused(SpecificationError, "X", "t = 1", t=1.0):
        sv.relaxed(plant, program, (1.0, 6.0), weight=1e-8)
    with refused(SpecificationError, "'stop'", end="stop"):
        sv.relaxed(plant, program, span, weight=1e-8, end="stop")
    for start in ({"x": "0.5"}, {"x": [1.0]}, [[0.0, 0.0], [0.0]]):
        with refused(SpecificationError):
            sv.relaxed(*crane, (0.0, 6.0), weight=1e-6, start=start)
    with refused(SpecificationError, name="weight", expected=(None,)):
        sv.relaxed(*crane, (0.0, 6.0), weight=[[1e-6, 1e-8]])
    with refused(SpecificationError, name="plant"):
        sv.relaxed(plant.mechanism, program, span, weight=1e-8)


def test_a_program_of_other_coordinates_is_refused(crane):
    with refused(SpecificationError, name="x"):
        sv.relaxed(crane[0], fixed_rope_crane()[1], (0.0, 6.0))


def test_a_span_that_ends_within_a_path_that_is_singular_at_rest(crane):
    """The linearisation at the end is not finite; a plan has an open end."""
    run = sv.relaxed(*crane, (0.0, 3.0), weight=1e-9, end="bounded")
    assert sv.verify(run).passed
    assert np.abs(run.residual["X"][0][run.t < 2.5]).max() < 1e-3  # a layer follows at the open end


@pytest.mark.parametrize("start, fact", [
    ({"x": 0.0, "theta": 0.1, "dx": 0.0, "dtheta": 0.0}, "balance of theta"),
    ({"x": 0.0, "theta": 0.0, "dx": 0.3, "dtheta": 0.0}, "dx = 0.3"),
    ({"theta": 0.2}, "theta"),
])  # fmt: skip
def test_a_start_that_is_no_equilibrium_is_refused(crane, start, fact):
    with refused(InconsistentStart, fact):
        sv.relaxed(*crane, (0.0, 6.0), weight=1e-8, start=start)


def test_limits_below_the_static_load_are_refused(crane):
    mechanism, program = fixed_rope_crane()
    plant = sv.plant(mechanism, forces={"x": ca.SX(-50.0)})
    with refused(LimitExceeded, "cart = 50", name="cart", limit=(-30.0, 30.0)):
        sv.relaxed(plant, program, (0.0, 6.0), weight=1e-8, limits={"cart": 30.0})


def test_infeasible_limits_say_which_where_and_by_how_much(crane):
    with refused(LimitExceeded, "cart", limit=10.0) as caught:
        sv.relaxed(*crane, (0.0, 6.0), weight=1e-6, limits={"cart": 10.0})
    assert caught.value.details["value"] == pytest.approx(127.8, abs=2.0)
    assert caught.value.details["t"] == pytest.approx(1.8, abs=0.1) or caught.value.details["t"] > 4.0


def test_a_solution_that_takes_too_long_says_so(crane, monkeypatch):
    monkeypatch.setitem(IPOPT, "max_wall_time", 1e-3)
    with refused(IntegrationStopped, f"IPOPT does not converge in {LONGEST:g} s", status="Maximum_WallTime_Exceeded"):
        sv.relaxed(*crane, (0.0, 6.0), weight=1e-8)


# --- the parts


def test_bernstein_polynomials_and_their_derivatives():
    theta = np.array([0.0, 0.3, 1.0])
    assert bernstein(5, theta).sum(axis=1) == pytest.approx(np.ones(3), abs=1e-15)
    slopes = [approx_fprime([x], lambda y: bernstein(5, y)[0], 1e-7)[:, 0] for x in (0.3,)]
    assert bernstein(5, np.array([0.3]), 1)[0] == pytest.approx(slopes[0], abs=1e-5)


def test_control_points_give_lines_and_integrals_are_exact():
    mesh = Mesh(np.array([0.0, 0.5, 2.0]), 9)
    points = 3.0 * mesh.places_of_points[None]
    assert points @ mesh.of_inputs(mesh.nodes) == pytest.approx(3.0 * mesh.nodes[None], abs=1e-13)
    assert mesh.weights @ mesh.nodes**8 == pytest.approx(2.0**9 / 9, rel=1e-14)
    powers = mesh.power_coefficients(points)[:, 1, 0]
    assert np.polyval(powers[::-1], 0.25) == pytest.approx((points @ mesh.of_inputs(np.array([0.5 + 1.5 * 0.625])))[0, 0])


def test_weights_fall_by_the_factor_from_the_first_to_the_last(monkeypatch, crane):
    seen, solve = [], Transcription.solve

    def recorded(self, w, beta, *rest):
        seen.append(float(beta[0]))
        return solve(self, w, beta, *rest)

    monkeypatch.setattr(Transcription, "solve", recorded)
    sv.relaxed(*crane, (0.0, 6.0), weight=1e-10)
    falling = np.array(seen[: seen.index(1e-10) + 1])
    assert np.all(falling[:-1] / falling[1:] <= FACTOR * (1 + 1e-9)) and len(falling) > 1
    assert falling[0] / FIRST == pytest.approx(5.0**2 / 130.0**2, rel=0.5)  # stroke²/force²


def test_bounds_that_admit_no_motion_are_named():
    """A metre in a second, from rest to rest, takes more than half a metre per second."""
    q = sv.coordinates("x")
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, q["x"]), actuators={"F": q["x"]})
    r = q.references(path=rest_to_rest(0.0, 1.0, duration=1.0, smoothness=2))
    program = sv.Program({"path": q["x"] - r.path})
    with pytest.raises((LimitExceeded, IntegrationStopped), match=r"without them dx is 1\.87"):  # by how IPOPT ends
        sv.relaxed(sv.plant(mechanism), program, (0.0, 1.0), bounds={"dx": 0.5})
