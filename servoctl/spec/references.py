"""References: signals that a program follows, as symbols r, r', r'', ... whose values come from paths."""

import threading

import casadi as ca

from servoctl.checks import named, whole_of
from servoctl.errors import SpecificationError
from servoctl.jets.tape import JETS

_lock = threading.Lock()


class References:
    """Symbols of named references, in the order of their names: `r.X`, `r["X"]`; unpacks into them.

    Made by `Coordinates.references`.

    Attributes
    ----------
    names : tuple of str
    """

    def __init__(self, family, names):
        self._family, self.names = family, tuple(names)

    @property
    def paths(self):
        """The paths that are followed until told otherwise, by name; None where there is none yet."""
        return {name: self._family.paths[name] for name in self.names}

    def __getitem__(self, name):
        return self._family.jet(named(name, self.names, "reference"), 0)

    def __getattr__(self, name):
        if name.startswith("_") or name not in self.names:
            raise AttributeError(f"No reference is named {name!r}; there are {', '.join(self.names)}.")
        return self[name]

    def __iter__(self):
        return iter([self[name] for name in self.names])

    def __len__(self):
        return len(self.names)

    def __repr__(self):
        return f"References({' '.join(self.names)})"

    def d(self, k=1):
        """The k-th time derivatives, a tuple of SX symbols in the order of the names.

        Raises SpecificationError if k is no whole number from 0 to 40.
        """
        k = whole_of("order", k, range(JETS + 1))
        return tuple(self._family.jet(name, k) for name in self.names)


class Family:
    """All references of a set of coordinates, which share them with their parts and with their other velocities."""

    def __init__(self, paths=None):
        self.paths, self._symbols, self._places = dict(paths or {}), {}, {}

    def __len__(self):
        return len(self.paths)

    def __reduce__(self):
        return Family, (self.paths,)

    @property
    def names(self):
        """The names in the order in which they were made, a tuple of str."""
        return tuple(self.paths)

    def add(self, paths):
        """The `References` of further names with their paths."""
        for name in paths:
            if name in self.paths or hasattr(References, name) or name == "names":
                why = "is a reference already" if name in self.paths else "would hide an attribute of the references"
                raise SpecificationError(
                    f"The reference {name!r} {why}.",
                    "Each reference has a name of its own.",
                    do="Give it another name, or its other path by model.with_references.",
                    name=name,
                )
        self.paths.update(paths)
        return References(self, paths)

    def jet(self, name, k):
        """The symbol of the k-th derivative."""
        if (name, k) not in self._symbols:
            with _lock:  # threads that derive from one mechanism share its symbols
                if (name, k) not in self._symbols:
                    symbol = ca.SX.sym(name if k == 0 else f"d{name}" if k == 1 else f"d{k}{name}")
                    self._places[symbol.element_hash()] = ("r", k, self.names.index(name))
                    self._symbols[name, k] = symbol
        return self._symbols[name, k]

    def where(self, key):
        """("r", k, place) of a symbol by its element hash, or None."""
        return self._places.get(key)
