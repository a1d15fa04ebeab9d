"""The figure of internal dynamics over a parameter of the outputs."""

import numpy as np

from servoctl.figures import style

SHADES = {"stable": "#009E73", "marginal": "#E69F00", "unstable": "#D55E00"}
CLIP = 3.0  # times the median magnitude of the roots: beyond it their real parts are cut off


def draw_output(result):
    """Draw the real parts of the roots over the parameter; ranges are shaded by their verdict."""
    figure, ((ax,),) = style.figure(4.4)
    magnitude = np.concatenate([np.abs(roots) for roots in result.roots])
    limit = CLIP * float(np.median(magnitude)) if magnitude.size else 1.0
    for verdict in dict.fromkeys(r.verdict for r in result.ranges):
        for i, r in enumerate(r for r in result.ranges if r.verdict == verdict):
            label = "_" if i else verdict
            ax.axvspan(r.low, r.high, color=SHADES[verdict], alpha=0.15, lw=0, label=label)
    points = [(v, root.real) for v, roots in zip(result.values, result.roots, strict=True) for root in roots]
    if points:
        x, y = np.array(points).T
        inside = np.abs(y) <= limit
        ax.plot(x[inside], y[inside], ".", color=style.COLOURS[0], markersize=3, label="real parts of the eigenvalues")
    for c in result.critical:
        ax.axvline(c.value, color="black", lw=1, ls=":", label="flat" if c.flat else "relative degree lost")
    ax.axvline(result.own, color=style.COLOURS[3], lw=1, ls="--", label="the model's own value")
    ax.axhline(0.0, color="black", lw=0.8)
    ax.set(xlim=(result.values[0], result.values[-1]), ylim=(-limit, limit))
    labels = {"xlabel": result.parameter, "ylabel": "real part [1/s]"}
    style.finish(ax, "Internal dynamics at the equilibrium", legend={}, **labels)
    return figure
