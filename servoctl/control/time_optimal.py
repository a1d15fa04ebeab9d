"""The time-optimal law s(t) along the curve of a program: a nonlinear program with the exact inverse at its nodes.

A program follows a curve, φ(q, s) = 0 for s from 0 to 1. Its rows, hidden ones included, are algebraic equations
between the jets of the motion and s, s', ..., s^(k). On N intervals s^(k) is continuous and linear; the unknowns are
the duration T, the jets of s at the ends of the intervals, and those of the motion at the nodes in them:

    minimise T   subject to   the rows and low <= signals <= high at the nodes,   s' >= 0,   rest at both ends.

Entries of the state that the rows leave free, the internal dynamics, are collocated at the same nodes.
"""

from dataclasses import replace
from functools import partial
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
from servoctl.spec.paths import Path, as_path
from servoctl.spec.paths.fit import fitted
from servoctl.spec.references import Jets, function_of, orders_in
from servoctl.values import frozen

INTERVALS = 80  # of a law: its highest derivative is linear on each
COLLOCATION = 5  # of the collocation: three nodes
REGULAR = 1e-3  # least speed along a curve, of the largest, with which time itself is its parameter
DEGREES = (1, 2, 4, 8, 12, 16, 20)  # of the polynomial of the arc length that a curve is, or else
SPLINE = (9, 80)  # the degree and the intervals of its spline
MISSED = (1e-12, 1e-8)  # of its extent: by which the polynomial, and the spline, may miss it
FITTED = 1e-7  # error of a derivative of references along a law, of its largest value: rounding of class 6 has 2e-8
PANELS, GAUSS = 2000, np.polynomial.legendre.leggauss(8)  # of the arc length; of a quadrature in each panel
LEAST = 1e-4  # duration, relative to that of the first motion


class Curve:
    """The curve along which the references of a program run: their values as paths of a parameter s from 0 to 1.

    `span` is (t0, t1) [s], `paths` are those of the references by name; `pieces` are their paths along s.
    """

    def __init__(self, mechanism, program, span, paths):
        self.mechanism, self.program, self.span = mechanism, program, span
        self._paths = {name: path.held() for name, path in paths.items()}
        self._require_curve()
        t = np.linspace(*span, PANELS + 1)
        places, rates = self._along(t)
        extent = np.ptp(places, axis=1)
        if not extent.any():
            raise self._refused("The curve", "stands still", next(iter(paths)), "Choose a span in which it moves.")
        self.extent = np.where(extent > 0, extent, 1.0)
        speed = self._speed(rates)
        self.pieces = (
            self._by_time()
            if speed.min() > REGULAR * speed.max()
            else dict(zip(paths, self._by_arc_length(), strict=True))
        )

    def _require_curve(self):
        """Refuse what is no curve: it contains the time itself, or prescribes rates."""
        mechanism, q = self.mechanism, self.mechanism.q
        fixed = [mechanism.balance, mechanism.E, q.V, q.h, *mechanism.constraints.values(), *mechanism.outputs.values()]
        chosen = [ca.SX(e) for e in (*self.program.weights.values(), *self.program.toward.values())]
        if any(ca.depends_on(e, q.t) for e in (*fixed, *chosen)) or orders_in(q, [*fixed, *chosen]):
            raise self._refused(
                "The mechanism",
                "depends on time",
                "the mechanism",
                "Leave q.t and references out of it, or choose shape=False.",
            )
        for name, e in self.program.with_turns.items():
            w, orders = q.jet(1), orders_in(q, [e])
            if ca.depends_on(e, q.t):
                raise self._refused(repr(name), "contains the time itself", name, "Write a reference in place of q.t.")
            if rates := [q.family.jet(reference, k).name() for reference, k in orders.items() if k]:
                raise self._refused(
                    repr(name),
                    f"contains {', '.join(rates)}",
                    name,
                    "Integrate it: prescribe a position, or choose shape=False.",
                )
            along = q.order(e) <= 0 or q.order(e) == 1 and not orders and mechanism.is_zero([ca.jtimes(e, w, w) - e])
            if not along:
                raise self._refused(repr(name), "prescribes rates", name, "Prescribe positions, or choose shape=False.")
        if not self._paths:
            name = next(iter(self.program.residuals))
            raise self._refused(
                repr(name), "contains no reference", name, "Write residuals as x - r.X with r = q.references(X=path)."
            )
        for name, path in self._paths.items():
            if path.before == "periodic":
                raise self._refused(
                    f"The path of {name}", "is periodic", name, "Make it with before='hold', after='hold'."
                )

    def _refused(self, what, why, name, do):
        return SpecificationError(
            f"{what} {why}.",
            "A time-optimal law runs along a curve, values of references from rest to rest; only its law is open.",
            do=do,
            name=name,
        )

    def _along(self, t):
        """Values of the references (k, N) and their rates."""
        return np.concatenate([path.jets(t, 1) for path in self._paths.values()], axis=1)

    def _by_time(self):
        """The paths by name with s = (t - t0)/(t1 - t0)."""
        (t0, t1), paths = self.span, self._paths.items()
        whole = {name: _with_rests(path, t0, t1) for name, path in paths}
        return {name: replace(path, breaks=(path.breaks - t0) / (t1 - t0)) for name, path in whole.items()}

    def _by_arc_length(self):
        """The path of all references along the part of the length of their curve.

        Polynomials are fitted to the places at the ends of panels of time, whose parts of the length are known.
        """
        from scipy.interpolate import BSpline

        panels = np.linspace(*self.span, PANELS + 1)
        t, weights = quadrature(self.span, PANELS)
        length = np.append(0.0, np.cumsum((self._speed(self._along(t)[1]) * weights).reshape(PANELS, -1).sum(axis=1)))
        part, places = length / length[-1], self._along(panels)[0].T
        for degree in DEGREES:
            fit = chebyshev.chebfit(2 * part - 1, places, degree)
            if (np.abs(chebyshev.chebval(2 * part - 1, fit).T - places) / self.extent).max() < MISSED[0]:
                powers = np.array([np.pad(p := chebyshev.cheb2poly(c), (0, degree + 1 - len(p))) for c in fit.T])
                return Path(np.array([0.0, 1.0]), powers[None], np.full(2, np.inf), "continue", "continue")
        degree, count = SPLINE
        s = np.linspace(0.0, 1.0, count + 1)
        knots = np.pad(s, degree, mode="edge")
        matrix = BSpline.design_matrix(part, knots, degree).toarray()
        curve = BSpline(knots, np.linalg.lstsq(matrix, places, rcond=None)[0], degree)
        miss = np.abs(curve(part) - places) / self.extent
        if not miss.max() < MISSED[1]:
            k, i = np.unravel_index(np.argmax(miss), miss.shape)
            name = list(self._paths)[i]
            raise self._refused(
                f"The path of {name}",
                f"turns sharply at {part[k]:.3g} of the length",
                name,
                "Round it off there, as by sv.paths.spline through its points, or choose shape=False.",
            )
        return as_path(curve, before="continue", after="continue")

    def _speed(self, rates):
        return np.linalg.norm(rates / self.extent[:, None], axis=0)

    def jets(self, c):
        """The references and their derivatives, SX by (name, order), of the jets c of a law s of time."""
        result = {}
        for name, path in self.pieces.items():
            breaks, inner = path.breaks, (path.breaks[1:-1] > 0) & (path.breaks[1:-1] < 1)
            first = np.count_nonzero(breaks[1:-1] <= 0)
            rows = slice(first, first + inner.sum() + 1)
            of_piece = partial(ca.pw_const, c[0], breaks[1:-1][inner]) if inner.any() else lambda row: ca.SX(row[0])
            middle, half = (breaks[1:] + breaks[:-1]) / 2, np.diff(breaks) / 2
            tau, value = (c[0] - of_piece(middle[rows])) * of_piece(1 / half[rows]), ca.SX(0)
            for power in path.coefficients[rows, 0].T[::-1]:
                value = value * tau + of_piece(power)
            for k in range(len(c)):
                result[name, k] = value
                value = sum(ca.jacobian(value, s) * rate for s, rate in zip(c[: k + 1], c[1 : k + 2], strict=False))
        return result

    def paths_along(self, law, k):
        """The paths of the references by name along a law s, a path of time from 0 to 1, of class C^k."""

        def jets(t):
            s, series = law.jets(t, k)[:, 0, 0] / factorials, np.zeros((k + 1, len(self.pieces)))
            at, s[0] = float(np.clip(s[0], 0.0, 1.0)), 0.0
            outer = np.stack([path.jets(at, k)[:, 0, 0] for path in self.pieces.values()], axis=1)
            for d in (outer / factorials[:, None])[::-1]:
                series = np.array([s[i::-1] @ series[: i + 1] for i in range(k + 1)])
                series[0] += d
            return series * factorials[:, None]

        for name, path in self.pieces.items():
            if rough := [s for s in path.breaks_below(k, 0.0, 1.0).tolist() if 0 < s < 1]:
                what = f"turns at {rough[0]:.3g} of its span with fewer than {k} continuous derivatives"
                raise self._refused(
                    f"The path of {name}", what, name, f"Make it with smoothness={k} or more, or choose shape=False."
                )
        if all(path.coefficients.shape[::2] == (1, 2) for path in self.pieces.values()):
            return {name: path(0.0) + (path(1.0) - path(0.0)) * law for name, path in self.pieces.items()}
        factorials = np.array([float(factorial(j)) for j in range(k + 1)])
        try:
            path = fitted(jets, law.breaks, k, FITTED, "hold", "hold")
        except SpecificationError as error:
            raise self._refused(
                f"The curve of {', '.join(self.pieces)}",
                f"bends too sharply for a law at t = {error.details['t']:.3g} s",
                next(iter(self.pieces)),
                "Make the path smoother, or choose shape=False.",
            ) from error
        return {name: path[i] for i, name in enumerate(self.pieces)}


def _with_rests(path, t0, t1):
    """The path of one component with pieces in which it is held from t0 on, and to t1 [s]."""
    breaks, table, classes = path.breaks, path.coefficients, path.classes

    def rest(t):
        return np.pad([[[path(t)]]], ((0, 0), (0, 0), (0, table.shape[2] - 1)))

    if path.before == "hold" and t0 < breaks[0]:
        table = np.concatenate([rest(breaks[0]), table])
        breaks, classes = np.append(t0, breaks), np.append(np.inf, classes)
    if path.after == "hold" and t1 > breaks[-1]:
        table = np.concatenate([table, rest(breaks[-1])])
        breaks, classes = np.append(breaks, t1), np.append(classes, np.inf)
    return replace(path, breaks=breaks, coefficients=table, classes=classes)


class Inverse:
    """The exact inverse at one instant: equations between jets Z of the motion and c = (s, s', ...), and signals.

    `signals` are names, `values` the parameters that differ from their defaults.
    """

    def __init__(self, curve, signals, values, guess):
        model = derived(curve.mechanism, curve.program, guess)
        self.model = model = model.with_parameters(**values) if values else model
        e, q, top = model.equations, curve.mechanism.q, model.reduction.top
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
        values = ca.vertcat(*(e.called(f, self.jets[: f.size1_in(1)], e.parameters)[i] for i, f in found))
        parts = [ca.vertcat(*(level[-1 - self.extra] for level in levels)), rows, values, e.rates(q.jet(top))]
        jets = Jets(q, parts)
        c = [ca.SX.sym(f"s_{j}") for j in range(1 + max(k for _, k in jets.places))]
        along = curve.jets(c)
        numbers = ca.DM([0.0, *model.parameters])
        parts = ca.substitute(parts, [jets.symbols], [ca.vertcat(*(along[place] for place in jets.places))])
        tops, *parts = ca.substitute(parts, [ca.vertcat(q.t, e.parameters)], [ca.SX(numbers)])
        self.order = max(j for j, s in enumerate(c) if ca.depends_on(tops, s))
        self.c = ca.vertcat(*c)
        self.function = ca.Function("inverse", [self.jets, self.c], [ca.densify(ca.cse(part)) for part in parts])

    def _signal(self, name):
        """The place of a signal among the outputs of a function of (t, Z, p), and this function."""
        model = self.model
        e = model.equations
        if name in model.jet_names:
            i = model.jet_names.index(name)
            return 0, function_of(e.q, model.reduction.references, "jet", e.jets, e.parameters, e.jets[i])
        groups = signal_groups(model.reduction)
        base, rate = (name, 0) if name in groups else antiderivative(name, groups) or (None, 0)
        if base is None:
            raise unknown(name, [*model.jet_names, *groups], "signal")
        names, f = e.signals(groups[base], rate)
        return names.index(name), f


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

    def path(self, t0):
        """s as a path that begins at t0 [s]; before and after it rests."""
        half = 0.5 / (len(self.top) - 1)
        powers = np.array([jet * half**j / factorial(j) for j, jet in enumerate(self.jets(self.ends[:-1] + half))])
        classes = np.full(len(self.top), float(self.k))
        return Path(t0 + self.duration * self.ends, powers.T[:, None], classes, "hold", "hold")


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
        if words(stats := search.stats()):
            raise IntegrationStopped(
                f"IPOPT {words(stats)}, after {stats['iter_count']} iterations.",
                "A time-optimal law is a minimum of the duration.",
                do="Choose wider limits, a simpler curve, or shape=False.",
                status=stats["return_status"],
                iterations=stats["iter_count"],
            )
        w = np.array(result["x"]).ravel()
        top = w[1 : 1 + s.numel()].reshape(s.shape, order="F")[k] * self.sizes[k]
        return resting(w[0] * self.law.duration, top, k)

    def _constraints(self, duration, jets, motion):
        """What vanishes, and the signals in their sizes, all as columns."""
        N, S, k = self.count, len(self.c), self.k
        slopes = (jets[k, 1:] - jets[k, :-1]) * N
        moved = ca.DM(taylor(k, k, 1.0 / N)) @ ca.vertcat(jets[:, :-1], slopes)
        equal, values, rates = [(jets[:k, 1:] - moved) / ca.repmat(ca.DM(self.sizes[:k]), 1, N)], [], []
        powers = ca.vertcat(*(duration**i for i in range(self.inverse.c.numel())))
        f = self.inverse.function.map(N)
        for j, place in enumerate(self._stages(jets)):
            rows, value, rate = f(motion[:, j::S], place / ca.repmat(powers, 1, N))
            equal.append(rows / ca.repmat(ca.DM(self.row_size), 1, N))
            values.append(value / ca.repmat(ca.DM(self.value_size), 1, N))
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
