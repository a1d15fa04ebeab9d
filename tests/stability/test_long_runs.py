"""A million steps, a thousand seconds, time reversed, starts off the constraints."""

import closed_forms as cf
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.methods.choice import as_method

START = {"x": 0.0, "y": 0.0, "z": 0.0, "phi": 0.0, "theta": 0.0, "dphi": 1.0, "dtheta": 2.0}


def integral(run, p=cf.APPELL_HAMEL):
    """H = maρφ'²/(2B) + maρθ'²/(2A) - (bmg/A) ln θ', with which φ' and θ' are periodic."""
    A = p["I_y"] + p["a"] ** 2 * (p["M"] + p["m"]) + p["b"] ** 2 * p["m"]
    B = p["I_x"] + p["m"] * p["rho"] ** 2
    k = p["m"] * p["a"] * p["rho"]
    falling = p["b"] * p["m"] * p["g"] / A * np.log(run["dtheta"])
    return k * run["dphi"] ** 2 / (2 * B) + k * run["dtheta"] ** 2 / (2 * A) - falling


def varies(values):
    return np.abs(values - values[0]).max() / np.abs(values[0])


def test_a_thousand_seconds_keep_energy_and_the_second_integral(wheel):
    model, start = wheel
    run = sv.simulate(model, start, (0.0, 1000.0), method=sv.methods.Taylor(rtol=1e-14, atol=1e-16), drift="project")
    assert varies(run["energy"]) < 1e-9 and varies(integral(run)) < 1e-9
    assert max(np.abs(run.residual[name]).max() for name in run.residual) < 1e-9
    assert run["dtheta"].min() > 0 and np.ptp(run["dphi"]) > 1.0  # periodic, not at rest


def test_phi_and_theta_rates_return_after_hundreds_of_periods(wheel):
    """The period, from the first crossings of φ' = 0 upwards, still holds at the end."""
    model, start = wheel
    t = np.append(np.linspace(0.0, 20.0, 4001), np.linspace(980.0, 1000.0, 4001))
    run = sv.simulate(model, start, (0.0, 1000.0), method=sv.methods.Taylor(rtol=1e-14, atol=1e-16), drift="project", t_eval=t)
    crossings = [
        run.t[i] - run["dphi"][i] * (run.t[i + 1] - run.t[i]) / (run["dphi"][i + 1] - run["dphi"][i])
        for i in np.flatnonzero((run["dphi"][:-1] < 0) & (run["dphi"][1:] >= 0))
        if run.t[i + 1] - run.t[i] < 0.01
    ]
    early, late = ([c for c in crossings if (c < 100) == first] for first in (True, False))
    period = np.mean(np.diff(early))
    assert len(early) > 3 and np.ptp(np.diff(early)) < 1e-4
    assert np.mean(np.diff(late)) == pytest.approx(period, abs=1e-4)


@pytest.mark.parametrize(("drift", "most"), [(None, 1e-9), ("project", 1e-12)])
def test_a_million_fixed_steps(drift, most, wheel):
    model, start = wheel
    t = np.linspace(0.0, 100.0, 101)
    run = sv.simulate(model, start, (0.0, 100.0), method=sv.methods.RungeKutta(4, step=1e-4), drift=drift, t_eval=t)
    assert run.counters["steps"] == 1_000_000
    levels = {name: np.abs(run.residual[name]).max(axis=1) for name in run.residual}
    assert {name: len(level) for name, level in levels.items()} == {"x_c": 2, "y_c": 2, "string": 3}
    assert all(np.all(np.isfinite(level)) and level.max() < most for level in levels.values())
    assert varies(run["energy"]) < 1e-9 and varies(integral(run)) < 1e-9


@pytest.mark.parametrize(("method", "drift"), [("DOP853", "project"), ("Radau", None), ("RK8", "project")])
def test_there_and_back(method, drift, wheel):
    model, start = wheel
    options = {"step": 1e-2} if method == "RK8" else {"rtol": 1e-10, "atol": 1e-12}
    there = sv.simulate(model, start, (0.0, 3.0), method=as_method(method, **options), drift=drift)
    end = there.jets[: len(model.state_names), -1]
    back = sv.simulate(model, end, (3.0, 0.0), method=as_method(method, **options), drift=drift)
    assert back.t[-1] == 0.0
    assert back.jets[: len(model.state_names), -1] == pytest.approx(start.values, abs=1e-7)


# starts off the constraints ------------------------------------------------------------------------------------------


@pytest.fixture
def off(wheel):
    model, start = wheel
    return model, start.values + 1e-3 * np.array([name.startswith("d") for name in model.state_names])


@pytest.mark.parametrize("method", ["DOP853", "RK4"])
def test_a_start_off_the_constraints_is_refused(method, off):
    with refused(sv.errors.InconsistentStart, invariant="D(string)") as caught:
        sv.simulate(*off, (0.0, 2.0), method=method)
    assert caught.value.details["residual"] == pytest.approx(1.2e-3, rel=1e-6)  # z' + b φ'


@pytest.mark.parametrize("drift", ["project", 0.05])
@pytest.mark.parametrize("method", ["DOP853", "RK4"])
def test_treatments_lead_back_to_the_constraints(method, drift, off):
    run = sv.simulate(*off, (0.0, 2.0), method=method, drift=drift)
    at_start = np.abs(run.residual["string"][1, 0])  # projection begins with the start
    assert at_start < 1e-15 if drift == "project" else at_start > 1e-3
    late = run.t > 1.5  # 30 time constants
    assert max(np.abs(run.residual[name][:, late]).max() for name in run.residual) < 1e-7


def test_a_start_of_other_parameters_is_refused(wheel):
    model, start = wheel
    with refused(sv.errors.InconsistentStart, "model.start", invariant="D(string)"):
        sv.simulate(model.with_parameters(b=0.3), start, (0.0, 1.0))


def test_rounding_of_a_long_run_is_no_reason_to_refuse_its_end(wheel):
    model, start = wheel
    run = sv.simulate(model, start, (0.0, 20.0), method=sv.methods.RungeKutta(4, step=1e-2))
    off = max(np.abs(run.residual[name][:, -1]).max() for name in run.residual)
    again = sv.simulate(model, run.jets[: len(model.state_names), -1], (20.0, 21.0))
    assert off > 1e-10 and again.success
