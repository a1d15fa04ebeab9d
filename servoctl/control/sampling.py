"""Plants seen from sample to sample: exact discretisation under a zero-order hold, and the loops that it closes."""

import numpy as np

from servoctl.codegen import matrices as many

SCALED, TERMS = 0.5, 16  # norm of a matrix whose exponential is summed; 0.5^17/17! is 2e-20
IN_DOUBLE = 8  # squarings that leave 2^8 roundings of a double, 3e-14


def discretised(A, B, period):
    """Exact discretisation of A (N, n, n), B (N, n, m) under a zero-order hold of a period [s]: exp([A B; 0 0] Ts)."""
    n, m = B.shape[1:]
    both = np.zeros((len(A), n + m, n + m))
    np.multiply(A, period, out=both[:, :n, :n])
    np.multiply(B, period, out=both[:, :n, n:])
    exact = exponentials(both)
    return exact[:, :n, :n], exact[:, :n, n:]


def exponentials(matrices):
    """exp of each matrix, (N, n, n): its Taylor series, scaled and squared, for all at once.

    Balancing by powers of two removes the units of the entries. Each squaring doubles the relative error of slow modes
    beside fast ones; many of them are done in long doubles.
    """
    from scipy.linalg import matrix_balance

    sizes = np.maximum(matrices.max(axis=0, initial=0.0), -matrices.min(axis=0, initial=0.0))
    units = matrix_balance(np.nan_to_num(sizes), permute=False, separate=True)[1][0]
    scales = units[:, None] / units
    norm = np.maximum(many.norms(matrices, scales), SCALED)
    squarings = np.ceil(np.log2(norm / SCALED)).astype(int)
    result = many.exponentials(matrices, scales, squarings, TERMS)
    long = squarings > IN_DOUBLE
    if long.any():
        result[long] = many.squared((matrices[long] / scales).astype(np.longdouble), squarings[long], TERMS) * scales
    return result


def spectral_radii(matrices):
    """Largest absolute eigenvalue of each matrix, (N,); infinite where an entry is not finite."""
    radii = np.full(len(matrices), np.inf)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    radii[finite] = np.abs(np.linalg.eigvals(matrices[finite])).max(axis=-1, initial=0.0)
    return radii


def sampled_radii(A, B, K, period, delays):
    """Largest factor of errors per sample under u = -K x, held, with a delay [s] of each input, (N,).

    A (N, n, n) and B (N, n, m) are in continuous time, K is (N, m, n), `delays` (m,). With a delay of d samples and the
    part θ of one more, x+ = e^(A Ts) x + Γ_0 u_(k-d) + Γ_1 u_(k-d-1), where Γ_0 = Γ(Ts - θ) and Γ_1 = e^(A (Ts - θ))
    Γ(θ) (Åström and Wittenmark, Computer-Controlled Systems, section 2.3).
    """
    count, n, m = B.shape
    whole = np.floor(delays / period + 1e-9).astype(int)
    rest = np.maximum(delays - whole * period, 0.0)
    past = int(whole.max(initial=0)) + bool(rest.max(initial=0.0) > 1e-9 * period)
    loop = np.zeros((count, n + m * past, n + m * past))
    loop[:, :n, :n] = discretised(A, B, period)[0]
    for a, (d, late) in enumerate(zip(whole, rest, strict=True)):
        early, soon = discretised(A, B[:, :, a : a + 1], period - late)
        for samples, gamma in ((d, soon), (d + 1, early @ discretised(A, B[:, :, a : a + 1], late)[1])):
            if samples == 0:
                loop[:, :n, :n] -= gamma @ K[:, a : a + 1]
            elif samples <= past:
                loop[:, :n, n + m * (samples - 1) + a] += gamma[:, :, 0]
    if past:
        loop[:, n : n + m, :n] = -K
        loop[:, n + m :, n:-m] = np.eye(m * (past - 1))
    return spectral_radii(loop)
