"""The command line: what it leaves, what it says, and that nothing computed is lost."""

import io
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from conftest import words

import servoctl
from servoctl.codegen.cache import cache_directory
from servoctl.codegen.compiler import compiler
from servoctl.errors import IntegrationStopped
from servoctl.gallery import gallery
from servoctl.methods.choice import METHODS as ALL_METHODS
from servoctl.shell.folder import FIGURES, FILES
from servoctl.shell.listing import COLUMNS_PRINTED, subjects
from servoctl.shell.main import main
from servoctl.shell.versions import NEEDED

FALL = '''"""A mass in a plane follows a path in x, and falls."""
import servoctl as sv

START = {"y": 0.0, "dy": 0.0}
T_SPAN = (0.0, 1.0)
UNITS = {"x": "m", "y": "m", "push": "N"}


def scene():
    p = sv.parameters(m=2.0, g=9.81)
    q = sv.coordinates("x y")
    x, y = q
    S = sv.particle(q, p.m, x) + sv.particle(q, p.m, y)
    r = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=2))
    mechanism = sv.Mechanism(q, gibbs=S, potential=p.m * p.g * y, actuators={"push": x}, parameters=p)
    return mechanism, sv.Program({"X": x - r.X})
'''


LARGEST_PAGE = 2_000_000  # bytes
pytestmark = pytest.mark.usefixtures("here")


@pytest.fixture
def fall(here):
    (here / "fall.py").write_text(FALL, encoding="utf-8")
    return "fall.py"


def process(*command):
    """A process of its own, from any folder, whether servoctl is installed or not."""
    path = os.pathsep.join([str(Path(servoctl.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(command, check=True, capture_output=True, text=True, env=environment)


def summary(folder):
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


# --- the main job


def test_run_leaves_numbers_figures_and_the_report(here, capsys):
    assert main(["run", "overhead-crane"]) == 0
    folder = here / "servoctl-runs" / "overhead-crane"
    assert {f.name for f in folder.iterdir()} == set(FILES)
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1] == f"open {folder.relative_to(here) / 'index.html'}"
    report = (folder / "report.txt").read_text(encoding="utf-8")
    assert all(word in text for text in (printed, report) for word in ("Model: x, l, theta", "State at t = 0 s", "Run: ", "Verification: passed"))
    run = servoctl.load(folder / "run.npz")
    assert run.success and run.t[-1] == 8.0

    facts = summary(folder)
    assert facts["scene"] == {
        "name": "overhead-crane", "given": "overhead-crane", "description": gallery["overhead-crane"].description
    }  # fmt: skip
    assert facts["command"] == ["run", "overhead-crane"]
    assert facts["parameters"] == {"m_trolley": 10.0, "m_hoist": 5.0, "m_load": 100.0, "g": 9.81}
    assert (facts["t_span"], facts["method"], facts["free_initial_values"]) == ([0.0, 8.0], "algebraic", 0)
    assert facts["structure"]["index"] == 5
    assert facts["start"]["values"]["l"] == 4.0
    assert facts["extrema"]["trolley"]["min"]["value"] == pytest.approx(-137.991607, abs=1e-6)
    assert facts["extrema"]["trolley"]["max"]["t"] == pytest.approx(1.868, abs=1e-3)
    assert facts["extrema"]["hoist"]["max"]["value"] == pytest.approx(-935.793762, abs=1e-6)
    assert facts["extrema"]["tension"]["min"]["value"] == pytest.approx(938.008880, abs=1e-6)
    assert set(facts["residuals"]) >= {"X", "Z"} and facts["residuals"]["X"]["worst"] < 1e-9
    assert facts["verification"]["passed"] and facts["verification"]["numbers"]["balance"] < 1e-9
    assert facts["versions"]["servoctl"] == servoctl.__version__
    assert facts["versions"]["python"] == platform.python_version()
    assert set(facts["versions"]) == {"servoctl", "casadi", "numpy", "scipy", "python"}

    page = (folder / "index.html").read_text(encoding="utf-8")
    pictures = ["motion.png", "sheet.png"]
    assert re.findall('alt="([^"]+)" src="data:image/png;base64,', page) == pictures  # all inside, nothing elsewhere
    assert page.count("src=") == len(pictures) and not re.search("href|https?://|url\\(", page)
    assert len(page) < LARGEST_PAGE
    for value in ("-137.992", "1041.23", "servoctl run overhead-crane", '<figure class="motion">', "Verification: passed", "within", "lqr"):
        assert value in page
    assert re.search(r"<td>hoist</td>(<td class=n>[^<]+</td>){4}<td>N</td>", page)
    assert "<td>index</td><td>5</td>" in page
    assert "beyond" not in page
    model = servoctl.derive(*gallery["overhead-crane"].build())
    verification = servoctl.verify(servoctl.load(folder / "run.npz", model))
    for name in verification.numbers:
        limit = verification.limits[name]
        assert re.search(rf"<td>{name}</td><td class=n>[^<]+</td><td class=n>{limit:.6g}</td>", page)


def test_a_plan_with_unstable_internal_dynamics_is_kept_and_fails(here, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # said once, by the command itself
        assert main(["run", "vtol-centre", "--method", "DOP853", "--no-loop", "--no-figures", "--no-verify"]) == 1
    printed = capsys.readouterr()
    assert "internal dynamics unstable over these 1 s: errors grow by" in printed.out
    assert "internal dynamics unstable" in printed.err
    facts = summary(here / "servoctl-runs" / "vtol-centre")
    assert facts["success"] and facts["internal_dynamics"]["verdict"] == "unstable"
    assert facts["internal_dynamics"]["growth"] > 100 and facts["internal_dynamics"]["seconds"] == 1.0


def test_unstable_internal_dynamics_get_the_bounded_plan(here, capsys):
    assert main(["run", "vtol-centre", "--no-figures"]) == 0
    printed = words(capsys.readouterr().out)
    assert "Verdict: non-minimum phase (hyperbolic): at both ends eigenvalues 15.0406" in printed
    facts = summary(here / "servoctl-runs" / "vtol-centre")
    assert facts["method"] == "bounded" and facts["t_span"] == [0.0, 4.0] and facts["t_end"] > 4.0
    assert facts["verdict"] == "non-minimum phase (hyperbolic)" and facts["verification"]["passed"]
    assert facts["verdict_facts"]["rest"]["end"]["eigenvalues"][0] == pytest.approx([15.0405993, 0.0], abs=1e-7)
    thrusts = [facts["extrema"][name][side]["value"] for name in ("u1", "u2") for side in ("min", "max")]
    assert 200.0 < min(thrusts) and max(thrusts) < 300.0  # its weight is 490.5 N
    assert max(r["worst"] for r in facts["closed_loop"]["residuals"].values()) < 1e-5 * 5.0


def test_samples_of_the_bounded_plan_include_what_comes_before_and_after_the_program(here, capsys):
    spans = []
    for options in ([], ["--samples", "201"]):
        assert main(["run", "vtol-centre", "--no-figures", "--no-loop", "--no-verify", *options]) == 0
        with np.load(here / "servoctl-runs" / "vtol-centre" / "run.npz") as file:
            spans.append((file["t"][0], file["t"][-1]))
    assert len(np.unique(spans[0])) == 2 and spans[0][0] < 0.0 and spans[0][1] > 4.0
    assert spans[1] == spans[0]
    facts = summary(here / "servoctl-runs" / "vtol-centre")
    assert facts["samples"] == 201 and "leave out" not in facts["message"]


def test_where_there_is_no_bounded_plan_the_forward_one_says_so(here, capsys):
    line = "run vtol-centre --t-span 0 1 --no-loop --no-figures --no-verify"
    assert main(line.split()) == 1
    printed = capsys.readouterr()
    assert "There is no bounded motion" in printed.out and "(0, 4)" in words(printed.out)
    assert "not to be trusted" in words(printed.err)


def test_the_verdict_of_a_run_is_printed_and_kept(here, capsys):
    assert main("run passive-arm --no-loop --no-figures --no-verify".split()) == 0
    assert "Verdict: minimum phase: at both ends eigenvalues -6 ± 9.16515i 1/s" in words(capsys.readouterr().out)
    assert summary(here / "servoctl-runs" / "passive-arm")["verdict"] == "minimum phase"


def test_a_program_that_cannot_be_realised_is_reported(here, capsys):
    (here / "free.py").write_text(
        "import servoctl as sv\n"
        "def scene():\n"
        "    q = sv.coordinates('x y')\n"
        "    x, y = q\n"
        "    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={'F': x})\n"
        "    return mechanism, sv.Program({'x': x - q.t, 'y': y})\n", encoding="utf-8"
    )
    assert main(["report", "free.py"]) == 0
    assert "Report: not realisable" in capsys.readouterr().out


def test_a_motion_that_stops_is_kept_drawn_and_explained(here, capsys):
    assert main(["run", "appell-hamel-squared", "--out", "squared"]) == 1
    out, err = capsys.readouterr()
    assert "SingularProgram: The program is singular at t = 0.698" in words(out) and "'speed'" in out
    assert "Verification: left out" in out
    assert "ended early, at t = 0.698" in err
    assert {f.name for f in (here / "squared").iterdir()} == set(FILES) - {"closed_loop.npz"}
    run = servoctl.load(here / "squared" / "run.npz")
    assert not run.success and 0.69 < run.t[-1] < 0.7
    assert summary(here / "squared")["status"] == -1
    assert "SingularProgram" in (here / "squared" / "report.txt").read_text(encoding="utf-8")


def test_the_page_shows_the_motion(here, fall):
    assert main(["run", fall, "--t-span", "0", "0.2", "--animate", "--no-verify", "--machine", "m=2.5"]) == 0
    folder = here / "servoctl-runs" / "fall"
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert (folder / "motion.gif").read_bytes()[:6] == b"GIF89a"
    assert page.index('<figure class="motion">') < page.index('alt="motion.png"') and "motion.gif" not in page
    assert "not verified" in page and "on a machine with m = 2.5" in page and len(page) < LARGEST_PAGE
    assert main(["run", fall, "--t-span", "0", "0.2", "--no-verify", "--no-figures"]) == 0
    assert not (folder / "motion.gif").exists() and not re.search("<img|<svg", (folder / "index.html").read_text(encoding="utf-8"))


def test_each_figure_has_a_file_of_its_own_where_that_is_wanted(here, fall):
    (here / "servoctl-runs" / "fall").mkdir(parents=True)
    assert main(["run", fall, "--no-verify", "--all-figures", "--samples", "11"]) == 0
    names = {f.name for f in (here / "servoctl-runs" / "fall").iterdir()}
    assert names >= {"sheet.png", "path.png", "coordinates.png", "residuals.png"} and names - {*FILES} <= {*FIGURES}
    assert main(["run", fall, "--no-verify", "--no-figures", "--samples", "11"]) == 0
    assert not {*FIGURES, "sheet.png"} & {f.name for f in (here / "servoctl-runs" / "fall").iterdir()}


def test_a_mechanism_that_cannot_be_drawn_has_a_page_without_it(here, capsys):
    text = FALL.replace("x y", "a b").replace('"y"', '"b"')
    (here / "turn.py").write_text(text.replace('"dy"', '"db"').replace('"x": "m", "b": "m"', '"a": "rad"'), encoding="utf-8")
    assert main(["run", "turn.py", "--animate", "--no-verify", "--no-loop"]) == 0
    assert "There is no animation" in capsys.readouterr().err
    names = {f.name for f in (here / "servoctl-runs" / "turn").iterdir()}
    assert names.isdisjoint({"motion.gif", "motion.png"}) and "index.html" in names


# --- a user's file


def test_run_of_a_users_file(here, fall, capsys):
    assert main(["run", fall, "--set", "m=3", "--hold", "dy=1.5", "--no-figures"]) == 0
    folder = here / "servoctl-runs" / "fall"
    assert {f.name for f in folder.iterdir()} == {"index.html", "run.npz", "closed_loop.npz", "summary.json", "report.txt"}
    facts = summary(folder)
    assert facts["scene"]["description"] == "A mass in a plane follows a path in x, and falls."
    assert facts["parameters"] == {"m": 3.0, "g": 9.81}
    assert facts["start"]["values"]["dy"] == 1.5 and facts["start"]["held"] == ["y", "dy"]
    assert servoctl.load(folder / "run.npz")["y"][-1] == pytest.approx(1.5 - 9.81 / 2, abs=1e-9)


def test_a_start_may_hold_outputs(here):
    """In START and in --hold, as model.start does: the distance of the mass from (0, -1), and its speed."""
    outputs = 'outputs={"distance": (x**2 + (y + 1) ** 2) ** 0.5, "speed": q.dt(y)}, parameters=p)'
    text = FALL.replace("parameters=p)", outputs).replace('START = {"y": 0.0, "dy": 0.0}', 'START = {"distance": 3.0}')
    (here / "far.py").write_text(text + '\nGUESS = {"y": 1.0}\n', encoding="utf-8")
    assert main([*"run far.py --no-verify --no-figures --no-loop --hold".split(), "speed=0.5"]) == 0
    start = summary(here / "servoctl-runs" / "far")["start"]
    assert start["held"] == ["distance", "speed"]
    assert start["values"]["y"] == pytest.approx(2.0, abs=1e-12) and start["values"]["dy"] == pytest.approx(0.5)


def test_a_guess_frees_what_the_scene_holds(here, fall):
    assert main(["run", fall, "--guess", "y=0.5", "--no-figures", "--no-verify"]) == 0
    start = summary(here / "servoctl-runs" / "fall")["start"]
    assert start["held"] == ["dy"] and start["free"] == ["y"] and start["values"]["y"] == 0.5


def test_a_file_may_import_its_neighbours(here, fall, capsys):
    (here / "sub").mkdir()
    (here / "sub" / "masses_of_fall.py").write_text("m = 4.0\n", encoding="utf-8")
    (here / "sub" / "other.py").write_text("import masses_of_fall\n" + FALL.replace("m=2.0", "m=masses_of_fall.m"), encoding="utf-8")
    assert main(["report", "sub/other.py"]) == 0
    assert "m=4" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("x = 1\n\ny = 1 / 0\n", ["broken.py raised ZeroDivisionError: division by zero", "in line 3: y = 1 / 0"]),
        ("def scene(:\n    pass\n", ["raised SyntaxError", "in line 1: def scene(:"]),
        ("import no_such_module\n", ["ModuleNotFoundError: No module named 'no_such_module'", "in line 1"]),
        ("import sys\nsys.exit(3)\n", ["raised SystemExit: 3", "in line 2"]),
        ("def scene():\n    return none\n", ["NameError: name 'none' is not defined", "in line 2: return none"]),
        ("def scen():\n    pass\n", ["broken.py defines no scene()", "The file defines scen()", "Define scene()"]),
        ("scene = 3\n", ["broken.py defines no scene()"]),
        ("def scene():\n    return 1\n", ["scene() of broken.py returned int", "return mechanism, program"]),
        ("def scene():\n    return 'a', 2\n", ["returned (str, int)", "a Mechanism and a Program"]),
        ("START = {'x': 'a'}\ndef scene():\n    pass\n", ["START = {'x': 'a'}", 'the form {"theta": 0.1}']),
        ("T_SPAN = 2.0\ndef scene():\n    pass\n", ["T_SPAN = 2.0", "(0.0, 2.0)"]),
        ("UNITS = ['m']\ndef scene():\n    pass\n", ["UNITS = ['m']"]),
        ("import servoctl as sv\ndef scene():\n    return sv.Program({}), 1\n",
         ["at least one residual", "Raised in broken.py, line 3: return sv.Program({}), 1"]),
    ],
)  # fmt: skip
def test_faults_in_a_users_file(here, capsys, text, facts):
    (here / "broken.py").write_text(text, encoding="utf-8")
    assert main(["run", "broken.py"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and "Traceback" not in err
    assert all(fact in words(err) for fact in facts)
    assert not (here / "servoctl-runs").exists()


# --- bad input


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        ("run overhed-crane", ["NameUnknown", "No scene is named 'overhed-crane'", "Nearest: 'overhead-crane'"]),
        ("report overhead_crane", ["Nearest: 'overhead-crane'"]),
        ("run fall", ["There is a file fall.py"]),
        ("run fal.py", ["There is no file fal.py", "Nearest: fall.py"]),
        ("run missing/fall.py", ["There is no file missing/fall.py"]),
        ("run notes.txt", ["notes.txt exists", "ends in .py"]),
        ("report empty", ["empty has no report.txt"]),
        ("run fall.py --set mm=3", ["No parameter is named 'mm'", "Nearest: 'm'"]),
        ("run fall.py --set m=3 --set m=4", ["--set m was given twice: 3 and 4"]),
        ("run fall.py --hold ddy=3", ["No state is named 'ddy'", "Nearest: 'dy'"]),
        ("run fall.py --hold t=3", ["No state is named 't'"]),
        ("run fall.py --guess z=3", ["No state is named 'z'"]),
        ("run fall.py --hold y=3 --guess y=2", ["y is both held and guessed"]),
        ("run fall.py --method Euler", ["No method is named 'Euler'"]),
        ("run fall.py --step 0.1", ["step=0.1"]),
        ("run fall.py --t-span 1 1", ["(1.0, 1.0)"]),
        ("run fall.py --t-span 1 0", ["--t-span 1 0 runs backwards", "Nearest: --t-span 0 1"]),
    ],
)
def test_errors_are_told_without_a_traceback(here, fall, capsys, arguments, facts):
    (here / "notes.txt").write_text("", encoding="utf-8")
    (here / "empty").mkdir()
    assert main(arguments.split()) == 2
    err = capsys.readouterr().err
    assert all(fact in words(err) for fact in facts)
    assert "Traceback" not in err and max(map(len, err.splitlines())) <= 120
    assert not (here / "servoctl-runs").exists()


@pytest.mark.parametrize(
    ("arguments", "fact"),
    [
        ("run fall.py --hold x", "'x' is not NAME=VALUE"),
        ("run fall.py --set =3", "'=3' is not NAME=VALUE"),
        ("run fall.py --set m=nan", "'m=nan' is not NAME=VALUE with a number"),
        ("run --hold y=1 fall.py", "the scene's name comes before such options"),
        ("run fall.py --drift much", "'much' is not none, project or a time constant"),
        ("run fall.py --samples 1", "'1' is not a whole number of at least 2"),
        ("run fall.py --t-spam 0 1", "unrecognized argument '--t-spam'; nearest: --t-span."),
        ("run fall.py --no-figures --all-figures", "not allowed with"),
        ("runn fall.py", "No command is named 'runn'. Nearest: 'run'"),
        ("", "required: command"),
    ],
)
def test_arguments_that_cannot_be_read(capsys, arguments, fact):
    with pytest.raises(SystemExit) as stop:
        main(arguments.split())
    err = capsys.readouterr().err
    assert stop.value.code == 2 and fact in err and len(err.splitlines()) == 1


# --- the folder


@pytest.mark.parametrize("out", ["taken", "taken/deeper"])
def test_a_folder_that_cannot_be_written_is_told_before_computing(here, fall, capsys, monkeypatch, out):
    (here / "taken").write_text("a file", encoding="utf-8")
    monkeypatch.setattr(servoctl, "derive", lambda *_: pytest.fail("computed first"))
    assert main(["run", fall, "--out", out]) == 2
    err = words(capsys.readouterr().err)
    assert f"The folder {out} cannot be written" in err and "Nothing has been computed yet" in err


@pytest.mark.parametrize("when", ["simulate", "verify"])
def test_a_folder_that_is_lost_while_computing_loses_nothing(here, fall, capsys, monkeypatch, when):
    compute = getattr(servoctl, when)
    monkeypatch.setattr("tempfile.tempdir", str(here / "temporary"))
    (here / "temporary").mkdir()

    def losing(*args, **rest):
        shutil.rmtree(here / "lost")
        (here / "lost").write_text("a file", encoding="utf-8")
        return compute(*args, **rest)

    monkeypatch.setattr(servoctl, when, losing)
    assert main(["run", fall, "--out", "lost", "--no-figures"]) == 1
    (kept,) = (here / "temporary").iterdir()
    assert {f.name for f in kept.iterdir()} == {"index.html", "run.npz", "closed_loop.npz", "summary.json", "report.txt"}
    assert f"it is written to {kept} instead" in words(capsys.readouterr().err)
    assert servoctl.load(kept / "run.npz").success


def test_nowhere_to_write_is_an_error_not_a_traceback(here, fall, capsys, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(servoctl.types.Run, "save", full)
    monkeypatch.setattr("tempfile.tempdir", str(here))
    assert main(["run", fall, "--no-verify"]) == 2
    out, err = capsys.readouterr()
    assert "Run: " in out and "cannot be written, either" in words(err)


def test_files_of_an_earlier_run_are_replaced_and_others_kept(here, fall):
    assert main(["run", fall, "--out", "kept", "--no-verify"]) == 0
    (here / "kept" / "notes.md").write_text("mine", encoding="utf-8")
    assert main(["run", fall, "--out", "kept", "--no-verify", "--no-figures"]) == 0
    assert {f.name for f in (here / "kept").iterdir()} == {
        "index.html", "run.npz", "closed_loop.npz", "summary.json", "report.txt", "notes.md"
    }  # fmt: skip


def test_no_empty_folder_stays_where_nothing_can_be_written(here, fall, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(here / "temporary"))
    (here / "temporary").mkdir()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(servoctl.types.Run, "save", full)
    assert main(["run", fall, "--no-verify"]) == 2
    assert not list((here / "temporary").iterdir()) and not (here / "servoctl-runs").exists()


# --- options, interruption, verification


@pytest.mark.parametrize(
    ("options", "fact"),
    [
        ("--t-span 1 1", "t_span=(1.0, 1.0)"),
        ("--t-span 0 nan", "t_span=(0.0, nan)"),
        ("--method Euler", "No method is named 'Euler'"),
        ("--drift -0.1", "-0.1"),
    ],
)
def test_what_no_model_has_is_told_before_deriving(fall, capsys, monkeypatch, options, fact):
    monkeypatch.setattr(servoctl, "derive", lambda *_: pytest.fail("derived first"))
    assert main(["run", fall, *options.split()]) == 2
    assert fact in words(capsys.readouterr().err)


def test_help_names_every_method(capsys):
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    assert ", ".join(ALL_METHODS) in words(capsys.readouterr().out)


def test_options_reach_the_simulation(fall, monkeypatch):
    given = {}

    def simulate(model, start, span, **options):
        given.update(options, span=span, t=start.t)
        raise IntegrationStopped("enough")

    monkeypatch.setattr(servoctl, "simulate", simulate)
    line = "--t-span 0.5 1.0 --method RK4 --step 1e-3 --drift project --samples 6"
    assert main(["run", fall, *line.split()]) == 2
    assert given["t_eval"] == pytest.approx([0.5, 0.6, 0.7, 0.8, 0.9, 1.0]) and given["t_eval"][-1] == 1.0
    del given["t_eval"]
    expected = {"method": servoctl.methods.RungeKutta(4, step=1e-3), "drift": "project"}
    assert given == {**expected, "span": (0.5, 1.0), "t": 0.5}
    given.clear()
    assert main(["run", fall, "--method", "Radau", "--rtol", "1e-6", "--atol", "1e-7"]) == 2
    assert given == {"method": servoctl.methods.Adaptive("Radau", 1e-6, 1e-7), "span": (0.0, 1.0), "t": 0.0}
    given.clear()
    assert main(["run", fall, "--drift", "0.1"]) == 2
    assert given == {"drift": 0.1, "span": (0.0, 1.0), "t": 0.0}


def interrupt(*_, **__):
    raise KeyboardInterrupt


def test_an_interruption_before_the_motion(here, fall, capsys, monkeypatch):
    monkeypatch.setattr(servoctl, "derive", interrupt)
    assert main(["run", fall]) == 130
    assert "Interrupted" in capsys.readouterr().err
    assert not (here / "servoctl-runs").exists()


def test_an_interrupted_verification_keeps_the_run(here, fall, capsys, monkeypatch):
    monkeypatch.setattr(servoctl, "verify", interrupt)
    assert main(["run", fall, "--no-figures"]) == 1
    assert "Verification: interrupted" in capsys.readouterr().out
    assert summary(here / "servoctl-runs" / "fall")["verification"] is None


def test_a_failed_verification_is_seen_in_the_exit_code(here, fall, monkeypatch):
    failed = servoctl.types.Verification({"balance": float("nan")}, ("balance",), limits={"balance": 1e-6})
    monkeypatch.setattr(servoctl, "verify", lambda *_: failed)
    assert main(["run", fall, "--no-figures"]) == 1
    verification = summary(here / "servoctl-runs" / "fall")["verification"]
    assert verification == {"verdict": "failed", "passed": False, "numbers": {"balance": None}}


def test_an_inconclusive_verification_has_an_exit_code_of_its_own(here, fall, monkeypatch):
    doubtful = servoctl.types.Verification({}, doubts=("No sample was checked.",))
    monkeypatch.setattr(servoctl, "verify", lambda *_: doubtful)
    assert main(["run", fall, "--no-figures"]) == 3
    assert summary(here / "servoctl-runs" / "fall")["verification"]["verdict"] == "inconclusive"
    assert "No sample was checked." in (here / "servoctl-runs" / "fall" / "index.html").read_text(encoding="utf-8")


# --- the other commands


def test_list_names_every_scene(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0].strip() for line in lines] == list(gallery)
    assert all(line.endswith(scene.description) for line, scene in zip(lines, gallery.values(), strict=True))


def test_the_long_list_groups_scenes_by_what_they_teach(capsys):
    assert main(["list", "--long"]) == 0
    printed = capsys.readouterr().out
    groups = {}
    for line in filter(str.strip, printed.splitlines()):
        if line[0] != " ":
            members = groups.setdefault(line.lower(), [])
        elif line[2] != " ":
            members.append(line.strip())
    assert groups == {group: list(members) for group, members in subjects()}
    assert [name for members in groups.values() for name in members] == list(gallery)
    text = " ".join(printed.split())
    assert all(part in text for scene in gallery.values() for part in (scene.teaches, scene.number, scene.source))
    assert max(map(len, printed.splitlines())) <= COLUMNS_PRINTED


def test_report_of_a_specification_simulates_nothing(here, fall, capsys, monkeypatch):
    monkeypatch.setattr(servoctl, "simulate", lambda *_, **__: pytest.fail("simulated"))
    assert main(["report", fall]) == 0
    out = capsys.readouterr().out
    assert all(word in out for word in ("Mechanism: x y", "Model: x, y", "Structure: index 3"))
    assert not (here / "servoctl-runs").exists()


def test_report_of_an_earlier_run(here, fall, capsys):
    """It has the details, which the command prints if it is asked to."""
    assert main(["run", fall, "--no-verify", "--no-figures"]) == 0
    short = capsys.readouterr().out
    assert main(["report", "servoctl-runs/fall"]) == 0
    again = capsys.readouterr().out
    assert "Run: " in again and "rank margins" in again and "rank margins" not in short
    assert main(["run", fall, "--no-verify", "--no-figures", "--verbose"]) == 0
    assert capsys.readouterr().out.startswith(again)


def test_the_version_and_a_quick_help():
    script = """
import sys
from servoctl.shell.main import main
try:
    main(["--help"])
except SystemExit as stop:
    assert stop.code == 0
slow = [name for name in ("matplotlib", "scipy.integrate", "control", "servoctl.gallery") if name in sys.modules]
assert not slow, slow
"""
    helped = process(sys.executable, "-c", script)
    assert all(word in helped.stdout for word in ("list", "report", "run", "scene()"))
    version = process(sys.executable, "-m", "servoctl", "--version")
    assert version.stdout == f"servoctl {servoctl.__version__}\n"


def test_versions_to_paste_into_a_report_of_a_fault():
    """All that is needed is named, and neither NumPy nor CasADi has to work for it."""
    script = """
import sys
from servoctl.shell.main import main
sys.modules["numpy"] = sys.modules["casadi"] = None
assert main(["versions"]) == 0
"""
    lines = process(sys.executable, "-c", script).stdout.splitlines()
    told = {name: fact for name, _, fact in (re.split("( +)", line, maxsplit=1) for line in lines)}
    assert told["servoctl"] == servoctl.__version__ and told["numpy"] == np.__version__
    assert told[platform.python_implementation()] == platform.python_version()
    assert told["cache"] == str(cache_directory()) and told["compiler"].split(":")[0] == (compiler() or "none")
    project = (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    needed = re.search(r"^dependencies = \[(.*?)^\]", project, re.M | re.S)[1]
    assert set(re.findall(r'^    "(\w+)', needed, re.M)) == set(NEEDED) <= set(told)


def test_versions_without_a_compiler(capsys, monkeypatch):
    monkeypatch.setenv("SERVOCTL_COMPILER", "none")
    assert main(["versions"]) == 0
    assert re.search("^compiler +none$", capsys.readouterr().out, re.M)


def test_a_terminal_without_greek_letters(here, fall, monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    assert "T from ker E?" in process(sys.executable, "-m", "servoctl", "report", fall, "--verbose").stdout


def test_a_reader_that_leaves_does_not_end_the_computation(here, fall):
    process("sh", "-c", f"{sys.executable} -m servoctl run {fall} --no-verify --no-figures | true")
    assert {f.name for f in (here / "servoctl-runs" / "fall").iterdir()} == {
        "index.html",
        "run.npz",
        "closed_loop.npz",
        "summary.json",
        "report.txt",
    }


def test_export_c_writes_two_files(here, capsys):
    assert main(["export-c", "two-cars", "--out", "c", "--set", "k1=2"]) == 0
    assert sorted(p.name for p in Path("c").iterdir()) == ["two_cars.c", "two_cars.h"]
    assert "two_cars.c, two_cars.h in c" in capsys.readouterr().out
    assert main(["export-c", "two-cars", "--out", "c", "--name", "int"]) == 2


LONG = "n" * 300


@pytest.mark.parametrize(
    "argv",
    [
        ["run", ""], ["run", LONG], ["run", "a\0b"], ["run", "a\0.py"], ["run", "\ud800.py"], ["report", ""],
        ["report", LONG], ["report", "a\0b"], ["export-c", "overhead-crane", "--out", LONG],
        ["export-c", "overhead-crane", "--out", "a\0b"],
        *(["run", "overhead-crane", "--out", out] for out in (LONG, "a\0b", "\ud800", f"{LONG}/{LONG}")),
        *([command, "overhead-crane", "--out", "a\0b"] for command in ("tradeoff", "run")),
    ],
    ids=lambda argv: " ".join(word[:12] for word in argv).encode("ascii", "backslashreplace").decode(),
)  # fmt: skip
def test_odd_names_are_explained(argv, capsys):
    assert main(argv) == 2
    said = capsys.readouterr().err
    assert "Error" in said or "NameUnknown" in said
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    "argv",
    [
        ["run", "overhead-crane", "--samples", "99999999999"], ["run", "overhead-crane", "--samples", "1" * 5000],
    ],
    ids=lambda argv: " ".join(argv[2:4])[:30],
)  # fmt: skip
def test_options_beyond_their_bounds_are_refused(argv, capsys):
    with pytest.raises(SystemExit) as ended:
        main(argv)
    assert ended.value.code == 2 and argv[2] in capsys.readouterr().err


@pytest.mark.parametrize("delay", ["999999999999999999999999999999", "1001"])
def test_a_delay_beyond_its_bound_is_a_sentence(delay, capsys):
    assert main(["run", "overhead-crane", "--no-figures", "--law", "computed", "--delay", delay]) in (1, 2)
    assert "delay" in capsys.readouterr().out


def test_a_reader_that_stops_reading_is_no_error(monkeypatch):
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", Closed())
    assert main(["versions"]) == 0
