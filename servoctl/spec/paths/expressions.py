"""Target trajectories: CasADi expressions of a time, or of a time law, for the residuals of a program.

Geometry and timing are separate. Every function takes as its first argument either the time symbol `q.t` or
another scalar path, the *time law*::

    s = rest_to_rest(q.t, 0.0, 1.0, duration=6.0, smoothness=4)       # when: from 0 to 1 in 6 s
    path = circle(2 * ca.pi * s, centre=(0.0, 1.0), radius=0.5)       # where: one turn

Pieces are joined by `fmin`, `fmax` and comparisons of the time alone, so that derivatives of any order are right on
either side of a knot. A path of class C^k has k continuous derivatives; the docstrings state k for smooth first
arguments. A path along a time law has the lower of both classes.
"""

import functools
import math

import casadi as ca
import numpy as np

from servoctl.checks import as_numbers, column, named, whole_of
from servoctl.errors import SpecificationError
from servoctl.jets.lookup import columns_at
from servoctl.spec.curves import _positive, _same_size, _scalar, line

TIMED_BY_SYMBOLS = 6  # class of a spline whose times are expressions, beyond which they lose 1e-6 to rounding
MOST_DENSE = 8  # points of a spline that are expressions, beyond which its coefficients are solved for
MOST_SUMMED = 200  # times of a spline, beyond which its coefficients are a table: each in sums takes 10 ms to derive
SMOOTHEST = 100  # class of a path, beyond which the terms of its polynomials leave the range of a double
MISSED = 1e-9  # largest distance of a spline from its points, relative to the largest point


def rest_to_rest(t, start, end, duration, smoothness=4, t_start=0.0):
    """Move from rest to rest along the polynomial of degree 2k + 1 whose first k derivatives vanish at both ends.

    Of class C^k, k = `smoothness`. With sigma = (t - t_start)/duration clipped to [0, 1], the path is
    start + (end - start) S(sigma), where S(sigma) = I_sigma(k + 1, k + 1) is the regularised incomplete beta
    function (for k = 4 and 6 the polynomials S9 and S13), written as
    S = 1/2 + (sigma - 1/2) sum_(j=0..k) binomial(2j, j) (sigma (1 - sigma))^j,
    which has no large terms of opposite sign: for k up to 20 the value and its derivatives are exact to 1e-14 of
    their largest magnitude, alike at both ends. It minimises the integral of the square of derivative k + 1.

    Parameters
    ----------
    t : SX or float
        Time [s], or a time law.
    start, end : float, SX, or sequence (n,) of them
        The path before `t_start` and after `t_start + duration`.
    duration : float or SX
        Time taken [s], positive.
    smoothness : int, optional
        Class k >= 0 of the path. A crane, or two cars and a spring, need 4.
    t_start : float or SX, optional
        Time of departure [s].

    Returns
    -------
    SX
        Scalar, or (n, 1) column.

    Raises
    ------
    SpecificationError
        If start and end differ in size, the duration is not positive, the smoothness is no integer >= 0,
        or a number is not finite.
    """
    t, t_start = _scalar(t, "t"), _scalar(t_start, "t_start")
    sigma = ca.fmin(ca.fmax((t - t_start) / _positive(duration, "duration"), 0), 1)
    return line(_smooth_step(sigma, _smoothness(smoothness)), start, end)


def trapezoid(t, distance, duration, ramp, smoothness=4, t_start=0.0):
    """Cover a distance at a constant speed that is reached, and left, along smooth ramps: a time law.

    Of class C^k, k = `smoothness`: during the first and last `ramp` seconds the speed rises and falls along
    the polynomial of `rest_to_rest` of class k - 1. The cruising speed is distance/(duration - ramp). Starts at
    0 and holds `distance` afterwards.

    Parameters
    ----------
    t : SX or float
        Time [s], or a time law.
    distance : float or SX
        Where the law ends: an arc length [m], an angle [rad], or 1 for a line.
    duration : float or SX
        Time taken [s], positive.
    ramp : float or SX
        Length of each ramp [s], positive, at most half the duration.
    smoothness : int, optional
        Class k >= 1 of the law.
    t_start : float or SX, optional
        Time of departure [s].

    Returns
    -------
    SX
        Scalar.

    Raises
    ------
    SpecificationError
        If duration or ramp is not positive, the ramps do not fit in the duration, the smoothness is no
        integer >= 1, or a number is not finite.
    """
    t, t_start, distance = _scalar(t, "t"), _scalar(t_start, "t_start"), _scalar(distance, "distance")
    duration, ramp = _positive(duration, "duration"), _positive(ramp, "ramp")
    k = _smoothness(smoothness, least=1)
    if (2 * ramp > duration).is_one():
        raise SpecificationError(
            f"Two ramps of {ramp} s do not fit in a duration of {duration} s.",
            "A trapezoid speeds up, cruises and slows down within its duration.",
            f"A ramp of {float(duration) / 2:g} s.",
            "Shorten the ramp or lengthen the duration.",
            ramp=float(ramp),
            duration=float(duration),
        )
    t_end = t_start + duration
    t = ca.fmin(t, t_end)
    begun = ca.fmax(t - t_start, 0) / ramp
    ending = ca.fmax(t - (t_end - ramp), 0) / ramp
    rising = ca.fmin(begun, 1)
    ramps_covered = _integral_of_step(rising, k - 1) + (begun - rising) - _integral_of_step(ending, k - 1)
    return distance / (duration - ramp) * ramp * ramps_covered


def spline(t, times, points, smoothness=2, ends="rest"):
    """Pass through via points at given times along a spline.

    With `ends="rest"` the spline has degree 2k + 1, k = `smoothness`, and its first k derivatives vanish at both
    ends, which it holds before the first and after the last time: of class C^k everywhere (C^2k at the via
    points between). It minimises the integral of the square of derivative k + 1; two points give `rest_to_rest`.
    With `ends="natural"` it has the least odd degree 2m + 1 > k, is of class C^2m >= C^k everywhere, its
    derivatives m + 1 to 2m vanish at both ends, and its first and last polynomials go on outside: for geometry
    along a time law, or a plan that starts in motion.

    A high smoothness over very uneven times overshoots between the points: choose times in proportion to
    the distances between them. Times that are expressions of parameters allow a smoothness up to 6.

    Through more than 200 points, with numbers as times and points, the coefficients are a table, so that samples of a
    measurement may be as many as memory holds. Each point that is an expression costs about 30 operations at every
    evaluation. Derivatives amplify the rounding and noise of samples: an error e of samples at a distance h becomes one
    of about e (pi/h)^k in derivative k, where e is 1e-16 of their size at least.

    Parameters
    ----------
    t : SX or float
        Time [s], or a time law.
    times : (n,) array, SX or sequence of SX
        Strictly increasing times [s] (values of the time law), n >= 2; expressions of parameters where these increase.
    points : (n,) or (n, dim) array, SX or nested sequences of SX
        The via points, SI; numbers or expressions of parameters.
    smoothness : int, optional
        Class k >= 0 of the path.
    ends : {"rest", "natural"}, optional
        What happens at the ends.

    Returns
    -------
    SX
        Scalar, or (dim, 1) column.

    Raises
    ------
    SpecificationError
        If times do not increase strictly, shapes disagree, a number is not finite, the smoothness is no
        integer >= 0, or the points are too few or too unevenly timed for it.
    NameUnknown
        If `ends` is neither "rest" nor "natural".
    """
    named(ends, ("rest", "natural"), "spline end")
    t, k = _scalar(t, "t"), _smoothness(smoothness)
    times, points = _via_points(times, points)
    for what, entries in (("times", times), ("points", points)):
        if t.is_symbolic() and isinstance(entries, ca.SX) and ca.depends_on(entries, t):
            raise SpecificationError(
                f"The spline's {what} contain {t}.",
                "A spline is a polynomial of its first argument between constant times.",
                do="Use parameters (sv.parameters), or line and rest_to_rest for ends that move.",
                what=what,
            )
    if isinstance(times, ca.SX):
        k = _smoothness(k, most=TIMED_BY_SYMBOLS)
    m = k if ends == "rest" else (k + 1) // 2
    vanishing = range(1, m + 1) if ends == "rest" else range(m + 1, 2 * m + 1)
    count = points.shape[0]
    if ends == "natural" and count <= m:
        raise SpecificationError(
            f"A natural spline of smoothness {k} has {count} points.",
            f"Its degree is {2 * m + 1}, which needs at least {m + 1} points.",
            f"smoothness={2 * (count - 1)}.",
            "Use more points, a lower smoothness, or ends='rest'.",
            points=count,
            smoothness=k,
        )
    if ends == "rest":
        t = ca.fmin(ca.fmax(t, times[0]), times[-1])
    if isinstance(times, ca.SX):
        pieces, times = _symbolic_pieces(times, points, m, ends), times.elements()
    elif isinstance(points, ca.SX) and count > MOST_DENSE:
        return _by_coefficients(t, times, points, 2 * m + 1, vanishing)
    elif isinstance(points, ca.SX):
        each = _spline_pieces(times, np.eye(count), 2 * m + 1, vanishing)  # of a point alone: the spline is linear
        pieces = [ca.DM(power) @ points for power in each]
    else:
        pieces = _spline_pieces(times, points, 2 * m + 1, vanishing)
    return piecewise(t, times, pieces)


def piecewise(t, times, coefficients):
    """Polynomials of time, piece after piece; the first and the last go on outside.

    Parameters
    ----------
    t : SX or float
        Time [s], or a time law.
    times : (n,) array or list of SX
        Strictly increasing ends of the pieces [s].
    coefficients : (degree + 1, n - 1, dim) array, or sequence of (n - 1, dim) SX
        Of the powers 0, 1, ... of a time that goes from -1 to 1 on each piece, SI.

    Returns
    -------
    SX
        Scalar, or (dim, 1) column.
    """
    if isinstance(times, np.ndarray) and isinstance(coefficients, np.ndarray) and len(times) > MOST_SUMMED:
        return _looked_up(t, times, coefficients)
    inside = _inside(t, times)
    times = times if isinstance(times, np.ndarray) else ca.vertcat(*times)
    middle, half = (times[:-1] + times[1:]) / 2, (times[1:] - times[:-1]) / 2
    tau = (t - ca.dot(inside, middle)) * ca.dot(inside, 1 / half)
    value = ca.SX(coefficients[0].shape[1], 1)
    for power in coefficients[::-1]:
        value = value * tau + ca.mtimes(power.T if isinstance(power, ca.SX) else ca.DM(power.T), inside)
    return value


def _inside(t, times):
    """Whether t lies in each piece, (n - 1, 1) SX of ones and zeros; the first and the last go on outside."""
    begun = ca.vertcat(1, *(t >= knot for knot in times[1:-1]), 0)
    return begun[:-1] - begun[1:]


def _looked_up(t, times, coefficients):
    """The value of `piecewise`, whose coefficients are taken from a table."""
    middle, half, dim = (times[:-1] + times[1:]) / 2, (times[1:] - times[:-1]) / 2, coefficients.shape[2]
    rows = np.column_stack([middle, 1 / half, *coefficients])
    centre, per_half, *entries = columns_at(t, times[1:-1], rows)
    tau, value = (t - centre) * per_half, ca.SX(dim, 1)
    for k in range(len(entries) - dim, -1, -dim):
        value = value * tau + ca.vertcat(*entries[k : k + dim])
    return value


def _by_coefficients(t, times, points, degree, vanishing):
    """The value of a spline through expressions, from the degree + 1 of its coefficients c that count on a piece.

    A c = points, where A has a band: operations are in proportion to the number of points, not to its square.
    """
    factors, parts, shapes = _basis(times, degree, vanishing)
    right = ca.vertcat(points, ca.SX(factors.shape[0] - len(times), points.shape[1]))
    lower, upper = map(ca.SX, parts)
    c = ca.solve(upper, ca.solve(lower, right[np.argsort(factors.perm_r).tolist(), :]))[factors.perm_c.tolist(), :]
    inside, pieces = _inside(t, times).T, len(times) - 1
    local = [ca.mtimes(inside, c[r : r + pieces, :]) for r in range(degree + 1)]
    return ca.mtimes(ca.vertcat(*local).T, _looked_up(t, times, shapes))


def _basis(times, degree, vanishing):
    """The factors of A by SciPy, their matrices (L, U), and the basis on each piece, (degree + 1, n - 1, degree + 1).

    The basis has powers of a time from -1 to 1. The rows of A give the points, and the derivatives at both ends that
    vanish.
    """
    from scipy.interpolate import BSpline
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import splu

    x, middle, half = _by_intervals(times)
    knots = np.concatenate([[x[0]] * degree, x, [x[-1]] * degree])
    basis = BSpline(knots, np.eye(len(x) + degree - 1), degree)
    ends = [basis(end, nu=order)[None] for end in (x[0], x[-1]) for order in vanishing]
    try:
        factors = splu(csc_matrix(np.concatenate([basis(x), *ends])), permc_spec="NATURAL")
    except RuntimeError:  # singular for very uneven intervals
        _require_passing(np.full((degree + 1, len(half), 1), np.nan), x[:, None], half)
    own = np.arange(len(half))[:, None] + np.arange(degree + 1)
    taylor = [np.take_along_axis(basis(middle, nu=k), own, axis=1) / math.factorial(k) for k in range(degree + 1)]
    shapes = np.array([c * half[:, None] ** k for k, c in enumerate(taylor)])
    for points in ((-1.0) ** np.arange(len(x)), x):
        c = factors.solve(np.append(points, np.zeros(len(ends))))
        _require_passing((shapes * c[own]).sum(axis=2, keepdims=True), points[:, None], half)
    return factors, [ca.DM(csc_matrix(part).sorted_indices()) for part in (factors.L, factors.U)], shapes


def _smooth_step(sigma, k):
    """Regularised incomplete beta function I_sigma(k + 1, k + 1): 0 to 1, k derivatives zero at both ends."""
    binomials = ca.SX([math.comb(2 * j, j) for j in range(k, -1, -1)])
    return 0.5 + (sigma - 0.5) * ca.polyval(binomials, sigma * (1 - sigma))


def _integral_of_step(sigma, k):
    """Integral of `_smooth_step` from 0 to sigma: (sigma - sum_(j=0..k) Catalan_j (sigma (1 - sigma))^(j+1))/2."""
    catalan = ca.SX([math.comb(2 * j, j) // (j + 1) for j in range(k, -1, -1)] + [0])
    return (sigma - ca.polyval(catalan, sigma * (1 - sigma))) / 2


def _spline_pieces(times, points, degree, vanishing):
    """Coefficients (degree + 1, n - 1, dim) of the spline's polynomials, each in a time from -1 to 1 on its piece.

    Expanded about the middle of its piece a polynomial has coefficients of the size of its values.
    """
    from scipy.interpolate import make_interp_spline

    x, middle, half = _by_intervals(times)
    conditions = [(order, np.zeros(points.shape[1])) for order in vanishing]
    try:
        curve = make_interp_spline(x, points, k=degree, bc_type=(conditions, conditions) if conditions else None)
        taylor = [curve(middle, nu=order) / math.factorial(order) for order in range(degree + 1)]
    except (ValueError, np.linalg.LinAlgError):  # SciPy's equations are singular for very uneven intervals
        taylor = [np.full((len(half), points.shape[1]), np.nan)] * (degree + 1)
    pieces = np.array([c * half[:, None] ** order for order, c in enumerate(taylor)])
    _require_passing(pieces, points, half)
    return pieces


def _by_intervals(times):
    """Times (n,) in the unit of the mean interval, from 0 on, the middles of the intervals and half their lengths."""
    x = (times - times[0]) / (times[-1] - times[0]) * (len(times) - 1)
    return x, (x[:-1] + x[1:]) / 2, (x[1:] - x[:-1]) / 2


def _require_passing(pieces, points, half):
    """Refuse pieces as of `_spline_pieces` that miss their points (n, dim)."""
    degree, starts, stops = len(pieces) - 1, pieces[::2].sum(axis=0) - pieces[1::2].sum(axis=0), pieces.sum(axis=0)
    miss = max(np.abs(starts - points[:-1]).max(), np.abs(stops - points[1:]).max())
    if not miss <= MISSED * np.abs(points).max():
        ratio = half.max() / half.min()
        raise SpecificationError(
            f"The spline of degree {degree} misses its points by {miss:.1e}; its longest interval is {ratio:.3g} times "
            "its shortest.",
            f"A spline passes through its points to within {MISSED:g} of the largest.",
            do="Choose intervals in proportion to the distances between the points, or a lower smoothness.",
            degree=degree,
            miss=miss,
            ratio=ratio,
        )


@functools.cache
def _from_ends(m):
    """Polynomials of degree 2m + 1 on (-1, 1) by their Taylor coefficients 0 .. m at -1, then at 1.

    Returns the powers 0 .. 2m + 1 (rows) of each, and the integrals of products of their derivatives m + 1, those of
    degree 2m by Gauss. That of coefficient j at -1 is (1 + x)^j r^(m + 1) sum_(k=0..m-j) binomial(m + k, k) l^k with
    l = (1 + x)/2 and r = (1 - x)/2; those at 1 are its mirror images.
    """
    x = np.polynomial.Polynomial([0.0, 1.0])
    left, right = (1 + x) / 2, (1 - x) / 2
    basis = []
    for j in range(m + 1):
        series = sum(math.comb(m + k, k) * left**k for k in range(m + 1 - j))
        basis.append((1 + x) ** j * right ** (m + 1) * series)
    basis += [(-1) ** j * polynomial(-x) for j, polynomial in enumerate(basis)]
    nodes, weights = np.polynomial.legendre.leggauss(m + 1)
    slopes = np.array([polynomial.deriv(m + 1)(nodes) for polynomial in basis])
    energy = slopes * weights @ slopes.T
    return np.column_stack([polynomial.coef for polynomial in basis]), energy / energy[0, 0]


def _symbolic_pieces(times, points, m, ends):
    """Coefficients as of `_spline_pieces`, a list of (n - 1, dim) SX, of a spline whose times are expressions.

    It has the least integral of the square of derivative m + 1 over its Taylor coefficients 1 .. m at the points; those
    at the ends are zero for "rest". The unit of time is the mean of half an interval.
    """
    n, (powers, energy) = points.shape[0], _from_ends(m)
    half = (times[1:] - times[:-1]) / (times[-1] - times[0]) * (n - 1)
    scales = [ca.diag(ca.vertcat(*([h**j for j in range(m + 1)] * 2))) for h in half.elements()]
    total = ca.SX(n * (m + 1), n * (m + 1))
    for i, scale in enumerate(scales):
        part = slice(i * (m + 1), (i + 2) * (m + 1))
        total[part, part] += scale @ ca.DM(energy) @ scale / half[i] ** (2 * m + 1)
    fixed = [k * (m + 1) for k in range(n)]
    inner = range(1, n - 1) if ends == "rest" else range(n)
    free = [k * (m + 1) + j for k in inner for j in range(1, m + 1)]
    values = ca.SX(n * (m + 1), points.shape[1])
    values[fixed, :] = points
    if free:
        values[free, :] = ca.ldl_solve(-total[free, fixed] @ points, *ca.ldl(ca.sparsify(total[free, free])))
    parts = [values[i * (m + 1) : (i + 2) * (m + 1), :] for i in range(n - 1)]
    pieces = [ca.DM(powers) @ scale @ part for scale, part in zip(scales, parts, strict=True)]
    return [ca.vertcat(*(piece[power, :] for piece in pieces)) for power in range(2 * m + 2)]


def _via_points(times, points):
    """The times (n,) and points (n, dim) of a spline: arrays of numbers, or SX where they contain symbols."""
    times, points = _entries(times, "times"), _entries(points, "points")
    finite = all(isinstance(e, ca.SX) or np.isfinite(e).all() for e in (times, points))
    shapes = [e.shape[:1] if isinstance(e, ca.SX) and e.shape[1] == 1 else e.shape for e in (times, points)]
    fit = len(shapes[0]) == 1 and len(shapes[1]) in (1, 2) and shapes[0][0] == shapes[1][0] >= 2
    if not finite or not fit or 0 in shapes[1]:
        raise SpecificationError(
            f"The spline's times have the shape {shapes[0]}, its points {shapes[1]}.",
            "There are at least two times, and one point for each: finite numbers or expressions.",
            do="Put points in rows, and their entries in columns.",
            times=shapes[0],
            points=shapes[1],
        )
    _require_rising(times)
    if isinstance(points, ca.SX) or isinstance(times, ca.SX):
        points = ca.reshape(ca.SX(points), shapes[0][0], -1) if isinstance(points, ca.SX) else ca.SX(ca.DM(points))
        return times, points
    return times, points.reshape(len(times), -1)


def _entries(value, what):
    """An array of numbers, or an SX matrix of a value that contains symbols, a row for each of its entries."""
    rows = [value[i, :] for i in range(value.shape[0])] if isinstance(value, ca.SX) else value
    if isinstance(rows, (list, tuple)) and any(ca.symvar(e) for row in rows for e in _parts(row)):
        columns = [ca.horzcat(*column(row, f"entry {i} of the {what}")) for i, row in enumerate(rows)]
        _same_size(**{f"{what}[{i}]": c for i, c in enumerate(columns)})
        return ca.vertcat(*columns)
    return as_numbers(np.array(ca.DM(value)) if isinstance(value, ca.SX) else value)


def _parts(row):
    """The SX among the entries of a row."""
    return [e for e in (row if isinstance(row, (list, tuple)) else [row]) if isinstance(e, ca.SX)]


def _require_rising(times):
    """Refuse times that do not increase strictly, where they are numbers."""
    if isinstance(times, np.ndarray):
        falling = np.flatnonzero(np.diff(times) <= 0)[:1].tolist()
    else:
        steps = (times[1:] - times[:-1]).elements()
        falling = [i for i, step in enumerate(steps) if step.is_constant() and float(step) <= 0]
    for i in falling:
        t = [str(times[j]) if isinstance(times, ca.SX) else f"{times[j]:g}" for j in (i, i + 1)]
        raise SpecificationError(
            f"The spline's times {i} and {i + 1} are {t[0]} and {t[1]}.",
            "Times increase strictly.",
            do="Sort the points by time and remove repeated times.",
            index=i + 1,
        )


def _smoothness(k, least=0, most=SMOOTHEST):
    """The k of a class C^k as an int."""
    return whole_of("smoothness", k, range(least, most + 1))
