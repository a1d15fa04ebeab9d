"""Derivatives of compiled functions, from their expressions."""

import functools

import casadi as ca
import numpy as np

from servoctl.codegen.function import Compiled
from servoctl.codegen.paths import arguments, combined


def differentiable(function):
    """Whether a function of (t, x, p) has expressions."""
    return isinstance(function, Compiled)


def jacobian(function, by, t, x, p):
    """∂y/∂x or ∂y/∂p (n_y, n) of a compiled function y(t, x, p) at a point, exactly; `by` is "x" or "p"."""
    f = _jacobian(function, by)
    return np.array(f(*arguments(f, t, x, p)))


@functools.lru_cache(maxsize=64)
def _jacobian(function, by):
    return combined("jacobian", lambda x, p, y: ca.jacobian(y, x if by == "x" else p), function.expression)
