"""The figure of sensitivities."""

import numpy as np

from servoctl.errors import SpecificationError
from servoctl.figures.names import label_of, units_in
from servoctl.figures.style import BESIDE, as_axes, high, look, panels


def draw_sensitivity(sensitivity, ax=None, units=None):
    """Draw the change of each signal, one panel for each, if each number grows by `sensitivity.change`."""
    of, units, given = sensitivity.of, units_in(sensitivity.run, units), as_axes(ax)
    axes = np.ravel(panels([max(2.2, high(len(sensitivity.to)))] * len(of)) if ax is None else given)
    if len(axes) != len(of):
        raise SpecificationError(
            f"{len(axes)} Axes were given.",
            f"There are {len(of)} panels: {', '.join(of)}.",
            do="Give as many Axes as signals.",
            axes=len(axes),
            panels=len(of),
        )
    for panel, name in zip(axes, of, strict=True):
        for i, to in enumerate(sensitivity.to):
            step = "1 %" if sensitivity.number(to) else "0.01"
            panel.plot(sensitivity.t, sensitivity.change(to) * sensitivity[name, to], label=f"{to} + {step}", **look(i))
        panel.set_ylabel(f"change of {label_of([name], units)}")
        panel.grid(alpha=0.3)
    axes[0].legend(**BESIDE)
    axes[-1].set_xlabel("t [s]")
    return axes
