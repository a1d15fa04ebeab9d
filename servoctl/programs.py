"""Programs as people say them: residuals by name, in dicts that join with |, for `Program` and constraints.

Each function takes the name that its residuals begin with. What is desired may be a number or an expression of time, of
parameters, or of the coordinates::

    tool = robot.frame("tool")
    program = sv.Program(pose("tool", tool, path, turn) | {"elbow": robot.q["joint_3"] - 0.2})

A norm is compared by the half difference of squares over the desired value, (|v|^2 - c^2)/(2 c), which is |v| - c to
first order and has derivatives of every order.
"""

import casadi as ca

from servoctl.checks import column, mapping, named, positive, require_kind, text
from servoctl.errors import SpecificationError
from servoctl.robots.robot import Frame
from servoctl.spec import rotations
from servoctl.spec.coordinates import Coordinates
from servoctl.spec.mechanism import Mechanism, inverse_directions
from servoctl.spec.references import is_path


def follow_point(name, position, target):
    """A point goes where it is told: position - target, of order 0.

    Parameters
    ----------
    name : str
    position : SX scalar, column or sequence, one to three entries
        The point [m], a function of the coordinates.
    target : float, SX or sequence of as many
        Where it is [m]: an expression of references, as those of `servoctl.curves`, of time or of other points.

    Returns
    -------
    dict of str to SX
        name_x, name_y, name_z [m].

    Raises
    ------
    SpecificationError
        If the sizes differ.
    """
    position, target = _vector(position, f"the position of {name!r}"), _vector(target, f"the target of {name!r}")
    _require_equal(name, position, target)
    return _entries(name, position - target)


def follow_path(name, position, curve, along):
    """A point stays on a curve: as a reference says, or freely, with the curve's parameter as a further coordinate.

    Parameters
    ----------
    name : str
    position : SX column or sequence
        The point [m].
    curve : callable
        Points [m] as a function of a parameter: `lambda s: sv.curves.circle(s, (0, 1), 0.5)`.
    along : SX
        The parameter: a reference, or the symbol of a coordinate that only says how far the point is; the point is then
        free along the curve.

    Returns
    -------
    dict of str to SX
        name_x, name_y, name_z [m].
    """
    if is_path(curve) or not callable(curve):
        raise SpecificationError(
            f"The curve of {name!r} is a {type(curve).__name__}.",
            "It is a function of a parameter, which returns points.",
            do="Write lambda s: sv.curves.line(s, start, end); for references X, Z, use follow_point.",
            name=name,
        )
    return follow_point(name, position, curve(_scalar(along, f"the parameter of {name!r}")))


def pose(name, frame, position, rotation):
    """A frame is where a position and a rotation are: three residuals each, of order 0.

    Parameters
    ----------
    name : str
    frame : Frame, or pair of a position (3,) and a rotation (3, 3)
        The frame that moves.
    position : (3,) SX or sequence
        Its desired origin [m].
    rotation : (3, 3) SX or array
        Its desired rotation from its axes to the world's, as from `rotations.turn` or `rotations.slerp`.

    Returns
    -------
    dict of str to SX
        name_x, name_y, name_z [m] and name_rx, name_ry, name_rz [rad], as those of `orientation`.
    """
    place, turn = _frame(frame)
    return follow_point(name, place, position) | orientation(name, turn, rotation)


def orientation(name, frame, rotation):
    """A frame has an orientation: the vector 2 tan(angle/2) along the axis of the rotation between them, of order 0.

    It goes to infinity at half a turn, where half the difference of the matrices would vanish as at none.

    Parameters
    ----------
    name : str
    frame : Frame, or (3, 3) SX
        The frame that moves, or its rotation.
    rotation : (3, 3) SX or array
        The desired rotation.

    Returns
    -------
    dict of str to SX
        name_rx, name_ry, name_rz [rad], in the desired axes.
    """
    turn = frame.rotation if isinstance(frame, Frame) else frame
    desired, turn = (rotations.as_rotation(value, f"a rotation of {name!r}") for value in (rotation, turn))
    difference = rotations.vector(desired.T @ turn)
    return {f"{name}_r{axis}": difference[i] for i, axis in enumerate("xyz")}


def distance(name, a, b, value):
    """Two points are a distance apart, of order 0; zero distance is `follow_point`.

    Parameters
    ----------
    name : str
    a, b : SX column or sequence, one to three entries
        The points [m].
    value : float or SX
        The distance [m], positive.

    Returns
    -------
    dict of str to SX
        One residual [m].
    """
    a, b = _vector(a, f"the first point of {name!r}"), _vector(b, f"the second point of {name!r}")
    _require_equal(name, a, b)
    return {name: _norm(name, a - b, value, "a distance")}


def constant_speed(name, q, position, value):
    """A point has a speed, of order 1.

    Parameters
    ----------
    name : str
    q : Coordinates
    position : SX column or sequence
        The point [m].
    value : float or SX
        The speed [m/s], positive.

    Returns
    -------
    dict of str to SX
        One residual [m/s].
    """
    return {name: _norm(name, _rate_of(name, q, position, 1), value, "a speed")}


def acceleration_norm(name, q, position, value):
    """The acceleration of a point has a magnitude, of order 2.

    Parameters
    ----------
    name : str
    q : Coordinates
    position : SX column or sequence
        The point [m].
    value : float or SX
        The magnitude [m/s^2], positive.

    Returns
    -------
    dict of str to SX
        One residual [m/s^2].
    """
    return {name: _norm(name, _rate_of(name, q, position, 2), value, "the magnitude of an acceleration")}


def jerk_norm(name, q, position, value):
    """The jerk of a point, the rate of its acceleration, has a magnitude, of order 3.

    Parameters
    ----------
    name : str
    q : Coordinates
    position : SX column or sequence
        The point [m].
    value : float or SX
        The magnitude [m/s^3], positive.

    Returns
    -------
    dict of str to SX
        One residual [m/s^3].
    """
    return {name: _norm(name, _rate_of(name, q, position, 3), value, "the magnitude of a jerk")}


def curvature(name, q, position, value):
    """The path of a point in the plane has a curvature, of order 2; positive turns from x to y.

    Parameters
    ----------
    name : str
    q : Coordinates
    position : (2,) SX or sequence
        The point [m].
    value : float or SX
        The curvature [1/m].

    Returns
    -------
    dict of str to SX
        One residual [1/m], without a value at rest: (x' y'' - y' x'')/|v|^3 - curvature.
    """
    return {name: _curvature(name, q, position) - _scalar(value, f"the curvature of {name!r}")}


def curvature_rate(name, q, position, value):
    """The curvature of a point's path in the plane changes at a rate, of order 3.

    Parameters
    ----------
    name : str
    q : Coordinates
    position : (2,) SX or sequence
        The point [m].
    value : float or SX
        Time derivative of the curvature [1/(m s)].

    Returns
    -------
    dict of str to SX
        One residual [1/(m s)].
    """
    return {name: q.dt(_curvature(name, q, position)) - _scalar(value, f"the rate of {name!r}")}


def perpendicular_velocities(name, q, a, b):
    """The velocities of two points are perpendicular, of order 1.

    Parameters
    ----------
    name : str
    q : Coordinates
    a, b : SX column or sequence
        The points [m].

    Returns
    -------
    dict of str to SX
        One residual, the cosine of the angle between them, without a value where one rests.
    """
    first, second = _rate_of(name, q, a, 1), _rate_of(name, q, b, 1)
    _require_equal(name, first, second)
    return {name: ca.dot(first, second) / ca.sqrt(ca.sumsqr(first) * ca.sumsqr(second))}


def energy(name, mechanism, value):
    """The energy of a mechanism, kinetic and potential, has a value, of order 1.

    Parameters
    ----------
    name : str
    mechanism : Mechanism
    value : float or SX
        [J]

    Returns
    -------
    dict of str to SX
        One residual [J].
    """
    require_kind(Mechanism, "mechanism", mechanism, "sv.Mechanism(q, gibbs, ...)")
    return {name: mechanism.energy - _scalar(value, f"the energy of {name!r}")}


def momentum(name, mechanism, coordinate, value):
    """The generalised momentum of a coordinate, (M w)_i, has a value: a virtual nonholonomic constraint, of order 1.

    Parameters
    ----------
    name : str
    mechanism : Mechanism
    coordinate : str
        The coordinate, or the quasi-velocity.
    value : float or SX
        [kg m/s or kg m^2/s]; an expression of the coordinates makes the constraint virtual and nonholonomic.

    Returns
    -------
    dict of str to SX
        One residual [kg m/s or kg m^2/s].
    """
    require_kind(Mechanism, "mechanism", mechanism, "sv.Mechanism(q, gibbs, ...)")
    q = mechanism.q
    names = q.force_names
    named(coordinate, names, "coordinate" if q.plain else "quasi-velocity")
    momenta = mechanism.mass @ ca.vertcat(*q.gamma(1))
    return {name: momenta[names.index(coordinate)] - _scalar(value, f"the momentum of {name!r}")}


def formation(name, leader, followers, offsets):
    """Points keep their places relative to a leader, of order 0.

    Parameters
    ----------
    name : str
    leader : SX column or sequence
        The leading point [m].
    followers : dict of str to SX column or sequence
        The other points [m].
    offsets : dict of str to sequence
        The place of each, relative to the leader [m]: numbers, or expressions that turn with it.

    Returns
    -------
    dict of str to SX
        name_follower_x, ... [m].

    Raises
    ------
    NameUnknown
        If an offset names no follower.
    """
    leader, followers = _vector(leader, f"the leader of {name!r}"), mapping(followers, "The followers")
    for follower in mapping(offsets, "The offsets"):
        named(follower, list(followers), "follower")
    if missing := [follower for follower in followers if follower not in offsets]:
        raise SpecificationError(
            f"The followers {', '.join(missing)} of {name!r} have no offset.",
            "Each follower has a place relative to the leader.",
            do="Give offsets={...} for all.",
            missing=missing,
        )
    rows = {}
    for follower, point in followers.items():
        rows |= follow_point(f"{name}_{follower}", point, leader + _vector(offsets[follower], f"offset {follower!r}"))
    return rows


def wish(mechanism, accelerations=None):
    """Inputs under which the mechanism alone would have given accelerations: `toward` of a redundant `Program`.

    With `weights="inertia"` the accelerations of the motion are those nearest to them, in the metric of the inertia,
    with which the program holds: zero ones give the least accelerations, others a self-motion.

    Parameters
    ----------
    mechanism : Mechanism
        Each velocity has an actuator, along a constant direction.
    accelerations : dict of str to float or SX, optional
        By coordinate, or quasi-velocity; expressions of t, the coordinates and velocities. Default 0 each.

    Returns
    -------
    dict of str to SX
        By actuator [N or N m].

    Raises
    ------
    SpecificationError
        If a velocity has no actuator.
    NameUnknown
        If an acceleration names no coordinate.
    """
    require_kind(Mechanism, "mechanism", mechanism, "robot.mechanism()")
    q = mechanism.q
    names = q.force_names
    inverse = inverse_directions(mechanism.E)
    if inverse is None:
        raise SpecificationError(
            f"The mechanism has {len(mechanism.actuators)} actuators for {q.n} velocities.",
            "Inputs for given accelerations exist where each velocity has an actuator, along a constant direction.",
            do="Write the wish by actuator yourself.",
            actuators=list(mechanism.actuators),
        )
    wanted = dict.fromkeys(names, ca.SX(0))
    for name, value in mapping(accelerations, "The accelerations").items():
        named(name, names, "coordinate" if q.plain else "quasi-velocity")
        wanted[name] = _scalar(value, f"the acceleration of {name!r}")
    balance = ca.substitute(mechanism.balance, q.jet(2), ca.vertcat(*wanted.values()))
    forces = ca.cse(inverse @ balance)
    return dict(zip(mechanism.actuators, forces.elements(), strict=True))


def posture(mechanism, at, rate):
    """A wish that draws a redundant machine to a posture and damps its self-motion, critically.

    Parameters
    ----------
    mechanism : Mechanism
    at : dict of str to float or SX
        Wished coordinates [rad or m]; those not named are damped alone.
    rate : float
        Decay rate [1/s], positive: accelerations -rate^2 (q - at) - 2 rate q'.

    Returns
    -------
    dict of str to SX
        By actuator, for `Program(..., weights="inertia", toward=...)`.

    Raises
    ------
    NameUnknown
        If the posture names no coordinate.
    """
    require_kind(Mechanism, "mechanism", mechanism, "robot.mechanism()")
    q, rate = mechanism.q, positive("rate", rate)
    if not q.plain:
        raise SpecificationError(
            "The mechanism has quasi-velocities.",
            "A posture is a wish for coordinates whose rates are the velocities.",
            do="Give accelerations to sv.programs.wish.",
        )
    drawn = {name: -2.0 * rate * w for name, w in zip(q.names, q.gamma(1), strict=True)}
    for name, value in mapping(at, "The posture").items():
        named(name, q.names, "coordinate")
        drawn[name] -= rate**2 * (q[name] - _scalar(value, f"the wish of {name!r}"))
    return wish(mechanism, drawn)


def _frame(frame):
    """Position and rotation of a frame, or of a pair."""
    if isinstance(frame, tuple) and len(frame) == 2:
        return frame
    frame = require_kind(Frame, "The frame", frame, "robot.frame(link), or write (position, rotation)")
    return frame.position, frame.rotation


def _vector(value, what):
    return ca.vertcat(*column(value, what, 1, 2, 3))


def _scalar(value, what):
    return column(value, what, 1)[0]


def _rate_of(name, q, position, k):
    """The k-th derivative of a point."""
    require_kind(Coordinates, "q", q, 'sv.coordinates("x y")')
    return q.dt(_vector(position, f"the position of {name!r}"), k)


def _norm(name, vector, value, what):
    """(|v|^2 - c^2)/(2 c)."""
    value = _scalar(value, f"the value of {name!r}")
    if value.is_constant():  # at zero the gradient of a norm has no direction
        positive(f"{what} of {name!r}", float(value))
    return (ca.dot(vector, vector) - value**2) / (2 * value)


def _curvature(name, q, position):
    """The curvature of the path of a point, which has a sign in the plane alone."""
    x, y = column(position, f"the position of {name!r}", 2)
    v, a = (_rate_of(name, q, (x, y), k) for k in (1, 2))
    return (v[0] * a[1] - v[1] * a[0]) / ca.dot(v, v) ** 1.5


def _require_equal(name, a, b):
    if a.numel() != b.numel():
        raise SpecificationError(
            f"{name!r} compares {a.numel()} entries with {b.numel()}.", "Both have as many.", name=name
        )


def _entries(name, vector):
    """Entries of a vector by name: the name itself for one, with _x, _y, _z for more."""
    if vector.numel() == 1:
        return {text("name", name): vector[0]}
    return {f"{text('name', name)}_{axis}": vector[i] for i, axis in zip(range(vector.numel()), "xyz", strict=False)}
