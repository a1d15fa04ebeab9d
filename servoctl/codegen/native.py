"""Calls into a compiled library through ctypes."""

import ctypes
import functools

import casadi as ca
import numpy as np

from servoctl.codegen.interpreted import Workspace, connected

_OF_PYTHON = (  # in the order of builtin.c
    "PyFloat_AsDouble PyErr_Occurred PyErr_Clear PyObject_Vectorcall PyCFunction_NewEx".split()
)
_VERSION, _NEW = 0, 93  # in NumPy's table of functions: PyArray_GetNDArrayCVersion, PyArray_New
_ABI = 0x2000000  # of NumPy 2: PyArray_New and the fields of an array as builtin.c has them
_HEADER = 2 * ctypes.sizeof(ctypes.c_void_p)  # of an object: references and type; Python without its lock has more


class Library:
    """Evaluation by a compiled library."""

    backend = "c"

    def __init__(self, library, symbol, n_x, n_p, n_y):
        self._library, self._symbol = library, symbol
        self._grid = self.native("grid")
        self._grid.restype = None
        self.workspace = Workspace(n_x, n_p, n_y, self._connect)

    def _connect(self, row, parts):
        # CasADi's buffer: its call without arguments takes a third of the time of a call through ctypes.
        return connected(ca.external(f"{self._symbol}_casadi", self._library._name), parts)

    def native(self, suffix):
        """The C function ``SYMBOL_suffix``."""
        return getattr(self._library, f"{self._symbol}_{suffix}")

    def grid(self, t, x, p, y):
        """See `Compiled.grid`."""
        self._grid(ctypes.c_int64(t.size), *map(argument, (t, x, p)), ctypes.c_int64(p.ndim == 2), argument(y))

    def rk(self, t0, x0, h, counts, p, tableau, states, outputs):
        """See `Compiled.rk`."""
        run = self.native("rk")
        run.restype = ctypes.c_int64
        return run(
            ctypes.c_double(t0),
            argument(x0),
            ctypes.c_double(h),
            *map(ctypes.c_int64, counts),
            argument(p),
            ctypes.c_int64(len(tableau[1])),
            *map(argument, tableau),
            ctypes.c_int64(states.shape[1]),
            argument(states),
            argument(outputs),
        )

    def taylor(self, ends, rtol, atol, every, max_steps, weights=None):
        """Rows (t, x, y) of the steps from the start in the workspace; see `Compiled.taylor`."""
        steps = self.workspace.steps
        steps.of(ends, rtol, atol, every, max_steps, weights)
        return steps.log[: self._taylor(steps.pointer) + 1].copy()

    @functools.cached_property
    def _taylor(self):
        run = self.native("taylor")
        run.restype = ctypes.c_int64
        return run

    def whole(self, ends, tolerances, most, times, net, sizes):
        """Rows of the steps, jets and facts of a motion from the start in the workspace; see `Compiled.whole`."""
        task, (inside, distance, to_knot), count = self.workspace.steps, net, len(times)
        task.of(ends, *tolerances, 0.0, most, None)
        jets, facts, k = np.empty((sizes[0], count)), np.empty(sizes[1]), np.empty(count, dtype=np.int64)
        places = (a.ctypes.data for a in (times, inside, k, jets, facts))
        samples = np.array([count, len(inside), to_knot, 0, *places])
        samples.view(float)[3] = distance
        steps = self._whole(task.pointer, argument(samples))
        return (task.log[: steps + 1].copy(), jets, facts) if steps >= 0 else None

    @functools.cached_property
    def _whole(self):
        run = self.native("whole")
        run.restype = ctypes.c_int64
        return run

    def jets(self, log, k, t, p, counts, z):
        """Fill z with the jets at times t in the steps k of a log; see `Compiled.jets`."""
        size, (levels, settled) = ctypes.c_int64(t.size), map(ctypes.c_int64, counts)
        log, k, t, p, z = map(argument, (log, k, t, p, z))
        self.native("taylor_jets")(log, size, k, t, p, levels, settled, z)

    def continuation(self, cuts, x0, p, longest, nodes):
        """Fill rows of nodes; return their number and that of evaluations. See `Compiled.continuation`."""
        run, count = self.native("continuation"), ctypes.c_int64()
        run.restype = ctypes.c_int64
        size, most = ctypes.c_int64(cuts.size), ctypes.c_int64(len(nodes))
        arrays = map(argument, (cuts, x0, p))
        return run(size, *arrays, ctypes.c_double(longest), most, argument(nodes), ctypes.byref(count)), count.value

    def newton(self, t, nodes, p, z):
        """Fill columns of z; return the numbers of points solved and of evaluations. See `Compiled.newton`."""
        run, count = self.native("newton"), ctypes.c_int64()
        run.restype = ctypes.c_int64
        sizes = ctypes.c_int64(t.size), ctypes.c_int64(len(nodes))
        n = run(sizes[0], argument(t), sizes[1], *map(argument, (nodes, p, z)), ctypes.byref(count))
        return n, count.value


def builtin(library, symbol, otherwise):
    """A function (t, x, p) -> new array of a library by builtin.c; None where Python or NumPy has no such interface.

    What is no number and two arrays as C has them goes to the function ``otherwise``.
    """
    try:
        functions = [ctypes.cast(getattr(ctypes.pythonapi, name), ctypes.c_void_p).value for name in _OF_PYTHON]
        capsule = np._core._multiarray_umath._ARRAY_API
    except AttributeError:
        return None
    pointer_in = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)
    address = pointer_in(("PyCapsule_GetPointer", ctypes.pythonapi))(capsule, None)
    table = (ctypes.c_void_p * (_NEW + 1)).from_address(address)
    if object.__basicsize__ != _HEADER or ctypes.CFUNCTYPE(ctypes.c_uint)(table[_VERSION])() != _ABI:
        return None
    make = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, ctypes.py_object)((f"{symbol}_builtin", library))
    addresses = *functions, table[_NEW], id(np.ndarray)
    return make((ctypes.c_void_p * len(addresses))(*addresses), otherwise)


def argument(array):
    """An array as an argument of a C function, which has its address."""
    if array.size and array.flags.carray:  # by its buffer: a quarter of the time of `array.ctypes`
        return ctypes.byref(ctypes.c_char.from_buffer(array))
    return pointer(array)


def address(array):
    """The address of an array's first number, as an int."""
    if array.size and array.flags.carray:  # by its buffer: a quarter of the time of `array.ctypes`
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    return array.ctypes.data


def pointer(array):
    """The address of an array's first number."""
    return ctypes.c_void_p(array.ctypes.data)
