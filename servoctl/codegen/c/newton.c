/* A path by continuation, and its points between. The outputs are the Newton correction delta of x, the rates x' and x''
   along the path, others, and at last the pivots of the elimination. A node is a row of t, x and these outputs. Newton's
   iteration computes delta alone; what depends on t and p alone once, and the other outputs at its end. */
#include <string.h>

#include "unit.h"
#ifdef WIDE
#include "lanes.h"
#endif

#define NODE (1 + NX + NY)

/* The largest |change_i| / (1 + |x_i|). */
static double relative(const double *x, const double *change)
{
    double largest = 0;
    for (int64_t i = 0; i < NX; i++) {
        const double e = fabs(change[i]) / (1 + fabs(x[i]));
        if (!isfinite(x[i]) || !isfinite(change[i])) return INFINITY;
        if (e > largest) largest = e;
    }
    return largest;
}

/* Newton's iteration at time t from x, whose corrections shrink by a factor; y is the function at the x it leaves, and
   `first` the size of the first correction. */
static int correct(double t, double *x, const double *p, double factor, double *y, double *first, int64_t *count)
{
    double x_next[NX + 1], y_next[NX + 1], w[WORK], w_next[WORK], defect, before = INFINITY;
    FN(instant)(t, x, p, y, w);
    for (int64_t iteration = 0; ; iteration++, before = defect) {
        FN(correction)(t, x, p, y, w);
        ++*count;
        defect = relative(x, y);
        if (!iteration) *first = defect;
        if (!isfinite(defect)) return 0;
        if (defect <= CORRECTED || (before <= QUADRATIC && defect > CONTRACTION * before)) break; /* or rounding */
        if (defect > factor * before || iteration == CORRECTIONS) return 0;
        for (int64_t i = 0; i < NX; i++) x[i] += y[i];
    }
    if (defect > ROUNDING) {
        for (int64_t i = 0; i < NX; i++) x_next[i] = x[i] + y[i];
        memcpy(w_next, w, sizeof w);
        FN(correction)(t, x_next, p, y_next, w_next);
        ++*count;
        if (relative(x_next, y_next) < defect) {
            for (int64_t i = 0; i < NX; i++) x[i] = x_next[i];
            for (int64_t i = 0; i < NX; i++) y[i] = y_next[i];
            memcpy(w, w_next, sizeof w);
        }
    }
    FN(rest)(t, x, p, y, w);
    return 1;
}

/* x after a time h, by its rates in y. */
static void predict(double h, const double *x, const double *y, double *x_next)
{
    for (int64_t i = 0; i < NX; i++) x_next[i] = x[i] + h * (y[NX + i] + h / 2 * y[2 * NX + i]);
}

/* The largest difference of two points, relative to 1 + |x|. */
static double distance(const double *x, const double *other)
{
    double change[NX + 1], size[NX + 1];
    for (int64_t i = 0; i < NX; i++) {
        change[i] = other[i] - x[i];
        size[i] = fmax(fabs(x[i]), fabs(other[i]));
    }
    return relative(size, change);
}

/* Largest error of a prediction on the way between two points. */
static double tolerance(const double *x, const double *other)
{
    return fmax(FOLLOWED * distance(x, other), QUADRATIC);
}

/* Whether no pivot changes its sign, or its size by more than a factor. */
static int steady(const double *y, const double *other)
{
    for (int64_t i = NY - PIVOTS; i < NY; i++) {
        const double product = y[i] * other[i];
        if (!(product >= STEADY * y[i] * y[i] && product >= STEADY * other[i] * other[i])) return 0;
    }
    return 1;
}

/* One step from x, y at time t towards the end, of at most the length h, which becomes that of the next. It is halved
   until the predictions from both its ends miss the other one by a small part of the way, and all pivots are steady.
   Returns 0 if it vanishes. */
static int step(double *t, double end, double *h, double least, double *x, double *y, const double *p, int64_t *count)
{
    double x_next[NX + 1], y_next[NY + 1], back[NX + 1], first;
    for (;;) {
        const double left = fabs(end - *t), length = *h >= left ? left : fmin(*h, left / 2);
        const double now = *h >= left ? end : *t + copysign(length, end - *t);
        if (now == *t || *h < fmin(least, left)) return 0;
        predict(now - *t, x, y, x_next);
        if (correct(now, x_next, p, CONTRACTION, y_next, &first, count) && steady(y, y_next)) {
            predict(*t - now, x_next, y_next, back);
            const double allowed = tolerance(x, x_next), error = fmax(first, distance(x, back));
            if (error <= allowed) {
                const double growth = fmin(2, 0.9 * sqrt(allowed / (error + ROUNDING)));
                *h = growth < 1 ? fmax(growth, 0.5) * length : fmax(*h, growth * length);
                *t = now;
                for (int64_t i = 0; i < NX; i++) x[i] = x_next[i];
                for (int64_t i = 0; i < NY; i++) y[i] = y_next[i];
                return 1;
            }
        }
        *h = length / 2;
    }
}

static void record(double t, const double *x, const double *y, double *node)
{
    *node++ = t;
    for (int64_t i = 0; i < NX; i++) *node++ = x[i];
    for (int64_t i = 0; i < NY; i++) *node++ = y[i];
}

/* The path through n instants from x0, in steps of at most a length; returns the number of nodes, at most `most`. */
int64_t FN(continuation)(int64_t n, const double *instants, const double *x0, const double *p, double longest,
                         int64_t most, double *nodes, int64_t *count)
{
    double x[NX + 1], y[NY + 1], first, t = instants[0], h = longest;
    int64_t k = 0;
    *count = 0;
    for (int64_t i = 0; i < NX; i++) x[i] = x0[i];
    if (!correct(t, x, p, INFINITY, y, &first, count)) return 0;
    record(t, x, y, nodes);
    for (int64_t next = 1; next < n && ++k < most; next += t == instants[next]) {
        const double least = SHORTEST * fmin(longest, fabs(instants[next] - instants[next - 1]));
        if (t == instants[next - 1]) h = fmax(h, least);
        if (!step(&t, instants[next], &h, least, x, y, p, count)) return k;
        h = fmin(h, longest);
        record(t, x, y, nodes + NODE * k);
    }
    return k < most ? k + 1 : most;
}

/* Where a time lies between two nodes: 0 at the first, 1 at the second. */
static inline double between(double t, const double *a, const double *b)
{
    return *b == *a ? 0 : (t - *a) / (*b - *a);
}

/* The solution at t between two nodes: by Hermite's interpolation of x, x' and x'', else by steps from the first. */
static int point(double t, const double *a, const double *b, const double *p, double *x, double *y, int64_t *count)
{
    const double h = *b - *a, s = between(t, a, b), r = 1 - s, s3 = s * s * s, r3 = r * r * r;
    double first;
    for (int64_t i = 0; i < NX; i++)
        x[i] = r3 * ((1 + s * (3 + 6 * s)) * a[1 + i] + s * h * ((1 + 3 * s) * a[1 + 2 * NX + i]
                                                                 + s / 2 * h * a[1 + 3 * NX + i]))
             + s3 * ((1 + r * (3 + 6 * r)) * b[1 + i] - r * h * ((1 + 3 * r) * b[1 + 2 * NX + i]
                                                                 - r / 2 * h * b[1 + 3 * NX + i]));
    if (correct(t, x, p, CONTRACTION, y, &first, count) && first <= tolerance(a + 1, b + 1) && steady(a + 1 + NX, y)
        && all_finite(NY - PIVOTS, y)) return 1;
    double now = *a, length = fabs(t - now);
    for (int64_t i = 0; i < NX; i++) x[i] = a[1 + i];
    for (int64_t i = 0; i < NY; i++) y[i] = a[1 + NX + i];
    while (now != t)
        if (!step(&now, t, &length, fabs(h) * SHORTEST, x, y, p, count)) return 0;
    return 1;
}

#ifdef WIDE
/* A number of eight nodes; the offset counts from their first numbers. */
static inline W gather(const double *const *node, int64_t offset)
{
    if (node[0] == node[7]) return ALL(node[0][offset]);
    W value;
    for (int64_t l = 0; l < 8; l++) value[l] = node[l][offset];
    return value;
}

/* The largest |delta_i| * size_i of each of eight points; NaN where one is none. */
static inline W wide_relative(const W *size, const W *delta)
{
    W largest = ALL(0.0);
    for (int64_t i = 0; i < NX; i++) largest = w_larger_size(w_fabs(delta[i] * size[i]), largest);
    return largest;
}

static double largest_of(W a)
{
    double largest = a[0];
    for (int64_t l = 1; l < 8; l++) largest = fmax(largest, a[l]);
    return largest;
}

/* The solutions at the eight times from t[k] on, each between the nodes a and b: as `point` predicts them, corrected
   together, by the first outputs alone until the correction is small. Returns 1 if all converge, to
   finite rates; then the log holds them. */
static int block(int64_t n, int64_t k, const double *t, const double *const *a, const double *const *b, double allowed,
                 const W *p, double *log, int64_t *count)
{
    W x[NX + 1], y[NY + 1], w[WORK], size[NX + 1], defect;
    const W now = w_load(t + k), start = gather(a, 0), h = gather(b, 0) - start;
    const W s = (now - start) / h, r = 1.0 - s, s3 = s * s * s, r3 = r * r * r;
    const W at_a = r3 * (1.0 + s * (3.0 + 6.0 * s)), rate_a = r3 * s * (1.0 + 3.0 * s) * h;
    const W at_b = s3 * (1.0 + r * (3.0 + 6.0 * r)), rate_b = s3 * r * (1.0 + 3.0 * r) * h;
    const W second_a = r3 * s * s * 0.5 * h * h, second_b = s3 * r * r * 0.5 * h * h;
    for (int64_t i = 0; i < NX; i++)
        x[i] = at_a * gather(a, 1 + i) + rate_a * gather(a, 1 + 2 * NX + i) + second_a * gather(a, 1 + 3 * NX + i)
             + at_b * gather(b, 1 + i) - rate_b * gather(b, 1 + 2 * NX + i) + second_b * gather(b, 1 + 3 * NX + i);
    for (int64_t i = 0; i < NX; i++) size[i] = 1.0 / (1.0 + w_fabs(x[i]));
    FN(wide_instant)(now, x, p, y, w);
    for (double before = allowed; ; before = CONTRACTION * largest_of(defect)) {
        FN(wide_correction)(now, x, p, y, w);
        *count += 8;
        defect = wide_relative(size, y);
        if (w_any(~(defect <= before))) return 0;
        for (int64_t i = 0; i < NX; i++) x[i] += y[i];
        if (!w_any(defect > QUADRATIC)) break;
    }
    FN(wide_correction)(now, x, p, y, w);
    *count += 8;
    if (w_any(~(wide_relative(size, y) <= CORRECTED))) return 0;
    FN(wide_rest)(now, x, p, y, w);
    for (int64_t i = NY - PIVOTS; i < NY; i++) {
        const W other = gather(a, 1 + NX + i), product = y[i] * other;
        if (w_any(~((product >= STEADY * y[i] * y[i]) & (product >= STEADY * other * other)))) return 0;
    }
    for (int64_t i = 0; i < NX; i++) w_store(log + i * n + k, x[i]);
    W sum = ALL(0.0); /* NaN where a rate is not finite */
    for (int64_t i = NX; i < NY - PIVOTS; i++) {
        w_store(log + i * n + k, y[i]);
        sum += y[i] * 0.0;
    }
    return !w_any(sum != 0);
}
#endif

/* The solution at each of n times, in the order of the nodes; the log holds n columns of x and of the outputs after
   delta, without pivots. Returns the number of points solved. */
int64_t FN(newton)(int64_t n, const double *t, int64_t n_nodes, const double *nodes, const double *p, double *log,
                   int64_t *count)
{
    double x[NX + 1], y[NY + 1];
    const double *a = nodes, *const last = nodes + NODE * (n_nodes - 1), *const final = n_nodes > 1 ? last - NODE : last;
    const double direction = *last - *nodes;
    *count = 0;
#ifdef WIDE
    W wide_p[NP + 1];
    const double *from[8] = {0}, *to[8];
    double allowed = 0;
    for (int64_t i = 0; i < NP; i++) wide_p[i] = ALL(p[i]);
#endif
    for (int64_t k = 0, alone = 0; k < n; k++) {
        while (a < final && (t[k] - a[NODE]) * direction > 0) a += NODE;
#ifdef WIDE
        if (k >= alone && k + 8 <= n && direction != 0) {
            if (from[7] != a) allowed = tolerance(a + 1, a + NODE + 1);
            for (int64_t l = 0; l < 8; l++) {
                from[l] = l ? from[l - 1] : a;
                while (from[l] < final && (t[k + l] - from[l][NODE]) * direction > 0) {
                    from[l] += NODE;
                    allowed = fmin(allowed, tolerance(from[l] + 1, from[l] + NODE + 1));
                }
                to[l] = from[l] + NODE;
            }
            if (block(n, k, t, from, to, allowed, wide_p, log, count)) {
                k += 7;
                continue;
            }
            alone = k + 8;
        }
#endif
        if (!point(t[k], a, a == last ? a : a + NODE, p, x, y, count)) return k;
        for (int64_t i = 0; i < NX; i++) log[i * n + k] = x[i];
        for (int64_t i = NX; i < NY - PIVOTS; i++) log[i * n + k] = y[i];
    }
    return n;
}
