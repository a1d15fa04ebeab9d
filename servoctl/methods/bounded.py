"""Bounded motions where forward integration diverges: stable inversion as a two-point boundary value problem.

Σ o_a entries z of the state are free, the invariants determine the others, and z' = f(t, z). Before and after its span
the program stands still, so that f is autonomous there, with equilibria. The bounded motion leaves the first one along
its unstable manifold and arrives at the other along its stable one: the components of z along the stable eigenspace
are zero at the start of a window that exceeds the span, those along the unstable one at its end (Devasia, Chen and
Paden 1996; Chen 1993). Collocation at the nodes of Radau IIA of order 13 turns this into equations for one banded
Newton iteration with exact Jacobians; a mesh is refined until the defect between the nodes is below the tolerance.
"""

from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.codegen.paths import combined
from servoctl.errors import (
    IntegrationStopped,
    LimitExceeded,
    SingularProgram,
    SpecificationError,
    UnstableInternalDynamics,
)
from servoctl.methods.accuracy import component_sizes, sizes_of, state_levels
from servoctl.methods.motion import DEFAULT_SAMPLES, Motion, breakpoints, margin_at
from servoctl.methods.radau import basis, radau
from servoctl.model.equations import invariant_names
from servoctl.model.following import corners_of
from servoctl.model.jets import with_highest
from servoctl.model.switching import switching
from servoctl.tolerances import CUTOFF, NOISE, TINY
from servoctl.values import frozen

ORDER = 13  # of the collocation: seven nodes
LONGEST = 4.0  # interval of the first mesh at corners, in time constants of the fastest mode
FIRST_INTERVALS = 1000  # of a first mesh that need not resolve its fastest modes everywhere
COARSEST = 10.0  # interval in time constants of the fastest unstable mode, up to which the collocation lets it grow
MOST_INTERVALS = 4000
NEWTON_STEPS, NEWTON_ENDS, STALLED = 40, 1e-12, 1e-9  # of Newton's method; relative size of its last step
REFINEMENTS, MOST_PIECES = 10, 4  # of the mesh; and into how many an interval is cut at most
LIFTED = 2  # Newton steps to the invariants from a polynomial between nodes, which is accurate to the defect
AIM = 0.1  # defect that refinement aims at, relative to the tolerance
HYPERBOLIC = 1e-10  # distance to a matrix with an eigenvalue on the imaginary axis, relative to A, that is rounding
STANDS = 1e-6  # relative change of the equilibrium before or after the span: the program does not stand still
REGULAR = 1e-6  # smallest singular value of the free entries' part of the tangent space
SPREAD = 0.1  # of the sizes of the state: how far seeds lie about a rest at which is asked what rates depend on
BETWEEN = (0.15, 0.5, 0.9)  # places within an interval where the defect is measured


def bounded(model, span, guess, method, instants, progress, events=None):
    """The bounded motion of a program that stands still outside its span; its `note` has window and truncation error.

    `guess` (n_x,) is where Newton's method for the first equilibrium begins. `instants` are (times, knots): the samples
    [s], None for 1001 in the whole window, the ends of the span and the knots; and where the program is not smooth [s].
    Raises UnstableInternalDynamics if an eigenvalue lies on the imaginary axis at an end, or the ends differ in the
    number of unstable ones, SpecificationError if the program moves outside the span, and IntegrationStopped or
    SingularProgram if there is no equilibrium, Newton's method does not converge, or a pivot vanishes.
    """
    times, knots = instants
    if span[1] < span[0]:
        raise SpecificationError(
            f"t_span=({span[0]:g}, {span[1]:g}) was given with method='bounded'.",
            "A bounded motion joins the rest before the program to the rest after it.",
            nearest=f"({span[1]:g}, {span[0]:g}).",
            t_span=span,
        )
    if switching(model) is not None:
        raise SpecificationError(
            "method='bounded' was given for a mechanism or program with kinks or switches of the state.",
            "A bounded motion is solved for at all instants at once, on one smooth branch.",
            do="Smooth the switch, such as tanh(v/v0) for sign(v).",
        )
    problem = Problem(model, span, guess)
    window = problem.window(method.window)
    _require_within(window, times)
    left_out = _left_out(span, window, times)
    mesh, x = problem.solve(window, knots, method.rtol)
    progress(window[0])
    reference = problem.solve(problem.window(2 * method.window), knots, np.inf, (mesh, x))
    progress(span[1])
    if times is None:
        edges = [k for k in (*span, *knots) if window[0] < k < window[1]]
        times = np.union1d(np.linspace(*window, DEFAULT_SAMPLES), edges)
    motion = Motion()
    motion.count(intervals=len(mesh) - 1, iterations=problem.iterations)
    if events is not None:
        times, motion.ended = _to_event(problem, events, (mesh, x), times)
    samples = problem.at(times, mesh, x)
    truncation = problem.distance(samples, problem.at(times, *reference))
    outputs = model.function("ode").grid(times, samples, model.p)
    problem.require_pivots(times, outputs[problem.n_x :])
    motion.add(model, times, samples, outputs[problem.n_x - model.n : problem.n_x])
    motion.keep(model, mesh, _OnMesh(problem, mesh, x), (), times[-1] if motion.ended else None)
    motion.say(f"bounded from t = {window[0]:.4g} to {window[1]:.4g} s{left_out}")
    motion.say(f"a window of twice the length changes the motion by {truncation:.1e}")
    return motion


def _require_within(window, times):
    """Refuse samples (N,) or None outside the window, but for rounding."""
    low, high = window
    if times is not None and (times[0] < low - margin_at(low, window) or times[-1] > high + margin_at(high, window)):
        raise SpecificationError(
            f"t_eval covers {times[0]:g} to {times[-1]:g} s.",
            f"Samples of the bounded motion lie within its window, {low:.9g} to {high:.9g} s.",
            do="Sample this window, or widen it by sv.methods.Bounded(window=...).",
            t_eval=times.tolist(),
            window=window,
        )


def _left_out(span, window, times):
    """What samples (N,) or None leave out of the motion before and after the span, in words; "" if nothing."""
    if times is None:
        return ""
    sides = [f"before t = {times[0]:.4g} s"] if window[0] < span[0] <= times[0] else []
    sides += [f"after t = {times[-1]:.4g} s"] if window[1] > span[1] >= times[-1] else []
    return "; the samples leave out the motion " + " and ".join(sides) if sides else ""


def _to_event(problem, events, solution, times):
    """The samples (N,) up to a terminal event of a motion, and its name; all of them and "" without one."""
    model = problem.model

    def jets(t):
        return with_highest(model, t, problem.at(t, *solution))

    found = events.first(model, solution[0], jets)
    return (times, "") if found is None else (np.append(times[times < found.t], found.t), found.name)


@frozen(eq=False)
class _OnMesh:
    """Jets of the solution x of a problem on a mesh."""

    problem: object
    mesh: np.ndarray
    x: np.ndarray

    @property
    def nbytes(self):
        """Memory of the solution."""
        return self.x.nbytes

    def __call__(self, k, t, p):
        """Jets (n_z, N) at instants t (N,)."""
        return with_highest(self.problem.model, t, self.problem.at(t, self.mesh, self.x), p)


@frozen
class End:
    """An equilibrium: instant [s], state (n_x,), linearisation A (f, f) in the free entries, and their sizes (f,).

    `others` (f, r) is an orthonormal basis of the entries over their sizes without integrals, on which nothing depends:
    those have the names `constants`, and where they move on it is a rest of the others.
    """

    t: float
    x: np.ndarray
    A: np.ndarray
    size: np.ndarray
    others: np.ndarray | None = None
    constants: tuple = ()
    moving: bool = False

    @cached_property
    def modes(self):
        """The rest without its integrals, whose constants are eigenvalues 0; all of it if there is nothing else."""
        if self.others is None or not 0 < self.others.shape[1] < len(self.A):
            return self
        whole = self.A * self.size / self.size[:, None]
        A = self.others.T @ whole @ self.others
        A[np.abs(A) <= NOISE * np.abs(whole).max()] = 0.0  # rounding of all may be all that is left
        return End(self.t, self.x, A, np.ones(len(A)))

    @cached_property
    def eigenvalues(self):
        """Eigenvalues of A [1/s], by descending real part."""
        values = np.linalg.eigvals(self.A).astype(complex)
        return values[np.lexsort((-values.imag, -values.real))]

    @cached_property
    def on_axis(self):
        """The eigenvalues on the imaginary axis: A is as near to a matrix with one there as rounding is.

        Real parts alone do not decide: those of multiple eigenvalues are far larger than the rounding that splits them.
        Halfway between such an eigenvalue and the axis A is as near to singular; between different ones it is not.
        Nor does the size of A: rounding of each entry moves a slow mode by less than that of a fast one.
        """
        from scipy.linalg import matrix_balance

        scaled = self.A * self.size / self.size[:, None]
        cut = np.where(np.abs(scaled) > NOISE * np.abs(scaled).max(initial=0.0), scaled, 0.0)
        balanced, (scale, _) = matrix_balance(cut, permute=False, separate=True)
        size = np.linalg.norm(balanced)
        path = np.stack([1j * self.eigenvalues.imag, self.eigenvalues - self.eigenvalues.real / 2], axis=1)
        shifted = balanced - path[:, :, None, None] * np.eye(len(scaled))
        distances = np.linalg.svd(shifted, compute_uv=False)[:, :, -1].max(axis=1)
        moved = self._moved(scaled * scale / scale[:, None], HYPERBOLIC * np.abs(balanced) + NOISE * size)
        return self.eigenvalues[(distances <= HYPERBOLIC * size) & (np.abs(self.eigenvalues.real) <= moved)]

    @staticmethod
    def _moved(A, change):
        """The most by which a change of entries (f, f) moves each eigenvalue of A, |y|ᵀ change |x| / |yᴴx|, (f,)."""
        from scipy.linalg import eig

        values, left, right = eig(A, left=True)
        moved = np.einsum("ik,ij,jk->k", np.abs(left), change, np.abs(right))
        moved = moved / np.maximum(np.abs(np.einsum("ik,ik->k", left.conj(), right)), TINY)
        return moved[np.lexsort((-values.imag, -values.real))]

    @property
    def unstable(self):
        """The number of unstable eigenvalues."""
        return int((self.eigenvalues.real > 0).sum())

    @property
    def unstable_beyond_axis(self):
        """The number of unstable eigenvalues that are not on the imaginary axis."""
        return int((np.setdiff1d(self.eigenvalues, self.on_axis).real > 0).sum())

    @property
    def fastest(self):
        """The magnitude of the fastest unstable eigenvalue [1/s], 0 without one."""
        return float(np.abs(self.eigenvalues[self.eigenvalues.real > 0]).max(initial=0.0))

    def left_space(self, unstable):
        """A basis (k, f) of the left eigenspace of the unstable, or of the stable eigenvalues and of integrals."""
        from scipy.linalg import null_space, schur, solve_sylvester

        if self.modes is not self:
            V, Q, A = null_space(self.others.T), self.others, self.A * self.size / self.size[:, None]
            Y = solve_sylvester(V.T @ A @ V, -self.modes.A, V.T @ A @ Q)  # (Vᵀ + Y Qᵀ) A = (Vᵀ A V) (Vᵀ + Y Qᵀ)
            rows = [self.modes.left_space(unstable) @ Q.T, *([] if unstable else [V.T + Y @ Q.T])]
            return np.vstack(rows) / self.size
        split, sign = np.abs(self.on_axis.real).max(initial=0.0), 1 if unstable else -1  # as rounding splits them
        _, vectors, count = schur(self.A.T, output="real", sort=lambda re, im: sign * re > split)
        return vectors[:, :count].T


class FreeEntries:
    """The internal dynamics z' = f(t, z) in entries z of the state that the invariants leave free.

    They are chosen near the state `guess` (n_x,) at t [s].
    """

    def __init__(self, model, t, guess):
        self.model = model
        self._equations = model.once("bounded", lambda: _equations(model))
        self.n_x, self.m = len(model.state_names), len(invariant_names(model))
        self.size, ends = np.maximum(np.abs(guess), 1.0), (t, *corners_of(model))
        self.times = np.linspace(min(ends), max(ends), len(ends) + 9)  # at which is asked what rates depend on
        inertia = model.function("matrices")(t, guess, model.p)[-model.n :]
        self._choose(
            np.array([t]),
            np.asarray(guess, dtype=float)[:, None],
            self.n_x - self.m,
            sizes_of(model, inertia, np.ones(self.n_x), np.inf),  # with which no unit matters
        )

    # the internal dynamics

    @np.errstate(invalid="ignore")  # a singular state has no linearisation
    def local(self, t, x):
        """The linearisation at states x (n_x, N): z' (N, f) and A (N, f, f) on the invariants, step back and tangent.

        x + step (N, n_x) satisfies the invariants to first order with the same z; tangent (N, n_x, f) is ∂x/∂z.
        """
        f, J, g, G = self._evaluated(t, x)
        J = J[:, self.free]
        solved = _solutions(G[:, :, self.solved], np.concatenate([g[:, :, None], G[:, :, self.free]], axis=2))
        step, tangent = np.zeros((len(t), self.n_x)), np.zeros((len(t), self.n_x, len(self.free)))
        step[:, self.solved], tangent[:, self.solved] = -solved[:, :, 0], -solved[:, :, 1:]
        tangent[:, self.free] = np.eye(len(self.free))
        return f[:, self.free] + (J @ step[:, :, None])[:, :, 0], J @ tangent, step, tangent

    def _evaluated(self, t, x):
        """X' (N, n_x), ∂X'/∂X (N, n_x, n_x), the invariants (N, m), their Jacobian (N, m, n_x) at states (n_x, N)."""
        n, m = self.n_x, self.m
        y = self._equations.grid(t, x, self.model.p).T
        f, J, g, G = np.split(y, np.cumsum([n, n * n, m]), axis=1)
        return f, J.reshape(len(t), n, n).swapaxes(1, 2), g, G.reshape(len(t), n, m).swapaxes(1, 2)

    def _choose(self, t, x, count, sizes):
        """Choose the free entries: those that span the tangent space at all these states best, in sizes (n_x,)."""
        from scipy.linalg import qr

        G = self._evaluated(t, x)[3]
        if not np.isfinite(G).all():
            raise self._failure("The invariants are not finite near the guess.", t[0])
        tangents = np.linalg.svd(G * sizes)[2][:, self.m :]
        self.free = np.sort(qr(np.concatenate(tangents), pivoting=True)[2][:count])
        self.solved = np.setdiff1d(np.arange(self.n_x), self.free)
        least = np.linalg.svd(tangents[:, :, self.free], compute_uv=False)[:, -1] if count else np.ones(1)
        if least.min() < REGULAR:
            k = int(np.argmin(least))
            raise self._failure("No entries of the state are coordinates of the internal dynamics throughout.", t[k])

    # equilibria

    def _quasi_static(self, t, x, Q=None):
        """States (n_x, N) on the invariants at which Qᵀz' = 0, each by Newton's method; the nearest of a continuum."""
        x, size = x.copy(), self.size[self.free]
        for _ in range(NEWTON_STEPS):
            rate, A, step, tangent = self.local(t, x)
            A, right = A * size / size[:, None], (rate / size)[:, :, None]
            try:
                if Q is None:
                    solution = np.linalg.solve(A, right)
                else:
                    solution = Q @ np.linalg.pinv(Q.T @ A @ Q, CUTOFF) @ Q.T @ right
            except np.linalg.LinAlgError:
                return np.full_like(x, np.nan)
            change = step - (tangent @ (size[:, None] * solution))[:, :, 0]
            largest = np.abs(change / (self.size + np.abs(x.T))).max(axis=1, initial=0.0)
            x += (change * np.minimum(1.0, 1.0 / np.maximum(largest, 1e-300))[:, None]).T
            if not largest.max(initial=0.0) > NEWTON_ENDS:
                break
        return x

    def equilibrium(self, t, x, moving=False):
        """The equilibrium that Newton's method finds from a state (n_x,); IntegrationStopped if it finds none.

        Where integrals may be `moving` on, one of the other entries will do.
        """
        t, guess, size = np.array([float(t)]), np.asarray(x, dtype=float)[:, None], self.size[self.free]
        fastest = self._scaled(self.local(t, guess)[1]).max(initial=1.0)
        for Q in (entries(guess) for entries in (lambda x: np.eye(len(size)), self._others)[: 1 + moving]):
            x = self._quasi_static(t, guess, Q)
            rate, A, _, tangent = self.local(t, x)
            still = np.isfinite(x).all() and np.abs((rate / size) @ Q).max(initial=0.0) <= STANDS * fastest
            # where z are no coordinates, z' = 0 for motions that do not stand still
            if still and np.abs(tangent[0] * size / self.size[:, None]).max(initial=0.0) < 1 / REGULAR:
                break
        else:
            raise self._failure("Newton's method finds no equilibrium of the internal dynamics.", t[0])
        others, moving = self._others(x), Q.shape[1] < len(size)
        constants = self.free[(others**2).sum(axis=1) < 1 - CUTOFF]
        return End(t[0], x[:, 0], A[0], size, others, tuple(self.model.state_names[i] for i in constants), moving)

    def _others(self, rest):
        """An orthonormal basis (f, r) of z in its sizes without integrals: rates depend on none, or theirs alone."""
        x = rest + SPREAD * self.size[:, None] * np.random.default_rng(0).normal(size=(self.n_x, len(self.times)))
        for _ in range(2 * LIFTED):
            x = x + self.local(self.times, x)[2].T
        A, size = self.local(self.times, x)[1], self.size[self.free]
        A, Q = (A * size / size[:, None])[np.isfinite(A).all(axis=(1, 2))], np.eye(len(size))
        while len(A) and Q.shape[1]:
            _, s, directions = np.linalg.svd((Q.T @ A @ Q).reshape(-1, Q.shape[1]), full_matrices=False)
            if s[-1] > CUTOFF * s[0]:
                break
            Q = Q @ directions[s > CUTOFF * s[0]].T
        return Q

    def _scaled(self, A):
        """Magnitudes of the entries of matrices A (..., f, f) for z in its sizes."""
        size = self.size[self.free]
        return np.abs(A) * size / size[:, None]

    def moved(self, end, times):
        """The first of these times [s] at which an equilibrium or its linearisation is another one, or None."""
        Q = end.others if end.moving else np.eye(len(self.free))
        x = self._quasi_static(times, np.repeat(end.x[:, None], len(times), axis=1), Q)
        change = np.abs(Q.T @ ((x - end.x[:, None])[self.free] / self.size[self.free, None])).max(axis=0, initial=0.0)
        of_A = self._scaled(self.local(times, x)[1] - end.A).max(axis=(1, 2), initial=0.0)
        still = (change <= STANDS) & (of_A <= STANDS * self._scaled(end.A).max(initial=1.0))
        return None if still.all() else float(times[np.argmin(still)])

    def _failure(self, what, t):
        return IntegrationStopped(
            what,
            "The bounded motion joins two equilibria of the internal dynamics.",
            do="Give a start near the first equilibrium, or a smaller or slower path.",
            t=float(t),
        )


class Problem(FreeEntries):
    """The boundary value problem of a program along a span; see `bounded` for the parameters."""

    def __init__(self, model, span, guess):
        super().__init__(model, span[0], guess)
        self.span, self.iterations = span, 0
        self.c, self.derivative, *_ = radau(ORDER)
        first = self.equilibrium(span[0], guess)
        last = self.equilibrium(span[1], first.x, moving=True)
        times = np.linspace(*span, 41)
        along = first.x[:, None] + np.linspace(0, 1, 41) * (last.x - first.x)[:, None]
        along = self._quasi_static(times, along, None if first.modes is first else first.others)
        self.size = component_sizes(along, state_levels(model), 1.0)
        self._choose(times, along, self.n_x - self.m, self.size)
        self.first, self.last = (self.equilibrium(end.t, end.x, end.moving) for end in (first, last))
        self._require_splitting()

    def _require_splitting(self):
        """Refuse eigenvalues on the imaginary axis, and ends with different numbers of unstable ones."""
        for end, where in ((self.first, "begin"), (self.last, "end")):
            for value in end.modes.on_axis[:1]:
                value = value if value.imag else value.real
                raise UnstableInternalDynamics(
                    f"The internal dynamics have the eigenvalue {value:.4g} 1/s at the {where} of the program.",
                    "The bounded motion is unique only where no eigenvalue lies on the imaginary axis.",
                    do="Choose another output, or add damping.",
                    t=end.t,
                    eigenvalues=end.eigenvalues.tolist(),
                )
        unstable = [end.modes.unstable for end in (self.first, self.last)]
        if unstable[0] != unstable[1]:
            raise UnstableInternalDynamics(
                f"The internal dynamics have {unstable[0]} unstable modes at the start, {unstable[1]} at the end.",
                "An isolated bounded motion has as many at both ends.",
                do="Begin and end in equilibria of the same kind.",
                unstable=unstable,
            )

    def window(self, length):
        """Begin and end [s] of a window that exceeds the span by `length` time constants, rounded up to two digits."""
        (t0, t1), before, after = self.span, self.first.modes.eigenvalues.real, self.last.modes.eigenvalues.real
        begin = t0 - _two_digits(length / before[before > 0].min(initial=np.inf))
        end = t1 + _two_digits(length / -after[after < 0].max(initial=-np.inf))
        for end_state, t in ((self.first, begin), (self.last, end)):
            self._require_rest(end_state, t)
        return float(begin), float(end)

    def _require_rest(self, end, t):
        """Refuse a program that does not stand still between an end of its span and t."""
        moved = self.moved(end, np.linspace(end.t, t, 6)[1:])
        if moved is not None:
            raise SpecificationError(
                f"The internal dynamics have another equilibrium at t = {moved:.4g} s than at t = {end.t:.4g} s.",
                "Outside the span the program stands still, so that the bounded motion has a rest to leave or reach.",
                nearest=self._wider(),
                do="Choose the span of the whole transition, paths that rest outside it, or a shorter window.",
                t=moved,
                span=self.span,
            )

    def _wider(self):
        """The span that all knots of the paths lie in; "" if they lie in the present one."""
        (t0, t1), knots = self.span, corners_of(self.model)
        low, high = min(t0, *knots, t1), max(t0, *knots, t1)
        return f"({low:g}, {high:g}), which holds all knots of the paths." if (low, high) != (t0, t1) else ""

    # collocation

    def solve(self, window, knots, rtol, near=None):
        """The mesh (N + 1,) [s] and the states (n_x, 1 + N s) at its begin and at all nodes.

        The mesh begins with that of a solution for a shorter window, or is as fine as the fastest mode requires.
        """
        mesh = self._wider_mesh(window, near[0]) if near else self._first_mesh(window, knots)
        x = self.at(self._nodes(mesh), *near) if near else self._guess(mesh)
        for _ in range(REFINEMENTS):
            x = self._newton(mesh, x)
            defect = self._defect(mesh, x) if rtol < np.inf else np.zeros(1)
            if defect.max() <= rtol:
                return mesh, x
            pieces = np.ceil((defect / (AIM * rtol)) ** (1 / len(self.c))).astype(int)
            finer = subdivided(mesh, np.where(defect > AIM * rtol, np.clip(pieces, 2, MOST_PIECES), 1))
            if len(finer) > MOST_INTERVALS:
                break
            x = self.at(self._nodes(finer), mesh, x)
            mesh = finer
        worst = mesh[int(np.argmax(defect))]
        raise self._failure(f"The defect is still {defect.max():.1e} with {len(mesh) - 1} intervals.", worst)

    def _guess(self, mesh):
        """Equilibria at frozen instants; the straight line between the ends where there is none."""
        nodes = self._nodes(mesh)
        part = np.clip((nodes - self.span[0]) / (self.span[1] - self.span[0]), 0.0, 1.0)
        straight = self.first.x[:, None] + (self.last.x - self.first.x)[:, None] * part
        x = self._quasi_static(nodes, straight, None if self.first.modes is self.first else self.first.others)
        return np.where(np.isfinite(x).all(axis=0), x, straight)

    def _first_mesh(self, window, knots):
        """A mesh of the window that is graded between the ends of the span and the knots."""
        shortest, longest = self._lengths(window)
        self._require_resolved(window, longest)
        corners = breakpoints(window, sorted({*self.span, *knots}))
        while True:
            mesh = np.unique([t for a, b in pairwise(corners) for t in _graded(a, b, shortest, longest)])
            if len(mesh) <= MOST_INTERVALS or shortest == longest:
                return mesh
            shortest = min(2 * shortest, longest)  # with many knots, layers are left to refinement

    def _require_resolved(self, window, longest):
        """Refuse a window in which the unstable modes need intervals too short for a mesh."""
        count = int(np.ceil((window[1] - window[0]) / longest))
        if count > MOST_INTERVALS:
            unstable = max(self.first.fastest, self.last.fastest)
            raise LimitExceeded(
                f"The bounded motion from t = {window[0]:.4g} to {window[1]:.4g} s has an unstable mode of "
                f"{unstable:.4g} 1/s.",
                f"It needs {count} intervals, and a mesh has at most {MOST_INTERVALS}.",
                do="Leave this mode out of the mechanism, or take a shorter window, such as sv.methods.Bounded(5).",
                intervals=count,
                most=MOST_INTERVALS,
            )

    def _wider_mesh(self, window, mesh):
        """A mesh continued to a wider window."""
        lengths = self._lengths(window)
        before, after = _graded(window[0], mesh[0], *lengths), _graded(mesh[-1], window[1], *lengths)
        return np.unique(np.concatenate([before, mesh, after]))

    def _lengths(self, window):
        """Lengths [s] of first intervals, at corners and between them.

        Stable modes have layers at corners; unstable ones must grow in every interval, as they do in truth.
        """
        fastest = max(np.abs(end.eigenvalues).max(initial=0.0) for end in (self.first, self.last))
        unstable = max(self.first.fastest, self.last.fastest)
        shortest = LONGEST / fastest
        between = min((window[1] - window[0]) / FIRST_INTERVALS, COARSEST / unstable if unstable else np.inf)
        return shortest, max(shortest, between)

    def _nodes(self, mesh):
        return np.append(mesh[0], (mesh[:-1, None] + np.diff(mesh)[:, None] * self.c).ravel())

    def _newton(self, mesh, x):
        """Solve the collocation equations from an approximation x (n_x, 1 + N s)."""
        nodes, last = self._nodes(mesh), np.inf
        for _ in range(NEWTON_STEPS):
            self.iterations += 1
            step = self._newton_step(nodes, np.diff(mesh), x)
            size = np.abs(step / self.size[:, None]).max()
            if not np.isfinite(size):
                break
            x = x + step
            following = size**2 if last == np.inf else size * (size / last) ** 2  # of quadratic convergence
            if following <= NEWTON_ENDS or 0.1 * last < size <= STALLED:
                return x
            last = size
        raise self._failure("Newton's method for the bounded motion does not converge.", self.span[0])

    def _newton_step(self, nodes, h, x):
        """The Newton step (n_x, 1 + N s)."""
        rate, A, step, tangent = self.local(nodes, x)
        count, s, f = len(h), len(self.c), len(self.free)
        z = x[self.free].T
        stages, begin = z[1:].reshape(count, s, f), z[:-1:s]
        # D (ζ - z) - h z' = 0 with the increments ζ of the stages over the begin of their interval
        missing = h[:, None, None] * rate[1:].reshape(count, s, f) - self.derivative @ (stages - begin[:, None])
        at_ends = [(end.x[self.free] - z[i])[:, None] for i, end in ((0, self.first), (-1, self.last))]
        dz = self.linear(h, A, missing.reshape(count * s, f, 1), at_ends)
        return (step + (tangent @ dz)[:, :, 0]).T

    def linear(self, h, A, right, at_ends):
        """Solve the collocated ζ' = A ζ + b for k right sides: ζ (1 + N s, f, k) at the start and at all nodes.

        Stages are eliminated interval by interval, then the ends of the intervals are solved for. The intervals have
        the lengths h (N,) [s], A is (1 + N s, f, f), and `right` (N s, f, k) is h b at the nodes. ζ has the stable
        components of the first of `at_ends`, two (f, k) arrays, at the start, and the unstable ones of the other at the
        end.
        """
        count, s, f, k = len(h), len(self.c), len(self.free), right.shape[2]
        K = np.tile(np.kron(self.derivative, np.eye(f)), (count, 1, 1)).reshape(count, s, f, s, f)
        inside, length = A[1:].reshape(count, s, f, f), h[:, None, None]
        for j in range(s):
            K[:, j, :, j] -= length * inside[:, j]
        onto_begin = np.tile(np.kron(self.derivative.sum(axis=1)[:, None], np.eye(f)), (count, 1, 1))
        sides = np.concatenate([right.reshape(count, s * f, k), onto_begin], axis=2)
        eliminated = np.linalg.solve(K.reshape(count, s * f, s * f), sides)
        ends = self._solve_ends(eliminated[:, -f:, :k], eliminated[:, -f:, k:], at_ends)
        inner = eliminated[:, :, :k] + eliminated[:, :, k:] @ ends[:-1]
        return np.concatenate([ends[:1], inner.reshape(count * s, f, k)])

    @cached_property
    def _boundary_rows(self):
        """Left eigenvectors of the stable modes at the start (k, f), and of the unstable ones at the end (f - k, f)."""
        return self.first.left_space(unstable=False), self.last.left_space(unstable=True)

    def _solve_ends(self, constants, factors, at_ends):
        """ζ (N + 1, f, k) at the mesh points: ζ_(i+1) = constants_i + factors_i ζ_i between the boundary rows."""
        from scipy.linalg import solve_banded

        rows = self._boundary_rows
        (count, f, k), first = constants.shape, len(rows[0])
        matrix, right = np.zeros((4 * f + 1, (count + 1) * f)), np.empty(((count + 1) * f, k))

        def put(rows, columns, values):
            matrix[2 * f + rows - columns, columns] = values

        i, j = np.indices((first, f))
        put(i, j, rows[0])
        n, i, j = np.indices((count, f, f))
        put(first + n * f + i, n * f + j, -factors)
        n, i = np.indices((count, f))
        put(first + n * f + i, (n + 1) * f + i, 1.0)
        i, j = np.indices((f - first, f))
        put(first + count * f + i, count * f + j, rows[1])
        right[:first], right[first + count * f :] = (each @ part for each, part in zip(rows, at_ends, strict=True))
        right[first : first + count * f] = constants.reshape(count * f, k)
        return solve_banded((2 * f, 2 * f), matrix, right).reshape(count + 1, f, k)

    # between the nodes

    def at(self, t, mesh, x):
        """States (n_x, N) at times within the mesh; before and after it the equilibria."""
        k = np.clip(np.searchsorted(mesh, t, side="right") - 1, 0, len(mesh) - 2)
        theta = (t - mesh[k]) / (mesh[k + 1] - mesh[k])
        values = self._polynomial(x, k, basis(self.c, theta))
        values = self._on_invariants(t, values)
        values[:, t < mesh[0]], values[:, t > mesh[-1]] = self.first.x[:, None], x[:, -1:]
        return values

    def _polynomial(self, x, k, weights):
        """Values (n_x, N) in intervals k (N,) from the weights (s, N) of the increments over their begins."""
        s = len(self.c)
        begin = x[:, k * s]
        stages = x[:, 1:].reshape(self.n_x, -1, s)[:, k]
        return begin + np.einsum("xns,sn->xn", stages - begin[:, :, None], weights)

    def _on_invariants(self, t, x):
        for _ in range(LIFTED):
            _, _, g, G = self._evaluated(t, x)
            x = x.copy()
            x[self.solved] -= np.linalg.solve(G[:, :, self.solved], g[:, :, None])[:, :, 0].T
        return x

    def _defect(self, mesh, x):
        """Largest h (z' - f) between the nodes of each interval, relative to the sizes of z, (N,)."""
        count, h, free = len(mesh) - 1, np.diff(mesh), self.free
        k, theta = np.repeat(np.arange(count), len(BETWEEN)), np.tile(BETWEEN, count)
        t = mesh[k] + theta * h[k]
        change = self._polynomial(x, k, basis_rates(self.c, theta)) - x[:, k * len(self.c)]
        values = self._on_invariants(t, self._polynomial(x, k, basis(self.c, theta)))
        rates = self.local(t, values)[0].T
        defect = np.abs(change[free] - h[k] * rates) / self.size[free, None]
        return defect.max(axis=0, initial=0.0).reshape(count, -1).max(axis=1)

    def distance(self, x, y):
        """Largest difference of two motions (n_x, N), relative to the sizes of the state's entries."""
        return float(np.abs((x - y) / self.size[:, None]).max(initial=0.0))

    def require_pivots(self, t, pivots):
        """Refuse a motion along which a pivot changes its sign."""
        turned = (pivots * pivots[:, :1] <= 0).any(axis=0)
        if turned.any():
            k = int(np.argmax(turned))
            raise SingularProgram(
                f"A pivot of the equations vanishes at about t = {t[k]:.6g} s along the bounded motion.",
                "The equations of motion lose rank there, or need other pivots.",
                do="Choose a guess near this instant in derive(..., guess=), a slower path or another output.",
                t=float(t[k]),
            )


def _equations(model):
    """One compiled function: X', ∂X'/∂X, the invariants and their Jacobian, both by columns."""
    rates, slopes, invariants = (model.function(name).expression for name in ("ode", "ode_jacobian", "invariants"))
    parts = rates, slopes, invariants
    f = combined("bounded", lambda x, _, y, *others: ca.cse(ca.vertcat(y[: x.numel()], *others)), *parts)
    return compiled(f, "bounded", ("rk",))  # which is called at many points, and therefore compiled


def _two_digits(length):
    """A length rounded up to two digits, so that windows hold whole samples."""
    digit = 10.0 ** (np.floor(np.log10(length)) - 1) if length > 0 else 1.0
    return float(np.round(np.ceil(length / digit * (1 - 1e-12)) * digit, 12))


def _graded(a, b, shortest, longest):
    """A mesh from a to b: intervals grow by a factor of two from `shortest` at both ends to `longest`."""
    doubled = shortest * (2.0 ** np.arange(np.ceil(np.log2(longest / shortest))) * 2 - 1)
    layer = np.append(0.0, doubled[3 * doubled < b - a])
    low, high = a + layer[-1], b - layer[-1]
    between = np.linspace(low, high, max(1, int(np.ceil((high - low) / longest))) + 1)
    return np.concatenate([a + layer[:-1], between, (b - layer[:-1])[::-1]])


def subdivided(mesh, counts):
    """The mesh with each interval cut into so many, (N,) int."""
    pieces = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(mesh[:-1], mesh[1:], counts, strict=True)]
    return np.append(np.concatenate(pieces), mesh[-1])


def basis_rates(c, theta):
    """Derivatives of `basis` (s, N) at theta (N,)."""
    nodes = np.append(0.0, c)
    powers = np.arange(1, len(nodes))
    coefficients = np.linalg.inv(np.vander(nodes, increasing=True))[1:, 1:]
    return coefficients.T @ (powers[:, None] * theta ** (powers[:, None] - 1))


def _solutions(matrices, right):
    """X (N, m, k) of A X = B for each of N systems; nan where A is singular."""
    try:
        return np.linalg.solve(matrices, right)
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.full_like(right, np.nan)
        return np.concatenate([_solutions(A[None], B[None]) for A, B in zip(matrices, right, strict=True)])
