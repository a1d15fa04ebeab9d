"""A run: what a simulation computed, by name."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from servoctl import archive
from servoctl.checks import antiderivative, as_numbers, finite, named, require_kind, rows_read, whole
from servoctl.dense import INEXACT, between, extremes, extremes_at, jets_at, piece_of, resolved
from servoctl.errors import SpecificationError, unknown
from servoctl.markup import EXTREMA, Detailed, digits, fitted, listed
from servoctl.model.equations import residual_names, signal_groups
from servoctl.model.following import ends_of_pieces
from servoctl.model.jets import extended, jet_names_to
from servoctl.model.model import Model, including
from servoctl.model.start import State, without_rounding
from servoctl.model.switching import switching
from servoctl.model.variants import place_of, variant_at
from servoctl.reduction.idle import names_of
from servoctl.units import unit_of
from servoctl.values import Value, frozen, read_only, same

CLOSED_LOOP = "closed loop: "  # the method of a loop as a run, before the name of its law
SAME_TIME = 1e-12  # relative: rounding of an instant
AGREES = 1e-6  # relative: difference of a signal in a file from that of a model, below which the run is of this model
FACTS = {
    "method": str,
    "drift": str,
    "counters": dict,
    "success": bool,
    "status": int,
    "message": str,
    "knots": list,
    "jet_names": list,
    "internal": dict,
    "units": dict,
}  # of a saved run


class ByName:
    """A value that has signals under its `names`: `list`, `len`, `in` and `dict` go by these."""

    def keys(self) -> tuple[str, ...]:
        """Names of all signals."""
        return self.names

    def __iter__(self):
        return iter(self.names)

    def __len__(self):
        return len(self.names)

    def __contains__(self, name):
        return name in self.names


class Sampled(ByName, Detailed):
    """Signals by name at instants `t`, with the `units` of a mechanism, as tables."""

    def unit(self, name: str) -> str:
        """The unit of a signal, as the specification gives it or as it follows; "" if it is not known.

        Parameters
        ----------
        name : str
        """
        return unit_of(name, self.units)

    def _of_row(self, name, mechanism):
        """The residual (N,) that is read by a name of no signal of the mechanism, or `NameUnknown`."""
        rows = rows_read(self.residual, self.names if mechanism is None else (*mechanism.signals, *self.names))
        if name in rows:
            return self.residual[rows[name]][0]
        valid = (*self.names, *rows)
        raise unknown(name, valid, "signal") if mechanism is None else mechanism.no("signal", name, valid)

    def _columns(self):
        """Times and all signals by name, and their units."""
        return {"t": self.t, **{name: self[name] for name in self.names}}, {"t": "s", **self._units_of_names()}

    def _units_of_names(self):
        return {name: self.unit(name) for name in self.names}

    def csv(self, path):
        """Write times and all signals as CSV: a line of names with units, then one line for each sample.

        Parameters
        ----------
        path : str or Path

        Returns
        -------
        Path

        Raises
        ------
        ServoError
            If the file cannot be written.
        """
        return archive.table(path, "table", *self._columns())

    def to_pandas(self):
        """All signals as a pandas.DataFrame over time; `attrs["units"]` has the known units by name.

        Raises
        ------
        ServoError
            If pandas is not installed.
        """
        return archive.frame(*self._columns(), index="t")

    def to_xarray(self):
        """All signals and residuals as an xarray.Dataset over time, with units; its `to_netcdf(path)` writes netCDF.

        Raises
        ------
        ServoError
            If xarray is not installed.
        """
        units = self._units_of_names()
        data = {name: ("t", self[name], {"units": units[name]} if units[name] else {}) for name in self.names}
        for name in self.residual:
            data[f"residual_{name}"] = ((f"level_{name}", "t"), self.residual[name])
        return archive.dataset(data, {"t": ("t", self.t, {"units": "s"})}, self._attributes())


@frozen(eq=False, repr=False)
class Run(Sampled, Value):
    """A motion with its actuation and its residuals; made by `simulate`, `close` or `load`.

    `run["theta"]`, `run["dtheta"]`, `run["trolley"]` are (N,) arrays, SI. Time derivatives of an actuation, output or
    energy are `run["dtrolley"]`, `run["d2trolley"]`; they may need higher jets, from `simulate(...,
    method=sv.methods.Taylor(jets=3))`. `run.residual["X"]` is (levels, N): the residual and its derivatives.

    Attributes
    ----------
    t : (N,) array
        [s]
    jets : (n_z, N) array
        q, γ', ..., γ^(s̄), with the names `jet_names`.
    counters : dict of str to int
        nfev, njev, nlu, steps, iterations, projections, pivot_changes, as the method counts them.
    success : bool
    status : int
        0 finished, 1 ended by an event, or interrupted (then without success), -1 stopped.
    message : str
        Whether the run finished, and if not, why.
    variants : tuple of (first, last + 1, model)
        The variant of the model, with its choice of pivots, for each range of samples; empty if there is only one.
    verdict : mapping or callable
        What `internal` gives, or the function of this run that computes it at the first access.
    events : dict of str to Run
        The motion at the instants of each event: `run.events["slack"].t` are its times [s],
        `run.events["slack"]["theta"]` the values of a signal there.
    steps : tuple of Dense
        The steps of the method, with which `at` and `extrema` know the motion between samples; none of a run that was
        loaded or closed.
    start : State or None
        From which the motion was computed. It also says which branch of its solutions a flat program follows:
        `simulate(model, run.start, ...)` repeats it.
    """

    t: np.ndarray
    jets: np.ndarray
    jet_names: tuple
    model: object = None
    method: str = ""
    drift: str = ""
    counters: dict = field(default_factory=dict)
    success: bool = True
    status: int = 0
    message: str = ""
    knots: tuple = ()
    variants: tuple = ()
    stored: dict = field(default_factory=dict, compare=False)
    stored_residual: dict = field(default_factory=dict, compare=False)
    verdict: Mapping | Callable = field(default_factory=dict, compare=False, repr=False)
    start: State | None = None
    events: dict = field(default_factory=dict)
    stored_units: dict = field(default_factory=dict, compare=False, repr=False)
    steps: tuple = field(default=(), compare=False, repr=False)

    def __post_init__(self):
        for name in ("t", "jets"):
            if isinstance(getattr(self, name), np.ndarray):
                object.__setattr__(self, name, read_only(getattr(self, name)))

    def __setstate__(self, state):
        vars(self).update(state)
        self.__post_init__()

    def __eq__(self, other):
        if not super().__eq__(other):
            return False
        # with a model all signals follow from the jets, and `stored` only holds those already computed
        signals = (self.stored, self.stored_residual), (other.stored, other.stored_residual)
        return self.model is not None or same(*signals)

    __hash__ = Value.__hash__

    def with_verdict(self, verdict):
        """The same run with another verdict."""
        run = object.__new__(Run)
        vars(run).update(vars(self), verdict=verdict)
        vars(run).pop("_internal", None)
        return run

    @property
    def internal(self) -> Mapping[str, object]:
        """The verdict on the internal dynamics along the run (`InternalDynamics.facts`), computed at the first access.

        Empty for flat programs, for plants under inputs, and for bounded motions, which are not integrated forward.
        """
        return MappingProxyType(self._internal)

    @cached_property
    def _internal(self):
        return dict(self.verdict(self) if callable(self.verdict) else self.verdict)

    @property
    def _groups(self):
        """The model's group of each signal; none for a loaded run, whose signals are all stored."""
        return signal_groups(self.model.reduction) if self.model is not None else {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all signals."""
        return tuple(dict.fromkeys([*self.jet_names, *self._groups, *self.stored]))

    @property
    def units(self) -> dict[str, str]:
        """Units by name, as the mechanism gives them."""
        return self.stored_units if self.model is None else self.model.reduction.mechanism.units

    def __getitem__(self, name: str) -> np.ndarray:
        if not isinstance(name, str):
            raise unknown(name, self.names, "signal")
        if name in self.jet_names:
            return self.jets[self.jet_names.index(name)]
        if name not in self.stored:
            base, rate = (name, 0) if name in self._groups else antiderivative(name, self._groups) or (None, 0)
            if base is None:
                return self._of_row(name, None if self.model is None else self.model.reduction.mechanism)
            names, values = self.signals(self._groups[base], rate)
            self.stored.update(zip(names, values, strict=True))
        return self.stored[name]

    def signals(self, kind, rate=0):
        """Names and (n, N) values of one of the model's groups of signals, or of their time derivatives.

        Parameters
        ----------
        kind : str
            One of `servoctl.model.equations.SIGNALS`.
        rate : int
            Order of the derivative, which may need jets above s̄.

        Raises
        ------
        SpecificationError
            If the run does not hold the jets that the derivative needs.
        """
        self.require_model()
        parts = []
        for first, end, model in self.variants or ((0, len(self.t), self.model),):
            names, f = model.signals(kind, rate)
            jets = self.jets[: f.n_x, first:end]
            if f.n_x > len(jets) and not rate:  # outputs of higher order than the motion
                jets = extended(model, self.t[first:end], jets, f.n_x)
            if f.n_x > len(jets):
                present, needed = ((size - model.nq) // model.n for size in (len(self.jets), f.n_x))
                raise SpecificationError(
                    f"The run has jets up to order {present}, too few for {', '.join(names)}.",
                    f"These time derivatives follow from jets up to order {needed}.",
                    do=f"Simulate with method=sv.methods.Taylor(jets={needed}).",
                    names=names,
                    jets=needed,
                )
            parts.append(f.grid(self.t[first:end], jets, model.p))
        return names, parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    def require_model(self):
        """Refuse a run that was loaded without its model, where more than the stored samples is asked for."""
        if self.model is None:
            raise SpecificationError(
                "The run was loaded from a file, without its model.",
                "It has what is stored, run.names and run.jets; all else needs the model.",
                do="Use sv.load(path, model).",
                signals=list(self.names),
            )

    def variant(self, i: int):
        """The variant of the model that holds at sample i."""
        i = whole("i", i, most=max(len(self.t) - 1, 0))
        return next((model for first, end, model in self.variants if first <= i < end), self.model)

    @property
    def residual(self) -> Mapping[str, np.ndarray]:
        """Residuals of every constraint at every level: a mapping of names to (levels, N) arrays."""
        return _Residuals(self)

    @property
    def t_events(self) -> dict[str, np.ndarray]:
        """Instants of the events by name, (K,) arrays [s]."""
        return {name: at.t for name, at in self.events.items()}

    def state(self, t: float) -> np.ndarray:
        """The state (q, γ') of the mechanism at an instant; see `at`.

        Parameters
        ----------
        t : float or (N,) array
            Within the run [s].

        Returns
        -------
        (nq + n,) or (nq + n, N) array
        """
        return self.at(t)[: self.model.nq + self.model.n]

    def at(self, t: ArrayLike) -> np.ndarray:
        """The jets Z at any instants of the run, by the dense output of its steps.

        A run that was loaded, or closed, has no steps: its jets come from Hermite's polynomials through all
        derivatives at the samples beside an instant.

        Parameters
        ----------
        t : float or (N,) array
            Within the run [s].

        Returns
        -------
        (n_z,) or (n_z, N) array

        Raises
        ------
        SpecificationError
            If an instant lies outside the run, or the run was loaded without its model.
        """
        times = self._within(t)
        forward = 1.0 if self.t[-1] >= self.t[0] else -1.0
        k = np.minimum(np.searchsorted(forward * self.t, forward * times), len(self.t) - 1)
        jets, inside = self.jets[:, k], self.t[k] != times
        if inside.any():
            jets[:, inside] = jets_at(self._pieces, times[inside])[: len(jets)]
        return jets if np.ndim(t) else jets[:, 0]

    def sampled(self, t: ArrayLike) -> "Run":
        """The run at other instants, as `at` gives it.

        Parameters
        ----------
        t : (N,) array
            Within the run [s], in its order.

        Returns
        -------
        Run

        Raises
        ------
        SpecificationError
            As by `at`, and for instants in another order.
        """
        times = self._within(np.atleast_1d(t))
        if (np.diff(times) * (self.span[1] - self.span[0]) < 0).any():
            raise SpecificationError(
                "Instants were given in another order than that of the run.",
                "Samples follow each other as the motion does.",
                do="Sort them, backwards for a run that goes backwards.",
                span=self.span,
            )
        ranges = [(int(np.argmax(inside)), int(inside.sum()), model) for model, inside in self.by_model(times)]
        variants = tuple((first, first + count, model) for first, count, model in ranges) if self.variants else ()
        return replace(self, t=times, jets=self.at(times), variants=variants, stored={}, stored_residual={})

    def by_model(self, t: np.ndarray) -> list[tuple[Model, np.ndarray]]:
        """The models that hold at instants, with their choices of pivots and sides of switches.

        Parameters
        ----------
        t : (N,) array
            Within the run [s].

        Returns
        -------
        list of (Model, (N,) array of bool)
            Each with the instants at which it holds, in their order; a model that holds again comes again.
        """
        if not len(self._pieces):
            return [(self.model, np.ones(len(t), dtype=bool))]
        models = [piece.model for piece in self._pieces]
        same = np.cumsum([False, *(a is not b for a, b in itertools.pairwise(models))])
        which = same[piece_of(self._pieces, t)]
        return [(models[np.argmax(same == i)], which == i) for i in np.unique(which)]

    @property
    def span(self) -> tuple[float, float]:
        """The first and the last instant of the motion [s]; samples may leave out a part of it."""
        ends = [piece.t for piece in self.steps] or [self.t]
        return float(ends[0][0]), float(ends[-1][-1])

    @cached_property
    def _pieces(self):
        """The steps of the run, or what passes through its samples."""
        return self.steps or between(self)

    @cached_property
    def resolved(self):
        """Whether the motion is known between its samples: by its steps, or as these are dense enough."""
        return bool(self.steps) or self.method in INEXACT or resolved(self._pieces)

    def _within(self, t):
        """Instants (N,) of the run, without what rounding lets them exceed it."""
        times = np.atleast_1d(finite("t", t, "time") if np.ndim(t) == 0 else as_numbers(t))
        low, high = sorted(self.span)
        outside = ~((low - SAME_TIME * (1 + abs(low)) <= times) & (times <= high + SAME_TIME * (1 + abs(high))))
        if outside.any():
            t = float(times[np.argmax(outside)])
            raise SpecificationError(
                f"t = {t:g} s lies outside the run.",
                f"It covers {low:g} to {high:g} s.",
                nearest=f"t = {low if t < low else high:g} s.",
                t=t,
                span=(low, high),
            )
        self.require_model()
        return np.clip(times, low, high)

    def extrema(self, name: str) -> tuple[tuple[float, float], tuple[float, float]]:
        """The least and the greatest value of a signal from the first to the last sample, between samples, too.

        A run that was loaded without its model, or with few samples, has those of its samples.

        Parameters
        ----------
        name : str

        Returns
        -------
        ((t, value), (t, value))
            Minimum and maximum of the finite values; NaN if there are none.
        """
        values = self[name]
        if self.model is None or len(self.t) < 2 or not self.resolved:
            return extremes_at(self.t, values)
        forward = 1 if self.t[-1] >= self.t[0] else -1
        low, high = sorted((self.t[0], self.t[-1]))
        ends = [piece.t for piece in self._pieces] or [self.t]
        cuts = np.unique(
            np.clip(np.concatenate([*ends, self.knots, ends_of_pieces(self.model, (low, high))]), low, high)
        )
        groups = self._groups
        kind = [other for other in groups if groups[other] == groups.get(name)] or [name]
        size = max(np.nanmax(np.abs(self[other]), initial=0.0) for other in kind)
        return extremes(lambda t: self.sampled(t[::forward])[name][::forward], cuts, self.t, values, size)

    def save(self, path):
        """Save the run as npz, without pickle: samples, all signals, residuals, and what happened.

        Parameters
        ----------
        path : str or Path
            A missing suffix .npz is added.

        Returns
        -------
        Path

        Raises
        ------
        ServoError
            If the file cannot be written.
        """
        signals = [name for name in self.names if name not in self.jet_names]
        facts = {name: kind(getattr(self, name)) for name, kind in FACTS.items()}
        facts |= {"signals": signals, "residuals": list(self.residual)}
        facts |= {"start": _facts_of_start(self.start)} | ({} if self.model is None else _facts_of_model(self))
        arrays = {"t": self.t, "jets": self.jets} | {f"signal_{i}": self[name] for i, name in enumerate(signals)}
        arrays |= {f"residual_{i}": self.residual[name] for i, name in enumerate(self.residual)}
        facts["events"] = list(self.events)
        for i, at in enumerate(self.events.values()):
            arrays |= {f"event_{i}": at.t, f"event_jets_{i}": at.jets}
        return archive.save(path, "run", facts, arrays)

    def _attributes(self):
        return {"method": self.method, "drift": self.drift, "message": self.message, **self.counters}

    def _lines(self, full):
        return [*self._facts(full), *(range_in_words(*ends) for ends in self._extremes(full))]

    def _tables(self):
        rows = [(name, *map(digits, numbers), unit) for name, *numbers, unit in self._extremes(full=False)]
        return [(EXTREMA, rows)] if rows else [], self._facts(full=False)[1:]

    def _extremes(self, full):
        """(name, least value, its t, greatest value, its t, unit) of each actuator and output.

        Unless full, what is rounding beside the largest actuator or output is 0, at no t.
        """
        for group in (self.model.actuators, self.model.outputs) if self.model is not None and len(self.t) else ():
            names = [name for name in group if name in self.names and np.isfinite(self[name]).any()]
            ends = np.array([self.extrema(name) for name in names]).reshape(-1, 2, 2)[..., ::-1]
            if not full:
                ends[..., 0] = without_rounding(ends[..., 0])
                ends[ends[..., 0] == 0.0, 1] = np.nan
            for name, numbers in zip(names, ends.reshape(-1, 4), strict=True):
                yield name, *numbers, self.unit(name)

    def _facts(self, full):
        """Lines that say how the run was computed."""
        if not len(self.t):
            return [f"Run: no samples; {self.message}"]
        outcome, _, note = self.message.partition("; ")
        levels = slice(1 if self.method.startswith(CLOSED_LOOP) else None)  # further ones are disturbed by the samples
        worst = {name: float(np.abs(self.residual[name][levels]).max(initial=0.0)) for name in self.residual}
        residuals = [f"{worst[name]:.1e} ({name})" for name in sorted(worst, key=worst.get, reverse=True)]
        method = f"method {self.method}" + (f", drift: {self.drift}" if self.drift else "")
        lines = [
            f"Run: {len(self.t)} samples, t = {self.t[0]:g} .. {self.t[-1]:g} s; {outcome}",
            note,
            method + (f"; largest residual {residuals[0]}" if residuals and not full else ""),
            *(self._computed(residuals) if full else ()),
            self.internal.get("text", ""),
            fitted(self._happened, full) * bool(self.events),
        ]
        return "\n  ".join(filter(None, lines)).splitlines()

    def _happened(self, room):
        times = {name: listed([f"{s:.7g}" for s in t], room, unit=" s") for name, t in self.t_events.items() if len(t)}
        return "events: " + "; ".join(f"{n} at t = {times[n]}" if n in times else f"{n} never" for n in self.events)

    def _computed(self, residuals):
        """The branch of a flat program's solution, what the method counted, and all residuals."""
        if self.start is not None and self.model is not None and self.model.flat:
            q = (f"{name} = {self.start[name]:.4g}" for name in self.model.reduction.mechanism.q.names)
            yield f"branch of {', '.join(q)} at t = {self.start.t:g} s"
        counted = [f"{name} {count}" for name, count in self.counters.items() if count]
        longest = [np.abs(np.diff(piece.t)).max() for piece in self.steps]
        yield ", ".join(counted + ([f"longest step {max(longest):.3g} s"] if longest else []))
        yield (
            f"largest residuals{'' if self.method.startswith(CLOSED_LOOP) else ' over all levels'}: "
            f"{', '.join(residuals)}"
        ) * bool(residuals)


def range_in_words(name, low, t_low, high, t_high, unit):
    """The line of a signal from its least to its greatest value."""
    low, high = (f"{digits(value)} {unit}".rstrip() for value in (low, high))
    at_low, at_high = ("" if np.isnan(t) else f" (t = {t:.4g} s)" for t in (t_low, t_high))
    return f"  {name}: {low} throughout" if low == high else f"  {name}: {low}{at_low} .. {high}{at_high}"


class _Residuals(Mapping):
    """Residuals by name, computed at the first access."""

    def __init__(self, run):
        self._run = run

    def __repr__(self):
        return f"Residuals({', '.join(self._names())})"

    def _names(self):
        run = self._run
        return list(run.stored_residual if run.model is None else residual_names(run.model.reduction))

    def __iter__(self):
        return iter(self._names())

    def __len__(self):
        return len(self._names())

    def __getitem__(self, name):
        stored = self._run.stored_residual
        name = named(name, self._names(), "residual")
        if name not in stored:
            levels, values = self._run.signals("residuals")
            rows, names = list(dict.fromkeys(level[0] for level in levels)), self._names()
            # Near an instant other balances may take the places of the model's hidden ones, and have their names here.
            for row, own in zip(rows, rows if set(rows) == set(names) else names, strict=True):
                stored[own] = values[[i for i, level in enumerate(levels) if level[0] == row]]
        return stored[name]


def _facts_of_start(start):
    if start is None:
        return None
    values = dict(zip(start.names, np.asarray(start.values, dtype=float).tolist(), strict=True))
    return {"t": start.t, "values": values, "held": start.held, "free": start.free, "residual": start.residual}


def _facts_of_model(run):
    """Parameters of a run's model; of its variants the places near which pivots were chosen, and sides of switches."""
    variants = [(first, end, place_of(variant), sides(run.model, variant)) for first, end, variant in run.variants]
    return {"parameters": run.model.numbers, "variants": variants}


def as_saved(facts, arrays):
    """The run of an archive, without its model."""
    for name, kind in FACTS.items():
        archive.require(type(facts[name]) is kind, f"its {name} is {facts[name]!r}")
    t = archive.numbers(arrays, "t", None)
    archive.require(np.isfinite(t).all() and abs(np.sign(np.diff(t)).sum()) == len(t) - 1, "its times are in no order")
    jets = archive.numbers(arrays, "jets", len(archive.named(facts["jet_names"])), len(t))
    names, rows = archive.named(facts["signals"]), archive.named(facts["residuals"])
    signals = {name: archive.numbers(arrays, f"signal_{i}", len(t)) for i, name in enumerate(names)}
    residuals = {name: archive.numbers(arrays, f"residual_{i}", None, len(t)) for i, name in enumerate(rows)}
    start = facts.get("start")
    if start is not None:
        values, lists = start["values"], {name: tuple(start[name]) for name in ("held", "free")}
        start = State(start["t"], np.array([*values.values()]), tuple(values), residual=start["residual"], **lists)
    own = {name: tuple(facts[name]) if kind is list else facts[name] for name, kind in FACTS.items()}
    own["verdict"], own["stored_units"] = own.pop("internal"), own.pop("units")
    events = {name: _event_at(arrays, i, own) for i, name in enumerate(archive.named(facts["events"]))}
    return Run(t, jets, stored=signals, stored_residual=residuals, start=start, events=events, **own)


def _event_at(arrays, i, own):
    """The motion at the instants of the i-th event of an archive."""
    t = archive.numbers(arrays, f"event_{i}", None)
    jets = archive.numbers(arrays, f"event_jets_{i}", None, len(t))
    return Run(t, jets, own["jet_names"][: len(jets)], stored_units=own["stored_units"])


def of_model(run, facts, model):
    """A loaded run with its model, which must give the signals of the file."""
    require_kind(Model, "model", model, "sv.derive(mechanism, program)")
    model = including(model, names_of(run))
    numbers, names = facts.get("parameters"), jet_names_to(model, len(run.jets))
    off = {name: (value, model.numbers.get(name)) for name, value in (numbers or {}).items()}
    off = {name: pair for name, pair in off.items() if pair[0] != pair[1]}
    if numbers is None or off or numbers.keys() != model.numbers.keys():
        raise _other_model("parameters", off or (None if numbers is None else sorted(numbers)))
    if run.jet_names != names or list(run.residual) != list(residual_names(model.reduction)):
        raise _other_model("names", [*run.jet_names, *run.residual])
    variants = tuple(
        (first, end, variant_at(on_side(model, tuple(b)), place)) for first, end, place, b in facts["variants"]
    )
    events = {name: replace(at, model=model) for name, at in run.events.items()}
    full = replace(run, model=model, variants=variants, events=events, stored={}, stored_residual={})
    for of_file, of_model, what in ((run.stored, full, "signals"), (run.stored_residual, full.residual, "residuals")):
        differing = [name for name, values in of_file.items() if not _agree(values, of_model[name])]
        if differing:
            raise _other_model(what, differing)
    return full


def _agree(values, others):
    """Whether signals agree; below 1 in size up to the same difference, as residuals are rounding errors."""
    size = np.abs(values[np.isfinite(values)]).max(initial=1.0)
    return np.allclose(values, others, rtol=0.0, atol=AGREES * size, equal_nan=True)


def _other_model(what, facts):
    return SpecificationError(
        f"The run in the file is not of this model: its {what} differ.",
        "A run belongs to one specification and its numbers.",
        do="Derive the model of the run, use with_parameters(...), or load the run without a model.",
        **{what: facts},
    )


def sides(model, variant):
    """The branches of switches that a variant of a model takes: its last parameters."""
    return tuple(variant.parameters[len(model.parameters) :].tolist())


def on_side(model, branches):
    """The smooth model of these branches of switches; the model itself if it has no such switches."""
    family = switching(model) if branches else None
    return family.at(branches) if family and len(branches) == len(family.switches) else model


def require_run(run, what):
    """The model of a run; what is no run, or has no model, is refused. `what` is the function that needs it."""
    if isinstance(run, Run) and hasattr(run.model, "reduction"):
        return run.model
    which = " without its model" if isinstance(run, Run) else ""
    raise SpecificationError(
        f"sv.{what} received a {type(run).__name__}{which}.",
        "It needs a run, which knows its model; one that was loaded from a file is given it.",
        do=f"Write sv.{what}(run), and sv.load(path, model) for a run from a file.",
        run=type(run).__name__,
    )
