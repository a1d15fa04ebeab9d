"""The sampled closed loop: a plant, a law, and what is between them."""

import numpy as np

from servoctl.checks import as_span, require_memory, whole_multiple
from servoctl.control.conditions import Conditions, index, limits, steps
from servoctl.control.law import Law, UserStep
from servoctl.control.loop import FINISHED, LAW_LOST, STATE_LOST, Loop, run_loop
from servoctl.control.reference import Reference, require_plan, require_plant, resampled
from servoctl.control.result import Closed
from servoctl.errors import InconsistentStart, IntegrationStopped, ServoError, SpecificationError

CONSISTENT = 1e-6  # of the state: what may be left of a material constraint at the start


def close(plant, law, x0, t_span, *, sensors=None, timing=None, disturbance=None, plan=None):
    """Run a sampled law on a plant.

    At each sample: the measurement, with noise, quantised; the law; the delay; limits of magnitude, then of rate; a
    zero-order hold. The plant is integrated by the Runge-Kutta method of order 4 in between, in one compiled loop.

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
    sensors : Sensors, optional
        Noise and quantisation of the measurement; default: none.
    timing : Timing, optional
        Rate [Hz] of a function, delay in samples, integration steps per sample.
    disturbance : dict of str to callable or float, optional
        Generalised forces by coordinate (or quasi-velocity): functions of time, such as those of `sv.disturbances`.
        Jumps belong at the ends of integration steps.
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
    t_span, conditions = as_span(t_span, forward=True), Conditions(sensors, timing, disturbance)
    law = _as_law(law, plant, conditions.timing.rate, t_span[0], plan)
    require_names(law, plant)
    if plan is not None:
        require_plan(plan, plant)
    loop = prepared(plant, law, x0, t_span, conditions)
    return _finish(plant, law, law.plan if plan is None else plan, loop, conditions)


def prepared(plant, law, x0, t_span, conditions):
    """All numbers of a `Loop`, in tables made beforehand."""
    (t0, t1), sensors, timing, forces = t_span, conditions.sensors, conditions.timing, conditions.disturbance
    samples = whole_multiple((t1 - t0) * law.rate, f"t_span of {t1 - t0:g} s at {law.rate:g} Hz", "samples")
    stored = plant.n_x + len(law.measures) + len(law.state) + law.n_out + len(plant.inputs) + len(sensors.noise)
    require_memory(samples, stored, f"The loop runs for {t1 - t0:g} s at {law.rate:g} Hz")
    first = whole_multiple((t0 - law.t0) * law.rate, f"A start at {t0:g} s of a law from {law.t0:g} s on", "samples")
    low, high, change = limits(plant, law.period)
    idle = _idle(law, t0)
    idle = idle if low is None else np.clip(idle, low, high)
    x0 = _start(plant, t0, x0, idle)
    substeps, transport = steps(plant, law.period, timing.substeps, t0, x0, idle)
    return Loop(
        samples=samples, substeps=substeps, delay=timing.delay, n_u=len(plant.inputs), n_out=law.n_out, first=first,
        at_u=len(plant.parameters), t0=t0, period=law.period, p=plant.p(), x0=x0, z0=law.state, table=law.schedule.T,
        measured=np.array([plant.state_names.index(name) for name in law.measures], dtype=np.int64),
        disturbed=np.array([index(name, plant.disturbable, "generalised force") for name in forces], dtype=np.int64),
        idle=idle, disturbance=conditions.forces(t0, law.period / substeps, samples * substeps),
        noise=sensors.noisy(law.measures, samples + 1), quantum=sensors.quantum(law.measures),
        low=low, high=high, change=change, transport=transport,
    )  # fmt: skip


def _idle(law, t0):
    """Inputs before the first command arrives: the law's own, or the plan's actuation where it starts later."""
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
    require_consistent(plant, t0, x[:, None], plant.p()[:, None])
    return x


def require_consistent(plant, t0, starts, p):
    """Refuse starts (n_x, N) that violate material constraints, with p (n_p, N) the plant's numbers in each case."""
    if not plant.constrained:
        return
    values = np.abs(plant.function("constraints").grid(t0, starts, p))
    relative = values / np.maximum(1.0, np.abs(starts).max(axis=0))
    row, case = np.unravel_index(int(np.argmax(relative)), values.shape)
    if relative[row, case] > CONSISTENT:
        names = plant.constraint_names()
        which = f" of case {case}" if starts.shape[1] > 1 else ""
        raise InconsistentStart(
            f"{names[row]} is {values[row, case]:.3g} at the start{which}.",
            "Nature keeps material constraints and their rates at zero.",
            do="Give a start that satisfies them, such as plan.state(t0) or model.start(...).",
            values=dict(zip(names, values[:, case].tolist(), strict=True)),
            case=int(case),
        )


def _finish(plant, law, plan, loop, conditions):
    """Run a loop; the `Closed` of it, or the error that it ended with."""
    status, x, law_x, law_y, inputs = run_loop(plant.function("ode"), law.begin(), loop)
    t = loop.t0 + np.arange(len(x)) * loop.period
    m, n_y, n_z = loop.n_u, len(law.measures), len(law.state)
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
    error = status if isinstance(status, BaseException) else _stopped(law, loop, status, end)
    error.run = run
    raise error


def _stopped(law, loop, status, end):
    """The error of a loop whose state, or whose law's answer, is not finite at its end [s]."""
    before = f"`.run` is the motion up to t = {max(end - loop.period, loop.t0):.6g} s."
    if status == STATE_LOST:
        return IntegrationStopped(
            f"The closed loop has no finite state at t = {end:.6g} s.",
            "An unstable loop grows until its numbers end; integration steps that are too long do the same.",
            do=f"Check signs and rate of the law; take more substeps; {before}",
            t=end,
        )
    return ServoError(
        f"The law {law.name!r} answered with NaN or infinity at t = {end:.6g} s.",
        "A command is a finite number at each sample.",
        do=f"Check what the law does with this measurement; {before}",
        t=end,
    )


def _as_law(law, plant, rate, t0, plan):
    """A law of the toolkit as it is; a function as a law that measures all states."""
    if isinstance(law, Law):
        if rate is not None and abs(rate - law.rate) > 1e-12 * law.rate:
            raise SpecificationError(
                f"rate={rate:g} Hz was given for a law of {law.rate:g} Hz.",
                "A law runs at the rate that it was designed for.",
                nearest=f"{law.rate:g} Hz.",
                do="Design the law for this rate.",
                rate=rate,
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
            "A function was given as law without a rate.",
            "It is called once per sample.",
            do="Give the rate [Hz]: timing=sv.Timing(rate=100.0).",
        )
    name = getattr(law, "__name__", type(law).__name__)
    idle = Reference(plan, plant, rate).idle if plan is not None else None
    step = UserStep(law, name, plant.state_names, plant.inputs)
    return Law(name, plant.state_names, plant.inputs, rate, t0, step, np.zeros((1, 1)), idle=idle, plan=plan)


def require_names(law, plant):
    """Refuse a law that measures or commands what the plant lacks."""
    for name in law.measures:
        index(name, plant.state_names, "state of the plant")
    for name in law.inputs:
        index(name, plant.inputs, "actuator of the plant")
    if law.inputs != plant.inputs:
        raise SpecificationError(
            f"The law commands {', '.join(law.inputs)}.",
            f"The plant's actuators are {', '.join(plant.inputs)}, in this order.",
            do="Design the law for a plant with the same actuators.",
            inputs=law.inputs,
            valid=plant.inputs,
        )
