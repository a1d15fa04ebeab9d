"""The fastest time law of a program that its actuators can follow."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from servoctl.checks import as_span, finite, interval, mapping, require_kind
from servoctl.errors import InconsistentStart, IntegrationStopped, LimitExceeded, SingularProgram, SpecificationError
from servoctl.model.model import derived
from servoctl.progress import progress_bar
from servoctl.run import Run
from servoctl.simulation import judged, simulated
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.program import Program

REACH = 12  # doublings of the time, after which a motion is nearly static, or halvings
BELOW = 1e-6  # of a limit: distance that the fastest time law keeps from it
REACHED = 1e-4  # of a limit: largest distance at which it counts as reached


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """A program whose time is scaled until a signal reaches its limit; made by `fastest`.

    Attributes
    ----------
    factor : float
        Duration of the motion over that of the original program.
    program : Program
        The program with this time law.
    plan : Run
        Its motion, within all limits.
    binding : (str, str, float)
        The signal that reaches its limit, the side ("lower" or "upper"), and the instant [s].
    """

    factor: float
    program: Program
    plan: Run
    binding: tuple[str, str, float]

    def __repr__(self):
        name, side, t = self.binding
        how = "slowed" if self.factor > 1 else "quickened"
        return (
            f"TimeLaw: {how} by the factor {self.factor:.6g}; {name} reaches its {side} limit at t = {t:.5g} s\n"
            f"  the motion takes {self.plan.t[0]:g} .. {self.plan.t[-1]:.6g} s"
        )


def fastest(
    mechanism: Mechanism, program: Program, limits: Mapping[str, Any], t_span: tuple[float, float],
    start: Mapping[str, float] | None = None, guess: Mapping[str, float] | None = None,
    parameters: Mapping[str, float] | None = None, progress: bool | None = None,
) -> TimeLaw:  # fmt: skip
    """The fastest time law q(t0 + (t - t0)/σ) under which signals keep their limits.

    The geometry of the motion stays; speeds scale with 1/σ, accelerations with 1/σ²; static loads stay. If several σ
    reach a limit, the result is the one next to σ = 1.

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
    limits : dict of str to (float, float) or float
        Lower and upper limit of actuators and outputs by name; a number c is (-c, c), None leaves a side open.
    t_span : (t0, t1)
        Span of the original program [s].
    start, guess : dict of str to float, optional
        As for `Model.start`, for the original program; derivatives in `start` are scaled with the motion.
    parameters : dict of str to float, optional
        Parameters of the mechanism that differ from their defaults.
    progress : bool, optional
        Show the number of simulated motions; default: on a terminal, for work of more than a second.

    Returns
    -------
    TimeLaw

    Raises
    ------
    LimitExceeded
        If even a nearly static motion exceeds a limit, or motions cease to exist before one is reached.
    SpecificationError
        For limits that are no interval, and a span that does not go forward.
    NameUnknown
        For a limit of an unknown signal.
    """
    from scipy.optimize import brentq

    scene = _Scene(
        mechanism,
        program,
        {name: interval(name, value, "limit") for name, value in mapping(limits, "The limits").items()},
        as_span(t_span, forward=True),
        {name: finite(name, value, "start value") for name, value in mapping(start, "The start values").items()},
        guess,
        mapping(parameters, "The parameters"),
    )

    @functools.cache
    def attempt(factor):
        try:
            return scene.slowed(factor)
        finally:
            bar.update()

    with progress_bar("fastest", progress, unit=" motions") as bar:
        quick, slow = _bracket(attempt)
        factor = brentq(lambda sigma: min(attempt(sigma)[0], 1.0) + BELOW, quick, slow, rtol=BELOW / 10)
    excess, binding, slower, plan = attempt(factor)
    if not abs(excess) < REACHED:
        raise LimitExceeded(
            f"No motion exists below the factor {factor:.6g}, and none above it reaches a limit.",
            "The fastest time law reaches a limit.",
            nearest=f"Limits that are reached between the factors {factor:.6g} and {slow:g}.",
            do="Pass tighter limits, or choose a factor yourself (Program.slowed).",
            factor=factor,
            slow=slow,
        )
    return TimeLaw(factor, slower, judged(plan), binding)


@dataclass(frozen=True)
class _Scene:
    """A program, its span and start, and the limits of its signals."""

    mechanism: Mechanism
    program: Program
    limits: dict
    t_span: tuple
    start: dict
    guess: dict
    parameters: dict

    def __post_init__(self):
        if not self.limits:
            raise SpecificationError(
                "There are no limits.", "The fastest time law reaches a limit.", do='Pass some, as {"trolley": 100.0}.'
            )
        require_kind(Mechanism, "mechanism", self.mechanism, "sv.Mechanism(q, gibbs, ...)")
        require_kind(Program, "program", self.program, "sv.Program({...})")

    def slowed(self, factor):
        """(largest excess, binding, program, plan) of a time law; the excess is infinite if there is no motion."""
        t0, t1 = self.t_span
        slower = self.program.slowed(self.mechanism.q, factor, at=t0)
        try:
            model = derived(self.mechanism, slower, self.guess)
            model = model.with_parameters(**self.parameters) if self.parameters else model
            values = {name: value / factor ** _level(model, name) for name, value in self.start.items()}
            start = model.start(t0, guess=self.guess, **values)
            plan = simulated(model, start, (t0, t0 + (t1 - t0) * factor), progress=False)
        except (SingularProgram, InconsistentStart, IntegrationStopped):
            return np.inf, ("", "", t0), slower, None
        return *_worst(plan, self.limits), slower, plan


def _bracket(attempt):
    """A factor that exceeds a limit, and the double of it, which keeps all."""
    factor = 1.0
    step = 2.0 if attempt(factor)[0] > -BELOW else 0.5
    for _ in range(REACH):
        before, factor = factor, factor * step
        if (attempt(factor)[0] > -BELOW) != (step > 1):
            return min(before, factor), max(before, factor)
    raise _unreached(factor) if step < 1 else _exceeded(attempt(factor), factor)


def _worst(plan, limits):
    """Largest excess over the limits, relative to their size, and its (signal, side, instant)."""
    excesses = []
    for name, (low, high) in limits.items():
        (t_low, least), (t_high, most) = plan.extrema(name)
        size = max(abs(v) for v in (low, high) if np.isfinite(v)) or max(abs(least), abs(most)) or 1.0
        excesses += [((low - least) / size, (name, "lower", t_low)), ((most - high) / size, (name, "upper", t_high))]
    return max(excesses)


def _level(model, name):
    """Order of the derivative of a name."""
    nq, n = model.nq, model.n
    return 0 if name not in model.jet_names[nq:] else 1 + (model.jet_names.index(name) - nq) // n


def _unreached(factor):
    return SpecificationError(
        f"No limit is reached even {1 / factor:g} times as fast as the program.",
        "The fastest time law reaches a limit.",
        do="Pass limits of the actuators that the motion uses.",
        factor=factor,
    )


def _exceeded(last, factor):
    _, (name, side, t), _, plan = last
    reached = "no motion exists" if plan is None else f"{name} still exceeds its {side} limit at t = {t:.5g} s"
    return LimitExceeded(
        f"{factor:g} times slower, {reached}.",
        "Slowing reduces accelerations, not static loads.",
        nearest="" if plan is None else f"{name} within {' .. '.join(f'{v:.6g}' for _, v in plan.extrema(name))}.",
        do="Pass limits that hold the mechanism at rest, or choose another path.",
        name=name,
        factor=factor,
    )
