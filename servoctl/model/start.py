"""Consistent starts: held values exact, every invariant satisfied, the rest as near its guess as possible."""

from dataclasses import dataclass, replace

import numpy as np

from servoctl.checks import finite, mapping
from servoctl.errors import InconsistentStart, ServoError, unknown
from servoctl.values import Value

TOLERANCE = 1e-10  # largest residual relative to its gradient times the state; Newton's iteration reaches rounding
GUESSED = 1e3  # weight of a guessed value relative to one without a guess
TRIES = 6  # initial points of the iteration; the first is the reference
FARTHER = 0.1  # distance of each further initial point from the reference, relative to the state's size
SEED = 1788  # seed of these points
REACHED = 1e-16  # scaled residual at which the iteration ends
REPEATED = 1e-12  # singular values below this fraction of the largest count as zero
SPANNED = 1e-9  # a column of the Jacobian with a smaller part outside the span of others lies in it


@dataclass(frozen=True, eq=False)
class State(Value):
    """A consistent state of a model at an instant.

    Attributes
    ----------
    t : float
        [s]
    values : (n_x,) array
    names : tuple of str
    held : tuple of str
        Names of the fixed values.
    free : tuple of str
        Further names that the invariants leave free; their values come from the guess or are near zero.
    residual : float
        Largest scaled residual.
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
        held, free = (", ".join(names) or "nothing" for names in (self.held, self.free))
        return (
            f"State at t = {self.t:g} s\n  {shown}\n  held: {held}; left free: {free}\n"
            f"  largest residual {self.residual:.1e}"
        )


class _Invariants:
    """Invariants of a model at one time: values (m,) and Jacobian (m, n_x)."""

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


@dataclass(frozen=True, eq=False)
class _Aim:
    """The state nearest to a reference is sought, by weights, with some values movable; arrays (n_x,)."""

    names: tuple
    reference: np.ndarray
    weights: np.ndarray
    movable: np.ndarray


@np.errstate(all="ignore")  # trial steps may leave the domain of the equations
def consistent(model, t, held, guess):
    """See `Model.start`."""
    names = model.state_names
    chosen = {**mapping(guess, "The guesses"), **held}
    for name in chosen:
        if name not in names:
            raise unknown(name, names, "state")
    chosen = {name: finite(name, value) for name, value in chosen.items()}
    reference = np.array([chosen.get(name, 0.0) for name in names])
    weights = np.array([GUESSED if name in chosen and name not in held else 1.0 for name in names])
    aim = _Aim(names, reference, weights, np.array([name not in held for name in names]))
    invariants, x, residual = _solve(model, t, aim)
    if not residual < TOLERANCE:
        _refuse(invariants, aim, held, x)
    free = _free(invariants, x, aim, chosen)
    x, residual = _at_guess(invariants, x, residual, aim, [name in free and name in chosen for name in names])
    return State(t, x, names, tuple(held), free, residual)


def _solve(model, t, aim):
    """The start by the model's pivots, else by pivots chosen at the reference, else near the best state so far."""
    invariants = _Invariants(model, t)
    finite_there = np.all(np.isfinite(invariants(aim.reference)[0]))
    x, residual = _best(invariants, aim) if finite_there else (aim.reference, np.inf)
    for at in (aim.reference, None):
        if residual < TOLERANCE:
            break
        if at is None and not finite_there:
            x, residual = _best(invariants, aim)
        try:  # a pivot of the model may vanish there
            other = _Invariants(model.near(t, np.append(x if at is None else at, np.zeros(model.n))), t)
        except ServoError:
            continue
        y, residual_there = _best(other, aim)
        if residual_there < residual or not np.isfinite(residual):
            invariants, x, residual = other, y, residual_there
    return invariants, x, residual


def _at_guess(invariants, x, residual, aim, guessed):
    """The start with free values exactly as guessed, if that is consistent."""
    guessed = np.array(guessed)
    if not guessed.any():
        return x, residual
    moved = _settle(invariants, np.where(guessed, aim.reference, x), replace(aim, movable=aim.movable & ~guessed))
    residual_there = np.abs(invariants.scaled(moved)).max(initial=0.0)
    return (moved, float(residual_there)) if residual_there < TOLERANCE else (x, residual)


def _starts(aim, tries):
    """The reference, then points farther and farther from it."""
    yield aim.reference
    spread = (1.0 + np.abs(aim.reference)) * aim.movable / np.sqrt(aim.weights)
    rng = np.random.default_rng(SEED)
    for attempt in range(1, tries):
        yield aim.reference + attempt * FARTHER * rng.uniform(-1.0, 1.0, len(spread)) * spread


def _best(invariants, aim, tries=TRIES):
    """The projection of the reference onto the invariants; if it fails, from perturbed points."""
    best, smallest = aim.reference, np.inf
    for first in _starts(aim, tries):
        x = _nearest(invariants, _settle(invariants, first, aim), aim)
        residual = np.nan_to_num(np.abs(invariants.scaled(x)), nan=np.inf).max(initial=0.0)
        if residual < smallest:
            best, smallest = x, residual
        if smallest < TOLERANCE:
            break
    return best, float(smallest)


def _step(value, jacobian, aim):
    """The least weighted change of the movable values that solves the linearised invariants."""
    rows = np.sqrt((jacobian**2).sum(axis=1))
    rows = np.where(rows > 0, rows, 1.0)
    a = (jacobian / rows[:, None])[:, aim.movable] / aim.weights[aim.movable]
    full = np.zeros(jacobian.shape[1])
    if a.size and np.all(np.isfinite(a)) and np.all(np.isfinite(value)):
        full[aim.movable] = np.linalg.lstsq(a, value / rows, rcond=REPEATED)[0] / aim.weights[aim.movable]
    return full


def _settle(invariants, x, aim, iterations=60):
    """Damped Gauss-Newton with least steps."""
    value, jacobian = invariants(x)
    norm = np.abs(invariants.scaled(x)).max(initial=0.0)
    for _ in range(iterations):
        if norm < REACHED:
            break
        step = _step(-value, jacobian, aim)
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


def _nearest(invariants, x, aim, iterations=40):
    """The point of the invariants nearest the reference, by successive projection."""
    for _ in range(iterations):
        value, jacobian = invariants(x)
        with np.errstate(all="ignore"):
            trial = aim.reference + _step(-value - jacobian @ (aim.reference - x), jacobian, aim)
        trial = _settle(invariants, trial, aim, 12)
        distance, before = (np.sum((aim.weights * (y - aim.reference)) ** 2) for y in (trial, x))
        if np.abs(invariants.scaled(trial)).max(initial=0.0) > TOLERANCE or not distance < before * (1 - 1e-12):
            break
        x = trial
    return x


def _free(invariants, x, aim, guess):
    """Names that the invariants leave free: guessed ones if possible, then low derivatives."""
    _, jacobian = invariants(x)
    rows = np.sqrt((jacobian**2).sum(axis=1))
    scaled = jacobian / np.where(rows > 0, rows, 1.0)[:, None]
    movable = np.flatnonzero(aim.movable)
    candidates = sorted(reversed(movable), key=lambda i: aim.names[i] in guess)
    basis, determined = np.zeros((len(rows), 0)), set()
    for i in candidates:
        column = scaled[:, i] - basis @ (basis.T @ scaled[:, i])
        column -= basis @ (basis.T @ column)
        size = np.linalg.norm(column)
        if size > SPANNED * max(np.linalg.norm(scaled[:, i]), 1e-12):
            basis = np.column_stack([basis, column / size])
            determined.add(i)
    return tuple(aim.names[i] for i in movable if i not in determined)


def _refuse(invariants, aim, held, x):
    """Raise InconsistentStart: a held value contradicts an invariant, or no state satisfies one."""
    residuals = np.abs(invariants.scaled(x))
    worst, largest = invariants.names[int(np.argmax(residuals))], float(residuals.max())
    loosened, residual = _best(invariants, replace(aim, movable=np.ones(len(aim.names), dtype=bool)), tries=2)
    if held and residual < TOLERANCE:
        moved = {n: float(loosened[aim.names.index(n)]) for n in held}
        change = max(moved, key=lambda n: abs(moved[n] - held[n]) / (1.0 + abs(held[n])))
        raise InconsistentStart(
            f"{change} = {held[change]:g} contradicts the invariant {worst!r} (residual {largest:.2e}).",
            "Held values satisfy every constraint and its time derivatives.",
            nearest=f"{change} = {moved[change]:.9g}.",
            do="Hold fewer values, or pass this one in guess={...}.",
            held=change,
            value=float(held[change]),
            invariant=worst,
            residual=largest,
            nearest_value=moved[change],
        )
    raise InconsistentStart(
        f"The search for a consistent start ended with the residual {largest:.2e} of the invariant {worst!r}.",
        "A start satisfies every constraint and its time derivatives.",
        do="Pass a guess={...} nearer to the motion, or check that the program can hold at this time.",
        invariant=worst,
        residual=largest,
    )
