"""Paths with parameters: their numbers are expressions, of which a model has the values.

On each piece r = sum c_j(p) tau^j, where tau = (t - m(p))/h(p) goes from -1 to 1. Its derivative by a parameter,

    dr/dp = sum dc_j/dp tau^j - r_tau (dm/dp + tau dh/dp)/h,

is a polynomial of the same degree on the same piece: a further row of the table of paths that a model follows.
"""

import functools
import inspect
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from servoctl.checks import as_numbers, by_name, finite, whole_of
from servoctl.errors import SpecificationError
from servoctl.spec.paths.expansions import taylor_at
from servoctl.values import Value, frozen

MAKERS = {}  # by name
OF_NUMBERS = "breaks coefficients classes before after jets held then at_rate plot"  # what a path with numbers has


def varies(value):
    """Whether what stands in place of a number is an expression of parameters, or contains one."""
    if isinstance(value, np.ndarray):
        return value.dtype == object and any(map(varies, value.ravel()))
    return any(map(varies, value)) if isinstance(value, (list, tuple)) else isinstance(value, ca.SX)


def or_parameters(*numbers, times=None) -> Any:
    """The decorator of a maker of paths which makes a `ParametricPath` where some of its numbers are expressions.

    `numbers` are the names of its arguments that may be, the first one that of a point, or of points at `times`; in
    others expressions are refused.
    """

    def decorator(make):
        MAKERS[make.__name__], signature = make, inspect.signature(make)

        @functools.wraps(make)
        def either(*args, **kwargs):
            try:
                given = signature.bind(*args, **kwargs)
            except TypeError:
                return make(*args, **kwargs)  # which says what is wrong
            varied = [name for name, value in given.arguments.items() if varies(value)]
            if others := set(varied) - {*numbers}:
                _refuse_expressions(make.__name__, sorted(others), numbers)
            if not varied:
                return make(*args, **kwargs)
            given.apply_defaults()
            options = {name: value for name, value in given.arguments.items() if name not in numbers}
            entries = {name: _as_column(given.arguments[name]) for name in numbers}
            count = entries[times][0].numel() if times else 1
            return _parametric(make.__name__, entries, options, entries[numbers[0]][0].numel() // max(count, 1))

        return either

    return decorator


def _refuse_expressions(maker, names, numbers):
    """Refuse expressions where a maker of paths takes numbers alone."""
    takes = f"in place of {', '.join(numbers)}" if numbers else "by rest_to_rest, trapezoid and spline"
    raise SpecificationError(
        f"There are expressions in {' and '.join(names)} of sv.paths.{maker.removesuffix('_through')}.",
        f"Parameters are taken {takes}; a path of numbers is added to and multiplied by them.",
        do="Write numbers, or path * p.a + p.b and path.at_rate(p.c).",
        names=tuple(names),
    )


def _as_column(value):
    """The numbers of an argument as an SX column, row by row, and its shape."""
    if isinstance(value, ca.SX):
        return ca.vec(value.T), () if value.is_scalar() else (value.numel(),) if value.is_column() else value.shape
    if not isinstance(value, (list, tuple)) and not np.ndim(value):
        return ca.SX(float(as_numbers(value))), ()
    rows = [_as_column(row) for row in value]
    shapes = [shape for _, shape in rows]
    if len(set(shapes)) > 1:
        rule, do = "Each has as many entries as the others.", "Write each point with as many entries."
        raise SpecificationError(f"The points have the shapes {shapes}.", rule, do=do, shapes=shapes)
    return ca.vertcat(ca.SX(0, 1), *(column for column, _ in rows)), (len(rows), *(shapes[0] if rows else ()))


def _parametric(maker, entries, options, dim):
    """The `ParametricPath` of a maker by its numbers, as of `_as_column`, and its other arguments."""
    column, base = ca.vertcat(*(part for part, _ in entries.values())), options.get("base")
    symbols = ca.symvar(column)
    known = {s.name(): s for s in symbols}
    if len(known) < len(symbols):
        raise SpecificationError(
            f"The path contains two parameters of one name, {', '.join(sorted(s.name() for s in symbols))}.",
            "Parameters of a path are known by their names.",
            do="Take all of them from one sv.parameters(...).",
            names=tuple(s.name() for s in symbols),
        )
    for name in base.names if isinstance(base, ParametricPath) else ():
        known.setdefault(name, ca.SX.sym(name))
    p = ca.vertcat(ca.SX(0, 1), *known.values())
    f = ca.Function("numbers", [p], [ca.densify(column), ca.densify(ca.jacobian(column, p))])
    shapes = {name: shape for name, (_, shape) in entries.items()}
    path = ParametricPath(maker, shapes, options, tuple(known), f.serialize(), dim)
    return path if known else path.made({})  # expressions of numbers alone


@frozen(eq=False)
class ParametricPath(Value):
    """A path whose numbers are expressions of parameters; made by `sv.paths` where these stand in place of numbers.

    A model follows it with its own numbers of the parameters, and another path after `with_parameters`. It is added to
    and multiplied by numbers and expressions; `path[i]` is one component, and `x, y = path` takes it apart.

    Attributes
    ----------
    maker : str
        The function that makes it.
    shapes : dict of str to tuple
        Of those of its arguments that are numbers.
    options : dict
        Its other arguments.
    names : tuple of str
        Of its parameters.
    content : str
        The function of these that returns its numbers, and their derivatives, serialised.
    dim : int
        The number of components.
    """

    maker: str
    shapes: dict
    options: dict
    names: tuple
    content: str
    dim: int
    __array_ufunc__ = None  # as of `Path`

    def at(self, **numbers: float):
        """The path with numbers of its parameters.

        Parameters
        ----------
        **numbers : float
            Of all of its parameters, SI.

        Returns
        -------
        Path

        Raises
        ------
        NameUnknown
            For a name that is no parameter of the path.
        SpecificationError
            For a parameter without a number, and for numbers with which there is no such path.
        """
        numbers = by_name(numbers, self.names, "parameter of the path", "The numbers")
        if missing := [name for name in self.names if name not in numbers]:
            raise SpecificationError(
                f"The path contains {', '.join(self.names)}, and {', '.join(missing)} has no number.",
                "A path has values where all of its parameters have numbers.",
                do=f"Write path.at({', '.join(f'{name}=...' for name in self.names)}).",
                missing=missing,
            )
        return self.made({name: finite(name, value, "parameter") for name, value in numbers.items()})

    @cached_property
    def _function(self):
        return ca.Function.deserialize(self.content)

    def _given(self, numbers, directions=()):
        """Values of its numbers by name, and their derivatives (K, ...) by some of the parameters."""
        values, slopes = (np.array(part) for part in self._function([numbers[name] for name in self.names]))
        zero = np.zeros(len(values))
        slopes = [slopes[:, self.names.index(name)] if name in self.names else zero for name in directions]
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes.values()])[:-1]
        parts = np.split(np.vstack([values.T, *slopes]), ends, axis=1)
        parts = {n: part.reshape(-1, *shape) for (n, shape), part in zip(self.shapes.items(), parts, strict=True)}
        given = {n: part[0] if self.shapes[n] else float(part[0]) for n, part in parts.items()}
        return given, {n: part[1:] for n, part in parts.items()}

    def made(self, numbers):
        """The path with numbers of the parameters by name, among others."""
        base = self.options.get("base")
        options = self.options | ({"base": base.made(numbers)} if isinstance(base, ParametricPath) else {})
        return MAKERS[self.maker](**self._given(numbers)[0], **options)

    def rates(self, numbers, directions):
        """The derivatives of the path by some of the parameters, a list of `Path`."""
        path, breaks, coefficients = path_moved(self, numbers, directions)
        half = np.diff(path.breaks) / 2
        middle, longer = (breaks[:, 1:] + breaks[:, :-1]) / 2 / half, np.diff(breaks) / 2 / half
        powers = np.arange(coefficients.shape[-1])
        slopes = np.pad(path.coefficients[:, :, 1:] * powers[1:], ((0, 0), (0, 0), (0, 1)))
        table = coefficients - middle[:, :, None, None] * slopes
        table -= longer[:, :, None, None] * path.coefficients * powers
        moves = (breaks != 0) & np.isfinite(path.classes)
        self._require_known_outside(path, moves.any(axis=0))
        classes = np.maximum(path.classes - moves, -1.0)
        return [path._with(coefficients=c, classes=rough) for c, rough in zip(table, classes, strict=True)]

    def _require_known_outside(self, path, moves):
        """Refuse a path whose derivative is not held, or does not repeat, outside its breaks where these move."""
        bent = path.breaks[[0, -1]][moves[[0, -1]] & (path.classes[[0, -1]] < 1)]
        if len(bent) or path.before == "periodic" and moves.any():
            what = f"has a bend where it is held, at t = {bent[0]:g} s" if len(bent) else "is periodic"
            raise SpecificationError(
                f"The path {what}, and its breaks move with {', '.join(self.names)}.",
                "A path has derivatives by parameters where it comes to rest before it is held, and does not repeat.",
                do="Make it with smoothness=1 or more, without before='periodic'; or keep its breaks where they are.",
                names=self.names,
            )

    def __len__(self):
        return self.dim

    def __iter__(self):
        return (self[i] for i in range(self.dim))

    def __getitem__(self, i):
        return changed(self, component=whole_of("component", i, range(-self.dim, self.dim)))

    def __mul__(self, factor):
        return changed(self, scale=factor)

    __rmul__ = __mul__

    def __neg__(self):
        return self * -1.0

    def __add__(self, other):
        return changed(self, offset=other)

    __radd__ = __add__

    def __sub__(self, other):
        return -(-self + other)

    def __rsub__(self, other):
        return -self + other

    def __call__(self, t):
        """Refused: it has no values without numbers."""
        raise self._without_numbers("path(t)")

    def __getattr__(self, name):
        if name not in OF_NUMBERS.split():
            raise AttributeError(f"A path with parameters has no attribute {name!r}.")
        raise self._without_numbers(f"path.{name}")

    def _without_numbers(self, what):
        at = f"path.at({', '.join(f'{name}=...' for name in self.names)})"
        return SpecificationError(
            f"{what} was asked of a path that contains the parameters {', '.join(self.names)}.",
            "A path has values where all of its parameters have numbers; a model has them.",
            do=f"Write {what.replace('path', at, 1)}, or simulate a model that follows it.",
            names=self.names,
        )

    def __repr__(self):
        return f"Path: {self.dim} component{'s' * (self.dim > 1)}, with the parameters {', '.join(self.names)}"


# --- derivatives of the breaks and of the coefficients, by maker ------------------------------------------------------


def path_moved(path, numbers, directions):
    """A path with numbers, and derivatives of its breaks (K, n + 1) and of its coefficients (K, n, dim, size)."""
    if not isinstance(path, ParametricPath):
        return path, *(np.zeros((len(directions), *part.shape)) for part in (path.breaks, path.coefficients))
    options = {n: path_moved(one, numbers, directions) if n == "base" else one for n, one in path.options.items()}
    made = path.made(numbers)
    return made, *RATES[path.maker](made, *path._given(numbers, directions), options)


def _rest_to_rest_rates(path, given, rates, options):
    times = {"duration": given["duration"], "t_start": given["t_start"]}
    unit = MAKERS["rest_to_rest"](0.0, 1.0, **times, **options).coefficients
    K = len(rates["start"])
    start, end = (rates[name].reshape(K, 1, path.dim, 1) for name in ("start", "end"))
    coefficients = (end - start) * unit
    coefficients[..., :1] += start
    part = (path.breaks - given["t_start"]) / given["duration"]
    return rates["t_start"][:, None] + rates["duration"][:, None] * part, coefficients


def _trapezoid_rates(path, given, rates, options):
    """Of distance times a unit path, whose rise and fall are in proportion to ramp/(duration - ramp)."""
    duration, ramp, t_start = (given[name] for name in ("duration", "ramp", "t_start"))
    by_duration, by_ramp, by_start = (rates[name] for name in ("duration", "ramp", "t_start"))
    corners = np.array([0.0, ramp, duration - ramp, duration]) + t_start
    moves = np.column_stack([0.0 * by_ramp, by_ramp, by_duration - by_ramp, by_duration]) + by_start[:, None]
    middles, part = path.breaks[:-1] + np.diff(path.breaks) / 2, ramp / (duration - ramp)
    cruising = (corners[1] < middles) & (middles < corners[2])
    if not cruising.any() and (moves[:, 1] != moves[:, 2]).any():
        raise SpecificationError(
            f"The ramps of the trapezoid take its whole duration of {duration:g} s.",
            "Where its cruise begins or ends with a parameter, it has derivatives to one side alone.",
            do="Give it shorter ramps, or write ramp=duration/2.",
            ramp=float(ramp),
            duration=float(duration),
        )
    unit = MAKERS["trapezoid"](1.0, duration, ramp, t_start=t_start, **options).coefficients
    rest = np.zeros_like(unit)  # the unit path without ramps
    rest[middles > corners[2], :, 0] = 1.0
    rest[cruising, :, :2] = 0.5
    by_part = (by_ramp * duration - ramp * by_duration) / (duration - ramp) ** 2
    K, distance = len(by_ramp), np.reshape(given["distance"], (path.dim, 1))
    coefficients = rates["distance"].reshape(K, 1, path.dim, 1) * unit
    coefficients = coefficients + by_part[:, None, None, None] * distance * (unit - rest) / part
    return np.array([np.interp(path.breaks, corners, move) for move in moves]), coefficients


def _spline_rates(path, given, rates, options):
    """The linear equations of the coefficients, differentiated.

    At the times the values are the points, at breaks derivatives are the same on both sides, at both ends some vanish.
    With Taylor coefficients T_k of pieces of half length h, dT_k = T_k(dc) - k T_k dh/h.
    """
    from scipy.sparse import lil_array
    from scipy.sparse.linalg import splu

    (n, dim, size), K, m = path.coefficients.shape, len(rates["times"]), path.coefficients.shape[2] // 2 - 1
    moves = np.array([np.interp(path.breaks, given["times"], move) for move in rates["times"]])
    longer = (np.diff(moves) / np.diff(path.breaks)).T[:, :, None]
    starts, stops = (taylor_at(path.breaks, np.tile(np.eye(size), (n, 1, 1)), tau) for tau in (-1.0, 1.0))
    values = taylor_at(path.breaks, path.coefficients, -1.0)[:, :, None]
    points = np.moveaxis(rates["points"].reshape(K, -1, dim), 1, 0)
    timed = np.isfinite(path.classes)
    timed[[0, -1]] = True
    vanishing = slice(1, m + 1) if options["ends"] == "rest" else slice(m + 1, 2 * m + 1)
    matrix, right, row = lil_array((n * size, n * size)), np.zeros((n * size, K, dim)), 0
    for i, point in enumerate(np.cumsum(timed) - 1):
        before, after = slice((i - 1) * size, i * size), slice(i * size, (i + 1) * size)
        here, side = (after, starts[:, i]) if i < n else (before, stops[:, -1])
        if timed[i]:
            matrix[row, here], right[row] = side[0], points[point]
        row += timed[i]
        count = size - timed[i] if 0 < i < n else m
        some = slice(row, row + count)
        if 0 < i < n:
            matrix[some, before], matrix[some, after] = stops[:count, i - 1], -starts[:count, i]
            right[some] = np.arange(count)[:, None, None] * values[:count, i] * (longer[i - 1] - longer[i])
        else:
            matrix[some, here] = side[vanishing]
        row += count
    solved = splu(matrix.tocsc()).solve(right.reshape(n * size, K * dim))
    return moves, solved.reshape(n, size, K, dim).transpose(2, 0, 3, 1)


def _changed(base, component, scale, offset, factor, about):
    path = base if component is None else base[component]
    return (path * scale + offset).at_rate(factor, about)


def _changed_rates(_, given, rates, options):
    """From those of the path that is changed."""
    path, moves, table = options["base"]
    some = slice(None) if options["component"] is None else [options["component"]]
    coefficients = given["scale"] * table[:, :, some]
    coefficients += rates["scale"][:, None, None, None] * path.coefficients[:, some]
    coefficients[..., 0] += rates["offset"].reshape(len(moves), 1, -1)
    factor, since = given["factor"], path.breaks - given["about"]
    slower = rates["about"][:, None] * (1 - 1 / factor) - rates["factor"][:, None] * since / factor**2
    return moves / factor + slower, coefficients


MAKERS["changed"] = _changed
RATES = {
    "rest_to_rest": _rest_to_rest_rates,
    "trapezoid": _trapezoid_rates,
    "spline_through": _spline_rates,
    "changed": _changed_rates,
}


def changed(base, component=None, scale=1.0, offset=None, factor=1.0, about=0.0):
    """One component of a path, or all, times a number and plus a constant, along another clock."""
    dim = base.dim if component is None else 1
    numbers = {"scale": scale, "offset": np.zeros(dim) if offset is None else offset, "factor": factor, "about": about}
    for one in numbers.values():
        if isinstance(one, Value):
            raise SpecificationError(
                "A path is added to one with parameters, or multiplied by it.",
                "A path with parameters is added to and multiplied by numbers and parameters.",
                do="Name a reference for each path, q.references(a=..., b=...), and write r.a + r.b.",
            )
    entries = {name: _as_column(value) for name, value in numbers.items()}
    return _parametric("changed", entries, {"base": base, "component": component}, dim)
