"""Piecewise constant values: the coefficients of splines, which CasADi writes as sums over all pieces.

They are made of constants and of comparisons knot <= s of one s alone, so that their numbers on all pieces are known.
"""

from collections import defaultdict
from typing import NamedTuple

import casadi as ca
import numpy as np

from servoctl.jets.tape import Node

FEWEST = 2  # knots from which on a search takes no longer than sums

_STEPWISE = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda a: 2.0 * a,
    ca.OP_INV: lambda a: 1.0 / a,
}


_OF_NODES = {
    "add": ca.OP_ADD,
    "sub": ca.OP_SUB,
    "mul": ca.OP_MUL,
    "div": ca.OP_DIV,
    "neg": ca.OP_NEG,
    "sq": ca.OP_SQ,
}


class Constant(NamedTuple):
    """An operand that is a number."""

    value: float


class Pieces(NamedTuple):
    """A piecewise constant function of s: its knots (n,), and its values (n + 1,)."""

    knots: np.ndarray
    values: np.ndarray

    def __call__(self, s):
        """The values at an array s."""
        return self.values[np.searchsorted(self.knots, s, "right")]


def by_pieces(tape, kept=()):
    """The nodes of a tape, for numbers, with piecewise constant ones as functions of their s in place of sums.

    There are as many as before; those that others do not need any more are zero. `kept` are nodes that are read,
    besides those of the outputs.
    """
    statements = [(i, *_statement(tape.nodes, node)) for i, node in enumerate(tape.nodes) if node.kind != "const"]
    pieces = piecewise_constant(statements)
    read = {v for target, _, operands in statements if target not in pieces for v in operand_values(operands)}
    read |= {*tape.outputs, *kept}
    nodes = [Node("const", (), 0.0) if i in pieces else node for i, node in enumerate(tape.nodes)]
    for v, values in of_all_pieces(statements, pieces, read.intersection(pieces)):
        s, knots = pieces[v]
        nodes[v] = Node("constant", (s,), Pieces(knots, values))
    return nodes


def _statement(nodes, node):
    """Operation and operands of a node, as CasADi has them; slopes of functions are operands as well."""
    kind, args, data = node
    code = ca.OP_LE if (kind, data) == ("constant", "le") else _OF_NODES.get(kind)
    args = (*args, *data[1]) if kind == "quad" else args
    return code, tuple(Constant(nodes[a].data) if nodes[a].kind == "const" else a for a in args)


def operand_values(operands):
    """The values among operands."""
    return [v for v in operands if isinstance(v, int)]


def piecewise_constant(statements):
    """The s and the knots, an array, of each value that is made of constants and of comparisons knot <= s."""
    source, knots = {}, defaultdict(set)
    for target, operation, operands in statements:
        if operation == ca.OP_LE and isinstance(operands[0], Constant) and not isinstance(operands[1], Constant):
            if operands[1] not in source:
                source[target] = operands[1]
                knots[operands[1]].add(operands[0].value)
        elif operation in _STEPWISE:
            of = {source.get(v) for v in operands if not isinstance(v, Constant)}
            if len(of) == 1 and None not in of:
                source[target] = of.pop()
    sorted_ = {s: np.array(sorted(some)) for s, some in knots.items() if len(some) >= FEWEST}
    usable = {s: k for s, k in sorted_.items() if np.isfinite(len(k) / (k[-1] - k[0])) and np.isfinite(k).all()}
    return {v: (s, usable[s]) for v, s in source.items() if s in usable}


def of_all_pieces(statements, pieces, read):
    """(value, its numbers on all pieces) of each value that is read; numbers live as long as others need them."""
    last = {v: k for k, (_, _, operands) in enumerate(statements) for v in operand_values(operands)}
    numbers = {}
    for k, (target, operation, operands) in enumerate(statements):
        if target not in pieces:
            continue
        if operation == ca.OP_LE:
            knots = pieces[target][1]
            numbers[target] = 1.0 * (np.arange(len(knots) + 1) > np.searchsorted(knots, operands[0].value))
        else:
            arguments = (v.value if isinstance(v, Constant) else numbers[v] for v in operands)
            with np.errstate(all="ignore"):
                numbers[target] = _STEPWISE[operation](*arguments)
        if target in read:
            yield target, np.broadcast_to(numbers[target], len(pieces[target][1]) + 1)
        for v in {*operand_values(operands), target}:
            if last.get(v, k) <= k:
                numbers.pop(v, None)
