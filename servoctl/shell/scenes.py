"""A scene by name: from the gallery, or from a user's file."""

import importlib.util
import os
import sys
import traceback
from pathlib import Path

import servoctl as sv
from servoctl.checks import is_number
from servoctl.errors import ServoError, SpecificationError, unknown
from servoctl.gallery import Scene, gallery
from servoctl.model.model import including

_MODULE = "servoctl_scene"  # name of the module made from a user's file, so that it shadows no other module


def find_scene(given):
    """The name and the scene of a gallery name or of a user's file; errors in the file are reported with their line.

    The file is a .py file that defines `scene()` -> (Mechanism, Program), and optionally START, GUESS, T_SPAN and UNITS
    (see `servoctl.gallery`). The first line of its docstring is the description.
    """
    if given in gallery:
        return given, gallery[given]
    path = Path(given)
    if path.suffix == ".py":
        return path.stem, _from_file(path)
    error = unknown(given, gallery, "scene")
    if os.path.isfile(f"{given}.py"):
        error.__notes__ = [f"There is a file {given}.py: give the name with its suffix."]
    elif os.path.exists(given):
        error.__notes__ = [f"{given} exists, but a scene's file ends in .py."]
    raise error


def model_of(scene, named=()):
    """The model of a scene, with the coordinates that its start and these names of signals name."""
    return including(sv.derive(*scene.build()), [*scene.start, *scene.guess, *named])


def _module(path):
    if not os.path.isfile(path):
        others = [p.name for p in path.parent.glob("*.py")]
        match = unknown(path.name, others, "file").details["match"]
        raise SpecificationError(
            f"There is no file {path}.",
            nearest=f"{path.parent / match}." if match else "",
            do="Give a Python file, or a name from servoctl list.",
            file=str(path),
        )
    return _reported(path, lambda: _import(path))


def _from_file(path):
    module = _module(path)
    scene = getattr(module, "scene", None)
    if not callable(scene):
        raise SpecificationError(
            f"{path} defines no scene().",
            "A scene's file defines scene(), a function without arguments that returns (Mechanism, Program).",
            do=_advice(module),
            file=str(path),
        )
    description = next(iter((module.__doc__ or "").strip().splitlines()), f"The scene of {path.name}.")
    return Scene(lambda: _built(path, scene), description, **_settings(path, module))


def _import(path):
    spec = importlib.util.spec_from_file_location(_MODULE, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[_MODULE] = module
    folder = str(path.parent.resolve())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    spec.loader.exec_module(module)
    return module


def _reported(path, action):
    """The result of `action()`; an exception in the user's file is reported with its line."""
    try:
        return action()
    except ServoError as error:
        line, text = _place(error, path)
        error.__notes__ = [*getattr(error, "__notes__", ()), f"Raised in {path}, line {line}: {text}"]
        raise
    except (Exception, SystemExit) as error:
        line, text = _place(error, path)
        last = traceback.format_exception_only(error)[-1].strip()
        raise SpecificationError(
            f"{path} raised {last}, in line {line}: {text}",
            do="Correct the file; python shows the whole traceback.",
            file=str(path),
            line=line,
            exception=last,
        ) from error


def _place(error, path):
    """Number and text of the line in the file where the error was raised."""
    if isinstance(error, SyntaxError) and error.filename and Path(error.filename).resolve() == path.resolve():
        return error.lineno, (error.text or "").strip()
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).resolve() == path.resolve()]
    return (frames[-1].lineno, frames[-1].line) if frames else (1, "")


def _built(path, scene):
    match value := _reported(path, scene):
        case [sv.Mechanism(), sv.Program()]:
            return tuple(value)
        case [*items]:
            kinds = f"({', '.join(type(item).__name__ for item in items)})"
        case _:
            kinds = type(value).__name__
    raise SpecificationError(
        f"scene() of {path} returned {kinds}.",
        "scene() returns a Mechanism and a Program, in this order.",
        do="End it with: return mechanism, program.",
        file=str(path),
        returned=kinds,
    )


def _advice(module):
    """What to do in a file without scene()."""
    functions = [n for n, v in vars(module).items() if callable(v) and getattr(v, "__module__", "") == _MODULE]
    if functions:
        return f"Define scene(). The file defines {', '.join(f'{name}()' for name in functions[:5])}."
    if any(isinstance(v, (sv.Mechanism, sv.Program)) for v in vars(module).values()):
        return "Return the mechanism and the program, which it makes outside any function, from scene()."
    return "Define scene()."


def _numbers(value):
    return isinstance(value, dict) and all(isinstance(k, str) and is_number(v) for k, v in value.items())


SETTINGS = {  # of a scene's file: the check of a value, and an example
    "START": (_numbers, '{"theta": 0.1}'),
    "GUESS": (_numbers, '{"theta": 0.1}'),
    "T_SPAN": (lambda v: isinstance(v, (tuple, list)) and len(v) == 2 and all(map(is_number, v)), "(0.0, 2.0)"),
    "UNITS": (lambda v: isinstance(v, dict) and all(isinstance(n, str) for n in (*v, *v.values())), '{"theta": "rad"}'),
}


def _settings(path, module):
    settings = {name: getattr(module, name) for name in SETTINGS if hasattr(module, name)}
    for name, value in settings.items():
        check, example = SETTINGS[name]
        if not check(value):
            raise SpecificationError(
                f"{path} sets {name} = {value!r}.", f"{name} has the form {example}.", file=str(path), name=name
            )
    return {name.lower(): value for name, value in settings.items()}
