"""Integrals of a program's rows: F of a residual ψ = D^k F + ρ(t), which loops compare with its values along a plan."""

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError
from servoctl.jets.identity import spread, vanish

SEED = 310  # of the jets at which an error shows by how much a stated F is wrong


def integrals(q, program):
    """F by row: those that are stated, and for rows of an order above 2 those that `q.dt` wrote."""
    found = {}
    for name, residual in program.residuals.items():
        F = program.stated.get(name) if q.order(residual) <= 2 else (program.integrals | program.stated).get(name)
        if F is not None and 0 <= q.order(F) <= min(2, q.order(residual) - 1):
            slopes = [slope for _, slope in _left(q, residual, F)]
            if not slopes or vanish(spread(slopes)).all():
                found[name] = F
    return found


def _left(q, residual, F):
    """Jets on which ψ - D^k F depends by its expression, and its slopes by them."""
    k = q.order(residual) - q.order(F)
    rest = residual - q.derivatives([F], k)[k][0]
    jets = [s for s in ca.symvar(rest) if q.is_jet(s)]
    slopes = ca.gradient(rest, ca.vertcat(ca.SX(0, 1), *jets))
    return [(jet, slopes[i]) for i, jet in enumerate(jets) if slopes[i].nnz() and not slopes[i].is_zero()]


def require_integrals(q, program):
    """Refuse stated integrals that are of no order below their residual's, up to 2, or do not give it."""
    valid = integrals(q, program)
    for name, F in program.stated.items():
        if name in valid:
            continue
        residual, order = program.residuals[name], q.order(F)
        if not 0 <= order <= min(2, q.order(residual) - 1):
            raise SpecificationError(
                f"The integral of {name!r} has order {order}, the residual {q.order(residual)}.",
                "F depends on the coordinates, has an order up to 2 and one below the residual's.",
                do=f"Leave it out, or write the residual as q.dt(F, k) and state integrals={{{name!r}: F}}.",
                name=name,
                order=order,
            )
        jets, slopes = zip(*_left(q, residual, F), strict=True)
        symbols = ca.symvar(ca.vertcat(*slopes, *jets))
        values = np.random.default_rng(SEED).uniform(0.5, 1.5, len(symbols)).round(2)
        off = np.ravel(ca.Function("off", [ca.vertcat(*symbols)], [ca.vertcat(*slopes)])(values))
        worst, k = int(np.argmax(np.abs(off))), q.order(residual) - order
        at = ", ".join(f"{s.name()} = {v:g}" for s, v in zip(symbols, values, strict=True))
        raise SpecificationError(
            f"The derivative of order {k} of the integral of {name!r} is not the residual: their difference has the "
            f"slope {off[worst]:.4g} by {jets[worst].name()} at {at[:300]}.",
            "ψ = D^k F + ρ(t): what they differ by is a function of time alone.",
            do=f"State another F, or leave {name!r} out of integrals and follow the plan by sv.lqr.",
            name=name,
            jet=jets[worst].name(),
            slope=float(off[worst]),
            at=dict(zip([s.name() for s in symbols], values.tolist(), strict=True)),
        )
