"""The time-optimal transfer of a crane's load along a straight line, against polynomials in time."""

import sys

import numpy as np
from scipy.integrate import trapezoid

import servoctl as sv
from servoctl.gallery import overhead_crane

LIMITS = {"trolley": (-300.0, 300.0), "hoist": (-1400.0, 0.0)}  # N
SPAN, GUESS = (0.0, 6.0), {"l": 4.0}  # s, m


def active(plan, near=0.01):
    """Part of the duration within which a force is within a hundredth of its limits."""
    on = np.zeros(len(plan.t), dtype=bool)
    for name, (low, high) in LIMITS.items():
        margin = near * max(abs(low), abs(high))
        on |= (plan[name] < low + margin) | (plan[name] > high - margin)
    return float(trapezoid(on.astype(float), plan.t) / np.ptp(plan.t))


def save_figure(plans, path):
    """Forces along the laws."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5, 4.6), layout="constrained")
    for axes, (name, sides) in zip(figure.subplots(2, 1, sharex=True), LIMITS.items(), strict=True):
        for side in filter(None, sides):
            axes.axhline(side, color="0.6", linestyle="--", linewidth=1)
        for label, plan in plans.items():
            axes.plot(plan.t, plan[name], label=label)
        axes.set(ylabel=f"{name} [N]")
        axes.grid(color="0.9")
    axes.set(xlabel="t [s]")
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=90)


def main(fast=False, save=None):
    """Durations [s], the part of the time at a limit, and whether the plant follows; `fast` leaves out polynomials."""
    mechanism, program = overhead_crane()
    law = sv.fastest(mechanism, program, LIMITS, SPAN, guess=GUESS, shape=True)
    print(law)
    proof = sv.verify(law.plan)
    print(proof)
    numbers = {"duration [s]": float(law.plan.t[-1]), "at a limit": active(law.plan), "verified": proof.passed}
    if not fast:
        even = sv.fastest(mechanism, program, LIMITS, SPAN, guess=GUESS)
        print(even)
        numbers |= {"duration by S9 [s]": float(even.plan.t[-1]), "at a limit by S9": active(even.plan)}
        if save:
            save_figure({"stretched evenly": even.plan, "time-optimal": law.plan}, save)
    return numbers


if __name__ == "__main__":
    for name, number in main(save=sys.argv[1] if len(sys.argv) > 1 else None).items():
        print(f"{name}: {number}")
