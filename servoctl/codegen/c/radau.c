/* Adaptive steps of the Radau IIA methods (Hairer and Wanner 1996, IV.8). */
#include "unit.h"
#include "phased.h"
#include "restore.h"

/* LU decomposition with partial pivoting of a complex matrix, real and imaginary parts side by side; the diagonal keeps
   the inverses of the pivots. */
static int factor(double *a, int64_t *pivot)
{
    const int64_t n = NX;
    for (int64_t k = 0; k < n; k++) {
        double best = 0;
        for (int64_t i = k; i < n; i++) {
            const double size = fabs(a[2 * (i * n + k)]) + fabs(a[2 * (i * n + k) + 1]);
            if (!isfinite(size)) return 0;
            if (size > best) { best = size; pivot[k] = i; }
        }
        if (!(best > 0)) return 0;
        double *top = a + 2 * k * n;
        if (pivot[k] != k) {
            double *other = a + 2 * pivot[k] * n;
            for (int64_t j = 0; j < 2 * n; j++) { const double v = top[j]; top[j] = other[j]; other[j] = v; }
        }
        const double size = top[2 * k] * top[2 * k] + top[2 * k + 1] * top[2 * k + 1];
        top[2 * k] /= size;
        top[2 * k + 1] /= -size;
        for (int64_t i = k + 1; i < n; i++) {
            double *row = a + 2 * i * n;
            const double re = row[2 * k] * top[2 * k] - row[2 * k + 1] * top[2 * k + 1];
            const double im = row[2 * k] * top[2 * k + 1] + row[2 * k + 1] * top[2 * k];
            row[2 * k] = re;
            row[2 * k + 1] = im;
            if (re == 0 && im == 0) continue;
            for (int64_t j = k + 1; j < n; j++) {
                row[2 * j] -= re * top[2 * j] - im * top[2 * j + 1];
                row[2 * j + 1] -= re * top[2 * j + 1] + im * top[2 * j];
            }
        }
    }
    return 1;
}

static void backsolve(const double *a, const int64_t *pivot, double *b)
{
    const int64_t n = NX;
    for (int64_t k = 0; k < n; k++) {
        double re = b[2 * pivot[k]], im = b[2 * pivot[k] + 1];
        b[2 * pivot[k]] = b[2 * k];
        b[2 * pivot[k] + 1] = b[2 * k + 1];
        b[2 * k] = re;
        b[2 * k + 1] = im;
    }
    for (int64_t i = 1; i < n; i++)
        for (int64_t j = 0; j < i; j++) {
            const double *l = a + 2 * (i * n + j);
            b[2 * i] -= l[0] * b[2 * j] - l[1] * b[2 * j + 1];
            b[2 * i + 1] -= l[0] * b[2 * j + 1] + l[1] * b[2 * j];
        }
    for (int64_t i = n - 1; i >= 0; i--) {
        for (int64_t j = i + 1; j < n; j++) {
            const double *u = a + 2 * (i * n + j);
            b[2 * i] -= u[0] * b[2 * j] - u[1] * b[2 * j + 1];
            b[2 * i + 1] -= u[0] * b[2 * j + 1] + u[1] * b[2 * j];
        }
        const double *d = a + 2 * (i * n + i), re = b[2 * i], im = b[2 * i + 1];
        b[2 * i] = re * d[0] - im * d[1];
        b[2 * i + 1] = re * d[1] + im * d[0];
    }
}

typedef struct {
    int64_t s, limit;
    const double *c, *rate, *from_pairs, *to_pairs, *mu, *e, *p;
    double tol, floor, *jacobian, *lu, *scale, *r, *b;
    int64_t *pivots, nfev, njev, nlu, rejected;
} Method;

/* The (s + 1)/2 matrices mu/h - J. */
static int prepare(Method *m, double h)
{
    const int64_t n = NX;
    m->nlu++;
    for (int64_t k = 0; k < (m->s + 1) / 2; k++) {
        double *a = m->lu + 2 * k * n * n;
        for (int64_t i = 0; i < n; i++)
            for (int64_t j = 0; j < n; j++) {
                a[2 * (i * n + j)] = (i == j ? m->mu[2 * k] / h : 0) - m->jacobian[j * n + i];
                a[2 * (i * n + j) + 1] = i == j ? m->mu[2 * k + 1] / h : 0;
            }
        if (!factor(a, m->pivots + k * n)) return 0;
    }
    return 1;
}

/* The simplified Newton iteration for the increments z (s, n_x) of the stages; returns its length, 0 where it fails. */
static int64_t iterate(Method *m, double t, const double *x, double h, double *z, double *rate)
{
    const int64_t n = NX, s = m->s;
    double point[NX + 1], y[NY + 1], w[s][WORK], now[s], last = 0;
    for (int64_t i = 0; i < s; i++) now[i] = NAN;
    *rate = 0;
    for (int64_t k = 0; k < m->limit; k++) {
        for (int64_t i = 0; i < s; i++) {
            for (int64_t l = 0; l < n; l++) point[l] = x[l] + z[i * n + l];
            evaluate(t + m->c[i] * h, point, m->p, y, w[i], now + i);
            for (int64_t l = 0; l < n; l++) {
                double slope = 0;
                for (int64_t j = 0; j < s; j++) slope += m->rate[i * s + j] * z[j * n + l];
                m->r[i * n + l] = y[l] - slope / h;
                if (!isfinite(m->r[i * n + l])) return 0;
            }
        }
        m->nfev += s;
        for (int64_t q = 0; q < (s + 1) / 2; q++) {
            for (int64_t l = 0; l < n; l++) {
                double re = 0, im = 0;
                for (int64_t j = 0; j < s; j++) {
                    if (q) re += m->to_pairs[(2 * q - 1) * s + j] * m->r[j * n + l];
                    im += m->to_pairs[2 * q * s + j] * m->r[j * n + l];
                }
                m->b[2 * (q * n + l)] = q ? re : im;
                m->b[2 * (q * n + l) + 1] = q ? im : 0;
            }
            backsolve(m->lu + 2 * q * n * n, m->pivots + q * n, m->b + 2 * q * n);
        }
        double norm = 0;
        for (int64_t i = 0; i < s; i++)
            for (int64_t l = 0; l < n; l++) {
                double dz = m->from_pairs[i * s] * m->b[2 * l];
                for (int64_t j = 1; j < s; j++)
                    dz += m->from_pairs[i * s + j] * m->b[2 * ((j + 1) / 2 * n + l) + (j + 1) % 2];
                z[i * n + l] += dz;
                norm += dz / m->scale[l] * (dz / m->scale[l]);
            }
        norm = sqrt(norm / (double)(s * n));
        if (!isfinite(norm)) return 0;
        if (k) *rate = norm / last;
        if (norm <= m->floor || (k && *rate < 1 && *rate / (1 - *rate) * norm < m->tol)) return k + 1;
        if (k && (*rate >= 1 || pow(*rate, (double)(m->limit - 1 - k)) / (1 - *rate) * norm > m->tol)) return 0;
        last = norm;
    }
    return 0;
}

/* A length to 10 bits: rounding in the estimated error does not show in the steps. */
static double rounded(double h)
{
    int exponent;
    const double part = frexp(h, &exponent);
    return ldexp(rint(part * 1024) / 1024, exponent);
}

static double weighted_norm(const double *v, int64_t stride, const double *x, const double *next, double rtol,
                            double atol)
{
    double sum = 0;
    for (int64_t i = 0; i < NX; i++) {
        const double e = v[stride * i] / (atol + rtol * fmax(fabs(x[i]), fabs(next[i])));
        sum += e * e;
    }
    return sqrt(sum / NX);
}

/* The norm of the error that the embedded method shows, smoothed by the real system. */
static double error_norm(Method *m, double t, const double *x, const double *f, const double *z, double h, double rtol,
                         double atol, int again)
{
    const int64_t n = NX, s = m->s;
    double next[NX + 1], point[NX + 1], y[NY + 1], size = 0;
    for (int64_t l = 0; l < n; l++) next[l] = x[l] + z[(s - 1) * n + l];
    for (int64_t round = 0; round < 2; round++) {
        for (int64_t l = 0; l < n; l++) {
            double sum = 0;
            for (int64_t i = 0; i < s; i++) sum += m->e[i] * z[i * n + l];
            m->b[2 * l] = (round ? y[l] : f[l]) + sum / h;
            m->b[2 * l + 1] = 0;
        }
        backsolve(m->lu, m->pivots, m->b);
        size = weighted_norm(m->b, 2, x, next, rtol, atol);
        if (!again || size <= 1 || round) return size;
        for (int64_t l = 0; l < n; l++) point[l] = x[l] + m->b[2 * l];
        NAME(t, point, m->p, y);
        m->nfev++;
    }
    return size;
}

/* Increments that continue the collocation polynomial of the last step, `ratio` times as far as that was long. */
static void extrapolate(const Method *m, const double *z, double ratio, double *guess)
{
    const int64_t n = NX, s = m->s;
    for (int64_t i = 0; i < s * n; i++) guess[i] = -z[(s - 1) * n + i % n];
    for (int64_t i = 0; i < s; i++)
        for (int64_t j = 0; j < s; j++) {
            const double theta = 1 + m->c[i] * ratio;
            double weight = theta / m->c[j];
            for (int64_t k = 0; k < s; k++) if (k != j) weight *= (theta - m->c[k]) / (m->c[j] - m->c[k]);
            for (int64_t l = 0; l < n; l++) guess[i * n + l] += weight * z[j * n + l];
        }
}

/* Steps of a Radau IIA method towards t1, at most max_steps. `step` holds the first length, then that of the next step;
   if `fixed`, all steps have it. The logs hold a row for each step: its start, its state, the function there, the
   increments of its stages; one row more of time and state for the end. Returns the number of steps; fewer than
   max_steps without reaching t1 where a step vanishes. counts are those of rejected steps, evaluations, Jacobians and
   decompositions. */
int64_t FN(radau)(double t0, const double *x0, double t1, const double *p, int64_t s, const double *table,
           int64_t limit, double tol, int64_t fixed, double rtol, double atol, int64_t project_every, int64_t max_steps,
           double *step, double *work, int64_t *pivots, double *t_log, double *x_log, double *y_log, double *z_log,
           int64_t *counts)
{
    const int64_t n = NX;
    const double *parts = table + s + 3 * s * s;
    Method m = {s, limit, table, table + s, table + s + s * s, table + s + 2 * s * s, parts, parts + s + 1, p,
                     tol, 10 * ROUNDING / rtol, work, work + n * n, work + n * n * (s + 2), 0, 0, pivots, 0, 0, 0, 0};
    double x[NX + 1], t = t0, h = *step, h_before = 0, e_before = 0, prepared = 0;
    m.r = m.scale + n;
    m.b = m.r + s * n;
    int current = 0, useful = 0;
    int64_t k = 0;
    for (int64_t i = 0; i < n; i++) x[i] = x0[i];
    for (; ; k++) {
        double *y = y_log + k * NY, *z = z_log + k * s * n;
        t_log[k] = t;
        for (int64_t i = 0; i < n; i++) x_log[k * n + i] = x[i];
        if (k == max_steps || t == t1) break;
        NAME(t, x, p, y);
        m.nfev++;
        if (!useful) { FN(jacobian)(t, x, p, m.jacobian); m.njev++; current = useful = 1; prepared = 0; }
        for (int64_t i = 0; i < n; i++) m.scale[i] = atol + rtol * fabs(x[i]);
        double rate = 0, signed_h = 0, error = 0, factor = 1;
        int64_t iterations = 0, refused = 0, ends = 0, stuck = 0;
        for (; ; refused++) {
            stuck = !(h > 1e-14 * (1e-3 + fabs(t))) || (fixed && refused);
            if (stuck) break;
            ends = h >= fabs(t1 - t) * (1 - 1e-12);
            signed_h = ends ? t1 - t : t1 > t ? h : -h;
            if (k) extrapolate(&m, z - s * n, signed_h / (t - t_log[k - 1]), z);
            else for (int64_t i = 0; i < s * n; i++) z[i] = 0;
            iterations = 0;
            if (prepared == signed_h || prepare(&m, signed_h)) {
                prepared = signed_h;
                iterations = iterate(&m, t, x, signed_h, z, &rate);
            }
            if (!iterations) {
                if (current) h = 0.5 * fabs(signed_h);
                else { FN(jacobian)(t, x, p, m.jacobian); m.njev++; current = 1; refused--; }
                prepared = 0;
                continue;
            }
            if (fixed) break;
            error = error_norm(&m, t, x, y, z, signed_h, rtol, atol, refused > 0 || k == 0);
            const double power = -1.0 / (double)(s + 1);
            const double safety = 0.9 * (double)(2 * limit + 1) / (double)(2 * limit + iterations);
            factor = pow(fmax(error, 1e-10), power);
            if (h_before > 0 && error > 0) factor *= fmin(1, fabs(signed_h) / h_before * pow(e_before / error, -power));
            factor *= safety;
            if (error <= 1) break;
            h = rounded(fabs(signed_h) * (isfinite(error) ? fmax(0.2, factor) : 0.5));
        }
        m.rejected += refused;
        if (stuck) break;
        h_before = fabs(signed_h);
        e_before = fmax(error, 1e-4);
        for (int64_t i = 0; i < n; i++) x[i] += z[(s - 1) * n + i];
        t = ends ? t1 : t + signed_h;
        useful = iterations <= 2 || rate <= 1e-3;
        current = 0;
        if (!fixed && !(useful && factor < 1.2 && factor > 0.9))
            h = rounded(h_before * fmin(factor, refused ? 1 : 5));
        if (project_every && (k + 1) % project_every == 0) restore(t, x, p);
    }
    *step = h;
    counts[0] = m.rejected;
    counts[1] = m.nfev;
    counts[2] = m.njev;
    counts[3] = m.nlu;
    return k;
}
