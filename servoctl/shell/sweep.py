"""`servoctl sweep`: many cases of a scene in one table, on several processes or machines."""

import functools
import inspect
import os
from dataclasses import replace
from pathlib import Path

import servoctl as sv
from servoctl.errors import ServoError, SpecificationError, unknown
from servoctl.figures.style import write_png
from servoctl.shell.folder import folder_of
from servoctl.shell.options import MANY, METHODS_HELP, by_name, count, draw, drawn, draws, shard, used, variation, whole
from servoctl.shell.printing import Report, complain
from servoctl.shell.scenes import find_scene, model_of, own_case, stamp
from servoctl.study.sweep import require_fitting

# options without effect beside --merge
COMPUTING = ("vary", "monte_carlo", "draw", "seed", "t_span", "method", "workers", "shard", "resume")


def add_sweep(sweep):
    """Add the arguments of the command."""
    scene = "a gallery name, or a .py file with scene() or case(**parameters)"
    sweep.add_argument("scene", metavar="NAME_OR_FILE", nargs="?", help=scene)
    vary = {"type": variation, "metavar": "NAME=LOW:HIGH:N", **MANY}
    sweep.add_argument("--vary", **vary, help="all combinations of these values")
    sweep.add_argument("--monte-carlo", type=draws, metavar="N", help="N random cases of each combination")
    distribution = {"type": draw, "metavar": "NAME=normal:MEAN:STD", **MANY}
    sweep.add_argument("--draw", **distribution, help="distributions of random parameters")
    sweep.add_argument("--seed", type=whole, help="seed of all random numbers")
    sweep.add_argument("--t-span", type=float, nargs=2, metavar=("T0", "T1"), help="[s]; default: the scene's")
    sweep.add_argument("--method", help=METHODS_HELP)
    sweep.add_argument("--workers", type=count, metavar="N", help="processes; default: 1")
    sweep.add_argument("--shard", type=shard, metavar="I/N", help="only part I of N, for several machines")
    sweep.add_argument("--resume", action="store_true", help="continue an interrupted sweep")
    sweep.add_argument("--out", metavar="DIR", help="folder; default servoctl-runs/NAME-sweep")
    sweep.add_argument("--merge", metavar="DIR", nargs="+", help="join the shards in these folders; computes nothing")
    sweep.set_defaults(command=_sweep)


def _sweep(args):
    if args.merge:
        return _merge(args)
    if args.scene is None:
        do = "Name one, as in servoctl sweep overhead-crane --vary m_load=80:120:9, or give --merge."
        raise SpecificationError("servoctl sweep was given no scene.", do=do, scene=None)
    name = Path(args.scene).stem if args.scene.endswith(".py") else find_scene(args.scene)[0]
    with folder_of(args, f"{name}-sweep") as folder:
        return _leave(_computed(args, folder), folder, _stem(args), _units(args.scene))


def _merge(args):
    computing = used(args, COMPUTING)
    if computing:
        raise SpecificationError(
            f"{', '.join(computing)} was given with --merge.",
            "Merging computes nothing.",
            do="Leave one of them out.",
            options=computing,
        )
    study = sv.merge(sv.load_study(path) for path in _shards(args.merge))
    with folder_of(args, Path(args.merge[0]).name) as folder:
        return _leave(study, folder, "sweep", _units(args.scene))


def _stem(args):
    return f"sweep-{args.shard[0]}-of-{args.shard[1]}" if args.shard else "sweep"


def _computed(args, folder):
    cases, case = _cases(args), _case(args)
    random = "rng" in inspect.signature(case).parameters
    idle = [] if random or args.draw else used(args, ("seed", "monte_carlo"))
    if idle or (random or args.draw) and args.seed is None:
        raise SpecificationError(
            f"{', '.join(idle)} was given, and nothing is random." if idle else "There is no --seed.",
            "The seed repeats random cases, and the numbers that a case(..., rng) draws.",
            do="Leave it out, or give --draw." if idle else "Give one, such as --seed 1.",
            options=idle,
            seed=args.seed,
        )
    checkpoint = folder.path / f"{_stem(args)}.jsonl"
    if checkpoint.exists() and not args.resume:
        raise SpecificationError(
            f"{checkpoint} holds the finished cases of an interrupted sweep.",
            do="Give --resume to continue it, another folder by --out, or remove the file.",
            checkpoint=str(checkpoint),
        )
    options = {"seed": args.seed if random else None, "checkpoint": checkpoint, "shard": args.shard}
    if args.workers in (None, 1):
        study = sv.sweep(case, cases, **options)
    else:
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
            study = sv.sweep(case, cases, executor=pool, **options)
    if not study.meta["interrupted"] and not study.meta["lost"]:
        checkpoint.unlink()
    return study


def _cases(args):
    varied, random = by_name(args.vary, "--vary"), by_name(args.draw, "--draw")
    both = [name for name in varied if name in random]
    if both:
        raise _unclear(f"{', '.join(both)} is both varied and drawn.", names=both)
    if random and not args.monte_carlo:
        raise _unclear("--draw was given without --monte-carlo N.", names=list(random))
    if not (varied or args.monte_carlo):
        raise _unclear("Neither --vary nor --monte-carlo was given.", names=[])
    grid = sv.grid(**varied)
    if not args.monte_carlo:
        return grid
    distributions = {name: drawn(*parts) for name, parts in random.items()}
    draws = sv.monte_carlo(args.monte_carlo * len(grid), seed=args.seed or 0, **distributions)
    return [{**grid[i // args.monte_carlo], **case} for i, case in enumerate(draws)]


def _unclear(given, **facts):
    return SpecificationError(
        given,
        "A sweep takes all combinations of the values of --vary, each with N draws of --monte-carlo.",
        do="Give --vary m_load=80:120:9, or --monte-carlo 100 --draw m_load=normal:100:5 --seed 1.",
        **facts,
    )


def _case(args):
    """The function of one case; every process imports a file's case() by the path of the file."""
    file_case = own_case(args.scene)
    if file_case is None:
        _require_names(args)
        options = {"t_span": tuple(args.t_span)} if args.t_span else {}
        options |= {"method": args.method} if args.method else {}
        return functools.partial(scene_case, args.scene, tuple(options.items()))
    if args.t_span or args.method:
        raise SpecificationError(
            "--t-span or --method was given, and the file computes its cases by its own case().",
            "These options are for cases that simulate the scene.",
            do="Leave them out, or set them inside case().",
            options=used(args, ("t_span", "method")),
        )
    draws = "rng" in inspect.signature(file_case).parameters
    require_fitting(file_case, {name: None for name, _ in (*args.vary, *args.draw)}, 0 if draws else None)
    return functools.partial(own_random_case if draws else own_plain_case, args.scene)


def _require_names(args):
    model = _model(args.scene)
    valid = (*model.reduction.mechanism.parameters.names, *model.state_names)
    for name, _ in (*args.vary, *args.draw):
        if name not in valid:
            raise unknown(name, valid, "parameter or state")


def _model(given):
    """The model of a scene, derived once in each process, and again when its file has changed."""
    return _model_of(given, stamp(given))


@functools.cache
def _model_of(given, _):
    return model_of(find_scene(given)[1])


def scene_case(given, options, /, **values):
    """Simulate the plan of a scene; `values` are parameters and held values, `options` arguments of `simulate`."""
    scene, model = find_scene(given)[1], _model(given)
    options, parameters = dict(options), model.reduction.mechanism.parameters.names
    model = model.with_parameters(**{name: value for name, value in values.items() if name in parameters})
    held = {name: value for name, value in values.items() if name not in parameters}
    guess = {name: value for name, value in scene.guess.items() if name not in held}
    span = options.pop("t_span", scene.t_span)
    start = model.start(t=span[0], guess=guess, **{**scene.start, **held})
    return sv.simulate(model, start, span, progress=False, **options)


def own_plain_case(given, /, **values):
    """Call case() of a user's file."""
    return own_case(given)(**values)


def own_random_case(given, /, rng, **values):
    """Call case() of a user's file with a random generator."""
    return own_case(given)(rng=rng, **values)


def _units(given):
    """Units of states, signals and parameters of a scene whose cases are its motions."""
    return _model(given).reduction.mechanism.units if given and own_case(given) is None else {}


def _leave(study, folder, stem, units):
    """Print, save and draw a study; returns the exit code."""
    study = replace(study, meta=study.meta | ({"units": units} if units else {}))
    report = Report()
    report.say(study)
    failures = study.take([i for i, error in enumerate(study["error"].tolist()) if error])
    first = {f"{row['error']}: {row['message']}": row["case"] for row in reversed(failures.rows())}
    for text, i in sorted(first.items(), key=lambda item: item[1])[:3]:
        complain(f"Case {i}: {text}")
    folder.write(lambda path: study.save(path / f"{stem}.npz"))
    folder.write(lambda path: study.csv(path / f"{stem}.csv"))
    folder.write_json(f"{stem}.json", study.meta)
    written = [f"{stem}{suffix}" for suffix in (".npz", ".csv", ".json")]
    try:
        figure = sv.figures.sweep(study)
        figure.suptitle(f"{folder.name}: {study.meta['message']}", fontsize=11)
    except SpecificationError as error:
        complain(f"There is no figure: {error}")
    else:
        folder.write(lambda path: write_png(figure, path / f"{stem}.png"))
        written.append(f"{stem}.png")
    print(f"{', '.join(written)} in {folder.path}")
    whole = study.meta["shard"] is not None or len(study) == study.meta["count"]
    return 0 if whole and not (len(failures) or study.meta["interrupted"] or folder.moved) else 1


def _shards(folders):
    there = {folder: os.path.isdir(folder) for folder in folders}
    shards = {folder: sorted(Path(folder).glob("sweep-*-of-*.npz")) if there[folder] else [] for folder in folders}
    empty = [folder for folder, paths in shards.items() if not paths]
    if empty:
        raise ServoError(
            f"There are no shards in {', '.join(empty)}.",
            "A shard is a file sweep-I-of-N.npz, written by servoctl sweep --shard I/N.",
            do="Give the folders of these commands.",
            folders=empty,
        )
    return [path for paths in shards.values() for path in paths]
