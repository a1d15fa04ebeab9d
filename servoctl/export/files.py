"""C files of named functions: a C99 source and its header, with an enum of indices for every array."""

import re
import textwrap
import unicodedata
from dataclasses import field
from importlib import resources

import casadi as ca
import numpy as np

from servoctl import archive
from servoctl.codegen import emit
from servoctl.codegen.loops import source
from servoctl.jets.branches import contains
from servoctl.units import unit_of
from servoctl.values import frozen

WIDTH = 110  # longest line of a file
FUNCTIONS = (  # of math.h, which has each for floats with the suffix f
    "acos|acosh|asin|asinh|atan|atan2|atanh|ceil|copysign|cos|cosh|erf|exp|expm1|fabs|floor|fma|fmax|fmin|fmod|hypot|"
    "log|log1p|pow|sin|sinh|sqrt|tan|tanh"
)
LARGEST_FLOAT = float(np.finfo(np.float32).max)


@frozen
class Array:
    """An array of the interface, with an enum of its indices.

    Its `key` is its name as an argument: p gives the indices `CRANE_P_m_load` and the length `CRANE_NP`.
    """

    key: str
    about: str  # description in the header
    names: tuple  # of the entries
    units: dict = field(default_factory=dict)  # those that are known, by name (`servoctl.units`), for comments

    def length(self, prefix):
        """C constant with its length."""
        return f"{prefix.upper()}_N{self.key.upper()}"

    def input(self):
        """Input argument of a C function."""
        return Argument(self, self.key, "const double")

    def output(self, name=""):
        """Output argument of a C function."""
        return Argument(self, name or self.key, "double")


@frozen
class Argument:
    """An array as a named argument of a C function."""

    array: Array
    name: str
    kind: str

    def declaration(self, prefix):
        """C declaration."""
        places = f"{self.name}[{self.array.length(prefix)}]" if len(self.array.names) else f"*{self.name}"
        return f"{self.kind} {places}"


@frozen
class Scalar:
    """A number as an argument of a C function."""

    name: str

    def declaration(self, prefix):
        """C declaration."""
        return f"double {self.name}"


@frozen
class Constant:
    """Numbers written into the C file."""

    name: str  # in C; a public constant has the prefix and an underscore before it
    values: object  # float or (N,) array
    about: str = ""  # description in the header; "" for a constant that is not public

    @property
    def kind(self):
        """C type: whole numbers are int."""
        return "int" if np.asarray(self.values).dtype.kind == "i" else "double"

    def declaration(self, prefix):
        """C declaration without a value."""
        name = f"const double {prefix}_{self.name}" if self.about else f"static const {self.kind} {self.name}"
        return f"{name}[{len(self.values)}]" if np.ndim(self.values) else name

    @property
    def text(self):
        """C text of the values."""
        values = np.ravel(self.values).tolist()
        literals = [str(v) if self.kind == "int" else emit.literal(float(v)).strip("()") for v in values]
        lines = "".join(f"    {', '.join(literals[k : k + 4])},\n" for k in range(0, len(literals), 4))
        return f"{{\n{lines}}}" if np.ndim(self.values) else literals[0]


@frozen
class Routine:
    """A public C function, which calls the static function of the same name."""

    name: str  # after the prefix and an underscore
    about: str  # description in the header
    arguments: tuple  # of Argument and Scalar
    result: str = "void"  # "void" or "int"

    def declaration(self, prefix):
        """C declaration without a semicolon."""
        arguments = ", ".join(argument.declaration(prefix) for argument in self.arguments)
        return f"{self.result} {prefix}_{self.name}({arguments})"

    def definition(self, prefix):
        """C definition; the static function takes jets of references `ref` at the end of its parameters."""
        names = [argument.name for argument in self.arguments]
        joined = "    double all[NALL];\n    join(p, ref, all);\n" if "ref" in names else ""
        names = ["all" if name == "p" else name for name in names if name != "ref"] if joined else names
        call = f"{'return ' if self.result == 'int' else ''}{self.name}({', '.join(names)});"
        return f"\n{self.declaration(prefix)}\n{{\n{joined}    {call}\n}}\n"


@frozen
class Contents:
    """Contents of a C file and its header."""

    arrays: tuple  # of Array
    constants: tuple  # of Constant
    functions: dict  # static ones by name: SX functions of (t, x, p) with one dense column
    routines: tuple  # of Routine
    sources: tuple = ()  # files of the folder `sources`, and headers of `codegen/c`, whose functions may call these
    sizes: dict = field(default_factory=dict)  # macros of the sources, by name
    before: str = ""  # C text before the functions


def write(folder, name, contents, real="double"):
    """Write NAME.c and NAME.h; their two paths. `name`, a C identifier, is the prefix of all public names.

    `real` is the type of all numbers, "double" or "float". Raises ServoError if the files cannot be written.
    """
    texts = {f"{name}.c": _source(name, contents), f"{name}.h": _header(name, contents)}
    convert = _doubles if real == "double" else _floats
    texts = {file: _outside_comments(convert, text) for file, text in texts.items()}
    with archive.writing(folder, "C export", folder=True) as place:
        for file, text in texts.items():
            (place / file).write_text(_wrapped(text), encoding="utf-8")
    return tuple(place / file for file in texts)


def _header(name, contents):
    guard = f"{name.upper()}_H"
    parts = [
        f"/* {name}.h: written by servoctl {_version()}. SI units and radians; arrays must not overlap. */\n",
        f'#ifndef {guard}\n#define {guard}\n\n#ifdef __cplusplus\nextern "C" {{\n#endif\n',
    ]
    parts += [_comment(f"{array.about}.") + _enum(name, array) for array in contents.arrays]
    parts += [_comment(f"{c.about}.") + f"extern {c.declaration(name)};\n" for c in contents.constants if c.about]
    parts += [_comment(r.about) + f"{r.declaration(name)};\n" for r in contents.routines]
    return "\n".join([*parts, f"#ifdef __cplusplus\n}}\n#endif\n\n#endif /* {guard} */\n"])


def _enum(name, array):
    used, lines = set(), []
    for i, entry in enumerate(array.names):
        word = unique = identifier(entry)
        while unique in used:
            unique = f"{word}_{i}"
        used.add(unique)
        unit = unit_of(entry, array.units)
        said = " ".join(["" if unique == entry else entry, f"[{unit}]" if unit else ""]).strip()
        comment = f" /* {_harmless(said)} */" if said else ""
        lines.append(f"    {name.upper()}_{array.key.upper()}_{unique} = {i},{comment}\n")
    return f"enum {{\n{''.join(lines)}    {array.length(name)} = {len(array.names)}\n}};\n"


def _source(name, contents):
    functions = "".join(emit.function(f, key, emit.EXPORTED) for key, f in contents.functions.items())
    inverse = any(contains(f, ca.OP_ERFINV) for f in contents.functions.values())
    parts = [
        f'/* {name}.c: written by servoctl {_version()}. C99; link with -lm. */\n#include "{name}.h"\n',
        "#include <math.h>\n",
        *(f"#define {key} {emit.literal(value)}\n" for key, value in contents.sizes.items()),
        *(f"\n{c.declaration(name)} = {c.text};\n" for c in contents.constants),
        f"\n{source('inverse_erf.h')}" if inverse else "",
        contents.before,
        functions,
        *map(text_of, contents.sources),
        *(routine.definition(name) for routine in contents.routines),
    ]
    return "".join(parts)


def text_of(file):
    """The text of a source, with the headers that it includes."""
    sources = resources.files("servoctl.export") / "sources"
    text = source(file) if file.endswith(".h") else (sources / file).read_text(encoding="utf-8")
    return re.sub(r'#include "(.*)"\n', lambda found: "" if found[1] == "unit.h" else text_of(found[1]), text)


def _outside_comments(convert, text):
    """C text of which what is no comment is converted."""
    parts = re.split(r"(/\*.*?\*/)", text, flags=re.DOTALL)
    return "".join(part if part.startswith("/*") else convert(part) for part in parts)


def _doubles(code):
    """Infinity and NaN as doubles: those of math.h are floats."""
    return re.sub(r"\bNAN\b", "(double)NAN", re.sub(r"\bINFINITY\b", "HUGE_VAL", code))


def _floats(code):
    """Types, literals and functions of floats in place of those of doubles."""
    code = re.sub(r"\bdouble\b", "float", code)
    code = re.sub(rf"\b({FUNCTIONS})(?=\()", r"\1f", code)
    code = re.sub(r"\bHUGE_VAL\b", "HUGE_VALF", code).replace("DBL_EPSILON", "FLT_EPSILON")
    return re.sub(r"(?<![\w.])(\d+\.\d*(?:[eE][+-]?\d+)?|\.?\d+[eE][+-]?\d+)(?![\w.])", _float_literal, code)


def _float_literal(found):
    """A literal within the range of floats, with their digits."""
    value = np.float32(min(float(found[0]), LARGEST_FLOAT))
    text = f"{value:.9g}"
    return f"{text if '.' in text or 'e' in text else text + '.'}f"


def _comment(text):
    return f"/* {_harmless(text)} */\n"


def _wrapped(text):
    how = {"subsequent_indent": "    ", "break_long_words": False, "break_on_hyphens": False}
    return "".join(f"{textwrap.fill(x, WIDTH, **how) if len(x) > WIDTH else x}\n" for x in text.splitlines())


def _harmless(text):
    """Text that neither ends a C comment nor begins another, without marks that turn or hide what follows."""
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/")


def identifier(name):
    """The C identifier of a name: Greek letters are spelt out, other characters become underscores."""
    letters = (c if c.isascii() else unicodedata.name(c, "_").split()[-1].lower() for c in name)
    word = re.sub(r"\W+", "_", "".join(letters), flags=re.ASCII).strip("_")
    return f"_{word}" if not word or word[0].isdigit() else word


def _version():
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("servoctl")
    except PackageNotFoundError:
        return "from its source"
