"""Sweeps: the same table whoever computes it, no failure and no finished work lost; cases."""

import functools
import json
import math
import multiprocessing
import os
import pickle
import re
import signal
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from conftest import needs
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, ServoError, SpecificationError
from servoctl.gallery import overhead_crane
from servoctl.study.cases import FAILURE

LOADS = {"m_load": lambda rng: rng.normal(115.0, 5.0)}


@functools.cache
def design():
    """Crane, plan and law, once in each process."""
    mechanism, program = overhead_crane()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0), progress=False)
    return mechanism, plan, sv.lqr(plan, sv.plant(mechanism), rate=100.0)


def crane_loop(m_load, rng):
    mechanism, plan, law = design()
    plant, seed = sv.plant(mechanism, m_load=m_load), int(rng.integers(2**31))
    return sv.close(plant, law, plan.state(0.0), (0.0, 1.0), sensors=sv.Sensors(noise={"theta": 1e-3}, seed=seed))


def halves(m):
    return {"half": m / 2}


def picky(m):
    if m == 2:
        raise SpecificationError("m is 2.", "It is not.", m=m)
    if m == 3:
        sys.exit("over")
    return {"r": math.nan if m == 4 else float(m), "word": "even" if m % 2 == 0 else "odd"}


def deadly(m):
    if m == 5:
        os._exit(1)
    return {"r": m}


def same(a, b):
    """Whether two studies are equal bit for bit."""
    assert list(a.columns) == list(b.columns)
    return all(a[name].dtype == b[name].dtype and a[name].tobytes() == b[name].tobytes() for name in a.columns)


def spawned(workers):
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


# whoever computes ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loops():
    return sv.sweep(crane_loop, sv.monte_carlo(8, seed=1, **LOADS), seed=2)


def test_closed_loops_in_this_process(loops):
    assert loops.meta["message"] == "8 of 8 cases finished"
    assert len(np.unique(loops["X_worst"])) == 8
    direct = crane_loop(loops["m_load"][3], np.random.Generator(np.random.Philox(key=2, counter=[0, 3, 1, 0])))
    assert loops["trolley_max"][3] == direct["trolley"].max()
    assert loops["X_last"][3] == abs(direct.residual["X"][0][-1])


def test_processes_give_the_same_bits(loops):
    with spawned(2) as pool:
        assert same(loops, sv.sweep(crane_loop, sv.monte_carlo(8, seed=1, **LOADS), seed=2, executor=pool))


def test_threads_give_the_same_bits(loops):
    with ThreadPoolExecutor(2) as pool:
        assert same(loops, sv.sweep(crane_loop, sv.monte_carlo(8, seed=1, **LOADS), seed=2, executor=pool))


def test_dask_gives_the_same_bits(loops):
    dask = needs("dask.distributed")
    with (
        dask.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        dask.Client(cluster) as client,
    ):
        executor = client.get_executor()
        assert same(loops, sv.sweep(crane_loop, sv.monte_carlo(8, seed=1, **LOADS), seed=2, executor=executor))


def test_the_script_of_the_docs_runs(tmp_path, monkeypatch, capsys):
    """With threads in place of its processes, which the tests above start."""
    text = (Path(__file__).parents[1] / "docs" / "sweeps.md").read_text(encoding="utf-8")
    (tmp_path / "loops.py").write_text(re.search(r"```python\n(.*?)\n\nstudy", text, re.S)[1] + "\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    script = re.search(r"```py\n(.*?)```", text, re.S)[1]
    for processes, threads in (
        ("import ProcessPoolExecutor", "import ThreadPoolExecutor as ProcessPoolExecutor"),
        ("(2, mp_context=spawn)", "(2)"),
        ("n_workers=2,", "n_workers=1, processes=False,"),
    ):
        assert processes in script
        script = script.replace(processes, threads)
    exec(compile(script, "sweeps.md", "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out == "True\n"


# cases ---------------------------------------------------------------------------------------------------------------


def test_a_grid_has_all_combinations_the_last_name_fastest():
    assert sv.grid(a=[1, 2], b=[3, 4], c=5) == [
        {"a": 1, "b": 3, "c": 5}, {"a": 1, "b": 4, "c": 5}, {"a": 2, "b": 3, "c": 5}, {"a": 2, "b": 4, "c": 5},
    ]  # fmt: skip


def test_random_cases_depend_on_seed_index_and_name_alone():
    few = sv.monte_carlo(5, seed=1, **LOADS)
    assert sv.monte_carlo(9, seed=1, **LOADS)[:5] == few
    assert [case["m_load"] for case in sv.monte_carlo(5, seed=1, l=lambda rng: rng.random(), **LOADS)] == [
        case["m_load"] for case in few
    ]
    assert sv.monte_carlo(5, seed=2, **LOADS) != few
    assert len({case["m_load"] for case in few}) == 5


def test_distributions_of_scipy_are_drawn_from():
    from scipy import stats

    frozen = stats.norm(100.0, 5.0)
    new = stats.Normal(mu=100.0, sigma=5.0) if hasattr(stats, "Normal") else frozen  # of SciPy 1.15
    cases = sv.monte_carlo(400, seed=1, a=frozen, b=new, c=7.0)
    for name in "ab":
        values = np.array([case[name] for case in cases])
        assert abs(values.mean() - 100.0) < 4 * 5.0 / 20 and abs(values.std() - 5.0) < 4 * 5.0 / np.sqrt(800)
    assert {case["c"] for case in cases} == {7.0}


def test_columns_are_cases_as_well():
    assert same(sv.sweep(halves, {"m": np.array([1.0, 3.0])}), sv.sweep(halves, [{"m": 1.0}, {"m": 3.0}]))


@pytest.mark.parametrize(
    ("cases", "fact"),
    [
        ([], "case"),
        ({"m": [1, 2], "l": [1]}, {"lengths": {"m": 2, "l": 1}}),
        ([{"m": 1}, {"l": 1}], {"case": 1}),
        ([{"m": [1, 2]}], {"name": "m", "case": 0}),
        ([{"m": math.inf}], {"name": "m", "case": 0}),
        ([3], {"case": 0}),
        ([{"error": 1}], {"name": "error"}),
        ([{"l": 1}], {"parameters": ["l"]}),
    ],
)
def test_cases_that_form_no_table_are_refused(cases, fact):
    with refused(SpecificationError, fact):
        sv.sweep(halves, cases)


@pytest.mark.parametrize(
    ("call", "fact"),
    [
        (lambda: sv.grid(m=[]), {"name": "m"}),
        (lambda: sv.monte_carlo(-1, seed=1), "n=-1"),
        (lambda: sv.monte_carlo(2, seed=None), "seed=None"),
        (lambda: sv.monte_carlo(2, seed=1, m=[1, 2]), {"name": "m"}),
        (lambda: sv.monte_carlo(2, seed=1, m=lambda rng: rng.normal(1.0, -1.0)), {"name": "m"}),
        (lambda: sv.sweep(halves, sv.grid(m=1), executor=2), "executor=2"),
        (lambda: sv.sweep(halves, sv.grid(m=1), executor=ThreadPoolExecutor), "ThreadPoolExecutor"),
        (lambda: sv.sweep(halves, sv.grid(m=1), seed=1), {"seed": 1}),
        (lambda: sv.sweep(crane_loop, sv.grid(m_load=100)), {"seed": None}),
        (lambda: sv.sweep(3, sv.grid(m=1)), "case is 3"),
    ],
)
def test_what_cannot_be_swept_is_refused(call, fact):
    with refused(SpecificationError, fact):
        call()


def test_a_function_that_processes_cannot_receive_is_refused_before_anything_runs():
    with spawned(1) as pool, refused(SpecificationError, "lambda"):
        sv.sweep(lambda m: {"r": m}, sv.grid(m=[1]), executor=pool)


# failures ------------------------------------------------------------------------------------------------------------


def test_failures_are_rows_with_their_facts():
    study = sv.sweep(picky, sv.grid(m=[1, 2, 3, 4]))
    assert study["error"].tolist() == ["", "SpecificationError", "SystemExit", ""]
    assert study["message"].tolist() == ["", "m is 2. It is not.", "over", ""]
    assert json.loads(study["facts"][1]) == {"m": 2}
    assert study["word"].tolist() == ["odd", "", "", "even"]
    assert study["r"][0] == 1.0 and np.isnan(study["r"][1:]).all()
    assert study.meta["message"] == "2 of 4 cases finished, 2 failed"


@pytest.mark.parametrize("result", [[1.0], {"r": [1.0]}, {"m": 1.0}, {"error": 1.0}, None])
def test_results_that_fit_no_table_are_failures(result):
    row = sv.sweep(lambda m: result, sv.grid(m=[1])).rows()[0]
    assert row["error"] == "SpecificationError" and "returned" in row["message"]


def test_a_pool_that_dies_leaves_what_was_finished():
    with spawned(1) as pool:
        study = sv.sweep(deadly, sv.grid(m=range(12)), executor=pool)
    done = study["case"][study["error"] == ""].tolist()
    assert len(study) == 12 and done == [0, 1, 2, 3, 4] and study.meta["lost"] == list(range(5, 12))
    assert set(study["error"][5:]) == {"BrokenProcessPool"}
    assert "did not finish this case" in study["message"][7]
    assert "7 not finished by the executor" in study.meta["message"]


def test_a_pool_that_dies_at_once_is_an_error():
    with spawned(1) as pool, refused(ServoError, "2 cases", error="BrokenProcessPool"):
        sv.sweep(deadly, sv.grid(m=[5, 5]), executor=pool)


def test_a_pool_that_was_shut_down_is_an_error():
    with ThreadPoolExecutor(1) as pool:
        pass
    with refused(ServoError, "1 cases", error="RuntimeError"):
        sv.sweep(halves, sv.grid(m=[1]), executor=pool)


def test_ctrl_c_returns_what_is_done():
    def interrupted(m):
        if m == 3:
            raise KeyboardInterrupt
        return {"r": m}

    study = sv.sweep(interrupted, sv.grid(m=range(6)))
    assert study["r"].tolist() == [0, 1, 2] and study.meta["interrupted"]
    assert study.meta["message"] == "3 of 6 cases finished, interrupted"


def test_a_case_that_swallows_ctrl_c_is_not_finished():
    # a shell's background jobs ignore Ctrl-C from the start, and pytest may be one of them
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    def swallowing(m):
        try:
            signal.raise_signal(signal.SIGINT) if m == 3 else None
        except KeyboardInterrupt:
            return {"r": -1.0}
        return {"r": float(m)}

    try:
        study = sv.sweep(swallowing, sv.grid(m=range(6)))
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert study["r"].tolist() == [0.0, 1.0, 2.0] and study.meta["interrupted"]


# tables and figures --------------------------------------------------------------------------------------------------


def test_a_run_gives_extrema_final_values_and_its_residual(gallery_model):
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0), progress=False)
    row = sv.sweep(lambda m: run, {"m": [1]}).rows()[0]
    assert [name for name in row if name not in FAILURE][2:] == [
        f"{name}_{what}" for name in ("trolley", "hoist", "tension", "X", "Z") for what in ("min", "max", "end")
    ] + ["residual", "t_end"]
    assert row["trolley_max"] == run["trolley"].max() and row["tension_end"] == run["tension"][-1]
    assert row["residual"] == max(np.abs(run.residual[name]).max() for name in run.residual) and row["t_end"] == 8.0


def test_a_study_is_saved_loaded_and_given_to_xarray(tmp_path):
    xarray = needs("xarray")
    study = sv.sweep(picky, sv.grid(m=[1, 2, 3, 4]))
    loaded = sv.load(study.save(tmp_path / "study"))
    assert same(study, loaded) and loaded.meta == study.meta
    study.to_xarray().to_netcdf(tmp_path / "study.nc")
    with xarray.open_dataset(tmp_path / "study.nc") as data:
        assert np.array_equal(data["r"], study["r"], equal_nan=True)
        assert data["error"].values.tolist() == study["error"].tolist()
        assert data.attrs["message"] == study.meta["message"]


def test_the_figure_shows_percentiles_dependence_and_failures():
    def case(a, b):
        if a > 1.95:
            raise ValueError
        return {"r": 10 * a + b, "still": 1.0}

    study = sv.sweep(case, sv.monte_carlo(200, seed=1, a=lambda r: r.uniform(0, 2), b=lambda r: r.uniform(0, 2)))
    figure = sv.figures.sweep(study, units={"r": "N"})
    histogram, scatter = figure.axes
    assert (histogram.get_xlabel(), scatter.get_xlabel(), scatter.get_ylabel()) == ("r [N]", "a", "r [N]")
    lines = [line.get_xdata()[0] for line in histogram.get_lines()]
    finished = study["r"][study["error"] == ""]
    assert np.allclose(lines, np.percentile(finished, [5, 50, 95]))
    assert sum(patch.get_height() for patch in histogram.patches) == len(finished)
    failed = len(study) - len(finished)
    assert failed and scatter.get_legend().get_texts()[0].get_text() == f"{failed} without result"
    assert sv.figures.sweep(study, ["r"], "b").axes[1].get_xlabel() == "b"
    with pytest.raises(NameUnknown):
        sv.figures.sweep(study, ["rr"])
    with refused(SpecificationError, "2 rows"):
        sv.figures.sweep(study.take([0, 1]), [])


def test_the_figure_shows_each_of_few_results():
    study = sv.sweep(lambda a: {"r": a * a}, sv.grid(a=[2.0, 1.0, 3.0]))
    results, scatter = sv.figures.sweep(study).axes
    (points,) = results.get_lines()
    assert points.get_xdata().tolist() == [1.0, 4.0, 9.0] and points.get_ydata().tolist() == [1, 2, 3]
    assert not results.patches and "at most" in results.get_ylabel() and len(scatter.get_lines()[0].get_xdata()) == 3


def test_a_sweep_of_functions_pickles_by_name():
    assert pickle.loads(pickle.dumps(halves)) is halves


def test_more_cases_than_fit_into_memory_are_refused():
    assert len(sv.grid(m=range(1000), k=range(1000))) == 10**6
    for make in (lambda: sv.grid(m=range(1001), k=range(1000)), lambda: sv.grid(m=range(10**15)),
                 lambda: sv.monte_carlo(10**6 + 1, seed=1, m=1.0), lambda: sv.monte_carlo(10**30, seed=1, m=1.0)):
        with refused(sv.errors.SpecificationError, most=10**6):
            make()
