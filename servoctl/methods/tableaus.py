"""Explicit Runge-Kutta methods as data."""

import numpy as np

from servoctl.errors import unknown

ORDERS = {"RK1": 1, "RK2": 2, "RK4": 4, "RK5": 5, "RK8": 8}
"""Order of each method: Euler's, the midpoint rule, the classical one of Kutta (1901), Dormand and Prince's of orders
5 (1980) and 8 (Prince and Dormand 1981), whose coefficients are scipy's."""


def tableau(name):
    """The tableau (a, b, c) of a method.

    Parameters
    ----------
    name : {"RK1", "RK2", "RK4", "RK5", "RK8"}

    Returns
    -------
    a : (s, s) array
        Strictly lower triangular.
    b, c : (s,) arrays

    Raises
    ------
    NameUnknown
        For another name.
    """
    if name not in ORDERS:
        raise unknown(name, ORDERS, "method")
    if name in ("RK5", "RK8"):
        import scipy.integrate

        method = scipy.integrate.RK45 if name == "RK5" else scipy.integrate.DOP853
        s = method.n_stages
        a = np.zeros((s, s))
        a[:, : method.A.shape[1]] = method.A[:s, :s]
        return a, np.array(method.B[:s]), np.array(method.C[:s])
    b = {"RK1": [1.0], "RK2": [0.0, 1.0], "RK4": [1 / 6, 1 / 3, 1 / 3, 1 / 6]}[name]
    c = {"RK1": [0.0], "RK2": [0.0, 0.5], "RK4": [0.0, 0.5, 0.5, 1.0]}[name]
    a = np.zeros((len(b), len(b)))
    a[np.arange(1, len(b)), np.arange(len(b) - 1)] = c[1:]
    return a, np.array(b), np.array(c)
