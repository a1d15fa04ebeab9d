"""The closed loop of `servoctl run`: by default about the plan's own numbers, else on the machine that is named."""

import json

import numpy as np
import pytest
from conftest import words
from matplotlib.colors import to_hex
from scenes import CRANE

import servoctl as sv
from servoctl.figures.loop import LIMIT
from servoctl.shell.folder import FILES
from servoctl.shell.main import main

pytestmark = pytest.mark.usefixtures("here")


def crane(*options):
    """Exit code, facts and the saved loop of a short run of the crane."""
    code = main(["run", "overhead-crane", "--no-verify", "--no-figures", "--out", "crane", *" ".join(options).split()])
    with open("crane/summary.json", encoding="utf-8") as file:
        return code, json.load(file)["closed_loop"], sv.load("crane/closed_loop.npz")


# the loop --------------------------------------------------------------------------------------------------------------


def test_a_run_closes_the_loop_about_its_plan(here, capsys):
    code, facts, run = crane()
    assert code == 0 and "Closed: 801 samples at 100 Hz" in capsys.readouterr().out
    assert "Closed: 801 samples" in (here / "crane" / "report.txt").read_text(encoding="utf-8")
    assert facts["law"] == "lqr, time-varying" and facts["rate"] == 100.0 and facts["success"]
    assert facts["residuals"]["X"]["worst"] < 1e-3 and facts["machine"]["m_load"] == 100.0
    assert np.allclose(run.t, np.arange(801) / 100, rtol=0, atol=1e-12)


def test_the_machine_has_its_own_numbers(plan):
    _, facts, run = crane("--machine m_load=115 --integral --rate 50 --delay 1 --noise x=1e-3 --seed 4")
    law = sv.lqr(plan, sv.plant(CRANE), rate=50.0, integral=True)
    machine = sv.plant(CRANE, m_load=115.0)
    sensors, timing = sv.Sensors(noise={"x": 1e-3}, seed=4), sv.Timing(delay=1)
    expected = sv.close(machine, law, plan.state(0.0), (0.0, 8.0), sensors=sensors, timing=timing)
    for name in machine.state_names:
        assert run[name] == pytest.approx(expected[name], rel=1e-9, abs=1e-9)  # compiled meanwhile, or interpreted
    assert facts["machine"] == {"m_trolley": 10.0, "m_hoist": 5.0, "m_load": 115.0, "g": 9.81}
    assert (facts["delay"], facts["noise"]) == (1, {"x": 1e-3})
    worst, end = np.abs(expected.residual["Z"][0]).max(), abs(expected.residual["Z"][0, -1])
    assert facts["residuals"]["Z"] == pytest.approx({"worst": worst, "end": end}, rel=1e-9, abs=1e-9)
    assert facts["residuals"]["Z"]["worst"] > 0.01 and facts["residuals"]["X"]["end"] < 0.02


def test_the_plan_has_the_numbers_of_set():
    _, facts, _ = crane("--set m_load=80 --machine m_hoist=6")
    assert facts["machine"] == {"m_trolley": 10.0, "m_hoist": 6.0, "m_load": 80.0, "g": 9.81}
    assert 980.0 > -facts["inputs"]["hoist"]["max"] > 600.0


def test_limits_are_kept_and_what_gave_way_is_told(capsys):
    _, facts, run = crane("--machine m_load=115 --limit trolley=120 hoist=-1300:0")
    assert "LimitReport: residuals gave way" in capsys.readouterr().out
    trolley = facts["inputs"]["trolley"]
    assert (trolley["min"], trolley["max"]) == (-120.0, 120.0) and 0.05 < trolley["at a limit"] < 0.6
    assert facts["inputs"]["hoist"]["at a limit"] == 0.0
    assert np.abs(run["trolley"]).max() == 120.0


@pytest.mark.parametrize(("law", "limit"), [("computed", ""), ("feedforward", "--limit trolley=130")])
def test_other_laws(law, limit):
    code, facts, _ = crane(f"--law {law} {limit}")
    assert code == 0 and facts["law"] == law
    assert not limit or facts["inputs"]["trolley"]["max"] == 130.0


def test_a_rate_that_does_not_divide_the_span_ends_at_its_last_sample():
    _, facts, _ = crane("--rate 30.3")
    assert facts["t_end"] == pytest.approx(242 / 30.3)


# where there is none ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "code"), [("", 0), ("--rate 50", 1)])
def test_an_ideal_reaction_has_no_loop(here, capsys, options, code):
    line = "run two-cars-ideal --no-verify --no-figures --out ideal"
    assert main([*line.split(), *options.split()]) == code  # an option of the line took no effect
    assert "Closed loop: left out, as a law commands actuators, not an ideal reaction." in capsys.readouterr().out
    assert {f.name for f in (here / "ideal").iterdir()} == {"index.html", "run.npz", "summary.json", "report.txt"}
    assert json.loads((here / "ideal" / "summary.json").read_text(encoding="utf-8"))["closed_loop"] is None


def test_the_loop_is_left_out_and_files_of_an_earlier_one_go(here, capsys):
    line = "run overhead-crane --no-verify --out crane"
    assert main(line.split()) == 0
    assert (here / "crane" / "closed_loop.npz").exists()
    assert "Closed" in capsys.readouterr().out
    assert main([*line.split(), "--no-loop"]) == 0
    assert {f.name for f in (here / "crane").iterdir()} == set(FILES) - {"closed_loop.npz"}
    assert "Closed" not in capsys.readouterr().out


def test_a_law_that_cannot_be_made_is_told_and_the_rest_kept(here, capsys):
    line = "run vtol-centre --no-verify --no-figures --law computed --out vtol"
    assert main(line.split()) == 1
    assert "Closed loop: UnstableInternalDynamics" in capsys.readouterr().out
    assert (here / "vtol" / "run.npz").exists() and not (here / "vtol" / "closed_loop.npz").exists()


def test_a_loop_that_is_lost_is_kept_to_its_last_finite_sample(here, capsys):
    assert main("run overhead-crane --no-verify --delay 40 --out crane".split()) == 1
    assert "Closed loop: IntegrationStopped" in capsys.readouterr().out
    facts = json.loads((here / "crane" / "summary.json").read_text(encoding="utf-8"))["closed_loop"]
    run = sv.load(here / "crane" / "closed_loop.npz")
    assert not facts["success"] and facts["t_end"] == run.t[-1] < 4.0 and not run.success
    assert np.isfinite(run.jets).all() and (here / "crane" / "sheet.png").exists()


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ("--machine m_lod=115", ["No parameter is named 'm_lod'", "Nearest: 'm_load'"]),
        ("--noise thet=1", ["No state of the mechanism is named 'thet'", "Nearest: 'theta'"]),
        ("--limit troley=100", ["No actuator is named 'troley'", "Nearest: 'trolley'"]),
        ("--no-loop --rate 50 --integral", ["--integral, --rate were given with --no-loop"]),
        ("--law computed --integral", ["--integral was given with --law computed"]),
        ("--no-loop --delay 1 --machine m_load=0", ["--machine, --delay were given with --no-loop"]),
        ("--law feedforward --noise x=1e-3", ["--noise was given with --law feedforward, which measures nothing"]),
        ("--seed 0", ["--seed was given with no --noise"]),
        ("--machine m_load=1 m_load=2", ["--machine m_load was given twice"]),
    ],
)
def test_options_that_make_no_sense_are_refused_before_the_motion(here, capsys, monkeypatch, options, facts):
    monkeypatch.setattr(sv, "simulate", lambda *_, **__: pytest.fail("computed first"))
    assert main(["run", "overhead-crane", *options.split()]) == 2
    err = words(capsys.readouterr().err)
    assert all(fact in err for fact in facts) and not (here / "servoctl-runs").exists()


@pytest.mark.parametrize(
    "options",
    [
        "--rate 0",
        "--rate -5",
        "--rate nan",
        "--seed -1",
        "--delay -1",
        "--noise x=nan",
        "--noise x=-1",
        "--machine m_load=inf",
    ],
)
def test_numbers_that_make_no_sense_are_refused_by_the_parser(capsys, options):
    with pytest.raises(SystemExit):
        main(["run", "overhead-crane", *options.split()])
    assert f"argument {options.split()[0]}: " in capsys.readouterr().err


@pytest.mark.parametrize("limit", ["trolley", "trolley=0", "trolley=3:1", "trolley=a:b", "=4", "trolley=1:2:3"])
def test_limits_that_cannot_be_read(capsys, limit):
    with pytest.raises(SystemExit):
        main(["run", "overhead-crane", "--limit", limit])
    assert "neither NAME=LOW:HIGH nor NAME=SIZE" in capsys.readouterr().err


# the figure ------------------------------------------------------------------------------------------------------------


def curves(ax):
    return {line.get_label(): line for line in ax.get_lines() if not line.get_label().startswith("_")}


def test_the_figure_of_a_loop_shows_errors_inputs_and_limits(plan):
    machine = sv.plant(CRANE, m_load=115.0, limits={"trolley": 140.0})
    run = sv.close(machine, sv.lqr(plan, sv.plant(CRANE)), plan.state(0.0), (0.0, 8.0))
    axes = sv.figures.closed(run)
    labels = ["residuals, SI", "off the plan [m]", "off the plan [rad]", "trolley [N]", "hoist [N]"]
    assert [ax.get_ylabel() for ax in axes] == labels and axes[-1].get_xlabel() == "t [s]"
    assert list(curves(axes[0])) == ["X", "Z"] and list(curves(axes[1])) == ["x", "l"]
    assert np.array_equal(curves(axes[0])["X"].get_ydata(), run.residual["X"][0])
    assert np.array_equal(curves(axes[2])["theta"].get_ydata(), run.error["theta"])
    trolley = curves(axes[3])
    assert list(trolley) == ["plan", "command", "input", "limit"] and list(curves(axes[4])) == ["plan", "input"]
    assert np.array_equal(trolley["input"].get_ydata(), run["trolley"])
    assert np.abs(trolley["plan"].get_ydata()).max() == pytest.approx(137.99, abs=0.05)
    drawn = [line.get_ydata()[0] for line in axes[3].get_lines() if to_hex(line.get_color()) == LIMIT.lower()]
    assert drawn == [-140.0, 140.0] and axes[3].get_ylim()[0] < -140.0 < 140.0 < axes[3].get_ylim()[1]
    assert axes[0].figure.get_figwidth() == 10.0


def test_a_loop_without_plan_is_drawn_by_name():
    x0 = {"x": 0.0, "l": 4.0, "theta": 0.1, "dx": 0.0, "dl": 0.0, "dtheta": 0.0}
    run = sv.close(sv.plant(CRANE), lambda t, y: [0.0, -981.0], x0, (0.0, 1.0), timing=sv.Timing(rate=50.0))
    axes = sv.figures.closed(run)
    assert [ax.get_ylabel() for ax in axes] == ["trolley [N]", "hoist [N]"] and list(curves(axes[0])) == ["input"]
