"""The motion between samples: integrated from each sample to the next, all at once, by collocation at Gauss points."""

import functools
from dataclasses import field

import numpy as np

from servoctl.codegen.function import compiled
from servoctl.codegen.paths import combined
from servoctl.values import frozen

STAGES = 4  # Gauss points of a step: order 8
FIXED_POINT_STEPS = 25  # of a step, at most: an explicit iteration that takes more needs shorter steps
SETTLED = 1e-9  # change of the state, relative to its size, at which the iteration has converged
CORRECTIONS = 3  # Newton steps of a state, at most; one that was integrated is accurate to AGREES or better
AGREES = 0.1  # of the limit: a difference from the next sample, or between two lengths of step, that decides
ENOUGH_STEPS = 1024  # between two samples
MOST_OPERATIONS, OVERHEAD = 5e8, 200  # of all steps of one length; what an evaluation takes besides its own


@functools.cache
def gauss(stages):
    """Nodes c (s,), weights b (s,) and matrix A (s, s) of the Gauss method, of order 2s (Hairer and Wanner, IV.5)."""
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    c, powers = (nodes + 1) / 2, np.arange(stages)
    integrals = c[:, None] ** (powers + 1) / (powers + 1)
    return c, weights / 2, integrals @ np.linalg.inv(c[:, None] ** powers)


@frozen
class Flow:
    """The motion of a model as x' = F(t, x): of q for a flat program, else of the state (q, γ', ..., γ^(s̄-1))."""

    model: object
    flat: bool
    balanced: bool  # whether the power is to be integrated

    @property
    def f(self):
        """The compiled function."""
        return self.model.function("path" if self.flat else "ode")

    def values(self, t, x):
        """Rates (n_x, N) and jets (n_z, N) at states (n_x, N)."""
        y, (nq, n) = self.f.grid(t, x, self.model.p), (self.model.nq, self.model.n)
        if self.flat:
            first = nq if self.model.reduction.mechanism.q.plain else 3 * nq  # of γ' and γ'' (see `Equations.path`)
            return y[nq : 2 * nq], np.concatenate([x, y[first : first + 2 * n]])
        return y[: len(x)], np.concatenate([x, y[len(x) - n : len(x)]])

    def newton(self, t, x):
        """The Newton step (n_x, N) that leads states back to the constraints; none where the states are integrated."""
        return self.f.grid(t, x, self.model.p)[: len(x)] if self.flat else np.zeros_like(x)

    def settled(self, t, x):
        """States led back to the constraints by Newton's method."""
        for _ in range(CORRECTIONS if self.flat else 0):
            x = x + self.newton(t, x)
        return x

    def power(self, t, z):
        """Power of the forces without a potential at times (N,) and jets (n_z, N)."""
        if not self.balanced:
            return np.zeros(len(t))
        work = self.model.once("power of forces", lambda: _power_of_forces(self.model))
        values = np.empty((1, len(t)))
        work.interpreted.grid(t, z[: work.n_x], self.model.p, values)  # once: compiling it takes longer
        return values[0]


def _power_of_forces(model):
    """The second of the signals "power" alone, without those that take most of its operations."""
    f = model.signals("power")[1].expression
    return compiled(combined("work", lambda z, p, y: y[1], f), "work")


@frozen
class Edges:
    """Instants from each of which the motion is integrated to the next.

    Below the state each column has the work done since the last sample: 0 at samples, in `known` the energy gained.
    """

    t: np.ndarray  # (K + 1,) [s], in the order of the motion
    sampled: np.ndarray  # (K + 1,) whether each is a sample, and no knot between samples
    known: np.ndarray  # (n_x + 1, K + 1) of the samples, NaN at knots
    sizes: np.ndarray  # (n_x + 1,) of these
    limit: float  # largest difference from the next sample that passes, relative to the sizes
    steps: int  # of each interval, at least


@frozen
class Found:
    """What was found in K intervals between edges."""

    ends: np.ndarray  # (n_x + 1, K) states reached, and the work since the last sample
    resolved: np.ndarray  # (K,) whether the steps were short enough to decide
    inside: list = field(default_factory=list)  # of (flow, t, z): jets z at instants t inside, to which the flow led


def between(attempts, edges):
    """What is `Found` from each of the `Edges` to the next.

    Each of `attempts` maps indices (K,) of edges to pairs of a `Flow` and the indices of those that it leads on; it is
    tried where those before it did not lead to the next edge, as pivots may vanish between edges.
    """
    count, starts = len(edges.t) - 1, edges.known.copy()
    starts[-1, edges.sampled] = 0.0
    found = Found(np.full((len(starts), count), np.nan), np.zeros(count, dtype=bool))
    ready = np.flatnonzero(edges.sampled[:-1])
    while ready.size:
        left = ready
        for attempt in attempts:
            for flow, ks in attempt(left):
                _integrate(flow, np.asarray(ks), starts, edges, found)
            left = left[~found.resolved[left]]
        on = ready[~edges.sampled[ready + 1] & found.resolved[ready]]
        starts[:, on + 1] = found.ends[:, on]
        ready = on[on + 1 < count] + 1
    return found


def _integrate(flow, ks, starts, edges, found):
    """Integrate the intervals ks (K,) with more and more steps, until the states at their ends are known.

    A sample beside its constraints shows in the interval before it and in the residuals; no length of step mends it.
    """
    starts, steps, cost = starts[:, ks], edges.steps, STAGES * (flow.f.operations + OVERHEAD)
    starts[:-1] = flow.settled(edges.t[ks], starts[:-1])
    while ks.size and (steps == edges.steps or steps <= ENOUGH_STEPS and len(ks) * steps * cost <= MOST_OPERATIONS):
        ends, led_back, inside = _stepped(flow, edges.t[ks], np.diff(edges.t)[ks], starts, steps, edges.sizes)
        with np.errstate(invalid="ignore"):
            defects, changes = (
                (np.abs(ends - others) / edges.sizes[:, None]).max(axis=0)
                for others in (edges.known[:, ks + 1], found.ends[:, ks])
            )
        enough = AGREES * np.fmax(defects, edges.limit)
        done = (defects <= AGREES * edges.limit) | ((changes <= enough) & (led_back <= enough))
        done &= np.isfinite(led_back)
        found.ends[:, ks], found.resolved[ks] = ends, done
        found.inside.extend((flow, t[done], z[:, done]) for t, z in inside if done.any())
        ks, starts, steps = ks[~done], starts[:, ~done], 2 * steps


def _stepped(flow, t, length, starts, steps, sizes):
    """Take equal steps from t (K,) over lengths (K,).

    Returns the ends; the largest Newton step, relative to the sizes, that leads a flat motion back to its constraints
    at the end of a step, infinite where a step did not settle; and instants between steps with their jets.
    """
    h, (c, b, _), x, work, sizes = length / steps, gauss(STAGES), starts[:-1], starts[-1], sizes[:-1, None]
    back, led_back, inside = 0.0, np.zeros(len(t)), []
    for k in range(steps):
        x = x + back
        rates, jets = flow.values(t + k * h, x)
        inside += [(t + k * h, jets)] * (k > 0)
        times = t + (k + c[:, None]) * h
        rates, jets, settled = _stages(flow, times, h, x, rates, sizes)
        x = x + h * np.tensordot(b, rates, (0, 1))
        work = work + h * (b @ flow.power(times.ravel(), jets).reshape(times.shape))
        back = flow.newton(t + (k + 1) * h, x)
        led_back = np.fmax(led_back, (np.abs(back) / sizes).max(axis=0))
        led_back[~(settled & np.all(np.isfinite(x), axis=0))] = np.inf
        if np.isinf(led_back).all():
            break
    return np.vstack([x, work]), led_back, inside


def _stages(flow, times, h, x, rates, sizes):
    """Rates (n_x, s, K) and jets (n_z, s K) at the Gauss points of a step, by iteration from rates; who settled."""
    rates, A = np.repeat(rates[:, None], STAGES, axis=1), gauss(STAGES)[2]
    for _ in range(FIXED_POINT_STEPS):
        with np.errstate(all="ignore"):
            states = x[:, None] + h * (A @ rates)
            new, jets = flow.values(times.ravel(), states.reshape(len(x), -1))
            new = new.reshape(rates.shape)
            change = (np.abs(h * (new - rates)) / sizes[:, None]).max(axis=(0, 1))
        rates = new
        if not np.any(change > SETTLED):  # without those that are no longer finite
            break
    return rates, jets, change <= SETTLED
