/* Jets of references: of each a piecewise polynomial, found by the address of its first one, which is a number of p. */
#include "unit.h"

#ifndef PATH_H
#define PATH_H

typedef struct {
    int64_t pieces, row, size; /* numbers of pieces, from one piece to the next, and of coefficients of a piece */
    int64_t before, after;     /* outside: 0 the value is held, 1 the end piece goes on, 2 all pieces repeat */
    const double *breaks, *c;  /* pieces + 1 instants; coefficients of the powers of a time from -1 to 1 on each piece */
} Path;

/* The piece that counts at an instant: the last one whose begin is reached; the first one where it is NaN. */
static int64_t path_piece(const Path *path, double t)
{
    const double *b = path->breaks;
    int64_t low = 0, high = path->pieces - 1;
    const double place = (t - b[0]) / (b[high + 1] - b[0]) * (double)path->pieces;
    int64_t guess = place > 0 ? (place < (double)high ? (int64_t)place : high) : 0;
    if (b[guess] <= t && (guess == high || t < b[guess + 1])) return guess; /* equal pieces */
    while (low < high) {
        const int64_t middle = (low + high + 1) / 2;
        if (b[middle] <= t) low = middle;
        else high = middle - 1;
    }
    return low;
}

typedef struct {
    const double *c;
    int64_t size;
    double tau, scale; /* the local time, and its rate: 0 where the path is held */
} Piece;

/* The piece of a path at time t that an instant selects. */
static Piece path_at(const Path *path, double instant, double t)
{
    const double first = path->breaks[0], last = path->breaks[path->pieces];
    if (path->before == 2) {
        const double turns = floor((instant - first) / (last - first)) * (last - first);
        instant -= turns;
        t -= turns;
    }
    const int64_t k = path_piece(path, instant);
    const double low = path->breaks[k], high = path->breaks[k + 1];
    const int held = (instant < first && !path->before) || (instant > last && !path->after);
    const Piece piece = {path->c + k * path->row, path->size,
                         held ? (instant < first ? -1.0 : 1.0) : ((t - low) + (t - high)) / (high - low),
                         held ? 0.0 : 2.0 / (high - low)};
    return piece;
}

/* path_jets_K: the derivatives 0 .. K of n references at time t, those of all references before the next ones. */
#define PATH_JETS(K) \
static __attribute__((noinline, optimize("O3"))) \
void path_jets_##K(double paths, double instant, double t, int64_t n, double *out) \
{ \
    for (int64_t i = 0; i < n; i++) { \
        const Piece piece = path_at((const Path *)(uintptr_t)paths + i, instant, t); \
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
    } \
}

#endif
