"""The signals that figures of a run show by default, and their units, from names alone: loaded runs have no model."""

import re

from servoctl.checks import antiderivative, require_kind
from servoctl.figures import style
from servoctl.run import Run
from servoctl.units import as_units, unit_of


def efforts(run):
    """Names of the run's actuators or of the components of its ideal reaction; for a loaded run with the outputs."""
    require_kind(Run, "run", run, "sv.simulate(...) or sv.load(path)")
    reaction = [name for name in run.names if name.startswith("reaction_")]
    if reaction:
        return reaction
    if run.model is not None:
        return [name for name in run.model.actuators if name in run.names]
    rates = {f"{d}{name}" for name in run.jet_names for d in ("d", "d2")}
    return [n for n in run.stored if n != "energy" and not n.startswith("multiplier_") and n not in rates]


def coordinates(run):
    """Names of the run's coordinates; for a loaded run of those whose derivatives are stored."""
    if run.model is not None:
        return list(run.model.reduction.mechanism.q.names)
    base = [name for name in run.jet_names if antiderivative(name, run.jet_names) is None]
    by_quasi_velocities = [name for name in base if f"d{name}" in run.stored]  # q' is then a signal, and no jet
    return by_quasi_velocities or base


def planes(run):
    """Groups of names of axes such as (X, Z) or (tip_x, tip_y): capitals first, outputs before coordinates."""
    outputs = list(run.model.outputs) if run.model is not None else []
    return planes_of([*outputs, *coordinates(run)])


def planes_of(names):
    """Those of some names that are axes of a plane or of space, by point."""
    groups = {}
    for name in names:
        match = re.fullmatch(r"(.*_)?([xyzXYZ])(_.*|\d*)", name)
        if match:
            groups.setdefault((match[2].islower(), match[1], match[3]), []).append(name)
    return [names for key, names in sorted(groups.items(), key=lambda group: group[0][0]) if len(names) > 1]


def along_one_axis(names):
    """Whether names are a single one, or numbered ones of one axis: x1, x2, ..."""
    axes = {name.rstrip("0123456789") for name in names}
    return len(names) == 1 or len(axes) == 1 and axes < set("xyzXYZ")


def units_in(run, units):
    """Units by name: those of the run's mechanism, and those that are given."""
    return {**run.units, **as_units(units)}


def label_of(names, units):
    """The label of an axis: names, with their unit if they share one."""
    unit = {unit_of(name, units) for name in names}
    text = ", ".join(names) if len(names) < 4 else ", ".join([*names[:2], "...", names[-1]])
    return style.label(text, unit.pop() if len(unit) == 1 else "")
