/* Exponentials of many matrices. */
#include "unit.h"

typedef double V __attribute__((vector_size(64)));
#define LANES 8
#define BLOCKS ((N + LANES - 1) / LANES) /* of columns; the last may have columns of zeros */

/* c = factor a b */
static void multiplied(const V a[N][BLOCKS], const V b[N][BLOCKS], double factor, V c[N][BLOCKS])
{
    for (int i = 0; i < N; i++) for (int j = 0; j < BLOCKS; j++) {
        V sum = {0};
        for (int k = 0; k < N; k++) sum += a[i][k / LANES][k % LANES] * b[k][j];
        c[i][j] = factor * sum;
    }
}

/* y = s exp(x 2^-squarings)^(2^squarings) with a scale s for each entry, of (N, N) matrices by their Taylor series. */
void FN(exponentials)(int64_t count, const double *x, const double *scales, const int64_t *squarings, double *y)
{
    V balanced[N][BLOCKS] = {{{0}}}, power[N][BLOCKS], next[N][BLOCKS];
    for (int64_t sample = 0; sample < count; sample++, x += N * N, y += N * N) {
        const double scale = ldexp(1.0, -(int)squarings[sample]);
        for (int i = 0; i < N; i++) for (int j = 0; j < N; j++) {
            balanced[i][j / LANES][j % LANES] = scale * x[i * N + j];
        }
        __builtin_memset(power, 0, sizeof power);
        for (int i = 0; i < N; i++) power[i][i / LANES][i % LANES] = 1;
        for (int term = TERMS; term > 0; term--) {
            multiplied(balanced, power, 1.0 / term, next);
            __builtin_memcpy(power, next, sizeof power);
            for (int i = 0; i < N; i++) power[i][i / LANES][i % LANES] += 1;
        }
        for (int64_t squaring = 0; squaring < squarings[sample]; squaring++) {
            multiplied(power, power, 1, next);
            __builtin_memcpy(power, next, sizeof power);
        }
        for (int i = 0; i < N; i++) for (int j = 0; j < N; j++) {
            y[i * N + j] = scales[i * N + j] * power[i][j / LANES][j % LANES];
        }
    }
}
