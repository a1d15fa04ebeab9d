"""Truncated Taylor arithmetic over CasADi expressions: derivatives of any order at polynomial cost.

A `Tape` is the instruction list of SX expressions. `Series` runs it on truncated power series in one
variable, coefficient by coefficient, with the usual recurrences (O(k) operations for coefficient k of a
product). The coefficients are SX expressions, when a derivative is to be derived, or NumPy arrays over
many points, when it is to be evaluated: the same recurrences serve both. Coefficients are *normalised*:
coefficient k of f is f^(k)/k!.
"""

from servoctl.jets.elementary import add, apply, divide, multiply, select, subtract

_NUMBERS = (float, int)


def is_zero(c):
    """Whether a coefficient is the number zero, which needs no arithmetic."""
    return c.__class__ in _NUMBERS and c == 0


def _dot(pairs):
    total = 0.0
    for a, b in pairs:
        if not (is_zero(a) or is_zero(b)):
            product = multiply(a, b)
            total = product if is_zero(total) else add(total, product)
    return total


def _plus(a, b):
    return b if is_zero(a) else a if is_zero(b) else add(a, b)


def _minus(a, b):
    return a if is_zero(b) else multiply(-1.0, b) if is_zero(a) else subtract(a, b)


def _inner_first(k, first=0):
    """Indices first..k of a product's terms, those with the latest coefficients last: the others are known earlier."""
    return sorted(range(first, k + 1), key=lambda j: max(j, k - j))


class Series:
    """A tape run on truncated power series, one coefficient at a time.

    `inputs[i]` is the list of coefficients of input i; before `advance()` computes coefficient k, each
    must hold at least k + 1 entries. `outputs[i]` are the coefficients of output i so far. Branches are taken by
    coefficient 0 of what is compared; `decided` may give other values for nodes, at which to take them. With
    `first` only so many of the tape's outputs are computed.
    """

    def __init__(self, tape, inputs, decided=None, first=None):
        self.tape = tape
        self.nodes = tape.nodes if first is None else tape.nodes[: tape.needed(first)]
        self.inputs = inputs
        self.c = [[] for _ in self.nodes]
        self.k = 0
        self.decided = decided or {}

    def _first(self, node):
        """The value of a node by which branches are taken."""
        return self.decided[node] if node in self.decided else self.c[node][0]

    @property
    def outputs(self):
        """The coefficients of each output so far (list of lists)."""
        return [self.c[node] for node in self.tape.outputs]

    def advance(self):
        """Compute the next coefficient of every node."""
        k, c = self.k, self.c
        if k == 0:
            self._start()
        else:
            for i, node in enumerate(self.nodes):
                c[i].append(self._coefficient(node, i, k))
        self.k += 1

    def _start(self):
        """Coefficient 0 of every node: its value, without the recurrences."""
        c, inputs = self.c, self.inputs
        for i, (kind, args, data) in enumerate(self.nodes):
            if kind == "mul":
                a, b = c[args[0]][0], c[args[1]][0]
                value = 0.0 if is_zero(a) or is_zero(b) else multiply(a, b)
            elif kind == "add":
                value = _plus(c[args[0]][0], c[args[1]][0])
            elif kind == "sub":
                a, b = c[args[0]][0], c[args[1]][0]
                value = _minus(a, b)
            elif kind == "neg":
                a = c[args[0]][0]
                value = 0.0 if is_zero(a) else -a
            elif kind == "input":
                value = inputs[data][0]
            elif kind == "const":
                value = data
            else:
                value = self._coefficient(self.nodes[i], i, 0)
            c[i].append(value)

    def replace_last(self, coefficients):
        """Recompute the last coefficient after the inputs' last coefficients changed.

        Parameters
        ----------
        coefficients : dict
            Input index to its new last coefficient.
        """
        for i, value in coefficients.items():
            self.inputs[i][self.k - 1] = value
        for c in self.c:
            c.pop()
        self.k -= 1
        self.advance()

    def _coefficient(self, node, i, k):
        c, kind = self.c, node.kind
        if kind == "input":
            return self.inputs[node.data][k]
        if kind == "const":
            return node.data if k == 0 else 0.0
        if kind == "quad":
            return self._quadrature(node, k)
        if kind == "constant":
            return apply(node.data, *(self._first(j) for j in node.args)) if k == 0 else 0.0
        a = c[node.args[0]]
        if kind == "neg":
            return 0.0 if is_zero(a[k]) else -a[k]
        if kind == "scale":
            return multiply(a[k], node.data)
        if kind == "copy":
            return a[k]
        if kind == "sq":
            return self._square(a, k)
        if kind == "sqrt":
            return self._root(a, c[i], k)
        if kind == "power":
            return self._constant_power(a, c[i], node.data, k)
        if kind in ("fabs", "gate", "fmin", "fmax"):
            return self._branch(node, k)
        b = c[node.args[1]]
        if kind == "add":
            return _plus(a[k], b[k])
        if kind == "sub":
            return _minus(a[k], b[k])
        if kind == "mul":
            return _dot((a[j], b[k - j]) for j in _inner_first(k))
        if kind == "div":
            y = c[i]
            rest = _minus(a[k], _dot((y[j], b[k - j]) for j in _inner_first(k) if j < k))
            return 0.0 if is_zero(rest) else divide(rest, b[0])
        raise TypeError(f"a tape holds a node of kind {kind!r}")

    def _branch(self, node, k):
        """Coefficient k of an operation that takes one of its branches."""
        a, b = (self.c[i] for i in (node.args[0], node.args[-1]))
        if node.kind == "fabs":
            return select(self._first(node.args[0]) >= 0, a[k], -a[k])
        if node.kind == "gate":
            return 0.0 if is_zero(b[k]) else select(a[0] != 0, b[k], 0.0)
        first = self._first(node.args[0]) <= self._first(node.args[1])
        return select(first, *((a[k], b[k]) if node.kind == "fmin" else (b[k], a[k])))

    @staticmethod
    def _square(a, k):
        if k == 0:
            return 0.0 if is_zero(a[0]) else multiply(a[0], a[0])
        inner = multiply(a[k // 2], a[k // 2]) if k % 2 == 0 and not is_zero(a[k // 2]) else 0.0
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
        vanishes = a[0] if k < exponent else sum(apply("fabs", c) for c in a)  # the power of a zero is zero
        return select(vanishes == 0, 0.0, divide(total, multiply(k, a[0])))

    def _quadrature(self, node, k):
        name, slopes = node.data
        if k == 0:
            return apply(name, *(self.c[j][0] for j in node.args))
        total = 0.0
        for argument, slope in zip(node.args, slopes, strict=True):
            a, g = self.c[argument], self.c[slope]
            total = _plus(total, _dot((multiply(j, a[j]), g[k - j]) for j in _inner_first(k, 1) if not is_zero(a[j])))
        return total if k == 1 or is_zero(total) else divide(total, k)
