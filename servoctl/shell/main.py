"""The command line: `servoctl list`, `run`, `report`, `tradeoff`, and those in commands.py."""

import argparse
import json
import sys
from pathlib import Path

from servoctl.checks import as_span
from servoctl.errors import ServoError, SpecificationError, unknown
from servoctl.methods.choice import as_method, default_method
from servoctl.methods.drift import as_drift
from servoctl.methods.tableaus import ORDERS
from servoctl.shell import commands as further
from servoctl.shell import loop as cli_loop
from servoctl.shell.folder import FILES, LOOP_FILES, Folder, Report, complain, plain, summary, versions
from servoctl.shell.options import METHODS_HELP, assignment, mapping, positive


def main(argv=None):
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; default: those of the process.

    Returns
    -------
    int
        0 done; 1 the motion stopped early, its verification failed, or files went to another folder than asked; 2 an
        error, explained on stderr; 130 interrupted.
    """
    args = _parser().parse_args(argv)
    args.command_line = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters is no reason to lose a run
    try:
        return args.command(args)
    except ServoError as error:
        complain(f"{type(error).__name__}: {error}", *getattr(error, "__notes__", ()))
        return 2
    except KeyboardInterrupt:
        complain("Interrupted; files that were already written are kept.")
        return 130


def _parser():
    parser = argparse.ArgumentParser(
        prog="servoctl",
        description="Inverse dynamics and motions of mechanisms under program constraints of any order.",
        epilog="Examples: servoctl run overhead-crane;  servoctl run overhead-crane --set m_load=115;  "
        "servoctl report my_scene.py, a file that defines scene() -> (Mechanism, Program).",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(required=True, metavar="command")
    listing = commands.add_parser("list", help="the gallery's scenes")
    listing.set_defaults(command=_list)
    report = commands.add_parser("report", help="what is done to a specification, and its structure; no simulation")
    report.add_argument("scene", metavar="NAME_OR_FILE", help="a gallery name, a .py file, or the folder of a run")
    report.set_defaults(command=_report)
    run = commands.add_parser("run", help="derive, simulate, verify; leave figures and numbers in a folder")
    run.add_argument("scene", metavar="NAME_OR_FILE", help="a gallery name, or a .py file that defines scene()")
    run.set_defaults(command=_run)
    _run_options(run)
    trade = commands.add_parser("tradeoff", help="measure what each method and treatment of drift costs and reaches")
    trade.add_argument("scene", metavar="NAME_OR_FILE", help="a gallery name, or a .py file that defines scene()")
    trade.set_defaults(command=_tradeoff)
    _tradeoff_options(trade)
    further.add(commands)
    return parser


def _run_options(run):
    pairs = {"type": assignment, "nargs": "+", "action": "extend", "default": [], "metavar": "NAME=VALUE"}
    run.add_argument("--out", metavar="DIR", help="folder; files of an earlier run in it are replaced")
    run.add_argument("--t-span", type=float, nargs=2, metavar=("T0", "T1"), help="[s]; default: the scene's")
    run.add_argument("--hold", **pairs, help="values that the start keeps, beside the scene's own")
    run.add_argument("--guess", **pairs, help="where the rest of the start is looked for; frees what the scene holds")
    run.add_argument("--set", **pairs, help="parameters")
    run.add_argument("--accuracy", type=float, metavar="E", help="error of the motion, in place of method and settings")
    run.add_argument("--method", help=METHODS_HELP)
    run.add_argument("--step", type=float, metavar="H", help=f"step of {', '.join(ORDERS)} and RadauIIA [s]")
    run.add_argument("--drift", type=_drift, metavar="D", help="none, project, minimal, or a time constant [s]")
    run.add_argument("--rtol", type=float, help="relative tolerance")
    run.add_argument("--atol", type=float, help="absolute tolerance")
    run.add_argument("--samples", type=_samples, metavar="N", help="equally spaced samples of the run")
    run.add_argument("--no-verify", action="store_true", help="leave out the check against the full mechanism")
    run.add_argument("--no-figures", action="store_true", help="leave out the figures")
    cli_loop.add(run)


def _tradeoff_options(trade):
    pairs = {"type": assignment, "nargs": "+", "action": "extend", "default": [], "metavar": "NAME=VALUE"}
    trade.add_argument("--out", metavar="DIR", help="folder; default servoctl-runs/NAME-tradeoff")
    trade.add_argument("--t-span", type=float, nargs=2, metavar=("T0", "T1"), help="[s]; default: the scene's")
    trade.add_argument("--hold", **pairs, help="values that the start keeps, beside the scene's own")
    trade.add_argument("--guess", **pairs, help="where the rest of the start is looked for")
    trade.add_argument("--set", **pairs, help="parameters")
    trade.add_argument("--method", nargs="+", metavar="METHOD", help="which are measured; default: most")
    trade.add_argument(
        "--drift", type=_drift, nargs="+", metavar="D", help="none, project, minimal, a time constant [s]"
    )
    trade.add_argument("--limit", type=positive, metavar="S", help="seconds that one run may take; default 0.3")
    wanted = trade.add_mutually_exclusive_group()
    wanted.add_argument("--error", type=positive, metavar="E", help="recommend the fastest within this error")
    wanted.add_argument("--seconds", type=positive, metavar="S", help="recommend the most accurate within this time")


class _Version(argparse.Action):
    def __call__(self, parser, *_):
        print(f"servoctl {versions()['servoctl']}")
        parser.exit()


def _drift(text):
    if text in ("none", "project", "minimal"):
        return None if text == "none" else text
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not none, project, minimal or a time constant [s]") from None


def _samples(text):
    if not (text.isdecimal() and int(text) >= 2):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 2")
    return int(text)


# --- commands


def _list(args):
    from servoctl.gallery import gallery

    width = max(map(len, gallery))
    for name, scene in gallery.items():
        print(f"{name:{width}}  {scene.description}")
    return 0


def _report(args):
    from servoctl.gallery import gallery
    from servoctl.shell.scenes import find_scene

    folder = Path(args.scene)
    if args.scene not in gallery and folder.is_dir():
        print(_earlier_report(folder), end="")
        return 0
    import servoctl as sv

    report = Report()
    _, scene = find_scene(args.scene)
    mechanism, program = scene.build()
    report.say(mechanism)
    model = sv.derive(mechanism, program)
    report.say(model)
    report.say(model.structure())
    return 0


def _earlier_report(folder):
    try:
        return (folder / "report.txt").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ServoError(
            f"{folder} has no report.txt that can be read: {getattr(error, 'strerror', None) or error}.",
            "The folder of a run holds the report that the run printed.",
            nearest="By default it is servoctl-runs/NAME.",
            do="Give the folder that servoctl run wrote, a gallery name, or a .py file that defines scene().",
            folder=str(folder),
        ) from error


def _run(args):
    from servoctl.shell.scenes import find_scene

    name, scene = find_scene(args.scene)
    folder = Folder(Path(args.out) if args.out else Path("servoctl-runs", name), name)
    try:
        return _compute(args, name, scene, folder)
    finally:
        folder.leave()


def _compute(args, name, scene, folder):
    """Derive, simulate, save, verify, close the loop and draw, in this order; returns the exit code."""
    import servoctl as sv

    report = Report()
    span = tuple(args.t_span or scene.t_span)
    changes, held, guess = (mapping(getattr(args, name), f"--{name}") for name in ("set", "hold", "guess"))
    _require_known(args, span)
    model = _with_parameters(sv.derive(*scene.build()), changes)
    cli_loop.require(args, model)
    report.say(model)
    start = _start(model, scene, span[0], held, guess)
    report.say(start)
    run = _simulate(model, start, span, _options(args, model, span), report)
    folder.write(lambda path: run.save(path / "run.npz"))
    verification = None if args.no_verify else _verify(model, run, report)
    closed, done = cli_loop.closed_loop(args, model, run, report)
    if closed is not None:
        folder.write(lambda path: closed.save(path / "closed_loop.npz"))
    about = {"name": name, "given": args.scene, "description": scene.description}
    facts = {"scene": about, "command": args.command_line, "t_span": span, **summary(run, start, verification)}
    facts |= {"closed_loop": cli_loop.facts(closed)}
    text = json.dumps(facts, indent=2, allow_nan=False, ensure_ascii=False)
    folder.write(lambda path: (path / "summary.json").write_text(text + "\n", encoding="utf-8"))
    folder.write(lambda path: (path / "report.txt").write_text("\n".join(report.texts), encoding="utf-8"))
    if not args.no_figures:
        from servoctl.figures import save_figures

        folder.write(lambda path: save_figures(run, path, units=scene.units, title=name))
        if closed is not None:
            folder.write(lambda path: cli_loop.save_figure(closed, path, scene.units, name))
    print(f"{', '.join(f for f in (*FILES, *LOOP_FILES) if (folder.path / f).exists())} in {folder.path}")
    if not run.success:
        complain(f"The motion ended early, at t = {run.t[-1]:.6g} s; what was computed is kept.")
    verified = args.no_verify or (verification is not None and verification.passed)
    return 0 if run.success and verified and done and not folder.moved else 1


def _require_known(args, span):
    """Refuse a span, a method or a treatment of drift that no model has."""
    as_span(span)
    as_drift(args.drift)
    if args.method is not None:
        as_method(args.method)


def _with_parameters(model, changes):
    valid = model.reduction.mechanism.parameters.names
    for name in changes:
        if name not in valid:
            raise unknown(name, valid, "parameter")
    return model.with_parameters(**changes) if changes else model


def _start(model, scene, t0, hold, guess):
    both = [name for name in guess if name in hold]
    if both:
        raise SpecificationError(
            f"{', '.join(both)} is both held and guessed.",
            "A value of the start is kept exactly, or is where the solution is looked for.",
            do="Give it to --hold or to --guess.",
        )
    held = {name: value for name, value in scene.start.items() if name not in guess} | hold
    for name in held:
        if name not in model.state_names:
            raise unknown(name, model.state_names, "state")
    return model.start(t=t0, guess={**scene.guess, **guess}, **held)


def _options(args, model, span):
    """Arguments of `simulate` that were given."""
    options = {name: getattr(args, name) for name in ("accuracy", "drift") if getattr(args, name) is not None}
    settings = {name: getattr(args, name) for name in ("step", "rtol", "atol") if getattr(args, name) is not None}
    if args.method or settings:
        options["method"] = as_method(args.method or default_method(model), **settings)
    if args.samples:
        options["t_eval"] = [span[0] + (span[1] - span[0]) * i / (args.samples - 1) for i in range(args.samples)]
        options["t_eval"][-1] = span[1]
    return options


def _simulate(model, start, span, options, report):
    """The run; where the motion stops, what was computed of it."""
    import servoctl as sv

    try:
        run = sv.simulate(model, start, span, **options)
        report.say(run)
        return run
    except ServoError as error:
        if error.run is None:
            raise
        report.say(error.run)
        report.say(f"{type(error).__name__}: {error}")
        return error.run


def _verify(model, run, report):
    """The verification; None where there is none to be had."""
    import servoctl as sv

    if not run.success:
        report.say("Verification: left out, as the motion ended early.")
        return None
    try:
        verification = sv.verify(model, run)
    except (ServoError, KeyboardInterrupt) as error:
        report.say(f"Verification: {str(error) or 'interrupted'}")
        return None
    report.say(verification)
    return verification


def _tradeoff(args):
    from servoctl.shell.scenes import find_scene

    name, scene = find_scene(args.scene)
    folder = Folder(Path(args.out) if args.out else Path("servoctl-runs", f"{name}-tradeoff"), name)
    try:
        return _measure(args, name, scene, folder)
    finally:
        folder.leave()


def _measure(args, name, scene, folder):
    """Derive, measure, save, draw, recommend, in this order; returns the exit code."""
    import servoctl as sv

    report = Report()
    span = tuple(args.t_span or scene.t_span)
    changes, held, guess = (mapping(getattr(args, name), f"--{name}") for name in ("set", "hold", "guess"))
    model = _with_parameters(sv.derive(*scene.build()), changes)
    report.say(model)
    start = _start(model, scene, span[0], held, guess)
    report.say(start)
    limit = {} if args.limit is None else {"seconds": args.limit}
    study = sv.tradeoff(model, start, span, methods=args.method, drift=args.drift, **limit)
    report.say(study)
    folder.write(lambda path: study.save(path / "tradeoff.npz"))
    folder.write(lambda path: study.csv(path / "tradeoff.csv"))
    figure = study.plot(title=name).figure
    folder.write(lambda path: figure.savefig(path / "tradeoff.png", dpi=100))
    try:
        best = _recommended(study, args, report)
    finally:  # what was measured is kept where nothing reaches what was asked
        folder.write(lambda path: (path / "report.txt").write_text("\n".join(report.texts), encoding="utf-8"))
    facts = {"scene": {"name": name, "given": args.scene}, "command": args.command_line, **study.meta}
    facts |= {"recommended": best, "pareto": study.pareto().rows()}
    text = json.dumps(plain(facts), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    folder.write(lambda path: (path / "summary.json").write_text(text, encoding="utf-8"))
    print(f"tradeoff.npz, tradeoff.csv, tradeoff.png, report.txt, summary.json in {folder.path}")
    return 1 if folder.moved or study.meta["message"] else 0


def _recommended(study, args, report):
    if args.error is None and args.seconds is None:
        return None
    best = study.recommend(error=args.error, seconds=args.seconds)
    options = ", ".join(f"{key}={value!r}" for key, value in best.items())
    error = max(best.row["error"], study.uncertainty)
    report.say(f"Recommended: {options}; error at most {error:.1e} in {best.row['seconds']:.2g} s")
    method = best["method"]
    settings = {name: value for name, value in vars(method).items() if name in ("step", "rtol", "atol") and value}
    return {**best, "method": str(method), **settings}
