"""The sampled closed loop of a plant and a law."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servoctl.checks import as_numbers, as_span, require_memory, whole_multiple
from servoctl.control.conditions import Conditions, Sensors, Timing, index, limits, require_few_steps, steps
from servoctl.control.law import Law, UserStep
from servoctl.control.loop import FINISHED, INTERRUPTED, LAW_LOST, STATE_LOST, Loop, run_loop
from servoctl.control.reference import Reference, of_plan, require_plan, require_plant
from servoctl.control.result import Closed
from servoctl.errors import InconsistentStart, IntegrationStopped, ServoError, SpecificationError
from servoctl.model.full import first_departure, other_order
from servoctl.plants.plant import Plant
from servoctl.run import Run

CONSISTENT = 1e-6  # of the state: the largest residual of a material constraint at the start


def close(
    plant: Plant,
    law: Law | Callable[..., Any],
    x0: ArrayLike | Mapping[str, float],
    t_span: tuple[float, float],
    *,
    sensors: Sensors | None = None,
    timing: Timing | None = None,
    disturbance: Mapping[str, Callable[..., Any] | float] | None = None,
    plan: Run | None = None,
) -> Closed:
    """Run a sampled law on a plant.

    In each sample the state is measured, with noise and quantisation; the law computes a command; after the delay the
    command is limited in magnitude, then in rate, and held. Between samples the plant is integrated by the Runge-Kutta
    method of order 4. All of it is one compiled loop.

    Parameters
    ----------
    plant : Plant
    law : Law or callable
        A function law(t, measurement) -> inputs gets a dict of all states by name, and returns a dict by actuator or a
        sequence in their order. An object with a method `start` is started first; that returns the function.
    x0 : array or dict of str to float
        Initial state of the plant, (q, γ'), followed by lagged inputs. Lagged inputs that are left out start at the
        initial input of the law.
    t_span : (t0, t1)
        [s]; t0 is a sampling instant of the law, t1 - t0 a whole number of samples.
    sensors : Sensors, optional
        Noise and quantisation of the measurement; default: none.
    timing : Timing, optional
        Rate [Hz] of a function, delay in samples, integration steps per sample.
    disturbance : dict of str to callable or float, optional
        Generalised forces by coordinate (or quasi-velocity), functions of time such as those of `sv.disturbances`.
        Integration steps end at their edges; those of your own function are its attribute `edges`, a sequence [s], and
        steps are at most its `longest` [s]. A parameter of the mechanism that enters forces only, such as the speed of
        the wind, is also named: its value is then this function, which the law does not know.
    plan : Run, optional
        The reference trajectory for residuals and errors; default: that of the law.

    Returns
    -------
    Closed
        After Ctrl-C it holds what was computed, with `success` False.

    Raises
    ------
    NameUnknown
        For a name that plant or law do not have.
    SpecificationError
        For times that are not whole samples or steps, for invalid values, and for a disturbed parameter on which
        inertia, kinematics or constraints depend.
    ServoError
        If the law returns NaN or infinity. An error of the law itself is passed on; its `run` is the motion so far.
    InconsistentStart
        If the initial state violates a material constraint.
    IntegrationStopped
        If the state becomes infinite; `run` is the motion so far.
    """
    require_plant(plant)
    plant = _of_start(plant, getattr(law, "plan", None) if plan is None else plan, x0)
    t_span, conditions = as_span(t_span, forward=True), Conditions(sensors, timing, disturbance)
    law = as_law(law, plant, conditions.timing.rate, t_span[0], plan)
    require_names(law, plant)
    if plan is not None:
        require_plan(plan, plant)
    plan = law.plan if plan is None else plan
    plant, loop = loop_of(plant, law, x0, t_span, conditions)
    return finished(plant, law, plan, loop, conditions)


def _of_start(plant, plan, x0):
    """The plant without coordinates that play no part in the plan's program, unless the start has them."""
    part = of_plan(plan, plant)
    if isinstance(x0, Mapping):
        return part if set(x0) <= set(part.state_names) else plant
    size = as_numbers(getattr(x0, "values", x0)).size
    return part if size in (part.n_x - len(part.lag), part.n_x) else plant


def loop_of(plant, law, x0, t_span, conditions):
    """The plant, with pivots that do not vanish at the start, and all numbers of the loop, in tables."""
    (t0, t1), sensors, timing, forces = t_span, conditions.sensors, conditions.timing, conditions.disturbance
    samples = whole_multiple((t1 - t0) * law.rate, f"t_span of {t1 - t0:g} s at {law.rate:g} Hz", "samples")
    stored = plant.n_x + len(law.measures) + len(law.state) + law.n_out + len(plant.inputs) + len(sensors.noise)
    require_memory(samples, stored, f"The loop runs for {t1 - t0:g} s at {law.rate:g} Hz")
    disturbed = np.array([plant.disturbed(name) for name in forces], dtype=np.int64)
    first = whole_multiple((t0 - law.t0) * law.rate, f"A start at {t0:g} s of a law from {law.t0:g} s on", "samples")
    low, high, change = limits(plant, law.period)
    initial = np.clip(_initial_input(law, t0), low, high)
    x0 = _initial_state(plant, t0, x0, initial)
    plant = plant.sound_at(t0, x0, plant.p(initial))
    substeps, transport = steps(plant, law.period, timing.substeps, t0, x0, initial)
    require_few_steps(samples, substeps, plant.function("ode").operations)
    loop = Loop(
        samples=samples,
        substeps=substeps,
        delay=timing.delay,
        n_u=len(plant.inputs),
        n_out=law.n_out,
        first=first,
        at_u=plant.at_u,
        t0=t0,
        period=law.period,
        p=plant.p()[plant.place.size :],
        x0=x0,
        z0=law.state,
        table=law.schedule.T,
        measured=np.array([plant.state_names.index(name) for name in law.measures], dtype=np.int64),
        disturbed=disturbed,
        initial_input=initial,
        noise=sensors.noisy(law.measures, samples + 1) if sensors.noise else None,
        quantum=sensors.quantum(law.measures) if sensors.quantisation else None,
        low=low,
        high=high,
        change=change,
        transport=transport,
        **conditions.forces(t0, law.period / substeps, samples * substeps),
    )
    return plant, loop


def _initial_input(law, t0):
    """The inputs until the first command arrives: the law's, or the plan's at t0 for a loop that starts mid-plan."""
    plan = law.plan
    if plan is None or getattr(plan, "model", None) is None or not plan.t[0] < t0:
        return law.initial_input
    at_start = plan.sampled(np.array([min(t0, plan.t[-1])]))
    return np.array([at_start[name][0] for name in law.inputs])


def _initial_state(plant, t0, x0, initial_input):
    """The initial state; lagged inputs that were left out are at rest, material constraints must hold."""
    x = plant.state(x0)
    for i, name in enumerate(plant.lagged, len(x) - len(plant.lag)):
        x[i] = initial_input[plant.inputs.index(name)] if np.isnan(x[i]) else x[i]
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
            "The initial state must satisfy the material constraints and their time derivatives.",
            do="Take a state of a motion, such as plan.state(t0) or model.start(...).",
            name=names[row],
            values=dict(zip(names, values[:, case].tolist(), strict=True)),
            case=int(case),
        )


def finished(plant, law, plan, loop, conditions, advance=None):
    """Run a loop and return its `Closed`, or raise the error that ended it; `advance` is that of `run_loop`."""
    status, x, law_x, law_y, inputs = run_loop(plant, law.begin(), loop, advance)
    if status == INTERRUPTED and not len(x):
        raise KeyboardInterrupt
    t = loop.t0 + np.arange(len(x)) * loop.period
    m, n_y, n_z = loop.n_u, len(law.measures), len(law.state)
    end = loop.t0 + len(x) * loop.period
    message = {
        FINISHED: "finished",
        STATE_LOST: f"the state is not finite at t = {end:.6g} s",
        LAW_LOST: f"the law's answer is not finite at t = {end:.6g} s",
        INTERRUPTED: f"interrupted at t = {end - loop.period:.7g} s; what was computed is kept",
    }.get(status, f"the law raised {type(status).__name__} at t = {end:.6g} s")
    run = Closed(
        t,
        x.T,
        inputs.T,
        law_y[:, :m].T,
        law_x[: len(x), :n_y].T,
        law_x[: len(x), n_y:].T,
        law_y[:, m + n_z :].T,
        plant,
        law,
        plan,
        loop,
        conditions,
        status == FINISHED,
        {FINISHED: 0, INTERRUPTED: 1}.get(status, -1),
        message,
    )
    if status in (FINISHED, INTERRUPTED):
        return _of_same_orders(run)
    error = status if isinstance(status, BaseException) else _stopped(law, loop, status, end)
    error.run = run
    raise error


def _of_same_orders(run):
    """The loop, if its material constraints have the same orders at all of its samples."""
    plant = run.plant
    if not plant.equations.rests:
        return run
    full, project, n_x = plant.function("full"), plant.function("project"), plant.n_x

    def restored(t, z):
        z[:n_x] += project.grid(t, z[:n_x], z[n_x:])
        return z

    points = np.vstack([run.states, np.nan_to_num(run.p)])
    names = [*plant.equations.written, *plant.equations.omitted]
    k, row = first_departure(names, lambda t, z: full.grid(t, z[:n_x], z[n_x:]), run.t, points, restored)
    if k is None:
        return run
    error = other_order(row, float(run.t[k]))
    error.run = replace(run, success=False, status=-1, message=f"stopped: {str(error).split('. ')[0]}")
    raise error


def _stopped(law, loop, status, end):
    """The error of a loop whose state or command is not finite at its end [s]."""
    so_far = f"`.run` is the motion up to t = {max(end - loop.period, loop.t0):.6g} s."
    if status == STATE_LOST:
        return IntegrationStopped(
            f"The state of the closed loop is not finite at t = {end:.6g} s.",
            "An unstable loop diverges; so does an integration with too long steps.",
            do=f"Check signs and rate of the law, or take more substeps; {so_far}",
            t=end,
            rate=law.rate,
            substeps=loop.substeps,
        )
    return ServoError(
        f"The law {law.name!r} returned NaN or infinity at t = {end:.6g} s.",
        "A command is a finite number at each sample.",
        do=f"Check the law at this measurement; {so_far}",
        name=law.name,
        t=end,
    )


def as_law(law, plant, rate, t0, plan):
    """A Law as it is; a function as a law that measures all states."""
    if isinstance(law, Law):
        # both rates may come from the same division by two ways of rounding
        if rate is not None and abs(rate - law.rate) > 1e-12 * law.rate:
            raise SpecificationError(
                f"The timing has rate={rate:g} Hz, the law {law.rate:g} Hz.",
                "A law runs at the rate of its design.",
                nearest=f"{law.rate:g} Hz.",
                do="Leave the rate out, or design the law for it.",
                rate=rate,
                law_rate=law.rate,
            )
        return law
    if isinstance(law, type) or not callable(law) and not hasattr(law, "start"):
        raise SpecificationError(
            f"Expected a law, got a {type(law).__name__}.",
            "A law is a Law, as of sv.lqr, or a function law(t, measurement) -> inputs.",
            do="Pass one of these.",
            kind=type(law).__name__,
        )
    name = getattr(law, "__name__", type(law).__name__)
    if rate is None:
        raise SpecificationError(
            f"The function {name!r} has no rate.",
            "A function as law is called once per sample.",
            do="Pass the rate [Hz]: timing=sv.Timing(rate=100.0).",
            name=name,
        )
    initial = Reference(plan, plant, rate).initial_input if plan is not None else None
    step = UserStep(law, name, plant.state_names, plant.inputs)
    schedule = np.zeros((1, 1))
    return Law(name, plant.state_names, plant.inputs, rate, t0, step, schedule, initial_input=initial, plan=plan)


def require_names(law, plant):
    """Refuse a law with other states or actuators than the plant's."""
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
