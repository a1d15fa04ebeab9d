"""The C files of this package, and the constants that C and Python loops share."""

import functools
import hashlib
from importlib import resources

BISECTIONS = 20  # halvings of one time step in newton: a millionth of it is a lost solution, not a long step
ROUNDING = 2.0**-52  # a Newton correction this small relative to 1 + |x| cannot be reduced by another
NEAR = 1e-3  # largest error of a prediction for several points at once, relative to 1 + |x|
QUADRATIC = 1e-8  # a Newton correction this small leaves an error of the order of rounding

LOOPS = ("rk", "newton", "taylor", "radau", "closed", "law")  # files of these names; rk.c defines NAME_rk
INLINE_SINES = {"radau", "closed", "law"}  # loops with inlined sin and cos, within 2 units in the last place

SOURCES = resources.files("servoctl.codegen") / "c"


def source(name):
    """The text of a C file of this package, such as "rk.c"."""
    return (SOURCES / name).read_text(encoding="utf-8")


@functools.cache
def digest():
    """Hash of all C files: units include them by name, so that it belongs to the key of every library."""
    files = sorted((file.name, file.read_bytes()) for file in SOURCES.iterdir() if file.name.endswith((".c", ".h")))
    return hashlib.sha256(repr(files).encode()).hexdigest()
