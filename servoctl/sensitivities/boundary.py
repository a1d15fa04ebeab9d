"""The tangent of a bounded motion: the linear boundary value problem of its variational equation.

The free entries z of the state obey z' = f(t, z, p), so that their tangent obeys δz' = A δz + b with A = ∂f/∂z and
b = ∂f/∂p. It is bounded if its stable components at the begin of the window, and its unstable ones at the end, are
those of the equilibria, δz = -A⁻¹ b. It is collocated at the nodes of the motion itself.
"""

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.errors import SpecificationError, UnstableInternalDynamics
from servoctl.methods.bounded import Problem
from servoctl.methods.choice import Bounded
from servoctl.methods.radau import basis
from servoctl.sensitivities.tangent import invariants_by, parameter_symbols, start_of

SAME_MOTION = 1e-3  # of its size: a run that differs by more is not the bounded motion of its program


def bounded_tangent(model, run, names):
    """The tangent (n_x, k, N) of the state of a bounded run by parameters.

    Parameters
    ----------
    model : Model
    run : Run
    names : tuple of str
        Of the parameters.

    Raises
    ------
    SpecificationError
        If the samples do not tell the window of the motion.
    """
    problem, mesh, x = _recomputed(model, run)
    at_nodes = _Linear(problem, names, problem._nodes(mesh), x)
    dz = _collocated(problem, at_nodes, np.diff(mesh))
    k = np.clip(np.searchsorted(mesh, run.t, side="right") - 1, 0, len(mesh) - 2)
    weights = basis(problem.c, (run.t - mesh[k]) / (mesh[k + 1] - mesh[k]))
    at_samples = _Linear(problem, names, run.t, run.jets[: problem.n_x])
    begin = dz[k * len(problem.c)]
    stages = dz[1:].reshape(len(mesh) - 1, len(problem.c), *dz.shape[1:])[k]
    dz = begin + np.einsum("nsfk,sn->nfk", stages - begin[:, None], weights)
    return at_samples.lifted(dz).transpose(1, 2, 0)


def _recomputed(model, run):
    """The boundary value problem of a bounded run with its mesh and states; samples need not cover its window."""
    t, guess = start_of(run)
    try:
        problem = Problem(model, (t, float(max(run.t[-1], *run.knots, t))), guess)
        begin, end = problem.window(Bounded().window)
    except (SpecificationError, UnstableInternalDynamics) as error:
        raise _unknown_window(run, "is not at rest before its start or after its last sample") from error
    window = min(begin, float(run.t[0])), end
    mesh, x = problem.solve(window, run.knots, Bounded().rtol)
    off = problem.distance(problem.at(run.t, mesh, x), run.jets[: problem.n_x])
    if not off <= SAME_MOTION:
        raise _unknown_window(run, f"differs by {off:.1e} of its size from the bounded one from rest to rest", off=off)
    return problem, mesh, x


def _unknown_window(run, what, **facts):
    return SpecificationError(
        f"The run has samples from t = {run.t[0]:.4g} to {run.t[-1]:.4g} s, and its motion {what}.",
        "The derivatives of a bounded motion depend on the whole of it, from rest to rest.",
        do="Leave t_eval out in simulate, or sample the whole window of the motion; its message says which that is.",
        samples=(float(run.t[0]), float(run.t[-1])),
        **facts,
    )


class _Linear:
    """A (N, f, f) and b (N, f, k) at states, and ∂x/∂p (N, n_x, k) with the free entries held."""

    def __init__(self, problem, names, t, x):
        n_x, m, k, p = problem.n_x, problem.m, len(names), problem.p
        _, self.A, _, self.tangent = problem.local(t, x)
        y = invariants_by(problem.model, names).grid(t, x, p)[m:].T.reshape(len(t), n_x + k, m).swapaxes(1, 2)
        self.held = np.zeros((len(t), n_x, k))
        self.held[:, problem.solved] = -np.linalg.solve(y[:, :, problem.solved], y[:, :, n_x:])
        slopes = _rates_by(problem.model, names).grid(t, x, p).T.reshape(len(t), n_x + k, n_x).swapaxes(1, 2)
        self.b = (slopes[:, :, :n_x] @ self.held + slopes[:, :, n_x:])[:, problem.free]

    def lifted(self, dz):
        """The tangent (N, n_x, k) of the state from that of the free entries (N, f, k)."""
        return self.held + self.tangent @ dz


def _rates_by(model, names):
    """∂X'/∂X and ∂X'/∂p, column by column, as a function of (t, X, p)."""

    def build():
        e = model.equations
        rates = e.ode()(e.q.t, e.state, e.parameters)[: e.state.numel()]
        both = ca.vertcat(e.state, parameter_symbols(e, names))
        f = e.function("rates_by", e.state, [ca.vec(ca.densify(ca.jacobian(rates, both)))])
        return compiled(f, "rates_by", ("rk",))  # which is evaluated at many points, and therefore compiled

    return model.once(f"rates by {' '.join(names)}", build)


def _collocated(problem, linear, h):
    """The tangent of the free entries (1 + N s, f, k) at the begin and at all nodes of the mesh."""
    count, s, f, k = len(h), len(problem.c), len(problem.free), linear.b.shape[2]
    inside, length = linear.A[1:].reshape(count, s, f, f), h[:, None, None]
    K = np.tile(np.kron(problem.derivative, np.eye(f)), (count, 1, 1)).reshape(count, s, f, s, f)
    for j in range(s):
        K[:, j, :, j] -= length * inside[:, j]
    onto_begin = np.tile(np.kron(problem.derivative.sum(axis=1)[:, None], np.eye(f)), (count, 1, 1))
    right = np.concatenate([length * linear.b[1:].reshape(count, s * f, k), onto_begin], axis=2)
    eliminated = np.linalg.solve(K.reshape(count, s * f, s * f), right)
    rest = [-np.linalg.solve(linear.A[i], linear.b[i]) for i in (0, -1)]
    ends = np.empty((count + 1, f, k))
    for j in range(k):
        beside = np.zeros((count + 1, f))  # at whose ends the equilibria lie by these amounts
        beside[0] = problem.first.x[problem.free] - rest[0][:, j]
        beside[-1] = problem.last.x[problem.free] - rest[1][:, j]
        ends[:, :, j] = problem._solve_ends(eliminated[:, -f:, j], eliminated[:, -f:, k:], beside)
    inner = eliminated[:, :, :k] + eliminated[:, :, k:] @ ends[:-1]
    return np.concatenate([ends[:1], inner.reshape(count * s, f, k)])
