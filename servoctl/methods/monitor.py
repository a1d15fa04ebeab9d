"""The rank monitor: inspects pivots along a motion and decides whether to go on, to repivot, or to stop.

A pivot that changes its sign, touches zero, vanishes or stays at zero marks a state where the program is singular, or
where only the choice of pivots fails; the equilibrated matrices L and B decide which. A pivot that degrades is replaced
as soon as the matrices are far better than it.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from servoctl.errors import IntegrationStopped, ServoError, SingularProgram
from servoctl.methods.sizes import motion_sizes
from servoctl.model.equations import balances, gradient_jets, invariant_names, leading_names
from servoctl.model.pivots import pivot_sizes, usual_column_sizes
from servoctl.model.report import explain
from servoctl.model.variants import derived_near, strong_form
from servoctl.tolerances import ENTRY
from servoctl.values import frozen

DEGRADED = 0.02  # of its reference: a pivot below this is replaced, if the matrix itself is better than that
HELPS = 5.0  # factor by which the matrix must be better
NEGLIGIBLE = 1e-7  # of its reference: a pivot below this is zero
SINGULAR = 1e-3  # of the rank measure beside a zero of a pivot that dense output has located: below this it is lost
NEXT = 1e-6  # of a step: distance from the zero of a pivot at which the rank measure is taken
HOPELESS = 1e-9  # an equilibrated singular value below this leaves no digits
VANISHING = 0.03  # of its reference: a gradient or rank measure below this counts as lost
LOST = 0.1  # of its best, or beside a zero: below this, rank is why no step succeeds or a pivot is zero
HIDES = 10.0  # times the root of a residual: a smaller pivot may be zero, as it touches zero quadratically
SHARE = 0.1  # of the largest entry of a null vector: smaller entries are not named in the error
LINGERS = 5.0  # times the extrapolated way to its zero, after which a pivot hidden by the residual is zero
NO_CHOICE = "no choice of pivots leads on"
FRACTIONS = (0.25, 0.5, 0.75)  # of a step with dense output at which pivots are inspected, beside its end


@frozen
class Fine:
    """The pivots allow all `steps` steps."""

    steps: int


@frozen
class Singular:
    """After `steps` whole steps the program is singular at t [s], X = x; `why` is the reason."""

    steps: int
    t: float
    x: np.ndarray
    why: str


@frozen
class Repivot:
    """After `steps` whole steps the motion goes on from t [s], X = x with other pivots."""

    steps: int
    t: float
    x: np.ndarray
    variant: tuple | None  # (Model, Monitor) with other pivots; None if they are still to be chosen
    otherwise: Singular  # the outcome if no other pivots lead on


def _other_pivots(steps, t, x):
    """The motion goes on from a state of full rank, with pivots that are still to be chosen."""
    return Repivot(steps, t, x, None, Singular(steps, t, x, NO_CHOICE))


@frozen
class Stretch:
    """Steps of a method without dense output: between their ends states and pivots are interpolated linearly."""

    t: np.ndarray  # (S + 1,) ends of the steps [s]
    x: np.ndarray  # (n_x, S + 1) states there
    pivots: np.ndarray  # (n_g, S, m) at m instants of each step, the last of them its end
    top: object  # γ^(s̄) from (t, X)
    crosses: bool = False  # steps across a pivot's zero are as accurate as others: the motion goes on from their end
    lost = LOST  # rank measure at a zero as roughly located as here, below which the program is singular

    def first(self, count):
        """The first steps alone."""
        if count >= len(self.t) - 1:
            return self
        return replace(self, t=self.t[: count + 1], x=self.x[:, : count + 1], pivots=self.pivots[:, :count])

    def instants(self, k):
        """Instants of step k at which pivots are known, its start first."""
        return self.t[k : k + 2]

    def inner_pivots(self, k):
        """Pivots (n_g, N) at `instants` except the start."""
        return self.pivots[:, k]

    def state(self, k, t):
        """X at an instant of step k."""
        s = (t - self.t[k]) / (self.t[k + 1] - self.t[k])
        return (1 - s) * self.x[:, k] + s * self.x[:, k + 1]

    def zero(self, k, i, ends, sizes):
        """Where pivot i, which has opposite signs at both ends, vanishes between them."""
        a, b = np.abs(sizes)
        return ends[0] + a / (a + b) * (ends[1] - ends[0])

    def least(self, k, i, instants, sizes, scale):
        """Where pivot i is least in step k, and its size there relative to a scale, from such sizes at instants."""
        j = int(np.argmin(sizes))
        return instants[j], sizes[j]

    def last_before(self, k, t):
        """The last instant before t from which the motion may go on."""
        return self.t[k]


@frozen
class DenseStretch(Stretch):
    """Steps of a method with dense output."""

    dense: object = None  # states (n_x, N) from steps k (N,) and times (N,)
    pivots_at: object = None  # pivots from (t, X)
    slope: object = None  # derivatives of the states, as `dense`; NaN for entries that are not integrated
    resumes: bool = False  # whether dense output is as accurate as the steps, so that the motion may go on within one
    lost = SINGULAR

    def instants(self, k):
        """The ends of step k and quarters between them."""
        a, b = self.t[k : k + 2]
        return np.array([a, *(a + s * (b - a) for s in FRACTIONS), b])

    def inner_pivots(self, k):
        """Pivots (n_g, N) at `instants` except the start, evaluated if only those of the end are known."""
        if self.pivots.shape[2] > 1:
            return self.pivots[:, k]
        inner = [self.pivots_at(s, self._inside(k, s)) for s in self.instants(k)[1:-1]]
        return np.column_stack([*inner, self.pivots[:, k]])

    def state(self, k, t):
        """X from the steps at their ends, from the dense output in between."""
        at = {self.t[k]: k, self.t[k + 1]: k + 1}.get(t)
        return self._inside(k, t) if at is None else self.x[:, at]

    def _inside(self, k, t):
        return self.dense(np.array([k]), np.array([t]))[:, 0]

    def _pivot(self, k, i, t):
        return self.pivots_at(t, self._inside(k, t))[i]

    def zero(self, k, i, ends, sizes):
        """The root of pivot i between two instants."""
        from scipy.optimize import brentq

        a, b = (self._pivot(k, i, t) for t in ends)
        if np.sign(a) == np.sign(b):  # where states were projected the dense output differs from what was inspected
            return ends[0] if abs(a) < abs(b) else ends[1]
        return brentq(lambda s: self._pivot(k, i, s), *ends, xtol=1e-14)

    def least(self, k, i, instants, sizes, scale):
        """The instant in step k at which pivot i is least, and its size there relative to a scale."""
        from scipy.optimize import minimize_scalar

        low, high = sorted(self.t[k : k + 2])

        def size(t):
            return abs(self._pivot(k, i, t))

        options = {"xatol": 1e-10 * max(high - low, 1e-12)}
        least = minimize_scalar(size, bounds=(low, high), method="bounded", options=options)
        best = min([*instants, float(least.x)], key=size)
        return best, size(best) / scale

    def last_before(self, k, t):
        """The last inspected instant before t, or the start of step k if the motion resumes from steps only."""
        if not self.resumes:
            return self.t[k]
        instants = self.instants(k)
        return instants[max(int(np.searchsorted(np.abs(instants - instants[0]), abs(t - instants[0]))) - 1, 0)]


def strong(pivots, usual):
    """Whether pivots (n_g, N) keep their signs, and sizes near their largest and `usual` ones (n_g,)."""
    low, high = np.minimum.reduce(pivots, axis=1), np.maximum.reduce(pivots, axis=1)
    least, largest = np.minimum(np.abs(low), np.abs(high)), np.maximum(-low, high)
    return bool(((low * high > 0) & (least >= DEGRADED * np.maximum(largest, usual))).all())


class Monitor:
    """Pivots and matrices of a model along a motion; x at t is the state of the first references, which grow along it.

    `before` is the monitor of the variant that this one replaces. Its references stay valid for columns and for rows
    that both variants have, so that a gradient that has nearly vanished does not become its own reference.
    """

    def __init__(self, model, t, x, before=None):
        self.model = model
        self.f, self.invariants = model.function("matrices"), model.function("invariants")
        self.l_names, self.b_names = leading_names(model.reduction)
        self.reference, self.lift = None, 1.0
        self.balances = list(balances(model.reduction))
        self.derivations = [{row.name: row.derivation for row in model.reduction.rows}, {}]
        self.largest = np.abs(np.asarray(x, dtype=float))
        self.m, self.start = len(invariant_names(model)), (t, np.array(x))
        if before is not None:
            self.columns = before.columns
            self._inherit(before)

    # What follows belongs to the start, and most motions never read it.

    @cached_property
    def matrices(self):
        """L and Bᵀ at the start, with zeros where they are not finite."""
        return [np.nan_to_num(m, nan=0.0, posinf=0.0, neginf=0.0) for m in self._matrices(*self.start)]

    @cached_property
    def columns(self):
        """Sizes of the columns of L and Bᵀ."""
        return self._columns(*self.start, self.matrices)

    @cached_property
    def rows(self):
        """Sizes of the rows of L and Bᵀ, to which later ones are compared."""
        rows = [np.linalg.norm(m / c, axis=1) for m, c in zip(self.matrices, self.columns, strict=True)]
        # TᵀM grows at the zeros of a pivot; √M_ii is its size with others
        for row, i in balances(self.model.reduction).items():
            rows[0][row] = self.columns[0][i]
        return rows

    @cached_property
    def best(self):
        """The best smallest singular values of L and B so far."""
        return self._smallest(self.matrices)

    @cached_property
    def gradients(self):
        """Sizes of the invariants' gradients at the start, (m,)."""
        t, x = self.start
        jacobian = self.invariants(t, x, self.model.p)[self.m :].reshape(len(x), self.m).T
        sizes = motion_sizes(self.model, np.array([t, t + 1.0]), np.column_stack([x, x]))
        sizes = np.where(sizes > 0, sizes, 1.0) + np.abs(x)
        return np.maximum(np.sqrt((jacobian**2 * sizes**2).sum(axis=1)), 1e-300)

    def _columns(self, t, x, matrices):
        """√M_ii, with which the entries of a row have one unit; for columns without inertia the size of their entries.

        That is the largest entry in rows scaled by their columns with inertia; where all of it is zero, the size at the
        points at which ranks were decided.
        """
        inertia = self.f(t, x, self.model.p)[-self.model.n :]
        metric = np.sqrt(np.where(inertia > 0, inertia, 0.0))
        moves, result = metric > 0, []
        if moves.all():
            return [metric, metric]
        for m, usual in zip(matrices, usual_column_sizes(self.model), strict=True):
            scaled = np.abs(m) / np.where(moves, metric, 1.0)
            rows = scaled[:, moves].max(axis=1, initial=0.0)
            rows = np.where(rows > 0, rows, scaled.max(axis=1, initial=0.0))[:, None]
            now = (scaled / np.where(rows > 0, rows, 1.0)).max(axis=0, initial=0.0)
            massless = np.where(now > 0, now, np.where(usual > 0, usual, 1.0))
            result.append(np.where(moves, metric, massless))
        return result

    def _inherit(self, before):
        for i, names in enumerate((self.l_names, self.b_names)):
            old = dict(zip((before.l_names, before.b_names)[i], before.rows[i], strict=True))
            for j, name in enumerate(names):
                if name in old and self.derivations[i].get(name) == before.derivations[i].get(name):
                    self.rows[i][j] = old[name]
        self.largest = np.maximum(self.largest, before.largest)
        now = self._smallest(self.matrices)
        self.best = np.maximum(now, before.best)
        self.lift = 1.0 / max(float(np.min(now / np.where(self.best > 0, self.best, 1.0))), DEGRADED)

    def _matrices(self, t, x):
        n = self.model.n
        y = self.f(t, x, self.model.p)
        rows = len(self.l_names)
        return y[: rows * n].reshape(n, rows).T, y[rows * n : -n].reshape(n, len(self.b_names)).T

    def _smallest(self, matrices, rows=None):
        """The smallest singular values of L and B, their rows scaled by `rows`; default: by the references.

        Rows TᵀM of (3.18) hold quotients of pivots; an orthonormal basis of their span does not.
        """
        result = []
        for m, c, r, some in zip(matrices, self.columns, rows or self.rows, (self.balances, []), strict=True):
            scaled = (m / c) / np.where(r > 0, r, 1.0)[:, None] if np.all(np.isfinite(m)) else m
            finite = scaled.size and np.all(np.isfinite(m))
            if finite and some:
                scaled[some] = np.linalg.qr(scaled[some].T)[0].T
            result.append(np.linalg.svd(scaled, compute_uv=False)[-1] if finite else (0.0 if scaled.size else 1.0))
        return np.array(result)

    def rank_measure(self, t, x):
        """The smallest scaled singular value of L or of B, relative to the best so far unless that is rounding."""
        self.largest = np.maximum(self.largest, np.abs(x))
        now = self._smallest(self._matrices(t, x))
        self.best = np.maximum(self.best, now)
        return float(np.min(now / np.where(self.best > HOPELESS, self.best, 1.0)))

    def begin(self, pivots):
        """Start a piece: the first step is compared with the pivots (n_g,) at its start."""
        self.sunk = None
        self.recent = self._relative(pivots[:, None])[0]

    def _relative(self, pivots):
        """Pivots (n_g, N) relative to their largest sizes up to each instant, and these sizes."""
        sizes = np.abs(pivots)
        sizes = np.where(np.isfinite(sizes), sizes, 0.0)
        if self.reference is None:
            sizes[:, 0] *= self.lift
        else:
            sizes[:, 0] = np.maximum(sizes[:, 0], self.reference)
        largest = np.maximum.accumulate(sizes, axis=1)
        self.reference = largest[:, -1]
        return pivots / np.where(largest > 0, largest, 1.0), largest

    def inspect(self, stretch):
        """Inspect the pivots along steps that continue the inspected ones: Fine, Repivot or Singular."""
        n_g, count, m = stretch.pivots.shape
        if not stretch.pivots.size or self._all_strong(stretch.pivots.reshape(n_g, -1)):
            return Fine(count)
        pole = self._pole(stretch)
        if pole is not None:
            return pole
        relative, largest = self._relative(stretch.pivots.reshape(n_g, -1))
        track = np.column_stack([self.recent, relative])
        first = self.recent.shape[1] - 1
        weak = np.any(np.abs(track[:, first:]) < DEGRADED, axis=0)
        changed = np.any(np.sign(track[:, first:-1]) * np.sign(track[:, first + 1 :]) < 0, axis=0)
        suspicious = np.any((weak[1:] | changed).reshape(count, m), axis=1) | weak[:-1:m]
        last = -1
        for k in np.flatnonzero(suspicious):
            if k > last + 1:
                self.sunk = None
            start = first + k * m
            scale = largest[:, (k + 1) * m - 1]
            outcome = self._step(stretch, k, track[:, max(start - 1, 0) : start + 1], np.where(scale > 0, scale, 1.0))
            if outcome is not None:
                return outcome
            last = k
        if last < count - 1:
            self.sunk = None
        self.recent = track[:, -2:]
        return Fine(count)

    def _all_strong(self, pivots):
        """Whether pivots (n_g, N) keep their signs and their sizes so well that nothing else needs to be inspected."""
        last, sizes = self.recent[:, -1], np.abs(pivots)
        before = np.maximum(sizes[:, :-1].max(axis=1, initial=0.0), self.reference)
        largest = np.maximum(before, sizes[:, -1])
        weakest = np.minimum((pivots * np.sign(last)[:, None]).min(axis=1), np.abs(last) * largest)
        usual = np.maximum(self.reference, pivot_sizes(self.model))
        if not ((weakest > DEGRADED * largest).all() and (NEGLIGIBLE * largest <= usual).all()):
            return False
        earlier = pivots[:, -2] / before if pivots.shape[1] > 1 else last
        self.sunk, self.reference, self.recent = None, largest, np.array([earlier, pivots[:, -1] / largest]).T
        return True

    def _pole(self, stretch):
        """Singular where a pivot grows without bound in one step, as that of a row divided by a speed that vanishes."""
        ends = np.abs(stretch.pivots[:, :, -1])
        largest = np.maximum(self.reference, pivot_sizes(self.model))[:, None]
        before = np.maximum.accumulate(np.column_stack([largest, ends]), axis=1)[:, :-1]
        for k in np.flatnonzero(np.any(NEGLIGIBLE * ends > before, axis=0)):
            t, x = stretch.t[k + 1], stretch.x[:, k + 1]
            if self._unbounded(self._matrices(t, x)):  # else an earlier pivot vanishes, by which this one is divided
                return Singular(int(k), t, x, "a pivot grows without bound")
        return None

    def _unbounded(self, matrices):
        """Whether gradients of constraints, or actuators, are far larger than ever, or not finite."""
        given = [self.model.reduction.original.get(name) is not None for name in self.l_names]
        for m, c, largest, some in zip(matrices, self.columns, self.rows, (given, slice(None)), strict=True):
            sizes = np.linalg.norm(m / c, axis=1)[some]
            if np.any(~(NEGLIGIBLE * sizes <= np.where(largest > 0, largest, 1.0)[some])):
                return True
        return False

    def _step(self, stretch, k, before, scale):
        """The outcome of one step, None if it is fine; `before` are the relative pivots at and before its start."""
        instants, after = stretch.instants(k), stretch.inner_pivots(k) / scale[:, None]
        track = np.column_stack([before[:, -1], after])
        changed = np.argwhere(np.sign(track[:, :-1]) * np.sign(track[:, 1:]) < 0)
        if len(changed):
            i, j = changed[np.argmin(changed[:, 1])]
            t = stretch.zero(k, i, instants[j : j + 2], track[i, j : j + 2])
            return self._vanishing(stretch, k, t, "a pivot changes its sign")
        t = self._touched(stretch, k, np.abs(np.column_stack([before, after])), scale)
        if t is not None:
            return self._vanishing(stretch, k, t, "a pivot touches zero")
        sizes = np.abs(track[:, 1:])
        if sizes.min() < NEGLIGIBLE:
            return self._vanishing(stretch, k, instants[1 + np.argmin(sizes.min(axis=0))], "a pivot has vanished")
        weakest = np.abs(track[np.argmin(sizes[:, -1])])
        lingering = self._lingers(k, instants[-2:], weakest[-2:], stretch.x[:, k + 1])
        if lingering is not None:
            return lingering
        t, x = stretch.t[k + 1], stretch.x[:, k + 1]
        definite = self.model.reduction.realisation.definite
        degraded = weakest[-1] < DEGRADED and (definite or self.pivots_only(weakest[-1], t, x))
        return _other_pivots(k + 1, t, x) if degraded else None

    def _touched(self, stretch, k, sizes, scale):
        """The instant in a step at which a pivot is least, if the residual may hide a zero there; else None."""
        middle = sizes[:, 1:-1]
        low = (middle < sizes[:, :-2]) & (middle <= sizes[:, 2:]) & (middle < DEGRADED)
        for i in np.argwhere(low.T)[:, 1]:
            t, size = stretch.least(k, i, stretch.instants(k), sizes[i, -len(stretch.instants(k)) :], scale[i])
            if self.hidden_zero(size, t, stretch.state(k, t)):
                return t
        return None

    def _vanishing(self, stretch, k, t, why):
        """The outcome of a pivot that vanishes at t in step k: another choice of pivots, or a singular program."""
        if self.at_zero(stretch, k, t) > stretch.lost:
            if stretch.crosses:
                return _other_pivots(k + 1, stretch.t[k + 1], stretch.x[:, k + 1])
            before = stretch.last_before(k, t)
            return _other_pivots(k, before, stretch.state(k, before))
        x, before = stretch.state(k, t), stretch.last_before(k, t)
        singular, start = Singular(k, t, x, why), stretch.state(k, before)
        variant = self.repivoted(before, start, stretch.top(before, start))
        helps = variant is not None and variant[1].at_zero(stretch, k, t) > stretch.lost
        return Repivot(k, before, start, variant, singular) if helps else singular

    def at_zero(self, stretch, k, t):
        """The rank measure at a zero of a pivot in step k, relative to the larger one at the step's ends.

        Rows are measured by their sizes at these ends: gradients may fall along the whole motion, as 1/r where a row
        is an angle or its rate. Where the motion so far was far better, these sizes become the references. It is zero
        where the residual may hide a zero.
        """
        t += NEXT * max(stretch.t[k : k + 2] - t, key=abs)  # at the zero itself, quotients of pivots have no value
        x = stretch.state(k, t)
        if self.rank_measure(t, x) < min(LOST, self._hides(stretch.t[k + 1], stretch.x[:, k + 1])):
            return 0.0
        ends = [self._matrices(s, stretch.state(k, s)) for s in stretch.t[k : k + 2]]
        rows = [np.max([np.linalg.norm(m[i] / c, axis=1) for m in ends], axis=0) for i, c in enumerate(self.columns)]
        here, *beside = (self._smallest(m, rows) for m in (self._matrices(t, x), *ends))
        larger = np.maximum(*beside)
        result = float(np.min(here / np.where(larger > 0, larger, np.inf)))
        if result > stretch.lost and self.rank_measure(t, x) < LOST:
            self.rows, self.best = rows, here
        return result

    def _lingers(self, k, instants, sizes, x):
        """Singular if a pivot sank below what the residual hides, should have crossed zero by now, and stays there."""
        t = instants[1]
        if sizes[1] >= DEGRADED or not self.hidden_zero(sizes[1], t, x):
            self.sunk = None
            return None
        if self.sunk is None:
            slope = (sizes[0] - sizes[1]) / abs(t - instants[0])
            ahead = sizes[1] / slope if slope > 0 else 0.0
            self.sunk = (t + np.copysign(ahead, t - instants[0]), ahead, x)
        crossing, ahead, at = self.sunk
        if abs(t - crossing) < LINGERS * ahead or (t - crossing) * (t - instants[0]) < 0:
            return None
        return None if self.pivots_only(sizes[1], t, x) else Singular(k, crossing, at, "a pivot stays at zero")

    def lost(self, t, x):
        """Whether a loss of rank, not the integrator, explains that no step succeeds at a state."""
        return self.rank_measure(t, x) < LOST or float(self.best.min()) < HOPELESS

    def hidden_zero(self, relative, t, x):
        """Whether a relative pivot, or the rank measure, is so small that the residual may hide a zero."""
        return min(relative, self.rank_measure(t, x)) < self._hides(t, x)

    def _hides(self, t, x):
        """Below which the residual at a state may hide a zero."""
        values = self.invariants(t, x, self.model.p)[: self.m]
        residual = np.abs(values / self.gradients).max(initial=0.0)  # relative to the gradients at the start
        return max(NEGLIGIBLE, HIDES * np.sqrt(residual))

    def pivots_only(self, relative, t, x):
        """Whether a degraded pivot is only badly chosen: the matrices themselves are far better."""
        return self.rank_measure(t, x) > HELPS * max(abs(relative), NEGLIGIBLE)

    def refuse_start(self, t, x, outputs, pivots):
        """The error of a start whose accelerations or pivots have no value with any choice of pivots, or None."""
        if not np.all(np.isfinite(outputs)):
            return self.singular(t, x, "the accelerations are not finite there")
        weakest = self._weakest(pivots)
        why = f"a pivot is {weakest:.1e} of its size nearby"
        return self.singular(t, x, why) if weakest < ENTRY else None

    def without_value(self, outputs, pivots):
        """Whether accelerations at the start are not finite, or divided by a pivot that is zero."""
        return not np.all(np.isfinite(outputs)) or self._weakest(pivots) < ENTRY

    def bad_choice(self, outputs, pivots):
        """Whether outputs at the start are not finite, or pivots are zero or far worse than the matrices."""
        if not np.all(np.isfinite(outputs)):
            return True
        weakest = self._weakest(pivots)
        return weakest < ENTRY or bool(weakest < DEGRADED and self.best.min() > HELPS * weakest)

    def _weakest(self, pivots):
        """The smallest pivot, each relative to its size where pivots were chosen."""
        reference = pivot_sizes(self.model)
        return float((np.abs(pivots) / np.where(reference > 0, reference, 1.0)).min(initial=1.0))

    def repivoted(self, t, x, top):
        """The model with pivots chosen at x and γ^(s̄) = top, and its monitor; None if no choice succeeds.

        With the same rows, solved without a choice of pivots, or derived again where these have lost their rank.
        """
        jets = np.append(x, np.nan_to_num(top))
        blocks = self.model.reduction.cascade is not None  # whose matrices have no value where their pivots vanish
        model = strong_form(self.model, t, jets) if blocks or self.rank_measure(t, x) > LOST else None
        sizes = {name: size for name, size in zip(self.model.state_names, self.largest, strict=True) if size > 0}
        try:
            model = model or derived_near(self.model, t, jets, sizes)
            return model, Monitor(model, t, x, self)
        except ServoError:
            return None

    def failed(self, t, x, why, told, row):
        """The error of a state from which no step succeeds: singular for the reason `why`, or the method's own.

        The latter has `told` what happened and what to do, and of which residual, if of one.
        """
        if self.lost(t, x):
            return self.singular(t, x, why)
        what, do = told
        return IntegrationStopped(
            f"{what}.",
            "A motion is integrated as far as its solution exists and steps succeed.",
            do=f"{do} The run before this instant is in .run.",
            t=float(t),
            **({"residual": row} if row else {}),
        )

    def singular(self, t, x, why):
        """The error that names the instant, the rows that lose rank, and the jets that are zero there."""
        matrices = self._matrices(t, x)
        measure = self.rank_measure(t, x)
        lost, zero, names = [], [], (self.l_names, self.b_names)
        for m, c, r, rows in zip(matrices, self.columns, self.rows, names, strict=True):
            norms = np.linalg.norm(m / c, axis=1)
            lost += [name for name, a, b in zip(rows, norms, r, strict=True) if a <= VANISHING * b and name not in lost]
        state = dict(zip(self.model.state_names, zip(x, self.largest, strict=True), strict=True))
        for row in lost or dict.fromkeys([*self.l_names, *self.b_names]):
            for name in gradient_jets(self.model.reduction, row):
                value, largest = state.get(name, (1.0, 1.0))
                if abs(value) < VANISHING * max(largest, 1e-12) and name not in zero:
                    zero.append(name)
        forces = self._smallest(matrices)[0] > LOST * self.best[0]  # L keeps its rank, and Bᵀ has lost its own
        direction = self._null_direction(matrices, int(forces))
        where = f", where {' and '.join(f'{name} = 0' for name in zero)}" if zero else ""
        dependent = [] if lost else self._dependent_rows(matrices, int(forces))
        facts = {"measure": measure, "rows": lost or dependent, "direction": direction}
        at_zero = np.where([name in zero for name in self.model.state_names], 0.0, x)
        explained = explain(self.model, t, at_zero, lost, **facts)
        if explained is not None:
            return explained
        what = f"the {'direction' if forces else 'gradient'} of row {', '.join(map(repr, lost))} vanishes"
        what = what if lost else f"the rows {', '.join(map(repr, dependent))} lose their rank"
        return SingularProgram(
            f"The program is singular at t = {t:.7g} s: {what}{where}; {why}.",
            f"{self._how_small(measure)}{'The actuation or a reaction is' if forces else 'Accelerations are'} "
            f"undetermined in the direction of {', '.join(direction)}.",
            do=f"{self._advice(lost or dependent)} The run before it is in .run.",
            t=float(t),
            measure=measure,
            rows=lost or dependent,
            zero=zero,
            direction=direction,
        )

    def _advice(self, lost):
        """What to do where rows lose their rank: as designed rows can be written otherwise, derived ones cannot."""
        r = self.model.reduction
        as_written = (row for row in r.rows if row.name in r.original and not row.derivation)
        written = {row.name: row.order for row in as_written if row.name in lost}
        actuators, residuals = r.mechanism.actuators, r.program.residuals
        if written and not any(written.values()):
            return (
                "Plan a path that keeps away from this state, as from the edge of what the machine reaches, or write "
                "the residual in a form whose gradient does not vanish there."
            )
        if written:
            return (
                "Write the residual in a form whose gradient does not vanish (linear in velocities, not squared), or "
                "plan around this state."
            )
        if r.program.by == "actuators" and len(actuators) > len(residuals) and {*actuators}.intersection(lost):
            return (
                f"Program as many residuals as there are actuators, {len(actuators)}: weights choose among them, and "
                "here one acts on no residual. Or plan around this state."
            )
        return "Plan around this state, or program other outputs."

    def _how_small(self, measure):
        """The rank measure as a sentence; a motion that begins at a singular state has no better one, or none."""
        best = float(self.best.min())
        small = f"{best:.1e} from the first instant on" if best < HOPELESS else f"{measure:.1e} of its best so far"
        sentence = f"The smallest singular value, rows of size 1 in the metric of the inertia, is {small}. "
        return sentence if min(best, measure) < LOST else ""

    def _dependent_rows(self, matrices, i):
        """Names of the rows of L, or of Bᵀ for i = 1, that depend on each other: its left null vector."""
        names = (self.l_names, self.b_names)[i]
        if not np.all(np.isfinite(matrices[i])):
            return list(names)
        scaled = matrices[i] / self.columns[i]
        norms = np.linalg.norm(scaled, axis=1)[:, None]
        scaled = scaled / np.where(norms > 0, norms, 1.0)
        weights = np.abs(np.linalg.svd(scaled)[0][:, -1])
        return [names[j] for j in np.flatnonzero(weights > SHARE * weights.max())]

    def _null_direction(self, matrices, i):
        """Names of the accelerations that the rows leave open: the right null vector of L, or of Bᵀ for i = 1."""
        leading, columns = matrices[i], self.columns[i]
        names = self.model.jet_names[-self.model.n :]
        if not np.all(np.isfinite(leading)):
            return list(names)
        rows = np.linalg.norm(leading / columns, axis=1)
        vector = np.abs(np.linalg.svd((leading / columns) / np.where(rows > 0, rows, 1.0)[:, None])[2][-1] / columns)
        return [names[j] for j in np.flatnonzero(vector > SHARE * vector.max())]
