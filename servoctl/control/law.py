"""Laws: what a controller does at each sample, as frozen values; a law with a controller state is started."""

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servoctl.checks import ON_SAMPLE, finite, meant, named, positive, require_kind
from servoctl.codegen.function import Compiled
from servoctl.errors import SpecificationError
from servoctl.markup import Shown
from servoctl.run import Run
from servoctl.values import Value, frozen


@frozen(eq=False)
class Law(Value, Shown):
    """A sampled law u = law(t, measurement); made by `feedforward`, `pd`, `lqr` and others.

    At the sampling instant t_k = t0 + k/rate, `step` maps t_k, [y; z] and column k of `schedule` to [u; z+; signals]:
    y is the measurement, z the controller state, u the command. After its end the last column of the schedule holds.

    Attributes
    ----------
    name : str
    measures : tuple of str
        Names of the measured states of the plant, in the order of y.
    inputs : tuple of str
        Names of the actuators, in the order of u.
    rate : float
        Samples per second [Hz].
    t0 : float
        Instant of the first sample [s].
    step : Compiled or callable
        (t_k, [y; z], column k) -> [u; z+; signals].
    schedule : (n_s, N) array
        The gain schedule: feedforward inputs, reference states and gains at each sample.
    state : (n_z,) array
        The initial controller state.
    state_names, signals : tuple of str
        Names of the controller states, and of the further signals.
    initial_input : (m,) array
        The inputs that act until the first command arrives; default 0.
    plan : Run or None
        The reference trajectory of the design.
    info : dict
        Results of the design: gains, poles, spectral radii.
    integrators : tuple of int
        Indices of the controller states that integrate residuals.
    feedback : StateFeedback or None
        Gains on all states of the plant, if the design has them.
    input_matrix : (N, n_z, m) array or None
        For a law with an estimator: the derivative of the next controller state with respect to the inputs of the same
        sample. An allocation uses it to correct the prediction for the inputs that act.
    allocation : Allocation or None
        The allocation of a limited law.
    """

    name: str
    measures: tuple[str, ...]
    inputs: tuple[str, ...]
    rate: float
    t0: float
    step: Callable[..., Any]
    schedule: np.ndarray
    state: np.ndarray = field(default_factory=lambda: np.zeros(0))
    state_names: tuple[str, ...] = ()
    signals: tuple[str, ...] = ()
    initial_input: np.ndarray | None = None
    plan: Run | None = None
    info: dict[str, Any] = field(default_factory=dict)
    integrators: tuple[int, ...] = ()
    feedback: Any = None
    input_matrix: np.ndarray | None = None
    allocation: Any = None

    def __post_init__(self):
        schedule = np.asarray(self.schedule, dtype=float)
        object.__setattr__(self, "schedule", np.ascontiguousarray(schedule.T).T)  # loops read it column by column
        if schedule.ndim != 2 or not schedule.shape[1] or not np.isfinite(schedule).all():
            raise SpecificationError(
                f"The schedule of the law {self.name!r} has the shape {schedule.shape}"
                + ("." if np.isfinite(schedule).all() else " and holds NaN or infinity."),
                "A gain schedule has one column of finite numbers per sample.",
                do="Pass an array of the shape (numbers per sample, samples).",
                name=self.name,
                shape=schedule.shape,
            )
        positive("rate", self.rate)
        initial = np.zeros(len(self.inputs)) if self.initial_input is None else self.initial_input
        object.__setattr__(self, "initial_input", np.asarray(initial, dtype=float))
        self._require_sizes()

    def _require_sizes(self):
        """Refuse numbers of measurements, states and signals that the step does not have."""
        sizes = (len(self.measures) + len(self.state), self.schedule.shape[0], self.n_out, self.initial_input.size)
        of_step = (self.step.n_x, self.step.n_p, self.step.n_y) if hasattr(self.step, "n_x") else sizes[:3]
        valid = (*of_step, len(self.inputs))
        if sizes != valid:
            raise SpecificationError(
                f"The law {self.name!r} has {sizes[0]} measurements and controller states, a schedule of {sizes[1]} "
                f"numbers per sample, {sizes[2]} outputs and {sizes[3]} initial inputs.",
                f"Its step takes {valid[0]} and {valid[1]} and returns {valid[2]}; the law has {valid[3]} inputs.",
                do="Pass measures, state, schedule, signals and initial_input that fit the step.",
                name=self.name,
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

    def answer(self, t, x, column):
        """The output of `step` at a sampling instant, checked.

        Parameters
        ----------
        t : float
            [s]
        x : (n_y + n_z,) array
            Measurement and controller state.
        column : (n_s,) array
            The schedule at t.

        Returns
        -------
        (n_out,) array
            Command, next controller state, further signals.

        Raises
        ------
        SpecificationError
            If `step` does not return n_out numbers.
        """
        states = self.state_names or (f"state {i}" for i in range(len(self.state)))
        names = (*self.inputs, *states, *self.signals)
        return ordered(self.step(t, x, column), names, f"output of the law {self.name!r}", t=float(t))

    def begin(self):
        """The step for one run: a compiled step as it is, another one checked at each sample.

        A user's function that has a method `start` is started.

        Returns
        -------
        Compiled or callable
            (t_k, [y; z], column k) -> [u; z+; signals].
        """
        native = getattr(self.step, "native", None)
        if isinstance(self.step, Compiled) or (native is not None and native("step") is not None):
            return self.step
        return (replace(self, step=self.step.started()) if isinstance(self.step, UserStep) else self).answer

    def start(self) -> "Controller":
        """A controller in the law's initial state: controller(t, measurement) -> u.

        Returns
        -------
        Controller
        """
        return Controller(self)

    def __call__(self, t: float, measurement: ArrayLike | Mapping[str, float]) -> np.ndarray:
        """The command of a law without a controller state.

        Parameters
        ----------
        t : float
            A sampling instant [s].
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
                "A law is a constant value; its controller carries the state from sample to sample.",
                do="Start it: controller = law.start(); controller(t, measurement).",
                name=self.name,
                state_names=self.state_names,
            )
        return Controller(self)(t, measurement)

    def schedule_at(self, t: float) -> np.ndarray:
        """The column of the gain schedule at a sampling instant, (n_s,).

        Parameters
        ----------
        t : float
            [s]

        Raises
        ------
        SpecificationError
            If t is between samples, before the first, or not finite.
        """
        k = sample_at(t, self.t0, self.period, np.inf, f"the law {self.name!r}")
        return self.schedule[:, min(k, self.schedule.shape[1] - 1)]

    def __repr__(self):
        shown = {name: value for name, value in self.info.items() if isinstance(value, (str, int, float))}
        end = self.t0 + (self.schedule.shape[1] - 1) / self.rate
        lines = [
            f"Law: {self.name}, {self.rate:g} Hz, t = {self.t0:g} .. {end:g} s, then held",
            f"  measures {', '.join(self.measures) or '(nothing)'}"[:118],
            f"  commands {', '.join(self.inputs)}"[:118],
        ]
        if self.state_names:
            lines.append(f"  controller state: {', '.join(self.state_names)}"[:118])
        lines += [f"  {name}: {v:.4g}" if isinstance(v, float) else f"  {name}: {v}"[:118] for name, v in shown.items()]
        return "\n".join(lines[:12])


class Controller:
    """A law at work, whose state changes at each call; made by `Law.start`.

    Attributes
    ----------
    law : Law
    state : (n_z,) array
        The controller state.
    signals : dict of str to float
        The law's further signals at the last call.
    """

    def __init__(self, law):
        require_kind(Law, "law", law, "sv.lqr(plan, plant)")
        self.law, self.state, self.signals, self._step = law, np.array(law.state, dtype=float), {}, law.begin()

    def __call__(self, t: float, measurement: ArrayLike | Mapping[str, float]) -> np.ndarray:
        """The command at a sampling instant.

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
        out = self._step(t, np.concatenate([y, self.state]), law.schedule_at(t))
        self.state = out[m : m + n_z]
        self.signals = dict(zip(law.signals, out[m + n_z :].tolist(), strict=True))
        return out[:m]

    def __repr__(self):
        return f"Controller of {self.law.name}: state {np.array2string(self.state, precision=4, threshold=8)}"


@frozen
class UserStep:
    """A user's function law(t, measurement) -> inputs, or an object whose method `start` returns one, as step of a law.

    `states` and `inputs` are the names of the measured states and of the actuators.
    """

    function: object
    name: str
    states: tuple
    inputs: tuple

    @property
    def stateful(self):
        """Whether the function has a state, which `start` resets."""
        return hasattr(self.function, "start")

    def started(self):
        """The same step with its function started, where it has a method `start`."""
        function = self.function.start() if self.stateful else self.function
        if not callable(function):
            raise SpecificationError(
                f"The method start of the law {self.name!r} returned a {type(function).__name__}.",
                "It returns the function that is called at each sample.",
                do="Return it from start: return lambda t, y: {...}.",
                name=self.name,
                kind=type(function).__name__,
            )
        return replace(self, function=function)

    def __call__(self, t, x, _column):
        """The inputs, (m,), of the measured states x, (n_y,), at t [s]."""
        u = self.function(t, dict(zip(self.states, x.tolist(), strict=True)))
        return ordered(u, self.inputs, f"output of the law {self.name!r}", t=float(t))


def sample_at(t, t0, period, last, whose):
    """The index of the sample at t [s], up to the last; `whose` samples they are goes into the message."""
    t = finite("t", t, "time")
    k = min(max(round((t - t0) / period), 0), last)
    nearest = t0 + k * period
    if abs(t - nearest) > ON_SAMPLE * period:
        raise SpecificationError(
            f"t = {t:.9g} s is not a sampling instant of {whose}.",
            f"Its samples are {period:g} s apart, from t = {t0:g} s "
            + (f"to {t0 + last * period:g} s." if last < np.inf else "on."),
            nearest=f"t = {nearest:.9g} s.",
            do="Pass a sampling instant.",
            t=t,
            nearest_t=nearest,
            period=period,
        )
    return k


def ordered(values, names, what, exactly=True, t=None):
    """Numbers in the order of their names, (n,), from an array in this order or from a dict.

    `what` the values are ("measurement") and the instant t [s] go into messages; `exactly` refuses further names in a
    dict.
    """
    numbers = values
    if isinstance(values, dict):
        if exactly:
            values = {meant(n, names, "actuator") or named(n, names, what): value for n, value in values.items()}
        for name in names:
            named(name, values, what)
        numbers = [values[name] for name in names]
    try:
        entries = np.asarray(numbers).ravel()
        numbers = np.zeros(0) if entries.dtype.kind in "USbc" else np.array([float(number) for number in entries])
    except Exception:  # CasADi raises types of its own for symbols
        numbers = np.zeros(0)
    if numbers.shape != (len(names),):
        raise SpecificationError(
            f"The {what} is {values!r}"[:200] + ("." if t is None else f" at t = {t:.6g} s."),
            f"It has {len(names)} numbers: {', '.join(names) or '(none)'}.",
            do="Pass them in this order, or as a dict.",
            names=names,
            what=what,
            t=t,
        )
    return numbers
