"""The fastest time law of a program that its actuators can follow."""

import functools
from collections.abc import Mapping
from dataclasses import field
from typing import Any

import numpy as np

from servoctl.checks import as_span, finite, interval, mapping, require_kind
from servoctl.control.extremes import excesses, extremes
from servoctl.control.time_optimal import Curve, Inverse, Problem, smooth
from servoctl.errors import (
    InconsistentStart,
    IntegrationStopped,
    LimitExceeded,
    SingularProgram,
    SpecificationError,
    UnstableInternalDynamics,
)
from servoctl.growth import internal_dynamics
from servoctl.model.model import derived
from servoctl.progress import progress_bar
from servoctl.reduction.idle import names_of, needed
from servoctl.run import Run
from servoctl.simulation import judged, simulated
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.paths import rest_to_rest
from servoctl.spec.program import Program
from servoctl.spec.references import orders_in, other_paths, paths_at, required_paths
from servoctl.values import frozen

REACH = 12  # doublings of the time, after which a motion is nearly static, or halvings
BELOW = 1e-6  # of a limit: distance that the fastest time law keeps from it
TIGHTENED, TIGHTER = 5, 1.2  # how often a time-optimal law is solved; limits at nodes give way by this many excesses
CURVE_GROWS = (
    "curve",
    "A time-optimal law by the exact inverse is for programs that are flat or minimum phase.",
    "Use sv.relaxed(plant, program, t_span, limits=...) for a given duration, or choose another output.",
)  # where errors grow, the rule, and what to do
REACHED = 1e-4  # of a limit: largest distance at which it counts as reached


@frozen(eq=False)
class TimeLaw:
    """A program whose time is stretched evenly, or runs by an optimal law, up to a limit; made by `fastest`.

    Attributes
    ----------
    factor : float
        Duration of the motion over that of the original program.
    program : Program
        The program with this time law.
    plan : Run
        Its motion, within all limits.
    paths : dict of str to Path
        Those of the program's references with this time law, as for `Model.with_references`.
    binding : (str, str, float)
        The signal that reaches its limit, the side ("lower" or "upper"), and the instant [s].
    """

    factor: float
    program: Program
    plan: Run
    binding: tuple[str, str, float]
    paths: dict = field(default_factory=dict)

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
    limits: Mapping[str, Any],
    t_span: tuple[float, float],
    start: Mapping[str, float] | None = None,
    guess: Mapping[str, float] | None = None,
    parameters: Mapping[str, float] | None = None,
    shape: bool = False,
) -> TimeLaw:
    """The fastest time law along the path of a program under which signals keep their limits.

    By default the time is stretched evenly, q(t0 + (t - t0)/σ): the geometry of the motion stays; speeds scale with
    1/σ, accelerations with 1/σ²; static loads stay. If several σ reach a limit, the result is the one next to σ = 1.

    With `shape=True` the law s(t) along the path is free, from rest to rest: a local minimum of the duration by the
    exact inverse, for programs that are flat or minimum phase. Its derivative that the actuation contains is
    continuous and linear on 80 intervals, so that actuators change within one of them from limit to limit.

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
        With `shape=True` its residuals contain q and references, without derivatives of these, or are conditions that
        hold at any speed; the references may run along their curve at any pace.
    limits : dict of str to (float, float) or float
        Lower and upper limit of actuators, their rates ("dtrolley") and outputs by name; a number c is (-c, c), None
        leaves a side open.
    t_span : (t0, t1)
        Span of the original program [s].
    start, guess : dict of str to float, optional
        As for `Model.start`, for the original program; derivatives in `start` are scaled with the motion.
    parameters : dict of str to float, optional
        Parameters of the mechanism that differ from their defaults.
    shape : bool, optional
        Whether the law along the path is free; default: only its duration is.

    Returns
    -------
    TimeLaw

    Raises
    ------
    LimitExceeded
        If even a nearly static motion exceeds a limit, or motions cease to exist before one is reached.
    SpecificationError
        For limits that are no interval, and a span that does not go forward; with `shape=True` for a program that is
        no curve, or turns sharply.
    UnstableInternalDynamics
        With `shape=True`, if what the program leaves free is unstable.
    IntegrationStopped
        If the optimisation with `shape=True` finds no minimum.
    NameUnknown
        For a limit of an unknown signal.
    """
    return fastest_along(None, mechanism, program, limits, t_span, (start, guess, parameters, shape))


def fastest_along(paths, mechanism, program, limits, t_span, options):
    """The same along paths of the program's references by name; None for those with which they were made.

    The options are start, guess, parameters and shape.
    """
    start, guess, parameters, shape = options
    require_kind(Mechanism, "mechanism", mechanism, "sv.Mechanism(q, gibbs, ...)")
    require_kind(Program, "program", program, "sv.Program({...})")
    limits = mapping(limits, "The limits")
    if not limits:
        raise SpecificationError(
            "There are no limits.", "The fastest time law reaches a limit.", do='Pass some, as {"trolley": 100.0}.'
        )
    scene = _Scene(
        needed(mechanism, program, named=[name for given in (limits, start, guess) for name in names_of(given)]),
        program,
        {name: interval(name, value, "limit") for name, value in limits.items()},
        as_span(t_span, forward=True),
        {name: finite(name, value, "start value") for name, value in mapping(start, "The start values").items()},
        guess,
        mapping(parameters, "The parameters"),
        paths_of(mechanism, program, paths, mapping(parameters, "The parameters")),
    )
    with progress_bar("fastest", None, unit=" motions") as bar:
        return _optimal(scene, bar) if require_kind(bool, "shape", shape, "shape=True") else _even(scene, bar)


def _even(scene, bar):
    """The time law that is stretched evenly."""
    from scipy.optimize import brentq

    @functools.cache
    def attempt(factor):
        try:
            slower = scene.program.slower(scene.mechanism.q, factor, scene.t_span[0])
            return scene.tried(slower, factor, scene.slower_paths(factor))
        finally:
            bar.update()

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
    return TimeLaw(factor, slower, plan if plan.model.flat else judged(plan), binding, scene.slower_paths(factor))


def _optimal(scene, bar):
    """The time law that is free along the curve: solved within the limits at nodes, and these tightened in between."""
    curve = Curve(scene.mechanism, scene.program, scene.t_span, scene.paths)
    inverse = Inverse(curve, tuple(scene.limits), scene.parameters, scene.guess)
    t0, t1 = scene.t_span

    @functools.cache
    def attempt(factor):
        step = rest_to_rest(0.0, 1.0, (t1 - t0) * factor, smoothness=inverse.order, t_start=t0)
        found = scene.tried(scene.program, factor, curve.paths_along(step, inverse.order))
        bar.update()
        if found[-1] is not None and not found[-1].model.flat:
            require_no_growth(found[-1], *CURVE_GROWS)
        return found

    _, slow = _bracket(attempt)
    law, plan = smooth((t1 - t0) * slow, inverse.order), attempt(slow)[-1]
    limits = np.array([*scene.limits.values()]).T
    sides = limits.copy()
    for _ in range(TIGHTENED):
        law = Problem(inverse, sides, law, plan).solved()
        factor, paths = law.duration / (t1 - t0), curve.paths_along(law.path(t0), inverse.order)
        excess, binding, program, plan = scene.tried(scene.program, factor, paths)
        bar.update()
        if excess <= 0:
            return TimeLaw(factor, program, plan if plan.model.flat else judged(plan), binding, paths)
        if plan is None:
            break
        values = np.array([[value for value, _ in extremes(plan, name)] for name in scene.limits]).T
        sides += TIGHTER * np.clip(limits - values, [[0.0], [-np.inf]], [[np.inf], [0.0]])
        if np.any(sides[0] >= sides[1]):
            break
    raise LimitExceeded(
        f"Between the nodes {binding[0] or 'a signal'} exceeds its limit by {excess:.2g} of it.",
        "A time-optimal law keeps its limits at all instants.",
        do="Add a limit of rates, as {'dtrolley': ...}, or choose shape=False.",
        name=binding[0],
        excess=float(excess),
    )


def paths_of(mechanism, program, given, parameters):
    """The paths of a program's references by name, some of which may be given, with parameters by name."""
    q, known = mechanism.q, mechanism.parameters
    paths = {name: q.family.paths[name] for name in program.references(q)}
    paths = required_paths(other_paths(paths, mapping(given, "The paths")))
    return paths_at(paths, known, known.values(parameters))


@frozen
class _Scene:
    """A program, its span and start, the limits of its signals, and the paths of its references."""

    mechanism: Mechanism
    program: Program
    limits: dict
    t_span: tuple
    start: dict
    guess: dict
    parameters: dict
    paths: dict

    def slower_paths(self, factor):
        """The paths of the program's references along a time that is slowed by a factor, by name."""
        m = self.mechanism
        both = [name for name in orders_in(m.q, [m.balance, m.E, *m.constraints.values()]) if name in self.paths]
        if both:
            raise SpecificationError(
                f"The mechanism and its program both contain {', '.join(both)}.",
                "A time law is that of the program: what moves a mechanism keeps its time.",
                do="Give the program a reference of its own with the same path.",
                references=both,
            )
        return {name: path.at_rate(1 / factor, self.t_span[0]) for name, path in self.paths.items()}

    def tried(self, program, factor, paths):
        """(largest excess, binding, program, plan) of a time law; the excess is infinite if there is no motion."""
        t0, t1 = self.t_span
        try:
            model = derived(self.mechanism, program, self.guess).with_references(**paths)
            model = model.with_parameters(**self.parameters) if self.parameters else model
            values = {name: value / factor ** _level(model, name) for name, value in self.start.items()}
            start = model.start(t0, guess=self.guess, **values)
            plan = simulated(model, start, (t0, t0 + (t1 - t0) * factor), progress=False)
        except (SingularProgram, InconsistentStart, IntegrationStopped):
            return np.inf, ("", "", t0), program, None
        excess, name, side, t, *_ = max(excesses(plan, self.limits))
        return excess, (name, side, t), program, plan


def _bracket(attempt):
    """A factor that exceeds a limit, and the double of it, which keeps all."""
    factor = 1.0
    step = 2.0 if attempt(factor)[0] > -BELOW else 0.5
    for _ in range(REACH):
        before, factor = factor, factor * step
        if (attempt(factor)[0] > -BELOW) != (step > 1):
            return min(before, factor), max(before, factor)
    raise _unreached(factor) if step < 1 else _exceeded(attempt(factor), factor)


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


def require_no_growth(plan, where, rule, do):
    """Refuse a motion along which errors of what the program leaves free grow."""
    internal = internal_dynamics(plan)
    if internal.verdict == "unstable":
        raise UnstableInternalDynamics(
            f"Along the {where} {internal.sentence()}.", rule, do=do, growth=float(internal.growth)
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
