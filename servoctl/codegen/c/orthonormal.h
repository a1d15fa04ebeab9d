/* Orthonormal columns. */
#ifndef ORTHONORMAL_H
#define ORTHONORMAL_H

#include "unit.h"

#define PADDED(n) (((n) + 7) / 8 * 8) /* to whole vectors */

/* Columns Q (F, n) become Q R^-1 with Q'Q = 1, by Gram and Schmidt's process, twice; 0 where they are dependent. */
static int orthonormal(int64_t F, int64_t n, double *Q, double *R)
{
    for (int64_t i = 0; i < F * F; i++) R[i] = 0;
    for (int64_t j = 0; j < F; j++) {
        double *v = Q + j * n, square = 0;
        for (int twice = 0; twice < 2; twice++) {
            for (int64_t i = 0; i < j; i++) {
                double along = 0;
                for (int64_t m = 0; m < n; m++) along += Q[i * n + m] * v[m];
                for (int64_t m = 0; m < n; m++) v[m] -= along * Q[i * n + m];
                R[i * F + j] += along;
            }
        }
        for (int64_t m = 0; m < n; m++) square += v[m] * v[m];
        const double size = sqrt(square);
        if (!(size > 0 && isfinite(size))) return 0;
        for (int64_t m = 0; m < n; m++) v[m] /= size;
        R[j * F + j] = size;
    }
    return 1;
}

/* C = A B of upper triangular matrices (F, F). */
static void triangular_product(int64_t F, const double *A, const double *B, double *C)
{
    for (int64_t i = 0; i < F * F; i++) C[i] = 0;
    for (int64_t i = 0; i < F; i++) for (int64_t k = i; k < F; k++) for (int64_t j = k; j < F; j++) {
        C[i * F + j] += A[i * F + k] * B[k * F + j];
    }
}

#endif
