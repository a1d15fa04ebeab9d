"""Integrals of a program's rows: F of a residual ψ = D^k F + ρ(t), which loops compare with its values along a plan."""

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError
from servoctl.jets.identity import spread, vanish


def integrals(q, program):
    """F by row: those that are stated, and for rows of an order above 2 those that `q.dt` wrote."""
    found = {}
    for name, residual in program.residuals.items():
        order = q.order(residual)
        F = program.integrals.get(name) if order > 2 or name in program.stated else None
        if F is not None and 0 <= q.order(F) <= min(2, order - 1) and not _left(q, residual, F):
            found[name] = F
    return found


def _left(q, residual, F):
    """Jets on which ψ - D^k F depends, and its slopes by them."""
    k = q.order(residual) - q.order(F)
    rest = residual - q.derivatives([F], k)[k][0]
    jets = [s for s in ca.symvar(rest) if q.is_jet(s)]
    slopes = ca.densify(ca.gradient(rest, ca.vertcat(*jets))).elements() if jets else []
    zeros = vanish(spread(slopes)) if jets else []
    return [pair for *pair, zero in zip(jets, slopes, zeros, strict=True) if not zero]


def require_integrals(q, program):
    """Refuse stated integrals that are of no order below their residual's, up to 2, or do not give it."""
    for name, F in ((name, program.integrals[name]) for name in program.stated):
        residual, order = program.residuals[name], q.order(F)
        if not 0 <= order <= min(2, q.order(residual) - 1):
            has = f"has order {order}, the residual {q.order(residual)}" if order >= 0 else "depends on no coordinates"
            raise SpecificationError(
                f"The integral of {name!r} {has}.",
                "F depends on the coordinates, has an order up to 2 and one below the residual's.",
                do=f"Leave it out, or write the residual as q.dt(F, k) and state integrals={{{name!r}: F}}.",
                name=name,
                order=order,
            )
        if left := _left(q, residual, F):
            jets, slopes = (ca.vertcat(*part) for part in zip(*left, strict=True))
            symbols = sorted(ca.symvar(ca.vertcat(slopes, jets)), key=q.order)
            values = np.linspace(0.5, 1.5, len(symbols)).round(2)
            off = np.ravel(ca.Function("off", [ca.vertcat(*symbols)], [slopes])(values))
            worst = int(np.argmax(np.abs(off)))
            at = {s.name(): float(value) for s, value in zip(symbols, values, strict=True)}
            raise SpecificationError(
                f"The derivative of order {q.order(residual) - order} of the integral of {name!r} is not the residual: "
                f"their difference has the slope {off[worst]:.4g} by {jets[worst].name()} at {str(at)[:300]}.",
                "ψ = D^k F + ρ(t): what they differ by is a function of time alone.",
                do=f"State another F, or leave {name!r} out of integrals and follow the plan by sv.lqr.",
                name=name,
                jet=jets[worst].name(),
                slope=float(off[worst]),
                at=at,
            )
