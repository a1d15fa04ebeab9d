#ifndef RESTORE_H
#define RESTORE_H

#include "unit.h"

#ifdef PROJECTED
/* Newton's iteration of the projection onto the invariants, level by level within each correction. */
static void restore(double t, double *x, const double *p)
{
    double d[NX + 1];
    for (int64_t iteration = 0; iteration < 6; iteration++) {
        double largest = 0;
        FN(project)(t, x, p, d);
        for (int64_t i = 0; i < NX; i++) {
            const double e = fabs(d[i]) / (1 + fabs(x[i]));
            if (!isfinite(e)) return;
            if (e > largest) largest = e;
        }
        for (int64_t i = 0; i < NX; i++) x[i] += d[i];
        if (largest <= ROUNDING) return;
    }
}
#else
#define restore(t, x, p) ((void)(t), (void)(x), (void)(p))
#endif

#endif
