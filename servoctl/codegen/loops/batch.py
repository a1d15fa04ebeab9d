"""Closed loops of several cases at once, as C text: the lanes of V are cases, blocks of them follow each other.

The functions `numbers`, `rates`, `law`, `told` and, where there are invariants, `change` come before it, with the sizes
in capitals. What all cases have in common is a table of numbers, a row for each sample, taken by `law` and `told`.
"""

BATCH = """
typedef struct {
    int64_t samples, substeps, delay, depth, every, n_traced, columns;
    double t0, period;
    const double *constants, *x0, *scale, *z0, *table, *quantum, *low, *high, *change, *idle, *disturbance;
    const int64_t *transport, *traced;
    double *found, *trace;
} Batch;

INLINE V load(const double *from) { return *(const U *)from; }
INLINE void store(double *to, V value) { *(U *)to = value; }
INLINE V within(V value, V low, V high) { return v_fmin(v_fmax(value, low), high); }
INLINE V rounded(V value)
{
    for (int l = 0; l < W_LANES; l++) value[l] = rint(value[l]);
    return value;
}

/* NaN in each lane in which one of the values is not finite. */
INLINE V lost(int64_t n, const V *values)
{
    V sum = K(0.0);
    for (int64_t i = 0; i < n; i++) sum += values[i] * 0.0;
    return sum;
}

INLINE void gather(int64_t n, const V *values, V *largest, V *squares)
{
    for (int64_t i = 0; i < n; i++) {
        const V size = v_fabs(values[i]);
        largest[i] = w_select(size > largest[i], size, largest[i]);
        squares[i] += values[i] * values[i];
    }
}

#if INVARIANTS
/* Newton's iteration of the projection onto the invariants, in the lanes that need it. */
static void restore(V t, V *x, const V *p)
{
    V d[NX + 1];
    I moving = (I)K(0.0) == (I)K(0.0);
    for (int iteration = 0; iteration < 6 && w_any(moving); iteration++) {
        V largest = K(0.0);
        change(t, x, p, d);
        moving &= lost(NX, d) == 0;
        for (int i = 0; i < NX; i++) largest = v_fmax(largest, v_fabs(d[i]) / (1.0 + v_fabs(x[i])));
        for (int i = 0; i < NX; i++) x[i] += (V)(moving & (I)d[i]);
        moving &= largest > SMALL;
    }
}
#endif

/* The cases in the lanes of one vector. */
typedef struct {
    V constants[NP + 1], p[NW + NU + ND + 1], x[NX + NV + 1], y[NY + NZ + 1], out[NO + 1], u[NU + 1], r[NR + 1];
    V scale[ND + 1], largest[NT + 1], squares[NT + 1], state_lost, law_lost;
    double *commands, *inputs;
} Cases;

INLINE void begin(const Batch *c, int64_t at, double *scratch, Cases *s)
{
    V w[NW + NV + 1];
    for (int i = 0; i < NP; i++) s->constants[i] = i < NC ? load(c->constants + i * c->columns + at) : K(0.0);
    for (int i = 0; i < NX; i++) s->x[i] = load(c->x0 + i * c->columns + at);
    for (int i = 0; i < ND; i++) s->scale[i] = load(c->scale + i * c->columns + at);
    for (int i = 0; i < NZ; i++) s->y[NY + i] = K(c->z0[i]);
    for (int i = 0; i < NU; i++) s->u[i] = K(c->idle[i]);
    for (int i = 0; i < NT; i++) s->largest[i] = s->squares[i] = K(0.0);
    s->state_lost = s->law_lost = K(INFINITY);
    s->commands = scratch;
    s->inputs = scratch + c->depth * NU * W_LANES;
    numbers(K(0.0), s->constants, s->constants, w);
    for (int i = 0; i < NW; i++) s->p[i] = w[i];
    for (int i = 0; i < NV; i++) s->x[NX + i] = w[NW + i];
}

/* Sample k: measure, law, delay, limits; what is gathered there. */
INLINE void sample(const Batch *c, int64_t k, int64_t at, const double *noise, Cases *s)
{
    const double t = c->t0 + (double)k * c->period, *row = c->table + k * (NL + NS);
    const int64_t here = k % c->depth;
    V *x = s->x, *u = s->u, *y = s->y;
    for (int i = 0; i < NY; i++) y[i] = x[measured[i]];
    if (noise) for (int i = 0; i < NY; i++) y[i] += load(noise + (k * NY + i) * 2 * W_LANES);
    if (c->quantum) for (int i = 0; i < NY; i++) {
        const double q = c->quantum[i];
        if (q > 0) y[i] = q * rounded(y[i] / q);
    }
    law(K(t), y, row, s->out);
    const V bad_state = lost(NX, x), bad_law = lost(NU + NZ, s->out);
    if (w_any((bad_state + bad_law) != 0)) {
        s->state_lost = v_fmin(s->state_lost, w_select(bad_state != 0, K(t), K(INFINITY)));
        s->law_lost = v_fmin(s->law_lost, w_select(bad_law != 0, K(t), K(INFINITY)));
    }
    for (int i = 0; i < NU; i++) {
        V value = s->out[i];
        if (c->delay) {
            store(s->commands + (here * NU + i) * W_LANES, value);
            const int64_t sent = (k - c->delay + c->depth) % c->depth;
            value = k < c->delay ? K(c->idle[i]) : load(s->commands + (sent * NU + i) * W_LANES);
        }
        if (c->low) value = within(value, K(c->low[i]), K(c->high[i]));
        if (c->change) value = within(value, u[i] - c->change[i], u[i] + c->change[i]);
        u[i] = value;
        if (c->transport) store(s->inputs + (here * NU + i) * W_LANES, value);
    }
    told(K(t), x, row + NL, s->r);
    gather(NX, x, s->largest, s->squares);
    gather(NU, u, s->largest + NX, s->squares + NX);
    gather(NR, s->r, s->largest + NX + NU, s->squares + NX + NU);
    if (c->n_traced && k % c->every == 0) for (int64_t i = 0; i < c->n_traced; i++) {
        const int64_t j = c->traced[i];
        const V value = j < NX ? x[j] : j < NX + NU ? u[j - NX] : s->r[j - NX - NU];
        store(c->trace + (k / c->every * c->n_traced + i) * c->columns + at, value);
    }
    for (int i = 0; i < NZ; i++) y[NY + i] = s->out[NU + i];
    for (int i = 0; i < NU; i++) s->p[NW + i] = u[i];
}

/* What arrives in one integration step after transport. */
INLINE void transported(const Batch *c, int64_t step, Cases *s)
{
    for (int i = 0; i < NU; i++) {
        const int64_t sent = step - c->transport[i], place = sent / c->substeps % c->depth;
        s->p[NW + i] = sent < 0 ? K(c->idle[i]) : load(s->inputs + (place * NU + i) * W_LANES);
    }
}

/* x' of both vectors at one stage of a step, with its disturbances d. */
INLINE void stage(double t, const double *d, const V *x, const V *x2, Cases *s, V k[2][NX + 1])
{
    for (int i = 0; i < ND; i++) for (int g = 0; g < 2; g++) s[g].p[NW + NU + i] = d[i] * s[g].scale[i];
    rates_of_two(K(t), x, s[0].p, k[0], x2, s[1].p, k[1]);
}

INLINE void onward(const Cases *s, double h, V k[2][NX + 1], V z[2][NX + 1])
{
    for (int i = 0; i < NX; i++) for (int g = 0; g < 2; g++) z[g][i] = s[g].x[i] + h * k[g][i];
}

/* One Runge-Kutta step of order 4; d holds the disturbances at its start, middle and end. */
INLINE void advance(double t, double h, const double *d, Cases *s)
{
    V k1[2][NX + 1], k2[2][NX + 1], k3[2][NX + 1], k4[2][NX + 1], z[2][NX + 1];
    const double half = h / 2, sixth = h / 6;
    stage(t, d, s[0].x, s[1].x, s, k1);
    onward(s, half, k1, z);
    stage(t + half, d + ND, z[0], z[1], s, k2);
    onward(s, half, k2, z);
    stage(t + half, d + ND, z[0], z[1], s, k3);
    onward(s, h, k3, z);
    stage(t + h, d + 2 * ND, z[0], z[1], s, k4);
    for (int i = 0; i < NX; i++) for (int g = 0; g < 2; g++) {
        s[g].x[i] += sixth * (k1[g][i] + 2.0 * (k2[g][i] + k3[g][i]) + k4[g][i]);
    }
}

INLINE void end(const Batch *c, int64_t at, const Cases *s)
{
    double *found = c->found + at;
    store(found, s->state_lost);
    store(found + c->columns, s->law_lost);
    for (int i = 0; i < NT; i++) {
        store(found + (2 + i) * c->columns, s->largest[i]);
        store(found + (2 + NT + i) * c->columns, s->squares[i]);
        store(found + (2 + 2 * NT + i) * c->columns, i < NX ? s->x[i] : i < NX + NU ? s->u[i - NX] : s->r[i - NX - NU]);
    }
}

/* The loops of one block, two vectors of cases; the last commands and inputs, as many as the delays need, are in
   scratch. */
static void block(const Batch *c, int64_t at, const double *noise, double *scratch)
{
    Cases s[2];
    const double h = c->period / (double)c->substeps;
    for (int g = 0; g < 2; g++) begin(c, at + g * W_LANES, scratch + g * 2 * c->depth * NU * W_LANES, s + g);
    for (int64_t k = 0; ; k++) {
        for (int g = 0; g < 2; g++) sample(c, k, at + g * W_LANES, noise ? noise + g * W_LANES : 0, s + g);
        if (k == c->samples) break;
        for (int64_t i = 0; i < c->substeps; i++) {
            const double t = c->t0 + (double)k * c->period + (double)i * h;
            const int64_t step = k * c->substeps + i;
            if (c->transport) for (int g = 0; g < 2; g++) transported(c, step, s + g);
            advance(t, h, c->disturbance + 3 * step * ND, s);
#if INVARIANTS
            for (int g = 0; g < 2; g++) restore(K(t + h), s[g].x, s[g].constants);
#endif
        }
    }
    for (int g = 0; g < 2; g++) end(c, at + g * W_LANES, s + g);
}

void batch(const Batch *c, int64_t first, int64_t last, const double *noise, double *scratch)
{
    const int64_t width = 2 * W_LANES;
    for (int64_t b = first; b < last; b++) {
        block(c, b * width, noise ? noise + (b - first) * (c->samples + 1) * NY * width : 0, scratch);
    }
}
"""
