"""Material constraints of robots: frames that are held, and chains that are closed."""

import casadi as ca
import numpy as np

from servoctl.checks import named, require_kind, texts
from servoctl.errors import SpecificationError
from servoctl.robots.joints import identifier, some_posture, unit_quaternions
from servoctl.robots.robot import Frame, Robot
from servoctl.spec import rotations
from servoctl.spec.mechanism import Constraints

HOLDS = ("position", "pose")
POSTURE_SEED = 20033  # of the postures at which rows are compared
POSTURES = 3
ALONE = 1e-6  # [rad, m] largest difference of postures that are one: nothing moves
FOLLOWS = 1e-5  # part of the largest singular value below which rows of Jacobians depend on others: files with 5 digits


def held(robot: Robot, frames, at) -> dict:
    """Material constraints that hold frames of a robot in the world.

    Parameters
    ----------
    robot : Robot
    frames : sequence of str, or dict of str to str
        Links. A dict says of each what is held, its "position" (three rows) or its "pose" (six); a sequence holds
        poses.
    at : dict of str to float
        The posture in which the frames are where they are held: coordinates by name, the others zero, the quaternion of
        a free base one.

    Returns
    -------
    dict of str to SX
        Rows foot_x, foot_y, foot_z [m] and foot_rx, foot_ry, foot_rz: the vector 2 tan(angle/2) along the axis of the
        rotation from the held orientation [rad], which goes to infinity, not back to zero, at half a turn. Rows that
        follow from the others wherever all hold are left out; starts satisfy them, too. Rows join by |.

    Raises
    ------
    SpecificationError
        If the frames cannot move, or a quaternion has not the length one.
    NameUnknown
        If a link, a coordinate or a kind does not exist.
    """
    require_kind(Robot, "robot", robot, "sv.urdf(file)")
    frames = frames if isinstance(frames, dict) else dict.fromkeys(texts(frames, "The frames"), "pose")
    rows, names = {}, set()
    for link, kind in frames.items():
        named(kind, HOLDS, "kind of constraint")
        names.add(name := identifier(link, names))
        frame, (position, rotation) = robot.frame(link), robot.at(at, link)
        turned = ca.DM(rotation.T) @ frame.rotation
        rows |= _coinciding(name, frame.position - ca.DM(position), turned, kind)
    return _without_followers(rows, robot.q, robot.parameters, robot.posture(at))


def loop(a: Frame, b: Frame, kind="pose", name="loop") -> dict:
    """Material constraints that close a chain: two frames of one robot coincide.

    Parameters
    ----------
    a, b : Frame
    kind : "position" or "pose"
        Whether their origins coincide (three rows), or their axes as well (six).
    name : str
        What the rows' names begin with.

    Returns
    -------
    dict of str to SX
        Rows as those of `held`, in the axes of `a`. Rows that follow from the others wherever all hold, as those
        across the plane of a planar linkage, are left out.

    Raises
    ------
    SpecificationError
        If the frames are of different robots, cannot meet, or cannot move against each other.
    NameUnknown
        If the kind does not exist.
    """
    for key, frame in (("a", a), ("b", b)):
        require_kind(Frame, key, frame, "robot.frame(link)")
    named(kind, HOLDS, "kind of constraint")
    if a.q is not b.q:
        raise SpecificationError(
            f"The frames {a.name!r} and {b.name!r} are of different robots.",
            "A chain is closed in one robot; two robots are one where one file has both.",
            do="Put both into one URDF file.",
            frames=[a.name, b.name],
        )
    rows = _coinciding(identifier(name), a.rotation.T @ (b.position - a.position), a.rotation.T @ b.rotation, kind)
    return _without_followers(rows, a.q, None, None)


def _coinciding(name, offset, rotation, kind):
    rows = {f"{name}_{axis}": offset[i] for i, axis in enumerate("xyz")}
    if kind == "pose":
        turned = rotations.vector(rotation)
        rows |= {f"{name}_r{axis}": turned[i] for i, axis in enumerate("xyz")}
    return rows


def _without_followers(rows, q, parameters, at):
    """The rows without those that depend on rows before them wherever all of them vanish.

    `at` (nq,) is a posture in which all rows vanish, None where none is known. Rows that contradict each other are
    refused, and so are rows of which none changes with the posture.
    """
    symbols = ca.vertcat(*q, *((parameters.symbols) if parameters else ()))
    values = ca.vertcat(*rows.values())
    gradient = ca.jacobian(values, ca.vertcat(*q)) @ q.V
    evaluate = ca.Function("rows", [symbols], [values, ca.densify(gradient), ca.densify(q.V)])
    numbers = np.array(list(parameters.defaults.values()) if parameters else [], float)
    random = np.random.default_rng(POSTURE_SEED)
    places = [np.concatenate([some_posture(q, random), numbers]) for _ in range(POSTURES)]
    starts = places if at is None else [np.concatenate([_near(q, at, place), numbers]) for place in places]
    closed = [place for start in starts if (place := _newton(evaluate, range(len(rows)), start.copy(), q)) is not None]
    kept = _adding([np.array(evaluate(place)[1]) for place in closed])
    if not closed or max(np.abs(place - closed[0]).max() for place in closed) < ALONE:
        kept = _adding([np.array(evaluate(place)[1]) for place in places], kept)
    if len(kept) < len(rows) and not closed and at is None:
        _refuse_contradiction(list(rows), kept, evaluate, places, q)
    if rows and not kept:
        raise SpecificationError(
            f"The rows {', '.join(rows)} have the same values in every posture."[:300],
            "Frames that are held or closed move with the coordinates.",
            do="Name links beyond a joint that moves.",
            rows=list(rows),
        )
    names = [list(rows)[i] for i in kept]
    followers = {name: ca.fmax(ca.fabs(row) - FOLLOWS, 0) for name, row in rows.items() if name not in names}
    return Constraints({name: rows[name] for name in names}, followers)


def _near(q, at, place):
    """A posture a third of the way to another one; quaternions are unit ones."""
    return unit_quaternions(q, at + (place[: q.nq] - at) / 3)


def _adding(jacobians, kept=()):
    """Rows, first ones first, that add to the rank of the rows before them in one of the postures."""
    kept = list(kept)
    for i in range(jacobians[0].shape[0] if jacobians else 0):
        trial = [*kept, i]
        if i not in kept and any(_rank(jacobian[trial]) == len(trial) for jacobian in jacobians):
            kept = trial
    return sorted(kept)


def _rank(matrix):
    return np.linalg.matrix_rank(matrix, FOLLOWS * max(1.0, np.linalg.norm(matrix, 2)))


def _refuse_contradiction(names, kept, evaluate, places, q):
    """Refuse rows left out that do not vanish where the others do."""
    dropped = [i for i in range(len(names)) if i not in kept]
    for place in places:
        closed = _newton(evaluate, kept, place.copy(), q)
        if closed is None:
            continue
        values = np.array(evaluate(closed)[0]).ravel()
        worst = max(dropped, key=lambda i: abs(values[i]))
        if abs(values[worst]) > FOLLOWS:
            raise SpecificationError(
                f"The chain cannot be closed: {names[worst]!r} is {values[worst]:.3g} where the other rows vanish.",
                "The frames coincide in some posture.",
                do="Correct the frames, or cut the chain elsewhere.",
                row=names[worst],
                value=float(values[worst]),
            )
        return


def _newton(evaluate, kept, place, q):
    """A posture in which the rows kept vanish, by Newton's iteration from a posture; None where it finds none."""
    for _ in range(50):  # all of them: at a stretched arm each halves what is left
        values, jacobian, frame = (np.array(part) for part in evaluate(place))
        if not np.isfinite(jacobian).all():
            return None
        step = np.linalg.lstsq(jacobian[kept], -values[kept].ravel(), rcond=None)[0]
        place[: q.nq] += frame @ (step * min(1.0, 0.5 / max(np.abs(step).max(), 1e-300)))
        place[: q.nq] = unit_quaternions(q, place[: q.nq])
    return place if np.abs(values[kept]).max(initial=0.0) < 1e-6 * FOLLOWS else None
