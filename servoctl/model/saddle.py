"""Accelerations and multipliers together: one sparse elimination of the balance and the constraints.

The balance M γ'' + c = B μ and the constraints G γ'' + d = 0 have the matrix [M -B; G 0]. Elimination by T first gives
(3.18); pivots chosen by Markowitz counts over the whole matrix preserve the sparsity of many bodies, and the number of
operations grows with the number of bodies. Either way γ'' is an expression of the state, without numerical multipliers.
"""

import casadi as ca

from servoctl.codegen.emit import operations
from servoctl.errors import SpecificationError
from servoctl.reduction.definite import Definite
from servoctl.reduction.ranks import clean, eliminate

FEW = 8  # quasi-velocities: up to this number (3.18) takes about as few operations
CLOSE = 1.1  # ratio of operations up to which the forms are compared after common terms are merged


def applies(reduction):
    """Whether the balance and the constraints determine γ'': s̄ = 2, and no row of (3.18) is differentiated."""
    dynamics = [row for row in reduction.rows if row.kind == "dynamics"]
    return reduction.top == 2 and all(row.order == 2 and not row.story for row in dynamics)


def solve(equations, poles=False):
    """γ'' (n,), the multipliers μ (b,) and the list of pivots; `poles` adds the constraints' error dynamics."""
    r, q = equations.r, equations.q
    constraints = [a for a, row in enumerate(r.rows) if row.kind != "dynamics"]
    B, size = r.realisation.B, len(constraints)
    G = ca.vertcat(*(r.rows[a].gradient(q) for a in constraints))
    matrix = ca.vertcat(ca.horzcat(r.mechanism.mass, -B), ca.horzcat(G, ca.SX(size, B.shape[1])))
    acceleration = q.jet(2)
    rest = ca.substitute(r.balance, acceleration, ca.SX.zeros(q.n))
    second = ca.vertcat(ca.SX(0, 1), *equations.rest(constraints, poles))
    if isinstance(r.realisation, Definite):
        acceleration, mu, pivots = r.realisation.solve(-rest, -second)
        return acceleration, mu, [ca.sign(p) * ca.sqrt(ca.fabs(p)) for p in pivots]  # of the size of singular values
    right = -ca.vertcat(rest, second)
    solution, pivots = eliminate(matrix, right, clean(*r.points.matrix(matrix)))
    return solution[: q.n], solution[q.n :], pivots


def accelerations(equations):
    """Outputs (γ'', μ) at a state: by (3.18) or by the sparse elimination, whichever takes fewer operations.

    Raises
    ------
    SpecificationError
        If the motion needs a derivative of the balance, or its order is above 2.
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
    sparse = ca.vertcat(*equations.saddle[:2])
    if equations.sparse:
        return equations.function("accelerations", equations.state, [sparse])
    solution, acceleration = equations.dense(), q.jet(2)
    dense = ca.vertcat(solution, ca.substitute(r.multipliers, acceleration, solution))
    few, many = sorted((sparse, dense), key=_instructions)
    near = _instructions(many) < CLOSE * _instructions(few)
    columns = (few, many) if near else (few,)
    functions = [equations.function("accelerations", equations.state, [y]) for y in columns]
    return min(functions, key=operations) if near else functions[0]


def _instructions(column):
    """Operations before common terms are merged."""
    return ca.Function("column", [], [column], {"allow_free": True}).n_instructions()
