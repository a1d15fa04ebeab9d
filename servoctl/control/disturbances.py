"""Disturbances: generalised forces as functions of time; random ones have a seed."""

import numpy as np

from servoctl.checks import finite, whole
from servoctl.errors import SpecificationError
from servoctl.values import frozen

__all__ = ["gust", "noise", "step"]

HARMONICS = 64  # of the noise: its values are then normally distributed to a few per cent
CHECKED = 9  # instants at which a function's values for an array are compared with those one by one


@frozen
class Gust:
    """A constant force between two instants, with edges of half a cosine.

    Parameters
    ----------
    size : float
        [N or N m]
    start, end : float
        [s]
    rise : float
        Duration of each edge [s]: 0 gives a rectangle, (end - start)/2 the "one minus cosine" of wind loads.

    Raises
    ------
    SpecificationError
        If the end is not after the start, or the edges overlap.
    """

    size: float
    start: float
    end: float
    rise: float = 0.0

    def __post_init__(self):
        _as_floats(self)
        if self.end <= self.start or not 0 <= self.rise <= (self.end - self.start) / 2:
            raise SpecificationError(
                f"The gust lasts from {self.start:g} to {self.end:g} s, its edges {self.rise:g} s each.",
                "A gust ends after its start; its two edges do not overlap.",
                do=f"Choose end > {self.start:g} and 0 <= rise <= (end - start)/2.",
                start=self.start,
                end=self.end,
                rise=self.rise,
            )

    # at which integration steps end [s]: those of the rise and of the fall, at most a radian apart
    edges = property(lambda s: np.add.outer([s.start, s.end - s.rise], np.linspace(0, s.rise, 5)).ravel())

    def __call__(self, t):
        """The force at times t [s]."""
        t = np.asarray(t, dtype=float)
        edge = max(self.rise, 1e-300)
        up = np.clip((t - self.start) / edge, 0, 1)
        down = np.clip((self.end - t) / edge, 0, 1)
        inside = (t > self.start) & (t < self.end)
        return np.where(inside, self.size * (1 - np.cos(np.pi * np.minimum(up, down))) / 2, 0.0)


@frozen
class Step:
    """A constant force from an instant on.

    Parameters
    ----------
    size : float
        [N or N m]
    at : float
        [s]
    """

    size: float
    at: float

    def __post_init__(self):
        _as_floats(self)

    edges = property(lambda self: (self.at,))  # at which integration steps end [s]

    def __call__(self, t):
        """The force at times t [s]."""
        return np.where(np.asarray(t, dtype=float) >= self.at, self.size, 0.0)


@frozen
class Noise:
    """A stationary random force: harmonics of equal power and random phase up to a frequency.

    It is a function of time: values do not depend on how it is sampled.

    Parameters
    ----------
    std : float
        Standard deviation over time [N or N m].
    bandwidth : float
        Highest frequency [Hz].
    seed : int
        The same seed gives the same force.

    Raises
    ------
    SpecificationError
        For a negative deviation, and a bandwidth that is not positive.
    """

    std: float
    bandwidth: float
    seed: int = 0

    def __post_init__(self):
        object.__setattr__(self, "seed", whole("seed", self.seed))
        _as_floats(self, "std", "bandwidth")
        if self.std < 0 or self.bandwidth <= 0:
            raise SpecificationError(
                f"The noise has std={self.std:g} and bandwidth={self.bandwidth:g} Hz.",
                "A standard deviation is not negative, a bandwidth is positive.",
                nearest=f"std={abs(self.std):g}, bandwidth={abs(self.bandwidth):g}." if self.bandwidth else "",
                std=self.std,
                bandwidth=self.bandwidth,
            )

    # of an integration step [s]: one radian of the highest harmonic, where Simpson's rule errs by 1/2880
    longest = property(lambda self: 1 / (2 * np.pi * self.bandwidth))

    def __call__(self, t):
        """The force at times t [s]."""
        random = np.random.default_rng(self.seed)
        frequency = (np.arange(HARMONICS) + random.uniform(size=HARMONICS)) * self.bandwidth / HARMONICS
        phase = random.uniform(0, 2 * np.pi, HARMONICS)
        t = np.asarray(t, dtype=float)
        total = np.zeros(t.shape)
        for f, a in zip(frequency, phase, strict=True):
            total += np.cos(2 * np.pi * f * t + a)
        return self.std * np.sqrt(2 / HARMONICS) * total


gust, step, noise = Gust, Step, Noise


def _as_floats(value, *names):
    """Make numbers of a frozen value finite floats; without names all of them."""
    for name in names or value.__dataclass_fields__:
        object.__setattr__(value, name, finite(name, getattr(value, name)))


def sampled(name, function, t):
    """Values of a disturbance at times t of any shape; its function may take arrays or single numbers."""
    if not callable(function):
        return np.full(t.shape, finite(name, function, "disturbance"))
    flat = t.ravel()
    some = np.linspace(0, flat.size - 1, CHECKED).astype(int) if flat.size else np.zeros(0, dtype=int)
    try:
        at_once = np.asarray(function(flat), dtype=float)
        same = at_once.shape == flat.shape
        same = same and np.allclose(at_once[some], _singly(name, function, flat[some]), rtol=1e-12)
    except Exception:  # a function of one number may raise anything for an array
        same = False
    values = at_once if same else _singly(name, function, flat)
    if not np.isfinite(values).all():
        at = flat[np.flatnonzero(~np.isfinite(values))[0]]
        raise SpecificationError(
            f"The disturbance of {name!r} is not finite at t = {at:.6g} s.",
            "A disturbance is a finite generalised force at each instant.",
            do="Correct its function there.",
            name=name,
            t=float(at),
        )
    return values.reshape(t.shape)


def _singly(name, function, t):
    try:
        return np.array([float(function(instant)) for instant in t.tolist()])
    except (TypeError, ValueError) as error:
        raise SpecificationError(
            f"The disturbance of {name!r} does not return a number: {error}.",
            "A disturbance maps time [s] to a generalised force.",
            do="Pass such a function: lambda t: 60.0 * (2.0 < t < 2.5).",
            name=name,
        ) from error
