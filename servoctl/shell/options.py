"""Values on the command line: NAME=VALUE, ranges, draws, shards."""

import argparse
import math

from servoctl.errors import SpecificationError
from servoctl.methods.choice import METHODS

METHODS_HELP = f"{', '.join(METHODS)}; default: by the model"
DRAWS = {"normal": "MEAN:STD", "uniform": "LOW:HIGH", "lognormal": "MEDIAN:LOG_STD", "triangular": "LOW:MODE:HIGH"}


def assignment(text):
    """(name, number) of NAME=VALUE."""
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not name.strip() or not math.isfinite(number):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not NAME=VALUE with a number, such as theta=0.1; the scene's name comes before such options"
        )
    return name.strip(), number


def mapping(pairs, option):
    """A dict of (name, value) pairs, each name once.

    Parameters
    ----------
    pairs : sequence of (str, object)
    option : str
        For the message.

    Returns
    -------
    dict

    Raises
    ------
    SpecificationError
        For a name that occurs twice.
    """
    found = {}
    for name, value in pairs:
        if name in found:
            raise SpecificationError(
                f"{option} {name} was given twice: {_short(found[name])} and {_short(value)}.",
                "A name has one value.",
                do="Leave one of them out.",
                name=name,
            )
        found[name] = value
    return found


def _short(value):
    return f"{value:g}" if isinstance(value, float) else value


def variation(text):
    """(name, list of numbers) of NAME=LOW:HIGH:N or NAME=A,B,C."""
    name, _, value = text.partition("=")
    try:
        if ":" in value:
            low, high, count = value.split(":")
            low, high, count = float(low), float(high), int(count)
            if count < 2:
                raise ValueError
            numbers = [low + (high - low) * i / (count - 1) for i in range(count - 1)] + [high]
        else:
            numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    if not name.strip() or not numbers:
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither NAME=LOW:HIGH:N with at least 2 values nor NAME=A,B,C, such as m_load=80:120:9"
        )
    return name.strip(), numbers


def draw(text):
    """(name, (kind, numbers)) of NAME=KIND:A:B."""
    name, _, value = text.partition("=")
    kind, *numbers = value.split(":")
    try:
        numbers = tuple(float(number) for number in numbers)
    except ValueError:
        numbers = ()
    if not name.strip() or kind not in DRAWS or len(numbers) != DRAWS[kind].count(":") + 1:
        forms = ", ".join(f"NAME={kind}:{form}" for kind, form in DRAWS.items())
        raise argparse.ArgumentTypeError(f"{text!r} is none of {forms}, such as m_load=normal:100:5")
    return name.strip(), (kind, *numbers)


def drawn(kind, *numbers):
    """The function of a numpy Generator that draws what `draw` has read."""
    return {
        "normal": lambda rng: rng.normal(*numbers),
        "uniform": lambda rng: rng.uniform(*numbers),
        "lognormal": lambda rng: numbers[0] * rng.lognormal(0.0, numbers[1]),
        "triangular": lambda rng: rng.triangular(*numbers),
    }[kind]


def shard(text):
    """(i, n) of I/N."""
    i, _, n = text.partition("/")
    if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
        raise argparse.ArgumentTypeError(f"{text!r} is not I/N with I from 1 to N, such as 1/4")
    return int(i), int(n)


def count(text):
    """A whole number of at least 1."""
    if not (text.isdecimal() and int(text) >= 1):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def whole(text):
    """A whole number of at least 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 0")
    return int(text)


def positive(text):
    """A positive number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return number


def given(args, names):
    """Those of these options that were given, as they are written: 0 is given, too.

    Parameters
    ----------
    args : argparse.Namespace
    names : sequence of str

    Returns
    -------
    list of str
    """
    values = {f"--{name.replace('_', '-')}": getattr(args, name) for name in names}
    return [option for option, value in values.items() if value is not None and value is not False and value != []]
