/* Paths of many cases, each by newton.c. N is the number of quasi-velocities, which follow x in a state, and PLAIN says
   whether they are its rates. */
#include <stdlib.h>

#include "unit.h"
#include "cases.h"
#ifndef NODE
#include "newton.c"
#endif

#define STATE (NX + N)
#define FIRST (PLAIN ? NX : 3 * NX) /* of the velocities in the log */

/* Whether a pivot of some nodes is far below or above its largest size so far. */
static int pivots_fall(const Many *m, int64_t n, const double *nodes)
{
    for (int64_t i = 0; i < PIVOTS; i++) {
        double largest = m->pivots[i];
        for (int64_t k = 0; k < n; k++) {
            const double size = fabs(nodes[k * NODE + 1 + NX + NY - PIVOTS + i]);
            if (!(size >= DEGRADED * largest) || size * NEGLIGIBLE > largest) return 1;
            largest = fmax(largest, size);
        }
    }
    return 0;
}

/* A case, and its number of nodes; the nodes and the log are memory for its path and samples. */
static int64_t plan(const Many *m, int64_t at, double *nodes, double *log)
{
    const double *p = m->p + at * NP;
    double *row = m->ends + at * (RESULTS + 2 * STATE), *samples = m->samples + at * m->n_times * STATE;
    int64_t count;
    const int64_t n = FN(continuation)(m->n_cuts, m->cuts, m->x0 + at * STATE, p, m->longest, m->max_steps, nodes, &count);
    row[0] = STUCK;
    if (!n || nodes[(n - 1) * NODE] != m->t1) return n;
    row[0] = PIVOT_FALLS;
    if (pivots_fall(m, n, nodes)) return n;
    row[0] = STUCK;
    if (FN(newton)(m->n_times, m->times, n, nodes, p, log, &count) != m->n_times) return n;
    row[0] = FINISHED;
    row[1] = (double)(n - 1);
    row[2] = m->t1;
    for (int64_t k = 0; k < m->n_times; k++, samples += STATE) {
        for (int64_t i = 0; i < NX; i++) samples[i] = log[i * m->n_times + k];
        for (int64_t i = 0; i < N; i++) samples[NX + i] = log[(FIRST + i) * m->n_times + k];
    }
    return n;
}

/* Called by each thread; without memory the cases are left as they are. */
void FN(plans)(Many *m)
{
    double *nodes = malloc(sizeof(double) * (size_t)(m->max_steps * NODE));
    double *log = malloc(sizeof(double) * (size_t)(m->n_times * (NY - PIVOTS)));
    for (int64_t at, steps = 0; nodes && log && steps < m->most && !stopped(m) && (at = next_case(m)) >= 0;) {
        steps += plan(m, at, nodes, log) + m->n_times;
    }
    free(nodes);
    free(log);
}
