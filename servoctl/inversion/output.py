"""Output redefinition: for which values of a parameter the internal dynamics at an equilibrium are stable.

The eigenvalues are the roots of the polynomial det Z (see `zeros`), whose coefficients are smooth in the parameter. A
range ends where a root crosses the imaginary axis, or where one passes through infinity and the relative degree at the
equilibrium changes. Where the dimension falls in motion, too, the output is flat.
"""

from dataclasses import field

import casadi as ca
import numpy as np

from servoctl.checks import finite, interval, named, require_kind
from servoctl.codegen.paths import arguments
from servoctl.errors import InconsistentStart, NotRealisable, SingularProgram, SpecificationError
from servoctl.inversion.zeros import NO_COEFFICIENT, ZeroPolynomial
from servoctl.methods.kinks import SMOOTHER, kink
from servoctl.model.model import Model, default_start
from servoctl.model.start import State
from servoctl.spec.references import function_of, require_fixed
from servoctl.tolerances import ENTRY, TINY
from servoctl.values import frozen

VALUES = 257  # of the parameter, spread over its range, at which roots are computed
TOUCHES = 1e-9  # of its largest value: a coefficient whose smallest value is below has a root there
NARROWEST = 24  # of a step of the values, towards a value at which roots come closest to the axis
NEWTON_STEPS = 60  # to a rest
CURVE_STEP, CURVE_STEPS = 0.02, 500  # along the rests of a program, relative to the size of the state; on either side
SHOWN_RANGES, SHOWN_VALUES = 6, 3  # in the printed form


@frozen
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

    def __str__(self):
        growing = f", {self.unstable} of them unstable" if self.unstable else ""
        return f"{self.verdict}, {_states(self.states)}{growing}"


@frozen
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

    def __str__(self):
        if self.flat:
            return "flat"
        motion = "" if self.free is None else f", in motion {self.free}"
        return f"the relative degree at the equilibrium rises; {_states(self.states)} there{motion}"


@frozen(eq=False)
class MinimumPhase:
    """Internal dynamics at an equilibrium over the values of a parameter; made by `minimum_phase`.

    Attributes
    ----------
    ranges : tuple of Range
        In the order of the values.
    critical : tuple of Critical
        Values at which a root passes through infinity.
    values : (N,) array
        Values of the parameter, and
    roots : tuple of (f,) complex arrays
        eigenvalues of the internal dynamics there [1/s].
    polynomial : ZeroPolynomial
    """

    ranges: tuple
    critical: tuple
    values: np.ndarray = field(repr=False)
    roots: tuple = field(repr=False)
    polynomial: object = field(repr=False)

    @property
    def parameter(self):
        """The parameter's name."""
        return self.polynomial.parameter

    @property
    def own(self):
        """The model's own value."""
        return self.polynomial.own

    @property
    def stable(self):
        """The ranges with stable internal dynamics, a tuple of (low, high)."""
        return tuple((r.low, r.high) for r in self.ranges if r.verdict == "stable")

    @property
    def flat(self):
        """Values for which the output is flat, a tuple of float."""
        return tuple(c.value for c in self.critical if c.flat)

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
        return self.polynomial.roots(finite(self.parameter, value))

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
        value, polynomial = finite(self.parameter, value), self.polynomial
        model = polynomial.model.with_parameters(**{self.parameter: value})
        return _losses(model, polynomial.t, polynomial.equilibrium(value)[: model.nq])

    def as_dict(self):
        """The result as plain values: {name: value}."""
        return {
            "parameter": self.parameter,
            "own": self.own,
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
        name, values = self.parameter, self.values
        lines = [f"MinimumPhase: {name} from {values[0]:g} to {values[-1]:g}, the model's own value {self.own:g}"]
        lines += [f"  {name} from {r.low:.10g} to {r.high:.10g}: {r}" for r in self.ranges[:SHOWN_RANGES]]
        lines += [f"  {name} = {c.value:.10g}: {c}" for c in self.critical[:SHOWN_VALUES]]
        hidden = max(len(self.ranges) - SHOWN_RANGES, 0) + max(len(self.critical) - SHOWN_VALUES, 0)
        return "\n".join(lines + ([f"  and {hidden} more"] if hidden else []))


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
        If the state is no equilibrium or lies on a switch, the program does not stand still there, or a value has no
        equilibrium.
    NotRealisable
        If the residuals determine no motion at the equilibrium, for any value.
    SpecificationError
        For a parameter of nothing but coordinates that the model leaves out, and for one of paths.

    Notes
    -----
    Ranges are sought between 257 values, and at and around the smallest distances of roots from the axis between these;
    narrower ones may be missed. Boundaries are accurate to rounding.
    """
    require_kind(Model, "model", model, "sv.derive(mechanism, program)")
    named(parameter, list(model.numbers), "parameter")
    ends = [finite(parameter, end, "range") for end in interval(parameter, values, "range")]
    _require_program(model)
    require_fixed(model.paths, model.reduction.mechanism.parameters, [parameter], "Zeros are followed over")
    _require_part(model, parameter)
    at = default_start(model) if at is None else require_kind(State, "at", at, "model.start(...)")
    polynomial, grid = ZeroPolynomial(model, parameter, at), np.linspace(*ends, VALUES)
    _require_linearisation(model, at)
    polynomial.follow(grid)
    critical = tuple(_critical(polynomial, value) for value in _infinite(polynomial, grid))
    ranges = _ranges(polynomial, grid, [c.value for c in critical])
    return MinimumPhase(ranges, critical, grid, tuple(map(polynomial.roots, grid)), polynomial)


def _states(count):
    return f"{count} internal state{'s' * (count != 1)}" if count else "no internal states"


def _require_program(model):
    if model.reduction.ideal or not model.reduction.program.residuals:
        raise SpecificationError(
            "The program is realised by an ideal reaction." if model.reduction.ideal else "There is no program.",
            "Outputs are redefined where actuators realise a program.",
            do='Write sv.Program(..., by="actuators").',
            by=model.reduction.program.by,
        )


def _require_part(model, parameter):
    """Refuse a parameter of nothing but coordinates that were left out."""
    mechanism, names = model.reduction.mechanism, ", ".join(model.reduction.left_out)
    symbol = dict(zip(mechanism.parameters.names, mechanism.parameters.symbols, strict=True))[parameter]
    rows = (*model.reduction.program.residuals.values(), *mechanism.constraints.values())
    if names and not ca.depends_on(ca.vertcat(mechanism.balance, ca.vec(mechanism.E), *rows), symbol):
        raise SpecificationError(
            f"The model was derived without {names}, and nothing that is left depends on {parameter}.",
            "Coordinates that nothing couples to the program are left out, and their stability is not judged.",
            do=f"Write sv.derive(mechanism, program, keep={list(model.reduction.left_out)}).",
            parameter=parameter,
            left_out=model.reduction.left_out,
        )


def _require_linearisation(model, at):
    switch = kink(model, at.t, np.asarray(at.values, dtype=float))
    if switch:
        raise InconsistentStart(
            f"The equilibrium lies on a switch, {switch}.",
            "Internal dynamics are linearised at an equilibrium, with one linearisation on all sides.",
            do=f"{SMOOTHER[0].upper()}{SMOOTHER[1:]}, or pass another equilibrium.",
            switch=switch,
        )


def _infinite(polynomial, grid):
    """Values at which a root passes through infinity: the highest coefficient changes its sign, or touches zero."""
    from scipy.optimize import brentq, minimize_scalar

    if polynomial.high == polynomial.low:
        return []
    f, y = polynomial.highest, np.array([polynomial.highest(value) for value in grid])
    y[np.abs(y) <= NO_COEFFICIENT * np.abs(y).max()] = 0.0
    zeros = grid[y == 0].tolist()
    for i in np.flatnonzero(y[:-1] * y[1:] < 0):
        zeros.append(brentq(f, grid[i], grid[i + 1], xtol=TINY, rtol=4 * np.finfo(float).eps))
    for i in np.flatnonzero((np.abs(y[1:-1]) <= np.minimum(np.abs(y[:-2]), np.abs(y[2:]))) & (y[:-2] * y[2:] > 0)) + 1:
        least = minimize_scalar(lambda value: abs(f(value)), bounds=(grid[i - 1], grid[i + 1]), method="bounded")
        if y[i] and least.fun <= TOUCHES * np.abs(y).max():
            zeros.append(float(least.x))
    return sorted(zeros)


def _critical(polynomial, value):
    """What happens at a value at which a root passes through infinity."""
    try:
        free = polynomial.model.with_parameters(**{polynomial.parameter: value}).free
    except (SingularProgram, NotRealisable, SpecificationError):
        free = None
    return Critical(value, len(polynomial.roots(value)), free, free == 0)


def _ranges(polynomial, grid, critical):
    """Ranges of one verdict, with boundaries to rounding."""
    width = (grid[-1] - grid[0]) / VALUES
    values = [v for v in _refined(polynomial, grid) if all(abs(v - c) > TOUCHES * width for c in critical)]
    kinds = [polynomial.kind(value) for value in values]
    alone = _alone([axis for _, axis in kinds])  # single values with roots on the axis: a crossing, or a touch
    marks, values = [values[i] for i in alone], [v for i, v in enumerate(values) if i not in alone]
    kinds = [kind for i, kind in enumerate(kinds) if i not in alone]
    edges, verdicts = [float(grid[0])], [kinds[0]]
    for a, b, first, last in zip(values, values[1:], kinds, kinds[1:], strict=False):
        inside = [c for c in critical if a <= c <= b] if first != last else [v for v in marks if a < v < b]
        if first != last or inside:
            edges.append(inside[0] if inside else _edge(polynomial, a, b, first, last))
            verdicts.append(last)
    return tuple(
        Range(low, high, "unstable" if count else "marginal" if axis else "stable", polynomial.high, count)
        for low, high, (count, axis) in zip(edges, [*edges[1:], float(grid[-1])], verdicts, strict=True)
        if high > low
    )


def _alone(flags):
    """Places of flags between neighbours without."""
    return {i for i in range(1, len(flags) - 1) if flags[i] and not flags[i - 1] and not flags[i + 1]}


def _refined(polynomial, grid):
    """The values of a grid, and those between at which roots come closest to the axis."""
    from scipy.optimize import minimize_scalar

    away = np.array([polynomial.distance(value) for value in grid])
    near = (away[1:-1] > 0) & (away[1:-1] <= np.minimum(away[:-2], away[2:])) & (away[:-2] + away[2:] > 2 * away[1:-1])
    step = grid[1] - grid[0]
    closest = [
        minimize_scalar(
            polynomial.distance, bounds=(grid[i - 1], grid[i + 1]), method="bounded", options={"xatol": TOUCHES * step}
        ).x
        for i in np.flatnonzero(near) + 1
    ]
    # where roots cross there and back between two values, one of these lies between the crossings
    offsets = step * np.concatenate([s * 0.5 ** np.arange(1, NARROWEST) for s in (1.0, -1.0)])
    around = [v for c in closest for v in c + offsets if grid[0] < v < grid[-1] and not polynomial.kind(v)[1]]
    return np.unique([*grid, *closest, *around]).tolist()


def _edge(polynomial, a, b, first, last):
    """The value between a and b at which the verdict changes."""
    from scipy.optimize import bisect

    part = 0 if first[0] != last[0] else 1

    def changed(value):
        return -1.0 if polynomial.kind(value)[part] == first[part] else 1.0

    return bisect(changed, a, b, xtol=np.finfo(float).eps * (b - a), rtol=4 * np.finfo(float).eps)


def _losses(model, t, q0):
    """Rests of a program at which its leading matrix is singular, on either side of a rest q0."""
    r, q = model.reduction, model.reduction.mechanism.q
    held = [row for row in r.rows if row.order == 0]
    if q.n - len(held) != 1 or not q.plain:
        raise SpecificationError(
            f"At rest the program leaves {q.n - len(held)} of {q.n} coordinates free.",
            "Rests are followed along a curve: coordinates are one more than constraints of order 0, and γ' = q'.",
            do="Use model.structure(...) at the states of a run.",
            free=q.n - len(held),
        )
    jets = ca.vertcat(*(s for k in range(1, r.top + 1) for s in q.gamma(k)))
    constraints = ca.vertcat(*(row.expression for row in held))
    outputs = [constraints, ca.jacobian(constraints, q.jet(0)), ca.substitute(r.leading, jets, ca.SX.zeros(jets.shape))]
    p = ca.vertcat(*r.mechanism.parameters.symbols)
    rests = function_of(q, r.references, "rests", q.jet(0), p, *map(ca.densify, outputs))

    def at(x):
        return [np.array(part) for part in rests(*arguments(rests, t, x, model.p))]

    both = [x for x in (_first_loss(at, q0, side) for side in (1.0, -1.0)) if x is not None]
    both.sort(key=lambda x: np.linalg.norm(x - q0))
    return [dict(zip(q.names, x.tolist(), strict=True)) for x in both]


def _first_loss(at, q0, side):
    """The first rest along a curve at which det L has another sign; None if there is none."""
    from scipy.optimize import bisect

    x, before, sign = np.array(q0, dtype=float), None, np.linalg.slogdet(at(q0)[2])[0]
    for _ in range(CURVE_STEPS):
        tangent = np.linalg.svd(at(x)[1])[2][-1]
        before = tangent * (side if before is None else np.sign(tangent @ before or 1.0))
        step = before * CURVE_STEP * (1.0 + np.abs(x).max())

        def same(part, x=x, step=step):
            return 1.0 if np.linalg.slogdet(at(_onto(at, x + part * step))[2])[0] == sign else -1.0

        if same(1.0) < 0:
            return _onto(at, x + bisect(same, 0.0, 1.0, xtol=np.finfo(float).eps) * step)
        x = _onto(at, x + step)
    return None


def _onto(at, x):
    """The rest nearest to a point."""
    for _ in range(NEWTON_STEPS):
        rows, slopes, _ = at(x)
        change = np.linalg.lstsq(slopes, rows.ravel(), rcond=None)[0]
        x = x - change
        if np.abs(change).max(initial=0.0) <= ENTRY * (1.0 + np.abs(x).max()):
            break
    return x
