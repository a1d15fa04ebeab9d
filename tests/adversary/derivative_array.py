"""An independent reference: the derivative array with multipliers, solved at once by least squares.

It shares no code with the package, which eliminates. Unknown are the Taylor coefficients of q, w, of the actuation
and of all multipliers at an instant; the equations are all coefficients of

    q' = V w + h,   r(t, q, w, w') = E u + G_mᵀ ν (+ Gᵀ λ for ideal programs),   φ = 0,   c = 0,

no matter which of them are hidden. CasADi differentiates formulas once or twice (gradients, q''); series are plain numpy.
The unknown coefficient j of x enters coefficient k of a row by [∂row/∂x^(l)]_(k−j+l) j!/(j−l)!, summed over l.
"""

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import casadi as ca
import numpy as np
from scipy.linalg import lstsq

LEVELS = 8  # derivatives of w that formulas may name
CUTOFF = 1e-11  # singular values below this fraction of the largest count as zero
HELD = 1e-11  # a state that leaves equations no more than this, relative to the coefficients, is consistent
MOVED = 1e-6  # of the state: farther than this no drift has taken it
HOLDS = 1e-9  # residuals below this are zero
UNITS = (1.0, 0.1, 1e-2, 1e-3, 1e-4)  # s, of time: coefficients of a quick motion are of one size in a short one
ITERATIONS = 25


def series_of(function, inputs, size):
    """Taylor coefficients (outputs, size) of a CasADi function without loops, of coefficients (inputs, size)."""
    work, out = {}, np.zeros((function.nnz_out(), size))
    zero = np.zeros(size)

    def multiply(a, b):
        return np.convolve(a, b)[:size]

    def divide(a, b):
        c = np.zeros(size)
        for k in range(size):
            c[k] = (a[k] - c[:k] @ b[k:0:-1]) / b[0]
        return c

    def sine_cosine(a):
        s, c = np.zeros(size), np.zeros(size)
        s[0], c[0] = np.sin(a[0]), np.cos(a[0])
        rate = a * np.arange(size)
        for k in range(1, size):
            s[k] = rate[1 : k + 1] @ c[k - 1 :: -1] / k
            c[k] = -(rate[1 : k + 1] @ s[k - 1 :: -1]) / k
        return s, c

    def exponential(a):
        e, rate = np.zeros(size), a * np.arange(size)
        e[0] = np.exp(a[0])
        for k in range(1, size):
            e[k] = rate[1 : k + 1] @ e[k - 1 :: -1] / k
        return e

    one = zero.copy()
    one[0] = 1.0
    binary = {ca.OP_ADD: np.add, ca.OP_SUB: np.subtract, ca.OP_MUL: multiply, ca.OP_DIV: divide}
    unary = {
        ca.OP_NEG: np.negative, ca.OP_SQ: lambda a: multiply(a, a), ca.OP_TWICE: lambda a: 2 * a, ca.OP_EXP: exponential,
        ca.OP_SIN: lambda a: sine_cosine(a)[0], ca.OP_COS: lambda a: sine_cosine(a)[1], ca.OP_INV: lambda a: divide(one, a),
    }  # fmt: skip
    for k in range(function.n_instructions()):
        operation, i, o = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_INPUT:
            work[o[0]] = inputs[i[1]]
        elif operation == ca.OP_OUTPUT:
            out[o[1]] = work[i[0]]
        elif operation == ca.OP_CONST:
            work[o[0]] = one * function.instruction_constant(k)
        elif operation in binary:
            work[o[0]] = binary[operation](work[i[0]], work[i[1]])
        else:
            work[o[0]] = unary[operation](work[i[0]])
    return out


@dataclass
class Solution:
    """What the array determines at an instant.

    `clear`: the accelerations (and the actuation) are determined; `gain`: their largest sensitivity to the equations;
    `residual`: the largest coefficient of an equation, relative to the size of its row of the Jacobian.
    """

    q: np.ndarray
    w: np.ndarray  # (n, coefficients)
    force: np.ndarray  # actuation, or the whole reaction of an ideal program
    clear: bool
    gain: float
    residual: float
    loose: float


class Reference:
    """The equations of a case, and their derivative array."""

    def __init__(self, case):
        n = self.n = case.n
        self.case = case
        self.t, self.q = ca.SX.sym("t"), ca.SX.sym("q", n)
        self.w = [ca.SX.sym(f"w_{level}", n) for level in range(LEVELS)]
        names = {"t": self.t, "sin": ca.sin, "cos": ca.cos, "exp": ca.exp, "D": self.rate}
        names |= {f"q{i}": self.q[i] for i in range(n)}
        names |= {f"w{i}" + (f"_{k}" if k else ""): self.w[k][i] for i in range(n) for k in range(LEVELS)}
        read = lambda text: ca.SX(eval(text, {}, names))  # noqa: E731, S307
        column = lambda texts: ca.vertcat(*map(read, texts)) if texts else ca.SX(0, 1)  # noqa: E731
        self.V = ca.vertcat(*(ca.horzcat(*map(read, row)) for row in case.V)) if case.V else ca.SX.eye(n)
        self.h = column(case.h) if case.h else ca.SX(n, 1)
        positions, masses = column(case.positions), ca.DM(list(case.masses))
        along = ca.jacobian(positions, self.q) @ self.V
        self.mass = along.T @ ca.diag(masses) @ along
        self.balance = along.T @ (masses * self.rate(self.rate(positions)))
        self.balance += self.V.T @ ca.gradient(read(case.potential), self.q) - column(case.forces)
        directions = [
            column(a) if isinstance(a, tuple) else (ca.jacobian(read(a), self.q) @ self.V).T for a in case.actuators
        ]
        self.E = ca.horzcat(*directions) if directions else ca.SX(n, 0)
        self.rows, self.plain, self.material = column(case.rows), column(case.plain), column(case.material)
        self.G, self.orders = self.leading(self.plain)
        self.Gm, material_orders = self.leading(self.material)
        self.G_given, self.orders_given = self.leading(self.rows)
        self.top = max([2, *self.orders, *material_orders, *self.orders_given])
        at = ca.vertcat(self.t, self.q, *self.w)
        self.at = lambda name, e: ca.Function(name, [at], [e])
        self.matrices = ca.Function("m", [at], [self.mass, self.E, self.G_given, self.Gm])
        self._equations()

    def rate(self, e):
        """The total derivative of an expression."""
        if not isinstance(e, ca.SX):
            return 0.0
        result = ca.jtimes(e, self.t, ca.SX(1)) + ca.jtimes(e, self.q, self.V @ self.w[0] + self.h)
        for low, high in zip(self.w, self.w[1:], strict=False):
            result += ca.jtimes(e, low, high)
        return result

    def leading(self, rows):
        """The leading matrix of rows, and their orders."""
        matrix, orders = [], []
        for row in ca.vertsplit(rows) if rows.numel() else []:
            used = [k for k in range(LEVELS) if ca.depends_on(row, self.w[k])]
            orders.append(used[-1] + 1 if used else 0)
            matrix.append(ca.jacobian(row, self.w[used[-1]]) if used else ca.jacobian(row, self.q) @ self.V)
        return ca.vertcat(*matrix) if matrix else ca.SX(0, self.n), orders

    def _equations(self):
        case, n, k, m, km = self.case, self.n, len(self.case.plain), len(self.case.actuators), len(self.case.material)
        ideal, redundant = case.by == "ideal", case.by != "ideal" and m > k
        nu, extra = ca.SX.sym("nu", km), []
        if ideal:
            force = ca.SX.sym("lambda", k)
            reaction, unknown = self.G.T @ force, [force, nu]
        elif redundant:  # u = W⁻¹Pᵀμ = Eᵀy, y = N Gᵀμ, with W = 1; any y if u has k effects only, which the rows give
            force, mu, y, z = (ca.SX.sym(name, size) for name, size in (("u", m), ("mu", k), ("y", n), ("z", km)))
            extra, reaction, unknown = [force - self.E.T @ y, self.Gm @ y], self.E @ force, [force, nu, y]
            if self._reach() > k:
                extra.append(self.mass @ y + self.Gm.T @ z - self.G.T @ mu)
                unknown += [mu, z]
        else:
            force = ca.SX.sym("u", m)
            reaction, unknown = self.E @ force, [force, nu]
        self.multipliers = ca.vertcat(*unknown)
        self.multiplier_sizes = np.ones(self.multipliers.numel())
        if redundant:
            self.multiplier_sizes[m + km : m + km + n] = case.sizes[1]
        self.count = force.numel()
        total = self.balance - reaction - self.Gm.T @ nu
        nearly = "nearly dependent" in case.kinds  # the array is as badly conditioned as such rows, their equivalent is not
        program, orders = (self.plain, self.orders) if nearly else (self.rows, self.orders_given)
        rows = ca.vertcat(self.V @ self.w[0] + self.h, total, *extra, program, self.material)
        levels = [self.q, *self.w[: self.top + 1]]
        values = ca.vertcat(self.t, *levels, self.multipliers)
        jacobian = ca.jacobian(rows, ca.vertcat(*levels, self.multipliers))
        self.pattern = jacobian.sparsity()
        nonzeros = ca.vertcat(*jacobian.nonzeros()) if jacobian.nnz() else ca.SX(0, 1)
        self.function = ca.Function("rows", [values], [ca.cse(ca.vertcat(ca.densify(rows), nonzeros))])
        self.n_rows, self.n_extra = rows.numel(), sum(e.numel() for e in extra)
        _, made = self.leading(self.material)
        self.row_levels = [0] * n + [1] * n + [-10] * self.n_extra + [order - 1 for order in (*orders, *made)]

    def _reach(self):
        """The number of effects that the actuators have: the largest at some states near the guess."""
        moves = np.random.default_rng(0).normal(0, 0.3, (3, self.n)) * self.case.sizes[0]
        speeds = np.array(self.case.speeds)[:, None]
        return max(self.ranks(0.1, self.case.guess + move, speeds)["reach"] for move in moves)

    def array(self, t, q, w, multipliers):
        """Residuals and Jacobian with respect to all coefficients of q (n, N+2), w (n, N+1), multipliers (p, N)."""
        n, N, levels = self.n, w.shape[1] - 1, self.top + 2
        size, p = N + 2, len(multipliers)
        inputs = np.zeros((1 + n * levels + p, size))
        inputs[0, 0], inputs[0, 1] = t, 1.0
        inputs[1 : 1 + n] = q
        for level in range(levels - 1):
            ladder = np.array([factorial(j) / factorial(j - level) for j in range(level, N + 1)])
            inputs[1 + n * (level + 1) : 1 + n * (level + 2), : N + 1 - level] = w[:, level:] * ladder
        inputs[1 + n * levels :, :N] = multipliers
        out = series_of(self.function, inputs, size)
        values, partial = out[: self.n_rows], out[self.n_rows :]
        lengths = [min(N - level, size - 1) + 1 if level > -10 else N for level in self.row_levels]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        residual, columns = np.zeros(starts[-1]), n * (N + 2) + n * (N + 1) + p * N
        J = np.zeros((starts[-1], columns))
        for row, length in enumerate(lengths):
            residual[starts[row] : starts[row] + length] = values[row, :length]
        for i in range(n):  # q' = V w + h
            k = np.arange(lengths[i])
            residual[starts[i] + k] -= (k + 1) * q[i, k + 1]
            J[starts[i] + k, i * (N + 2) + k + 1] -= k + 1
        row_of, column_of = self.pattern.get_triplet()
        for row, column, P in zip(row_of, column_of, partial, strict=True):
            if column < n:
                first, width, level = column * (N + 2), N + 2, 0
            elif column < n * levels:
                level, i = divmod(column - n, n)
                first, width = n * (N + 2) + i * (N + 1), N + 1
            else:
                first, width, level = n * (2 * N + 3) + (column - n * levels) * N, N, 0
            for j in range(level, width):
                k = np.arange(max(0, j - level), lengths[row])
                J[starts[row] + k, first + j] += P[k - (j - level)] * (factorial(j) / factorial(j - level))
        return residual, J

    def solve(self, t, q0, w0, more=0, near=False, unit=1.0):
        """The array at an instant from a state of the motion: q0 (n,), w0 (n, coefficients), without accelerations.

        Its columns are scaled to a unit of time [s] and to the coordinates in which the case was drawn.

        A state that is `near` a consistent one is held until the higher coefficients fit it, and moved then.
        """
        n, N, p = self.n, self.top + more, self.multipliers.numel()
        known = min(w0.shape[1], N + 1)
        x = np.zeros(n * (2 * N + 3) + p * N)
        q, w, multipliers = self._parts(x, N)
        q[:, 0], w[:, :known] = q0, w0[:, :known]
        state = np.zeros(len(x), dtype=bool)
        q_state, w_state, _ = self._parts(state, N)
        q_state[:, 0], w_state[:, : min(known, self.top - 1)] = True, True
        natural, times, everything = np.ones(len(x)), np.ones(len(x)), np.ones(len(x), dtype=bool)
        for part, size in zip(self._parts(natural, N), (*self.case.sizes, self.multiplier_sizes), strict=True):
            part[:] = size[:, None]
        for part in self._parts(times, N):
            part[:] = unit ** -np.arange(part.shape[1])
        sizes = natural * times
        if not self._newton(t, x, N, ~state if near else everything, sizes):
            return None
        if near:
            residual, J = self.array(t, q, w, multipliers)
            off = np.abs(residual * self._row_scales(J * sizes)).max()
            held = x.copy()
            if off > HELD * (1 + np.abs(x / sizes).max()) and not self._newton(t, x, N, everything, sizes):
                return None
            if np.abs((x - held) / natural)[state].max() > MOVED * (1 + np.abs((held / natural)[state]).max()):
                x[:] = held  # Newton's method has left for another motion, next to a singular one
        residual, J = self.array(t, q, w, multipliers)
        J *= sizes
        scale = self._row_scales(J)
        clear, gain, loose = self._determined(J[:, ~state] * scale[:, None], state, N, times)
        reaction = np.array(self._force(t, q, w, multipliers))
        return Solution(q[:, 0], w.copy(), reaction, clear, gain, float(np.abs(residual * scale).max()), loose)

    @staticmethod
    def _row_scales(J):
        return 1 / np.maximum(np.abs(J).max(axis=1), 1e-300)

    def _newton(self, t, x, N, free, sizes):
        """Gauss-Newton steps of least norm on the free coefficients of x, in place; False where numbers end."""
        size = np.inf
        for _ in range(ITERATIONS):
            residual, J = self.array(t, *self._parts(x, N))
            if not np.all(np.isfinite(J)):
                return False
            J *= sizes
            scale = self._row_scales(J)
            step = self._least(J[:, free] * scale[:, None], residual * scale)
            length, largest = np.abs(step).max(), 1 + np.abs(x / sizes).max()
            x[free] -= step * sizes[free] * min(1.0, 3.0 * largest / max(length, 1e-300))
            length /= 1 + np.abs(x / sizes).max()
            if length < 1e-13 or (length < 1e-9 and length > 0.5 * size):
                break
            size = length
        return True

    def _parts(self, x, N):
        n = self.n
        q, w, rest = x[: n * (N + 2)], x[n * (N + 2) : n * (2 * N + 3)], x[n * (2 * N + 3) :]
        return q.reshape(n, N + 2), w.reshape(n, N + 1), rest.reshape(-1, N)

    @staticmethod
    def _least(J, r):
        """The step of least norm; a complete orthogonal factorisation, several times faster than an SVD."""
        return lstsq(J, r, cond=CUTOFF, lapack_driver="gelsy", check_finite=False)[0]

    def _determined(self, J, state, N, times):
        key = np.zeros(len(state), dtype=bool)
        _, w, multipliers = self._parts(key, N)
        w[:, self.top - 1] = True
        multipliers[: self.count, 0] = True
        key, times = key[~state], times[~state]
        _, s, v = np.linalg.svd(J, full_matrices=True)
        s = np.append(s, np.zeros(len(v) - len(s)))
        live = s > CUTOFF * s[0]
        loose = float(np.linalg.norm(v[~live][:, key])) if not live.all() else 0.0
        gain = float(np.linalg.norm(v[live][:, key] * times[key] / s[live, None]))
        return loose < 1e-6, gain, loose

    def _force(self, t, q, w, multipliers):
        if self.case.by != "ideal":
            return multipliers[: self.count, 0]
        jets = np.concatenate([[t], q[:, 0], *(w[:, k] * factorial(k) for k in range(2))])
        jets = np.append(jets, np.zeros(self.n * (LEVELS - 2)))
        return np.array(self._balance(jets)).ravel()

    @cached_property
    def _balance(self):
        return self.at("balance", self.balance)

    def determined(self, t, q0, w0, near=False):
        """The solution of the shortest array that determines accelerations and actuation, else of the longest."""
        first = None
        for unit in UNITS if near else UNITS[:1]:
            for more in dict.fromkeys((1, 3, 5, 2 * self.n + 1)):
                solution = self.solve(t, q0, w0, more, near, unit)
                if solution is not None and (solution.clear and solution.residual < HOLDS):
                    return solution
            first = first or solution
        return first

    def ranks(self, t, q0, w):
        """Singular values that decide who can realise the program, at a state: a dict of arrays."""
        jets = np.zeros(1 + self.n * (LEVELS + 1))
        jets[0], jets[1 : 1 + self.n] = t, q0
        for level in range(min(w.shape[1], LEVELS)):
            jets[1 + self.n * (level + 1) : 1 + self.n * (level + 2)] = w[:, level] * factorial(level)
        M, E, G, Gm = (np.array(a).reshape(a.shape) for a in self.matrices(jets))
        size = self.case.sizes[1]
        M, E, G, Gm = size[:, None] * M * size, size[:, None] * E, G * size, Gm * size
        unit = lambda a: a / np.maximum(np.linalg.norm(a, axis=1), 1e-300)[:, None]  # noqa: E731
        smallest = lambda a: np.linalg.svd(a, compute_uv=False).min(initial=np.inf)  # noqa: E731
        both = np.hstack([E, Gm.T]) if E.size or Gm.size else np.zeros((self.n, 0))
        kernel = np.linalg.svd(Gm)[2][np.linalg.matrix_rank(Gm) :].T if len(Gm) else np.eye(self.n)
        N = kernel @ np.linalg.solve(kernel.T @ M @ kernel, kernel.T)
        return {
            "directions": smallest(unit(both.T)) if both.size else np.inf,
            "reach": np.linalg.matrix_rank(both) - np.linalg.matrix_rank(Gm) if both.size else 0,
            "decoupling": smallest(unit(G @ N @ E)) if E.size else 0.0,
            "rows": smallest(unit(np.vstack([G, Gm]))),
            "mass": smallest(M),
        }
