"""C text of an SX function from its instruction list, and translation units with loops over it.

The function is a ``casadi.Function`` with inputs t (scalar), x (n_x), p (n_p) and one dense column output y (n_y). A
`Dialect` defines how numbers are written: as ``double``, or as vectors whose lanes are points. A long function is cut
into chunks that share a work vector, because compilers need more than linear time for one long function. Where several
values have the same divisor, such as a pivot, they are multiplied with its reciprocal: a division takes as long as
eight products. This rounds twice instead of once.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from itertools import chain, count

import casadi as ca

from servoctl.codegen.loops import CONSTANTS, INLINE_SINES, LOOPS

CHUNK = 350  # statements per C function: compile time is least, and flat, between 250 and 500
WIDE = 3000  # operations: up to here a function is emitted for eight points at once as well
SHARED = 2  # divisions by the same value: from here on they become products with its reciprocal
SCALAR_FASTER = '#pragma GCC optimize("no-tree-slp-vectorize")\n'  # pairs of terms of a series cost more to gather

_ARITHMETIC = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{two} * {0}",
    ca.OP_INV: "{one} / {0}",
}
_UNARY = (
    "sqrt exp log expm1 log1p sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh fabs floor ceil erf "
    "sign not erfinv"
).split()
_BINARY = "pow fmin fmax fmod remainder atan2 copysign hypot lt le eq ne and or if_else_zero".split()
_ELEMENTARY = {getattr(ca, f"OP_{name.upper()}"): (name, 1) for name in _UNARY}
_ELEMENTARY |= {getattr(ca, f"OP_{name.upper()}"): (name, 2) for name in _BINARY} | {ca.OP_CONSTPOW: ("pow", 2)}
_COPIES = {ca.OP_ASSIGN, ca.OP_LIFT}  # the first operand, unchanged
_NOT_ARITHMETIC = {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT, *_COPIES}
EMITTED = frozenset({*_ARITHMETIC, *_ELEMENTARY, *_NOT_ARITHMETIC})  # instructions that have a C counterpart

_FORMS_OF_ONE = {
    "sign": "({0} < 0 ? -1 : {0} > 0 ? 1 : {0})",
    "not": "!{0}",
    "lt": "({0} < {1})",
    "le": "({0} <= {1})",
    "eq": "({0} == {1})",
    "ne": "({0} != {1})",
    "and": "({0} && {1})",
    "or": "({0} || {1})",
    "if_else_zero": "({0} ? {1} : 0)",
    "erfinv": "inverse_erf({0})",
}


@dataclass(frozen=True)
class Dialect:
    """How C writes the numbers and the head of a function.

    Attributes
    ----------
    number : str
        Type of the numbers.
    literal : str
        Format of a constant: {} is replaced by a C number.
    prefix : str
        Prefix of elementary functions.
    forms : dict of str to str
        Formats of the operations that are no call of an elementary function, by name.
    common : bool
        Whether all lanes share p, an array of ``double``.
    linkage : str
        Linkage of the function and of its chunks; without one, the chunks are static and not inlined.
    exact : bool
        Whether the operations are those of CasADi, one by one, without shared reciprocals.
    """

    number: str = "double"
    literal: str = "{}"
    prefix: str = ""
    forms: dict = field(default_factory=dict)
    common: bool = False
    linkage: str = ""
    exact: bool = False

    def constant(self, value):
        """A number as C text, exactly."""
        return self.literal.format(literal(value))

    def operand(self, array, i, suffix=""):
        """C text of t, or of an entry of x or p."""
        place = array if array == "t" else f"{array}{suffix}[{i}]"
        return self.literal.format(place) if array == "p" and self.common else place

    def expression(self, operation, operands):
        """C text of an operation on operands."""
        if operation in _ARITHMETIC:
            return _ARITHMETIC[operation].format(*operands, one=self.constant(1.0), two=self.constant(2.0))
        name, n = _ELEMENTARY[operation]
        if name in self.forms:
            return self.forms[name].format(*operands)
        return f"{self.prefix}{name}({', '.join(operands[:n])})"

    def head(self, name, suffixes=("",), work=False):
        """C text of a function up to its first statement."""
        number, shared = self.number, "double" if self.common else self.number
        arguments = [
            f"const {number} *restrict x{s}, const {shared} *restrict p{s}, {number} *restrict y{s}" for s in suffixes
        ]
        arguments = ", ".join([f"const {number} t", *arguments, *([f"{number} *restrict w"] if work else [])])
        linkage = self.linkage or ("static __attribute__((noinline)) " if work else "")
        used = "".join(f" (void){argument};" for argument in "txpyw"[: 5 if work else 4]) if self.linkage else ""
        return f"\n{linkage}void {name}({arguments})\n{{\n" + (f"   {used}\n" if used else "")


SCALAR = Dialect(forms=_FORMS_OF_ONE)
EXACT = Dialect(forms=_FORMS_OF_ONE, exact=True)
SCALAR_INLINE = Dialect(forms=_FORMS_OF_ONE | {"sin": "s_sin({0})", "cos": "s_cos({0})"})
PORTABLE = Dialect(forms=_FORMS_OF_ONE, linkage="static ")
WIDE_LANES = Dialect("W", "ALL({})", "w_")
LANES = Dialect("W", "ALL({})", "w_", linkage="static ")
LANES_INLINE = Dialect("W", "ALL({})", "w_", linkage="INLINE ")
LANES_COMMON = Dialect("W", "ALL({})", "w_", common=True, linkage="static ")


def operations(f):
    """Number of arithmetic instructions of an SX function: all but constants, inputs, outputs and copies."""
    instructions = ((f.instruction_id(k), f.instruction_input(k)) for k in range(f.n_instructions()))
    return sum(code not in _NOT_ARITHMETIC and not _copies(code, source) for code, source in instructions)


def _copies(operation, source):
    """Whether an instruction gives its first operand unchanged; copysign(c, c) keeps CasADi from rewriting c."""
    return operation in _COPIES or (operation == ca.OP_COPYSIGN and source[0] == source[1])


def emit(f, name, loops=(), *, project=None, others=None, sizes=None, wide=True, chunk=CHUNK):
    """C translation unit of a function and of loops over it; it includes files of `loops.SOURCES`.

    The unit defines ``void name(double t, const double *x, const double *p, double *y)`` (``y`` overlaps no input),
    ``name_point``, ``name_grid``, ``name_casadi`` in the form that CasADi calls, and the functions of each loop's file.

    Parameters
    ----------
    f : casadi.Function
        SX function (t, x, p) -> y of elementary operations (`EMITTED`).
    name : str
        A C identifier, the prefix of every external symbol.
    loops : sequence of {"rk", "newton", "taylor", "radau", "closed", "law"}
        Files to include.
    project : casadi.Function, optional
        SX function (t, x, p) -> change of x that restores invariants; loops may call it after their steps.
    others : dict of str to casadi.Function, optional
        Further SX functions of this form, with sizes of their own, which become ``name_KEY``.
    sizes : dict of str to int, optional
        Constants of the loops; their names are in capitals in C.
    wide : bool
        Whether grids and Newton's method may evaluate eight points at once, by a second copy of f.
    chunk : int
        Largest number of statements in one C function.

    Returns
    -------
    str
        The same text for the same function, name and loops, in every process.
    """
    dialect = SCALAR_INLINE if INLINE_SINES.intersection(loops) else SCALAR
    scalar = {name: f} | ({} if project is None else {f"{name}_project": project})
    scalar |= {f"{name}_{key}": other for key, other in (others or {}).items()}
    parts = [function(other, key, dialect, chunk) for key, other in scalar.items()]
    wide = wide and operations(f) <= WIDE
    if wide:
        copies = {f"{name}_wide": f} | ({f"{name}_wide_step": _first(f, f.numel_in(1))} if "newton" in loops else {})
        parts += [include("lanes.h"), *(function(copy, key, WIDE_LANES, chunk) for key, copy in copies.items())]
    constants = {"NAME": name, "NX": f.numel_in(1), "NP": f.numel_in(2), "NY": f.numel_out(0)}
    constants |= {"PROJECTED": ""} if project is not None else {}
    constants |= {"WIDE": ""} if wide else {}
    constants |= {"PIVOTS": 0} if "newton" in loops else {}
    constants |= {key.upper(): int(value) for key, value in (sizes or {}).items()}
    files = ["grid.c", *(f"{loop}.c" for loop in LOOPS if loop in loops)]
    return "".join((SCALAR_FASTER if "taylor" in loops else "", unit(constants), *parts, *map(include, files)))


def emit_builtin(f, name):
    """C translation unit of the builtin function of Python ``name``, with the operations of CasADi, one by one."""
    constants = {"NAME": name, "NX": f.numel_in(1), "NP": f.numel_in(2), "NY": f.numel_out(0)}
    return "".join((unit(constants), function(f, name, EXACT), include("builtin.c")))


def unit(constants):
    """Head of a translation unit: #define lines of constants by name, and `unit.h`."""
    lines = (f"#define {key} {value}\n" for key, value in (CONSTANTS | constants).items())
    return "".join(("#include <math.h>\n#include <stdint.h>\n", *lines, include("unit.h")))


def include(name):
    """C line that includes a file."""
    return f'#include "{name}"\n'


def _first(f, n):
    inputs = f.sx_in()
    return ca.Function(f.name(), inputs, [f(*inputs)[:n]])


def function(f, name, dialect=SCALAR, chunk=CHUNK):
    """C text of one function y = f(t, x, p), cut into chunks of at most `chunk` statements."""
    statements = _statements(f, dialect) if dialect.exact else _with_reciprocals(_statements(f, dialect))
    chunks = [statements[k : k + chunk] for k in range(0, len(statements), chunk)]
    if len(chunks) > 1:
        return _chunked(name, chunks, dialect)
    return dialect.head(name) + "".join(_line(statement, dialect) for statement in statements) + "}\n"


def function_of_several(f, name, dialect, suffixes):
    """C text of y = f(t, x, p) for each suffix of x, p, y, with alternating statements: the processor overlaps them."""
    copies = [_with_reciprocals(_statements(f, dialect, suffix)) for suffix in suffixes]
    lines = (
        _line(statement, dialect, f"a{suffix}_")
        for statements in zip(*copies, strict=True)
        for suffix, statement in zip(suffixes, statements, strict=True)
    )
    return dialect.head(name, suffixes) + "".join(lines) + "}\n"


def literal(value):
    """A number as C text, exactly."""
    if math.isnan(value):
        return "NAN"
    text = "INFINITY" if math.isinf(value) else repr(abs(value))
    return f"(-{text})" if math.copysign(1.0, value) < 0 else text


def _statements(f, dialect, suffix=""):
    """Single assignments (target, operation, operands); values are numbered, inputs and outputs are C text."""
    register, statements, values = {}, [], 0
    for k in range(f.n_instructions()):
        operation, source, target = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if operation == ca.OP_INPUT:
            register[target[0]] = dialect.operand("txp"[source[0]], source[1], suffix)
        elif operation == ca.OP_CONST:
            register[target[0]] = dialect.constant(f.instruction_constant(k))
        elif operation == ca.OP_OUTPUT:
            statements.append((f"y{suffix}[{target[1]}]", ca.OP_ASSIGN, (register[source[0]],)))
        elif _copies(operation, source):
            register[target[0]] = register[source[0]]
        else:
            statements.append((values, operation, tuple(register[i] for i in source)))
            register[target[0]] = values
            values += 1
    return statements


def _with_reciprocals(statements):
    """The statements, with products by a reciprocal where `SHARED` or more divisions have the same divisor."""
    divisors = Counter(operands[1] for _, operation, operands in statements if operation == ca.OP_DIV)
    new = count(len(statements))
    reciprocal = {v: next(new) for v, n in divisors.items() if n >= SHARED and isinstance(v, int)}
    result, computed = [], set()
    for target, operation, operands in statements:
        if operation == ca.OP_DIV and operands[1] in reciprocal:
            a, b = operands
            if b not in computed:
                computed.add(b)
                result.append((reciprocal[b], ca.OP_INV, (b,)))
            operation, operands = ca.OP_MUL, (a, reciprocal[b])
        result.append((target, operation, operands))
    return result


def _line(statement, dialect, value="a"):
    """C line of a statement; a value's name is a letter and its number."""
    target, operation, operands = statement
    text = dialect.expression(operation, [v if isinstance(v, str) else f"{value}{v}" for v in operands])
    place = target if isinstance(target, str) else f"const {dialect.number} {value}{target}"
    return f"    {place} = {text};\n"


def _chunked(name, chunks, dialect):
    """C text of a function that calls its chunks, which share a work vector w."""
    home = {target: here for here, chunk in enumerate(chunks) for target, _, _ in chunk if isinstance(target, int)}
    slots, n_slots = _slots(chunks, home)
    functions = (
        f"{dialect.head(f'{name}_{here}', work=True)}{_chunk(chunk, slots, home, here, dialect)}}}\n"
        for here, chunk in enumerate(chunks)
    )
    calls = (f"    {name}_{here}(t, x, p, y, w);\n" for here in range(len(chunks)))
    work = f"    {dialect.number} w[{n_slots + 1}];\n"
    return "".join(chain(functions, [dialect.head(name), work], calls, ["}\n"]))


def _chunk(statements, slots, home, here, dialect):
    """C lines of a chunk: values of other chunks are loaded from w at their first use, values for others are stored."""
    known, lines = set(), []
    for statement in statements:
        target, _, operands = statement
        for v in operands:
            if isinstance(v, int) and home[v] != here and v not in known:
                known.add(v)
                lines.append(f"    const {dialect.number} a{v} = w[{slots[v]}];\n")
        lines.append(_line(statement, dialect))
        if target in slots:
            lines.append(f"    w[{slots[target]}] = a{target};\n")
    return "".join(lines)


def _slots(chunks, home):
    """Index in w of each value that outlives its chunk; it is free again after the last chunk that reads the value."""
    last = {
        v: here for here, chunk in enumerate(chunks) for _, _, operands in chunk for v in operands if isinstance(v, int)
    }
    expiring, free, slots, n_slots = [[] for _ in chunks], [], {}, 0
    for here, chunk in enumerate(chunks):
        free += expiring[here - 1] if here else []
        for target, _, _ in chunk:
            if isinstance(target, int) and last.get(target, here) > home[target]:
                slots[target] = free.pop() if free else n_slots
                n_slots = max(n_slots, slots[target] + 1)
                expiring[last[target]].append(slots[target])
    return slots, n_slots


def contains(f, operation):
    """Whether an SX function contains an operation, such as ``casadi.OP_ERFINV``."""
    return any(f.instruction_id(k) == operation for k in range(f.n_instructions()))
