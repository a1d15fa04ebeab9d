/* How deviations from a motion move: X = Q R at the end of each step, Q'Q = 1 in the sizes of the states. */
#ifndef DEVIATIONS_H
#define DEVIATIONS_H

#include "orthonormal.h"

#define COLD static __attribute__((cold)) /* called once for a motion: compiled for size, in a fifth of the time */
#define SHORTER 0.75 /* steps where series of deviations are too short */

/* Deviations Q (F, NX) from a motion through the state x at the first of the cuts, at which steps end, in the sizes of the
   states: the first `fixed` of them stay, as nothing depends on the states that are not active. `settings` are rtol, atol,
   nearby and left_out. Z (F, NX, PADDED(instants)) are the deviations at instants `at`, of which the first one is the
   first cut; the log has a row for each step: the instant of its end, Q and R (F, F) there. */
typedef struct {
    int64_t count, instants, fixed, F, most;
    const double *cuts, *at, *p, *settings, *sizes, *active;
    double *x, *Q, *Z, *series, *log, *defect;
} Deviations;

/* Of all entries, the terms of index k of their series in a row of the log of `taylor`; power is h^(k - TOP + 1). */
COLD void terms(const double *row, double h, int64_t k, double power, double *result)
{
    const double *y = row + 1 + NX, *c = y + (PLAIN ? 0 : NQ * LAST);
    for (int64_t j = TOP - 1; j >= 1; j--, power *= h) {
        for (int64_t i = 0; i < N; i++) result[NQ + (j - 1) * N + i] = falling(k, j) * power * c[(k - 1) * N + i];
    }
    for (int64_t i = 0; i < NQ; i++) result[i] = y[(k - 1) * NQ + i] * power;
}

/* Series of the deviations of a step from a row: half the difference of those at the states with the deviations times
   `nearby` added and subtracted. */
COLD void series_of(const Deviations *d, const double *row, const double *p, double *work)
{
    double below[NX + NY];
    for (int64_t j = d->fixed; j < d->F; j++) {
        const double nearby = d->settings[2], unit = 1 / (2 * nearby), *v = d->Q + j * NX;
        double *above = d->series + j * (1 + NX + NY);
        above[0] = row[0];
        for (int64_t i = 0; i < NX; i++) {
            above[1 + i] = row[1 + i] + nearby * d->sizes[i] * v[i];
            below[i] = row[1 + i] - nearby * d->sizes[i] * v[i];
        }
        FN(moving)(row[0], above + 1, p, above + 1 + NX, work);
        FN(moving)(row[0], below, p, below + NX, work);
        for (int64_t i = 0; i < NX + NY; i++) above[1 + i] = (above[1 + i] - below[i]) * unit;
    }
}

/* Where these are at m times, the instants of Z from `first` on, and the end of the step, to where Q is moved. Returns 0
   where they leave out more than `left_out`, and leaves Q. */
COLD int moved(const Deviations *d, int64_t m, const double *times, int64_t first, const double *p)
{
    const int64_t S = PADDED(d->instants);
    double largest = 0, last = 0, states[NX * (m + 1)], next[d->F * NX + 1];
    int64_t k[m + 1];
    for (int64_t b = 0; b <= m; b++) k[b] = 0;
    for (int64_t j = d->fixed; j < d->F; j++) {
        const double *row = d->series + j * (1 + NX + NY), h = times[m] - row[0];
        double *z = d->Z + j * NX * S + first, power = pow(h, LAST - TOP), last_terms[NX + 1];
        FN(taylor_jets)(row, m + 1, k, times, p, TOP - 1, 0, states);
        for (int64_t i = 0; i < NX; i++) {
            for (int64_t b = 0; b < m; b++) z[i * S + b] = states[i * (m + 1) + b] / d->sizes[i];
            next[j * NX + i] = states[i * (m + 1) + m] / d->sizes[i];
            widen(&largest, fabs(next[j * NX + i]));
        }
        for (int64_t e = 1; e >= 0; e--, power *= h) {
            terms(row, h, LAST - e, power, last_terms);
            for (int64_t i = 0; i < NX; i++) widen(&last, fabs(last_terms[i] / d->sizes[i]));
        }
    }
    for (int64_t i = 0; i < d->fixed * NX; i++) {
        widen(&largest, fabs(d->Q[i]));
        for (int64_t b = 0; b < m; b++) d->Z[i * S + first + b] = d->Q[i];
    }
    if (!(last <= d->settings[3] * largest)) return 0;
    for (int64_t i = d->fixed * NX; i < d->F * NX; i++) d->Q[i] = next[i];
    return 1;
}

/* Deviations Z at m instants from `first` on, in terms of Q at the last end of a step, become those in terms of Q at the
   start of the motion, from where P (F, F) leads to that end. */
COLD void from_the_start(const Deviations *d, int64_t m, int64_t first, const double *P)
{
    const int64_t S = PADDED(d->instants);
    for (int64_t j = d->F - 1; j >= 0; j--) for (int64_t i = 0; i < NX; i++) {
        double *z = d->Z + (j * NX + i) * S + first;
        for (int64_t b = 0; b < m; b++) z[b] *= P[j * d->F + j];
        for (int64_t k = 0; k < j; k++) for (int64_t b = 0; b < m; b++) {
            z[b] += d->Z[(k * NX + i) * S + first + b] * P[k * d->F + j];
        }
    }
}

/* Take a step of at most the length h from a row towards an end: as long as series reach. Returns its end, and in m the
   number of instants in it; NaN where it vanishes. */
COLD double step_on(const Deviations *d, const double *row, double h, double end, const double *p, int64_t first, int64_t *m)
{
    const double left = end - row[0], forward = left > 0 ? 1 : -1;
    double times[d->instants + 1];
    for (; h > 1e-13 * (1 + fabs(row[0])); h *= SHORTER) {
        const double t = h >= fabs(left) * (1 - 1e-12) ? end : row[0] + forward * h;
        for (*m = 0; first + *m < d->instants && forward * d->at[first + *m] <= forward * t; ++*m) {
            times[*m] = d->at[first + *m];
        }
        times[*m] = t;
        if (moved(d, *m, times, first, p)) return t;
    }
    return NAN;
}

/* Move deviations: returns the number of steps, at most `most`; -1 where they vanish or are not finite. x and Q are those
   of the end on return. */
__attribute__((cold)) int64_t FN(deviations)(const Deviations *d)
{
    const double log_rtol = log2(LAST_TERM * d->settings[0]), least = d->settings[1] / d->settings[0];
    const int64_t F = d->F, S = PADDED(d->instants), start = 0;
    double row[1 + NX + NY], p[NP], P[F * F], R[F * F], next[F * F], work[WORK], *log = d->log;
    int64_t steps = 0, first = 1;
    for (int64_t i = 0; i < F * F; i++) P[i] = i % (F + 1) == 0;
    for (int64_t i = 0; i < F * NX && d->instants; i++) d->Z[i * S] = d->Q[i];
    for (int64_t cut = 1; cut < d->count; cut++) {
        const double end = d->cuts[cut];
        double t = d->cuts[cut - 1];
        on_branch(d->p, (t + end) / 2, p);
        FN(still)(t, d->x, p, 0, work);
        for (int64_t m; t != end; steps++, first += m) {
            if (steps == d->most) return -1;
            row[0] = t;
            for (int64_t i = 0; i < NX; i++) row[1 + i] = d->x[i];
            FN(moving)(t, d->x, p, row + 1 + NX, work);
            series_of(d, row, p, work);
            t = step_on(d, row, step_length(d->x, row + 1 + NX, 0, log_rtol, least), end, p, first, &m);
            if (isnan(t)) return -1;
            FN(taylor_jets)(row, 1, &start, &t, p, TOP - 1, 0, d->x);
            for (int64_t i = 0; i < NX; i++) if (!isfinite(d->x[i])) return -1;
            from_the_start(d, m, first, P);
            if (!orthonormal(F, NX, d->Q, R)) return -1;
            triangular_product(F, R, P, next);
            for (int64_t i = 0; i < F * F; i++) P[i] = next[i];
            settle(t, d->x, p);
            if (!log) continue;
            *log++ = t;
            for (int64_t i = 0; i < F * NX; i++) *log++ = d->Q[i];
            for (int64_t i = 0; i < F * F; i++) *log++ = R[i];
        }
    }
    return steps;
}

#ifdef INVARIANTS
/* Orthonormal gradients (INVARIANTS, NX) of the invariants by the active states, in the sizes of the states; 0 where they
   are dependent. */
COLD int gradients(double t, const double *x, const double *p, const double *sizes, const double *active, double *result)
{
    double y[INVARIANTS * (1 + NX) + 1], R[INVARIANTS * INVARIANTS + 1];
    FN(invariants)(t, x, p, y);
    for (int64_t i = 0; i < INVARIANTS; i++) {
        double square = 0, *row = result + i * NX;
        for (int64_t j = 0; j < NX; j++) {
            row[j] = active[j] * y[INVARIANTS * (1 + j) + i] * sizes[j];
            square += row[j] * row[j];
        }
        for (int64_t j = 0; j < NX; j++) row[j] /= sqrt(square);
    }
    return orthonormal(INVARIANTS, NX, result, R);
}

/* Orthonormal deviations (F, NX) in the tangent space of the invariants at the first cut: first the unit vectors of states
   that are not active, then those next to unit vectors of the others. Returns 0 where gradients are dependent. */
__attribute__((cold)) int64_t FN(tangents)(const Deviations *d)
{
    double basis[NX * NX], R[NX * NX], left[NX], p[NP];
    int64_t count = INVARIANTS;
    on_branch(d->p, d->cuts[0], p);
    if (!gradients(d->cuts[0], d->x, p, d->sizes, d->active, basis)) return 0;
    for (int64_t j = 0; j < NX; j++) {
        if (d->active[j]) continue;
        for (int64_t i = 0; i < NX; i++) basis[count * NX + i] = i == j;
        count++;
    }
    while (count < INVARIANTS + d->F) {
        int64_t farthest = 0;
        for (int64_t j = 0; j < NX; j++) {
            left[j] = 1;
            for (int64_t i = 0; i < count; i++) left[j] -= basis[i * NX + j] * basis[i * NX + j];
            farthest = left[j] > left[farthest] ? j : farthest;
        }
        for (int64_t j = 0; j < NX; j++) basis[count * NX + j] = j == farthest;
        if (!orthonormal(++count, NX, basis, R)) return 0;
    }
    for (int64_t i = 0; i < d->F * NX; i++) d->Q[i] = basis[INVARIANTS * NX + i];
    return 1;
}

/* How far deviations Q are from the tangent space of the invariants at x at the last cut, in Frobenius' norm; infinite
   where gradients are dependent. */
__attribute__((cold)) int64_t FN(defect)(const Deviations *d)
{
    double rows[INVARIANTS * NX + 1], square = 0, p[NP];
    const double t = d->cuts[d->count - 1];
    on_branch(d->p, t, p);
    const int found = gradients(t, d->x, p, d->sizes, d->active, rows);
    for (int64_t k = 0; k < d->F; k++) for (int64_t i = 0; i < INVARIANTS; i++) {
        double along = 0;
        for (int64_t j = 0; j < NX; j++) along += rows[i * NX + j] * d->active[j] * d->Q[k * NX + j];
        square += along * along;
    }
    *d->defect = found ? sqrt(square) : INFINITY;
    return found;
}
#endif

#endif
