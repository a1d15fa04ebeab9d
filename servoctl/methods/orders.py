"""A motion ends where a row takes another order than the one that it was derived with."""

import numpy as np

from servoctl.errors import ServoError, SingularProgram
from servoctl.reduction.orders import first_alive


def end_at_other_orders(motion):
    """Cut a motion before the first sample at which a row has another order, and set the error as its stop.

    Parameters
    ----------
    motion : Motion
        Its samples are cut in place.
    """
    for i, (model, t, x, top) in enumerate(motion.pieces):
        jets = np.vstack([x, top])
        known = np.flatnonzero(np.isfinite(jets).all(axis=0))
        k, name = first_alive(model.reduction, t[known], jets[:, known], model.parameters)
        if k is not None:
            k = known[k]
            motion.stop = _other_order(model, name, float(t[k]), jets[:, k])
            motion.pieces[i:] = [(model, t[:k], x[:, :k], top[:, :k])] if k else []
            return


def _other_order(model, name, t, jets):
    """The error of a row whose order changes, with the number of free initial values on either side."""
    try:
        free = model.near(t, jets[: len(model.jet_names)]).free
    except ServoError as error:
        free = error.details.get("free")
    other = f", and the program has {free} free initial values instead of {model.free}" * (free not in (None, model.free))
    return SingularProgram(
        f"The order of row {name!r} changes at t = {t:.6g} s: terms come alive that vanish where it was derived{other}.",
        "The rows of a motion keep their orders along it.",
        do="Derive two models, one for each regime, with guess={...} in each, and join their motions.",
        t=t,
        row=name,
        free=free,
        expected=model.free,
    )
