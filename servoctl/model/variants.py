"""The same model with other pivots: those of a state near by or of an instant, or the diagonal of definite matrices."""

import numpy as np

from servoctl.errors import ServoError, SingularProgram, SpecificationError
from servoctl.model import saddle
from servoctl.model.following import instants_of
from servoctl.model.pivots import pivot_strength
from servoctl.reduction.definite import Definite, definite
from servoctl.reduction.manifold import references_at
from servoctl.spec.references import required_paths
from servoctl.tolerances import ENTRY, RESOLVED

DIAGONAL = "diagonal"  # pivots of definite matrices, beside places of other pivots
AS_DERIVED = "as derived"  # a model with the parameters at which its ranks were decided
STRONG = 0.1  # of its usual size: pivots above this serve for other parameters, or again
MOST_VARIANTS = 8  # of a model that it holds: motions from one start meet the same ones again


def derived_near(model, t, jets, sizes=()):
    """The model of the same specification, derived with pivots chosen at the instant t [s] with these jets (n_z,).

    `sizes`, by name, are those relative to which jets are near zero; default, also in place of rounding: their sizes
    where ranks were decided, at most 1.
    """
    jets = np.asarray(jets, dtype=float) + 0.0  # without the sign of a zero
    default = model.once("jet sizes", lambda: model.equations.jet_sizes)
    model._store.require_unchanged()
    sizes = {name: size for name, size in dict(sizes).items() if size > ENTRY * default.get(name, 0.0)}
    state = dict(zip(model.jet_names, jets.tolist(), strict=True)) | references_at(required_paths(model.paths), t)
    place = (float(t), state, default | sizes)
    key = repr(place)
    if key in model._variants:
        return model._variants[key]
    near = _near_before(model, t, jets, sizes) or _near(model, place)
    if near.free != model.free:
        raise SpecificationError(
            f"Near t = {t:.6g} s the program has {near.free} free initial values, elsewhere {model.free}.",
            "The number of free initial values is the same along a motion.",
            do="Derive two models, one for each regime.",
            t=float(t),
            free=near.free,
            expected=model.free,
        )
    return _kept(model, key, model._with(near, near._functions, model._variants))


def strong_near(model, t, jets):
    """The model, or where its pivots vanish at an instant the one with pivots chosen there, if any."""
    try:
        return model if pivot_strength(model, t, jets) > RESOLVED else derived_near(model, t, jets)
    except ServoError:
        return model


def _near(model, place):
    r = model.reduction
    guess = None if r.context.scales is None else model._store.specification[2] or {}
    return model._of(r.mechanism, r.program, guess, place, model.parameters)


def _near_before(model, t, jets, sizes):
    """The variant near an instant with the parameters of the derivation, if it serves with these; else None."""
    r = model.reduction
    if model.paths:  # a variant belongs to the jets of its paths
        return None
    same = np.array_equal(model.parameters, r.context.values)
    own = model if same else type(model)(r, model._store, functions=model._functions)
    first = model._functions.setdefault(AS_DERIVED, own)
    if first is model:
        return None
    try:
        near = derived_near(first, t, jets, sizes)
    except ServoError:
        return None
    here = model._with(near, near._functions)
    serves = pivot_strength(here, t, jets) > STRONG and (same or near._holds(model.parameters))
    return here if serves else None


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
        t, jets, sizes = near
        model = derived_near(model, t, [jets[name] for name in model.jet_names], sizes)
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
    return _kept(model, key, made)


def _kept(model, key, variant):
    """A variant that is held from now on, in place of the oldest one where there are too many."""
    if len(model._variants) > MOST_VARIANTS:
        del model._variants[next(known for known in model._variants if known is not None)]
    model._variants[key] = variant
    return variant
