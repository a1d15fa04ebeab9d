"""The internal dynamics that a program leaves: how errors grow along a motion, by the variational equation.

Deviations δ of a motion obey δ' = J δ, J = ∂X'/∂X, and stay in the tangent space of the manifold of the constraints.
With orthonormal bases N(t) of it, and a fixed basis M = N(t_m) of the middle of a segment, z = Mᵀδ obeys z' = B(t) z,

    B = Mᵀ J N (Mᵀ N)⁻¹,    Y = (Mᵀ N_1)⁻¹ e^Ω (Mᵀ N_0),    Ω = ∫ B dt - h² [B_0, B_1] / 12,

where Y takes coordinates of deviations from the start of the segment to its end: Magnus' series of order 4, whatever
the bases. The products of all Y are the propagators Φ(t, s). Real parts of the eigenvalues of the frozen Nᵀ J N decide
nothing: where J changes, x' = J x may grow though all of them are negative, and decay though some are positive.
"""

from dataclasses import field, replace
from functools import cached_property

import numpy as np

from servoctl.checks import positive
from servoctl.errors import SpecificationError
from servoctl.markup import Shown
from servoctl.methods.kinks import SMOOTHER, stays_on_switch
from servoctl.methods.motion import breakpoints
from servoctl.methods.stability import stability_function
from servoctl.model.equations import invariant_names
from servoctl.run import SAME_TIME, Run, require_run
from servoctl.tolerances import TINY
from servoctl.values import frozen

AT_ZERO = 1e-9  # size of a state relative to the largest, below which it is the rounding of zero
UNSTABLE = 10.0  # growth of an error along a motion above which the internal dynamics are unstable over it
FASTER = 3.0  # growth over a time, relative to that over half of it, that is no drift of phases, which gives 2
EXPONENTIAL = 1.6  # its logarithm, relative to that over half of it: 2 for e^λt, less for powers of t
MOST_GROWTH = 0.8  # of the logarithm of all growth: what is exponential has it, not one swing that is followed by drift
GREAT = 1e4  # growth that is unstable even if it is a power of time
SHRUNK = 0.95  # of the errors of the start: with less than this left at the end, they are stable
FEWEST, MOST = 512, 8192  # intervals at whose ends a motion is linearised: four times as many until they resolve growth
AGREE = 0.02  # of 1 + ln(growth): difference of its logarithm by steps twice as long that is accepted
JITTER, GOLDEN = 0.5, 0.6180339887498949  # of their distance by which instants are irregular, by the golden ratio
ASIDE = 1e-10  # of the span and of the instant: distance on both sides of a knot, where the linearisation may jump
TURNED = 0.75  # squared sines of the angles between tangent spaces at an end of a segment and at its middle, summed
BLOCKS = 32  # instants between which growth is measured, as all pairs of them
SWEEPS, BALANCED = 30, 0.01  # of balancing, at most; until sums of rows and of columns agree to one percent
BOUNDED_AT, BOUNDED_IN = 16, 4  # intervals between the instants of a bound of the growth; sweeps of its balancing
MOST_AT_FIRST = 256  # intervals, at most, that may tell that there is nothing to warn of
SHORT = 0.7  # ∫‖A‖ over each of them, by few linearisations; the series converges below 1
GLANCES = 128  # intervals by which these instants are spread over the way of the states
SHARED = 0.5  # of the largest part that is independent of states chosen before: with it a state is fit as the next one
MATTERS = 1e-3  # of the states' scales: an error as large as this matters
STEP_ERROR = 1e-9  # of the steps of a motion, unless its method has another
PERIODIC = 1e-3  # of the largest linearisation: its change over a period that is accepted
FEW_SAMPLES = "the samples do not resolve it, and its steps are not known; simulate with more samples (t_eval)"
NEAR_ONE = 1e-3  # of a multiplier: within this of 1 it is neutral


@frozen(eq=False)
class InternalDynamics(Shown):
    """How errors in the internal dynamics of a program grow along a motion; made by `internal_dynamics`.

    Growth is measured in the states' norm after one scaling of each state, the one with the smallest propagators
    (balancing, Osborne 1960), so that it depends neither on units nor on coordinates that are at rest.

    Attributes
    ----------
    tangents : Tangents
        The linearisation.
    verdict : {"none", "stable", "neutral", "unstable", "inconclusive"}
        "none" for flat programs. Over the time of the run, and no longer: "unstable" if an error grows more than
        tenfold and exponentially or faster than a power of time can, or 1e4-fold, "stable" if none does and all errors
        of the start have shrunk at its end, "neutral" otherwise, as where phases drift apart. With a period, which says
        something of all times, by the multipliers. "inconclusive" if the motion is too long or too quick for the
        intervals over which it is linearised.
    growth : float
        max ‖Φ(t, s)‖, s <= t: the largest growth of an error from any instant of the run to any later one.
    left : float
        ‖Φ(t_1, t_0)‖, what is left of the errors of the start at the end.
    until : (2, K) array
        Instants [s], and the growth up to each of them.
    period : float
        [s]; 0 if there was none.
    multipliers : (f,) complex array
        Floquet's, the eigenvalues of the propagator over a period; none without a period.
    cause : str
        Of an inconclusive verdict, with the remedy.
    """

    tangents: "Tangents" = field(repr=False)
    verdict: str
    growth: float
    left: float = 1.0
    until: np.ndarray = field(default_factory=lambda: np.ones((2, 0)))
    period: float = 0.0
    multipliers: np.ndarray = field(default_factory=lambda: np.zeros(0, complex))
    cause: str = f"{MOST} intervals do not resolve it; simulate a shorter time"

    @property
    def t(self):
        """Instants [s], (N,) array."""
        return self.tangents.t

    @property
    def names(self):
        """Names of f states that may serve as its coordinates, tuple of str."""
        return self.tangents.independent

    @property
    def eigenvalues(self):
        """Frozen eigenvalues [1/s], (f, N) complex array: of the linearisation at each instant, by real part.

        They decide nothing.
        """
        return self.tangents.eigenvalues

    @property
    def length(self):
        """The time that was judged [s]."""
        return float(np.ptp(self.t)) if len(self.t) else 0.0

    def good_for(self, tolerance=STEP_ERROR):
        """The time [s] after which errors of a tolerance, relative to the states, have grown to 1e-3.

        Parameters
        ----------
        tolerance : float
            Relative error of a step.

        Returns
        -------
        float
            The length of the run if they stay below.
        """
        t, growth = self.until
        beyond = np.flatnonzero(growth * tolerance > MATTERS)
        if not len(beyond):
            return self.length
        k = max(int(beyond[0]), 1)
        low, high = np.log(np.minimum(growth[k - 1 : k + 1], np.finfo(float).max))
        part = (np.log(MATTERS / tolerance) - low) / (high - low) if high > low else 0.0
        return float(abs(t[k - 1] + np.clip(part, 0.0, 1.0) * (t[k] - t[k - 1]) - t[0]))

    def sentence(self, tolerance=STEP_ERROR):
        """The verdict in words, with the numbers behind it.

        Parameters
        ----------
        tolerance : float
            As for `good_for`.

        Returns
        -------
        str
        """
        if self.verdict == "none":
            return "internal dynamics: none (the program determines the motion)"
        if self.verdict == "inconclusive":
            return f"internal dynamics inconclusive: {self.cause}"
        facts = {
            "unstable": f"errors grow by {self.growth:.2g}",
            "neutral": f"errors grow by at most {self.growth:.2g}",
            "stable": f"errors shrink to {self.left:.2g}, after growing by at most {self.growth:.2g}",
        }
        over = f"with a period of {self.period:.6g} s" if self.period else f"over these {self.length:.4g} s"
        text = f"internal dynamics {self.verdict} {over}: {facts[self.verdict]}"
        if self.verdict == "unstable" and (good := self.good_for(tolerance)) < self.length:
            text += f"; a forward integration, good for {good:.2g} s"
        return text

    def facts(self, tolerance=STEP_ERROR):
        """The verdict with its numbers: {name: value}, "text" the sentence.

        Parameters
        ----------
        tolerance : float
            As for `good_for`.

        Returns
        -------
        dict
        """
        return {
            "verdict": self.verdict,
            "growth": self.growth,
            "left": self.left,
            "seconds": self.length,
            "good for": self.good_for(tolerance),
            "text": self.sentence(tolerance),
        }

    def __repr__(self):
        lines = ["InternalDynamics: " + self.sentence().removeprefix("internal dynamics").lstrip(": ")]
        if self.names:
            lines.append(f"  {len(self.names)} states: {', '.join(self.names)}")
        if len(self.multipliers):
            sizes = ", ".join(f"{size:.4g}" for size in np.sort(np.abs(self.multipliers))[::-1])
            lines.append(f"  multipliers of a period of {self.period:.6g} s: {sizes}")
        if self.eigenvalues.size:
            low, high = self.eigenvalues.real.min(), self.eigenvalues.real.max()
            lines.append(f"  frozen eigenvalues: real parts {low:.4g} .. {high:.4g} 1/s, which decide nothing")
        return "\n".join(lines)


def internal_dynamics(run: Run, period: float | None = None) -> InternalDynamics:
    """Measure how errors in the internal dynamics grow along a run.

    Parameters
    ----------
    run : Run
    period : float, optional
        Of the linearisation along the motion [s], for Floquet's multipliers over its first period.

    Returns
    -------
    InternalDynamics

    Raises
    ------
    SpecificationError
        If the run has no model, is shorter than the period, or does not have it.

    Notes
    -----
    The motion is linearised at the ends of 512 intervals or a few more, on both sides of breaks of its paths, whatever
    its samples. The growth counts if that by intervals twice as long agrees; otherwise 2048 and 8192 intervals are
    tried, shorter ones where the linearisation is large.
    """
    model = require_run(run, "internal_dynamics")
    if model.flat or not _dimension(model):
        return InternalDynamics(Tangents((), run.t[:0], np.ones(0), *np.zeros((2, 0, 0, 0))), "none", 1.0)
    t0, t1 = run.span
    if not run.resolved:
        nothing = _tangents(model, run, run.t[:1])
        return InternalDynamics(nothing, "inconclusive", np.nan, np.nan, cause=FEW_SAMPLES)
    end = None if period is None else _end_of_first(positive("period", period), t0, t1)
    tangents, *resolved = _propagated(model, run, t1)
    if switch := stays_on_switch(model, run):
        cause = f"the run stays on a switch, {switch}, and has no linearisation; {SMOOTHER}"
        return InternalDynamics(tangents, "inconclusive", np.nan, np.nan, cause=cause)
    if not resolved:
        return InternalDynamics(tangents, "inconclusive", np.nan, np.nan)
    judged = _judged(tangents, *resolved)
    return judged if end is None else _with_multipliers(model, run, end, period, judged)


def few_tangents(run):
    """Tangents at few instants of a run; None where one is not finite."""
    if run.span[0] == run.span[1]:
        return None
    t = _instants(run, run.span[1], GLANCES)
    x = run.at(t)[: len(run.model.state_names)]
    if not np.isfinite(x).all():
        return None
    picked = _spread(t, x / _sizes(x)[:, None], _knots(run, run.span[1]))
    tangents = _linearised(run, t[picked], x[:, picked], _sizes(x))
    return tangents if len(tangents.t) == len(picked) else None


@np.errstate(all="ignore")
def growth_bound(run, tangents):
    """A bound of the growth of errors along a run, by the logarithmic norm of its linearisation at few instants.

    It is exp max ∫ μ dt over all parts of the run, μ = λ_max(A + Aᵀ)/2 with A = Nᵀ J N in scaled states
    (Söderlind 2006, eq. (2.5)), where the integral is enlarged by its difference from that by every other instant; inf
    where A is not finite. One scale of the states, which balances the mean of (J N Nᵀ)², serves the whole run. A large
    bound says nothing: where A turns, an error may stay small though μ is large.
    """
    if tangents is None:
        return np.inf
    (t0, t1), N, JN = run.span, tangents.N, tangents.JN
    t, slopes = np.abs(tangents.t - t0), JN @ N.swapaxes(1, 2)
    scale = _balance((slopes**2).mean(axis=0) + np.eye(N.shape[1]) / t[-1] ** 2, BOUNDED_IN)[:, None]
    Q, R = np.linalg.qr(N / scale)
    A = np.sign(t1 - t0) * Q.swapaxes(1, 2) @ (JN / scale) @ np.linalg.inv(R)
    mu = np.linalg.eigvalsh((A + A.swapaxes(1, 2)) / 2)[:, -1]
    fine, coarse = (_largest_integral(t[::stride], mu[::stride]) for stride in (1, 2))
    return float(np.exp(fine + abs(fine - coarse)))


def _spread(t, x, knots):
    """BOUNDED_AT + 1 samples at equal parts of the time and of the way of the states x (n_x, N), first and last too.

    Where none is between two knots, all that are there.
    """
    way, time = np.abs(np.diff(x)).sum(axis=0), np.abs(np.diff(t))
    part = np.cumsum(time / time.sum() + way / max(way.sum(), TINY))
    samples = np.searchsorted(part, np.linspace(0.0, part[-1], BOUNDED_AT + 1))
    samples[-1] = len(part)
    if not len(knots):
        return samples
    pieces = np.searchsorted(np.abs(knots - t[0]), np.abs(t - t[0]))
    return np.union1d(samples, np.flatnonzero(~np.isin(pieces, pieces[samples])))


def quiet(run):
    """Whether a run's internal dynamics need no warning: by a bound of the growth, or by few propagators."""
    few = few_tangents(run)
    if growth_bound(run, few) <= UNSTABLE:
        return True
    count = np.inf if few is None else _frobenius(few.frozen).max() * abs(run.span[1] - run.span[0]) / SHORT
    if not count <= MOST_AT_FIRST:
        return False
    tangents = _tangents(run.model, run, _instants(run, run.span[1], max(count, BLOCKS))).in_fours()
    size, corners = _frobenius(tangents.frozen), tangents[::2]
    short = np.abs(np.diff(tangents.t)) * np.maximum(size[1:], size[:-1]) < 1
    steps = _steps(tangents) if short.all() else None
    if steps is None:
        return False
    return not _unstable(corners, steps, *_growth(corners, _propagators(steps, _block_ends(corners.t))))


def _largest_integral(t, mu):
    """The largest integral of mu from one instant to a later one, by the trapezoidal rule; 0 at least."""
    along = np.append(0.0, np.cumsum(np.diff(t) * (mu[1:] + mu[:-1]) / 2))
    return (along - np.minimum.accumulate(along)).max()


@frozen
class Tangents:
    """Names of the states (n_x,), instants (K,), and sizes of the states along a motion (n_x,).

    Orthonormal bases N of the tangent space in scaled states, and their rates J N, (K, n_x, f).
    """

    states: tuple
    t: np.ndarray
    size: np.ndarray
    N: np.ndarray
    JN: np.ndarray

    def in_fours(self):
        """A multiple of four intervals of these instants: up to three of the last instants but one are left out."""
        return self[np.delete(np.arange(len(self.t)), slice(-1 - (len(self.t) - 1) % 4, -1))]

    def __getitem__(self, picked):
        """Some of these instants."""
        return replace(self, t=self.t[picked], N=self.N[picked], JN=self.JN[picked])

    @property
    def frozen(self):
        """Nᵀ J N, (K, f, f)."""
        return self.N.swapaxes(1, 2) @ self.JN

    @cached_property
    def eigenvalues(self):
        """Of Nᵀ J N at each instant, (f, K), by descending real part."""
        values = np.linalg.eigvals(self.frozen).astype(complex)
        return np.take_along_axis(values, np.argsort(-values.real, axis=1, kind="stable"), axis=1).T

    @cached_property
    def independent(self):
        """Names of states that serve as coordinates of the internal dynamics at all instants: the first fit ones."""
        if not len(self.t):
            return ()
        bases = np.linalg.qr(self.size[:, None] * self.N)[0].transpose(1, 0, 2)
        rows, picked = bases.reshape(bases.shape[0], -1), []
        for _ in range(self.N.shape[2]):
            sizes = _frobenius(rows[:, None])
            picked.append(int(np.argmax(sizes >= SHARED * sizes.max())))
            pivot = rows[picked[-1]] / sizes[picked[-1]]
            rows = rows - np.outer(rows @ pivot, pivot)
        return tuple(self.states[i] for i in sorted(picked))


def linearised(model, run, count):
    """Internal dynamics linearised along a run: instants t (K,) [s] and A = Nᵀ J N (K, f, f) [1/s].

    At most `count` instants are spread over the run, and those without a finite Jacobian are left out; f is the number
    of states less that of invariants.
    """
    t0, t1 = run.span
    tangents = _tangents(model, run, t0 + (t1 - t0) * _irregular(count - 1))
    return tangents.t, tangents.frozen


def _dimension(model):
    """f, the number of states less that of invariants: Σ o_a, and more where coordinates outnumber velocities."""
    return len(model.state_names) - len(invariant_names(model))


def _sizes(x):
    """Largest magnitude of each state (n_x,) of states x (n_x, N), 1 where it stays at zero."""
    size = np.abs(x).max(axis=1, where=np.isfinite(x), initial=0.0)
    return np.where(size > AT_ZERO * size.max(), size, 1.0)


def _tangents(model, run, t):
    """Tangents at instants t (K,) of a run."""
    x = run.at(t)[: len(model.state_names)]
    return _linearised(run, t, x, _sizes(x))


def _linearised(run, t, x, size):
    """Tangents at instants t (K,) and states x (n_x, K), in the states' sizes (n_x,), by the models that hold there."""
    names, f = run.model.state_names, _dimension(run.model)
    N, JN = np.full((2, len(t), len(size), f), np.nan)
    for model, inside in run.by_model(t):
        N[inside], JN[inside] = _bases(model, t[inside], x[:, inside], size)
    finite = np.isfinite(JN).all(axis=(1, 2))
    return Tangents(names, t[finite], size, N[finite], JN[finite])


@np.errstate(all="ignore")
def _bases(model, t, x, size):
    """N, the kernel of the invariants' Jacobian, and J N: (K, n_x, f) each, in scaled states; NaN where not finite."""
    n_x = len(size)
    J = _slopes(model, "ode_jacobian", t, x, n_x) * size / size[:, None]
    N, lost = _kernel(model, t, x, size)
    return N, np.where(lost[:, None, None], np.nan, J @ N)


@np.errstate(all="ignore")
def _kernel(model, t, x, size):
    """N, the kernel of the invariants' Jacobian in scaled states (K, n_x, f), and where it is not finite (K,)."""
    m = len(invariant_names(model))
    C = _slopes(model, "invariants", t, x, m) * size
    rows = np.sqrt((C**2).sum(axis=2, keepdims=True))
    C = C / np.where(rows > 0, rows, 1.0)
    lost = ~np.isfinite(C).all(axis=(1, 2))
    return np.linalg.qr(np.where(lost[:, None, None], 0.0, C).swapaxes(1, 2), mode="complete")[0][:, :, m:], lost


def _slopes(model, name, t, x, rows):
    """The Jacobian of `rows` values by the state at N points, (N, rows, n_x): the last outputs of a function."""
    values = _grid(model.function(name).interpreted, t, x, model.p)[-rows * len(x) :]
    return values.T.reshape(len(t), len(x), rows).swapaxes(1, 2)


def _grid(interpreter, t, x, p):
    y = np.empty((interpreter.workspace.buffer[3].size, len(t)))
    interpreter.grid(t, x, p, y)
    return y


# --- instants ---------------------------------------------------------------------------------------------------------


def _knots(run, t1):
    """Knots (K,) within a run up to t1, in its direction."""
    ends, inside = (run.span[0], t1), np.array(breakpoints((run.span[0], t1), run.knots)[1:-1])
    near = 2 * ASIDE * (np.abs(inside) + abs(t1 - run.span[0]))
    return inside[np.abs(np.subtract.outer(ends, inside)).min(axis=0) > near]


def _instants(run, t1, count, part=None, at=None):
    """Ends of `count` intervals of a run up to t1, or more: of four at least from a knot to the next, and around it.

    They are as many in equal parts of the time; or of what has the increasing values `part` (K,) at instants `at` (K,).
    Instants at equal distances would see a periodic linearisation at one phase only.
    """
    t0, knots = run.span[0], _knots(run, t1)
    beside = ASIDE * (np.abs(knots) + abs(t1 - t0)) * np.sign(t1 - t0)
    ends = np.concatenate([[t0], np.column_stack([knots - beside, knots + beside]).ravel(), [t1]])
    if part is None:
        part, at = np.array([0.0, 1.0]), np.array([t0, t1])
    way, at = np.interp(np.abs(ends - t0), np.abs(at - t0), part), np.abs(at - t0)
    pieces = []
    for a, b, first, last in zip(ends[:-1], ends[1:], way[:-1], way[1:], strict=True):
        between = _irregular(4 * max(1, round(count / 4 * (last - first) / part[-1])))
        time = np.interp(first + (last - first) * between, part, at)
        pieces.append(a + (b - a) * (time[:-1] - time[0]) / (np.ptp(time) or 1.0))
    return np.append(np.concatenate(pieces), t1)


def _irregular(count):
    """`count` + 1 increasing fractions from 0 to 1 with irregular distances."""
    k = np.arange(count + 1)
    beside = JITTER * ((GOLDEN * k) % 1 - 0.5)
    beside[[0, -1]] = 0.0
    return (k + beside) / count


def _propagated(model, run, t1):
    """Tangents along a run up to t1, and, if enough to resolve the growth, steps along them and propagators.

    Where equal intervals do not, shorter ones are taken where the linearisation was found to be large.
    """
    count, known = FEWEST, ()
    while count <= MOST:
        tangents = _tangents(model, run, _instants(run, t1, count, *known)).in_fours()
        steps, longer = (_steps(tangents[::stride]) for stride in (1, 2))
        if steps is not None and longer is not None:
            ends = _block_ends(tangents.t[::2])
            propagators = _propagators(steps, ends)
            if _agree(propagators, _propagators(longer, ends[ends % 2 == 0] // 2)):
                return tangents, steps, propagators
        large = _large(tangents)
        if not 0 < large[-1] < np.inf:  # as of a single instant
            break
        count, known = 4 * count, (large, tangents.t)
    return (tangents,)


@np.errstate(all="ignore")
def _large(tangents):
    """Values at the instants of tangents that increase with the time and with the way of Nᵀ J N, half by each."""
    time, size = np.abs(np.diff(tangents.t)), _frobenius(tangents.frozen)
    way = time * (size[1:] + size[:-1]) / 2
    return np.append(0.0, np.cumsum(time / time.sum() + way / max(way.sum(), TINY)))


def _agree(propagators, longer):
    """Whether the logarithms of the growth, and of what is left at the end, are the same by steps twice as long."""
    (ends, _, log), (_, _, other) = propagators, longer
    common = ends % 2 == 0
    log = log[np.ix_(common, common)]
    return all(abs(x - y) <= AGREE * (1 + abs(x)) for x, y in ((log.max(), other.max()), (log[0, -1], other[0, -1])))


def _frobenius(matrices):
    return np.sqrt((matrices**2).sum(axis=(-2, -1)))


# --- propagators ------------------------------------------------------------------------------------------------------


@np.errstate(all="ignore")
def _steps(tangents):
    """Y of each segment, which has an instant within it, (S, f, f); None if a tangent space turns too far in one."""
    t, N, JN = tangents.t, tangents.N, tangents.JN
    a, m, b = slice(0, -2, 2), slice(1, -1, 2), slice(2, None, 2)
    if len(t) < 3 or t[0] == t[-1]:
        return None
    M = N[m].swapaxes(1, 2)
    G0, G1 = M @ N[a], M @ N[b]
    if max((G.shape[1] - (G**2).sum(axis=(1, 2))).max() for G in (G0, G1)) > TURNED:
        return None
    h = (t[b] - t[a])[:, None, None]
    c = (t[m] - t[a])[:, None, None] / h
    w = 1 / (6 * c * (1 - c))  # of the quadratic through three values
    try:
        B0, B, B1 = M @ JN[a] @ np.linalg.inv(G0), M @ JN[m], M @ JN[b] @ np.linalg.inv(G1)
        omega = h * ((0.5 - w * (1 - c)) * B0 + w * B + (0.5 - w * c) * B1)
        small = _frobenius(omega)[:, None, None] < 1  # where the series converges
        omega = omega - small * h**2 / 12 * (B0 @ B1 - B1 @ B0)
        return np.linalg.solve(G1, _exponential(omega) @ G0)
    except np.linalg.LinAlgError:  # of rates near a singular state, or where e^Ω is lost to rounding
        return None


def _exponential(omega):
    """e^Ω by Radau's fraction (2, 3) of Ω/4, which vanishes at -∞ like it."""
    above, below = stability_function("RadauIIA", 5)
    z, one = omega / 4, np.eye(omega.shape[1])
    square = z @ z
    fraction = np.linalg.solve(
        below[0] * one + below[1] * z + below[2] * square + below[3] * square @ z,
        above[0] * one + above[1] * z + above[2] * square,
    )
    fraction = fraction @ fraction
    return fraction @ fraction


def _block_ends(t):
    """Which ends t (S + 1,) of steps are nearest to those of BLOCKS blocks of equal times: even ones, or all if few."""
    every = 2 if len(t) > 2 * BLOCKS else 1
    ago = np.abs(t[::every] - t[0])
    equal = np.linspace(0.0, ago[-1], min(BLOCKS, len(ago) - 1) + 1)
    return every * np.unique(np.searchsorted((ago[1:] + ago[:-1]) / 2, equal))


@np.errstate(all="ignore")
def _propagators(steps, ends):
    """Ends of blocks of steps (n,), then propagators e^log Y between all of them, Y[s, t] (f, f) and log[s, t]."""
    n, f, longest = len(ends), steps.shape[1], np.diff(ends).max()
    block, of_block = np.tile(np.eye(f), (n - 1, 1, 1)), np.zeros(n - 1)
    for k in range(longest):
        inside = np.flatnonzero(ends[:-1] + k < ends[1:])
        block[inside], size = _normalised(steps[ends[inside] + k] @ block[inside])
        of_block[inside] += size
    Y, log = np.zeros((n, n, f, f)), np.full((n, n), -np.inf)
    Y[range(n), range(n)], log[range(n), range(n)] = np.eye(f), 0.0
    Y[range(n - 1), range(1, n)], log[range(n - 1), range(1, n)] = block, of_block
    i, j = np.indices((n, n))
    for length in 2 ** np.arange(int(np.ceil(np.log2(n)))):  # longer ones from two of at most this length
        s, t = np.nonzero((j - i > length) & (j - i <= 2 * length))
        Y[s, t], size = _normalised(Y[s + length, t] @ Y[s, s + length])
        log[s, t] = log[s + length, t] + log[s, s + length] + size
    return ends, Y, log


def _normalised(matrices):
    """Matrices of norm 1, and the logarithms of the norms that they had."""
    size = np.maximum(_frobenius(matrices), TINY)
    return matrices / size[:, None, None], np.log(size)


def _growth(corners, propagators, scale=None):
    """Ends of blocks of steps (n,), ln ‖Φ(t, s)‖ between them (n, n), and the scale of the states (n_x,).

    Where it can be no largest one, the logarithm is a lower bound.
    """
    ends, Y, log = propagators
    s, t = later = np.triu_indices(len(ends))
    N, Y, log = corners.N[ends], Y[later], log[later]
    if scale is None:
        shares = np.exp(2 * (log - log.max()))[:, None, None]
        scale = _balance((shares * (N[t] @ Y @ N[s].swapaxes(1, 2)) ** 2).sum(axis=0))
    R = np.linalg.qr(N / scale[:, None])[1]
    scaled = R[t] @ Y @ np.linalg.inv(R)[s]
    logs, most = np.full((2, len(ends), len(ends)), -np.inf)
    columns, rows = (scaled**2).sum(axis=1), (scaled**2).sum(axis=2)
    least = np.maximum(columns.max(axis=1), rows.max(axis=1))
    for bound, square in ((logs, least), (most, columns.sum(axis=1))):
        bound[later] = log + np.log(np.maximum(square, TINY**2)) / 2
    matter = _may_be_largest(logs, most)[later]
    norms = np.linalg.eigvalsh(scaled[matter].swapaxes(1, 2) @ scaled[matter])[:, -1]
    logs[s[matter], t[matter]] = log[matter] + np.log(np.maximum(norms, TINY**2)) / 2
    return ends, logs, scale


def _may_be_largest(least, most):
    """Of which pairs of instants (n, n) the growth may be the largest over a time, or up to an instant.

    Its logarithm lies between `least`, of the largest row or column of a propagator, and `most`, of all its entries.
    """
    blocks = np.arange(len(least))
    matter = most >= np.maximum.accumulate(least.max(axis=0))
    matter |= most >= _within(least)[np.maximum(blocks - blocks[:, None], 0)]
    matter[0, -1] = True
    return matter


def _within(logs):
    """The largest of logs (n, n) between instants that are at most 0, 1, ..., n - 1 blocks apart."""
    n = len(logs)
    beside = np.full((n, 2 * n), -np.inf)
    beside[:, :n] = logs
    diagonals = np.lib.stride_tricks.as_strided(beside, (n, n), (beside.strides[0] + beside.itemsize, beside.itemsize))
    return np.maximum.accumulate(diagonals.max(axis=0))


def _unstable(corners, steps, ends, logs, scale):
    """Whether errors grow more than tenfold, and not as a power of time like phases that drift apart.

    Growth over each number of blocks is compared with that over half as many, and where a block has most of it, in
    that block. Errors in f states grow no faster than t^(f - 1) where a constant linearisation has no positive mode.
    """
    limit, power = np.log(UNSTABLE), np.log(2.0) * max(corners.N.shape[2] - 2, 0)
    within = _within(logs)
    whole = within[2::2]
    half = within[1 : 1 + len(whole)]
    exponential = (whole > EXPONENTIAL * half) | (whole - half > np.log(FASTER) + power)
    exponential &= whole > MOST_GROWTH * within.max()
    if (exponential & (whole > limit) & (whole - half > np.log(FASTER))).any() or logs.max() > np.log(GREAT):
        return True
    j = int(np.argmax(np.diag(logs, 1)))
    first, end = ends[j], ends[j + 1]
    if logs[j, j + 1] <= limit or end == first + 1:
        return False
    block, steps = corners[first : end + 1], steps[first:end]
    return _unstable(block, steps, *_growth(block, _propagators(steps, _block_ends(block.t)), scale))


def _balance(W, sweeps=SWEEPS):
    """d (n,) that makes Σ W_ij d_j²/d_i² smallest: sums of rows and of columns are then the same (Osborne 1960)."""
    square = np.ones(len(W))
    for _ in range(sweeps):
        rows, columns = W @ square / square, square * ((1 / square) @ W)
        ratios = np.where((rows > TINY) & (columns > TINY), rows / np.maximum(columns, TINY), 1.0)
        if np.abs(np.log(ratios)).max() < BALANCED:
            break
        square *= ratios**0.25
    return np.sqrt(square)


# --- verdicts ---------------------------------------------------------------------------------------------------------


@np.errstate(over="ignore")
def _judged(tangents, steps, propagators):
    """The verdict on a motion from its propagators."""
    corners = tangents[::2]  # ends of the steps
    ends, logs, scale = _growth(corners, propagators)
    growth, left = (float(f"{np.exp(log):.3g}") for log in (logs.max(), logs[0, -1]))  # as many digits as are right
    until = np.stack([corners.t[ends], np.exp(np.maximum.accumulate(logs.max(axis=0)))])
    unstable = _unstable(corners, steps, ends, logs, scale)
    verdict = "unstable" if unstable else "stable" if left < SHRUNK else "neutral"
    return InternalDynamics(tangents, verdict, growth, left, until)


def _with_multipliers(model, run, end, period, judged):
    """The verdict by Floquet's multipliers over the first period of a run, up to its end [s]."""
    tangents, *resolved = _propagated(model, run, end)
    if not resolved:
        return replace(judged, verdict="inconclusive", period=period)
    _, (_, Y, log) = resolved
    back = tangents.N[0].T @ tangents.N[-1]
    _require_periodic(period, tangents, back)
    multipliers = np.exp(log[0, -1]) * np.linalg.eigvals(back @ Y[0, -1]).astype(complex)
    largest = np.abs(multipliers).max()
    verdict = "unstable" if largest > 1 + NEAR_ONE else "stable" if largest < 1 - NEAR_ONE else "neutral"
    order = np.argsort(-np.abs(multipliers), kind="stable")
    return replace(judged, verdict=verdict, period=period, multipliers=multipliers[order])


def _end_of_first(period, t0, t1):
    """The instant [s] at which the first period of a run from t0 to t1 ends."""
    length = abs(t1 - t0)
    if not period <= length * (1 + SAME_TIME):
        raise SpecificationError(
            f"period={period:g} s was given for a run of {length:g} s.",
            "Multipliers are those of the first period of a run.",
            do="Simulate for a whole period, or leave it out.",
            period=period,
            length=length,
        )
    return t0 + np.sign(t1 - t0) * min(period, length)


def _require_periodic(period, tangents, back):
    """Refuse a period after which the tangent space or the linearisation is another one."""
    first, last = tangents.frozen[0], tangents.frozen[-1]
    turned = 1 - np.linalg.svd(back, compute_uv=False).min()
    changed = _frobenius(back @ last @ back.T - first) / max(_frobenius(tangents.frozen).max(), TINY)
    if max(turned, changed) > PERIODIC:
        raise SpecificationError(
            f"The linearisation does not have the period {period:g} s: after it, it differs by {changed:.2g} of its "
            f"largest value, and its tangent space by {turned:.2g}.",
            "Multipliers belong to a motion along which the linearisation is periodic.",
            do="Give its period, or leave it out.",
            period=period,
            differs=float(max(turned, changed)),
        )
