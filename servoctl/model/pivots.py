"""The pivots of a model: what its functions divide by, and the sizes of its columns."""

import numpy as np

from servoctl.model.following import instants_of


def pivots_at(model, t, jets, count=None):
    """Pivots (n_g,), or the first of them, at an instant t [s] with jets (n_z,)."""
    here = model.reduction.points.at(instants_of(model, [t]), jets[:, None], model.parameters)
    return here.only_values([pivot for _, pivot in model.equations.pivots[:count]])[:, 0].astype(float)


def pivot_sizes(model):
    """Largest size of each pivot at the points where the pivots were chosen, (n_g,) array."""
    return model.once("pivot sizes", lambda: model.equations.pivot_sizes)


def pivot_strength(model, t, jets):
    """The smallest chosen pivot at an instant, relative to its size where pivots were chosen; 0 if one has no value."""
    count = len(row_pivots(model)) if model.reduction.orthogonal else None
    if count == 0:
        return 1.0
    pivots, sizes = np.abs(pivots_at(model, t, jets, count)), pivot_sizes(model)[:count]
    relative = pivots / np.where(sizes > 0, sizes, 1.0)
    return float(np.nan_to_num(relative, nan=0.0, posinf=0.0).min(initial=1.0))


def row_pivots(model):
    """Names of the pivots by which the rows divide, and which depend on the motion; those of L come after them."""
    rows = {name for name, _ in model.reduction.pivots}
    return model.once("row pivots", lambda: [name for name, _ in model.equations.pivots if name in rows])


def usual_column_sizes(model):
    """Column sizes (n,) (see `ranks.column_sizes`) of L and of Bᵀ at the points where ranks were decided."""
    return model.once("column sizes", lambda: model.equations.column_sizes)
