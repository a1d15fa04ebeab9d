"""Internal dynamics: eigenvalues against closed forms, whatever the coordinates."""

from math import pi

import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.gallery import cars, gallery, mass_on_car, passive_arm, vtol


def internal(pair, span, start, **guess):
    model = sv.derive(*pair)
    return sv.internal_dynamics(model, sv.simulate(model, model.start(guess=guess, **start), span))


@pytest.mark.parametrize(
    "pair, start, poles",
    [
        (mass_on_car(pi / 4), {"s": 0.0, "ds": 0.0}, [-0.5 + 2.1794494718j, -0.5 - 2.1794494718j]),
        (mass_on_car(pi / 4, coordinates="absolute"), {"x": 0.5, "dx": 0.0}, [-0.5 + 2.1794494718j]),
        (mass_on_car(pi / 2), {"s": 0.0, "ds": 0.0}, [-0.25 + 1.5612494996j, -0.25 - 1.5612494996j]),
        (mass_on_car(0.0, 1.0), {"s": 0.0}, [-5.0]),  # -k/d
    ],
)
def test_mass_on_car(pair, start, poles):
    found = internal(pair, (0.0, 1.0), start)
    assert found.verdict == "stable" and found.growth == 1.0
    for pole in poles:
        assert np.abs(found.eigenvalues - pole).min(axis=0).max() < 1e-7


def test_the_aircrafts_centre_of_mass_is_unstable():
    """Theory: ±15.0405993 1/s at rest, and errors grow by exp of their integral."""
    found = internal(vtol("centre"), (0.0, 0.2), {"theta": 0.0, "dtheta": 0.0})
    assert found.verdict == "unstable"
    assert found.eigenvalues[:, 0] == pytest.approx([15.0405993, -15.0405993], abs=1e-6)
    assert found.growth == pytest.approx(np.exp(0.2 * 15.04), rel=0.02)


def test_the_passive_arm_turns_unstable_above_0_4():
    verdicts = [internal(passive_arm(G), (0.0, 0.02), {"q2": 0.0, "dq2": 0.0}).verdict for G in (0.2, 0.39, 0.41, 0.6)]
    assert verdicts == ["stable", "stable", "unstable", "unstable"]


def test_symmetries_are_neutral_and_flat_programs_have_none():
    scene = gallery["wheeled-robot"]
    found = internal(scene.build(), (0.0, 5.0), scene.start, v=1.0)
    assert (found.verdict, found.names) == ("neutral", ("x", "y", "psi"))
    flat = internal(cars(), (0.0, 0.5), {})
    assert flat.verdict == "none" and "determines" in repr(flat)


def test_a_run_without_its_model_is_refused(tmp_path):
    model = sv.derive(*passive_arm())
    run = sv.simulate(model, model.start(q2=0.0, dq2=0.0), (0.0, 0.5))
    for other, kind in ((sv.load(run.save(tmp_path / "run")), "Run"), (None, "NoneType")):
        with refused(sv.SpecificationError, "internal_dynamics", kind):
            sv.internal_dynamics(model, other)
