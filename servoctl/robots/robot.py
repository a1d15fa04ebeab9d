"""A robot from its file: coordinates named by joints, frames, limits, and the mechanism of its tree of bodies."""

import math
import warnings
from functools import cached_property

import casadi as ca
import numpy as np

from servoctl.checks import array_of, as_list, by_name, column, finite, mapping, named, numbers_by_name, texts, within
from servoctl.errors import SpecificationError
from servoctl.robots.description import described
from servoctl.robots.dynamics import Kinematics, inverse_dynamics, kinetic_energy, mass_matrix, potential_energy
from servoctl.robots.inertia import require_possible, with_symbols
from servoctl.robots.joints import actuator, axes_of
from servoctl.robots.tree import ONE_AXIS, tree, with_followers
from servoctl.spec.mechanism import Mechanism
from servoctl.values import frozen

UNIT = 1e-6  # largest difference of a quaternion's length from one: numbers of a file or a table with seven digits


@frozen
class Frame:
    """A frame of a robot, made by `Robot.frame`.

    Attributes
    ----------
    name : str
        The link's.
    position : (3,) SX
        Of its origin in the world [m].
    rotation : (3, 3) SX
        From its axes to the world's.
    jacobian : (6, n) SX
        Velocity of the origin [m/s] and angular velocity [rad/s], both in the world's axes, over the velocities.
    q : Coordinates
    """

    name: str
    position: ca.SX
    rotation: ca.SX
    jacobian: ca.SX
    q: object

    def __repr__(self):
        return f"Frame {self.name!r} of {' '.join(self.q.names)}"[:118]


class Robot:
    """A robot as a tree of bodies, made by `urdf`.

    Attributes
    ----------
    q : Coordinates
        Named by the joints, as identifiers. A free base has base_x ... base_z, the quaternion base_qx ... base_qw
        (scalar last) with its invariant, and the velocities base_vx ... base_wz in its own axes; a joint's velocity is
        then named hip_rate.
    parameters : Parameters
        Mass, centre and inertia of the symbolic links.
    joints : dict of str to str
        Names of the joints in the file, by coordinate.
    links : tuple of str
        Names of the frames.
    effort, velocity, position : dict
        Limits of the file: largest force or torque by actuator [N or N m], largest speed [m/s or rad/s] and (low, high)
        [m or rad] by coordinate. Joints without a limit, or with the 0 or -1 of files that state none, are left out;
        `urdf` warns of these.
    damping, friction, armature : dict of str to float
        Viscous coefficients [N s/m or N m s], dry friction [N or N m], and inertia of rotors as their joints feel it
        [kg or kg m^2], Drake's rotor_inertia times gear_ratio squared, by coordinate.
    """

    def __init__(self, description, tree, gravity, parameters):
        self._tree, self._gravity = tree, gravity
        self.name, self.parameters, self.links = description.name, parameters, tuple(tree.places)
        self.q, self._axes, joints = axes_of(description, tree, parameters.names)
        self._all_joints = tuple(description.joints.values())
        self.joints = {name: joint.name for name, joint in joints.items()}
        self._moving = moving = {name: joint for name, joint in joints.items() if joint.kind in ONE_AXIS}
        self.effort = {actuator(name, j): j.effort for name, j in moving.items() if 0.0 < j.effort < math.inf}
        self.velocity = {name: j.velocity for name, j in moving.items() if 0.0 < j.velocity < math.inf}
        self.position = {
            name: (j.lower, j.upper) for name, j in moving.items() if math.isfinite(j.lower) or math.isfinite(j.upper)
        }
        self.damping, self.friction, self.armature = (
            {name: getattr(joint, key) for name, joint in moving.items() if getattr(joint, key)}
            for key in ("damping", "friction", "armature")
        )

    def __repr__(self):
        return f"Robot {self.name!r}: {self.q.n} degrees of freedom\n  coordinates {' '.join(self.q.names)}"

    def frame(self, name) -> Frame:
        """The frame of a link.

        Parameters
        ----------
        name : str
            The link's name in the file.

        Raises
        ------
        NameUnknown
            If no link has this name.
        """
        named(name, self.links, "link")
        body, placement = self._tree.places[name]
        position, rotation = self._position(body, placement), ca.SX(ca.DM(placement.rotation))
        if body is not None:
            rotation = self._kinematics.rotations[body] @ rotation
        return Frame(name, position, rotation, self._jacobian(body, position), self.q)

    def posture(self, at) -> np.ndarray:
        """All coordinates of a posture, (nq,): those not named are zero, and the quaternion of a free body is one.

        Parameters
        ----------
        at : dict of str to float
            Coordinates by name [rad or m].

        Raises
        ------
        SpecificationError
            If a quaternion has not the length one.
        NameUnknown
            If one is no coordinate.
        """
        numbers = {name: self.q.identity.get(name, 0.0) for name in self.q.names}
        numbers |= numbers_by_name(at, self.q.names, "coordinate", "coordinate")
        posture = np.array(list(numbers.values()))
        for e in (list(places) for places, _ in self.q.spheres):
            posture[e] = _unit([self.q.names[i] for i in e], posture[e])
        return posture

    def at(self, posture, link):
        """Position (3,) [m] and rotation (3, 3) of a link in a posture, with the parameters' defaults.

        Parameters
        ----------
        posture : dict of str to float
        link : str

        Returns
        -------
        position, rotation : arrays

        Raises
        ------
        NameUnknown
            If the link or a coordinate does not exist.
        """
        frame = self.frame(link)
        f = ca.Function("f", [ca.vertcat(*self.q)], [ca.densify(frame.position), ca.densify(frame.rotation)])
        position, rotation = f.call([ca.DM(self.posture(posture))])
        return np.array(position).ravel(), np.array(rotation)

    def mechanism(
        self,
        constraints=None,
        actuators=None,
        *,
        outputs=None,
        forces=None,
        friction=None,
        armature=None,
        parameters=None,
    ) -> Mechanism:
        """The mechanism of the robot: its balance by the recursive Newton-Euler scheme, gravity and damping.

        Figures show each link as a line from the frame of the link that carries it to its own. Efforts and positions of
        the file are its `limits`, of which `verify` says where a motion is beyond them.

        Parameters
        ----------
        constraints : dict of str to SX, optional
            Material constraints, such as those of `held` and `loop`.
        actuators : sequence of str or dict, optional
            Coordinates whose joints are driven; all joints by default. They are named torque_hip, and force_lift where
            the joint slides. A dict has displacements or directions, as in `Mechanism`.
        outputs : dict of str to SX, optional
        forces : dict of str to SX, optional
            Further generalised forces, as in `Mechanism`.
        friction : float, optional
            Speed [rad/s or m/s] below which the file's dry friction c becomes viscous, c tanh(v / friction); 0 leaves
            it out. Needed where the file has friction.
        armature : dict of str to float, optional
            Inertia of rotors as the joints feel it [kg or kg m^2], gear ratio squared times that of the rotor, by
            coordinate: in place of the file's.
        parameters : Parameters, optional
            `robot.parameters.extended(...)`, where constraints and forces have further ones.

        Raises
        ------
        SpecificationError
            If the file has dry friction and `friction` is not given.
        NameUnknown
            If an actuator names no joint.
        """
        names, driven = self.q.force_names, self._driven(actuators)
        total = {name: ca.SX(0) for name in names}
        what = "coordinate" if self.q.plain else "quasi-velocity"
        for name, value in by_name(forces, names, what, "The forces").items():
            total[name] += column(value, f"the force on {name!r}", 1)[0]
        for name, value in zip(names, self._resistance(friction, armature).elements(), strict=True):
            total[name] += value
        mechanism = Mechanism(
            self.q,
            potential=potential_energy(self._kinematics, self._gravity),
            actuators=driven,
            parameters=self.parameters if parameters is None else parameters,
            kinetic=kinetic_energy(self._kinematics),
            balance=inverse_dynamics(self._kinematics, self.q.n),
            mass=mass_matrix(self._kinematics, self.q.n),
            forces={name: value for name, value in total.items() if not value.is_zero()} or None,
            constraints=constraints,
            outputs=outputs,
            shapes=self._lines(),
            limits={n: limit for n, limit in (self.effort | self.position).items() if n in (*driven, *self.q.names)},
        )
        mechanism.passive = tuple(self.effort.keys() - mechanism.actuators)
        return mechanism

    def _lines(self):
        """Each link as a line from the frame of the link that carries it to its own."""
        ends = {name: self._position(*place) for name, place in self._tree.places.items()}
        return {joint.child: [ends[joint.parent], ends[joint.child]] for joint in self._all_joints}

    def _position(self, body, placement):
        """Position of a link on a body, (3,) SX [m]."""
        offset = ca.SX(ca.DM(placement.offset))
        return offset if body is None else self._kinematics.offsets[body] + self._kinematics.rotations[body] @ offset

    @cached_property
    def _kinematics(self):
        return Kinematics(self._tree, self._axes)

    def _jacobian(self, body, position):
        """Jacobian of the velocities of a point and of the body it is on, (6, n) SX."""
        result = ca.SX.zeros(6, self.q.n)
        while body is not None:
            rotation, arm = self._kinematics.rotations[body], position - self._kinematics.offsets[body]
            axis = self._axes[body]
            for (row, factor), unit in zip(axis.rows, axis.units, strict=True):
                turn, slide = (rotation @ part for part in unit)
                result[:, row] += factor * ca.vertcat(slide + ca.cross(turn, arm), turn)
            body = self._tree.bodies[body].parent
        return result

    def _resistance(self, friction, armature=None):
        """Generalised forces of damping, friction and the inertia of rotors, (n,) SX."""
        if friction is None and self.friction:
            raise SpecificationError(
                f"The joints {', '.join(self.friction)} have dry friction."[:500],
                "Dry friction jumps where a joint stops; servoctl takes it smoothed, as c tanh(v / friction).",
                do="Pass friction=0.01, a speed in rad/s or m/s, or friction=0 to leave it out.",
                joints=list(self.friction),
            )
        speed = within("friction", 0.0 if friction is None else friction, least=0.0)
        rotors = numbers_by_name(armature, self._moving, "joint that can be driven", "rotor inertia", low=0.0)
        rotors = {joint.name: rotors.get(name, joint.armature) for name, joint in self._moving.items()}
        rows = ca.SX.zeros(self.q.n)
        for axis, body in zip(self._axes, self._tree.bodies, strict=True):
            joint = body.joint
            if joint is None or joint.kind not in ONE_AXIS:
                continue
            (row, factor), rate = axis.rows[0], axis.rate[0]
            load = joint.damping * rate + rotors.get(joint.name, joint.armature) * axis.acceleration[0]
            if speed and joint.friction:
                load = load + joint.friction * ca.tanh(rate / speed)
            rows[row] -= factor * load
        return rows

    def _driven(self, actuators):
        """Displacements of the actuators by name."""
        if isinstance(actuators, dict):
            return actuators
        chosen = list(self._moving) if actuators is None else texts(actuators, "The actuators")
        places = dict(zip(self.q.names, self.q, strict=True))
        for name in chosen:
            named(name, list(self._moving), "joint that can be driven")
        return {actuator(name, self._moving[name]): places[name] for name in chosen}


def urdf(source, base="fixed", lock=None, symbolic=(), gravity=9.81) -> Robot:
    """Read a robot from a URDF file.

    Fixed and locked joints make one body of their links; meshes, visuals and collisions play no part, nor does
    a transmission but for Drake's rotor_inertia and gear_ratio of its actuator.
    Joints that mimic others move with them.

    Parameters
    ----------
    source : str or Path
        Path of the file, or its text.
    base : "fixed" or "free"
        Whether the root link rests in the world, or moves with six degrees of freedom.
    lock : dict of str to float, optional
        Positions of joints that do not move [rad or m], by their names in the file.
    symbolic : sequence of str
        Links whose mass, centre and inertia become parameters tool0_mass [kg], tool0_cx ... [m] and tool0_ixx ...
        [kg m^2], about the centre of mass in the axes of the link. Their defaults are the numbers of the file.
    gravity : float or (3,) sequence
        Along -z of the world, or a vector [m/s^2].

    Returns
    -------
    Robot

    Raises
    ------
    SpecificationError
        If the file is no URDF or written for xacro, is too large, declares a document type, has an impossible inertia,
        two roots or a loop, or a joint that moves no mass.
    NameUnknown
        If a joint or a link does not exist.
    """
    description = described(source)
    named(base, ("fixed", "free"), "base")
    lock = {name: finite(name, value, "position") for name, value in mapping(lock, "The locked joints").items()}
    parameters, inertials = with_symbols(description, texts(symbolic, "The symbolic links"))
    description, lock = with_followers(description, lock)
    bodies = tree(description, base, lock, inertials)
    require_possible(bodies, parameters)
    gravity = [0.0, 0.0, -finite("gravity", gravity)] if as_list(gravity) is None else gravity
    robot = Robot(description, bodies, array_of("gravity", gravity, 3), parameters)
    if unstated := [name for name, joint in robot._moving.items() if min(joint.effort, joint.velocity) <= 0.0]:
        said = f"An effort or a velocity of {', '.join(unstated)} is 0 or less in the file, which states no limit"
        warnings.warn(f"{said}. State it there, or pass limits={{...}} to sv.plant.", RuntimeWarning, stacklevel=2)
    return robot


def _unit(names, quaternion):
    """A quaternion without its rounding; one that is no rotation is refused."""
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > UNIT:
        unit = quaternion / length if length else np.array([0.0, 0.0, 0.0, 1.0])
        raise SpecificationError(
            f"The quaternion {', '.join(f'{n}={v:g}' for n, v in zip(names, quaternion, strict=True))} has the length "
            f"{length:g}.",
            "Its length is one; the scalar is one where it is not given.",
            f"{', '.join(f'{n}={v:.9g}' for n, v in zip(names, unit, strict=True))}.",
            do="Give all four entries.",
            length=length,
            unit=unit.tolist(),
        )
    return quaternion / length
