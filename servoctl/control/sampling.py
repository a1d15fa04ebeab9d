"""Plants seen from sample to sample: exact discretisation under a zero-order hold, and the loops that it closes."""

import numpy as np

SCALED, TERMS = 0.5, 16  # norm of a matrix whose exponential is summed; 0.5^17/17! is 2e-20


def discretised(A, B, period):
    """Exact discretisation of A (N, n, n), B (N, n, m) under a zero-order hold of a period [s]: exp([A B; 0 0] Ts)."""
    n, m = B.shape[1:]
    both = np.zeros((len(A), n + m, n + m))
    both[:, :n, :n], both[:, :n, n:] = A * period, B * period
    exact = exponentials(both)
    return exact[:, :n, :n], exact[:, :n, n:]


def exponentials(matrices):
    """exp of each matrix, (N, n, n): its Taylor series to rounding, scaled and squared, for all at once."""
    norm = np.abs(matrices).sum(axis=2).max(initial=0.0)
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / SCALED))))
    scaled, eye = matrices / 2**squarings, np.eye(matrices.shape[1])
    power = eye
    for k in range(TERMS, 0, -1):
        power = eye + scaled @ power / k
    for _ in range(squarings):
        power = power @ power
    return power


def spectral_radii(matrices):
    """Largest absolute eigenvalue of each matrix, (N,)."""
    return np.abs(np.linalg.eigvals(matrices)).max(axis=-1, initial=0.0)


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
