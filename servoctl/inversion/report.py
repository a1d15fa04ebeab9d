"""What a program asks of its mechanism, in one value: orders, ranks, directions, what is left free, the actuation."""

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from servoctl.checks import by_name, interval
from servoctl.control.extremes import extremes, rates, sampled_extremes
from servoctl.errors import NotRealisable, SpecificationError
from servoctl.figures.names import efforts
from servoctl.inversion.verdict import UNREALISABLE, Verdict, endpoints, verdict
from servoctl.markup import Detailed, fitted, listed
from servoctl.model.following import instants_of
from servoctl.model.model import SAMPLED, Model, derive, including
from servoctl.model.start import State
from servoctl.reduction.self_motion import SelfMotion, self_motion
from servoctl.reduction.structure import Directions, Local, directions, margins
from servoctl.run import Run, require_run
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.program import Program
from servoctl.units import rate_unit
from servoctl.values import evenly, frozen


@frozen
class Effort:
    """What one actuator, or one component of an ideal reaction, does along a run.

    Attributes
    ----------
    peak, peak_at : float
        The value of largest magnitude, and its instant [s].
    rms : float
    rate, rate_at, rate_rms : float
        The same of its derivative in time [1/s].
    limit, limit_at, room : float or None
        The nearest limit, the instant [s] at which the actuator is nearest to it, and how far it is then from it:
        negative beyond it. None without a limit.
    unit : str
        Of the values, where it is known.
    """

    peak: float
    peak_at: float
    rms: float
    rate: float
    rate_at: float
    rate_rms: float
    limit: float | None = None
    limit_at: float | None = None
    room: float | None = None
    unit: str = ""

    def __str__(self):
        unit, rate = f" {self.unit}".rstrip(), rate_unit(self.unit or "1")
        text = f"peak {self.peak:.6g}{unit} (t = {self.peak_at:.4g} s), rms {self.rms:.4g}{unit}; "
        text += f"rate {self.rate:.4g} {rate} (t = {self.rate_at:.4g} s), rms {self.rate_rms:.4g}"
        if self.room is not None:
            side = "within" if self.room >= 0 else "beyond"
            text += f"; {abs(self.room):.4g}{unit} {side} the limit {self.limit:g}{unit}"
        return text


@frozen(eq=False, repr=False)
class Report(Detailed):
    """What a program asks of its mechanism, and which inverse it has; made by `report`.

    Attributes
    ----------
    basis : Verdict
        The verdict with what it rests on: eigenvalues at rest and growth along a run.
    residuals : dict of str to dict
        For each residual its "order", how often it is "raised" until accelerations appear, its "relative degree", and
        the "class" C^k that its path needs.
    index : int or None
        Differentiation index; None where it is not defined.
    realisation : {"orthogonal", "mixed", "tangential", "undecided", "ideal"}
        The class: rank of the decoupling matrix full, between, or zero.
    directions : Directions or None
        Actuators and normals of the program at the start; None for ideal programs and where there is no start.
    hidden : tuple of str
        How each hidden constraint was derived.
    free : int
        Dimension of the internal dynamics, Σ o_a.
    self_motion : SelfMotion or None
        What more actuators than residuals can move while the program holds, and whether it is damped; None without any.
    ranks : dict of str to Local
        Relative degrees, zeros at infinity and index: at seeded points, at the start, in the middle of a run, and
        where the leading matrix loses rank along it.
    margin : (float, float) or None
        The smallest pivot of the leading matrix along a run, equilibrated, and its instant [s].
    efforts : dict of str to Effort
        Actuation along a run.
    run : Run or None
    """

    basis: Verdict
    residuals: dict
    index: int | None = None
    realisation: str = "undecided"
    directions: Directions | None = None
    hidden: tuple = ()
    free: int = 0
    self_motion: SelfMotion | None = None
    ranks: dict[str, Local] = field(default_factory=dict)
    margin: tuple[float, float] | None = None
    efforts: dict[str, Effort] = field(default_factory=dict)
    run: Run | None = None

    @property
    def verdict(self) -> str:
        """The verdict in a word; see `servoctl.inversion.verdict.Verdict`."""
        return self.basis.word

    @property
    def reason(self) -> str:
        """The number or the fact that decides the verdict."""
        return self.basis.reason

    @property
    def eigenvalues(self) -> dict[str, np.ndarray]:
        """Eigenvalues of the internal dynamics [1/s] at the rests "start" and "end", as far as there are any."""
        return {name: end.eigenvalues for name, end in self.basis.rest.items()}

    def as_dict(self) -> dict:
        """The report as numbers, texts, lists and dicts, for JSON; eigenvalues as pairs [real part, imaginary part]."""
        return {
            **self.basis.as_dict(),
            "residuals": {name: dict(facts) for name, facts in self.residuals.items()},
            "index": self.index,
            "realisation": self.realisation,
            "directions": None if self.directions is None else _plain(self.directions),
            "hidden": list(self.hidden),
            "free": self.free,
            "self_motion": None if self.self_motion is None else _plain(self.self_motion),
            "ranks": {place: _plain(local) for place, local in self.ranks.items()},
            "margin": None if self.margin is None else list(self.margin),
            "efforts": {name: _plain(effort) for name, effort in self.efforts.items()},
        }

    def plot(self):
        """A figure: eigenvalues at rest, growth of errors, directions, and the actuation with its limits.

        Returns
        -------
        matplotlib.figure.Figure
        """
        from servoctl.figures.report import draw_report

        return draw_report(self)

    def _lines(self, full):
        v, lines = self.basis, [f"Report: {self.basis.word}"]
        lines += [f"  {text}" for text in (v.reason, v.growth, v.do) if text]
        lines += [f"  {text}" for text in _of_residuals(self.residuals, full)]
        if self.basis.word != UNREALISABLE:
            index = "not defined" if self.index is None else self.index
            directions = _of_directions(self.directions)
            lines += f"  index {index}; {self.realisation} realisation{directions}".splitlines()
            free = f"{self.free} free initial value{'s' * (self.free != 1)}"
            free += "" if self.self_motion is None else f"; {self.self_motion}"
            hidden = fitted(lambda room: f"hidden: {listed(self.hidden, room, apart='; ')}; {free}", full)
            lines.append(f"  {hidden}" if self.hidden else f"  no hidden constraint; {free}")
        lines += [f"  {name}: {effort}" for name, effort in self.efforts.items()]
        if self.margin is not None:
            lines.append(f"  smallest pivot along the run {self.margin[0]:.2g} (t = {self.margin[1]:.4g} s)")
        return [*lines, *(f"  {place}: {local.named(self.residuals)}" for place, local in self._differing())]

    def _differing(self):
        """The places whose ranks are printed: the first of those with the same ranks, none where all are the same."""
        first = {local.decided: (place, local) for place, local in reversed(self.ranks.items())}
        return list(reversed(first.values()))[:3] if len(first) > 1 else []


def _plain(value):
    """The fields of a value, as JSON has them."""
    kept = {name: list(v) if isinstance(v, tuple) else v for name, v in vars(value).items()}
    return {name: None if isinstance(v, float) and not np.isfinite(v) else v for name, v in kept.items()}


def _of_residuals(residuals, full):
    """Lines on the residuals, one for those with equal facts."""
    groups = {}
    for name, facts in residuals.items():
        groups.setdefault(tuple(facts.values()), []).append(name)
    for (order, raised, degree, smoothness), names in groups.items():
        facts = f"order {order}" + f", raised {raised}x" * bool(raised)
        facts += "" if degree is None else f", relative degree {degree}"
        facts += "" if smoothness is None else f", path C{smoothness}"
        yield fitted(lambda room, names=names, facts=facts: f"{listed(names, room)}: {facts}", full)


def _of_directions(found):
    if found is None or not found.cosines:
        return ""
    text = f", actuators and normals up to {round(np.degrees(found.angle), 3):g}° apart"
    if found.margin:
        which = "least cosine" if found.margin <= min(found.cosines) else "least cosine of the others"
        text += f" ({which} {found.margin:.2g})"
    if found.residuals:
        text += f"\n  {', '.join(found.actuators) or 'no actuator'} without effect on {', '.join(found.residuals)}"
    return text


def report(
    what: Run | Model | Mechanism, start: State | Program | None = None, limits: Mapping[str, float] | None = None
) -> Report:
    """What a program asks of its mechanism, and the verdict: which inverse it has.

    Parameters
    ----------
    what : Run, Model or Mechanism
        A run, along which ranks, growth and actuation are reported; or a model; or a mechanism, of whose program the
        model is derived; where no actuation realises it, the report says so.
    start : State or Program, optional
        Of a model, by default the one near the guess of `derive`; or the program of a mechanism.
    limits : dict of str to float or (float, float), optional
        Limits of actuators, as in `plant`: c means (-c, c).

    Returns
    -------
    Report

    Raises
    ------
    SpecificationError
        If a run has no model, there are limits without a run, or a limit is no interval.
    NameUnknown
        For a limit of no actuator.
    """
    if isinstance(what, Mechanism):
        try:
            what, start = derive(what, start), None
        except NotRealisable as error:
            return _not_realisable(what, start, error)
    model, motion = _model_and_motion(what, start)
    limits = by_name(limits, model.actuators, "actuator", "The limits")
    limits = {name: interval(name, value, "limit") for name, value in limits.items()}
    along = motion if isinstance(motion, Run) else None
    _require_limits(along, limits)
    judged, structure, ends = verdict(model, motion), model.structure(), endpoints(model, motion)
    margin, ranks = _ranks(model, structure, along, ends)
    return Report(
        judged,
        _residuals(model, structure),
        structure.index,
        structure.realisation,
        _directions(model, ends),
        tuple(row.derivation for row in model.reduction.hidden),
        model.free,
        None if model.reduction.ideal else self_motion(model.reduction),
        ranks,
        margin,
        {} if along is None else {name: _effort(along, name, limits.get(name)) for name in efforts(along)},
        along,
    )


def _not_realisable(mechanism, program, error):
    """The report of a program that no actuation can realise."""
    orders = {name: max(mechanism.q.order(e), 0) for name, e in program.residuals.items()}
    facts = {
        name: {"order": order, "raised": max(0, 2 - order), "relative degree": None, "class": None}
        for name, order in orders.items()
    }
    return Report(Verdict(UNREALISABLE, str(error).rstrip(".")), facts)


def _model_and_motion(what, start):
    """A model and its motion: a run, a start, or None; others are refused."""
    if isinstance(what, Model) and isinstance(start, State):
        whole = including(what, start.names)
        if whole.state_names == start.names:
            return whole, start
    elif start is None:
        return (what, None) if isinstance(what, Model) else (require_run(what, "report"), what)
    raise SpecificationError(
        f"sv.report received a {type(what).__name__} and a {type(start).__name__}.",
        "It takes a run, a model and a start of it, or a mechanism and its program.",
        do="Write sv.report(run), sv.report(model, start), or sv.report(mechanism, program).",
        what=type(what).__name__,
        start=type(start).__name__,
    )


def _require_limits(run, limits):
    if limits and run is None:
        raise SpecificationError(
            f"Limits of {', '.join(limits)} were given without a run.",
            "Limits are compared with the actuation along a run.",
            do="Pass the run, or leave out the limits.",
            limits=limits,
        )


def _residuals(model, structure):
    reduction = model.reduction
    degrees, classes = (
        dict(zip(structure.residuals, of, strict=False))
        for of in (structure.relative_degree, structure.essential_orders)
    )
    return {
        name: {
            "order": reduction.original[name].order,
            "raised": max(0, reduction.top - reduction.original[name].order),
            "relative degree": degrees.get(name) if reduction.original[name].order <= 2 else None,
            "class": classes.get(name, reduction.needs.get(name)),
        }
        for name in reduction.program.residuals
    }


def _directions(model, ends):
    """The directions where the motion begins."""
    if model.reduction.ideal or not ends:
        return None
    t, x = ends[0]
    return directions(model.reduction, instants_of(model, [t]), x[:, None], model.parameters)[0]


def _ranks(model, structure, run, ends):
    """The margin along a run, and the structure by place: seeded points, the start, and instants of the run."""
    if not structure.at:
        return None, {}
    places = {"seeded points": next(local for _, local in structure.at if _typical(local, structure))}
    for t, x in ends[:1]:
        places[f"at the start, t = {t:.4g} s"] = model.structure([t], x[:, None]).at[0][1]
    if run is None:
        return None, places
    n_x = len(model.state_names)
    some = np.flatnonzero(np.isfinite(run.jets[:n_x]).all(axis=0))
    some = some[evenly(len(some), SAMPLED)]
    along = np.concatenate([_margins(run, some, part) for part in run.variants or ((0, len(run.t), model),)])
    if np.isnan(along).all():
        return None, places
    worst = int(np.nanargmin(along))
    for k in {int(some[len(some) // 2]), *([int(some[worst])] if along[worst] == 0 else [])}:
        places[f"at t = {run.t[k]:.4g} s"] = model.structure(run.t[[k]], run.jets[:, [k]]).at[0][1]
    return (float(along[worst]), float(run.t[some[worst]])), places


def _margins(run, some, part):
    """Margins of the variant (first, end, model) at those of some samples that it holds for."""
    first, end, variant = part
    inside = some[(some >= first) & (some < end)]
    if not len(inside):
        return []
    instants = instants_of(variant, run.t[inside])
    return margins(variant.reduction, instants, run.jets[:, inside], variant.parameters)


def _typical(local, structure):
    return (local.relative_degree, local.zeros_at_infinity) == (structure.relative_degree, structure.zeros_at_infinity)


# actuation ------------------------------------------------------------------------------------------------------------


def _effort(run, name, limits):
    """An `Effort` from a signal of a run."""
    (low, t_low), (high, t_high) = extremes(run, name)
    peak, peak_at = max(((low, t_low), (high, t_high)), key=lambda extreme: abs(extreme[0]))
    changes = rates(run, name)
    rate, rate_at = max(sampled_extremes(run.t, changes), key=lambda extreme: abs(extreme[0]))
    nearest = {}
    if limits is not None:
        room, limit_at, limit = min((low - limits[0], t_low, limits[0]), (limits[1] - high, t_high, limits[1]))
        nearest = {"limit": limit, "limit_at": limit_at, "room": room}
    mean, unit = _rms(run.t, run[name]), run.unit(name)
    return Effort(peak, peak_at, mean, rate, rate_at, _rms(run.t, changes), **nearest, unit=unit)


def _rms(t, values):
    """The root of the mean square over time, of finite samples, by the trapezoidal rule."""
    known = np.isfinite(values)
    t, squares = t[known], values[known] ** 2
    return float(np.sqrt(np.diff(t) @ (squares[1:] + squares[:-1]) / 2 / (t[-1] - t[0]))) if len(t) > 1 else np.nan
