"""A list of operations at many points: one C unit for all functions, so that no function is compiled by itself.

The operations of a function are data of the unit, which carries out each at `TOGETHER` points before the next. They are
CasADi's, one by one: the bits are those of single points.
"""

import ctypes
import functools

import casadi as ca
import numpy as np

from servoctl.codegen import compiler, emit
from servoctl.codegen.compiler import CALLS

TOGETHER = 64  # points of a block: the values of sixty operations stay in the first cache
ENOUGH = 4  # points that are worth a block: CasADi evaluates fewer of them one by one in less time


def machine(f, points):
    """The `Machine` of an SX function (t, x, p) -> y; False where not all is arithmetic, None while it is not compiled.

    CasADi has its own approximation of the inverse error function. It would be used at so many points now.
    """
    calls = points * f.n_instructions() / CALLS  # it is compiled for all functions, as long as one of so many
    if (library := compiler.library(_written(TOGETHER), "-O3", True, calls)) is None:
        return None
    used = {f.instruction_id(k) for k in range(f.n_instructions())}
    return used <= emit.SAME_BITS and Machine(f, library.servoctl_machine)


class Machine:
    """Evaluation of a function's operations at many points; threads may share it."""

    def __init__(self, f, run):
        self._run, self._rows = run, f.sz_w()
        code, constants = np.zeros((f.n_instructions(), 4), dtype=np.int32), np.zeros(f.n_instructions())
        first = np.cumsum([0, 1, f.numel_in(1), f.numel_in(2)])  # of t, x, p and jets in one list of inputs
        for k in range(len(code)):
            operation, source, target = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
            if operation == ca.OP_INPUT:
                code[k] = operation, target[0], first[source[0]] + source[1], 0
            elif operation == ca.OP_CONST:
                code[k], constants[k] = (operation, target[0], 0, 0), f.instruction_constant(k)
            elif operation == ca.OP_OUTPUT:
                code[k] = operation, target[1], source[0], 0
            else:
                code[k] = operation, target[0], source[0], source[-1]
        self._code, self._constants, self._inputs = code, constants, int(first[2])

    def grid(self, t, x, p, y):
        """Fill y (n_y, N) with the outputs at t (N,) and the columns of x, and of p if that is a matrix."""
        t, x, p = (np.ascontiguousarray(part, dtype=float) for part in (t, x, p))
        filled = y if y.flags.c_contiguous else np.empty(y.shape)
        work = np.empty((self._rows, TOGETHER))
        arrays = (self._code, self._constants, t, x, p, filled, work)
        sizes = (len(self._code), self._inputs, t.size, p.ndim == 2)
        self._run(*map(ctypes.c_int64, sizes), *(ctypes.c_void_p(a.ctypes.data) for a in arrays))
        if filled is not y:
            y[:] = filled


_written = functools.cache(emit.emit_machine)
