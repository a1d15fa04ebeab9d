"""Consistent starts of many cases at once, where they are the same or a linear problem with one solution.

Of a linear problem: level by level, coordinates first and then velocities, as many invariants as unknown entries must
remain, which are affine in them. Then one state has the held values, and it is the one that `Model.start` finds.
"""

import casadi as ca
import numpy as np

from servoctl.model.equations import invariant_names
from servoctl.reduction.manifold import WELL_CONDITIONED

PASSES = 2  # Newton steps of each level: one solves it, another one takes what rounding left


def linear_levels(model, held):
    """Indices of the invariants and of the unknown entries of the state by level; None if they are no linear problem.

    A linear problem has as many names in `held` as free initial values, and invariants that are affine in the unknown
    entries, as many as these. Levels without invariants are left out.
    """
    names = model.state_names
    if not set(held) <= set(names) or len(set(held)) != model.free or model.reduction.cascade is not None:
        return None
    f, m = model.function("invariants").expression, len(invariant_names(model))
    arguments = f.sx_in()
    x, values = arguments[1], f.call(arguments)[0][:m]
    entries = x.elements()
    of = [0 if i < model.nq else 1 + (i - model.nq) // model.n for i in range(len(names))]
    rows = [[i for i, e in enumerate(entries) if ca.depends_on(value, e)] for value in values.elements()]
    levels = []
    for level in range(max(of) + 1):
        some = [a for a, places in enumerate(rows) if max((of[i] for i in places), default=0) == level]
        unknown = [i for i, name in enumerate(names) if of[i] == level and name not in held]
        block = x[unknown]
        if len(some) != len(unknown) or some and ca.depends_on(ca.jacobian(values[some], block), block):
            return None
        levels += [(some, unknown)] if some else []
    return levels


def same_start(model, held, parameters):
    """Whether starts with one set of held values are the same for all values of some parameters, by their names."""
    f, m = model.function("invariants").expression, len(invariant_names(model))
    arguments = f.sx_in()
    p = arguments[2][-len(model.parameters) :] if len(model.parameters) else ca.SX(0, 1)
    places = [i for i, name in enumerate(model.numbers) if name in parameters]
    values = f.call(arguments)[0][:m]
    return set(held) <= set(model.state_names) and not (places and ca.depends_on(values, p[places]))


def linear_starts(model, t, held, p):
    """States (N, n_x) at time t [s] with held values, and whether each is the only one with these values, (N,).

    `held` is a dict of str to (N,) array, the parameters p are (N, n_p) as functions have them. A state that is not
    the only one means nothing.
    """
    states, solved = np.zeros((len(p), len(model.state_names))), np.zeros(len(p), bool)
    levels = model.once(f"linear levels {sorted(held)}", lambda: linear_levels(model, tuple(held)))
    if levels is None:
        return states, solved
    for name, values in held.items():
        states[:, model.state_names.index(name)] = values
    f, m = model.function("invariants"), len(invariant_names(model))
    solved[:] = True
    with np.errstate(all="ignore"):
        for rows, unknown in (level for level in levels for _ in range(PASSES)):
            y = f.grid(t, states.T, p.T)
            jacobian = y[m:].reshape(states.shape[1], m, -1)[np.ix_(unknown, rows)].transpose(2, 1, 0)
            sizes = np.linalg.norm(jacobian, axis=2)
            scaled, off = jacobian / sizes[:, :, None], y[rows].T / sizes
            solved &= np.isfinite(scaled).all(axis=(1, 2)) & np.isfinite(off).all(axis=1)
            scaled[~solved] = np.eye(len(rows))
            regular = np.linalg.svd(scaled, compute_uv=False)[:, -1] > WELL_CONDITIONED
            scaled[~regular], solved = np.eye(len(rows)), solved & regular
            states[:, unknown] -= np.linalg.solve(scaled, np.where(solved[:, None], off, 0.0)[:, :, None])[:, :, 0]
    return states, solved
