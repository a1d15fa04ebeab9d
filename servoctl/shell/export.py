"""`servoctl export-c`: the feedforward and the residuals of a scene in C."""

import servoctl as sv
from servoctl.export.files import identifier
from servoctl.shell.motion import with_parameters
from servoctl.shell.options import MANY, SCENE_HELP, assignment, by_name
from servoctl.shell.scenes import find_scene, model_of


def add_export(export):
    """Add the arguments of the command."""
    export.add_argument("scene", metavar="NAME_OR_FILE", help=SCENE_HELP)
    export.add_argument("--out", metavar="DIR", required=True, help="folder for the two files")
    export.add_argument("--name", help="prefix of the files and of all functions; default: the scene's name")
    export.add_argument("--set", type=assignment, metavar="NAME=VALUE", **MANY, help="parameters")
    export.set_defaults(command=_export)


def _export(args):
    name, scene = find_scene(args.scene)
    model = with_parameters(model_of(scene), by_name(args.set, "--set"))
    start = model.start(t=scene.t_span[0], guess=scene.guess, **scene.start)
    files = sv.export_c(model, args.out, name=args.name or identifier(name), start=start)
    print(f"{', '.join(file.name for file in files)} in {args.out}")
    return 0
