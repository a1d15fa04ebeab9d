"""From a mechanism and a program to the rows that determine the motion and its actuation."""

from dataclasses import replace
from functools import cached_property

import casadi as ca
import numpy as np

from servoctl.checks import by_name, distinct, finite, mapping, named, require_kind
from servoctl.errors import NotRealisable, ServoError, SpecificationError
from servoctl.reduction.appell import Realisation, require_inertia, saddle
from servoctl.reduction.cascade import Cascade
from servoctl.reduction.hidden import complete
from servoctl.reduction.manifold import (
    Context,
    Points,
    follows,
    is_ordinary,
    sample,
    sizes_of_references,
)
from servoctl.reduction.ranks import Rank, clean, decide_all, eliminate, orthogonal
from servoctl.reduction.realisation import desired_actuation, desired_balance, realisation
from servoctl.reduction.rows import Balance, as_rows, balances, merge_uses, omitted, settle_rows
from servoctl.reduction.scales import usual
from servoctl.reduction.triangular import completed
from servoctl.spec.mechanism import Mechanism, require_known
from servoctl.spec.packing import Packed
from servoctl.spec.program import Program
from servoctl.spec.references import orders_in
from servoctl.tolerances import TINY
from servoctl.values import frozen

NEARBY = 0.01  # s about an instant for which pivots are chosen; at that instant itself entries may vanish by accident
NEAR_SPREAD = 1e-3  # relative width of the points about a state for which pivots are chosen
WINDOW = (0.1, 1.1)  # s, where points are drawn; t = 0 is too often a special instant of formulas of time
WEAKER = 1e-6  # relative to its size before: a pivot below this with other parameters is chosen again


@frozen
class Reduction(Packed):
    """The rows ψ_a = 0 of a motion, with its hidden constraints, and who realises the program."""

    mechanism: Mechanism
    program: Program
    rows: tuple  # n rows, program rows first, then material ones, then those of (3.18)
    realisation: Realisation
    rank: Rank  # of the leading matrix of the rows, with its margins
    points: Points  # seeded points on the manifold of the rows and their derivatives
    pivots: tuple  # (str, SX): pivots by which the rows divide, each with a description
    context: Context
    original: dict  # rows of the designer's residuals and material constraints, by name
    cascade: Cascade | None = None  # the rows by blocks, where they are deep
    orthogonal: bool = False  # whether systems are solved by orthogonal rows, without a choice of pivots

    def __repr__(self):
        rows = ", ".join(f"{row.name} {row.order}" for row in self.rows)
        return f"Reduction(rows and orders: {rows}; {self.free} free initial values)"

    @cached_property
    def top(self):
        """The common order s̄ of the differentiated rows: at least 2, and above the order of rows not affine in it."""
        return max([2, *(row.order + (not row.affine) for row in self.rows)])

    @cached_property
    def free(self):
        """The number of free initial values: Σ o_a, and coordinates beyond quasi-velocities and their invariants."""
        q = self.mechanism.q
        return sum(row.order for row in self.rows) + q.nq - q.n - len(q.invariants)

    @property
    def needs(self):
        """The highest derivative of each residual that the actuation contains."""
        return {name: count for name, count in needs(self.rows).items() if name in self.program.residuals}

    @cached_property
    def references(self):
        """Names of the references in the program and the mechanism."""
        return references(self.mechanism, self.program)

    @cached_property
    def follows(self):
        """The highest derivative of each reference in the actuation, by name: below zero for one that may jump itself.

        That of a force which is not differentiated may jump.
        """
        times = {}
        for row in self.rows:
            for source, count in row.uses.items():
                times[source] = max(times.get(source, -row.order), count + 2 - row.order)
        forces = times.pop(Balance(), 0)
        sources = {**self.program.residuals, **self.mechanism.constraints, Balance(): self.balance}
        times[Balance()] = forces if forces > 0 else -1
        highest = dict.fromkeys(self.references, -1)
        for source, expression in sources.items():
            for name, order in orders_in(self.mechanism.q, [expression]).items():
                highest[name] = max(highest[name], order + times.get(source, 0))
        return highest

    @property
    def hidden(self):
        """The rows that are hidden constraints."""
        return tuple(row for row in self.rows if row.derivation)

    @property
    def raised(self):
        """How often each row is differentiated to the common order s̄, {row name: ρ}: the number of its poles."""
        return {row.name: self.top - row.order for row in self.rows}

    @property
    def ideal(self):
        """Whether an ideal reaction realises the program, instead of the actuators."""
        return self.program.by == "ideal"

    @property
    def left_out(self):
        """Names of the mechanism's coordinates that play no part in the program."""
        return self.mechanism.left_out.get("coordinate", ())

    @property
    def rests(self):
        """Whether the order of a row rests on slopes that may be active elsewhere."""
        return any(row.rests for row in (*self.original.values(), *self.rows, *self.realisation.settled))

    @cached_property
    def leading(self):
        """The leading matrix L, (n, n) SX."""
        return ca.vertcat(*(row.gradient(self.mechanism.q) for row in self.rows))

    def solve(self, right):
        """L⁻¹ right, and the pivots of L."""
        return self.solved(self.leading, right)

    def solved(self, matrix, right, order=()):
        """The solution of a system of the motion, and its pivots, in an order if one is given and they are chosen."""
        numbers = clean(*self.points.matrix(matrix))
        if self.orthogonal:
            return orthogonal(matrix, right, numbers)
        return eliminate(matrix, right, numbers, order=order)

    @cached_property
    def full(self):
        """What must vanish along a motion, by name: the rows as they are written, and the balance with the reaction."""
        m, left = self.mechanism, self.balance - self.realisation.B @ self.multipliers
        rows = {name: m.q.on_spheres(e) for name, e in {**self.program.residuals, **m.constraints}.items()}
        return rows | {f"balance of {name}": e for name, e in zip(m.q.force_names, left.elements(), strict=True)}

    @property
    def omitted(self):
        """What the rows of the designer leave out of the full equations, where it may be active elsewhere, by name."""
        return omitted(self.full, self.original.values())

    @cached_property
    def balance(self):
        """The balance under the desired actuation, (n,) SX."""
        return desired_balance(self.mechanism, self.program)

    @cached_property
    def multipliers(self):
        """Multipliers of the reaction, those of the program first, (b,) SX of t, q, γ', γ''."""
        return self.realisation.multipliers(self.balance)

    @cached_property
    def actuation(self):
        """Required actuation u (m,) SX, or for an ideal program the reaction of the program, (n,) SX."""
        k = len(self.program.residuals)
        multipliers = self.multipliers[:k] if k else ca.SX(0, 1)
        if self.program.by == "actuators":
            return ca.cse(desired_actuation(self.mechanism, self.program) + self.realisation.actuation @ multipliers)
        return ca.cse(self.realisation.B[:, :k] @ multipliers)


def needs(rows):
    """The highest derivative of each residual and of the balance that γ'', and so the actuation, contains."""
    return merge_uses(*((row.uses, max(0, 2 - row.order)) for row in rows))


@np.errstate(all="ignore")  # trial values may leave the domain of the rows: what is not finite is no point
def reduce(mechanism, program, guess=None, near=None, values=None):
    """Derive the rows of a motion: eq. (3.18), hidden constraints, ranks on the manifold.

    Points of the manifold are searched about `guess`, values of coordinates or derivatives by name. Where these are not
    ordinary numbers, or points of ordinary size lead to no reduction, points have the usual sizes of jets. `near`
    (t [s], jets, sizes) is an instant at which pivots are chosen, with dicts of jets and of their sizes along the
    motion; beside a guess, points then have the usual sizes. Ranks are decided at the parameters `values` (n_p,), by
    default those of the mechanism. For errors see `hidden.complete` and `realisation.realisation`.
    """
    program = require_parts(mechanism, program, guess)
    balance = desired_balance(mechanism, program)
    values = mechanism.parameters.values() if values is None else np.asarray(values, dtype=float)
    plain, errors = guess is None if near else all(map(is_ordinary, filter(None, (guess or {}).values()))), {}
    for scaled in (not plain,) if near else (not plain, plain):  # a guess far from the origin tells no size
        scales = None
        if scaled:
            sizes = sizes_of_references(mechanism.q, mechanism.parameters.symbols, values)
            scales = usual(mechanism, program, guess or {}, values, _window, sizes)
        if errors and scaled and scales.ordinary:
            break
        try:
            return _reduced(mechanism, program, balance, _context(mechanism, guess, near, values, scales))
        except ServoError as error:
            errors[scaled] = error
    raise errors.get(True, errors.get(False))


def _reduced(mechanism, program, balance, context):
    """The reduction by points of a context."""
    q = mechanism.q
    original = [
        *as_rows(q, program.residuals, "program", context),
        *as_rows(q, mechanism.constraints, "material", context),
    ]
    constraints, points, of_constraints = _constraints(mechanism, program, original, context)
    realised, points, of_sharing = realisation(mechanism, program, constraints, points, context)
    dynamics, of_split = realised.dynamics(balance)
    dynamics = [row for row, _ in settle_rows(q, balances(q, dynamics), context)]
    _require_motion(dynamics, program)
    rows = [*(realised.settled or constraints), *dynamics]
    solve = complete if realised.settled else completed
    inertial = replace(context, saddle=saddle(mechanism, [row for row in constraints if row.kind == "material"]))
    rows, rank, points, of_rows, *cascade = solve(q, rows, inertial, points)
    of_split = [(f"choice of dependent coordinates {i}", pivot) for i, pivot in enumerate(of_split, 1)]
    pivots = (*of_constraints, *of_sharing, *of_split, *of_rows)
    by_name = {row.name: row for row in original}
    return Reduction(mechanism, program, tuple(rows), realised, rank, points, pivots, context, by_name, *cascade)


def references(mechanism, program, further=()):
    """Names of the references in the expressions of a specification, and in further ones."""
    if not len(mechanism.q.family):
        return ()
    m, chosen = mechanism, (*program.weights.values(), *program.toward.values())
    of_program = (*program.with_turns.values(), *(e for e in chosen if isinstance(e, ca.SX)))
    named_rows = (*m.constraints.values(), *m.followers.values(), *m.outputs.values(), *m.reported.values())
    return tuple(orders_in(m.q, [*of_program, *named_rows, m.balance, m.energy, m.E, m.q.V, m.q.h, *further]))


def strong(pivots, before):
    """Whether pivots are not far weaker with other parameters, from their values with either."""
    return np.abs(pivots) >= WEAKER * np.abs(before)


def require_parts(mechanism, program, guess):
    """The program by the mechanism's names; refuse what is none, unknown symbols, equal names, and unknown guesses."""
    require_kind(Mechanism, "mechanism", mechanism, "sv.Mechanism(q, gibbs, ...)")
    require_kind(Program, "program", program, "sv.Program({...})")
    q, guess = mechanism.q, mapping(guess, "The guesses")
    for name, expression in program.residuals.items():
        require_known(expression, mechanism, f"the residual {name!r}")
    chosen = {"weight": program.weights, "wish": program.toward}
    for what, values in (chosen | {"integral": program.integrals}).items():
        for name, expression in values.items():
            require_known(ca.SX(expression), mechanism, f"the {what} of {name!r}")
    twice = [name for name in program.residuals if name in mechanism.constraints]
    if twice:
        raise SpecificationError(
            f"A residual and a material constraint are both named {twice[0]!r}.",
            "Names of rows differ.",
            do="Rename one of them.",
            name=twice[0],
        )
    for name in set(references(mechanism, program)) & {*mechanism.parameters.names}:
        raise SpecificationError(
            f"A reference and a parameter are both named {name!r}.",
            "A reference has a path, a parameter a number.",
            do="Rename one of them.",
            name=name,
        )
    known = [*q.names, *(name for k in range(1, 8) for name in q.jet_names(k))]
    for name, value in guess.items():
        named(name, known, "coordinate or derivative")
        finite(name, value)
    distinct("residual", (*program.residuals, *mechanism.constraints), mechanism.signals)  # refuses ambiguous names
    if program.stated:
        from servoctl.spec.integrals import require_integrals

        require_integrals(q, program)
    full = [by_name(values, mechanism.actuators, "actuator", f"The {what}s") for what, values in chosen.items()]
    return program.again(program.with_turns, *full) if full != [*chosen.values()] else program


def _constraints(mechanism, program, original, context):
    """Program and material rows, points on their manifold, and the pivots of hidden constraints among them.

    Material rows have full rank; with an ideal program all rows together have.
    """
    q = mechanism.q
    program_rows = [row for row in original if row.kind == "program"]
    material, _, points, pivots = complete(q, [row for row in original if row.kind == "material"], context)
    require_inertia(mechanism, material, points)
    constraints = [*program_rows, *material]
    if program.by == "ideal":
        constraints, _, points, pivots = complete(q, constraints, context)
        return constraints, points, pivots
    common = sample(q, constraints, max([2, *(row.order for row in constraints)]), context)
    points = common if len(common.t) else points
    G = ca.vertcat(*(row.gradient(q) for row in constraints))
    if decide_all(*points.matrix(G))[0].rank < len(constraints):
        # Hidden constraints among these rows follow with those of (3.18); here they only show contradictions.
        complete(q, constraints, context, points)
    return constraints, points, pivots


def _require_motion(dynamics, program):
    """Refuse a program on whose virtual displacements a row of (3.18) vanishes."""
    for row in dynamics:
        if row.order < 0:
            raise NotRealisable(
                f"The {row.name} vanishes identically on the displacements that {', '.join(program.residuals)} allow.",
                "Together with the program, eq. (3.18) must determine the motion.",
                do="Choose another program; this one leaves the motion undetermined.",
                rows=[row.name, *program.residuals],
            )


def require_outputs(reduction):
    """Refuse an output of higher order than the jets of a motion, for what computes outputs from these alone."""
    q, top = reduction.mechanism.q, reduction.top
    for name, expression in reduction.mechanism.outputs.items():
        if q.order(expression) > top:
            raise SpecificationError(
                f"The output {name!r} has order {q.order(expression)}.",
                f"Motions of this program have jets up to order {top}.",
                do=f"Leave it out of the mechanism's outputs; run[{name!r}] has it along a run.",
                name=name,
                order=q.order(expression),
                limit=top,
            )


def _context(mechanism, guess, near, values, scales=None):
    symbols, unit = mechanism.parameters.symbols, 1.0 if scales is None else scales.time
    if near is None:
        return Context(symbols, values, _window(unit), guess or {}, scales=scales)
    t, guess, sizes = near
    width = NEARBY * min(unit, _time_scale(mechanism.q, guess, scales))
    followed = follows(mechanism.q, guess)
    return Context(symbols, values, (t - width, t + width), guess, NEAR_SPREAD, sizes, scales, followed)


def _window(scale):
    """The window (t0, t1) [s] in which points are drawn, from a time scale [s]."""
    return WINDOW[0] * scale, WINDOW[1] * scale


def _time_scale(q, jets, scales):
    """The time [s] in which a state changes by its size: near a singularity a motion is quick."""
    size = np.ones(q.nq + 2 * q.n) if scales is None else scales.jets(2)
    place, rate, second = (
        max((abs(jets.get(name, 0.0)) / size[i] for i, name in zip(places, q.jet_names(k), strict=True)), default=0.0)
        for k, places in enumerate(np.split(np.arange(len(size)), [q.nq, q.nq + q.n]))
    )
    unit = 1.0 if scales is None else scales.time
    return unit / max(rate / (1.0 + place), np.sqrt(second / (1.0 + place)), TINY)
