"""The closed loop of `servoctl run`: the plan under feedback, on a machine with other parameters."""

import math

import servoctl as sv
from servoctl.checks import named, without_effect
from servoctl.errors import ServoError
from servoctl.figures.style import write_png
from servoctl.shell.options import MANY, assignment, by_name, deviation, limits, positive, used, whole
from servoctl.verification.remarks import SAMPLES, least_rate

LAWS = ("lqr", "computed", "feedforward")
GIVEN = ("machine", "law", "integral", "rate", "delay", "noise", "seed", "limit")
RATE = 100.0  # Hz


def add_loop(parser):
    """Add the options of the closed loop to a command."""
    loop = parser.add_argument_group("the closed loop, of programs realised by actuators")
    machine = "parameters of the machine that differ from those of the plan"
    loop.add_argument("--machine", type=assignment, metavar="NAME=VALUE", **MANY, help=machine)
    loop.add_argument("--law", choices=LAWS, help="default: lqr, about the plan")
    loop.add_argument("--integral", action="store_true", help="LQR: add integrals of the residuals")
    loop.add_argument(
        "--rate", type=positive, metavar="HZ", help=f"samples per second; default {RATE:g}, or what the plan needs"
    )
    loop.add_argument("--delay", type=whole, metavar="N", help="samples from the measurement to the input")
    loop.add_argument("--noise", type=deviation, metavar="NAME=STD", **MANY, help="noise of measured states")
    loop.add_argument("--seed", type=whole, help="seed of the noise")
    loop.add_argument("--limit", type=limits, metavar="NAME=LOW:HIGH", **MANY, help="limits of actuators; or NAME=SIZE")
    loop.add_argument("--no-loop", action="store_true", help="leave out the closed loop")


def require(args, model):
    """Refuse options of the loop that have no effect, and names that the mechanism does not have."""
    if args.no_loop:
        without_effect(used(args, GIVEN), "with --no-loop")
    if args.law not in (None, "lqr"):
        without_effect(used(args, ("integral",)), f"with --law {args.law}")
    if args.law == "feedforward":
        without_effect(used(args, ("noise",)), "with --law feedforward, which measures nothing")
    if not args.noise:
        without_effect(used(args, ("seed",)), "with no --noise")
    mechanism = model.reduction.mechanism
    valid = {
        "machine": (mechanism.parameters.names, "parameter"),
        "noise": (model.state_names[: model.nq + model.n], "state of the mechanism"),
        "limit": (mechanism.actuators, "actuator"),
    }
    for option, (names, what) in valid.items():
        for name in by_name(getattr(args, option), f"--{option}"):
            named(name, names, what)


def closed_loop(args, model, plan, report):
    """Close the loop about the plan and print it: the Closed or None, and whether all that was requested is done."""
    if args.no_loop:
        return None, True
    requested = bool(used(args, GIVEN))
    if model.reduction.ideal or not plan.success:
        why = "a law commands actuators, not an ideal reaction" if model.reduction.ideal else "the motion ended early"
        report.say(f"Closed loop: left out, as {why}.")
        return None, not requested
    try:
        run = _closed(args, model, plan, report)
    except ServoError as error:
        report.say(f"Closed loop: {type(error).__name__}: {error}")
        return error.run if error.run is not None and len(error.run.t) else None, not requested
    report.say(run)
    if run.law.allocation:
        report.say(sv.limit_report(run))
    return run, run.success or not requested


def _closed(args, model, plan, report):
    mechanism = model.reduction.mechanism
    parameters = dict(zip(mechanism.parameters.names, model.parameters.tolist(), strict=True))
    limits, noise = by_name(args.limit, "--limit"), by_name(args.noise, "--noise")
    nominal = sv.plant(mechanism, limits=limits, **parameters)
    machine = sv.plant(mechanism, limits=limits, **parameters | by_name(args.machine, "--machine"))
    rate = max(RATE, least_rate(plan, nominal)) if args.rate is None else args.rate
    if args.rate is None and rate > RATE:
        report.say(
            f"The loop runs at {rate:g} Hz, not {RATE:g}: {SAMPLES} samples in the fastest time constant of the plan"
        )
    law = _law(args, plan, nominal, rate)
    start, samples = float(plan.t[0]), math.floor((plan.t[-1] - plan.t[0]) * law.rate * (1 + 1e-12) + 1e-9)
    span = (start, start + samples / law.rate)
    sensors, timing = sv.Sensors(noise=noise, seed=args.seed), sv.Timing(delay=args.delay or 0)
    return sv.close(machine, law, plan.state(start), span, sensors=sensors, timing=timing)


def _law(args, plan, nominal, rate):
    if args.law == "feedforward":
        return sv.feedforward(plan, nominal, rate)
    if args.law == "computed":
        law = sv.computed(plan, nominal, rate, delay=args.delay or 0)
    else:
        law = sv.lqr(plan, nominal, rate, integral=args.integral or None)
    return sv.limited(law, nominal) if nominal.limits else law


def facts(closed):
    """Errors and inputs of a closed loop as values for JSON."""
    if closed is None:
        return None
    names = closed.plant.mechanism.parameters.names
    errors = {name: values[0] for name, values in closed.residual.items()}
    return {
        "law": closed.law.name,
        "rate": closed.law.rate,
        "machine": dict(zip(names, closed.plant.parameters.tolist(), strict=False)),
        "delay": closed.loop.delay,
        "noise": closed.conditions.sensors.noise,
        "success": closed.success,
        "message": closed.message,
        "t_end": float(closed.t[-1]),
        "as F minus F along the plan": list(closed.by_F),
        "residuals": {n: {"worst": float(abs(e).max()), "end": float(abs(e[-1]))} for n, e in errors.items()},
        "inputs": {
            name: {
                "min": float(values.min()),
                "max": float(values.max()),
                "at a limit": float((closed.signal.get(f"limit {name}", closed.active[name]) != 0).mean()),
            }
            for name, values in closed.input.items()
        },
    }


def save_figure(closed, folder, title):
    """Write closed_loop.png."""
    figure = sv.figures.closed(closed)[0].figure
    figure.suptitle(f"{title}: closed loop, {closed.law.name}, {closed.law.rate:g} Hz")
    write_png(figure, folder / "closed_loop.png")
