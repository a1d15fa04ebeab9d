"""Whether a derivation is valid with other parameters, affirmed in double precision by a few evaluations.

The points at which ranks were decided move to the manifold of the new parameters, and there every pivot of an
elimination must keep its size, whatever was left out must vanish, and the equations must hold. Each bound is at least
as strict as that of `reduction.reduce.holds`, which decides in extended precision where this does not affirm.
"""

from functools import reduce

import casadi as ca
import numpy as np

from servoctl.codegen.function import GRID_POINTS, compiled
from servoctl.jets.branches import sizes_of_terms
from servoctl.model.equations import invariant_names
from servoctl.model.points import place_of, through, with_place
from servoctl.reduction.appell import NEGATIVE
from servoctl.reduction.manifold import ON_MANIFOLD, at_nominal_size, gradient_scales, least_steps
from servoctl.reduction.ranks import clean
from servoctl.reduction.reduce import WEAKER, strong
from servoctl.tolerances import ENTRY, TINY
from servoctl.values import frozen

TOGETHER = 1000  # sets of parameters, which bounds the memory
MOVES = 8  # Newton steps of a point to the manifold of other parameters


@frozen
class Quantities:
    """What decides whether a derivation is valid, as a function of (t, Z, p).

    The groups are "pivots", the full equations, "conditions", and the inertia matrix, "mass", which has no sizes.
    """

    function: object  # values and sizes of the terms of all groups; None where points have no paths of their own
    counts: dict  # scalars in each group, by name
    pivots: np.ndarray  # (n_pivots,), least sizes at the points where they were chosen

    def at(self, t, jets, values, place=()):
        """Values and sizes (2, n, N) of each group, by name; the parameters (n_p,) or (n_p, N)."""
        result = _evaluated(self.function, t, jets, with_place(place, values))
        result = result.reshape(2, -1, len(t))
        return dict(zip(self.counts, np.split(result, np.cumsum([*self.counts.values()])[:-1], axis=1), strict=True))


def quantities(equations):
    """The quantities of a model."""
    r, groups = equations.r, _groups(equations)
    scalars = [ca.SX(e) for group in groups.values() for e in group]
    counts = {name: len(group) for name, group in groups.items()}
    sized = len(scalars) - counts["mass"]
    sizes = [*sizes_of_terms(scalars[:sized]), ca.SX(counts["mass"], 1)]
    f = compiled(equations.function("quantities", equations.jets, [*scalars, *sizes]), "quantities")
    jets = np.vstack([r.points.jet(k) for k in range(r.top + 1)]).astype(float)
    followed = through(r, [f.expression]) if r.references else None
    if r.references and followed is None:
        return Quantities(None, counts, np.zeros(0))
    place = (followed.address,) if followed else ()
    values, _ = Quantities(f, counts, None).at(r.points.t.astype(float), jets, r.points.values, place)["pivots"]
    return Quantities(f, counts, np.abs(values).min(axis=1, initial=np.inf))


def _groups(equations):
    r = equations.r
    return {
        "pivots": [pivot for _, pivot in equations.all_pivots],
        "conditions": equations.written,
        "mass": ca.densify(r.mechanism.mass).nonzeros(),
    }


def affirmed(model, values):
    """Whether a derivation is certainly valid with parameters (n_p,); if not, extended precision must decide."""
    return bool(affirmed_each(model, np.reshape(values, (-1, 1)))[0])


def affirmed_each(model, values):
    """The same for each column of parameters (n_p, C), (C,) array of bool."""
    result, points = np.zeros(values.shape[1], bool), len(model.reduction.points.t)
    if not points:
        return result
    known = model.once("quantities", lambda: quantities(model.equations))
    if known.function is None:
        return result
    with np.errstate(all="ignore"):
        # from the manifold of the model's own parameters others are fewer steps away
        at = model._rank_points if len(result) > 1 else _points_of(model)
        if len(result) > 1:
            result = _plainly_valid(model, at, values)
        others = np.flatnonzero(~result)
        for here in (others[first : first + TOGETHER] for first in range(0, len(others), TOGETHER)):
            sets, places = np.unique(values[:, here], axis=1, return_inverse=True)
            moved, t, jets = _moved(model, at, sets)
            good = np.zeros(sets.shape[1], bool)
            if len(moved):
                good[moved] = _valid(model, known, t, jets, sets[:, moved])
            result[here] = good[places.ravel()]
    return result


def _place(model):
    """The place of paths through the points, for the functions that are evaluated there."""
    known = model.once("quantities", lambda: quantities(model.equations))
    return place_of(model, [known.function, model.function("invariants"), model.function("ode")])


def points_with(model):
    """States (n_x, points) at which ranks were decided, moved to the manifold of the model's own parameters.

    They stay where that is the same, or where not all reach it.
    """
    at, changed = _points_of(model), model.parameters != model.reduction.points.values
    if not changed[_of_invariants(model)].any():
        return at
    if model.once("quantities", lambda: quantities(model.equations)).function is None and model.paths:
        return at
    moved, _, jets = _moved(model, at, model.parameters[:, None])
    return jets[: len(at)] if len(moved) else at


def _of_invariants(model):
    """Indices of the parameters on which the invariants depend."""

    def places():
        f = model.function("invariants").expression
        t, x, p, *r = f.sx_in()
        depends = ca.which_depends(f(t, x, p, *r), p, 1, False)
        return np.flatnonzero(depends[-len(model.parameters) :] if len(model.parameters) else []).tolist()

    return model.once("parameters of the invariants", places)


def _plainly_valid(model, x, values):
    """Whether a derivation is plainly valid in each case, by points x (n_x, points) of the model's own manifold."""
    result, t = np.zeros(values.shape[1], bool), model.reduction.points.t.astype(float)
    varied = np.flatnonzero((values != model.parameters[:, None]).any(axis=1)).tolist()
    moving = bool(set(varied) & set(_of_invariants(model)))
    varied = None if moving else varied
    criterion = model.once(f"criterion {varied}", lambda: _criterion(model, varied))
    for first in range(0, len(result), TOGETHER):
        part = values[:, first : first + TOGETHER]
        count = part.shape[1]
        times, states = np.repeat(t, count), np.repeat(x, count, axis=1)
        p = with_place(_place(model), np.tile(part, len(t)))
        states = on_manifold(model, times, states, p) if moving else states
        met = _evaluated(criterion, times, states, p)
        result[first : first + count] = (met > 0).reshape(len(t), count).all(axis=0)
    return result


def _criterion(model, varied):
    """A function of (t, X, p), positive where a derivation is valid, each bound being met at each point by itself.

    It has only what depends on the varied parameters, or all where points move with them (None).
    """
    known, equations = model.once("quantities", lambda: quantities(model.equations)), model.equations
    t, x, p, n, n_x = equations.q.t, equations.state, equations.parameters, model.n, len(model.state_names)
    rates = equations.called(model.function("ode").expression, x, p)
    y = equations.called(known.function.expression, ca.vertcat(x, rates[n_x - n : n_x]), p)
    value, size = ca.vertsplit(y, y.numel() // 2)
    depend = [True] * y.numel() if varied is None else ca.which_depends(y, p[varied], 1, True) if varied else []
    some = {i % value.numel() for i, depends in enumerate(depend) if depends}
    starts = np.cumsum([0, *known.counts.values()]).tolist()
    groups = {name: range(*ends) for name, *ends in zip(known.counts, starts[:-1], starts[1:], strict=True)}
    met = [ca.SX(1)]
    met += [ca.fabs(value[i]) <= ENTRY * ca.fmax(size[i], TINY) for i in some & {*groups["conditions"]}]
    for i, least in zip(groups["pivots"], (WEAKER * known.pivots).tolist(), strict=True):
        met += [ca.fabs(value[i]) >= least, ca.fabs(value[i]) > ENTRY * size[i]] if i in some else []
    if some & {*groups["mass"]}:
        mass = ca.reshape(value[list(groups["mass"])], n, n)
        met += [pivot > 0 for pivot in ca.ldl(ca.sparsify(mass - NEGATIVE * ca.diag(ca.diag(mass))))[0].elements()]
    if varied is None:
        met += [_manifold(model, t, x, p)[1]]
    return compiled(equations.function("criterion", x, [reduce(ca.logic_and, met)]), "criterion")


def on_manifold(model, t, x, p):
    """States x (n_x, N) moved to the constraint manifolds of p, as far as Newton's method of full ranks does so."""

    def step():
        at = model.equations.q.t, model.equations.state, model.equations.parameters
        return compiled(model.equations.function("to_manifold", at[1], _manifold(model, *at)), "to_manifold")

    f = model.once("to the manifold", step)
    for _ in range(MOVES):
        *moved, near = _evaluated(f, t, x, p)
        if (near > 0).all():
            break
        x = np.array(moved)
    return x


def _manifold(model, t, x, p):
    """Expressions of the state after a step of `least_steps` to the manifold, and whether it is there before."""
    m, sizes = len(invariant_names(model)), _sizes_of(model)
    y = model.equations.called(model.function("invariants").expression, x, p)
    residual, jacobian = y[:m], ca.sparsify(ca.reshape(y[m:], m, -1))
    scales = ca.sqrt(jacobian**2 @ (sizes + ca.fabs(x)) ** 2)
    off = [ca.fabs(residual[i]) <= ON_MANIFOLD * ca.if_else(scales[i] > 0, scales[i], 1) for i in range(m)]
    rows = jacobian @ ca.diag(sizes)
    lengths = ca.sqrt(ca.sum2(rows**2))
    rows = ca.diag(1 / lengths) @ rows
    step = sizes * (rows.T @ ca.ldl_solve(residual / lengths, *ca.ldl(rows @ rows.T))) if m else 0 * x
    return [x - step, reduce(ca.logic_and, off, ca.SX(1))]


def _sizes_of(model):
    """Sizes (n_x,) of the states at the points where ranks were decided."""
    points, top = model.reduction.points, model.reduction.top
    return (points.sizes(top - 1) * points.factorials(top - 1)).astype(float)


def _valid(model, known, t, z, values):
    """Whether a derivation is valid and the inertia positive in each case, by jets z at times t, case by case."""
    n, cases, r = model.n, values.shape[1], model.reduction
    p, place = np.repeat(values, len(t) // cases, axis=1), _place(model)

    def at(z):
        found = known.at(t, z, p, place)
        return {name: group.reshape(*group.shape[:2], cases, group.shape[2] // cases) for name, group in found.items()}

    found = at(z)
    left, of_left = found["conditions"]
    if not (np.abs(left) <= ENTRY * np.maximum(of_left, TINY)).all():  # a velocity that is kept at zero is rounding
        sizes = r.points.sizes(r.top) * r.points.factorials(r.top)
        of_left = np.maximum(of_left, at(at_nominal_size(z, sizes, model.nq))["conditions"][1])
    checks = (
        strong(clean(*found["pivots"]), known.pivots[:, None, None]),
        np.abs(left) <= ENTRY * np.maximum(of_left, TINY),
    )
    positive = _positive(found["mass"][0].reshape(n, n, -1)).reshape(cases, -1).all(axis=1)
    return np.all([check.all(axis=(0, 2)) for check in checks], axis=0) & positive


def _positive(mass):
    """Whether each inertia matrix (n, n, N) is certainly positive definite, (N,)."""
    size = np.sqrt(np.einsum("iip->ip", mass))
    scaled = np.moveaxis(mass / size / size[:, None], 2, 0)
    finite = np.isfinite(scaled).all(axis=(1, 2))
    scaled[~finite] = 0.0
    return finite & (np.linalg.eigvalsh(scaled).min(axis=1) > NEGATIVE)


def _points_of(model):
    """States (n_x, points) at which the ranks of a model were decided."""
    points = model.reduction.points
    return np.vstack([points.jet(k) for k in range(model.reduction.top)]).astype(float)


def _moved(model, at, values):
    """States (n_x, points) moved to the manifolds of other parameters (n_p, C).

    Returns the cases (K,) whose points all reach it, with times (K points,) [s] and jets (n_z, K points), case by case.
    """
    points, n_x = model.reduction.points, len(model.state_names)
    n_points, cases = len(points.t), values.shape[1]
    sizes = _sizes_of(model)[:, None]
    invariants, rates = model.function("invariants"), model.function("ode")
    t = np.tile(points.t.astype(float), cases)
    x = np.tile(at, cases)
    p, m = with_place(_place(model), np.repeat(values, n_points, axis=1)), len(invariant_names(model))
    left, moved = np.arange(cases), np.zeros(cases, bool)
    for _ in range(MOVES):
        here = (left[:, None] * n_points + np.arange(n_points)).ravel()
        y = _evaluated(invariants, t[here], x[:, here], p[:, here])
        residual, jacobian = y[:m], y[m:].reshape(n_x, m, len(here)).swapaxes(0, 1)
        finite = np.isfinite(y).all(axis=0)
        near = (np.abs(residual) <= ON_MANIFOLD * gradient_scales(jacobian, x[:, here], sizes)).all(axis=0) & finite
        finite, near = (each.reshape(-1, n_points).all(axis=1) for each in (finite, near))
        moved[left[near]] = True
        on = np.repeat(finite & ~near, n_points)
        left = left[finite & ~near]
        if not len(left):
            break
        x[:, here[on]] += least_steps(jacobian[:, :, on], residual[:, on], sizes).astype(float)
    here = np.flatnonzero(np.repeat(moved, n_points))
    t, x = t[here], x[:, here]
    highest = _evaluated(rates, t, x, p[:, here])[n_x - model.n : n_x]
    return np.flatnonzero(moved), t, np.vstack([x, highest])


def _evaluated(f, t, x, p):
    """The outputs (n_y, N) of a Compiled, which few points do not load."""
    if len(t) > GRID_POINTS:
        return f.grid(t, x, p)
    y = np.empty((f.n_y, len(t)))
    f.interpreted.grid(t, x, p, y)
    return y
