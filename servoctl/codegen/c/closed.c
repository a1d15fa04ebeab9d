/* The sampled closed loop around a plant. It calls the law through a pointer. */
#include "unit.h"
#include "restore.h"

#define V double
#define V_OF(number) (number)
#define V_CALL(name) name
#include "sampled.h"

/* y = C x + noise, quantised. */
static void measure(const Loop *c, int64_t k, const double *x, double *y)
{
    for (int64_t i = 0; i < c->n_y; i++) {
        const double value = x[c->measured[i]];
        y[i] = quantised(c, i, c->noise ? value + c->noise[k * c->n_y + i] : value);
    }
}

#define EACH _Pragma("GCC unroll 32") for (int i = 0; i < NX; i++)
#define AT(v) v[i]
#define RATES(stage, instant, state, k) \
    for (int64_t i = 0; i < c->n_d; i++) p[c->disturbed[i]] = d[stage * c->n_d + i]; \
    NAME(instant, state, p, k)

/* A step with the rates written into it; d holds the disturbances at its start, middle and end. Vectors of states would
   be filled and emptied one by one, in each stage: they take longer than numbers. */
__attribute__((flatten, optimize("no-tree-vectorize")))
static void advance(const Loop *c, double t, double h, const double *d, double *x, double *p)
{
    double k1[NX + 1], k2[NX + 1], k3[NX + 1], k4[NX + 1], z[NX + 1];
    RATES(0, t, x, k1);
#include "rk4.h"
}

/* Whether measurements are neighbouring states as they are, which a law may read where they are logged. */
static int neighbours(const Loop *c)
{
    if (c->stride || c->noise || c->quantum || !c->n_y) return 0;
    for (int64_t i = 1; i < c->n_y; i++) if (c->measured[i] != c->measured[0] + i) return 0;
    return 1;
}

/* The loop; sample k at t0 + k period: measure, call the law, delay, limit, hold. It goes on at a step of a sample, and
   pauses after some steps, as an interruption waits for it. Returns the samples completed. */
__attribute__((optimize("no-tree-vectorize")))
int64_t FN(closed)(Step *law, Loop *c)
{
    double x[NX + 1], p[NP + 1];
    const double h = c->period / (double)c->substeps;
    const double *const direct = neighbours(c) ? c->x + c->measured[0] : 0;
    int64_t left = c->steps;
    for (int i = 0; i < NX; i++) x[i] = c->state[i];
    for (int i = 0; i < NP; i++) p[i] = c->p[i];
    if (c->sample + c->step == 0) for (int64_t i = 0; i < c->n_z; i++) c->law_x[c->n_y + i] = c->z0[i];
    for (int64_t k = c->sample; ; k++, c->step = 0) {
        const double t = c->t0 + (double)k * c->period;
        const int64_t row = c->first + k < c->rows ? c->first + k : c->rows - 1;
        double *y = c->law_x + k * c->stride, *out = c->law_y + k * c->n_out, *u = c->input + k * c->n_u;
        if (c->step == 0) {
            for (int i = 0; i < NX; i++) if (!isfinite(x[i])) { c->status = 1; return k; }
            for (int i = 0; i < NX; i++) c->x[k * NX + i] = x[i];
            if (!direct) measure(c, k, x, y);
            law(t, direct ? direct + k * NX : y, c->table + row * c->n_row, out);
            for (int64_t i = 0; i < c->n_u + c->n_z; i++) if (!isfinite(out[i])) { c->status = 2; return k; }
            const double *command = k < c->delay ? c->initial_input : out - c->delay * c->n_out;
            const double *before = k ? u - c->n_u : c->initial_input;
            for (int64_t i = 0; i < c->n_u; i++) p[c->at_u + i] = u[i] = limited(c, i, command[i], before[i]);
            if (k == c->samples) { c->status = 0; return k + 1; }
            for (int64_t i = 0; i < c->n_z; i++) y[c->stride + c->n_y + i] = out[c->n_u + i];
        }
        for (int64_t i = 0; c->step && i < c->n_u; i++) p[c->at_u + i] = u[i];
        for (int64_t s = c->step; s < c->substeps; s++) {
            const int64_t step = k * c->substeps + s;
            for (int64_t i = 0; c->transport && i < c->n_u; i++) {
                const int64_t sent = step - c->transport[i];
                p[c->at_u + i] = sent < 0 ? c->initial_input[i] : c->input[sent / c->substeps * c->n_u + i];
            }
            const int64_t last = first_part(c, step + 1);
            for (int64_t i = first_part(c, step); i < last; i++) {
                const double begun = begin_of(c, t + (double)s * h, i), length = length_of(c, i, h);
                advance(c, begun, length, c->disturbance + 3 * i * c->n_d, x, p);
                restore(begun + length, x, p);
            }
            if (--left > 0) continue;
            for (int i = 0; i < NX; i++) c->state[i] = x[i];
            c->sample = k + (s + 1) / c->substeps;
            c->step = (s + 1) % c->substeps;
            return k + 1;
        }
    }
}
