"""Whether reduced equations satisfy the full ones, as these are written: with other numbers, and along a motion.

A slope that vanishes where a row is derived lowers the row's order, and what it is a slope of is left out. If it does
not vanish identically, that may come alive: a gear that is blended in at 3 s, a coupling beyond x = 2, a parameter that
was zero. What the reduced equations give then leaves the full ones.
"""

from functools import reduce

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.errors import SingularProgram
from servoctl.model.equations import invariant_names
from servoctl.model.points import place_of, with_place
from servoctl.reduction.appell import NEGATIVE
from servoctl.reduction.manifold import ON_MANIFOLD
from servoctl.reduction.reduce import WEAKER
from servoctl.tolerances import ENTRY

TOGETHER = 1000  # sets of parameters, which bounds the memory
MOVES = 8  # Newton steps of a point to the manifold of other parameters
DRIFTED = 1e-6  # of its terms: below this a residual may be due to drift; above, it is judged on the manifold


def affirmed(model, values):
    """For which parameters (n_p, C) a derivation is certainly valid, (C,) array of bool.

    That is so where the points at which ranks were decided, as far as they reach the manifold of these parameters,
    satisfy the full equations there, with a positive inertia and no pivot far weaker or, as at a pole, stronger.
    """
    points, result = model.reduction.points, np.zeros(values.shape[1], bool)
    place = place_of(model, [_criterion(model), _to_manifold(model)])
    if place is None or not len(points):
        return result
    t, x = points.t.astype(float), np.vstack([points.jet(k) for k in range(model.reduction.top)]).astype(float)
    x = on_manifold(model, t, x, with_place(place, model.parameters))
    for first in range(0, len(result), TOGETHER):
        p = with_place(place, values[:, first : first + TOGETHER])
        count = p.shape[1]
        at = np.repeat(t, count), np.repeat(x, count, axis=1), np.tile(p, len(t))
        near, met = (each.reshape(-1, count) for each in _examined(model, *at))
        result[first : first + count] = near.any(axis=0) & (met | ~near).all(axis=0)
    return result


def _examined(model, t, x, p):
    """Whether states x (n_x, N) with p (n_p, N) reach their manifold, and whether the derivation is valid there."""
    f = _criterion(model)
    near, met = f.grid(t, x, p) > 0
    off = np.flatnonzero(~near)
    if len(off):
        t, p = t[off], p[:, off]
        near[off], met[off] = f.grid(t, on_manifold(model, t, x[:, off], p), p) > 0
    return near, met


def on_manifold(model, t, x, p):
    """States x (n_x, N) moved to the manifolds of p (n_p,) or (n_p, N), as far as Newton's method does so."""
    there = np.zeros(len(t), bool)
    for _ in range(MOVES):
        *moved, near = _to_manifold(model).grid(t, x, p)
        x, there = np.where(there, x, moved), there | (near > 0)  # one step more leaves rounding
        if there.all():
            break
    return x


def _criterion(model):
    """A function of (t, X, p): whether a state is on its manifold, and whether the derivation is valid there."""

    def build():
        e, r, n_x = model.equations, model.reduction, len(model.state_names)
        pivots = ca.vertcat(*(pivot for _, pivot in e.all_pivots))
        before = np.abs(r.points.evaluate(pivots.elements())[0]).astype(float)
        least, most = before.min(axis=1, initial=np.inf), before.max(axis=1, initial=0.0)
        highest = e.called(model.function("ode").expression, e.state, e.parameters)[n_x - model.n : n_x]
        y = e.called(model.function("full").expression, ca.vertcat(e.state, highest), e.parameters)
        mass, m = r.mechanism.mass, y.numel() // 3
        inertia = ca.ldl(ca.sparsify(mass - NEGATIVE * ca.diag(ca.diag(mass))))[0]
        kept = ca.fabs(pivots) > WEAKER * least, WEAKER * ca.fabs(pivots) < most
        met = _met(inertia > 0, *kept, ca.fabs(y[:m]) <= ENTRY * y[2 * m :])
        return compiled(e.function("criterion", e.state, [_off(model)[0], met]), "criterion")

    return model.once("criterion", build)


def _to_manifold(model):
    """A function of (t, X, p): the state after a step to its manifold, and whether it is there before."""

    def build():
        e, (near, residual, rows, sizes) = model.equations, _off(model)
        lengths = ca.sqrt(ca.sum2(rows**2))
        rows = ca.diag(1 / lengths) @ rows
        step = rows.T @ ca.ldl_solve(residual / lengths, *ca.ldl(rows @ rows.T)) if rows.numel() else 0 * e.state
        return compiled(e.function("to_manifold", e.state, [e.state - sizes * step, near]), "to_manifold")

    return model.once("to the manifold", build)


def _off(model):
    """Expressions: whether a state is on its manifold, the residuals, their scaled gradients, and usual sizes."""
    e, m, points, level = model.equations, len(invariant_names(model)), model.reduction.points, model.reduction.top - 1
    sizes = (points.sizes(level) * points.factorials(level)).astype(float)
    y = e.called(model.function("invariants").expression, e.state, e.parameters)
    residual, jacobian = y[:m], ca.sparsify(ca.reshape(y[m:], m, len(sizes)))
    scales = ca.sqrt(jacobian**2 @ (sizes + ca.fabs(e.state)) ** 2)
    near = _met(ca.fabs(residual) <= ON_MANIFOLD * ca.if_else(scales > 0, scales, 1))
    return near, residual, jacobian @ ca.diag(sizes), sizes


def _met(*conditions):
    """Whether all of some columns of conditions are met."""
    return reduce(ca.logic_and, ca.vertcat(*conditions).elements(), ca.SX(1))


def departure(model, t, jets):
    """The first sample of a motion, t (N,) [s] with jets (n_z, N), that does not satisfy the full equations.

    Its index, and the name of an equation that it does not satisfy; (None, "") if there is none.
    """
    f, n_x, p = model.function("full"), len(model.state_names), model.p

    def restored(t, z):
        x = on_manifold(model, t, z[:n_x], p)
        return np.vstack([x, model.function("ode").grid(t, x, p)[n_x - model.n : n_x]])

    names = [*model.reduction.full, *model.reduction.omitted]
    return first_departure(names, lambda t, z: f.grid(t, z, p), t, jets[: f.n_x], restored)


def first_departure(names, full, t, z, restored):
    """The same for points z (n_z, N), from functions of times and points.

    `full` gives what `equations.sized` has of the equations, `restored` the points on the constraint manifold.
    """
    known = np.flatnonzero(np.isfinite(z).all(axis=0))
    t, z = t[known], z[:, known]
    left, terms, usual = np.split(np.abs(full(t, z)), 3)
    allowed = np.fmax(DRIFTED * np.fmax.accumulate(terms, axis=1), ENTRY * usual)
    suspects = np.flatnonzero((left > allowed).any(axis=0))
    if len(suspects):
        z = restored(t[suspects], z[:, suspects])
        off = np.abs(full(t[suspects], z))[: len(names)] > allowed[:, suspects]
        confirmed = np.flatnonzero(off.any(axis=0))
        if len(confirmed):
            return int(known[suspects[confirmed[0]]]), names[int(np.argmax(off[:, confirmed[0]]))]
    return None, ""


def other_order(row, t, free=None, expected=None):
    """The error of a row whose order changes at t [s], with the numbers of free initial values beyond and before."""
    changes = free not in (None, expected)
    there = f", and from there on {free} initial values are free instead of {expected}" if changes else ""
    return SingularProgram(
        f"The order of row {row!r} changes at t = {t:.6g} s: terms are active that vanish where it was derived{there}.",
        "The rows of a motion keep their orders along it.",
        do="Derive two models, one for each regime, with guess={...} in each, and join their motions.",
        t=t,
        row=row,
        free=free,
        expected=expected,
    )
