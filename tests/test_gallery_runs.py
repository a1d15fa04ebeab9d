"""`servoctl run` of each scene of the gallery: its exit code, its files, and figures that can be read."""

import json

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from readable import faults
from scenes import KINDS

from servoctl.markup import MOST_LINES
from servoctl.shell.main import main

ENDS_EARLY = ("appell-hamel-squared",)  # at the singularity that its description names
SHOWN = (*KINDS, "cart-pole", "cable-robot")  # a page each, with all its figures


@pytest.fixture
def drawn(monkeypatch):
    """Figures that are written, and what makes them hard to read."""
    found, draw = {}, FigureCanvasAgg.print_png

    def note(canvas, path, **options):
        draw(canvas, path, **options)
        found[str(path).rpartition("/")[2]] = faults(canvas.figure)

    monkeypatch.setattr(FigureCanvasAgg, "print_png", note)
    return found


@pytest.mark.parametrize("name", SHOWN)
def test_a_scene_runs_and_leaves_a_page_with_figures_that_can_be_read(name, drawn, tmp_path, capsys):
    """Each value prints itself in at most eight lines."""
    code, out = main(["run", name, "--out", str(tmp_path), "--all-figures"]), capsys.readouterr().out
    assert code == (1 if name in ENDS_EARLY else 0), out
    assert max(lines_of_values(out)) <= MOST_LINES and "rank margins" in (tmp_path / "report.txt").read_text(encoding="utf-8")
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["scene"]["name"] == name and (tmp_path / "index.html").stat().st_size < 2e6
    assert set(drawn) >= {"motion.png", "sheet.png", "coordinates.png", "residuals.png"}
    assert not {figure: sentences for figure, sentences in drawn.items() if sentences}


def lines_of_values(text):
    """How many lines each printed value has, without those that continue a long one."""
    return [sum(not line.startswith("    ") for line in value.splitlines()) for value in text.split("\n\n")]


def figure_of(change):
    """A figure with two panels, changed and drawn."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    upper, lower = figure.subplots(2)
    for ax in (upper, lower):
        ax.plot([0, 1], [0, 1], label="x")
        ax.set(xlabel="t [s]", ylabel="x [m]", title="position")
        ax.legend()
    change(figure, upper, lower)
    FigureCanvasAgg(figure).draw()
    return faults(figure)


def test_a_plain_figure_has_no_faults():
    assert not figure_of(lambda *_: None)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda figure, upper, _: upper.text(0.5, 0.5, "a") and upper.text(0.5, 0.5, "b"), "'a' over 'b'"),
        (lambda figure, upper, _: upper.set_ylabel("a long label that is longer than its panel is high"), "is cut"),
        (lambda figure, upper, _: figure.text(0.99, 0.5, "beyond the edge"), "is cut"),
        (lambda figure, upper, _: upper.set_xticks([0.50, 0.51], ["first tick", "second tick"]), "over"),
        (lambda figure, _, lower: lower.lines[0].remove(), "panel 'position' is empty"),
    ],
)
def test_faults_of_figures_are_found(change, text):
    assert any(text in fault for fault in figure_of(change))
