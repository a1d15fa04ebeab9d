"""A URDF file, read by expat: links, joints and their numbers; document types, and so entities, are refused."""

import math
from dataclasses import field
from pathlib import Path
from xml.etree.ElementTree import TreeBuilder
from xml.parsers import expat

import casadi as ca
import numpy as np

from servoctl.checks import named, require_kind, within
from servoctl.errors import SpecificationError, unknown
from servoctl.values import frozen

LARGEST_FILE = 20_000_000  # bytes: a hundred times the largest description of a humanoid
NEGLIGIBLE = 1e-12  # entry of a rotation that is rounding: zero, or one if it is that near to one
JOINTS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@frozen
class Inertial:
    """Mass [kg], first moment [kg m] and inertia [kg m^2] about the origin of a frame, in its axes: DM or SX."""

    mass: object = 0.0
    moment: object = field(default_factory=lambda: ca.DM.zeros(3))
    inertia: object = field(default_factory=lambda: ca.DM.zeros(3, 3))

    def __add__(self, other):
        return Inertial(self.mass + other.mass, self.moment + other.moment, self.inertia + other.inertia)

    def moved(self, rotation, offset):
        """The same body seen from a frame in which its own frame has this rotation and offset."""
        if isinstance(rotation, np.ndarray):
            rotation, offset = ca.DM(rotation), ca.DM(offset)
        turned = rotation @ self.moment
        shift = _parallel(offset, turned) + _parallel(turned, offset) + self.mass * _parallel(offset, offset)
        inertia = rotation @ self.inertia @ rotation.T + shift
        return Inertial(self.mass, turned + self.mass * offset, ca.triu2symm(ca.triu(inertia)))


@frozen
class Joint:
    """A joint: child link on parent link, its placement, axis and the numbers of its tags."""

    name: str
    kind: str
    parent: str
    child: str
    rotation: np.ndarray
    offset: np.ndarray
    axis: np.ndarray
    lower: float = -math.inf
    upper: float = math.inf
    effort: float = math.inf
    velocity: float = math.inf
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    mimic: tuple[str, float, float] | None = None  # joint, multiplier, offset


@frozen
class Description:
    """Links by name with their inertia, and joints by name in the order of the file."""

    name: str
    links: dict[str, Inertial]
    joints: dict[str, Joint]


def described(source):
    """The description of a robot from the path of a URDF file, or from its text.

    Refused: a file that is no URDF or is too large, one with a document type, entities or xacro, and numbers that are
    none.
    """
    root = _root_element(*_bytes(source))
    if root.tag != "robot":
        raise SpecificationError(
            f"The root of the document is <{root.tag}>.", "That of a URDF file is <robot>.", tag=root.tag
        )
    links = {name: _inertial(node, name) for name, node in _by_name(root, "link").items()}
    rotors = _rotors(root)
    joints = {name: _joint(node, name, rotors.pop(name, 0.0)) for name, node in _by_name(root, "joint").items()}
    if not links:
        raise SpecificationError("The robot has no link.", "A URDF file has at least one <link name=...>.")
    for rotor in rotors:
        raise unknown(rotor, joints, "joint (as a rotor drives it)")
    for joint in joints.values():
        _require_known(joint, links, joints)
    return Description(root.get("name") or "robot", links, joints)


def rotation_of(roll, pitch, yaw):
    """The rotation matrix of roll, pitch and yaw [rad] about fixed axes, without entries that are rounding."""
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (math.cos, math.sin))
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return without_rounding(rotation)


def without_rounding(rotation):
    """A rotation matrix whose entries within 1e-12 of -1, 0 or 1 are these."""
    whole = np.round(rotation)
    return np.where(np.abs(rotation - whole) < NEGLIGIBLE, whole, rotation)


def _parallel(a, b):
    """(a·b) E - b aᵀ, of which Steiner's rule is made."""
    return ca.dot(a, b) * ca.DM.eye(3) - b @ a.T


def _bytes(source):
    """Bytes of a document and the encoding that overrides its declaration, or None."""
    if isinstance(source, str) and "<" in source:
        return source.encode(errors="surrogatepass"), "utf-8"
    if isinstance(source, bytes):
        return source, None
    path = Path(require_kind((str, Path), "The source of the robot", source, 'Path("robot.urdf")'))
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
        size = max(path.stat().st_size, len(content))
    except (OSError, ValueError) as error:
        raise SpecificationError(
            f"The file {str(source)[:200]!r} cannot be read: {getattr(error, 'strerror', None) or error}.",
            "A robot comes from the path of a URDF file, or from its text.",
            do="Check the path.",
            path=str(source),
        ) from None
    _require_size(size)
    return content, None


def _require_size(size):
    if size > LARGEST_FILE:
        raise SpecificationError(
            f"The document has {size} bytes.",
            f"A robot's description has at most {LARGEST_FILE}.",
            do="Meshes belong in files of their own.",
            size=size,
            limit=LARGEST_FILE,
        )


def _root_element(content, encoding):
    """The root element; document types are refused, so that no entity is expanded or fetched."""
    _require_size(len(content))
    builder, parser = TreeBuilder(), expat.ParserCreate(encoding)
    parser.StartElementHandler = lambda tag, attributes: builder.start(tag, _without_macros(tag, attributes))
    parser.EndElementHandler = builder.end
    parser.StartDoctypeDeclHandler = _refuse_document_type
    try:
        parser.Parse(content.lstrip(), True)
    except SpecificationError:
        raise
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise SpecificationError(
            f"The document is no XML: {error}.",
            "A robot's description is a URDF file: XML with a root <robot>.",
            do="Check the place that the message names.",
        ) from None
    return builder.close()


def _refuse_document_type(name, *_):
    raise SpecificationError(
        f"The document declares a document type {name!r}.",
        "A URDF file needs none, and entities in it can fetch files or grow without bound.",
        do="Remove <!DOCTYPE ...>.",
        doctype=name,
    )


def _without_macros(tag, attributes):
    """The attributes of an element that needs no macro processor."""
    macro = next((f"{k}={v!r}" for k, v in attributes.items() if "${" in v or "$(" in v), None)
    if tag.startswith("xacro:") or macro:
        raise SpecificationError(
            f"The document has {f'the attribute {macro}' if macro else f'the element <{tag}>'}.",
            "It is written for xacro; sv.urdf reads the URDF that xacro makes of it.",
            do="Run xacro robot.urdf.xacro > robot.urdf first.",
            tag=tag,
        )
    return attributes


def _by_name(root, tag):
    """Elements of a kind by name."""
    found = {}
    for node in root.findall(tag):
        name = node.get("name")
        if not name or name in found:
            raise SpecificationError(
                f"Two of <{tag}> are named {name!r}." if name else f"A <{tag}> has no name.",
                f"Each <{tag}> has a name that no other has.",
                do="Rename one of them." if name else f"Write <{tag} name=...>.",
                name=name,
            )
        found[name] = node
    return found


def _rotors(root):
    """Inertia of rotors as their joints feel it: in Drake's tags, rotor_inertia times gear_ratio squared."""
    felt = {}
    for node in root.findall("transmission"):
        what = f"transmission {node.get('name')!r}"
        for joint, motor in zip(node.findall("joint"), node.findall("actuator"), strict=False):
            inertia = _resistance(_one(motor, "drake:rotor_inertia", what), "value", what)
            ratio = _one_number(_one(motor, "drake:gear_ratio", what), "value", what, 1.0)
            felt[joint.get("name")] = felt.get(joint.get("name"), 0.0) + inertia * ratio**2
    return {name: value for name, value in felt.items() if value}


def _one(node, tag, what):
    """The element of a kind within another one, or None."""
    found = node.findall(tag)
    if len(found) > 1:
        raise SpecificationError(
            f"{what} has {len(found)} elements <{tag}>.", "It has one at most.", do="Remove the others.", tag=tag
        )
    return found[0] if found else None


def _inertial(link, name):
    """Inertia of a link about its origin; none where it has no <inertial>."""
    what = f"link {name!r}"
    node = _one(link, "inertial", what)
    if node is None:
        return Inertial()
    rotation, offset = _origin(node, f"the inertial of {what}")
    mass = _one_number(_one(node, "mass", what), "value", f"the <mass> of {what}")
    tag = _one(node, "inertia", what)
    ixx, ixy, ixz, iyy, iyz, izz = (_one_number(tag, key, what, 0.0) for key in MOMENTS)
    inertia = ca.DM([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    return Inertial(within(f"the mass of {what}", mass, least=0.0), ca.DM.zeros(3), inertia).moved(rotation, offset)


def _joint(node, name, armature):
    kind, what = node.get("type"), f"joint {name!r}"
    if kind not in JOINTS:
        raise SpecificationError(
            f"The type of {what} is {kind!r}.",
            f"Types of joints are {', '.join(JOINTS)}.",
            unknown(kind, JOINTS, "type").details["match"] or "",
            do="Build it from joints of these types, with links without mass between them.",
            joint=name,
            type=kind,
        )
    rotation, offset = _origin(node, what)
    limit, dynamics = _one(node, "limit", what), _one(node, "dynamics", what)
    turns = kind in ("continuous", "floating", "planar")
    joint = Joint(
        name,
        kind,
        _link_of(node, "parent", what),
        _link_of(node, "child", what),
        rotation,
        offset,
        np.zeros(3) if kind in ("fixed", "floating") else _axis(node, what),
        lower=-math.inf if turns else _one_number(limit, "lower", what, 0.0 if limit is not None else -math.inf),
        upper=math.inf if turns else _one_number(limit, "upper", what, 0.0 if limit is not None else math.inf),
        effort=_one_number(limit, "effort", what, math.inf),
        velocity=_one_number(limit, "velocity", what, math.inf),
        damping=_resistance(dynamics, "damping", what),
        friction=_resistance(dynamics, "friction", what),
        armature=armature,
        mimic=_mimic(_one(node, "mimic", what), kind, what),
    )
    if joint.lower > joint.upper:
        raise SpecificationError(
            f"The limits of {what} are lower={joint.lower:g}, upper={joint.upper:g}.",
            "The lower one is at most the upper one.",
            f"lower={joint.upper:g}, upper={joint.lower:g}.",
            joint=name,
            limits=[joint.lower, joint.upper],
        )
    return joint


def _link_of(node, tag, what):
    found = _one(node, tag, what)
    if found is None or not found.get("link"):
        raise SpecificationError(f"{what} has no <{tag} link=...>.", "A joint has a parent and a child.", joint=what)
    return found.get("link")


def _mimic(node, kind, what):
    if node is None or kind == "fixed":
        return None
    if kind in ("floating", "planar") or not node.get("joint"):
        raise SpecificationError(
            f"The {kind} {what} mimics {node.get('joint')!r}.",
            "A joint with one position mimics another one, by its name.",
            do="Remove the <mimic>, or write <mimic joint=...>.",
            joint=what,
        )
    return node.get("joint"), _one_number(node, "multiplier", what, 1.0), _one_number(node, "offset", what, 0.0)


def _origin(node, what):
    """Rotation and offset of an element's <origin>; the identity where it has none."""
    origin = _one(node, "origin", what)
    if origin is None:
        return np.eye(3), np.zeros(3)
    angles, offset = (_finite_numbers(origin, key, what, "0 0 0") for key in ("rpy", "xyz"))
    return rotation_of(*angles), np.array(offset)


def _axis(node, what):
    axis = np.array(_finite_numbers(_one(node, "axis", what), "xyz", what, "1 0 0"))
    if not axis.any():
        raise SpecificationError(f"The axis of {what} is 0 0 0.", "An axis has a direction.", joint=what)
    axis = axis / np.abs(axis).max()  # whose square is in the range of numbers
    return without_rounding(axis / np.linalg.norm(axis))


def _resistance(node, key, what):
    return within(f"the {key} of {what}", _one_number(node, key, what, 0.0), least=0.0)


def _one_number(node, key, what, default=None):
    if node is None or node.get(key) is None:
        if default is not None:
            return default
        raise SpecificationError(f"{what} has no {key!r}.", f"It needs one number {key!r}.", what=what, attribute=key)
    return _finite_numbers(node, key, what, count=1)[0]


def _finite_numbers(node, key, what, default="", count=3):
    """The finite numbers of an attribute."""
    text = default if node is None else node.get(key, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    infinite = count == 1 and key in ("lower", "upper", "effort", "velocity")
    if len(values) != count or not all(math.isfinite(v) or infinite and not math.isnan(v) for v in values):
        raise SpecificationError(
            f"The attribute {key}={text!r} of {what} is given.",
            f"It is {'a finite number' if count == 1 else f'{count} finite numbers, separated by blanks'}.",
            what=what,
            attribute=key,
            value=text,
        )
    return values


def _require_known(joint, links, joints):
    """Refuse a joint between links, or like a joint, that are not there."""
    for name in (joint.parent, joint.child):
        named(name, links, f"link (as joint {joint.name!r} needs it)")
    if joint.mimic:
        named(joint.mimic[0], joints, f"joint (as joint {joint.name!r} mimics it)")
