/* Newton's iteration along a path. */
#include "unit.h"
#ifdef WIDE
#include "lanes.h"
#endif

/* The largest |delta_i| / (1 + |x_i|). */
static double relative_step(const double *x, const double *y)
{
    double largest = 0;
    for (int64_t i = 0; i < NX; i++) {
        const double e = fabs(y[i]) / (1 + fabs(x[i]));
        if (!isfinite(x[i]) || !isfinite(y[i])) return INFINITY;
        if (e > largest) largest = e;
    }
    return largest;
}

/* Newton's iteration at time t from x; y is the function at the x it leaves. */
static int correct(double t, double *x, const double *p, double tol, int64_t max_iter, double *y, int64_t *count)
{
    double x_next[NX + 1], y_next[NY + 1], defect;
    for (int64_t iteration = 0; ; iteration++) {
        NAME(t, x, p, y);
        ++*count;
        defect = relative_step(x, y);
        if (defect <= tol) break;
        if (!isfinite(defect) || iteration == max_iter) return 0;
        for (int64_t i = 0; i < NX; i++) x[i] += y[i];
    }
    if (defect <= ROUNDING) return 1;
    for (int64_t i = 0; i < NX; i++) x_next[i] = x[i] + y[i];
    NAME(t, x_next, p, y_next);
    ++*count;
    if (relative_step(x_next, y_next) < defect) {
        for (int64_t i = 0; i < NX; i++) x[i] = x_next[i];
        for (int64_t i = 0; i < NY; i++) y[i] = y_next[i];
    }
    return 1;
}

/* From the solution x, y at time a to the one at b: predicted by the rate and corrected; halves the step where that
   fails. */
static int advance(double a, double b, double *x, const double *p, double tol, int64_t max_iter, double *y,
                   int64_t *count)
{
    double x_next[NX + 1], y_next[NY + 1], t = a;
    for (int64_t done = 0, pieces = 1; done < pieces; ) {
        const double next = done + 1 == pieces ? b : a + (b - a) * ((double)(done + 1) / (double)pieces);
        for (int64_t i = 0; i < NX; i++) x_next[i] = x[i] + (next - t) * y[NX + i];
        if (correct(next, x_next, p, tol, max_iter, y_next, count)) {
            for (int64_t i = 0; i < NX; i++) x[i] = x_next[i];
            for (int64_t i = 0; i < NY; i++) y[i] = y_next[i];
            t = next;
            for (done++; pieces > 1 && done % 2 == 0; done /= 2) pieces /= 2;
        } else {
            if (pieces == (int64_t)1 << BISECTIONS) return 0;
            done *= 2;
            pieces *= 2;
        }
    }
    return 1;
}

#ifdef WIDE
/* Weights of a node's value and rate in Hermite's interpolation at the times t, by its distances to two other nodes. */
static inline void weights(W t, double node, double other, double another, W *value, W *rate)
{
    const double a = 1 / (node - other), b = 1 / (node - another);
    const W d = t - node, basis = (t - other) * (t - another) * (a * b), square = basis * basis;
    *value = square * (1 - 2 * (a + b) * d);
    *rate = square * d;
}

/* The largest |delta_i| / (1 + |x_i|) of eight points. */
static inline double wide_relative_step(const W *x, const W *y)
{
    double defect = 0;
    W largest = ALL(0.0);
    for (int64_t i = 0; i < NX; i++) {
        const W e = w_fabs(y[i]) / (1.0 + w_fabs(x[i]));
        largest = w_select((e <= largest) | (largest != largest), largest, e);
    }
    for (int64_t l = 0; l < 8; l++) {
        if (!isfinite(largest[l])) return INFINITY;
        defect = fmax(defect, largest[l]);
    }
    return defect;
}

/* The solutions at the eight times from t[k] on: predicted from three of the last eight by their values and rates, and
   corrected together, by the first outputs alone until the correction is small. Returns 1 if all converge; then
   the logs hold them. */
static int block(int64_t n, int64_t k, const double *t, const W *p, double tol, double *x_log, double *y_log,
                 int64_t *count)
{
    W x[NX + 1], y[NY + 1], value[3], rate[3];
    const W now = w_load(t + k);
    const int64_t nodes[3] = {k - 8, k - 4, k - 1};
    for (int64_t m = 0; m < 3; m++)
        weights(now, t[nodes[m]], t[nodes[(m + 1) % 3]], t[nodes[(m + 2) % 3]], value + m, rate + m);
    for (int64_t i = 0; i < NX; i++) {
        x[i] = ALL(0.0);
        for (int64_t m = 0; m < 3; m++)
            x[i] += value[m] * x_log[i * n + nodes[m]] + rate[m] * y_log[(NX + i) * n + nodes[m]];
    }
    for (double defect = INFINITY, before = NEAR; !(defect <= QUADRATIC); before = defect) {
        FN(wide_step)(now, x, p, y);
        *count += 8;
        defect = wide_relative_step(x, y);
        if (!(defect < before)) return 0;
        for (int64_t i = 0; i < NX; i++) x[i] += y[i];
    }
    FN(wide)(now, x, p, y);
    *count += 8;
    if (!(wide_relative_step(x, y) <= tol)) return 0;
    for (int64_t i = 0; i < NX; i++) w_store(x_log + i * n + k, x[i]);
    for (int64_t i = 0; i < NY; i++) w_store(y_log + i * n + k, y[i]);
    return 1;
}
#endif

/* The solution at each of n times in order; the logs hold n columns. Returns the number of points solved. */
int64_t FN(newton)(int64_t n, const double *t, const double *x0, const double *p, double tol, int64_t max_iter,
           double *x_log, double *y_log, int64_t *count)
{
    double x[NX + 1], y[NY + 1];
    int64_t alone = 9;
    *count = 0;
    for (int64_t i = 0; i < NX; i++) x[i] = x0[i];
#ifdef WIDE
    W wide_p[NP + 1];
    for (int64_t i = 0; i < NP; i++) wide_p[i] = ALL(p[i]);
#endif
    for (int64_t k = 0; k < n; k++) {
#ifdef WIDE
        if (k >= alone && k + 8 <= n) {
            if (block(n, k, t, wide_p, tol, x_log, y_log, count)) {
                for (int64_t i = 0; i < NX; i++) x[i] = x_log[i * n + k + 7];
                for (int64_t i = 0; i < NY; i++) y[i] = y_log[i * n + k + 7];
                k += 7;
                continue;
            }
            alone = k + 8;
        }
#endif
        if (!(k ? advance(t[k - 1], t[k], x, p, tol, max_iter, y, count)
                : correct(t[k], x, p, tol, max_iter, y, count))) return k;
        for (int64_t i = 0; i < NX; i++) x_log[i * n + k] = x[i];
        for (int64_t i = 0; i < NY; i++) y_log[i * n + k] = y[i];
    }
    return n;
}
