/* Closed loops of several cases at once: the lanes of W are cases, and blocks of vectors follow each other.

   The functions numbers, rates_of_block, law unless CALLED, signals and, if PROJECTED, change come before it, with the sizes

   VECTORS, LOOKED       vectors of a block; samples between two looks whether all is finite
   NX, NU, ND, NM, NZ    states, inputs, disturbances, measurements, states of the law
   NC, NP                parameters of the plant, and with inputs and disturbances
   NW, NV, NL, NS        what `numbers` computes for rates and signals; what all cases share for law and signals
   NO, NR, NT            outputs of the law, residuals, all that is gathered

   and MEASURED, the measured states. What all cases share is a table for law and signals, a row for each sample. */
#include "unit.h"
#include "normal.h"

#define EACH_VECTOR(g) _Pragma("GCC unroll 8") for (int g = 0; g < VECTORS; g++)
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

#ifdef CALLED
/* The law of each case by itself. */
static __attribute__((noinline)) void called(const Loop *c, double t, const W *x, const double *row, W *y)
{
    EACH_LANE {
        double own[NM + NZ + 1], out[NO + 1];
        for (int j = 0; j < NM + NZ; j++) own[j] = x[j][i];
        c->law(t, own, row, out);
        for (int j = 0; j < NU + NZ; j++) y[j][i] = out[j];
    }
}
#define LAW(t, x, row, y) called(c, t, x, row, y)
#else
#define LAW(t, x, row, y) law(ALL(t), x, row, y)
#endif

/* The cases in the lanes of one vector; `lost` is NaN in each lane in which the law's output was once not finite. */
typedef struct {
    W constants[NP + 1], p[NW + NU + ND + 1], y[NM + NZ + 1], out[NO + 1], u[NU + 1], r[NR + 1];
    W noise[NM + 1][4], scale[ND + 1], largest[NT + 1], squares[NT + 1], lost, state_lost, law_lost;
    double *commands, *inputs;
} Cases;

INLINE void begin(const Loop *c, int64_t at, double *scratch, Cases *s, W *x)
{
    W w[NW + NV + 1];
    for (int i = 0; i < NP; i++) s->constants[i] = i < NC ? w_load(c->constants + i * c->columns + at) : ALL(0.0);
    for (int i = 0; i < NX; i++) x[i] = w_load(c->x0 + i * c->columns + at);
    for (int i = 0; i < ND; i++) s->scale[i] = w_load(c->scale + i * c->columns + at);
    for (int i = 0; i < NZ; i++) s->y[NM + i] = ALL(c->z0[i]);
    for (int i = 0; i < NU; i++) s->u[i] = ALL(c->initial_input[i]);
    for (int i = 0; i < NT; i++) s->largest[i] = s->squares[i] = ALL(0.0);
    s->lost = ALL(0.0);
    s->state_lost = s->law_lost = ALL(INFINITY);
    s->commands = scratch;
    s->inputs = scratch + c->depth * NU * W_LANES;
    numbers(ALL(0.0), s->constants, s->constants, w);
    for (int i = 0; i < NW; i++) s->p[i] = w[i];
    for (int i = 0; i < NV; i++) x[NX + i] = w[NW + i];
}

/* When the state, and the output of the law, were first not finite. */
static __attribute__((noinline, cold)) void date(double t, W bad_state, W bad_law, Cases *s)
{
    s->state_lost = w_fmin(s->state_lost, w_select(bad_state != 0, ALL(t), ALL(INFINITY)));
    s->law_lost = w_fmin(s->law_lost, w_select(bad_law != 0, ALL(t), ALL(INFINITY)));
}

/* Noise of four samples, from k on. */
static __attribute__((noinline)) void draw(const Loop *c, int64_t k, int64_t at, W (*noise)[4])
{
    for (int i = 0; i < NM; i++) if (c->deviations[i] > 0) {
        w_normal(c->keys + 2 * at, 2, (uint64_t)(k / 4 + 1), 0, (uint64_t)i, noise[i]);
    }
}

/* Sample k: measure, law, delay, limits; gathered quantities. */
INLINE void sample(const Loop *c, int64_t k, int64_t at, int dated, Cases *s, const W *x)
{
    const double t = c->t0 + (double)k * c->period, *row = c->table + k * (NL + NS);
    const int64_t here = k % c->depth;
    W *u = s->u, *y = s->y;
    if (c->deviations && k % 4 == 0) draw(c, k, at, s->noise);
    for (int i = 0; i < NM; i++) {
        W value = x[measured[i]];
        if (c->deviations && c->deviations[i] > 0) value += c->deviations[i] * s->noise[i][k % 4];
        y[i] = quantised(c, i, value);
    }
    LAW(t, y, row, s->out);
    const W bad_law = lost(NU + NZ, s->out);
    s->lost += bad_law;
    if (dated) date(t, lost(NX, x), bad_law, s);
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

/* x' of a block at one stage of a step, with its disturbances d. */
INLINE void rates_at(double t, const double *d, Cases *s, W x[][NX + NV + 1], W k[][NX + 1])
{
    const W *at[VECTORS], *p[VECTORS];
    for (int i = 0; i < ND; i++) EACH_VECTOR(g) s[g].p[NW + NU + i] = d[i] * s[g].scale[i];
    EACH_VECTOR(g) at[g] = x[g];
    EACH_VECTOR(g) p[g] = s[g].p;
    rates_of_block(ALL(t), at, p, k);
}

#define EACH for (int i = 0; i < NX; i++) EACH_VECTOR(g)
#define AT(v) v[g][i]
#define RATES(stage, instant, state, k) rates_at(instant, d + stage * ND, s, state, k)

INLINE double begin_of_step(const Loop *c, int64_t k, int64_t i)
{
    return c->t0 + (double)k * c->period + (double)i * (c->period / (double)c->substeps);
}

/* A part of step i of sample k begins: its inputs, and the rates k1. After a sample it shares with it what depends on x alone. */
INLINE void start(const Loop *c, int64_t k, int64_t i, int64_t part, Cases *s, W x[][NX + NV + 1], W k1[][NX + 1])
{
    const double *d = c->disturbance + 3 * part * ND;
    if (c->transport) EACH_VECTOR(g) transported(c, k * c->substeps + i, s + g);
    RATES(0, begin_of(c, begin_of_step(c, k, i), part), x, k1);
}

/* It, of a block, with the rates k1 at its start. */
INLINE void advance(const Loop *c, int64_t k, int64_t i, int64_t part, Cases *s, W x[][NX + NV + 1], W k1[][NX + 1])
{
    W k2[VECTORS][NX + 1], k3[VECTORS][NX + 1], k4[VECTORS][NX + 1], z[VECTORS][NX + NV + 1];
    const double h = length_of(c, part, c->period / (double)c->substeps), t = begin_of(c, begin_of_step(c, k, i), part);
    const double *d = c->disturbance + 3 * part * ND;
#include "rk4.h"
#ifdef PROJECTED
    EACH_VECTOR(g) project(ALL(t + h), x[g], s[g].constants);
#endif
}

INLINE void end(const Loop *c, int64_t at, const Cases *s, const W *x)
{
    double *rows = c->gathered + at;
    w_store(rows, s->state_lost);
    w_store(rows + c->columns, s->law_lost);
    for (int i = 0; i < NT; i++) {
        const W last = i < NX ? x[i] : i < NX + NU ? s->u[i - NX] : s->r[i - NX - NU];
        w_store(rows + (2 + i) * c->columns, s->largest[i]);
        w_store(rows + (2 + NT + i) * c->columns, s->squares[i]);
        w_store(rows + (2 + 2 * NT + i) * c->columns, last);
    }
}

/* The loops of one block; nothing is gathered if they are stopped. The last commands and inputs, as many as the delays
   need, are in scratch. A state that is not finite stays so, and the law's outputs are summed: unless they are dated at
   each sample, it is enough to look now and then. Returns whether some were found, which are then to be dated. */
static int block(const Loop *c, int64_t at, double *scratch, int dated)
{
    Cases s[VECTORS];
    W x[VECTORS][NX + NV + 1], k1[VECTORS][NX + 1];
    EACH_VECTOR(g) begin(c, at + g * W_LANES, scratch + g * 2 * c->depth * NU * W_LANES, s + g, x[g]);
    for (int64_t k = 0; ; k++) {
        EACH_VECTOR(g) sample(c, k, at + g * W_LANES, dated, s + g, x[g]);
        if (!dated && (k % LOOKED == 0 || k == c->samples)) {
            EACH_VECTOR(g) if (w_any((s[g].lost + lost(NX, x[g])) != 0)) return 1;
        }
        if (k == c->samples) break;
        int64_t part = first_part(c, k * c->substeps);
        start(c, k, 0, part, s, x, k1);
        for (int64_t i = 0; ; ) {
            if (*(const volatile int64_t *)&c->stop) return 0;
            advance(c, k, i, part, s, x, k1);
            i += ++part == first_part(c, k * c->substeps + i + 1);
            if (i == c->substeps) break;
            start(c, k, i, part, s, x, k1);
        }
    }
    EACH_VECTOR(g) end(c, at + g * W_LANES, s + g, x[g]);
    return 0;
}

void batch(const Loop *c, int64_t first, int64_t last, double *scratch)
{
    const int64_t width = VECTORS * W_LANES;
    for (int64_t b = first; b < last && !*(const volatile int64_t *)&c->stop; b++) {
        if (block(c, b * width, scratch, 0)) block(c, b * width, scratch, 1);
    }
}
