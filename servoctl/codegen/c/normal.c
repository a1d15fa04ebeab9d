/* First words of one key. */
#include "normal.h"

/* The first word of each channel of a kind. */
void first_words(const uint64_t *key, int64_t kind, int64_t count, uint64_t *y)
{
    uint64_t word[4];
    for (int64_t channel = 0; channel < count; channel++) {
        philox(key, 1, (uint64_t)channel, (uint64_t)kind, word);
        y[channel] = word[0];
    }
}
