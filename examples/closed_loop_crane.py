"""Overhead crane with 15 % more load than planned, and a gust: how far off its path the load is under each law.

All laws are designed for 100 kg; the machine carries 115 kg, and a gust turns the rope by 60 N m from 2.0 to 2.5 s.
"""

import sys

import numpy as np

import servoctl as sv
from servoctl.gallery import overhead_crane

GUST = {"theta": sv.disturbances.gust(60.0, 2.0, 2.5)}  # N m
SENSORS = {"x": 1e-3, "l": 1e-3, "theta": 1e-3}  # m, m, rad: standard deviations
NOISE = SENSORS | {"dx": 1e-2, "dl": 1e-2, "dtheta": 1e-2}  # m/s, m/s, rad/s
LIMITS = {"trolley": 150.0, "hoist": (-1300.0, 0.0)}  # N
WEAK = {"trolley": 100.0, "hoist": (-1300.0, 0.0)}  # N; the plan needs 138 N
LOOKS = [{"linestyle": style, "color": colour} for style in sv.figures.STYLES for colour in sv.figures.COLOURS]
RESERVE = 0.8  # of the weak trolley, for the plan; the rest is the feedback's


def planned():
    """The crane and its plan."""
    mechanism, program = overhead_crane()
    model = sv.derive(mechanism, program)
    return mechanism, sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0), progress=False)


def laws(mechanism, plan):
    """The laws by name, at 100 Hz, designed for the nominal load except where the name says otherwise."""
    nominal = sv.plant(mechanism)
    integral = sv.lqr(plan, nominal, integral=True)
    gains = {"kp": {"trolley": 2000.0, "hoist": 8000.0}, "kd": {"trolley": 800.0, "hoist": 2000.0}}  # N/m, N s/m
    return {
        "feedforward": sv.feedforward(plan, nominal),
        "PD": sv.pd(plan, nominal, **gains),
        "computed, 0.25 s": sv.computed(plan, nominal),
        "computed, 0.06 s": sv.computed(plan, nominal, poles=0.06),
        "computed, 0.25 s, load known": sv.computed(plan, sv.plant(mechanism, m_load=115.0)),
        "LQR": sv.lqr(plan, nominal),
        "LQR with integral": integral,
        "output feedback": sv.output_feedback(integral, nominal, SENSORS),
        "limited": sv.limited(integral, sv.plant(mechanism, limits=LIMITS)),
    }


def closed(mechanism, plan, law, limits=None, end=8.0, **options):
    """The loop around the machine with 115 kg, in the gust."""
    machine = sv.plant(mechanism, m_load=115.0, limits=limits)
    return sv.close(machine, law, plan.state(0.0), (0.0, end), disturbance=GUST, **options)


def load_error(run):
    """Distance of the load from its path [mm]."""
    return 1e3 * np.hypot(run.residual["X"][0], run.residual["Z"][0])


def summary(name, run):
    """Worst and last error, the largest trolley force, and whether the power balance of a run holds."""
    error = load_error(run)
    return {
        f"{name}: worst [mm]": error.max(),
        f"{name}: at the end [mm]": error[-1],
        f"{name}: trolley [N]": np.abs(run["trolley"]).max(),
        f"{name}: verified": sv.verify(run).passed,
    }


def refusal(mechanism, plan, time_constant=0.015):
    """The error raised for poles that are too fast for 100 Hz."""
    try:
        sv.computed(plan, sv.plant(mechanism), poles=time_constant)
    except sv.errors.SpecificationError as error:
        return error
    raise AssertionError("poles beyond the bound were accepted")


def overloaded(mechanism, plan, fast=False):
    """A trolley of 100 N, less than the plan needs: inputs bounded by allocation, then a slower plan."""
    nominal, weak = sv.plant(mechanism), sv.plant(mechanism, limits=WEAK)
    scene = {"t_span": (0.0, 6.0), "guess": {"l": 4.0}}
    base = sv.lqr(plan, nominal, integral=True)
    clipped = closed(mechanism, plan, base, WEAK)
    limited = closed(mechanism, plan, sv.limited(base, weak), WEAK)
    report = sv.limit_report(limited, None if fast else scene)
    print(report)
    slower = sv.fastest(mechanism, plan.model.reduction.program, {"trolley": RESERVE * WEAK["trolley"]}, **scene)
    print(slower)
    base = sv.lqr(slower.plan, nominal, integral=True)
    slowed = closed(mechanism, slower.plan, sv.limited(base, weak), WEAK, end=10.0)
    print(sv.limit_report(slowed))
    numbers = summary("overloaded, clipped", clipped) | summary("overloaded, limited", limited)
    numbers |= summary("slowed", slowed) | {"the plan needs [N]": report.overload[2], "reserve factor": slower.factor}
    numbers["slowed: residuals that gave way"] = len(sv.limit_report(slowed).rows)
    return numbers | ({} if fast else {"slower": report.slower})


def draw(ax, runs):
    """The load's error in each of the runs over time, on a logarithmic scale."""
    ax.axvspan(2.0, 2.5, color="0.92")
    ax.axvline(6.0, color="0.7", linewidth=1)
    for (name, run), look in zip(runs.items(), LOOKS, strict=False):
        ax.semilogy(run.t, np.maximum(load_error(run), 1e-3), label=name, linewidth=1.4, **look)
    ax.text(2.25, 0.03, "gust", ha="center", color="0.4")
    ax.text(5.95, 0.03, "end of the path", ha="right", color="0.4")
    ax.set(xlim=(0.0, 8.0), ylim=(0.02, 7e4), xlabel="t [s]", ylabel="distance of the load from its path [mm]")
    ax.set_title("Overhead crane, designed for 100 kg, carrying 115 kg", loc="left")
    ax.grid(axis="y", color="0.9")
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)


def save_figure(runs, path):
    """A figure of all runs."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5, 4.2), layout="constrained")
    draw(figure.subplots(), runs)
    figure.savefig(path, dpi=90)


def main(fast=False, save=None):
    """Errors of the load [mm] and the largest trolley force [N] under each law.

    Names that begin with "noise, " belong to the same loop with noise and one sample of delay. `fast` leaves out one
    time law; `save` names a file for the figure.
    """
    mechanism, plan = planned()
    numbers, runs, every = {}, {}, laws(mechanism, plan)
    for name, law in every.items():
        limits = LIMITS if name == "limited" else None
        noise = {state: std for state, std in NOISE.items() if state in law.measures}
        runs[name] = closed(mechanism, plan, law, limits)
        numbers |= summary(name, runs[name]) | {f"{name}: at 6 s [mm]": load_error(runs[name])[600]}
        sensors, timing = sv.Sensors(noise=noise, seed=1 if noise else None), sv.Timing(delay=1)
        noisy = closed(mechanism, plan, law, limits, sensors=sensors, timing=timing)
        numbers |= summary(f"noise, {name}", noisy)
    calm = sv.close(sv.plant(mechanism), every["computed, 0.25 s"], plan.state(0.0), (0.0, 8.0))
    numbers |= summary("computed, 0.25 s, as planned", calm)
    print(refusal(mechanism, plan))
    if save:
        save_figure(runs, save)
    return {name: float(value) for name, value in (numbers | overloaded(mechanism, plan, fast)).items()}


if __name__ == "__main__":
    for name, number in main(save=sys.argv[1] if len(sys.argv) > 1 else None).items():
        print(f"{name}: {number:.4g}")
