"""The sampled closed loop: a plant, a law, and what stands between them."""

from dataclasses import dataclass, field

import numpy as np

from servoctl.checks import ON_SAMPLE, as_span, finite, mapping, positive, require_memory, whole, whole_multiple
from servoctl.codegen.function import Compiled
from servoctl.control.disturbances import sampled
from servoctl.control.law import Law
from servoctl.control.loop import FINISHED, LAW_LOST, STATE_LOST, Loop, run_loop
from servoctl.control.result import Closed
from servoctl.control.tracking import Reference, require_plan, require_plant, resampled
from servoctl.errors import InconsistentStart, IntegrationStopped, ServoError, SpecificationError, unknown

RESOLVED = 0.05  # |λ| h at most: then one Runge-Kutta step of order 4 errs by 3e-9
MOST_SUBSTEPS = 1000
CONSISTENT = 1e-6  # of the state: what may be left of a material constraint at the start
INSIDE = 1e-9  # of a step: how far inside it disturbances are taken, so that they may jump at its ends


def close(
    plant, law, x0, t_span, *, rate=None, delay=0, noise=None, seed=None, quantisation=None, disturbance=None,
    substeps=None, plan=None,
):  # fmt: skip
    """Run a sampled law on a plant.

    At each sample: the measurement, with noise, quantised; the law; the delay; limits of magnitude, then of rate; a
    zero-order hold. The plant is integrated by the Runge-Kutta method of order 4 in between, in one compiled loop.

    Main arguments

    Parameters
    ----------
    plant : Plant
    law : Law or callable
        Or any function law(t, measurement) -> inputs: measurement is a dict of all states by name, the result a dict by
        actuator or a sequence in their order. If it has a method `start`, that is called first and gives the function.
    x0 : array or dict of str to float
        State of the plant at the start, (q, γ'); lagged inputs may follow, and start at the first input otherwise.
    t_span : (t0, t1)
        [s]; a whole number of samples, from one of the law's own on.

    Other arguments

    rate : float, optional
        Samples per second [Hz]; needed for a function, a Law has its own.
    delay : int
        Samples from the measurement to the input. Until the first command arrives the inputs are the plan's actuation
        at the start, or the law's `idle` without a plan.
    noise : dict of str to float, optional
        Standard deviation of normally distributed noise by measured state.
    seed : int, optional
        Of the noise; default 0.
    quantisation : dict of str to float, optional
        Step of the measurement by measured state.
    disturbance : dict of str to callable or float, optional
        Generalised forces by coordinate (or quasi-velocity): functions of time, such as those of `sv.disturbances`.
        Jumps belong at the ends of integration steps.
    substeps : int, optional
        Integration steps per sample; default: enough for |λ| h <= 0.05 of the fastest eigenvalue λ at the start, and
        for a transport delay of whole steps.
    plan : Run, optional
        The run whose program is judged; default the law's own.

    Returns
    -------
    Closed

    Raises
    ------
    NameUnknown
        For a name that plant or law do not have.
    SpecificationError
        For times that are not whole samples or steps, and for values that make no sense.
    ServoError
        If the law answers with NaN. What a law raises itself is passed on, with the motion before in its `run`.
    InconsistentStart
        If material constraints do not hold at the start.
    IntegrationStopped
        If the state is no longer finite; what was computed is in `run`.
    """
    require_plant(plant)
    t_span = as_span(t_span, forward=True)
    law = _as_law(law, plant, rate, t_span[0], plan)
    require_names(law, plant)
    if plan is not None:
        require_plan(plan, plant)
    if not noise and seed is not None:
        raise SpecificationError("A seed was given without noise.", "The seed is that of the noise.", do="Remove it.")
    given = (disturbance, noise, quantisation)
    names = ("The disturbances", "The noise", "The quantisation")
    conditions = Conditions(
        *(dict(mapping(values, what)) for values, what in zip(given, names, strict=True)),
        0 if seed is None else whole("seed", seed),
    )
    loop = prepared(plant, law, x0, t_span, whole_multiple(delay, "delay", "samples"), conditions, substeps)
    return finish(plant, law, loop, conditions, law.plan if plan is None else plan)


@dataclass(frozen=True)
class Conditions:
    """What a loop was exposed to, by name."""

    disturbance: dict = field(default_factory=dict)
    noise: dict = field(default_factory=dict)
    quantisation: dict = field(default_factory=dict)
    seed: int = 0


def prepared(plant, law, x0, t_span, delay, conditions, substeps):
    """All numbers of a loop, in tables made beforehand."""
    t0, t1 = t_span
    samples = whole_multiple((t1 - t0) * law.rate, f"t_span of {t1 - t0:g} s at {law.rate:g} Hz", "samples")
    kept = plant.n_x + len(law.measures) + len(law.memory) + law.n_out + len(plant.inputs) + len(conditions.noise)
    require_memory(samples, kept, f"The loop runs for {t1 - t0:g} s at {law.rate:g} Hz")
    first = whole_multiple((t0 - law.t0) * law.rate, f"A start at {t0:g} s of a law from {law.t0:g} s on", "samples")
    low, high, change = limits(plant, law.period)
    idle = _idle(law, t0)
    idle = idle if low is None else np.clip(idle, low, high)
    x0 = _start(plant, t0, x0, idle)
    substeps, transport = steps(plant, law.period, substeps, t0, x0, idle)
    forces = conditions.disturbance
    return Loop(
        samples=samples, substeps=substeps, delay=delay, n_u=len(plant.inputs), n_out=law.n_out, first=first,
        at_u=len(plant.parameters), t0=t0, period=law.period, p=plant.p(), x0=x0, z0=law.memory, table=law.table.T,
        measured=np.array([plant.state_names.index(name) for name in law.measures], dtype=np.int64),
        disturbed=np.array([_index(name, plant.disturbable, "generalised force") for name in forces], dtype=np.int64),
        idle=idle, disturbance=disturbed(forces, t0, law.period / substeps, samples * substeps),
        noise=noisy(conditions.noise, law.measures, samples + 1, conditions.seed),
        quantum=_by_measure(conditions.quantisation, law.measures, "quantisation"),
        low=low, high=high, change=change, transport=transport,
    )  # fmt: skip


def _idle(law, t0):
    """Inputs before the first command arrives: the law's own, or what its plan asks for where it starts later."""
    plan = law.plan
    if plan is None or getattr(plan, "model", None) is None or not plan.t[0] < t0:
        return law.idle
    now = resampled(plan, np.array([min(t0, plan.t[-1])]))
    return np.array([now[name][0] for name in law.inputs])


def _start(plant, t0, x0, idle):
    """The state at the start, with lagged inputs at rest that were not given; material constraints must hold."""
    x = plant.state(x0)
    at_rest = dict(zip(plant.inputs, idle, strict=True))
    x = np.array(
        [at_rest[name] if np.isnan(value) else value for name, value in zip(plant.state_names, x, strict=True)]
    )
    if plant.constrained:
        values = np.abs(plant.function("constraints")(t0, x, plant.p()))
        worst = int(np.argmax(values))
        if values[worst] > CONSISTENT * max(1.0, np.abs(x).max()):
            raise InconsistentStart(
                f"{plant.constraint_names()[worst]} is {values[worst]:.3g} at the start.",
                "Nature keeps material constraints and their rates at zero.",
                nearest="plan.state(t0), or model.start(...).",
                do="Give a start that satisfies them.",
                values=dict(zip(plant.constraint_names(), values.tolist(), strict=True)),
            )
    return x


def finish(plant, law, loop, conditions, plan):
    """Run a loop; the `Closed` of it, or the error that it ended with."""
    begin(law)
    step = law.step if isinstance(law.step, Compiled) else law.answer
    status, x, law_x, law_y, inputs = run_loop(plant.function("ode"), step, loop)
    t = loop.t0 + np.arange(len(x)) * loop.period
    m, n_y, n_z = loop.n_u, len(law.measures), len(law.memory)
    end = loop.t0 + len(x) * loop.period
    message = {
        FINISHED: "finished",
        STATE_LOST: f"the state is not finite at t = {end:.6g} s",
        LAW_LOST: f"the law's answer is not finite at t = {end:.6g} s",
    }.get(status, f"the law raised {type(status).__name__} at t = {end:.6g} s")
    run = Closed(
        t, x.T, inputs.T, law_y[:, :m].T, law_x[: len(x), :n_y].T, law_x[: len(x), n_y:].T, law_y[:, m + n_z :].T,
        plant, law, plan, loop, conditions, status == FINISHED, 0 if status == FINISHED else -1, message,
    )  # fmt: skip
    if status == FINISHED:
        return run
    if isinstance(status, BaseException):
        error = status
    elif status == STATE_LOST:
        error = IntegrationStopped(
            f"The closed loop has no finite state at t = {end:.6g} s.",
            "An unstable loop grows until its numbers end; integration steps that are too long do the same.",
            nearest=f"The motion up to t = {max(end - loop.period, loop.t0):.6g} s, which is kept in run.",
            do="Check signs and rate of the law; take more substeps.",
            t=end,
        )
    else:
        error = ServoError(
            f"The law {law.name!r} answered with NaN or infinity at t = {end:.6g} s.",
            "A command is a finite number at each sample.",
            nearest=f"The motion up to t = {max(end - loop.period, loop.t0):.6g} s, which is kept in run.",
            do="Check what the law does with this measurement.",
            t=end,
        )
    error.run = run
    raise error


def begin(law):
    """Start the user's own law anew, where it has a start."""
    if isinstance(law.step, _Function):
        law.step.begin()


def limits(plant, period):
    """Lower and upper limits of the inputs, and the largest change in a sample; None for those the plant has not."""
    pairs = np.array([plant.limits.get(name, (-np.inf, np.inf)) for name in plant.inputs]).reshape(-1, 2)
    change = np.array([plant.rate_limits.get(name, np.inf) for name in plant.inputs]) * period
    low, high = (pairs[:, 0], pairs[:, 1]) if plant.limits else (None, None)
    return low, high, change if plant.rate_limits else None


def steps(plant, period, substeps, t0, x0, u0):
    """Integration steps per sample, and those by which each input arrives late (None for no transport delay).

    Raises
    ------
    SpecificationError
        If a transport delay is no whole number of steps, or the start does not tell how many steps are needed.
    """
    delays = np.array([plant.delay.get(name, 0.0) for name in plant.inputs])
    if substeps is None:
        least = _resolving(plant, period, t0, x0, u0)
        fitting = (n for n in range(least, MOST_SUBSTEPS + 1) if _fits(delays * n / period))
        substeps = next(fitting, least)
    substeps = whole_multiple(substeps, "substeps", "steps per sample")
    if substeps < 1:
        raise SpecificationError("substeps = 0 was given.", "A sample is at least one step.", "1.", "Change it.")
    if not plant.delay:
        return substeps, None
    late = delays * substeps / period
    if not _fits(late):
        name = plant.inputs[int(np.argmax(np.abs(late - np.rint(late))))]
        wanted = plant.delay[name]
        rates = [k / wanted for k in {max(int(np.floor(wanted / period)), 1), int(np.ceil(wanted / period))}]
        raise SpecificationError(
            f"The transport delay {wanted:g} s of {name!r} is {wanted * substeps / period:.6g} integration steps of "
            f"{period / substeps:g} s.",
            "A transport delay is a whole number of integration steps.",
            nearest=f"Rates of {' or '.join(f'{rate:.6g}' for rate in sorted(rates))} Hz.",
            do="Change the rate, the substeps or the delay.",
            name=name,
        )
    return substeps, np.rint(late).astype(np.int64)


def _resolving(plant, period, t0, x0, u0):
    """The least number of steps per sample for the fastest eigenvalue at the start."""
    A, _ = plant.linearised(t0, x0[:, None], u0[:, None])
    fastest = np.abs(np.linalg.eigvals(A[0])).max(initial=0.0) if np.isfinite(A).all() else np.inf
    least = fastest * period / RESOLVED
    if not least <= MOST_SUBSTEPS:
        raise SpecificationError(
            f"The plant's linearisation at the start has eigenvalues of up to {fastest:.4g} 1/s, at {1 / period:g} Hz."
            if fastest < np.inf
            else "The plant's linearisation at the start is not finite.",
            f"Without substeps a sample is divided into at most {MOST_SUBSTEPS} steps, each resolving these.",
            nearest=f"substeps={least:.0f}." if fastest < np.inf else "substeps=10.",
            do="Give substeps, or leave out a lag or a stiffness that fast.",
            eigenvalue=float(fastest),
        )
    return max(1, int(np.ceil(least)))


def _fits(numbers):
    return np.abs(numbers - np.rint(numbers)).max(initial=0.0) < ON_SAMPLE


def disturbed(forces, t0, h, count):
    """Disturbances at the start, middle and end of each integration step, (count, 3, n_d); None without any."""
    if not forces:
        return None
    starts = t0 + np.arange(count)[:, None] * h
    t = starts + np.array([INSIDE, 0.5, 1 - INSIDE]) * h
    return np.stack([sampled(name, f, t) for name, f in forces.items()], axis=-1)


def noisy(noise, measures, count, seed):
    """Normally distributed noise of each sample, (count, n_y); None without any."""
    std = _by_measure(noise, measures, "noise")
    return None if std is None else np.random.default_rng(seed).standard_normal((count, len(std))) * std


def _by_measure(values, measures, what):
    """Numbers in the order of the measurement, 0 where none was given; None without any."""
    if not mapping(values, f"The {what}"):
        return None
    found = np.zeros(len(measures))
    for name, value in values.items():
        found[_index(name, measures, "measured state")] = finite(name, value, what)
        if found.min() < 0:
            raise SpecificationError(f"The {what} of {name!r} is {value}.", "It is not negative.", do="Change it.")
    return found


def _index(name, names, what):
    if name not in names:
        raise unknown(name, names, what)
    return names.index(name)


def _as_law(law, plant, rate, t0, plan):
    """A law of the toolkit as it is; a function as a law that measures all states."""
    if isinstance(law, Law):
        if rate is not None and abs(positive("rate", rate) - law.rate) > 1e-12 * law.rate:
            raise SpecificationError(
                f"rate={rate:g} Hz was given for a law of {law.rate:g} Hz.",
                "A law runs at the rate that it was designed for.",
                nearest=f"{law.rate:g} Hz.",
                do="Design the law for this rate.",
            )
        return law
    if isinstance(law, type) or not callable(law) and not hasattr(law, "start"):
        raise SpecificationError(
            f"A {type(law).__name__} was given as law.",
            "A law is made by sv.lqr and others, or is a function law(t, measurement) -> inputs.",
            do="Give one of them.",
        )
    if rate is None:
        raise SpecificationError(
            "A function was given as law without a rate.", "It is called once per sample.",
            nearest="rate=100.0.", do="Give the rate [Hz].",
        )  # fmt: skip
    name = getattr(law, "__name__", type(law).__name__)
    function = _Function(law, name, plant)
    idle = Reference(plan, plant, rate).idle if plan is not None else None
    return Law(
        name, plant.state_names, plant.inputs, positive("rate", rate), t0, function, np.zeros((1, 1)),
        idle=idle, plan=plan,
    )  # fmt: skip


class _Function:
    """A user's function as the step of a law."""

    def __init__(self, law, name, plant):
        self._given, self._law, self._name, self._plant = law, law, name, plant

    def begin(self):
        """Start the law where it has a memory of its own."""
        self._law = self._given.start() if hasattr(self._given, "start") else self._given
        if not callable(self._law):
            raise SpecificationError(
                f"The law {self._name!r} was started, and gave a {type(self._law).__name__}.",
                "A law's start gives the function that answers.",
                nearest="return lambda t, y: {...}.",
                do="Return it from start.",
            )

    def __call__(self, t, x, _row):
        inputs = self._plant.inputs
        u = self._law(t, dict(zip(self._plant.state_names, x.tolist(), strict=True)))
        if isinstance(u, dict):
            for name in (*u, *inputs):
                if name not in inputs or name not in u:
                    raise unknown(name, inputs if name not in inputs else u, "input of the law")
            u = [u[name] for name in inputs]
        try:
            found = np.asarray(u, dtype=float).reshape(-1)
        except (TypeError, ValueError):
            found = np.zeros(0)
        if found.size != len(inputs):
            raise SpecificationError(
                f"The law {self._name!r} answered {u!r} at t = {t:.6g} s."[:200],
                f"It answers {len(inputs)} numbers: {', '.join(inputs)}.",
                do="Return a sequence in this order, or a dict.",
                t=t,
            )
        return found


def require_names(law, plant):
    """Refuse a law that measures or commands what the plant lacks."""
    for name in law.measures:
        _index(name, plant.state_names, "state of the plant")
    for name in law.inputs:
        _index(name, plant.inputs, "actuator of the plant")
    if law.inputs != plant.inputs:
        raise SpecificationError(
            f"The law commands {', '.join(law.inputs)}.",
            f"The plant's actuators are {', '.join(plant.inputs)}, in this order.",
            do="Design the law for a plant with the same actuators.",
        )
