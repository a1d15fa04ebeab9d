"""Compiled explicit Runge-Kutta methods of fixed step."""

from itertools import pairwise

import numpy as np

from servoctl.errors import IntegrationStopped
from servoctl.methods.bounds import largest_explicit, row_poles, warn_fast_poles, warn_unresolved
from servoctl.methods.drift import MinimalCoordinates, Poles, Project
from servoctl.methods.minimal import Chart, Sizes
from servoctl.methods.monitor import DEGRADED, NEGLIGIBLE, NO_CHOICE, Watch
from servoctl.methods.motion import Motion, breakpoints, interruptible
from servoctl.methods.resolution import unresolved
from servoctl.methods.tableaus import tableau

CHUNK = 2000  # steps per call of the compiled loop
SLOW_CHUNK = 100  # of the loop in Python
POWERS, NUDGE = 6, 1e-6  # of the power iteration for the fastest rate: its length, and relative size of a deviation
NEAR = 0.3  # of its reference: below this the least size of a pivot is looked for within a step


def fixed_step(model, method, drift, span, x0, step, knots, progress):
    """Integrate with steps of at most `step`, ending at every knot.

    Parameters
    ----------
    model : Model
    method : str
        One of `tableaus.ORDERS`.
    drift : None, Poles, Project or MinimalCoordinates
    span : (t0, t1)
        [s]
    x0 : (n_x,) array
    step : float
        [s]
    knots : sequence of float
    progress : callable

    Returns
    -------
    Motion
        Every step is a sample.
    """
    motion = Motion()
    with interruptible(motion):
        integration = _Fixed(model, method, drift, motion, progress)
        integration.watch = Watch(model, span[0], x0)
        integration.start(span[0], x0)
        cuts = breakpoints(span, knots)
        pieces = [(a, b, max(1, int(np.ceil(abs(b - a) / step * (1 - 1e-12))))) for a, b in pairwise(cuts)]
        if isinstance(drift, Poles):
            warn_fast_poles(method, row_poles(drift, model), max(((b - a) / count for a, b, count in pieces), key=abs))
        x = x0
        for a, b, count in pieces:
            if motion.stop is not None:
                break
            x = integration.piece(a, x, (b - a) / count, count)
        if motion.stop is None:
            integration.look_back()
    return motion


class _Fixed:
    def __init__(self, model, method, drift, motion, progress):
        self.method, self.drift, self.motion, self.progress = method, drift, motion, progress
        self.tableau = tableau(method)
        self.every = drift.every if isinstance(drift, Project) else 0
        self.sizes = Sizes(model) if isinstance(drift, MinimalCoordinates) else None
        self._use(model)

    def _use(self, model):
        self.model = model
        stabilised = isinstance(self.drift, Poles)
        self.f = model.function("ode_poles" if stabilised else "ode_projected" if self.every else "ode")
        self.p = np.append(model.parameters, self.drift.coefficients(model)) if stabilised else model.parameters

    def start(self, t, x):
        if self.watch.bad_choice(self.f(t, x, self.p), self.f.n_x):
            self._repivot(t, x)
            self.motion.stop = self.watch.refuse_start(t, x, self.f(t, x, self.p))

    def _repivot(self, t, x):
        """Go on with other pivots; whether there are any."""
        variant = self.watch.anew(t, x, self.f(t, x, self.p)[self.f.n_x - self.model.n : self.f.n_x])
        if variant is None:
            return False
        model, self.watch = variant
        self._use(model)
        self.motion.count(pivot_changes=1)
        return True

    def piece(self, a, x, h, count):
        """`count` steps of h from t = a; returns the last state."""
        self._suspect = (a, x)
        n_x, n, done = self.f.n_x, self.model.n, 0
        chunk = CHUNK - CHUNK % self.every if 0 < self.every < CHUNK else self.every or CHUNK
        chunk = SLOW_CHUNK if isinstance(self.drift, MinimalCoordinates) else chunk
        last = None
        while done < count:
            steps = min(chunk, count - done)
            states, guards = self._steps(a + done * h, x, h, steps)
            t = a + (done + np.arange(states.shape[1])) * h
            good, why, repivot = self._check(t, states, guards, last)
            short = good < steps
            states, t = states[:, : good + 1], t[: good + 1]
            top = self.f.grid(t, states, self.p)[n_x - n : n_x]
            self.motion.add(self.model, t, states, top)
            projections = good // self.every if self.every else 0
            self.motion.count(steps=good, nfev=len(self.tableau[1]) * good, projections=projections)
            if isinstance(self.drift, MinimalCoordinates):
                self.motion.count(coordinate_changes=self._changed[:good].sum())
            last = guards[:, : good + 1][:, -3:]
            x, done = states[:, -1].copy(), done + good
            self.progress(t[-1])
            if repivot and self.motion.changes_pivots(t[-1]) and self._repivot(t[-1], x):
                last = None
            elif repivot:
                self.motion.stop = self.watch.singular(t[-1], x, NO_CHOICE)
                break
            elif short:
                self._stop(t[-1], x, h, why)
                break
        return x

    def look_back(self):
        """Warn where steps do not resolve the motion."""
        with np.errstate(all="ignore"):
            found = unresolved(self.motion.pieces, self._halved)
            if found is not None:
                step, x, difference, size = found
                stable = largest_explicit(self.method) / self._fastest_rate(step[0], x, difference, size)
                warn_unresolved(self.method, step, np.abs(difference).max(), stable)

    def _halved(self, model, t, x, h):
        self._use(model)
        return self._steps(t, x, h, 2)[0]

    def _fastest_rate(self, t, x, direction, size):
        """|λ| of the mode that dominates in a direction, by power iteration; NaN where it is not finite."""
        rate = np.nan
        for _ in range(POWERS):
            direction = NUDGE * direction / np.abs(direction).max()
            ahead = self.f(t, x + size * direction, self.p)[: len(x)] - self.f(t, x, self.p)[: len(x)]
            direction, rate = ahead / size, float(np.abs(ahead / size).max() / NUDGE)
        return rate

    def _steps(self, t, x, h, count):
        """States (n_x, N + 1) of `count` steps and the pivots there; fewer where no state is finite."""
        if not isinstance(self.drift, MinimalCoordinates):
            return self.f.rk(t, x, h, count, self.p, self.tableau, 1, self.every)[1:]
        chart = Chart(self.model, self.sizes, t, x)
        states, self._changed = chart.steps(t, x, h, count, self.tableau)
        self.motion.counters["integrated"] = len(chart.free)
        return states, self.f.grid(t + np.arange(states.shape[1]) * h, states, self.p)[self.f.n_x :]

    def _check(self, t, states, guards, before):
        """How many steps stand, why no more, and whether pivots must be chosen anew there."""
        total = states.shape[1] - 1
        track = guards if before is None else np.concatenate([before[:, :-1], guards], axis=1)
        offset = track.shape[1] - guards.shape[1]
        if not guards.shape[0]:
            return total, "", False
        relative = self.watch.relative(track)
        events = []
        for i in range(len(relative)):
            r = relative[i]
            events += [(k, "a pivot changes its sign") for k in np.flatnonzero(np.sign(r[:-1]) * np.sign(r[1:]) < 0)]
            size = np.abs(r)
            inner = np.flatnonzero((size[1:-1] < size[:-2]) & (size[1:-1] <= size[2:]) & (size[1:-1] < DEGRADED)) + 1
            events += [(k, "a pivot touches zero") for k in inner if self._bounces(size[k], t, states, k - offset)]
            events += [(k, "a pivot has vanished") for k in np.flatnonzero(size < NEGLIGIBLE)]
            weak = np.flatnonzero(size[offset:] < DEGRADED)
            for k in weak[weak > 0][:1]:
                if self.watch.chart_only(size[k + offset], t[k], states[:, k]):
                    events.append((k + offset, "repivot"))
        events = [(max(k - offset, 0), why) for k, why in events]
        touched = self._touched(np.abs(relative[:, offset:]), t, states)
        if touched is not None and touched[0] <= min(events, default=(total,))[0] + 1:
            self._suspect = touched[1:]
            return touched[0], "a pivot touches zero", False
        if not events:
            return total, "", False
        k, why = min(events)
        if why == "repivot":
            return k, "", k > 0 or before is not None
        self._locate(k, t, states, guards)
        around = (self._measure(t, states, k), self._measure(t, states, k + 1), self.watch.rank_measure(*self._suspect))
        if min(around) > DEGRADED:
            return k, "", True
        j = max(k - 1, 0)
        top = self.f(t[j], states[:, j], self.p)[self.f.n_x - self.model.n : self.f.n_x]
        at = min(k, len(t) - 1)
        other = self.watch.other_choice(t[j], np.append(states[:, j], top), t[at], states[:, at])
        return (j, "", True) if other is not None and j > 0 else (k, why, False)

    def _locate(self, k, t, states, guards):
        """Where a pivot vanishes between samples k and k + 1, by linear interpolation; else sample k."""
        self._suspect = (t[k], states[:, k])
        if k + 1 < len(t):
            for a, b in guards[:, [k, k + 1]]:
                if a * b < 0:
                    f = abs(a) / (abs(a) + abs(b))
                    self._suspect = (t[k] + f * (t[k + 1] - t[k]), (1 - f) * states[:, k] + f * states[:, k + 1])

    def _touched(self, sizes, t, states):
        """The last sample before the program is singular within a step, with t and X there, or None.

        Where the constraints are exact, a pivot that touches zero leaves no residual to be seen by: its least size is
        looked for within the steps.
        """
        if not isinstance(self.drift, MinimalCoordinates) or len(t) < 2:
            return None
        padded = np.pad(sizes, ((0, 0), (1, 1)), constant_values=np.inf)
        low = (sizes < NEAR) & (sizes <= padded[:, :-2]) & (sizes <= padded[:, 2:])
        for k, i in np.argwhere(low.T):
            first, last = max(k - 1, 0), min(k + 1, len(t) - 1)
            chart = Chart(self.model, self.sizes, t[first], states[:, first])
            at, x, size = chart.weakest(t[first], states[:, first], t[last] - t[first], self.tableau, i)
            hidden = self.watch.hidden_zero(size / self.watch.reference[i], at, x)
            if hidden and self.watch.rank_measure(at, x) < DEGRADED:
                return first, at, x
        return None

    def _bounces(self, size, t, states, k):
        k = max(k, 0)
        return self.watch.hidden_zero(size, t[k], states[:, k])

    def _measure(self, t, states, k):
        k = min(k, len(t) - 1)
        return self.watch.rank_measure(t[k], states[:, k])

    def _stop(self, t, x, h, why):
        if why:
            self.motion.stop = self.watch.singular(*self._suspect, why)
        elif self.watch.lost(t, x):
            self.motion.stop = self.watch.singular(t, x, "the state is no longer finite")
        else:
            self.motion.stop = IntegrationStopped(
                f"{self.method} with steps of {abs(h):.3g} s has no finite state after t = {t:.7g} s.",
                "Explicit methods are stable for steps below about 2.8 over the largest eigenvalue.",
                nearest=f"The motion before t = {t:.6g} s, which is kept.",
                do="Take a smaller step, slower poles, or an adaptive method.",
                t=float(t),
            )
