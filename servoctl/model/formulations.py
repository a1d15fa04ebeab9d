"""One motion in several formulations, to compare what they cost: without multipliers (3.18), and with them."""

import casadi as ca

from servoctl.errors import SpecificationError
from servoctl.model import saddle


def formulation(equations, how, forces):
    """γ'' at a state, with the multipliers if `forces`, in one formulation.

    Parameters
    ----------
    equations : Equations
    how : {"eliminated", "sparse", "qr"}
        (3.18) with the constraints, multipliers afterwards from r_D = B_D μ; the matrix [M -B; G 0] of accelerations
        and multipliers by sparse symbolic elimination; the same matrix by CasADi's `solve`, a dense QR factorisation.
    forces : bool
        Whether the multipliers are asked for: where they are not, what only they need is left out.

    Returns
    -------
    casadi.Function
        Of (t, X, p); outputs γ'', and μ.

    Raises
    ------
    SpecificationError
        If accelerations do not follow from a state.
    """
    r, q = equations.r, equations.q
    if not saddle.applies(r):
        raise SpecificationError(
            f"The program leads to a motion of order {r.top} with {len(r.hidden)} hidden constraints.",
            "Formulations are compared where the balance itself, with the constraints, gives the accelerations.",
            do="Give a program of order 2 or less without hidden constraints.",
        )
    acceleration = ca.vertcat(*q.gamma(2))
    if how == "eliminated":
        solution = equations.dense()
        multipliers = ca.substitute(r.multipliers, acceleration, solution) if forces else ca.SX(0, 1)
    elif how == "sparse":
        solution, multipliers, _ = saddle.solve(equations)
    else:
        matrix, right = _multiplier_form(equations)
        both = ca.solve(matrix, right)
        solution, multipliers = both[: q.n], both[q.n :]
    outputs = [solution, multipliers] if forces else [solution]
    name = f"formulation_{how}{'_forces' if forces else ''}"
    return equations.function(name, equations.state, outputs)


def assembly(equations):
    """Matrix, column by column, and right side of [M -B; G 0] [γ''; μ], for a dense numerical solution.

    Parameters
    ----------
    equations : Equations

    Returns
    -------
    casadi.Function
        Of (t, X, p).
    """
    matrix, right = _multiplier_form(equations)
    return equations.function("formulation_assembly", equations.state, [ca.vec(ca.densify(matrix)), right])


def _multiplier_form(equations):
    r, q = equations.r, equations.q
    rows = [a for a, row in enumerate(r.rows) if row.kind != "dynamics"]
    acceleration, B = ca.vertcat(*q.gamma(2)), r.realisation.B
    G = ca.jacobian(ca.vertcat(*(equations.levels[a][-1] for a in rows)), acceleration)
    matrix = ca.vertcat(ca.horzcat(r.mechanism.mass, -B), ca.horzcat(G, ca.SX(len(rows), B.shape[1])))
    balance = ca.substitute(r.mechanism.balance, acceleration, ca.SX.zeros(q.n))
    return matrix, -ca.vertcat(balance, *equations.rest(rows))


FORMULATIONS = {
    f"formulation_{how}{suffix}": lambda e, how=how, suffix=suffix: (formulation(e, how, bool(suffix)),)
    for how in ("eliminated", "sparse", "qr")
    for suffix in ("", "_forces")
} | {"formulation_assembly": lambda e: (assembly(e),)}
"""The model's functions by name: each how, its multipliers as well ("_forces"), and the assembled matrix."""
