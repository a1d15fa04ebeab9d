"""Compiled explicit Runge-Kutta methods of fixed step: their tableaus and their integration."""

from itertools import pairwise

import numpy as np

from servoctl.dense import Hermite
from servoctl.methods.choice import Poles, Project
from servoctl.methods.motion import Stepping, equal_steps
from servoctl.methods.pieces import LEAVES, End, residuals, terms_of
from servoctl.methods.rank import Fine, Stretch

MUCH = 1e-2  # of its terms, by which a residual may change over a step, unless shorter ones change it less
FINER, CLOSER = 16, 4  # shorter steps in place of one; how often, to come close to where a motion ends


def tableau(name):
    """The tableau of a method: a (s, s), strictly lower triangular, b and c (s,); that of RK8 is DOP853's."""
    if name == "RK4":
        return np.diag([0.5, 0.5, 1.0], -1), np.array([1, 2, 2, 1]) / 6, np.array([0.0, 0.5, 0.5, 1.0])
    import scipy.integrate

    method = getattr(scipy.integrate, {"RK8": "DOP853"}.get(name, name))
    a, s = np.zeros((method.n_stages, method.n_stages)), method.n_stages
    a[:, : method.A.shape[1]] = method.A[:s, :s]
    return a, np.array(method.B[:s]), np.array(method.C[:s])


class RungeKuttaSteps(Stepping):
    """One integration, by one of `ORDERS`, in steps of at most `step` [s] that end at knots; every step is a sample."""

    rank_lost = "its steps lead to no state of the program"
    advice = "Use a smaller step (stable below about 2.8 over the largest eigenvalue), slower poles, or 'DOP853'."
    parts = 1
    most = 2000  # steps per call of the compiled loop

    def __init__(self, model, method, drift, step, progress):
        self.tableau, self.step = tableau(method), step
        self.every = drift.every if isinstance(drift, Project) else 0
        self.projects = self.every > 0
        super().__init__(model, method, drift, progress)

    def _function(self, model, poles):
        return model.function("ode_projected") if self.every else super()._function(model, poles)

    @property
    def taken(self):
        """The steps as (model, t, states)."""
        m = self.motion
        return [(model, m.t[first:end], m.jets[: self.n_x, first:end]) for model, first, _, end in m.pieces]

    def _samples(self, cuts, t_eval):
        return 1 + sum(equal_steps(a, b, self.step)[1] for a, b in pairwise(cuts))

    def _piece(self, a, x, b, times):
        h, count = equal_steps(a, b, self.step)
        first, last = self._beside(a, b)
        inner = (last - first) / count
        # each call ends with a projection where steps are projected, so that the next one counts from there
        most = self.most - self.most % self.every if 0 < self.every < self.most else self.every or self.most
        done = 0
        self._begin_piece(a, self._pivots(a, x))
        while done < count and self.motion.stop is None:
            steps = min(most, count - done)
            states, pivots = self._steps(first + done * inner, x, inner, steps)
            t = a + (done + np.arange(states.shape[1])) * h
            t[-1] = b if done + len(t) > count else t[-1]
            end = self._lost(t, states)
            kept = slice(len(t) if end is None else end[0] + 1)
            outcome = self._inspect(t[kept], states[:, kept], pivots[:, kept])
            good = outcome.steps
            if isinstance(outcome, End):
                inside = np.append(t[: good + 1], outcome.t), np.column_stack([states[:, : good + 1], outcome.x])
                self._record(*inside)
                self._turn(outcome, b)
                return outcome.t, outcome.x
            self._record(t[: good + 1], states[:, : good + 1])
            x, done = states[:, good].copy(), done + good
            self.progress(t[good])
            if not isinstance(outcome, Fine):
                self._follow(outcome)
            elif good < steps:
                place = (t[good], x) if end is None or good < end[0] else end[1:]
                self._fail(*place, f"a step of {abs(h):.3g} s leads to no state of the program")
        return b, x

    def _lost(self, t, states):
        """The first step that leads off the program, also in parts, as its rank is lost there: (k, t, X); or None."""
        values, allowed = residuals(self.model, self.tolerance, t[-1:], states[:, -1:])
        if (np.abs(values) <= LEAVES * allowed).all():
            return None
        for k in np.flatnonzero(self._off(t, states)):
            at, x = self._last(t[k], states[:, k], t[k + 1] - t[k])
            if self.rank.lost(at, x):
                return int(k), at, x
        return None

    def _off(self, t, states):
        """Over which steps a residual changes by much of its terms, (S,)."""
        values, allowed = residuals(self.model, self.tolerance, t, states)
        change, terms = np.abs(np.diff(values)), terms_of(self.model).grid(t, states, self.model.p)
        return ((change > MUCH * terms[:, 1:]) & (change > LEAVES * allowed[:, 1:])).any(axis=0)

    def _last(self, t, x, h):
        """The last instant and state before a step of length h [s] leads off the program, by ever shorter ones."""
        for _ in range(CLOSER):
            h /= FINER
            states = self.again(t, x, h, FINER)
            off = np.append(self._off(t + h * np.arange(states.shape[1]), states), states.shape[1] <= FINER)
            good = int(np.argmax(off)) if off.any() else FINER
            t, x = t + good * h, states[:, good]
            if good == FINER:
                break
        return t, x

    def _record(self, t, states):
        steps, jets = len(t) - 1, self._jets(t, states)
        self.motion.add(self.model, t, jets)
        self.motion.keep(
            self.model, t, Hermite(self.model, t, jets, not isinstance(self.drift, Poles)), self.coefficients
        )
        self.motion.count(steps=steps, nfev=len(self.tableau[1]) * steps)
        self.motion.count(projections=steps // self.every if self.every else 0)

    def _jets(self, t, states):
        """Jets (n_z, N) of states (n_x, N)."""
        return np.concatenate([states, self.f.grid(t, states, self.p)[self.n_x - self.model.n : self.n_x]])

    def halved(self, model, t, x, h):
        """States (n_x, 3) at t, t + h and t + 2 h by two steps; fewer if one fails."""
        self._use(model)
        return self.again(t, x, h, 2)

    def rates(self, t, x):
        """X' at a state."""
        return self._outputs(t, x)[: self.n_x]

    def _steps(self, t, x, h, count):
        """States (n_x, N + 1) of `count` steps and the pivots there; fewer if a state is not finite."""
        return self.f.rk(t, x, h, count, self.p, self.tableau, 1, self.every)[1:]

    def _inspect(self, t, states, pivots):
        """The outcome of steps; one across a pivot's zero has passed no error test and is repeated."""
        return self._inspected(Stretch(t, states, np.ones(1), pivots[:, 1:, None], self._between(t, states)))

    def _between(self, t, states):
        """X from steps and times within them, by polynomials through all derivatives."""
        made = []

        def dense(k, times):
            made[:] = made or [Hermite(self.model, t, self._jets(t, states))]
            return made[0](k, times, self.p)[: self.n_x]

        return dense

    def _continuous(self, stretch):
        """Where steps are projected, by shorter ones from their starts that are not."""
        if not self.every:
            return stretch.dense

        def states(k, t):
            places = zip(stretch.t[k], stretch.x[:, k].T, t, strict=True)
            steps = [self.f.rk(a, x, b - a, 1, self.p, self.tableau, 1, 0)[1] for a, x, b in places]
            return np.array([x[:, -1] if x.shape[1] == 2 else np.full(self.n_x, np.nan) for x in steps]).T

        return states

    def _state_within(self, stretch):
        """X from (k, t) within steps, by a shorter step from their start."""
        return lambda k, t: self.again(stretch.t[k], stretch.x[:, k], t - stretch.t[k], 1)[:, -1]

    def again(self, t, x, h, count):
        """States (n_x, count + 1) at the ends of equal steps from t; fewer if one fails."""
        return self._steps(t, x, h, count)[0]
