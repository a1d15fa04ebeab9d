#ifndef PHASED_H
#define PHASED_H

#include "unit.h"

/* The function at time t, whose phases share w; what depends on t and p alone is that of the time *now, if that is t. */
static inline void evaluate(double t, const double *x, const double *p, double *y, double *w, double *now)
{
    if (t != *now) FN(instant)(*now = t, x, p, y, w);
    FN(correction)(t, x, p, y, w);
    FN(rest)(t, x, p, y, w);
}

#endif
