"""Nonlinear systems of python-control, by name."""

import math

import numpy as np

from servoctl.checks import MOST_COUNT, as_list, named, positive, require_kind, whole, without_effect
from servoctl.codegen.paths import jets_in
from servoctl.control.conditions import limits, steps
from servoctl.control.law import Law
from servoctl.control.loop import hold, limited, quantised, samples_ago
from servoctl.control.result import Closed
from servoctl.errors import ServoError, SpecificationError
from servoctl.interop.names import (
    SYSTEMS,
    connected,
    disturbable_of,
    disturbed_names,
    output_names,
    signal_names,
    system_name,
)
from servoctl.model.following import p_with
from servoctl.model.model import Model
from servoctl.plants.plant import Plant
from servoctl.reduction.reduce import require_outputs
from servoctl.spec.references import require_fixed

SUBSTEPS = 10  # Runge-Kutta steps per sample: 1 ms at 100 Hz


def nlsys(thing, *, rate=None, substeps=None, disturbed=(), references="path", name=None):
    """A model, plant, law or closed loop as a `control.NonlinearIOSystem`.

    A model has no inputs, or those of its references: its states follow the program; its outputs are the states, the
    required actuation (or reaction) and the mechanism's outputs. A plant's inputs are its actuators, its outputs the
    states and the mechanism's outputs. A law is sampled (dt = 1/rate) from the measurement to the actuators. A closed
    loop is the `control.interconnect` of its sampled plant and its law; its inputs are "disturbance NAME" of each
    generalised force and "noise NAME" of each measured state, its outputs those of the plant and "command NAME".

    Parameters
    ----------
    thing : Model, Plant, Law or Closed
    rate : float, optional
        Samples per second [Hz] of a plant, which is then a system in discrete time with inputs held over each sample.
        Required to interconnect it with a law, and for limits of rate and transport delays, with which past inputs are
        further states.
    substeps : int, optional
        Runge-Kutta steps of order 4 per sample of a plant; default 10.
    disturbed : sequence of str
        Generalised forces, and parameters that enter forces only, of a plant that have an input "disturbance NAME".
    references : {"path", "inputs"}
        Whether a model follows the paths of its references, or has these and their derivatives as inputs: "X", "dX",
        "d2X", ...
    name : str, optional
        Name of the system; default "model", "plant", "law" or "loop".

    Returns
    -------
    control.NonlinearIOSystem
        The mechanism's parameters are its `params`, by name.

    Raises
    ------
    SpecificationError
        For other objects, options that do not apply, and limits of rate or delays in continuous time.
    NameUnknown
        For a disturbance of what is no generalised force or parameter, and other `references`.
    """
    require_kind((Model, Plant, Law, Closed), "thing", thing, SYSTEMS)
    as_inputs = named(references, ("path", "inputs"), "form of references") == "inputs"
    if as_inputs and not (isinstance(thing, Model) and thing.reduction.references):
        without_effect(["references"], "for what is no model with references")
    if isinstance(thing, Plant):
        return _plant(thing, system_name(name, "plant"), disturbed, rate, substeps)
    given = {"rate": rate, "substeps": substeps, "disturbed": None if as_list(disturbed) == [] else disturbed}
    without_effect([name for name, value in given.items() if value is not None], f"for a {type(thing).__name__}")
    if isinstance(thing, Model):
        return _model(thing, system_name(name, "model"), as_inputs)
    if isinstance(thing, Law):
        return _law(thing, system_name(name, "law"))
    return _closed(thing, system_name(name, "loop"))


def start(closed):
    """The initial state of a closed loop's system, X0 of python-control: plant, past inputs, law.

    Parameters
    ----------
    closed : Closed

    Returns
    -------
    (n,) array

    Raises
    ------
    SpecificationError
        For anything but a closed loop.
    """
    require_kind(Closed, "closed", closed, "sv.close(...)")
    loop, late = closed.loop, 0 if closed.loop.transport is None else closed.loop.transport
    past = loop.delay + _past_inputs(closed.plant, late, loop.substeps)
    return np.concatenate([loop.x0, np.tile(loop.initial_input, past), loop.z0])


def _model(model, name, as_inputs):
    import control

    n, n_x, p = model.n, len(model.state_names), model.parameters
    require_outputs(model.reduction)
    groups = [model.signals("reaction" if model.reduction.ideal else "actuation"), model.signals("outputs")]
    names = [name for group, _ in groups for name in group]
    ode, symbols = model.function("ode"), model.reduction.mechanism.parameters.names
    inputs, at = _along_inputs(model, (ode, *(f for _, f in groups))) if as_inputs else ([], _along_paths(model))

    def rates(t, x, u, params):
        _require_fixed_in(model, model.reduction.mechanism, p, params)
        y = at(ode, t, x, u, _parameter_values(p, symbols, params))[:n_x]
        if not np.isfinite(y).all():
            raise ServoError(
                f"The reduced dynamics is not finite at t = {t:.6g} s.",
                "A pivot of the model vanishes here; sv.simulate would choose others.",
                do="Derive the model with guess={...}, a state near by: its pivots are chosen there.",
                t=float(t),
            )
        return y

    def outputs(t, x, u, params):
        z, numbers = np.append(x, rates(t, x, u, params)[-n:]), _parameter_values(p, symbols, params)
        return np.concatenate([x, *(at(f, t, z, u, numbers) for group, f in groups if group)])

    return control.nlsys(
        rates,
        outputs,
        name=name,
        inputs=inputs or 0,
        states=model.state_names,
        outputs=[*model.state_names, *names],
        params=dict(zip(symbols, p.tolist(), strict=True)),
    )


def _along_paths(model):
    """A function's values at a state along the paths that a model follows, whatever the inputs."""
    return lambda f, t, x, _, numbers: f(t, x, p_with(model, numbers))


def _along_inputs(model, functions):
    """Names of the jets that functions of a model take, and their values at a state with these as inputs."""
    count = max(f.expression.size2_in(3) if jets_in(f.expression) else 0 for f in functions)
    jet, followed = model.reduction.mechanism.q.family.jet, model.reduction.references

    def at(f, t, x, u, numbers):
        jets = np.reshape(u, (count, -1)).T
        some = [jets[:, : f.expression.size2_in(3)]] if jets_in(f.expression) else []
        return np.ravel(f.expression(t, x, np.append(0.0, numbers), *some))

    return [jet(name, k).name() for k in range(count) for name in followed], at


def _require_fixed_in(thing, mechanism, p, params):
    """Refuse python-control's params by which the paths of a model or a plant would be others."""
    if thing.paths:
        own = zip(mechanism.parameters.names, p, strict=False)
        changes = [name for name, value in own if params[name] != value]
        require_fixed(thing.paths, mechanism.parameters, changes, "python-control changes")


def _parameter_values(p, symbols, params):
    """The parameters p with the values of python-control's params."""
    return np.append([params[name] for name in symbols], p[len(symbols) :])


def _plant(plant, name, disturbed, rate, substeps, delay=0):
    import control

    disturbed, places = disturbed_names(plant, disturbed)
    period = None if rate is None else 1.0 / positive("rate", rate)
    substeps = None if substeps is None else whole("substeps", substeps, least=1, most=MOST_COUNT)
    if period is None:
        _require_continuous(plant, substeps)
    inputs = [*plant.inputs, *(f"disturbance {force}" for force in disturbed)]
    m, n_x, symbols = len(plant.inputs), plant.n_x, plant.mechanism.parameters.names
    ode, low_high = plant.function("ode"), limits(plant, 1.0)[:2]

    def numbers(u, params):
        _require_fixed_in(plant, plant.mechanism, plant.parameters, params)
        applied, calm = np.clip(u[:m], *low_high), np.zeros(len(plant.disturbable))
        p = np.concatenate([plant.place, _parameter_values(plant.parameters, symbols, params), applied, calm])
        p[places] = u[m:]
        return p

    def rates(t, x, u, params):
        return ode(t, x, numbers(u, params))

    def outputs(t, x, u, params):
        return np.append(x[:n_x], plant.function("outputs")(t, x[:n_x], numbers(u, params)))

    states, update = list(plant.state_names), rates
    if period is not None:
        sampled = _SampledPlant(plant, period, SUBSTEPS if substeps is None else substeps, delay)
        states += sampled.names

        def update(t, x, u, params):
            return sampled(t, x, u, lambda inputs: numbers(np.append(inputs, u[m:]), params))

    signals = {"inputs": inputs, "states": states, "outputs": output_names(plant)}
    params = dict(zip(symbols, plant.parameters.tolist(), strict=False))
    return control.nlsys(update, outputs, name=name, dt=period or 0, params=params, **signals)


def _require_continuous(plant, substeps):
    """Refuse limits of rate, delays and substeps without a rate."""
    if plant.rate_limits or plant.delay or substeps is not None:
        what = "limits of rate" if plant.rate_limits else "transport delay" if plant.delay else "substeps"
        raise SpecificationError(
            f"The system has {what} and no rate.",
            "Limits of rate, transport delays and substeps need inputs that are sampled and held.",
            do="Pass the rate: interop.nlsys(plant, rate=100.0).",
            what=what,
        )


class _SampledPlant:
    """A plant over one sample behind delays and limits; its state is [x; past commands; past inputs]."""

    def __init__(self, plant, period, substeps, delay):
        self.plant, self.delay, self.m = plant, delay, len(plant.inputs)
        at_rest = np.zeros(self.m)
        self.substeps, late = steps(plant, period, substeps, 0.0, np.zeros(plant.n_x), at_rest)
        self.late = np.zeros(self.m, dtype=int) if late is None else late
        self.h = period / self.substeps
        self.low, self.high, self.change = limits(plant, period)
        self.past = _past_inputs(plant, self.late, self.substeps)
        kinds = (("command of", delay), ("input to", self.past))
        self.names = [f"{a} {name} {k} ago" for a, n in kinds for k in range(1, n + 1) for name in plant.inputs]

    def __call__(self, t, state, u, numbers):
        m, n_x = self.m, self.plant.n_x
        x, queues = state[:n_x], state[n_x:].reshape(-1, m)
        commands, inputs = np.vstack([u[None, :m], queues[: self.delay]]), queues[self.delay :]
        before = inputs[0] if len(inputs) else np.zeros(m)  # without limits of rate
        applied = limited(commands[self.delay], before, self.low, self.high, self.change)
        inputs = np.vstack([applied[None], inputs])
        ages = (samples_ago(s, self.late, self.substeps) for s in range(self.substeps))
        held = ((s * self.h, self.h, 3 * (numbers(inputs[age, range(m)]),)) for s, age in enumerate(ages))
        x = hold(self.plant.function("ode"), t, x, held)
        return np.concatenate([x, commands[: self.delay].ravel(), inputs[: self.past].ravel()])


def _past_inputs(plant, late, substeps):
    """Number of past samples whose inputs are states."""
    return max(math.ceil(np.max(late, initial=0) / substeps), 1 if plant.rate_limits else 0)


def _law(law, name, quantum=None):
    import control

    if getattr(law.step, "stateful", False):
        raise SpecificationError(
            f"The law {law.name!r} has a hidden state.",
            "python-control evaluates outputs and states separately, more than once per sample.",
            do="Run it with sv.close, or write it as a control.nlsys.",
            name=law.name,
        )
    m, n_z, lost = len(law.inputs), len(law.state), None

    def answer(t, z, y):
        return law.answer(t, np.append(quantised(y, quantum), z), law.schedule_at(t))

    def output(t, z, y, _):
        nonlocal lost
        u, before = answer(t, z, y)[:m], lost
        lost = None if np.isfinite(u).all() else t
        if lost is not None and lost == before:
            raise ServoError(
                f"The law {law.name!r} returned NaN or infinity at t = {t:.6g} s.",
                "A command is a finite number at each sample.",
                do="Check the law at this measurement.",
                name=law.name,
                t=float(t),
            )
        return u if np.any(y) else np.nan_to_num(u)  # a loop asks at y = 0 first, whatever is measured, and goes on

    return control.nlsys(
        (lambda t, z, y, _: answer(t, z, y)[m : m + n_z]) if n_z else None,
        output,
        name=name,
        inputs=signal_names(law.measures, law.inputs),
        outputs=law.inputs,
        states=law.state_names or None,
        dt=law.period,
    )


def _closed(closed, name):
    plant, loop = closed.plant, closed.loop
    system = _plant(plant, "plant", disturbable_of(closed), 1.0 / loop.period, loop.substeps, loop.delay)
    return connected(system, _law(closed.law, "law", loop.quantum), closed, name)
