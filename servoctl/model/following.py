"""The paths that a model follows: what its motion needs of them, and the instants at which its steps end."""

from itertools import chain
from math import factorial

import numpy as np

from servoctl.codegen.paths import Followed
from servoctl.errors import SpecificationError
from servoctl.jets.tape import JETS, REAL
from servoctl.model.points import with_place
from servoctl.spec.paths.value import SAME, numbers_in, parameters_of
from servoctl.spec.references import required_paths

SMOOTHER = 2  # continuous derivatives of a motion between the nodes of a flat plan: its interpolation uses two


def breaks_within(model, span, smoother=SMOOTHER):
    """Instants within a span at which a path has fewer continuous derivatives than a motion by some method needs.

    That are `smoother` more than the actuation contains. SpecificationError where it has fewer than these.
    """
    low, high, found = min(span), max(span), set()
    for name, path in required_paths(model.paths).items():
        needs = model.reduction.follows[name]
        require_class(name, path, needs, (low, high), model.reduction.program.jumps)
        found |= {*path.held().breaks_below(needs + smoother, low, high).tolist()}
    return tuple(sorted(found))


def ends_of_pieces(model, span):
    """Instants within a span at which pieces of paths end, whatever their class."""
    held = (path.held() for path in required_paths(model.paths).values())
    return [t for path in held for t in path.breaks_below(np.inf, min(span), max(span)).tolist()]


def require_class(name, path, needs, span, jumps):
    """Refuse a path that has too few continuous derivatives inside a span, or is not known there."""
    low, high = span
    for end, rule, outside in ((0, path.before, low < path.breaks[0]), (-1, path.after, high > path.breaks[-1])):
        if outside and rule is None and path.classes[end] < needs:
            at, side = float(path.breaks[end]), "after" if end else "before"
            raise SpecificationError(
                f"The path of {name} is asked for from t = {low:g} to {high:g} s, and nothing was said of it {side} "
                f"t = {at:g} s.",
                f"It is held there if {needs} derivatives, which the actuation contains, vanish; "
                f"{path.classes[end]:g} do.",
                f"t_span within {path.breaks[0]:g} .. {path.breaks[-1]:g} s.",
                f"Stay inside, or make the path with {side}='hold', 'continue' or 'periodic'.",
                name=name,
                t=at,
            )
    held, least = path.held(), needs - (1 if jumps else 0)
    inside = [t for t in held.breaks_below(least, low, high) if low < t < high]
    if inside:
        first, last = held.breaks[[0, -1]]
        at = first + (inside[0] - first) % (last - first) if held.before == "periodic" else inside[0]
        class_ = int(held.classes[np.argmin(np.abs(held.breaks - at))])
        has = f", has {f'C^{class_}' if class_ >= 0 else 'a jump'}"
        raise SpecificationError(
            f"The path of {name} needs C^{needs}{has} at t = {inside[0]:.6g} s.",
            f"The actuation contains its derivative {needs}, which must be continuous.",
            do=f"Make it with smoothness={needs}"
            + ("." if jumps else ", or write Program(..., jumps=True) where forces may jump."),
            name=name,
            needs=needs,
            has=class_,
            t=float(inside[0]),
        )


def places_of(models):
    """The places in memory (1, N) of the paths of models, (0, N) without references, at which their p begin."""
    if not (models and models[0].paths):
        return np.empty((0, len(models)))
    return np.array([[model._followed.address for model in models]])


def p_with(model, parameters):
    """The parameters of a model's compiled functions, with others (n_p,) or (n_p, N) than its own."""
    return with_place((model._followed.address,) if model.paths else (), parameters)


def moved_by(model, names):
    """Pairs (reference, parameter) of the paths that contain some of the parameters, by their names."""
    written = _names_in_paths(model)
    return tuple((r, n) for r, path in model.paths.items() for n in names if written.get(n) in parameters_of(path))


def p_with_rates(model, pairs):
    """The parameters of compiled functions that take derivatives of references by parameters behind the references."""
    if not pairs:
        return model.p
    known = model._rates_followed
    if pairs not in known:
        rates = []
        for reference in dict.fromkeys(r for r, _ in pairs):  # pairs are in their order
            of = [_names_in_paths(model)[name] for r, name in pairs if r == reference]
            rates += model.paths[reference].source.rates(_numbers_in_paths(model), of)
        known[pairs] = Followed([*model._followed.paths, *(rate.held() for rate in rates)])
    return with_place((known[pairs].address,), model.parameters)


def instant_by(model, name, t):
    """The derivative by a parameter of an instant t [s] at which paths may make forces jump; None where none does.

    SpecificationError where breaks of several paths meet that move differently.
    """
    rates, written = {}, _names_in_paths(model)[name]
    for reference, path in model.paths.items():
        k = int(np.argmin(np.abs(path.breaks - t)))
        if path.classes[k] <= model.reduction.follows[reference] and abs(path.breaks[k] - t) <= SAME * abs(t):
            moves = written in parameters_of(path)
            rates[reference] = path.source.moved(_numbers_in_paths(model), written)[k] if moves else 0.0
    if len({*rates.values()}) > 1:
        raise SpecificationError(
            f"At t = {t:.6g} s the paths of {', '.join(rates)} have breaks that move differently with {name!r}.",
            "Forces jump there, and derivatives by a parameter are those of jumps apart from each other.",
            do="Give the paths a higher smoothness, or breaks at different instants.",
            t=float(t),
            name=name,
        )
    return next(iter(rates.values()), None)


def _names_in_paths(model):
    """Names of the parameters as paths have them, by those of the model."""
    parameters = model.reduction.mechanism.parameters
    return {name: symbol.name() for name, symbol in zip(parameters.names, parameters.symbols, strict=True)}


def _numbers_in_paths(model):
    """Values of the parameters as paths have them."""
    return numbers_in(model.reduction.mechanism.parameters.symbols, model.parameters)


def instants_of(model, t):
    """Instants (N, 1 + R) of times (N,) [s]: with the jets of the paths that a model follows there."""
    family = model.reduction.mechanism.q.family
    result = np.zeros((len(t), len(family), JETS + 1), dtype=REAL)
    for name, path in zip(model.paths, model._followed.paths, strict=True) if model.paths else ():
        order = min(JETS, path.coefficients.shape[2] - 1)
        sizes = np.array([[factorial(k)] for k in range(order + 1)], dtype=float)
        result[:, family.names.index(name), : order + 1] = (path.jets(t, order)[:, 0] / sizes).T
    return np.column_stack([np.asarray(t, dtype=REAL), result.reshape(len(t), -1)])


def corners_of(model):
    """Instants at which the paths that a model follows have a break."""
    paths = required_paths(model.paths).values()
    return tuple(sorted({*chain.from_iterable(path.breaks[np.isfinite(path.classes)].tolist() for path in paths)}))
