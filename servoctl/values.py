"""Equality of frozen values by their fields, arrays among them."""

from dataclasses import fields
from functools import wraps

import numpy as np


class Value:
    """Base of frozen dataclasses that compare by their fields, arrays among them; NaN equals NaN."""

    def __eq__(self, other):
        if self is other or type(self) is not type(other):
            return self is other
        return all(same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self) if f.compare)

    def __hash__(self):
        entries = (getattr(self, f.name) for f in fields(self) if f.compare)
        return hash((type(self), *(entry for entry in entries if isinstance(entry, (str, int, float)))))


def same(a, b):
    """Whether two values are equal, with arrays and containers of arrays compared by their entries."""
    if a is b:
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a, b = np.asarray(a), np.asarray(b)
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    if isinstance(a, dict) and isinstance(b, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if getattr(type(a), "_equals", type(a)) is not getattr(type(b), "_equals", type(b)):
        return False
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b) or (isinstance(a, float) and a != a and b != b)


def read_only(array):
    """A view of an array that cannot be written."""
    view = array.view()
    view.flags.writeable = False
    return view


class Identity:
    """A value that equals only itself: what is kept for a mechanism holds its symbols, not those of an equal one."""

    def __init__(self, value):
        self.value = value

    def __eq__(self, other):
        return self.value is other.value

    def __hash__(self):
        return id(self.value)


class Deferred(dict):
    """A dict of which some values are computed together when one of its values is first read.

    Parameters
    ----------
    known : dict
    names : sequence of str
        Keys of the others.
    compute : callable
        Returns the others by name.
    """

    def __init__(self, known, names, compute):
        super().__init__(dict.fromkeys(names) | known)
        self._compute = compute

    def __reduce__(self):
        return dict, (dict(self.items()),)


def _computed(name):
    read = getattr(dict, name)

    @wraps(read)
    def method(self, *args):
        if self._compute is not None:
            self.update(self._compute())
            self._compute = None
        return read(self, *args)

    return method


for _name in "__getitem__ __iter__ __eq__ __or__ __ror__ __repr__ get items values copy pop".split():
    setattr(Deferred, _name, _computed(_name))
