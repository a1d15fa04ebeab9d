"""Accelerations and multipliers together: one sparse elimination of the balance and the constraints.

The balance M γ'' + c = B μ and the constraints G γ'' + d = 0 form the matrix [M -B; G 0]. Eliminated by T first it is
(3.18); pivots chosen by Markowitz counts over all of it keep the sparsity of many bodies, and the operations grow with
their number. No multiplier is introduced numerically: γ'' is an expression of the state either way.
"""

import casadi as ca

from servoctl.codegen.emit import operations
from servoctl.errors import SpecificationError
from servoctl.reduction.ranks import clean, eliminate

FEW = 8  # quasi-velocities: up to here (3.18) takes about as few operations
CLOSE = 1.1  # times as many operations: up to here merging of common terms decides which are fewer


def applies(reduction):
    """Whether γ'' follows from the balance and the constraints as they are: s̄ = 2, no row of (3.18) differentiated.

    Parameters
    ----------
    reduction : Reduction

    Returns
    -------
    bool
    """
    dynamics = [row for row in reduction.rows if row.kind == "dynamics"]
    return reduction.top == 2 and all(row.order == 2 and not row.story for row in dynamics)


def solve(equations, poles=False):
    """γ'', the multipliers μ, and the pivots divided by.

    Parameters
    ----------
    equations : Equations
    poles : bool
        With the error dynamics of the constraints.

    Returns
    -------
    accelerations : (n,) SX
    multipliers : (b,) SX
    pivots : list of SX scalars
    """
    r, q = equations.r, equations.q
    constraints = [a for a, row in enumerate(r.rows) if row.kind != "dynamics"]
    B, size = r.realisation.B, len(constraints)
    G = ca.vertcat(*(r.rows[a].gradient(q) for a in constraints))
    matrix = ca.vertcat(ca.horzcat(r.mechanism.mass, -B), ca.horzcat(G, ca.SX(size, B.shape[1])))
    acceleration = q.jet(2)
    rest = ca.substitute(r.mechanism.balance, acceleration, ca.SX.zeros(q.n))
    right = -ca.vertcat(rest, *equations.rest(constraints, poles))
    solution, pivots = eliminate(matrix, right, clean(*r.points.matrix(matrix)))
    return solution[: q.n], solution[q.n :], pivots


def accelerations(equations):
    """Outputs (γ'', μ) at a state: by (3.18) or by the sparse elimination, whichever takes fewer operations.

    Raises
    ------
    SpecificationError
        If the motion needs the balance differentiated, or has an order above 2.
    """
    r, q = equations.r, equations.q
    if not applies(r):
        raise SpecificationError(
            f"The motion has order {r.top} and {len(r.hidden)} hidden constraints.",
            "Accelerations and multipliers follow from a state (q, γ') where the program needs no derivative of the "
            "balance and its residuals have orders up to 2.",
            do="Simulate it; a run has both.",
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
    """Operations of a column whose common terms are not yet merged."""
    return ca.Function("column", [], [column], {"allow_free": True}).n_instructions()
