"""Paths as values: polynomials of time between breaks, with their derivatives and the class at each break."""

from dataclasses import field
from functools import cached_property

import numpy as np

from servoctl.checks import MOST_JETS, array_of, as_numbers, finite, positive, require_kind, whole, whole_of
from servoctl.errors import SpecificationError
from servoctl.spec.paths.parametric import Components, ParametricPath, expressed, varies
from servoctl.values import Value, frozen, read_only

RULES = ("hold", "continue", "periodic", None)
SAME = 1e-13  # of the largest instant of a path: breaks that differ by less are one, but for rounding
COUNTED = 1e-7  # of a derivative's largest value, up to which its jump is rounding: SciPy's monomials of C^9 have 1e-8
CANCELLING = 16.0  # sum of the terms of a polynomial over its largest value, beyond which it is cut: four binary digits
SMOOTHEST = 100  # class of a path, beyond which the terms of its polynomials leave the range of a double
PATH_INSTANTS = 51  # of a path, at which its size is read
HALVINGS = 8  # of a piece: 256 parts, which a path of class 100 needs at its ends


@frozen(eq=False)
class Path(Components, Value):
    """A signal that is known with its derivatives: polynomials of time between breaks; made by `sv.paths`.

    `path(t)` is its value, `jets` has its derivatives, too. Paths are added, subtracted and multiplied by numbers;
    `then` joins them in time, `at_rate` changes their clock, `plot` draws them. `path[i]` is one component, and
    `x, y = path` takes it apart. A path of one component is a scalar: its values have the shape of t. At a break the
    piece that begins there counts, at the last one the piece that ends.

    Attributes
    ----------
    breaks : (n + 1,) array
        Ends of the pieces [s], ascending.
    coefficients : (n, dim, degree + 1) array
        Of the powers 0, 1, ... of a time that goes from -1 to 1 on each piece, SI.
    classes : (n + 1,) array
        How many derivatives are continuous at each break: infinity where one polynomial is cut, -1 at jumps.
        At an end that is held, how many derivatives vanish there.
    before, after : {"hold", "continue", "periodic", None}
        What the path does outside its breaks: it stands still, the polynomial goes on, or everything repeats. None: it
        stands still as far as its derivatives vanish at this end, and is refused where others are asked for.
    remark : str
        What its maker says of it, such as the error of a fit; it does not take part in comparisons.
    """

    breaks: np.ndarray
    coefficients: np.ndarray
    classes: np.ndarray
    before: str | None = None
    after: str | None = None
    remark: str = field(default="", compare=False)

    def __post_init__(self):
        arrays = {"breaks": (None,), "coefficients": (None, None, None), "classes": (None,)}
        for name, sizes in arrays.items():
            array = as_numbers(getattr(self, name)) + 0.0
            array_of(name, array[array != np.inf] if name == "classes" else array, *sizes)
            self.__dict__[name] = read_only(array)
        pieces, shape = len(self.breaks) - 1, self.coefficients.shape
        if shape[0] != pieces or 0 in shape or len(self.classes) != pieces + 1:
            raise SpecificationError(
                f"There are {pieces + 1} breaks, {len(self.classes)} classes, and coefficients of the shape {shape}.",
                "Each break has a class, and each piece between two breaks the coefficients of each component.",
                do="Use sv.paths.polynomials(breaks, coefficients), which counts the classes.",
                breaks=pieces + 1,
                shape=shape,
            )
        require_ascending("breaks", self.breaks)
        _require_rules(self.before, self.after)

    @property
    def dim(self):
        """The number of components."""
        return self.coefficients.shape[1]

    def __call__(self, t):
        """The values at instants.

        Parameters
        ----------
        t : float or (N,) array
            [s].

        Returns
        -------
        float or (N,) array
            Of one component; otherwise (dim,) or (dim, N).

        Raises
        ------
        SpecificationError
            As `jets` does.
        """
        values = self.jets(t, 0)[0]
        values = values[0] if self.dim == 1 else values
        return values if np.ndim(t) else values[..., 0]

    def jets(self, t, order, instants=None):
        """The values and derivatives at instants.

        Parameters
        ----------
        t : float or (N,) array
            [s].
        order : int
            Of the highest derivative.
        instants : (N,) array, optional
            [s]; they select the pieces, on either side of a break. Default t.

        Returns
        -------
        (order + 1, dim, N) array
            In powers of 1/s; N = 1 for a number.

        Raises
        ------
        SpecificationError
            If t is no finite number or array (N,) of them, the order is no whole number, or an instant lies outside
            a path that neither holds, goes on nor repeats there.
        """
        t, order = vector("t", t), whole("order", order, most=MOST_JETS)
        at = t if instants is None else np.asarray(instants, dtype=float)
        self._require_known(at, max(order, 1))
        factorials = np.cumprod([1.0, *range(1, order + 1)])
        return (self._taylor(t, order, 1.0, at) * factorials[:, None, None]).transpose(0, 2, 1)

    def _taylor(self, t, order, unit, at):
        """Taylor coefficients (order + 1, N, dim) at t (N,), for a time in a unit (N,) or one [s].

        Of the pieces at instants (N,).
        """
        first, last = self.breaks[[0, -1]]
        held = (at < first) & (self.before in ("hold", None)) | (at > last) & (self.after in ("hold", None))
        if self.before == "periodic":
            turns = np.floor((at - first) / (last - first)) * (last - first)
            t, at = t - turns, at - turns
        t = np.where(held, at.clip(first, last), t)
        pieces = (np.searchsorted(self.breaks, at, "right") - 1).clip(0, len(self.breaks) - 2)
        low, high = self.breaks[pieces], self.breaks[pieces + 1]
        tau = ((t - low) + (t - high)) / (high - low)
        result = taylor(self.coefficients, pieces, tau, order)
        ends = np.abs(tau) == 1.0
        if ends.any():  # where a path rests its derivatives are zero: rounding would determine directions
            terms = taylor(np.abs(self.coefficients[pieces[ends]]), np.arange(ends.sum()), np.ones(ends.sum()), order)
            rounding = self.coefficients.shape[2] * np.finfo(float).eps * terms
            result[:, ends] = np.where(np.abs(result[:, ends]) <= rounding, 0.0, result[:, ends])
            for end, rest in zip((first, last), self.rests, strict=True):
                result[1 : rest + 1, ends & (t == end)] = 0.0  # by class, no rounding: a rank may hang on it
        result[1:, held] = 0.0
        rates = np.ones((order + 1, len(tau)))
        rates[1:] = 2 * unit / (high - low)
        return result * rates.cumprod(axis=0)[:, :, None]

    @cached_property
    def largest(self):
        """The largest value, by samples."""
        return float(np.abs(self(np.linspace(*self.breaks[[0, -1]], PATH_INSTANTS))).max())

    @property
    def rests(self):
        """How many derivatives vanish at the first break, and at the last one, by the class there."""
        return [
            int(min(max(class_, 0), self.coefficients.shape[2])) if rule in ("hold", None) else 0
            for rule, class_ in zip((self.before, self.after), self.classes[[0, -1]], strict=True)
        ]

    def _require_known(self, t, order):
        """Refuse instants (N,) outside, if nothing was said and derivatives up to `order` do not vanish at the end."""
        for end, rule, outside in ((0, self.before, t < self.breaks[0]), (-1, self.after, t > self.breaks[-1])):
            if rule is None and outside.any() and self.classes[end] < order:
                first, last, instant = *self.breaks[[0, -1]], t[outside][0]
                raise SpecificationError(
                    f"The path from t = {first:g} to {last:g} s is asked for at t = {instant:g} s.",
                    f"It can be held only where its derivatives vanish: derivative {self.classes[end] + 1:g} does not.",
                    f"t = {self.breaks[end]:g} s.",
                    f"Stay inside, or make it with {'after' if end else 'before'}='hold' or 'continue'.",
                    t=float(instant),
                    end=float(self.breaks[end]),
                )

    def _parametric(self):
        """The same path, whose numbers may become expressions."""
        return expressed(self._with(), np.eye(self.dim), np.zeros(self.dim))

    def held(self):
        """The path that is held outside where nothing was said of it."""
        if self.before and self.after:
            return self
        found = object.__new__(Path)  # whose other fields need no check
        rules = {"before": self.before or "hold", "after": self.after or "hold", "remark": ""}
        found.__dict__.update(self.__dict__ | rules)
        return found

    def breaks_below(self, smooth, low, high):
        """Instants (N,) from `low` to `high` at which fewer than `smooth` derivatives are continuous."""
        breaks = self.breaks[self.classes < smooth]
        if not breaks.size:
            return breaks
        if self.before == "periodic":
            first, period = self.breaks[0], self.breaks[-1] - self.breaks[0]
            turns = np.arange(np.floor((low - first) / period), np.ceil((high - first) / period))
            breaks = np.unique(breaks + period * turns[:, None])
        return breaks[(low <= breaks) & (breaks <= high)]

    def __getitem__(self, i):
        i = whole_of("component", i, range(-self.dim, self.dim))
        return self._with(coefficients=self.coefficients[:, [i]])

    def _with(self, **changed):
        """The path with other fields, and without its maker's remark."""
        fields = ("breaks", "coefficients", "classes", "before", "after")
        return Path(**{name: getattr(self, name) for name in fields} | changed)

    def __reduce__(self):
        return Path, (self.breaks, self.coefficients, self.classes, self.before, self.after, self.remark)

    def __mul__(self, factor):
        if varies(factor):
            return self._parametric() * factor
        return self._with(coefficients=self.coefficients * finite("factor", factor, "multiple of a path"))

    def __add__(self, other):
        """The sum with a path, or with a constant: a number or a vector (dim,)."""
        if varies(other) or isinstance(other, ParametricPath):
            return self._parametric() + other
        if not isinstance(other, Path):
            constant = vector("The constant of a sum with a path", other)
            _require_dim(self.dim, len(constant))
            coefficients = self.coefficients.copy()
            coefficients[:, :, 0] += constant
            return self._with(coefficients=coefficients)
        _require_dim(self.dim, other.dim)
        (first, second), fields = together(self, other)
        return Path(coefficients=first + second, **fields)

    def then(self, other):
        """The path, and then another one, moved in time to begin where it ends.

        Parameters
        ----------
        other : Path
            Of the same dimension; its values are not moved.

        Returns
        -------
        Path
            Of the class at the joint that both have together, -1 if the value jumps.

        Raises
        ------
        SpecificationError
            If the dimensions differ or one of the paths is periodic, and has no end.
        """
        _require_dim(self.dim, require_kind(Path, "other", other, "sv.paths.as_path(...)").dim)
        if "periodic" in (self.after, other.before):
            raise SpecificationError(
                "A periodic path was joined.",
                "A path follows the end of another one.",
                do="Repeat neither of them.",
                after=self.after,
                before=other.before,
            )
        breaks = np.append(self.breaks, other.breaks[1:] + (self.breaks[-1] - other.breaks[0]))
        coefficients = np.concatenate(of_one_degree(self.coefficients, other.coefficients))
        joint = len(self.breaks) - 1
        found = counted(breaks, coefficients)[joint]
        at_rest = -1 if "continue" in (self.after, other.before) else min(self.classes[-1], other.classes[0])
        joined = max(found, at_rest) if found >= 0 else found
        classes = np.concatenate([self.classes[:-1], [joined], other.classes[1:]])
        return Path(breaks, coefficients, classes, self.before, other.after)

    def at_rate(self, factor, about=None):
        """The path along a clock that runs faster.

        Parameters
        ----------
        factor : float
            Positive; 2 halves the time that it takes. An expression of parameters makes a `ParametricPath`.
        about : float, optional
            The instant at which both clocks agree [s]; default: the first one of the path.

        Returns
        -------
        Path
        """
        if varies([factor, about]):
            return self._parametric().at_rate(factor, about)
        fixed = self.breaks[0] if about is None else finite("about", about, "instant")
        return self._with(breaks=fixed + (self.breaks - fixed) / positive("factor", factor))

    def plot(self, order=2):
        """Draw the path and its derivatives over its span.

        Parameters
        ----------
        order : int, optional
            Of the highest derivative.

        Returns
        -------
        (order + 1,) array of Axes
        """
        from matplotlib.figure import Figure

        t = np.linspace(self.breaks[0], self.breaks[-1], 1001)
        jets = self.jets(t, order)
        axes = Figure(figsize=(8.0, 2.0 * len(jets)), layout="constrained").subplots(len(jets), squeeze=False)[:, 0]
        for k, values in enumerate(jets):
            axes[k].plot(t, values.T)
            axes[k].set_ylabel(f"derivative {k}")
        axes[-1].set_xlabel("t [s]")
        return axes

    def __repr__(self):
        span = f"Path: {self.dim} component{'s' * (self.dim > 1)}, t = {self.breaks[0]:g} .. {self.breaks[-1]:g} s"
        lowest, many = self.classes[1:-1].min(initial=np.inf), int(np.isfinite(self.classes[1:-1]).sum())
        between = f", class {lowest:g} at {many} break{'s' * (many > 1)}" * bool(many)
        does = {"continue": "goes on", "periodic": "repeats", "hold": "held", None: "held if at rest"}
        sides = ("before", self.before, self.classes[0]), ("after", self.after, self.classes[-1])
        ends = ", ".join(f"{side}: {does[rule]}" + f" (class {c:g})" * bool(c < np.inf) for side, rule, c in sides)
        text = f"{span}, degree {self.coefficients.shape[2] - 1}{between}\n  {ends}"
        return text + f"\n  {self.remark}" * bool(self.remark)


def _require_dim(dim, other):
    if dim != other:
        raise SpecificationError(
            f"One has {dim} components, the other {other}.",
            "Paths are joined component by component.",
            do="Take components, path[i], or give as many of each.",
            dimensions=(dim, other),
        )


def vector(name, value):
    """An array (n,) of finite numbers, from one number, too."""
    return array_of(name, value if as_numbers(value).ndim else [value], None)


def require_ascending(name, breaks):
    """Refuse breaks (n + 1,) that do not ascend, or are fewer than two."""
    falling = np.flatnonzero(~(np.diff(breaks) > 0))
    if len(breaks) < 2 or len(falling):
        i = int(falling[0]) if len(falling) else 0
        given = ", ".join(f"{t:g}" for t in breaks[i : i + 2])
        raise SpecificationError(
            f"{name} {i} and {i + 1} are {given}." if len(falling) else f"There are {len(breaks)} {name}.",
            "There are at least two, and they ascend.",
            do="Sort them, and remove repeated ones.",
            index=i + 1,
        )


def taylor(coefficients, pieces, tau, order):
    """Taylor coefficients (order + 1, N, dim) of pieces (N,) of a table (n, dim, size), at local times (N,)."""
    tau, result = tau[:, None], np.zeros((order + 1, len(tau), coefficients.shape[1]))
    for j in reversed(range(coefficients.shape[2])):
        result[1:] = result[1:] * tau + result[:-1]
        result[0] = result[0] * tau + coefficients[pieces, :, j]
    return result


def taylor_at(breaks, coefficients, tau):
    """Taylor coefficients (size, n, dim) of all pieces at one local time, in units of half their mean length."""
    n, _, size = coefficients.shape
    lengths = np.diff(breaks)
    with np.errstate(over="ignore", invalid="ignore"):  # of the shortest of very uneven pieces
        unit = (lengths.mean() / lengths) ** np.arange(size)[:, None]
        return taylor(coefficients, np.arange(n), np.full(n, float(tau)), size - 1) * unit[:, :, None]


def _require_rules(before, after):
    named = all(rule is None or isinstance(rule, str) and rule in RULES for rule in (before, after))
    if not named or (before == "periodic") != (after == "periodic"):
        raise SpecificationError(
            f"The path has before={before!r}, after={after!r}.",
            f"Each is one of {', '.join(map(repr, RULES))}, and a path that is periodic is so on both sides.",
            do="Say for each side what the path does there, or before='periodic', after='periodic'.",
            before=before,
            after=after,
        )


def counted(breaks, coefficients, before=None, after=None):
    """The classes (n + 1,) at breaks, as far as derivatives agree up to `COUNTED` of their sizes."""
    _require_rules(before, after)
    starts, stops = (taylor_at(breaks, coefficients, tau) for tau in (-1.0, 1.0))
    jumps = np.concatenate([starts[:, :1], starts[:, 1:] - stops[:, :-1], stops[:, -1:]], axis=1)
    jumps[0, [0, -1]] = 0.0  # at the ends: how many derivatives vanish
    if before == "periodic":
        jumps[:, [0, -1]] = starts[:, :1] - stops[:, -1:]
    sizes = taylor_at(breaks, np.abs(coefficients), 1.0).max(axis=1, keepdims=True)
    agree = (np.abs(jumps) <= COUNTED * sizes).all(axis=2)
    agree[:, [0, -1]] |= [before == "continue", after == "continue"]
    return np.where(agree.all(axis=0), np.inf, agree.argmin(axis=0) - 1.0)


def cut(breaks, expand):
    """Breaks with cuts where large terms of opposite sign are left, coefficients, and which breaks (n + 1,) are cuts.

    Parts whose terms exceed `CANCELLING` times the largest value of a derivative anywhere on the path are halved, as a
    polynomial that is expanded in a shorter interval has smaller terms of higher powers. expand(low, high) returns
    the coefficients (N, dim, size) between instants (N,).
    """
    coefficients, cuts = expand(breaks[:-1], breaks[1:]), np.zeros(len(breaks), dtype=bool)
    for _ in range(HALVINGS):
        terms = taylor_at(breaks, np.abs(coefficients), 1.0)
        values = 0.0
        for tau in (-1.0, 0.0, 1.0, -0.75, 0.75, -0.5, 0.5, -0.25, 0.25):
            values = np.maximum(values, np.abs(taylor_at(breaks, coefficients, tau)).max(axis=1))
            large = (terms > CANCELLING * values[:, None]).any(axis=(0, 2))
            if not large.any():
                return breaks, coefficients, cuts
        behind = np.flatnonzero(large) + 1
        breaks = np.insert(breaks, behind, ((breaks[:-1] + breaks[1:]) / 2)[large])
        cuts, count = np.insert(cuts, behind, True), 1 + large
        halves, coefficients = np.repeat(large, count), np.repeat(coefficients, count, axis=0)
        coefficients[halves] = expand(breaks[:-1][halves], breaks[1:][halves])
    return breaks, coefficients, cuts


def of_one_degree(*tables):
    """Coefficients (n, dim, size) of several tables, filled up with zeros to one size."""
    size = max(c.shape[2] for c in tables)
    return [np.pad(c, ((0, 0), (0, 0), (0, size - c.shape[2]))) for c in tables]


def together(*paths):
    """Coefficients of several paths on common breaks, and what else their sum or stack has, by name of `Path`.

    What they do outside they do together, if they all do it.
    """
    breaks = np.unique(np.concatenate([p.breaks for p in paths]))
    near = SAME * np.abs(breaks).max()
    spans = [p.breaks[[0, -1]] for p in paths]
    if {p.before for p in paths} > {"periodic"} or paths[0].before == "periodic" and np.ptp(spans, axis=0).max() > near:
        given = ", ".join(f"{a:g} .. {b:g} s ({p.before})" for (a, b), p in zip(spans, paths, strict=True))
        raise SpecificationError(
            f"The spans of the paths are {given}.",
            "A periodic path is joined to others of the same period.",
            do="Repeat all in one span, or none.",
            spans=spans,
        )
    breaks = breaks[np.append(True, np.diff(breaks) > near)]
    half, classes = np.diff(breaks) / 2, np.full(len(breaks), np.inf)
    middles = breaks[:-1] + half
    tables = [p._taylor(middles, p.coefficients.shape[2] - 1, half, middles).transpose(1, 2, 0) for p in paths]
    tables = of_one_degree(*tables)
    for p in paths:
        p._require_known(middles, 1)
        np.minimum.at(classes, np.searchsorted(breaks, p.breaks, "right") - 1, p.classes)
    sides = [p.before for p in paths], [p.after for p in paths]
    before, after = (rules[0] if len({*rules}) == 1 else None for rules in sides)
    classes[[0, -1]] = counted(breaks, np.concatenate(tables, axis=1), before, after)[[0, -1]]
    return tables, {"breaks": breaks, "classes": classes, "before": before, "after": after}


def stacked(*paths):
    """One path with the components of several, on common breaks, each of the lowest of their classes."""
    tables, fields = together(*paths)
    return Path(coefficients=np.concatenate(tables, axis=1), **fields)


@frozen(eq=False, repr=False)
class PathAt(Path):
    """A path with the numbers of a model, and the one with parameters that it was made of, its `source`."""

    source: ParametricPath = field(default=None, repr=False)

    def __reduce__(self):
        return PathAt, (*super().__reduce__()[1], self.source)

    def __mul__(self, factor):
        return self.source * factor

    def __add__(self, other):
        return self.source + other

    __radd__ = __add__  # which counts before the other path's own sum

    def __getitem__(self, i):
        return self.source[i]

    def then(self, other):
        """Refused, as of a path with parameters."""
        return self.source.then(other)

    def at_rate(self, factor, about=None):
        """See `Path.at_rate`; the parameters stay."""
        return self.source.at_rate(factor, about)


def path_at(path, numbers, what="The path"):
    """A path with numbers of parameters by name: itself if it contains none. `what` it is begins a message."""
    source = path.source if isinstance(path, PathAt) else path
    if not isinstance(source, ParametricPath):
        return path
    said = f"with {', '.join(f'{name} = {numbers[name]:g}' for name in source.names)}"
    made = source.made(numbers, f"{what} {said}")
    return PathAt(made.breaks, made.coefficients, made.classes, made.before, made.after, said, source)


def numbers_in(symbols, values):
    """The values (n_p,) of parameters by the names that these have in paths."""
    return {symbol.name(): float(value) for symbol, value in zip(symbols, values, strict=False)}


def parameters_of(path):
    """Names of the parameters of a path."""
    return path.names if isinstance(path, ParametricPath) else path.source.names if isinstance(path, PathAt) else ()
