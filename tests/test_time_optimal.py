"""Time-optimal laws along the curve of a program: closed forms, the crane, internal dynamics, refusals."""

import sys

import casadi as ca
import closed_forms
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import trapezoid
from scipy.optimize import brentq

import servoctl as sv
from servoctl.control.time_optimal import INTERVALS
from servoctl.gallery import cars, gallery, overhead_crane, wheeled_robot

CRANE = {"trolley": 300.0, "hoist": (-1400.0, 0.0)}
NEAR = 0.01  # of a limit: distance within which it is active


def active(law, limits):
    """Part of the duration within which one of the limits is active."""
    plan, on = law.plan, np.zeros(len(law.plan.t), dtype=bool)
    for name, limit in limits.items():
        low, high = limit if isinstance(limit, tuple) else (-limit, limit)
        size = max(abs(side) for side in (low, high) if side is not None)
        values = plan[name] if name in plan.names else np.interp(plan.t, *rate(plan, name[1:]))
        on |= (values > high - NEAR * size) | (values < low + NEAR * size)
    return trapezoid(on.astype(float), plan.t) / np.ptp(plan.t)


def rate(plan, name):
    """Instants and mean rates between them, 997 of the whole motion."""
    t = np.linspace(plan.t[0], plan.t[-1], 998)
    return (t[1:] + t[:-1]) / 2, np.diff(np.interp(t, plan.t, plan[name])) / np.diff(t)


def even_duration(k):
    """Of the crane's path by a polynomial of class k within its limits, from closed forms [s]."""

    def excess(duration):
        forces = closed_forms.overhead_crane(np.linspace(0.0, duration, 4001), duration=duration, k=k)
        return max(np.abs(forces["trolley"]).max() / 300.0, -forces["hoist"].min() / 1400.0) - 1.0

    return brentq(excess, 3.0, 8.0)


def mass(path, m=2.0):
    q = sv.coordinates("x")
    (x,) = q
    p = sv.parameters(m=m)
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, x), actuators={"push": x}, parameters=p)
    return mechanism, sv.Program({"X": x - path(q)})


def S7(q):
    return q.references(X=sv.paths.rest_to_rest(0.0, 3.0, duration=5.0, smoothness=3)).X


def even(q):
    return q.references(X=sv.paths.polynomials([0.0, 50.0], [[0.06], [0.0]])).X


def trailer():
    """A mass follows a path and draws another one by a spring and a damper: two stable, free initial values."""
    q = sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    pull = 50.0 * (y - x) + 20.0 * (dy - dx)
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 10.0, x) + sv.particle(q, 5.0, y), forces={"x": pull, "y": -pull}, actuators={"push": x}
    )
    return mechanism, sv.Program({"X": x - S7(q)})


def test_the_crane_is_faster_than_by_any_polynomial_and_at_a_limit_nearly_throughout():
    law = sv.fastest(*overhead_crane(), CRANE, (0.0, 6.0), guess={"l": 4.0}, shape=True)
    duration = law.plan.t[-1]
    assert duration == pytest.approx(6.0 * law.factor)
    assert duration < 0.75 * min(even_duration(k) for k in (4, 6, 8))
    assert active(law, CRANE) >= 0.8
    for name, (low, high) in {"trolley": (-300.0, 300.0), "hoist": (-1400.0, 0.0)}.items():
        (_, least), (_, most) = law.plan.extrema(name)
        assert low <= least and most <= high
    assert sv.verify(law.plan).passed
    assert np.abs(law.plan["X"] / 5.0 - (4.0 - law.plan["Z"]) / 2.0).max() < 1e-9  # the straight line
    assert law.plan["X"][-1] == pytest.approx(5.0) and abs(law.plan["trolley"][-1]) < 1e-6


@pytest.mark.parametrize("path, span", [(S7, (0.0, 5.0)), (even, (0.0, 50.0))])
def test_a_mass_takes_the_time_of_full_thrust_and_one_interval_of_ramps(path, span):
    """Thrust ±F takes 2√(dm/F); reversal and both ends take an interval each, whatever the pace of the path given."""
    law = sv.fastest(*mass(path), {"push": 4.0}, span, shape=True)
    least = 2.0 * np.sqrt(3.0 * 2.0 / 4.0)
    assert least < law.plan.t[-1] <= least * (1.0 + 1.1 / INTERVALS)
    assert active(law, {"push": 4.0}) > 0.94
    assert sv.verify(law.plan).passed


def test_limits_of_rates_give_the_law_of_seven_pieces():
    """Thrust ±F at rates ±R: T = t_r + √(t_r² + 4 d m/F) with t_r = F/R."""
    limits = {"push": 4.0, "dpush": 10.0}
    law = sv.fastest(*mass(S7), limits, (0.0, 5.0), shape=True)
    assert law.plan.t[-1] == pytest.approx(0.4 + np.sqrt(0.4**2 + 4 * 3.0 * 2.0 / 4.0), rel=1e-3)
    assert np.abs(rate(law.plan, "push")[1]).max() <= 10.0 * (1 + 1e-9)
    assert active(law, limits) > 0.99


def test_the_part_of_a_path_within_the_span_is_the_curve():
    """A line at constant speed with breaks before, inside and after the span, and one that goes on."""
    for breaks in ([0.0, 20.0, 50.0, 80.0], [-50.0, -10.0, 50.0], [0.0, 10.0]):
        table = np.array([np.full(len(breaks) - 1, 0.06), 0.06 * np.array(breaks[:-1])])
        path = sv.paths.polynomials(breaks, table, before="continue", after="continue")
        law = sv.fastest(*mass(lambda q, path=path: q.references(X=path).X), {"push": 4.0}, (0.0, 50.0), shape=True)
        assert law.plan.t[-1] == pytest.approx(2.0 * np.sqrt(3.0 * 2.0 / 4.0), rel=1.1 / INTERVALS)
        assert law.plan["x"][-1] == pytest.approx(3.0) and law.program.names == ("X",)


def test_geometry_along_a_reference_may_turn_back():
    """x = sin(π s) from s = 0 to 1: 0, 1 m and back; at the turn the mass need not stop in s."""
    q = sv.coordinates("x")
    s = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0)).s
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, q[0]), actuators={"push": q[0]})
    law = sv.fastest(mechanism, sv.Program({"X": q[0] - ca.sin(np.pi * s)}), {"push": 4.0}, (0.0, 2.0), shape=True)
    least = 2 * np.sqrt(2.0)  # s: half a metre at full thrust of 2 m/s^2, a metre against it, half a metre
    assert least < law.plan.t[-1] <= least * (1.0 + 1.1 / INTERVALS)
    assert law.plan["x"].max() == pytest.approx(1.0, abs=1e-3) and sv.verify(law.plan).passed


def test_parameters_and_states_take_part():
    """Half the mass at the same thrust; a limit of speed v adds a coast: T = d/v + v m/F."""
    law = sv.fastest(*mass(S7), {"push": 4.0, "dx": 1.0}, (0.0, 5.0), parameters={"m": 4.0}, shape=True)
    least = 3.0 / 1.0 + 1.0 * 4.0 / 4.0
    assert least < law.plan.t[-1] < least * (1.0 + 1.2 / INTERVALS)


def test_stable_internal_dynamics_take_part():
    law = sv.fastest(*trailer(), {"push": 60.0}, (0.0, 5.0), shape=True)
    even = sv.fastest(*trailer(), {"push": 60.0}, (0.0, 5.0))
    assert law.plan.t[-1] < 0.8 * even.plan.t[-1] and active(law, {"push": 60.0}) > 0.9
    assert np.abs(law.plan["push"]).max() <= 60.0 and sv.verify(law.plan).passed
    assert not law.plan.model.flat and law.plan["y"][-1] != pytest.approx(3.0)


def test_two_cars_with_a_force_of_the_fourth_derivative():
    law = sv.fastest(*cars(), {"force": 200.0}, (0.0, 2.0), shape=True)
    assert law.factor < 0.76 * 1.1170918  # of S13 stretched evenly, by its closed form
    assert active(law, {"force": 200.0}) > 0.8 and np.abs(law.plan["force"]).max() <= 200.0


def test_a_full_circle_is_followed():
    """A curve by its arc length: its fit is exact, and its speed is bounded by F = m v²/r."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)), actuators={"fx": x, "fy": y})
    turn = 2 * np.pi * q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0)).s
    program = sv.Program({"X": x - ca.cos(turn), "Y": y - ca.sin(turn)})
    law = sv.fastest(mechanism, program, {"fx": 3.0, "fy": 3.0}, (0.0, 2.0), shape=True)
    assert np.abs(np.hypot(law.plan["x"], law.plan["y"]) - 1.0).max() < 1e-11
    assert max(np.abs(law.plan[name]).max() for name in ("fx", "fy")) <= 3.0 and active(law, {"fx": 3.0, "fy": 3.0}) > 0.8
    assert sv.verify(law.plan).passed


def test_what_is_no_curve_is_refused():
    def line(q, name="X"):
        return q.references(**{name: sv.paths.rest_to_rest(0.0, 1.0, duration=2.0)})[name]

    def there_and_back(q):
        out = sv.paths.rest_to_rest(0.0, 1.0, duration=1.0)
        return q.references(X=out.then(1.0 - out)).X

    pushed, wanted = mass(line), {"push": 3.0}
    q = pushed[0].q
    (x,), t, speeds = q, q.t, q.references(V=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0))
    for program, name, advice in (
        (sv.Program({"X": x * (1.0 + t) - line(q, "Y")}), "X", "in place of q.t"),
        (sv.Program({"X": x - 1.0}), "X", "r = q.references(X=path)"),
        (sv.Program({"X": q.d(1)[0] - 1.0}), "X", "Prescribe positions"),
        (sv.Program({"X": q.d(1)[0] - speeds.d(1)[0]}), "X", "Integrate it"),
    ):
        with refused(sv.errors.SpecificationError, advice, name=name):
            sv.fastest(pushed[0], program, wanted, (0.0, 2.0), shape=True)
    with refused(sv.errors.SpecificationError, "at 0.5", "Round it off", name="X"):
        sv.fastest(*mass(there_and_back), wanted, (0.0, 2.0), shape=True)
    corner = sv.paths.polynomials([0.0, 1.0, 2.0], [[1.0, 0.5], [0.0, 1.0]])
    with refused(sv.errors.SpecificationError, "turns at 0.5 of its span", "smoothness=2", name="X"):
        sv.fastest(*mass(lambda q: q.references(X=corner).X), wanted, (0.0, 2.0), shape=True)
    windy = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, x), forces={"x": ca.sin(t)}, actuators={"push": x})
    still, again = sv.paths.polynomials([0.0, 2.0], [[1.0]]), sv.paths.polynomials(
        [0.0, 1.0, 2.0], [[1.0, -1.0], [0.0, 1.0]], before="periodic", after="periodic"
    )
    for path, advice in ((still, "Choose a span"), (again, "before='hold'")):
        with refused(sv.errors.SpecificationError, advice, name="X"):
            sv.fastest(*mass(lambda q, path=path: q.references(X=path).X), wanted, (0.0, 2.0), shape=True)
    with refused(sv.errors.SpecificationError, "Leave q.t and references out", name="the mechanism"):
        sv.fastest(windy, pushed[1], wanted, (0.0, 2.0), shape=True)
    with refused(sv.errors.SpecificationError, name="speed"):
        sv.fastest(
            *wheeled_robot(), {"steer": 0.5}, (0.0, 5.0), start=gallery["wheeled-robot"].start, guess={"v": 1.0}, shape=True
        )
    with refused(sv.errors.SpecificationError, "str", name="shape"):
        sv.fastest(*pushed, wanted, (0.0, 2.0), shape="yes")
    with refused(sv.errors.NameUnknown, name="pull"):
        sv.fastest(*pushed, {"pull": 3.0}, (0.0, 2.0), shape=True)


def test_a_curve_that_no_polynomials_fit_is_refused_without_tolerances(monkeypatch):
    monkeypatch.setattr("servoctl.control.time_optimal.FITTED", 1e-30)
    monkeypatch.setattr(sys.modules["servoctl.spec.paths.fit"], "FINEST", 100)
    bend = sv.paths.polynomials([0.0, 2.0], [[0.1], [0.5], [0.0]])
    with refused(sv.errors.SpecificationError, "The curve of X bends too sharply", "Make the path smoother") as caught:
        sv.fastest(*mass(lambda q: q.references(X=bend).X), {"push": 30.0}, (0.0, 2.0), shape=True)
    assert "tolerance" not in str(caught.value)


def test_limits_without_a_time_law_are_refused():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)), actuators={"fx": x, "fy": y})
    with refused(sv.errors.SpecificationError, factor=2.0**-12):
        sv.fastest(mechanism, sv.Program({"X": x - S7(q), "Y": y}), {"fy": 3.0}, (0.0, 5.0), shape=True)


def test_unstable_internal_dynamics_are_refused():
    aircraft, program = gallery["vtol-centre"].build()
    with refused(sv.errors.UnstableInternalDynamics, "minimum phase"):
        sv.fastest(aircraft, program, {"u1": (0.0, 500.0), "u2": (0.0, 500.0)}, (0.0, 4.0), shape=True)
