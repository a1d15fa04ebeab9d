"""Paths near functions and measurements."""

import functools
import math
from collections.abc import Callable

import numpy as np

from servoctl.checks import MOST_JETS, array_of, as_numbers, as_span, positive, positives, require_kind, whole_of
from servoctl.errors import SpecificationError
from servoctl.spec.paths.makers import hermite, samples
from servoctl.spec.paths.scipy_paths import as_path
from servoctl.spec.paths.value import SAME, Path, counted, stacked

FINEST = 10000  # pieces of a fit to a function: more are needed only where derivatives do not fit their values
UNFIT = 1e-6  # of what a derivative changes by, up to which the integral of the next one is the same, but for rounding
FITPACK = 5  # the highest degree of its splines
BOOLE = np.array([7.0, 32.0, 12.0, 32.0, 7.0]) / 90  # weights of a quadrature by five equidistant points


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
    require_kind(Callable, "f", f, "def f(t): return value, derivative, ...")
    return fitted(f, np.array(as_span(span, forward=True)), k, tolerance, before, after)


def fitted(f, edges, k, tolerance, before, after):
    """As `function`, on pieces that are halved from given ones on, whose ends (n + 1,) ascend."""
    told, best = {}, math.inf

    def jets(t):
        told.update((x, _jets_of(f, x, k)) for x in t.tolist() if x not in told)
        return np.stack([told[x] for x in t.tolist()], axis=2)

    while True:
        path = through_jets(edges, jets(edges), before, after)
        between = np.concatenate([edges[:-1] + part * np.diff(edges) for part in (0.25, 0.5, 0.75)])
        error = np.abs(path.jets(between, k) - jets(between))
        size = np.abs(np.stack(list(told.values()))).max(axis=0)[:, :, None]
        errors = np.divide(error, size, out=error, where=size > 0).max(axis=(0, 1)).reshape(3, -1).max(axis=0)
        best, high = min(best, errors.max()), errors > tolerance
        if not high.any():
            said = f"fitted to a function: derivatives up to order {k} within {best:.1e} of their largest values"
            return path._with(remark=said)
        if len(edges) + high.sum() > FINEST or np.diff(edges)[high].min() < SAME * np.abs(edges).max():
            _refuse(jets, edges[errors.argmax() :][:2], best)
        edges = np.insert(edges, np.flatnonzero(high) + 1, ((edges[:-1] + edges[1:]) / 2)[high])


def through_jets(edges, jets, before, after):
    """The path through jets (k + 1, dim, n + 1) at the ends of its pieces."""
    k, origin = len(jets) - 1, jets[:1, :, :-1]
    powers, half = np.arange(k + 1)[:, None, None], np.diff(edges) / 2
    scale = half**powers / np.array([math.factorial(j) for j in range(k + 1)])[:, None, None]
    low, high = scale * jets[:, :, :-1], scale * jets[:, :, 1:]
    low[:1], high[:1] = 0.0, high[:1] - origin
    coefficients = np.einsum("pj,jdn->ndp", _from_both_ends(k), np.concatenate([low, high]))
    coefficients[:, :, 0] += origin[0].T
    classes = counted(edges, coefficients, before, after)
    classes[1:-1] = k
    return Path(edges, coefficients, np.where(np.isinf(classes), classes, np.minimum(classes, k)), before, after)


@functools.lru_cache(maxsize=64)
def _from_both_ends(k):
    """Powers 0 .. 2k + 1 (rows) of the polynomial that has Taylor coefficients 0 .. k at -1, then at 1 (columns)."""
    columns = [hermite(k, j) for j in range(k + 1)]
    left = np.array([[c / denominator for c in numerators] for numerators, denominator in columns]).T
    mirrored = (-1.0) ** np.add.outer(np.arange(2 * k + 2), np.arange(k + 1))
    return np.concatenate([left, left * mirrored], axis=1)


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
    if not len(defects) or defects[order] <= UNFIT:
        raise SpecificationError(
            f"The fit to the function is off by {best:.1e} of the largest value of a derivative.",
            f"Halving ends at {FINEST} pieces, and rounding of the values grows in derivatives on the way.",
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
    """The spline of class C^k with few knots that passes near noisy samples.

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
        Class k, 0 to 40; the degree is the least odd one above it.
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
    tolerances = np.ravel(positives("tolerance", tolerance, "Give the noise of the samples."))
    tolerances = array_of("tolerance", tolerances.repeat(x.shape[1] if len(tolerances) == 1 else 1), x.shape[1])
    if len(t) <= degree:
        raise SpecificationError(
            f"There are {len(t)} samples.",
            f"A spline of degree {degree} needs at least {degree + 1}.",
            do="Give more samples, or a lower smoothness.",
            samples=len(t),
        )
    curves = [_beside(t, column, degree, most) for column, most in zip(x.T, tolerances, strict=True)]
    path = stacked(*(as_path(curve) for curve in curves))
    parts = path.breaks[:-1, None] + np.diff(path.breaks)[:, None] * np.linspace(0.0, 1.0, 9)
    largest = ", ".join(f"{value:.3g}" for value in np.abs(path.jets(parts.ravel(), k)).max(axis=(1, 2)))
    missed = np.sqrt(((path.jets(t, 0)[0].T - x) ** 2).mean(axis=0)).max()
    said = f"{len(path.breaks) - 2} knots, {missed:.2g} beside the samples; largest derivatives 0 to {k}: {largest}"
    return path._with(remark=said)


def _beside(t, x, degree, tolerance):
    """SciPy's spline of a degree through one column of samples, as near as is asked for."""
    from scipy.interpolate import BSpline, make_lsq_spline, splrep

    squares = 0.99 * len(t) * tolerance**2  # FITPACK reaches them to 0.001
    curve = BSpline(*splrep(t, x, k=min(degree, FITPACK), s=squares, full_output=1)[0])
    inner = curve.t[curve.k + 1 : -curve.k - 1]
    while curve.k < degree or not np.mean((curve(t) - x) ** 2) <= tolerance**2:
        edges = np.concatenate([[t[0]], inner, [t[-1]]])
        knots = np.concatenate([[t[0]] * degree, edges, [t[-1]] * degree])
        try:
            curve = make_lsq_spline(t, x, knots, degree) if len(edges) + degree <= len(t) else None
        except (ValueError, np.linalg.LinAlgError):  # there are too few samples between knots
            curve = None
        if curve is None:
            raise SpecificationError(
                f"A spline of degree {degree} does not pass within tolerance={tolerance:g} of {len(t)} samples.",
                "It has fewer knots than samples, and some samples between any knots.",
                do="Give a greater tolerance, a lower smoothness, or samples at even distances.",
                tolerance=float(tolerance),
            )
        inner = np.sort(np.append(inner, (edges[:-1] + edges[1:]) / 2))
    return curve
