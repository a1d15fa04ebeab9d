"""Minimal coordinates: as many values are integrated as the program leaves free, and nothing drifts."""

import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import pendulum
from refusals import refused
from scipy.integrate import solve_ivp

import servoctl as sv
from servoctl.methods.choice import as_method
from servoctl.methods.minimal import Chart, Sizes

SCENES = (
    "appell-hamel", "constant-speed", "mass-on-car", "mass-on-car-absolute", "passive-arm", "spiral", "two-cars-ideal",
)  # fmt: skip
APPELL_HAMEL = {
    0.5: (0.0319727678, 0.2954591857, -0.0653856446, 0.3269282232, 0.9061260409, 0.2941642246, 1.6888475537),
    1.0: (-0.1974199455, 0.3336476801, -0.0577323796, 0.2886618981, 1.7454659644, -0.4458690776, 1.7226077945),
    2.0: (0.0937497219, -0.2692972364, 0.1619778260, -0.8098891302, 3.9504768171, -1.6103273411, 3.0406014808),
}  # x, y, z, phi, theta, dphi, dtheta
PRECISE = {"rtol": 1e-11, "atol": 1e-13}
SETTINGS = {
    "RK45": PRECISE, "DOP853": PRECISE, "Radau": PRECISE, "RK23": {"rtol": 1e-8, "atol": 1e-10},
    "RK4": {"step": 2e-3}, "RK5": {"step": 1e-2}, "RK8": {"step": 2.5e-2},
}  # fmt: skip
ROUNDING = 1e-11


def worst_residual(run):
    """Over all rows, levels and samples."""
    return max(float(np.abs(run.residual[name]).max()) for name in run.residual)


@pytest.mark.parametrize("method", SETTINGS)
def test_appell_hamel_in_six_values(method, wheel):
    model, start = wheel
    run = sv.simulate(model, start, (0.0, 2.0), method=as_method(method, **SETTINGS[method]), drift="minimal")
    assert run.drift == "minimal coordinates" and run.counters["integrated"] == 6
    names = ("x", "y", "z", "phi", "theta", "dphi", "dtheta")
    for t, state in APPELL_HAMEL.items():
        found = [dict(zip(run.jet_names, run.at(t), strict=True))[name] for name in names]
        assert found == pytest.approx(state, abs=2e-7 if method == "RK23" else 2e-9)
    assert worst_residual(run) < 1e-14


@pytest.mark.parametrize("method", ["DOP853", "RK4"])
def test_nothing_drifts_in_20_seconds(method, wheel):
    model, start = wheel
    options = {"step": 2e-2} if method == "RK4" else {"rtol": 1e-6, "atol": 1e-8}
    plain = sv.simulate(model, start, (0.0, 20.0), method=as_method(method, **options))
    minimal = sv.simulate(model, start, (0.0, 20.0), method=as_method(method, **options), drift="minimal")
    assert worst_residual(minimal) < ROUNDING < 1e-2 * worst_residual(plain)


@pytest.mark.parametrize("name", SCENES)
def test_as_many_values_are_integrated_as_are_free(name, gallery_model):
    from servoctl.gallery import gallery

    scene, model = gallery[name], gallery_model(name)
    start, t1 = model.start(**scene.start, guess=scene.guess), min(scene.t_span[1], 2.0)
    run = sv.simulate(model, start, (0.0, t1), method=sv.Adaptive("DOP853", **PRECISE), drift="minimal")
    assert run.counters["integrated"] == model.free < len(model.state_names)
    assert worst_residual(run) < ROUNDING
    reference = sv.simulate(model, start, (0.0, t1), method=sv.Taylor(rtol=1e-13, atol=1e-15), drift="project")
    scale = np.abs(reference.jets).max(axis=1, keepdims=True) + 1.0
    assert np.abs((run.jets - reference.jets) / scale).max() < 1e-7


def test_absolute_coordinates_need_the_same_force(gallery_model):
    forces = {}
    rest = {"mass-on-car": {"s": 0.0, "ds": 0.0}, "mass-on-car-absolute": {"y_m": 0.0, "dy_m": 0.0}}
    for name, held in rest.items():
        model = gallery_model(name)
        run = sv.simulate(model, model.start(**held), (0.0, 5.0), sv.Adaptive(**PRECISE), drift="minimal")
        assert run.counters["integrated"] == 2
        forces[name] = run["force"]
    one, other = forces.values()
    assert np.abs(one).max() > 1.0 and other == pytest.approx(one, abs=1e-8)


# local charts --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def satellite():
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    try:
        import quaternion
    finally:
        sys.path.pop(0)
    return sv.derive(quaternion.mechanism, quaternion.program)


@pytest.mark.parametrize("method", ["DOP853", "RK4", "Radau"])
def test_a_unit_quaternion_has_a_local_chart(method, satellite):
    start = satellite.start(w3=0.5, guess={"e0": 1.0})
    run = sv.simulate(
        satellite,
        start,
        (0.0, 10.0),
        method=as_method(method, **{"step": 1e-2} if method == "RK4" else PRECISE),
        drift="minimal",
    )
    assert run.counters["integrated"] == satellite.free == 2
    assert (
        run.counters["coordinate_changes"] + run.counters["pivot_changes"] >= 1
    )  # the spin turns by 5 rad, the quaternion by half of that
    assert worst_residual(run) < ROUNDING
    assert np.ptp(run["w3"]) < 1e-8
    angle = np.pi / 3 * np.polyval([6.0, -15.0, 10.0, 0.0, 0.0, 0.0], run.t / 10.0)
    axis = 2 * (run["e1"] * run["e3"] + run["e0"] * run["e2"])
    assert axis == pytest.approx(np.sin(angle), abs=ROUNDING)


@pytest.mark.parametrize(
    ("method", "metre"),
    [("DOP853", 1.0), ("RK45", 1.0), ("Radau", 1.0), ("RK8", 1.0), ("DOP853", 1e6), ("DOP853", 1e-6)],
)
def test_a_turning_pendulum_changes_its_coordinates(method, metre):
    model = pendulum(metre)
    start = model.start(x=0.0, y=-metre, dx=7.0 * metre)
    options = {"step": 1e-2} if method == "RK8" else {"rtol": 1e-11, "atol": 1e-13 * metre}
    run = sv.simulate(model, start, (0.0, 3.0), method=as_method(method, **options), drift="minimal")
    swing = solve_ivp(
        lambda t, z: [z[1], -9.81 * np.cos(z[0])], (0.0, 3.0), [-np.pi / 2, 7.0], method="DOP853", rtol=1e-13, atol=1e-14,
        dense_output=True,
    )  # fmt: skip
    angle = swing.sol(run.t)[0]
    assert angle[-1] > angle[0] + 2 * np.pi  # it goes over the top
    assert run.counters["integrated"] == model.free == 2
    assert 8 <= run.counters["coordinate_changes"] <= 12  # x for y and back: twice a turn each
    error = np.hypot(run["x"] / metre - np.cos(angle), run["y"] / metre - np.sin(angle)).max()
    assert error < 2e-6 if method == "RK8" else error < 2e-8
    assert np.abs(np.hypot(run["x"], run["y"]) / metre - 1.0).max() < 1e-14


def test_a_chart_has_the_exact_jacobian():
    model = pendulum()
    x = model.start(x=0.6, y=-0.8, guess={"dx": 2.0}).values
    chart = Chart(model, Sizes(model), 0.0, x)
    y, step = x[chart.free], 1e-6
    assert chart.lift(0.0, y, x) == pytest.approx(x, abs=1e-15)
    columns = []
    for k in range(len(y)):
        ahead, behind = (chart.rates(0.0, chart.lift(0.0, y + s * step * np.eye(len(y))[k], x)) for s in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    assert np.abs(np.array(columns)).max() > 1.0
    assert chart.jacobian(0.0, x) == pytest.approx(np.array(columns).T, abs=1e-7)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("bad", ["none", "beyond", "nan", "singular"])
def test_states_are_solved_together_as_one_by_one(bad):
    """x² + y² = 1 has no state with x beyond 1; where x = y = 0 the matrix to be solved is singular."""
    model = pendulum()
    start = model.start(x=0.6, y=-0.8, guess={"dx": 2.0}).values
    chart = Chart(model, Sizes(model), 0.0, start)
    y, near = np.outer(start[chart.free], np.linspace(-1.2, 1.2, 9)), np.repeat(start[:, None], 9, axis=1)
    y[0, 4], near[:, 4] = {
        "none": (0.3, start), "beyond": (1.5, start), "nan": (0.3, np.nan), "singular": (0.3, 0.0)
    }[bad]  # fmt: skip
    together = chart.lift_all(np.zeros(9), y, near)
    each = np.column_stack([chart.lift(0.0, y[:, i], near[:, i]) for i in range(9)])
    assert np.isnan(together).any(axis=0).tolist() == [i == 4 and bad != "none" for i in range(9)]
    assert together == pytest.approx(each, abs=1e-14, nan_ok=True)


def test_samples_and_inspected_instants_cost_no_solve_each(wheel, monkeypatch):
    model, start = wheel
    lift, calls = Chart.lift, []
    monkeypatch.setattr(Chart, "lift", lambda self, *given: calls.append(given[0]) or lift(self, *given))
    run = sv.simulate(model, start, (0.0, 2.0), "DOP853", drift="minimal")
    assert len(run.t) > 1000 and len(calls) <= run.counters["nfev"] + 3 * run.counters["steps"]


def test_time_runs_backwards(wheel):
    model, start = wheel
    there = sv.simulate(model, start, (0.0, 2.0), sv.Adaptive(**PRECISE), drift="minimal")
    n_x = len(model.state_names)
    back = sv.simulate(model, there.jets[:n_x, -1], (2.0, 0.0), sv.Adaptive(**PRECISE), drift="minimal")
    assert back.jets[:n_x, -1] == pytest.approx(start.values, abs=1e-8)


# where it does not go ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["RK23", "RK45", "DOP853", "Radau", "RK4", "RK8"])
def test_exact_constraints_do_not_carry_a_motion_through_a_singularity(method, gallery_model):
    model = gallery_model("appell-hamel-squared")
    start = model.start(guess={"dx": 0.5}, x=0.0, y=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=2.0)
    options = {"step": 1e-2} if method in ("RK4", "RK8") else {"rtol": 1e-8, "atol": 1e-10}
    with pytest.raises(sv.SingularProgram) as caught:
        sv.simulate(model, start, (0.0, 2.0), method=as_method(method, **options), drift="minimal")
    error = caught.value
    assert abs(error.details["t"] - 0.6983110523) < 5e-3
    assert "speed" in error.details["rows"] and "dphi" in error.details["zero"]
    assert np.all(np.diff(error.run.t) > 0) and error.run.t[-1] <= error.details["t"]
    forward = error.run["dx"] * np.cos(error.run["theta"]) + error.run["dy"] * np.sin(error.run["theta"])
    assert forward == pytest.approx(0.5 * error.run["dphi"], abs=1e-5)


@pytest.mark.parametrize("method", [None, "algebraic"])
def test_a_flat_program_leaves_nothing_to_integrate(method, gallery_model):
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(), (0.0, 6.0), method=method, drift="minimal")
    assert run.method == "algebraic" and run.drift == "minimal coordinates" and "integrated" not in run.counters
    plain = sv.simulate(model, model.start(), (0.0, 6.0))
    assert run.jets == pytest.approx(plain.jets, rel=1e-12, abs=1e-14)  # of CasADi, or of compiled code


def test_a_flat_program_is_not_integrated_in_minimal_coordinates(gallery_model):
    model = gallery_model("overhead-crane")
    with refused(sv.SpecificationError, "algebraic", free=0):
        sv.simulate(model, model.start(), (0.0, 6.0), method="DOP853", drift="minimal")


@pytest.mark.parametrize("method", ["Taylor", "BDF", "LSODA"])
def test_methods_that_cannot_are_refused(method, wheel):
    model, start = wheel
    with refused(sv.SpecificationError, method, "RK4", "DOP853") as caught:
        sv.simulate(model, start, (0.0, 1.0), method=method, drift="minimal")
    assert caught.value.details["methods"] == ["RK1", "RK2", "RK4", "RK5", "RK8", "RK23", "RK45", "DOP853", "Radau"]


def test_an_unknown_treatment_shows_the_nearest(wheel):
    model, start = wheel
    with refused(sv.NameUnknown, name="minimum", match="minimal"):
        sv.simulate(model, start, (0.0, 1.0), drift="minimum")


def test_a_state_that_is_lost_ends_the_motion(wheel, monkeypatch):
    model, start = wheel
    lift = Chart.lift

    def lost(self, t, y, near):
        return np.full(self.n_x, np.nan) if 0.5 < t < 0.6 else lift(self, t, y, near)

    monkeypatch.setattr(Chart, "lift", lost)
    with refused(sv.IntegrationStopped, "DOP853") as caught:
        sv.simulate(model, start, (0.0, 1.0), method="DOP853", drift="minimal")
    assert 0.3 < caught.value.run.t[-1] <= 0.5 + 1e-9


def test_without_invariants_everything_is_integrated():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=9.81 * y)
    ax, ay = q.d(2)
    model = sv.derive(mechanism, sv.Program({"lean": ax - ay - 9.81}, by="ideal"))
    run = sv.simulate(
        model, model.start(x=0.0, y=0.0, dx=1.0, dy=0.0), (0.0, 1.0), method=sv.RungeKutta(4, step=0.1), drift="minimal"
    )
    assert run.counters["integrated"] == 4
    assert run["x"][-1] == pytest.approx(1.0, abs=1e-12) and run["y"][-1] == pytest.approx(-4.905, abs=1e-12)
