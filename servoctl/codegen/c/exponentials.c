/* Exponentials of many (N, N) matrices. */
#include "rows.h"

/* Row sum norms of x/s, with a scale s for each entry. */
void FN(norms)(int64_t count, const double *x, const double *scales, double *norms)
{
    for (int64_t sample = 0; sample < count; sample++, x += N * N) {
        double largest = 0;
        for (int i = 0; i < N; i++) {
            double sum = 0;
            for (int j = 0; j < N; j++) sum += fabs(x[i * N + j] / scales[i * N + j]);
            largest = sum <= largest ? largest : sum; /* also if it is not a number */
        }
        norms[sample] = largest;
    }
}

static void multiplied(V a[N][BLOCKS], V b[N][BLOCKS], V c[N][BLOCKS])
{
    for (int i = 0; i < N; i++) COMBINE(c[i], 1, N, ENTRY(a[i], k), b)
}

/* The Taylor series of exp(a) to the power `terms`, a multiple of 4, in powers of a^4 (Paterson and Stockmeyer). */
static void series(V powers[5][N][BLOCKS], int64_t terms, V sum[N][BLOCKS])
{
    V next[N][BLOCKS];
    double factorial = 1; /* terms! / k! */
    for (int k = 2; k < 5; k++) multiplied(powers[1], powers[k - 1], powers[k]);
    for (int i = 0; i < N; i++) EACH_BLOCK(j) next[i][j] = powers[4][i][j];
    for (int64_t term = terms - 4; term >= 0; term -= 4) {
        if (term < terms - 4) multiplied(powers[4], sum, next);
        for (int k = 3; k >= 0; k--) {
            factorial *= (double)(term + k + 1);
            for (int i = 0; i < N; i++) EACH_BLOCK(j) next[i][j] += factorial * powers[k][i][j];
        }
        for (int i = 0; i < N; i++) EACH_BLOCK(j) sum[i][j] = next[i][j];
    }
    for (int i = 0; i < N; i++) EACH_BLOCK(j) sum[i][j] /= factorial;
}

/* y = s exp(x/s 2^-squarings)^(2^squarings), with a scale s for each entry that is a power of two. */
void FN(exponentials)(int64_t count, const double *x, const double *scales, const int64_t *squarings, int64_t terms,
                      double *y)
{
    V powers[5][N][BLOCKS] = {{{{0}}}}, sum[N][BLOCKS], squared[N][BLOCKS];
    double inverse[N * N];
    for (int i = 0; i < N; i++) ENTRY(powers[0][i], i) = 1;
    for (int i = 0; i < N * N; i++) inverse[i] = 1 / scales[i];
    for (int64_t sample = 0; sample < count; sample++, x += N * N, y += N * N) {
        const double scale = ldexp(1.0, -(int)squarings[sample]);
        for (int i = 0; i < N; i++) for (int k = 0; k < N; k++) {
            ENTRY(powers[1][i], k) = scale * (x[i * N + k] * inverse[i * N + k]);
        }
        series(powers, terms, sum);
        for (int64_t squaring = 0; squaring < squarings[sample]; squaring++) {
            multiplied(sum, sum, squared);
            for (int i = 0; i < N; i++) EACH_BLOCK(j) sum[i][j] = squared[i][j];
        }
        for (int i = 0; i < N; i++) for (int k = 0; k < N; k++) y[i * N + k] = scales[i * N + k] * ENTRY(sum[i], k);
    }
}
