"""Evaluations and loops of a function by CasADi and NumPy: for short motions, and where there is no compiler."""

import ctypes
import functools
import threading
from itertools import pairwise
from math import ldexp, perm

import numpy as np

from servoctl.codegen.loops import (
    BEND,
    CONTRACTION,
    CORRECTED,
    CORRECTIONS,
    FOLLOWED,
    LAST_TERM,
    QUADRATIC,
    REST,
    ROUNDING,
    SHORTEST,
    STEADY,
)
from servoctl.codegen.machine import ENOUGH, machine
from servoctl.codegen.paths import evaluated, jets_at, jets_in, none_chosen, with_jets

BLOCK = 128  # instants of a path that are solved together
MANY_POINTS = 2_000  # one by one, of which CasADi takes longer than writing a list of operations or loading a library

_guard = threading.Lock()


class Workspace(threading.local):
    """Memory of one thread: t, x, p, y in one row, and the call without arguments that fills y."""

    # A memoryview is assigned in half the time of an array, and refuses another type or shape.

    def __init__(self, n_x, n_p, n_y, connect):
        row = np.zeros(1 + n_x + n_p + n_y)
        parts = np.split(row, np.cumsum([1, n_x, n_p]))
        run, self._alive = connect(row, parts)
        self.row, self.buffer = (*map(memoryview, parts[:3]), parts[3], run), (*parts, run)
        self.start = row[: 1 + n_x + n_p]
        self.steps = StepsOfThread(row, 1 + n_x + n_y)  # an attribute of a thread's own takes as long as three others


class StepsOfThread:
    """The Steps of taylor.c with their memory: five numbers, and addresses of start, log, ends and weights.

    `start` holds t, x and p; a row of the log has `columns` entries.
    """

    __slots__ = "_address", "_columns", "_end", "_ends", "_memory", "_most", "log", "numbers", "pointer", "weights"

    def __init__(self, start, columns):
        self._memory = np.zeros(9), np.zeros(1), start
        task, end, _ = self._memory
        self.numbers, self._address, self._end = memoryview(task), memoryview(task.view(np.int64)), memoryview(end)
        self.numbers[0], self._address[5], self._address[7] = 1.0, start.ctypes.data, end.ctypes.data
        self.pointer = ctypes.c_void_p(task.ctypes.data)
        self.log, self._columns, self._most, self._ends, self.weights = None, columns, -1, None, None

    def of(self, ends, rtol, atol, every, most, weights):
        """Set what `Library.taylor` takes; the ends may be a float."""
        if most > self._most:
            self.log, self._most = np.empty((most + 1, self._columns)), most
            self._address[6] = self.log.ctypes.data
        numbers = self.numbers
        numbers[1], numbers[2], numbers[3], numbers[4] = rtol, atol, every, most
        if isinstance(ends, float):  # an array's address takes as long as a step
            self._end[0] = ends
            if self._ends is not None:
                numbers[0], self._address[7], self._ends = 1.0, self._memory[1].ctypes.data, None
        else:
            self._ends = np.atleast_1d(np.ascontiguousarray(ends, dtype=float))
            numbers[0], self._address[7] = self._ends.size, self._ends.ctypes.data
        if weights is not self.weights:
            self.weights = weights
            self._address[8] = 0 if weights is None else weights.ctypes.data


class Blocks(threading.local):
    """Memory of one thread for the t, x, p and y (size, BLOCK) of a block, and the call that fills y."""

    def __init__(self, block, sizes, connect):
        parts = [np.zeros((size, BLOCK), order="F") for size in sizes]
        run, self._alive = connect(block, [part.ravel("K") for part in parts])
        self.parts = parts, run


def connected(f, parts):
    """The call of a CasADi function on arrays of its inputs and y, and the buffer that must live as long as it."""
    with _guard:
        buffer, run = f.buffer()
    for i, part in enumerate(parts[:-1]):
        buffer.set_arg(i, memoryview(part))
    buffer.set_res(0, memoryview(parts[-1]))
    return run, buffer


class Interpreter:
    """Evaluation by CasADi, with the loops in Python."""

    backend = "casadi"

    def __init__(self, f, project=None, sizes=None, settled=None):
        self._f, self._n_x, self._project, self._sizes, self._settled = f, f.numel_in(1), project, sizes, settled
        self._parts, self._points, self._machine = (1, self._n_x, f.numel_in(2), f.numel_out(0)), 0, None
        self.workspace = Workspace(*self._parts[1:], self._connect)

    def _connect(self, row, parts):
        return self._connected(self._f, parts)

    def _connected(self, f, parts):
        """The call of the function, at one point or several, on arrays t, x, p, y; jets follow from t and p."""
        if not jets_in(self._f):
            return connected(f, parts)
        t, p = np.reshape(parts[0], -1), np.reshape(parts[2], (-1, self._parts[2]))
        r = np.zeros((len(t), jets_in(self._f)))
        run, alive = connected(f, [*parts[:3], r, parts[3]])

        def filled(jets=None):
            r[:] = jets_at(self._f, t, p.T).T if jets is None else jets
            run()

        return filled, alive

    def _value(self, t, x, p, *jets):
        """The outputs at a point, with the jets of references if they are known."""
        row_t, row_x, row_p, row_y, run = self.workspace.row
        row_t[0], row_x[:], row_p[:] = t, x, p
        run(*jets)
        return row_y.copy()

    def native(self, suffix):
        """None: CasADi has no C functions."""

    def grid(self, t, x, p, y):
        """Fill y (n_y, N) with the outputs at t (N,) and the columns of x, and of p if that is a matrix."""
        self._points += t.size
        if self._points >= MANY_POINTS and t.size >= ENOUGH and self._by_machine(t.size):
            self._machine.grid(t, x, with_jets(self._f, t, p), y)
            return
        left = t.size % BLOCK
        blocks = t.size - left * (left < BLOCK // 2)  # a block with half as many points is faster than these one by one
        if t.size < BLOCK and "_blocks" not in vars(self):  # making them takes longer; same bits
            blocks = 0
        if blocks:
            parts, run = self._blocks.parts
            parts[2][:] = p[:, :1] if p.ndim == 2 else p[:, None]  # also where a block is not full: paths have a place
        for k in range(0, blocks, BLOCK):
            here, size = slice(k, k + BLOCK), min(BLOCK, t.size - k)
            parts[0][0, :size], parts[1][:, :size] = t[here], x[:, here]
            if p.ndim == 2:
                parts[2][:, :size] = p[:, here]
            run()
            y[:, here] = parts[3][:, :size]
        left = slice(blocks, None)
        for k, jets in zip(range(blocks, t.size), self._jets(t[left], p[:, left] if p.ndim == 2 else p), strict=True):
            y[:, k] = self._value(t[k], x[:, k], p[:, k] if p.ndim == 2 else p, *jets)

    def _jets(self, t, p):
        """For each of the times (N,), what a single evaluation takes beside t, x and p: jets of references, if any."""
        return [(jets,) for jets in jets_at(self._f, t, p).T] if len(t) and jets_in(self._f) else [()] * len(t)

    @functools.cached_property
    def _blocks(self):
        return Blocks(self._block, self._parts, self._connected)

    def _by_machine(self, points):
        """Whether so many points are evaluated in C."""
        if self._machine is None and not none_chosen():
            self._machine = machine(self._f, points)
        return self._machine

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
    def taylor(self, ends, rtol, atol, every, max_steps, weights=None):
        """Rows (t, x, y) of the steps from the start in the workspace; see `Compiled.taylor`."""
        nq, n, top, last, plain = (self._sizes[key] for key in ("nq", "n", "top", "last", "plain"))
        start, n_x, moved = self.workspace.start.copy(), self._n_x, 0.0
        t, x, p, rows, (t1, *later) = start[0], start[1 : 1 + n_x], start[1 + n_x :], [], np.atleast_1d(ends)
        p[-1] = (t + t1) / 2
        free = np.array(self._sizes.get("free", [1] * (n_x - nq)), dtype=bool).reshape(top - 1, n)
        w = np.ones(n_x) if weights is None else weights
        while True:
            if len(rows) == max_steps or t == (later or [t1])[-1]:
                x = self._settle(t, x, p)
                break
            if t == t1:
                t1, *later = later
                p[-1] = (t + t1) / 2
            y = self._value(t, x, p)
            of_q = y[: nq * last].reshape(last, nq)
            c = of_q if plain else y[nq * last : (nq + n) * last].reshape(last, n)
            levels = zip(*(part[nq:].reshape(top - 1, n) for part in (x, w)), free, strict=True)
            moved = np.abs(w[:nq] * (x[:nq] - start[1 : 1 + nq])).max(initial=moved)
            of_rates = (longest((u * v)[i], (u * c)[:, i], j, rtol, atol) for j, (v, u, i) in enumerate(levels, 1))
            h = rough_exp2(min(longest(moved, w[:nq] * of_q, 0, rtol, atol), *of_rates))
            if not h > 1e-13 * (1 + abs(t)):
                x = self._settle(t, x, p)
                break
            x[nq:][~free.ravel()] = np.concatenate([jet(c, j, 0.0) for j in range(1, top)])[~free.ravel()]
            reached = h >= abs(t1 - t) * (1 - 1e-12)
            h = t1 - t if reached else np.copysign(h, t1 - t)
            following = np.concatenate([x[:nq] + jet(of_q, 0, h), *(jet(c, j, h) for j in range(1, top))])
            if not np.isfinite(following).all():
                break
            rows.append(np.concatenate([[t], x, y]))
            t, x = t1 if reached else t + h, following
            if every and len(rows) % every == 0:
                x = self._restore(t, self._settle(t, x, p), p)
        return np.array([*rows, np.concatenate([[t], x, np.zeros(len(self.workspace.row[3]))])])

    def whole(self, *_):
        """None: without a compiler a motion is no single call."""

    def jets(self, log, k, t, p, counts, z):
        """Fill z with the jets at times t in the steps k of a log; see `Compiled.jets`."""
        nq, n, last, plain = (self._sizes[key] for key in ("nq", "n", "last", "plain"))
        levels, settled = counts
        x, y = log[k, 1 : 1 + nq], log[k, 1 + self._n_x :]
        of_q = y[:, : nq * last].reshape(-1, last, nq)
        c = of_q if plain else y[:, nq * last : (nq + n) * last].reshape(-1, last, n)
        h = (t - log[k, 0])[:, None]
        z[:nq] = (x + jet(of_q, 0, h)).T
        for j in range(1, levels + 1):
            z[nq + (j - 1) * n : nq + j * n] = jet(c, j, h).T
        if settled and self._settled is not None:
            for i, (when, x) in enumerate(zip(t, z[: self._n_x].T.copy(), strict=True)):
                branch = (log[k[i], 0] + log[k[i] + 1, 0]) / 2
                z[:settled, i] = self._settling._value(when, x, np.append(p[:-1], branch))[:settled]

    @functools.cached_property
    def _settling(self):
        return Interpreter(self._settled)

    def _settle(self, t, x, p):
        """The state with the rates that rows determine."""
        return x if self._settled is None else self._settling._value(t, x, p)[: self._n_x]

    def _restore(self, t, x, p):
        return restored(self._project, t, x, p)

    def _path(self, p):
        return _Path(self._value, p, self._n_x, (self._sizes or {}).get("pivots", 0))

    @np.errstate(all="ignore")
    def continuation(self, cuts, x0, p, longest, nodes):
        """Fill rows of nodes; return their number and that of evaluations. See `Compiled.continuation`."""
        path, k, h = self._path(p), 0, longest
        point, _ = path.correct(cuts[0], x0, np.inf)
        t, pieces = cuts[0], iter(pairwise(cuts))
        begin, end = next(pieces, (None, None))
        while point is not None:
            nodes[k] = np.concatenate([[t], *point])
            k += 1
            if k == len(nodes) or end is None:
                break
            least = SHORTEST * min(longest, abs(end - begin))
            t, h, point = path.step(t, end, max(h, least) if t == begin else h, least, point)
            h, (begin, end) = min(h, longest), next(pieces, (None, None)) if t == end else (begin, end)
        return k, path.count

    def _blockwise(self, parts, points):
        """The call of the function on arrays (BLOCK, n) of t, x, p and y, and what must live as long as it."""
        if not self._by_machine(points):
            return self._connected(self._block, parts)
        t, x, p, y = (part.T for part in parts)
        return lambda: self._machine.grid(t, x, with_jets(self._f, t, p[:, 0]), y), None

    @np.errstate(all="ignore")
    def newton(self, t, nodes, p, z):
        """Fill columns of z; return the numbers of points solved and of evaluations. See `Compiled.newton`."""
        path, k, alone = self._path(p), 0, 0
        (_, n_x, _, n_y), rows = self._parts, len(z)
        parts = np.zeros(BLOCK), np.zeros((BLOCK, n_x)), np.tile(p, (BLOCK, 1)), np.zeros((BLOCK, n_y))
        call = self._blockwise(parts, t.size) if t.size >= BLOCK else None
        forward = nodes[-1, 0] >= nodes[0, 0]
        ends = nodes[1:, 0] if forward else -nodes[1:, 0]
        first = np.minimum(np.searchsorted(ends, t if forward else -t), max(len(nodes) - 2, 0))
        last = np.minimum(first + 1, len(nodes) - 1)
        while k < t.size:
            block = slice(k, k + BLOCK)
            if alone <= k <= t.size - BLOCK:
                if path.together(t[block], nodes[first[block]], nodes[last[block]], parts, call[0]):
                    z[:n_x, block], z[n_x:, block] = parts[1].T, parts[3][:, n_x:rows].T
                    k += BLOCK
                    continue
                alone = k + BLOCK
            point = path.between(t[k], nodes[first[k]], nodes[last[k]])
            if point is None:
                break
            z[:n_x, k], z[n_x:, k] = point[0], point[1][n_x:rows]
            k += 1
        return k, path.count


def restored(project, t, x, p):
    """The state with its invariants restored, by Newton's iteration as in restore.h."""
    for _ in range(6):
        d = evaluated(project, t, x, p)
        if not np.isfinite(d).all():
            return x
        largest, x = np.max(np.abs(d) / (1 + np.abs(x)), initial=0.0), x + d
        if largest <= ROUNDING:
            break
    return x


def restored_grid(project, t, x, p):
    """States x (n_x, N) at times t (N,), each restored in the same way; `project` is an `Interpreter`."""
    x, left = np.array(x, dtype=float), np.arange(len(t))
    for _ in range(6):
        d = np.empty((len(x), len(left)))
        project.grid(t[left], x[:, left], p, d)
        finite = np.isfinite(d).all(axis=0)
        left, d = left[finite], d[:, finite]
        largest = np.max(np.abs(d) / (1 + np.abs(x[:, left])), axis=0, initial=0.0)
        x[:, left] += d
        left = left[largest > ROUNDING]
        if not left.size:
            break
    return x


def jet(c, j, h):
    """Change (..., n) of the j-th derivative in times h (..., 1), from coefficients c (..., last, n) of index 1 on."""
    total, last = np.zeros(c.shape[:-2] + c.shape[-1:]), c.shape[-2]
    for k in range(last, max(j, 1) - 1, -1):
        total = total * h + float(perm(k, j)) * c[..., k - 1, :]
    return total if j else total * h


def rough_log2(a):
    """log2 of numbers >= 0 from their bits, as in taylor.c."""
    bits = np.asarray(a, dtype=float).view(np.int64)
    f = ((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000).view(float) - 1.0
    return (bits >> 52) - 1023.0 + f * (1.0 + BEND - BEND * f)


def rough_exp2(a):
    """Its inverse, as in taylor.c."""
    whole, f = divmod(min(max(a, -1022.0), REST), 1.0)
    return ldexp(1.0 + f * (1.0 - BEND + BEND * f), int(whole))


def weighted(atol):
    """The least absolute tolerance and weights (n_x,) by which each entry has this one; None for a number."""
    if np.ndim(atol) == 0:
        return atol, None
    return atol.min(), atol.min() / atol


def longest(level, c, j, rtol, atol):
    """log2 of the step at which the last term of a level j of the state is in tolerance; c (last, n) are coefficients.

    Terms are taken to grow as the fastest of four of them. For q the level is how far it has moved, and the last term
    may also be in tolerance of what q' moves it in the step.
    """
    last = len(c)
    k = np.array([last, last - 1, last // 2 + 1, last // 2])
    k = k[k > max(j, 1)]
    falling = np.prod([k - m + 0.0 for m in range(j)], axis=0) if j else np.ones(len(k))
    scale, log_rtol = rough_log2(atol / rtol + np.max(np.abs(level), initial=0.0)), np.log2(LAST_TERM * rtol)
    rate, sizes = (rough_log2(np.abs(some).max(axis=1, initial=0.0)) for some in (c[:1], c[k - 1]))
    h = log_rtol / (last - j) + (scale - sizes - rough_log2(falling)) / (k - j)
    of_way = log_rtol / (last - 1) + (rate - sizes) / (k - 1)
    return np.min(h if j else np.maximum(h, of_way), initial=np.inf)


def _distance(x, other):
    """The largest difference of two points, relative to 1 + |x|."""
    return np.max(np.abs(other - x) / (1 + np.maximum(np.abs(x), np.abs(other))), axis=-1, initial=0.0)


def _tolerance(x, other):
    """Largest error of a prediction on the way between two points of a path."""
    return np.maximum(FOLLOWED * _distance(x, other), QUADRATIC)


def _hermite(t, a, b, n_x):
    """x at times (N,) between nodes (N, ...), by Hermite's interpolation of x, x' and x''."""
    cuts = [1, 1 + n_x, 1 + 2 * n_x, 1 + 3 * n_x, 1 + 4 * n_x]
    (start, *of_a), (end, *of_b) = (np.split(node, cuts, -1)[:5] for node in (a, b))
    h = end - start
    s = np.divide(t[..., None] - start, h, out=np.zeros_like(h), where=h != 0)

    def part(s, h, x, _, rate, second):
        return (1 - s) ** 3 * ((1 + s * (3 + 6 * s)) * x + s * h * ((1 + 3 * s) * rate + s / 2 * h * second))

    return part(s, h, *of_a) + part(1 - s, -h, *of_b)


class _Path:
    """Points of a path by Newton's method, as in newton.c; a point is a pair (x, y), None where the iteration fails."""

    def __init__(self, value, p, n_x, pivots):
        self._value, self._p, self._n_x, self._pivots, self.count = value, p, n_x, pivots, 0

    def _at(self, t, x):
        self.count += 1
        y = self._value(t, x, self._p)
        delta = y[: self._n_x]
        defect = (np.abs(delta) / (1 + np.abs(x))).max(initial=0.0)  # a NaN or inf of delta shows here, an inf of x not
        return y, delta, defect if defect < np.inf and np.isfinite(x).all() else np.inf

    def correct(self, t, x, factor):
        """The solution at time t from x, by corrections that shrink by a factor; and the size of the first."""
        first, before = None, np.inf
        for _ in range(CORRECTIONS + 1):
            y, delta, defect = self._at(t, x)
            first = defect if first is None else first
            if defect <= CORRECTED or (before <= QUADRATIC and CONTRACTION * before < defect < np.inf):  # or rounding
                break
            if not np.isfinite(defect) or defect > factor * before:
                return None, first
            x, before = x + delta, defect
        else:
            return None, first
        if defect > ROUNDING:
            y_next, _, defect_next = self._at(t, x + delta)
            if defect_next < defect:
                return (x + delta, y_next), first
        return (x, y), first

    def _predict(self, h, x, y):
        n = self._n_x
        return x + h * (y[n : 2 * n] + h / 2 * y[2 * n : 3 * n])

    def _steady(self, y, other):
        """Whether no pivot changes its sign, or its size by more than a factor."""
        size = y.shape[-1] - self._pivots
        a, b = y[..., size:], other[..., size:]
        return bool(np.all(a * b >= STEADY * np.maximum(a * a, b * b)))

    def _finite(self, y):
        return bool(np.isfinite(y[..., : y.shape[-1] - self._pivots]).all())

    def step(self, t, end, h, least, point):
        """One step of at most the length h: the time reached, the next length and the point, None if h vanishes."""
        while True:
            left = abs(end - t)
            length, now = (left, end) if h >= left else (min(h, left / 2), t + np.copysign(min(h, left / 2), end - t))
            if now == t or h < min(least, left):
                return t, h, None
            following, first = self.correct(now, self._predict(now - t, *point), CONTRACTION)
            if following is not None and self._steady(point[1], following[1]):
                allowed = _tolerance(point[0], following[0])
                error = np.maximum(first, _distance(point[0], self._predict(t - now, *following)))  # NaN if one is
                if error <= allowed:
                    growth = min(2.0, 0.9 * np.sqrt(allowed / (error + ROUNDING)))
                    return now, max(growth, 0.5) * length if growth < 1 else max(h, growth * length), following
            h = length / 2

    def between(self, t, a, b):
        """The point at t between two nodes: predicted by both, else reached by steps from the first."""
        x, y = np.split(a[1:], [self._n_x])
        point, first = self.correct(t, _hermite(np.asarray(t), a, b, self._n_x), CONTRACTION)
        near = point is not None and first <= _tolerance(x, b[1 : 1 + self._n_x])
        if near and self._steady(y, point[1]) and self._finite(point[1]):
            return point
        now, h, point = a[0], abs(t - a[0]), (x, y)
        while now != t and point is not None:
            now, h, point = self.step(now, t, h, abs(b[0] - a[0]) * SHORTEST, point)
        return point

    def together(self, t, a, b, parts, run):
        """Fill the parts with the points at times (N,) between nodes (N, ...); False where the iteration fails."""
        (instants, x, _, y), n = parts, self._n_x
        instants[:], x[:] = t, _hermite(t, a, b, n)
        before, largest = np.inf, np.min(_tolerance(a[:, 1 : 1 + n], b[:, 1 : 1 + n]))

        def correction():
            run()
            self.count += len(t)
            return np.max(np.abs(y[:, :n]) / (1 + np.abs(x)))

        while not before <= CONTRACTION * QUADRATIC:
            defect = correction()
            if not defect <= min(before, largest):
                return False
            x += y[:, :n]
            before = CONTRACTION * defect
        return correction() <= CORRECTED and self._steady(a[:, 1 + n :], y) and self._finite(y)
