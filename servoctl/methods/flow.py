"""How deviations from a motion move, by the series of the Taylor method at states beside it.

A series is exact for every state, not for one motion alone: the propagator over a step is the derivative of its series
by the state at its start, here by central differences, without a Jacobian. With orthonormal deviations Q_k at the end
of step k, those that the step takes from Q_(k-1) are Q_k R_k, so that propagators between ends of steps are products
of the triangular R (Dieci, Russell and Van Vleck 1997). Deviations within the tangent space of the constraints stay
there.
"""

import ctypes

import casadi as ca
import numpy as np

from servoctl.codegen.matrices import of_any_size
from servoctl.codegen.native import pointer
from servoctl.methods.taylor import series_loop
from servoctl.model.equations import invariant_names

RTOL = 1e-7  # of the steps along which deviations are moved, and of the least size of a level of the state
NEARBY = 1e-6  # of the size of a state: distance of the states from which deviations are taken
LEFT_OUT = 1e-3  # of a propagator over a step: its last terms, which bound those that are left out
MOST_ALONG = 2_000  # of a motion: more of them take longer than propagators by the linearisation


def active_states(model):
    """Which states (n_x,) the rates or the invariants depend on: errors in the others stay as they are."""

    def build():
        parts = (model.function(name).expression.jac_sparsity(0, 1) for name in ("ode", "invariants"))
        rates, invariants = (np.array(ca.DM.ones(part)) for part in parts)
        return np.concatenate([rates[: len(model.state_names)], invariants]).any(axis=0)

    return model.once("active states", build)


class Deviations:
    """Deviations Q from a motion in the sizes of its states, which move on in C; see deviations.h.

    The model has no switches, and its series are compiled up to index `last`. Steps end at `cuts` [s]: the first and
    the last instant of the motion, and those between which paths are smooth. x (n_x,) is the state at the first cut,
    later that after the last step, and Q (f, n_x) are orthonormal deviations there. Z (f, n_x, S) are, at `instants`
    (N,) from the first cut on [s], what the deviations at the first of them become; S ≥ N is a whole number of vectors.
    """

    def __init__(self, model, last, cuts, x, size, instants=()):
        f, active = series_loop(model, last), active_states(model)
        self.x, self._native = np.array(x), f.native
        free = len(x) - len(invariant_names(model))
        self.Q, self.Z = np.empty((free, len(x))), np.empty((free, len(x), padded(len(instants))))
        settings, self._defect = np.array([RTOL, RTOL * size.min(), NEARBY, LEFT_OUT]), np.empty(1)
        series = np.empty((free, 1 + f.n_x + f.n_y))
        given = cuts, instants, np.append(model.p, np.nan), settings, size, active
        self._arrays = [np.ascontiguousarray(array, dtype=float) for array in given]
        counts = len(cuts), len(instants), len(x) - np.count_nonzero(active), free, MOST_ALONG
        places = [array.ctypes.data for array in (*self._arrays, self.x, self.Q, self.Z, series)]
        self._arrays.append(series)
        self._task = np.array([*counts, *places, 0, self._defect.ctypes.data])

    def begin(self):
        """Set Q to tangents of the constraints at the first cut, first the unit vectors of states that are not active.

        False where nothing is compiled, or gradients are dependent or not finite.
        """
        return self._call("tangents") == 1

    def move(self):
        """Move to the last cut; False where the series do not reach it, or are too short for the deviations."""
        return self._call("deviations") >= 0

    def by_step(self):
        """Move to the last cut; the ends of K steps [s], the deviations there and the propagators over the steps.

        That is t (K + 1,) from the first cut on, Q (K + 1, n_x, f) and R (K, f, f); None where `move` is False.
        """
        (f, n_x), start = self.Q.shape, self.Q.T.copy()
        log = np.empty((MOST_ALONG, 1 + f * (n_x + f)))
        self._task[-2] = log.ctypes.data
        steps = self._call("deviations")
        self._task[-2] = 0  # the log lives no longer than this call
        if steps < 0:
            return None
        t, Q, R = np.split(log[:steps], [1, 1 + f * n_x], axis=1)
        Q = np.concatenate([start[None], Q.reshape(steps, f, n_x).swapaxes(1, 2)])
        return np.append(self._arrays[0][0], t), Q, R.reshape(steps, f, f)

    def defect(self):
        """How far deviations are from the tangent space at the last cut, in Frobenius' norm; infinite as `begin`."""
        self._call("defect")
        return float(self._defect[0])

    def _call(self, name):
        call = self._native(name)
        if call is None:
            return -1
        call.restype = ctypes.c_int64
        return call(pointer(self._task))


def growth(Z, count, settings):
    """Whether deviations tell that the internal dynamics of a motion are not unstable; see growth.c.

    Z (f, n_x, S) is that of `Deviations`, at `count` instants; `settings` are those of growth.c. Returns the answer,
    False where nothing is compiled; the scale (n_x,) of the states; and ln of the largest growth (count,) between
    instants that are at most 0, 1, ... blocks apart.
    """
    f, n_x, S = Z.shape
    of_vectors = n_x**2 + f * n_x * (f + 1) // 2 + (f + 1) * (n_x + 1)
    others = 8 + n_x * (n_x + 3) + (2 * f + 1) * padded(f)
    work = np.empty(2 * S * (f * (n_x + f) + count) + 8 * of_vectors + others)
    settings, scale, within = np.array(settings), np.full(n_x, np.nan), np.full(count, np.nan)
    sizes, call = map(ctypes.c_int64, (count, n_x, f)), of_any_size("growth", "growth")
    found = call is not None and call(*sizes, *map(pointer, (Z, settings, work, scale, within)))
    return bool(found), scale, within


def padded(count):
    """`PADDED` of orthonormal.h."""
    return 8 * -(-count // 8)
