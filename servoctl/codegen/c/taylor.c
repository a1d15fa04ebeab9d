/* Steps of the Taylor method. NQ, N, TOP and LAST are the numbers of coordinates and quasi-velocities, the order s and
   the highest index of coefficients; PLAIN says whether q' = gamma'. Loops over them are unrolled. */
#include "unit.h"
#include "restore.h"

static inline double falling(int64_t k, int64_t j)
{
    double product = 1;
    for (int64_t m = 0; m < j; m++) product *= (double)(k - m);
    return product;
}

static inline double largest_size(const double *v, int64_t n)
{
    double largest = 0;
    for (int64_t i = 0; i < n; i++) if (!(fabs(v[i]) <= largest)) largest = fabs(v[i]);
    return largest;
}

/* log2 of the step at which the last term meets the tolerance at the first `levels` levels of the state, the
   terms taken to grow as the fastest of the upper half do: single coefficients may vanish. */
static inline double length(const double *x, const double *c, int64_t n, int64_t levels, double log_rtol, double least)
{
    const int64_t last = LAST;
    double size[LAST + 1], shortest = INFINITY;
    for (int64_t k = last / 2 > 1 ? last / 2 : 1; k <= last; k++) {
        const double largest = largest_size(c + (k - 1) * n, n);
        if (!isfinite(largest)) return -INFINITY;
        size[k] = log2(largest);
    }
    for (int64_t j = 0; j < levels; j++) {
        const double scale = log2(least + (j ? largest_size(x + NQ + (j - 1) * n, n) : largest_size(x, NQ)));
        for (int64_t k = last / 2 > j ? last / 2 : j + 1; k <= last; k++) {
            const double growth = (scale - size[k] - log2(falling(k, j))) / (double)(k - j);
            shortest = fmin(shortest, log_rtol / (double)(last - j) + growth);
        }
    }
    return shortest;
}

/* The state a time h after the expansion: x_j = sum over k of k!/(k - j)! c_[k] h^(k - j); y holds the coefficients. */
static inline void move(const double *x, const double *y, const double *c, double h, double *x_next)
{
    double jet[NX + 1] = {0};
    for (int64_t k = LAST; k >= 1; k--) {
        for (int64_t i = 0; i < NQ; i++) jet[i] = jet[i] * h + y[(k - 1) * NQ + i];
        for (int64_t j = 1; j < TOP && j <= k; j++) {
            double *level = jet + NQ + (j - 1) * N;
            for (int64_t i = 0; i < N; i++) level[i] = level[i] * h + falling(k, j) * c[(k - 1) * N + i];
        }
    }
    for (int64_t i = 0; i < NQ; i++) x_next[i] = x[i] + jet[i] * h;
    for (int64_t i = NQ; i < NX; i++) x_next[i] = jet[i];
}

/* Steps of the Taylor method from the start (t, x, p) towards t1. The function gives the coefficients of q (unless
   plain), those of gamma, and pivots. The log has a row (t, x, y) for each step, and one more for the end. Returns the
   number of steps, at most max_steps; fewer without reaching t1 where a step vanishes or is not finite. */
int64_t FN(taylor)(const double *start, double t1, double rtol, double atol, int64_t project_every, int64_t max_steps,
           double *log)
{
    const double *p = start + 1 + NX, log_rtol = log2(rtol), least = atol / rtol;
    double t = start[0];
    for (int64_t i = 0; i < NX; i++) log[1 + i] = start[1 + i];
    for (int64_t step = 0; ; step++) {
        double *x = log + 1, *y = x + NX, *row = y + NY, *x_next = row + 1;
        log[0] = t;
        if (step == max_steps || t == t1) return step;
        NAME(t, x, p, y);
        const double *c = y + (PLAIN ? 0 : NQ * LAST);
        double h = length(x, c, N, TOP, log_rtol, least);
        if (!PLAIN) h = fmin(h, length(x, y, NQ, 1, log_rtol, least));
        h = exp2(h);
        if (!(h > 1e-13 * (1 + fabs(t)))) return step;
        const int ends = h >= fabs(t1 - t) * (1 - 1e-12);
        const double signed_h = ends ? t1 - t : t1 > t ? h : -h;
        move(x, y, c, signed_h, x_next);
        t = ends ? t1 : t + signed_h;
        for (int64_t i = 0; i < NX; i++) if (!isfinite(x_next[i])) return step;
        if (project_every && (step + 1) % project_every == 0) restore(t, x_next, p);
        log = row;
    }
}
