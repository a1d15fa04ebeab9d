"""Derivations on disk: what one process derived, the next one reads.

Entries lie in ``derived`` under the directory of the compiled libraries (see `cache`), each under the hash of the
specification with all its numbers, the name of what was derived, and the versions and sources that derived it. What
cannot be read is derived; ``SERVOCTL_MEMO=none`` neither reads nor writes.
"""

import contextlib
import functools
import hashlib
import json
import os
import pickle
import platform
import sys
import time
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

from servoctl.codegen.cache import cache_directory, keeping, kept
from servoctl.errors import SpecificationError
from servoctl.spec.coordinates import Coordinates
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.packing import packed, unpacked
from servoctl.spec.parameters import Parameters
from servoctl.spec.program import Program

MOST_BYTES = 2**28  # of all entries: beyond it those that were not used for the longest time go, until half is left
WRITES = 50  # of a process between two looks at that sum
SETTLED = 1.0  # s: sources that changed later than this before they were loaded are not what runs

_LOADED = time.time()
_written = 0


class Store:
    """What was derived of one specification, by this process or another.

    Parameters
    ----------
    mechanism, program, guess, near, values
        The specification, as `servoctl.reduction.reduce.reduce` takes it.

    Attributes
    ----------
    fingerprint : str or None
        Of the specification; see `fingerprint`.
    """

    def __init__(self, mechanism, program, guess=None, near=None, values=None):
        self.specification = mechanism, program, dict(guess) if isinstance(guess, dict) else guess, near, values
        self.fingerprint = fingerprint(*self.specification)

    def recall(self, name, build):
        """The entry of a name, or else what `build()` returns, which becomes the entry.

        Parameters
        ----------
        name : str
        build : callable
            Without arguments.

        Raises
        ------
        SpecificationError
            If it is to be built and the specification has become another.
        """
        path = self._path(name)
        content = _read(path)
        if content is None:
            self.require_unchanged()
            content = (build(),)
            _write(path, content)
        return content[0]

    def reduction(self, reduce):
        """The `Reduction` on disk, in the designer's own symbols, or else that of `reduce`, which is written.

        Parameters
        ----------
        reduce : callable
            Of the specification.
        """
        mechanism, program, *_ = self.specification
        path = self._path("reduction")
        content = _read(path)
        if content is None:
            reduction = reduce(*self.specification)
            if path is not None:
                _write(path, pack(reduction, program=program))
            return reduction
        return unpack(content, mechanism, program=program)

    def require_unchanged(self):
        """Refuse a specification that was changed since its model was derived.

        Raises
        ------
        SpecificationError
        """
        if fingerprint(*self.specification) != self.fingerprint:
            raise SpecificationError(
                "The mechanism or the program was changed after its model was derived.",
                "A specification is a value: what is derived of it later must fit what was derived before.",
                do="Make another mechanism or program, and derive its model.",
            )

    def _path(self, name):
        """Where an entry lies; None where nothing is read or written."""
        stamp = None if os.environ.get("SERVOCTL_MEMO") == "none" else _stamp()
        if stamp is None or self.fingerprint is None:
            return None
        entry = hashlib.sha256(f"{stamp} {self.fingerprint} {name}".encode()).hexdigest()
        return cache_directory() / "derived" / entry


def pack(reduction, **shared):
    """A reduction as what pickles, without its mechanism and what else is shared (see `packing.packed`)."""
    m = reduction.mechanism
    return packed(reduction, m.q, m.parameters, {"mechanism": m, **shared})


def unpack(content, mechanism, **shared):
    """The reduction that `pack` made, in the symbols of a mechanism."""
    reduction = unpacked(content, mechanism.q, mechanism.parameters, {"mechanism": mechanism, **shared})
    return replace(reduction, context=replace(reduction.context, book=reduction.points.book))


def fingerprint(mechanism, program, guess=None, near=None, values=None):
    """What a derivation follows from, as a hash.

    Two specifications have the same one only if every expression that a derivation reads is made by the same operations
    in the same order, and every name, number and choice is the same.

    Parameters
    ----------
    mechanism, program, guess, near, values
        As `servoctl.reduction.reduce.reduce` takes them.

    Returns
    -------
    str or None
        None for a value of another class, which may say more than its expressions: nothing of it goes to disk.
    """
    if (type(mechanism), type(program)) != (Mechanism, Program):
        return None
    if (type(mechanism.q), type(mechanism.parameters)) != (Coordinates, Parameters):
        return None
    try:
        t, state, sizes = (None, {}, {}) if near is None else near
        facts = [
            list(program.residuals),
            program.by,
            [(name, None if isinstance(weight, ca.SX) else float(weight)) for name, weight in program.weights.items()],
            [(name, float(value)) for name, value in (guess or {}).items()],
            None if near is None else float(t),
            *([(name, float(value)) for name, value in some.items()] for some in (state, sizes)),
            np.asarray(mechanism.parameters.values() if values is None else values, dtype=float).tolist(),
        ]
        expressions = [*program.residuals.values(), *(w for w in program.weights.values() if isinstance(w, ca.SX))]
        function = mechanism.q.as_function(expressions, mechanism.parameters.symbols)
        text = "\n".join([json.dumps(facts, allow_nan=False), mechanism.as_text(), function.serialize()])
    except Exception:  # the derivation says what is wrong; CasADi raises bare ones
        return None
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def _stamp():
    """Versions, and the places, sizes and times of the package's sources; None where others may have been loaded."""
    sources, newest = [], 0.0
    try:
        for path, stat in _sources(Path(__file__).parents[1]):
            sources.append((path, stat.st_size, stat.st_mtime_ns))
            newest = max(newest, stat.st_mtime, stat.st_ctime)
    except OSError:
        return None
    if not sources or newest > _LOADED - SETTLED:
        return None
    versions = (sys.version, platform.machine(), ca.__version__, np.__version__, str(np.finfo(np.longdouble)))
    return hashlib.sha256(repr((versions, sorted(sources))).encode()).hexdigest()


def _sources(directory):
    """(path, status) of each source under a directory."""
    with os.scandir(directory) as entries:
        for entry in entries:
            if entry.name.endswith((".py", ".c", ".h")):
                yield entry.path, entry.stat()
            elif entry.is_dir() and entry.name != "__pycache__":
                yield from _sources(entry.path)


def _read(path):
    """The entry at a path, a tuple, or None if there is nothing that can be read."""
    if path is None:
        return None
    try:
        content = kept(path)
        with contextlib.suppress(OSError):
            os.utime(path)
        return pickle.loads(content)
    except Exception:  # what is whole can still be of a library that was built in another way
        return None


def _write(path, entry):
    """Keep a tuple, if it can be."""
    global _written
    if path is None:
        return
    try:
        content = pickle.dumps(entry)
    except Exception:  # what holds expressions does not pickle, which CasADi tells by a bare Exception
        return
    with contextlib.suppress(OSError):
        with keeping(path) as temporary:
            Path(temporary).write_bytes(content)
        if _written % WRITES == 0:
            _prune(path.parent)
        _written += 1


def _prune(directory):
    """Remove what was not used for the longest time, if all entries together are too large."""
    entries = []
    for entry in os.scandir(directory):
        with contextlib.suppress(OSError):  # another process removed it
            entries.append((entry.stat().st_mtime, entry.stat().st_size, entry.path))
    total = sum(size for _, size, _ in entries)
    if total <= MOST_BYTES:
        return
    for _, size, path in sorted(entries):
        if total <= MOST_BYTES / 2:
            break
        with contextlib.suppress(OSError):
            os.unlink(path)
        total -= size
