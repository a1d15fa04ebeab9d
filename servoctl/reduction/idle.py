"""Coordinates that play no part in a program: nothing couples them to what it prescribes, drives or reports."""

import casadi as ca
import numpy as np

from servoctl.checks import texts
from servoctl.errors import unknown
from servoctl.spec.mechanism import IDENTITY_SEED, RANDOM
from servoctl.tolerances import ENTRY


def needed(mechanism, program, keep=(), named=()):
    """The mechanism without the coordinates that play no part in a program; itself if all do.

    A coordinate plays a part if residuals, actuators, weights, wishes or outputs contain it, if it is named, or if
    terms of the mechanism couple it to one that does. Coordinates without inertia, or with constraints that depend on
    each other, are left to the derivation, which refuses them. `keep` are names of coordinates, NameUnknown is raised
    for others; `named` are signals, such as derivatives of coordinates, that a caller guesses, holds or bounds.
    """
    q, keep = mechanism.q, texts(keep, "The coordinates to keep")
    for name in keep:
        if name not in q.names:
            raise unknown(name, q.names, "coordinate")
    if not program.residuals or mechanism.left_out:
        return mechanism
    chosen = [*program.weights.values(), *program.toward.values()]
    roots = mechanism.places(*program.residuals.values(), *chosen, *mechanism.outputs.values())
    roots = roots.union(*map(mechanism.driven, mechanism.actuators), mechanism.places(*mechanism.reported.values()))
    roots |= {place for name, place in _jets(q).items() if name in keep or name in named}
    every = q.nq + q.n
    reached = roots if len(roots) == every else _reached(roots, mechanism.couplings())
    all_play = not reached or len(reached) == every
    return mechanism.part(reached) if not all_play and _others_are_regular(mechanism, reached) else mechanism


def names_of(values):
    """Names of a start, of the jets of a run, or of values by name; none of anything else."""
    if isinstance(values, dict):
        return tuple(values)
    names = getattr(values, "jet_names", getattr(values, "names", ()))
    return names if isinstance(names, tuple) else ()


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


def _others_are_regular(mechanism, reached):
    """Whether [M Gᵀ; G 0] of the others, with their constraints G, determines accelerations, and M >= 0, at a point."""
    q = mechanism.q
    rows = [i for i in range(q.n) if ("w", i) not in reached]
    constraints = [e for e in mechanism.constraints.values() if not mechanism.places(e) <= reached]
    gradients = [_leading(q, e)[rows] for e in constraints]
    parts = [mechanism.mass[rows, rows], ca.horzcat(ca.SX(len(rows), 0), *gradients)]
    f = q.as_function(parts, mechanism.parameters.symbols)
    rng = np.random.default_rng(IDENTITY_SEED)
    jets = [rng.uniform(*RANDOM, f.size1_in(k)) for k in range(f.n_in() - 1)]
    M, G = (np.array(part).reshape(len(rows), -1) for part in f(*jets, mechanism.parameters.values()))
    K = np.block([[M, G], [G.T, np.zeros((G.shape[1], G.shape[1]))]])
    size = np.sqrt(np.abs(K).max(axis=1))
    if not np.isfinite(K).all() or not size.all():
        return False
    least = np.linalg.eigvalsh(M / np.outer(size, size)[: len(M), : len(M)]).min()
    return bool(least > -ENTRY and np.linalg.matrix_rank(K / np.outer(size, size)) == len(K))


def _leading(q, constraint):
    """∂φ/∂γ^(s) as a column, by the velocities."""
    order = q.order(constraint)
    slopes = ca.jacobian(constraint, q.jet(order))
    return (slopes if order or q.plain else slopes @ q.V).T
