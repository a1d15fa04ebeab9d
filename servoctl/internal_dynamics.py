"""The internal dynamics that a program leaves: its linearisation and eigenvalues along a motion.

Deviations on the manifold of the constraints are N y. The frame N is orthonormal in the tangent space and does not turn
within it (Nᵀ N' = 0), so that y' = Nᵀ J N y with J = ∂X'/∂X. States are scaled by their sizes along the motion.
"""

from dataclasses import dataclass

import numpy as np

from servoctl.model.model import Model
from servoctl.run import Run, require_model

INSTANTS = 41  # instants along a run at which the internal dynamics is linearised
AT_ZERO = 1e-9  # size of a state relative to the largest, below which it is the rounding of zero
NEUTRAL = 1e-7  # of the largest entry of the linearisation: a smaller real part counts as zero


@dataclass(frozen=True, eq=False)
class InternalDynamics:
    """Eigenvalues of the internal dynamics, frozen at instants; made by `internal_dynamics`.

    Attributes
    ----------
    t : (N,) array
        [s]
    names : tuple of str
        Σ o_a states that may serve as its coordinates.
    eigenvalues : (Σ o_a, N) complex array
        [1/s], by descending real part.
    verdict : {"none", "stable", "neutral", "unstable"}
        "none" for flat programs; "neutral" has eigenvalues on the imaginary axis (symmetries, undamped oscillations),
        "unstable" some to the right of it at some instant.
    growth : float
        exp of the integral of the largest positive real part over the run: the growth of initial errors.
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


def linearised(model, run, count):
    """Linearise the internal dynamics along a run.

    Parameters
    ----------
    model : Model
    run : Run
        A motion of it.
    count : int
        Number of instants, spread over the samples; those without a finite Jacobian are left out.

    Returns
    -------
    t : (N,) array
        [s]
    A : (N, f, f) array
        Nᵀ J N [1/s], f = Σ o_a.
    N : (N, n_x, f) array
        Bases of the kernel of the invariants' Jacobian, SI.
    """
    n_x, size = len(model.state_names), np.abs(run.jets[: len(model.state_names)]).max(axis=1)
    size[size <= AT_ZERO * size.max()] = 1.0
    picked = np.unique(np.linspace(0, len(run.t) - 1, count).round().astype(int))
    J, C = (np.concatenate(parts) for parts in zip(*_jacobians(model, run, picked, n_x), strict=True))
    finite = np.isfinite(J).all(axis=(1, 2)) & np.isfinite(C).all(axis=(1, 2))
    first = min(C.shape[1], n_x - model.free)
    transposed = np.linalg.svd(C[finite] * size)[2][:, first : first + model.free]
    N = transposed.swapaxes(1, 2)
    return run.t[picked][finite], transposed @ (J[finite] * size / size[:, None]) @ N, size[:, None] * N


def _jacobians(model, run, picked, n_x):
    """∂X'/∂X (N, n_x, n_x) and the invariants' Jacobian (N, m, n_x) at samples, by variant of the model."""
    for first, end, variant in run.variants or ((0, len(run.t), model),):
        samples = picked[(picked >= first) & (picked < end)]
        if len(samples):
            t, x, p, m = run.t[samples], run.jets[:n_x, samples], variant.parameters, len(variant.invariant_names())
            J = variant.function("ode_jacobian").grid(t, x, p).T.reshape(-1, n_x, n_x).swapaxes(1, 2)
            C = variant.function("invariants").grid(t, x, p)[m:].T.reshape(-1, n_x, m).swapaxes(1, 2)
            yield J, C


def internal_dynamics(model: Model, run: Run) -> InternalDynamics:
    """Find the eigenvalues of the internal dynamics along a run.

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
    times, matrices, bases = linearised(model, run, INSTANTS)
    eigenvalues = np.linalg.eigvals(matrices).astype(complex)
    order = np.argsort(-eigenvalues.real, axis=1, kind="stable")
    eigenvalues = np.take_along_axis(eigenvalues, order, axis=1).T
    largest, rounding = eigenvalues.real.max(axis=0), NEUTRAL * np.abs(matrices).max()
    verdict = "unstable" if largest.max() > rounding else "stable" if largest.max() < -rounding else "neutral"
    growth = float(np.exp(np.trapezoid(np.maximum(largest, 0.0), np.abs(times - times[0]))))
    return InternalDynamics(times, _independent(model, bases), eigenvalues, verdict, growth)


def _independent(model, bases):
    """Names of states that serve as coordinates of the internal dynamics at all instants."""
    from scipy.linalg import qr

    tangents = np.linalg.qr(bases)[0]
    _, _, pivots = qr(np.concatenate(tangents.swapaxes(1, 2)), pivoting=True)
    return tuple(model.state_names[i] for i in np.sort(pivots[: model.free]))
