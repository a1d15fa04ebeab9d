"""Plans and laws at the door: starts, edges of disturbances, quadratures, orders of optima, numbers that are none."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.special import ellipj

import servoctl as sv

# a projected start ----------------------------------------------------------------------------------------------------

G = 9.81  # m/s^2


@pytest.fixture(scope="module")
def pendulum():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, ca.vertcat(x, y)), potential=G * y)
    return sv.derive(mechanism, sv.Program({"rod": x**2 + y**2 - 1}, by="ideal"))


def swinging(angle, t):
    """The place x [m] of a pendulum of 1 m released at rest, in closed form."""
    k = np.sin(angle / 2)
    _, cn, dn, _ = ellipj(np.sqrt(G) * t, k**2)
    half = k * cn / dn
    return 2 * half * np.sqrt(1 - half**2)


STARTS = {  # x, y, x', y' off the circle; the two places, and two more
    "near": (0.6, -0.81, 0.0, 0.0),
    "far": (0.6, -1.6, 0.0, 0.0),
    "inside": (0.3, -0.4, 0.0, 0.0),
    "along the rod": (0.6, -0.8, 0.3, -0.4),
}


@pytest.mark.parametrize("method", [None, "Taylor", "RadauIIA", "DOP853", "Radau", "RK4"])
@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS)
def test_projection_begins_with_the_start(start, method, pendulum):
    run = sv.simulate(pendulum, start, (0.0, 1.0), method, drift="project", t_eval=[0.0, 1.0])
    on_circle = np.array(start[:2]) / np.hypot(*start[:2])
    assert np.abs([run["x"][0] - on_circle[0], run["y"][0] - on_circle[1], run["dx"][0], run["dy"][0]]).max() < 1e-15
    assert (run.start.values == run.jets[:4, 0]).all()
    assert run["x"][-1] == pytest.approx(swinging(np.arctan2(start[0], -start[1]), 1.0), abs=1e-8)


def test_the_least_change_of_a_start_is_that_of_its_masses():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, x) + sv.particle(q, 3.0, y), potential=-8.0 * x)
    model = sv.derive(mechanism, sv.Program({"together": x - y}, by="ideal"))
    run = sv.simulate(model, [0.0, 1.0, 2.0, 0.0], (0.0, 2.0), drift="project")
    assert [run["x"][0], run["dy"][0]] == pytest.approx([0.75, 0.5], abs=1e-15)  # the centre and its velocity
    assert run["y"][-1] == pytest.approx(0.75 + 0.5 * 2 + 8 / 4 * 2, abs=1e-9)


def test_a_start_that_projection_does_not_bring_to_the_constraint_is_refused(pendulum):
    with refused(sv.InconsistentStart, "model.start", invariant="rod"):
        sv.simulate(pendulum, [0.0, 0.0, 0.0, 0.0], (0.0, 1.0), drift="project")
