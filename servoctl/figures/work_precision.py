"""Work-precision diagrams: errors of models, methods and treatments of drift over their cost."""

import itertools
from textwrap import fill

import numpy as np

from servoctl.figures import style

COLOURS = (*style.COLOURS, *style.MORE)
LOOKS = {  # line, marker and label of each treatment of drift
    "none": ("-", "o", "as it drifts"),
    "project": ("--", "s", "projected"),
}
AXIS_MARGIN = 1.5  # from the cheapest and the dearest row to the ends of the axis: small differences look small
FRONT, OTHER, UNRESOLVED, GREY = "#FFE08A", "#BBBBBB", "#EEEEEE", "#555555"
LINES = ("model", "method", "drift")  # columns that tell the lines apart


def draw_tradeoff(study, ax, cost, title, of):
    """Draw errors over a cost: a line for each model, method and treatment, in colour if it reaches the Pareto front.

    The colour is that of the model where there are several, else that of the method.
    """
    ax = style.as_single_axes(ax, 5.0, width=8.0)
    floor = study.meta["reference"][of]
    good, front = study.take(np.flatnonzero(np.isfinite(study[of]) & np.isfinite(study[cost]))), study.pareto(cost, of)
    lines, best = _lines(good), _lines(front)
    key = 0 if len(study.meta["models"]) > 1 else 1
    kinds, reaching = (dict.fromkeys(line[key] for line in some) for some in (lines, best))
    colours = dict(zip((kind for kind in kinds if kind in reaching), itertools.cycle(COLOURS), strict=False))
    for line in lines:
        rows, on = good.where(**dict(zip(LINES, line, strict=True))), line in best
        form, mark, _ = _look(line[-1])
        look = {"color": colours[line[key]] if on else OTHER, "linewidth": 1.4 if on else 0.8, "zorder": 3 if on else 2}
        ax.plot(rows[cost], np.maximum(rows[of], floor), form, marker=mark, markersize=4, **look)
    reached = np.maximum(front[of], floor)
    ax.plot(front[cost], reached, color=FRONT, linewidth=7, zorder=0, solid_capstyle="round")
    ax.scatter(front[cost], reached, s=70, color=FRONT, zorder=0)
    _name_front(ax, front[LINES[key]].tolist(), front[cost], reached, colours)
    ax.set(xscale="log", yscale="log", xlabel=style.label(cost, "s" if cost == "seconds" else ""), title=title)
    ax.set(ylabel=f"error of the {'motion' if of == 'error' else of}, relative")
    low, high = good[cost].min(initial=1.0), good[cost].max(initial=1e-4)
    ax.set_xlim(low / AXIS_MARGIN * (low / high) ** 0.15, high * AXIS_MARGIN)  # with room for names beside the front
    if not len(good):
        ax.text(0.5, 0.5, "every run failed", transform=ax.transAxes, ha="center")
    least = max(floor, 1e-17)
    ax.axhspan(least / 10, least, color=UNRESOLVED, zorder=-1)
    ax.set_ylim(least / 10, min(3.0, max(10 * good[of].max(initial=least), 100 * least)))
    ax.grid(True, which="major", color="#DDDDDD", linewidth=0.6)
    keys = _keys(colours, [kind for kind in kinds if kind not in colours], dict.fromkeys(drift for *_, drift in lines))
    ax.legend(handles=keys, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8)
    return ax


def _name_front(ax, names, costs, errors, colours):
    """Write each name once, left of and below its cheapest point, where by definition nothing is drawn."""
    for name in dict.fromkeys(names):
        at, place = names.index(name), {"textcoords": "offset points", "ha": "right", "va": "top"}
        ax.annotate(name, (costs[at], errors[at]), (-6, -2), color=colours[name], fontsize=9, **place)


def _lines(study):
    """(model, method, drift) of the rows, each once."""
    return list(dict.fromkeys(zip(*(study[name].tolist() for name in LINES), strict=True)))


def _look(drift):
    return LOOKS.get(drift, ("-.", "D", f"poles at -1/({drift} s)"))


def _keys(colours, others, drifts):
    from matplotlib.lines import Line2D

    keys = [Line2D([], [], color=colour, label=method) for method, colour in colours.items()]
    if others:
        keys.append(Line2D([], [], color=OTHER, label=fill("never best: " + ", ".join(others), 22)))
    for drift in drifts:
        line, mark, words = _look(drift)
        keys.append(Line2D([], [], color=GREY, linestyle=line, marker=mark, markersize=4, label=words))
    keys.append(Line2D([], [], color=FRONT, linewidth=6, label="Pareto front"))
    keys.append(Line2D([], [], color=UNRESOLVED, linewidth=6, label="below the reference's\nown uncertainty"))
    return keys
