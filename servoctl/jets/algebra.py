"""Whether an expression is zero by algebra: a proof, where values at points are evidence.

The expression becomes a polynomial with exact coefficients in its symbols, their reciprocals, and its functions of
equal arguments; sin² gives way to 1 - cos², the square of a root to its argument. If all terms cancel, it is zero
wherever it has a value. The converse does not hold: identities between other functions stay undecided.
"""

from collections import defaultdict
from fractions import Fraction

import casadi as ca

from servoctl.jets.lookup import lookup_at

MOST_OPERATIONS = 300  # of an expression that is expanded
MOST_PRODUCTS = 20_000  # of terms of all polynomials in one expansion: some hundredths of a second

_ONE = {(): Fraction(1)}


class _Undecided(Exception):
    """The expansion is too long, or a number is not finite."""


def cancels(expression):
    """Whether all terms of an SX scalar cancel; False where that is not decided."""
    f = ca.Function("cancels", [], [expression], {"allow_free": True, "live_variables": False})
    if f.n_instructions() > MOST_OPERATIONS:
        return False
    try:
        return not _Expansion().of(f)
    except _Undecided:
        return False


class _Expansion:
    """Polynomials {monomial: coefficient}; a monomial is a sorted tuple of pairs (number of a factor, exponent)."""

    def __init__(self):
        self._factors, self._squares, self._products = {}, {}, 0

    def of(self, f):
        """The polynomial of a function without inputs and with one output."""
        work, free, operations = [], iter(range(f.n_instructions())), _OPERATIONS
        for k in range(f.n_instructions()):
            op, operands = f.instruction_id(k), f.instruction_input(k)
            if op == ca.OP_OUTPUT:
                return work[operands[0]]
            if op == ca.OP_PARAMETER:
                work.append(self._factor("symbol", next(free)))
            elif op == ca.OP_CONST:
                work.append(_rational(f.instruction_constant(k)))
            elif op in operations:
                work.append(operations[op](self, *(work[i] for i in operands)))
            else:
                op = lookup_at(f, k) if op == ca.OP_CALL else op
                work.append(self._factor(op, *(frozenset(work[i].items()) for i in operands)))
        return {}

    def _factor(self, *key):
        """The polynomial of a symbol, or of a function (its operation) of arguments."""
        new = len(self._factors)
        number = self._factors.setdefault(key, new)
        if number == new and key[0] == ca.OP_SIN:
            self._squares[number] = self.sum(_ONE, self.product(self._cosine(key[1]), self._cosine(key[1])), -1)
        if number == new and key[0] == ca.OP_SQRT:
            self._squares[number] = dict(key[1])
        return {((number, 1),): Fraction(1)}

    def _cosine(self, argument):
        return self._factor(ca.OP_COS, argument)

    def sum(self, a, b, sign=1):
        """a + b, or a - b."""
        result = defaultdict(Fraction, a)
        for monomial, coefficient in b.items():
            result[monomial] += sign * coefficient
        return {monomial: coefficient for monomial, coefficient in result.items() if coefficient}

    def product(self, a, b):
        """a b, with squares substituted."""
        result, left = defaultdict(Fraction), self._expanded(a, b)
        while left:
            monomial, coefficient = left.popitem()
            factor = next((i for i, exponent in monomial if exponent > 1 and i in self._squares), None)
            if factor is None:
                result[monomial] += coefficient
                continue
            rest = tuple((i, n - 2 * (i == factor)) for i, n in monomial if (i, n) != (factor, 2))
            for other, c in self._expanded({rest: coefficient}, self._squares[factor]).items():
                left[other] = left.get(other, 0) + c
        return {monomial: coefficient for monomial, coefficient in result.items() if coefficient}

    def _expanded(self, a, b):
        """The terms of a b."""
        self._products += len(a) * len(b)
        if self._products > MOST_PRODUCTS:
            raise _Undecided
        result = defaultdict(Fraction)
        for one, c in a.items():
            for other, d in b.items():
                exponents = defaultdict(int, one)
                for factor, exponent in other:
                    exponents[factor] += exponent
                result[tuple(sorted((i, n) for i, n in exponents.items() if n))] += c * d
        return result

    def quotient(self, a, b):
        """a / b: by a monomial with negative exponents, by a sum with its reciprocal as a factor."""
        if len(b) == 1:
            ((monomial, coefficient),) = b.items()
            return self.product(a, {tuple((i, -n) for i, n in monomial): 1 / coefficient})
        if not b:
            raise _Undecided
        return self.product(a, self._factor(ca.OP_INV, frozenset(b.items())))

    def power(self, a, b):
        """a to the power b, a factor of its own unless b is a small whole number."""
        exponent = b.get((), Fraction(0))
        if len(b) > 1 or exponent.denominator != 1 or not 0 <= exponent <= 8 or b.keys() - {()}:
            return self._factor(ca.OP_POW, frozenset(a.items()), frozenset(b.items()))
        result = _ONE
        for _ in range(int(exponent)):
            result = self.product(result, a)
        return result


def _rational(value):
    try:
        return {(): Fraction(value)} if value else {}
    except (ValueError, OverflowError):
        raise _Undecided from None


_OPERATIONS = {
    ca.OP_ADD: _Expansion.sum,
    ca.OP_SUB: lambda e, a, b: e.sum(a, b, -1),
    ca.OP_MUL: _Expansion.product,
    ca.OP_DIV: _Expansion.quotient,
    ca.OP_NEG: lambda e, a: e.sum({}, a, -1),
    ca.OP_SQ: lambda e, a: e.product(a, a),
    ca.OP_TWICE: lambda e, a: e.sum(a, a),
    ca.OP_INV: lambda e, a: e.quotient(_ONE, a),
    ca.OP_POW: _Expansion.power,
    ca.OP_CONSTPOW: _Expansion.power,
    ca.OP_ASSIGN: lambda e, a: a,
}
