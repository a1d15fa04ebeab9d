"""Where a machine stands still under a program: one search, whoever asks for it.

At rest γ' = γ'' = ... = 0, and ψ(t, q, μ) = [r - B μ; constraints; residuals] vanishes with forces μ that hold the
machine. The search begins where the actuators alone bring the machine from its guess to the program, and at other
angles. Distances are those of the kinetic energy. Of several rests the one nearest to the guess is taken; then the one
with the smallest angles, as the zero of a length means nothing; then the one in which the machine hangs lowest.
"""

import casadi as ca
import numpy as np

from servoctl.codegen.paths import arguments
from servoctl.reduction.rows import Row
from servoctl.spec.references import function_of, orders_in
from servoctl.tolerances import ENTRY, TINY

NEWTON = 25  # steps
MET = 1e-9  # largest row at a rest, relative to its slopes times the state
RANK = 1e-8  # singular values below this fraction of the largest count as zero
UNDECIDED = 1e-3  # difference of two rests, or of their distances relative to these, that decides nothing
GUESSED = 1e3  # weight of a guessed value relative to one without a guess


class Rests:
    """The rests of a mechanism under a balance r (n,), directions B of what holds it, and expressions by name.

    Expressions of the coordinates are rows: those of velocities say nothing of where a machine stands.
    p are the numbers of the mechanism's parameters, z = [q; μ].
    """

    def __init__(self, mechanism, balance, B, rows, references=()):
        q = mechanism.q
        rows = {name: e for name, e in (rows | mechanism.followers).items() if q.order(e) <= 0}
        self.coordinates, self.nq, self.n, self.references = q.names, q.nq, q.n, references
        self.zero = {name: q.identity.get(name, 0.0) for name in q.names}
        self.names = (*(f"balance of {name}" for name in q.force_names), *rows)
        mu, p = ca.SX.sym("mu", B.shape[1]), ca.vertcat(*mechanism.parameters.symbols)
        z = ca.vertcat(q.jet(0), mu)
        still = _still(q, ca.vertcat(balance - B @ mu, *rows.values()))
        moving = {f"rate of {name}": h for name, h in zip(q.names, q.h.elements(), strict=True) if not h.is_zero()}
        rows = ca.vertcat(still, *q.invariants.values(), *moving.values())
        self.names += (*q.invariants, *moving)
        parts = map(ca.densify, (rows, ca.jacobian(rows, z)))
        self.function = function_of(q, references, "rest", z, p, *parts)
        self._frame = frame(mechanism, references)

    @classmethod
    def of_model(cls, model):
        """Those under the balance and the actuation of a model."""
        r = model.reduction
        rows = {row.name: row.expression for row in r.original.values()}
        return cls(r.mechanism, r.balance, r.realisation.B, rows, r.references)

    @classmethod
    def of_program(cls, mechanism, forces, program):
        """Those with any actuation, under further forces (n,), of rows that can hold at rest."""
        q, material = mechanism.q, mechanism.constraints
        B = ca.horzcat(
            mechanism.E, *(Row(e, max(q.order(e), 0), name, "material").gradient(q).T for name, e in material.items())
        )
        rows, balance = {**material, **program.residuals}, mechanism.balance - forces
        return cls(mechanism, balance, B, rows, tuple(orders_in(q, [balance, B, *rows.values()])))

    def measured(self, t, z, p):
        """The rows (e,) at [q; μ], their slopes (e, z) and the rows relative to these and to the state."""
        rows, slopes = (np.array(part) for part in self.function(*arguments(self.function, t, z, p)))
        return rows[:, 0], slopes, np.abs(rows[:, 0]) / np.maximum(np.abs(slopes) @ (1.0 + np.abs(z)), TINY)

    def reached(self, t, p, q, movable=None, weights=None, some=slice(None), angles=None):
        """[q; μ] nearest to a rest by Newton's least weighted steps, whether it is one, and its worst row.

        Only some coordinates are movable, only some rows need to vanish, and a step turns angles by a radian at most.
        """
        movable, weights = np.ones(self.nq, bool) if movable is None else movable, 1.0 if weights is None else weights
        z, weights = np.concatenate([q, np.zeros(self.function.size1_in(1) - self.nq)]), weights * np.ones(self.nq)
        best, least = z, np.inf
        for _ in range(NEWTON):
            rows, slopes, off = (part[some] for part in self.measured(t, z, p))
            largest = float(np.nan_to_num(off, nan=np.inf).max(initial=0.0))
            if not np.isfinite(slopes).all() or largest >= least <= MET:
                break
            best, least = (z, largest) if largest < least else (best, least)
            last, z = z, z + self._step(rows, slopes, movable, weights, movable & False if angles is None else angles)
            if np.all(np.abs(z - last) <= ENTRY * (1.0 + np.abs(last))):  # no step leads on
                best = z if best is last else best
                break
        rows, _, off = (part[some] for part in self.measured(t, best, p))
        if not len(rows):
            return best, True, None
        worst = int(np.argmax(np.nan_to_num(off, nan=np.inf)))
        return best, least <= MET, (self.names[np.arange(len(self.names))[some][worst]], float(rows[worst]))

    def _step(self, rows, slopes, movable, weights, angles):
        """The least weighted step of the coordinates that the rows ask for, whatever the forces, and these forces.

        Weights choose among steps, and decide no rank.
        """
        sizes = np.maximum(np.abs(slopes).max(axis=1), TINY)[:, None]
        of_q, of_mu = np.split(slopes / sizes, [self.nq], axis=1)
        left, singular, _ = np.linalg.svd(of_mu)
        unforced = left[:, np.sum(singular > RANK * singular.max(initial=0.0)) :].T
        step, right = np.zeros(slopes.shape[1]), -rows / sizes[:, 0]
        columns, weights = (unforced @ of_q)[:, movable], weights[movable]
        columns = np.where(np.abs(columns) > ENTRY, columns, 0.0)
        largest = np.maximum(np.abs(columns).max(axis=0, initial=0.0), TINY)
        rank = np.linalg.lstsq(columns / largest, unforced @ right, rcond=RANK)[2] if columns.size else 0
        U, singular, V = np.linalg.svd(columns / weights, full_matrices=False)
        step[: self.nq][movable] = V[:rank].T @ ((U[:, :rank].T @ unforced @ right) / singular[:rank]) / weights
        step /= max(1.0, np.abs(step[: self.nq][angles]).max(initial=0.0))  # a radian at most
        step[self.nq :] = np.linalg.lstsq(of_mu, right - of_q @ step[: self.nq], rcond=RANK)[0]
        return step

    def nearest(self, t, p, guess, fixed=()):
        """Rests [q; μ], first the one to take and then those that the guess excludes no better, and the worst row.

        `guess` has values of coordinates by name, `fixed` are the names of those that stay.
        """
        first = np.array([guess.get(name, zero) for name, zero in self.zero.items()], dtype=float)
        known, movable = np.isin(self.coordinates, list(guess)), ~np.isin(self.coordinates, list(fixed))
        angles, sizes = self.angles(t, p, first), next(roots_of_inertia(self._frame, t, first, p))
        found, reason, weights = [], None, sizes * np.where(known, GUESSED, 1.0)
        balanced = self.reached(t, p, first, movable & ~known, sizes, slice(self.n), angles)[0][: self.nq]
        starts = (first,) if np.array_equal(balanced, first) else (first, balanced)
        for turned in self._turns(angles & movable):
            if found and 0.5 in np.abs(turned):
                break
            for start in starts:
                q = self._met(t, p, start + turned * np.pi, known, movable, angles, sizes)
                z, rests, worst = self.reached(t, p, q, movable, weights, angles=angles)
                reason = reason or worst
                if rests and not any(self._alike(z, other, angles) for other in found):
                    z[: self.nq] += angles * 2 * np.pi * np.round((first - z[: self.nq]) / (2 * np.pi))
                    found.append(z)
        return self._ordered(t, p, found, first, known, angles, sizes), reason

    @staticmethod
    def _turns(angles):
        """By how many half turns angles are turned: none, each, all, and where no rest was found all by a quarter."""
        yield 0.0 * angles
        if angles.any():
            yield from np.eye(len(angles))[angles]
            yield from (k * angles for k in (*([1.0] if angles.sum() > 1 else []), 0.5, -0.5))

    def _alike(self, z, other, angles):
        """Whether rests differ by full turns only."""
        apart = (z - other)[: self.nq]
        apart -= angles * 2 * np.pi * np.round(apart / (2 * np.pi))
        return bool(np.all(np.abs(apart) <= UNDECIDED * (1.0 + np.abs(other[: self.nq]))))

    def angles(self, t, p, q):
        """Coordinates that a full turn leaves as they are, and another change does not."""
        z = np.random.default_rng(0).uniform(-1.0, 1.0, self.function.size1_in(1))
        z[: self.nq] += q
        turns = np.eye(len(z))[: self.nq] * 2 * np.pi
        changed = [[self.measured(t, z + part * turn, p)[0] for turn in turns] for part in (0.0, 1.0, 0.1)]
        whole, other = (np.abs(np.subtract(some, changed[0])).max(axis=1, initial=0.0) for some in changed[1:])
        return whole < UNDECIDED * other

    def _met(self, t, p, q, known, movable, angles, sizes):
        """q on the constraints and the program by what nobody guessed, driven lengths first, at last by anything."""
        V, _, E = (np.array(part) for part in self._frame(*arguments(self._frame, t, q, p)))
        driven, lengths, first = np.abs(V @ E).max(axis=1, initial=0.0) > 0, ~angles, q
        for some in (driven & lengths & ~known, lengths & ~known, driven & ~known, ~known, movable):
            near = q if some is movable else first
            z, there, _ = self.reached(t, p, near, movable & some, sizes, slice(self.n, None), angles)
            q = z[: self.nq]
            if there:
                break
        return q

    def _ordered(self, t, p, found, first, known, angles, sizes):
        """The rest to take, and others that are as near to the guess."""
        if not found:
            return []
        away = [(z[: self.nq] - first) * sizes for z in found]
        lists = [[np.linalg.norm(a[some]) for a in away] for some in (known, angles & ~known, ~known)]
        guessed, turned, far = map(np.array, lists)
        near = np.flatnonzero(_smallest(guessed))
        left = near[_smallest(turned[near])]
        heights, terms = np.transpose([(0.0, 0.0), *(self._lifted(t, p, found[left[0]], found[i]) for i in left[1:])])
        left = left[_smallest(heights, terms.max())]
        left = left[_smallest(far[left])]
        return [found[left[0]], *(found[i] for i in near if i != left[0])]

    def _lifted(self, t, p, one, other):
        """The potential energy of a state above that of another, by the work of the forces at rest, and its terms."""
        way, works = (other - one)[: self.nq], []
        for at, weight in zip(*np.polynomial.legendre.leggauss(NEWTON // 2), strict=True):
            z = np.concatenate([one[: self.nq] + 0.5 * (1 + at) * way, np.zeros(len(one) - self.nq)])
            V = np.array(self._frame(*arguments(self._frame, t, z[: self.nq], p))[0])
            works.append(0.5 * weight * (self.measured(t, z, p)[0][: self.n] * (np.linalg.pinv(V) @ way)))
        return np.sum(works), np.abs(works).sum()


def frame(mechanism, references):
    """V, the inertia and the directions of the actuators at rest, a CasADi function of t, q and parameters."""
    q, p = mechanism.q, ca.vertcat(*mechanism.parameters.symbols)
    parts = [ca.densify(_still(q, e)) for e in (ca.SX(q.V), mechanism.mass, mechanism.E)]
    return function_of(q, references, "frame", q.jet(0), p, *parts)


def roots_of_inertia(frame, t, q, p):
    """The roots of the inertias of coordinates and of velocities at q (nq,), for want of inertia the least of them."""
    V, M, _ = (np.array(part) for part in frame(*arguments(frame, t, q, p)))
    inverse = np.linalg.pinv(V) if np.isfinite(V).all() else np.nan * V.T
    for inertia in (inverse.T @ M @ inverse, M):
        with np.errstate(all="ignore"):
            roots = np.sqrt(np.diag(inertia))
        heavy = np.isfinite(roots) & (roots > 0)
        yield np.where(heavy, roots, roots[heavy].min(initial=np.inf) if heavy.any() else 1.0)


def _smallest(values, size=0.0):
    """Which values are the least, but for what decides nothing; a `size` of their terms."""
    values = np.nan_to_num(values, nan=np.inf)  # of guesses beyond what can be squared none is nearer
    return values - values.min() <= UNDECIDED * max(np.abs(values).max(), size)


def _still(q, expressions):
    """Expressions with all rates zero."""
    places = [(s, q.where(s) or ("t", 0, 0)) for s in ca.symvar(expressions)]
    rates = [s for s, (kind, level, _) in places if kind == "w" or (kind == "r" and level > 0)]
    return ca.substitute(expressions, ca.vertcat(*rates), ca.SX.zeros(len(rates))) if rates else expressions
