"""The public surface: names, documentation, short reprs, layering, import cost, sizes."""

import ast
import inspect
import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

import casadi as ca
import numpy as np
import pytest
from conftest import needs

import servoctl as sv
from servoctl.gallery import gallery

PACKAGE = Path(sv.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
ENTRIES = ("__init__.py", "__main__.py", "types.py")  # of the package itself: they gather the rest
FAMILIES = ("errors", "methods", "types")  # modules of public classes

LAYERS = (
    "version", "errors", "values", "markup", "tolerances", "checks", "units", "archive", "progress", "jets", "spec", "robots", "programs", "reduction", "codegen",
    "model", "dense", "plants", "run", "methods", "growth", "simulation", "figures", "control", "verification",
    "sensitivities", "study", "inversion", "interop", "export", "gallery", "shell",
)  # fmt: skip
WITHOUT_CASADI = ("study", "figures", "interop", "shell")
SWEEPS = ("concurrent.futures", "multiprocessing", "importlib.metadata")
LATE = ("scipy", "matplotlib", "control", "tqdm", "xarray", "pandas", "dask")
MOST_IN_A_FUNCTION, MOST_PARAMETERS, MOST_MODULES_OF_A_NAME, MOST_IN_A_REPR = 40, 8, 2, 8
SHEETS = ("Mechanism.__init__", "simulate", "simulated", "simulate_many")  # filled in by keyword


def relative(path):
    return path.relative_to(PACKAGE).as_posix()


def layer(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path):
    """Modules that a file imports anywhere, `from servoctl import spec` as servoctl.spec."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{relative(path)} imports relatively"
            if node.module == "servoctl":
                yield from (f"servoctl.{alias.name}" for alias in node.names)
            else:
                yield node.module


LAYERED = [path for path in FILES if relative(path) not in ENTRIES]


def offenders(fault, files=FILES):
    """What a function says of each file, by the file's name, where it says anything."""
    return {relative(path): said for path in files if (said := fault(path))}


# names and documentation ---------------------------------------------------------------------------------------------


def test_public_names_exist_once_and_in_order():
    assert sv.__all__ == sorted(set(sv.__all__))
    assert all(hasattr(sv, name) for name in sv.__all__)
    assert set(sv.__all__) <= set(dir(sv))
    with pytest.raises(AttributeError, match="'servoctl' has no attribute 'dervie'"):
        sv.dervie  # noqa: B018


def test_type_checkers_see_the_public_names():
    """The stub, executed, binds the objects that the package gives on use, and no others."""
    seen = {}
    exec(PACKAGE.joinpath("__init__.pyi").read_text(encoding="utf-8"), seen)
    public = {name: thing for name, thing in seen.items() if name not in ("__builtins__", "__doc__")}
    assert set(public) == {*sv.__all__, "__version__"}
    assert [name for name, thing in public.items() if getattr(sv, name) is not thing] == []


def test_importing_a_module_hides_no_public_name():
    """Importing servoctl.x sets the attribute x of the package, in place of a function of that name."""
    for package in (sv, import_module("servoctl.gallery")):
        modules = {path.stem for path in Path(package.__file__).parent.iterdir()}
        named = {name for name in package.__all__ if not isinstance(getattr(package, name), ModuleType)}
        assert modules & named == set()


def public():
    """(name, object) of all functions, classes, methods and properties that `servoctl.__all__` leads to."""
    for name in sv.__all__:
        thing = getattr(sv, name)
        if isinstance(thing, ModuleType):
            own = [n for n, f in vars(thing).items() if getattr(f, "__module__", "") == thing.__name__ and n[0] != "_"]
            inside = [(n, getattr(thing, n)) for n in getattr(thing, "__all__", own)]
            things = [(n if name in FAMILIES else f"{name}.{n}", f) for n, f in inside if callable(f)]
        else:
            things = [(name, thing)]
        yield from things
        for label, owner in things if not isinstance(thing, ModuleType) or name in FAMILIES else ():
            if inspect.isclass(owner):
                for n, member in vars(owner).items():
                    if not n.startswith("_") and (callable(member) or isinstance(member, property)):
                        yield f"{label}.{n}", member


PUBLIC = dict(public())


def begins_with_a_sentence(text):
    first = text.split("\n\n")[0]
    return first.endswith((".", ":")) and first[0] == first[0].upper() or first[:1] in tuple("qwrγφ")


def test_public_names_are_documented():
    assert [name for name, thing in PUBLIC.items() if not begins_with_a_sentence(inspect.getdoc(thing) or " ")] == []


def documented(text):
    """Names in front of ' : ' and names alone on their line, in a numpydoc docstring; `a, b : float` has two."""
    names = set()
    for line in text.splitlines():
        found = re.match(r"(\*{0,2}\w+(?:, \*{0,2}\w+)*)(?: : |$)", line)
        if found:
            names |= {n.strip().lstrip("*") for n in found[1].split(",")}
    return names


def parameters(thing):
    """Parameter names that a user may pass: none of a class that the toolkit alone makes, or that inherits its own."""
    if isinstance(thing, property):
        return []
    if inspect.isclass(thing) and ("__init__" not in vars(thing) or re.search("[Mm]ade by `", inspect.getdoc(thing))):
        return []
    names = inspect.signature(thing).parameters
    return [n for n in names if n not in ("self", "cls") and not n.startswith("_")]


def undocumented(thing):
    wanted, text = parameters(thing), inspect.getdoc(thing) or ""
    first = text.split("\n\n")[0]
    said = [n for n in wanted if len(wanted) == 1 and re.search(rf"\b{n}\b", first)]  # "symbols of γ^(k), k >= 1"
    return [n for n in wanted if n not in documented(text) and n not in said]


def test_every_parameter_is_documented():
    assert {name: missing for name, thing in PUBLIC.items() if (missing := undocumented(thing))} == {}


# reprs ---------------------------------------------------------------------------------------------------------------


def short(value):
    lines = repr(value).splitlines()
    assert 1 <= len(lines) <= MOST_IN_A_REPR
    assert all(line.strip() for line in lines)
    assert not re.search(r"\bSX\b|object at 0x|@\d+=", repr(value)), "no expressions and no addresses"
    return True


def test_specifications_print_in_eight_lines():
    for scene in gallery.values():
        mechanism, program = scene.build()
        assert short(mechanism) and short(program) and short(mechanism.q) and short(mechanism.parameters)


@pytest.mark.parametrize("name", ["crane-3d", "vtol-centre", "constant-speed-horizontal"])
def test_models_runs_and_verifications_print_in_eight_lines(name, gallery_model):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(**scene.start, guess=scene.guess)
    run = sv.simulate(model, start, (0.0, 0.1), t_eval=[0.0, 0.02, 0.04, 0.06, 0.08, 0.1])
    assert short(start) and short(run) and short(sv.verify(run, segments=1))
    assert short(model) and short(model.structure())


@pytest.fixture(scope="module")
def large():
    """The plan of 24 masses, each with a motor, which stand still but for the first; its outputs are their places."""
    q = sv.coordinates(" ".join(f"place{i}" for i in range(24)), units="m " * 24)
    mechanism = sv.Mechanism(
        q, gibbs=sum(sv.particle(q, 2.0, x) for x in q), actuators={f"motor{i}": x for i, x in enumerate(q)},
        outputs={f"output{i}": x + 1.0 for i, x in enumerate(q)},
    )  # fmt: skip
    moved = q.references(moved=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0)).moved
    program = sv.Program({f"residual{i}": x - moved * (i == 0) for i, x in enumerate(q)})
    model = sv.derive(mechanism, program)
    return sv.simulate(model, model.start(), (0.0, 1.0), t_eval=np.linspace(0.0, 1.0, 21))


def test_the_lists_of_a_large_model_are_shortened(large):
    lines = repr(large.model).splitlines()
    assert max(map(len, lines)) <= 118 and len(lines[0]) > 90 and lines[0].count(" more") == 3
    assert all(f"{what}{i}" in large.model.details for what in ("place", "residual", "motor") for i in range(24))


def test_signals_beyond_eight_lines_are_counted(large):
    lines = repr(large).splitlines()
    assert len(lines) == MOST_IN_A_REPR and lines[-1] == f"  and {2 + 48 - 7} more in .details"
    assert all(f"  {what}{i}: " in large.details for what in ("motor", "output") for i in range(24))


def test_rounding_is_not_printed_as_a_value(large):
    """A motor that has nothing to do has the force 0, and no instant of its greatest force but in the details."""
    motors = {name: large[name] for name in large.model.actuators}
    run = replace(large, stored={**motors, "motor1": 2e-16 * np.sin(9 * large.t)})
    assert "  motor1: 0 N throughout" in repr(run) and "e-16 N" not in repr(run)
    (shown,) = (line for line in run.details.splitlines() if line.startswith("  motor1: -"))
    assert shown.count("e-16 N (t = ") == 2


def test_what_a_model_holds_prints_in_eight_lines(gallery_model):
    reduction = gallery_model("overhead-crane").reduction
    for value in (reduction.rank, reduction.rows[0], reduction.hidden[0], reduction.realisation, reduction):
        assert short(value)


def test_a_large_specification_prints_in_eight_lines():
    q = sv.coordinates(" ".join(f"x{i}" for i in range(60)))
    p = sv.parameters(**{f"m{i}": 1.0 + i for i in range(60)})
    S = sum(sv.particle(q, m, x) for m, x in zip(p.symbols, q, strict=True))
    mechanism = sv.Mechanism(
        q, gibbs=S, parameters=p,
        actuators={f"motor{i}": x for i, x in enumerate(q)},
        constraints={f"tie{i}": a - b for i, (a, b) in enumerate(zip(list(q)[:20], list(q)[20:], strict=False))},
        outputs={f"output{i}": x for i, x in enumerate(q)},
    )  # fmt: skip
    program = sv.Program({f"residual{i}": x - ca.sin(q.t) for i, x in enumerate(q)})
    for value in (q, p, mechanism, program):
        assert short(value)


@pytest.mark.parametrize("value", [sv.methods.Project(), sv.methods.Poles(0.1), sv.methods.Poles({"X": (-1.0, -2.0)}), gallery["vtol"]])
def test_small_values_print_in_eight_lines(value):
    assert short(value)
    assert short(str(value))


# layers and imports --------------------------------------------------------------------------------------------------


def test_modules_belong_to_a_layer():
    assert [relative(path) for path in LAYERED if layer(path) not in LAYERS] == []


def upward(path):
    """Imports of a file from a layer above its own; the shell and the gallery alone import the whole package."""
    here, shows = LAYERS.index(layer(path)), layer(path) in ("shell", "gallery")
    for module in imports(path):
        first, *rest = module.split(".")
        if first != "servoctl" or (rest and rest[0] not in LAYERS):
            continue
        above = LAYERS.index(rest[0]) > here if rest else not shows
        seen = rest[:1] != ["gallery"] or shows
        if above or not seen or (layer(path) == "gallery" and rest and rest[0] not in ("errors", "spec", "gallery")):
            yield module


def test_imports_point_towards_the_specification():
    assert offenders(lambda path: list(upward(path)), LAYERED) == {}


def test_casadi_stays_where_equations_are_made():
    files = [path for path in LAYERED if layer(path) in WITHOUT_CASADI]
    assert offenders(lambda path: [m for m in imports(path) if m.split(".")[0] == "casadi"], files) == {}


def imported_at_once(path):
    """Packages that a file imports outside its functions."""
    top = [node for node in parsed(path).body if isinstance(node, ast.Import | ast.ImportFrom)]
    names = [a.name for node in top if isinstance(node, ast.Import) for a in node.names]
    names += [node.module for node in top if isinstance(node, ast.ImportFrom)]
    return {name.split(".")[0] for name in names}


def test_optional_and_heavy_packages_are_imported_where_they_are_used():
    assert offenders(lambda path: imported_at_once(path) & set(LATE)) == {}


def loaded(script, names, **environment):
    """Those of some modules that a new process has imported after a script."""
    program = f"{script}\nimport sys\nprint([name for name in {names!r} if name in sys.modules], file=sys.stderr)"
    command, environment = [sys.executable, "-c", program], {**os.environ, **environment}
    done = subprocess.run(command, capture_output=True, text=True, cwd=PACKAGE.parent, env=environment)
    assert done.returncode == 0, done.stderr
    return ast.literal_eval(done.stderr.splitlines()[-1])


LIGHT = """
from servoctl.shell.main import main
try:
    main([%r])
except SystemExit:
    pass
"""


@pytest.mark.parametrize("script", ["import servoctl", LIGHT % "list", LIGHT % "--version", LIGHT % "--help"])
def test_what_needs_no_equations_imports_no_numpy(script):
    own = [module_name(path) for path in FILES if layer(path) in LAYERS and layer(path) not in ("gallery", "shell")]
    assert set(loaded(script, ("numpy", "casadi", *LATE, *SWEEPS, *own))) <= {"servoctl.errors", "servoctl.version"}


def test_public_names_load_no_heavy_package():
    assert loaded("import servoctl\nfor name in servoctl.__all__: getattr(servoctl, name)", LATE) == []


def test_a_plan_loads_what_it_needs(tmp_path):
    """A determined motion is continued by Newton's iteration: neither SciPy nor what laws and sweeps need.

    A second process neither compiles nor writes files, and refuses nothing.
    """
    script = """
import servoctl as sv
from servoctl.gallery import gallery
scene = gallery["overhead-crane"]
model = sv.derive(*scene.build())
run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span)
run["trolley"]
print(model)
"""
    laws = [module_name(path) for path in FILES if layer(path) in ("control", "study", "inversion", "figures", "interop")]
    kept = {"SERVOCTL_MEMO": "", "SERVOCTL_CACHE": str(tmp_path)}
    assert loaded(script, (*LATE, *SWEEPS, *laws), **kept) == []  # derives
    unused = "numpy.ma", "subprocess", "tempfile", "difflib", "fractions", "zipfile", "importlib.resources"
    assert loaded(script, (*LATE, *SWEEPS, *laws, *unused), **kept) == []


# sizes ---------------------------------------------------------------------------------------------------------------


def functions(path):
    """(qualified name, node) of all functions of a file."""

    def inside(node, prefix):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                name = f"{prefix}{child.name}"
                if not isinstance(child, ast.ClassDef):
                    yield name, child
                yield from inside(child, f"{name}.")
            else:
                yield from inside(child, prefix)

    return inside(parsed(path), "")


def size(node):
    """Lines of a function without its docstring; what is defined inside counts, too."""
    statements = node.body[ast.get_docstring(node) is not None :]
    return node.end_lineno - statements[0].lineno + 1 if statements else 0


def test_functions_can_be_read_at_once():
    assert offenders(lambda path: [name for name, node in functions(path) if size(node) > MOST_IN_A_FUNCTION]) == {}


def arguments(node):
    a = node.args
    names = [arg.arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg) if arg is not None]
    return [n for n in names if n not in ("self", "cls")]


def test_functions_have_few_parameters():
    """Options that belong together travel as one value."""
    many = lambda name, node: len(arguments(node)) > MOST_PARAMETERS and name not in SHEETS  # noqa: E731
    assert offenders(lambda path: [name for name, node in functions(path) if many(name, node)]) == {}


def defined(path):
    """Public names that a module defines: functions, classes, constants."""
    for node in parsed(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name))


def test_no_name_is_defined_in_three_modules():
    homes = {}
    for path in FILES:
        for name in {n for n in defined(path) if not n.startswith("__")}:
            homes.setdefault(name, []).append(relative(path))
    assert {name: places for name, places in homes.items() if len(places) > MOST_MODULES_OF_A_NAME} == {}


def module_name(path):
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def names_imported(path):
    """All that a file imports, `from servoctl.control import batch` as servoctl.control and servoctl.control.batch."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def circles(graph):
    """Modules that reach themselves."""

    def reached(name):
        seen, waiting = set(), list(graph[name])
        while waiting:
            if (found := waiting.pop()) not in seen:
                seen.add(found)
                waiting.extend(graph[found])
        return seen

    return sorted(name for name in graph if name in reached(name))


def test_no_import_runs_in_a_circle():
    """Function-level imports count. A package that gathers its own modules is not imported by them."""
    files = {module_name(path): path for path in FILES}
    graph = {name: {m for m in names_imported(path) if m in files} for name, path in files.items()}
    for name, found in graph.items():  # `from package import module` needs the module, not what the package gathers
        packages = {m for m in found if any(other.startswith(f"{m}.") for other in found)}
        graph[name] = {m for m in found - packages if m != name}
    assert circles(graph) == []
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]


def test_every_room_is_in_the_documents():
    rooms = {layer(path) for path in FILES if relative(path) not in ENTRIES}
    root = PACKAGE.parent
    for page, opening in (("CONTRIBUTING.md", "## Layout"), ("docs/architecture.md", "| part |")):
        text = (root / page).read_text(encoding="utf-8")
        words = set(re.findall(r"\w+", text[text.index(opening) :].split("\n## ")[0]))
        assert rooms - words == set(), page


def test_nothing_is_left_open():
    assert offenders(lambda path: re.findall(r"\b(?:TODO|FIXME|XXX|NotImplementedError)\b", path.read_text(encoding="utf-8"))) == {}


def test_the_linter_finds_nothing():
    needs("ruff")
    found = subprocess.run([sys.executable, "-m", "ruff", "check", Path(__file__).parent.parent], capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr
