"""Motions that end where a program is singular, motions that must not, and pivots that change on the way."""

import contextlib

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from refusals import refused, warned
from scenes import KINDS
from scipy.integrate import solve_ivp

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.methods.choice import as_method

ADAPTIVE = ("RK45", "DOP853", "Radau", "LSODA", "Taylor")
FIXED = ("RK4", "RK8")
METHODS = (*ADAPTIVE, *FIXED)
MULTISTEP = ("LSODA",)  # carries past states, so that projection is refused
ZERO = {"x": 0.0, "y": 0.0, "phi": 0.0, "theta": 0.0, "dtheta": 2.0}
BACKWARDS_STOPS = 1.6956635129  # s: where the wheel stops when it starts with φ' = -1
REFERENCE = {"rtol": 1e-13, "atol": 1e-14, "method": "DOP853", "dense_output": True}


def tolerances(method, rtol=1e-8, step=1e-3):
    return {"step": step} if method in FIXED else {"rtol": rtol, "atol": 1e-2 * rtol}


def drifts(method):
    return (None,) if method in MULTISTEP else (None, "project")


def cases(*values):
    return [(method, drift, value) for method in METHODS for drift in drifts(method) for value in values]


@pytest.fixture(scope="module")
def squared(gallery_model):
    return gallery_model("appell-hamel-squared")


@pytest.fixture(scope="module")
def on_the_right_branch(squared):
    return squared.start(guess={"dx": 0.5}, dphi=1.0, **ZERO)


def stopped(model, start, t_span, method, drift=None, **settings):
    """The error by which a simulation ends."""
    with pytest.raises(sv.errors.SingularProgram) as caught:
        sv.simulate(model, start, t_span, as_method(method, **settings), drift=drift)
    return caught.value


# the squared Appell-Hamel program ------------------------------------------------------------------------------------


def assert_told(error, at, within):
    """The error tells when the wheel stops, the row, φ' = 0 and a direction, and keeps the right branch before."""
    assert abs(error.details["t"] - at) < within
    assert "speed" in error.details["rows"] and "'speed'" in str(error)
    assert "dphi" in error.details["zero"] and "dphi = 0" in str(error)
    assert error.details["measure"] < 0.03 and error.details["direction"]
    run = error.run
    assert not run.success and run.status == -1 and "speed" in run.message
    assert at - within - 0.1 < run.t[-1] <= error.details["t"] + 1e-9
    forward = run["dx"] * np.cos(run["theta"]) + run["dy"] * np.sin(run["theta"])
    assert np.all(np.isfinite(run.jets))
    before = run.t < at - 0.01
    assert np.all(np.sign(forward[before]) == np.sign(run["dphi"][before]))
    assert np.abs(forward - 0.5 * run["dphi"])[before].max() < 0.05


@pytest.mark.parametrize(
    ("method", "drift", "rtol"),
    [*((m, d, 1e-8) for m in ADAPTIVE for d in drifts(m)), ("RK45", None, 1e-6), ("DOP853", None, 1e-10)],
)
def test_adaptive_methods_stop_when_the_wheel_stops(method, drift, rtol, squared, on_the_right_branch):
    error = stopped(squared, on_the_right_branch, (0.0, 2.0), method=method, drift=drift, rtol=rtol)
    assert_told(error, cf.WHEEL_STOPS, 1e-3)


@pytest.mark.parametrize("step", [1e-2, 3e-3, 1e-3, 1e-4])
@pytest.mark.parametrize("drift", [None, "project"])
def test_rk4_stops_when_the_wheel_stops(drift, step, squared, on_the_right_branch):
    error = stopped(squared, on_the_right_branch, (0.0, 2.0), method="RK4", drift=drift, step=step)
    assert_told(error, cf.WHEEL_STOPS, max(1e-3, step))


def test_another_fixed_step_method_stops_when_the_wheel_stops(squared, on_the_right_branch):
    error = stopped(squared, on_the_right_branch, (0.0, 2.0), method="RK8", step=1e-3)
    assert_told(error, cf.WHEEL_STOPS, 1e-3)


@pytest.mark.parametrize("method", ["DOP853", "Radau", "RK4"])
def test_error_dynamics_do_not_carry_a_motion_through(method, squared, on_the_right_branch):
    error = stopped(squared, on_the_right_branch, (0.0, 2.0), method=method, drift=0.1, **tolerances(method))
    assert_told(error, cf.WHEEL_STOPS, 2e-3)


@pytest.mark.parametrize("method", METHODS)
def test_the_linear_program_passes(method, gallery_model):
    model = gallery_model("appell-hamel")
    run = sv.simulate(model, model.start(dphi=1.0, **ZERO), (0.0, 2.0), method=as_method(method, **tolerances(method)))
    assert run.success and run.t[-1] == 2.0
    assert run["dphi"][-1] == pytest.approx(cf.APPELL_HAMEL_STATES[2.0][5], abs=1e-6)


@pytest.mark.parametrize("method", ["DOP853", "LSODA", "Taylor", "RK4"])
def test_a_wheel_that_starts_backwards_stops_later(method, squared):
    start = squared.start(guess={"dx": -0.5}, dphi=-1.0, **ZERO)
    run = sv.simulate(squared, start, (0.0, 1.0), method=as_method(method, **tolerances(method)))
    assert run.success
    error = stopped(squared, start, (0.0, 2.5), method=method, **tolerances(method))
    assert_told(error, BACKWARDS_STOPS, 1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_a_fast_wheel_does_not_stop(method, squared):
    start = squared.start(guess={"dx": 7.5}, dphi=15.0, **ZERO)
    run = sv.simulate(squared, start, (0.0, 2.0), method=as_method(method, **tolerances(method)))
    reference = cf.appell_hamel(run.t[[-1]], dphi=15.0)
    assert run.success
    assert run["dphi"][-1] == pytest.approx(reference["dphi"][0], abs=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_a_start_where_the_wheel_stands_is_refused(method, squared):
    with refused(sv.errors.SingularProgram, "speed", "dphi"):
        start = squared.start(guess={"dx": 0.0}, dphi=0.0, **ZERO)
        sv.simulate(squared, start, (0.0, 0.5), method=as_method(method, **tolerances(method)))


# constant speed ------------------------------------------------------------------------------------------------------


def test_constant_speed_follows_its_closed_form(gallery_model):
    model, scene = gallery_model("constant-speed"), gallery["constant-speed"]
    start = model.start(**scene.start, guess=scene.guess)
    run = sv.simulate(model, start, (0.0, 1.0), sv.methods.Adaptive(rtol=1e-12, atol=1e-13))
    reference = cf.constant_speed(run.t)
    for name in ("x", "y", "dx", "dy"):
        assert np.max(np.abs(run[name] - reference[name])) < 1e-9
    assert np.max(np.abs(np.hypot(run["dx"], run["dy"]) - 5.0)) < 1e-9


@pytest.mark.parametrize(("method", "drift", "rtol"), cases(1e-8))
def test_a_horizontal_force_ends_with_the_fall(method, drift, rtol, gallery_model):
    model, scene = gallery_model("constant-speed-horizontal"), gallery["constant-speed-horizontal"]
    start = model.start(**scene.start, guess=scene.guess)
    error = stopped(model, start, (0.0, 1.0), method=method, drift=drift, **tolerances(method, rtol))
    within = 2e-3 if method in FIXED else 1e-3
    assert abs(error.details["t"] - 5.0 / cf.GRAVITY) < within
    assert "dx" in error.details["zero"] and "dx = 0" in str(error)
    assert "'speed'" in str(error)  # the row that loses its hold on the actuator
    run = error.run
    early = run.t < 0.45
    assert run.t[-1] > 0.45 and run["thrust"][-1] < 2 * run["thrust"][early].min() < 0  # it grows without bound
    assert run["thrust"][early] == pytest.approx(cf.constant_speed_horizontal(run.t[early])["thrust"], rel=1e-4)


# no false alarms -----------------------------------------------------------------------------------------------------

SINGULAR = ("appell-hamel-squared", "constant-speed-horizontal")


@pytest.mark.parametrize(
    ("name", "method"),
    [
        *((name, method) for name in KINDS if name not in SINGULAR for method in ("DOP853", "Taylor")),
        *(("mass-on-car", method) for method in ("RK45", "Radau", "LSODA", "RK4")),
    ],
)
@pytest.mark.usefixtures("uncompiled")
def test_no_false_alarm(name, method, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    start = model.start(**scene.start, guess=scene.guess)
    t0, t1 = scene.t_span
    span = (t0, t1 if method in ("DOP853", "Taylor", "RK4") else t0 + 0.2 * (t1 - t0))
    step = {"step": (t1 - t0) / 500} if method == "RK4" else {"rtol": 1e-6, "atol": 1e-8}
    order = {"order": 8} if method == "Taylor" else {}
    with warned("unstable") if name == "vtol-centre" else contextlib.nullcontext():
        run = sv.simulate(model, start, span, method=as_method(method, **step, **order), t_eval=np.linspace(*span, 11))
    assert run.success and run.t[-1] == span[1]
    assert np.all(np.isfinite(run.jets))


# pivots that change --------------------------------------------------------------------------------------------------


def on_a_circle(kind):
    """A particle kept on the unit circle, by its equation or by its curvature."""
    p, q = sv.parameters(m=2.0), sv.coordinates("x y")
    (x, y), (dx, dy), (ddx, ddy) = q, q.d(1), q.d(2)
    residual = {
        "equation": x**2 + y**2 - 1,
        "curvature": (dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5 - 1,
    }[kind]
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, ca.vertcat(x, y)), parameters=p)
    return sv.derive(mechanism, sv.Program({"circle": residual}, by="ideal"))


def pendulum_on_a_cart():
    """A pendulum in Cartesian coordinates, its rod a material constraint, on a cart that is held."""
    p, q = sv.parameters(M=2.0, m=1.0, l=1.0, g=9.81), sv.coordinates("s x y")
    s, x, y = q
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.M, s) + sv.particle(q, p.m, ca.vertcat(x, y)),
        potential=p.m * p.g * y,
        actuators={"force": s},
        constraints={"rod": (x - s) ** 2 + y**2 - p.l**2},
        parameters=p,
    )
    return sv.derive(mechanism, sv.Program({"cart": s}))


def driven_pendulum():
    """A pendulum turned at a constant rate by a torque; every instant of a turn needs other pivots."""
    p, q = sv.parameters(m=1.0, l=1.0, g=9.81, rate=2.0), sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m, ca.vertcat(x, y)),
        potential=p.m * p.g * y,
        actuators={"torque": ca.vertcat(-y, x) / p.l**2},
        constraints={"rod": x**2 + y**2 - p.l**2},
        parameters=p,
    )
    return sv.derive(mechanism, sv.Program({"turn": x * dy - y * dx - p.rate * p.l**2}))


@pytest.fixture(scope="module")
def derived():
    """Models of this module by name, each derived once."""
    models = {}

    def model(make, *arguments):
        if (make, arguments) not in models:
            models[make, arguments] = make(*arguments)
        return models[make, arguments]

    return model


def precise(method):
    return {"step": 2e-3} if method in FIXED else {"rtol": 1e-11, "atol": 1e-13}


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        *(("equation", method) for method in ("DOP853", "LSODA", "Taylor")),
        *(("curvature", method) for method in ("Radau", "RK8")),
    ],
)
def test_a_particle_goes_round_and_round(kind, method, derived):
    model = derived(on_a_circle, kind)
    start = model.start(x=1.0, y=0.0, dx=0.0, dy=1.0)
    run = sv.simulate(model, start, (0.0, 20.0), method=as_method(method, **precise(method)), drift=drifts(method)[-1])
    assert run.success and run.counters["pivot_changes"] == 1  # to those of definite matrices, which last
    error = np.hypot(run["x"] - np.cos(run.t), run["y"] - np.sin(run.t)).max()
    assert error < 1e-8


def derives_again(patch):
    """Changed pivots are those of rows that are derived again, as where no others solve the same rows."""
    patch.setattr("servoctl.methods.motion.strong_form", lambda *_: None)


@pytest.mark.parametrize(("make", "method"), [("equation", "DOP853"), ("curvature", "Taylor")])
def test_rows_derived_again_lead_on(make, method, derived, monkeypatch):
    derives_again(monkeypatch)
    model = derived(on_a_circle, make)
    run = sv.simulate(model, model.start(x=1.0, y=0.0, dx=0.0, dy=1.0), (0.0, 20.0), as_method(method, **precise(method)))
    assert run.success and run.counters["pivot_changes"] >= 6
    assert np.hypot(run["x"] - np.cos(run.t), run["y"] - np.sin(run.t)).max() < 1e-8


def test_long_steps_change_pivots_on_the_way_back_too(derived, monkeypatch):
    derives_again(monkeypatch)
    model = derived(on_a_circle, "equation")
    x, y = np.cos(20.0), np.sin(20.0)
    start = model.start(t=20.0, x=x, y=y, dx=-y, dy=x)
    run = sv.simulate(model, start, (20.0, 0.0), method=sv.methods.Taylor(order=20, rtol=1e-11, atol=1e-13), drift="project")
    assert run.success and run.counters["steps"] < 30 and run.counters["pivot_changes"] >= 6
    assert np.hypot(run["x"] - np.cos(run.t), run["y"] - np.sin(run.t)).max() < 1e-9


@pytest.mark.parametrize("method", ["LSODA", "Taylor", "RK4"])
def test_a_pendulum_goes_over_the_top(method, derived):
    model = derived(pendulum_on_a_cart)
    start = model.start(s=0.0, ds=0.0, x=0.0, y=-1.0, dx=7.0)
    run = sv.simulate(model, start, (0.0, 3.0), method=as_method(method, **precise(method)), drift=drifts(method)[-1])
    swing = solve_ivp(lambda t, z: [z[1], -9.81 * np.cos(z[0])], (0.0, 3.0), [-np.pi / 2, 7.0], **REFERENCE)
    angle = swing.sol(run.t)[0]
    assert angle[-1] > angle[0] + 2 * np.pi
    assert run.counters["pivot_changes"] == 1
    assert np.hypot(run["x"] - np.cos(angle), run["y"] - np.sin(angle)).max() < 1e-7
    tension = 2 * run["multiplier_rod"] * -1.0  # the rod's reaction is 2 μ (x, y)
    assert np.abs(tension).max() == pytest.approx(9.81 + 49.0, rel=1e-4)
    assert np.abs(run["force"]).max() < 80.0 and sv.verify(run, segments=4).numbers["balance"] < 1e-11


@pytest.mark.parametrize("method", ["Radau", "Taylor", "RK4"])
def test_a_driven_pendulum_turns_by_more_than_360_degrees(method, derived):
    model = derived(driven_pendulum)
    start = model.start(x=1.0, y=0.0)
    run = sv.simulate(model, start, (0.0, 4.0), method=as_method(method, **precise(method)), drift=drifts(method)[-1])
    assert run.success and run.counters["pivot_changes"] == 1
    assert np.hypot(run["x"] - np.cos(2 * run.t), run["y"] - np.sin(2 * run.t)).max() < 1e-8
    assert run["torque"] == pytest.approx(9.81 * np.cos(2 * run.t), abs=1e-6)


def test_signals_without_a_finite_value_are_not_printed(gallery_model):
    model, scene = gallery_model("overhead-crane"), gallery["overhead-crane"]
    run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span)
    low, high = run.extrema("hoist")
    run["tension"][:], run["hoist"][-1], run["X"][:] = np.nan, np.nan, np.inf
    text = repr(run)
    assert "tension" not in text and "nan" not in text and "inf" not in text
    assert run.extrema("hoist") == (low, high) and f"hoist: {low[1]:.6g}" in text


def led_round():
    """A particle led round a circle by the direction in which it is seen: nothing is left to integrate."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, ca.vertcat(x, y)))
    residuals = {"circle": x**2 + y**2 - 1.0, "direction": x * ca.sin(2 * q.t) - y * ca.cos(2 * q.t)}
    return sv.derive(mechanism, sv.Program(residuals, by="ideal"), guess={"x": 1.0, "y": 0.0})


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA", "Taylor", "RK4", "algebraic"])
def test_where_no_other_pivots_are_found_the_motion_is_kept(method, derived, monkeypatch):
    def none_found(*_):
        raise sv.errors.InconsistentStart("No state was found.", "Points of a motion are consistent.")

    model = derived(led_round if method == "algebraic" else driven_pendulum)
    start = model.start(t=0.2, x=np.cos(0.4), y=np.sin(0.4))
    derives_again(monkeypatch)
    monkeypatch.setattr("servoctl.methods.motion.derived_near", none_found)
    settings = {} if method == "algebraic" else precise(method)
    with pytest.raises(sv.errors.SingularProgram) as caught:
        sv.simulate(model, start, (0.2, 4.0), as_method(method, **settings), t_eval=np.linspace(0.2, 4.0, 381))
    run = caught.value.run
    assert 0.3 < run.t[-1] <= caught.value.details["t"] < 1.7  # within the first half turn
    assert np.hypot(run["x"] - np.cos(2 * run.t), run["y"] - np.sin(2 * run.t)).max() < 1e-8


LEVERS = {  # direction of g (a, b), and where it has no lever on b
    "crank": (lambda a, b: [ca.sin(a), ca.cos(b)], np.pi / 2),
    "moving lever": (lambda a, b: [0.0, 1.2 - b], 1.2),
    "lever of both": (lambda a, b: [0.3, ca.cos(b) - 0.1 * ca.sin(b)], np.arctan(10.0)),
}


def lifted(name, start=0.0):
    """Two masses, each driven by its own actuator, the second lifted at 1 m/s by a lever; and its start."""
    q = sv.coordinates("a b")
    a, b = q
    actuators = {"f": [1.0, 0.0], "g": LEVERS[name][0](a, b)}
    mechanism = sv.Mechanism(q, gibbs=sum(x**2 for x in q.d(2)) / 2, potential=b, actuators=actuators)
    program = sv.Program({"A": a - 0.2 * ca.sin(q.t), "B": q.d(1)[1] - 1.0}, by="actuators")
    model = sv.derive(mechanism, program)
    return model, model.start(b=start)


@pytest.mark.parametrize(
    ("name", "method"),
    [*((name, None) for name in LEVERS), *(("lever of both", method) for method in ("RK4", "DOP853", "RadauIIA"))],
)
def test_a_motion_of_all_coordinates_stops_where_an_actuator_has_no_lever(name, method):
    """The accelerations are finite there, and the force 1/lever is not."""
    dead = LEVERS[name][1]
    model, start = lifted(name)
    run = sv.simulate(model, start, (0.0, dead - 0.05), method)
    lever = model.reduction.mechanism.E[1, 1]
    values = ca.Function("lever", [*model.reduction.mechanism.q], [lever]).map(len(run.t))(run["a"], run["b"])
    assert run["g"] == pytest.approx(1.0 / np.ravel(values), rel=1e-6)
    with refused(sv.errors.SingularProgram, direction=["d2b"]) as caught:
        sv.simulate(model, start, (0.0, dead + 0.5), method)
    assert caught.value.details["t"] == pytest.approx(dead, abs=1e-6)
    assert caught.value.details["measure"] < 1e-6 and "actuation" in str(caught.value)
    with refused(sv.errors.SingularProgram, direction=["d2b"], t=0.0):
        sv.simulate(*lifted(name, dead), (0.0, 0.3), method)


UNDEFINED = {  # no value of the formulas at t = 1 s, where they have limits
    "power": lambda t: 0.1 * ((t - 1.0) ** 2) ** 1.25,
    "quotient": lambda t: 0.1 * ca.sin(t - 1.0) / (t - 1.0),
}


def pulled_along(path):
    """A cart along a path, with a pendulum on it."""
    q = sv.coordinates("x th")
    x, th = q
    functions = sv.particle(q, 1.0, ca.vertcat(x, 0)) + sv.particle(q, 0.5, ca.vertcat(x + ca.sin(th), -ca.cos(th)))
    mechanism = sv.Mechanism(q, functions, potential=-0.5 * 9.81 * ca.cos(th), actuators={"F": x})
    model = sv.derive(mechanism, sv.Program({"X": x - path(q.t)}, by="actuators"))
    return model, model.start(th=0.2, dth=0.0)


@pytest.mark.parametrize("method", ["Taylor", "DOP853", "RadauIIA", "LSODA"])
@pytest.mark.parametrize("name", UNDEFINED)
def test_no_sample_is_without_finite_accelerations(name, method):
    model, start = pulled_along(UNDEFINED[name])
    with refused(sv.errors.IntegrationStopped, "d2x", "d2th", "t_eval", t=1.0, residual="X") as caught:
        sv.simulate(model, start, (0.0, 2.0), method)
    run = caught.value.run
    assert np.isfinite(run.jets).all() and 0.99 < run.t[-1] < 1.0 and not run.success


@pytest.mark.parametrize("method", ["Taylor", "DOP853", "RadauIIA"])
@pytest.mark.parametrize("name", UNDEFINED)
def test_an_instant_without_finite_accelerations_is_left_out(name, method):
    """The force on the cart in front of the gap and behind it, from x'' of the path."""
    model, start = pulled_along(UNDEFINED[name])
    run = sv.simulate(model, start, (0.0, 2.0), method, t_eval=[0.0, 0.5, 1.5, 2.0])
    assert run.success and np.isfinite(run.jets).all()
    d2x = np.array([float(ca.evalf(ca.substitute(second, t, at))) for at in run.t for t, second in [twice(name)]])
    th, dth, d2th = run["th"], run["dth"], run["d2th"]
    force = 1.5 * d2x + 0.5 * (d2th * np.cos(th) - dth**2 * np.sin(th))
    assert run["F"] == pytest.approx(force, abs=1e-8)
    assert np.cos(th) * d2x + d2th + 9.81 * np.sin(th) == pytest.approx(0.0, abs=1e-8)


def twice(name):
    """Time and x''(t) of a path, by CasADi."""
    t = ca.SX.sym("t")
    return t, ca.jacobian(ca.jacobian(UNDEFINED[name](t), t), t)
