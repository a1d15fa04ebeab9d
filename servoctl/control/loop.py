"""The sampled closed loop around a plant: one C loop that calls the law through a pointer, and the same in Python."""

import ctypes
from dataclasses import dataclass

import numpy as np

from servoctl.codegen.native import pointer

FINISHED, STATE_LOST, LAW_LOST = 0, 1, 2  # how a loop ends

@dataclass(frozen=True)
class Loop:
    """What a closed loop needs beside the plant and the law; arrays that were not asked for are None.

    Attributes
    ----------
    samples, substeps, delay : int
        Number of periods, Runge-Kutta steps in each, samples from a command to the input.
    n_u, n_out : int
        Numbers of inputs, and of the law's outputs: inputs, memory and further signals.
    first : int
        The law's row at the first sample.
    t0, period : float
        [s]
    p : (n_p,) array
        Of the plant, with room for inputs and disturbances at the end.
    x0, z0 : (n_x,), (n_z,) arrays
        State of the plant and memory of the law at the start.
    table : (rows, n_row) array
        Of the law; the last row holds beyond the end.
    measured, disturbed : (n_y,), (n_d,) integer arrays
        Which states are measured, which generalised forces disturbed.
    noise : (samples + 1, n_y) array
    quantum : (n_y,) array
    low, high, change : (n_u,) arrays
        Limits of the inputs, and of their change from sample to sample.
    idle : (n_u,) array
        The inputs before the first command arrives.
    disturbance : (samples * substeps, 3, n_d) array
        At the start, the middle and the end of each step.
    transport : (n_u,) integer array
        Integration steps by which each input arrives late.
    at_u : int
        Where the inputs stand in p.
    """

    samples: int
    substeps: int
    delay: int
    n_u: int
    n_out: int
    first: int
    at_u: int
    t0: float
    period: float
    p: np.ndarray
    x0: np.ndarray
    z0: np.ndarray
    table: np.ndarray
    measured: np.ndarray
    disturbed: np.ndarray
    idle: np.ndarray
    disturbance: np.ndarray = None
    noise: np.ndarray = None
    quantum: np.ndarray = None
    low: np.ndarray = None
    high: np.ndarray = None
    change: np.ndarray = None
    transport: np.ndarray = None


_COUNTS = "samples substeps delay n_y n_z n_u n_out n_row rows first n_d at_u".split()
_REALS = "p x0 z0 table noise quantum low high change idle disturbance".split()
_WHOLE = "measured transport disturbed".split()
_LOGS = "x law_x law_y input".split()


class _Arguments(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in _COUNTS),
        *((name, ctypes.c_double) for name in ("t0", "period")),
        *((name, ctypes.c_void_p) for name in (*_REALS, *_WHOLE, *_LOGS)),
        ("status", ctypes.c_int64),
    ]


_STEP = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


def run_loop(ode, law, loop):
    """Run a closed loop: in C, with a compiled law or one that is called back, or in Python without a compiler.

    Parameters
    ----------
    ode : Compiled
        Of the plant, made with `DRIVER`.
    law : Compiled or callable
        (t, [y; z], row) -> [u; z+; further signals].
    loop : Loop

    Returns
    -------
    status : int or BaseException
        FINISHED; STATE_LOST or LAW_LOST where the state or the law's answer is not finite at the next sample; or what
        the law raised there.
    x : (N, n_x) array
        States at the samples completed.
    law_x : (N, n_y + n_z) array
        Measurement and memory there.
    law_y : (N, n_out) array
        Command, next memory and further signals there.
    inputs : (N, n_u) array
        Inputs applied from there on.
    """
    n, n_y, n_z = loop.samples + 1, len(loop.measured), len(loop.z0)
    x, law_x = np.empty((n, ode.n_x)), np.empty((n + 1, n_y + n_z))
    law_y, inputs = np.empty((n, loop.n_out)), np.empty((n, loop.n_u))
    logs = (x, law_x, law_y, inputs)
    native = ode.native("closed")
    if native is None:
        done, status = _interpreted(ode, law, loop, *logs)
    else:
        done, status = _native(native, law, loop, logs)
    return status, *(log[:done] for log in logs)


def _native(native, law, loop, logs):
    step = law.native("step") if hasattr(law, "native") else None
    failures, callback = [], None
    if step is None:
        callback = _STEP(_called_back(law, loop, logs, failures))
        step = callback
    sizes = {
        "n_y": len(loop.measured), "n_z": len(loop.z0), "n_d": len(loop.disturbed),
        "rows": loop.table.shape[0], "n_row": loop.table.shape[1],
    }  # fmt: skip
    a = _Arguments(t0=loop.t0, period=loop.period, status=FINISHED)
    for name in _COUNTS:
        setattr(a, name, sizes.get(name, getattr(loop, name, 0)))
    kept = []
    for names, kind in ((_REALS, np.float64), (_WHOLE, np.int64)):
        for name in names:
            value = getattr(loop, name)
            if value is not None:
                kept.append(np.ascontiguousarray(value, dtype=kind))
                setattr(a, name, pointer(kept[-1]))
    for name, log in zip(_LOGS, logs, strict=True):
        setattr(a, name, pointer(log))
    native.restype = ctypes.c_int64
    done = native(ctypes.cast(step, ctypes.c_void_p), ctypes.byref(a))
    return done, failures[0] if failures else a.status


def _called_back(law, loop, logs, failures):
    """A function for C that calls a Python law; what it raises is kept, and ends the loop."""
    n_in, n_row, n_out = logs[1].shape[1], loop.table.shape[1], loop.n_out

    def view(address, size):
        return np.ctypeslib.as_array((ctypes.c_double * size).from_address(address)) if size else np.empty(0)

    def step(t, x, row, y):
        out = view(y, n_out)
        try:
            out[:] = law(t, view(x, n_in).copy(), view(row, n_row).copy())
        except BaseException as error:  # C cannot pass it on
            failures.append(error)
            out[:] = np.nan

    return step


@np.errstate(all="ignore")
def _interpreted(ode, law, c, x_log, law_x, law_y, inputs):
    """The loop of `DRIVER` in Python; returns the samples completed and the status."""
    n_y, n_z, n_u, n_d = len(c.measured), len(c.z0), c.n_u, len(c.disturbed)
    x, p, h = c.x0.copy(), c.p.copy(), c.period / c.substeps
    law_x[0, n_y:] = c.z0
    for k in range(c.samples + 1):
        t = c.t0 + k * c.period
        if not np.isfinite(x).all():
            return k, STATE_LOST
        x_log[k] = x
        y = x[c.measured]
        y = y if c.noise is None else y + c.noise[k]
        if c.quantum is not None:
            steps = np.where(c.quantum > 0, c.quantum, 1.0)
            y = np.where(c.quantum > 0, c.quantum * np.rint(y / steps), y)
        law_x[k, :n_y] = y
        try:
            law_y[k] = law(t, law_x[k].copy(), c.table[min(c.first + k, len(c.table) - 1)])
        except BaseException as error:  # as in C: the motion before is kept
            return k, error
        if not np.isfinite(law_y[k, : n_u + n_z]).all():
            return k, LAW_LOST
        u = law_y[k - c.delay, :n_u] if k >= c.delay else c.idle
        before = inputs[k - 1] if k else c.idle
        u = u if c.low is None else np.clip(u, c.low, c.high)
        inputs[k] = u if c.change is None else np.clip(u, before - c.change, before + c.change)
        if k == c.samples:
            break
        law_x[k + 1, n_y:] = law_y[k, n_u : n_u + n_z]
        p[c.at_u : c.at_u + n_u] = inputs[k]
        for s in range(c.substeps):
            step = k * c.substeps + s
            for i in range(n_u if c.transport is not None else 0):
                sent = step - c.transport[i]
                p[c.at_u + i] = c.idle[i] if sent < 0 else inputs[sent // c.substeps, i]
            x = _rk4(ode, c, t + s * h, h, c.disturbance[step] if n_d else None, x, p)
            x = ode.restore(t + (s + 1) * h, x, p)
    return c.samples + 1, FINISHED


def _rk4(ode, c, t, h, d, x, p):
    """One Runge-Kutta step of order 4; d (3, n_d) holds the disturbances at its start, middle and end."""

    def rate(stage, instant, state):
        if d is not None:
            p[c.at_u + c.n_u + c.disturbed] = d[stage]
        return ode(instant, state, p)[: len(x)]

    k1 = rate(0, t, x)
    k2 = rate(1, t + h / 2, x + h / 2 * k1)
    k3 = rate(1, t + h / 2, x + h / 2 * k2)
    k4 = rate(2, t + h, x + h * k3)
    return x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
