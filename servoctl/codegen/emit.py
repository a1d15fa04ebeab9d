"""C text of an SX function from its instruction list, and translation units with loops over it.

The function is a ``casadi.Function`` with inputs t (scalar), x (n_x), p (n_p) and one dense column output y (n_y); a
fourth input are jets of references, which C takes from paths (see `codegen.paths`), into the first numbers of w. A
`Dialect` defines how numbers are written: as ``double``, or as vectors whose lanes are points. A long function is cut
into chunks that share a work vector, because compilers need more than linear time for one long function. Where several
values have the same divisor, such as a pivot, they are multiplied with its reciprocal: a division takes as long as
eight products. This rounds twice instead of once.
"""

import math
from collections import Counter
from dataclasses import field, replace
from itertools import chain, count

import casadi as ca

from servoctl.codegen.chains import Constant, short_chains, time_of
from servoctl.codegen.collecting import collected, ways
from servoctl.codegen.loops import CONSTANTS, INLINE_SINES, LOOPS, PHASED
from servoctl.codegen.paths import BY_INSTANT, jets_in
from servoctl.jets.branches import apply_code
from servoctl.values import frozen

CHUNK = 350  # statements per C function: compile time is least, and flat, between 250 and 500
WIDE = 3000  # operations: up to here a function is emitted for eight points at once as well
COLLECTED = 2000  # operations: up to here collecting like terms takes at most a third of a second
SHARED = 2  # divisions by the same value: from here on they become products with its reciprocal
PHASES = ("instant", "correction", "rest")  # of t and p alone; for a Newton correction; for the other outputs
SERIES = ("still", "moving")  # of p alone; all others
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
EMITTED = frozenset({*_ARITHMETIC, *_ELEMENTARY, *_NOT_ARITHMETIC})  # what has a C counterpart
SAME_BITS = EMITTED - {ca.OP_ERFINV}  # what C evaluates as CasADi does, point by point

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


@frozen
class Dialect:
    """How C writes the numbers and the head of a function."""

    number: str = "double"  # type of the numbers
    literal: str = "{}"  # format of a constant: {} is replaced by a C number
    prefix: str = ""  # of elementary functions
    forms: dict = field(default_factory=dict)  # formats, by name, of operations that call no elementary function
    common: bool = False  # whether all lanes share p, an array of double
    linkage: str = ""  # of the function and its chunks; without one, chunks are static and not inlined
    exact: bool = False  # whether operations are those of CasADi, one by one, without shared reciprocals
    whole: bool = False  # whether the text holds the numbers of paths; else p has their place in memory
    chained: bool = False  # whether each evaluation waits for the last: one chunk has the statements of `short_chains`
    collected: bool = False  # whether like terms of these are collected before

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
_OF_ZEROS = {"fmin": "({0} <= {1} || {1} != {1} ? {0} : {1})", "fmax": "({0} >= {1} || {1} != {1} ? {0} : {1})"}
EXACT = Dialect(forms=_FORMS_OF_ONE | _OF_ZEROS, exact=True)  # of 0 and -0 CasADi takes the first, as C need not
SCALAR_INLINE = Dialect(forms=_FORMS_OF_ONE | {"sin": "s_sin({0})", "cos": "s_cos({0})"})
SCALAR_CHAINED = replace(SCALAR_INLINE, chained=True, collected=True)
PORTABLE = Dialect(forms=_FORMS_OF_ONE, linkage="static ")
EXPORTED = replace(PORTABLE, whole=True)
WIDE_LANES = Dialect("W", "ALL({})", "w_")
LANES = Dialect("W", "ALL({})", "w_", linkage="static ")
LANES_INLINE = Dialect("W", "ALL({})", "w_", linkage="INLINE ", chained=True)
LANES_COMMON = Dialect("W", "ALL({})", "w_", common=True, linkage="static ")


def operations(f):
    """Number of arithmetic operations of an SX function in C: all but constants, inputs, outputs and copies."""
    return sum(isinstance(target, int) for target, _, _ in _statements(f, SCALAR))


def cost(f, dialect):
    """The time of a function in a dialect, in operations; see `time_of`."""
    return time_of(_prepared(f, dialect))


def other_ways(f):
    """Outputs equal to that of a short SX function (t, x, p) but for rounding, with like terms collected."""
    statements = _statements(f, SCALAR)
    if len(statements) > CHUNK:
        return []
    inputs = dict(zip("txpw", map(ca.vec, f.sx_in()), strict=False))
    return [_of_statements(way, inputs) for way in ways(statements)[1:]]


def _of_statements(statements, inputs):
    """The outputs of statements as an SX column; `inputs` by name."""
    values, outputs = {}, []

    def operand(v):
        if isinstance(v, str):
            name, _, index = v.rstrip("]").partition("[")
            return inputs[name][int(index or 0)]
        return ca.SX(v.value) if isinstance(v, Constant) else values[v]

    for target, operation, operands in statements:
        if isinstance(target, str):
            outputs.append(operand(operands[0]))
        else:
            value = apply_code(operation, *map(operand, operands))
            # CasADi would divide by c for a product with 1/c, which then were no value of its own
            values[target] = ca.copysign(value, value) if operation == ca.OP_INV else value
    return ca.vertcat(*outputs)


def _copies(operation, source):
    """Whether an instruction gives its first operand unchanged; copysign(c, c) keeps CasADi from rewriting c."""
    return operation in _COPIES or (operation == ca.OP_COPYSIGN and source[0] == source[1])


def emit(f, name, loops=(), *, project=None, others=None, sizes=None, wide=True, chunk=CHUNK):
    """C translation unit of a function and of loops over it; it includes files of `loops.SOURCES`.

    The unit defines ``void name(double t, const double *x, const double *p, double *y)`` (``y`` overlaps no input),
    ``name_point``, ``name_grid``, ``name_casadi`` in the form that CasADi calls, ``name_KEY`` for `others`, and the
    functions of each loop's file; for loops in `PHASED` also ``name_instant``, ``name_correction`` and ``name_rest``
    (see `phases`), for "taylor" ``name_still`` and ``name_moving`` (see `series`). `sizes`, with names in capitals, are
    constants of the loops; `wide` lets grids and Newton's method evaluate eight points at once, by a second copy of f;
    a C function has at most `chunk` statements. The same arguments give the same text in every process.
    """
    dialect = SCALAR_INLINE if INLINE_SINES.intersection(loops) else SCALAR
    dialect = SCALAR_CHAINED if "closed" in loops else dialect
    scalar = {name: f} | ({} if project is None else {f"{name}_project": project})
    scalar |= {f"{name}_{key}": other for key, other in (others or {}).items()}
    step = f.numel_in(1) if "newton" in loops else 0

    def emitted(part, name, dialect):
        if part is phased:
            return phases(f, name, given, dialect, chunk)
        return (series if part is f and "taylor" in loops else function)(part, name, dialect, chunk)

    phased = f if PHASED.intersection(loops) else None
    given = None if phased is None else by_phase(f, step)
    parts = [emitted(other, key, dialect) for key, other in scalar.items()]
    wide = wide and (operations(f) if phased is None else sum(map(len, given[0]))) <= WIDE
    if wide:
        parts += [include("lanes.h"), emitted(f, f"{name}_wide", WIDE_LANES)]
    constants = {"NAME": name, "NX": f.numel_in(1), "NP": f.numel_in(2), "NY": f.numel_out(0)}
    constants |= {"PROJECTED": ""} if project is not None else {}
    constants |= {"WIDE": ""} if wide else {}
    constants |= {"PIVOTS": 0} if "newton" in loops else {}
    constants |= {"SETTLED": ""} if "settled" in (others or {}) else {}
    constants |= definitions(sizes or {})
    files = ["grid.c", *(f"{loop}.c" for loop in LOOPS if loop in loops)]
    return "".join((SCALAR_FASTER if "taylor" in loops else "", unit(constants), *parts, *map(include, files)))


def emit_builtin(f, name):
    """C translation unit of the builtin function of Python ``name``, with the operations of CasADi, one by one."""
    constants = {"NAME": name, "NX": f.numel_in(1), "NP": f.numel_in(2), "NY": f.numel_out(0)}
    return "".join((unit(constants), function(f, name, EXACT), include("builtin.c")))


def emit_machine(width):
    """C translation unit of ``servoctl_machine``, which carries out lists of operations at `width` points at once."""
    moved = {"INPUT_": ca.OP_INPUT, "CONST_": ca.OP_CONST, "OUTPUT_": ca.OP_OUTPUT}
    copied = {operation: ca.OP_ASSIGN for operation in _COPIES}
    cases = (
        f"EACH({operation}, {EXACT.expression(copied.get(operation, operation), ('a', 'b'))})"
        for operation in sorted(SAME_BITS - {*moved.values()})
    )
    constants = {"NAME": "servoctl", "NX": 0, "NP": 0, "NY": 0, "WIDTH": width, **moved, "OPERATIONS": " ".join(cases)}
    return unit(constants) + include("machine.c")


def unit(constants):
    """Head of a translation unit: #define lines of constants by name, and `unit.h`."""
    lines = (f"#define {key} {value}\n" for key, value in (CONSTANTS | constants).items())
    return "".join(("#include <math.h>\n#include <stdint.h>\n", *lines, include("unit.h")))


def definitions(sizes):
    """Constants of loops by their names in C: numbers, and tuples of numbers as initialisers."""
    return {
        key.upper(): "{" + ", ".join(map(str, value)) + "}" if isinstance(value, tuple) else int(value)
        for key, value in sizes.items()
    }


def literal(value):
    """A number as C text, exactly."""
    if math.isnan(value):
        return "NAN"
    text = "INFINITY" if math.isinf(value) else repr(abs(value))
    return f"(-{text})" if math.copysign(1.0, value) < 0 else text


def include(name):
    """C line that includes a file."""
    return f'#include "{name}"\n'


def function(f, name, dialect=SCALAR, chunk=CHUNK):
    """C text of one function y = f(t, x, p), cut into chunks of at most `chunk` statements."""
    statements = _prepared(f, dialect)
    chunks, first, jets = _cut(statements, chunk), jets_in(f), _jets_line(f, dialect)
    if len(chunks) == 1:
        jets = f"    {dialect.number} w[{first}];\n{jets}" if first else ""
        return "".join((_paths(f, dialect), dialect.head(name), jets, *(_line(s, dialect) for s in statements), "}\n"))
    names = [f"{name}_{here}" for here in range(len(chunks))]
    text, size = _sharing(names, chunks, [0] * len(chunks), dialect, first)
    work = f"    {dialect.number} w[{size}];\n{jets}"
    return _paths(f, dialect) + text + dialect.head(name) + work + _calls(names) + "}\n"


def by_phase(f, step):
    """The statements of a function in each of the `PHASES`.

    Where Newton's method evaluates the first `step` outputs, like terms are collected, if that is faster.
    """
    statements = _statements(f, SCALAR)
    some = [_by_phase(_with_reciprocals(statements), step)]
    if step and len(statements) <= COLLECTED:
        some.append(_by_phase(collected(statements), step))
    return min(some, key=_time_of_newton)


def _time_of_newton(phases):
    """The operations of a solution at one instant, after two corrections."""
    instant, correction, rest = map(len, phases)
    return instant + 2 * correction + rest


def phases(f, name, given, dialect=SCALAR, chunk=CHUNK):
    """C text of one function y = f(t, x, p) in phases, `given` by `by_phase`, which share a vector w.

    ``name_instant`` computes what depends on t and p alone, ``name_correction`` the step of Newton's method,
    ``name_rest`` the other outputs. At one instant, corrections of several x may precede the rest, which completes
    the last one.
    """
    return _paths(f, dialect) + _in_phases(f, name, PHASES, given, dialect, chunk)


def series(f, name, dialect=SCALAR, chunk=CHUNK):
    """C text of one function y = f(t, x, p) of Taylor coefficients in two phases, which share a vector w.

    ``name_still`` computes what depends on p alone, ``name_moving`` the outputs.
    """
    still, parts = set(), ([], [])
    for statement in _prepared(f, dialect):
        target, _, operands = statement
        alone = isinstance(target, int) and all(_is_still(v, still) for v in operands)
        still.update([target] if alone else [])
        parts[not alone].append(statement)
    return _paths(f, dialect) + _in_phases(f, name, SERIES, parts, dialect, chunk)


def _is_still(operand, still):
    """Whether an operand depends on p alone, as some values do."""
    return operand in still if isinstance(operand, int) else isinstance(operand, Constant) or operand.startswith("p[")


def _in_phases(f, name, phases, parts, dialect, chunk):
    """C text of a function in phases, each with its statements, and of the function that calls all of them.

    The first phase of `PHASES`, and the second of `SERIES`, which has the time, computes jets of references.
    """
    parts = [_cut(part, chunk) for part in parts]
    wholes = [f"{name}_{phase}" for phase in phases]
    names = [[f"{w}_{k}" for k in range(len(c))] if len(c) > 1 else [w] for w, c in zip(wholes, parts, strict=True)]
    of = [k for k, chunks in enumerate(parts) for _ in chunks]
    timed, jets = phases.index("instant" if phases is PHASES else "moving"), _jets_line(f, dialect)
    at_begin = {names[timed][0]: jets} if jets else {}
    text, size = _sharing(list(chain(*names)), list(chain(*parts)), of, dialect, jets_in(f), at_begin)
    static = replace(dialect, linkage="static ")
    for whole, some in zip(wholes, names, strict=True):
        text += static.head(whole, work=True) + _calls(some) + "}\n" if len(some) > 1 else ""
    together = dialect.head(name) + f"    {dialect.number} w[WORK];\n" + _calls(wholes) + "}\n"
    return f"\n#define WORK {size}\n{text}{together}"


def function_of_several(f, name, dialect, suffixes):
    """C text of y = f(t, x, p) for each suffix of x, p, y, with alternating statements: the processor overlaps them."""
    copies = [_prepared(f, dialect, suffix) for suffix in suffixes]
    lines = (
        _line(statement, dialect, f"a{suffix}_")
        for statements in zip(*copies, strict=True)
        for suffix, statement in zip(suffixes, statements, strict=True)
    )
    return "".join((dialect.head(name, suffixes), *lines, "}\n"))


def _prepared(f, dialect, suffix=""):
    """The statements of a function, with reciprocals."""
    statements = _statements(f, dialect, suffix)
    if not dialect.exact:
        chained = dialect.chained and len(statements) <= CHUNK
        some = ways(statements) if chained and dialect.collected else [statements]
        statements = min(map(short_chains, some), key=time_of) if chained else _with_reciprocals(statements)
    return statements


def _paths(f, dialect):
    """C text by which a function takes jets from paths in memory, if any."""
    if not jets_in(f) or dialect.whole:
        return ""
    name = f"{dialect.prefix.upper()}PATH_JETS"
    once = f"#ifndef HAS_{name}_{(order := _highest(f))}\n#define HAS_{name}_{order}\n{name}({order})\n#endif\n"
    return include("path_lanes.h" if dialect.prefix else "path.h") + once


def _highest(f):
    """The highest derivative among them."""
    return f.size2_in(3) - 1


def _jets_line(f, dialect):
    """C line that takes the jets at t from the paths at p[0], of the piece that the last number of p may select.

    In text that is whole, `references` has the paths.
    """
    if not jets_in(f):
        return ""
    if dialect.whole:
        return f"    references(t, {_highest(f)}, w);\n"
    paths = dialect.operand("p", 0)
    instant = dialect.operand("p", f.numel_in(2) - 1) if f.name_in(3) == BY_INSTANT else "t"
    return f"    {dialect.prefix}path_jets_{_highest(f)}({paths}, {instant}, t, {f.size1_in(3)}, w);\n"


def _statements(f, dialect, suffix=""):
    """Single assignments (target, operation, operands).

    Values are numbered; inputs and outputs are C text.
    """
    register, statements, values = {}, [], 0
    for k in range(f.n_instructions()):
        operation, source, target = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if operation == ca.OP_INPUT:
            register[target[0]] = dialect.operand("txpw"[source[0]], source[1], suffix)
        elif operation == ca.OP_CONST:
            register[target[0]] = Constant(f.instruction_constant(k))
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
    new = count(1 + max((target for target, _, _ in statements if isinstance(target, int)), default=0))
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
    text = dialect.expression(operation, [_operand_text(v, dialect, value) for v in operands])
    place = target if isinstance(target, str) else f"const {dialect.number} {value}{target}"
    return f"    {place} = {text};\n"


def _by_phase(statements, step):
    """The statements of each of the `PHASES`, in order; outputs are written by the step or the rest."""
    moving, needed = set(), {f"y[{k}]" for k in range(step)}
    for target, _, operands in statements:
        if isinstance(target, str) or any(v in moving or str(v).startswith("x") for v in operands):
            moving.add(target)
    for target, _, operands in reversed(statements):
        if target in needed:
            needed.update(operands)
    phase = [0 if s[0] not in moving else 1 if s[0] in needed else 2 for s in statements]
    return [[s for s, k in zip(statements, phase, strict=True) if k == here] for here in range(len(PHASES))]


def _cut(statements, chunk):
    """The statements in chunks, at least one."""
    return [statements[k : k + chunk] for k in range(0, max(len(statements), 1), chunk)]


def _calls(names):
    return "".join(f"    {name}(t, x, p, y, w);\n" for name in names)


def _operand_text(operand, dialect, value):
    """C text of an operand."""
    if isinstance(operand, Constant):
        return dialect.constant(operand.value)
    return operand if isinstance(operand, str) else f"{value}{operand}"


def _sharing(names, chunks, of, dialect, first=0, at_begin=None):
    """C text of functions, one for each chunk, that share a work vector w, and its length.

    `of` are the phases of the chunks: a function that is the only one of its phase may be inlined. The `first` numbers
    of w are jets of references; `at_begin` has lines with which some functions begin, by name.
    """
    home = {target: here for here, chunk in enumerate(chunks) for target, _, _ in chunk if isinstance(target, int)}
    slots, n_slots = _slots(chunks, home, of, first)
    text = "".join(
        f"{(replace(dialect, linkage='static ') if of.count(k) == 1 else dialect).head(name, work=True)}"
        f"{(at_begin or {}).get(name, '')}{_chunk(chunk, slots, home, here, dialect)}}}\n"
        for here, (name, chunk, k) in enumerate(zip(names, chunks, of, strict=True))
    )
    return text, n_slots + 1


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


def _slots(chunks, home, of, first):
    """Index in w, at least `first`, of each value that outlives its chunk, and the number of indices.

    An index is free again after the last chunk that reads the value, unless that is of another phase, which may be
    repeated.
    """
    last = {}
    for here, chunk in enumerate(chunks):
        for v in chain.from_iterable(operands for _, _, operands in chunk):
            if isinstance(v, int):
                last[v] = here if of[here] == of[home[v]] else len(chunks)
    expiring, free, slots, n_slots = [[] for _ in range(len(chunks) + 1)], [], {}, first
    for here, chunk in enumerate(chunks):
        free += expiring[here - 1] if here else []
        for target, _, _ in chunk:
            if isinstance(target, int) and last.get(target, here) > home[target]:
                slots[target] = free.pop() if free else n_slots
                n_slots = max(n_slots, slots[target] + 1)
                expiring[last[target]].append(slots[target])
    return slots, n_slots
