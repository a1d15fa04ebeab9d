"""Exact linearisations as linear systems of python-control, by name."""

from dataclasses import replace

import numpy as np

from servoctl.checks import array_of, as_list, as_numbers, finite, named, positive, require_kind, without_effect
from servoctl.codegen.jacobians import differentiable, jacobian
from servoctl.control.law import Law, ordered
from servoctl.control.result import Closed
from servoctl.control.sampling import discretised
from servoctl.errors import SpecificationError
from servoctl.interop.names import (
    SYSTEMS,
    connected,
    disturbable_of,
    disturbed_names,
    output_names,
    signal_names,
    system_name,
)
from servoctl.model.model import Model
from servoctl.plants.plant import Plant, part_of
from servoctl.reduction.reduce import require_outputs
from servoctl.run import Run

OPTIONS = {Plant: ("x", "u", "rate", "disturbed"), Law: ("x", "controller_state"), Closed: (), Model: ("x",)}


def linearise(thing, t, x=None, u=None, *, controller_state=None, rate=None, disturbed=(), name=None):
    """A model, plant, law or closed loop linearised exactly, from its expressions, as a named `control.StateSpace`.

    Parameters
    ----------
    thing : Model, Plant, Law or Closed
        Limits of a plant are ignored. A closed loop is linearised about its state at the sample t.
    t : float
        [s]
    x : (n,) array or dict of str to float
        State of the model or plant, or measurement of the law; default for a law: that of its plan.
    u : (m,) array or dict of str to float, optional
        Inputs of a plant; default 0.
    controller_state : (n_z,) array, optional
        Controller state of a law; default its initial one.
    rate : float, optional
        A plant is discretised exactly under a zero-order hold of 1/rate [s].
    disturbed : sequence of str
        Generalised forces, and parameters that enter forces only, of a plant that are further inputs.
    name : str, optional

    Returns
    -------
    control.StateSpace
        With the names of `nlsys`; laws and closed loops in discrete time, u = C z + D y about the point.

    Raises
    ------
    SpecificationError
        For a law written in Python, a plant with transport delay, and options that do not apply.
    NameUnknown
        For a disturbance of what is no generalised force or parameter.
    """
    require_kind((Model, Plant, Law, Closed), "thing", thing, SYSTEMS)
    given = {"x": x, "u": u, "controller_state": controller_state, "rate": rate}
    given["disturbed"] = None if as_list(disturbed) == [] else disturbed
    valid = next(options for kind, options in OPTIONS.items() if isinstance(thing, kind))
    idle = [name for name, value in given.items() if value is not None and name not in valid]
    without_effect(idle, f"for a {type(thing).__name__}")
    t = finite("t", t, "time")
    if isinstance(thing, Plant):
        return _linear_plant(thing, t, thing.state(x), u, rate, disturbed, system_name(name, "plant"))
    if isinstance(thing, Law):
        return _linear_law(thing, t, x, controller_state, system_name(name, "law"))
    if isinstance(thing, Closed):
        return _linear_closed(thing, t, system_name(name, "loop"))
    state = ordered(x if isinstance(x, dict) else getattr(x, "values", x), thing.state_names, "state")
    return _linear_model(thing, t, state, system_name(name, "model"))


def along(thing, run, times=None, **options):
    """Linearisations of a plant, model or law along a run.

    Parameters
    ----------
    thing : Plant, Model or Law
        Of a plant the part that the model of the run has, if `derive` left coordinates out.
    run : Run or Closed
        States, inputs or measurements by name.
    times : (N,) array, optional
        Increasing instants [s] within the run: sampling instants for a law, samples of a closed loop. Default: all
        samples of the run.
    **options
        Options rate, disturbed and name of `linearise`.

    Yields
    ------
    control.StateSpace

    Raises
    ------
    SpecificationError
        For times outside the run, and as `linearise`.
    """
    require_kind((Model, Plant, Law), "thing", thing, SYSTEMS)
    require_kind((Run, Closed), "run", run, "sv.simulate(...) or sv.close(...)")
    times = run.t if times is None else array_of("times", np.atleast_1d(as_numbers(times)), None)
    if isinstance(run, Closed):
        picked = [int(np.argmin(np.abs(run.t - t))) for t in times]
        [run.state(t) for t in times]  # refuses what is no sample
        values = {name: run[name][picked] for name in run.names}
        values |= {f"input {name}": value[picked] for name, value in run.input.items()}
    else:
        _require_within(run, times)
        values = run.sampled(times)
        if isinstance(thing, Plant) and run.model is not None:
            thing = part_of(thing, run.model.reduction.mechanism)
    for k, t in enumerate(times):
        if isinstance(thing, Plant):
            inputs = [f"input {name}" if isinstance(run, Closed) else name for name in thing.inputs]
            u = list(_at(values, inputs, k).values())
            yield linearise(thing, t, _at(values, thing.state_names, k), u, **options)
        elif isinstance(thing, Law):
            yield linearise(thing, t, _at(values, thing.measures, k), **options)
        else:
            yield linearise(thing, t, list(_at(values, thing.state_names, k).values()), **options)


def _at(values, names, k):
    return {name: values[name][k] for name in names}


def _require_within(run, times):
    room = 1e-9 * (run.t[-1] - run.t[0])
    if not len(times):
        raise SpecificationError("There are no times.", "A linearisation has an instant.", times=times)
    if np.any(np.diff(times) < 0) or times[0] < run.t[0] - room or times[-1] > run.t[-1] + room:
        raise SpecificationError(
            f"The times go from {times[0]:g} to {times[-1]:g} s.",
            f"Times increase, within {run.t[0]:g} to {run.t[-1]:g} s of the run.",
            do="Sort them, and leave out those beyond the run.",
            times=times,
            span=(float(run.t[0]), float(run.t[-1])),
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
        For anything but linear systems, and for different sampling.
    """
    import control

    for system in (plant, law):
        require_kind(control.StateSpace, "system", system, "interop.linearise(...)")
    if plant.dt != law.dt:
        raise SpecificationError(
            f"The plant has dt = {plant.dt:g} s, the law {law.dt:g} s.",
            "Plant and law have the same sampling period.",
            nearest=f"interop.linearise(plant, t, x, u, rate={1 / law.dt:g}).",
            do="Linearise the plant with the law's rate.",
            plant_dt=plant.dt,
            law_dt=law.dt,
        )
    at = named(at, law.output_labels, "actuator")
    plant, law = plant.copy("plant", use_prefix_suffix=False), law.copy("law", use_prefix_suffix=False)
    wires = [[f"plant.{a}", f"law.{a}"] for a in law.output_labels if a != at]
    wires += [[f"law.{y}", f"plant.{y}"] for y in law.input_labels]
    return control.interconnect(
        [plant, law],
        wires,
        inplist=[f"plant.{at}"],
        outlist=[f"-law.{at}"],
        inputs=[at],
        outputs=[f"-{at}"],
        name=f"loop gain at {at}",
        warn_duplicate=False,
        check_unused=False,
    )


def _linear_plant(plant, t, x, u, rate, disturbed, name):
    import control

    if plant.delay:
        raise SpecificationError(
            f"The plant has a transport delay of {max(plant.delay.values()):g} s.",
            "A delay in continuous time has no linear system of finite order.",
            do="Linearise the plant without delay, and put control.pade in series or a delay of samples into sv.close.",
            delay=dict(plant.delay),
        )
    (disturbed, places), m, n_x = disturbed_names(plant, disturbed), len(plant.inputs), plant.n_x
    u = np.zeros(m) if u is None else ordered(u, plant.inputs, "input")
    at_rest = [0.0] * (n_x - len(plant.lag)) + [u[plant.inputs.index(name)] for name in plant.lagged]
    x = np.where(np.isnan(x), at_rest, x)
    p, at_u = plant.p(u), plant.at_u
    columns = [*range(at_u, at_u + m), *places]
    A, B = jacobian(plant.function("ode"), "x", t, x, p), jacobian(plant.function("ode"), "p", t, x, p)[:, columns]
    C, D = np.eye(n_x), np.zeros((n_x, len(columns)))
    if plant.mechanism.outputs:
        C = np.vstack([C, jacobian(plant.function("outputs"), "x", t, x, p)])
        D = np.vstack([D, jacobian(plant.function("outputs"), "p", t, x, p)[:, columns]])
    if rate is not None:
        A, B = (part[0] for part in discretised(A[None], B[None], 1.0 / positive("rate", rate)))
    return control.ss(
        A,
        B,
        C,
        D,
        dt=0 if rate is None else 1.0 / float(rate),
        name=name,
        states=plant.state_names,
        inputs=[*plant.inputs, *(f"disturbance {force}" for force in disturbed)],
        outputs=output_names(plant),
    )


def _linear_law(law, t, x, controller_state, name):
    import control

    if not differentiable(law.step):
        raise SpecificationError(
            f"The law {law.name!r} is computed in Python.",
            "An exact linearisation needs expressions.",
            do="Linearise the law without sv.limited, or interop.nlsys(law) by differences.",
            name=law.name,
        )
    if x is None:
        if law.plan is None:
            raise SpecificationError(
                f"The law {law.name!r} has no plan.", "A law is linearised about x.", do="Pass x.", name=law.name
            )
        at = law.plan.sampled(np.clip([float(t)], law.plan.t[0], law.plan.t[-1]))
        x = {measure: at[measure][0] for measure in law.measures}
    y, m, n_z = ordered(x, law.measures, "measurement", exactly=False), len(law.inputs), len(law.state)
    z = array_of("controller_state", law.state if controller_state is None else controller_state, n_z)
    J = jacobian(law.step, "x", t, np.append(y, z), law.schedule_at(t))
    n_y = len(y)
    A, B, C, D = J[m : m + n_z, n_y:], J[m : m + n_z, :n_y], J[:m, n_y:], J[:m, :n_y]
    signals = {"states": law.state_names, "outputs": law.inputs, "inputs": signal_names(law.measures, law.inputs)}
    return control.ss(A, B, C, D, law.period, name=name, remove_useless_states=False, **signals)


def _linear_closed(closed, t, name):
    plant, law, loop = closed.plant, closed.law, closed.loop
    x = closed.state(t)
    k = int(np.argmin(np.abs(closed.t - t)))
    if loop.quantum is not None:
        raise SpecificationError(
            f"The measurement of {', '.join(closed.conditions.sensors.quantisation)} is quantised.",
            "Rounding has no linearisation.",
            do="Close the loop without quantisation.",
            quantisation=closed.conditions.sensors.quantisation,
        )
    u, y = closed.inputs[:, k], closed.measurements[:, k]
    first = plant.at_u - len(plant.parameters)
    now = replace(plant, parameters=closed.p[first : plant.at_u, k])  # of which some are disturbed
    system = _late(_linear_plant(now, t, x, u, law.rate, disturbable_of(closed), "plant"), plant, loop.delay)
    return connected(system, _linear_law(law, t, y, closed.controller_states[:, k], "law"), closed, name)


def _late(system, plant, delay):
    """A sampled plant behind a delay of its inputs in samples: past commands are further states."""
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
        A,
        B,
        C,
        D,
        dt=system.dt,
        name="plant",
        states=[*system.state_labels, *names],
        inputs=system.input_labels,
        outputs=system.output_labels,
    )


def _linear_model(model, t, x, name):
    import control

    n, n_x, p = model.n, len(model.state_names), model.p
    ode = model.function("ode")
    A = jacobian(ode, "x", t, x, p)[:n_x]
    z, to_jets = np.append(x, ode(t, x, p)[n_x - n : n_x]), np.vstack([np.eye(n_x), A[-n:]])
    require_outputs(model.reduction)
    groups = [model.signals("reaction" if model.reduction.ideal else "actuation"), model.signals("outputs")]
    C = [np.eye(n_x), *(jacobian(f, "x", t, z, p) @ to_jets for group, f in groups if group)]
    names = [*model.state_names, *(name for group, _ in groups for name in group)]
    C = np.vstack(C)
    return control.ss(
        A, np.zeros((n_x, 0)), C, np.zeros((len(C), 0)), name=name, states=model.state_names, outputs=names, inputs=[]
    )
