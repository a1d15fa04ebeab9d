/* Jets of references: of each a piecewise polynomial, found by the address of its first one, which is a number of p. */
#include "piece.h"

#ifndef PATH_H
#define PATH_H

/* path_jets_K: the derivatives 0 .. K of n references at time t, those of all references before the next ones. */
#define PATH_JETS(K) \
static __attribute__((noinline, optimize("O3"))) \
void path_jets_##K(double paths, double instant, double t, int64_t n, double *out) \
{ \
    for (int64_t i = 0; i < n; i++) { \
        const Path *path = (const Path *)(uintptr_t)paths + i; \
        const Piece piece = path_at(path, instant, t); \
        double r[K + 1], factor = 1; \
        _Pragma("GCC unroll 64") for (int64_t k = 0; k <= K; k++) r[k] = 0; \
        for (int64_t j = piece.size - 1; j >= 0; j--) { \
            _Pragma("GCC unroll 64") for (int64_t k = K; k > 0; k--) r[k] = r[k] * piece.tau + r[k - 1]; \
            r[0] = r[0] * piece.tau + piece.c[j]; \
        } \
        _Pragma("GCC unroll 64") for (int64_t k = 0; k <= K; k++) { \
            out[k * n + i] = r[k] * factor; \
            factor *= (double)(k + 1) * piece.scale; \
        } \
        if (fabs(piece.tau) == 1) path_rest(path, &piece, K, n, out + i); \
    } \
}

#endif
