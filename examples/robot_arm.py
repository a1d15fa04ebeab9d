"""A six-axis arm from its URDF file: the tool follows a line and turns, with 2 kg in it that the law does not know."""

from pathlib import Path

import numpy as np

import servoctl as sv

HOME = {"pan": 0.3, "lift": 0.2, "elbow": 1.4, "roll": 0.2, "bend": 0.9, "turn": 0.4}  # rad


def main(fast=False):
    """Torques of the plan [N m] and errors of the loop [mm, mrad]; `fast` checks fewer segments of the plan."""
    arm = sv.urdf(Path(__file__).parent / "robots" / "six_axis_arm.urdf", symbolic=("tool",))
    position, rotation = arm.at(HOME, "tool")
    (s,) = arm.q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0))
    line = sv.curves.line(s, position, position + np.array([0.05, -0.15, -0.1]))
    turned = sv.rotations.turn(0.6 * s, (0, 0, 1), rotation)
    mechanism = arm.mechanism()
    model = sv.derive(mechanism, sv.Program(sv.programs.pose("tool", arm.frame("tool"), line, turned)))
    start = model.start(guess=HOME)
    plan = sv.simulate(model, start, (0.0, 4.0))  # the path holds its end after 2 s
    print(plan)
    proof = sv.verify(plan, segments=3 if fast else 20)
    print(proof)
    numbers = {"free": model.free, "verified": proof.passed, "lift max": plan.extrema("torque_lift")[1][1]}
    known, loaded = (sv.plant(mechanism, limits=arm.effort, tool_mass=mass) for mass in (0.0, 2.0))
    for name, integral in (("LQR", None), ("LQR with integral", True)):
        law = sv.lqr(plan, known, rate=500.0, integral=integral)
        loop = sv.close(loaded, law, start, (0.0, 4.0))
        ends = {axis: 1e3 * abs(loop.residual[f"tool_{axis}"][0][-1]) for axis in ("x", "y", "z", "rx", "ry", "rz")}
        numbers[f"{name}: at the end [mm]"] = max(ends[axis] for axis in "xyz")
        numbers[f"{name}: at the end [mrad]"] = max(ends[f"r{axis}"] for axis in "xyz")
    return numbers


if __name__ == "__main__":
    for name, number in main().items():
        print(f"{name}: {number}")
