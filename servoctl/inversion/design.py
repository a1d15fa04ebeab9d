"""Parameters of a program, such as via points and durations, of least actuation or time.

A program with the parameters p determines a motion with signals y(t, p), whose derivatives by p are exact
(`sensitivity`). Sought are the p within ranges that

    minimise   ∫ Σ (y/size)² dt / T   ("rms"),   max |y/size|   ("peak"),   or the duration   ("time")

subject to low <= y <= high. Sequential quadratic programming solves this with inequalities at nodes, which move with
the ends of the motion. Extrema between the nodes that exceed a limit become nodes, too, and it is solved again.
"""

import functools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import field, replace

import casadi as ca
import numpy as np

from servoctl.checks import as_list, by_name, finite, interval, mapping, named, numbers_by_name, require_kind, texts
from servoctl.control.extremes import excesses, extremes, rates, size_of_limit
from servoctl.control.time_law import REACHED, require_no_growth
from servoctl.control.time_optimal import quadrature
from servoctl.errors import LimitExceeded, ServoError, SpecificationError
from servoctl.inversion.verdict import HYPERBOLIC_ZEROS, verdict
from servoctl.markup import Shown
from servoctl.methods.choice import Bounded
from servoctl.model.equations import signal_groups
from servoctl.model.following import corners_of
from servoctl.model.model import Model
from servoctl.progress import progress_bar
from servoctl.run import Run
from servoctl.sensitivities.sensitivity import sensitivity
from servoctl.simulation import judged, simulated
from servoctl.values import frozen
from servoctl.verification import Verification, verify

MINIMISED = ("rms", "peak", "time")
FIRST_NODES = 100  # instants of the motion at which inequalities hold, before extrema between them are added
SQUARE_PANELS = 256  # of the quadrature; knots end panels
SAFELY_INSIDE = 1e-6  # of a limit: by which it is stricter at nodes, and by which a peak may exceed that at nodes
SEARCHES = 12  # of the search, each with more nodes than the one before
APART = 1e-6  # of the motion: least distance of two nodes
QUADRATIC_PROGRAMS = 200  # of sequential quadratic programming
UNCHANGED = 1e-12  # change of the cost, relative to that before, with which sequential quadratic programming ends
ACTIVE = 1e-5  # distance from an inequality, relative to the limit, within which it counts as met
STATIONARY = 1e-4  # of the cost: largest gain across the ranges at a local minimum
MOTION_GROWS = (
    "motion",
    "A design is one of exact inverses: flat, bounded, or integrated forward where errors do not grow.",
    "Begin and end the program with a dwell, or choose another output.",
)  # where errors grow, the rule, and what to do
PROBED = (0.1, 0.3)  # of the ranges: how far from a minimum less cost is looked for


@frozen(eq=False)
class Design(Shown):
    """Parameters of least actuation or time, and the motion with them; made by `design`.

    Attributes
    ----------
    values : dict of str to float
        The parameters that were varied.
    minimise : str
        "rms", "peak" or "time".
    cost, before : float
        What was minimised, with these parameters and with those of the model that was passed.
    plan : Run
        The motion, within all limits. `plan.model` is the model with these parameters.
    proof : Verification
        The check of the plan against the full mechanism.
    binding : tuple of (str, str)
        What bounds the minimum: signals at a limit, parameters at an end of their range; "lower" or "upper" each.
    gain : float
        How much of the cost a change of the parameters across their ranges would save, to first and second order,
        within the limits: zero at a local minimum, and where the cost itself is.
    motions : int
        How many were computed.
    """

    values: dict
    minimise: str
    cost: float
    before: float
    plan: Run = field(repr=False)
    proof: Verification = field(repr=False)
    binding: tuple
    gain: float
    motions: int

    @property
    def model(self):
        """The model with these parameters."""
        return self.plan.model

    @property
    def message(self):
        """Whether this is a local minimum, and if not, what to do."""
        if self.gain <= STATIONARY:
            return f"a local minimum: the gradient left is {self.gain:.1e} of the cost"
        return f"inconclusive: {self.gain:.1e} of the cost is left to save; begin elsewhere, or smooth kinks"

    def __repr__(self):
        shown = [f"{name} = {value:.6g}" for name, value in self.values.items()]
        lines = [f"Design: {self.minimise} {self.before:.6g} -> {self.cost:.6g}; {self.message}"]
        lines += [f"  {', '.join(shown[:8])}" + (f" and {len(shown) - 8} more" if len(shown) > 8 else "")]
        if self.binding:
            lines += ["  bounded by " + ", ".join(f"{name} ({side})" for name, side in self.binding[:6])]
        lines += [f"  {self.motions} motions; verification {self.proof.verdict}"]
        return "\n".join(lines)


def design(
    model: Model,
    vary: Mapping[str, object],
    t_span: Sequence[object],
    minimise: str = "rms",
    of: str | Sequence[str] | Mapping[str, float] | None = None,
    limits: Mapping[str, object] | None = None,
    start: Mapping[str, float] | None = None,
    guess: Mapping[str, float] | None = None,
) -> Design:
    """Parameters of a program, such as via points and durations, of least actuation or time under limits.

    A local minimum by sequential quadratic programming with exact derivatives, found from the numbers of the model.
    Motions are those of the exact inverse: instant by instant for flat programs, bounded for hyperbolic ones,
    integrated forward for others.

    Parameters
    ----------
    model : Model
        Its numbers are where the search begins (`Model.with_parameters`).
    vary : dict of str to (float, float)
        Ranges of the parameters that are varied, {"via_x": (1.0, 4.0)}: of paths, or of the mechanism.
    t_span : (t0, t1)
        [s]; t1 may be an expression of parameters, such as `p.duration`.
    minimise : {"rms", "peak", "time"}
        The root of the mean over time of Σ (y/size)², the largest |y/size|, or t1 - t0, of which limits are part.
    of : str, sequence of str, or dict of str to float, optional
        The signals y with their sizes, {"shoulder": 100.0, "elbow": 40.0}: actuators, outputs, jets. Default: the
        actuation, or the reaction of an ideal program, of size 1 each.
    limits : dict of str to (float, float) or float, optional
        Lower and upper limit of signals; a number c is (-c, c), None leaves a side open.
    start, guess : dict of str to float, optional
        As for `Model.start`. Free initial values stay as they are with the first parameters.

    Returns
    -------
    Design

    Raises
    ------
    SpecificationError
        If a range is empty or without the model's number, an end of the span contains other symbols than parameters,
        or the time is minimised without limits.
    NameUnknown
        For a parameter or signal that the model does not have.
    LimitExceeded
        If no parameters were found with which the motion is within the limits, or it exceeds them between all nodes.
    UnstableInternalDynamics
        If what the program leaves free is unstable, and no bounded motion exists.
    SingularProgram, IntegrationStopped, InconsistentStart
        If there is no motion with the numbers of the model.

    Warns
    -----
    RuntimeWarning
        If the search ends where the cost still has a gradient.
    """
    require_kind(Model, "model", model, "sv.derive(mechanism, program)")
    named(minimise, MINIMISED, "cost")
    ranges = _varied(model, vary)
    sizes, limits = _sized(model, of), _limited(model, limits)
    if minimise == "time" and not limits:
        raise SpecificationError(
            "The time is minimised without limits.",
            "The least time of a motion is that which its actuators allow.",
            do='Pass limits, as {"trolley": 100.0}.',
            minimise=minimise,
        )
    motions = Motions(model, tuple(ranges), _span(model, t_span, ranges), (mapping(start, "The start"), guess))
    with progress_bar("design", None, unit=" motions") as bar:
        motions.count = bar.update
        found = Search(motions, np.array(list(ranges.values())), minimise, sizes, limits).found()
    if found.gain > STATIONARY:
        warnings.warn(f"The design is {found.message}.", RuntimeWarning, stacklevel=2)
    return found


def _varied(model, vary):
    """The ranges of parameters by name, (low, high)."""
    vary = by_name(vary, model.numbers, "parameter", "The parameters that are varied")
    if not vary:
        raise SpecificationError(
            "No parameters are varied.", "A design has at least one.", do='Name some, as {"via_x": (1.0, 4.0)}.'
        )
    ranges, numbers = {name: interval(name, value, "range") for name, value in vary.items()}, model.numbers
    for name, (low, high) in ranges.items():
        number = numbers[name]
        if not np.isfinite([low, high]).all():
            raise SpecificationError(
                f"The range of {name!r} is ({low:g}, {high:g}).", "A range has two finite ends.", name=name
            )
        if not low <= number <= high:
            raise SpecificationError(
                f"{name} = {number:g} is outside its range, {low:g} to {high:g}.",
                "The search begins at the numbers of the model.",
                nearest=f"model.with_parameters({name}={min(max(number, low), high):g}).",
                name=name,
                value=number,
                range=(low, high),
            )
    return ranges


def _sized(model, of):
    """The signals whose actuation counts, with their sizes."""
    if of is None:
        kinds = signal_groups(model.reduction)
        return {name: 1.0 for name, kind in kinds.items() if kind in ("actuation", "reaction")}
    known = (*model.jet_names, *signal_groups(model.reduction))
    if isinstance(of, Mapping):
        return numbers_by_name(of, known, "signal", "size", positive=True)
    return {named(name, known, "signal"): 1.0 for name in texts(of, "The signals")}


def _limited(model, limits):
    """(low, high) by signal."""
    known = (*model.jet_names, *signal_groups(model.reduction))
    for name in mapping(limits, "The limits"):
        named(name, known, "signal")
    return {name: interval(name, value, "limit") for name, value in (limits or {}).items()}


def _span(model, t_span, ranges):
    """t0 and the function of the model's parameters that gives t1 and its derivatives by those that are varied."""
    ends = as_list(t_span) or []
    if len(ends) != 2:
        raise SpecificationError(
            f"t_span is {t_span!r}.", "It has a begin and an end.", do="Write (0.0, p.duration).", t_span=t_span
        )
    t0, end = finite("t0", ends[0], "begin of the span"), ends[1]
    end = end if isinstance(end, ca.SX) and end.is_scalar() else ca.SX(finite("t1", end, "end of the span"))
    symbols, numbers = ca.symvar(end), model.numbers
    name_of = model.reduction.mechanism.parameters.name_of
    names = [named(name_of(s) or s.name(), numbers, "parameter") for s in symbols]
    inputs = {name: ca.SX.sym(name) for name in numbers}
    end = ca.substitute([end], symbols, [inputs[name] for name in names])[0]
    slopes = ca.jacobian(end, ca.vertcat(*(inputs[name] for name in ranges)))
    return t0, ca.Function("end", [ca.vertcat(*inputs.values())], [end, ca.densify(slopes)])


class Motions:
    """The motions of a model by its parameters.

    `names` are those of the k parameters that are varied; `span` is t0 [s] and a function of all parameters that gives
    t1 and its derivatives by the varied ones; `known` has the values of the start that are held, and a guess or None.
    """

    def __init__(self, model, names, span, known):
        self.model, self.names, (self.t0, self.end) = model, names, span
        self.count = lambda: None
        held, guess = known
        self.held, self.guess, self.method = held, guess, None
        if not model.flat:
            begin = model.start(self.t0, guess=guess, **held)
            found = verdict(model, begin)
            if found.dynamics == HYPERBOLIC_ZEROS:
                rest = found.rest["start"] if "start" in found.rest else begin
                begin = replace(begin, values=np.array(getattr(rest, "x", begin.values)))
                self.method, self.held = Bounded(), {}
            self.guess = dict(zip(model.state_names, np.asarray(begin.values).tolist(), strict=False))
        first = self.run(model)
        self.guess = dict(zip(model.state_names, np.asarray(first.start.values).tolist(), strict=False))
        if not model.flat and self.method is None:
            require_no_growth(first, *MOTION_GROWS)
            free = sensitivity(first, model.state_names[0], names).independent
            self.held = {name: self.guess[name] for name in free}
        self.t1 = float(self.ends(self.numbers)[0])
        self.ahead, self.after = self.t0 - float(first.t[0]), float(first.t[-1]) - self.t1

    @property
    def numbers(self):
        """The model's numbers of the parameters (k,)."""
        return np.array([self.model.numbers[name] for name in self.names])

    def ends(self, p):
        """t1 [s] and its derivatives (k,)."""
        numbers = self.model.numbers | dict(zip(self.names, p, strict=True))
        t1, slopes = self.end(list(numbers.values()))
        return float(t1), np.array(slopes).ravel()

    def window(self, p):
        """First and last instant [s] of the motion, and derivatives of the last one (k,)."""
        t1, slopes = self.ends(p)
        return self.t0 - self.ahead, t1 + self.after, slopes

    def with_parameters(self, p):
        """The model with parameters p (k,)."""
        return self.model.with_parameters(**dict(zip(self.names, p.tolist(), strict=True)))

    def run(self, model, times=None):
        """The motion of a model with other parameters at times (N,)."""
        self.count()
        t1, _ = self.ends([model.numbers[name] for name in self.names])
        if not t1 > self.t0:
            raise SpecificationError(
                f"The motion ends at t = {t1:.6g} s and begins at {self.t0:g} s.",
                "A motion goes forward in time.",
                do="Narrow the ranges of the parameters that the end depends on.",
                t1=t1,
            )
        if self.method is None:
            begin = model.start(self.t0, guess=self.guess, **self.held)
        else:
            begin = np.array(list(self.guess.values()))
        return simulated(model, begin, (self.t0, t1), self.method, t_eval=times, progress=False)


@frozen
class Evaluated:
    """Signals at nodes (s, N), their derivatives (s, N, k) there, mean squares (s,), and their derivatives (s, k)."""

    values: np.ndarray
    slopes: np.ndarray
    squares: np.ndarray
    square_slopes: np.ndarray


class Search:
    """The nonlinear program; unknown are the parameters in units of their ranges.

    `ranges` (k, 2) are those of the parameters; `minimise` is "rms", "peak" or "time". Signals count relative to their
    `sizes`, by name, and stay within their `limits`, (low, high) by name.
    """

    def __init__(self, motions, ranges, minimise, sizes, limits):
        self.motions, self.minimise, self.sizes, self.limits = motions, minimise, sizes, limits
        self.low, self.width = ranges[:, 0], ranges[:, 1] - ranges[:, 0]
        self.signals = tuple(dict.fromkeys([*sizes, *limits]))
        place = self.signals.index
        self.peaks = [(place(name), sign, 0.0, size) for name, size in sizes.items() for sign in (1.0, -1.0)]
        self.sides = [
            (place(name), sign, side, size_of_limit(*ends) or 1.0)
            for name, ends in limits.items()
            for sign, side in zip((1.0, -1.0), ends, strict=True)
            if np.isfinite(side)
        ]
        self.evaluated = 0
        self.at_nodes(np.linspace(0.0, 1.0, FIRST_NODES + 1 if limits or minimise == "peak" else 2))

    def at_nodes(self, parts):
        """Evaluate inequalities at these parts (N,) of the motion from now on."""
        self.parts = np.sort(parts)
        self.local = functools.lru_cache(maxsize=64)(lambda data: self._signals_of(np.frombuffer(data)))

    def parameters(self, v):
        """The parameters (k,) of unknowns (k,)."""
        return self.low + self.width * v

    def at(self, v):
        """What is needed of the motion with unknowns v (k,)."""
        return self.local(np.ascontiguousarray(v, dtype=float).tobytes())

    def _signals_of(self, v):
        self.evaluated += 1
        p = self.parameters(v)
        model, (first, last, end_slopes) = self.motions.with_parameters(p), self.motions.window(p)
        nodes = first + self.parts * (last - first)
        t, weights = quadrature([first, *(k for k in corners_of(model) if first < k < last), last], SQUARE_PANELS)
        times, where = np.unique(np.concatenate([nodes, t]), return_inverse=True)
        run = self.motions.run(model, times)
        tangents = sensitivity(run, self.signals, self.motions.names)
        y = np.array([run[name] for name in self.signals])
        dy = np.array([[tangents[name, to] for to in self.motions.names] for name in self.signals]).swapaxes(1, 2)
        at, inside = where[: len(nodes)], where[len(nodes) :]
        slopes = dy[:, at]
        if end_slopes.any():
            moved = np.array([rates(run, name)[at] for name in self.signals])
            slopes = slopes + moved[:, :, None] * self.parts[:, None] * end_slopes
        squares = y[:, inside] ** 2 @ weights / (last - first)
        end = (y[:, at[-1], None] ** 2 - squares[:, None]) * end_slopes
        square_slopes = (np.einsum("sn,n,snk->sk", 2 * y[:, inside], weights, dy[:, inside]) + end) / (last - first)
        return Evaluated(y[:, at], slopes * self.width, squares, square_slopes * self.width)

    # the cost and the inequalities

    def duration(self, v):
        """t1 - t0 [s], and its derivatives (k,)."""
        t1, slopes = self.motions.ends(self.parameters(v))
        return t1 - self.motions.t0, slopes * self.width

    def mean_square(self, v):
        """The mean square of the signals that count, and its derivatives (k,)."""
        local, n = self.at(v), len(self.sizes)
        weights = np.array([*self.sizes.values()]) ** -2.0
        return weights @ local.squares[:n], weights @ local.square_slopes[:n]

    def inside(self, v, sides):
        """How far signals at nodes are inside some sides, relative to their sizes, (c,), and derivatives (c, k)."""
        local = self.at(v)
        values = [sign * (local.values[i] - side) / size for i, sign, side, size in sides]
        slopes = [sign * local.slopes[i] / size for i, sign, _, size in sides]
        return np.concatenate([np.zeros(0), *values]), np.concatenate([np.zeros((0, len(v))), *slopes])

    def cost(self, v):
        """What is minimised, in its own units."""
        if self.minimise == "time":
            return self.duration(v)[0]
        return np.sqrt(self.mean_square(v)[0]) if self.minimise == "rms" else -self.inside(v, self.peaks)[0].min()

    # the search

    def found(self):
        """The design; solved with more nodes until nothing is exceeded between them."""
        motions = self.motions
        v = (motions.numbers - self.low) / self.width
        before = self.measured(v, motions.run(motions.model))
        for _ in range(SEARCHES):
            v = self.feasible(self.solved(v, self.minimise))
            plan = motions.run(motions.with_parameters(self.parameters(v)))
            parts = self.exceeding(v, plan)
            if not parts:
                less = self.gain(v)[1]
                if less is None:
                    return self.designed(v, before, plan)
                v = less
            self.at_nodes(np.append(self.parts, parts))
        if any(excess > 0 for excess, *_ in excesses(plan, self.limits)):
            raise self.beyond(plan)
        return self.designed(v, before, plan)

    def designed(self, v, before, plan):
        """The result for the unknowns of a minimum, with its plan."""
        values = dict(zip(self.motions.names, self.parameters(v).tolist(), strict=True))
        if not plan.model.flat and self.motions.method is None:
            require_no_growth(plan, *MOTION_GROWS)
            plan = judged(plan)
        limits = [(name, side) for excess, name, side, *_ in excesses(plan, self.limits) if abs(excess) <= REACHED]
        at_ends = [
            (name, "lower" if x < 0.5 else "upper")
            for name, x in zip(values, v, strict=True)
            if min(x, 1.0 - x) <= ACTIVE
        ]
        return Design(
            values,
            self.minimise,
            self.measured(v, plan),
            before,
            plan,
            verify(plan),
            (*limits, *at_ends),
            float(self.gain(v)[0]),
            self.evaluated,
        )

    def measured(self, v, plan):
        """The cost of a motion, a peak refined between its samples."""
        if self.minimise != "peak":
            return float(self.cost(v))
        return max(abs(value) / size for name, size in self.sizes.items() for value, _ in extremes(plan, name))

    def exceeding(self, v, plan):
        """Extrema of the plan that exceed a limit, or the peak at nodes, in parts of the motion."""
        limits = [(name, *ends) for name, ends in self.limits.items()]
        if self.minimise == "peak":
            peak = self.cost(v) * (1.0 + SAFELY_INSIDE)
            limits += [(name, -peak * size, peak * size) for name, size in self.sizes.items()]
        times = [t for name, low, high in limits for t in _extrema_beyond(plan, name, low, high)]
        parts = [(t - plan.t[0]) / np.ptp(plan.t) for t in times]
        return [part for part in parts if np.abs(self.parts - part).min() > APART]

    def feasible(self, v):
        """Unknowns within the limits: these, or those of the minimum that is found from the ones of least excess."""
        if self.keeps(v):
            return v
        least = self.solved(v, "excess")
        if not self.keeps(least):
            raise self.beyond(self.motions.run(self.motions.with_parameters(self.parameters(least))))
        again = self.solved(least, self.minimise)
        return again if self.keeps(again) else least

    def keeps(self, v):
        """Whether signals at nodes are within their limits."""
        return self.inside(v, self.sides)[0].min(initial=0.0) >= 0.0

    def solved(self, v, what):
        """Unknowns (k,) of a minimum from v."""
        return NonlinearProgram(self, what, v).minimum(v)

    def gain(self, v):
        """How much of the cost is left to save within the limits, and unknowns (k,) of less cost, None without any."""
        from scipy.linalg import null_space
        from scipy.optimize import nnls

        problem, k = NonlinearProgram(self, self.minimise, v), len(v)
        x = problem.start(v)
        ends = np.pad(np.vstack([np.eye(k)[v <= ACTIVE], -np.eye(k)[v >= 1.0 - ACTIVE]]), ((0, 0), (0, len(x) - k)))
        met = problem.inequalities(x)[0] <= ACTIVE

        def slopes(x):
            return problem.cost(x)[1], np.vstack([ends, problem.inequalities(x)[1][met]])

        def allowed(v):
            try:
                return self.cost(v) if self.keeps(v) else np.inf
            except ServoError:
                return np.inf

        gradient, active = slopes(x)
        balance, first = nnls(active.T, gradient) if len(active) else (np.zeros(0), np.linalg.norm(gradient))
        along = null_space(np.vstack([active[balance > 0], 0 * x])).T
        try:
            bent = [g - gradient - (rows - active).T @ balance for g, rows in (slopes(x + ACTIVE * d) for d in along)]
            rises = max(self.cost(v + ACTIVE * d) for d in np.diag(np.where(v < 0.5, 1.0, -1.0))) - self.cost(v)
        except ServoError:
            return float(first), None
        curvature, directions = np.linalg.eigh(np.reshape(bent, along.shape) @ along.T / ACTIVE)
        steps = np.outer(PROBED, (directions.T @ along)[:, :k]).reshape(-1, k)
        less = min(np.clip([v, *v + steps, *v - steps], 0.0, 1.0), key=allowed)
        less = less if allowed(less) < (1 - STATIONARY) * self.cost(v) else None
        zero = self.cost(v) * ACTIVE < STATIONARY * rises  # beside what the ranges make of it
        return 0.0 if zero else max(float(first), -curvature.min(initial=0.0) / 2), less

    def beyond(self, plan):
        """The error of a motion that exceeds a limit."""
        excess, name, _, t, *_ = max(excesses(plan, self.limits))
        (least, _), (most, _) = extremes(plan, name)
        return LimitExceeded(
            f"With the least excess that was found {name} exceeds its limit by {100 * excess:.3g} % at t = {t:.4g} s.",
            "A design keeps its limits at all instants.",
            nearest=f"{name} within {least:.6g} .. {most:.6g}.",
            do="Widen the limits or the ranges of the parameters, or begin from other numbers.",
            name=name,
            excess=excess,
            t=t,
            values={name: plan.model.numbers[name] for name in self.motions.names},
        )


class NonlinearProgram:
    """The cost and the inequalities of x = v, or of x = (v, z) where the bound z of what exceeds some sides is least.

    `what` is "rms", "time", "peak", the excess of magnitudes over zero, or "excess", that over limits. Costs, but for
    an excess, are relative to the one at v (k,), where the search begins.
    """

    def __init__(self, search, what, v):
        self.search, self.what, self.k = search, what, len(v)
        self.scale = 1.0 if what == "excess" else search.cost(v) or 1.0
        self.kept = [] if what == "excess" else search.sides
        self.least = {"peak": search.peaks, "excess": search.sides}.get(what, [])
        self._known = None

    def start(self, v):
        """The unknowns x of v."""
        excess = -self.search.inside(v, self.least)[0] / self.scale
        return np.append(v, excess.max()) if self.least else v

    def minimum(self, v):
        """The unknowns (k,) of a minimum from v."""
        from scipy.optimize import minimize

        inequalities = {"fun": lambda x: self._evaluated(x)[1], "jac": lambda x: self._evaluated(x)[2]}
        x = minimize(
            lambda x: self._evaluated(x)[0],
            self.start(v),
            jac=True,
            method="SLSQP",
            bounds=[(0.0, 1.0)] * self.k + [(-ACTIVE, None)] * bool(self.least),
            constraints=inequalities | {"type": "ineq"},
            options={"maxiter": QUADRATIC_PROGRAMS, "ftol": UNCHANGED},
        ).x
        x = x if np.isfinite(self._evaluated(x)[0][0]) else self._last  # the last one with a motion
        return np.clip(x[: self.k], 0.0, 1.0)

    def _evaluated(self, x):
        """The cost with its derivatives, the inequalities, and their derivatives.

        Without a motion the cost is infinite beside the last inequalities: the line search shortens its step.
        """
        try:
            self._known, self._last = (self.cost(x), *self.inequalities(x)), np.array(x)
        except ServoError:
            if self._known is None:
                raise
            (_, slopes), *inequalities = self._known
            return (np.inf, slopes), *inequalities
        return self._known

    def cost(self, x):
        """The cost, relative to that at the start, and its derivatives."""
        if self.least:
            return x[-1], np.eye(len(x))[-1]
        timed = self.what == "time"
        value, slopes = self.search.duration(x) if timed else self.search.mean_square(x)
        scale = self.scale if timed else self.scale**2
        return value / scale, slopes / scale

    def inequalities(self, x):
        """What is not negative, (c,), and its derivatives (c, len(x))."""
        v, bounds = x[: self.k], ((0, 0), (0, len(x) - self.k))
        kept, kept_slopes = self.search.inside(v, self.kept)
        least, least_slopes = (part / self.scale for part in self.search.inside(v, self.least))
        slopes = [np.pad(kept_slopes, bounds), np.pad(least_slopes, bounds, constant_values=1.0)]
        return np.concatenate([kept - SAFELY_INSIDE, least + x[-1]]), np.concatenate(slopes)


def _extrema_beyond(plan, name, low, high):
    """Instants of the extrema of a signal beyond its limits."""
    t, y = plan.t, plan[name]
    for excess in (y - high, low - y):
        yield from (float(t[k]) for k in (0, -1) if excess[k] > 0)
        inner = (excess[1:-1] > 0) & (excess[1:-1] >= excess[:-2]) & (excess[1:-1] > excess[2:])
        for k in np.flatnonzero(inner):
            yield _vertex(t[k : k + 3], excess[k : k + 3])


def _vertex(t, y):
    """Where the parabola through three samples (3,), the middle one the largest, has its maximum."""
    (a, b), (left, right) = np.diff(t), np.diff(y)
    return float(t[1] + (left * b**2 + right * a**2) / (2 * (left * b - right * a)))
