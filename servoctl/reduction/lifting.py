"""Equations that are linear in some unknowns, as a sparse system in which shared sums are unknowns, too.

In joint angles the inertia matrix of n bodies is full, although the balance that it comes from takes about n
operations: the acceleration of a body is a sum that all bodies behind it share. With such sums z as further unknowns,
each with the row that defines it, the system has about n entries, and elimination in sparse order about n operations.
"""

import casadi as ca

from servoctl.jets.series import Series
from servoctl.jets.tape import Tape, add, divide, holds, multiply

SIGNS = {"add": 1.0, "sub": -1.0}  # of the second term


def lifted(expressions, unknowns):
    """The matrix of expressions f = A x + f(0) that are linear in unknowns x, in x and further unknowns z.

    An (m + k, n + k) SX for m expressions and n symbols x: the rows of f - f(0) = P x + Q z, then those of
    R x + (S - 1) z = 0, which define the k shared sums z; S is strictly lower triangular. None where other operations
    are made of unknowns than sums and products with factors.
    """
    expressions = ca.cse(expressions)
    tape = Tape(ca.symvar(expressions), expressions.elements())
    place = {s.element_hash(): k for k, s in enumerate(unknowns.elements())}
    free = [place.get(s.element_hash()) for s in tape.symbols]
    series = Series(tape, [[s if k is None else 0.0] for s, k in zip(tape.symbols, free, strict=True)])
    series.advance(without=_with_unknowns(tape, free))
    sums, forms, uses = [], [], _uses(tape)
    for i, node in enumerate(tape.nodes):
        form = {free[node.data]: 1.0} if node.kind == "input" else _form(node, forms, series.c)
        if form is None:
            return None
        form.pop(None, None)
        if len(form) > 1 and uses[i] > 1:
            sums.append(form | {len(place) + len(sums): -1.0})
            form = {len(place) + len(sums) - 1: 1.0}
        forms.append(form)
    rows = [*(forms[i] for i in tape.outputs), *sums]
    filled, columns = [i for i, form in enumerate(rows) for _ in form], [j for form in rows for j in form]
    entries = ca.vertcat(ca.SX(0, 1), *(factor for form in rows for factor in form.values()))
    return ca.SX.triplet(filled, columns, entries, len(rows), len(place) + len(sums))


def _with_unknowns(tape, free):
    """The set of nodes that change with unknowns; `free` has for each input the index of an unknown, or None."""
    moving = set()
    for i, node in enumerate(tape.nodes):
        if free[node.data] is not None if node.kind == "input" else not moving.isdisjoint(node.args):
            moving.add(i)
    return moving


def _form(node, forms, c):
    """The linear part of an operation, factors by unknown; None if it is not linear. `c`: values without unknowns."""
    kind, args, data = node
    moving = [i for i in args if forms[i]]
    if not moving:
        return {}
    if kind in SIGNS:
        return _sum(forms[args[0]], forms[args[1]], SIGNS[kind])
    a, b = args[0], args[-1]
    if kind == "mul" and len(moving) == 1 and a != b:
        (still,) = {a, b} - set(moving)
        return _scaled(forms[moving[0]], lambda x: multiply(c[still][0], x))
    if kind == "div" and moving == [a]:
        return _scaled(forms[a], lambda x: divide(x, c[b][0]))
    if kind == "gate" and moving == [b]:
        return _scaled(forms[b], lambda x: multiply(holds(ca.SX(c[a][0])), x))
    if kind in ("neg", "scale", "copy"):
        factor = {"neg": -1.0, "scale": data, "copy": 1.0}[kind]
        return _scaled(forms[a], lambda x: multiply(factor, x))
    return None


def _scaled(form, by):
    """A linear form with `by` applied to each factor."""
    return {k: by(factor) for k, factor in form.items()}


def _sum(a, b, sign):
    """The form a + sign b."""
    total = dict(a)
    for k, factor in b.items():
        change = factor if sign > 0 else multiply(-1.0, factor)
        total[k] = add(total[k], change) if k in total else change
    return total


def _uses(tape):
    """How often each node is an argument or an output."""
    uses = [0] * len(tape.nodes)
    for i in (*(i for node in tape.nodes for i in node.args), *tape.outputs):
        uses[i] += 1
    return uses
