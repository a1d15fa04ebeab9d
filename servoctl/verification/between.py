"""The motion between samples: integrated from each sample to the next, all at once, by collocation at Gauss points."""

import functools
from dataclasses import field

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.values import frozen

STAGES = 4  # Gauss points of a step: order 8
FIXED_POINT_STEPS = 25  # of a step, at most: an explicit iteration that takes more needs shorter steps
SETTLED = 1e-9  # change of the state, relative to its size, at which the iteration has converged
CORRECTIONS = 3  # Newton steps of a state, at most; one that was integrated is accurate to AGREES or better
AGREES = 0.1  # of the limit: a difference from the next sample, or between two lengths of step, that decides
FEW_STEPS, ENOUGH_STEPS = 32, 1024  # between two samples, where other pivots may help, and else
MOST_OPERATIONS, OVERHEAD = 5e9, 200  # of all steps together: seconds; what an evaluation takes besides its own


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
    most: int  # steps between two samples

    @property
    def f(self):
        """The compiled function."""
        return self.model.function("path" if self.flat else "ode")

    @property
    def n_x(self):
        """The number of states."""
        return self.model.nq if self.flat else len(self.model.state_names)

    def values(self, t, x):
        """Rates (n_x, N) and jets (n_z, N) at states (n_x, N)."""
        y, (nq, n) = self.f.grid(t, x, self.model.parameters), (self.model.nq, self.model.n)
        if self.flat:
            first = nq if self.model.reduction.mechanism.q.plain else 3 * nq  # of γ' and γ'' (see `Equations.path`)
            return y[nq : 2 * nq], np.concatenate([x, y[first : first + 2 * n]])
        return y[: self.n_x], np.concatenate([x, y[self.n_x - n : self.n_x]])

    def newton(self, t, x):
        """The Newton step (n_x, N) that leads states back to the constraints; none where the states are integrated."""
        return self.f.grid(t, x, self.model.parameters)[: self.n_x] if self.flat else np.zeros_like(x)

    def settled(self, t, x, sizes, limit):
        """States led back to the constraints by Newton's method, up to a limit relative to the sizes."""
        for _ in range(CORRECTIONS if self.flat else 0):
            step = self.newton(t, x)
            x = x + step
            if np.nanmax(np.abs(step) / sizes[:, None], initial=0.0) <= limit:
                break
        return x

    def corrected(self, t, z):
        """Jets at instants, those of a flat program solved for q by Newton's method."""
        if not self.flat:
            return z
        q = z[: self.model.nq]
        for _ in range(CORRECTIONS):
            q = q + self.newton(t, q)
        return self.values(t, q)[1]

    def power(self, t, z):
        """Power of the forces without a potential at times (N,) and jets (n_z, N)."""
        if not self.balanced:
            return np.zeros(len(t))
        work = self.model.once("power of forces", lambda: _power_of_forces(self.model))
        values = np.empty((1, len(t)))
        work.interpreted.grid(t, z[: work.n_x], self.model.parameters, values)  # once: compiling it takes longer
        return values[0]


def _power_of_forces(model):
    """The second of the signals "power" alone, without those that take most of its operations."""
    f = model.signals("power")[1].expression
    t, z, p = f.sx_in()
    return compiled(ca.Function("work", [t, z, p], [ca.densify(f(t, z, p)[1])]), "work")


@frozen
class Integration:
    """How intervals are integrated.

    Jets are returned at the ends of all steps of an interval but the last.
    """

    sizes: np.ndarray  # (n_x,) of the components of the state
    limit: float  # largest difference from the next sample that passes, relative to the sizes
    steps: np.ndarray  # (K,) of each interval, at least
    work: np.ndarray  # (K,) largest difference of the integrals of the power between two lengths of step; inf: any


@frozen
class Interval:
    """What was found in one or many intervals, one entry for each."""

    ends: np.ndarray  # (n_x, K) states reached
    defects: np.ndarray  # (K,) largest differences from the samples at the ends, relative to the sizes; NaN without one
    resolved: np.ndarray  # (K,) whether the steps were short enough to decide
    work: np.ndarray  # (K,) integrals of the power
    inside: list = field(default_factory=list)  # of (flow, t, z): jets z at instants t inside, to which the flow led


def between(attempts, t, x, settings):
    """Integrate from each edge to the next.

    Each of `attempts` maps indices (K,) of edges to pairs of a `Flow` and the indices of those that it leads on; it is
    tried where those before it did not lead to the next edge, as pivots may vanish between edges. Edges t (K + 1,) [s]
    are in the order of the motion; states x (n_x, K + 1) are NaN at edges between samples, where the state is the one
    reached from the edge before.
    """
    count, budget, x = len(t) - 1, [MOST_OPERATIONS], x.copy()
    found = Interval(np.full((len(x), count), np.nan), *(np.full(count, v) for v in (np.nan, False, np.nan)))
    sampled = np.all(np.isfinite(x), axis=0)
    targets, ready = x[:, 1:].copy(), np.flatnonzero(sampled[:-1])
    while ready.size:
        left = ready
        for attempt in attempts:
            for flow, ks in attempt(left):
                for steps in np.unique(settings.steps[ks]):
                    here = np.asarray(ks)[settings.steps[ks] == steps]
                    problem = t[here], np.diff(t)[here], x[:, here], targets[:, here]
                    _integrate(flow, problem, here, settings, found, budget)
            left = left[~found.resolved[left]]
            if not left.size:
                break
        on = ready[~sampled[ready + 1] & found.resolved[ready]]
        x[:, on + 1] = found.ends[:, on]
        ready = on + 1
        ready = ready[ready < count]
    return found


def _integrate(flow, problem, numbers, settings, found, budget):
    """Integrate the intervals of these numbers with more and more steps, until the states at their ends are known.

    A sample beside its constraints shows in the interval before it and in the residuals; no length of step mends it.
    """
    left, steps = np.arange(len(numbers)), settings.steps[numbers[0]]
    t, length, x, targets = problem
    problem = t, length, flow.settled(t, x, settings.sizes, AGREES * settings.limit), targets
    least, cost = steps, flow.f.operations + OVERHEAD
    while left.size and steps <= max(flow.most, least):
        if steps > least and left.size * steps * STAGES * cost > budget[0]:
            break
        part = [values[..., left] for values in problem]
        ks = numbers[left]
        before, work_before = found.ends[:, ks], found.work[ks]
        ends, led_back, work, inside, evaluations = _stepped(flow, *part, steps, settings.sizes)
        budget[0] -= evaluations * cost
        with np.errstate(invalid="ignore"):
            defects = (np.abs(ends - part[3]) / settings.sizes[:, None]).max(axis=0)
            changes = (np.abs(ends - before) / settings.sizes[:, None]).max(axis=0)
        enough = AGREES * np.fmax(defects, settings.limit)
        done = (defects <= AGREES * settings.limit) | ((changes <= enough) & (led_back <= enough))
        done &= np.isfinite(led_back) & ~(np.abs(work - work_before) > settings.work[ks])
        done &= np.isinf(settings.work[ks]) | np.isfinite(work_before)
        found.ends[:, ks], found.defects[ks], found.work[ks], found.resolved[ks] = ends, defects, work, done
        found.inside.extend((flow, t[done], z[:, done]) for t, z in inside if done.any())
        left, steps = left[~done], 2 * steps


def _stepped(flow, t, length, x, targets, steps, sizes):
    """Take equal steps from t (K,) over lengths (K,).

    Returns the ends; the largest Newton step, relative to the sizes, that leads a flat motion back to its constraints
    at the end of a step, infinite where a step did not settle; the work; instants with their jets; and the number of
    evaluations.
    """
    h, (_, b, _) = length / steps, gauss(STAGES)
    back, led_back, work, evaluations, inside = 0.0, np.zeros(len(t)), np.zeros(len(t)), 0, []
    for k in range(steps):
        x = x + back
        start, jets = flow.values(t + k * h, x)
        inside += [(t + k * h, jets)] * (k > 0)
        goal = flow.values(t + h, np.where(np.isfinite(targets), targets, x))[0] if steps == 1 else start
        times, rates, jets, converged, count = _stages(flow, t + k * h, h, x, (start, goal), sizes)
        x = x + h * np.tensordot(b, rates, (0, 1))
        back = flow.newton(t + (k + 1) * h, x)
        led_back = np.fmax(led_back, (np.abs(back) / sizes[:, None]).max(axis=0))
        led_back[~(converged & np.all(np.isfinite(x), axis=0))] = np.inf
        power = flow.power(times.ravel(), jets.reshape(len(jets), -1)).reshape(times.shape)
        work += h * (b @ power)
        evaluations += count + times.size + 3 * len(t)
        if np.isinf(led_back).all():
            break
    return x, led_back, work, inside, evaluations


def _stages(flow, t, h, x, guess, sizes):
    """Times (s, K), rates (n_x, s, K) and jets (n_z, s, K) at the Gauss points of a step; who settled; evaluations.

    `guess` are the rates at the start and at the end.
    """
    c, _, A = gauss(STAGES)
    times, (start, end) = t + c[:, None] * h, guess
    rates = start[:, None] + c[:, None] * (end - start)[:, None]
    jets, left, evaluations = None, slice(None), 0
    settled = np.zeros(len(t), dtype=bool)
    for _ in range(FIXED_POINT_STEPS):
        before = rates[..., left]
        with np.errstate(all="ignore"):
            states = x[:, None, left] + h[left] * (A @ before)
            pair = flow.values(times[:, left].ravel(), states.reshape(len(x), -1))
            new, z = (values.reshape(len(values), STAGES, -1) for values in pair)
            change = (np.abs(h[left] * (new - before)) / sizes[:, None, None]).max(axis=(0, 1))
        jets = np.zeros((len(z), STAGES, len(t))) if jets is None else jets
        rates[..., left], jets[..., left] = new, z
        evaluations += new[0].size
        left = np.arange(len(t))[left]
        settled[left[change <= SETTLED]] = True
        left = left[change > SETTLED]  # without those that are no longer finite
        if not left.size:
            break
        left = slice(None) if left.size == len(t) else left
    return times, rates, jets, settled, evaluations
