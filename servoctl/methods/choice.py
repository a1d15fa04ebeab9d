"""What a user passes to `simulate`: methods with their settings, treatments of drift, and which go together."""

from dataclasses import fields, replace

import numpy as np

from servoctl.checks import (
    MOST_JETS,
    as_complex,
    by_name,
    is_whole,
    mapping,
    named,
    positive,
    positive_number,
    tolerance,
    whole_of,
)
from servoctl.codegen.compiler import compiler
from servoctl.errors import SpecificationError, unknown
from servoctl.values import frozen

ORDERS = {"RK4": 4, "RK8": 8}
"""Order of each Runge-Kutta method: the classical one of Kutta (1901), and that of Prince and Dormand (1981)."""
RADAU_ORDERS = (5, 9, 13)  # of RadauIIA, with 3, 5 and 7 stages
SCIPY = ("RK45", "DOP853", "Radau", "LSODA")
EXPLICIT = ("RK45", "DOP853")
SMALLEST_RTOL = 100 * np.finfo(float).eps  # that scipy's methods except LSODA accept: they replace a smaller one
LARGE_FOR_SERIES = 300  # operations of the rates, above which a series takes a second to make, and more to compile
REAL = 1e-9  # imaginary part of a pole polynomial, relative to its largest coefficient, that is rounding


# treatments of drift -------------------------------------------------------------------------------------------------


@frozen
class Poles:
    """Error dynamics Π(D - λ_i) ψ = 0 in place of D^ρ ψ = 0 in every row that was differentiated ρ times.

    Parameters
    ----------
    values : float or dict of str to sequence of complex
        One time constant T [s], which puts all poles at -1/T; or ρ poles [1/s] by row name, with ρ from
        `model.reduction.raised`. Rows without an entry keep D^ρ ψ = 0.

    Raises
    ------
    SpecificationError
        If the time constant is not positive, the dict is empty, or poles are not finite or not in conjugate pairs.
    """

    values: object

    def __post_init__(self):
        by_row = isinstance(self.values, dict)
        checked = _poles_by_row(self.values) if by_row else positive("time constant", self.values)
        object.__setattr__(self, "values", checked)

    def __hash__(self):
        return hash(self.values if isinstance(self.values, float) else frozenset(self.values.items()))

    def __str__(self):
        if isinstance(self.values, float):
            return f"poles at {-1 / self.values:g} 1/s"
        return f"poles of {', '.join(self.values)}"

    def by_row(self, model):
        """The poles [1/s] of every row of a model: {row name: (ρ,) array}."""
        if isinstance(self.values, float):
            return {row: np.full(count, -1.0 / self.values) for row, count in model.reduction.raised.items()}
        values = by_name(self.values, model.reduction.raised, "row", "The poles")
        poles = {row: np.atleast_1d(values.get(row, np.zeros(rho))) for row, rho in model.reduction.raised.items()}
        for row, rho in model.reduction.raised.items():
            if len(poles[row]) != rho:
                raise SpecificationError(
                    f"The row {row!r} has {len(poles[row])} poles.",
                    f"It is differentiated {rho} times, so its error dynamics have {rho} poles.",
                    row=row,
                    count=rho,
                )
        return poles

    def coefficients(self, model):
        """The coefficients c_0 .. c_(ρ-1) of each row's error dynamics, in the order of the model's pole inputs."""
        rows = [np.atleast_1d(np.poly(poles)).real[:0:-1] for poles in self.by_row(model).values()]
        return np.concatenate([*rows, np.zeros(0)])


def _poles_by_row(values):
    if not values:
        raise SpecificationError(
            "The dict of poles names no row.",
            "Error dynamics belong to rows.",
            do="Name a row of model.reduction.raised, or pass a time constant.",
            values=values,
        )
    return {row: _conjugate_poles(row, poles) for row, poles in mapping(values, "The poles").items()}


def _conjugate_poles(row, poles):
    """The poles of a row as a tuple, finite and in conjugate pairs."""
    array = as_complex(poles)
    if array.ndim != 1 or not np.all(np.isfinite(array)):
        raise SpecificationError(
            f"The poles of {row!r} are {poles!r}.",
            "Poles are finite numbers [1/s].",
            do="Pass a list such as [-5.0, -5.0].",
            row=row,
        )
    polynomial = np.atleast_1d(np.poly(array))
    if np.abs(polynomial.imag).max(initial=0.0) > REAL * np.abs(polynomial).max():
        raise SpecificationError(
            f"The poles {poles!r} of {row!r} are not in conjugate pairs.",
            "Error dynamics have real coefficients.",
            row=row,
        )
    return tuple(np.atleast_1d(poles).tolist())


@frozen
class Project:
    """Projection onto the invariants: the least change of the jets in the metric M, of the start and after steps.

    Parameters
    ----------
    every : int
        Steps between projections, at least 1: after every `every`-th.
    """

    every: int = 1

    def __post_init__(self):
        if not is_whole(self.every) or self.every < 1:
            raise SpecificationError(
                f"every={self.every!r} was given.", "It is a whole number of steps, at least 1.", every=self.every
            )
        object.__setattr__(self, "every", int(self.every))

    def __str__(self):
        return "projected after every step" if self.every == 1 else f"projected after every {self.every} steps"


SHORT_FORMS = {"none": None, "project": Project()}


def as_drift(value):
    """The treatment that `drift=` stands for: None, a short form, a time constant [s], or a value."""
    if value is None or isinstance(value, (Poles, Project)):
        return value
    if isinstance(value, str):
        return SHORT_FORMS[named(value, SHORT_FORMS, "drift treatment")]
    return Poles(value)


# methods -------------------------------------------------------------------------------------------------------------


class Method:
    """What all methods share: a short form, and the treatments of drift they refuse, with the reason."""

    forward = True  # integrates from the start on, so that errors grow like those of the internal dynamics
    named_by = ()  # fields that the short form contains
    refused = {}

    def __str__(self):
        return type(self).__name__

    def __repr__(self):
        shown = [f.name for f in fields(self) if f.name in self.named_by or getattr(self, f.name) != f.default]
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in shown)})"

    def _check(self, **valid):
        """Check the fields: whole numbers by the values that are valid, steps and tolerances by their ranges."""
        for name, numbers in valid.items():
            self._check_field(name, whole_of, numbers)
        checks = {"step": (positive_number, np.inf), "rtol": (tolerance, 1.0), "atol": (tolerance, 1.0)}
        for name, (check, most) in checks.items():
            if hasattr(self, name):
                self._check_field(name, check, most)

    def _check_field(self, name, check, rule):
        # None is valid where it is the default: the method then chooses
        if getattr(self, name) is not None or getattr(type(self), name) is not None:
            object.__setattr__(self, name, check(name, getattr(self, name), rule))

    @property
    def settings(self):
        """Names of the fields that the short form does not contain."""
        return [f.name for f in fields(self) if f.name not in self.named_by]


@frozen(repr=False)
class Algebraic(Method):
    """Newton's method at each instant, for programs that determine the motion completely (Σ o_a = 0)."""

    refused = dict.fromkeys((Project, Poles), "Every instant is solved separately, so that nothing drifts.")

    def __str__(self):
        return "algebraic"


@frozen(repr=False)
class Taylor(Method):
    """Compiled Taylor series steps: the most accurate method, with derivatives of any order.

    Parameters
    ----------
    order : int, optional
        Order of the series, 2 to 40; default: the order of least work for rtol.
    jets : int, optional
        Highest derivative in the samples, 1 to 40: `run["d4theta"]`; default s̄. Values above s̄ also give rates of
        the actuation: `run["dtrolley"]`.
    rtol, atol : float
        Tolerances of a step. `rtol` is relative to the largest coordinate, velocity, ...; coordinates count from the
        start, so that steps are the same wherever their origin lies. The defaults keep residuals near 1e-9 over tens of
        seconds. Default atol: 1e-11; a motion that turns out to be so small that this is no small part of it is
        computed again with a smaller one.
    """

    order: int | None = None
    jets: int | None = None
    rtol: float = 1e-9
    atol: float | None = None

    refused = {Poles: "The series are those of the undisturbed rows; error dynamics would need series of their own."}

    def __post_init__(self):
        self._check(order=range(2, MOST_JETS + 1), jets=range(1, MOST_JETS + 1))


@frozen(repr=False)
class RungeKutta(Method):
    """Compiled explicit Runge-Kutta steps of fixed length; the short forms are "RK4" and "RK8".

    Parameters
    ----------
    order : {4, 8}
        The classical one of Kutta, or that of Prince and Dormand.
    step : float, optional
        Step length [s]; default (t1 - t0)/2000. Steps are shortened to end at breaks of paths. A warning is
        issued where they do not resolve the motion.
    """

    order: int = 8
    step: float | None = None

    named_by = ("order",)

    def __post_init__(self):
        self._check(order=tuple(ORDERS.values()))

    def __str__(self):
        return f"RK{self.order}"


@frozen(repr=False)
class Bounded(Method):
    """The bounded motion of unstable internal dynamics, from rest to rest: stable inversion by collocation.

    The run begins before the span and ends after it: the mechanism moves ahead of the program.

    Parameters
    ----------
    window : float
        By how much the run exceeds the span, in time constants of the slowest unstable mode before it and of the
        slowest stable mode after it. The motion is cut off where it is about exp(-window) of its size.
    rtol : float
        Largest defect of the collocation in an interval, relative to the sizes of the state's entries.
    """

    window: float = 10.0
    rtol: float = 1e-9

    forward = False
    refused = dict.fromkeys((Project, Poles), "The constraints hold at every node, so that nothing drifts.")

    def __post_init__(self):
        self._check()
        self._check_field("window", positive_number, 1e3)

    def __str__(self):
        return "bounded"


@frozen(repr=False)
class RadauIIA(Method):
    """Compiled implicit steps, for stiff motions.

    Parameters
    ----------
    order : {5, 9, 13}, optional
        Default: the order of least work for rtol.
    step : float, optional
        Length of fixed steps [s], shortened to end at breaks of paths; default: steps follow from the tolerances.
    rtol, atol : float
        Tolerances of a step, and of the equations solved in it; default atol as for `Taylor`.
    """

    order: int | None = None
    step: float | None = None
    rtol: float = 1e-9
    atol: float | None = None

    def __post_init__(self):
        self._check(order=RADAU_ORDERS)


@frozen(repr=False)
class Adaptive(Method):
    """One of scipy's adaptive methods on compiled right-hand sides.

    Parameters
    ----------
    name : {"RK45", "DOP853", "Radau", "LSODA"}
        As in `scipy.integrate`.
    rtol, atol : float
        Tolerances of a step; rtol at least 2.2e-14 except for "LSODA"; default atol as for `Taylor`.
    """

    name: str = "DOP853"
    rtol: float = 1e-9
    atol: float | None = None

    named_by = ("name",)

    def __post_init__(self):
        named(self.name, SCIPY, "method of scipy")
        self._check()
        if self.rtol < SMALLEST_RTOL and self.name != "LSODA":
            raise SpecificationError(
                f"rtol={self.rtol:g} was given with method={self.name!r}.",
                f"scipy replaces an rtol below {SMALLEST_RTOL:.3g} by this number.",
                nearest=f"rtol={1.01 * SMALLEST_RTOL:.3g}.",
                do="Use this rtol, or method='Taylor', which has no such limit.",
                rtol=self.rtol,
            )

    def __str__(self):
        return self.name

    @property
    def refused(self):
        """The treatment of drift that a multistep method cannot take, with the reason."""
        return {Project: "It carries past states, which projection would contradict."} if self.name == "LSODA" else {}


@frozen(repr=False)
class Automatic(Taylor):
    """The series as a default, in whose place another method takes what does not suit them."""

    def __str__(self):
        return "Taylor"

    for_stiff = property(lambda self: _implicit(self) if self.jets is None else None)  # only series give jets

    @property
    def without_series(self):
        """What goes on where the equations are no series; None for an order that is required."""
        required = self.jets is not None or self.order is not None
        return None if required else AutomaticAdaptive(rtol=self.rtol, atol=self.atol)


@frozen(repr=False)
class AutomaticAdaptive(Adaptive):
    """DOP853 as a default, in whose place another method takes stiff equations and long motions."""

    for_stiff = property(lambda self: _implicit(self))


def _implicit(method):
    """The implicit method with the tolerances of another one: its loop is C code, or scipy's without a compiler."""
    return RadauIIA(rtol=method.rtol, atol=method.atol) if compiler() else Adaptive("Radau", method.rtol, method.atol)


_FAMILIES = ((RungeKutta, ORDERS.values()), (Adaptive, SCIPY))
_NAMED = (family(name) for family, names in _FAMILIES for name in names)
_DEFAULTS = (Algebraic(), Taylor(), RadauIIA(), Bounded(), *_NAMED)
METHODS = {str(method): method for method in _DEFAULTS}
"""The methods with their defaults, by their short forms."""


def as_method(value, **settings):
    """The method that `method=` stands for: itself, or the one with this short form, with its defaults.

    Settings (rtol, atol, step, order, jets) replace those of the method, and None keeps them. Raises NameUnknown for a
    name not in `METHODS`, SpecificationError for a setting that the method does not have or that is out of range.
    """
    method = value if isinstance(value, Method) else METHODS.get(value) if isinstance(value, str) else None
    if method is None:
        raise unknown(value, METHODS, "method")
    settings = {name: setting for name, setting in settings.items() if setting is not None}
    for name, setting in settings.items():
        if name not in method.settings:
            users = ", ".join(short for short, other in METHODS.items() if name in other.settings)
            raise SpecificationError(
                f"{name}={setting!r} was given with method={str(method)!r}.",
                f"{method} takes {', '.join(method.settings) or 'no settings'}.",
                do=f"Leave {name} out, or choose a method that takes it: {users}." if users else f"Leave {name} out.",
                **{name: setting},
            )
    return replace(method, **settings) if settings else method


def default_method(model, drift=None):
    """The method for a model and a treatment of drift if the user names none.

    Series, unless the treatment excludes them, or the equations are so large that making a series takes seconds.
    """
    if model.flat:
        return Algebraic()
    series = type(drift) not in Taylor.refused and model.function("ode").operations <= LARGE_FOR_SERIES
    return Automatic() if series else AutomaticAdaptive()


def require_combination(model, method, drift):
    """Refuse a method and a treatment of drift that do not go together, or not with this model."""
    if isinstance(method, Algebraic) and not model.flat:
        raise SpecificationError(
            "method='algebraic' was given.",
            f"The program leaves {model.free} initial values free, so that internal dynamics must be integrated.",
            nearest=f"{str(default_method(model))!r}.",
            free=model.free,
        )
    if isinstance(method, Bounded) and model.flat:
        raise SpecificationError(
            "method='bounded' was given for a program that determines the motion completely.",
            "Without internal dynamics there is nothing to keep bounded: each instant is a Newton solve.",
            nearest="method='algebraic'.",
            free=0,
        )
    if type(drift) in method.refused:
        forms = {**{repr(form): type(value) for form, value in SHORT_FORMS.items()}, "a time constant": Poles}
        possible = [form for form, treatment in forms.items() if treatment not in method.refused]
        methods = [name for name, other in METHODS.items() if type(drift) not in other.refused and name != "algebraic"]
        raise SpecificationError(
            f"drift={drift!r} was given with method={str(method)!r}.",
            method.refused[type(drift)],
            do=f"Choose drift={', '.join(possible)} for this method, or one of the methods {', '.join(methods)}.",
            method=str(method),
            drift=drift,
            methods=methods,
        )
