"""Whether reduced equations satisfy the full ones, as their designer wrote them, along a motion.

A slope that vanishes where a row is derived lowers the row's order, and what it is a slope of is left out. If it does
not vanish identically, that may come alive: a gear that is blended in at 3 s, a coupling beyond x = 2. From there on a
motion by the reduced equations leaves the full ones.
"""

import numpy as np

from servoctl.errors import SingularProgram
from servoctl.model.validity import on_manifold
from servoctl.tolerances import ENTRY

DRIFTED = 1e-6  # of its terms: below this a residual may be due to drift; above, it is judged on the manifold


def departure(model, t, jets):
    """The first sample of a motion, t (N,) [s] with jets (n_z, N), that does not satisfy the full equations.

    Its index, and the name of an equation that it does not satisfy; (None, "") if there is none.
    """
    f, n_x, p = model.function("full"), len(model.state_names), model.p

    def restored(t, z):
        x = on_manifold(model, t, z[:n_x], p)
        return np.vstack([x, model.function("ode").grid(t, x, p)[n_x - model.n : n_x]])

    return first_departure([*model.reduction.full], lambda t, z: f.grid(t, z, p), t, jets[: f.n_x], restored)


def first_departure(names, full, t, z, restored):
    """The same for points z (n_z, N), from functions of times and points.

    `full` gives what `equations.sized` has of each equation; `restored` are the points on the constraint manifold.
    """
    known = np.flatnonzero(np.isfinite(z).all(axis=0))
    t, z = t[known], z[:, known]
    left, terms, usual = np.split(np.abs(full(t, z)), 3)
    allowed = np.fmax(DRIFTED * np.fmax.accumulate(terms, axis=1), ENTRY * usual)
    suspects = np.flatnonzero((left > allowed).any(axis=0))
    if len(suspects):
        z = restored(t[suspects], z[:, suspects])
        off = np.abs(full(t[suspects], z))[: len(names)] > allowed[:, suspects]
        confirmed = np.flatnonzero(off.any(axis=0))
        if len(confirmed):
            return int(known[suspects[confirmed[0]]]), names[int(np.argmax(off[:, confirmed[0]]))]
    return None, ""


def other_order(row, t, free=None, expected=None):
    """The error of a row whose order changes at t [s], with the numbers of free initial values beyond and before."""
    changes = free not in (None, expected)
    there = f", and from there on {free} initial values are free instead of {expected}" if changes else ""
    return SingularProgram(
        f"The order of row {row!r} changes at t = {t:.6g} s: terms are active that vanish where it was derived{there}.",
        "The rows of a motion keep their orders along it.",
        do="Derive two models, one for each regime, with guess={...} in each, and join their motions.",
        t=t,
        row=row,
        free=free,
        expected=expected,
    )
