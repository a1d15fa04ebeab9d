"""Points on the constraint manifold: jets that satisfy rows and their derivatives, to extended precision.

Ranks are decided here and not at arbitrary points, where equations look more independent than they are on
their own solutions. A point is found by Gauss-Newton on all levels at once, from a seeded random start about
the guess; residuals are evaluated by numerical Taylor arithmetic in extended precision.
"""

from dataclasses import dataclass
from math import factorial

import casadi as ca
import numpy as np

from servoctl.spec.taylor import Series, Tape, evaluate

REAL = np.longdouble


@dataclass(frozen=True)
class Points:
    """Points in jet space.

    Attributes
    ----------
    q : Coordinates
    t : (N,) array
    z : (nq + K n, N) array
        q and the normalised Taylor coefficients γ_[k] = γ^(k)/k!, k = 1..K.
    parameters : tuple of SX
    values : (n_p,) array
    residual : (N,) array
        Largest scaled residual that is left at each point.
    """

    q: object
    t: np.ndarray
    z: np.ndarray
    parameters: tuple
    values: np.ndarray
    residual: np.ndarray

    @property
    def level(self):
        """The highest level K of the jets."""
        return (len(self.z) - self.q.nq) // self.q.n

    def jet(self, k):
        """q for k = 0, else γ^(k): (nq, N) or (n, N) array; zero beyond the level."""
        nq, n = self.q.nq, self.q.n
        if k == 0:
            return self.z[:nq]
        if k > self.level:
            return np.zeros((n, len(self.t)), dtype=self.z.dtype)
        return self.z[nq + (k - 1) * n : nq + k * n] * factorial(k)

    def evaluate(self, expressions):
        """Values and sizes of SX scalars at the points: two arrays (len, N)."""
        expressions = list(expressions)
        symbols = ca.symvar(ca.vertcat(*expressions)) if expressions else []
        if not expressions:
            return np.zeros((0, len(self.t))), np.zeros((0, len(self.t)))
        inputs = np.empty((len(symbols), len(self.t)), dtype=REAL)
        for i, symbol in enumerate(symbols):
            inputs[i] = self._input(symbol)
        return evaluate(Tape(symbols, expressions), inputs)

    def matrix(self, expression):
        """Values and sizes of an SX matrix at the points: two arrays (rows, columns, N)."""
        values, sizes = self.evaluate(ca.vec(ca.densify(expression)).elements())
        shape = (expression.shape[1], expression.shape[0], len(self.t))
        return values.reshape(shape).swapaxes(0, 1), sizes.reshape(shape).swapaxes(0, 1)

    def _input(self, symbol):
        place = self.q.where(symbol)
        if place is None:
            return np.full(len(self.t), self._parameter(symbol), dtype=REAL)
        kind, level, i = place
        return self.t if kind == "t" else self.jet(level)[i]

    def _parameter(self, symbol):
        hashes = [p.element_hash() for p in self.parameters]
        return self.values[hashes.index(symbol.element_hash())]

    def take(self, keep):
        """Some of the points."""
        return Points(self.q, self.t[keep], self.z[:, keep], self.parameters, self.values, self.residual[keep])


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
    """

    def __init__(self, q, rows, level, points):
        self.q, self.level, self.points = q, level, points
        self.equations = [(a, i) for a, (_, order) in enumerate(rows) for i in range(level - order + 1)]
        self.groups = []
        for order in sorted({order for _, order in rows if order <= level}):
            members = [a for a, (_, o) in enumerate(rows) if o == order]
            expressions = [rows[a][0] for a in members]
            parts = [ca.jacobian(ca.vertcat(*expressions), ca.vertcat(*q.gamma(m) if m else q)) for m in range(order + 1)]
            self.groups.append(self._tape(members, order, expressions, parts))
        if not q.plain:
            moving = q.V @ ca.vertcat(*q.gamma(1)) + q.h
            self.motion = self._tape([], 0, moving.elements(), [ca.jacobian(moving, ca.vertcat(*q)), q.V])

    def _tape(self, members, order, expressions, parts):
        outputs = [*expressions, *(e for p in parts for e in ca.vec(ca.densify(p)).elements())]
        symbols = ca.symvar(ca.vertcat(*outputs))
        return members, order, Tape(symbols, outputs), symbols, [p.shape for p in parts]

    def __call__(self, t, z):
        """Coefficients (n_equations, N) and Jacobian (n_equations, nz, N) at times t (N,) and jets z (nz, N)."""
        n_points = z.shape[1]
        q_series, q_map = self._kinematics(t, z)
        place = {equation: e for e, equation in enumerate(self.equations)}
        residual = np.zeros((len(self.equations), n_points), dtype=REAL)
        jacobian = np.zeros((len(self.equations), len(z), n_points))
        for members, order, tape, symbols, shapes in self.groups:
            depth = self.level - order
            coefficients = self._run(tape, symbols, t, z, q_series, depth)
            offset = len(members)
            blocks = []
            for shape in shapes:
                size = shape[0] * shape[1]
                blocks.append(coefficients[offset : offset + size].reshape(shape[1], shape[0], depth + 1, n_points))
                offset += size
            for r, a in enumerate(members):
                for i in range(depth + 1):
                    e = place[a, i]
                    residual[e] = coefficients[r, i]
                    jacobian[e] = self._linear(blocks, r, i, q_map, len(z), n_points)
        return residual, jacobian

    def _linear(self, blocks, r, i, q_map, nz, n_points):
        row = np.zeros((nz, n_points))
        nq, n = self.q.nq, self.q.n
        for m, block in enumerate(blocks):
            for l in range(i + 1):
                part = block[:, r, i - l].astype(float)
                if m == 0:
                    row += np.einsum("jp,jzp->zp", part, q_map[l])
                elif l + m <= self.level:
                    start = nq + (l + m - 1) * n
                    row[start : start + n] += part * (factorial(l + m) / factorial(l))
        return row

    def _kinematics(self, t, z):
        """Taylor coefficients of q, and the derivative of each in z."""
        nq, n, n_points = self.q.nq, self.q.n, z.shape[1]
        first = np.zeros((nq, len(z), n_points))
        first[np.arange(nq), np.arange(nq)] = 1.0
        series, maps = [z[:nq]], [first]
        if self.q.plain:
            for k in range(1, self.level + 1):
                step = np.zeros((nq, len(z), n_points))
                start = nq + (k - 1) * n
                step[np.arange(nq), start + np.arange(nq)] = 1.0
                series.append(z[start : start + n])
                maps.append(step)
            return series, maps
        _, _, tape, symbols, _ = self.motion
        for k in range(self.level):
            c = self._run(tape, symbols, t, z, series, k)
            slope = c[nq : nq + nq * nq].reshape(nq, nq, k + 1, n_points).astype(float)
            frame = c[nq + nq * nq :].reshape(n, nq, k + 1, n_points).astype(float)
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


def solve(flow, t, z, iterations=80):
    """Move jets onto the manifold of a flow's rows by damped Gauss-Newton with least steps.

    Parameters
    ----------
    flow : Flow
    t : (N,) array
    z : (nz, N) array

    Returns
    -------
    z : (nz, N) array
    residual : (N,) array
        Largest residual left, each relative to the size of its gradient times that of the jets.
    """
    z, t = np.array(z, dtype=REAL), np.asarray(t, dtype=REAL)
    residual, jacobian = flow(t, z)
    norm = _norms(residual, jacobian, z)
    active = np.ones(len(t), dtype=bool)
    for _ in range(iterations):
        if not active.any() or not len(residual):
            break
        step = np.zeros_like(z)
        for p in np.flatnonzero(active):
            step[:, p] = _least_step(jacobian[:, :, p], residual[:, p])
        longest = np.max(np.abs(step) / (1.0 + np.abs(z)), axis=0).astype(float)
        damping = np.where(active, 1.0 / np.maximum(1.0, longest), 0.0)
        for _ in range(12):
            trial = z + damping * step
            new_residual, new_jacobian = flow(t, trial)
            new_norm = _norms(new_residual, new_jacobian, trial)
            worse = active & ~(new_norm < norm) & (damping > 0)
            if not worse.any():
                break
            damping = np.where(worse, damping / 4, damping)
        better = active & (new_norm < norm)
        z[:, better] = trial[:, better]
        active = better & (new_norm > 1e-30)
        residual, jacobian, norm = (
            np.where(better, new_residual, residual),
            np.where(better, new_jacobian, jacobian),
            np.where(better, new_norm, norm),
        )
    return z, norm


def _norms(residual, jacobian, z):
    if not len(residual):
        return np.zeros(z.shape[1])
    scale = np.sqrt((jacobian**2 * (1.0 + np.abs(z.astype(float))) ** 2).sum(axis=1))
    with np.errstate(all="ignore"):
        norm = np.max(np.abs(residual) / np.where(scale > 0, scale, 1.0), axis=0).astype(REAL)
    return np.where(np.isfinite(norm), norm, np.inf)


def _least_step(jacobian, residual):
    scale = np.sqrt((jacobian**2).sum(axis=1))
    scale = np.where(scale > 0, scale, 1.0)
    a, b = jacobian / scale[:, None], residual / scale
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        return np.zeros(jacobian.shape[1], dtype=REAL)
    return -np.linalg.lstsq(a, b.astype(float), rcond=1e-11)[0].astype(REAL)


def sample(q, rows, level, context, starts=None, count=5, seed=1907):
    """Seeded random points that satisfy rows and their derivatives up to a level.

    Parameters
    ----------
    q : Coordinates
    rows : list of (expression, order) pairs
    level : int
        Highest level of the jets.
    context : Context
        Parameters and their values, the window of times, the guess.
    starts : Points, optional
        Earlier points: their jets are starts, beside random ones.
    count : int
        Points to look for.

    Returns
    -------
    Points
        Those that were found, at most `count`; none if no start converged.
    """
    rng = np.random.default_rng(seed)
    count_tried = 2 * count
    nz = q.nq + level * q.n
    centre, spread = np.zeros(nz), np.ones(nz)
    for name, value in context.guess.items():
        for k in range(level + 1):
            if name in q.jet_names(k):
                i = q.jet_names(k).index(name) + (q.nq + (k - 1) * q.n if k else 0)
                centre[i], spread[i] = value / factorial(k), context.spread * (abs(value) + 0.1) / factorial(k)
    z = centre[:, None] + spread[:, None] * rng.uniform(-1.0, 1.0, (nz, count_tried))
    t = np.asarray(rng.uniform(*context.window, count_tried), dtype=REAL)
    if starts is not None and len(starts.t):
        shared = min(nz, len(starts.z))
        for i in range(count):
            t[i] = starts.t[i % len(starts.t)]
            z[:shared, i] = starts.z[:shared, i % len(starts.t)] + (i // len(starts.t)) * 0.1 * z[:shared, i]
    empty = Points(q, t, z.astype(REAL), context.parameters, context.values, np.zeros(count_tried))
    flow = Flow(q, rows, level, empty)
    z, residual = solve(flow, t, z)
    found = Points(q, t, z, context.parameters, context.values, residual.astype(float))
    good = np.flatnonzero(residual < 1e-13)
    return found.take(good[:count])


@dataclass(frozen=True)
class Context:
    """What sampling needs to know.

    Attributes
    ----------
    parameters : tuple of SX
    values : (n_p,) array
    window : (t0, t1)
        Times are drawn from it [s].
    guess : dict of str to float
        Values of jets about which points are looked for.
    spread : float
        Of the starts about guessed values, relative.
    """

    parameters: tuple
    values: np.ndarray
    window: tuple
    guess: dict
    spread: float = 0.1
