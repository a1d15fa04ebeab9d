"""The internal dynamics that a program leaves: its eigenvalues along a motion, and what they allow."""

from dataclasses import dataclass

import numpy as np

from servoctl.run import require_model

SAMPLES = 41  # instants along a run at which the internal dynamics is linearised
NEUTRAL = 1e-7  # of the largest entry of the linearisation: a smaller real part is none


@dataclass(frozen=True, eq=False)
class InternalDynamics:
    """Eigenvalues of the motion's freedom that the program leaves, frozen at instants; made by `internal_dynamics`.

    Attributes
    ----------
    t : (N,) array
        [s]
    names : tuple of str
        The states that were taken as its coordinates, Σ o_a of them.
    eigenvalues : (Σ o_a, N) complex array
        [1/s], by descending real part.
    verdict : {"none", "stable", "neutral", "unstable"}
        None is left for flat programs; "neutral" has eigenvalues on the imaginary axis (symmetries, oscillations
        without damping), "unstable" some to the right of it at some instant.
    growth : float
        exp of the integral of the largest positive real part over the run: by how much errors of the start grow.
    """

    t: np.ndarray
    names: tuple
    eigenvalues: np.ndarray
    verdict: str
    growth: float

    def __repr__(self):
        if self.verdict == "none":
            return "InternalDynamics: none (the program determines the motion)"
        low, high = self.eigenvalues.real.min(), self.eigenvalues.real.max()
        return (
            f"InternalDynamics: {self.verdict}; {len(self.names)} states ({', '.join(self.names)})\n"
            f"  real parts {low:.4g} .. {high:.4g} 1/s along the motion; errors grow by {self.growth:.2g}"
        )


def internal_dynamics(model, run):
    """Linearise the internal dynamics along a run, in Σ o_a of the state's own entries.

    With the state split by the invariants Ψ(t, X) = 0 into dependent and independent entries, ∂X/∂y spans the kernel of
    ∂Ψ/∂X, and the internal dynamics y' = f_y(t, X(y, t)) has the Jacobian (∂f/∂X)_y ∂X/∂y.

    Parameters
    ----------
    model : Model
    run : Run
        A motion of it.

    Returns
    -------
    InternalDynamics

    Raises
    ------
    SpecificationError
        If the run is not of this model; a loaded run has none.
    """
    require_model(model, run, "internal_dynamics")
    if model.free == 0:
        return InternalDynamics(run.t[:0], (), np.zeros((0, 0), complex), "none", 1.0)
    picked = np.unique(np.linspace(0, len(run.t) - 1, SAMPLES).astype(int))
    times, states = run.t[picked], run.jets[: len(model.state_names), picked]
    own = [run.variant(i) for i in picked]
    tangents = [_tangent(*point) for point in zip(own, times, states.T, strict=True)]
    entries = _independent(tangents)
    reduced = [_reduced(*point, basis, entries) for *point, basis in zip(own, times, states.T, tangents, strict=True)]
    found = [np.linalg.eigvals(matrix) for matrix in reduced]
    eigenvalues = np.array([values[np.argsort(-values.real)] for values in found]).T
    largest, rounding = eigenvalues.real.max(axis=0), NEUTRAL * np.abs(reduced).max()
    verdict = "unstable" if largest.max() > rounding else "stable" if largest.max() < -rounding else "neutral"
    growth = float(np.exp(np.trapezoid(np.maximum(largest, 0.0), np.abs(times - times[0]))))
    return InternalDynamics(times, tuple(model.state_names[i] for i in entries), eigenvalues, verdict, growth)


def _tangent(model, t, x):
    """A basis of the states' changes that the invariants allow, (n_x, Σ o_a)."""
    from scipy.linalg import null_space

    n_x, count = len(x), len(model.invariant_names())
    jacobian = model.function("invariants")(t, x, model.parameters)[count:].reshape(n_x, count).T
    sizes = np.abs(jacobian).max(axis=1, keepdims=True, initial=0.0)
    return null_space(jacobian / np.where(sizes > 0, sizes, 1.0))[:, : model.free] if count else np.eye(n_x)


def _independent(tangents):
    """Entries of the state that serve as coordinates of the motion's freedom at all instants."""
    from scipy.linalg import qr

    _, _, pivots = qr(np.concatenate([basis.T for basis in tangents]), pivoting=True)
    return np.sort(pivots[: tangents[0].shape[1]])


def _reduced(model, t, x, basis, entries):
    """The Jacobian of the internal dynamics in the chosen entries."""
    n_x = len(x)
    jacobian = model.function("ode_jacobian")(t, x, model.parameters).reshape(n_x, n_x).T
    return (jacobian @ basis)[entries] @ np.linalg.inv(basis[entries])
