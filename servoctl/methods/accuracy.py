"""The rule by which an accuracy becomes a method: how an error is measured, and what reaches it.

Where something is left to integrate, the Taylor method needs the fewest evaluations at every accuracy, and it finds
its steps itself; projection keeps its invariants at rounding (docs/work_precision.md, where a method of fixed step is
faster on some scenes, once its step is known). A tolerance bounds the error of a step and not of the motion, so the
rule does not trust it: the motion is computed with two tolerances, and their difference is the error.
"""

from dataclasses import replace
from numbers import Real

import numpy as np

from servoctl.checks import is_number
from servoctl.errors import LimitExceeded, SpecificationError
from servoctl.methods.choice import Algebraic, Project, Taylor
from servoctl.methods.taylor import order_for

SMALLEST_SIZE = 1e-3  # of a component relative to the largest of its level: what is zero has rounding for its size
MARGIN, FINER = 0.1, 1e-2  # first tolerance by the accuracy, and of each next one by the one before
FINEST = 1e-15  # tolerance: below, steps shorten and rounding grows
COARSEST_ACCURACY, FINEST_ACCURACY = 1e-1, 1e-13  # accuracies that make sense in double precision


def relative_error(values, reference, levels=None):
    """Largest deviation over components and instants, each component relative to its size.

    The size of a component is its largest magnitude in the reference, at least 1e-3 of the largest component of the
    same level (positions, velocities, ..., in SI and radians); 1 where the whole level is zero.

    Parameters
    ----------
    values, reference : (n, N) arrays
    levels : (n,) array of int, optional
        Level of each component; default: all the same.

    Returns
    -------
    float
        NaN where a value is not finite.
    """
    if not np.size(reference):
        return 0.0
    levels = np.zeros(len(reference), dtype=int) if levels is None else levels
    return float((np.abs(values - reference) / component_sizes(reference, levels)[:, None]).max())


def component_sizes(values, levels):
    """The size of each component (n,) of values (n, N), as `relative_error` takes it."""
    size = np.abs(values).max(axis=1)
    for level in np.unique(levels):
        own = levels == level
        size[own] = np.maximum(size[own], SMALLEST_SIZE * size[own].max())
    size[size == 0] = 1.0
    return size


def state_levels(model):
    """Level of each entry of the state X: 0 for q, k for γ^(k); (n_x,) array of int."""
    n_x, nq, n = len(model.state_names), model.nq, model.n
    return np.append(np.zeros(nq, dtype=int), 1 + np.arange(n_x - nq) // n)


def motion_error(model, jets, reference):
    """Error of a motion: `relative_error` of its state X = (q, γ', ..., γ^(s̄-1)).

    Parameters
    ----------
    model : Model
    jets, reference : (n_z, N) arrays
        Jets at the same instants.

    Returns
    -------
    float
    """
    n_x = len(model.state_names)
    return relative_error(jets[:n_x], reference[:n_x], state_levels(model))


def method_for(model, accuracy, jets=None):
    """The method with which the rule begins for an accuracy of the motion.

    Parameters
    ----------
    model : Model
    accuracy : float
    jets : int, optional
        Highest derivative in the samples; the Taylor method gives it, also where nothing is integrated.

    Returns
    -------
    Algebraic or Taylor
    """
    if model.flat and jets is None:
        return Algebraic()
    rtol = max(MARGIN * accuracy, FINEST)
    return Taylor(order_for(rtol), jets, rtol, rtol)


def accurate(simulated, model, accuracy, method=None, drift=None):
    """The motion with an error of at most `accuracy`.

    Where nothing is integrated, each instant is solved to rounding. Else the tolerance is lowered until two successive
    motions agree to `accuracy`; the one of the lower tolerance is returned.

    Parameters
    ----------
    simulated : callable
        From a method and a treatment of drift to a Run.
    model : Model
    accuracy : float
        See `motion_error`.
    method : None or Taylor
        `Taylor(jets=...)` asks for jets; order and tolerances follow from the accuracy.
    drift : None
        Follows from the accuracy.

    Returns
    -------
    Run
        Its message tells the difference.

    Raises
    ------
    SpecificationError
        For an accuracy out of range, or together with what it determines.
    LimitExceeded
        Where rounding grows beyond it first; `.run` is the best motion.
    """
    accuracy, jets = require_accuracy(accuracy), _jets_alone(accuracy, method, drift)
    method = method_for(model, accuracy, jets)
    if isinstance(method, Algebraic):
        return simulated(method, None)
    run = simulated(method, Project())
    if not run.success:
        return run
    best = np.inf
    while method.rtol > FINEST:
        rtol = max(FINER * method.rtol, FINEST)
        method = replace(method, rtol=rtol, atol=rtol)
        finer = simulated(method, Project())
        if not finer.success:
            return finer
        difference = motion_error(model, run.jets, finer.jets)
        if difference <= accuracy:
            return replace(finer, message=f"finished; two tolerances agree to {difference:.1e}")
        best, run = min(best, difference), finer
    error = LimitExceeded(
        f"accuracy={accuracy:g} was asked for.",
        "Errors grow along an unstable motion, and rounding with them: no tolerance reaches what rounding has spoilt.",
        nearest=f"accuracy={2 * best:.1g}: two tolerances agree to {best:.1e}.",
        do="Ask for less, or for a shorter span.",
        accuracy=accuracy,
        reached=best,
    )
    error.run = run
    raise error


def require_accuracy(accuracy):
    """An accuracy as a float, where it is one."""
    low, high = FINEST_ACCURACY, COARSEST_ACCURACY
    if not (isinstance(accuracy, Real) and low <= accuracy <= high):
        raise SpecificationError(
            f"accuracy={accuracy!r} was given.",
            f"An accuracy is the largest relative error of the motion, from {low:g} to {high:g}.",
            nearest=f"{np.clip(accuracy, low, high):g}." if is_number(accuracy) else "",
            do="Give 1e-6, or a number in this range.",
            accuracy=accuracy,
        )
    return float(accuracy)


def _jets_alone(accuracy, method, drift):
    """The jets that a method asks for beside an accuracy; anything else that the accuracy determines is refused."""
    if drift is None and method is None:
        return None
    if drift is None and isinstance(method, Taylor) and method.jets and method == Taylor(jets=method.jets):
        return method.jets
    chosen = {name: value for name, value in (("method", method), ("drift", drift)) if value is not None}
    raise SpecificationError(
        f"accuracy={accuracy!r} was given with {', '.join(f'{name}={value!r}' for name, value in chosen.items())}.",
        "An accuracy determines the method, its settings and the treatment of drift; only jets may be asked for.",
        nearest=f"method=sv.Taylor(jets={method.jets})." if getattr(method, "jets", None) else "",
        do="Leave one of them out.",
        **chosen,
    )
