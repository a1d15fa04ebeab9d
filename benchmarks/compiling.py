"""What generated code costs beside the arithmetic: compiling it, calling it, and deriving derivatives of any order."""

import ctypes
from functools import partial

import appell_hamel
import casadi as ca
import numpy as np
from harness import Limit, Missing, Row
from native import COMPILER, build, casadi_text, function

import servoctl as sv
from servoctl.codegen.emit import emit, operations
from servoctl.codegen.function import CALLS
from servoctl.methods.taylor import taylor_coefficients

LAST = 64  # index of Taylor coefficients at which the function has 24,000 operations
CALL, BUFFER = "casadi Function.__call__ of compiled code", "casadi FunctionBuffer of compiled code"
COLUMN, ARRAYS = (ctypes.c_double, *3 * [ctypes.c_void_p]), (*4 * [ctypes.c_void_p], ctypes.c_int)


def compile_long():
    """From an SX function to a loaded library at -O2: our chunked text against CasADi's single C function."""
    model, start = appell_hamel.constrained()
    f = taylor_coefficients(model.equations, LAST)
    inputs = np.array([0.0]), start.values, np.append(model.parameters, 5.0)
    y = np.empty(f.numel_out(0))
    pointers = [v.ctypes.data for v in inputs]

    def ours():
        function(build(emit(f, "long_function"), "-O2"), "long_function", *COLUMN)(0.0, *pointers[1:], y.ctypes.data)
        return y.copy()

    def casadis():
        call = function(build(casadi_text(f), "-O2"), f.name(), *ARRAYS)
        results, work = (ctypes.c_void_p * 1)(y.ctypes.data), np.empty(f.sz_w() + 1)
        call((ctypes.c_void_p * 3)(*pointers), results, None, work.ctypes.data, 0)
        return y.copy()

    exact = f(*inputs).full().ravel()

    def error(values):
        return (np.abs(values - exact) / (np.abs(exact) + 1e-300)).max()

    peer = "CasADi's single C function, gcc -O2"
    peers = {peer: casadis if COMPILER else Missing("gcc is not installed")}
    return Row(
        f"Emit and compile {operations(f):,} operations at -O2", ours if COMPILER else Missing("gcc is not installed"),
        peers, error, 1e-6, {peer: 1.6},
    )  # fmt: skip


def call_once(arrays):
    """One evaluation of X' from Python: with its arguments in place, or from arrays to a new array."""
    model, start = appell_hamel.constrained()
    f, x, p = model.function("ode"), start.values, model.parameters
    exact = f(0.0, x, p)
    plain = f.expression
    if COMPILER:
        plain = ca.external(plain.name(), str(build(casadi_text(plain), "-O1")))
    buffer, trigger = plain.buffer()
    buffered = [np.zeros(1), x.copy(), p.copy()]
    y = np.empty(f.n_y)
    for k, value in enumerate(buffered):
        buffer.set_arg(k, memoryview(value))
    buffer.set_res(0, memoryview(y))

    def through_buffer():
        buffered[0][0], buffered[1][:], buffered[2][:] = 0.0, x, p
        trigger()
        return y.copy()

    through_buffer.needs = buffer, plain  # the trigger does not keep them alive

    def error(values):
        return np.abs(np.ravel(values) - exact).max()

    if arrays:
        for _ in range(CALLS):
            f(0.0, x, p)
        peers = {CALL: lambda: plain(0.0, x, p).full().ravel(), BUFFER: through_buffer}
        return Row(
            "One evaluation from Python, Appell-Hamel right-hand side, from arrays to a new array",
            lambda: f(0.0, x, p), peers, error, 1e-12,
        )  # fmt: skip
    *places, out, run = f.buffer()
    for place, value in zip(places, (0.0, x, p), strict=True):
        place[:] = value

    def in_place():
        run()
        return out

    def triggered():
        trigger()
        return y

    triggered.needs = through_buffer
    peers = {CALL: lambda: plain(0.0, x, p), BUFFER: triggered}
    return Row(
        "One evaluation from Python, Appell-Hamel right-hand side, arguments and result in place",
        in_place, peers, error, 1e-12, {CALL: 100},
    )  # fmt: skip


def total_derivative(rounds):
    """Growth from k = 8 to k = 16 of the operations of D^k of a curvature; 4 is quadratic."""
    q = sv.coordinates("x y")
    dx, dy = q.d(1)
    d2x, d2y = q.d(2)
    curvature = (dx * d2y - dy * d2x) / (dx**2 + dy**2) ** 1.5
    count = [operations(ca.Function("D", [ca.vertcat(*q, *(s for j in range(1, k + 3) for s in q.d(j)))],
                                    [ca.cse(q.dt(curvature, k))])) for k in (8, 16)]  # fmt: skip
    return [count[1] / count[0]]


def taylor_growth(rounds):
    """The same for the Taylor coefficients of a motion, for indices up to 8 and up to 16."""
    model, _ = appell_hamel.constrained()
    low, high = (operations(taylor_coefficients(model.equations, k)) for k in (8, 16))
    return [high / low]


ROWS = {
    "compile": compile_long,
    "call": partial(call_once, arrays=False),
    "call-arrays": partial(call_once, arrays=True),
    "derivatives": partial(
        Limit, "Operations of the k-th total derivative of a curvature: k = 16 / k = 8", total_derivative, 4.0
    ),
    "coefficients": partial(
        Limit, "Operations of the Appell-Hamel Taylor coefficients: up to 16 / up to 8", taylor_growth, 4.0
    ),
}
