"""The map of stable steps: against eigenvalues known in closed form and against where simulations diverge."""

import runpy
from math import pi
from pathlib import Path

import numpy as np
import pytest
from refusals import refused, warned

import servoctl as sv
from servoctl.gallery import gallery, mass_on_car
from servoctl.methods.choice import ORDERS, as_method
from servoctl.methods.stability import largest_explicit
from servoctl.study.stability_map import MAPPED, stability

DOC = Path(__file__).parents[1] / "docs" / "servo_dae.md"


@pytest.fixture(scope="module")
def stiff():
    """A mass on a car whose guide has a strong damper: (model, run, map)."""
    model = sv.derive(*mass_on_car(damping=60.0))
    run = sv.simulate(model, model.start(s=0.0, ds=0.0), (0.0, 6.0), "Taylor", drift="project")
    return model, run, stability(model, run)


def internal_rates(damping, m_2=2.0, k=5.0, alpha=pi / 4):
    """Of the guide's internal dynamics m_2 sin²α s'' + d s' + k s = 0: with z given, x'' = z'' - s'' cos α."""
    return np.sort(np.roots([m_2 * np.sin(alpha) ** 2, damping, k]))


def test_internal_eigenvalues_are_those_of_the_closed_form(stiff):
    _, _, found = stiff
    expected = internal_rates(60.0)
    assert np.allclose(np.sort(found.rates.real, axis=1), expected, rtol=1e-9)
    assert np.abs(found.rates.imag).max() == 0.0


@pytest.mark.filterwarnings("ignore:Steps of:RuntimeWarning")
@pytest.mark.parametrize("drift", [None, "project", 0.5])
@pytest.mark.parametrize("method", ["RK4", "RK8"])
def test_simulations_diverge_where_the_map_says(stiff, method, drift):
    model, run, found = stiff
    largest = found.largest_step(method, drift)

    def error(step):  # after the path's end, where no knot shortens a step
        moved = sv.simulate(
            model, model.start(t=3.0, s=0.1, ds=0.0), (3.0, 63.0), as_method(method, step=step), drift=drift
        )
        assert len(moved.t) == pytest.approx(60.0 / step, abs=2.0)
        return np.abs(moved["s"][-1])

    assert error(0.98 * largest) < 0.1
    assert not error(1.02 * largest) < 10.0


@pytest.mark.filterwarnings("ignore:Steps of:RuntimeWarning")
@pytest.mark.parametrize("method", ["RK4", "RK8"])
def test_poles_faster_than_the_internal_dynamics_decide(stiff, method):
    model, run, found = stiff
    pole = 400.0
    largest = found.largest_step(method, 1 / pole)
    assert largest == pytest.approx(largest_explicit(method) / pole, rel=0.01)

    def violation(step):
        moved = sv.simulate(model, model.start(s=0.0, ds=0.0), (0.0, 6.0), as_method(method, step=step), drift=1 / pole)
        return np.abs(moved.residual["z"][0]).max()

    assert violation(0.97 * largest) < 1e-2
    assert not violation(1.03 * largest) < 1.0


def test_the_documentation_prints_this_map():
    model = sv.derive(*mass_on_car(damping=10.0))
    run = sv.simulate(model, model.start(s=0.0, ds=0.0), (0.0, 6.0))
    assert repr(stability(model, run)) in DOC.read_text(encoding="utf-8")


def test_a_flat_program_has_steps_to_fear_only_where_poles_are_given(gallery_model):
    model, scene = gallery_model("two-cars"), gallery["two-cars"]
    found = stability(model, sv.simulate(model, model.start(), scene.t_span))
    assert found.rates.shape[1] == 0
    for method in MAPPED:
        assert found.largest_step(method) == found.largest_step(method, "project") == np.inf
    for method in ORDERS:
        assert found.largest_step(method, 0.001) == pytest.approx(0.001 * largest_explicit(method), rel=0.01)
    assert found.largest_step("RadauIIA", 0.001) == found.largest_step("Radau", 0.001) == np.inf


def test_an_undamped_oscillation_has_the_limit_of_the_imaginary_axis(gallery_model):
    """Car 2 swings on its spring with ω² = k/m = 1/2."""
    model, scene = gallery_model("two-cars-ideal"), gallery["two-cars-ideal"]
    run = sv.simulate(model, model.start(**scene.start), (0.0, 200.0), "Taylor")
    found = stability(model, run)
    omega = np.sqrt(0.5)
    assert np.allclose(np.abs(found.rates.imag), omega) and np.abs(found.rates.real).max() < 1e-12
    assert found.largest_step("RK4") == pytest.approx(np.sqrt(8) / omega, rel=0.01)


def test_unstable_internal_dynamics_are_not_blamed_on_a_step(gallery_model):
    model, scene = gallery_model("vtol-centre"), gallery["vtol-centre"]
    with warned("unstable over these 0.3 s"):
        run = sv.simulate(model, model.start(**scene.start), (0.0, 0.3))
    found = stability(model, run)
    assert np.sort(found.rates[0].real) == pytest.approx([-15.0405993, 15.0405993], rel=1e-7)
    assert found.radius("RK4", 1e-3).max() <= 1.0 + 1e-12
    assert found.largest_step("RK4") > 0.1
    assert "15.0" in repr(found) and "motion's own" in repr(found)


def test_a_manifold_that_turns_gives_no_false_rates(gallery_model):
    model = gallery_model("appell-hamel")
    run = sv.simulate(model, model.start(dphi=1.0, dtheta=2.0), (0.0, 2.0))
    found = stability(model, run)
    assert found.rates.shape[1] == model.free == 6
    assert np.abs(found.rates).max() < 5.0
    program = runpy.run_path(str(DOC.parents[1] / "examples" / "quaternion.py"), run_name="example")
    model = sv.derive(program["mechanism"], program["program"])  # a spin through all orientations: nothing grows fast
    run = sv.simulate(model, model.start(w3=0.5, guess={"e0": 1.0}), (0.0, 10.0), drift="project")
    assert np.abs(stability(model, run).rates).max() < 0.5


def test_poles_that_fit_no_row_and_foreign_runs_are_refused(stiff, gallery_model):
    model, run, found = stiff
    with refused(sv.errors.NameUnknown, name="nothing"):
        found.largest_step("RK4", sv.methods.Poles({"nothing": [-1.0, -2.0]}))
    with refused(sv.errors.SpecificationError, row="z", count=2):
        found.largest_step("RK4", sv.methods.Poles({"z": [-1.0]}))
    with refused(sv.errors.NameUnknown, name="LSODA"):
        found.largest_step("LSODA")
    with refused(sv.errors.SpecificationError, "x1"):
        stability(gallery_model("two-cars"), run)


def test_the_map_prints_in_twelve_lines_and_draws_its_boundary(stiff):
    _, _, found = stiff
    assert len(repr(found).splitlines()) <= 12
    left, right, *_ = found.plot("RK4").axes
    assert [line.get_label() for line in left.lines] == [*ORDERS, "Taylor, order 12"]
    poles, steps = right.lines[0].get_data()
    assert steps[-1] == pytest.approx(largest_explicit("RK4") / poles[-1], rel=0.01)
