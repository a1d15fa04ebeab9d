"""The file in which a sweep keeps its rows while it runs: a line of JSON each, so that a killed process loses none."""

import hashlib
import json
import os
from pathlib import Path

from servoctl.errors import ServoError, SpecificationError

FORMAT = 1


def identity(name, cases, seed):
    """What two sweeps must share for their rows to belong together: a digest of the case's name, the cases, the seed.

    Parameters
    ----------
    name : str
        Of the function that computes a case, with its module.
    cases : list of dict
    seed : int or None

    Returns
    -------
    str
    """
    return hashlib.sha256(json.dumps([name, cases, seed]).encode()).hexdigest()


class Checkpoint:
    """Rows on disk: those of an earlier sweep are read, further ones appended and flushed as they come.

    Parameters
    ----------
    path : str or Path
        Made where it is missing.
    key : str
        The sweep's `identity`.

    Attributes
    ----------
    rows : list of dict
        What was there. A last line that was cut off is dropped.

    Raises
    ------
    SpecificationError
        If the file belongs to another sweep, or is no checkpoint.
    ServoError
        If it cannot be read or written.
    """

    def __init__(self, path, key):
        self.path, self.rows = Path(path), []
        header = json.dumps({"servoctl_sweep": FORMAT, "identity": key}) + "\n"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True) if self.path.exists() else []
            whole = [line for line in lines if line.endswith("\n")]
            self.rows = self._read(whole, key)
            self._file = open(self.path, "r+b" if whole else "wb")
            self._file.truncate(len("".join(whole).encode()))
            self._file.seek(0, os.SEEK_END)
            if not whole:
                self._append(header)
        except OSError as error:
            raise ServoError(
                f"The checkpoint {path} cannot be opened: {error.strerror or error}.",
                "A checkpoint is a file that can be read and appended to.",
                do="Choose another path; nothing has been computed yet.",
                path=str(path),
            ) from error

    def _read(self, lines, key):
        try:
            header, *rows = (json.loads(line) for line in lines) if lines else ({"identity": key},)
            found = header["identity"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise SpecificationError(
                f"{self.path} is no checkpoint of a sweep.",
                "A checkpoint has a line of JSON for each finished case.",
                do="Choose another path; the file was not changed.",
                path=str(self.path),
            ) from error
        if found != key:
            raise SpecificationError(
                f"The checkpoint {self.path} belongs to other cases, another seed or another case function.",
                "A sweep goes on where its own checkpoint ends: rows of different sweeps form no table.",
                nearest=f"It holds {len(rows)} rows.",
                do="Give the same cases, seed and function, or another path; the file was not changed.",
                path=str(self.path),
            )
        return rows

    def add(self, row):
        """Append a row; it is on the disk when this returns."""
        self._append(json.dumps(row) + "\n")

    def _append(self, line):
        self._file.write(line.encode())
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self):
        """Close the file."""
        self._file.close()
