"""Radau IIA methods for stiff motions: tableaus, the compiled steps with exact Jacobians, and their integration."""

import ctypes
import functools
from dataclasses import dataclass

import numpy as np

from servoctl.codegen.function import compiled
from servoctl.codegen.loops import ROUNDING
from servoctl.codegen.native import pointer
from servoctl.errors import SpecificationError
from servoctl.methods.bulk import BulkSteps
from servoctl.methods.drift import Project
from servoctl.methods.motion import equal_steps

RADAU_ORDERS = (5, 9, 13)
LEAST_RTOL = {5: 1e-4, 9: 1e-7}  # above which an order needs less work than the next
NEWTON_TOLERANCE = 1e-2  # of the Newton iteration, relative to the tolerance of a step
TIGHT, PATIENT = 1e-4, 3  # the same where steps are fixed, and how many times more iterations they may take
NEWTON_ITERATIONS = {5: 7, 9: 12, 13: 17}  # at most, by order (Hairer and Wanner 1999)


# Stages by order. All are L-stable; the matrix of an odd number of stages has one real eigenvalue.
STAGES = {5: 3, 9: 5, 13: 7}


@functools.cache
def radau(order):
    """The Radau IIA method of an order (Hairer and Wanner 1996, IV.5 and IV.8).

    Parameters
    ----------
    order : {5, 9, 13}

    Returns
    -------
    c : (s,) array
        Nodes, the last of which is 1.
    rate : (s, s) array
        A⁻¹: what takes increments of the stages to h times their rates, the derivative of the collocation polynomial.
    from_pairs, to_pairs : (s, s) arrays
        Real and imaginary parts of the eigenvectors of A⁻¹ as columns, and their inverse.
    mu : ((s + 1)/2, 2) array
        Eigenvalues of A⁻¹, real and imaginary parts: the real one, then one of each pair.
    e : (s,) array
        Weights of the increments in the error of the embedded method of order s.
    """
    from scipy.special import roots_jacobi

    s = STAGES[order]
    c = np.append((1.0 + roots_jacobi(s - 1, 1.0, 0.0)[0]) / 2.0, 1.0)
    nodes = np.append(0.0, c)
    gaps = nodes[:, None] - nodes + np.eye(s + 1)
    weights = 1.0 / gaps.prod(axis=1)
    derivative = weights / weights[:, None] / gaps
    derivative[np.diag_indices(s + 1)] = (1.0 / gaps).sum(axis=1) - 1.0
    rate = derivative[1:, 1:]
    values, vectors = np.linalg.eig(rate)
    real = np.argmin(np.abs(values.imag))
    pairs = [i for i in np.argsort(values.imag) if values[i].imag > 1e-6]
    columns = [vectors[:, real].real, *(part for i in pairs for part in (vectors[:, i].real, vectors[:, i].imag))]
    from_pairs = np.array(columns).T
    mu = np.array([[values[real].real, 0.0], *([values[i].real, -values[i].imag] for i in pairs)])
    # The embedded quadrature has the weight 1/mu_0 at the start and is of order s: what it adds to the weights b_i,
    # times A⁻¹; scaled so that (mu_0/h - J)⁻¹ (f + sum e_i z_i / h) is the error.
    powers = np.vander(c, s, increasing=True).T
    e = mu[0, 0] * np.linalg.solve(powers, np.append(-1.0 / mu[0, 0], np.zeros(s - 1))) @ rate
    return c, rate, from_pairs, np.linalg.inv(from_pairs), mu, e


def basis(c, theta):
    """Lagrange polynomials of the nodes c, and 0, at theta (N,): an (s, N) array."""
    nodes = np.append(0.0, c)
    rows = [[k for k in range(len(nodes)) if k != j] for j in range(1, len(nodes))]
    return np.array([np.prod([(theta - nodes[k]) / (nodes[j + 1] - nodes[k]) for k in r], axis=0)
                     for j, r in enumerate(rows)])  # fmt: skip


def radau_order(rtol):
    """The order of least work for a tolerance."""
    return next((order for order, least in LEAST_RTOL.items() if rtol > least), RADAU_ORDERS[-1])


def radau_loop(model, poles=False):
    """The compiled X' of a model, whose library holds the loop over Radau IIA steps; with error dynamics if `poles`."""

    def build():
        e = model.equations
        name, others = "RadauIIA_poles" if poles else "RadauIIA", {"jacobian": e.ode_jacobian(poles)}
        return compiled(e.ode(poles), name, project=e.project(), others=others, drivers=STEPS)

    return model.once("RadauIIA with poles" if poles else "RadauIIA", build)


@dataclass(frozen=True)
class Settings:
    """How Radau IIA steps are taken.

    Attributes
    ----------
    order : {5, 9, 13}
    rtol, atol : float
        Tolerance of each entry of the state, relative and absolute, of the embedded method of order s.
    fixed : bool
        Whether all steps have the length of the first.
    project_every : int
        Steps between projections; 0 for none.
    """

    order: int
    rtol: float
    atol: float
    fixed: bool = False
    project_every: int = 0

    @property
    def iterations(self):
        """The most iterations of Newton's method in a step."""
        return NEWTON_ITERATIONS[self.order] * (PATIENT if self.fixed else 1)

    @property
    def tolerance(self):
        """The tolerance of Newton's method, relative to that of a step."""
        return max(TIGHT if self.fixed else NEWTON_TOLERANCE, 10 * ROUNDING / self.rtol)


def radau_steps(f, t0, x0, t1, p, h, settings, max_steps):
    """Radau IIA steps towards t1.

    Parameters
    ----------
    f : Compiled
        From `radau_loop`.
    t0 : float
        Start [s].
    x0 : (n_x,) array
        State at t0, SI.
    t1 : float
        End [s].
    p : (n_p,) array
        Parameters, SI.
    h : float
        Length of the first step [s], positive.
    settings : Settings
    max_steps : int

    Returns
    -------
    t : (S + 1,) array
        Starts of the steps, and where the last one ended [s]; short of t1 where steps vanish.
    x : (n_x, S + 1) array
        States there, SI.
    z : (S, s, n_x) array
        Increments of the stages.
    h : float
        Length that the next step should have [s].
    counts : (4,) array
        Rejected steps, evaluations of X', of the Jacobian, decompositions.
    """
    parts, n = radau(settings.order), len(x0)
    s, table = len(parts[0]), np.concatenate([np.ravel(part) for part in parts])
    x0, p = np.ascontiguousarray(x0, dtype=float), np.ascontiguousarray(p, dtype=float)
    work, pivots = np.empty(n * n * (s + 2) + n * (2 * s + 2)), np.empty((s + 1) // 2 * n, dtype=np.int64)
    t, x, y = np.empty(max_steps + 1), np.empty((max_steps + 1, n)), np.empty((max_steps, f.n_y))
    z, step, counts = np.empty((max_steps, s, n)), np.array([float(h)]), np.zeros(4, dtype=np.int64)
    run = f.native("radau")
    run.restype = ctypes.c_int64
    k = run(
        ctypes.c_double(t0),
        pointer(x0),
        ctypes.c_double(t1),
        pointer(p),
        ctypes.c_int64(s),
        pointer(table),
        ctypes.c_int64(settings.iterations),
        ctypes.c_double(settings.tolerance),
        ctypes.c_int64(settings.fixed),
        ctypes.c_double(settings.rtol),
        ctypes.c_double(settings.atol),
        ctypes.c_int64(settings.project_every),
        ctypes.c_int64(max_steps),
        *map(pointer, (step, work, pivots, t, x, y, z, counts)),
    )
    return t[: k + 1], x[: k + 1].T, z[:k], float(step[0]), counts


def settle(f, t, x, p):
    """States x (n_x, N) at times t (N,) moved onto the invariants, by the library of `radau_loop`."""
    rows, t = np.array(x.T, dtype=float, order="C"), np.ascontiguousarray(t, dtype=float)
    run, p = f.native("settle"), np.ascontiguousarray(p, dtype=float)
    run.restype = None
    run(ctypes.c_int64(len(t)), *map(pointer, (t, rows, p)))
    return rows.T


def inside(order, theta, z):
    """Increments at fractions theta (N,) of steps from their stages z (..., s, n_x): (..., N, n_x)."""
    return np.einsum("jm,...jl->...ml", basis(radau(order)[0], np.asarray(theta)), z)


def first_step(f, t, x, p, span, settings):
    """Length of a first step (Hairer, Nørsett and Wanner 1993, II.4); f is a Compiled with the outputs X', guards."""
    n, power = len(x), 1.0 / (STAGES[settings.order] + 1)
    scale = settings.atol + settings.rtol * np.abs(x)
    slope = f(t, x, p)[:n]
    d0, d1 = _size(x / scale), _size(slope / scale)
    h = min(abs(span), 1e-6 if d0 < 1e-5 or d1 < 1e-5 else 0.01 * d0 / d1)
    signed = np.copysign(h, span)
    d2 = _size((f(t + signed, x + signed * slope, p)[:n] - slope) / scale) / h
    longer = max(1e-6, h * 1e-3) if max(d1, d2) <= 1e-15 else (0.01 / max(d1, d2)) ** power
    h = min(100 * h, longer, abs(span))
    return h if np.isfinite(h) and h > 0 else 1e-6 * abs(span)


def _size(v):
    return float(np.sqrt(np.mean(np.square(v)))) if v.size else 0.0


@dataclass(frozen=True)
class Steps:
    """Steps of a Radau IIA method.

    Attributes
    ----------
    t : (S + 1,) array
        Starts, and the end of the last one [s].
    x : (n_x, S + 1) array
        States there.
    failed : bool
        Whether no further step succeeds.
    order : int
    z : (S, s, n_x) array
        Increments of the stages.
    """

    t: np.ndarray
    x: np.ndarray
    failed: bool
    order: int
    z: np.ndarray

    def at(self, k, times):
        """States (n_x, N) at times (N,) within step k, by the collocation polynomial."""
        theta = (times - self.t[k]) / (self.t[k + 1] - self.t[k])
        return self.x[:, [k]] + inside(self.order, theta, self.z[k]).T

    def within(self, theta):
        """States (n_x, S, N) at fractions theta (N,) of all steps."""
        return self.x[:, :-1, None] + np.moveaxis(inside(self.order, theta, self.z), 2, 0)


class RadauSteps(BulkSteps):
    """One integration by a Radau IIA method.

    Parameters
    ----------
    model : Model
    drift : None, Poles or Project
    rtol, atol : float
    order : {5, 9, 13} or None
        None chooses it by `radau_order`.
    step : float or None
        Length of fixed steps [s]; None adapts them.
    progress : callable

    Raises
    ------
    SpecificationError
        Where there is no C compiler.
    """

    most = 200  # steps per call of the compiled loop

    def __init__(self, model, drift, rtol, atol, order, step, progress):
        self.step, self.taken = step, []
        self.every = drift.every if isinstance(drift, Project) else 0
        self.most = max(self.most - self.most % self.every, self.every) if self.every else self.most
        order = radau_order(rtol) if order is None else order
        self.settings = Settings(order, rtol, atol, step is not None, self.every)
        super().__init__(model, "RadauIIA", drift, progress)

    def _function(self, model, poles):
        f = radau_loop(model, poles)
        if f.native("radau") is None:
            raise SpecificationError(
                "method='RadauIIA' was given, and there is no C compiler.",
                "The loop over its steps is C code.",
                nearest="method='Radau', scipy's of order 5.",
                do="Take that, or install a C compiler (gcc or clang).",
            )
        return f

    def halved(self, model, t, x, h):
        """States (n_x, 3) at t, t + h and t + 2 h by two steps; fewer where one fails."""
        self._use(model)
        return radau_steps(self.f, t, x, t + 2 * h, self.p, abs(h), self.settings, 2)[1]

    def _record(self, steps, stand):
        super()._record(steps, stand)
        if self.step is not None:
            self.taken.append((self.model, steps.t[: stand + 1], steps.x[:, : stand + 1]))

    def _begin(self, a, x, b):
        if self.step is None:
            self.h = first_step(self.f, a, x, self.p, b - a, self.settings)
            self.motion.count(nfev=2)
        else:
            self.h = abs(equal_steps(a, b, self.step)[0])

    def _steps(self, t, x, b):
        t, x, z, self.h, counts = radau_steps(self.f, t, x, b, self.p, self.h, self.settings, self.most)
        self.motion.count(steps=len(z), **dict(zip(("rejected", "nfev", "njev", "nlu"), counts, strict=True)))
        if self.every:
            self.motion.count(projections=len(z) // self.every)
            if t[-1] == b:
                x = np.column_stack([x[:, :-1], self._settled(t[-1:], x[:, -1:])])
        return Steps(t, x, len(z) < self.most and t[-1] != b, self.settings.order, z)

    def _settled(self, times, states):
        return settle(self.f, times, states, self.p) if self.every else states

    def _fail(self, t, x):
        why = "its steps vanish" if self.step is None else "a fixed step is not solved by the Newton iteration"
        self.motion.stop = self.monitor.failed(
            t,
            x,
            "the step of the integrator shrinks to nothing",
            f"RadauIIA stopped at t = {t:.7g} s: {why}.",
            "A motion is integrated as far as its solution exists and steps can be solved.",
            "Take a smaller step or none, loosen rtol, or see whether the motion escapes.",
        )


STEPS = """
/* LU decomposition with partial pivoting of a complex matrix, real and imaginary parts side by side; the diagonal keeps
   the inverses of the pivots. */
static int NAME_factor(double *a, int64_t *pivot)
{
    const int64_t n = NAME_nx;
    for (int64_t k = 0; k < n; k++) {
        double best = 0;
        for (int64_t i = k; i < n; i++) {
            const double size = fabs(a[2 * (i * n + k)]) + fabs(a[2 * (i * n + k) + 1]);
            if (!isfinite(size)) return 0;
            if (size > best) { best = size; pivot[k] = i; }
        }
        if (!(best > 0)) return 0;
        double *top = a + 2 * k * n;
        if (pivot[k] != k) {
            double *other = a + 2 * pivot[k] * n;
            for (int64_t j = 0; j < 2 * n; j++) { const double v = top[j]; top[j] = other[j]; other[j] = v; }
        }
        const double size = top[2 * k] * top[2 * k] + top[2 * k + 1] * top[2 * k + 1];
        top[2 * k] /= size;
        top[2 * k + 1] /= -size;
        for (int64_t i = k + 1; i < n; i++) {
            double *row = a + 2 * i * n;
            const double re = row[2 * k] * top[2 * k] - row[2 * k + 1] * top[2 * k + 1];
            const double im = row[2 * k] * top[2 * k + 1] + row[2 * k + 1] * top[2 * k];
            row[2 * k] = re;
            row[2 * k + 1] = im;
            if (re == 0 && im == 0) continue;
            for (int64_t j = k + 1; j < n; j++) {
                row[2 * j] -= re * top[2 * j] - im * top[2 * j + 1];
                row[2 * j + 1] -= re * top[2 * j + 1] + im * top[2 * j];
            }
        }
    }
    return 1;
}

static void NAME_backsolve(const double *a, const int64_t *pivot, double *b)
{
    const int64_t n = NAME_nx;
    for (int64_t k = 0; k < n; k++) {
        double re = b[2 * pivot[k]], im = b[2 * pivot[k] + 1];
        b[2 * pivot[k]] = b[2 * k];
        b[2 * pivot[k] + 1] = b[2 * k + 1];
        b[2 * k] = re;
        b[2 * k + 1] = im;
    }
    for (int64_t i = 1; i < n; i++)
        for (int64_t j = 0; j < i; j++) {
            const double *l = a + 2 * (i * n + j);
            b[2 * i] -= l[0] * b[2 * j] - l[1] * b[2 * j + 1];
            b[2 * i + 1] -= l[0] * b[2 * j + 1] + l[1] * b[2 * j];
        }
    for (int64_t i = n - 1; i >= 0; i--) {
        for (int64_t j = i + 1; j < n; j++) {
            const double *u = a + 2 * (i * n + j);
            b[2 * i] -= u[0] * b[2 * j] - u[1] * b[2 * j + 1];
            b[2 * i + 1] -= u[0] * b[2 * j + 1] + u[1] * b[2 * j];
        }
        const double *d = a + 2 * (i * n + i), re = b[2 * i], im = b[2 * i + 1];
        b[2 * i] = re * d[0] - im * d[1];
        b[2 * i + 1] = re * d[1] + im * d[0];
    }
}

typedef struct {
    int64_t s, limit;
    const double *c, *rate, *from_pairs, *to_pairs, *mu, *e, *p;
    double tol, floor, *jacobian, *lu, *scale, *r, *b;
    int64_t *pivots, nfev, njev, nlu, rejected;
} NAME_method;

/* The (s + 1)/2 matrices mu/h - J. */
static int NAME_prepare(NAME_method *m, double h)
{
    const int64_t n = NAME_nx;
    m->nlu++;
    for (int64_t k = 0; k < (m->s + 1) / 2; k++) {
        double *a = m->lu + 2 * k * n * n;
        for (int64_t i = 0; i < n; i++)
            for (int64_t j = 0; j < n; j++) {
                a[2 * (i * n + j)] = (i == j ? m->mu[2 * k] / h : 0) - m->jacobian[j * n + i];
                a[2 * (i * n + j) + 1] = i == j ? m->mu[2 * k + 1] / h : 0;
            }
        if (!NAME_factor(a, m->pivots + k * n)) return 0;
    }
    return 1;
}

/* The simplified Newton iteration for the increments z (s, n_x) of the stages; returns its length, 0 where it fails. */
static int64_t NAME_iterate(NAME_method *m, double t, const double *x, double h, double *z, double *rate)
{
    const int64_t n = NAME_nx, s = m->s;
    double point[NAME_nx + 1], y[NAME_ny + 1], last = 0;
    *rate = 0;
    for (int64_t k = 0; k < m->limit; k++) {
        for (int64_t i = 0; i < s; i++) {
            for (int64_t l = 0; l < n; l++) point[l] = x[l] + z[i * n + l];
            NAME(t + m->c[i] * h, point, m->p, y);
            for (int64_t l = 0; l < n; l++) {
                double slope = 0;
                for (int64_t j = 0; j < s; j++) slope += m->rate[i * s + j] * z[j * n + l];
                m->r[i * n + l] = y[l] - slope / h;
                if (!isfinite(m->r[i * n + l])) return 0;
            }
        }
        m->nfev += s;
        for (int64_t q = 0; q < (s + 1) / 2; q++) {
            for (int64_t l = 0; l < n; l++) {
                double re = 0, im = 0;
                for (int64_t j = 0; j < s; j++) {
                    if (q) re += m->to_pairs[(2 * q - 1) * s + j] * m->r[j * n + l];
                    im += m->to_pairs[2 * q * s + j] * m->r[j * n + l];
                }
                m->b[2 * (q * n + l)] = q ? re : im;
                m->b[2 * (q * n + l) + 1] = q ? im : 0;
            }
            NAME_backsolve(m->lu + 2 * q * n * n, m->pivots + q * n, m->b + 2 * q * n);
        }
        double norm = 0;
        for (int64_t i = 0; i < s; i++)
            for (int64_t l = 0; l < n; l++) {
                double dz = m->from_pairs[i * s] * m->b[2 * l];
                for (int64_t j = 1; j < s; j++)
                    dz += m->from_pairs[i * s + j] * m->b[2 * ((j + 1) / 2 * n + l) + (j + 1) % 2];
                z[i * n + l] += dz;
                norm += dz / m->scale[l] * (dz / m->scale[l]);
            }
        norm = sqrt(norm / (double)(s * n));
        if (!isfinite(norm)) return 0;
        if (k) *rate = norm / last;
        if (norm <= m->floor || (k && *rate < 1 && *rate / (1 - *rate) * norm < m->tol)) return k + 1;
        if (k && (*rate >= 1 || pow(*rate, (double)(m->limit - 1 - k)) / (1 - *rate) * norm > m->tol)) return 0;
        last = norm;
    }
    return 0;
}

/* A length to 10 bits: rounding in the estimated error does not show in the steps. */
static double NAME_rounded(double h)
{
    int exponent;
    const double part = frexp(h, &exponent);
    return ldexp(rint(part * 1024) / 1024, exponent);
}

static double NAME_size(const double *v, int64_t stride, const double *x, const double *next, double rtol, double atol)
{
    double sum = 0;
    for (int64_t i = 0; i < NAME_nx; i++) {
        const double e = v[stride * i] / (atol + rtol * fmax(fabs(x[i]), fabs(next[i])));
        sum += e * e;
    }
    return sqrt(sum / NAME_nx);
}

/* The norm of the error that the embedded method shows, smoothed by the real system. */
static double NAME_error(NAME_method *m, double t, const double *x, const double *f, const double *z, double h,
                         double rtol, double atol, int again)
{
    const int64_t n = NAME_nx, s = m->s;
    double next[NAME_nx + 1], point[NAME_nx + 1], y[NAME_ny + 1], size = 0;
    for (int64_t l = 0; l < n; l++) next[l] = x[l] + z[(s - 1) * n + l];
    for (int64_t round = 0; round < 2; round++) {
        for (int64_t l = 0; l < n; l++) {
            double sum = 0;
            for (int64_t i = 0; i < s; i++) sum += m->e[i] * z[i * n + l];
            m->b[2 * l] = (round ? y[l] : f[l]) + sum / h;
            m->b[2 * l + 1] = 0;
        }
        NAME_backsolve(m->lu, m->pivots, m->b);
        size = NAME_size(m->b, 2, x, next, rtol, atol);
        if (!again || size <= 1 || round) return size;
        for (int64_t l = 0; l < n; l++) point[l] = x[l] + m->b[2 * l];
        NAME(t, point, m->p, y);
        m->nfev++;
    }
    return size;
}

/* Increments that continue the collocation polynomial of the last step, `ratio` times as far as that was long. */
static void NAME_continue(const NAME_method *m, const double *z, double ratio, double *guess)
{
    const int64_t n = NAME_nx, s = m->s;
    for (int64_t i = 0; i < s * n; i++) guess[i] = -z[(s - 1) * n + i % n];
    for (int64_t i = 0; i < s; i++)
        for (int64_t j = 0; j < s; j++) {
            const double theta = 1 + m->c[i] * ratio;
            double weight = theta / m->c[j];
            for (int64_t k = 0; k < s; k++) if (k != j) weight *= (theta - m->c[k]) / (m->c[j] - m->c[k]);
            for (int64_t l = 0; l < n; l++) guess[i * n + l] += weight * z[j * n + l];
        }
}

/* Steps of a Radau IIA method towards t1, at most max_steps. `step` holds the first length, then that of the next step;
   if `fixed`, all steps have it. The logs hold a row for each step: its start, its state, the function there, the
   increments of its stages; one row more of time and state for the end. Returns the number of steps; fewer than
   max_steps without reaching t1 where a step vanishes. counts are those of rejected steps, evaluations, Jacobians and
   decompositions. */
int64_t NAME_radau(double t0, const double *x0, double t1, const double *p, int64_t s, const double *table,
                   int64_t limit, double tol, int64_t fixed, double rtol, double atol, int64_t project_every,
                   int64_t max_steps, double *step, double *work, int64_t *pivots, double *t_log, double *x_log,
                   double *y_log, double *z_log, int64_t *counts)
{
    const int64_t n = NAME_nx;
    const double *parts = table + s + 3 * s * s;
    NAME_method m = {s, limit, table, table + s, table + s + s * s, table + s + 2 * s * s, parts, parts + s + 1, p,
                     tol, 10 * ROUNDING / rtol, work, work + n * n, work + n * n * (s + 2), 0, 0, pivots, 0, 0, 0, 0};
    double x[NAME_nx + 1], t = t0, h = *step, h_before = 0, e_before = 0, prepared = 0;
    m.r = m.scale + n;
    m.b = m.r + s * n;
    int current = 0, useful = 0;
    int64_t k = 0;
    for (int64_t i = 0; i < n; i++) x[i] = x0[i];
    for (; ; k++) {
        double *y = y_log + k * NAME_ny, *z = z_log + k * s * n;
        t_log[k] = t;
        for (int64_t i = 0; i < n; i++) x_log[k * n + i] = x[i];
        if (k == max_steps || t == t1) break;
        NAME(t, x, p, y);
        m.nfev++;
        if (!useful) { NAME_jacobian(t, x, p, m.jacobian); m.njev++; current = useful = 1; prepared = 0; }
        for (int64_t i = 0; i < n; i++) m.scale[i] = atol + rtol * fabs(x[i]);
        double rate = 0, signed_h = 0, error = 0, factor = 1;
        int64_t iterations = 0, refused = 0, ends = 0, stuck = 0;
        for (; ; refused++) {
            stuck = !(h > 1e-14 * (1e-3 + fabs(t))) || (fixed && refused);
            if (stuck) break;
            ends = h >= fabs(t1 - t) * (1 - 1e-12);
            signed_h = ends ? t1 - t : t1 > t ? h : -h;
            if (k) NAME_continue(&m, z - s * n, signed_h / (t - t_log[k - 1]), z);
            else for (int64_t i = 0; i < s * n; i++) z[i] = 0;
            iterations = 0;
            if (prepared == signed_h || NAME_prepare(&m, signed_h)) {
                prepared = signed_h;
                iterations = NAME_iterate(&m, t, x, signed_h, z, &rate);
            }
            if (!iterations) {
                if (current) h = 0.5 * fabs(signed_h);
                else { NAME_jacobian(t, x, p, m.jacobian); m.njev++; current = 1; refused--; }
                prepared = 0;
                continue;
            }
            if (fixed) break;
            error = NAME_error(&m, t, x, y, z, signed_h, rtol, atol, refused > 0 || k == 0);
            const double power = -1.0 / (double)(s + 1);
            const double safety = 0.9 * (double)(2 * limit + 1) / (double)(2 * limit + iterations);
            factor = pow(fmax(error, 1e-10), power);
            if (h_before > 0 && error > 0) factor *= fmin(1, fabs(signed_h) / h_before * pow(e_before / error, -power));
            factor *= safety;
            if (error <= 1) break;
            h = NAME_rounded(fabs(signed_h) * (isfinite(error) ? fmax(0.2, factor) : 0.5));
        }
        m.rejected += refused;
        if (stuck) break;
        h_before = fabs(signed_h);
        e_before = fmax(error, 1e-4);
        for (int64_t i = 0; i < n; i++) x[i] += z[(s - 1) * n + i];
        t = ends ? t1 : t + signed_h;
        useful = iterations <= 2 || rate <= 1e-3;
        current = 0;
        if (!fixed && !(useful && factor < 1.2 && factor > 0.9))
            h = NAME_rounded(h_before * fmin(factor, refused ? 1 : 5));
        if (project_every && (k + 1) % project_every == 0) NAME_PROJECT(t, x, p);
    }
    *step = h;
    counts[0] = m.rejected;
    counts[1] = m.nfev;
    counts[2] = m.njev;
    counts[3] = m.nlu;
    return k;
}

/* Restores the invariants at n instants; x is (n, n_x). */
void NAME_settle(int64_t n, const double *t, double *x, const double *p)
{
    for (int64_t k = 0; k < n; k++) NAME_PROJECT(t[k], x + k * NAME_nx, p);
}
"""
