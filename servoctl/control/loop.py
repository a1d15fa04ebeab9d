"""The sampled closed loop around a plant: one C loop that calls the law through a pointer, and the same in Python."""

import ctypes
from dataclasses import dataclass

import numpy as np

from servoctl.codegen.native import pointer

FINISHED, STATE_LOST, LAW_LOST = 0, 1, 2  # how a loop ends


@dataclass(frozen=True)
class Loop:
    """What a closed loop needs beside the plant and the law; arrays that are not used are None.

    Attributes
    ----------
    samples, substeps, delay : int
        Number of periods, Runge-Kutta steps in each, samples from a command to the input.
    n_u, n_out : int
        Numbers of inputs, and of the law's outputs: inputs, controller state and further signals.
    first : int
        The law's row at the first sample.
    t0, period : float
        [s]
    p : (n_p,) array
        Of the plant, with room for inputs and disturbances at the end.
    x0, z0 : (n_x,), (n_z,) arrays
        State of the plant and controller state at the start.
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
        Index of the first input in p.
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


_FIELDS = {
    ctypes.c_int64: "samples substeps delay n_y n_z n_u n_out n_row rows first n_d at_u depth every n_traced columns "
    "status",
    ctypes.c_double: "t0 period",
    ctypes.c_void_p: "p x0 z0 table noise quantum low high change idle disturbance constants scale measured transport "
    "disturbed traced x law_x law_y input gathered trace",
}
_WHOLE = {"measured", "transport", "disturbed", "traced"}  # arrays of whole numbers


class Arguments(ctypes.Structure):
    """The C structure ``Loop`` of `codegen/c/sampled.h`, which one loop and many loops take.

    Parameters
    ----------
    **values
        Its fields by name, with arrays for pointers, which it keeps; None and fields that are left out are 0. What is
        no field of it is passed over.
    """

    _fields_ = [(name, kind) for kind, names in _FIELDS.items() for name in names.split()]

    def __init__(self, **values):
        super().__init__()
        self.arrays = []
        for name, kind in self._fields_:
            value = values.get(name)
            if value is None:
                continue
            if kind is ctypes.c_void_p:
                self.arrays.append(np.ascontiguousarray(value, dtype=np.int64 if name in _WHOLE else np.float64))
                value = pointer(self.arrays[-1])
            setattr(self, name, value)


_STEP = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


def run_loop(ode, law, loop):
    """Run a closed loop: in C, with a compiled law or one that is called back, or in Python without a compiler.

    Parameters
    ----------
    ode : Compiled
        Of the plant, made with the loop "closed".
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
        Measurement and controller state there.
    law_y : (N, n_out) array
        Command, next controller state and further signals there.
    inputs : (N, n_u) array
        Inputs applied from there on.
    """
    n, n_y, n_z = loop.samples + 1, len(loop.measured), len(loop.z0)
    logs = {
        "x": np.empty((n, ode.n_x)), "law_x": np.empty((n + 1, n_y + n_z)),
        "law_y": np.empty((n, loop.n_out)), "input": np.empty((n, loop.n_u)),
    }  # fmt: skip
    native = ode.native("closed")
    if native is None:
        done, status = _interpreted(ode, law, loop, *logs.values())
    else:
        done, status = _native(native, law, loop, logs)
    return status, *(log[:done] for log in logs.values())


def _native(native, law, loop, logs):
    """The loop of closed.c; returns the samples completed and the status."""
    step = law.native("step") if hasattr(law, "native") else None
    failures = []
    if step is None:
        step = _STEP(_called_back(law, loop, logs["law_x"].shape[1], failures))
    rows, n_row = loop.table.shape
    sizes = {"n_y": len(loop.measured), "n_z": len(loop.z0), "n_d": len(loop.disturbed), "rows": rows, "n_row": n_row}
    arguments = Arguments(**vars(loop) | sizes | logs, status=FINISHED)
    native.restype = ctypes.c_int64
    done = native(ctypes.cast(step, ctypes.c_void_p), ctypes.byref(arguments))
    return done, failures[0] if failures else arguments.status


def _called_back(law, loop, n_in, failures):
    """A function for C that calls a Python law; what it raises is kept, and ends the loop."""
    n_row, n_out = loop.table.shape[1], loop.n_out

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


# --- the rule of the loop in Python, as sampled.h, rk4.h and closed.c have it


def quantised(y, quantum):
    """Measurements y (n_y,) in whole steps of quantum (n_y,), where these are positive; None for none."""
    if quantum is None:
        return y
    return np.where(quantum > 0, quantum * np.rint(y / np.where(quantum > 0, quantum, 1.0)), y)


def limited(command, before, low, high, change):
    """Inputs (n_u,) of one sample: the command within its limits, and those of its change from the inputs before."""
    u = command if low is None else np.clip(command, low, high)
    return u if change is None else np.clip(u, before - change, before + change)


def samples_ago(step, transport, substeps):
    """Samples since the inputs that arrive in an integration step of this one were applied, (n_u,) whole numbers."""
    return -((step - transport) // substeps)


def hold(ode, t, h, x, steps):
    """The state at the end of a sample.

    Parameters
    ----------
    ode : Compiled
    t, h : float
        Start of the sample, length of an integration step [s].
    x : (n_x,) array
    steps : iterable of (start, middle, end)
        Parameters (n_p,) of the plant, with inputs and disturbances, in each step.

    Returns
    -------
    (n_x,) array
    """
    for s, stages in enumerate(steps):
        x = ode.restore(t + (s + 1) * h, _rk4(ode, t + s * h, h, x, stages), stages[2])
    return x


def _rk4(ode, t, h, x, stages):
    """One Runge-Kutta step of order 4."""
    start, middle, end = stages
    n = len(x)
    k1 = ode(t, x, start)[:n]
    k2 = ode(t + h / 2, x + h / 2 * k1, middle)[:n]
    k3 = ode(t + h / 2, x + h / 2 * k2, middle)[:n]
    k4 = ode(t + h, x + h * k3, end)[:n]
    return x + h / 6 * (k1 + 2 * (k2 + k3) + k4)


def _steps(c, k, inputs):
    """Parameters at the start, the middle and the end of each step of sample k."""
    d_at, late = c.at_u + c.n_u + c.disturbed, 0 if c.transport is None else c.transport
    for s in range(c.substeps):
        stages = np.tile(c.p, (3, 1))
        applied = k - samples_ago(s, late, c.substeps) + np.zeros(c.n_u, dtype=int)
        stages[:, c.at_u : c.at_u + c.n_u] = np.where(applied < 0, c.idle, inputs[applied, range(c.n_u)])
        if len(d_at):
            stages[:, d_at] = c.disturbance[k * c.substeps + s]
        yield stages


@np.errstate(all="ignore")
def _interpreted(ode, law, c, x_log, law_x, law_y, inputs):
    """The loop of closed.c in Python; returns the samples completed and the status."""
    n_y, n_z, n_u, x = len(c.measured), len(c.z0), c.n_u, c.x0
    law_x[0, n_y:] = c.z0
    for k in range(c.samples + 1):
        t = c.t0 + k * c.period
        if not np.isfinite(x).all():
            return k, STATE_LOST
        x_log[k] = x
        law_x[k, :n_y] = quantised(x[c.measured] + (0.0 if c.noise is None else c.noise[k]), c.quantum)
        try:
            law_y[k] = law(t, law_x[k].copy(), c.table[min(c.first + k, len(c.table) - 1)])
        except BaseException as error:  # as in C: the motion before is kept
            return k, error
        if not np.isfinite(law_y[k, : n_u + n_z]).all():
            return k, LAW_LOST
        command = law_y[k - c.delay, :n_u] if k >= c.delay else c.idle
        inputs[k] = limited(command, inputs[k - 1] if k else c.idle, c.low, c.high, c.change)
        if k == c.samples:
            break
        law_x[k + 1, n_y:] = law_y[k, n_u : n_u + n_z]
        x = hold(ode, t, c.period / c.substeps, x, _steps(c, k, inputs))
    return c.samples + 1, FINISHED
