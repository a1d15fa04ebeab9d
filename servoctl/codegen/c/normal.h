/* Normally distributed numbers that follow from a key and a counter alone: words of the generator Philox 4x64-10 (Salmon,
   Moraes, Dror, Shaw, SC 2011), the same as NumPy's, and the transformation of Box and Muller, in the lanes of W. */
#include "lanes.h"

#ifndef NORMAL_H
#define NORMAL_H

/* The four words of the counter (c0, c1, c2, 0). */
INLINE void philox(const uint64_t *key, uint64_t c0, uint64_t c1, uint64_t c2, uint64_t word[4])
{
    uint64_t a = c0, b = c1, c = c2, d = 0, k0 = key[0], k1 = key[1];
    for (int round = 0; round < 10; round++) {
        const unsigned __int128 first = (unsigned __int128)a * 0xD2E7470EE14C6C93u;
        const unsigned __int128 second = (unsigned __int128)c * 0xCA5A826395121157u;
        a = (uint64_t)(second >> 64) ^ b ^ k0;
        c = (uint64_t)(first >> 64) ^ d ^ k1;
        b = (uint64_t)second;
        d = (uint64_t)first;
        k0 += 0x9E3779B97F4A7C15u;
        k1 += 0xBB67AE8584CAA73Bu;
    }
    word[0] = a;
    word[1] = b;
    word[2] = c;
    word[3] = d;
}

/* The logarithm of normal positive numbers, as fdlibm's: within one unit in the last place. */
INLINE W w_ln(W a)
{
    const I exponent = ((I)a - 0x3fe6a09e667f3bcdLL) >> 52;
    const W k = __builtin_convertvector(exponent, W), f = (W)((I)a - (exponent << 52)) - 1.0;
    const W s = f / (2.0 + f), z = s * s, half = 0.5 * f * f;
    const W r = z * (6.666666666666735130e-01 + z * (3.999999999940941908e-01 + z * (2.857142874366239149e-01
        + z * (2.222219843214978396e-01 + z * (1.818357216161805012e-01 + z * (1.531383769920937332e-01
        + z * 1.479819860511658591e-01))))));
    return k * 6.93147180369123816490e-01 - ((half - (s * (half + r) + k * 1.90821492927058770002e-10)) - f);
}

/* Four independent normal numbers in each lane: of key i times `own`, of the counter c0 + i times `next` in channel c1. */
INLINE void w_normal(const uint64_t *key, int64_t own, uint64_t c0, uint64_t next, uint64_t c1, W y[4])
{
    I words[4];
    EACH_LANE {
        uint64_t word[4];
        philox(key + i * own, c0 + (uint64_t)i * next, c1, 0, word);
        for (int j = 0; j < 4; j++) words[j][i] = (int64_t)(word[j] >> 11);
    }
    for (int pair = 0; pair < 4; pair += 2) {
        const W u = __builtin_convertvector(words[pair] + 1, W) * 0x1p-53;
        const W a = __builtin_convertvector(words[pair + 1], W) * (0x1p-52 * 3.14159265358979323846);
        const W r = w_sqrt(-2.0 * w_ln(u));
        y[pair] = r * w_turned(a, 1);
        y[pair + 1] = r * w_turned(a, 0);
    }
}

#endif
