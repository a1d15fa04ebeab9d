"""The inverse of a program, chosen by its verdict."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from servoctl.checks import as_span, interval, mapping, numbers_by_name, positive_number, require_kind
from servoctl.errors import IntegrationStopped, ServoError, SingularProgram, SpecificationError, unknown
from servoctl.inversion.relaxed import relaxed
from servoctl.inversion.report import extremes
from servoctl.inversion.verdict import (
    FLAT,
    GROWS,
    HYPERBOLIC_ZEROS,
    MARGINAL,
    MINIMUM,
    OPEN,
    SINGULAR,
    Verdict,
    verdict,
)
from servoctl.methods.choice import Algebraic, Bounded, Method, as_method
from servoctl.model.model import derive
from servoctl.model.start import State
from servoctl.plants.plant import plant
from servoctl.reduction.idle import names_of, needed
from servoctl.run import Run
from servoctl.simulation import as_state, simulate
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.program import Program

RELAXED = "relaxed"  # the word for the inverse that is no method of `simulate`
END_MOVES = "; its end is free, as the program moves there"
DWELL = "Add a dwell before and after the path (a longer t_span)"
REMEDIES = {
    MARGINAL: f"{DWELL}, or take the exact forward plan by method='DOP853', whose internal motion goes on after it.",
    GROWS: f"{DWELL}.",
    OPEN: "Begin and end the program with a dwell, or pass a start=... nearer to its bounded motion.",
}  # of a relaxed plan that misses its program, by verdict
MISS = 1e-3  # of the stroke of a residual, by which a plan misses it with a warning


def inverse(
    mechanism: Mechanism, program: Program, t_span: Sequence[float], *,
    start: State | Mapping[str, float] | None = None, method: Method | str | None = None,
    limits: Mapping[str, object] | None = None, bounds: Mapping[str, object] | None = None,
    weight: float | Mapping[str, float] | None = None,
) -> Run:  # fmt: skip
    """The motion and the actuation of a program by the inverse that its verdict allows.

    Flat programs are solved instant by instant, minimum-phase ones are integrated forward, hyperbolic ones get the
    bounded motion (`Bounded`), and marginal ones, those singular at rest, rough paths and limits that the exact plan
    exceeds the relaxed one (`relaxed`), which rests at both ends unless the program moves there. The message of the run
    says which, and why.

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
    t_span : (t0, t1)
        [s]; the bounded motion begins before and ends after it.
    start : State or dict of str to float, optional
        A state of the model, or values near the start by name. Default: near zero. Motions that may begin at rest do.
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
        Of the relaxed inverse; default: 1e-6 of that for which standing still costs as much as the program.

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
        If a method is given that is not the one of the verdict, or a relaxed plan misses the program by more than a
        thousandth of what its residual moves.
    """
    require_kind(Mechanism, "mechanism", mechanism, "sv.Mechanism(q, gibbs, ...)")
    require_kind(Program, "program", program, "sv.Program({...})")
    span, ranges = as_span(t_span, forward=True), _ranges(mechanism, limits, bounds)
    mechanism = needed(mechanism, program, named=[*names_of(start), *ranges[0], *ranges[1]])
    task = Task(mechanism, program, span, start, ranges, _checked(weight, program))
    known = None if isinstance(start, State) else mapping(start, "The start")
    by_hand = method if method is None or isinstance(method, str) and method == RELAXED else as_method(method)
    try:
        model = derive(mechanism, program, known)
    except SpecificationError as error:
        facts = error.details
        if by_hand not in (None, RELAXED) or not {"needs", "has"} <= facts.keys():
            raise
        rough = f"{facts['name']} has class C^{facts['has']}, and the exact inverse needs {facts['needs']}"
        return _measured(task.relaxed(rough), program, "")
    begin = _begin(model, start, span[0])
    found = verdict(model, begin)
    chosen = _chosen(model, found)
    if by_hand is not None:
        return _measured(_by_hand(task, model, begin, found, chosen, by_hand), program, found.dynamics)
    return _measured(task.run(model, begin, found, chosen), program, found.dynamics)


@dataclass(frozen=True)
class Task:
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
            if model.ideal:
                raise
            run = getattr(error, "run", None)
            judged = found if run is None else verdict(model, run)
            if judged.dynamics == GROWS:
                return self.relaxed(judged, begin, moving=True)
            if not (ranges and isinstance(error, SingularProgram)):
                raise
            # as at a rope without tension, which a bound excludes
            return self.relaxed(f"the exact plan ends: {str(error).split('; ')[0]}", begin)
        excess = _excess(run, ranges)
        if excess:
            return self.relaxed(excess, begin)
        if found.dynamics == OPEN or run.internal.get("verdict") == "unstable":
            found = verdict(model, run)
        if found.dynamics != GROWS:
            return _told(run, found)
        if not model.ideal:
            return self.relaxed(found, begin, moving=True)
        warnings.warn(f"An ideal program has no other inverse, and this is {found}.", RuntimeWarning, stacklevel=3)
        return _told(run, found)

    def exact(self, model, begin, found, method):
        """The run of an exact inverse; integrated forward from the rest where the program begins, if there is one."""
        if not isinstance(self.start, State) and (begin is None or method is None and "start" in found.rest):
            rest = found.rest["start"].x.tolist() if "start" in found.rest else ()
            guess = dict(zip(model.state_names, rest, strict=False)) or _of_states(model, self.start or {})
            begin = model.start(self.span[0], guess=guess)  # or the error that tells why there is no start
        with warnings.catch_warnings():  # growth is part of the verdict
            warnings.filterwarnings("ignore", "Internal dynamics unstable")
            return simulate(model, begin, self.span, method)

    def relaxed(self, why, begin=None, moving=False):
        """The run of the relaxed inverse: from rest to rest, and free where the program moves.

        `moving` says that it begins in motion, with the state `begin`.
        """
        tries = [] if moving else [({"start": self.start}, ""), ({"start": self.start, "end": "free"}, END_MOVES)]
        tries += [({"start": begin, "end": "free"}, END_MOVES)] if begin is not None else []
        limits, bounds = self.ranges
        for k, (ends, note) in enumerate(tries):
            try:
                run = relaxed(
                    plant(self.mechanism), self.program, self.span, weight=self.weight, limits=limits, bounds=bounds,
                    **ends,
                )  # fmt: skip
            except SpecificationError as error:
                if "rate" not in error.details or k + 1 == len(tries):
                    raise
            except IntegrationStopped as error:
                if not moving:
                    raise
                raise _no_plan(why, error) from error
            else:
                return _told(run, why, note)


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
    for name in mapping(limits, "The limits"):
        if name not in actuators:
            raise unknown(name, actuators, "actuator or rate")
    return tuple(
        {name: interval(name, value, what) for name, value in mapping(values, f"The {what}s").items()}
        for values, what in ((limits, "limit"), (bounds, "bound"))
    )


def _checked(weight, program):
    """A weight, or weights by residual, that are positive."""
    if isinstance(weight, Mapping):
        return numbers_by_name(weight, program.names, "residual", "weight", positive=True)
    return None if weight is None else positive_number("weight", weight)


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


def _chosen(model, found):
    """The method of the exact inverse, None for the default of `simulate`, or `RELAXED`."""
    if found.dynamics == HYPERBOLIC_ZEROS:
        return Bounded()
    relaxes = found.dynamics in (MARGINAL, SINGULAR, GROWS) and not model.ideal
    return RELAXED if relaxes else None


def _by_hand(task, model, begin, found, chosen, method):
    """The run of a method that was given, with a warning if the verdict speaks against it."""
    expected = {FLAT: Algebraic, MINIMUM: Method}.get(found.dynamics, Bounded if isinstance(chosen, Bounded) else ())
    fits = method == RELAXED or isinstance(method, expected)
    if not fits:
        warnings.warn(
            f"method={str(method)!r} was chosen for a program that is {found}. sv.inverse without method takes "
            f"{'the bounded motion' if isinstance(chosen, Bounded) else 'the relaxed inverse'}.",
            RuntimeWarning,
            stacklevel=3,
        )
    if method == RELAXED:
        return task.relaxed(found)
    run = task.exact(model, begin, found, method)
    excess = _excess(run, {**task.ranges[0], **task.ranges[1]})
    if excess:
        warnings.warn(f"method={str(method)!r} was chosen, and {excess}.", RuntimeWarning, stacklevel=3)
    return _told(run, found)


def _excess(run, ranges):
    """What of a run lies beyond its ranges, in words; "" if nothing does."""
    for name, (low, high) in ranges.items():
        for value, t in extremes(run, name):
            if not low <= value <= high:
                limit = low if value < low else high
                return f"the exact plan needs {name} = {value:.6g} at t = {t:.4g} s, and the limit is {limit:g}"
    return ""


def _told(run, why, note=""):
    """The run, whose message says which inverse it is and why."""
    kind = {"algebraic": "instant by instant", "bounded": "bounded", RELAXED: "relaxed"}.get(run.method, "forward")
    reason = f"the program is {why.word} ({why.reason})" if isinstance(why, Verdict) else why
    return replace(run, message=f"{run.message}; inverse: {kind}, as {reason}{note}")


def _measured(run, program, dynamics):
    """The run, with a warning if it is a relaxed plan that misses its program."""
    if run.method != RELAXED:
        return run
    largest = {name: float(np.abs(run.residual[name][0]).max()) for name in program.names}
    strokes = {name: _stroke(run, program.residuals[name]) for name in largest}
    usual = max(strokes.values())
    parts = {name: largest[name] / (stroke or usual) for name, stroke in strokes.items() if stroke or usual}
    if not parts:
        return run
    name = max(parts, key=parts.get)
    if parts[name] <= MISS:
        return run
    missed = f"the plan misses {name} by {largest[name]:.3g}, {100 * parts[name]:.2g} % of its stroke"
    do = REMEDIES.get(dynamics, "Allow more time or wider limits, or a smaller weight.")
    warnings.warn(f"{missed[0].upper()}{missed[1:]}. {do}", RuntimeWarning, stacklevel=3)
    return replace(run, message=f"{run.message}; {missed}")


def _stroke(run, residual):
    """How far time moves a residual at the first state of a run."""
    q = run.model.reduction.mechanism.q
    orders = range(max(q.order(residual), 0) + 1)
    names = [name for k in orders for name in q.jet_names(k)]
    jets = [run[name][0] if name in run.jet_names else 0.0 for name in names]
    symbols = ca.vertcat(*run.model.reduction.mechanism.parameters.symbols)
    f = ca.Function("residual", [q.t, ca.vertcat(*(q.jet(k) for k in orders)), symbols], [residual])
    return float(np.ptp([float(f(t, jets, run.model.parameters)) for t in run.t]))
