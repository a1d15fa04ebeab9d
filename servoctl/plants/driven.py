"""A plant under inputs that are functions of time: a mechanism without a program."""

import casadi as ca

from servoctl.checks import by_name, column
from servoctl.errors import SpecificationError
from servoctl.jets.overflow import settled
from servoctl.model.model import derive
from servoctl.plants.plant import made_again
from servoctl.spec.mechanism import require_no_switch
from servoctl.spec.paths import Path, polynomials
from servoctl.spec.paths.limited import within_limits
from servoctl.spec.program import no_program
from servoctl.spec.references import followed_path, is_path

CLOCK = "time"  # the reference that is the time


def driven(plant, inputs=None, residuals=None):
    """The model of a plant under given inputs, within its limits of magnitude.

    A plant with lag, transport delay or limits of rate is refused. Inputs by actuator, 0 by default, are numbers,
    paths, smooth expressions of `q.t` and of references, or functions of `q.t` that return these; `residuals` are those
    of a program that the inputs realise approximately, which runs report. Free initial values are all states that the
    material constraints leave; outputs include the inputs.
    """
    for what, value in (("lag", plant.lag), ("delay", plant.delay), ("rate_limits", plant.rate_limits)):
        if value:
            raise SpecificationError(
                f"The plant has {what}={value}.",
                "simulate lets inputs act at once.",
                do="Use sv.close, which has actuators with lag, delay and limits of rate, or make the plant without.",
                name=what,
                value=value,
            )
    mechanism, values = plant.mechanism, by_name(inputs, plant.inputs, "actuator", "The inputs")
    q, expressions = _expressions(mechanism, dict.fromkeys(plant.inputs, 0.0) | values, plant.limits)
    count = len(mechanism.parameters.names)
    damping = ca.SX(list(plant.parameters[count : count + plant.equations.damping.numel()]))
    further = plant.equations.forces + ca.substitute(plant.equations.resisting, plant.equations.damping, damping)
    model = derive(mechanism.under(expressions, further, residuals, q), no_program(jumps=True))
    model = model.with_references(**{name: path for name, path in plant.paths.items() if name in model.paths})
    return model.with_parameters(**dict(zip(mechanism.parameters.names, plant.parameters[:count], strict=True)))


def _expressions(mechanism, values, limits):
    """The coordinates with the paths of inputs as references, and the inputs within their limits as expressions.

    A reference has the name of its input where this is free. A formula within limits is one of a reference that is the
    time, so that motions find its kinks as any other ones.
    """
    q, taken = mechanism.q, (*mechanism.q.family.names, *mechanism.parameters.names)
    paths = {name: followed_path(name, value) for name, value in values.items() if is_path(value)}
    cut = {name: sides for name, sides in limits.items() if not isinstance(paths.get(name), Path)}
    paths |= {n: within_limits(paths[n].held(), *sides) for n, sides in limits.items() if n in paths and n not in cut}
    names, clock = {n: n + "_path" * (n in taken) for n in paths}, CLOCK + "_path" * (CLOCK in (*taken, *values))
    time = {clock: polynomials([0.0, 1.0], [[1.0], [0.0]], before="continue", after="continue")} if cut else {}
    q, r = q.beside(**{names[name]: path for name, path in paths.items()}, **time)
    inputs = {name: r[names[name]] if name in paths else _expression(name, values[name], q) for name in values}
    for name, (low, high) in cut.items():
        inputs[name] = ca.fmin(ca.fmax(ca.substitute(inputs[name], q.t, r[clock]), low), high)
    return q, inputs


def _expression(name, value, q):
    """An input as an expression."""
    try:
        value = value(q.t) if callable(value) else value
    except Exception as error:  # the function's own
        raise SpecificationError(
            f"The input {name!r} is a function that takes no symbol ({type(error).__name__}).",
            "A function of an input is evaluated once, at q.t: by arithmetic and CasADi's functions.",
            do="Pass a path, as sv.paths.spline(times, points) through samples, or use CasADi's functions.",
            name=name,
        ) from error
    value = settled(column(value, what := f"the input {name!r}", 1))[0]
    require_no_switch(value, q, what)
    return value


def at_once(plant):
    """The plant with actuators that act at once, without limits."""
    return made_again(plant, plant.mechanism)
