"""A via point and a duration for an arm of two links: the least time under limits of its torques."""

import sys

import numpy as np

import servoctl as sv
from servoctl.gallery import two_link_arm

LIMITS = {"shoulder": 45.0, "elbow": 5.0}  # N m
START, END, MIDDLE = (0.6, 0.4), (0.2, 0.9), (0.4, 0.65)  # m
GUESS = {"q1": -0.2, "q2": 1.7}  # rad


def arm(**values):
    """The arm of the gallery, whose end passes a via point in the middle of a duration; the model, its parameters."""
    mechanism, _ = two_link_arm()
    mechanism.parameters = p = mechanism.parameters.extended(via_x=MIDDLE[0], via_y=MIDDLE[1], duration=1.0)
    points = [START, (p.via_x, p.via_y), END]
    path = sv.paths.spline([0.0, 0.5, 1.0], points, smoothness=2).at_rate(1 / p.duration)
    r, end = mechanism.q.references(end_x=path[0], end_y=path[1]), mechanism.outputs
    model = sv.derive(mechanism, sv.Program({"X": end["X_end"] - r.end_x, "Y": end["Y_end"] - r.end_y}))
    return model.with_parameters(**values), p


def save_figure(designs, path):
    """Ways of the end and torques over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5, 3.8), layout="constrained")
    way, *torques = figure.subplots(1, 3)
    for label, design in designs.items():
        plan = design.plan
        way.plot(plan["X_end"], plan["Y_end"], label=f"{label}: {design.cost:.3f} s")
        for axes, name in zip(torques, LIMITS, strict=True):
            axes.plot(plan.t, plan[name])
    for axes, (name, limit) in zip(torques, LIMITS.items(), strict=True):
        for side in (-limit, limit):
            axes.axhline(side, color="0.6", linestyle="--", linewidth=1)
        axes.set(xlabel="t [s]", ylabel=f"{name} [N m]")
    way.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", ylim=(0.35, 1.15))
    way.legend(frameon=False, loc="upper right", fontsize="small")
    for axes in (way, *torques):
        axes.grid(color="0.9")
    figure.savefig(path, dpi=90)


def main(fast=False, save=None):
    """Durations [s] on a straight way and through the best via point, and this point [m]; `fast`: the latter."""
    model, p = arm()
    vary = {"via_x": (0.2, 0.7), "via_y": (0.4, 0.9), "duration": (0.3, 3.0)}
    ways = {"designed": vary} if fast else {"straight": {"duration": vary["duration"]}, "designed": vary}
    designs = {
        label: sv.design(model, chosen, (0.0, p.duration), "time", limits=LIMITS, guess=GUESS)
        for label, chosen in ways.items()
    }
    for design in designs.values():
        print(design)
    if save:
        save_figure(designs, save)
    found = designs["designed"]
    return {f"{label} [s]": design.cost for label, design in designs.items()} | {
        "via x [m]": found.values["via_x"], "via y [m]": found.values["via_y"], "gain": found.gain,
        "verified": all(design.proof.passed for design in designs.values()),
        **{f"{name} [N m]": float(np.abs(found.plan[name]).max()) for name in LIMITS},
    }  # fmt: skip


if __name__ == "__main__":
    for name, number in main(save=sys.argv[1] if len(sys.argv) > 1 else None).items():
        print(f"{name}: {number}")
