"""Whether a derivation is valid with other parameters, affirmed in double precision by a few evaluations.

The points at which ranks were decided move to the manifold of the new parameters, and there every pivot of an
elimination must keep its size, whatever was left out must vanish, and the equations must hold. Each bound is at least
as strict as that of `reduction.reduce.holds`, which decides in extended precision where this does not affirm.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from servoctl.jets.branches import sizes_of_terms
from servoctl.reduction.appell import NEGATIVE
from servoctl.reduction.manifold import ON_MANIFOLD, gradient_scales, least_steps
from servoctl.reduction.ranks import clean
from servoctl.reduction.reduce import HELD, strong
from servoctl.tolerances import ENTRY, TINY

MOVES = 8  # Newton steps of a point to the manifold of other parameters


@dataclass(frozen=True)
class Quantities:
    """What decides whether a derivation is valid, as a function of (t, Z, p).

    Attributes
    ----------
    function : casadi.Function or None
        Values and sizes of the terms of all groups; None if these contain jets above s̄.
    counts : dict of str to int
        Scalars in each group: "slopes" that vanish and their "jets" and "terms", "pivots", "conditions" and "dropped"
        entries, which vanish, and the inertia matrix, "mass", without sizes.
    pivots : (n_pivots,) array
        Least sizes of the pivots at the points where they were chosen.
    """

    function: object
    counts: dict
    pivots: np.ndarray

    def at(self, t, jets, values):
        """Values and sizes (2, n, N) of each group, by name."""
        result = self.function(t[None], jets, values).full().reshape(2, -1, len(t))
        return dict(zip(self.counts, np.split(result, np.cumsum([*self.counts.values()])[:-1], axis=1), strict=True))


def quantities(equations):
    """The quantities of a model."""
    r, groups = equations.r, _groups(equations)
    scalars = [ca.SX(e) for group in groups.values() for e in group]
    counts = {name: len(group) for name, group in groups.items()}
    places = filter(None, map(r.mechanism.q.where, ca.symvar(ca.vertcat(*scalars))))
    if any(level > r.top for of, level, _ in places if of not in ("t", "q")):
        return Quantities(None, counts, np.zeros(0))
    sized = len(scalars) - counts["mass"]
    sizes = [*sizes_of_terms(scalars[:sized]), ca.SX(counts["mass"], 1)]
    f = equations.function("quantities", equations.jets, [*scalars, *sizes])
    jets = np.vstack([r.points.jet(k) for k in range(r.top + 1)]).astype(float)
    values, _ = Quantities(f, counts, None).at(r.points.t.astype(float), jets, r.points.values)["pivots"]
    return Quantities(f, counts, np.abs(values).min(axis=1, initial=np.inf))


def _groups(equations):
    r = equations.r
    slopes, jets, terms = r.orders.vanishing
    return {
        "slopes": slopes,
        "jets": jets,
        "terms": terms,
        "pivots": [pivot for _, pivot in equations.all_pivots],
        "conditions": r.conditions,
        "dropped": equations.entries_dropped,
        "mass": ca.densify(r.mechanism.mass).nonzeros(),
    }


def affirmed(model, values):
    """Whether the derivation of a model is certainly valid with other parameters.

    Parameters
    ----------
    model : Model
    values : (n_p,) array

    Returns
    -------
    bool
        If it is false, extended precision must decide.
    """
    known = model.once("quantities", lambda: quantities(model.equations))
    if known.function is None or not len(model.reduction.points.t):
        return False
    with np.errstate(all="ignore"):
        t, jets = _moved(model, values)
        return jets is not None and _valid(known, known.at(t, jets, values), model.n)


def _valid(known, found, n):
    """Whether the values and sizes of all groups are those of a valid derivation with a positive inertia matrix."""
    (slopes, of_slopes), (jets, _), (_, terms) = found["slopes"], found["jets"], found["terms"]
    jets, terms = (np.max(np.abs(each), axis=1, keepdims=True, initial=0.0) for each in (jets, terms))
    slopes = np.abs(slopes)
    alive = ~((slopes <= ENTRY * of_slopes) | (slopes * np.maximum(jets, 1.0) <= ENTRY * terms))
    left, of_left = found["conditions"]
    dropped, of_dropped = found["dropped"]
    return bool(
        not alive.any()
        and strong(clean(*found["pivots"]), known.pivots[:, None]).all()
        and (np.abs(left) <= HELD * np.maximum(of_left, TINY)).all()
        and (np.abs(dropped) <= ENTRY * of_dropped).all()
        and _positive(found["mass"][0].reshape(n, n, -1))
    )


def _positive(mass):
    """Whether inertia matrices (n, n, N) are certainly positive definite."""
    size = np.sqrt(np.einsum("iip->ip", mass))
    scaled = np.moveaxis(mass / size / size[:, None], 2, 0)
    return bool(np.isfinite(scaled).all() and np.linalg.eigvalsh(scaled).min() > NEGATIVE)


def _moved(model, values):
    """Times (N,), and jets (n_z, N) of the model's points moved to the manifold of other parameters, or None."""
    points, top, n_x = model.reduction.points, model.reduction.top, len(model.state_names)
    t, x = points.t.astype(float), np.vstack([points.jet(k) for k in range(top)]).astype(float)
    sizes = (points.sizes(top - 1) * points.factorials(top - 1))[:, None]
    invariants, rates = model.function("invariants"), model.function("ode")
    for _ in range(MOVES):
        y = np.array([invariants(*place, values) for place in zip(t, x.T, strict=True)]).T
        m = len(y) // (1 + n_x)
        residual, jacobian = y[:m], y[m:].reshape(n_x, m, len(t)).swapaxes(0, 1)
        if not np.isfinite(y).all():
            break
        if (np.abs(residual) <= ON_MANIFOLD * gradient_scales(jacobian, x, sizes)).all():
            highest = np.array([rates(*place, values)[n_x - model.n : n_x] for place in zip(t, x.T, strict=True)]).T
            return t, np.vstack([x, highest])
        x = x + least_steps(jacobian, residual, sizes).astype(float)
    return t, None
