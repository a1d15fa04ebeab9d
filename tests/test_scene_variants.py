"""Scenes with other numbers than those of the gallery, and what their motions brought to light."""

import ast
from importlib import import_module
from inspect import getsource
from math import cos, sin, sqrt, tan

import casadi as ca
import numpy as np
import pytest
from gallery_numbers import free_rates, wrenches
from refusals import refused
from robots import OWN

import servoctl as sv
from servoctl.gallery import gallery, scenes, six_axes
from servoctl.gallery.attitude import tumbling_satellite
from servoctl.gallery.chains import cable_robot
from servoctl.gallery.contacts import ball_on_turntable, rolling_disc
from servoctl.gallery.flexible import elastic_link, flexible_joint
from servoctl.gallery.hitched import trailers
from servoctl.gallery.jerk import constant_jerk, jerkless_trolley
from servoctl.inversion.verdict import verdict
from servoctl.jets.tape import Tape
from servoctl.model.equations import residual_names

NEWCOMERS = (  # what a newcomer writes from the documents alone, in so many lines
    "double_pendulum", "trailers", "reaction_wheels", "constant_jerk", "slung_load", "flexible_joint",
    "ball_on_turntable",
)  # fmt: skip
LINES = 35


def moved(built, span, guess=None, **start):
    model = sv.derive(*built)
    return sv.simulate(model, model.start(**start, guess=guess), span, t_eval=np.linspace(*span, 101))


@pytest.mark.parametrize("name", NEWCOMERS)
def test_a_newcomers_scene_takes_few_lines(name):
    source = getsource(import_module(f"servoctl.gallery.{scenes.BUILDERS[name]}"))
    function = next(f for f in ast.parse(source).body if isinstance(f, ast.FunctionDef) and f.name == name)
    assert 1 + function.end_lineno - function.body[1].lineno <= LINES  # the first statement is the docstring


# rolling ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("radius", "speed"), [(3.0, 1.0), (-1.5, -0.5)])
def test_trailers_come_to_circles_about_one_centre(radius, speed):
    built = trailers(radius=radius, speed=speed, duration=4.0)
    run = moved(built, (0.0, 6.0), {"v": speed}, X=0.0, Y=0.0, theta1=0.0, theta2=0.0)
    bend, last = run["theta0"][-1] - run["theta1"][-1], run["theta1"][-1] - run["theta2"][-1]
    assert tan(last) / 0.8 == pytest.approx(1 / radius, rel=1e-8)
    robot = run["v"][-1] / (cos(bend) * cos(last)) / run["r"][-1]
    assert robot == pytest.approx(np.sign(radius) * sqrt(radius**2 + 2 * 0.8**2), rel=1e-7)
    assert abs(run["steer"][-1]) < 1e-6 and abs(run["drive"][-1]) < 1e-6
    assert sv.verify(run).passed


@pytest.mark.parametrize(("rate", "x", "y", "dx", "dy"), [(3.0, 0.2, 0.1, 0.3, -0.1), (-5.0, 0.0, 0.0, 0.4, 0.0)])
def test_a_ball_on_a_turntable_goes_around_a_circle_with_the_motors_torque(rate, x, y, dx, dy):
    run = moved(ball_on_turntable(rate), (0.0, 6.0), x=x, y=y, dx=dx, dy=dy, alpha=0.0, beta=0.0)
    w = 2 / 7 * rate
    centre, arm = np.array([x - dy / w, y + dx / w]), np.array([dy / w, -dx / w])
    turned = np.array([[np.cos(w * run.t), -np.sin(w * run.t)], [np.sin(w * run.t), np.cos(w * run.t)]])
    place = centre[:, None] + np.einsum("ijk,j->ik", turned, arm)
    assert run["x"] == pytest.approx(place[0], abs=1e-9) and run["y"] == pytest.approx(place[1], abs=1e-9)
    force = -0.5 * w**2 * (place - centre[:, None])  # on the ball; on the table its opposite
    assert run["motor"] == pytest.approx(place[0] * force[1] - place[1] * force[0], abs=1e-9)


@pytest.mark.parametrize(("lean", "turn", "a"), [(-0.5, -2.0, 0.5), (0.6, 3.0, 0.2)])
def test_a_disc_precesses_steadily(lean, turn, a):
    s = (9.81 * tan(lean) / (a * turn) - turn * sin(lean) / 4) * 2 / 3
    start = {"psi": 0.0, "lean": lean, "phi": 0.0, "dpsi": turn, "dlean": 0.0, "dphi": s + turn * sin(lean)}
    run = moved(rolling_disc(a), (0.0, 1.5), x=0.0, y=0.0, **start)
    assert run["lean"] == pytest.approx(np.full(101, lean), abs=1e-7)
    assert run["x"] == pytest.approx(a * s / turn * np.sin(turn * run.t), abs=1e-6)
    assert np.ptp(run["energy"]) < 1e-9 * abs(run["energy"]).max()


# arms that bend --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.0, 5.0])
def test_the_motor_of_a_flexible_joint_holds_weight_alone_at_its_end(friction):
    run = moved(flexible_joint(friction), (0.0, 1.5))
    weight = 5.0 * 9.81 * 0.5
    assert run["torque"][-1] == pytest.approx(weight, rel=1e-9)
    assert run["motor"][-1] - run["link"][-1] == pytest.approx(weight / 500.0, rel=1e-9)


def test_an_elastic_link_tends_to_a_clamped_beam():
    beam, errors = 1.8751040687**2 * sqrt(20.0 / 2.0), []
    for n in (1, 3):
        model = sv.derive(*elastic_link(n))
        start = model.start(**{f"{d}bend{i}": 0.0 for d in ("", "d") for i in range(1, n + 1)})
        run = sv.simulate(model, start, (0.0, 0.1), t_eval=[0.0, 0.1])
        poles = sv.internal_dynamics(run).eigenvalues[:, 0]
        errors.append(1 - np.abs(poles.imag).min() / beam)
    assert 0 < errors[1] < 0.06 and errors[1] < errors[0] / 6  # of second order


def test_an_elastic_link_without_a_rod_is_refused():
    with refused(sv.errors.SpecificationError, "0", n=0):
        elastic_link(0)


# ropes -----------------------------------------------------------------------------------------------------------------


def test_ropes_share_a_pretension_that_moves_nothing():
    """Two pretensions differ by the part of their difference that lies in the null space of the wrenches."""
    names = [f"rope{i}" for i in range(1, 9)]
    low, high = (moved(cable_robot(pretension), (0.0, 3.0)) for pretension in (100.0, 500.0))
    for k in (0, 40, 100):
        W = wrenches([high["x"][k], high["y"][k], high["z"][k]], high["yaw"][k])
        free = np.full(8, 400.0) - np.linalg.pinv(W) @ W @ np.full(8, 400.0)
        assert [high[name][k] - low[name][k] for name in names] == pytest.approx(free, abs=1e-9)
    assert min(high[name].min() for name in names) > 100.0 > 0.0 > min(low[name].min() for name in names)


# jerk ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [-1.0])
def test_a_constant_jerk_has_two_branches_each_a_cubic_path(sign):
    e = np.array([cos(1.0), sin(1.0)])
    start = {"x": 0.0, "y": 0.0, "dx": 1.0, "dy": 0.0, "d2x": 3.0 * e[0], "d2y": 3.0 * e[1] - 9.81}
    guess = {"d3x": sign * e[0], "d3y": sign * e[1]}
    run = moved(constant_jerk(1.0), (0.0, 2.0), guess, **start)
    along = 3.0 * run.t**2 / 2 + sign * run.t**3 / 6
    assert run["x"] == pytest.approx(run.t + e[0] * along, abs=1e-8)
    assert run["y"] == pytest.approx(-9.81 * run.t**2 / 2 + e[1] * along, abs=1e-8)


def test_a_report_on_a_jerk_program_finds_no_rest_and_says_so():
    """At a = g the reaction has no direction, and the linearised constraints are singular."""
    model, scene = sv.derive(*constant_jerk()), gallery["constant-jerk"]
    start = model.start(**scene.start, guess=scene.guess)
    report = sv.report(sv.simulate(model, start, (0.0, 1.0)))
    assert report.verdict == "marginal" and "no rest" in repr(report)


@pytest.mark.parametrize("a", [-6.0, 20.0])
def test_a_rod_on_a_trolley_without_jerk_swings_in_a_steady_gravity(a):
    run = moved(jerkless_trolley(), (0.0, 3.0), x=0.1, dx=-1.0, d2x=a, theta=0.0, dtheta=0.0)
    assert run["x"] == pytest.approx(0.1 - run.t + a * run.t**2 / 2, abs=1e-9)
    angle, rate = run["theta"], run["dtheta"]
    assert rate**2 == pytest.approx(3.0 * (a * np.sin(angle) - 9.81 * (1 - np.cos(angle))), abs=1e-6)
    turning = 1.5 * (a * np.cos(angle) - 9.81 * np.sin(angle))
    force = 5.0 * a - 1.0 * (turning * np.cos(angle) - rate**2 * np.sin(angle))
    names, reaction = run.signals("reaction")
    assert names == ["reaction_x", "reaction_theta"]
    assert reaction[0] == pytest.approx(force, abs=1e-6) and reaction[1] == pytest.approx(0.0, abs=1e-9)


# a satellite whose energy falls --------------------------------------------------------------------------------------


def braked(decay, weights="inertia"):
    start = {"e1": 0.0, "e2": 0.0, "e3": 0.0, "w1": 0.25, "w2": 0.0}
    return moved(tumbling_satellite(decay, weights), (0.0, 12.0), {"e0": 1.0, "w3": 0.35}, **start)


@pytest.mark.parametrize("decay", [0.3, -0.05])
def test_torques_of_an_inertial_generalised_inverse_keep_the_direction_of_the_angular_momentum(decay):
    run = braked(decay)
    slowed = np.exp(-decay * run.t)
    for name, J, rate in zip("123", (30.0, 40.0, 50.0), free_rates((1 - slowed) / decay), strict=True):
        assert run[f"w{name}"] == pytest.approx(slowed * rate, abs=1e-9)
        assert run[f"torque{name}"] == pytest.approx(-decay * J * slowed * rate, abs=1e-8)
    for name, momentum in zip("xyz", (7.5, 0.0, 17.5), strict=True):  # to eight digits of its magnitude, 19 N m s
        assert run[f"momentum_{name}"] == pytest.approx(slowed * momentum, abs=1e-8 * np.hypot(7.5, 17.5))


def test_torques_of_the_pseudoinverse_lie_along_the_rates():
    run, decay = braked(0.1, None), 0.1
    w, torque = (np.array([run[f"{name}{i}"] for i in (1, 2, 3)]) for name in ("w", "torque"))
    assert torque == pytest.approx(-8.0 * decay * np.exp(-2 * decay * run.t) / (w**2).sum(0) * w, abs=1e-8)
    assert abs(run["momentum_y"]).max() > 0.01  # the direction of the angular momentum changes


def test_a_program_that_is_singular_at_rest_names_no_rate_of_its_self_motion():
    """The gradient of the energy vanishes with the rates: a linearisation at rest says nothing."""
    said = repr(sv.derive(*tumbling_satellite()))
    assert "self-motion of 2 velocities" in said and "at rest" not in said and "inf" not in said


# a run whose pivots are others than the model's --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hovering():
    scene = gallery["slung-load-3d"]
    model = sv.derive(*scene.build())
    return sv.simulate(model, model.start(), (0.0, 6.0), t_eval=np.linspace(0.0, 6.0, 31))


def test_residuals_have_the_models_names_where_other_balances_are_hidden(hovering):
    rows = [[row.name for row in model.reduction.rows] for model in (hovering.model, hovering.variant(0))]
    assert rows[0] != rows[1]
    assert list(hovering.residual) == list(residual_names(hovering.model.reduction))
    assert all(np.abs(values).max() < 1e-10 for values in hovering.residual.values())
    assert "hidden: balance" in repr(hovering)


def test_a_hovering_quadrotor_is_not_singular(hovering):
    assert str(verdict(hovering.model, hovering)).startswith("flat")


def test_the_sign_of_itself_is_no_operation():
    """By it conditions of a path's pieces enter the elimination of a cascade's blocks."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    product = x * y
    tape = Tape([x, y], [ca.copysign(product, product)])
    assert [node.kind for node in tape.nodes] == [node.kind for node in Tape([x, y], [product]).nodes]
    with refused(sv.errors.SpecificationError, operation="copysign"):
        Tape([x, y], [ca.copysign(x, y)])


# the arm of the examples ------------------------------------------------------------------------------------------------


def test_the_six_axis_arm_is_the_one_of_the_examples():
    """Its table of bodies and the file give the same balance and the same tool."""
    here, there = sv.urdf(six_axes._description()), sv.urdf(OWN / "six_axis_arm.urdf")
    values = np.random.default_rng(2).uniform(-1.0, 1.0, (3, 6))
    found = []
    for arm in (here, there):
        q = arm.q
        expressions = ca.vertcat(arm.mechanism().balance, arm.frame("tool").position, ca.vec(arm.frame("tool").rotation))
        found.append(ca.Function("f", [q.jet(0), q.jet(1), q.jet(2)], [expressions])(*values).full().ravel())
    assert found[0] == pytest.approx(found[1], abs=1e-12)
    assert here.effort == there.effort and here.damping == there.damping
