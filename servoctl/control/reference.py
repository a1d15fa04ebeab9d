"""The reference of a law: a plan at the sampling instants, with the plant's linearisation about it."""

import numpy as np

from servoctl.checks import ON_SAMPLE, named, positive, require_kind, require_memory
from servoctl.errors import NotRealisable, ServoError, SpecificationError
from servoctl.plants.plant import Plant, part_of


class Reference:
    """States, inputs and linearisations at the sampling instants of a plan; plan and plant must have the same names.

    t (N,) are the sampling instants t0 + k/rate within the plan [s], x (n_x, N) the states there; middle (N,) are the
    middles of the samples up to the plan's end, middle_x (n_x, N) and middle_input (m, N) the states and the plan's
    actuation there; initial_input (m,) is the plan's first actuation.
    """

    def __init__(self, plan, plant, rate):
        self.plan, self.plant, self.rate = plan, plant, positive("rate", rate)
        require_plan(plan, plant)
        period = 1.0 / self.rate
        count = np.floor((plan.t[-1] - plan.t[0]) * self.rate * (1 + 1e-12) + 1e-9)
        if count < 1:
            raise SpecificationError(
                f"The plan lasts {plan.t[-1] - plan.t[0]:g} s, a sample {period:g} s.",
                "A plan is at least one sample long.",
                nearest=f"rate={1 / (plan.t[-1] - plan.t[0]):.4g}.",
                do="Raise the rate, or simulate a longer plan.",
                duration=float(plan.t[-1] - plan.t[0]),
                period=period,
            )
        matrices = 2 * (plant.n_x + len(plant.inputs)) ** 2  # linearisations in continuous and in discrete time
        require_memory(count, matrices, f"The plan of {plan.t[-1] - plan.t[0]:g} s is sampled at {self.rate:g} Hz")
        self.t = plan.t[0] + np.arange(int(count) + 1) * period
        self.period, self.end, self._runs = period, plan.t[-1], {}
        self.x = self._states(self.t)
        self.middle = np.minimum(self.t + period / 2, self.end)
        self.middle_x, self.middle_input = self._states(self.middle), self._actuation(self.middle)
        self.initial_input = self._actuation(self.t[:1])[:, 0]

    def _run(self, t):
        """The plan at instants (N,), at its end beyond it [s]."""
        t = np.minimum(t, self.end)
        key = t.tobytes()
        if key not in self._runs:
            self._runs[key] = self.plan.sampled(t)
        return self._runs[key]

    def planned(self, name):
        """A signal of the plan at the samples, (N,)."""
        return self._run(self.t)[name]

    def _actuation(self, t):
        run = self._run(t)
        return np.array([run[name] for name in self.plant.inputs]).reshape(len(self.plant.inputs), len(t))

    def _states(self, t):
        run = self._run(t)
        return np.array([run[name] for name in self.plant.state_names])  # a lagged input follows the plan's

    def inputs(self):
        """The command of each sample, (m, N): the actuation in its middle, with lag and transport delay inverted."""
        return self._commands(0.0, self.period / 2)

    def ahead(self, delay=0):
        """Commands in the middle of the hold, `delay` samples late, minus those at the samples, (m, N)."""
        change = self._commands(delay * self.period, self.period / 2) - self._commands(0.0, 0.0)
        change[:, -1] = 0.0
        return change

    def _commands(self, late, into):
        """Commands for the plan's actuation at a time `into` a hold that begins `late` after its sample [s], (m, N)."""
        lag, commands = self.plant.lag, []
        for a, name in enumerate(self.plant.inputs):
            at = self.t + self.plant.delay.get(name, 0.0) + late + into
            u = self._actuation(at)[a]
            commands.append(u + lag[name] * self._slope(at)[a] if name in lag else u)
        return np.array(commands)

    def _slope(self, t):
        """du/dt of the plan's actuation, (m, N), by central differences over a sample, within the plan."""
        low, high = (np.clip(t + side, self.t[0], self.end) for side in (-self.period / 2, self.period / 2))
        span = high - low
        known = span > ON_SAMPLE * self.period
        return np.where(known, self._actuation(high) - self._actuation(low), 0.0) / np.where(known, span, 1.0)

    def linearised(self):
        """A (N, n_x, n_x) and B (N, n_x, m) of the plant in the middle of each sample."""
        A, B = self.plant.linearised(self.middle, self.middle_x, self.middle_input)
        lost = ~(np.isfinite(A).all(axis=(1, 2)) & np.isfinite(B).all(axis=(1, 2)))
        if lost.any():
            raise ServoError(
                f"The plant's linearisation is not finite at t = {self.middle[lost][0]:.6g} s of the plan.",
                "Linear feedback needs forces with finite slopes along the plan.",
                do="Design for a plant with a smooth force, tanh(v/0.01) for sign(v), and close the loop with sign(v).",
                t=float(self.middle[lost][0]),
            )
        return A, B


def require_plant(plant):
    """Refuse anything but a Plant."""
    require_kind(Plant, "plant", plant, "sv.plant(mechanism)")


def of_plan(plan, plant):
    """The plant without the coordinates that play no part in the program of a plan; as it is without a plan."""
    model = getattr(plan, "model", None)
    return part_of(plant, model.reduction.mechanism) if isinstance(plant, Plant) and model is not None else plant


def refuse_transport(plant, what):
    """Refuse a plant with transport delay; `what` begins the rule: "The design is"."""
    if plant.delay:
        raise SpecificationError(
            f"The plant has a transport delay of {max(plant.delay.values()):g} s.",
            f"{what} that of a plant without delay.",
            do="Design for sv.plant(mechanism) without delay, and close the loop around the plant with it.",
            delay=dict(plant.delay),
        )


def require_plan(plan, plant):
    """Refuse anything but a run with its model, forward in time, by actuators, with the names of the plant."""
    require_plant(plant)
    model = getattr(plan, "model", None)
    if model is None or not hasattr(plan, "jets"):
        raise SpecificationError(
            f"The plan is a {type(plan).__name__}{' without its model' if hasattr(plan, 'jets') else ''}.",
            "A plan is a run of sv.simulate; its model interpolates between samples.",
            do="Simulate the plan; a loaded run has no model.",
            kind=type(plan).__name__,
        )
    if len(plan.t) < 2 or plan.t[-1] <= plan.t[0] or not np.isfinite(plan.jets).all():
        raise SpecificationError(
            f"The plan has {len(plan.t)} samples from t = {plan.t[0]:g} to {plan.t[-1]:g} s.",
            "A plan goes forward in time, through finite states.",
            do="Simulate it over (t0, t1) with t1 > t0.",
            samples=len(plan.t),
            t_span=(float(plan.t[0]), float(plan.t[-1])),
        )
    if model.reduction.ideal:
        raise NotRealisable(
            f"The plan of {', '.join(map(repr, model.reduction.program.names))} is realised by an ideal reaction.",
            "A law commands actuators.",
            do='Derive the program with by="actuators", and follow that plan, whatever its order by sv.lqr.',
            names=model.reduction.program.names,
        )
    state_names = plan.jet_names[: model.nq + model.n]
    for names, valid, what in (
        (state_names, plant.state_names, "state of the plant"),
        (model.actuators, plant.inputs, "actuator of the plant"),
        (plant.state_names[: plant.n_x - len(plant.lag)], state_names, "state of the plan"),
        (plant.inputs, model.actuators, "actuator of the plan"),
    ):
        for name in names:
            named(name, valid, what)
