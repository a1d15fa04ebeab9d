"""Edges of a program: where a function in its rows ends or jumps, such as asin(z) at z = 1 and atan(1/z) at z = 0.

The arguments of such functions are followed along the dense output of steps. Where one of them meets its edge, the
residuals on both sides tell whether they stay zero, as those with sin(z)/z do.
"""

import numpy as np

from servoctl.codegen.function import compiled
from servoctl.dense import steps_of
from servoctl.errors import IntegrationStopped
from servoctl.jets.branches import domain_edges
from servoctl.methods.pieces import FIXED_STEPS, RESOLUTION, End, least_between, net, residuals, row_of, terms_of
from servoctl.model.equations import invariant_names
from servoctl.tolerances import ENTRY
from servoctl.values import frozen

PARTS = 4  # of a step, at least, at whose ends arguments are evaluated
MAY_TOUCH = 0.8  # of an argument's distances from an edge beside the least one: a vertex below this may touch the edge
CLOSE = 1e-8  # of its largest distance so far: an argument that comes so near has met the edge, and may stay there
JUMPS = 30.0  # times its tolerance, by which a residual changes at an edge only if it jumps
OF_TERMS = 1e-3  # of its terms, which a residual does not reach a thousandth of the span away from an edge
DISTANCES = 0.5 ** np.arange(20, 6, -1)  # of the span: distances from an edge at which residuals are compared
EXPLAINS = 1e-3  # distance of an argument from its edge that explains why a motion cannot go on


@frozen
class Arguments:
    """Arguments of functions in rows, less their values at the edges: the rows, words, and a function of (t, X, p)."""

    rows: tuple = ()
    words: tuple = ()
    f: object = None


def arguments_of(model):
    """The arguments whose edges a motion of a model may meet."""

    def build():
        rows = [row for row in model.reduction.original.values() if row.order < model.reduction.top]
        found = [(row.name, *place) for row in rows for place in domain_edges([row.expression])]
        places = [*{(argument.element_hash(), edge): (*_, argument, edge) for *_, argument, edge in found}.values()]
        if not places:
            return Arguments()
        names, words, arguments, edges = zip(*places, strict=True)
        e = model.equations
        values = [argument - edge for argument, edge in zip(arguments, edges, strict=True)]
        return Arguments(names, words, compiled(e.function("edges", e.state, values), "edges"))

    return model.once("edges", build)


def edge(model, t, x):
    """What explains why a motion cannot go on at t, X = x: an edge, in words, and the row; "" for none."""
    arguments = arguments_of(model)
    if arguments.f is None:
        return "", ""
    distances = np.nan_to_num(np.abs(arguments.f(t, x, model.p)), nan=np.inf)
    i = int(np.argmin(distances))
    return (arguments.words[i], arguments.rows[i]) if distances[i] < EXPLAINS else ("", "")


@frozen
class _Side:
    """Residuals at an instant beside an edge, and by how much they may differ from those on the other side, (m,)."""

    residuals: np.ndarray
    allowed: np.ndarray


class Edges:
    """The edges that a motion meets; `tolerance` is that of its states, `span` its length [s].

    Steps of fixed length are `coarse`; states at the ends of steps may be `projected`, from one side to the other.
    """

    def __init__(self, tolerance, span, coarse=False, projected=False):
        self.tolerance, self.span, self.jumps = tolerance, span, JUMPS * (FIXED_STEPS if coarse else 1.0)
        self.projected = projected
        self.met = []  # beyond which residuals are still to be seen: (t, index of the argument, `_Side` before)
        self.start = None  # the first instant and state, where slopes are as usual
        self.seen = None  # the last instant and the arguments there, their largest sizes, and where they met an edge

    def first(self, model, t, states):
        """The first edge along steps of a model with ends t (S + 1,) at which a residual jumps, as an `End`, or None.

        `states()` gives a function of steps (N,) and times (N,) within them: X (n_x, N).
        """
        arguments = arguments_of(model)
        if arguments.f is None or len(t) < 2:
            return None
        dense, forward = states(), np.copysign(1.0, t[-1] - t[0])

        def state(times):
            return dense(steps_of(t, times), times)

        if self.start is None:
            self.start = t[:1], state(t[:1])
        open_, self.met = [(t, *edge) for edge in self.met], []
        for at, i in self._new(lambda times: arguments.f.grid(times, state(times), model.p), t):
            k = int(steps_of(t, at))
            within = t[k : k + 2] if self.projected else t
            open_.append((within, at, i, self._beside(model, state, within, at, -forward)))
        for within, at, i, before in open_:
            after = self._beside(model, state, within, at, forward)
            known = before.allowed <= 2 * after.allowed  # else it is zero as far as tolerances tell
            change = np.abs(after.residuals - np.where(known, before.residuals, 0.0))
            if (change > after.allowed).any():
                place = max(forward * at, forward * t[0]) * forward
                error = _jump(model, at, arguments.words[i], np.where(change > after.allowed, change, 0.0))
                return End(int(steps_of(t, place)), place, state(np.array([place]))[:, 0], error=error)
            if abs(t[-1] - at) < DISTANCES[-1] * self.span:
                self.met.append((at, i, before))
        return None

    def stopped(self, model, t):
        """The error of a motion that cannot go on at t, right beyond an edge; None elsewhere."""
        arguments = arguments_of(model)
        for at, i, _ in self.met:
            if abs(t - at) < self.span / RESOLUTION:
                row = arguments.rows[i]
                return _stop(f"The program of {row!r} ends", at, arguments.words[i], row, level=row)
        return None

    def _new(self, value, t):
        """The edges that arguments, `value` of times, meet along steps with ends t: (t, index) in their order."""
        at, forward = np.append(t[:1], net(t, self.span / RESOLUTION, PARTS)[1]), np.copysign(1.0, t[-1] - t[0])
        z = value(at)
        if self.seen is None:
            self.seen = at[:0], z[:, :0], np.zeros(len(z)), np.full(len(z), np.nan)
        before, known, largest, last = self.seen
        at, z = np.append(before, at), np.column_stack([known, z])
        size = np.abs(z)
        largest = np.fmax(largest, np.nanmax(size, axis=1, initial=0.0))
        self.seen, result = (at[-2:-1], z[:, -2:-1], largest, last), []
        crossed, turned = z[:, :-1] * z[:, 1:] < 0, _turned(at, size, largest)
        for wide, places in ((1, crossed), (2, turned)):
            for i, k in np.argwhere(places):
                a, b = max(forward * at[k], forward * t[0]) * forward, at[k + wide]
                if not abs(last[i] - (a + b) / 2) < abs(b - a) / 2 + self.span / RESOLUTION:
                    last[i] = _least(lambda s, i=i: np.nan_to_num(value(np.array([s]))[i, 0]), *sorted((a, b)))
                    result.append((float(last[i]), i))
        return sorted(result, key=lambda one: forward * one[0])

    def _beside(self, model, state, t, at, side):
        """Residuals on a side of an edge along steps with ends t.

        They are those of the nearest instant at which tolerances allow hardly more than anywhere on this side: next to
        an edge slopes may grow without bound. Beyond a thousandth of the span, where a motion may stay on its edge, the
        terms bound them, too, and what has no value is infinite.
        """
        end, m = t[-1 if side * (t[-1] - t[0]) > 0 else 0], len(invariant_names(model))
        times = at + side * self.span * DISTANCES
        # the last instant is not yet that end, which may be projected
        times = np.append(times[(times - t[0]) * (times - t[-1]) < 0], at + 0.9 * (end - at))
        if not side * (end - at) > 0:
            return _Side(np.zeros(m), np.full(m, np.inf))
        x = state(times)
        values, tolerance = residuals(model, self.tolerance, times, x)
        terms, far = terms_of(model).grid(times, x, model.p), np.abs(times - at) > self.span / RESOLUTION
        allowed = self.jumps * tolerance + ENTRY * terms
        usual = self.jumps * residuals(model, self.tolerance, *self.start)[1]
        allowed = np.where(far, np.fmin(allowed, np.fmax(usual, OF_TERMS * terms)), allowed)
        allowed = np.where(np.isfinite(values + allowed), allowed, np.inf)
        nearest = np.arange(m), (allowed <= 2 * allowed.min(axis=1, keepdims=True)).argmax(axis=1)
        values, allowed = values[nearest], allowed[nearest]
        lost = np.isnan(values) & far[-1]
        return _Side(np.where(lost, np.inf, np.nan_to_num(values)), np.where(lost, 0.0, allowed))


def _turned(t, size, largest):
    """Where sizes (m, N) at times t (N,) become zero, or have a least one that may be, (m, N - 2)."""
    before, here, after = size[:, :-2], size[:, 1:-1], size[:, 2:]
    arrives = (here < CLOSE * largest[:, None]) & (before >= CLOSE * largest[:, None])
    least, vertex = least_between(t, size)
    return arrives | least & (here < after) & (vertex < MAY_TOUCH * np.minimum(before, after))


def _jump(model, at, why, change):
    """The error of the residual that changes most, by change (m,), at an edge."""
    worst = int(np.argmax(change))
    name, height = invariant_names(model)[worst][1], float(change[worst])
    row = row_of(model, name)
    what = f"The residual {name!r}" if row is None else f"The rate {name} of the residual {row!r}"
    what += f" jumps by {height:.3g}" if np.isfinite(height) else " has no value beyond"
    return _stop(what, at, why, row or name, level=name, height=height)


def _stop(what, at, why, row, **details):
    return IntegrationStopped(
        f"{what} at t = {at:.7g} s: {why}.",
        "A motion keeps the residuals of its program at zero.",
        do="Let the motion end before, or write the residual so that it is smooth along the motion. The run before it "
        "is in .run.",
        t=float(at),
        residual=row,
        why=why,
        **details,
    )


def _least(function, a, b):
    """Where a function vanishes or is nearest to zero between two instants."""
    from scipy.optimize import brentq, minimize_scalar

    if function(a) * function(b) < 0:
        return brentq(function, a, b, xtol=1e-15)
    return float(minimize_scalar(lambda s: abs(function(s)), bounds=(a, b), method="bounded").x)
