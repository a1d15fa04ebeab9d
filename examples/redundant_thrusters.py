"""Four thrusters for three residuals: the actuation is nearest to a wish in a weighted norm.

A vehicle floats on a plane; its position and heading follow paths. The motion is determined by the program alone, the
division among the thrusters by weights and wishes: u = u_wish + W^-1 P' mu has least (u - u_wish)'W(u - u_wish).
"""

import casadi as ca
import numpy as np

import servoctl as sv

LEVER = 0.3  # m, from the centre of mass to a pair of thrusters


def vehicle(weights=None, toward=None):
    p = sv.parameters(m=12.0, J=0.8, lever=LEVER)  # kg, kg m^2, m
    q = sv.coordinates("x y psi")  # m, m, rad
    x, y, psi = q
    forward = ca.vertcat(ca.cos(psi), ca.sin(psi))
    left = ca.vertcat(-ca.sin(psi), ca.cos(psi))
    S = sv.rigid_body(q, p.m, (0, 0, p.J), position=(x, y), rates=(0, 0, q.d(1)[2]))
    actuators = {  # by direction: force on x, on y, torque about the centre of mass
        "port": ca.vertcat(forward, -p.lever),
        "starboard": ca.vertcat(forward, p.lever),
        "bow": ca.vertcat(left, p.lever),
        "stern": ca.vertcat(left, -p.lever),
    }
    path = sv.paths.rest_to_rest(start=(0.0, 0.0, 0.0), end=(2.0, 1.0, np.pi / 2), duration=4.0, smoothness=2)
    r = q.references(X=path[0], Y=path[1], heading=path[2])
    mechanism = sv.Mechanism(q, gibbs=S, actuators=actuators, parameters=p)
    program = sv.Program({"X": x - r.X, "Y": y - r.Y, "heading": psi - r.heading}, weights=weights, toward=toward)
    return mechanism, program


def main(fast=False):
    """Largest thrusts [N]: equal weights, a weak bow thruster, a wish of 3 N for port and -3 N for starboard.

    `fast` checks fewer segments of the runs.
    """
    numbers = {}
    wish = {"port": 3.0, "starboard": -3.0}
    for case, weights, toward in (("equal", {}, {}), ("weak bow", {"bow": 10.0}, {}), ("wish", {}, wish)):
        model = sv.derive(*vehicle(weights, toward))
        run = sv.simulate(model, model.start(), (0.0, 4.0))
        print(run)
        proof = sv.verify(run, segments=3 if fast else 20)
        print(proof)
        u = np.array([run[name] for name in model.actuators])
        numbers |= {f"{case} {name}": float(abs(values).max()) for name, values in zip(model.actuators, u, strict=True)}
        numbers |= {
            f"{case} verified": proof.passed,
            f"{case} against the least norm": float(abs(u - _least_norm(run, weights, toward)).max()),
        }
    return numbers


def _least_norm(run, weights, toward, m=12.0, J=0.8):
    """u_wish + W^-1 E'(E W^-1 E')^-1 ((m x'', m y'', J psi'') - E u_wish) at every sample, (4, N) [N], by numpy."""
    inverse = np.diag([1.0 / weights.get(name, 1.0) for name in run.model.actuators])
    wish = np.array([toward.get(name, 0.0) for name in run.model.actuators])
    wanted = np.array([m * run["d2x"], m * run["d2y"], J * run["d2psi"]])
    result = []
    for psi, force in zip(run["psi"], wanted.T, strict=True):
        c, s = np.cos(psi), np.sin(psi)
        E = np.array([[c, c, -s, -s], [s, s, c, c], [-LEVER, LEVER, LEVER, -LEVER]])
        result.append(wish + inverse @ E.T @ np.linalg.solve(E @ inverse @ E.T, force - E @ wish))
    return np.array(result).T


if __name__ == "__main__":
    for name, number in main().items():
        print(f"{name}: {number}")
