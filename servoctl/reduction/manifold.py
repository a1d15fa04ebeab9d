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

    def __repr__(self):
        return f"Points({len(self.t)} points, jets up to order {self.level})"

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
    signals : dict, optional
        Taylor coefficients of further symbols along the motion, by element hash: lists of (N,) arrays.
    real : type
        Of the Jacobian; double precision is enough for Newton's method.
    """

    def __init__(self, q, rows, level, points, signals=None, real=float):
        self.q, self.level, self.points, self.signals, self.real = q, level, points, signals or {}, real
        self.equations = [(a, i) for a, (_, order) in enumerate(rows) for i in range(level - order + 1)]
        self.levels = np.array([rows[a][1] + i for a, i in self.equations], dtype=int)
        self.groups = []
        for order in sorted({order for _, order in rows if order <= level}):
            members = [a for a, (_, o) in enumerate(rows) if o == order]
            expressions = [rows[a][0] for a in members]
            parts = [
                ca.jacobian(ca.vertcat(*expressions), ca.vertcat(*q.gamma(m) if m else q)) for m in range(order + 1)
            ]
            self.groups.append(self._tape(members, order, expressions, parts))
        self.bare = [self._tape(m, order, [rows[a][0] for a in m], []) for m, order, *_ in self.groups]
        if not q.plain:
            moving = q.V @ ca.vertcat(*q.gamma(1)) + q.h
            self.motion = self._tape([], 0, moving.elements(), [ca.jacobian(moving, ca.vertcat(*q)), q.V])

    def _tape(self, members, order, expressions, parts):
        outputs = [*expressions, *(e for p in parts for e in ca.vec(ca.densify(p)).elements())]
        symbols = ca.symvar(ca.vertcat(*outputs))
        return members, order, Tape(symbols, outputs), symbols, [p.shape for p in parts]

    def __call__(self, t, z, slopes=True):
        """Coefficients (n_equations, N) and Jacobian (n_equations, nz, N) at times t (N,) and jets z (nz, N).

        Without `slopes` the Jacobian is None.
        """
        n_points = z.shape[1]
        q_series, q_map = self._kinematics(t, z, slopes)
        place = {equation: e for e, equation in enumerate(self.equations)}
        residual = np.zeros((len(self.equations), n_points), dtype=REAL)
        jacobian = np.zeros((len(self.equations), len(z), n_points), dtype=self.real) if slopes else None
        for members, order, tape, symbols, shapes in self.groups if slopes else self.bare:
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
                    residual[place[a, i]] = coefficients[r, i]
                    if slopes:
                        jacobian[place[a, i]] = self._linear(blocks, r, i, q_map, len(z), n_points)
        return residual, jacobian

    def series(self, expressions, t, z, depth):
        """Taylor coefficients of expressions along a motion, (len, depth + 1, N)."""
        q_series, _ = self._kinematics(t, z, False)
        symbols = ca.symvar(ca.vertcat(*expressions))
        return self._run(Tape(symbols, list(expressions)), symbols, t, z, q_series, depth)

    def _linear(self, blocks, r, i, q_map, nz, n_points):
        row = np.zeros((nz, n_points), dtype=self.real)
        nq, n = self.q.nq, self.q.n
        for m, block in enumerate(blocks):
            for l in range(i + 1):
                part = block[:, r, i - l].astype(self.real)
                if m == 0:
                    row += np.einsum("jp,jzp->zp", part, q_map[l])
                elif l + m <= self.level:
                    start = nq + (l + m - 1) * n
                    row[start : start + n] += part * (factorial(l + m) / factorial(l))
        return row

    def _kinematics(self, t, z, slopes):
        """Taylor coefficients of q and, with `slopes`, the derivative of each in z."""
        nq, n, n_points = self.q.nq, self.q.n, z.shape[1]
        if self.q.plain and not slopes:
            return [z[:nq], *(z[nq + k * n : nq + (k + 1) * n] for k in range(self.level))], None
        first = np.zeros((nq, len(z), n_points), dtype=self.real)
        first[np.arange(nq), np.arange(nq)] = 1.0
        series, maps = [z[:nq]], [first]
        if self.q.plain:
            for k in range(1, self.level + 1):
                step = np.zeros((nq, len(z), n_points), dtype=self.real)
                start = nq + (k - 1) * n
                step[np.arange(nq), start + np.arange(nq)] = 1.0
                series.append(z[start : start + n])
                maps.append(step)
            return series, maps
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


def solve(flow, t, z, iterations=60):
    """Move jets onto the manifold of a flow's rows: level by level, then by damped Gauss-Newton on all levels.

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
    if not len(flow.equations):
        return z, np.zeros(len(t), dtype=REAL)
    for level in range(flow.level + 1):
        z = _solve_level(flow, t, z, level)
    residual, jacobian = flow(t, z)
    norm = _norms(residual, jacobian, z)
    active = np.flatnonzero(norm > 1e-30)
    for _ in range(iterations):
        if not len(active):
            break
        start, scale = z[:, active], _scales(jacobian[:, :, active], z[:, active])
        step = np.array([_least_step(jacobian[:, :, p], residual[:, p]) for p in active]).T
        trial, better = _search(flow, t[active], start, step, scale, residual[:, active])
        active, trial = active[better], trial[:, better]
        if not len(active):
            break
        z[:, active] = trial
        residual[:, active], jacobian[:, :, active] = flow(t[active], trial)
        norm[active] = _norms(residual[:, active], jacobian[:, :, active], trial)
        active = active[norm[active] > 1e-30]
    return z, norm


def _search(flow, t, z, step, scale, residual):
    """The longest of a sequence of shortened steps that lessens the residual, point by point."""
    longest = np.max(np.abs(step) / (1.0 + np.abs(z)), axis=0)
    damping, before = 1.0 / np.maximum(1.0, longest), np.max(np.abs(residual) / scale, axis=0)
    trial, open_ = z + damping * step, np.arange(len(t))
    better = np.zeros(len(t), dtype=bool)
    for _ in range(12):
        new, _ = flow(t[open_], trial[:, open_], slopes=False)
        with np.errstate(all="ignore"):
            good = np.max(np.abs(new) / scale[:, open_], axis=0) < before[open_]
        better[open_[good]] = True
        open_ = open_[~good]
        if not len(open_):
            break
        damping[open_] /= 4
        trial[:, open_] = z[:, open_] + damping[open_] * step[:, open_]
    return trial, better


def _solve_level(flow, t, z, level):
    """Newton's method for γ^(level) alone, lower jets fixed: exact in a step where the rows are affine there."""
    rows = np.flatnonzero(flow.levels == level)
    nq, n = flow.q.nq, flow.q.n
    columns = slice(0, nq) if level == 0 else slice(nq + (level - 1) * n, nq + level * n)
    if not len(rows):
        return z
    for _ in range(8 if level == 0 else 2):
        residual, jacobian = flow(t, z)
        steps = [_least_step(jacobian[rows][:, columns, p], residual[rows, p]) for p in range(len(t))]
        step = np.array(steps).T
        longest = np.max(np.abs(step) / (1.0 + np.abs(z[columns])), axis=0)
        z[columns] += step / np.maximum(1.0, longest) if level == 0 else step
        if np.all(np.abs(step) <= 1e-17 * (1.0 + np.abs(z[columns]))):
            break
    return z


def _scales(jacobian, z):
    """Size of each residual's gradient times that of the jets, (equations, N)."""
    with np.errstate(all="ignore"):
        scale = np.sqrt((jacobian**2 * (1.0 + np.abs(z.astype(float))) ** 2).sum(axis=1))
    return np.where(scale > 0, scale, 1.0)


def _norms(residual, jacobian, z):
    with np.errstate(all="ignore"):
        norm = np.max(np.abs(residual) / _scales(jacobian, z), axis=0).astype(REAL)
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
