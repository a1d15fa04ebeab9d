"""The work-precision diagram of a trade-off."""

import numpy as np

from servoctl.figures import style

COLOURS = (*style.COLOURS, *style.MORE)
LOOKS = {  # line, marker and label of each treatment of drift
    "none": ("-", "o", "as it drifts"),
    "project": ("--", "s", "projected"),
    "minimal": (":", "^", "minimal coordinates"),
}
FRONT, UNRESOLVED, GREY = "#BBBBBB", "#EEEEEE", "#555555"


def draw_tradeoff(study, ax, cost, title):
    """Draw errors over a cost, with a line for each method and treatment, and the Pareto front."""
    ax = style.as_single_axes(ax, 5.0, width=8.0)
    good = np.isfinite(study["error"]) & np.isfinite(study["seconds"])
    methods, drifts = (list(dict.fromkeys(study[name][good].tolist())) for name in ("method", "drift"))
    colours = {method: COLOURS[i % len(COLOURS)] for i, method in enumerate(methods)}
    error, low = np.maximum(study["error"], study.uncertainty), max(study.uncertainty, 1e-17)
    for method, colour in colours.items():
        for drift in drifts:
            rows = good & (study["method"] == method) & (study["drift"] == drift)
            line, mark, _ = _look(drift)
            ax.plot(study[cost][rows], error[rows], line, marker=mark, color=colour, markersize=4, linewidth=1.1)
    front = study.pareto(cost)
    best = np.maximum(front["error"], study.uncertainty)
    ax.plot(front[cost], best, color=FRONT, linewidth=6, zorder=0, solid_capstyle="round")
    ax.scatter(front[cost], best, s=60, color=FRONT, zorder=0)
    ax.axhspan(low / 10, low, color=UNRESOLVED, zorder=-1)
    ax.set(xscale="log", yscale="log", xlabel=style.label(cost, "s" if cost == "seconds" else ""))
    ax.set(ylabel="error of the motion, relative", title=title)
    if not good.any():
        ax.set_xlim(1e-4, 1.0)
        ax.text(0.5, 0.5, "every run failed", transform=ax.transAxes, ha="center")
    ax.set_ylim(low / 10, min(3.0, max(10 * error[good].max(initial=low), 100 * low)))
    ax.grid(True, which="major", color="#DDDDDD", linewidth=0.6)
    ax.legend(handles=_keys(colours, drifts), loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8)
    return ax


def _look(drift):
    return LOOKS.get(drift, ("-.", "D", f"poles at -1/({drift} s)"))


def _keys(colours, drifts):
    from matplotlib.lines import Line2D

    keys = [Line2D([], [], color=colour, label=method) for method, colour in colours.items()]
    for drift in drifts:
        line, mark, words = _look(drift)
        keys.append(Line2D([], [], color=GREY, linestyle=line, marker=mark, markersize=4, label=words))
    keys.append(Line2D([], [], color=FRONT, linewidth=6, label="Pareto front"))
    keys.append(Line2D([], [], color=UNRESOLVED, linewidth=6, label="below the reference's\nown uncertainty"))
    return keys
