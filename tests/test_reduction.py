"""Ranks, elimination, eq. (3.18), hidden constraints, redundant actuation, invariance, knots."""

import casadi as ca
import numpy as np
import pytest
from conftest import at_random, motion, numbers, signal

from servoctl import spec as sv
from servoctl.errors import InconsistentStart, NotRealisable, ServoError, SingularProgram, SpecificationError
from servoctl.mechanisms import cars, crane_3d, gallery, mass_on_car, overhead_crane, passive_arm, spiral, vtol
from servoctl.model.model import derive
from servoctl.reduction.elimination import eliminate
from servoctl.reduction.ranks import clean, decide, decide_all, equilibrate
from servoctl.reduction.rows import gradient, sample_rows

LONG = np.longdouble


def orders(model):
    return [row.order for row in model.reduction.rows]


# ranks ---------------------------------------------------------------------------------------------------------------


def of_rank(rng, m, n, r):
    return (rng.integers(-4, 5, (m, r)) @ rng.integers(-4, 5, (r, n))).astype(LONG)


@pytest.mark.parametrize("seed", range(8))
def test_rank_decisions_do_not_depend_on_units(seed):
    rng = np.random.default_rng(seed)
    m, n = rng.integers(2, 7, 2)
    r = int(rng.integers(1, min(m, n) + 1))
    a = of_rank(rng, m, n, r)
    true = np.linalg.matrix_rank(a.astype(float))
    plain = decide(a)
    assert plain.rank == true and plain.clear and len(plain.rows) == len(plain.columns) == true
    block = a[np.ix_(plain.rows, plain.columns)].astype(float)
    assert np.linalg.matrix_rank(block) == true
    for _ in range(4):
        rows, columns = (LONG(10) ** rng.integers(-9, 10, k).astype(LONG) for k in (m, n))
        scaled = decide(rows[:, None] * a * columns[None, :])
        assert scaled.rank == true and scaled.clear
        assert scaled.kept > 1e-4 and scaled.dropped < 1e-17


def test_rank_margins_are_reported():
    assert decide(np.zeros((2, 3))).rank == 0
    assert decide(np.zeros((2, 3))).kept == np.inf and decide(np.zeros((2, 3))).dropped == 0.0
    assert decide(np.zeros((0, 3))).rank == 0 and decide(np.zeros((0, 3))).clear
    near = decide(np.array([[1.0, 1.0], [1.0, 1.0 + 1e-6]], dtype=LONG))
    assert near.rank == 2 and near.clear and near.kept == pytest.approx(1e-6, rel=1e-3)
    between = decide(np.array([[1.0, 1.0], [1.0, 1.0 + 1e-13]], dtype=LONG))
    assert between.rank == 1 and not between.clear and between.dropped == pytest.approx(1e-13, rel=1e-2)
    exact = decide(np.array([[1.0, 2.0], [3.0, 6.0]], dtype=LONG))
    assert exact.rank == 1 and exact.clear and exact.dropped < 1e-18
    assert decide(np.diag([1.0, 1e-30])).rank == 2


def test_equilibration_brings_entries_near_one_and_returns_its_factors():
    a = np.array([[1e9, 1e-3, 0.0], [1e3, 1e-9, 0.0], [0.0, 0.0, 0.0]])
    scaled, rows, columns = equilibrate(a)
    assert np.abs(scaled[:2, :2]).max() == pytest.approx(1.0, rel=1e-3)
    assert (rows[:, None] * a * columns[None, :]).astype(float) == pytest.approx(scaled.astype(float), rel=1e-14)
    assert np.all(np.isfinite(scaled))


def test_entries_below_the_size_of_their_terms_are_zero():
    values, sizes = np.array([1e-14, 1e-10, -3.0, 1e-20]), np.array([1.0, 1.0, 3.0, 1e-20])
    assert list(clean(values, sizes)) == [0.0, 1e-10, -3.0, 1e-20]


def test_the_generic_rank_is_the_highest_over_the_points():
    values = np.zeros((2, 2, 3))
    values[:, :, 0] = [[1, 0], [0, 0]]
    values[:, :, 1] = [[1, 1], [1, 2]]
    values[:, :, 2] = [[1, 0], [0, 1]]
    rank, best = decide_all(values, np.abs(values))
    assert rank.rank == 2 and best == 2
    assert rank.kept == pytest.approx(0.5, rel=0.3)


# elimination ---------------------------------------------------------------------------------------------------------


def symbolic(pattern):
    n, m = pattern.shape
    return ca.vertcat(*(ca.horzcat(*(ca.SX.sym(f"a{i}_{j}") if pattern[i, j] else ca.SX(0) for j in range(m))) for i in range(n)))


def with_numbers(rng, pattern, count):
    values = rng.uniform(0.5, 2.0, (*pattern.shape, count)) * rng.choice([-1.0, 1.0], (*pattern.shape, count))
    return values * pattern[:, :, None]


@pytest.mark.parametrize("kind", ["dense", "sparse", "permuted", "arrow"])
@pytest.mark.parametrize("n", [1, 2, 5, 9])
def test_elimination_equals_numpy(kind, n):
    rng = np.random.default_rng(40 + n)
    pattern = {
        "dense": np.ones((n, n), dtype=bool),
        "sparse": (rng.uniform(size=(n, n)) < 0.25) | np.eye(n, dtype=bool)[rng.permutation(n)],
        "permuted": np.eye(n, dtype=bool)[rng.permutation(n)],
        "arrow": np.eye(n, dtype=bool) | (np.arange(n) == n - 1) | (np.arange(n) == n - 1)[:, None],
    }[kind]
    A, B = symbolic(pattern), symbolic(np.ones((n, 2), dtype=bool))
    chosen = with_numbers(rng, pattern, 3)
    solution, pivots = eliminate(A, B, chosen)
    assert solution.shape == (n, 2) and len(pivots) == n
    f = ca.Function("f", [ca.vertcat(*ca.symvar(ca.vertcat(ca.vec(A), ca.vec(B))))], [solution, ca.vertcat(*pivots)])
    names = [s.name() for s in ca.symvar(ca.vertcat(ca.vec(A), ca.vec(B)))]
    for k in range(3):  # near the points of the pivots, where the choice is good
        a = chosen[:, :, k] * rng.uniform(0.95, 1.05, (n, n))
        b = rng.normal(size=(n, 2))
        f_values = {f"a{i}_{j}": a[i, j] for i in range(n) for j in range(n)}
        separate = ca.Function("s", [ca.vec(A[pattern.nonzero()[0].tolist(), 0]) if False else ca.SX.sym("z")], [1])
        assert separate is not None and names
        A_values, B_values = ca.DM(a), ca.DM(b)
        g = ca.Function("g", ca.symvar(A) + ca.symvar(B), [solution, ca.vertcat(*pivots)], {"allow_duplicate_io_names": True})
        inputs = [f_values[s.name()] for s in ca.symvar(A)]
        inputs += [b[tuple(int(i) for i in s.name()[1:].split("_"))] for s in ca.symvar(B)]
        x, p = (np.array(v) for v in g.call(inputs))
        assert A_values.shape == (n, n) and B_values.shape == (n, 2) and f is not None
        assert x == pytest.approx(np.linalg.solve(a, b), rel=1e-10, abs=1e-10)
        assert abs(np.prod(p)) == pytest.approx(abs(np.linalg.det(a)), rel=1e-10)
