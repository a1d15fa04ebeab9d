"""The time-optimal law s(t) along the curve of a program: a nonlinear program with the exact inverse at its nodes.

A program follows a curve, φ(q, s) = 0 for s from 0 to 1. Its rows, hidden ones included, are algebraic equations
between the jets of the motion and s, s', ..., s^(k). On N intervals s^(k) is continuous and linear; the unknowns are
the duration T, the jets of s at the ends of the intervals, and those of the motion at the nodes in them:

    minimise T   subject to   the rows and low <= signals <= high at the nodes,   s' >= 0,   rest at both ends.

Entries of the state that the rows leave free, the internal dynamics, are collocated at the same nodes.
"""

from copy import copy
from math import factorial

import casadi as ca
import numpy as np
from numpy.polynomial import chebyshev

from servoctl.checks import antiderivative
from servoctl.control.nonlinear import solver, words
from servoctl.errors import IntegrationStopped, SpecificationError, unknown
from servoctl.methods.bounded import FreeEntries, subdivided
from servoctl.methods.radau import radau
from servoctl.model.equations import signal_groups
from servoctl.model.jets import extended
from servoctl.model.model import derived
from servoctl.spec.paths import piecewise
from servoctl.values import frozen

JETS = 14  # s, s', ..., among which are those that the rows contain
INTERVALS = 80
COLLOCATION = 5  # of the collocation: three nodes
REGULAR = 1e-3  # least speed along a curve, of the largest, with which time itself is its parameter
DEGREES = (1, 2, 4, 8, 12, 16, 20)  # of the polynomial of the arc length that a curve is, or else
SPLINE = (9, 80)  # the degree and the intervals of its spline
MISSED = (1e-12, 1e-8)  # of its extent: by which the polynomial, and the spline, may miss it
PANELS, GAUSS = 2000, np.polynomial.legendre.leggauss(8)  # of the arc length; of a quadrature in each panel
LEAST = 1e-4  # duration, relative to that of the first motion


class Curve:
    """The curve of a program: its residuals as functions of a parameter s from 0 to 1.

    Residuals are h(q) - p(t), and others that hold along the curve at any speed. `t_span` is (t0, t1) [s], `values` are
    the parameters that differ from their defaults.
    """

    def __init__(self, mechanism, program, t_span, values):
        self.mechanism, self.program, self.span = mechanism, program, t_span
        self.moving = self._moving()
        q, p = mechanism.q, mechanism.parameters
        offsets = [e - ca.substitute(e, q.t, t_span[0]) for e in self.moving.values()]
        anywhere = ca.vertcat(*q, *p.symbols), ca.DM([0.5] * q.nq + [*p.values(values)])
        offsets = ca.substitute(ca.vertcat(*offsets), *anywhere)
        self._offsets = ca.Function("curve", [q.t], [ca.densify(offsets), ca.densify(ca.jacobian(offsets, q.t))])
        t = np.linspace(*t_span, PANELS + 1)
        self.extent = np.ptp(self._along(t)[0], axis=1)
        if not np.all(self.extent > 0):
            raise self._refused(list(self.moving)[int(np.argmin(self.extent))], "returns to no other value in the span")
        speed = self._speed(t)
        self._pieces = None if speed.min() > REGULAR * speed.max() else self._by_arc_length()

    def _moving(self):
        """The residuals that contain the time, by name; refuses what is no curve."""
        mechanism, q = self.mechanism, self.mechanism.q
        fixed = [mechanism.balance, mechanism.E, q.V, q.h, *mechanism.constraints.values(), *mechanism.outputs.values()]
        chosen = [ca.SX(e) for e in (*self.program.weights.values(), *self.program.toward.values())]
        if any(ca.depends_on(e, q.t) for e in (*fixed, *chosen)):
            raise self._refused("the mechanism", "depends on time")
        moving = {}
        for name, e in self.program.with_turns.items():
            w, timed = q.jet(1), ca.depends_on(e, q.t)
            if q.order(e) > 0 and (timed or q.order(e) > 1 or not mechanism.is_zero([ca.jtimes(e, w, w) - e])):
                raise self._refused(name, "prescribes rates")
            if timed and ca.depends_on(ca.jacobian(e, q.t), ca.vertcat(*q)):
                raise self._refused(name, "contains products of the time and the coordinates")
            if timed:
                moving[name] = e
        if not moving:
            raise self._refused(next(iter(self.program.residuals)), "does not contain the time")
        return moving

    def _refused(self, name, what):
        return SpecificationError(
            f"{name!r} {what}." if name in self.program.residuals else f"{name.capitalize()} {what}.",
            "A time-optimal law runs along a curve, h(q) = p(s); only its time law is open.",
            do="Write residuals h(q) - p(t), with via points by spline(..., ends='natural'), or choose shape=False.",
            name=name,
        )

    def _along(self, t):
        """Places p(t) - p(t0) of the curve (k, N) and their rates."""
        return tuple(np.array(part) for part in self._offsets.map(len(t))(np.asarray(t, dtype=float)[None]))

    def _by_arc_length(self):
        """Ends of pieces (n + 1,) in s and coefficients (degree + 1, n, k), as for `paths.piecewise`.

        Polynomials are fitted to the places at the ends of panels of time, whose parts of the length are known.
        """
        from scipy.interpolate import BSpline

        panels = np.linspace(*self.span, PANELS + 1)
        t, weights = quadrature(self.span, PANELS)
        length = np.append(0.0, np.cumsum((self._speed(t) * weights).reshape(PANELS, -1).sum(axis=1)))
        part, places = length / length[-1], self._along(panels)[0].T
        for degree in DEGREES:
            fit = chebyshev.chebfit(2 * part - 1, places, degree)
            if (np.abs(chebyshev.chebval(2 * part - 1, fit).T - places) / self.extent).max() < MISSED[0]:
                powers = np.array([np.pad(p := chebyshev.cheb2poly(c), (0, degree + 1 - len(p))) for c in fit.T])
                return np.array([0.0, 1.0]), powers.T[:, None, :]
        degree, count = SPLINE
        s, half = np.linspace(0.0, 1.0, count + 1), 0.5 / count
        knots = np.pad(s, degree, mode="edge")
        matrix = BSpline.design_matrix(part, knots, degree).toarray()
        curve = BSpline(knots, np.linalg.lstsq(matrix, places, rcond=None)[0], degree)
        miss = np.abs(curve(part) - places) / self.extent
        if not miss.max() < MISSED[1]:
            k, i = np.unravel_index(np.argmax(miss), miss.shape)
            raise self._refused(list(self.moving)[i], f"turns sharply at {part[k]:.3g} of the length of its curve")
        coefficients = [curve(s[:-1] + half, nu=j) / factorial(j) * half**j for j in range(degree + 1)]
        return s, np.array(coefficients)

    def _speed(self, t):
        return np.linalg.norm(self._along(t)[1] / self.extent[:, None], axis=0)

    def program_along(self, law):
        """The program whose curve is followed by a law s, an SX scalar from 0 to 1."""
        q, (t0, t1) = self.mechanism.q, self.span
        residuals = dict(self.program.with_turns)
        if self._pieces is None:
            timed = {name: ca.substitute(e, q.t, t0 + (t1 - t0) * law) for name, e in self.moving.items()}
        else:
            offsets = piecewise(law, *self._pieces).elements()
            begins = (ca.substitute(e, q.t, t0) for e in self.moving.values())
            timed = dict(zip(self.moving, map(sum, zip(begins, offsets, strict=True)), strict=True))
        weights, toward = self.program.weights, self.program.toward
        return self.program.again(residuals | timed, weights, toward)


class Inverse:
    """The exact inverse at one instant: equations between jets Z of the motion and c = (s, s', ...), and signals.

    `signals` are names, `values` the parameters that differ from their defaults.
    """

    def __init__(self, curve, signals, values, guess):
        mechanism = copy(curve.mechanism)
        mechanism.parameters = mechanism.parameters.extended(**{f"s_{j}": 0.4 * (-0.5) ** j for j in range(JETS)})
        c, t = mechanism.parameters.symbols[-JETS:], mechanism.q.t
        law = sum(s * t**j / factorial(j) for j, s in enumerate(c))
        model = derived(mechanism, curve.program_along(law), guess)
        self.model = model = model.with_parameters(**values) if values else model
        e, q, top = model.equations, mechanism.q, model.reduction.top
        found = [self._signal(name) for name in signals]
        size = max([e.jets.numel(), *(f.size1_in(1) for _, f in found)])
        self.extra = (size - e.jets.numel()) // q.n
        self.jets = ca.vertcat(e.jets, *(s for k in range(top + 1, top + 1 + self.extra) for s in q.gamma(k)))
        counts = [count + self.extra for count in e.raised]
        levels = [
            [level[0] for level in q.derivatives([row.expression], count)]
            for row, count in zip(model.reduction.rows, counts, strict=True)
        ]
        rows = ca.vertcat(*q.invariants.values(), *(row for level in levels for row in level))
        values = ca.vertcat(*(f(t, self.jets[: f.size1_in(1)], e.parameters)[i] for i, f in found))
        parts = [ca.vertcat(*(level[-1 - self.extra] for level in levels)), rows, values, e.rates(q.jet(top))]
        numbers = ca.DM([0.0, *model.parameters[:-JETS]])
        tops, *parts = ca.substitute(parts, [ca.vertcat(t, *e.parameters.elements()[:-JETS])], [ca.SX(numbers)])
        self.order, highest = (max(j for j in range(JETS) if ca.depends_on(x, c[j])) for x in (tops, parts[0]))
        self.c = ca.vertcat(*c[: highest + 1])
        self.function = ca.Function("inverse", [self.jets, self.c], [ca.densify(ca.cse(part)) for part in parts])

    def _signal(self, name):
        """The place of a signal among the outputs of a function of (t, Z, p), and this function."""
        model = self.model
        e = model.equations
        if name in model.jet_names:
            i = model.jet_names.index(name)
            return 0, ca.Function("jet", [e.q.t, e.jets, e.parameters], [e.jets[i]])
        groups = signal_groups(model.reduction)
        base, rate = (name, 0) if name in groups else antiderivative(name, groups) or (None, 0)
        if base is None:
            raise unknown(name, [*model.jet_names, *groups], "signal")
        names, f = e.signals(groups[base], rate)
        return names.index(name), f


def in_formulas(q, program, paths):
    """The program with the paths of its references as formulas of time, along which a law is sought."""
    if not paths:
        return program
    expressions = program.with_turns
    symbols = [s for s in ca.symvar(ca.vertcat(*expressions.values())) if (place := q.where(s)) and place[0] == "r"]
    names = [q.family.names[q.where(s)[2]] for s in symbols]
    for symbol, name in zip(symbols, names, strict=True):
        if q.where(symbol)[1] or "periodic" in (paths[name].before, paths[name].after) or set(paths) != set(names):
            raise SpecificationError(
                f"The program contains {symbol.name()}." if q.where(symbol)[1] else f"The path of {name} is periodic.",
                "A time-optimal law runs along a curve, h(q) = r, of values from one rest to another.",
                do="Write residuals h(q) - r with paths that end, or choose shape=False.",
                name=name,
            )
    formulas = [_formula(q.t, paths[name]) for name in names]
    timed = ca.substitute([*expressions.values()], symbols, formulas)
    return program.again(dict(zip(expressions, timed, strict=True)), program.weights, program.toward)


def _formula(t, path):
    """A path as an expression of time."""
    low, high = path.breaks[[0, -1]]
    t = t if path.before == "continue" else ca.fmax(t, low)
    t = t if path.after == "continue" else ca.fmin(t, high)
    return piecewise(t, path.breaks, path.coefficients.transpose(2, 0, 1))


@frozen
class Law:
    """A law s(t): s^(k) T^k at the ends of N equal intervals of a duration T, between which it is linear."""

    duration: float  # [s]
    top: np.ndarray  # (N + 1,)
    k: int

    @property
    def ends(self):
        """Ends of the intervals (N + 1,) in parts of the duration."""
        return np.linspace(0.0, 1.0, len(self.top))

    def jets(self, parts):
        """s, s' T, ..., s^(k+1) T^(k+1) at parts (M,) of the duration: (k + 2, M)."""
        from scipy.interpolate import BSpline

        linear = BSpline(np.pad(self.ends, 1, mode="edge"), self.top, 1)
        below = [linear.antiderivative(self.k - j)(parts) for j in range(self.k)]
        return np.array([*below, linear(parts), linear(parts, nu=1)])

    def expression(self, t, t0):
        """s as an SX of a time that begins at t0 [s]; before and after it rests."""
        half, times = 0.5 / (len(self.top) - 1), t0 + self.duration * self.ends
        jets = self.jets(self.ends[:-1] + half)
        powers = np.array([jet * half**j / factorial(j) for j, jet in enumerate(jets)])
        return piecewise(ca.fmin(ca.fmax(t, times[0]), times[-1]), times, powers[:, :, None])


def quadrature(edges, panels):
    """Instants (N,) [s] and weights (N,) of a quadrature over pieces, in about so many panels of eight nodes."""
    ends = subdivided(edges, np.ceil(panels * np.diff(edges) / np.ptp(edges)).astype(int))
    half = np.diff(ends)[:, None] / 2
    return (ends[:-1, None] + half * (1 + GAUSS[0])).ravel(), (half * GAUSS[1]).ravel()


def taylor(rows, k, step):
    """The matrix (rows, k + 2) from (s, ..., s^(k+1)) at the begin of an interval to s, s', ... a step later."""
    powers = [step**j / factorial(j) for j in range(k + 2)]
    return np.array([[powers[j - i] if j >= i else 0.0 for j in range(k + 2)] for i in range(rows)])


def resting(duration, top, k):
    """The law whose s^(k), with values nearest to these (N + 1,), leads from rest at s = 0 to rest at s = 1."""
    fixed, end = np.append(0.0, np.append(top[1:-1], 0.0)), np.ones(1)
    at_end = Law(duration, np.eye(len(top)), k).jets(end)[:k, 0, 1:-1]
    size = np.abs(at_end).sum(axis=1)
    for _ in range(2):
        miss = np.eye(k)[0] - Law(duration, fixed, k).jets(end)[:k, 0]
        fixed[1:-1] += np.linalg.lstsq(at_end / size[:, None], miss / size, rcond=None)[0]
    return Law(duration, fixed, k)


def _each(sizes, count):
    return ca.repmat(ca.DM(sizes), 1, count)


def smooth(duration, k):
    """The law of a given duration [s] and class that is nearly a polynomial, `paths.rest_to_rest`."""
    step = np.polynomial.Polynomial([0.0, 1.0])
    place = ((step * (1 - step)) ** k).integ()
    return resting(duration, place.deriv(k)(np.linspace(0.0, 1.0, INTERVALS + 1)) / place(1.0), k)


class Problem:
    """The nonlinear program of a curve.

    Unknowns: the duration, the jets of s at the ends of the intervals (k + 1, N + 1), the jets of the motion at all
    nodes (n_z, N S), each in units of its size. `limits` (low, high), (m,) each, are those of the inverse's signals;
    the search begins at `law` with its motion `plan`, which is within them.
    """

    def __init__(self, inverse, limits, law, plan):
        self.inverse, self.limits, self.law, self.k = inverse, np.array(limits), law, inverse.order
        self.c, self.rate, *_ = radau(COLLOCATION)
        self.count, size = len(law.top) - 1, inverse.jets.numel()
        self.parts = (np.arange(self.count)[:, None] + self.c).ravel() / self.count  # of the duration, at nodes
        times = plan.t[0] + law.duration * np.append(0.0, self.parts)
        jets = np.array([np.interp(times, plan.t, row) for row in plan.jets])
        jets = jets[:size] if len(jets) >= size else extended(plan.model, times, jets, size)
        self.begin, self.z = jets[:, 0], jets[:, 1:]
        start = plan.jets[: len(plan.model.state_names), 0]
        self.free = [] if plan.model.flat else FreeEntries(plan.model, plan.t[0], start).free.tolist()
        self._measure()

    def _measure(self):
        """Sizes of the unknowns, of the rows and of the signals."""
        inverse, z, law, rows = self.inverse, self.z, self.law, self.inverse.c.numel()
        self.s = law.jets(law.ends)[: self.k + 1]
        self.sizes = np.maximum(np.abs(self.s).max(axis=1), 1e-300)
        largest = np.abs(z).max(axis=1)
        self.z_size = np.where(largest > 1e-6 * largest.max(), largest, 1.0)
        at = np.pad(law.jets(self.parts), ((0, rows), (0, 0)))[:rows] / law.duration ** np.arange(rows)[:, None]
        f, of = inverse.function, (inverse.jets, inverse.c)
        J = ca.Function("slopes", [*of], [ca.densify(ca.jacobian(f(*of)[0], inverse.jets))])
        slopes = np.array([np.array(J(z[:, i], at[:, i])) * self.z_size for i in range(z.shape[1])])
        self.row_size = np.abs(slopes).max(axis=(0, 2))
        values = np.array(f.map(z.shape[1])(z, at)[1])
        self.value_size = np.maximum(np.abs(values).max(axis=1), 1e-300)

    def _stages(self, jets):
        """s, s' T, ... (rows, N) at each stage."""
        k, rows = self.k, self.inverse.c.numel()
        stack = ca.vertcat(jets[:, :-1], (jets[k, 1:] - jets[k, :-1]) * self.count)
        return [ca.DM(taylor(rows, k, theta / self.count)) @ stack for theta in self.c]

    def solved(self):
        """The time-optimal law."""
        N, k = self.count, self.k
        T, s, z = ca.MX.sym("T"), ca.MX.sym("s", k + 1, N + 1), ca.MX.sym("z", *self.z.shape)
        jets = ca.diag(ca.DM(self.sizes)) @ s
        equal, values = self._constraints(T * self.law.duration, jets, ca.diag(ca.DM(self.z_size)) @ z)
        problem = {"x": ca.veccat(T, s, z), "f": T, "g": ca.vertcat(equal, values)}
        zeros, free = np.zeros(equal.numel()), np.full(z.numel(), np.inf)
        sides = [np.tile(side / self.value_size, values.numel() // max(len(side), 1)) for side in self.limits]
        first = [(self.s / self.sizes[:, None]).ravel("F"), (self.z / self.z_size[:, None]).ravel("F")]
        search = solver(problem)
        result = search(
            x0=np.concatenate([[1.0], *first]),
            lbx=np.concatenate([[LEAST], self._sides(0), -free]),
            ubx=np.concatenate([[np.inf], self._sides(1), free]),
            lbg=np.concatenate([zeros, sides[0]]),
            ubg=np.concatenate([zeros, sides[1]]),
        )
        if words(search.stats()):
            raise _failed(search.stats())
        w = np.array(result["x"]).ravel()
        top = w[1 : 1 + s.numel()].reshape(s.shape, order="F")[k] * self.sizes[k]
        return resting(w[0] * self.law.duration, top, k)

    def _constraints(self, duration, jets, motion):
        """What vanishes, and the signals in their sizes, all as columns."""
        N, S, k = self.count, len(self.c), self.k
        slopes = (jets[k, 1:] - jets[k, :-1]) * N
        moved = ca.DM(taylor(k, k, 1.0 / N)) @ ca.vertcat(jets[:, :-1], slopes)
        equal, values, rates = [(jets[:k, 1:] - moved) / _each(self.sizes[:k], N)], [], []
        powers = ca.vertcat(*(duration**i for i in range(self.inverse.c.numel())))
        f = self.inverse.function.map(N)
        for j, place in enumerate(self._stages(jets)):
            rows, value, rate = f(motion[:, j::S], place / ca.repmat(powers, 1, N))
            equal.append(rows / _each(self.row_size, N))
            values.append(value / _each(self.value_size, N))
            rates.append(rate)
        for i in self.free:
            x = ca.vertcat(*(motion[i, j::S] for j in range(S)))
            begin = ca.horzcat(ca.MX(self.begin[i]), x[-1, :-1])
            rate = ca.vertcat(*(rate[i, :] for rate in rates))
            equal.append((ca.DM(self.rate) @ (x - ca.repmat(begin, S, 1)) - duration / N * rate) / self.z_size[i])
        return ca.veccat(*equal), ca.veccat(*values)

    def _sides(self, upper):
        """Lower or upper bounds of the jets of s."""
        bound = np.full((self.k + 1, self.count + 1), np.inf if upper else -np.inf)
        bound[0] = float(upper)
        if not upper:
            bound[1] = 0.0
        bound[:, 0] = 0.0
        bound[:, -1] = np.eye(self.k + 1)[0]
        return (bound / self.sizes[:, None]).ravel("F")


def _failed(stats):
    return IntegrationStopped(
        f"IPOPT {words(stats)}, after {stats['iter_count']} iterations.",
        "A time-optimal law is a minimum of the duration.",
        do="Choose wider limits, a simpler curve, or shape=False.",
        status=stats["return_status"],
        iterations=stats["iter_count"],
    )
