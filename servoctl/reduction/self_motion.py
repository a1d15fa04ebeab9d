"""Self-motion: what more actuators than residuals can move while the program holds, and whether it is damped at rest.

Deviations ν of velocities that all other rows allow, δγ' = N ν, obey (L_2 N) ν' = -(∂ψ_2/∂γ' N) ν at rest, with the
balances ψ_2 of order two and their leading matrix L_2. Coriolis terms are quadratic and vanish there; friction and
wishes that depend on velocities remain.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

from servoctl.reduction.ranks import clean, decide_each
from servoctl.values import frozen

DAMPED = 1e-9  # of the fastest rate of self-motion: slower decay is rounding


@frozen
class SelfMotion:
    """Self-motion of a program with open actuation, at rest.

    Attributes
    ----------
    velocities : int
        The number of its velocities.
    rate : float
        Largest real part of the eigenvalues of its velocities [1/s], over the points where ranks were decided; 0 where
        nothing damps one, NaN beside residuals above order 2, or where the program is singular at rest.
    """

    velocities: int
    rate: float

    @property
    def damped(self):
        """Whether all of its velocities decay at rest."""
        return self.rate < 0

    def __repr__(self):
        count = f"{self.velocities} velocit{'y' if self.velocities == 1 else 'ies'}"
        if np.isnan(self.rate):
            return f"self-motion of {count}"
        if not self.rate:
            return f"self-motion of {count}, undamped at rest"
        at_least = "decays with at least" if self.damped else "grows with up to"
        return f"self-motion of {count}, {at_least} {abs(self.rate):.3g} 1/s at rest"


def self_motion(reduction):
    """The self-motion that open actuation leaves, a `SelfMotion`; None if the program leaves none."""
    realised, q = reduction.realisation, reduction.mechanism.q
    if not realised.settled:
        return None
    count = len(realised.independent) - len(realised.unreached)
    if any(row.order > 2 for row in reduction.rows):
        return SelfMotion(count, np.nan)
    z = reduction.points.z.copy()
    z[q.nq :] = 0.0
    points = replace(reduction.points, z=z)
    free = [row for row in reduction.rows if row.kind == "dynamics" and row.order == 2]
    names = [row.name for row in free]
    held = [row.gradient(q) for row in reduction.rows if row.name not in names]
    L, D = [row.gradient(q) for row in free], [ca.jacobian(row.expression, q.jet(1)) for row in free]
    L, D, G = (np.moveaxis(clean(*points.matrix(ca.vertcat(ca.SX(0, q.n), *m))), 2, 0) for m in (L, D, held))
    regular = [p for p, rank in enumerate(decide_each(np.moveaxis(G, 0, 2))) if rank.rank == len(held)]
    L, D, G = (m[regular].astype(float) for m in (L, D, G))
    N = np.linalg.svd(G)[2][:, len(held) :].swapaxes(1, 2)
    rates = np.linalg.eigvals(-np.linalg.solve(L @ N, D @ N))
    if not rates.size:
        return SelfMotion(count, np.nan)
    slowest = float(rates.real.max())
    return SelfMotion(count, slowest if abs(slowest) > DAMPED * np.abs(rates).max(initial=0.0) else 0.0)
