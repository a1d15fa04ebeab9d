"""The printed form of a model, and what is said of a state at which its program is singular."""

import warnings
from math import inf

import numpy as np

from servoctl.checks import distinct
from servoctl.errors import ServoError, SingularProgram
from servoctl.markup import fitted, listed
from servoctl.model.equations import gradient_jets
from servoctl.model.rest import first_motion, standstill_near
from servoctl.reduction.rows import alternatives
from servoctl.reduction.self_motion import self_motion

LARGEST_EXPLAINED = 20_000  # operations of the accelerations, beyond which relative degrees take minutes


def describe(model, full):
    """The lines of a printed model: what was done to the specification; if full, with what the derivation rests on."""
    r, rows = model.reduction, (_title, _longer, _left_out, _raised, _hidden, _free, _chosen, _follows)
    texts = [fitted(lambda room, row=row: row(model, r, room), full) for row in rows]
    return "\n  ".join(filter(None, [*texts, *(_derivation(r) if full else ())])).splitlines()


def _title(model, r, room):
    names, program, actuators = listed(r.mechanism.q.names, room), r.program, r.mechanism.actuators
    if not program.residuals:
        return f"Model: {names}; no program"
    several = "s" * (len(actuators) != 1)
    by = "an ideal reaction" if program.by == "ideal" else f"the actuator{several} {listed(actuators, room)}"
    return f"Model: {names} under the program {listed(program.residuals, room)}; realised by {by}"


def _longer(model, r, room):
    """The longer names of what would else bear the name of a coordinate or another signal.

    A residual of an output, as X - path of X, is expected, and has its line in the details alone.
    """
    read = distinct("residual", r.original, r.mechanism.signals)
    told = [name for name in read if room == inf or name not in r.mechanism.outputs]
    names = [*(read[name] for name in told if read[name] != name), *r.mechanism.longer]
    return f"longer names, as other signals have the short ones: {listed(names, room)}" * bool(names)


def _left_out(model, r, room):
    """How many coordinates play no part in the program."""
    names = model.reduction.left_out
    count = f"{len(names)} coordinates play" if len(names) > 1 else f"the coordinate {''.join(names)} plays"
    return f"{count} no part in the program: left out, unless keep= includes them" * bool(names)


def _raised(model, r, room):
    """How often each residual and material constraint is differentiated, until the accelerations appear."""
    groups, times = {}, {0: "not differentiated", 1: "differentiated once", 2: "differentiated twice"}
    for name, row in r.original.items():
        groups.setdefault((max(0, r.top - row.order), row.order), []).append(name)
    return "; ".join(
        f"{listed(names, room)} (order {order}) {'are' if len(names) > 1 else 'is'} "
        f"{times.get(k, f'differentiated {k} times')}"
        for (k, order), names in groups.items()
    )


def _hidden(model, r, room):
    derivations = [row.derivation for row in r.hidden]
    if not derivations:
        return "no hidden constraint"
    return (
        f"{len(derivations)} hidden constraint{'s' * (len(derivations) > 1)} ({listed(derivations, room, apart='; ')})"
    )


def _free(model, r, room):
    """What the program leaves free."""
    if model.flat:
        return "flat: the program determines the whole motion, nothing is integrated"
    rest = "the internal dynamics are" if r.program.residuals else "the motion is"
    return f"{model.free} free initial value{'s' * (model.free > 1)}: {rest} integrated"


def _chosen(model, r, room):
    """The rule for an ideal reaction; or how actuation that the program leaves open is chosen, with its self-motion."""
    m, k, program = len(r.mechanism.actuators), len(r.program.residuals), r.program
    if program.by == "ideal":
        rows = [row for row in r.original.values() if row.kind == "program"]
        classical = all(row.order == 0 or (row.order == 1 and row.affine) for row in rows)
        rule = "d'Alembert's principle" if classical else "the generalised Chetaev rule, a postulate at this order"
        return f"the reaction obeys {rule}"
    if not 0 < k < m:
        return ""
    norm = "of least weighted norm" if program.weights or program.metric == "inertia" else "of least norm"
    chosen = "nearest to the wishes" if program.toward else norm
    own = self_motion(r) or "no self-motion"
    return f"{m} actuators for {k} residual{'s' * (k > 1)}: {chosen}; {own}"


def _follows(model, r, room):
    """The references, with the derivatives that the actuation contains."""
    groups = {}
    for name, order in r.follows.items():
        groups.setdefault(max(order, 0), []).append(name)
    several = {0: "", 1: " with its first derivative"}

    def told(order, names):
        each = ", each" * (len(names) > 1) * (order > 0)
        most = several.get(order, f" with its derivatives up to order {order}")
        return f"{listed(names, room)}{each}{most}"

    return f"follows {'; '.join(told(order, names) for order, names in sorted(groups.items()))}" * bool(groups)


def _derivation(r):
    """How eq. (3.18) was applied, rows that are not linear, and the margins of the rank."""
    dependent = ", ".join(r.mechanism.q.force_names[i] for i in r.realisation.dependent) or "none"
    kernel, rule = ("Eᵀ", "; no rule for the reaction is assumed") if r.program.by == "actuators" else ("G", "")
    yield f"(3.18) with T from ker {kernel}; dependent: {dependent}{rule}"
    if nonlinear := [row.name for row in r.rows if not row.affine]:
        yield f"{', '.join(nonlinear)}: not linear in the highest derivative, differentiated once more"
    yield f"rank margins: smallest pivot {r.rank.kept:.1e}, largest dropped {r.rank.dropped:.1e}"


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
    r = model.reduction
    decisive = zero or dict.fromkeys(jet for row in r.rows for jet in gradient_jets(r, row.name))
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
