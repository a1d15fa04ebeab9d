"""The same model with other pivots: those of a state near by, or systems that are solved without a choice of pivots.

Variants near a state are shared by the models of other parameters and paths: one whose pivots are strong at another
state serves there, too.
"""

from contextlib import suppress

import numpy as np

from servoctl.errors import ServoError, SpecificationError
from servoctl.model.full import affirmed
from servoctl.model.pivots import pivot_strength
from servoctl.reduction import range_space
from servoctl.reduction.manifold import references_at
from servoctl.spec.references import required_paths
from servoctl.tolerances import ENTRY, RESOLVED

FREE = "without a choice"  # of pivots, beside places of others
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
        others = (v for v in tuple(base._functions.get(NEAR, {}).values()) if v.reduction is not model.reduction)
        found = next((v for v in others if _serves(base, v, t, jets)), None) or _near(base, place)
        held = (v for v in base._variants.values() if v.reduction is found.reduction)
        near = next(held, None) or base._with(found, base._variants)
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
        strong = model if pivot_strength(model, t, jets) > RESOLVED else strong_form(model, t, jets)
        return strong or derived_near(model, t, jets)
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


def strong_form(model, t, jets):
    """The model as first derived, or without a choice of pivots, if what its rows divide by is strong at an instant.

    Where a model that chooses no pivots is weak, its rows are, and only others help.
    """
    base = model._variants[None]
    others = model.reduction.rows is not base.reduction.rows
    made = [(base, False)] * others + [(model, True)] * (not model.reduction.orthogonal) + [(base, True)] * others
    forms = (without_choice(each) if free else each for each, free in made)
    return next((form for form in forms if pivot_strength(form, t, jets) > STRONG), None)


def without_choice(model):
    """The model with the same rows, whose systems are solved without a choice of pivots (`reduction.range_space`)."""
    near = model._store.specification[3] or ()
    key = repr((*near, FREE))
    if model.reduction.orthogonal or key in model._variants:
        return model._variants.get(key, model)
    functions, reduction = model._functions.setdefault(FREE, {}), range_space.without_choice(model.reduction)
    numbers = model.parameters, functions, model._variants, model.paths
    return _keep(model._variants, key, type(model)(reduction, model._store, *numbers))


def place_of(model):
    """How pivots were chosen: (t, jets, sizes) of `derived_near`, then `FREE` if none are; None as derived."""
    near, free = model._store.specification[3] or (), (FREE,) * model.reduction.orthogonal
    return (*near, *free) or None


def variant_at(model, place):
    """The variant of a place (`place_of`); the model if that is None. What names other pivots is solved without."""
    place = place or ()
    if len(place) > 1:
        model = model._with(_near(model._variants[None], tuple(place[:3])), model._variants)
    return without_choice(model) if len(place) % 3 == 1 else model


def _keep(variants, key, variant):
    """The variant, which is held from now on, in place of the oldest one where there are too many."""
    if len(variants) > MOST_VARIANTS:
        del variants[next(known for known in variants if known is not None)]
    variants[key] = variant
    return variant
