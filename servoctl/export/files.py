"""C files of named functions: one C99 source and its header, with an enum of indices for every array."""

import re
import textwrap
import unicodedata
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servoctl.codegen import emit
from servoctl.errors import ServoError

WIDTH = 110  # of the lines of a file


@dataclass(frozen=True)
class Array:
    """An array of the interface, its indices an enum.

    Parameters
    ----------
    key : str
        Its name as an argument: m_load of p is `CRANE_P_m_load`, their number `CRANE_NP`.
    about : str
        What it is, for the header.
    names : sequence of str
        Of its entries.
    """

    key: str
    about: str
    names: tuple

    @property
    def size(self):
        """The C constant that holds its length."""
        return f"@@_N{self.key.upper()}"

    def given(self, name=""):
        """Itself as an input of a C function."""
        return f"const {self.changed(name)}"

    def changed(self, name=""):
        """Itself as an output of a C function."""
        return f"double {name or self.key}[{self.size}]" if len(self.names) else f"double *{name or self.key}"


@dataclass(frozen=True)
class Constant:
    """Numbers written into the C file.

    Parameters
    ----------
    name : str
        After the prefix and an underscore.
    values : float or (N,) array
    about : str
        What it is, for the header; empty for one that stays in the C file.
    """

    name: str
    values: object
    about: str = ""

    @property
    def declaration(self):
        """Its declaration without a value."""
        return f"const double @_{self.name}{f'[{len(self.values)}]' if np.ndim(self.values) else ''}"

    @property
    def text(self):
        """Its values as C."""
        literals = [emit.literal(float(value))[2:-1] for value in np.ravel(self.values)]
        lines = "".join(f"    {', '.join(literals[k : k + 4])},\n" for k in range(0, len(literals), 4))
        return f"{{\n{lines}}}" if np.ndim(self.values) else literals[0]


@dataclass(frozen=True)
class Routine:
    """A C function.

    Parameters
    ----------
    name : str
        After the prefix and an underscore.
    body : str or casadi.Function
        Statements; or an SX function of (t, x, p) with one dense column, whose arguments are t, x, p and y.
    about : str
        What it computes, for the header; empty for one that stays in the C file.
    arguments : sequence of str
        As the header shows them.
    result : {"void", "int"}
    """

    name: str
    body: object
    about: str = ""
    arguments: tuple = ()
    result: str = "void"

    @property
    def declaration(self):
        """Its declaration without a semicolon."""
        return f"{self.result} @_{self.name}({', '.join(self.arguments)})"


def write(folder, name, arrays, constants, routines):
    """Write NAME.c and NAME.h of any functions.

    Parameters
    ----------
    folder : str or Path
    name : str
        A C identifier; it takes the place of @ in the texts, in upper case that of @@.
    arrays : sequence of Array
    constants : sequence of Constant
    routines : sequence of Routine
        Each after those that it calls.

    Returns
    -------
    (Path, Path)

    Raises
    ------
    ServoError
        If the files cannot be written.
    """
    folder = Path(folder)
    texts = {f"{name}.c": _source(constants, routines), f"{name}.h": _header(arrays, constants, routines)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file, text in texts.items():
            text = _wrapped(text.replace("@@", name.upper()).replace("@", name))
            (folder / file).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ServoError(
            f"The C files cannot be written to {folder}: {error.strerror or error}.",
            "An export leaves a C file and its header in a folder.",
            do="Choose another folder.",
            folder=str(folder),
        ) from error
    return tuple(folder / file for file in texts)


def _header(arrays, constants, routines):
    parts = [
        f"/* @.h: written by servoctl {_version()}. SI units and radians; arrays must not overlap. */\n",
        '#ifndef @@_H\n#define @@_H\n\n#ifdef __cplusplus\nextern "C" {\n#endif\n',
    ]
    parts += [_comment(f"{array.about}.") + _enum(array) for array in arrays]
    parts += [_comment(f"{c.about}.") + f"extern {c.declaration};\n" for c in constants if c.about]
    parts += [_comment(r.about) + f"{r.declaration};\n" for r in routines if r.about]
    return "\n".join([*parts, "#ifdef __cplusplus\n}\n#endif\n\n#endif /* @@_H */\n"])


def _enum(array):
    used, lines = set(), []
    for i, name in enumerate(array.names):
        word = unique = identifier(name)
        while unique in used:
            unique = f"{word}_{i}"
        used.add(unique)
        told = "" if unique == name else f" /* {_harmless(name)} */"
        lines.append(f"    @@_{array.key.upper()}_{unique} = {i},{told}\n")
    return f"enum {{\n{''.join(lines)}    {array.size} = {len(array.names)}\n}};\n"


def _source(constants, routines):
    data = "".join(f"\n{'' if c.about else 'static '}{c.declaration} = {c.text};\n" for c in constants)
    functions = "".join(map(_definition, routines))
    first = f'/* @.c: written by servoctl {_version()}. C99; link with -lm. */\n#include "@.h"\n'
    return first + emit.prelude(functions) + data + functions


def _definition(routine):
    if isinstance(routine.body, str):
        return f"\n{routine.declaration}\n{{{routine.body}}}\n"
    if not routine.about:
        return emit.portable(routine.body, f"@_{routine.name}")
    arguments = ", ".join(re.search(r"\w+(?=\[|$)", text)[0] for text in routine.arguments)
    inner = emit.portable(routine.body, f"@_{routine.name}_f")
    return f"{inner}\n{routine.declaration}\n{{\n    @_{routine.name}_f({arguments});\n}}\n"


def _comment(text):
    return f"/* {_harmless(text)} */\n"


def _wrapped(text):
    """Long lines on several ones."""
    how = {"subsequent_indent": "    ", "break_long_words": False, "break_on_hyphens": False}
    return "".join(f"{textwrap.fill(x, WIDTH, **how) if len(x) > WIDTH else x}\n" for x in text.splitlines())


def _harmless(text):
    """Text inside a comment, which it must not end, nor begin another."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/")


def identifier(name):
    """A C identifier that reads like a name: Greek letters in words, underscores for what is neither letter nor digit.

    Parameters
    ----------
    name : str

    Returns
    -------
    str
    """
    letters = (c if c.isascii() else unicodedata.name(c, "_").split()[-1].lower() for c in name)
    word = re.sub(r"\W+", "_", "".join(letters), flags=re.ASCII).strip("_")
    return f"_{word}" if not word or word[0].isdigit() else word


def _version():
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("servoctl")
    except PackageNotFoundError:
        return "from its source"
