"""The quadratic program of an allocation in C: optimal by its conditions of optimality, and equal to DAQP's solution."""

import ctypes
import pickle

import casadi as ca
import mpmath
import numpy as np
import pytest
from refusals import refused
from scenes import CRANE

import servoctl as sv
from servoctl.codegen import compiler, emit
from servoctl.control import limits
from servoctl.control.limits import DEPENDENT, STEPS, WITHIN

pytestmark = pytest.mark.skipif(compiler.compiler() is None, reason="needs a compiler")


def in_c(n, m):
    sizes = {"N_QP": n, "M_QP": m, "QP_STEPS": STEPS, "QP_MET": WITHIN, "QP_DEPENDENT": DEPENDENT, "NAME": "qp"}
    text = emit.unit(sizes) + emit.include("small_qp.h") + (
        "int solve(const double *H, const double *N, const double *b, double *v)\n"
        "{ return small_qp((const double (*)[N_QP])H, (const double (*)[N_QP])N, b, v); }\n"
    )
    library = compiler.library(text)

    def solve(H, low, high, A, least, most):
        N = np.ascontiguousarray(np.vstack([np.eye(n), -np.eye(n), A, -A]))
        b, v = np.concatenate([low, -high, least, -most]), np.empty(n)
        arrays = (np.ascontiguousarray(H), N, b, v)
        return v if library.solve(*(ctypes.c_void_p(a.ctypes.data) for a in arrays)) else None

    return solve


def by_daqp(H, low, high, A, least, most):
    (j, n), options = A.shape, {"error_on_fail": False}
    qp = ca.conic("qp", "daqp", {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(j, n)}, options)
    v = qp(h=H, a=A, lba=least, uba=most, lbx=low, ubx=high)["x"]
    return np.asarray(v).ravel() if qp.stats()["success"] else None


def problem(rng, n, j, spread):
    root = rng.normal(size=(n, n)) * spread ** rng.uniform(-1, 1, n)
    H = root.T @ root + 1e-6 * np.eye(n)
    low, high = np.sort(rng.normal(size=(2, n)), axis=0)
    low[rng.random(n) < 0.2], high[rng.random(n) < 0.2] = -np.inf, np.inf
    A = rng.normal(size=(j, n))
    A /= np.abs(A).max(axis=1, initial=1e-300)[:, None]
    least, most = np.sort(rng.normal(size=(2, j)) + 0.5, axis=0)
    return H / np.abs(H).max(), low, high, A, least, most


def best(H, N, b):
    """The least of v'Hv/2 on N v = b, and its multipliers, to 40 digits."""
    (k, n), N = N.shape, mpmath.matrix(N)
    with mpmath.workdps(40):
        K, right = mpmath.zeros(n + k), mpmath.zeros(n + k, 1)
        K[:n, :n], K[n:, :n], K[:n, n:], right[n:, 0] = mpmath.matrix(H), N, -N.T, mpmath.matrix(b)
        solution = np.array([float(x) for x in mpmath.lu_solve(K, right)])
    return solution[:n], solution[n:]


@pytest.mark.parametrize("n, j", [(1, 1), (2, 0), (2, 2), (3, 1), (5, 3), (8, 0), (8, 4)])
@pytest.mark.parametrize("spread", [1.0, 100.0])
def test_solutions_are_optimal_and_those_of_daqp(n, j, spread):
    rng, solve, solved = np.random.default_rng(n + 10 * j), in_c(n, 2 * (n + j)), 0
    while solved < 12:
        H, low, high, A, least, most = given = problem(rng, n, j, spread)
        v, other = solve(*given), by_daqp(*given)
        assert (v is None) == (other is None)
        if v is None or not v.any():
            continue
        solved += 1
        N, b = np.vstack([np.eye(n), -np.eye(n), A, -A]), np.concatenate([low, -high, least, -most])
        gaps = N @ v - b
        assert gaps.min() > -WITHIN
        exact, multipliers = best(H, N[gaps < 1e-9], b[gaps < 1e-9])
        assert v == pytest.approx(exact, rel=1e-9, abs=1e-9) and np.all(multipliers >= -1e-12)
        if spread == 1.0:  # DAQP's own tolerances are wider than the valley of others
            assert v == pytest.approx(other, rel=1e-9, abs=1e-9)


def test_constraints_that_coincide_touch_or_exclude_each_other():
    solve, one = in_c(2, 8), np.ones(2)
    none = np.array([-np.inf, -np.inf]), np.array([np.inf, np.inf])
    A = np.array([[1.0, 1.0], [1.0, 1.0]])
    assert solve(np.eye(2), *none, A, 2 * one, 3 * one) == pytest.approx([1.0, 1.0])  # the same row twice
    assert solve(np.eye(2), one, one, A, 2 * one, 2 * one) == pytest.approx([1.0, 1.0])  # a single point
    assert solve(np.eye(2), one, 2 * one, A, -one, 2 * one) == pytest.approx([1.0, 1.0])
    assert solve(np.eye(2), one, 2 * one, A, -one, 1.99 * one) is None
    assert solve(np.eye(2), 2 * one, one, A, *none) is None
    assert solve(np.eye(2), *none, 0 * A, -one, one) == pytest.approx([0.0, 0.0])
    assert solve(np.eye(2), *none, 0 * A, one, 2 * one) is None
    assert solve(np.nan * np.eye(2), one, 2 * one, A, *none) is None


@pytest.mark.parametrize("far", [1.0, 1e3, 1e6, 1e9, 1e12])
def test_limits_far_from_what_is_wanted_are_met_to_rounding(far):
    """A wild measurement: what the law wants is so far from the limits that rounding exceeds any fixed tolerance."""
    rng, solve = np.random.default_rng(1983), in_c(3, 8)
    for _ in range(20):
        root = rng.normal(size=(3, 3))
        low = far * rng.normal(size=3)
        high, A = low + far * rng.random(3), rng.normal(size=(1, 3))
        least = A @ (low + (high - low) * rng.random(3))
        v = solve(root.T @ root + np.eye(3), low, high, A, least, least + 0.1 * far)
        assert v is not None
        assert np.all(v >= low - 1e-9 * far) and np.all(v <= high + 1e-9 * far) and A @ v >= least - 1e-8 * far
    outside = A @ np.where(A[0] > 0, low, high) - 0.1 * far
    assert solve(np.eye(3), low, high, A, outside - far, outside) is None


def laws(plan, machine):
    free = sv.plant(CRANE)
    yield "integral", sv.lqr(plan, free, rate=200.0, integral=True), {}
    yield "bounds", sv.lqr(plan, free, rate=200.0), {"bounds": {"tension": (0.0, 1000.0)}}
    yield "priority", sv.lqr(plan, free, rate=200.0), {"priority": ("Z", "X")}
    yield "estimator", sv.output_feedback(sv.lqr(plan, free, 200.0), free, {"x": 1e-3, "l": 1e-3, "theta": 1e-3}), {}
    yield "computed", sv.computed(plan, free, rate=200.0), {}


def test_compiled_allocations_are_those_in_python(plan, monkeypatch):
    machine = sv.plant(CRANE, limits={"trolley": 100.0, "hoist": (None, 0.0)}, rate_limits={"hoist": 2e3})
    for name, law, given in laws(plan, machine):
        limited = sv.limited(law, machine, **given)
        runs = []
        for native in (limits.Allocation.native, lambda self, *_: None):
            monkeypatch.setattr(limits.Allocation, "native", native)
            runs.append(sv.close(machine, limited, plan.state(0.0), (0.0, 5.0)))
        monkeypatch.undo()
        compiled, in_python = runs
        assert compiled.states == pytest.approx(in_python.states, rel=1e-8, abs=1e-9), name
        for signal in limited.allocation.signals:
            size = max(1.0, np.abs(in_python.signal[signal]).max())
            differ = np.abs(compiled.signal[signal] - in_python.signal[signal]) > 1e-6 * size
            assert differ.mean() <= 0.002, (name, signal)  # a sample may be at its limit by rounding
        assert any(np.any(compiled.signal[f"limit {actuator}"]) for actuator in machine.inputs), name


def test_an_allocation_that_is_impossible_says_so_from_c(plan):
    machine = sv.plant(CRANE, limits={"hoist": (-900.0, 0.0)})
    law = sv.limited(sv.lqr(plan, machine, rate=100.0), machine, bounds={"tension": (1100.0, None)})
    assert law.step.native("step") is not None
    with refused(sv.errors.LimitExceeded, "tension") as caught:
        sv.close(machine, law, plan.state(0.0), (0.0, 4.0))
    assert caught.value.run is not None and len(caught.value.details["low"]) == 2


def test_laws_and_loops_that_ran_in_c_are_pickled(plan):
    machine = sv.plant(CRANE, limits={"trolley": 50.0})
    law = sv.limited(sv.lqr(plan, machine, rate=100.0), machine)
    run = sv.close(machine, law, plan.state(0.0), (0.0, 0.5))
    again = pickle.loads(pickle.dumps(run))
    assert again.law == law
    assert np.array_equal(sv.close(machine, again.law, plan.state(0.0), (0.0, 0.5)).states, run.states)
    assert sv.close_many(again, {"m_load": [100.0]})["final x"] == pytest.approx(run["x"][-1], rel=1e-12)
