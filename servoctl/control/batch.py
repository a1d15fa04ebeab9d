"""Thousands of closed loops of one plant and one law, in compiled code whose vector lanes are cases."""

import ctypes
import os
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import casadi as ca
import numpy as np

from servoctl.codegen import compiler, emit
from servoctl.codegen.compiler import lanes
from servoctl.codegen.function import Compiled, compiled
from servoctl.codegen.native import pointer
from servoctl.codegen.paths import jets_in
from servoctl.control.loop import Arguments
from servoctl.values import frozen

INLINED = 300  # operations of the plant's rates, up to which they are inlined into each stage, for all vectors in turn
VECTORS = 2  # in a block: as many chains of dependent operations as registers hold
LOOKED = 64  # samples between two looks whether all is finite
PER_THREAD = 16  # tasks, so that threads end at about the same time

_UNITS = weakref.WeakKeyDictionary()  # step of a law -> its units


@frozen(eq=False)
class Unit:
    """The C text of a batch for any number of lanes, and the function of its table; made by `unit`.

    `table` maps t_k and row k of the schedule, with jets of references below it, to values that are common to all cases
    at a sample. `states`, `inputs` and `residuals` (Residuals or None) are gathered.
    """

    text: str
    table: Compiled
    states: tuple
    inputs: tuple
    residuals: object

    @property
    def names(self):
        """Names of the gathered quantities; "input a" for the input of a lagged actuator a, which is also a state."""
        inputs = (f"input {name}" if name in self.states else name for name in self.inputs)
        residuals = self.residuals.names if self.residuals else ()
        return (*self.states, *inputs, *(f"residual {name}" for name in residuals))

    def library(self, n):
        """The C function for n lanes; None without a compiler."""
        library = compiler.library(f"#define W_LANES {n}\n{self.text}", level="-O3")
        return library and library.batch


def unit(plant, law, disturbed, residuals=None):
    """The unit of a plant and a compiled law; one serves all numbers of both.

    `disturbed` are indices in p of what is disturbed; `residuals` are gathered beside states and inputs.
    """
    units = _UNITS.setdefault(law.step, {})
    phi = tuple(e.element_hash() for e in residuals.expressions.elements()) if residuals else ()
    key = (plant.equations, law.measures, disturbed, phi)
    if key not in units:
        units[key] = _derived(plant, law, disturbed, residuals)
    return replace(units[key], residuals=residuals)  # which may follow other paths


def _derived(plant, law, disturbed, residuals):
    """Rates, law and residuals in C; parts that depend on the case alone, or on the sample alone, are split off."""
    n_c, n_u, project = plant.at_u, len(plant.inputs), plant.equations.project()
    t, x, p, followed, rates = _plant_rates(plant, disturbed)
    constants, applied = p[:n_c], ca.vertcat(p[n_c : n_c + n_u], *(p[i] for i in disturbed))
    still = ca.vertcat(ca.SX(0, 1), *(p[i] for i in range(n_c) if i not in disturbed))
    place = ca.vertcat(ca.SX(0, 1), *p.elements()[: n_c - len(plant.parameters)])
    f, w, w_values = _fastest((t, x, p, rates, followed), place, still, applied)
    t_k, row, written, common_values = _law_in_c(law)
    r = ca.SX.sym("r", len(residuals.jets) if residuals else 0)
    phi, s, s_values = _apart(_signals(plant, residuals, t_k, x, p, r), ca.vertcat(t_k, r))
    phi, v, v_values = _apart(phi, constants)
    vectors = {"NX": x, "NP": p, "NW": w, "NV": v, "NL": common_values, "NS": s, "NR": phi}
    sizes = {name: vector.numel() for name, vector in vectors.items()}
    sizes |= {
        "NU": n_u,
        "NC": n_c,
        "ND": len(disturbed),
        "NM": len(law.measures),
        "NZ": len(law.state),
        "NO": law.n_out,
    }
    sizes |= {"NT": sizes["NX"] + n_u + sizes["NR"], "VECTORS": VECTORS, "LOOKED": LOOKED}
    where = ", ".join(str(plant.state_names.index(name)) for name in law.measures) or "0"
    given = {"PROJECTED": project is not None, "CALLED": not written}
    texts = {"NAME": "batch", "MEASURED": f"{{{where}}}"} | {name: "" for name, is_so in given.items() if is_so}
    parts = [
        emit.unit(sizes | texts),
        emit.include("normal.h"),
        _lanes("numbers", t, constants, ca.SX(0, 1), ca.vertcat(w_values, v_values)),
        _rates_of_block(f),
        written,
        _lanes("signals", t_k, ca.vertcat(x, v), s, phi, emit.LANES_COMMON),
        "" if project is None else emit.function(project, "change", emit.LANES),
        emit.include("batch.c"),
    ]
    table = _function("table", t_k, ca.SX(0, 1), ca.vertcat(row, r), ca.vertcat(common_values, s_values))
    table = compiled(table, "table")
    return Unit("".join(parts), table, plant.state_names, plant.inputs, residuals)


def _signals(plant, residuals, t, x, p, r):
    """Residuals of the state x at t, with jets of references r."""
    if not residuals:
        return ca.SX(0, 1)
    # a single parameter indexed by [] is a row in CasADi, not a column
    first = plant.at_u - len(plant.parameters)
    numbers = ca.vertcat(ca.SX(0, 1), *(p[first + i] for i in residuals.places), r)
    return residuals.expression(t, x, plant.state_names, numbers)


def _law_in_c(law):
    """Symbols t_k and row; C text of the law, "" for one that is called; what all cases share at a sample."""
    if law.allocation is not None:
        t_k, row = ca.SX.sym("t"), ca.SX.sym("row", law.schedule.shape[0])
        return t_k, row, "", row
    t_k, y, row = law.step.expression.sx_in()
    command, common, values = _apart(law.step.expression(t_k, y, row), ca.vertcat(t_k, row))
    return t_k, row, _lanes("law", t_k, y, common, command, emit.LANES_COMMON), values


def _plant_rates(plant, disturbed):
    """Symbols t, x, p and r of a plant, and x' with no generalised force but those that are disturbed."""
    f = plant.function("ode").expression
    t, x, p, *r = f.sx_in()
    first = plant.at_u + len(plant.inputs)
    calm = [i for i in range(first, p.numel()) if i not in disturbed]
    return t, x, p, *(r or [ca.SX(0, 1)]), ca.substitute(f(t, x, p, *r), p[calm], ca.SX.zeros(len(calm)))


def _fastest(of_all, place, still, applied):
    """The rates (t, x, p, x', r) as a function of (t, x, [w; applied], r), symbols w, and their values by `still`.

    What each case computes once takes no time. The place of paths, if any, is the first of w.
    """
    f, (t, x, p, _, r) = _function("rates", *of_all), of_all
    inputs, ways = (t, x, p, r)[: f.n_in()], []
    for rates in (f(*inputs), *(ca.Function("way", f.sx_in(), [way])(*inputs) for way in emit.other_ways(f))):
        rest, w, values = _apart(rates, still)
        w, values = ca.vertcat(place, w), ca.vertcat(place, values)
        ways.append((_function("rates", t, x, ca.vertcat(w, applied), rest, r), w, values))
    return min(ways, key=lambda way: emit.cost(way[0], emit.LANES_INLINE))


def _apart(expression, symbols):
    """An expression with new symbols for parts that depend on some symbols alone; these symbols; their values."""
    rest, new, values = ca.extract_parametric(ca.cse(expression), symbols, {"extract_trivial": True})
    return rest, ca.vertcat(ca.SX(0, 1), *new), ca.vertcat(ca.SX(0, 1), *values)


def _function(name, t, x, p, value, r=None):
    """The function (t, x, p), or (t, x, p, r) where there are jets of references."""
    inputs = {"t": t, "x": x, "p": p} | ({"r": r} if r is not None and r.numel() else {})
    return ca.Function(name, [*inputs.values()], [ca.densify(ca.cse(value))], [*inputs], ["y"])


def _lanes(name, t, x, p, value, dialect=emit.LANES):
    """C text of an expression for the cases in the lanes of a vector."""
    return emit.function(_function(name, t, x, p, value), name, dialect)


def _rates_of_block(f):
    """C text of the rates of the vectors of a block, inlined if they are short."""
    head = "INLINE void rates_of_block(const W t, const W *const x[], const W *const p[], W (*y)[NX + 1])\n{\n"
    if emit.operations(f) > INLINED or jets_in(f):
        each = (f"    rates(t, x[{g}], p[{g}], y[{g}]);\n" for g in range(VECTORS))
        return emit.function(f, "rates", emit.LANES) + head + "".join(each) + "}\n"
    suffixes = ("", *map(str, range(1, VECTORS)))
    arguments = ", ".join(f"x[{g}], p[{g}], y[{g}]" for g in range(VECTORS))
    text = emit.function_of_several(f, "rates_of_several", emit.LANES_INLINE, suffixes)
    return text + head + f"    rates_of_several(t, {arguments});\n}}\n"


@frozen
class Gathered:
    """Results of a batch of N cases, for n quantities in the order of `Unit.names`.

    `state_lost` and `law_lost` (N,) are the instants [s] at which the state, or the law's output, is first not finite,
    else infinite; `largest`, `rms` and `last` (n, N) the largest size over all samples, the root of the mean square and
    the value at the end; `trace` (K, n_traced, N) the values at every n-th sample. After Ctrl-C `state_lost` is NaN in
    the cases that were not finished.
    """

    state_lost: np.ndarray
    law_lost: np.ndarray
    largest: np.ndarray
    rms: np.ndarray
    last: np.ndarray
    trace: np.ndarray


def run_batch(unit, loop, cases, noise=None, traced=(), every=1, threads=None, step=None):
    """Run the closed loops of N cases: `Gathered`, or None without a compiler.

    `loop` holds for all cases, without its p, x0 and noise. `cases` are parameters of the plant (n_c, N), initial
    states (n_x, N) and factors of the disturbances (n_d, N); `noise` are standard deviations of the measurements (n_y,)
    and keys of the cases (N, 2). `step` is the C function of a law that is called.
    `traced` are indices of quantities that are traced at every n-th sample. By default there is one thread per core;
    the numbers do not depend on it.
    """
    n = lanes()
    native = unit.library(n)
    if native is None:
        return None
    native.restype = None
    count, width, size = cases[1].shape[1], VECTORS * n, len(unit.names)
    blocks = -(-count // width)
    columns = np.minimum(np.arange(blocks * width), count - 1)
    gathered = np.full((2 + 3 * size, blocks * width), np.nan)
    trace = np.empty((loop.samples // every + 1 if len(traced) else 0, len(traced), blocks * width))
    late = 0 if loop.transport is None else int(np.max(loop.transport)) // loop.substeps + 1
    depth = 1 + max(loop.delay, late)
    constants, x0, scale = (part[:, columns] for part in cases)
    deviations, keys = noise or (None, None)
    given = {"constants": constants, "x0": x0, "scale": scale, "p": None, "table": _common(unit, loop), "depth": depth}
    given |= {"deviations": deviations, "keys": None if keys is None else keys[columns]}
    given |= {"law": step and ctypes.cast(step, ctypes.c_void_p), "columns": blocks * width, "every": every}
    given |= {"traced": traced, "n_traced": len(traced), "gathered": gathered, "trace": trace}
    arguments = Arguments(**vars(loop) | given)

    def run(first, last):
        scratch = np.empty(2 * depth * loop.n_u * width + 1)
        native(ctypes.byref(arguments), ctypes.c_int64(first), ctypes.c_int64(last), pointer(scratch))

    threads = threads or os.cpu_count() or 1
    length = -(-blocks // (threads * PER_THREAD))
    starts = range(0, blocks, length)
    with ThreadPoolExecutor(threads) as pool:
        try:
            list(pool.map(run, starts, (min(first + length, blocks) for first in starts)))
        except KeyboardInterrupt:
            arguments.stop = 1  # which the threads read at each integration step
    lost, largest, squares, last = np.split(gathered[:, :count], [2, 2 + size, 2 + 2 * size])
    return Gathered(*lost, largest, np.sqrt(squares / (loop.samples + 1)), last, trace[:, :, :count])


def _common(unit, loop):
    """The table of values that are common to all cases, a row per sample."""
    samples = np.arange(loop.samples + 1)
    t, rows = loop.t0 + samples * loop.period, loop.table[np.minimum(loop.first + samples, len(loop.table) - 1)].T
    jets = [unit.residuals.jets.at(t)] if unit.residuals else []
    return unit.table.grid(t, np.zeros((0, len(samples))), np.vstack([rows, *jets])).T
