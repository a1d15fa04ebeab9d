"""Which signals a figure of a run shows, and their units: from names alone, so that loaded runs are drawn, too."""

import re

from servoctl.figures import style


def efforts(run):
    """Names of the run's actuators, or of the ideal reaction's components; of a loaded run, outputs among them."""
    reaction = [name for name in run.names if name.startswith("reaction_")]
    if reaction:
        return reaction
    if run.model is not None:
        return [name for name in run.model.actuators if name in run.names]
    rates = {f"{d}{name}" for name in run.jet_names for d in ("d", "d2")}
    return [n for n in run.stored if n != "energy" and not n.startswith("multiplier_") and n not in rates]


def coordinates(run):
    """Names of the run's coordinates; of a loaded run those of which derivatives are known."""
    if run.model is not None:
        return list(run.model.coordinate_names)
    base = [name for name in run.jet_names if _antiderivative(name, run.jet_names) is None]
    moved = [name for name in base if f"d{name}" in run.stored]  # by quasi-velocities: q' is no jet
    return moved or base


def _antiderivative(name, names):
    """(q, k) of the k-th derivative of a signal, or None."""
    match = re.fullmatch(r"d(\d*)(.+)", name)
    return (match[2], int(match[1] or 1)) if match and match[2] in names else None


def planes(run):
    """Groups of names that span a plane by convention, capitals first, and outputs before coordinates."""
    outputs = list(run.model.outputs) if run.model is not None else []
    groups = {}
    for name in [*outputs, *coordinates(run)]:
        match = re.fullmatch(r"(.*_)?([xyzXYZ])(_.*|\d*)", name)
        if match:
            groups.setdefault((match[2].islower(), match[1], match[3]), []).append(name)
    return [names for key, names in sorted(groups.items(), key=lambda group: group[0][0]) if len(names) > 1]


def along_one_axis(names):
    """Whether names are one coordinate, or numbered ones of one axis: x1, x2, ..."""
    axes = {name.rstrip("0123456789") for name in names}
    return len(names) == 1 or len(axes) == 1 and axes < set("xyzXYZ")


def unit_of(name, units):
    """Unit of a signal, also of a derivative or of a component of the reaction; "" where it is not known."""
    if name in units:
        return units[name]
    if name == "energy":
        return "J"
    if name.startswith("reaction_"):
        return {"m": "N", "rad": "N m"}.get(units.get(name.removeprefix("reaction_")), "")
    base = _antiderivative(name, units)
    return "" if base is None else units[base[0]] + ("/s" if base[1] == 1 else f"/s$^{{{base[1]}}}$")


def label_of(names, units):
    """The label of an axis: names, with their unit if they share one."""
    unit = {unit_of(name, units) for name in names}
    text = ", ".join(names) if len(names) < 4 else ", ".join([*names[:2], "...", names[-1]])
    return style.label(text, unit.pop() if len(unit) == 1 else "")
