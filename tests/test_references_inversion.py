"""Verdicts, inverses, zeros and time laws along references."""

import numpy as np
import pytest
import referred
from refusals import refused
from scipy.integrate import solve_bvp

import servoctl as sv
from servoctl.errors import SpecificationError


def parts(model):
    return model.reduction.mechanism, model.reduction.program


def same(new, old, tolerance, names):
    for name in names:
        assert np.abs(new[name] - old[name]).max() <= tolerance * np.abs(old[name]).max()


def test_the_inverse_of_a_pendulum_that_stands_is_bounded_between_the_rests_of_its_path():
    """L a'' = g sin a - x'' cos a by SciPy, and the force M x'' + m (x'' + L (sin a)'')."""
    g, L, m, path = 9.81, 0.5, 0.1, sv.paths.rest_to_rest(**referred.CART)

    def rates(t, y):
        return np.array([y[1], (g * np.sin(y[0]) - path.jets(t, 2)[2, 0] * np.cos(y[0])) / L])

    def ends(left, right):
        return np.array([left[1] - (g / L) ** 0.5 * left[0], right[1] + (g / L) ** 0.5 * right[0]])

    times = np.linspace(-4.0, 5.0, 1801)
    other = solve_bvp(rates, ends, times, np.zeros((2, len(times))), tol=1e-9, max_nodes=100000)
    mechanism, program = parts(referred.cart(up=True))
    run = sv.inverse(mechanism, program, (0.0, 1.0))
    assert "at both ends eigenvalues 4.42945, -4.42945 1/s" in run.message and sv.verify(run).passed
    a, da = other.sol(run.t)
    d2x, d2a = path.jets(run.t, 2)[2, 0], rates(run.t, (a, da))[1]
    force = (1.0 + m) * d2x + m * L * (d2a * np.cos(a) - da**2 * np.sin(a))
    assert np.abs(run["theta"] - a).max() < 1e-8 and np.abs(run["force"] - force).max() < 1e-6
    by, t = sv.sensitivity(run, "force", ["m", "L"]), run.t
    for name, value in (("m", m), ("L", L)):
        model = run.model
        forces = [
            sv.simulate(model.with_parameters(**{name: value + h}), model.start(), (0.0, 1.0), "bounded", t_eval=t)["force"]
            for h in (1e-4, -1e-4)
        ]
        slope, inside = (forces[0] - forces[1]) / 2e-4, (t >= 0.0) & (t <= 1.0)  # outside they fade with the window
        assert np.abs(by["force", name] - slope)[inside].max() < 1e-6 * np.abs(slope).max()


def test_a_report_has_the_verdict_at_both_ends_of_the_path():
    found = sv.report(referred.cart(up=True))
    assert found.verdict == "non-minimum phase (hyperbolic)"
    assert "at both ends eigenvalues 4.42945, -4.42945 1/s" in repr(found)


def test_zeros_at_rest_by_a_parameter():
    found = sv.minimum_phase(referred.cart(), "L", (0.2, 1.0))
    swing = 1j * np.sqrt(9.81 / 0.4)
    assert np.abs(np.sort_complex(found.polynomial.roots(0.4)) - [-swing, swing]).max() < 1e-11
    assert repr(found) == repr(sv.minimum_phase(referred.cart(formula=True), "L", (0.2, 1.0)))


def test_a_relaxed_plan_follows_the_path_as_far_as_its_weight_says():
    plans = []
    for formula in (True, False):
        mechanism, program = parts(referred.cart(formula=formula, up=True))
        plans.append(sv.relaxed(sv.plant(mechanism), program, (0.0, 1.0), weight=1e-3))
    old, new = plans
    assert np.allclose(new.t, old.t)
    same(new, old, 1e-7, ("x", "theta", "force", "X"))


def test_the_fastest_law_slows_the_path():
    model = referred.crane()
    law = sv.fastest(*parts(model), {"trolley": (-100.0, 100.0)}, (0.0, 6.0), guess={"l": 4.0})
    assert law.factor == pytest.approx(1.18142, abs=1e-5) and law.binding[:2] == ("trolley", "lower")
    again = model.with_references(**law.paths)
    run = sv.simulate(again, again.start(guess={"l": 4.0}), (0.0, 6.0 * law.factor), t_eval=law.plan.t)
    assert np.abs(run["trolley"] - law.plan["trolley"]).max() < 1e-9
    assert np.abs(run["trolley"]).max() == pytest.approx(100.0, rel=1e-4)


def test_a_slower_program_of_speeds_scales_the_jets_of_references():
    q = sv.coordinates("x")
    path = sv.paths.rest_to_rest(0.0, 2.0, 1.0)
    r = q.references(v=path)
    mechanism = sv.Mechanism(q, sv.particle(q, 2.0, [q[0], 0]), 0, {"force": q[0]})
    program = sv.Program({"V": q.dt(q[0]) - r.d(1)[0] - 0.5 * r.v})
    slower = program.slower(q, 2.0, 0.0)
    model = sv.derive(mechanism, slower).with_references(v=path.at_rate(0.5, about=0.0))
    run = sv.simulate(model, model.start(x=0.0), (0.0, 2.0), "DOP853", t_eval=np.linspace(0.0, 2.0, 21))
    own = sv.derive(mechanism, program)
    fast = sv.simulate(own, own.start(x=0.0), (0.0, 1.0), "DOP853", t_eval=np.linspace(0.0, 1.0, 21))
    assert np.abs(run["x"] - fast["x"]).max() < 1e-9 and np.abs(4 * run["force"] - fast["force"]).max() < 1e-7
    with refused(SpecificationError, "follows v", "path.at_rate(0.5, about=0)"):
        program.slowed(q, 2.0)



def test_a_time_law_is_not_sought_along_derivatives_of_references_or_of_a_reference_of_the_mechanism():
    q = sv.coordinates("x")
    r = q.references(a=sv.paths.rest_to_rest(0.0, 2.0, 1.0))
    limits, mass = {"force": 10.0}, sv.particle(q, 2.0, [q[0], 0])
    mechanism = sv.Mechanism(q, mass, 0, {"force": q[0]})
    with refused(SpecificationError, "contains da", "shape=False"):
        sv.fastest(mechanism, sv.Program({"V": q.dt(q[0]) - r.d(1)[0]}), limits, (0.0, 1.0), shape=True)
    moved = sv.Mechanism(q, mass, 0, {"force": q[0]}, forces={"x": r.a})
    with refused(SpecificationError, "mechanism and its program both contain a", "reference of its own"):
        sv.fastest(moved, sv.Program({"X": q[0] - r.a}), limits, (0.0, 1.0))


def test_designs_are_those_along_a_formula():
    found = [
        sv.design(referred.crane(formula=formula), {"m_l": (80.0, 120.0)}, (0.0, 6.0), guess={"l": 4.0})
        for formula in (True, False)
    ]
    assert repr(found[0]) == repr(found[1])


def test_a_bound_of_a_residual_is_not_one_of_the_reference_with_its_name():
    """The exact plan has X - r = 0: 10 mm bound the residual, not the path, which goes to 3 m."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, sv.particle(q, 2.0, [x, y]), 0, {"fx": x, "fy": y})
    program = sv.Program({"X": x - q.references(X=sv.paths.rest_to_rest(0.0, 3.0, 2.0)).X, "Y": y})
    run = sv.inverse(mechanism, program, (0.0, 2.0), bounds={"X": 0.01})
    assert run.method == "algebraic" and run["X"][-1] == pytest.approx(3.0)
