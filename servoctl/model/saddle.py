"""Accelerations and multipliers together: one sparse elimination of the balance and the constraints.

The balance M γ'' + c = B μ and the constraints G γ'' + d = 0 have the matrix [M -B; G 0]. Elimination by T first gives
(3.18); pivots chosen by Markowitz counts over the whole matrix preserve the sparsity of many bodies, and the number of
operations grows with the number of bodies. In joint angles M is full, and sums of accelerations and forces that several
rows share become unknowns (`lifted`), so that it grows with their number, too. Either way γ'' is an expression of the
state, without numerical multipliers.
"""

import casadi as ca
import numpy as np

from servoctl.codegen.emit import operations
from servoctl.errors import SpecificationError
from servoctl.reduction.lifting import lifted
from servoctl.reduction.range_space import RangeSpace, applies
from servoctl.reduction.ranks import clean, eliminate

FEW = 8  # quasi-velocities: up to this number (3.18) takes about as few operations
SPARED = 0.95  # of the work of [M -B; G 0] below which the system with shared sums is taken
CLOSE = 1.1  # ratio of operations up to which the forms are compared after common terms are merged


def solve(equations, poles=False):
    """γ'' (n,), the multipliers μ (b,) and the list of pivots; `poles` adds the constraints' error dynamics."""
    r, q = equations.r, equations.q
    constraints = [a for a, row in enumerate(r.rows) if row.kind != "dynamics"]
    if isinstance(r.realisation, RangeSpace):
        rest = ca.substitute(r.balance, q.jet(2), ca.SX.zeros(q.n))
        second = ca.vertcat(ca.SX(0, 1), *equations.rest(constraints, poles))
        return r.realisation.solve(-rest, -second)
    system = matrix(equations)
    rest = ca.substitute(r.balance, q.jet(2), ca.SX.zeros(q.n))
    right = -ca.vertcat(rest, *equations.rest(constraints, poles))
    sums = system.shape[0] - right.shape[0]
    right, numbers = ca.vertcat(right, ca.SX(sums, 1)), clean(*r.points.matrix(system))
    solution, pivots = eliminate(system, right, numbers, in_order=sums > 0)
    reactions = slice(q.n, q.n + r.realisation.B.shape[1])
    return solution[: q.n], solution[reactions], pivots


def matrix(equations):
    """[M -B; G 0], or the same with shared sums as unknowns where that takes fewer operations, (n + b + k)² SX."""
    r, q = equations.r, equations.q
    constraints = [a for a, row in enumerate(r.rows) if row.kind != "dynamics"]
    reactions = ca.vertcat(-r.realisation.B, ca.SX(len(constraints), r.realisation.B.shape[1]))
    G = ca.vertcat(*(r.rows[a].gradient(q) for a in constraints))
    direct = ca.vertcat(r.mechanism.mass, G)
    raised = ca.vertcat(*(equations.levels[a][-1] for a in constraints))
    shared = lifted(ca.vertcat(r.balance, raised), q.jet(2))
    if shared is None or _work(shared) >= SPARED * _work(direct):
        return ca.horzcat(direct, reactions)
    reactions = ca.vertcat(reactions, ca.SX(shared.shape[0] - direct.shape[0], reactions.shape[1]))
    return ca.horzcat(shared[:, : q.n], reactions, shared[:, q.n :])


def _work(rows):
    """Operations that the entries of a matrix and its elimination without fill-in take, about."""
    entries = _instructions(ca.vertcat(ca.SX(0, 1), *rows.nonzeros()))
    return entries + int((np.bincount(rows.row()) ** 2).sum())


def accelerations(equations):
    """Outputs (γ'', μ) at a state: by (3.18) or by the sparse elimination, whichever takes fewer operations.

    Raises SpecificationError if the motion needs a derivative of the balance, or if its order is above 2.
    """
    r, q = equations.r, equations.q
    if not applies(r):
        raise SpecificationError(
            f"The motion has order {r.top} and {len(r.hidden)} hidden constraints.",
            "A state (q, γ') determines accelerations and multipliers if the program needs no derivative of the "
            "balance and its residuals have orders up to 2.",
            do="Simulate the motion: its run has both.",
            order=r.top,
            hidden=[row.name for row in r.hidden],
        )
    if equations.range_space or (q.n > FEW and not r.orthogonal):
        return equations.function("accelerations", equations.state, equations.saddle[:2])
    solution, acceleration = equations.dense(), q.jet(2)
    dense = ca.vertcat(solution, ca.substitute(r.multipliers, acceleration, solution))
    if r.orthogonal:
        return equations.function("accelerations", equations.state, [dense])
    few, many = sorted((ca.vertcat(*equations.saddle[:2]), dense), key=_instructions)
    near = _instructions(many) < CLOSE * _instructions(few)
    columns = (few, many) if near else (few,)
    functions = [equations.function("accelerations", equations.state, [y]) for y in columns]
    return min(functions, key=operations) if near else functions[0]


def _instructions(column):
    """Operations before common terms are merged."""
    return ca.Function("column", [], [column], {"allow_free": True}).n_instructions()
