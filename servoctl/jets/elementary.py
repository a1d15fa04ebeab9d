"""Elementary functions of SX expressions or of arrays, whichever is given."""

import operator

import casadi as ca
import numpy as np

if ca.GlobalOptions.getNumpyMode() == 0:  # nothing chosen: NumPy's functions of symbols work, and CasADi warns of them
    ca.GlobalOptions.setNumpyMode(-1)  # the same without a warning

_NUMPY = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "exp": np.exp, "log": np.log, "sqrt": np.sqrt,
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "sinh": np.sinh, "cosh": np.cosh,
    "tanh": np.tanh, "asinh": np.arcsinh, "acosh": np.arccosh, "atanh": np.arctanh, "expm1": np.expm1,
    "log1p": np.log1p, "sign": np.sign, "fabs": np.abs, "atan2": np.arctan2,
    "power": np.power,
    "lt": lambda a, b: 1.0 * (a < b), "le": lambda a, b: 1.0 * (a <= b),
    "eq": lambda a, b: 1.0 * (a == b), "ne": lambda a, b: 1.0 * (a != b),
    "logic_and": lambda a, b: 1.0 * ((a != 0) & (b != 0)), "logic_or": lambda a, b: 1.0 * ((a != 0) | (b != 0)),
    "logic_not": lambda a: 1.0 * (a == 0),
}  # fmt: skip
_CASADI = {name: getattr(ca, name) for name in _NUMPY} | {"erf": ca.erf}


def _np_erf(x):
    from scipy.special import erf

    return erf(np.asarray(x, dtype=float))


_NUMPY["erf"] = _np_erf


def apply(name, *args):
    """The function `name` on SX expressions or on numbers and arrays, whichever is given."""
    if any(isinstance(a, ca.SX) for a in args):
        return _CASADI[name](*args)
    return _NUMPY[name](*args)


def _arithmetic(name, code):
    """An operation of two: `SX.binary` skips the search for a common type, which takes ten times as long."""
    plain, of_two, symbolic = getattr(operator, name), ca.SX.binary, ca.SX

    def run(a, b):
        return of_two(code, a, b) if a.__class__ is symbolic or b.__class__ is symbolic else plain(a, b)

    return run


add = _arithmetic("add", ca.OP_ADD)
subtract = _arithmetic("sub", ca.OP_SUB)
multiply = _arithmetic("mul", ca.OP_MUL)
divide = _arithmetic("truediv", ca.OP_DIV)


def select(condition, yes, no):
    """`yes` where `condition` is not zero, else `no`; works on SX expressions and on arrays."""
    if any(isinstance(a, ca.SX) for a in (condition, yes, no)):
        return ca.if_else(condition, yes, no)
    return np.where(condition, yes, no)
