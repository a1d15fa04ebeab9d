"""The inverse of a program, chosen by its verdict."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from servoctl.checks import as_span, by_name, interval, mapping, require_kind
from servoctl.control.extremes import excesses
from servoctl.errors import (
    InconsistentStart,
    IntegrationStopped,
    ServoError,
    SingularProgram,
    SpecificationError,
    warn,
)
from servoctl.inversion.relaxed import relaxed, weights_of
from servoctl.inversion.transfer import Near, rests
from servoctl.inversion.verdict import (
    FLAT,
    GROWS,
    HYPERBOLIC_ZEROS,
    MARGINAL,
    MINIMUM,
    OPEN,
    RELAXED,
    UNDETERMINED,
    Verdict,
    chosen_by,
    verdict,
    verdict_with,
)
from servoctl.methods.choice import Algebraic, Bounded, Method, as_method
from servoctl.model.following import breaks_within
from servoctl.model.model import derive
from servoctl.model.start import State
from servoctl.plants.plant import plant
from servoctl.reduction.idle import names_of, needed
from servoctl.run import Run
from servoctl.simulation import as_state, simulate
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.program import Program
from servoctl.spec.references import required_paths
from servoctl.values import frozen
from servoctl.verification.remarks import path

END_MOVES = "; its end is open, as the program moves there"
END_SWINGS = "; its end is open, as modes on the imaginary axis swing on"
DWELL = "Add a dwell before and after the path (a longer t_span)"
REMEDIES = {
    MARGINAL: f"{DWELL}, or take the exact forward plan, which swings on after it, by leaving method and weight out.",
    GROWS: f"{DWELL}.",
    OPEN: "Begin and end the program with a dwell, or pass a start=... nearer to its bounded motion.",
}  # of a relaxed plan that misses its program, by verdict
MISS = 1e-3  # of the stroke of a residual, by which a plan misses it with a warning
SWINGS_ON = 1e-3  # speed at the end relative to the largest one, with which a forward plan warns that it goes on


def inverse(
    mechanism: Mechanism,
    program: Program,
    t_span: Sequence[float],
    *,
    start: State | Mapping[str, float] | None = None,
    method: Method | str | None = None,
    limits: Mapping[str, object] | None = None,
    bounds: Mapping[str, object] | None = None,
    weight: float | Mapping[str, float] | None = None,
) -> Run:
    """The motion and the actuation of a program by the inverse that its verdict allows.

    Flat programs are solved instant by instant, minimum-phase and marginal ones are integrated forward, hyperbolic ones
    get the bounded motion (`Bounded`), and those singular at rest, rough paths and limits that the exact plan exceeds
    the relaxed one (`relaxed`), which rests at both ends unless the program moves there. The message of the run says
    which, and why.

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
    t_span : (t0, t1)
        [s]; the bounded motion begins before and ends after it.
    start : State or dict of str to float, optional
        A state of the model, or values near the start by name. Motions that may begin at rest do;
        relaxed plans that begin in motion begin on their bounded motion, near values by name.
    method : Method or str, optional
        A method of `simulate`, or "relaxed", instead of the one that the verdict chooses; where it is another one, a
        warning says what speaks against it.
    limits : dict of str to float or (low, high), optional
        Limits of actuators and of their rates, {"trolley": 100.0, "dtrolley": 500.0}. An exact plan beyond them is
        replaced by the relaxed one.
    bounds : dict of str to float or (low, high), optional
        Bounds of other signals, such as {"tension": (0, None)}, likewise. With limits or bounds, an exact plan that
        reaches a singular state is replaced, too.
    weight : float or dict of str to float, optional
        Of the relaxed inverse, which a marginal program then gets; default: 1e-6 of that for which standing still costs
        as much as the program.

    Returns
    -------
    Run

    Raises
    ------
    NotRealisable
        If no actuation can realise the program.
    SpecificationError, SingularProgram, IntegrationStopped, LimitExceeded
        As by `derive`, `simulate` and `relaxed`.

    Warns
    -----
    RuntimeWarning
        If a method is given that is not the one of the verdict, a relaxed plan misses the program by more than a
        thousandth of what its residual moves, or the internal motion of a marginal program goes on after the path.
    """
    require_kind(Mechanism, "mechanism", mechanism, "sv.Mechanism(q, gibbs, ...)")
    require_kind(Program, "program", program, "sv.Program({...})")
    span, ranges = as_span(t_span, forward=True), _ranges(mechanism, limits, bounds)
    mechanism = needed(mechanism, program, named=[*names_of(start), *ranges[0], *ranges[1]])
    weights_of(weight, program)  # refused now, whether it will be needed or not
    request = Request(mechanism, program, span, start, ranges, weight)
    known = None if isinstance(start, State) else mapping(start, "The start")
    by_hand = method if method is None or isinstance(method, str) and method == RELAXED else as_method(method)
    try:
        model = derive(mechanism, program, known)
        required_paths(model.paths)
        breaks_within(model, span)
    except SpecificationError as error:
        facts = error.details
        if by_hand not in (None, RELAXED) or not {"needs", "has"} <= facts.keys():
            raise
        rough = f"{facts['name']} has class C^{facts['has']}, and the exact inverse needs {facts['needs']}"
        return _measured(request.relaxed(rough), program, "")
    begin = _begin(model, start, span[0])
    found = verdict(model, begin)
    chosen = chosen_by(model, found, weight is not None)
    if by_hand is not None:
        return _measured(_by_hand(request, model, begin, found, chosen, by_hand), program, found.dynamics)
    return _measured(request.run(model, begin, found, chosen), program, found.dynamics)


@frozen
class Request:
    """What `inverse` received; `ranges` are limits and bounds, {signal: (low, high)} each."""

    mechanism: Mechanism
    program: Program
    span: tuple
    start: object
    ranges: tuple
    weight: object

    def run(self, model, begin, found, chosen):
        """The run by the method that the verdict chooses; the relaxed one where that is beyond limits or grows."""
        if chosen == RELAXED:
            return self.relaxed(found, begin)
        ranges = {**self.ranges[0], **self.ranges[1]}
        try:
            run = self.exact(model, begin, found, chosen)
        except (IntegrationStopped, SingularProgram) as error:
            if model.reduction.ideal:
                raise
            run = getattr(error, "run", None)
            after = found if run is None else verdict(model, run)
            if after.dynamics in (GROWS, HYPERBOLIC_ZEROS):
                return self.relaxed(after, begin, moving=True)
            if not (ranges and isinstance(error, SingularProgram)):
                raise
            # as at a rope without tension, which a bound excludes
            return self.relaxed(f"the exact plan ends: {str(error).split('; ')[0]}", begin)
        excess = _excess(run, ranges)
        if excess:
            return self.relaxed(excess, begin)
        after = verdict_with(model, found, run)
        if after.dynamics == GROWS and not model.reduction.ideal:
            return self.relaxed(after, begin, moving=found.dynamics != MARGINAL)
        if after.dynamics == GROWS:
            warn(f"An ideal program has no other inverse, and this is {after}.")
        return _with_reason(run, after)

    def exact(self, model, begin, found, method):
        """The run of an exact inverse; integrated forward from the rest where the program begins, if there is one."""
        if not isinstance(self.start, State) and (begin is None or method is None and "start" in found.rest):
            rest = found.rest["start"].x.tolist() if "start" in found.rest else ()
            guess = dict(zip(model.state_names, rest, strict=False)) or _of_states(model, self.start or {})
            begin = model.start(self.span[0], guess=guess)  # or the error that says why there is no start
        with warnings.catch_warnings():  # growth is part of the verdict
            warnings.filterwarnings("ignore", "Internal dynamics unstable")
            return simulate(model, begin, self.span, method)

    def relaxed(self, why, begin=None, moving=False):
        """The run of the relaxed inverse: from rest to rest, and with open ends where the program moves.

        `moving` says that it begins in motion, with the state `begin`, or near it where values by name were given.
        """
        swings = isinstance(why, Verdict) and why.dynamics == GROWS and why.swings
        tries = [({}, ""), ({"end": "bounded"}, END_MOVES)] if not swings else [({"end": "bounded"}, END_SWINGS)]
        tries = [] if moving else [({"start": self.start} | ends, note) for ends, note in tries]
        near = begin if isinstance(self.start, State) else Near(begin)
        tries += [({"start": near, "end": "bounded"}, END_MOVES)] if begin is not None else []
        for k, (ends, note) in enumerate(tries):
            try:
                run = self._planned(**ends)
            except SpecificationError as error:
                if "rate" not in error.details or k + 1 == len(tries):
                    raise
            except IntegrationStopped as error:
                if not moving:
                    raise
                raise _no_plan(why, error) from error
            else:
                return _with_reason(run, why, note)

    def _planned(self, start, **end):
        """The relaxed plan; from the rest near values of coordinates, where there is none with exactly these."""
        limits, bounds = self.ranges
        full, q = plant(self.mechanism), self.mechanism.q
        if isinstance(start, Mapping) and not {*full.state_names} <= {*start}:
            start = {name: value for name, value in start.items() if name in q.names}  # a rest is near these
        options = {"weight": self.weight, "limits": limits, "bounds": bounds, **end}
        try:
            return relaxed(full, self.program, self.span, start=start, **options)
        except InconsistentStart:
            some, numbers = rests(full, self.program)
            near = some.nearest(self.span[0], numbers, start)[0] if isinstance(start, Mapping) else []
            if not near:
                raise
            start = dict(zip(q.names, near[0].tolist(), strict=False))
            return relaxed(full, self.program, self.span, start=start, **options)


def _no_plan(why, error):
    return IntegrationStopped(
        f"The program is {why}, and the iteration of the relaxed inverse failed: {str(error).split('; ')[0]}.",
        "Motions that grow are not integrated forward.",
        do="Begin and end the program with a dwell, take a shorter span, or another start.",
        **error.details | {"verdict": why.word},
    )


def _ranges(mechanism, limits, bounds):
    """Limits of actuators and their rates, and bounds of other signals, {name: (low, high)} each."""
    actuators = [*mechanism.actuators, *(f"d{name}" for name in mechanism.actuators)]
    limits = by_name(limits, actuators, "actuator or rate", "The limits")
    return tuple(
        {name: interval(name, value, what) for name, value in mapping(values, f"The {what}s").items()}
        for values, what in ((limits, "limit"), (bounds, "bound"))
    )


def _begin(model, start, t):
    """The given start, or one near its values; None where there is none, as at a singular rest."""
    if isinstance(start, State):
        as_state(model, start, t)
        return start
    try:
        return model.start(t, guess=_of_states(model, start or {}))
    except ServoError:
        return None


def _of_states(model, known):
    """Those of the known values that are states of the model."""
    return {name: value for name, value in known.items() if name in model.state_names}


def _by_hand(request, model, begin, found, chosen, method):
    """The run of a method that was given, with a warning if the verdict speaks against it."""
    expected = {FLAT: Algebraic, MINIMUM: Method, MARGINAL: Method, HYPERBOLIC_ZEROS: Bounded}.get(found.dynamics, ())
    fits = method == RELAXED or isinstance(method, expected)
    if not fits:
        warn(
            f"method={str(method)!r} was chosen for a program that is {found}. sv.inverse without method takes "
            f"{'the bounded motion' if isinstance(chosen, Bounded) else 'the relaxed inverse'}."
        )
    if method == RELAXED:
        return request.relaxed(found, begin)
    run = request.exact(model, begin, found, method)
    excess = _excess(run, {**request.ranges[0], **request.ranges[1]})
    if excess:
        warn(f"method={str(method)!r} was chosen, and {excess}.")
    return _with_reason(run, found)


def _excess(run, ranges):
    """What of a run lies beyond its ranges, in words; "" if nothing does."""
    if not ranges:
        return ""
    excess, name, _, t, value, limit = max(excesses(run, ranges))
    beyond = f"the exact plan needs {name} = {value:.6g} at t = {t:.4g} s, and the limit is {limit:g}"
    return beyond if excess > 0 else ""


def _with_reason(run, why, note=""):
    """The run, whose message says which inverse it is and why."""
    kind = {"algebraic": "instant by instant", "bounded": "bounded", RELAXED: "relaxed"}.get(run.method, "forward")
    reason = why
    if isinstance(why, Verdict):
        grown = "" if why.rest or why.word == UNDETERMINED or not why.growth else f"; {why.growth}"
        reason = f"the program is {why.word} ({why.reason}{grown})"
    if kind == "forward" and isinstance(why, Verdict) and why.dynamics == MARGINAL and "end" in why.rest:
        note += _swinging(run)
    return replace(run, message=f"{run.message}; inverse: {kind}, as {reason}{note}")


def _swinging(run):
    """What of the motion goes on where the program rests, for the message and with a warning; "" if nothing does."""
    q = run.model.reduction.mechanism.q
    speeds = {name: run[name] for name in q.jet_names(1)}
    largest = {name: np.abs(values).max() for name, values in speeds.items()}
    least = SWINGS_ON * max(largest.values())  # those below are rounding
    parts = {name: abs(speeds[name][-1]) / size for name, size in largest.items() if size > least}
    name = max(parts, key=parts.get, default=None)
    if name is None or parts[name] <= SWINGS_ON:
        return ""
    what = f"the internal motion goes on after it, with {name} = {speeds[name][-1]:.3g} at t = {run.t[-1]:.4g} s"
    do = "" if run.model.reduction.ideal else " method='relaxed' rests at both ends, as near to the program as that is."
    warn(f"The program is marginal, and {what}.{do}")
    return f"; {what}"


def _measured(run, program, dynamics):
    """The run, with a warning if it is a relaxed plan that misses its program."""
    if run.method != RELAXED:
        return run
    largest = {name: float(np.abs(run.residual[name][0]).max()) for name in program.names}
    strokes = {name: path(run, program.residuals[name])[0] for name in largest}
    usual = max(strokes.values())
    parts = {name: largest[name] / (stroke or usual) for name, stroke in strokes.items() if stroke or usual}
    if not parts:
        return run
    name = max(parts, key=parts.get)
    if parts[name] <= MISS:
        return run
    missed = f"the plan misses {name} by {largest[name]:.3g}, {100 * parts[name]:.2g} % of its stroke"
    do = REMEDIES.get(dynamics, "Allow more time or wider limits, or a smaller weight.")
    warn(f"{missed[0].upper()}{missed[1:]}. {do}")
    return replace(run, message=f"{run.message}; {missed}")
