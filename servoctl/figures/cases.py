"""The figure of a sweep: distributions of results, and their dependence on parameters."""

import numpy as np

from servoctl.checks import texts
from servoctl.errors import SpecificationError
from servoctl.figures import style
from servoctl.units import as_units, unit_of_column

MOST_RESULTS = 4  # results in one figure
DRAWN_EACH = 20  # results below which each is drawn: percentiles say little of them
SHARES = {5: "--", 50: "-", 95: ":"}  # percentiles


def sweep(study, names=None, against=None, units=None):
    """Draw results of a sweep: histograms with percentiles, and each result over a parameter.

    Parameters
    ----------
    study : Study
        From `sweep`.
    names : sequence of str, optional
        Columns; default: the first four results that vary.
    against : str, optional
        Column of the horizontal axis; default: for each result the parameter with the largest rank correlation.
    units : dict of str to str, optional
        Unit of each column, by name.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    NameUnknown
        If there is no such column.
    SpecificationError
        If no result varies, or the study is not a sweep.
    """
    if getattr(study, "kind", None) != "sweep":
        kind = f"Study of the kind {study.kind}" if hasattr(study, "kind") else type(study).__name__
        raise SpecificationError(f"A {kind} was given.", do="Give a study from sv.sweep.", kind=kind)
    parameters = [name for name in study.meta["parameters"] if _varies(study, name)]
    results = [name for name in study.columns if name not in ("case", *study.meta["parameters"])]
    varying = [name for name in results if _varies(study, name)]
    names = varying[:MOST_RESULTS] if names is None else texts(names, "The columns")
    if not names:
        raise SpecificationError(
            f"No result varies among the {len(study)} rows.",
            "The figure shows numbers that differ between cases.",
            do="See study.rows(); the column error has what failed.",
            rows=len(study),
        )
    if against is not None:
        study.column(against)
    units = study.units | as_units(units)
    figure, rows = style.figure(0.6 + 2.5 * len(names), rows=len(names), columns=2)
    for name, axes in zip(names, rows, strict=True):
        values = np.asarray(study[name], dtype=float)
        _histogram(axes[0], values, style.label(name, unit_of_column(name, units)))
        by = against or _strongest(study, parameters, values)
        _scatter(axes[1], study[by], values, study["error"] != "")
        x, y = (style.label(column, unit_of_column(column, units)) for column in (by, name))
        axes[1].set(xlabel=x, ylabel=y)
    figure.suptitle(f"{study.meta['case']}: {study.meta['message']}", fontsize=11)
    return figure


def _histogram(ax, values, label):
    """Draw how often results fall into bins, with percentiles; each result of few cases as a point."""
    values = values[np.isfinite(values)]
    if len(values) < DRAWN_EACH:
        ax.plot(np.sort(values), np.arange(1, len(values) + 1), "o", color=style.COLOURS[0])
        style.finish(ax, xlabel=label, ylabel="cases at most as large", ylim=(0, len(values) + 1))
        ax.yaxis.get_major_locator().set_params(integer=True)
        return
    ax.hist(values, bins="auto" if len(values) < 5000 else 60, color=style.COLOURS[0], alpha=0.55)
    for share, line in SHARES.items():
        value = np.percentile(values, share)
        ax.axvline(value, color="black", linestyle=line, label=f"{share} %: {value:.4g}")
    ax.set(xlabel=label, ylabel="cases")
    ax.legend(fontsize=9, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)


def _scatter(ax, x, values, failed):
    ax.plot(x, values, "o", color=style.COLOURS[0], markersize=3.5 if len(x) > 60 else 5, alpha=0.6)
    if failed.any():
        at_the_bottom = {"transform": ax.get_xaxis_transform(), "label": f"{failed.sum()} without result"}
        ax.plot(x[failed], np.full(failed.sum(), 0.03), "x", color=style.COLOURS[1], **at_the_bottom)
    style.finish(ax, legend={} if failed.any() else None)


def _varies(study, name):
    values = study[name]
    if values.dtype.kind not in "bif":
        return False
    values = values[np.isfinite(values.astype(float))]
    return len(values) > 1 and np.ptp(values.astype(float)) > 0


def _strongest(study, parameters, values):
    """The parameter with the largest rank correlation, else the index of the case."""
    from scipy.stats import spearmanr

    known = np.isfinite(values)
    if known.sum() < 3 or np.ptp(values[known]) == 0:
        return parameters[0] if parameters else "case"
    strength = {name: abs(spearmanr(study[name][known], values[known]).statistic) for name in parameters}
    return max(strength, key=lambda name: np.nan_to_num(strength[name]), default="case")
