"""Sums: the terms of an expression, and what is left of it without some of them."""

import casadi as ca

PLUS, ONE, PRODUCTS = (ca.OP_ADD, ca.OP_SUB), (ca.OP_NEG, ca.OP_TWICE), (ca.OP_MUL, ca.OP_DIV)
APPLIED = {
    ca.OP_ADD: lambda a, b: a + b,
    ca.OP_SUB: lambda a, b: a - b,
    ca.OP_MUL: lambda a, b: a * b,
    ca.OP_DIV: lambda a, b: a / b,
    ca.OP_NEG: lambda a, _: -a,
    ca.OP_TWICE: lambda a, _: 2 * a,
}


def summands(expression, moves):
    """Terms of a scalar: operands of its sums and differences, also of those with a factor that does not move.

    `moves` tells whether an SX scalar depends on the motion. The terms are without their signs and without such
    factors.
    """
    terms, waiting = [], [expression]
    while waiting:
        spine, end = _spine(waiting.pop(), moves)
        terms.append(end)
        waiting += [other for operation, other in spine if operation in PLUS]
    return terms


def without(expression, moves, dropped):
    """A scalar without the `summands` for which `dropped(term)` is true; the order of the others stays."""
    spine, value = _spine(expression, moves)
    value = ca.SX(0) if dropped(value) else value
    for operation, other in reversed(spine):
        value = APPLIED[operation](value, without(other, moves, dropped) if operation in PLUS else other)
    return value


def _spine(expression, moves):
    """[(operation, other operand)] from a scalar down to its first term, and this term."""
    spine = []
    while not expression.is_leaf():
        operation, left = expression.op(), expression.dep(0)
        right = expression.dep(1) if expression.n_dep() > 1 else None
        if operation == ca.OP_MUL and not moves(left):
            left, right = right, left
        if operation not in PLUS + ONE and not (operation in PRODUCTS and not moves(right)):
            break
        spine.append((operation, right))
        expression = left
    return spine, expression
