/* The rule of a sampled loop that one loop and the lanes of many have in common. Before it, V is the type of numbers,
   V_OF(number) a V of one number, and V_CALL(name) a function of V. */

typedef void Step(double t, const double *x, const double *row, double *y); /* of a law */

/* Mirrored by servoctl/control/loop.py; arrays that are not used are null. */
typedef struct {
    int64_t samples, substeps, delay, n_y, n_z, n_u, n_out, n_row, rows, first, n_d, at_u; /* of any loop */
    int64_t depth, every, n_traced, columns, stop;                                         /* of many */
    int64_t status, sample, step, steps; /* of one: how it ended, where it goes on, integration steps until it pauses */
    int64_t stride;                      /* numbers from a row of law_x to the next; 0 where it follows from x */
    double t0, period;
    const double *p, *x0, *z0, *table, *noise, *quantum, *low, *high, *change, *initial_input, *disturbance;
    const double *spans; /* of parts of integration steps [s]: begin after that of the step, and length */
    const double *constants, *scale, *deviations;
    const int64_t *measured, *transport, *disturbed, *traced, *parts;
    const uint64_t *keys;
    double *state, *x, *law_x, *law_y, *input; /* the state and logs of one loop */
    double *gathered, *trace;          /* and of many */
    Step *law;                         /* which is called, where the law is not written into the loop */
} Loop;

/* Edges of disturbances cut integration steps into parts: the first of a step; begin [s] of one of a step, and length. */
INLINE int64_t first_part(const Loop *c, int64_t step) { return c->parts ? c->parts[step] : step; }
INLINE double begin_of(const Loop *c, double step, int64_t part) { return c->parts ? step + c->spans[2 * part] : step; }
INLINE double length_of(const Loop *c, int64_t part, double h) { return c->parts ? c->spans[2 * part + 1] : h; }

INLINE V quantised(const Loop *c, int64_t i, V value)
{
    if (c->quantum && c->quantum[i] > 0) value = c->quantum[i] * V_CALL(rint)(value / c->quantum[i]);
    return value;
}

/* The input of one sample: the command, cut to its limits and its rate limits. */
INLINE V limited(const Loop *c, int64_t i, V value, V before)
{
    if (c->low) value = V_CALL(fmin)(V_CALL(fmax)(value, V_OF(c->low[i])), V_OF(c->high[i]));
    if (c->change) value = V_CALL(fmin)(V_CALL(fmax)(value, before - c->change[i]), before + c->change[i]);
    return value;
}
