"""Radau IIA methods for stiff motions: tableaus, the compiled steps with exact Jacobians, and their integration."""

import ctypes
import functools

import numpy as np

from servoctl.codegen.function import compiled
from servoctl.codegen.loops import ROUNDING
from servoctl.codegen.native import pointer
from servoctl.errors import SpecificationError
from servoctl.methods.bulk import BulkSteps, Steps
from servoctl.methods.choice import RADAU_ORDERS, Project
from servoctl.methods.motion import equal_steps
from servoctl.values import frozen

LEAST_RTOL = {5: 1e-4, 9: 1e-7}  # rtol above which an order needs less work than the next
NEWTON_TOLERANCE = 1e-2  # of the Newton iteration, relative to the tolerance of a step
TIGHT, PATIENT = 1e-4, 3  # the same for fixed steps, and the factor of iterations that they may take
NEWTON_ITERATIONS = {5: 7, 9: 12, 13: 17}  # at most, by order (Hairer and Wanner 1999)
STAGES = {5: 3, 9: 5, 13: 7}  # all L-stable; for an odd number of stages A has one real eigenvalue


@functools.cache
def radau(order):
    """The Radau IIA method of order 5, 9 or 13: c, A⁻¹, T, T⁻¹, μ and e (Hairer and Wanner 1996, IV.5 and IV.8).

    c (s,) are the nodes, the last of which is 1. A⁻¹ (s, s) maps increments of the stages to h times their rates (the
    collocation polynomial's derivative). T (s, s) has the real and imaginary parts of its eigenvectors as columns, and
    μ ((s + 1)/2, 2) those of its eigenvalues as rows: the real one, then one of each pair. e (s,) are the weights of
    the increments in the error of the embedded method of order s.
    """
    from scipy.special import roots_jacobi

    s = STAGES[order]
    c = np.append((1.0 + roots_jacobi(s - 1, 1.0, 0.0)[0]) / 2.0, 1.0)
    rate = rates_at(c)
    values, vectors = np.linalg.eig(rate)
    real = np.argmin(np.abs(values.imag))
    pairs = [i for i in np.argsort(values.imag) if values[i].imag > 1e-6]
    columns = [vectors[:, real].real, *(part for i in pairs for part in (vectors[:, i].real, vectors[:, i].imag))]
    from_pairs = np.array(columns).T
    mu = np.array([[values[real].real, 0.0], *([values[i].real, -values[i].imag] for i in pairs)])
    # The embedded quadrature has the weight 1/mu_0 at the start and is of order s: what it adds to the weights b_i,
    # times A⁻¹; scaled so that (mu_0/h - J)⁻¹ (f + sum e_i z_i / h) is the error.
    powers = np.vander(c, s, increasing=True).T
    e = mu[0, 0] * np.linalg.solve(powers, np.append(-1.0 / mu[0, 0], np.zeros(s - 1))) @ rate
    return c, rate, from_pairs, np.linalg.inv(from_pairs), mu, e


def rates_at(c):
    """What maps values (s,) at nodes c, of a polynomial that is 0 at 0, to its derivatives there, (s, s)."""
    nodes = np.append(0.0, c)
    gaps = nodes[:, None] - nodes + np.eye(len(nodes))
    weights = 1.0 / gaps.prod(axis=1)
    derivative = weights / weights[:, None] / gaps
    derivative[np.diag_indices(len(nodes))] = (1.0 / gaps).sum(axis=1) - 1.0
    return derivative[1:, 1:]


def basis(c, theta):
    """Lagrange polynomials of the nodes c, and 0, at theta (N,): an (s, N) array."""
    return lagrange(np.append(0.0, c), theta)[1:]


def lagrange(nodes, theta):
    """Lagrange polynomials of nodes (s,) at theta (N,): an (s, N) array."""
    own = np.eye(len(nodes), dtype=bool)
    gaps = nodes[:, None] - nodes + own
    return np.where(own[:, :, None], 1.0, (theta - nodes[:, None]) / gaps[:, :, None]).prod(axis=1)


def radau_order(rtol):
    """The order of least work for a tolerance."""
    return next((order for order, least in LEAST_RTOL.items() if rtol > least), RADAU_ORDERS[-1])


def radau_loop(model, poles=False):
    """The compiled X' of a model, whose library holds the loop over Radau IIA steps; with error dynamics if `poles`."""

    def build():
        e = model.equations
        name, others = "RadauIIA_poles" if poles else "RadauIIA", {"jacobian": e.ode_jacobian(poles)}
        return compiled(e.ode(poles), name, ("radau",), e.project(), others)

    return model.once("RadauIIA with poles" if poles else "RadauIIA", build)


@frozen
class Settings:
    """How Radau IIA steps are taken."""

    order: int  # 5, 9 or 13
    rtol: float  # of each entry of the state, for the error of the embedded method of order s
    atol: float  # the same
    fixed: bool = False  # whether all steps have the length of the first
    project_every: int = 0  # steps between projections; 0 for none

    @property
    def iterations(self):
        """The most iterations of Newton's method in a step."""
        return NEWTON_ITERATIONS[self.order] * (PATIENT if self.fixed else 1)

    @property
    def tolerance(self):
        """The tolerance of Newton's method, relative to that of a step."""
        return max(TIGHT if self.fixed else NEWTON_TOLERANCE, 10 * ROUNDING / self.rtol)


def radau_steps(f, t0, x0, t1, p, h, settings, max_steps):
    """Radau IIA steps from x0 (n_x,) at t0 towards t1 [s], the first of length h > 0 [s]; f is from `radau_loop`.

    Returns t (S + 1,), starts of steps and the end of the last [s], which lies before t1 if steps vanish or `max_steps`
    do not suffice; states (n_x, S + 1) there; increments (S, s, n_x) of the stages; the length that the next step
    should have [s]; and counts (4,) of rejected steps, evaluations of X', of the Jacobian, and decompositions.
    """
    parts, n = radau(settings.order), len(x0)
    s, table = len(parts[0]), np.concatenate([np.ravel(part) for part in parts])
    x0, p = np.ascontiguousarray(x0, dtype=float), np.ascontiguousarray(p, dtype=float)
    work, pivots = np.empty(n * n * (s + 2) + n * (2 * s + 2)), np.empty((s + 1) // 2 * n, dtype=np.int64)
    t, x, y = np.empty(max_steps + 1), np.empty((max_steps + 1, n)), np.empty((max_steps, f.n_y))
    z, step, counts = np.empty((max_steps, s, n)), np.array([float(h)]), np.zeros(4, dtype=np.int64)
    run = f.native("radau")
    run.restype = ctypes.c_int64
    k = run(
        ctypes.c_double(t0),
        pointer(x0),
        ctypes.c_double(t1),
        pointer(p),
        ctypes.c_int64(s),
        pointer(table),
        ctypes.c_int64(settings.iterations),
        ctypes.c_double(settings.tolerance),
        ctypes.c_int64(settings.fixed),
        ctypes.c_double(settings.rtol),
        ctypes.c_double(settings.atol),
        ctypes.c_int64(settings.project_every),
        ctypes.c_int64(max_steps),
        *map(pointer, (step, work, pivots, t, x, y, z, counts)),
    )
    return t[: k + 1], x[: k + 1].T, z[:k], float(step[0]), counts


def first_step(f, t, x, p, span, settings):
    """Length of a first step (Hairer, Nørsett and Wanner 1993, II.4); f is a Compiled with the outputs X', pivots."""
    n, power = len(x), 1.0 / (STAGES[settings.order] + 1)
    scale = settings.atol + settings.rtol * np.abs(x)
    slope = f(t, x, p)[:n]
    d0, d1 = _size(x / scale), _size(slope / scale)
    h = min(abs(span), 1e-6 if d0 < 1e-5 or d1 < 1e-5 else 0.01 * d0 / d1)
    signed = np.copysign(h, span)
    d2 = _size((f(t + signed, x + signed * slope, p)[:n] - slope) / scale) / h
    longer = max(1e-6, h * 1e-3) if max(d1, d2) <= 1e-15 else (0.01 / max(d1, d2)) ** power
    h = min(100 * h, longer, abs(span))
    return h if np.isfinite(h) and h > 0 else 1e-6 * abs(span)


def _size(v):
    return float(np.sqrt(np.mean(np.square(v)))) if v.size else 0.0


@frozen
class Collocated(Steps):
    """Steps along which states are polynomials, with values at nodes of each."""

    nodes: tuple  # c (s,), parts of the step, and their `rates_at`
    z: np.ndarray  # (S, s, n_x) increments from the start of the step to these nodes

    @property
    def nbytes(self):
        """Memory of the steps."""
        return self.x.nbytes + self.z.nbytes

    def at(self, k, times):
        """States (n_x, N) at times (N,) within steps k (N,), by these polynomials."""
        theta, _ = self._parts(k, times)
        weights = basis(self.nodes[0], theta)
        return self.x[:, k] + np.einsum("jm,mjl->lm", weights, self.z[k])

    def slope(self, k, times):
        """Their derivatives: polynomials through the rates at the nodes."""
        theta, h = self._parts(k, times)
        c, rate = self.nodes
        return np.einsum("jm,mjl->lm", rate.T @ lagrange(c, theta), self.z[k]) / h

    def _parts(self, k, times):
        """Parts of steps at which times lie in them, and their lengths [s]."""
        h = np.diff(self.t)[k]
        return (times - self.t[k]) / h, h


class RadauSteps(BulkSteps):
    """One integration by a Radau IIA method, which is refused where there is no C compiler.

    The order is 5, 9 or 13; None leaves it to `radau_order`. `step` is the length of fixed steps [s]; None adapts them.
    """

    most = 200  # steps per call of the compiled loop
    advice = "Use a smaller step or none, use a larger rtol, or check whether the motion escapes."

    def __init__(self, model, drift, rtol, atol, order, step, progress):
        self.step, self.taken = step, []
        self.failure = "its steps vanish" if step is None else "the Newton iteration does not solve a fixed step"
        self.every = drift.every if isinstance(drift, Project) else 0
        self.projects = self.every > 0
        self.most = max(self.most - self.most % self.every, self.every) if self.every else self.most
        order = radau_order(rtol) if order is None else order
        self.settings = Settings(order, rtol, atol, step is not None, self.every)
        if step is None:
            self.tolerances = rtol, atol
        super().__init__(model, "RadauIIA", drift, progress)

    def _function(self, model, poles):
        return radau_loop(model, poles)

    def halved(self, model, t, x, h):
        """States (n_x, 3) at t, t + h and t + 2 h by two steps; fewer if one fails."""
        self._use(model)
        return self._equal_steps(t, x, h, 2)

    def _equal_steps(self, t, x, h, count):
        return radau_steps(self.f, t, x, t + count * h, self.p, abs(h), self.settings, count)[1]

    def _record(self, steps, first, last, end=None):
        super()._record(steps, first, last, end)
        if self.step is not None:
            self.taken.append((self.model, steps.t[first : last + 1], steps.x[:, first : last + 1]))

    def _begin(self, a, x, b):
        if self.f.native("radau") is None:  # compiled here, as the start may choose other pivots
            raise SpecificationError(
                "method='RadauIIA' was given, and there is no C compiler, or compiled=False.",
                "The loop over its steps is C code.",
                nearest="method='Radau', scipy's of order 5.",
                do="Use it, leave out compiled=False, or install a C compiler (gcc or clang).",
                method="RadauIIA",
            )
        if self.step is None:
            self.h = first_step(self.f, a, x, self.p, b - a, self.settings)
            self.motion.count(nfev=2)
        else:
            self.h = abs(equal_steps(a, b, self.step)[0])

    def _retake(self, h):
        self.h = abs(h)

    def _steps(self, t, x, b):
        first, last = self._beside(t, b)
        times, x, z, self.h, counts = radau_steps(self.f, first, x, last, self.p, self.h, self.settings, self.most)
        t = np.concatenate([[t], times[1:-1], [b if times[-1] == last else times[-1]]])[: len(times)]
        self.motion.count(steps=len(z), **dict(zip(("rejected", "nfev", "njev", "nlu"), counts, strict=True)))
        if self.every:
            self.motion.count(projections=len(z) // self.every)
            if t[-1] == b:
                x = np.column_stack([x[:, :-1], self.projection.restore_grid(t[-1:], x[:, -1:], self.p)])
        return Collocated(t, x, len(z) < self.most and t[-1] != b, radau(self.settings.order)[:2], z)
