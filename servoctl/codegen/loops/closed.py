"""The sampled closed loop in C, which calls the law through a pointer."""

# The law's function under a name of its own: its address goes into the plant's loop.
LAW_DRIVER = """
void NAME_step(double t, const double *x, const double *p, double *y) { NAME(t, x, p, y); }
"""

DRIVER = """
typedef void NAME_law(double t, const double *x, const double *p, double *y);

typedef struct {
    int64_t samples, substeps, delay, n_y, n_z, n_u, n_out, n_row, rows, first, n_d, at_u;
    double t0, period;
    const double *p, *x0, *z0, *table, *noise, *quantum, *low, *high, *change, *idle, *disturbance;
    const int64_t *measured, *transport, *disturbed;
    double *x, *law_x, *law_y, *input;
    int64_t status;
} NAME_loop;

/* y = C x + noise, quantised. */
static void NAME_measure(const NAME_loop *c, int64_t k, const double *x, double *y)
{
    for (int64_t i = 0; i < c->n_y; i++) {
        double value = x[c->measured[i]];
        if (c->noise) value += c->noise[k * c->n_y + i];
        if (c->quantum && c->quantum[i] > 0) value = c->quantum[i] * rint(value / c->quantum[i]);
        y[i] = value;
    }
}

/* The input of one sample: the command, kept within its limits and its limits of rate. */
static void NAME_limit(const NAME_loop *c, const double *command, const double *before, double *u)
{
    for (int64_t i = 0; i < c->n_u; i++) {
        double value = command[i];
        if (c->low) value = fmin(fmax(value, c->low[i]), c->high[i]);
        if (c->change) value = fmin(fmax(value, before[i] - c->change[i]), before[i] + c->change[i]);
        u[i] = value;
    }
}

#define ALL_STATES _Pragma("GCC unroll 32") for (int i = 0; i < NAME_nx; i++)

/* One Runge-Kutta step of order 4, with the rates written into it; d holds the disturbances at its start, middle and
   end. Vectors of states would be filled and emptied one by one, in each stage: they take longer than numbers. */
__attribute__((flatten, optimize("no-tree-vectorize")))
static void NAME_rk4(const NAME_loop *c, double t, double h, const double *d, double *x, double *p)
{
    double k1[NAME_nx + 1], k2[NAME_nx + 1], k3[NAME_nx + 1], k4[NAME_nx + 1], z[NAME_nx + 1];
    double *pd = p + c->at_u + c->n_u;
    const double half = h / 2, sixth = h / 6;
    for (int64_t i = 0; i < c->n_d; i++) pd[c->disturbed[i]] = d[i];
    NAME(t, x, p, k1);
    ALL_STATES z[i] = x[i] + half * k1[i];
    for (int64_t i = 0; i < c->n_d; i++) pd[c->disturbed[i]] = d[c->n_d + i];
    NAME(t + half, z, p, k2);
    ALL_STATES z[i] = x[i] + half * k2[i];
    NAME(t + half, z, p, k3);
    ALL_STATES z[i] = x[i] + h * k3[i];
    for (int64_t i = 0; i < c->n_d; i++) pd[c->disturbed[i]] = d[2 * c->n_d + i];
    NAME(t + h, z, p, k4);
    ALL_STATES x[i] += sixth * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
}

/* The loop; sample k at t0 + k period: measure, call the law, delay, limit, hold. Returns the samples completed. */
__attribute__((optimize("no-tree-vectorize")))
int64_t NAME_closed(NAME_law *law, NAME_loop *c)
{
    double x[NAME_nx + 1], p[NAME_np + 1];
    const double h = c->period / (double)c->substeps;
    for (int i = 0; i < NAME_nx; i++) x[i] = c->x0[i];
    for (int i = 0; i < NAME_np; i++) p[i] = c->p[i];
    for (int64_t i = 0; i < c->n_z; i++) c->law_x[c->n_y + i] = c->z0[i];
    for (int64_t k = 0; ; k++) {
        const double t = c->t0 + (double)k * c->period;
        const int64_t row = c->first + k < c->rows ? c->first + k : c->rows - 1;
        double *y = c->law_x + k * (c->n_y + c->n_z), *out = c->law_y + k * c->n_out, *u = c->input + k * c->n_u;
        for (int i = 0; i < NAME_nx; i++) if (!isfinite(x[i])) { c->status = 1; return k; }
        for (int i = 0; i < NAME_nx; i++) c->x[k * NAME_nx + i] = x[i];
        NAME_measure(c, k, x, y);
        law(t, y, c->table + row * c->n_row, out);
        for (int64_t i = 0; i < c->n_u + c->n_z; i++) if (!isfinite(out[i])) { c->status = 2; return k; }
        NAME_limit(c, k < c->delay ? c->idle : out - c->delay * c->n_out, k ? u - c->n_u : c->idle, u);
        if (k == c->samples) return k + 1;
        for (int64_t i = 0; i < c->n_z; i++) y[c->n_y + c->n_z + c->n_y + i] = out[c->n_u + i];
        for (int64_t i = 0; i < c->n_u; i++) p[c->at_u + i] = u[i];
        for (int64_t s = 0; s < c->substeps; s++) {
            const int64_t step = k * c->substeps + s;
            for (int64_t i = 0; c->transport && i < c->n_u; i++) {
                const int64_t sent = step - c->transport[i];
                p[c->at_u + i] = sent < 0 ? c->idle[i] : c->input[sent / c->substeps * c->n_u + i];
            }
            NAME_rk4(c, t + (double)s * h, h, c->disturbance + 3 * step * c->n_d, x, p);
            NAME_PROJECT(t + (double)(s + 1) * h, x, p);
        }
    }
}
"""
