"""Products without constant factors inside: the same values, and fewer products of series."""

import casadi as ca
import numpy as np
import pytest

from servoctl.codegen.emit import operations
from servoctl.jets.factors import constants_outside
from servoctl.jets.series import Series
from servoctl.jets.tape import Tape

A, B, P, Q = (ca.SX.sym(name) for name in "abpq")
EXPRESSIONS = {
    "products": P * A * (Q * B) - 2 * (P * A) * B,
    "squares": (P * A) ** 2 + (-A) ** 2 * P,
    "quotients": P * A / (Q * B) + A / P,
    "functions": P * ca.sin(Q * A) * B + ca.exp(-P * B) * A,
    "powers": (P * A) ** 3 * ca.sqrt(Q * B) + (2 * B) ** 1.5,
    "branches": ca.fabs(P * A) * B + ca.if_else(A > 1, Q * A, B) + ca.fmin(-A, Q * B),
    "constants": P * Q + ca.sin(P) * 3,
    "atan2": ca.atan2(P * A, B) * Q + ca.tanh(-A) * P,
}


def coefficients(tape, series):
    run = Series(tape, series)
    for _ in range(6):
        run.advance()
    return np.array([[float(c) for c in output] for output in run.outputs])


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_values_are_the_same(name):
    rng, symbols = np.random.default_rng(3), [A, B, P, Q]
    tape = Tape(symbols, [EXPRESSIONS[name], EXPRESSIONS[name] * P])
    of_time = [list(rng.uniform(0.5, 1.5, 6)) for _ in (A, B)]
    series = [*of_time, *([value, *[0.0] * 5] for value in (1.3, -0.7 if name == "products" else 0.7))]
    expected, found = coefficients(tape, series), coefficients(constants_outside(tape, {2, 3}), series)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


def test_a_product_is_formed_once_for_all_constant_factors():
    tape = Tape([A, B, P, Q], [P * A * B, Q * (B * A), -(Q * B) * (P * A)])
    nodes = constants_outside(tape, {2, 3}).nodes
    of_series = [n for n in nodes if n.kind == "mul" and not {2, 3}.intersection(n.args) and set(n.args) <= {0, 1}]
    assert len(of_series) == 1


def test_a_sine_shares_its_recurrence_with_products_of_rates():
    """Coefficient k of cos(a)' is that of -sin(a) a', up to the last terms, which the recurrence of cos(a) lacks."""
    a, b = ([ca.SX.sym(f"{name}{k}") for k in range(9)] for name in "ab")
    rate = [a[k + 1] * float(k + 1) for k in range(8)]
    counts = []
    both = [ca.cos(A), B * ca.sin(A)]
    for expressions, factor in ((both[:1], rate), (both, rate), (both, b)):
        run = Series(Tape([A, B], expressions), [a[:8], factor[:8]])
        for _ in range(8):
            run.advance()
        terms = ca.cse(ca.vertcat(*(ca.SX(c) for output in run.outputs for c in output)))
        counts.append(operations(ca.Function("f", [ca.SX.sym("t"), ca.vertcat(*a), ca.vertcat(*b)], [terms])))
    alone, shared, separate = counts
    assert 2 * (shared - alone) < separate - alone
