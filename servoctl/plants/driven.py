"""A plant under inputs that are functions of time: a mechanism without a program."""

import casadi as ca

from servoctl.checks import by_name, column
from servoctl.errors import SpecificationError
from servoctl.jets.overflow import settled
from servoctl.model.model import derive
from servoctl.plants.plant import made_again
from servoctl.spec.program import no_program


def driven(plant, inputs=None, residuals=None):
    """The model of a plant under given inputs, within its limits of magnitude.

    A plant with lag, transport delay or limits of rate is refused. Inputs by actuator, 0 by default, are numbers,
    expressions of `q.t` or of references, or functions that give them of `q.t`; `residuals` are those of a program that
    the inputs realise approximately, which runs report. Free initial values are all states that the material
    constraints leave; outputs include the inputs.
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
    mechanism, t = plant.mechanism, plant.mechanism.q.t
    values = by_name(inputs, plant.inputs, "actuator", "The inputs")
    expressions = {name: _expression(name, values.get(name, 0.0), t) for name in plant.inputs}
    for name, (low, high) in plant.limits.items():
        expressions[name] = ca.fmin(ca.fmax(expressions[name], low), high)
    count = len(mechanism.parameters.names)
    damping = ca.SX(list(plant.parameters[count : count + plant.equations.damping.numel()]))
    further = plant.equations.forces + ca.substitute(plant.equations.resisting, plant.equations.damping, damping)
    model = derive(mechanism.under(expressions, further, residuals), no_program())
    model = model.with_references(**{name: path for name, path in plant.paths.items() if name in model.paths})
    return model.with_parameters(**dict(zip(mechanism.parameters.names, plant.parameters[:count], strict=True)))


def _expression(name, value, t):
    """An input as an expression."""
    try:
        value = value(t) if callable(value) else value
    except Exception as error:  # the function's own
        raise SpecificationError(
            f"The input {name!r} is a function that takes no symbol ({type(error).__name__}).",
            "A function of an input is evaluated once, at q.t: by arithmetic and CasADi's functions.",
            do="Use CasADi's functions; samples are q.references(u=sv.paths.spline(times, points)).u, a reference.",
            name=name,
        ) from error
    return settled(column(value, f"the input {name!r}", 1))[0]


def at_once(plant):
    """The plant with actuators that act at once, without limits."""
    return made_again(plant, plant.mechanism)
