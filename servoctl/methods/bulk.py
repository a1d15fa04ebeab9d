"""Methods that take many steps at once: pivots are inspected and samples recorded afterwards."""

import numpy as np

from servoctl.methods.monitor import FRACTIONS, DenseStretch, Fine, Repivot
from servoctl.methods.motion import Stepping
from servoctl.methods.watch import End


class BulkSteps(Stepping):
    """An integration that takes many steps at once, by `_steps`; `failure` is the reason if no further one succeeds.

    `_steps` returns an object with the ends t (S + 1,) [s], states x (n_x, S + 1) there, `at(k, times)` and
    `within(theta)` for the states in between, and `failed`: whether no step succeeds after them.
    """

    def _piece(self, a, x, b, times):
        self.pending, self.forward, t = times, b >= a, a
        self._begin(a, x, b)
        self.monitor.begin(self._pivots(a, x))
        self.watch.begin(a)
        while t != b and self.motion.stop is None:
            steps = self._steps(t, x, b)
            outcome = self._inspected(self._stretch(steps))
            last = outcome.steps
            if isinstance(outcome, End):
                self._record(steps, 0, last, outcome)
                self._turn(outcome, b)
                return outcome.t, outcome.x
            # A step in which a pivot vanishes is sampled with the next pivots: its own lose digits near the zero.
            before = max(last - 1, 0) if isinstance(outcome, Repivot) else last
            self._record(steps, 0, before)
            t, x = steps.t[last], steps.x[:, last].copy()
            if last < len(steps.t) - 1:
                self._retake(steps.t[last + 1] - t)
            goes_on = isinstance(outcome, Fine) or self._follow(outcome)
            if before < last:
                self._record(steps, before, last)
            self.progress(t)
            if isinstance(outcome, Fine) and steps.failed:
                self._fail(t, x, self.failure)
                goes_on = False
            if not goes_on:
                self._keep_last(t, x)
        return t, x

    def _retake(self, h):
        """Go on from before a step of length h [s], which is repeated."""

    def _stretch(self, steps):
        """The steps for the monitor: they have passed their error test, and the next begin where they end."""
        inside = np.array([*FRACTIONS, 1.0])
        times = (steps.t[:-1, None] + np.outer(np.diff(steps.t), inside)).ravel()
        pivots = self.f.grid(times, steps.within(inside).reshape(self.n_x, -1), self.p)[self.n_x :]
        if len(pivots):
            self.motion.count(watched=times.size)
        return DenseStretch(
            steps.t,
            steps.x,
            pivots.reshape(len(pivots), len(steps.t) - 1, len(inside)),
            self._top,
            crosses=True,
            dense=lambda k, t: steps.at(k, np.array([t]))[:, 0],
            pivots_at=self._pivots,
        )

    def _record(self, steps, first, last, end=None):
        """Record the pending samples from the start of step `first` to the start of step `last`, or an end within."""
        direction = 1.0 if self.forward else -1.0
        due = direction * self.pending <= direction * (steps.t[last] if end is None else end.t)
        times, self.pending = self.pending[due], self.pending[~due]
        if not len(times):
            return
        step = first + np.searchsorted(direction * steps.t[first : last + 1], direction * times, "right") - 1
        states = steps.x[:, np.clip(step, 0, last)]
        for k in np.unique(step[step < last + (end is not None)]):
            states[:, step == k] = steps.at(k, times[step == k])
        states = self._settled(times, states)
        top = self.f.grid(times, states, self.p)[self.n_x - self.model.n : self.n_x]
        self.motion.add(self.model, times, states, top)

    def _settled(self, times, states):
        """States of samples, projected if the method projects."""
        return states
