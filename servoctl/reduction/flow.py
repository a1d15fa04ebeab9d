"""Rows along a motion: their Taylor coefficients, and how these answer to the coefficients of the jets."""

from copy import copy
from math import factorial

import casadi as ca
import numpy as np

from servoctl.spec.taylor import Series, Tape

REAL = np.longdouble


class Flow:
    """Rows along a motion: Taylor coefficients of the residuals, and their Jacobian in the jets.

    Parameters
    ----------
    q : Coordinates
    rows : list of (expression, order) pairs
        Each contributes its coefficients 0 .. level - order.
    level : int
        Highest level K of the jets.
    points : Points
        Only its parameters and their values are used here.
    signals : dict, optional
        Taylor coefficients of further symbols along the motion, by element hash: lists of (N,) arrays.
    real : type
        Of the Jacobian; double precision is enough for Newton's method.
    """

    def __init__(self, q, rows, level, points, signals=None, real=float):
        self.q, self.level, self.points, self.signals, self.real = q, level, points, signals or {}, real
        self.equations = [(a, i) for a, (_, order) in enumerate(rows) for i in range(level - order + 1)]
        self.levels = np.array([rows[a][1] + i for a, i in self.equations], dtype=int)
        self.first = np.cumsum([0, *(max(level - order + 1, 0) for _, order in rows)])
        self.rows, self._made = rows, {}  # tapes, read when they are first needed
        self.members = {
            order: np.array([a for a, (_, o) in enumerate(rows) if o == order], dtype=int)
            for order in sorted({order for _, order in rows if order <= level})
        }
        if not q.plain:
            moving = q.V @ ca.vertcat(*q.gamma(1)) + q.h
            parts = [ca.densify(ca.jacobian(moving, ca.vertcat(*q))), ca.densify(q.V)]
            self.motion = self._tape([], 0, moving.elements(), parts)

    def at(self, points):
        """The same rows with the parameters of other points; what was read of the rows is shared."""
        flow = copy(self)
        flow.points = points
        return flow

    @property
    def groups(self):
        """For each order its rows with their gradients in q and all jets."""
        if "groups" not in self._made:
            self._made["groups"] = [self._group(order, range(order + 1)) for order in self.members]
        return self._made["groups"]

    @property
    def bare(self):
        """For each order its rows alone."""
        if "bare" not in self._made:
            self._made["bare"] = [self._group(order, []) for order in self.members]
        return self._made["bare"]

    def _group(self, order, levels):
        expressions = [self.rows[a][0] for a in self.members[order]]
        column = ca.vertcat(*expressions)
        parts = [ca.jacobian(column, ca.vertcat(*(self.q.gamma(m) if m else self.q))) for m in levels]
        return self._tape(self.members[order], order, expressions, parts)

    def leading(self, order, level):
        """Rows of an order with their gradients in γ^(order), or in q itself for level 0."""
        in_q = order == 0 and (level == 0 or self.q.plain)
        if (order, in_q) not in self._made:
            group = self._group(order, [order])
            if order == 0 and not in_q:
                expressions = [self.rows[a][0] for a in self.members[0]]
                slopes = ca.jacobian(ca.vertcat(*expressions), ca.vertcat(*self.q)) @ self.q.V
                group = self._tape(self.members[0], 0, expressions, [slopes])
            self._made[order, in_q] = group
        return self._made[order, in_q]

    def _tape(self, members, order, expressions, parts):
        """A group's residuals and the nonzero entries of their gradients, with the places of these."""
        outputs = [*expressions, *(e for p in parts for e in p.nonzeros())]
        symbols = ca.symvar(ca.vertcat(*outputs))
        places = [np.array(p.sparsity().get_triplet(), dtype=int) for p in parts]
        return members, order, Tape(symbols, outputs), symbols, places

    def __call__(self, t, z, slopes=True):
        """Coefficients (n_equations, N) and Jacobian (n_equations, nz, N) at times t (N,) and jets z (nz, N).

        Without `slopes` the Jacobian is None.
        """
        n_points = z.shape[1]
        q_series, q_map = self._kinematics(t, z)
        residual = np.zeros((len(self.equations), n_points), dtype=REAL)
        jacobian = np.zeros((len(self.equations), len(z), n_points), dtype=self.real) if slopes else None
        for members, order, tape, symbols, places in self.groups if slopes else self.bare:
            depth = self.level - order
            coefficients = self._run(tape, symbols, t, z, q_series, depth)
            for i in range(depth + 1):
                residual[self.first[members] + i] = coefficients[: len(members), i]
            offset = len(members)
            for m, (rows, columns) in enumerate(places):
                entries = coefficients[offset : offset + len(rows)].astype(self.real)
                offset += len(rows)
                for i in range(depth + 1):
                    self._add_slopes(jacobian, self.first[members[rows]] + i, columns, m, entries[:, : i + 1], q_map)
        return residual, jacobian

    def _add_slopes(self, jacobian, equations, columns, m, entries, q_map):
        """Add to coefficient i of equations what ∂ψ/∂γ^(m) contributes, from its coefficients 0 .. i."""
        nq, n, i = self.q.nq, self.q.n, entries.shape[1] - 1
        for l in range(i + 1):
            part = entries[:, i - l]
            if m == 0 and not self.q.plain:
                np.add.at(jacobian, equations, part[:, None, :] * q_map[l][columns])
            elif m == 0:
                jacobian[equations, columns + (nq + (l - 1) * n if l else 0)] += part
            elif l + m <= self.level:
                jacobian[equations, columns + nq + (l + m - 1) * n] += part * (factorial(l + m) / factorial(l))

    def at_level(self, t, z, level):
        """The equations of a level: residuals (n_equations, N) and slopes in γ_[level] or q (n_equations, n, N).

        Rows of other levels are zero. The slopes are those of the leading gradients.
        """
        q_series, _ = self._kinematics(t, z)
        width = self.q.n if level else self.q.nq
        residual = np.zeros((len(self.equations), z.shape[1]), dtype=REAL)
        slopes = np.zeros((len(self.equations), width, z.shape[1]))
        for order in self.members:
            if order > level:
                continue
            members, _, tape, symbols, [(rows, columns)] = self.leading(order, level)
            depth = level - order
            coefficients = self._run(tape, symbols, t, z, q_series, depth)
            residual[self.first[members] + depth] = coefficients[: len(members), depth]
            entries = coefficients[len(members) :, 0] * (factorial(level) / factorial(depth))
            slopes[self.first[members[rows]] + depth, columns] = entries
        return residual, slopes

    def series(self, expressions, t, z, depth):
        """Taylor coefficients of expressions along a motion, (len, depth + 1, N)."""
        q_series, _ = self._kinematics(t, z)
        symbols = ca.symvar(ca.vertcat(*expressions))
        return self._run(Tape(symbols, list(expressions)), symbols, t, z, q_series, depth)

    def _kinematics(self, t, z):
        """Taylor coefficients of q and, unless q' = γ', the derivative of each in z."""
        nq, n, n_points = self.q.nq, self.q.n, z.shape[1]
        if self.q.plain:
            return [z[:nq], *(z[nq + k * n : nq + (k + 1) * n] for k in range(self.level))], None
        first = np.zeros((nq, len(z), n_points), dtype=self.real)
        first[np.arange(nq), np.arange(nq)] = 1.0
        series, maps = [z[:nq]], [first]
        _, _, tape, symbols, _ = self.motion
        for k in range(self.level):
            c = self._run(tape, symbols, t, z, series, k)
            slope = c[nq : nq + nq * nq].reshape(nq, nq, k + 1, n_points).astype(self.real)
            frame = c[nq + nq * nq :].reshape(n, nq, k + 1, n_points).astype(self.real)
            series.append(c[:nq, k] / (k + 1))
            step = np.zeros_like(first)
            for l in range(k + 1):
                step += np.einsum("jip,jzp->izp", slope[:, :, k - l], maps[l])
                start = nq + l * n
                step[:, start : start + n] += (l + 1) * np.swapaxes(frame[:, :, k - l], 0, 1)
            maps.append(step / (k + 1))
        return series, maps

    def _run(self, tape, symbols, t, z, q_series, depth):
        inputs = [[self._input(s, k, t, z, q_series) for k in range(depth + 1)] for s in symbols]
        series = Series(tape, inputs)
        with np.errstate(all="ignore"):
            for _ in range(depth + 1):
                series.advance()
        shape = (depth + 1, z.shape[1])
        result = np.zeros((len(tape.outputs), *shape), dtype=REAL)
        for i, c in enumerate(series.outputs):
            for k in range(depth + 1):
                result[i, k] = c[k]
        return result

    def _input(self, symbol, k, t, z, q_series):
        place = self.q.where(symbol)
        if place is None and symbol.element_hash() in self.signals:
            return self.signals[symbol.element_hash()][k]
        if place is None:
            return np.full(z.shape[1], self.points._parameter(symbol), dtype=REAL) if k == 0 else 0.0
        kind, level, i = place
        if kind == "t":
            return t if k == 0 else float(k == 1)
        if kind == "q":
            return q_series[k][i]
        if level + k > self.level:
            return np.zeros(z.shape[1], dtype=REAL)
        start = self.q.nq + (level + k - 1) * self.q.n
        return z[start + i] * (factorial(level + k) / factorial(k))
