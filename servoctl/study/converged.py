"""Converged motions of the models of one scene, and how far other motions are from that of the first."""

import functools
import time

import numpy as np

from servoctl.checks import numbers_by_name, texts
from servoctl.errors import LimitExceeded, NameUnknown, ServoError, SpecificationError, unknown
from servoctl.methods.accuracy import component_sizes, relative_error
from servoctl.methods.choice import Adaptive, Algebraic, Project, Taylor
from servoctl.methods.sizes import state_levels
from servoctl.model.equations import signal_groups
from servoctl.model.following import breaks_within
from servoctl.simulation import consistent_state, simulated
from servoctl.study.executor import whole_run
from servoctl.verification import verify

INSTANTS = 51  # samples of adaptive methods while they are timed
COMPARED, BETWEEN = 400, 0.382  # instants at which motions are compared, and where in its interval each lies
CHECKS = (Adaptive("DOP853", 3e-14, 1e-15), Taylor(12, rtol=1e-14, atol=1e-14))  # of a motion, in this order


class Converged:
    """The converged motion of a model, at any instants.

    `check` is the run at `times` of the method that verified it, the first that ends within ten times `seconds`.
    """

    def __init__(self, model, start, span, seconds):
        consistent_state(model, start, span[0])
        self.model, self.start, self.span, self._runs = model, start, span, {}
        t0, t1 = span
        self.knots = [k for k in breaks_within(model, span) if min(span) < k < max(span)]
        self.few = np.union1d(np.linspace(t0, t1, INSTANTS), self.knots)
        between = t0 + (t1 - t0) * (np.arange(COMPARED) + BETWEEN) / COMPARED
        self.times = np.unique([t0, *between, t1, *self.knots])
        self.method, self.drift, checks = Taylor(16, rtol=1e-15, atol=1e-15), Project(), CHECKS
        if model.flat:
            self.method, self.drift, checks = Algebraic(), None, CHECKS[::-1]
        self.forces = [name for name, of in signal_groups(model.reduction).items() if of in ("actuation", "reaction")]
        self.at(self.times)
        self.checked_by, self.check = self._verified(checks, seconds)

    def _verified(self, checks, seconds):
        """The first of the other methods that ends in time, and its run."""
        for method in checks:
            options = {"drift": Project(), "t_eval": self.times, "progress": Deadline(10 * seconds)}
            try:
                return method, whole_run(simulated(self.model, self.start, self.span, method, **options))
            except ServoError as error:
                failure = error
        raise failure

    def at(self, times):
        """The run with samples at these times (N,) [s]."""
        key = times.tobytes()
        if key not in self._runs:
            run = simulated(self.model, self.start, self.span, self.method, drift=self.drift, t_eval=times)
            self._runs[key] = whole_run(run)
        return self._runs[key]


class Deadline:
    """A `progress` for `simulate` that stops a run some seconds after its first step."""

    def __init__(self, seconds):
        self.seconds, self.since, self.steps = seconds, None, 0

    def __call__(self, t):
        """Raise LimitExceeded when the time is over."""
        now = time.perf_counter()
        self.since, self.steps = self.since or now, self.steps + 1
        if now - self.since > self.seconds:
            raise LimitExceeded(
                f"More than {self.seconds:g} s: ended at t = {t:.4g} s", seconds=self.seconds, steps=self.steps, t=t
            )


class Comparison:
    """Deviations of runs, sampled at `times`, from the converged motion of the first of several models.

    `outputs` are the signals that are compared, or their sizes by name; None stands for the state, as far as all models
    have it. Forces are those of the same names.
    """

    def __init__(self, motions, outputs):
        first, *others = self.motions = tuple(motions.values())
        self.times = np.unique(np.concatenate([motion.times for motion in self.motions]))
        self.exact = first.at(self.times)
        self.forces = [name for name in first.forces if all(name in other.forces for other in others)]
        sizes = numbers_by_name(outputs, outputs, "", "size", positive=True) if isinstance(outputs, dict) else {}
        states = first.model.state_names
        if outputs is None:
            self.names = [name for name in states if all(name in other.model.state_names for other in others)]
            levels = state_levels(first.model)[[states.index(name) for name in self.names]]
        else:
            self.names = [*sizes] or [*texts(outputs, "The outputs")]
            levels = np.arange(len(self.names))  # each signal has a size of its own
            _require_signals(self.names, motions)
        if not self.names:
            raise SpecificationError(
                f"outputs={outputs!r} was given, and the models {', '.join(motions)} share no coordinate.",
                "Motions are compared in signals of the same name, one or more.",
                do='Give the outputs that all have, as outputs=["load"].',
                models=list(motions),
            )
        own = component_sizes(_values(self.exact, self.names), levels)
        self.sizes = np.array([sizes.get(*pair) for pair in zip(self.names, own, strict=True)])

    def off(self, run, other):
        """Largest deviation of the signals between two runs at the same instants, relative to their sizes."""
        return float((np.abs(_values(run, self.names) - _values(other, self.names)) / self.sizes[:, None]).max())

    def forces_off(self, run, other):
        """Largest deviation of the forces, each relative to its size; NaN where the models have none in common."""
        if not self.forces:
            return np.nan
        return relative_error(_values(run, self.forces), _values(other, self.forces))

    @functools.cached_property
    def agreement(self):
        """The methods that computed the first motion, and the largest differences of two methods on one model."""
        first = self.motions[0]
        pairs = [(motion.check, motion.at(motion.times)) for motion in self.motions]
        return {
            "method": in_words(first.method),
            "verified by": in_words(first.checked_by),
            "error": max(self.off(*pair) for pair in pairs),
            "actuation": float(np.fmax.reduce([self.forces_off(*pair) for pair in pairs], initial=0.0)),
            "energy": verify(first.at(first.times)).numbers.get("energy", np.nan),
        }


def _require_signals(names, motions):
    """Refuse signals that a model's motion does not have."""
    for model, motion in motions.items():
        for name in names:
            try:
                motion.check[name]
            except NameUnknown as error:
                of = f" of the model {model!r}" * (len(motions) > 1)
                raise unknown(name, motion.check.names, f"signal{of}") from error


def _values(run, names):
    return np.array([run[name] for name in names])


def in_words(method):
    """A method with its order and its tolerance."""
    order = f" of order {method.order}" if isinstance(method, Taylor) else ""
    return f"{method}{order}" + (f" at {method.rtol:g}" if hasattr(method, "rtol") else "")
