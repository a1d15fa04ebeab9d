"""Many motions along references: with parameters of each case they are those of one motion after the other."""

import numpy as np
import pytest
import referred

import servoctl as sv
from servoctl.study import many


@pytest.fixture(scope="module")
def model():
    return referred.crane()


def test_plans_with_many_parameters_are_those_of_the_old_spelling_at_once(model, monkeypatch):
    masses, times = np.linspace(50.0, 150.0, 23), np.linspace(0.0, 6.0, 31)
    old = referred.crane(old=True)
    wanted = sv.simulate_many(old, old.start(guess={"l": 4.0}), {"m_l": masses}, (0.0, 6.0), t_eval=times)
    monkeypatch.setattr(many._Many, "_one", lambda *_: pytest.fail("one by one"))
    found = sv.simulate_many(model, model.start(guess={"l": 4.0}), {"m_l": masses}, (0.0, 6.0), t_eval=times)
    for name in ("x", "l", "theta", "dtheta", "d2theta", "trolley", "hoist", "hidden: balance of theta"):
        assert found.trace[name].shape == (31, 23)
        assert np.abs(found.trace[name] - wanted.trace[name]).max() <= 1e-11 * max(
            np.abs(wanted.trace[name]).max(), 1.0
        )
    assert np.abs(found.trace["X_residual"]).max() < 1e-11 and found.trace["X"][-1] == pytest.approx(5.0)


def test_integrated_motions_are_those_of_simulate():
    model = referred.cart()
    start, masses = model.start(theta=0.1, dtheta=0.0), [0.05, 0.1, 0.2]
    found = sv.simulate_many(model, start, {"m": masses}, (0.0, 1.5), "RK4", t_eval=[0.4, 1.5])
    for i, m in enumerate(masses):
        run = sv.simulate(model.with_parameters(m=m), start, (0.0, 1.5), "RK4", t_eval=[0.4, 1.5])
        for name in ("theta", "force"):
            assert np.allclose(found.trace[name][:, i], run[name], rtol=1e-9, atol=1e-12)


def test_starts_by_name_and_other_workers(model):
    """A worker has the paths, and places in memory of its own."""
    from concurrent.futures import ProcessPoolExecutor

    cart = referred.cart()
    cases = {"theta": np.array([0.1, 0.2, 0.3]), "dtheta": np.zeros(3)}
    here = sv.simulate_many(cart, cases, None, (0.0, 0.5), "RK4")
    plan = sv.simulate_many(model, model.start(guess={"l": 4.0}), {"m_l": [90.0, 110.0]}, (0.0, 6.0))
    with ProcessPoolExecutor(1) as pool:
        there = sv.simulate_many(cart, cases, None, (0.0, 0.5), "RK4", executor=pool)
        planned = sv.simulate_many(
            model, model.start(guess={"l": 4.0}), {"m_l": [90.0, 110.0]}, (0.0, 6.0), executor=pool
        )
    assert np.array_equal(here["final theta"], there["final theta"]) and np.array_equal(
        plan["final x"], planned["final x"]
    )
