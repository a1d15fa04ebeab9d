"""The run of a closed loop, by name."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servoctl.checks import ON_SAMPLE, finite
from servoctl.control.reference import resampled
from servoctl.control.residuals import Residuals
from servoctl.errors import SpecificationError, unknown
from servoctl.run import Run

NONE, LOWER, UPPER, FALLING, RISING = 0, -1, 1, -2, 2  # which limit an input has met


@dataclass(frozen=True, eq=False)
class Closed:
    """The motion of a plant under a law; made by `close`.

    `run["theta"]`, `run["dtheta"]`, `run["d2theta"]`, `run["trolley"]` are (N,) arrays at the samples, SI: what an
    actuator does; with a lag that is a state. `run.residual["X"]` is (levels, N).

    Attributes
    ----------
    t : (N,) array
        [s]
    states : (n_x, N) array
        Of the plant, with the names `plant.state_names`.
    inputs, commands : (m, N) arrays
        What the actuators were given from each sample on, within their limits; what the law commanded there.
    measurements, controller_states, signals : (n_y, N), (n_z, N), (n_s, N) arrays
        With the names of `law.measures`, `law.state_names`, `law.signals`.
    plant : Plant
    law : Law
    plan : Run or None
    loop : Loop
        The numbers of the loop.
    conditions : Conditions
        Sensors, timing and disturbances, by name.
    success : bool
    status : int
        0 finished, -1 stopped.
    message : str
    """

    t: np.ndarray
    states: np.ndarray
    inputs: np.ndarray
    commands: np.ndarray
    measurements: np.ndarray
    controller_states: np.ndarray
    signals: np.ndarray
    plant: object
    law: object
    plan: object
    loop: object
    conditions: object
    success: bool = True
    status: int = 0
    message: str = ""

    @property
    def names(self):
        """Names of all signals."""
        p = self.plant
        accelerations = p.mechanism.q.jet_names(2)
        return tuple(dict.fromkeys([*p.state_names, *p.inputs, *accelerations, *p.mechanism.outputs, "energy"]))

    def __getitem__(self, name):
        p = self.plant
        if name in p.state_names:
            return self.states[p.state_names.index(name)]
        if name in p.inputs:
            return self.inputs[p.inputs.index(name)]
        for kind, names in (
            ("accelerations", p.mechanism.q.jet_names(2)),
            ("outputs", tuple(p.mechanism.outputs)),
            ("power", ("energy",)),
        ):
            if name in names:
                return self._evaluated(kind)[names.index(name)]
        raise unknown(name, self.names, "signal")

    @cached_property
    def _evaluations(self):
        return {}

    def _evaluated(self, kind):
        if kind not in self._evaluations:
            self._evaluations[kind] = self.plant.function(kind).grid(self.t, self.states, self.p)
        return self._evaluations[kind]

    @cached_property
    def p(self):
        """The plant's parameters, inputs as they arrive after transport, and disturbances at each sample, (n_p, N)."""
        return self.plant.p(self._arriving, self._disturbances)

    @cached_property
    def _arriving(self):
        """Inputs as they reach the plant at each sample, after transport, (m, N)."""
        loop, inputs = self.loop, self.inputs.copy()
        if loop.transport is not None:
            for a, late in enumerate(loop.transport):
                sent = (np.arange(len(self.t)) * loop.substeps - late) // loop.substeps
                inputs[a] = np.where(sent < 0, loop.idle[a], self.inputs[a, np.maximum(sent, 0)])
        return inputs

    @cached_property
    def _disturbances(self):
        """Disturbances right after each sample, (n, N)."""
        forces, loop = np.zeros((len(self.plant.disturbable), len(self.t))), self.loop
        if loop.disturbance is not None:
            steps = np.minimum(np.arange(len(self.t)) * loop.substeps, len(loop.disturbance) - 1)
            ends = np.where(np.arange(len(self.t)) < loop.samples, 0, 2)
            forces[loop.disturbed] = loop.disturbance[steps, ends].T
        return forces

    @property
    def measured(self):
        """What the law measured, by name: (N,) arrays with noise and quantisation."""
        return dict(zip(self.law.measures, self.measurements, strict=True))

    @property
    def command(self):
        """What the law commanded at each sample, by actuator."""
        return dict(zip(self.plant.inputs, self.commands, strict=True))

    @property
    def input(self):
        """What each actuator was given from each sample on: the command after delay and limits."""
        return dict(zip(self.plant.inputs, self.inputs, strict=True))

    @property
    def disturbance(self):
        """Disturbances right after each sample, by generalised force."""
        return dict(zip(self.plant.disturbable, self._disturbances, strict=True))

    @property
    def signal(self):
        """Controller states and further signals of the law at each sample, by name."""
        names = (*self.law.state_names, *self.law.signals)
        return dict(zip(names, (*self.controller_states, *self.signals), strict=True))

    @property
    def active(self):
        """Which limit each input met, by actuator: (N,) of -1 lower, 1 upper, -2 and 2 of its rate, 0 none."""
        late, loop, codes = self._late, self.loop, {}
        before = np.column_stack([loop.idle, self.inputs[:, :-1]])
        for a, name in enumerate(self.plant.inputs):
            code = np.zeros(len(self.t), dtype=int)
            wanted = late[a]
            if loop.low is not None:
                code[wanted < loop.low[a]], code[wanted > loop.high[a]] = LOWER, UPPER
                wanted = np.clip(wanted, loop.low[a], loop.high[a])
            if loop.change is not None:
                code[wanted > before[a] + loop.change[a]], code[wanted < before[a] - loop.change[a]] = RISING, FALLING
            codes[name] = code
        return codes

    @property
    def _late(self):
        """Commands when they reach the limits, after the delay, (m, N)."""
        k = np.arange(len(self.t)) - self.loop.delay
        return np.where(k < 0, self.loop.idle[:, None], self.commands[:, np.maximum(k, 0)])

    @cached_property
    def residual(self):
        """Residuals of the plan's program, with the derivatives that the state decides, and of material constraints.

        By name; (levels, N) arrays at the plant's states and parameters. Residuals of order 2 are those of the
        accelerations right after each sample; residuals of higher order are left out.
        """
        residuals = {}
        if self.plan is not None:
            jets = np.vstack([self.states, self._evaluated("accelerations")])
            residuals |= Residuals(self.plan.model, self.plant, order=2).levels(self.t, jets)
        if self.plant.constrained:
            values = self.plant.function("constraints").grid(self.t, self.states, self.plant.p())
            residuals |= {name: value[None] for name, value in zip(self.plant.constraint_names(), values, strict=True)}
        return residuals

    @cached_property
    def error(self):
        """States less those of the plan, by name; beyond the plan's end less its last ones. Empty without a plan."""
        if self.plan is None:
            return {}
        plan = resampled(self.plan, np.clip(self.t, self.plan.t[0], self.plan.t[-1]))
        return {name: self[name] - plan[name] for name in self.plant.state_names if name in plan.names}

    def planned(self, name):
        """A signal of the plan at the samples up to the plan's end.

        Parameters
        ----------
        name : str

        Returns
        -------
        t, values : (K,) arrays
            Empty without a plan.
        """
        if self.plan is None:
            return np.zeros(0), np.zeros(0)
        t = self.t[self.t <= self.plan.t[-1]]
        return t, resampled(self.plan, t)[name]

    def state(self, t):
        """The state of the plant at a sample, (n_x,).

        Parameters
        ----------
        t : float
            An instant of sampling [s].

        Raises
        ------
        SpecificationError
            If t is no sample of this run.
        """
        t = finite("t", t, "time")
        k = int(np.argmin(np.abs(self.t - t)))
        if abs(self.t[k] - t) > ON_SAMPLE * self.loop.period:
            raise SpecificationError(
                f"t = {t:.9g} s was given.",
                f"The run has samples every {self.loop.period:g} s from {self.t[0]:g} to {self.t[-1]:g} s.",
                nearest=f"t = {self.t[k]:.9g} s.",
                do="Give the instant of a sample.",
                t=t,
            )
        return self.states[:, k].copy()

    def to_run(self):
        """The samples as a plain `Run`, with "command NAME" and "measured NAME" among its signals: what is saved."""
        p = self.plant
        stored = {name: self[name] for name in self.names if name not in p.state_names}
        for what, values in (
            ("command", self.command), ("input", self.input), ("measured", self.measured), ("law", self.signal)
        ):  # fmt: skip
            stored |= {f"{what} {name}": value for name, value in values.items()}
        counters = {"samples": len(self.t), "substeps": self.loop.substeps, "delay": self.loop.delay}
        return Run(
            self.t, self.states, p.state_names, None, f"closed loop: {self.law.name}", "", counters, self.success,
            self.status, self.message, (), (), stored, dict(self.residual),
        )  # fmt: skip

    def save(self, path):
        """Save the run as npz, without pickle; `load` gives it back as a plain `Run`.

        Parameters
        ----------
        path : str or Path
            A missing suffix .npz is added.

        Returns
        -------
        Path

        Raises
        ------
        ServoError
            If the file cannot be written.
        """
        return self.to_run().save(path)

    def __reduce__(self):
        return _same, (self.to_run(),)  # disturbances may be functions that do not pickle

    def __repr__(self):
        loop = self.loop
        lines = [
            f"Closed: {len(self.t)} samples at {1 / loop.period:g} Hz, t = {loop.t0:g} .. "
            f"{loop.t0 + max(len(self.t) - 1, 0) * loop.period:g} s; {self.message}",
            f"  law: {self.law.name}; {loop.substeps} integration step{'s' * (loop.substeps > 1)} per sample",
            *self._exposure(),
        ]
        if not len(self.t):
            return "\n".join(lines)
        worst = {name: np.abs(values[0]) for name, values in self.residual.items()}
        if worst:
            largest = sorted(worst, key=lambda name: -worst[name].max())[:3]
            errors = "; ".join(f"{name} {worst[name].max():.3g}, {worst[name][-1]:.3g}" for name in largest)
            lines.append(f"  residuals, at worst and at the end: {errors}")
        if self.plan is not None and self.t[-1] > self.plan.t[-1] + ON_SAMPLE * loop.period:
            lines.append(f"  the plan ends at t = {self.plan.t[-1]:g} s: its last row is held")
        for name in self.plant.inputs[:5]:
            share = np.mean(self.active[name] != NONE)
            limited = f"; limited during {100 * share:.3g} % of the samples" if share else ""
            lines.append(f"  {name}: {self.input[name].min():.6g} .. {self.input[name].max():.6g}{limited}")
        return "\n".join(lines[:12])

    def _exposure(self):
        """The line that says what the loop was exposed to, if it was to anything."""
        c, delay = self.conditions, self.loop.delay
        kinds = (("noise on", c.sensors.noise), ("quantised:", c.sensors.quantisation), ("disturbed:", c.disturbance))
        parts = [f"{what} {', '.join(names)}" for what, names in kinds if names]
        parts += [f"delay of {delay} sample{'s' * (delay > 1)}"] * bool(delay)
        return [f"  {'; '.join(parts)}"[:118]] * bool(parts)


def _same(run):
    return run
