"""Values on the command line: NAME=VALUE, ranges, numbers within bounds."""

import argparse
import math

from servoctl.errors import SpecificationError
from servoctl.methods.choice import METHODS

MOST_SAMPLES = 10**7  # of a run: some gigabytes
VERBOSE = {"action": "store_true", "help": "print the details of values, which report.txt has"}
METHODS_HELP = f"{', '.join(METHODS)}; default: by the model"
SCENE_HELP = "a gallery name, or a .py file that defines scene()"
MANY = {"nargs": "+", "action": "extend", "default": []}  # options that take several values, and may be repeated


def add_motion(parser):
    """Add the arguments that describe a motion: the scene, its time span, parameters and start."""
    parser.add_argument("scene", metavar="NAME_OR_FILE", help=SCENE_HELP)
    parser.add_argument("--t-span", type=float, nargs=2, metavar=("T0", "T1"), help="[s]; default: the scene's")
    pairs = {"type": assignment, "metavar": "NAME=VALUE", **MANY}
    parser.add_argument("--hold", **pairs, help="values held at the start, in addition to the scene's")
    parser.add_argument("--guess", **pairs, help="guess of values at the start; not held then, even if the scene does")
    parser.add_argument("--set", **pairs, help="parameters")


def by_name(pairs, option):
    """A dict of (name, value) pairs, each name once; `option` is for the message."""
    values = {}
    for name, value in pairs:
        if name in values:
            both = " and ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in (values[name], value))
            raise SpecificationError(
                f"{option} {name} was given twice: {both}.",
                do="Leave one out.",
                option=option,
                name=name,
                values=(values[name], value),
            )
        values[name] = value
    return values


def used(args, names):
    """The options among these names that were given, as written on the command line; 0 counts as given."""
    values = {f"--{name.replace('_', '-')}": getattr(args, name) for name in names}
    return [option for option, value in values.items() if value is not None and value is not False and value != []]


# --- types of arguments


def _typed(read, form):
    """A type for argparse: `read(text)`; an error that states the form if that is None or raises ValueError."""

    def parse(text):
        try:
            value = read(text)
        except ValueError:
            value = None
        if value is None:
            raise argparse.ArgumentTypeError(f"{text!r} is {form}")
        return value

    return parse


def _named(read, form):
    """A type for argparse: the name and the value of NAME=VALUE."""

    def split(text):
        name, _, text = text.partition("=")
        value = read(text)
        return None if value is None or not name.strip() else (name.strip(), value)

    return _typed(split, form)


def _number(above=-math.inf, least=-math.inf):
    """A reader of finite numbers that are greater than a bound, and at least another one."""
    return lambda text: float(text) if above < float(text) < math.inf and least <= float(text) else None


def _at_least(least, most=math.inf):
    form = f"not a whole number of at least {least}{f' and at most {most}' if most < math.inf else ''}"
    return _typed(lambda text: int(text) if text.isdecimal() and least <= int(text) <= most else None, form)


def _limits(text):
    low, high = (float(part) for part in text.split(":")) if ":" in text else (-float(text), float(text))
    return (low, high) if low < high else None


whole, samples = _at_least(0), _at_least(2, MOST_SAMPLES)
positive = _typed(_number(above=0.0), "not a positive number")
drift = _typed(
    lambda text: text if text in ("none", "project") else float(text), "not none, project or a time constant [s]"
)
_pair = "not NAME=VALUE with a number, such as theta=0.1; the scene's name comes before such options"
assignment = _named(_number(), _pair)
deviation = _named(_number(least=0.0), "not NAME=STD with STD >= 0, such as theta=0.001")
limits = _named(_limits, "neither NAME=LOW:HIGH nor NAME=SIZE, such as trolley=150")
