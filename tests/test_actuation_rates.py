"""Derivatives in time of actuation, reactions, outputs and energy, from jets above those of the motion itself."""

import numpy as np
import pytest
from refusals import refused
from scipy.interpolate import make_interp_spline

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.model.equations import signal_groups


def taylor(gallery_model, name, t0, t1, jets):
    """A run of a scene from its own start, with samples between two times within one smooth piece."""
    model, scene = gallery_model(name), gallery[name]
    start = model.start(guess=scene.guess, **scene.start)
    method = sv.methods.Taylor(jets=jets, rtol=1e-13, atol=1e-14)
    return sv.simulate(model, start, (0.0, t1), method, drift="project", t_eval=np.linspace(t0, t1, 201))


@pytest.mark.parametrize(
    ("name", "t0", "t1", "signals"),
    [
        ("overhead-crane", 2.0, 3.0, ("trolley", "hoist", "tension", "energy")),
        ("appell-hamel", 0.2, 1.0, ("reaction_x", "reaction_theta", "multiplier_string", "tension")),
        ("wheeled-robot", 1.1, 1.9, ("steer", "energy")),
    ],
)
def test_rates_are_those_of_the_signals(name, t0, t1, signals, gallery_model):
    run = taylor(gallery_model, name, t0, t1, gallery_model(name).reduction.top + 2)
    assert not [knot for knot in run.knots if t0 < knot < t1]
    for signal in signals:
        spline = make_interp_spline(run.t, run[signal], k=9)
        for order, rate in ((1, run[f"d{signal}"]), (2, run[f"d2{signal}"])):
            size = max(np.abs(rate).max(), 1e-6 * np.abs(run[signal]).max())
            inside = slice(20, -20)  # splines are less accurate at their ends
            assert spline(run.t, nu=order)[inside] == pytest.approx(rate[inside], abs=1e-6 * size), (signal, order)


def test_rates_across_a_change_of_pivots(gallery_model):
    model = gallery_model("constant-speed")
    scene = gallery["constant-speed"]
    start = model.start(guess=scene.guess, **scene.start)
    run = sv.simulate(model, start, (0.0, 2.0), method=sv.methods.Taylor(jets=model.reduction.top + 1), drift="project")
    signal = next(iter(signal_groups(model.reduction)))
    slope = make_interp_spline(run.t, run[signal], k=5)(run.t, nu=1)
    assert run[f"d{signal}"] == pytest.approx(slope, abs=1e-5 * (1 + np.abs(slope).max()))


@pytest.mark.parametrize("method", [None, "DOP853"])
def test_a_run_without_the_jets_says_how_to_get_them(method, gallery_model):
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(), (0.0, 1.0), method=method, t_eval=[0.0, 1.0])
    with refused(sv.errors.SpecificationError, jets=3) as caught:
        run["dtrolley"]
    assert caught.value.details["jets"] == 3


@pytest.mark.parametrize("name", ["d", "dtroley", "d0trolley", "d1trolley", "d2", "dd"])
def test_names_that_are_no_rates(name, gallery_model):
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(), (0.0, 1.0), t_eval=[0.0, 1.0])
    with pytest.raises(sv.errors.NameUnknown):
        run[name]
