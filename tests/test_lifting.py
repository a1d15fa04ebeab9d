"""Equations that are linear in unknowns, as a sparse system with shared sums as unknowns."""

import casadi as ca
import numpy as np
import pytest

from servoctl.reduction.lifting import lifted

x = ca.SX.sym("x", 4)
a = ca.SX.sym("a", 3)
VALUES = [0.7, -1.3, 2.1]


def eliminated(matrix, rows):
    """A of f = A x + f(0), from [P Q; R S - 1] at values of the factors."""
    numbers = ca.Function("matrix", [a], [ca.densify(matrix)])(VALUES).full()
    n = x.numel()
    P, Q, R, S = numbers[:rows, :n], numbers[:rows, n:], numbers[rows:, :n], numbers[rows:, n:]
    assert np.allclose(np.triu(S, 1), 0) and np.allclose(np.diag(S), -1)
    return P - Q @ np.linalg.solve(S, R) if len(S) else P


def chain():
    """Accelerations of four bodies, each carried by the one before, and the forces of all behind them."""
    positions, total, balance = [], 0, []
    for k in range(4):
        total = total + x[k]
        positions.append(ca.cos(a[k % 3]) * total + (positions[-1] if k else 0))
    force = 0
    for position in reversed(positions):
        force = force + a[0] * position
        balance.append(force / a[1] - 3)
    return balance


EXPRESSIONS = {
    "chain": chain(),
    "plain": [2 * x[0] + a[0], x[1] - x[2], -x[3], a[1]],
    "divided": [(x[0] + a[0] * x[1]) / a[2] + ca.sin(a[1]), (x[0] + a[0] * x[1]) * ca.exp(a[0]) - x[0]],
    "differences": [(x[0] - x[1]) - (x[0] - x[1]), a[0] * (x[2] - x[1]) - (x[2] - x[1]) * a[1]],
    "branch of factors": [ca.if_else(a[0] > 0, x[0] + x[1], x[2]) + 2 * (x[0] + x[1])],
    "constant": [a[0] ** 2, ca.SX(3.0)],
}


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_the_system_has_the_jacobian_of_the_expressions(name):
    column = ca.vertcat(*EXPRESSIONS[name])
    expected = ca.Function("jacobian", [a], [ca.densify(ca.jacobian(column, x))])(VALUES).full()
    assert eliminated(lifted(column, x), column.numel()) == pytest.approx(expected, abs=1e-14)


def test_a_sum_that_several_rows_share_becomes_an_unknown_and_others_do_not():
    shared = x[0] + a[0] * x[1]
    assert lifted(ca.vertcat(shared * a[1], shared / a[2]), x).shape == (3, 5)
    assert lifted(ca.vertcat(shared, x[2] + x[3]), x).shape == (2, 4)
    assert lifted(ca.vertcat(a[0] * x[0], 2 * x[0], x[0]), x).shape == (3, 4)


@pytest.mark.parametrize(
    "expression",
    [x[0] * x[1], x[0] ** 2 - x[0] ** 2 * ca.cos(a[0]), ca.sin(x[1]), a[0] / x[0], ca.fmin(x[0], x[1]), ca.fabs(x[2]),
     ca.if_else(x[0] > 0, a[0], a[1])],
    ids=str,
)  # fmt: skip
def test_what_is_no_sum_of_unknowns_with_factors_has_no_system(expression):
    assert lifted(ca.vertcat(expression, x[0]), x) is None
