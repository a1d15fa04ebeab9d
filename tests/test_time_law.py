"""Programs slowed in time: the same path, and the fastest time law that limits allow."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scenes import POINT, POINT_PROGRAM
from scipy.optimize import brentq

import servoctl as sv
from servoctl.gallery import cars, gallery, overhead_crane, wheeled_robot

S13 = np.polynomial.Polynomial([0] * 7 + [1716, -9009, 20020, -24024, 16380, -6006, 924])


def largest_force(factor):
    """Of two cars (theory: F = 2y'''' + 3y'') when the path of 2 s takes `factor` times as long."""
    s, T = np.linspace(0, 1, 200_001), 2 * factor
    return np.max(2 * 2 * S13.deriv(4)(s) / T**4 + 3 * 2 * S13.deriv(2)(s) / T**2)


@pytest.mark.parametrize("limit", [200.0, 3000.0])
def test_two_cars_take_the_time_that_their_closed_form_takes(limit):
    law = sv.fastest(*cars(), {"force": limit}, (0.0, 2.0))
    assert law.factor == pytest.approx(brentq(lambda s: largest_force(s) - limit, 0.3, 3.0), rel=2e-6)
    assert limit * (1 - 3e-6) < np.abs(law.plan["force"]).max() * 1.0001 and law.binding[0] == "force"
    assert all(abs(value) <= limit for _, value in law.plan.extrema("force"))
    assert sv.verify(law.plan).passed


def test_slowed_rates_and_curvatures_leave_the_path_where_it_is():
    """A program of orders 1 and 2: residuals are written for the slowed jets."""
    mechanism, program = wheeled_robot()
    scene = gallery["wheeled-robot"]
    runs = []
    for factor in (1.0, 2.5):
        model = sv.derive(mechanism, program.slowed(mechanism.q, factor))
        start = model.start(**scene.start, guess={"v": 1.0 / factor})
        times = np.linspace(0.0, 5.0 * factor, 101)
        runs.append(sv.simulate(model, start, (0.0, times[-1]), t_eval=times))
    for name in ("x", "y", "psi"):
        assert np.abs(runs[0][name] - runs[1][name]).max() < 1e-7
    assert np.abs(runs[0]["v"] - 2.5 * runs[1]["v"]).max() < 1e-9
    assert np.abs(runs[0]["steer"] - 2.5**2 * runs[1]["steer"]).max() < 1e-6


def test_the_motions_tried_are_shown(capsys, monkeypatch):
    monkeypatch.setattr("servoctl.progress.PATIENCE", 0)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    sv.fastest(POINT, POINT_PROGRAM, {"force": 20.0}, (0.0, 1.0))
    printed = capsys.readouterr().err
    assert "fastest" in printed and "motions" in printed and "simulate" not in printed
    monkeypatch.setattr("sys.stderr.isatty", lambda: False, raising=False)
    sv.fastest(POINT, POINT_PROGRAM, {"force": 20.0}, (0.0, 1.0))
    assert not capsys.readouterr().err


def test_held_velocities_are_slowed_too():
    law = sv.fastest(
        *wheeled_robot(), {"steer": 0.5}, (0.0, 5.0), start=gallery["wheeled-robot"].start, guess={"v": 1.0}
    )
    assert law.factor == pytest.approx((0.925275 / 0.5) ** 0.5, rel=1e-4)


def test_a_limit_at_zero_is_a_limit():
    """A rope lifts a mass and does not push: the path's largest deceleration is g."""
    q = sv.coordinates("z")
    (z,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 3.0, z), potential=3.0 * 9.81 * z, actuators={"rope": z})
    program = sv.Program({"Z": z - q.references(Z=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=3)).Z})
    law = sv.fastest(mechanism, program, {"rope": (0.0, None)}, (0.0, 2.0))
    model = sv.derive(mechanism, program)
    (_, least), _ = sv.simulate(model, model.start(), (0.0, 2.0)).extrema("d2z")
    assert law.factor == pytest.approx(np.sqrt(-least / 9.81), rel=1e-5)
    assert law.binding[:2] == ("rope", "lower") and 0.0 <= law.plan.extrema("rope")[0][1] < 1e-3


def test_motions_that_cease_to_exist_before_a_limit_are_no_fastest_ones(monkeypatch):
    def simulated(model, start, span, **options):
        if span[1] < 1.5:
            raise sv.errors.IntegrationStopped("No motion is quicker than 1.5 s.")
        return sv.simulate(model, start, span, **options)

    monkeypatch.setattr("servoctl.control.time_law.simulated", simulated)
    with refused(sv.errors.LimitExceeded, factor=pytest.approx(0.75, abs=1e-4)):
        sv.fastest(*cars(), {"force": 3000.0}, (0.0, 2.0))


def test_weights_of_actuators_are_slowed_as_well():
    q = sv.coordinates("x")
    (x,), (dx,) = q, q.d(1)
    program = sv.Program({"X": x - q.t}, weights={"push": 1.0 + q.t + dx**2, "pull": 2.0})
    slower = program.slowed(q, 2.0, at=1.0)
    at = ca.Function("at", [q.t, dx], [slower.weights["push"]])
    assert float(at(3.0, 0.5)) == pytest.approx(1.0 + 2.0 + 1.0) and float(ca.SX(slower.weights["pull"])) == 2.0


def test_static_loads_beyond_the_limits_are_refused_with_the_numbers():
    with refused(sv.errors.LimitExceeded, "-981", name="hoist", factor=4096.0):
        sv.fastest(*overhead_crane(), {"hoist": (-900.0, 0.0)}, (0.0, 6.0), guess={"l": 4.0})


def test_bad_input():
    mechanism, program = cars()
    for factor in (0.0, -1.0, "fast", np.nan):
        with refused(sv.errors.SpecificationError, "factor"):
            program.slowed(mechanism.q, factor)
    for at in ("now", None, np.nan):
        with refused(sv.errors.SpecificationError, repr(at)):
            program.slowed(mechanism.q, 2.0, at=at)
    for limits, span, fact in (
        ({}, (0.0, 2.0), "limits"), (5.0, (0.0, 2.0), "limits"), ({"force": 200.0}, (2.0, 0.0), "(2.0, 0.0)")
    ):  # fmt: skip
        with refused(sv.errors.SpecificationError, fact):
            sv.fastest(mechanism, program, limits, span)
    for pair, kind in (((mechanism, "cars"), "Program"), (("cars", program), "Mechanism")):
        with refused(sv.errors.SpecificationError, "str", kind.lower()):
            sv.fastest(*pair, {"force": 200.0}, (0.0, 2.0))
    for given in ("start", "parameters"):
        with refused(sv.errors.SpecificationError, "[1.0]"):
            sv.fastest(mechanism, program, {"force": 200.0}, (0.0, 2.0), **{given: [1.0]})
    for limit in ((1.0, -1.0), (None, None), "1..2", np.nan):
        with refused(sv.errors.SpecificationError, name="force"):
            sv.fastest(mechanism, program, {"force": limit}, (0.0, 2.0))
    with refused(sv.errors.NameUnknown, name="forse", match="force"):
        sv.fastest(mechanism, program, {"forse": 1.0}, (0.0, 2.0))
