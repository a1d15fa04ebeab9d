"""Disturbances by name: generalised forces as functions of time, seeded where they are random."""

from dataclasses import dataclass

import numpy as np

from servoctl.checks import finite, whole
from servoctl.errors import SpecificationError

__all__ = ["gust", "noise", "step"]

HARMONICS = 64  # of a band-limited noise: its values are normally distributed to a few per cent
CHECKED = 9  # instants at which a function of arrays is compared with its values one by one


@dataclass(frozen=True)
class Gust:
    """A force that rises, lasts and falls; made by `gust`."""

    size: float
    start: float
    end: float
    rise: float

    def __call__(self, t):
        """The force at times t [s]."""
        t = np.asarray(t, dtype=float)
        edge = max(self.rise, 1e-300)
        up = np.clip((t - self.start) / edge, 0, 1)
        down = np.clip((self.end - t) / edge, 0, 1)
        inside = (t > self.start) & (t < self.end)
        return np.where(inside, self.size * (1 - np.cos(np.pi * np.minimum(up, down))) / 2, 0.0)


@dataclass(frozen=True)
class Step:
    """A force that sets in and stays; made by `step`."""

    size: float
    at: float

    def __call__(self, t):
        """The force at times t [s]."""
        return np.where(np.asarray(t, dtype=float) >= self.at, self.size, 0.0)


@dataclass(frozen=True)
class Noise:
    """A stationary random force without power above a frequency; made by `noise`."""

    std: float
    bandwidth: float
    seed: int

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


def gust(size, start, end, rise=0.0):
    """A gust: a force of one size between two instants, with edges of half a cosine.

    Parameters
    ----------
    size : float
        [N or N m]
    start, end : float
        [s]
    rise : float
        Duration of each edge [s]; 0 for a rectangle, half of the gust for the "one minus cosine" of wind loads.

    Returns
    -------
    Gust
        A function of time.

    Raises
    ------
    SpecificationError
    """
    size, start, end, rise = (
        finite(n, v) for n, v in zip(("size", "start", "end", "rise"), (size, start, end, rise), strict=True)
    )
    if end <= start or not 0 <= rise <= (end - start) / 2:
        raise SpecificationError(
            f"A gust from {start:g} to {end:g} s with edges of {rise:g} s was asked for.",
            "A gust ends after it started, and each edge takes at most half of it.",
            nearest=f"end > {start:g}, 0 <= rise <= (end - start)/2.",
            do="Change the instants.",
        )
    return Gust(size, start, end, rise)


def step(size, at):
    """A force that sets in at an instant and stays.

    Parameters
    ----------
    size : float
        [N or N m]
    at : float
        [s]

    Returns
    -------
    Step
        A function of time.
    """
    return Step(finite("size", size), finite("at", at))


def noise(std, bandwidth, seed=0):
    """A stationary random force: harmonics up to a frequency, of equal power and random phase.

    As a function of time it does not depend on how it is sampled.

    Parameters
    ----------
    std : float
        Standard deviation over time [N or N m].
    bandwidth : float
        Highest frequency [Hz].
    seed : int
        The same seed gives the same force.

    Returns
    -------
    Noise
        A function of time.

    Raises
    ------
    SpecificationError
    """
    std, bandwidth = finite("std", std), finite("bandwidth", bandwidth)
    if std < 0 or bandwidth <= 0:
        raise SpecificationError(
            f"A noise of standard deviation {std:g} up to {bandwidth:g} Hz was asked for.",
            "The deviation is not negative, the bandwidth positive.",
            do="Change them.",
        )
    return Noise(std, bandwidth, whole("seed", seed))


def sampled(name, function, t):
    """Values of a disturbance at times of any shape, whether or not its function takes arrays.

    Parameters
    ----------
    name : str
    function : callable or float
    t : array
        [s]

    Returns
    -------
    array of t's shape

    Raises
    ------
    SpecificationError
        If a value is no finite number.
    """
    if not callable(function):
        return np.full(t.shape, finite(name, function, "disturbance"))
    flat = t.ravel()
    some = np.linspace(0, flat.size - 1, CHECKED).astype(int) if flat.size else np.zeros(0, dtype=int)
    values = None
    try:
        found = np.asarray(function(flat), dtype=float)
        if found.shape == flat.shape and np.allclose(found[some], _singly(name, function, flat[some]), rtol=1e-12):
            values = found
    except Exception:  # a function of one number may raise anything when it is given many
        values = None
    values = _singly(name, function, flat) if values is None else values
    if not np.isfinite(values).all():
        at = flat[np.flatnonzero(~np.isfinite(values))[0]]
        raise SpecificationError(
            f"The disturbance of {name!r} is not finite at t = {at:.6g} s.",
            "A disturbance is a finite generalised force at each instant.",
            do="Correct its function.",
            name=name,
        )
    return values.reshape(t.shape)


def _singly(name, function, t):
    try:
        return np.array([float(function(instant)) for instant in t.tolist()])
    except (TypeError, ValueError) as error:
        raise SpecificationError(
            f"The disturbance of {name!r} does not give a number: {error}.",
            "A disturbance is a function of time [s] to a generalised force.",
            nearest="lambda t: 60.0 * (2.0 < t < 2.5).",
            do="Correct its function.",
            name=name,
        ) from error
