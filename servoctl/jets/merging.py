"""Expressions operation by operation; equal operations as one, and text of functions, whatever tables they look up.

CasADi compares the numbers of functions that expressions call, each time. Here lookups give way to symbols of the names
of their contents.
"""

import casadi as ca

from servoctl.jets.lookup import Lookup, lookups, used


def cse(expression):
    """An SX matrix whose equal operations are one (common subexpression elimination)."""
    if not used():
        return ca.cse(expression)
    values, marks = _marked(expression.nonzeros())
    if not marks:
        return ca.cse(expression)
    work, by_mark = [], {mark.element_hash(): lookup for lookup, mark in marks.items()}

    def value(op, operands):
        first, *others = (work[i] for i in operands)
        lookup = op == ca.OP_FMOD and by_mark.get(others[0].element_hash())
        return lookup.called(first) if lookup else apply_code(op, first, *others)

    merged = replayed(ca.cse(ca.vertcat(*values)).elements(), work, lambda leaf, symbol: leaf, value)
    return ca.SX(expression.sparsity(), ca.vertcat(*merged))


def as_text(f):
    """Text of an SX function, which is equal for equal functions alone.

    Parameters
    ----------
    f : casadi.Function

    Returns
    -------
    str
    """
    if not lookups(f):
        return f.serialize()
    outputs = f.call(f.sx_in())
    values, marks = _marked([e for y in outputs for e in y.nonzeros()])
    shapes = [[y.shape, *y.sparsity().get_triplet()] for y in outputs]
    names = sorted(marks, key=str)
    whole = ca.Function("text", [*f.sx_in(), *(marks[lookup] for lookup in names)], [ca.vertcat(*values)])
    return f"{f.name()} {list(map(str, names))} {shapes}\n{whole.serialize()}"


def replayed(expressions, work, leaf, value):
    """The outputs of expressions whose operations are taken one by one; `work` receives all values in their order.

    `leaf` gives the value of a symbol (True) or a constant (False), `value` that of an operation on places of `work`.
    """
    f = ca.Function("operations", [], list(expressions), {"allow_free": True, "live_variables": False})
    free, outputs, called = iter(f.free_sx()), [ca.SX(0)] * len(expressions), lookups(f)
    for k in range(f.n_instructions()):
        op, operands = called.get(k, f.instruction_id(k)), f.instruction_input(k)
        if op == ca.OP_OUTPUT:
            outputs[f.instruction_output(k)[0]] = work[operands[0]]
        elif op == ca.OP_PARAMETER:
            work.append(leaf(next(free), True))
        elif op == ca.OP_CONST:
            work.append(leaf(ca.SX(f.instruction_constant(k)), False))
        else:
            work.append(value(op, operands))
    return outputs


def apply_code(op, *operands):
    """The operation of CasADi with a code, or a lookup, of SX scalars."""
    if isinstance(op, Lookup):
        return op.called(*operands)
    return ca.SX.unary(op, *operands) if len(operands) == 1 else ca.SX.binary(op, *operands)


def _marked(expressions):
    """SX scalars with an operation on a symbol in place of each lookup, and the symbols by lookup."""
    work, marks = [], {}

    def value(op, operands):
        arguments = [work[i] for i in operands]
        if not isinstance(op, Lookup):
            return apply_code(op, *arguments)
        return ca.fmod(*arguments, marks.setdefault(op, ca.SX.sym(op.name)))

    return replayed(expressions, work, lambda leaf, symbol: leaf, value), marks
