"""Gathered scales: the same values as the given statements, of which those of parameters alone are computed once."""

import ctypes

import casadi as ca
import numpy as np
import pytest

from servoctl.codegen import emit
from servoctl.codegen.compiler import library
from servoctl.codegen.scaling import is_still, scaled

T, X, P = ca.SX.sym("t"), ca.SX.sym("x", 4), ca.SX.sym("p", 3)
A, B, C = P.elements()
SUM = A * X[0] + B * X[1]

EXPRESSIONS = {
    "a chain of scales": 5 * ((-0.05 * (A * (B * (X[0] * X[1])))) / C),
    "a scaled sum": 0.25 * (SUM * 3) / C,
    "a scaled sum, negated": -(0.5 * SUM),
    "a difference of negated terms": -(A * X[0]) - 2 * (-X[1]) - (-(B * X[2])),
    "a sum of negated terms": -(A * X[0]) + -(B * X[2]),
    "a sum that two scale": 0.5 * SUM + A * ca.sin(SUM),
    "a sum that is a divisor": A / SUM + (A * X[1] + 2 * X[2]) / 3,
    "a scaled sum of scaled sums": B * (2 * SUM + C * (X[2] * A - 3 * X[3])),
    "a scale that comes later": (A * X[0] + X[1]) * (A + B * C) - X[2],
    "a sum of parameters": (A + 2 * B) * (C - A) * X[0] + A * B,
    "two that move": (A * X[0]) * (-(B * X[1])),
    "zero and one": 0 * X[0] + 1 * (A * X[1]) - ca.SX(0) * A * X[2],
    "branches": ca.if_else(X[0] > A, X[1] * B, ca.fabs(X[1]) / ca.sqrt(X[2] * X[2] + 1)) * A * X[1],
    "functions of parameters": ca.sin(A) * X[0] + ca.exp(B) / C * X[1] * ca.sin(T),
    "a parameter": B,
    "a state": X[2],
    "a number": ca.SX(3),
}  # fmt: skip


def function(*outputs):
    return ca.Function("f", [T, X, P], [ca.densify(ca.vertcat(*outputs))])


def statements(*outputs):
    return scaled(emit._statements(function(*outputs), emit.SCALAR))


def moving(statements):
    """The operations that depend on more than p."""
    still, result = set(), []
    for target, operation, operands in statements:
        if isinstance(target, int) and all(is_still(v, still) for v in operands):
            still.add(target)
        elif isinstance(target, int):
            result.append(operation)
    return result


@pytest.mark.parametrize("name", EXPRESSIONS)
@pytest.mark.parametrize("chunk", [3, 350])
@pytest.mark.usefixtures("c_compiler")
def test_values_are_those_of_the_given_order(name, chunk):
    f = function(EXPRESSIONS[name], EXPRESSIONS[name] * X[2] - A / X[3])
    call = library(emit.unit({"NAME": "f"}) + emit.series(f, "f", chunk=chunk), "-O1").f
    call.restype = None
    rng = np.random.default_rng(len(name))
    for _ in range(20):
        x, p, y = rng.normal(size=4), rng.uniform(0.5, 2, 3), np.empty(2)
        call(ctypes.c_double(0.3), *(ctypes.c_void_p(v.ctypes.data) for v in (x, p, y)))
        np.testing.assert_allclose(y, np.array(f(0.3, x, p)).ravel(), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("name, left", [
    ("a chain of scales", [ca.OP_MUL] * 2),
    ("a scaled sum", [ca.OP_MUL] * 2 + [ca.OP_ADD]),
    ("a scaled sum, negated", [ca.OP_MUL] * 2 + [ca.OP_ADD]),
    ("a scaled sum of scaled sums", [ca.OP_MUL] * 5 + [ca.OP_ADD, ca.OP_ADD, ca.OP_SUB]),
    ("a sum of parameters", [ca.OP_MUL, ca.OP_ADD]),
])  # fmt: skip
def test_a_value_waits_for_one_scale(name, left):
    assert emit.operations(function(EXPRESSIONS[name])) > len(left)
    assert sorted(moving(statements(EXPRESSIONS[name]))) == sorted(left)


def test_values_that_differ_by_a_scale_follow_from_the_same_value():
    product = X[0] * X[1]
    assert moving(statements(product * A * 0.5, product * A * 3, -product)) == [ca.OP_MUL] * 3 + [ca.OP_NEG]


def test_a_quotient_by_a_number_rounds_once():
    assert ca.OP_DIV in moving(statements(X[0] / 3))


def test_what_depends_on_parameters_alone_is_not_computed_again():
    text = emit.series(function(*EXPRESSIONS.values()), "f", chunk=10**6)
    once, again = text.split("void f_moving", 1)
    for part in ("sin(p[0])", "exp(p[1])", "1.0 / p[2]"):
        assert part in once and part not in again
    assert "x[" not in once.split("{", 1)[1]
