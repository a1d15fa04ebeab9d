"""Commands beside running a scene: `servoctl sweep` and `servoctl export-c`."""

import functools
import inspect
import json
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from servoctl.errors import ServoError, SpecificationError, unknown
from servoctl.shell.folder import Folder, Report, complain
from servoctl.shell.options import METHODS_HELP, assignment, count, draw, drawn, given, mapping, shard, variation, whole


def add(commands):
    """Add the commands to the subparsers of the command line.

    Parameters
    ----------
    commands : argparse subparsers
    """
    many = {"nargs": "+", "action": "extend", "default": []}
    sweep = commands.add_parser("sweep", help="many cases of a scene, on several processes or machines, in one table")
    sweep.add_argument(
        "scene",
        metavar="NAME_OR_FILE",
        nargs="?",
        help="a gallery name, or a .py file with scene() or case(**parameters)",
    )
    sweep.add_argument(
        "--vary", type=variation, metavar="NAME=LOW:HIGH:N", **many, help="all combinations of such values"
    )
    sweep.add_argument("--monte-carlo", type=count, metavar="N", help="N random cases, of each combination")
    sweep.add_argument("--draw", type=draw, metavar="NAME=normal:MEAN:STD", **many, help="what is random in them")
    sweep.add_argument("--seed", type=whole, help="of everything random")
    sweep.add_argument("--t-span", type=float, nargs=2, metavar=("T0", "T1"), help="[s]; default: the scene's")
    sweep.add_argument("--method", help=METHODS_HELP)
    sweep.add_argument("--workers", type=count, metavar="N", help="processes; default: this one alone")
    sweep.add_argument("--shard", type=shard, metavar="I/N", help="only part I of N, for several machines")
    sweep.add_argument("--resume", action="store_true", help="go on where an interrupted sweep ended")
    sweep.add_argument("--out", metavar="DIR", help="folder; default servoctl-runs/NAME-sweep")
    sweep.add_argument("--merge", metavar="DIR", nargs="+", help="no computation: join the shards in these folders")
    sweep.set_defaults(command=_sweep)
    export = commands.add_parser("export-c", help="the feedforward and residuals of a scene as one C file and header")
    export.add_argument("scene", metavar="NAME_OR_FILE", help="a gallery name, or a .py file that defines scene()")
    export.add_argument("--out", metavar="DIR", required=True, help="folder for the two files")
    export.add_argument("--name", help="prefix of the files and of all functions; default: the scene's name")
    export.add_argument("--set", type=assignment, metavar="NAME=VALUE", **many, help="parameters")
    export.set_defaults(command=_export_c)


# what computes, and has no place beside --merge
COMPUTING = ("vary", "monte_carlo", "draw", "seed", "t_span", "method", "workers", "shard", "resume")

# --- export-c


def _export_c(args):
    from servoctl.export.c import export_c
    from servoctl.export.files import identifier
    from servoctl.shell.scenes import find_scene

    name, scene = find_scene(args.scene)
    model = _model(args.scene).with_parameters(**mapping(args.set, "--set"))
    start = model.start(t=scene.t_span[0], guess=scene.guess, **scene.start)
    files = export_c(model, args.out, name=args.name or identifier(name), start=start)
    print(f"{', '.join(file.name for file in files)} in {args.out}")
    return 0


# --- sweep


def _sweep(args):
    import servoctl as sv

    if args.merge:
        _require_alone(args)
        study = sv.merge(sv.load_study(path) for path in _shards(args.merge))
        name = Path(args.merge[0]).name
    elif args.scene is None:
        raise SpecificationError(
            "servoctl sweep was given no scene.",
            "A sweep computes cases of a scene, or merges shards.",
            nearest="servoctl sweep overhead-crane --vary m_load=80:120:9",
            do="Name a scene, or give --merge.",
        )
    else:
        name, study = None, None
    folder = _folder(args, name)
    try:
        study = _computed(args, folder) if study is None else study
        return _leave(study, folder, _stem(args), _units(args.scene))
    finally:
        folder.leave()


def _require_alone(args):
    surplus = given(args, COMPUTING)
    if surplus:
        raise SpecificationError(
            f"{', '.join(surplus)} was given with --merge.",
            "Merging joins what was computed, and computes nothing.",
            do="Leave one of them out.",
        )


def _folder(args, merged):
    from servoctl.shell.scenes import find_scene

    name = merged or f"{_scene_name(args.scene, find_scene)}-sweep"
    return Folder(Path(args.out) if args.out else Path("servoctl-runs", name), name)


def _scene_name(given, find_scene):
    return Path(given).stem if given.endswith(".py") else find_scene(given)[0]


def _stem(args):
    return f"sweep-{args.shard[0]}-of-{args.shard[1]}" if args.shard else "sweep"


def _computed(args, folder):
    import servoctl as sv

    cases, case = _cases(args), _case(args)
    random = "rng" in inspect.signature(case).parameters
    surplus = [] if random or args.draw else given(args, ("seed", "monte_carlo"))
    if surplus or (random or args.draw) and args.seed is None:
        raise SpecificationError(
            f"{', '.join(surplus)} was given, and nothing is random." if surplus else "There is no --seed.",
            "Random cases, and a case(..., rng) that draws numbers, are repeated exactly from a seed.",
            do="Leave it out, or give --draw." if surplus else "Give one, such as --seed 1.",
        )
    checkpoint = folder.path / f"{_stem(args)}.jsonl"
    if checkpoint.exists() and not args.resume:
        raise SpecificationError(
            f"{checkpoint} holds the finished cases of a sweep that did not end.",
            "Work that was done is not thrown away.",
            nearest="--resume goes on where it ended.",
            do="Give --resume, another folder by --out, or remove the file.",
            checkpoint=str(checkpoint),
        )
    options = {"seed": args.seed if random else None, "checkpoint": checkpoint, "shard": args.shard}
    if args.workers in (None, 1):
        study = sv.sweep(case, cases, **options)
    else:
        with ProcessPoolExecutor(args.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            study = sv.sweep(case, cases, executor=pool, **options)
    if not study.meta["interrupted"] and not study.meta["lost"]:
        checkpoint.unlink()
    return study


def _cases(args):
    import servoctl as sv

    varied, random = mapping(args.vary, "--vary"), mapping(args.draw, "--draw")
    both = [name for name in varied if name in random]
    if both or bool(random) > bool(args.monte_carlo) or not (varied or args.monte_carlo):
        raise SpecificationError(
            f"{', '.join(both)} is both varied and drawn." if both
            else "--draw was given without --monte-carlo N." if random
            else "Neither --vary nor --monte-carlo was given.",
            "A sweep takes all combinations of the values of --vary, each with N draws of --monte-carlo.",
            nearest="--vary m_load=80:120:9, or --monte-carlo 100 --draw m_load=normal:100:5 --seed 1.",
            do="Say what differs between the cases.",
        )  # fmt: skip
    grid = sv.grid(**varied)
    if not args.monte_carlo:
        return grid
    distributions = {name: drawn(*parts) for name, parts in random.items()}
    draws = sv.monte_carlo(args.monte_carlo * len(grid), seed=args.seed or 0, **distributions)
    return [{**grid[i // args.monte_carlo], **case} for i, case in enumerate(draws)]


def _case(args):
    """The function of one case; a file's own case() is found again by its file in every process."""
    from servoctl.shell.scenes import own_case
    from servoctl.study.sweep import require_fitting

    own = own_case(args.scene)
    if own is None:
        _require_names(args)
        options = {"t_span": tuple(args.t_span)} if args.t_span else {}
        options |= {"method": args.method} if args.method else {}
        return functools.partial(scene_case, args.scene, tuple(options.items()))
    if args.t_span or args.method:
        raise SpecificationError(
            "--t-span or --method was given, and the file computes its cases by its own case().",
            "Such options are for cases that simulate the scene.",
            do="Leave them out, or use them inside of case().",
        )
    draws = "rng" in inspect.signature(own).parameters
    require_fitting(own, {name: None for name, _ in (*args.vary, *args.draw)}, 0 if draws else None)
    return functools.partial(own_random_case if draws else own_plain_case, args.scene)


def _require_names(args):
    model = _model(args.scene)
    valid = (*model.reduction.mechanism.parameters.names, *model.state_names)
    for name, _ in (*args.vary, *args.draw):
        if name not in valid:
            raise unknown(name, valid, "parameter or state")


def _model(given):
    """The model of a scene, derived once in each process."""
    from servoctl.shell.scenes import stamp

    return _derived(given, stamp(given))


@functools.cache
def _derived(given, _):
    from servoctl.model.model import derive
    from servoctl.shell.scenes import find_scene

    return derive(*find_scene(given)[1].build())


def scene_case(given, options, /, **values):
    """Simulate the plan of a scene with other parameters and held values of the start.

    Parameters
    ----------
    given : str
        A name of the gallery, or a file.
    options : tuple of (str, object)
        Of `simulate`, and t_span.
    **values : float
        By name.

    Returns
    -------
    Run
    """
    from servoctl.shell.scenes import find_scene
    from servoctl.simulation import simulate

    scene, model = find_scene(given)[1], _model(given)
    options, parameters = dict(options), model.reduction.mechanism.parameters.names
    model = model.with_parameters(**{name: value for name, value in values.items() if name in parameters})
    held = {name: value for name, value in values.items() if name not in parameters}
    guess = {name: value for name, value in scene.guess.items() if name not in held}
    span = options.pop("t_span", scene.t_span)
    start = model.start(t=span[0], guess=guess, **{**scene.start, **held})
    return simulate(model, start, span, progress=False, **options)


def own_plain_case(given, /, **values):
    """What case() of a user's file returns."""
    from servoctl.shell.scenes import own_case

    return own_case(given)(**values)


def own_random_case(given, /, rng, **values):
    """What case() of a user's file returns, which draws random numbers."""
    from servoctl.shell.scenes import own_case

    return own_case(given)(rng=rng, **values)


def _units(given):
    """Units of states and of what a row has of a signal, by column."""
    from servoctl.shell.scenes import find_scene, own_case

    known = find_scene(given)[1].units if given and own_case(given) is None else {}
    return {f"{name}{end}": unit for name, unit in known.items() for end in ("", "_min", "_max", "_end")}


def _leave(study, folder, stem, units):
    """Print, save and draw; returns the exit code."""
    from servoctl import figures

    report = Report()
    report.say(study)
    failures = study.take([i for i, error in enumerate(study["error"].tolist()) if error])
    first = {f"{row['error']}: {row['message']}": row["case"] for row in reversed(failures.rows())}
    for text, i in sorted(first.items(), key=lambda item: item[1])[:3]:
        complain(f"Case {i}: {text}")
    folder.write(lambda path: study.save(path / f"{stem}.npz"))
    folder.write(lambda path: study.csv(path / f"{stem}.csv"))
    text = json.dumps(study.meta, indent=2, ensure_ascii=False) + "\n"
    folder.write(lambda path: (path / f"{stem}.json").write_text(text, encoding="utf-8"))
    written = [f"{stem}{suffix}" for suffix in (".npz", ".csv", ".json")]
    try:
        figure = figures.sweep(study, units=units)
        figure.suptitle(f"{folder.name}: {study.meta['message']}", fontsize=11)
    except SpecificationError as error:
        complain(f"There is no figure: {error}")
    else:
        folder.write(lambda path: figure.savefig(path / f"{stem}.png"))
        written.append(f"{stem}.png")
    print(f"{', '.join(written)} in {folder.path}")
    whole = study.meta["shard"] is not None or len(study) == study.meta["count"]
    return 0 if whole and not (len(failures) or study.meta["interrupted"] or folder.moved) else 1


def _shards(folders):
    found = {folder: sorted(Path(folder).glob("sweep-*-of-*.npz")) for folder in folders}
    empty = [folder for folder, paths in found.items() if not paths]
    if empty:
        raise ServoError(
            f"There are no shards in {', '.join(empty)}.",
            "A shard is a file sweep-I-of-N.npz, written by servoctl sweep --shard I/N.",
            do="Name the folders given by --out.",
            folders=empty,
        )
    return [path for paths in found.values() for path in paths]
