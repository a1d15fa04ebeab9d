"""How large the entries of a state are along a motion, in the metric of the inertia."""

from functools import cache

import numpy as np

from servoctl.values import read_only


def state_levels(model):
    """Level of each entry of the state X: 0 for q, k for γ^(k); (n_x,) array of int."""
    return _levels(len(model.state_names), model.nq, model.n)


@cache
def _levels(n_x, nq, n):
    return read_only(np.append(np.zeros(nq, dtype=int), 1 + np.arange(n_x - nq) // n))


def from_start(model, x, x0):
    """States x (n_x, N), q as its way from the start x0 (n_x,), whose size does not hang on where the origin lies."""
    return x - np.where(state_levels(model) == 0, x0, 0.0)[:, None]


def motion_sizes(model, t, x):
    """Sizes (n_x,) of the entries of X along a motion, in the metric of the inertia, with which no unit matters.

    A level is as large as its largest √M_ii |γ_i^(k)|, and at least as large as the level below over the time; what a
    coordinate at rest has of it is rounding. Coordinates without inertia, and q of another frame than γ', have their
    own largest magnitude. The motion is x (n_x, N) at t (N,) [s].
    """
    inertia = model.function("matrices")(t[0], x[:, 0], model.p)[-model.n :]
    return sizes_of(model, inertia, np.abs(x).max(axis=1), t[-1] - t[0])


def sizes_of(model, inertia, largest, duration):
    """The same from the inertia (n, ...), the largest magnitudes (n_x, ...) of the state and a duration [s]."""
    metric, n_x = np.sqrt(np.maximum(inertia, 0.0)), len(largest)
    sizes, below, duration, massive = largest.copy(), 0.0, max(abs(duration), 1e-300), metric > 0
    for first in range(0 if model.reduction.mechanism.q.plain else model.nq, n_x, model.n):
        here = slice(first, first + model.n)
        below = np.maximum((metric * largest[here]).max(axis=0), below / duration)
        np.divide(below, metric, out=sizes[here], where=massive)
    return sizes
