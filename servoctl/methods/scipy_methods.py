"""scipy's adaptive methods on compiled right-hand sides, with projection after their steps."""

import numpy as np

from servoctl.methods.choice import MinimalCoordinates, Project
from servoctl.methods.minimal import Chart, MinimalSolver, Sizes
from servoctl.methods.monitor import FRACTIONS, DenseStretch, Fine
from servoctl.methods.motion import Stepping
from servoctl.methods.watch import End, edge

IMPLICIT = ("Radau", "BDF")
MANY, CREEPS = 200, 1e-5  # steps in which a motion near the edge of a domain passes this part of the span
SHORTENINGS, SHORTER = 8, 1e-2  # how often, and to which part, a step is shortened that errs by far
LONG = 4  # samples in a step that is checked at them
SPACING = 1e-3  # of a step, between the points by which its dense output is differentiated
OFF = 1e3  # times the tolerance, which the equations may add to a step


class ScipySteps(Stepping):
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

    advice = "Use a larger rtol or a method for stiff equations ('Radau'), or check whether the motion escapes."

    def __init__(self, model, method, drift, rtol, atol, progress):
        self.tolerances = rtol, atol
        self.sizes = Sizes(model) if isinstance(drift, MinimalCoordinates) else None
        super().__init__(model, method, drift, progress)

    def _use(self, model):
        super()._use(model)
        name = f"{self.f.name}_jacobian"
        self.slopes = model.function(name) if self.method in IMPLICIT else None
        self.restore = model.function("ode_projected").restore if isinstance(self.drift, Project) else None

    def _rates(self, t, x):
        return self.f(t, x, self.p)[: self.n_x]

    def _jacobian(self, t, x):
        return self.slopes(t, x, self.p).reshape(self.n_x, self.n_x).T

    def _solver(self, a, x, b, **first):
        import scipy.integrate

        rtol, atol = self.tolerances

        def solver(rates, t, y, jacobian, **options):
            exact = {"jac": jacobian} if self.slopes is not None else {}
            options |= first | exact
            return getattr(scipy.integrate, self.method)(rates, t, y, b, rtol=rtol, atol=atol, **options)

        if isinstance(self.drift, MinimalCoordinates):
            return MinimalSolver(solver, Chart(self.model, self.sizes, a, x), a, x)
        return solver(self._rates, a, x, self._jacobian)

    def _piece(self, a, x, b, times):
        self.pending, self.forward = np.asarray(times), 1.0 if b >= a else -1.0
        solver, steps, outcome, shortened = self._begun(a, x, b), 0, Fine(0), 0
        while solver.status == "running":
            t, x = solver.t, solver.y.copy()
            if not self._stepped(solver, t, x):
                break
            steps, dense = steps + 1, solver.dense_output()
            if self._repeats(t, solver.t, dense):
                solver = self._shortened(solver, t, x, b)
                continue
            outcome = self._inspected(self._stretch(t, x, solver, dense))
            if isinstance(outcome, Fine):
                if self.restore is not None and (steps % self.drift.every == 0 or solver.status == "finished"):
                    self._project(solver)
                self._sample(solver.t, dense, solver.y)
                self.progress(solver.t)
                if steps % MANY or not self._creeps(solver):
                    continue
                break
            if isinstance(outcome, End):
                if outcome.error and t == a and shortened < SHORTENINGS:
                    solver, shortened = self._shortened(solver, t, x, b), shortened + 1
                    continue
                self._sample(outcome.t, dense, outcome.x)
                self._turn(outcome, b)
                break
            t, x = (solver.t, solver.y) if outcome.steps else (t, x)
            goes_on = self._follow(outcome)
            # A step in which a pivot vanishes is sampled with the next pivots: its own lose digits near the zero.
            if outcome.steps:
                self._sample(t, dense, x)
            if not goes_on:
                self._keep_last(t, x)
                break
            self._count(solver)
            solver = self._solver(t, x, b)
        self._count(solver)
        self.motion.count(steps=steps)
        return (solver.t, solver.y) if isinstance(outcome, Fine) else (outcome.t, outcome.x)

    def _creeps(self, solver):
        """Whether the motion has stopped because it creeps towards the edge of a residual's domain."""
        before, self.mark = self.mark, solver.t
        why = edge(self.model, solver.t, solver.y) if abs(solver.t - before) < CREEPS * self.watch.span else ""
        if why:
            self._fail(solver.t, solver.y, f"its steps shrink; {why}")
        return bool(why)

    def _begun(self, t, x, b):
        """The solver of a piece."""
        self.mark, self.tried = t, (t, 0)
        self.monitor.begin(self._pivots(t, x))
        self.watch.begin(t)
        self._sample(t, None, x)
        return self._solver(t, x, b)

    def _shortened(self, solver, t, x, b):
        """A solver with a shorter first step: from rest scipy's may be as long as the span, and pass its error test."""
        length = abs(solver.t - t)
        self._count(solver)
        self.monitor.begin(self._pivots(t, x))
        return self._solver(t, x, b, first_step=SHORTER * length)

    def _stepped(self, solver, t, x):
        """Whether a step from t, X = x succeeds; the motion stops if not."""
        message = _step(solver)
        if solver.status != "failed" and np.all(np.isfinite(solver.y)):
            return True
        self._fail(t, x, (message or "the state is no longer finite").rstrip("."))
        self._keep_last(t, x)
        return False

    def _repeats(self, t, end, dense):
        """Whether a step from t is repeated, since a shorter one may meet the equations."""
        self.tried = t, self.tried[1] + 1 if self.tried[0] == t else 0
        return self.tried[1] < SHORTENINGS and self._doubted(t, end, dense)

    def _doubted(self, t, end, dense):
        """Whether a long step does not meet the equations at the samples within it.

        Its stages know nothing of what is flat at all of them, such as a narrow bump.
        """
        if self.sizes is not None:
            return False
        times = self.pending[: self._due(end)]
        times = times[(times != t) & (times != end)]
        if len(times) < LONG:
            return False
        h = end - t
        x = dense(times)
        two, one, next_one, next_two = (dense(times + k * SPACING * h) for k in (-2, -1, 1, 2))
        change = (8 * (next_one - one) - (next_two - two)) / (12 * SPACING)
        with np.errstate(all="ignore"):
            error = np.abs(h * self.f.grid(times, x, self.p)[: self.n_x] - change)
            rtol, atol = self.tolerances
            allowed = OFF * (atol + rtol * np.maximum(np.abs(x).max(axis=1), np.abs(change).max(axis=1)))
            return bool(np.any(error > allowed[:, None]))

    def _stretch(self, t, x, solver, dense):
        """The last step for the monitor: it has passed its error test, and the next begins where it ends."""
        inside = [t + s * (solver.t - t) for s in FRACTIONS]
        pivots = np.array([*(self._pivots(s, dense(s)) for s in inside), self._pivots(solver.t, solver.y)]).T
        self.motion.count(watched=len(inside) + 1)
        return DenseStretch(
            np.array([t, solver.t]),
            np.column_stack([x, solver.y]),
            pivots[:, None],
            self._top,
            crosses=True,
            dense=lambda k, s: dense(s),
            pivots_at=self._pivots,
        )

    def _project(self, solver):
        solver.y = self.restore(solver.t, solver.y, self.p)
        if hasattr(solver, "f"):
            solver.f = solver.fun(solver.t, solver.y)
        self.motion.count(projections=1)

    def _count(self, solver):
        minimal = isinstance(solver, MinimalSolver)
        work = solver.work if minimal else (solver.nfev, solver.njev, solver.nlu)
        self.motion.count(**dict(zip(("nfev", "njev", "nlu"), work, strict=True)))
        if minimal:
            self.motion.counters["integrated"] = len(solver.chart.free)
            self.motion.count(coordinate_changes=solver.changes)

    def _sample(self, t, dense, x):
        """Record the pending samples up to t, the end of a step with state x; `dense` interpolates within it."""
        due = self._due(t)
        times, self.pending = self.pending[:due], self.pending[due:]
        if not due:
            return
        if self.sizes is None and due > 1:
            states = dense(times)
        else:
            states = np.array([x if s == t else dense(s) for s in times]).T
        states[:, times == t] = x[:, None]
        if self.restore is not None:
            for i in np.flatnonzero(times != t):
                states[:, i] = self.restore(times[i], states[:, i], self.p)
        top = self.f.grid(times, states, self.p)[self.n_x - self.model.n : self.n_x]
        self.motion.add(self.model, times, states, top)

    def _due(self, t):
        """The number of pending samples up to t."""
        return int(np.searchsorted(self.forward * self.pending, self.forward * t, "right"))


def _step(solver):
    """One step; scipy raises ValueError for a Jacobian that is not finite."""
    try:
        with np.errstate(all="ignore"):
            return solver.step()
    except ValueError:
        getattr(solver, "solver", solver).status = "failed"
        return "the Jacobian is not finite"
