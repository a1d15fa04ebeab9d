"""From a model and a start to a run."""

from dataclasses import replace

import numpy as np

from servoctl.checks import as_span, is_number, is_whole
from servoctl.errors import InconsistentStart, SpecificationError, unknown
from servoctl.methods.accuracy import accurate
from servoctl.methods.adaptive import METHODS, ONE_STEP, Adaptive
from servoctl.methods.algebraic import algebraic
from servoctl.methods.bounds import row_poles, warn_many_steps
from servoctl.methods.drift import Minimal, Poles, Project, as_drift
from servoctl.methods.minimal import require_minimal
from servoctl.methods.radau import RADAU_ORDERS, RadauMethod
from servoctl.methods.runge_kutta import fixed_step
from servoctl.methods.sundials import MULTISTEP, SundialsMethod
from servoctl.methods.tableaus import ORDERS
from servoctl.methods.taylor import SeriesMethod
from servoctl.progress import Progress
from servoctl.run import Run

SAMPLES = 1001  # of a run unless t_eval says otherwise: smooth curves, and extrema refined to rounding
MOST_STEPS = 10**8  # of fixed length: more would fill the memory with samples
OFF = 1e-5  # of a start: residuals relative to their gradients times the state, above which it is no start
EXPLICIT = ("RK23", "RK45", "DOP853")  # and adaptive
FLOORED, FLOOR = (*ONE_STEP, "BDF"), 100 * np.finfo(float).eps  # least rtol of scipy's methods but LSODA
ALL_METHODS = ("algebraic", "Taylor", "RadauIIA", *ORDERS, *METHODS, *MULTISTEP)


def simulate(
    model,
    start,
    t_span,
    method=None,
    *,
    drift=None,
    accuracy=None,
    rtol=None,
    atol=None,
    step=None,
    t_eval=None,
    order=None,
    jets=None,
    progress=None,
):
    """Simulate the motion that a program prescribes.

    Main arguments

    Parameters
    ----------
    model : Model
    start : State or (n_x,) array
        From `model.start`.
    t_span : (t0, t1)
        [s]; t1 < t0 runs backwards.
    method : {"algebraic", "Taylor", "RadauIIA", "RK1", ..., "RK8", "DOP853", ..., "Radau", ..., "CVODES", "IDAS"}
        Default: "algebraic" where the program determines the motion completely (Σ o_a = 0: a Newton solve at each
        instant, no integration), else "DOP853". "Taylor" takes compiled series steps, the most accurate; "RadauIIA"
        compiled implicit ones, for stiff scenes; "RK1" to "RK8" are compiled with a fixed step; "CVODES" and "IDAS"
        are those of SUNDIALS, IDAS on the rows before elimination; the others are scipy's.
    drift : None, "project", "minimal", float, `project(...)` or `poles(...)`, optional
        Treatment of constraint drift; a number is the time constant of the error dynamics [s]. "minimal" integrates
        as many values as the program leaves free and solves the others: exact, in Python, at many times the cost.
    accuracy : float, optional
        Largest error of the motion, relative to each component's size, in place of method, drift and settings: they
        follow from it (`servoctl.methods.accuracy`), and the error is measured.

    Other arguments

    rtol, atol : float
        Tolerances of adaptive methods. The defaults, 1e-9 and 1e-11, keep residuals near 1e-9 over tens of seconds.
    step : float, optional
        Step of the fixed-step methods [s]; default (t1 - t0)/2000, shortened so that steps end at the knots of paths.
        "RadauIIA" takes fixed steps if it is given. Steps that do not resolve the motion are warned about.
    t_eval : (N,) array, optional
        Times of the samples [s], within t_span. Default: 1001 instants and the knots; all steps of fixed-step methods.
    order : int, optional
        Order of "Taylor", or of "RadauIIA" (5, 9 or 13); default: that of least work for rtol.
    jets : int, optional
        Highest derivative in the samples, for "Taylor": `run["d4theta"]`; default s̄. With more than s̄ rates of the
        actuation follow: `run["dtrolley"]`.
    progress : bool or callable, optional
        Show a bar; default: on a terminal, after a second. Or a function of the time reached [s], which may raise.

    Returns
    -------
    Run
        Ctrl-C returns what was computed, with `success` False.

    Raises
    ------
    SingularProgram, IntegrationStopped
        Where the motion ends; `.run` holds what was computed.
    LimitExceeded
        Where the accuracy is out of reach.
    InconsistentStart
        For a start off the constraints, unless the treatment of drift leads back.
    SpecificationError
        For arguments that do not go together, or a path that is not smooth enough.
    """
    if accuracy is not None:
        _alone(accuracy, method=method, drift=drift, rtol=rtol, atol=atol, step=step, order=order)
        same = {"t_eval": t_eval, "jets": jets, "progress": progress}
        return accurate(lambda **options: simulate(model, start, t_span, **options, **same), model, accuracy)
    return _simulated(model, start, as_span(t_span), method, drift, rtol, atol, step, t_eval, order, jets, progress)


def _simulated(model, start, span, method, drift, rtol, atol, step, t_eval, order, jets, progress):
    t0, t1 = span
    method = _method(model, method)
    drift = _drift(model, drift, method)
    if isinstance(drift, Poles):
        _require_decay(model, drift, t0, t1)
        if method in EXPLICIT:
            warn_many_steps(method, row_poles(drift, model), t1 - t0)
    _refuse_idle(method, step, order, jets, rtol, atol)
    leads_back = method == "algebraic" or isinstance(drift, (Poles, Project))
    x0 = (as_state if leads_back else consistent_state)(model, start, t0)
    knots = model.require_smooth((min(t0, t1), max(t0, t1)))
    times = _times(t0, t1, t_eval, knots)
    rtol, atol = _tolerance("rtol", rtol, 1e-9), _tolerance("atol", atol, 1e-11)
    if method in FLOORED and rtol < FLOOR:
        raise SpecificationError(
            f"rtol={rtol:g} was given with method={method!r}.",
            f"scipy's methods take {FLOOR:.3g} instead of less.",
            nearest=f"rtol={1.01 * FLOOR:.3g}; method='Taylor' has no such limit.",
            do="Change one of them.",
        )
    bar = Progress((t0, t1), progress)
    try:
        if method == "algebraic":
            motion = algebraic(model, t0, x0, times, bar)
        elif method == "Taylor":
            motion = SeriesMethod(model, drift, rtol, atol, order, jets or 0, bar).run(t0, x0, t1, times, knots)
        elif method == "RadauIIA":
            fixed = None if step is None else _step(step, t0, t1)
            motion = RadauMethod(model, drift, rtol, atol, order, fixed, bar).run(t0, x0, t1, times, knots)
        elif method in MULTISTEP:
            motion = SundialsMethod(model, method, drift, rtol, atol, t1 - t0, bar).run(t0, x0, t1, times, knots)
        elif method in ORDERS:
            motion = fixed_step(model, method, drift, (t0, t1), x0, _step(step, t0, t1), knots, bar)
        else:
            motion = Adaptive(model, method, drift, rtol, atol, bar).run(t0, x0, t1, times, knots)
    finally:
        bar.close()
    return _finish(model, motion, method, drift, knots, (t0, x0, t1), None if t_eval is None else times)


def _finish(model, motion, method, drift, knots, span, wanted):
    if not motion.pieces:
        motion.add(model, [span[0]], span[1][:, None], np.full((model.n, 1), np.nan))
    t, jets, variants = motion.samples()
    last = f"t = {t[-1]:.7g} s"
    if motion.stop is not None:
        status, message = -1, f"stopped: {str(motion.stop).split('. ')[0]}"
    elif motion.interrupted:
        status, message = 1, f"interrupted at {last} of {span[2]:g} s; what was computed is kept"
    else:
        status, message = 0, "finished"
    told = {"method": method, "drift": str(drift or ""), "counters": motion.counters, "knots": knots}
    told |= {"success": status == 0, "status": status, "message": message, "variants": tuple(variants)}
    run = Run(t, jets, model.names_to(len(jets)), model, **told)
    if wanted is not None and method in ORDERS:
        run = _resample(run, wanted)
    if motion.stop is not None:
        motion.stop.run = run
        raise motion.stop
    return run


def _resample(run, times):
    low, high = min(run.t[0], run.t[-1]), max(run.t[0], run.t[-1])
    times = times[(times >= low) & (times <= high)]
    owner = [run.variant(int(np.argmin(np.abs(run.t - t)))) for t in times]
    variants = tuple((i, i + 1, model) for i, model in enumerate(owner)) if len(run.variants) > 1 else run.variants[:1]
    variants = tuple((0, len(times), v[2]) for v in variants) if len(variants) == 1 else variants
    return replace(run, t=times, jets=np.array([run.at(t) for t in times]).T, variants=variants)


def _method(model, method):
    if method is None:
        return "algebraic" if model.flat else "DOP853"
    if method not in ALL_METHODS:
        raise unknown(method, ALL_METHODS, "method")
    if method == "algebraic" and not model.flat:
        raise SpecificationError(
            "method='algebraic' was given.",
            f"The program leaves {model.free} initial values free: an internal dynamics remains to be integrated.",
            nearest="'DOP853'.",
            do="Leave the method out.",
            free=model.free,
        )
    return method


def _drift(model, given, method):
    drift = as_drift(given)
    if isinstance(drift, Minimal):
        require_minimal(model, method, (*ORDERS, *ONE_STEP))
    elif drift is not None and method == "algebraic":
        raise SpecificationError(
            f"drift={given!r} was given with method='algebraic'.",
            "Where every instant is solved for itself nothing drifts.",
            nearest="drift=None, or an integrating method such as 'DOP853'.",
            do="Leave one of them out.",
        )
    if isinstance(drift, Poles) and method == "Taylor":
        raise SpecificationError(
            f"drift={given!r} was given with method='Taylor'.",
            "The series are those of the undisturbed rows; error dynamics would need series of their own.",
            nearest="drift='project', which keeps residuals at rounding.",
            do="Project, or take another method.",
        )
    if isinstance(drift, Project) and method in (*METHODS, *MULTISTEP) and method not in ONE_STEP:
        raise SpecificationError(
            f"drift={given!r} was given with method={method!r}.",
            "A multistep method carries past states, which projection would contradict.",
            nearest=f"One of {', '.join(('Taylor', 'RadauIIA', 'RK4', *ONE_STEP))}, or poles.",
            do="Change one of them.",
        )
    return drift


def _require_decay(model, drift, t0, t1):
    """Refuse poles that amplify in the direction of time."""
    drift.coefficients(model)  # refuses poles that do not fit the rows
    for row, values in row_poles(drift, model).items():
        if np.any(np.real(values) * (t1 - t0) > 0):
            way, sign = ("forward", "negative") if t1 > t0 else ("backwards", "positive")
            raise SpecificationError(
                f"drift={drift} was given with a span that runs {way}: {row!r} has poles {np.asarray(values)} 1/s.",
                "Error dynamics that decay forward in time grow backward, and the other way round.",
                nearest=f"drift='project'; or poles by row with {sign} real parts.",
                do="Change one of them.",
                row=row,
            )


def _alone(accuracy, **given):
    """Refuse what the rule for an accuracy chooses itself."""
    given = {name: value for name, value in given.items() if value is not None}
    if given:
        raise SpecificationError(
            f"accuracy={accuracy!r} was given with {', '.join(f'{name}={value!r}' for name, value in given.items())}.",
            "An accuracy determines the method, its setting and the treatment of drift.",
            nearest="sv.tradeoff measures what each method reaches.",
            do="Leave one of them out.",
            **given,
        )


def _refuse_idle(method, step, order, jets, rtol, atol):
    """Refuse options that the method would not use: nothing asked for is ignored."""
    orders = ("Taylor", "RadauIIA")
    adaptive = tuple(name for name in ALL_METHODS if name not in ("algebraic", *ORDERS))
    used = [("step", step, (*ORDERS, "RadauIIA")), ("order", order, orders), ("jets", jets, orders[:1])]
    for name, value, users in (*used, ("rtol", rtol, adaptive), ("atol", atol, adaptive)):
        if value is not None and method not in users:
            raise SpecificationError(
                f"{name}={value!r} was given with method={method!r}.",
                f"It belongs to {', '.join(users)}.",
                nearest=f"method={users[0]!r}.",
                do=f"Leave {name} out.",
            )
    if method == "RadauIIA" and order is not None and order not in RADAU_ORDERS:
        raise SpecificationError(
            f"order={order!r} was given with method='RadauIIA'.",
            f"It has the orders {', '.join(map(str, RADAU_ORDERS))}.",
            do="Give one of them, or leave order out.",
        )
    for name, value, low in (("order", order, 2), ("jets", jets, 1)):
        if value is not None and not (is_whole(value) and low <= value <= 40):
            raise SpecificationError(
                f"{name}={value!r} was given.", f"It is a whole number from {low} to 40.", do="Give 12."
            )


def as_state(model, start, t0):
    """The state X (n_x,) that a start gives at t0."""
    try:
        values = np.asarray(start if isinstance(start, dict) else getattr(start, "values", start), dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (len(model.state_names),) or not np.all(np.isfinite(values)):
        raise SpecificationError(
            f"The start has the shape {values.shape}.",
            f"A state of this model has {len(model.state_names)} finite entries: {', '.join(model.state_names)}.",
            do="Make it by model.start(...).",
        )
    t = getattr(start, "t", t0)
    if abs(t - t0) > 1e-12 * max(1.0, abs(t0)):
        raise SpecificationError(
            f"The start is consistent at t = {t:g} s, the span begins at {t0:g} s.",
            "A start satisfies the constraints at the first instant.",
            do=f"Use model.start(t={t0:g}, ...).",
        )
    return values


def consistent_state(model, start, t):
    """The same, refused off the constraints: without a treatment that leads back, the whole motion would be off."""
    x = as_state(model, start, t)
    names = [name for _, name in model.invariant_names()]
    y = model.function("invariants")(t, x, model.parameters)
    values, slopes = y[: len(names)], y[len(names) :].reshape(len(x), len(names)).T
    sizes = np.sqrt((slopes**2 * (1.0 + np.abs(x)) ** 2).sum(axis=1))
    off = np.nan_to_num(np.abs(values) / np.where(sizes > 0, sizes, 1.0))
    if off.max(initial=0.0) > OFF:
        worst = int(np.argmax(off))
        raise InconsistentStart(
            f"The start leaves the residual {values[worst]:.3g} of {names[worst]!r}.",
            "A start satisfies every constraint at every level; what is off at the start stays off.",
            nearest="drift='project', which moves it onto the constraints; error dynamics lead back, too.",
            do="Make it by model.start(guess={...}).",
            invariant=names[worst],
            residual=float(values[worst]),
        )
    return x


def _times(t0, t1, t_eval, knots):
    if t_eval is None:
        times = np.union1d(np.linspace(t0, t1, SAMPLES), [k for k in knots if min(t0, t1) < k < max(t0, t1)])
    else:
        try:
            times = np.unique(np.asarray(t_eval, dtype=float))
        except (TypeError, ValueError):
            times = np.array([np.nan])
        if not np.all(np.isfinite(times)):
            raise SpecificationError(
                f"t_eval={t_eval!r} was given.", "It is a sequence of finite times [s].", do="Give [0.0, 0.5, 1.0]."
            )
        if not times.size or times[0] < min(t0, t1) - 1e-12 or times[-1] > max(t0, t1) + 1e-12:
            raise SpecificationError(
                "t_eval lies outside t_span or is empty.", "Samples are taken within the span.", do="Extend t_span."
            )
    return times if t1 > t0 else times[::-1]


def _step(step, t0, t1):
    if step is None:
        return abs(t1 - t0) / 2000
    if not (is_number(step) and step > 0):
        raise SpecificationError(
            f"step={step!r} was given.", "A step is a positive number of seconds.", do="Give 1e-3."
        )
    if abs(t1 - t0) > MOST_STEPS * step:
        raise SpecificationError(
            f"step={step!r} was given for a span of {abs(t1 - t0):g} s.",
            f"At most {MOST_STEPS:,} steps fit into memory, each of them a sample.",
            nearest=f"step={abs(t1 - t0) / MOST_STEPS:.2g}.",
            do="Take a longer step, an adaptive method, or several spans.",
            step=float(step),
        )
    return float(step)


def _tolerance(name, value, usual):
    if value is None:
        return usual
    if not (is_number(value) and 0 < value <= 1):
        raise SpecificationError(
            f"{name}={value!r} was given.", "A tolerance is a positive number, at most 1.", do=f"Give {usual:g}."
        )
    return float(value)
