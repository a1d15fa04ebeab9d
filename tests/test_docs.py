"""The documentation site: every page has its place, every public name is in the reference once, commands are valid."""

import contextlib
import json
import re
import runpy
import shlex
from importlib import import_module
from pathlib import Path

import pytest
from conftest import needs

import servoctl as sv
import servoctl.shell.main as shell
from servoctl import gallery

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
REFERENCE = sorted((DOCS / "reference").glob("*.md"))
COMMANDS = [
    (page.name, line.strip())
    for page in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
    for line in re.findall(r"^    (servoctl .*)$", page.read_text(encoding="utf-8"), re.M)
]
FAMILIES = ("errors", "methods", "types")  # modules of public classes


def contents(page):
    """Pages in the tables of contents of a page."""
    tables = re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    return sorted(line for table in tables for line in table.splitlines() if line and not line.startswith(":"))


def test_every_block_is_executed_or_printed_by_a_test():
    """Python by test_readme, C by test_export_c and test_export_law, other processes by test_sweep, other tools below, commands by .ci/run."""
    elsewhere = {"c_export.md": {"c", "cpp"}, "sweeps.md": {"py"}, "ten_lines.md": {"py", "modelica"}}
    elsewhere |= dict.fromkeys(("README.md", "index.md"), {"sh"})
    for page in [ROOT / "README.md", *DOCS.glob("*.md")]:
        kinds = set(re.findall(r"^```(\w+)", page.read_text(encoding="utf-8"), re.M))
        assert kinds - elsewhere.get(page.name, set()) <= {"python", "text"}, page.name


def test_a_notebook_is_a_page_with_its_outputs(tmp_path):
    picture, code = {"image/png": "AAEC\n", "text/plain": ["<Figure>"]}, {"cell_type": "code", "source": ["a = 1\n", "a"]}
    printed = [{"output_type": "stream", "text": ["one\n", "two\n"]}, {"data": picture}, {"data": picture}, {"text": []}]
    cells = [{"cell_type": "markdown", "source": ["# Title"]}, {**code, "outputs": printed}]
    (tmp_path / "name.ipynb").write_text(json.dumps({"cells": cells}), encoding="utf-8")
    page = runpy.run_path(str(DOCS / "conf.py"))["as_page"](tmp_path / "name.ipynb", tmp_path)
    shown = re.findall(r"!\[[^]]*\]\((.*?)\)", page)
    assert len(set(shown)) == 2 and all((tmp_path / name).read_bytes() == b"\0\1\2" for name in shown)
    assert page.startswith("# Title\n\n```python\na = 1\na\n```\n\n```text\none\ntwo\n```\n\n![")


def directive(thing):
    """The directive of Sphinx that documents an object."""
    if isinstance(thing, type):
        return "exception" if issubclass(thing, Exception) else "class"
    return type(thing).__name__


def test_every_page_is_in_a_table_of_contents_once():
    pages = [page.stem for page in DOCS.glob("*.md") if page.stem != "index"]
    assert contents(DOCS / "index.md") == sorted([*pages, "notebooks/*", "reference/index"])
    assert contents(DOCS / "reference" / "index.md") == [page.stem for page in REFERENCE if page.stem != "index"]


def test_the_reference_has_every_public_name_once():
    text = "".join(page.read_text(encoding="utf-8") for page in REFERENCE)
    listed = re.findall(r"^\.\. auto(\w+):: servoctl\.((?:\w+\.)?[A-Z]\w+|\w+)$", text, re.M)
    things = {name: getattr(sv, name) for name in sv.__all__ if name not in FAMILIES} | {"gallery": gallery}
    for family in FAMILIES:
        things |= {f"{family}.{name}": getattr(getattr(sv, family), name) for name in getattr(sv, family).__all__}
    assert sorted(name for _, name in listed) == sorted(things)
    assert [name for kind, name in listed if kind != directive(things[name])] == []


@pytest.mark.parametrize("page", REFERENCE, ids=lambda page: page.stem)
def test_links_of_the_reference_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8"))
    assert all((page.parent / target).exists() for target in targets)


@pytest.mark.parametrize("page, command", COMMANDS, ids=lambda text: text)
def test_the_shell_commands_of_the_pages_are_valid(page, command):
    name, *arguments = shlex.split(command)
    shell._parser(arguments).parse_args(arguments)


TOOLS = {
    "servoctl": "servoctl",
    "SciPy": "scipy",
    "SymPy": "sympy.physics.mechanics",
    "Pinocchio": "pinocchio",
    "Drake": "pydrake.all",
    "MuJoCo": "mujoco",
    "python-control": "control",
}
TEN_LINES = (DOCS / "ten_lines.md").read_text(encoding="utf-8")


def column(tool):
    """Names in code in the cells of a tool, in all tables that have it as a heading."""
    for block in re.findall(r"(?:^\|.*\n)+", (DOCS / "names_elsewhere.md").read_text(encoding="utf-8"), re.M):
        rows = [[cell.strip() for cell in line.strip("|\n ").split("|")] for line in block.splitlines()]
        if tool in rows[0]:
            yield from (name for row in rows[2:] for name in re.findall("`([^`]+)`", row[rows[0].index(tool)]))


def exists(module, name):
    """Whether a module leads to a dotted name; modules within it are imported."""
    for part in name.split("."):
        if not hasattr(module, part):
            with contextlib.suppress(ImportError):
                import_module(f"{module.__name__}.{part}")
        if not hasattr(module, part):
            return False
        module = getattr(module, part)
    return True


@pytest.mark.parametrize("tool", TOOLS)
def test_the_names_of_each_tool_exist(tool):
    module = needs(TOOLS[tool])
    names = list(column(tool))
    assert len(names) > 9
    assert [name for name in names if not exists(module, name)] == []


@pytest.mark.parametrize("tool", ["SymPy", "Pinocchio", "MuJoCo", "Drake"])
def test_each_tool_prints_the_same_line(tool, capsys):
    needs(TOOLS[tool])
    by_hand = re.findall(r"```python\n(.*?)```", TEN_LINES, re.S)[1]
    block = re.search(rf"^## {tool}\n\n```py\n(.*?)```", TEN_LINES, re.M | re.S)[1]
    exec(by_hand + block, {})
    assert capsys.readouterr().out == re.search(r"```text\n(.*?)```", TEN_LINES, re.S)[1]
