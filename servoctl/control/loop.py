"""The sampled closed loop around a plant: one C loop that calls the law through a pointer, and the same in Python."""

import ctypes
import enum
import time

import numpy as np

from servoctl.codegen.native import address
from servoctl.errors import ServoError
from servoctl.values import Value, frozen

FINISHED, STATE_LOST, LAW_LOST, INTERRUPTED, PAUSED = enum.IntEnum(
    "Ending", "FINISHED STATE_LOST LAW_LOST INTERRUPTED PAUSED", start=0
)  # how a loop ends; the first three as in closed.c
PIECE = 0.03  # s that the compiled loop runs before it looks for Ctrl-C
FIRST_PIECE = 1000  # integration steps: at most some hundredths of a second


@frozen(eq=False)
class Loop(Value):
    """The numbers of a closed loop; arrays that are not used are None."""

    samples: int
    substeps: int  # Runge-Kutta steps per sample
    delay: int  # samples from a command to the input
    n_u: int
    n_out: int  # outputs of the law: command, controller state, further signals
    first: int  # row of the table at the first sample
    at_u: int  # index of the first input in p
    t0: float  # [s]
    period: float  # [s]
    p: np.ndarray  # the plant's numbers; the place of the paths that it follows, if any, is not among them
    x0: np.ndarray
    z0: np.ndarray  # initial controller state
    table: np.ndarray  # gain schedule, a row per sample; the last row holds after the end
    measured: np.ndarray  # (n_y,) indices of states
    disturbed: np.ndarray  # (n_d,) indices in p of generalised forces and parameters
    initial_input: np.ndarray  # (n_u,) until the first command arrives
    low: np.ndarray  # (n_u,) limits of the inputs, infinite without any
    high: np.ndarray
    change: np.ndarray  # (n_u,) largest change of the inputs from sample to sample
    disturbance: np.ndarray = None  # (n_parts, 3, n_d) at the start, the middle and the end of each part of a step
    parts: np.ndarray = None  # (samples * substeps + 1,) first part of each step; None: each has one, all of it
    spans: np.ndarray = None  # (n_parts, 2) begin of a part after that of its step, and its length [s]
    noise: np.ndarray = None  # (samples + 1, n_y)
    quantum: np.ndarray = None  # (n_y,)
    transport: np.ndarray = None  # (n_u,) integration steps by which each input arrives late


_FIELDS = {
    ctypes.c_int64: "samples substeps delay n_y n_z n_u n_out n_row rows first n_d at_u depth every n_traced columns "
    "stop status sample step steps stride",
    ctypes.c_double: "t0 period",
    ctypes.c_void_p: "p x0 z0 table noise quantum low high change initial_input disturbance spans constants "
    "scale deviations measured transport disturbed traced parts keys state x law_x law_y input gathered trace law",
}
_TYPES = {np.float64, np.int64, np.uint64}  # of numbers in arrays
_KIND_OF = {name: kind for kind, names in _FIELDS.items() for name in names.split()}
_KIND_OF |= dict.fromkeys((n for n, kind in _KIND_OF.items() if kind is ctypes.c_void_p and n != "law"), np.float64)
_KIND_OF |= dict.fromkeys(("measured", "transport", "disturbed", "traced", "parts"), np.int64) | {"keys": np.uint64}


class Arguments(ctypes.Structure):
    """The C structure ``Loop`` of `codegen/c/sampled.h`, for one loop and for many, from its fields by name.

    Arrays are passed for pointers, and the structure holds a reference to them. None and missing fields are 0; names
    that are no field are ignored.
    """

    _fields_ = [(name, kind) for kind, names in _FIELDS.items() for name in names.split()]

    def __init__(self, **values):
        super().__init__()
        self.arrays = []
        for name, value in values.items():
            kind = _KIND_OF.get(name)
            if value is None or kind is None:
                continue
            if kind in _TYPES and not isinstance(value, ctypes.c_void_p):
                self.arrays.append(np.ascontiguousarray(value, dtype=kind))
                value = address(self.arrays[-1])
            setattr(self, name, value)


_STEP = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


def run_loop(plant, law, loop, advance=None, rates="ode"):
    """Run a closed loop: in C, which calls a law in Python back, or in Python without a compiler.

    `advance`, of the arguments of `hold`, advances the state by a sample in place of the plant's equations.

    `rates` names a function of the plant that is compiled with the loop "closed"; `law` maps (t, [y; z], row of the
    schedule) to [u; z+; signals]. Returns the status (FINISHED; STATE_LOST or LAW_LOST if the state or the law's output
    is not finite at the next sample; INTERRUPTED by Ctrl-C; or the error that the law raised), and at the N completed
    samples the states (N, n_x), measurements and controller states (N, n_y + n_z), outputs of the law (N, n_out) and
    inputs (N, n_u).
    """
    n, n_y, n_z = loop.samples + 1, len(loop.measured), len(loop.z0)
    ode, p = plant.function(rates), np.append(plant.place, loop.p)
    native = ode.native("closed", loop.samples * loop.substeps) if advance is None else None
    exact = native is not None and not n_z and loop.noise is None and loop.quantum is None  # the law gets states
    logs = {
        "x": np.empty((n, ode.n_x)),
        "law_x": np.empty((1 if exact else n + 1, n_y + n_z)),
        "law_y": np.empty((n, loop.n_out)),
        "input": np.empty((n, loop.n_u)),
    }
    if native is None:
        done, status = _interpreted((ode, p, advance or hold), law, loop, logs)
    else:
        done, status = _native(native, law, loop, logs | {"p": p})
    if exact:
        logs["law_x"] = _by_columns(logs["x"], loop.measured)
    return status, *(log[:done] for log in logs.values())


def _by_columns(x, indices):
    """Columns of x (N, n_x), without a copy if they are next to each other."""
    some = indices.tolist()
    adjoining = some and some == [*range(some[0], some[0] + len(some))]
    return x[:, some[0] : some[0] + len(some)] if adjoining else x[:, some]


def _native(native, law, loop, logs):
    """The loop of closed.c; returns the number of completed samples and the status."""
    step = law.native("step") if hasattr(law, "native") else None
    failures = []
    if step is None:
        logs["law_y"][:] = np.nan  # ctypes drops an interruption at the entry to the law, and with it the law's answer
        step = _STEP(_called_back(law, loop, logs["law_x"].shape[1], failures))
    rows, n_row = loop.table.shape
    sizes = {"n_y": len(loop.measured), "n_z": len(loop.z0), "n_d": len(loop.disturbed), "rows": rows, "n_row": n_row}
    sizes["stride"] = logs["law_x"].shape[1] if len(logs["law_x"]) > 1 else 0
    goes_on = {"state": loop.x0.copy(), "steps": FIRST_PIECE, "status": PAUSED}
    arguments = Arguments(**vars(loop) | sizes | logs | goes_on | _unlimited(loop))
    native.restype = ctypes.c_int64
    call, done = (ctypes.cast(step, ctypes.c_void_p), ctypes.byref(arguments)), 0
    try:
        while arguments.status == PAUSED:
            begun = time.perf_counter()
            done = native(*call)
            faster = PIECE / max(time.perf_counter() - begun, PIECE / 10)
            arguments.steps = max(1, int(arguments.steps * faster))
    except KeyboardInterrupt:
        return done, INTERRUPTED
    status = failures[0] if failures else arguments.status
    if status != LAW_LOST:
        return done, status
    given = logs["law_x"][done] if sizes["stride"] else logs["x"][done, loop.measured]
    return done, _raised(law, loop, done, given) or status


def _unlimited(loop):
    """None for limits that limit nothing, which C does not ask for at every sample."""
    limits = {("low", "high"): [loop.low, loop.high], ("change",): loop.change}
    return {name: None for names, values in limits.items() if np.isinf(values).all() for name in names}


def _raised(law, loop, k, given):
    """The error that a law in C raises in Python at sample k, where it is given (n_y + n_z,); None if there is none."""
    row = loop.table[min(loop.first + k, len(loop.table) - 1)]
    try:
        law(loop.t0 + k * loop.period, given.copy(), row)
    except ServoError as error:
        return error


def _called_back(law, loop, n_in, failures):
    """A function for C that calls a Python law; an error goes to `failures` and ends the loop."""
    n_row, n_out = loop.table.shape[1], loop.n_out

    def view(address, size):
        return np.ctypeslib.as_array((ctypes.c_double * size).from_address(address)) if size else np.empty(0)

    def step(t, x, row, y):
        try:
            view(y, n_out)[:] = law(t, view(x, n_in).copy(), view(row, n_row).copy())
        except BaseException as error:  # an exception cannot cross C
            failures.append(INTERRUPTED if isinstance(error, KeyboardInterrupt) else error)
            view(y, n_out)[:] = np.nan

    return step


# --- the loop in Python, operation by operation as in sampled.h, rk4.h and closed.c


def quantised(y, quantum):
    """Measurements y (n_y,) rounded to multiples of quantum (n_y,) where that is positive; None: no quantisation."""
    if quantum is None:
        return y
    return np.where(quantum > 0, quantum * np.rint(y / np.where(quantum > 0, quantum, 1.0)), y)


def limited(command, before, low, high, change):
    """Inputs (n_u,) of one sample: the command clipped to its limits, then to the largest change per sample."""
    return np.clip(np.clip(command, low, high), before - change, before + change)


def samples_ago(step, transport, substeps):
    """Age in samples of the inputs that act in an integration step, behind a transport delay, (n_u,) integers."""
    return -((step - transport) // substeps)


def hold(ode, t, x, steps):
    """The state x (n_x,) at the end of a sample that starts at t, by Runge-Kutta steps of order 4.

    `steps` are the begin of each after t and its length [s], and the plant's numbers (n_p,), with inputs and
    disturbances, at its start, middle and end.
    """
    n = len(x)
    for begin, h, (start, middle, end) in steps:
        at = t + begin
        k1 = ode(at, x, start)[:n]
        k2 = ode(at + h / 2, x + h / 2 * k1, middle)[:n]
        k3 = ode(at + h / 2, x + h / 2 * k2, middle)[:n]
        k4 = ode(at + h, x + h * k3, end)[:n]
        x = ode.restore(at + h, x + h / 6 * (k1 + 2 * (k2 + k3) + k4), end)
    return x


def _steps(c, p, k, inputs):
    """Begin after the sample k and length of each step [s], parameters at its start, middle and end."""
    late, h = 0 if c.transport is None else c.transport, c.period / c.substeps
    for s in range(c.substeps):
        stages = np.tile(p, (3, 1))
        applied = k - samples_ago(s, late, c.substeps) + np.zeros(c.n_u, dtype=int)
        stages[:, c.at_u : c.at_u + c.n_u] = np.where(applied < 0, c.initial_input, inputs[applied, range(c.n_u)])
        step = k * c.substeps + s
        for part in (step,) if c.parts is None else range(*c.parts[step : step + 2]):
            if len(c.disturbed):
                stages[:, c.disturbed] = c.disturbance[part]
            begin, length = (0.0, h) if c.parts is None else c.spans[part]
            yield s * h + begin, length, stages


@np.errstate(all="ignore")
def _interpreted(plant, law, c, logs):
    """The loop of closed.c in Python; returns the number of completed samples and the status.

    Of the plant there are its rates, its numbers and what advances its state.
    """
    (ode, p, advance), (x_log, law_x, law_y, inputs) = plant, logs.values()
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
        except BaseException as error:  # as in C: the motion so far is returned
            return k, INTERRUPTED if isinstance(error, KeyboardInterrupt) else error
        if not np.isfinite(law_y[k, : n_u + n_z]).all():
            return k, LAW_LOST
        command = law_y[k - c.delay, :n_u] if k >= c.delay else c.initial_input
        inputs[k] = limited(command, inputs[k - 1] if k else c.initial_input, c.low, c.high, c.change)
        if k == c.samples:
            break
        law_x[k + 1, n_y:] = law_y[k, n_u : n_u + n_z]
        try:
            x = advance(ode, t, x, _steps(c, p, k, inputs))
        except KeyboardInterrupt:
            return k + 1, INTERRUPTED
    return c.samples + 1, FINISHED
