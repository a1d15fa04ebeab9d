/* One point, a grid of points, and the interface for CasADi. */
#include "unit.h"
#ifdef WIDE
#include "lanes.h"
#endif

/* CasADi's interface of an external function. */
int FN(casadi)(const double **arg, double **res, long long *iw, double *w, int mem)
{
    (void)iw, (void)w, (void)mem;
    NAME(*arg[0], arg[1], arg[2], res[0]);
    return 0;
}
long long FN(casadi_n_in)(void) { return 3; }
long long FN(casadi_n_out)(void) { return 1; }
const long long *FN(casadi_sparsity_in)(long long i)
{
    static const long long dense[3][3] = {{1, 1, 1}, {NX, 1, 1}, {NP, 1, 1}};
    return dense[i];
}
const long long *FN(casadi_sparsity_out)(long long i)
{
    static const long long dense[3] = {NY, 1, 1};
    (void)i;
    return dense;
}

/* One pointer to t, x, p, y in a row: ctypes spends most of a call on converting arguments. */
void FN(point)(double *row)
{
    NAME(row[0], row + 1, row + 1 + NX, row + 1 + NX + NP);
}

/* x is (n_x, n), p is (n_p) or, if p_varies, (n_p, n), y is (n_y, n): row by row, one column per point. */
void FN(grid)(int64_t n, const double *t, const double *x, const double *p, int64_t p_varies, double *y)
{
#ifdef WIDE
    if (n >= 8) {
        W xs[NX + 1], ps[NP + 1], ys[NY + 1];
        for (int64_t i = 0; !p_varies && i < NP; i++) ps[i] = ALL(p[i]);
        for (int64_t k = 0; k < n; k += 8) {
            k = k + 8 > n ? n - 8 : k;
            for (int64_t i = 0; i < NX; i++) xs[i] = w_load(x + i * n + k);
            for (int64_t i = 0; p_varies && i < NP; i++) ps[i] = w_load(p + i * n + k);
            FN(wide)(w_load(t + k), xs, ps, ys);
            for (int64_t i = 0; i < NY; i++) w_store(y + i * n + k, ys[i]);
        }
#ifdef __AVX__
        __builtin_ia32_vzeroupper(); /* gcc adds it from -O2 on; later SSE code takes up to eight times as long without it */
#endif
        return;
    }
#endif
    double xk[NX + 1], pk[NP + 1], yk[NY + 1];
    for (int64_t k = 0; k < n; k++) {
        for (int64_t i = 0; i < NX; i++) xk[i] = x[i * n + k];
        for (int64_t i = 0; p_varies && i < NP; i++) pk[i] = p[i * n + k];
        NAME(t[k], xk, p_varies ? pk : p, yk);
        for (int64_t i = 0; i < NY; i++) y[i * n + k] = yk[i];
    }
}
