"""Orders of methods, tolerance ladders, work, drift over long times, reversed time, interruption, files."""

import zipfile
from functools import cache

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from conftest import needs
from refusals import refused, warned
from scipy.integrate import solve_ivp

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.methods.choice import as_method
from servoctl.progress import Progress

AMPLITUDE = 1.0  # rad
STATE = ("x", "y", "z", "phi", "theta", "dphi", "dtheta")


def held_cart(coordinates):
    """A pendulum on a cart that is held: in an angle, or in Cartesian coordinates with a material rod."""
    p = sv.parameters(M=2.0, m=1.0, l=1.0, g=9.81)
    q = sv.coordinates({"angle": "s theta", "cartesian": "s x y"}[coordinates])
    s, *rest = q
    bob = ca.vertcat(*rest)
    if coordinates == "angle":
        bob = ca.vertcat(s + p.l * ca.sin(rest[0]), -p.l * ca.cos(rest[0]))
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.M, s) + sv.particle(q, p.m, bob),
        potential=p.m * p.g * bob[1],
        actuators={"force": s},
        constraints={"rod": (rest[0] - s) ** 2 + rest[1] ** 2 - p.l**2} if coordinates == "cartesian" else {},
        parameters=p,
    )
    return sv.derive(mechanism, sv.Program({"cart": s}))


@cache
def swing(t):
    """(theta, theta') of the pendulum, far below the tests' tolerances."""
    return solve_ivp(
        lambda _, z: [z[1], -9.81 * np.sin(z[0])], (0.0, t), [AMPLITUDE, 0.0], method="DOP853", rtol=3e-14, atol=1e-15
    ).y[:, -1]


class Case:
    """A model, its start, and the error of a run at its end."""

    def __init__(self, model, start, error):
        self.model, self.start, self.error = model, start, error

    def run(self, method, t_span=(0.0, 2.0), drift=None, t_eval=None, **settings):
        return sv.simulate(self.model, self.start, t_span, as_method(method, **settings), drift=drift, t_eval=t_eval)


@pytest.fixture(scope="module")
def case(gallery_model):
    def appell_hamel_error(run):
        reference = cf.appell_hamel(run.t[-1])
        return max(abs(run[name][-1] - reference[name][0]) for name in STATE)

    def pendulum_error(run):
        return np.abs([run["theta"][-1], run["dtheta"][-1]] - swing(run.t[-1])).max()

    appell_hamel, pendulum = gallery_model("appell-hamel"), held_cart("angle")
    return {
        "appell-hamel": Case(
            appell_hamel,
            appell_hamel.start(x=0.0, y=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=2.0),
            appell_hamel_error,
        ),
        "pendulum": Case(pendulum, pendulum.start(s=0.0, ds=0.0, theta=AMPLITUDE, dtheta=0.0), pendulum_error),
    }


@pytest.fixture(scope="module")
def rod():
    """The Cartesian pendulum in a swing that needs no change of pivots."""
    model = held_cart("cartesian")
    return model, model.start(s=0.0, ds=0.0, x=0.8, y=-0.6, dx=0.0)


# orders, ladders, work -----------------------------------------------------------------------------------------------

STEPS = {
    "RK4": (25, 50, 100, 200),
    "RK8": (10, 15, 20, 30),
}


@pytest.mark.parametrize("method", STEPS)
@pytest.mark.parametrize("name", ["appell-hamel", "pendulum"])
def test_fixed_step_methods_have_their_order(name, method, case):
    errors = [case[name].error(case[name].run(method, step=2.0 / n)) for n in STEPS[method]]
    slope = -np.polyfit(np.log(STEPS[method]), np.log(errors), 1)[0]
    order = int(method[2:])
    assert abs(slope - order) < {4: 0.15, 8: 0.6}[order]


@pytest.mark.parametrize("method", ["DOP853", "Radau", "RK45"])
@pytest.mark.parametrize("name", ["appell-hamel", "pendulum"])
def test_tolerance_ladders_are_monotone(name, method, case):
    rungs = [1e-4, 1e-6, 1e-8, 1e-10]
    runs = [case[name].run(method, rtol=rtol, atol=1e-2 * rtol, t_eval=[0.0, 2.0]) for rtol in rungs]
    errors = [case[name].error(run) for run in runs]
    assert all(fine < 0.5 * coarse for coarse, fine in zip(errors[:-1], errors[1:], strict=True))
    assert errors[-1] < {"RK45": 1e-9}.get(method, 5e-11)
    work = [run.counters["nfev"] for run in runs]
    assert all(fine > coarse for coarse, fine in zip(work[:-1], work[1:], strict=True))


@pytest.mark.parametrize("order", [8, 14, 20])
def test_series_reach_rounding_at_any_order(order, case):
    run = case["appell-hamel"].run("Taylor", order=order, rtol=1e-13, atol=1e-15)
    assert case["appell-hamel"].error(run) < 1e-11


CEILINGS = {  # evaluations for 2 s at rtol = 1e-9; measured, and a quarter more
    "appell-hamel": {"RK45": 500, "DOP853": 240, "Radau": 2800, "LSODA": 240, "Taylor": 15},
    "pendulum": {"RK45": 800, "DOP853": 490, "Radau": 2800, "LSODA": 370, "Taylor": 27},
}


@pytest.mark.parametrize(("name", "method"), [(name, method) for name in CEILINGS for method in CEILINGS[name]])
def test_evaluations_at_1e_9(name, method, case):
    run = case[name].run(method, rtol=1e-9, t_eval=[0.0, 2.0])
    assert 0 < run.counters["nfev"] <= CEILINGS[name][method]
    assert case[name].error(run) < 1e-6
    if method == "Radau":
        assert run.counters["njev"] > 0 and run.counters["nlu"] > 0


def test_flat_plans_take_few_newton_steps(gallery_model):
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0))
    assert run.counters["iterations"] <= 6 * len(run.t)
    assert run.counters.get("nfev", 0) == 0


def test_samples_do_not_change_the_work(case):
    few = case["pendulum"].run("DOP853", t_eval=[0.0, 2.0])
    many = case["pendulum"].run("DOP853", t_eval=np.linspace(0.0, 2.0, 777))
    assert few.counters["nfev"] == many.counters["nfev"]
    assert few["theta"][-1] == many["theta"][-1]


# drift ---------------------------------------------------------------------------------------------------------------


def by_quarters(run, name="rod"):
    """The largest residual of position and velocity in each quarter of a run."""
    residual, ends = np.abs(run.residual[name][:2]), np.linspace(run.t[0], run.t[-1], 5)
    return [residual[:, (run.t >= a) & (run.t <= b)].max() for a, b in zip(ends[:-1], ends[1:], strict=True)]


@pytest.mark.parametrize("method", ["DOP853", "Radau", "RK4"])
def test_projection_leaves_no_residual(method, rod):
    options = {"step": 2e-3} if method == "RK4" else {"rtol": 1e-8}
    run = sv.simulate(*rod, (0.0, 20.0), method=as_method(method, **options), drift="project")
    assert max(by_quarters(run)) <= 1e-11 and run.counters["projections"] > 0
    assert np.abs(run.residual["rod"]).max() <= 1e-11  # at the level of accelerations too
    assert np.abs(run["energy"] - run["energy"][0]).max() < 1e-4


def test_projection_of_every_tenth_step_is_enough(rod):
    often, seldom = (
        sv.simulate(*rod, (0.0, 20.0), method=sv.methods.RungeKutta(4, step=2e-3), drift=sv.methods.Project(every)) for every in (1, 10)
    )
    assert seldom.counters["projections"] == pytest.approx(often.counters["projections"] / 10, abs=2)
    assert max(by_quarters(seldom)) < 1e-9


@pytest.mark.parametrize("method", ["DOP853", "RK4", "LSODA"])
def test_error_dynamics_bound_the_residual(method, rod):
    options = {"step": 2e-3} if method == "RK4" else {"rtol": 1e-9}
    free = by_quarters(sv.simulate(*rod, (0.0, 20.0), method=as_method(method, **options)))
    held = by_quarters(sv.simulate(*rod, (0.0, 20.0), method=as_method(method, **options), drift=0.5))
    assert free[-1] > 3 * free[0]  # without treatment it grows
    assert max(held[1:]) < 3 * held[0] and held[-1] < 0.5 * free[-1]


@pytest.mark.parametrize("method", ["DOP853", "RK4"])
def test_the_string_of_the_appell_hamel_mechanism_keeps_its_length(method, case):
    for drift in (None, "project", 0.2):
        run = case["appell-hamel"].run(method, (0.0, 20.0), drift=drift)
        residual = max(np.abs(values).max() for values in run.residual.values())
        assert residual <= (1e-11 if drift == "project" else 1e-6)


@cache
def tracking(rho):
    """x follows sin t through ρ derivatives."""
    q = sv.coordinates("x y")
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, ca.vertcat(*q)))
    return sv.derive(mechanism, sv.Program({"x": q.d(0)[0] - ca.sin(q.t), "y": q.d(rho)[1]}, by="ideal"))


def tracking_error(rho, drift):
    model = tracking(rho)
    start = model.start(**{name: 0.0 for name in model.state_names if name.endswith("y")})
    run = sv.simulate(model, start, (0.0, 100.0), method=sv.methods.RungeKutta(4, step=0.05), drift=drift)
    return np.abs(run["x"] - np.sin(run.t)).max()


@pytest.mark.parametrize(("rho", "without", "by_poles"), [(2, 2.2e-7, 2.3e-6), (4, 3.6e-4, 2.1e-7)])
def test_poles_cost_accuracy_at_low_order_and_save_it_at_high_order(rho, without, by_poles):
    assert tracking_error(rho, None) == pytest.approx(without, rel=0.05)
    assert tracking_error(rho, sv.methods.Poles({"x": [-5.0] * rho})) == pytest.approx(by_poles, rel=0.05)
    assert tracking_error(rho, "project") < 1e-12


def test_poles_beyond_the_stability_of_rk4_diverge():
    assert tracking_error(2, sv.methods.Poles({"x": [-40.0] * 2})) < 1e-3  # |λ h| = 2 < 2.785
    with np.errstate(all="ignore"), warned("'x'", "-60 1/s", "0.04642 s"):
        try:
            error = tracking_error(2, sv.methods.Poles({"x": [-60.0] * 2}))
        except sv.errors.IntegrationStopped:
            error = np.inf
    assert error > 1.0


@pytest.mark.parametrize(
    ("values", "error", "fact"),
    [
        ({"rod": [-1.0]}, sv.errors.SpecificationError, {"row": "rod", "count": 2}),
        ({"rod": [-1.0, -2.0, -3.0]}, sv.errors.SpecificationError, {"row": "rod", "count": 2}),
        ({"rod": [-1.0 + 1.0j, -1.0 + 1.0j]}, sv.errors.SpecificationError, "rod"),
        ({"rood": [-1.0, -2.0]}, sv.errors.NameUnknown, {"match": "rod"}),
    ],
)
def test_wrong_poles_are_refused(values, error, fact, rod):
    with refused(error, fact):
        sv.simulate(*rod, (0.0, 1.0), drift=sv.methods.Poles(values))


def test_poles_per_row(rod):
    model, start = rod
    assert model.reduction.raised["rod"] == 2 and model.reduction.raised["cart"] == 2
    run = sv.simulate(model, start, (0.0, 5.0), drift=sv.methods.Poles({"rod": [-3.0 + 1.0j, -3.0 - 1.0j]}))
    assert run.success and "rod" in run.drift
    assert max(by_quarters(run)) < 1e-6


# time, interruption, files -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["DOP853", "Radau", "LSODA", "Taylor", "RK4"])
@pytest.mark.parametrize("name", ["appell-hamel", "pendulum"])
def test_time_runs_backwards(name, method, case):
    options = {} if method == "RK4" else {"rtol": 1e-11, "atol": 1e-13}
    there = case[name].run(method, **options)
    start = case[name].start.values
    back = sv.simulate(case[name].model, there.jets[: len(start), -1], (2.0, 0.0), method=as_method(method, **options))
    assert back.success and back.t[0] == 2.0 and back.t[-1] == 0.0
    assert back.jets[: len(start), -1] == pytest.approx(start, abs=1e-7)


def test_a_flat_plan_runs_backwards(gallery_model):
    model = gallery_model("winch-crane")
    forward = sv.simulate(model, model.start(guess={"beta": 40.0}), (0.0, 6.0))
    end = model.start(t=6.0, guess={"beta": 50.0, "x": 1.0})
    back = sv.simulate(model, end, (6.0, 0.0))
    assert back["trolley"][::-1] == pytest.approx(forward["trolley"], abs=1e-9)
    assert [value for _, value in back.extrema("winch")] == pytest.approx(
        [value for _, value in forward.extrema("winch")], rel=1e-10
    )


@pytest.mark.parametrize(
    ("method", "options"), [("DOP853", {}), ("RK4", {"step": 1e-4}), ("LSODA", {}), ("Taylor", {"order": 4})]
)
def test_ctrl_c_keeps_what_was_computed(method, options, case, monkeypatch):
    def interrupt(progress, t):
        if t > 1.0:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "__call__", interrupt)
    run = case["pendulum"].run(method, (0.0, 20.0), **options)
    assert not run.success and run.status == 1 and "interrupted" in run.message and "kept" in run.message
    assert 0.9 < run.t[-1] < 4.0 and len(run.t) > 20
    assert np.all(np.isfinite(run.jets)) and np.all(np.isfinite(run["force"]))
    assert run["dtheta"][-1] == pytest.approx(swing(float(run.t[-1]))[1], abs=1e-5)


def test_ctrl_c_keeps_a_flat_plan(gallery_model, monkeypatch):
    def interrupt(progress, t):
        if t > 2.0:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "__call__", interrupt)
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0), t_eval=np.linspace(0, 8, 4001))
    assert not run.success and run.status == 1 and 1.5 < run.t[-1] < 8.0
    assert run["hoist"] == pytest.approx(cf.overhead_crane(run.t)["hoist"], rel=1e-9)


def test_ctrl_c_before_the_first_step_keeps_the_start(case, monkeypatch):
    def interrupt(progress, t):
        raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "__call__", interrupt)
    run = case["pendulum"].run("DOP853")
    assert run.status == 1 and run.t[0] == 0.0 and run["theta"][0] == AMPLITUDE


@pytest.mark.parametrize("name", ["overhead-crane", "appell-hamel", "spiral"])
def test_runs_are_saved_and_loaded_without_pickle(name, gallery_model, tmp_path):
    model, scene = gallery_model(name), gallery[name]
    t1 = 0.25 * scene.t_span[1]
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), (0.0, t1), t_eval=np.linspace(0, t1, 11))
    path = run.save(tmp_path / "sub" / "plan")
    assert path.suffix == ".npz" and path.exists()
    with np.load(path, allow_pickle=False) as data:
        assert all(data[key].dtype != object for key in data.files)
    assert zipfile.is_zipfile(path)
    again = sv.load(path)
    assert set(run.names) == set(again.names) and list(run.residual) == list(again.residual)
    for signal in run.names:
        np.testing.assert_array_equal(again[signal], run[signal])
    for row in run.residual:
        np.testing.assert_array_equal(again.residual[row], run.residual[row])
    for key in ("method", "drift", "message", "success", "status", "counters", "jet_names"):
        assert getattr(again, key) == getattr(run, key)
    assert tuple(again.knots) == tuple(run.knots)
    first = next(iter(again.names))
    assert [value for _, value in again.extrema(first)] == [run[first].min(), run[first].max()]
    assert repr(again).splitlines()[0] == repr(run).splitlines()[0]


def test_a_stopped_run_is_saved_too(gallery_model, tmp_path):
    model, scene = gallery_model("appell-hamel-squared"), gallery["appell-hamel-squared"]
    with pytest.raises(sv.errors.SingularProgram) as caught:
        sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)
    again = sv.load(caught.value.run.save(tmp_path / "stopped.npz"))
    assert not again.success and again.status == -1 and "speed" in again.message


def test_runs_become_datasets(gallery_model):
    needs("xarray")
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0), t_eval=np.linspace(0, 8, 21))
    data = run.to_xarray()
    assert list(data.t.values) == list(run.t)
    for name in ("x", "dtheta", "trolley", "tension", "energy"):
        np.testing.assert_array_equal(data[name].values, run[name])
    assert data["residual_X"].shape == run.residual["X"].shape
    assert float(data["trolley"].sel(t=2.0, method="nearest")) == run["trolley"][np.argmin(np.abs(run.t - 2.0))]
    assert data.attrs["method"] == run.method
