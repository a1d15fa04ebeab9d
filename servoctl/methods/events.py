"""Events: instants at which a signal of a motion crosses a value, located within the steps of its method."""

from collections.abc import Callable, Mapping

import numpy as np

from servoctl.checks import as_list, finite, mapping, whole
from servoctl.dense import AS_ZERO, one_sign_apart, parted
from servoctl.errors import SpecificationError
from servoctl.model.jets import jet_names_to
from servoctl.run import Run
from servoctl.values import frozen

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

    The motion goes from t0 to t1 [s].
    """

    def __init__(self, events, model, t0, t1):
        self.events, self.found, self.signs, self.start = events, [], None, t0
        self.forward, self.length = (-1.0 if t1 < t0 else 1.0), abs(t1 - t0)
        self.began = None, None, 0
        for event in events.values():
            _require_signal(event, model)

    def first(self, model, ends, jets_at, stops=False):
        """The first terminal event along steps with these ends (S + 1,), or None; others before it are recorded.

        Ends are in the order of the motion, from that of the last steps on [s]; `jets_at` gives jets (n_z, N) at
        instants (N,) in this order. With `stops` the motion cannot go on from the last: an event may be what makes it
        singular there.
        """
        if self.began[0] == ends[0]:  # these steps are repeated
            self.signs, self.found = self.began[1], self.found[: self.began[2]]
        self.signs = dict.fromkeys(self.events, 0.0) if self.signs is None else dict(self.signs)
        self.began, crossed = (ends[0], dict(self.signs), len(self.found)), []
        elapsed = self.forward * (ends - self.start)
        edges = parted(elapsed, self.length) if len(ends) > 1 else elapsed
        rounding = AS_ZERO * np.abs(jets_at(ends)[: model.nq]).max(initial=0.0)
        for name, event in self.events.items():

            def value(s, event=event):  # of the elapsed time
                t = self.start + self.forward * s
                return self._along(event, model, t, jets_at(t))

            s = one_sign_apart(value, edges, rounding * isinstance(event.signal, str))
            g = value(s)
            s, g = s[np.isfinite(g)], g[np.isfinite(g)]
            g = _with_start(g) if s[:1] == 0 else g
            crossings = list(self._crossings(name, s, g, lambda at, value=value: float(value(np.array([at]))[0])))
            crossings += self._at_stop(s, g) if stops and not crossings else []
            crossed += [(at, name) for at, sign in crossings if event.direction in (0.0, sign)]
        for s, name in sorted(crossed):
            t, last = self.start + self.forward * s, self.start + self.forward * min(s, elapsed[-1])
            self.found.append(Occurrence(name, float(t), jets_at(np.array([last]))[:, 0], model))
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

    def _crossings(self, name, s, g, value):
        """Elapsed times at which values g (N,) at s (N,) change their sign, with the new one."""
        sign, last = self.signs[name], None  # the last sign, and when it was seen
        for at, new in zip(s, np.sign(g), strict=True):
            if sign * new < 0:
                yield (s[0] if last is None else _root(value, last, at)), new
            if new:
                sign, last = new, at
        self.signs[name] = sign

    def _at_stop(self, s, g):
        """Where values g (N,) at s (N,) vanish right beyond the last instant, extrapolated, with the new sign."""
        k = int(np.searchsorted(s, s[-1] * (1 - AT_START))) - 1 if len(s) else -1
        if k < 0 or not g[k] * g[-1] > 0 or not abs(g[-1]) < abs(g[k]):
            return []
        at = s[-1] + g[-1] / (g[k] - g[-1]) * (s[-1] - s[k])
        return [(at, -np.sign(g[-1]))] if abs(at - s[-1]) <= AT_STOP * s[-1] else []


def _with_start(g):
    """Values g (N,) from the start of a motion on, the first of them 0 where it is the rounding of zero."""
    size = np.abs(g[np.isfinite(g)]).max(initial=0.0)
    return np.append(0.0 if np.abs(g[0]) <= AT_START * size else g[0], g[1:])


def _root(value, a, b):
    """The root between a and b, to rounding; the nearer end where the values there have one sign, as after a jump."""
    from scipy.optimize import brentq

    low, high = value(a), value(b)
    if not low * high < 0:
        return a if abs(low) < abs(high) else b
    return float(brentq(value, a, b, xtol=1e-15, rtol=8.9e-16, disp=False))  # a multiple root is as near as it gets


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
