"""Files of results: npz archives without pickle, and the errors where one cannot be written or read."""

import contextlib
import json
from pathlib import Path

import numpy as np

from servoctl.errors import ServoError

FORMAT, SUFFIX = 1, ".npz"


@contextlib.contextmanager
def writing(path, what, folder=False):
    """A context for writing a file, or into a `folder`, which is made if missing; an OSError becomes a `ServoError`.

    `what` names the content: "run", "study", "figures".
    """
    path = Path(path)
    try:
        (path if folder else path.parent).mkdir(parents=True, exist_ok=True)
        yield path
    except OSError as error:
        raise ServoError(
            f"The {what} cannot be written to {path}: {error.strerror or error}.",
            do="Choose another path; nothing that was computed is lost.",
            path=str(path),
            what=what,
        ) from error


def save(path, what, facts, arrays):
    """Write arrays and JSON-able facts as npz and return the path; a missing suffix is added."""
    path = _suffixed(path)
    with writing(path, what):
        np.savez_compressed(path, meta=np.array(json.dumps({"format": FORMAT, **facts})), **arrays)
    return path


def _suffixed(path):
    path = Path(path)
    return path if path.suffix == SUFFIX else path.with_name(path.name + SUFFIX)


def read(path, what, build):
    """`build(facts, arrays)` of an archive; `ServoError` if the file is not one of this kind.

    A missing suffix is added where there is no file without it.
    """
    path = Path(path) if Path(path).is_file() else _suffixed(path)
    try:
        with np.load(path, allow_pickle=False) as data:
            return build(json.loads(str(data["meta"])), data)
    except (OSError, KeyError, ValueError) as error:
        raise ServoError(
            f"{path} cannot be read as a {what}: {error}.",
            f"A {what} is read from an npz file that {what.capitalize()}.save wrote.",
            path=str(path),
            what=what,
        ) from error


def dataset(variables, coordinates, attributes):
    """An xarray.Dataset; attributes other than numbers and texts become JSON. `ServoError` without xarray."""
    try:
        import xarray
    except ImportError as error:
        raise ServoError("xarray is not installed.", do="Install xarray, or use save.", package="xarray") from error
    attributes = {k: v if type(v) in (int, float, str) else json.dumps(v) for k, v in attributes.items()}
    return xarray.Dataset(variables, coords=coordinates, attrs=attributes)
