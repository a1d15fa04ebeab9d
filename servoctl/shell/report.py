"""`servoctl report`: what the derivation of a scene says, without a simulation."""

import os
from pathlib import Path

import servoctl as sv
from servoctl.errors import NotRealisable, ServoError
from servoctl.gallery import gallery
from servoctl.model.model import including
from servoctl.shell.options import VERBOSE
from servoctl.shell.printing import Report
from servoctl.shell.scenes import find_scene


def add_report(report):
    """Add the arguments of the command."""
    report.add_argument("scene", metavar="NAME_OR_FILE", help="a gallery name, a .py file, or the folder of a run")
    report.add_argument("--verbose", **VERBOSE)
    report.set_defaults(command=_report)


def _report(args):
    if args.scene not in gallery and os.path.isdir(args.scene):
        print(_earlier_report(Path(args.scene)), end="")
        return 0
    report = Report(args.verbose)
    _, scene = find_scene(args.scene)
    mechanism, program = scene.build()
    report.say(mechanism)
    try:
        model = including(sv.derive(mechanism, program), [*scene.start, *scene.guess])
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
