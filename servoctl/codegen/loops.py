"""The C files of this package, and the constants that C and Python loops share."""

import functools
import hashlib
from pathlib import Path

CORRECTIONS = 30  # of one point by Newton's method, at most
CORRECTED = 1e-13  # a Newton correction this small relative to 1 + |x| ends the iteration
ROUNDING = 2.0**-52  # a Newton correction this small relative to 1 + |x| cannot be reduced by another
QUADRATIC = 1e-8  # a Newton correction this small leaves an error of the order of rounding
CONTRACTION = 0.25  # largest ratio of two Newton corrections at one instant: another solution is four times as far away
FOLLOWED = 0.02  # largest error of a step's prediction, relative to the way of the step
STEADY = 0.25  # smallest ratio of a pivot to itself in a step: none is jumped over, none loses its digits in one step
SHORTEST = 2.0**-32  # of the longest step in a piece: the path ends where a shorter one would be needed
TERMS = 4  # coefficients of a Taylor series whose growth gives the step: two even ones and two odd ones
LAST_TERM = 0.1  # of the tolerance, at the end of a step: the terms that are left out and earlier errors add to it
REST = 1000  # log2 of the longest step of a Taylor series [s]
BEND = 0.344  # of the parabola in place of log2 between powers of two

CONSTANTS = {  # that C needs by name
    "CORRECTIONS": CORRECTIONS,
    "CORRECTED": CORRECTED,
    "ROUNDING": ROUNDING,
    "QUADRATIC": QUADRATIC,
    "CONTRACTION": CONTRACTION,
    "FOLLOWED": FOLLOWED,
    "STEADY": STEADY,
    "SHORTEST": SHORTEST,
    "TERMS": TERMS,
    "LAST_TERM": LAST_TERM,
    "BEND": BEND,
    "REST": REST,
}

LOOPS = ("rk", "newton", "taylor", "radau", "closed", "law")  # files of these names; rk.c defines NAME_rk
INLINE_SINES = {"radau", "closed", "law"}  # loops with inlined sin and cos, within 2 units in the last place
PHASED = frozenset({"rk", "newton", "radau"})  # loops that evaluate at one instant again and again

SOURCES = Path(__file__).with_name("c")


def source(name):
    """The text of a C file of this package, such as "rk.c"."""
    return (SOURCES / name).read_text(encoding="utf-8")


@functools.cache
def digest():
    """Hash of all C files, which units include by name, and of what writes units: a part of each library's key."""
    files = sorted((f.name, f.read_bytes()) for f in (*SOURCES.glob("*.[ch]"), *Path(__file__).parent.glob("*.py")))
    return hashlib.sha256(repr(files).encode()).hexdigest()
