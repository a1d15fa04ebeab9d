"""Edges of a program: where a function in its rows ends or jumps, such as asin(z) at z = 1 and atan(1/z) at z = 0.

The arguments of such functions are followed along the dense output of steps. Where one of them meets its edge, the
residuals on both sides tell whether they stay zero, as those with sin(z)/z do.
"""

import numpy as np

from servoctl.codegen.function import compiled
from servoctl.dense import steps_of
from servoctl.errors import IntegrationStopped
from servoctl.jets.branches import domain_edges
from servoctl.methods.pieces import RESOLUTION, End, net, residuals, terms_of
from servoctl.model.equations import invariant_names
from servoctl.values import frozen

PARTS = 4  # of a step, at least, at whose ends arguments are evaluated
CLOSE = 0.05  # of its largest distance from an edge so far: an argument that turns within it may have met the edge
OF_TERMS = 1e-3  # of the terms of a residual: one that changes by more at an edge jumps
DISTANCES = 0.5 ** np.arange(20, 1, -1)  # of the span: distances from an edge at which residuals are compared
BECAUSE_OF = 1e-6  # of the span: a motion that stops so near an edge stops because of it
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
        places = [(row.name, *place) for row in rows for place in domain_edges([row.expression])]
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


class Edges:
    """The edges that a motion meets; `tolerance` is that of its states, `span` its length [s]."""

    def __init__(self, tolerance, span):
        self.tolerance, self.span = tolerance, span
        self.met = []  # beyond which residuals are still to be seen: (t, the argument's index, `_beside` before)
        self.seen = (
            None  # the last instant and the arguments there, their largest sizes, and where each last met its edge
        )

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

        new = self._new(lambda times: arguments.f.grid(times, state(times), model.p), t)
        open_ = self.met + [(at, i, np.nan_to_num(self._beside(model, state, t, at, -forward))) for at, i in new]
        self.met = []
        for at, i, before in open_:
            after = self._beside(model, state, t, at, forward)
            change = np.abs(after[0] - before[0])
            if (change > OF_TERMS * np.fmax(after[1], before[1])).any():
                known = max(forward * at, forward * t[0]) * forward
                error = _jump(model, at, arguments.words[i], change)
                return End(int(steps_of(t, known)), known, state(np.array([known]))[:, 0], error=error)
            if abs(t[-1] - at) < DISTANCES[-1] * self.span:
                before[0, after[2] == 1] = np.nan
                self.met.append((at, i, before))
        return None

    def stopped(self, model, t):
        """The error of a motion that cannot go on at t, right beyond an edge; None elsewhere."""
        arguments = arguments_of(model)
        for at, i, _ in self.met:
            if abs(t - at) < BECAUSE_OF * self.span:
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
        crossed = z[:, :-1] * z[:, 1:] < 0
        turned = (size[:, 1:-1] <= np.fmin(size[:, :-2], size[:, 2:])) & (size[:, 1:-1] < CLOSE * largest[:, None])
        for wide, places in ((1, crossed), (2, turned)):
            for i, k in np.argwhere(places):
                a, b = max(forward * at[k], forward * t[0]) * forward, at[k + wide]
                if not abs(last[i] - (a + b) / 2) < abs(b - a) / 2 + self.span / RESOLUTION:
                    last[i] = _least(lambda s, i=i: np.nan_to_num(value(np.array([s]))[i, 0]), *sorted((a, b)))
                    result.append((float(last[i]), i))
        return sorted(result, key=lambda one: forward * one[0])

    def _beside(self, model, state, t, at, side):
        """Residuals on a side of an edge, along steps with ends t, their terms, and whether tolerances resolve them.

        They are those of the nearest instant at which tolerances resolve them, or of one farther than a thousandth of
        the span: infinite where they have no value, and NaN where no instant is so far.
        """
        times = at + side * self.span * DISTANCES
        times, m = times[(times - t[0]) * (times - t[-1]) <= 0], len(invariant_names(model))
        result = np.full((3, m), np.nan)
        if not len(times):
            return result
        x = state(times)
        values, allowed = residuals(model, self.tolerance, times, x)
        terms = terms_of(model).grid(times, x, model.p)[:, ::-1]
        terms = np.fmax.accumulate(terms, axis=1)[:, ::-1]  # of an instant and all that are farther
        far, resolved = np.abs(times - at) > self.span / RESOLUTION, allowed <= OF_TERMS * terms
        values[np.isnan(values) & far] = np.inf
        known = (resolved | far) & ~np.isnan(values)
        rows = np.flatnonzero(known.any(axis=1))
        nearest = known[rows].argmax(axis=1)
        result[:, rows] = values[rows, nearest], np.nan_to_num(terms[rows, nearest]), resolved[rows, nearest]
        return result


def _jump(model, at, why, change):
    """The error of the residual that changes most, by change (m,), at an edge."""
    worst = int(np.nanargmax(change))
    name, height = invariant_names(model)[worst][1], float(change[worst])
    row = next((row.name for row in model.reduction.rows if name.endswith(f"({row.name})")), None)
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
