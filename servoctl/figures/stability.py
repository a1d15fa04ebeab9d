"""The figure of a stability map."""

import numpy as np

from servoctl.figures import style

SHADED_STEPS, SHADED_POLES, LINE = 120, 81, 3  # points of the shaded map; lines have every third pole
POLES = "poles of the error dynamics, 1/T [1/s]"
LEVELS = (0.0, 0.5, 0.8, 0.9, 0.95, 1.0, 1.05, 1.2, 1.5, 2.0)  # levels of the radius, fine near the bound of stability


def draw_stability(stability, method, poles, methods):
    """Draw largest steps of several methods over the poles, and the spectral radius of one over poles and steps."""
    length = abs(stability.t[-1] - stability.t[0])
    poles = np.geomspace(0.3, 300.0, SHADED_POLES) * 10 / length if poles is None else poles
    figure, ((left, right),) = style.figure(4.4, columns=2, sharex=True)
    _largest_steps(stability, left, poles, methods)
    _radius(stability, right, method, poles, left.get_ylim())
    return figure


def _largest_steps(stability, ax, poles, methods):
    poles = _fewer(poles)
    for colour, method in zip(style.COLOURS, methods, strict=False):
        steps = np.array([stability.largest_step(method, 1.0 / pole) for pole in poles])
        name = f"Taylor, order {stability.order}" if method == "Taylor" else method
        ax.loglog(poles, np.where(steps > 0, steps, np.nan), color=colour, label=name)
    style.finish(ax, "Largest stable step", xlabel=POLES, ylabel="step h [s]", legend={})


def _radius(stability, ax, method, poles, limits):
    from matplotlib.colors import BoundaryNorm

    steps = np.geomspace(*limits, SHADED_STEPS)
    radius = np.array([[stability.radius(method, h, 1.0 / pole).max() for pole in poles] for h in steps])
    norm = BoundaryNorm(LEVELS, 256)
    shade = ax.contourf(poles, steps, np.minimum(radius, LEVELS[-1]), LEVELS, cmap="RdBu_r", norm=norm)
    fewer = _fewer(poles)
    boundary = [stability.largest_step(method, 1.0 / pole) for pole in fewer]
    ax.plot(fewer, boundary, color="black", label="largest stable step")
    ax.set(xscale="log", yscale="log", ylim=limits)
    title = f"{method}: spectral radius of a step, at worst along the plan"
    style.finish(ax, title, xlabel=POLES, legend={"loc": "lower left"})
    ax.figure.colorbar(shade, ax=ax, label="factor per step (2: two or more)", ticks=LEVELS)


def _fewer(poles):
    """The poles of the lines, with the last."""
    return np.unique(np.append(poles[::LINE], poles[-1]))
