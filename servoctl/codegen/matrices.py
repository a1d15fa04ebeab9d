"""Exponentials and the Riccati equation of many small matrices, compiled for their size once on a machine."""

import contextlib
import ctypes

import numpy as np

from servoctl.codegen import compiler
from servoctl.codegen.native import pointer

FEWEST_COMPILED = 100  # matrices up to which NumPy takes at most two milliseconds
PRODUCTS = 3e7  # multiplications of one call, some hundredths of a second: then Python looks for Ctrl-C


def norms(matrices, scales):
    """Largest sums (N,) of a row's magnitudes, of matrices x (N, n, n) over scales s (n, n), entry by entry."""
    count, n, _ = matrices.shape
    call = _function("exponentials", "norms", count, N=n)
    if call is None:
        return np.abs(matrices / scales).sum(axis=2).max(axis=1, initial=0.0)
    x, scales, result = _whole(matrices), _whole(scales), np.empty(count)
    call(ctypes.c_int64(count), pointer(x), pointer(scales), pointer(result))
    return result


def exponentials(matrices, scales, squarings, terms):
    """s exp(x/s 2^-k)^(2^k) (N, n, n) by the Taylor series of some terms.

    `matrices` x are (N, n, n), `scales` s (n, n), powers of two for each entry, and `squarings` k (N,).
    """
    count, n, _ = matrices.shape
    call = _function("exponentials", "exponentials", count, N=n)
    if call is None:
        return squared(matrices / scales, squarings, terms) * scales
    x, scales, y = _whole(matrices), _whole(scales), np.empty((count, n, n))
    squarings = np.ascontiguousarray(squarings, dtype=np.int64)
    for part in _parts(count, terms * n**3):
        given = (pointer(x[part]), pointer(scales), pointer(squarings[part]), ctypes.c_int64(terms))
        call(_length(part), *given, pointer(y[part]))
    return y


def squared(matrices, squarings, terms):
    """exp(A/2^k)^(2^k) of each matrix, (N, n, n), in their own precision, with k in `squarings`, (N,)."""
    scaled, eye = matrices / np.exp2(squarings)[:, None, None].astype(matrices.dtype), np.eye(matrices.shape[1])
    power = np.broadcast_to(eye, scaled.shape).astype(matrices.dtype)
    for k in range(terms, 0, -1):
        power = eye + scaled @ power / k
    for k in range(squarings.max(initial=0)):
        more = squarings > k
        power[more] = power[more] @ power[more]
    return power


def riccati(A, B, Q, R, P, of_state=True):
    """H = R + BᵀPB and K = H⁻¹BᵀPA, then P = Q + AᵀP(A - BK), at one sample after another.

    A and Q are (N, n, n), B is (N, n, m), R (m, m) and the first P (n, n). Returned are the gains K (N, m, n), or
    H⁻¹BᵀP unless `of_state`, H (N, m, m), and P after the last sample.
    """
    count, n, m = B.shape
    call = _function("riccati", "riccati", count, N=n, NU=m) if m else None
    if call is None:
        return _by_numpy(A, B, Q, R, P, of_state)
    A, B, Q = (_with_rows(part) for part in (A, B, Q))
    R, P = _whole(R), np.array(P, dtype=float, order="C")
    gains, H = np.empty((count, m, n)), np.empty((count, m, m))
    for part in _parts(count, 3 * n**3):
        given = [entry for stack in (A, B, Q) for entry in (pointer(stack[part]), *_distances(stack))]
        outputs = (pointer(P), pointer(gains[part]), pointer(H[part]))
        call(_length(part), *given, pointer(R), ctypes.c_int64(of_state), *outputs)
    return gains, H, P


def _by_numpy(A, B, Q, R, P, of_state):
    count, n, m = B.shape
    gains, H = np.full((count, m, n), np.nan), np.full((count, m, m), np.nan)
    with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):  # of weights beyond the range of floats
        for k in range(count):
            PB = P @ B[k]
            H[k] = R + B[k].T @ PB
            G = np.linalg.solve(H[k], PB.T)
            K = G @ A[k]
            gains[k] = K if of_state else G
            P = Q[k] + A[k].T @ P @ (A[k] - B[k] @ K)
            P = (P + P.T) / 2
    return gains, H, P


def _function(file, name, count, **sizes):
    """A C function of a file for matrices of these sizes; None where NumPy is as good, and without a compiler."""
    if count <= FEWEST_COMPILED:
        return None
    defined = {"NAME": "servoctl", **sizes, "NX": 1, "NP": 1, "NY": 1}
    text = "".join(f"#define {key} {value}\n" for key, value in defined.items()) + f'#include "{file}.c"\n'
    library = compiler.library(text, "-O3", calls=count)
    return None if library is None else library[f"servoctl_{name}"]


def _parts(count, products):
    """Slices of so many matrices that each takes some hundredths of a second."""
    size = max(1, int(PRODUCTS / products))
    return [slice(a, min(a + size, count)) for a in range(0, count, size)]


def _whole(array):
    return np.ascontiguousarray(array, dtype=float)


def _length(part):
    return ctypes.c_int64(part.stop - part.start)


def _with_rows(stack):
    """A stack of matrices of doubles whose rows have no gaps, in place where it is one."""
    whole = stack.dtype == float and stack.strides[-1] == stack.itemsize and not any(s % 8 for s in stack.strides)
    return stack if whole else np.ascontiguousarray(stack, dtype=float)


def _distances(stack):
    """Distances from a matrix and from a row to the next, in numbers."""
    return (ctypes.c_int64(step // stack.itemsize) for step in stack.strides[:2])
