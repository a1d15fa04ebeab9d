"""The conditions of a sampled loop: sensors, timing and disturbances."""

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from servoctl.checks import (
    MOST_COUNT,
    ON_SAMPLE,
    array_of,
    mapping,
    named,
    numbers_by_name,
    positive,
    require_kind,
    require_memory,
    texts,
    whole,
)
from servoctl.control.disturbances import sampled
from servoctl.control.noise import normal
from servoctl.errors import SpecificationError
from servoctl.values import frozen

RESOLVED = 0.05  # largest |λ| h: the error of one Runge-Kutta step of order 4 is then 3e-9
MOST_SUBSTEPS = 1000
MOST_LOOP_OPERATIONS = 10**12  # of all steps of one loop, four evaluations each: some ten minutes of compiled code
STEP_OPERATIONS = 50  # of an evaluation besides its own: what a step of Runge-Kutta costs
WITHIN_STEP = 1e-9  # of a step: disturbances are sampled this far inside its ends, at which they may jump


@frozen
class Sensors:
    """Noise and quantisation of the measured states, in this order.

    Parameters
    ----------
    noise : dict of str to float
        Standard deviation of normally distributed noise by measured state, SI.
    quantisation : dict of str to float
        Resolution by measured state, SI.
    seed : int, optional
        Seed of the noise; default 0.

    Raises
    ------
    SpecificationError
        For a number that is negative or not finite, and a seed without noise.
    """

    noise: Mapping[str, float] = field(default_factory=dict)
    quantisation: Mapping[str, float] = field(default_factory=dict)
    seed: int | None = None

    def __post_init__(self):
        for what in ("noise", "quantisation"):
            values = mapping(getattr(self, what), f"The values of the {what}")
            object.__setattr__(self, what, numbers_by_name(values, values, "measured state", what, low=0.0))
        if self.seed is None:
            return
        object.__setattr__(self, "seed", whole("seed", self.seed))
        if not self.noise:
            raise SpecificationError(
                f"The sensors have seed={self.seed} and no noise.",
                "The seed is that of the noise.",
                do="Leave it out, or pass noise.",
                seed=self.seed,
            )

    def __hash__(self):
        return hash((frozenset(self.noise.items()), frozenset(self.quantisation.items()), self.seed))

    def noisy(self, measures, count):
        """Normally distributed noise of the measurement at each sample.

        It follows from the seed, the place of the state in `measures` and the sample alone (Philox 4x64-10).

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
        std = self.deviations(texts(measures, "The measured states"))
        count = whole("count", count, most=MOST_COUNT)
        require_memory(count, len(self.noise), f"Noise of {count} samples")
        if std is None:
            return None
        noisy, values = np.flatnonzero(std), np.zeros((count, len(std)))
        values[:, noisy] = normal(self.seed or 0, count, noisy.tolist()) * std[noisy]
        return values

    def deviations(self, measures):
        """Standard deviations in the order of `measures`, (n_y,), 0 for a state without noise; None without noise."""
        return _by_measure(self.noise, measures)

    def quantum(self, measures):
        """The quantisation in the order of `measures`, (n_y,), 0 for a state without; None if no state has any."""
        return _by_measure(self.quantisation, texts(measures, "The measured states"))


@frozen
class Timing:
    """Sampling rate, delay of the commands, and integration steps per sample.

    Parameters
    ----------
    rate : float, optional
        Samples per second [Hz]; required for a function as law. A Law has a rate.
    delay : int
        Samples from the measurement to the input. Until the first command arrives the inputs are the plan's actuation
        at the start, or the law's `initial_input` without a plan.
    substeps : int, optional
        Integration steps per sample; default: enough for |λ| h <= 0.05 with the fastest eigenvalue λ at the start, and
        for a transport delay of whole steps.

    Raises
    ------
    SpecificationError
        For a rate that is not positive, and a delay or substeps that are not whole numbers.
    """

    rate: float | None = None
    delay: int = 0
    substeps: int | None = None

    def __post_init__(self):
        object.__setattr__(self, "delay", whole("delay", self.delay, most=MOST_COUNT))
        if self.rate is not None:
            object.__setattr__(self, "rate", positive("rate", self.rate))
        if self.substeps is not None:
            object.__setattr__(self, "substeps", whole("substeps", self.substeps, least=1, most=MOST_COUNT))


@frozen
class Conditions:
    """Sensors, timing and disturbances of a loop: generalised forces or parameters by name, as functions of t [s]."""

    sensors: Sensors = field(default_factory=Sensors)
    timing: Timing = field(default_factory=Timing)
    disturbance: dict = field(default_factory=dict)

    def __post_init__(self):
        for name, kind in (("sensors", Sensors), ("timing", Timing)):
            value = kind() if getattr(self, name) is None else getattr(self, name)
            object.__setattr__(self, name, require_kind(kind, name, value, f"sv.{kind.__name__}(...)"))
        object.__setattr__(self, "disturbance", dict(mapping(self.disturbance, "The disturbances")))

    def forces(self, t0, h, count, finer=1):
        """The disturbances of a `Loop` in so many steps of length h [s] from t0 on, which are cut at their `edges`.

        They are also cut into equal parts of at most their `longest`, and these once more into so many (`finer`).
        """
        functions = self.disturbance.values()
        if not functions and finer == 1:
            return dict.fromkeys(("disturbance", "parts", "spans"))
        longest = min((positive("longest", getattr(f, "longest", h)) for f in functions), default=h)
        n = max(1, int(np.ceil(h / longest - ON_SAMPLE)))
        require_memory(count * n * finer, 3 * len(functions) + 3, f"A disturbance needs steps of {h / n:.3g} s")
        edges = np.unique([e for f in functions for e in array_of("edges", getattr(f, "edges", ()), None).tolist()])
        at, inside = (edges - t0) * n / h, max(WITHIN_STEP, 2 * np.spacing(abs(t0) + count * h) * n / h)
        at = at[(np.abs(at - np.rint(at)) > inside) & (np.diff(at, prepend=-np.inf) > inside)]
        begin = np.sort(np.append(np.arange(count * n), at[(at > 0) & (at < count * n)]))  # in h/n
        begin = (begin[:, None] + np.diff(begin, append=count * n)[:, None] * np.arange(finer) / finer).ravel()
        step, length, inside = (begin // n).astype(np.int64), np.diff(begin, append=count * n) * h / n, inside * h / n
        begin = (begin - n * step) * h / n
        t = (t0 + step * h + begin)[:, None] + np.stack([inside + 0 * length, length / 2, length - inside], axis=1)
        values = np.stack([sampled(name, f, t) for name, f in self.disturbance.items()], -1) if functions else None
        parts = np.searchsorted(step, np.arange(count + 1)) if len(step) > count else None
        return {"disturbance": values, "parts": parts, "spans": np.stack([begin, length], axis=1)}


def _by_measure(values, measures):
    """Numbers by name in the order of the measurement, 0 for missing names; None if there are no numbers."""
    if not values:
        return None
    numbers = np.zeros(len(measures))
    for name, value in values.items():
        numbers[index(name, measures, "measured state")] = value
    return numbers


def index(name, names, what):
    """The index of a name; `what` the names stand for, in the singular."""
    return names.index(named(name, names, what))


def limits(plant, period):
    """Lower and upper limits of the inputs, and the largest change in a sample, (m,) each; infinite without any."""
    low, high = np.array([plant.limits.get(name, (-np.inf, np.inf)) for name in plant.inputs]).reshape(-1, 2).T
    return low, high, np.array([plant.rate_limits.get(name, np.inf) for name in plant.inputs]) * period


def require_few_steps(samples, substeps, operations):
    """Refuse a loop that would integrate for hours; `operations` of one evaluation of the plant."""
    most = max(MOST_LOOP_OPERATIONS // (4 * (operations + STEP_OPERATIONS)), 1)
    if samples * substeps > most:
        fitting = {"nearest": f"substeps={most // samples}."} if most >= samples else {}
        raise SpecificationError(
            f"{samples} samples with {substeps} substeps are {samples * substeps:.3g} integration steps.",
            f"A loop of this plant takes at most {most:.1e}, which is some ten minutes.",
            do="Take fewer substeps, a lower rate or a shorter time.",
            samples=samples,
            substeps=substeps,
            most=most,
            **fitting,
        )


def steps(plant, period, substeps, t0, x0, u0):
    """Integration steps per sample, and transport delays in such steps, (m,) integers or None without any."""
    delays = np.array([plant.delay.get(name, 0.0) for name in plant.inputs])
    if substeps is None:
        least = _resolving(plant, period, t0, x0, u0)
        fitting = (n for n in range(least, MOST_SUBSTEPS + 1) if _fits(delays * n / period))
        substeps = next(fitting, least)
    late = delays * substeps / period
    if not _fits(late):
        name = plant.inputs[int(np.argmax(np.abs(late - np.rint(late))))]
        raise _split_delay(name, plant.delay[name], period, substeps)
    return substeps, np.rint(late).astype(np.int64) if plant.delay else None


def _split_delay(name, delay, period, substeps):
    """The error for a transport delay that is no whole number of integration steps."""
    rates = sorted(k / delay for k in {max(int(np.floor(delay / period)), 1), int(np.ceil(delay / period))})
    return SpecificationError(
        f"The transport delay {delay:g} s of {name!r} is {delay * substeps / period:.6g} integration steps of "
        f"{period / substeps:g} s.",
        "A transport delay is a whole number of integration steps.",
        nearest=f"Rates of {' or '.join(f'{rate:.6g}' for rate in rates)} Hz.",
        do="Change the rate, the substeps or the delay.",
        name=name,
        delay=delay,
        rates=rates,
    )


def _resolving(plant, period, t0, x0, u0):
    """The least number of steps per sample for the fastest eigenvalue at the start."""
    A, _ = plant.linearised(t0, x0[:, None], u0[:, None])
    fastest = np.abs(np.linalg.eigvals(A[0])).max(initial=0.0) if np.isfinite(A).all() else np.inf
    least = fastest * period / RESOLVED
    if not least <= MOST_SUBSTEPS:
        raise SpecificationError(
            f"The plant's linearisation at the start has the eigenvalue {fastest:.4g} 1/s; a sample is {period:g} s."
            if fastest < np.inf
            else "The plant's linearisation at the start is not finite.",
            f"The default substeps resolve the fastest eigenvalue, with at most {MOST_SUBSTEPS} per sample.",
            nearest=f"sv.Timing(substeps={least:.0f})." if fastest < np.inf else "",
            do="Pass substeps, or leave out such a short lag or high stiffness.",
            eigenvalue=float(fastest),
            substeps=float(least),
            most=MOST_SUBSTEPS,
        )
    return max(1, int(np.ceil(least)))


def _fits(numbers):
    return np.abs(numbers - np.rint(numbers)).max(initial=0.0) < ON_SAMPLE
