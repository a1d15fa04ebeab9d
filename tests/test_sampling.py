"""Plants from sample to sample: loops with transport delays of parts of a sample."""

import numpy as np
import pytest
from refusals import refused
from scipy.optimize import brentq

import servoctl as sv
from servoctl.control.sampling import sampled_radii

q = sv.coordinates("x")
(x,) = q
POINT = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, x), actuators={"force": x})
POINT_PROGRAM = sv.Program({"X": x - q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=3)).X})


@pytest.mark.parametrize("late", [0.0, 0.004, 0.01, 0.013, 0.027])
def test_loops_turn_unstable_where_their_sampled_radius_says(late):
    """Two poles at -p with a transport delay of parts of a sample."""
    A, B, m = np.array([[[0.0, 1.0], [0.0, 0.0]]]), np.array([[[0.0], [0.5]]]), 2.0
    gains = lambda p: np.array([[[m * p**2, 2 * m * p]]])  # noqa: E731
    radius = lambda p: sampled_radii(A, B, gains(p), 0.01, np.array([late]))[0]  # noqa: E731
    limit = brentq(lambda p: radius(p) - 1.0, 1.0, 150.0)
    grew = []
    for p in (0.98 * limit, 1.02 * limit):
        K = gains(p)[0]
        run = sv.close(
            sv.plant(POINT, delay=late),
            lambda t, y, K=K: -K @ [y["x"], y["dx"]],
            [1.0, 0.0],
            (0.0, 20.0),
            timing=sv.Timing(rate=100.0, substeps=10),
        )
        size = np.abs(run.states).max(axis=0)
        grew.append(bool(size[-200:].max() > size[800:1000].max()))
    assert grew == [False, True]


def test_a_transport_delay_too_long_for_the_gains_is_refused():
    model = sv.derive(POINT, POINT_PROGRAM)
    point_plan = sv.simulate(model, model.start(), (0.0, 2.0))
    gains = {"kp": {"force": 400.0}, "kd": {"force": 40.0}}
    for late in (0.0, 0.02):
        law = sv.pd(point_plan, sv.plant(POINT, delay=late), **gains)
        A, B = np.array([[[0.0, 1.0], [0.0, 0.0]]]), np.array([[[0.0], [0.5]]])
        radius = sampled_radii(A, B, np.array([[[400.0, 40.0]]]), 0.01, np.array([late]))[0]
        assert law.info["largest spectral radius along the plan"] == pytest.approx(radius, rel=1e-9) and radius < 1.0
    with refused(sv.errors.ServoError, "0.1 s", radius=pytest.approx(1.058, abs=5e-4)):
        sv.pd(point_plan, sv.plant(POINT, delay=0.1), **gains)
