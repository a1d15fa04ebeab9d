"""Robots with a free base and revolute joints, by recursive Newton-Euler equations as a library would give them."""

import casadi as ca
import numpy as np

import servoctl as sv

GRAVITY = 9.81


def turn(axis, angle):
    """The rotation by an angle about a coordinate axis, 0 to 2."""
    s, c, R = ca.sin(angle), ca.cos(angle), ca.SX.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def attitude(e):
    """The rotation matrix of a quaternion, and Q of e' = Q w by body rates w."""
    a, b, c, d = e
    Q = [[-b, -c, -d], [a, -d, c], [d, a, -b], [-c, b, a]]
    R = [
        [1 - 2 * (c**2 + d**2), 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), 1 - 2 * (b**2 + d**2), 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b**2 + c**2)],
    ]
    return tuple(ca.vertcat(*(ca.horzcat(*row) for row in rows)) for rows in (R, np.array(Q) / 2))


class Robot:
    """Base 0 and links 1, 2, ...: `parents` of the links, seeded axes, offsets, masses, centres and inertias.

    Coordinates are the place of the base, its quaternion and the joint angles; velocities those of the base along its
    own axes, its body rates and the joint rates.
    """

    def __init__(self, parents, seed=1):
        rng, n = np.random.default_rng(seed), len(parents)
        joints = [f"j{i}" for i in range(1, n + 1)]
        plain = sv.coordinates(" ".join(["x y z e0 e1 e2 e3", *joints]))
        R, Q = attitude(list(plain)[3:7])
        names = " ".join(["u v w p q r", *(f"rate_{name}" for name in joints)])
        unit = {"unit": ca.sumsqr(ca.vertcat(*list(plain)[3:7])) - 1}
        self.q = q = plain.with_quasi_velocities(names, ca.diagcat(R, Q, ca.SX.eye(n)), invariants=unit)
        angles, rates, changes = list(q)[7:], ca.vertcat(*q.gamma(1)), ca.vertcat(*q.gamma(2))
        masses, centres = rng.uniform(0.5, 2.0, n + 1), rng.uniform(-0.1, 0.1, (n + 1, 3)).round(3)
        inertias, offsets = rng.uniform(0.01, 0.02, (n + 1, 3)).round(4), rng.uniform(-0.3, 0.3, (n + 1, 3)).round(2)
        axes = [i % 3 for i in range(n + 1)]
        self.turns, self.places = [R], [ca.vertcat(*list(q)[:3])]
        spin, speed = [rates[3:6]], [changes[3:6]]
        moved, relative = [changes[:3] + ca.cross(rates[3:6], rates[:3])], [None]
        for i, parent in enumerate(parents, 1):
            unit, offset, R = ca.SX.eye(3)[:, axes[i]], ca.SX(offsets[i]), turn(axes[i], angles[i - 1])
            carried = R.T @ spin[parent]
            relative.append(R)
            spin.append(carried + unit * rates[5 + i])
            speed.append(R.T @ speed[parent] + unit * changes[5 + i] + ca.cross(carried, unit) * rates[5 + i])
            moved.append(R.T @ (moved[parent] + _about(spin[parent], speed[parent], offset)))
            self.places.append(self.places[parent] + self.turns[parent] @ offset)
            self.turns.append(self.turns[parent] @ R)
        forces, moments, self.potential = [], [], 0
        for i in range(n + 1):
            force = masses[i] * (moved[i] + _about(spin[i], speed[i], ca.SX(centres[i])))
            inertia = ca.SX(inertias[i])
            forces.append(force)
            moments.append(
                inertia * speed[i] + ca.cross(spin[i], inertia * spin[i]) + ca.cross(ca.SX(centres[i]), force)
            )
            self.potential += GRAVITY * masses[i] * (self.places[i] + self.turns[i] @ ca.SX(centres[i]))[2]
        torques = [None] * n
        for i in range(n, 0, -1):
            parent, force = parents[i - 1], relative[i] @ forces[i]
            torques[i - 1] = moments[i][axes[i]]
            forces[parent] += force
            moments[parent] += relative[i] @ moments[i] + ca.cross(ca.SX(offsets[i]), force)
        self.balance = ca.vertcat(forces[0], moments[0], *torques)

    def posture(self, seed=2):
        """Coordinates of the robot upright with seeded joint angles, by name."""
        angles = np.random.default_rng(seed).uniform(-0.6, 0.6, self.q.nq - 7).round(2)
        return dict(zip(self.q.names, [0, 0, 1, 1, 0, 0, 0, *angles], strict=True))

    def scene(self, programmed, feet=(), base=False):
        """Links held to the ground by material constraints; joints, and perhaps the base, on paths by motors."""
        q, posture = self.q, self.posture()
        symbols, constraints = dict(zip(q.names, q, strict=True)), {}
        for foot in feet:
            here = ca.Function("here", [q.jet(0)], [self.places[foot], self.turns[foot]])
            place, turned = (ca.SX(m) for m in here(list(posture.values())))
            difference = turned.T @ self.turns[foot]
            rows = [*(self.places[foot] - place).elements(), difference[2, 1], difference[0, 2], difference[1, 0]]
            constraints |= {f"foot {foot} {name}": row for name, row in zip("xyzabc", rows, strict=True)}
        motors = {f"motor {name}": symbols[name] for name in q.names[7:]}
        targets = {name: 0.2 * ca.sin(2 * q.t + i) - 0.2 * np.sin(i) for i, name in enumerate(programmed)}
        targets |= {name: 0.02 * (1 - ca.cos(q.t)) for name in "xyz" if base}
        targets |= {name: 0 for name in ("e1", "e2", "e3") if base}
        mechanism = sv.Mechanism(
            q, balance=self.balance, potential=self.potential, actuators=motors, constraints=constraints
        )
        residuals = {f"on {name}": symbols[name] - posture[name] - target for name, target in targets.items()}
        return mechanism, sv.Program(residuals)


def _about(spin, turned, arm):
    """The acceleration of a point of a body relative to that of its origin."""
    return ca.cross(turned, arm) + ca.cross(spin, ca.cross(spin, arm))
