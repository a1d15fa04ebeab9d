"""Work-precision diagrams: of a trade-off, and of levels of modelling."""

from itertools import product
from textwrap import fill

import numpy as np

from servoctl.figures import style

COLOURS = (*style.COLOURS, *style.MORE)
LOOKS = {  # line, marker and label of each treatment of drift
    "none": ("-", "o", "as it drifts"),
    "project": ("--", "s", "projected"),
}
MARKS = ("o", "s", "^", "D", "v", "P", "X")
AXIS_MARGIN = 1.5  # from the cheapest and the dearest row to the ends of the axis: small differences look small
OF = {
    "error": "error of the motion",
    "modelling": "error of modelling",
    "actuation": "error of the actuation",
    "in_loop": "error in the loop",
}
FRONT, OTHER, UNRESOLVED, GREY = "#FFE08A", "#BBBBBB", "#EEEEEE", "#555555"


def draw_tradeoff(study, ax, cost, title):
    """Draw errors over a cost: a line for each method and treatment, in colour where it reaches the Pareto front."""
    ax = style.as_single_axes(ax, 5.0, width=8.0)
    good = np.isfinite(study["error"]) & np.isfinite(study[cost])
    methods, drifts = (list(dict.fromkeys(study[name][good].tolist())) for name in ("method", "drift"))
    error, low = np.maximum(study["error"], study.uncertainty), max(study.uncertainty, 1e-17)
    front = study.pareto(cost)
    best = set(zip(front["method"].tolist(), front["drift"].tolist(), strict=True))
    reaching = [method for method in methods if any((method, drift) in best for drift in drifts)]
    colours = {method: COLOURS[i % len(COLOURS)] for i, method in enumerate(reaching)}
    for method, drift in product(methods, drifts):
        rows, on = good & (study["method"] == method) & (study["drift"] == drift), (method, drift) in best
        line, mark, _ = _look(drift)
        look = {"color": colours[method] if on else OTHER, "linewidth": 1.4 if on else 0.8, "zorder": 3 if on else 2}
        ax.plot(study[cost][rows], error[rows], line, marker=mark, markersize=4, **look)
    reached = np.maximum(front["error"], study.uncertainty)
    ax.plot(front[cost], reached, color=FRONT, linewidth=7, zorder=0, solid_capstyle="round")
    ax.scatter(front[cost], reached, s=70, color=FRONT, zorder=0)
    ax.axhspan(low / 10, low, color=UNRESOLVED, zorder=-1)
    ax.set(xscale="log", yscale="log", xlabel=style.label(cost, "s" if cost == "seconds" else ""))
    ax.set(ylabel="error of the motion, relative", title=title)
    if not good.any():
        ax.set_xlim(1e-4, 1.0)
        ax.text(0.5, 0.5, "every run failed", transform=ax.transAxes, ha="center")
    ax.set_ylim(low / 10, min(3.0, max(10 * error[good].max(initial=low), 100 * low)))
    ax.grid(True, which="major", color="#DDDDDD", linewidth=0.6)
    others = [method for method in methods if method not in colours]
    keys = _keys(colours, others, drifts)
    ax.legend(handles=keys, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8)
    return ax


def draw_levels(study, ax, cost, of, title):
    """Draw errors of levels of modelling over a cost: the front of all levels in colour, other rows in grey."""
    ax = style.as_single_axes(ax, 5.0, width=8.0)
    floor = max(study._floor(of), 1e-17)
    good = np.isfinite(study[of]) & np.isfinite(study[cost])
    front = study.pareto(cost, of)
    for i, level in enumerate(dict.fromkeys(study["level"][good].tolist())):
        rows, best = study.take(np.flatnonzero(good & (study["level"] == level))), front.where(level=level)
        look = {"marker": MARKS[i % len(MARKS)], "linestyle": "", "markersize": 7}
        names = (None, level) if len(best) else (level, None)
        ax.plot(rows[cost], np.maximum(rows[of], floor), **look, color=OTHER, markerfacecolor="none", label=names[0])
        ax.plot(best[cost], np.maximum(best[of], floor), **look, color=COLOURS[i % len(COLOURS)], label=names[1])
    ax.step(front[cost], np.maximum(front[of], floor), where="post", color=OTHER, linewidth=1.2, zorder=0)
    ax.axhspan(floor / 10, floor, color=UNRESOLVED, zorder=-1, label="not resolved")
    ax.set(xscale="log", yscale="log", xlabel=style.label(cost, "s" if cost == "seconds" else ""), title=title)
    ax.set(ylabel=f"{OF[of]}, relative", ylim=(floor / 10, max(3.0 * study[of][good].max(initial=floor), 100 * floor)))
    ax.set_xlim(study[cost][good].min(initial=1.0) / AXIS_MARGIN, study[cost][good].max(initial=1e-4) * AXIS_MARGIN)
    if not good.any():
        ax.text(0.5, 0.5, "no level has numbers", transform=ax.transAxes, ha="center")
    ax.grid(True, which="major", color="#DDDDDD", linewidth=0.6)
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8, title="filled: on the front")
    return ax


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
