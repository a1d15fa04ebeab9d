"""The servo DAE itself, as the literature integrates it: balance with the unknown forces, and the constraints."""

import casadi as ca

from servoctl.errors import SpecificationError
from servoctl.reduction.elimination import eliminate
from servoctl.reduction.ranks import clean, decide_all


def servo_dae(equations, form):
    """Residual and Jacobian of one implicit step on the servo DAE.

    Unknowns are z = (q, γ', μ) with the multipliers μ of the reaction B μ: the inputs u where actuators realise the
    program without redundancy. Rates are those of a linear multistep formula, q̇ = α q + s_q and γ̈ = α γ' + s_γ.

    "servo" is the DAE as it stands, q̇ = V γ' + h, r(t, q, γ', γ̈) = B μ, φ = 0: of index 5 where the essential order
    is 4. "projected" is that of Blajer and Kołodziejczyk (2004), of lower index: the balance on ker C only, and
    φ̈ = 0 with the accelerations of the plant, C M⁻¹(B μ - r₀) + ξ = 0, beside φ = 0.

    Parameters
    ----------
    equations : Equations
    form : {"servo", "projected"}

    Returns
    -------
    casadi.Function
        Of t, z (nq + n + b) and (p, α, s_q, s_γ); outputs the residual and its Jacobian in z, column by column.

    Raises
    ------
    SpecificationError
        If a residual holds derivatives above velocities: such a program is no DAE in these unknowns.
    """
    r, q = equations.r, equations.q
    rows = list(r.given.values())
    high = [row.name for row in rows if row.order > 1]
    if high:
        raise SpecificationError(
            f"The program's {', '.join(high)} holds derivatives of order 2 or higher.",
            "The servo DAE has coordinates, velocities and forces as unknowns.",
            nearest="A program on coordinates and velocities.",
            do="Compare by tradeoff(...) instead.",
        )
    B = r.realisation.B
    velocity, acceleration = ca.vertcat(*q.gamma(1)), ca.vertcat(*q.gamma(2))
    mu, alpha = ca.SX.sym("mu", B.shape[1]), ca.SX.sym("alpha")
    past_q, past_v = ca.SX.sym("past_q", q.nq), ca.SX.sym("past_v", q.n)
    balance = _projected(equations, rows, mu) if form == "projected" else r.mechanism.balance - B @ mu
    moving = alpha * ca.vertcat(*q) + past_q - q.V @ velocity - q.h
    residual = ca.vertcat(moving, balance, *(row.expression for row in rows))
    residual = ca.substitute(residual, acceleration, alpha * velocity + past_v)
    z = ca.vertcat(*q, velocity, mu)
    jacobian = ca.vec(ca.densify(ca.jacobian(residual, z)))
    return equations.function(f"servo_dae_{form}", z, [residual, jacobian], ca.vertcat(alpha, past_q, past_v))


def _projected(equations, rows, mu):
    """Dᵀ(r - B μ) with C D = 0, and φ̈ with the accelerations of the plant."""
    r, q = equations.r, equations.q
    acceleration, zero = ca.vertcat(*q.gamma(2)), ca.SX.zeros(q.n)
    second = ca.vertcat(*(q.derivatives([row.expression], 2 - row.order)[-1][0] for row in rows))
    C = ca.jacobian(second, acceleration)
    numbers, sizes = r.points.matrix(C)
    numbers = clean(numbers, sizes)
    dependent = sorted(decide_all(*r.points.matrix(C))[0].columns)
    independent = [i for i in range(q.n) if i not in dependent]
    unbalanced = r.mechanism.balance - r.realisation.B @ mu
    A = eliminate(C[:, dependent], -C[:, independent], numbers[:, dependent])[0]
    free = unbalanced[independent] + A.T @ unbalanced[dependent]
    mass = r.mechanism.mass
    force = -ca.substitute(unbalanced, acceleration, zero)
    plant = eliminate(mass, force, clean(*r.points.matrix(mass)))[0]
    return ca.vertcat(free, ca.substitute(second, acceleration, plant))


SERVO_DAE = {
    "servo_dae": lambda e: (servo_dae(e, "servo"),),
    "servo_dae_projected": lambda e: (servo_dae(e, "projected"),),
}
"""The model's functions by name, one for each form."""
