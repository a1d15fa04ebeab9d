"""Evaluations and loops of a function by CasADi and NumPy: for short motions, and where there is no compiler."""

import functools
import threading
from itertools import pairwise

import numpy as np

from servoctl.codegen.loops import BISECTIONS, NEAR, QUADRATIC, ROUNDING

BLOCK, STRIDE = 128, 16  # instants of a path that are solved together; from one that is solved alone to the next

_guard = threading.Lock()


class Workspace(threading.local):
    """Memory of one thread: t, x, p, y in one row, and the call without arguments that fills y."""

    # A memoryview is assigned in half the time of an array, and refuses another type or shape.

    def __init__(self, n_x, n_p, n_y, connect):
        row = np.zeros(1 + n_x + n_p + n_y)
        parts = np.split(row, np.cumsum([1, n_x, n_p]))
        run, self._alive = connect(row, parts)
        self.row, self.buffer = (*map(memoryview, parts[:3]), parts[3], run), (*parts, run)
        self.start, self.address = row[: 1 + n_x + n_p], row.ctypes.data
        self._log = np.empty((0, 0)), 0

    def log(self, rows, columns):
        """Memory for a log and its address; the next log overwrites it."""
        if len(self._log[0]) < rows:
            log = np.empty((rows, columns))
            self._log = log, log.ctypes.data
        return self._log


def connected(f, parts):
    """The call of a CasADi function on arrays t, x, p, y, and the buffer that must live as long as the call."""
    with _guard:
        buffer, run = f.buffer()
    for i, part in enumerate(parts[:3]):
        buffer.set_arg(i, memoryview(part))
    buffer.set_res(0, memoryview(parts[3]))
    return run, buffer


class Interpreter:
    """Evaluation by CasADi, with the loops in Python."""

    backend = "casadi"

    def __init__(self, f, project=None, sizes=None):
        self._f, self._n_x, self._project, self._sizes = f, f.numel_in(1), project, sizes
        self.workspace = Workspace(self._n_x, f.numel_in(2), f.numel_out(0), self._connect)

    def _connect(self, row, parts):
        return connected(self._f, parts)

    def _value(self, t, x, p):
        row_t, row_x, row_p, row_y, run = self.workspace.row
        row_t[0], row_x[:], row_p[:] = t, x, p
        run()
        return row_y.copy()

    def native(self, suffix):
        """None: CasADi has no C functions."""

    def grid(self, t, x, p, y):
        """Fill y (n_y, N) with the outputs at t (N,) and the columns of x, and of p if that is a matrix."""
        whole = t.size - t.size % BLOCK
        parts = [np.empty((BLOCK, size)) for size in (1, self._n_x, self._f.numel_in(2), len(y))]
        if whole:
            parts[2][:] = 0.0 if p.ndim == 2 else p
            run, alive = connected(self._block, parts)  # the buffer lives as long as its name
        for k in range(0, whole, BLOCK):
            here = slice(k, k + BLOCK)
            parts[0][:, 0], parts[1][:] = t[here], x[:, here].T
            if p.ndim == 2:
                parts[2][:] = p[:, here].T
            run()
            y[:, here] = parts[3].T
        for k in range(whole, t.size):
            y[:, k] = self._value(t[k], x[:, k], p[:, k] if p.ndim == 2 else p)

    @functools.cached_property
    def _block(self):
        """The function at `BLOCK` points; the bits are those of single points."""
        return self._f.map(BLOCK)

    @np.errstate(all="ignore")
    def rk(self, t0, x0, h, counts, p, tableau, states, outputs):
        """Fill columns of states and outputs; return the index of the last one. See `Compiled.rk`."""
        (n_steps, every, project_every), (a, b, c) = counts, tableau
        x, column, n_x = x0, 0, self._n_x
        for step in range(n_steps + 1):
            if not np.isfinite(x).all():
                break
            y = self._value(t0 + step * h, x, p)
            if step % every == 0 or step == n_steps:
                states[:, column], outputs[:, column] = x, y[n_x:]
                column += 1
            if step < n_steps:
                k = [y[:n_x]]
                for j in range(1, len(b)):
                    z = x + h * (a[j, :j] @ np.array(k))
                    k.append(self._value(t0 + (step + c[j]) * h, z, p)[:n_x])
                x = x + h * (b @ np.array(k))
                if project_every and (step + 1) % project_every == 0:
                    x = self._restore(t0 + (step + 1) * h, x, p)
        return column - 1

    @np.errstate(all="ignore")
    def taylor(self, t1, rtol, atol, every, max_steps):
        """Rows (t, x, y) of the steps from the start in the workspace; see `Compiled.taylor`."""
        nq, n, top, last, plain = (self._sizes[key] for key in ("nq", "n", "top", "last", "plain"))
        start, n_x = self.workspace.start.copy(), self._n_x
        t, x, p, rows = start[0], start[1 : 1 + n_x], start[1 + n_x :], []
        while True:
            end = np.concatenate([[t], x, np.zeros(len(self.workspace.row[3]))])
            if len(rows) == max_steps or t == t1:
                break
            y = self._value(t, x, p)
            of_q = y[: nq * last].reshape(last, nq)
            c = of_q if plain else y[nq * last : (nq + n) * last].reshape(last, n)
            h = step_length(x, c, (nq, n, top), rtol, atol)
            h = h if plain else min(h, step_length(x, of_q, (nq, nq, 1), rtol, atol))
            if not h > 1e-13 * (1 + abs(t)):
                break
            ends = h >= abs(t1 - t) * (1 - 1e-12)
            h = t1 - t if ends else np.copysign(h, t1 - t)
            following = np.concatenate([x[:nq] + jet(of_q, 0, h), *(jet(c, j, h) for j in range(1, top))])
            if not np.isfinite(following).all():
                break
            rows.append(np.concatenate([[t], x, y]))
            t, x = t1 if ends else t + h, following
            if every and len(rows) % every == 0:
                x = self._restore(t, x, p)
        return np.array([*rows, end])

    def _restore(self, t, x, p):
        return restored(self._project, t, x, p)

    def newton(self, t, x0, p, tol, max_iter, x, y):
        """Fill columns of x and y; return the numbers of points solved and of evaluations. See `Compiled.newton`."""
        solve, k, alone = _Newton(self._value, p, self._n_x, tol, max_iter), 0, 1
        parts = np.zeros(BLOCK), np.zeros((BLOCK, len(x))), np.tile(p, (BLOCK, 1)), np.zeros((BLOCK, len(y)))
        block = (parts, *connected(self._block, parts)) if t.size > BLOCK else None
        while k < t.size:
            point = (x[:, k - 1].copy(), y[:, k - 1].copy()) if k else None
            if alone <= k <= t.size - BLOCK:
                if solve.together(t[k - 1 : k + BLOCK], point, block):
                    x[:, k : k + BLOCK], y[:, k : k + BLOCK] = parts[1].T, parts[3].T
                    k += BLOCK
                    continue
                alone = k + BLOCK
            point = solve.advance(t[k - 1], t[k], *point) if k else solve.correct(t[k], x0)
            if point is None:
                break
            x[:, k], y[:, k] = point
            k += 1
        return k, solve.count


def restored(project, t, x, p):
    """The state with its invariants restored, by Newton's iteration as in restore.h."""
    for _ in range(6):
        d = np.asarray(project(t, x, p[: project.numel_in(2)])).ravel()
        if not np.isfinite(d).all():
            return x
        largest, x = np.max(np.abs(d) / (1 + np.abs(x)), initial=0.0), x + d
        if largest <= ROUNDING:
            break
    return x


def jet(c, j, h):
    """Change (n,) of the j-th derivative in a time h, from Taylor coefficients c (last, n) of index 1 .. last."""
    k = np.arange(1, len(c) + 1)
    falling = np.prod([k - m for m in range(j)], axis=0) if j else np.ones(len(c))
    total = np.zeros(c.shape[1])
    for i in reversed(range(max(j, 1) - 1, len(c))):
        total = total * h + falling[i] * c[i]
    return total if j else total * h


def step_length(x, c, shape, rtol, atol):
    """The step at which the last term meets the tolerance, if terms grow as the fastest of the upper half."""
    nq, n, top = shape
    h, last = np.inf, len(c)
    for j in range(top):
        level = x[:nq] if j == 0 else x[nq + (j - 1) * n : nq + j * n]
        scale = atol + rtol * np.max(np.abs(level), initial=0.0)
        for k in range(last // 2 if last // 2 > j else j + 1, last + 1):
            term = np.prod([k - m for m in range(j)]) * np.max(np.abs(c[k - 1]), initial=0.0)
            if not np.isfinite(term):
                return 0.0
            if term > 0:
                h = min(h, rtol ** (1.0 / (last - j)) * (scale / rtol / term) ** (1.0 / (k - j)))
    return h


class _Newton:
    """Newton's iteration along a path; a solution is a pair (x, y), and None where the iteration fails."""

    def __init__(self, value, p, n_x, tol, max_iter):
        self._value, self._p, self._n_x, self._tol, self._max_iter = value, p, n_x, tol, max_iter
        self.count = 0

    def _at(self, t, x):
        self.count += 1
        y = self._value(t, x, self._p)
        delta = y[: self._n_x]
        defect = (np.abs(delta) / (1 + np.abs(x))).max(initial=0.0)  # a NaN or inf of delta shows here, an inf of x not
        return y, delta, defect if defect < np.inf and np.isfinite(x).all() else np.inf

    @np.errstate(all="ignore")
    def correct(self, t, x):
        """The solution at time t, from x."""
        for _ in range(self._max_iter + 1):
            y, delta, defect = self._at(t, x)
            if defect <= self._tol:
                break
            if not np.isfinite(defect):
                return None
            x = x + delta
        else:
            return None
        if defect > ROUNDING:
            y_next, _, defect_next = self._at(t, x + delta)
            if defect_next < defect:
                return x + delta, y_next
        return x, y

    @np.errstate(all="ignore")
    def advance(self, a, b, x, y):
        """The solution at b from x, y at a: predicted by the rate; the step is halved where the correction fails."""
        t, done, pieces = a, 0, 1
        while done < pieces:
            following = b if done + 1 == pieces else a + (b - a) * ((done + 1) / pieces)
            point = self.correct(following, x + (following - t) * y[self._n_x : 2 * self._n_x])
            if point is not None:
                (x, y), t, done = point, following, done + 1
                while pieces > 1 and done % 2 == 0:
                    done, pieces = done // 2, pieces // 2
            elif pieces == 2**BISECTIONS:
                return None
            else:
                done, pieces = 2 * done, 2 * pieces
        return x, y

    @np.errstate(all="ignore")
    def together(self, t, point, block):
        """Fill the block with the solutions at t[1:], from the one at t[0]; False where the iteration fails.

        Every `STRIDE`-th instant is solved alone; the others start from Hermite's cubic interpolation between these.
        """
        (instants, x, _, y), run, _ = block
        n_x, nodes = self._n_x, [point]
        for a, b in pairwise(t[::STRIDE]):
            if (point := self.advance(a, b, *nodes[-1])) is None:
                return False
            nodes.append(point)
        z = np.array([x for x, _ in nodes])[:, None]
        rate = np.array([y[n_x : 2 * n_x] for _, y in nodes])[:, None]
        instants[:], h = t[1:], np.diff(t[::STRIDE])[:, None, None]
        s = (t[1:].reshape(-1, STRIDE, 1) - t[:-1:STRIDE, None, None]) / h
        r = 1 - s
        start = r * r * ((1 + 2 * s) * z[:-1] + s * h * rate[:-1]) + s * s * ((1 + 2 * r) * z[1:] - r * h * rate[1:])
        x[:], defect = start.reshape(BLOCK, n_x), NEAR

        def correction():
            run()
            self.count += BLOCK
            return np.max(np.abs(y[:, :n_x]) / (1 + np.abs(x)))

        while not defect <= QUADRATIC:
            before, defect = defect, correction()
            if not defect < before:  # the interpolation was too far off, or the iteration does not converge
                return False
            x += y[:, :n_x]
        return correction() <= self._tol
