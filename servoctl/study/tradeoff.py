"""The trade-off: measured errors and costs of models, methods, settings and treatments of drift on one motion."""

import time
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np

from servoctl.checks import as_span, mapping, named, positive, positives, require_kind, text
from servoctl.codegen.compiler import fixed
from servoctl.errors import LimitExceeded, ServoError, SpecificationError
from servoctl.markup import Shown
from servoctl.methods.choice import (
    METHODS,
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
from servoctl.simulation import as_state, simulated
from servoctl.study.converged import Comparison, Converged, Deadline, cpu_seconds
from servoctl.study.executor import whole_run
from servoctl.study.table import SHOWN, Study, machine, table
from servoctl.values import evenly

MEASURED = tuple(name for name in METHODS if name != "bounded")  # which solves another problem
OF_MODELS = ("Taylor", "RadauIIA")  # default methods where models are compared: the second for stiff ones
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
STEP_COUNTS = tuple(5 * 4**k for k in range(7))  # steps of a fixed length in the span
TIMED, ENOUGH = 3, 0.3  # calls timed after a warm-up, fewer where they take this part of a run's limit together
TIME_CONSTANT = 50  # default time constants of the poles in the span
DRIFTS = ("none", "project")  # words of the column drift; others are time constants of poles
COSTS = ("seconds", "evaluations", "steps")
ERRORS = ("error", "actuation")


class Recommendation(dict):
    """Arguments of `simulate`, with the `row` that was measured with them; made by `TradeOff.recommend`.

    `sv.simulate(model, start, t_span, **study.recommend(error=1e-6))`
    """

    def __init__(self, options, row):
        super().__init__(options)
        self.row = row


def _wanted(**bounds):
    """The name and the value of the bound of a recommendation; exactly one is given, a positive number."""
    given = {name: value for name, value in bounds.items() if value is not None}
    if len(given) != 1:
        raise SpecificationError(
            f"{', '.join(f'{name}={value!r}' for name, value in bounds.items())} was given.",
            "Exactly one of the two bounds a recommendation.",
            do="Give recommend(error=1e-6) or recommend(seconds=1e-3).",
            **bounds,
        )
    [(wanted, limit)] = given.items()
    return wanted, positive(wanted, limit)


class TradeOff(Study):
    """Errors and costs of models, methods, settings and treatments of drift on one motion; made by `tradeoff`.

    Columns: model (empty if there is one); method; drift ("none", "project", or the time constant of the poles in s);
    setting ("rtol" or "step") and its value; error of the motion: the largest deviation from the reference, which is
    the converged motion of the first model, over the compared signals, each relative to its largest magnitude (a
    component of the state to at least 1e-3 of the largest of its level), and over 402 instants that are the same for
    all methods: dense output counts, and Hermite interpolation between the steps of fixed-step methods; integration:
    the same from the converged motion of the row's own model, so that what an error has beyond it is an error of
    modelling; actuation: the error of the required forces and moments; residual: the largest of any constraint at any
    level at these instants, in its unit; energy: energy gained less the work done along the converged motion, relative
    to the largest energy; power: dE/dt less the power of all forces, relative (NaN where it does not apply); operations
    of one evaluation of the rates, or of Newton's step; evaluations of the right-hand side, or of the series, or Newton
    steps; steps; seconds: the shortest call after a warm-up, with 51 samples for adaptive methods (more samples take
    longer), and one at each instant or step for the others; resolved: whether the error of integration exceeds the
    uncertainty of the converged motions, as finer settings than one that does not are left out; failure: why there are
    no numbers. What a method could not measure, if more than one setting, is one row without a value.
    """

    COLUMNS = (
        *("model", "method", "drift", "setting", "value", "error", "integration", "actuation", "residual", "energy"),
        *("power", "operations", "evaluations", "steps", "seconds", "resolved", "failure"),
    )

    @property
    def uncertainty(self) -> float:
        """Relative difference between a converged motion and the method that verified it, the largest of all models."""
        return self.meta["reference"]["error"]

    def pareto(self, cost: str = "seconds", of: str = "error") -> "TradeOff":
        """The rows that no other row beats in both error and cost, from cheap to accurate.

        Errors below the uncertainty of the reference count as equal to it.

        Parameters
        ----------
        cost : {"seconds", "evaluations", "steps"}
        of : {"error", "actuation"}

        Returns
        -------
        TradeOff
        """
        cost, error = self[named(cost, COSTS, "cost")], self._errors(of)
        rows = np.lexsort((error, cost))
        rows = rows[np.isfinite(error[rows]) & np.isfinite(cost[rows])]
        return self.take(rows[error[rows] < np.minimum.accumulate(np.append(np.inf, error[rows]))[:-1]])

    def recommend(
        self, *, error: float | None = None, seconds: float | None = None, of: str = "error"
    ) -> Recommendation:
        """Arguments of `simulate`: the fastest within an error, or the most accurate within a time.

        Parameters
        ----------
        error : float, optional
            Largest error of the motion, relative.
        seconds : float, optional
            Longest time of a call [s], on the machine that measured.
        of : {"error", "actuation"}
            Which error.

        Returns
        -------
        Recommendation
            A dict of arguments; `.row` is the measured row, `.row["model"]` the model.

        Raises
        ------
        SpecificationError
            Unless exactly one of the two is given, a positive number.
        LimitExceeded
            If no row reaches it; the message has the nearest one.
        """
        wanted, limit = _wanted(error=error, seconds=seconds)
        front = self.pareto(of=of)
        reached = front._errors(of) if wanted == "error" else front["seconds"]
        within = np.flatnonzero(reached <= limit)
        if not len(within):
            raise self._out_of_reach(wanted, limit, front, of)
        row = front.rows()[within[0] if wanted == "error" else within[-1]]
        return Recommendation(arguments_of(row), row)

    def _errors(self, of):
        """Errors of all rows, (N,), at least the uncertainty of the reference."""
        return np.maximum(self[named(of, ERRORS, "error")], self.meta["reference"][of])

    def _out_of_reach(self, wanted, limit, front, of):
        nearest = ""
        if len(front):
            row = front.rows()[-1 if wanted == "error" else 0]
            best = max(row[of], self.meta["reference"][of])
            nearest = f"{_in_words(row)}: {of} {best:.2g} in {row['seconds']:.2g} s"
        reason = "no measured setting reaches it" if len(front) else "every run failed, see the column failure"
        return LimitExceeded(
            f"{wanted}={limit:g} was given, and {reason}.",
            f"The reference itself has the uncertainty {self.meta['reference'][of]:.1g}." if wanted == "error" else "",
            nearest=nearest,
            do=f"Raise {wanted}, or measure other methods, settings and models.",
            limit=limit,
            uncertainty=self.meta["reference"][of],
        )

    def plot(self, ax=None, cost: str = "seconds", title: str = "", of: str = "error"):
        """Draw the work-precision diagram: error over cost, with a line for each model, method and drift.

        Parameters
        ----------
        ax : Axes, optional
        cost : {"seconds", "evaluations", "steps"}
        title : str
        of : {"error", "actuation"}

        Returns
        -------
        Axes
        """
        from servoctl.figures.work_precision import draw_tradeoff

        return draw_tradeoff(self, ax, named(cost, COSTS, "cost"), text("title", title), named(of, ERRORS, "error"))

    _tables = Shown._tables

    def _advice(self, front):
        """One sentence: the middle of the front, and below which error a single method is left."""
        if not len(front):
            return "no row has numbers, see the column failure"
        row, good = front.rows()[len(front) // 2], self.take(np.flatnonzero(np.isfinite(self["error"])))
        kind = "model" if len(self.meta["models"]) > 1 else "method"
        best = sorted((good.where(**{kind: name})._errors("error").min(), name) for name in set(good[kind].tolist()))
        alone = len(best) > 1 and f"{best[1][0]:.0e}" != f"{best[0][0]:.0e}"
        only = f"; of these rows, below {best[1][0]:.0e} only {best[0][1]}" if alone else ""
        return f"{_in_words(row)}: {max(row['error'], self.uncertainty):.0e} for {1e3 * row['seconds']:.3g} ms{only}"

    def __repr__(self):
        t0, t1 = self.meta["t_span"]
        reference, where = self.meta["reference"], self.meta["machine"]
        front = self.pareto()
        shown = evenly(len(front), SHOWN)
        kinds = Counter(why.partition(":")[0] for why in self["failure"].tolist() if why)
        lines = [
            f"Trade-off{', interrupted' * bool(self.meta.get('message'))}: t = {t0:g} .. {t1:g} s, {len(self)} rows, "
            f"{int(np.isnan(self['error']).sum())} empty"
            + f" ({', '.join(f'{count} {kind}' for kind, count in kinds.most_common())})" * bool(kinds)
            + f"; {self.meta['left out']} finer left out" * bool(self.meta["left out"]),
            f"  reference: {reference['method']}; {reference['verified by']} agrees to {reference['error']:.1e}, "
            f"actuation to {reference['actuation']:.1e}",
            f"  CPU {reference['cpu']:.2g} s for the reference, {self.meta['cpu']:.2g} of {self.meta['budget']:g} s "
            f"for rows; {where['processor']}, {where['cores']} cores, compiler {where['compiler']}",
            f"  {self._advice(front)}"
            + (f". Fastest for each error, {len(shown)} of {len(front)}:" if len(front) else ""),
        ]
        names = ("method", "drift", "setting", "value", "error", "actuation", "evaluations", "seconds")
        names = ("model", *names) if len(self.meta["models"]) > 1 else names
        return "\n".join([*(line[:120] for line in lines), *table(front.take(shown), names, SHOWN)])


def tradeoff(
    model: Model | Mapping[str, Model],
    start: State | np.ndarray,
    t_span: tuple[float, float],
    methods: Sequence[str] | str | Mapping[str, Sequence[float]] | None = None,
    drift: Sequence | None = None,
    *,
    outputs: Sequence[str] | Mapping[str, float] | None = None,
    budget: float = 30.0,
    progress: bool | None = None,
) -> TradeOff:
    """Measure error and cost of methods, settings and treatments of drift on one motion, of one model or several.

    The reference is the Taylor method of order 16 at a tolerance of 1e-15, Radau IIA of order 13 at 1e-14 where series
    take longer, or, where nothing is integrated, Newton's method at each instant. A second method verifies it. Their
    difference is the uncertainty of the reference; smaller errors are marked as not resolved. The motions of simpler
    models of the same scene are compared with that of the first one: what they save in time, and cost in error.

    Main arguments

    Parameters
    ----------
    model : Model, or dict of str to Model
        Several models by name: the first is the reference of all.
    start : State or (n_x,) array
        From `model.start`, of the first model. The others start as near to it as possible, and hold the coordinates and
        rates that it holds.
    t_span : (t0, t1)
        [s]
    methods : sequence of str, or dict of str to sequence of float, optional
        Names of methods as in `simulate`, or the settings of each method by its name: tolerances of the adaptive
        methods, steps of those of fixed step, spacings of the instants of "algebraic" [s]. Default: "algebraic" where
        the program determines the motion completely, so that nothing is integrated, else all; of several models
        "Taylor" and "RadauIIA". Default tolerances are 1e-3 to 1e-13, atol is a hundredth of rtol; default steps
        (t1 - t0)/(5·4ᵏ), k = 0 .. 6.
    drift : sequence, optional
        Treatments as in `simulate`; default: None, "project" and poles at -50/(t1 - t0), of several models "project".

    Other arguments

    outputs : sequence of str, or dict of str to float, optional
        Signals that all models have, of which the error is taken, or the sizes to which it is relative by their names,
        in their units; default: the coordinates and rates that all have, relative to their largest magnitudes.
    budget : float
        Processor time of all rows [s], that of compilers included and that of the reference, which is printed, apart.
        Those that need least are measured first; the column failure says what it did not suffice for.
    progress : bool, optional
        Show a progress bar; default: on a terminal, for work of more than a second.

    Returns
    -------
    TradeOff
        What a model cannot do is a row with the reason. After Ctrl-C the rows measured so far, with `meta["message"]`
        "interrupted".

    Raises
    ------
    ServoError
        If the reference cannot be computed, such as SingularProgram where the motion ends.
    InconsistentStart
        For a start off the constraints.
    NameUnknown
        For a method or a signal that does not exist.
    SpecificationError
        For invalid settings, and for models that have no coordinate in common.
    """
    models = _as_models(model)
    span, budget = as_span(t_span), positive("budget", budget)
    candidates = {name: _candidates(each, methods, drift, span, len(models)) for name, each in models.items()}
    total = sum(len(settings) for each in candidates.values() for *_, settings in each)
    with warnings.catch_warnings(), progress_bar("tradeoff", progress, total, unit="run") as bar:
        warnings.simplefilter("ignore", RuntimeWarning)  # steps outside the stable range: their errors are measured
        motions, rows = _converged(models, start, span, bar)
        comparison = Comparison(motions, outputs)
        agreement, began = comparison.agreement, cpu_seconds()
        ladders = [Ladder(name, motions[name], *candidate) for name in motions for candidate in candidates[name]]
        message = _measure(ladders, comparison, budget, bar)
    by_method = groupby(ladders, key=lambda each: (each.model, each.method))
    rows += [row for _, group in by_method for row in _rows(list(group))]
    columns = {name: [row.get(name) for row in rows] for name in TradeOff.COLUMNS}
    meta = {"t_span": list(span), "budget": budget, "cpu": cpu_seconds() - began, "models": list(models)}
    meta |= {"left out": sum(each.unseen for each in ladders), "outputs": comparison.names, "reference": agreement}
    meta |= {"machine": machine(), "measured": time.strftime("%Y-%m-%d"), "message": message}
    return TradeOff("tradeoff", columns, meta)


# --- models and their motions


def _as_models(given):
    """Models by name; a single one has the name ""."""
    models = mapping(given, "The models") if isinstance(given, Mapping) else {"": given}
    if not models:
        raise SpecificationError("No model was given.", do='Give one, or several as {"rigid": model, ...}.', models=0)
    for name, model in models.items():
        require_kind(Model, f"model {name!r}" if name else "model", model, "sv.derive(mechanism, program)")
    return models


def _converged(models, start, span, bar):
    """The converged motions by model, and a row with the reason for each model but the first that has none."""
    motions, rows, (first, *_) = {}, [], models
    for name, model in models.items():
        try:
            near = start if name == first else _start_near(model, models[first], start, span[0])
            motions[name] = Converged(model, near, span, bar)
        except ServoError as error:
            if name == first:
                raise
            rows.append({"model": name, "failure": _failure(error)})
    return motions, rows


def _start_near(model, first, start, t):
    """The start of a model that is nearest to that of the first one, and holds the same coordinates and rates."""
    values = dict(zip(first.state_names, as_state(first, start, t).tolist(), strict=True))
    common = {name: value for name, value in values.items() if name in model.state_names}
    held = {name: common[name] for name in getattr(start, "held", ()) if name in common}
    return model.start(t=t, guess={name: value for name, value in common.items() if name not in held} or None, **held)


def _failure(error):
    return f"{type(error).__name__}: {error}"


# --- runs, the cheapest first


def _measure(ladders, comparison, budget, bar):
    """Measure settings within a budget [s of CPU], the one that needs least before all others; tells of Ctrl-C."""
    # first what needs no code of its own, then what takes ever longer to make
    waiting = sorted(ladders, key=lambda each: [*METHODS].index(each.method), reverse=True)
    left, end = budget, cpu_seconds() + budget
    try:
        while waiting:
            ladder, left = min(waiting, key=lambda each: each.needed), end - cpu_seconds()
            if ladder.needed > left:
                break
            count = len(ladder.settings)
            ladder.measure(comparison, left, left / len(waiting))
            bar.update(count - len(ladder.settings))
            waiting = [each for each in waiting if each.settings]
    except KeyboardInterrupt:
        return "interrupted"
    for ladder in waiting:
        needs = f"{ladder.needed:.2g} s of CPU are needed" if ladder.needed else "not begun"
        reason = f"Budget: {needs}, {max(left, 0):.2g} of {budget:g} s were left."
        ladder.leave(reason, len(ladder.settings))
    return ""


class Ladder:
    """The settings of a method and a treatment of drift that are still to be measured, and the rows of the others.

    `needed` is the processor time that the next row is expected to need: that of the last one [s], or nothing yet where
    that was the first, for which code was made; `unseen` is the number of settings left out, as a coarser one reaches
    the uncertainty of the reference.
    """

    def __init__(self, model, motion, method, treatment, settings):
        self.model, self.motion, self.method, self.treatment = model, motion, method, treatment
        self.settings, self.needed, self.unseen, self.rows, self.failed = sorted(settings), 0.0, 0, [], []
        self.same = {"model": model, "method": method, "drift": _drift_word(treatment), "setting": _kind(method)}

    def measure(self, comparison, left, share):
        """Measure the coarsest setting, by runs of an equal share of the time that is left, or twice what is needed."""
        value, began, limit = self.settings[-1], cpu_seconds(), min(left, max(share, 2 * self.needed))
        try:
            row = _errors_and_cost(comparison, self.motion, method_at(self.method, value), self.treatment, value, limit)
        except ServoError as error:
            self.needed, needed = cpu_seconds() - began, error.details.get("needed")  # by runs that took too long
            if needed is not None and needed < left - self.needed:
                self.needed = needed  # the same setting again
            else:  # finer settings are invalid, too, or take longer
                finer = isinstance(error, SpecificationError) or needed is not None and self.rows
                self.leave(_failure(error), len(self.settings) if finer else 1)
            return
        if not np.isfinite([row[name] for name in ("error", "residual", "energy")]).all():
            return self.leave(f"Diverged: the error of the motion is {row['error']:.1g}.", 1)
        row["resolved"] = row["integration"] >= comparison.agreement["error"]
        self.rows.append(self.same | row | {"value": self.settings.pop(), "failure": ""})
        self.needed = cpu_seconds() - began if len(self.rows) > 1 else 0.0
        if not row["resolved"]:  # what is finer has no smaller error that could be seen
            self.unseen, self.settings = len(self.settings), []

    def leave(self, reason, count):
        """The reason for so many of the settings that are left, the coarsest first."""
        reason += f" Finer ones likewise: {count - 1}." * (count > 1)
        self.failed.append(self.same | {"value": self.settings[-1], "failure": reason})
        del self.settings[-count:]


def _rows(ladders):
    """The rows of a method: those with numbers, and one for all that failed."""
    failed = [row for ladder in ladders for row in ladder.failed]
    if len(failed) > 1:
        first, *others = failed
        drift = first["drift"] if len({row["drift"] for row in failed}) == 1 else ""
        also = (f"{row['drift']} {row['value']:g}: {row['failure'].partition(':')[0]}" for row in others)
        reasons = f"{first['failure']} So at {first['drift']} {first['value']:g}; also {'; '.join(also)}."
        failed = [first | {"drift": drift, "value": np.nan, "failure": reasons}]
    return [*(row for ladder in ladders for row in ladder.rows), *failed]


def _errors_and_cost(comparison, motion, method, treatment, value, limit):
    """Errors, counts and time of one setting."""
    (t0, t1), times = motion.span, motion.few
    if isinstance(method, Algebraic):
        times = np.union1d(np.linspace(t0, t1, 1 + round(abs(t1 - t0) / value)), motion.knots)
    elif isinstance(method, RungeKutta):
        times = None

    def at(times):
        options = {"drift": treatment, "t_eval": times, "progress": Deadline(limit, motion.span)}
        with fixed(True):
            return whole_run(simulated(motion.model, motion.start, motion.span, method, **options))

    runs, timed = [at(comparison.times)], []
    while len(timed) < TIMED and sum(timed) <= ENOUGH * limit:
        since = time.perf_counter()
        run = at(times)
        timed.append(time.perf_counter() - since)
    if isinstance(method, Taylor) and t1 > t0:
        samples = np.union1d(np.linspace(t0, t1, DEFAULT_SAMPLES), motion.knots)
        runs.append(at(samples).sampled(comparison.times))
    return _errors(comparison, motion, runs) | {
        "operations": motion.model.function("path" if motion.model.flat else "ode").operations,
        "evaluations": run.counters.get("nfev", run.counters.get("iterations", 0)),
        "steps": run.counters.get("steps", len(run.t)),
        "seconds": min(timed),
    }


def _errors(comparison, motion, runs):
    """Errors of a motion at the instants of the comparison: of its samples, and of those between them."""
    run, exact, own = runs[0], comparison.exact, motion.at(comparison.times)
    rate, work, size, law, _ = run.signals("power")[1]
    largest = max(np.abs(size).max(), np.abs(rate).max(), 1e-300)
    lawful = np.abs(law).max() < 1e-9 * largest
    energy, own_energy = run["energy"], own["energy"]
    drifted = np.abs((energy - energy[0]) - (own_energy - own_energy[0])).max()
    return {
        "error": max(comparison.off(each, exact) for each in runs),
        "integration": max(comparison.off(each, own) for each in runs),
        "actuation": comparison.forces_off(run, exact),
        "residual": max((float(np.abs(levels).max(initial=0.0)) for levels in run.residual.values()), default=0.0),
        "energy": float(drifted / max(np.abs(own_energy).max(), 1e-300)),
        "power": float(np.abs(rate - work).max() / largest) if lawful else np.nan,
    }


# --- combinations to measure


def _candidates(model, methods, drift, span, models):
    """(method, treatment, settings) to measure; "algebraic" has no treatment, and is the default for flat programs."""
    length = abs(span[1] - span[0])
    if methods is None:
        all_methods = [name for name in MEASURED if name != "algebraic"] if models == 1 else OF_MODELS
        methods = ["algebraic"] if model.flat else all_methods
    default = (None, "project", length / TIME_CONSTANT) if models == 1 else ("project",)
    wanted = default if drift is None else drift
    names = list(methods) if isinstance(methods, (list, tuple, dict)) else [methods]
    for method in names:
        named(method, METHODS, "method")
    treatments = [as_drift(value) for value in (wanted if isinstance(wanted, (list, tuple)) else [wanted])]
    if any(isinstance(value, Poles) and not isinstance(value.values, float) for value in treatments):
        raise SpecificationError(
            "Poles by row were given.",
            "A study names each treatment by one word or number.",
            do="Give one time constant for all rows.",
            drift=drift,
        )
    given = methods if isinstance(methods, dict) else dict.fromkeys(names)
    settings = {name: _settings(name, given[name], length) for name in names}
    pairs = [(m, None) for m in names if m == "algebraic"]
    integrated = [(m, d) for m in names for d in treatments if m != "algebraic"]
    pairs += [(m, d) for m, d in integrated if drift is not None or type(d) not in as_method(m).refused]
    if not pairs:
        raise SpecificationError(
            f"methods={methods!r} and drift={drift!r} were given.",
            "A study needs at least one method and one treatment of drift.",
            do="Leave both out for the defaults, or give drift=[None] for no treatment.",
            methods=methods,
            drift=drift,
        )
    return [(method, treatment, settings[method]) for method, treatment in pairs]


def _settings(method, given, length):
    """Tolerances or steps of a method, by default for a span of this length [s]."""
    if _kind(method) == "step":
        values, most = [length / n for n in STEP_COUNTS] if given is None else given, np.inf
    else:
        values, most = TOLERANCES if given is None else given, 1.0
    do = f"Give methods=[{method!r}] for its default settings."
    return np.ravel(positives(f"{_kind(method)} of {method}", values, do, most=most)).tolist()


def _kind(method):
    return "step" if isinstance(as_method(method), (Algebraic, RungeKutta)) else "rtol"


def _drift_word(treatment):
    """A treatment as a word, which `arguments_of` reads."""
    if isinstance(treatment, Poles):
        return repr(treatment.values)
    if isinstance(treatment, Project):
        return "project" if treatment.every == 1 else f"project {treatment.every}"
    return "none"


# --- methods and treatments in words


def _in_words(row):
    """Model, method, treatment and setting of a row."""
    drift = {"none": "", "project": ", projected"}.get(row["drift"], f", drift {row['drift']}")
    model = f"{row['model']}, " if row["model"] else ""
    return f"{model}{row['method']} at {row['setting']} {row['value']:.3g}{drift}"


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
