"""Rates in time and extrema of the signals of a run, and by how much these exceed limits."""

import numpy as np

from servoctl.errors import NameUnknown, SpecificationError

FEWEST_OF_A_SPLINE = 4  # samples between two knots through which a spline of order 3 is laid
SHORT = 1e-6  # of the span: intervals between samples that are too short for a derivative


def extremes(run, name):
    """(value, instant [s]) of the least and the greatest value of a signal, or of the rate of one, along a run.

    Parameters
    ----------
    run : Run
    name : str
        A signal, or d and the name of one.
    """
    if name not in run and name[:1] == "d" and name[1:] in run:
        return sampled_extremes(run.t, rates(run, name[1:]))
    return tuple((value, t) for t, value in run.extrema(name))


def excesses(run, limits):
    """(excess relative to the limit, signal, side, instant [s], value, limit) at each side of (low, high) by signal."""
    for name, (low, high) in limits.items():
        (least, t_least), (most, t_most) = extremes(run, as_read(run, name))
        size = size_of_limit(low, high) or max(abs(least), abs(most)) or 1.0
        for excess, *where in ((low - least, "lower", t_least, least, low), (most - high, "upper", t_most, most, high)):
            yield np.inf if np.isnan(excess) else float(excess / size), name, *where


def as_read(run, name):
    """The name by which a run has what a limit or bound names: the residual X, beside a reference X, is X_residual."""
    both = name in run.model.paths and name in [*run.residual] and name not in run.model.reduction.mechanism.signals
    return f"{name}_residual" if both else name


def size_of_limit(low, high):
    """The larger finite side of a limit; 0 if there is none."""
    return max((abs(side) for side in (low, high) if np.isfinite(side)), default=0.0)


def sampled_extremes(t, values):
    """The same of samples (N,)."""
    if not np.isfinite(values).any():
        return (np.nan, float(t[0])), (np.nan, float(t[0]))
    return tuple((float(values[k]), float(t[k])) for k in (int(np.nanargmin(values)), int(np.nanargmax(values))))


def rates(run, name):
    """The derivative of a signal at the samples: exact if the run has the jets, else of splines between knots."""
    from scipy.interpolate import CubicSpline

    try:
        return run[f"d{name}"]
    except (NameUnknown, SpecificationError):
        values, found = run[name], np.full(len(run.t), np.nan)
    short, ends = SHORT * np.ptp(run.t), sorted((run.t[0], run.t[-1]))
    edges = [-np.inf, *(knot for knot in sorted(run.knots) if ends[0] + short < knot < ends[1] - short), np.inf]
    direction = 1 if run.t[-1] >= run.t[0] else -1
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        inside = np.flatnonzero((run.t >= a) & (run.t <= b) & np.isfinite(values))[::direction]
        apart = inside[np.append(True, np.diff(run.t[inside]) > short)[: len(inside)]]
        if len(apart) >= FEWEST_OF_A_SPLINE:
            slopes = CubicSpline(run.t[apart], values[apart])(run.t[inside], 1)
            larger = ~(np.abs(found[inside]) >= np.abs(slopes))  # at a knot the rate may jump
            found[inside[larger]] = slopes[larger]
    return found
