"""Hidden constraints by linear combination (Tan, Nedialkov & Pryce after Pryce's signature method).

While the leading matrix L of the rows is singular on their manifold, w with wᵀL = 0 gives the combination
χ = Σ w_a D^(o - o_a) ψ_a of lower order, which replaces one row; the sum of the orders falls at every step.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

from servoctl.errors import InconsistentStart, NotRealisable, SingularProgram, SpecificationError
from servoctl.reduction.manifold import SPREAD, anywhere, sample
from servoctl.reduction.ranks import clean, decide, decide_each, eliminate, generic
from servoctl.reduction.rows import (
    Row,
    dependence,
    leading,
    merge_uses,
    settle,
    slopes,
    solved_columns,
    values_and_sizes,
    vanishing_gradient,
)
from servoctl.tolerances import NOISE, RESOLVED
from servoctl.values import frozen

OUT_OF_REACH = 30.0  # least value of a residual, relative to its changes, where mixed units are a likely cause
DIVIDES = 1e-3  # of its usual size: a combination is not divided by a jet that is smaller at a point


class Deep(Exception):
    """A row would differentiate a residual or a balance more often than allowed; `complete` can go on from there."""

    so_far = None


def complete(q, rows, context, starts=None, most=None, so_far=None):
    """Replace rows by hidden constraints until their leading matrix has full row rank.

    Takes at most n rows, with settled orders. Returns rows, their rank, whose `dropped` is the largest on the way,
    points of their manifold, and pivots (description, SX). Raises SpecificationError if constraints depend on or
    contradict each other, NotRealisable if rows of (3.18) are involved, SingularProgram if a gradient vanishes where
    its row holds or a rank is undecided, InconsistentStart if no state satisfies the rows, and `Deep`, from whose
    `so_far` it can go on, if a row would hold more than `most` derivatives of a residual or a balance.
    """
    rows, pivots, points, dropped = so_far or (list(rows), [], starts, 0.0)
    while True:
        level, before = max([row.order for row in rows], default=0), points
        points = sample(q, rows, level, context, starts=before)
        if not len(points.t):
            raise _no_common_state(q, rows, context)
        numbers, sizes = leading(q, rows, points)
        ranks = decide_each(clean(numbers, sizes))
        rank, _ = generic(ranks)
        if not rank.clear:
            raise _ill_conditioned(rows, rank)
        same = [p for p, other in enumerate(ranks) if other.rank == rank.rank]
        dropped = max(dropped, rank.dropped)
        if rank.rank == len(rows):
            return rows, replace(rank, dropped=dropped), points.take(same), pivots
        try:
            combination = _lowest(q, rows, numbers[:, :, same], context, points, most)
        except Deep as deep:
            deep.so_far = rows, pivots, before, dropped
            raise
        if combination.row.order < 0:
            raise _dependent(q, rows, combination)
        rows[combination.replaces] = replace(combination.row, parts=())
        pivots += [(f"combination of {combination.row.derivation}", pivot) for pivot in combination.pivots]


@frozen
class _Combination:
    """A combination of rows whose leading gradients cancel."""

    row: Row  # with its true order, -1 if it depends on t alone
    replaces: int  # index of the row that it replaces, one of the highest order in the support
    support: list  # indices of the combined rows
    points: object  # on the manifold of all rows but the replaced one
    pivots: list  # SX by which the combination divides
    whole: Row  # the combination itself, before its order was settled


def combined_uses(rows):
    """The highest derivative of each residual, and of the balance, in a combination of rows at their highest order."""
    top = max((row.order for row in rows), default=0)
    return merge_uses(*((row.uses, top - row.order) for row in rows))


def _lowest(q, rows, numbers, context, starts=None, most=None):
    """The combination of dependent rows that replaces one of them by a row of lower order."""
    # Rows of (3.18) come last, and are replaced first among those of highest order: where it can be, the designer's
    # constraints stay as they are written.
    order = sorted(range(len(rows)), key=lambda a: (rows[a].kind == "dynamics", rows[a].order, a))
    support, weights = dependence(numbers[order])
    if not support:  # a gradient that is rounding at some points and zero at others depends on rows after it, too
        order = order[::-1]
        support, weights = dependence(numbers[order])
    if not support:  # the ranks at single points and the dependence at all of them disagree
        raise _ill_conditioned(rows, generic(decide_each(numbers))[0])
    support = [order[i] for i in support]
    if most is not None and max(combined_uses([rows[a] for a in support]).values(), default=0) > most:
        raise Deep
    top = max(rows[a].order for a in support)
    # The gradients of the others are divided by: constant ones vanish nowhere.
    varying = {a for a in support if ca.symvar(rows[a].gradient(q))}
    highest = ((a, w) for a, w in zip(support, weights, strict=True) if rows[a].order == top)
    b = max((rows[a].kind == "dynamics", varying <= {a}, w, a) for a, w in highest)[3]
    first = _combination(q, rows, b, support, numbers, context, starts)
    if first.row.order < top and not _slopes_beside(q, rows, first, context).any():
        return first
    for support, numbers in _beside_manifold(q, rows, b, context):
        if support and all(rows[a].affine or rows[a].order < top for a in support):
            combination = _combination(q, rows, b, support, numbers, context)
            if combination.row.order < top:
                return combination
    return _divided(q, rows, first, context)


def _combination(q, rows, b, support, numbers, context, starts=None):
    """Row b combined with the others of a support, with its order on the manifold of all other rows."""
    top = rows[b].order
    _require_affine(rows, support, top)
    others = [a for a in support if a != b]
    parts, pivots = _combine(q, rows, b, others, top, numbers, context)
    derivation = in_words(rows[b], [rows[a] for a in others], top)
    uses = combined_uses([rows[a] for a in support])
    rests = any(rows[a].rests for a in support)
    expression = ca.cse(sum(parts))
    chi = replace(rows[b], expression=expression, order=top, uses=uses, parts=tuple(parts), rests=rests)
    row, points = settle(q, chi, rows[:b] + rows[b + 1 :], context, starts)
    if row is None:
        raise _no_state(q, rows[:b] + rows[b + 1 :], context)
    return _Combination(replace(row, derivation=derivation), b, support, points, pivots, chi)


def _slopes_beside(q, rows, combination, context):
    """Slopes (n, N) of a combination in its highest jets where the other rows hold and the replaced one need not.

    Where the slopes vanish beside the manifold of the other rows, too, they vanish identically.
    """
    level, points = combination.whole.order, combination.points
    # at random points, not in proportion to these: what the rows keep at zero is not zero there
    values = slopes(q, combination.whole, level, anywhere(q, points.level, context))
    if not np.any(values):
        return values
    rest = [row for a, row in enumerate(rows) if a != combination.replaces]
    return slopes(q, combination.whole, level, sample(q, rest, points.level, context))


def _divided(q, rows, combination, context):
    """A combination a γ_i^(k) whose jet is not zero at the solutions, divided by it: the row a = 0.

    A path by its geometry and a wheel that rolls along it give such a combination: the speed times the angle between
    the wheel and the path.
    """
    b, whole = combination.replaces, combination.whole
    if len(combination.support) == 1:
        if _independent_in_q(q, [rows[b]], combination.points):  # but no velocity moves it where it holds at all times
            raise _beyond_velocities(q, [rows[b].name])
        raise vanishing_gradient(rows[b])
    level = whole.order
    beside = np.abs(_slopes_beside(q, rows, combination, context)).max(axis=1, initial=0.0)
    i = int(np.argmax(beside))
    jet = q.jet_names(level)[i]
    if not np.abs(combination.points.jet(level)[i]).min(initial=np.inf) > DIVIDES * context.sizes.get(jet, 1.0):
        raise vanishing_gradient(rows[b])  # at rest a = 0 would follow from nothing
    rest = [row for a, row in enumerate(rows) if a != b]
    row = replace(whole, expression=ca.densify(whole.gradient(q, level))[i], parts=())
    row, points = settle(q, row, rest, context, combination.points)
    if row is None or not 0 <= row.order < level:
        raise vanishing_gradient(rows[b])
    points = sample(q, [*rest, row], level, context, starts=points)
    if not len(points.t) or np.any(clean(*values_and_sizes(whole, points))):
        raise vanishing_gradient(rows[b])
    return replace(
        combination, row=replace(row, derivation=f"{combination.row.derivation}, divided by {jet}"), points=points
    )


def _beside_manifold(q, rows, b, context):
    """The rows whose combination is row b's leading gradient, and L, beside the manifold of all rows.

    Coefficients may vanish on the manifold and not beside it. A load that is lifted straight up never swings; only
    beside its motion does the combination show that it forbids swinging. First all rows but b hold, then those alone
    that are no balances.
    """
    order = [*(a for a in range(len(rows)) if a != b and rows[a].order <= rows[b].order), b]
    rest = [row for a, row in enumerate(rows) if a != b]
    wide = replace(context, spread=SPREAD)  # products of coefficients that vanish on the manifold are felt there
    for some, place in ((rest, context), ([row for row in rest if row.kind != "dynamics"], wide)):
        points = sample(q, some, max(row.order for row in rows), place)
        numbers, _ = leading(q, rows, points)
        support, _ = dependence(numbers[order], first=len(order) - 1)
        yield [order[i] for i in support], numbers


def _combine(q, rows, b, others, top, numbers, context):
    """The terms of χ = ψ_b + Σ w_a D^(top - o_a) ψ_a with the w that cancels the leading gradient of row b."""
    if not others:
        return [rows[b].expression], []
    rank = decide(numbers[others, :, 0])
    if rank.rank < len(others):  # rows that depend on each other at some points only
        raise _ill_conditioned([rows[a] for a in others], rank)
    columns = solved_columns(q, numbers[others, :, 0], rank, context)
    matrix = ca.vertcat(*(rows[a].gradient(q) for a in others))[:, columns].T
    target = -rows[b].gradient(q)[:, columns].T
    w, pivots = eliminate(matrix, target, numbers[others][:, columns].swapaxes(0, 1))
    raised = (q.derivatives([rows[a].expression], top - rows[a].order)[-1][0] for a in others)
    parts = [rows[b].expression, *(weight * e for weight, e in zip(w.elements(), raised, strict=True))]
    return parts, [p for p in pivots if ca.symvar(p)]


def in_words(row, others, top):
    """The combination of a row with derivatives of others to an order, in words."""
    names = [_derivative_name(other, top - other.order) for other in others]
    return f"{row.name} with {', '.join(names)}" if names else row.name


def _derivative_name(row, k):
    return row.name if k == 0 else f"D{'' if k == 1 else k}({row.name})"


def _require_affine(rows, support, top):
    indices = [a for a in support if rows[a].order == top and not rows[a].affine]
    nonlinear = [rows[a].name for a in indices]
    if nonlinear:
        raise SpecificationError(
            f"The residual {nonlinear[0]!r} is nonlinear in its highest derivative and depends on other rows there.",
            "Hidden constraints are derived from rows that are linear in their highest derivatives.",
            do=f"Program the time derivative of {nonlinear[0]!r}, which is linear in its highest derivative, and start "
            "where the residual is zero; or divide it by a factor that the others keep at zero.",
            rows=nonlinear,
        )


def _dependent(q, rows, combination):
    """The error of rows whose combination depends on t alone."""
    names, derivation = [rows[a].name for a in combination.support], combination.row.derivation
    zero = not np.any(clean(*values_and_sizes(combination.row, combination.points)))
    listed = ", ".join(names)
    if any(rows[a].kind == "dynamics" for a in combination.support):
        program = [name for name in names if name != combination.row.name] or names
        return NotRealisable(
            f"No derivative of the program contains the actuation: the combination {derivation} "
            + ("vanishes identically." if zero else "depends on t alone and is not zero."),
            "Every residual needs an actuator that moves it.",
            do=f"Change the actuators or the rows {', '.join(program)}.",
            rows=names,
            combination=derivation,
        )
    if zero:
        if _independent_in_q(q, [rows[a] for a in combination.support], combination.points):
            return _beyond_velocities(q, names)
        return SpecificationError(
            f"The constraints {listed} are dependent: the combination {derivation} vanishes identically.",
            "Constraints must be independent of each other, and each has a gradient where it holds.",
            do=f"Remove one of {listed}, or divide it by a factor that the others keep at zero.",
            rows=names,
            combination=derivation,
        )
    return SpecificationError(
        f"The constraints {listed} contradict each other: the combination {derivation} depends on t alone and "
        "is not zero.",
        "Constraints must have a common solution.",
        do=f"Correct one of {listed}.",
        rows=names,
        combination=derivation,
    )


def _independent_in_q(q, rows, points):
    """Whether residuals of order 0 restrict more directions of q than the velocities have, as rolling machines do."""
    if q.nq <= q.n or any(row.order for row in rows):
        return False
    expressions = [*(row.expression for row in rows), *q.invariants.values()]
    numbers = clean(*points.matrix(ca.jacobian(ca.vertcat(*expressions), q.jet(0))))
    return generic(decide_each(numbers))[0].rank == len(expressions)


def _beyond_velocities(q, names):
    listed, velocities = ", ".join(names), ", ".join(q.velocity_names)
    if len(names) == 1:
        given = f"The residual {listed} restricts coordinates, but none of the velocities {velocities} moves it there."
    else:
        given = f"The residuals {listed} are independent, but {velocities} move them in dependent directions."
    return SpecificationError(
        given,
        "Hidden constraints of quasi-velocities are derived from rates where residuals outnumber the directions in "
        "which the velocities move them.",
        do=f"Program the rates q.dt(residual, 1) of {listed}, and start where the residuals are zero; or write the "
        "machine in its coordinates, with constraints={...} in place of fewer velocities.",
        rows=names,
        velocities=q.velocity_names,
    )


def _no_common_state(q, rows, context):
    """The error of rows that no point satisfies: a contradiction among them, where there is one."""
    given, points = rows, sample(q, [], max(row.order for row in rows), context)
    while True:
        numbers, sizes = leading(q, rows, points)
        ranks = decide_each(clean(numbers, sizes))
        rank, _ = generic(ranks)
        if not rank.clear or rank.rank == len(rows):
            return _no_state(q, given, context)
        same = [p for p, other in enumerate(ranks) if other.rank == rank.rank]
        try:
            combination = _lowest(q, rows, numbers[:, :, same], context)
        except InconsistentStart:  # some of the rows alone have no common state
            return _no_state(q, given, context)
        if combination.row.order < 0:
            return _dependent(q, rows, combination)
        rows = [combination.row if a == combination.replaces else row for a, row in enumerate(rows)]


def _no_state(q, rows, context):
    """The error of rows without a common state; it tells of one that is far from where random points move it."""
    points = sample(q, [], max(0, *(row.order for row in rows)), context)
    points = replace(points, instants=points.instants[[0] * len(points)])  # a path alone brings no residual to zero
    values = np.abs(points.evaluate([row.expression for row in rows])[0]).astype(float)
    with np.errstate(all="ignore"):
        ratios = np.nan_to_num(values.min(axis=1) / np.ptp(values, axis=1), posinf=0.0)
    name, ratio = max(zip((row.name for row in rows), ratios.tolist(), strict=True), key=lambda pair: pair[1])
    far = f"; {name} is {ratio:.0f} times as far from zero as coordinates of usual size change it"
    far = far if ratio > OUT_OF_REACH else ""
    units = "Check that lengths have the same unit (m, not mm), pass" if far else "Pass"
    return InconsistentStart(
        f"No state satisfies {', '.join(sorted({row.name for row in rows}))} and their time derivatives{far}.",
        "Newton's method searches for such states about the guess.",
        do=f"{units} guess={{...}} near the motion to derive, or correct the constraints.",
        rows=[row.name for row in rows],
        **({"far": name, "ratio": ratio} if far else {}),
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
