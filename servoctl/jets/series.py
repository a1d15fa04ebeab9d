"""Truncated Taylor arithmetic over CasADi expressions: derivatives of any order at polynomial cost.

A `Tape` is the instruction list of SX expressions. `Series` runs it on truncated power series in one
variable, coefficient by coefficient, with the usual recurrences (O(k) operations for coefficient k of a
product). The coefficients are SX expressions, when a derivative is to be derived, or NumPy arrays over
many points, when it is to be evaluated: the same recurrences serve both. Coefficients are *normalised*:
coefficient k of f is f^(k)/k!.

A `Motion` gives the coefficients of every symbol of an expression; a `Flow` is rows along a motion in numbers.
"""

from copy import copy
from math import factorial, prod

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError
from servoctl.jets.tape import (
    JETS,
    REAL,
    Scalars,
    add,
    apply,
    column_of,
    divide,
    finite,
    holds,
    multiply,
    select,
    subtract,
)

_NUMBERS = (float, int)
OVERFLOWING = 1e100  # a divisor beyond it, of which a coefficient has overflown, is infinite


def is_zero(c):
    """Whether a coefficient is the number zero, which needs no arithmetic."""
    return c.__class__ in _NUMBERS and c == 0


def over(c, k):
    """A coefficient over a whole number; an expression by a product, which takes a fourth of the time."""
    return multiply(c, 1.0 / k) if isinstance(c, ca.SX) else divide(c, k)


def _times(a, b):
    return 0.0 if is_zero(a) or is_zero(b) else multiply(a, b)


def _dot(pairs):
    total = 0.0
    for a, b in pairs:
        total = _plus(total, _times(a, b))
    return total


def _plus(a, b):
    return b if is_zero(a) else a if is_zero(b) else add(a, b)


def _minus(a, b):
    return a if is_zero(b) else multiply(-1.0, b) if is_zero(a) else subtract(a, b)


def _inner_first(k):
    """Indices 0..k of a product's terms; terms with the highest coefficients, which come latest, are last."""
    return sorted(range(k + 1), key=lambda j: max(j, k - j))


class Series:
    """A tape run on truncated power series, one coefficient at a time.

    `inputs` has a list of coefficients for each input: before `advance()` computes coefficient k, at least k + 1 of
    them. Branches are taken by coefficients 0. `c` has the coefficients of each node so far, `k` is their number.
    """

    def __init__(self, tape, inputs):
        self.tape = tape
        self.nodes = tape.nodes
        self.inputs = inputs
        self.c = [[] for _ in self.nodes]
        self.k = 0

    @property
    def outputs(self):
        """The coefficients of each output so far (list of lists)."""
        return [self.c[node] for node in self.tape.outputs]

    def advance(self, without=()):
        """Compute the next coefficient of every node but some, on which no other node depends."""
        for i, node in enumerate(self.nodes):
            self.c[i].append(None if i in without else self._coefficient(node, i, self.k))
        self.k += 1

    def replace_last(self, coefficients):
        """Recompute the last coefficient with new last coefficients of inputs, a dict by index of the input."""
        for i, value in coefficients.items():
            self.inputs[i][self.k - 1] = value
        for c in self.c:
            c.pop()
        self.k -= 1
        self.advance()

    def _coefficient(self, node, i, k):
        """Coefficient k of node i from lower ones of all nodes and coefficients k of earlier nodes."""
        c, (kind, args, data) = self.c, node
        if kind in ("mul", "add", "sub", "div"):
            a, b = c[args[0]], c[args[1]]
            if kind == "mul":
                return _dot((a[j], b[k - j]) for j in _inner_first(k)) if k else _times(a[0], b[0])
            if kind == "add":
                return _plus(a[k], b[k])
            if kind == "sub":
                return _minus(a[k], b[k])
            rest = _minus(a[k], _dot((c[i][j], b[k - j]) for j in _inner_first(k) if j < k))
            rest = self._bounded(rest, a[k], args[1], k)
            return 0.0 if is_zero(rest) else divide(rest, b[0])
        if kind == "input":
            return self.inputs[data][k]
        if kind == "const":
            return data if k == 0 else 0.0
        if kind == "quad":
            return self._quadrature(node, k)
        if kind == "constant":
            return apply(data, *(self.c[j][0] for j in args)) if k == 0 else 0.0
        a = c[args[0]]
        if kind == "neg":
            return 0.0 if is_zero(a[k]) else -a[k]
        if kind == "scale":
            return multiply(a[k], data)
        if kind == "copy":
            return a[k]
        if kind == "sq":
            return self._square(a, k)
        if kind == "sqrt":
            return self._root(a, c[i], k)
        if kind == "power":
            return self._constant_power(a, c[i], data, k)
        return self._branch(node, k)

    def _bounded(self, rest, dividend, divisor, k):
        """The rest of a division by a series that may overflow, as 1 + exp(a) does.

        Its quotient vanishes there, to far below the smallest number that matters, and so do all its coefficients.
        """
        if k == 0 or is_zero(rest) or not self._grows(divisor):
            return rest
        size = apply("fabs", self.c[divisor][0])
        counts = apply("logic_or", apply("lt", size, OVERFLOWING), finite(rest))
        return select(counts, rest, dividend)

    def _grows(self, node):
        """Whether a node has a function that may overflow among its arguments."""
        return self.tape.growing[node]

    def _branch(self, node, k):
        """Coefficient k of an operation with branches: that of the branch taken."""
        a, b = (self.c[i] for i in (node.args[0], node.args[-1]))
        if node.kind == "fabs":
            return select(a[0] >= 0, a[k], -a[k])
        if node.kind == "gate":
            return 0.0 if is_zero(b[k]) else select(holds(a[0]), b[k], 0.0)
        return select(a[0] <= b[0], *((a[k], b[k]) if node.kind == "fmin" else (b[k], a[k])))

    @staticmethod
    def _square(a, k):
        inner = 0.0 if k % 2 else _times(a[k // 2], a[k // 2])
        return _plus(inner, multiply(2.0, _dot((a[j], a[k - j]) for j in reversed(range((k + 1) // 2)))))

    @staticmethod
    def _root(a, y, k):
        if k == 0:
            return apply("sqrt", a[0])
        rest = _minus(a[k], _dot((y[j], y[k - j]) for j in range(1, k)))
        return 0.0 if is_zero(rest) else divide(rest, multiply(2.0, y[0]))

    @staticmethod
    def _constant_power(a, y, exponent, k):
        if k == 0:
            return a[0] ** exponent
        total = _dot((multiply(exponent * (k - j) - j, a[k - j]), y[j]) for j in range(k) if not is_zero(a[k - j]))
        if is_zero(total):
            return 0.0
        # The recurrence divides by a_0. Where a_0 = 0 coefficients below the exponent vanish, and all do where a = 0.
        zero = [1.0 * (c == 0) for c in (a[:1] if k < exponent else a) if not is_zero(c)]
        return select(prod(zero), 0.0, divide(total, multiply(k, a[0])))

    def _quadrature(self, node, k):
        name, slopes = node.data
        if k == 0:
            return apply(name, *(self.c[j][0] for j in node.args))
        total = 0.0
        for argument, slope in zip(node.args, slopes, strict=True):
            of, add_to = (slope, _plus) if self.nodes[slope].kind != "neg" else (self.nodes[slope].args[0], _minus)
            a, g = self.c[argument], self.c[of]
            # Coefficient k - 1 of the product a' g, term by term as `mul` has it, so that the same product is shared.
            terms = ((_times(a[j + 1], float(j + 1)), g[k - 1 - j]) for j in _inner_first(k - 1))
            total = add_to(total, _dot(terms))
        return total if k == 1 or is_zero(total) else over(total, k)


class _Grouped(Series):
    """A tape run on series of numbers at many points, a group of equal operations at a time: (size, N) arrays.

    Coefficients of inputs are (N,) arrays or numbers. `first` is how many of the outputs are computed, None for all.
    """

    def __init__(self, tape, inputs, first, n_points):
        self.tape, self.inputs, (self.plan, self.growing) = tape, inputs, tape.plan_of(first)
        self.nodes, self.places = self.plan.grouped
        self.shape, self.values = (len(self.plan.place), n_points), []  # coefficients of all operations
        self.c, self.k = [[] for _ in self.nodes], 0

    def advance(self):
        """Compute the next coefficient of every group."""
        values = np.zeros(self.shape, dtype=REAL)
        if self.k == 0:
            places, constants = self.plan.constants
            values[places] = np.array(constants)[:, None]
        for place, i in zip(*self.plan.inputs, strict=True):
            values[place] = self.inputs[i][self.k]
        self.values.append(values)
        for i, (node, places) in enumerate(zip(self.nodes, self.places, strict=True)):
            if node.kind == "gather":
                self.c[i].append(values.take(places, axis=0))
            else:
                values[places] = coefficient = self._coefficient(node, i, self.k)
                self.c[i].append(coefficient)
        self.k += 1

    def _bounded(self, rest, dividend, divisor, k):
        bounded = super()._bounded(rest, dividend, divisor, k)
        return rest if bounded is rest else np.where(self.growing[self.places[divisor]], bounded, rest)

    def _grows(self, node):
        return self.growing[self.places[node]].any()


class Motion:
    """The normalised Taylor coefficients of every symbol along a motion.

    Subclasses define `coordinate(i, j)`, coefficient j of q_i, and `velocity(i, l, j)`, coefficient j of γ_i^(l).
    """

    def __init__(self, q):
        self.q = q

    def coefficient(self, symbol, j):
        """Coefficient j of a symbol: q_[j], (γ^(l))_[j], t_[0] = t and t_[1] = 1; other symbols are constant."""
        kind, level, i = self.q.where(symbol) or ("constant", 0, 0)
        if kind == "q":
            return self.coordinate(i, j)
        if kind == "w":
            return self.velocity(i, level, j)
        if kind == "r" and level + j <= JETS:
            return self.reference(i, level, j)
        if kind == "r":
            raise SpecificationError(
                f"The derivative {level + j} of the reference {self.q.family.names[i]} was asked for.",
                f"Derivatives of references end at order {JETS}.",
                do="Let the program follow it in rows of lower order.",
                name=self.q.family.names[i],
                order=level + j,
                limit=JETS,
            )
        return symbol if j == 0 else float(kind == "t" and j == 1)

    def reference(self, i, level, j):
        """Coefficient j of r_i^(level): a symbol, unless the motion has numbers."""
        return divide(self.q.family.jet(self.q.family.names[i], level + j), float(factorial(j)))


def shifted(c, level, j):
    """(γ^(l))_[j] = γ_[l+j] (l + j)!/j!, from c = γ_[l+j]."""
    return 0.0 if is_zero(c) else c * float(factorial(level + j) // factorial(j))


class Flow:
    """Rows along a motion: Taylor coefficients of the residuals, and their Jacobian in the jets.

    `level` is the highest level K of the jets; a row contributes its coefficients 0 .. level - order. `points` has the
    parameters with their values, and the book of scalars. `signals` are Taylor coefficients of further symbols along
    the motion by element hash, lists of (N,) arrays. `real` is the type of the Jacobian; double precision is enough for
    Newton's method.
    """

    def __init__(self, q, rows, level, points, signals=None, real=float):
        self.q, self.level, self.points, self.signals, self.real = q, level, points, signals or {}, real
        orders = [row.order for row in rows]
        self.equations = [(a, i) for a, order in enumerate(orders) for i in range(level - order + 1)]
        self.levels = np.array([orders[a] + i for a, i in self.equations], dtype=int)
        self.first = np.cumsum([0, *(max(level - order + 1, 0) for order in orders)])
        self.rows, self._cache = rows, {}
        self.members = {
            order: np.array([a for a, row in enumerate(rows) if row.order == order], dtype=int)
            for order in sorted({order for order in orders if order <= level})
        }
        if not q.plain:
            moving = q.V @ q.jet(1) + q.h
            parts = [ca.densify(ca.jacobian(moving, q.jet(0))), ca.densify(q.V)]
            self.motion = self._scalars([*moving.elements(), *(e for p in parts for e in p.nonzeros())])

    def at(self, points):
        """The same rows with the parameters of other points, and the same cached tapes."""
        flow = copy(self)
        flow.points = points
        return flow

    @property
    def lowest(self):
        """The rows of order 0 as equations of q."""
        if "lowest" not in self._cache:
            self._cache["lowest"] = Flow(self.q, self.rows, 0, self.points, self.signals, self.real)
        return self._cache["lowest"].at(self.points)

    def aim(self, t, z):
        """Residuals of rows of order 0 and slopes (rows, nq + references, N) in q and r; None without a reference."""
        if "aim" not in self._cache:
            rows = ca.vertcat(*(row.expression for row in self.rows if row.order == 0))
            targets = ca.vertcat(ca.SX(0, 1), *(self.q.family.jet(name, 0) for name in self.q.family.names))
            slopes = ca.jacobian(rows, ca.vertcat(self.q.jet(0), targets))
            places = np.array(slopes.sparsity().get_triplet(), dtype=int)
            aims = ca.depends_on(rows, targets) if len(self.q.family) else False
            self._cache["aim"] = aims and (self._scalars([*rows.elements(), *slopes.nonzeros()]), slopes.shape, places)
        if not self._cache["aim"]:
            return None
        scalars, shape, (rows, columns) = self._cache["aim"]
        values = scalars.values(t, z, self.points.values)
        slopes = np.zeros((*shape, z.shape[1]))
        slopes[rows, columns] = values[shape[0] :]
        return values[: shape[0]], slopes

    def _scalars(self, expressions):
        return Scalars(self.q, self.points.parameters, expressions, self.signals)

    @property
    def groups(self):
        """The rows of each order with their gradients in q and all jets."""
        if "groups" not in self._cache:
            self._cache["groups"] = [self._group(order) for order in self.members]
        return self._cache["groups"]

    def _group(self, order):
        """The rows of an order, the tape of their residuals and nonzero gradient entries, and places of the entries."""
        members = self.members[order]
        residuals = [self.rows[a].expression for a in members]
        parts = [ca.jacobian(ca.vertcat(*residuals), self.q.jet(m)) for m in range(order + 1)]
        places = [np.array(p.sparsity().get_triplet(), dtype=int) for p in parts]
        return members, order, self._scalars([*residuals, *(e for p in parts for e in p.nonzeros())]), places

    def leading(self, order, level):
        """Residuals of an order and nonzero entries of their gradients in γ^(order), or in q itself for level 0.

        Returns their places in the book of scalars, and the places (rows, columns) of the entries.
        """
        in_q = order == 0 and level == 0 and not self.q.plain
        if (order, in_q) not in self._cache:
            rows = [self.rows[a] for a in self.members[order]]
            slopes = [ca.jacobian(row.expression, self.q.jet(0)) if in_q else row.gradient(self.q) for row in rows]
            columns = [g.sparsity().get_triplet()[1] for g in slopes]
            residuals, entries = [row.expression for row in rows], [e for g in slopes for e in g.nonzeros()]
            in_book = self.points.book.find(self.q, self.points.parameters, [*residuals, *entries])
            places = np.repeat(np.arange(len(rows)), [len(c) for c in columns]), np.array(sum(columns, []), dtype=int)
            self._cache[order, in_q] = in_book, places
        return self._cache[order, in_q]

    def __call__(self, t, z):
        """Coefficients (n_equations, N) and Jacobian (n_equations, nz, N) at times t (N,) and jets z (nz, N)."""
        n_points = z.shape[1]
        q_series, q_map = self._kinematics(t, z)
        residual = np.zeros((len(self.equations), n_points), dtype=REAL)
        jacobian = np.zeros((len(self.equations), len(z), n_points), dtype=self.real)
        for members, order, scalars, places in self.groups:
            depth = self.level - order
            coefficients = self._run(scalars, t, z, q_series, depth)
            for i in range(depth + 1):
                residual[self.first[members] + i] = coefficients[: len(members), i]
            offset = len(members)
            for m, (rows, columns) in enumerate(places):
                entries = coefficients[offset : offset + len(rows)].astype(self.real)
                offset += len(rows)
                for i in range(depth + 1):
                    self._add_slopes(jacobian, self.first[members[rows]] + i, columns, m, entries[:, : i + 1], q_map)
        return residual, jacobian

    def _add_slopes(self, jacobian, equations, columns, m, entries, q_map):
        """Add the contribution of ∂ψ/∂γ^(m), by its coefficients 0 .. i, to the slopes of coefficient i of ψ."""
        nq, n, i = self.q.nq, self.q.n, entries.shape[1] - 1
        for l in range(i + 1):
            part = entries[:, i - l]
            if m == 0 and not self.q.plain:
                np.add.at(jacobian, equations, part[:, None, :] * q_map[l][columns])
            elif m == 0:
                jacobian[equations, columns + (nq + (l - 1) * n if l else 0)] += part
            elif l + m <= self.level:
                jacobian[equations, columns + nq + (l + m - 1) * n] += part * (factorial(l + m) / factorial(l))

    def residual(self, t, z):
        """The coefficients (n_equations, N) alone."""
        q_series, _ = self._kinematics(t, z)
        residual = np.zeros((len(self.equations), z.shape[1]), dtype=REAL)
        for order, members in self.members.items():
            in_book, _ = self.leading(order, self.level)
            coefficients = self._residuals(in_book, members, t, z, q_series, self.level - order)
            for i in range(coefficients.shape[1]):
                residual[self.first[members] + i] = coefficients[:, i]
        return residual

    def at_level(self, t, z, level):
        """The equations of a level: residuals (n_equations, N) and slopes in γ_[level] or q (n_equations, n, N).

        Rows of other levels are zero. The slopes are those of the leading gradients.
        """
        q_series, _ = self._kinematics(t, z)
        residual = np.zeros((len(self.equations), z.shape[1]), dtype=REAL)
        slopes = np.zeros((len(self.equations), self.q.n if level else self.q.nq, z.shape[1]))
        for order, members in self.members.items():
            if order > level:
                continue
            in_book, (rows, columns) = self.leading(order, level)
            depth, entries = level - order, np.empty((len(members) + len(rows), z.shape[1]), dtype=REAL)
            for scalars, sources, targets in in_book:
                entries[targets] = scalars.values(t, z, self.points.values)[sources]
            if depth:
                coefficients = self._residuals(in_book, members, t, z, q_series, depth)[:, depth]
            else:
                coefficients = entries[: len(members)]
            residual[self.first[members] + depth] = coefficients
            entries = entries[len(members) :] * (factorial(level) / factorial(depth))
            slopes[self.first[members[rows]] + depth, columns] = entries
        return residual, slopes

    def _residuals(self, in_book, members, t, z, q_series, depth):
        """Coefficients of the residuals of some rows, (rows, depth + 1, N)."""
        result = np.empty((len(members), depth + 1, z.shape[1]), dtype=REAL)
        for scalars, sources, targets in in_book:
            pairs = [(i, a) for i, a in zip(sources, targets, strict=True) if a < len(members)]
            if pairs and depth:
                coefficients = self._run(scalars, t, z, q_series, depth, 1 + max(i for i, _ in pairs))
            elif pairs:
                coefficients = scalars.values(t, z, self.points.values)[:, None]
            for i, a in pairs:
                result[a] = coefficients[i]
        return result

    def series(self, expressions, t, z, depth):
        """Taylor coefficients of expressions along a motion, (len, depth + 1, N)."""
        return self._run(self._scalars(list(expressions)), t, z, self._kinematics(t, z)[0], depth)

    def _kinematics(self, t, z):
        """Taylor coefficients of q and, unless q' = γ', the derivative of each in z."""
        nq, n, n_points = self.q.nq, self.q.n, z.shape[1]
        if self.q.plain:
            return [z[:nq], *(z[nq + k * n : nq + (k + 1) * n] for k in range(self.level))], None
        first = np.zeros((nq, len(z), n_points), dtype=self.real)
        first[np.arange(nq), np.arange(nq)] = 1.0
        series, maps = [z[:nq]], [first]
        for k in range(self.level):
            c = self._run(self.motion, t, z, series, k)
            slope = c[nq : nq + nq * nq].reshape(nq, nq, k + 1, n_points).astype(self.real)
            frame = c[nq + nq * nq :].reshape(n, nq, k + 1, n_points).astype(self.real)
            series.append(c[:nq, k] / (k + 1))
            step = np.zeros_like(first)
            for l in range(k + 1):
                step += np.einsum("jip,jzp->izp", slope[:, :, k - l], maps[l])
                start = nq + l * n
                step[:, start : start + n] += (l + 1) * np.swapaxes(frame[:, :, k - l], 0, 1)
            maps.append(step / (k + 1))
        return series, maps

    def _run(self, scalars, t, z, q_series, depth, first=None):
        """Coefficients 0 .. depth of the first scalars, (first, depth + 1, N)."""
        motion, values = _Numbers(self.q, t, z, q_series, self.level), scalars.inputs(t, z, self.points.values)
        inputs = []
        for symbol, value in zip(scalars.tape.symbols, values, strict=True):
            higher = (motion.coefficient(symbol, k) for k in range(1, depth + 1))
            inputs.append(self.signals.get(symbol.element_hash()) or [value, *higher])
        series = _Grouped(scalars.tape, inputs, first, z.shape[1])
        with np.errstate(all="ignore"):
            for _ in range(depth + 1):
                series.advance()
        return np.stack(series.values, axis=1)[series.plan.place[scalars.tape.outputs[:first]]]


class _Numbers(Motion):
    """The motion of jets z (nz, N) at instants t; those above a level are zero."""

    def __init__(self, q, t, z, q_series, level):
        super().__init__(q)
        self.t, self.z, self.q_series, self.level = t, z, q_series, level

    def coordinate(self, i, j):
        return self.q_series[j][i]

    def velocity(self, i, level, j):
        if level + j > self.level:
            return np.zeros(self.z.shape[1], dtype=REAL)
        return shifted(self.z[self.q.nq + (level + j - 1) * self.q.n + i], level, j)

    def reference(self, i, level, j):
        return shifted(self.t[:, column_of(i, level + j)], level, j)
