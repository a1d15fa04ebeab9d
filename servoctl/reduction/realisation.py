"""Who realises a program: an ideal reaction, or actuators, which share where the program leaves actuation open.

What a program says of more actuators than it has residuals is linear in u. The rows that hold whatever the actuation
is are the program, the material constraints, the balances that no actuator enters, and the hidden constraints among
them. With their leading matrix L, and N = ∂γ''/∂u of the plant, L N u is determined, which is k numbers. Of all u with
these

    u = u_wish + W⁻¹Pᵀμ,    P = k independent rows of L N,

has the least (u - u_wish)ᵀW(u - u_wish). For relative degree 2, P = G N is the decoupling matrix.
"""

import casadi as ca
import numpy as np

from servoctl.errors import NotRealisable, SingularProgram, SpecificationError
from servoctl.reduction.appell import Realisation, plant_solution
from servoctl.reduction.hidden import complete
from servoctl.reduction.ranks import clean, decide, decide_all, decide_each, sizeable_columns
from servoctl.reduction.rows import balances, settle_rows
from servoctl.spec.coordinates import require_order
from servoctl.spec.mechanism import inverse_directions


def realisation(mechanism, program, constraints, points, context):
    """The realisation of a program by ideal reactions or by the mechanism's actuators, with points and pivots.

    Material rows among the constraints have full row rank; points lie on the manifold of the constraints, those
    returned on that of the settled rows, if there are any. Pivots are (description, SX). Raises NotRealisable if the
    residuals outnumber the independent actuators, or these cannot move them independently, and SpecificationError for
    weights by the inertia or wishes that do not fit, such as wishes where the program determines the actuation.
    """
    if program.by == "ideal":
        G = [row.gradient(mechanism.q).T for row in constraints if row.kind == "program"]
        return _realised(mechanism, constraints, ca.horzcat(*G), None, points), points, []
    m, k = len(mechanism.actuators), len(program.residuals)
    material = [row for row in constraints if row.kind == "material"]
    independent = _independent_actuators(mechanism, material, points)
    _require_enough(mechanism, program, len(independent))
    _require_choices(mechanism, program)
    if k == m:
        return _realised(mechanism, constraints, mechanism.E, ca.SX.eye(m), points), points, []
    if k == len(independent):
        # The program determines E u up to forces of material rows. P has the row space of T_mᵀE.
        rows, pivots = _realised(mechanism, material, ca.SX(mechanism.q.n, 0), None, points).virtual(mechanism.E)
        chosen = _independent_rows(clean(*points.matrix(rows)), k)
        A = _inverse_weights(mechanism, program) @ rows[chosen, :].T
        pivots = [(f"choice of virtual displacements {i}", p) for i, p in enumerate(pivots, 1)]
        return _realised(mechanism, constraints, mechanism.E @ A, A, points), points, pivots
    return _shared(mechanism, program, constraints, independent, points, context)


def desired_actuation(mechanism, program):
    """u_wish, (m,) SX."""
    return ca.vertcat(*(ca.SX(program.toward.get(name, 0.0)) for name in mechanism.actuators))


def desired_balance(mechanism, program):
    """The balance under the desired actuation, r - E u_wish, (n,) SX: what the reaction B μ holds."""
    return mechanism.balance - mechanism.E @ desired_actuation(mechanism, program)


def _realised(mechanism, constraints, directions, actuation, points, among=None, **settled):
    """The realisation by a program's directions beside material rows; `among` are candidates for dependence."""
    n = mechanism.q.n
    candidates = list(range(n)) if among is None else sorted(among)
    B = ca.horzcat(directions, *(row.gradient(mechanism.q).T for row in constraints if row.kind == "material"))
    numbers, sizes = points.matrix(B.T)
    rank, best = decide_all(numbers[:, candidates], sizes[:, candidates])
    if rank.rank < B.shape[1]:
        raise NotRealisable(
            f"The directions of the actuators {', '.join(mechanism.actuators)} and of the material constraints are "
            f"dependent (rank {rank.rank} of {B.shape[1]}).",
            "Actuators and material constraints act in independent directions.",
            do="Remove an actuator or a constraint.",
            actuators=list(mechanism.actuators),
            rank=rank.rank,
            directions=B.shape[1],
        )
    cleaned = clean(numbers, sizes)
    inertia = clean(*points.matrix(ca.diag(mechanism.mass)))[candidates, 0, best]
    # columns of numbers alone vanish nowhere, in no unit
    steady = [i for i, j in enumerate(candidates) if B[j, :].is_constant()]
    alone = decide(cleaned[:, [candidates[i] for i in steady], best])
    columns = [steady[i] for i in alone.columns] if alone.rank == rank.rank else list(rank.columns)
    columns = sizeable_columns(cleaned[:, candidates, best], columns, inertia)
    dependent = tuple(sorted(candidates[i] for i in columns))
    regular = [p for p, rank in enumerate(decide_each(cleaned[:, list(dependent)])) if rank.rank == len(cleaned)]
    independent = tuple(i for i in range(n) if i not in dependent)
    return Realisation(B, actuation, dependent, independent, cleaned[:, :, regular or [best]], **settled)


def _shared(mechanism, program, constraints, independent, points, context):
    """What `realisation` returns where k residuals leave actuation open."""
    q, k = mechanism.q, len(program.residuals)
    material = [row for row in constraints if row.kind == "material"]
    reached = _realised(mechanism, constraints, mechanism.E[:, independent], None, points)
    unreached, of_split = reached.dynamics(mechanism.balance)
    rows = [*constraints, *(row for row, _ in settle_rows(q, balances(q, unreached), context))]
    rows, _, points, pivots = complete(q, rows, context, points)
    of_split = of_split if reached.independent else []  # nothing is divided where all balances are reached
    pivots = [*((f"choice of unreached balances {i}", p) for i, p in enumerate(of_split, 1)), *pivots]
    P, L = _determined_rows(mechanism, rows, material, points, k)
    A = _inverse_weights(mechanism, program) @ P.T if program.metric == "actuators" else _inertial(mechanism, L)
    realised = _realised(
        mechanism,
        constraints,
        mechanism.E @ A,
        A,
        points,
        reached.dependent,
        settled=tuple(rows),
        unreached=reached.independent,
    )
    return realised, points, pivots


def _determined_rows(mechanism, rows, material, points, k):
    """P, k independent rows of L N, (k, m) SX, and these rows of L."""
    q = mechanism.q
    L = ca.vertcat(*(row.gradient(q) for row in rows))
    P = L @ _responses(mechanism, material, points)
    numbers = clean(*points.matrix(P))
    lengths = np.linalg.norm(clean(*points.matrix(L)).astype(float), axis=1)
    chosen = _independent_rows(numbers / np.where(lengths > 0, lengths, 1.0)[:, None], k)
    rank = max(r.rank for r in decide_each(numbers[chosen]))
    if rank < k:
        names = ", ".join(row.name for row in rows)
        raise SingularProgram(
            f"The rows {names} determine {rank} combinations of the actuators {', '.join(mechanism.actuators)}.",
            f"{k} residuals determine {k} of them, which weights and wishes complete.",
            do="Move the parameters away from this case, or program other outputs.",
            rows=[row.name for row in rows],
            actuators=list(mechanism.actuators),
            rank=rank,
            determined=k,
        )
    return ca.cse(P[chosen, :]), L[chosen, :]


def _responses(mechanism, material, points):
    """N = ∂γ''/∂u of the plant, (n, m) SX: M⁻¹E, or beside material rows T_m(T_mᵀMT_m)⁻¹T_mᵀE."""
    still = ca.SX.zeros(len(material), mechanism.E.shape[1])
    return plant_solution(mechanism, material, mechanism.E, still, points)[0][: mechanism.q.n, :]


def _independent_actuators(mechanism, material, points):
    """As many actuators as possible with independent directions beside those of material constraints, by index."""
    m = mechanism.E.shape[1]
    if not m:
        return []
    directions = ca.vertcat(*(row.gradient(mechanism.q) for row in material), mechanism.E.T)
    numbers = clean(*points.matrix(directions))
    count = decide_all(numbers, np.abs(numbers))[0].rank
    rows = _independent_rows(numbers, count, len(material))
    return sorted(a - len(material) for a in rows[len(material) :])


def _independent_rows(matrices, count, first=0):
    """Indices of rows of (rows, m, N), the first ones and others in order until there are `count`.

    Each has the largest part that is independent of those before, relative to its column sizes, at the point where that
    part is smallest.
    """
    columns = np.abs(matrices).max(axis=(0, 2), initial=0.0)
    rest = (matrices / np.where(columns > 0, columns, 1.0)[:, None]).astype(float)
    chosen = []
    for i in range(count):
        sizes = np.linalg.norm(rest, axis=1)
        a = i if i < first else int(np.argmax(sizes.min(axis=1)))
        chosen.append(a)
        unit = rest[a] / np.where(sizes[a] > 0, sizes[a], 1.0)
        rest -= np.einsum("rmp,mp->rp", rest, unit)[:, None] * unit
    return [*chosen[:first], *sorted(chosen[first:])]


def _inverse_weights(mechanism, program):
    """W⁻¹, (m, m) SX."""
    return ca.diag(ca.vertcat(*(1 / ca.SX(program.weights.get(name, 1.0)) for name in mechanism.actuators)))


def _inertial(mechanism, L):
    """W⁻¹Pᵀ = E⁻¹Lᵀ for the weights EᵀM⁻¹E and P = L M⁻¹E, (m, k) SX."""
    return inverse_directions(mechanism.E) @ L.T


def _require_inertial(mechanism, program):
    """Refuse weights of the inertia where some velocity has no actuator of its own."""
    if inverse_directions(mechanism.E) is None or mechanism.constraints:
        raise SpecificationError(
            f"weights='inertia' is set for {len(mechanism.actuators)} actuators and {mechanism.q.n} velocities"
            f"{' with material constraints' if mechanism.constraints else ''}.",
            "The accelerations are chosen freely where each velocity has an actuator, along a constant direction.",
            do="Give weights by actuator, or program the further accelerations.",
            actuators=list(mechanism.actuators),
            velocities=list(mechanism.q.velocity_names),
        )


def _require_enough(mechanism, program, independent):
    """Refuse more residuals than independent actuators."""
    k = len(program.residuals)
    if k > independent:
        raise NotRealisable(
            f"The program has {k} residual{'s' * (k != 1)} ({', '.join(program.residuals)}), and the mechanism "
            f"{independent} independent actuators ({', '.join(mechanism.actuators) or 'none'}).",
            "A program needs at least as many independent actuators as residuals.",
            nearest=f"{independent} residuals, or by='ideal'." if independent else "by='ideal'.",
            do="Add actuators or remove residuals.",
            residuals=list(program.residuals),
            actuators=list(mechanism.actuators),
            independent=independent,
        )


def _require_choices(mechanism, program):
    """Refuse wishes of accelerations, wishes where no actuation is open, and an inertial metric that does not fit."""
    if program.metric == "inertia":
        _require_inertial(mechanism, program)
    for name, wish in program.toward.items():
        require_order(mechanism.q, ca.SX(wish), f"The wish of {name!r}", 1)
    if program.toward and len(program.residuals) == len(mechanism.actuators):
        raise SpecificationError(
            f"There are wishes of {', '.join(program.toward)}, and {len(program.residuals)} residuals determine the "
            f"{len(mechanism.actuators)} actuators.",
            "A wish chooses among actuations with which the program holds.",
            do="Remove the wishes or a residual, or add actuators.",
            wishes=list(program.toward),
            actuators=list(mechanism.actuators),
        )
