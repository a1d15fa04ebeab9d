"""Paths from what SciPy makes."""

import numpy as np

from servoctl.checks import whole_of, without_effect
from servoctl.errors import SpecificationError
from servoctl.spec.paths.value import SMOOTHEST, Path, counted, cut

MOST_COUNTED = 300  # pieces of bare polynomials: among more, rounding of high derivatives looks like their jumps


def as_path(thing, *, smoothness=None, before=None, after=None):
    """The path that a piecewise polynomial or a spline of SciPy is.

    It is evaluated about the middle of each piece, by its own method. The class at the breaks of a BSpline is its
    degree less the multiplicity of the knot; that of a CubicSpline is 2, of an Akima1DInterpolator, a
    PchipInterpolator and a CubicHermiteSpline 1. That of a PPoly or BPoly is counted from its coefficients.

    Parameters
    ----------
    thing : PPoly, BPoly, BSpline or Path
        Also what inherits from these, as CubicSpline does, and what make_interp_spline, make_lsq_spline and
        make_smoothing_spline return; of one or several columns.
    smoothness : int, optional
        The class at the breaks of a PPoly or BPoly, -1 for jumps; needed beyond 300 pieces.
    before, after : {"hold", "continue", "periodic"}, optional
        What the path does outside. By default it repeats if `extrapolate="periodic"` was asked for, and is held as
        far as its derivatives vanish else.

    Returns
    -------
    Path

    Raises
    ------
    SpecificationError
        If it is none of these, complex or not finite, if the smoothness is missing, or given where it is known.
    """
    if isinstance(thing, Path):
        options = {"smoothness": smoothness, "before": before, "after": after}
        without_effect([name for name, value in options.items() if value is not None], "for a Path, which has its own")
        return thing
    breaks, degree, known = _knots(thing)
    if known is not None:
        without_effect(["smoothness"] * (smoothness is not None), f"for a {type(thing).__name__}, whose class is known")
    elif smoothness is not None:
        known = whole_of("smoothness", smoothness, range(-1, SMOOTHEST + 1))
    elif len(breaks) - 1 > MOST_COUNTED:
        raise SpecificationError(
            f"A {type(thing).__name__} of {len(breaks) - 1} pieces was given without its smoothness.",
            f"The class is counted from coefficients for up to {MOST_COUNTED} pieces: among more, the rounding of high "
            "derivatives cannot be told from jumps.",
            do="Give smoothness=k for polynomials of class C^k, or the spline (BSpline, CubicSpline) that they are.",
            pieces=len(breaks) - 1,
            most=MOST_COUNTED,
        )
    if thing.extrapolate == "periodic":
        before, after = before or "periodic", after or "periodic"
    breaks, coefficients, cuts = cut(breaks, by_derivatives(thing, degree))
    classes = np.where(cuts, np.inf, counted(breaks, coefficients, before, after))
    if known is not None:
        classes[np.flatnonzero(~cuts)[1:-1]] = known
    return Path(breaks, coefficients, classes, before, after)


def _knots(thing):
    """The breaks (n + 1,) of an object of SciPy, its degree, and the class at inner breaks, None if it is not known."""
    from scipy.interpolate import BPoly, BSpline, CubicHermiteSpline, CubicSpline, PPoly

    if not isinstance(thing, (PPoly, BPoly, BSpline)) or np.iscomplexobj(thing.c):
        raise SpecificationError(
            f"A {type(thing).__name__} was given as a path{' of complex numbers' * hasattr(thing, 'c')}.",
            "A path is made of a real PPoly, BPoly or BSpline of SciPy, or of what inherits from these.",
            do="Use sv.paths.spline, fit or function, or SciPy's make_interp_spline.",
            type=type(thing).__name__,
        )
    if isinstance(thing, BSpline):
        breaks, multiplicities = np.unique(thing.t[thing.k : len(thing.t) - thing.k], return_counts=True)
        return breaks, thing.k, thing.k - multiplicities[1:-1]
    degree = thing.c.shape[0] - 1
    known = degree - (1 if isinstance(thing, CubicSpline) else 2) if isinstance(thing, CubicHermiteSpline) else None
    return np.unique(thing.x), degree, known


def by_derivatives(curve, degree, origin=0.0, unit=1.0):
    """The function `expand` of `cut` for a curve of SciPy whose argument is (t - origin)/unit."""

    def expand(low, high):
        middle, half = ((low - origin) + (high - origin)) / 2 / unit, (high - low) / 2 / unit
        rows, scale = [], np.ones((len(middle), 1))
        for k in range(degree + 1):
            values = np.moveaxis(np.asarray(curve(middle, nu=k)), curve.axis, 0).reshape(len(middle), -1)
            rows.append(values * scale)
            scale = scale * half[:, None] / (k + 1)
        return np.stack(rows, axis=2)

    return expand
