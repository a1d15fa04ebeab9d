"""What a run leaves: the text that was printed, a folder with its files, and its facts as plain values."""

import contextlib
import json
import math
import os
import sys
import tempfile
import textwrap
from pathlib import Path

import servoctl as sv
from servoctl.errors import ServoError
from servoctl.study.table import machine

COLUMNS = 120  # columns of what is printed
FILES = ("run.npz", "summary.json", "report.txt", "path.png", "coordinates.png", "actuation.png", "residuals.png")
LOOP_FILES = ("closed_loop.npz", "closed_loop.png")


class Report:
    """What was printed, to be written as well."""

    def __init__(self):
        self.texts = []

    @property
    def text(self):
        """All that was printed."""
        return "\n".join(self.texts)

    def say(self, value):
        """Print a value, long lines wrapped, and remember it."""
        self.texts.append("\n".join(_wrapped(line, "    ") for line in str(value).splitlines()) + "\n")
        try:
            print(self.texts[-1], flush=True)
        except BrokenPipeError:  # a reader that left, such as head, does not end the computation
            sys.stdout = open(os.devnull, "w")


def complain(*texts):
    """Print texts to stderr in lines of readable length."""
    for text in texts:
        print(_wrapped(text, "  "), file=sys.stderr)


def _wrapped(line, indent):
    if len(line) <= COLUMNS:
        return line
    return textwrap.fill(line, COLUMNS, subsequent_indent=indent, break_on_hyphens=False)


class Folder:
    """The folder of a run: tried before anything is computed, replaced by a temporary one where writing fails later.

    Its `path` is where the files are; it has `moved` if that is a temporary folder in place of the one that was given.
    """

    def __init__(self, path, name):
        self.path, self.name, self.moved, self._done = path, name, False, []
        self._made = [p for p in (path, *path.parents) if not p.exists()]
        try:
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path):
                pass
        except OSError as error:
            self._leave()
            reason = "it is a file" if path.is_file() else error.strerror or error
            raise ServoError(
                f"The folder {path} cannot be written: {reason}.",
                f"A run leaves its numbers and figures in a folder, by default {Path('servoctl-runs', name)}.",
                do="Give another folder by --out. Nothing has been computed yet.",
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
        """Write facts as JSON; what is not finite becomes null."""
        text = json.dumps(jsonable(facts), indent=2, allow_nan=False, ensure_ascii=False)
        self.write_text(name, text + "\n")

    def write(self, action):
        """Carry out `action(path)`, which writes files; where it fails, it and all before it go to a temporary folder.

        The first action finds the files of earlier runs removed. A ServoError where no temporary folder can be written.
        """
        try:
            if not self._done:
                for name in (*FILES, *LOOP_FILES):
                    (self.path / name).unlink(missing_ok=True)
            action(self.path)
        except (OSError, ServoError) as error:
            if self.moved:
                raise _nowhere(self.path, error) from error
            self._move(error)
            for each in [*self._done, action]:
                self.write(each)
        else:
            self._done.append(action)

    def _move(self, error):
        try:
            self.path, self.moved = Path(tempfile.mkdtemp(prefix=f"servoctl-{self.name}-")), True
        except OSError as another:
            raise _nowhere(tempfile.gettempdir(), another) from error
        self._made.append(self.path)
        complain(f"{self.name}: {error}", f"What was computed is kept: it is written to {self.path} instead.")

    def _leave(self):
        """Remove the folders that were made for this run and stayed empty."""
        for path in self._made:
            with contextlib.suppress(OSError):
                path.rmdir()


def _nowhere(path, error):
    return ServoError(
        f"{path} cannot be written, either: {error}.",
        "A run leaves its numbers and figures in a folder.",
        do="Make room or set TMPDIR, and run again; what was printed is above.",
    )


def folder_of(args, name, ending=""):
    """The folder given by --out, or servoctl-runs/NAME and the ending."""
    return Folder(Path(args.out) if args.out else Path("servoctl-runs", name + ending), name)


def summary(run, start, verification):
    """Facts of a run, for JSON: versions, numbers, outcome, start, structure, extrema, residuals, verification."""
    model = run.model
    residuals = {name: [_worst(level) for level in run.residual[name].tolist()] for name in run.residual}
    checked = verification is not None
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
        "start": {
            "t": start.t,
            "values": dict(zip(start.names, start.values, strict=True)),
            "held": start.held,
            "free": start.free,
            "residual": start.residual,
        },
        "structure": _structure(model),
        "operations": model.operations(),
        "extrema": {n: _extrema(run, n) for n in dict.fromkeys([*sv.figures.efforts(run), *model.outputs])},
        "residuals": {name: {"worst": _worst(levels), "levels": levels} for name, levels in residuals.items()},
        "verification": {"passed": verification.passed, "numbers": verification.numbers} if checked else None,
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
    """Numbers, texts, lists and dicts of them; what is not finite becomes None."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
