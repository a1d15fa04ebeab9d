"""Bounded motions of programs with unstable internal dynamics: known answers, a second opinion, refusals."""

from itertools import pairwise
from math import pi

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import quad

import servoctl as sv
from servoctl.errors import IntegrationStopped, LimitExceeded, SpecificationError, UnstableInternalDynamics
from servoctl.gallery import gallery
from servoctl.methods.bounded import LONGEST, Problem
from servoctl.model.equations import invariant_names


def arm(Gamma, duration=2.0, **numbers):
    """Two equal homogeneous links in the plane, a torque on the first, a spring and a damper in the second joint."""
    p = sv.parameters(m=6.875, l=1.0, I=0.57, c=50.0, d=0.25, Gamma=Gamma)
    q = sv.coordinates("q1 q2")
    (q1, q2), (dq1, dq2) = q, q.d(1)
    links = [ca.vertcat(ca.cos(a), ca.sin(a)) for a in (q1, q1 + q2)]
    S = sv.rigid_body(q, p.m, (0, 0, p.I), position=p.l / 2 * links[0], rates=(0, 0, dq1))
    S += sv.rigid_body(q, p.m, (0, 0, p.I), position=p.l * links[0] + p.l / 2 * links[1], rates=(0, 0, dq1 + dq2))
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=p.c * q2**2 / 2, forces={"q2": -p.d * dq2}, actuators={"torque": q1}, parameters=p
    )
    path = q.references(angle=sv.paths.rest_to_rest(0.0, pi / 2, duration=duration, smoothness=4)).angle
    return sv.derive(mechanism, sv.Program({"angle": q1 + p.Gamma * q2 - path})).with_parameters(**numbers)


def aircraft():
    """The centre of mass of the gallery's aircraft, from (0, 0) to (10, 5) m in 3 s."""
    mechanism, _ = gallery["vtol-centre"].build()
    x, z, _ = mechanism.q
    path = sv.paths.rest_to_rest((0.0, 0.0), (10.0, 5.0), duration=3.0, smoothness=4)
    r = mechanism.q.references(across=path[0], up=path[1])
    return sv.derive(mechanism, sv.Program({"X": x - r.across, "Z": z - r.up}))


def flexible_link(n, m=0.1, l=0.15, k=60.0, d=0.05, J=0.05):
    """n segments with springs and dampers between them, a torque on the hub, and a path of their mean angle."""
    q = sv.coordinates(" ".join(f"q{i}" for i in range(n)))
    hub, *joints = q
    angles, end, S = np.cumsum([hub, *joints]), ca.SX.zeros(2), J * q.d(2)[0] ** 2 / 2
    for angle in angles:
        along = l * ca.vertcat(ca.cos(angle), ca.sin(angle))
        S, end = S + sv.particle(q, m, end + along / 2), end + along
    dampers = {f"q{i}": -d * q.d(1)[i] for i in range(1, n)}
    springs = sum(k * angle**2 / 2 for angle in joints)
    mechanism = sv.Mechanism(q, gibbs=S, potential=springs, forces=dampers, actuators={"hub": hub})
    path = q.references(tip=sv.paths.rest_to_rest(0.0, 0.5, 1.5, t_start=0.3)).tip
    return mechanism, sv.Program({"tip": sum(angles) / n - path})


def cart_pole(path, start=0.0, damping=0.0):
    """A pole on a cart that follows a path; the pole stands upright at 0."""
    q = sv.coordinates("x a")
    x, a = q
    S = sv.particle(q, 1.0, (x, 0)) + sv.particle(q, 0.2, (x + 0.5 * ca.sin(a), 0.5 * ca.cos(a)))
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=0.2 * 9.81 * 0.5 * ca.cos(a), forces={"a": -damping * q.d(1)[1]}, actuators={"F": x}
    )
    model = sv.derive(mechanism, sv.Program({"x": x - path(q)}))
    return model, model.start(a=start, da=0.0)


def step(duration=1.0):
    path = sv.paths.rest_to_rest(0.0, 1.0, duration=duration, smoothness=4)
    return lambda q: q.references(x=path).x


def test_the_passive_arm_of_known_numbers():
    model = arm(0.5)
    run = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded())
    assert run.state(0.5)[1] == pytest.approx(-0.308555247, abs=1e-9)
    assert run.state(1.5)[1] == pytest.approx(0.312284407, abs=1e-9)
    fine = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), t_eval=np.linspace(0.0, 2.0, 20001))
    assert np.degrees(np.abs(fine["q2"]).max()) == pytest.approx(19.303385, abs=1e-6)
    assert fine["torque"].min() == pytest.approx(-48.83509, abs=1e-5)
    assert fine["torque"].max() == pytest.approx(48.88454, abs=1e-5)
    assert run.t[0] < -1.0 and run.t[-1] > 3.0 and abs(run["torque"][0]) < 1e-2  # moves ahead of the program
    assert sv.verify(run).passed


def test_the_aircraft_of_known_numbers():
    model = aircraft()
    run = sv.simulate(model, model.start(), (0.0, 3.0), "bounded")
    assert run.state(0.75)[2] == pytest.approx(-0.563010398, abs=1e-9)
    assert run.state(2.25)[2] == pytest.approx(1.033108370, abs=1e-9)
    fine = sv.simulate(model, model.start(), (0.0, 3.0), "bounded", t_eval=np.linspace(0.0, 3.0, 20001))
    assert np.degrees(np.abs(fine["theta"]).max()) == pytest.approx(64.8117, abs=1e-4)
    thrusts = np.stack([fine["u1"], fine["u2"]])
    assert thrusts.min() == pytest.approx(131.3045, abs=1e-4) and thrusts.max() == pytest.approx(485.9057, abs=1e-4)
    assert sv.verify(run).passed


def test_a_general_solver_finds_the_same_motion():
    """scipy's solve_bvp on the pole's own equation, a'' = (g sin a - x'' cos a)/l, over a window of 3 s beside it."""
    from scipy.integrate import solve_bvp

    model, start = cart_pole(step())
    run = sv.simulate(model, start, (0.0, 1.0), sv.methods.Bounded())
    path = sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=4)
    rate = np.sqrt(9.81 / 0.5)

    def rates(t, y):
        return np.array([y[1], (9.81 * np.sin(y[0]) - path.jets(t, 2)[2, 0] * np.cos(y[0])) / 0.5])

    def ends(left, right):  # the stable component is zero before the program, the unstable one after it
        return np.array([left[1] - rate * left[0], right[1] + rate * right[0]])

    times = np.linspace(-3.0, 4.0, 1401)
    other = solve_bvp(rates, ends, times, np.zeros((2, len(times))), tol=1e-9, max_nodes=100000)
    assert other.success
    inside = (run.t > -1.0) & (run.t < 2.0)
    assert run["a"][inside] == pytest.approx(other.sol(run.t[inside])[0], abs=1e-8)


def test_it_is_a_forward_motion_where_the_internal_dynamics_are_stable():
    model = sv.derive(*gallery["passive-arm"].build())
    run = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), t_eval=np.linspace(0.0, 2.0, 101))
    exact, start = sv.methods.Taylor(rtol=1e-13, atol=1e-13), model.start(q2=0.0, dq2=0.0)
    forward = sv.simulate(model, start, (0.0, 2.0), exact, t_eval=run.t)
    assert run.jets == pytest.approx(forward.jets, abs=1e-8)
    whole = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded())
    assert whole.t[0] == 0.0 and whole.t[-1] > 3.0  # nothing to do ahead of it


@pytest.mark.parametrize("make, span", [(lambda: arm(0.5), (0.0, 2.0)), (aircraft, (0.0, 3.0))], ids=["arm", "aircraft"])
def test_the_error_of_the_window_falls_with_its_length(make, span):
    model = make()
    errors, said = [], []
    exact = sv.simulate(model, model.start(), span, sv.methods.Bounded(25.0), t_eval=np.linspace(*span, 201))
    for window in (1.0, 1.5, 2.0, 2.5, 3.0):
        run = sv.simulate(model, model.start(), span, sv.methods.Bounded(window), t_eval=exact.t)
        errors.append(np.abs((run.jets - exact.jets)[: len(model.state_names)]).max())
        said.append(float(run.message.split()[-1]))
    falls = -np.diff(np.log(errors)) / 0.5
    assert falls.min() > 1.0  # exp(-window), or faster
    assert (np.array(said) > 0.05 * np.array(errors)).all() and (np.array(said) < 5 * np.array(errors)).all()


@pytest.mark.parametrize("duration", [1.0, 0.5, 0.2, 0.1])
def test_quick_steps_of_a_cart_pole(duration):
    model, start = cart_pole(step(duration))
    run = sv.simulate(model, start, (0.0, duration), sv.methods.Bounded())
    assert run["a"][0] > 0 > run["a"][-1] and sv.verify(run).passed  # leans forward before the cart moves
    assert np.abs(run["x"][run.t <= 0]).max() < 1e-12


def test_material_constraints_and_quasi_velocities_change_nothing():
    model, start = cart_pole(step())
    expected = sv.simulate(model, start, (0.0, 1.0), sv.methods.Bounded(), t_eval=np.linspace(0.0, 1.0, 101))
    q = sv.coordinates("x X Z")  # the pole's tip by its position, on a rod
    x, X, Z = q
    S = sv.particle(q, 1.0, (x, 0)) + sv.particle(q, 0.2, (X, Z))
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=0.2 * 9.81 * Z, actuators={"F": x}, constraints={"rod": (X - x) ** 2 + Z**2 - 0.25}
    )
    absolute = sv.derive(mechanism, sv.Program({"x": x - step()(q)}), guess={"Z": 0.5})
    run = sv.simulate(absolute, absolute.start(guess={"Z": 0.5}), (0.0, 1.0), sv.methods.Bounded(), t_eval=expected.t)
    assert run["X"] == pytest.approx(expected["x"] + 0.5 * np.sin(expected["a"]), abs=1e-9)
    assert run["F"] == pytest.approx(expected["F"], abs=1e-7)
    q = sv.coordinates("x a").with_quasi_velocities("u v", [[1, 0], [-2 * ca.cos(0.3), 1]])
    x, a = q
    S = sv.particle(q, 1.0, (x, 0)) + sv.particle(q, 0.2, (x + 0.5 * ca.sin(a), 0.5 * ca.cos(a)))
    mechanism = sv.Mechanism(q, gibbs=S, potential=0.2 * 9.81 * 0.5 * ca.cos(a), actuators={"F": x})
    other = sv.derive(mechanism, sv.Program({"x": x - step()(q)}))
    run = sv.simulate(other, other.start(guess={"a": 0.0}), (0.0, 1.0), sv.methods.Bounded(), t_eval=expected.t)
    assert run["a"] == pytest.approx(expected["a"], abs=1e-9) and run["F"] == pytest.approx(expected["F"], abs=1e-7)


def test_a_law_follows_the_bounded_plan():
    model = arm(0.5)
    plan = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(15.0), t_eval=None)
    plant = sv.plant(model.reduction.mechanism)
    law = sv.lqr(plan, plant, rate=1000.0)
    run = sv.close(plant, law, plan.state(plan.t[0]), (plan.t[0], plan.t[-1]))
    angle = run["q1"] + 0.5 * run["q2"]
    planned = np.interp(run.t, plan.t, plan["q1"] + 0.5 * plan["q2"])
    assert np.abs(angle - planned).max() < 1e-5 * pi / 2


@pytest.fixture(scope="module")
def arm_plan():
    """The bounded motion of the passive arm, with the rests before and after it."""
    model = arm(0.5)
    return sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(15.0))


def test_feedforward_of_a_bounded_plan_holds_as_long_as_errors_are_small(arm_plan):
    """Errors of the hold grow like e^(9.55 t): the law is the plan's input at mid-sample."""
    plant = sv.plant(arm_plan.model.reduction.mechanism)
    law = sv.feedforward(arm_plan, plant, rate=1000.0)
    run = sv.close(plant, law, arm_plan.state(arm_plan.t[0]), (arm_plan.t[0], 0.5))
    assert abs(run["q2"][-1] - arm_plan.state(0.5)[1]) < 1e-3
    k = 600
    middle = arm_plan.t[0] + (k + 0.5) * 1e-3
    assert run.input["torque"][k] == pytest.approx(np.interp(middle, arm_plan.t, arm_plan["torque"]), abs=1e-2)


def test_a_law_of_a_bounded_plan_in_c_and_under_limits(arm_plan, tmp_path):
    plant = sv.plant(arm_plan.model.reduction.mechanism, limits={"torque": 60.0})
    law = sv.lqr(arm_plan, plant, rate=100.0)
    assert [file.name for file in sv.export_c(law, tmp_path)] == ["law.c", "law.h"]
    span = (arm_plan.t[0], arm_plan.t[0] + 5.0)
    run = sv.close(plant, sv.limited(law, plant), arm_plan.state(span[0]), span)
    assert np.abs(run.input["torque"]).max() < 60.0 and not sv.limit_report(run).rows


def test_a_bounded_plan_in_files_verdicts_and_loops_of_many_cases(arm_plan, tmp_path):
    assert sv.load(arm_plan.save(tmp_path / "plan"), arm_plan.model) == arm_plan
    assert sv.internal_dynamics(arm_plan).verdict == "unstable"  # open loop, and the plan is exact
    plant = sv.plant(arm_plan.model.reduction.mechanism)
    law = sv.lqr(arm_plan, plant, rate=100.0)
    run = sv.close(plant, law, arm_plan.state(arm_plan.t[0]), (arm_plan.t[0], arm_plan.t[0] + 5.0))
    batch = sv.close_many(run, {"c": [49.0, 50.0, 51.0]})
    worst = batch["max |residual angle|"]
    assert worst[1] == pytest.approx(np.abs(run.residual["angle"][0]).max(), rel=1e-6) and worst.max() < 0.05


def bounded_case(c):
    """The peak torque of a bounded motion with another stiffness of the joint."""
    model = arm(0.5, c=c)
    run = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded())
    return {"peak": run.extrema("torque")[1][1]}


def test_bounded_plans_in_a_sweep():
    study = sv.sweep(bounded_case, {"c": [40.0, 50.0, 60.0]})
    peaks = np.asarray(study["peak"], dtype=float)
    assert peaks[1] == pytest.approx(48.88454, abs=1e-4) and np.ptp(peaks) > 0.1


def masses(forces, residual):
    """Masses of 1 kg at x, y and z under forces(x, v), of which an actuator moves the first by residual(q, x, v, a)."""
    q = sv.coordinates("x y z")
    x, v, a = tuple(q), tuple(q.d(1)), tuple(q.d(2))
    S = sv.particle(q, 1.0, x[0]) + sv.particle(q, 1.0, x[1]) + sv.particle(q, 1.0, x[2])
    mechanism = sv.Mechanism(q, S, actuators={"F": x[0]}, forces=ca.vertcat(0, *forces(x, v)))
    return sv.derive(mechanism, sv.Program({"x": residual(q, x, v, a)}))


def follows(q, x, v, a):
    """x follows the path of `step()`."""
    return x[0] - step()(q)


def convolved(path, rate, t):
    """The bounded solution of y'' = rate² y + x(t): the integral of x along both exponentials."""
    ends = sorted({-10.0, 0.0, 1.0, t, 12.0})
    value = sum(quad(lambda s: np.exp(-rate * abs(t - s)) * path(s), a, b, epsabs=1e-14)[0] for a, b in pairwise(ends))
    return -value / (2 * rate)


def s9(t):
    """The path of `step()` at an instant, as a number."""
    s = np.clip(t, 0.0, 1.0)
    return s**5 * (126 - 420 * s + 540 * s**2 - 315 * s**3 + 70 * s**4)


def stiff_forces(damping, stiffness):
    return lambda x, v: (25 * x[1] + x[0], -damping * v[2] - stiffness * x[2] + x[0])


@pytest.mark.parametrize("damping, stiffness", [(8e3, 8e4), (1e3, 1e9), (-2e3, -1e4)], ids=["stiff", "vibrates", "grows"])
def test_stiff_modes_beside_an_unstable_one(damping, stiffness):
    """They need no more intervals than their layers beside corners, and the others have their closed form."""
    model = masses(stiff_forces(damping, stiffness), follows)
    run = sv.simulate(model, model.start(), (0.0, 1.0), sv.methods.Bounded())
    assert run.counters["intervals"] < 2500
    for t in (-0.3, 0.0, 0.4, 1.0, 1.5):
        assert run.state(t)[1] == pytest.approx(convolved(s9, 5.0, t), abs=1e-12)


def test_unstable_modes_that_no_mesh_resolves_are_refused():
    model = masses(stiff_forces(-8e4, -8e5), follows)
    with refused(LimitExceeded, "4000", most=4000):
        sv.simulate(model, model.start(), (0.0, 1.0), sv.methods.Bounded())


def test_a_program_of_accelerations_has_no_invariants():
    """x'' + 3 x' + 2 x = 2 path leaves the whole state free, one eigenvalue of which is unstable."""
    model = masses(
        lambda x, v: (4 * x[1] + x[0], -x[2] - v[2]),
        lambda q, x, v, a: a[0] + 3 * v[0] + 2 * x[0] - 2 * step()(q),
    )
    run = sv.simulate(model, model.start(), (0.0, 1.0), sv.methods.Bounded())
    assert not invariant_names(model) and sv.verify(run).passed
    assert run.state(run.t[0])[1] == pytest.approx(0.0, abs=1e-4) and run.state(run.t[-1])[1] == pytest.approx(-0.25, abs=1e-4)
    assert run.state(1.0)[1] == pytest.approx(convolved(lambda s: run.state(np.clip(s, *run.t[[0, -1]]))[0], 2.0, 1.0), abs=1e-6)
    assert "hyperbolic" in sv.report(run).verdict


def test_accelerations_that_leave_an_oscillation_are_marginal():
    model = masses(lambda x, v: (-x[1], -x[2]), lambda q, x, v, a: a[0] - ca.sin(q.t))
    assert sv.report(model).verdict == "marginal"
    with refused(UnstableInternalDynamics, "imaginary axis"):
        sv.simulate(model, model.start(), (0.0, 1.0), sv.methods.Bounded())


def test_samples_within_the_window():
    """The actuation ahead of the program, at any rate; its message says what samples leave out."""
    model = arm(0.5)
    whole = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded())
    times = np.linspace(whole.t[0], whole.t[-1], 2001)
    run = sv.simulate(model, model.start(), (0.0, 2.0), "bounded", t_eval=times)
    assert np.array_equal(run.t, times) and "leave out" not in run.message and sv.verify(run).passed
    assert np.abs(run["torque"] - np.interp(times, whole.t, whole["torque"])).max() < 0.05
    part = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), t_eval=[0.0, 1.0, 2.5])
    assert "leave out the motion before t = 0 s;" in part.message and "after" not in part.message
    assert part.jets[:4, 1] == pytest.approx(whole.state(1.0), abs=1e-9)
    with refused(SpecificationError, "window", window=(float(whole.t[0]), float(whole.t[-1]))):
        sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), t_eval=[-50.0, 1.0])
    for times in ([], [0.0, np.nan]):
        with refused(SpecificationError, "t_eval"):
            sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), t_eval=times)


# refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 2500, 5000])
def test_a_mesh_keeps_all_corners_and_follows_the_fastest_mode(count):
    """Of a longer window, too, whose corners are the mesh of a shorter one."""
    problem, corners = Problem(arm(0.5), (0.0, 2.0), np.zeros(4)), np.linspace(0.0, 2.0, count)
    mesh = problem._first_mesh((-5.0, 7.0), corners)
    assert np.isin(corners, mesh).all() and np.all(np.diff(mesh) > 0)
    assert (mesh[0], mesh[-1]) == (-5.0, 7.0)
    fastest = np.abs(problem.first.eigenvalues).max()
    assert np.diff(mesh).max() * fastest <= LONGEST * 4


def test_internal_dynamics_on_the_imaginary_axis_are_refused():
    model, start = cart_pole(step(), start=pi)
    with refused(UnstableInternalDynamics, "imaginary axis", t=0.0):
        sv.simulate(model, start, (0.0, 1.0), sv.methods.Bounded())


def test_rolling_as_a_constraint_of_velocities_has_the_motion_of_its_integral():
    """Its constant is an eigenvalue 0 between a pair of real ones, on which nothing depends."""
    q = sv.coordinates("x phi a")
    x, phi, a = q
    S = sv.particle(q, 2.0, (x, 0)) + sv.particle(q, 1.0, (x + 0.7 * ca.sin(a), 0.7 * ca.cos(a)))
    S += sv.rigid_body(q, 1e-4, (0, 0, 0.05), position=ca.vertcat(x, 0), rates=(0, 0, q.d(1)[1]))
    runs, U, to = [], 9.81 * 0.7 * ca.cos(a), step()(q)
    for roll in (q.d(1)[0] - 0.2 * q.d(1)[1], x - 0.2 * phi):
        mechanism = sv.Mechanism(q, gibbs=S, potential=U, constraints={"roll": roll}, actuators={"T": phi})
        model = sv.derive(mechanism, sv.Program({"x": x - to}))
        runs.append(sv.simulate(model, model.start(a=0.0, da=0.0), (0.0, 1.0), sv.methods.Bounded()))
        values = Problem(model, (0.0, 1.0), runs[-1].start.values).first.modes.eigenvalues
        assert values == pytest.approx([(9.81 / 0.7) ** 0.5, -((9.81 / 0.7) ** 0.5)], abs=1e-9)
    for name in ("T", "a", "phi"):
        assert np.abs(runs[0][name] - runs[1][name]).max() < 1e-9 * np.abs(runs[1][name]).max()


def test_ends_that_differ_in_their_unstable_modes_are_refused():
    """A pole on a cart under a spring that its position switches: upright is stable at one end alone."""
    q = sv.coordinates("x a")
    x, a = q
    S = sv.particle(q, 1.0, (x, 0)) + sv.particle(q, 0.2, (x + 0.5 * ca.sin(a), 0.5 * ca.cos(a)))
    U = 0.2 * 9.81 * 0.5 * ca.cos(a) + (1 - x) * 5.0 * a**2 / 2
    mechanism = sv.Mechanism(q, gibbs=S, potential=U, forces={"a": -0.2 * q.d(1)[1]}, actuators={"F": x})
    model = sv.derive(mechanism, sv.Program({"x": x - step()(q)}))
    with refused(UnstableInternalDynamics, unstable=[0, 1]):
        sv.simulate(model, model.start(a=0.0, da=0.0), (0.0, 1.0), sv.methods.Bounded())


@pytest.mark.parametrize("path, end", [(lambda q: ca.sin(3 * q.t), 1.0), (step(), 0.6)], ids=["oscillates", "cut short"])
def test_a_program_that_does_not_stand_still_outside_its_span_is_refused(path, end):
    model, start = cart_pole(path)
    with refused(SpecificationError, "stands still", span=(0.0, end)):
        sv.simulate(model, start, (0.0, end), sv.methods.Bounded())


def test_switches_of_the_state_are_refused():
    q = sv.coordinates("x a")
    x, a = q
    S = sv.particle(q, 1.0, (x, 0)) + sv.particle(q, 0.2, (x + 0.5 * ca.sin(a), 0.5 * ca.cos(a)))
    U = 0.2 * 9.81 * 0.5 * ca.cos(a)
    mechanism = sv.Mechanism(q, gibbs=S, potential=U, forces={"a": -0.1 * ca.sign(q.d(1)[1])}, actuators={"F": x})
    model = sv.derive(mechanism, sv.Program({"x": x - step()(q)}))
    with refused(SpecificationError, "kinks or switches"):
        sv.simulate(model, model.start(a=0.0, da=0.0), (0.0, 1.0), sv.methods.Bounded())


def test_what_bounded_motions_do_not_take_is_refused(gallery_model):
    model, start = cart_pole(step())
    with refused(SpecificationError, "(0, 1)", t_span=(1.0, 0.0)):
        sv.simulate(model, model.start(t=1.0, a=0.0, da=0.0), (1.0, 0.0), sv.methods.Bounded())
    with refused(SpecificationError, "Project", method="bounded"):
        sv.simulate(model, start, (0.0, 1.0), sv.methods.Bounded(), drift="project")
    crane = gallery_model("overhead-crane")
    with refused(SpecificationError, "algebraic", free=0):
        sv.simulate(crane, crane.start(guess=gallery["overhead-crane"].guess), (0.0, 8.0), sv.methods.Bounded())
    wheel = gallery_model("appell-hamel")
    with refused(IntegrationStopped, "equilibrium"):
        sv.simulate(wheel, wheel.start(**gallery["appell-hamel"].start), (0.0, 1.0), sv.methods.Bounded())
    for window in (0.0, -1.0, 1e4, "long", None):
        with refused(SpecificationError, "window", name="window", value=window):
            sv.methods.Bounded(window)
