"""The trade-off: measured errors and costs of methods, settings and treatments of drift on one motion."""

import functools
import itertools
import time
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from servoctl.checks import as_span, is_number, mapping, named, positive, positives, require_kind, text
from servoctl.control.reference import resampled
from servoctl.errors import LimitExceeded, ServoError, SpecificationError, unknown
from servoctl.markup import Shown
from servoctl.methods.accuracy import motion_error, relative_error
from servoctl.methods.choice import (
    METHODS,
    Adaptive,
    Algebraic,
    Poles,
    Project,
    RungeKutta,
    Taylor,
    as_drift,
    as_method,
)
from servoctl.methods.motion import DEFAULT_SAMPLES
from servoctl.model.model import Model
from servoctl.model.start import State
from servoctl.progress import progress_bar
from servoctl.simulation import consistent_state, simulated
from servoctl.study.table import SHOWN, Study, machine, table

MEASURED = tuple(name for name in METHODS if name != "bounded")  # which solves another problem
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
STEP_COUNTS = tuple(5 * 4**k for k in range(7))  # steps of a fixed length in the span
INSTANTS = 51  # samples of adaptive methods while they are timed
COMPARED, BETWEEN = 400, 0.382  # instants at which motions are compared, and where in its interval each lies
DENSE = 1001  # instants of the reference over which its power is integrated
TIMED, ENOUGH = 3, 0.3  # calls timed after a warm-up, fewer where they take this part of `seconds` together
FEW = 20  # steps: a run that takes too long for fewer has diverged, and says nothing about finer settings
TIME_CONSTANT = 50  # default time constants of the poles in the span
DRIFTS = ("none", "project")  # words of the column drift; others are time constants of poles
CHECKS = (Adaptive("DOP853", 3e-14, 1e-15), Taylor(12, rtol=1e-14, atol=1e-14))  # of the reference, in this order
COSTS = ("seconds", "evaluations", "steps")


class Recommendation(dict):
    """Arguments of `simulate`, with the `row` that was measured with them; made by `TradeOff.recommend`.

    `sv.simulate(model, x0, t_span, **study.recommend(error=1e-6))`
    """

    def __init__(self, options, row):
        super().__init__(options)
        self.row = row


def unbeaten(cost, error):
    """Indices of the entries that no other one beats in both cost (N,) and error (N,), from cheap to accurate."""
    front, best = [], np.inf
    for i in np.lexsort((error, cost)):
        if error[i] < best:
            front.append(i)
            best = error[i]
    return np.array(front, dtype=int)


def bound(error, seconds):
    """What bounds a recommendation, "error" or "seconds", and its value; exactly one of the two is a number."""
    if (error is None) == (seconds is None):
        raise SpecificationError(
            f"error={error!r} and seconds={seconds!r} were given.",
            "Exactly one of the two bounds a recommendation.",
            do="Give recommend(error=1e-6) or recommend(seconds=1e-3).",
            error=error,
            seconds=seconds,
        )
    wanted, limit = ("error", error) if seconds is None else ("seconds", seconds)
    if not (is_number(limit) and limit > 0):
        given, rule = f"{wanted}={limit!r} was given.", "It must be a positive number."
        raise SpecificationError(given, rule, **{wanted: limit})
    return wanted, limit


class TradeOff(Study):
    """Errors and costs of methods, settings and treatments of drift on one motion; made by `tradeoff`.

    Columns: method; drift ("none", "project", or the time constant of the poles in s); setting ("rtol" or
    "step") and its value; error of the motion: the largest deviation from the reference over the components of the
    state, each relative to its largest magnitude (at least 1e-3 of the largest of its level), and over 402 instants
    that are the same for all methods: dense output counts, and Hermite interpolation between the steps of fixed-step
    methods; actuation: the same for the required forces and moments; residual: the largest of any constraint at any
    level at these instants, in its unit; energy: energy gained less the work done along the reference, relative to
    the largest energy; power: dE/dt less the power of all forces, relative (NaN where it does not apply); evaluations
    of the right-hand side, or of the series, or Newton steps; steps; seconds: the shortest call after a warm-up, with
    51 samples for adaptive methods (more samples take longer), and one at each instant or step for the others;
    resolved: whether the error exceeds the uncertainty of the reference; failure: why there are no numbers.
    """

    COLUMNS = (
        *("method", "drift", "setting", "value", "error", "actuation", "residual", "energy", "power"),
        *("evaluations", "steps", "seconds", "resolved", "failure"),
    )

    @property
    def uncertainty(self) -> float:
        """Relative difference between the reference and the method that verified it."""
        return self.meta["reference"]["error"]

    def pareto(self, cost: str = "seconds") -> "TradeOff":
        """The rows that no other row beats in both error and cost, from cheap to accurate.

        Errors below the uncertainty of the reference count as equal to it.

        Parameters
        ----------
        cost : {"seconds", "evaluations", "steps"}

        Returns
        -------
        TradeOff
        """
        good = self._good()
        return self.take(good[unbeaten(self.column(as_cost(cost))[good], self._errors()[good])])

    def recommend(self, *, error: float | None = None, seconds: float | None = None) -> Recommendation:
        """Arguments of `simulate`: the fastest within an error, or the most accurate within a time.

        Parameters
        ----------
        error : float, optional
            Largest error of the motion, relative.
        seconds : float, optional
            Longest time of a call [s], on the machine that measured.

        Returns
        -------
        Recommendation
            A dict of arguments; `.row` is the measured row.

        Raises
        ------
        SpecificationError
            Unless exactly one of the two is given, a positive number.
        LimitExceeded
            If no row reaches it; the message has the nearest one.
        """
        wanted, limit = bound(error, seconds)
        front = self.pareto()
        reached = front._errors() if wanted == "error" else front["seconds"]
        within = np.flatnonzero(reached <= limit)
        if not len(within):
            raise self._out_of_reach(wanted, limit, front)
        row = front.rows()[within[0] if wanted == "error" else within[-1]]
        return Recommendation(arguments_of(row), row)

    def _out_of_reach(self, wanted, limit, front):
        nearest = ""
        if len(front):
            row = front.rows()[-1 if wanted == "error" else 0]
            best = max(row["error"], self.uncertainty)
            nearest = f"{row['method']}, drift {row['drift']}, {row['setting']} {row['value']:g}: "
            nearest += f"error {best:.2g} in {row['seconds']:.2g} s"
        reason = "no measured setting reaches it" if len(front) else "every run failed, see the column failure"
        return LimitExceeded(
            f"{wanted}={limit:g} was given, and {reason}.",
            f"The reference itself has the uncertainty {self.uncertainty:.1g}." if wanted == "error" else "",
            nearest=nearest,
            do=f"Raise {wanted}, or measure other methods and settings.",
            limit=limit,
            uncertainty=self.uncertainty,
        )

    def plot(self, ax=None, cost: str = "seconds", title: str = ""):
        """Draw the work-precision diagram: error of the motion over cost, with a line for each method and drift.

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

        return draw_tradeoff(self, ax, as_cost(cost), text("title", title))

    def _good(self):
        return np.flatnonzero(np.isfinite(self["error"]) & np.isfinite(self["seconds"]))

    def _errors(self):
        """Errors, at least the uncertainty of the reference."""
        return np.maximum(self["error"], self.uncertainty)

    def _tables(self):
        return Shown._tables(self)

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


def tradeoff(
    model: Model,
    x0: State | np.ndarray,
    t_span: tuple[float, float],
    methods: Sequence[str] | str | None = None,
    drift: Sequence | None = None,
    *,
    settings: Mapping[str, Sequence[float]] | None = None,
    seconds: float = 0.3,
    progress: bool | None = None,
) -> TradeOff:
    """Measure error and cost of methods, settings and treatments of drift on one motion.

    The reference is the Taylor method of order 16 at a tolerance of 1e-15, or, where nothing is integrated, Newton's
    method at each instant. A second method verifies it. Their difference is the uncertainty of the reference; smaller
    errors are marked as not resolved.

    Main arguments

    Parameters
    ----------
    model : Model
    x0 : State or (n_x,) array
        From `model.start`.
    t_span : (t0, t1)
        [s]
    methods : sequence of str, optional
        Names of methods as in `simulate`; default: "algebraic" where the program determines the motion completely, so
        that nothing is integrated, else all.
    drift : sequence, optional
        Treatments as in `simulate`; default: None, "project" and poles at -50/(t1 - t0).

    Other arguments

    settings : dict of str to sequence of float, optional
        "rtol": tolerances of the adaptive methods, default 1e-3 to 1e-13; atol is a hundredth of rtol. "step": steps
        of the methods of fixed step, and spacings of the instants of "algebraic" [s]; default (t1 - t0)/(5·4ᵏ),
        k = 0 .. 6.
    seconds : float
        Time that one run may take [s]. A longer one is stopped, and finer settings are skipped if it had taken more
        than a few steps; the column failure says so.
    progress : bool, optional
        Show a progress bar; default: on a terminal, for work of more than a second.

    Returns
    -------
    TradeOff
        After Ctrl-C the rows measured so far, with `meta["message"]` "interrupted".

    Raises
    ------
    ServoError
        If the reference cannot be computed, such as SingularProgram where the motion ends.
    InconsistentStart
        For a start off the constraints.
    SpecificationError
        For invalid settings.
    """
    require_kind(Model, "model", model, "sv.derive(mechanism, program)")
    t0, t1 = as_span(t_span)
    settings = _ladders(mapping(settings, "The settings"), abs(t1 - t0))
    limit = positive("seconds", seconds)
    drifts = (None, "project", abs(t1 - t0) / TIME_CONSTANT) if drift is None else drift
    combinations = _combinations(model, methods, drifts if isinstance(drifts, (list, tuple)) else [drifts])
    total = sum(len(settings[_kind(method)]) for method, _ in combinations)
    with progress_bar("tradeoff", progress, total, unit="run") as bar, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # steps outside the stable range: their errors are measured
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


# --- the reference


class Reference:
    """The motion with which others are compared, at any instants.

    `check` is the run at `times` of the method that verified it, the first that ends within ten times `seconds`.
    `agreement` has both methods and their differences.
    """

    def __init__(self, model, x0, t_span, seconds, checks=CHECKS):
        consistent_state(model, x0, t_span[0])
        self.model, self.start, self.span, self._runs = model, x0, t_span, {}
        self.knots = [k for k in model.require_smooth((min(t_span), max(t_span))) if min(t_span) < k < max(t_span)]
        t0, t1 = t_span
        self.few = np.union1d(np.linspace(t0, t1, INSTANTS), self.knots)
        between = t0 + (t1 - t0) * (np.arange(COMPARED) + BETWEEN) / COMPARED
        self.times = np.unique([t0, *between, t1, *self.knots])
        self.method, self.drift = Taylor(16, rtol=1e-15, atol=1e-15), Project()
        if model.flat:
            self.method, self.drift, checks = Algebraic(), None, CHECKS[::-1]
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

    @functools.cached_property
    def agreement(self):
        """The two methods in words, and how far their motions, actuations and energies differ."""
        exact = self.at(self.times)
        dense = np.union1d(np.linspace(*self.span, DENSE), self.knots)
        return {
            "method": _text(self.method),
            "verified by": _text(self.checked_by),
            "error": motion_error(self.model, self.check.jets, exact.jets),
            "actuation": relative_error(actuation(self.check), actuation(exact)),
            "energy": _energy_balance(self.at(dense), self.knots),
        }

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
            late = f"More than {self.seconds:g} s: ended at t = {t:.4g} s"
            raise LimitExceeded(late, seconds=self.seconds, steps=self.steps, t=t)


def whole_run(run):
    """The run, if it reached its end; one that Ctrl-C stopped ends the study."""
    if not run.success:
        raise KeyboardInterrupt
    return run


def actuation(run):
    """Forces and moments that realise the program, of actuators or of the ideal reaction, (n, N)."""
    return run.signals("inputs")[1]


# --- one run


def _ladder(reference, method, treatment, settings, seconds):
    """A row for each setting, from coarse to fine; those after the first too slow or unresolved one are skipped."""
    skipped, name = "", _kind(method)
    for value in sorted(settings, reverse=True):
        row = {"method": method, "drift": _drift_word(treatment), "setting": name, "value": value, "failure": skipped}
        if not skipped:
            try:
                row |= _errors_and_cost(reference, method, treatment, value, seconds)
                if not row["resolved"]:
                    skipped = f"skipped: {name} = {value:g} reaches the uncertainty of the reference"
                elif row["seconds"] > seconds:
                    skipped = f"skipped: {name} = {value:g} took {row['seconds']:.2g} s, more than {seconds:g} s"
            except SpecificationError as error:  # the combination is invalid at every setting: one row is enough
                yield row | {"value": np.nan, "failure": str(error)}
                return
            except ServoError as error:
                row["failure"] = f"{type(error).__name__}: {error}"
                if error.details.get("steps", 0) > FEW:
                    skipped = f"skipped: {name} = {value:g} took more than {seconds:g} s"
        yield row


def _errors_and_cost(reference, name, treatment, value, seconds):
    """Errors, counts and time of one setting."""
    model, (t0, t1) = reference.model, reference.span
    method, times = method_at(name, value), reference.few
    if isinstance(method, Algebraic):
        times = np.union1d(np.linspace(t0, t1, 1 + round(abs(t1 - t0) / value)), reference.knots)
    elif isinstance(method, RungeKutta):
        times = None

    def at(times):
        options = {"drift": treatment, "t_eval": times, "progress": Deadline(seconds)}
        return whole_run(simulated(model, reference.start, reference.span, method, **options))

    run, timed = at(times), []
    for _ in range(TIMED):
        since = time.perf_counter()
        at(times)
        timed.append(time.perf_counter() - since)
        if sum(timed) > ENOUGH * seconds:
            break
    errors = _errors(reference, at(reference.times))
    if isinstance(method, Taylor) and t1 > t0:
        between = resampled(at(np.union1d(np.linspace(t0, t1, DEFAULT_SAMPLES), reference.knots)), reference.times)
        errors["error"] = max(errors["error"], motion_error(model, between.jets, reference.at(reference.times).jets))
    return errors | {
        "evaluations": run.counters.get("nfev", run.counters.get("iterations", 0)),
        "steps": run.counters.get("steps", len(run.t)),
        "seconds": min(timed),
    }


def _errors(reference, run):
    """Errors of a run at the times of the reference."""
    exact = reference.at(reference.times)
    error = motion_error(reference.model, run.jets, exact.jets)
    rate, work, size, law, _ = run.signals("power")[1]
    largest = max(np.abs(size).max(), np.abs(rate).max(), 1e-300)
    lawful = np.abs(law).max() < 1e-9 * largest
    energy, exact_energy = run["energy"], exact["energy"]
    drifted = np.abs((energy - energy[0]) - (exact_energy - exact_energy[0])).max()
    return {
        "error": error,
        "actuation": relative_error(actuation(run), actuation(exact)),
        "residual": max((float(np.abs(levels).max(initial=0.0)) for levels in run.residual.values()), default=0.0),
        "energy": float(drifted / max(np.abs(exact_energy).max(), 1e-300)),
        "power": float(np.abs(rate - work).max() / largest) if lawful else np.nan,
        "resolved": bool(error >= reference.agreement["error"]),
    }


def _energy_balance(run, knots):
    """Largest difference between the energy gained and the work of all forces, relative to the energy (splines)."""
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


# --- combinations to measure


def _combinations(model, methods, drifts):
    """Pairs of method and treatment; "algebraic", which has no treatment, is the default for flat programs."""
    if methods is None:
        methods = ["algebraic"] if model.flat else [name for name in MEASURED if name != "algebraic"]
    methods = list(methods) if isinstance(methods, (list, tuple)) else [methods]
    for method in methods:
        if not (isinstance(method, str) and method in METHODS):
            raise unknown(method, METHODS, "method")
    treatments = [as_drift(value) for value in drifts]
    if any(isinstance(value, Poles) and not isinstance(value.values, float) for value in treatments):
        rule, do = "A study names each treatment by one word or number.", "Give one time constant for all rows."
        raise SpecificationError("Poles by row were given.", rule, do=do, drift=list(drifts))
    pairs = [(m, None) for m in methods if m == "algebraic"]
    pairs += [(m, d) for m in methods for d in treatments if m != "algebraic"]
    if not pairs:
        raise SpecificationError(
            f"methods={methods!r} and drift={drifts!r} were given.",
            "A study needs at least one method and one treatment of drift.",
            do="Leave both out for the defaults, or give drift=[None] for no treatment.",
            methods=methods,
            drift=list(drifts),
        )
    return pairs


def _ladders(settings, length):
    """Values of "rtol", and of "step" for a span of this length [s]."""
    for name in settings:
        named(name, ("rtol", "step"), "setting")
    rtol = positives("rtol", settings.get("rtol", TOLERANCES), "Leave rtol out.", most=1.0)
    step = positives("step", settings.get("step", [length / n for n in STEP_COUNTS]), "Leave step out.")
    return {"rtol": np.ravel(rtol).tolist(), "step": np.ravel(step).tolist()}


def _kind(method):
    return "step" if isinstance(as_method(method), (Algebraic, RungeKutta)) else "rtol"


def _drift_word(treatment):
    """A treatment as a word, which `arguments_of` reads."""
    if isinstance(treatment, Poles):
        return repr(treatment.values)
    if isinstance(treatment, Project):
        return "project" if treatment.every == 1 else f"project {treatment.every}"
    return "none"


def _text(method):
    order = f" of order {method.order}" if isinstance(method, Taylor) else ""
    return f"{method}{order}" + (f" at {method.rtol:g}" if hasattr(method, "rtol") else "")


# --- methods and treatments in words


def method_at(name, value):
    """The method of this name with a step [s] or a relative tolerance of `value`; atol is a hundredth of it."""
    method = as_method(name)
    if isinstance(method, Algebraic):
        return method
    settings = {"step": value} if isinstance(method, RungeKutta) else {"rtol": value, "atol": value / 100}
    return as_method(method, **settings)


def arguments_of(row):
    """The arguments of `simulate` with which a row was measured."""
    options, drift = {"method": method_at(row["method"], row["value"])}, row["drift"]
    if drift != "none":
        word, _, every = drift.partition(" ")
        options["drift"] = Project(int(every)) if every else word if word in DRIFTS else float(drift)
    return options


def as_cost(name):
    """One of the columns that count as cost, or the error of another name."""
    return named(name, COSTS, "cost")
