"""CVODES and IDAS of SUNDIALS, through CasADi: independent integrators for comparison."""

from dataclasses import dataclass

import numpy as np

from servoctl.errors import IntegrationStopped
from servoctl.methods.drift import Poles
from servoctl.methods.radau import InBulk
from servoctl.methods.sundials_solver import MOST_STEPS, sundials_solver

WATCHED = 1000  # intervals of a span at whose ends pivots are looked at, beside the samples


@dataclass(frozen=True)
class Grid:
    """A motion on a grid t (S + 1,): states and rates (n_x, S + 1), cubics between them; whether it failed after it."""

    t: np.ndarray
    x: np.ndarray
    rates: np.ndarray
    failed: bool

    def at(self, k, times):
        """States (n_x, N) at times (N,) between instants k and k + 1."""
        theta = (times - self.t[k]) / (self.t[k + 1] - self.t[k])
        return self._cubic(theta, *(v[:, [i]] for v in (self.x, self.rates) for i in (k, k + 1)), np.diff(self.t)[k])

    def within(self, theta):
        """States (n_x, S, N) at fractions theta (N,) of all intervals."""
        ends = (v[:, part, None] for v in (self.x, self.rates) for part in (slice(None, -1), slice(1, None)))
        return self._cubic(theta, *ends, np.diff(self.t)[:, None])

    @staticmethod
    def _cubic(s, x0, x1, slope0, slope1, h):
        """Hermite's polynomial of degree 3."""
        rise = (3.0 - 2.0 * s) * s**2
        return x0 + rise * (x1 - x0) + h * s * (1.0 - s) * ((1.0 - s) * slope0 - s * slope1)


class SundialsMethod(InBulk):
    """One integration by CVODES, or by IDAS on the rows before elimination.

    Parameters
    ----------
    model : Model
    method : {"CVODES", "IDAS"}
    drift : None or Poles
    rtol, atol : float
    span : float
        Length of the integration [s].
    progress : callable
    """

    def __init__(self, model, method, drift, rtol, atol, span, progress):
        self.resolution = abs(span) / WATCHED
        super().__init__(model, method, drift, rtol, atol, progress)

    def _use(self, model):
        super()._use(model)
        self.solver = sundials_solver(model, self.method, isinstance(self.drift, Poles))

    def _begin(self, a, x, b):
        """Nothing to prepare."""

    def _steps(self, t, x, b):
        direction = np.sign(b - t)
        marks = np.linspace(t, b, 2 + int(abs(b - t) / self.resolution))
        grid = np.unique(direction * np.concatenate([marks, self.pending]))
        grid = direction * grid[(grid >= direction * t) & (grid <= direction * b)]
        states, counts = self.solver.run(grid, x, self._top(t, x), self.p, self.rtol, self.atol)
        self.motion.count(**counts)
        t, failed = grid[: states.shape[1]], states.shape[1] < len(grid)
        return Grid(t, states, self.f.grid(t, states, self.p)[: self.n_x], failed)

    def _failed(self, t, x, message):
        if self.watch.lost(t, x):
            self.motion.stop = self.watch.singular(t, x, "the integrator finds no further step")
            return
        self.motion.stop = IntegrationStopped(
            f"{self.method} stopped at t = {t:.7g} s: no step succeeds, or {MOST_STEPS:,} reach no further sample.",
            "A motion is integrated as far as its solution exists and steps can be solved.",
            nearest=f"The motion before t = {t:.6g} s, which is kept.",
            do="Loosen rtol, give more t_eval, take 'RadauIIA', or see whether the motion escapes.",
            t=float(t),
        )
