"""Laws: what a controller does at each sample, as frozen values; a law with memory is started."""

from dataclasses import dataclass, field

import numpy as np

from servoctl.checks import ON_SAMPLE, finite
from servoctl.errors import SpecificationError, unknown
from servoctl.values import Value

_SIZES = ("n_x", "n_p", "n_y")  # of a compiled step: what it takes, its row, what it gives


@dataclass(frozen=True, eq=False)
class Law(Value):
    """A sampled law u = law(t, measurement); made by `feedforward`, `pd`, `lqr` and others.

    At the sample k of t_k = t0 + k/rate, `step` maps t_k, [y; z] and the k-th column of `table` to [u; z+; further
    signals]: y is the measurement, z the memory. Beyond the table its last column holds.

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
    table : (n_row, N) array
        What the law needs at each sample: inputs, references, gains.
    memory : (n_z,) array
        The memory z at the start.
    memory_names, signals : tuple of str
        Names of the memory and of the further signals.
    idle : (m,) array
        The inputs before the first command arrives.
    plan : Run or None
        The plan it was made from.
    info : dict
        Facts of the design: gains, poles, spectral radius.
    """

    name: str
    measures: tuple
    inputs: tuple
    rate: float
    t0: float
    step: object
    table: np.ndarray
    memory: np.ndarray = field(default_factory=lambda: np.zeros(0))
    memory_names: tuple = ()
    signals: tuple = ()
    idle: np.ndarray = None
    plan: object = None
    info: dict = field(default_factory=dict)

    def __post_init__(self):
        table = np.asarray(self.table, dtype=float)
        object.__setattr__(self, "table", np.ascontiguousarray(table.T).T)  # loops read it column by column
        if table.ndim != 2 or not table.shape[1] or not np.isfinite(table).all():
            raise SpecificationError(
                f"The table of the law {self.name!r} has the shape {table.shape}"
                + ("." if np.isfinite(table).all() else " and holds NaN or infinity."),
                "It has one column of finite numbers per sample.",
                do="Correct it.",
            )
        if finite("rate", self.rate) <= 0:
            raise SpecificationError(
                f"The law {self.name!r} has a rate of {self.rate:g} Hz.", "A rate is positive.", do="Change it."
            )
        idle = np.zeros(len(self.inputs)) if self.idle is None else np.asarray(self.idle, dtype=float)
        object.__setattr__(self, "idle", idle)
        given = (len(self.measures) + len(self.memory), table.shape[0], self.n_out, idle.size)
        wanted = (*(getattr(self.step, size, n) for size, n in zip(_SIZES, given, strict=False)), len(self.inputs))
        if given != wanted:
            raise SpecificationError(
                f"The law {self.name!r} has {given[0]} measurements and memories, rows of {given[1]} numbers, "
                f"{given[2]} answers and {given[3]} idle inputs.",
                f"Its step takes {wanted[0]} and rows of {wanted[1]}, gives {wanted[2]}; its inputs are {wanted[3]}.",
                do="Give measures, memory, table, signals and idle that belong to the step.",
            )

    @property
    def period(self):
        """Ts = 1/rate [s]."""
        return 1.0 / self.rate

    @property
    def n_out(self):
        """The number of outputs of `step`."""
        return len(self.inputs) + len(self.memory) + len(self.signals)

    def answer(self, t, x, row):
        """What `step` says at a sample.

        Parameters
        ----------
        t : float
            [s]
        x : (n_y + n_z,) array
            Measurement and memory.
        row : (n_row,) array
            Of the table.

        Returns
        -------
        (n_out,) array
            Inputs, next memory, further signals.

        Raises
        ------
        SpecificationError
            If these are not n_out numbers.
        """
        said = self.step(t, x, row)
        try:
            out = np.asarray(said, dtype=float).ravel()
        except (TypeError, ValueError):
            out = np.zeros(0)
        if out.size != self.n_out:
            raise SpecificationError(
                f"The step of the law {self.name!r} answered {said!r} at t = {t:.6g} s."[:200],
                f"It answers {self.n_out} numbers: {len(self.inputs)} inputs, {len(self.memory)} of the next memory, "
                f"{len(self.signals)} further signals.",
                do="Return an array of them.",
                t=float(t),
            )
        return out

    def start(self):
        """A controller that runs this law from its first memory on: law(t, measurement) -> u.

        Returns
        -------
        Controller
        """
        return Controller(self)

    def __call__(self, t, measurement):
        """The inputs of a law without memory.

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
            If the law has a memory, t is between samples, or the measurement has another shape.
        """
        if len(self.memory):
            raise SpecificationError(
                f"The law {self.name!r} has the memory {', '.join(self.memory_names)}.",
                "A law is a value and keeps nothing.",
                nearest="controller = law.start(); controller(t, measurement).",
                do="Start it.",
            )
        return Controller(self)(t, measurement)

    def row(self, t):
        """The column of the table at an instant of sampling, (n_row,).

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
                f"The law was asked at t = {t:.9g} s.",
                f"It is sampled at {self.rate:g} Hz from t = {self.t0:g} s on.",
                nearest=f"t = {nearest:.9g} s.",
                do="Ask at an instant of sampling.",
                t=t,
            )
        return self.table[:, min(round(k), self.table.shape[1] - 1)]

    def __repr__(self):
        shown = {name: value for name, value in self.info.items() if isinstance(value, (str, int, float))}
        lines = [
            f"Law: {self.name}, {self.rate:g} Hz, t = {self.t0:g} .. {self._end:g} s, then held",
            f"  measures {', '.join(self.measures) or '(nothing)'}"[:118],
            f"  commands {', '.join(self.inputs)}"[:118],
        ]
        if self.memory_names:
            lines.append(f"  memory: {', '.join(self.memory_names)}"[:118])
        lines += [f"  {name}: {v:.4g}" if isinstance(v, float) else f"  {name}: {v}"[:118] for name, v in shown.items()]
        return "\n".join(lines[:12])

    @property
    def _end(self):
        return self.t0 + (self.table.shape[1] - 1) / self.rate


class Controller:
    """A law at work: it has the law's memory, and changes it at each call; made by `Law.start`.

    Attributes
    ----------
    law : Law
    memory : (n_z,) array
    signals : dict of str to float
        The law's further signals at the last call.
    """

    def __init__(self, law):
        self.law, self.memory, self.signals = law, np.array(law.memory, dtype=float), {}

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
        law, m = self.law, len(self.law.inputs)
        y = as_measurement(measurement, law.measures)
        out = law.answer(t, np.concatenate([y, self.memory]), law.row(t))
        self.memory = out[m : m + len(self.memory)]
        self.signals = dict(zip(law.signals, out[m + len(self.memory) :].tolist(), strict=True))
        return out[:m]

    def __repr__(self):
        return f"Controller of {self.law.name}: memory {np.array2string(self.memory, precision=4, threshold=8)}"


def as_measurement(measurement, names):
    """The measured values in the order of their names, (n_y,).

    Raises
    ------
    NameUnknown
        If one is missing.
    SpecificationError
        If an array has another shape.
    """
    if isinstance(measurement, dict):
        for name in names:
            if name not in measurement:
                raise unknown(name, measurement, "measurement")
        measurement = [measurement[name] for name in names]
    try:
        y = np.array([float(value) for value in np.ravel(measurement)])
    except (TypeError, ValueError):
        y = np.zeros(0)
    if y.shape != (len(names),):
        raise SpecificationError(
            f"The measurement {measurement!r} was given."[:200],
            f"The law measures {len(names)}: {', '.join(names) or '(nothing)'}.",
            do="Give them in this order, or as a dict.",
        )
    return y
