"""Files of results: npz archives without pickle, and what is said where one cannot be written or read."""

import contextlib
import json
from pathlib import Path

import numpy as np

from servoctl.errors import ServoError

FORMAT, SUFFIX = 1, ".npz"


@contextlib.contextmanager
def writing(path, what, folder=False):
    """Write below a folder that is made where it is missing; what the file system refuses is a `ServoError`.

    The path is a file, or the `folder` itself; `what` is written: "run", "study", "figures".
    """
    path = Path(path)
    try:
        (path if folder else path.parent).mkdir(parents=True, exist_ok=True)
        yield path
    except OSError as error:
        raise ServoError(
            f"The {what} cannot be written to {path}: {error.strerror or error}.",
            "Results are written where files may be created.",
            do="Choose another path; nothing that was computed is lost.",
            path=str(path),
        ) from error


def save(path, what, facts, arrays):
    """Write arrays and JSON-able facts as npz; a missing suffix is added. The path."""
    path = Path(path)
    path = path if path.suffix == SUFFIX else path.with_name(path.name + SUFFIX)
    with writing(path, what):
        np.savez_compressed(path, meta=np.array(json.dumps({"format": FORMAT, **facts})), **arrays)
    return path


def read(path, what, build):
    """What `build(facts, arrays)` makes of an archive; `ServoError` if there is none of this kind."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return build(json.loads(str(data["meta"])), data)
    except (OSError, KeyError, ValueError) as error:
        raise ServoError(
            f"{path} cannot be read as a {what}: {error}.",
            f"A {what} is an npz file written by {what.capitalize()}.save.",
            do="Check the path.",
            path=str(path),
        ) from error


def dataset(variables, coordinates, attributes):
    """An xarray.Dataset; attributes that are no numbers or texts become JSON. `ServoError` without xarray."""
    try:
        import xarray
    except ImportError as error:
        raise ServoError(
            "xarray is not installed.", "A Dataset is an xarray object.", do="Install xarray, or use save."
        ) from error
    attributes = {k: v if type(v) in (int, float, str) else json.dumps(v) for k, v in attributes.items()}
    return xarray.Dataset(variables, coords=coordinates, attrs=attributes)
