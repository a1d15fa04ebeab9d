"""Curves: points along a scalar expression, the arc or the angle, which a reference or a formula of time drives.

Geometry and timing are separate::

    s = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=6.0)).s      # when: from 0 to 1 in 6 s
    point = sv.curves.circle(2 * ca.pi * s, centre=(0.0, 1.0), radius=0.5)   # where: one turn

Centres, radii and ends may be expressions of parameters.
"""

import casadi as ca
import numpy as np

from servoctl.checks import as_list, column, positive
from servoctl.errors import SpecificationError

ORTHONORMAL = 1e-9  # largest difference of products of a circle's axes from those of orthonormal vectors


def line(s, start, end):
    """Go along a straight line, from `start` at s = 0 to `end` at s = 1; of the class of `s`.

    Parameters
    ----------
    s : SX or float
        A reference or a formula of time, dimensionless; the line goes on for s outside [0, 1].
    start, end : float, SX, or sequence (n,) of them
        The ends.

    Returns
    -------
    SX
        Scalar, or (n, 1) column.

    Raises
    ------
    SpecificationError
        If start and end differ in size or a number is not finite.
    """
    s, start, end = _scalar(s, "s"), _column(start, "start"), _column(end, "end")
    _same_size(start=start, end=end)
    return start + s * (end - start)


def circle(angle, centre, radius, axes=None):
    """Go around a circle: centre + radius (cos(angle) e1 + sin(angle) e2); of the class of `angle`.

    Parameters
    ----------
    angle : SX or float
        A reference or a formula of time [rad].
    centre : sequence (2,) or (3,) of float or SX
        The centre [m].
    radius : float or SX
        The radius [m], positive.
    axes : pair of sequences like `centre`, optional
        Orthonormal e1 (where the angle is zero) and e2 (where it is pi/2) that span the circle's plane; in
        the plane (1, 0) and (0, 1) by default.

    Returns
    -------
    SX
        (2, 1) or (3, 1) column.

    Raises
    ------
    SpecificationError
        If the radius is not positive, the centre has neither 2 nor 3 entries, or 3 without axes, or the axes
        differ from it in size or are not orthonormal.
    """
    angle, radius, centre = _scalar(angle, "angle"), _positive(radius, "radius"), _column(centre, "centre")
    n = centre.numel()
    if n not in (2, 3) or (n == 3 and axes is None):
        raise SpecificationError(
            f"The circle has a centre with {n} entries and {'no' if axes is None else 'two'} axes.",
            "A centre has 2 entries in the plane; in space it has 3, and two axes span the plane of the circle.",
            do="Use a centre with 2 entries, or one with 3 and axes.",
            size=n,
        )
    e1, e2 = _orthonormal(((1, 0), (0, 1)) if axes is None else axes, centre)
    return centre + radius * (ca.cos(angle) * e1 + ca.sin(angle) * e2)


def _column(value, what):
    """An SX column of expressions and finite numbers."""
    items = column(value, what)
    shape = getattr(value, "shape", ())
    if not items or (len(shape) == 2 and 1 not in shape):
        raise SpecificationError(
            f"{what} has the shape {shape or (0,)}.",
            "A point of a curve is a number or a vector with at least one entry.",
            do="Write a number, or a list of coordinates.",
            what=what,
            shape=shape,
        )
    return ca.vertcat(*items)


def _scalar(value, what):
    """An SX scalar: an expression, or a finite number."""
    return column(value, what, 1)[0]


def _positive(value, what):
    """An SX scalar that is an expression, or a number greater than zero."""
    value = _scalar(value, what)
    if value.is_constant():
        positive(what, float(value))
    return value


def _orthonormal(axes, centre):
    """Two orthonormal vectors of the size of `centre`."""
    if not isinstance(axes, (list, tuple, np.ndarray)) or len(as_list(axes) or ()) != 2:
        raise SpecificationError(
            f"The circle's axes are {axes!r}.",
            "A pair of orthonormal vectors spans its plane.",
            do="Write axes=((1, 0, 0), (0, 1, 0)) for the plane z = const.",
            axes=axes,
        )
    e1, e2 = (_column(axis, f"axes[{i}]") for i, axis in enumerate(axes))
    _same_size(centre=centre, **{"axes[0]": e1, "axes[1]": e2})
    gram = ca.vertcat(ca.dot(e1, e1) - 1, ca.dot(e1, e2), ca.dot(e2, e2) - 1)
    if gram.is_constant() and np.abs(np.array(ca.DM(gram))).max() > ORTHONORMAL:
        raise SpecificationError(
            f"The circle's axes are {axes!r}.",
            "Axes are orthonormal.",
            _orthonormalised(e1, e2),
            "Give two unit vectors at a right angle.",
            axes=axes,
        )
    return e1, e2


def _orthonormalised(e1, e2):
    """Text of orthonormal axes of the same plane, by Gram and Schmidt; empty for parallel vectors."""
    a, b = (np.array(ca.DM(e)).ravel() for e in (e1, e2))
    a = a / (np.linalg.norm(a) or 1.0)
    b = b - (a @ b) * a
    if not np.linalg.norm(b) > ORTHONORMAL:
        return ""
    pair = (", ".join(f"{x:.6g}" for x in e) for e in (a, b / np.linalg.norm(b)))
    return "(({}), ({}))".format(*pair)


def _same_size(**columns):
    sizes = {name: c.numel() for name, c in columns.items()}
    if len(set(sizes.values())) > 1:
        raise SpecificationError(
            ", ".join(f"{name} has {n} entries" for name, n in sizes.items()) + ".",
            "They are vectors of the same space, and have the same number of entries.",
            do="Give all of them as many entries.",
            **sizes,
        )
