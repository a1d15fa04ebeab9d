"""C text from the instruction list of an SX function: the function itself and the loops that call it.

The function is a ``casadi.Function`` with inputs t (scalar), x (n_x), p (n_p) and one dense column output y (n_y). Its
statements are written for a number type ``V`` through ``K(constant)`` and ``v_sin(a)``, so that the same text serves
any type for which these are defined. A long function is cut into chunks, and the values that outlive a chunk are kept
in memory: compilers need more than linear time for one long function.
"""

import math
from itertools import chain

import casadi as ca

from servoctl.errors import SpecificationError, unknown

CHUNK = 350  # statements per C function: compile time is least, and flat, between 250 and 500
BISECTIONS = 20  # halvings of one time step in newton: a millionth of it is a lost solution, not a long step
ROUNDING = 2.0**-52  # a Newton correction this small relative to 1 + |x| cannot be reduced by another

_LIBM_1 = (
    "sqrt exp log expm1 log1p sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh fabs floor ceil erf"
).split()
_LIBM_2 = "pow fmin fmax fmod remainder atan2 copysign hypot".split()
_OWN_1 = "sign not erfinv".split()
_OWN_2 = "lt le eq ne and or if_else_zero".split()

_TEMPLATES = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "K(2.0) * {0}",
    ca.OP_INV: "K(1.0) / {0}",
    ca.OP_CONSTPOW: "v_pow({0}, {1})",
    **{getattr(ca, f"OP_{name.upper()}"): f"v_{name}({{0}})" for name in (*_LIBM_1, *_OWN_1)},
    **{getattr(ca, f"OP_{name.upper()}"): f"v_{name}({{0}}, {{1}})" for name in (*_LIBM_2, *_OWN_2)},
}
_COPIES = {ca.OP_ASSIGN, ca.OP_LIFT}  # the first operand, unchanged
_NOT_ARITHMETIC = {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT, *_COPIES}
_INPUTS = ("t", "x[{}]", "p[{}]")

_PRELUDE = (
    """\
#include <math.h>
#include <stdint.h>

typedef double V;
#define K(constant) (constant)
"""
    + "".join(f"#define v_{name} {name}\n" for name in (*_LIBM_1, *_LIBM_2))
    + """
static inline V v_sign(V a) { return a < 0 ? -1 : a > 0 ? 1 : a; }
static inline V v_not(V a) { return !a; }
static inline V v_lt(V a, V b) { return a < b; }
static inline V v_le(V a, V b) { return a <= b; }
static inline V v_eq(V a, V b) { return a == b; }
static inline V v_ne(V a, V b) { return a != b; }
static inline V v_and(V a, V b) { return a && b; }
static inline V v_or(V a, V b) { return a || b; }
static inline V v_if_else_zero(V a, V b) { return a ? b : 0; }
"""
)

_ERFINV = """\

/* As CasADi evaluates it: rational approximations, and two Newton steps on erf except below -0.7. */
static V v_erfinv(V a)
{
    const V size = fabs(a);
    V r, z;
    if (!(size < 1)) return size == 1 ? copysign(INFINITY, a) : NAN;
    if (a < 0.7 && a >= -0.7) {
        z = a * a;
        r = a * (((-0.140543331 * z + 0.914624893) * z - 1.645349621) * z + 0.886226899)
            / ((((-0.329097515 * z + 0.012229801) * z + 1.442710462) * z - 2.118377725) * z + 1.0);
    } else {
        z = sqrt(-log((1.0 - size) / 2.0));
        r = (((1.641345311 * z + 3.429567803) * z - 1.624906493) * z - 1.970840454)
            / ((1.637067800 * z + 3.543889200) * z + 1.0);
    }
    if (a < -0.7) return -r;
    for (int k = 0; k < 2; k++) r = r - (erf(r) - a) / (2.0 / sqrt(3.14159265358979323846) * exp(-r * r));
    return r;
}
"""

_SIGNATURE = "const V t, const V *restrict x, const V *restrict p, V *restrict y"

# The scalar call takes one pointer to t, x, p, y in a row: ctypes spends most of a call on converting arguments.
_GRID = """
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

/* The step whose last two terms stay below the tolerance at every level of the state. */
static double NAME_length(const double *x, const double *c, int64_t nq, int64_t n, int64_t top, int64_t last,
                          double rtol, double atol)
{
    double h = INFINITY;
    for (int64_t j = 0; j < top; j++) {
        const double scale = atol + rtol * (j ? NAME_largest(x + nq + (j - 1) * n, n) : NAME_largest(x, nq));
        for (int64_t k = last - 1; k <= last; k++) {
            double falling = 1;
            for (int64_t m = 0; m < j; m++) falling *= (double)(k - m);
            const double term = falling * NAME_largest(c + (k - 1) * n, n);
            if (!isfinite(term)) return 0;
            if (term > 0) h = fmin(h, pow(scale / term, 1.0 / (double)(k - j)));
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

_PROJECTION = """
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


def operations(f):
    """Number of arithmetic instructions of an SX function.

    Parameters
    ----------
    f : casadi.Function
        An SX function.

    Returns
    -------
    int
        Instructions that compute; constants, inputs, outputs and copies are not counted.
    """
    return sum(f.instruction_id(k) not in _NOT_ARITHMETIC for k in range(f.n_instructions()))


def emit(f, name, loops=(), chunk=CHUNK, project=None):
    """C translation unit of a function and of the loops over it.

    It defines ``void name(double t, const double *x, const double *p, double *y)`` (``y`` overlaps no input),
    ``name_point``, ``name_grid`` and a ``name_LOOP`` for each loop asked for.

    Parameters
    ----------
    f : casadi.Function
        SX function of t (scalar), x (n_x), p (n_p) with one dense column output y (n_y).
    name : str
        A C identifier, the prefix of every external symbol.
    loops : sequence of {"rk", "newton", "taylor"}
        Drivers to append.
    chunk : int
        Largest number of statements in one C function.
    project : casadi.Function, optional
        Change of x (n_x) that restores invariants, of the same inputs; loops may call it after their steps.

    Returns
    -------
    str
        The same text for the same function, name and loops, in every process.

    Raises
    ------
    SpecificationError
        If f contains an operation that has no C counterpart here.
    NameUnknown
        If a loop is none of the above.
    """
    for loop in loops:
        if loop not in LOOPS:
            raise unknown(loop, LOOPS, "loop")
    body = _function(f, name, chunk)
    if project is not None:
        body += _function(project, f"{name}_project", chunk)
    drivers = "".join((_GRID, _PROJECTION if project else "", *(LOOPS[loop] for loop in LOOPS if loop in loops)))
    drivers = drivers.replace("NAME_PROJECT(", "NAME_restore(" if project else "(void)(")
    for key, value in {
        "N_X": f.numel_in(1),
        "N_P": f.numel_in(2),
        "N_Y": f.numel_out(0),
        "BISECTIONS": BISECTIONS,
        "ROUNDING": repr(ROUNDING),
        "NAME": name,
    }.items():
        drivers = drivers.replace(key, str(value))
    return _PRELUDE + (_ERFINV if "v_erfinv" in body else "") + body + drivers


def _function(f, name, chunk):
    """The text of one C function, in chunks where it is long."""
    statements = _statements(f)
    chunks = [statements[k : k + chunk] for k in range(0, len(statements), chunk)]
    return _single(name, statements) if len(chunks) <= 1 else _chunked(name, chunks)


def _literal(value):
    if math.isnan(value):
        return "K(NAN)"
    if math.isinf(value):
        return "K(INFINITY)" if value > 0 else "K(-INFINITY)"
    return f"K({value!r})"


def _statements(f):
    """Single assignments: (value number, or None for an output; C template; operands as value numbers or C text)."""
    register, statements, values = {}, [], 0
    for k in range(f.n_instructions()):
        operation, source, target = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if operation == ca.OP_INPUT:
            register[target[0]] = _INPUTS[source[0]].format(source[1])
        elif operation == ca.OP_CONST:
            register[target[0]] = _literal(f.instruction_constant(k))
        elif operation == ca.OP_OUTPUT:
            statements.append((None, f"y[{target[1]}] = {{0}}", (register[source[0]],)))
        elif operation in _COPIES:
            register[target[0]] = register[source[0]]
        elif operation in _TEMPLATES:
            statements.append((values, _TEMPLATES[operation], tuple(register[i] for i in source)))
            register[target[0]] = values
            values += 1
        else:
            raise SpecificationError(
                f"the function {f.name()} contains the operation {_operation_name(operation)}",
                "only scalar arithmetic can be compiled",
                nearest="the elementary functions of CasADi's SX",
                do="write the expression with these, or expand() the function called",
                operation=operation,
            )
    return statements


def _operation_name(operation):
    return next((name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == operation), operation)


def _lines(statements, slots, home, here):
    """C lines of one chunk: a value from another chunk is loaded from w at its first use, one for another is stored."""
    known, lines = set(), []
    for target, template, operands in statements:
        for v in operands:
            if isinstance(v, int) and home[v] != here and v not in known:
                known.add(v)
                lines.append(f"    const V a{v} = w[{slots[v]}];\n")
        text = template.format(*(v if isinstance(v, str) else f"a{v}" for v in operands))
        lines.append(f"    {text};\n" if target is None else f"    const V a{target} = {text};\n")
        if target in slots:
            lines.append(f"    w[{slots[target]}] = a{target};\n")
    return "".join(lines)


def _single(name, statements):
    home = {target: 0 for target, _, _ in statements}
    return f"\nvoid {name}({_SIGNATURE})\n{{\n{_lines(statements, {}, home, 0)}}}\n"


def _chunked(name, chunks):
    home = {target: here for here, chunk in enumerate(chunks) for target, _, _ in chunk if target is not None}
    slots, n_slots = _slots(chunks, home)
    functions = (
        f"\nstatic __attribute__((noinline)) void {name}_{here}({_SIGNATURE}, V *restrict w)\n{{\n"
        f"{_lines(chunk, slots, home, here)}}}\n"
        for here, chunk in enumerate(chunks)
    )
    calls = (f"    {name}_{here}(t, x, p, y, w);\n" for here in range(len(chunks)))
    return "".join(chain(functions, [f"\nvoid {name}({_SIGNATURE})\n{{\n    V w[{n_slots + 1}];\n"], calls, ["}\n"]))


def _slots(chunks, home):
    """Where each value that outlives its chunk is kept; a place is used again after the last chunk that reads it."""
    last = {
        v: here for here, chunk in enumerate(chunks) for _, _, operands in chunk for v in operands if isinstance(v, int)
    }
    expiring, free, slots, n_slots = [[] for _ in chunks], [], {}, 0
    for here, chunk in enumerate(chunks):
        free += expiring[here - 1] if here else []
        for target, _, _ in chunk:
            if target is not None and last.get(target, here) > home[target]:
                slots[target] = free.pop() if free else n_slots
                n_slots = max(n_slots, slots[target] + 1)
                expiring[last[target]].append(slots[target])
    return slots, n_slots
