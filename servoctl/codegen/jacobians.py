"""Derivatives of compiled functions, from their expressions."""

import functools

import casadi as ca
import numpy as np

from servoctl.codegen.function import Compiled


def differentiable(function):
    """Whether a function of (t, x, p) has expressions."""
    return isinstance(function, Compiled)


def jacobian(function, by, t, x, p):
    """∂y/∂x or ∂y/∂p (n_y, n) of a compiled function y(t, x, p) at a point, exactly; `by` is "x" or "p"."""
    return np.array(_jacobian(function, by)(t, x, p))


@functools.lru_cache(maxsize=64)
def _jacobian(function, by):
    f = function.expression
    t, x, p = (ca.SX.sym(name, f.numel_in(i)) for i, name in enumerate("txp"))
    y = f(t, x, p)
    return ca.Function("jacobian", [t, x, p], [ca.densify(ca.jacobian(y, x if by == "x" else p))])
