"""What all integrations share: the pieces of a motion, and the change of pivots that weak pivots require."""

import contextlib
import threading
from _signal import SIGINT, getsignal  # `signal` makes enumerations of them, which takes ten times as long
from _signal import signal as set_signal
from dataclasses import dataclass, field

import numpy as np

from servoctl.dense import Dense, steps_of
from servoctl.errors import IntegrationStopped, ServoError
from servoctl.methods.choice import Poles
from servoctl.methods.edges import Edges, edge
from servoctl.methods.lost_rank import VANISHING, failed, singular
from servoctl.methods.pieces import DEFAULT, FIXED_STEPS, End, Tolerance
from servoctl.methods.rank import Fine, Rank, Singular, Weak
from servoctl.methods.sizes import from_start
from servoctl.methods.switches import Switches, no_model, sticks
from servoctl.model.full import departure, other_order
from servoctl.model.variants import derived_near, strong_form

CHATTERS, CHATTERS_IN = 100, 1e-3  # switches in this part of the span: the motion stays on one, as after ever less time
NO_CHOICE = "no choice of pivots leads on"
MOST_CHANGES = 2  # of pivots at one instant: the same rows without a choice, then rows derived again
DEFAULT_SAMPLES = 1001  # without t_eval: smooth curves, and as many as figures show
SAME_INSTANT = 1e-12  # of the time: instants closer than this are one
BESIDE_KNOTS = 0.1  # of that: how far before and after a knot a piece ends and begins, with all stages on its own side
MOST_KEPT = 200e6  # bytes of steps: beyond them a motion is known at its samples alone
MOST_RESERVED = 2_000_000  # samples: for more of them arrays grow, by doubling


@dataclass
class Motion:
    """A motion while it is being computed: samples of the state, and the model variant that holds in each piece.

    The samples from `start` to `end` of a piece belong to its model; its steps begin at the sample `first`, which is
    `start` or the one before, as an instant that two pieces share is one sample.
    """

    counters: dict = field(default_factory=dict)
    pieces: list = field(default_factory=list)  # (model, first, start, end)
    stop: object = None
    interrupted: bool = False
    ended: str = ""  # by this terminal event
    occurrences: dict = field(default_factory=dict)  # of events, by name
    note: str = ""
    changed: dict = field(default_factory=dict)
    switches: list = field(default_factory=list)
    start: object = None  # X at t0, if it is not the given one
    room: int = 0  # samples of the whole motion
    drifted: float = np.nan  # largest residual at t1, relative to its gradient times the state; NaN if it is not known
    largest: float | np.ndarray = 0.0  # magnitudes (n_x,) of X, `from_start`, at the ends of steps
    steps: list = field(default_factory=list)  # `Dense`, kept until they fill the memory that they may take
    kept: float = 0.0  # memory of the steps; infinite where it was too much
    _t: np.ndarray = field(default_factory=lambda: np.zeros(0))
    _jets: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def t(self):
        """Instants of all samples [s], (N,) array."""
        return self._t[: self._end]

    @property
    def jets(self):
        """Jets at all samples, (n_z, N) array."""
        return self._jets[:, : self._end]

    @property
    def _end(self):
        return self.pieces[-1][-1] if self.pieces else 0

    def add(self, model, t, *levels):
        """Append samples t (N,) and the levels of their jets, (m, N) each, computed with one variant of the model."""
        start, t = self._end, np.asarray(t)
        shared = int(start > 0 and len(t) > 0 and t[0] == self._t[start - 1])
        further = t[1:] != t[:-1]
        every = bool(further.all())
        new = slice(shared, None) if every else np.append(not shared, further)  # a slice is eleven times as fast
        end = start + (len(t) - shared if every else int(new.sum()))
        if end == start:
            return
        if end > len(self._t):
            self._reserve(max(end, 2 * start, min(self.room, MOST_RESERVED)), sum(map(len, levels)))
        self._t[start:end], row = t[new], 0
        for level in levels:
            self._jets[row : row + len(level), start:end] = level[:, new]
            row += len(level)
        self.pieces.append((model, start - shared, start, end))

    def fill(self, model, t, jets):
        """Set all samples t (N,) and jets (n_z, N), computed with one variant of the model."""
        self.pieces, self._t, self._jets = [(model, 0, 0, len(t))], np.array(t), jets

    def keep(self, model, t, jets, further=(), end=None, first=0):
        """Keep steps with ends t (S + 1,), or up to an end within the last one [s]; see `Dense`."""
        if end is not None and end != t[-1]:
            forward = 1.0 if t[-1] >= t[0] else -1.0
            t = np.append(t[forward * t < forward * end], end)
        if len(t) < 2 or t[0] == t[-1] or self.kept == np.inf:
            return
        self.steps.append(Dense(model, t, jets, further, first))
        self.kept += self.steps[-1].nbytes
        if self.kept > MOST_KEPT:
            self.steps, self.kept = [], np.inf
            self.say(f"interpolated between samples, as its steps take more than {MOST_KEPT / 1e6:g} MB")

    def say(self, what):
        """Add what the message of the run says."""
        self.note = "; ".join(dict.fromkeys([*filter(None, self.note.split("; ")), what]))

    def _reserve(self, room, rows):
        """Make room for samples; the system gives memory as they fill it."""
        t, jets = np.empty(room), np.empty((rows, room))
        if self.pieces:
            t[: self._end], jets[:, : self._end] = self.t, self.jets
        self._t, self._jets = t, jets

    def by_piece(self):
        """The (model, t, jets) of each piece."""
        return [(model, self._t[a:b], self._jets[:, a:b]) for model, _, a, b in self.pieces]

    def reaches(self, x):
        """Take in the states (n_x, S) at the ends of steps, `from_start`."""
        self.largest = np.fmax(self.largest, np.abs(x).max(axis=1))

    def end_before(self, t, error):
        """Drop the samples from an instant t [s] on, and stop there for an error."""
        self.stop = error  # first: if Ctrl-C comes between the two, the same samples are cut again
        self._cut(int(np.flatnonzero(self.t == t)[0]))

    def end_after(self, t, error):
        """Drop the samples after an instant t [s], and stop there for an error."""
        self.stop, times = error, self.t
        if len(times) > 1:
            self._cut(int(np.sum(times <= t if times[-1] > times[0] else times >= t)))

    def _cut(self, count):
        """Keep the first samples alone."""
        self.pieces = [(model, first, a, min(b, count)) for model, first, a, b in self.pieces if a < count]

    def end_where_undefined(self, method):
        """Stop before the first sample at which a jet has no finite value, as 0/0, also where it has a limit."""
        if np.isfinite(self.jets).all():
            return
        k = int(np.flatnonzero(~np.isfinite(self.jets).all(axis=0))[0])
        if self.stop is not None and k == len(self.t) - 1:  # the stop that follows says why
            return self._cut(k)
        model, t = next(model for model, _, _, end in self.pieces if k < end), float(self.t[k])
        names = [name for name, value in zip(model.jet_names, self.jets[:, k], strict=False) if not np.isfinite(value)]
        states = self.jets[: len(model.state_names), max(k - 1, 0) : k + 1]
        why, row = edge(model, t, states[:, -1 if np.isfinite(states[:, -1]).all() else 0])
        error = IntegrationStopped(
            f"{method} stopped at t = {t:.7g} s: no finite value of {', '.join(names) or 'a jet'}{why and f'; {why}'}.",
            "Samples of a motion have finite coordinates, velocities and accelerations.",
            do="Write what the program prescribes so that it and its derivatives have values there, also as limits, or "
            "leave this instant out of t_eval. The run before it is in .run.",
            t=t,
            **({"residual": row} if row else {}),
        )
        self.end_before(self.t[k], error)

    def end_where_orders_change(self):
        """Stop before the first sample at which a row has another order than the one that it was derived with."""
        for model, t, jets in self.by_piece():
            k, name = departure(model, t, jets) if model.reduction.rests else (None, "")
            if k is not None:
                at = float(t[k])
                try:
                    free = derived_near(model, at, jets[: len(model.jet_names), k]).free
                except ServoError as error:
                    free = error.details.get("free")
                return self.end_before(t[k], other_order(name, at, free, model.free))

    def changes_pivots(self, t):
        """Note a change of pivots at t; how many were made at this instant already and did not help."""
        self.changed[t] = self.changed.get(t, -1) + 1
        return self.changed[t]

    def count(self, **numbers):
        """Add to counters."""
        for name, number in numbers.items():
            self.counters[name] = self.counters.get(name, 0) + int(number)

    def variants(self):
        """The variant of the model that holds for each range of samples: a list of (first, last + 1, model)."""
        result = []
        for model, _, start, end in self.pieces:
            if result and result[-1][2] is model:
                start = result.pop()[0]
            result.append((start, end, model))
        return result


@contextlib.contextmanager
def interruptible(motion):
    """Ctrl-C ends the integration; the motion so far remains."""
    try:
        yield
    except KeyboardInterrupt:
        motion.interrupted = True


@contextlib.contextmanager
def without_interruption():
    """Ctrl-C waits until the end; the list is not empty if it came."""
    pressed, before = [], getsignal(SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield pressed
        return
    set_signal(SIGINT, lambda number, frame: pressed.append(number))
    try:
        yield pressed
    finally:
        set_signal(SIGINT, before)


def margin_at(t, span):
    """Distance from an instant [s] of a motion over a span within which another is the same."""
    return SAME_INSTANT * max(min(1.0, abs(span[1] - span[0])), abs(t))


def breakpoints(span, knots):
    """The span cut at the knots inside it, in the direction of integration."""
    t0, t1 = span
    if not len(knots):
        return [t0, t1]
    knots = np.asarray(knots, dtype=float)
    low, high = min(span), max(span)
    inside = knots[(knots > low + margin_at(low, span)) & (knots < high - margin_at(high, span))].tolist()
    return [t0, *(inside if t1 >= t0 else reversed(inside)), t1]


def equal_steps(a, b, step):
    """Length [s] and number of equal steps from a to b, the longest that are at most `step`; negative backwards."""
    count = max(1, int(np.ceil(abs(b - a) / step * (1 - 1e-12))))
    return (b - a) / count, count


class Stepping:
    """One integration: the model in use, the rank along it, and the motion so far.

    A method takes the steps of a smooth piece in `_piece(a, x, b, times)` and returns the instant and the state at its
    end, which lies before b where a switching function vanishes. If a step fails, `rank_lost` describes this for a
    singular program, and `advice` is for other failures.
    """

    rank_lost = "the step of the integrator shrinks to nothing"
    advice = "Use a larger rtol, or check whether the motion escapes."
    switches = edges = None  # that are looked for, while steps are taken
    family = None  # the smooth models of a model with kinks or switches
    events = None  # that are looked for
    tolerances = None  # rtol and atol; None for steps of fixed length
    parts = 8  # of a step, at whose ends switching functions are evaluated; 1 where steps are short
    projects = False  # whether ends of steps are projected
    knots = frozenset()  # inside the span
    cuts = ()  # at which steps end: the ends of the span, and these knots

    def __init__(self, model, method, drift, progress):
        self.method, self.drift, self.progress, self.motion = method, drift, progress, Motion()
        self._use(model)

    def _use(self, model):
        poles = isinstance(self.drift, Poles)
        self.model, self.f, self.n_x = model, self._function(model, poles), len(model.state_names)
        self.coefficients = self.drift.coefficients(model) if poles else ()
        self.p = np.append(model.p, self.coefficients) if poles else model.p

    def _function(self, model, poles):
        """The compiled X' and pivots."""
        return model.function("ode_poles" if poles else "ode")

    def run(self, t0, x0, t1, t_eval, knots):
        """Integrate from x0 (n_x,) at t0 to t1 [s], with samples at t_eval, in this order; steps end at the knots."""
        with interruptible(self.motion):
            self.span, self.length, self.x0 = (t0, t1), abs(t1 - t0), x0
            self._look_out(t0, x0)
            t, x, cuts = t0, x0, breakpoints(self.span, knots)
            at_ends = (c for c in self.span if (np.abs(np.subtract(knots, c)) <= margin_at(c, self.span)).any())
            self.cuts, self.knots = cuts, {*cuts[1:-1], *at_ends} if len(knots) else frozenset()
            ends = self._ends(cuts)
            self._start(t, x, cuts[1])
            self.motion.room = self._samples(cuts, t_eval)
            for b in ends:
                while t != b and self.motion.stop is None and not self.motion.ended:
                    t, x = self._piece(t, x, b, self._due(t_eval, t, b))
        return self.motion

    def _ends(self, cuts):
        """The ends of the pieces that are integrated one after the other."""
        return cuts[1:]

    def _due(self, t_eval, t, b):
        """The instants of samples after t, or from the start on, up to b."""
        forward = np.sign(self.span[1] - self.span[0])
        before = np.searchsorted(forward * t_eval, forward * t, "left" if t == self.span[0] else "right")
        return t_eval[before : np.searchsorted(forward * t_eval, forward * b, "right")]

    def _samples(self, cuts, t_eval):
        """The number of samples of a whole motion through instants (K,) at which pieces end."""
        return len(t_eval)

    def _beside(self, a, b):
        """The ends of a piece, moved inwards where they are knots: on a knot a jump has the value beyond, or before."""
        forward = np.copysign(BESIDE_KNOTS, b - a)
        first, last = (forward * margin_at(c, self.span) * (c in self.knots) for c in (a, b))
        return a + first, b - last

    def _look_out(self, t, x):
        """Look for the ends of smooth pieces, from the start on."""
        self.tolerance = Tolerance(self.model, x, *(self.tolerances or DEFAULT))
        self.edges = Edges(self.tolerance, self.length, self.tolerances is None, self.projects)
        if self.family is not None:
            branches = self.family.branches(t, x)
            self.switches = Switches(self.family, branches, self.length, self.parts, self.tolerance)

    def _begin_piece(self, t, pivots):
        """Start a piece at t [s] with pivots (n_g,)."""
        self.rank.begin(self.model, t, pivots)
        if self.switches is not None:
            self.switches.start = t

    def _inspected(self, stretch):
        """The outcome of steps: that of the rank, or the `End` of the piece if it comes first."""
        outcome = self._smooth(stretch)
        self.motion.reaches(from_start(self.model, stretch.x[:, : outcome.steps + 1], self.x0))
        return outcome if self.events is None else self._event(stretch, outcome) or outcome

    def _event(self, stretch, outcome):
        """The `End` at a terminal event within steps before their outcome; None without."""
        end = stretch.t[outcome.steps] if isinstance(outcome, Fine) else outcome.t
        ends = np.append(stretch.t[: outcome.steps + 1], end)
        dense = stretch.dense

        def jets_at(t):
            return self._with_top(t, dense(steps_of(stretch.t, t), t))

        ends = ends[np.append(np.diff(ends) != 0, True)]
        found = self.events.first(self.model, ends, jets_at, isinstance(outcome, Singular))
        if found is None:
            return None
        k = max(int(np.searchsorted(self.events.forward * stretch.t, self.events.forward * found.t)) - 1, 0)
        return End(k, found.t, found.jets[: self.n_x], event=found.name)

    def _with_top(self, t, x):
        """The jets (n_z, N) at times t (N,) and states x (n_x, N)."""
        poles = isinstance(self.drift, Poles)
        f = self.model.function("ode_poles" if poles else "ode")
        p = self.p if poles else self.model.p
        return np.concatenate([x, f.grid(t, x, p)[self.n_x - self.model.n : self.n_x]])

    def _smooth(self, stretch):
        """The outcome of steps: that of the rank, or the `End` of the smooth piece if it comes first."""
        whole, switch = stretch, None
        if self.switches is not None:
            switch = self.switches.first(stretch, stretch.dense, self._state_within(stretch))
        if switch is not None:
            stretch = stretch.first(switch.steps)
        outcome = self.rank.inspect(stretch) if len(stretch.t) > 1 else Fine(0)
        outcome = switch if switch is not None and isinstance(outcome, Fine) else outcome
        self.tolerance.accept(whole.x[:, : outcome.steps + 1])
        t = whole.t[: outcome.steps + 1]
        if not isinstance(outcome, Fine) and (outcome.t - t[-1]) * (self.span[1] - self.span[0]) > 0:
            t = np.append(t, outcome.t)
        return self.edges.first(self.model, t, lambda: self._continuous(whole)) or outcome

    def _continuous(self, stretch):
        """X (n_x, N) from steps (N,) and times (N,), where edges are looked for: before its end is projected."""
        return stretch.dense

    def _state_within(self, stretch):
        """X from (k, t) within steps, where ends of smooth pieces are located."""
        return stretch.state

    def _turn(self, end, b):
        """Stop at the end of a smooth piece, or go on beyond its switch towards b."""
        if end.event:
            self.motion.ended = end.event
            if end.t not in self.motion.t[-1:]:
                self.motion.add(self.model, [end.t], end.x[:, None], self._top(end.t, end.x)[:, None])
            return
        if end.error is not None:
            return self.motion.end_after(end.error.details["t"], end.error)
        stuck, branches = self.switches.stays(end)
        often = self.motion.switches[-CHATTERS:]
        if len(often) == CHATTERS and abs(end.t - often[0]) < CHATTERS_IN * self.length:
            stuck = stuck or [self.family.switches[i].text for i in end.switched]
        if stuck:
            self.motion.stop = sticks(self.method, end.t, stuck)
            return
        try:
            model = self.family.at(branches)
        except ServoError as error:
            row, free, expected = (error.details.get(name) for name in ("row", "free", "expected"))
            if row and expected is not None:
                self.motion.stop = other_order(row, end.t, free, expected)
            else:
                self.motion.stop = no_model(self.method, end.t, self.switches.texts(end), error)
            return
        self.motion.stop = self.switches.jump(self.model, model, end)
        if self.motion.stop is None:
            self.motion.switches.append(end.t)
            self._use(model)
            self._start(end.t, end.x, b)
            self.switches.branches = branches

    def _start(self, t, x, b):
        """Choose other pivots at the start of the first piece, up to b, if the model's are a bad choice there."""
        self.rank = self._rank_from(t, x)
        outputs, pivots = self._with_pivots(t, x)
        self.rank.begin(self.model, t, pivots)
        if self.rank.bad_choice(outputs, pivots):
            for _ in range(MOST_CHANGES):
                self._repivot(t, x)
                outputs, pivots = self._with_pivots(t, x)
                if not self.rank.without_value(outputs, pivots):
                    return
            finite, weakest = np.all(np.isfinite(outputs)), self.rank.weakest(pivots)
            why = f"a pivot is {weakest:.1e} of its size nearby" if finite else "the accelerations are not finite there"
            self.motion.stop = singular(self.rank, t, x, why)

    def _outputs(self, t, x):
        return self.f(t, x, self.p)

    def _with_pivots(self, t, x):
        """The outputs at a state, and the pivots among them."""
        outputs = self._outputs(t, x)
        return outputs, self._pivots_of(outputs)

    def _pivots(self, t, x):
        return self._pivots_of(self._outputs(t, x))

    def _pivots_of(self, outputs):
        return outputs[self.n_x :]

    def _top(self, t, x):
        """γ^(s̄) at a state."""
        return self._outputs(t, x)[self.n_x - self.model.n : self.n_x]

    def _rank_from(self, t, x):
        fixed = self.tolerances is None and not self.model.flat
        return Rank(self.model, t, x, self.tolerance, FIXED_STEPS if fixed else 1.0)

    def _repivot(self, t, x):
        """Go on from a state with the same rows, solved without a choice of pivots, or derived again; False without."""
        jets = np.append(x, np.nan_to_num(self._top(t, x)))
        sizes = {name: size for name, size in zip(self.model.state_names, self.rank.largest, strict=True) if size > 0}
        try:
            model = strong_form(self.model, t, jets) or derived_near(self.model, t, jets, sizes)
        except ServoError:
            return False
        same = model.reduction.rows is self.model.reduction.rows
        self._use(model)
        self.rank = self.rank if same else self._rank_from(t, x)
        self.rank.go_on(model, self._pivots(t, x), t, x)
        self.motion.count(pivot_changes=1)
        return True

    def _follow(self, outcome):
        """Go on with other pivots if the outcome requires them; False if the program is singular."""
        at, why = (outcome.at, outcome.why) if isinstance(outcome, Singular) else (outcome.t, NO_CHOICE)
        if isinstance(outcome, Weak):
            tried = self.motion.changes_pivots(outcome.t)
            if tried < MOST_CHANGES and self._repivot(outcome.t, outcome.x):
                return True
        stop = self.edges and self.edges.stopped(self.model, outcome.t)
        last = min(outcome.t, at, key=lambda t: abs(t - self.rank.start[0]))
        self.motion.end_after(last, stop or singular(self.rank, at, outcome.x, why))
        return False

    def _fail(self, t, x, why):
        """Stop because no step succeeds."""
        place, row = edge(self.model, t, x)
        why = "; ".join(dict.fromkeys(filter(None, (*why.split("; "), place))))
        what = f"{self.method} stopped at t = {t:.7g} s: {why}"
        self.motion.stop = failed(self.rank, t, x, self.rank_lost, (what, self.advice), row)

    def _keep_last(self, t, x):
        """Record the last state, unless it is so near a singularity that γ^(s̄) is lost."""
        end = self.motion.stop.details.get("t", t)
        if abs(end - self.span[0]) >= abs(t - self.span[0]) and self.rank.measure(t, x) > VANISHING:
            self.motion.add(self.model, [t], x[:, None], self._top(t, x)[:, None])
