"""Robots with a free base and many joints: points, starts and operations in reasonable numbers."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from conftest import at_random, numbers
from walkers import Robot

import servoctl as sv
from servoctl.jets.series import Flow
from servoctl.reduction.lifting import lifted
from servoctl.reduction.rows import row_levels

LEG = [0, 1, 2, 3, 4, 5]  # parents of the links of a leg with six joints


def branches(n):
    """Parents of n links in two branches."""
    return [max(0, i - 2) for i in range(1, n + 1)]


@pytest.fixture(scope="module")
def standing():
    """A robot of 14 velocities that stands on its foot, with one of two arm joints programmed."""
    robot = Robot([*LEG, 0, 7])
    return robot, *robot.scene(["j7"], feet=[6], base=True)


def test_a_robot_is_derived_without_gradients_in_all_jets(standing, monkeypatch):
    """They take most of the time, and a start from which q cannot be solved is given up before."""
    robot, mechanism, program = standing
    called, levels = Flow.__call__, []

    def noted(flow, t, z):
        levels.append(flow.level)
        return called(flow, t, z)

    monkeypatch.setattr(Flow, "__call__", noted)
    model = sv.derive(mechanism, program, guess=robot.posture())
    assert not any(levels)
    start = model.start(guess=robot.posture())
    assert start.residual < 1e-15 and len(start.free) == 2
    assert all(abs(start[name] - value) < 1e-12 for name, value in robot.posture().items())


@cache
def accelerated(n):
    """A robot in the air, all joints programmed, of 6 + n velocities."""
    robot = Robot(branches(n))
    mechanism, program = robot.scene([f"j{i}" for i in range(1, n + 1)])
    return sv.derive(mechanism, program, guess=robot.posture())


def test_the_accelerations_of_a_robot_are_those_of_its_full_mass_matrix():
    model = accelerated(5)
    r, q = model.reduction, model.reduction.mechanism.q
    assert model.equations.sparse
    unknown = ca.vertcat(q.jet(2), mu := ca.SX.sym("mu", r.realisation.B.shape[1]))
    rows = ca.vertcat(r.balance - r.realisation.B @ mu, *(level[-1] for level in row_levels(q, [*r.original.values()], 2)))
    symbols = [q.t, ca.vertcat(*q, *q.gamma(1)), ca.vertcat(*r.mechanism.parameters.symbols)]
    form = ca.Function("form", symbols, [ca.jacobian(rows, unknown), -ca.substitute(rows, unknown, 0 * unknown)])
    for seed in range(3):
        state = np.random.default_rng(seed).uniform(-1.0, 1.0, len(model.state_names))
        matrix, right = (np.array(part) for part in form(0.3, state, model.parameters))
        expected = np.linalg.solve(matrix, right)[:, 0]
        y = model.function("accelerations")(0.3, state, model.p)
        assert y == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_the_operations_of_a_robot_are_linear_in_its_joints():
    models = {n: accelerated(n) for n in (5, 10)}
    counts = {n: model.function("accelerations").operations for n, model in models.items()}
    assert counts[10] <= 2.4 * counts[5]
    entries = [lifted(r.mechanism.balance, r.mechanism.q.jet(2)).nnz() for r in (models[n].reduction for n in (5, 10))]
    assert entries[1] <= 2.1 * entries[0]


def test_rows_of_a_robot_are_differentiated_together(monkeypatch):
    """Rows that are differentiated equally often share the kinematics of the robot."""
    reduction = accelerated(5).reduction
    q, rows = reduction.mechanism.q, [row for row in reduction.rows if row.kind == "program"]
    one_by_one = [row_levels(q, [row], 2)[0] for row in rows]
    calls, series = [], type(q)._series
    monkeypatch.setattr(type(q), "_series", lambda *given: calls.append(given) or series(*given))
    together = row_levels(q, rows, 2)
    assert len(calls) == 1 and len(rows) == 5
    known = at_random(q)
    values = [numbers(sum(levels, []), known) for levels in (together, one_by_one)]
    assert len(values[0]) == 15 and (values[0] == values[1]).all()
