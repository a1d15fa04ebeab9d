"""Treatments of constraint drift: error dynamics by poles, projection, or minimal coordinates."""

from dataclasses import dataclass

import numpy as np

from servoctl.checks import is_whole
from servoctl.errors import SpecificationError, unknown


@dataclass(frozen=True)
class Poles:
    """Error dynamics Π(D - λ_i) ψ = 0 in place of D^ρ ψ = 0 in every row that was raised ρ times.

    Attributes
    ----------
    values : float or dict of str to sequence of complex
        One time constant T [s] (all poles at -1/T), or ρ poles [1/s] per row name; rows that are not named keep
        D^ρ ψ = 0.
    """

    values: object

    def __str__(self):
        return (
            f"poles at {-1 / self.values:g} 1/s"
            if isinstance(self.values, float)
            else f"poles of {', '.join(self.values)}"
        )

    def coefficients(self, model):
        """The coefficients c_0 .. c_(ρ-1) of each row's error dynamics, in the order of the model's pole inputs."""
        found, rows = [], dict(model.pole_rows())
        if isinstance(self.values, dict):
            for name in self.values:
                if name not in rows:
                    raise unknown(name, rows, "row")
        for name, count in rows.items():
            if isinstance(self.values, float):
                poles = [-1.0 / self.values] * count
            else:
                poles = _numbers(name, self.values.get(name, [0.0] * count))
            if len(poles) != count:
                raise SpecificationError(
                    f"{len(poles)} poles were given for the row {name!r}.",
                    f"It is differentiated {count} times, so its error dynamics have {count} poles.",
                    do=f"Give {count} poles.",
                    row=name,
                    count=count,
                )
            polynomial = np.atleast_1d(np.poly(poles))
            if np.abs(polynomial.imag).max(initial=0.0) > 1e-9 * np.abs(polynomial).max():
                raise SpecificationError(
                    f"The poles of {name!r} are not in conjugate pairs.", "Error dynamics are real.", do="Pair them."
                )
            found += list(polynomial.real[:0:-1])
        return np.array(found)


def _numbers(row, poles):
    try:
        found = np.atleast_1d(np.asarray(poles, dtype=complex))
    except (TypeError, ValueError):
        found = np.full(1, np.nan)
    if found.ndim != 1 or not np.all(np.isfinite(found)):
        raise SpecificationError(
            f"The poles {poles!r} were given for the row {row!r}.",
            "Poles are finite numbers [1/s].",
            do="Give [-5.0, -5.0].",
            row=row,
        )
    return found


@dataclass(frozen=True)
class Project:
    """After every `every`-th step, the least change of the jets in the metric M that restores the invariants."""

    every: int = 1

    def __str__(self):
        return "projected after every step" if self.every == 1 else f"projected after every {self.every} steps"


@dataclass(frozen=True)
class Minimal:
    """Only as many values as the program leaves free are integrated, the others solved from the constraints."""

    def __str__(self):
        return "minimal coordinates"


def poles(values):
    """Error dynamics against drift, for `simulate(..., drift=...)`.

    Parameters
    ----------
    values : float or dict of str to sequence of complex
        A time constant [s], or the poles [1/s] of each row by name, as many as `model.raised` says.

    Returns
    -------
    Poles

    Raises
    ------
    SpecificationError
        If the time constant is not positive, or no row is named.
    """
    if isinstance(values, dict):
        if not values:
            raise SpecificationError(
                "Poles of no row were given.", "Error dynamics belong to rows.", do="Give 0.1, or poles by row name."
            )
        return Poles(dict(values))
    try:
        constant = np.nan if isinstance(values, bool) else float(values)
    except (TypeError, ValueError):
        constant = np.nan
    if not (np.isfinite(constant) and constant > 0):
        raise SpecificationError(
            f"The time constant {values!r} was given.",
            "A time constant is a positive number of seconds.",
            do="Give 0.1, or poles by row name.",
        )
    return Poles(constant)


def project(every=1):
    """Projection against drift, for `simulate(..., drift=...)`.

    Parameters
    ----------
    every : int
        Steps between projections.

    Returns
    -------
    Project
    """
    if not is_whole(every) or every < 1:
        raise SpecificationError(f"every={every!r} was given.", "It is a whole number, at least 1.", do="Give 1.")
    return Project(int(every))


def as_drift(value):
    """The treatment that a designer's `drift=` means: None, "project", "minimal", a time constant, or a value."""
    if value is None or isinstance(value, (Poles, Project, Minimal)):
        return value
    if isinstance(value, str):
        if value == "none":
            return None
        if value == "project":
            return Project()
        if value == "minimal":
            return Minimal()
        raise unknown(value, ["none", "project", "minimal", "a time constant [s]"], "drift treatment")
    return poles(value)


class Projector:
    """Level by level, the least change of the jets in the metric M (δq = V δγ) that restores the invariants."""

    def __init__(self, model):
        self.model = model
        self.invariants, self.metric = model.function("invariants"), model.function("metric")
        self.levels = np.array([level for level, _ in model.invariant_names()])
        kinematic = len(self.levels) - sum(count for _, count in model.pole_rows())
        self.kinematic = np.arange(len(self.levels)) < kinematic

    def __call__(self, t, x, iterations=4):
        """The state moved onto the invariants."""
        model, p = self.model, self.model.parameters
        nq, n = model.nq, model.n
        x = np.array(x)
        for level in sorted(set(self.levels)):
            columns = slice(0, nq) if level == 0 else slice(nq + (level - 1) * n, nq + level * n)
            for _ in range(iterations):
                y = self.invariants(t, x, p)
                m = len(self.levels)
                jacobian = y[m:].reshape(len(x), m).T[:, columns]
                change = self._change(t, x, y[:m], jacobian, level)
                x[columns] += change
                if np.abs(change).max(initial=0.0) <= 1e-15 * (1.0 + np.abs(x[columns]).max()):
                    break
        return x

    def _change(self, t, x, values, jacobian, level):
        nq, n = self.model.nq, self.model.n
        y = self.metric(t, x, self.model.parameters)
        mass, frame = y[: n * n].reshape(n, n).T, y[n * n :].reshape(n, nq).T
        own = (self.levels == level) & ~self.kinematic
        change = np.zeros(jacobian.shape[1])
        if level == 0 and self.kinematic.any():
            change -= np.linalg.lstsq(jacobian[self.kinematic], values[self.kinematic], rcond=None)[0]
        rows = jacobian[own] @ frame if level == 0 else jacobian[own]
        if len(rows):
            try:
                root = np.linalg.cholesky(mass)
                step = np.linalg.solve(
                    root.T, np.linalg.lstsq(np.linalg.solve(root, rows.T).T, -values[own], rcond=None)[0]
                )
            except np.linalg.LinAlgError:  # masses that vanish where material constraints hold
                step = np.linalg.lstsq(rows, -values[own], rcond=None)[0]
            change += frame @ step if level == 0 else step
        return change
