/* How deviations from a motion move: X = Q R at the end of each step, Q'Q = 1 in the sizes of the states. */
#ifndef DEVIATIONS_H
#define DEVIATIONS_H

#include "orthonormal.h"

#define COLD static __attribute__((cold)) /* called once for a motion: compiled for size, in a fifth of the time */

/* The state a time h after the expansion by the series of all its entries; y holds the coefficients, c those of gamma. */
COLD void reached(const double *x, const double *y, const double *c, double h, double *result)
{
    double jet[NX + 1] = {0};
    for (int64_t k = LAST; k >= 1; k--) {
        for (int64_t i = 0; i < NQ; i++) jet[i] = jet[i] * h + y[(k - 1) * NQ + i];
        for (int64_t j = 1; j < TOP && j <= k; j++) {
            double *level = jet + NQ + (j - 1) * N;
            for (int64_t i = 0; i < N; i++) level[i] = level[i] * h + falling(k, j) * c[(k - 1) * N + i];
        }
    }
    for (int64_t i = 0; i < NQ; i++) result[i] = x[i] + jet[i] * h;
    for (int64_t i = NQ; i < NX; i++) result[i] = jet[i];
}

/* Of all entries, their terms of index k in these series; power is h^(k - TOP + 1). */
COLD void terms(const double *y, const double *c, double h, int64_t k, double power, double *result)
{
    for (int64_t j = TOP - 1; j >= 1; j--, power *= h) {
        for (int64_t i = 0; i < N; i++) result[NQ + (j - 1) * N + i] = falling(k, j) * power * c[(k - 1) * N + i];
    }
    for (int64_t i = 0; i < NQ; i++) result[i] = y[(k - 1) * NQ + i] * power;
}

/* Where F deviations of unit size, the rows of Q (F, NX), are a time h later: half the difference of the states from x
   with these times `nearby` added and subtracted. The first `fixed` of them stay. The last terms of the series are
   `left_out` of this at most, else 0. */
COLD int moved(double t, const double *x, const double *p, double h, int64_t fixed, int64_t F, const double *sizes,
               double nearby, double left_out, double *Q)
{
    const double powers[2] = {pow(h, LAST - TOP + 1), pow(h, LAST - TOP)};
    double largest = 0, last = 0, beside[NX + 1], y[NY + 1], ends[2][NX + 1], last_terms[2][2][NX + 1];
    for (int64_t i = 0; i < fixed * NX; i++) largest = fmax(largest, fabs(Q[i]));
    for (int64_t j = fixed; j < F; j++) {
        double *v = Q + j * NX;
        for (int64_t side = 0; side < 2; side++) {
            for (int64_t i = 0; i < NX; i++) beside[i] = x[i] + (side ? -nearby : nearby) * sizes[i] * v[i];
            NAME(t, beside, p, y);
            const double *c = y + (PLAIN ? 0 : NQ * LAST);
            reached(beside, y, c, h, ends[side]);
            for (int64_t k = 0; k < 2; k++) terms(y, c, h, LAST - k, powers[k], last_terms[k][side]);
        }
        for (int64_t i = 0; i < NX; i++) {
            const double unit = 1 / (2 * nearby * sizes[i]);
            v[i] = (ends[0][i] - ends[1][i]) * unit;
            largest = fmax(largest, fabs(v[i]));
            for (int64_t k = 0; k < 2; k++) {
                last = fmax(last, fabs((last_terms[k][0][i] - last_terms[k][1][i]) * unit));
            }
        }
    }
    return last <= left_out * largest;
}

/* Deviations along a motion from the state x at the first of the cuts, at which steps end; between them steps are as long
   as the tolerance allows. The first `fixed` deviations stay. `settings` are rtol, atol, nearby and left_out. x and Q
   are those of the end on return, and each row of the log has the instant of a step's end, Q (F, NX) and R (F, F) there.
   Returns the number of steps, at most `most`; -1 where series are too short for the deviations, vanish, or are not
   finite. */
__attribute__((cold)) int64_t FN(deviations)(int64_t count, const double *cuts, double *x, const double *p,
                                             const double *settings, int64_t fixed, int64_t F,
                                             const double *sizes, double *Q, int64_t most, double *log)
{
    const double log_rtol = log2(LAST_TERM * settings[0]), least = settings[1] / settings[0];
    double y[NY + 1], x_next[NX + 1];
    int64_t steps = 0;
    for (int64_t cut = 1; cut < count; cut++) {
        for (double t = cuts[cut - 1]; t != cuts[cut]; steps++, log += 1 + F * (NX + F)) {
            if (steps == most) return -1;
            NAME(t, x, p, y);
            const double h = step_length(x, y, 0, log_rtol, least), left = cuts[cut] - t;
            if (!(h > 1e-13 * (1 + fabs(t)))) return -1;
            const int ends = h >= fabs(left) * (1 - 1e-12);
            const double signed_h = ends ? left : left > 0 ? h : -h;
            const double *c = y + (PLAIN ? 0 : NQ * LAST);
            reached(x, y, c, signed_h, x_next);
            for (int64_t i = 0; i < NX; i++) if (!isfinite(x_next[i])) return -1;
            if (!moved(t, x, p, signed_h, fixed, F, sizes, settings[2], settings[3], Q)) return -1;
            if (!orthonormal(F, NX, Q, log + 1 + F * NX)) return -1;
            t = ends ? cuts[cut] : t + signed_h;
            for (int64_t i = 0; i < NX; i++) x[i] = x_next[i];
            settle(t, x, p);
            log[0] = t;
            for (int64_t i = 0; i < F * NX; i++) log[1 + i] = Q[i];
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

/* Orthonormal deviations (F, NX) in the tangent space of the invariants: first the unit vectors of states that are not
   active, then those next to unit vectors of the others. Returns 0 where gradients are dependent. */
__attribute__((cold)) int64_t FN(tangents)(const double *t, const double *x, const double *p, const double *sizes,
                                           const double *active, int64_t F, double *Q)
{
    double basis[NX * NX], R[NX * NX], left[NX];
    int64_t count = INVARIANTS;
    if (!gradients(*t, x, p, sizes, active, basis)) return 0;
    for (int64_t j = 0; j < NX; j++) {
        if (active[j]) continue;
        for (int64_t i = 0; i < NX; i++) basis[count * NX + i] = i == j;
        count++;
    }
    while (count < INVARIANTS + F) {
        int64_t farthest = 0;
        for (int64_t j = 0; j < NX; j++) {
            left[j] = 1;
            for (int64_t i = 0; i < count; i++) left[j] -= basis[i * NX + j] * basis[i * NX + j];
            farthest = left[j] > left[farthest] ? j : farthest;
        }
        for (int64_t j = 0; j < NX; j++) basis[count * NX + j] = j == farthest;
        if (!orthonormal(++count, NX, basis, R)) return 0;
    }
    for (int64_t i = 0; i < F * NX; i++) Q[i] = basis[INVARIANTS * NX + i];
    return 1;
}

/* How far deviations (F, NX) are from the tangent space of the invariants, in Frobenius' norm; infinite where gradients
   are dependent. */
__attribute__((cold)) void FN(defect)(const double *t, const double *x, const double *p, const double *sizes,
                                      const double *active, int64_t F, const double *Q, double *result)
{
    double rows[INVARIANTS * NX + 1], square = 0;
    const int found = gradients(*t, x, p, sizes, active, rows);
    for (int64_t k = 0; k < F; k++) for (int64_t i = 0; i < INVARIANTS; i++) {
        double along = 0;
        for (int64_t j = 0; j < NX; j++) along += rows[i * NX + j] * active[j] * Q[k * NX + j];
        square += along * along;
    }
    *result = found ? sqrt(square) : INFINITY;
}
#endif

#endif
