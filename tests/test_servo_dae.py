"""The servo DAE itself: its residual holds on the model's motions, and implicit steps on it behave as the theory says."""

import re
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from benchmarks.literature.servo_dae import FORMS, DaeComparison, dae_comparison, servo_dae
from servoctl.gallery import gallery
from servoctl.study.load import load

DOC = Path(__file__).parents[1] / "docs" / "servo_dae.md"
SCENES = ["overhead-crane", "crane-3d-redundant", "two-cars", "mass-on-car-absolute", "appell-hamel", "vtol"]


def solution(model, name, t):
    """(z, rates of q and γ') of the model's motion at an instant."""
    scene = gallery[name]
    start = model.start(**scene.start, guess=scene.guess)
    run = sv.simulate(model, start, (0.0, t), t_eval=[t / 2, t])
    jets = run.jets[:, -1]
    mu = run.signals("all_multipliers")[1][:, -1]
    nq, n = model.nq, model.n
    return np.concatenate([jets[: nq + n], mu]), np.concatenate([jets[nq : nq + n], jets[nq + n : nq + 2 * n]])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", SCENES)
def test_the_residual_vanishes_on_the_models_motion(name, form, gallery_model):
    model = gallery_model(name)
    z, rates = solution(model, name, 0.7)
    f = servo_dae(model, form)
    p = np.concatenate([model.p, [0.0], rates])
    residual = f(0.7, z, p)[: len(z)]
    assert np.abs(residual).max() < 1e-6 * (1 + np.abs(z).max())
    off = f(0.7, z + np.eye(len(z))[-1] * np.abs(z).max(), p)[: len(z)]
    assert np.abs(off).max() > 1e-3 * np.abs(z).max()  # the last multiplier stands in it


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", SCENES)
def test_the_jacobian_is_that_of_the_residual(name, form, gallery_model):
    model = gallery_model(name)
    z, rates = solution(model, name, 0.7)
    f, n = servo_dae(model, form), len(z)
    p = np.concatenate([model.p, [30.0], rates])
    jacobian = f(0.7, z, p)[n:].reshape(n, n).T
    step = 1e-6 * (1 + np.abs(z))
    differences = [(f(0.7, z + d, p) - f(0.7, z - d, p))[:n] / (2 * d.sum()) for d in np.diag(step)]
    assert np.allclose(jacobian, np.array(differences).T, rtol=1e-6, atol=1e-7 * np.abs(jacobian).max())


def compared(model, name, steps, span=None, **options):
    scene = gallery[name]
    start = model.start(**scene.start, guess=scene.guess)
    return dae_comparison(model, start, span or scene.t_span, steps, **options)


def test_the_force_of_index_5_has_a_step_of_least_error(gallery_model):
    """Two cars: relative degree 4, so rounding of the force grows like ε/h⁴; truncation falls like h and h²."""
    study = compared(gallery_model("two-cars"), "two-cars", 0.05 / 2.0 ** np.arange(9), forms=["servo"])
    for method, order in (("BE", 1), ("BDF2", 2)):
        found = study.best("servo", method)
        assert found["order"] == pytest.approx(order, abs=0.1)
        printed = re.search(rf"two-cars .*servo \| {method} .* ([\d.]+) \| (\S+) \|", DOC.read_text(encoding="utf-8"))
        assert float(printed[1]) == pytest.approx(found["step"], rel=0.01)
        assert float(printed[2]) == pytest.approx(found["force"], rel=0.3)  # rounding differs among machines
    best = study.best("servo", "BDF2")
    assert best["rounding"] == pytest.approx(4.0, abs=0.5)
    assert 0.5 < best["step"] / best["fitted_step"] < 2.0
    assert 1e-5 < best["force"] < 1e-3 and best["motion"] < best["force"]
    finest = study.where(method="BDF2")
    assert finest["force"][-1] > 30 * best["force"]  # a smaller step is worse
    assert finest["motion"][-1] < best["motion"]  # of the force only


def test_the_projected_form_defers_rounding(gallery_model):
    study = compared(gallery_model("two-cars"), "two-cars", 0.05 / 2.0 ** np.arange(8), methods=["BDF2"])
    servo, projected = (study.where(form=form)["force"] for form in ("servo", "projected"))
    assert np.all(projected < servo)
    assert projected[-1] < 1e-3 * servo[-1]
    assert study.best("projected", "BDF2")["order"] == pytest.approx(2.0, abs=0.1)


def test_the_force_of_index_3_rounds_with_the_square_of_the_step(gallery_model):
    model = gallery_model("mass-on-car")
    steps = [1e-4, 1.6e-5, 8e-6, 4e-6]
    study = compared(model, "mass-on-car", steps, (0.0, 0.08), forms=["servo"], methods=["BDF2"])
    force = study["force"]
    slope = np.polyfit(np.log(study["step"][1:]), np.log(force[1:]), 1)[0]
    assert slope == pytest.approx(-2.0, abs=0.5)


def test_index_7_rounds_with_the_sixth_power(gallery_model):
    study = compared(
        gallery_model("three-cars"), "three-cars", 0.0125 / 2.0 ** np.arange(6), forms=["servo"], methods=["BDF2"]
    )
    best = study.best("servo", "BDF2")
    assert best["rounding"] == pytest.approx(6.0, abs=0.5)
    assert best["force"] > 0.01  # no step gives two digits


def test_a_hoisted_load_is_lost_in_relative_coordinates_and_found_in_redundant_ones(gallery_model):
    """The DAE as it stands, index 5: with the rope shortening, backward Euler diverges at every step that resolves it."""
    steps = [0.05, 0.025, 0.0125]
    relative = compared(gallery_model("overhead-crane"), "overhead-crane", steps, forms=["servo"], methods=["BE"])
    assert all("Newton's method fails" in message for message in relative["message"])
    assert np.all(np.isnan(relative["force"])) and np.isnan(relative.best("servo")["step"])
    name = "overhead-crane-redundant"
    redundant = compared(gallery_model(name), name, steps, forms=["servo"], methods=["BE"])
    ratios = redundant["force"][:-1] / redundant["force"][1:]
    assert ratios == pytest.approx([2.0, 2.0], rel=0.05)


def test_a_comparison_is_a_study_that_prints_saves_and_draws(gallery_model, tmp_path):
    study = compared(gallery_model("two-cars"), "two-cars", [0.1, 0.05])
    assert len(study) == 8 and len(repr(study).splitlines()) <= 12
    again = load(study.save(tmp_path / "dae"))
    again = DaeComparison(again.kind, again.columns, again.meta)
    assert again.best("servo") == pytest.approx(study.best("servo"), nan_ok=True)
    assert np.array_equal(again["force"], study["force"])
    motion, force = study.plot().axes
    assert len(motion.lines) == len(force.lines) == 4


def test_what_is_no_dae_in_these_unknowns_is_refused(gallery_model):
    with refused(sv.errors.SpecificationError, "curvature"):
        compared(gallery_model("spiral"), "spiral", [0.1])
    with refused(sv.errors.NameUnknown, name="index 1"):
        compared(gallery_model("two-cars"), "two-cars", [0.1], forms=["index 1"])
    with refused(sv.errors.SpecificationError, "[-0.1]"):
        compared(gallery_model("two-cars"), "two-cars", [-0.1])
