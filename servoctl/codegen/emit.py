"""C text from the instruction list of an SX function: the function itself and the loops that call it.

The function is a ``casadi.Function`` with inputs t (scalar), x (n_x), p (n_p) and one dense column output y (n_y). Its
statements are written for a number type ``V`` through ``K(constant)`` and ``v_sin(a)``, so that the same text serves
any type for which these are defined. A long function is cut into chunks, and the values that outlive a chunk are kept
in memory: compilers need more than linear time for one long function. Where several values are divided by one, as by a
pivot, its reciprocal multiplies them, which rounds twice instead of once: a division takes as long as eight products.
"""

import math
import re
from collections import Counter
from itertools import chain, count

import casadi as ca

from servoctl.codegen.loops import BISECTIONS, GRID, LOOPS, NEAR, PROJECTION, QUADRATIC, ROUNDING, circular, lanes
from servoctl.errors import SpecificationError, unknown

CHUNK = 350  # statements per C function: compile time is least, and flat, between 250 and 500
WIDE = 3000  # operations: up to here a function is emitted for eight points at once as well
SHARED = 2  # divisions by the same value: from here on its reciprocal is taken once, and multiplied with

_LIBM_1 = (
    "sqrt exp log expm1 log1p sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh fabs floor ceil erf"
).split()
_LIBM_2 = "pow fmin fmax fmod remainder atan2 copysign hypot".split()
_OWN_1 = "sign not erfinv".split()
_OWN_2 = "lt le eq ne and or if_else_zero".split()
_OPERATIONS = {name: ("a", name) for name in _LIBM_1} | {name: ("ab", name) for name in _LIBM_2}
_OPERATIONS |= {name: ("a", None) for name in _OWN_1} | {name: ("ab", None) for name in _OWN_2}

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

_AS_CASADI = """

int NAME_casadi(const double **arg, double **res, long long *iw, double *w, int mem)
{
    NAME(*arg[0], arg[1], arg[2], res[0]);
    return 0;
}
long long NAME_casadi_n_in(void) { return 3; }
long long NAME_casadi_n_out(void) { return 1; }
const long long *NAME_casadi_sparsity_in(long long i)
{
    static const long long dense[3][3] = {{1, 1, 1}, {N_X, 1, 1}, {N_P, 1, 1}};
    return dense[i];
}
const long long *NAME_casadi_sparsity_out(long long i)
{
    static const long long dense[3] = {N_Y, 1, 1};
    return dense;
}
"""

_SIGNATURE = "const V t, const V *restrict x, const V *restrict p, V *restrict y"


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


def emit(f, name, loops=(), chunk=CHUNK, project=None, others=None, drivers="", sizes=None, wide=True):
    """C translation unit of a function and of the loops over it.

    It defines ``void name(double t, const double *x, const double *p, double *y)`` (``y`` overlaps no input),
    ``name_point``, ``name_grid``, ``name_casadi``, which CasADi can call, and a ``name_LOOP`` for each loop asked for.

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
    others : dict of str to casadi.Function, optional
        Further SX functions of this form (their sizes may differ), which become ``name_KEY``.
    drivers : str
        C text to append, with the placeholders of the loops; with it sin and cos are our own, within 2 ulp, in line.
    sizes : dict of str to int, optional
        Constants ``name_KEY`` for the loops and drivers.
    wide : bool
        Whether grids, and Newton's method, may take eight points at once, by a second copy of f.

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
    for key, other in (others or {}).items():
        body += _function(other, f"{name}_{key}", chunk)
    wide = wide and operations(f) <= WIDE
    if wide:
        copies = _function(f, f"{name}_wide", chunk)
        if "newton" in loops:
            copies += _function(_first(f, f.numel_in(1)), f"{name}_wide_step", chunk)
        body += lanes(copies, _OPERATIONS)
    begin = _PRELUDE + (circular() if drivers and re.search(r"\bv_(sin|cos)\(", body) else "")
    wanted = [text for loop, text in LOOPS.items() if loop in loops]
    constants = f"#define NAME_wide_lanes {int(wide)}\n"
    constants += "".join(f"enum {{ NAME_{key} = {value} }};\n" for key, value in (sizes or {}).items())
    drivers = "".join((constants, _AS_CASADI, GRID, PROJECTION if project else "", *wanted, drivers))
    drivers = drivers.replace("NAME_PROJECT(", "NAME_restore(" if project else "(void)(")
    for key, value in {
        "N_X": f.numel_in(1),
        "N_P": f.numel_in(2),
        "N_Y": f.numel_out(0),
        "BISECTIONS": BISECTIONS,
        "ROUNDING": repr(ROUNDING),
        "QUADRATIC": repr(QUADRATIC),
        "NEAR": repr(NEAR),
        "NAME": name,
    }.items():
        drivers = drivers.replace(key, str(value))
    return begin + (_ERFINV if "v_erfinv" in body else "") + body + drivers


def _first(f, n):
    """The function of the first n outputs alone."""
    inputs = f.sx_in()
    return ca.Function(f.name(), inputs, [f(*inputs)[:n]])


def _function(f, name, chunk):
    """The text of one C function, in chunks where it is long."""
    statements = _with_reciprocals(_statements(f))
    chunks = [statements[k : k + chunk] for k in range(0, len(statements), chunk)]
    return _single(name, statements) if len(chunks) <= 1 else _chunked(name, chunks)


def literal(value):
    """A number as C text, exactly."""
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
            register[target[0]] = literal(f.instruction_constant(k))
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


def _with_reciprocals(statements):
    """The statements with one reciprocal for all divisions by the same value, where these are `SHARED` or more."""
    division, product = _TEMPLATES[ca.OP_DIV], _TEMPLATES[ca.OP_MUL]
    divisors = Counter(operands[1] for _, template, operands in statements if template == division)
    new = count(len(statements))
    reciprocal = {v: next(new) for v, n in divisors.items() if n >= SHARED and isinstance(v, int)}
    found, made = [], set()
    for target, template, operands in statements:
        if template == division and operands[1] in reciprocal:
            a, b = operands
            if b not in made:
                made.add(b)
                found.append((reciprocal[b], _TEMPLATES[ca.OP_INV], (b,)))
            template, operands = product, (a, reciprocal[b])
        found.append((target, template, operands))
    return found


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


def portable(f, name):
    """C99 text of one static function, without attributes and warnings, for a file that begins with `prelude`.

    Parameters
    ----------
    f : casadi.Function
        As `emit` takes it.
    name : str
        A C identifier.

    Returns
    -------
    str
    """
    text = _function(f, name, CHUNK).replace("__attribute__((noinline)) ", "")
    for begin, used in ((f"{_SIGNATURE})\n{{\n", "txpy"), (f"{_SIGNATURE}, V *restrict w)\n{{\n", "txpyw")):
        text = text.replace(begin, f"{begin}    {' '.join(f'(void){argument};' for argument in used)}\n")
    return text.replace(f"\nvoid {name}(", f"\nstatic void {name}(")


def several(text, n):
    """`portable` functions and loops over them, in terms of V and K, for n points at once."""
    return lanes(text, _OPERATIONS, n)


def prelude(text):
    """The beginning of a C file: of the definitions that `portable` functions need those that occur in the text."""
    lines = (_PRELUDE + (_ERFINV if "v_erfinv" in text else "")).splitlines(keepends=True)
    names = ((line, re.match(r"(?:#define|static inline V) (v_\w+)", line)) for line in lines)
    return "".join(line for line, name in names if name is None or re.search(rf"\b{name[1]}\b", text))
