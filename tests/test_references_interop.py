"""python-control systems of models that follow references."""

import numpy as np
import pytest
import referred

import servoctl as sv

control = pytest.importorskip("control")


def test_the_nonlinear_system_of_a_model_follows_its_path_with_other_parameters():
    old, new = (sv.interop.nlsys(referred.cart(formula=formula)) for formula in (True, False))
    x, params = np.array([0.2, 0.1, 0.3, -0.2]), {**new.params, "m": 0.3}
    for t in (0.0, 0.4, 0.9):
        for function in ("dynamics", "output"):
            wanted, found = (getattr(system, function)(t, x, np.zeros(0), params=params) for system in (old, new))
            assert np.abs(found - wanted).max() <= 1e-12 * max(np.abs(wanted).max(), 1.0)


def test_the_linear_system_of_a_model_is_that_at_an_instant_of_its_path():
    models = (referred.cart(formula=formula) for formula in (True, False))
    old, new = (sv.interop.linearise(model, 0.4, [0.2, 0.1, 0.3, -0.2]) for model in models)
    for name in "AC":
        assert np.abs(getattr(new, name) - getattr(old, name)).max() <= 1e-12 * np.abs(getattr(old, name)).max()
