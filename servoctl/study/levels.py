"""Levels of modelling: what each simplification of a model costs in error and saves in time, measured on one scene."""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from servoctl.checks import as_span, mapping, named, numbers_by_name, text
from servoctl.errors import LimitExceeded, SpecificationError
from servoctl.markup import Shown
from servoctl.progress import progress_bar
from servoctl.study.cases import as_cases
from servoctl.study.modelling import Levelled, add_likeness
from servoctl.study.power_law import Prediction, power_law
from servoctl.study.sweep import name_of
from servoctl.study.table import SHOWN, Study, machine, table
from servoctl.study.tradeoff import Recommendation, arguments_of, as_cost, bound, unbeaten

ERRORS = ("error", "modelling", "actuation", "in_loop")


def levels(
    builds: Mapping[str, Callable], t_span: tuple[float, float], *, reference: str,
    start: Mapping[str, float] | Callable | None = None, outputs: Sequence[str] | Mapping[str, float] | None = None,
    cases: Sequence[Mapping] | Mapping[str, Sequence] | None = None, law: Callable | None = None,
    progress: bool | None = None,
) -> "Levels":  # fmt: skip
    """Measure what each level of modelling costs in error of motion and actuation, and saves in time.

    All levels follow the same program. Each is simulated with several tolerances, in turn, so that all are timed under
    the same conditions, and compared with the converged motion of one of them, the reference.

    Main arguments

    Parameters
    ----------
    builds : dict of str to callable, (Mechanism, Program) or Model
        The levels by name. A function returns a (Mechanism, Program) or a Model; its parameters are taken from the
        cases by name. A `Plant` in the place of the mechanism adds what the plan does not contain, such as friction,
        lag and limits, to the loop.
    t_span : (t0, t1)
        [s]
    reference : str
        Name of the level with which the others are compared.
    start : dict of str to float or callable, optional
        Values at t0 that are held, by name, in each level that has them. What a level leaves free is as near as
        possible to the start of the reference. Or a function of a model that returns its start.
    outputs : sequence of str or dict of str to float, optional
        Signals that all levels have, of which the error of motion is taken, with the sizes to which it is relative, in
        their units. Default: the coordinates and outputs of all levels, relative to their largest magnitudes in the
        reference, coordinates to at least 1e-3 of the largest of them.

    Other arguments

    cases : sequence of dict, or dict of sequences, optional
        Parameters of the levels for which all is measured, as of `grid`; default: the levels as they are. Three or
        more permit `predict`.
    law : callable, optional
        `law(plan, plant)` returns the law of a level's plan and plant, such as `sv.feedforward`. It is closed around
        the plant of the reference, from the reference's start: the error that a machine would show which is like the
        reference. Default: no loop.
    progress : bool, optional
        Show a progress bar; default: on a terminal, for work of more than a second.

    Returns
    -------
    Levels
        What a level cannot do is a row with the reason. After Ctrl-C the rows so far, with `meta["message"]`
        "interrupted".

    Raises
    ------
    NameUnknown
        For a reference that is no level, a signal that a level does not have, a value or parameter that none has.
    SpecificationError
        For levels that are no models or share no signal.
    ServoError
        If the reference itself cannot be computed in the first case.
    """
    named(reference, mapping(builds, "The levels"), "level")
    span = as_span(t_span)
    scene = Levelled(builds, reference, span, start, outputs, _as_law(law))
    cases = _checked_cases(cases, scene)
    rows, interrupted, uncertain = [], False, np.zeros(2)
    with progress_bar("levels", progress, len(cases) * len(builds), unit="level") as bar, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of growth and steps: the errors are measured
        try:
            for i, case in enumerate(cases):
                measured, unsure = scene.measured(case, bar)
                rows += [{"case": i, **case, **row, "resolved": row.get("error", 0.0) >= unsure[0]} for row in measured]
                uncertain = np.maximum(uncertain, unsure)
        except KeyboardInterrupt:
            interrupted = True
    add_likeness(rows)
    names = ("case", *cases[0], *Levels.COLUMNS)
    agreement = dict(zip(("error", "actuation"), uncertain.tolist(), strict=True))
    meta = {"t_span": list(span), "levels": list(builds), "parameters": list(cases[0])}
    meta |= {"outputs": list(scene.names or ()), "actuators": list(scene.actuators or ())}
    meta |= {"law": "" if law is None else name_of(law), "reference": {"level": reference, **agreement}}
    meta |= {"message": "interrupted" if interrupted else "", "measured": time.strftime("%Y-%m-%d")}
    meta |= {"machine": machine()}
    return Levels("levels", {name: [row.get(name) for row in rows] for name in names}, meta)


class Levels(Study):
    """Errors and costs of levels of modelling; made by `levels`.

    Columns: case (the index), its parameters; level; method, drift, setting ("rtol", empty where nothing is integrated)
    and its value, as in `TradeOff`; error: the largest deviation of the common signals from the converged motion of the
    reference, relative to their sizes, over at least 402 instants; modelling: that of the level's own converged motion;
    integration: the deviation from this; actuation: the deviation of the forces and moments of the same names; in_loop:
    the deviation of the reference's plant under the level's law (NaN without one); modelling_like, actuation_like,
    in_loop_like: the cosine of the error's course in time with that in the first case (1: the same up to a factor);
    operations of one evaluation of the rates, or of Newton's step; evaluations and steps; seconds: processor time of
    the shortest of three or more calls, in turn with those of all other rows, with samples at the same instants;
    resolved: whether the error exceeds the uncertainty; failure: why numbers are missing.
    """

    COLUMNS = (
        *("level", "method", "drift", "setting", "value", "error", "modelling", "integration", "actuation", "in_loop"),
        *("modelling_like", "actuation_like", "in_loop_like"),
        *("operations", "evaluations", "steps", "seconds", "resolved", "failure"),
    )

    @property
    def uncertainty(self) -> float:
        """Largest deviation of two methods on one level: smaller errors are not resolved."""
        return self._floor("error")

    def pareto(self, cost: str = "seconds", of: str = "error") -> "Levels":
        """The rows that no other row of their case beats in both error and cost, from cheap to accurate.

        Parameters
        ----------
        cost : {"seconds", "evaluations", "steps"}
        of : {"error", "modelling", "actuation", "in_loop"}

        Returns
        -------
        Levels
        """
        cost, error = self[as_cost(cost)], self._errors(named(of, ERRORS, "error"))
        front = []
        for case in np.unique(self["case"]):
            good = np.flatnonzero((self["case"] == case) & np.isfinite(error) & np.isfinite(cost))
            front += good[unbeaten(cost[good], error[good])].tolist()
        return self.take(front)

    def recommend(
        self, *, error: float | None = None, seconds: float | None = None, of: str = "error",
        parameters: Mapping[str, float] | None = None,
    ) -> Recommendation:  # fmt: skip
        """The level and arguments of `simulate`: the fastest within an error, or the most accurate within a time.

        Parameters
        ----------
        error : float, optional
            Largest error, relative.
        seconds : float, optional
            Longest time of a call [s], on the machine that measured.
        of : {"error", "modelling", "actuation", "in_loop"}
            Which error.
        parameters : dict of str to float, optional
            For these parameters, by the upper ends of predicted errors where they were not measured. Default: for all
            measured cases, by the largest error of them.

        Returns
        -------
        Recommendation
            A dict of arguments; `.row["level"]` is the level.

        Raises
        ------
        SpecificationError
            Unless exactly one of the two bounds is given, a positive number.
        LimitExceeded
            If no row reaches it; the message has the nearest one.
        """
        (wanted, limit), of = bound(error, seconds), named(of, ERRORS, "error")
        rows = [row for row in self._candidates(of, parameters) if np.isfinite(row[of]) and np.isfinite(row["seconds"])]
        better = "seconds" if wanted == "error" else of
        reached = of if wanted == "error" else "seconds"
        within = [row for row in rows if row[reached] <= limit]
        if not within:
            raise self._out_of_reach(wanted, limit, min(rows, key=lambda row: row[reached], default=None), of)
        best = min(within, key=lambda row: row[better])
        return Recommendation(arguments_of(best), best)

    def predict(self, level: str, parameters: Mapping[str, float], of: str = "modelling") -> Prediction:
        """The error of a level at parameters that were not measured, by a power law through the measured cases.

        Parameters
        ----------
        level : str
        parameters : dict of str to float
            All parameters of the cases, SI.
        of : {"modelling", "error", "actuation", "in_loop"}
            Which error, of the level's finest setting.

        Returns
        -------
        Prediction
            Inconclusive where the cases do not show a law, or do not reach near the parameters.

        Raises
        ------
        NameUnknown
            For a name that is no level or no parameter of the cases.
        SpecificationError
            If parameters are missing, or no cases were measured.
        """
        of, at = named(of, ERRORS, "error"), self._parameters(parameters)
        rows = self.where(level=named(level, self.meta["levels"], "level"))
        cases = np.unique(rows["case"])
        of_case = [np.flatnonzero((rows["case"] == case) & np.isfinite(rows[of])) for case in cases]
        finest = [some[np.argmin(rows["integration"][some])] for some in of_case if len(some)]
        rows = rows.take(finest)
        return self._law(rows, at, of, rows[of], self._floor(of))

    def plot(self, ax=None, cost: str = "seconds", of: str = "error", title: str = ""):
        """Draw error over cost, the front of all levels in colour.

        Parameters
        ----------
        ax : Axes, optional
        cost : {"seconds", "evaluations", "steps"}
        of : {"error", "modelling", "actuation", "in_loop"}
        title : str

        Returns
        -------
        Axes
            Of the first case; `study.where(case=1).plot()` is that of another.
        """
        from servoctl.figures.work_precision import draw_levels

        first = self.where(case=int(self["case"].min(initial=0)))
        return draw_levels(first, ax, as_cost(cost), named(of, ERRORS, "error"), text("title", title))

    def _parameters(self, parameters):
        """All parameters of the cases by name, in their order."""
        names = self.meta["parameters"]
        at = numbers_by_name(parameters, names, "parameter of the cases", "parameter")
        missing = [name for name in names if name not in at]
        if missing or not names:
            raise SpecificationError(
                f"parameters={dict(at)} were given.",
                f"A prediction needs all parameters of the cases: {', '.join(names)}." if names else
                "The levels were measured with one set of parameters.",
                do=f"Add {', '.join(missing)}." if names else "Measure several: levels(..., cases=...).",
                missing=missing,
            )  # fmt: skip
        return {name: at[name] for name in names}

    def _floor(self, of):
        """The uncertainty of an error: below it, it is not resolved."""
        return self.meta["reference"]["actuation" if of == "actuation" else "error"]

    def _errors(self, of):
        return np.maximum(self[of], self._floor(of))

    def _law(self, rows, at, of, errors, floor=0.0):
        texts = [name for name in at if rows[name].dtype.kind == "U"]
        if texts:
            rule, do = "A law is one of numbers.", f"Take the rows by study.where({texts[0]}=...)."
            raise SpecificationError(f"The parameter {texts[0]!r} of the cases is a text.", rule, do=do, name=texts[0])
        cases = np.column_stack([rows[name] for name in at]).reshape(len(rows), len(at)).astype(float)
        likeness = rows["modelling_like" if of == "error" else f"{of}_like"]
        return power_law(cases, errors, at, floor, likeness=likeness.min(initial=1.0))

    def _candidates(self, of, parameters):
        """One row for each level and setting: the largest numbers of all cases, or those for these parameters."""
        at = None if parameters is None else self._parameters(parameters)
        keys = [str(key) for key in zip(*(self[name].tolist() for name in ("level", "method", "value")), strict=True)]
        for key in dict.fromkeys(keys):
            rows = self.take([i for i, other in enumerate(keys) if other == key])
            errors, same = rows._errors(of), np.ones(len(rows), dtype=bool)
            for name, value in (at or {}).items():
                same &= rows[name] == value
            if same.any():
                largest = float(errors[same].max())
            else:
                known = np.flatnonzero(np.isfinite(errors))
                largest = self._law(rows.take(known), at, of, errors[known]).high
            yield rows.rows()[0] | {of: largest, "seconds": float(rows["seconds"].max())} | (at or {})

    def _out_of_reach(self, wanted, limit, row, of):
        nearest, reason = "", "no level has a number for all cases, see the column failure"
        if row is not None:
            nearest = f"{row['level']}, {_setting(row)}: {of} {row[of]:.2g} in {row['seconds']:.2g} s"
            reason = "no measured level reaches it"
        return LimitExceeded(
            f"{wanted}={limit:g} was given, and {reason}.",
            f"The motions themselves have the uncertainty {self._floor(of):.1g}." if wanted == "error" else "",
            nearest=nearest,
            do=f"Raise {wanted}, or measure other levels.",
            limit=limit,
            uncertainty=self._floor(of),
        )

    def _tables(self):
        return Shown._tables(self)

    def __repr__(self):
        t0, t1 = self.meta["t_span"]
        failed, front = int((self["failure"] != "").sum()), self.pareto()
        front = front.where(case=int(front["case"].min(initial=0)))
        shown = np.unique(np.linspace(0, len(front) - 1, min(SHOWN, len(front))).round().astype(int))
        cases = len(np.unique(self["case"]))
        lines = [
            f"Levels of modelling: {len(self.meta['levels'])}, {cases} case{'s' * (cases != 1)}, {len(self)} rows, "
            f"{failed} with a failure; t = {t0:g} .. {t1:g} s" + ("; interrupted" if self.meta.get("message") else ""),
            f"  reference: {self.meta['reference']['level']}; uncertainty {self.uncertainty:.1e}",
            f"  signals: {', '.join(self.meta['outputs'])}"[:118],
            f"  fastest for each error, {len(shown)} of {len(front)}:" if len(front) else "  every level failed",
        ]
        names = ("level", "value", "error", "modelling", "actuation", "in_loop", "operations", "seconds")
        return "\n".join(lines + (table(front.take(shown), names) if len(front) else []))


# --- the input


def _as_law(law):
    if law is not None and (isinstance(law, type) or not callable(law)):
        rule, do = "It is a function law(plan, plant) that returns a Law.", "Write law=sv.feedforward."
        raise SpecificationError(f"law={repr(law)[:150]} was given.", rule, do=do, type=type(law).__name__)
    return law


def _checked_cases(cases, scene):
    """Cases whose parameters are some level's, and no columns of the table."""
    cases = [{}] if cases is None else as_cases(cases)
    known = scene.parameters(cases[0]) if cases[0] else ()
    for name in cases[0]:
        if name in Levels.COLUMNS:
            rule = f"The table has a column of this name: {', '.join(Levels.COLUMNS)}."
            raise SpecificationError(f"A parameter is named {name!r}.", rule, do="Choose another name.", name=name)
        named(name, known, "parameter of a level")
    return cases


def _setting(row):
    return row["method"] + (f", rtol {row['value']:g}" if row["setting"] else "")
