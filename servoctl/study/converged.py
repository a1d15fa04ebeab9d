"""Converged motions of the models of one scene, and how far other motions are from that of the first."""

import functools
import os
import time

import numpy as np

from servoctl.checks import numbers_by_name, texts
from servoctl.errors import LimitExceeded, NameUnknown, ServoError, SpecificationError, unknown
from servoctl.methods.accuracy import component_sizes, relative_error
from servoctl.methods.choice import Adaptive, Algebraic, Project, RadauIIA, Taylor, default_method
from servoctl.methods.sizes import state_levels
from servoctl.model.equations import signal_groups
from servoctl.model.following import breaks_within
from servoctl.simulation import consistent_state, simulated
from servoctl.study.executor import whole_run
from servoctl.verification import verify

INSTANTS = 51  # samples of adaptive methods while they are timed
COMPARED, BETWEEN = 400, 0.382  # instants at which motions are compared, and where in its interval each lies
TO_CONVERGE = (  # what a motion converges to, tried in this order: two that end, the implicit ones where it is stiff
    *(Taylor(16, rtol=1e-15, atol=1e-15), Adaptive("DOP853", 3e-14, 1e-15), Adaptive("LSODA", 1e-13, 1e-15)),
    *(RadauIIA(13, rtol=1e-14, atol=1e-15), RadauIIA(9, rtol=1e-13, atol=1e-14), Taylor(12, rtol=1e-14, atol=1e-14)),
)
FIRST = 0.3  # s of CPU after which a run for the reference waits until the others have been tried


class Converged:
    """The converged motion of a model, at any instants, and the run `check` at `times` of a method that verifies it.

    Both are of the methods `TO_CONVERGE` that need the least time, or of Newton's method where nothing is integrated;
    `cpu` is the processor time of all that was tried [s].
    """

    def __init__(self, model, start, span, bar):
        began = cpu_seconds()
        consistent_state(model, start, span[0])
        self.model, self.start, self.span = model, start, span
        t0, t1 = span
        self.knots = [k for k in breaks_within(model, span) if min(span) < k < max(span)]
        self.few = np.union1d(np.linspace(t0, t1, INSTANTS), self.knots)
        between = t0 + (t1 - t0) * (np.arange(COMPARED) + BETWEEN) / COMPARED
        self.times = np.unique([t0, *between, t1, *self.knots])
        self.forces = [name for name, of in signal_groups(model.reduction).items() if of in ("actuation", "reaction")]
        found = {Algebraic(): self._run(Algebraic(), self.times, Deadline(np.inf, span, bar))} if model.flat else {}
        self._find_two(found, bar)
        self.method, self.checked_by = sorted(found, key=lambda each: getattr(each, "rtol", 0.0))
        self.check, self._runs = found[self.checked_by], {self.times.tobytes(): found[self.method]}
        self.cpu = cpu_seconds() - began

    def _run(self, method, times, progress=False):
        options = {"drift": None if Project in method.refused else Project(), "t_eval": times, "progress": progress}
        return whole_run(simulated(self.model, self.start, self.span, method, **options))

    def _find_two(self, found, bar):
        """Add runs by method until there are two; what takes long waits for what is expected to take less.

        An untried method is expected to take twice as long as the longest attempt; series and implicit steps, which are
        made first, as many times as there are states, as their Jacobian has so many columns.
        """
        series_pay = isinstance(default_method(self.model, None), Taylor)
        waiting = dict.fromkeys(sorted(TO_CONVERGE, key=lambda each: isinstance(each, Taylor) and not series_pay), 0.0)
        dearest, failures = 0.0, []
        while len(found) < 2:
            if not waiting or len(failures) > 1 and not found:  # two methods say where it ends
                raise failures[0]
            expected = {
                each: needed or dearest * (2 if isinstance(each, Adaptive) else len(self.model.state_names))
                for each, needed in waiting.items()
            }
            method, began = min(expected, key=expected.get), cpu_seconds()
            del waiting[method]
            try:
                found[method] = self._run(
                    method, self.times, Deadline(max(FIRST, 2 * expected[method]), self.span, bar)
                )
            except ServoError as error:
                if "needed" in error.details:
                    waiting[method] = error.details["needed"]
                else:
                    failures.append(error)
            dearest = max(dearest, cpu_seconds() - began)

    def at(self, times):
        """The run with samples at these times (N,) [s]."""
        key = times.tobytes()
        if key not in self._runs:
            self._runs[key] = self._run(self.method, times)
        return self._runs[key]


def cpu_seconds():
    """Processor time of this process and of the compilers that it has called [s]."""
    return time.process_time() + sum(os.times()[2:4])


class Deadline:
    """A `progress` for `simulate` that stops a run some seconds of processor time after its first step.

    What it raises has the seconds that the whole run would need.
    """

    def __init__(self, seconds, span, bar=None):
        self.seconds, self.span, self.bar, self.since = seconds, span, bar, None

    def __call__(self, t):
        """Raise LimitExceeded when the time is over."""
        self.since = self.since or cpu_seconds()
        spent, (t0, t1) = cpu_seconds() - self.since, self.span
        if self.bar is not None:
            self.bar.update(0)  # the time that it shows
        if spent > self.seconds:
            needed = spent * (t1 - t0) / (t - t0) if t != t0 else np.inf
            raise LimitExceeded(
                f"More than {self.seconds:.2g} s of CPU: ended at t = {t:.4g} s of {t1:g} s", needed=needed, t=t
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
            "cpu": sum(motion.cpu for motion in self.motions),
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
    order = f" of order {method.order}" if isinstance(method, (Taylor, RadauIIA)) else ""
    return f"{method}{order}" + (f" at {method.rtol:g}" if hasattr(method, "rtol") else "")
