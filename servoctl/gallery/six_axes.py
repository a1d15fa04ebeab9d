"""An arm with six axes and an offset wrist, whose tool follows a line and turns."""

import servoctl as sv

AXES = (  # joint, its place [m], axis; mass [kg], centre [m], inertias [kg m^2]; effort [N m], damping [N m s/rad]
    ("pan", "0 0 0.15", "0 0 1", 6.0, "0 0.02 0.1", (0.04085, 0.04085, 0.0192), 200.0, 0.5),
    ("lift", "0 0.12 0.05", "0 1 0", 9.0, "0 0.01 0.22", (0.1533, 0.1533, 0.0162), 200.0, 0.5),
    ("elbow", "0 -0.1 0.44", "0 1 0", 5.0, "0 -0.01 0.2", (0.0697917, 0.0697917, 0.00625), 150.0, 0.3),
    ("roll", "0 0 0.4", "0 0 1", 1.5, "0 0.03 0", (0.003, 0.002, 0.003), 40.0, 0.1),
    ("bend", "0 0.08 0", "0 1 0", 1.2, "0 0 0.03", (0.002, 0.002, 0.0015), 40.0, 0.1),
    ("turn", "0 0 0.09", "0 0 1", 0.3, "0 0 0.01", (0.0003, 0.0003, 0.0004), 20.0, 0.05),
)
HOME = {"pan": 0.3, "lift": 0.2, "elbow": 1.4, "roll": 0.2, "bend": 0.9, "turn": 0.4}  # rad
MOVED, TURNED = (0.05, -0.15, -0.1), 0.6  # of the tool: m, rad about the vertical


def six_axis_arm(duration=2.0):
    """The tool of an arm with six motors moves along a line by 0.19 m and turns by 0.6 rad about the vertical.

    A pose is six residuals: each torque follows from the path's second derivatives, by Newton's and Euler's equations
    of the bodies that the arm's description holds.

    Parameters
    ----------
    duration : float
        [s]

    Returns
    -------
    Mechanism, Program
        Realised by the actuators "torque_pan", ..., "torque_turn" [N m].
    """
    arm = sv.urdf(_description())
    position, rotation = arm.at(HOME, "tool")
    (s,) = arm.q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=duration, smoothness=2))
    path = sv.curves.line(s, position, position + MOVED)
    pose = sv.programs.pose("tool", arm.frame("tool"), path, sv.rotations.turn(TURNED * s, (0, 0, 1), rotation))
    return arm.mechanism(), sv.Program(pose, by="actuators")


def _description():
    """The arm as the text of a URDF file: a base, a link for each axis, and a tool on the last."""
    parts, before = ['<robot name="six_axis_arm"><link name="base"/>'], "base"
    for joint, place, axis, mass, centre, inertias, effort, damping in AXES:
        moments = " ".join(f'i{a}{a}="{value}"' for a, value in zip("xyz", inertias, strict=True))
        parts.append(
            f'<link name="{joint} link"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>'
            f'<inertia {moments} ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{joint}" type="continuous"><origin xyz="{place}"/><parent link="{before}"/>'
            f'<child link="{joint} link"/><axis xyz="{axis}"/><limit effort="{effort}" velocity="5"/>'
            f'<dynamics damping="{damping}"/></joint>'
        )
        before = f"{joint} link"
    parts.append(
        '<link name="tool"/><joint name="tool" type="fixed"><origin xyz="0 0 0.08" rpy="0 1.570796326794897 0"/>'
        f'<parent link="{before}"/><child link="tool"/></joint></robot>'
    )
    return "".join(parts)
