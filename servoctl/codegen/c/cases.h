/* Motions of many cases, which threads share. */
#include "unit.h"

#ifndef CASES_H
#define CASES_H

/* Inputs are a row for each case: x0, p, absolute tolerance; the indices of the cases to compute; and for all of them the
   pivots' sizes, the instants of samples, and those at which steps end. A thread takes at most so many steps, and leaves
   the cases that it has not finished. Results are a row for each case: the outcome, the number of steps, the last
   instant, by how much the invariants are violated, the last state, its largest sizes, of q from x0; and its samples. */
#define RESULTS 4 /* before the state */

typedef struct {
    double t0, t1, rtol, longest;
    int64_t max_steps, n_times, n_cuts, n_cases, most, next, stop;
    const int64_t *order;
    const double *x0, *p, *atol, *pivots, *times, *cuts;
    double *ends, *samples;
} Many;

enum { FINISHED = 1, PIVOT_FALLS = -1, STUCK = -2, SERIES_OFF = -3 };

/* The next case that no thread has taken, -1 if there is none. */
static inline int64_t next_case(Many *m)
{
    const int64_t next = __atomic_fetch_add(&m->next, 1, __ATOMIC_RELAXED);
    return next < m->n_cases ? m->order[next] : -1;
}

static inline int stopped(const Many *m) { return *(const volatile int64_t *)&m->stop != 0; }

#endif
