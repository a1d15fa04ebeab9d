"""`servoctl tradeoff`: measure errors and costs of methods and treatments of drift on a scene, and recommend one."""

import servoctl as sv
from servoctl.figures.style import write_png
from servoctl.shell.folder import folder_of
from servoctl.shell.motion import described
from servoctl.shell.options import add_motion, drift, positive
from servoctl.shell.printing import Report
from servoctl.shell.scenes import find_scene

FILES = ("tradeoff.npz", "tradeoff.csv", "tradeoff.png", "report.txt", "summary.json")


def add_tradeoff(trade):
    """Add the arguments of the command."""
    add_motion(trade)
    trade.add_argument("--out", metavar="DIR", help="folder; default servoctl-runs/NAME-tradeoff")
    trade.add_argument("--method", nargs="+", metavar="M", help="methods to measure; default: all")
    trade.add_argument("--drift", type=drift, nargs="+", metavar="D", help="none, project, time constants [s]")
    trade.add_argument("--budget", type=positive, metavar="S", help="CPU time of all rows [s]; default 30")
    wanted = trade.add_mutually_exclusive_group()
    wanted.add_argument("--error", type=positive, metavar="E", help="recommend the fastest within this error")
    wanted.add_argument("--seconds", type=positive, metavar="S", help="recommend the most accurate within this time")
    trade.set_defaults(command=_tradeoff)


def _tradeoff(args):
    """Derive, measure, save, draw and recommend; returns the exit code."""
    name, scene = find_scene(args.scene)
    with folder_of(args, name, "-tradeoff") as folder:
        return _measured(args, name, scene, folder)


def _measured(args, name, scene, folder):
    report = Report()
    motion = described(args, scene, report)
    budget = {} if args.budget is None else {"budget": args.budget}
    study = sv.tradeoff(motion.model, motion.start, motion.span, methods=args.method, drift=args.drift, **budget)
    report.say(study)
    folder.write(lambda path: study.save(path / "tradeoff.npz"))
    folder.write(lambda path: study.csv(path / "tradeoff.csv"))
    figure = study.plot(title=name).figure
    folder.write(lambda path: write_png(figure, path / "tradeoff.png"))
    try:
        best = _recommended(study, args, report)
    finally:  # also where no setting is good enough
        folder.write_text("report.txt", report.text)
    facts = {"scene": {"name": name, "given": args.scene}, "command": args.command_line, **study.meta}
    folder.write_json("summary.json", facts | {"recommended": best, "pareto": study.pareto().rows()})
    print(f"{', '.join(FILES)} in {folder.path}")
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
