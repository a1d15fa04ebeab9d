"""Methods as values: what `simulate(..., method=)` takes, its settings, and the treatments of drift it goes with."""

from dataclasses import dataclass, fields, replace

import numpy as np

from servoctl.checks import is_number, is_whole
from servoctl.errors import SpecificationError, unknown
from servoctl.methods.drift import SHORT_FORMS, MinimalCoordinates, Poles, Project
from servoctl.methods.radau import RADAU_ORDERS
from servoctl.methods.runge_kutta import ORDERS

SCIPY = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")
EXPLICIT, MULTISTEP = ("RK23", "RK45", "DOP853"), ("BDF", "LSODA")
SUNDIALS = ("CVODES", "IDAS")
LEAST_RTOL = 100 * np.finfo(float).eps  # least rtol of scipy's methods but LSODA
HIGHEST = 40  # order of a series, and level of jets

PAST_STATES = "A multistep method carries past states, which projection would contradict."
MOVING_CHART = (
    "The choice of coordinates changes along the motion, which past states and compiled loops would not notice."
)


def _positive(name, value, most=np.inf):
    if not (is_number(value) and 0 < value <= most):
        bound = f", at most {most:g}" if np.isfinite(most) else ""
        raise SpecificationError(
            f"{name}={value!r} was given.",
            f"{'A step' if name == 'step' else 'A tolerance'} is a positive number{bound}.",
            nearest=f"{name}={most:g}." if is_number(value) and value > most else "",
            do=f"Give another, or leave {name} out.",
            **{name: value},
        )
    return float(value)


def _whole_number(name, value, low):
    if not (is_whole(value) and low <= value <= HIGHEST):
        raise SpecificationError(
            f"{name}={value!r} was given.",
            f"It is a whole number from {low} to {HIGHEST}.",
            nearest=f"{name}={int(np.clip(np.round(value), low, HIGHEST))}." if is_number(value) else "",
            do=f"Give another, or leave {name} out.",
            **{name: value},
        )
    return int(value)


def _one_of(name, value, valid, method):
    if not (is_whole(value) and value in valid):
        raise SpecificationError(
            f"{name}={value!r} was given to {method}.",
            f"It has the orders {', '.join(map(str, valid))}.",
            nearest=f"{name}={min(valid, key=lambda order: abs(order - value))}." if is_number(value) else "",
            do="Give one of them.",
            **{name: value},
        )
    return int(value)


class Method:
    """What all methods share: a short form, and the treatments of drift they refuse, with the reason."""

    named_by = ()  # fields that the short form tells
    refused = {}

    def __str__(self):
        return type(self).__name__

    def __repr__(self):
        shown = [f.name for f in fields(self) if f.name in self.named_by or getattr(self, f.name) != f.default]
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in shown)})"

    def _set(self, **checked):
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def _set_tolerances(self):
        self._set(rtol=_positive("rtol", self.rtol, 1.0), atol=_positive("atol", self.atol, 1.0))


@dataclass(frozen=True, repr=False)
class Algebraic(Method):
    """Newton's method at each instant, for programs that determine the motion completely (Σ o_a = 0)."""

    refused = dict.fromkeys((Project, Poles), "Where every instant is solved for itself nothing drifts.")

    def __str__(self):
        return "algebraic"


@dataclass(frozen=True, repr=False)
class Taylor(Method):
    """Compiled series steps: the most accurate method, with derivatives of any order.

    Parameters
    ----------
    order : int, optional
        Of the series, 2 to 40; default: that of least work for rtol.
    jets : int, optional
        Highest derivative in the samples, 1 to 40: `run["d4theta"]`; default s̄. With more than s̄ rates of the
        actuation follow: `run["dtrolley"]`.
    rtol, atol : float
        Tolerances of a step. The defaults keep residuals near 1e-9 over tens of seconds.
    """

    order: int | None = None
    jets: int | None = None
    rtol: float = 1e-9
    atol: float = 1e-11

    refused = {
        Poles: "The series are those of the undisturbed rows; error dynamics would need series of their own.",
        MinimalCoordinates: "The series give every jet from the rows themselves: nothing is solved for the others.",
    }

    def __post_init__(self):
        order, jets = (
            None if value is None else _whole_number(name, value, low)
            for name, value, low in (("order", self.order, 2), ("jets", self.jets, 1))
        )
        self._set(order=order, jets=jets)
        self._set_tolerances()


@dataclass(frozen=True, repr=False)
class RungeKutta(Method):
    """Compiled explicit Runge-Kutta steps of fixed length; its short forms are "RK1" to "RK8".

    Parameters
    ----------
    order : {1, 2, 4, 5, 8}
        Euler's method, the midpoint rule, the classical one of Kutta, and Dormand and Prince's of orders 5 and 8.
    step : float, optional
        [s]; default (t1 - t0)/2000. Shortened so that steps end at the knots of paths; steps that do not resolve the
        motion are warned about.
    """

    order: int = 8
    step: float | None = None

    named_by = ("order",)

    def __post_init__(self):
        self._set(order=_one_of("order", self.order, ORDERS.values(), "RungeKutta"))
        self._set(step=None if self.step is None else _positive("step", self.step))

    def __str__(self):
        return f"RK{self.order}"


@dataclass(frozen=True, repr=False)
class RadauIIA(Method):
    """Compiled implicit steps, for stiff motions.

    Parameters
    ----------
    order : {5, 9, 13}, optional
        Default: that of least work for rtol.
    step : float, optional
        Length of fixed steps [s], shortened to end at knots; default: steps follow from the tolerances.
    rtol, atol : float
        Tolerances of a step, and of the equations solved in it.
    """

    order: int | None = None
    step: float | None = None
    rtol: float = 1e-9
    atol: float = 1e-11

    refused = {MinimalCoordinates: MOVING_CHART}

    def __post_init__(self):
        self._set(order=None if self.order is None else _one_of("order", self.order, RADAU_ORDERS, "RadauIIA"))
        self._set(step=None if self.step is None else _positive("step", self.step))
        self._set_tolerances()


@dataclass(frozen=True, repr=False)
class Adaptive(Method):
    """One of scipy's adaptive methods on compiled right-hand sides.

    Parameters
    ----------
    name : {"RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA"}
        As in `scipy.integrate`.
    rtol, atol : float
        Tolerances of a step; rtol at least 2.2e-14 but for "LSODA".
    """

    name: str = "DOP853"
    rtol: float = 1e-9
    atol: float = 1e-11

    named_by = ("name",)

    def __post_init__(self):
        if self.name not in SCIPY:
            raise unknown(self.name, SCIPY, "method of scipy")
        self._set_tolerances()
        if self.rtol < LEAST_RTOL and self.name != "LSODA":
            raise SpecificationError(
                f"rtol={self.rtol:g} was given with method={self.name!r}.",
                f"scipy's methods take {LEAST_RTOL:.3g} instead of less.",
                nearest=f"rtol={1.01 * LEAST_RTOL:.3g}; method='Taylor' has no such limit.",
                do="Change one of them.",
                rtol=self.rtol,
            )

    def __str__(self):
        return self.name

    @property
    def refused(self):
        """Treatments of drift that a method with a memory cannot take."""
        return {Project: PAST_STATES, MinimalCoordinates: MOVING_CHART} if self.name in MULTISTEP else {}


@dataclass(frozen=True, repr=False)
class Sundials(Method):
    """The multistep methods of SUNDIALS, through CasADi: "IDAS" integrates the rows before elimination.

    Parameters
    ----------
    name : {"CVODES", "IDAS"}
    rtol, atol : float
        Tolerances of a step.
    """

    name: str = "CVODES"
    rtol: float = 1e-9
    atol: float = 1e-11

    named_by = ("name",)
    refused = {Project: PAST_STATES, MinimalCoordinates: MOVING_CHART}

    def __post_init__(self):
        if self.name not in SUNDIALS:
            raise unknown(self.name, SUNDIALS, "method of SUNDIALS")
        self._set_tolerances()

    def __str__(self):
        return self.name


_FAMILIES = ((RungeKutta, ORDERS.values()), (Adaptive, SCIPY), (Sundials, SUNDIALS))
_DEFAULTS = (Algebraic(), Taylor(), RadauIIA(), *(family(name) for family, names in _FAMILIES for name in names))
METHODS = {str(method): method for method in _DEFAULTS}
"""The methods with their defaults, by their short forms."""


def as_method(value, **settings):
    """The method that a designer's `method=` means.

    Parameters
    ----------
    value : str or Method
        The short form of a method stands for its value with the defaults.
    **settings
        In place of the defaults: rtol, atol, step, order, jets; None leaves the default.

    Returns
    -------
    Method

    Raises
    ------
    NameUnknown
        For another name.
    SpecificationError
        For a setting that the method does not have, or that makes no sense.
    """
    method = value if isinstance(value, Method) else METHODS.get(value) if isinstance(value, str) else None
    if method is None:
        raise unknown(value, METHODS, "method")
    known, settings = setting_names(method), {name: s for name, s in settings.items() if s is not None}
    for name, setting in settings.items():
        if name not in known:
            users = ", ".join(short for short, other in METHODS.items() if name in setting_names(other))
            raise SpecificationError(
                f"{name}={setting!r} was given with method={str(method)!r}.",
                f"{method} takes {', '.join(known) or 'no settings'}; {name} belongs to {users or 'none'}.",
                do=f"Leave {name} out, or take a method that has it.",
                **{name: setting},
            )
    return replace(method, **settings)


def default_method(model):
    """The method for a model where none is given."""
    return Algebraic() if model.flat else Adaptive()


def require_combination(model, method, drift):
    """Refuse a method and a treatment of drift that do not go together, or not with this model.

    Parameters
    ----------
    model : Model
    method : Method
    drift : None, Project, Poles or MinimalCoordinates

    Raises
    ------
    SpecificationError
    """
    if isinstance(method, Algebraic) and not model.flat:
        raise SpecificationError(
            "method='algebraic' was given.",
            f"The program leaves {model.free} initial values free: an internal dynamics remains to be integrated.",
            nearest=f"{str(default_method(model))!r}.",
            do="Leave the method out.",
            free=model.free,
        )
    given = f"drift={drift!r} was given with method={str(method)!r}"
    if isinstance(drift, MinimalCoordinates) and model.flat and not isinstance(method, Algebraic):
        raise SpecificationError(
            f"{given} for a program that determines the motion completely.",
            "Without free initial values nothing is left to integrate: each instant is a Newton solve.",
            nearest="method='algebraic'.",
            do="Leave the method out.",
            free=0,
        )
    if type(drift) in method.refused:
        forms = {**{repr(form): type(value) for form, value in SHORT_FORMS.items()}, "a time constant": Poles}
        taken = [form for form, treatment in forms.items() if treatment not in method.refused]
        others = [name for name, other in METHODS.items() if type(drift) not in other.refused and name != "algebraic"]
        raise SpecificationError(
            f"{given}.",
            method.refused[type(drift)],
            nearest=f"with this method drift={', '.join(taken)}; with this treatment {', '.join(others)}.",
            do="Change one of them.",
            method=str(method),
            drift=drift,
            methods=others,
        )


def setting_names(method):
    """Names of what may be set beside what the short form tells."""
    return [f.name for f in fields(method) if f.name not in method.named_by]
