"""The measured trade: every candidate has its row, the numbers are those of a run, and the advice follows from them."""

import csv
import json

import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import LimitExceeded, NameUnknown, ServoError, SingularProgram, SpecificationError
from servoctl.figures.work_precision import COLOURS
from servoctl.gallery import gallery
from servoctl.methods.accuracy import motion_error
from servoctl.methods.choice import METHODS as ALL_METHODS
from servoctl.methods.choice import as_method
from servoctl.shell.main import main
from servoctl.study import tradeoff as module
from servoctl.study.load import load
from servoctl.study.table import Study
from servoctl.study.tradeoff import TOLERANCES as DEFAULTS
from servoctl.study.tradeoff import TradeOff

SPAN = (0.0, 1.0)
TOLERANCES, STEPS = (1e-3, 1e-6, 1e-9), (0.1, 0.025, 0.005)
METHODS = {"Taylor": TOLERANCES, "DOP853": TOLERANCES, "RK4": STEPS, "LSODA": TOLERANCES}
DRIFTS = (None, "project", 0.05)


@pytest.fixture(scope="module")
def scene(wheel):
    return wheel


@pytest.fixture(scope="module")
def study(scene):
    return sv.tradeoff(*scene, SPAN, METHODS, DRIFTS)


def synthetic(errors, seconds, uncertainty=1e-12, **changes):
    n = len(errors)
    columns = {name: [np.nan] * n for name in TradeOff.COLUMNS}
    columns |= {"method": ["Taylor"] * n, "drift": ["project"] * n, "setting": ["rtol"] * n, "failure": [""] * n}
    columns |= {"model": [""] * n}
    columns |= {"error": errors, "seconds": seconds, "value": [10.0**-k for k in range(n)], **changes}
    reference = {"method": "a", "verified by": "b", "error": uncertainty, "actuation": 0.0, "cpu": 1.0}
    machine = {"processor": "p", "cores": 1, "compiler": "cc"}
    facts = {"t_span": [0.0, 1.0], "models": [""], "cpu": 2.0, "budget": 30.0, "left out": 0, "reference": reference, "machine": machine}
    return TradeOff("tradeoff", columns, facts)


# --- rows


def test_each_candidate_has_a_row(study):
    for method in METHODS:
        for drift in ("none", "project", "0.05"):
            rows = study.where(method=method, drift=drift).rows()
            if (method, drift) in (("LSODA", "project"), ("Taylor", "0.05")):
                assert len(rows) == 1 and "was given with method" in rows[0]["failure"]
            else:
                assert [row["value"] for row in rows] == list(STEPS if method == "RK4" else TOLERANCES)
    measured = study.take(np.flatnonzero(study["failure"] == ""))
    for name in ("error", "actuation", "residual", "energy", "power", "evaluations", "seconds"):
        assert np.all(np.isfinite(measured[name])), name


@pytest.mark.parametrize("drift, method, step", [("none", "RK4", 0.1), ("project", "RK4", 0.025)])
def test_the_numbers_are_those_of_the_run(drift, method, step, study, scene):
    model, start = scene
    row = study.where(method=method, drift=drift, value=step).rows()[0]
    run = sv.simulate(model, start, SPAN, as_method(method, step=step), drift=drift, t_eval=instants())
    exact = sv.simulate(model, start, SPAN, sv.methods.Adaptive("DOP853", rtol=3e-14, atol=1e-15), t_eval=run.t)
    assert row["error"] == pytest.approx(motion_error(model, run.jets, exact.jets), rel=1e-3)
    assert row["residual"] == max(np.abs(run.residual[name]).max() for name in run.residual)
    assert row["evaluations"] == run.counters["nfev"] and row["steps"] == run.counters["steps"]
    force, wanted = run.signals("inputs")[1], exact.signals("inputs")[1]
    size = np.abs(wanted).max(axis=1, keepdims=True)
    size = np.maximum(size, 1e-3 * size.max())
    assert row["actuation"] == pytest.approx((np.abs(force - wanted) / size).max(), rel=1e-3)
    assert row["energy"] == pytest.approx(np.abs(np.ptp(run["energy"]) / exact["energy"].max()), rel=0.5, abs=1e-12)


def instants():
    return np.array([0.0, *((np.arange(400) + 0.382) / 400), 1.0])


def test_errors_between_the_steps_count(scene):
    """At its six steps RK8 has 2e-7; between them Hermite's interpolation leaves a thousand times more."""
    study = sv.tradeoff(*scene, (0.0, 2.0), {"RK8": [0.4, 0.1, 0.02], "Taylor": DEFAULTS}, ["project"])
    coarse, fine = study.where(method="RK8", value=0.4), study.where(method="RK8", value=0.02)
    assert coarse["error"][0] > 1e-5 and fine["error"][0] < 1e-9
    for error in (1e-4, 1e-6, 1e-8):
        best = study.recommend(error=error)
        run = sv.simulate(*scene, (0.0, 2.0), **best)
        dense = np.random.default_rng(3).uniform(0.0, 2.0, 1500)
        exact = sv.simulate(*scene, (0.0, 2.0), sv.methods.Taylor(rtol=1e-15, atol=1e-15), drift="project", t_eval=np.sort(dense))
        jets = np.array([run.at(t) for t in exact.t]).T
        assert motion_error(scene[0], jets, exact.jets) <= 1.5 * error


def test_a_program_that_leaves_nothing_to_integrate_is_not_integrated(gallery_model):
    scene, model = gallery["overhead-crane"], gallery_model("overhead-crane")
    study = sv.tradeoff(model, model.start(guess=scene.guess), (0.0, 8.0))
    assert set(study["method"]) == {"algebraic"} and study["error"][0] <= study.uncertainty


def test_finer_settings_have_smaller_errors(study):
    for method in METHODS:
        errors = study.where(method=method, drift="none")["error"]
        assert np.all(np.diff(errors[np.isfinite(errors)]) < 0)


def test_the_reference_is_verified_by_another_method(study):
    reference = study.meta["reference"]
    assert reference["method"].startswith("Taylor") and reference["verified by"].startswith("DOP853")
    assert 0 < reference["error"] < 1e-11 and reference["actuation"] < 1e-11 and reference["energy"] < 1e-11
    assert np.array_equal(study["resolved"] == 1, study["error"] >= reference["error"])


def test_the_machine_is_recorded(study):
    machine = study.meta["machine"]
    assert machine["cores"] >= 1 and machine["processor"] and machine["compiler"]
    assert set(machine["versions"]) == {"servoctl", "python", "casadi", "numpy", "scipy"}


COSTS = {("RK4", 0.1): 0.01, ("RK4", 0.025): 0.04, ("RK4", 0.005): 2.0, ("Taylor", 1e-3): 0.1, ("Taylor", 1e-6): 0.3,
         ("Taylor", 1e-9): 0.5, ("DOP853", 1e-3): np.inf, ("DOP853", 1e-6): 0.2, ("DOP853", 1e-9): 90.0}  # fmt: skip


@pytest.fixture
def measured(monkeypatch):
    """Settings in the order in which they were begun, on a clock that their costs [s] drive; what costs inf is lost."""
    clock, begun = [0.0], []

    def run(comparison, motion, method, treatment, value, limit):
        needed = COSTS[str(method), value]
        begun.append((str(method), value))
        clock[0] += min(needed, limit)
        if needed > limit:
            raise LimitExceeded(f"More than {limit:.2g} s of CPU: ended at t = 0.5 s of 1 s", needed=needed)
        names = ("error", "integration", "actuation", "residual", "energy")
        return dict.fromkeys(names, value) | {"seconds": needed, "evaluations": 1}

    monkeypatch.setattr(module, "cpu_seconds", lambda: clock[0])
    monkeypatch.setattr(module, "_errors_and_cost", run)
    return begun


def test_what_needs_least_is_measured_first_and_what_does_not_fit_says_so(scene, measured):
    methods = {"RK4": STEPS, "Taylor": TOLERANCES, "DOP853": TOLERANCES}
    study = sv.tradeoff(*scene, SPAN, methods, [None], budget=12.0)
    coarse = [("DOP853", 1e-3), ("RK4", 0.1), ("RK4", 0.025), ("Taylor", 1e-3), ("Taylor", 1e-6), ("RK4", 0.005)]
    assert measured[:6] == coarse, "what needs no code of its own comes first; the second row shows what a row needs"
    assert study.meta["cpu"] <= 12.0 and len(study) == 8
    assert study.where(method="Taylor")["value"].tolist() == list(TOLERANCES)
    assert study.where(method="RK4")["value"].tolist() == list(STEPS), "what was cut has a longer run later"
    found, failed = study.where(method="DOP853").rows()
    assert found["value"] == 1e-6, "a coarse setting that gets lost says nothing about finer ones"
    assert "LimitExceeded: More than" in failed["failure"] and "also none 1e-09" in failed["failure"]


def test_a_budget_that_suffices_for_nothing_says_so(scene):
    study = sv.tradeoff(*scene, SPAN, {"RK4": STEPS, "DOP853": TOLERANCES}, [None], budget=1e-9)
    assert study["method"].tolist() == ["RK4", "DOP853"] and np.isnan(study["error"]).all()
    for failure in study["failure"]:
        assert failure.startswith("Budget: ") and "of 1e-09 s were left. Finer ones likewise: 2." in failure
    assert "(2 Budget)" in repr(study) and f"CPU {study.meta['reference']['cpu']:.2g} s for the reference" in repr(study)
    with refused(LimitExceeded, "see the column failure"):
        study.recommend(error=1e-3)


def test_a_method_that_cannot_run_is_one_row_with_its_reasons(scene):
    study = sv.tradeoff(*scene, SPAN, {"DOP853": [1e-3, 1e-16], "LSODA": 1e-3}, ["project", 0.05])
    assert study.where(method="DOP853")["value"].tolist()[:2] == [1e-3, 1e-3]
    *_, failed = study.where(method="DOP853").rows()
    assert len(study.where(method="DOP853")) == 3 and failed["drift"] == "" and np.isnan(failed["value"])
    assert "rtol=1e-16" in failed["failure"] and "also 0.05 1e-16: SpecificationError" in failed["failure"]
    assert "was given with method" in study.where(method="LSODA", drift="project")["failure"][0]


def test_defaults_leave_out_what_does_not_go_together(scene):
    study = sv.tradeoff(*scene, SPAN, {"Taylor": 1e-3, "LSODA": 1e-3})
    assert list(zip(study["method"].tolist(), study["drift"].tolist(), strict=True)) == [
        ("Taylor", "none"), ("Taylor", "project"), ("LSODA", "none"), ("LSODA", "0.02"),
    ]  # fmt: skip


def test_one_sentence_says_what_to_take():
    several = synthetic([1e-2, 1e-6, 1e-9, 1e-5], [1e-3, 2e-3, 5e-3, 1.0], method=["Taylor"] * 3 + ["RK4"])
    sentence = "  Taylor at rtol 0.1, projected: 1e-06 for 2 ms; of these rows, below 1e-05 only Taylor. Fastest for each"
    assert sentence in repr(several)
    alike = synthetic([1e-2, 1.01e-9, 1e-9], [1e-3, 2e-3, 5e-3], method=["RK4", "RK8", "Taylor"])
    assert "below" not in repr(alike)
    assert "no row has numbers" in repr(synthetic([np.nan], [np.nan]))


def test_a_program_without_free_values_is_solved(gallery_model):
    model, scene = gallery_model("overhead-crane"), gallery["overhead-crane"]
    start = model.start(guess=scene.guess)
    crane = sv.tradeoff(
        model,
        start,
        (0.0, 8.0),
        {"algebraic": [0.1], "Taylor": [1e-3, 1e-6], "RK4": 0.1},
        [None, "project"],
    )
    assert crane.meta["reference"]["method"] == "algebraic" and crane.uncertainty < 1e-12
    solved = crane.where(method="algebraic")
    assert len(solved) == 1 and solved["error"][0] <= 1e-12 and solved["actuation"][0] <= 1e-11
    assert crane.where(method="RK4", drift="none")["error"][0] > 1e-9
    assert crane.recommend(error=1e-12) == {"method": sv.methods.Algebraic()}


# --- advice


def test_the_front_is_what_nothing_beats(study):
    front = study.pareto()
    observed = np.maximum(study["error"], study.uncertainty)
    good = np.isfinite(observed)
    wanted = [
        i for i in np.flatnonzero(good)
        if not np.any(good & (observed <= observed[i]) & (study["seconds"] <= study["seconds"][i])
                      & ((observed < observed[i]) | (study["seconds"] < study["seconds"][i])))
    ]  # fmt: skip
    assert sorted(front["seconds"]) == sorted(study["seconds"][wanted])
    assert np.all(np.diff(front["seconds"]) > 0)
    assert study.pareto("evaluations")["method"][0] == "Taylor"


def test_a_recommendation_is_kept(study, scene):
    best = study.recommend(error=1e-6)
    assert best.row["error"] <= 1e-6
    run = sv.simulate(*scene, SPAN, **best)
    exact = sv.simulate(*scene, SPAN, sv.methods.Adaptive("DOP853", rtol=3e-14, atol=1e-15), t_eval=run.t)
    assert motion_error(scene[0], run.jets, exact.jets) <= 2e-6
    assert study.recommend(seconds=1e3).row["error"] == study.pareto()["error"][-1]


def test_the_fastest_within_an_error_and_the_best_within_a_time():
    made = synthetic([1e-2, 1e-6, 1e-9, np.nan, 1e-15], [1e-3, 2e-3, 5e-3, np.nan, 1.0])
    assert made.recommend(error=1e-5) == {"method": sv.methods.Taylor(rtol=0.1, atol=1e-3), "drift": "project"}
    assert made.recommend(seconds=6e-3)["method"].rtol == 0.01
    assert made.recommend(error=1e-12)["method"].rtol == 1e-4
    with refused(LimitExceeded, "error 1e-12 in 1 s", limit=1e-14, uncertainty=1e-12):
        made.recommend(error=1e-14)  # what lies below the reference's uncertainty is not known
    with refused(LimitExceeded, "error 0.01 in 0.001 s", limit=1e-5):
        made.recommend(seconds=1e-5)
    with refused(LimitExceeded, "failure", limit=1.0):
        synthetic([np.nan], [np.nan]).recommend(error=1.0)
    for given in ({}, {"error": 1e-3, "seconds": 1.0}):
        with refused(SpecificationError, "error=", "seconds="):
            made.recommend(**given)


def test_a_recommended_time_constant_is_the_measured_one(scene):
    constant = 1 / 7
    study = sv.tradeoff(*scene, SPAN, {"RK4": [0.01]}, [constant])
    assert study.recommend(error=1.0)["drift"] == constant


@pytest.mark.parametrize("drift", ["none", "project", "project 5", "0.05"])
def test_a_recommended_treatment_is_the_measured_one(drift):
    options = synthetic([1e-6], [1.0], drift=[drift]).recommend(error=1e-3)
    wanted = {"none": None, "project 5": sv.methods.Project(5), "0.05": 0.05}.get(drift, drift)
    assert options.get("drift") == wanted


# --- the table


def test_a_study_is_read_back(study, tmp_path):
    again = load(study.save(tmp_path / "trade"))
    assert type(again) is TradeOff and again.meta == study.meta and repr(again) == repr(study)
    for name in study.columns:
        np.testing.assert_array_equal(again[name], study[name])
    with open(study.csv(tmp_path / "trade.csv"), newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(study) and list(rows[0]) == list(TradeOff.COLUMNS)
    assert [float(row["error"]) for row in rows[:3]] == study["error"][:3].tolist()


def test_a_study_prints_in_twelve_lines(study):
    lines = repr(study).splitlines()
    assert 5 <= len(lines) <= 12 and max(map(len, lines)) <= 120
    assert "Taylor of order 16 at 1e-15; DOP853 at 3e-14 agrees to" in lines[1]
    assert len(repr(synthetic([10.0**-k for k in range(20)], np.arange(1.0, 21.0))).splitlines()) <= 12


def test_a_table_has_even_columns(tmp_path):
    table = Study("any", {"a": [1, None, 3.5], "b": ["x", None, "z"]})
    assert table.where(b="z").rows() == [{"a": 3.5, "b": "z"}] and np.isnan(table["a"][1]) and table["b"][1] == ""
    with refused(SpecificationError, "'a': 1", "'b': 2"):
        Study("any", {"a": [1], "b": [1, 2]})
    with refused(NameUnknown, name="c"):
        table.column("c")
    with refused(ServoError, "none.npz"):
        load(tmp_path / "none.npz")
    (tmp_path / "file").write_text("", encoding="utf-8")
    with refused(ServoError, "a.csv"):
        table.csv(tmp_path / "file" / "a.csv")


@pytest.mark.parametrize("cost", ["seconds", "evaluations"])
def test_the_plot_draws_every_number(cost, study):
    ax = study.plot(cost=cost, title="trade")
    drawn = [line for line in ax.lines if line.get_marker() not in ("None", "", None)]
    assert sum(len(line.get_xdata()) for line in drawn) == np.isfinite(study["error"]).sum()
    assert ax.get_xscale() == ax.get_yscale() == "log" and cost in ax.get_xlabel() and ax.get_title() == "trade"
    keys = {key.get_text(): line.get_color() for key, line in zip(ax.get_legend().get_texts(), ax.get_legend().get_lines(), strict=True)}
    assert {"projected", "poles at -1/(0.05 s)", "Pareto front"} <= set(keys)
    best = set(study.pareto(cost)["method"].tolist())
    (others,) = [text for text in keys if text.startswith("never best: ")]
    assert {method for method in ("Taylor", "DOP853", "RK4", "LSODA") if method in keys} == best & {"Taylor", "DOP853", "RK4", "LSODA"}
    assert set(others.removeprefix("never best: ").replace("\n", " ").split(", ")) == set(study["method"].tolist()) - best
    grey = sum(len(line.get_xdata()) for line in drawn if line.get_color() == keys[others])
    reaching = set(zip(study.pareto(cost)["method"].tolist(), study.pareto(cost)["drift"].tolist(), strict=True))
    rows = zip(study["method"].tolist(), study["drift"].tolist(), np.isfinite(study["error"]).tolist(), strict=True)
    assert grey == sum(good and (method, drift) not in reaching for method, drift, good in rows)
    with pytest.raises(NameUnknown):
        study.plot(cost="money")


# --- what is refused


@pytest.mark.parametrize(
    "given, error, fact",
    [
        ({"methods": ["RK3"]}, NameUnknown, "No method is named 'RK3'"),
        ({"methods": {"DOP853": [1e-3, -1.0]}}, SpecificationError, "rtol of DOP853=[0.001, -1.0] was given"),
        ({"methods": {"order": [8]}}, NameUnknown, "No method is named 'order'"),
        ({"methods": {"RK4": "fine"}}, SpecificationError, "step of RK4='fine' was given"),
        ({"methods": {"RK4": []}}, SpecificationError, "step of RK4=[] was given"),
        ({"budget": 0.0}, SpecificationError, "budget=0.0 was given"),
        ({"drift": ["often"]}, NameUnknown, "drift treatment"),
        ({"drift": [sv.methods.Poles({"x_c": [-1.0]})]}, SpecificationError, "time constant"),
        ({"t_span": (0.0, 0.0)}, SpecificationError, "two different finite times"),
        ({"t_span": 3.0}, SpecificationError, "two different finite times"),
    ],
)
def test_bad_input(given, error, fact, scene):
    with refused(error, fact):
        sv.tradeoff(*scene, given.pop("t_span", SPAN), **given)


def test_without_a_reference_there_is_no_trade(gallery_model):
    model, scene = gallery_model("appell-hamel-squared"), gallery["appell-hamel-squared"]
    with refused(SingularProgram, rows=["speed"], zero=["dphi"], t=pytest.approx(0.698311, abs=1e-5)):
        sv.tradeoff(model, model.start(guess=scene.guess, **scene.start), (0.0, 1.0), ["RK4"], [None])


def test_a_figure_of_failures_only_says_so(scene, tmp_path):
    found = sv.tradeoff(*scene, SPAN, ["Taylor"], [0.1])
    assert np.isnan(found["error"]).all() and len(found.pareto()) == 0
    ax = found.plot()
    ax.figure.savefig(tmp_path / "failed.png")
    assert [text.get_text() for text in ax.texts] == ["every run failed"]


def test_every_method_has_its_own_colour():
    assert len(set(COLOURS)) == len(COLOURS) >= len(ALL_METHODS) - 1  # bounded is not measured


# --- the command


def test_the_command_leaves_table_figure_and_advice(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = "tradeoff appell-hamel --t-span 0 0.5 --method Taylor RK4 --drift none --set b=0.21"
    assert main([*line.split(), "--error", "1e-6"]) == 0
    folder = tmp_path / "servoctl-runs" / "appell-hamel-tradeoff"
    names = {"tradeoff.npz", "tradeoff.csv", "tradeoff.png", "summary.json", "report.txt"}
    assert {path.name for path in folder.iterdir()} == names
    facts = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert facts["t_span"] == [0.0, 0.5] and facts["recommended"]["method"] in ("Taylor", "RK4")
    assert "Recommended: method=" in capsys.readouterr().out
    assert set(load(folder / "tradeoff.npz")["method"]) == {"Taylor", "RK4"}


def test_the_command_keeps_what_was_measured_where_nothing_reaches_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = "tradeoff appell-hamel --t-span 0 0.5 --method RK4 --drift none --out here --seconds 1e-9"
    assert main(line.split()) == 2
    assert "seconds=1e-09 was given" in capsys.readouterr().err
    assert (tmp_path / "here" / "tradeoff.csv").exists() and (tmp_path / "here" / "report.txt").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [("--budget", "0"), ("--error", "-1"), ("--seconds", "nan"), ("--budget", "inf"), ("--error", "x")],
)
def test_the_command_refuses_what_is_no_positive_number_before_it_measures(option, value, capsys):
    with pytest.raises(SystemExit):
        main(["tradeoff", "appell-hamel", f"{option}={value}"])
    assert "not a positive number" in capsys.readouterr().err
