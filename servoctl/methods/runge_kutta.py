"""Compiled explicit Runge-Kutta methods of fixed step: their tableaus and their integration."""

from itertools import pairwise

import numpy as np

from servoctl.errors import unknown
from servoctl.methods.choice import ORDERS, MinimalCoordinates, Project
from servoctl.methods.minimal import Chart, Sizes
from servoctl.methods.monitor import DEGRADED, Fine, Singular, Stretch
from servoctl.methods.motion import Cubics, Stepping, equal_steps
from servoctl.methods.watch import FINER, End

NEARLY_ZERO = 0.3  # of its reference: below this a pivot's least size is searched for within steps


def tableau(name):
    """The tableau (a, b, c) of a method; the coefficients of RK5 and RK8 are scipy's.

    Parameters
    ----------
    name : {"RK1", "RK2", "RK4", "RK5", "RK8"}

    Returns
    -------
    a : (s, s) array
        Strictly lower triangular.
    b, c : (s,) arrays

    Raises
    ------
    NameUnknown
        For another name.
    """
    if name not in ORDERS:
        raise unknown(name, ORDERS, "method")
    if name in ("RK5", "RK8"):
        import scipy.integrate

        method = scipy.integrate.RK45 if name == "RK5" else scipy.integrate.DOP853
        s = method.n_stages
        a = np.zeros((s, s))
        a[:, : method.A.shape[1]] = method.A[:s, :s]
        return a, np.array(method.B[:s]), np.array(method.C[:s])
    b = {"RK1": [1.0], "RK2": [0.0, 1.0], "RK4": [1 / 6, 1 / 3, 1 / 3, 1 / 6]}[name]
    c = {"RK1": [0.0], "RK2": [0.0, 0.5], "RK4": [0.0, 0.5, 0.5, 1.0]}[name]
    a = np.zeros((len(b), len(b)))
    a[np.arange(1, len(b)), np.arange(len(b) - 1)] = c[1:]
    return a, np.array(b), np.array(c)


class RungeKuttaSteps(Stepping):
    """One integration with steps of at most `step` that end at the knots; every step is a sample.

    Parameters
    ----------
    model : Model
    method : str
        One of `ORDERS`.
    drift : None, Poles, Project or MinimalCoordinates
    step : float
        [s]
    progress : callable
    """

    rank_lost = "the state is no longer finite"
    advice = "Use a smaller step (stable below about 2.8 over the largest eigenvalue), slower poles, or 'DOP853'."
    parts = 1
    _changed = np.zeros(0, dtype=bool)  # before which of the last steps coordinates were chosen again
    most, most_in_python = 2000, 100  # steps per call of the compiled loop, and of the one on minimal coordinates

    def __init__(self, model, method, drift, step, progress):
        self.tableau, self.step = tableau(method), step
        self.every = drift.every if isinstance(drift, Project) else 0
        self.sizes = Sizes(model) if isinstance(drift, MinimalCoordinates) else None
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
        most, done = self.most_in_python if self.sizes else most, 0
        self.monitor.begin(self._pivots(a, x))
        self.watch.begin(a)
        while done < count and self.motion.stop is None:
            steps = min(most, count - done)
            states, pivots = self._steps(first + done * inner, x, inner, steps)
            t = a + (done + np.arange(states.shape[1])) * h
            t[-1] = b if done + len(t) > count else t[-1]
            outcome = self._inspect(t, states, pivots)
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
                self._fail(t[good], x, f"a step of {abs(h):.3g} s leads to no finite state")
        return b, x

    def _record(self, t, states):
        steps, top = len(t) - 1, slice(self.n_x - self.model.n, self.n_x)
        self.motion.add(self.model, t, states, self.f.grid(t, states, self.p)[top])
        self.motion.count(steps=steps, nfev=len(self.tableau[1]) * steps)
        self.motion.count(projections=steps // self.every if self.every else 0)
        if self.sizes:
            self.motion.count(coordinate_changes=self._changed[:steps].sum())

    def halved(self, model, t, x, h):
        """States (n_x, 3) at t, t + h and t + 2 h by two steps; fewer if one fails."""
        self._use(model)
        return self.again(t, x, h, 2)

    def rates(self, t, x):
        """X' at a state."""
        return self._outputs(t, x)[: self.n_x]

    def _steps(self, t, x, h, count):
        """States (n_x, N + 1) of `count` steps and the pivots there; fewer if a state is not finite."""
        if not self.sizes:
            return self.f.rk(t, x, h, count, self.p, self.tableau, 1, self.every)[1:]
        chart = Chart(self.model, self.sizes, t, x)
        states, self._changed = chart.steps(t, x, h, count, self.tableau)
        self.motion.counters["integrated"] = len(chart.free)
        return states, self.f.grid(t + np.arange(states.shape[1]) * h, states, self.p)[self.n_x :]

    def _inspect(self, t, states, pivots):
        """The monitor's outcome; a step across a pivot's zero has passed no error test and is repeated."""
        outcome = self._inspected(Stretch(t, states, pivots[:, 1:, None], self._top))
        if (self.sizes or self.every) and outcome.steps:
            first = slice(outcome.steps + 1)
            torn = self.watch.torn(t[first], states[:, first], self._all_rates(t[first], states[:, first]), self._finer)
            outcome = outcome if torn is None else torn
        if self.sizes and len(t) > 1 and len(pivots):
            touched = self._touched(t, states, pivots)
            if touched is not None and touched.steps <= outcome.steps + 1:
                return touched
        return outcome

    def _states_within(self, stretch):
        """X from steps and times within them, by cubics."""
        rates = self.f.grid(stretch.t, stretch.x, self.p)[: self.n_x]
        return Cubics(stretch.t, stretch.x, rates).at

    def _state_within(self, stretch):
        """X from (k, t) within steps, by a shorter step from their start."""
        return lambda k, t: self.again(stretch.t[k], stretch.x[:, k], t - stretch.t[k], 1)[:, -1]

    def again(self, t, x, h, count):
        """States (n_x, count + 1) at the ends of equal steps from t; fewer if one fails."""
        changed = self._changed
        states = self._steps(t, x, h, count)[0]
        self._changed = changed
        return states

    def _all_rates(self, t, states):
        return self.f.grid(t, states, self.p)[: self.n_x]

    def _finer(self, t, x, end):
        """Instants, states and rates of shorter steps; what a state has drifted since its projection is no jump."""
        x = self.f.restore(t, x, self.p) if self.every else x
        states = self.again(t, x, (end - t) / FINER, FINER)
        times = np.linspace(t, end, FINER + 1)[: states.shape[1]]
        return times, states, self._all_rates(times, states)

    def _touched(self, t, states, pivots):
        """Singular if a pivot touches zero within a step, else None.

        On minimal coordinates the constraints hold exactly, so that no residual reveals a pivot that touches zero: its
        least size is searched for within the steps.
        """
        scale = np.where(self.monitor.reference > 0, self.monitor.reference, 1.0)
        sizes = np.abs(pivots) / scale[:, None]
        padded = np.pad(sizes, ((0, 0), (1, 1)), constant_values=np.inf)
        low = (sizes < NEARLY_ZERO) & (sizes <= padded[:, :-2]) & (sizes <= padded[:, 2:])
        for k, i in np.argwhere(low.T):
            first, last = max(k - 1, 0), min(k + 1, len(t) - 1)
            chart = Chart(self.model, self.sizes, t[first], states[:, first])
            at, x, size = chart.weakest(t[first], states[:, first], t[last] - t[first], self.tableau, i)
            hidden = self.monitor.hidden_zero(size / scale[i], at, x)
            if hidden and self.monitor.rank_measure(at, x) < DEGRADED:
                return Singular(first, at, x, "a pivot touches zero")
        return None
