"""Shapes by which figures show a mechanism: lines between points that move with it.

A shape is a sequence of points, each a column or sequence (x, y) or (x, y, z) [m] of expressions of t, q and the
parameters. x points to the right, the last axis up. One point is drawn as a dot, several as a line, and a line that
ends where it began as a body. `box`, `disc` and `spring` make such sequences::

    shapes={"rail": [(-1, 0), (6, 0)], "trolley": sv.shapes.box((x, 0), 0.6, 0.2), "rope": [(x, 0), (X, -Z)]}
"""

from functools import lru_cache

import casadi as ca
import numpy as np

from servoctl.checks import as_list, column, mapping
from servoctl.errors import SpecificationError
from servoctl.spec.references import Jets
from servoctl.values import Identity, evenly

__all__ = ["box", "disc", "spring"]

CORNERS = 24  # of a disc
EARLY, LATE = 0.15, 0.85  # parts of a spring between which it has coils
INSTANTS = 9  # of a motion, at which the direction of gravity is examined
SIDEWAYS = 1e-6  # part of gravity along other axes below which an axis is vertical


def box(centre, width, height, angle=0.0):
    """A rectangle.

    Parameters
    ----------
    centre : (2,) SX or sequence
        [m]
    width, height : SX or float
        [m]
    angle : SX or float
        From the horizontal to its width [rad], counterclockwise.

    Returns
    -------
    list of (2,) SX
    """
    across = ca.vertcat(ca.cos(angle), ca.sin(angle)) * width / 2
    up = ca.vertcat(-ca.sin(angle), ca.cos(angle)) * height / 2
    return [_point(centre) + a * across + b * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]


def disc(centre, radius, angle=None, plane=None):
    """A disc, with a spoke that shows its rotation if an angle is given.

    Parameters
    ----------
    centre : (2,) or (3,) SX or sequence
        [m]
    radius : SX or float
        [m]
    angle : SX or float, optional
        Of the spoke, from the first towards the second direction of the plane [rad].
    plane : pair of columns, optional
        Orthogonal unit vectors; default: those of the plane, to the right and up.

    Returns
    -------
    list of (2,) or (3,) SX
    """
    first, second = ((1, 0), (0, 1)) if plane is None else plane
    first, second, centre = _point(first), _point(second), _point(centre)
    turned = 0.0 if angle is None else angle
    angles = [turned + 2 * ca.pi * i / CORNERS for i in range(CORNERS)]
    rim = [centre + radius * (ca.cos(a) * first + ca.sin(a) * second) for a in angles]
    return [*rim, rim[0]] if angle is None else [centre, *rim, rim[0], centre]


def spring(start, end, width, coils=6):
    """A zigzag between two points of the plane.

    Parameters
    ----------
    start, end : (2,) SX or sequence
        [m]
    width : float
        [m]
    coils : int

    Returns
    -------
    list of (2,) SX
    """
    start, end = _point(start), _point(end)
    along = end - start
    aside = width / 2 * ca.vertcat(-along[1], along[0]) / ca.sqrt(ca.sumsqr(along) + width**2 / 1e6)
    parts = np.linspace(EARLY, LATE, 2 * coils + 1)
    middle = [start + s * along + (0, 1, 0, -1)[i % 4] * aside for i, s in enumerate(parts)]
    return [start, *middle, end]


def _point(point):
    return ca.vertcat(*column(point, "A point"))


def as_shapes(shapes, known):
    """Shapes by name as (d, n) SX of n points; `known(expression, what, size)` checks the symbols of an expression."""
    placed, size = {}, (2, 3)
    for name, points in mapping(shapes, "The shapes").items():
        what = f"The shape {name!r}"
        points, entries = as_list(points), []
        if not points:
            raise SpecificationError(
                f"{what} has no points.",
                "A shape is a sequence of points, all (x, y) or all (x, y, z).",
                do='Write "rope": [(x, 0), (X, -Z)].',
                name=name,
            )
        for i, point in enumerate(points, 1):
            entries += column(point, f"{what}, point {i},", *size)
            size = size if len(size) == 1 else (len(entries),)  # of all that follow: they lie in one plane, or in space
        placed[name] = ca.reshape(known(entries, what, len(entries)), *size, -1)
    return placed


def moved(mechanism, t, q, p, paths=None):
    """Points of the shapes by name, (d, n, N) [m], at t (N,) [s], q (nq, N), parameters p (n_p,), along paths by name.

    References without a path among them follow the default ones.
    """
    jets = _jets_along(mechanism, mechanism.shapes.values(), paths, p)
    values = np.array(_points_of(Identity(mechanism))(np.reshape(t, (1, -1)), q, p, jets.at(t)))
    ends = np.cumsum([points.numel() for points in mechanism.shapes.values()])
    rows = np.split(values, ends[:-1])
    return {
        name: part.reshape(points.shape[1], points.shape[0], -1).swapaxes(0, 1)
        for (name, points), part in zip(mechanism.shapes.items(), rows, strict=True)
    }


@lru_cache(32)
def _points_of(identity):
    mechanism = identity.value
    q, p = mechanism.q, ca.vertcat(ca.SX(0, 1), *mechanism.parameters.symbols)
    points = ca.vertcat(*(ca.vec(points) for points in mechanism.shapes.values()))
    jets = Jets(q, mechanism.shapes.values()).symbols
    return ca.Function("shapes", [q.t, ca.vertcat(*q), p, jets], [ca.densify(points)])


def _jets_along(mechanism, expressions, paths, p):
    return Jets(mechanism.q, expressions, mechanism.q.family.paths | (paths or {}), (mechanism.parameters, p))


def heights(mechanism, names, t, q, p, paths=None):
    """For each of some coordinates or outputs: 1 if it measures height, -1 if depth, 0 if neither is certain.

    At rest, the balance of a mechanism under gravity is that of a force along one of them. The instants are t (N,) with
    q (nq, N) and p (n_p,), along paths by name. All are 0 if an output contains derivatives.
    """
    own = dict(zip(mechanism.q.names, mechanism.q, strict=True)) | mechanism.outputs
    if any(mechanism.q.order(own[name]) > 0 for name in names):
        return [0] * len(names)
    chosen = evenly(len(t), INSTANTS)
    system = mechanism.q
    rates = ca.vertcat(*system.gamma(1), *system.gamma(2))
    slopes = ca.jacobian(ca.vertcat(*(own[name] for name in names)), ca.vertcat(*system)) @ system.V
    jets = _jets_along(mechanism, [mechanism.balance, slopes], paths, p)
    parameters = ca.vertcat(ca.SX(0, 1), *mechanism.parameters.symbols)
    symbols = [system.t, ca.vertcat(*system), rates, parameters, jets.symbols]
    p = np.asarray(p)[: len(mechanism.parameters.names)]
    rest = ca.Function("rest", symbols, [ca.densify(mechanism.balance), ca.densify(slopes.T)])
    shares, r = [], jets.at(np.asarray(t))
    for i in chosen:
        weight, directions = (np.array(value) for value in rest(t[i], q[:, i], 0.0, p, r[:, i]))
        if not (np.isfinite(weight).all() and np.isfinite(directions).all()):
            return [0] * len(names)
        shares.append(np.linalg.lstsq(directions, weight[:, 0], rcond=None)[0] * np.linalg.norm(directions, axis=0))
    shares, sizes = np.array(shares), np.abs(shares).max(axis=0)
    others = [np.delete(sizes, i).max(initial=0.0) for i in range(len(names))]
    return [
        int(np.sign(s[0])) if np.all(s * s[0] > 0) and other < SIDEWAYS * np.abs(s).min() else 0
        for s, other in zip(shares.T, others, strict=True)
    ]
