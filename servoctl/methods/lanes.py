"""Motions of many cases by the Taylor method at once, in vector lanes with steps of their own."""

import ctypes
import os
import sys
from functools import lru_cache, reduce
from threading import Thread

import casadi as ca
import numpy as np

from servoctl.codegen import compiler, emit
from servoctl.codegen.function import compiled
from servoctl.codegen.native import pointer
from servoctl.codegen.paths import combined
from servoctl.jets.branches import steep_arguments
from servoctl.methods.algebraic import NODES, STEPS, switched
from servoctl.methods.motion import breakpoints
from servoctl.methods.rank import DEGRADED, NEGLIGIBLE
from servoctl.methods.taylor import FAR_OFF, series_loop
from servoctl.model.equations import invariant_names
from servoctl.model.pivots import pivot_sizes
from servoctl.model.switching import switching

MOST_IN_LANES = 10**6  # of a case
SHOWN_EVERY = 0.1  # s between two looks at how far the threads are
IN_CALLER = 1e7  # operations, a few milliseconds, which the calling thread does before it starts others
OF_A_CASE = ("outcome", "steps", "t", "violation")  # of the results of a case, before its last state

_NUMBERS = ("t0", "t1", "rtol", "longest")
_COUNTS = ("max_steps", "n_times", "n_cuts", "n_cases", "most", "next", "stop")
_ARRAYS = ("order", "x0", "p", "atol", "pivots", "times", "cuts", "ends", "samples")
_KINDS = {ctypes.c_double: _NUMBERS, ctypes.c_int64: _COUNTS, ctypes.c_void_p: _ARRAYS}


class _Many(ctypes.Structure):
    """The C structure ``Many`` of cases.h, from its fields by name; it holds a reference to its arrays."""

    _fields_ = [(name, kind) for kind, names in _KINDS.items() for name in names]

    def __init__(self, arrays, **numbers):
        super().__init__(**numbers, **{name: pointer(array) for name, array in arrays.items()})
        self.arrays = arrays

    def run(self, library, operations, threads, progress):
        """Call a C function of so many operations a step; whether Ctrl-C ended it.

        It begins in the calling thread: others take longer to start than many problems take.
        """
        n, workers = self.n_cases, []
        try:
            self.most = max(int(IN_CALLER / operations), 1)
            library(ctypes.byref(self))
            order = np.flatnonzero(self.arrays["ends"][:, 0] == 0)
            self.arrays["order"], self.order = order, pointer(order)
            self.most, self.n_cases, self.next = sys.maxsize, len(order), 0
            workers += [Thread(target=library, args=(ctypes.byref(self),)) for _ in range(min(threads, len(order)))]
            for worker in workers:
                worker.start()
            for worker in workers:
                while worker.is_alive():
                    worker.join(SHOWN_EVERY)
                    if progress:
                        progress(n - self.n_cases + min(self.next, self.n_cases))
        except KeyboardInterrupt:
            self.stop = 1  # which the threads read at each step
            for worker in workers:
                if worker.ident:
                    worker.join()
        return bool(self.stop)


def fits(model):
    """Whether the motions of a model can be integrated in lanes, where they are watched at the ends of steps alone.

    Nothing may happen within a step that its series does not show: equations are polynomials of the state and of sines
    and cosines, do not depend on time, and have no kinks.
    """

    def smooth():
        f = model.function("ode").expression
        inputs = f.sx_in()
        alone = not model.reduction.rests and switching(model) is None and not _steep(model)
        return alone and not ca.depends_on(f(*inputs), inputs[0])

    return not (model.flat or model.paths) and model.once("fits lanes", smooth)


def _steep(model):
    """Whether functions in a model's equations may change much in a short time of its motions."""
    m, program = model.reduction.mechanism, model.reduction.program
    weights = [w for w in program.weights.values() if isinstance(w, ca.SX)]
    rows = [*program.residuals.values(), *m.constraints.values(), *weights, *m.E.elements()]
    found = steep_arguments([ca.SX(e) for e in (*m.balance.elements(), *rows)])
    return any(m.q.where(symbol) is not None for a in found for symbol in ca.symvar(a))


def integrate(model, last, span, cases, rtol, times, threads=None, progress=None):
    """Integrate from starts x0 (N, n_x) with parameters p (N, n_p) and absolute tolerances (N,) over a span.

    Ctrl-C ends it. Returns ends (N, 4 + 2 n_x), samples (N, K, n_x) at the times (K,), and whether Ctrl-C came; the
    arrays are None without a compiler or where the series is `too_long`. An end has the outcome (1: finished, 0: not
    reached before Ctrl-C, else to be computed by itself), number of steps, last instant, largest violation of the
    invariants at start and end (relative to their gradients times the state), last state, and largest sizes of the
    state, `from_start`. `progress` is called with the number of cases begun.
    """
    f = series_loop(model, last)
    library = None if f.too_long else _library(f, model)
    if library is None:
        return None, None, False
    x0, p, atol = cases
    n, n_x = x0.shape
    p = np.column_stack([p, np.full(n, sum(span) / 2)])  # the instant that selects pieces of paths
    arrays = {"x0": x0, "p": p, "atol": atol, "pivots": pivot_sizes(model), "times": times}
    arrays = {name: np.ascontiguousarray(array, dtype=float) for name, array in arrays.items()}
    arrays |= _results(n, len(times), n_x)
    many = _Many(arrays, t0=span[0], t1=span[1], rtol=rtol, max_steps=MOST_IN_LANES, n_times=len(times), n_cases=n)
    threads = min(threads or os.cpu_count() or 1, -(-n // compiler.lanes()))
    interrupted = many.run(library, f.operations, threads, progress)
    return arrays["ends"], arrays["samples"], interrupted


def plans_fit(model):
    """Whether plans of a model can be computed in compiled code alone, where pivots are watched at the ends of steps.

    Nothing may happen on the way but that they fall: no switches, no other orders.
    """

    def quiet():
        r = model.reduction
        return r.cascade is None and not (r.rests or switched(r))

    return model.flat and model.once("plans fit", quiet)


def plan_many(model, span, cases, times, knots, threads=None, progress=None):
    """Plans from states x0 (N, n_x) with parameters p (N, n_p), as functions have them, over a span with its knots.

    The results are those of `integrate`; the last of the times is the end of the span, the largest sizes are zero.
    """
    f = model.function("path")
    library = _plan_library(f, model)
    if library is None:
        return None, None, False
    x0, p = cases
    n, n_x = x0.shape
    cuts = breakpoints(span, knots)
    arrays = {"x0": x0, "p": p, "pivots": pivot_sizes(model), "times": times, "cuts": cuts}
    arrays = {name: np.ascontiguousarray(array, dtype=float) for name, array in arrays.items()}
    arrays |= _results(n, len(times), n_x)
    counts = {"max_steps": NODES, "n_times": len(times), "n_cuts": len(cuts), "n_cases": n}
    many = _Many(arrays, t0=span[0], t1=span[1], longest=abs(span[1] - span[0]) / STEPS, **counts)
    interrupted = many.run(library, f.operations, min(threads or os.cpu_count() or 1, n), progress)
    ends, samples = arrays["ends"], arrays["samples"]
    ends[:, len(OF_A_CASE) :][:, :n_x] = samples[:, -1]
    return ends, samples, interrupted


def _results(n, n_times, n_x):
    """Arrays for the results of N cases, none of which was computed yet, and the order in which they will be."""
    order, samples = np.arange(n), np.full((n, n_times, n_x), np.nan)
    return {"order": order, "ends": np.zeros((n, len(OF_A_CASE) + 2 * n_x)), "samples": samples}


def _library(f, model):
    """The C function of a model's series in lanes; None without a compiler."""
    command = compiler.compiler()
    if command is None:
        return None
    off_manifold = model.once("off the manifold", lambda: _off_manifold(model))
    return _loaded(f, off_manifold, len(model.state_names), compiler.lanes(), command)


@lru_cache(32)
def _loaded(f, off_manifold, n_x, width, _):
    """The same for a number of lanes and a compiler."""
    library = compiler.library(f"#define W_LANES {width}\n{_source(f, off_manifold, n_x)}", "-O3")
    if library is not None:
        library.servoctl_many.restype = None
    return library and library.servoctl_many


def _plan_library(f, model):
    """The C function of the plans of a model; None without a compiler."""
    if compiler.compiler() is None:
        return None

    def text():
        q, sizes = model.reduction.mechanism.q, f.sizes | {"n": model.n}
        given = {"DEGRADED": DEGRADED, "NEGLIGIBLE": NEGLIGIBLE, "PLAIN": int(q.plain)}
        head = "".join(f"#define {name} {value}\n" for name, value in given.items())
        return head + emit.emit(f.expression, "servoctl", ("newton",), sizes=sizes) + emit.include("plans.c")

    library = compiler.library(model.once("C text of plans", text), "-O3")
    if library is not None:
        library.servoctl_plans.restype = None
    return library and library.servoctl_plans


def _off_manifold(model):
    """The largest residual of the invariants, relative to its gradient times the state, as a function of (t, X, p)."""
    f, m = model.function("invariants").expression, len(invariant_names(model))

    def largest(x, _, y):
        sizes = ca.sqrt(ca.reshape(y[m:], m, -1) ** 2 @ (1 + ca.fabs(x)) ** 2)
        off = ca.fabs(y[:m]) / ca.if_else(sizes > 0, sizes, 1)
        return reduce(ca.fmax, off.elements(), ca.SX(0))

    return compiled(combined("off_manifold", largest, f), "off_manifold")


def _source(f, off_manifold, n_x):
    """The C text for any number of lanes."""
    sizes, chunk = emit.definitions(f.sizes), emit.WIDE if f.operations <= emit.WIDE else emit.CHUNK
    sizes |= {"NAME": "servoctl", "NX": n_x, "NP": f.n_p, "NY": f.n_y}
    sizes |= {"DEGRADED": DEGRADED, "NEGLIGIBLE": NEGLIGIBLE, "FAR_OFF": FAR_OFF}
    settled = f.others.get("settled")
    sizes |= {} if settled is None else {"SETTLED": ""}
    expansion = emit.series(f.expression, "expansion", emit.LANES, chunk)  # in one piece values stay in registers
    parts = [emit.unit(sizes), emit.include("lanes.h"), expansion]
    parts += [emit.function(off_manifold.expression, "off_manifold", emit.LANES)]
    parts += [] if settled is None else [emit.function(settled, "servoctl_settled", emit.PORTABLE)]
    return "".join((*parts, emit.include("many.c")))
