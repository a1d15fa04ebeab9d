"""Shared by all figures: colours, line styles, panels, legends, labels."""

import re

import numpy as np

from servoctl.checks import as_list, require_kind
from servoctl.units import with_unit

SOURCE = "matplotlib.pyplot.subplots()"

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # Okabe and Ito
MORE = ("#8C6D31", "#7F7F7F", "#5E3C99", "#882255", "#44AA99", "#B5BD00", "#FF7F9F")  # for more curves
STYLES = ("-", "--", ":", "-.")
FIGURE_WIDTH = 10.0  # inches: 1000 px at matplotlib's 100 dpi
BESIDE = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "frameon": False}  # a legend to the right of its panel


def figure(height, rows=1, columns=1, width=FIGURE_WIDTH, **options):
    """A figure outside pyplot, which leaves the user's backend unchanged, and its (rows, columns) array of Axes."""
    from matplotlib.figure import Figure

    empty = Figure(figsize=(width, height), dpi=100, layout="constrained")
    return empty, empty.subplots(rows, columns, squeeze=False, **options)


def panels(count, height, **options):
    """Axes one above the other in a new figure, with one time axis."""
    return figure(height, rows=count, sharex=True, **options)[1][:, 0]


def as_axes(ax):
    """An (n,) array of Axes from one or a sequence of them; (0,) from None."""
    from matplotlib.axes import Axes

    several = [] if ax is None else as_list(ax.ravel() if isinstance(ax, np.ndarray) else ax)
    return [require_kind(Axes, "ax", one, SOURCE) for one in ([ax] if several is None else several)]


def as_single_axes(ax, height, **options):
    """A given Axes, or one in a new figure."""
    from matplotlib.axes import Axes

    return panels(1, height, **options)[0] if ax is None else require_kind(Axes, "ax", ax, SOURCE)


def write_png(drawn, path):
    """Write a figure to a file, laid out and drawn once; `savefig` does both twice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(drawn).print_png(path)


def logarithmic(ax):
    """Powers of ten as 1e-12, without minor ticks: typesetting them takes longer than the rest of a figure."""
    from matplotlib.ticker import FuncFormatter, NullLocator

    ax.set_yscale("log")
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0e}"))


def look(i):
    """Colour and line style of the i-th curve."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": STYLES[i // len(COLOURS) % len(STYLES)]}


def label(text, unit):
    """A text with its unit in brackets, if there is one; powers are raised."""
    return with_unit(text, re.sub(r"\^(-?\d+)", r"$^{\1}$", unit))
