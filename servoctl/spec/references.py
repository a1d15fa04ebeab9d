"""References: signals that a program follows, as symbols r, r', r'', ... whose values come from paths."""

import threading
from math import factorial

import casadi as ca
import numpy as np

from servoctl.checks import by_name, named, whole_of
from servoctl.errors import SpecificationError
from servoctl.jets.tape import JETS, column_of
from servoctl.spec.paths.parametric import ParametricPath
from servoctl.spec.paths.scipy_paths import as_path
from servoctl.spec.paths.value import Path, numbers_in, parameters_of, path_at

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

    def again(self):
        """The same references, with the same symbols, to which others can be added."""
        other = Family(self.paths)
        with _lock:
            other._symbols, other._places = dict(self._symbols), dict(self._places)
        return other

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
        self.paths.update({name: followed_path(name, path) for name, path in paths.items()})
        return References(self, paths)

    def jet(self, name, k):
        """The symbol of the k-th derivative of a reference, or of its derivative by a parameter: (name, parameter)."""
        if (name, k) not in self._symbols:
            with _lock:  # threads that derive from one mechanism share its symbols
                if (name, k) not in self._symbols:
                    written = name if isinstance(name, str) else "_by_".join(name)
                    symbol = ca.SX.sym(written if k == 0 else f"d{written}" if k == 1 else f"d{k}{written}")
                    place = self.names.index(name) if name in self.paths else name
                    self._places[symbol.element_hash()] = ("r", k, place)
                    self._symbols[name, k] = symbol
        return self._symbols[name, k]

    def where(self, key):
        """("r", k, place) of a symbol by its element hash, or None."""
        return self._places.get(key)


def orders_in(q, expressions):
    """The highest derivative of each reference in SX expressions, by name in the order in which they were made."""
    symbols = ca.symvar(ca.vertcat(ca.SX(0, 1), *map(ca.vec, expressions))) if len(q.family) else []
    places = sorted(place for place in map(q.where, symbols) if place and place[0] == "r")
    highest = {i: k for _, k, i in places}  # the last one counts
    return {name: highest[i] for i, name in enumerate(q.family.names) if i in highest}


def function_of(q, names, name, x, p, *outputs, jets="r"):
    """An SX function (t, x, p) of expressions, or (t, x, p, r) where they contain jets of references.

    `names` are those of the references that a model follows: where there are some, p begins with the place of their
    paths in memory. The fourth input r has their derivatives 0 .. K in columns; `jets` is its name (`codegen.paths`).
    """
    p, outputs = ca.vertcat(ca.SX.sym("paths"), p) if names else p, [ca.SX(y) for y in outputs]
    symbols = ca.symvar(ca.vertcat(*map(ca.vec, outputs))) if names else []
    levels = [place[1] for place in map(q.where, symbols) if place and place[0] == "r"]
    r = [ca.vertcat(*(q.family.jet(one, k) for one in names)) for k in range(max(levels, default=-1) + 1)]
    inputs = {"t": q.t, "x": x, "p": p} | ({jets: ca.horzcat(*r)} if r else {})
    return ca.Function(name, [*inputs.values()], outputs, [*inputs], [f"y{i or ''}" for i in range(len(outputs))])


def called(q, names, f, x, p):
    """The output of a function by `function_of` as an expression, at states x and parameters p without a place."""
    columns = range(f.size2_in(3) if f.n_in() > 3 else 0)
    jets = [ca.horzcat(*(ca.vertcat(*(q.family.jet(name, k) for name in names)) for k in columns))] * bool(columns)
    return f(q.t, x, ca.vertcat(ca.SX(0 if names else ca.SX(0, 1)), p), *jets)


class Jets:
    """The jets of references in expressions as further numbers of a column, whose values follow from paths by name.

    `places` are their names and orders, `symbols` and `rates`, the next jets, SX columns. `numbers` are parameters and
    their values (n_p,), which paths may contain.
    """

    def __init__(self, q, expressions, paths=None, numbers=None):
        symbols = ca.symvar(ca.vertcat(ca.SX(0, 1), *map(ca.vec, expressions)))
        found = [(place, s) for s in symbols if (place := q.where(s)) and place[0] == "r"]
        self.symbols = ca.vertcat(ca.SX(0, 1), *(s for _, s in found))
        self._names, self.places = q.family.names, [(q.family.names[i], k) for (_, k, i), _ in found]
        self.rates = ca.vertcat(ca.SX(0, 1), *(q.family.jet(name, k + 1) for name, k in self.places))
        self.paths = paths and required_paths({name: paths[name] for name, _ in self.places})
        self.paths = paths_at(self.paths, *numbers) if numbers else self.paths

    def __len__(self):
        return len(self.places)

    def __getstate__(self):
        return {name: value for name, value in vars(self).items() if not isinstance(value, ca.SX)}

    def of(self, instants):
        """Their values (n, N) at instants (N, 1 + R) of points."""
        columns = [column_of(self._names.index(name), k) for name, k in self.places]
        sizes = np.array([[factorial(k)] for _, k in self.places], dtype=float).reshape(-1, 1)
        return np.asarray(instants[:, columns], dtype=float).T * sizes

    def at(self, t):
        """Their values at times (N,) [s], (n, N); a path that says nothing of an instant is held there."""
        highest = {name: k for k, name in sorted((k, name) for name, k in self.places)}
        jets = {name: self.paths[name].held().jets(t, k) for name, k in highest.items()}
        return np.concatenate([np.zeros((0, len(t))), *(jets[name][k] for name, k in self.places)])


def required_paths(paths):
    """The paths by name; refused where there is none yet."""
    if missing := [name for name, path in paths.items() if path is None]:
        raise SpecificationError(
            f"No path was given for {', '.join(missing)}.",
            "A motion follows a path for each reference of the program and of the mechanism.",
            do=f"Write .with_references({', '.join(f'{name}=...' for name in missing)}) on the model or the plant.",
            missing=missing,
        )
    return paths


def other_paths(paths, changes):
    """The paths by name, some of them changed."""
    changes = by_name(changes, paths, "reference", "The references")
    return paths | {name: followed_path(name, path) for name, path in changes.items()}


def paths_at(paths, parameters, values):
    """The paths by name with the values (n_p,) of parameters that they contain."""
    if not any(map(parameters_of, paths.values())):
        return paths
    written = numbers_in(parameters.symbols, values)
    for name, path in paths.items():
        if unknown_ones := [one for one in parameters_of(path) if one not in written]:
            raise SpecificationError(
                f"The path of the reference {name!r} contains {', '.join(unknown_ones)}.",
                "A path contains numbers and parameters of the mechanism.",
                nearest=f"Its parameters are {', '.join(written)}." if written else "",
                do=f"Make the mechanism with parameters=sv.parameters({unknown_ones[0]}=..., ...).",
                name=name,
                names=unknown_ones,
            )
    return {name: path_at(path, written, f"The path of the reference {name!r}") for name, path in paths.items()}


def require_fixed(paths, parameters, names, what):
    """Refuse parameters by name which paths contain where they are changed along the same paths by `what`."""
    written = {s.name(): name for name, s in zip(parameters.names, parameters.symbols, strict=True) if name in names}
    for reference, path in paths.items():
        if both := [name for one, name in written.items() if one in parameters_of(path)]:
            raise SpecificationError(
                f"The path of the reference {reference!r} contains {', '.join(both)}.",
                f"{what} parameters along paths that stay the same.",
                do=f"Follow a path of numbers: with_references({reference}=path.at({both[0]}=...)).",
                name=reference,
                names=both,
            )


def is_path(value):
    """Whether a value is a path, or a piecewise polynomial of SciPy, which is called with numbers alone."""
    return isinstance(value, (Path, ParametricPath)) or hasattr(value, "extrapolate")


def followed_path(name, path):
    """The path of one component that a reference follows, from what SciPy makes, too; None for none yet."""
    path = path if path is None or isinstance(path, (Path, ParametricPath)) else as_path(path)
    if path is not None and path.dim != 1:
        raise SpecificationError(
            f"The path of the reference {name!r} has {path.dim} components.",
            "A reference is one signal.",
            f"{name}=path[0].",
            "Name a reference for each component.",
            name=name,
            components=path.dim,
        )
    return path


def rates_in_time(q, expressions):
    """The partial derivatives (n,) of SX expressions (n,) by the time, along the paths of their references."""
    jets = Jets(q, [expressions])
    return ca.jacobian(expressions, q.t) + ca.jacobian(expressions, jets.symbols) @ jets.rates
