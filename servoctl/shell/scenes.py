"""A scene by name: from the gallery, or from a user's file."""

import functools
import importlib.util
import math
import sys
import traceback
from pathlib import Path

from servoctl.errors import ServoError, SpecificationError, unknown

_MODULE = "servoctl_scene"  # name under which a user's file is imported, so that it hides no other module


def find_scene(given):
    """The scene of the gallery with this name, or that of a user's file.

    Parameters
    ----------
    given : str
        A name of the gallery, or the path of a .py file that defines `scene()` -> (Mechanism, Program), and, if
        wanted, START, GUESS, T_SPAN and UNITS (see `servoctl.gallery`). Its docstring's first line describes it.

    Returns
    -------
    name : str
        Of the scene; of a file its name without suffix.
    scene : Scene

    Raises
    ------
    NameUnknown
        If the gallery has no such scene.
    SpecificationError
        If the file is missing, raises, has no `scene()`, or holds values of other kinds. Errors in the file are
        reported with their line.
    """
    from servoctl.gallery import gallery

    if given in gallery:
        return given, gallery[given]
    path = Path(given)
    if path.suffix == ".py":
        return path.stem, _from_file(path)
    error = unknown(given, gallery, "scene")
    if path.with_name(path.name + ".py").is_file():
        error.add_note(f"There is a file {given}.py: give its name with the suffix.")
    elif path.exists():
        error.add_note(f"{given} exists, but a scene's file ends in .py.")
    raise error


def _module(path):
    if not path.is_file():
        others = [p.name for p in path.parent.glob("*.py")]
        match = unknown(path.name, others, "file").details["match"]
        raise SpecificationError(
            f"There is no file {path}.",
            "A scene is a name of the gallery or a Python file.",
            nearest=f"{path.parent / match}." if match else "",
            do="Check the path, or see servoctl list.",
            file=str(path),
        )
    return _reported(path, lambda: _import(path))


def _from_file(path):
    from servoctl.gallery import Scene

    module = _module(path)
    scene = getattr(module, "scene", None)
    if not callable(scene):
        raise SpecificationError(
            f"{path} defines no scene().",
            "A scene's file defines scene(), a function without arguments that returns (Mechanism, Program).",
            nearest=_nearest(module),
            do="Define scene().",
            file=str(path),
        )
    description = next(iter((module.__doc__ or "").strip().splitlines()), f"The scene of {path.name}.")
    return Scene(lambda: _built(path, scene), description, **_settings(path, module))


def stamp(given):
    """What tells a scene from another one, and a file from what it was before it was changed: to be cached by."""
    path = Path(given)
    return (str(path.resolve()), path.stat().st_mtime_ns) if path.is_file() else given


def own_case(given):
    """The function `case` that a user's file defines for sweeps; None where there is none."""
    from servoctl.gallery import gallery

    path = Path(given)
    if given in gallery or path.suffix != ".py":
        return None
    return getattr(_imported(path, stamp(given)), "case", None)


@functools.cache
def _imported(path, _):
    return _module(path)


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
    """What `action()` returns; an exception in the user's file is reported with its line there."""
    try:
        return action()
    except ServoError as error:
        line, text = _place(error, path)
        error.add_note(f"Raised in {path}, line {line}: {text}")
        raise
    except (Exception, SystemExit) as error:
        line, text = _place(error, path)
        last = traceback.format_exception_only(error)[-1].strip()
        raise SpecificationError(
            f"{path} raised {last}, in line {line}: {text}",
            "A scene's file is imported, and its scene() is called.",
            do="Correct the file; run by python, it shows the whole traceback.",
            file=str(path),
            line=line,
            exception=last,
        ) from error


def _place(error, path):
    """Number and text of the last line of the file that the error passed through."""
    if isinstance(error, SyntaxError) and error.filename and Path(error.filename).resolve() == path.resolve():
        return error.lineno, (error.text or "").strip()
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).resolve() == path.resolve()]
    return (frames[-1].lineno, frames[-1].line) if frames else (1, "")


def _built(path, scene):
    from servoctl.spec import Mechanism, Program

    value = _reported(path, scene)
    if not (
        isinstance(value, (tuple, list))
        and len(value) == 2
        and isinstance(value[0], Mechanism)
        and isinstance(value[1], Program)
    ):
        kinds = ", ".join(type(item).__name__ for item in value) if isinstance(value, (tuple, list)) else None
        raise SpecificationError(
            f"scene() of {path} returned {type(value).__name__ if kinds is None else f'({kinds})'}.",
            "scene() returns a Mechanism and a Program, in this order.",
            do="End it with: return mechanism, program.",
            file=str(path),
        )
    return tuple(value)


def _nearest(module):
    """A function of the file that may be meant."""
    from servoctl.spec import Mechanism, Program

    functions = [n for n, v in vars(module).items() if callable(v) and getattr(v, "__module__", "") == _MODULE]
    if functions:
        return f"The file defines {', '.join(f'{name}()' for name in functions[:5])}."
    if any(isinstance(v, (Mechanism, Program)) for v in vars(module).values()):
        return "The file makes a mechanism or program outside any function: return them from scene()."
    return ""


def _settings(path, module):
    settings = {}
    for name, check, form in (
        ("START", _numbers, '{"theta": 0.1}'),
        ("GUESS", _numbers, '{"theta": 0.1}'),
        ("T_SPAN", _span, "(0.0, 2.0)"),
        ("UNITS", _texts, '{"theta": "rad"}'),
    ):
        if hasattr(module, name):
            value = getattr(module, name)
            if not check(value):
                raise SpecificationError(
                    f"{path} sets {name} = {value!r}.",
                    f"{name} has the form {form}.",
                    do="Correct it, or leave it out.",
                    file=str(path),
                    name=name,
                )
            settings[name.lower()] = value
    return settings


def _number(value):
    return isinstance(value, (int, float)) and math.isfinite(value)


def _numbers(value):
    return isinstance(value, dict) and all(isinstance(k, str) and _number(v) for k, v in value.items())


def _span(value):
    return isinstance(value, (tuple, list)) and len(value) == 2 and all(map(_number, value))


def _texts(value):
    return isinstance(value, dict) and all(isinstance(k, str) and isinstance(v, str) for k, v in value.items())
