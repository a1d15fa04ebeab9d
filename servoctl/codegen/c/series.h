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

/* log2 of a number >= 0 from its bits, within 0.01; that of zero is -1023. */
static inline double rough_log2(double a)
{
    const int64_t bits = s_bits(a);
    const double f = s_value((bits & 0x000fffffffffffffLL) | 0x3ff0000000000000LL) - 1;
    return (double)((bits >> 52) - 1023) + f * (1 + BEND - BEND * f);
}

#endif
