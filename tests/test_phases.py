"""Functions in two phases: the same values, of which those of parameters alone are computed once."""

import ctypes

import casadi as ca
import numpy as np
import pytest

from servoctl.codegen import emit
from servoctl.codegen.compiler import library

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


@pytest.mark.parametrize("name", EXPRESSIONS)
@pytest.mark.parametrize("chunk", [3, 350])
@pytest.mark.usefixtures("c_compiler")
def test_two_phases_give_the_values_of_the_function(name, chunk):
    f = function(EXPRESSIONS[name], EXPRESSIONS[name] * X[2] - A / X[3])
    call = library(emit.unit({"NAME": "f"}) + emit.series(f, "f", chunk=chunk), "-O1").f
    call.restype = None
    rng = np.random.default_rng(len(name))
    for _ in range(20):
        x, p, y = rng.normal(size=4), rng.uniform(0.5, 2, 3), np.empty(2)
        call(ctypes.c_double(0.3), *(ctypes.c_void_p(v.ctypes.data) for v in (x, p, y)))
        np.testing.assert_allclose(y, np.array(f(0.3, x, p)).ravel(), rtol=1e-14, atol=1e-14)


def test_what_depends_on_parameters_alone_is_not_computed_again():
    text = emit.series(function(*EXPRESSIONS.values()), "f", chunk=10**6)
    once, again = text.split("void f_moving", 1)
    for part in ("sin(p[0])", "exp(p[1])"):
        assert part in once and part not in again
    assert "x[" not in once.split("{", 1)[1]
