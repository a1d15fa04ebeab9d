"""How `accuracy=` determines a method, and how the error of a motion is measured.

If something is left to integrate, the Taylor method needs the fewest evaluations at every accuracy and finds its own
steps; projection keeps its invariants at rounding (docs/work_precision.md; on some scenes a fixed-step method is faster
once its step is known). Where stability limits its steps, the motion is stiff, and Radau IIA is faster. A tolerance
bounds the error of a step, not of the motion. Therefore the motion is computed with two tolerances, and their
difference is the error.
"""

from dataclasses import replace

import numpy as np

from servoctl.checks import within
from servoctl.errors import IntegrationStopped, LimitExceeded, SpecificationError
from servoctl.methods.choice import Adaptive, Algebraic, Automatic, Project, Taylor
from servoctl.methods.sizes import sizes_of, state_levels
from servoctl.methods.taylor import order_for

SMALLEST_SIZE = 1e-3  # of a component relative to the largest of its level; a zero component has only rounding
MARGIN, FINER = 0.1, 1e-2  # first tolerance relative to the accuracy, and each next one relative to the last
ATOL = 1e-11  # default absolute tolerance, for motions whose sizes are neither far below nor far above 1
NO_MOTION = 1e-10  # of the size that the inertia gives an entry: less is rounding
UNLIKE = 3e-3  # of the largest of its level: a smaller entry has a tolerance of its own
COARSE = 10.0  # times rtol: an absolute tolerance above this part of a size decides about its error
LARGE = 1e3  # speed above which the default absolute tolerance comes near rounding and grows with the speed
FINEST = 1e-15  # tolerance below which steps shorten and rounding grows
SAME = 1.0 + 1e-9  # tolerances within this factor are one and the same, up to the rounding of their decades
COARSEST_ACCURACY, FINEST_ACCURACY = 1e-1, 1e-13  # accuracies that make sense in double precision


def relative_error(values, reference, levels=None):
    """Largest deviation of values (n, N) over components and instants, each component relative to its size.

    The size of a component is its largest magnitude in the reference, at least 1e-3 of the largest component of the
    same level (positions, velocities, ..., in SI and radians); 1 where the whole level is zero. Without levels (n,) all
    components are of one. The result is NaN if a value is.
    """
    if not np.size(reference):
        return 0.0
    levels = np.zeros(len(reference), dtype=int) if levels is None else levels
    return float((np.abs(values - reference) / component_sizes(reference, levels)[:, None]).max())


def component_sizes(values, levels, least=SMALLEST_SIZE):
    """The size of each component (n,) of values (n, N), as `relative_error` takes it, from a share of its level on."""
    size = np.abs(values).max(axis=1)
    for level in np.unique(levels):
        same = levels == level
        size[same] = np.maximum(size[same], least * size[same].max())
    size[~(size > 0)] = 1.0  # NaN among them
    return size


def large_tolerances(model, t, x):
    """Absolute tolerances (n_x,) for a motion that starts so fast that the default is rounding of it; else None.

    Its span is t = (t0, t1) [s], and x (n_x,) the state at its start. Where that lies has no part in it.
    """
    inertia = model.function("matrices")(t[0], x, model.p)[-model.n :]
    sizes = sizes_of(model, inertia, np.where(state_levels(model) == 0, 0.0, np.abs(x)), t[1] - t[0])
    return ATOL * np.where(sizes > LARGE, sizes, 1.0) if sizes.max() > LARGE else None


def coarse(sizes, rtol):
    """Whether the default absolute tolerance is no small part of sizes, an array of numbers >= 0."""
    return (sizes > 0) & (ATOL > COARSE * rtol * sizes)


def absolute_tolerances(sizes, rtol):
    """Absolute tolerances (n_x,) for a motion of sizes (n_x,) where the default is no small part of them; else None."""
    moves = sizes > 0
    if not coarse(sizes, rtol).any():
        return None
    return np.where(moves, np.minimum(ATOL, FINER * rtol * sizes), ATOL)


def unlike_tolerances(levels, largest, sizes, atol=None):
    """Absolute tolerances (n_x,) for entries of a level that are too unlike for one of the level; else None.

    As places in micrometres beside angles. `largest` (n_x,) are the magnitudes of the entries along the motion, and
    `sizes` (n_x,), from `sizes_of`, what the inertia makes of them, which tells a small entry from rounding. `atol` is
    the tolerance of the largest entries of each level; without it each entry has 1e-11 of its own size.
    """
    if not unlike(levels, largest, sizes):
        return None
    own = np.where(largest >= NO_MOTION * sizes, largest, sizes)
    own[own == 0.0] = 1.0
    return ATOL * own if atol is None else atol * np.minimum(own / np.fmax(_of_level(levels, largest), own), 1.0)


def unlike(levels, largest, sizes=0.0):
    """Whether an entry of (n_x, ...) is far below the largest of its level, and no rounding."""
    small = (largest > 0) & (largest < UNLIKE * _of_level(levels, largest))
    return (small & (largest >= NO_MOTION * sizes)).any(axis=0)


def _of_level(levels, largest):
    """The largest of the magnitudes (n_x, ...) of each entry's level."""
    first = np.searchsorted(levels, range(levels[-1] + 1))
    return np.maximum.reduceat(largest, first)[levels]


def motion_error(model, jets, reference):
    """The `relative_error` of a motion's state X = (q, γ', ..., γ^(s̄-1)), from jets (n_z, N) at the same instants."""
    n_x = len(model.state_names)
    return relative_error(jets[:n_x], reference[:n_x], state_levels(model))


def method_for(model, accuracy, jets=None):
    """The first method for an accuracy of the motion, with `jets` as the highest derivative in the samples."""
    if model.flat and jets is None:
        return Algebraic()
    rtol = max(MARGIN * accuracy, FINEST)
    return Automatic(order_for(rtol), jets, rtol, rtol)


def _with_fallback(simulated, method):
    """The method and its motion; where series stop, those of DOP853, which needs none."""
    try:
        return method, simulated(method, Project())
    except IntegrationStopped:
        if not isinstance(method, Automatic) or method.jets is not None:
            raise
        other = Adaptive(rtol=method.rtol, atol=method.atol)
        return other, simulated(other, Project())


def accurate(simulated, model, accuracy, method=None, drift=None):
    """The motion with a `motion_error` of at most `accuracy`; `simulated` gives a run from a method and a drift.

    A flat program is solved to rounding at each instant. Otherwise, or with jets, the tolerance is lowered until two
    successive motions agree to `accuracy`; the one of the lower tolerance is returned, and its message states the
    difference. Only `Taylor(jets=...)` may be given, since all else follows from the accuracy. LimitExceeded is raised
    if rounding errors exceed it; its `.run` is the motion of the lowest tolerance.
    """
    accuracy, jets = require_accuracy(accuracy), _jets_alone(accuracy, method, drift)
    method = method_for(model, accuracy, jets)
    if isinstance(method, Algebraic):
        return simulated(method, None)
    method, run = _with_fallback(simulated, method)
    if run.method == str(getattr(method, "for_stiff", None)):
        method = method.for_stiff
    if not run.success:
        return run
    best, growth = np.inf, 0.0
    while method.rtol > SAME * FINEST:
        coarser, rtol = method, max(FINER * method.rtol, FINEST)
        method = replace(method, rtol=rtol, atol=rtol)
        method, finer = _with_fallback(simulated, method)
        if not finer.success:
            return finer
        difference = _disagreement(model, run, finer)
        growth = difference / coarser.rtol
        if difference <= accuracy:
            return replace(finer, message=f"{finer.message}; two tolerances agree to {difference:.1e}")
        best, run = min(best, difference), finer
    raise _out_of_reach(accuracy, best, growth, run)


def _disagreement(model, run, finer):
    """`motion_error` between two motions at the samples of both; infinite where an event ends one of them alone."""
    if run.status != finer.status:
        return np.inf
    _, here, there = np.intersect1d(run.t, finer.t, return_indices=True)
    return motion_error(model, run.jets[:, here], finer.jets[:, there])


def _out_of_reach(accuracy, best, growth, run):
    nearest = f"accuracy={2 * best:.1g}: two tolerances agree to {best:.1e}."
    error = LimitExceeded(
        f"accuracy={accuracy:g} was given; the errors of steps grow by about {growth:.1e} along the motion.",
        "Rounding errors grow with them, so that a smaller tolerance cannot help.",
        nearest=nearest if 2 * best <= COARSEST_ACCURACY else "",
        do="Use a larger accuracy or a shorter span.",
        accuracy=accuracy,
        reached=best,
        growth=growth,
    )
    error.run = run
    return error


def require_accuracy(accuracy):
    """An accuracy as a float, or the error of one that is out of range."""
    return within("accuracy", accuracy, FINEST_ACCURACY, COARSEST_ACCURACY)


def _jets_alone(accuracy, method, drift):
    """The jets of a method that is combined with an accuracy; its other settings are refused."""
    if drift is None and method is None:
        return None
    if drift is None and isinstance(method, Taylor) and method.jets and method == Taylor(jets=method.jets):
        return method.jets
    chosen = {name: value for name, value in (("method", method), ("drift", drift)) if value is not None}
    raise SpecificationError(
        f"accuracy={accuracy!r} was given with {', '.join(f'{name}={value!r}' for name, value in chosen.items())}.",
        "An accuracy determines the method, its settings and the treatment of drift; only jets may be set.",
        nearest=f"method=sv.methods.Taylor(jets={method.jets})." if getattr(method, "jets", None) else "",
        do=f"Leave out the accuracy, or {' and '.join(chosen)}.",
        **chosen,
    )
