/* The step of a limited law: (t, [y; z; last u], row) -> [u; z+; u; signals], as `Allocation` of control/limits.py.

   The functions unlimited, the law without limits, and effects come before it, with the sizes

   NM, NZ_LAW, NU, NSIG  its measurements, states, inputs and further signals
   NROW, NX, NK, NJ      its schedule; states of the plant, residuals that may have slack, bounded outputs
   NI, NC                integrators among its states, parameters of the plant

   the tolerances, and the indices measured and integrators, or MEASURED and INTEGRATORS; CORRECTED_BY if a row has the
   input matrix of an estimator. A row is the law's, then the numbers of limits, sizes, bounds and plant, perhaps the
   input matrix, x_ref, D and H. */
#include "unit.h"

#ifndef ALLOCATION_H
#define ALLOCATION_H

#define N_QP NU
#define M_QP (2 * (NU + NJ))
#include "small_qp.h"

#ifdef MEASURED
static const int measured[] = MEASURED, integrators[] = INTEGRATORS;
#endif

/* Where a row has its parts. */
#define LOW NROW
#define HIGH (LOW + NU)
#define CHANGE (HIGH + NU)
#define SIZES (CHANGE + NU)
#define LEAST (SIZES + NU)
#define MOST (LEAST + NJ)
#define PARAMETERS (MOST + NJ)
#define MATRIX (PARAMETERS + NC)
#ifdef CORRECTED_BY
#define X_REF (MATRIX + NZ_LAW * NU)
#else
#define X_REF MATRIX
#endif
#define SLOPES (X_REF + NX)
#define METRIC (SLOPES + NK * NU)

/* The inputs u nearest to those desired within low .. high and within the bounds of c + O u; whether there are some. */
static int allocated(const double *row, const double *desired, const double *low, const double *high, const double *c,
                     const double (*O)[NU], double *u)
{
    const double *size = row + SIZES;
    double H[NU][NU], rows[M_QP][NU], b[M_QP], v[NU], largest = 0;
    int within = 1;
    for (int i = 0; i < NU; i++) within &= low[i] <= desired[i] && desired[i] <= high[i];
    for (int r = 0; r < NJ; r++) {
        double scale = QP_TINY, value = c[r];
        for (int i = 0; i < NU; i++) {
            value += O[r][i] * desired[i];
            scale = fmax(scale, fabs(O[r][i] * size[i]));
        }
        const double least = row[LEAST + r] - value, most = row[MOST + r] - value;
        within &= least <= 0 && 0 <= most;
        for (int i = 0; i < NU; i++) {
            rows[2 * NU + r][i] = O[r][i] * size[i] / scale;
            rows[2 * NU + NJ + r][i] = -rows[2 * NU + r][i];
        }
        b[2 * NU + r] = least / scale;
        b[2 * NU + NJ + r] = -most / scale;
    }
    for (int i = 0; i < NU; i++) u[i] = desired[i];
    if (within) return 1;
    for (int i = 0; i < NU; i++) {
        for (int j = 0; j < NU; j++) {
            H[i][j] = size[i] * row[METRIC + i * NU + j] * size[j];
            largest = fmax(largest, fabs(H[i][j]));
            rows[i][j] = i == j;
            rows[NU + i][j] = -rows[i][j];
        }
        b[i] = (low[i] - desired[i]) / size[i];
        b[NU + i] = -(high[i] - desired[i]) / size[i];
    }
    for (int i = 0; i < NU; i++) for (int j = 0; j < NU; j++) H[i][j] /= largest;
    if (!small_qp((const double (*)[NU])H, (const double (*)[NU])rows, b, v)) return 0;
    for (int i = 0; i < NU; i++) u[i] = fmin(fmax(desired[i] + size[i] * v[i], low[i]), high[i]);
    return 1;
}

static void limited_law(double t, const double *x, const double *row, double *y)
{
    const double *z = x + NM, *last = x + NM + NZ_LAW, *size = row + SIZES;
    double wanted[NU + NZ_LAW + NSIG + 1], state[NX + 1], e[NJ + NJ * NU + 1], O[NJ + 1][NU], low[NU], high[NU], u[NU];
    double *next = y + NU, *signal = y + 2 * NU + NZ_LAW, *slack = signal + NSIG, *active = slack + NK, *reached = active + NU;
    int gives_way = 0;
    unlimited(t, x, row, wanted);
    for (int i = 0; i < NX; i++) state[i] = row[X_REF + i];
    for (int i = 0; i < NM; i++) state[measured[i]] = x[i];
    effects(t, state, row + PARAMETERS, e);
    for (int r = 0; r < NJ; r++) for (int i = 0; i < NU; i++) O[r][i] = e[NJ + i * NJ + r];
    for (int i = 0; i < NU; i++) {
        low[i] = fmax(row[LOW + i], last[i] - row[CHANGE + i]);
        high[i] = fmin(row[HIGH + i], last[i] + row[CHANGE + i]);
    }
    if (!allocated(row, wanted, low, high, e, (const double (*)[NU])O, u)) for (int i = 0; i < NU; i++) u[i] = NAN;
    for (int k = 0; k < NK; k++) {
        double most = 0;
        slack[k] = 0;
        for (int i = 0; i < NU; i++) {
            slack[k] += row[SLOPES + k * NU + i] * (u[i] - wanted[i]);
            most += fabs(row[SLOPES + k * NU + i]) * size[i];
        }
        gives_way |= fabs(slack[k]) > GIVEN_WAY * most;
    }
    for (int i = 0; i < NZ_LAW; i++) next[i] = wanted[NU + i];
    for (int i = 0; gives_way && i < NI; i++) next[integrators[i]] = z[integrators[i]];
#ifdef CORRECTED_BY
    for (int i = 0; i < NZ_LAW; i++) for (int j = 0; j < NU; j++) next[i] += row[MATRIX + i * NU + j] * (u[j] - wanted[j]);
#endif
    for (int i = 0; i < NU; i++) {
        const double room = MET * size[i], side = u[i] <= low[i] + room ? -1.0 : u[i] >= high[i] - room ? 1.0 : 0.0;
        y[i] = y[NU + NZ_LAW + i] = u[i];
        active[i] = fabs(u[i] - wanted[i]) > room ? side : 0.0;
    }
    for (int i = 0; i < NSIG; i++) signal[i] = wanted[NU + NZ_LAW + i];
    for (int r = 0; r < NJ; r++) {
        double value = e[r], room = 0;
        for (int i = 0; i < NU; i++) {
            value += O[r][i] * u[i];
            room += MET * fabs(O[r][i]) * size[i];
        }
        reached[r] = fabs(value - row[MOST + r]) <= room ? 1.0 : 0.0;
        if (fabs(value - row[LEAST + r]) <= room) reached[r] -= 1.0;
    }
}

#endif
