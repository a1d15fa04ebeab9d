"""Consistent starts: every invariant at every level, held values exact, the rest as near its guess as possible."""

from dataclasses import dataclass

import numpy as np

from servoctl.checks import finite, mapping
from servoctl.errors import InconsistentStart, ServoError, unknown

TOLERANCE = 1e-10  # of a residual relative to its gradient times the state; Newton reaches rounding
GUESSED = 1e3  # weight of a guessed value against one that is merely to stay near zero


@dataclass(frozen=True)
class State:
    """A consistent state of a model at an instant.

    Attributes
    ----------
    t : float
        [s]
    values : (n_x,) array
    names : tuple of str
    held : tuple of str
        Names whose values were given.
    free : tuple of str
        Names that the invariants left free, beside the held ones; their values come from the guess or are near zero.
    residual : float
        Largest scaled residual that is left.
    """

    t: float
    values: np.ndarray
    names: tuple
    held: tuple
    free: tuple
    residual: float

    def __getitem__(self, name):
        if name not in self.names:
            raise unknown(name, self.names, "state")
        return float(self.values[self.names.index(name)])

    def __repr__(self):
        items = [f"{name} = {value:.6g}" for name, value in zip(self.names, self.values, strict=True)]
        shown = ", ".join(items[:12]) + (f", ... ({len(items)} in all)" if len(items) > 12 else "")
        return "\n".join([
            f"State at t = {self.t:g} s",
            f"  {shown}",
            f"  held: {', '.join(self.held) or 'nothing'}; left free: {', '.join(self.free) or 'nothing'}",
            f"  largest residual {self.residual:.1e}",
        ])  # fmt: skip


class _Invariants:
    """Invariants of a model at one time, with rows scaled to their gradients."""

    def __init__(self, model, t):
        self.f, self.t, self.p = model.function("invariants"), t, model.parameters
        self.names = [name for _, name in model.invariant_names()]
        self.m = len(self.names)

    def __call__(self, x):
        with np.errstate(all="ignore"):
            y = self.f(self.t, x, self.p)
        return y[: self.m], y[self.m :].reshape(len(x), self.m).T

    def scaled(self, x):
        """Residuals relative to the size of their gradients times that of the state."""
        value, jacobian = self(x)
        return value / np.maximum(np.sqrt((jacobian**2 * (1.0 + np.abs(x)) ** 2).sum(axis=1)), 1e-300)


def consistent(model, t, held, guess):
    """See `Model.start`."""
    names = model.state_names
    both = {**mapping(guess, "The guesses"), **held}
    given = {name: finite(name, value) for name, value in both.items() if _known(name, names)}
    reference, weights = np.zeros(len(names)), np.ones(len(names))
    for name, value in given.items():
        reference[names.index(name)] = value
        weights[names.index(name)] = 1.0 if name in held else GUESSED
    movable = np.array([name not in held for name in names])
    invariants, x, residual = _solve(model, t, reference, weights, movable)
    if not residual < TOLERANCE:
        _refuse(invariants, reference, weights, held, names, x)
    free = _free(invariants, x, movable, names, given)
    x, residual = _at_guess(invariants, x, residual, reference, weights, movable, names, free, given)
    return State(t, x, names, tuple(held), free, residual)


def _solve(model, t, reference, weights, movable):
    """The start by the model's own choice of pivots, or by one made at the reference or near what was found."""
    invariants = _Invariants(model, t)
    finite_there = np.all(np.isfinite(invariants(reference)[0]))
    x, residual = _best(invariants, reference, weights, movable) if finite_there else (reference, np.inf)
    for at in (reference, None):
        if residual < TOLERANCE:
            break
        if at is None and not finite_there:
            x, residual = _best(invariants, reference, weights, movable)
        try:  # a pivot of the model may vanish there
            other = _Invariants(model.near(t, np.append(x if at is None else at, np.zeros(model.n))), t)
        except ServoError:
            continue
        y, left = _best(other, reference, weights, movable)
        if left < residual or not np.isfinite(residual):
            invariants, x, residual = other, y, left
    return invariants, x, residual


def _known(name, names):
    if name not in names:
        raise unknown(name, names, "state")
    return True


def _at_guess(invariants, x, residual, reference, weights, movable, names, free, given):
    """The start with free values exactly as guessed, where that is consistent."""
    guessed = np.array([name in free and name in given for name in names])
    if not guessed.any():
        return x, residual
    start = np.where(guessed, reference, x)
    moved = _settle(invariants, start, weights, movable & ~guessed)
    left = np.abs(invariants.scaled(moved)).max(initial=0.0)
    return (moved, float(left)) if left < TOLERANCE else (x, residual)


def _starts(reference, spread, tries):
    """The reference, then points farther and farther from it."""
    yield reference
    rng = np.random.default_rng(1788)
    for attempt in range(1, tries):
        yield reference + attempt * 0.1 * rng.uniform(-1.0, 1.0, len(reference)) * spread


def _best(invariants, reference, weights, movable, tries=6):
    """The projection of the reference onto the invariants, from perturbed starts where the first fails."""
    best, smallest = reference, np.inf
    for first in _starts(reference, (1.0 + np.abs(reference)) * movable / np.sqrt(weights), tries):
        x = _settle(invariants, first, weights, movable)
        x = _nearest(invariants, x, reference, weights, movable)
        residual = np.nan_to_num(np.abs(invariants.scaled(x)), nan=np.inf).max(initial=0.0)
        if residual < smallest:
            best, smallest = x, residual
        if smallest < TOLERANCE:
            break
    return best, float(smallest)


def _step(value, jacobian, weights, movable):
    """The least weighted change of the movable values that solves the linearised invariants."""
    rows = np.sqrt((jacobian**2).sum(axis=1))
    rows = np.where(rows > 0, rows, 1.0)
    a = (jacobian / rows[:, None])[:, movable] / weights[movable]
    full = np.zeros(jacobian.shape[1])
    if a.size and np.all(np.isfinite(a)) and np.all(np.isfinite(value)):
        full[movable] = np.linalg.lstsq(a, value / rows, rcond=1e-12)[0] / weights[movable]
    return full


def _settle(invariants, x, weights, movable, iterations=60):
    """Damped Gauss-Newton with least steps."""
    value, jacobian = invariants(x)
    norm = np.abs(invariants.scaled(x)).max(initial=0.0)
    for _ in range(iterations):
        if norm < 1e-16:
            break
        step = _step(-value, jacobian, weights, movable)
        damping = 1.0 / max(1.0, np.max(np.abs(step) / (1.0 + np.abs(x)), initial=0.0))
        for _ in range(15):
            trial = x + damping * step
            new = np.abs(invariants.scaled(trial)).max(initial=0.0)
            if new < norm:
                break
            damping /= 3
        else:
            break
        x, norm = trial, new
        value, jacobian = invariants(x)
    return x


def _nearest(invariants, x, reference, weights, movable, iterations=40):
    """The point of the invariants nearest the reference, by successive projection."""
    for _ in range(iterations):
        value, jacobian = invariants(x)
        with np.errstate(all="ignore"):
            trial = reference + _step(-value - jacobian @ (reference - x), jacobian, weights, movable)
        trial = _settle(invariants, trial, weights, movable, 12)
        distance, before = (np.sum((weights * (y - reference)) ** 2) for y in (trial, x))
        if np.abs(invariants.scaled(trial)).max(initial=0.0) > TOLERANCE or not distance < before * (1 - 1e-12):
            break
        x = trial
    return x


def _free(invariants, x, movable, names, guess):
    """Names that the invariants leave free: guessed ones where possible, and low derivatives."""
    _, jacobian = invariants(x)
    rows = np.sqrt((jacobian**2).sum(axis=1))
    scaled = jacobian / np.where(rows > 0, rows, 1.0)[:, None]
    candidates = [i for i in reversed(range(len(names))) if movable[i]]
    candidates.sort(key=lambda i: names[i] in guess)
    basis, determined = np.zeros((len(rows), 0)), set()
    for i in candidates:
        column = scaled[:, i] - basis @ (basis.T @ scaled[:, i])
        column -= basis @ (basis.T @ column)
        size = np.linalg.norm(column)
        if size > 1e-9 * max(np.linalg.norm(scaled[:, i]), 1e-12):
            basis = np.column_stack([basis, column / size])
            determined.add(i)
    return tuple(names[i] for i in range(len(names)) if movable[i] and i not in determined)


def _refuse(invariants, reference, weights, held, names, x):
    left = np.abs(invariants.scaled(x))
    worst = invariants.names[int(np.argmax(left))]
    loosened, residual = _best(invariants, reference, weights, np.ones(len(names), dtype=bool), tries=2)
    if held and residual < TOLERANCE:
        moved = {n: float(loosened[names.index(n)]) for n in held}
        change = max(moved, key=lambda n: abs(moved[n] - held[n]) / (1.0 + abs(held[n])))
        raise InconsistentStart(
            f"{change} = {held[change]:g} is held, against the invariant {worst!r} (residual {left.max():.2e}).",
            "Held values satisfy every constraint at every level.",
            nearest=f"{change} = {moved[change]:.9g}.",
            do="Hold fewer values, or give it as a guess.",
            held=change,
            invariant=worst,
            nearest_value=moved[change],
        )
    raise InconsistentStart(
        f"No consistent start was found: the invariant {worst!r} keeps the residual {left.max():.2e}.",
        "A start satisfies every constraint at every level.",
        do="Give a guess={...} nearer the motion, or check that the program can hold at this time.",
        invariant=worst,
        residual=float(left.max()),
    )
