"""Jets of a motion beyond its states: those that the model determines, by its rates or by derivatives of its rows."""

from dataclasses import replace
from math import factorial

import numpy as np

from servoctl.jets.series import Flow
from servoctl.jets.tape import REAL
from servoctl.model.following import instants_of
from servoctl.reduction.manifold import ON_MANIFOLD, solve


def jet_names_to(model, size):
    """Names of the first `size` jets, beyond γ^(s̄) if necessary."""
    q, names, k = model.reduction.mechanism.q, list(model.jet_names), model.reduction.top
    while len(names) < size:
        k += 1
        names += q.jet_names(k)
    return tuple(names[:size])


def with_highest(model, t, states, p=None):
    """The jets (n_z, N) of a motion from its states (n_x, N) at times (N,): with the derivatives that are determined.

    The parameters are (n_p,) or (n_p, N); default: those of the model.
    """
    (n_x, n), p = (len(model.state_names), model.n), model.p if p is None else p
    if not model.flat:
        return np.concatenate([states, model.function("ode").grid(t, states, p)[n_x - n : n_x]])
    nq, path = model.nq, model.function("path")
    first = nq if model.reduction.mechanism.q.plain else 3 * nq
    return np.concatenate([states, path.grid(t, states[:nq], p)[first + n : first + 2 * n]])


def extended(model, t, jets, size):
    """Jets (size, N) of a motion beyond those known, from derivatives of its rows (`reduction.manifold.solve`).

    The known ones (n, N) are at least the state; the others are NaN where the rows do not determine them.
    """
    r, q = model.reduction, model.reduction.mechanism.q
    level = (size - q.nq) // q.n
    scale = np.repeat([1.0, *(factorial(k) for k in range(1, level + 1))], [q.nq, *level * [q.n]])[:, None]
    z = np.zeros((size, len(t)), dtype=REAL)
    z[: len(jets)] = jets / scale[: len(jets)]
    instants = instants_of(model, t)
    points = replace(r.points, instants=instants, z=z, values=model.parameters, residual=np.zeros(len(t)))
    if r.cascade is not None:
        deeper, good = r.cascade.continued(points, level, r.top - 1)
        solved = deeper[:size]
    else:
        solved, residual = solve(Flow(q, r.rows, level, points), instants, z)
        good = residual < ON_MANIFOLD
    result = np.where(good, (solved * scale).astype(float), np.nan)
    result[: len(jets)] = jets
    return result
