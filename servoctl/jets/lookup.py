"""Tables in expressions: piecewise constant functions whose numbers are data, not operations.

A spline of many pieces as sums over its pieces costs every step of a derivation in proportion to their number. Here an
expression calls a function instead, which stays one operation: `Lookup`. Its values are whole numbers inside `floor`,
whose derivative is zero, so that CasADi differentiates expressions of them as those of any piecewise constant function.
"""

import functools
import hashlib
import math
import re

import casadi as ca
import numpy as np

BITS = 80  # of the largest number of a column: smaller parts of the others are left out
TABLE_NAME = re.compile(r"(?:knots|entries)_(\d+)_[0-9a-f]{16}")  # the name of a table, with how many numbers it has
BEYOND = 1e300  # before and after all knots

made = {}  # functions of this process by name, that of the content: CasADi shares calls of the same function only
_contents = {}  # by the same name


class Lookup:
    """The number of knots that s has reached, or the entry of a list at a place.

    Its function is one that `of_knots` or `of_entries` has made.
    """

    def __init__(self, function):
        self.name = function.name()
        self.function = made.setdefault(self.name, function)

    @classmethod
    def of_knots(cls, knots):
        """The lookup of the number of ascending knots (n,) that s has reached."""
        knots = np.asarray(knots, dtype=float)
        name = _name("knots", knots)
        if name not in made:
            s = ca.MX.sym("s")
            reached = ca.low(ca.DM([-BEYOND, *knots, BEYOND]), s)
            made[name], _contents[name] = _opaque(name, s, [reached, _list(knots)(s)]), knots
        return cls(made[name])

    @classmethod
    def of_entries(cls, entries):
        """The lookup of a list (n,) of whole numbers, as floats, by place."""
        entries = np.asarray(entries, dtype=float)
        name = _name("entries", entries)
        if name not in made:
            place = ca.MX.sym("place")
            made[name], _contents[name] = _opaque(name, place, [_list(entries)(place)]), entries
        return cls(made[name])

    def __eq__(self, other):
        return isinstance(other, Lookup) and self.name == other.name

    def __hash__(self):
        return hash(self.name)

    def __str__(self):
        return self.name

    @property
    def counts(self):
        """Whether it counts knots."""
        return self.name.startswith("knots")

    @functools.cached_property
    def numbers(self):
        """The knots, or the entries."""
        if self.name not in _contents:
            places = np.arange(int(self.name.split("_")[1]))[None]
            _contents[self.name] = np.array(self.function.call([ca.DM(places)])[-1]).ravel()
        return _contents[self.name]

    def __call__(self, s):
        """The value at an SX scalar, or at an array of numbers."""
        if isinstance(s, ca.SX):
            return ca.floor(self.called(s))
        if self.counts:
            return 1.0 * np.searchsorted(self.numbers, np.asarray(s, dtype=float), "right")
        return self.numbers[np.clip(np.nan_to_num(np.asarray(s, dtype=float)), 0, len(self.numbers) - 1).astype(int)]

    def called(self, s):
        """The value at an SX scalar, without the `floor` that has no derivative."""
        return self.function.call([s])[0]


def columns_at(s, knots, values):
    """Entries of a table in the row whose number is that of the knots that s has reached.

    Parameters
    ----------
    s : SX scalar
    knots : (n,) array
        Ascending.
    values : (n + 1, m) array

    Returns
    -------
    list of m SX scalars
        To 2^-`BITS` of the largest of their column.
    """
    _, exponents = np.frexp(np.abs(values).max(axis=0))
    entries = Lookup.of_entries(np.rint(np.ldexp(values, BITS - exponents)).ravel())
    place = len(exponents) * Lookup.of_knots(knots)(s)
    return [entries(place + j) * 2.0 ** (int(e) - BITS) for j, e in enumerate(exponents)]


def lookup_at(f, k):
    """The lookup that instruction k of an SX function calls."""
    return Lookup(_instructions(f)[k].which_function())


@functools.lru_cache(maxsize=2)
def _instructions(f):
    return f.instructions_sx()


def lookups(f):
    """The lookups that an SX function calls, each once, in their order."""
    calls = (k for k in range(f.n_instructions()) if f.instruction_id(k) == ca.OP_CALL)
    return list(dict.fromkeys(lookup_at(f, k) for k in calls))


def _opaque(name, argument, values):
    """A function that stays one operation, and that CasADi need not differentiate."""
    outputs = [ca.MX.sym(f"y{i}") for i, _ in enumerate(values)]
    slopes = ca.Function(f"jac_{name}", [argument, *outputs], [ca.MX(1, 1) for _ in values])
    undifferentiated = {"enable_forward": False, "enable_reverse": False, "custom_jacobian": slopes}
    return ca.Function(name, [argument], values, {"never_inline": True, **undifferentiated})


def _name(kind, numbers):
    return f"{kind}_{len(numbers)}_{hashlib.sha256(numbers.tobytes()).hexdigest()[:16]}"


def _list(numbers):
    """The function of a place that is an entry of a list at whole numbers.

    The list is folded to rows, by straight lines in two directions: a grid of all places would take as much again.
    """
    width = 2 + math.isqrt(len(numbers))
    rows = 2 + len(numbers) // width
    grids = [np.concatenate([[0.0], np.arange(float(n)), [n - 1.0]]).tolist() for n in (width, rows)]
    values = np.append(numbers, np.zeros(width * rows - len(numbers)))
    folded = ca.Function.bspline("list", grids, values, [1, 1], 1, {})
    place = ca.MX.sym("place")
    row = ca.floor(place / width)
    return ca.Function("entry", [place], [folded(ca.vertcat(place - width * row, row))])
