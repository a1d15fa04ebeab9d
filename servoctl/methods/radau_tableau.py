"""Radau IIA methods as data."""

import functools

import numpy as np

# Stages by order. All are L-stable; the matrix of an odd number of stages has one real eigenvalue.
STAGES = {5: 3, 9: 5, 13: 7}


@functools.cache
def radau(order):
    """The Radau IIA method of an order (Hairer and Wanner 1996, IV.5 and IV.8).

    Parameters
    ----------
    order : {5, 9, 13}

    Returns
    -------
    c : (s,) array
        Nodes, the last of which is 1.
    rate : (s, s) array
        A⁻¹: what takes increments of the stages to h times their rates, the derivative of the collocation polynomial.
    from_pairs, to_pairs : (s, s) arrays
        Real and imaginary parts of the eigenvectors of A⁻¹ as columns, and their inverse.
    mu : ((s + 1)/2, 2) array
        Eigenvalues of A⁻¹, real and imaginary parts: the real one, then one of each pair.
    e : (s,) array
        Weights of the increments in the error of the embedded method of order s.
    """
    from scipy.special import roots_jacobi

    s = STAGES[order]
    c = np.append((1.0 + roots_jacobi(s - 1, 1.0, 0.0)[0]) / 2.0, 1.0)
    nodes = np.append(0.0, c)
    gaps = nodes[:, None] - nodes + np.eye(s + 1)
    weights = 1.0 / gaps.prod(axis=1)
    derivative = weights / weights[:, None] / gaps
    derivative[np.diag_indices(s + 1)] = (1.0 / gaps).sum(axis=1) - 1.0
    rate = derivative[1:, 1:]
    values, vectors = np.linalg.eig(rate)
    real = np.argmin(np.abs(values.imag))
    pairs = [i for i in np.argsort(values.imag) if values[i].imag > 1e-6]
    columns = [vectors[:, real].real, *(part for i in pairs for part in (vectors[:, i].real, vectors[:, i].imag))]
    from_pairs = np.array(columns).T
    mu = np.array([[values[real].real, 0.0], *([values[i].real, -values[i].imag] for i in pairs)])
    # The embedded quadrature has the weight 1/mu_0 at the start and is of order s: what it adds to the weights b_i,
    # times A⁻¹; scaled so that (mu_0/h - J)⁻¹ (f + sum e_i z_i / h) is the error.
    powers = np.vander(c, s, increasing=True).T
    e = mu[0, 0] * np.linalg.solve(powers, np.append(-1.0 / mu[0, 0], np.zeros(s - 1))) @ rate
    return c, rate, from_pairs, np.linalg.inv(from_pairs), mu, e


def basis(c, theta):
    """Lagrange polynomials of the nodes c, and 0, at theta (N,): an (s, N) array."""
    nodes = np.append(0.0, c)
    rows = [[k for k in range(len(nodes)) if k != j] for j in range(1, len(nodes))]
    return np.array([np.prod([(theta - nodes[k]) / (nodes[j + 1] - nodes[k]) for k in r], axis=0)
                     for j, r in enumerate(rows)])  # fmt: skip
