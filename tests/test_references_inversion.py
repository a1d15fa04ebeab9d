"""Verdicts, inverses, zeros and time laws along references: those of the same path in the old spelling."""

import casadi as ca
import numpy as np
import pytest
import referred
from refusals import refused

import servoctl as sv
from servoctl.control.time_optimal import in_formulas
from servoctl.errors import SpecificationError


def parts(model):
    return model.reduction.mechanism, model.reduction.program


def same(new, old, tolerance, names):
    for name in names:
        assert np.abs(new[name] - old[name]).max() <= tolerance * np.abs(old[name]).max()


def test_the_inverse_of_a_pendulum_that_stands_is_bounded_between_the_rests_of_its_path():
    old, new = (sv.inverse(*parts(referred.cart(old=old, up=True)), (0.0, 1.0)) for old in (True, False))
    assert "at both ends eigenvalues 4.42945, -4.42945 1/s" in new.message and new.message == old.message
    same(new, old, 1e-11, ("theta", "force"))
    by = [sv.sensitivity(run, "force", ["m", "L"]) for run in (new, old)]
    for name in ("m", "L"):
        assert np.abs(by[0]["force", name] - by[1]["force", name]).max() < 1e-8 * np.abs(by[1]["force", name]).max()


def test_a_report_has_the_verdict_at_both_ends_of_the_path():
    old, new = (sv.report(referred.cart(old=old, up=True)) for old in (True, False))
    assert repr(new).splitlines()[:2] == repr(old).splitlines()[:2] and "at both ends" in repr(new)


def test_zeros_at_rest_by_a_parameter():
    old, new = (sv.minimum_phase(referred.cart(old=old), "L", (0.2, 1.0)) for old in (True, False))
    assert repr(new) == repr(old)
    assert np.allclose(
        np.sort_complex(new.polynomial.roots(0.4)), np.sort_complex(old.polynomial.roots(0.4)), rtol=1e-12
    )


def test_a_relaxed_plan_follows_the_path_as_far_as_its_weight_says():
    plans = []
    for old in (True, False):
        mechanism, program = parts(referred.cart(old=old, up=True))
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


def test_a_path_is_the_same_as_a_formula_of_time():
    mechanism, program = parts(referred.crane())
    q, paths = mechanism.q, mechanism.q.family.paths
    found = in_formulas(q, program, paths).residuals
    at = [*q]
    rows = ca.Function("rows", [q.t, ca.vertcat(*at)], [ca.vertcat(*found.values())])
    for t in (-1.0, 0.0, 2.2, 6.0, 7.5):
        x, l, theta = np.array([0.3, 3.1, 0.2])
        wanted = x + l * np.sin(theta) - paths["X"](t), -l * np.cos(theta) + paths["Z"](t)
        assert np.allclose(np.array(rows(t, [x, l, theta])).ravel(), wanted, rtol=0, atol=1e-14)


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


def test_designs_are_those_of_the_old_spelling():
    found = [
        sv.design(referred.crane(old=old), {"m_l": (80.0, 120.0)}, (0.0, 6.0), guess={"l": 4.0})
        for old in (True, False)
    ]
    assert repr(found[0]) == repr(found[1])
