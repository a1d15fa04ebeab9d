"""Many motions along references: with parameters of each case they are those of one motion after the other."""

from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
import referred
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.study import many


@pytest.fixture(scope="module")
def model():
    return referred.crane()


def test_plans_with_many_parameters_are_those_along_a_formula_at_once(model, monkeypatch):
    masses, times = np.linspace(50.0, 150.0, 23), np.linspace(0.0, 6.0, 31)
    old = referred.crane(formula=True)
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


def detours(count):
    """Paths of the load from one place to others, some of them with a pause on the way, or of another class."""
    ends = np.linspace(3.0, 6.0, count)
    paths = [sv.paths.rest_to_rest(0.0, end, 6.0, smoothness=4 + i % 3) for i, end in enumerate(ends)]
    paths[1] = sv.paths.rest_to_rest(0.0, 2.0, 3.0).then(sv.paths.rest_to_rest(2.0, 5.0, 2.5))
    return paths


def test_a_path_for_each_case_is_that_of_simulate_at_once(model, monkeypatch):
    paths, times = detours(9), np.linspace(0.0, 6.0, 13)
    start, masses = model.start(guess={"l": 4.0}), np.linspace(90.0, 110.0, 9)
    with monkeypatch.context() as patch:
        patch.setattr(many._Many, "_one", lambda *_: pytest.fail("one by one"))
        found = sv.simulate_many(model, start, {"m_l": masses}, (0.0, 6.0), paths={"X": paths}, t_eval=times)
        again = sv.simulate_many(model, start, None, (6.0, 0.0)[::-1], paths={"X": paths})
    for i in (0, 1, 5, 8):
        along = model.with_references(X=paths[i])
        run = sv.simulate(along.with_parameters(m_l=masses[i]), start, (0.0, 6.0), t_eval=times)
        for name in ("x", "theta", "d2theta", "trolley", "hoist"):
            assert np.abs(found.trace[name][:, i] - run[name]).max() <= 1e-11 * np.abs(run[name]).max()
        assert again["final x"][i] == pytest.approx(paths[i](6.0), abs=1e-11)


def test_paths_of_integrated_motions_of_workers_and_in_pickles():
    import pickle

    cart, paths = referred.cart(), [sv.paths.rest_to_rest(0.0, end, 1.5) for end in (0.5, 1.0)]
    arguments = cart, {"theta": [0.1, 0.2], "dtheta": [0.0, 0.0]}, None, (0.0, 0.4), "RK4"
    here = sv.simulate_many(*arguments, paths={"r": paths}, t_eval=[0.2, 0.4])
    with ProcessPoolExecutor(1) as pool:
        there = sv.simulate_many(*arguments, paths={"r": paths}, t_eval=[0.2, 0.4], executor=pool)
    kept = pickle.loads(pickle.dumps(here))
    for i, path in enumerate(paths):
        along = cart.with_references(r=path)
        run = sv.simulate(along, along.start(theta=[0.1, 0.2][i], dtheta=0.0), (0.0, 0.4), "RK4", t_eval=[0.2, 0.4])
        for batch in (here, there, kept):
            assert np.abs(batch.trace["force"][:, i] - run["force"]).max() < 1e-11 * np.abs(run["force"]).max()


def test_what_paths_cannot_be(model):
    start, paths = model.start(guess={"l": 4.0}), detours(3)
    with refused(NameUnknown, "'Y'"):
        sv.simulate_many(model, start, None, (0.0, 6.0), paths={"Y": paths})
    with refused(SpecificationError, "a path for each case", "with_references"):
        sv.simulate_many(model, start, None, (0.0, 6.0), paths={"X": paths[0]})
    with refused(SpecificationError, "2, 3"):
        sv.simulate_many(model, start, {"m_l": [90.0, 100.0]}, (0.0, 6.0), paths={"X": paths})


def test_a_part_without_a_case_for_compiled_code(model):
    start, masses = model.start(guess={"l": 4.0}), [-1.0, 90.0, 110.0]
    with ThreadPoolExecutor(2) as pool:
        found = sv.simulate_many(model, start, {"m_l": masses}, (0.0, 6.0), paths={"X": detours(3)}, executor=pool)
    assert np.isfinite(found["final x"]).tolist() == [False, True, True]
    assert "m_l" in found.study["message"][0]
