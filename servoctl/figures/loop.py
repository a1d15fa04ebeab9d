"""The figure of a closed loop: errors against the program and the plan, and inputs with their limits."""

import numpy as np

from servoctl.errors import SpecificationError
from servoctl.figures.names import units_in
from servoctl.figures.style import BESIDE, COLOURS, high, label, look, panels

LIMIT = "#A00000"


def closed(run, units=None):
    """Draw a closed loop: residuals of the program, deviations from the plan, inputs with plan and limits.

    Parameters
    ----------
    run : Closed
    units : dict of str to str, optional
        Unit of each coordinate and actuator, by name.

    Returns
    -------
    (n,) array of Axes

    Raises
    ------
    SpecificationError
        If the loop has no samples, or is not a closed loop.
    """
    if not hasattr(run, "commands"):
        kind = type(run).__name__
        raise SpecificationError(f"A {kind} was given.", do="Give a closed loop from sv.close.", type=kind)
    if not len(run.t):
        raise SpecificationError("The loop ended before its first sample.", do="See run.message.", samples=0)
    units = units_in(run, units)
    return draw_loop(run, units, panels(heights_of_loop(run, units)))


def heights_of_loop(run, units):
    """Height of each panel of a closed loop."""
    return [*(high(len(curves)) for _, curves in _errors(run, units)), *(high(4) for _ in run.plant.inputs)]


def draw_loop(run, units, axes):
    """Draw a closed loop in as many Axes."""
    errors = _errors(run, units)
    for ax, (text, curves) in zip(axes, errors, strict=False):
        for i, (name, values) in enumerate(curves.items()):
            ax.plot(run.t, values, label=name, **look(i))
        ax.set_ylabel(text)
    for ax, name in zip(axes[len(errors) :], run.plant.inputs, strict=True):
        _input(ax, run, name, units.get(name, ""))
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.margins(x=0.01)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(**BESIDE)
        if not run.success:
            _early_end(ax, run)
    axes[-1].set_xlabel("t [s]")
    return axes


def _early_end(ax, run):
    """Mark the end of a loop that failed; the frame is that of its first three quarters, as the rest may diverge."""
    until = run.t[0] + 0.75 * (run.t[-1] - run.t[0])
    drawn = np.concatenate([np.asarray(line.get_xydata(), dtype=float) for line in ax.get_lines()])
    early = drawn[drawn[:, 0] <= until, 1]
    room = max(0.3 * np.ptp(early), 1e-12)
    ax.set_ylim(early.min() - room, early.max() + room)
    ax.axvline(run.t[-1], color="black", linestyle="--", linewidth=1.2)


def _errors(run, units):
    """(label, {name: values}) of each panel of errors."""
    groups = []
    program = {n: v[0] for n, v in run.residual.items() if n not in run.plant.constraint_names()}
    for what, some in (
        ("residuals, SI", program.keys() - run.by_F),
        ("F − F along the plan, SI", program.keys() & run.by_F),
    ):
        groups += [(what, {n: v for n, v in program.items() if n in some})] * bool(some)
    by_unit = {}
    for name in run.plant.mechanism.q.names:
        if name in run.error:
            by_unit.setdefault(units.get(name, ""), {})[name] = run.error[name]
    return groups + [(label("off the plan", unit), errors) for unit, errors in by_unit.items()]


def _input(ax, run, name, unit):
    """The input of an actuator with its plan, its command where that differs, and its limits."""
    if run.plan is not None:
        ax.plot(*run.planned(name), "--", color="black", linewidth=0.9, zorder=3, label="plan")
    force, command = run.input[name], run.command[name]
    if not np.array_equal(force, command):
        ax.plot(run.t, command, color=COLOURS[1], linewidth=0.7, drawstyle="steps-post", label="command")
    ax.plot(run.t, force, color=COLOURS[0], linewidth=1.2, drawstyle="steps-post", label="input")
    low, high = run.plant.limits.get(name, (-np.inf, np.inf))
    limits = [limit for limit in (low, high) if np.isfinite(limit)]
    for limit in limits:
        ax.axhline(limit, color=LIMIT, linestyle=":", linewidth=1.4, label="limit" if limit == limits[0] else None)
    if limits:
        values = np.concatenate([force, limits])
        room = 0.15 * max(np.ptp(values), 1e-300)
        ax.set_ylim(values.min() - room, values.max() + room)
    ax.set_ylabel(label(name, unit))
