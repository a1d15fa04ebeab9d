"""What the package weighs, against LIMITS.toml: a limit rises only by what a change needs and says, and falls with it."""

import ast
import json
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import servoctl as sv

PACKAGE = Path(sv.__file__).parent
ROOT = PACKAGE.parent
BELOW = 0.01  # part of a limit, by which the package may be lighter before the limit is lowered
PLAIN = {0, 1, 2, 3, 4, 0.5}  # numbers that decide nothing by themselves
LIMITS = dict(re.findall(r"^(\w+) = (\d+)", (ROOT / "LIMITS.toml").read_text(encoding="utf-8"), re.M))
TRACED = """
import json, sys
import servoctl as sv
from servoctl.gallery import gallery

scene, entered = gallery["overhead-crane"], []
mechanism, program = scene.build()
imported = [getattr(sv, name) for name in sv.__all__]

def note(frame, event, argument):
    if event == "call" and frame.f_code.co_name != "<module>":
        entered.append(frame.f_code.co_filename)

sys.setprofile(note)
model = sv.derive(mechanism, program)
run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span, progress=False)
force = run["trolley"]
sys.setprofile(None)
print(json.dumps(entered))
"""


@cache
def nodes():
    """All nodes of the package's syntax trees, with whether they are a scene's."""
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}
    return [(node, "gallery" in path.parts) for path, tree in trees.items() for node in ast.walk(tree)]


def statements():
    return sum(isinstance(node, ast.stmt) for node, _ in nodes())


def is_number(node):
    """Whether an expression is made of numbers alone."""
    if isinstance(node, ast.Constant):
        return type(node.value) in (int, float)
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    return isinstance(node, ast.BinOp) and is_number(node.left) and is_number(node.right)


def tells(node):
    """Whether it is a number other than the plain ones."""
    return is_number(node) and any(isinstance(n, ast.Constant) and abs(n.value) not in PLAIN for n in ast.walk(node))


def assigned(body):
    """Names and values of assignments, those of tuples one by one."""
    for line in body:
        targets = getattr(line, "targets", [line.target] if isinstance(line, ast.AnnAssign) else [])
        for target in targets if getattr(line, "value", None) is not None else []:
            tuples = isinstance(target, ast.Tuple) and isinstance(line.value, ast.Tuple)
            pairs = zip(target.elts, line.value.elts, strict=True) if tuples else [(target, line.value)]
            yield from ((name.id, value) for name, value in pairs if isinstance(name, ast.Name) and is_number(value))


def deciding(node):
    """How many numbers that decide a node of a syntax tree has of its own."""
    if isinstance(node, ast.Module):
        return sum(name.isupper() or tells(value) for name, value in assigned(node.body))
    if isinstance(node, ast.ClassDef):
        return sum(tells(value) for _, value in assigned(node.body))
    if isinstance(node, ast.Compare):
        return sum(isinstance(n, ast.Constant) and tells(n) for n in ast.walk(node))
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return sum(map(tells, [*node.args.defaults, *filter(None, node.args.kw_defaults)]))
    return 0


def numbers_that_decide():
    """Constants of modules, fields of classes, literals in comparisons, defaults; those of scenes are data."""
    return sum(deciding(node) for node, scene in nodes() if not scene)


def lines_of_c():
    files = [path for kind in ("*.c", "*.h") for path in PACKAGE.rglob(kind)]
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)


def names_at_the_top():
    return len(sv.__all__)


@cache
def files_entered():
    """The files that a reader opens who follows the crane from its specification to the first force of the plan."""
    environment = os.environ | {"SERVOCTL_MEMO": "none", "SERVOCTL_COMPILER": "none", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", TRACED], env=environment, capture_output=True, text=True, check=True)
    entered = [Path(name) for name in dict.fromkeys(json.loads(done.stdout)) if name.startswith(str(PACKAGE))]
    return [path.relative_to(PACKAGE).as_posix() for path in entered if path.name != "__init__.py"]


def files_to_the_first_force():
    return len(files_entered())


@pytest.mark.parametrize(
    "weighed", [statements, numbers_that_decide, lines_of_c, names_at_the_top, files_to_the_first_force]
)
def test_the_package_weighs_what_its_limits_say(weighed):
    limit, found = int(LIMITS[weighed.__name__]), weighed()
    assert found <= limit, f"{found} where {limit} are granted: take something away"
    assert found >= (1 - BELOW) * limit, f"{found}: lower the limit {limit} in LIMITS.toml"


def test_from_a_specification_to_the_first_force_nothing_is_emitted():
    names = files_entered()
    assert names[0] == "model/model.py" and "reduction/reduce.py" in names[:7] and names[-1] == "run.py"
    assert not {"codegen/emit.py", "codegen/compiler.py"} & set(names), "nothing is emitted where nothing is compiled"
