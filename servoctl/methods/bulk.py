"""Methods that take many steps at once: pivots are inspected and samples recorded afterwards."""

import numpy as np

from servoctl.methods.monitor import FRACTIONS, DenseStretch, Fine
from servoctl.methods.motion import Stepping


class BulkSteps(Stepping):
    """An integration that takes many steps at once; `_steps` takes them.

    They come as a value with the ends t (S + 1,) [s], states x (n_x, S + 1) there, `at(k, times)` and `within(theta)`
    for the states in between, and `failed`, whether no step succeeds after them.
    """

    def _piece(self, a, x, b, times):
        self.pending, self.forward, t = times, b >= a, a
        self._begin(a, x, b)
        self.monitor.begin(self._pivots(a, x))
        while t != b and self.motion.stop is None:
            steps = self._steps(t, x, b)
            outcome = self.monitor.inspect(self._stretch(steps))
            self._record(steps, outcome.steps)
            t, x = steps.t[outcome.steps], steps.x[:, outcome.steps].copy()
            self.progress(t)
            if not isinstance(outcome, Fine):
                if not self._follow(outcome):
                    self._keep_last(t, x)
            elif steps.failed:
                self._fail(t, x)
                self._keep_last(t, x)
        return x

    def _stretch(self, steps):
        """The steps; they have passed their test of error, and others begin where they end."""
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

    def _record(self, steps, stand):
        """Record the pending samples within the first `stand` steps."""
        direction = 1.0 if self.forward else -1.0
        due = direction * self.pending <= direction * steps.t[stand]
        times, self.pending = self.pending[due], self.pending[~due]
        if not len(times):
            return
        owner = np.searchsorted(direction * steps.t[: stand + 1], direction * times, "right") - 1
        states = steps.x[:, np.clip(owner, 0, stand)]
        for k in np.unique(owner[owner < stand]):
            states[:, owner == k] = steps.at(k, times[owner == k])
        states = self._settled(times, states)
        top = self.f.grid(times, states, self.p)[self.n_x - self.model.n : self.n_x]
        self.motion.add(self.model, times, states, top)

    def _settled(self, times, states):
        """States of samples as they are recorded."""
        return states
