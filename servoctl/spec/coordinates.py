"""Generalised coordinates, quasi-velocities and their jets, and the total derivative (3.1)."""

import threading
from collections.abc import Iterable, Mapping
from math import factorial

import casadi as ca

from servoctl.checks import as_list, column, is_number, is_whole, mapping, matrix, named, require_kind, whole_of
from servoctl.errors import SpecificationError
from servoctl.jets.identity import spread, vanish
from servoctl.jets.series import Motion, Series, is_zero
from servoctl.jets.tape import Tape, divide, multiply
from servoctl.spec.references import JETS, Family
from servoctl.units import units_by_name

_lock = threading.Lock()

MULTIPLES = ("__mul__", "__rmul__", "__truediv__")

MOST_ORDER = 100  # of a derivative: k! of higher ones leaves the range of doubles soon


class Column(ca.SX):
    """A column of SX scalars that also unpacks, and indexes, as a tuple of them does."""

    def __init__(self, items):
        super().__init__(ca.vertcat(*items) if len(items) else ca.SX(0, 1))
        self._items = tuple(items)

    def __iter__(self):
        return iter(self._items)

    def __len__(self):
        return len(self._items)

    def __getitem__(self, place):
        if isinstance(place, slice):
            return Column(self._items[place])
        return self._items[place] if is_whole(place) else super().__getitem__(place)

    __setitem__ = None  # the symbols stay what they are

    if hasattr(ca.SX, "__array_function__"):  # from CasADi 3.8 on, which knows its own types alone

        def __array_function__(self, func, types, args, kwargs):
            return super().__array_function__(func, (ca.SX,), args, kwargs)


def _kept(name):
    """A sum or multiple of SX that keeps the antiderivative; in sums what has none counts as a function of time."""
    operation, multiple = getattr(ca.SX, name), name in MULTIPLES

    def applied(self, *others):
        value = operation(self, *others)
        of = operation(self.of, *(getattr(one, "of", one if multiple else 0) for one in others))
        same = all(is_number(one) if multiple else getattr(one, "k", self.k) == self.k for one in others)
        return Rate(value, of, self.k) if same and value.shape == self.shape else value

    return applied


class Rate(ca.SX):
    """A k-th total derivative that knows its antiderivative `of`, which sums and multiples by numbers keep."""

    __array_ufunc__ = None  # numbers of NumPy leave operations to it
    __add__, __radd__, __sub__, __rsub__, __neg__ = map(_kept, "__add__ __radd__ __sub__ __rsub__ __neg__".split())
    __mul__, __rmul__, __truediv__ = map(_kept, MULTIPLES)

    def __init__(self, value, of, k):
        super().__init__(value)
        self.of, self.k = of, k

    def __getitem__(self, place):
        return Rate(super().__getitem__(place), self.of[place], self.k)


class Coordinates:
    """Generalised coordinates q, quasi-velocities w with q' = V w + h (3.1), and jets of any order.

    Made by `coordinates`. Unpacks into the coordinates' symbols; CasADi's functions take it as their column. Symbols of
    jets are made on first use.

    Attributes
    ----------
    names : tuple of str
        The coordinates' names.
    t : SX
        The time [s].
    units : dict of str to str
        Units of coordinates and quasi-velocities, where they are given.
    """

    def __init__(self, names, units=None):
        self.names, self.units = names, units or {}
        self.nq = len(names)
        self.t = ca.SX.sym("t")
        self._q = tuple(ca.SX.sym(name) for name in names)
        self._w, self._columns = {}, {}  # symbols by order, and as columns
        self._index = {self.t.element_hash(): ("t", 0, 0)}
        self._index |= {s.element_hash(): ("q", 0, i) for i, s in enumerate(self._q)}
        self.velocity_names = tuple(f"d{name}" for name in names)
        self.V, self.h, self.invariants, self.spheres = ca.SX.eye(self.nq), ca.SX.zeros(self.nq), {}, ()
        self.plain, self.identity = True, {}  # values that a posture has where it is not given, and that are not zero
        self.family = Family()  # of the references
        self._whole = None  # of a part: the coordinates whose symbols it has, and the places of its velocities there

    def __iter__(self):
        return iter(self._q)

    def __len__(self) -> int:
        return self.nq

    def __getitem__(self, name):
        """The symbol of a coordinate by its name or its place, or a column of some by a slice."""
        if isinstance(name, slice) or is_whole(name) and -self.nq <= name < self.nq:
            return self.d(0)[name]
        return self._q[self.names.index(named(name, self.names, "coordinate"))]

    def __SX__(self):
        """The column by which CasADi's functions take it; one that is kept, as CasADi 3.7 does not."""
        self.jet(0)
        return self._columns[0]

    @property
    def T(self):
        """The coordinates as a row, (1, nq) SX."""
        return self.jet(0).T

    @property
    def n(self):
        """The number of quasi-velocities."""
        return len(self.velocity_names)

    @property
    def force_names(self):
        """Names of the generalised forces: those of the coordinates, or of quasi-velocities where these differ."""
        return self.names if self.plain else self.velocity_names

    def __repr__(self):
        frame = "" if self.plain else f", quasi-velocities {' '.join(self.velocity_names)}"
        return f"Coordinates({' '.join(self.names)}{frame})"

    def with_quasi_velocities(self, names, V, h=None, invariants=None):
        """The same coordinates, with quasi-velocities w: q' = V w + h (3.1).

        Parameters
        ----------
        names : str
            Names of the n quasi-velocities, separated by blanks.
        V : (nq, n) SX or nested lists
            May be rectangular (a quaternion with body rates: nq = n + 1); of full column rank.
        h : (nq,) SX or sequence, optional
            Velocity of the coordinates at w = 0; may depend on t. Default 0.
        invariants : dict of str to SX, optional
            For nq > n: functions of q that the kinematics keep at zero, e.g. {"unit": dot(e, e) - 1}.

        Returns
        -------
        Coordinates
            A new value with the same symbols for q and t.

        Raises
        ------
        SpecificationError
            If sizes disagree or a name is taken.
        """
        names = _identifiers(names, "quasi-velocities")
        V = matrix(V, "V", (self.nq, len(names)))
        other = Coordinates(self.names, self.units)
        other.t, other._q, other.plain, other.family = self.t, self._q, False, self.family
        other._index = {key: value for key, value in self._index.items() if value[0] != "w"}
        other.V = V
        other.h = ca.vertcat(*column([0.0] * self.nq if h is None else h, "h", self.nq))
        other.velocity_names = names
        other.invariants = {
            k: column(v, f"invariant {k!r}", 1)[0] for k, v in mapping(invariants, "The invariants").items()
        }
        other.spheres = tuple(filter(None, map(self._sphere, other.invariants.values())))
        fixed = {i for places, _ in other.spheres for i in places}
        other.V = ca.vertcat(*(V[i, :] if i in fixed else other.on_spheres(V[i, :]) for i in range(self.nq)))
        _refuse_clash([*self.names, *names])
        for what, expression in (("V", V), ("h", other.h)):
            for s in ca.symvar(expression):
                if (self.where(s) or ("",))[0] == "w":
                    raise SpecificationError(
                        f"{what} depends on {s.name()}.", "V and h are functions of q and t (3.1).", name=s.name()
                    )
        return other

    def _sphere(self, invariant):
        """Places of the coordinates e in an invariant N(e) - c, N homogeneous of degree two, and c/N; None if other."""
        e = ca.vertcat(*(s for s in self._q if ca.depends_on(invariant, s)))
        least = ca.substitute(invariant, e, ca.SX.zeros(e.numel()))
        norm = ca.jtimes(invariant, e, e) / 2
        if not e.numel() or ca.depends_on(least, self.t) or not vanish(spread([norm - invariant + least])).all():
            return None
        return tuple(self.where(s)[2] for s in e.elements()), -least / norm

    def on_spheres(self, expression):
        """An expression that has its values at unit quaternions for those of any length, also as 1 - 2(y² + z²)."""
        for places, square in self.spheres:
            e = ca.vertcat(*(self._q[i] for i in places))
            if not vanish(spread(ca.jtimes(expression, e, e).elements())).all():
                expression = ca.substitute(expression, e, e * ca.sqrt(square))
        return expression

    def part(self, places, velocities):
        """Some of the coordinates and velocities, with the same symbols.

        Parameters
        ----------
        places, velocities : sequence of int
            Of the coordinates q and of γ', of which q' = V w + h couples none to the others.

        Returns
        -------
        Coordinates
        """
        other = Coordinates(tuple(self.names[i] for i in places))
        other.t, other._q, other.family = self.t, tuple(self._q[i] for i in places), self.family
        other._index = {self.t.element_hash(): ("t", 0, 0)}
        other._index |= {s.element_hash(): ("q", 0, i) for i, s in enumerate(other._q)}
        other.velocity_names = tuple(self.velocity_names[i] for i in velocities)
        other.V, other.h, other.plain = self.V[places, velocities], self.h[places], self.plain
        other.units = {name: u for name, u in self.units.items() if name in (*other.names, *other.velocity_names)}
        known = {s.element_hash() for s in other._q}
        other.invariants = {
            name: value
            for name, value in self.invariants.items()
            if {s.element_hash() for s in ca.symvar(value)} & known
        }
        at = dict(zip(places, range(len(places)), strict=True))
        other.spheres = tuple((tuple(at[i] for i in e), square) for e, square in self.spheres if set(e) <= set(at))
        other._whole, other.identity = (self, tuple(velocities)), self.identity
        return other

    def w(self, k=0):
        """Symbols of the k-th derivative of the quasi-velocities, γ^(k+1): an SX column that unpacks into n scalars."""
        return Column(self.gamma(_order(k) + 1))

    def gamma(self, k):
        """Symbols of γ^(k), k >= 1: a tuple of n SX scalars. γ' are the quasi-velocities."""
        k = _order(k, least=1)
        if k not in self._w:
            shared = None if self._whole is None else tuple(self._whole[0].gamma(k)[i] for i in self._whole[1])
            with _lock:  # threads that derive from one mechanism share its symbols
                if k not in self._w:
                    symbols = shared or tuple(map(ca.SX.sym, self.jet_names(k)))
                    self._index |= {s.element_hash(): ("w", k, i) for i, s in enumerate(symbols)}
                    self._w[k] = symbols
        return self._w[k]

    def jet(self, k):
        """γ^(k), k >= 1, or q for k = 0, as a column: (n,) or (nq,) SX."""
        k = _order(k)
        if k not in self._columns:
            self._columns[k] = ca.vertcat(*(self.gamma(k) if k else self._q))
        return ca.SX(self._columns[k])  # which a caller may change

    def jet_names(self, k: int) -> tuple[str, ...]:
        """Names of γ^(k), k >= 1, or of q for k = 0."""
        if _order(k) == 0:
            return self.names
        return tuple(jet_name(name, k, self.plain) for name in self.force_names)

    def d(self, k=1):
        """The k-th time derivatives of the coordinates: an SX column that unpacks into nq scalars.

        Symbols where q' = w, else expressions of w = `q.w()` and its derivatives.
        """
        if _order(k) == 0 or not self.plain:
            return Column(self.derivatives(self._q, k)[k])
        return Column(self.gamma(k))

    def references(self, **paths):
        """Signals that a program follows, by name, with the paths that they follow until told otherwise.

        Parameters
        ----------
        **paths : Path or None
            None: no path yet.

        Returns
        -------
        r : References
            The symbols: `r.X`, `r["X"]`, and their derivatives in the order of the names, `r.d(1)`. Equations may
            contain them as they contain t.

        Raises
        ------
        SpecificationError
            If a name is a reference already.
        """
        return self.family.add(paths)

    def beside(self, **paths):
        """The same coordinates with further references of their own.

        Parameters
        ----------
        **paths : Path or None
            By the names of the references.

        Returns
        -------
        (Coordinates, References)
        """
        other = object.__new__(Coordinates)
        vars(other).update(vars(self), family=self.family.again())
        return other, other.references(**paths)

    def dt(self, expression, k=1):
        """The k-th total time derivative of an expression of t, q and the jets.

        Parameters
        ----------
        expression : SX
            Scalar or column.
        k : int
            Order, at least 0.

        Returns
        -------
        SX of the same shape
            A residual that is a sum of it, or of multiples by numbers, and functions of time knows its integral, in any
            other form it does not: state that by `Program(..., integrals={"row": expression})`.
        """
        items = column(expression, "the expression")
        result = ca.vertcat(*self.derivatives(items, _order(k))[k])
        shape = expression.shape if isinstance(expression, ca.SX) else result.shape
        of, below = (expression.of, expression.k) if isinstance(expression, Rate) else (ca.vertcat(*items), 0)
        result, of = ca.reshape(result, *shape), ca.reshape(of, *shape)
        return Rate(result, of, k + below) if k else result

    def where(self, symbol):
        """What a symbol is: ("t", 0, 0), ("q", 0, i), ("w", k, i) for γ_i^(k), ("r", k, i) for r_i^(k), or None."""
        key = require_kind(ca.SX, "symbol", symbol, "q.d(1)").element_hash()
        if key not in self._index and self._whole is not None:
            kind, k, i = self._whole[0].where(symbol) or ("", 0, 0)
            if kind == "w" and i in self._whole[1]:
                self.gamma(k)
        return self._index.get(key) or self.family.where(key)

    def is_jet(self, symbol):
        """Whether a symbol is a coordinate, or one of the jets of a quasi-velocity."""
        return (self.where(symbol) or "t")[0] in "qw"

    def moves(self, symbol):
        """Whether a symbol is a jet, of a coordinate or of a reference."""
        return (self.where(symbol) or "t")[0] != "t"

    def order(self, expression):
        """The highest k for which γ^(k) is in an expression; 0 for q alone, -1 for neither."""
        if not isinstance(expression, ca.SX):
            expression = ca.SX(ca.vertcat(*column(expression, "the expression")))
        places = map(self.where, symbols_in(expression))
        return max([-1, *(place[1] for place in places if place is not None and place[0] in "qw")])

    def derivatives(self, expressions, k):
        """Total derivatives of orders 0 to k by one propagation of Taylor series.

        Parameters
        ----------
        expressions : sequence of SX scalars
        k : int

        Returns
        -------
        list of k + 1 lists of SX scalars
        """
        expressions = column(as_list(expressions), "the expressions")
        if _order(k) == 0:
            return [expressions]
        outputs = self._series(expressions, k).outputs[: len(expressions)]
        derivatives = ([multiply(c[j], float(factorial(j))) for c in outputs] for j in range(k + 1))
        return [[e if e.__class__ is ca.SX else ca.SX(e) for e in level] for level in derivatives]

    def as_function(self, expressions, parameters=()):
        """Expressions of t, q, jets and parameters as one CasADi function, which serialises and pickles.

        Parameters
        ----------
        expressions : sequence of SX
        parameters : sequence of SX
            Their symbols.

        Returns
        -------
        casadi.Function
        """
        free = ca.Function("expressions", [], list(expressions), {"allow_free": True}).free_sx()
        highest = max([0, *map(self.order, free)])
        followed = 1 + max([-1, *(place[2] for place in map(self.where, free) if place and place[0] == "r")])
        return ca.Function("expressions", self._arguments(highest, followed, parameters), list(expressions))

    def from_function(self, function, parameters=()):
        """The expressions of a function by `as_function`, perhaps of another process, in these symbols.

        Parameters
        ----------
        function : casadi.Function
        parameters : sequence of SX
            Their symbols.

        Returns
        -------
        list of SX
        """
        followed = function.numel_in(0) // (JETS + 1)
        return function.call(self._arguments(function.n_in() - 4, followed, parameters), True, False)

    def _arguments(self, highest, followed, parameters):
        """All jets of the references `followed` in number, t, those of the coordinates up to `highest`, parameters."""
        references = [self.family.jet(name, k) for name in self.family.names[:followed] for k in range(JETS + 1)]
        jets = [self.jet(k) for k in range(highest + 1)]
        return [ca.vertcat(ca.SX(0, 1), *references), self.t, *jets, ca.vertcat(ca.SX(0, 1), *parameters)]

    def __reduce__(self):
        if self.plain:
            return Coordinates, (self.names, self.units), {"family": self.family}
        frame = self.as_function([self.V, self.h, *self.invariants.values()])
        parts = self.names, self.units, self.velocity_names, frame, tuple(self.invariants), self.identity, self.family
        return _moved, parts

    def _series(self, expressions, k):
        """Coefficients 0 to k of expressions, followed by those of q' = V w + h if these contain q and q' is not w."""
        symbols, rates = None, []
        if not self.plain:
            symbols = ca.symvar(ca.vertcat(*expressions)) if expressions else []
            if any((self.where(s) or ("",))[0] == "q" for s in symbols):
                symbols = [*symbols, *ca.symvar(ca.vertcat(ca.vec(self.V), self.h)), *self._q, *self.gamma(1)]
                symbols = list({s.element_hash(): s for s in symbols}.values())
                rates = (self.V @ self.jet(1) + self.h).elements()
        tape = Tape(symbols, [*expressions, *rates])
        inputs = [[] for _ in tape.symbols]
        series = Series(tape, inputs)
        motion = _SymbolicMotion(self, [series.c[node] for node in tape.outputs[len(expressions) :]])
        for j in range(k + 1):
            for symbol, coefficients in zip(tape.symbols, inputs, strict=True):
                coefficients.append(motion.coefficient(symbol, j))
            series.advance()
        return series


class _SymbolicMotion(Motion):
    """The motion whose jets γ^(k) are symbols; `rates` lists the coefficients of q' so far, where q' is not γ'."""

    def __init__(self, q, rates):
        super().__init__(q)
        self.rates = rates

    def coordinate(self, i, j):
        if j == 0:
            return self.q._q[i]
        if self.q.plain:
            return self.velocity(i, 0, j)
        rate = self.rates[i][j - 1]
        return 0.0 if is_zero(rate) else divide(rate, j)

    def velocity(self, i, level, j):
        return divide(self.q.gamma(level + j)[i], float(factorial(j)))


def symbols_in(expression):
    """The symbols in an SX expression; CasADi's search is left out where there is nothing to search."""
    if expression.is_constant():
        return []
    return [expression] if expression.is_scalar() and expression.is_symbolic() else ca.symvar(expression)


def _moved(names, units, velocity_names, frame, invariants, identity, family):
    """Coordinates with quasi-velocities, unpickled."""
    q = Coordinates(names, units)
    q.family = family
    V, h, *values = q.from_function(frame)
    moved = q.with_quasi_velocities(" ".join(velocity_names), V, h, dict(zip(invariants, values, strict=True)))
    moved.identity = identity
    return moved


def require_order(q, expression, what, most):
    """Refuse an expression with higher derivatives of q than γ^(most); `what` it is begins the message."""
    order = q.order(expression)
    if order > most:
        raise SpecificationError(
            f"{what} has the order {order} in the jets.",
            f"Its order is at most {most}: {('coordinates and t', 'velocities', 'accelerations')[min(most, 2)]}.",
            do="Write it by lower derivatives, which are known where it is evaluated.",
            what=what,
            order=order,
            limit=most,
        )


def _order(k, least=0):
    return whole_of("order", k, range(least, MOST_ORDER + 1))


def jet_name(name, k, plain=True):
    """The name of a jet: theta, dtheta, d2theta for coordinates; u, du, d2u for quasi-velocities (k = 1, 2, 3)."""
    order = k if plain else k - 1
    return name if order == 0 else f"d{name}" if order == 1 else f"d{order}{name}"


def _identifiers(names, what):
    if not isinstance(names, str) or not names.split() or "," in names:
        raise SpecificationError(
            f"The names of the {what} are {names!r}.",
            "Names are a text, separated by blanks without commas.",
            nearest=repr(" ".join(names.replace(",", " ").split())) + "." if isinstance(names, str) else "",
            do='Write, for example, "x y theta".',
            names=names,
        )
    names = tuple(names.split())
    for name in names:
        if not name.isidentifier() or name in ("t", "guess", "hold"):
            raise SpecificationError(
                f"{name!r} is no name of {what}.",
                "Names are Python identifiers other than t, guess and hold, which are arguments of a start.",
                do="Rename it.",
                name=name,
            )
    _refuse_clash(names)
    return names


def _refuse_clash(names):
    """Refuse names that repeat, or that are names of derivatives of others."""
    derivatives = {jet_name(name, k): name for name in names for k in range(1, 10)}
    for name in names:
        if names.count(name) > 1 or name in derivatives:
            why = f"also names a derivative of {derivatives[name]!r}" if name in derivatives else "is used twice"
            raise SpecificationError(
                f"The name {name!r} {why}.",
                "Coordinates, quasi-velocities and derivatives (theta, dtheta, d2theta, ...) have different names.",
                do="Rename one of them.",
                name=name,
            )


def coordinates(names: str | Iterable[str], units: str | Mapping[str, str] | None = None) -> Coordinates:
    """Generalised coordinates by name, with jets of any order on demand.

    Parameters
    ----------
    names : str
        Names separated by blanks, e.g. "x l theta".
    units : str or dict of str to str, optional
        The unit of each, separated by blanks ("m m rad"), or of some by name. Figures, tables, reports and exported C
        show them, and those of rates and actuators that follow; numbers are in SI and radians whatever they are.

    Returns
    -------
    Coordinates
        Iterable of the coordinates' symbols (SX scalars); `.t` is the time [s].

    Raises
    ------
    SpecificationError
        If a name is no identifier, is `t`, repeats, or is also a derivative's name; if there are not as many units.
    NameUnknown
        For the unit of a name that is no coordinate.
    """
    names = _identifiers(names, "coordinates")
    return Coordinates(names, units_by_name(units, names, "coordinate"))
