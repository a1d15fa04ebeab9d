"""What is between a plant and its law in a sampled loop: sensors, timing and disturbances."""

from dataclasses import dataclass, field

import numpy as np

from servoctl.checks import ON_SAMPLE, mapping, numbers_by_name, positive, whole
from servoctl.control.disturbances import sampled
from servoctl.errors import SpecificationError, unknown

RESOLVED = 0.05  # |λ| h at most: then one Runge-Kutta step of order 4 errs by 3e-9
MOST_SUBSTEPS = 1000
WITHIN_STEP = 1e-9  # of a step: how far inside it disturbances are taken, so that they may jump at its ends


@dataclass(frozen=True)
class Sensors:
    """How the states are measured: what a law sees is the state with noise, then quantised.

    Parameters
    ----------
    noise : dict of str to float
        Standard deviation of normally distributed noise by measured state, SI.
    quantisation : dict of str to float
        Step of the measurement by measured state, SI.
    seed : int, optional
        Of the noise; default 0.

    Raises
    ------
    SpecificationError
        For a number that is negative or not finite, and a seed without noise.
    """

    noise: dict = field(default_factory=dict)
    quantisation: dict = field(default_factory=dict)
    seed: int = None

    def __post_init__(self):
        for what in ("noise", "quantisation"):
            values = getattr(self, what) or {}
            object.__setattr__(self, what, numbers_by_name(values, values, "measured state", what, low=0.0))
        if self.seed is None:
            return
        object.__setattr__(self, "seed", whole("seed", self.seed))
        if not self.noise:
            raise SpecificationError(
                f"seed={self.seed} was given without noise.",
                "The seed is that of the noise.",
                do="Remove it.",
                seed=self.seed,
            )

    def noisy(self, measures, count):
        """Normally distributed noise of the measurement at each sample.

        Parameters
        ----------
        measures : tuple of str
            Names of the measured states.
        count : int
            Number of samples.

        Returns
        -------
        (count, n_y) array or None
            None without noise.
        """
        std = _by_measure(self.noise, measures)
        return None if std is None else np.random.default_rng(self.seed or 0).standard_normal((count, len(std))) * std

    def quantum(self, measures):
        """The quantisation in the order of `measures`, (n_y,), 0 for what is not quantised; None without any."""
        return _by_measure(self.quantisation, measures)


@dataclass(frozen=True)
class Timing:
    """When a law is sampled, how late its commands are, and how finely the plant is integrated in between.

    Parameters
    ----------
    rate : float, optional
        Samples per second [Hz]; needed for a function, a Law has its own.
    delay : int
        Samples from the measurement to the input. Until the first command arrives the inputs are the plan's actuation
        at the start, or the law's `idle` without a plan.
    substeps : int, optional
        Integration steps per sample; default: enough for |λ| h <= 0.05 of the fastest eigenvalue λ at the start, and
        for a transport delay of whole steps.

    Raises
    ------
    SpecificationError
        For a rate that is not positive, a delay or substeps that are no whole numbers.
    """

    rate: float = None
    delay: int = 0
    substeps: int = None

    def __post_init__(self):
        object.__setattr__(self, "delay", whole("delay", self.delay))
        if self.rate is not None:
            object.__setattr__(self, "rate", positive("rate", self.rate))
        if self.substeps is not None:
            object.__setattr__(self, "substeps", whole("substeps", self.substeps, least=1))


@dataclass(frozen=True)
class Conditions:
    """What a loop is exposed to.

    Attributes
    ----------
    sensors : Sensors
    timing : Timing
    disturbance : dict of str to callable or float
        Generalised forces by coordinate (or quasi-velocity), functions of t [s].
    """

    sensors: Sensors = field(default_factory=Sensors)
    timing: Timing = field(default_factory=Timing)
    disturbance: dict = field(default_factory=dict)

    def __post_init__(self):
        for name, kind in (("sensors", Sensors), ("timing", Timing)):
            value = kind() if getattr(self, name) is None else getattr(self, name)
            if not isinstance(value, kind):
                raise SpecificationError(
                    f"{name}={value!r} was given."[:200],
                    f"They are a value of sv.{kind.__name__}.",
                    do=f"Write {name}=sv.{kind.__name__}(...).",
                )
            object.__setattr__(self, name, value)
        object.__setattr__(self, "disturbance", dict(mapping(self.disturbance, "The disturbances")))

    def forces(self, t0, h, count):
        """Disturbances at the start, middle and end of each integration step, (count, 3, n_d); None without any."""
        if not self.disturbance:
            return None
        starts = t0 + np.arange(count)[:, None] * h
        t = starts + np.array([WITHIN_STEP, 0.5, 1 - WITHIN_STEP]) * h
        return np.stack([sampled(name, f, t) for name, f in self.disturbance.items()], axis=-1)


def _by_measure(values, measures):
    """Numbers by name in the order of the measurement, 0 for those without; None without any."""
    if not values:
        return None
    numbers = np.zeros(len(measures))
    for name, value in values.items():
        numbers[index(name, measures, "measured state")] = value
    return numbers


def index(name, names, what):
    """The place of a name among others; `what` is a name's meaning in the singular."""
    if name not in names:
        raise unknown(name, names, what)
    return names.index(name)


def ranges(plant, period):
    """Lower and upper limits of the inputs, and the largest change in a sample, (m,) each; infinite without any."""
    low, high = np.array([plant.limits.get(name, (-np.inf, np.inf)) for name in plant.inputs]).reshape(-1, 2).T
    return low, high, np.array([plant.rate_limits.get(name, np.inf) for name in plant.inputs]) * period


def limits(plant, period):
    """The same; None for limits and rate limits that the plant has not."""
    low, high, change = ranges(plant, period)
    low, high = (low, high) if plant.limits else (None, None)
    return low, high, change if plant.rate_limits else None


def steps(plant, period, substeps, t0, x0, u0):
    """Integration steps per sample, and those by which each input arrives late (None for no transport delay)."""
    delays = np.array([plant.delay.get(name, 0.0) for name in plant.inputs])
    if substeps is None:
        least = _resolving(plant, period, t0, x0, u0)
        fitting = (n for n in range(least, MOST_SUBSTEPS + 1) if _fits(delays * n / period))
        substeps = next(fitting, least)
        substeps = whole("substeps", substeps, least=1)
    if not plant.delay:
        return substeps, None
    late = delays * substeps / period
    if not _fits(late):
        name = plant.inputs[int(np.argmax(np.abs(late - np.rint(late))))]
        _refuse_delay(name, plant.delay[name], period, substeps)
    return substeps, np.rint(late).astype(np.int64)


def _refuse_delay(name, delay, period, substeps):
    rates = sorted(k / delay for k in {max(int(np.floor(delay / period)), 1), int(np.ceil(delay / period))})
    raise SpecificationError(
        f"The transport delay {delay:g} s of {name!r} is {delay * substeps / period:.6g} integration steps of "
        f"{period / substeps:g} s.",
        "A transport delay is a whole number of integration steps.",
        nearest=f"Rates of {' or '.join(f'{rate:.6g}' for rate in rates)} Hz.",
        do="Change the rate, the substeps or the delay.",
        name=name,
        rates=rates,
    )


def _resolving(plant, period, t0, x0, u0):
    """The least number of steps per sample for the fastest eigenvalue at the start."""
    A, _ = plant.linearised(t0, x0[:, None], u0[:, None])
    fastest = np.abs(np.linalg.eigvals(A[0])).max(initial=0.0) if np.isfinite(A).all() else np.inf
    least = fastest * period / RESOLVED
    if not least <= MOST_SUBSTEPS:
        raise SpecificationError(
            f"The plant's linearisation at the start has eigenvalues of up to {fastest:.4g} 1/s, at {1 / period:g} Hz."
            if fastest < np.inf
            else "The plant's linearisation at the start is not finite.",
            f"Without substeps a sample is divided into at most {MOST_SUBSTEPS} steps, each resolving these.",
            nearest=f"sv.Timing(substeps={least:.0f})." if fastest < np.inf else "",
            do="Give substeps, or leave out a lag or a stiffness that fast.",
            eigenvalue=float(fastest),
        )
    return max(1, int(np.ceil(least)))


def _fits(numbers):
    return np.abs(numbers - np.rint(numbers)).max(initial=0.0) < ON_SAMPLE
