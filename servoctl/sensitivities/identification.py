"""Parameters of a plant from measured runs: least squares on its motion under the recorded inputs.

Between samples the inputs are held, and the plant moves by the Runge-Kutta steps of order 4 of the sampled loop. With
the state x its tangents S = ∂x/∂(θ, x_0) are advanced by the same steps, so that the Jacobian of the residuals
(measured less computed, over its standard deviation) is that of the computation itself. First states are unknowns, too.
"""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import partial

import casadi as ca
import numpy as np

from servoctl.checks import named, numbers_by_name, require_kind, texts
from servoctl.control.result import Closed
from servoctl.errors import IntegrationStopped, SpecificationError
from servoctl.markup import Shown
from servoctl.plants.equations import equations_at
from servoctl.plants.plant import Plant, refuse_references
from servoctl.run import ByName
from servoctl.sensitivities.records import as_records
from servoctl.tolerances import TINY
from servoctl.values import Value, frozen

CONVERGES = 1e-10  # of least squares: relative changes of the sum, the unknowns and the gradient
PRIOR = 1e-3  # weight of relative changes of the parameters, against residuals near 1: it decides what is not seen
UNSEEN = 1.0  # relative standard deviation above which the data do not determine a combination of parameters
TAKES_PART = 0.1  # of a direction's length: parameters that take part in a combination
PIECES = (16, 4, 1)  # into which a run is cut, one after the other: over long times a first guess leads far away
SHORTER = 4  # times as many pieces, where the motion is not finite in these
ROUGH = 1e-4  # `CONVERGES` while there are pieces
WORSE = 2.0  # misfit of longer pieces relative to that of shorter ones, which are then the result
MISFIT = 1.25  # times the noise: larger residuals than these say that plant or noise levels are wrong


@frozen(eq=False)
class Identification(ByName, Value, Shown):
    """Parameters of a plant from measured runs; made by `identify`.

    `found["m_load"]` is a value, SI.

    Attributes
    ----------
    names : tuple of str
        Of the parameters.
    values, deviations : (k,) arrays
        The parameters, and their standard deviations; infinite where the data do not determine them.
    covariance : (k, k) array
        With unseen combinations left out.
    unseen : tuple of dict of str to float
        Combinations of relative changes of the parameters that the data do not determine.
    misfit : float
        Root mean square of the residuals relative to the noise: near 1 if plant and noise levels are right.
    starts : tuple of (n_x,) arrays
        First states of the runs.
    residuals : tuple of dict of str to (N,) array
        Measured less computed, for each run by name.
    plant : Plant
        With these parameters.
    success : bool
        Whether the search has converged.
    message : str
    """

    names: tuple
    values: np.ndarray
    deviations: np.ndarray
    covariance: np.ndarray = field(repr=False)
    unseen: tuple
    misfit: float
    starts: tuple = field(repr=False)
    residuals: tuple = field(repr=False)
    plant: Plant = field(repr=False)
    success: bool = True
    message: str = ""

    def __getitem__(self, name):
        return float(self.values[self.names.index(named(name, self.names, "parameter"))])

    def deviation(self, name: str) -> float:
        """The standard deviation of a parameter.

        Parameters
        ----------
        name : str
        """
        return float(self.deviations[self.names.index(named(name, self.names, "parameter"))])

    def __repr__(self):
        count, k = sum(len(values) for run in self.residuals for values in run.values()), len(self.names)
        lines = [f"Identification: {k} parameter{'s' * (k != 1)} from {count} measurements; {self.message}"]
        for name in self.names[:6]:
            lines.append(f"  {name} = {self[name]:.6g}, standard deviation {self.deviation(name):.2g}")
        if k > 6:
            lines.append(f"  and {k - 6} more: {', '.join(self.names[6:])}")
        for direction in self.unseen[:3]:
            parts = " and ".join(f"{name} ({part:+.2f})" for name, part in direction.items())
            lines.append(f"  not seen in the data: {parts}, in relative changes")
        lines.append(f"  residuals are {self.misfit:.3g} times the noise")
        return "\n".join(textwrap.fill(line, 118, subsequent_indent="    ") for line in lines)


def identify(
    plant: Plant,
    measured: Closed | Mapping[str, object] | Sequence[object],
    parameters: Sequence[str] | Mapping[str, float],
    *,
    noise: Mapping[str, float] | None = None,
    start: Mapping[str, float] | np.ndarray | None = None,
) -> Identification:
    """Find parameters of a plant with which its motion under recorded inputs fits measurements best.

    Parameters
    ----------
    plant : Plant
        Without material constraints. Its disturbances are taken to be zero.
    measured : Closed, dict of str to (N,) array, or a sequence of them
        Closed loops, or logs: the times "t" at equal intervals [s], all inputs, which act from their samples on, and
        measurements of states and outputs.
    parameters : sequence of str, or dict of str to float
        Names, and the values from which the search starts (default: those of the plant): parameters of the mechanism,
        "damping_x" for the damping of a coordinate and "lag_trolley" for the lag of an actuator that the plant has.
    noise : dict of str to float, optional
        Standard deviations of the measurements that are used, by name, SI. Default: those of the closed loop's
        sensors, with their quantisation.
    start : dict of str to float or (n_x,) array, optional
        A guess of the first state; it is identified, too. Default: the first measurements, 0 for what is not measured.

    Returns
    -------
    Identification

    Raises
    ------
    NameUnknown
        For names that the plant does not have.
    SpecificationError
        For measurements that lack inputs or values, or are not sampled at equal intervals or far too seldom, for plants
        with material constraints, and for first values by which the mass matrix is not positive definite.
    IntegrationStopped
        If the plant's motion is not finite at the values from which the search starts.

    Notes
    -----
    The covariance is that of the linearised problem, (JᵀJ)⁻¹, first states included as unknowns. The mass matrix stays
    positive definite during the search, and lags stay positive.
    """
    require_kind(Plant, "plant", plant, "sv.plant(mechanism)")
    _require_free(plant)
    names, theta = _first_values(plant, parameters)
    _require_inertia(plant, names, theta)
    records, noise = as_records(plant, measured, noise, start)
    sizes, best = np.abs(theta), None
    for count in (SHORTER * PIECES[0], *PIECES):
        problem = _Problem(plant, names, records, noise, count)
        if best is None and count == SHORTER * PIECES[0] and problem.finite(theta, PIECES[0]):
            continue
        fit = _fitted(problem, theta if best is None else best.unknowns[: len(names)], theta)
        if fit is not None and (best is None or fit.misfit < WORSE * max(best.misfit, 1.0)):
            best, records = fit, problem.followed(fit.unknowns)
    if best is None:
        raise IntegrationStopped(
            "The motion of the plant under the recorded inputs is not finite.",
            "The search starts from a motion near the measured one.",
            do="Pass other first values of the parameters or of the state.",
            parameters=dict(zip(names, theta.tolist(), strict=True)),
        )
    return _identified(plant, best, sizes)


def _require_free(plant):
    if plant.constrained:
        raise SpecificationError(
            f"The plant has the invariants {', '.join(plant.constraint_names())}.",
            "The first states of a plant are identified, which takes independent coordinates.",
            do="Write the mechanism in coordinates without material constraints.",
            invariants=plant.constraint_names(),
        )
    refuse_references(plant, "The identification is")


def _places(plant):
    """Indices among the plant's numbers of its parameters, dampings and lags by name."""
    names = [*plant.mechanism.parameters.names, *(f"damping_{name}" for name in plant.damping)]
    return {name: i for i, name in enumerate([*names, *(f"lag_{name}" for name in plant.lagged)])}


def _first_values(plant, parameters):
    """Names (k,) and first values (k,) of the parameters."""
    places = _places(plant)
    given = parameters if isinstance(parameters, Mapping) else {}
    given = numbers_by_name(dict(given), places, "parameter", "first value")
    listed = tuple(given) or texts(parameters, "The names of parameters")
    names = tuple(named(name, places, "parameter") for name in listed)
    if not names or len(set(names)) < len(names):
        raise SpecificationError(
            f"The parameters are {', '.join(names)}." if names else "No parameter is named.",
            "A search is for at least one parameter, and names each of them once.",
            do=f"Choose among {', '.join(places)}." if places else "Give the mechanism parameters=sv.parameters(...).",
            parameters=names,
        )
    own = plant.parameters[[places[name] for name in names]]
    own = [1 / value if name.startswith("lag_") else value for name, value in zip(names, own, strict=True)]
    return names, np.array([given.get(name, value) for name, value in zip(names, own, strict=True)])


def _numbers(plant, names, theta):
    """All numbers of the plant with these parameters (k,)."""
    p, places = plant.parameters.copy(), _places(plant)
    for name, value in zip(names, theta, strict=True):
        p[places[name]] = 1 / value if name.startswith("lag_") else value
    return p


def _require_inertia(plant, names, theta):
    """Refuse lags that are not positive, and parameters by which the mass matrix is not positive definite."""
    for name, value in zip(names, theta, strict=True):
        if name.startswith("lag_") and not value > 0:
            raise SpecificationError(
                f"The first value of {name!r} is {value:g} s.", "A lag must be positive.", name=name, value=float(value)
            )
    plant.equations.require_inertia(_numbers(plant, names, theta)[: len(plant.mechanism.parameters.names)])


class _Problem:
    """Residuals of records, cut into pieces, as functions of (parameters, first states), with their Jacobian."""

    def __init__(self, plant, names, records, noise, count):
        self.plant, self.names, self.records, self.noise, self.count = plant, names, records, noise, count
        self.pieces = [(i, a, piece) for i, record in enumerate(records) for a, piece in record.pieces(count)]
        self.k, self.n_x, self.weights = len(names), plant.n_x, np.array(list(noise.values()))
        self._latest = None, None, None

    def first(self, theta):
        """Unknowns of these parameters and the guesses of the first states."""
        return np.concatenate([theta, *(piece.states[:, 0] for _, _, piece in self.pieces)])

    def finite(self, theta, count):
        """Whether the motion is finite in so many pieces."""
        other = _Problem(self.plant, self.names, self.records, self.noise, count)
        return bool(np.isfinite(other.residuals(other.first(theta))).all())

    def residuals(self, unknowns):
        """Measured less computed, over the noise, of all pieces."""
        return self._evaluated(unknowns)[0]

    def jacobian(self, unknowns):
        """Their derivatives by the unknowns."""
        return self._evaluated(unknowns)[1]

    def by_name(self, unknowns):
        """Measured less computed for each record, by name."""
        result, values = [{name: [] for name in self.noise} for _ in self.records], self.residuals(unknowns)
        for i, _, piece in self.pieces:
            own, values = np.split(values, [len(piece.t) * len(self.noise)])
            for row, (name, level) in zip(own.reshape(len(self.noise), -1), self.noise.items(), strict=True):
                result[i][name].append(level * row)
        return tuple({name: np.concatenate(rows) for name, rows in record.items()} for record in result)

    def followed(self, unknowns):
        """The records with the computed states as guesses."""
        states = [record.states.copy() for record in self.records]
        for (i, a, piece), x in zip(self.pieces, self.starts(unknowns), strict=True):
            states[i][:, a : a + len(piece.t)] = self._moved(piece, unknowns[: self.k], x)[: self.n_x]
        return [replace(record, states=x) for record, x in zip(self.records, states, strict=True)]

    def starts(self, unknowns):
        """First states of the pieces."""
        return tuple(unknowns[self.k :].reshape(-1, self.n_x))

    def first_states(self, unknowns):
        """First states of the records."""
        return tuple(x for (_, a, _), x in zip(self.pieces, self.starts(unknowns), strict=True) if a == 0)

    def _evaluated(self, unknowns):
        """Residuals and their derivatives; infinite where the plant is none, so that no search goes there."""
        if self._latest[0] is None or not np.array_equal(self._latest[0], unknowns):
            try:
                _require_inertia(self.plant, self.names, unknowns[: self.k])
            except SpecificationError:
                count = len(self.noise) * sum(len(piece.t) for _, _, piece in self.pieces)
                return np.full(count, np.inf), np.full((count, len(unknowns)), np.inf)
            values, slopes = [], []
            for i, ((_, _, piece), x) in enumerate(zip(self.pieces, self.starts(unknowns), strict=True)):
                value, slope = self._computed(piece, unknowns[: self.k], x)
                rows, here = np.zeros((len(value), len(unknowns))), self.k + i * self.n_x
                rows[:, : self.k], rows[:, here : here + self.n_x] = slope[:, : self.k], slope[:, self.k :]
                values.append(value)
                slopes.append(rows)
            self._latest = unknowns.copy(), np.concatenate(values), np.concatenate(slopes)
        return self._latest[1:]

    def _moved(self, piece, theta, x):
        """States with their tangents at the samples of a piece, column by column."""
        steps = piece.held.shape[1]
        t = piece.t[0] + piece.step * np.arange(steps)
        z = np.concatenate([x, np.zeros(self.n_x * self.k), np.eye(self.n_x).ravel()])
        moved = self._rollout(steps)(z, np.vstack([t, np.full(steps, piece.step), piece.held]), theta)
        return np.column_stack([z, np.array(moved)[:, piece.substeps - 1 :: piece.substeps]])

    def _computed(self, piece, theta, x):
        """Residuals of a piece and their derivatives by the parameters and its first state."""
        count = len(piece.t)
        y = np.array(self._measurements.map(count)(piece.t, self._moved(piece, theta, x), piece.inputs, theta))
        y = y.reshape(len(self.noise), self.k + self.n_x + 1, count, order="F") / self.weights[:, None, None]
        measured = np.array([piece.measured[name] for name in self.noise]) / self.weights[:, None]
        return (measured - y[:, 0]).ravel(), -y[:, 1:].swapaxes(1, 2).reshape(-1, self.k + self.n_x)

    # functions of the plant, cached with its equations

    def _kept(self, what, build):
        functions = self.plant.equations.functions
        key = f"{what} {' '.join(self.names)} {self.plant.parameters.tobytes().hex()}"
        if key not in functions:
            functions[key] = build()
        return functions[key]

    def _rollout(self, steps):
        return self._kept(f"rollout {steps}", lambda: self._step.mapaccum("rollout", steps))

    @property
    def _symbols(self):
        """t, x, S, u, θ and the plant's numbers with θ, u and no disturbances."""
        theta, u = ca.SX.sym("theta", self.k), ca.SX.sym("u", len(self.plant.inputs))
        p = ca.SX(self.plant.parameters)
        for i, name in enumerate(self.names):
            p[_places(self.plant)[name]] = 1 / theta[i] if name.startswith("lag_") else theta[i]
        p = ca.vertcat(p, u, ca.SX.zeros(len(self.plant.disturbable)))
        x, S = ca.SX.sym("x", self.n_x), ca.SX.sym("S", self.n_x, self.k + self.n_x)
        return ca.SX.sym("t"), x, S, u, theta, p

    @property
    def _step(self):
        """One Runge-Kutta step of the state with its tangents."""

        def build():
            t, x, S, u, theta, p = self._symbols
            rates = self.plant.function("ode").expression(t, x, p)
            tangents = ca.jacobian(rates, x) @ S + ca.horzcat(
                ca.jacobian(rates, theta), ca.SX.zeros(self.n_x, self.n_x)
            )
            z = ca.vertcat(x, ca.vec(S))
            f = ca.Function("f", [t, z, u, theta], [ca.cse(ca.densify(ca.vertcat(rates, ca.vec(tangents))))])
            h = ca.SX.sym("h")
            k1 = f(t, z, u, theta)
            k2 = f(t + h / 2, z + h / 2 * k1, u, theta)
            k3 = f(t + h / 2, z + h / 2 * k2, u, theta)
            k4 = f(t + h, z + h * k3, u, theta)
            return ca.Function("step", [z, ca.vertcat(t, h, u), theta], [z + h / 6 * (k1 + 2 * (k2 + k3) + k4)])

        return self._kept("step", build)

    @property
    def _measurements(self):
        """Measured quantities and their tangents, column by column."""

        def build():
            t, x, S, u, theta, p = self._symbols
            outputs = dict(zip(self.plant.state_names, x.elements(), strict=True))
            if set(self.noise) - set(outputs):
                y = self.plant.function("outputs").expression(t, x, p)
                outputs |= dict(zip(self.plant.mechanism.outputs, y.elements(), strict=True))
            y = ca.vertcat(*(outputs[name] for name in self.noise))
            by_theta = ca.horzcat(ca.jacobian(y, theta), ca.SX.zeros(y.numel(), self.n_x))
            rows = ca.horzcat(y, ca.jacobian(y, x) @ S + by_theta)
            return ca.Function("y", [t, ca.vertcat(x, ca.vec(S)), u, theta], [ca.densify(ca.vec(rows))])

        return self._kept(f"measurements {' '.join(self.noise)}", build)


@frozen
class _Fit:
    """The least-squares solution of a problem; `status` is SciPy's."""

    problem: _Problem
    unknowns: np.ndarray
    misfit: float
    status: int


def _fitted(problem, theta, first):
    """The `_Fit` of a problem; None if no motion is finite.

    The search starts from `theta` (k,); combinations that cannot be seen stay where they were in `first` (k,).
    """
    from scipy.optimize import least_squares
    from scipy.sparse import csr_array

    unknowns = problem.first(theta)
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = [(values**2).sum() for values in (problem.residuals(unknowns), problem.jacobian(unknowns))]
    if not np.isfinite(sizes).all():
        return None
    k, scale = problem.k, PRIOR / np.where(first != 0, np.abs(first), 1.0)
    tolerance, form = (ROUGH, csr_array) if problem.count > 1 else (CONVERGES, np.asarray)
    options = {"x_scale": "jac", "xtol": tolerance, "ftol": tolerance, "gtol": tolerance}
    prior = np.column_stack([np.diag(scale), np.zeros((k, len(unknowns) - k))])

    def residuals(x):
        return np.append(problem.residuals(x), scale * (x[:k] - first))

    def jacobian(x, open_):
        return form(np.vstack([problem.jacobian(x), prior]) * open_)

    def search(x, open_):
        return least_squares(residuals, x, partial(jacobian, open_=open_), **options)

    with np.errstate(all="ignore"):
        try:
            if problem.count > 1:  # the guesses of first states are far worse than those of the parameters
                unknowns = search(unknowns, np.arange(len(unknowns)) >= k).x
            found = search(unknowns, True)
        except np.linalg.LinAlgError:  # of derivatives that are not finite
            return None
    values = problem.residuals(found.x)
    misfit = np.sqrt(values @ values / max(len(values) - len(unknowns), 1))
    return _Fit(problem, found.x, float(misfit), found.status)


def _identified(plant, fit, sizes):
    """The identification of a fit; `sizes` (k,) are those of the first values of the parameters."""
    problem, x = fit.problem, fit.unknowns
    theta, J = x[: problem.k], problem.jacobian(x)
    sizes = np.maximum(np.abs(theta), sizes)
    sizes = np.where(sizes > 0, sizes, 1.0)
    covariance, deviations, unseen = _determined(problem.names, J[:, : problem.k] * sizes, J[:, problem.k :])
    return Identification(
        problem.names,
        theta,
        deviations * sizes,
        covariance * np.outer(sizes, sizes),
        unseen,
        fit.misfit,
        problem.first_states(x),
        problem.by_name(x),
        _with_numbers(plant, _numbers(plant, problem.names, x[: problem.k])),
        fit.status > 0,
        _message(fit, unseen),
    )


def _message(fit, unseen):
    if fit.status <= 0:
        return "the search has not converged"
    parts = ["converged"]
    if fit.problem.count > 1:
        parts.append(f"in {len(fit.problem.pieces)} pieces, as longer motions diverge")
    if fit.misfit > MISFIT:
        parts.append("but residuals exceed the noise: the plant or the noise levels are wrong")
    return ", ".join(parts) + ("; not all are seen" if unseen else "")


def _determined(names, by_parameters, by_starts):
    """Relative covariance (k, k) and deviations (k,), and the combinations that the data do not determine.

    What first states explain is taken out of the derivatives by the parameters.
    """
    from scipy.linalg import orth

    lengths = np.linalg.norm(by_starts, axis=0)
    Q = orth(by_starts / np.where(lengths > 0, lengths, 1.0))
    _, singular, directions = np.linalg.svd(by_parameters - Q @ (Q.T @ by_parameters), full_matrices=False)
    deviations = 1 / np.maximum(singular, TINY)
    seen = deviations <= UNSEEN
    parts = directions[seen] * deviations[seen, None]
    covariance = parts.T @ parts
    parts = [{n: float(d) for n, d in zip(names, v, strict=True) if abs(d) > TAKES_PART} for v in directions[~seen]]
    lost = (np.abs(directions[~seen]) > TAKES_PART).any(axis=0)
    return covariance, np.where(lost, np.inf, np.sqrt(np.diag(covariance))), tuple(parts)


def _with_numbers(plant, numbers):
    """The plant with other numbers."""
    count = len(plant.mechanism.parameters.names)
    damping = dict(zip(plant.damping, numbers[count:].tolist(), strict=False))
    lag = {name: 1 / rate for name, rate in zip(plant.lagged, numbers[len(numbers) - len(plant.lag) :], strict=True)}
    equations = equations_at(plant.equations, numbers[:count])
    return replace(plant, parameters=numbers, damping=damping, lag=lag, equations=equations)
