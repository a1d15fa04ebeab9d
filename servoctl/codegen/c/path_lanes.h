/* Jets of references at several instants at once, of which each lane may follow other paths. */
#include "lanes.h"
#include "path.h"

#ifndef PATH_LANES_H
#define PATH_LANES_H

#define W_PATH_JETS(K) \
static __attribute__((noinline, optimize("O3"))) \
void w_path_jets_##K(W paths, W instant, W t, int64_t n, W *out) \
{ \
    for (int64_t at = 0; at < n; at++) { \
        W tau, scale, factor = ALL(1.0), r[K + 1]; \
        Piece piece[W_LANES]; \
        int same = 1; \
        EACH_LANE piece[i] = path_at((const Path *)(uintptr_t)paths[i] + at, instant[i], t[i]); \
        EACH_LANE tau[i] = piece[i].tau, scale[i] = piece[i].scale, same &= piece[i].c == piece[0].c; \
        int64_t size = 0; \
        EACH_LANE size = piece[i].size > size ? piece[i].size : size; \
        _Pragma("GCC unroll 64") for (int64_t k = 0; k <= K; k++) r[k] = ALL(0.0); \
        for (int64_t j = size - 1; j >= 0; j--) { \
            W c = ALL(0.0); \
            if (same) c = ALL(piece[0].c[j]); \
            else EACH_LANE if (j < piece[i].size) c[i] = piece[i].c[j]; \
            _Pragma("GCC unroll 64") for (int64_t k = K; k > 0; k--) r[k] = r[k] * tau + r[k - 1]; \
            r[0] = r[0] * tau + c; \
        } \
        _Pragma("GCC unroll 64") for (int64_t k = 0; k <= K; k++) { \
            out[k * n + at] = r[k] * factor; \
            factor *= (double)(k + 1) * scale; \
        } \
        if (w_any((tau == 1.0) | (tau == -1.0))) EACH_LANE if (fabs(piece[i].tau) == 1) { \
            path_rest((const Path *)(uintptr_t)paths[i] + at, piece + i, K, n * W_LANES, (double *)(out + at) + i); \
        } \
    } \
}

#endif
