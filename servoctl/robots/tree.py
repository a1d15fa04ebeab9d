"""The tree of moving bodies: links that fixed and locked joints connect are one body, a joint has one axis."""

from dataclasses import field, replace

import numpy as np

from servoctl.checks import named
from servoctl.errors import SpecificationError
from servoctl.robots.description import Inertial, Joint, without_rounding
from servoctl.values import frozen

ONE_AXIS = ("revolute", "continuous", "prismatic")  # kinds of joints with one position


@frozen
class Placement:
    """A frame in the frame of another: rotation (3, 3) and offset (3,) [m], arrays."""

    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __matmul__(self, inner):
        """The placement of a frame that is placed in this one."""
        return Placement(without_rounding(self.rotation @ inner.rotation), self.offset + self.rotation @ inner.offset)


@frozen
class Body:
    """A moving body: its parent (a position in the tree, or None for the ground), its joint, and its inertia.

    Its frame has the joint's axis as z, in which it turns ("turn") or slides ("slide"), or is free ("free"). A planar
    joint has three bodies, a free base no joint. Coordinates are named by `label`.
    """

    name: str
    label: str
    joint: Joint | None
    motion: str
    parent: int | None
    placement: Placement
    inertial: Inertial = field(default_factory=Inertial)

    @property
    def mimic(self):
        """The joint that moves it, multiplier and offset; None where it moves by itself."""
        return self.joint.mimic if self.joint else None


@frozen
class Tree:
    """Bodies, parents first, and the place of each link: (body or None, placement)."""

    bodies: tuple[Body, ...]
    places: dict[str, tuple[int | None, Placement]]


def tree(description, base, lock, inertials):
    """The tree of bodies of a description.

    `base` is "fixed" or "free", `lock` has the positions of joints that are held fixed [rad or m], and `inertials`
    those of the links, some with symbols. Links without a root, with several, or in a loop are refused.
    """
    bodies, places = [], {}
    root = _root_link(description)
    if base == "free":
        bodies.append(Body(root, "base", None, "free", None, Placement()))
    children = {}
    for joint in description.joints.values():
        children.setdefault(joint.parent, []).append(joint)
    waiting = [(root, None, 0 if base == "free" else None, Placement())]
    while waiting:
        link, joint, body, placement = waiting.pop()
        if joint is not None:
            body, placement = _beyond(joint, body, placement, lock, bodies)
        places[link] = body, placement
        if body is not None:
            moved = inertials[link].moved(placement.rotation, placement.offset)
            bodies[body] = replace(bodies[body], inertial=bodies[body].inertial + moved)
        waiting += [(joint.child, joint, body, placement) for joint in reversed(children.get(link, []))]
    if lost := [link for link in description.links if link not in places]:
        raise SpecificationError(
            f"The links {', '.join(lost[:5])} hang on a loop of joints, not on the root {root!r}.",
            "The joints of a URDF file form a tree.",
            do="Remove a joint of the loop.",
            links=lost,
        )
    return Tree(tuple(bodies), places)


def with_followers(description, lock):
    """The description in which joints mimic joints that move, and the locked joints with those that follow them.

    `lock` has positions by joint [rad or m]. Refused: a lock of a joint that does not exist, is fixed or has several
    positions, and joints that mimic each other, or one that has several positions.
    """
    for name in lock:
        named(name, description.joints, "joint")
        if description.joints[name].kind not in ONE_AXIS:
            raise SpecificationError(
                f"The {description.joints[name].kind} joint {name!r} is locked at {lock[name]:g}.",
                f"Joints with one position can be locked: {', '.join(ONE_AXIS)}.",
                do='Leave it out of lock, or place its link by type="fixed" and <origin> in the file.',
                joint=name,
            )
    joints, locked = dict(description.joints), dict(lock)
    for name, joint in description.joints.items():
        if joint.mimic is None or name in lock:
            continue
        source, factor, offset, chain = *joint.mimic, [name]
        while source not in lock and (mimic := description.joints[source].mimic) is not None and source not in chain:
            chain.append(source)
            source, factor, offset = mimic[0], factor * mimic[1], offset + factor * mimic[2]
        kind = description.joints[source].kind
        if source in chain or kind in ("floating", "planar"):
            raise SpecificationError(
                f"The joint {name!r} mimics {'itself' if source in chain else f'the {kind} joint {source!r}'}.",
                "A joint mimics another one that has one position.",
                do="Remove the <mimic> of one of them.",
                joint=name,
                chain=chain,
            )
        joints[name] = replace(joint, mimic=(source, factor, offset))
        if source in lock or kind == "fixed":
            locked[name] = offset + factor * lock.get(source, 0.0)
    return replace(description, joints=joints), locked


def _root_link(description):
    """The one link that is no joint's child."""
    parents = {}
    for joint in description.joints.values():
        if joint.child in parents:
            raise SpecificationError(
                f"The link {joint.child!r} is the child of the joints {parents[joint.child]!r} and {joint.name!r}.",
                "The joints of a URDF file form a tree; sv.loop closes chains.",
                do="Remove one of the joints, and pass constraints=sv.loop(frame, frame) to the mechanism.",
                link=joint.child,
            )
        parents[joint.child] = joint.name
    roots = [link for link in description.links if link not in parents]
    if len(roots) != 1:
        raise SpecificationError(
            f"The links {', '.join(roots)} are children of no joint." if roots else "Every link is a joint's child.",
            "One link is the root of the tree.",
            do="Connect them by fixed joints." if roots else "Remove a joint of the loop.",
            roots=roots,
        )
    return roots[0]


def _beyond(joint, body, placement, lock, bodies):
    """Body and placement of the link beyond a joint; bodies of the joint are appended to `bodies`."""
    placement = placement @ Placement(joint.rotation, joint.offset)
    if joint.kind == "fixed" or joint.name in lock:
        return body, placement @ _fixed_at(joint, lock.get(joint.name, 0.0))
    if joint.kind == "floating":
        bodies.append(Body(joint.child, joint.name, joint, "free", body, placement))
        return len(bodies) - 1, Placement()
    frame = _with_axis_z(joint.axis)
    if joint.kind != "planar":
        motion = "slide" if joint.kind == "prismatic" else "turn"
        bodies.append(Body(joint.child, joint.name, joint, motion, body, placement @ Placement(frame)))
        return len(bodies) - 1, Placement(frame.T)
    placement = placement @ Placement(frame)
    for name, motion in (("x", "slide"), ("y", "slide"), ("angle", "turn")):
        placement = placement @ Placement(CYCLE)
        bodies.append(Body(joint.child, f"{joint.name}_{name}", joint, motion, body, placement))
        body, placement = len(bodies) - 1, Placement()
    return body, Placement(frame.T)


CYCLE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # its axes z, x, y are the x, y, z of the parent


def _fixed_at(joint, position):
    """The placement of a joint's child at a position."""
    if joint.kind == "fixed":
        return Placement()
    if joint.kind == "prismatic":
        return Placement(offset=position * joint.axis)
    frame = _with_axis_z(joint.axis)
    c, s = np.cos(position), np.sin(position)
    return Placement(without_rounding(frame @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ frame.T))


def _with_axis_z(axis):
    """A rotation whose third column is the axis; a permutation with signs where the axis is one of x, y, z."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    x = other - np.dot(other, axis) * axis
    x /= np.linalg.norm(x)
    return without_rounding(np.column_stack([x, np.cross(axis, x), axis]))
