"""The load and the friction of a crane from one noisy run at 100 Hz.

The crane carries its load along the planned path under LQR, which was designed for 100 kg and no friction. Its inputs
and measurements tell the true load and the friction of the trolley, with their standard deviations. The figure shows
what was measured less what the identified crane does under the same inputs.
"""

import sys

import servoctl as sv
from servoctl.gallery import gallery

NOISE = {"x": 1e-3, "l": 1e-3, "theta": 1e-3, "dx": 5e-3, "dl": 5e-3, "dtheta": 5e-3}  # m, m, rad and per second
TRUE = {"m_load": 112.0, "damping_x": 25.0}  # kg, N s/m


def measured_run(seed=1, duration=6.0):
    """One run of the true crane, and its plan."""
    mechanism, program = gallery["overhead-crane"].build()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, duration))
    law = sv.lqr(plan, sv.plant(mechanism), rate=100.0, integral=True)
    machine = sv.plant(mechanism, m_load=TRUE["m_load"], damping={"x": TRUE["damping_x"]})
    sensors = sv.Sensors(noise=NOISE, seed=seed)
    return plan, sv.close(machine, law, plan.state(0.0), (0.0, duration), sensors=sensors)


def main(fast=False, save=None):
    """Identified parameters with their standard deviations; `fast` takes half of the run, `save` names a figure."""
    plan, loop = measured_run(duration=3.0 if fast else 6.0)
    guess = sv.plant(plan.model.reduction.mechanism, damping={"x": 1.0})
    found = sv.identify(guess, loop, list(TRUE))
    print(found)
    numbers = {}
    for name, value in TRUE.items():
        numbers |= {name: found[name], f"{name} deviation": found.deviation(name)}
        numbers[f"{name} verified"] = abs(found[name] - value) < 3 * found.deviation(name)
    if save:
        save_figure(found, loop, save)
    return numbers | {"misfit": found.misfit}


def save_figure(found, loop, path):
    """Residuals of the measured states in units of their noise."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 5.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    for panel, (name, values) in zip(axes, list(found.residuals[0].items())[:3], strict=True):
        panel.plot(loop.t, values / NOISE[name], ".", markersize=3, color=sv.figures.COLOURS[0])
        panel.axhspan(-3, 3, color=sv.figures.COLOURS[0], alpha=0.1)
        panel.set(ylabel=f"{name} / noise", ylim=(-5, 5))
        panel.grid(alpha=0.3)
    numbers = ", ".join(f"{n} = {found[n]:.4g} ± {found.deviation(n):.1g}" for n in found.names)
    axes[0].set_title(f"Measured less computed, relative to the noise: {numbers}", fontsize=11)
    axes[-1].set_xlabel("t [s]")
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main(save=sys.argv[1] if len(sys.argv) > 1 else None)
