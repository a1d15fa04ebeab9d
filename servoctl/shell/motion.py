"""The motion that a scene and options on the command line describe."""

from servoctl.checks import as_span, named
from servoctl.errors import SpecificationError
from servoctl.shell.options import by_name
from servoctl.shell.scenes import model_of
from servoctl.values import frozen


@frozen
class Scenario:
    """A model with its parameters, a start, and a time span (t0, t1) [s]."""

    model: object
    start: object
    span: tuple


def described(args, scene, report, require=lambda model: None):
    """Derive the model of a scene and solve for its start; print both.

    `require(model)` is called before anything is printed; it raises for options that do not fit.
    """
    span = as_span(tuple(args.t_span or scene.t_span))
    if args.t_span and span[1] < span[0]:
        given, forward = (f"--t-span {a:g} {b:g}" for a, b in (span, span[::-1]))
        raise SpecificationError(
            f"{given} runs backwards in time.",
            nearest=f"{forward}.",
            do="To run backwards, set T_SPAN in a scene's file.",
            t_span=span,
        )
    changes, held, guess = (by_name(getattr(args, name), f"--{name}") for name in ("set", "hold", "guess"))
    model = with_parameters(model_of(scene, [*held, *guess]), changes)
    require(model)
    report.say(model)
    start = _start(model, scene, span[0], held, guess)
    report.say(start)
    return Scenario(model, start, span)


def with_parameters(model, changes):
    """The model with other values of parameters."""
    return model.with_parameters(**changes) if changes else model


def _start(model, scene, t0, hold, guess):
    both = [name for name in guess if name in hold]
    if both:
        raise SpecificationError(
            f"{', '.join(both)} is both held and guessed.",
            "A value of the start is either held exactly, or a guess from which the solution starts.",
            do="Give it to --hold or to --guess.",
            names=both,
        )
    held = {name: value for name, value in scene.start.items() if name not in guess} | hold
    outputs = model.reduction.mechanism.outputs
    known = (*model.state_names, *outputs)
    for name in held:
        named(name, known, "state or output" if outputs else "state")
    return model.start(t=t0, guess={**scene.guess, **guess}, **held)
