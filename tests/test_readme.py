"""README and docs: what they show is what happens, tables are what the models say, links lead somewhere."""

import contextlib
import io
import re
import runpy
from functools import partial
from math import pi
from pathlib import Path

import pytest
from conftest import needs

import servoctl as sv
from servoctl.gallery import cars, crane_3d, mass_on_car, overhead_crane, passive_arm, vtol

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SYSTEMS = {
    "two cars": cars,
    "three cars": partial(cars, 3),
    "planar crane": overhead_crane,
    "3-D crane": crane_3d,
    "mass on car, 0°, no damper": partial(mass_on_car, 0.0, 0.0),
    "mass on car, 0°, damper": partial(mass_on_car, 0.0, 1.0),
    "mass on car, 45°": partial(mass_on_car, pi / 4),
    "aircraft, centre of mass": partial(vtol, "centre"),
    "aircraft, flat point": vtol,
    "passive-joint arm": passive_arm,
}

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.S)


def table(page, first):
    """Rows of the table whose first heading is `first`: {first cell: other cells}."""
    lines = page.read_text(encoding="utf-8").split(f"| {first} |")[1].split("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("| ").split("|")] for line in lines]
    return {row[0]: row[1:] for row in cells}


def listed(values):
    return ", ".join(map(str, values))


def settled(text):
    """A printed report without what depends on rounding or on how functions are compiled."""
    text = re.sub(r"\d\.\de[+-]\d+", "#", text)
    return [line for line in text.splitlines() if not re.match(r"  (operations|watched|nfev|iterations|.*largest residual)", line)]


@pages
def test_python_blocks_execute_and_print_what_is_shown(page, tmp_path, monkeypatch, as_shipped):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    shown, printed, names = blocks(page, "text"), io.StringIO(), {}
    with contextlib.redirect_stdout(printed):
        for block in blocks(page, "python"):
            for module in re.findall(r"^ *(?:import|from) (\w+)", block, re.M):
                needs(module)
            exec(compile(block, page.name, "exec"), names)
    assert settled(printed.getvalue()) == settled("".join(shown))


def test_the_readme_has_two_commands_and_shows_python():
    assert [("servoctl run" in c, "pytest" in c) for c in blocks(PAGES[0], "sh")] == [(True, False), (False, True)]
    assert blocks(PAGES[0], "python")


@pages
def test_links_and_named_files_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert (page.parent / target).exists(), target
    for name in re.findall(r"`((?:docs|examples|notebooks|tests)/[\w./]*|[\w/]+\.(?:md|cff|ipynb|py))`", text):
        places = (page.parent, ROOT, ROOT / "docs", ROOT / "tests", ROOT / "notebooks")
        assert any((place / name).exists() for place in places), name


def test_the_picture_of_the_parts_is_drawn_from_the_sources(tmp_path):
    drawing = runpy.run_path(str(ROOT / "docs" / "figures" / "parts.py"))
    lines, imports = drawing["parts"]()
    assert imports["errors"] == set() and "spec" in imports["reduction"] and lines["spec"] > 500
    floor = drawing["heights"](imports)
    assert floor["errors"] == 0 < floor["spec"] < floor["reduction"] < floor["control"]
    assert all(below not in imports[other] for name, found in drawing["direct"](imports).items()
               for below in found for other in found - {below})  # fmt: skip
    drawing["draw"].__globals__["TRIES"] = 10
    drawing["draw"](tmp_path / "parts.png")
    assert (tmp_path / "parts.png").stat().st_size > 1000


def test_functions_named_in_the_table_of_equations_exist():
    for cells in table(ROOT / "docs" / "paper.md", "equation").values():
        for name in re.findall(r"`([A-Za-z_.]+)`", cells[1]):
            thing = sv
            for part in name.removeprefix("servoctl.").split("."):
                thing = getattr(thing, part)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_table_of_the_theory_is_what_the_models_say(name):
    rows = table(ROOT / "docs" / "theory.md", "system")
    assert set(rows) == set(SYSTEMS)
    model = sv.derive(*SYSTEMS[name]())
    s = model.structure()
    assert rows[name] == [
        listed(row.order for row in model.reduction.rows),
        listed(s.relative_degree),
        f"{s.decoupling_rank} of {len(s.residuals)}",
        listed(s.zeros_at_infinity),
        listed(s.essential_orders),
        str(s.index),
    ]
