"""Tables in C for piecewise constant values: the coefficients of splines, of which one piece counts at an instant.

CasADi writes a spline as sums over all its pieces. In C a value that is made of constants and of comparisons knot <= s
of one s is looked up: the number of knots that s has reached is its row in a table. The numbers are those of the sums,
to the last bit.
"""

import ctypes
import functools
import hashlib
import math
import re
from collections import Counter, defaultdict
from itertools import chain
from typing import NamedTuple

import numpy as np

from servoctl.jets.pieces import of_all_pieces, operand_values, piecewise_constant

BOUND = "/* bound */"  # begins the C line of a table that `bind` leads to its numbers
_bound = {}  # lookups by name
MARGIN = 1e-6  # of a cell of a table: how far rounding may lead beyond its ends


class Row(NamedTuple):
    """The operation that finds the row of a value s in a table, the number of knots that it has reached."""

    table: str

    def text(self, prefix, s):
        """C text."""
        return f"{prefix}row(&{self.table}_knots, {s})"


class Entry(NamedTuple):
    """The operation that takes the entry of a table in a row."""

    table: str
    columns: int
    column: int

    def text(self, prefix, row):
        """C text."""
        return f"{prefix}entry({self.table} + {self.column}, {self.columns}, {row})"


def tabulated(statements):
    """Statements with lookups in tables in place of sums over pieces, where that is shorter, and C texts of the tables.

    Statements (target, operation, operands) are in single assignment; operands are numbered values, constants, or C
    text of inputs. Fewer values are computed, and these are the same.
    """
    pieces = piecewise_constant(statements)
    others = (operands for target, _, operands in statements if target not in pieces)
    read = {v for operands in others for v in operand_values(operands) if v in pieces}
    pieces = _shorter(pieces, read)
    if not pieces:
        return statements, []
    columns = defaultdict(dict)
    for v, column in of_all_pieces(statements, pieces, read.intersection(pieces)):
        columns[pieces[v][0]][v] = column
    new, texts, lookups = 1 + max(target for target, _, _ in statements if isinstance(target, int)), [], {}
    for row, (s, entries) in enumerate(columns.items(), new):
        table, text = _table(pieces[next(iter(entries))][1], np.array([*entries.values()]).T)
        texts.append(text)
        for j, v in enumerate(entries):
            found = [(row, Row(table), (s,))] if j == 0 else []
            lookups[v] = [*found, (v, Entry(table, len(entries), j), (row,))]
    kept = (lookups.get(s[0], []) if s[0] in pieces else [s] for s in statements)
    return list(chain.from_iterable(kept)), texts


def literal(value):
    """A number as C text, exactly."""
    if math.isnan(value):
        return "NAN"
    text = "INFINITY" if math.isinf(value) else repr(abs(value))
    return f"(-{text})" if math.copysign(1.0, value) < 0 else text


def _shorter(pieces, read):
    """Those of each s whose table has no more entries than operations that it replaces."""
    replaced, entries = Counter(s for s, _ in pieces.values()), Counter()
    for s, knots in (pieces[v] for v in read):
        entries[s] += len(knots) + 1
    return {v: (s, knots) for v, (s, knots) in pieces.items() if entries[s] <= replaced[s]}


def _table(knots, rows):
    """Name and C text of a table: its knots with the rows that each cell of equal length may hold, and its rows.

    The name is that of the content, so that functions of one unit share a table.
    """
    name = f"table_{hashlib.sha256(knots.tobytes() + b'|' + rows.tobytes()).hexdigest()[:16]}"
    return name, _once(name, f"{_knots(name, knots)}static const double {name}[{rows.size}] = {_array(rows)};\n")


def _once(name, text):
    """C text that a unit may contain several times."""
    return f"\n#ifndef HAS_{name}\n#define HAS_{name}\n{text}#endif\n"


def _knots(name, knots):
    """C text of knots."""
    n, numbers, cells = len(knots), f"{len(knots)}, {', '.join(map(literal, _scale(knots)))}", _cells(knots)
    return (
        f"static const double {name}_at[{n}] = {_array(knots)};\n"
        f"static const int {name}_cells[{2 * n}] = {_array(cells)};\n"
        f"static const Knots {name}_knots = {{{numbers}, {name}_at, {name}_cells}};\n"
    )


def _scale(knots):
    """The first knot, and the number of cells per second."""
    return float(knots[0]), float(len(knots) / (knots[-1] - knots[0]))


def _cells(knots):
    """The first and the last row that each of n cells of equal length may hold, (n, 2)."""
    n, offsets = len(knots), knots - knots[0]
    cell = offsets[-1] / n
    edges = cell * np.arange(n + 1)
    low = np.searchsorted(offsets, edges[:-1] - MARGIN * cell, "right")
    high = np.searchsorted(offsets, edges[1:] + MARGIN * cell, "right")
    low[0], high[-1] = 0, n
    return np.array([low, high]).T


def lookup_operation(lookup):
    """The operation in C of a lookup."""
    return Row(lookup.name) if lookup.counts else Entry(lookup.name, 1, 0)


def lookup_text(lookup, whole):
    """C text that declares the numbers of a lookup; they are set by `bind`, or are part of the text as a whole."""
    name = lookup.name
    if whole:
        numbers = lookup.numbers
        entries = f"static const double {name}[{numbers.size}] = {_array(numbers)};\n"
        return _once(name, _knots(name, numbers) if lookup.counts else entries)
    _bound[name] = lookup
    return _once(name, f"{BOUND} Knots {name}_knots;\n" if lookup.counts else f"{BOUND} const double *{name};\n")


def bind(library, text):
    """Lead the tables that a C text leaves open to their numbers, which live as long as the process."""
    for name in re.findall(rf"^{re.escape(BOUND)} .*?((?:knots|entries)_\w+?)(?:_knots)?;$", text, re.MULTILINE):
        lookup = _bound[name]
        if not lookup.counts:
            ctypes.c_void_p.in_dll(library, name).value = lookup.numbers.ctypes.data
            continue
        knots, cells = lookup.numbers, _lasting_cells(name)
        place = _Knots.in_dll(library, f"{name}_knots")
        place.start, place.cells_per_second = _scale(knots)
        place.at, place.cells, place.n = knots.ctypes.data, cells.ctypes.data, len(knots)


@functools.cache
def _lasting_cells(name):
    return np.ascontiguousarray(_cells(_bound[name].numbers), dtype=np.intc)


class _Knots(ctypes.Structure):
    """`Knots` of table.h."""

    _fields_ = (
        ("n", ctypes.c_int),
        ("start", ctypes.c_double),
        ("cells_per_second", ctypes.c_double),
        ("at", ctypes.c_void_p),
        ("cells", ctypes.c_void_p),
    )


def _array(numbers):
    texts = [literal(x) for x in numbers.ravel().tolist()]
    return "{" + ",\n".join(", ".join(texts[k : k + 6]) for k in range(0, len(texts), 6)) + "}"
