"""Kinematics and inertia of a tree of bodies, by recursion over them: linear in their number."""

import casadi as ca

from servoctl.values import frozen


@frozen
class Axis:
    """The motion of a joint: coordinates, their rates and accelerations (SX), and what its force works on.

    `rows` pairs places of the velocities with factors: that of the joint a joint mimics, times the multiplier. A free
    body has a position (3,), a quaternion (4,) with the scalar last, and six velocities in its own axes.
    """

    motion: str
    value: ca.SX
    rate: ca.SX
    acceleration: ca.SX
    rows: tuple[tuple[int, float], ...]

    def parts(self, jet):
        """What turns and what slides of a value, rate or acceleration of the joint, in the body's axes."""
        if self.motion == "free":
            return jet[3:], jet[:3]
        along, nothing = ca.vertcat(0, 0, jet[0]), ca.SX.zeros(3)
        return (along, nothing) if self.motion == "turn" else (nothing, along)

    @property
    def units(self):
        """What turns and what slides for a unit of each velocity."""
        return [self.parts(unit) for unit in ca.horzsplit(ca.SX.eye(len(self.rows)))]


class Kinematics:
    """Rotations and offsets of the bodies in the world, and their velocities in their own axes.

    One entry for each body, SX: `rotations` (3, 3), `offsets` (3,) [m], angular velocities `omega` (3,) [rad/s], and
    velocities `speed` (3,) of the origins [m/s].
    """

    def __init__(self, tree, axes):
        self.tree, self.axes = tree, axes
        self.rotations, self.offsets, self.omega, self.speed = [], [], [], []
        self.locals = list(map(_local, axes))
        self.along = [axis.parts(axis.value)[1] for axis in axes]
        for body, axis in zip(tree.bodies, axes, strict=True):
            self._place(body, axis)
            self._move(axis)

    def into(self, i, vector):
        """A vector in the parent's axes, in those of body i."""
        return self.locals[i].T @ (ca.DM(self.tree.bodies[i].placement.rotation.T) @ vector)

    def out_of(self, i, vector):
        """A vector in the axes of body i, in those of its parent."""
        return ca.DM(self.tree.bodies[i].placement.rotation) @ (self.locals[i] @ vector)

    def arm(self, i):
        """The offset of body i's origin in its parent's axes."""
        placement = self.tree.bodies[i].placement
        return ca.DM(placement.offset) + ca.DM(placement.rotation) @ self.along[i]

    def parent(self, vectors, i):
        """The vector of body i's parent, zero for the ground."""
        parent = self.tree.bodies[i].parent
        return ca.SX.zeros(3) if parent is None else vectors[parent]

    def _place(self, body, axis):
        i = len(self.rotations)
        inner = ca.horzcat(*(self.out_of(i, e) for e in ca.horzsplit(ca.SX.eye(3))))
        if body.parent is None:
            self.rotations.append(inner)
            self.offsets.append(self.arm(i))
        else:
            outer = self.rotations[body.parent]
            self.rotations.append(outer @ inner)
            self.offsets.append(self.offsets[body.parent] + outer @ self.arm(i))

    def _move(self, axis):
        i = len(self.omega)
        outer, speed = self.parent(self.omega, i), self.parent(self.speed, i)
        carried = self.into(i, speed + ca.cross(outer, self.arm(i)))
        spin, slide = axis.parts(axis.rate)
        self.omega.append(self.into(i, outer) + spin)
        self.speed.append(carried + slide)


def inverse_dynamics(kinematics, n):
    """Generalised forces of inertia M γ'' + h without gravity, by the recursive Newton-Euler scheme: (n,) SX.

    Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 5.3, written with vectors of three.
    """
    bodies, axes, into = kinematics.tree.bodies, kinematics.axes, kinematics.into
    alphas, accelerations, forces, couples = [], [], [], []
    for i, (body, axis) in enumerate(zip(bodies, axes, strict=True)):
        outer, arm = kinematics.parent(kinematics.omega, i), kinematics.arm(i)
        alpha, acceleration = kinematics.parent(alphas, i), kinematics.parent(accelerations, i)
        acceleration = into(i, acceleration + ca.cross(alpha, arm) + ca.cross(outer, ca.cross(outer, arm)))
        (spin, slide), (spun, slid) = axis.parts(axis.rate), axis.parts(axis.acceleration)
        alpha, outer = into(i, alpha), into(i, outer)
        alpha = alpha + ca.cross(outer, spin) + spun
        acceleration = acceleration + ca.cross(2 * outer + spin, slide) + slid
        alphas.append(alpha)
        accelerations.append(acceleration)
        force, couple = _inertial_load(body.inertial, kinematics.omega[i], alpha, acceleration)
        forces.append(force)
        couples.append(couple)
    return _projected(kinematics, forces, couples, n)


def kinetic_energy(kinematics):
    """Kinetic energy [J] of the bodies: a function of q and the velocities."""
    total = 0
    for body, omega, speed in zip(kinematics.tree.bodies, kinematics.omega, kinematics.speed, strict=True):
        inertial = body.inertial
        total += inertial.mass * ca.dot(speed, speed) / 2 + ca.dot(ca.cross(omega, inertial.moment), speed)
        total += ca.dot(omega, inertial.inertia @ omega) / 2
    return total


def potential_energy(kinematics, gravity):
    """Potential energy [J] in a field of gravity, a vector (3,) [m/s^2] in the world's axes."""
    moments, masses = zip(*((body.inertial.moment, body.inertial.mass) for body in kinematics.tree.bodies), strict=True)
    moments, masses, total = list(map(ca.SX, moments)), list(masses), 0
    for i in reversed(range(len(moments))):
        parent, moment = kinematics.tree.bodies[i].parent, kinematics.out_of(i, moments[i])
        moment = moment + masses[i] * kinematics.arm(i)
        if parent is None:
            total -= ca.dot(ca.DM(gravity), moment)
        else:
            moments[parent] = moments[parent] + moment
            masses[parent] = masses[parent] + masses[i]
    return total


def quaternion_rotation(x, y, z, w):
    """The rotation matrix of a quaternion with the scalar w, of any length: orthonormal off the unit sphere, too."""
    twice = 2 / (x * x + y * y + z * z + w * w)
    return ca.vertcat(
        ca.horzcat(1 - twice * (y * y + z * z), twice * (x * y - z * w), twice * (x * z + y * w)),
        ca.horzcat(twice * (x * y + z * w), 1 - twice * (x * x + z * z), twice * (y * z - x * w)),
        ca.horzcat(twice * (x * z - y * w), twice * (y * z + x * w), 1 - twice * (x * x + y * y)),
    )


def _local(axis):
    """Rotation of a body in the frame of its placement."""
    if axis.motion == "slide":
        return ca.SX.eye(3)
    if axis.motion == "free":
        return quaternion_rotation(*axis.value[3:].elements())
    c, s = ca.cos(axis.value), ca.sin(axis.value)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def _inertial_load(inertial, omega, alpha, acceleration):
    """Force and couple about the body's origin that its motion takes."""
    moment = inertial.moment
    force = inertial.mass * acceleration + ca.cross(alpha, moment) + ca.cross(omega, ca.cross(omega, moment))
    couple = inertial.inertia @ alpha + ca.cross(omega, inertial.inertia @ omega) + ca.cross(moment, acceleration)
    return force, couple


def _projected(kinematics, forces, couples, n):
    """Generalised forces of forces and couples on the bodies, each with all that its joint carries."""
    rows = [0] * n
    for i in reversed(range(len(forces))):
        body, axis = kinematics.tree.bodies[i], kinematics.axes[i]
        for (row, factor), (turn, slide) in zip(axis.rows, axis.units, strict=True):
            rows[row] += factor * (ca.dot(couples[i], turn) + ca.dot(forces[i], slide))
        if body.parent is not None:
            force, couple = kinematics.out_of(i, forces[i]), kinematics.out_of(i, couples[i])
            forces[body.parent] = forces[body.parent] + force
            couples[body.parent] = couples[body.parent] + couple + ca.cross(kinematics.arm(i), force)
    return ca.vertcat(*rows)


def mass_matrix(kinematics, n):
    """The mass matrix of the bodies by composite rigid bodies: (n, n) SX.

    Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 6.2, written with vectors of three.
    """
    bodies, axes = kinematics.tree.bodies, kinematics.axes
    composites = [body.inertial for body in bodies]
    M = ca.SX.zeros(n, n)
    for i in reversed(range(len(bodies))):
        loads = [_inertial_load(composites[i], ca.SX.zeros(3), alpha, a) for alpha, a in axes[i].units]
        for k, ((row, factor), load) in enumerate(zip(axes[i].rows, loads, strict=True)):
            j, columns = i, range(k + 1)
            while j is not None:
                for c in columns:
                    other, scale = axes[j].rows[c]
                    alpha, a = axes[j].units[c]
                    entry = factor * scale * (ca.dot(a, load[0]) + ca.dot(alpha, load[1]))
                    M[row, other] += entry
                    if (j, c) != (i, k):
                        M[other, row] += entry
                force, couple = kinematics.out_of(j, load[0]), kinematics.out_of(j, load[1])
                load = force, couple + ca.cross(kinematics.arm(j), force)
                j = bodies[j].parent
                columns = () if j is None else range(len(axes[j].rows))
        if (parent := bodies[i].parent) is not None:
            inner = composites[i].moved(kinematics.locals[i], kinematics.along[i])
            placement = bodies[i].placement
            composites[parent] = composites[parent] + inner.moved(placement.rotation, placement.offset)
    return M
