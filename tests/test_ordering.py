"""Which method is cheapest at an error of 1e-9: counts, which are the same on every machine."""

import numpy as np
import pytest

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.methods.accuracy import motion_error
from servoctl.methods.choice import ORDERS, as_method
from servoctl.methods.taylor import order_for, series_loop

ERROR = 1e-9
INTERVALS = 32  # between samples: each is a whole number of fixed steps
TOLERANCES = tuple(10.0**-k for k in range(6, 14))
STEPS = tuple(INTERVALS * 2**k for k in range(9))


def fewest(model, start, span, method, exact, t):
    """Evaluations, and operations in them, of the coarsest setting whose error is at most ERROR."""
    fixed = method in ORDERS
    for setting in STEPS if fixed else TOLERANCES:
        given = {"step": (span[1] - span[0]) / setting} if fixed else {"rtol": setting, "atol": setting}
        run = sv.simulate(model, start, span, as_method(method, **given), t_eval=None if fixed else t)
        jets = run.jets[:, :: setting // INTERVALS] if fixed else run.jets
        np.testing.assert_allclose(run.t[:: setting // INTERVALS] if fixed else run.t, t, atol=1e-9)
        if motion_error(model, jets, exact) <= ERROR:
            series = series_loop(model, order_for(setting) + model.reduction.top - 1) if method == "Taylor" else None
            each = (series or model.function("ode")).operations
            return run.counters["nfev"], run.counters["nfev"] * each
    raise AssertionError(f"{method} does not reach {ERROR}")


@pytest.mark.parametrize("name", ["appell-hamel", "mass-on-car"])
def test_taylor_then_dop853_then_rk45_then_rk4(name, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    start, t = model.start(guess=scene.guess, **scene.start), np.linspace(*scene.t_span, INTERVALS + 1)
    exact = sv.simulate(model, start, scene.t_span, sv.methods.Adaptive("DOP853", rtol=3e-14, atol=1e-15), t_eval=t).jets
    costs = [fewest(model, start, scene.t_span, m, exact, t) for m in ("Taylor", "DOP853", "RK45", "RK4")]
    evaluations, operations = zip(*costs, strict=True)
    assert list(evaluations) == sorted(set(evaluations))
    assert list(operations) == sorted(set(operations))
    assert 20 * evaluations[0] < evaluations[1]
