"""Figures of a run: what is drawn where, by default and by name, and that they can be read."""

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from refusals import refused

import servoctl
from servoctl import figures
from servoctl.errors import NameUnknown, ServoError, SpecificationError
from servoctl.gallery import gallery
from servoctl.run import Run

UNITS = {"x": "m", "z": "m", "theta": "rad", "trolley": "N", "winch": "N m"}
T = np.linspace(0.0, 2.0, 401)


def a_run(names="x z theta", stored=(), residual=None, **rest):
    """A run without model: q, q', q'' of sines and cosines."""
    names = names.split()
    q = [np.sin((i + 1) * T) + i for i in range(len(names))]
    rates = [np.gradient(v, T) for v in q]
    jets = np.array([*q, *rates, *(np.gradient(v, T) for v in rates)])
    jet_names = tuple(d + name for d in ("", "d", "d2") for name in names)
    signals = {name: (i + 1) * 10 * np.cos(T) for i, name in enumerate(stored)}
    return Run(T, jets, jet_names, stored=signals, stored_residual=residual or {}, message="finished", **rest)


@pytest.fixture
def run():
    rows = {"X": np.array([1e-12 * T, 1e-9 * T, 1e-6 * T]), "Z": np.array([0.0 * T, 1e-15 * T, 1e-13 * T])}
    return a_run(stored=("trolley", "winch", "energy"), residual=rows, knots=(0.0, 0.5, 1.5), method="RK4")


@pytest.fixture
def stopped():
    force = 1.0 / (2.0 + 1e-9 - T)
    part = a_run("x y", success=False, status=-1, residual={"X": np.array([1e-9 * T])})
    part.stored["force"] = force
    return part


def lines(ax, vertical=False):
    """Curves of an Axes, or its vertical marks."""
    return [line for line in ax.get_lines() if (len(line.get_xdata()) == 2) == vertical]


def verticals(ax):
    return sorted(float(line.get_xdata()[0]) for line in lines(ax, vertical=True))


# --- the path


def test_a_path_is_drawn_in_the_plane_that_the_names_span(run):
    ax = figures.path(run, units=UNITS)
    curve = ax.get_lines()[0]
    assert np.array_equal(curve.get_xdata(), run["x"]) and np.array_equal(curve.get_ydata(), run["z"])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "z [m]")
    assert ax.get_aspect() == 1.0
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["start, t = 0 s", "end, t = 2 s"]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("x l theta", ("x", "l")),
        ("x y l X Y Z", ("X", "Y")),
        ("x l X Z", ("X", "Z")),
        ("x x_m y_m", ("x_m", "y_m")),
        ("phi tip_x tip_z", ("tip_x", "tip_z")),
        ("x1 x2 x3", ("t [s]", "x1, x2, x3")),
        ("x1 y2", ("x1", "y2")),
        ("q1 q2", ("q1", "q2")),
    ],
)
def test_default_plane(names, expected):
    ax = figures.path(a_run(names))
    assert (ax.get_xlabel(), ax.get_ylabel()) == expected


def test_a_path_by_name_and_with_one_name_only(run):
    ax = figures.path(run, "theta", "dtheta", units=UNITS)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("theta [rad]", "dtheta [rad/s]")
    assert ax.get_aspect() == "auto"
    assert figures.path(run, x="z").get_ylabel() == "x"
    assert figures.path(run, y="x").get_xlabel() == "z"


def test_a_single_coordinate_is_drawn_over_time():
    ax = figures.path(a_run("x"), units={"x": "m"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t [s]", "x [m]")


def test_flat_paths_keep_their_scales_apart(run):
    run.stored["far"] = 1e3 * run["x"]
    assert figures.path(run, "x", "far", units={"x": "m", "far": "m"}).get_aspect() == "auto"


def test_an_open_run_is_no_closed_loop(run):
    with refused(SpecificationError, "Run", "sv.close"):
        figures.closed(run)


def test_a_run_is_no_sweep(run):
    with refused(SpecificationError, "Run", "sv.sweep"):
        figures.sweep(run)
    with refused(SpecificationError, "tradeoff", "sv.sweep"):
        figures.sweep(servoctl.types.Study("tradeoff", {}, {}))


def test_the_load_of_a_crane_is_drawn_on_its_path(gallery_model):
    model, scene = gallery_model("overhead-crane"), gallery["overhead-crane"]
    ax = figures.path(servoctl.simulate(model, model.start(guess=scene.guess), scene.t_span))
    curve = ax.get_lines()[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("X [m]", "Z [m]")
    assert np.allclose(curve.get_ydata(), 4.0 - 0.4 * curve.get_xdata(), rtol=0, atol=1e-12)


def test_an_unknown_name_is_refused_with_the_nearest(run):
    with refused(NameUnknown, name="thetta", match="theta"):
        figures.path(run, "x", "thetta")


# --- signals


def test_coordinates_share_a_panel_by_unit(run):
    axes = figures.signals(run, units=UNITS)
    assert [ax.get_ylabel() for ax in axes] == ["x, z [m]", "theta [rad]"]
    assert [len(lines(ax)) for ax in axes] == [2, 1]
    assert axes[-1].get_xlabel() == "t [s]"
    assert all(verticals(ax) == [0.0, 0.5, 1.5] for ax in axes)


def test_without_units_each_signal_has_a_panel(run):
    assert [ax.get_ylabel() for ax in figures.signals(run)] == ["x", "z", "theta"]


def test_one_axes_takes_all_signals_and_keeps_their_units_apart(run):
    ax = Figure().subplots()
    assert figures.signals(run, ["x", "theta", "d2theta"], ax=ax, units=UNITS) is ax
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["x [m]", "theta [rad]", "d2theta [rad/s$^{2}$]"]


def test_axes_must_be_as_many_as_panels(run):
    with refused(SpecificationError, "3 Axes", "2 panels"):
        figures.signals(run, ax=Figure().subplots(3), units=UNITS)
    two = Figure().subplots(2)
    assert list(figures.signals(run, ax=two, units=UNITS)) == list(two)


def test_colours_are_for_every_colour_vision(run):
    drawn = lines(figures.signals(run, units=UNITS)[0])
    assert [to_hex(line.get_color()).upper() for line in drawn] == ["#0072B2", "#D55E00"]


def test_many_signals_are_told_apart():
    run = a_run(" ".join(f"s{i}" for i in range(15)))
    drawn = lines(figures.signals(run, units={f"s{i}": "m" for i in range(15)})[0])
    assert len({(line.get_color(), line.get_linestyle()) for line in drawn}) == 15


def test_rounding_does_not_fill_a_panel(run):
    run.stored["winch"] = 1e-14 * np.sin(9 * T)
    run.stored["hoist"] = 981.0 + 1e-12 * np.sin(9 * T)
    axes = figures.actuation(run, names=["trolley", "winch", "hoist"], units=UNITS | {"winch": "N", "hoist": "N"})
    assert all(np.ptp(ax.get_ylim()) > 100.0 for ax in axes[1:])


def test_rounding_that_is_alone_of_its_unit_does_not_fill_a_panel(run):
    run.stored["drive"], run.stored["steer"] = 1e-15 * np.sin(9 * T), np.sin(T)
    run.stored["small"] = 1e-9 * np.sin(9 * T)
    units = {"drive": "N", "steer": "N m", "small": "m"}
    axes = figures.actuation(run, names=["drive", "steer", "small"], units=units)
    assert np.ptp(axes[0].get_ylim()) == pytest.approx(0.2 * np.sin(T).max(), rel=0.1)
    assert np.ptp(axes[2].get_ylim()) < 1e-8


def test_coordinates_moved_by_quasi_velocities_are_recognised():
    jets = np.array([T, T**2, T, 1 + 0 * T])
    run = Run(T, jets, ("x", "psi", "u", "du"), stored={"dx": T, "dpsi": T, "d2x": T, "d2psi": T, "thrust": T})
    assert [ax.get_ylabel() for ax in figures.signals(run)] == ["x", "psi"]
    assert figures.efforts(run) == ["thrust"]


# --- actuation


def test_each_actuator_has_a_panel_with_its_extrema(run):
    axes = figures.actuation(run, units=UNITS)
    assert [ax.get_ylabel() for ax in axes] == ["trolley [N]", "winch [N m]"]
    assert axes[1].get_title(loc="left") == "winch: -8.32294 N m (t = 2 s) to 20 N m (t = 0 s)"


def test_an_ideal_program_shows_its_reaction():
    run = a_run("x theta", stored=("reaction_x", "reaction_theta", "multiplier_X", "tension"))
    axes = figures.actuation(run, units=UNITS)
    assert [ax.get_ylabel() for ax in axes] == ["reaction_x [N]", "reaction_theta [N m]"]


def test_a_run_without_actuation_says_so():
    with refused(SpecificationError, "actuation"):
        figures.actuation(a_run())


def test_what_grows_without_bound_before_a_stop_leaves_the_frame(stopped):
    ax = figures.actuation(stopped)[0]
    assert ax.get_ylim()[1] < 200.0 < stopped["force"].max()
    assert ax.get_title(loc="right") == "stopped after t = 2 s"
    assert verticals(ax) == [2.0]


def test_a_signal_that_is_not_finite_is_drawn_where_it_is(run):
    run.stored["trolley"][-1] = np.nan
    run.stored["winch"][:] = np.nan
    axes = figures.actuation(run)
    assert axes[0].get_title(loc="left") == "trolley: not finite at some instants"
    assert len(axes) == 2


# --- residuals


def test_residuals_tell_constraints_by_colour_and_levels_by_style(run):
    ax = figures.residuals(run)
    drawn = lines(ax)
    assert [(line.get_color(), line.get_linestyle()) for line in drawn] == [
        (colour, style) for colour in figures.COLOURS[:2] for style in ("-", "--", ":")
    ]
    assert ax.get_yscale() == "log"
    assert drawn[3].get_ydata().min() == 1e-18
    assert drawn[2].get_ydata().max() == np.abs(run.residual["X"][2]).max()
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["X", "Z", "residual", "1st derivative", "2nd derivative"]
    assert verticals(ax) == [0.0, 0.5, 1.5]


def test_residuals_of_one_level_and_of_high_levels():
    for levels, expected in ((1, ["c"]), (6, ["3rd derivative", "4th derivative", "5th derivative"])):
        ax = figures.residuals(a_run(residual={"c": np.full((levels, len(T)), 1e-9)}))
        assert [text.get_text() for text in ax.get_legend().get_texts()][-3:] == expected


def test_a_given_axes_is_used(run):
    ax = Figure().subplots()
    assert figures.residuals(run, ax=ax) is ax and figures.path(run, ax=ax) is ax and figures.actuation(run, ax=ax) is ax


# --- early ends


@pytest.mark.parametrize(("status", "word"), [(1, "interrupted"), (-1, "stopped")])
def test_early_ends_are_marked(status, word):
    run = a_run("x y", success=False, status=status, residual={"X": np.array([1e-9 * T])})
    assert figures.path(run).get_legend().get_texts()[1].get_text() == f"{word}, t = 2 s"
    for ax in (figures.signals(run)[0], figures.residuals(run)):
        assert ax.get_title(loc="right") == f"{word} after t = 2 s"
        assert verticals(ax) == [2.0]


# --- files


def test_figures_are_1000_px_wide(run, tmp_path):
    files = figures.save_figures(run, tmp_path / "made", units=UNITS, title="a run")
    assert [f.name for f in files] == ["path.png", "coordinates.png", "actuation.png", "residuals.png"]
    for file in files:
        head = file.read_bytes()[:24]
        assert head.startswith(b"\x89PNG") and struct.unpack(">I", head[16:20]) == (1000,)


def test_figures_without_actuation_and_residuals(tmp_path):
    assert [f.name for f in figures.save_figures(a_run(), tmp_path)] == ["path.png", "coordinates.png"]


def test_a_run_of_one_sample_is_drawn(tmp_path):
    signals, rows = {"f": np.ones(1)}, {"X": np.zeros((2, 1))}
    run = Run(np.zeros(1), np.ones((2, 1)), ("x", "dx"), success=False, status=-1, stored=signals, stored_residual=rows)
    assert len(figures.save_figures(run, tmp_path)) == 3  # x alone is no path


def test_a_folder_that_cannot_be_written(run, tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with refused(ServoError, path=str(tmp_path / "file")):
        figures.save_figures(run, tmp_path / "file")


def test_pyplot_and_the_backend_are_left_alone(tmp_path):
    script = f"""
import sys
import numpy as np
import servoctl
from servoctl import figures
assert not [name for name in sys.modules if name.startswith("matplotlib")]
t = np.linspace(0, 1, 9)
figures.save_figures(servoctl.types.Run(t, np.array([t, t]), ("x", "y")), {str(tmp_path)!r})
assert "matplotlib.pyplot" not in sys.modules
"""
    path = os.pathsep.join([str(Path(servoctl.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    subprocess.run([sys.executable, "-c", script], check=True, env={**os.environ, "PYTHONPATH": path})
