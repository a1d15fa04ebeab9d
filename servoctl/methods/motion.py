"""What all integrations share: the pieces of a motion, and the change of pivots that the rank monitor requires."""

import contextlib
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from servoctl.methods.choice import Poles
from servoctl.methods.monitor import VANISHING, Monitor, Repivot


@dataclass
class Motion:
    """A motion while it is being computed: samples of the state, and the model variant that holds in each piece."""

    counters: dict = field(default_factory=dict)
    pieces: list = field(default_factory=list)
    stop: object = None
    interrupted: bool = False
    changed: set = field(default_factory=set)
    start: object = None  # X at t0, if it is not the given one

    def add(self, model, t, x, top):
        """Append samples t (N,), X (n_x, N) and γ^(s̄) (n, N) computed with one variant of the model."""
        if len(t):
            self.pieces.append((model, np.asarray(t), np.asarray(x), np.asarray(top)))

    def changes_pivots(self, t):
        """Note a change of pivots at t; False if one was made at this instant already and did not help."""
        again = t in self.changed
        self.changed.add(t)
        return not again

    def count(self, **numbers):
        """Add to counters."""
        for name, number in numbers.items():
            self.counters[name] = self.counters.get(name, 0) + int(number)

    def samples(self):
        """All samples; an instant that two pieces share appears once.

        Returns
        -------
        t : (N,) array
        z : (n_z, N) array
        variants : list of (first, last + 1, model)
            The variant of the model that holds for each range of samples.
        """
        t = np.concatenate([piece[1] for piece in self.pieces])
        keep = np.append(True, np.diff(t) != 0)
        starts = np.cumsum([0, *(len(piece[1]) for piece in self.pieces[:-1])])
        counts = np.add.reduceat(keep, starts, dtype=int)
        z = np.empty((sum(map(len, self.pieces[0][2:])), counts.sum()))  # filled by piece: one large copy takes seconds
        for (_, of_piece, *parts), start, end, count in zip(self.pieces, starts, counts.cumsum(), counts, strict=True):
            z[:, end - count : end] = np.vstack(parts)[:, keep[start : start + len(of_piece)]]
        variants, end = [], 0
        for (model, *_), count in zip(self.pieces, counts.tolist(), strict=True):
            first, end = end, end + count
            if count and variants and variants[-1][2] is model:
                variants[-1] = (variants[-1][0], end, model)
            elif count:
                variants.append((first, end, model))
        return t[keep], z, variants


@contextlib.contextmanager
def interruptible(motion):
    """Ctrl-C ends the integration; the motion so far remains."""
    try:
        yield
    except KeyboardInterrupt:
        motion.interrupted = True


def breakpoints(span, knots):
    """The span cut at the knots inside it, in the direction of integration."""
    t0, t1 = span
    low, high = min(span), max(span)
    margin = 1e-12 * max(1.0, abs(low), abs(high))
    inside = [k for k in knots if low + margin < k < high - margin]
    return [t0, *(inside if t1 >= t0 else reversed(inside)), t1]


def equal_steps(a, b, step):
    """Length [s] and number of equal steps from a to b, the longest that are at most `step`; negative backwards."""
    count = max(1, int(np.ceil(abs(b - a) / step * (1 - 1e-12))))
    return (b - a) / count, count


class Stepping:
    """One integration: the model in use, the monitor of its pivots, and the motion so far.

    A method takes the steps of a smooth piece in `_piece(a, x, b, times)` and returns the state at its end. If a step
    fails, `rank_lost` describes this for a singular program, and `advice` is for other failures.

    Parameters
    ----------
    model : Model
    method : str
    drift : None, Poles, Project or MinimalCoordinates
    progress : callable
    """

    rank_lost = "the step of the integrator shrinks to nothing"
    advice = "Use a larger rtol, or check whether the motion escapes."

    def __init__(self, model, method, drift, progress):
        self.method, self.drift, self.progress, self.motion = method, drift, progress, Motion()
        self._use(model)

    def _use(self, model):
        poles = isinstance(self.drift, Poles)
        self.model, self.f, self.n_x = model, self._function(model, poles), len(model.state_names)
        self.p = np.append(model.parameters, self.drift.coefficients(model)) if poles else model.parameters

    def _function(self, model, poles):
        """The compiled X' and pivots."""
        return model.function("ode_poles" if poles else "ode")

    def run(self, t0, x0, t1, t_eval, knots):
        """Integrate from t0 to t1 [s].

        Parameters
        ----------
        t0 : float
        x0 : (n_x,) array
        t1 : float
        t_eval : (N,) array
            Instants of the samples, in the order of the motion [s].
        knots : sequence of float
            At which steps end [s].

        Returns
        -------
        Motion
        """
        with interruptible(self.motion):
            x, cuts = x0, breakpoints((t0, t1), knots)
            self._start(t0, x0, cuts[1])
            for a, b in pairwise(cuts):
                if self.motion.stop is not None:
                    break
                x = self._piece(a, x, b, t_eval[(t_eval >= min(a, b)) & (t_eval <= max(a, b))])
        return self.motion

    def _start(self, t, x, b):
        """Choose other pivots at the start of the first piece, up to b, if the model's are a bad choice there."""
        self.monitor = Monitor(self.model, t, x)
        if self.monitor.bad_choice(self._outputs(t, x), self._pivots(t, x)):
            variant = self.monitor.repivoted(t, x, self._top(t, x))
            if variant is not None:
                self._go_on(variant, t, x)
            self.motion.stop = self.monitor.refuse_start(t, x, self._outputs(t, x))

    def _outputs(self, t, x):
        return self.f(t, x, self.p)

    def _pivots(self, t, x):
        return self._outputs(t, x)[self.n_x :]

    def _top(self, t, x):
        """γ^(s̄) at a state."""
        return self._outputs(t, x)[self.n_x - self.model.n : self.n_x]

    def _go_on(self, variant, t, x):
        model, self.monitor = variant
        self._use(model)
        self.monitor.begin(self._pivots(t, x))
        self.motion.count(pivot_changes=1)

    def _follow(self, outcome):
        """Go on with other pivots if the outcome requires them; False if the program is singular."""
        if isinstance(outcome, Repivot):
            t, x = outcome.t, outcome.x
            variant = None
            if self.motion.changes_pivots(t):
                variant = outcome.variant or self.monitor.repivoted(t, x, self._top(t, x))
            if variant is not None:
                self._go_on(variant, t, x)
                return True
            outcome = outcome.otherwise
        self.motion.stop = self.monitor.singular(outcome.t, outcome.x, outcome.why)
        return False

    def _fail(self, t, x, why):
        """Stop because no step succeeds."""
        what = f"{self.method} stopped at t = {t:.7g} s: {why}"
        self.motion.stop = self.monitor.failed(t, x, self.rank_lost, what, self.advice)

    def _keep_last(self, t, x):
        """Record the last state, unless it is so near a singularity that γ^(s̄) is lost."""
        if self.monitor.rank_measure(t, x) > VANISHING:
            self.motion.add(self.model, [t], x[:, None], self._top(t, x)[:, None])
