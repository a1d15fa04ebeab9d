"""Where the equations may change much within a step: at zeros and least magnitudes of the arguments of functions.

The stages of a step see nothing of a bump or a blend between them, and no test of its error does. The arguments of the
functions in the equations show where these can be: along the dense output of a step they are located, and there the
equations are evaluated, and beside: the force of a barrier is zero on its top.
"""

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.jets.branches import steep_arguments
from servoctl.spec.references import function_of

BESIDE_ZERO = 0.7  # change of an argument from its zero, at which odd functions of it are large, such as s exp(-s²)
SECANTS, MOST_SECANTS = 4, 60  # of a zero between two instants, least and most
LOCATED = 1e-2  # argument at which a zero is located well enough
CLOSE = 1e-8  # of an interval, over which an argument is a straight line


def arguments(model):
    """The compiled arguments of steep functions in a model's equations, of (t, X, p); None if there are none."""

    def build():
        moving, m = steep(model), model.reduction.mechanism
        if not moving:
            return None
        p, names = ca.vertcat(*m.parameters.symbols), model.reduction.references
        return compiled(function_of(m.q, names, "steep", _state(model), p, ca.densify(ca.vertcat(*moving))), "steep")

    return model.once("steep arguments", build)


def steep(model, squares=True):
    """The arguments of steep functions in a model's equations that change along its motions: a list of SX."""
    m, program = model.reduction.mechanism, model.reduction.program
    weights = [w for w in program.weights.values() if isinstance(w, ca.SX)]
    rows = [*program.residuals.values(), *m.constraints.values(), *weights, *m.E.elements()]
    found = steep_arguments([ca.SX(e) for e in (*m.balance.elements(), *rows)], squares)
    known = {s.element_hash() for s in (m.q.t, *_state(model).elements(), *m.parameters.symbols)}
    return [a for a in found if _moves(a, known, m.q)]


def _state(model):
    q = model.reduction.mechanism.q
    return ca.vertcat(*q, *(s for k in range(1, model.reduction.top) for s in q.gamma(k)))


def _moves(argument, known, q):
    """Whether an argument is known with the state, and changes with it or with time."""
    symbols = ca.symvar(argument)
    return all(s.element_hash() in known for s in symbols) and any(q.where(s) is not None for s in symbols)


def centres(f, p, t, x, dense):
    """Instants at which an argument is zero, or its magnitude least, and those beside at which it differs by 0.7.

    f is from `arguments`. States x (n_x, N) are those at t (N,), in the order of the motion [s]; `dense` gives states
    (n_x, M) at times (M,) between the first and the last of these instants. The result (M,) is not in order.
    """
    with np.errstate(all="ignore"):
        g = f.grid(t, x, p)
        below, known = g < 0, ~np.isnan(g)
        i, j = np.nonzero((below[:, :-1] != below[:, 1:]) & known[:, :-1] & known[:, 1:])
        zeros = t[j]
        if len(zeros):
            zeros = _zeros(lambda s: f.grid(s, dense(s), p)[i, np.arange(len(s))], t[j], t[j + 1], g[i, j], g[i, j + 1])
        size = np.abs(g)
        before, here, after = size[:, :-2], size[:, 1:-1], size[:, 2:]
        least = (here < before) & (here <= after) & (g[:, :-2] * g[:, 2:] > 0)
        i, j = np.nonzero(least)
        return np.concatenate([zeros, _vertices(t, size, i, j + 1)])


def _zeros(function, a, b, left, right):
    """Zeros of functions between a and b (M,) by the Illinois method, and beside; values there have opposite signs.

    Many steps are needed where arguments of exponentials are kept from overflow, and are constant far from their zeros.
    """
    s, start, end = a, a, b
    for step in range(MOST_SECANTS):
        s = b - right * (b - a) / (right - left)
        s = np.where(np.isfinite(s), s, (a + b) / 2)
        value = function(s)
        beyond = value * right < 0
        a, left = np.where(beyond, b, a), np.where(beyond, right, left / 2)
        b, right = s, value
        if not np.any(value) or (step >= SECANTS - 1 and not np.any(np.abs(value) > LOCATED)):
            break
    h = CLOSE * (end - start)
    return _aside(s, BESIDE_ZERO * 2 * np.abs(h) / np.abs(function(s + h) - function(s - h)), start, end)


def _vertices(t, size, i, j):
    """Where the parabola through three instants about j (M,) is least, and beside."""
    h0, h1 = t[j] - t[j - 1], t[j + 1] - t[j]
    d0, d1 = (size[i, j] - size[i, j - 1]) / h0, (size[i, j + 1] - size[i, j]) / h1
    s = t[j] - (d0 * h1 + d1 * h0) / (2 * (d1 - d0))
    s = np.where(np.isfinite(s), s, t[j])
    return _aside(s, np.sqrt(BESIDE_ZERO * np.abs((h0 + h1) / (d1 - d0))), t[j - 1], t[j + 1])


def _aside(s, distance, a, b):
    """Instants s (M,), and those at a distance (M,) before and after them between a and b (M,)."""
    return np.concatenate([s, *(np.clip(s + d, np.minimum(a, b), np.maximum(a, b)) for d in (-distance, distance))])
