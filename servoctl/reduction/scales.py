"""Usual sizes of jets in the units of a specification: those by which the terms of each of its rows are alike.

The terms of a row change by c when a jet changes by its size. Sizes of coordinates s_i, of γ' by the time s_w / T, and
the time T itself are chosen so that log c is as equal as can be within each row, in the sense of least squares (Curtis
& Reid, J. Inst. Maths Applics 10 (1972) 118-124, with γ^(k) scaled by s_w / T^k).
"""

from math import log

import casadi as ca
import numpy as np

from servoctl.spec.references import Jets
from servoctl.values import frozen

ORDINARY = 100.0  # factor from 1 within which sizes of jets and of the time are taken as 1
WEAK = 0.3  # weight of the size 1 beside that of a term; a guessed size has the weight of a term
ROUNDS = 12  # of evaluation and least squares; each goes half the way, which converges for rows of any degree up to 3
ALIKE = log(3.0)  # change of a logarithm at which the rounds end
FELT = 1e-9  # a change below this fraction of the row is its rounding
SCALES_SEED = 1972
TERM_POINTS = 3  # points at which terms are compared


@frozen(eq=False)
class Scales:
    """Usual sizes of jets."""

    coordinates: np.ndarray  # (nq,)
    rates: np.ndarray  # (n,), sizes of γ' times `time`
    time: float = 1.0  # [s]

    @property
    def ordinary(self):
        """Whether all sizes are 1."""
        return self.time == 1.0 and np.all(self.coordinates == 1.0) and np.all(self.rates == 1.0)

    def jets(self, level):
        """Sizes (nq + level n,) of q and of the normalised Taylor coefficients γ_[k], k = 1..level."""
        return np.concatenate([self.coordinates, *(self.rates / self.time**k for k in range(1, level + 1))])


def usual(mechanism, program, guess, values, window, references):
    """The scales of a specification; sizes that are ordinary are 1.

    `guess` has values of jets by name, `values` (n_p,) are parameters, and `window` gives the window of times
    (t0, t1) [s] for a time scale; `references` (R,) are the sizes of these.
    """
    terms = _Terms(mechanism, program, values, references)
    if terms.f.has_free():
        return Scales(np.ones(mechanism.q.nq), np.ones(mechanism.q.n))
    wishes, weights = terms.wishes(guess)
    guessed = np.linalg.lstsq(weights, wishes, rcond=None)[0]
    logs = guessed.copy()
    for _ in range(ROUNDS):
        scales = terms.scales(logs)
        step = _balanced(terms.contributions(scales, window(scales.time)), terms.unknowns, logs, wishes, weights)
        logs += step / 2
        if np.abs(step).max() < ALIKE:
            break
    else:  # as of rows that fall with a power of the distance, along which no size is the last
        logs = guessed
    logs = np.where(np.abs(logs) < np.log(ORDINARY), 0.0, logs)
    return terms.scales(np.where(terms.bounded(logs, window), 0.0, logs))


class _Terms:
    """The rows of a specification as a function of their jets; the unknowns are logarithms of sizes, the time last.

    `unknowns` says what they add to the logarithm of each term: of a jet, of a constant, of the time.
    """

    def __init__(self, mechanism, program, values, references):
        q = self.q = mechanism.q
        rows = [*program.residuals.values(), *mechanism.constraints.values(), *mechanism.balance.elements()]
        rows = ca.vertcat(*rows, *q.invariants.values())
        self.level, self.values, motion = max(1, q.order(rows)), values, ca.SX(0, 1)
        if not q.plain:  # q' = V γ' + h are rows, too
            motion = ca.SX.sym("motion", q.nq)
            rows = ca.vertcat(rows, motion - q.V @ q.jet(1) - q.h)
        jets, sizes = Jets(q, [rows]), dict(zip(q.family.names, references, strict=True))
        rows = ca.substitute(rows, jets.symbols, ca.DM([sizes[name] * (k == 0) for name, k in jets.places]))
        self.names = [name for k in range(self.level + 1) for name in q.jet_names(k)]
        jets = ca.vertcat(*(q.jet(k) for k in range(self.level + 1)), motion)
        arguments = [q.t, jets, ca.vertcat(ca.SX(0, 1), *mechanism.parameters.symbols)]
        outputs = [ca.densify(rows), ca.densify(ca.jacobian(rows, q.t))]
        self.f = ca.Function("rows", arguments, outputs, {"allow_free": True})
        self.unknowns = self._unknowns(jets.numel())

    def _unknowns(self, jets):
        nq, n = self.q.nq, self.q.n
        first = 0 if self.q.plain else nq
        matrix = np.zeros((jets + 2, first + n + 1))
        matrix[:nq, :nq] = np.eye(nq)
        for k in range(1, self.level + 1):
            places = nq + (k - 1) * n + np.arange(n)
            matrix[places, first + np.arange(n)], matrix[places, -1] = 1.0, -k
        if not self.q.plain:
            matrix[jets - nq : jets, :nq], matrix[jets - nq : jets, -1] = np.eye(nq), -1.0
        matrix[-1, -1] = 1.0
        return matrix

    def scales(self, logs):
        """The scales of unknowns."""
        sizes, first = np.exp(logs), 0 if self.q.plain else self.q.nq
        return Scales(sizes[: self.q.nq], sizes[first : first + self.q.n], float(sizes[-1]))

    def wishes(self, guess):
        """Guessed logarithms of jets, and the combinations of unknowns that they are; size 1 with little weight."""
        known = [(a, np.log(abs(guess[name]))) for a, name in enumerate(self.names) if guess.get(name)]
        places = [a for a, _ in known]
        few = WEAK * np.eye(self.unknowns.shape[1])
        return np.append(np.zeros(len(few)), [log for _, log in known]), np.vstack([few, self.unknowns[places]])

    def contributions(self, scales, window):
        """Logarithms of the terms of each row (rows, terms), their mean over draws; NaN where there is none."""
        rng, jets = np.random.default_rng(SCALES_SEED), len(self.unknowns) - 2
        sizes = np.exp(self.unknowns[:jets] @ self._logs(scales))
        logs = np.log([self._terms(rng, sizes, window, scales.time) for _ in range(TERM_POINTS)])
        known = np.isfinite(logs)
        with np.errstate(all="ignore"):
            return np.where(known, logs, 0.0).sum(axis=0) / known.sum(axis=0)

    def bounded(self, logs, window):
        """For each unknown, whether it is the size of a coordinate that no row feels beyond 1, as of an angle."""
        result, large = np.zeros(len(logs), dtype=bool), np.flatnonzero(logs[: self.q.nq] > 0)
        for i in large:
            one = logs.copy()
            one[i] = 0.0
            here, there = (self.contributions(s, window(s.time))[:, i] for s in map(self.scales, (logs, one)))
            result[i] = not np.any(here - there > logs[i] / 2)
        return result

    def _logs(self, scales):
        parts = [scales.coordinates] if self.q.plain else [scales.coordinates, scales.rates]
        return np.log(np.concatenate([*parts, [scales.time]]))

    def _terms(self, rng, sizes, window, time):
        """Sizes of the terms of each row about a random point at rest, NaN for those that are not felt.

        In motion every coordinate would change inertia forces, and what sets the time would not be seen. A row without
        a value at rest has its terms in motion.
        """
        point, other = rng.choice([-1.0, 1.0], len(sizes)) * rng.uniform(0.5, 1.5, (2, len(sizes))) * sizes
        t, at_rest = rng.uniform(*window), np.where(np.arange(len(sizes)) < self.q.nq, point, 0.0)
        still, moving = (self._changes(t, p, other, time) for p in (at_rest, point))
        return np.where(np.isfinite(still).any(axis=1, keepdims=True), still, moving)

    def _changes(self, t, point, other, time):
        """Changes of the rows at a point, each jet alone becoming another one; their values at zero; change in time."""
        jets = np.where(np.eye(len(point), dtype=bool), other, point[:, None])
        rows, slopes = (y.full() for y in self.f(t, np.column_stack([jets, point, 0.0 * point]), self.values))
        here = rows[:, [-2]]
        changes = np.abs(rows[:, :-2] - here)
        changes[~(changes > FELT * np.abs(here))] = np.nan
        terms = np.column_stack([changes, np.abs(rows[:, -1]), np.abs(slopes[:, -2]) * time])
        return np.where(np.isfinite(terms) & (terms > 0), terms, np.nan)


def _balanced(terms, unknowns, logs, wishes, weights):
    """The change of the unknowns that makes the terms of each row most alike."""
    matrix, right = [weights], [wishes - weights @ logs]
    for row in terms:
        felt = np.flatnonzero(np.isfinite(row))
        if len(felt) > 1:
            matrix.append(unknowns[felt] - unknowns[felt].mean(axis=0))
            right.append(row[felt].mean() - row[felt])
    return np.linalg.lstsq(np.vstack(matrix), np.concatenate(right), rcond=None)[0]
