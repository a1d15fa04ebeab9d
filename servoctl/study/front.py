"""What a measured trade tells: the Pareto front, a recommendation, a work-precision plot."""

import numpy as np

from servoctl.checks import is_number
from servoctl.errors import LimitExceeded, SpecificationError, unknown
from servoctl.methods.choice import Algebraic, RungeKutta, as_method
from servoctl.methods.drift import Project
from servoctl.study.table import Study, table

DRIFTS = ("none", "project", "minimal")  # others are time constants of poles
SHOWN = 7


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
        good, error = self._good(), self._told()
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
            Where nothing reaches it; the nearest that does is told.
        """
        if (error is None) == (seconds is None):
            raise SpecificationError(
                f"error={error!r} and seconds={seconds!r} were given.",
                "A recommendation answers one question: the fastest within an error, or the best within a time.",
                do="Give recommend(error=1e-6) or recommend(seconds=1e-3).",
            )
        asked, limit = ("error", error) if seconds is None else ("seconds", seconds)
        if not (is_number(limit) and limit > 0):
            raise SpecificationError(
                f"{asked}={limit!r} was given.", f"{asked} is a positive number.", do="Give 1e-6.", asked=limit
            )
        front = self.pareto()
        reached = front._told() if asked == "error" else front["seconds"]
        within = np.flatnonzero(reached <= limit)
        if not len(within):
            raise self._out_of_reach(asked, limit, front)
        row = front.rows()[within[0] if asked == "error" else within[-1]]
        return Recommendation(_arguments(row), row)

    def _out_of_reach(self, asked, limit, front):
        nearest = "none: every run failed, see the column failure"
        if len(front):
            row = front.rows()[-1 if asked == "error" else 0]
            best = max(row["error"], self.uncertainty)
            nearest = f"{_name(row)}: error {best:.2g} in {row['seconds']:.2g} s"
        rule = f"The reference is itself certain to {self.uncertainty:.1g} only" if asked == "error" else ""
        return LimitExceeded(
            f"{asked}={limit:g} was asked for, which no setting that was measured reaches.",
            rule or "A recommendation is one of the settings that were measured.",
            nearest=nearest,
            do="Raise it, or measure other methods and settings by tradeoff(...).",
            asked=limit,
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
        from servoctl.figures.work_precision import draw

        return draw(self, ax, _cost(cost), title)

    def _good(self):
        return np.flatnonzero(np.isfinite(self["error"]) & np.isfinite(self["seconds"]))

    def _told(self):
        """Errors, where smaller than the reference's uncertainty that uncertainty."""
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
    costs = ("seconds", "evaluations", "steps")
    if name not in costs:
        raise unknown(name, costs, "cost")
    return name
