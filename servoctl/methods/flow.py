"""How deviations from a motion move, by the series of the Taylor method at states beside it.

A series is exact for every state, not for one motion alone: the propagator over a step is the derivative of its series
by the state at its start, here by central differences, without a Jacobian. With orthonormal deviations Q_k at the end
of step k, those that the step takes from Q_(k-1) are Q_k R_k, so that propagators between ends of steps are products
of the triangular R (Dieci, Russell and Van Vleck 1997). Deviations within the tangent space of the constraints stay
there.
"""

import ctypes
from itertools import pairwise

import numpy as np

from servoctl.codegen.matrices import of_any_size
from servoctl.codegen.native import pointer
from servoctl.methods.motion import breakpoints
from servoctl.methods.taylor import series_loop
from servoctl.values import frozen

RTOL = 1e-7  # of the steps along which deviations are moved, and of the least size of a level of the state
NEARBY = 1e-6  # of the size of a state: distance of the states from which deviations are taken
LEFT_OUT = 1e-3  # of a propagator over a step: its last terms, which bound those that are left out
MOST_ALONG = 2_000  # of a motion: more of them take longer than propagators by the linearisation


@frozen
class Deviations:
    """How deviations move along a motion, in the sizes of its states.

    Attributes
    ----------
    cuts : (N,) array
        Instants at which steps end, among others [s].
    start : (f, n_x) array
        Orthonormal deviations at the first one.
    log : (K, 1 + f (n_x + f)) array
        The end of each step [s], the deviations Qᵀ there and R.
    x : (n_x,) array
        State at the last one.
    """

    cuts: np.ndarray
    start: np.ndarray
    log: np.ndarray
    x: np.ndarray

    @property
    def t(self):
        """The first instant and the ends of the steps (K + 1,) [s]."""
        return np.append(self.cuts[0], self.log[:, 0])

    @property
    def Q(self):
        """The deviations at these instants, (K + 1, n_x, f)."""
        end = 1 + self.start.size
        return np.concatenate([self.start[None], self.log[:, 1:end].reshape(-1, *self.start.shape)]).swapaxes(1, 2)

    @property
    def R(self):
        """The propagators of the steps between them, (K, f, f)."""
        return self.log[:, 1 + self.start.size :].reshape(-1, len(self.start), len(self.start))

    def growth(self, *settings):
        """ln of the growth between all cuts and the scale of the states, as `growth._growth`; see growth.c.

        Parameters
        ----------
        *settings : float
            Those of growth.c.

        Returns
        -------
        logs : (N, N) array
        scale : (n_x,) array
            Both are None where propagators are not moderate.
        """
        n, (free, n_x) = len(self.cuts), self.start.shape
        rows, row = 8 * -(-n_x // 8), 8 * -(-free // 8)  # padded to whole vectors
        sizes = free * (3 * n * free + 4 * row + n * n_x), rows * (free * (free + 2) + n_x + 2), n * (free + 2 * n + 2)
        settings, work = np.array(settings), np.empty(sum(sizes))
        logs, scale = np.full((n, n), -np.inf), np.empty(n_x)
        steps, n_x, n, free = map(ctypes.c_int64, (len(self.log), n_x, n, free))
        given = steps, n_x, pointer(self.log), n, pointer(self.cuts), pointer(self.start), free
        found = of_any_size("growth", "growth")(*given, *map(pointer, (settings, work, scale, logs)))
        return (logs, scale) if found else (None, None)


def tangents(model, last, t, x, size):
    """Orthonormal deviations in the tangent space of the invariants, in the sizes of the states.

    Parameters
    ----------
    model : Model
    last : int
        As for `deviations`.
    t : float
        [s]
    x : (n_x,) array
    size : (n_x,) array

    Returns
    -------
    (n_x, f) array or None
        First the unit vectors of states that are not active (`Model.active_states`). None where nothing is compiled,
        or gradients are dependent or not finite.
    """
    call, f = series_loop(model, last).native("tangents"), len(x) - len(model.invariant_names())
    if call is None:
        return None
    call.restype, Q = ctypes.c_int64, np.empty((f, len(x)))
    return Q.T if call(*_place(model, t, x, size), ctypes.c_int64(f), pointer(Q)) else None


def defect(model, last, t, x, size, Q):
    """How far deviations Q (n_x, f) are from the tangent space at t and x, as `tangents`, in Frobenius' norm."""
    call, Q, result = series_loop(model, last).native("defect"), np.ascontiguousarray(Q.T), np.empty(1)
    call.restype = None
    call(*_place(model, t, x, size), ctypes.c_int64(len(Q)), pointer(Q), pointer(result))
    return float(result[0])


def _place(model, t, x, size):
    """Pointers to t, x, p, the sizes and the active states; the arrays live as long as they."""
    arrays = [np.array([t]), x, np.append(model.parameters, t), size, model.active_states]
    return [_pointer_to(np.ascontiguousarray(array, dtype=float)) for array in arrays]


def _pointer_to(array):
    """`pointer`, which holds its array."""
    place = pointer(array)
    place.array = array
    return place


def deviations(model, last, t, x, knots, size, Q, fixed=0):
    """How deviations move along a motion.

    Parameters
    ----------
    model : Model
        Without switches.
    last : int
        Highest index of the coefficients, for which they are compiled.
    t : (N,) array
        Instants at which steps end, the first and the last one that of the motion [s].
    x : (n_x,) array
        State at the first one.
    knots : sequence of float
        Instants at which paths take other branches [s].
    size : (n_x,) array
        Sizes of the states.
    Q : (n_x, f) array
        Orthonormal deviations at the first instant.
    fixed : int
        The first of them that stay, as nothing depends on the states in them.

    Returns
    -------
    Deviations or None
        None where nothing is compiled, or the series do not reach the end or are too short for the deviations.
    """
    f, forward, (n_x, free) = series_loop(model, last), np.sign(t[-1] - t[0]), Q.shape
    run, x, start = f.native("deviations"), np.array(x), np.array(Q.T, order="C")
    if run is None:
        return None
    run.restype, moved = ctypes.c_int64, start.copy()
    settings, size = np.array([RTOL, RTOL * size.min(), NEARBY, LEFT_OUT]), np.ascontiguousarray(size)
    log, taken = np.empty((MOST_ALONG, 1 + free * (n_x + free))), 0
    for a, b in pairwise(breakpoints((t[0], t[-1]), knots)):
        p = np.append(model.parameters, (a + b) / 2)
        inside = np.concatenate([[a], t[(forward * t > forward * a) & (forward * t < forward * b)], [b]])
        count, *counts, most = map(ctypes.c_int64, (len(inside), fixed, free, MOST_ALONG - taken))
        given = (count, *map(pointer, (inside, x, p, settings)), *counts, *map(pointer, (size, moved)))
        steps = run(*given, most, pointer(log[taken:]))
        if steps < 0:
            return None
        taken += steps
    return Deviations(np.ascontiguousarray(t), start, log[:taken], x)
