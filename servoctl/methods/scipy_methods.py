"""scipy's adaptive methods on compiled right-hand sides, with projection after their steps."""

import functools

import numpy as np

from servoctl.methods.bulk import BulkSteps
from servoctl.methods.choice import Project
from servoctl.methods.edges import edge
from servoctl.methods.pieces import AT_ONCE
from servoctl.methods.radau import Collocated, rates_at
from servoctl.methods.taylor import leave_if_unsuited

DEGREES = {"RK45": 4, "DOP853": 7, "Radau": 3, "LSODA": 12}  # of the polynomials of dense output
MANY, CREEPS = 200, 1e-5  # steps in which a motion near the edge of a domain passes this part of the span


@functools.cache
def nodes_of(method):
    """Chebyshev's nodes but 0 of the polynomials within a step from 0 to 1, and their `rates_at`."""
    degree = DEGREES[method]
    c = (1 - np.cos(np.pi * np.arange(1, degree + 1) / degree)) / 2
    return c, rates_at(c)


class ScipySteps(BulkSteps):
    """One integration by one of scipy's methods, `choice.SCIPY`.

    Where stability limits the steps, or there are many, the motion is left to the method `for_stiff`, if there is one.
    """

    advice = "Use a larger rtol or a method for stiff equations ('Radau'), or check whether the motion escapes."

    def __init__(self, model, method, drift, rtol, atol, progress, for_stiff=None):
        self.tolerances, self.for_stiff = (rtol, atol), for_stiff
        self.projects = isinstance(drift, Project)
        super().__init__(model, method, drift, progress)

    def _use(self, model):
        super()._use(model)
        name = f"{self.f.name}_jacobian"
        self.slopes = model.function(name) if self.method == "Radau" else None
        self.solver = None

    def _rates(self, t, x):
        return self.f(t, x, self.p)[: self.n_x]

    def _jacobian(self, t, x):
        return self.slopes(t, x, self.p).reshape(self.n_x, self.n_x).T

    def _begin(self, a, x, b):
        self.solver, self.most = None, 1
        self.taken, self.mark = 0, a

    def _retake(self, h):
        self.most = 1

    def _solver(self, a, x, b):
        import scipy.integrate

        rtol, atol = self.tolerances
        exact = {"jac": self._jacobian} if self.slopes is not None else {}
        return getattr(scipy.integrate, self.method)(self._rates, a, x, b, rtol=rtol, atol=atol, **exact)

    def _continued(self, t, x, b):
        """The solver that goes on from t, X = x towards b."""
        (first, last), s = self._beside(t, b), self.solver
        if s is None or s.status != "running" or s.t != first or s.t_bound != last or not np.array_equal(s.y, x):
            self.solver, self.counted = self._solver(first, x, last), np.zeros(3, dtype=int)
        return self.solver

    def _steps(self, t, x, b):
        solver, self.failure = self._continued(t, x, b), ""
        t, x, z, nodes = [t], [solver.y.copy()], [], nodes_of(self.method)
        while solver.status == "running" and len(z) < self.most:
            message = _step(solver)
            if solver.status == "failed" or not np.all(np.isfinite(solver.y)):
                self.failure = (message or "the state is no longer finite").rstrip(".")
                break
            inside = solver.t_old + nodes[0] * (solver.t - solver.t_old)
            z.append(solver.dense_output()(inside).T - x[-1])
            if self.projects and ((self.taken + len(z)) % self.drift.every == 0 or solver.status == "finished"):
                self._project()
            t.append(b if solver.t == solver.t_bound else solver.t)
            x.append(solver.y.copy())
        self._count(len(z))
        if 4 * len(z) >= AT_ONCE:  # blocks from the third on, after seven steps; the limit is that of a mode that
            # decays within each of them
            leave_if_unsuited(self, self.for_stiff, 1.0, np.array(t), x[-1], interpreted=True)
        self.most = min(2 * self.most, AT_ONCE)
        if not self.failure and self._creeps(len(z)):
            self.failure = "its steps shrink"
        return Collocated(
            np.array(t), np.array(x).T, bool(self.failure), nodes, np.reshape(z, (-1, len(nodes[0]), len(x[0])))
        )

    def _creeps(self, steps):
        """Whether the motion has stopped because it creeps towards the edge of a residual's domain."""
        before, self.taken = self.taken, self.taken + steps
        if self.taken // MANY == before // MANY:
            return False
        mark, self.mark = self.mark, self.solver.t
        near = abs(self.mark - mark) < CREEPS * self.length
        return near and edge(self.model, self.solver.t, self.solver.y)[0] != ""

    def _project(self):
        s = self.solver
        s.y = self.projection.restore(s.t, s.y, self.p)
        if hasattr(s, "f"):
            s.f = s.fun(s.t, s.y)
        self.motion.count(projections=1)

    def _work(self):
        """Evaluations, Jacobians and decompositions so far."""
        return np.array([self.solver.nfev, self.solver.njev, self.solver.nlu])

    def _count(self, steps):
        before, self.counted = self.counted, self._work()
        nfev, njev, nlu = self.counted - before
        self.motion.count(steps=steps, nfev=nfev, njev=njev, nlu=nlu)


def _step(solver):
    """One step; scipy raises ValueError for a Jacobian that is not finite."""
    try:
        with np.errstate(all="ignore"):
            return solver.step()
    except ValueError:
        solver.status = "failed"
        return "the Jacobian is not finite"
