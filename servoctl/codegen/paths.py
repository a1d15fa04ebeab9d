"""References in compiled functions: tables of paths in memory, of which a function receives the address as a number.

A function f(t, x, p, r) contains jets of references r, an input (n, K + 1) with the derivatives 0 .. K of n references.
Who calls it gives t, x and p alone: the first number of p is the address of the `Followed` paths, from which its C code
takes the jets at each instant that it evaluates; CasADi receives them by one small library for all functions, or from
NumPy where there is no compiler. Both have the same bits.
"""

import ctypes
import os
import weakref

import casadi as ca
import numpy as np

from servoctl.codegen import compiler
from servoctl.errors import SpecificationError

BY_INSTANT = "of_piece"  # name of the fourth input of a function whose last parameter selects the pieces of paths
RULES = {"hold": 0, "continue": 1, "periodic": 2}  # as in path.h
IN_C = '#define NAME servoctl\n#include "paths.c"\n'

_alive = weakref.WeakValueDictionary()  # by address


class Followed:
    """The paths that references follow, as C reads them.

    `address` is a number of p for as long as this object lives; `jets` has the derivatives at some instants.
    """

    library = None  # of paths.c, the same for all paths; None while it is not compiled

    def __init__(self, paths):
        self.paths = tuple(paths)  # of one component each
        rows, self._arrays = [], []
        for path in self.paths:
            pieces, _, size = path.coefficients.shape
            arrays = [np.ascontiguousarray(part) for part in (path.breaks, path.coefficients)]
            self._arrays += arrays  # which must live as long
            places = (array.ctypes.data for array in arrays)
            rows.append((pieces, size, size, RULES[path.before], RULES[path.after], *path.rests, *places))
        self._table = np.array(rows, dtype=np.int64).reshape(-1, 9)
        self.address, self._last = float(self._table.ctypes.data), (None, None)
        _alive[self.address] = self

    def jets(self, t, order, instant=None):
        """Derivatives 0 .. `order` at times (N,), of the pieces that instants (N,) select: ((order + 1) n, N).

        They are NaN where a time is none: steps that fail ask for such, and are told by what they get.
        """
        instant = t if instant is None else instant
        key = (t[0], instant[0]) if len(t) == 1 else None
        last, jets = self._last
        size = (order + 1) * len(self.paths)
        if key is None or key != last or len(jets) < size:  # functions ask for one instant again and again
            jets = self._evaluated(t, order, instant)
            self._last = (key, jets) if key else self._last
        return jets[:size]

    def _evaluated(self, t, order, instants):
        """As `jets`."""
        if Followed.library is None and not none_chosen():
            Followed.library = compiler.library(IN_C, "-O2", exact=True, calls=(order + 1) * len(self.paths))
        if Followed.library is None or none_chosen():
            jets, known = np.full((order + 1, len(self.paths), len(t)), np.nan), np.isfinite(t) & np.isfinite(instants)
            for i, path in enumerate(self.paths):
                jets[:, i, known] = path.jets(t[known], order, instants[known])[:, 0]
            return jets.reshape(-1, len(t))
        jets = np.zeros((len(t), (order + 1) * len(self.paths)))
        arrays = *(np.ascontiguousarray(part, dtype=float) for part in (instants, t)), jets
        sizes = map(ctypes.c_int64, (len(self.paths), order, len(t)))
        Followed.library.servoctl_paths(
            ctypes.c_double(self.address), *sizes, *(ctypes.c_void_p(a.ctypes.data) for a in arrays)
        )
        return jets.T


def none_chosen():
    """Whether nothing is compiled, by choice: of the process, or of a call."""
    return compiler.choice.get() is False or os.environ.get("SERVOCTL_COMPILER") == "none"


def followed(address):
    """The paths at an address of p."""
    if (paths := _alive.get(float(address))) is None:
        raise SpecificationError(
            "A function of references was called without their paths.",
            "Its parameters p begin with the place of the paths in memory, which a model keeps.",
            do="Pass model.p, and keep the model.",
        )
    return paths


def jets_in(f):
    """The number of jets of references that a function takes."""
    return f.numel_in(3) if f.n_in() > 3 else 0


def jets_at(f, t, p):
    """The jets (numbers, N) that a function takes at times (N,) with parameters p (n_p,) or (n_p, N)."""
    p, order = np.reshape(p, (len(p), -1)), f.size2_in(3) - 1
    instants = np.broadcast_to(p[-1], len(t)) if f.name_in(3) == BY_INSTANT else t
    if p.shape[1] == 1:
        return followed(p[0, 0]).jets(t, order, instants)
    jets = np.empty((jets_in(f), len(t)))
    for address in {*p[0].tolist()}:
        some = p[0] == address
        jets[:, some] = followed(address).jets(t[some], order, instants[some])
    return jets


def with_jets(f, t, p):
    """Parameters (n_p,) or (n_p, N), with the jets that a function takes at times (N,) below them, if any."""
    if not jets_in(f):
        return p
    return np.vstack([np.broadcast_to(np.reshape(p, (len(p), -1)), (len(p), len(t))), jets_at(f, t, p)])


def arguments(f, t, x, p):
    """What a CasADi function takes at one point: t, x, as many of the parameters, and jets of references, if any."""
    p = np.asarray(p)[: f.numel_in(2)]
    jets = [jets_at(f, np.array([float(t)]), p).reshape(f.size_in(3), order="F")] if jets_in(f) else []
    return t, x, p, *jets


def evaluated(f, t, x, p):
    """The output (n_y,) of a CasADi function at one point."""
    return np.asarray(f(*arguments(f, t, x, p))).ravel()


def combined(name, build, *functions):
    """The function (t, x, p) whose output is `build(x, p, *outputs)` of those of functions of the first x and p."""
    longest = max(functions, key=lambda f: f.numel_in(1))
    t, x, p = longest.sx_in()[:3]
    r = max((f.sx_in()[3] for f in functions if jets_in(f)), key=ca.SX.numel, default=None)
    outputs = []
    for f in functions:
        jets = [r[:, : f.size2_in(3)]] if jets_in(f) else []
        outputs.append(f(t, x[: f.numel_in(1)], p[: f.numel_in(2)], *jets))
    kinds = {f.name_in(3) for f in functions if jets_in(f)}
    inputs = {"t": t, "x": x, "p": p} | {kind: r for kind in kinds}
    return ca.Function(name, [*inputs.values()], [ca.densify(ca.SX(build(x, p, *outputs)))], [*inputs], ["y"])
