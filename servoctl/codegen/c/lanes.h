/* Several points at once: the vector type W, with a function w_name for each operation of an expression. What has no
   formula here or in circular.h is computed lane by lane. Values differ from those of one point by rounding. */
#include "unit.h"

#ifndef LANES_H
#define LANES_H

#include "inverse_erf.h"

#ifndef W_LANES
#define W_LANES 8 /* a power of two */
#endif

typedef double W __attribute__((vector_size(8 * W_LANES)));
typedef int64_t I __attribute__((vector_size(8 * W_LANES)));
typedef int8_t M __attribute__((vector_size(W_LANES)));
typedef double U __attribute__((vector_size(8 * W_LANES), aligned(8), may_alias)); /* of any place in memory */

#if W_LANES == 8
#define ALL(c) ((W){(c), (c), (c), (c), (c), (c), (c), (c)})
#elif W_LANES == 4
#define ALL(c) ((W){(c), (c), (c), (c)})
#elif W_LANES == 2
#define ALL(c) ((W){(c), (c)})
#else
#define ALL(c) ((W){(c)})
#endif

INLINE W w_load(const double *from) { return *(const U *)from; }
INLINE void w_store(double *to, W value) { *(U *)to = value; }
INLINE W w_select(I mask, W a, W b) { return (W)((mask & (I)a) | (~mask & (I)b)); }
INLINE int w_any(I mask)
{
    const M bytes = __builtin_convertvector(mask, M);
    int64_t word = 0;
    __builtin_memcpy(&word, &bytes, W_LANES);
    return word != 0;
}
INLINE I w_bits(W a) { return (I)a; }
INLINE W w_value(I bits) { return (W)bits; }
INLINE W w_truth(I mask) { return (W)(mask & (I)ALL(1.0)); }

INLINE W w_fabs(W a) { return (W)((I)a & 0x7fffffffffffffffLL); }
INLINE W w_fmin(W a, W b) { return w_select((a <= b) | (b != b), a, b); }
INLINE W w_fmax(W a, W b) { return w_select((a >= b) | (b != b), a, b); }
#if W_LANES == 8 && defined(__AVX512F__) && defined(__GNUC__) && !defined(__clang__) /* one instruction, which gcc does not see */
INLINE W w_lesser(W a, W b) { return (W)__builtin_ia32_minpd512_mask(a, b, a, -1, 4); }
typedef long long L __attribute__((vector_size(64)));
INLINE W w_larger_size(W a, W b) { return (W)__builtin_ia32_pmaxsq512_mask((L)a, (L)b, (L)a, -1); }
#else
INLINE W w_lesser(W a, W b) { return w_select(a < b, a, b); }
INLINE W w_larger_size(W a, W b) { return w_select(w_bits(a) > w_bits(b), a, b); } /* of numbers >= 0; NaN if one is none */
#endif
INLINE W w_sign(W a) { return w_select(a < 0, ALL(-1.0), w_select(a > 0, ALL(1.0), a)); }
INLINE W w_not(W a) { return w_truth(a == 0); }
INLINE W w_lt(W a, W b) { return w_truth(a < b); }
INLINE W w_le(W a, W b) { return w_truth(a <= b); }
INLINE W w_eq(W a, W b) { return w_truth(a == b); }
INLINE W w_ne(W a, W b) { return w_truth(a != b); }
INLINE W w_and(W a, W b) { return w_truth((a != 0) & (b != 0)); }
INLINE W w_or(W a, W b) { return w_truth((a != 0) | (b != 0)); }
INLINE W w_if_else_zero(W a, W b) { return (W)((a != 0) & (I)b); }

#define EACH_LANE for (int i = 0; i < W_LANES; i++)
#define BY_LANE(name, of_one) INLINE W w_##name(W a) { W r; EACH_LANE r[i] = of_one(a[i]); return r; }
#define BY_LANE_2(name) INLINE W w_##name(W a, W b) { W r; EACH_LANE r[i] = name(a[i], b[i]); return r; }
BY_LANE(sqrt, sqrt)
BY_LANE(exp, exp)
BY_LANE(log, log)
BY_LANE(expm1, expm1)
BY_LANE(log1p, log1p)
BY_LANE(tan, tan)
BY_LANE(asin, asin)
BY_LANE(acos, acos)
BY_LANE(atan, atan)
BY_LANE(sinh, sinh)
BY_LANE(cosh, cosh)
BY_LANE(tanh, tanh)
BY_LANE(asinh, asinh)
BY_LANE(acosh, acosh)
BY_LANE(atanh, atanh)
BY_LANE(floor, floor)
BY_LANE(ceil, ceil)
BY_LANE(rint, rint)
BY_LANE(erf, erf)
BY_LANE(erfinv, inverse_erf)
BY_LANE_2(pow)
BY_LANE_2(fmod)
BY_LANE_2(remainder)
BY_LANE_2(atan2)
BY_LANE_2(copysign)
BY_LANE_2(hypot)

#define OF(name) w_##name
#define REAL W
#define WHOLE I
#include "circular.h"

/* The value is computed before the question whether it holds, so that compilers compute common parts once. */
INLINE int w_moderate(W a) { return !w_any(~(w_fabs(a) < FAR)); }
static __attribute__((noinline, cold)) W w_far_sin(W a, W r)
{
    EACH_LANE if (!(fabs(a[i]) < FAR)) r[i] = sin(a[i]);
    return r;
}
INLINE W w_sin(W a)
{
    const W r = w_turned(a, 0);
    return w_moderate(a) ? r : w_far_sin(a, r);
}
static __attribute__((noinline, cold)) W w_far_cos(W a, W r)
{
    EACH_LANE if (!(fabs(a[i]) < FAR)) r[i] = cos(a[i]);
    return r;
}
INLINE W w_cos(W a)
{
    const W r = w_turned(a, 1);
    return w_moderate(a) ? r : w_far_cos(a, r);
}

#endif
