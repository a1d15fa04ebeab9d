"""The gallery in docs: its pages have the code, the facts, the number and what is printed of each scene; pictures."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from gallery_numbers import ENDS, NUMBERS, quoted

from servoctl.gallery import gallery

DOCS = Path(__file__).parents[1] / "docs"
WRITER = runpy.run_path(str(DOCS / "figures" / "gallery.py"))
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]\d+)?")
ROUNDING = re.compile(r"  (operations|watched|nfev|iterations|.*largest residual)")  # lines that rounding decides
SMALL = re.compile(r"\d\.\de[-+]\d+|\(t = [^)]*\)")  # errors, and instants of extrema, which may be flat


def told(page):
    """Words of each line, and its numbers."""
    lines = [SMALL.sub("#", line) for line in page.splitlines() if not ROUNDING.match(line)]
    return [NUMBER.sub("#", line) for line in lines], [np.array(NUMBER.findall(line), float) for line in lines]


@pytest.mark.parametrize("name", gallery)
@pytest.mark.usefixtures("uncompiled")
def test_the_page_of_a_scene_is_what_its_code_says_and_prints(name):
    written, run = WRITER["scene_page"](name)
    (words, numbers), (shown, stored) = told(written), told((DOCS / "gallery" / f"{name}.md").read_text(encoding="utf-8"))
    assert words == shown
    for found, expected in zip(numbers, stored, strict=True):
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-3 * max(abs(expected), default=0.0))
    assert ("Verification: passed" in written) == (name not in ENDS)
    if name not in ENDS:
        with np.errstate(all="ignore"):
            measured, number = NUMBERS[name](run)
        assert measured == pytest.approx(number, rel=2e-5) and quoted(name, number)


def test_the_page_of_the_gallery_leads_to_every_scene():
    assert WRITER["page"]() == (DOCS / "gallery.md").read_text(encoding="utf-8")
    assert {path.stem for path in (DOCS / "gallery").glob("*.md")} == set(gallery)


@pytest.mark.parametrize("kind", ["PICTURES", "SIGNALS"])
def test_every_scene_has_small_pictures(kind):
    sizes = {path.stem: path.stat().st_size for path in WRITER[kind].glob("*.png")}
    assert set(sizes) == set(gallery) and max(sizes.values()) < 30_000


def test_a_scene_is_drawn_again(tmp_path):
    _, run = WRITER["scene_page"]("two-cars")
    WRITER["draw"]("two-cars", run, tmp_path, tmp_path / "signals")
    for drawn, folder in ((tmp_path, "PICTURES"), (tmp_path / "signals", "SIGNALS")):
        sizes = [(where / "two-cars.png").stat().st_size for where in (drawn, WRITER[folder])]
        assert sizes[0] == pytest.approx(sizes[1], rel=0.5)


def test_facts_tell_programs_from_material_constraints():
    rows = {name: (DOCS / "gallery" / f"{name}.md").read_text(encoding="utf-8").split("---|\n")[1].split("\n")[0] for name in gallery}
    assert rows["crane-3d-redundant"] == "| 0, 0, 0 + 0 | 2 | 5 | 0 |" and rows["spiral"] == "| 3 | 0 | - | 5 |"
