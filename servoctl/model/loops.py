"""The loops over an emitted function, as C text: a grid, Runge-Kutta steps, Newton's iteration, Taylor steps.

NAME stands for the function's name, N_X, N_P and N_Y for the numbers of its states, parameters and outputs; the
function is ``NAME(t, x, p, y)``, and NAME_PROJECT(t, x, p) restores invariants where there is something to restore
them.
"""

BISECTIONS = 20  # halvings of one time step in newton: a millionth of it is a lost solution, not a long step
ROUNDING = 2.0**-52  # a Newton correction this small relative to 1 + |x| cannot be reduced by another

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
    double xk[NAME_nx + 1], pk[NAME_np + 1], yk[NAME_ny + 1];
    for (int64_t k = 0; k < n; k++) {
        for (int64_t i = 0; i < NAME_nx; i++) xk[i] = x[i * n + k];
        for (int64_t i = 0; p_varies && i < NAME_np; i++) pk[i] = p[i * n + k];
        NAME(t[k], xk, p_varies ? pk : p, yk);
        for (int64_t i = 0; i < NAME_ny; i++) y[i * n + k] = yk[i];
    }
}
"""

_RK = """
/* Explicit Runge-Kutta steps on the first n_x outputs by a tableau of s stages; the other outputs are logged beside the
   state. The logs hold n_log columns. Returns the index of the last column written: a state that is not finite ends the
   run. */
int64_t NAME_rk(double t0, const double *x0, double h, int64_t n_steps, int64_t every, int64_t project_every,
                const double *p, int64_t s, const double *a, const double *b, const double *c, int64_t n_log,
                double *x_log, double *guard_log)
{
    double x[NAME_nx + 1], z[NAME_nx + 1], k[s][NAME_ny + 1];
    int64_t column = 0, due = 1;
    for (int64_t i = 0; i < NAME_nx; i++) x[i] = x0[i];
    for (int64_t step = 0; ; step++) {
        for (int64_t i = 0; i < NAME_nx; i++) if (!isfinite(x[i])) return column - 1;
        NAME(t0 + (double)step * h, x, p, k[0]);
        if (--due == 0 || step == n_steps) {
            for (int64_t i = 0; i < NAME_nx; i++) x_log[i * n_log + column] = x[i];
            for (int64_t i = NAME_nx; i < NAME_ny; i++) guard_log[(i - NAME_nx) * n_log + column] = k[0][i];
            column++;
            due = every;
        }
        if (step == n_steps) return column - 1;
        for (int64_t j = 1; j < s; j++) {
            for (int64_t i = 0; i < NAME_nx; i++) z[i] = 0;
            for (int64_t m = 0; m < j; m++) {
                const double weight = a[j * s + m];
                if (weight != 0) for (int64_t i = 0; i < NAME_nx; i++) z[i] += weight * k[m][i];
            }
            for (int64_t i = 0; i < NAME_nx; i++) z[i] = x[i] + h * z[i];
            NAME(t0 + ((double)step + c[j]) * h, z, p, k[j]);
        }
        for (int64_t i = 0; i < NAME_nx; i++) z[i] = 0;
        for (int64_t m = 0; m < s; m++) {
            if (b[m] != 0) for (int64_t i = 0; i < NAME_nx; i++) z[i] += b[m] * k[m][i];
        }
        for (int64_t i = 0; i < NAME_nx; i++) x[i] += h * z[i];
        if (project_every && (step + 1) % project_every == 0) NAME_PROJECT(t0 + (double)(step + 1) * h, x, p);
    }
}
"""

_NEWTON = """
/* The largest |delta_i| / (1 + |x_i|). */
static double NAME_defect(const double *x, const double *y)
{
    double largest = 0;
    for (int64_t i = 0; i < NAME_nx; i++) {
        const double e = fabs(y[i]) / (1 + fabs(x[i]));
        if (!isfinite(x[i]) || !isfinite(y[i])) return INFINITY;
        if (e > largest) largest = e;
    }
    return largest;
}

/* Newton's iteration at time t from x; y is the function at the x it leaves. */
static int NAME_correct(double t, double *x, const double *p, double tol, int64_t max_iter, double *y, int64_t *count)
{
    double x_next[NAME_nx + 1], y_next[NAME_ny + 1], defect;
    for (int64_t iteration = 0; ; iteration++) {
        NAME(t, x, p, y);
        ++*count;
        defect = NAME_defect(x, y);
        if (defect <= tol) break;
        if (!isfinite(defect) || iteration == max_iter) return 0;
        for (int64_t i = 0; i < NAME_nx; i++) x[i] += y[i];
    }
    if (defect <= ROUNDING) return 1;
    for (int64_t i = 0; i < NAME_nx; i++) x_next[i] = x[i] + y[i];
    NAME(t, x_next, p, y_next);
    ++*count;
    if (NAME_defect(x_next, y_next) < defect) {
        for (int64_t i = 0; i < NAME_nx; i++) x[i] = x_next[i];
        for (int64_t i = 0; i < NAME_ny; i++) y[i] = y_next[i];
    }
    return 1;
}

/* From the solution x, y at time a to the one at b: predicted by the rate and corrected; halves the step where that
   fails. */
static int NAME_advance(double a, double b, double *x, const double *p, double tol, int64_t max_iter, double *y,
                        int64_t *count)
{
    double x_next[NAME_nx + 1], y_next[NAME_ny + 1], t = a;
    for (int64_t done = 0, pieces = 1; done < pieces; ) {
        const double next = done + 1 == pieces ? b : a + (b - a) * ((double)(done + 1) / (double)pieces);
        for (int64_t i = 0; i < NAME_nx; i++) x_next[i] = x[i] + (next - t) * y[NAME_nx + i];
        if (NAME_correct(next, x_next, p, tol, max_iter, y_next, count)) {
            for (int64_t i = 0; i < NAME_nx; i++) x[i] = x_next[i];
            for (int64_t i = 0; i < NAME_ny; i++) y[i] = y_next[i];
            t = next;
            for (done++; pieces > 1 && done % 2 == 0; done /= 2) pieces /= 2;
        } else {
            if (pieces == (int64_t)1 << BISECTIONS) return 0;
            done *= 2;
            pieces *= 2;
        }
    }
    return 1;
}

/* The solution at each of n times in order; the logs hold n columns. Returns the number of points solved. */
int64_t NAME_newton(int64_t n, const double *t, const double *x0, const double *p, double tol, int64_t max_iter,
                    double *x_log, double *y_log, int64_t *count)
{
    double x[NAME_nx + 1], y[NAME_ny + 1];
    *count = 0;
    for (int64_t i = 0; i < NAME_nx; i++) x[i] = x0[i];
    for (int64_t k = 0; k < n; k++) {
        if (!(k ? NAME_advance(t[k - 1], t[k], x, p, tol, max_iter, y, count)
                : NAME_correct(t[k], x, p, tol, max_iter, y, count))) return k;
        for (int64_t i = 0; i < NAME_nx; i++) x_log[i * n + k] = x[i];
        for (int64_t i = 0; i < NAME_ny; i++) y_log[i * n + k] = y[i];
    }
    return n;
}
"""

_TAYLOR = """
/* The jet of level j a time h after the expansion: sum over k of k!/(k - j)! c_[k] h^(k - j); c holds `size` numbers
   for each k = 1 .. last, `now` the value itself for j = 0. */
static void NAME_jet(const double *c, int64_t size, int64_t last, int64_t j, const double *now, double h, double *jet)
{
    for (int64_t i = 0; i < size; i++) {
        double sum = 0;
        for (int64_t k = last; k >= (j ? j : 1); k--) {
            double falling = 1;
            for (int64_t m = 0; m < j; m++) falling *= (double)(k - m);
            sum = sum * h + falling * c[(k - 1) * size + i];
        }
        jet[i] = j ? sum : now[i] + sum * h;
    }
}

static double NAME_largest(const double *v, int64_t n)
{
    double largest = 0;
    for (int64_t i = 0; i < n; i++) if (!(fabs(v[i]) <= largest)) largest = fabs(v[i]);
    return largest;
}

/* The step at which the last term stays below the tolerance at every level of the state, the terms taken to grow as the
   fastest of the upper half do: single coefficients may vanish. */
static double NAME_length(const double *x, const double *c, int64_t nq, int64_t n, int64_t top, int64_t last,
                          double rtol, double atol)
{
    double h = INFINITY;
    for (int64_t j = 0; j < top; j++) {
        const double size = j ? NAME_largest(x + nq + (j - 1) * n, n) : NAME_largest(x, nq);
        const double scale = atol + rtol * size, reach = pow(rtol, 1.0 / (double)(last - j));
        for (int64_t k = last / 2 > j ? last / 2 : j + 1; k <= last; k++) {
            double falling = 1;
            for (int64_t m = 0; m < j; m++) falling *= (double)(k - m);
            const double term = falling * NAME_largest(c + (k - 1) * n, n);
            if (!isfinite(term)) return 0;
            if (term > 0) h = fmin(h, reach * pow(scale / rtol / term, 1.0 / (double)(k - j)));
        }
    }
    return h;
}

/* Steps of the Taylor method towards t1. y holds the coefficients of q (unless plain), those of gamma, and guards. The
   logs hold a row for each step: its start, its state, its coefficients and guards; one row more for the end. Returns
   the number of steps, at most max_steps; fewer without reaching t1 where a step vanishes or is not finite. */
int64_t NAME_taylor(double t0, const double *x0, double t1, const double *p, int64_t nq, int64_t n, int64_t top,
                    int64_t last, int64_t plain, double rtol, double atol, int64_t project_every, int64_t max_steps,
                    double *t_log, double *x_log, double *y_log)
{
    double x[NAME_nx + 1], y[NAME_ny + 1], d[NAME_nx + 1], t = t0;
    for (int64_t i = 0; i < NAME_nx; i++) x[i] = x0[i];
    for (int64_t step = 0; ; step++) {
        t_log[step] = t;
        for (int64_t i = 0; i < NAME_nx; i++) x_log[step * NAME_nx + i] = x[i];
        if (step == max_steps || t == t1) return step;
        NAME(t, x, p, y);
        for (int64_t i = 0; i < NAME_ny; i++) y_log[step * NAME_ny + i] = y[i];
        const double *c = y + (plain ? 0 : nq * last);
        double h = NAME_length(x, c, nq, n, top, last, rtol, atol);
        if (!plain) h = fmin(h, NAME_length(x, y, nq, nq, 1, last, rtol, atol));
        if (!(h > 1e-13 * (1 + fabs(t)))) return step;
        const int ends = h >= fabs(t1 - t) * (1 - 1e-12);
        const double signed_h = ends ? t1 - t : t1 > t ? h : -h;
        NAME_jet(y, nq, last, 0, x, signed_h, d);
        for (int64_t j = 1; j < top; j++) NAME_jet(c, n, last, j, x, signed_h, d + nq + (j - 1) * n);
        for (int64_t i = 0; i < NAME_nx; i++) x[i] = d[i];
        t = ends ? t1 : t + signed_h;
        for (int64_t i = 0; i < NAME_nx; i++) if (!isfinite(x[i])) return step;
        if (project_every && (step + 1) % project_every == 0) NAME_PROJECT(t, x, p);
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

LOOPS = {"rk": _RK, "newton": _NEWTON, "taylor": _TAYLOR}
