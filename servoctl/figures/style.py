"""Shared by all figures: colours, line styles, panels and their layout, legends, labels."""

import functools
import re

import numpy as np

from servoctl.checks import as_list, require_kind
from servoctl.errors import SpecificationError
from servoctl.units import with_unit

SOURCE = "matplotlib.pyplot.subplots()"

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # Okabe and Ito
MORE = ("#8C6D31", "#7F7F7F", "#5E3C99", "#882255", "#44AA99", "#B5BD00", "#FF7F9F")  # for more curves
TICKS = 6  # intervals of a time axis, at most
STYLES = ("-", "--", ":", "-.")
FIGURE_WIDTH = 10.0  # inches: 1000 px at matplotlib's 100 dpi
PANEL, ENTRY = 1.5, 0.22  # inches: height of a panel, of an entry of its legend
LEFT, BELOW, LABEL = 1.1, 0.5, 0.85  # inches: for ticks and labels beside and below a panel, from its label to the axis
TITLE, PAD = 0.2, 0.08  # inches: a line of a title, a gap
BESIDE = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "frameon": False}  # a legend to the right of its panel


def figure(height, rows=1, columns=1, width=FIGURE_WIDTH, **options):
    """A figure outside pyplot, which leaves the user's backend unchanged, and its (rows, columns) array of Axes."""
    from matplotlib.figure import Figure

    empty = Figure(figsize=(width, height), dpi=100, layout=column() if columns == 1 else "constrained")
    return empty, empty.subplots(rows, columns, squeeze=False, **options)


@functools.cache
def column():
    """A layout of panels one above the other, of which legends and titles alone are measured.

    matplotlib's "constrained", which measures every text several times, takes longer than drawing.
    """
    from matplotlib.layout_engine import LayoutEngine

    class Column(LayoutEngine):
        _adjust_compatible = _colorbar_gridspec = True

        def __reduce__(self):
            return column, ()

        def execute(self, fig):
            renderer, (width, height) = fig._get_renderer(), fig.get_size_inches()
            legends = [ax.get_legend() for ax in fig.axes if ax.get_legend()]
            beside = [legend.get_window_extent(renderer).x1 - legend.axes.bbox.x1 for legend in legends]
            left = LEFT if any(ax.axison for ax in fig.axes) else 2 * PAD
            across = width - left - PAD - max([PAD, *(part / fig.dpi for part in beside)])
            titles = [text for text in fig.texts if text.get_text() and text.get_text() == fig.get_suptitle()]
            top = height - sum(PAD + text.get_window_extent(renderer).height / fig.dpi for text in titles)
            for text in titles:
                text.set_y(1 - PAD / height)
            rows = {ax: ax.get_subplotspec().rowspan.start for ax in fig.axes if ax.get_subplotspec()}
            shares = np.array(fig.axes[0].get_gridspec().get_height_ratios(), dtype=float)
            above = np.full(len(shares), PAD + TITLE)
            for ax, row in rows.items():
                above[row] = max(above[row], PAD + TITLE * _title_lines(ax))
            up = shares / shares.sum() * (top - above.sum() - BELOW)
            low = top - np.cumsum(above + up)
            for ax, row in rows.items():
                ax.set_position([left / width, low[row] / height, across / width, up[row] / height])
                ax.set_in_layout(True)  # which `set_position` ends
                if ax.get_aspect() == "auto":
                    ax.yaxis.set_label_coords(-LABEL / across, 0.5)

    return Column()


def _title_lines(ax):
    return max(len(ax.get_title(place).splitlines()) for place in ("left", "center", "right"))


def panels(heights, **options):
    """Axes one above the other with heights [inches] and one time axis, in a new figure."""
    height = sum(heights) + (PAD + TITLE) * (len(heights) + 1) + BELOW
    axes = figure(height, rows=len(heights), sharex=True, height_ratios=heights, **options)[1][:, 0]
    axes[0].locator_params("x", nbins=TICKS)  # of all: making its ticks takes most of the time of a panel
    return axes


def finish(ax, title="", legend=None, **labels):
    """Labels and limits of a panel, its title, a faint grid, and its legend where that has a place: {} for the best."""
    ax.set(**labels)
    ax.grid(alpha=0.3)
    if title:
        ax.set_title(title, fontsize=10)
    if legend is not None:
        ax.legend(fontsize=9, **legend)


def high(entries):
    """Height of a panel with so many entries of its legend [inches]."""
    return max(PANEL, ENTRY * entries)


def as_panels(ax, heights):
    """An array of Axes from one or a sequence of them, or in a new figure: one for each of the heights [inches]."""
    from matplotlib.axes import Axes

    if ax is None:
        return panels(heights)
    several = as_list(ax.ravel() if isinstance(ax, np.ndarray) else ax)
    axes = [require_kind(Axes, "ax", one, SOURCE) for one in ([ax] if several is None else several)]
    if len(axes) != len(heights):
        raise SpecificationError(
            f"{len(axes)} Axes were given.",
            f"There are {len(heights)} panels.",
            do="Give as many Axes as panels.",
            axes=len(axes),
            panels=len(heights),
        )
    return np.array(axes)


def as_single_axes(ax, height, **options):
    """A given Axes, or one in a new figure."""
    from matplotlib.axes import Axes

    return figure(height, **options)[1][0, 0] if ax is None else require_kind(Axes, "ax", ax, SOURCE)


def write_png(drawn, path):
    """Write a figure to a file, laid out and drawn once; `savefig` does both twice, and packs more tightly."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(drawn).print_png(path, pil_kwargs={"compress_level": 1})


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
