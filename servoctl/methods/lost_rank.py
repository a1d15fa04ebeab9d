"""The errors of motions that end where a program is singular, or where no step succeeds."""

import numpy as np

from servoctl.errors import IntegrationStopped, SingularProgram
from servoctl.methods.rank import HOPELESS, LOST
from servoctl.model.equations import gradient_jets
from servoctl.model.report import explain

VANISHING = 0.03  # of its reference: a gradient or rank measure below this counts as lost
SHARE = 0.1  # of the largest entry of a null vector: smaller entries are not named in the error


def failed(rank, t, x, why, told, row):
    """The error of a state from which no step succeeds: singular for the reason `why`, or the method's own.

    The latter has `told` what happened and what to do, and of which residual, if of one.
    """
    if rank.lost(t, x):
        return singular(rank, t, x, why)
    what, do = told
    return IntegrationStopped(
        f"{what}.",
        "A motion is integrated as far as its solution exists and steps succeed.",
        do=f"{do} The run before this instant is in .run.",
        t=float(t),
        **({"residual": row} if row else {}),
    )


def singular(rank, t, x, why):
    """The error that names the instant, the rows that lose rank, and the jets that are zero there."""
    matrices, measure, model = rank.matrices(t, x), rank.measure(t, x), rank.first
    lost, zero = [], []
    for m, c, r, rows in zip(matrices, rank.columns, rank.rows, rank.names, strict=True):
        norms = np.linalg.norm(m / c, axis=1)
        lost += [name for name, a, b in zip(rows, norms, r, strict=True) if a <= VANISHING * b and name not in lost]
    state = dict(zip(model.state_names, zip(x, rank.largest, strict=True), strict=True))
    for row in lost or dict.fromkeys([*rank.names[0], *rank.names[1]]):
        for name in gradient_jets(model.reduction, row):
            value, largest = state.get(name, (1.0, 1.0))
            if abs(value) < VANISHING * max(largest, 1e-12) and name not in zero:
                zero.append(name)
    forces = rank.least(t, x)[0] > LOST * rank.best[0]  # L keeps its rank, and Bᵀ has lost its own
    direction = _null_direction(rank, matrices, int(forces))
    where = f", where {' and '.join(f'{name} = 0' for name in zero)}" if zero else ""
    dependent = [] if lost else _dependent_rows(rank, matrices, int(forces))
    facts = {"measure": measure, "rows": lost or dependent, "direction": direction}
    at_zero = np.where([name in zero for name in model.state_names], 0.0, x)
    explained = explain(model, t, at_zero, lost, **facts)
    if explained is not None:
        return explained
    what = f"the {'direction' if forces else 'gradient'} of row {', '.join(map(repr, lost))} vanishes"
    what = what if lost else f"the rows {', '.join(map(repr, dependent))} lose their rank"
    return SingularProgram(
        f"The program is singular at t = {t:.7g} s: {what}{where}; {why}.",
        f"{_how_small(rank, measure)}{'The actuation or a reaction is' if forces else 'Accelerations are'} "
        f"undetermined in the direction of {', '.join(direction)}.",
        do=f"{_advice(model.reduction, lost or dependent)} The run before it is in .run.",
        t=float(t),
        measure=measure,
        rows=lost or dependent,
        zero=zero,
        direction=direction,
    )


def _advice(r, lost):
    """What to do where rows lose their rank: as designed rows can be written otherwise, derived ones cannot."""
    as_written = (row for row in r.rows if row.name in r.original and not row.derivation)
    written = {row.name: row.order for row in as_written if row.name in lost}
    actuators, residuals = r.mechanism.actuators, r.program.residuals
    if written and not any(written.values()):
        return (
            "Plan a path that keeps away from this state, as from the edge of what the machine reaches, or write "
            "the residual in a form whose gradient does not vanish there."
        )
    if written:
        return (
            "Write the residual in a form whose gradient does not vanish (linear in velocities, not squared), or "
            "plan around this state."
        )
    if r.program.by == "actuators" and len(actuators) > len(residuals) and {*actuators}.intersection(lost):
        return (
            f"Program as many residuals as there are actuators, {len(actuators)}: weights choose among them, and "
            "here one acts on no residual. Or plan around this state."
        )
    return "Plan around this state, or program other outputs."


def _how_small(rank, measure):
    """The rank measure as a sentence; a motion that begins at a singular state has no better one, or none."""
    best = float(rank.best.min())
    small = f"{best:.1e} from the first instant on" if best < HOPELESS else f"{measure:.1e} of its best so far"
    sentence = f"The smallest singular value, rows of size 1 in the metric of the inertia, is {small}. "
    return sentence if min(best, measure) < LOST else ""


def _dependent_rows(rank, matrices, i):
    """Names of the rows of L, or of Bᵀ for i = 1, that depend on each other: its left null vector."""
    names = rank.names[i]
    if not np.all(np.isfinite(matrices[i])):
        return list(names)
    scaled = matrices[i] / rank.columns[i]
    norms = np.linalg.norm(scaled, axis=1)[:, None]
    scaled = scaled / np.where(norms > 0, norms, 1.0)
    weights = np.abs(np.linalg.svd(scaled)[0][:, -1])
    return [names[j] for j in np.flatnonzero(weights > SHARE * weights.max())]


def _null_direction(rank, matrices, i):
    """Names of the accelerations that the rows leave open: the right null vector of L, or of Bᵀ for i = 1."""
    leading, columns = matrices[i], rank.columns[i]
    names = rank.first.jet_names[-rank.first.n :]
    if not np.all(np.isfinite(leading)):
        return list(names)
    rows = np.linalg.norm(leading / columns, axis=1)
    vector = np.abs(np.linalg.svd((leading / columns) / np.where(rows > 0, rows, 1.0)[:, None])[2][-1] / columns)
    return [names[j] for j in np.flatnonzero(vector > SHARE * vector.max())]
