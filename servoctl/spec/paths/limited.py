"""Paths within limits."""

import numpy as np

from servoctl.spec.paths.value import SAME, Path


def within_limits(path, low, high):
    """A path of one component that stays at a limit where it would exceed it; of class 0 where it reaches one."""
    met = _instants_at(path, low, high)
    breaks = np.unique(np.concatenate([path.breaks, met]))
    breaks = breaks[np.append(True, np.diff(breaks) > SAME * np.abs(breaks).max())]
    own = np.clip(np.searchsorted(path.breaks, breaks), 0, len(path.breaks) - 1)
    classes = np.where(path.breaks[own] == breaks, path.classes[own], np.inf)
    half = np.diff(breaks) / 2
    middles = breaks[:-1] + half
    table = path._taylor(middles, path.coefficients.shape[2] - 1, half, middles)
    sides = np.where(table[0] < low, -1, np.where(table[0] > high, 1, 0))[:, 0]  # of the limits
    for side, limit in ((-1, low), (1, high)):
        table[:, sides == side] = 0.0
        table[0, sides == side] = limit
    classes[1:-1][np.diff(sides) != 0] = np.minimum(classes[1:-1][np.diff(sides) != 0], 0.0)
    return Path(breaks, table.transpose(1, 2, 0), classes, path.before, path.after)


def _instants_at(path, low, high):
    """Instants (N,) at which a path has the value of a limit; where it goes on outside, another beyond them all."""
    found, last = [], len(path.breaks) - 2
    for i, (a, b, c) in enumerate(zip(path.breaks[:-1], path.breaks[1:], path.coefficients[:, 0], strict=True)):
        roots = np.concatenate([np.zeros(0), *(_roots(c, limit) for limit in (low, high) if np.isfinite(limit))])
        first_goes_on, last_goes_on = i == 0 and path.before == "continue", i == last and path.after == "continue"
        inside = ((roots > -1) | first_goes_on) & ((roots < 1) | last_goes_on)
        outermost = [roots.min(initial=-1.0) - 1] * first_goes_on + [roots.max(initial=1.0) + 1] * last_goes_on
        found.append(a + (b - a) * (1 + np.concatenate([roots[inside], outermost])) / 2)
    return np.concatenate(found)


def _roots(c, limit):
    """The real places at which a polynomial (size,) has a value."""
    c = np.trim_zeros([c[0] - limit, *c[1:]], "b")
    roots = np.polynomial.polynomial.polyroots(c) if len(c) > 1 else np.zeros(0)
    return roots[np.isreal(roots)].real
