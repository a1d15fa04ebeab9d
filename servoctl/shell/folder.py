"""What a run leaves: the folder with its files, and its summary."""

import contextlib
import json
import math
import os
import tempfile
from pathlib import Path

import servoctl as sv
from servoctl.checks import as_path
from servoctl.errors import ServoError
from servoctl.shell.printing import complain
from servoctl.study.table import machine

FILES = ("index.html", "run.npz", "closed_loop.npz", "summary.json", "report.txt", "motion.png", "sheet.png")
FIGURES = ("path.png", "coordinates.png", "actuation.png", "residuals.png", "closed_loop.png")  # by --all-figures
ANIMATION = "motion.gif"


class Folder:
    """The folder of a run: checked before anything is computed, replaced by a temporary one if writing fails later.

    `path` is where the files are; `moved` is true if that is the temporary folder.
    """

    def __init__(self, path, name):
        self.path, self.name, self.moved, self._actions = path, name, False, []
        self._made = []
        try:
            self._made = [p for p in (path, *path.parents) if not p.exists()]
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path):
                pass
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            self._leave()
            reason = "it is a file" if os.path.isfile(path) else getattr(error, "strerror", None) or error
            raise ServoError(
                f"The folder {str(path).encode(errors='backslashreplace').decode()} cannot be written: {reason}.",
                f"Numbers and figures of a run are written to a folder, by default {Path('servoctl-runs', name)}.",
                do=f"Give another one: --out {Path(tempfile.gettempdir(), name)}. Nothing has been computed yet.",
                folder=str(path),
            ) from error

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._leave()

    def write_text(self, name, text):
        """Write a text file."""
        self.write(lambda path: (path / name).write_text(text, encoding="utf-8"))

    def write_json(self, name, facts):
        """Write facts as JSON; NaN and infinity become null."""
        text = json.dumps(jsonable(facts), indent=2, allow_nan=False, ensure_ascii=False)
        self.write_text(name, text + "\n")

    def write(self, action):
        """Call `action(path)`, which writes files; if it fails, all actions are repeated in a temporary folder.

        Before the first action the files of earlier runs are removed.
        """
        try:
            if not self._actions:
                for name in (*FILES, *FIGURES, ANIMATION):
                    (self.path / name).unlink(missing_ok=True)
            action(self.path)
        except (OSError, ServoError) as error:
            if self.moved:
                raise _nowhere(self.path, error) from error
            self._move(error)
            for each in [*self._actions, action]:
                self.write(each)
        else:
            self._actions.append(action)

    def _move(self, error):
        try:
            self.path, self.moved = Path(tempfile.mkdtemp(prefix=f"servoctl-{self.name}-")), True
        except OSError as another:
            raise _nowhere(tempfile.gettempdir(), another) from error
        self._made.append(self.path)
        complain(f"{self.name}: {error}", f"Nothing is lost: it is written to {self.path} instead.")

    def _leave(self):
        """Remove the folders made for this run that are still empty."""
        for path in self._made:
            with contextlib.suppress(OSError, ValueError):
                path.rmdir()


def _nowhere(path, error):
    return ServoError(
        f"{path} cannot be written, either: {error}.",
        do="Free space on the disk or set TMPDIR, and run again; the report is above.",
        path=str(path),
    )


def folder_of(args, name, ending=""):
    """The folder of --out, by default servoctl-runs/NAME with the ending."""
    return Folder(Path("servoctl-runs", name + ending) if args.out is None else as_path(args.out, "--out"), name)


def summary(run, start, verification):
    """A run as values for JSON."""
    model = run.model
    residuals = {name: [_worst(level) for level in run.residual[name].tolist()] for name in run.residual}
    verified = verification and {name: getattr(verification, name) for name in ("verdict", "passed", "numbers")}
    return {
        "versions": machine()["versions"],
        "parameters": dict(zip(model.reduction.mechanism.parameters.names, model.parameters, strict=True)),
        "method": run.method,
        "drift": run.drift or None,
        "success": run.success,
        "status": run.status,
        "message": run.message,
        "t_end": run.t[-1],
        "samples": len(run.t),
        "counters": run.counters,
        "free_initial_values": model.free,
        "internal_dynamics": {name.replace(" ", "_"): value for name, value in run.internal.items()} or None,
        "start": {
            "t": start.t,
            "values": dict(zip(start.names, start.values, strict=True)),
            "held": start.held,
            "free": start.free,
            "residual": start.residual,
        },
        "structure": _structure(model),
        "extrema": {n: _extrema(run, n) for n in dict.fromkeys([*sv.figures.efforts(run), *model.outputs])},
        "residuals": {name: {"worst": _worst(levels), "levels": levels} for name, levels in residuals.items()},
        "verification": verified,
    }


def _worst(values):
    return max(map(abs, values), default=0.0) if all(map(math.isfinite, values)) else math.nan


def _structure(model):
    try:
        structure = model.structure()
    except ServoError as error:
        return {"index": None, "message": str(error)}
    names = ("index", "relative_degree", "decoupling_rank", "zeros_at_infinity", "essential_orders", "margin")
    return {name: getattr(structure, name) for name in names}


def _extrema(run, name):
    low, high = run.extrema(name)
    return {"min": {"t": low[0], "value": low[1]}, "max": {"t": high[0], "value": high[1]}}


def jsonable(value):
    """A value of numbers, texts, lists and dicts; NaN and infinity become None."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
