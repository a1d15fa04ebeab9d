"""Paths with parameters: r(t) = A P((t - t0)/T) + b of a path P of numbers, where A, b, t0 and T are expressions.

On each piece r = sum c_j(p) tau^j, where tau = (t - m(p))/h(p) goes from -1 to 1. Its derivative by a parameter,

    dr/dp = sum dc_j/dp tau^j - r_tau (dm/dp + tau dh/dp)/h,

is a polynomial of the same degree on the same piece: a further row of the table of paths that a model follows.
"""

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from servoctl.checks import by_name, column, finite, whole_of
from servoctl.errors import SpecificationError
from servoctl.values import Value, frozen


class Components:
    """What paths of numbers and of expressions have in common: `dim` components, and arithmetic from the other side."""

    __array_ufunc__ = None  # a number of NumPy times a path is a path

    def __len__(self):
        return self.dim

    def __iter__(self):
        return (self[i] for i in range(self.dim))

    def __neg__(self):
        return self * -1.0

    def __radd__(self, other):
        return self + other

    def __rmul__(self, factor):
        return self * factor

    def __sub__(self, other):
        return -(-self + other)

    def __rsub__(self, other):
        return -self + other


@frozen(eq=False)
class ParametricPath(Components, Value):
    """A path whose numbers are expressions of parameters; made by `sv.paths` where these stand in place of numbers.

    A model follows it with its own numbers of the parameters, and another path after `with_parameters`. It is added to
    and multiplied by numbers and expressions; `path[i]` is one component, and `x, y = path` takes it apart.

    Attributes
    ----------
    base : Path
        Of numbers.
    names : tuple of str
        Of the parameters.
    dim : int
        The number of components.
    content : str
        The function of the parameters that returns A (dim, n), b, t0 and T, serialised.
    """

    base: Any
    names: tuple
    dim: int
    content: str

    def at(self, **numbers: float) -> Any:
        """The path with numbers of its parameters.

        Parameters
        ----------
        **numbers : float
            Of all of its parameters, SI.

        Returns
        -------
        Path

        Raises
        ------
        NameUnknown
            For a name that is no parameter of the path.
        SpecificationError
            For a parameter without a number, and for a duration that is not positive.
        """
        numbers = by_name(numbers, self.names, "parameter of the path", "The numbers")
        if missing := [name for name in self.names if name not in numbers]:
            raise SpecificationError(
                f"The path contains {', '.join(self.names)}, and {', '.join(missing)} has no number.",
                "A path has values where all of its parameters have numbers.",
                do=f"Write path.at({', '.join(f'{name}=...' for name in self.names)}).",
                missing=missing,
            )
        return self.made({name: finite(name, value, "parameter") for name, value in numbers.items()})

    @cached_property
    def _function(self):
        return ca.Function.deserialize(self.content)

    @property
    def _symbols(self):
        return ca.vertcat(ca.SX(0, 1), *(ca.SX.sym(name) for name in self.names))

    def _forms(self):
        """A, b, t0 and T as expressions of symbols with the names of the parameters."""
        return self._function(self._symbols)

    def made(self, numbers, what="The path"):
        """The path with numbers of the parameters by name, among others; `what` it is begins a message."""
        A, b, t0, T = (np.array(part) for part in self._function([numbers[name] for name in self.names]))
        if not 0 < T[0, 0] < np.inf:
            raise SpecificationError(
                f"{what} lasts for {T[0, 0] * np.ptp(self.base.breaks):g} s.",
                "A path has a positive, finite duration.",
                do=f"Change {', '.join(self.names) or 'its duration'}.",
                names=self.names,
            )
        coefficients = A @ self.base.coefficients
        coefficients[:, :, 0] += b[:, 0]
        breaks = t0[0, 0] + T[0, 0] * self.base.breaks
        return self.base._with(breaks=breaks, coefficients=coefficients)

    @cached_property
    def _slopes(self):
        p = self._symbols
        return ca.Function("slopes", [p], [ca.densify(ca.jacobian(part, p)) for part in self._function(p)])

    def _by(self, numbers, names):
        """The derivatives of A (dim, n), b (dim,), t0 and T by some of the parameters, a list with these of each."""
        slopes = [np.array(part) for part in self._slopes([numbers[name] for name in self.names])]
        for i in map(self.names.index, names):
            A, b, t0, T = (part[:, i] for part in slopes)
            yield A.reshape(self.dim, -1, order="F"), b, t0[0], T[0]

    def moved(self, numbers, name):
        """The derivatives (n + 1,) of the breaks by a parameter."""
        ((_, _, t0, T),) = self._by(numbers, [name])
        return t0 + T * self.base.breaks

    def rates(self, numbers, names):
        """The derivatives of the path by some of the parameters, a list of `Path`."""
        path, result = self.made(numbers), []
        half, powers = np.diff(path.breaks) / 2, np.arange(path.coefficients.shape[-1])
        slopes = np.pad(path.coefficients[:, :, 1:] * powers[1:], ((0, 0), (0, 0), (0, 1)))
        for A, b, t0, T in self._by(numbers, names):
            moves = t0 + T * self.base.breaks
            middle, longer = (moves[1:] + moves[:-1]) / 2 / half, np.diff(moves) / 2 / half
            table = A @ self.base.coefficients - middle[:, None, None] * slopes
            table -= longer[:, None, None] * path.coefficients * powers
            table[:, :, 0] += b
            broken = (moves != 0) & np.isfinite(path.classes)
            self._require_known_outside(path, broken)
            classes = np.maximum(path.classes - broken, -1.0)
            result.append(path._with(coefficients=table, classes=classes))
        return result

    def _require_known_outside(self, path, broken):
        """Refuse a path whose derivative is not held, or does not repeat, outside its breaks where these move."""
        bent = path.breaks[[0, -1]][broken[[0, -1]] & (path.classes[[0, -1]] < 1)]
        if len(bent) or path.before == "periodic" and broken.any():
            what = f"has a bend where it is held, at t = {bent[0]:g} s" if len(bent) else "is periodic"
            raise SpecificationError(
                f"The path {what}, and its breaks move with {', '.join(self.names)}.",
                "A path has derivatives by parameters where it comes to rest before it is held, and does not repeat.",
                do="Make it with smoothness=1 or more, without before='periodic'; or keep its breaks where they are.",
                names=self.names,
            )

    def __getitem__(self, i):
        A, b, t0, T = self._forms()
        i = range(self.dim)[whole_of("component", i, range(-self.dim, self.dim))]
        return parametric(self.base, A[i, :], b[i], t0, T)

    def __mul__(self, factor):
        A, b, t0, T = self._forms()
        factor = column(factor, "multiple of a path", 1)[0]
        return parametric(self.base, factor * A, factor * b, t0, T)

    def __add__(self, other):
        """The sum with a constant: a number or an expression, or a vector (dim,) of them."""
        if isinstance(other, (type(self.base), ParametricPath)):
            raise SpecificationError(
                "A path is added to one with parameters.",
                "A path with parameters is added to and multiplied by numbers and parameters.",
                do="Name a reference for each path, q.references(a=..., b=...), and write r.a + r.b.",
            )
        A, b, t0, T = self._forms()
        return parametric(self.base, A, b + ca.vertcat(*column(other, "constant", self.dim)), t0, T)

    def at_rate(self, factor, about=None):
        """The path that runs so many times as fast, with `about` [s], by default its first break, where it was."""
        A, b, t0, T = self._forms()
        factor = column(factor, "factor", 1)[0]
        about = t0 + T * self.base.breaks[0] if about is None else column(about, "about", 1)[0]
        return parametric(self.base, A, b, about + (t0 - about) / factor, T / factor)

    def __call__(self, t):
        """Refused: it has no values without numbers."""
        raise self._without_numbers("path(t)")

    def __getattr__(self, name):
        if name.startswith("_") or not hasattr(self.base, name):
            raise AttributeError(name)
        raise self._without_numbers(f"path.{name}")

    def _without_numbers(self, what):
        at = f"path.at({', '.join(f'{name}=...' for name in self.names)})"
        return SpecificationError(
            f"{what} was asked of a path that contains the parameters {', '.join(self.names)}.",
            "A path has values where all of its parameters have numbers; a model has them.",
            do=f"Write {what.replace('path', at, 1)}, or simulate a model that follows it.",
            names=self.names,
        )

    def __repr__(self):
        return f"Path: {self.dim} component{'s' * (self.dim > 1)}, with the parameters {', '.join(self.names)}"


def parametric(base, A, b, t0=0.0, T=1.0):
    """The path A P((t - t0)/T) + b of a path P of numbers, with expressions A (dim, n), b (dim,), t0 and T."""
    path = expressed(base, A, b, t0, T)
    return path if path.names else path.made({})


def expressed(base, A, b, t0=0.0, T=1.0):
    """The same path, also where its expressions contain no parameter."""
    forms = [ca.densify(ca.SX(part)) for part in (A, b, t0, T)]
    known, symbols = {}, ca.symvar(ca.vertcat(*map(ca.vec, forms)))
    for symbol in symbols:
        known.setdefault(symbol.name(), symbol)  # parameters of a path are known by their names
    same = ca.vertcat(ca.SX(0, 1), *(known[s.name()] for s in symbols))
    forms = ca.substitute(forms, [ca.vertcat(ca.SX(0, 1), *symbols)], [same])
    f = ca.Function("numbers", [ca.vertcat(ca.SX(0, 1), *known.values())], forms)
    return ParametricPath(base, tuple(known), forms[0].size1(), f.serialize())


def varies(value):
    """Whether what stands in place of a number is an expression of parameters, or contains one."""
    if isinstance(value, np.ndarray):
        return value.dtype == object and any(map(varies, value.ravel()))
    if isinstance(value, (list, tuple)):
        return any(map(varies, value))
    return isinstance(value, ca.SX)
