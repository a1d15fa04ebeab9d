"""What makes a drawn figure hard to read: texts over each other, texts cut at the edge, panels without data."""

from itertools import combinations

from matplotlib.text import Text

SLACK = 2.0  # px that boxes of texts may share: they are higher than their letters


def faults(figure):
    """Sentences about texts of a drawn figure that overlap or are cut, and about empty panels."""
    edge, texts = figure.bbox, _texts(figure)
    cut = [f"{text!r} is cut" for text, box in texts if not _inside(box, edge)]
    over = [f"{a!r} over {b!r}" for (a, first), (b, second) in combinations(texts, 2) if _overlap(first, second)]
    return cut + over + [f"panel {ax.get_title() or ax.get_ylabel()!r} is empty" for ax in figure.axes if _empty(ax)]


def _texts(figure):
    """(text, box in px) of what is visible; ticks outside the limits are not drawn."""
    ticks = {label for ax in figure.axes for axis in _axes(ax) for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks())
             for label in (tick.label1, tick.label2)}  # fmt: skip
    drawn = {label for ax in figure.axes for axis in _axes(ax) for tick in axis._update_ticks()
             for label in (tick.label1, tick.label2)}  # fmt: skip
    hidden = ticks - drawn
    hidden |= {part for ax in figure.axes if not ax.axison for axis in _axes(ax) for part in axis.findobj(Text)}
    found = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip() and text not in hidden]
    return [(text.get_text(), text.get_window_extent()) for text in found]


def _axes(ax):
    return [axis for name in ("xaxis", "yaxis", "zaxis") if (axis := getattr(ax, name, None)) is not None]


def _inside(box, edge):
    return (box.x0 >= edge.x0 - SLACK and box.x1 <= edge.x1 + SLACK
            and box.y0 >= edge.y0 - SLACK and box.y1 <= edge.y1 + SLACK)  # fmt: skip


def _overlap(a, b):
    return min(a.x1, b.x1) - max(a.x0, b.x0) > SLACK and min(a.y1, b.y1) - max(a.y0, b.y0) > SLACK


def _empty(ax):
    return ax.axison and ax.get_visible() and not any(
        artist.get_visible() for artist in (*ax.lines, *ax.collections, *ax.patches, *ax.images)
    )
