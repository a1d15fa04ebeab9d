/* A piecewise polynomial of time: the piece that counts at an instant. */
#include "unit.h"

#ifndef PIECE_H
#define PIECE_H

#include <float.h>

typedef struct {
    int64_t pieces, row, size; /* numbers of pieces, from one piece to the next, and of coefficients of a piece */
    int64_t before, after;     /* outside: 0 the value is held, 1 the end piece goes on, 2 all pieces repeat */
    int64_t first, last;       /* how many derivatives vanish at the first break, and at the last one */
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
    const double tau = held ? (instant < first ? -1.0 : 1.0) : ((t - low) + (t - high)) / (high - low);
    return (Piece){path->c + k * path->row, path->size, tau, held ? 0.0 : 2.0 / (high - low)};
}

/* At an end of a piece: derivatives r, a stride apart, that vanish are zero; rounding would determine directions. */
static void path_rest(const Path *path, const Piece *piece, int64_t most, int64_t stride, double *r)
{
    const int64_t first = piece->tau < 0 && piece->c == path->c ? path->first : 0;
    const int64_t last = piece->tau > 0 && piece->c == path->c + (path->pieces - 1) * path->row ? path->last : 0;
    double rounding = (double)piece->size * DBL_EPSILON;
    for (int64_t k = 0; k <= most; k++) {
        double terms = 0, binomial = 1;
        for (int64_t j = k; j < piece->size; j++) {
            terms += binomial * fabs(piece->c[j]);
            binomial *= (double)(j + 1) / (double)(j + 1 - k);
        }
        if ((k > 0 && k <= first + last) || fabs(r[k * stride]) <= rounding * terms) r[k * stride] = 0;
        rounding *= (double)(k + 1) * piece->scale;
    }
}

#endif
