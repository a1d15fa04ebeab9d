"""`servoctl versions`: what a report of a fault should name. It works where NumPy or CasADi cannot be imported."""

import platform
from importlib.metadata import distributions

from servoctl.codegen.cache import cache_directory
from servoctl.codegen.compiler import compiler_in_words, processor
from servoctl.version import __version__

NEEDED = ("casadi", "numpy", "scipy", "control", "matplotlib", "tqdm")
OPTIONAL = ("xarray", "pandas", "dask", "mujoco", "pin", "heyoka", "sympy", "numba", "drake")


def add_versions(versions):
    """Add the arguments of the command: none."""
    versions.set_defaults(command=_versions)


def _versions(args):
    facts = {"servoctl": __version__, platform.python_implementation(): platform.python_version()}
    for name in (*NEEDED, *OPTIONAL):
        facts[name] = next((d.version for d in distributions(name=name)), "not found" if name in NEEDED else "")
    facts |= {"system": platform.platform(), "processor": processor()}
    facts |= {"compiler": compiler_in_words(), "cache": cache_directory()}
    print(*(f"{name:12}{fact}" for name, fact in facts.items() if fact), sep="\n")
    return 0
