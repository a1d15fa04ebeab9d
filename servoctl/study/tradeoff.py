"""The measured trade: what each method, setting and treatment of drift costs and reaches on a motion."""

import itertools
import time
import warnings

import numpy as np

from servoctl.checks import as_span, is_number, mapping, positive, positives
from servoctl.codegen.function import compiling_at_once
from servoctl.errors import LimitExceeded, ServoError, SpecificationError, unknown
from servoctl.methods.accuracy import motion_error, relative_error
from servoctl.methods.choice import (
    METHODS,
    Adaptive,
    Algebraic,
    MinimalCoordinates,
    Poles,
    Project,
    RungeKutta,
    Taylor,
    as_drift,
    as_method,
)
from servoctl.progress import progress_bar
from servoctl.simulation import consistent_state, simulate
from servoctl.study.table import SHOWN, Study, machine, table

MEASURED = tuple(name for name in METHODS if name not in ("RK1", "RK2", "RK23"))  # those need too many steps
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
STEP_COUNTS = tuple(5 * 4**k for k in range(7))  # of a fixed length, in the span
INSTANTS, COMPARED = 51, 201  # instants that adaptive methods give, and at most so many of any run are compared
DENSE = 1001  # instants of the reference over which its power is integrated
TIMED, ENOUGH = 3, 0.3  # calls timed after a warm-up, unless they take this part of `seconds` together
FEW = 20  # steps: a run that takes too long for fewer has lost its way, and tells nothing of finer settings
TIME_CONSTANT = 50  # of the default poles, in the span
DRIFTS = ("none", "project", "minimal")  # others are time constants of poles
COSTS = ("seconds", "evaluations", "steps")


def tradeoff(model, x0, t_span, methods=None, drift=None, *, settings=None, seconds=0.3, progress=None):
    """Measure error and cost of methods, settings and treatments of drift on one motion.

    The reference is made here: the Taylor method of order 16 at a tolerance of 1e-15, or Newton's method at each
    instant where nothing is integrated. A second method verifies it; their disagreement is the reference's own
    uncertainty, and smaller errors than that are marked as not resolved.

    Main arguments

    Parameters
    ----------
    model : Model
    x0 : State or (n_x,) array
        From `model.start`.
    t_span : (t0, t1)
        [s]
    methods : sequence of str, optional
        Short forms of those that `simulate` has; default: all but "RK1", "RK2" and "RK23".
    drift : sequence, optional
        Treatments as `simulate` takes them; default: None, "project", "minimal" and poles at -50/(t1 - t0).

    Other arguments

    settings : dict of str to sequence of float, optional
        "rtol": tolerances of the adaptive methods, default 1e-3 to 1e-13; atol is a hundredth. "step": steps of the
        methods of fixed step, and spacings of the instants of "algebraic" [s]; default (t1 - t0)/5, and each next one
        a quarter of the one before, down to (t1 - t0)/20,480.
    seconds : float
        That one run may take. One that takes longer is ended, and finer settings are skipped if it had taken more
        than a few steps; their rows say so.
    progress : bool, optional
        Show a progress bar; default: on a terminal, for work of more than a second.

    Returns
    -------
    TradeOff
        Ctrl-C returns the rows measured so far; `meta["message"]` says so.

    Raises
    ------
    ServoError
        Where the reference cannot be had, such as SingularProgram where the motion ends.
    InconsistentStart
        For a start off the constraints: how a treatment leads back is no motion to measure others by.
    SpecificationError
        For settings that are none.
    """
    t0, t1 = as_span(t_span)
    settings = _ladders(mapping(settings, "The settings"), abs(t1 - t0))
    limit = positive("seconds", seconds)
    drifts = (None, "project", "minimal", abs(t1 - t0) / TIME_CONSTANT) if drift is None else drift
    combinations = _combinations(model, methods, drifts if isinstance(drifts, (list, tuple)) else [drifts])
    total = sum(len(settings[_kind(method)]) for method, _ in combinations)
    with compiling_at_once(), progress_bar("tradeoff", progress, total, unit="run") as bar, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of steps outside the stable range: the rows have what they do
        reference, rows, interrupted = Reference(model, x0, (t0, t1), limit), [], False
        try:
            for method, treatment in combinations:
                for row in _ladder(reference, method, treatment, settings[_kind(method)], limit):
                    rows.append(row)
                    bar.update()
        except KeyboardInterrupt:
            interrupted = True
    columns = {name: [row.get(name) for row in rows] for name in TradeOff.COLUMNS}
    meta = {"t_span": [t0, t1], "seconds": limit, "reference": reference.agreement, "machine": machine()}
    meta |= {"message": "interrupted" if interrupted else "", "measured": time.strftime("%Y-%m-%d")}
    return TradeOff("tradeoff", columns, meta)


class Recommendation(dict):
    """Arguments of `simulate`, and in `row` what was measured with them; made by `TradeOff.recommend`.

    `sv.simulate(model, x0, t_span, **study.recommend(error=1e-6))`
    """

    def __init__(self, options, row):
        super().__init__(options)
        self.row = row


class TradeOff(Study):
    """Errors and costs of methods, settings and treatments of drift on one motion; made by `tradeoff`.

    Columns: method; drift ("none", "project", "minimal", or the time constant of the poles in s); setting ("rtol" or
    "step") and its value; error of the motion: the largest deviation from the reference over all instants and
    components of the state, each relative to its largest magnitude (at least 1e-3 of the largest of its level);
    actuation: the same of the required forces and moments; residual: the largest of any constraint at any level, in
    its unit; energy: energy gained less the work done along the reference, relative to the largest energy; power:
    dE/dt less the power of all forces, relative (NaN where it does not apply); evaluations of the right-hand side, or
    of the series, or Newton steps; steps; seconds: the shortest call after a warm-up, with 51 samples by methods that
    find their steps (more samples take longer), and one at each instant or step by the others; resolved: whether the
    error exceeds the reference's own uncertainty; failure: why there is no number.
    """

    COLUMNS = (
        "method", "drift", "setting", "value", "error", "actuation", "residual", "energy", "power", "evaluations",
        "steps", "seconds", "resolved", "failure",
    )  # fmt: skip

    @property
    def uncertainty(self):
        """How far the reference and the method that verified it agree on the motion."""
        return self.meta["reference"]["error"]

    def pareto(self, cost="seconds"):
        """The rows that no other beats in both error and cost, from cheap to accurate.

        Errors below the reference's uncertainty count as equal to it.

        Parameters
        ----------
        cost : {"seconds", "evaluations", "steps"}

        Returns
        -------
        TradeOff
        """
        good, error = self._good(), self._errors()
        front, best = [], np.inf
        for i in good[np.lexsort((error[good], self.column(_cost(cost))[good]))]:
            if error[i] < best:
                front.append(i)
                best = error[i]
        return self.take(front)

    def recommend(self, *, error=None, seconds=None):
        """What to give to `simulate`: the fastest within an error, or the most accurate within a time.

        Parameters
        ----------
        error : float, optional
            Largest error of the motion, relative.
        seconds : float, optional
            Longest time of a call [s], on the machine that measured.

        Returns
        -------
        Recommendation
            A dict of arguments; `.row` has what was measured.

        Raises
        ------
        SpecificationError
            Unless one of the two is given.
        LimitExceeded
            Where nothing reaches it; the message names the nearest that does.
        """
        if (error is None) == (seconds is None):
            raise SpecificationError(
                f"error={error!r} and seconds={seconds!r} were given.",
                "A recommendation answers one question: the fastest within an error, or the best within a time.",
                do="Give recommend(error=1e-6) or recommend(seconds=1e-3).",
            )
        wanted, limit = ("error", error) if seconds is None else ("seconds", seconds)
        if not (is_number(limit) and limit > 0):
            raise SpecificationError(
                f"{wanted}={limit!r} was given.", f"{wanted} is a positive number.", do="Give 1e-6.", **{wanted: limit}
            )
        front = self.pareto()
        reached = front._errors() if wanted == "error" else front["seconds"]
        within = np.flatnonzero(reached <= limit)
        if not len(within):
            raise self._out_of_reach(wanted, limit, front)
        row = front.rows()[within[0] if wanted == "error" else within[-1]]
        return Recommendation(_arguments(row), row)

    def _out_of_reach(self, wanted, limit, front):
        nearest = ""
        if len(front):
            row = front.rows()[-1 if wanted == "error" else 0]
            best = max(row["error"], self.uncertainty)
            nearest = f"{_name(row)}: error {best:.2g} in {row['seconds']:.2g} s"
        rule = f"The reference is itself certain to {self.uncertainty:.1g} only" if wanted == "error" else ""
        return LimitExceeded(
            f"{wanted}={limit:g} was given, which no setting that was measured reaches"
            + ("." if len(front) else ": every run failed, see the column failure."),
            rule or "A recommendation is one of the settings that were measured.",
            nearest=nearest,
            do="Raise it, or measure other methods and settings by tradeoff(...).",
            limit=limit,
            uncertainty=self.uncertainty,
        )

    def plot(self, ax=None, cost="seconds", title=""):
        """Draw the work-precision diagram: error of the motion over cost, a line for each method and treatment.

        Parameters
        ----------
        ax : Axes, optional
        cost : {"seconds", "evaluations", "steps"}
        title : str

        Returns
        -------
        Axes
        """
        from servoctl.figures.work_precision import draw_tradeoff

        return draw_tradeoff(self, ax, _cost(cost), title)

    def _good(self):
        return np.flatnonzero(np.isfinite(self["error"]) & np.isfinite(self["seconds"]))

    def _errors(self):
        """Errors, those below the reference's uncertainty raised to it."""
        return np.maximum(self["error"], self.uncertainty)

    def __repr__(self):
        t0, t1 = self.meta["t_span"]
        reference, where = self.meta["reference"], self.meta["machine"]
        front = self.pareto()
        shown = np.unique(np.linspace(0, len(front) - 1, min(SHOWN, len(front))).round().astype(int))
        lines = [
            f"Trade-off: {len(self)} rows, {len(self) - len(self._good())} without numbers; t = {t0:g} .. {t1:g} s"
            + ("; interrupted" if self.meta.get("message") else ""),
            f"  reference: {reference['method']}; {reference['verified by']} agrees to {reference['error']:.1e}, "
            f"actuation to {reference['actuation']:.1e}",
            f"  on {where['processor']}, {where['cores']} cores, compiler {where['compiler']}",
            f"  fastest for each error, {len(shown)} of {len(front)}:" if len(front) else "  every run failed",
        ]
        names = ("method", "drift", "setting", "value", "error", "actuation", "evaluations", "seconds")
        return "\n".join([*lines, *table(front.take(shown), names, SHOWN)])


# --- the reference


class Reference:
    """The motion against which others are measured, at any instants.

    `agreement` has its method, the one that verified it (which may take ten times `seconds`), and how far they agree.
    """

    def __init__(self, model, x0, t_span, seconds):
        consistent_state(model, x0, t_span[0])
        self.model, self.start, self.span, self._known = model, x0, t_span, {}
        self.knots = [k for k in model.require_smooth((min(t_span), max(t_span))) if min(t_span) < k < max(t_span)]
        self.times = np.union1d(np.linspace(*t_span, INSTANTS), self.knots)
        checks = [Adaptive("DOP853", 3e-14, 1e-15), Taylor(12, rtol=1e-14, atol=1e-14)]
        self.method, self.drift = Taylor(16, rtol=1e-15, atol=1e-15), Project()
        if model.flat:
            self.method, self.drift, checks = Algebraic(), None, checks[::-1]
        self.agreement = self._verified(checks, seconds)

    def _verified(self, checks, seconds):
        """The agreement with the first other method that comes to the end in time."""
        exact = self.at(self.times)
        dense = np.union1d(np.linspace(*self.span, DENSE), self.knots)
        for method in checks:
            options = {"drift": Project(), "t_eval": self.times, "progress": Deadline(10 * seconds)}
            try:
                run = _whole(simulate(self.model, self.start, self.span, method, **options))
            except ServoError as error:
                failure = error
                continue
            return {
                "method": _said(self.method),
                "verified by": _said(method),
                "error": motion_error(self.model, run.jets, exact.jets),
                "actuation": relative_error(actuation(run), actuation(exact)),
                "energy": _energy_balance(self.at(dense), self.knots),
            }
        raise failure

    def at(self, times):
        """The run with samples at these times (N,) [s]."""
        key = times.tobytes()
        if key not in self._known:
            run = simulate(self.model, self.start, self.span, self.method, drift=self.drift, t_eval=times)
            self._known[key] = _whole(run)
        return self._known[key]


class Deadline:
    """What `simulate` takes as progress to end a run that takes more than some seconds from its first step on."""

    def __init__(self, seconds):
        self.seconds, self.since, self.steps = seconds, None, 0

    def __call__(self, t):
        """Raise LimitExceeded where the time is over."""
        now = time.perf_counter()
        self.since, self.steps = self.since or now, self.steps + 1
        if now - self.since > self.seconds:
            late = f"More than {self.seconds:g} s: ended at t = {t:.4g} s"
            raise LimitExceeded(late, seconds=self.seconds, steps=self.steps)


def _whole(run):
    """A run to its end; one that Ctrl-C ended is no measurement, and ends the study."""
    if not run.success:
        raise KeyboardInterrupt
    return run


def actuation(run):
    """Forces and moments that realise the program, of actuators or of the ideal reaction, (n, N)."""
    return run.signals("inputs")[1]


# --- one run


def _ladder(reference, method, treatment, settings, seconds):
    """A row for each setting, from coarse to fine, until they are too slow or as exact as the reference."""
    over, name = "", _kind(method)
    for value in sorted(settings, reverse=True):
        row = {"method": method, "drift": _drift_word(treatment), "setting": name, "value": value, "failure": over}
        if not over:
            try:
                row |= _errors_and_cost(reference, method, treatment, value, seconds)
                if not row["resolved"]:
                    over = f"skipped: {name} = {value:g} reaches what the reference is certain to"
                elif row["seconds"] > seconds:
                    over = f"skipped: {name} = {value:g} took {row['seconds']:.2g} s, more than {seconds:g} s"
            except SpecificationError as error:  # no setting makes sense of this combination: one row says so
                yield row | {"value": np.nan, "failure": str(error)}
                return
            except ServoError as error:
                row["failure"] = f"{type(error).__name__}: {error}"
                if error.details.get("steps", 0) > FEW:
                    over = f"skipped: {name} = {value:g} took more than {seconds:g} s"
        yield row


def _errors_and_cost(reference, name, treatment, value, seconds):
    """Errors, counts and time of one setting."""
    model, (t0, t1) = reference.model, reference.span
    method, times = method_at(name, value), reference.times
    if isinstance(method, Algebraic):
        times = np.union1d(np.linspace(t0, t1, 1 + round(abs(t1 - t0) / value)), reference.knots)
    elif isinstance(method, RungeKutta):
        times = None

    def once():
        options = {"drift": treatment, "t_eval": times, "progress": Deadline(seconds)}
        return _whole(simulate(model, reference.start, reference.span, method, **options))

    run, timed = once(), []
    for _ in range(TIMED):
        since = time.perf_counter()
        once()
        timed.append(time.perf_counter() - since)
        if sum(timed) > ENOUGH * seconds:
            break
    return _errors(reference, run) | {
        "evaluations": run.counters.get("nfev", run.counters.get("iterations", 0)),
        "steps": run.counters.get("steps", len(run.t)),
        "seconds": min(timed),
    }


def _errors(reference, run):
    some = np.unique(np.linspace(0, len(run.t) - 1, COMPARED).round().astype(int))
    exact = reference.at(np.sort(run.t[some]))
    error = motion_error(reference.model, run.jets[:, some], exact.jets)
    rate, work, size, law = run.signals("power")[1]
    largest = max(np.abs(size).max(), np.abs(rate).max(), 1e-300)
    lawful = np.abs(law).max() < 1e-9 * largest
    energy, exact_energy = run["energy"][some], exact["energy"]
    drifted = np.abs((energy - energy[0]) - (exact_energy - exact_energy[0])).max()
    return {
        "error": error,
        "actuation": relative_error(actuation(run)[:, some], actuation(exact)),
        "residual": max((float(np.abs(levels).max(initial=0.0)) for levels in run.residual.values()), default=0.0),
        "energy": float(drifted / max(np.abs(exact_energy).max(), 1e-300)),
        "power": float(np.abs(rate - work).max() / largest) if lawful else np.nan,
        "resolved": bool(error >= reference.agreement["error"]),
    }


def _energy_balance(run, knots):
    """Largest difference of the energy gained and the work of all forces, relative to the energy (splines)."""
    from scipy.interpolate import make_interp_spline

    order = np.argsort(run.t)
    t, work, energy = run.t[order], run.signals("power")[1][1][order], run["energy"][order]
    gained, cuts = [0.0], [t[0], *knots, t[-1]]
    for a, b in itertools.pairwise(cuts):
        piece = (t >= a) & (t <= b)
        if piece.sum() < 2:
            return np.nan
        spline = make_interp_spline(t[piece], work[piece], k=min(9, (piece.sum() - 1) // 2 * 2 - 1 or 1))
        gained += list(gained[-1] + spline.antiderivative()(t[piece])[1:])
    return float(np.abs(energy - energy[0] - gained).max() / max(np.abs(energy).max(), 1e-300))


# --- what is measured


def _combinations(model, methods, drifts):
    """Pairs of method and treatment; default methods are those that the model can have."""
    if methods is None:
        methods = MEASURED if model.flat else [name for name in MEASURED if name != "algebraic"]
    methods = list(methods) if isinstance(methods, (list, tuple)) else [methods]
    for method in methods:
        if not (isinstance(method, str) and method in METHODS):
            raise unknown(method, METHODS, "method")
    treatments = [as_drift(value) for value in drifts]
    for value in treatments:
        if isinstance(value, Poles) and not isinstance(value.values, float):
            raise SpecificationError(
                "Poles by row were given.", "A row of the study names its drift in a word.", do="Give a time constant."
            )
    pairs = [(m, d) for m in methods for d in treatments if m != "algebraic"]
    pairs = [*((m, None) for m in methods if m == "algebraic"), *pairs]
    if not pairs:
        raise SpecificationError(
            f"methods={methods!r} and drift={drifts!r} were given.",
            "A study measures at least one method with one treatment of drift.",
            do="Leave both out to measure most, or give drift=[None].",
        )
    return pairs


def _ladders(settings, length):
    """Values of "rtol" and "step", the latter for a span of some length [s]."""
    for name in settings:
        if name not in ("rtol", "step"):
            raise unknown(name, ("rtol", "step"), "setting")
    rtol = positives("rtol", settings.get("rtol", TOLERANCES), "Leave rtol out.", most=1.0)
    step = positives("step", settings.get("step", [length / n for n in STEP_COUNTS]), "Leave step out.")
    return {"rtol": np.ravel(rtol).tolist(), "step": np.ravel(step).tolist()}


def _kind(method):
    return "step" if isinstance(as_method(method), (Algebraic, RungeKutta)) else "rtol"


def _drift_word(treatment):
    """A word for a treatment from which `TradeOff.recommend` makes it again."""
    if isinstance(treatment, Poles):
        return f"{treatment.values:g}"
    if isinstance(treatment, Project):
        return "project" if treatment.every == 1 else f"project {treatment.every}"
    return "minimal" if isinstance(treatment, MinimalCoordinates) else "none"


def _said(method):
    order = f" of order {method.order}" if isinstance(method, Taylor) else ""
    return f"{method}{order}" + (f" at {method.rtol:g}" if hasattr(method, "rtol") else "")


# --- methods and treatments in words


def method_at(name, value):
    """The method of a name with a step of `value` [s], or a tolerance: rtol is `value`, atol a hundredth."""
    method = as_method(name)
    if isinstance(method, Algebraic):
        return method
    settings = {"step": value} if isinstance(method, RungeKutta) else {"rtol": value, "atol": value / 100}
    return as_method(method, **settings)


def _arguments(row):
    """The arguments of `simulate` that a row was measured with."""
    options, drift = {"method": method_at(row["method"], row["value"])}, row["drift"]
    if drift != "none":
        word, _, every = drift.partition(" ")
        options["drift"] = Project(int(every)) if every else word if word in DRIFTS else float(drift)
    return options


def _name(row):
    return ", ".join([row["method"], f"drift {row['drift']}", f"{row['setting']} {row['value']:g}"])


def _cost(name):
    if name not in COSTS:
        raise unknown(name, COSTS, "cost")
    return name
