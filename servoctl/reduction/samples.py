"""Whether the samples of a path determine the derivatives of it that the actuation contains.

A spline follows its samples with their rounding and noise, and differentiates these, too: an error e of samples at a
distance h is one of the size e/h^k in derivative k. Noise is what divided differences of high order leave: they vanish
for polynomials, and pass what alternates from sample to sample.
"""

import math
import warnings
from typing import NamedTuple

import numpy as np

LEAST_DENSE = 30  # knots from which on a spline is one through samples; fewer are via points, which may zigzag
DIFFERENCES = 8  # their order: of a sine with 10 samples in a period they leave 2e-4, of noise all
WINDOW, WINDOWS = 128, 16  # consecutive samples that are looked at, and places along the path
EDGE = 40  # samples at either end, at most a quarter of all, on which the spline's ends have an effect
ALTERNATING = 0.1  # part of a derivative that alternates from sample to sample, above which it is noise
MEANT = 1e-2  # of the range of a path: what alternates in the path itself by more is meant
CALM = 0.03  # part of noise in the differences of fewer samples, up to which these are proposed
STEEP = 30.0  # size of a derivative, relative to what the samples give, above which the spline's ends do not fit them


class Noise(NamedTuple):
    """Noise of samples: its part of the derivative, its size, and a distance of fewer samples that calms, or 0.

    And what alternates in the derivative relative to what noise of that size makes there.
    """

    part: float
    size: float
    stride: int
    excess: float


def warn_of_samples(switches, values, needs, times):
    """Warn of splines through samples that do not determine a derivative that the actuation contains.

    A RuntimeWarning tells of noise, and of ends that do not fit the samples, such as ends at rest of a motion, in
    splines that time alone, or a time law, runs through. `needs` has the highest derivative of each residual that the
    actuation contains; `times` are ascending instants at which residuals switch [s].
    """
    ends, noises = [], []
    for name, k in needs.items():
        for argument, knots in switches.tables(name).items() if k and len(times) > 1 else ():
            samples = Samples(switches, values, name, argument, knots, (times[0], times[-1]))
            if len(samples.knots) < LEAST_DENSE or not samples.move():
                continue
            steep, noise = samples.steepness(k), samples.noise(k)
            if steep > STEEP or noise is not None and noise.excess > STEEP:
                ends.append((steep, k, name))
            elif noise is not None:
                noises.append((noise, k, name))
    _warn(_of_ends, ends)
    _warn(_of_noise, noises)


def _warn(sentence, found):
    """Warn of the worst of what was found, (measure, derivative, residual), with the names of all."""
    if found:
        measure, k, _ = max(found, key=lambda one: one[0])
        names = ", ".join(repr(name) if isinstance(name, str) else str(name) for *_, name in found)
        warnings.warn(sentence(names, k, measure), RuntimeWarning, stacklevel=4)


def _of_noise(names, k, noise):
    fit = "fit a spline of fewer pieces to all of them, as docs/own_scene.md does"
    do = f"Pass about one in {noise.stride} samples to sv.paths.spline, or {fit}."
    if not noise.stride:
        do = f"{fit.capitalize()}; where the path itself bends as sharply as they do, pass more samples."
    return (
        f"The samples of the path in {names} do not determine its derivative {k}, which the actuation contains: they "
        f"differ by about {noise.size:.1g} from a smooth curve, as by rounding, noise or corners, which makes up "
        f"{min(noise.part, 1.0):.0%} of that derivative. {do}"
    )


def _of_ends(names, k, _):
    return (
        f"The spline of the path in {names} does not fit its samples at its ends: from there on its derivative {k}, "
        "which the actuation contains, swings about that of the samples. Where the samples begin and end at rest, "
        f"write ends='rest' in sv.paths.spline; where they do not, ends='natural' and smoothness={max(2 * k - 2, 2)}, "
        "with samples before and after the motion."
    )


class Samples:
    """The samples that the residual `name` takes from a spline.

    `argument` is the node that runs through the knots (n,), within the span (t0, t1) [s]; `values` (n_p,) are
    parameters.
    """

    def __init__(self, switches, values, name, argument, knots, span):
        passage = switches.passage(values, argument, span)
        self._instants = lambda some: switches.passed(values, argument, some, passage)
        self._coefficient = lambda t, k: switches.coefficient(name, t, values, k)
        self.knots = knots[(knots >= passage[1][0]) & (knots <= passage[1][-1])]
        self.edge = min(EDGE, len(self.knots) // 4)

    def move(self):
        """Whether the path is no constant."""
        return np.ptp(self._coefficient(self._windows(1), 0)) > 0

    def noise(self, k):
        """The `Noise` of derivative k; None if it is determined, or if what alternates is meant."""
        t = self._windows(1)
        between = t if k % 2 == 0 else (t[:, 1:] + t[:, :-1]) / 2  # where what alternates has its extrema
        path, derivative = self._coefficient(t, 0), self._coefficient(between, k)
        size = _left(t, path, DIFFERENCES)
        alternating = _left(between, derivative, DIFFERENCES)
        part = alternating / (_root_mean_square(derivative) + self._slow(k))
        if part <= ALTERNATING or size > MEANT * np.ptp(path):
            return None
        made = size * (math.pi / np.diff(t).min()) ** k / math.factorial(k)
        return Noise(float(part), size, self._calm_stride(size, k), alternating / made)

    def steepness(self, k):
        """The largest derivative k beside the ends, relative to those between and of polynomials through the samples.

        A motion that is brisk at an end is so in these, too.
        """
        last = len(self.knots) - 1
        inner = np.linspace(self.edge, last - self.edge, min(WINDOW * WINDOWS, last - 2 * self.edge)).astype(int)
        ends = np.arange(self.edge // 2)
        t = self._instants(self.knots[np.concatenate([ends, inner, last - ends[::-1]])])
        sizes = np.abs(self._coefficient(np.array([t[:-1], (t[1:] + t[:-1]) / 2]), k)).max(axis=0)
        between = sizes[len(ends) : len(t) - len(ends) - 1].max()
        given = max(self._divided(k, self.knots[: self.edge + k]), self._divided(k, self.knots[-self.edge - k :]))
        return sizes[[*ends, *(-1 - ends)]].max() / (max(between, given) + self._slow(k))

    def _divided(self, k, knots):
        """The largest divided difference k of consecutive samples: coefficient k of the polynomial through them."""
        t = self._instants(knots)
        c = self._coefficient(t, 0)
        for j in range(1, k + 1):
            c = np.diff(c) / (t[j:] - t[:-j])
        return np.abs(c).max()

    def _slow(self, k):
        """Coefficient k of a motion of the same stroke in all the time: a derivative may be zero, as of a line."""
        t = self._instants(np.linspace(self.knots[0], self.knots[-1], WINDOW))
        path = self._coefficient(t, 0)
        return np.ptp(path) * (2 * math.pi / (t[-1] - t[0])) ** k / math.factorial(k)

    def _calm_stride(self, size, k):
        """The least power of 2 as a distance of samples whose differences of order k are large beside the noise."""
        stride = 2
        while (len(self.knots) - 2 * self.edge) // stride > max(DIFFERENCES, k):
            t = self._windows(stride)
            if size < CALM * _left(t, self._coefficient(t, 0), k):
                return stride
            stride *= 2
        return 0

    def _windows(self, stride):
        """Instants of samples so many apart, (places along the path, consecutive ones)."""
        inner = len(self.knots) - 2 * self.edge
        length = min(WINDOW, inner // stride)
        count = max(1, min(WINDOWS, inner // (length * stride)))
        starts = np.linspace(self.edge, self.edge + inner - length * stride, count).astype(int)
        places = starts[:, None] + stride * np.arange(length)
        return self._instants(self.knots[places.ravel()]).reshape(places.shape)


def _left(t, values, order):
    """Root mean square of what divided differences of an order leave of values (m, n) at instants, as of noise alone.

    Their weights have squares that add up to 1.
    """
    t, values = (np.lib.stride_tricks.sliding_window_view(e, order + 1, axis=1) for e in (t, values))
    t = (t - t[..., :1]) / (t[..., -1:] - t[..., :1]) * order
    weights = 1 / (t[..., :, None] - t[..., None, :] + np.eye(order + 1)).prod(axis=-1)
    weights /= np.linalg.norm(weights, axis=-1, keepdims=True)
    return _root_mean_square((weights * values).sum(axis=-1))


def _root_mean_square(values):
    return float(np.sqrt(np.mean(np.square(values))))
