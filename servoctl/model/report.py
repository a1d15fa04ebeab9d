"""The printed form of a model, and what is said of a state at which its program is singular."""

import warnings

import numpy as np

from servoctl.errors import ServoError, SingularProgram
from servoctl.model.rest import first_motion, standstill_near
from servoctl.reduction.rows import alternatives
from servoctl.reduction.self_motion import self_motion

LARGEST_EXPLAINED = 20_000  # operations of the accelerations, beyond which relative degrees take minutes
WIDTH = 118


def describe(model):
    """What `print(model)` shows: how the specification was reduced, in at most twelve lines."""
    r = model.reduction
    program = f"program {', '.join(r.program.residuals)} by {_by(r)}" if r.program.residuals else "no program"
    raised = _raised(r)
    lines = [
        f"Model: {' '.join(r.mechanism.q.names)}; {program}",
        *_left_out(model),
        *([f"  {raised}"] if raised else []),
        *_hidden_and_free(model),
        f"  {_rule(r)}",
        *_open(r),
    ]
    if any(not row.affine for row in r.rows):
        nonlinear = ", ".join(row.name for row in r.rows if not row.affine)
        lines.append(f"  {nonlinear}: not linear in the highest derivative, differentiated once more")
    lines.append(f"  rank margins: smallest pivot {r.rank.kept:.1e}, largest dropped {r.rank.dropped:.1e}")
    if model.knots:
        lines.append(f"  paths switch at t = {', '.join(f'{k:g}' for k in model.knots[:8])} s")
    return "\n".join(line if len(line) <= WIDTH else line[: WIDTH - 3] + "..." for line in lines)


def _left_out(model):
    """How many coordinates play no part in the program."""
    names = model.left_out
    count = f"{len(names)} coordinates play" if len(names) > 1 else f"The coordinate {''.join(names)} plays"
    return [f"  {count} no part in this program: left out; keep= includes them"] if names else []


def _by(r):
    return "an ideal reaction" if r.program.by == "ideal" else f"actuators {', '.join(r.mechanism.actuators)}"


def _raised(r):
    """'X, Z (order 0) differentiated 2x each': until the accelerations appear."""
    groups = {}
    for name, row in r.original.items():
        groups.setdefault((max(0, r.top - row.order), row.order), []).append(name)
    parts = []
    for (count, order), names in groups.items():
        times = f"differentiated {count}x" + (" each" if len(names) > 1 else "") if count else "not differentiated"
        parts.append(f"{', '.join(names)} (order {order}) {times}")
    return "; ".join(parts)


def _hidden_and_free(model):
    """Hidden constraints and free initial values, on one line if there is room."""
    r = model.reduction
    free = f"{model.free} free initial value{'s' * (model.free != 1)}"
    free += " (flat: nothing is integrated)" if model.flat else ""
    if not r.hidden:
        return [f"  no hidden constraint; {free}"]
    count = f"{len(r.hidden)} hidden constraint{'s' * (len(r.hidden) != 1)}"
    stories = "; ".join(row.story for row in r.hidden)
    line = f"  {count} ({stories}); {free}"
    return [line] if len(line) <= WIDTH else [f"  {count}; {free}", f"    {stories}"]


def _rule(r):
    names = r.mechanism.q.force_names
    dependent = ", ".join(names[i] for i in r.realisation.dependent) or "none"
    if r.program.by == "actuators":
        return f"(3.18) with T from ker Eᵀ; dependent: {dependent}; no rule for the reaction is assumed"
    program = [row for row in r.original.values() if row.kind == "program"]
    classical = all(row.order == 0 or (row.order == 1 and row.affine) for row in program)
    rule = "d'Alembert's principle" if classical else "the generalised Chetaev rule, a postulate at this order"
    return f"(3.18) with T from ker G; dependent: {dependent}; under {rule}"


def _open(r):
    """How actuation that the program leaves open is chosen, and the self-motion that goes with it."""
    m, k = len(r.mechanism.actuators), len(r.program.residuals)
    if r.program.by == "ideal" or not 0 < k < m:
        return []
    weighted = r.program.weights or r.program.metric == "inertia"
    norm = "of least weighted norm" if weighted else "of least norm"
    chosen = "nearest to the wishes" if r.program.toward else norm
    return [f"  {m} actuators for {k} residuals: {chosen}; {self_motion(r) or 'no self-motion'}"]


def warn_of_products(r):
    """Warn of each residual that holds by more than one of its factors: a start decides which, and both may be zero."""
    for row in r.original.values():
        zeros = alternatives(r.mechanism.q, row, r.context)
        if zeros:
            warnings.warn(
                f"The residual {row.name!r} is a product, and holds wherever {' or '.join(zeros)} is zero: a start "
                f"decides by which, and where both are zero its gradient vanishes. Divide {row.name!r} by the factor "
                "that is not meant, or pass guess={...} to derive, far from the zeros of that factor.",
                RuntimeWarning,
                stacklevel=3,
            )


def explain(model, t, x, lost, **facts):
    """The error of a singular state (n_x,), of which `lost` rows lose their gradients, by its cause; None if unknown.

    Machines that roll may stand still there, or relative degrees be others than in motion.
    """
    chosen = dict(zip(model.state_names, map(float, x), strict=True))
    found = standstill_near(model, t, chosen)
    if found is not None:
        at, still = found
        return still.error(at, first_motion(model, at, chosen, still), chosen, **facts)
    prescribed = any(name in model.reduction.original for name in lost)
    large = model.function("ode").operations > LARGEST_EXPLAINED
    return None if prescribed or large else _lost_degrees(model, t, np.asarray(x, dtype=float), **facts)


def _lost_degrees(model, t, x, **facts):
    """The error of a state at which the residuals have other relative degrees than in motion, or None."""
    try:
        usual, there = (model.structure(), model.structure([t], x[:, None]))
    except ServoError:
        return None
    if not there.zeros_at_infinity or there.zeros_at_infinity == usual.zeros_at_infinity:
        return None
    degrees = zip(usual.residuals, usual.relative_degree, there.relative_degree, strict=True)
    changed = ", ".join(f"that of {name} is {local}, in motion {r}" for name, r, local in degrees if local != r)
    zero, state = there.at[0][1].zero, dict(zip(model.state_names, x, strict=True))
    decisive = zero or dict.fromkeys(jet for row in model.row_stories() for jet in model.gradient_jets(row))
    values = [f"{name} = {state[name]:.4g}" for name in decisive if name in state]
    where = f", where {' and '.join(values)}" if values else ""
    lost = f"relative degrees differ there ({changed})" if changed else "zeros at infinity differ there"
    return SingularProgram(
        f"The program is singular at t = {t:.7g} s{where}: {lost}.",
        "Such a state does not determine the actuation, and towards it the actuation may grow without bound.",
        do=f"Start and plan away from it{f', by model.start({zero[0]}=...)' if zero else ''}, or program outputs whose "
        "relative degrees stay the same. The run before it is in .run.",
        t=float(t),
        relative_degree=there.relative_degree,
        in_motion=usual.relative_degree,
        **facts | {"zero": list(zero)},
    )
