"""The figure of sensitivities."""

from servoctl.figures.names import label_of, units_in
from servoctl.figures.style import BESIDE, as_panels, finish, high, look


def draw_sensitivity(sensitivity, ax=None, units=None):
    """Draw the change of each signal, one panel for each, if each number grows by `sensitivity.change`."""
    of, units = sensitivity.of, units_in(sensitivity.run, units)
    axes = as_panels(ax, [max(2.2, high(len(sensitivity.to)))] * len(of))
    for panel, name in zip(axes, of, strict=True):
        for i, to in enumerate(sensitivity.to):
            step = "1 %" if sensitivity.number(to) else "0.01"
            panel.plot(sensitivity.t, sensitivity.change(to) * sensitivity[name, to], label=f"{to} + {step}", **look(i))
        finish(panel, ylabel=f"change of {label_of([name], units)}")
    axes[0].legend(**BESIDE)
    axes[-1].set_xlabel("t [s]")
    return axes
