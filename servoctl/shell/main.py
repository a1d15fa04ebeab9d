"""The command line: its parser, and the commands without a motion, `servoctl list` and `servoctl report`."""

import argparse
import os
import sys
from pathlib import Path

import servoctl as sv
from servoctl.errors import NotRealisable, ServoError
from servoctl.shell import cache, export, run, sweep, tradeoff
from servoctl.shell.folder import Report, complain
from servoctl.shell.scenes import find_scene


def main(argv=None):
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; default: those of the process.

    Returns
    -------
    int
        0 done; 1 the motion stopped early, its verification failed, or files were written to another folder; 2 an
        error, explained on stderr; 3 the verification is inconclusive; 130 interrupted.
    """
    args = _parser().parse_args(argv)
    args.command_line = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a run must not fail because a terminal has no Greek letters
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
    parser.add_argument(
        "--version", action="version", version=f"servoctl {sv.__version__}", help="print the version and exit"
    )
    commands = parser.add_subparsers(required=True, metavar="command")
    listing = commands.add_parser("list", help="the gallery's scenes")
    listing.set_defaults(command=_list)
    report = commands.add_parser("report", help="the derivation of a model, its structure, its verdict; no simulation")
    report.add_argument("scene", metavar="NAME_OR_FILE", help="a gallery name, a .py file, or the folder of a run")
    report.set_defaults(command=_report)
    for add in (run.add_run, tradeoff.add_tradeoff, sweep.add_sweep, export.add_export, cache.add_cache):
        add(commands)
    return parser


def _list(args):
    from servoctl.gallery import gallery

    width = max(map(len, gallery))
    for name, scene in gallery.items():
        print(f"{name:{width}}  {scene.description}")
    return 0


def _report(args):
    from servoctl.gallery import gallery

    if args.scene not in gallery and os.path.isdir(args.scene):
        print(_earlier_report(Path(args.scene)), end="")
        return 0
    report = Report()
    _, scene = find_scene(args.scene)
    mechanism, program = scene.build()
    report.say(mechanism)
    try:
        model = sv.derive(mechanism, program)
    except NotRealisable:
        report.say(sv.report(mechanism, program))
        return 0
    report.say(model)
    report.say(model.structure())
    report.say(sv.report(model, _start_of(model, scene)))
    return 0


def _start_of(model, scene):
    """The scene's start; None if there is none, which the report then says."""
    try:
        return model.start(t=scene.t_span[0], guess=scene.guess, **scene.start)
    except ServoError:
        return None


def _earlier_report(folder):
    try:
        return (folder / "report.txt").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ServoError(
            f"{folder} has no report.txt that can be read: {getattr(error, 'strerror', None) or error}.",
            "Each folder that servoctl run writes, by default servoctl-runs/NAME, has one.",
            do="Give such a folder, a gallery name, or a .py file that defines scene().",
            folder=str(folder),
        ) from error
