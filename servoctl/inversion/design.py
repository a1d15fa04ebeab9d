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
from servoctl.control.time_law import REACHED
from servoctl.errors import LimitExceeded, ServoError, SpecificationError, UnstableInternalDynamics
from servoctl.growth import internal_dynamics
from servoctl.inversion.report import extremes
from servoctl.inversion.verdict import HYPERBOLIC_ZEROS, verdict
from servoctl.markup import Shown
from servoctl.methods.choice import Bounded
from servoctl.model.model import Model
from servoctl.progress import progress_bar
from servoctl.run import Run
from servoctl.sensitivities.sensitivity import sensitivity
from servoctl.simulation import judged, simulated
from servoctl.values import frozen
from servoctl.verification import Verification, verify

MINIMISED = ("rms", "peak", "time")
FIRST_NODES = 100  # instants of the motion at which inequalities hold, before extrema between them are added
SQUARE_PANELS, EIGHT_NODES = 32, np.polynomial.legendre.leggauss(8)  # of the quadrature; knots end panels
MOST_PANELS = 1024  # with which jumps of the actuation between knots are integrated to a thousandth
QUADRATURE = 1e-8  # of a mean square: error of its quadrature, beyond which it gets twice as many panels
SAFELY_INSIDE = 1e-6  # of a limit: by which it is stricter at nodes, and by which a peak may exceed that at nodes
SEARCHES = 12  # of the search, each with more nodes or panels than the one before
REGIONS = 30  # of one search, each in a smaller or larger region around the best motion
SMALLEST_REGION = 1e-6  # of the ranges: region without a motion next to one with a motion
QUADRATIC_PROGRAMS = 200  # of sequential quadratic programming in one region
UNCHANGED = 1e-12  # change of the cost, relative to that before, with which sequential quadratic programming ends
ACTIVE = 1e-5  # distance from an inequality, relative to the limit, within which it counts as met
STATIONARY = 1e-4  # of the cost: largest gain across the ranges at a local minimum
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
        try:
            found = Search(motions, np.array(list(ranges.values())), minimise, sizes, limits).found()
        except NoMotion as failure:
            raise failure.error from None
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
        kinds = model.signal_groups
        return {name: 1.0 for name, kind in kinds.items() if kind in ("actuation", "reaction")}
    known = (*model.jet_names, *model.signal_groups)
    if isinstance(of, Mapping):
        return numbers_by_name(of, known, "signal", "size", positive=True)
    return {named(name, known, "signal"): 1.0 for name in texts(of, "The signals")}


def _limited(model, limits):
    """(low, high) by signal."""
    known = (*model.jet_names, *model.signal_groups)
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


class NoMotion(Exception):
    """Parameters `at` (k,) in units of their ranges, for which there is no motion, and the error that says why."""

    def __init__(self, at, error):
        self.at, self.error = at, error


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
            _require_no_growth(model, first)
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


def _require_no_growth(model, run):
    """Refuse a motion that is integrated forward, along which errors grow."""
    internal = internal_dynamics(run)
    if internal.verdict == "unstable":
        raise UnstableInternalDynamics(
            f"Along the motion {internal.sentence()}.",
            "A design is one of exact inverses: flat, bounded, or integrated forward where errors do not grow.",
            do="Begin and end the program with a dwell, or choose another output.",
            growth=float(internal.growth),
        )


def _derivatives_at(run, signals, picked):
    """The time derivatives (s, N) of signals at some samples (N,), which are in order."""
    parts = []
    for first, end, model in run.variants or ((0, len(run.t), run.model),):
        inside = picked[(picked >= first) & (picked < end)]
        groups = {_rate_group(model, name) for name in signals if not _is_state_jet(model, name)}
        functions = {group: model.signals(*group)[1] for group in groups}
        size = max([len(model.jet_names) + model.n, *(f.n_x for f in functions.values())])
        jets = model.extended(run.t[inside], run.jets[: len(model.jet_names), inside], size)
        grids = {g: f.grid(run.t[inside], jets[: f.n_x], model.parameters) for g, f in functions.items()}
        parts.append([_rate_row(model, name, jets, grids) for name in signals])
    return np.concatenate(parts, axis=1)


def _is_state_jet(model, name):
    """Whether the derivative of a signal is another jet."""
    return name in model.jet_names and (model.reduction.mechanism.q.plain or name not in model.coordinate_names)


def _rate_group(model, name):
    """The group of a signal's derivative, and its order there."""
    return ("coordinate_rates", 0) if name in model.coordinate_names else (model.signal_groups[name], 1)


def _rate_row(model, name, jets, grids):
    """The derivative of a signal (N,) out of jets and groups of signals."""
    if _is_state_jet(model, name):
        return jets[model.jet_names.index(name) + model.n]
    kind, order = _rate_group(model, name)
    return grids[kind, order][model.signals(kind)[0].index(name if order else f"d{name}")]


@frozen
class Nodes:
    """Instants t0 + part (t1 - t0) + offset of motions, each (N,), in order for the first one."""

    part: np.ndarray
    offset: np.ndarray

    def at(self, t0, t1):
        """The instants (N,) [s]."""
        return t0 + self.part * (t1 - t0) + self.offset

    def joined(self, t0, t1, times):
        """These and further instants (N,), which are instants of the motion from t0 to t1."""
        t = np.asarray(times)
        inside = np.clip(t, t0, t1)
        part, offset = np.append(self.part, (inside - t0) / (t1 - t0)), np.append(self.offset, t - inside)
        order = np.argsort(t0 + part * (t1 - t0) + offset)
        return Nodes(part[order], offset[order])


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
        self.panels, self.evaluated = SQUARE_PANELS, 0
        count = FIRST_NODES + 1 if limits or minimise == "peak" else 2
        t = np.linspace(motions.t0 - motions.ahead, motions.t1 + motions.after, count)
        none = Nodes(np.zeros(0), np.zeros(0))
        self.nodes = none.joined(motions.t0, motions.t1, t)
        self.clear()

    def clear(self):
        """Forget motions that were evaluated at other nodes."""
        self._known = functools.lru_cache(maxsize=64)(lambda data: self._local(np.frombuffer(data)))

    def parameters(self, v):
        """The parameters (k,) of unknowns (k,)."""
        return self.low + self.width * v

    def local(self, v):
        """What is needed of the motion with unknowns v (k,)."""
        return self._known(np.ascontiguousarray(v, dtype=float).tobytes())

    def _local(self, v):
        self.evaluated += 1
        try:
            return self._signals_of(self.parameters(v))
        except ServoError as error:
            raise NoMotion(v, error) from error

    def _signals_of(self, p):
        model, (t1, end_slopes) = self.motions.with_parameters(p), self.motions.ends(p)
        fixed = self.nodes.at(self.motions.t0, t1)
        edges = [k for k in model.knots if fixed[0] < k < fixed[-1]]
        t, weights = _quadrature([fixed[0], *edges, fixed[-1]], self.panels)
        times, where = np.unique(np.concatenate([fixed, t]), return_inverse=True)
        run = self.motions.run(model, times)
        tangents = sensitivity(run, self.signals, self.motions.names)
        y = np.array([run[name] for name in self.signals])
        dy = np.array([[tangents[name, to] for to in self.motions.names] for name in self.signals]).swapaxes(1, 2)
        at, inside = where[: len(fixed)], where[len(fixed) :]
        slopes = dy[:, at]
        if end_slopes.any():
            slopes = slopes + _derivatives_at(run, self.signals, at)[:, :, None] * self.nodes.part[:, None] * end_slopes
        length = fixed[-1] - fixed[0]
        squares = y[:, inside] ** 2 @ weights / length
        end = (y[:, at[-1], None] ** 2 - squares[:, None]) * end_slopes
        square_slopes = (np.einsum("sn,n,snk->sk", 2 * y[:, inside], weights, dy[:, inside]) + end) / length
        return Evaluated(y[:, at], slopes * self.width, squares, square_slopes * self.width)

    def _by_name(self, p):
        return dict(zip(self.motions.names, p.tolist(), strict=True))

    # the cost and the inequalities

    def rms(self, local):
        """The mean square of the signals that count, and its derivatives (k,)."""
        n = len(self.sizes)
        weights = np.array([*self.sizes.values()]) ** -2.0
        return weights @ local.squares[:n], weights @ local.square_slopes[:n]

    def relative(self, local):
        """The signals that count over their sizes (n, N) and derivatives (n, N, k)."""
        sizes = np.array([*self.sizes.values()])
        return local.values[: len(sizes)] / sizes[:, None], local.slopes[: len(sizes)] / sizes[:, None, None]

    def cost(self, v):
        """What is minimised, in its own units."""
        if self.minimise == "time":
            return self.motions.ends(self.parameters(v))[0] - self.motions.t0
        local = self.local(v)
        return np.sqrt(self.rms(local)[0]) if self.minimise == "rms" else np.abs(self.relative(local)[0]).max()

    def within(self, v):
        """How far signals at nodes are inside their limits, relative to these, (c,), and derivatives (c, k)."""
        local, values, slopes = self.local(v), [np.zeros(0)], [np.zeros((0, len(v)))]
        for name, (low, high) in self.limits.items():
            i, size = self.signals.index(name), _size_of_limit(low, high)
            for sign, side in ((1.0, low), (-1.0, high)):
                if np.isfinite(side):
                    values.append(sign * (local.values[i] - side) / size - SAFELY_INSIDE)
                    slopes.append(sign * local.slopes[i] / size)
        return np.concatenate(values), np.concatenate(slopes)

    # the search

    def found(self):
        """The design; solved with more nodes and panels until nothing is exceeded between them."""
        motions = self.motions
        v = (motions.numbers - self.low) / self.width
        before = self.measured(v, motions.run(motions.model))
        for _ in range(SEARCHES):
            v = self.feasible(self.solved(v, self.minimise))
            plan = motions.run(motions.with_parameters(self.parameters(v)))
            times = self.exceeding(v, plan)
            doubled = self.minimise == "rms" and self.refined(v)
            if not times and not doubled:
                less = self.gain(v)[1]
                if less is None:
                    return self.designed(v, before, plan)
                v = less
            if times:
                self.nodes = self.nodes.joined(motions.t0, motions.ends(self.parameters(v))[0], times)
            self.clear()
        if any(excess > 0 for excess, *_ in _beyond_limits(plan, self.limits)):
            raise self.beyond(plan)
        return self.designed(v, before, plan)

    def designed(self, v, before, plan):
        """The result for the unknowns of a minimum, with its plan."""
        values = self._by_name(self.parameters(v))
        if not plan.model.flat and self.motions.method is None:
            _require_no_growth(plan.model, plan)
            plan = judged(plan)
        limits = [
            (name, side)
            for name, ends in self.limits.items()
            for (value, _), limit, side in zip(extremes(plan, name), ends, ("lower", "upper"), strict=True)
            if np.isfinite(limit) and abs(value - limit) <= REACHED * _size_of_limit(*ends)
        ]
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
        """Instants of extrema of the plan that exceed a limit, or the peak at nodes."""
        limits = [(name, *ends) for name, ends in self.limits.items()]
        if self.minimise == "peak":
            peak = self.cost(v) * (1.0 + SAFELY_INSIDE)
            limits += [(name, -peak * size, peak * size) for name, size in self.sizes.items()]
        times = [t for name, low, high in limits for t in _extrema_beyond(plan, name, low, high)]
        known = self.nodes.at(self.motions.t0, self.motions.ends(self.parameters(v))[0])
        close = SMALLEST_REGION * np.ptp(known)
        return [t for t in times if np.abs(known - t).min() > close]

    def refined(self, v):
        """Whether mean squares change with twice as many panels, which are then taken."""
        if self.panels >= MOST_PANELS:
            return False
        coarse = self.rms(self.local(v))[0]
        self.panels *= 2
        self.clear()
        if abs(self.rms(self.local(v))[0] - coarse) > QUADRATURE * coarse:
            return True
        self.panels //= 2
        return False

    def feasible(self, v):
        """Unknowns within the limits: these, or those of the minimum that is found from the ones of least excess."""
        if not self.limits or self.within(v)[0].min() >= -SAFELY_INSIDE:
            return v
        least = self.solved(v, "excess")
        if self.within(least)[0].min() < -SAFELY_INSIDE:
            raise self.beyond(self.motions.run(self.motions.with_parameters(self.parameters(least))))
        again = self.solved(least, self.minimise)
        return again if self.within(again)[0].min() >= -SAFELY_INSIDE else least

    def solved(self, v, what):
        """Unknowns (k,) of a minimum from v, in a region that shrinks where there is no motion."""
        problem, region = NonlinearProgram(self, what, v), np.inf
        for _ in range(REGIONS):
            low, high = np.maximum(v - region, 0.0), np.minimum(v + region, 1.0)
            v, failure = problem.minimum(v, low, high)
            if failure is not None:
                region = np.abs(failure.at - v).max() / 2
                if region < SMALLEST_REGION:
                    raise failure
                continue
            edge = SMALLEST_REGION * (high - low)
            if np.all(((v > low + edge) | (low == 0.0)) & ((v < high - edge) | (high == 1.0))):
                break
            region *= 2
        return v

    def gain(self, v):
        """How much of the cost is left to save within the limits, and unknowns (k,) of less cost, None without any."""
        from scipy.linalg import null_space
        from scipy.optimize import nnls

        problem, k = NonlinearProgram(self, self.minimise, v), len(v)
        x = problem.start(v)
        ends = np.pad(np.vstack([np.eye(k)[v <= ACTIVE], -np.eye(k)[v >= 1.0 - ACTIVE]]), ((0, 0), (0, len(x) - k)))
        met = problem.inequalities(x) <= ACTIVE

        def slopes(x):
            return problem.cost(x)[1], np.vstack([ends, problem.slopes(x)[met]])

        def allowed(v):
            try:
                return self.cost(v) if self.within(v)[0].min(initial=0.0) >= -SAFELY_INSIDE else np.inf
            except NoMotion:
                return np.inf

        gradient, active = slopes(x)
        balance, first = nnls(active.T, gradient) if len(active) else (np.zeros(0), np.linalg.norm(gradient))
        along = null_space(np.vstack([active[balance > 0], 0 * x])).T
        try:
            bent = [g - gradient - (rows - active).T @ balance for g, rows in (slopes(x + ACTIVE * d) for d in along)]
            rises = max(self.cost(v + ACTIVE * d) for d in np.diag(np.where(v < 0.5, 1.0, -1.0))) - self.cost(v)
        except NoMotion:
            return float(first), None
        curvature, directions = np.linalg.eigh(np.reshape(bent, along.shape) @ along.T / ACTIVE)
        steps = np.outer(PROBED, (directions.T @ along)[:, :k]).reshape(-1, k)
        less = min(np.clip([v, *v + steps, *v - steps], 0.0, 1.0), key=allowed)
        less = less if allowed(less) < (1 - STATIONARY) * self.cost(v) else None
        zero = self.cost(v) * ACTIVE < STATIONARY * rises  # beside what the ranges make of it
        return 0.0 if zero else max(float(first), -curvature.min(initial=0.0) / 2), less

    def beyond(self, plan):
        """The error of a motion that exceeds a limit."""
        excess, name, t = max(_beyond_limits(plan, self.limits))
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
    """The cost and the inequalities of x = v, or of x = (v, z) with a bound z of all magnitudes or excesses.

    `what` is "rms", "peak", "time", or "excess", the largest one over limits. Costs, but for an excess, are relative to
    the one at v (k,), where the search begins.
    """

    def __init__(self, search, what, v):
        self.search, self.what, self.k = search, what, len(v)
        self.bounded = what in ("peak", "excess")
        self.scale = 1.0 if what == "excess" else search.cost(v) or 1.0
        limited = search.limits or self.bounded
        self.constraints = ({"type": "ineq", "fun": self.inequalities, "jac": self.slopes},) if limited else ()

    def start(self, v):
        """The unknowns x of v."""
        if self.what == "excess":
            return np.append(v, max(0.0, -self.search.within(v)[0].min()))
        return np.append(v, self.search.cost(v) / self.scale) if self.bounded else v

    def bounds(self, low, high):
        """Lower and upper bounds of x."""
        z = [(-ACTIVE, None)] * (self.what == "excess") + [(0.0, None)] * (self.what == "peak")
        return [*zip(low, high, strict=True), *z]

    def minimum(self, v, low, high):
        """The unknowns (k,) of a minimum between bounds, None; or the last ones on the way, and why it ended there."""
        from scipy.optimize import minimize

        passed = [v]
        try:
            x = minimize(
                self.cost,
                self.start(v),
                jac=True,
                method="SLSQP",
                bounds=self.bounds(low, high),
                constraints=self.constraints,
                callback=lambda x: passed.append(np.array(x[: self.k])),
                options={"maxiter": QUADRATIC_PROGRAMS, "ftol": UNCHANGED},
            ).x
        except NoMotion as failure:
            return passed[-1], failure
        return np.clip(x[: self.k], low, high), None

    def cost(self, x):
        """The cost, relative to that at the start, and its derivatives."""
        search, v = self.search, x[: self.k]
        if self.bounded:
            return x[-1], np.eye(len(x))[-1]
        if self.what == "time":
            t1, slopes = search.motions.ends(search.parameters(v))
            return (t1 - search.motions.t0) / self.scale, slopes * search.width / self.scale
        value, slopes = search.rms(search.local(v))
        return value / self.scale**2, slopes / self.scale**2

    def inequalities(self, x):
        """What is not negative, (c,)."""
        return self._inequalities(x)[0]

    def slopes(self, x):
        """Its derivatives (c, len(x))."""
        return self._inequalities(x)[1]

    def _inequalities(self, x):
        search, v = self.search, x[: self.k]
        values, slopes = search.within(v)
        if not self.bounded:
            return values, slopes
        slopes = np.pad(slopes, ((0, 0), (0, 1)))
        if self.what == "excess":
            slopes[:, -1] = 1.0
            return values + x[-1], slopes
        y, dy = (part / self.scale for part in search.relative(search.local(v)))
        magnitudes = [np.column_stack([sign * dy.reshape(-1, self.k), np.ones(y.size)]) for sign in (-1.0, 1.0)]
        return np.concatenate([values, x[-1] - y.ravel(), x[-1] + y.ravel()]), np.concatenate([slopes, *magnitudes])


def _quadrature(edges, panels):
    """Instants (N,) [s] and weights (N,) of a quadrature over pieces, with about a number of panels in all."""
    counts = np.ceil(panels * np.diff(edges) / np.ptp(edges)).astype(int)
    pieces = zip(edges[:-1], edges[1:], counts, strict=True)
    ends = np.concatenate([*(np.linspace(a, b, n + 1)[:-1] for a, b, n in pieces), edges[-1:]])
    (x, weights), half = EIGHT_NODES, np.diff(ends)[:, None] / 2
    return (ends[:-1, None] + half * (1 + x)).ravel(), (half * weights).ravel()


def _size_of_limit(low, high):
    """The size of a limit: its larger finite side."""
    return max(abs(side) for side in (low, high) if np.isfinite(side)) or 1.0


def _beyond_limits(plan, limits):
    """(excess relative to the limit, name, instant) of each signal at each side."""
    for name, (low, high) in limits.items():
        (least, t_least), (most, t_most) = extremes(plan, name)
        size = _size_of_limit(low, high)
        yield float((low - least) / size), name, float(t_least)
        yield float((most - high) / size), name, float(t_most)


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
