"""From a model and a start to a run."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from servoctl.checks import as_numbers, as_span, within
from servoctl.codegen.compiler import fixed
from servoctl.dense import up_to
from servoctl.errors import InconsistentStart, ServoError, SpecificationError, warn
from servoctl.growth import STEP_ERROR, internal_dynamics, quiet
from servoctl.methods.accuracy import (
    ATOL,
    absolute_tolerances,
    accurate,
    large_tolerances,
    unlike_tolerances,
)
from servoctl.methods.algebraic import algebraic
from servoctl.methods.bounded import bounded
from servoctl.methods.choice import (
    EXPLICIT,
    Adaptive,
    Algebraic,
    Bounded,
    Method,
    Poles,
    Project,
    RadauIIA,
    RungeKutta,
    Taylor,
    as_drift,
    as_method,
    default_method,
    require_combination,
)
from servoctl.methods.events import Event, Events, as_events, occurrences
from servoctl.methods.motion import DEFAULT_SAMPLES, breakpoints, margin_at, without_interruption
from servoctl.methods.radau import RadauSteps
from servoctl.methods.runge_kutta import RungeKuttaSteps
from servoctl.methods.scipy_methods import ScipySteps
from servoctl.methods.sizes import sizes_of, state_levels
from servoctl.methods.stability import run_checked, warn_drifted, warn_many_steps, warn_unstable
from servoctl.methods.taylor import TaylorSteps, Unsuited
from servoctl.methods.transient import first_transient
from servoctl.model.equations import invariant_names
from servoctl.model.following import SMOOTHER, breaks_within
from servoctl.model.jets import extended, jet_names_to, with_highest
from servoctl.model.model import Model, including
from servoctl.model.start import State
from servoctl.model.switching import switching
from servoctl.plants.driven import driven
from servoctl.plants.plant import Plant
from servoctl.progress import Progress
from servoctl.reduction.idle import names_of
from servoctl.run import SAME_TIME, Run

STEPS_IN_SPAN = 2000  # steps of fixed length in a span if the method has no step
MOST_STEPS = 10**8  # of fixed length: more would fill the memory with samples
MOST_ENDS = 10**6  # of steps that `max_step` asks for: more would fill the memory
OFF = 1e-5  # residual relative to its gradient times the state, above which a start is inconsistent, and a run says so
DRIFTED = 1e-2  # the same at the end of a motion that deserves a warning


def simulate(
    model: Model | Plant,
    start: State | ArrayLike | Mapping[str, float],
    t_span: Sequence[float],
    method: Method | str | None = None,
    *,
    inputs: Mapping[str, object] | None = None,
    drift: Project | Poles | str | float | None = None,
    accuracy: float | None = None,
    max_step: float | None = None,
    t_eval: ArrayLike | None = None,
    events: Mapping[str, object] | Sequence[object] | Event | Callable[..., float] | str | None = None,
    progress: bool | Callable[[float], object] | None = None,
    compiled: bool | None = None,
) -> Run:
    """Simulate the motion that a program prescribes, or that of a plant under inputs.

    Main arguments

    Parameters
    ----------
    model : Model or Plant
    start : State, (n_x,) array or dict of str to float
        From `model.start`; for a plant (q, γ'), also by name.
    t_span : (t0, t1)
        [s]; t1 < t0 runs backwards.
    method : Algebraic, Taylor, RadauIIA, RungeKutta, Adaptive, or a short form, optional
        A method with its settings, such as `sv.methods.Taylor(jets=3)` or `sv.methods.RungeKutta(4, step=1e-3)`, or the
        short form of a method with its defaults: "algebraic", "Taylor", "RadauIIA", "RK4", "RK8", or scipy's names.
        Default: "algebraic" (a Newton solve at each instant) if the program determines the motion completely,
        Σ o_a = 0, else "Taylor"; "DOP853" with the treatments of drift that series exclude, and for equations so large
        that making a series takes seconds; "RadauIIA" in place of both where stability limits their steps, or where the
        span takes more than 400 that are not compiled.
    drift : None, "project", float, `sv.methods.Project(...)` or `sv.methods.Poles(...)`, optional
        Treatment of constraint drift. A number is the time constant of the error dynamics [s].
    accuracy : float, optional
        Largest error of the motion, relative to each component's size. It determines method and drift
        (`servoctl.methods.accuracy`), and the error is measured. Only `method=sv.methods.Taylor(jets=3)` may be
        combined with it, for jets.

    Other arguments

    inputs : dict of str to float, Path, SX or callable, optional
        Of a plant, by actuator, default 0: numbers, paths (those of SciPy, too), smooth expressions of `q.t` and of
        references, or functions of `q.t` that return such. They act at once, within the plant's limits of magnitude.
    max_step : float, optional
        The longest step that a method may take [s]. A path is never stepped over, as steps end where its pieces do; a
        formula of `q.t` or of the state that acts for less than a thousandth of the span may be.
    t_eval : (N,) array, optional
        Times of the samples [s], within t_span, or within the window of `Bounded`. Default: 1001 instants and the
        knots; all steps of `RungeKutta`.
    events : Event, dict of str to Event, or a sequence, optional
        Signals whose crossings are located, such as `{"slack": sv.Event("tension", terminal=True, direction=-1)}`. A
        terminal event ends the motion: it is the last sample, `status` is 1 and `message` names it. Names of signals
        stand for their zeros; functions event(t, x) may have SciPy's attributes `terminal` and `direction`.
    progress : bool or callable, optional
        Whether to show a bar; default: on a terminal, after a second. A callable receives the time reached [s]; an
        exception that it raises ends the simulation.
    compiled : bool, optional
        True compiles at once what is not on disk, False takes no compiled code, and no method that is C alone; both
        give the same bits again. By default what is on disk is used, and the rest compiled when the steps so far have
        made up for that.

    Returns
    -------
    Run
        After Ctrl-C it holds what was computed, with `success` False.

    Raises
    ------
    SingularProgram, IntegrationStopped
        If the motion ends early; `.run` holds what was computed.
    LimitExceeded
        If the accuracy is out of reach.
    InconsistentStart
        If the start violates the constraints and the treatment of drift does not correct it.
    SpecificationError
        If method and drift do not go together, or a path is not smooth enough.
    """
    model, start = _model_and_start(model, start, inputs)
    span = as_span(t_span)
    others = {"events": as_events(events), "progress": progress, "max_step": max_step}
    with nullcontext() if compiled is None else fixed(compiled):
        return _with_verdict(model, start, span, (method, drift, accuracy), {"t_eval": t_eval, **others})


def _with_verdict(model, start, span, settings, others):
    """The run of `simulated`, or the most accurate of several, with a verdict on its internal dynamics."""
    method, drift, accuracy = settings

    def attempt(method, drift):
        return simulated(model, start, span, method, drift=drift, **others)

    judging = _has_internal_dynamics(model) and (method is None or as_method(method).forward)
    tolerance = getattr(method, "rtol", STEP_ERROR)
    try:
        run = attempt(method, drift) if accuracy is None else accurate(attempt, model, accuracy, method, drift)
    except ServoError as error:
        if judging and error.run is not None:
            error.run = error.run.with_verdict(partial(_verdict, tolerance=tolerance))
        raise
    if not judging:
        return run
    run = judged(run, tolerance)
    if said := first_transient(run, partial(simulated, model)):
        warn(f"{said}.")
    return run


def simulated(model, start, t_span, method=None, *, drift=None, max_step=None, t_eval=None, events=None, progress=None):
    """The run of `simulate`, without a verdict on its internal dynamics."""
    span = t0, t1 = as_span(t_span)
    method, drift = _method_and_drift(model, method, drift, t0, t1)
    leads_back = isinstance(method, (Algebraic, Bounded)) or isinstance(drift, Poles)
    x0 = as_state(model, start, t0) if leads_back else consistent_state(model, start, t0, isinstance(drift, Project))
    smoother = SMOOTHER if isinstance(method, Algebraic) else method.order if isinstance(method, RungeKutta) else np.inf
    knots = breaks_within(model, span, smoother)
    times = None if isinstance(method, Bounded) and t_eval is None else sample_times(t0, t1, t_eval, knots, method)
    bar, problem = Progress(span, progress), (t0, x0, t1, times, _ends_of_steps(knots, span, max_step, method), events)
    try:
        method, motion = _suited(model, method, drift, problem, bar)
    finally:
        bar.close()

    def finished():
        motion.end_where_undefined(str(method))
        motion.end_where_orders_change()
        started = _as_started(model, start, t0, x0 if motion.start is None else motion.start)
        run = _run(model, motion, (method, drift, knots), started, t1)
        return _resampled(run, times) if t_eval is not None and isinstance(method, RungeKutta) else run

    run = _kept(finished)
    if motion.stop is not None:
        motion.stop.run = run
        raise motion.stop
    if run.success and not model.flat and not motion.drifted <= OFF:
        return _drifted(run)
    return run


def _suited(model, method, drift, problem, bar):
    """The motion and its method, in place of a default that does not suit it."""
    try:
        return method, _tolerant(model, method, drift, problem, bar)
    except Unsuited as unsuited:
        method, motion = _suited(model, unsuited.method, drift, problem, bar)
        if method is unsuited.method:
            motion.say(f"by {method}, since {unsuited}")
        return method, motion


def _ends_of_steps(knots, span, max_step, method):
    """The knots, with as many further instants as steps need to be no longer than `max_step` [s]; None for any."""
    if max_step is None:
        return knots
    if isinstance(method, Bounded):
        raise SpecificationError(
            f"max_step={max_step!r} was given with method='bounded'.",
            "A bounded motion is solved for on a mesh of its own, which is refined until its defect is small.",
            do="Leave it out, or take another method.",
            max_step=max_step,
        )
    length = abs(span[1] - span[0])
    count = np.ceil(length / within("max_step", max_step, least=length / MOST_ENDS, above=0.0))
    return tuple(np.union1d(knots, np.linspace(*span, int(count) + 1)[1:-1]).tolist())


def _kept(finished):
    """The run that a function puts together from a motion: Ctrl-C waits until it is complete."""
    try:
        return finished()
    except KeyboardInterrupt:
        with without_interruption():
            run = finished()
    return _interrupted_at_its_end(run) if run.status == 0 else run


def _method_and_drift(model, method, drift, t0, t1):
    """Method and treatment of drift, which go together over a span [s]."""
    drift = as_drift(drift)
    method = default_method(model, drift) if method is None else as_method(method)
    require_combination(model, method, drift)
    if isinstance(drift, Poles):
        _require_decay(model, drift, t0, t1)
        if str(method) in EXPLICIT:
            warn_many_steps(str(method), drift.by_row(model), t1 - t0)
    return method, drift


def _interrupted_at_its_end(run):
    """A run that is complete, though Ctrl-C came while it was put together or judged."""
    return replace(run, success=False, status=1, message=f"{run.message}; interrupted at its end")


def _drifted(run):
    """A run that says where its last state violates a constraint more than any start may, and warns of much more."""
    model, x = run.variant(len(run.t) - 1), run.jets[: len(run.model.state_names), -1]
    names, values, off = _scaled_residuals(model, run.t[-1], x)
    if off.max(initial=0.0) <= OFF:
        return run
    worst = int(np.argmax(off))
    name, value = names[worst], float(values[worst])
    if off[worst] > DRIFTED:
        warn_drifted(name, value, float(run.t[-1]), run.method)
    return replace(run, message=f"{run.message}; the residual of {name!r} has drifted to {value:.2g}")


def _has_internal_dynamics(model):
    """Whether a program leaves something free; a plant under inputs has no program."""
    return bool(model.reduction.program.residuals) and not model.flat


def judged(run, tolerance=STEP_ERROR):
    """A run that gives the verdict on its internal dynamics when it is read; warns at once if they are unstable.

    Most motions need few propagators, or none, to know that there is nothing to warn of. Whoever interrupts a motion
    does not wait. `tolerance` is the relative error of a step of the run's method.
    """
    later = run.with_verdict(partial(_verdict, tolerance=tolerance))
    try:
        if not run.success or quiet(run):
            return later
        known = later.with_verdict(dict(later.internal))
    except KeyboardInterrupt:
        return _interrupted_at_its_end(later)
    if known.internal["verdict"] == "unstable":
        warn_unstable(known.internal["text"])
    return known


def _verdict(run, tolerance):
    """The verdict on the internal dynamics of a run."""
    return internal_dynamics(run).facts(tolerance)


def _model_and_start(model, start, inputs):
    """The model of a plant under inputs, and its start as an array; a model and its start as they are."""
    if isinstance(model, Plant):
        return driven(model, inputs), start if isinstance(start, State) else model.state(start)
    if not isinstance(model, Model) or inputs is not None:
        given = f"a {type(model).__name__}" + (" and inputs" if inputs is not None else "")
        raise SpecificationError(
            f"simulate received {given}.",
            "It takes a Model, whose program determines the inputs, or a Plant and its inputs.",
            do="Write sv.simulate(sv.derive(mechanism, program), start, t_span), or "
            "sv.simulate(sv.plant(mechanism), x0, t_span, inputs={...}).",
            type=type(model).__name__,
        )
    return including(model, names_of(start)), start


def _tolerant(model, method, drift, problem, bar):
    """Integrate with absolute tolerances that fit the motion: where the default is no small part of it, once more."""
    t0, x0, t1, *_ = problem
    given, series = getattr(method, "atol", 0.0), isinstance(method, Taylor)
    if given is not None and not series:
        return _motion(model, method, drift, problem, bar)
    large = large_tolerances(model, (t0, t1), x0) if given is None else None
    motion = _motion(model, method, drift, problem, bar, large.min() if series and large is not None else large)
    fitting = _fitting_tolerances(model, method, motion, t0)
    if fitting is None:
        return motion
    again = _motion(model, method, drift, problem, bar, fitting)
    return again if again.stop is None or motion.stop is not None else motion


def _motion(model, method, drift, problem, bar, atol=None):
    """Integrate (t0, x0, t1, times, knots, events) by a method; samples are taken at the times (N,), or at all steps.

    `atol` (n_x,) replaces the default of the method.
    """
    t0, x0, t1, times, knots, events = problem
    watched = None if times is None or not events else Events(events, model, t0, t1)
    if isinstance(method, Algebraic):
        return _with_events(algebraic(model, (t0, t1), x0, times, knots, bar, watched), watched)
    if isinstance(method, Bounded):
        watched = Events(events, model, t0, t1) if events else None
        return _with_events(bounded(model, (t0, t1), x0, method, (times, knots), bar, watched), watched)
    family = switching(model)
    if family is not None:
        model = family.at(family.branches(t0, x0))
    stepping = _stepping(model, method, drift, (t0, t1), bar, atol)
    stepping.family, stepping.events = family, watched
    motion = run_checked(stepping, *problem[:5]) if stepping.tolerances is None else stepping.run(*problem[:5])
    return _with_events(motion, watched)


def _with_events(motion, events):
    """The motion with the occurrences of its events up to its end."""
    if events is not None and motion.pieces:
        motion.occurrences = events.until(motion.t[-1])
    return motion


def _stepping(model, method, drift, span, bar, atol):
    """The integration by a method other than `Algebraic`."""
    (t0, t1), least = span, ATOL if atol is None else np.min(atol)
    match method:
        case Taylor():
            return TaylorSteps(model, drift, method, (method.atol or ATOL) if atol is None else atol, bar)
        case RadauIIA(order, step, rtol, given):
            step = None if step is None else _step_length(step, t0, t1)
            return RadauSteps(model, drift, rtol, given or least, order, step, bar)
        case RungeKutta(_, step):
            return RungeKuttaSteps(model, str(method), drift, _step_length(step, t0, t1), bar)
        case Adaptive(name, rtol, given):
            each = least if atol is None else atol
            return ScipySteps(model, name, drift, rtol, given or each, bar, getattr(method, "for_stiff", None))


def _fitting_tolerances(model, method, motion, t0):
    """Absolute tolerances with which a motion from t0 on is computed again, as it does not fit the first; else None."""
    largest = motion.largest
    if motion.interrupted or not motion.pieces or np.ndim(largest) == 0 or not np.isfinite(largest).all():
        return None
    if isinstance(method, RadauIIA) and method.step is not None:
        return None
    t, x = motion.t[-1], motion.jets[: len(model.state_names), -1]
    inertia = model.function("matrices")(t, x, model.p)[-model.n :]
    sizes = sizes_of(model, inertia, largest, t - t0)
    if isinstance(method, Taylor):
        unlike = unlike_tolerances(state_levels(model), largest, sizes, method.atol)
        if unlike is not None or method.atol is not None:
            return unlike
        atol = absolute_tolerances(sizes, method.rtol)
        return atol if atol is None else atol.min()
    return absolute_tolerances(sizes, method.rtol)


def _run(model, motion, settings, start, t1):
    """The run of a motion towards t1 by (method, drift, knots), to its end or its stop."""
    method, drift, knots = settings
    if not motion.pieces:  # interrupted or stopped before the first sample
        motion.add(model, [start.t], start.values[:, None], np.full((model.n, 1), np.nan))
    t, jets = motion.t, motion.jets
    if motion.stop is not None:
        status, message = -1, f"stopped: {str(motion.stop).split('. ')[0]}"
    elif motion.interrupted:
        status, message = 1, f"interrupted at t = {t[-1]:.7g} s of {t1:g} s; what was computed is kept"
    elif motion.ended:
        status, message = 1, f"ended by the event {motion.ended!r} at t = {t[-1]:.9g} s"
    else:
        status, message = 0, "finished"
    message += f"; {motion.note}" if motion.note and motion.stop is None else ""
    facts = {"method": str(method), "drift": str(drift or ""), "counters": motion.counters}
    facts["knots"] = tuple(sorted({*knots, *motion.switches}))
    facts["variants"] = tuple(motion.variants())
    if isinstance(method, Taylor):
        _set_at_knots(t, jets, facts["variants"], knots)
    facts |= {"success": status == 0 or bool(motion.ended), "status": status, "message": message}
    steps = facts["steps"] = tuple(motion.steps if motion.stop is None else up_to(motion.steps, t[-1]))
    found = occurrences(motion.occurrences, partial(jet_names_to, model))
    facts["events"] = {name: replace(at, steps=steps) for name, at in found.items()}
    return Run(t, jets, jet_names_to(model, len(jets)), model, start=start, **facts)


def _set_at_knots(t, jets, variants, knots):
    """Derivatives at knots by the equations at that instant: those of a series are of the side that it comes from."""
    knots = np.sort(knots)
    for first, end, model in variants if len(knots) else ():
        after = np.searchsorted(knots, t[first:end])
        beside = knots[np.clip([after - 1, after], 0, len(knots) - 1)]
        near = np.abs(t[first:end] - beside) <= SAME_TIME * np.maximum(1.0, np.abs(beside))
        at = first + np.flatnonzero(near.any(axis=0))
        if len(at):
            top = len(model.jet_names)
            jets[:top, at] = with_highest(model, t[at], jets[: len(model.state_names), at])
            if len(jets) > top:
                jets[:, at] = extended(model, t[at], jets[:top, at], len(jets))


def _resampled(run, times):
    """The run at those of other times that it reaches, and in any case at the event that ends it."""
    low, high = min(run.t[0], run.t[-1]), max(run.t[0], run.t[-1])
    times = times[(times >= low) & (times <= high)]
    return run.sampled(np.append(times, run.t[-1]) if run.status == 1 and run.t[-1] not in times else times)


def _require_decay(model, drift, t0, t1):
    """Refuse poles that amplify in the direction of time."""
    for row, values in drift.by_row(model).items():
        if np.any(np.real(values) * (t1 - t0) > 0):
            sign = "negative" if t1 > t0 else "positive"
            raise SpecificationError(
                f"The row {row!r} has the poles {np.asarray(values)} 1/s, and t_span is {t0:g} to {t1:g} s.",
                f"In this direction of time error dynamics decay if their poles have {sign} real parts.",
                do="Use drift='project', or poles by row with such real parts.",
                row=row,
                poles=list(values),
                t_span=(t0, t1),
            )


def as_state(model, start, t0):
    """The state X (n_x,) that a start gives at t0."""
    if isinstance(start, Mapping):
        given = ", ".join(f"{name}={value}" for name, value in start.items())
        raise SpecificationError(
            f"The start is a dict of {', '.join(map(repr, start)) or 'nothing'}.",
            "A program determines further values at its start, so that it takes a state that satisfies all of it.",
            do=f"Use model.start({given}), or model.start(guess={{...}}) for values that may change.",
            names=list(start),
        )
    values = as_numbers(getattr(start, "values", start))
    if values.shape != (len(model.state_names),) or not np.all(np.isfinite(values)):
        raise SpecificationError(
            f"The start has the shape {values.shape}.",
            f"A state of this model has {len(model.state_names)} finite entries: {', '.join(model.state_names)}.",
            do="Make it by model.start(...).",
            shape=values.shape,
            names=model.state_names,
        )
    t = getattr(start, "t", t0)
    if abs(t - t0) > SAME_TIME * max(1.0, abs(t0)):
        raise SpecificationError(
            f"The start is consistent at t = {t:g} s, the span begins at {t0:g} s.",
            "Constraints depend on time, so that a start belongs to the first instant of the span.",
            do=f"Use model.start(t={t0:g}, ...).",
            t=t,
            t0=t0,
        )
    return values


def _as_started(model, start, t, x):
    """The state from which a motion was computed: `start`, or what the method has made of it."""
    if isinstance(start, State) and (start.values == x).all():
        return start
    off = np.abs(_scaled_residuals(model, t, x)[2]).max(initial=0.0)
    facts = {"held": start.held, "free": start.free} if isinstance(start, State) else {"held": (), "free": ()}
    return State(float(t), np.array(x), tuple(model.state_names), residual=float(off), **facts)


def _scaled_residuals(model, t, x):
    """Names of the invariants, their values, and these relative to their gradients times the state."""
    names = [name for _, name in invariant_names(model)]
    y = model.function("invariants")(t, x, model.p)
    values, slopes = y[: len(names)], y[len(names) :].reshape(len(x), len(names))
    square = (1.0 + np.abs(x)) ** 2 @ slopes**2
    off = np.abs(values) / np.sqrt(np.where(square > 0, square, 1.0))
    return names, values, np.fmin(np.fmax(off, 0.0), np.finfo(float).max)


def consistent_state(model, start, t, project=False):
    """The state that a start gives, or its projection, which must satisfy the invariants: nothing would lead back."""
    x, before = as_state(model, start, t), np.inf
    while project and (off := np.abs(_scaled_residuals(model, t, x)[2]).max(initial=0.0)) < before:
        x, before = model.function("ode_projected").restore(t, x, model.p), off
    names, values, off = _scaled_residuals(model, t, x)
    if off.max(initial=0.0) > OFF:
        worst = int(np.argmax(off))
        raise InconsistentStart(
            f"The start{' after projection' * project} leaves the residual {values[worst]:.3g} of {names[worst]!r}.",
            "It must satisfy every constraint at every level, or the whole motion violates them.",
            do="Complete it by model.start(guess={...})"
            + ("." if project else ", or use drift='project', which corrects it."),
            invariant=names[worst],
            residual=float(values[worst]),
        )
    return x


def _default_times(t0, t1, knots):
    """Equally spaced instants, with the knots; an instant that differs from a knot by rounding alone is the knot."""
    times, (_, *inside, _) = np.linspace(t0, t1, DEFAULT_SAMPLES), breakpoints((t0, t1), knots)
    for k in inside:
        nearest = round((k - t0) / (t1 - t0) * (DEFAULT_SAMPLES - 1))
        if abs(times[nearest] - k) <= margin_at(k, (t0, t1)):
            times[nearest] = k
    return np.array(sorted({*times.tolist(), *map(float, inside)}))  # np.union1d imports np.ma


def sample_times(t0, t1, t_eval, knots, method=None):
    """The instants of the samples of a motion by a method, in its order; with the knots where none are given."""
    if t_eval is None:
        times = _default_times(t0, t1, knots)
    else:
        times = as_numbers(t_eval)
        if times.ndim != 1 or not (times[1:] > times[:-1]).all():
            times = np.unique(times)
        if times.size and not np.isfinite(times[[0, -1]]).all():  # of ascending ones
            raise SpecificationError(
                f"t_eval={repr(t_eval)[:150]} was given.", "It is a sequence of finite times [s].", t_eval=t_eval
            )
        window = method is not None and isinstance(as_method(method), Bounded)  # which is known with the motion
        low, high = (-np.inf, np.inf) if window else (min(t0, t1), max(t0, t1))
        margin = SAME_TIME * max(1.0, abs(t0), abs(t1))
        if not times.size or times[0] < low - margin or times[-1] > high + margin:
            covered = "is empty"
            if times.size:
                beyond = max(low - times[0], times[-1] - high)
                covered = f"covers {times[0]:g} to {times[-1]:g} s, up to {beyond:.2g} s beyond t_span"
            raise SpecificationError(
                f"t_eval {covered}.",
                f"Samples lie within t_span, {min(t0, t1):g} to {max(t0, t1):g} s.",
                t_eval=t_eval,
                t_span=(t0, t1),
            )
        if times[0] < low or times[-1] > high:  # by rounding
            times = np.unique(np.clip(times, low, high))
    return times if t1 > t0 else times[::-1]


def _step_length(step, t0, t1):
    if step is None:
        return abs(t1 - t0) / STEPS_IN_SPAN
    if abs(t1 - t0) > MOST_STEPS * step:
        raise SpecificationError(
            f"step={step!r} was given for a span of {abs(t1 - t0):g} s.",
            f"Each step is a sample, and at most {MOST_STEPS:,} fit into memory.",
            nearest=f"step={abs(t1 - t0) / MOST_STEPS:.2g}.",
            do="Take a longer step, an adaptive method, or several spans.",
            step=step,
            span=abs(t1 - t0),
        )
    return step
