"""Ranks decided independently of units, and sparse symbolic elimination with pivots chosen numerically."""

import casadi as ca
import numpy as np
import pytest
from conftest import numbers
from refusals import refused
from scipy.linalg import qr

from servoctl.errors import SingularProgram
from servoctl.reduction import ranks
from servoctl.reduction.ranks import (
    _independent_columns,
    clean,
    combination,
    decide,
    decide_all,
    eliminate,
    equilibrate,
    pivot_order,
)
from servoctl.tolerances import EXTENDED, NOISE

LONG = np.longdouble


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
        assert scaled.kept > 1e-4 and scaled.dropped < NOISE / 3


def test_rank_margins_are_reported():
    assert decide(np.zeros((2, 3))).rank == 0
    assert decide(np.zeros((2, 3))).kept == np.inf and decide(np.zeros((2, 3))).dropped == 0.0
    assert decide(np.zeros((0, 3))).rank == 0 and decide(np.zeros((0, 3))).clear
    near = decide(np.array([[1.0, 1.0], [1.0, 1.0 + 1e-6]], dtype=LONG))
    assert near.rank == 2 and near.clear and near.kept == pytest.approx(1e-6, rel=1e-3)
    between = decide(np.array([[1.0, 1.0], [1.0, 1.0 + 1e-12]], dtype=LONG))
    assert between.rank == 1 and not between.clear and between.dropped == pytest.approx(1e-12, rel=1e-2)
    exact = decide(np.array([[1.0, 2.0], [3.0, 6.0]], dtype=LONG))
    assert exact.rank == 1 and exact.clear and exact.dropped < NOISE / 30
    assert decide(np.diag([1.0, 1e-30])).rank == 2


@pytest.mark.skipif(not EXTENDED, reason="without extended precision the noise is that of double precision")
@pytest.mark.parametrize("pivot, rank, clear", [(5e-15, 1, True), (5e-13, 1, False), (5e-11, 1, False), (5e-10, 2, True)])
def test_a_pivot_is_rounding_undecided_or_resolved(pivot, rank, clear):
    """Below 1e-14 it is the rounding of constants folded in double; above 1e-10 a division by it leaves six digits."""
    for rows, columns in ((1.0, 1.0), (1e6, 1e-9)):
        matrix = np.array([[1, 1], [1, 1 + LONG(pivot)]], dtype=LONG) * np.array([[1.0], [rows]]) * [1.0, columns]
        found = decide(matrix)
        assert (found.rank, found.clear) == (rank, clear)


def test_equilibration_brings_entries_near_one_and_returns_its_factors():
    a = np.array([[1e9, 1e-3, 0.0], [1e3, 1e-9, 0.0], [0.0, 0.0, 0.0]])
    scaled, rows, columns = equilibrate(a)
    assert np.abs(scaled[:2, :2]).max() == pytest.approx(1.0, rel=0.05)
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


def test_a_combination_is_found_whatever_the_units():
    rng = np.random.default_rng(11)
    rows = rng.integers(-4, 5, (3, 5)).astype(LONG)
    c = np.array([2.0, -3.0, 0.5])
    for scale in (1.0, 1e9, 1e-9):
        found, left = combination(rows * scale, c @ rows)
        assert found * scale == pytest.approx(c, rel=1e-12) and left < 1e-15
    _, left = combination(rows[:2], rows[2])
    assert left > 1e-3
    assert combination(np.zeros((0, 5)), rows[0])[1] == pytest.approx(1.0)


# elimination ---------------------------------------------------------------------------------------------------------


def symbolic(name, pattern):
    """A matrix of symbols where the pattern is true."""
    m, n = pattern.shape
    entries = [[ca.SX.sym(f"{name}{i}_{j}") if pattern[i, j] else ca.SX(0) for j in range(n)] for i in range(m)]
    return ca.vertcat(*(ca.horzcat(*row) for row in entries))


PATTERNS = {
    "dense": lambda n, rng: np.ones((n, n), dtype=bool),
    "sparse": lambda n, rng: (rng.uniform(size=(n, n)) < 0.25) | np.eye(n, dtype=bool)[rng.permutation(n)],
    "permuted": lambda n, rng: np.eye(n, dtype=bool)[rng.permutation(n)],
    "arrow": lambda n, rng: np.eye(n, dtype=bool) | (np.arange(n) == n - 1) | (np.arange(n) == n - 1)[:, None],
}


@pytest.mark.parametrize("kind", PATTERNS)
@pytest.mark.parametrize("n", [1, 2, 5, 9])
def test_elimination_equals_numpy(kind, n):
    rng = np.random.default_rng(40 + n)
    pattern = PATTERNS[kind](n, rng)
    A, B = symbolic("a", pattern), symbolic("b", np.ones((n, 2)))
    chosen = rng.uniform(0.5, 2.0, (n, n, 3)) * rng.choice([-1.0, 1.0], (n, n, 3)) * pattern[:, :, None]
    solution, pivots = eliminate(A, B, chosen)
    assert solution.shape == (n, 2) and len(pivots) == n
    for k in range(3):  # near the points of the pivots, where the choice is good
        a, b = chosen[:, :, k] * rng.uniform(0.97, 1.03, (n, n)), rng.normal(size=(n, 2))
        values = {f"a{i}_{j}": a[i, j] for i in range(n) for j in range(n)}
        values |= {f"b{i}_{j}": b[i, j] for i in range(n) for j in range(2)}
        exact = np.linalg.solve(a, b)
        found = numbers([ca.vec(solution)], values).reshape(2, n).T
        assert found == pytest.approx(exact, rel=1e-9, abs=1e-10 * np.abs(exact).max())
        assert abs(np.prod(numbers(pivots, values))) == pytest.approx(abs(np.linalg.det(a)), rel=1e-9)


def test_elimination_follows_the_numerical_structure():
    """An entry that is zero by its value alone, like cos 2x + 2 sin² x - 1, costs nothing and is no pivot."""
    x = ca.SX.sym("x")
    false_entry = ca.cos(2 * x) + 2 * ca.sin(x) ** 2 - 1
    A = ca.vertcat(ca.horzcat(false_entry, 2), ca.horzcat(3 + x, 1))
    solution, pivots = eliminate(A, ca.SX([4, 5]), np.array([[[0.0], [2.0]], [[3.5], [1.0]]]))
    assert numbers([solution], {"x": 0.7}) == pytest.approx([3 / 3.7, 2.0], rel=1e-15)
    assert sorted(numbers(pivots, {"x": 0.7})) == pytest.approx([2.0, 3.7])


def test_elimination_does_not_depend_on_units():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(5, 5, 2)), rng.normal(size=5)
    A, B = symbolic("a", np.ones((5, 5))), symbolic("b", np.ones((5, 1)))
    rows, columns = 10.0 ** rng.integers(-9, 10, 5), 10.0 ** rng.integers(-9, 10, 5)
    for r, c in ((np.ones(5), np.ones(5)), (rows, columns)):
        scaled = r[:, None, None] * a * c[None, :, None]
        solution, _ = eliminate(A, B, scaled)
        values = {f"a{i}_{j}": scaled[i, j, 0] for i in range(5) for j in range(5)}
        values |= {f"b{i}_0": r[i] * b[i] for i in range(5)}
        assert c * numbers([solution], values) == pytest.approx(np.linalg.solve(a[:, :, 0], b), rel=1e-9)


def test_a_pivot_that_vanishes_at_one_of_the_points_is_not_taken():
    A, B = symbolic("a", np.ones((2, 2))), symbolic("b", np.ones((2, 1)))
    chosen = np.stack([[[5.0, 1.0], [1.0, 1.0]], [[0.0, 1.0], [1.0, 1.0]]], axis=2)
    _, pivots = eliminate(A, B, chosen)
    for k in range(2):
        values = {f"a{i}_{j}": chosen[i, j, k] for i in range(2) for j in range(2)}
        assert min(abs(numbers(pivots, values))) > 0.5


def test_elimination_without_right_hand_sides_returns_the_pivots():
    A = symbolic("a", np.eye(3))
    solution, pivots = eliminate(A, ca.SX(3, 0), np.eye(3)[:, :, None])
    assert solution.shape == (3, 0) and len(pivots) == 3


@pytest.mark.parametrize("matrix", [[[1.0, 2.0], [2.0, 4.0]], [[0.0, 0.0], [1.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]])
def test_elimination_of_a_singular_matrix_is_refused(matrix):
    with refused(SingularProgram, "singular"):
        eliminate(symbolic("a", np.ones((2, 2))), ca.SX([1, 1]), np.array(matrix)[:, :, None])


def test_entries_that_cancel_are_not_eliminated_again():
    """Rows 0 and 1 agree in their first two columns, so that each is eliminated from the other with one pivot."""
    a, b, c, d, e, f = symbols = [ca.SX.sym(name) for name in "abcdef"]
    A = ca.vertcat(ca.horzcat(a, b, 0), ca.horzcat(a, b, c), ca.horzcat(d, e, f))
    values = np.array([1.0, 0.9, 0.5, 0.7, -0.8, 0.6])
    dense = np.array(ca.Function("A", symbols, [A])(*values))
    solution, _ = eliminate(A, ca.SX([1, 2, 3]), dense[:, :, None])
    found = numbers([solution], dict(zip("abcdef", values, strict=True)))
    assert found == pytest.approx(np.linalg.solve(dense, [1.0, 2.0, 3.0]), rel=1e-13)


def test_identities_are_decided_where_values_cannot_tell(monkeypatch):
    """What is zero at the points of the pivots is left out if it vanishes identically, and stays otherwise."""
    tests = []
    zeros = ranks.identical_zeros
    monkeypatch.setattr(ranks, "identical_zeros", lambda entries: tests.extend([1] * bool(entries)) or zeros(entries))
    a, b, c, d, t = symbols = [ca.SX.sym(name) for name in "abcdt"]
    late = ca.fmax(0, t - 4)
    values = np.array([1.0, 0.9, 0.5, 0.7, 1.0])

    def solved(A, t=9.0):
        f = ca.Function("A", symbols, [A])
        solution, _ = eliminate(A, ca.SX([1, 2, 3]), np.array(f(*values)).round(12)[:, :, None])
        at = np.append(values[:4], t)
        assert numbers([solution], dict(zip("abcdt", at, strict=True))) == pytest.approx(
            np.linalg.solve(np.array(f(*at)), [1.0, 2.0, 3.0]), rel=1e-12
        )

    solved(ca.vertcat(ca.horzcat(a, b, c), ca.horzcat(b, d, a), ca.horzcat(c, a, d)))
    assert tests == []  # no entry is zero at the points
    solved(ca.vertcat(ca.horzcat(a, late, c), ca.horzcat(b, d, a), ca.horzcat(c, a, d)))
    assert tests == [1]  # the entry is asked about, and stays: it is alive at t = 9
    solved(ca.vertcat(ca.horzcat(a, (a + b) ** 2 - a * a - 2 * a * b - b * b, c), ca.horzcat(b, d, a),
                      ca.horzcat(c, a, d)))
    assert tests == [1, 1]  # nothing is left of it
    solved(ca.vertcat(ca.horzcat(a, a * b, c), ca.horzcat(c, b * c + late, d), ca.horzcat(d, b, a)))
    assert tests[2] == 1 and len(tests) <= 4  # a difference that arises on the way, then those that follow


def test_columns_of_a_plan_are_those_of_a_pivoted_qr():
    rng = np.random.default_rng(7)
    for _ in range(300):
        m = int(rng.integers(1, 7))
        matrix = rng.normal(size=(m, m + int(rng.integers(0, 6)))) * 10.0 ** rng.integers(-5, 6)
        assert _independent_columns(matrix, m) == qr(matrix, mode="r", pivoting=True)[1][:m].tolist()


def test_a_small_pivot_is_not_taken_for_its_fill_in():
    """The entry 1e-6 has the least fill-in; eliminating with it loses six digits."""
    chosen = np.array([[1e-6, 1, 0, 0], [1, 0.9, 0.8, -0.7], [0, 0.8, -0.6, 1], [0, 0.7, 1, 0.9]])
    A = symbolic("a", chosen != 0)
    _, pivots = eliminate(A, ca.SX([1, 2, 3, 4]), chosen[:, :, None])
    values = {f"a{i}_{j}": chosen[i, j] for i in range(4) for j in range(4)}
    assert min(abs(numbers(pivots, values))) > 0.05


def test_a_number_is_taken_before_an_expression_that_may_vanish():
    """Among pivots of the same fill-in, though the other is larger at the points."""
    a, b, c = (ca.SX.sym(name) for name in "abc")
    matrix = ca.vertcat(ca.horzcat(a, 1.0), ca.horzcat(b, c))
    numbers = np.array([[[1.5], [1.0]], [[0.3], [2.0]]])
    solution, pivots = eliminate(matrix, ca.SX([1.0, 2.0]), numbers)
    assert pivots[0].is_constant()
    found = np.array(ca.Function("f", [a, b, c], [solution])(1.5, 0.3, 2.0)).ravel()
    np.testing.assert_allclose(found, np.linalg.solve(numbers[:, :, 0], [1.0, 2.0]), rtol=1e-14)


def test_columns_to_be_solved_for_are_regular_at_all_points():
    a = ca.SX.sym("a")
    matrix = ca.horzcat(ca.vertcat(1.0, 0.0), ca.vertcat(a, 1.0), ca.vertcat(2.0, 1.0))
    numbers = np.array([[[1.0, 1.0], [0.0, 2.0], [2.0, 2.0]], [[0.0, 0.0], [1.0, 1.0], [1.0, 1.0]]])
    columns = [j for _, j in pivot_order(matrix, numbers)]
    assert len(columns) == 2 and all(abs(np.linalg.det(numbers[:, columns, i])) > 0.1 for i in range(2))
    with pytest.raises(SingularProgram):
        pivot_order(ca.SX([[1.0, 1.0], [1.0, 1.0]]), np.ones((2, 2, 1)))
