/* Whether deviations from a motion with n_x states grow as those of unstable internal dynamics do. */
#include "unit.h"
#include "orthonormal.h"

/* The constants of growth.py. */
typedef struct {
    double moderate, sweeps, balanced, tiny, squarings, unstable, exponential, faster, most_growth, great;
} Settings;

/* An entry of matrices at n instants has S = PADDED(n) numbers, one after the other; those beyond n repeat the last one.
   Whole vectors are added and multiplied without looking at their number. */
#define EACH(t) for (int64_t t##8 = 0; t##8 < S; t##8 += 8) for (int64_t t = t##8; t < t##8 + 8; t++)

/* Matrices Q (F, n_x) of all instants become Q R^-1 with orthonormal rows, by Gram and Schmidt's process, twice; values
   that are not finite where rows are dependent. */
static void all_orthonormal(int64_t S, int64_t F, int64_t n_x, double *restrict Q, double *restrict R)
{
    double along[S];
    for (int64_t i = 0; i < F * F * S; i++) R[i] = 0;
    for (int64_t j = 0; j < F; j++) {
        double *v = Q + j * n_x * S, *size = R + j * (F + 1) * S;
        for (int twice = 0; twice < 2; twice++) for (int64_t i = 0; i < j; i++) {
            const double *other = Q + i * n_x * S;
            double *r = R + (i * F + j) * S;
            EACH(t) along[t] = 0;
            for (int64_t m = 0; m < n_x; m++) EACH(t) along[t] += other[m * S + t] * v[m * S + t];
            for (int64_t m = 0; m < n_x; m++) EACH(t) v[m * S + t] -= along[t] * other[m * S + t];
            EACH(t) r[t] += along[t];
        }
        for (int64_t m = 0; m < n_x; m++) EACH(t) size[t] += v[m * S + t] * v[m * S + t];
        EACH(t) along[t] = 1 / (size[t] = sqrt(size[t]));
        for (int64_t m = 0; m < n_x; m++) EACH(t) v[m * S + t] *= along[t];
    }
}

/* B = A^-1 of upper triangular matrices (F, F) of all instants. */
static void all_inverse(int64_t S, int64_t F, const double *restrict A, double *restrict B)
{
    for (int64_t i = 0; i < F * F * S; i++) B[i] = 0;
    for (int64_t j = 0; j < F; j++) for (int64_t i = j; i >= 0; i--) {
        double *sum = B + (i * F + j) * S;
        const double *pivot = A + i * (F + 1) * S;
        EACH(t) sum[t] = i == j;
        for (int64_t k = i + 1; k <= j; k++) {
            const double *a = A + (i * F + k) * S, *b = B + (k * F + j) * S;
            EACH(t) sum[t] -= a[t] * b[t];
        }
        EACH(t) sum[t] /= pivot[t];
    }
}

/* Whether the products of entries of matrices with those of their inverses stay below a limit. */
static int moderate(int64_t count, const double *P, const double *inverses, double limit)
{
    double most = 0, most_inverse = 0, sum = 0;
    for (int64_t i = 0; i < count; i++) {
        most = fabs(P[i]) > most ? fabs(P[i]) : most;
        most_inverse = fabs(inverses[i]) > most_inverse ? fabs(inverses[i]) : most_inverse;
        sum += P[i] * 0 + inverses[i] * 0;
    }
    return sum == 0 && most * most_inverse < limit; /* not if one of them is not finite */
}

/* The sum of the squares of N(t) Phi(t, s) N(s)' = Z(t) P(s)^-1 Q(s)' over all pairs of instants t >= s, W (n_x, n_x).
   work has 2 S n_x + F n_x S numbers. */
static void sum_of_squares(int64_t n, int64_t S, int64_t F, int64_t n_x, const double *Z, const double *Q,
                           const double *inverses, double *W, double *work)
{
    double *restrict before = work, *restrict after = before + S * n_x, *earlier = after + S * n_x;
    for (int64_t j = 0; j < F; j++) for (int64_t i = 0; i < n_x; i++) {
        double *restrict sum = earlier + (j * n_x + i) * S;
        EACH(t) sum[t] = 0;
        for (int64_t k = j; k < F; k++) {
            const double *q = Q + (k * n_x + i) * S, *p = inverses + (j * F + k) * S;
            EACH(t) sum[t] += q[t] * p[t];
        }
    }
    for (int64_t i = 0; i < n_x * n_x; i++) W[i] = 0;
    for (int64_t a = 0; a < F; a++) for (int64_t b = a; b < F; b++) {
        const double *first = earlier + a * n_x * S, *second = earlier + b * n_x * S;
        const double *z = Z + a * n_x * S, *other = Z + b * n_x * S, times = a == b ? 1 : 2;
        for (int64_t i = 0; i < n_x * S; i++) before[i] = first[i] * second[i];
        for (int64_t i = 0; i < n_x * S; i++) after[i] = times * z[i] * other[i];
        for (int64_t t = 1; t < n; t++) for (int64_t i = 0; i < n_x; i++) before[i * S + t] += before[i * S + t - 1];
        for (int64_t i = 0; i < n_x; i++) for (int64_t t = n; t < S; t++) after[i * S + t] = 0;
        for (int64_t i = 0; i < n_x; i++) for (int64_t j = 0; j < n_x; j++) {
            double sums[8] = {0};
            for (int64_t t = 0; t < S; t += 8) {
                for (int64_t l = 0; l < 8; l++) sums[l] += after[i * S + t + l] * before[j * S + t + l];
            }
            for (int64_t l = 0; l < 8; l++) W[i * n_x + j] += sums[l];
        }
    }
}

/* d that makes the sum of W_ij d_j^2/d_i^2 smallest, as `_balance` of growth.py; work has 3 n_x numbers. */
static void balance(int64_t n_x, const double *W, const Settings *settings, double *scale, double *work)
{
    double *square = work, *ratios = work + n_x, *inverses = ratios + n_x;
    for (int64_t i = 0; i < n_x; i++) square[i] = inverses[i] = 1;
    for (int64_t sweep = 0; sweep < settings->sweeps; sweep++) {
        double most = 1;
        for (int64_t i = 0; i < n_x; i++) {
            double row = 0, column = 0;
            for (int64_t j = 0; j < n_x; j++) {
                row += W[i * n_x + j] * square[j];
                column += W[j * n_x + i] * inverses[j];
            }
            row *= inverses[i];
            column *= square[i];
            ratios[i] = row > settings->tiny && column > settings->tiny ? row / column : 1;
            most = fmax(most, fmax(ratios[i], 1 / ratios[i]));
        }
        if (log(most) < settings->balanced) break;
        for (int64_t i = 0; i < n_x; i++) {
            square[i] *= sqrt(sqrt(ratios[i]));
            inverses[i] = 1 / square[i];
        }
    }
    for (int64_t i = 0; i < n_x; i++) scale[i] = sqrt(square[i]);
}

/* Between which the squares of the norms of Y = A(t) B(s) lie, of upper triangular factors, for all s <= t: `least` is the
   largest sum of squares of a row or column, `most` the sum of all; (n, S). work has (F + 2) S numbers. */
static void bounds(int64_t n, int64_t columns, int64_t F, const double *A, const double *B, double *least, double *most,
                   double *work)
{
    double *restrict column = work, *restrict row = column + F * columns, *restrict y = row + columns;
    for (int64_t t = 0; t < n; t++, least += columns, most += columns) {
        const int64_t S = PADDED(t + 1);
        EACH(s) least[s] = most[s] = 0;
        for (int64_t i = 0; i < F * columns; i++) column[i] = 0;
        for (int64_t i = 0; i < F; i++) {
            EACH(s) row[s] = 0;
            for (int64_t j = i; j < F; j++) {
                EACH(s) y[s] = 0;
                for (int64_t k = i; k <= j; k++) {
                    const double a = A[(i * F + k) * columns + t], *b = B + (k * F + j) * columns;
                    EACH(s) y[s] += a * b[s];
                }
                EACH(s) row[s] += y[s] * y[s];
                EACH(s) column[j * columns + s] += y[s] * y[s];
            }
            EACH(s) most[s] += row[s];
            EACH(s) least[s] = row[s] > least[s] ? row[s] : least[s];
        }
        for (int64_t j = 0; j < F; j++) {
            EACH(s) least[s] = column[j * columns + s] > least[s] ? column[j * columns + s] : least[s];
        }
    }
}

/* Rows of the length S, padded with zeros. */
static inline void add(int64_t S, double factor, const double *restrict from, double *restrict to)
{
    EACH(i) to[i] += factor * from[i];
}

/* ln of the norm of A(t) B(s), from the trace of (Y'Y)^(2^squarings), which exceeds that of the largest eigenvalue F times
   at most; of a norm below `least` fewer squarings do, as they bound it. work has (3 F + 1) PADDED(F) numbers. */
static double log_norm(int64_t F, int64_t columns, const double *A, const double *B, double squarings, double least,
                       double *work)
{
    const int64_t S = PADDED(F);
    double *G = work, *square = G + F * S, *row = square + F * S, result = 0, part = 0.5;
    for (int64_t i = 0; i < F * S; i++) G[i] = 0;
    for (int64_t i = 0; i < F; i++) {
        EACH(j) row[j] = 0;
        for (int64_t k = i; k < F; k++) for (int64_t j = k; j < F; j++) {
            row[j] += A[(i * F + k) * columns] * B[(k * F + j) * columns];
        }
        for (int64_t j = i; j < F; j++) add(S, row[j], row, G + j * S);
    }
    for (int squaring = 0; ; squaring++, part /= 2) {
        double trace = 0;
        for (int64_t i = 0; i < F; i++) trace += G[i * S + i];
        const double change = part * log(trace); /* after the first, each is less than the square of the one before */
        result += change;
        if (squaring >= squarings || result < least || (squaring && -change < exp2(-squarings) * part)) return result;
        trace = 1 / trace;
        for (int64_t i = 0; i < F * S; i++) G[i] *= trace;
        for (int64_t i = 0; i < F * S; i++) square[i] = 0;
        for (int64_t i = 0; i < F; i++) for (int64_t k = 0; k < F; k++) add(S, G[i * S + k], G + k * S, square + i * S);
        double *before = G;
        G = square, square = before;
    }
}

/* Whether errors do not grow as those of unstable internal dynamics, from ln of the largest growth between instants that
   are at most 0, 1, ..., n - 1 blocks apart, within (n): as `_unstable` of growth.py. 0 as well where a single block has
   growth that it would take apart. */
static int quiet(int64_t n, int64_t F, const double *within, const Settings *s)
{
    const double limit = log(s->unstable), faster = log(s->faster), power = log(2) * (F > 2 ? F - 2 : 0);
    for (int64_t half = 1; 2 * half < n; half++) {
        const double whole = within[2 * half], more = whole - within[half];
        if (!(whole > s->exponential * within[half] || more > faster + power)) continue;
        if (whole > s->most_growth * within[n - 1] && whole > limit && more > faster) return 0;
    }
    return within[n - 1] <= log(s->great) && within[1] <= limit;
}

/* Whether deviations Z (F, n_x, S) from a motion at n instants, those at the first of them moved on, tell that its internal
   dynamics are not unstable. Growth is that of the states x_i/scale_i; `within` is as for `quiet`, where all other growth
   is less. 0 as well beyond moderate propagators, of which products with inverses lose digits.
   work has S (2 F n_x + 4 F^2 + 2 n) + max(2 S n_x + F n_x S + n_x^2 + 3 n_x, S (F + 2), (3 F + 1) PADDED(F)) numbers. */
int64_t FN(growth)(int64_t n, int64_t n_x, int64_t F, const double *Z, const Settings *settings, double *work,
                   double *scale, double *within)
{
    const int64_t S = PADDED(n), matrices = F * F * S, all = F * n_x * S;
    double *whole = work, *Q = whole + all, *P = Q + all, *inverses = P + matrices, *least = inverses + matrices;
    double *most = least + n * S, *rest = most + n * S, *W = rest + 2 * S * n_x + all, best = 1;
    const double least_part = exp2(-settings->squarings) * log((double)F);
    for (int64_t e = 0; e < F * n_x; e++) EACH(t) whole[e * S + t] = Q[e * S + t] = Z[e * S + (t < n ? t : n - 1)];
    all_orthonormal(S, F, n_x, Q, P);
    all_inverse(S, F, P, inverses);
    if (!moderate(matrices, P, inverses, settings->moderate)) return 0;
    sum_of_squares(n, S, F, n_x, whole, Q, inverses, W, rest);
    balance(n_x, W, settings, scale, W + n_x * n_x);
    for (int64_t j = 0; j < F; j++) for (int64_t i = 0; i < n_x; i++) {
        const double unit = 1 / scale[i], *z = whole + (j * n_x + i) * S;
        EACH(t) Q[(j * n_x + i) * S + t] = z[t] * unit;
    }
    all_orthonormal(S, F, n_x, Q, P);
    all_inverse(S, F, P, inverses);
    bounds(n, S, F, P, inverses, least, most, rest);
    within[0] = 0;
    for (int64_t apart = 1; apart < n; apart++) {
        int64_t first = apart;
        for (int64_t t = apart; t < n; t++) {
            best = fmax(best, least[t * S + t - apart]);
            first = most[t * S + t - apart] > most[first * S + first - apart] ? t : first;
        }
        within[apart] = fmax(within[apart - 1], log(best) / 2);
        for (int64_t k = apart - 1; k < n; k++) {
            const int64_t t = k < apart ? first : k, s = t - apart; /* the one that may be largest comes first */
            if (!(most[t * S + s] > best) || k == first) continue;
            const double found = log_norm(F, S, P + t, inverses + s, settings->squarings, log(best) / 2, rest);
            within[apart] = fmax(within[apart], found);
            best = fmax(best, exp(2 * found - least_part));
        }
    }
    return quiet(n, F, within, settings);
}
