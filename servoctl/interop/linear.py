"""Linear systems of python-control, by name: exact linearisations."""

import numpy as np

from servoctl.checks import finite, positive
from servoctl.codegen.jacobians import differentiable, jacobian
from servoctl.control.law import Law, ordered
from servoctl.control.reference import resampled
from servoctl.control.result import Closed
from servoctl.control.sampling import discretised
from servoctl.errors import SpecificationError, unknown
from servoctl.interop.names import connected, force_names, output_names, signal_names, stranger
from servoctl.model.model import Model
from servoctl.plants.plant import Plant


def linearise(thing, t, x=None, u=None, *, controller_state=None, rate=None, disturbed=(), name=None):
    """A model, plant, law or closed loop linearised exactly, from its expressions, as a named `control.StateSpace`.

    Parameters
    ----------
    thing : Model, Plant, Law or Closed
        A plant is linearised where no limit is met. Of a closed loop that is its state at the sample t.
    t : float
        [s]
    x : (n,) array or dict of str to float
        State of the model or plant; of a law the measurement, default its plan's.
    u : (m,) array or dict of str to float, optional
        Of a plant: its inputs; default 0.
    controller_state : (n_z,) array, optional
        Of a law; default that at its start.
    rate : float, optional
        Of a plant: discretised exactly under a zero-order hold of 1/rate.
    disturbed : sequence of str
        Of a plant: generalised forces that are inputs, too.
    name : str, optional

    Returns
    -------
    control.StateSpace
        With the names of `nlsys`; a law's and a closed loop's in discrete time, u = C z + D y about the point.

    Raises
    ------
    SpecificationError
        For a law written in Python, a plant with transport delay, options that the thing does not have.
    NameUnknown
        For a disturbance on no generalised force.
    """
    options = {"u": u is not None, "controller_state": controller_state is not None}
    options |= {"rate": rate is not None, "disturbed": bool(disturbed)}
    allowed = {Plant: ("u", "rate", "disturbed"), Law: ("controller_state",), Closed: (), Model: ()}
    for kind, valid in allowed.items():
        surplus = [option for option, given in options.items() if given and option not in valid]
        if isinstance(thing, kind) and (surplus or (kind is Closed and x is not None)):
            raise SpecificationError(
                f"{', '.join(surplus) or 'x'} was given for a {kind.__name__}.",
                f"It has {', '.join(('t', *(('x',) if kind is not Closed else ()), *valid))}.",
                do="Leave it out.",
            )
    t = finite("t", t, "time")
    if isinstance(thing, Plant):
        return _linear_plant(thing, t, thing.state(x), u, rate, disturbed, name or "plant")
    if isinstance(thing, Law):
        return _linear_law(thing, t, x, controller_state, name or "law")
    if isinstance(thing, Closed):
        return _linear_closed(thing, t, name or "loop")
    if isinstance(thing, Model):
        return _linear_model(thing, t, np.asarray(getattr(x, "values", x), dtype=float), name or "model")
    raise stranger(thing)


def along(thing, run, times=None, **options):
    """A plant, model or law linearised along a run, one after another.

    Parameters
    ----------
    thing : Plant, Model or Law
    run : Run or Closed
        Gives states, inputs or measurements, by name.
    times : (N,) array, optional
        [s], in increasing order within the run; of a law instants of sampling, of a closed loop its samples. Default:
        all samples of the run.
    **options
        rate, disturbed, name: of `linearise`.

    Yields
    ------
    control.StateSpace

    Raises
    ------
    SpecificationError
        For times outside the run, and as `linearise`.
    """
    times = run.t if times is None else np.atleast_1d(np.asarray(times, dtype=float))
    if isinstance(run, Closed):
        picked = [int(np.argmin(np.abs(run.t - t))) for t in times]
        [run.state(t) for t in times]  # refuses what is no sample
        values = {name: run[name][picked] for name in run.names}
        values |= {f"input {name}": value[picked] for name, value in run.input.items()}
    else:
        _require_within(run, times)
        values = resampled(run, times)
    for k, t in enumerate(times):
        if isinstance(thing, Plant):
            x = {name: values[name][k] for name in thing.state_names}
            inputs = [f"input {name}" if isinstance(run, Closed) else name for name in thing.inputs]
            yield linearise(thing, t, x, [values[name][k] for name in inputs], **options)
        elif isinstance(thing, Law):
            yield linearise(thing, t, {name: values[name][k] for name in thing.measures}, **options)
        elif isinstance(thing, Model):
            yield linearise(thing, t, np.array([values[name][k] for name in thing.state_names]), **options)
        else:
            raise stranger(thing)


def _require_within(run, times):
    room = 1e-9 * (run.t[-1] - run.t[0])
    if not len(times):
        raise SpecificationError("No times were given.", "A linearisation has an instant.", do="Give one or more.")
    if np.any(np.diff(times) < 0) or times[0] < run.t[0] - room or times[-1] > run.t[-1] + room:
        raise SpecificationError(
            f"Times from {times[0]:g} to {times[-1]:g} s were given.",
            f"They increase, within the run: {run.t[0]:g} to {run.t[-1]:g} s.",
            do="Give such times.",
        )


def loop_gain(plant, law, at):
    """The loop's gain L at one actuator, all other loops closed.

    With the loop cut where the law's command enters the plant, L is minus the gain from there back to the command:
    1 + L = 0 at the closed loop's poles. Margins are those of `control.stability_margins(control.frd(L, w))`: of a
    StateSpace python-control takes them from polynomials, which lose all digits for more than a few states.

    Parameters
    ----------
    plant, law : control.StateSpace
        From `linearise`, with the same dt.
    at : str
        Name of the actuator.

    Returns
    -------
    control.StateSpace
        With one input and one output.

    Raises
    ------
    NameUnknown
        If the law has no such actuator.
    SpecificationError
        For what is no linear system, or different sampling.
    """
    import control

    for system in (plant, law):
        if not isinstance(system, control.StateSpace):
            raise stranger(system, "A loop gain is that of two linear systems, from interop.linearise.")
    if plant.dt != law.dt:
        raise SpecificationError(
            f"The plant has dt = {plant.dt:g} s, the law {law.dt:g} s.",
            "A sampled law is closed around a plant that is sampled alike.",
            nearest=f"interop.linearise(plant, t, x, u, rate={1 / law.dt:g}).",
            do="Linearise the plant with the law's rate.",
        )
    if at not in law.output_labels:
        raise unknown(at, law.output_labels, "actuator")
    plant, law = _renamed(plant, "plant"), _renamed(law, "law")
    wires = [[f"plant.{a}", f"law.{a}"] for a in law.output_labels if a != at]
    wires += [[f"law.{y}", f"plant.{y}"] for y in law.input_labels]
    return control.interconnect(
        [plant, law], wires, inplist=[f"plant.{at}"], outlist=[f"-law.{at}"], inputs=[at], outputs=[f"-{at}"],
        name=f"loop gain at {at}", warn_duplicate=False, check_unused=False,
    )  # fmt: skip


def _linear_plant(plant, t, x, u, rate, disturbed, name):
    import control

    if plant.delay:
        raise SpecificationError(
            f"The plant has a transport delay of {max(plant.delay.values()):g} s.",
            "A linear system of finite order has none in continuous time, and whole samples of it in discrete time.",
            nearest="sv.plant without delay, and a delay of sv.close or a control.pade in series.",
            do="Linearise the plant without delay.",
        )
    (disturbed, forces), m, n_x = force_names(plant, disturbed), len(plant.inputs), plant.n_x
    u = np.zeros(m) if u is None else ordered(u, plant.inputs, "input")
    at_rest = [0.0] * (n_x - len(plant.lag)) + [u[plant.inputs.index(name)] for name in plant.lagged]
    x = np.where(np.isnan(x), at_rest, x)
    p, at_u = plant.p(u), len(plant.parameters)
    columns = [*range(at_u, at_u + m), *(at_u + m + i for i in forces)]
    A, B = jacobian(plant.function("ode"), "x", t, x, p), jacobian(plant.function("ode"), "p", t, x, p)[:, columns]
    C, D = np.eye(n_x), np.zeros((n_x, len(columns)))
    if plant.mechanism.outputs:
        C = np.vstack([C, jacobian(plant.function("outputs"), "x", t, x, p)])
        D = np.vstack([D, jacobian(plant.function("outputs"), "p", t, x, p)[:, columns]])
    if rate is not None:
        A, B = (part[0] for part in discretised(A[None], B[None], 1.0 / positive("rate", rate)))
    return control.ss(
        A, B, C, D, dt=0 if rate is None else 1.0 / rate, name=name, states=plant.state_names,
        inputs=[*plant.inputs, *(f"disturbance {force}" for force in disturbed)], outputs=output_names(plant),
    )  # fmt: skip


def _linear_law(law, t, x, controller_state, name):
    import control

    if not differentiable(law.step):
        raise SpecificationError(
            f"The law {law.name!r} is computed in Python.",
            "A linearisation is taken from expressions.",
            do="Linearise the law that it allocates within limits, or interop.nlsys(law) by differences.",
        )
    if x is None:
        if law.plan is None:
            raise SpecificationError("The law has no plan.", "A linearisation has a point.", do="Give the measurement.")
        at = resampled(law.plan, np.clip([float(t)], law.plan.t[0], law.plan.t[-1]))
        x = {measure: at[measure][0] for measure in law.measures}
    y, m, n_z = ordered(x, law.measures, "measurement", exactly=False), len(law.inputs), len(law.state)
    z = np.asarray(law.state if controller_state is None else controller_state, dtype=float)
    if z.shape != (n_z,):
        raise SpecificationError(
            f"The controller state has the shape {z.shape}.", f"That of the law has {n_z} numbers.", do="Give as many."
        )
    J = jacobian(law.step, "x", t, np.append(y, z), law.schedule_at(t))
    n_y = len(y)
    A, B, C, D = J[m : m + n_z, n_y:], J[m : m + n_z, :n_y], J[:m, n_y:], J[:m, :n_y]
    return control.ss(
        A, B, C, D, dt=law.period, name=name, states=law.state_names, outputs=law.inputs,
        inputs=signal_names(law.measures, law.inputs), remove_useless_states=False,
    )  # fmt: skip


def _linear_closed(closed, t, name):
    plant, law, loop = closed.plant, closed.law, closed.loop
    x = closed.state(t)
    k = int(np.argmin(np.abs(closed.t - t)))
    if loop.quantum is not None:
        raise SpecificationError(
            "The measurement is quantised.", "Steps have no linearisation.", do="Close the loop without quantisation."
        )
    u, y = closed.inputs[:, k], closed.measurements[:, k]
    system = _late(_linear_plant(plant, t, x, u, law.rate, plant.disturbable, "plant"), plant, loop.delay)
    return connected(system, _linear_law(law, t, y, closed.controller_states[:, k], "law"), plant, law, name)


def _late(system, plant, delay):
    """A sampled plant whose actuators receive each command `delay` samples late: past commands are further states."""
    import control

    if not delay:
        return system
    m, n = len(plant.inputs), system.nstates
    size, others = n + m * delay, system.ninputs - m
    A, B = np.zeros((size, size)), np.zeros((size, m + others))
    A[:n, :n], A[:n, size - m :] = system.A, system.B[:, :m]  # the oldest command acts
    A[n + m :, n : size - m] = np.eye(m * (delay - 1))
    B[n : n + m, :m], B[:n, m:] = np.eye(m), system.B[:, m:]
    C = np.zeros((system.noutputs, size))
    C[:, :n], C[:, size - m :] = system.C, system.D[:, :m]
    D = np.hstack([np.zeros((system.noutputs, m)), system.D[:, m:]])
    names = [f"command of {name} {k} ago" for k in range(1, delay + 1) for name in plant.inputs]
    return control.ss(
        A, B, C, D, dt=system.dt, name="plant", states=[*system.state_labels, *names],
        inputs=system.input_labels, outputs=system.output_labels,
    )  # fmt: skip


def _linear_model(model, t, x, name):
    import control

    n, n_x, p = model.n, len(model.state_names), model.parameters
    if x.shape != (n_x,):
        raise SpecificationError(
            f"The state has the shape {x.shape}.", f"It has {n_x} numbers: {', '.join(model.state_names)}.",
            nearest="model.start(...).", do="Give them in this order.",
        )  # fmt: skip
    ode = model.function("ode")
    A = jacobian(ode, "x", t, x, p)[:n_x]
    z, to_jets = np.append(x, ode(t, x, p)[n_x - n : n_x]), np.vstack([np.eye(n_x), A[-n:]])
    groups = [model.signals("reaction" if model.ideal else "actuation"), model.signals("outputs")]
    C = [np.eye(n_x), *(jacobian(f, "x", t, z, p) @ to_jets for group, f in groups if group)]
    names = [*model.state_names, *(name for group, _ in groups for name in group)]
    C = np.vstack(C)
    return control.ss(
        A, np.zeros((n_x, 0)), C, np.zeros((len(C), 0)), name=name, states=model.state_names, outputs=names, inputs=[]
    )


def _renamed(system, name):
    import control

    return control.ss(
        system.A, system.B, system.C, system.D, dt=system.dt, name=name, states=system.state_labels,
        inputs=system.input_labels, outputs=system.output_labels, remove_useless_states=False,
    )  # fmt: skip
