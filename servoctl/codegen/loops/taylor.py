"""Steps of the Taylor method as C text.

NAME_nq, NAME_n, NAME_top, NAME_last and NAME_plain are constants: the numbers of coordinates and quasi-velocities, the
order s̄, the highest index of coefficients, and whether q' = γ'. Loops over them are unrolled.
"""

TAYLOR = """
static inline double NAME_falling(int64_t k, int64_t j)
{
    double product = 1;
    for (int64_t m = 0; m < j; m++) product *= (double)(k - m);
    return product;
}

static inline double NAME_largest(const double *v, int64_t n)
{
    double largest = 0;
    for (int64_t i = 0; i < n; i++) if (!(fabs(v[i]) <= largest)) largest = fabs(v[i]);
    return largest;
}

/* log2 of the step at which the last term stays below the tolerance at the first `levels` levels of the state, the
   terms taken to grow as the fastest of the upper half do: single coefficients may vanish. */
static inline double NAME_length(const double *x, const double *c, int64_t n, int64_t levels, double log_rtol,
                                 double least)
{
    const int64_t last = NAME_last;
    double size[NAME_last + 1], shortest = INFINITY;
    for (int64_t k = last / 2 > 1 ? last / 2 : 1; k <= last; k++) {
        const double largest = NAME_largest(c + (k - 1) * n, n);
        if (!isfinite(largest)) return -INFINITY;
        size[k] = log2(largest);
    }
    for (int64_t j = 0; j < levels; j++) {
        const double scale = log2(least + (j ? NAME_largest(x + NAME_nq + (j - 1) * n, n) : NAME_largest(x, NAME_nq)));
        for (int64_t k = last / 2 > j ? last / 2 : j + 1; k <= last; k++) {
            const double growth = (scale - size[k] - log2(NAME_falling(k, j))) / (double)(k - j);
            shortest = fmin(shortest, log_rtol / (double)(last - j) + growth);
        }
    }
    return shortest;
}

/* The state a time h after the expansion: x_j = sum over k of k!/(k - j)! c_[k] h^(k - j); y holds the coefficients. */
static inline void NAME_move(const double *x, const double *y, const double *c, double h, double *x_next)
{
    double jet[NAME_nx + 1] = {0};
    for (int64_t k = NAME_last; k >= 1; k--) {
        for (int64_t i = 0; i < NAME_nq; i++) jet[i] = jet[i] * h + y[(k - 1) * NAME_nq + i];
        for (int64_t j = 1; j < NAME_top && j <= k; j++) {
            double *level = jet + NAME_nq + (j - 1) * NAME_n;
            for (int64_t i = 0; i < NAME_n; i++) level[i] = level[i] * h + NAME_falling(k, j) * c[(k - 1) * NAME_n + i];
        }
    }
    for (int64_t i = 0; i < NAME_nq; i++) x_next[i] = x[i] + jet[i] * h;
    for (int64_t i = NAME_nq; i < NAME_nx; i++) x_next[i] = jet[i];
}

/* Steps of the Taylor method from the start (t, x, p) towards t1. The function gives the coefficients of q (unless
   plain), those of gamma, and guards. The log has a row (t, x, y) for each step, and one more for the end. Returns the
   number of steps, at most max_steps; fewer without reaching t1 where a step vanishes or is not finite. */
int64_t NAME_taylor(const double *start, double t1, double rtol, double atol, int64_t project_every, int64_t max_steps,
                    double *log)
{
    const double *p = start + 1 + NAME_nx, log_rtol = log2(rtol), least = atol / rtol;
    double t = start[0];
    for (int64_t i = 0; i < NAME_nx; i++) log[1 + i] = start[1 + i];
    for (int64_t step = 0; ; step++) {
        double *x = log + 1, *y = x + NAME_nx, *row = y + NAME_ny, *x_next = row + 1;
        log[0] = t;
        if (step == max_steps || t == t1) return step;
        NAME(t, x, p, y);
        const double *c = y + (NAME_plain ? 0 : NAME_nq * NAME_last);
        double h = NAME_length(x, c, NAME_n, NAME_top, log_rtol, least);
        if (!NAME_plain) h = fmin(h, NAME_length(x, y, NAME_nq, 1, log_rtol, least));
        h = exp2(h);
        if (!(h > 1e-13 * (1 + fabs(t)))) return step;
        const int ends = h >= fabs(t1 - t) * (1 - 1e-12);
        const double signed_h = ends ? t1 - t : t1 > t ? h : -h;
        NAME_move(x, y, c, signed_h, x_next);
        t = ends ? t1 : t + signed_h;
        for (int64_t i = 0; i < NAME_nx; i++) if (!isfinite(x_next[i])) return step;
        if (project_every && (step + 1) % project_every == 0) NAME_PROJECT(t, x_next, p);
        log = row;
    }
}
"""
