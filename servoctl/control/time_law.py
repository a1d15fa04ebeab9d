"""The fastest time law of a program that its actuators can follow."""

import functools
from dataclasses import dataclass

import numpy as np

from servoctl.checks import as_span, interval, mapping
from servoctl.errors import InconsistentStart, IntegrationStopped, LimitExceeded, SingularProgram, SpecificationError
from servoctl.model.model import derive
from servoctl.progress import progress_bar
from servoctl.run import Run
from servoctl.simulation import simulate
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.program import Program

REACH = 12  # doublings of the time, in which a motion becomes as good as static, or halvings
BELOW = 1e-6  # of a limit: how far below it the fastest time law stays
REACHED = 1e-4  # of a limit: how near the fastest time law comes to it, unless motions cease to exist before


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """A program slowed, or quickened, to where its first limit is reached; made by `fastest`.

    Attributes
    ----------
    factor : float
        How many times as long as given the motion takes.
    program : Program
        The program with this time law.
    plan : Run
        Its motion; every limit holds.
    binding : (str, str, float)
        The signal that reaches its limit, which side ("lower" or "upper"), and when [s].
    """

    factor: float
    program: object
    plan: Run
    binding: tuple

    def __repr__(self):
        name, side, t = self.binding
        how = "slowed" if self.factor > 1 else "quickened"
        return (
            f"TimeLaw: {how} by the factor {self.factor:.6g}; {name} reaches its {side} limit at t = {t:.5g} s\n"
            f"  the motion takes {self.plan.t[0]:g} .. {self.plan.t[-1]:.6g} s"
        )


def fastest(
    mechanism: Mechanism,
    program: Program,
    limits: dict,
    t_span: tuple[float, float],
    start: dict[str, float] | None = None,
    guess: dict[str, float] | None = None,
    parameters: dict[str, float] | None = None,
    progress: bool | None = None,
) -> TimeLaw:
    """The fastest time law q(t0 + (t - t0)/σ) under which signals keep their limits, found by solving for σ.

    The motion's geometry stays; speeds go with 1/σ, accelerations with 1/σ². What a limit leaves beside static loads
    decides. Where several σ reach a limit the one next to the given time law, σ = 1, is found.

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
    limits : dict of str to (float, float) or float
        Lower and upper limit of actuators and outputs by name; one number is symmetric. `None` leaves a side open.
    t_span : (t0, t1)
        Of the program as given [s].
    start, guess : dict of str to float, optional
        As for `Model.start`, for the program as given; derivatives that are held are slowed with the motion.
    parameters : dict of str to float, optional
        Other numbers for the mechanism's parameters.
    progress : bool, optional
        Show how many motions were tried; default: on a terminal, for work of more than a second.

    Returns
    -------
    TimeLaw

    Raises
    ------
    LimitExceeded
        If the motion exceeds a limit however slow it is, or does not exist any more where it would reach one.
    SpecificationError
        For limits that are no interval, and a time that does not go forward.
    NameUnknown
        For a limit on something that is no signal of the plan.
    """
    from scipy.optimize import brentq

    scene = _Scene(
        mechanism,
        program,
        {name: interval(name, value, "limit") for name, value in mapping(limits, "The limits").items()},
        as_span(t_span, forward=True),
        mapping(start, "Values of the start"),
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
            f"No motion exists below the factor {factor:.6g}, before it reaches a limit.",
            "A fastest time law is decided by a limit that is reached.",
            nearest=f"Limits that are reached between the factors {factor:.6g} and {slow:g}.",
            do="Give tighter limits, or slow the program by a factor that you choose (Program.slowed).",
            factor=factor,
        )
    return TimeLaw(factor, slower, plan, binding)


@dataclass(frozen=True)
class _Scene:
    """What is slowed: a program, its motion and the limits of its signals."""

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
                "No limits were given.", "A fastest time law is decided by a limit.", do='Give {"trolley": 100.0}.'
            )
        for given, kind in ((self.mechanism, Mechanism), (self.program, Program)):
            if not isinstance(given, kind):
                raise SpecificationError(
                    f"A {type(given).__name__} was given as {kind.__name__.lower()}.",
                    "A mechanism's program is slowed.",
                    do="Write sv.fastest(mechanism, program, ...).",
                )

    def slowed(self, factor):
        """(worst excess, binding, program, plan) of a time law; an infinite excess where there is no motion."""
        t0, t1 = self.t_span
        slower = self.program.slowed(self.mechanism.q, factor, at=t0)
        try:
            model = derive(self.mechanism, slower, self.guess)
            model = model.with_parameters(**self.parameters) if self.parameters else model
            held = {name: value / factor ** _level(model, name) for name, value in self.start.items()}
            start = model.start(t0, guess=self.guess, **held)
            plan = simulate(model, start, (t0, t0 + (t1 - t0) * factor), progress=False)
        except (SingularProgram, InconsistentStart, IntegrationStopped):
            return np.inf, ("", "", t0), slower, None
        return *_worst(plan, self.limits), slower, plan


def _bracket(attempt):
    """A factor at which a limit is exceeded, and the double of it, at which all are kept."""
    factor = 1.0
    step = 2.0 if attempt(factor)[0] > -BELOW else 0.5
    for _ in range(REACH):
        before, factor = factor, factor * step
        if (attempt(factor)[0] > -BELOW) != (step > 1):
            return min(before, factor), max(before, factor)
    _refuse(attempt(factor), factor, step)


def _worst(plan, limits):
    """Largest excess over the limits, relative to their size, and where it is."""
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


def _refuse(last, factor, step):
    excess, (name, side, t), _, plan = last
    if step < 1:
        raise SpecificationError(
            f"No limit is reached even {1 / factor:g} times as fast as given.",
            "A fastest time law is decided by a limit.",
            do="Give limits of the actuators that the motion uses.",
        )
    reached = "no motion exists" if plan is None else f"{name} still exceeds its {side} limit at t = {t:.5g} s"
    raise LimitExceeded(
        f"{factor:g} times slower, {reached}.",
        "Slowing reduces what accelerations ask for, not static loads.",
        nearest="" if plan is None else f"{name} within {' .. '.join(f'{v:.6g}' for _, v in plan.extrema(name))}.",
        do="Give limits that hold the mechanism at rest, or another path.",
        name=name,
        factor=factor,
    )
