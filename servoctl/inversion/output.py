"""Output redefinition: for which values of a parameter the internal dynamics at an equilibrium are stable.

Deviations of a motion e^(st) [δπ; δμ] with δq = V δπ satisfy, at an equilibrium,

    Z(s) [δπ; δμ] = 0,    Z(s) = Σ_j s^j ∂ψ/∂[γ^(j); μ],    ψ = [r - B μ; φ; material rows],

so that the roots of det Z are the eigenvalues of the internal dynamics. The coefficients of this polynomial are smooth
in the parameter: roots move on, and reach the right half plane through the imaginary axis, or through infinity where
the highest coefficient vanishes and with it the relative degree. No rank is decided and no pivot is divided by.
"""

from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np

from servoctl.checks import finite, interval, require_kind
from servoctl.errors import (
    InconsistentStart,
    NotRealisable,
    SingularProgram,
    SpecificationError,
    UnstableInternalDynamics,
    unknown,
)
from servoctl.model.model import Model
from servoctl.model.start import State
from servoctl.reduction.ranks import equilibrate
from servoctl.simulation import simulate

VALUES = 257  # of the parameter, spread over its range, at which roots are computed
NO_COEFFICIENT = 1e-11  # of the largest coefficient at all values: a smaller one is zero
ON_AXIS = 1e-10  # real part of a root, relative to its size, below which it lies on the imaginary axis
TOUCHES = 1e-9  # of its largest value: a coefficient whose smallest value is below has a root there
BISECTIONS = 60  # halvings of an interval of the parameter: all digits of a double
RADII = 4  # adjustments of the circle on which det Z is evaluated
NEWTON, AT_REST = 50, 1e-12  # steps towards an equilibrium; its scaled residual
MOVED = 1e-6  # distance of an equilibrium from the state that was passed, relative to its size
STEP, STEPS = 0.02, 500  # along the rests of a program, relative to the size of the state; on either side


@dataclass(frozen=True)
class Range:
    """Values of a parameter with one kind of internal dynamics.

    Attributes
    ----------
    low, high : float
    verdict : {"stable", "marginal", "unstable"}
        "marginal": roots on the imaginary axis and none beyond it.
    states : int
        Dimension of the internal dynamics at the equilibrium.
    unstable : int
        Number of its roots in the right half plane.
    """

    low: float
    high: float
    verdict: str
    states: int
    unstable: int


@dataclass(frozen=True)
class Critical:
    """A value of a parameter at which the relative degree at the equilibrium rises.

    Attributes
    ----------
    value : float
    states : int
        Dimension of the internal dynamics at the equilibrium, there.
    free : int or None
        Dimension in motion, i.e. free initial values of the model with this value; None if it has no such model.
    flat : bool
        Whether the dimension falls to zero in motion: the output is flat.
    """

    value: float
    states: int
    free: object
    flat: bool


@dataclass(frozen=True, eq=False)
class MinimumPhase:
    """Internal dynamics over the values of a parameter; made by `minimum_phase`.

    Attributes
    ----------
    parameter : str
    current : float
        The model's own value.
    ranges : tuple of Range
        In the order of the values.
    critical : tuple of Critical
        Values at which roots pass through infinity.
    values : (N,) array
        Values of the parameter, and
    roots : tuple of (f,) complex arrays
        eigenvalues of the internal dynamics there [1/s].
    model : Model
    at : State
        The equilibrium at the model's own value.
    """

    parameter: str
    current: float
    ranges: tuple
    critical: tuple
    values: np.ndarray = field(repr=False)
    roots: tuple = field(repr=False)
    model: object = field(repr=False)
    at: object = field(repr=False)

    @property
    def stable(self):
        """The ranges with stable internal dynamics, a tuple of (low, high)."""
        return tuple((r.low, r.high) for r in self.ranges if r.verdict == "stable")

    @property
    def flat(self):
        """Values for which the output is flat, a tuple of float."""
        return tuple(c.value for c in self.critical if c.flat)

    @cached_property
    def _pencil(self):
        return _Pencil(self.model, self.parameter, self.at)

    def eigenvalues(self, value):
        """Eigenvalues of the internal dynamics at the equilibrium [1/s].

        Parameters
        ----------
        value : float
            Of the parameter.

        Returns
        -------
        (f,) complex array
            By descending real part.
        """
        return self._pencil.roots(finite(self.parameter, value))

    def lost(self, value):
        """Rests of the program, on either side of the equilibrium, at which the relative degree is lost.

        They are sought along the states at rest that satisfy the program, which for this must be a curve.

        Parameters
        ----------
        value : float
            Of the parameter.

        Returns
        -------
        list of dict
            Coordinates by name, the nearest first; empty if the relative degree stays as far as the curve was followed.

        Raises
        ------
        SpecificationError
            If the program and its hidden constraints leave no curve of rests, but more or less than that.
        """
        value = finite(self.parameter, value)
        return _lost(self.model.with_parameters(**{self.parameter: value}), self.at.t, self._pencil.coordinates(value))

    def cost(self, value, t_span, **options):
        """What following the output with this value costs in the output with the model's own value.

        The motion with this value is integrated from its equilibrium, and the residuals of the model's own value are
        evaluated along it. The redefined output follows its path exactly; these are the errors of the original one.

        Parameters
        ----------
        value : float
            Of the parameter, in a stable range.
        t_span : (t0, t1)
            [s]; the program must stand still at t0.
        **options
            Of `simulate`.

        Returns
        -------
        dict of str to float
            Largest magnitude of each residual, in its unit.

        Raises
        ------
        UnstableInternalDynamics
            If the internal dynamics with this value are not stable at the equilibrium.
        """
        value = finite(self.parameter, value)
        roots = self.eigenvalues(value)
        if roots.size and not roots.real.max() < 0:
            ranges = " or ".join(f"{low:.6g} .. {high:.6g}" for low, high in self.stable)
            raise UnstableInternalDynamics(
                f"With {self.parameter} = {value:g} the internal dynamics have the eigenvalue {roots[0]:.6g} 1/s.",
                "The motion of a redefined output is integrated, for which its internal dynamics must be stable.",
                nearest=f"{self.parameter} in {ranges}." if ranges else "",
                do="Choose a value in a stable range, or use method=sv.Bounded() for the original output.",
                parameter=self.parameter,
                value=value,
                eigenvalue=complex(roots[0]),
                stable=self.stable,
            )
        model = self.model.with_parameters(**{self.parameter: value})
        q = self._pencil.coordinates(value)
        guess = dict(zip(model.coordinate_names, map(float, q), strict=True))
        run = simulate(model, model.start(float(t_span[0]), guess=guess), t_span, **options)
        return _residuals_along(self.model, run)

    def as_dict(self):
        """The result as plain values: {name: value}."""
        return {
            "parameter": self.parameter,
            "current": self.current,
            "stable": [list(pair) for pair in self.stable],
            "flat": list(self.flat),
            "ranges": [vars(r) for r in self.ranges],
            "critical": [vars(c) for c in self.critical],
        }

    def plot(self):
        """Draw the real parts of the eigenvalues over the parameter, with the stable ranges shaded.

        Returns
        -------
        matplotlib.figure.Figure
        """
        from servoctl.figures.output import draw_output

        return draw_output(self)

    def __repr__(self):
        name = self.parameter
        lines = [f"MinimumPhase: {name} from {self.values[0]:g} to {self.values[-1]:g}, own value {self.current:g}"]
        for r in self.ranges[:6]:
            growing = f", {r.unstable} of them growing" if r.unstable else ""
            states = f"{r.states} internal state{'s' * (r.states != 1)}{growing}" if r.states else "flat"
            lines.append(f"  {r.verdict:8s} for {name} from {r.low:.10g} to {r.high:.10g}: {states}")
        for c in self.critical[:3]:
            where = f"  at {name} = {c.value:.10g} "
            if c.flat:
                lines.append(where + "the output is flat")
            else:
                motion = "" if c.free is None else f", in motion {c.free}"
                lines.append(where + f"the relative degree is lost at the equilibrium: {c.states} internal states{motion}")
        hidden = max(len(self.ranges) - 6, 0) + max(len(self.critical) - 3, 0)
        return "\n".join(lines + ([f"  and {hidden} more ranges and values"] if hidden else []))


def minimum_phase(model: Model, parameter: str, values, at: State | None = None) -> MinimumPhase:
    """For which values of a parameter of the outputs the internal dynamics at an equilibrium are stable.

    Parameters
    ----------
    model : Model
    parameter : str
        A parameter of the mechanism that the program's outputs depend on.
    values : (low, high)
        Range of its values.
    at : State, optional
        An equilibrium under the model's own value, at an instant at which the program stands still; default:
        `model.start()`. For other values the equilibrium is continued.

    Returns
    -------
    MinimumPhase

    Raises
    ------
    NameUnknown
        For a name that is no parameter.
    InconsistentStart
        If the state is no equilibrium, the program does not stand still there, or a value has no equilibrium.
    NotRealisable
        If the residuals determine no motion at the equilibrium, for any value.

    Notes
    -----
    Ranges are sought between 257 values, and at the smallest distances of roots from the axis between these; narrower
    ones may be missed. Boundaries are accurate to rounding.
    """
    require_kind(Model, "model", model, "sv.derive(mechanism, program)")
    if parameter not in model.numbers:
        raise unknown(parameter, list(model.numbers), "parameter")
    low, high = interval(parameter, values, "range")
    low, high = finite(parameter, low, "range"), finite(parameter, high, "range")
    _require_program(model)
    at = model.start() if at is None else require_kind(State, "at", at, "model.start(...)")
    pencil = _Pencil(model, parameter, at)
    pencil.require_equilibrium()
    grid = pencil.grid(low, high)
    critical = tuple(_critical(pencil, value) for value in pencil.vanishing(grid))
    ranges = _ranges(pencil, grid, [c.value for c in critical])
    roots = tuple(pencil.roots(value) for value in grid)
    return MinimumPhase(parameter, model.numbers[parameter], ranges, critical, grid, roots, model, at)


class _Pencil:
    """det Z of a program at its equilibria, as a polynomial in s with coefficients by the value of a parameter."""

    def __init__(self, model, parameter, at):
        self.model, self.parameter, self.at = model, parameter, at
        self.q, self.p, self.index = model.reduction.mechanism.q, model.parameters, list(model.numbers).index(parameter)
        self._rest, self._matrices, self.degree = _equations(model)
        self.own = model.numbers[parameter]
        self._known = {self.own: self._equilibrium(self.own, self._first())}
        self.radius, self._scales, self.low, self.high = 1.0, None, 0, self.degree
        self._adjust()

    def _numbers(self, value):
        p = self.p.copy()
        p[self.index] = value
        return p

    def _first(self):
        """The state that was passed, with the multipliers that balance it best."""
        q = self.at.values[: self.q.nq].astype(float)
        size = self._rest.size1_in(1) - self.q.nq
        values, slopes, _ = self._evaluated(np.concatenate([q, np.zeros(size)]), self.own)
        return np.concatenate([q, np.linalg.lstsq(slopes[:, self.q.nq :], -values, rcond=None)[0]])

    def _evaluated(self, z, value):
        return [np.array(part) if i else np.array(part).ravel() for i, part in
                enumerate(self._rest(self.at.t, z, self._numbers(value)))]  # fmt: skip

    def _equilibrium(self, value, z):
        """[q; μ] of the equilibrium that Newton's method reaches from another one."""
        for _ in range(NEWTON):
            values, slopes, _ = self._evaluated(z, value)
            sizes = np.maximum(np.abs(slopes) @ (1.0 + np.abs(z)), 1e-300)
            if not np.isfinite(values).all() or (np.abs(values) / sizes).max(initial=0.0) < AT_REST:
                break
            scaled, rows, columns = equilibrate(slopes)
            z = z - columns.astype(float) * np.linalg.lstsq(scaled.astype(float), rows.astype(float) * values, rcond=AT_REST)[0]
        off = np.abs(values) / sizes
        if not np.isfinite(off).all() or off.max(initial=0.0) > AT_REST:
            worst = int(np.argmax(np.nan_to_num(off, nan=np.inf)))
            raise InconsistentStart(
                f"With {self.parameter} = {value:g} no equilibrium was reached from the state at t = {self.at.t:g} s: "
                f"row {worst} is off by {values[worst]:.3g}.",
                "Internal dynamics are linearised at an equilibrium of the program.",
                do="Pass another state, or a smaller range of values.",
                parameter=self.parameter,
                value=value,
                residual=float(values[worst]),
            )
        return z

    def require_equilibrium(self):
        """Refuse a state that is no equilibrium, and a program that does not stand still there."""
        nq, z = self.q.nq, self._known[self.own]
        moving = np.abs(self.at.values[nq:]).max(initial=0.0)
        away = np.abs(z[:nq] - self.at.values[:nq]) / (1.0 + np.abs(z[:nq]))
        rates = self._evaluated(z, self.own)[2].ravel()
        if moving > MOVED or away.max(initial=0.0) > MOVED or np.abs(rates).max(initial=0.0) > MOVED:
            nearest = {name: float(x) for name, x in zip(self.q.names, z, strict=False)}
            listed = ", ".join(f"{name} = {x:.6g}" for name, x in nearest.items())
            still = np.abs(rates).max(initial=0.0) <= MOVED
            raise InconsistentStart(
                f"The state at t = {self.at.t:g} s is no equilibrium: "
                + (f"velocities or accelerations up to {moving:.3g}, coordinates {away.max():.3g} off." if still else
                   f"the program moves there, at up to {np.abs(rates).max():.3g} per second."),
                "Internal dynamics are linearised at an equilibrium, while the program stands still.",
                nearest=f"{listed}." if still else "",
                do="Pass the state of an equilibrium, as model.start(...) with its coordinates held.",
                equilibrium=nearest,
                t=self.at.t,
            )  # fmt: skip

    def equilibrium(self, value):
        """[q; μ] for a value, continued from the nearest value that is known."""
        if value not in self._known:
            nearest = min(self._known, key=lambda known: abs(known - value))
            self._known[value] = self._equilibrium(value, self._known[nearest])
        return self._known[value]

    def coordinates(self, value):
        """q of the equilibrium for a value."""
        return self.equilibrium(value)[: self.q.nq]

    def grid(self, low, high):
        """Values over a range, at all of which there is an equilibrium."""
        values = np.linspace(low, high, VALUES)
        for value in sorted(values, key=lambda v: abs(v - self.own)):
            self.equilibrium(value)
        coefficients = np.abs([self._all(value) for value in values])
        present = np.flatnonzero(coefficients.max(axis=0) > NO_COEFFICIENT * coefficients.max())
        if not len(present) or not np.isfinite(coefficients).all():
            raise NotRealisable(
                f"For all {self.parameter} from {low:g} to {high:g} the residuals determine no motion at the equilibrium.",
                "The linearised program must determine the actuation.",
                do="Choose another equilibrium or other outputs.",
                parameter=self.parameter,
            )
        self.low, self.high = int(present[0]), int(present[-1])
        return values

    def _adjust(self):
        """Scale s, rows and columns so that coefficients are near 1."""
        for _ in range(RADII):
            Z = self._Z(self.own)
            size = sum(np.abs(part) * self.radius**j for j, part in enumerate(Z))
            _, rows, columns = equilibrate(size)
            self._scales = rows.astype(float), columns.astype(float)
            c = np.abs(self._all(self.own))
            present = np.flatnonzero(c > NO_COEFFICIENT * c.max(initial=0.0))
            if len(present) < 2:
                return
            first, last = present[[0, -1]]
            self.radius *= (c[first] / c[last]) ** (1.0 / (last - first))

    def _Z(self, value):
        return [np.array(part) for part in self._matrices(self.at.t, self.equilibrium(value), self._numbers(value))]

    def _all(self, value):
        """All coefficients of det Z in powers of s over the radius, ascending."""
        rows, columns = self._scales
        Z = [rows[:, None] * part * columns * self.radius**j for j, part in enumerate(self._Z(value))]
        circle = np.exp(2j * np.pi * np.arange(self.degree + 1) / (self.degree + 1))
        values = np.linalg.det(sum(part * circle[:, None, None] ** j for j, part in enumerate(Z)))
        return (np.fft.fft(values) / (self.degree + 1)).real

    def coefficients(self, value):
        """Coefficients from the lowest to the highest power that occurs, ascending."""
        return self._all(float(value))[self.low : self.high + 1]

    def roots(self, value):
        """Eigenvalues [1/s] by descending real part; those through infinity are left out."""
        c = self.coefficients(value)
        c = c[: 1 + np.flatnonzero(np.abs(c) > NO_COEFFICIENT * np.abs(c).max())[-1]]
        odd = np.abs(c[1::2]).max(initial=0.0) > NO_COEFFICIENT * np.abs(c).max()
        if odd or len(c) < 2:
            roots = np.roots(c[::-1]).astype(complex)
        else:  # without damping roots come in pairs ±√σ
            sigma = np.roots(c[::-2]).astype(complex)
            sigma.imag[np.abs(sigma.imag) <= ON_AXIS * np.abs(sigma)] = 0.0
            roots = np.concatenate([np.sqrt(sigma), -np.sqrt(sigma)])
        roots = np.concatenate([roots, np.zeros(self.low)]) * self.radius
        return roots[np.lexsort((-roots.imag, -roots.real))]

    def kind(self, value):
        """(number of roots in the right half plane, whether there are some on the axis)."""
        roots = self.roots(value)
        near = ON_AXIS * np.abs(roots)
        return int(np.sum(roots.real > near)), bool(np.any(np.abs(roots.real) <= near))

    def distance(self, value):
        """Smallest distance of a root from the axis, relative to its size."""
        roots = self.roots(value)
        return float(np.min(np.abs(roots.real) / np.maximum(np.abs(roots), 1e-300), initial=1.0))

    def vanishing(self, grid):
        """Values at which the highest coefficient vanishes."""
        if self.high == self.low:
            return []
        return _zeros(lambda value: self.coefficients(value)[-1], grid)


def _equations(model):
    """Functions of (t, [q; μ], p): what vanishes at rest with its Jacobian and its rate in t; Z_j; the degree's bound."""
    r, q = model.reduction, model.reduction.mechanism.q
    mu = ca.SX.sym("mu", r.realisation.B.shape[1])
    balance = (r.balance - r.realisation.B @ mu).elements()
    constraints = [row.expression for row in r.original.values()]
    rows = ca.vertcat(*balance, *constraints)
    orders = [2] * len(balance) + [max(q.order(e), 0) for e in constraints]
    top = max(orders)
    jets = ca.vertcat(*(s for k in range(1, top + 1) for s in q.gamma(k)))
    moving = (jets, ca.SX.zeros(jets.shape))
    parts = []
    for j in range(top + 1):
        slopes = ca.jacobian(rows, q.jet(j))
        slopes = slopes if j else slopes @ q.V
        held = ca.jacobian(rows, mu) if j == 0 else ca.SX(rows.numel(), mu.numel())
        parts.append(ca.densify(ca.substitute(ca.horzcat(slopes, held), *moving)))
    z, p = ca.vertcat(q.jet(0), mu), ca.vertcat(*r.mechanism.parameters.symbols)
    still = ca.vertcat(ca.substitute(rows, *moving), *q.invariants.values())
    rest = [ca.densify(e) for e in (still, ca.jacobian(still, z), ca.jacobian(still, q.t))]
    return ca.Function("rest", [q.t, z, p], rest), ca.Function("Z", [q.t, z, p], parts), sum(orders)


def _require_program(model):
    if model.ideal or not model.reduction.program.residuals:
        raise SpecificationError(
            "The program is realised by an ideal reaction." if model.ideal else "There is no program.",
            "Outputs are redefined where actuators realise a program.",
            do='Write sv.Program(..., by="actuators").',
            by=model.reduction.program.by,
        )


def _zeros(f, grid):
    """Zeros of a function between values of a grid: where it changes sign, and where it touches zero."""
    from scipy.optimize import brentq, minimize_scalar

    y = np.array([f(x) for x in grid])
    size, zeros = np.abs(y).max(), [float(x) for x, v in zip(grid, y, strict=True) if v == 0]
    for a, b, u, v in zip(grid, grid[1:], y, y[1:], strict=False):
        if u * v < 0:
            zeros.append(float(brentq(f, a, b, xtol=1e-300, rtol=4 * np.finfo(float).eps)))
    for i in range(1, len(grid) - 1):
        if 0 < abs(y[i]) <= min(abs(y[i - 1]), abs(y[i + 1])) and y[i - 1] * y[i] > 0 and y[i] * y[i + 1] > 0:
            found = minimize_scalar(lambda x: abs(f(x)), bounds=(grid[i - 1], grid[i + 1]), method="bounded",
                                    options={"xatol": 1e-12 * (grid[-1] - grid[0])})  # fmt: skip
            if found.fun <= TOUCHES * size:
                zeros.append(float(found.x))
    return sorted(zeros)


def _critical(pencil, value):
    """What happens where the highest coefficient vanishes."""
    try:
        free = pencil.model.with_parameters(**{pencil.parameter: value}).free
    except (SingularProgram, NotRealisable, SpecificationError):
        free = None
    return Critical(value, len(pencil.roots(value)), free, free == 0)


def _ranges(pencil, grid, critical):
    """Ranges of one verdict, with boundaries to rounding."""
    values = _refined(pencil, grid, critical)
    kinds = [pencil.kind(value) for value in values]
    edges, found = [float(values[0])], [kinds[0]]
    for a, b, first, last in zip(values, values[1:], kinds, kinds[1:], strict=False):
        if first == last:
            continue
        inside = [c for c in critical if a <= c <= b]
        edge = inside[0] if inside else _edge(pencil, a, b, first, last)
        edges.append(float(edge))
        found.append(last)
    edges.append(float(values[-1]))
    states = pencil.high
    return tuple(
        Range(low, high, "unstable" if count else "marginal" if axis else "stable", states, count)
        for low, high, (count, axis) in zip(edges, edges[1:], found, strict=False)
        if high > low
    )


def _refined(pencil, grid, critical):
    """The grid without critical values, and with the values at which roots come closest to the axis."""
    from scipy.optimize import minimize_scalar

    width = (grid[-1] - grid[0]) / len(grid)
    grid = np.array([x for x in grid if all(abs(x - c) > 1e-9 * width for c in critical)])
    away = np.array([pencil.distance(x) for x in grid])
    more = []
    for i in range(1, len(grid) - 1):
        if ON_AXIS < away[i] <= min(away[i - 1], away[i + 1]) and away[i] < max(away[i - 1], away[i + 1]):
            found = minimize_scalar(pencil.distance, bounds=(grid[i - 1], grid[i + 1]), method="bounded")
            more.append(float(found.x))
    return np.unique([*grid, *more])


def _edge(pencil, a, b, first, last):
    """The value between a and b at which the verdict changes."""
    part = 0 if first[0] != last[0] else 1
    for _ in range(BISECTIONS):
        middle = (a + b) / 2
        a, b = (middle, b) if pencil.kind(middle)[part] == first[part] else (a, middle)
    return (a + b) / 2


def _lost(model, t, q0):
    """Rests of a program at which its leading matrix is singular, on either side of a rest."""
    r, q = model.reduction, model.reduction.mechanism.q
    held = [row for row in r.rows if row.order == 0]
    if q.n - len(held) != 1 or not q.plain:
        raise SpecificationError(
            f"At rest the program leaves {q.n - len(held)} of {q.n} coordinates free.",
            "Rests are followed along a curve: one coordinate more than constraints of order 0.",
            do="Use model.structure(...) at states of a run instead.",
            free=q.n - len(held),
        )
    jets = ca.vertcat(*(s for k in range(1, r.top + 1) for s in q.gamma(k)))
    p = ca.vertcat(*r.mechanism.parameters.symbols)
    constraints, L = (
        ca.substitute(e, jets, ca.SX.zeros(jets.shape)) for e in (ca.vertcat(*(row.expression for row in held)), r.leading)
    )
    outputs = [ca.densify(e) for e in (constraints, ca.jacobian(constraints, q.jet(0)), L)]
    f = ca.Function("rests", [q.t, q.jet(0), p], outputs)
    at = lambda x: [np.array(part) for part in f(t, x, model.parameters)]  # noqa: E731
    found = []
    for side in (1.0, -1.0):
        x = _first_loss(at, q0, side)
        if x is not None:
            found.append((float(np.linalg.norm(x - q0)), dict(zip(q.names, x.tolist(), strict=True))))
    return [state for _, state in sorted(found, key=lambda pair: pair[0])]


def _first_loss(at, q0, side):
    """The first rest along a curve at which det L changes its sign; None if there is none."""
    direction = side * np.linalg.svd(at(q0)[1])[2][-1]
    x, sign = np.array(q0, dtype=float), np.linalg.slogdet(at(q0)[2])[0]

    def advanced(x, direction, step):
        y = x + step * direction
        for _ in range(NEWTON):
            values, slopes, _ = at(y)
            change = np.linalg.lstsq(slopes, values.ravel(), rcond=None)[0]
            y = y - change
            if np.abs(change).max(initial=0.0) <= AT_REST * (1.0 + np.abs(y).max()):
                break
        return y

    for _ in range(STEPS):
        step = STEP * (1.0 + np.abs(x).max())
        y = advanced(x, direction, step)
        if np.linalg.slogdet(at(y)[2])[0] != sign:
            low, high = 0.0, step
            for _ in range(BISECTIONS):
                middle = (low + high) / 2
                same = np.linalg.slogdet(at(advanced(x, direction, middle))[2])[0] == sign
                low, high = (middle, high) if same else (low, middle)
            return advanced(x, direction, high)
        tangent = np.linalg.svd(at(y)[1])[2][-1]
        x, direction = y, tangent * np.sign(tangent @ direction or 1.0)
    return None


def _residuals_along(model, run):
    """Largest magnitudes of a model's residuals along a motion of another one."""
    r, q = model.reduction, model.reduction.mechanism.q
    expressions = [r.original[name].expression for name in r.program.residuals]
    top = max(max(q.order(e), 0) for e in expressions)
    jets, p = ca.vertcat(*(q.jet(k) for k in range(top + 1))), ca.vertcat(*r.mechanism.parameters.symbols)
    f = ca.Function("residuals", [q.t, jets, p], [ca.densify(ca.vertcat(*expressions))])
    count = len(run.t)
    values = np.array(f(run.t[None], run.jets[: jets.numel()], np.tile(model.parameters[:, None], count)))
    return dict(zip(r.program.residuals, np.abs(values).max(axis=1).tolist(), strict=True))
