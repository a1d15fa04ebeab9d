"""Hidden constraints by linear combination (Tan, Nedialkov & Pryce after Pryce's signature method).

While the leading matrix L of the rows is singular on their manifold, w with wᵀL = 0 gives the combination
χ = Σ w_a D^(o - o_a) ψ_a of lower order, which replaces one row; the sum of the orders falls at every step.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from servoctl.errors import InconsistentStart, NotRealisable, SingularProgram, SpecificationError
from servoctl.reduction.manifold import sample
from servoctl.reduction.ranks import clean, decide, decide_all, decide_each, eliminate, generic
from servoctl.reduction.rows import Row, dependence, leading, merge_uses, settle, vanishing_gradient
from servoctl.tolerances import NOISE, RESOLVED


def complete(q, rows, context, starts=None):
    """Replace rows by hidden constraints until their leading matrix has full row rank.

    Parameters
    ----------
    q : Coordinates
    rows : list of Row
        At most n; each with its settled order.
    context : Context
    starts : Points, optional
        Starts for points of the manifold.

    Returns
    -------
    rows : list of Row
    rank : Rank
        Rank of the final leading matrix, with its margins.
    points : Points
        Points of the final manifold.
    pivots : list of (str, SX)
        Pivots by which the combinations divide, each with a description.

    Raises
    ------
    SpecificationError
        If constraints depend on each other or contradict each other.
    NotRealisable
        If the dependence involves rows of (3.18).
    SingularProgram
        If a row's gradient vanishes on its own solutions, or a rank is undecided in double precision.
    InconsistentStart
        If no state satisfies the rows.
    """
    rows, pivots, points = list(rows), [], starts
    while True:
        level = max([row.order for row in rows], default=0)
        points = sample(q, rows, level, context, starts=points)
        if not len(points.t):
            raise _no_common_state(q, rows, context)
        numbers, sizes = leading(q, rows, points)
        ranks = decide_each(clean(numbers, sizes))
        rank, _ = generic(ranks)
        if not rank.clear:
            raise _ill_conditioned(rows, rank)
        same = [p for p, other in enumerate(ranks) if other.rank == rank.rank]
        if rank.rank == len(rows):
            return rows, rank, points.take(same), pivots
        combination = _lowest(q, rows, numbers[:, :, same], context, points)
        if combination.row.order < 0:
            raise _dependent(rows, combination)
        rows[combination.replaces] = combination.row
        pivots += [(f"combination of {combination.row.story}", pivot) for pivot in combination.pivots]


@dataclass(frozen=True)
class _Combination:
    """A combination of rows whose leading gradients cancel."""

    row: Row  # with its true order, -1 if it depends on t alone
    replaces: int  # index of the row that it replaces, one of the highest order in the support
    support: list  # indices of the combined rows
    points: object  # on the manifold of all rows but the replaced one
    pivots: list  # SX by which the combination divides


def _lowest(q, rows, numbers, context, starts=None):
    """The combination of dependent rows that replaces one of them by a row of lower order."""
    # Rows of (3.18) come last, and are replaced first among those of highest order: where it can be, the designer's
    # constraints stay as they are written.
    order = sorted(range(len(rows)), key=lambda a: (rows[a].kind == "dynamics", rows[a].order, a))
    support, weights = dependence(numbers[order])
    if not support:  # the ranks at single points and the dependence at all of them disagree
        raise _ill_conditioned(rows, generic(decide_each(numbers))[0])
    support = [order[i] for i in support]
    top = max(rows[a].order for a in support)
    highest = ((a, w) for a, w in zip(support, weights, strict=True) if rows[a].order == top)
    b = max((rows[a].kind == "dynamics", w, a) for a, w in highest)[2]
    combination = _combination(q, rows, b, support, numbers, context, starts)
    if combination.row.order >= top:
        support, numbers = _beside_manifold(q, rows, b, context)
        combination = _combination(q, rows, b, support, numbers, context) if support else None
        if combination is None or combination.row.order >= top:
            raise vanishing_gradient(rows[b])
    return combination


def _combination(q, rows, b, support, numbers, context, starts=None):
    """Row b combined with the others of a support, with its order on the manifold of all other rows."""
    top = rows[b].order
    _require_affine(rows, support, top)
    others = [a for a in support if a != b]
    chi, pivots = _combine(q, rows, b, others, top, numbers)
    names = [_derivative_name(rows[a], top - rows[a].order) for a in others]
    story = f"{rows[b].name} with {', '.join(names)}" if names else rows[b].name
    rest = [row for a, row in enumerate(rows) if a != b]
    uses = merge_uses(*((rows[a].uses, top - rows[a].order) for a in support))
    row, points = settle(q, replace(rows[b], expression=chi, order=top, uses=uses), rest, context, starts)
    if row is None:
        raise _no_state(rest)
    return _Combination(replace(row, story=story), b, support, points, pivots)


def _beside_manifold(q, rows, b, context):
    """The rows whose combination is row b's leading gradient where all rows but b hold, and L at such points.

    Coefficients may vanish on the manifold of all rows and not beside it. A load that is lifted straight up never
    swings; only beside its motion does the combination show that it forbids swinging.
    """
    order = [*(a for a in range(len(rows)) if a != b and rows[a].order <= rows[b].order), b]
    rest = [row for a, row in enumerate(rows) if a != b]
    points = sample(q, rest, max(row.order for row in rows), context)
    numbers, _ = leading(q, rows, points)
    support, _ = dependence(numbers[order])
    return ([order[i] for i in support] if support and support[-1] == len(order) - 1 else []), numbers


def _combine(q, rows, b, others, top, numbers):
    """χ = ψ_b + Σ w_a D^(top - o_a) ψ_a with the w that cancels the leading gradient of row b."""
    chi = q.derivatives([rows[b].expression], top - rows[b].order)[-1][0]
    if not others:
        return chi, []
    columns = sorted(decide(numbers[others, :, 0]).columns)
    matrix = ca.vertcat(*(rows[a].gradient(q) for a in others))[:, columns].T
    target = -rows[b].gradient(q)[:, columns].T
    w, pivots = eliminate(matrix, target, numbers[others][:, columns].swapaxes(0, 1))
    for a, weight in zip(others, w.elements(), strict=True):
        chi = chi + weight * q.derivatives([rows[a].expression], top - rows[a].order)[-1][0]
    return ca.cse(chi), [p for p in pivots if ca.symvar(p)]


def _derivative_name(row, k):
    return row.name if k == 0 else f"D{'' if k == 1 else k}({row.name})"


def _require_affine(rows, support, top):
    nonlinear = [rows[a].name for a in support if rows[a].order == top and not rows[a].affine]
    if nonlinear:
        raise SpecificationError(
            f"The residual {nonlinear[0]!r} is nonlinear in its highest derivative and depends on other rows there.",
            "Hidden constraints are derived from rows that are linear in their highest derivatives.",
            do=f"Program the time derivative of {nonlinear[0]!r}, which is linear in its highest derivative, and start "
            "where the residual is zero.",
            rows=nonlinear,
        )


def _dependent(rows, combination):
    """The error of rows whose combination depends on t alone."""
    names, story = [rows[a].name for a in combination.support], combination.row.story
    zero = not np.any(clean(*combination.points.evaluate([combination.row.expression])))
    listed = ", ".join(names)
    if any(rows[a].kind == "dynamics" for a in combination.support):
        program = [name for name in names if name != combination.row.name] or names
        return NotRealisable(
            f"No derivative of the program contains the actuation: the combination {story} "
            + ("vanishes identically." if zero else "depends on t alone and is not zero."),
            "Every residual needs an actuator that moves it.",
            do=f"Change the actuators or the rows {', '.join(program)}.",
            rows=names,
            combination=story,
        )
    if zero:
        return SpecificationError(
            f"The constraints {listed} are dependent: the combination {story} vanishes identically.",
            "Constraints must be independent of each other.",
            do=f"Remove one of {listed}.",
            rows=names,
            combination=story,
        )
    return SpecificationError(
        f"The constraints {listed} contradict each other: the combination {story} depends on t alone and is not zero.",
        "Constraints must have a common solution.",
        do=f"Correct one of {listed}.",
        rows=names,
        combination=story,
    )


def _no_common_state(q, rows, context):
    """The error of rows that no point satisfies: a contradiction among them, where there is one."""
    points = sample(q, [], max(row.order for row in rows), context)
    numbers, sizes = leading(q, rows, points)
    rank, _ = decide_all(numbers, sizes)
    if rank.clear and rank.rank < len(rows):
        same = [p for p, other in enumerate(decide_each(numbers)) if other.rank == rank.rank]
        combination = _lowest(q, rows, numbers[:, :, same], context)
        if combination.row.order < 0:
            return _dependent(rows, combination)
    return _no_state(rows)


def _no_state(rows):
    return InconsistentStart(
        f"No state satisfies {', '.join(sorted({row.name for row in rows}))} and their time derivatives.",
        "Newton's method searches for such states about the guess.",
        do="Pass guess={...} near the motion to derive, or correct the constraints.",
        rows=[row.name for row in rows],
    )


def _ill_conditioned(rows, rank):
    return SingularProgram(
        f"Double precision cannot decide whether the rows {', '.join(row.name for row in rows)} are independent: the "
        f"smallest pivot that counts is {rank.kept:.2e}, the largest that does not {rank.dropped:.2e}.",
        f"An equilibrated pivot must be zero (below {NOISE:.0e}) or resolved (above {RESOLVED:.0e}).",
        do="Move the parameters away from the singular case, or set them to the singular case exactly.",
        rows=[row.name for row in rows],
        kept=rank.kept,
        dropped=rank.dropped,
    )
