/* What loops over Taylor series share. */
#include "unit.h"

#ifndef SERIES_H
#define SERIES_H

static inline double falling(int64_t k, int64_t j)
{
    double product = 1;
    for (int64_t m = 0; m < j; m++) product *= (double)(k - m);
    return product;
}

/* Index of the m-th coefficient whose growth gives the step: the last two, and two of the middle, which keep the steps of
   functions without singularities, such as sin, below their period. */
static inline int64_t term(int64_t m) { return m < 2 ? LAST - m : LAST / 2 + 3 - m; }

/* Which entries of the rates gamma', ... of the state are integrated: all but those that rows determine. */
#ifdef SETTLED
static const int8_t free_rates[] = FREE;
#define IS_FREE(i) free_rates[i]
#else
#define IS_FREE(i) 1
#endif

/* The larger of two numbers >= 0; NaN if one is none. */
static inline void widen(double *largest, double a) { *largest = a > *largest || isnan(a) ? a : *largest; }

/* The highest level at which the i-th quasi-coordinate is integrated. */
static inline int64_t highest_level(int64_t i)
{
    int64_t j = TOP - 1;
    while (j > 0 && !IS_FREE((j - 1) * N + i)) j--;
    return j;
}

/* log2 of a number >= 0 from its bits, within 0.01; that of zero is -1023. */
static inline double rough_log2(double a)
{
    const int64_t bits = s_bits(a);
    const double f = s_value((bits & 0x000fffffffffffffLL) | 0x3ff0000000000000LL) - 1;
    return (double)((bits >> 52) - 1023) + f * (1 + BEND - BEND * f);
}

/* Its inverse, within 0.5 %, the smallest normal number for what is far below, and 2^REST for what is far above. */
static inline double rough_exp2(double a)
{
    const double within = a > -1022 ? (a < REST ? a : REST) : -1022, whole = floor(within), f = within - whole;
    return s_value(((int64_t)whole + 1023) << 52) * (1 + f * (1 - BEND + BEND * f));
}

#ifdef SETTLED
/* Put the rates that rows determine into a state. */
static inline void settle(double t, double *x, const double *p)
{
    double all[NX + N];
    FN(settled)(t, x, p, all);
    for (int64_t i = NQ; i < NX; i++) if (!IS_FREE(i - NQ)) x[i] = all[i];
}
#else
#define settle(t, x, p) ((void)(t), (void)(x), (void)(p))
#endif

#endif
