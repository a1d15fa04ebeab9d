"""Points on the constraint manifold: jets that satisfy rows and their derivatives, in extended precision.

Ranks are decided at such points, since at arbitrary points equations look more independent than they are on their
solutions. The Gauss-Newton method solves all levels at once, from seeded random starts about the guess; residuals
are evaluated by numerical Taylor arithmetic in extended precision.
"""

from dataclasses import field, replace
from math import factorial

import casadi as ca
import numpy as np

from servoctl.jets.series import Flow
from servoctl.jets.tape import JETS, REAL, Book
from servoctl.reduction.ranks import clean, decide_each
from servoctl.reduction.scales import ORDINARY
from servoctl.spec.paths.value import numbers_in, parameters_of, path_at
from servoctl.tolerances import CUTOFF
from servoctl.values import frozen

ROUNDED = 8 * float(np.finfo(REAL).eps)  # a scaled residual below this is a rounding error
ROUNDED_STEP = 1e-15  # a step from a residual below this is tried once; shortening it gains nothing
WELL_CONDITIONED = 1e-3  # Cholesky pivots of A Aᵀ, of unit diagonal, above which steps need no singular values
LEVEL_SOLVED = 1e-17  # relative step below which a level is solved
ON_MANIFOLD = 1e-13  # largest scaled residual of a point: far below ENTRY, so that zeros show
GAUSS_NEWTON_STEPS = 60  # on all levels together
COORDINATE_STEPS, JET_STEPS = 8, 2  # Newton steps for q, and for a level of jets, where rows are mostly affine
LEVEL_SWEEPS = 2  # a second one, without gradients in all jets, where the first leaves the rounding of its steps
AIMING_STEPS = 6  # Gauss-Newton steps of q and references together, before the levels
SHORTENINGS = 3  # quarterings of a step before a search ends: with shorter steps it creeps, and other starts converge
SPREAD = 0.1  # relative width of starts about a guess, whose size is its value plus its usual size
POINTS = 5  # at which ranks are decided; with as many further starts where one of the first fails
POINTS_SEED = 1907  # of the random starts


@frozen
class Points:
    """Points in jet space."""

    q: object
    instants: np.ndarray  # (N, 1 + R): the time [s], and r^(k)/k! there, k = 0..JETS, of each reference
    z: np.ndarray  # (nq + K n, N): q and the normalised Taylor coefficients γ_[k] = γ^(k)/k!, k = 1..K
    parameters: tuple  # SX
    values: np.ndarray  # (n_p,), of the parameters
    residual: np.ndarray  # (N,), the largest scaled residual at each point
    book: Book = field(default_factory=Book, repr=False, compare=False)  # tapes of the scalars that were evaluated
    scales: object = None  # Scales: usual sizes of jets, by which steps and residuals are measured; default 1 each
    _values: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def __repr__(self):
        return f"Points({len(self)} points, jets up to order {self.level})"

    def __len__(self):
        return len(self.instants)

    @property
    def t(self):
        """The times (N,) [s]."""
        return self.instants[:, 0]

    @property
    def level(self):
        """The highest level K of the jets."""
        return (len(self.z) - self.q.nq) // self.q.n

    def sizes(self, level):
        """Usual sizes (nz,) of q and of normalised Taylor coefficients up to a level."""
        return np.ones(self.q.nq + level * self.q.n) if self.scales is None else self.scales.jets(level)

    def jet(self, k):
        """q for k = 0, else γ^(k): (nq, N) or (n, N) array; zero beyond the level."""
        nq, n = self.q.nq, self.q.n
        if k == 0:
            return self.z[:nq]
        if k > self.level:
            return np.zeros((n, len(self)), dtype=self.z.dtype)
        return self.z[nq + (k - 1) * n : nq + k * n] * factorial(k)

    def evaluate(self, expressions):
        """Values and sizes of SX scalars at the points: two arrays (len, N)."""
        result = np.empty((2, len(expressions), len(self)), dtype=REAL)
        for scalars, sources, targets in self.book.find(self.q, self.parameters, expressions):
            if scalars not in self._values:
                self._values[scalars] = scalars.evaluate(self.instants, self.z, self.values)
            result[:, targets] = self._values[scalars][:, sources]
        return result[0], result[1]

    def only_values(self, expressions):
        """The values alone, (len, N): sizes take longer."""
        result = np.empty((len(expressions), len(self)), dtype=REAL)
        for scalars, sources, targets in self.book.find(self.q, self.parameters, expressions):
            result[targets] = scalars.values(self.instants, self.z, self.values)[sources]
        return result

    def read(self, expressions):
        """Put SX scalars on one tape that will be evaluated one after the other."""
        self.book.find(self.q, self.parameters, expressions)

    def matrix(self, expression):
        """Values and sizes of an SX matrix at the points: two arrays (rows, columns, N)."""
        expression = ca.SX(expression)
        return self.placed(expression.sparsity(), *self.evaluate(expression.nonzeros()))

    def placed(self, sparsity, *nonzeros):
        """Arrays (rows, columns, N) from their nonzero entries (nnz, N)."""
        rows, columns = sparsity.get_triplet()
        matrices = np.zeros((len(nonzeros), *sparsity.shape, len(self)), dtype=REAL)
        matrices[:, rows, columns] = nonzeros
        return tuple(matrices)

    def joined(self, other):
        """These points and others of the same jets."""
        residual = np.append(self.residual, other.residual)
        instants, z = np.vstack([self.instants, other.instants]), np.hstack([self.z, other.z])
        return replace(self, instants=instants, z=z, residual=residual)

    def factorials(self, level):
        """The derivatives of jets up to a level relative to their normalised Taylor coefficients, (nq + level n,)."""
        return np.repeat([1.0, *(factorial(k) for k in range(1, level + 1))], [self.q.nq, *level * [self.q.n]])

    def at(self, t, jets, values):
        """Other points: at times t (N,), or instants, jets (nq + K n, N) and parameters (n_p,)."""
        level = (len(jets) - self.q.nq) // self.q.n
        z = jets / self.factorials(level)[:, None].astype(REAL)
        return replace(self, instants=as_instants(t), z=z, values=values, residual=np.zeros(len(t)))

    def take(self, keep):
        """Some of the points."""
        some = replace(self, instants=self.instants[keep], z=self.z[:, keep], residual=self.residual[keep])
        some._values.update((scalars, values[:, :, keep]) for scalars, values in self._values.items())
        return some


def as_instants(t):
    """Instants (N, 1 + R) of times (N,) [s] where there are no references; instants as they are."""
    return np.reshape(t, (len(t), -1))


@np.errstate(all="ignore")  # trial steps may leave the domain of the rows: what is not finite is no improvement
def solve(flow, t, z, iterations=GAUSS_NEWTON_STEPS, natural=False):
    """Solve a flow's rows for jets: level by level, then by damped Gauss-Newton steps on all levels.

    Where the levels lead nowhere, damped steps for the rows of q alone come first; a point without these has no jets.
    If `natural`, damped steps are judged by the Newton correction at their end instead of the residual: that is the
    same for all combinations of the rows, and leads on where rows are nearly dependent and curved. Returns z (nz, N)
    and the largest residual of each point (N,), relative to the size of its gradient times that of the jets.
    """
    z, t = np.array(z, dtype=REAL), np.asarray(as_instants(t), dtype=REAL)
    if not len(flow.equations):
        return z, np.zeros(len(t), dtype=REAL)
    scales, sizes = np.ones((len(flow.equations), len(t))), flow.points.sizes(flow.level)[:, None]
    norm = _solve_levels(flow, t, z, scales, sizes)
    active = np.flatnonzero(norm > ROUNDED)
    far = np.flatnonzero(~(norm < ON_MANIFOLD))
    if len(far) and flow.level and 0 in flow.members and not natural:
        z[: flow.q.nq, far], lowest = solve(flow.lowest, t[far], z[: flow.q.nq, far], iterations)
        norm = _solve_levels(flow, t, z, scales, sizes)
        lost = far[~(lowest < ON_MANIFOLD)]
        active = np.setdiff1d(np.flatnonzero(norm > ROUNDED), lost)
    for _ in range(iterations):
        if not len(active):
            break
        start = z[:, active]
        residual, jacobian = flow(t[active], start)
        scale = gradient_scales(jacobian, start, sizes)
        norm[active] = _norms(residual, scale)
        rough = norm[active] > ROUNDED
        active, start, residual, scale = active[rough], start[:, rough], residual[:, rough], scale[:, rough]
        if not len(active):
            break
        jacobian = jacobian[:, :, rough]
        step = least_steps(jacobian, residual, sizes)
        search = _natural_search if natural else _search
        trial, better = search(flow, t[active], start, step, jacobian if natural else scale, residual)
        active = active[better]
        z[:, active] = trial[:, better]
    return z, norm


def _solve_levels(flow, t, z, scales, sizes):
    """Solve level after level, twice where the rounding of the first steps is left; changes z and scales in place.

    Returns the largest scaled residual of each point, (N,).
    """
    for _ in range(LEVEL_SWEEPS):
        for level in range(flow.level + 1):
            _solve_level(flow, t, z, level, scales, sizes)
        norm = _norms(flow.residual(t, z), scales)
        if not np.any((norm > ROUNDED) & (norm < ON_MANIFOLD)):
            break
    return norm


def _search(flow, t, z, step, scale, residual):
    """For each point the longest of ever shorter steps that reduces the residual, and whether one does."""
    longest = np.max(np.abs(step) / (flow.points.sizes(flow.level)[:, None] + np.abs(z)), axis=0)
    damping, before = 1.0 / np.maximum(1.0, longest), np.max(np.abs(residual) / scale, axis=0)
    trial, open_ = z + damping * step, np.arange(len(t))
    better = np.zeros(len(t), dtype=bool)
    for _ in range(SHORTENINGS):
        new = flow.residual(t[open_], trial[:, open_])
        good = np.max(np.abs(new) / scale[:, open_], axis=0) < before[open_]
        better[open_[good]] = True
        open_ = open_[~good & (before[open_] > ROUNDED_STEP)]
        if not len(open_):
            break
        damping[open_] /= 4
        trial[:, open_] = z[:, open_] + damping[open_] * step[:, open_]
    return trial, better


def _natural_search(flow, t, z, step, jacobian, _):
    """For each point the longest of ever shorter steps that shortens the Newton correction, and whether one does.

    The correction J⁺ψ of the end is taken with the Jacobian of the start (the natural monotonicity test of Deuflhard).
    """
    sizes = flow.points.sizes(flow.level)[:, None]
    longest = np.max(np.abs(step) / (sizes + np.abs(z)), axis=0)
    damping, trial, open_ = 1.0 / np.maximum(1.0, longest), z.copy(), np.arange(len(t))
    for _ in range(SHORTENINGS):
        trial[:, open_] = z[:, open_] + damping[open_] * step[:, open_]
        left = least_steps(jacobian[:, :, open_], flow.residual(t[open_], trial[:, open_]), sizes)
        open_ = open_[~(np.max(np.abs(left) / (sizes + np.abs(z[:, open_])), axis=0) < longest[open_])]
        if not len(open_):
            break
        damping[open_] /= 4
    return trial, ~np.isin(np.arange(len(t)), open_)


def _solve_level(flow, t, z, level, scales, sizes):
    """Newton's method for γ^(level) with fixed lower jets; one step is exact where the rows are affine in γ^(level).

    Changes z, and the scales of the level's rows in place.
    """
    rows = np.flatnonzero(flow.levels == level)
    nq, n = flow.q.nq, flow.q.n
    columns = slice(0, nq) if level == 0 else slice(nq + (level - 1) * n, nq + level * n)
    sizes = sizes[columns]
    for _ in range((COORDINATE_STEPS if level == 0 else JET_STEPS) if len(rows) else 0):
        residual, slopes = flow.at_level(t, z, level)
        residual, slopes = residual[rows], slopes[rows]
        step = least_steps(slopes, residual, sizes)
        longest = np.max(np.abs(step) / (sizes + np.abs(z[columns])), axis=0)
        z[columns] += step / np.maximum(1.0, longest) if level == 0 else step
        scales[rows] = gradient_scales(slopes, z[columns], sizes)
        if np.all(np.abs(step) <= LEVEL_SOLVED * (sizes + np.abs(z[columns]))):
            break


def gradient_scales(jacobian, z, sizes):
    """Size of each residual's gradient times that of the jets, (equations, N)."""
    scale = np.sqrt((jacobian**2 * (sizes + np.abs(z.astype(float))) ** 2).sum(axis=1))
    return np.where(scale > 0, scale, 1.0)


def _norms(residual, scales):
    norm = np.max(np.abs(residual) / scales, axis=0).astype(REAL)
    return np.where(np.isfinite(norm), norm, np.inf)


def least_steps(jacobian, residual, sizes):
    """Steps, least relative to `sizes`, to zeros of the linearised residual, (nz, N); zero where not finite."""
    a = np.moveaxis(jacobian * sizes, 2, 0)
    scale = np.sqrt((a**2).sum(axis=2))
    scale[~(scale > 0)] = 1.0
    a, b = a / scale[:, :, None], (residual.T / scale).astype(float)
    steps = _normal_steps(a, b)
    steps = np.array([_least_step(*one) for one in zip(a, b, strict=True)]) if steps is None else steps
    return steps.T.astype(REAL) * sizes


def _least_step(a, b):
    """The step of least length at one point, by singular values if the normal equations are ill-conditioned."""
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        return np.zeros(a.shape[1])
    steps = _normal_steps(a[None], b[None])
    return -np.linalg.lstsq(a, b, rcond=CUTOFF)[0] if steps is None else steps[0]


def _normal_steps(a, b):
    """-Aᵀ(A Aᵀ)⁻¹ b of A (N, m, nz) and b (N, m), or None unless all are finite and well conditioned."""
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        return None
    gram = a @ a.swapaxes(1, 2)
    try:
        pivots = np.linalg.cholesky(gram).diagonal(axis1=1, axis2=2)
    except np.linalg.LinAlgError:
        return None
    if not pivots.min(initial=np.inf) > WELL_CONDITIONED:
        return None
    return -(a.swapaxes(1, 2) @ np.linalg.solve(gram, b[:, :, None]))[:, :, 0]


def sample(q, rows, level, context, starts=None, flow=None):
    """Seeded random points that satisfy rows and their derivatives up to a level of jets.

    At most `POINTS`; none if no start converges. Starts are random, by the window and the guess of the context, beside
    the jets of earlier points `starts`. A `flow`, if given, has the same rows and level.
    """
    starting = anywhere(q, level, context)
    if starts is not None and len(starts):
        t, z = starting.instants, starting.z
        shared = min(len(z), len(starts.z))
        for i in range(POINTS):
            again, p = divmod(i, len(starts))
            t[i, : starts.instants.shape[1]] = starts.instants[p]  # references that were made later have random jets
            z[:shared, i] = starts.z[:shared, p] + again * SPREAD * z[:shared, i]
    flow = flow.at(starting) if flow else Flow(q, rows, level, starting)
    first = _solved(starting, flow, slice(POINTS))
    points = _with_inertia(first, context.saddle)
    if len(points) == POINTS:
        return points
    others = _solved(starting, flow, slice(POINTS, None))
    points = points.joined(_with_inertia(others, context.saddle)).take(slice(POINTS))
    if not len(points):  # as where every solution is in such a place
        points = first.joined(others).take(slice(POINTS))
    return points if len(points) else _solved(starting, flow, slice(POINTS), natural=True)


def _with_inertia(points, saddle):
    """The points where every allowed direction has inertia; all of them without a matrix [M G_mᵀ; G_m 0].

    Where coordinates are singular, as longitude is at a pole, a balance vanishes with the inertia of its coordinate:
    such places solve the equations, and are no motions.
    """
    if saddle is None or not len(points):
        return points
    ranks = decide_each(clean(*points.matrix(saddle)))
    return points.take([i for i, r in enumerate(ranks) if r.rank == saddle.shape[0]])


def anywhere(q, level, context):
    """The random points about the guess from which points of a manifold are sought."""
    t, z = _random_starts(q, level, context)
    known = context.parameters, context.values
    return Points(q, t, z.astype(REAL), *known, np.zeros(len(t)), context.book, context.scales)


def _random_starts(q, level, context):
    """Instants in the window and jets (nz, 2 POINTS) about the guess, about zero where there is none."""
    rng, nz = np.random.default_rng(POINTS_SEED), q.nq + level * q.n
    centre = np.array([q.identity.get(name, 0.0) for name in q.names] + [0.0] * level * q.n)
    usual = np.ones(nz) if context.scales is None else context.scales.jets(level)
    spread = usual.copy()
    for name, value in context.guess.items():
        for k in range(level + 1):
            if name in q.jet_names(k):
                i = q.jet_names(k).index(name) + (q.nq + (k - 1) * q.n if k else 0)
                size = abs(value) + SPREAD * context.sizes.get(name, usual[i])
                centre[i], spread[i] = value / factorial(k), context.spread * size / factorial(k)
    z = centre[:, None] + spread[:, None] * rng.uniform(-1.0, 1.0, (nz, 2 * POINTS))
    t = rng.uniform(*context.window, (2 * POINTS, 1))
    sizes = np.repeat(sizes_of_references(q, context.parameters, context.values), JETS + 1)
    near = context.followed
    middle, sizes = (0.0, sizes) if near is None else (near, context.spread * (np.abs(near) + SPREAD * sizes))
    r = middle + sizes * rng.uniform(-1.0, 1.0, (2 * POINTS, len(sizes)))
    return np.hstack([t, r]).astype(REAL), z


def is_ordinary(size):
    """Whether points spread by 1 serve for this size, too."""
    return 1 / ORDINARY < abs(size) < ORDINARY


def sizes_of_references(q, parameters, values):
    """Largest values (R,) of paths of references, with values (n_p,) of parameters; 1 if ordinary, or for none."""
    sizes, numbers = np.ones(len(q.family)), numbers_in(parameters, values)
    for i, given in enumerate(q.family.paths.values()):
        path = path_at(given, numbers) if {*parameters_of(given)} <= numbers.keys() else None
        if path is not None and path.largest and not is_ordinary(path.largest):
            sizes[i] = path.largest
    return sizes


def follows(q, values):
    """Jets (R,) of references, as in instants, by their values {"X_reference": ...}; those without are zero."""
    jets = ((name, k) for name in q.family.names for k in range(JETS + 1))
    return np.array([values.get(jet_of_reference(name, k), 0.0) / factorial(k) for name, k in jets])


def references_at(paths, t):
    """Values of the jets of references at an instant, by names as points near a state have them."""
    found = {}
    for name, path in paths.items():
        jets = path.held().jets([t], min(path.coefficients.shape[2] - 1, JETS))[:, 0, 0]
        found |= {jet_of_reference(name, k): value for k, value in enumerate(jets.tolist())}
    return found


def jet_of_reference(name, k):
    """The name of a derivative of a reference among those of jets near which points are drawn."""
    return f"d{k}{name}_reference"


def _solved(starting, flow, some, natural=False):
    """The points of the manifold to which Newton's method converges from some of the starting points."""
    instants, z = starting.instants[some], starting.z[:, some]
    if 0 in flow.members:
        instants, z = aimed(flow.lowest, instants, z)
    z, residual = solve(flow, instants, z, natural=natural)
    points = replace(starting, instants=instants, z=z, residual=residual.astype(float))
    return points.take(np.flatnonzero(residual < ON_MANIFOLD))


def aimed(lowest, instants, z):
    """Instants and jets after steps of q and of the references towards rows of order 0: any posture is some target."""
    q, nq, points, places = lowest.q, lowest.q.nq, lowest.points, np.arange(1, instants.shape[1], JETS + 1)
    sizes = np.concatenate([points.sizes(0), sizes_of_references(q, points.parameters, points.values)])[:, None]
    instants, z = instants.copy(), np.array(z, dtype=REAL)
    for _ in range(AIMING_STEPS):
        if (aim := lowest.aim(instants, z[:nq])) is None:
            break
        residual, jacobian = aim
        step = least_steps(jacobian, residual, sizes)
        longest = np.max(np.abs(step) / (sizes + np.abs(np.vstack([z[:nq], instants[:, places].T]))), axis=0)
        step = step / np.maximum(1.0, longest)
        z[:nq] += step[:nq]
        instants[:, places] += step[nq:].T
    return instants, z


@frozen
class Context:
    """Where points are sampled, and with which parameters."""

    parameters: tuple  # SX
    values: np.ndarray  # (n_p,), of the parameters
    window: tuple  # (t0, t1) of the times [s]
    guess: dict  # values of jets by name about which points are searched
    spread: float = SPREAD  # relative width of the starts about guessed values
    sizes: dict = field(default_factory=dict)  # of jets by name, by which a guess near zero is spread; default `scales`
    scales: object = None  # Scales: usual sizes of jets, by which jets without a guess are spread; default 1 each
    followed: object = None  # (R,) jets of references, as in instants, that points near a state have; default random
    book: Book = field(default_factory=Book, repr=False, compare=False)  # tapes of the scalars that were evaluated
    saddle: object = None  # SX [M G_mᵀ; G_m 0]: points where it is singular are left out, where there are others
