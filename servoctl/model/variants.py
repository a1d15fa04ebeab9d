"""The same model with other pivots: those of a state near by or of an instant, or the diagonal of definite matrices.

Variants near a state are shared by the models of other parameters and paths: one whose pivots are strong at another
state serves there, too.
"""

from contextlib import suppress

import numpy as np

from servoctl.errors import ServoError, SingularProgram, SpecificationError
from servoctl.model import saddle
from servoctl.model.following import instants_of
from servoctl.model.full import affirmed
from servoctl.model.pivots import pivot_strength
from servoctl.reduction.definite import Definite, definite
from servoctl.reduction.manifold import references_at
from servoctl.spec.references import required_paths
from servoctl.tolerances import ENTRY, RESOLVED

DIAGONAL = "diagonal"  # pivots of definite matrices, beside places of other pivots
NEAR = "near"  # variants near states, derived with the parameters at which ranks were decided
STRONG = 0.1  # of its usual size: pivots above this serve for other parameters, or again
MOST_VARIANTS = 8  # of a model that it holds: motions from one start meet the same ones again


def derived_near(model, t, jets, sizes=()):
    """The model of the same specification, derived with pivots chosen at the instant t [s] with these jets (n_z,).

    `sizes`, by name, are those relative to which jets are near zero; default, also in place of rounding: their sizes
    where ranks were decided, at most 1.
    """
    jets = np.asarray(jets, dtype=float) + 0.0  # without the sign of a zero
    default = model.once("jet sizes", lambda: model.equations.jet_sizes)
    sizes = {name: size for name, size in dict(sizes).items() if size > ENTRY * default.get(name, 0.0)}
    state = dict(zip(model.jet_names, jets.tolist(), strict=True)) | references_at(required_paths(model.paths), t)
    place = (float(t), state, default | sizes)
    key = repr(place)
    if key not in model._variants:
        base = model._variants[None]
        known = (near for near in tuple(base._functions.get(NEAR, {}).values()) if _serves(base, near, t, jets))
        near = base._with(next(known, None) or _near(base, place), base._variants)
        if near.free != model.free:
            raise SpecificationError(
                f"Near t = {t:.6g} s the program has {near.free} free initial values, elsewhere {model.free}.",
                "The number of free initial values is the same along a motion.",
                do="Derive two models, one for each regime.",
                t=float(t),
                free=near.free,
                expected=model.free,
            )
        _keep(model._variants, key, near)
    return model._variants[key]


def strong_near(model, t, jets):
    """The model, or where its pivots vanish at an instant the one with pivots chosen there, if any."""
    try:
        return model if pivot_strength(model, t, jets) > RESOLVED else derived_near(model, t, jets)
    except ServoError:
        return model


def _near(base, place):
    """The shared variant of a place (t, jets by name, their sizes); where it is of no use, that of own parameters."""
    t, state, _ = place
    own = np.array_equal(base.parameters, base.reduction.context.values)
    with suppress(() if own else ServoError):
        shared, key = base._functions.setdefault(NEAR, {}), repr(place)
        if key not in shared:
            _keep(shared, key, _derived(base, place, base.reduction.context.values))
        if own or _serves(base, shared[key], t, np.array([state[name] for name in base.jet_names])):
            return shared[key]
    return _derived(base, place, base.parameters)


def _derived(base, place, values):
    base._store.require_unchanged()
    r = base.reduction
    guess = None if r.context.scales is None else base._store.specification[2] or {}
    return base._of(r.mechanism, r.program, guess, place, values)


def _serves(base, near, t, jets):
    """Whether a variant that was derived near another state, or with other parameters, is as good at these jets."""
    strong = pivot_strength(base._with(near), t, jets) > STRONG
    same = np.array_equal(base.parameters, near.reduction.context.values)
    return strong and near.free == base.free and (same or affirmed(near, base.parameters[:, None])[0])


def with_diagonal_pivots(model):
    """The model with diagonal entries of definite matrices as pivots (`reduction.definite`); None without such."""
    first = model._variants[None]
    applies = not (first.equations.definite or first.flat) and saddle.applies(first.reduction)
    return _formed(first, DIAGONAL) if applies else None


def reordered_at(model, t, jets):
    """The model with the same rows, and pivots of their leading matrix chosen at an instant.

    None if the pivots stay, or are not those of the leading matrix.
    """
    r = model.reduction
    if model.equations.definite or model.equations.sparse or (r.cascade is None and model.flat and model.nq != model.n):
        return None
    try:
        order = r.order_at(instants_of(model, [t]), np.asarray(jets, dtype=float), model.parameters)
    except SingularProgram:
        return None
    return None if order == r.order else _formed(model, order)


def place_of(model):
    """How pivots were chosen: (t, jets, sizes) of `derived_near`, then their places or `DIAGONAL`; None as derived."""
    near, form = model._store.specification[3] or (), form_of(model.reduction)
    return (*near, form) if form else near or None


def form_of(reduction):
    """`DIAGONAL`, or the places of pivots of the leading matrix; empty if they are chosen at the points."""
    return DIAGONAL if isinstance(reduction.realisation, Definite) else reduction.order


def variant_at(model, place):
    """The variant of a place (`place_of`); the model if that is None."""
    place = place or ()
    near, form = place[:3] if len(place) > 1 else (), place[-1] if len(place) % 3 == 1 else None
    if near:
        model = model._with(_near(model._variants[None], tuple(near)), model._variants)
    if form is None:
        return model
    return _formed(model, form if form == DIAGONAL else tuple((i, j) for i, j in form))


def _formed(model, form):
    """The model with the same rows, and pivots by their places, or from the diagonal; None without the latter."""
    key, r = repr((*(model._store.specification[3] or ()), form)), model.reduction
    if key in model._variants:
        return model._variants[key]
    reduction = definite(r) if form == DIAGONAL else r.with_order(form)
    store, functions = model._store.part(form), model._functions.setdefault(str(form), {})
    numbers = model.parameters, functions, model._variants, model.paths
    made = reduction and type(model)(reduction, store, *numbers)
    return _keep(model._variants, key, made)


def _keep(variants, key, variant):
    """The variant, which is held from now on, in place of the oldest one where there are too many."""
    if len(variants) > MOST_VARIANTS:
        del variants[next(known for known in variants if known is not None)]
    variants[key] = variant
    return variant
