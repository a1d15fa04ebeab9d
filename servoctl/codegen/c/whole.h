/* A whole motion by the Taylor method in one call: its steps, its samples, and what shows whether nothing along it needs a
   decision. Units with the functions `rates`, X' and more, and `invariants`, values and their Jacobian column by column,
   have it; INVARIANTS is the number of the values. */
#ifndef WHOLE_H
#define WHOLE_H
#ifdef INVARIANTS

#define N_C ((PLAIN ? 0 : NQ * LAST) + N * LAST) /* coefficients among the outputs, before the pivots */
#define N_PIVOTS (NY - N_C)
#define OUTPUTS_OF_INVARIANTS (INVARIANTS * (1 + NX))

/* Samples at `count` times in the order of the motion, whose steps are written to k and jets q, gamma', ..., gamma^(s) to
   `jets`. Series are compared with the equations at parts `inside` of each step, and at instants no farther apart than
   `distance`: at the samples, if rows determine their rates and they are as dense; not at knots, where equations have other
   branches: the ends of `Steps` but the last one, and this if `to_knot`. */
typedef struct {
    int64_t count, parts, to_knot;
    double distance;
    const double *times, *inside;
    int64_t *k;
    double *jets, *facts;
} Whole;

/* The largest invariant at a state, relative to its gradient times the state; y are their values and Jacobian. */
static double scaled(const double *y, const double *x)
{
    double largest = 0;
    for (int64_t i = 0; i < INVARIANTS; i++) {
        double square = 0;
        for (int64_t j = 0; j < NX; j++) {
            const double slope = y[INVARIANTS * (1 + j) + i] * (1 + fabs(x[j]));
            square += slope * slope;
        }
        widen(&largest, fabs(y[i]) / (square > 0 ? sqrt(square) : 1));
    }
    return largest;
}

static inline double last_end(const Steps *s) { return s->ends[(int64_t)s->count - 1]; }

/* Whether rows determine the rates of samples of the whole span that are no farther apart than the distance. */
static int dense(const Steps *s, const Whole *w)
{
#ifdef SETTLED
    if (!w->count || w->times[0] != s->start[0] || w->times[w->count - 1] != last_end(s)) return 0;
    for (int64_t at = 1; at < w->count; at++) {
        if (!(fabs(w->times[at] - w->times[at - 1]) <= w->distance)) return 0;
    }
    return 1;
#else
    (void)s, (void)w;
    return 0;
#endif
}

/* Enlarge `farthest` by the instants of a step from a row of the log to an end, which may be a knot. */
static void compare(const double *row, double end, int knot, int by_samples, const Whole *w, const double *p,
                    double *farthest)
{
    const double h = end - row[0];
    const double *x = row + 1, *of_q = x + NX, *c = of_q + (PLAIN ? 0 : NQ * LAST);
    const double equal = by_samples ? 0 : fmax(ceil(fabs(h) / w->distance), 1);
    const int64_t all = w->parts + (int64_t)equal - (knot && !by_samples);
    for (int64_t first = 0; first < all; first += W_LANES) {
        W s = ALL(0.0), jets[NQ + TOP * N];
        const int64_t count = all - first < W_LANES ? all - first : W_LANES;
        for (int64_t b = 0; b < count; b++) {
            const int64_t m = first + b, j = m - w->parts + 1;
            s[b] = m < w->parts ? w->inside[m] * h : j == (int64_t)equal ? end - row[0] : h * ((double)j / equal);
        }
        for (int64_t i = 0; i < NQ + TOP * N; i++) jets[i] = ALL(0.0);
        for (int64_t m = LAST; m >= 1; m--) {
            for (int64_t i = 0; i < NQ; i++) jets[i] = jets[i] * s + of_q[(m - 1) * NQ + i];
            for (int64_t j = 1; j <= TOP && j <= m; j++) {
                W *level = jets + NQ + (j - 1) * N;
                for (int64_t i = 0; i < N; i++) level[i] = level[i] * s + falling(m, j) * c[(m - 1) * N + i];
            }
        }
        for (int64_t i = 0; i < NQ; i++) jets[i] = x[i] + jets[i] * s;
        for (int64_t b = 0; b < count; b++) {
            double at[NX + 1], rates[RATES];
            for (int64_t i = 0; i < NX; i++) at[i] = jets[i][b];
            FN(rates)(row[0] + s[b], at, p, rates);
            for (int64_t i = 0; i < N; i++) widen(farthest + i, fabs(rates[NX - N + i] - jets[NX + i][b]));
        }
    }
}

/* Returns the number of steps to the last one of the ends; -1 where they do not reach it, or samples are not finite.
   `facts` are, in this order:
     N           how far gamma^(s) of the series is at most from that of the equations
     1           the longest step
     NX          how far each of q has moved from the start at most at the ends of steps, and the largest size of each rate
     N_PIVOTS    the least size of each pivot, 0 where its sign changes
     N_PIVOTS    its largest size
     1           the largest invariant at the end, relative to its gradient times the state */
int64_t FN(whole)(const Steps *s, const Whole *w)
{
    double p[NP], values[OUTPUTS_OF_INVARIANTS + 1];
    const int64_t steps = FN(taylor)(s), columns = 1 + NX + NY;
    double *end = s->log + steps * columns, *farthest = w->facts, *longest = farthest + N, *states = longest + 1;
    double *least = states + NX, *most = least + N_PIVOTS, *drifted = most + N_PIVOTS;
    const double *knot = s->ends;
    const int by_samples = dense(s, w);
    if (end[0] != last_end(s)) return -1;
    on_branch(s->start + 1 + NX, (end[-columns] + end[0]) / 2, p);
    NAME(end[0], end + 1, p, end + 1 + NX);
    for (double *fact = farthest; fact <= drifted; fact++) *fact = 0;
    for (int64_t i = 0; i < N_PIVOTS; i++) least[i] = INFINITY;
    for (int64_t step = 0; step <= steps; step++) {
        const double *row = s->log + step * columns, *pivots = row + 1 + NX + N_C, *first = s->log + 1 + NX + N_C;
        for (int64_t i = 0; i < NX; i++) widen(states + i, fabs(row[1 + i] - (i < NQ ? s->log[1 + i] : 0)));
        for (int64_t i = 0; i < N_PIVOTS; i++) {
            const double size = pivots[i] * first[i] > 0 ? fabs(pivots[i]) : 0;
            least[i] = size < least[i] ? size : least[i];
            widen(most + i, fabs(pivots[i]));
        }
        if (step == steps) break;
        widen(longest, fabs(row[columns] - row[0]));
        const int at_knot = row[columns] == *knot && (step + 1 < steps || w->to_knot);
        compare(row, row[columns], at_knot, by_samples, w, p, farthest);
        knot += row[columns] == *knot;
    }
    FN(invariants)(end[0], end + 1, p, values);
    *drifted = scaled(values, end + 1);
    const double forward = last_end(s) > s->start[0] ? 1 : -1;
    for (int64_t at = 0, step = 0; at < w->count; at++) {
        while (step < steps - 1 && forward * s->log[(step + 1) * columns] <= forward * w->times[at]) step++;
        w->k[at] = step;
    }
    FN(taylor_jets)(s->log, w->count, w->k, w->times, p, TOP, 0, w->jets);
    by_rows(s->log, w->count, w->k, w->times, p, NX + N, w->jets, farthest);
    return all_finite(w->count * (NX + N), w->jets) ? steps : -1;
}

#endif
#endif
