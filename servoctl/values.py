"""Frozen values, and their equality by their fields, arrays among them."""

from dataclasses import MISSING, FrozenInstanceError, dataclass, field, fields
from functools import partial, wraps
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform  # since Python 3.11 in typing, too
else:

    def dataclass_transform(**_):  # noqa: D103 - type checkers read the other one
        return lambda decorator: decorator


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(cls=None, *, eq=True, repr=True):
    """The decorator ``dataclass(frozen=True)`` with one function compiled for each class in place of six.

    The constructor is its own; equality, hash, text and the refusal of changes are shared, which halves the time that
    importing the package takes beyond that of NumPy and CasADi.
    """
    if cls is None:
        return partial(frozen, eq=eq, repr=repr)
    cls = dataclass(init=False, eq=False, repr=False)(cls)
    methods = {"__init__": _constructor(cls), "__setattr__": _refuse_change, "__delattr__": _refuse_change}
    methods |= {"__eq__": _equal, "__hash__": _hash} if eq else {}
    methods |= {"__repr__": _fields_text} if repr else {}
    for name, method in methods.items():
        if vars(cls).get(name) is None:
            setattr(cls, name, method)
    return cls


class _Made:
    def __repr__(self):
        return "<factory>"


def _constructor(cls):
    """The function that sets the fields of a class from arguments and defaults, and calls its ``__post_init__``."""
    scope, parameters, values = {"made": _Made()}, ["self"], []
    for f in fields(cls):
        default, value = "", f.name
        if f.default_factory is not MISSING:
            scope[f"new_{f.name}"], default = f.default_factory, "=made"
            value = f"new_{f.name}() if {f.name} is made else {f.name}" if f.init else f"new_{f.name}()"
        elif f.default is not MISSING:
            scope[f"default_{f.name}"], default = f.default, f"=default_{f.name}"
        parameters += [f.name + default] if f.init else []
        values += [f"{f.name}={value}"] if f.init or f.default_factory is not MISSING else []
    after = "; self.__post_init__()" if hasattr(cls, "__post_init__") else ""
    exec(f"def __init__({', '.join(parameters)}): self.__dict__.update({', '.join(values)}){after}", scope)
    init = scope["__init__"]
    init.__module__, init.__qualname__ = cls.__module__, f"{cls.__qualname__}.__init__"
    init.__annotations__ = {f.name: f.type for f in fields(cls) if f.init} | {"return": None}
    return init


def _refuse_change(self, name, *value):
    if "__dataclass_params__" not in vars(type(self)) and all(f.name != name for f in fields(self)):
        return (object.__setattr__ if value else object.__delattr__)(self, name, *value)  # of a plain subclass
    raise FrozenInstanceError(f"cannot {'assign to' if value else 'delete'} field {name!r}")


def _compared(value):
    return tuple(getattr(value, f.name) for f in fields(value) if f.compare)


def _equal(self, other):
    return _compared(self) == _compared(other) if other.__class__ is self.__class__ else NotImplemented


def _hash(self):
    return hash(_compared(self))


def _fields_text(self):
    entries = (f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.repr)
    return f"{self.__class__.__qualname__}({', '.join(entries)})"


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


def evenly(n, most):
    """Indices (k,) of at most so many of n entries, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))


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

    `compute` returns the values of `names`, those that `known` does not hold. The dict pickles as a plain one.
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
