"""The figure of a report: eigenvalues at rest, growth of errors, angles of the actuators, actuation with its limits."""

import numpy as np

from servoctl.figures import style

MOST_EFFORTS = 4  # panels of actuation in one figure


def draw_report(report):
    """Draw what a report holds, one panel for each part that it has.

    Parameters
    ----------
    report : Report

    Returns
    -------
    matplotlib.figure.Figure
    """
    present = {
        _growth: report.basis.internal is not None and report.basis.internal.until.size,
        _eigenvalues: report.basis.rest,
        _angles: report.directions is not None and report.directions.cosines,
    }
    parts = [(_effort, name) for name in list(report.efforts)[:MOST_EFFORTS]]
    parts = parts + [(draw, None) for draw, found in present.items() if found] or [(_orders, None)]
    rows = -(-len(parts) // 2)
    figure, axes = style.figure(0.7 + 2.8 * rows, rows=rows, columns=min(2, len(parts)))
    for ax, (draw, name) in zip(axes.flat, parts, strict=False):
        draw(ax, report, name)
    for ax in list(axes.flat)[len(parts) :]:
        ax.set_axis_off()
    figure.suptitle(f"{', '.join(report.residuals)}: {report.verdict}", fontsize=12)
    return figure


def _effort(ax, report, name):
    run, effort = report.run, report.efforts[name]
    ax.plot(run.t, run[name], color=style.COLOURS[0])
    ax.plot(effort.peak_at, effort.peak, "o", color=style.COLOURS[1], label=f"peak {effort.peak:.5g}")
    if effort.limit is not None:
        ax.axhline(effort.limit, color=style.COLOURS[6], linestyle="--", label=f"nearest limit {effort.limit:g}")
    style.finish(ax, xlabel="t [s]", ylabel=name, legend={})


def _growth(ax, report, _):
    t, growth = report.basis.internal.until
    ax.semilogy(t, growth, color=style.COLOURS[0])
    style.finish(ax, "largest growth of an error up to t", xlabel="t [s]", ylabel="growth of errors")


def _eigenvalues(ax, report, _):
    for (name, end), mark, colour in zip(report.basis.rest.items(), "ox", style.COLOURS, strict=False):
        label = f"at the {name}, t = {end.t:.4g} s"
        ax.plot(end.eigenvalues.real, end.eigenvalues.imag, mark, color=colour, label=label)
    ax.axvline(0.0, color=style.COLOURS[6], linewidth=1.0)
    reach = 1.2 * max(max(np.abs(end.eigenvalues).max(initial=0.0) for end in report.basis.rest.values()), 1e-300)
    limits = {"xlim": (-reach, reach), "ylim": (-reach, reach)}
    labels = {"xlabel": "real part [1/s]", "ylabel": "imaginary part [1/s]"}
    style.finish(ax, "eigenvalues of the internal dynamics at rest", legend={}, **limits, **labels)


def _angles(ax, report, _):
    degrees = np.degrees(np.arccos(np.clip(report.directions.cosines, 0.0, 1.0)))
    ax.bar(range(1, len(degrees) + 1), degrees, color=style.COLOURS[2], width=0.6)
    for place, value in enumerate(degrees, 1):
        ax.annotate(f"{round(value, 2):g}°", (place, value), ha="center", va="bottom")
    ax.set(ylim=(0, 105), yticks=(0, 30, 60, 90), xticks=range(1, len(degrees) + 1))
    title = "angles between actuators and normals of the program"
    style.finish(ax, title, xlabel="principal angle", ylabel="[°]")


def _orders(ax, report, _):
    facts = list(report.residuals.values())
    places = np.arange(len(facts))
    for shift, key, colour in ((-0.2, "order", 0), (0.2, "raised", 1)):
        ax.bar(places + shift, [fact[key] for fact in facts], 0.4, color=style.COLOURS[colour], label=key)
    title = "order of each residual, and how often it is raised"
    style.finish(ax, title, xticks=places, xticklabels=list(report.residuals), ylabel="derivatives", legend={})
