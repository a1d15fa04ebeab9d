"""Coordinates that play no part in a program: nothing couples them to what it prescribes or reports."""

from collections.abc import Mapping

from servoctl.checks import texts
from servoctl.errors import unknown


def needed(mechanism, program, keep=(), named=()):
    """The mechanism without the coordinates that play no part in a program; itself if all do.

    A coordinate plays a part if residuals, weights, wishes, outputs, `keep` or `named` contain it, or if terms of the
    mechanism couple it to one that does.

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
    keep : sequence of str
        Names of coordinates.
    named : iterable of str
        Signals that a caller starts from, limits or bounds: coordinates and actuators with their derivatives among
        them.

    Returns
    -------
    Mechanism

    Raises
    ------
    NameUnknown
        If `keep` names no coordinate.
    """
    q, keep = mechanism.q, texts(keep, "The coordinates to keep")
    for name in keep:
        if name not in q.names:
            raise unknown(name, q.names, "coordinate")
    if not program.residuals or mechanism.left_out:
        return mechanism
    choices = program.weights | program.toward
    asked = [*program.residuals.values(), *choices.values(), *mechanism.outputs.values(), *mechanism.reported.values()]
    roots = mechanism.places(*asked).union(*(mechanism.driven(name) for name in choices if name in mechanism.actuators))
    roots |= {place for name, place in _jets(q).items() if name in keep or name in named}
    roots = roots.union(*(mechanism.driven(name) for name in mechanism.actuators if {name, f"d{name}"} & {*named}))
    reached = _reached(roots, mechanism.couplings())
    return mechanism.part(reached) if 0 < len(reached) < q.nq + q.n else mechanism


def _jets(q):
    """The place of each coordinate and derivative by name."""
    names = ((name, "w" if k else "q", i) for k in range(8) for i, name in enumerate(q.jet_names(k)))
    return {name: (kind, i) for name, kind, i in names}


def _reached(roots, couplings):
    """All that is coupled to some places, directly or through others."""
    through, reached, waiting = {}, set(roots), [*roots]
    for coupling in couplings:
        for place in coupling:
            through.setdefault(place, []).append(coupling)
    while waiting:
        for coupling in through.pop(waiting.pop(), ()):
            waiting += coupling - reached
            reached |= coupling
    return reached


def names_of(values):
    """Names of a start, or of values by name; none of anything else."""
    return tuple(values) if isinstance(values, Mapping) else tuple(getattr(values, "names", ()))
