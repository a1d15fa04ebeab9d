"""Paths near functions and measurements."""

import functools
import math

import numpy as np

from servoctl.checks import MOST_JETS, as_numbers, as_span, positive, positives, whole_of
from servoctl.errors import SpecificationError
from servoctl.spec.paths.makers import samples
from servoctl.spec.paths.scipy_paths import as_path
from servoctl.spec.paths.value import SAME, Path, counted, stacked

MOST_PIECES = 10000  # of a fit to a function: more are needed only where derivatives do not fit their values
DEFECT = 1e-6  # of the change of a derivative: if the next one integrates to it up to this, rounding limits the fit
FITPACK = 5  # the highest degree of its splines
ROUNDED = 1.01  # of a tolerance: FITPACK reaches the sum of squares to 1e-3
PER_PIECE = 8  # samples at which the largest derivatives of a fit are taken
BOOLE = np.array([7.0, 32.0, 12.0, 32.0, 7.0]) / 90  # weights of a quadrature of degree 5 by five equidistant points


def function(f, span, smoothness=4, tolerance=1e-9, *, before=None, after=None):
    """The path of a function that is known with its derivatives, by polynomials that have these at both ends.

    Two-point Hermite polynomials of degree 2k + 1, k = `smoothness`. Pieces are halved until values and derivatives
    up to order k are right at three points in between. What is printed says how far they are off.

    Parameters
    ----------
    f : callable
        f(t) returns the jets at an instant [s]: value and derivatives up to order k or more, (k + 1,) or
        (k + 1, dim); for k = 0 a value alone is taken, too.
    span : (float, float)
        Ascending instants [s] between which the path is known.
    smoothness : int, optional
        Class k of the path, 0 to 40.
    tolerance : float, optional
        Largest error of each derivative, relative to its largest value; 1e-9 is what rounding lets class 4 reach.
    before, after : {"hold", "continue", "periodic"}, optional
        What the path does outside, as the attributes of `Path` say.

    Returns
    -------
    Path

    Raises
    ------
    SpecificationError
        If f returns other shapes or numbers that are not finite, the derivatives do not fit the values, by the defect,
        or rounding keeps the fit from the tolerance.
    """
    k, tolerance = whole_of("smoothness", smoothness, range(MOST_JETS + 1)), positive("tolerance", tolerance)
    edges, told, best = np.array(as_span(span, forward=True)), {}, math.inf

    def jets(t):
        told.update((x, _jets_of(f, x, k)) for x in t.tolist() if x not in told)
        return np.stack([told[x] for x in t.tolist()], axis=2)

    while True:
        path = _hermite_path(edges, jets(edges), before, after)
        between = np.concatenate([edges[:-1] + part * np.diff(edges) for part in (0.25, 0.5, 0.75)])
        error = np.abs(path.jets(between, k) - jets(between))
        size = np.abs(np.stack(list(told.values()))).max(axis=0)[:, :, None]
        errors = np.divide(error, size, out=error, where=size > 0).max(axis=(0, 1)).reshape(3, -1).max(axis=0)
        best, high = min(best, errors.max()), errors > tolerance
        if not high.any():
            said = f"fitted to a function: derivatives up to order {k} within {best:.1e} of their largest values"
            return path._with(remark=said)
        if len(edges) + high.sum() > MOST_PIECES or np.diff(edges)[high].min() < SAME * np.abs(edges).max():
            _refuse(jets, edges[errors.argmax() :][:2], best)
        edges = np.insert(edges, np.flatnonzero(high) + 1, ((edges[:-1] + edges[1:]) / 2)[high])


def _hermite_path(edges, jets, before, after):
    """The path through jets (k + 1, dim, n + 1) at the ends of its pieces."""
    k = len(jets) - 1
    half = np.diff(edges) / 2
    taylor = np.stack([jets[j, :, :] / math.factorial(j) for j in range(k + 1)])
    low, high = (taylor[:, :, side] * half ** np.arange(k + 1)[:, None, None] for side in (slice(-1), slice(1, None)))
    origin = low[0].copy()
    low[0], high[0] = 0.0, high[0] - origin
    coefficients = np.einsum("pj,jdn->ndp", _hermite(k), np.concatenate([low, high]))
    coefficients[:, :, 0] += origin.T
    classes = counted(edges, coefficients, before, after)
    classes[1:-1] = k
    classes[np.isfinite(classes)] = classes[np.isfinite(classes)].clip(None, k)  # as many as the function told
    return Path(edges, coefficients, classes, before, after)


@functools.lru_cache(maxsize=64)
def _hermite(k):
    """Powers 0 .. 2k + 1 (rows) of the polynomial that has Taylor coefficients 0 .. k at -1, then at 1 (columns).

    That of coefficient j at -1 is (1 + x)^j r^(k + 1) sum_(i=0..k-j) binomial(k + i, i) l^i with l = (1 + x)/2 and
    r = (1 - x)/2, in whole numbers that are rounded once; those at 1 are its mirror images.
    """
    columns = []
    for j in range(k + 1):
        terms = [math.comb(k + i, i) * 2 ** (k - j - i) for i in range(k + 1 - j)]
        powers = [
            sum(
                term * math.comb(i + j, a) * math.comb(k + 1, p - a) * (-1) ** (p - a)
                for i, term in enumerate(terms)
                for a in range(min(i + j, p) + 1)
            )
            for p in range(2 * k + 2)
        ]
        columns.append([power / 2 ** (2 * k + 1 - j) for power in powers])
    left = np.array(columns).T
    signs = (-1.0) ** np.arange(2 * k + 2)
    return np.concatenate([left, left * signs[:, None] * signs[: k + 1]], axis=1)


def _jets_of(f, t, k):
    """The jets (k + 1, dim) that a function returns at an instant."""
    returned = f(t)
    jets = as_numbers(returned)
    jets = jets[None] if k == 0 and jets.ndim == 1 and len(jets) > 1 or jets.ndim == 0 else jets
    jets = jets.reshape(len(jets), -1)[: k + 1] if jets.ndim in (1, 2) else jets
    if jets.ndim != 2 or len(jets) <= k or not jets.size or not np.isfinite(jets).all():
        raise SpecificationError(
            f"The function returns {repr(returned)[:150]} at t = {t:g} s.",
            f"For smoothness {k} it returns finite numbers: the value and {k} derivatives, ({k + 1}[, dim]).",
            do="Return value and derivatives in this order; without derivatives, use sv.paths.fit on samples.",
            t=t,
            smoothness=k,
        )
    return jets


def _refuse(jets, ends, best):
    """Say which derivative of a function does not fit the one below between two instants, or what rounding allows."""
    told, length = jets(np.linspace(*ends, 5)), ends[1] - ends[0]
    miss = np.abs(told[:-1, :, -1] - told[:-1, :, 0] - length * (told[1:] @ BOOLE))
    sizes = length * np.abs(told[1:]).max(axis=2)
    defects = np.divide(miss, sizes, out=np.zeros_like(miss), where=sizes > 0).max(axis=1, initial=0.0)
    order = int((defects >= defects.max(initial=0.0) / 2).argmax()) if len(defects) else 0  # the first that is wrong
    if not len(defects) or defects[order] <= DEFECT:
        raise SpecificationError(
            f"The fit to the function is off by {best:.1e} of the largest value of a derivative.",
            f"Halving ends at {MOST_PIECES} pieces, and rounding of the values grows in derivatives on the way.",
            f"tolerance={2 * best:.1g}.",
            "Or give a lower smoothness.",
            error=float(best),
            t=float(ends[0]),
        )
    raise SpecificationError(
        f"The function's derivative {order + 1} does not fit its derivative {order} between t = {ends[0]:.9g} and "
        f"{ends[1]:.9g} s: its integral differs from the change by {defects[order]:.1e} of it.",
        f"Each derivative is that of the one before, and continuous; the fit is off by {best:.1e}.",
        do="Correct the derivatives, or ask for a lower smoothness.",
        order=order + 1,
        defect=float(defects[order]),
        t=float(ends[0]),
    )


def fit(t, x, smoothness=4, *, tolerance):
    """The spline of class C^k with the fewest knots that passes near noisy samples.

    For k up to 4 by FITPACK, whose splines end at degree 5; beyond, by least squares on the knots of that of degree 5,
    which are halved where they do not suffice. What is printed has the largest value of each derivative up to k: see
    whether the machine can follow it.

    Parameters
    ----------
    t : (n,) array
        Ascending [s].
    x : (n,) or (n, dim) array
        Samples, SI.
    smoothness : int, optional
        Class k >= 0; the degree is k + 1.
    tolerance : float or (dim,) array
        The root mean square by which the path passes beside the samples: the noise, SI, positive.

    Returns
    -------
    Path
        From the first to the last instant.

    Raises
    ------
    SpecificationError
        If times do not ascend, shapes disagree, a number is not finite, a tolerance is not positive, or the samples
        are too few.
    """
    k = whole_of("smoothness", smoothness, range(MOST_JETS + 1))
    t, x = samples(t, x)
    degree = k + 1 + k % 2
    tolerances = np.broadcast_to(positives("tolerance", tolerance, "Give the noise of the samples."), x.shape[1:])
    if len(t) <= degree:
        given, rule = f"There are {len(t)} samples.", f"A spline of degree {degree} needs at least {degree + 1}."
        raise SpecificationError(given, rule, do="Give more samples, or a lower smoothness.", samples=len(t))
    curves = [_near(t, column, degree, most) for column, most in zip(x.T, tolerances, strict=True)]
    path = stacked(*(as_path(curve) for curve in curves))
    parts = path.breaks[:-1, None] + np.diff(path.breaks)[:, None] * np.linspace(0.0, 1.0, PER_PIECE)
    largest = np.abs(path.jets(parts.ravel(), k)).max(axis=(1, 2))
    missed = np.sqrt(((path.jets(t, 0)[0].T - x) ** 2).mean(axis=0)).max()
    said = ", ".join(f"{value:.3g}" for value in largest)
    knots = len(path.breaks) - 2
    return path._with(remark=f"{knots} knots, {missed:.2g} beside the samples; largest derivatives 0 to {k}: {said}")


def _near(t, x, degree, tolerance):
    """SciPy's spline of a degree through one column of samples, as near as is asked for."""
    from scipy.interpolate import BSpline, make_lsq_spline, splrep

    (knots, c, k), *_ = splrep(t, x, k=min(degree, FITPACK), s=len(t) * tolerance**2, full_output=1)
    curve, inner = BSpline(knots, c, k), knots[k + 1 : -k - 1]
    missed = np.sqrt(np.mean((curve(t) - x) ** 2))
    if degree > FITPACK:
        curve, missed = None, np.inf
        while missed > ROUNDED * tolerance and len(inner) + degree < len(t):
            edges = np.concatenate([[t[0]], inner, [t[-1]]])
            try:
                curve = make_lsq_spline(t, x, np.concatenate([[t[0]] * degree, edges, [t[-1]] * degree]), degree)
            except (ValueError, np.linalg.LinAlgError):  # too few samples between knots
                break
            missed = np.sqrt(np.mean((curve(t) - x) ** 2))
            inner = np.sort(np.append(inner, (edges[:-1] + edges[1:]) / 2))
    if not missed <= ROUNDED * tolerance:
        raise SpecificationError(
            f"A spline of degree {degree} with as many knots as {len(t)} samples allow is {missed:.2g} beside them.",
            f"It is to pass within tolerance={tolerance:g}, in root mean square.",
            do="Give a greater tolerance, a lower smoothness, or samples at even distances.",
            missed=float(missed),
            tolerance=float(tolerance),
        )
    return curve
