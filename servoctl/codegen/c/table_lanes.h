/* Lookups of several points at once, for functions that have tables. */
#include "lanes.h"
#include "table.h"

#ifndef TABLE_LANES_H
#define TABLE_LANES_H

#ifdef __AVX512F__
#include <immintrin.h>
#endif

/* Consecutive lanes are mostly in one row, or in the next. */
INLINE int in_row(const Knots *knots, int row, double s)
{
    return (row == 0 || knots->at[row - 1] <= s) && (row == knots->n || s < knots->at[row]);
}
INLINE W w_row(const Knots *knots, W s)
{
    int at = (int)row(knots, s[0]);
    const W begun = ALL(at > 0 ? knots->at[at - 1] : -INFINITY), over = ALL(at < knots->n ? knots->at[at] : INFINITY);
    W rows = ALL((double)at);
    if (w_any(~((begun <= s) & (s < over)))) EACH_LANE {
        if (!in_row(knots, at, s[i])) at = at < knots->n && in_row(knots, at + 1, s[i]) ? at + 1 : (int)row(knots, s[i]);
        rows[i] = at;
    }
    return rows;
}
INLINE W w_entry(const double *column, int columns, W rows)
{
    if (!w_any(rows != rows[0])) return ALL(entry(column, columns, rows[0]));
    const I place = __builtin_convertvector(rows, I) * columns;
#if defined(__AVX512F__) && W_LANES == 8
    return (W)_mm512_i64gather_pd((__m512i)place, column, 8);
#else
    W r;
    EACH_LANE r[i] = column[place[i]];
    return r;
#endif
}

#endif
