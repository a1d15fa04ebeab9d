"""What a formulation costs: all give the same accelerations; their operations are those that the documentation prints."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from benchmarks.literature.formulations import NAMES, FormulationCost, formulation, formulation_cost
from benchmarks.literature.guided_arm import guided_arm
from servoctl.gallery import gallery
from servoctl.study.load import load

DOC = Path(__file__).parents[1] / "docs" / "formulations.md"
JOINTS = [(2, 1), (4, 1), (4, 2), (4, 3), (8, 1), (8, 4), (8, 7)]
BODIES = [(2, 1), (4, 1), (4, 3)]


@pytest.fixture(scope="module")
def joints():
    return formulation_cost(guided_arm, JOINTS, timed=False)


@pytest.fixture(scope="module")
def bodies():
    build, most = partial(guided_arm, coordinates="bodies"), ("eliminated", "sparse", "assembly")
    return formulation_cost(build, BODIES, most, timed=False)


def test_all_formulations_give_the_same_accelerations(joints, bodies):
    assert len(joints) == len(JOINTS) * len(NAMES)
    robust = joints["formulation"] != NAMES["qr"]
    assert joints["difference"][robust].max() < 1e-9
    assert joints["difference"].max() < 1e-7  # ca.solve loses digits with the condition
    assert bodies["difference"].max() < 1e-9


def test_the_accelerations_are_those_of_the_model():
    model = sv.derive(*guided_arm(4, 2))
    x = np.random.default_rng(1).uniform(0.2, 1.2, len(model.state_names))
    rates = model.function("ode")(0.0, x, model.p)[model.nq : model.nq + model.n]
    for how in ("eliminated", "sparse", "qr"):
        assert formulation(model, how)(0.0, x, model.p) == pytest.approx(rates, rel=1e-9)
        forces = formulation(model, how, forces=True)(0.0, x, model.p)
        jets = np.concatenate([x, rates])
        mu = model.signals("all_multipliers")[1](0.0, jets, model.p)
        assert forces == pytest.approx(np.concatenate([rates, mu]), rel=1e-8)


def test_the_documentation_prints_these_operations(joints, bodies):
    text = DOC.read_text(encoding="utf-8")
    assert joints.table() in text
    assert bodies.table() in text


def operations(study, n, k, how, column="operations"):
    return int(study.where(n=n, k=k, formulation=NAMES[how])[column][0])


def test_multipliers_cost_more_the_more_constraints_there_are(joints):
    """The paper's claim holds where k is near n: few motions are left; it does not where k is small."""
    for n, ratio in ((4, 0.7), (8, 0.9)):  # shared sums as unknowns spare the more the longer the arm
        assert operations(joints, n, n - 1, "eliminated") < ratio * operations(joints, n, n - 1, "sparse")
        assert operations(joints, n, n - 1, "eliminated") < 0.5 * operations(joints, n, n - 1, "assembly")
        assert operations(joints, n, 1, "sparse") < operations(joints, n, 1, "eliminated")
    eliminated = [operations(joints, 8, k, "eliminated") for k in (1, 4, 7)]
    assert eliminated == sorted(eliminated, reverse=True)


def test_the_multipliers_themselves_cost_less_where_they_are_unknowns(joints):
    for n, k in JOINTS:
        extra = {how: operations(joints, n, k, how, "with_forces") - operations(joints, n, k, how) for how in NAMES}
        assert extra["sparse"] < extra["eliminated"]
        assert extra["assembly"] == 0


def test_sparse_coordinates_matter_more_than_multipliers(joints, bodies):
    for n, k in BODIES:
        best = {
            how: min(operations(joints, n, k, how), operations(bodies, n, k, how)) for how in ("eliminated", "sparse")
        }
        assert max(best.values()) < 0.8 * operations(joints, n, k, "eliminated")
        assert operations(bodies, n, k, "assembly") > 5 * max(best.values())  # dense matrices forget the structure


def test_times_are_measured_where_they_are_asked_for(joints):
    timed = formulation_cost(guided_arm, [(2, 1)])
    assert np.all(timed["microseconds"] > 0) and np.all(np.isnan(joints["microseconds"]))
    assert timed["operations"].tolist() == joints.where(n=2)["operations"].tolist()


def test_a_cost_is_a_study_that_saves_and_draws(joints, tmp_path):
    again = load(joints.save(tmp_path / "cost"))
    assert FormulationCost(again.kind, again.columns, again.meta).table() == joints.table()
    assert len(repr(joints).splitlines()) <= 12
    counts, times = joints.plot().axes
    assert len(counts.lines) == len(times.lines) == len(NAMES)


def test_what_has_no_formulation_with_multipliers_is_refused():
    with refused(sv.errors.SpecificationError, "order 3"):
        formulation_cost(lambda n, k: gallery["spiral"].build(), [(1, 1)])
    with refused(sv.errors.SpecificationError, "1 hidden"):
        formulation_cost(lambda n, k: gallery["two-cars"].build(), [(2, 1)])
    with refused(sv.errors.NameUnknown, name="inverse"):
        formulation_cost(guided_arm, [(2, 1)], ["inverse"])
    with refused(sv.errors.SpecificationError, "k = 4", "k = 3"):
        guided_arm(4, 4)
