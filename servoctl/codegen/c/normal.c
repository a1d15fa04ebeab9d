/* Normally distributed numbers of one key: the lanes are counters. */
#include "normal.h"

/* Numbers 0 .. count - 1 of a channel, at y[0], y[stride], ... */
void normal(const uint64_t *key, int64_t channel, int64_t count, int64_t stride, double *y)
{
    for (int64_t first = 0; first < count; first += 4 * W_LANES) {
        W z[4];
        w_normal(key, 0, (uint64_t)(first / 4 + 1), 1, (uint64_t)channel, z);
        EACH_LANE for (int j = 0; j < 4; j++) {
            const int64_t place = first + 4 * i + j;
            if (place < count) y[place * stride] = z[j][i];
        }
    }
}

/* The first word of each channel of a kind. */
void first_words(const uint64_t *key, int64_t kind, int64_t count, uint64_t *y)
{
    uint64_t word[4];
    for (int64_t channel = 0; channel < count; channel++) {
        philox(key, 1, (uint64_t)channel, (uint64_t)kind, word);
        y[channel] = word[0];
    }
}
