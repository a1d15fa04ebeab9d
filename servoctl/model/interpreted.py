"""The evaluations and loops of a compiled function, by CasADi and numpy: what runs where there is no compiler."""

import threading

import numpy as np

from servoctl.model import emit

_guard = threading.Lock()


class Workspace(threading.local):
    """Per thread: views of t, x, p, y in one row of memory, and the call without arguments that works on it.

    A memoryview is assigned in half the time that an array takes, and only from what has its own type and shape.
    """

    def __init__(self, n_x, n_p, n_y, connect):
        row = np.zeros(1 + n_x + n_p + n_y)
        parts = np.split(row, np.cumsum([1, n_x, n_p]))
        run, self.kept = connect(row, parts)
        self.row = (*map(memoryview, parts[:3]), parts[3], run)


class Interpreter:
    """Evaluation by CasADi, with the loops of `emit` in Python."""

    backend = "casadi"

    def __init__(self, f):
        self._f, self._n_x = f, f.numel_in(1)
        self.workspace = Workspace(self._n_x, f.numel_in(2), f.numel_out(0), self._connect)

    def _connect(self, row, parts):
        with _guard:
            buffer, run = self._f.buffer()
        for i, part in enumerate(parts[:3]):
            buffer.set_arg(i, memoryview(part))
        buffer.set_res(0, memoryview(parts[3]))
        return run, buffer

    def _value(self, t, x, p):
        row_t, row_x, row_p, row_y, run = self.workspace.row
        row_t[0], row_x[:], row_p[:] = t, x, p
        run()
        return row_y.copy()

    def grid(self, t, x, p, y):
        """Fill y (n_y, N) with the outputs at t (N,) and the columns of x, and of p if that is a matrix."""
        for k, t_k in enumerate(t):
            y[:, k] = self._value(t_k, x[:, k], p[:, k] if p.ndim == 2 else p)

    @np.errstate(all="ignore")
    def rk4(self, t0, x0, h, n_steps, every, p, states, guards):
        """Fill the columns of states and guards as `Compiled.rk4` says; return the index of the last one filled."""
        x, column, n_x = x0, 0, self._n_x
        for k in range(n_steps + 1):
            if not np.isfinite(x).all():
                break
            y = self._value(t0 + k * h, x, p)
            if k % every == 0 or k == n_steps:
                states[:, column], guards[:, column] = x, y[n_x:]
                column += 1
            if k < n_steps:
                middle, k1 = t0 + (k + 0.5) * h, y[:n_x]
                k2 = self._value(middle, x + h / 2 * k1, p)[:n_x]
                k3 = self._value(middle, x + h / 2 * k2, p)[:n_x]
                k4 = self._value(t0 + (k + 1) * h, x + h * k3, p)[:n_x]
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return column - 1

    def newton(self, t, x0, p, tol, max_iter, x, y):
        """Fill the columns of x and y as `Compiled.newton` says; return the points solved and the evaluations made."""
        solve = _Newton(self._value, p, self._n_x, tol, max_iter)
        point = None
        for k in range(t.size):
            point = solve.correct(t[k], x0) if k == 0 else solve.advance(t[k - 1], t[k], *point)
            if point is None:
                return k, solve.count
            x[:, k], y[:, k] = point
        return t.size, solve.count


class _Newton:
    """Newton's iteration along a path; a solution is a pair (x, y), or None where it was not found."""

    def __init__(self, value, p, n_x, tol, max_iter):
        self._value, self._p, self._n_x, self._tol, self._max_iter = value, p, n_x, tol, max_iter
        self.count = 0

    def _at(self, t, x):
        self.count += 1
        y = self._value(t, x, self._p)
        delta = y[: self._n_x]
        finite = np.isfinite(x).all() and np.isfinite(delta).all()
        return y, delta, np.max(np.abs(delta) / (1 + np.abs(x)), initial=0.0) if finite else np.inf

    @np.errstate(all="ignore")
    def correct(self, t, x):
        """Newton's iteration at time t from x."""
        for _ in range(self._max_iter + 1):
            y, delta, defect = self._at(t, x)
            if defect <= self._tol:
                break
            if not np.isfinite(defect):
                return None
            x = x + delta
        else:
            return None
        if defect > emit.ROUNDING:
            y_next, _, defect_next = self._at(t, x + delta)
            if defect_next < defect:
                return x + delta, y_next
        return x, y

    @np.errstate(all="ignore")
    def advance(self, a, b, x, y):
        """From the solution x, y at time a to the one at b: predicted by the rate; the step halved where that fails."""
        t, done, pieces = a, 0, 1
        while done < pieces:
            following = b if done + 1 == pieces else a + (b - a) * ((done + 1) / pieces)
            point = self.correct(following, x + (following - t) * y[self._n_x : 2 * self._n_x])
            if point is not None:
                (x, y), t, done = point, following, done + 1
                while pieces > 1 and done % 2 == 0:
                    done, pieces = done // 2, pieces // 2
            elif pieces == 2**emit.BISECTIONS:
                return None
            else:
                done, pieces = 2 * done, 2 * pieces
        return x, y
