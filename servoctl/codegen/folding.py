"""Powers of two, gathered: SX leaves the factors 1/2 and 2 of energies and gradients where they arise."""

import math

import casadi as ca

from servoctl.jets.branches import apply_code

_OF_ONE = {ca.OP_ASSIGN: 1.0, ca.OP_NEG: -1.0, ca.OP_TWICE: 2.0}


def folded(f):
    """The output of an SX function with its factors ±2^k gathered.

    Results are the same to the last bit, because products with powers of two do not round. The function has one column
    output, which is given in terms of the symbols `f.sx_in()`.
    """
    inputs = [column.elements() for column in f.sx_in()]
    work, outputs = {}, [ca.SX(0)] * f.numel_out(0)
    for k in range(f.n_instructions()):
        operation, source, target = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if operation == ca.OP_INPUT:
            work[target[0]] = (1.0, inputs[source[0]][source[1]])
        elif operation == ca.OP_CONST:
            work[target[0]] = _constant(f.instruction_constant(k))
        elif operation == ca.OP_OUTPUT:
            outputs[target[1]] = _product(work[source[0]])
        else:
            work[target[0]] = _operation(operation, [work[i] for i in source])
    return ca.vertcat(*outputs)


def _constant(value):
    """(factor, expression) of a number: ±2^k is all factor."""
    return (value, ca.SX(1)) if value and abs(math.frexp(value)[0]) == 0.5 else (1.0, ca.SX(value))


def _product(term):
    factor, expression = term
    return expression if factor == 1 else -expression if factor == -1 else factor * expression


def _operation(operation, terms):
    """One instruction on terms (factor, expression)."""
    (c, a), (d, b) = terms[0], terms[-1]
    if operation in _OF_ONE:
        return _OF_ONE[operation] * c, a
    if operation == ca.OP_SQ:
        return c * c, a * a
    if operation == ca.OP_MUL:
        return c * d, a * b
    if operation == ca.OP_DIV:
        return c / d, a / b
    if operation == ca.OP_INV:
        return 1 / c, 1 / a
    if operation in (ca.OP_ADD, ca.OP_SUB):
        d = d if operation == ca.OP_ADD else -d
        if abs(d) == 1 and abs(c) != 1:
            (c, a), (d, b) = (d, b), (c, a)
        ratio = d / c
        return c, a + b if ratio == 1 else a - b if ratio == -1 else a + ratio * b
    operands = [_product(term) for term in terms]
    return 1.0, apply_code(operation, *operands)
