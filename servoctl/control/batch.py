"""Thousands of closed loops of one plant and one law: a compiled unit in which the lanes of a vector are cases."""

import ctypes
import os
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from servoctl.codegen import compiler, emit
from servoctl.codegen.function import Compiled, compiled, compiling_at_once
from servoctl.codegen.loops import ROUNDING
from servoctl.codegen.loops.batch import BATCH
from servoctl.codegen.native import pointer

INLINED = 300  # operations: up to here the plant's rates are written into each stage of a step, for two vectors in turn
PER_THREAD = 16  # tasks: so that threads end at about the same time


def lanes():
    """How many cases one core takes at once: 8 where the processor has AVX-512, 4 with AVX2, else 1."""
    features = compiler.features()
    return 8 if "avx512f" in features else 4 if "avx2" in features else 1


@dataclass(frozen=True, eq=False)
class Unit:
    """The C text of a batch, but for its lanes, with what makes its table; made by `unit`.

    Attributes
    ----------
    text : str
        In terms of V and K.
    table : Compiled
        (t_k, nothing, row_k of the law) -> what all cases have in common at a sample.
    states, inputs : tuple of str
        What is gathered, in this order,
    residuals : Residuals or None
        and then these.
    n_y : int
        Number of measurements.
    """

    text: str
    table: Compiled
    states: tuple
    inputs: tuple
    residuals: object
    n_y: int
    _libraries: dict = field(default_factory=dict, repr=False)

    @property
    def names(self):
        """Names of what is gathered and may be traced; "input a" where the actuator a is itself a state."""
        inputs = (f"input {name}" if name in self.states else name for name in self.inputs)
        residuals = self.residuals.names if self.residuals else ()
        return (*self.states, *inputs, *(f"residual {name}" for name in residuals))

    def library(self, n):
        """The C function of n lanes; None without a compiler."""
        if n not in self._libraries:
            text = emit.prelude(self.text) + emit.several(self.text, n)
            self._libraries[n] = compiler.library(text, level="-O3")
        return self._libraries[n] and self._libraries[n].batch


def unit(plant, law, disturbed, residuals=None):
    """The unit of a plant and a law, derived once for all numbers of both.

    Parameters
    ----------
    plant : Plant
    law : Law
        Of the toolkit: its step is an expression.
    disturbed : tuple of int
        Which generalised forces are disturbed.
    residuals : Residuals, optional
        What is gathered beside states and inputs.

    Returns
    -------
    Unit
    """
    kept = vars(law.step).setdefault("_batches", {})
    phi = tuple(e.element_hash() for e in residuals.expressions.elements()) if residuals else ()
    key = (plant.equations, law.measures, disturbed, phi)
    if key not in kept:
        kept[key] = _derived(plant, law, disturbed, residuals)
    return kept[key]


def _derived(plant, law, disturbed, residuals):
    e, n_c, n_u = plant.equations, len(plant.parameters), len(plant.inputs)
    t, x, p = plant.function("ode")._f.sx_in()
    constants, forces = p[:n_c], p[n_c + n_u :]
    rates = plant.function("ode")._f(t, x, p)
    calm = [i for i in range(forces.numel()) if i not in disturbed]
    rates = ca.substitute(rates, forces[calm], ca.SX.zeros(len(calm)))
    rates, w, w_values = _apart(rates, constants)
    step = law.step._f
    t_k, y, row = step.sx_in()
    command, common, common_values = _apart(step(t_k, y, row), ca.vertcat(t_k, row))
    phi = ca.SX(0, 1)
    if residuals:
        own = [plant.mechanism.parameters.names.index(s.name()) for s in residuals.symbols]
        phi = residuals.expression(t_k, x, plant.state_names, constants[own])
    phi, s, s_values = _apart(phi, t_k)
    phi, v, v_values = _apart(phi, constants)
    sizes = {
        "NX": x.numel(), "NU": n_u, "NP": p.numel(), "NC": n_c, "NW": w.numel(), "NV": v.numel(),
        "ND": len(disturbed), "NY": len(law.measures), "NZ": len(law.state), "NO": law.n_out, "NL": common.numel(),
        "NS": s.numel(), "NR": phi.numel(), "NT": x.numel() + n_u + phi.numel(),
    }  # fmt: skip
    functions = [
        _function("numbers", t, constants, ca.SX(0, 1), ca.vertcat(w_values, v_values)),
        _of_two(_function("rates", t, x, ca.vertcat(w, p[n_c : n_c + n_u], forces[list(disturbed)]), rates)),
        _of_common(_function("law", t_k, y, common, command)),
        _of_common(_function("told", t_k, ca.vertcat(x, v), s, phi)),
    ]
    project = e.project()
    if project is not None:
        functions.append(_function("change", *project.sx_in(), project(*project.sx_in())))
    where = ", ".join(str(plant.state_names.index(name)) for name in law.measures) or "0"
    text = "\n".join(
        [
            f"\nenum {{ {', '.join(f'{name} = {value}' for name, value in sizes.items())} }};",
            f"#define INVARIANTS {int(project is not None)}\n#define SMALL {ROUNDING!r}",
            f"static const int measured[] = {{ {where} }};",
            *(text for _, text in functions),
            BATCH,
        ]
    )
    table = ca.Function("table", [t_k, ca.SX(0, 1), row], [ca.densify(ca.vertcat(common_values, s_values))])
    return Unit(text, compiled(table, "table"), plant.state_names, plant.inputs, residuals, len(law.measures))


def _apart(expression, symbols):
    """An expression with new symbols for what depends on some symbols alone; these, and what they stand for."""
    found, new, values = ca.extract_parametric(ca.cse(expression), symbols, {"extract_trivial": True})
    return found, ca.vertcat(ca.SX(0, 1), *new), ca.vertcat(ca.SX(0, 1), *values)


def _function(name, t, x, p, value):
    f = ca.Function(name, [t, x, p], [ca.densify(ca.cse(value))])
    return f, emit.portable(f, name)


def _of_two(function):
    """A function for two vectors of cases, statement by statement: one waits for its last while the other goes on."""
    f, text = function
    statements = text.split(")\n{\n", 1)[1]
    if emit.operations(f) > INLINED:
        return f, f"{text}\n{_TWO}{{\n    rates(t, x, p, y);\n    rates(t, x2, p2, y2);\n}}\n"
    lines = [line for line in statements.splitlines() if line.startswith(("    const V a", "    y["))]
    twice = (part for line in lines for part in (line, _ARGUMENT.sub("2", _VALUE.sub("b", line))))
    return f, "\n".join([f"{_TWO}{{", *twice, "}", ""])


def _of_common(function):
    """A function whose last argument is the same in all lanes."""
    f, text = function
    return f, re.sub(r"\bp\[(\d+)\]", r"K(p[\1])", text).replace("const V *restrict p", "const double *restrict p")


_TWO = """
INLINE void rates_of_two(const V t, const V *restrict x, const V *restrict p, V *restrict y,
                         const V *restrict x2, const V *restrict p2, V *restrict y2)
"""
_VALUE, _ARGUMENT = re.compile(r"\ba(?=\d)"), re.compile(r"(?<=\b[xpy])(?=\[)")

_COUNTS = "samples substeps delay depth every n_traced columns".split()
_WHOLE = ("transport", "traced")
_REALS = "constants x0 scale z0 table quantum low high change idle disturbance".split()


class _Arguments(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in _COUNTS),
        *((name, ctypes.c_double) for name in ("t0", "period")),
        *((name, ctypes.c_void_p) for name in (*_REALS, *_WHOLE, "found", "trace")),
    ]


@dataclass(frozen=True)
class Gathered:
    """What remains of a batch of N cases; n quantities in the order of `Unit.names`.

    Attributes
    ----------
    state_lost, law_lost : (N,) arrays
        First samples at which the state, or the law's answer, is not finite [s]; infinite where there is none.
    largest, rms, last : (n, N) arrays
        Largest size over all samples, root of the mean square, value at the end.
    trace : (K, n_traced, N) array
        Of every so many samples.
    """

    state_lost: np.ndarray
    law_lost: np.ndarray
    largest: np.ndarray
    rms: np.ndarray
    last: np.ndarray
    trace: np.ndarray


def run_batch(unit, loop, constants, x0, scale, noise=None, traced=(), every=1, threads=None, n=None):
    """Run the closed loops of N cases.

    Parameters
    ----------
    unit : Unit
    loop : Loop
        What the cases have in common; its p, x0 and noise are not used.
    constants : (n_c, N) array
        Parameters of the plant by case.
    x0 : (n_x, N) array
    scale : (n_d, N) array
        Of the disturbances.
    noise : callable, optional
        From the index of a case to its noise, (samples + 1, n_y).
    traced : sequence of int
        Which of the quantities are kept at every so many samples.
    every : int
    threads : int, optional
        Default: one per core.
    n : int, optional
        Lanes; default `lanes()`.

    Returns
    -------
    Gathered or None
        None without a compiler. The numbers do not depend on the number of threads.
    """
    n = n or lanes()
    native = unit.library(n)
    if native is None:
        return None
    count, width, size = x0.shape[1], 2 * n, len(unit.names)
    blocks, samples = -(-count // width), np.arange(loop.samples + 1)
    columns = np.minimum(np.arange(blocks * width), count - 1)
    found = np.empty((2 + 3 * size, blocks * width))
    trace = np.empty((loop.samples // every + 1 if len(traced) else 0, len(traced), blocks * width))
    late = 0 if loop.transport is None else int(np.max(loop.transport)) // loop.substeps + 1
    depth = 1 + max(loop.delay, late)
    given = {
        "samples": loop.samples, "substeps": loop.substeps, "delay": loop.delay, "depth": depth, "every": every,
        "n_traced": len(traced), "columns": blocks * width, "t0": loop.t0, "period": loop.period, "found": found,
        "trace": trace, "traced": np.array(traced, dtype=np.int64), "transport": loop.transport,
        "constants": constants[:, columns], "x0": x0[:, columns], "scale": scale[:, columns],
        "table": _common(unit, loop, samples),
    }  # fmt: skip
    arguments, kept = _Arguments(), []
    for name, kind in _Arguments._fields_:
        value = given.get(name, getattr(loop, name, None))
        if kind is ctypes.c_void_p and value is not None:
            kept.append(np.ascontiguousarray(value, dtype=np.int64 if name in _WHOLE else np.float64))
            value = pointer(kept[-1])
        setattr(arguments, name, value)
    native.restype = None

    def run(first, last):
        own = None if noise is None else np.empty((last - first, loop.samples + 1, unit.n_y, width))
        for case in range(first * width, last * width) if noise is not None else ():
            own[case // width - first, :, :, case % width] = noise(columns[case])
        scratch = np.empty(2 * depth * loop.n_u * width + 1)
        native(
            ctypes.byref(arguments), ctypes.c_int64(first), ctypes.c_int64(last),
            None if own is None else pointer(own), pointer(scratch),
        )  # fmt: skip

    threads = threads or os.cpu_count() or 1
    length = 1 if noise is not None else -(-blocks // (threads * PER_THREAD))
    starts = range(0, blocks, length)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(run, starts, (min(first + length, blocks) for first in starts)))
    parts = np.split(found[:, :count], [1, 2, 2 + size, 2 + 2 * size])
    return Gathered(
        parts[0][0], parts[1][0], parts[2], np.sqrt(parts[3] / (loop.samples + 1)), parts[4], trace[:, :, :count]
    )


def _common(unit, loop, samples):
    """The table of what all cases have in common, a row per sample."""
    rows = loop.table[np.minimum(loop.first + samples, len(loop.table) - 1)].T
    with compiling_at_once():
        return unit.table.grid(loop.t0 + samples * loop.period, np.zeros((0, len(samples))), rows).T
