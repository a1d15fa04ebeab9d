"""A spinning satellite turns its axis by 60 degrees, by two transverse torques: unit quaternion and body rates.

Four coordinates move with three quasi-velocities, q' = V w with V of shape (4, 3), and the unit length is an
invariant that the kinematics keep. No torque acts about the axis: the spin is internal dynamics, two of the motion's
initial values stay free, and the spin rate stays what it was. Turning the axis at the rate a' takes the torque
J_t a'' about the axis of the turn and the gyroscopic torque J_a Omega a' across it.
"""

import casadi as ca
import numpy as np

import servoctl as sv

p = sv.parameters(J_t=40.0, J_a=60.0)  # kg m^2, transverse and axial
e = sv.coordinates("e0 e1 e2 e3")  # unit quaternion, body to inertial axes
e0, e1, e2, e3 = e
V = [[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]]
q = e.with_quasi_velocities(
    "w1 w2 w3",  # body rates, rad/s
    [[entry / 2 for entry in row] for row in V],
    invariants={"unit": e0**2 + e1**2 + e2**2 + e3**2 - 1},
)

S = sv.rigid_body(q, mass=0, inertia=(p.J_t, p.J_t, p.J_a), rates=q.w())  # (3.11)
mechanism = sv.Mechanism(q, gibbs=S, actuators={"torque1": (1, 0, 0), "torque2": (0, 1, 0)}, parameters=p)
r = q.references(angle=sv.paths.rest_to_rest(0.0, np.pi / 3, duration=10.0, smoothness=2))  # rad
program = sv.Program(
    {
        "across": 2 * (e1 * e3 + e0 * e2) - ca.sin(r.angle),  # the axis is (sin a, 0, cos a) in inertial axes
        "aside": 2 * (e2 * e3 - e0 * e1),
    }
)


def main(fast=False):
    """Largest torque [N m], change of the spin rate, error of the unit length; `fast` checks fewer segments."""
    model = sv.derive(mechanism, program)
    print(model)
    start = model.start(w3=0.5, guess={"e0": 1.0})
    run = sv.simulate(model, start, (0.0, 10.0), drift="project")
    print(run)
    proof = sv.verify(run, segments=3 if fast else 20)
    print(proof)
    length = sum(run[name] ** 2 for name in ("e0", "e1", "e2", "e3"))
    return {
        "free": model.free,
        "torque max": float(np.hypot(run["torque1"], run["torque2"]).max()),
        "spin change": float(np.ptp(run["w3"])),
        "unit error": float(abs(length - 1.0).max()),
        "verified": proof.passed,
    }


if __name__ == "__main__":
    for name, number in main().items():
        print(f"{name}: {number}")
