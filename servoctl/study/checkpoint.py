"""Checkpoints: a sweep writes each finished row as a line of JSON, so that a killed process loses none."""

import hashlib
import json
import os

from servoctl.checks import as_path
from servoctl.errors import ServoError, SpecificationError
from servoctl.study.cases import FAILURE

FORMAT = 1


def identity(name, cases, seed):
    """A digest of the case's name, the cases and the seed: rows form one table if it is the same."""
    return hashlib.sha256(json.dumps([name, cases, seed]).encode()).hexdigest()


class Checkpoint:
    """Rows on disk: `rows` are those of an earlier sweep, further ones are appended and flushed as they come.

    With the path None nothing is written. A file of another sweep, one that is no checkpoint, or one with two different
    rows of a case raises SpecificationError; one that cannot be opened raises ServoError. `count` is the number of
    cases.
    """

    def __init__(self, path, key, count):
        self.rows, self._file = [], None
        if path is not None:
            self._open(as_path(path, "The path of the checkpoint"), key, count)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._file is not None:
            self._file.close()

    def _open(self, path, key, count):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists() and not path.is_file():
                raise OSError("it is no file")
            whole, newline, _ = path.read_bytes().rpartition(b"\n") if path.exists() else (b"", b"", b"")
            whole += newline  # a killed process leaves half a line
            self.rows = _rows(path, whole.splitlines(), key, count)
            self._file = open(path, "r+b" if whole else "wb")
            self._file.truncate(len(whole))
            self._file.seek(0, os.SEEK_END)
            if not whole:
                self.add({"servoctl_sweep": FORMAT, "identity": key})
        except SpecificationError:
            raise
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            raise ServoError(
                f"The checkpoint {str(path)!r} cannot be opened: {getattr(error, 'strerror', None) or error}.",
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


def _rows(path, lines, key, count):
    """The rows of a checkpoint, one for each case, if it belongs to the sweep with this identity."""
    try:
        header, *rows = (json.loads(line) for line in lines) if lines else ({"identity": key},)
        written_for = header["identity"]
        if written_for == key and not all(_is_row(row, count) for row in rows):
            raise ValueError("a line is no row of this sweep")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise SpecificationError(
            f"{path} is no checkpoint of a sweep: {error}.",
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
    return list(by_case(rows, f"The checkpoint {path}").values())


def _is_row(row, count):
    """Whether a line of a checkpoint is a row of a sweep with so many cases."""
    if type(row["case"]) is not int or not 0 <= row["case"] < count:
        return False
    if "numbers" in row:
        return all(isinstance(value, (bool, int, float, str)) for value in row["numbers"].values())
    return all(isinstance(row[name], str) for name in FAILURE)


def by_case(rows, where):
    """Rows by their case.

    Raises
    ------
    SpecificationError
        If two rows of one case differ.
    """
    unique = {}
    for row in rows:
        first = unique.setdefault(row["case"], row)
        if first is not row and json.dumps(first, sort_keys=True) != json.dumps(row, sort_keys=True):
            raise SpecificationError(
                f"{where} has two different rows of case {row['case']}.",
                "A case has the same numbers wherever it is computed, on processors of one kind.",
                do="Compute the case again, and find out which of the two is right.",
                case=row["case"],
            )
    return unique
