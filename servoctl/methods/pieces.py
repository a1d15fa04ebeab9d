"""What ends a smooth piece of a motion, and what the tolerances of its state allow in functions of it."""

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.jets.branches import size_of_terms
from servoctl.methods.sizes import state_levels
from servoctl.values import frozen

LEAVES = 1e3  # times its tolerance: a residual beyond it differs from zero
DEFAULT = 1e-9, 1e-11  # rtol and atol that judge steps of fixed length
FIXED_STEPS = 1e3  # times the default tolerances, by which steps without tolerances may err
LEAST_RTOL, LEAST_ATOL = 1e-12, 1e-14  # rounding of residuals: smaller tolerances are not resolved
AT_ONCE = 16  # steps in Python that are inspected together, at most
RESOLUTION = 1000  # instants of a span, at least, at which functions of the motion are inspected within steps


@frozen
class End:
    """The smooth piece ends at t [s], X = x, in the step after `steps` whole ones."""

    steps: int
    t: float
    x: np.ndarray
    switched: tuple = ()  # indices of the switches that the motion crosses there; none where it stops
    branches: tuple = ()  # all branches beyond
    error: object = None  # why it stops: a ServoError or None
    event: str = ""  # the terminal event that ends the motion there


def net(t, distance, least):
    """Instants within steps with ends t (S + 1,), in at least so many equal parts, no longer than a distance [s].

    Returns their steps (N,); the instants (N,) in the order of the motion, ends of steps included [s]; and whether they
    are ends of the least parts, which all steps have, (N,).
    """
    h = np.diff(t)
    parts = least * np.maximum(np.ceil(np.abs(h) / (least * distance)), 1).astype(int)
    k, last = np.repeat(np.arange(len(h)), parts), np.cumsum(parts) - 1
    j = 1 + np.arange(len(k)) - np.repeat(last - parts + 1, parts)
    at = t[k] + h[k] * (j / parts[k])
    at[last] = t[1:]
    return k, at, j * least % parts[k] == 0


def least_between(t, values):
    """Where values (m, N) at times t (N,) have a least one between two neighbours, and the vertex of a parabola there.

    The vertex is that of the parabola through the three, NaN or infinite where they lie on a line. Both are (m, N - 2).
    """
    before, here, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
    with np.errstate(all="ignore"):
        left, right = (here - before) / (t[1:-1] - t[:-2]), (after - here) / (t[2:] - t[1:-1])
        bend = (right - left) / (t[2:] - t[:-2])
        vertex = here - (left + bend * (t[1:-1] - t[:-2])) ** 2 / (4 * bend)
    return (here <= before) & (here <= after) & (bend > 0), vertex


class Tolerance:
    """The tolerances of the state along a motion from x0 (n_x,), and of functions of it; atol is a number or (n_x,)."""

    def __init__(self, model, x0, rtol, atol):
        self.rtol, atol = max(rtol, LEAST_RTOL), np.maximum(atol, LEAST_ATOL)
        self.levels = state_levels(model)
        self.atol = np.broadcast_to(atol, len(self.levels))[:, None]
        self.sizes, self.x0 = np.zeros(len(self.levels)), np.where(self.levels == 0, x0, 0.0)[:, None]

    def of(self, slopes, x):
        """Tolerances (m, N) of functions with derivatives (m, n_x, N) in X = x (n_x, N) along the motion."""
        return np.einsum("mxn,xn->mn", np.abs(slopes), self.states(x))

    def states(self, x):
        """Tolerances (n_x, N) of states x (n_x, N) along the motion."""
        return self.atol + self.rtol * self._sizes(x)

    def accept(self, x):
        """Take in states (n_x, N) as part of the motion."""
        self.sizes = self._sizes(x)[:, -1]

    def _sizes(self, x):
        """The largest size of each entry's level so far, (n_x, N): of q its way from x0, or rounding."""
        sizes = np.fmax(np.abs(x - self.x0), LEAST_RTOL / self.rtol * np.abs(x))
        sizes = np.fmin(np.fmax(sizes, self.sizes[:, None]), np.finfo(float).max)
        first = np.searchsorted(self.levels, range(self.levels[-1] + 1))
        return np.maximum.accumulate(np.maximum.reduceat(sizes, first)[self.levels], axis=1)


def residuals(model, tolerance, t, x):
    """Residuals of all levels of the state at times t (N,) and states x (n_x, N), and their tolerances, (m, N) each.

    The tolerance of a residual is |∂ψ/∂X| (atol + rtol |X|).
    """
    y = model.function("invariants").grid(t, x, model.p)
    m = len(y) // (1 + len(x))
    slopes = y[m:].reshape(len(x), m, len(t)).swapaxes(0, 1)
    return y[:m], tolerance.of(slopes, x)


def terms_of(model):
    """The sum of the magnitudes of each residual's terms, as a function of (t, X, p)."""

    def build():
        e = model.equations
        sizes = [size_of_terms(ca.densify(expression)) for _, _, expression in e.invariant_rows]
        return compiled(e.function("terms", e.state, sizes), "terms")

    return model.once("terms", build)


def row_of(model, level):
    """The name of the row of which a level of the invariants is a rate; None for a row itself."""
    return next((row.name for row in model.reduction.rows if level.endswith(f"({row.name})")), None)
