"""Points on the constraint manifold: jets that satisfy rows and their derivatives, to extended precision.

Ranks are decided here and not at arbitrary points, where equations look more independent than they are on
their own solutions. A point is found by Gauss-Newton on all levels at once, from a seeded random start about
the guess; residuals are evaluated by numerical Taylor arithmetic in extended precision.
"""

from dataclasses import dataclass, field, replace
from math import factorial

import casadi as ca
import numpy as np

from servoctl.jets.flow import Flow
from servoctl.jets.scalars import REAL, Book

ROUNDED = 8 * float(np.finfo(REAL).eps)  # a scaled residual below this is rounding
ROUNDED_STEP = 1e-15  # a step from below this is worth one trial: shorter ones gain nothing
WELL_CONDITIONED = 1e-3  # Cholesky pivots of A Aᵀ with unit diagonal above it: Newton's steps need no singular values


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
    book : Book
        Of what was read.
    """

    q: object
    t: np.ndarray
    z: np.ndarray
    parameters: tuple
    values: np.ndarray
    residual: np.ndarray
    book: Book = field(default_factory=Book, repr=False, compare=False)
    _found: dict = field(default_factory=dict, init=False, repr=False, compare=False)

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
        result = np.empty((2, len(expressions), len(self.t)), dtype=REAL)
        for scalars, own, given in self.book.find(self.q, self.parameters, expressions):
            if scalars not in self._found:
                self._found[scalars] = scalars.evaluate(self.t, self.z, self.values)
            result[:, given] = self._found[scalars][:, own]
        return result[0], result[1]

    def read(self, expressions):
        """Read SX scalars together that will be needed one after the other."""
        self.book.find(self.q, self.parameters, expressions)

    def matrix(self, expression):
        """Values and sizes of an SX matrix at the points: two arrays (rows, columns, N)."""
        expression = ca.SX(expression)
        return self.placed(expression.sparsity(), *self.evaluate(expression.nonzeros()))

    def placed(self, sparsity, *nonzeros):
        """Arrays (rows, columns, N) from their nonzero entries (nnz, N)."""
        rows, columns = sparsity.get_triplet()
        found = np.zeros((len(nonzeros), *sparsity.shape, len(self.t)), dtype=REAL)
        found[:, rows, columns] = nonzeros
        return tuple(found)

    def joined(self, other):
        """These points and others of the same jets."""
        residual = np.append(self.residual, other.residual)
        return replace(self, t=np.append(self.t, other.t), z=np.hstack([self.z, other.z]), residual=residual)

    def take(self, keep):
        """Some of the points."""
        kept = replace(self, t=self.t[keep], z=self.z[:, keep], residual=self.residual[keep])
        kept._found.update((scalars, found[:, :, keep]) for scalars, found in self._found.items())
        return kept


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
    scales = np.ones((len(flow.equations), len(t)))
    for level in range(flow.level + 1):
        _solve_level(flow, t, z, level, scales)
    residual = flow.residual(t, z)
    norm = _norms(residual, scales)
    active = np.flatnonzero(norm > ROUNDED)
    for _ in range(iterations):
        if not len(active):
            break
        start = z[:, active]
        residual, jacobian = flow(t[active], start)
        scale = _scales(jacobian, start)
        norm[active] = _norms(residual, scale)
        rough = norm[active] > ROUNDED
        active, start, residual, scale = active[rough], start[:, rough], residual[:, rough], scale[:, rough]
        if not len(active):
            break
        step = _least_steps(jacobian[:, :, rough], residual)
        trial, better = _search(flow, t[active], start, step, scale, residual)
        active = active[better]
        z[:, active] = trial[:, better]
    return z, norm


def _search(flow, t, z, step, scale, residual):
    """The longest of a sequence of shortened steps that lessens the residual, point by point."""
    longest = np.max(np.abs(step) / (1.0 + np.abs(z)), axis=0)
    damping, before = 1.0 / np.maximum(1.0, longest), np.max(np.abs(residual) / scale, axis=0)
    trial, open_ = z + damping * step, np.arange(len(t))
    better = np.zeros(len(t), dtype=bool)
    for _ in range(12):
        new = flow.residual(t[open_], trial[:, open_])
        with np.errstate(all="ignore"):
            good = np.max(np.abs(new) / scale[:, open_], axis=0) < before[open_]
        better[open_[good]] = True
        open_ = open_[~good & (before[open_] > ROUNDED_STEP)]
        if not len(open_):
            break
        damping[open_] /= 4
        trial[:, open_] = z[:, open_] + damping[open_] * step[:, open_]
    return trial, better


def _solve_level(flow, t, z, level, scales):
    """Newton's method for γ^(level) alone, lower jets fixed: exact in a step where the rows are affine there.

    Changes z, and the rows of `scales` that belong to the level: the size of their gradients times that of the jets.
    """
    rows = np.flatnonzero(flow.levels == level)
    nq, n = flow.q.nq, flow.q.n
    columns = slice(0, nq) if level == 0 else slice(nq + (level - 1) * n, nq + level * n)
    for _ in range((8 if level == 0 else 2) if len(rows) else 0):
        residual, slopes = flow.at_level(t, z, level)
        residual, slopes = residual[rows], slopes[rows]
        step = _least_steps(slopes, residual)
        longest = np.max(np.abs(step) / (1.0 + np.abs(z[columns])), axis=0)
        z[columns] += step / np.maximum(1.0, longest) if level == 0 else step
        scales[rows] = _scales(slopes, z[columns])
        if np.all(np.abs(step) <= 1e-17 * (1.0 + np.abs(z[columns]))):
            break


def _scales(jacobian, z):
    """Size of each residual's gradient times that of the jets, (equations, N)."""
    with np.errstate(all="ignore"):
        scale = np.sqrt((jacobian**2 * (1.0 + np.abs(z.astype(float))) ** 2).sum(axis=1))
    return np.where(scale > 0, scale, 1.0)


def _norms(residual, scales):
    with np.errstate(all="ignore"):
        norm = np.max(np.abs(residual) / scales, axis=0).astype(REAL)
    return np.where(np.isfinite(norm), norm, np.inf)


def _least_steps(jacobian, residual):
    """Steps of least length to where the linearised residual vanishes, (nz, N)."""
    a = np.moveaxis(jacobian, 2, 0)
    scale = np.sqrt((a**2).sum(axis=2))
    scale[~(scale > 0)] = 1.0
    a, b = a / scale[:, :, None], (residual.T / scale).astype(float)
    if np.all(np.isfinite(a)) and np.all(np.isfinite(b)):
        gram = a @ a.swapaxes(1, 2)
        try:
            if np.linalg.cholesky(gram).diagonal(axis1=1, axis2=2).min(initial=np.inf) > WELL_CONDITIONED:
                return -(a.swapaxes(1, 2) @ np.linalg.solve(gram, b[:, :, None]))[:, :, 0].T.astype(REAL)
        except np.linalg.LinAlgError:
            pass
    return np.array([_least_step(jacobian[:, :, p], residual[:, p]) for p in range(residual.shape[1])]).T


def _least_step(jacobian, residual):
    scale = np.sqrt((jacobian**2).sum(axis=1))
    scale = np.where(scale > 0, scale, 1.0)
    a, b = jacobian / scale[:, None], residual / scale
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        return np.zeros(jacobian.shape[1], dtype=REAL)
    b, gram = b.astype(float), a @ a.T
    try:
        least = np.diag(np.linalg.cholesky(gram)).min()
    except np.linalg.LinAlgError:
        least = 0.0
    if least > WELL_CONDITIONED:
        return -(a.T @ np.linalg.solve(gram, b)).astype(REAL)
    return -np.linalg.lstsq(a, b, rcond=1e-11)[0].astype(REAL)


def sample(q, rows, level, context, starts=None, flow=None, count=5, seed=1907):
    """Seeded random points that satisfy rows and their derivatives up to a level.

    Parameters
    ----------
    q : Coordinates
    rows : list of Row
    level : int
        Highest level of the jets.
    context : Context
        Parameters and their values, the window of times, the guess.
    starts : Points, optional
        Earlier points: their jets are starts, beside random ones.
    flow : Flow, optional
        Of the same rows and level, from an earlier call.
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
                size = abs(value) + 0.1 * context.sizes.get(name, 1.0)
                centre[i], spread[i] = value / factorial(k), context.spread * size / factorial(k)
    z = centre[:, None] + spread[:, None] * rng.uniform(-1.0, 1.0, (nz, count_tried))
    t = np.asarray(rng.uniform(*context.window, count_tried), dtype=REAL)
    if starts is not None and len(starts.t):
        shared = min(nz, len(starts.z))
        for i in range(count):
            t[i] = starts.t[i % len(starts.t)]
            z[:shared, i] = starts.z[:shared, i % len(starts.t)] + (i // len(starts.t)) * 0.1 * z[:shared, i]
    starting = Points(q, t, z.astype(REAL), context.parameters, context.values, np.zeros(count_tried), context.book)
    flow = flow.at(starting) if flow else Flow(q, rows, level, starting)
    found = []
    for some in (slice(count), slice(count, None)):  # the second half is needed where one of the first failed
        if sum(len(part.t) for part in found) < count:
            solved, residual = solve(flow, t[some], z[:, some])
            part = replace(starting, t=t[some], z=solved, residual=residual.astype(float))
            found.append(part.take(np.flatnonzero(residual < 1e-13)))
    return found[0] if len(found) == 1 else found[0].joined(found[1]).take(slice(count))


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
    sizes : dict of str to float
        What a guessed value near zero is small against; 1 where it is not given.
    book : Book
        Of what was read.
    """

    parameters: tuple
    values: np.ndarray
    window: tuple
    guess: dict
    spread: float = 0.1
    sizes: dict = field(default_factory=dict)
    book: Book = field(default_factory=Book, repr=False, compare=False)
