"""Taylor expansions of the polynomials of paths."""

import numpy as np


def taylor(coefficients, pieces, tau, order):
    """Taylor coefficients (order + 1, N, dim) of pieces (N,) of a table (n, dim, size), at local times (N,)."""
    tau, result = tau[:, None], np.zeros((order + 1, len(tau), coefficients.shape[1]))
    for j in reversed(range(coefficients.shape[2])):
        result[1:] = result[1:] * tau + result[:-1]
        result[0] = result[0] * tau + coefficients[pieces, :, j]
    return result


def taylor_at(breaks, coefficients, tau):
    """Taylor coefficients (size, n, dim) of all pieces at one local time, in units of half their mean length."""
    n, _, size = coefficients.shape
    lengths = np.diff(breaks)
    with np.errstate(over="ignore", invalid="ignore"):  # of the shortest of very uneven pieces
        unit = (lengths.mean() / lengths) ** np.arange(size)[:, None]
        return taylor(coefficients, np.arange(n), np.full(n, float(tau)), size - 1) * unit[:, :, None]
