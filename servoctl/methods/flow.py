"""How deviations from a motion move, by the series of the Taylor method at states beside it.

A series is exact for every state, not for one motion alone: the propagator over a step is the derivative of its series
by the state at its start, here by central differences of all columns at once. No Jacobian is formed.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import perm

import numpy as np

from servoctl.methods.motion import breakpoints
from servoctl.methods.taylor import series_loop

RTOL = 1e-6  # of the steps along which deviations are moved, and of the least size of a level of the state
NEARBY = 1e-6  # of the size of a state: distance of the states from which deviations are taken
LEFT_OUT = 1e-3  # of a propagator over a step: its last terms, which bound those that are left out
MOST_ALONG = 2_000  # of a motion: more of them take longer than propagators by the linearisation


@dataclass(frozen=True)
class Propagation:
    """Instants t (K + 1,) of a motion, states (n_x, K + 1) there, and the series that lead from each to the next.

    `parameters` (n_p, K) are those of the series, with the instants that select the branches of paths.
    """

    f: object
    t: np.ndarray
    x: np.ndarray
    parameters: np.ndarray

    def moved(self, columns, size):
        """Where small deviations at the starts of the steps are at their ends.

        Parameters
        ----------
        columns : (K, n_x, f) array
            In the sizes of the states.
        size : (n_x,) array

        Returns
        -------
        (K, n_x, f) array or None
            None where the series are too short.
        """
        (K, n_x, count), sizes = columns.shape, self.f.sizes
        beside = NEARBY * (columns * size[:, None]).transpose(1, 0, 2)
        x = (self.x[:, :-1, None, None] + np.stack([beside, -beside], axis=2)).reshape(n_x, -1)
        t, h, p = (np.repeat(part, 2 * count, axis=-1) for part in (self.t[:-1], np.diff(self.t), self.parameters))
        y = self.f.grid(t, x, p)
        log = np.concatenate([t[None], x, y]).T
        ends = self.f.jets(log, np.arange(len(t)), t + h, self.parameters[:, 0], sizes["top"] - 1)

        def difference(values):
            both = values.reshape(len(values), K, 2, count)
            return ((both[:, :, 0] - both[:, :, 1]) / (2 * NEARBY)).transpose(1, 0, 2)

        result = difference(ends) / size[:, None]
        largest = LEFT_OUT * np.abs(result).max(axis=(1, 2))
        for k in (sizes["last"], sizes["last"] - 1):  # one of them vanishes where a motion is even or odd
            if np.any(np.abs(difference(self._term(k, y, h)) / size[:, None]).max(axis=(1, 2)) > largest):
                return None
        return result

    def _term(self, k, y, h):
        """The terms of index k of the states (n_x, M), from coefficients (n_y, M) and times h (M,)."""
        nq, n, top, last, plain = (self.f.sizes[name] for name in ("nq", "n", "top", "last", "plain"))
        rates = y[(0 if plain else nq * last) :][n * (k - 1) : n * k]
        of_q = rates if plain else y[nq * (k - 1) : nq * k]
        return np.concatenate([of_q * h**k, *(perm(k, j) * rates * h ** (k - j) for j in range(1, top))])


def flow(model, last, t, x, knots, size):
    """The series along a motion at given instants and wherever they end between them.

    Parameters
    ----------
    model : Model
        Without switches.
    last : int
        Highest index of the coefficients, for which they are compiled.
    t : (N,) array
        Instants, the first and the last one that of the motion [s].
    x : (n_x,) array
        State at the first one.
    knots : sequence of float
        Instants at which paths take other branches [s].
    size : (n_x,) array
        Sizes of the states.

    Returns
    -------
    Propagation or None
        None where the series do not reach the end.
    """
    f, n_x, parts = series_loop(model, last), len(x), []
    forward = np.sign(t[-1] - t[0])
    for a, b in pairwise(breakpoints((t[0], t[-1]), knots)):
        p = np.append(model.parameters, (a + b) / 2)
        log = f.taylor(a, x, b, p, RTOL, RTOL * size.min(), MOST_ALONG)
        if log[-1, 0] != b:
            return None
        ends, x = log[:, 0], log[-1, 1 : 1 + n_x]
        at = np.unique(forward * np.append(ends[:-1], t[(forward * t > forward * a) & (forward * t < forward * b)]))
        at *= forward
        k = np.searchsorted(forward * ends, forward * at, "right") - 1
        parts.append((at, f.jets(log, k, at, p, f.sizes["top"] - 1), np.tile(p[:, None], len(at))))
        if sum(len(part[0]) for part in parts) > MOST_ALONG:
            return None
    instants, states, parameters = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
    return Propagation(f, np.append(instants, t[-1]), np.column_stack([states, x]), parameters)
