"""Units of signals by name: those that a specification gives, and those that follow from them."""

import re

from servoctl.checks import antiderivative, as_list, by_name, mapping
from servoctl.errors import SpecificationError

FORCES = {"m": "N", "rad": "N m", "m/s": "N", "rad/s": "N m"}  # unit of a position or a velocity: of its force
OF_LOOP = ("command ", "input ", "measured ")  # how names of a loop's signals begin in a plain run
OF_NUMBERS = re.compile(r"(?:final |rms )(.+)|max \|(.+)\||(.+)_(?:min|max|end)")  # columns of a study, of a signal


def as_units(units):
    """Units by name, texts, from a dict or None."""
    if not all(isinstance(unit, str) for unit in mapping(units, "The units").values()):
        rule, do = "A unit is a text.", 'Write {"x": "m", "theta": "rad"}.'
        raise SpecificationError(f"The units are {repr(units)[:150]}.", rule, do=do, units=units)
    return units or {}


def units_by_name(units, names, what):
    """Units of some of the names, from a dict, or of all of them, from a text or a list in their order.

    `what` says what is named, such as "coordinate", for the message of `NameUnknown`.
    """
    listed = units.split() if isinstance(units, str) else as_list(units)
    if listed is None:
        return by_name(as_units(units), names, what, "The units")
    if len(listed) != len(names):
        raise SpecificationError(
            f"{len(listed)} units were given: {' '.join(map(str, listed))[:150]}.",
            f"There are {len(names)} names, {', '.join(names)}, each with a unit; 1 is that of a number.",
            do='Write units="m m rad", or name some of them: units={"x": "m"}.',
            units=len(listed),
            names=len(names),
        )
    return as_units(dict(zip(names, listed, strict=True)))


def rate_unit(unit, k=1):
    """Unit of the k-th time derivative of what has a unit: m, m/s, m/s^2; 1/m, 1/(m s)."""
    if k == 0 or not unit:
        return unit
    base, _, below = unit.partition("/")
    factors = below.strip("()").split()
    seconds = [factor for factor in factors if re.fullmatch(r"s(\^\d+)?", factor)]
    k += sum(int(factor[2:] or 1) for factor in seconds)
    factors = [factor for factor in factors if factor not in seconds] + ["s" if k == 1 else f"s^{k}"]
    return f"{base}/{factors[0]}" if len(factors) == 1 else f"{base}/({' '.join(factors)})"


def unit_of(name, units):
    """Unit of a signal, of a derivative or of a component of the reaction; "" if it is not known."""
    if name in units:
        return units[name]
    if name == "energy":
        return "J"
    if name.startswith("reaction_"):
        return FORCES.get(units.get(name.removeprefix("reaction_")), "")
    if name.startswith(OF_LOOP):
        return unit_of(name.partition(" ")[2], units)
    base = antiderivative(name, (*units, "energy"))
    return "" if base is None else rate_unit(unit_of(base[0], units), base[1])


def unit_of_column(name, units):
    """Unit of a column of a study: of a signal, or of its least, greatest, mean or last value.

    A study without units has none: its columns may be errors of signals.
    """
    if not units or name in units:
        return units.get(name, "")
    of = OF_NUMBERS.fullmatch(name)
    return unit_of(next(filter(None, of.groups())) if of else name, units)


def with_unit(name, unit):
    """A name, with its unit in brackets if it is known."""
    return f"{name} [{unit}]" if unit else name
