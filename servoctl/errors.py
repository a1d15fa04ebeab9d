"""The errors of servoctl.

Each message has up to four sentences: what was given, the rule, the nearest valid value, what to do. The facts are
also in `details`.
"""

import re
import sys
import warnings

__all__ = [
    "InconsistentStart",
    "IntegrationStopped",
    "LimitExceeded",
    "NameUnknown",
    "NotRealisable",
    "ServoError",
    "SingularProgram",
    "SpecificationError",
    "UnstableInternalDynamics",
]
DERIVATIVE = re.compile(r"d([2-9]?)([A-Za-z_]\w*)")  # dx, d2x: names that may be those of derivatives


class ServoError(ValueError):
    """Base of all errors of the toolkit: a specification or a motion breaks a rule.

    Parameters
    ----------
    given : str
        The input, with its value.
    rule : str, optional
        The rule that it breaks.
    nearest : str, optional
        The nearest valid value, computed from the input.
    do : str, optional
        What to do, unless the rule says it.
    **details
        The same facts as values.

    Attributes
    ----------
    details : dict
        The facts of the message, by name.
    run : Run or None
        What was computed before an integration stopped.
    """

    def __init__(self, given, rule="", nearest="", do="", **details):
        nearest = nearest and f"Nearest: {nearest}"
        parts = (" ".join(str(part).split()) for part in (given, rule, nearest, do))
        super().__init__(" ".join(part if part[-1] in ".!?" else part + "." for part in parts if part))
        self.details = details
        self.run = None


class SpecificationError(ServoError):
    """Raised when an input is of the wrong kind, or contradicts itself or another one."""


class NotRealisable(ServoError):
    """Raised when no actuation of the mechanism can realise the program."""


class InconsistentStart(ServoError):
    """Raised when no state satisfies the held values and every constraint, or the guess leads to none."""


class SingularProgram(ServoError):
    """Raised when the equations of motion lose rank, as where a constraint's gradient vanishes on its solutions."""


class UnstableInternalDynamics(ServoError):
    """Raised when the internal dynamics are unstable and the requested method would integrate them forward."""


class LimitExceeded(ServoError):
    """Raised when a motion needs more than a stated limit allows."""


class IntegrationStopped(ServoError):
    """Raised when an integrator cannot continue; what it computed is in `run`."""


class NameUnknown(ServoError):
    """Raised when a name is unknown; the message has the closest valid one."""


def unknown(name, valid, what):
    """The `NameUnknown` for a name that is not valid, to be raised by the caller; `what` it names: "parameter".

    Its details are `name`, `valid` (tuple) and `match` (the closest valid name, or None).
    """
    import difflib

    valid = tuple(str(candidate) for candidate in valid)
    by_lower_case = {candidate.lower(): candidate for candidate in reversed(valid)}
    matches = difflib.get_close_matches(str(name).lower(), by_lower_case, n=1)
    nearest = _next_derivative(str(name), valid) or (by_lower_case[matches[0]] if matches else None)
    return NameUnknown(
        f"No {what} is named {name!r}",
        nearest=repr(nearest) if nearest else "",
        do=f"The names are: {', '.join(valid)}" if valid else f"There is no {what} at all",
        name=name,
        valid=valid,
        match=nearest,
    )


def _next_derivative(name, valid):
    """Of the valid names of derivatives of the same quantity, that of the nearest order; None if there is none."""
    repeated = re.fullmatch(r"(dd+)(.+)", name)
    if repeated and repeated[2] in valid:  # ddx
        name = f"d{len(repeated[1])}{repeated[2]}"
    found = DERIVATIVE.fullmatch(name)
    if name in valid or not found:
        return name if name in valid else None
    order, base = int(found[1] or 1), found[2]
    orders = {base: 0, f"d{base}": 1} | {f"d{k}{base}": k for k in range(2, order)}
    return min((other for other in valid if other in orders), key=lambda other: order - orders[other], default=None)


def warn(text):
    """Warn the first caller outside the package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] == __name__.split(".")[0]:
        level, frame = level + 1, frame.f_back
    warnings.warn(text, RuntimeWarning, stacklevel=level)
