/* The growth of deviations between all pairs of instants of a motion with n_x states. */
#include "unit.h"
#include "orthonormal.h"

typedef struct {
    double moderate, sweeps, balanced, tiny, squarings;
} Settings;

/* Entry i, j of a triangular matrix (F, F) in a stack. */
#define AT(stack, k, i, j) (stack)[((k) * F + (i)) * F + (j)]

/* C = A B of upper triangular matrices (F, F). */
static inline void product(int64_t F, const double *A, const double *B, double *C)
{
    for (int64_t i = 0; i < F; i++) {
        double *row = C + i * F;
        for (int64_t j = 0; j < F; j++) row[j] = 0;
        for (int64_t k = i; k < F; k++) for (int64_t j = k; j < F; j++) row[j] += A[i * F + k] * B[k * F + j];
    }
}

/* B = A^-1 of an upper triangular matrix. */
static inline void inverse(int64_t F, const double *A, double *B)
{
    for (int64_t j = 0; j < F; j++) {
        for (int64_t i = F - 1; i >= 0; i--) {
            double sum = i == j;
            for (int64_t k = i + 1; k <= j; k++) sum -= A[i * F + k] * B[k * F + j];
            B[i * F + j] = i > j ? 0 : sum / A[i * F + i];
        }
    }
}

/* d that makes the sum of W_ij d_j^2/d_i^2 smallest, as `_balance` of growth.py. */
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

/* Rows are padded with zeros to whole vectors, which the compiler adds without looking at their number. */
#define PADDED(n) (((n) + 7) / 8 * 8)
static inline void add(int64_t n, double factor, const double *restrict from, double *restrict to)
{
    for (int64_t i = 0; i < n; i += 8) for (int64_t j = 0; j < 8; j++) to[i + j] += factor * from[i + j];
}

/* ln of the norm of an upper triangular Y (F, F), from the trace of (Y'Y)^(2^squarings), which exceeds that of the largest
   eigenvalue F times at most; of a norm below `least` fewer squarings do, as they bound it. work has 3 F PADDED(F). */
static double log_norm(int64_t F, const double *Y, double squarings, double least, double *work)
{
    const int64_t S = PADDED(F);
    double *G = work, *square = G + F * S, *rows = square + F * S, result = 0, part = 0.5;
    for (int64_t i = 0; i < F * S; i++) G[i] = 0;
    for (int64_t k = 0; k < F; k++) {
        for (int64_t i = 0; i < S; i++) rows[i] = i < F ? Y[k * F + i] : 0;
        for (int64_t i = k; i < F; i++) add(S, rows[i], rows, G + i * S);
    }
    for (int squaring = 0; ; squaring++, part /= 2) {
        double trace = 0;
        for (int64_t i = 0; i < F; i++) trace += G[i * S + i];
        const double change = part * log(trace); /* after the first, each is less than the square of the one before */
        result += change;
        if (squaring >= squarings || result < least || (squaring && -change < exp2(-squarings) * part)) return result;
        for (int64_t i = 0; i < F * S; i++) G[i] /= trace;
        for (int64_t i = 0; i < F * S; i++) square[i] = 0;
        for (int64_t i = 0; i < F; i++) for (int64_t k = 0; k < F; k++) add(S, G[i * S + k], G + k * S, square + i * S);
        double *before = G;
        G = square, square = before;
    }
}

/* The sum of the squares of N(t) Phi(t, s) N(s)' over all pairs of instants t >= s, W (n_x, n_x). With S = PADDED(n_x),
   before has F F S numbers, after and earlier have F S, and W has n_x S. */
static void sum_of_squares(int64_t n, int64_t n_x, int64_t F, const double *Q, const double *P, const double *inverses,
                           double *before, double *after, double *earlier, double *W)
{
    const int64_t S = PADDED(n_x);
    for (int64_t i = 0; i < n_x * S; i++) W[i] = 0;
    for (int64_t i = 0; i < F * F * S; i++) before[i] = 0;
    for (int64_t i = 0; i < F * S; i++) after[i] = earlier[i] = 0;
    for (int64_t t = 0; t < n; t++, Q += F * n_x) {
        for (int64_t j = 0; j < F; j++) for (int64_t i = 0; i < n_x; i++) {
            double sum = 0, other = 0;
            for (int64_t k = 0; k <= j; k++) sum += Q[k * n_x + i] * AT(P, t, k, j);
            for (int64_t k = j; k < F; k++) other += Q[k * n_x + i] * AT(inverses, t, j, k);
            after[j * S + i] = sum;
            earlier[j * S + i] = other;
        }
        for (int64_t a = 0; a < F; a++) for (int64_t b = a; b < F; b++) {
            double *sums = before + (a * F + b) * S, *first = earlier + a * S, *second = earlier + b * S;
            for (int64_t j = 0; j < S; j++) sums[j] += first[j] * second[j];
            for (int64_t i = 0; i < n_x; i++) {
                add(S, (a == b ? 1 : 2) * after[a * S + i] * after[b * S + i], sums, W + i * S);
            }
        }
    }
    for (int64_t i = 0; i < n_x; i++) for (int64_t j = 0; j < n_x; j++) W[i * n_x + j] = W[i * S + j];
}

/* Propagators P from the first instant to each of the n cuts, and the deviations there, from the log of `deviations`. */
static void from_the_start(int64_t steps, int64_t n_x, const double *row, int64_t n, const double *cuts,
                           const double *Q, int64_t F, double *P, double *corners, double *work)
{
    for (int64_t i = 0; i < F * F; i++) P[i] = i % (F + 1) == 0;
    for (int64_t i = 0; i < F * n_x; i++) corners[i] = Q[i];
    for (int64_t i = 0; i < F * F; i++) work[i] = P[i];
    for (int64_t step = 0, k = 1; step < steps && k < n; step++, row += 1 + F * (n_x + F)) {
        double *next = P + k * F * F;
        product(F, row + 1 + F * n_x, work, next);
        for (int64_t i = 0; i < F * F; i++) work[i] = next[i];
        if (row[0] != cuts[k]) continue;
        for (int64_t i = 0; i < F * n_x; i++) corners[k * F * n_x + i] = row[1 + i];
        k++;
    }
}

/* Whether the products of entries of n matrices with those of their inverses stay below a limit. */
static int moderate(int64_t n, int64_t F, const double *P, const double *inverses, double limit)
{
    double most = 0, most_inverse = 0;
    for (int64_t i = 0; i < n * F * F; i++) {
        if (!isfinite(P[i]) || !isfinite(inverses[i])) return 0;
        most = fmax(most, fabs(P[i]));
        most_inverse = fmax(most_inverse, fabs(inverses[i]));
    }
    return most * most_inverse < limit;
}

/* Between which the squares of the norms of Y = A(t) B(s) lie, of upper triangular factors, for all s <= t: `least` is the
   largest sum of squares of a row or column, `most` the sum of all; (n, n). work has n F^2 + n F + 2 n numbers. */
static void bounds(int64_t n, int64_t F, const double *A, const double *B, double *least, double *most, double *work)
{
    double *by_instant = work, *columns = by_instant + n * F * F, *row = columns + n * F, *y = row + n;
    for (int64_t s = 0; s < n; s++) for (int64_t i = 0; i < F * F; i++) by_instant[i * n + s] = B[s * F * F + i];
    for (int64_t t = 0; t < n; t++, least += n, most += n) {
        for (int64_t s = 0; s <= t; s++) least[s] = most[s] = 0;
        for (int64_t i = 0; i < n * F; i++) columns[i] = 0;
        for (int64_t i = 0; i < F; i++) {
            for (int64_t s = 0; s <= t; s++) row[s] = 0;
            for (int64_t j = i; j < F; j++) {
                for (int64_t s = 0; s <= t; s++) y[s] = 0;
                for (int64_t k = i; k <= j; k++) {
                    const double a = AT(A, t, i, k), *b = by_instant + (k * F + j) * n;
                    for (int64_t s = 0; s <= t; s++) y[s] += a * b[s];
                }
                double *column = columns + j * n;
                for (int64_t s = 0; s <= t; s++) row[s] += y[s] * y[s];
                for (int64_t s = 0; s <= t; s++) column[s] += y[s] * y[s];
            }
            for (int64_t s = 0; s <= t; s++) most[s] += row[s];
            for (int64_t s = 0; s <= t; s++) least[s] = row[s] > least[s] ? row[s] : least[s];
        }
        for (int64_t j = 0; j < F; j++) {
            const double *column = columns + j * n;
            for (int64_t s = 0; s <= t; s++) least[s] = column[s] > least[s] ? column[s] : least[s];
        }
    }
}

/* ln of the growth between the n cuts of `deviations`, (n, n), from its log, and the scale of the states: as `_growth` of
   growth.py. Q are the deviations at the first cut. A pair of which the growth is less than between two that are no
   farther apart is left out. Returns 0 beyond moderate propagators, of which products with inverses lose digits.
   With S = PADDED(n_x),
   work has 3 n F^2 + 4 F PADDED(F) + n n_x F + n F + 2 n (n + 1) + S (F^2 + 2 F + 2 + n_x) numbers. */
int64_t FN(growth)(int64_t steps, int64_t n_x, const double *log_of_steps, int64_t n, const double *cuts,
                   const double *Q, int64_t F, const Settings *settings, double *work, double *scale, double *logs)
{
    const int64_t S = PADDED(n_x);
    double *P = work, *inverses = P + n * F * F, *pair = inverses + n * F * F, *before = pair + 4 * F * PADDED(F);
    double *corners = before + S * F * F, *least = corners + n * F * n_x, *most = least + n * n, best = 0;
    double *after = most + n * n + n * F * F + n * F + 2 * n, *earlier = after + S * (F + 2), *W = earlier + S * F;
    const double least_part = exp2(-settings->squarings) * log((double)F);
    from_the_start(steps, n_x, log_of_steps, n, cuts, Q, F, P, corners, pair);
    for (int64_t k = 0; k < n; k++) inverse(F, P + k * F * F, inverses + k * F * F);
    if (!moderate(n, F, P, inverses, settings->moderate)) return 0;
    sum_of_squares(n, n_x, F, corners, P, inverses, before, after, earlier, W);
    balance(n_x, W, settings, scale, after);
    for (int64_t k = 0; k < n; k++) {
        double *columns = corners + k * F * n_x;
        for (int64_t i = 0; i < F * n_x; i++) columns[i] /= scale[i % n_x];
        if (!orthonormal(F, n_x, columns, pair)) return 0;
        product(F, pair, P + k * F * F, pair + F * F);
        for (int64_t i = 0; i < F * F; i++) P[k * F * F + i] = pair[F * F + i];
        inverse(F, P + k * F * F, inverses + k * F * F);
    }
    bounds(n, F, P, inverses, least, most, most + n * n);
    for (int64_t apart = 0; apart < n; apart++) {
        for (int64_t t = apart; t < n; t++) best = fmax(best, least[t * n + t - apart]);
        for (int64_t s = 0, t = apart; t < n; s++, t++) {
            double *result = logs + s * n + t;
            if (least[t * n + s] >= best) *result = log(fmax(best, settings->tiny)) / 2;
            if (!(most[t * n + s] > best) || !(most[t * n + s] > settings->tiny)) continue;
            const double log_best = log(fmax(best, settings->tiny)) / 2;
            product(F, P + t * F * F, inverses + s * F * F, pair);
            *result = log_norm(F, pair, settings->squarings, log_best, pair + F * F);
            best = fmax(best, exp(2 * *result - least_part));
        }
    }
    return 1;
}
