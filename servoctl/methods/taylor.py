"""The Taylor method: compiled series steps, dense output from the coefficients, jets of any order."""

from math import factorial

import numpy as np

from servoctl.errors import IntegrationStopped
from servoctl.methods.drift import Project
from servoctl.methods.monitor import DEGRADED, NEGLIGIBLE, NO_CHOICE, Watch
from servoctl.methods.motion import Motion, breakpoints, interruptible
from servoctl.methods.series import series_loop

CHUNK = 100  # steps per call of the compiled loop
INSIDE = np.array([0.25, 0.5, 0.75])  # of a step: where pivots are looked at
LOWEST, HIGHEST = 4, 24  # orders: below, steps are too short; above, compiling grows faster than steps


def order_for(rtol):
    """The order of least work for a tolerance: 1 - ln(rtol)/2 (Jorba and Zou 2005), and four more.

    Their order counts operations as quadratic in it; here a step also has work that does not grow, and compiled
    operations of higher order wait less for each other.
    """
    return int(np.clip(np.ceil(5.0 - 0.5 * np.log(rtol)), LOWEST, HIGHEST))


class SeriesMethod:
    """One integration by the Taylor method.

    Parameters
    ----------
    model : Model
    drift : None or Project
    rtol, atol : float
    order : int or None
        Of the method; None chooses it by `order_for`.
    jets : int
        Highest level of the jets in the samples.
    progress : callable
    """

    def __init__(self, model, drift, rtol, atol, order, jets, progress):
        self.rtol, self.atol, self.progress = rtol, atol, progress
        self.order = order_for(rtol) if order is None else order
        self.every = drift.every if isinstance(drift, Project) else 0
        self.jets = max(jets, model.reduction.top)
        self.motion = Motion()
        self._use(model)

    def _use(self, model):
        self.model = model
        last = max(self.order + model.reduction.top - 1, self.jets + 1)
        self.f = series_loop(model, last)
        self.nq, self.n, self.top, self.last, self.plain = model.nq, model.n, model.reduction.top, last, model.plain
        self.n_c = (0 if self.plain else self.nq * last) + self.n * last

    def run(self, t0, x0, t1, t_eval, knots):
        """Integrate from t0 to t1; samples at t_eval."""
        with interruptible(self.motion):
            self.watch = Watch(self.model, t0, x0)
            x, cuts = x0, breakpoints((t0, t1), knots)
            self._start(t0, x0, (cuts[0] + cuts[1]) / 2)
            for a, b in zip(cuts[:-1], cuts[1:], strict=True):
                if self.motion.stop is not None:
                    break
                inside = (t_eval >= min(a, b)) & (t_eval <= max(a, b))
                x = self._piece(a, x, b, t_eval[inside])
        return self.motion

    def _start(self, t, x, after):
        self.p = np.append(self.model.parameters, after)
        y = self.f(t, x, self.p)
        first = np.append(x, y[self.n_c :])
        if not np.all(np.isfinite(y)) or self.watch.bad_choice(first, len(x)):
            self._repivot(t, x)
            self.motion.stop = self.watch.refuse_start(t, x, self.f(t, x, self.p))

    def _repivot(self, t, x):
        """Go on with other pivots; whether there are any."""
        variant = self.watch.anew(t, x, np.zeros(self.n))
        if variant is None:
            return False
        model, self.watch = variant
        self._use(model)
        self.motion.count(pivot_changes=1)
        return True

    def _piece(self, a, x, b, pending):
        self.p = np.append(self.model.parameters, (a + b) / 2)  # paths take the branches of this piece
        while a != b and self.motion.stop is None:
            t, states, y = self.f.taylor(a, x, b, self.p, self.rtol, self.atol, CHUNK, self.every)
            steps = len(t) - 1
            stand, where, why, repivot = self._check(t, states, y)
            self.motion.count(steps=stand, nfev=stand)
            end = t[stand] if where is None else where
            pending = self._sample(t, states, y, pending, end)
            if repivot and where is not None:
                a, x = where, self._state(t, states, y, where)
            else:
                a, x = t[stand], states[:, stand].copy()
            self.progress(a)
            if repivot:
                if not (self.motion.changes_pivots(a) and self._repivot(a, x)):
                    self.motion.stop = self.watch.singular(a, x, NO_CHOICE)
            elif why:
                at = self._state(t, states, y, where)
                self.motion.stop = self.watch.singular(where, at, why)
            elif steps < CHUNK and a != b:
                self._stopped(a, x)
        if len(pending) and self.motion.stop is None:
            self._sample(np.array([a, a]), np.column_stack([x, x]), self._outputs(a, x), pending, a)
        return x

    def _outputs(self, t, x):
        return self.f(t, x, self.p)[:, None]

    def _coefficients(self, y):
        """Coefficients of q and of γ with index 1 .. last."""
        own = y[: self.nq * self.last].reshape(self.last, self.nq)
        c = own if self.plain else y[self.nq * self.last : self.n_c].reshape(self.last, self.n)
        return own, c

    def _jets(self, x, y, h, top):
        """Jets q, γ', ..., γ^(top) at times h (N,) after a step's start, (nq + top n, N)."""
        own, c = self._coefficients(y)
        rows = [x[: self.nq, None] + _level(own, 0, h)]
        return np.concatenate([*rows, *(_level(c, j, h) for j in range(1, top + 1))])

    def _state(self, t, states, y, when):
        direction = np.sign(t[-1] - t[0])
        k = min(int(np.searchsorted(direction * t, direction * when, "right")) - 1, y.shape[1] - 1)
        return self._jets(states[:, k], y[:, k], np.array([when - t[k]]), self.top - 1)[:, 0]

    def _check(self, t, states, y):
        """Whole steps that stand, where the next one is left, why, and whether other pivots lead on from there."""
        steps = y.shape[1]
        if not steps or y.shape[0] == self.n_c:
            return steps, None, "", False
        ends = np.column_stack([y[self.n_c :], self.f(t[-1], states[:, -1], self.p)[self.n_c :]])
        track = np.abs(self.watch.relative(ends))
        suspicious = np.any(np.sign(ends[:, :-1]) * np.sign(ends[:, 1:]) < 0, axis=0)
        suspicious |= np.any((track[:, :-1] < DEGRADED) | (track[:, 1:] < DEGRADED), axis=0)
        for k in np.flatnonzero(suspicious):
            inside = t[k] + INSIDE * (t[k + 1] - t[k])
            between = self._jets(states[:, k], y[:, k], inside - t[k], self.top - 1)
            middle = [self.f(s, between[:, i], self.p)[self.n_c :] for i, s in enumerate(inside)]
            found = self._vanishing(
                self.watch.relative(np.array([ends[:, k], *middle, ends[:, k + 1]]).T),
                [t[k], *inside, t[k + 1]],
                *(k, t, states, y),
            )
            if found is not None:
                return found
        return steps, None, "", False

    def _vanishing(self, track, instants, k, t, states, y):
        changed = np.argwhere(np.sign(track[:, :-1]) * np.sign(track[:, 1:]) < 0)
        weak = np.argwhere(np.abs(track) < NEGLIGIBLE)
        if len(changed) or len(weak):
            i, j = changed[np.argmin(changed[:, 1])] if len(changed) else weak[np.argmin(weak[:, 1])]
            where = instants[j]
            if len(changed):
                where = self._root(i, instants[j], instants[j + 1], t, states, y)
            at = self._state(t, states, y, where)
            until = instants[j if len(changed) else max(j - 1, 0)]
            before = np.append(self._state(t, states, y, until), np.zeros(self.n))
            if self.watch.rank_measure(where, at) > DEGRADED or self.watch.other_choice(until, before, where, at):
                return k, until, "", True
            return k, where, "a pivot changes its sign" if len(changed) else "a pivot has vanished", False
        lowest = np.abs(track[:, -1])
        if lowest.min(initial=1.0) < DEGRADED and self.watch.chart_only(lowest.min(), t[k + 1], states[:, k + 1]):
            return k + 1, None, "", True
        return None

    def _root(self, i, a, b, t, states, y):
        from scipy.optimize import brentq

        return brentq(lambda s: self.f(s, self._state(t, states, y, s), self.p)[self.n_c + i], a, b, xtol=1e-13)

    def _sample(self, t, states, y, pending, end):
        """Record pending samples up to `end`; those that remain."""
        if not y.shape[1]:
            return pending
        direction = 1.0 if t[-1] >= t[0] else -1.0
        due = direction * pending <= direction * end
        times = pending[due]
        if len(times):
            k = np.clip(np.searchsorted(direction * t, direction * times, "right") - 1, 0, y.shape[1] - 1)
            parts = np.empty((self.nq + self.jets * self.n, len(times)))
            for step in np.unique(k):
                own = k == step
                parts[:, own] = self._jets(states[:, step], y[:, step], times[own] - t[step], self.jets)
            n_x = len(states)
            self.motion.add(self.model, times, parts[:n_x], parts[n_x:])
        return pending[~due]

    def _stopped(self, t, x):
        if self.watch.lost(t, x):
            self.motion.stop = self.watch.singular(t, x, "the radius of convergence shrinks to nothing")
        else:
            self.motion.stop = IntegrationStopped(
                f"The Taylor method stopped at t = {t:.7g} s: its steps vanish or are not finite.",
                "A step is as long as the series converges.",
                nearest=f"The motion before t = {t:.6g} s, which is kept.",
                do="See whether the motion escapes or meets a point where it is not smooth.",
                t=float(t),
            )


def _level(c, j, h):
    """The j-th derivative at times h (N,) of the series with coefficients c (last, n), less the constant for j = 0."""
    total = np.zeros((c.shape[1], len(h)))
    for k in range(len(c), max(j, 1) - 1, -1):
        total = total * h + float(factorial(k) // factorial(k - j)) * c[k - 1][:, None]
    return total * h if j == 0 else total
