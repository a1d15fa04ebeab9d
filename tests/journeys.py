"""What the project's own journeys execute of the package, in percent of the statements of functions; by hand, an hour.

    python tests/journeys.py [J1 J2 J3 J4 J5]

The journeys are J1, the README's blocks and its first command; J2, `servoctl run` of every scene; J3, examples and
notebooks; J4, the Python blocks and the commands of the pages; J5, every command with its options, and mistyped ones.
Statements of a block that raises are refusals, and do not count.
"""

import ast
import contextlib
import io
import json
import os
import re
import runpy
import shlex
import sys
import tempfile
from functools import partial
from pathlib import Path

os.environ["SERVOCTL_MEMO"] = "none"  # what was derived before would not be entered

import coverage

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "servoctl"
METHODS = "Taylor", "RadauIIA", "RK4", "RK8", "RK45", "DOP853", "Radau", "LSODA", "bounded"
OPTIONS = (  # of J5, beside the commands of the pages
    *(f"run cart-pole --method {method} --no-figures" for method in METHODS),
    *(f"run mass-on-car --drift {drift} --no-figures" for drift in ("none", "project", "0.1")),
    *(f"run overhead-crane --law {law} --rate 200 --delay 1 --no-figures" for law in ("lqr", "computed", "feedforward")),
    "run overhead-crane --integral --noise x=1e-3 --seed 1 --limit trolley=-200:200 --machine m_load=110 --no-figures",
    "run overhead-crane --accuracy 1e-6 --samples 51 --verbose --animate",
    "run pendubot --t-span 0 1 --hold q2=0.1 --guess dq2=0.1 --no-loop --no-verify",
    "list",
    "list --long",
    "report overhead-crane --verbose",
    "report overhead-crane-run",
    "tradeoff mass-on-car --out tradeoff",
    "export-c overhead-crane --out c --set m_load=90",
    "cache",
    "versions",
    "run overhead-crain",
    "run overhead-crane --method tailor",
    "run overhead-crane --set m_lode=1",
    "run overhead-crane --limit trolley",
    "run overhead-crane --hold x=much",
    "reprot overhead-crane",
    "run nowhere.py",
    "run",
)


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.S)


def commands(page):
    """What a page says after `servoctl`, in blocks of commands and in indented lines."""
    lines = "\n".join([*blocks(page, "sh"), *re.findall(r"^ {4}(.*)$", page.read_text(encoding="utf-8"), re.M)])
    return re.findall(r"(?:^|&& )(?:\S*/)?servoctl (.*)$", lines, re.M)


def run_blocks(page):
    names = {"__name__": page.stem}
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), names)


def run_cells(notebook):
    names = {"__name__": notebook.stem}
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        code = "".join(cell["source"])
        if cell["cell_type"] == "code" and not code.lstrip().startswith("%"):
            exec(compile(code, notebook.name, "exec"), names)


def run_example(path):
    runpy.run_path(str(path))["main"](fast=True)


def command(line):
    from servoctl.shell.main import main

    with contextlib.suppress(SystemExit):
        main(shlex.split(line, comments=True))


def journeys():
    """{journey: [(name, function without arguments)]}."""
    from servoctl.gallery import gallery

    readme, pages = ROOT / "README.md", sorted((ROOT / "docs").glob("*.md"))
    scenes = [f"run {name} --all-figures --out {name}" for name in gallery]
    examples, notebooks = sorted((ROOT / "examples").glob("*.py")), sorted((ROOT / "notebooks").glob("*.ipynb"))

    def of(function, things):
        return [(getattr(thing, "name", thing), partial(function, thing)) for thing in things]

    return {
        "J1": of(run_blocks, [readme]) + of(command, commands(readme)),
        "J2": of(command, scenes),
        "J3": of(run_example, examples) + of(run_cells, notebooks),
        "J4": of(run_blocks, pages) + of(command, [line for page in pages for line in commands(page)]),
        "J5": of(command, OPTIONS),
    }


def travelled(wanted):
    """Run journeys; returns the lines that were executed, by file. What ends with an error is told, and goes on."""
    import matplotlib

    matplotlib.use("Agg")
    measured = coverage.Coverage(data_file=None, source_pkgs=["servoctl"], config_file=False)
    sys.path[:0] = str(ROOT), str(ROOT / "examples")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder) / "work"  # beside which notebooks find the examples, and in which pages do
        work.mkdir()
        for place in (Path(folder), work):
            (place / "examples").symlink_to(ROOT / "examples")
        os.chdir(work)
        measured.start()
        for journey, steps in journeys().items():
            for name, step in steps if journey in wanted else ():
                printed = io.StringIO()
                try:
                    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                        step()
                    print(f"{journey} {name}", flush=True)
                except Exception as error:
                    print(f"{journey} {name}: {type(error).__name__}: {error}"[:300], flush=True)
        measured.stop()
        os.chdir(ROOT)
    data = measured.get_data()
    return {Path(file): set(data.lines(file)) for file in data.measured_files()}


def counted(path):
    """The lines on which statements of a file's functions begin, but for docstrings and blocks that raise, as a set."""
    found = set()

    def visit(body, function, block):
        if block and isinstance(body[-1], ast.Raise):
            return
        for node in body:
            inner = isinstance(node, ast.FunctionDef)
            docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
            if function and not inner and not docstring:
                found.add(node.lineno)
            parts = [getattr(node, name, []) for name in ("body", "orelse", "finalbody")]
            parts += [part.body for part in (*getattr(node, "handlers", ()), *getattr(node, "cases", ()))]
            for part in filter(None, parts):
                visit(part, function or inner, not inner and not isinstance(node, ast.ClassDef))

    visit(ast.parse(path.read_text(encoding="utf-8")).body, False, False)
    return found


def main():
    wanted = sys.argv[1:] or ["J1", "J2", "J3", "J4", "J5"]
    entered, parts = travelled(wanted), {}
    for path in sorted(PACKAGE.rglob("*.py")):
        statements = counted(path)
        part = parts.setdefault(path.relative_to(PACKAGE).parts[0], [0, 0])
        part[0] += len(statements)
        part[1] += len(statements & entered.get(path, set()))
    for part, (all_, some) in sorted(parts.items(), key=lambda item: -item[1][0]):
        if all_:
            print(f"{part:20}{all_:7}{some:7}{100 * some / all_:6.1f} %")
    all_, some = (sum(column) for column in zip(*parts.values(), strict=True))
    print(f"{'all':20}{all_:7}{some:7}{100 * some / all_:6.1f} %")


if __name__ == "__main__":
    main()
