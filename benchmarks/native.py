"""C text compiled outside servoctl: what the peers that are written in C need."""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

from servoctl.codegen.loops import SOURCES

COMPILER = shutil.which("gcc")
_directory = tempfile.TemporaryDirectory(prefix="servoctl-benchmarks-")


def build(text, *flags):
    """Path of the shared library of a C text, compiled afresh."""
    library = Path(tempfile.mkstemp(suffix=".so", dir=_directory.name)[1])
    subprocess.run(
        [COMPILER, *flags, "-w", "-march=native", f"-I{SOURCES}", "-fPIC", "-shared", "-x", "c", "-", "-o", library,
         "-lm"],
        input=text, text=True, check=True,
    )  # fmt: skip
    return library


def function(library, name, *arguments):
    """A void function of a shared library with arguments of these ctypes types."""
    found = ctypes.CDLL(str(library))[name]
    found.restype, found.argtypes = None, arguments
    return found


def casadi_text(f):
    """What CasADi generates for a function."""
    import casadi as ca

    generator = ca.CodeGenerator(f"{f.name()}_generated")
    generator.add(f)
    return generator.dump()
