"""Every scene of the gallery: its texts, its number against a closed form, and its verification."""

import re
from math import pi

import closed_forms
import numpy as np
import pytest
from gallery_numbers import MORE
from scenes import CERTIFIED

import servoctl as sv
from servoctl.gallery import gallery

BOUNDED = ("cart-pole", "fixed-rope-crane")  # unstable internal dynamics: a bounded inverse in place of an integration


@pytest.fixture(scope="module")
def motion(gallery_model):
    """A function from a name to the run of its scene, or to the error that ends it."""
    runs = {}

    def run(name):
        if name not in runs:
            model, scene = gallery_model(name), gallery[name]
            start, method = model.start(**scene.start, guess=scene.guess), "bounded" if name in BOUNDED else None
            try:
                runs[name] = sv.simulate(model, start, scene.t_span, method)
            except sv.errors.SingularProgram as error:
                runs[name] = error
        return runs[name]

    return run


# --- closed forms: the number of a run, and what it must be


def largest(signal, closed_form):
    """The largest magnitude of a signal, by a function of time that returns it by name."""
    return lambda run: (np.abs(run[signal]).max(), np.abs(closed_form(run.t)[signal]).max())


def decay(run):
    """The slowest decay of the internal dynamics, at the start [1/s]."""
    return -sv.internal_dynamics(run).eigenvalues[:, 0].real.max()


def swing(run):
    """Frequency [rad/s] of the pendubot's second link about the hanging pose, m2 g l2/2 over I2 + m2 l2²/4."""
    inertia, damping = 0.07 + 3.0 * 0.25**2, 0.05
    rate = np.sqrt(3.0 * 9.81 * 0.25 / inertia - (damping / inertia / 2) ** 2)
    return np.abs(sv.internal_dynamics(run).eigenvalues[:, 0].imag).max(), rate


def three_cars(t):
    return closed_forms.cars(t, (1.0, 1.0, 2.0), (1.0, 1.0), (0.5, 0.5))


def mass_on_car(t):
    return closed_forms.mass_on_car(t, pi / 4, 1.0)


NUMBERS = {
    "overhead-crane": largest("hoist", closed_forms.overhead_crane),
    "winch-crane": largest("winch", closed_forms.winch_crane),
    "crane-3d": largest("tension", closed_forms.crane_3d),
    "two-cars": largest("force", closed_forms.cars),
    "three-cars": largest("force", three_cars),
    "vtol": largest("u1", closed_forms.vtol),
    "overhead-crane-redundant": largest("trolley", closed_forms.overhead_crane),
    "winch-crane-redundant": largest("tension", closed_forms.winch_crane),
    "crane-3d-redundant": largest("hoist", closed_forms.crane_3d),
    "mass-on-car-absolute": largest("force", mass_on_car),
    "mass-on-car": lambda run: (decay(run), -closed_forms.mass_on_car_poles(pi / 4).real.max()),
    "passive-arm": lambda run: (decay(run), -closed_forms.passive_arm_poles(0.3, 10.0, 1.0).real.max()),
    "pendubot": swing,
    "vtol-centre": lambda run: (-decay(run), closed_forms.vtol_rate()),
    "two-link-arm": lambda run: (run["q2"][0], np.arccos((0.6**2 + 0.4**2 - 0.6**2 - 0.5**2) / (2 * 0.6 * 0.5))),
    "appell-hamel": largest("tension", closed_forms.appell_hamel),
    "two-cars-ideal": lambda run: (
        np.abs(run.signals("reaction")[1][0]).max(), np.abs(closed_forms.cars_ideal(run.t)["reaction"]).max(),
    ),  # fmt: skip
    "constant-speed": lambda run: (-run["y"][-1], -closed_forms.constant_speed(run.t)["y"][-1]),
    "spiral": lambda run: (run["y"][-1], closed_forms.spiral(run.t, 3)["y"][-1]),
    "wheeled-robot": lambda run: (run["curvature"].max(), pi / 4),
    "appell-hamel-squared": lambda stop: (stop.details["t"], closed_forms.WHEEL_STOPS),
    "constant-speed-horizontal": lambda stop: (stop.details["t"], 5.0 / closed_forms.GRAVITY),
    **MORE,
}


@pytest.mark.parametrize("name", gallery)
def test_a_scene_gives_its_number(name, motion):
    with np.errstate(all="ignore"):
        measured, expected = NUMBERS[name](motion(name))
    assert measured == pytest.approx(expected, rel=2e-5)
    printed = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", gallery[name].number)]
    assert any(number == pytest.approx(expected, rel=5e-4) for number in printed), (expected, printed)


# --- texts


@pytest.mark.parametrize("name", gallery)
def test_a_scene_says_what_it_teaches_and_where_it_comes_from(name):
    scene = gallery[name]
    for sentence in (scene.description, scene.teaches, scene.number):
        assert sentence[0].isupper() and sentence.endswith(".") and len(sentence) < 115
    assert scene.source and not scene.source.endswith(".") and 2 <= len(scene.group.split()) <= 3


def test_scenes_of_one_group_are_together():
    groups = [scene.group for scene in gallery.values()]
    assert [g for g, before in zip(groups, [None, *groups], strict=False) if g != before] == list(dict.fromkeys(groups))


@pytest.mark.parametrize("name", gallery)
def test_a_scene_has_the_units_of_its_signals(name):
    mechanism, _ = gallery[name].build()
    assert set(mechanism.units) >= {*mechanism.q.names, *mechanism.actuators, *mechanism.outputs}


# --- verification


@pytest.mark.parametrize("name", [name for name in gallery if name not in CERTIFIED])
def test_a_scene_passes(name, motion):
    run = motion(name)
    proof = sv.verify(run)
    assert run.success and proof.passed, proof
