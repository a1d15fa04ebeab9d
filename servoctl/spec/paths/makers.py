"""Paths from ends, points and limits."""

import functools
import inspect
import itertools
import math
from typing import Any

import casadi as ca
import numpy as np

from servoctl.checks import array_of, as_numbers, column, finite, named, positive, whole_of
from servoctl.errors import SpecificationError
from servoctl.spec.paths.parametric import parametric, varies
from servoctl.spec.paths.scipy_paths import as_path, by_derivatives
from servoctl.spec.paths.value import HALVINGS, SAME, SMOOTHEST, Path, cut, require_ascending, vector

MISSED = 1e-9  # largest distance of a spline from its points, relative to the largest point


def _shown(value):
    return str(value) if isinstance(value, ca.SX) else repr(value)


def without_time(maker: Any) -> Any:
    """The maker of a path, which refuses a time in front of its arguments and shows what to write."""
    parameters = [p.replace(kind=p.POSITIONAL_OR_KEYWORD) for p in inspect.signature(maker).parameters.values()]
    timed = inspect.Signature([inspect.Parameter("t", inspect.Parameter.POSITIONAL_OR_KEYWORD), *parameters])

    @functools.wraps(maker)
    def made(*args, **kwargs):
        try:
            given = timed.bind_partial(*args, **kwargs).arguments
        except TypeError:
            return maker(*args, **kwargs)
        time, needed = given.pop("t", None), [p.name for p in parameters if p.default is p.empty]
        missing = [name for name in needed if name not in given]
        if not isinstance(time, ca.SX) or missing and "t" not in map(ca.SX.name, ca.symvar(time)):
            return maker(*args, **kwargs)
        shown = [(name, text if len(text := _shown(value)) < 40 else name) for name, value in given.items()]
        shown, plain = shown + [(name, "...") for name in missing], {*needed} - kwargs.keys() - {*missing}
        line = f"sv.paths.{maker.__name__}({', '.join(x if name in plain else f'{name}={x}' for name, x in shown)})"
        raise SpecificationError(
            f"{maker.__name__} was called with {_shown(time)} before its other arguments.",
            "It makes a path: data with numbers, which a reference follows in time.",
            nearest=f"{line}.",
            do=f"Write r = q.references(X={line}), and r.X in the program.",
            name=maker.__name__,
        )

    return made


@without_time
def rest_to_rest(start, end, duration, *, smoothness=4, t_start=0.0):
    """Move from rest to rest along the polynomial of degree 2k + 1 whose first k derivatives vanish at both ends.

    Of class C^k, k = `smoothness`; it minimises the integral of the square of derivative k + 1. With sigma = (t -
    t_start)/duration it is start + (end - start) I_sigma(k + 1, k + 1), the regularised incomplete beta function.
    Held before and after.

    Parameters
    ----------
    start, end : float, (dim,) array, or expressions of parameters
        The path before and after, SI.
    duration : float or SX
        Time taken [s], positive.
    smoothness : int, optional
        Class k >= 0. A crane, or two cars and a spring, need 4.
    t_start : float or SX, optional
        Time of departure [s].

    Returns
    -------
    Path, or ParametricPath with parameters

    Raises
    ------
    SpecificationError
        If start and end differ in size, the duration is not positive, the smoothness is no integer from 0 to 100,
        or a number is not finite.
    """
    if varies([start, end, duration, t_start]):
        start = ca.vertcat(*column(start, "start"))
        way = ca.vertcat(*column(end, "end", start.numel())) - start
        return parametric(rest_to_rest(0.0, 1.0, 1.0, smoothness=smoothness), way, start, t_start, duration)
    k = _class(smoothness)
    start, end = _ends(start, end)
    t_start = finite("t_start", t_start)
    breaks, step = _stretched(*_unit_step(k), t_start, t_start + positive("duration", duration))
    return _along(breaks, step, start, end, k)


@without_time
def trapezoid(distance, duration, ramp, *, smoothness=4, t_start=0.0):
    """Cover a distance at a constant speed that is reached, and left, along smooth ramps.

    Of class C^k, k = `smoothness`: during the first and last `ramp` seconds the speed rises and falls along the
    polynomial of `rest_to_rest` of class k - 1. The cruising speed is distance/(duration - ramp). Starts at 0; held
    before and after.

    Parameters
    ----------
    distance : float, (dim,) array, or expressions of parameters
        Where the path ends, SI.
    duration : float
        Time taken [s], positive.
    ramp : float
        Length of each ramp [s], positive, at most half the duration.
    smoothness : int, optional
        Class k >= 1.
    t_start : float or SX, optional
        Time of departure [s].

    Returns
    -------
    Path, or ParametricPath with parameters

    Raises
    ------
    SpecificationError
        If duration or ramp is not positive, the ramps do not fit in the duration, the smoothness is no integer from
        1 to 100, or a number is not finite.
    """
    if varies([distance, t_start]):
        unit, distance = trapezoid(1.0, duration, ramp, smoothness=smoothness), column(distance, "distance")
        return parametric(unit, ca.vertcat(*distance), np.zeros(len(distance)), t_start)
    k, t_start = _class(smoothness, least=1), finite("t_start", t_start)
    duration, ramp = positive("duration", duration), positive("ramp", ramp)
    distance = vector("distance", distance)
    if 2 * ramp > duration:
        raise SpecificationError(
            f"Two ramps of {ramp:g} s do not fit in a duration of {duration:g} s.",
            "A trapezoid speeds up, cruises and slows down within its duration.",
            f"A ramp of {duration / 2:g} s.",
            "Shorten the ramp or lengthen the duration.",
            ramp=ramp,
            duration=duration,
        )
    corners = [t_start, t_start + ramp, t_start + duration - ramp, t_start + duration]
    part = ramp / (duration - ramp)  # of the distance: what the cruise would cover twice during a ramp
    edges, rise = _unit_ramp(k)
    fall = -rise[::-1] * (-1.0) ** np.arange(rise.shape[1])
    begun, rise = _stretched(edges, part * rise, *corners[:2])
    ended, fall = _stretched(1.0 - edges[::-1], part * fall, *corners[2:])
    fall[:, 0] += 1.0
    cruise = np.zeros((int(corners[2] - corners[1] > SAME * np.abs(corners).max()), rise.shape[1]))
    cruise[:, :2] = 0.5, 0.5 - part / 2
    breaks = np.concatenate([begun, ended[1 - len(cruise) :]])
    table = np.concatenate([rise, cruise, fall])
    return _along(breaks, table, 0.0 * distance, distance, k, np.isin(breaks, corners))


def s_curve(start, end, speed, acceleration, jerk, *, t_start=0.0):
    """Move from rest to rest along a line as quickly as limits of speed, acceleration and jerk allow.

    The jerk is constant piece by piece, at its limit or zero, in at most seven phases: of class C^2. Held before and
    after.

    Parameters
    ----------
    start, end : float or (dim,) array
        The path before and after, SI; they differ.
    speed, acceleration, jerk : float
        Limits along the line, SI, positive; what need not be reached is not reached.
    t_start : float, optional
        Time of departure [s].

    Returns
    -------
    Path

    Raises
    ------
    SpecificationError
        If start and end differ in size or are the same, a limit is not positive, or a number is not finite.
    """
    from scipy.interpolate import PPoly

    start, end = _ends(start, end)
    distance = math.hypot(*(end - start))
    if distance == 0.0:
        raise SpecificationError(
            f"start and end are both {end.tolist()}.",
            "They differ.",
            do="Use rest_to_rest for a path that stands still.",
            start=end.tolist(),
        )
    v, a, j = positive("speed", speed), positive("acceleration", acceleration), positive("jerk", jerk)
    rise = min(a / j, math.sqrt(v / j), (distance / (2 * j)) ** (1 / 3))  # of the acceleration, to its largest value
    a = j * rise
    constant = max(0.0, min(v / a - rise, math.sqrt(rise**2 / 4 + distance / a) - 1.5 * rise))  # of the acceleration
    cruise = max(0.0, distance / (a * (rise + constant)) - 2 * rise - constant)
    phases = np.array([rise, constant, rise, cruise, rise, constant, rise])
    if not rise > SAME * phases.sum():
        raise SpecificationError(
            f"Of {phases.sum():.3g} s in all, the acceleration rises for {rise:.3g} s.",
            f"Phases of a path last for more than {SAME:g} of it: shorter ones are rounding.",
            do="Give a shorter distance, a higher speed or a lower jerk.",
            duration=float(phases.sum()),
            rise=rise,
        )
    lasting = phases > SAME * phases.sum()  # others are rounding
    breaks = np.append(0.0, np.cumsum(phases[lasting]))
    jerks = np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])[lasting] * j / distance
    unit = as_path(PPoly(jerks[None], breaks).antiderivative(3), smoothness=2)
    table = unit.coefficients[:, 0]
    return _along(finite("t_start", t_start) + unit.breaks, table, start, end, 2, np.isfinite(unit.classes))


@without_time
def spline(times, points, *, smoothness=2, ends="rest"):
    """Pass through points at given times along SciPy's interpolating spline.

    With `ends="rest"` the spline has degree 2k + 1, k = `smoothness`, and its first k derivatives vanish at both
    ends, where it is held: of class C^k there, C^2k at the points between. It minimises the integral of the square
    of derivative k + 1; two points give `rest_to_rest`. With `ends="natural"` it has the least odd degree 2m + 1 > k,
    is of class C^2m, its derivatives m + 1 to 2m vanish at both ends, and its first and last polynomials go on.

    Derivatives amplify noise: an error e of points at a distance h becomes one of about e (pi/h)^k in derivative k.
    Use `fit` for measurements. A high smoothness over very uneven times overshoots between the points.

    Parameters
    ----------
    times : (n,) array
        Ascending [s], n >= 2.
    points : (n,) or (n, dim) array, or expressions of parameters
        SI.
    smoothness : int, optional
        Class k >= 0.
    ends : {"rest", "natural"}, optional
        What happens at the ends.

    Returns
    -------
    Path, or ParametricPath with parameters

    Raises
    ------
    SpecificationError
        If times do not ascend, shapes disagree, a number is not finite, the smoothness is no integer from 0 to 100, or
        the points are too few or too unevenly timed for it.
    NameUnknown
        If `ends` is neither "rest" nor "natural".
    """
    if varies(points):
        if not isinstance(points, ca.SX):
            dim = len(column(points[0], "point 0"))
            rows = (ca.horzcat(*column(point, f"point {i}", dim)) for i, point in enumerate(points))
            points = ca.vertcat(*rows)
        unit = spline(times, np.eye(points.shape[0]), smoothness=smoothness, ends=ends)
        return parametric(unit, points.T, ca.SX.zeros(points.shape[1]))
    rest, k = named(ends, ("rest", "natural"), "spline end") == "rest", _class(smoothness)
    times, points = samples(times, points)
    m = k if rest else (k + 1) // 2
    if not rest and len(times) <= m:
        raise SpecificationError(
            f"A natural spline of smoothness {k} has {len(times)} points.",
            f"Its degree is {2 * m + 1}, which needs at least {m + 1} points.",
            f"smoothness={2 * (len(times) - 1)}.",
            "Use more points, a lower smoothness, or ends='rest'.",
            points=len(times),
            smoothness=k,
        )
    miss, degree = math.nan, 2 * m + 1
    vanishing, outside = (range(1, m + 1), "hold") if rest else (range(m + 1, degree), "continue")
    try:
        path = _interpolating(times, points, vanishing, outside)
        miss = np.abs(path.jets(times, 0)[0].T - points).max()
    except (ValueError, np.linalg.LinAlgError):  # SciPy's equations are singular for very uneven intervals
        pass
    if not miss <= MISSED * np.abs(points).max():
        ratio = np.diff(times).max() / np.diff(times).min()
        raise SpecificationError(
            f"The spline of degree {degree} misses its points by {miss:.1e}; its longest interval is {ratio:.3g} times "
            "its shortest.",
            f"A spline passes through its points to within {MISSED:g} of the largest.",
            do="Choose intervals in proportion to the distances between the points, or a lower smoothness.",
            degree=degree,
            miss=miss,
            ratio=ratio,
        )
    return path


def _interpolating(times, points, vanishing, outside):
    """SciPy's spline through points whose derivatives of m orders vanish at both ends."""
    from scipy.interpolate import make_interp_spline

    m, unit = len(vanishing), (times[-1] - times[0]) / (len(times) - 1)
    conditions = [(order, np.zeros(points.shape[1])) for order in vanishing]
    bc_type = (conditions, conditions) if conditions else None
    curve = make_interp_spline((times - times[0]) / unit, points, k=2 * m + 1, bc_type=bc_type)
    breaks, coefficients, cuts = cut(times, by_derivatives(curve, 2 * m + 1, times[0], unit))
    classes = np.where(cuts, np.inf, 2.0 * m)
    classes[[0, -1]] = m if outside == "hold" else np.inf
    return Path(breaks, coefficients, classes, outside, outside)


def polynomials(breaks, coefficients, *, smoothness=None, before=None, after=None):
    """Piecewise polynomials in the convention of SciPy's `PPoly`.

    Parameters
    ----------
    breaks : (n + 1,) array
        Ascending [s].
    coefficients : (degree + 1, n) or (degree + 1, n, dim) array
        Of powers of the time since the start of each piece, the highest power first, SI.
    smoothness : int, optional
        The class at the breaks; by default counted from the coefficients.
    before, after : {"hold", "continue", "periodic"}, optional
        What the path does outside, as the attributes of `Path` say.

    Returns
    -------
    Path

    Raises
    ------
    SpecificationError
        If breaks do not ascend, the coefficients have another shape, a number is not finite, or there are too many
        pieces for the class to be counted.
    """
    from scipy.interpolate import PPoly

    breaks, table = array_of("breaks", breaks, None), as_numbers(coefficients)
    require_ascending("breaks", breaks)
    pieces, finite_numbers = len(breaks) - 1, int(np.isfinite(table).sum())
    if table.ndim not in (2, 3) or 0 in table.shape or table.shape[1] != pieces or finite_numbers < table.size:
        raise SpecificationError(
            f"The coefficients of {pieces} pieces have the shape {table.shape}, {finite_numbers} of them finite.",
            f"They are finite numbers of the shape (degree + 1, {pieces}) or (degree + 1, {pieces}, dim).",
            do="Give the highest power first, a column for each piece.",
            shape=table.shape,
            pieces=pieces,
        )
    return as_path(PPoly(table, breaks), smoothness=smoothness, before=before, after=after)


def samples(times, points):
    """Ascending times (n,) and points (n, dim) of finite numbers, n >= 2."""
    times, points = as_numbers(times), as_numbers(points)
    right = times.ndim == 1 and points.ndim in (1, 2) and len(times) == len(points) > 1 and points.size
    if not right or not np.isfinite(times).all() or not np.isfinite(points).all():
        raise SpecificationError(
            f"The times have the shape {times.shape}, the points {points.shape}.",
            "There are at least two times, and one point for each: finite numbers.",
            do="Put points in rows, and their entries in columns.",
            times=times.shape,
            points=points.shape,
        )
    require_ascending("times", times)
    return times, points.reshape(len(times), -1)


def _class(k, least=0):
    return whole_of("smoothness", k, range(least, SMOOTHEST + 1))


def _ends(start, end):
    """Two points (dim,) of the same size, from numbers or vectors."""
    start, end = vector("start", start), vector("end", end)
    if len(start) != len(end):
        raise SpecificationError(
            f"start has {len(start)} entries, end has {len(end)}.",
            "They are vectors of the same size.",
            do="Give both as many entries.",
            start=len(start),
            end=len(end),
        )
    return start, end


def _along(breaks, unit, start, end, k, corners=False):
    """The path from start to end along polynomials (n, size) from 0 to 1, of class k at its ends and corners (n + 1,).

    It is held outside; other breaks are cuts.
    """
    coefficients = unit[:, None] * (end - start)[:, None]
    coefficients[:, :, 0] += start
    classes = np.where(corners, float(k), np.full(len(breaks), np.inf))
    classes[[0, -1]] = k
    return Path(breaks, coefficients, classes, "hold", "hold")


def _stretched(edges, coefficients, first, last):
    """A polynomial on (0, 1), by edges (n + 1,) and coefficients (n, size), between two instants: breaks, coefficients.

    Where a cut is rounded in t, the parts beside it are expanded about their rounded ends, to first order.
    """
    breaks = first + (last - first) * edges
    breaks[-1] = last
    require_ascending("breaks", breaks)
    wide = breaks.astype(np.longdouble)
    moved = ((wide - wide[0]) - (wide[-1] - wide[0]) * edges).astype(float)
    low, high = moved[:-1] / np.diff(breaks), moved[1:] / np.diff(breaks)
    powers = np.arange(coefficients.shape[1])
    slopes = np.pad(coefficients[:, 1:] * powers[1:], ((0, 0), (0, 1)))
    return breaks, coefficients + (low + high)[:, None] * slopes + (high - low)[:, None] * coefficients * powers


@functools.lru_cache(maxsize=64)
def _unit_step(k):
    """The step from 0 to 1 of class k over (0, 1), with its cuts: edges (n + 1,), coefficients (n, size)."""
    return _cut_exactly(*_step_in_u(k))


@functools.lru_cache(maxsize=64)
def _unit_ramp(k):
    """The integral from 0 of the step of class k - 1, as of `_unit_step`."""
    numerators, denominator = _step_in_u(k - 1)
    multiple = math.lcm(*range(1, len(numerators) + 1))
    powers = [0, *(c * multiple // (j + 1) for j, c in enumerate(numerators))]
    powers[0] = -sum(c * (-1) ** j for j, c in enumerate(powers))
    return _cut_exactly(powers, 2 * denominator * multiple)


def _step_in_u(k):
    """The step of class k in the time u from -1 to 1, as of `hermite`."""
    numerators, denominator = hermite(k, 0)
    return [c * (-1) ** p for p, c in enumerate(numerators)], denominator


def hermite(k, j):
    """Whole numerators (2k + 2,) by powers of u, and their denominator, of one polynomial of Hermite.

    Of its Taylor coefficients 0 to k at -1 and at 1 all vanish but number j at -1, which is 1. It is
    (1 + u)^j r^(k + 1) sum_(i=0..k-j) binomial(k + i, i) l^i with l = (1 + u)/2 and r = (1 - u)/2.
    """
    powers = [0] * (2 * k + 2)
    for i, b in itertools.product(range(k + 1 - j), range(k + 2)):
        factor = (-1) ** b * 2 ** (k - j - i) * math.comb(k + i, i) * math.comb(k + 1, b)
        for a in range(i + j + 1):
            powers[a + b] += factor * math.comb(i + j, a)
    return powers, 2 ** (2 * k + 1 - j)


def _cut_exactly(numerators, denominator):
    """The polynomial in u with rational coefficients on (0, 1), expanded in parts: edges, coefficients (n, size).

    Each is computed in whole numbers and rounded once.
    """
    n, unit = len(numerators) - 1, 2 ** (HALVINGS + 1)  # of u at middles of parts

    def part(low, high):
        middle, half = int((low + high - 1) * unit), int((high - low) * unit)
        row = [c * unit ** (n - j) for j, c in enumerate(numerators)]
        for i in range(n):
            for j in reversed(range(i, n)):
                row[j] += middle * row[j + 1]
        return [c * half**k / (denominator * unit**n) for k, c in enumerate(row)]

    def expand(low, high):
        return np.array([part(*ends) for ends in zip(low.tolist(), high.tolist(), strict=True)])[:, None]

    edges, coefficients, _ = cut(np.array([0.0, 1.0]), expand)
    return edges, coefficients[:, 0]
