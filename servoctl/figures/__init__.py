"""Figures of runs, closed loops and sweeps; each function returns matplotlib's Axes or Figure."""

from servoctl.figures.animation import Animation, animate, stroboscope
from servoctl.figures.cases import sweep
from servoctl.figures.loop import closed
from servoctl.figures.names import efforts
from servoctl.figures.run import actuation, path, residuals, save_figures, signals
from servoctl.figures.style import COLOURS, STYLES

__all__ = [
    "Animation",
    "COLOURS",
    "STYLES",
    "actuation",
    "animate",
    "closed",
    "efforts",
    "path",
    "residuals",
    "save_figures",
    "signals",
    "stroboscope",
    "sweep",
]
