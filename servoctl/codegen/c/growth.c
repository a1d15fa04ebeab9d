/* Whether deviations from a motion with n_x states grow as those of unstable internal dynamics do. */
#include "unit.h"
#include "orthonormal.h"
#include "lanes.h"

/* The constants of growth.py. */
typedef struct {
    double moderate, sweeps, balanced, tiny, squarings, unstable, exponential, faster, most_growth, great;
} Settings;

/* Matrices at n instants are blocks of matrices of vectors, whose lanes are instants; those beyond n repeat the last one. */

/* Rows of Q (F, n_x) become those of R^-T Q, which are orthonormal, by Gram and Schmidt's process, twice; values that are
   not finite where they are dependent. */
static void orthonormal_rows(int64_t F, int64_t n_x, W *Q, W *R)
{
    for (int64_t i = 0; i < F * F; i++) R[i] = ALL(0.0);
    for (int64_t j = 0; j < F; j++) {
        W *v = Q + j * n_x, square = ALL(0.0), unit;
        for (int twice = 0; twice < 2; twice++) for (int64_t i = 0; i < j; i++) {
            W along = ALL(0.0);
            for (int64_t m = 0; m < n_x; m++) along += Q[i * n_x + m] * v[m];
            for (int64_t m = 0; m < n_x; m++) v[m] -= along * Q[i * n_x + m];
            R[i * F + j] += along;
        }
        for (int64_t m = 0; m < n_x; m++) square += v[m] * v[m];
        for (int64_t l = 0; l < W_LANES; l++) R[j * F + j][l] = sqrt(square[l]);
        unit = 1 / R[j * F + j];
        for (int64_t m = 0; m < n_x; m++) v[m] *= unit;
    }
}

/* B = A^-1 of upper triangular matrices. */
static void inverse(int64_t F, const W *A, W *B)
{
    for (int64_t j = 0; j < F; j++) for (int64_t i = F - 1; i >= 0; i--) {
        W sum = i == j ? ALL(1.0) : ALL(0.0);
        for (int64_t k = i + 1; k <= j; k++) sum -= A[i * F + k] * B[k * F + j];
        B[i * F + j] = i > j ? ALL(0.0) : sum / A[i * F + i];
    }
}

/* Whether the products of entries of matrices with those of their inverses stay below a limit. */
static int moderate(int64_t count, const W *P, const W *inverses, double limit)
{
    W most = ALL(0.0), most_inverse = ALL(0.0), sum = ALL(0.0);
    for (int64_t i = 0; i < count; i++) {
        most = w_fmax(most, w_fabs(P[i]));
        most_inverse = w_fmax(most_inverse, w_fabs(inverses[i]));
        sum += P[i] * 0 + inverses[i] * 0;
    }
    double largest = 0, largest_inverse = 0;
    for (int64_t l = 0; l < W_LANES; l++) {
        if (sum[l] != 0) return 0; /* one is not finite */
        largest = fmax(largest, most[l]);
        largest_inverse = fmax(largest_inverse, most_inverse[l]);
    }
    return largest * largest_inverse < limit;
}

/* Sums over the lanes up to each. */
static inline W sums_up_to(W a)
{
    for (int64_t apart = 1; apart < W_LANES; apart *= 2) {
#ifdef __clang__
        double after[2 * W_LANES] = {0};
        w_store(after + W_LANES, a);
        a += w_load(after + W_LANES - apart);
#else /* in seven eighths of the time */
        I from;
        for (int64_t l = 0; l < W_LANES; l++) from[l] = l < apart ? W_LANES : l - apart;
        a += __builtin_shuffle(a, ALL(0.0), from);
#endif
    }
    return a;
}

/* The sum of the squares of N(t) Phi(t, s) N(s)' = Z(t) P(s)^-1 Q(s)' over all pairs of instants t >= s, squares (n_x, n_x).
   work has n_x^2 + F (F + 1) n_x + F n_x vectors. */
static void sum_of_squares(int64_t n, int64_t F, int64_t n_x, const W *Z, const W *Q, const W *inverses, double *squares,
                           W *work)
{
    W *sums = work, *before = sums + n_x * n_x, *earlier = before + F * (F + 1) / 2 * n_x, *after = earlier + F * n_x;
    for (int64_t i = 0; i < n_x * n_x + F * (F + 1) / 2 * n_x; i++) sums[i] = ALL(0.0);
    for (int64_t block = 0; block < PADDED(n); block += W_LANES, Z += F * n_x, Q += F * n_x, inverses += F * F) {
        W counted, *carried = before;
        for (int64_t l = 0; l < W_LANES; l++) counted[l] = block + l < n;
        for (int64_t j = 0; j < F; j++) for (int64_t i = 0; i < n_x; i++) {
            W sum = ALL(0.0);
            for (int64_t k = j; k < F; k++) sum += Q[k * n_x + i] * inverses[j * F + k];
            earlier[j * n_x + i] = sum;
        }
        for (int64_t a = 0; a < F; a++) for (int64_t b = a; b < F; b++, carried += n_x) {
            for (int64_t j = 0; j < n_x; j++) {
                const W sum = carried[j] + sums_up_to(earlier[a * n_x + j] * earlier[b * n_x + j]);
                after[j] = sum;
                carried[j] = ALL(sum[W_LANES - 1]);
            }
            for (int64_t i = 0; i < n_x; i++) {
                const W z = counted * (a == b ? 1.0 : 2.0) * Z[a * n_x + i] * Z[b * n_x + i];
                for (int64_t j = 0; j < n_x; j++) sums[i * n_x + j] += z * after[j];
            }
        }
    }
    for (int64_t i = 0; i < n_x * n_x; i++) {
        squares[i] = 0;
        for (int64_t l = 0; l < W_LANES; l++) squares[i] += sums[i][l];
    }
}

/* d that makes the sum of S_ij d_j^2/d_i^2 smallest, as `_balance` of growth.py; work has 3 n_x numbers. */
static void balance(int64_t n_x, const double *S, const Settings *settings, double *scale, double *work)
{
    double *square = work, *ratios = work + n_x, *inverses = ratios + n_x;
    for (int64_t i = 0; i < n_x; i++) square[i] = inverses[i] = 1;
    for (int64_t sweep = 0; sweep < settings->sweeps; sweep++) {
        double most = 1;
        for (int64_t i = 0; i < n_x; i++) {
            double row = 0, column = 0;
            for (int64_t j = 0; j < n_x; j++) {
                row += S[i * n_x + j] * square[j];
                column += S[j * n_x + i] * inverses[j];
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

/* The entries of matrices at an instant t, W_LANES numbers apart. */
static inline const double *at(const W *matrices, int64_t F, int64_t t)
{
    return (const double *)(matrices + t / W_LANES * F * F) + t % W_LANES;
}

/* Between which the squares of the norms of Y = A(t) B(s) lie, of upper triangular factors, for all s <= t: `least` is the
   largest sum of squares of a row or column, `most` the sum of all; (n, PADDED(n)). work has F vectors. */
static void bounds(int64_t n, int64_t F, const W *A, const W *B, double *least, double *most, W *work)
{
    for (int64_t t = 0; t < n; t++) for (int64_t s = 0; s <= t; s += W_LANES) {
        const double *a = at(A, F, t);
        const W *b = B + s / W_LANES * F * F;
        W *column = work, largest = ALL(0.0), all = ALL(0.0);
        for (int64_t j = 0; j < F; j++) column[j] = ALL(0.0);
        for (int64_t i = 0; i < F; i++) {
            W row = ALL(0.0);
            for (int64_t j = i; j < F; j++) {
                W y = ALL(0.0);
                for (int64_t k = i; k <= j; k++) y += a[(i * F + k) * W_LANES] * b[k * F + j];
                row += y * y;
                column[j] += y * y;
            }
            largest = w_fmax(largest, row);
            all += row;
        }
        for (int64_t j = 0; j < F; j++) largest = w_fmax(largest, column[j]);
        w_store(least + t * PADDED(n) + s, largest);
        w_store(most + t * PADDED(n) + s, all);
    }
}

/* Rows of the length S, padded with zeros. */
static inline void add(int64_t S, double factor, const double *restrict from, double *restrict to)
{
    for (int64_t i = 0; i < S; i += 8) for (int64_t l = i; l < i + 8; l++) to[l] += factor * from[l];
}

/* ln of the norm of A(t) B(s), from the trace of (Y'Y)^(2^squarings), which exceeds that of the largest eigenvalue F times
   at most; of a norm below `least` fewer squarings do, as they bound it. work has (2 F + 1) PADDED(F) numbers. */
static double log_norm(int64_t F, const double *A, const double *B, double squarings, double least, double *work)
{
    const int64_t S = PADDED(F);
    double *G = work, *square = G + F * S, *row = square + F * S, result = 0, part = 0.5;
    for (int64_t i = 0; i < F * S; i++) G[i] = 0;
    for (int64_t i = 0; i < F; i++) {
        for (int64_t j = 0; j < S; j++) row[j] = 0;
        for (int64_t k = i; k < F; k++) for (int64_t j = k; j < F; j++) {
            row[j] += A[(i * F + k) * W_LANES] * B[(k * F + j) * W_LANES];
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

/* Whether deviations Z (F, n_x, PADDED(n)) from a motion at n instants, those at the first of them moved on, tell that its
   internal dynamics are not unstable. Growth is that of the states x_i/scale_i; `within` is as for `quiet`, where all other
   growth is less. 0 as well beyond moderate propagators, of which products with inverses lose digits. work has the numbers
   of W_LANES + 2 n PADDED(n) + 2 PADDED(n) F (n_x + F) + n_x (n_x + 3) + (2 F + 1) PADDED(F)
   + W_LANES (n_x^2 + F n_x (F + 1)/2 + (F + 1) (n_x + 1)). */
int64_t FN(growth)(int64_t n, int64_t n_x, int64_t F, const double *Z, const Settings *settings, double *work,
                   double *scale, double *within)
{
    const int64_t S = PADDED(n), blocks = S / W_LANES, all = F * n_x;
    W *whole = (W *)(((uintptr_t)work + sizeof(W) - 1) / sizeof(W) * sizeof(W)), *Q = whole + blocks * all;
    W *P = Q + blocks * all, *inverses = P + blocks * F * F, *rest = inverses + blocks * F * F;
    double *least = (double *)(rest + n_x * n_x + all * (F + 1) / 2 + (F + 1) * (n_x + 1)), *most = least + n * S;
    double *squares = most + n * S, *of_pair = squares + n_x * (n_x + 3), best = 1;
    const double least_part = exp2(-settings->squarings) * log((double)F);
    for (int64_t block = 0; block < blocks; block++) for (int64_t e = 0; e < all; e++) {
        W *z = whole + block * all + e;
        for (int64_t l = 0, t = block * W_LANES; l < W_LANES; l++, t++) (*z)[l] = Z[e * S + (t < n ? t : n - 1)];
        Q[block * all + e] = *z;
    }
    for (int64_t k = 0; k < blocks; k++) {
        orthonormal_rows(F, n_x, Q + k * all, P + k * F * F);
        inverse(F, P + k * F * F, inverses + k * F * F);
    }
    if (!moderate(blocks * F * F, P, inverses, settings->moderate)) return 0;
    sum_of_squares(n, F, n_x, whole, Q, inverses, squares, rest);
    balance(n_x, squares, settings, scale, squares + n_x * n_x);
    for (int64_t k = 0; k < blocks; k++) {
        for (int64_t e = 0; e < all; e++) Q[k * all + e] = whole[k * all + e] / scale[e % n_x];
        orthonormal_rows(F, n_x, Q + k * all, P + k * F * F);
        inverse(F, P + k * F * F, inverses + k * F * F);
    }
    bounds(n, F, P, inverses, least, most, rest);
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
            const double *a = at(P, F, t), *b = at(inverses, F, s);
            const double found = log_norm(F, a, b, settings->squarings, log(best) / 2, of_pair);
            within[apart] = fmax(within[apart], found);
            best = fmax(best, exp(2 * found - least_part));
        }
    }
    return quiet(n, F, within, settings);
}
