"""Methods with dense output: many steps at once, of which pivots, switches, residuals and equations are then inspected.

A test of a step's error knows the equations at its stages alone. Therefore they are compared with the dense output at
instants in between: quarters of each step, and instants at most a thousandth of the span apart. Steps up to the first
one that does not meet them count; the next one ends at that instant, so that its stages see what it stepped over.
"""

import numpy as np

from servoctl.methods.motion import Stepping
from servoctl.methods.pieces import RESOLUTION, End, net
from servoctl.methods.rank import Fine, Stretch, Weak
from servoctl.values import frozen

QUARTERS = 4  # of a step, at whose ends pivots are inspected
OFF = 1e3  # times the tolerance, which the equations may add to a step
REPEATS = 8  # of a step at one instant, after which it is believed
FUTILE = 1e-8  # of the span: a shorter step that misses the equations where the rank is lost ends the motion
SHORTEST = 1e-12  # of the span: shorter steps are not repeated, so that a jump of the equations is passed


@frozen
class Steps:
    """Steps with dense output: states `at(k, times)` (n_x, N) within steps k (N,) at times (N,).

    `slope(k, times)` gives their derivatives, NaN for entries that are not integrated.
    """

    t: np.ndarray  # (S + 1,) starts, and the end of the last one [s]
    x: np.ndarray  # (n_x, S + 1) states there
    failed: bool  # whether no further step succeeds


class BulkSteps(Stepping):
    """An integration that takes many steps at once, by `_steps`; `failure` is the reason if no further one succeeds.

    `_steps` returns an object with the attributes and methods of `Steps`.
    """

    off = OFF

    def _piece(self, a, x, b, times):
        self.pending, self.forward, t = times, b >= a, a
        self._begin(a, x, b)
        self._begin_piece(a, self._pivots(a, x))
        until, repeats = b, 0
        while t != b and self.motion.stop is None:
            steps = self._steps(t, x, until)
            stretch = self._stretch(steps)
            outcome, doubt = self._outcome(stretch, repeats < REPEATS)
            until, repeats = (b, 0) if doubt is None else (doubt, 0 if outcome.steps else repeats + 1)
            last = outcome.steps
            if isinstance(outcome, End):
                self._record(steps, 0, last, outcome)
                self._turn(outcome, b)
                return outcome.t, outcome.x
            # A step in which a pivot vanishes is sampled with the next pivots: its own lose digits near the zero.
            before = max(last - 1, 0) if isinstance(outcome, Weak) else last
            self._record(steps, 0, before)
            t, x = steps.t[last], steps.x[:, last].copy()
            if last < len(steps.t) - 1:
                self._retake(steps.t[last + 1] - t if doubt is None else doubt - t)
            goes_on = isinstance(outcome, Fine) or self._follow(outcome)
            if before < last:
                self._record(steps, before, last)
            self.progress(t)
            futile = doubt is not None and abs(doubt - t) < FUTILE * self.length and self.rank.lost(t, x)
            if isinstance(outcome, Fine) and (futile or steps.failed and last == len(steps.t) - 1):
                self._fail(t, x, self.failure)
                goes_on = False
            if not goes_on:
                self._keep_last(t, x)
        return t, x

    def _outcome(self, stretch, doubts):
        """The outcome of steps, and the instant at which the next one must end as it does not meet the equations there.

        `doubts` says whether the first step may be repeated.
        """
        good, doubt = self._doubted(stretch) if len(stretch.t) > 1 else (0, None)
        if doubt is not None and not good and not doubts:
            good, doubt = 1, None
            stretch = stretch.first(1)
        if doubt is not None and not good:
            return Fine(0), doubt
        outcome = self._inspected(stretch.first(good) if doubt is not None else stretch)
        return outcome, doubt if isinstance(outcome, Fine) else None

    def _retake(self, h):
        """Go on from before a step of length h [s], which is repeated."""

    def _stretch(self, steps):
        """The steps to be inspected: they have passed their error test, and the next begin where they end."""
        k, at, quarters = net(steps.t, self.length / RESOLUTION, QUARTERS)
        states = steps.at(k, at)
        y = self.f.grid(at, states, self.p)
        self.net = k, at, states, y[: self.n_x]
        pivots = y[self.n_x :, quarters]
        if len(pivots):
            self.motion.count(watched=pivots.shape[1])
        pivots, parts = pivots.reshape(len(pivots), len(steps.t) - 1, QUARTERS), np.arange(1, QUARTERS + 1) / QUARTERS
        return Stretch(steps.t, steps.x, parts, pivots, steps.at, crosses=True, slope=steps.slope)

    def _doubted(self, stretch):
        """The number of steps that meet the equations, and the instant at which the next one does not, or None."""
        if self.tolerances is None:
            return len(stretch.t) - 1, None
        k, at, x, rates = self.net
        h = np.diff(stretch.t)
        inside = (at != stretch.t[k]) & (at != stretch.t[k + 1]) & (np.abs(h[k]) > SHORTEST * self.length)
        return self._defect(stretch, h, k[inside], at[inside], x[:, inside], rates[:, inside])

    def _defect(self, stretch, h, k, at, x, rates):
        rtol, atol = self.tolerances
        with np.errstate(all="ignore"):
            change = h[k] * stretch.slope(k, at)
            sizes = np.zeros((len(x), len(h)))
            np.maximum.at(sizes, (slice(None), k), np.fmax(np.abs(x), np.abs(change)))
            allowed = self.off * (np.reshape(atol, (-1, 1)) + rtol * sizes[:, k])
            excess = np.nan_to_num(np.abs(h[k] * rates - change) / allowed, posinf=np.inf).max(axis=0, initial=0.0)
        wrong = np.flatnonzero(excess > 1.0)
        if not len(wrong):
            return len(h), None
        good = k[wrong].min()
        worst = wrong[k[wrong] == good]
        return int(good), float(at[worst[np.argmax(excess[worst])]])

    def _use(self, model):
        super()._use(model)
        self.projection = model.function("ode_projected") if self.projects else None

    def _record(self, steps, first, last, end=None):
        """Keep the steps from `first` to before `last`, or to an end within it, and record the samples in them."""
        direction = 1.0 if self.forward else -1.0
        dense = _Stepped(steps, self.f, self.model.n, self.projection)
        ends, until = steps.t[first : last + 1 + (end is not None)], None if end is None else end.t
        self.motion.keep(self.model, ends, dense, self.coefficients, until, first)
        due = direction * self.pending <= direction * (steps.t[last] if end is None else end.t)
        times, self.pending = self.pending[due], self.pending[~due]
        if not len(times):
            return
        step = first + np.searchsorted(direction * steps.t[first : last + 1], direction * times, "right") - 1
        states = steps.x[:, np.clip(step, 0, last)]
        inside = (step < last + (end is not None)) & (times != steps.t[np.clip(step, 0, last)])
        states[:, inside] = dense.states(step[inside], times[inside], self.p)
        self.motion.add(self.model, times, dense.with_top(times, states, self.p))


@frozen(eq=False)
class _Stepped:
    """Jets within steps, with γ^(s̄), n values of the function f of X'; `projection` restores states, unless None."""

    steps: Steps
    f: object
    n: int
    projection: object

    @property
    def nbytes(self):
        """Memory of the steps."""
        return self.steps.nbytes

    def states(self, k, t, p):
        """X (n_x, N) at instants t (N,) within steps k (N,)."""
        states = self.steps.at(k, t)
        return states if self.projection is None else self.projection.restore_grid(t, states, p)

    def with_top(self, t, states, p):
        """Jets (n_z, N) of states."""
        n_x = len(states)
        return np.concatenate([states, self.f.grid(t, states, p)[n_x - self.n : n_x]])

    def __call__(self, k, t, p):
        """Jets (n_z, N) at instants t (N,) within steps k (N,)."""
        return self.with_top(t, self.states(k, t, p), p)
