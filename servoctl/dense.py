"""A motion between its samples: the dense output of its steps, and the extremes of a signal along them."""

from collections.abc import Callable
from dataclasses import replace
from math import factorial, perm

import numpy as np
from numpy.polynomial import chebyshev

from servoctl.model.jets import with_highest
from servoctl.tolerances import TINY
from servoctl.values import frozen

INEXACT = ("relaxed",)  # methods whose motions miss the program, so that its equations do not give the accelerations
MISSES = 1e-2  # of the largest rates: what polynomials may miss them by over an interval of samples
DISTINCT = 1e-6  # of the mean distance of samples: between nearer ones polynomials are rounding
NODES = 9  # of the polynomial by which a signal is known within an interval: pulses of a tenth of it are seen
PROBES = np.array([-0.611, 0.137])  # where it is compared with the signal; on no symmetry of the nodes
PARTS = 200  # intervals of a motion, at least: a signal that acts for a thousandth of it is seen
FITS = 1e-7  # of a signal's range: error of polynomials that is accepted; that of their extremes is its square
AS_ZERO = 1e-12  # of the size of signals of a kind: what is smaller is rounding
MOST_PROBED = 400_000  # instants at which a signal is evaluated: 5,000 periods, and a second
CANDIDATES = 5  # intervals in which the extreme points of polynomials are looked at
TOUCHES = 1e-6  # imaginary part of a root that is real but for rounding, as where a slope touches zero
LEAST_PART = 1e-12  # of a span: an interval that is not halved
INWARDS = 1e-9  # of an interval: how far within it its ends are looked at, as a signal may jump there


@frozen(eq=False)
class Dense:
    """Steps by one model, with ends t (S + 1,) [s] in the order of the motion.

    `jets` gives q, γ', ..., γ^(s̄) (n_z, N) from steps (N,), instants (N,) within them, and parameters: those of the
    model and `further` ones. Steps are counted from `first` on.
    """

    model: object
    t: np.ndarray
    jets: Callable
    further: tuple = ()
    first: int = 0

    def at(self, t):
        """Jets (n_z, N) at instants within the steps."""
        return self.jets(self.first + steps_of(self.t, t), t, np.append(self.model.p, self.further))

    @property
    def nbytes(self):
        """Memory that the steps take."""
        return self.t.nbytes + self.jets.nbytes


@frozen(eq=False)
class Hermite:
    """Polynomials that match all derivatives of jets (n_z, N) at distinct instants t (N,)."""

    model: object
    t: np.ndarray
    jets: np.ndarray
    exact: bool = False  # whether the highest derivatives are those of the equations

    @property
    def nbytes(self):
        """Memory of the jets."""
        return self.jets.nbytes

    def __call__(self, k, times, p):
        """Jets (n_z, N) at instants in the intervals k (N,)."""
        z, (nq, n) = self.jets, (self.model.nq, self.model.n)
        levels = [z[first : first + n] for first in range(nq, len(z), n)]
        place = self.t, k, times
        if self.model.reduction.mechanism.q.plain:
            found = _matched([z[:nq], *levels], *place)
        else:
            f = self.model.signals("coordinate_rates")[1]
            rates = f.grid(self.t, z[: f.n_x], self.model.p)
            found = [*_matched([z[:nq], rates[:nq], rates[nq:]], *place)[:1], *_matched(levels, *place)]
        jets, n_x = np.vstack(found), len(self.model.state_names)
        if self.exact:
            jets[: n_x + n] = with_highest(self.model, times, jets[:n_x], p)
        return jets


def _matched(derivatives, t, i, times):
    """Values and derivatives at times (M,) of the polynomials that match all derivatives at the ends of intervals.

    `derivatives` are (n, N) arrays of the orders 0, 1, ..., r at t (N,), i (M,) the intervals of the instants. Returns
    as many (n, M) arrays.
    """
    r, h = len(derivatives), t[i + 1] - t[i]
    s = (times - t[i]) / h
    low = [d[:, i] * (h**k / factorial(k)) for k, d in enumerate(derivatives)]
    matrix = np.array([[perm(j, k) for j in range(r, 2 * r)] for k in range(r)], dtype=float)
    ends = [d[:, i + 1] * h**k for k, d in enumerate(derivatives)]
    missing = [end - sum(perm(j, k) * low[j] for j in range(k, r)) for k, end in enumerate(ends)]
    c = [*low, *np.tensordot(np.linalg.inv(matrix), missing, 1)]
    return [_derivative(c, k, s) / h**k for k in range(r)]


def _derivative(c, k, s):
    """The k-th derivative of Σ c_j s^j, by Horner's rule."""
    value = np.zeros(c[0].shape)
    for j in reversed(range(k, len(c))):
        value *= s
        value += perm(j, k) * c[j]
    return value


def steps_of(t, times):
    """The steps with ends t (S + 1,) in which times (N,) lie; an end belongs to the following step."""
    forward = 1.0 if t[-1] >= t[0] else -1.0
    return np.clip(np.searchsorted(forward * t, forward * times, "right") - 1, 0, len(t) - 2)


def between(run):
    """The dense output between the samples of a run, by Hermite's polynomials, with the variants that hold there."""
    apart, pieces = DISTINCT * abs(run.t[-1] - run.t[0]) / len(run.t), []
    for first, end, model in run.variants or ((0, len(run.t), run.model),):
        begin = max(first - 1, 0)
        t, jets = run.t[begin:end], run.jets[:, begin:end]
        if begin < first and not model.flat:  # the variant of a step's end holds within the step
            jets, n_x = jets.copy(), len(model.state_names)
            jets[: n_x + model.n, :1] = with_highest(model, t[:1], jets[:n_x, :1])
        distinct = np.append(np.abs(np.diff(t)) > apart, True)
        if distinct.sum() > 1:
            t, jets = t[distinct], jets[:, distinct]
            pieces.append(Dense(model, t, Hermite(model, t, jets, exact=run.method not in INEXACT)))
    return tuple(pieces)


def resolved(pieces):
    """Whether polynomials `between` samples have the accelerations that the equations give there."""
    for piece in pieces:
        middle, h, n = (piece.t[1:] + piece.t[:-1]) / 2, np.abs(np.diff(piece.t)), piece.model.n
        curve = replace(piece.jets, exact=False)(np.arange(len(h)), middle, piece.model.p)
        n_x = len(piece.model.state_names)
        off = np.abs(curve[n_x : n_x + n] - with_highest(piece.model, middle, curve[:n_x])[n_x : n_x + n])
        if not (h * off).max() <= MISSES * np.abs(curve[n_x - n : n_x]).max(initial=TINY):
            return False
    return bool(pieces)


def piece_of(pieces, t):
    """Which of the pieces holds at each instant (N,): where one ends and the next begins, the one that ends."""
    forward = 1.0 if pieces[-1].t[-1] >= pieces[0].t[0] else -1.0
    ends = np.array([piece.t[-1] for piece in pieces])
    return np.minimum(np.searchsorted(forward * ends, forward * t), len(pieces) - 1)


def up_to(pieces, t):
    """The pieces up to an instant [s], where a motion must end."""
    forward, result = 1.0 if pieces and pieces[-1].t[-1] >= pieces[0].t[0] else -1.0, []
    for piece in pieces:
        before = piece.t[forward * piece.t < forward * t]
        if len(before) == len(piece.t):
            result.append(piece)
        elif len(before):
            result.append(replace(piece, t=np.append(before, t)))
    return result


def jets_at(pieces, t):
    """Jets (n_z, N) at instants t (N,), by the piece that holds at each."""
    which = piece_of(pieces, t)
    found = np.unique(which)
    if len(found) == 1:
        return pieces[found[0]].at(t)
    parts = [(which == i, pieces[i]) for i in found]
    values = [piece.at(t[inside]) for inside, piece in parts]
    jets = np.empty((len(values[0]), len(t)))
    for (inside, _), value in zip(parts, values, strict=True):
        jets[:, inside] = value
    return jets


def extremes_at(t, known):
    """The least and the greatest of values (N,) at t (N,), as `extremes`."""
    return tuple(_farthest((float(t[0]), np.nan), t, known, sign) for sign in (-1.0, 1.0))


@np.errstate(all="ignore")
def extremes(value, cuts, t, known, size):
    """The least and the greatest value of a signal, ((t, value), (t, value)); NaN where it has no finite one.

    `value` gives it at ascending instants (N,), between the ascending `cuts` it is smooth, and at samples t (N,) it has
    the `known` values. `size` is that of signals of its kind.
    """
    found = list(extremes_at(t, known))

    def look(curve, a, b, instants, y):
        found[:] = [_farthest(found[i], instants.ravel(), y.ravel(), sign) for i, sign in enumerate((-1.0, 1.0))]
        (_, low), (_, high) = found
        error, bounds = curve.judged(y)
        beyond = np.array([bounds[0] < low, bounds[1] > high]) & np.isfinite(error)
        rough = beyond.any(axis=0) & (error > FITS * (high - low) + AS_ZERO * size)
        known = np.isfinite(y)
        rough |= known.any(axis=1) & ~known.all(axis=1)  # where it has an end
        for i, sign in enumerate((-1.0, 1.0)):
            last = np.flatnonzero(beyond[i] & ~rough)
            last = last[np.argsort(sign * bounds[i, last])[-CANDIDATES:]]
            turns = np.sort(np.concatenate([curve.turns(a[k], b[k], y[k]) for k in last] or [a[:0]]))
            found[i] = _farthest(found[i], turns, value(turns) if len(turns) else turns, sign)
        return rough

    _refined(value, parted(cuts, cuts[-1] - cuts[0]), look)
    return tuple(found)


@np.errstate(all="ignore")
def one_sign_apart(value, edges, floor=0.0):
    """Ascending instants, the `edges` among them, between which a signal has at most one zero.

    They are where polynomials through its values turn. `value` gives it at ascending instants (N,); what is below the
    `floor` is rounding.
    """
    found, size = [edges], 0.0

    def look(curve, a, b, instants, y):
        nonlocal size
        size = np.nanmax(np.abs(y), initial=size)
        error, (low, high) = curve.judged(y)
        near = (low <= 0) & (high >= 0) & np.isfinite(error)
        rough = near & (error > FITS * size + floor)
        found.extend(curve.turns(a[k], b[k], y[k]) for k in np.flatnonzero(near & ~rough))
        found.append((a[rough] + b[rough]) / 2)
        return rough

    _refined(value, edges, look)
    return np.unique(np.concatenate(found))


def parted(cuts, span):
    """The ascending cuts with further instants between them, `PARTS` of them in a span [s]."""
    parts = np.maximum(np.ceil(np.diff(cuts) / (span / PARTS) * (1 - LEAST_PART)), 1).astype(int)
    k = np.repeat(np.arange(len(parts)), parts)
    within = (np.arange(len(k)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[k]
    return np.append(cuts[:-1][k] + within * np.diff(cuts)[k], cuts[-1])


def _refined(value, edges, look):
    """Have values of a signal looked at in intervals between edges, and in halves of those that `look` finds rough."""
    a, b, probed, curve = edges[:-1], edges[1:], 0, _Curve()
    while len(a) and probed < MOST_PROBED:
        instants = curve.instants(a, b)
        y = value(instants.ravel()).reshape(instants.shape)
        rough, probed = look(curve, a, b, instants, y), probed + y.size
        rough &= b - a > LEAST_PART * (edges[-1] - edges[0])
        middle = (a[rough] + b[rough]) / 2
        a, b = np.sort(np.append(a[rough], middle)), np.sort(np.append(middle, b[rough]))


def _farthest(found, t, y, sign):
    """The (t, value) found so far, or the one among values y (N,) at t (N,) that is farther towards a sign."""
    known = np.flatnonzero(np.isfinite(y))
    if not len(known):
        return found
    k = known[np.argmax(sign * y[known])]
    return found if sign * y[k] <= sign * found[1] else (float(t[k]), float(y[k]))


class _Curve:
    """Signals within intervals by polynomials through their values at Gauss' nodes."""

    def __init__(self):
        nodes = chebyshev.chebpts1(NODES)
        ends = 1 - 2 * INWARDS
        self.places = np.sort(np.concatenate([nodes, PROBES, [-ends, ends]]))
        self.nodes, self.probes = (np.searchsorted(self.places, some) for some in (nodes, np.sort(PROBES)))
        self.fit = np.linalg.inv(chebyshev.chebvander(nodes, NODES - 1))
        grid = np.concatenate([self.places[self.probes], np.linspace(-1, 1, 4 * NODES)])
        self.along = chebyshev.chebvander(grid, NODES - 1) @ self.fit

    def instants(self, a, b):
        """Ascending instants in intervals from a to b (K,)."""
        return a[:, None] + np.multiply.outer(b - a, (self.places + 1) / 2)

    def judged(self, y):
        """The error (K,) of polynomials through values y (K, n), and bounds of the signal (2, K)."""
        along = y[:, self.nodes] @ self.along.T
        error = np.abs(along[:, : len(PROBES)] - y[:, self.probes]).max(axis=1)
        along = along[:, len(PROBES) :]
        margin = error + np.abs(np.diff(along, 2)).max(axis=1)  # a curve exceeds its points by an eighth of this
        return error, np.array([along.min(axis=1) - margin, along.max(axis=1) + margin])

    def turns(self, a, b, y):
        """Instants between a and b at which the polynomial through values y (n,) has a slope of zero."""
        slope = chebyshev.chebder(self.fit @ y[self.nodes])
        roots = chebyshev.chebroots(chebyshev.chebtrim(slope, np.finfo(float).eps * np.abs(slope).max()))
        real = roots.real[(np.abs(roots.imag) < TOUCHES) & (np.abs(roots.real) < 1)]
        return a + (b - a) * (real + 1) / 2
