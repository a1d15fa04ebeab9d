/* Closed loops of several cases at once: the lanes of W are cases, and blocks of two vectors follow each other.

   The functions numbers, rates_of_two, law, signals and, if PROJECTED, change come before it, with the sizes

   NX, NU, ND, NM, NZ    states, inputs, disturbances, measurements, states of the law
   NC, NP                parameters of the plant, and with inputs and disturbances
   NW, NV, NL, NS        what `numbers` computes for rates and signals; what all cases share for law and signals
   NO, NR, NT            outputs of the law, residuals, all that is gathered

   and MEASURED, the measured states. What all cases share is a table for law and signals, a row for each sample. */
#include "unit.h"
#include "lanes.h"

#define V W
#define V_OF(number) ALL(number)
#define V_CALL(name) w_##name
#include "sampled.h"

static const int measured[] = MEASURED;

/* NaN in each lane in which one of the values is not finite. */
INLINE W lost(int64_t n, const W *values)
{
    W sum = ALL(0.0);
    for (int64_t i = 0; i < n; i++) sum += values[i] * 0.0;
    return sum;
}

INLINE void gather(int64_t n, const W *values, W *largest, W *squares)
{
    for (int64_t i = 0; i < n; i++) {
        const W size = w_fabs(values[i]);
        largest[i] = w_select(size > largest[i], size, largest[i]);
        squares[i] += values[i] * values[i];
    }
}

#ifdef PROJECTED
/* Newton's iteration of the projection onto the invariants, in the lanes that need it. */
static void project(W t, W *x, const W *p)
{
    W d[NX + 1];
    I moving = (I)ALL(0.0) == (I)ALL(0.0);
    for (int iteration = 0; iteration < 6 && w_any(moving); iteration++) {
        W largest = ALL(0.0);
        change(t, x, p, d);
        moving &= lost(NX, d) == 0;
        for (int i = 0; i < NX; i++) largest = w_fmax(largest, w_fabs(d[i]) / (1.0 + w_fabs(x[i])));
        for (int i = 0; i < NX; i++) x[i] += (W)(moving & (I)d[i]);
        moving &= largest > ROUNDING;
    }
}
#endif

/* The cases in the lanes of one vector. */
typedef struct {
    W constants[NP + 1], p[NW + NU + ND + 1], x[NX + NV + 1], y[NM + NZ + 1], out[NO + 1], u[NU + 1], r[NR + 1];
    W scale[ND + 1], largest[NT + 1], squares[NT + 1], state_lost, law_lost;
    double *commands, *inputs;
} Cases;

INLINE void begin(const Loop *c, int64_t at, double *scratch, Cases *s)
{
    W w[NW + NV + 1];
    for (int i = 0; i < NP; i++) s->constants[i] = i < NC ? w_load(c->constants + i * c->columns + at) : ALL(0.0);
    for (int i = 0; i < NX; i++) s->x[i] = w_load(c->x0 + i * c->columns + at);
    for (int i = 0; i < ND; i++) s->scale[i] = w_load(c->scale + i * c->columns + at);
    for (int i = 0; i < NZ; i++) s->y[NM + i] = ALL(c->z0[i]);
    for (int i = 0; i < NU; i++) s->u[i] = ALL(c->initial_input[i]);
    for (int i = 0; i < NT; i++) s->largest[i] = s->squares[i] = ALL(0.0);
    s->state_lost = s->law_lost = ALL(INFINITY);
    s->commands = scratch;
    s->inputs = scratch + c->depth * NU * W_LANES;
    numbers(ALL(0.0), s->constants, s->constants, w);
    for (int i = 0; i < NW; i++) s->p[i] = w[i];
    for (int i = 0; i < NV; i++) s->x[NX + i] = w[NW + i];
}

/* Sample k: measure, law, delay, limits; gathered quantities. */
INLINE void sample(const Loop *c, int64_t k, int64_t at, const double *noise, Cases *s)
{
    const double t = c->t0 + (double)k * c->period, *row = c->table + k * (NL + NS);
    const int64_t here = k % c->depth;
    W *x = s->x, *u = s->u, *y = s->y;
    for (int i = 0; i < NM; i++) {
        const W value = x[measured[i]];
        y[i] = quantised(c, i, noise ? value + w_load(noise + (k * NM + i) * 2 * W_LANES) : value);
    }
    law(ALL(t), y, row, s->out);
    const W bad_state = lost(NX, x), bad_law = lost(NU + NZ, s->out);
    if (w_any((bad_state + bad_law) != 0)) {
        s->state_lost = w_fmin(s->state_lost, w_select(bad_state != 0, ALL(t), ALL(INFINITY)));
        s->law_lost = w_fmin(s->law_lost, w_select(bad_law != 0, ALL(t), ALL(INFINITY)));
    }
    for (int i = 0; i < NU; i++) {
        W command = s->out[i];
        if (c->delay) {
            w_store(s->commands + (here * NU + i) * W_LANES, command);
            const int64_t sent = (k - c->delay + c->depth) % c->depth;
            command = k < c->delay ? ALL(c->initial_input[i]) : w_load(s->commands + (sent * NU + i) * W_LANES);
        }
        u[i] = limited(c, i, command, u[i]);
        if (c->transport) w_store(s->inputs + (here * NU + i) * W_LANES, u[i]);
    }
    signals(ALL(t), x, row + NL, s->r);
    gather(NX, x, s->largest, s->squares);
    gather(NU, u, s->largest + NX, s->squares + NX);
    gather(NR, s->r, s->largest + NX + NU, s->squares + NX + NU);
    if (c->n_traced && k % c->every == 0) for (int64_t i = 0; i < c->n_traced; i++) {
        const int64_t j = c->traced[i];
        const W value = j < NX ? x[j] : j < NX + NU ? u[j - NX] : s->r[j - NX - NU];
        w_store(c->trace + (k / c->every * c->n_traced + i) * c->columns + at, value);
    }
    for (int i = 0; i < NZ; i++) y[NM + i] = s->out[NU + i];
    for (int i = 0; i < NU; i++) s->p[NW + i] = u[i];
}

/* The inputs of one integration step, after the transport delay. */
INLINE void transported(const Loop *c, int64_t step, Cases *s)
{
    for (int i = 0; i < NU; i++) {
        const int64_t sent = step - c->transport[i], place = sent / c->substeps % c->depth;
        s->p[NW + i] = sent < 0 ? ALL(c->initial_input[i]) : w_load(s->inputs + (place * NU + i) * W_LANES);
    }
}

/* x' of both vectors at one stage of a step, with its disturbances d. */
INLINE void rates_at(double t, const double *d, Cases *s, const W *x, const W *x2, W k[2][NX + 1])
{
    for (int i = 0; i < ND; i++) for (int g = 0; g < 2; g++) s[g].p[NW + NU + i] = d[i] * s[g].scale[i];
    rates_of_two(ALL(t), x, s[0].p, k[0], x2, s[1].p, k[1]);
}

#define EACH for (int i = 0; i < NX; i++) for (int g = 0; g < 2; g++)
#define AT(v) v[g][i]
#define RATES(stage, instant, state, k) rates_at(instant, d + stage * ND, s, state[0], state[1], k)

/* One step of two vectors of cases; d holds the disturbances at its start, middle and end. */
INLINE void advance(double t, double h, const double *d, Cases *s)
{
    W k1[2][NX + 1], k2[2][NX + 1], k3[2][NX + 1], k4[2][NX + 1], z[2][NX + 1], *const x[2] = {s[0].x, s[1].x};
#include "rk4.h"
}

INLINE void end(const Loop *c, int64_t at, const Cases *s)
{
    double *rows = c->gathered + at;
    w_store(rows, s->state_lost);
    w_store(rows + c->columns, s->law_lost);
    for (int i = 0; i < NT; i++) {
        const W last = i < NX ? s->x[i] : i < NX + NU ? s->u[i - NX] : s->r[i - NX - NU];
        w_store(rows + (2 + i) * c->columns, s->largest[i]);
        w_store(rows + (2 + NT + i) * c->columns, s->squares[i]);
        w_store(rows + (2 + 2 * NT + i) * c->columns, last);
    }
}

/* The loops of one block, two vectors of cases, unless they are stopped: then nothing is gathered. The last commands and inputs, as many as the delays need, are in
   scratch. */
static void block(const Loop *c, int64_t at, const double *noise, double *scratch)
{
    Cases s[2];
    const double h = c->period / (double)c->substeps;
    for (int g = 0; g < 2; g++) begin(c, at + g * W_LANES, scratch + g * 2 * c->depth * NU * W_LANES, s + g);
    for (int64_t k = 0; ; k++) {
        for (int g = 0; g < 2; g++) sample(c, k, at + g * W_LANES, noise ? noise + g * W_LANES : 0, s + g);
        if (k == c->samples) break;
        for (int64_t i = 0; i < c->substeps; i++) {
            if (*(const volatile int64_t *)&c->stop) return;
            const double t = c->t0 + (double)k * c->period + (double)i * h;
            const int64_t step = k * c->substeps + i;
            if (c->transport) for (int g = 0; g < 2; g++) transported(c, step, s + g);
            advance(t, h, c->disturbance + 3 * step * ND, s);
#ifdef PROJECTED
            for (int g = 0; g < 2; g++) project(ALL(t + h), s[g].x, s[g].constants);
#endif
        }
    }
    for (int g = 0; g < 2; g++) end(c, at + g * W_LANES, s + g);
}

void batch(const Loop *c, int64_t first, int64_t last, const double *noise, double *scratch)
{
    const int64_t width = 2 * W_LANES;
    for (int64_t b = first; b < last && !*(const volatile int64_t *)&c->stop; b++) {
        block(c, b * width, noise ? noise + (b - first) * (c->samples + 1) * NM * width : 0, scratch);
    }
}
