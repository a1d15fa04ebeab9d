"""A run by its names: as a mapping, in files, with its model again."""

import numpy as np
import pytest
from refusals import refused
from test_continuation import arm, moved

import servoctl as sv
from servoctl import plots


@pytest.fixture(scope="module")
def run():
    return moved("spiral", np.linspace(0, 3, 301))


def test_a_run_goes_by_its_names_like_a_mapping(run):
    assert list(run) == list(run.keys()) == list(run.names) and len(run) == len(run.names)
    assert "a" in run and "u" in run and "q" not in run and 3 not in run
    values = dict(run)
    assert list(values) == list(run.names) and all(values[name] is run[name] for name in ("u", "energy"))


def test_a_closed_loop_goes_by_its_names(run):
    plant = sv.plant(run.model.reduction.mechanism)
    closed = sv.close(plant, sv.lqr(run, plant, rate=100), run.state(0.0), (0.0, 0.1), plan=run)
    assert list(closed) == list(closed.names) and "u" in closed and "w" not in closed
    assert dict(closed)["u"] == pytest.approx(closed["u"])


def test_a_run_is_loaded_with_its_model(run, tmp_path):
    assert len(run.variants) > 2
    path = run.save(tmp_path / "plan")
    model = sv.derive(run.model.reduction.mechanism, run.model.reduction.program)  # derived again
    loaded = sv.load(tmp_path / "plan", model=model)
    assert loaded == run and loaded.start == run.start and path.suffix == ".npz"
    assert sv.verify(model, loaded).passed
    plant = sv.plant(model.reduction.mechanism)
    law, other = (sv.lqr(plan, plant, rate=100) for plan in (run, loaded))
    assert np.array_equal(law.schedule, other.schedule)
    assert sv.load(path).model is None and sv.load(path).start == run.start


def test_a_run_is_not_loaded_with_another_model(run, tmp_path, gallery_model):
    path = run.save(tmp_path / "plan.npz")
    with refused(sv.SpecificationError, residuals=["X", "Y"]):
        sv.load(path, model=arm("circle")[0])
    with refused(sv.SpecificationError, "parameters"):
        sv.load(path, model=gallery_model("overhead-crane"))
    with refused(sv.SpecificationError, "str", model="str"):
        sv.load(path, model="spiral")


def test_a_run_of_other_parameters_is_refused(gallery_model, tmp_path):
    model = gallery_model("overhead-crane")
    name, value = next(iter(model.numbers.items()))
    run = sv.simulate(model, model.start(), (0.0, 1.0), t_eval=np.linspace(0, 1, 11))
    path, heavier = run.save(tmp_path / "crane"), model.with_parameters(**{name: 1.5 * value})
    with refused(sv.SpecificationError, parameters={name: (value, 1.5 * value)}):
        sv.load(path, model=heavier)
    assert sv.load(path, model=heavier.with_parameters(**{name: value})) == run


def test_the_suffix_of_a_file_may_be_left_out(run, tmp_path):
    run.save(tmp_path / "plan.v2")
    assert sv.load(tmp_path / "plan.v2").message == sv.load(tmp_path / "plan.v2.npz").message == "finished"
    with refused(sv.ServoError, "plan.v3"):
        sv.load(tmp_path / "plan.v3")


def test_signals_are_drawn_by_several_names(run):
    units = {"a": "rad", "b": "rad"}
    (ax,) = plots.signals(run, "a", "b", units=units)
    assert len(ax.lines) == len(plots.signals(run, ["a", "b"], units=units)[0].lines) == 2
