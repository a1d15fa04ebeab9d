"""Equality of frozen values by their fields, arrays among them."""

from dataclasses import fields

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
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
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
