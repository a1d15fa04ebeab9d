"""Whether fixed steps resolve a motion: single steps compared with two of half their length."""

import numpy as np

from servoctl.methods.accuracy import component_sizes, state_levels

UNRESOLVED = 0.1  # of the state's size: what a step and two half steps differ by where they are too long


def unresolved(pieces, halved):
    """The last step of a motion, or else that of the fastest change, if two of half its length lead elsewhere.

    Parameters
    ----------
    pieces : list of (model, t, states, ...)
        Steps from t[k] to t[k + 1] [s] with states (n_x, N) by one variant of the model.
    halved : callable
        (model, t, x, h) -> states (n_x, 3) at t, t + h and t + 2 h; fewer where a step fails.

    Returns
    -------
    ((start, end), x, difference, size) or None
        Of the step [s]; the state (n_x,) at its start; by how much both ends differ, relative to the sizes (n_x,) of
        the state's entries: (n_x,) array.
    """
    pieces = [(model, t, states) for model, t, states, *_ in pieces if len(t) > 1]
    if not pieces:
        return None
    largest = np.column_stack([np.abs(states).max(axis=1) for _, _, states in pieces])
    size = component_sizes(largest, state_levels(pieces[0][0]))
    changes = [(np.abs(np.diff(states)) / size[:, None]).max(axis=0) for _, _, states in pieces]
    fastest = int(np.argmax([change.max() for change in changes]))
    last = (len(pieces) - 1, len(changes[-1]) - 1)
    for i, k in dict.fromkeys((last, (fastest, int(np.argmax(changes[fastest]))))):
        model, t, states = pieces[i]
        halves = halved(model, t[k], states[:, k], (t[k + 1] - t[k]) / 2)
        lost = halves.shape[1] < 3
        difference = np.full(len(size), np.inf) if lost else (states[:, k + 1] - halves[:, -1]) / size
        if not np.abs(difference).max() <= UNRESOLVED:
            return t[k : k + 2], states[:, k], difference, size
    return None
