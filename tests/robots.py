"""Robots for tests: the project's own files, those of example-robot-data where it is installed, and pinocchio's view."""

from importlib.util import find_spec
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import needs

OWN = Path(__file__).parents[1] / "examples" / "robots"
PUBLIC = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "solo12": "solo_description/robots/solo12.urdf",
    "talos": "talos_data/robots/talos_reduced.urdf",
}


def file_of(name):
    """The path of a robot's file; the test is skipped where it needs example-robot-data and this is not installed."""
    if name not in PUBLIC:
        return str(OWN / f"{name}.urdf")
    found = find_spec("cmeel")
    path = found and Path(found.origin).parents[1] / "cmeel.prefix/share/example-robot-data/robots" / PUBLIC[name]
    if path is None or not path.exists():
        pytest.skip("needs example-robot-data, which is in the extra 'test-all'")
    return str(path)


TWIST, PLACE = ("vx", "vy", "vz", "wx", "wy", "wz"), ("x", "y", "z", "qx", "qy", "qz", "qw")


class Pinocchio:
    """A robot in pinocchio, with states given in the names of servoctl."""

    def __init__(self, robot, path, base):
        pinocchio = needs("pinocchio")
        self.pin, self.robot = pinocchio, robot
        free = (pinocchio.JointModelFreeFlyer(),) if base == "free" else ()
        self.model = pinocchio.buildModelFromUrdf(path, *free, mimic=True)
        self.data = self.model.createData()
        q, by_joint = robot.q, {joint: name for name, joint in robot.joints.items()}
        velocities = list(q.names if q.plain else q.velocity_names)
        self.rows = np.zeros(self.model.nv, int)  # of our velocities, in pinocchio's order
        for joint, name in zip(list(self.model.joints)[1:], list(self.model.names)[1:], strict=True):
            if joint.nv == 6:
                self.rows[joint.idx_v : joint.idx_v + 6] = [velocities.index(f"base_{e}") for e in TWIST]
            elif joint.nv:
                own = by_joint[name]
                self.rows[joint.idx_v] = velocities.index(own if q.plain else f"{own}_rate")
        self.by_joint = by_joint

    def configuration(self, values):
        """pinocchio's configuration of ours, (nq,) array."""
        numbers, result = dict(zip(self.robot.q.names, values, strict=True)), self.pin.neutral(self.model)
        for joint, name in zip(list(self.model.joints)[1:], list(self.model.names)[1:], strict=True):
            if joint.nv == 6:
                result[joint.idx_q : joint.idx_q + 7] = [numbers[f"base_{e}"] for e in PLACE]
            elif joint.nv:
                angle = numbers[self.by_joint[name]]
                turns = joint.nq == 2
                result[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(angle), np.sin(angle)] if turns else [angle]
        return result


def random_state(robot, random):
    """Coordinates, velocities and accelerations; the quaternion of a free base is a unit one."""
    q = robot.q
    values = random.uniform(-2.0, 2.0, q.nq)
    if not q.plain:
        place = q.names.index("base_qx")
        values[place : place + 4] /= np.linalg.norm(values[place : place + 4])
    return values, random.normal(size=q.n), random.normal(size=q.n)


def function_of(robot, *expressions):
    """Expressions as a function of coordinates, velocities and accelerations that returns arrays."""
    q = robot.q
    f = ca.Function("f", [ca.vertcat(*q), q.jet(1), q.jet(2)], [ca.densify(ca.SX(e)) for e in expressions])
    return lambda *state: [np.array(value).squeeze() for value in f.call([ca.DM(part) for part in state])]


def bodies(*links, axes=(), mass=1.0, centre="0 0 0", moments=(0.01, 0.01, 0.01), points=None, more="", inside=""):
    """The text of a chain of bodies on revolute joints ja, jb, ..., with massless points fixed to the first one.

    Mass, centre and moments are those of the last body, others have 5 kg; `inside` is text of each joint.
    """
    parts = []
    for i, name in enumerate(links):
        last = i == len(links) - 1
        ixx, iyy, izz = moments if last else (0.05, 0.05, 0.05)
        parts.append(
            f'<link name="{name}"><inertial><origin xyz="{centre if last else "0 0 0"}"/><mass value="{mass if last else 5}"/>'
            f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial></link>'
        )
    for i, axis in enumerate(axes):
        parts.append(
            f'<joint name="j{"abc"[i]}" type="continuous"><parent link="{links[i]}"/><child link="{links[i + 1]}"/>'
            f'<axis xyz="{axis}"/>{inside}</joint>'
        )
    for name, place in (points or {}).items():
        parts.append(
            f'<link name="{name}"/><joint name="to_{name}" type="fixed"><parent link="{links[0]}"/><child link="{name}"/>'
            f'<origin xyz="{place}"/></joint>'
        )
    return f'<robot name="bodies">{"".join(parts)}{more}</robot>'


def two_legs():
    """The text of a trunk on two legs of hip, knee and ankle, whose axes are parallel; soles are welded to feet."""
    body = (
        '<link name="{0}"><inertial><origin xyz="0 0 {1}"/><mass value="{2}"/>'
        '<inertia ixx="{3}" ixy="0" ixz="0" iyy="{3}" iyz="0" izz="{3}"/></inertial></link>'
    )
    joint = (
        '<joint name="{}" type="revolute"><origin xyz="{}"/><parent link="{}"/><child link="{}"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="40" velocity="20"/><dynamics damping="0.05"/></joint>'
    )
    parts = [body.format("trunk", 0.05, 5, 0.06)]
    for leg, x in (("front", 0.15), ("hind", -0.15)):
        above = "trunk"
        for name, link, origin, mass in (
            ("hip", "thigh", f"{x} 0 0", 0.9), ("knee", "shank", "0 0 -0.2", 0.4), ("ankle", "foot", "0 0 -0.2", 0.2),
        ):  # fmt: skip
            parts.append(body.format(f"{leg}_{link}", -0.05, mass, 2e-3))
            parts.append(joint.format(f"{leg}_{name}", origin, above, f"{leg}_{link}"))
            above = f"{leg}_{link}"
    return f'<robot name="two_legs">{"".join(parts)}</robot>'
