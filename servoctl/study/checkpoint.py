"""The file in which a sweep keeps its rows while it runs: a line of JSON each, so that a killed process loses none."""

import hashlib
import json
import os
from pathlib import Path

from servoctl.errors import ServoError, SpecificationError

FORMAT = 1


def identity(name, cases, seed):
    """What sweeps must share for their rows to belong together: a digest of the case's name, the cases, the seed."""
    return hashlib.sha256(json.dumps([name, cases, seed]).encode()).hexdigest()


class Checkpoint:
    """Rows on disk: those of an earlier sweep are read, further ones appended and flushed as they come.

    The path None keeps nothing. `rows` is what was there; a last line that was cut off is dropped. A file of another
    sweep, or one that is no checkpoint, raises SpecificationError; one that cannot be opened ServoError.
    """

    def __init__(self, path, key):
        self.rows, self._file = [], None
        if path is not None:
            self._open(Path(path), key)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._file is not None:
            self._file.close()

    def _open(self, path, key):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
            whole = [line for line in lines if line.endswith("\n")]
            self.rows = _rows(path, whole, key)
            self._file = open(path, "r+b" if whole else "wb")
            self._file.truncate(len("".join(whole).encode()))
            self._file.seek(0, os.SEEK_END)
            if not whole:
                self.add({"servoctl_sweep": FORMAT, "identity": key})
        except OSError as error:
            raise ServoError(
                f"The checkpoint {path} cannot be opened: {error.strerror or error}.",
                "A checkpoint is a file that can be read and appended to.",
                do="Choose another path; nothing has been computed yet.",
                path=str(path),
            ) from error

    def add(self, row):
        """Append a row; it is on the disk when this returns."""
        if self._file is not None:
            self._file.write((json.dumps(row) + "\n").encode())
            self._file.flush()
            os.fsync(self._file.fileno())


def _rows(path, lines, key):
    """The rows of a checkpoint, if it belongs to the sweep with this identity."""
    try:
        header, *rows = (json.loads(line) for line in lines) if lines else ({"identity": key},)
        identity_there = header["identity"]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SpecificationError(
            f"{path} is no checkpoint of a sweep.",
            "A checkpoint has a line of JSON for each finished case.",
            do="Choose another path; the file was not changed.",
            path=str(path),
        ) from error
    if identity_there != key:
        raise SpecificationError(
            f"The checkpoint {path} belongs to other cases, another seed or another case function.",
            "A sweep goes on where its own checkpoint ends: rows of different sweeps form no table.",
            do="Give the same cases, seed and function, or another path; the file was not changed.",
            path=str(path),
            rows=len(rows),
        )
    return rows
