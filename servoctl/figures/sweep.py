"""The figure of a sweep: how results are distributed, and on what they depend."""

import numpy as np

from servoctl.errors import SpecificationError

COLOURS = ("#0072B2", "#D55E00")  # Okabe and Ito
TOLD = ("error", "message", "facts")  # columns of what went wrong, which are no results
MOST = 4  # results in one figure
SHARES = {5: "--", 50: "-", 95: ":"}  # percentiles


def draw(study, names, against, units):
    """Rows of a histogram with percentiles and a scatter over one parameter."""
    from matplotlib.figure import Figure

    if getattr(study, "kind", None) != "sweep":
        kind = f"Study of the kind {study.kind}" if hasattr(study, "kind") else type(study).__name__
        raise SpecificationError(
            f"A {kind} was given.", "A sweep is drawn.", "What sv.sweep or sv.merge returns.", "Give that."
        )
    parameters = [name for name in study.meta["parameters"] if _varies(study, name)]
    results = [name for name in study.columns if name not in (*TOLD, "case", *study.meta["parameters"])]
    names = [name for name in results if _varies(study, name)][:MOST] if names is None else list(names)
    if not names:
        raise SpecificationError(
            f"Of {len(study)} rows no result varies.",
            "The figure shows numbers that differ between cases.",
            do="Look at study.rows(); the column error says what failed.",
        )
    if against is not None:
        study.column(against)
    figure = Figure(figsize=(10.0, 0.6 + 2.5 * len(names)), layout="constrained")
    for name, axes in zip(names, figure.subplots(len(names), 2, squeeze=False), strict=True):
        values = np.asarray(study[name], dtype=float)
        _histogram(axes[0], values, _label(name, units))
        by = against or _strongest(study, parameters, values)
        _scatter(axes[1], study[by], values, study["error"] != "")
        axes[1].set(xlabel=_label(by, units), ylabel=_label(name, units))
    figure.suptitle(f"{study.meta['case']}: {study.meta['message']}", fontsize=11)
    return figure


def _histogram(ax, values, label):
    values = values[np.isfinite(values)]
    ax.hist(values, bins="auto" if len(values) < 5000 else 60, color=COLOURS[0], alpha=0.55)
    for share, style in SHARES.items():
        value = np.percentile(values, share)
        ax.axvline(value, color="black", linestyle=style, label=f"{share} %: {value:.4g}")
    ax.set(xlabel=label, ylabel="cases")
    ax.legend(fontsize=9, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)


def _scatter(ax, x, values, failed):
    ax.plot(x, values, "o", color=COLOURS[0], markersize=3.5 if len(x) > 60 else 5, alpha=0.6)
    if failed.any():
        bottom = {"transform": ax.get_xaxis_transform(), "color": COLOURS[1], "label": f"{failed.sum()} without result"}
        ax.plot(x[failed], np.full(failed.sum(), 0.03), "x", **bottom)
        ax.legend(fontsize=9)
    ax.grid(alpha=0.3)


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


def _label(name, units):
    return f"{name} [{units[name]}]" if name in (units or {}) else name
