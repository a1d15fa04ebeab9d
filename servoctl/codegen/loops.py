"""The C files of this package: loops over an emitted function, and what they and their counterparts in Python share."""

import functools
import hashlib
from importlib import resources

BISECTIONS = 20  # halvings of one time step in newton: a millionth of it is a lost solution, not a long step
ROUNDING = 2.0**-52  # a Newton correction this small relative to 1 + |x| cannot be reduced by another
NEAR = 1e-3  # relative to 1 + |x|: a prediction for several points at once that is worse is not trusted
QUADRATIC = 1e-8  # a Newton correction this small leaves an error of the order of rounding

LOOPS = ("rk", "newton", "taylor", "radau", "closed", "law")  # each a file of this name, which defines NAME_rk etc.
INLINE_SINES = {"radau", "closed", "law"}  # whose function takes sin and cos in line, within 2 units in the last place

SOURCES = resources.files("servoctl.codegen") / "c"


def source(name):
    """The text of a C file of this package.

    Parameters
    ----------
    name : str
        Of the file, such as "rk.c".

    Returns
    -------
    str
    """
    return (SOURCES / name).read_text(encoding="utf-8")


@functools.cache
def digest():
    """A hash of all C files, which belongs to the key of every library: units include them by name."""
    files = sorted((file.name, file.read_bytes()) for file in SOURCES.iterdir() if file.name.endswith((".c", ".h")))
    return hashlib.sha256(repr(files).encode()).hexdigest()
