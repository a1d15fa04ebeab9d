"""From a mechanism and a program to the rows that determine the motion and its actuation."""

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from servoctl.checks import finite, mapping
from servoctl.errors import NotRealisable, SpecificationError, unknown
from servoctl.jets.series import Flow
from servoctl.reduction.appell import Realisation, realisation, require_inertia
from servoctl.reduction.hidden import complete
from servoctl.reduction.knots import Knots, Switches, require_smooth
from servoctl.reduction.manifold import Context, Points, sample
from servoctl.reduction.ranks import Rank, clean, decide, decide_all
from servoctl.reduction.rows import Balance, Row, as_rows, merge_uses, settle_alone
from servoctl.spec.mechanism import Mechanism, require_known
from servoctl.spec.program import Program
from servoctl.tolerances import TINY

NEARBY = 0.01  # s about an instant for which pivots are chosen: at the instant alone, accidents look like laws
NEAR_SPREAD = 1e-3  # relative width of the points about a state for which pivots are chosen
WINDOW = (0.1, 1.1)  # s, where points are drawn if nothing switches; t = 0 is too often a special instant
LONE_WINDOW = 1.0  # s on either side of a single switch
INSET = 0.07  # of the time between the first and the last switch is left out at both ends, where paths begin and end
HELD = 1e-9  # of the size of its terms: what may be left of a residual at points where the rows hold


@dataclass(frozen=True)
class Reduction:
    """The rows ψ_a = 0 of a motion, hidden constraints among them, and where the actuation comes from.

    Attributes
    ----------
    mechanism : Mechanism
    program : Program
    rows : tuple of Row
        n rows, program rows first, then material ones, then those of (3.18).
    realisation : Realisation
    rank : Rank
        Of the leading matrix of the rows, with its margins.
    points : Points
        Seeded points on the manifold of the rows and their derivatives.
    guards : tuple of (str, SX)
        Pivots by which the rows divide.
    knots : Knots
    switches : Switches
    context : Context
    given : dict of str to Row
        Rows of the designer's residuals and material constraints, by name.
    """

    mechanism: Mechanism
    program: Program
    rows: tuple
    realisation: Realisation
    rank: Rank
    points: Points
    guards: tuple
    knots: Knots
    switches: Switches
    context: Context
    given: dict

    def __repr__(self):
        rows = ", ".join(f"{row.name} {row.order}" for row in self.rows)
        return f"Reduction(rows and orders: {rows}; {self.free} free initial values)"

    @property
    def top(self):
        """The common order s̄ to which every row is raised: 2 or more, and more than that of a bent row."""
        return max([2, *(row.order + (not row.affine) for row in self.rows)])

    @property
    def free(self):
        """The number of free initial values, Σ o_a."""
        return sum(row.order for row in self.rows)

    @property
    def needs(self):
        """Derivatives of each residual that the actuation holds."""
        return {name: count for name, count in needs(self.rows).items() if name in self.program.residuals}

    @property
    def smoothness(self):
        """The class that each residual, material constraint and force needs in time."""
        return smoothness(self.switches, self.rows)

    @property
    def timed(self):
        """Whether paths switch at instants."""
        return bool(self.switches)

    @property
    def hidden(self):
        """The rows that are hidden constraints."""
        return tuple(row for row in self.rows if row.story)

    @cached_property
    def leading(self):
        """The leading matrix L, (n, n) SX."""
        return ca.vertcat(*(row.gradient(self.mechanism.q) for row in self.rows))

    @cached_property
    def conditions(self):
        """What `holds` looks at: L, Bᵀ, and then the residuals with their derivatives, and the balance."""
        q, B = self.mechanism.q, self.realisation.B
        levels = (q.derivatives([row.expression], max(0, self.top - row.order)) for row in self.given.values())
        left = [level[0] for orders in levels for level in orders]
        free = self.mechanism.balance - B @ self.multipliers
        return [*self.leading.nonzeros(), *B.T.nonzeros(), *left, *free.elements()]

    @cached_property
    def decided(self):
        """Values and sizes of the conditions at the points of the reduction."""
        return self.points.evaluate(self.conditions)

    @cached_property
    def flow(self):
        """The rows along a motion, as `holds` puts points on their manifold."""
        return Flow(self.mechanism.q, self.rows, self.top, self.points)

    @cached_property
    def multipliers(self):
        """Multipliers of the reaction, program first, (b,) SX of t, q, γ', γ''."""
        return self.realisation.multipliers(self.mechanism.balance)

    @cached_property
    def actuation(self):
        """Required actuation u (m,) SX, or for an ideal program the reaction of the program, (n,) SX."""
        k = len(self.program.residuals)
        multipliers = self.multipliers[:k]
        if self.program.by == "actuators":
            return ca.cse(self.realisation.actuation @ multipliers)
        return ca.cse(self.realisation.B[:, :k] @ multipliers)


def needs(rows):
    """Derivatives of each residual and of the balance that γ'', and so the actuation, holds."""
    return merge_uses(*((row.uses, max(0, 2 - row.order)) for row in rows))


def smoothness(switches, rows):
    """The class in time that each expression of the switches needs; a force that no derivative is taken of may jump."""
    total = needs(rows)
    forces = total.pop(Balance(), 0)
    if forces:
        total |= {name: forces for name in switches.residuals if isinstance(name, Balance)}
    return total


def _idle(row, program):
    return NotRealisable(
        f"The {row.name} vanishes identically on the displacements that {', '.join(program.residuals)} allow.",
        "Eq. (3.18) determines the motion beside the program.",
        do="State another program: this one leaves the motion open.",
        rows=[row.name, *program.residuals],
    )


def reduce(mechanism, program, guess=None, near=None, values=None):
    """Derive the rows of a motion: eq. (3.18), hidden constraints, ranks on the manifold.

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
    guess : dict of str to float, optional
        Values of coordinates or derivatives about which points of the manifold are looked for.
    near : (t, jets, sizes), optional
        An instant and dicts of jets and of their sizes along the motion: pivots are chosen there.
    values : (n_p,) array, optional
        Parameters at which ranks are decided; default: the mechanism's own.

    Returns
    -------
    Reduction

    Raises
    ------
    SpecificationError, NotRealisable, SingularProgram, InconsistentStart
        See `hidden.complete` and `appell.realisation`.
    """
    _require_parts(mechanism, program, guess)
    q = mechanism.q
    names = q.names if q.plain else q.velocity_names
    forces = {Balance(name): r for name, r in zip(names, mechanism.balance.elements(), strict=True)}
    switches = Switches(q, {**program.residuals, **mechanism.constraints, **forces}, mechanism.parameters.symbols)
    context = _context(mechanism, switches, guess, near, values)
    original = [
        *as_rows(q, program.residuals, "program", context),
        *as_rows(q, mechanism.constraints, "material", context),
    ]
    constraints, points, guards = _constraints(mechanism, program, original, context)
    split = realisation(mechanism, program, constraints, points)
    expressions, pivots = split.dynamics(mechanism.balance)
    guards = [*guards, *((f"choice of dependent coordinates {i + 1}", p) for i, p in enumerate(pivots))]
    dynamics = [
        Row(e, max(q.order(e), 0), f"balance of {names[i]}", "dynamics", uses={Balance(): 0})
        for i, e in zip(split.independent, expressions, strict=True)
    ]
    dynamics = [row for row, _ in settle_alone(q, dynamics, context)]
    for row in dynamics:
        if row.order < 0:
            raise _idle(row, program)
    rows, rank, points, more = complete(q, [*constraints, *dynamics], context, points)
    knots = require_smooth(switches, context.values, smoothness(switches, rows))
    by_name = {row.name: row for row in original}
    reduction = Reduction(
        mechanism, program, tuple(rows), split, rank, points, (*guards, *more), knots, switches, context, by_name
    )
    _require_outputs(reduction)
    return reduction


def holds(reduction, values):
    """Whether a reduction, which was decided at its own parameters, is right at others as well.

    At points that satisfy its rows with these parameters, the given residuals and the balance must hold, too; every
    entry that was found to be zero must still be, and every rank must be kept.

    Parameters
    ----------
    reduction : Reduction
    values : (n_p,) array

    Returns
    -------
    bool
    """
    q, r = reduction.mechanism.q, reduction
    context = replace(r.context, values=values)
    points = sample(q, r.rows, r.top, context, starts=r.points, flow=r.flow)
    if not len(points.t):
        return False
    after, start = points.evaluate(r.conditions), 0
    for sparsity in (r.leading.sparsity(), r.realisation.B.T.sparsity()):
        entries = slice(start, start + sparsity.nnz())
        old, new = (
            clean(*p.placed(sparsity, *(part[entries] for part in values_and_sizes)))
            for p, values_and_sizes in ((r.points, r.decided), (points, after))
        )
        if np.any(np.any(new, axis=2) & ~np.any(old, axis=2)) or decide(new[:, :, 0]).rank < len(new):
            return False
        start = entries.stop
    left, sizes = (part[start:] for part in after)
    return bool(np.all(np.abs(left) <= HELD * np.maximum(sizes, TINY)))


def _require_parts(mechanism, program, guess):
    for value, kind in ((mechanism, Mechanism), (program, Program)):
        if not isinstance(value, kind):
            raise SpecificationError(
                f"Expected a {kind.__name__}, got a {type(value).__name__}.",
                "A model is derived from a mechanism and a program, in this order.",
                do="Write sv.derive(mechanism, program).",
            )
    q = mechanism.q
    for name, expression in program.residuals.items():
        require_known(expression, mechanism, f"the residual {name!r}")
    for name, weight in program.weights.items():
        require_known(ca.SX(weight), mechanism, f"the weight of {name!r}")
    twice = [name for name in program.residuals if name in mechanism.constraints]
    if twice:
        raise SpecificationError(
            f"{twice[0]!r} names a residual and a material constraint.", "Their names differ.", do="Rename one of them."
        )
    known = [*q.names, *(name for k in range(1, 8) for name in q.jet_names(k))]
    for name, value in mapping(guess, "The guesses").items():
        if name not in known:
            raise unknown(name, known, "coordinate or derivative")
        finite(name, value)


def _constraints(mechanism, program, given, context):
    """Program and material rows, the latter of full rank, ideal ones together; points on them; pivots divided by."""
    q = mechanism.q
    program_rows = [row for row in given if row.kind == "program"]
    material, _, points, guards = complete(q, [row for row in given if row.kind == "material"], context)
    require_inertia(mechanism, material, points)
    if program.by == "ideal":
        constraints, _, points, guards = complete(q, [*program_rows, *material], context)
        return constraints, points, guards
    constraints = [*program_rows, *material]
    points = _points_for(q, constraints, points, context)
    G = ca.vertcat(*(row.gradient(q) for row in constraints))
    if decide_all(*points.matrix(G))[0].rank < len(constraints):
        complete(q, constraints, context, points)
    return constraints, points, guards


def _require_outputs(reduction):
    """Refuse an output of higher order than the jets of a motion."""
    q, top = reduction.mechanism.q, reduction.top
    for name, expression in reduction.mechanism.outputs.items():
        if q.order(expression) > top:
            raise SpecificationError(
                f"The output {name!r} has order {q.order(expression)}.",
                f"A motion of this program has jets up to order {top}.",
                do="Give an output of lower order, and take its derivatives from a run by method=sv.Taylor(jets=...).",
                name=name,
            )


def _context(mechanism, switches, guess, near, values):
    values = mechanism.parameters.values() if values is None else np.asarray(values, dtype=float)
    if near is not None:
        t, guess, sizes = near
        return Context(mechanism.parameters.symbols, values, (t - NEARBY, t + NEARBY), guess, NEAR_SPREAD, sizes)
    times = switches.times(values)
    window = WINDOW
    if len(times) == 1:
        window = (times[0] - LONE_WINDOW, times[0] + LONE_WINDOW)
    elif times:
        width = times[-1] - times[0]
        window = (times[0] + INSET * width, times[-1] - INSET * width)
    return Context(mechanism.parameters.symbols, values, window, guess or {})


def _points_for(q, constraints, points, context):
    """Points on the manifold of all constraints, or on that of the material ones where there are none."""
    common = sample(q, constraints, max([2, *(row.order for row in constraints)]), context)
    return common if len(common.t) else points
