#include "unit.h"
#include "phased.h"
#include "restore.h"

/* Explicit Runge-Kutta steps on the first n_x outputs by a tableau of s stages; the other outputs are logged beside the
   state. The logs hold n_log columns. Returns the index of the last column written: a state that is not finite ends the
   run. */
int64_t FN(rk)(double t0, const double *x0, double h, int64_t n_steps, int64_t every, int64_t project_every,
           const double *p, int64_t s, const double *a, const double *b, const double *c, int64_t n_log, double *x_log,
           double *guard_log)
{
    double x[NX + 1], z[NX + 1], k[s][NY + 1], w[WORK], now = NAN;
    int64_t column = 0, due = 1;
    for (int64_t i = 0; i < NX; i++) x[i] = x0[i];
    for (int64_t step = 0; ; step++) {
        for (int64_t i = 0; i < NX; i++) if (!isfinite(x[i])) return column - 1;
        evaluate(t0 + (double)step * h, x, p, k[0], w, &now);
        if (--due == 0 || step == n_steps) {
            for (int64_t i = 0; i < NX; i++) x_log[i * n_log + column] = x[i];
            for (int64_t i = NX; i < NY; i++) guard_log[(i - NX) * n_log + column] = k[0][i];
            column++;
            due = every;
        }
        if (step == n_steps) return column - 1;
        for (int64_t j = 1; j < s; j++) {
            for (int64_t i = 0; i < NX; i++) z[i] = 0;
            for (int64_t m = 0; m < j; m++) {
                const double weight = a[j * s + m];
                if (weight != 0) for (int64_t i = 0; i < NX; i++) z[i] += weight * k[m][i];
            }
            for (int64_t i = 0; i < NX; i++) z[i] = x[i] + h * z[i];
            evaluate(t0 + ((double)step + c[j]) * h, z, p, k[j], w, &now);
        }
        for (int64_t i = 0; i < NX; i++) z[i] = 0;
        for (int64_t m = 0; m < s; m++) {
            if (b[m] != 0) for (int64_t i = 0; i < NX; i++) z[i] += b[m] * k[m][i];
        }
        for (int64_t i = 0; i < NX; i++) x[i] += h * z[i];
        if (project_every && (step + 1) % project_every == 0) restore(t0 + (double)(step + 1) * h, x, p);
    }
}
