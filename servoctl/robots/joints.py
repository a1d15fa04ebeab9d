"""Coordinates and velocities of a tree's joints, named as in the file."""

import keyword
import re

import casadi as ca

from servoctl.errors import SpecificationError
from servoctl.robots.dynamics import Axis, quaternion_rotation
from servoctl.spec.coordinates import coordinates

ONE_AXIS = ("revolute", "continuous", "prismatic")  # kinds of joints with one position
PLACE = ("x", "y", "z", "qx", "qy", "qz", "qw")  # position and quaternion of a free body
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")  # its velocities in its own axes
ARGUMENTS = ("t", "guess", "hold")  # names that no coordinate has


def axes_of(description, tree):
    """Coordinates of a tree, the axis of each body, and the joints' names in the file by coordinate."""
    free = any(body.motion == "free" for body in tree.bodies)
    taken, places, joints = [], {}, {}
    for body in tree.bodies:
        if body.mimic is None:
            base = identifier(body.joint, taken)
            places[body.joint] = [f"{base}_{part}" for part in PLACE] if body.motion == "free" else [base]
            taken += places[body.joint]
            joints |= dict.fromkeys(places[body.joint], body.joint)
    if not taken:
        raise SpecificationError(
            f"The robot {description.name!r} has no joint that moves.",
            "A mechanism has at least one degree of freedom.",
            do='Release a joint, or pass base="free".',
        )
    q = coordinates(" ".join(taken))
    if free:
        q = _with_twists(q, tree, places)
    rates, accelerations = q.gamma(1), q.gamma(2)
    symbols, axes, row, rows = dict(zip(q.names, q, strict=True)), {}, 0, []
    for body in tree.bodies:
        if body.mimic is None:
            rows = range(row, row + (6 if body.motion == "free" else 1))
            row = rows.stop
            position = ca.vertcat(*(symbols[name] for name in places[body.joint]))
            rate, acceleration = (ca.vertcat(*(jet[i] for i in rows)) for jet in (rates, accelerations))
            axes[body.joint] = Axis(body.motion, position, rate, acceleration, tuple((i, 1.0) for i in rows))
    for body in tree.bodies:
        if body.mimic is not None:
            source, factor, offset = body.mimic
            axis, motion = axes[source], body.motion
            rows = tuple((i, factor * f) for i, f in axis.rows)
            position, rate, acceleration = factor * axis.value + offset, factor * axis.rate, factor * axis.acceleration
            axes[body.joint] = Axis(motion, position, rate, acceleration, rows)
    return q, [axes[body.joint] for body in tree.bodies], joints


def _with_twists(q, tree, places):
    """Coordinates of which free bodies have the velocities of their own axes, and joints their rates."""
    symbols, names, columns, invariants = dict(zip(q.names, q, strict=True)), [], [], {}
    for body in tree.bodies:
        if body.mimic is not None:
            continue
        own = places[body.joint]
        if body.motion != "free":
            names.append(f"{own[0]}_rate")
            columns.append({own[0]: 1.0})
            continue
        base = own[0].removesuffix("_x")
        x, y, z, w = (symbols[name] for name in own[3:])
        names += [f"{base}_{part}" for part in TWIST]
        turned = quaternion_rotation(x, y, z, w)
        columns += [dict(zip(own, e.elements(), strict=False)) for e in ca.horzsplit(turned)]
        rates = ((w, z, -y, -x), (-z, w, x, -y), (y, -x, w, -z))
        columns += [{name: value / 2 for name, value in zip(own[3:], rate, strict=True)} for rate in rates]
        invariants[f"{base}_unit"] = x * x + y * y + z * z + w * w - 1
    V = ca.SX.zeros(q.nq, len(names))
    for j, entries in enumerate(columns):
        for name, value in entries.items():
            V[q.names.index(name), j] = value
    return q.with_quasi_velocities(" ".join(names), V, invariants=invariants)


def identifier(name, taken=()):
    """A name as a Python identifier that neither a coordinate nor a derivative of one has.

    Parameters
    ----------
    name : str
    taken : sequence of str
    """
    plain = re.sub(r"\W", "_", name)
    plain = f"j_{plain}" if not plain.isidentifier() or keyword.iskeyword(plain) or plain in ARGUMENTS else plain
    while plain in taken or any(_derives(a, b) for other in taken for a, b in ((plain, other), (other, plain))):
        plain += "_"
    return plain


def _derives(name, base):
    """Whether a name is that of a derivative of another."""
    return bool(re.fullmatch(rf"d[2-9]?{re.escape(base)}", name))
