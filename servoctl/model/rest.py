"""Starts where a program is singular: machines that stand still, and hidden constraints that divide by zero.

A rolling machine at rest satisfies its constraints with any heading. Where the motion that follows has a limit as it
begins, its start is that limit.
"""

from contextlib import suppress

import casadi as ca
import numpy as np

from servoctl.checks import mapping
from servoctl.codegen.paths import evaluated
from servoctl.errors import InconsistentStart, ServoError, SingularProgram
from servoctl.jets.branches import shown
from servoctl.model.equations import gradient_jets, invariant_names
from servoctl.model.following import corners_of, instants_of
from servoctl.model.start import SPANNED, TOLERANCE, Aim, JetEquations, State, consistent, free_names, gauss_newton
from servoctl.model.variants import derived_near
from servoctl.progress import stage
from servoctl.reduction.ranks import equilibrate
from servoctl.spec.references import function_of
from servoctl.tolerances import RESOLVED
from servoctl.values import frozen

STANDS = 1e-9  # velocities below this, relative to the coordinates' size, are rest
MOVES = 1e-5  # velocities above this, likewise, leave six digits of directions that depend on their squares
LATER = tuple(1e-3 * 2.0**k for k in range(9))  # of the time to the next knot, where the motion may have begun
FAINT = 1e-6  # of their usual size: divisors above this leave four digits of what depends on their squares
NEAR_LIMIT = 1e-2  # rad or m: distance of the first value from the limit up to which extrapolation is trusted
AFTERWARDS = 1e-4  # s, from the end of a motion to a standstill at which it ends, at most
SECANTS = 4  # steps towards that instant
EQUAL = 1e-9  # difference of values at two instants that is rounding, at velocities of MOVES


@frozen
class Standstill:
    """What is open while a machine stands still."""

    coordinates: tuple  # names of those that the constraints determine in motion only
    rows: tuple  # names of these constraints
    rates: tuple = ()  # velocities in them that they do not determine: with one the machine may start in motion

    def error(self, t, nearest=None, values=None, **facts):
        """The error of a program that is singular because its machine stands still at t [s].

        `nearest` is an instant at which it moves [s], `values` (dict) are states from which a guess there may come.
        """
        rows, names = (", ".join(parts) for parts in (map(repr, self.rows), self.coordinates))
        leave = "leaves" if len(self.rows) == 1 else "leave"
        guess = {name: round(float(values[name]), 4) for name in self.coordinates if name in (values or {})}
        begin = f"model.start(t={nearest}{f', guess={guess}' if guess else ''})"
        return SingularProgram(
            f"At t = {t:.7g} s the machine stands still: {rows} {leave} {names} open there.",
            "Constraints that are linear in velocities determine directions in motion only, so that no motion can be "
            "computed through a standstill.",
            nearest="" if nearest is None else f"t = {nearest:g} s, where it moves.",
            do=f"Simulate from {begin} on, and end before the next standstill; or give the path a speed there."
            if nearest is not None
            else f"Start in motion, as by model.start({self.rates[0]}=1.0), or program a speed."
            if self.rates
            else "End the motion before this instant, or give the path a speed there.",
            t=float(t),
            coordinates=self.coordinates,
            nearest_time=nearest,
            rates=self.rates,
            **facts | {"rows": list(self.rows)},
        )


@stage("solving for the start")
def started(model, t, held, guess, hold):
    """See `Model.start`: a consistent state, at a standstill the limit of the motion that follows."""
    state = failure = None
    chosen = mapping(guess, "The guesses") | {name: v for name, v in held.items() if name in model.state_names}
    try:
        state = consistent(model, t, held, guess, hold)
        if _determined(model, t, state.values):
            if _faint(model, t, state.values):
                raise _division(model, t, state.values, chosen, FAINT)
            return state
    except InconsistentStart as error:
        if held and _determined(model, t, _at_rest(model, t, chosen)[-1]):
            raise
        failure = error
    still = standstill(model, t, chosen)
    open_ = set(still.coordinates if still else ()) - set(held)
    if open_ and not hold and (state is None or open_ & set(state.free)):
        try:
            return _limit(model, t, held, chosen, still)
        except SingularProgram:  # without a limit a guess chooses
            if state is None or not set(still.coordinates) <= set(chosen):
                raise
    if state is None:
        if still is not None:
            raise still.error(t, first_motion(model, t, chosen, still), chosen) from failure
        raise division_by_zero(model, t, chosen) or failure
    return state


def division_by_zero(model, t, chosen):
    """The error of hidden constraints that divide by zero where the program holds at t [s]; None if none does.

    That is the state nearest the chosen values (dict) that satisfies the constraints as they were written.
    """
    _, equations, _, x = _at_rest(model, t, chosen)
    if not np.abs(equations.scaled(x)).max(initial=0.0) < TOLERANCE:
        return None
    return _division(model, t, x, chosen, RESOLVED)


def _division(model, t, x, chosen, least):
    """The error of hidden constraints at t [s], X = x whose divisor is at most `least` of its usual size; else None."""
    divisors, parts = _divisors(model, model, t, x)
    small = np.flatnonzero(~(parts > least))
    if not len(small):
        return None
    (row, pivot), part, r = divisors[small[0]], parts[small[0]], model.reduction
    later = _first_start(model, t, chosen)
    size = "zero" if part <= RESOLVED else f"{part:.1g} of its usual size"
    raised = [name for name, k in row.uses.items() if k and name in r.original]
    return SingularProgram(
        f"At t = {t:.7g} s the hidden constraint {row.name!r} ({row.derivation}) divides by {shown(pivot)}, "
        f"which is {size} "
        "where the program holds there.",
        "A hidden constraint combines derivatives of residuals, and says nothing where its divisor vanishes.",
        nearest="" if later is None else f"t = {later:g} s, where it is larger.",
        do=f"Start {'where it is larger' if later is None else 'then or later'}, or program "
        f"{', '.join(f'q.dt({name}, 1)' for name in raised)} instead and start where the residual is zero.",
        t=float(t),
        rows=[row.name],
        divisor=shown(pivot),
        size=float(part),
        residuals=raised,
        nearest_time=later,
    )


def _divisors(model, variant, t, x):
    """The (row, divisor) of a variant's hidden constraints; sizes of these at t [s], X = x relative to usual ones."""
    hidden, usual = (
        {f"combination of {row.derivation}": row for row in variant.reduction.hidden},
        model.reduction.points,
    )
    divisors = [(hidden[name], pivot) for name, pivot in variant.reduction.pivots if name in hidden]
    if not divisors:
        return [], np.zeros(0)
    jets = np.append(x[: len(model.state_names)], np.zeros(model.n))[:, None]
    there = usual.at(instants_of(model, [t]), jets, model.parameters)
    sizes = (np.abs(points.evaluate([pivot for _, pivot in divisors])[0]).max(axis=1) for points in (there, usual))
    with np.errstate(all="ignore"):
        return divisors, np.divide(*sizes)


def _faint(model, t, x):
    """Whether hidden constraints divide by next to nothing at t [s], X = x, whichever pivots they are combined with."""
    if (_divisors(model, model, t, x)[1] > FAINT).all():
        return False
    with suppress(ServoError):
        near = derived_near(model, t, np.append(x, np.zeros(model.n)))
        return not (_divisors(model, near, t, x)[1] > FAINT).all()
    return True


def _first_start(model, t, chosen):
    """A time [s] shortly after t at which the model has a start near the chosen values; None if none."""
    for later in _later(model, t):
        with suppress(InconsistentStart):
            if not _faint(model, later, consistent(model, later, {}, chosen, None).values):
                return later
    return None


def _later(model, t):
    """Instants [s] after t, farther and farther, up to a quarter of the time to the next knot."""
    length = min((knot - t for knot in corners_of(model) if knot > t), default=1.0)
    return [t + tau * length for tau in LATER]


def _determined(model, t, x):
    """Whether the invariants leave as many values free at a state as elsewhere."""
    jacobian = JetEquations(model, t, {})(x)[1]
    if not np.all(np.isfinite(jacobian)):
        return False
    sizes = np.linalg.svd(equilibrate(jacobian)[0].astype(float), compute_uv=False)
    return np.sum(sizes > SPANNED) >= len(invariant_names(model))


def _written(model):
    """The constraints as they were written."""
    return tuple(row for row in model.reduction.original.values() if row.order <= model.reduction.top)


def _at_rest(model, t, chosen):
    """The constraints as they were written, and the state nearest the chosen values that satisfies them."""
    rows = _written(model)
    equations = JetEquations(model, t, {}, rows)
    known = {name: v for name, v in chosen.items() if name in equations.names}
    aim = Aim.of(equations.names, known, {}, model.reduction.mechanism.q.identity)
    return rows, equations, aim, gauss_newton(equations, aim.reference, aim)


def standstill(model, t, chosen):
    """What is open at t [s] while the machine stands still, about the chosen values; None if it moves."""
    rows, equations, aim, x = _at_rest(model, t, chosen)
    q = model.reduction.mechanism.q
    if not np.abs(equations.scaled(x)).max(initial=0.0) < TOLERANCE or not np.isfinite(equations(x)[1]).all():
        return None
    slow = STANDS * (1.0 + np.abs(x[: q.nq]).max())
    x[q.nq :][np.abs(x[q.nq :]) <= slow] = 0.0  # by rounding they would determine directions
    directions = {row.name: gradient_jets(model.reduction, row.name) for row in rows if row.order > 0}
    directions = {row: [name for name in names if name in q.names] for row, names in directions.items()}
    free = free_names(equations, x, aim, {name for names in directions.values() for name in names})
    open_ = {row: [name for name in names if name in free] for row, names in directions.items()}
    coordinates = tuple(dict.fromkeys(name for names in open_.values() for name in names))
    moving = np.abs(_rates_of(model, t, x, rows)[[name not in coordinates for name in q.names]]).max(initial=0.0)
    if not coordinates or moving > slow:
        return None
    turning = {rate for name, rate in zip(q.names, q.jet_names(1), strict=False) if q.plain and name in coordinates}
    bound = zip(q.jet_names(1), _bound(q, rows), strict=True)
    rates = tuple(name for name, inside in bound if inside and name in free and name not in turning)
    return Standstill(coordinates, tuple(row for row, names in open_.items() if names), rates)


def _bound(q, rows):
    """Which velocities are in rows (n,): others, such as that of a pendulum on the machine, move apart from it."""
    places = [*filter(None, map(q.where, ca.symvar(ca.vertcat(*(row.expression for row in rows)))))]
    return np.isin(np.arange(q.n), [i for kind, _, i in places if kind == "w" or kind == "q" and q.plain])


def _rates_near(model, t, chosen):
    """What `_rates_of` returns of the state nearest the chosen values."""
    rows, _, _, x = _at_rest(model, t, chosen)
    return _rates_of(model, t, x, rows)


def _rates_of(model, t, x, rows):
    """q' at a state; where velocities are q', those in rows alone, and others zero."""
    q = model.reduction.mechanism.q
    return _state_rates(model, t, x) * (_bound(q, rows) if q.plain else 1.0)


def standstill_near(model, t, chosen):
    """The instant beside t [s] at which the machine stands still, and what is open there; None if there is none.

    By the secant method: a motion stops at the last instant at which its pivots have digits.
    """
    for _ in range(SECANTS):
        still = standstill(model, t, chosen)
        if still is not None:
            return t, still
        before, after = (_rates_near(model, at, chosen) for at in (t, t + AFTERWARDS))
        change = after - before
        if not np.any(change):
            return None
        step = -AFTERWARDS * (before @ change) / (change @ change)
        if not abs(step) < AFTERWARDS:
            return None
        t += step
    return None


def _limit(model, t, held, chosen, still):
    """The start that the motion after t has as its limit; raises SingularProgram if there is no motion, or no limit."""
    moving = first_motion(model, t, chosen, still)
    if moving is None:
        raise still.error(t)
    states, guess, later = [], chosen, moving - t
    try:
        for tau in (later, 2 * later, 4 * later):
            states.append(consistent(model, t + tau, {}, guess, None))
            guess = {name: states[-1][name] for name in states[-1].names}
    except InconsistentStart:
        raise still.error(t, moving) from None
    limit = dict(zip(states[0].names[: model.nq], states[0].values, strict=False))
    for name in still.coordinates:
        limit[name], error = _extrapolated(*(state[name] for state in states))
        if not error <= NEAR_LIMIT:
            raise still.error(t, moving, dict(zip(states[0].names, states[0].values, strict=True)))
    _, equations, aim, _ = _at_rest(model, t, {**chosen, **limit})
    x = gauss_newton(equations, aim.reference, aim)
    residual = np.abs(equations.scaled(x)).max(initial=0.0)
    return State(t, x, states[0].names, tuple(held), (), float(residual), at_rest=still.coordinates)


def _extrapolated(first, second, third):
    """The limit at 0 of a value at τ, 2τ and 4τ, exact for c + a τ^m (Aitken), and its distance from the first."""
    near, far = second - first, third - second
    if abs(near) <= EQUAL:
        return first, abs(near)
    if not abs(far) > abs(near):
        return first, np.inf
    limit = first - near**2 / (far - near)
    return limit, abs(limit - first)


def first_motion(model, t, chosen, still):
    """A time [s] shortly after t at which the constraints determine a machine that stands still at t; None if none."""
    return next((later for later in _later(model, t) if _moves(model, later, chosen, still)), None)


def _moves(model, t, guess, still):
    """Whether a machine has a start at t [s] at which it is fast enough for its constraints to determine it.

    Rates of what is open at rest are no measure: just after it they are rounding errors.
    """
    try:
        state = consistent(model, t, {}, guess, None)
    except InconsistentStart:
        return False
    q = model.reduction.mechanism.q
    measured = [name not in still.coordinates for name in q.names]
    t, x = state.t, state.values
    speed = np.abs(_rates_of(model, t, x, _written(model))[measured]).max(initial=0.0)
    return bool(speed > MOVES * (1.0 + np.abs(x[: q.nq]).max())) and _determined(model, t, x)


def _state_rates(model, t, x):
    """q' (nq,) at a state, also where velocities are others."""
    r, q = model.reduction, model.reduction.mechanism.q
    of, p = ca.vertcat(q.jet(0), q.jet(1)), ca.vertcat(*r.mechanism.parameters.symbols)
    rates = model.once("rates", lambda: function_of(q, r.references, "rates", of, p, ca.vertcat(*q.d(1))))
    return evaluated(rates, t, x[: q.nq + q.n], model.p)
