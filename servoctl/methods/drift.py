"""Treatments of constraint drift: error dynamics by poles, projection, or minimal coordinates."""

from dataclasses import dataclass

import numpy as np

from servoctl.checks import is_whole
from servoctl.errors import SpecificationError, unknown


@dataclass(frozen=True)
class Poles:
    """Error dynamics Π(D - λ_i) ψ = 0 in place of D^ρ ψ = 0 in every row that was raised ρ times.

    Parameters
    ----------
    values : float or dict of str to sequence of complex
        One time constant T [s] (all poles at -1/T), or ρ poles [1/s] per row name, as many as `model.raised` says;
        rows that are not named keep D^ρ ψ = 0.

    Raises
    ------
    SpecificationError
        If the time constant is not positive, no row is named, or poles are not finite or not in conjugate pairs.
    """

    values: object

    def __post_init__(self):
        checked = _by_row(self.values) if isinstance(self.values, dict) else _time_constant(self.values)
        object.__setattr__(self, "values", checked)

    def __str__(self):
        if isinstance(self.values, float):
            return f"poles at {-1 / self.values:g} 1/s"
        return f"poles of {', '.join(self.values)}"

    def coefficients(self, model):
        """The coefficients c_0 .. c_(ρ-1) of each row's error dynamics, in the order of the model's pole inputs."""
        coefficients, rows = [], model.raised
        if isinstance(self.values, dict):
            for name in self.values:
                if name not in rows:
                    raise unknown(name, rows, "row")
        for name, count in rows.items():
            if isinstance(self.values, float):
                poles = [-1.0 / self.values] * count
            else:
                poles = np.asarray(self.values.get(name, [0.0] * count), dtype=complex)
            if len(poles) != count:
                raise SpecificationError(
                    f"{len(poles)} poles were given for the row {name!r}.",
                    f"It is differentiated {count} times, so its error dynamics have {count} poles.",
                    do=f"Give {count} poles.",
                    row=name,
                    count=count,
                )
            coefficients += list(np.atleast_1d(np.poly(poles)).real[:0:-1])
        return np.array(coefficients)


def _time_constant(value):
    try:
        constant = np.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        constant = np.nan
    if not (np.isfinite(constant) and constant > 0):
        raise SpecificationError(
            f"The time constant {value!r} was given.",
            "A time constant is a positive number of seconds.",
            do="Give 0.1, or poles by row name.",
            value=value,
        )
    return constant


def _by_row(values):
    if not values:
        raise SpecificationError(
            "Poles of no row were given.", "Error dynamics belong to rows.", do="Give 0.1, or poles by row name."
        )
    return {row: _poles(row, poles) for row, poles in values.items()}


def _poles(row, poles):
    """The poles of a row as a tuple, finite and in conjugate pairs."""
    try:
        array = np.atleast_1d(np.asarray(poles, dtype=complex))
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.ndim != 1 or not np.all(np.isfinite(array)):
        raise SpecificationError(
            f"The poles {poles!r} were given for the row {row!r}.",
            "Poles are finite numbers [1/s].",
            do="Give [-5.0, -5.0].",
            row=row,
        )
    polynomial = np.atleast_1d(np.poly(array))
    if np.abs(polynomial.imag).max(initial=0.0) > 1e-9 * np.abs(polynomial).max():
        raise SpecificationError(
            f"The poles of {row!r} are not in conjugate pairs.", "Error dynamics are real.", do="Pair them.", row=row
        )
    return tuple(np.atleast_1d(poles).tolist())


@dataclass(frozen=True)
class Project:
    """After every `every`-th step, the least change of the jets in the metric M that restores the invariants.

    Parameters
    ----------
    every : int
        Steps between projections, at least 1.
    """

    every: int = 1

    def __post_init__(self):
        if not is_whole(self.every) or self.every < 1:
            raise SpecificationError(
                f"every={self.every!r} was given.", "It is a whole number, at least 1.", do="Give 1.", every=self.every
            )
        object.__setattr__(self, "every", int(self.every))

    def __str__(self):
        return "projected after every step" if self.every == 1 else f"projected after every {self.every} steps"


@dataclass(frozen=True)
class MinimalCoordinates:
    """Only as many values as the program leaves free are integrated, the others solved from the constraints."""

    def __str__(self):
        return "minimal coordinates"


SHORT_FORMS = {"none": None, "project": Project(), "minimal": MinimalCoordinates()}


def as_drift(value):
    """The treatment that a designer's `drift=` means: None, a short form, a time constant [s], or a value."""
    if value is None or isinstance(value, (Poles, Project, MinimalCoordinates)):
        return value
    if isinstance(value, str):
        if value not in SHORT_FORMS:
            raise unknown(value, [*SHORT_FORMS, "a time constant [s]"], "drift treatment")
        return SHORT_FORMS[value]
    return Poles(value)
