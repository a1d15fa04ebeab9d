"""Exponentials and Riccati recursions of many matrices: compiled code against NumPy and SciPy, and laws made by both."""

import copy
import pickle

import numpy as np
import pytest
from scenes import CRANE
from scipy.linalg import expm

import servoctl as sv
from servoctl.codegen import compiler, matrices
from servoctl.codegen.matrices import FEWEST_COMPILED, exponentials, norms, riccati
from servoctl.control import lqr as design
from servoctl.control.sampling import TERMS, spectral_radii

COUNT = FEWEST_COMPILED + 3


@pytest.fixture
def numpy_alone(monkeypatch):
    """A function that has what follows computed without a compiler."""
    return lambda: monkeypatch.setenv("SERVOCTL_COMPILER", "none")


@pytest.mark.parametrize("n", [1, 3, 8, 9, 17])
def test_compiled_exponentials_are_those_of_scipy(n, c_compiler, numpy_alone):
    rng = np.random.default_rng(n)
    scaled = rng.uniform(-1.0, 1.0, (COUNT, n, n)) / (2 * n)
    units = 2.0 ** rng.integers(-20, 20, n)
    scales, squarings = units[:, None] / units, rng.integers(0, 3, COUNT)
    x = scaled * scales * 2.0 ** squarings[:, None, None]
    compiled = exponentials(x, scales, squarings, TERMS), norms(x, scales)
    exact = np.array([expm(a) for a in x / scales])
    numpy_alone()
    for found, sizes in (compiled, (exponentials(x, scales, squarings, TERMS), norms(x, scales))):
        size = np.abs(exact).max(axis=(1, 2), keepdims=True)
        assert np.abs((found / scales - exact) / size).max() < 1e-13
        np.testing.assert_allclose(sizes, np.abs(x / scales).sum(axis=2).max(axis=1), rtol=1e-14)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (6, 2), (8, 1), (9, 3), (13, 5)])
@pytest.mark.parametrize("of_state", [True, False])
def test_the_compiled_recursion_is_that_of_numpy(n, m, of_state, monkeypatch, c_compiler, numpy_alone):
    rng = np.random.default_rng(n)
    both = 0.5 * rng.normal(size=(COUNT, n + m, n + m + 1)) + np.eye(n + m, n + m + 1)
    A, B = both[::-1, :n, :n], both[::-1, :n, n : n + m]  # rows with gaps, backwards
    C = rng.normal(size=(n, n))
    Q, R, P = np.broadcast_to(C @ C.T, A.shape), np.diag(rng.uniform(0.1, 10.0, m)), np.eye(n)
    found = riccati(A, B, Q, R, P, of_state)
    monkeypatch.setattr(matrices, "PRODUCTS", 1000)
    for part, again in zip(found, riccati(A, B, Q, R, P, of_state), strict=True):
        np.testing.assert_array_equal(again, part)
    numpy_alone()
    for part, expected in zip(found, riccati(A, B, Q, R, P, of_state), strict=True):
        np.testing.assert_allclose(part, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_array_equal(P, np.eye(n))


def test_few_matrices_are_left_to_numpy_and_many_of_a_size_compiled_once(monkeypatch, c_compiler):
    asked, library = [], compiler.library
    monkeypatch.setattr(compiler, "library", lambda text, *given, **options: asked.append(text) or library(text, *given, **options))
    for count in (1, FEWEST_COMPILED, FEWEST_COMPILED + 1, FEWEST_COMPILED + 2):
        exponentials(np.zeros((count, 2, 2)), np.ones((2, 2)), np.zeros(count, dtype=int), TERMS)
    assert len(asked) == 2 and len(set(asked)) == 1


def test_a_recursion_that_leaves_the_range_of_floats_has_no_gains(numpy_alone):
    A, B = np.full((COUNT, 1, 1), 1e300), np.ones((COUNT, 1, 1))
    for _ in range(2):
        assert not np.isfinite(riccati(A, B, A, np.zeros((1, 1)), np.zeros((1, 1)))[0]).all()
        numpy_alone()


@pytest.mark.parametrize("lag", [None, {"trolley": 0.05}])
@pytest.mark.parametrize("how", [{}, {"integral": True}, {"varying": False}])
def test_laws_of_compiled_recursions_are_those_of_numpy(lag, how, plan, c_compiler, numpy_alone):
    plant = sv.plant(CRANE, lag=lag)

    def laws():
        law = sv.lqr(plan, plant, **how)
        return law, sv.output_feedback(law, plant, {"x": 1e-3, "l": 1e-3, "theta": 1e-3})

    compiled = laws()
    numpy_alone()
    for law, expected in zip(compiled, laws(), strict=True):
        size = np.abs(expected.schedule).max()
        np.testing.assert_allclose(law.schedule, expected.schedule, rtol=1e-8, atol=1e-11 * size)
        for name in [name for name in law.info if "radius" in name]:
            assert law.info[name] == pytest.approx(expected.info[name], rel=1e-10)


def test_spectral_radii_are_those_of_all_samples_and_computed_when_they_are_read(plan, monkeypatch):
    seen = []
    monkeypatch.setattr(design, "spectral_radii", lambda m: seen.append(len(m)) or spectral_radii(m))
    law, twin = (sv.lqr(plan, sv.plant(CRANE)) for _ in range(2))
    asked = len(seen)
    names = list(law.info.keys())
    assert "gains" in law.info and len(names) == len(law.info)
    assert max(seen, default=0) <= 1 and len(seen) == asked
    largest = law.info["largest spectral radius along the plan"]
    assert seen[asked:] == [law.schedule.shape[1]] and 0.0 < largest < 1.0
    assert law.info.get("spectral radius at its end") <= largest and len(seen) == asked + 1
    assert pickle.loads(pickle.dumps(twin)) == law and twin == law
    for read in (dict, copy.copy, lambda info: info | {}, lambda info: {} | info, lambda info: {**info}):
        info = read(sv.lqr(plan, sv.plant(CRANE)).info)
        assert info["largest spectral radius along the plan"] == largest and list(info) == names
