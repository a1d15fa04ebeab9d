"""The examples run, and their numbers are those of closed forms and of independent integrations."""

import runpy
from pathlib import Path

import closed_forms as known
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def numbers():
    """A function from an example's name to what its `main(fast=True)` returns."""
    results = {}

    def run(name):
        if name not in results:
            results[name] = runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](fast=True)
        return results[name]

    return run


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_every_example_is_verified_and_returns_numbers(numbers, path):
    found = numbers(path.stem)
    checks = [value for name, value in found.items() if name.endswith("verified")]
    assert checks and all(checks)
    assert all(np.isfinite(value) for value in found.values())


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_every_example_explains_itself_and_runs_as_a_script(path):
    text = path.read_text()
    assert text.startswith('"""')
    assert 'if __name__ == "__main__":' in text


def test_appell_hamel(numbers):
    found = numbers("appell_hamel")
    assert found["free"] == 6
    state = [found[name] for name in ("x", "y", "z", "phi", "theta", "dphi", "dtheta")]
    assert np.abs(np.array(state) - known.APPELL_HAMEL_STATES[2.0]).max() < 1e-8
    assert found["energy drift"] < 1e-8


def test_overhead_crane(numbers):
    found = numbers("overhead_crane")
    assert (found["free"], found["index"]) == (0, 5)
    exact = known.overhead_crane(np.linspace(0.0, 8.0, 80_001))
    for name in ("trolley", "hoist", "theta"):
        assert found[f"{name} min"] == pytest.approx(exact[name].min(), rel=1e-6)
        assert found[f"{name} max"] == pytest.approx(exact[name].max(), rel=1e-6)
    printed = {"trolley": (-137.991607, 134.331943), "hoist": (-1044.370897, -935.793762)}
    for name, (least, greatest) in printed.items():
        assert (found[f"{name} min"], found[f"{name} max"]) == pytest.approx((least, greatest), abs=1e-6)
    assert np.rad2deg([found["theta min"], found["theta max"]]) == pytest.approx((-7.1814, 7.9766), abs=1e-4)


def test_two_cars(numbers):
    found = numbers("two_cars")
    assert found["ideal max"] == pytest.approx(6.852059, abs=1e-6)
    assert found["ideal at"] == pytest.approx(0.7091, abs=1e-4)
    assert found["ideal swing"] == pytest.approx(1.966911, abs=1e-6)
    assert found["actuators max"] == pytest.approx(316.175102075, rel=1e-9)
    assert found["actuators at"] == pytest.approx(1.248527, abs=1e-6)
    assert found["actuators swing"] < 1e-9
    assert (found["ideal free"], found["actuators free"]) == (2, 0)
    assert found["ideal outside"] == pytest.approx(1.0)
    t = np.linspace(0.0, 2.0, 20_001)
    assert found["ideal max"] == pytest.approx(known.cars_ideal(t)["reaction"].max(), rel=1e-7)
    assert found["actuators max"] == pytest.approx(known.cars(t)["force"].max(), rel=1e-6)


def test_spiral(numbers):
    found, exact = numbers("spiral"), known.spiral(np.array(2.0), 5, c=1.5)
    assert found["free"] == 7
    assert found["heading"] == pytest.approx(1.0, abs=1e-9)
    assert (found["x"], found["y"]) == pytest.approx((float(exact["x"]), float(exact["y"])), abs=1e-9)
    assert found["speed error"] < 1e-8


def test_redundant_thrusters(numbers):
    found = numbers("redundant_thrusters")
    for case in ("equal", "weak bow"):
        assert found[f"{case} against the least norm"] < 1e-12
    assert found["weak bow bow"] < found["equal bow"] / 3
    assert found["weak bow stern"] > found["equal stern"]


def test_quaternion(numbers):
    found = numbers("quaternion")
    t = np.linspace(0.0, 10.0, 1001)
    rate, acceleration = (known.rest_to_rest(t, k, 0.0, np.pi / 3, 10.0, 2) for k in (1, 2))
    torque = np.hypot(40.0 * acceleration, 60.0 * 0.5 * rate)
    assert found["torque max"] == pytest.approx(torque.max(), rel=1e-9)
    assert found["free"] == 2
    assert found["spin change"] < 1e-12
    assert found["unit error"] < 1e-14
