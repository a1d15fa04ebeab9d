"""Motions of mixed and high orders, with kinematics that depend on time, against closed forms and other integrators."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import servoctl as sv

INDEPENDENT = {"rtol": 1e-12, "atol": 1e-13, "method": "DOP853"}


def free(names, program, **parts):
    """A unit mass in the coordinates of these names, under an ideal program of its coordinates."""
    q = sv.coordinates(names)
    mechanism = sv.Mechanism(q, gibbs=sum(a**2 for a in q.d(2)) / 2, **{k: f(q) for k, f in parts.items()})
    return sv.derive(mechanism, sv.Program(program(q), by="ideal"))


def integrated(rates, t, state):
    """States at times t (N,) of X' = rates(t, X), by SciPy."""
    return solve_ivp(rates, (t[0], t[-1]), state, t_eval=t, **INDEPENDENT).y


@pytest.mark.parametrize("method", ["Taylor", "RK8"])
def test_orders_one_and_three_together(method):
    """A clothoid: unit speed (order 1), curvature that grows by 0.5 1/m per second (order 3)."""

    def program(q):
        (dx, dy), (ddx, ddy) = q.d(1), q.d(2)
        return {
            "speed": ca.sqrt(dx**2 + dy**2) - 1,
            "spin": q.dt((dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5) - 0.5,
        }

    model = free("x y", program)
    run = sv.simulate(model, model.start(x=0.0, y=0.0, dx=1.0, dy=0.0, d2x=0.0, d2y=0.0), (0.0, 3.0), method)
    course = 0.25 * run.t**2
    path = integrated(lambda t, s: [np.cos(0.25 * t**2), np.sin(0.25 * t**2)], run.t, [0.0, 0.0])
    assert np.abs(run["dx"] - np.cos(course)).max() < 1e-7 and np.abs(run["dy"] - np.sin(course)).max() < 1e-7
    assert np.abs(run.jets[:2] - path).max() < 1e-7


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA"])
def test_a_material_sphere_and_order_three(method):
    """On the unit sphere, a material constraint, z''' = -0.8 sin 2t."""

    def program(q):
        return {"jerk": q.d(3)[2] + 0.8 * ca.sin(2 * q.t)}

    model = free("x y z", program, constraints=lambda q: {"sphere": ca.sumsqr(ca.vertcat(*q)) - 1})
    start = model.start(x=1.0, y=0.0, z=0.0, dy=0.5, dz=0.2, d2z=0.0)
    run = sv.simulate(model, start, (0.0, 2.0), method)
    t = run.t  # z'' = 0.4 (cos 2t - 1), z' = 0.2 + 0.2 sin 2t - 0.4 t, z = 0.2 t + 0.1 (1 - cos 2t) - 0.2 t²
    assert np.abs(run["z"] - (0.2 * t + 0.1 * (1 - np.cos(2 * t)) - 0.2 * t**2)).max() < 1e-7
    assert np.abs(run["x"] ** 2 + run["y"] ** 2 + run["z"] ** 2 - 1).max() < 1e-7
    # the reactions lie along the z axis and the radius: no moment about the z axis
    assert np.abs(run["x"] * run["dy"] - run["y"] * run["dx"] - 0.5).max() < 1e-7


@pytest.mark.parametrize("method", ["DOP853", "RK8"])
def test_a_residual_of_order_three_that_is_not_linear(method):
    """The magnitude of the jerk is 2: under the generalised rule the reaction lies along the jerk j, so a × j = 0."""

    def program(q):
        a, b = q.d(3)
        return {"jerk": a**2 + b**2 - 4}

    model = free("x y", program)
    start = model.start(x=0.0, y=0.0, dx=1.0, dy=0.0, d2x=0.6, d2y=0.8, guess={"d3x": 1.2, "d3y": 1.6})
    run = sv.simulate(model, start, (0.0, 1.5), method)
    t, direction = run.t, np.array([[0.6], [0.8]])
    # the acceleration keeps its direction and grows by 2 per second
    closed = np.array([[1.0], [0.0]]) * t + direction * (t**2 / 2 + t**3 / 3)
    assert np.abs(run.jets[:2] - closed).max() < 1e-7


@pytest.mark.parametrize("method", ["Taylor", "RadauIIA"])
def test_velocity_rows_on_a_turntable(method):
    """A skate on a table that turns by 0.7 rad/s: across its blade it moves with the table."""
    rate = 0.7
    q = sv.coordinates("x y theta")
    (x, y, theta), (dx, dy, _) = q, q.d(1)
    mechanism = sv.Mechanism(
        q,
        gibbs=sum(a**2 for a in q.d(2)) / 2,
        constraints={"blade": -(dx + rate * y) * ca.sin(theta) + (dy - rate * x) * ca.cos(theta)},
        actuators={"torque": theta},
    )
    model = sv.derive(mechanism, sv.Program({"turn": theta - 0.5 * ca.sin(q.t) - rate * q.t}))
    run = sv.simulate(model, model.start(x=0.3, y=0.1, guess={"dx": 1.0}), (0.0, 4.0), method)

    def rates(t, s):
        """The forward speed v alone is free: its equation is the balance along the blade."""
        x, y, v = s
        angle, turn = 0.5 * np.sin(t) + rate * t, 0.5 * np.cos(t) + rate
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        side = rate * (y * np.sin(angle) + x * np.cos(angle))
        velocity = v * along + side * across
        return [*velocity, turn * side]

    v = run["dx"] * np.cos(run["theta"]) + run["dy"] * np.sin(run["theta"])
    reference = integrated(rates, run.t, [0.3, 0.1, v[0]])
    assert np.abs(np.array([run["x"], run["y"], v]) - reference).max() < 1e-7


@pytest.mark.parametrize("method", ["Taylor", "RadauIIA"])
def test_kinematics_that_depend_on_time(method):
    """A particle in a frame that turns by t² / 2 and drifts: q' = V(t) w + h(t), w in the turning frame."""
    plain = sv.coordinates("x y")
    angle = plain.t**2 / 2
    c, s = ca.cos(angle), ca.sin(angle)
    q = plain.with_quasi_velocities("u v", [[c, -s], [s, c]], h=[0.2, 0.1 * plain.t])
    (x, y), (u, v) = q, q.w()
    velocity = q.V @ ca.vertcat(u, v) + q.h
    acceleration = q.dt(velocity)
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(acceleration) / 2, potential=2 * (x**2 + y**2), actuators={"F": [1, 0]})
    model = sv.derive(mechanism, sv.Program({"along": u - ca.sin(plain.t)}))
    run = sv.simulate(model, model.start(x=1.0, y=0.0, v=0.3), (0.0, 3.0), method)

    def rates(t, state):
        """The balance across: the acceleration along the second axis of the frame is that of the spring."""
        x, y, v = state
        c, s, u = np.cos(t**2 / 2), np.sin(t**2 / 2), np.sin(t)
        force = -4 * (-s * x + c * y)
        return [c * u - s * v + 0.2, s * u + c * v + 0.1 * t, force - t * u - 0.1 * c]

    reference = integrated(rates, run.t, [1.0, 0.0, 0.3])
    assert np.abs(np.array([run["x"], run["y"], run["v"]]) - reference).max() < 1e-7
