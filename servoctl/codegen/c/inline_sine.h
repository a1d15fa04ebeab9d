/* s_sin and s_cos: sine and cosine of one number, in line, twice as fast as the C library's. */
#include "unit.h"

#ifndef INLINE_SINE_H
#define INLINE_SINE_H

INLINE int64_t s_bits(double a) { int64_t bits; __builtin_memcpy(&bits, &a, 8); return bits; }
INLINE double s_value(int64_t bits) { double a; __builtin_memcpy(&a, &bits, 8); return a; }
INLINE double s_select(int which, double a, double b) { return which ? a : b; }

#define OF(name) s_##name
#define REAL double
#define WHOLE int64_t
#include "circular.h"

#define EIGHTH 0.785 /* below pi/4: angles below it are as they were after a reduction, which is left out */

static __attribute__((noinline, cold)) double s_far_sin(double a) { return sin(a); }
static __attribute__((noinline, cold)) double s_far_cos(double a) { return cos(a); }

INLINE double s_circular(double a, int64_t turns)
{
    if (__builtin_expect(fabs(a) < EIGHTH, 1)) return s_of_reduced(a, 0, turns);
    if (fabs(a) < FAR) return s_turned(a, turns);
    return turns ? s_far_cos(a) : s_far_sin(a);
}

INLINE double s_sin(double a) { return s_circular(a, 0); }
INLINE double s_cos(double a) { return s_circular(a, 1); }

#endif
