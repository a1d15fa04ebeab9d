"""The closed loop of `servoctl run`: the plan under feedback, on a machine with other numbers."""

import argparse
import math

from servoctl.errors import ServoError, SpecificationError, unknown
from servoctl.shell.options import assignment, given, mapping, positive, whole

LAWS = ("lqr", "computed", "feedforward")
GIVEN = ("machine", "law", "integral", "rate", "delay", "noise", "seed", "limit")
RATE = 100.0  # Hz


def add(parser):
    """Add the options of the closed loop to a command.

    Parameters
    ----------
    parser : argparse.ArgumentParser
    """
    many = {"nargs": "+", "action": "extend", "default": []}
    loop = parser.add_argument_group("the closed loop, of programs realised by actuators")
    loop.add_argument(
        "--machine", type=assignment, metavar="NAME=VALUE", **many, help="parameters that the plan missed"
    )
    loop.add_argument("--law", choices=LAWS, help="default: lqr, about the plan")
    loop.add_argument("--integral", action="store_true", help="LQR: integrals of the residuals, too")
    loop.add_argument("--rate", type=positive, metavar="HZ", help=f"samples per second; default {RATE:g}")
    loop.add_argument("--delay", type=whole, metavar="N", help="samples from the measurement to the input")
    loop.add_argument("--noise", type=_deviation, metavar="NAME=STD", **many, help="of measured states")
    loop.add_argument("--seed", type=whole, help="of the noise")
    loop.add_argument("--limit", type=_limit, metavar="NAME=LOW:HIGH", **many, help="of actuators; or NAME=SIZE")
    loop.add_argument("--no-loop", action="store_true", help="leave out the closed loop")


def _deviation(text):
    """(name, standard deviation) of NAME=STD."""
    name, value = assignment(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text!r}: a standard deviation is not negative")
    return name, value


def _limit(text):
    """(name, limits) of NAME=SIZE or NAME=LOW:HIGH."""
    name, _, value = text.partition("=")
    try:
        low, high = (float(part) for part in value.split(":")) if ":" in value else (-float(value), float(value))
    except ValueError:
        low = high = math.nan
    if not name.strip() or not low < high:
        raise argparse.ArgumentTypeError(f"{text!r} is neither NAME=LOW:HIGH nor NAME=SIZE, such as trolley=150")
    return name.strip(), (low, high)


def require(args, model):
    """Refuse options of the loop that contradict each other, and names that the mechanism has not.

    Parameters
    ----------
    args : argparse.Namespace
    model : Model

    Raises
    ------
    SpecificationError, NameUnknown
    """
    options = given(args, GIVEN)
    clashes = {
        "--no-loop": options if args.no_loop else [],
        "--law " + (args.law or ""): ["--integral"] if args.integral and args.law not in (None, "lqr") else [],
        "--law feedforward, which measures nothing": ["--noise"] if args.noise and args.law == "feedforward" else [],
        "no --noise": ["--seed"] if args.seed is not None and not args.noise else [],
    }
    for kind, surplus in clashes.items():
        if surplus:
            raise SpecificationError(
                f"{', '.join(surplus)} was given with {kind}.",
                "Options of the closed loop are never ignored.",
                do="Leave one of them out.",
            )
    mechanism = model.reduction.mechanism
    valid = {
        "machine": (mechanism.parameters.names, "parameter"),
        "noise": (model.state_names[: model.nq + model.n], "state of the mechanism"),
        "limit": (mechanism.actuators, "actuator"),
    }
    for option, (names, what) in valid.items():
        for name in mapping(getattr(args, option), f"--{option}"):
            if name not in names:
                raise unknown(name, names, what)


def closed_loop(args, model, plan, report):
    """Close the loop about the plan, and say what came of it.

    Parameters
    ----------
    args : argparse.Namespace
    model : Model
    plan : Run
    report : Report

    Returns
    -------
    closed : Closed or None
        None where there is no loop.
    done : bool
        Whether what was asked for was done.
    """
    if args.no_loop:
        return None, True
    asked = bool(given(args, GIVEN))
    if model.ideal or not plan.success:
        why = "a law commands actuators, not an ideal reaction" if model.ideal else "the motion ended early"
        report.say(f"Closed loop: left out, as {why}.")
        return None, not asked
    try:
        run = _closed(args, model, plan)
    except ServoError as error:
        report.say(f"Closed loop: {type(error).__name__}: {error}")
        run = getattr(error, "run", None)
        return run if run is not None and len(run.t) else None, not asked
    report.say(run)
    if "slack of" in run.law.info:
        from servoctl.control.limits import limit_report

        report.say(limit_report(run))
    return run, True


def _closed(args, model, plan):
    from servoctl.control.close import close
    from servoctl.plants.plant import plant

    mechanism = model.reduction.mechanism
    believed = dict(zip(mechanism.parameters.names, model.parameters.tolist(), strict=True))
    limits, noise = mapping(args.limit, "--limit"), mapping(args.noise, "--noise")
    nominal = plant(mechanism, limits=limits, **believed)
    machine = plant(mechanism, limits=limits, **believed | mapping(args.machine, "--machine"))
    law = _law(args, plan, nominal)
    start, samples = float(plan.t[0]), math.floor((plan.t[-1] - plan.t[0]) * law.rate * (1 + 1e-12) + 1e-9)
    span = (start, start + samples / law.rate)
    return close(machine, law, plan.state(start), span, delay=args.delay or 0, noise=noise or None, seed=args.seed)


def _law(args, plan, nominal):
    from servoctl.control.computed import computed
    from servoctl.control.limits import limited
    from servoctl.control.lqr import lqr
    from servoctl.control.tracking import feedforward

    rate = RATE if args.rate is None else args.rate
    if args.law == "feedforward":
        return feedforward(plan, nominal, rate)
    if args.law == "computed":
        law = computed(plan, nominal, rate, delay=args.delay or 0)
    else:
        law = lqr(plan, nominal, rate, integral=args.integral or None)
    return limited(law, nominal) if nominal.limits else law


def facts(closed):
    """Numbers of a closed loop for the summary: worst and last errors, what each actuator did.

    Parameters
    ----------
    closed : Closed or None

    Returns
    -------
    dict or None
    """
    if closed is None:
        return None
    names = closed.plant.mechanism.parameters.names
    errors = {name: values[0] for name, values in closed.residual.items()}
    return {
        "law": closed.law.name,
        "rate": closed.law.rate,
        "machine": dict(zip(names, closed.plant.parameters.tolist(), strict=False)),
        "delay": closed.loop.delay,
        "noise": closed.conditions.noise,
        "success": closed.success,
        "message": closed.message,
        "t_end": float(closed.t[-1]),
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


def save_figure(closed, folder, units, title):
    """Write closed_loop.png.

    Parameters
    ----------
    closed : Closed
    folder : Path
    units : dict of str to str
    title : str
        Put over the figure.
    """
    from servoctl import figures

    figure = figures.closed(closed, units=units)[0].figure
    figure.suptitle(f"{title}: closed loop, {closed.law.name}, {closed.law.rate:g} Hz")
    figure.savefig(folder / "closed_loop.png", dpi=100)
