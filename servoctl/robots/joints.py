"""Coordinates and velocities of a tree's joints, named as in the file."""

import keyword
import re
import unicodedata

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError
from servoctl.robots.dynamics import Axis, quaternion_rotation
from servoctl.spec.coordinates import coordinates
from servoctl.units import rate_unit

PLACE = ("x", "y", "z", "qx", "qy", "qz", "qw")  # position and quaternion of a free body
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")  # its velocities in its own axes
ARGUMENTS = ("t", "guess", "hold")  # names that no coordinate has
UNITS = {"turn": ["rad"], "slide": ["m"], "free": ["m"] * 3 + ["1"] * 4}  # of coordinates by motion


def axes_of(description, tree, taken):
    """Coordinates of a tree, the axis of each body, and the joints of the file by coordinate.

    No coordinate gets a name that is in `taken`.
    """
    free, taken = any(body.motion == "free" for body in tree.bodies), set(taken)
    places, joints, sources = {}, {}, {}
    for i, body in enumerate(tree.bodies):
        if body.mimic is None:
            base = identifier(body.label, taken, lambda name, body=body: _names_of(name, body, free))
            taken |= set(_names_of(base, body, free))
            places[i] = [f"{base}_{part}" for part in PLACE] if body.motion == "free" else [base]
            if body.joint is not None:
                joints |= dict.fromkeys(places[i], body.joint)
                sources[body.joint.name] = i
    if not places:
        raise SpecificationError(
            f"The robot {description.name!r} has no joint that moves.",
            "A mechanism has at least one degree of freedom.",
            do='Release a joint, or pass base="free".',
        )
    units = (unit for i in places for unit in UNITS[tree.bodies[i].motion])
    q = coordinates(" ".join(name for names in places.values() for name in names), " ".join(units))
    if free:
        q = _with_twists(q, tree, places)
    rates, accelerations = q.gamma(1), q.gamma(2)
    symbols, axes, row = dict(zip(q.names, q, strict=True)), {}, 0
    for i, body in enumerate(tree.bodies):
        if body.mimic is None:
            rows = range(row, row + (6 if body.motion == "free" else 1))
            row = rows.stop
            position = ca.vertcat(*(symbols[name] for name in places[i]))
            rate, acceleration = (ca.vertcat(*(jet[k] for k in rows)) for jet in (rates, accelerations))
            axes[i] = Axis(body.motion, position, rate, acceleration, tuple((k, 1.0) for k in rows))
    for i, body in enumerate(tree.bodies):
        if body.mimic is not None:
            source, factor, offset = body.mimic
            axis, motion = axes[sources[source]], body.motion
            rows = tuple((k, factor * f) for k, f in axis.rows)
            position, rate, acceleration = factor * axis.value + offset, factor * axis.rate, factor * axis.acceleration
            axes[i] = Axis(motion, position, rate, acceleration, rows)
    return q, [axes[i] for i in range(len(axes))], joints


def _names_of(base, body, free):
    """Names of the coordinates, velocities and actuator of a body."""
    if body.motion == "free":
        return [f"{base}_{part}" for part in (*PLACE, *TWIST, "unit")]
    return [base, actuator(base, body.joint), *((f"{base}_rate",) if free else ())]


def actuator(name, joint):
    """The name of the actuator of a joint, by its coordinate."""
    return f"{'force' if joint.kind == 'prismatic' else 'torque'}_{name}"


def some_posture(q, random):
    """A random posture, (nq,); quaternions of free bodies are unit ones."""
    return unit_quaternions(q, random.uniform(-1.0, 1.0, q.nq))


def unit_quaternions(q, posture):
    """A posture (nq,) whose quaternions of free bodies have length one."""
    for e in (list(places) for places, _ in q.spheres):
        posture[e] /= np.linalg.norm(posture[e])
    return posture


def _with_twists(q, tree, places):
    """Coordinates of which free bodies have the velocities of their own axes, and joints their rates."""
    symbols, names, units, columns, invariants = dict(zip(q.names, q, strict=True)), [], [], [], {}
    for i, own in places.items():
        body = tree.bodies[i]
        if body.motion != "free":
            names.append(f"{own[0]}_rate")
            columns.append({own[0]: 1.0})
            units.append(rate_unit(q.units[own[0]]))
            continue
        base = own[0].removesuffix("_x")
        x, y, z, w = (symbols[name] for name in own[3:])
        names += [f"{base}_{part}" for part in TWIST]
        units += ["m/s"] * 3 + ["rad/s"] * 3
        turned = quaternion_rotation(x, y, z, w)
        columns += [dict(zip(own, e.elements(), strict=False)) for e in ca.horzsplit(turned)]
        rates = ((w, z, -y, -x), (-z, w, x, -y), (y, -x, w, -z))
        columns += [{name: value / 2 for name, value in zip(own[3:], rate, strict=True)} for rate in rates]
        invariants[f"{base}_unit"] = x * x + y * y + z * z + w * w - 1
    V = ca.SX.zeros(q.nq, len(names))
    for j, entries in enumerate(columns):
        for name, value in entries.items():
            V[q.names.index(name), j] = value
    moved = q.with_quasi_velocities(" ".join(names), V, invariants=invariants)
    moved.units = q.units | dict(zip(names, units, strict=True))
    moved.identity = {f"{name.removesuffix('_unit')}_qw": 1.0 for name in invariants}
    return moved


def identifier(name, taken=(), names_of=lambda name: (name,)):
    """A name as a Python identifier that neither a coordinate nor a derivative of one has.

    Neither it nor a name that comes with it, which `names_of` gives, is in `taken`, or a derivative of such a name.
    """
    plain = re.sub(r"\W", "_", unicodedata.normalize("NFKC", name))
    plain = f"j_{plain}" if not plain.isidentifier() or keyword.iskeyword(plain) or plain in ARGUMENTS else plain
    while any(_clashes(own, taken) for own in names_of(plain)):
        plain += "_"
    return plain


def _clashes(name, taken):
    """Whether a name is taken, or that of a derivative of a taken one, or one of its derivatives is."""
    bases = re.fullmatch(r"d([2-9]?)(.+)", name)
    related = {name, *(f"d{k}{name}" for k in ("", *range(2, 10)))}
    related |= {bases[2], bases[1] + bases[2]} if bases else set()
    return not related.isdisjoint(taken)
