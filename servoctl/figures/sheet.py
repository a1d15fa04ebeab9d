"""The sheet of a run: coordinates, actuation, residuals and the closed loop, one above the other."""

from servoctl.figures.loop import draw_loop, heights_of_loop
from servoctl.figures.names import coordinates, efforts, units_in
from servoctl.figures.run import actuation, by_unit, extrema_text, over_time, residuals
from servoctl.figures.style import high, panels


def draw_sheet(run, loop, title):
    """Draw a run and its closed loop, if there is one; returns the figure.

    A loop that was not lost shows the required actuation beneath its inputs; else it has panels of its own.
    """
    units, kept = units_in(run, None), loop is not None and loop.success
    groups, levels = by_unit(coordinates(run), units), max(map(len, run.residual.values()), default=0)
    forces = [name for name in efforts(run) if not (kept and name in loop.plant.inputs)]
    heights = [*(high(len(group)) for group in groups), *(high(1) for _ in forces)]
    heights += [max(2.0, high(len(run.residual) + levels))] * bool(levels)  # its label is long
    axes = panels(heights + ([] if loop is None else heights_of_loop(loop, units)))
    of_run, of_loop = axes[: len(heights)], axes[len(heights) :]
    over_time(run, groups, of_run[: len(groups)], units)
    if forces:
        actuation(run, of_run[len(groups) : len(groups) + len(forces)], names=forces)
    if levels:
        residuals(run, of_run[-1])
    if loop is not None:
        draw_loop(loop, units, of_loop)
        of_loop[0].set_title(f"closed loop: {loop.law.name}, {loop.law.rate:g} Hz", fontsize="small", loc="right")
        for ax, name in zip(of_loop[::-1], loop.plant.inputs[::-1] if kept else (), strict=False):
            ax.set_title(f"plan: {extrema_text(run, name, units)}", fontsize="small", loc="left")
    for ax in axes[:-1]:
        ax.set_xlabel("")
    for line in (line for ax in axes for line in ax.get_lines() if len(line.get_xdata()) == 1):
        line.set_marker("o")  # of a run of one sample
    axes[0].figure.suptitle(title)
    return axes[0].figure
