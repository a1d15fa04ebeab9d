"""The tangent of a bounded motion: the linear boundary value problem of its variational equation.

The free entries z of the state obey z' = f(t, z, p), so that their tangent obeys δz' = A δz + b with A = ∂f/∂z and
b = ∂f/∂p. It is bounded if its stable components at the start of the window, and its unstable ones at the end, are
those of the equilibria, δz = -A⁻¹ b. It is collocated at the nodes of the motion itself.
"""

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.errors import SpecificationError, UnstableInternalDynamics
from servoctl.methods.bounded import Problem
from servoctl.methods.choice import Bounded
from servoctl.methods.radau import basis
from servoctl.model.following import moved_by, p_with_rates
from servoctl.sensitivities.tangent import by_parameters, invariants_by, kept, start_of
from servoctl.tolerances import CUTOFF

SAME_MOTION = 1e-3  # of its size: a run that differs by more is not the bounded motion of its program


def bounded_tangent(model, run, names):
    """The tangent (n_x, k, N) of the state of a bounded run by parameters.

    Refused if the samples do not determine the window of the motion.
    """
    problem, mesh, x = _recomputed(model, run)
    at_nodes = _Linear(problem, names, problem._nodes(mesh), x)
    h, s = np.diff(mesh), len(problem.c)
    rest = [-np.linalg.pinv(at_nodes.A[i], CUTOFF) @ at_nodes.b[i] for i in (0, -1)]
    dz = problem.linear(h, at_nodes.A, np.repeat(h, s)[:, None, None] * at_nodes.b[1:], rest)
    k = np.clip(np.searchsorted(mesh, run.t, side="right") - 1, 0, len(mesh) - 2)
    weights = basis(problem.c, (run.t - mesh[k]) / (mesh[k + 1] - mesh[k]))
    at_samples = _Linear(problem, names, run.t, run.jets[: problem.n_x])
    begin = dz[k * s]
    stages = dz[1:].reshape(len(h), s, *dz.shape[1:])[k]
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
        n_x, m, k, model = problem.n_x, problem.m, len(names), problem.model
        moved = moved_by(model, names)
        p = p_with_rates(model, moved)
        _, self.A, _, self.tangent = problem.local(t, x)
        y = invariants_by(model, names, moved).grid(t, x, p)[m:].T.reshape(len(t), n_x + k, m).swapaxes(1, 2)
        self.held = np.zeros((len(t), n_x, k))
        self.held[:, problem.solved] = -np.linalg.solve(y[:, :, problem.solved], y[:, :, n_x:])
        slopes = _rates_by(model, names, moved).grid(t, x, p).T.reshape(len(t), n_x + k, n_x).swapaxes(1, 2)
        self.b = (slopes[:, :, :n_x] @ self.held + slopes[:, :, n_x:])[:, problem.free]

    def lifted(self, dz):
        """The tangent (N, n_x, k) of the state from that of the free entries (N, f, k)."""
        return self.held + self.tangent @ dz


@kept
def _rates_by(model, names, moved):
    """∂X'/∂X and ∂X'/∂p, column by column, as a function of (t, X, p)."""
    e = model.equations
    rates = e.called(e.ode(), e.state, e.parameters)[: e.state.numel()]
    slopes = ca.horzcat(ca.jacobian(rates, e.state), by_parameters(e, rates, names, moved))
    f = e.function("rates_by", e.state, [ca.vec(ca.densify(slopes))], rates=moved)
    return compiled(f, "rates_by", ("rk",))  # which is evaluated at many points, and therefore compiled
