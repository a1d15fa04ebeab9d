"""Laws: what a controller does at each sample, as frozen values; a law with a controller state is started."""

from dataclasses import dataclass, field, replace

import numpy as np

from servoctl.checks import ON_SAMPLE, finite, positive
from servoctl.codegen.function import Compiled
from servoctl.errors import SpecificationError, unknown
from servoctl.values import Value


@dataclass(frozen=True, eq=False)
class Law(Value):
    """A sampled law u = law(t, measurement); made by `feedforward`, `pd`, `lqr` and others.

    At the sample k of t_k = t0 + k/rate, `step` maps t_k, [y; z] and the k-th column of `schedule` to [u; z+; further
    signals]: y is the measurement, z the controller state. Beyond the schedule its last column holds.

    Attributes
    ----------
    name : str
    measures : tuple of str
        Names of the plant's states that are measured, the order of y.
    inputs : tuple of str
        Names of the actuators, the order of u.
    rate : float
        Samples per second [Hz].
    t0 : float
        Instant of the first sample [s].
    step : Compiled or callable
        (t_k, [y; z], row_k) -> [u; z+; further signals].
    schedule : (n_row, N) array
        The gain schedule: what the law needs at each sample, inputs, references and gains.
    state : (n_z,) array
        The controller state z at the start.
    state_names, signals : tuple of str
        Names of the controller state's entries and of the further signals.
    idle : (m,) array
        The inputs before the first command arrives.
    plan : Run or None
        The reference trajectory it was made from.
    info : dict
        Facts of the design: gains, poles, spectral radius.
    integrators : tuple of int
        Which entries of the controller state are integrals of residuals.
    feedback : StateFeedback or None
        Its gains on all states of a plant, where it has such gains.
    input_matrix : (N, n_z, m) array or None
        Of an estimator: how the controller state after each sample changes with the inputs of that sample. An
        allocation that gives others than the law's own corrects the prediction by it.
    allocation : Allocation or None
        How it keeps limits, where it does.
    """

    name: str
    measures: tuple
    inputs: tuple
    rate: float
    t0: float
    step: object
    schedule: np.ndarray
    state: np.ndarray = field(default_factory=lambda: np.zeros(0))
    state_names: tuple = ()
    signals: tuple = ()
    idle: np.ndarray = None
    plan: object = None
    info: dict = field(default_factory=dict)
    integrators: tuple = ()
    feedback: object = None
    input_matrix: np.ndarray = None
    allocation: object = None

    def __post_init__(self):
        schedule = np.asarray(self.schedule, dtype=float)
        object.__setattr__(self, "schedule", np.ascontiguousarray(schedule.T).T)  # loops read it column by column
        if schedule.ndim != 2 or not schedule.shape[1] or not np.isfinite(schedule).all():
            raise SpecificationError(
                f"The schedule of the law {self.name!r} has the shape {schedule.shape}"
                + ("." if np.isfinite(schedule).all() else " and holds NaN or infinity."),
                "It has one column of finite numbers per sample.",
                do="Correct it.",
                shape=schedule.shape,
            )
        positive("rate", self.rate)
        idle = np.zeros(len(self.inputs)) if self.idle is None else np.asarray(self.idle, dtype=float)
        object.__setattr__(self, "idle", idle)
        self._require_sizes()

    def _require_sizes(self):
        """Refuse numbers of measurements, states and signals that the step does not have."""
        sizes = (len(self.measures) + len(self.state), self.schedule.shape[0], self.n_out, self.idle.size)
        of_step = (self.step.n_x, self.step.n_p, self.step.n_y) if hasattr(self.step, "n_x") else sizes[:3]
        valid = (*of_step, len(self.inputs))
        if sizes != valid:
            raise SpecificationError(
                f"The law {self.name!r} has {sizes[0]} measurements and controller states, columns of {sizes[1]} "
                f"numbers, {sizes[2]} outputs and {sizes[3]} idle inputs.",
                f"Its step takes {valid[0]} and columns of {valid[1]}, gives {valid[2]}; its inputs are {valid[3]}.",
                do="Give measures, state, schedule, signals and idle that belong to the step.",
                sizes=sizes,
                valid=valid,
            )

    @property
    def period(self):
        """Ts = 1/rate [s]."""
        return 1.0 / self.rate

    @property
    def n_out(self):
        """The number of outputs of `step`."""
        return len(self.inputs) + len(self.state) + len(self.signals)

    def answer(self, t, x, row):
        """The output of `step` at a sample, checked.

        Parameters
        ----------
        t : float
            [s]
        x : (n_y + n_z,) array
            Measurement and controller state.
        row : (n_row,) array
            Of the schedule.

        Returns
        -------
        (n_out,) array
            Inputs, next controller state, further signals.

        Raises
        ------
        SpecificationError
            If these are not n_out numbers.
        """
        answer = self.step(t, x, row)
        try:
            out = np.asarray(answer, dtype=float).ravel()
        except (TypeError, ValueError):
            out = np.zeros(0)
        if out.size != self.n_out:
            raise SpecificationError(
                f"The law {self.name!r} answered {answer!r} at t = {t:.6g} s."[:200],
                f"It answers {self.n_out} numbers: {', '.join((*self.inputs, *self.state_names, *self.signals))}.",
                do="Return a sequence of them in this order.",
                t=float(t),
                n_out=self.n_out,
            )
        return out

    def begin(self):
        """The step for one run: compiled, or checked at each sample; a user's function with a start is started.

        Returns
        -------
        Compiled or callable
            (t_k, [y; z], row_k) -> [u; z+; further signals].
        """
        if isinstance(self.step, Compiled):
            return self.step
        return (replace(self, step=self.step.started()) if isinstance(self.step, UserStep) else self).answer

    def start(self):
        """A controller that runs this law from its first state on: law(t, measurement) -> u.

        Returns
        -------
        Controller
        """
        return Controller(self)

    def __call__(self, t, measurement):
        """The inputs of a law without a controller state.

        Parameters
        ----------
        t : float
            An instant of sampling [s].
        measurement : (n_y,) array or dict of str to float

        Returns
        -------
        (m,) array

        Raises
        ------
        SpecificationError
            If the law has a controller state, t is between samples, or the measurement has another shape.
        """
        if len(self.state):
            raise SpecificationError(
                f"The law {self.name!r} has the controller state {', '.join(self.state_names)}.",
                "A law is a value and remembers nothing.",
                do="Start it: controller = law.start(); controller(t, measurement).",
                state_names=self.state_names,
            )
        return Controller(self)(t, measurement)

    def row(self, t):
        """The column of the schedule at an instant of sampling, (n_row,).

        Parameters
        ----------
        t : float
            [s]

        Raises
        ------
        SpecificationError
            If t lies between samples, or before the first, or is no finite number.
        """
        t = finite("t", t, "time")
        k = (t - self.t0) * self.rate
        if abs(k - round(k)) > ON_SAMPLE or round(k) < 0:
            nearest = self.t0 + max(round(k), 0) / self.rate
            raise SpecificationError(
                f"The law was evaluated at t = {t:.9g} s.",
                f"It is sampled at {self.rate:g} Hz from t = {self.t0:g} s on.",
                nearest=f"t = {nearest:.9g} s.",
                do="Evaluate it at an instant of sampling.",
                t=t,
            )
        return self.schedule[:, min(round(k), self.schedule.shape[1] - 1)]

    def __repr__(self):
        shown = {name: value for name, value in self.info.items() if isinstance(value, (str, int, float))}
        lines = [
            f"Law: {self.name}, {self.rate:g} Hz, t = {self.t0:g} .. {self._end:g} s, then held",
            f"  measures {', '.join(self.measures) or '(nothing)'}"[:118],
            f"  commands {', '.join(self.inputs)}"[:118],
        ]
        if self.state_names:
            lines.append(f"  controller state: {', '.join(self.state_names)}"[:118])
        lines += [f"  {name}: {v:.4g}" if isinstance(v, float) else f"  {name}: {v}"[:118] for name, v in shown.items()]
        return "\n".join(lines[:12])

    @property
    def _end(self):
        return self.t0 + (self.schedule.shape[1] - 1) / self.rate


class Controller:
    """A law at work: it has the law's state, and changes it at each call; made by `Law.start`.

    Attributes
    ----------
    law : Law
    state : (n_z,) array
        The controller state.
    signals : dict of str to float
        The law's further signals at the last call.
    """

    def __init__(self, law):
        self.law, self.state, self.signals, self._step = law, np.array(law.state, dtype=float), {}, law.begin()

    def __call__(self, t, measurement):
        """The inputs at an instant of sampling.

        Parameters
        ----------
        t : float
            [s]
        measurement : (n_y,) array or dict of str to float

        Returns
        -------
        (m,) array
        """
        law, m, n_z = self.law, len(self.law.inputs), len(self.state)
        y = ordered(measurement, law.measures, "measurement", exactly=False)
        out = self._step(t, np.concatenate([y, self.state]), law.row(t))
        self.state = out[m : m + n_z]
        self.signals = dict(zip(law.signals, out[m + n_z :].tolist(), strict=True))
        return out[:m]

    def __repr__(self):
        return f"Controller of {self.law.name}: state {np.array2string(self.state, precision=4, threshold=8)}"


@dataclass(frozen=True)
class UserStep:
    """A user's function law(t, measurement) -> inputs as the step of a law.

    Attributes
    ----------
    function : callable
        Or what has a method `start` that gives the function.
    name : str
    states, inputs : tuple of str
        Names of the measured states and of the actuators.
    """

    function: object
    name: str
    states: tuple
    inputs: tuple

    @property
    def stateful(self):
        """Whether the function has a state of its own, which `start` resets."""
        return hasattr(self.function, "start")

    def started(self):
        """The same with a function that starts afresh.

        Raises
        ------
        SpecificationError
            If its `start` gives no function.
        """
        function = self.function.start() if self.stateful else self.function
        if not callable(function):
            raise SpecificationError(
                f"The law {self.name!r} was started, and gave a {type(function).__name__}.",
                "A law's start gives the function that answers.",
                do="Return it from start: return lambda t, y: {...}.",
                name=self.name,
            )
        return replace(self, function=function)

    def __call__(self, t, x, _row):
        """The inputs, (m,), of the measured states x, (n_y,), at t [s]."""
        u = self.function(t, dict(zip(self.states, x.tolist(), strict=True)))
        return ordered(u, self.inputs, f"answer of the law {self.name!r} at t = {t:.6g} s")


def ordered(values, names, what, exactly=True):
    """Numbers in the order of their names, (n,), from as many numbers or from a dict.

    Parameters
    ----------
    values : (n,) array or dict of str to float
    names : sequence of str
    what : str
        What the values are, for messages: "measurement".
    exactly : bool
        Whether further names are refused.

    Raises
    ------
    NameUnknown
        If a name is missing, or there are further ones.
    SpecificationError
        If they are not n numbers.
    """
    numbers = values
    if isinstance(values, dict):
        for name in values if exactly else ():
            if name not in names:
                raise unknown(name, names, what)
        for name in names:
            if name not in values:
                raise unknown(name, values, what)
        numbers = [values[name] for name in names]
    try:
        numbers = np.array([float(number) for number in np.ravel(numbers)])
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (len(names),):
        raise SpecificationError(
            f"The {what} is {values!r}."[:200],
            f"It has {len(names)} numbers: {', '.join(names) or '(none)'}.",
            do="Give them in this order, or as a dict.",
            names=names,
        )
    return numbers
