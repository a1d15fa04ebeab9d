"""Whether what the orders of rows rest on still vanishes, at other parameters or along a motion.

A slope that vanishes where a row is derived lowers the row's order. If it does not vanish identically, it may come
active: a gear that is blended in at 3 s, a coupling beyond x = 2, a parameter that was zero. It then counts against the
terms of the row, times the size of the jet in which it is the slope, both the largest of the motion so far.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from servoctl.errors import SingularProgram
from servoctl.jets.series import Flow
from servoctl.reduction.manifold import ON_MANIFOLD, Points, solve
from servoctl.tolerances import ENTRY
from servoctl.values import frozen

DRIFTED = 1e-6  # of its terms: below this a slope may be due to drift; above, it is judged on the manifold


@frozen(eq=False)
class Orders:
    """The slopes on whose vanishing the orders of rows rest; false if there are none."""

    decided: tuple  # rows whose orders were decided
    rows: tuple  # of the manifold
    top: int  # highest order of jets on the manifold
    points: Points  # of the manifold, where the slopes vanish

    def __bool__(self):
        return any(row.vanishing for row in self.decided)

    @cached_property
    def _vanishing(self):
        """The row's name of each slope; slopes, jets, and expressions that they are slopes of."""
        each = {}
        for row in self.decided:
            for slope, jet, expression in row.vanishing:
                each[slope.element_hash(), jet.element_hash()] = row.name, slope, jet, expression
        names, *zeros = zip(*each.values(), strict=True)
        return names, zeros

    @property
    def vanishing(self):
        """Slopes, jets, and the expressions that they are slopes of: three sequences of SX."""
        return self._vanishing[1] if self else ((), (), ())

    @cached_property
    def _level(self):
        order = self.points.q.order
        return max(self.top, *(order(e) for part in self._vanishing[1] for e in part))

    def hold(self, points):
        """Whether the orders are the same at points of the manifold with other parameters."""
        if not self:
            return True
        jets, terms = self._usual(points)
        return not self._active(points, np.maximum(jets, 1.0), terms, ENTRY, ENTRY).any()

    def first_change(self, t, jets, values):
        """The first sample of a motion at which the order of a row is another one: its index, and the row's name.

        The motion is t (N,) [s] with jets (n_z, N), q, γ', and perhaps higher ones, and parameters `values` (n_p,). If
        there is no such sample, (None, "").
        """
        known = np.flatnonzero(np.isfinite(jets).all(axis=0)) if self else ()
        if not len(known):
            return None, ""
        points = self._sampled(t[known], jets[:, known], values)
        jets, terms = (
            np.maximum.accumulate(np.maximum(there, here), axis=1)
            for there, here in zip(self._usual(self._on_manifold(self.points)), self._sizes(points), strict=True)
        )
        suspects = np.flatnonzero(self._active(points, jets, terms, DRIFTED, DRIFTED).any(axis=0))
        if not len(suspects):
            return None, ""
        there = self._on_manifold(points.take(suspects))
        active = self._active(there, jets[:, suspects], terms[:, suspects], ENTRY, DRIFTED)
        confirmed = np.flatnonzero(active.any(axis=0))
        if not len(confirmed):
            return None, ""
        return int(known[suspects[confirmed[0]]]), self._vanishing[0][int(np.argmax(active[:, confirmed[0]]))]

    def _sampled(self, t, jets, values):
        """Points at samples of a motion; jets that it does not have follow from the rows."""
        points = self.points.at(t, jets, values)
        return points if points.level >= self._level else self._on_manifold(points)

    def _sizes(self, points):
        """Sizes of each slope's jet, and of the terms of its row, at points: two arrays (slopes, N)."""
        _, jets, expressions = self._vanishing[1]
        return np.nan_to_num(np.abs(points.evaluate(jets)[0])), np.nan_to_num(points.evaluate(expressions)[1])

    def _usual(self, points):
        """The largest of these sizes over points: two arrays (slopes, 1)."""
        return [size.max(axis=1, keepdims=True, initial=0.0) for size in self._sizes(points)]

    def _active(self, points, jets, terms, rounding, share):
        """Whether slopes (slopes, N) exceed their rounding, and times their jets a share of the terms of their row."""
        values, sizes = np.abs(points.evaluate(self._vanishing[1][0]))
        return (values > rounding * sizes) & (values * jets > share * terms)

    def _on_manifold(self, points):
        """The points of the manifold nearest to points; those without such stay."""
        q = points.q
        z = np.zeros((q.nq + self._level * q.n, len(points.t)), dtype=points.z.dtype)
        shared = min(len(z), len(points.z))
        z[:shared] = points.z[:shared]
        start = replace(points, z=z)
        solved, residual = solve(Flow(q, self.rows, self._level, start), start.instants, z)
        return replace(start, z=np.where(residual < ON_MANIFOLD, solved, z))


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
