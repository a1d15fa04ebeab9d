"""What ends a smooth piece of a motion: a kink or switch of the equations, or a residual that leaves its tolerance.

The tolerance of a residual is what the tolerances of the state allow in it, |∂ψ/∂X| (atol + rtol |X|). Over a step a
residual and its derivatives change as they extrapolate each other, since the last of them is kept at zero; what a step
adds to that is its error. Where the program ends (an angle whose sine passes 1) or jumps, this is no small number.
"""

from math import factorial

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.codegen.paths import evaluated
from servoctl.errors import IntegrationStopped
from servoctl.jets.branches import domain_edges, size_of_terms
from servoctl.methods.sizes import state_levels
from servoctl.model.equations import invariant_names
from servoctl.spec.references import function_of
from servoctl.tolerances import TINY
from servoctl.values import frozen

LEAVES = 1e3  # times its tolerance, which no healthy step adds to a residual
DEFAULT = 1e-9, 1e-11  # rtol and atol that judge steps of fixed length, until these are known to be coarser
LEAST_RTOL, LEAST_ATOL = 1e-12, 1e-14  # rounding of residuals: smaller tolerances are not resolved
OF_TERMS = 1e-3  # of the terms of a residual, which it never reaches where it is sensitive
SENSITIVE = 1e2  # times the first allowance of a residual, beyond which its terms bound it
EXPLAINED = 2.0  # times the extrapolation of a residual from earlier levels
FINER = 16  # equal steps in place of one of fixed length that errs by far
REMAINS = 0.75  # of its error in these: it is a jump, since other errors shrink, at least to a half with each halving
LEARNED = 10.0  # times the error of a step of fixed length, which later ones may have
MOST_INSPECTED = 128  # steps of a stretch whose residuals are evaluated
LOCATED_BY_PARTS = 8  # divisions into `FINER` parts that locate where states jump
LOCATED = 40  # halvings of a step that locate where a residual leaves: all digits
EDGE = 1e-3  # distance of a function's argument from the edge of its domain that explains why a residual leaves
AT_ONCE = 1e-9  # of the span: switches closer than this follow at once
RESOLUTION = 1000  # instants of a span, at least, at which switching functions and equations are inspected within steps
BESIDE_ENDS = 1e-3  # of a step: instants next to its ends, which show where a function has its least value across steps
NEAR_ZERO = 0.2  # of a function's values beside its least one: a vertex below this is looked at closely
MOST_AT_ONCE = 2  # changes of one branch at once, after which the motion stays on the switch

END_BEFORE = "Let the motion end before, or write the residual so that it is smooth along the motion."


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


def resolved(rtol, atol):
    """Tolerances, a number and one or an array, no smaller than rounding of residuals."""
    return max(rtol, LEAST_RTOL), np.maximum(atol, LEAST_ATOL)


class Tolerance:
    """The tolerances of the state along a motion, and of functions of it; atol is a number or an array (n_x,)."""

    def __init__(self, model, rtol, atol):
        self.rtol, atol = resolved(rtol, atol)
        self.levels = state_levels(model)
        self.atol = np.broadcast_to(atol, len(self.levels))[:, None]
        self.sizes, self.x0 = np.zeros(len(self.levels)), None

    def of(self, slopes, x):
        """Tolerances (m, N) of functions with derivatives (m, n_x, N) in X = x (n_x, N) along the motion."""
        return np.einsum("mxn,xn->mn", np.abs(slopes), self.atol + self.rtol * self._sizes(x))

    def of_states(self, x):
        """Tolerances (n_x, N) of states X (n_x, N) along the motion."""
        return self.atol + self.rtol * self._sizes(x)

    def accept(self, x):
        """Take in states (n_x, N) as part of the motion."""
        self.sizes = self._sizes(x)[:, -1]

    def _sizes(self, x):
        """The largest size of each entry's level so far, (n_x, N): of q its way from the first state, or rounding."""
        self.x0 = np.where(self.levels == 0, x[:, 0], 0.0)[:, None] if self.x0 is None else self.x0
        sizes = np.fmax(np.abs(x - self.x0), LEAST_RTOL / self.rtol * np.abs(x))
        sizes = np.fmin(np.fmax(sizes, self.sizes[:, None]), np.finfo(float).max)
        first = np.searchsorted(self.levels, range(self.levels[-1] + 1))
        return np.maximum.accumulate(np.maximum.reduceat(sizes, first)[self.levels], axis=1)


class Switches:
    """The switching functions of a motion of length `span` [s], evaluated at the ends of so many parts of each step.

    A `Watch` sets the branches that hold, the tolerance, and the start of the piece [s].
    """

    def __init__(self, family, span, parts):
        self.family, self.span, self.parts = family, span, parts
        self.counts, self.rested, self.start, self.branches, self.tolerance = {}, set(), 0.0, (), None

    def first(self, stretch, states, state):
        """The first switch within steps as an `End`, or None.

        `states` gives X (n_x, N) from steps (N,) and times (N,), where switches are looked for; `state` from (k, t),
        where one is located.
        """
        t, x = self._instants(stretch, states)
        functions, slopes, _ = self.family.values(self.branches, t, x)
        allowed = self.tolerance.of(slopes, x)
        wrong = functions < -allowed
        wrong[:, 0] = False  # where the branches were chosen: a root that is rounded
        last = max(int(np.argmax(wrong.any(axis=0))), 1) if wrong.any() else len(t)
        direction = np.copysign(1.0, t[-1] - t[0])

        def step(s):
            return int(np.clip(np.searchsorted(direction * stretch.t, direction * s) - 1, 0, len(stretch.t) - 2))

        crossing = self._grazed(t[:last], functions[:, :last], allowed, lambda s: state(step(s), s))
        if crossing is None and not wrong.any():
            return None
        begin, end, rows = crossing or (t[last - 1], t[last], np.flatnonzero(wrong[:, last]))
        roots = {i: self._root(i, begin, end, lambda s: state(step(s), s)) for i in rows}
        at = direction * min(direction * root for root in roots.values())
        changed = tuple(int(i) for i, root in roots.items() if abs(root - at) <= AT_ONCE * self.span)
        k = step(at)
        y = state(k, at) if at != t[0] else stretch.x[:, 0]
        return End(k, float(at), y, changed, self._beyond(changed, at, y))

    def _grazed(self, t, functions, allowed, state):
        """The first interval in which a function dips below zero between instants: its ends and the function; or None.

        Where a function has a least value among three instants, the parabola through them shows whether it comes near
        zero between them; its true minimum decides.
        """
        if len(t) < 3:
            return None
        before, here, after = functions[:, :-2], functions[:, 1:-1], functions[:, 2:]
        with np.errstate(all="ignore"):
            left, right = (here - before) / (t[1:-1] - t[:-2]), (after - here) / (t[2:] - t[1:-1])
            bend = (right - left) / (t[2:] - t[:-2])
            vertex = here - (left + bend * (t[1:-1] - t[:-2])) ** 2 / (4 * bend)
        low = (here <= before) & (here <= after) & (bend > 0) & (vertex < NEAR_ZERO * np.minimum(before, after))
        for j, i in np.argwhere(low.T):
            begin, end = t[j], t[j + 2]
            least, value = self._least(i, begin, end, state)
            if value < -allowed[i, j + 1]:
                return begin, least, np.array([i])
        return None

    def _least(self, i, a, b, state):
        from scipy.optimize import minimize_scalar

        def function(s):
            return self.family.values(self.branches, np.array([s]), state(s)[:, None])[0][i, 0]

        found = minimize_scalar(function, bounds=sorted((a, b)), method="bounded", options={"xatol": 1e-9 * abs(b - a)})
        return found.x, found.fun

    def _instants(self, stretch, states):
        """Instants (N,) and states (n_x, N) at which the functions are evaluated: ends of steps, and parts of them."""
        k, at, _ = net(stretch.t, self.span / RESOLUTION, self.parts)
        h, every = np.diff(stretch.t), np.arange(len(stretch.t) - 1)
        beside = np.concatenate([stretch.t[:-1] + BESIDE_ENDS * h, stretch.t[1:] - BESIDE_ENDS * h])
        k, at = np.concatenate([k, every, every]), np.concatenate([at, beside])
        order = np.lexsort((at if h[0] > 0 else -at, k))
        k, at = k[order], at[order]
        x, last = states(k, at), np.append(k[1:] > k[:-1], True)
        x[:, last] = stretch.x[:, 1:]
        return np.append(stretch.t[:1], at), np.column_stack([stretch.x[:, :1], x])

    def _root(self, i, a, b, state):
        from scipy.optimize import brentq

        def function(s):
            return self.family.values(self.branches, np.array([s]), state(s)[:, None])[0][i, 0]

        low, high = function(a), function(b)
        if not low > 0 > high:
            return a
        return brentq(function, a, b, xtol=1e-15, rtol=8.9e-16)

    def _beyond(self, changed, t, x):
        """All branches beyond a switch, with those that follow from it."""
        result, open_ = list(self.branches), list(changed)
        t, x = np.array([t]), x[:, None]
        while open_:
            others = self.family.values(tuple(result), t, x)[2]
            for i in open_:
                result[i] = float(others[i, 0])
            changed = {*changed, *open_}
            functions, slopes, _ = self.family.values(tuple(result), t, x)
            wrong = np.flatnonzero(functions[:, 0] < -self.tolerance.of(slopes, x)[:, 0])
            open_ = [i for i in wrong if i not in changed]
        return tuple(result)

    def stays(self, end):
        """The switches from which the motion is driven back on both sides, in words, and the branches to go on with.

        Where sign(0) = 0 and |0| = 0 are meant, the motion may rest on the switch: it is tried once.
        """
        if abs(end.t - self.start) > AT_ONCE * self.span:
            self.counts, self.rested = {}, set()
        for i in end.switched:
            self.counts[i] = self.counts.get(i, 0) + 1
        stuck = [i for i, count in self.counts.items() if count > MOST_AT_ONCE]
        if stuck and not self.rested & {*stuck} and all(self.family.switches[i].rests for i in stuck):
            self.rested |= {*stuck}
            return [], tuple(0.5 if i in stuck else b for i, b in enumerate(end.branches))
        return [self.family.switches[i].text for i in stuck], end.branches


class Residuals:
    """The residuals of a motion at all levels of its state; `coefficients` are those of each row's error dynamics."""

    def __init__(self, model, tolerance, coefficients=()):
        self.model, self.tolerance, self.f = model, tolerance, model.function("invariants")
        self.names = [name for _, name in invariant_names(model)]
        self.m, self.coarse = len(self.names), np.zeros(len(self.names))
        self.terms, self.first, self.led_back = np.zeros(self.m), None, len(coefficients) > 0
        places = {name: i for i, name in enumerate(self.names)}
        self.chains = []
        for a, row in enumerate(model.reduction.rows):
            levels = [row.name, f"D({row.name})", *(f"D{j}({row.name})" for j in range(2, len(places)))]
            chain = [places[name] for name in levels if name in places]
            self.chains.append((chain, np.abs(coefficients[a]) if len(coefficients) else np.zeros(len(chain))))

    def values(self, t, x):
        """Residuals (m, N) at times t (N,) and states x (n_x, N), and what their tolerances and terms allow."""
        y = self.f.grid(t, x, self.model.p)
        slopes = y[self.m :].reshape(len(x), self.m, -1).swapaxes(0, 1)
        allowed = LEAVES * self.tolerance.of(slopes, x)
        if self.first is None:
            self.first = allowed[:, 0]
        first, self.latest, self.bound = self.first[:, None], self.terms, np.inf
        if not np.all(allowed < SENSITIVE * first):  # near the edge of a domain slopes, and errors, grow without bound
            terms = np.nan_to_num(self._terms.grid(t, x, self.model.p), posinf=0.0)
            terms = np.maximum.accumulate(np.maximum(terms, self.terms[:, None]), axis=1)
            allowed, self.latest = np.fmin(allowed, np.maximum(first, OF_TERMS * terms)), terms[:, -1]
            self.bound = np.maximum(first, OF_TERMS * terms)
        return y[: self.m], allowed

    def small(self, t, x):
        """Whether residuals at times t (N,) and states x (n_x, N) are what they may be at the start of the motion.

        This needs no slopes.
        """
        residuals = self.f.grid(t, x, self.model.p)[: self.m]
        return bool(np.all(np.abs(residuals) <= self.first[:, None]))

    @property
    def _terms(self):
        """The sum of the magnitudes of each residual's terms."""

        def build():
            e = self.model.equations
            sizes = [size_of_terms(ca.densify(expression)) for _, _, expression in e.invariant_rows]
            return compiled(e.function("terms", e.state, sizes), "terms")

        return self.model.once("terms", build)

    def accept(self):
        """Take in the states of the last evaluation as part of the motion."""
        self.terms = self.latest

    def explained(self, before, h):
        """What residuals (m, N) may grow to in times h (N,), by the lower ones of their rows and the error dynamics."""
        size, h = np.abs(before), np.abs(h)
        result = size.copy()
        for chain, coefficients in self.chains:
            last = sum((c * size[i] for c, i in zip(coefficients, chain, strict=True)), 0.0 * h)
            levels = [*(size[i] for i in chain), last]
            for j, i in enumerate(chain):
                result[i] = sum(level * h**k / factorial(k) for k, level in enumerate(levels[j:]))
        return EXPLAINED * result

    def off(self, t, before, after):
        """How far residuals (m, N) exceed what they may be at the ends of steps, negative where all is well.

        The starts and ends of the steps are t (2, N) [s], and the states there `before` and `after` (n_x, N).
        """
        with np.errstate(all="ignore"):
            values, _ = self.values(t[0], before)
            residuals, allowed = self.values(t[1], after)
            limit = allowed + self.explained(values, t[1] - t[0])
            if not self.led_back:
                limit = np.fmin(limit, self.bound)
            over = np.abs(residuals) - limit - self.coarse[:, None]
        return np.where(np.isnan(residuals), np.inf, np.nan_to_num(over, nan=-1.0, posinf=np.inf, neginf=-1.0))

    def error(self, t, x, over, step, advice, last):
        """The error of the residual that is farthest beyond what it may be at t, X = x, in a `step`, in words.

        `advice` is for where why is open; X = `last` just before, where x may have no value.
        """
        values, allowed = (part[:, 0] for part in self.values(np.array([t]), x[:, None]))
        worst = int(np.argmax(np.where(over > 0, over / np.maximum(allowed, TINY), -1.0)))
        name, value = self.names[worst], float(values[worst])
        row = next((row for row in self.model.reduction.rows if name.endswith(f"({row.name})")), None)
        what = f"The residual {name!r}" if row is None else f"The rate {name} of the residual {row.name!r}"
        why, _ = edge(self.model, t, x if np.isfinite(x).all() else last)
        return IntegrationStopped(
            f"{what} leaves zero at t = {t:.7g} s, to {value:.3g} within a step {step}{why and f': {why}'}.",
            f"The tolerances of the method allow it {allowed[worst]:.1e}; beyond, this is no motion of the program.",
            do=f"{END_BEFORE if why else advice} The run before this instant is in .run.",
            t=t,
            residual=name if row is None else row.name,
            level=name,
            value=value,
            allowed=float(allowed[worst]),
            why=why,
        )


def edge(model, t, x):
    """The function at the edge of its domain, or that jumps, at t, X = x, and the residual it is in; "" for none."""
    r, m = model.reduction, model.reduction.mechanism
    state = ca.vertcat(*m.q, *(s for k in range(1, r.top) for s in m.q.gamma(k)))
    rows = [row for row in r.original.values() if row.order < r.top]
    places = [(row.name, *place) for row in rows for place in domain_edges([row.expression])]
    if not places:
        return "", ""
    arguments = ca.vertcat(*(argument for _, _, argument, _ in places))
    f = function_of(m.q, r.references, "edges", state, ca.vertcat(*m.parameters.symbols), arguments)
    values = evaluated(f, t, x, model.p)
    near = [(abs(v - bound), words, row) for v, (row, words, _, bound) in zip(values, places, strict=True)]
    distance, words, row = min(near, key=lambda place: np.nan_to_num(place[0], nan=np.inf))
    return (words, row) if distance < EDGE else ("", "")


class Watch:
    """Finds where a smooth piece of a motion ends.

    The tolerances (rtol, atol) are those of the method, None for steps of fixed length; `span` is the length of the
    whole motion [s], and `family` has the smooth models of one with kinks or switches. Residuals that are solved for,
    `exact`, need no watch. Switching functions are evaluated at the ends of so many parts of each step.
    """

    def __init__(self, tolerances, span, family, exact, parts):
        self.span = span
        self.tolerances, self.family, self.exact = tolerances or DEFAULT, family, exact
        self.switches = None if family is None else Switches(family, span, parts)
        self.model = self.tolerance = self.rough = None
        self.method, self.advice = "", ""

    def use(self, model, branches, coefficients=()):
        """Watch the motion of a model, which is the one for these branches."""
        if self.tolerance is None:
            self.tolerance = Tolerance(model, *self.tolerances)
            self.rough = np.zeros(len(model.state_names))
        self.model, tolerance = model, self.tolerance
        self.residuals = None if self.exact else Residuals(model, tolerance, coefficients)
        if self.switches is not None:
            self.switches.branches, self.switches.tolerance = branches, tolerance

    @property
    def branches(self):
        """The branches that hold."""
        return () if self.switches is None else self.switches.branches

    def texts(self, end):
        """The switches that the motion crosses at an end, in words."""
        return " and ".join(self.family.switches[i].text for i in end.switched)

    def begin(self, t):
        """Start a piece at t [s]."""
        if self.switches is not None:
            self.switches.start = t

    def switch(self, stretch, states, state):
        """The first switch within steps as an `End`, or None; see `Switches.first`."""
        return None if self.switches is None else self.switches.first(stretch, states, state)

    def left(self, stretch, state, again=None, projected=False):
        """Where a residual leaves its tolerance within steps, as an `End`, or None.

        `state` gives X from (k, t); `again`, for steps of fixed length, gives states at the ends of equal steps from
        (t, x, h, count). Where the ends of steps were `projected`, what `state` gives there was not.
        """
        count = len(stretch.t) - 1
        if not count:
            return None
        if self.residuals is None or not self.residuals.m:
            self.tolerance.accept(stretch.x)
            return None
        picked = (
            np.unique(np.linspace(0, count, MOST_INSPECTED + 1).astype(int))
            if count > MOST_INSPECTED
            else (np.arange(count + 1))
        )
        t, x = stretch.t[picked], stretch.x[:, picked]
        ends = stretch.dense(np.arange(count), stretch.t[1:]) if projected else stretch.x[:, 1:]
        if self.residuals.first is None:
            self.residuals.values(t[:1], x[:, :1])
        if self.residuals.small(t[1:], ends[:, picked[1:] - 1]):
            self.tolerance.accept(x)
            return None
        over = self.residuals.off(np.array([t[:-1], t[1:]]), x[:, :-1], ends[:, picked[1:] - 1])
        for p in np.flatnonzero((over > 0).any(axis=0)):
            for k in range(picked[p], picked[p + 1]):
                step = stretch.t[k : k + 2], stretch.x[:, k], ends[:, k]
                off = self._off(*step) > 0
                if off.any() and (again is None or self._stays(off, *step, again)):
                    return self._end(k, *step, state)
            self.residuals.values(t[-1:], x[:, -1:])
        self.tolerance.accept(x)
        self.residuals.accept()
        return None

    def torn(self, t, x, rates, finer):
        """Where states that are solved for, or projected, jump although their rates do not, as an `End`, or None.

        States x and their rates X' are (n_x, S + 1), at t (S + 1,) [s]; `finer` gives the same (t, x, rates) at more
        instants from (t0, x0, t1).
        """
        beyond = self._beyond_rates(t, x, rates)
        for k in np.flatnonzero((beyond > self.rough[:, None]).any(axis=0)):
            i = int(np.argmax(beyond[:, k] - self.rough))
            height, place = beyond[i, k], (t[k], x[:, k], t[k + 1])
            for _ in range(LOCATED_BY_PARTS):
                parts = finer(*place)
                within = self._beyond_rates(*parts)[i]
                j = int(np.argmax(within))
                if not within[j] > REMAINS * height:
                    self.rough[i] = max(self.rough[i], LEARNED * height)
                    break
                place = parts[0][j], parts[1][:, j], parts[0][j + 1]
            else:
                end = self._torn_at(k, t[k + 1] - t[k], parts[2][:, j], *place)
                if end is not None:
                    return end
        return None

    def _beyond_rates(self, t, x, rates):
        """How much more states change from instant to instant than their rates there explain, (n_x, S)."""
        h = np.diff(t)
        with np.errstate(all="ignore"):
            change = np.abs(np.diff(x) - h * (rates[:, 1:] + rates[:, :-1]) / 2)
            beyond = change - np.abs(h * np.diff(rates)) - LEAVES * self.tolerance.of_states(x)[:, 1:]
        return np.nan_to_num(beyond, nan=-1.0, posinf=-1.0, neginf=-1.0)

    def _torn_at(self, k, h, rates, t, x, after):
        """The end at t, X = x, before a jump of the states; None if they leave no residual, carried over it."""
        carried, residuals = x + (after - t) * rates, Residuals(self.model, self.tolerance)
        values, allowed = residuals.values(np.array([after]), carried[:, None])
        over = (np.abs(values) - allowed)[:, 0]
        if not np.any(over > 0):
            return None
        step = f"of {abs(h):.3g} s by {self.method}"
        error = residuals.error(float(after), carried, over, step, self.advice, x)
        return End(k, float(t), x, error=error)

    def _off(self, t, before, after):
        return self.residuals.off(t[:, None], before[:, None], after[:, None])[:, 0]

    def _stays(self, off, t, before, after, again):
        """Whether a residual is as far off after steps that are far shorter; if not, this one is coarse."""
        shorter = again(t[0], before, (t[1] - t[0]) / FINER, FINER)
        if shorter.shape[1] <= FINER:
            return True
        values, _ = self.residuals.values(t[[0, 1, 1]], np.column_stack([before, after, shorter[:, -1]]))
        explained = self.residuals.explained(values[:, :1], t[1:] - t[:1])[off]
        long, short = (np.abs(values[off, 1:]) - explained).T
        if np.any(~(short <= REMAINS * long)):
            return True
        self.residuals.coarse[off] = np.maximum(self.residuals.coarse[off], LEARNED * long)
        return False

    def _end(self, k, t, before, after, state):
        """The end within step k at which a residual leaves its tolerance, by bisection."""
        (start, high), low = t, t[0]
        ends = {start: before, high: after}

        def at(t):
            return ends[t] if t in ends else state(k, t)

        def off(t):
            return self._off(np.array([start, t]), ends[start], at(t))

        for _ in range(LOCATED):
            middle = (low + high) / 2
            low, high = (low, middle) if np.any(off(middle) > 0) else (middle, high)
        step = f"of {abs(t[1] - t[0]):.3g} s by {self.method}"
        error = self.residuals.error(float(high), at(high), off(high), step, self.advice, at(low))
        return End(k, float(low), at(low), error=error)

    def jump(self, model, end):
        """The error of a residual, or derivative of one, that jumps at a switch to another model; None if none does."""
        t, x = np.array([end.t]), end.x[:, None]
        sides = [Residuals(m, self.switches.tolerance) for m in (self.model, model)]
        if not sides[0].names or sides[0].names != sides[1].names:
            return None
        (before, allowed), (after, other) = (side.values(t, x) for side in sides)
        heights = np.abs(after - before)[:, 0]
        jumps = np.flatnonzero(heights > np.maximum(allowed, other)[:, 0])
        if not len(jumps):
            return None
        name, height = sides[0].names[jumps[0]], float(heights[jumps[0]])
        where = self.texts(end)
        row = next((row.name for row in model.reduction.rows if name.endswith(f"({row.name})")), None)
        what = f"{name!r} jumps" if row is None else f"{row!r} has a kink: its rate {name} jumps"
        return IntegrationStopped(
            f"The residual {what} by {height:.3g} at t = {end.t:.7g} s, where {where}.",
            "To keep it at zero on both sides, coordinates or velocities would jump.",
            do="Write the residual with a smooth function, such as sqrt(y**2 + a**2) for |y|, or let the motion end "
            "here. The run before this instant is in .run.",
            t=end.t,
            residual=row or name,
            level=name,
            height=height,
            switch=where,
        )


def sticks(method, t, switches):
    """The error of a motion that cannot leave a switch."""
    where = " and ".join(switches)
    return IntegrationStopped(
        f"{method} stopped at t = {t:.7g} s: the motion stays at the switch {where}, driven back from both sides.",
        "On a switch the equations of neither side hold, as where dry friction sticks.",
        do="Write the switch as a smooth function, such as tanh(v/v0) for sign(v), or let the motion end here. The run "
        "before this instant is in .run.",
        t=t,
        switches=list(switches),
    )


def no_model(method, t, where, reason):
    """The error of a motion that meets a switch beyond which its program has no model."""
    return IntegrationStopped(
        f"{method} stopped at t = {t:.7g} s, where {where}: {reason}",
        "Beyond a switch the program needs a model of the same structure.",
        do="Let the motion end here. The run before this instant is in .run.",
        t=t,
        switch=where,
        reason=type(reason).__name__,
    )
