/* Matrices of N columns whose rows are vectors; the columns beyond N are zero. */
#ifndef ROWS_H
#define ROWS_H

#include "unit.h"

#define LANES 8
#define BLOCKS ((N + LANES - 1) / LANES)
#define EACH_BLOCK(j) for (int j = 0; j < BLOCKS; j++)
#define ENTRY(row, k) (row)[(k) / LANES][(k) % LANES]

typedef double V __attribute__((vector_size(8 * LANES)));

/* sum = factor times the sum of coefficient(k) row(k), over k < count */
#define COMBINE(sum, factor, count, coefficient, rows) \
    EACH_BLOCK(j) { \
        V total = {0}; \
        for (int k = 0; k < (count); k++) total += (coefficient) * (rows)[k][j]; \
        (sum)[j] = (factor) * total; \
    }

/* A row of N numbers. */
INLINE void loaded(V row[BLOCKS], const double *from)
{
    EACH_BLOCK(j) row[j] = (V){0};
    for (int k = 0; k < N; k++) ENTRY(row, k) = from[k];
}

#endif
