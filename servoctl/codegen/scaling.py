"""Scales of values gathered: factors of parameters and numbers alone, which a loop computes once.

A coefficient of a Taylor series is a sum of products with a scale: -(k - 1)/k of a mass, over another, times k for a
velocity. Each factor by itself is an operation, and the next coefficient waits for all of them. Here a value is a scale
times another value, and a sum that is scaled is one of scaled terms. The results are those of the given order but for
rounding.
"""

import functools
from collections import Counter
from typing import NamedTuple

import casadi as ca

from servoctl.jets.pieces import Constant, operand_values


class _Scaled(NamedTuple):
    """number · product of factors · value, where the factors depend on parameters alone."""

    number: float
    factors: tuple
    value: object


_TERMS = {ca.OP_ADD: (1.0, 1.0), ca.OP_SUB: (1.0, -1.0)}
_BY_NUMBER = {ca.OP_NEG: -1.0, ca.OP_TWICE: 2.0}


def scaled(statements):
    """Statements with gathered scales.

    Statements (target, operation, operands) are in single assignment; operands are numbered values, constants, or C
    text of inputs. The outputs are the same, to rounding.
    """
    gathered = _Gathered(statements)
    for statement in statements:
        gathered.take(*statement)
    return needed(gathered.statements)


def is_still(operand, still):
    """Whether an operand depends on p alone, as some values do."""
    if isinstance(operand, int):
        return operand in still
    return isinstance(operand, Constant) or operand.startswith("p[")


def needed(statements):
    """The statements that outputs need."""
    read, result = set(), []
    for target, operation, operands in reversed(statements):
        if isinstance(target, str) or target in read:
            read.update(operand_values(operands))
            result.append((target, operation, operands))
    return result[::-1]


class _Gathered:
    """The statements written so far.

    `forms` are given values as scaled ones, `sums` the terms of those that their only reader scales; `still` are the
    values that depend on p alone.
    """

    def __init__(self, statements):
        self.statements, self.written, self.still, self.forms, self.sums = [], {}, set(), {}, {}
        reads = Counter(v for _, _, operands in statements for v in operand_values(operands))
        self.reader = {v: s for s in statements for v in operand_values(s[2]) if reads[v] == 1}

    def take(self, target, operation, operands):
        """Write what replaces a given statement, or note its scale."""
        if isinstance(target, str):
            self.statements.append((target, operation, tuple(map(self.place, operands))))
            return
        scale, operand = self.scale(operation, operands)
        if operand in self.sums:
            terms = [_rescaled(scale, term) for term in self.sums.pop(operand)]
        elif operand is not None:
            self.forms[target] = _rescaled(scale, self.form(operand))
            return
        elif operation in _TERMS:
            terms = [_rescaled((c, ()), self.form(v)) for c, v in zip(_TERMS[operation], operands, strict=True)]
        else:
            self.forms[target] = _Scaled(1.0, (), self.write(operation, *map(self.place, operands)))
            return
        if self.is_scaled_next(target) and any(abs(term.number) != 1 or term.factors for term in terms):
            self.sums[target] = terms
        else:
            self.forms[target] = _Scaled(1.0, (), self.sum(*terms))

    def write(self, operation, *operands):
        """The value of an operation, which is written once."""
        key = operation, frozenset(operands) if operation in (ca.OP_MUL, ca.OP_ADD) else operands
        if key not in self.written:
            value = self.written[key] = len(self.written)
            self.statements.append((value, operation, operands))
            if all(is_still(v, self.still) for v in operands):
                self.still.add(value)
        return self.written[key]

    def form(self, operand):
        """The form of a given operand."""
        if operand in self.sums:
            self.forms[operand] = _Scaled(1.0, (), self.sum(*self.sums.pop(operand)))
        return self.forms[operand] if isinstance(operand, int) else _Scaled(1.0, (), operand)

    def place(self, operand):
        """The written operand of a given one."""
        return self.value(self.form(operand))

    def value(self, form):
        """The written operand of a form."""
        if not form.factors and abs(form.number) == 1:
            return form.value if form.number == 1 else self.write(ca.OP_NEG, form.value)
        scale = Constant(form.number)
        if form.factors:
            factor = functools.reduce(functools.partial(self.write, ca.OP_MUL), form.factors)
            scale = factor if form.number == 1 else self.write(ca.OP_MUL, scale, factor)
        return self.write(ca.OP_MUL, scale, form.value)

    def moves(self, operand):
        """Whether a given operand is known to depend on more than p."""
        known = operand in self.forms or not isinstance(operand, int)
        return not known or not is_still(self.form(operand).value, self.still)

    def scale(self, operation, operands):
        """((number, factors), operand) of an operation that scales an operand that moves; (None, None) of others."""
        moving = [v for v in operands if self.moves(v)]
        if len(moving) != 1 or not _scales(operation, operands, *moving):
            return None, None
        if operation in _BY_NUMBER:
            return (_BY_NUMBER[operation], ()), *moving
        (factor,) = (v for v in operands if v not in moving)
        if isinstance(factor, Constant):
            return (factor.value, ()), *moving
        factor = self.place(factor)
        return (1.0, (factor if operation == ca.OP_MUL else self.write(ca.OP_INV, factor),)), *moving

    def is_scaled_next(self, value):
        """Whether the only reader of a given value scales it, by what is known already."""
        _, operation, operands = self.reader.get(value, (None, None, ()))
        return _scales(operation, operands, value) and not any(self.moves(v) for v in operands if v != value)

    def sum(self, a, b):
        """The written sum of two forms."""
        if a.number < 0 < b.number:
            a, b = b, a
        if a.number > 0 > b.number:
            return self.write(ca.OP_SUB, self.value(a), self.value(_rescaled((-1.0, ()), b)))
        return self.write(ca.OP_ADD, self.value(a), self.value(b))


def _rescaled(scale, form):
    """A form times (number, factors)."""
    number, factors = scale
    if factors and form.factors:
        factors = tuple(sorted((*factors, *form.factors), key=str))
    return _Scaled(number * form.number, factors or form.factors, form.value)


def _scales(operation, operands, moving):
    """Whether an operation is a scale times the one of its operands that moves; a quotient by a number rounds once."""
    if operation == ca.OP_DIV:
        return operands[0] == moving and not isinstance(operands[1], Constant)
    return operation == ca.OP_MUL or operation in _BY_NUMBER
