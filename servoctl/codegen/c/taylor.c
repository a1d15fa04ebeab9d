/* Steps of the Taylor method. NQ, N, TOP and LAST are the numbers of coordinates and quasi-velocities, the order s and
   the highest index of coefficients; PLAIN says whether q' = gamma'. Loops over them are unrolled. */
#include "unit.h"
#include "lanes.h"
#include "restore.h"
#include "series.h"

/* The bits of non-negative numbers have the order of the numbers, and those of NaN are largest. Of a level of rates only
   those count that are integrated. The weights w (n) may be NULL for 1. */
static inline double largest_size(const double *v, const double *w, int64_t n, int64_t level)
{
    int64_t largest = 0;
    for (int64_t i = 0; i < n; i++) {
        const int64_t bits = s_bits(w ? w[i] * fabs(v[i]) : fabs(v[i]));
        largest = bits > largest && (!level || IS_FREE((level - 1) * N + i)) ? bits : largest;
    }
    return s_value(largest);
}

/* log2 of the step at which the last term is 2^log_rtol of a level of the state, which is `scale` large, or for q of what
   q' moves it in the step; the terms are taken to grow as the fastest of some do: single coefficients may vanish. */
static inline double length(double scale, const double *c, const double *w, int64_t n, int64_t level, double log_rtol)
{
    const double log_scale = rough_log2(scale), rate = level ? 0 : rough_log2(largest_size(c, w, n, 0));
    double shortest = INFINITY;
    for (int64_t m = 0; m < TERMS; m++) {
        const int64_t k = term(m);
        if (k <= level || k < 2) continue;
        const double size = rough_log2(largest_size(c + (k - 1) * n, w, n, level));
        const double growth = (log_scale - size - rough_log2(falling(k, level))) * (1.0 / (double)(k - level));
        double h = log_rtol * (1.0 / (double)(LAST - level)) + growth;
        const double of_way = level ? h : log_rtol * (1.0 / (double)(LAST - 1)) + (rate - size) * (1.0 / (double)(k - 1));
        h = of_way > h ? of_way : h;
        shortest = h < shortest ? h : shortest;
    }
    return shortest;
}

/* The step h at which the last terms of all levels meet the tolerance, with weights w (NX) of the state or NULL. The size
   of q is how far it has `moved` from the start at most, since q itself hangs on the origin. */
static inline double step_length(const double *x, const double *y, const double *w, double log_rtol, double least,
                                 double moved)
{
    const double *c = y + (PLAIN ? 0 : NQ * LAST);
    double log_h = length(least + moved, y, w, NQ, 0, log_rtol);
    for (int64_t j = 1; j < TOP; j++) {
        const int64_t at = NQ + (j - 1) * N;
        const double *v = w ? w + at : w;
        const double of_level = length(least + largest_size(x + at, v, N, j), c, v, N, j, log_rtol);
        log_h = of_level < log_h ? of_level : log_h;
    }
    return rough_exp2(log_h);
}

/* The state a time h after the expansion: x_j = sum over k of k!/(k - j)! c_[k] h^(k - j); y holds the coefficients.
   Rates that rows determine are left to these. */
static inline void move(const double *x, const double *y, const double *c, double h, double *x_next)
{
    double jet[NX + 1] = {0};
    for (int64_t k = LAST; k >= 1; k--) {
        for (int64_t i = 0; i < NQ; i++) jet[i] = jet[i] * h + y[(k - 1) * NQ + i];
        for (int64_t j = 1; j < TOP && j <= k; j++) {
            double *level = jet + NQ + (j - 1) * N;
            for (int64_t i = 0; i < N; i++) {
                if (IS_FREE((j - 1) * N + i)) level[i] = level[i] * h + falling(k, j) * c[(k - 1) * N + i];
            }
        }
    }
    for (int64_t i = 0; i < NQ; i++) x_next[i] = x[i] + jet[i] * h;
    for (int64_t i = NQ; i < NX; i++) x_next[i] = IS_FREE(i - NQ) ? jet[i] : x[i];
}

/* Steps from the start (t, x, p) towards the last of the ends, in the direction of motion, at each of which a step ends: at
   most max_steps, which may be projected. The log has a row (t, x, y) for each step, and one more for the end. One pointer,
   since ctypes spends most of a call on converting arguments. */
typedef struct {
    double count, rtol, atol, project_every, max_steps;
    const double *start;
    double *log;
    const double *ends, *weights;
} Steps;

/* p, whose last number is the instant that selects the pieces of paths. */
static inline void on_branch(const double *p, double t, double *branch)
{
    for (int64_t i = 0; i < NP - 1; i++) branch[i] = p[i];
    branch[NP - 1] = t;
}

/* Steps of the Taylor method. The function gives the coefficients of q (unless plain), those of gamma, and pivots.
   Returns the number of steps; fewer than max_steps without reaching t1 where a step vanishes or is not finite. */
int64_t FN(taylor)(const Steps *s)
{
    const double log_rtol = log2(LAST_TERM * s->rtol), least = s->atol / s->rtol, *end = s->ends;
    const double *last = end + (int64_t)s->count - 1;
    const int64_t max_steps = (int64_t)s->max_steps, project_every = (int64_t)s->project_every;
    double t = s->start[0], t1 = *end, moved = 0, *log = s->log, p[NP], work[WORK];
    for (int64_t i = 0; i < NX; i++) log[1 + i] = s->start[1 + i];
    on_branch(s->start + 1 + NX, (t + t1) / 2, p);
    FN(still)(t, log + 1, p, 0, work);
    for (int64_t step = 0; ; step++) {
        double *x = log + 1, *y = x + NX, *row = y + NY, *x_next = row + 1;
        log[0] = t;
        if (step == max_steps || t == *last) {
            settle(t, x, p);
            return step;
        }
        if (t == t1) {
            t1 = *++end;
            p[NP - 1] = (t + t1) / 2;
            FN(still)(t, x, p, 0, work);
        }
        FN(moving)(t, x, p, y, work);
        const double *c = y + (PLAIN ? 0 : NQ * LAST), *w = s->weights;
        const double h = w ? step_length(x, y, w, log_rtol, least, moved) : step_length(x, y, 0, log_rtol, least, moved);
        if (!(h > 1e-13 * (1 + fabs(t)))) {
            settle(t, x, p);
            return step;
        }
        for (int64_t i = 0; i < N * (TOP - 1); i++) {
            if (!IS_FREE(i)) x[NQ + i] = falling(1 + i / N, 1 + i / N) * c[i];
        }
        const int ends = h >= fabs(t1 - t) * (1 - 1e-12);
        const double signed_h = ends ? t1 - t : t1 > t ? h : -h;
        move(x, y, c, signed_h, x_next);
        t = ends ? t1 : t + signed_h;
        for (int64_t i = 0; i < NX; i++) if (!isfinite(x_next[i])) return step;
        for (int64_t i = 0; i < NQ; i++) widen(&moved, (w ? w[i] : 1) * fabs(x_next[i] - s->start[1 + i]));
        if (project_every && (step + 1) % project_every == 0) {
            settle(t, x_next, p);
            restore(t, x_next, p);
        }
        log = row;
    }
}

#ifdef SETTLED
/* Put what rows determine in place of the first `settled` jets at n instants t in the steps k of a log, and enlarge
   `farthest` (N) to its largest distance from gamma^(s) if that is among the jets. */
static void by_rows(const double *log, int64_t n, const int64_t *k, const double *t, const double *p, int64_t settled,
                    double *jets, double *farthest)
{
    for (int64_t at = 0; at < n; at++) {
        const double *row = log + k[at] * (1 + NX + NY);
        double x[NX + 1], branch[NP], all[NX + N];
        for (int64_t i = 0; i < NX; i++) x[i] = jets[i * n + at];
        on_branch(p, (row[0] + row[1 + NX + NY]) / 2, branch);
        FN(settled)(t[at], x, branch, all);
        for (int64_t i = 0; i < N && farthest; i++) widen(farthest + i, fabs(jets[(NX + i) * n + at] - all[NX + i]));
        for (int64_t i = NQ; i < settled; i++) jets[i * n + at] = all[i];
    }
}
#else
#define by_rows(log, n, k, t, p, settled, jets, farthest) ((void)(p), (void)(settled), (void)(farthest))
#endif

/* The jets q, gamma', ..., gamma^(levels) at n instants t in the steps k of a log, row by row, one column per instant.
   The lanes of a vector are consecutive instants of one step. Of the first `settled` jets those that rows determine are
   theirs. */
void FN(taylor_jets)(const double *log, int64_t n, const int64_t *k, const double *t, const double *p, int64_t levels,
                     int64_t settled, double *jets)
{
    double factor[LAST + 1];
    for (int64_t j = 0; j <= levels; j++) {
        const int64_t size = j ? N : NQ;
        double *rows = jets + (j ? NQ + (j - 1) * N : 0) * n;
        for (int64_t m = 1; m <= LAST; m++) factor[m] = falling(m, j);
        for (int64_t at = 0, count; at < n; at += count) {
            const double *row = log + k[at] * (1 + NX + NY), *x = row + 1, *c = x + NX + (j && !PLAIN ? NQ * LAST : 0);
            W h = ALL(0.0);
            for (count = 0; count < W_LANES && at + count < n && k[at + count] == k[at]; count++) {
                h[count] = t[at + count] - row[0];
            }
            for (int64_t i = 0; i < size; i++) {
                W total = ALL(0.0);
                for (int64_t m = LAST; m >= (j ? j : 1); m--) total = total * h + factor[m] * c[(m - 1) * size + i];
                if (!j) total = x[i] + total * h;
                for (int64_t b = 0; b < count; b++) rows[i * n + at + b] = total[b];
            }
        }
    }
    if (settled) by_rows(log, n, k, t, p, settled, jets, 0);
}

#include "whole.h"
