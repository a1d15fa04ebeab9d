"""The run of a closed loop, by name."""

import pickle
from collections.abc import Mapping
from dataclasses import fields
from functools import cached_property

import numpy as np

from servoctl.checks import ON_SAMPLE
from servoctl.control.conditions import Conditions
from servoctl.control.law import Law, UserStep, sample_at
from servoctl.control.loop import Loop, samples_ago
from servoctl.control.mid_samples import program_rows
from servoctl.control.residuals import known_residuals
from servoctl.errors import SpecificationError
from servoctl.markup import fitted, listed
from servoctl.model.start import without_rounding
from servoctl.plants.plant import Plant
from servoctl.run import CLOSED_LOOP, Run, Sampled, range_in_words
from servoctl.values import Value, frozen, read_only

ALONG = "F − F along the plan"  # what is shown of a residual that is the k-th derivative of F
NONE, LOWER, UPPER, FALLING, RISING = 0, -1, 1, -2, 2  # which limit an input has met


@frozen(eq=False, repr=False)
class Closed(Sampled, Value):
    """The motion of a plant under a law; made by `close`.

    `run["theta"]`, `run["dtheta"]`, `run["d2theta"]`, `run["trolley"]` are (N,) arrays at the samples, SI. The
    signal of an actuator is its force or torque; with a lag that is a state. Outputs and the reactions λ of material
    constraints, `run["multiplier_rope"]`, are those right after a sample. `run.residual["X"]` is (levels, N).

    Attributes
    ----------
    t : (N,) array
        [s]
    states : (n_x, N) array
        States of the plant, in the order of `plant.state_names`.
    inputs : (m, N) array
        Inputs from each sample on, after delay and limits.
    commands : (m, N) array
        Commands of the law.
    measurements, controller_states, signals : (n_y, N), (n_z, N), (n_s, N) arrays
        In the order of `law.measures`, `law.state_names` and `law.signals`.
    plant : Plant
    law : Law
    plan : Run or None
        The reference trajectory.
    loop : Loop
        The numbers of the loop.
    conditions : Conditions
        Sensors, timing and disturbances, by name.
    success : bool
    status : int
        0 finished, 1 interrupted, -1 stopped.
    message : str
    """

    t: np.ndarray
    states: np.ndarray
    inputs: np.ndarray
    commands: np.ndarray
    measurements: np.ndarray
    controller_states: np.ndarray
    signals: np.ndarray
    plant: Plant
    law: Law
    plan: Run | None
    loop: Loop
    conditions: Conditions
    success: bool = True
    status: int = 0
    message: str = ""

    def __post_init__(self):
        for name in ("states", "measurements"):  # which may share their memory
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @cached_property
    def _kinds(self):
        """Names of the evaluated signals, by the function of the plant that evaluates them."""
        mechanism = self.plant.mechanism
        return {
            "accelerations": mechanism.q.jet_names(2),
            "outputs": tuple(mechanism.outputs),
            "power": ("energy",),
            "multipliers": self.plant.equations.multiplier_names,
        }

    @property
    def units(self) -> dict[str, str]:
        """Units by name, as the mechanism gives them."""
        return self.plant.mechanism.units

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all signals."""
        evaluated = (name for names in self._kinds.values() for name in names)
        return tuple(dict.fromkeys([*self.plant.state_names, *self.plant.inputs, *evaluated]))

    def __getitem__(self, name: str) -> np.ndarray:
        if name in self.plant.state_names:
            return self.states[self.plant.state_names.index(name)]
        if name in self.plant.inputs:
            return self.inputs[self.plant.inputs.index(name)]
        for kind, names in self._kinds.items():
            if name in names:
                return self._evaluated(kind)[names.index(name)]
        return self._of_row(name, self.plant.mechanism)

    @cached_property
    def _evaluations(self):
        return {}

    def _evaluated(self, kind):
        if kind not in self._evaluations:
            self._evaluations[kind] = self.plant.function(kind).grid(self.t, self.states, self.p)
        return self._evaluations[kind]

    @cached_property
    def p(self):
        """The plant's parameters, inputs after the transport delay, and disturbances at each sample, (n_p, N)."""
        return self.p_within(0)

    def p_within(self, half):
        """Those of `p` at the start of each sample, in its middle, or at its end.

        Parameters
        ----------
        half : int
            0, 1 or 2.

        Returns
        -------
        (n_p, N) array
            As `p`, in the mechanism's units.
        """
        loop, inputs = self.loop, self.inputs
        step, stage = divmod(half * loop.substeps, 2) if half < 2 else (loop.substeps - 1, 2)
        if loop.transport is not None:
            sent = np.arange(len(self.t)) - samples_ago(step, loop.transport[:, None], loop.substeps)
            inputs = np.take_along_axis(inputs, np.maximum(sent, 0), axis=1)
            inputs = np.where(sent < 0, loop.initial_input[:, None], inputs)
        p = self.plant.p(inputs)
        p[loop.disturbed] = self._disturbances(step, stage)
        return p

    def _disturbances(self, step, stage):
        """Disturbances (n_d, N) at the start, in the middle or at the end (stage 0, 1, 2) of a step of each sample."""
        loop = self.loop
        if loop.disturbance is None:
            return np.zeros((0, len(self.t)))
        steps = np.minimum(np.arange(len(self.t)) * loop.substeps + step, loop.samples * loop.substeps)
        parts = steps if loop.parts is None else loop.parts[np.minimum(steps + (stage == 2), steps[-1])] - (stage == 2)
        parts = np.minimum(parts, len(loop.disturbance) - 1)
        ends = np.where(np.arange(len(self.t)) < loop.samples, stage, 2)
        return loop.disturbance[parts, ends].T

    @property
    def measured(self) -> dict[str, np.ndarray]:
        """Measurements with noise and quantisation, (N,) by state."""
        return dict(zip(self.law.measures, self.measurements, strict=True))

    @property
    def command(self) -> dict[str, np.ndarray]:
        """Commands of the law, (N,) by actuator."""
        return dict(zip(self.plant.inputs, self.commands, strict=True))

    @property
    def input(self) -> dict[str, np.ndarray]:
        """Inputs from each sample on, (N,) by actuator: commands after delay and limits."""
        return dict(zip(self.plant.inputs, self.inputs, strict=True))

    @property
    def disturbance(self) -> dict[str, np.ndarray]:
        """Disturbances right after each sample, (N,) by generalised force, and by parameter where that is disturbed."""
        calm = {name: np.zeros(len(self.t)) for name in self.plant.disturbable}
        return calm | dict(zip(self.conditions.disturbance, self._disturbances(0, 0), strict=True))

    @property
    def signal(self) -> dict[str, np.ndarray]:
        """Controller states and further signals of the law at each sample, (N,) by name."""
        names = (*self.law.state_names, *self.law.signals)
        return dict(zip(names, (*self.controller_states, *self.signals), strict=True))

    @property
    def active(self) -> dict[str, np.ndarray]:
        """The limit that each input has met, (N,) by actuator: -1 lower, 1 upper, -2 and 2 of its rate, 0 none."""
        loop, k = self.loop, np.arange(len(self.t)) - self.loop.delay
        initial, low, high, change = (x[:, None] for x in (loop.initial_input, loop.low, loop.high, loop.change))
        delayed = np.where(k < 0, initial, self.commands[:, np.maximum(k, 0)])
        before, wanted = np.column_stack([initial, self.inputs[:, :-1]]), np.clip(delayed, low, high)
        met = (wanted > before + change, wanted < before - change, delayed < low, delayed > high)
        codes = np.select(met, (RISING, FALLING, LOWER, UPPER), NONE)
        return dict(zip(self.plant.inputs, codes, strict=True))

    @cached_property
    def residual(self) -> Mapping[str, np.ndarray]:
        """Residuals of the plan's program and of material constraints, (levels, N) by name.

        Levels are the residual and its derivatives up to the velocities, at the plant's states and parameters. A
        residual of order 2 is evaluated in the middle of each sample; so is F of a residual of order 3 or more that is
        its k-th derivative: its levels are F minus F along the plan, and the k-th difference quotient of that, which is
        the residual, over windows of 0.1 s, if there are more than k middles. One without F is evaluated with central
        differences of the velocities. The last sample, which has no middle, has the values of the one before.
        """
        residuals = program_rows(self) if self.plan is not None else {}
        if self.plant.constrained:
            values = self.plant.function("constraints").grid(self.t, self.states, self.plant.p())
            residuals |= {name: value[None] for name, value in zip(self.plant.constraint_names(), values, strict=True)}
        return residuals

    @cached_property
    def by_F(self) -> tuple[str, ...]:
        """Names of the residuals that are shown as F minus F along the plan."""
        model = getattr(self.plan, "model", None)
        return () if model is None else tuple(known_residuals(model, self.plant).integrated)

    @cached_property
    def error(self) -> Mapping[str, np.ndarray]:
        """States minus those of the plan (after its end, minus its last ones), by name; empty without a plan."""
        if self.plan is None:
            return {}
        plan = self.plan.sampled(np.clip(self.t, self.plan.t[0], self.plan.t[-1]))
        return {name: self[name] - plan[name] for name in self.plant.state_names if name in plan.names}

    def planned(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """A signal of the plan at the samples up to its end.

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
        return t, self.plan.sampled(t)[name]

    def state(self, t: float) -> np.ndarray:
        """The state of the plant at a sample, (n_x,).

        Parameters
        ----------
        t : float
            A sampling instant [s].

        Raises
        ------
        SpecificationError
            If t is between samples, or outside the run.
        """
        return self.states[:, sample_at(t, self.loop.t0, self.loop.period, len(self.t) - 1, "the run")].copy()

    @property
    def _counters(self):
        return {"samples": len(self.t), "substeps": self.loop.substeps, "delay": self.loop.delay}

    def _attributes(self):
        return {"law": self.law.name, "message": self.message, **self._counters}

    def to_run(self) -> Run:
        """The samples as a plain `Run`, with the further signals "command a", "input a", "measured x" and "law z"."""
        p = self.plant
        stored = {name: self[name] for name in self.names if name not in p.state_names}
        kinds = {"command": self.command, "input": self.input, "measured": self.measured, "law": self.signal}
        for kind, values in kinds.items():
            stored |= {f"{kind} {name}": value for name, value in values.items()}
        return Run(
            self.t,
            self.states,
            p.state_names,
            None,
            f"{CLOSED_LOOP}{self.law.name}",
            "",
            self._counters,
            self.success,
            self.status,
            self.message,
            (),
            (),
            stored,
            dict(self.residual),
            stored_units=self.units,
        )

    def save(self, path):
        """Save the run as npz, without pickle; `load` returns it as a plain `Run`.

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
        functions = {f"disturbance of {name!r}": f for name, f in self.conditions.disturbance.items()}
        law = self.law.step.law if self.law.allocation else self.law
        if isinstance(law.step, UserStep):
            functions[f"law {law.name!r}"] = law.step.function
        for what, function in functions.items():
            try:
                pickle.dumps(function)
            except Exception as error:  # pickle raises several types
                raise SpecificationError(
                    f"The {what} cannot be pickled: {error}.",
                    "A closed loop travels with its law and disturbances; pickle takes functions of a module by name.",
                    do="Use functions of a module or sv.disturbances instead of a lambda, or send run.to_run().",
                    what=what,
                ) from error
        return Closed, tuple(getattr(self, f.name) for f in fields(self))

    def _lines(self, full):
        return [*self._facts(full), *self._exertion(full)] if len(self.t) else self._facts(full)

    def _exertion(self, full):
        """A line for each input: its range, and how long it is limited; rounding is 0 unless full."""
        ends = np.array([(values.min(), values.max()) for values in self.input.values()])
        ends, shares = ends if full else without_rounding(ends), [np.mean(a != NONE) for a in self.active.values()]
        for name, (low, high), share in zip(self.input, ends, shares, strict=True):
            limited = f"; limited during {100 * share:.3g} % of the samples" if share else ""
            yield range_in_words(name, low, np.nan, high, np.nan, self.unit(name)) + limited

    def _facts(self, full):
        """Lines that say what the loop was, and its errors."""
        loop = self.loop
        steps = f"; {loop.substeps} integration step{'s' * (loop.substeps > 1)} per sample"
        lines = [
            f"Closed: {len(self.t)} samples at {1 / loop.period:g} Hz, t = {loop.t0:g} .. "
            f"{loop.t0 + max(len(self.t) - 1, 0) * loop.period:g} s; {self.message}",
            f"law: {self.law.name}" + steps * full,
            fitted(self._exposure, full),
        ]
        if len(self.t):
            sizes = {name: np.abs(values[0]) for name, values in self.residual.items()}
            order = sorted(sizes, key=lambda name: -sizes[name].max())
            ends = [f"{name} {sizes[name].max():.3g} / {sizes[name][-1]:.3g}" for name in order]
            lines.append("max / final residual: " * bool(ends) + "; ".join(ends if full else ends[:3]))
            program = self.plan.model.reduction.program.names if self.plan is not None and self.plan.model else ()
            for what, names in (
                (f"shown as {ALONG}:", [n for n in sizes if n in self.by_F]),
                ("not evaluated, as the loop has too few samples:", [n for n in program if n not in sizes]),
            ):
                lines.append(fitted(lambda room: f"{what} {listed(names, room)}", full) * bool(names))  # noqa: B023
            if self.plan is not None and self.t[-1] > self.plan.t[-1] + ON_SAMPLE * loop.period:
                lines.append(f"the plan ends at t = {self.plan.t[-1]:g} s; its last sample is held")
        return "\n  ".join(filter(None, lines)).splitlines()

    def _exposure(self, room):
        """Noise, quantisation, disturbances and delay, where there are any."""
        c, delay = self.conditions, self.loop.delay
        kinds = (("noise on", c.sensors.noise), ("quantised:", c.sensors.quantisation), ("disturbed:", c.disturbance))
        parts = [f"{what} {listed(names, room)}" for what, names in kinds if names]
        parts += [f"delay of {delay} sample{'s' * (delay > 1)}"] * bool(delay)
        return "; ".join(parts)
