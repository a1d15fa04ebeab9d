"""A grid of points, and the scalar call, as C text."""

# The scalar call takes one pointer to t, x, p, y in a row: ctypes spends most of a call on converting arguments.
GRID = """
enum { NAME_nx = N_X, NAME_np = N_P, NAME_ny = N_Y };

void NAME_point(double *row)
{
    NAME(row[0], row + 1, row + 1 + NAME_nx, row + 1 + NAME_nx + NAME_np);
}

/* x is (n_x, n), p is (n_p) or, if p_varies, (n_p, n), y is (n_y, n): row by row, one column per point. */
void NAME_grid(int64_t n, const double *t, const double *x, const double *p, int64_t p_varies, double *y)
{
#if NAME_wide_lanes
    if (n >= 8) {
        W xs[NAME_nx + 1], ps[NAME_np + 1], ys[NAME_ny + 1];
        for (int64_t i = 0; !p_varies && i < NAME_np; i++) ps[i] = ALL(p[i]);
        for (int64_t k = 0; k < n; k += 8) {
            k = k + 8 > n ? n - 8 : k;
            for (int64_t i = 0; i < NAME_nx; i++) xs[i] = *(const U *)(x + i * n + k);
            for (int64_t i = 0; p_varies && i < NAME_np; i++) ps[i] = *(const U *)(p + i * n + k);
            NAME_wide(*(const U *)(t + k), xs, ps, ys);
            for (int64_t i = 0; i < NAME_ny; i++) *(U *)(y + i * n + k) = ys[i];
        }
        return;
    }
#endif
    double xk[NAME_nx + 1], pk[NAME_np + 1], yk[NAME_ny + 1];
    for (int64_t k = 0; k < n; k++) {
        for (int64_t i = 0; i < NAME_nx; i++) xk[i] = x[i * n + k];
        for (int64_t i = 0; p_varies && i < NAME_np; i++) pk[i] = p[i * n + k];
        NAME(t[k], xk, p_varies ? pk : p, yk);
        for (int64_t i = 0; i < NAME_ny; i++) y[i * n + k] = yk[i];
    }
}
"""

PROJECTION = """
/* Newton's iteration of the projection onto the invariants, level by level within each correction. */
static void NAME_restore(double t, double *x, const double *p)
{
    double d[NAME_nx + 1];
    for (int64_t iteration = 0; iteration < 6; iteration++) {
        double largest = 0;
        NAME_project(t, x, p, d);
        for (int64_t i = 0; i < NAME_nx; i++) {
            const double e = fabs(d[i]) / (1 + fabs(x[i]));
            if (!isfinite(e)) return;
            if (e > largest) largest = e;
        }
        for (int64_t i = 0; i < NAME_nx; i++) x[i] += d[i];
        if (largest <= ROUNDING) return;
    }
}
"""
