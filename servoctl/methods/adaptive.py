"""scipy's adaptive methods on compiled right-hand sides, with the watch on rank and projection."""

import numpy as np

from servoctl.errors import IntegrationStopped
from servoctl.methods.drift import MinimalCoordinates, Poles, Project, Projector
from servoctl.methods.minimal import MinimalSolver, Sizes
from servoctl.methods.monitor import DEGRADED, NEGLIGIBLE, NO_CHOICE, VANISHING, Watch
from servoctl.methods.motion import Motion, breakpoints, interruptible, sign_change

IMPLICIT = ("Radau", "BDF")
LINGERS = 5.0  # times the way to its crossing that a sunk pivot may stay at zero
INSIDE = (0.25, 0.5, 0.75, 1.0)  # of a step: where pivots are looked at


class Adaptive:
    """One integration by one of scipy's methods.

    Parameters
    ----------
    model : Model
    method : str
        One of `choice.SCIPY`.
    drift : None, Poles, Project or MinimalCoordinates
    rtol, atol : float
    progress : callable
    """

    def __init__(self, model, method, drift, rtol, atol, progress):
        self.method, self.drift = method, drift
        self.rtol, self.atol, self.progress = rtol, atol, progress
        self.motion = Motion()
        self.sizes = Sizes(model) if isinstance(drift, MinimalCoordinates) else None
        self._use(model)

    def _use(self, model):
        self.model = model
        stabilised = isinstance(self.drift, Poles)
        self.f = model.function("ode_poles" if stabilised else "ode")
        self.p = np.append(model.parameters, self.drift.coefficients(model)) if stabilised else model.parameters
        self.n_x = self.f.n_x
        name = "ode_poles_jacobian" if stabilised else "ode_jacobian"
        self.slopes = model.function(name) if self.method in IMPLICIT else None
        self.projector = Projector(model) if isinstance(self.drift, Project) else None

    def run(self, t0, x0, t1, t_eval, knots):
        """Integrate from t0 to t1; samples at t_eval.

        Returns
        -------
        Motion
        """
        with interruptible(self.motion):
            self.watch = Watch(self.model, t0, x0)
            self._choose_pivots(t0, x0)
            x, cuts = x0, breakpoints((t0, t1), knots)
            for a, b in zip(cuts[:-1], cuts[1:], strict=True):
                if self.motion.stop is not None:
                    break
                inside = t_eval[(t_eval >= min(a, b)) & (t_eval <= max(a, b))]
                self.pending, self.forward = list(inside), b >= a
                x = self._piece(a, x, b)
        return self.motion

    def _rates(self, t, x):
        return self.f(t, x, self.p)[: self.n_x]

    def _jacobian(self, t, x):
        return self.slopes(t, x, self.p).reshape(self.n_x, self.n_x).T

    def _solver(self, a, x, b):
        import scipy.integrate

        method, tolerances = getattr(scipy.integrate, self.method), {"rtol": self.rtol, "atol": self.atol}
        if isinstance(self.drift, MinimalCoordinates):
            return MinimalSolver(method, self.model, self.sizes, a, x, b, tolerances, self.slopes is not None)
        exact = {} if self.slopes is None else {"jac": self._jacobian}
        return method(self._rates, a, x, b, **tolerances, **exact)

    def _piece(self, a, x, b):
        solver, self._sunk = self._solver(a, x, b), None
        self._sample(a, None, x)
        history = [self._guards(a, x)]
        steps = 0
        while solver.status == "running":
            old = (solver.t, solver.y.copy())
            with np.errstate(all="ignore"):
                message = solver.step()
            if solver.status == "failed" or not np.all(np.isfinite(solver.y)):
                self._failed(*old, message)
                self._last(*old)
                break
            steps += 1
            dense = solver.dense_output()
            if self._watched(history, old, solver.t, dense):
                other = self.watch.other_choice(old[0], np.append(old[1], self._top(*old)), *self._suspect[:2])
                if other is None or not self.motion.changes_pivots(old[0]):
                    self.motion.stop = self.watch.singular(*self._suspect)
                    self._last(*old)
                    break
                self._count(solver)
                solver, history = self._change(other, *old, b)
                continue
            if self._must_repivot:
                t, x = solver.t, solver.y
                self._sample(t, dense, x)
                other = self.watch.anew(t, x, self._top(t, x))
                if other is None:
                    self.motion.stop = self.watch.singular(t, x, NO_CHOICE)
                    self._last(t, x)
                    break
                self._count(solver)
                solver, history = self._change(other, t, x, b)
                continue
            if self.projector is not None and (steps % self.drift.every == 0 or solver.status == "finished"):
                solver.y = self.projector(solver.t, solver.y)
                if hasattr(solver, "f"):
                    solver.f = solver.fun(solver.t, solver.y)
                self.motion.count(projections=1)
            self._sample(solver.t, dense, solver.y)
            self.progress(solver.t)
        self._count(solver)
        self.motion.count(steps=steps)
        return solver.y

    def _change(self, variant, t, x, b):
        """Go on with another variant of the model from a state; its solver and the history of its pivots."""
        self._go_on(variant)
        return self._solver(t, x, b), [self._guards(t, x)]

    def _go_on(self, variant):
        model, self.watch = variant
        self._use(model)
        self.motion.count(pivot_changes=1)

    def _count(self, solver):
        self.motion.count(nfev=solver.nfev, njev=solver.njev, nlu=solver.nlu)
        if isinstance(solver, MinimalSolver):
            self.motion.counters["integrated"] = len(solver.chart.free)
            self.motion.count(coordinate_changes=solver.changes)

    def _guards(self, t, x):
        return self.watch.relative(self.f(t, x, self.p)[self.n_x :])

    def _top(self, t, x):
        return self.f(t, x, self.p)[self.n_x - self.model.n : self.n_x]

    def _choose_pivots(self, t, x):
        """At the start: choose pivots anew where the model's own are far worse than its matrices."""
        y = self.f(t, x, self.p)
        if self.watch.bad_choice(y, self.n_x):
            other = self.watch.anew(t, x, y[self.n_x - self.model.n : self.n_x])
            if other is not None:
                self._go_on(other)
            self.motion.stop = self.watch.refuse_start(t, x, self.f(t, x, self.p))

    def _watched(self, history, old, t, dense):
        """Look at the pivots along the last step; True where the program is singular."""
        self._must_repivot = False
        times = [old[0] + s * (t - old[0]) for s in INSIDE]
        values = np.array([self.f(s, dense(s), self.p)[self.n_x :] for s in times])
        self.motion.count(watched=len(times))
        if not values.size:
            return False
        relative = self.watch.relative(values.T).T
        track = [*history[-1:], *relative]
        instants = [old[0], *times]
        for before, after, a, b in zip(track[:-1], track[1:], instants[:-1], instants[1:], strict=True):
            for i in sign_change(before, after):
                return self._candidate(i, self._root(i, a, b, dense), dense, "a pivot changes its sign")
        longer = [*history[-2:], *relative]
        for k in range(1, len(longer) - 1):
            middle = np.abs(longer[k])
            low = np.flatnonzero(
                (middle < np.abs(longer[k - 1])) & (middle <= np.abs(longer[k + 1])) & (middle < DEGRADED)
            )
            for i in low:
                where, value = self._minimum(i, instants, dense, old[0], t)
                if self.watch.hidden_zero(value, where, dense(where)):
                    return self._candidate(i, where, dense, "a pivot touches zero")
        worst = int(np.argmin(np.abs(relative[-1])))
        if abs(relative[-1, worst]) < NEGLIGIBLE:
            return self._candidate(worst, t, dense, "a pivot has vanished")
        if self._lingers(worst, instants[-2:], np.abs(relative[-2:, worst]), dense):
            return True
        if abs(relative[-1, worst]) < DEGRADED and self.watch.chart_only(relative[-1, worst], t, dense(t)):
            self._must_repivot = True
        history.extend(relative)
        del history[:-2]
        return False

    def _lingers(self, i, instants, sizes, dense):
        """Whether a pivot has sunk into what the residual hides, should have crossed zero, and stays there."""
        t, x = instants[1], dense(instants[1])
        if sizes[1] >= DEGRADED or not self.watch.hidden_zero(sizes[1], t, x):
            self._sunk = None
            return False
        if self._sunk is None:
            slope = (sizes[0] - sizes[1]) / abs(t - instants[0])
            ahead = sizes[1] / slope if slope > 0 else 0.0
            self._sunk = (t + np.copysign(ahead, t - instants[0]), ahead, x)
        crossing, ahead, at = self._sunk
        if abs(t - crossing) < LINGERS * ahead or (t - crossing) * (t - instants[0]) < 0:
            return False
        if self.watch.chart_only(sizes[1], t, x):
            return False
        self._suspect = (crossing, at, "a pivot stays at zero")
        return True

    def _pivot(self, i, t, dense):
        return self.f(t, dense(t), self.p)[self.n_x + i]

    def _root(self, i, a, b, dense):
        from scipy.optimize import brentq

        return brentq(lambda s: self._pivot(i, s, dense), a, b, xtol=1e-14)

    def _minimum(self, i, instants, dense, a, b):
        from scipy.optimize import minimize_scalar

        low, high = min(a, b), max(a, b)
        found = minimize_scalar(lambda s: abs(self._pivot(i, s, dense)), bounds=(low, high), method="bounded",
                                options={"xatol": 1e-10 * max(high - low, 1e-12)})  # fmt: skip
        candidates = [*instants, float(found.x)]
        best = min(candidates, key=lambda s: abs(self._pivot(i, s, dense)))
        return best, abs(self._pivot(i, best, dense)) / self.watch.reference[i]

    def _candidate(self, i, t, dense, why):
        """A pivot vanishes at t: the program is singular there, or only the choice of pivots is."""
        x = dense(t)
        if self.watch.chart_only(0.0, t, x) and self.watch.rank_measure(t, x) > DEGRADED:
            self._must_repivot = True
            return False
        self._suspect = (t, x, why)
        return True

    def _failed(self, t, x, message):
        if self.watch.lost(t, x):
            self.motion.stop = self.watch.singular(t, x, "the step of the integrator shrinks to nothing")
        else:
            self.motion.stop = IntegrationStopped(
                f"{self.method} stopped at t = {t:.7g} s: {message or 'the state is no longer finite'}.",
                "A motion is integrated as far as its solution exists.",
                nearest=f"The motion before t = {t:.6g} s, which is kept.",
                do="Loosen rtol, take a method for stiff equations (Radau), or see whether the motion escapes.",
                t=float(t),
            )

    def _last(self, t, x):
        """Record the last state that stands, whatever was asked for; not so near a singularity that γ^(s̄) is lost."""
        if self.watch.rank_measure(t, x) > VANISHING:
            self.motion.add(self.model, [t], x[:, None], self._top(t, x)[:, None])

    def _sample(self, t, dense, x):
        """Record the samples that are pending up to t."""
        times, states = [], []
        while self.pending and (self.pending[0] <= t if self.forward else self.pending[0] >= t):
            s = self.pending.pop(0)
            y = x if s == t and x is not None else dense(s)
            if self.projector is not None and (x is None or s != t):
                y = self.projector(s, y)
            times.append(s)
            states.append(y)
        if times:
            states = np.array(states).T
            top = np.array([self._top(s, y) for s, y in zip(times, states.T, strict=True)]).T
            self.motion.add(self.model, times, states, top)
