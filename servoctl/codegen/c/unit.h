/* Head of every unit. The emitter defines, before it includes a file of this folder,

   NAME            the function: void NAME(double t, const double *x, const double *p, double *y), x -> y
   NX, NP, NY      the lengths of x, p and y
   PROJECTED       where there is NAME_project, the change of x that restores invariants
   WIDE            where there is NAME_wide, the same for eight points at once
   WORK            for some loops the length of the vector w that NAME_instant, NAME_correction and NAME_rest share: what
                   depends on t and p alone, the Newton correction, and the other outputs; of NAME_wide as well; for that
                   of taylor.c it is the vector of NAME_still, what depends on p alone, and NAME_moving
   CORRECTIONS, ...    the tolerances of Newton's method and of continuation in loops.py

   and what the file itself names; tests/alone.h is an example, by which each file compiles alone. */
#ifndef UNIT_H
#define UNIT_H

#include <math.h>
#include <stdint.h>

#define GLUED_(a, b) a##_##b
#define GLUED(a, b) GLUED_(a, b)
#define FN(suffix) GLUED(NAME, suffix) /* NAME_suffix: a function that is called from outside */
#define INLINE static inline __attribute__((always_inline))

/* Whether numbers are finite. */
static inline int all_finite(int64_t count, const double *x)
{
    double sum = 0;
    for (int64_t i = 0; i < count; i++) sum += x[i] * 0;
    return sum == 0;
}

#include "inline_sine.h"
#include "inverse_erf.h"

#endif
