"""Consistent starts: held values exact, every invariant satisfied, the rest as near its guess as possible."""

from copy import copy
from dataclasses import field, replace
from math import factorial

import casadi as ca
import numpy as np

from servoctl.checks import column, finite, mapping, named
from servoctl.codegen.paths import evaluated
from servoctl.errors import InconsistentStart, ServoError, SpecificationError
from servoctl.markup import Shown
from servoctl.model.equations import Invariants, invariant_names
from servoctl.model.following import instants_of
from servoctl.model.jets import jet_names_to
from servoctl.model.rests import GUESSED, Rests, frame, roots_of_inertia
from servoctl.model.variants import derived_near, strong_form, strong_near
from servoctl.reduction.hidden import OUT_OF_REACH
from servoctl.spec.mechanism import require_known
from servoctl.spec.references import function_of, orders_in
from servoctl.values import Value, frozen

TOLERANCE = 1e-10  # largest residual relative to its gradient times the state; Newton's iteration reaches rounding
TRIES = 6  # initial points of the iteration; the first is the reference
FARTHER = 0.1  # distance of each further initial point from the reference, relative to the state's size
SEED = 1788  # seed of these points
THIRDS = 15  # of a step to a third, until the residual falls
LEAPS = 3  # whole steps along which it may rise, as over a kink
REACHED = 1e-16  # scaled residual at which the iteration ends
REPEATED = 1e-12  # singular values below this fraction of the largest count as zero
SPANNED = 1e-9  # a column of the Jacobian with a smaller part outside the span of others lies in it
SEARCHED = 6  # points from which other states with the same held and free values are sought
FAR = 3.0  # largest distance of these points, relative to the state's size: half a turn
SEARCH_STEPS = 20  # of Newton's method from each
NEARER = 0.25  # of the way from one such state to another: a reference before it is clearly nearer the first
DISTINCT = 1e-3  # difference of two such states, relative to their size
SHOWN = 3  # values by which a printed state tells branches apart
STILL = 1e-6  # largest rate of a value of a state at rest, relative to its size
PRINTED_ZERO = 1e-14  # of the largest value: a smaller one that is not held is printed as zero


@frozen(eq=False)
class State(Value, Shown):
    """A consistent state of a model at an instant.

    Attributes
    ----------
    t : float
        [s]
    values : (n_x,) array
    names : tuple of str
    held : tuple of str
        Names of the fixed values, outputs and conditions.
    free : tuple of str
        Further names that the invariants leave free; their values come from a rest, the guess, or are near zero.
    residual : float
        Largest scaled residual.
    at_rest : tuple of str
        Coordinates that the constraints determine in motion only; their values are the limit of the motion.
    branches : (b, n_x) array
        This state and others with the same held and free values that a short search found, between which neither
        the guess nor the distance from zero decides.
    notes : tuple of str
        On values that no such state has, and on angles that look like degrees.
    """

    t: float
    values: np.ndarray
    names: tuple
    held: tuple
    free: tuple
    residual: float
    at_rest: tuple = ()
    branches: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)), compare=False)
    notes: tuple = field(default=(), compare=False)

    def __getitem__(self, name):
        named(name, self.names, "state")
        return float(self.values[self.names.index(name)])

    def __repr__(self):
        shown = np.where(np.isin(self.names, self.held), self.values, without_rounding(self.values))
        items = [f"{name} = {value:.6g}" for name, value in zip(self.names, shown, strict=True)]
        shown = ", ".join(items[:12]) + (f", ... ({len(items)} in all)" if len(items) > 12 else "")
        held, free, rest = (", ".join(names) or "nothing" for names in (self.held, self.free, self.at_rest))
        return (
            f"State at t = {self.t:g} s\n  {shown}\n  held: {held}; left free: {free}\n"
            f"  largest residual {self.residual:.1e}"
            + (
                f"\n  at rest; {rest} by the limit of the motion that follows, which can be simulated once it moves"
                if self.at_rest
                else ""
            )
            + self._told_apart()
            + "".join(f"\n  {note}" for note in self.notes)
        )

    def _told_apart(self):
        """The line of a printed state on its branches: the first values in which they differ."""
        if len(self.branches) < 2:
            return ""
        spread = np.ptp(self.branches, axis=0) > DISTINCT * (1.0 + np.abs(self.values))
        shown, branches = np.flatnonzero(spread)[:SHOWN], map(without_rounding, self.branches)
        each = [", ".join(f"{self.names[i]} = {branch[i]:.4g}" for i in shown) for branch in branches]
        return f"\n  {len(each)} branches: {each[0]} (this one); {'; '.join(each[1:])}; a guess chooses"


def without_rounding(values):
    """Values (...), with zeros for those that are rounding beside the largest of them."""
    size = np.abs(values)
    return np.where(size > PRINTED_ZERO * size.max(initial=0.0), values, 0.0)


class JetEquations:
    """Invariants of a model at one time, followed by conditions of the start: values (m,) and Jacobian (m, n_z).

    The jets are the state, and higher ones where a condition contains these. `rows` replace those of the reduction.
    """

    def __init__(self, model, t, conditions, rows=None):
        r, self.t, self.p = model.reduction, t, model.p
        q = r.mechanism.q
        top = max([r.top, *(q.order(e) + 1 for e in conditions.values())])
        if top == r.top and rows is None:
            self.f, names = model.function("invariants"), [name for _, name in invariant_names(model)]
        else:
            extended = Invariants(r.mechanism, rows or r.rows, top, r.points, references=r.references)
            self.f, names = _numeric(extended.invariants()), [name for _, name, _ in extended.invariant_rows]
        self.invariants, self.rows, self.conditions, self.kept = len(names), [*names, *conditions], None, slice(None)
        self.names = jet_names_to(model, q.nq + (top - 1) * q.n)
        if conditions:
            jets, values = ca.vertcat(*(q.jet(k) for k in range(top))), ca.vertcat(*conditions.values())
            outputs = ca.densify(ca.vertcat(values, ca.vec(ca.jacobian(values, jets))))
            parameters = ca.vertcat(*r.mechanism.parameters.symbols)
            self.conditions = _numeric(function_of(q, r.references, "conditions", jets, parameters, outputs))

    def __call__(self, x):
        """Values (m,) and Jacobian (m, n_z) at jets (n_z,)."""
        with np.errstate(all="ignore"):
            parts = [self._split(self.f(self.t, x, self.p), self.invariants, x)]
            if self.conditions is not None:
                values = self.conditions(self.t, x, self.p)
                parts.append(self._split(values, len(values) // (1 + len(x)), x))
        value, jacobian = map(np.concatenate, zip(*parts, strict=True))
        return value[self.kept], jacobian[self.kept]

    @staticmethod
    def _split(y, m, x):
        return y[:m], y[m:].reshape(len(x), m).T

    def without(self, names):
        """The equations, of the same jets, but for some by name."""
        others, left = copy(self), [a for a, row in enumerate(self.rows) if row not in names]
        others.rows, others.kept = [self.rows[a] for a in left], left
        return others

    def scaled(self, x):
        """Residuals relative to the size of their gradients times that of the jets."""
        value, jacobian = self(x)
        with np.errstate(invalid="ignore"):  # a residual without a value has no size
            return value / gradient_sizes(jacobian, x)


def gradient_sizes(jacobian, x):
    """The size of each gradient times that of the jets."""
    return np.maximum(np.sqrt((jacobian**2 * (1.0 + np.abs(x)) ** 2).sum(axis=1)), 1e-300)


def _numeric(f):
    """A CasADi function of columns as one of arrays."""
    return lambda t, x, p: evaluated(f, t, x, p)


@frozen(eq=False)
class Aim:
    """The state nearest to a reference is sought, by sizes and most of all in guessed values; arrays (n_x,)."""

    names: tuple
    reference: np.ndarray
    sizes: np.ndarray
    guessed: np.ndarray
    movable: np.ndarray

    @property
    def weights(self):
        """By which a distance of values from the reference counts."""
        return np.where(self.guessed, GUESSED, 1.0) * self.sizes

    @classmethod
    def of(cls, names, guess, held, identity):
        """The state nearest to guessed values, with held ones; where neither says more, to zero or the identity's."""
        reference = np.array([held.get(name, guess.get(name, identity.get(name, 0.0))) for name in names])
        movable = np.array([name not in held for name in names])
        return cls(names, reference, np.ones(len(names)), movable & np.isin(names, list(guess)), movable)

    def weighed(self, model, t):
        """Distances of coordinates and of velocities by the kinetic energy, and so those of higher derivatives."""
        measured = model.once("frame", lambda: frame(model.reduction.mechanism, model.reduction.references))
        of_q, of_w = roots_of_inertia(measured, t, self.reference[: model.nq], model.p)
        return replace(self, sizes=np.append(of_q, np.resize(of_w, len(self.names) - model.nq)))


@np.errstate(all="ignore")  # trial steps may leave the domain of the equations
def consistent(model, t, held, guess, hold):
    """See `Model.start`."""
    values, conditions = _split_held(model, held, hold)
    n_x, states = len(model.state_names), model.state_names
    guess = {name: _known(model, name, value, states) for name, value in mapping(guess, "The guesses").items()}
    chosen = guess | values
    q, rows = model.reduction.mechanism.q, model.reduction.mechanism.followers | conditions
    equations = JetEquations(model, t, rows)
    aim = Aim.of(equations.names, guess, values, q.identity).weighed(model, t)
    for e in (list(places) for places, _ in q.spheres):
        if not aim.reference[e].any() and {*chosen} & {q.names[i] for i in e}:
            raise SpecificationError(
                f"The values of {', '.join(q.names[i] for i in e)} are zero, a quaternion of length 0.",
                "A quaternion has a direction.",
                f"{next((q.names[i] for i in e if q.names[i] in q.identity), q.names[e[0]])} = 1.",
                do="Guess another value, or leave all of them out.",
            )
    found = _rests(model, equations, aim, values, rows)
    equations, branches = found or _solved(model, equations, aim, rows, dict.fromkeys(conditions, 0.0) | held)
    x = branches[0]
    left = tuple(name for name in free_names(equations, x, aim, chosen) if name in states)
    fixed, residual = tuple(dict.fromkeys((*held, *conditions))), _largest(equations, x)
    notes = tuple(_notes(model, t, chosen, guess, dict(zip(states, x.tolist(), strict=False))))
    return State(t, x[:n_x], states, fixed, left, residual, branches=branches[:, :n_x], notes=notes)


def _notes(model, t, given, guess, state):
    """On the guessed value that a state is farthest from, and on given angles that are round numbers of degrees."""
    away = {abs(state[name] - value): name for name, value in guess.items()}
    name, far = away.get(max(away, default=0.0)), max(away, default=0.0)
    if name is not None and far > DISTINCT * (1.0 + abs(guess[name])):
        shown = without_rounding(np.array([guess[name], state[name]]))[1]
        yield f"the nearest state found is {far:.4g} off the guess: {name} = {shown:.4g}, guessed {guess[name]:.4g}"
    coordinates = {name: value for name, value in given.items() if name in model.reduction.mechanism.q.names}
    turned = {name: value for name, value in coordinates.items() if abs(value) > 2 * np.pi and value % 5 == 0}
    angles = _all_rests(model).angles(t, model.p, np.zeros(model.nq)) if turned else ()
    for name, value in turned.items():
        if angles[model.reduction.mechanism.q.names.index(name)]:
            yield f"{name} = {value:g} is in radians; {value:g} degrees are {np.radians(value):.4g}"


def _all_rests(model):
    return model.once("rests", lambda: Rests.of_model(model))


def _rests(model, equations, aim, held, conditions):
    """The equations, and the rest nearest to the guess before others, where a path begins at rest; else None."""
    t, q, residuals = equations.t, model.reduction.mechanism.q, model.reduction.program.residuals.values()
    rates = held.keys() - set(q.names)
    moves = orders_in(q, residuals) or any(ca.depends_on(e, q.t) for e in residuals)
    if not moves or any(held[name] for name in rates):
        return None
    chosen = zip(q.names, aim.reference, aim.guessed | ~aim.movable, strict=False)
    guess = {name: value for name, value, known in chosen if known}
    found, _ = _all_rests(model).nearest(t, model.p, guess, held.keys() - rates)
    states = [np.concatenate([z[: q.nq], np.zeros(len(aim.names) - q.nq)]) for z in found]
    jets = np.append(states[0][: len(model.state_names)], np.zeros(model.n)) if states else None
    if states and not _largest(equations, states[0]) < TOLERANCE:
        equations = JetEquations(strong_near(model, t, jets), t, conditions)
    states = [x for x in states if _largest(equations, x) < TOLERANCE and _stays(model, t, x)]
    others = [x for x in states[1:] if not _clear_choice(states[0], x, aim, model)]
    return (equations, np.array([states[0], *others])) if states else None


def _stays(model, t, x):
    """Whether a state stays, and residuals to first order, from t on or, as where a path begins with a jump, before.

    Where it is singular, and has no rates, the program holds there if nothing moves.
    """
    if model.flat:
        return True
    rates, n_x, p = model.function("ode").expression, len(model.state_names), model.p
    slow = STILL * (1.0 + np.abs(x[:n_x]))

    def largest(at, rate):
        names, f = model.signals("residuals")[0], model.signals("residuals", rate)[1].expression
        still = np.append(x[:n_x], np.zeros(f.numel_in(1) - n_x))
        values, given = np.abs(evaluated(f, at, still, p)), [level == 0 for _, level in names]
        return values[given if rate else slice(None)].max(initial=0.0)

    def stays(at):
        moving = np.abs(evaluated(rates, at, x[:n_x], p)[:n_x])
        there = np.all(moving <= slow) if np.isfinite(moving).all() else largest(at, 0) <= slow.max()
        return bool(there and largest(at, 1) <= slow.max())

    return any(map(stays, (t, np.nextafter(t, -np.inf))))


def _split_held(model, held, hold):
    """Held states by name, and conditions by name: outputs less their held values, and expressions that are zero."""
    mechanism, names = model.reduction.mechanism, model.state_names
    known, what = (*names, *mechanism.outputs), "state or output" if mechanism.outputs else "state"
    values = {name: _known(model, name, value, known, what) for name, value in held.items()}
    conditions = {name: mechanism.outputs[name] - value for name, value in values.items() if name not in names}
    for name, expression in mapping(hold, "The conditions").items():
        conditions[name] = _condition(name, expression, mechanism, known)
    return {name: value for name, value in values.items() if name in names}, conditions


def _condition(name, expression, mechanism, known):
    """A condition of a start as an SX scalar."""
    scalar = column(expression, f"The condition {name!r}", 1)[0]
    require_known(scalar, mechanism, f"The condition {name!r}")
    if name in known or mechanism.q.order(scalar) < 0:
        said = "has the name of a state or an output" if name in known else "contains no coordinate and no derivative"
        raise SpecificationError(
            f"The condition {name!r} {said}.",
            "A condition is an expression that is zero at the start, under a name of its own.",
            do=f"Write model.start({name}=...)." if name in known else "Write it with the mechanism's symbols.",
            name=name,
        )
    return scalar


def _known(model, name, value, names, what="state"):
    if name not in names:
        raise model.reduction.mechanism.no(what, name, names)
    return finite(name, value)


def _solve(model, equations, aim, conditions):
    """The start by the model's pivots, else by pivots chosen at the reference, else near the best state so far."""
    t, n_x = equations.t, len(model.state_names)
    finite_there = np.all(np.isfinite(equations(aim.reference)[0][: equations.invariants]))
    x, residual = _best(equations, aim) if finite_there else (aim.reference, np.inf)
    blocks = model.reduction.cascade is not None
    if not residual < TOLERANCE and blocks:
        x, residual = _by_blocks(model, t, equations, aim)
    choices = [(aim.reference, strong_form)] * blocks + [(aim.reference, derived_near), (None, derived_near)]
    for at, choose in choices:
        if residual < TOLERANCE:
            break
        if at is None and not finite_there:
            x, residual = _best(equations, aim)
        try:  # a pivot of the model may vanish there
            near = choose(model, t, np.append((x if at is None else at)[:n_x], np.zeros(model.n)))
        except ServoError:
            continue
        if near is None:
            continue
        other = JetEquations(near, t, conditions)
        y, residual_there = _best(other, aim)
        if residual_there < residual or not np.isfinite(residual):
            equations, x, residual = other, y, residual_there
    return equations, x, residual


def _solved(model, equations, aim, conditions, held):
    """The equations, and the state nearest to the guess before others that the guess excludes no better."""
    equations, x, residual = _solve(model, equations, aim, conditions)
    if not residual < TOLERANCE:
        _refuse(equations, aim, held, x)
    x = _by_levels(equations, x, aim, model)
    sought = aim.movable & ~np.isin(aim.names, free_names(equations, x, aim, set(np.array(aim.names)[aim.guessed])))
    return equations, _branches(equations, x, replace(aim, movable=sought), model)


def _by_blocks(model, t, equations, aim):
    """The start that Newton's method reaches from the reference block by block, then on all rows together."""
    r, q, n_x = model.reduction, model.reduction.mechanism.q, len(model.state_names)
    sizes = np.repeat([1.0, *(factorial(k) for k in range(1, r.top))], [q.nq, *[q.n] * (r.top - 1)])
    z = (aim.reference[:n_x] / sizes)[:, None]
    z, _ = r.cascade.continued(replace(r.points, instants=instants_of(model, [t]), z=z, values=model.parameters), r.top)
    x = aim.reference.copy()
    x[:n_x] = np.where(aim.movable[:n_x], z[:n_x, 0].astype(float) * sizes, x[:n_x])
    x = gauss_newton(equations, np.where(np.isfinite(x), x, aim.reference), aim)
    return x, _largest(equations, x)


def _by_levels(equations, x, aim, model):
    """The state near x that is nearest to guessed coordinates, then to each guessed derivative, then to the rest."""
    levels, movable = _orders(model, len(x)), aim.movable
    for some in (*(aim.guessed & (levels == level) for level in range(levels[-1] + 1)), aim.movable & ~aim.guessed):
        movable = movable & ~some
        kept = gauss_newton(equations, np.where(some, aim.reference, x), replace(aim, movable=movable))
        if not _largest(equations, kept) < TOLERANCE:
            reference, sizes = np.where(some, aim.reference, x), np.where(some, GUESSED, 1.0) * aim.sizes
            kept = _nearest(equations, x, Aim(aim.names, reference, sizes, some, movable | some))
        x = kept if _largest(equations, kept) < TOLERANCE else x
    return x


def _orders(model, size):
    """The derivative that each of the first jets is."""
    return np.maximum(0, np.arange(size) - model.nq + model.n) // model.n


def _starts(equations, aim):
    """The reference, the nearest state with all guessed values, then points farther from the reference."""
    yield aim.reference
    if aim.guessed.any():
        yield gauss_newton(equations, aim.reference, replace(aim, movable=aim.movable & ~aim.guessed))
    spread = (1.0 + np.abs(aim.reference)) * aim.movable / np.where(aim.guessed, np.sqrt(GUESSED), 1.0)
    rng = np.random.default_rng(SEED)
    for attempt in range(1, TRIES):
        yield aim.reference + attempt * FARTHER * rng.uniform(-1.0, 1.0, len(spread)) * spread


def _best(equations, aim):
    """The solution nearest to the guess and then to the reference, from two points, from others if it fails."""
    found = []
    for attempt, first in enumerate(_starts(equations, aim)):
        x = _nearest(equations, gauss_newton(equations, first, aim), aim)
        residual, away = _largest(equations, x), np.linalg.norm((aim.sizes * (x - aim.reference))[aim.guessed])
        found.append((0 if residual < TOLERANCE else residual, away, attempt, x))
        if attempt >= aim.guessed.any() and min(found)[0] == 0:
            break
    best = min(found)[-1]
    return best, _largest(equations, best)


def _step(value, jacobian, aim):
    """The least weighted change of the movable values that solves the linearised invariants."""
    full = np.zeros(jacobian.shape[1])
    if not (np.all(np.isfinite(jacobian)) and np.all(np.isfinite(value))):
        return full
    weights = aim.weights[aim.movable]
    a = jacobian[:, aim.movable] / weights
    rows = np.sqrt((a**2).sum(axis=1))
    rows = np.where(rows > 0, rows, 1.0)
    if a.size:
        full[aim.movable] = np.linalg.lstsq(a / rows[:, None], value / rows, rcond=REPEATED)[0] / weights
    return full


@np.errstate(all="ignore")  # what is not finite is no solution
def gauss_newton(equations, x, aim, iterations=200):
    """Damped Gauss-Newton with least steps.

    A step is judged by the gradients at its start: relative to gradients that shrink along it, residuals that fall
    would seem to rise. Where no part of a step helps, as before a kink, a few whole steps are tried.
    """
    left = []
    for _ in range(iterations):
        value, jacobian = equations(x)
        size = gradient_sizes(jacobian, x)
        norm = np.abs(value / size).max(initial=0.0)
        if norm < REACHED:
            break
        step = _step(-value, jacobian, aim)
        longest = 1.0 / max(1.0, np.max(np.abs(step) / (1.0 + np.abs(x)), initial=0.0))
        trials = (x + longest / 3**k * step for k in range(THIRDS))
        better = (y for y in trials if np.abs(equations(y)[0] / size).max(initial=0.0) < norm)
        trial = next(better, None)
        if trial is None:
            left.append(x)
            if len(left) > LEAPS:
                break
            trial = x + longest * step
        x = trial
    return min([x, *left], key=lambda y: _largest(equations, y)) if left else x


def _largest(equations, x):
    """The largest scaled residual; inf where one has no value."""
    return float(np.nan_to_num(np.abs(equations.scaled(x)), nan=np.inf).max(initial=0.0))


def _nearest(equations, x, aim, iterations=200):
    """The solution nearest the reference, by successive projection; a state without values where that is singular.

    Where a whole step leads no nearer, as where the solutions are bent more than the reference is far, a part does.
    """
    part, last = 1.0, np.inf
    for _ in range(iterations):
        value, jacobian = equations(x)
        with np.errstate(all="ignore"):
            step = aim.reference + _step(-value - jacobian @ (aim.reference - x), jacobian, aim) - x
        trial = gauss_newton(equations, x + part * step, aim, 12)
        distance, before, change = (
            np.linalg.norm(aim.weights * way) for way in (trial - aim.reference, x - aim.reference, trial - x)
        )
        off = np.abs(equations.scaled(trial)).max(initial=0.0)
        slack = TOLERANCE if np.isfinite(off) else -REPEATED  # what has no values must be nearer
        nearer = distance < before * (1 - TOLERANCE) or change < last  # where rounding hides which is nearer
        if off > TOLERANCE or not (nearer and distance <= before * (1 + slack)):
            part /= 3
            if part < 3.0**-THIRDS:
                break
            continue
        x, last = trial, change
        if change <= REPEATED * before:
            break
    return x


def free_names(equations, x, aim, guess):
    """Names that the equations leave free: guessed ones if possible, then low derivatives."""
    _, jacobian = equations(x)
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


def _branches(equations, x, aim, model):
    """A state and others with the same held and free values that guess and reference do not exclude, (b, n_z).

    Newton's method starts at the mirror image of the values that are sought, and at a few random points.
    """
    found, rng = [x], np.random.default_rng(SEED)
    for attempt in range(SEARCHED if aim.movable.any() else 0):
        signs, far = rng.choice([-1.0, 1.0], len(x)), rng.uniform(-FAR, FAR, len(x)) * (1.0 + np.abs(x))
        first = np.where(aim.movable, x * signs + far if attempt else -x, x)
        y = gauss_newton(equations, first, aim, SEARCH_STEPS)
        residual = _largest(equations, y)
        same = residual < TOLERANCE and any(_same_motion(y, z, model) for z in found)
        if residual < TOLERANCE and not same and not _clear_choice(x, y, aim, model):
            found.append(y)
    away = [np.linalg.norm((aim.sizes * (y - aim.reference))[aim.guessed]) for y in found]
    return np.array([found[i] for i in np.argsort(np.round(away, 9), kind="stable")])


def _clear_choice(x, y, aim, model):
    """Whether the guess is much nearer the first of two states, or, without one, the reference is.

    Of the reference the lowest derivatives in which they differ count.
    """
    differ = np.abs(y - x) > DISTINCT * (1.0 + np.abs(x))
    levels = _orders(model, len(x))
    guessed = differ & aim.guessed
    lowest = guessed if guessed.any() else differ & (levels == levels[differ].min())
    between, way = (aim.sizes * (y - x))[lowest], (aim.sizes * (aim.reference - x))[lowest]
    return bool(way @ between < NEARER * (between @ between))


def _same_motion(x, y, model):
    """Whether states differ by whole turns of coordinates only, or by the signs of quaternions."""
    nq, small, x = model.nq, DISTINCT * (1.0 + np.abs(y)), x.copy()
    for e in (list(places) for places, _ in model.reduction.mechanism.q.spheres):
        x[e] = np.copysign(1.0, x[e] @ y[e]) * x[e]
    x[:nq] -= 2 * np.pi * np.round((x - y)[:nq] / (2 * np.pi))
    return bool(np.all(np.abs(x - y) <= small))


def _refuse(equations, aim, held, x):
    """Raise InconsistentStart: a held value contradicts an equation, or no state satisfies one."""
    residuals = np.abs(equations.scaled(x))
    alone = equations.without([name for name in held if name not in aim.names])
    all_movable = replace(aim, movable=np.ones(len(aim.names), dtype=bool))
    if held and _loosened(alone, all_movable, x)[1] < TOLERANCE:
        loosened = _loosened_values(equations, aim, held, x) or {next(iter(held)): None}
        (change, nearest), *others = loosened.items()
        largest, worst = max(zip(residuals, equations.rows, strict=True))
        what = [f"{name} = {held[name]:g}" for name, _ in others]
        what += [f"the invariant {worst!r} (residual {largest:.2e})"] if worst in alone.rows else []
        held_too = f" with {', '.join(name for name in held if name != change)} held" * (len(held) > 1)
        what = " and ".join(what) or f"the constraints{held_too}"
        raise InconsistentStart(
            f"{change} = {held[change]:g} contradicts {what}.",
            "Held values satisfy every constraint and its time derivatives.",
            nearest="" if nearest is None else f"{change} = {nearest:.9g}.",
            do=f"Hold fewer values{', or pass this one in guess={...}' if change in aim.names else ''}.",
            held=change,
            value=float(held[change]),
            invariant=worst,
            residual=float(largest),
            nearest_value=nearest,
        )
    raise _not_found(equations, x, residuals)


def _loosened(equations, aim, x):
    """As `_best`; where the nearest state is singular, the one that Newton's method reaches from x."""
    y, residual = _best(equations, aim)
    y = y if residual < TOLERANCE else gauss_newton(equations, x, aim)
    return y, _largest(equations, y)


def _loosened_values(equations, aim, held, x):
    """Held values, each as it agrees with the others when it alone changes, the least change first."""
    found = {}
    for name, value in held.items():
        loose = replace(aim, movable=aim.movable | np.isin(aim.names, name))
        y, residual = _loosened(equations.without([name]), loose, x)
        if residual < TOLERANCE:
            is_state = name in aim.names
            other = y[aim.names.index(name)] if is_state else value + equations(y)[0][equations.rows.index(name)]
            found[name] = float(other) if abs(other) > TOLERANCE * abs(value) else 0.0
    return dict(sorted(found.items(), key=lambda item: abs(item[1] - held[item[0]]) / (1.0 + abs(held[item[0]]))))


def _not_found(equations, x, residuals):
    """The error of a search that ended at jets (n_z,) with residuals (m,)."""
    worst = int(np.argmax(np.nan_to_num(residuals, nan=np.inf)))
    value, jacobian = (each[worst] for each in equations(x))
    name, lacks = equations.rows[worst], "" if np.isfinite(value) else "value"
    lacks = lacks or ("" if np.isfinite(jacobian).all() and jacobian.any() else "gradient")
    end = (
        f"where the invariant {name!r} has no {lacks}"
        if lacks
        else f"with the residual {residuals[worst]:.2e} of the invariant {name!r}"
    )
    far = not lacks and residuals[worst] > OUT_OF_REACH  # of what coordinates of usual size change it by
    unit = "Check that lengths have the same unit (m, not mm), pass" if far else "Pass"
    return InconsistentStart(
        f"The search for a consistent start ended {end}.",
        "A start satisfies every constraint and its time derivatives.",
        do=f"{unit} a guess={{...}} nearer to the motion, or check that the program can hold at this time.",
        invariant=name,
        residual=float(np.inf if lacks else residuals[worst]),
    )
