"""Rests of a plant at which a program is met, by Newton's method."""

import casadi as ca
import numpy as np

STEPS, RESTS = 60, 1e-9  # of Newton's method; largest residual, relative to its slope times the state
RANK = 1e-8  # of the equations of a rest: smallest singular value relative to the largest


class Equilibria:
    """States with γ' = 0, γ'' = 0, on the material constraints, at which residuals of order 0 vanish.

    Parameters
    ----------
    plant : Plant
        Whose inputs act at once.
    program : Program
    node : Node
    """

    def __init__(self, plant, program, node):
        q, e = node.q, plant.equations
        still = ca.vertcat(*q.gamma(1))
        rows = dict(zip(q.jet_names(2), node.acceleration.elements(), strict=True))
        rows |= {name: node.known(c) for name, c in plant.mechanism.constraints.items() if q.order(c) == 0}
        rows |= {name: node.known(c) for name, c in q.invariants.items()}
        self.program = [name for name, c in program.residuals.items() if q.order(c) <= 0]
        rows |= {name: node.known(program.residuals[name]) for name in self.program}
        self.names, self.coordinates = tuple(rows), tuple(q.names)
        unknowns = ca.vertcat(*q, e.u)
        values = ca.substitute(ca.vertcat(*rows.values()), still, ca.SX.zeros(still.numel()))
        self.rows = ca.Function("rest", [q.t, ca.vertcat(*q), e.u], [values])
        outputs = [ca.densify(values), ca.densify(ca.jacobian(values, unknowns))]
        self._values = ca.Function("rest", [q.t, unknowns], outputs)
        self.nq = q.nq

    def at(self, t, q, u, fixed=(), without=()):
        """The rest (q, u) that Newton's method reaches with some coordinates (indices) fixed; None if there is none.

        `without` are names of rows that need not vanish. The second value is the largest violation (row, value).
        """
        z = np.concatenate([q, u]).astype(float)
        rows = [i for i, name in enumerate(self.names) if name not in without]
        free = np.setdiff1d(np.arange(len(z)), fixed)
        for _ in range(STEPS):
            values, slopes, off = self._measured(t, z, rows)
            if not np.isfinite(off).all() or off.max(initial=0.0) <= RESTS**1.3:
                break
            z[free] -= np.linalg.lstsq(slopes[:, free], values, rcond=RANK)[0]
        values, _, off = self._measured(t, z, rows)
        worst = int(np.argmax(np.nan_to_num(off, nan=np.inf)))
        found = bool(off.max(initial=0.0) <= RESTS)
        return (z[: self.nq], z[self.nq :]) if found else None, (self.names[rows[worst]], float(values[worst]))

    def _measured(self, t, z, rows):
        values, slopes = (np.array(part) for part in self._values(t, z))
        values, slopes = values.ravel()[rows], slopes[rows]
        return values, slopes, np.abs(values) / np.maximum(np.abs(slopes) @ (1.0 + np.abs(z)), 1e-300)

    def along(self, times, q, u):
        """Rests (nq + m, N) at frozen instants, each from the one before; NaN where there is none."""
        found = np.full((len(q) + len(u), len(times)), np.nan)
        for k, t in enumerate(times):
            rest, _ = self.at(t, q, u)
            if rest is not None:
                q, u = rest
                found[:, k] = np.concatenate(rest)
        return found

    def slopes(self, t, q, u):
        """The Jacobian of all rows in (q, u)."""
        return np.array(self._values(t, np.concatenate([q, u]))[1])
