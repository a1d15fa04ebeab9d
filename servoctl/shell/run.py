"""`servoctl run`: derive, simulate, verify, close the loop; write figures and numbers to a folder."""

import warnings
from dataclasses import replace

import numpy as np

import servoctl as sv
from servoctl.errors import IntegrationStopped, ServoError, SingularProgram
from servoctl.figures.animation import shows_mechanism
from servoctl.figures.sheet import draw_sheet
from servoctl.figures.style import write_png
from servoctl.inversion.verdict import GROWS, MARGINAL, chosen_by, verdict, verdict_with
from servoctl.methods.bounded import Problem
from servoctl.methods.choice import ORDERS, Bounded, as_drift, as_method, default_method
from servoctl.model.following import corners_of
from servoctl.model.jets import with_highest
from servoctl.progress import stage
from servoctl.shell import loop
from servoctl.shell.folder import ANIMATION, FIGURES, folder_of, jsonable, summary
from servoctl.shell.motion import described
from servoctl.shell.options import METHODS_HELP, VERBOSE, add_motion, drift, samples, used
from servoctl.shell.page import NAME as PAGE
from servoctl.shell.page import write_page
from servoctl.shell.printing import Report, complain
from servoctl.shell.scenes import find_scene
from servoctl.verification.remarks import of_loop

SETTINGS = ("method", "drift", "accuracy", "step", "rtol", "atol")  # options that decide how a motion is computed
INCONCLUSIVE = 3  # exit code where nothing failed and something could not be verified


def add_run(run):
    """Add the arguments of the command."""
    add_motion(run)
    run.add_argument("--out", metavar="DIR", help="folder; files of an earlier run are replaced")
    run.add_argument("--accuracy", type=float, metavar="E", help="largest error of the motion; sets method and steps")
    run.add_argument("--method", help=METHODS_HELP)
    run.add_argument("--step", type=float, metavar="H", help=f"step of {', '.join(ORDERS)} and RadauIIA [s]")
    run.add_argument("--drift", type=drift, metavar="D", help="none, project, or a time constant [s]")
    run.add_argument("--rtol", type=float, help="relative tolerance")
    run.add_argument("--atol", type=float, help="absolute tolerance")
    run.add_argument("--samples", type=samples, metavar="N", help="equally spaced samples of the run")
    run.add_argument("--no-verify", action="store_true", help="leave out the check against the full mechanism")
    figures = run.add_mutually_exclusive_group()
    figures.add_argument("--no-figures", action="store_true", help="leave out the figures")
    figures.add_argument("--all-figures", action="store_true", help=f"write {', '.join(FIGURES)}, too")
    run.add_argument("--verbose", **VERBOSE)
    run.add_argument("--animate", action="store_true", help=f"write the motion to a file, too: {ANIMATION}")
    loop.add_loop(run)
    run.set_defaults(command=_run)


def _run(args):
    name, scene = find_scene(args.scene)
    with folder_of(args, name) as folder:
        return _compute(args, name, scene, folder)


def _compute(args, name, scene, folder):
    """Derive, simulate, save, verify, close the loop and draw, in this order; returns the exit code."""
    report = Report(args.verbose)
    as_drift(args.drift)  # refuse unknown names before anything is derived
    if args.method is not None:
        as_method(args.method)
    motion = described(args, scene, report, require=lambda model: loop.require(args, model))
    motion, run, ended = _planned(args, motion, report)
    for said in filter(None, (run, ended)):
        report.say(said)
    found = verdict(motion.model, run if run.model is motion.model else motion.start)
    report.say(f"Verdict: {found}")
    folder.write(lambda path: run.save(path / "run.npz"))
    verification = None if args.no_verify else _verify(run, report)
    closed, done = loop.closed_loop(args, motion.model, run, report)
    of_closed = () if closed is None else of_loop(closed)
    for said in of_closed[:1]:
        report.say(f"Loop: {said}")
    if closed is not None:
        folder.write(lambda path: closed.save(path / "closed_loop.npz"))
    about = {"name": name, "given": args.scene, "description": scene.description}
    facts = {"scene": about, "command": args.command_line, "t_span": motion.span}
    facts |= {"verdict": found.word, "verdict_facts": found.as_dict(), **summary(run, motion.start, verification)}
    facts |= {"closed_loop": loop.facts(closed), "remarks": [*getattr(verification, "remarks", ()), *of_closed]}
    folder.write_json("summary.json", facts)
    folder.write_text("report.txt", report.text)
    motion = _pictures_of(args, folder, name, run, closed)
    folder.write(lambda path: write_page(path, jsonable(facts), run.units, verification, report.text, motion))
    if not run.success:
        complain(f"The motion ended early, at t = {run.t[-1]:.6g} s; what was computed is kept.")
    unstable = run.internal.get("verdict") == "unstable"
    if unstable:
        complain(f"The plan is not to be trusted: {run.internal['text']}.")
    verified = "passed" if args.no_verify else getattr(verification, "verdict", "failed")
    print(f"open {folder.path / PAGE}")
    if unstable or not (run.success and verified != "failed" and done and not folder.moved):
        return 1
    return INCONCLUSIVE if verified == "inconclusive" else 0


@stage("drawing")
def _pictures_of(args, folder, name, run, closed):
    """Write the figures, and the GIF if it is wanted; returns the motion as HTML: in the loop if there is one."""
    moving = run if closed is None else closed
    shown, drawn = shows_mechanism(moving), not args.no_figures
    if drawn:
        folder.write(lambda path: write_png(draw_sheet(run, closed, name), path / "sheet.png"))
    if args.all_figures:
        folder.write(lambda path: sv.figures.save_figures(run, path, title=name))
        if closed is not None:
            folder.write(lambda path: loop.save_figure(closed, path, name))
    if args.animate and not shown:
        complain("There is no animation: the mechanism has no shapes=, and no outputs or coordinates like X and Z.")
    if drawn and shown:
        what = f"{name}: motion" + (", in the closed loop" if closed is not None else "")
        axes = sv.figures.stroboscope(moving, title=what)
        folder.write(lambda path: write_png(axes.figure, path / "motion.png"))
    if args.animate and shown:
        folder.write(lambda path: sv.figures.animate(moving).save(path / ANIMATION))
    return sv.figures.animate(moving).html() if drawn and shown else ""


def _planned(args, motion, report):
    """The motion, its run, the one that `sv.inverse` would choose unless settings are given, and why it ended early."""
    options, model, start, (t0, t1) = _options(args, motion.model, motion.span), motion.model, motion.start, motion.span
    found = None if used(args, SETTINGS) or t1 < t0 else verdict(model, start)
    method = found and chosen_by(model, found)
    forward = None if method else _simulate(motion, options)
    try:
        if isinstance(method, Bounded):
            instants = t0, t1, *corners_of(model)  # the whole path, and the rest on either side of it
            span = motion.span if args.t_span else (min(instants), max(instants))
            window = Problem(model, span, start.values).window(method.window) if args.samples else span
            whole = replace(motion, span=span)
            return whole, *_simulate(whole, _options(args, model, window) | {"method": method})
    except ServoError as error:
        report.say(f"There is no {method} motion: {error}")
        if not isinstance(error, (IntegrationStopped, SingularProgram)):
            return motion, *_simulate(motion, options)
    try:
        after = verdict_with(model, found, forward[0]) if found and forward else found
        if method or after and after.dynamics == GROWS and not model.reduction.ideal:
            from servoctl.inversion.choice import Request  # its import takes as long as a short motion

            request = Request(model.reduction.mechanism, model.reduction.program, motion.span, start, ({}, {}), None)
            run = request.relaxed(after, start, moving=not method and found.dynamics != MARGINAL)
            if args.samples:
                run = run.sampled(options["t_eval"])
                run = replace(run, jets=with_highest(run.model, run.t, run.jets[: len(run.model.state_names)]))
            return motion, run, ""
    except ServoError as error:
        report.say(f"There is no relaxed motion: {error}")
    return motion, *(forward or _simulate(motion, options))


def _options(args, model, span):
    """Arguments of `simulate` from the command line, with samples of the span."""
    options = {} if args.accuracy is None else {"accuracy": args.accuracy}
    options |= {} if args.drift in (None, "none") else {"drift": args.drift}
    settings = {name: getattr(args, name) for name in ("step", "rtol", "atol") if getattr(args, name) is not None}
    if args.method or settings:
        options["method"] = as_method(args.method or default_method(model), **settings)
    if args.samples:
        options["t_eval"] = np.linspace(*span, args.samples)
    return options


def _simulate(motion, options):
    """The run, or the part of it before the motion stopped, and why it did."""
    try:
        with warnings.catch_warnings():  # the report and the exit code say this
            warnings.filterwarnings("ignore", "Internal dynamics unstable|.* a first transient")
            return sv.simulate(motion.model, motion.start, motion.span, **options), ""
    except ServoError as error:
        if error.run is None:
            raise
        return error.run, f"{type(error).__name__}: {error}"


def _verify(run, report):
    """The verification, or None."""
    if not run.success:
        report.say("Verification: left out, as the motion ended early.")
        return None
    try:
        verification = sv.verify(run)
    except (ServoError, KeyboardInterrupt) as error:
        report.say(f"Verification: {str(error) or 'interrupted'}")
        return None
    report.say(verification)
    return verification
