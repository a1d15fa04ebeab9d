"""Rotations: matrices R from a body's axes to the world's, along an expression, and of measured ones a vector each.

An orientation to be programmed is geometry along a scalar reference::

    (s,) = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0))
    rotation = sv.rotations.slerp(s, start, end)

or, through many rotations, three references, the components of vectors about the middle one::

    vectors, middle = sv.rotations.vectors(rotations)
    path = sv.paths.spline(times, vectors, smoothness=3)
    r = q.references(rx=path[0], ry=path[1], rz=path[2])
    rotation = middle @ sv.rotations.from_vector([*r])
"""

import casadi as ca
import numpy as np

from servoctl.checks import array_of, column, matrix
from servoctl.errors import SpecificationError

ORTHONORMAL = 1e-9  # largest difference of RᵀR from the identity
HALF_TURN = 1e-6  # [rad] nearness to half a turn, where the shorter way is not determined


def __getattr__(name):
    raise AttributeError(
        f"sv.rotations has no {name!r}." + " Take sv.paths.spline through sv.rotations.vectors." * (name == "spline")
    )


def turn(angle, axis, start=None):
    """Turn about an axis that is fixed in the world: R = exp(angle [axis]) start.

    Parameters
    ----------
    angle : SX or float
        [rad], of the class of the reference that drives it.
    axis : (3,) sequence of float
        The axis; its length plays no part.
    start : (3, 3) array or SX, optional
        The rotation at angle zero; the identity by default.

    Returns
    -------
    (3, 3) SX

    Raises
    ------
    SpecificationError
        If the axis is zero or the start is no rotation.
    """
    (angle,) = column(angle, "the angle", 1)
    axis = array_of("axis", axis, 3)
    if not axis.any():
        raise SpecificationError("The axis of the turn is zero.", "An axis has a direction.", axis=axis.tolist())
    return _about(axis / np.linalg.norm(axis), angle) @ (ca.SX.eye(3) if start is None else as_rotation(start, "start"))


def slerp(s, start, end):
    """Turn evenly from one rotation to another, by the shorter way: R = start exp(s log(startᵀ end)).

    Parameters
    ----------
    s : SX or float
        0 at the start and 1 at the end, as of a reference; the turn goes on outside.
    start, end : (3, 3) arrays
        The rotations.

    Returns
    -------
    (3, 3) SX

    Raises
    ------
    SpecificationError
        If one is no rotation, or they are half a turn apart, where both ways are as long.
    """
    (s,) = column(s, "s", 1)
    start, end = _matrix_of_numbers(start, "start"), _matrix_of_numbers(end, "end")
    axis, angle = _axis_and_angle(start.T @ end)
    return ca.SX(ca.DM(start)) @ _about(axis, s * angle)


def vectors(rotations):
    """The vectors of rotations about the middle one, of which a path is made, by `paths.spline` or `paths.fit`.

    Parameters
    ----------
    rotations : (n, 3, 3) array

    Returns
    -------
    vectors : (n, 3) array
        Those of `from_vector`: the rotations are middle @ from_vector(vectors[i]).
    middle : (3, 3) DM
        The rotation in the middle of the list.

    Raises
    ------
    SpecificationError
        If there is none, one is no rotation, or is half a turn from the middle one.
    """
    rotations = array_of("rotations", rotations, None, 3, 3)
    rotations = [_matrix_of_numbers(rotation, f"rotations[{i}]") for i, rotation in enumerate(rotations)]
    if not rotations:  # an array of the shape (0, 3, 3)
        raise SpecificationError("No rotation is given.", "A path passes through two at least.")
    middle, found = rotations[len(rotations) // 2], []
    for i, rotation in enumerate(rotations):
        axis, angle = _axis_and_angle(middle.T @ rotation, f"rotations[{i}] and the middle one")
        found.append(2.0 * np.tan(angle / 2.0) * axis)
    return np.array(found), ca.DM(middle)


def from_vector(vector):
    """The rotation of a vector 2 tan(angle/2) along its axis: Rodrigues' parameters, twice.

    Parameters
    ----------
    vector : (3,) SX or sequence

    Returns
    -------
    (3, 3) SX
    """
    vector = ca.vertcat(*column(vector, "the vector", 3))
    cross = ca.skew(vector)
    return ca.SX.eye(3) + (cross + cross @ cross / 2) * (4 / (4 + ca.dot(vector, vector)))


def vector(rotation):
    """The vector 2 tan(angle/2) along the axis of a rotation, which goes to infinity at half a turn.

    Parameters
    ----------
    rotation : (3, 3) SX or array

    Returns
    -------
    (3,) SX
    """
    rotation = as_rotation(rotation, "the rotation")
    skew, power = ca.inv_skew(rotation - rotation.T), (1 + ca.trace(rotation)) / 4
    # With c = cos²(angle/2), skew·skew = 16 c (1 - c). Near half a turn 1 + trace = 4 c is rounding, and 2 skew/4c is
    # zero where the skew part is: there c is skew·skew (1 + c + ... + c^63)/16, and only its rest c^65 by the trace.
    series = ca.dot(skew, skew) / 16
    rest = power
    for _ in range(6):
        series, power = series * (1 + power), power * power
    return skew / (2 * (series + rest * power))


def as_rotation(value, what):
    """A rotation matrix, of which one of numbers is verified.

    Parameters
    ----------
    value : (3, 3) SX or array
    what : str
        What it is, for errors.

    Returns
    -------
    (3, 3) SX

    Raises
    ------
    SpecificationError
        If it has another shape, or numbers that are no rotation.
    """
    value = matrix(value, what, (3, 3))
    if value.is_constant():
        _matrix_of_numbers(np.array(ca.evalf(value)), what)
    return value


def _about(axis, angle):
    """exp(angle [axis]) of a unit vector of numbers."""
    axis, cross = ca.DM(axis), ca.skew(ca.DM(axis))
    return ca.SX.eye(3) + ca.sin(angle) * cross + (1 - ca.cos(angle)) * (cross @ cross)


def _axis_and_angle(rotation, what="start and end"):
    """Axis (3,) and angle [rad] in [0, π) of a rotation of numbers."""
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    angle = float(np.arctan2(np.linalg.norm(skew) / 2.0, (np.trace(rotation) - 1.0) / 2.0))
    if np.pi - angle < HALF_TURN:
        raise SpecificationError(
            f"{what} are half a turn apart.",
            "Both ways are as long, and the axis depends on rounding.",
            do="Add a rotation between them, or use rotations.turn with the axis that you mean.",
            angle=angle,
        )
    return (skew / np.linalg.norm(skew) if skew.any() else np.array([0.0, 0.0, 1.0])), angle


def _matrix_of_numbers(value, what):
    """A rotation of numbers, (3, 3) array."""
    array = array_of(what, value, 3, 3)
    if not np.linalg.det(array) > 0.0 or np.abs(array.T @ array - np.eye(3)).max() > ORTHONORMAL:
        raise SpecificationError(
            f"{what} is no rotation: {array.tolist()}."[:300],
            "A rotation matrix has orthonormal columns and determinant 1.",
            do="Take the nearest one, U Vᵀ of its singular value decomposition, or use rotations.turn.",
            what=what,
        )
    return array
