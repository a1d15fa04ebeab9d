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
from pathlib import Path

import casadi as ca
import numpy as np

from servoctl.codegen.cache import cache_directory, keeping, kept
from servoctl.codegen.function import Compiled
from servoctl.spec.coordinates import Coordinates
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.parameters import Parameters
from servoctl.spec.program import Program

MOST_BYTES = 2**28  # of all entries: beyond it those that were not used for the longest time go, until half is left
WRITES = 50  # of a process between two looks at that sum
SETTLED = 1.0  # s: sources that changed later than this before they were loaded are not what runs

_LOADED = time.time()
_written = 0


class Memo:
    """What was derived of one specification, by name.

    Parameters
    ----------
    key : str or None
        From `key`; without one nothing is kept.
    """

    def __init__(self, key):
        self.key = key

    def recall(self, name, build):
        """What was kept under a name, or else what `build()` returns, which is kept.

        Parameters
        ----------
        name : str
        build : callable
            Without arguments.
        """
        if self.key is None or os.environ.get("SERVOCTL_MEMO") == "none":
            return build()
        path = cache_directory() / "derived" / hashlib.sha256(f"{self.key} {name}".encode()).hexdigest()
        found = _read(path)
        if found is None:
            found = (build(),)
            _write(path, found)
        return found[0]


def key(mechanism, program, guess, near, values):
    """What a derivation follows from, as a hash, with the versions and the sources that derive.

    Two specifications have the same key only if every expression that a derivation reads is made by the same operations
    in the same order, and every name, number and choice is the same.

    Parameters
    ----------
    mechanism, program, guess, near, values
        As `servoctl.reduction.reduce.reduce` takes them.

    Returns
    -------
    str or None
        None for what cannot be told completely, or where the sources that run are not those on disk.
    """
    stamp = _stamp()
    if stamp is None or (type(mechanism), type(program)) != (Mechanism, Program):
        return None
    if (type(mechanism.q), type(mechanism.parameters)) != (Coordinates, Parameters):
        return None
    try:
        t, state, sizes = (None, {}, {}) if near is None else near
        told = [
            stamp,
            _names(mechanism, program),
            [(name, float(value)) for name, value in (guess or {}).items()],
            None if near is None else float(t),
            *([(name, float(value)) for name, value in some.items()] for some in (state, sizes)),
            np.asarray(values, dtype=float).tolist(),
        ]
        text = json.dumps(told, allow_nan=False) + "\n" + _expressions(mechanism, program)
    except Exception:  # the derivation tells what is wrong; CasADi raises bare ones
        return None
    return hashlib.sha256(text.encode()).hexdigest()


def _names(mechanism, program):
    """All names, and the numbers among the weights: with the numbers of entries, what each expression is for."""
    q, weights = mechanism.q, program.weights.items()
    return [
        [q.names, q.velocity_names, q.plain, list(q.invariants)],
        [mechanism.actuators, list(mechanism.constraints), list(mechanism.outputs), mechanism.parameters.names],
        [list(program.residuals), program.by, [(n, None if isinstance(w, ca.SX) else float(w)) for n, w in weights]],
    ]


def _expressions(mechanism, program):
    """Every expression that a derivation reads, as one serialised function of t, q, the jets and the parameters."""
    q = mechanism.q
    outputs = [
        q.V, q.h, *q.invariants.values(), mechanism.balance, mechanism.energy, mechanism.forces, mechanism.E,
        *mechanism.constraints.values(), *mechanism.outputs.values(), *program.residuals.values(),
        *(w for w in program.weights.values() if isinstance(w, ca.SX)),
    ]  # fmt: skip
    highest = max(1, q.order(ca.vertcat(*(ca.vec(e) for e in outputs))))
    jets = [ca.vertcat(*q.gamma(k)) for k in range(1, highest + 1)]
    inputs = [q.t, ca.vertcat(*q), *jets, ca.vertcat(*mechanism.parameters.symbols)]
    return ca.Function("specification", inputs, outputs).serialize()


@functools.cache
def _stamp():
    """Versions, and the places, sizes and times of the package's sources; None where others may have been loaded."""
    found, newest = [], 0.0
    try:
        for path, stat in _sources(Path(__file__).parents[1]):
            found.append((path, stat.st_size, stat.st_mtime_ns))
            newest = max(newest, stat.st_mtime, stat.st_ctime)
    except OSError:
        return None
    if not found or newest > _LOADED - SETTLED:
        return None
    versions = (sys.version, platform.machine(), ca.__version__, np.__version__, str(np.finfo(np.longdouble)))
    return hashlib.sha256(repr((versions, sorted(found))).encode()).hexdigest()


def _sources(directory):
    """(path, status) of each Python file under a directory."""
    with os.scandir(directory) as entries:
        for entry in entries:
            if entry.name.endswith(".py"):
                yield entry.path, entry.stat()
            elif entry.is_dir() and entry.name != "__pycache__":
                yield from _sources(entry.path)


def _read(path):
    """A tuple with what is kept at a path, or None if there is nothing that can be read."""
    try:
        content = kept(path)
        with contextlib.suppress(OSError):
            os.utime(path)
        return pickle.loads(content)
    except Exception:  # what is whole can still be of a library that was built in another way
        return None


def _write(path, found):
    """Keep something, if it can be."""
    global _written
    try:
        for part in found[0] if isinstance(found[0], tuple) else found:
            if isinstance(part, Compiled):
                part.source()
        content = pickle.dumps(found)
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
    kept = []
    for entry in os.scandir(directory):
        with contextlib.suppress(OSError):  # another process removed it
            kept.append((entry.stat().st_mtime, entry.stat().st_size, entry.path))
    total = sum(size for _, size, _ in kept)
    if total <= MOST_BYTES:
        return
    for _, size, path in sorted(kept):
        if total <= MOST_BYTES / 2:
            break
        with contextlib.suppress(OSError):
            os.unlink(path)
        total -= size
