"""The reference of a law: a plan at the instants of sampling, with what the plant's linearisation is there."""

from dataclasses import replace
from math import factorial, perm

import numpy as np

from servoctl.checks import ON_SAMPLE, positive, require_memory
from servoctl.errors import NotRealisable, ServoError, SpecificationError, unknown
from servoctl.plants.plant import Plant


class Reference:
    """A plan at the instants of sampling: states, inputs, linearisations; refused where plan and plant do not fit.

    Attributes
    ----------
    rate : float
        [Hz]
    t : (N,) array
        t_k = t0 + k/rate within the plan [s].
    x : (n_x, N) array
        The plant's states there.
    middle : (N,) array
        Middles of the samples, no later than the plan's end [s].
    middle_x, middle_input : (n_x, N), (m, N) arrays
        States and plan's actuation there.
    idle : (m,) array
        The plan's first actuation.
    """

    def __init__(self, plan, plant, rate):
        self.plan, self.plant, self.rate = plan, plant, positive("rate", rate)
        require_plan(plan, plant)
        period = 1.0 / self.rate
        count = np.floor((plan.t[-1] - plan.t[0]) * self.rate * (1 + 1e-12) + 1e-9)
        if count < 1:
            raise SpecificationError(
                f"The plan lasts {plan.t[-1] - plan.t[0]:g} s, and is sampled every {period:g} s.",
                "A plan that is followed is at least one sample long.",
                nearest=f"rate={1 / (plan.t[-1] - plan.t[0]):.4g}.",
                do="Raise the rate, or simulate a longer plan.",
            )
        matrices = 2 * (plant.n_x + len(plant.inputs)) ** 2  # linearisations, and the same from sample to sample
        require_memory(count, matrices, f"The plan of {plan.t[-1] - plan.t[0]:g} s is sampled at {self.rate:g} Hz")
        self.t = plan.t[0] + np.arange(int(count) + 1) * period
        self.period, self.end = period, plan.t[-1]
        self.x = self._states(self.t)
        self.middle = np.minimum(self.t + period / 2, self.end)
        self.middle_x, self.middle_input = self._states(self.middle), self._actuation(self.middle)
        self.idle = self._actuation(self.t[:1])[:, 0]

    def _actuation(self, t):
        run = resampled(self.plan, np.minimum(t, self.end))
        return np.array([run[name] for name in self.plant.inputs]).reshape(len(self.plant.inputs), len(t))

    def _states(self, t):
        run, plant = resampled(self.plan, np.minimum(t, self.end)), self.plant
        return np.array([run[name] for name in plant.state_names])  # a lagged input follows the plan's

    def inputs(self):
        """The command of each sample, (m, N): the actuation in its middle, with lag and transport delay inverted."""
        return self._commands(self.period / 2)

    def ahead(self, late=0):
        """By how much the command in the middle of the time for which it is held exceeds that at each sample, (m, N).

        Parameters
        ----------
        late : int
            Samples from the measurement to the input: that of the sample k is held from the sample k + late on.
        """
        exceeding = self._commands(self.period / 2, late * self.period) - self._commands(0.0)
        exceeding[:, -1] = 0.0
        return exceeding

    def _commands(self, into, late=0.0):
        """Commands for the plan's actuation a time into each hold that begins `late` after its sample [s], (m, N)."""
        return np.array([self._command(a, name, into, late) for a, name in enumerate(self.plant.inputs)])

    def _command(self, a, name, into, late):
        at = self.t + self.plant.delay.get(name, 0.0) + late + into
        u = self._actuation(at)[a]
        return u + self.plant.lag[name] * self._slope(at)[a] if name in self.plant.lag else u

    def _slope(self, t):
        """du/dt of the plan's actuation, (m, N), by central differences over a sample as far as the plan reaches."""
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
                "Laws of linear feedback are designed where forces have finite slopes.",
                do="Design for a plant with a smooth force, tanh(v/0.01) for sign(v); close the loop with the other.",
                t=float(self.middle[lost][0]),
            )
        return A, B


def require_plant(plant):
    """Refuse what is no plant."""
    if not isinstance(plant, Plant):
        raise SpecificationError(
            f"A {type(plant).__name__} was given as plant.",
            "Laws are designed for a plant, and a loop is closed around one.",
            do="Make the plant of the mechanism: sv.plant(mechanism).",
        )


def refuse_transport(plant, what):
    """Refuse a transport delay where a law's design knows none."""
    if plant.delay:
        raise SpecificationError(
            f"The plant has a transport delay of {max(plant.delay.values()):g} s.",
            f"{what} that of a plant without delay.",
            do="Design for sv.plant(mechanism) without delay, and close the loop around the plant with it.",
            delay=dict(plant.delay),
        )


def require_plan(plan, plant):
    """Refuse a plan that is none, or that names what the plant lacks."""
    require_plant(plant)
    model = getattr(plan, "model", None)
    if model is None or not hasattr(plan, "jets"):
        raise SpecificationError(
            f"A {type(plan).__name__}{' without its model' if hasattr(plan, 'jets') else ''} was given as plan.",
            "A law is made from a run of sv.simulate, which interpolates between its samples.",
            do="Simulate the plan here; a loaded run has no model.",
        )
    if len(plan.t) < 2 or plan.t[-1] <= plan.t[0] or not np.isfinite(plan.jets).all():
        raise SpecificationError(
            f"The plan has {len(plan.t)} samples from t = {plan.t[0]:g} to {plan.t[-1]:g} s.",
            "A plan that is followed goes forward in time, through finite states.",
            do="Simulate it over (t0, t1) with t1 > t0.",
        )
    if model.ideal:
        raise NotRealisable(
            "The plan is realised by an ideal reaction.",
            "A law commands actuators.",
            do='Derive Program(..., by="actuators"), and simulate that plan.',
        )
    state_names = plan.jet_names[: model.nq + model.n]
    for given, valid, what in (
        (state_names, plant.state_names, "state of the plant"),
        (model.actuators, plant.inputs, "actuator of the plant"),
        (plant.state_names[: plant.n_x - len(plant.lag)], state_names, "state of the plan"),
        (plant.inputs, model.actuators, "actuator of the plan"),
    ):
        for name in given:
            if name not in valid:
                raise unknown(name, valid, what)


def resampled(plan, times):
    """The plan at other instants within it, (N,) [s], increasing, by Hermite interpolation of all derivatives."""
    model, t = plan.model, plan.t
    nq, n = model.nq, model.n
    top = (len(plan.jets) - nq) // n
    i = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    place = (i, t[i + 1] - t[i], times)
    levels = [plan.jets[nq + k * n : nq + (k + 1) * n] for k in range(top)]
    if model.reduction.mechanism.q.plain:
        jets = _hermite(t, [plan.jets[:nq], *levels], *place)
    else:
        rates = plan.signals("coordinate_rates")[1]
        jets = [*_hermite(t, [plan.jets[:nq], rates[:nq], rates[nq:]], *place)[:1], *_hermite(t, levels, *place)]
    edges = [0, *(np.searchsorted(times, t[first]) for first, _, _ in plan.variants[1:]), len(times)]
    variants = tuple((a, b, v[2]) for a, b, v in zip(edges[:-1], edges[1:], plan.variants, strict=False) if b > a)
    return replace(plan, t=times, jets=np.vstack(jets), variants=variants, stored={}, stored_residual={})


def _hermite(t, derivatives, i, h, times):
    """Values and derivatives at times (M,) of the polynomials that match all derivatives at the ends of intervals.

    `derivatives` are (n, N) arrays of the orders 0, 1, ..., r at t (N,); `i` and `h` the interval of each instant and
    its length. Returns as many (n, M) arrays.
    """
    r, s = len(derivatives), (times - t[i]) / h
    low = [d[:, i] * h**k / factorial(k) for k, d in enumerate(derivatives)]
    matrix = np.array([[perm(j, k) for j in range(r, 2 * r)] for k in range(r)], dtype=float)
    ends = [d[:, i + 1] * h**k for k, d in enumerate(derivatives)]
    missing = [end - sum(perm(j, k) * low[j] for j in range(k, r)) for k, end in enumerate(ends)]
    high = np.einsum("jk,knm->jnm", np.linalg.inv(matrix), np.array(missing))
    c = [*low, *high]
    return [sum(perm(j, k) * c[j] * s ** (j - k) for j in range(k, 2 * r)) / h**k for k in range(r)]
