"""Minimal coordinates: as many values are integrated as the program leaves free; the others are solved for.

At level j the invariants ψ_a^(j-o_a) = 0 of all rows of order o_a <= j determine as many components of γ^(j) as there
are rows (at level 0, with the invariants of the kinematics, components of q). The others, Σ o_a in all, are integrated.
Pivoted QR chooses them, and chooses again when the choice degrades. Nothing is left to drift.
"""

from copy import copy

import numpy as np

from servoctl.errors import IntegrationStopped
from servoctl.reduction.ranks import equilibrate
from servoctl.values import frozen

REACH = 2.0  # speed of the solved values relative to the integrated ones, above which the choice is reconsidered
BETTER = 2.0  # factor by which another choice must be slower
GROWN = 10.0  # growth of a slope after which sizes are updated
ITERATIONS, HALVINGS = 12, 40
CONVERGED = 1e-10  # relative: the Newton step after which the next is below rounding
STALLED, SHRINKS = 1e-7, 0.3  # relative: steps below this that do not shrink to this part of the last are rounding


class Sizes:
    """Usual sizes of the entries of X, and factors that make the columns of the invariants' Jacobian comparable.

    They come from the points where ranks were decided, which lie about the guess in all directions: at one state a
    column may vanish by chance. Along a motion they grow.

    Parameters
    ----------
    model : Model
        As it was derived: the points of its variants lie near one state.

    Attributes
    ----------
    columns, usual : (n_x,) arrays
    """

    def __init__(self, model):
        top, points = model.reduction.top, model.reduction.points
        x = np.vstack([points.jet(k) for k in range(top)]).astype(float)
        m = len(model.invariant_names())
        y = model.function("invariants").grid(np.asarray(points.t, dtype=float), x, model.parameters)[m:]
        self._blocks, self._x = levels(model), np.zeros(len(x))
        self._slopes, self._names = np.zeros((m, len(x))), model.invariant_names()
        self.columns, self.usual = np.ones(len(x)), np.ones(len(x))
        self.grow(model, np.abs(x).max(axis=1), np.nan_to_num(np.abs(y)).max(axis=1).reshape(len(x), m).T)

    def grow(self, model, x, slopes):
        """Take in a state X and the Jacobian (m, n_x) of a model's invariants there, if these are the same."""
        grown = np.all(np.isfinite(slopes)) and model.invariant_names() == self._names
        if not grown or not np.any(np.abs(slopes) > GROWN * self._slopes):
            return
        self._x, self._slopes = np.maximum(np.abs(x), self._x), np.maximum(np.abs(slopes), self._slopes)
        self.columns, self.usual = np.ones(len(x)), np.ones(len(x))
        for rows, columns in self._blocks:
            scale = equilibrate(self._slopes[np.ix_(rows, columns)])[2].astype(float)
            self.columns[columns] = scale
            self.usual[columns] = scale * (self._x[columns] / scale).max()


def levels(model):
    """Indices of the invariants and of the entries of X at each level."""
    rows = np.array([level for level, _ in model.invariant_names()], dtype=int)
    entries = np.repeat(np.arange(model.reduction.top), [model.nq, *[model.n] * (model.reduction.top - 1)])
    return [(np.flatnonzero(rows == j), np.flatnonzero(entries == j)) for j in range(model.reduction.top)]


class Chart:
    """The entries of the state X that are integrated, and the others as functions of them.

    Parameters
    ----------
    model : Model
    sizes : Sizes
    t : float
    x : (n_x,) array
        The state where the entries are chosen first.

    Attributes
    ----------
    free, solved : (n,) arrays of int
        Indices of the integrated and of the solved entries.
    """

    def __init__(self, model, sizes, t, x):
        self.ode, self.p = model.function("ode"), model.parameters
        self._invariants, self._model = model.function("invariants"), model
        self.n_x, self.m = len(model.state_names), len(model.invariant_names())
        self.blocks, self.sizes = levels(model), sizes
        self._grow(t, x)
        self.choose(t, x)

    def _grow(self, t, x):
        slopes = self._invariants(t, x, self.p)[self.m :].reshape(self.n_x, self.m).T
        self.sizes.grow(self._model, x, slopes)
        self.columns, self.usual = self.sizes.columns, self.sizes.usual

    def invariants(self, t, x):
        """Values (m,) and Jacobian (m, n_x) of the invariants, columns and rows scaled."""
        y = self._invariants(t, x, self.p)
        jacobian = y[self.m :].reshape(self.n_x, self.m).T * self.columns
        rows = np.abs(jacobian).max(axis=1, initial=0.0)
        rows = np.where(rows > 0, rows, 1.0)
        return y[: self.m] / rows, jacobian / rows[:, None]

    def choose(self, t, x):
        """Choose the entries to be integrated: those that pivoted QR leaves over at each level."""
        from scipy.linalg import qr

        _, jacobian = self.invariants(t, x)
        solved = [
            columns[qr(jacobian[np.ix_(rows, columns)], mode="r", pivoting=True)[1][: len(rows)]]
            for rows, columns in self.blocks
            if len(rows)
        ]
        self.solved = np.sort(np.concatenate([*solved, np.zeros(0, dtype=int)])).astype(int)
        self.free = np.setdiff1d(np.arange(self.n_x), self.solved)
        self.sign = np.linalg.slogdet(jacobian[:, self.solved])[0]

    def reach(self, t, x):
        """How many times as fast as the integrated values the solved ones move, at most, at their own level."""
        _, jacobian = self.invariants(t, x)
        largest = 0.0
        for rows, columns in self.blocks:
            solved, free = (np.intersect1d(columns, which) for which in (self.solved, self.free))
            if len(rows) and len(free):
                try:
                    slopes = np.linalg.solve(jacobian[np.ix_(rows, solved)], jacobian[np.ix_(rows, free)])
                except np.linalg.LinAlgError:
                    return np.inf
                largest = max(largest, float(np.abs(slopes).max()))
        return largest

    def improved(self, t, x):
        """Choose again where the choice has degraded and another is better; whether it was changed."""
        self._grow(t, x)
        before = self.reach(t, x)
        if before <= REACH:
            return False
        old = self.free, self.solved, self.sign
        self.choose(t, x)
        if self.reach(t, x) * BETTER < before:
            return True
        self.free, self.solved, self.sign = old
        return False

    def lift(self, t, y, near):
        """The state X with the integrated values y, by Newton's method from a state near by; nan where it fails."""
        x = np.array(near, dtype=float)
        x[self.free] = y
        columns, last = self.columns[self.solved], np.inf
        for _ in range(ITERATIONS):
            values, jacobian = self.invariants(t, x)
            matrix = jacobian[:, self.solved]
            try:
                step = np.linalg.solve(matrix, -values)
            except np.linalg.LinAlgError:
                break
            x[self.solved] += columns * step
            size = np.abs(columns * step / np.maximum(np.abs(x), self.usual)[self.solved]).max(initial=0.0)
            if not np.isfinite(size):
                break
            if size <= CONVERGED or SHRINKS * last < size <= STALLED:
                return x if np.linalg.slogdet(matrix)[0] == self.sign else np.full(self.n_x, np.nan)
            last = size
        return np.full(self.n_x, np.nan)

    @np.errstate(all="ignore")
    def lift_all(self, t, y, near):
        """The same at times t (N,) for values y (f, N) and states near by (n_x, N): states (n_x, N)."""
        x, size = np.array(near, dtype=float), np.full(len(t), np.inf)
        x[self.free] = y
        for _ in range(ITERATIONS):
            slopes = self._invariants.grid(t, x, self.p).T
            values, matrices = slopes[:, : self.m], slopes[:, self.m :].reshape(len(t), self.n_x, self.m).swapaxes(1, 2)
            matrices = (matrices * self.columns)[:, :, self.solved]
            try:
                steps = np.linalg.solve(matrices, -values[:, :, None])[:, :, 0].T
            except np.linalg.LinAlgError:
                break
            x[self.solved] += self.columns[self.solved, None] * steps
            sizes = np.maximum(np.abs(x[self.solved]), self.usual[self.solved, None])
            size = np.abs(self.columns[self.solved, None] * steps / sizes).max(axis=0, initial=0.0)
            if not np.any(size > CONVERGED):
                break
        for i in np.flatnonzero(~(size <= CONVERGED) | (np.linalg.slogdet(matrices)[0] != self.sign)):
            x[:, i] = self.lift(t[i], y[:, i], near[:, i])
        return x

    def rates(self, t, x):
        """y' at a state."""
        return self.ode(t, x, self.p)[self.free]

    def jacobian(self, t, x):
        """∂y'/∂y at a state: ∂X'/∂X along the invariants."""
        slopes = self._model.function("ode_jacobian")(t, x, self.p).reshape(self.n_x, self.n_x).T
        _, rows = self.invariants(t, x)
        tangent = np.zeros((self.n_x, len(self.free)))
        tangent[self.free, np.arange(len(self.free))] = 1.0
        moved = np.linalg.solve(rows[:, self.solved], rows[:, self.free] / self.columns[self.free])
        tangent[self.solved] = -self.columns[self.solved, None] * moved
        return slopes[self.free] @ tangent

    def weakest(self, t, x, span, tableau, pivot):
        """Where a pivot is least within a span from a state: t, X and its size there, zero where X ends to exist.

        Parameters
        ----------
        t, x, span : float, (n_x,) array, float
        tableau : tuple
        pivot : int
            Its place among those that "ode" logs.
        """
        from scipy.optimize import minimize_scalar

        def state(part):
            return self._step(t, x, part * span, *tableau)

        def size(part):
            return np.nan_to_num(abs(self.ode(t + part * span, state(part), self.p)[self.n_x + pivot]))

        least = minimize_scalar(size, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-12})
        part = least.x
        if not np.all(np.isfinite(state(part))):
            part, beyond = 0.0, least.x
            while beyond - part > 1e-12:
                middle = (part + beyond) / 2
                part, beyond = (middle, beyond) if np.all(np.isfinite(state(middle))) else (part, middle)
        return t + part * span, state(part), least.fun

    def steps(self, t0, x, h, count, tableau):
        """Explicit Runge-Kutta steps, fewer than `count` where no state is found.

        Returns
        -------
        states : (n_x, N + 1) array
        changed : (N,) array of bool
            Before which steps the choice was changed.
        """
        x = self.lift(t0, x[self.free], x)
        states, changed = [x], []
        for i in range(count):
            t = t0 + i * h
            change = self.improved(t, x)
            x = self._step(t, x, h, *tableau)
            if not np.all(np.isfinite(x)):
                break
            states.append(x)
            changed.append(change)
        return np.array(states).T, np.array(changed, dtype=bool)

    def _step(self, t, x, h, a, b, c):
        y, slopes, near = x[self.free], np.zeros((len(b), len(self.free))), x
        for i in range(len(b)):
            near = self.lift(t + c[i] * h, y + h * (a[i, :i] @ slopes[:i]), near)
            slopes[i] = self.rates(t + c[i] * h, near)
        return self.lift(t + h, y + h * (b @ slopes), near)


class MinimalSolver:
    """One of scipy's one-step methods on minimal coordinates; like scipy's solvers it has t, y, status and step().

    Parameters
    ----------
    solver : callable
        Solver of scipy for (y', t, y, ∂y'/∂y), with options by keyword.
    chart : Chart
    t : float
    x : (n_x,) array
    """

    def __init__(self, solver, chart, t, x):
        self._new, self.chart = solver, chart
        self.changes, self.done, self.lost = 0, np.zeros(3, dtype=int), False
        self.t, self.y = t, chart.lift(t, x[chart.free], x)
        self._start()

    def _start(self, **options):
        self.solver = self._new(self._rates, self.t, self.y[self.chart.free], self._jacobian, **options)

    def _jacobian(self, t, y):
        return self.chart.jacobian(t, self._lift(t, y))

    def _lift(self, t, y):
        return self.chart.lift(t, y, self.y)

    def _rates(self, t, y):
        return self.chart.rates(t, self._lift(t, y))

    @property
    def status(self):
        """Status of scipy's solver; "failed" where even the shortest step leads to no state."""
        return "failed" if self.lost else self.solver.status

    @property
    def t_bound(self):
        """The end of the integration [s]."""
        return self.solver.t_bound

    @property
    def work(self):
        """(nfev, njev, nlu) over all choices of coordinates."""
        return self.done + (self.solver.nfev, self.solver.njev, self.solver.nlu)

    def step(self):
        """One step, after a change of coordinates where one is due; halved as long as its end has no state X."""
        if self.chart.improved(self.t, self.y):
            self.done, self.changes = self.work, self.changes + 1
            self._start()
        for _ in range(HALVINGS):
            message = self.solver.step()
            if self.solver.status == "failed":
                break
            self._dense, length = self.solver.dense_output(), self.solver.t - self.t
            middle = self._lift(self.t + length / 2, self._dense(self.t + length / 2))
            if np.all(np.isfinite(middle)):
                self._before = self.t, self.y
                self.t, self.y = self.solver.t, self.chart.lift(self.solver.t, self.solver.y, middle)
                break
            self.done = self.work
            self._start(first_step=abs(length) / 2)
        else:
            self.lost, message = True, "Newton's method finds no solution of the constraints"
        return message

    def dense_output(self):
        """X as a function of times (N,) within the last step."""
        return Dense(copy(self.chart), self._dense, (*self._before, self.t, self.y))


@frozen
class Dense:
    """States within a step from (t0, x0) to (t1, x1), solved from its dense output for the integrated values."""

    chart: Chart
    inner: object
    ends: tuple

    def __call__(self, times):
        """States (n_x, N)."""
        (t0, x0, t1, x1), times = self.ends, np.asarray(times)
        near = x0[:, None] + (times - t0) * ((x1 - x0) / (t1 - t0))[:, None]
        states = self.chart.lift_all(times, self.inner(times), near)
        failed = np.flatnonzero(~np.all(np.isfinite(states), axis=0))
        if not len(failed):
            return states
        t = float(times[failed[0]])
        raise IntegrationStopped(
            f"Newton's method finds no solution of the constraints at t = {t:.7g} s, within a step.",
            "The values that are not integrated are solved from the constraints.",
            do="Use a smaller rtol, or drift='project', which solves nothing within a step.",
            t=t,
        )

    def integrated(self, times):
        """The integrated values at their places (n_x, N), NaN at others."""
        states = np.full((len(self.ends[1]), len(times)), np.nan)
        states[self.chart.free] = self.inner(times)
        return states
