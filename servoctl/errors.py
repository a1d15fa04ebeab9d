"""The errors of servoctl.

Each message has four parts: what was given, the rule, the nearest valid thing, what to do. The facts are also
in `details`.
"""

import difflib


class ServoError(ValueError):
    """Raised, through one of its children, when a specification or a motion breaks a rule of the toolkit.

    Parameters
    ----------
    given : str
        What was given, with its value.
    rule : str, optional
        The rule that it breaks.
    nearest : str, optional
        The nearest valid thing.
    do : str, optional
        What to do about it.
    **details
        The same facts as values, kept in `details`.

    Attributes
    ----------
    details : dict
        The facts of the message, by name.
    run : Run or None
        The part of the motion that was computed before an integration stopped.
    """

    def __init__(self, given, rule="", nearest="", do="", **details):
        nearest = nearest and f"Nearest: {nearest}"
        parts = (" ".join(str(part).split()) for part in (given, rule, nearest, do))
        super().__init__(" ".join(part if part[-1] in ".!?" else part + "." for part in parts if part))
        self.details = details
        self.run = None


class SpecificationError(ServoError):
    """Raised when coordinates, a mechanism, a program or a path contradict themselves or each other."""


class NotRealisable(ServoError):
    """Raised when no actuation of the mechanism can realise the program."""


class InconsistentStart(ServoError):
    """Raised when no start satisfies the held values and every invariant, or none was found from the guess."""


class SingularProgram(ServoError):
    """Raised when the equations of motion lose rank, such as where a row's gradient vanishes on its own solutions."""


class UnstableInternalDynamics(ServoError):
    """Raised when the internal dynamics are unstable and the requested method would integrate them forward."""


class LimitExceeded(ServoError):
    """Raised when a motion needs more than a stated limit allows."""


class IntegrationStopped(ServoError):
    """Raised when an integrator cannot go on; what it computed is in `run`."""


class NameUnknown(ServoError):
    """Raised when a name is none of those that exist; the nearest match is in the message."""


def unknown(name, valid, what):
    """Make the error for a name that is none of the valid ones.

    Parameters
    ----------
    name : str
        The name that was given.
    valid : iterable of str
        The names that exist.
    what : str
        What the names stand for, in the singular: `"parameter"`, `"method"`.

    Returns
    -------
    NameUnknown
        To be raised by the caller, with `details` `name`, `valid` (tuple) and `match` (str or None).
    """
    valid = tuple(str(candidate) for candidate in valid)
    by_lower_case = {candidate.lower(): candidate for candidate in reversed(valid)}
    matches = difflib.get_close_matches(str(name).lower(), by_lower_case, n=1)
    nearest = by_lower_case[matches[0]] if matches else None
    return NameUnknown(
        f"No {what} is named {name!r}",
        f"The names are: {', '.join(valid)}" if valid else f"There is no {what} at all",
        repr(nearest) if nearest else "",
        "Use one of these names" if valid else f"Leave the {what} out",
        name=name,
        valid=valid,
        match=nearest,
    )
