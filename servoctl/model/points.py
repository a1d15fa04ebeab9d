"""Paths through the points at which ranks were decided, where references have values of each point's own."""

import numpy as np

from servoctl.codegen.paths import Followed, jets_in
from servoctl.jets.tape import JETS
from servoctl.spec.paths.value import Path

PART = 1 / 3  # of the time between two points, on either side of each: their pieces do not meet


def place_of(model, functions):
    """The place () or (1,) in memory of paths that have, at the instant of each point, the references of the point.

    They have as many derivatives as the compiled functions take; None where two points have one instant. For as long as
    functions of the model are used, the paths are kept.
    """
    if not model.paths:
        return ()
    kept = model._functions
    if "paths through points" not in kept:  # not `once`: places in memory are never stored
        kept["paths through points"] = through(model.reduction, [f.expression for f in functions])
    followed = kept["paths through points"]
    return followed and (followed.address,)


def through(reduction, functions):
    """The same paths, for SX functions, as `Followed`."""
    points, family = reduction.points, reduction.mechanism.q.family
    t, count = points.t.astype(float), max((f.size2_in(3) for f in functions if jets_in(f)), default=1)
    order = np.argsort(t)
    t, jets = t[order], points.instants[order, 1:].astype(float).reshape(len(t), -1, JETS + 1)
    gaps = np.concatenate([[np.inf], np.diff(t), [np.inf]])
    widths = PART * np.minimum(np.minimum(gaps[1:], gaps[:-1]), 1.0)
    breaks = np.column_stack([t - widths, t + widths]).ravel()
    if not (np.diff(breaks) > 0).all():
        return None
    paths = []
    for name in reduction.references:
        coefficients = np.zeros((len(breaks) - 1, 1, count))
        terms = jets[:, family.names.index(name), :count]
        coefficients[::2, 0, : terms.shape[1]] = terms * widths[:, None] ** np.arange(terms.shape[1])
        paths.append(Path(breaks, coefficients, np.full(len(breaks), -1.0), "hold", "hold"))
    return Followed(paths)


def with_place(place, p):
    """Parameters (n_p,) or (n_p, N) after a place () or (1,) of paths in memory."""
    p = np.asarray(p, dtype=float)
    return np.concatenate([np.full((len(place), *p.shape[1:]), *place), p]) if place else p
