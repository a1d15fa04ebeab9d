"""Derivations on disk, which the next process reads.

An entry lies in ``derived`` under the cache directory; its file name is the hash of the specification with all numbers,
the entry's name, and the versions and sources that derived it. An entry that cannot be read is derived again.
``SERVOCTL_MEMO=none`` neither reads nor writes.
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

from servoctl.codegen.cache import cache_directory, read_cached, replacing
from servoctl.errors import SpecificationError
from servoctl.reduction.manifold import sizes_of_references
from servoctl.reduction.reduce import references
from servoctl.spec.coordinates import Coordinates
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.packing import packed, unpacked
from servoctl.spec.parameters import Parameters
from servoctl.spec.program import Program

SETTLED = 1.0  # s: sources that are newer than this before they were loaded may have been loaded in another version

_LOADED = time.time()


class Store:
    """The derivations of one specification on disk.

    `specification` holds the arguments, which are those of `servoctl.reduction.reduce.reduce`, and `fingerprint` their
    hash; where that is None, nothing is read or written.
    """

    def __init__(self, mechanism, program, guess=None, near=None, values=None):
        self.specification = mechanism, program, dict(guess) if isinstance(guess, dict) else guess, near, values
        self.fingerprint = fingerprint(*self.specification)

    def recall(self, name, build):
        """The entry of this name; if there is none, the value of `build()`, which is written.

        Raises SpecificationError if the value must be built after the specification was changed.
        """
        path = self._path(name)
        entry = _read(path)
        if entry is None:
            self.require_unchanged()
            entry = (build(),)
            _write(path, entry)
        return entry[0]

    def reduction(self, reduce):
        """The `Reduction` on disk, in the designer's symbols; if there is none, that of `reduce`, which is written."""
        mechanism, program, *_ = self.specification
        path = self._path("reduction")
        entry = _read(path)
        if entry is not None:
            return unpack(entry, mechanism, program=program)
        reduction = reduce(*self.specification)
        if path is not None:
            _write(path, pack(reduction, program=program))
        return reduction

    def require_unchanged(self):
        """Raise SpecificationError if the specification was changed after its model was derived."""
        if fingerprint(*self.specification) != self.fingerprint:
            raise SpecificationError(
                "The mechanism or the program was changed after its model was derived.",
                "A model derives its functions when they are first used, from the specification that it was made of.",
                do="Make another mechanism or program and derive its model.",
                changed="specification",
            )

    def _path(self, name):
        """Path of an entry; None if nothing is to be read or written."""
        stamp = None if os.environ.get("SERVOCTL_MEMO") == "none" else _stamp()
        if stamp is None or self.fingerprint is None:
            return None
        entry = hashlib.sha256(f"{stamp} {self.fingerprint} {name}".encode()).hexdigest()
        return cache_directory() / "derived" / entry


def pack(reduction, **shared):
    """A reduction in a form that pickles, without its mechanism and the `shared` objects (see `packing.packed`)."""
    m = reduction.mechanism
    return packed(reduction, m.q, m.parameters, {"mechanism": m, **shared})


def unpack(content, mechanism, **shared):
    """The reduction that was packed, in the symbols of a mechanism."""
    reduction = unpacked(content, mechanism.q, mechanism.parameters, {"mechanism": mechanism, **shared})
    return replace(reduction, context=replace(reduction.context, book=reduction.points.book))


def fingerprint(mechanism, program, guess=None, near=None, values=None):
    """Hash of all that a derivation depends on: operations in their order, names, numbers and choices.

    The arguments are those of `servoctl.reduction.reduce.reduce`. None if the specification cannot be hashed, since
    instances of subclasses may hold more than their expressions.
    """
    if (type(mechanism), type(program)) != (Mechanism, Program):
        return None
    if (type(mechanism.q), type(mechanism.parameters)) != (Coordinates, Parameters):
        return None
    try:
        t, state, spreads = (None, {}, {}) if near is None else near
        numbers = np.asarray(mechanism.parameters.values() if values is None else values, dtype=float)
        q, sizes = mechanism.q, sizes_of_references(mechanism.q, mechanism.parameters.symbols, numbers).tolist()
        facts = [
            list(program.residuals),
            program.by,
            program.metric,
            program.jumps,
            [list(program.integrals), program.stated],
            *(
                [(name, None if isinstance(e, ca.SX) else float(e)) for name, e in chosen.items()]
                for chosen in (program.weights, program.toward)
            ),
            [(name, float(value)) for name, value in (guess or {}).items()],
            None if near is None else float(t),
            *([(name, float(value)) for name, value in some.items()] for some in (state, spreads)),
            numbers.tolist(),
            [sizes[q.family.names.index(name)] for name in references(mechanism, program)],
        ]
        chosen = (*program.weights.values(), *program.toward.values())
        residuals = [*program.residuals.values(), *program.with_turns.values()]
        expressions = [*residuals, *program.integrals.values(), *(e for e in chosen if isinstance(e, ca.SX))]
        function = mechanism.q.as_function(expressions, mechanism.parameters.symbols)
        text = "\n".join([json.dumps(facts, allow_nan=False), mechanism.as_text(), function.serialize()])
    except Exception:  # CasADi raises bare ones; the derivation says what is wrong
        return None
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def _stamp():
    """Hash of versions and of the package's sources; None if the sources changed after import."""
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
    """The entry at a path, a tuple; None if it cannot be read."""
    if path is None:
        return None
    try:
        return pickle.loads(read_cached(path))
    except Exception:  # an undamaged entry may hold objects of another build of a library
        return None


def _write(path, entry):
    if path is None:
        return
    try:
        content = pickle.dumps(entry)
    except Exception:  # expressions do not pickle: CasADi raises a bare Exception
        return
    with contextlib.suppress(OSError), replacing(path) as temporary:
        Path(temporary).write_bytes(content)
