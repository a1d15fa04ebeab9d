"""Names: what is read by a name is one signal, wherever it is read."""

import re

from servoctl.errors import SpecificationError

SUFFIXES = {
    "actuator": "_input", "actuator or rate": "_input", "output": "_output", "parameter": "_parameter",
    "residual": "_residual", "row": "_residual",
}  # fmt: skip
OF_REACTIONS = ("multiplier_", "reaction_")  # how names of their components begin


def antiderivative(name, names):
    """(q, k) of the k-th derivative of a signal, or None."""
    match = re.fullmatch(r"d([2-9]|[1-9]\d+)?(\D.*)", name)
    return (match[2], int(match[1] or 1)) if match and match[2] in names else None


def distinct(kind, names, others, bases=()):
    """The names under which what is of one kind is read: {name: name, or NAME_input where a signal has that name}.

    Signals are the others, and time derivatives of these and of `bases`. Refused if the longer name is taken, too.
    """
    read, names = {}, tuple(names)
    for name in names:
        taken = name in others or antiderivative(name, (*others, *bases)) or name.startswith(OF_REACTIONS)
        read[name] = name + SUFFIXES[kind] * bool(taken)
        if taken and (read[name] in others or read[name] in names):
            raise SpecificationError(
                f"The {kind} {name!r} has the name of another signal, and {read[name]!r} is taken, too.",
                "What is read by a name is one signal.", do="Rename one of them.", name=name, taken=read[name],
            )  # fmt: skip
    return read


def meant(name, names, kind):
    """The one of the names of a kind that a name means, where only this kind can be meant; None if there is none."""
    suffix = SUFFIXES.get(kind, "")
    forms = (name, f"{name}{suffix}", name.removesuffix(suffix)) if isinstance(name, str) else ()
    return next((form for form in forms if form in names), None)


def rows_read(rows, signals):
    """The rows by the names under which their residuals are read beside signals: {X or X_residual: X}."""
    return {long: row for row, long in distinct("residual", rows, signals).items()}
