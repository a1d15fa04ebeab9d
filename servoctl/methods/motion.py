"""What every integrator shares: pieces of a motion, and where a pivot vanishes."""

import contextlib
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Motion:
    """A motion while it is being computed: samples of the state, and the model variant that holds in each piece."""

    counters: dict = field(default_factory=dict)
    pieces: list = field(default_factory=list)
    stop: object = None
    interrupted: bool = False
    changed: set = field(default_factory=set)

    def add(self, model, t, x, top):
        """Append samples t (N,), X (n_x, N) and γ^(s̄) (n, N) computed with one variant of the model."""
        if len(t):
            self.pieces.append((model, np.asarray(t), np.asarray(x), np.asarray(top)))

    def changes_pivots(self, t):
        """Note a change of pivots at t; False where one was made at the same instant before: it did not help."""
        again = t in self.changed
        self.changed.add(t)
        return not again

    def count(self, **numbers):
        """Add to counters."""
        for name, number in numbers.items():
            self.counters[name] = self.counters.get(name, 0) + int(number)

    def samples(self):
        """All samples, an instant that two pieces share once.

        Returns
        -------
        t : (N,) array
        z : (n_z, N) array
        variants : list of (first, last + 1, model)
            Which variant of the model holds for which samples.
        """
        t = np.concatenate([piece[1] for piece in self.pieces])
        z = np.concatenate([np.vstack([piece[2], piece[3]]) for piece in self.pieces], axis=1)
        keep = np.append(True, np.diff(t) != 0)
        owner = np.repeat(np.arange(len(self.pieces)), [len(piece[1]) for piece in self.pieces])[keep]
        variants = []
        for i, number in enumerate(owner):
            model = self.pieces[number][0]
            if variants and variants[-1][2] is model:
                variants[-1] = (variants[-1][0], i + 1, model)
            else:
                variants.append((i, i + 1, model))
        return t[keep], z[:, keep], variants


@contextlib.contextmanager
def interruptible(motion):
    """Ctrl-C ends the work and keeps what was computed."""
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


def sign_change(before, after):
    """Indices of guards that change their sign between two samples."""
    return np.flatnonzero(np.sign(before) * np.sign(after) < 0)
