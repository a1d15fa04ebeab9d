"""Velocities that rows determine, and the other rows without them."""

from dataclasses import replace
from functools import lru_cache

import casadi as ca

from servoctl.codegen import emit
from servoctl.errors import SingularProgram
from servoctl.jets.factors import constants_outside
from servoctl.jets.identity import spread, vanish
from servoctl.jets.tape import Tape
from servoctl.reduction.ranks import clean, eliminate, pivot_order

CONVOLUTIONS = {"mul": 1.0, "div": 1.0, "quad": 1.0, "power": 1.0, "sq": 0.5, "sqrt": 0.5}  # in an operation


@lru_cache(4)  # the same for all functions of one model
def solved_for(equations):
    """Velocities that rows determine: for each level below s̄ rows, the entries of γ^(k) they give, and pivots.

    A row of order k or less is linear in γ^(k). Those entries are not integrated: what is integrated satisfies the row
    with the tolerance, what is solved for to rounding. They are chosen so that all pivots are constant or watched.
    """
    r, solved = equations.r, {}
    for k in range(1, equations.top if r.cascade is None and not r.orthogonal else 1):
        rows = [a for a, row in enumerate(r.rows) if row.order + (not row.affine) <= k]
        matrix = r.leading[rows, :]
        numbers = clean(*r.points.matrix(matrix))
        try:
            order = pivot_order(matrix, numbers)
            columns = sorted(j for _, j in order)
            order = tuple((i, columns.index(j)) for i, j in order)
            _, pivots = eliminate(matrix[:, columns], ca.SX(len(rows), 0), numbers[:, columns], order=order)
        except SingularProgram:
            continue
        if rows and all(_watched(pivot, equations) for pivot in pivots):
            solved[k] = rows, columns, order
    return solved


def _watched(pivot, equations):
    """Whether a pivot is constant, or equals one that is watched up to its sign."""
    others = [other for _, other in equations.all_pivots]
    return not ca.symvar(pivot) or any(vanish(v) for o in others for v in spread([pivot - o, pivot + o]))


@lru_cache(4)
def in_independent(equations):
    """The rows with what rows of order 0 and 1 determine put into the others, their L, and the stage of these others.

    None if no products of series fall away. A balance with x'' cos θ + y'' sin θ of what rolls has twice as many as
    that of the angles alone.
    """
    r, q, solved = equations.r, equations.q, solved_for(equations).get(1)
    if solved is None or equations.top != 2:
        return None
    inside, columns, _ = solved
    others, free = ([i for i in range(q.n) if i not in some] for some in (inside, columns))
    velocities, accelerations = (_by_others(equations, solved, level) for level in (1, 2))
    given = ca.vertcat(*(ca.vertcat(*(q.gamma(k)[j] for j in columns)) for k in (2, 1)))
    found = ca.vertcat(ca.substitute(accelerations, given[len(columns) :], velocities), velocities)
    put = ca.substitute(ca.vertcat(*(r.rows[a].expression for a in others)), given, found)
    ways = [r.rows]
    for way in emit.other_ways(equations.function("rows", equations.jets, [put])):
        new = dict(zip(others, way.elements(), strict=True))
        ways.append([replace(row, expression=new[a], slopes=None) if a in new else row for a, row in enumerate(r.rows)])
    rows = min(ways, key=lambda way: _products(q, way))
    if _products(q, rows)[0] >= _products(q, r.rows)[0]:
        return None
    leading = ca.vertcat(*(row.gradient(q) for row in rows))
    matrix = leading[others, free]
    _, pivots = eliminate(matrix, ca.SX(len(others), 0), clean(*r.points.matrix(matrix)))
    if not all(_watched(pivot, equations) for pivot in pivots):
        return None
    return rows, leading, (others, free, ())


def _by_others(equations, solved, level):
    """The velocities or accelerations that rows determine, by the others."""
    (rows, columns, order), r = solved, equations.r
    given = ca.vertcat(*(equations.q.gamma(level)[j] for j in columns))
    right = ca.vertcat(*(equations.levels[a][level - r.rows[a].order] for a in rows))
    matrix = r.leading[rows, columns]
    numbers = clean(*r.points.matrix(matrix))
    return eliminate(matrix, -ca.substitute(right, given, ca.SX.zeros(len(columns))), numbers, order=order)[0]


def _products(q, rows):
    """The number of products of series in rows, where one with itself counts half, and that of all operations."""
    tape = Tape(None, ca.cse(ca.vertcat(*(row.expression for row in rows))).elements())
    still = {i for i, symbol in enumerate(tape.symbols) if q.where(symbol) is None}
    nodes, total, moving = constants_outside(tape, still).nodes, 0.0, []
    for kind, args, data in nodes:
        moving.append(data not in still if kind == "input" else any(moving[a] for a in args))
        series = [a for a in args if moving[a]]
        total += CONVOLUTIONS.get(kind, 0.0) if len(series) == len(args) or kind == "div" and moving[args[1]] else 0.0
    return total, len(nodes)
