"""Eliminations leave out entries that vanish identically: along each motion it is checked that they do."""

import numpy as np

from servoctl.errors import IntegrationStopped
from servoctl.reduction.ranks import SUSPECT, alive

DERIVATIONS = 4  # of the equations of one motion, each near a state at which an entry came alive


def first_alive(f, entries, t, x, p):
    """The first sample at which entries that were left out are not zero, and the one at which they are clearest.

    f gives the values of the entries and the sizes of their terms at t (N,) [s] and what it takes there, x (n, N); f is
    None if nothing was left out. `entries` gives the entries (list of SX) and the points (Points) of some samples from
    their indices. Returns two such indices, or None if all are zero.
    """
    if f is None or not len(t):
        return None
    values = np.abs(f.grid(t, x, p))
    half = len(values) // 2
    suspects = np.flatnonzero(np.any(values[:half] > SUSPECT * values[half:], axis=0))
    if not len(suspects):
        return None
    shares = alive(*entries(suspects))  # in extended precision
    first = np.flatnonzero(shares)
    return (int(suspects[first[0]]), int(suspects[np.argmax(shares)])) if len(first) else None


def alive_along(motion):
    """The first instant of a motion [s] at which an entry that was left out is not zero, and a place to derive again.

    The place is the instant [s] at which such an entry is clearest, with its jets (n_z,). None if all are zero.
    """
    for model, t, jets in motion.by_piece():
        f = model.dropped
        if f is None:
            continue
        full = jets if len(jets) == f.n_x else jets[: f.n_x] if len(jets) > f.n_x else model.extended(t, jets, f.n_x)

        def entries(some, model=model, t=t, full=full):
            return model.equations.entries_dropped, model.reduction.points.at(t[some], full[:, some], model.parameters)

        found = first_alive(f, entries, t, full, model.parameters)
        if found is not None:
            first, clearest = found
            return float(t[first]), (float(t[clearest]), jets[: len(model.jet_names), clearest])
    return None


def came_alive(t):
    """The error of a motion along which entries come alive whatever the state is near which equations are derived."""
    return IntegrationStopped(
        f"At t = {t:.7g} s an entry of the equations is not zero that was left out where they were derived.",
        "Entries are left out where they vanish identically; the equations hold up to this instant only.",
        do="Derive the model with guess={...} near this instant, and join the motions.",
        t=t,
    )
