"""Files of results: npz archives without pickle, and the errors where one cannot be written or read."""

import contextlib
import json
from pathlib import Path

import numpy as np

from servoctl.checks import as_path
from servoctl.errors import ServoError

FORMAT, SUFFIX = 1, ".npz"
MOST_LETTERS = 200  # of another package's message


@contextlib.contextmanager
def writing(path, what, folder=False):
    """A context for writing a file, or into a `folder`, which is made if missing; an OSError becomes a `ServoError`.

    `what` names the content: "run", "study", "figures".
    """
    path = as_path(path, f"The path of the {what}")
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
    path = _suffixed(as_path(path, f"The path of the {what}"))
    with writing(path, what):
        np.savez_compressed(path, meta=np.array(json.dumps({"format": FORMAT, **facts})), **arrays)
    return path


def _suffixed(path):
    return path if path.suffix == SUFFIX else Path(f"{path}{SUFFIX}")


def read(path, what, build):
    """`build(facts, arrays)` of an archive; `ServoError` if the file is damaged or not one of this kind.

    A missing suffix is added where there is no file without it.
    """
    path = as_path(path, f"The path of the {what}")
    try:
        path = path if path.is_file() else _suffixed(path)
        with np.load(path, allow_pickle=False) as data:
            facts = json.loads(str(data["meta"]))
            require(facts["format"] == FORMAT, f"its format is {facts['format']!r}, not {FORMAT}")
            return build(facts, data)
    except Exception as error:  # of zip, zlib, numpy or json, or from what a damaged file says
        why = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise ServoError(
            f"{path} cannot be read as a {what}: {why[:MOST_LETTERS]}.",
            f"A {what} is read from an npz file that {what.capitalize()}.save wrote.",
            path=str(path),
            what=what,
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
        raise ServoError("xarray is not installed.", do="Install xarray, or use save.", package="xarray") from error
    attributes = {k: v if type(v) in (int, float, str) else json.dumps(v) for k, v in attributes.items()}
    return xarray.Dataset(variables, coords=coordinates, attrs=attributes)
