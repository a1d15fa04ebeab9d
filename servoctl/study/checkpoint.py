"""Checkpoints: a sweep writes each finished row as a line of JSON, so that a killed process loses none."""

import hashlib
import json
import os
from pathlib import Path

from servoctl.errors import ServoError, SpecificationError

FORMAT = 1


def identity(name, cases, seed):
    """A digest of the case's name, the cases and the seed: rows form one table if it is the same."""
    return hashlib.sha256(json.dumps([name, cases, seed]).encode()).hexdigest()


class Checkpoint:
    """Rows on disk: `rows` are those of an earlier sweep, further ones are appended and flushed as they come.

    With the path None nothing is written. A file of another sweep, or one that is no checkpoint, raises
    SpecificationError; one that cannot be opened raises ServoError.
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
            whole = [line for line in lines if line.endswith("\n")]  # a killed process leaves half a line
            self.rows = _rows(path, whole, key)
            self._file = open(path, "r+b" if whole else "wb")
            self._file.truncate(len("".join(whole).encode()))
            self._file.seek(0, os.SEEK_END)
            if not whole:
                self.add({"servoctl_sweep": FORMAT, "identity": key})
        except OSError as error:
            raise ServoError(
                f"The checkpoint {path} cannot be opened: {error.strerror or error}.",
                "A checkpoint must be readable and writable.",
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
        written_for = header["identity"]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SpecificationError(
            f"{path} is no checkpoint of a sweep.",
            "A checkpoint has a line of JSON for each finished case.",
            do="Choose another path; the file was not changed.",
            path=str(path),
        ) from error
    if written_for != key:
        raise SpecificationError(
            f"The checkpoint {path} belongs to other cases, another seed or another case function.",
            "Rows of different sweeps form no table.",
            do="Give the same cases, seed and function, or another path; the file was not changed.",
            path=str(path),
            rows=len(rows),
        )
    return rows
