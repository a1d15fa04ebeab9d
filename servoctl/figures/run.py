"""Figures of a run: path, signals, actuation and residuals, each returning matplotlib's Axes.

Units are those of the mechanism; `units` has others by name, and those of derivatives follow. Without `ax` a figure is
made outside pyplot, which leaves the user's backend unchanged: `ax.figure.savefig(...)`. For a window or a notebook
give `ax=plt.subplots()[1]`.
"""

import numpy as np

from servoctl.archive import writing
from servoctl.checks import require_kind, text, texts
from servoctl.errors import SpecificationError
from servoctl.figures.names import along_one_axis, coordinates, efforts, label_of, planes, units_in
from servoctl.figures.style import (
    BESIDE,
    COLOURS,
    PANEL,
    STYLES,
    as_panels,
    as_single_axes,
    finish,
    high,
    logarithmic,
    look,
    write_png,
)
from servoctl.run import CLOSED_LOOP, Run
from servoctl.spec.shapes import heights
from servoctl.units import unit_of

SOURCE = "sv.simulate(...) or sv.load(path)"
LEAST = 1e-18  # residual drawn for exact zeros on the logarithmic scale
BINS = 100  # bins of time, each drawn by the greatest magnitude in it: rounding becomes a line
LAST, UNBOUNDED = 0.01, 2.0  # a signal that doubles its range in the last hundredth of a stopped run leaves the frame
FLAT = 1e-9  # variation relative to the largest value of the same unit below which it is rounding
VISIBLE = 1e-14  # magnitude relative to the largest value of any unit, in SI, below which it is rounding


def path(run, x=None, y=None, ax=None, units=None):
    """Draw one signal over another, with the start and end of the run.

    Parameters
    ----------
    run : Run
    x, y : str, optional
        Names of signals. Default: two of x, y, z (or X, Y, Z, preferred) with the same prefix and suffix, such as
        "x" and "z" or "tip_x" and "tip_y", among outputs and coordinates; else the first two coordinates. A single
        coordinate, or coordinates along one axis, such as "x1" and "x2", are drawn over time. Of three axes the
        vertical one is drawn, where the balance at rest shows which that is; an axis that measures depth points down.
    ax : Axes, optional
    units : dict of str to str, optional
        Signals of the same unit have equal scales if both remain visible.

    Returns
    -------
    Axes

    Raises
    ------
    NameUnknown
        If there is no such signal.
    """
    require_kind(Run, "run", run, SOURCE)
    groups, names, units = planes(run), coordinates(run), units_in(run, units)
    if x is None and y is None and not groups and along_one_axis(names):
        return signals(run, names, ax=as_single_axes(ax, 4.2), units=units)
    first, second, *_ = groups[0] if groups else dict.fromkeys([*names, *run.names])
    if x is None and y is None and groups:
        first, second = _upright(run, groups[0])
    x = (first if y != first else second) if x is None else x
    y = (second if x != second else first) if y is None else y
    across, up = run[x], run[y]
    ax = as_single_axes(ax, 6.0)
    ax.plot(across, up, color=COLOURS[0])
    ax.plot(across[0], up[0], "o", color=COLOURS[0], markerfacecolor="white", label=f"start, t = {run.t[0]:.4g} s")
    word = _ending(run)
    ax.plot(across[-1], up[-1], "s" if run.success else "X", color=COLOURS[1], label=f"{word}, t = {run.t[-1]:.4g} s")
    finish(ax, xlabel=label_of([x], units), ylabel=label_of([y], units), legend={})
    spans = sorted(float(np.ptp(v[np.isfinite(v)])) if np.isfinite(v).any() else 0.0 for v in (across, up))
    if unit_of(x, units) and unit_of(x, units) == unit_of(y, units) and spans[1] <= 5 * spans[0]:
        ax.set_aspect("equal", adjustable="datalim")
    if _height(run, [x, y])[1] < 0:
        ax.invert_yaxis()
    return ax


def _height(run, names):
    """For each signal 1 if it measures height, -1 if depth, 0 if neither is certain or it is no position."""
    own = () if run.model is None else (*run.model.reduction.mechanism.q.names, *run.model.outputs)
    if not len(run.t) or not set(names) <= set(own):
        return [0] * len(names)
    model = run.model
    return heights(model.reduction.mechanism, names, run.t, run.jets[: model.nq], model.parameters, model.paths)


def _upright(run, names):
    """Two of the names of a point's axes: the vertical one last, if there is one."""
    vertical = [name for name, sign in zip(names, _height(run, names), strict=True) if sign]
    if len(names) < 3 or not vertical:
        return names[:2]
    level = [name for name in names if name not in vertical]
    return max(level, key=lambda name: np.ptp(run[name])), vertical[0]


def signals(run, *names, ax=None, units=None):
    """Draw signals over time, by default the coordinates.

    Parameters
    ----------
    run : Run
    *names : str or sequence of str
    ax : Axes or sequence of Axes, optional
        One Axes for all signals, or one for each panel. Default: a new figure with one panel for all signals of the
        same unit, and one for each signal of unknown unit.
    units : dict of str to str, optional

    Returns
    -------
    Axes or (n,) array of Axes
        An Axes if `ax` is one, else an array.

    Raises
    ------
    NameUnknown
        If there is no such signal.
    SpecificationError
        If the number of Axes is not that of the panels.
    """
    require_kind(Run, "run", run, SOURCE)
    units = units_in(run, units)
    names = [name for given in names or coordinates(run) for name in texts(given, "The names of signals")]
    if not names:
        raise SpecificationError("No signal was named.", do="Leave names out for the coordinates.", names=names)
    return over_time(run, by_unit(names, units), ax, units)


def by_unit(names, units):
    """Groups of names of signals of the same unit; one of unknown unit is alone."""
    groups = {}
    for name in names:
        groups.setdefault(unit_of(name, units) or (name,), []).append(name)
    return list(groups.values())


def actuation(run, ax=None, units=None, names=None):
    """Draw the required actuation, of all actuators or of the ideal reaction, over time with its extrema.

    Parameters
    ----------
    run : Run
    ax : Axes or sequence of Axes, optional
        One Axes for all signals, or one for each. Default: a new figure with a panel for each.
    units : dict of str to str, optional
        Units of an ideal reaction follow from those of the coordinates (m: N; rad: N m).
    names : sequence of str, optional
        Default: the actuators, or all `reaction_*` of an ideal program; for a loaded run, which does not distinguish
        actuators and outputs, both.

    Returns
    -------
    Axes or (n,) array of Axes
        An Axes if `ax` is one, else an array.

    Raises
    ------
    NameUnknown
        If there is no such signal.
    SpecificationError
        If there is no actuation, or the number of Axes is not that of the panels.
    """
    require_kind(Run, "run", run, SOURCE)
    names = efforts(run) if names is None else texts(names, "The names of signals")
    if not names:
        raise SpecificationError(
            "The run has no actuation.",
            "It needs a model, or stored signals.",
            do="Give names of signals.",
            names=run.names,
        )
    return over_time(run, [[name] for name in names], ax, units_in(run, units), extrema=True)


def residuals(run, ax=None):
    """Draw the magnitude of every constraint's residual at every level, on a logarithmic scale.

    Each constraint has a colour, each level (the residual and its derivatives) a line style. Each point is the greatest
    magnitude within 1/100 of the run, at least 1e-18.

    Parameters
    ----------
    run : Run
    ax : Axes, optional

    Returns
    -------
    Axes
    """
    require_kind(Run, "run", run, SOURCE)
    ax = as_single_axes(ax, 5.0)
    bins = np.array_split(np.arange(len(run.t)), min(BINS, len(run.t)))
    t = np.array([run.t[rows].mean() for rows in bins])
    levels, top = 0, LEAST
    for i, name in enumerate(run.residual):
        values = np.maximum(np.abs(run.residual[name]), LEAST)
        levels = max(levels, len(values))
        for j, row in enumerate(values):
            worst = np.array([row[rows].max() for rows in bins])
            top = max(top, worst[np.isfinite(worst)].max(initial=LEAST))
            ax.plot(t, worst, STYLES[j % len(STYLES)], color=COLOURS[i % len(COLOURS)], linewidth=1.0 if j else 1.8)
    logarithmic(ax)
    finish(ax, xlabel="t [s]", ylabel="|residual|, SI (1e-18: zero)", ylim=(LEAST / 2, max(10 * top, 1e-12)))
    _instants(run, [ax])
    _end(run, [ax])
    _keys(ax, list(run.residual), levels, run.method.startswith(CLOSED_LOOP))
    return ax


def save_figures(run, folder, units=None, title=""):
    """Write path.png, coordinates.png, actuation.png and residuals.png, each 1000 px wide.

    Parameters
    ----------
    run : Run
    folder : str or Path
        Made if it is missing.
    units : dict of str to str, optional
    title : str, optional
        Title of each figure.

    Returns
    -------
    list of Path
        The files; without path.png, actuation.png or residuals.png if the run has no positions in a plane, no
        actuation, or no residuals.

    Raises
    ------
    ServoError
        If the folder cannot be written.
    """
    require_kind(Run, "run", run, SOURCE)
    text("title", title)
    draws = {
        "path": path if planes(run) else None,
        "coordinates": signals,
        "actuation": actuation if efforts(run) else None,
        "residuals": (lambda run, units: residuals(run)) if len(run.residual) else None,
    }
    drawn = {name: draw(run, units=units) for name, draw in draws.items() if draw}
    files = []
    with writing(folder, "figures", folder=True) as folder:
        for name, axes in drawn.items():
            figure = np.ravel(axes)[0].figure
            figure.suptitle(f"{title}: {name}" if title else name)
            files.append(folder / f"{name}.png")
            write_png(figure, files[-1])
    return files


def over_time(run, groups, ax, units, extrema=False):
    """Draw groups of signals: one panel for each, or all in `ax` if that is a single Axes."""
    single = hasattr(ax, "plot")
    if single:
        groups = [[name for group in groups for name in group]]
    axes = as_panels(ax, [max(high(len(group)), 2 * PANEL / len(groups)) for group in groups])  # a single one is higher
    largest = _largest(run, [name for group in groups for name in group], units)
    for panel, group in zip(axes, groups, strict=True):
        mixed = len({unit_of(name, units) for name in group}) > 1
        for i, name in enumerate(group):
            panel.plot(run.t, run[name], label=label_of([name], units if mixed else {}), **look(i))
        of_unit = max(largest[unit_of(name, units)] for name in group)
        _frame(panel, run, group, max(largest.values()) if of_unit < VISIBLE * max(largest.values()) else of_unit)
        finish(panel, ylabel=label_of(group, units))
        if len(group) > 1:
            panel.legend(**BESIDE)
        if extrema:
            panel.set_title("\n".join(extrema_text(run, name, units) for name in group), fontsize="small", loc="left")
    axes[-1].set_xlabel("t [s]")
    _instants(run, axes)
    _end(run, axes)
    return axes[0] if single else axes


def _largest(run, names, units):
    """Greatest magnitude among the signals of each unit."""
    largest = {}
    for name in names:
        values = np.abs(run[name])
        unit = unit_of(name, units)
        largest[unit] = max(largest.get(unit, 0.0), values[np.isfinite(values)].max(initial=0.0))
    return largest


def _frame(ax, run, names, largest):
    """Limits of a panel that neither rounding fills nor a divergence before a stop flattens."""
    values = np.concatenate([run[name] for name in names])
    values = values[np.isfinite(values)]
    if values.size and np.ptp(values) < FLAT * largest:
        middle = (values.min() + values.max()) / 2
        ax.set_ylim(middle - largest / 10, middle + largest / 10)
    if run.success or len(run.t) < 3:
        return
    before = np.abs(run.t[-1] - run.t) > LAST * abs(run.t[-1] - run.t[0])
    early = np.concatenate([run[name][before] for name in names])
    early = early[np.isfinite(early)]
    if early.size and np.ptp(values) > UNBOUNDED * np.ptp(early) > 0:
        ax.set_ylim(early.min() - np.ptp(early) / 2, early.max() + np.ptp(early) / 2)


def extrema_text(run, name, units):
    """The least and the greatest value of a signal, with their instants."""
    if not np.all(np.isfinite(run[name])):
        return f"{name}: not finite at some instants"
    unit = unit_of(name, units)
    low, high = (f"{value + 0.0:.6g} {unit}".strip() + f" (t = {t:.4g} s)" for t, value in run.extrema(name))
    return f"{name}: {low} to {high}"


def _instants(run, axes):
    """Faint vertical lines at the breaks of paths and at switches."""
    for ax in axes:
        for knot in run.knots:
            if min(run.t[0], run.t[-1]) <= knot <= max(run.t[0], run.t[-1]):
                ax.axvline(knot, color="grey", alpha=0.35, linewidth=0.8, zorder=0)


def _ending(run):
    if run.success:
        return "end"
    return "interrupted" if run.status == 1 else "stopped"


def _end(run, axes):
    """Mark where a run stopped early."""
    if run.success:
        return
    for ax in axes:
        ax.axvline(run.t[-1], color="black", linestyle="--", linewidth=1.2)
    axes[0].set_title(f"{_ending(run)} after t = {run.t[-1]:.6g} s", fontsize="small", loc="right")


def _keys(ax, names, levels, looped):
    """Legends beside the panel: a colour for each constraint, a line style for each level, in loops also those of F."""
    from matplotlib.lines import Line2D

    colours = [Line2D([], [], color=COLOURS[i % len(COLOURS)], label=name) for i, name in enumerate(names)]
    words = ["residual" + ", or F − F along the plan" * looped, "1st derivative" + ", or k-th quotient of F" * looped]
    words += ["2nd derivative", "3rd derivative", *(f"{j}th derivative" for j in range(4, levels))]
    styles = [
        Line2D([], [], color="black", linestyle=STYLES[j % len(STYLES)], label=words[j])
        for j in range(levels if levels > 1 else 0)
    ]
    ax.legend(handles=[*colours, *styles], fontsize="small", **BESIDE)
