"""Files of results: npz archives without pickle, and the errors where one cannot be written or read."""

import contextlib
import json
from pathlib import Path

import numpy as np

from servoctl.checks import as_path
from servoctl.errors import ServoError
from servoctl.units import with_unit

FORMAT, SUFFIX = 1, ".npz"  # of files: others are refused
MOST_LETTERS = 200  # of another package's message
FORMULA = ("=", "+", "-", "@", "\t", "\n")  # how texts begin that spreadsheets evaluate


@contextlib.contextmanager
def writing(path, what, folder=False):
    """A context for writing a file, or into a `folder`, which is made if missing; an OSError becomes a `ServoError`.

    `what` names the content: "run", "study", "figures".
    """
    path = as_path(path, "The path of what was saved")
    try:
        (path if folder else path.parent).mkdir(parents=True, exist_ok=True)
        yield path
    except (OSError, UnicodeError) as error:
        raise ServoError(
            f"The {what} cannot be written to {str(path)!r}: {getattr(error, 'strerror', None) or error}.",
            do="Choose another path; nothing that was computed is lost.",
            path=str(path),
            what=what,
        ) from error


def save(path, what, facts, arrays):
    """Write arrays and JSON-able facts as npz and return the path; a missing suffix is added."""
    path = _suffixed(as_path(path, "The path of what was saved"))
    with writing(path, what):
        np.savez_compressed(path, meta=np.array(json.dumps({"format": FORMAT, **facts})), **arrays)
    return path


def table(path, what, columns, units):
    """Write columns by name as CSV: a line of names with their units [N], one line for each row; returns the path.

    A text that spreadsheets would take for a formula, as it begins with =, +, - or @, has a ' before it.
    """
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    head = [with_unit(name, units.get(name, "")) for name in columns]
    with writing(path, what) as path:
        with open(path, "w", newline="", encoding="utf-8", errors="backslashreplace") as file:
            import csv

            lines = csv.writer(file, lineterminator="\n")
            lines.writerows([_cell(value) for value in row] for row in (head, *rows))
    return path


def _cell(value):
    if not isinstance(value, str):
        return value
    text = value.replace("\r\n", "\n").replace("\r", "\n")  # the csv module quotes no carriage return
    return f"'{text}" if text.startswith(FORMULA) else text


def frame(columns, units, index=None):
    """A pandas.DataFrame of columns by name, with `attrs["units"]`. `ServoError` without pandas."""
    try:
        import pandas
    except ImportError as error:
        raise _missing("pandas", "to_xarray or csv") from error
    table = pandas.DataFrame(columns)
    table.attrs["units"] = {name: units[name] for name in columns if units.get(name)}
    return table if index is None else table.set_index(index)


def _missing(package, other):
    return ServoError(
        f"{package} is not installed.",
        f"Tables of {package} need it; the extra servoctl[io] has it.",
        do=f"Install {package}, or use {other}.",
        package=package,
    )


def _suffixed(path):
    return path if path.suffix == SUFFIX else Path(f"{path}{SUFFIX}")


def read(path, build):
    """`build(facts, arrays)` of an archive; `ServoError` if the file is damaged or no archive.

    A missing suffix is added where there is no file without it.
    """
    path = as_path(path, "The path of what was saved")
    try:
        path = path if path.is_file() else _suffixed(path)
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:  # NumPy leaves damaged ones open
            facts = json.loads(str(data["meta"]))
            require(facts["format"] == FORMAT, f"its format is {facts['format']!r}, not {FORMAT}")
            return build(facts, data)
    except Exception as error:  # of zip, zlib, numpy or json, or from what a damaged file says
        why = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise ServoError(
            f"{path} cannot be read: {why[:MOST_LETTERS]}.",
            "It is no npz file that `save` of a run, a loop or a study wrote, or not a whole one.",
            path=str(path),
        ) from error


def require(holds, otherwise):
    """Raise ValueError with a text unless something holds of an archive."""
    if not holds:
        raise ValueError(otherwise)


def named(names):
    """A list of distinct texts from an archive."""
    require(isinstance(names, list) and all(isinstance(name, str) for name in names), f"its names are {names!r}")
    require(len(set(names)) == len(names), "a name occurs twice")
    return names


def numbers(arrays, name, *sizes):
    """An array of real numbers from an archive, of these sizes; None stands for any."""
    array = arrays[name]
    right = array.ndim == len(sizes) and all(n in (None, m) for n, m in zip(sizes, array.shape, strict=True))
    require(right, f"{name} has the shape {array.shape}")
    require(array.dtype.kind in "fiub", f"{name} has the type {array.dtype}")
    return array


def dataset(variables, coordinates, attributes):
    """An xarray.Dataset; attributes other than numbers and texts become JSON. `ServoError` without xarray."""
    try:
        import xarray
    except ImportError as error:
        raise _missing("xarray", "save or csv") from error
    attributes = {k: v if type(v) in (int, float, str) else json.dumps(v) for k, v in attributes.items()}
    return xarray.Dataset(variables, coords=coordinates, attrs=attributes)
