"""The rank along a motion: steps with weak pivots, and whether the program is singular in them.

A pivot that is small, or changes its sign, is badly chosen or shows that the rank is lost. The least singular values of
the scaled L and B decide: where one of them is zero, as far as the state is known, the program is singular.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from servoctl.model.equations import balances, invariant_names, leading_names
from servoctl.model.pivots import pivot_sizes, row_pivots, usual_column_sizes
from servoctl.reduction.range_space import OF_CHOICE
from servoctl.tolerances import ENTRY
from servoctl.values import frozen

DEGRADED = 0.02  # of its reference: a pivot below this is weak
HELPS = 5.0  # times a weak pivot: the rank measure of a matrix for which other pivots are better
NEGLIGIBLE = 1e-7  # of its reference: a pivot below this is zero, and one of which the reference is this is infinite
HOPELESS = 1e-9  # an equilibrated singular value below this leaves no digits
LOST = 0.1  # of its best: below this, rank is why no step succeeds
ERRS = 10.0  # times its tolerance, and the way to its invariants, by which a state may be wrong
NEXT = 1e-3  # of a step: the distance from its start of an instant inside, where no step lies before
SAMPLED = 8  # of a step with weak pivots, at whose ends singular values are taken
VANISHES = "rank is lost there"
CLOSELY = {"xatol": 1e-10}  # of the distance between its neighbours, to which a least value is located


@frozen
class Fine:
    """The pivots allow all `steps` steps."""

    steps: int


@frozen
class Singular:
    """After `steps` whole steps the motion ends at t [s], X = x: the program is singular there, or soon, `at` [s]."""

    steps: int
    t: float
    x: np.ndarray
    at: float
    why: str


@frozen
class Weak:
    """After `steps` whole steps the motion goes on from t [s], X = x with other pivots."""

    steps: int
    t: float
    x: np.ndarray


@frozen
class Stretch:
    """Steps with ends t (S + 1,) [s], states x (n_x, S + 1) there, and pivots (n_g, S, m) after parts of each step.

    The last of the parts (m,) is 1, the step's end. `dense` gives states (n_x, N) from steps k (N,) and times (N,) [s],
    `slope` their derivatives. Steps that `cross` a zero of a pivot are as accurate as others; within those of a series
    the motion `resumes`.
    """

    t: np.ndarray
    x: np.ndarray
    parts: np.ndarray
    pivots: np.ndarray
    dense: object
    crosses: bool = False
    slope: object = None
    resumes: bool = False

    def first(self, count):
        """The first steps alone."""
        if count >= len(self.t) - 1:
            return self
        return replace(self, t=self.t[: count + 1], x=self.x[:, : count + 1], pivots=self.pivots[:, :count])

    def state(self, k, t):
        """X at an instant of step k."""
        at = {self.t[k]: k, self.t[k + 1]: k + 1}.get(t)
        return self.dense(np.array([k]), np.array([t]))[:, 0] if at is None else self.x[:, at]


def strong(pivots, usual):
    """Whether pivots (n_g, N) keep their signs, and sizes near their largest and `usual` ones (n_g,)."""
    low, high = np.minimum.reduce(pivots, axis=1), np.maximum.reduce(pivots, axis=1)
    least, largest = np.minimum(np.abs(low), np.abs(high)), np.maximum(-low, high)
    return bool(((low * high > 0) & (least >= DEGRADED * np.maximum(largest, usual))).all())


def may_vanish(t, sizes):
    """Where sizes (m, N) at t (N,) have a least one among three that may have been zero beside it, (m, N - 2).

    It is zero there if they fell on as steeply as on the steeper side.
    """
    (before, here, after), h = (sizes[:, a : a + len(t) - 2] for a in range(3)), np.diff(t)
    with np.errstate(all="ignore"):
        ahead, back = (before - here) * h[1:] / h[:-1], (after - here) * h[:-1] / h[1:]
    return (here <= np.fmin(before, after)) & (here < np.fmax(ahead, back))


class Rank:
    """L and B along a motion from x (n_x,) at t [s], whose states err by `error` times a tolerance.

    The model may change to one of the same rows with other pivots (`go_on`).
    """

    def __init__(self, model, t, x, tolerance, error=1.0):
        self.first, self.start, self.tolerance, self.error = model, (t, np.array(x)), tolerance, error
        self.names, self.balances = leading_names(model.reduction), balances(model.reduction)
        self.largest = np.abs(np.asarray(x, dtype=float))

    def begin(self, model, t, pivots):
        """Start a piece at t [s] with pivots (n_g,) of a model; the first step is compared with them."""
        self.model, self.reference, self.before = model, np.nan_to_num(np.abs(pivots), posinf=0.0), None
        self.recent = np.array([t]), pivots[:, None]  # the last two instants, and pivots there
        self.followed = np.full(len(pivots), np.inf)  # sizes of weak pivots where the rank was last followed

    def go_on(self, model, pivots, t, x):
        """Go on from a state with a model of the same rows."""
        self.begin(model, t, pivots)
        self.reference = self.reference / max(self.measure(t, x), DEGRADED)

    # What follows belongs to the start, and most motions never read it.

    @cached_property
    def columns(self):
        """Sizes of the columns of L and Bᵀ: √M_ii, with which the entries of a row have one unit.

        Without inertia that of the entries, in rows scaled by the columns that have it.
        """
        (t, x), first, n, result = self.start, self.first, self.first.n, []
        inertia = first.function("matrices")(t, x, first.p)[-n:]
        metric = np.sqrt(np.where(inertia > 0, inertia, 0.0))
        moves = metric > 0
        for m, usual in zip(self.matrices(t, x), usual_column_sizes(first), strict=True):
            scaled = np.abs(np.nan_to_num(m, nan=0.0, posinf=0.0, neginf=0.0)) / np.where(moves, metric, 1.0)
            rows = scaled[:, moves].max(axis=1, initial=0.0)
            rows = np.where(rows > 0, rows, scaled.max(axis=1, initial=0.0))[:, None]
            now = (scaled / np.where(rows > 0, rows, 1.0)).max(axis=0, initial=0.0)
            massless = np.where(now > 0, now, np.where(usual > 0, usual, 1.0))
            result.append(np.where(moves, metric, massless))
        return result

    @cached_property
    def rows(self):
        """Sizes of the rows of L and Bᵀ at the start, to which later ones are compared."""
        return self.norms(*self.start)

    @cached_property
    def best(self):
        """The largest least singular values of L and B so far."""
        return self.least(*self.start)

    def matrices(self, t, x):
        """L and Bᵀ at a state."""
        return [m[0] for m in self._stacked(t, x[:, None])]

    def norms(self, t, x):
        """Sizes of their rows; those of rows TᵀM, which grow at the zeros of a pivot, are those of M."""
        sizes = [np.linalg.norm(m / c, axis=1) for m, c in zip(self.matrices(t, x), self.columns, strict=True)]
        for row, i in self.balances.items():
            sizes[0][row] = self.columns[0][i]
        return sizes

    def _stacked(self, t, x):
        """L (N, n, n) and Bᵀ (N, b, n) at times (N,) and states (n_x, N)."""
        n, y, result = self.first.n, self.first.function("matrices").grid(t, x, self.first.p).T, []
        for count in map(len, self.names):
            result.append(y[:, : count * n].reshape(-1, n, count).swapaxes(1, 2))
            y = y[:, count * n :]
        return result

    def along(self, t, x, rows):
        """The least singular values of L and B, (2, N), their rows relative to sizes; NaN where they have no values.

        Rows TᵀM of (3.18) hold quotients of pivots. An orthonormal basis of their span does not, and where a pivot is
        zero its limit is that of a state so near that none could tell them apart.
        """
        result, stacked = np.ones((2, x.shape[1])), self._stacked(t, x)
        if not all(np.isfinite(m).all() for m in stacked):
            aside = self._stacked(t, x + self.tolerance.states(x) * np.cos(np.arange(len(x)))[:, None])
            pairs = zip(stacked, aside, strict=True)
            stacked = [np.where(np.isfinite(m).all(axis=(1, 2), keepdims=True), m, beside) for m, beside in pairs]
        for i, (m, c, r) in enumerate(zip(stacked, self.columns, rows, strict=True)):
            known, some = np.isfinite(m).all(axis=(1, 2)), [] if i else [*self.balances]
            scaled = m[known] / c / np.where(r > 0, r, 1.0)[:, None]
            if some:
                scaled[:, some] = np.linalg.qr(scaled[:, some].swapaxes(1, 2))[0].swapaxes(1, 2)
            if len(r):
                result[i] = np.nan
                result[i, known] = np.linalg.svd(scaled, compute_uv=False)[:, -1]
        return result

    def least(self, t, x):
        """The least singular values of L and B at a state, (2,); 0 where they are not finite."""
        return np.nan_to_num(self.along(t, x[:, None], self.rows)[:, 0])

    def sign(self, t, x):
        """The sign of the determinant of [M -B; G 0], or 0 where other rows divide by pivots, which may change it."""
        L, Bt = self.matrices(t, x)
        dependent = list(self.first.reduction.realisation.dependent)
        square = L.shape[0] == L.shape[1] and len(dependent) == len(Bt)
        if not (square and all(name.startswith(OF_CHOICE) for name in row_pivots(self.first)) and np.isfinite(L).all()):
            return 0.0
        return float(np.linalg.slogdet(L)[0] * np.linalg.slogdet(Bt[:, dependent])[0])

    def measure(self, t, x):
        """The least singular value of L or of B, relative to its best so far unless that is rounding."""
        self.largest = np.maximum(self.largest, np.abs(x))
        now = self.least(t, x)
        self.best = np.maximum(self.best, now)
        return float(np.min(now / np.where(self.best > HOPELESS, self.best, 1.0)))

    def lost(self, t, x):
        """Whether a loss of rank, not the integrator, explains that no step succeeds at a state."""
        return self.measure(t, x) < LOST or float(self.best.min()) < HOPELESS

    def without_value(self, outputs, pivots):
        """Whether accelerations at the start are not finite, or divided by a pivot that is zero."""
        return not np.all(np.isfinite(outputs)) or self.weakest(pivots) < ENTRY

    def bad_choice(self, outputs, pivots):
        """Whether that is so, or pivots at the start are far worse than the matrices."""
        weakest = self.weakest(pivots)
        degraded = weakest < DEGRADED and bool(self.best.min() > HELPS * weakest)
        return degraded or self.without_value(outputs, pivots)

    def weakest(self, pivots):
        """The smallest pivot, each relative to its size where pivots were chosen."""
        usual = pivot_sizes(self.model)
        return float((np.abs(pivots) / np.where(usual > 0, usual, 1.0)).min(initial=1.0))

    # What follows inspects steps.

    def inspect(self, stretch):
        """Inspect steps that continue the inspected ones: Fine, Weak or Singular."""
        count = stretch.pivots.shape[1]
        before, self.before = self.before, stretch
        if not stretch.pivots.size:
            return Fine(count)
        pole = self._pole(stretch)
        if pole is not None:
            return pole
        sudden, changed, least = self._pivots_in(stretch)
        weak = least < DEGRADED
        for k in map(int, np.flatnonzero(sudden | weak.any(axis=0))):
            self.followed[~weak[:, k - 1 : k].any(axis=1) & (k > 0)] = np.inf
            falls = 2 * least[:, k] < self.followed  # a pivot that stays weak is looked at again where it has halved
            found = self._singular(stretch, k, before) if sudden[k] or falls.any() else None
            found = found or self._weak(stretch, k, changed[:, k], least[:, k])
            if found is not None:
                return found
            self.followed = np.where(falls, least[:, k], self.followed)
        self.followed[~weak[:, -1]] = np.inf
        return Fine(count)

    def _pivots_in(self, stretch):
        """In which steps a pivot may have been zero (S,): it changes its sign (n_g, S), or turns; least sizes (n_g, S).

        Sizes are relative to the largest so far; what is not finite has none.
        """
        (before, known), (n_g, count, m) = self.recent, stretch.pivots.shape
        t = np.append(before, stretch.t[:-1, None] + np.diff(stretch.t)[:, None] * stretch.parts)
        track = np.nan_to_num(np.column_stack([known, stretch.pivots.reshape(n_g, -1)]), posinf=0.0, neginf=0.0)
        sizes, signs, first = np.abs(track), np.sign(track), len(before)
        largest = np.maximum(np.maximum.accumulate(sizes, axis=1), self.reference[:, None])
        turned, beside = np.zeros(len(t), dtype=bool), may_vanish(t, sizes).any(axis=0)
        turned[1:-1] |= beside  # the zero lies before or after the least of three
        turned[2:] |= beside
        self.recent, self.reference = (t[-2:], track[:, -2:]), largest[:, -1]
        changed = (signs[:, :-1] * signs[:, 1:] < 0)[:, first - 1 :].reshape(n_g, count, m).any(axis=2)
        ends = np.maximum(largest[:, first + m - 1 :: m], np.finfo(float).tiny)
        least = np.fmin(sizes[:, first:].reshape(n_g, count, m).min(axis=2), sizes[:, first - 1 : -1 : m]) / ends
        return changed.any(axis=0) | turned[first:].reshape(count, m).any(axis=1), changed, least

    def _pole(self, stretch):
        """Singular where a pivot grows without bound in one step, as that of a row divided by a speed that vanishes."""
        ends = np.abs(stretch.pivots[:, :, -1])
        largest = np.maximum(self.reference, pivot_sizes(self.model))[:, None]
        before = np.maximum.accumulate(np.column_stack([largest, ends]), axis=1)[:, :-1]
        for k in np.flatnonzero(np.any(NEGLIGIBLE * ends > before, axis=0)):
            t, x = stretch.t[k + 1], stretch.x[:, k + 1]
            if self._unbounded(t, x):  # else an earlier pivot vanishes, by which this one is divided
                return Singular(int(k), t, x, t, "a pivot grows without bound")
        return None

    def _unbounded(self, t, x):
        """Whether gradients of constraints, or actuators, are far larger than ever, or not finite."""
        given = [self.first.reduction.original.get(name) is not None for name in self.names[0]]
        for m, c, largest, some in zip(self.matrices(t, x), self.columns, self.rows, (given, slice(None)), strict=True):
            sizes = np.linalg.norm(m / c, axis=1)[some]
            if np.any(~(NEGLIGIBLE * sizes <= np.where(largest > 0, largest, 1.0)[some])):
                return True
        return False

    def _weak(self, stretch, k, changed, least):
        """The outcome of step k if other pivots are better there, by signs that change and least sizes (n_g,)."""
        among = slice(len(row_pivots(self.model))) if self.model.reduction.orthogonal else slice(None)
        changed, least = changed[among], least[among]
        t, x = stretch.t[k + 1], stretch.x[:, k + 1]
        if not len(least) or not changed.any() and self.measure(t, x) < HELPS * max(least.min(), NEGLIGIBLE):
            return None
        steps = k + (stretch.crosses and bool(np.isfinite(stretch.pivots[:, k, -1]).all()))
        t = self._strong_until(stretch, k) if stretch.resumes else stretch.t[steps]
        return Weak(steps, t, stretch.state(k, t))

    def _strong_until(self, stretch, k):
        """The last inspected instant of step k before a pivot is weak or has changed its sign."""
        pivots = stretch.pivots[:, k]
        strong = pivots * np.sign(pivots[:, :1]) >= DEGRADED * self.reference[:, None]
        good = int(np.argmin(np.append(strong.all(axis=0), False)))
        return stretch.t[k] + (stretch.parts[good - 1] * (stretch.t[k + 1] - stretch.t[k]) if good else 0.0)

    def _singular(self, stretch, k, before):
        """The outcome of step k if the rank is lost in it: where a least value is zero, or from its start on."""
        along = _Along(self, stretch, k, stretch if k else before)
        (start, end), signs = along.span, [self.sign(*place) for place in along.ends]
        if signs[0] * signs[1] < 0:
            t = self._change_of_sign(along, signs[0])
        else:
            value, t, i, allowed = min(along.least(), default=(np.inf, end, 0, 0.0))
            doubt = self._doubt(t, along)
            if not value <= allowed + doubt[i]:
                stays = np.flatnonzero((along.sizes <= doubt[:, None]).all(axis=1))
                if not len(stays) or start == self.start[0]:
                    return None
                t = along.zero(stays[0])
        last = t if (t - start) * (t - end) < 0 else start
        return Singular(k, last, along.state(t if abs(t - start) < abs(end - start) else end), t, VANISHES)

    def _change_of_sign(self, along, sign):
        """The instant at which the determinant changes the sign that it has at the start of a step, by bisection."""
        a, b = along.span
        while (middle := (a + b) / 2) not in (a, b):
            a, b = (middle, b) if self.sign(middle, along.state(middle)) == sign else (a, middle)
        return b

    def _doubt(self, t, along):
        """By how much the least singular values at an instant may be wrong as the state is, (2,).

        That is by its tolerances, and by the way to its invariants from the ends of the step, which grows where the
        rank of these is lost.
        """
        x, model = along.state(t)[:, None], self.model
        sizes, m, ways = self.tolerance.states(x), len(invariant_names(model)), self.error * np.eye(len(x))
        if m:
            f = model.function("invariants")
            slopes, off = f(t, x[:, 0], model.p)[m:].reshape(-1, m).T, [f(*end, model.p)[:m] for end in along.ends]
            if np.isfinite(slopes).all() and np.isfinite(off).all():
                ways = np.column_stack([ways, np.linalg.lstsq(slopes * sizes.T, np.transpose(off), rcond=None)[0]])
        lengths = np.fmax(np.abs(ways).max(axis=0), 1.0)
        moved = sizes * ways / lengths
        least = self.along(t, x + np.column_stack([0.0 * x, moved, -moved]), along.rows)
        change = np.nan_to_num(np.abs(least[:, 1:] - least[:, :1])).reshape(2, 2, -1).max(axis=1)
        return ERRS * change @ lengths


class _Along:
    """The least singular values along step k of a stretch, and at an instant in the step `before`, if it is known."""

    def __init__(self, rank, stretch, k, before):
        self.rank, self.stretch, self.k, self.before = rank, stretch, k, before
        start, end = self.span = stretch.t[k : k + 2]
        self.t = np.linspace(start, end, SAMPLED + 1)
        if before is not None and start in before.t[1:]:
            self.earlier = int(np.flatnonzero(before.t[1:] == start)[0])
            part = max(1.0 / SAMPLED, 1.0 - np.append(0.0, before.parts)[-2])  # from the last inspected instant on
            self.t = np.append(start - part * (start - before.t[self.earlier]), self.t)
        else:
            self.t = np.insert(self.t, 1, start + NEXT * (end - start))
        self.ends = [(t, self.state(t)) for t in self.span]
        sizes = zip(*(rank.norms(*place) for place in self.ends), strict=True)
        self.rows = [np.fmax(*np.nan_to_num(pair, posinf=0.0)) for pair in sizes]
        inside = (self.t - start) * (end - start) > 0
        states = np.column_stack([self.ends[0][1]] * len(self.t))
        states[:, inside] = stretch.dense(np.full(inside.sum(), k), self.t[inside])
        states[:, -1] = self.ends[1][1]
        states[:, 0] = self.state(self.t[0])
        self.sizes = rank.along(self.t, states, self.rows)

    def state(self, t):
        """X at an instant [s]."""
        start, end = self.span
        earlier = (t - start) * (end - start) < 0
        return self.before.state(self.earlier, t) if earlier else self.stretch.state(self.k, t)

    def value(self, t):
        """The least singular values of L and B there, (2,)."""
        return self.rank.along(t, self.state(t)[:, None], self.rows)[:, 0]

    def zero(self, i):
        """Where one of them is zero if it falls on as in the step, else the start of the step."""
        (start, end), first, last = self.span, self.sizes[i, 1], self.sizes[i, -1]
        part = first / (first - last) if first > last else 0.0
        return start + (end - start) * part if part < SAMPLED else start

    def least(self):
        """Their least values: (value, t, which of them, what is nothing beside its neighbours)."""
        before, here, after = (self.sizes[:, a : a + len(self.t) - 2] for a in range(3))
        found, may = [], may_vanish(self.t, self.sizes)
        for i, j in np.argwhere((here <= np.fmin(before, after)) & (here < (1 - NEGLIGIBLE) * np.fmax(before, after))):
            value, t = self._located(i, *self.t[[j, j + 2]]) if may[i, j] else (here[i, j], self.t[j + 1])
            if np.isfinite(value):
                found.append((value, float(t), i, NEGLIGIBLE * max(before[i, j], after[i, j])))
        return found

    def _located(self, i, a, b):
        """The least value of one of them between two instants, and where that is."""
        from scipy.optimize import minimize_scalar

        def value(part):
            return self.value(a + part * (b - a))[i]

        found = minimize_scalar(value, bounds=(0, 1), method="bounded", options=CLOSELY)
        return found.fun, a + found.x * (b - a)
