"""Events: instants at which a signal of a motion crosses a value, located within the steps of its method."""

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np

from servoctl.checks import as_list, finite, mapping, whole
from servoctl.errors import SpecificationError
from servoctl.methods.watch import BESIDE_ENDS
from servoctl.model.jets import jet_names_to
from servoctl.run import Run
from servoctl.values import frozen

PARTS = 8  # of a step, at whose ends signals are evaluated, beside the samples within it
TURNS = 0.2  # of a signal's values beside its least one: where a parabola comes below, its minimum is searched for
AT_START = 1e-9  # of a signal in the first step: a start below it lies on the event, which is none
AT_STOP = 1e-6  # of the motion's duration: an event this close beyond the instant where a motion must stop ends it


@frozen
class Event:
    """A signal that crosses a value along a motion.

    Parameters
    ----------
    signal : str or callable
        Name of a coordinate, a derivative, an actuation, an output, a residual, as of `run[name]`; or a function
        event(t, x) of the time [s] and the state (n_x,), in the order of `model.state_names`.
    value : float
        Which it crosses, in its unit.
    terminal : bool or int
        Whether the motion ends there; a number: at which occurrence.
    direction : float
        Positive: only where the signal rises in the order of the motion; negative: only where it falls; 0: both.

    Raises
    ------
    SpecificationError
        For a signal that is neither a name nor a function, and numbers out of range.
    """

    signal: str | Callable[..., float]
    value: float = 0.0
    terminal: bool | int = False
    direction: float = 0.0

    def __post_init__(self):
        if not (isinstance(self.signal, str) or callable(self.signal)):
            raise SpecificationError(
                f"The event has the signal {repr(self.signal)[:150]}.",
                "It is the name of a signal, or a function event(t, x).",
                do='Write sv.Event("tension", 0.0, terminal=True, direction=-1).',
                signal=self.signal,
            )
        object.__setattr__(self, "value", finite("value", self.value))
        object.__setattr__(self, "direction", float(np.sign(finite("direction", self.direction))))
        if not isinstance(self.terminal, (bool, np.bool_)):
            object.__setattr__(self, "terminal", whole("terminal", self.terminal))

    @property
    def name(self):
        """A name from the signal and the value."""
        signal = self.signal if isinstance(self.signal, str) else getattr(self.signal, "__name__", "event")
        return f"{signal} = {self.value:g}"

    def along(self, run):
        """The signal less the value at the samples of a run, (N,)."""
        if isinstance(self.signal, str):
            values = run[self.signal]
        else:
            states = run.jets[: len(run.model.state_names)].T
            values = np.array([self._called(t, x) for t, x in zip(run.t, states, strict=True)])
        return values - self.value

    def _called(self, t, x):
        try:
            value = self.signal(t, x)
        except Exception as error:  # the function's own
            raise SpecificationError(
                f"The event {self.name!r} raises {type(error).__name__} at t = {t:.7g} s: {error}.",
                "A function of an event takes the time [s] and the state (n_x,), and returns a number.",
                do="Check the function, or name a signal.",
                name=self.name,
                t=float(t),
            ) from error
        return finite(self.name, value, "value of the event")


def as_events(events):
    """Events by name: from a dict, a sequence or a single one of events, functions and names of signals."""
    if isinstance(events, Mapping):
        return {name: _as_event(event) for name, event in mapping(events, "The events").items()}
    listed = [] if events is None else as_list(events)
    listed = [_as_event(event) for event in ([events] if listed is None else listed)]
    named = {event.name: event for event in listed}
    if len(named) < len(listed):
        raise SpecificationError(
            f"{len(listed)} events were given, with the names {', '.join(event.name for event in listed)}.",
            "Events that look alike have names.",
            do='Write events={"first": sv.Event(...), "second": sv.Event(...)}.',
            names=[event.name for event in listed],
        )
    return named


def _as_event(event):
    """An event as it is; a function with the attributes `terminal` and `direction` that SciPy reads."""
    if isinstance(event, Event):
        return event
    return Event(event, 0.0, getattr(event, "terminal", False), getattr(event, "direction", 0.0))


@frozen
class Occurrence:
    """The event of a name at t [s], with the jets (n_z,) and the model that holds there."""

    name: str
    t: float
    jets: np.ndarray
    model: object


class Events:
    """The events, by name, of a motion while it is being computed, and their occurrences `found` so far.

    Its samples are at times (N,), in the order of the motion [s].
    """

    def __init__(self, events, model, times):
        self.events, self.found, self.signs, self.start = events, [], None, None
        self.forward = -1.0 if len(times) > 1 and times[-1] < times[0] else 1.0
        self.times, self.began = times, (None, None, 0)
        for event in events.values():
            _require_signal(event, model)

    def instants(self, stretch, parts=PARTS):
        """Indices of steps (N,) and instants (N,) at which signals are evaluated: ends, parts and samples of steps."""
        inside = np.array([BESIDE_ENDS, *(np.arange(1, parts) / parts), 1 - BESIDE_ENDS]) if parts > 1 else np.zeros(0)
        steps, instants = [[0]], [stretch[:1]]
        for k, (a, b) in enumerate(pairwise(stretch)):
            low, high = np.searchsorted(self.forward * self.times, self.forward * np.array([a, b]), "right")
            samples = self.times[low:high] if parts > 1 else []
            t = np.unique(np.concatenate([a + (b - a) * inside, samples, [b]]))[:: int(self.forward)]
            steps.append(np.full(len(t), k))
            instants.append(t)
        return np.concatenate(steps), np.concatenate(instants)

    def first(self, model, t, jets, at, stops=False):
        """The first terminal event along instants t (N,) with jets (n_z, N), or None; others before it are recorded.

        Instants are in the order of the motion, from the end of the last ones on [s]; `at` gives jets (n_z,) at one of
        them. With `stops` the motion cannot go on from the last: an event may be what makes it singular there.
        """
        self.start = t[0] if self.start is None else self.start
        if self.began[0] == t[0]:  # these steps are repeated
            self.signs, self.found = self.began[1], self.found[: self.began[2]]
        values = {name: self._along(event, model, t, jets) for name, event in self.events.items()}
        if self.signs is None:
            self.signs = dict.fromkeys(values, 0.0)
        if t[0] == self.start:
            values = {name: _with_start(g) for name, g in values.items()}
        self.began = t[0], self.signs, len(self.found)
        self.signs, crossed = dict(self.signs), []
        for name, g in values.items():
            crossings = list(self._crossings(name, t, g, lambda s, name=name: self._value(name, model, s, at)))
            crossings += self._at_stop(t, g) if stops and not crossings else []
            wanted = self.events[name].direction
            crossed += [(self.forward * s, name) for s, sign in crossings if wanted in (0.0, sign)]
        for s, name in sorted(crossed):
            jets_there = at(self.forward * min(s, self.forward * t[-1]))
            self.found.append(Occurrence(name, float(self.forward * s), jets_there, model))
            terminal = self.events[name].terminal
            if terminal and sum(one.name == name for one in self.found) >= terminal:
                return self.found[-1]
        return None

    def until(self, t):
        """The occurrences up to t [s] by name of the event."""
        before = [one for one in self.found if self.forward * one.t <= self.forward * t]
        return {name: [one for one in before if one.name == name] for name in self.events}

    def _along(self, event, model, t, jets):
        return event.along(Run(t, jets, jet_names_to(model, len(jets)), model))

    def _value(self, name, model, s, at):
        return float(self._along(self.events[name], model, np.array([s]), at(s)[:, None])[0])

    def _crossings(self, name, t, g, value):
        """Instants at which values g (N,) at t (N,) change their sign, with the new one, and where they touch zero."""
        sign, last = self.signs[name], None  # the last sign, and the instant at which it was seen
        turns = _turns(t, g)
        for j, new in enumerate(np.sign(np.nan_to_num(g))):
            if sign * new < 0:
                yield (t[0] if last is None else _root(value, last, t[j])), new
            if new and j in turns and sign * new > 0:
                least = _least(lambda s, new=new: new * value(s), t[j - 1], t[j + 1])
                if least is not None:
                    yield _root(value, t[j - 1], least), -new
                    yield _root(value, least, t[j + 1]), new
            if new:
                sign, last = new, t[j]
        self.signs[name] = sign

    def _at_stop(self, t, g):
        """Where values g (N,) at t (N,) vanish right beyond the last instant, extrapolated, with the new sign."""
        elapsed = abs(t[-1] - self.start)
        k = int(np.searchsorted(self.forward * t, self.forward * t[-1] - AT_START * elapsed)) - 1
        if k < 0 or not g[k] * g[-1] > 0 or not abs(g[-1]) < abs(g[k]):
            return []
        s = t[-1] + g[-1] / (g[k] - g[-1]) * (t[-1] - t[k])
        return [(s, -np.sign(g[-1]))] if abs(s - t[-1]) <= AT_STOP * elapsed else []


def _with_start(g):
    """Values g (N,) from the start of a motion on, the first of them 0 where it is the rounding of zero."""
    size = np.abs(g[np.isfinite(g)]).max(initial=0.0)
    return np.append(0.0 if np.abs(g[0]) <= AT_START * size else g[0], g[1:])


def _turns(t, g):
    """Indices of values g (N,) of one sign at t (N,) whose least ones may lie beyond zero between the instants."""
    if len(t) < 3:
        return set()
    size = np.abs(g)
    before, here, after = size[:-2], size[1:-1], size[2:]
    with np.errstate(all="ignore"):
        left, right = (here - before) / (t[1:-1] - t[:-2]), (after - here) / (t[2:] - t[1:-1])
        bend = (right - left) / (t[2:] - t[:-2])
        vertex = here - (left + bend * (t[1:-1] - t[:-2])) ** 2 / (4 * bend)
    same = (np.sign(g[:-2]) == np.sign(g[1:-1])) & (np.sign(g[1:-1]) == np.sign(g[2:]))
    low = same & (here <= before) & (here <= after) & (bend > 0) & (vertex < TURNS * np.minimum(before, after))
    return {int(j) + 1 for j in np.flatnonzero(low)}


def _least(value, a, b):
    """Where a positive signal is below zero between a and b; None where it is not."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(value, bounds=sorted((a, b)), method="bounded", options={"xatol": 1e-9 * abs(b - a)})
    return float(found.x) if found.fun < 0 else None


def _root(value, a, b):
    """The root between a and b, to rounding; the nearer end where the values there have one sign, as after a jump."""
    from scipy.optimize import brentq

    low, high = value(a), value(b)
    if not low * high < 0:
        return a if abs(low) < abs(high) else b
    return float(brentq(value, a, b, xtol=1e-15, rtol=8.9e-16))


def _require_signal(event, model):
    """Refuse a signal that the model does not have, or that needs jets above those of its equations."""
    if not isinstance(event.signal, str):
        return
    size = len(model.jet_names)
    empty = Run(np.zeros(1), np.full((size, 1), np.nan), model.jet_names, model)
    try:
        empty[event.signal]
    except SpecificationError as error:
        if "jets" not in error.details:
            raise
        raise SpecificationError(
            f"An event of {event.signal!r} was given.",
            f"Events are evaluated from the jets up to {model.jet_names[-1]}.",
            do="Name a coordinate, a derivative up to this order, an actuation, an output or a residual.",
            signal=event.signal,
            jets=error.details["jets"],
        ) from error


def occurrences(found, names):
    """The runs at the instants of events, {name: Run}, from occurrences by name; `names(k)` names the first k jets."""
    runs = {}
    for name, ones in found.items():
        jets = np.array([one.jets for one in ones]).T if ones else np.zeros((0, 0))
        variants = tuple((i, i + 1, one.model) for i, one in enumerate(ones))
        model = ones[0].model if ones else None
        runs[name] = Run(np.array([one.t for one in ones]), jets, names(len(jets)), model, variants=variants)
    return runs
