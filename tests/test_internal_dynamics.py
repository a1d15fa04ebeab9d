"""Internal dynamics: growth against the variational equation and closed forms, whatever the coordinates and samples."""

import pickle
import runpy
import warnings
from math import pi
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from refusals import refused, warned
from scenes import CERTIFIED
from scipy.integrate import solve_ivp

import servoctl as sv
from servoctl import growth, simulation
from servoctl.gallery import cars, gallery, mass_on_car, passive_arm, spiral, vtol
from servoctl.growth import few_tangents, growth_bound


def internal(pair, span, start, **guess):
    model = sv.derive(*pair)
    return sv.internal_dynamics(sv.simulate(model, model.start(guess=guess, **start), span))


@pytest.mark.parametrize(
    "pair, start, poles",
    [
        (mass_on_car(pi / 4), {"s": 0.0, "ds": 0.0}, [-0.5 + 2.1794494718j, -0.5 - 2.1794494718j]),
        (mass_on_car(pi / 4, coordinates="absolute"), {"x": 0.5, "dx": 0.0}, [-0.5 + 2.1794494718j]),
        (mass_on_car(pi / 2), {"s": 0.0, "ds": 0.0}, [-0.25 + 1.5612494996j, -0.25 - 1.5612494996j]),
        (mass_on_car(0.0, 1.0), {"s": 0.0}, [-5.0]),  # -k/d
    ],
)
def test_mass_on_car(pair, start, poles):
    found = internal(pair, (0.0, 1.0), start)
    assert found.verdict == "stable" and found.growth == 1.0 and found.left < 0.95
    for pole in poles:
        assert np.abs(found.eigenvalues - pole).min(axis=0).max() < 1e-7


def test_the_aircrafts_centre_of_mass_is_unstable():
    """Theory: ±15.0405993 1/s at rest, and errors grow by exp of their integral."""
    with warned("unstable over these 0.2 s", "grow by 20"):
        found = internal(vtol("centre"), (0.0, 0.2), {"theta": 0.0, "dtheta": 0.0})
    assert found.verdict == "unstable"
    assert found.eigenvalues[0, 0] == pytest.approx(15.0405993, abs=1e-6)
    assert found.eigenvalues[1, 0] == pytest.approx(-15.0405993, abs=1e-6)
    assert found.growth == pytest.approx(np.exp(0.2 * 15.04), rel=0.02)


def test_the_passive_arm_turns_unstable_above_0_4():
    """Its frozen eigenvalues say so at once; a verdict takes the time in which errors grow."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        found = [internal(passive_arm(G), (0.0, 0.02), {"q2": 0.0, "dq2": 0.0}) for G in (0.2, 0.39, 0.41, 0.6)]
        longer = [internal(passive_arm(G), (0.0, T), {"q2": 0.0, "dq2": 0.0}) for G, T in ((0.2, 1.0), (0.6, 0.3))]
    assert [one.eigenvalues.real.max() > 0 for one in found] == [False, False, True, True]
    assert [one.verdict for one in found] == ["neutral", "neutral", "unstable", "neutral"]
    assert [one.verdict for one in longer] == ["stable", "unstable"]


def test_symmetries_are_neutral_and_flat_programs_have_none():
    scene = gallery["wheeled-robot"]
    found = internal(scene.build(), (0.0, 5.0), scene.start, v=1.0)
    assert (found.verdict, found.names) == ("neutral", ("x", "y", "psi", "r"))
    flat = internal(cars(), (0.0, 0.5), {})
    assert flat.verdict == "none" and "determines" in repr(flat)


def test_a_run_without_its_model_is_refused(tmp_path):
    model = sv.derive(*passive_arm())
    run = sv.simulate(model, model.start(q2=0.0, dq2=0.0), (0.0, 0.5))
    for other, kind in ((sv.load(run.save(tmp_path / "run")), "Run"), (None, "NoneType")):
        with refused(sv.errors.SpecificationError, "internal_dynamics", kind):
            sv.internal_dynamics(other)


# a body of which the program says nothing: its motion is the internal dynamics --------------------------------------


def passive(acceleration, scale=1.0):
    """The model of a body x'' = acceleration(x, x', t), in units of 1/scale m, beside another one that is driven."""
    q = sv.coordinates("x y")
    (x, y), (dx, _), (d2x, d2y) = q, q.d(1), q.d(2)
    mechanism = sv.Mechanism(
        q,
        gibbs=(d2x**2 + d2y**2) / 2,
        forces={"x": scale * acceleration(x / scale, dx / scale, q.t)},
        actuators={"F": y},
    )
    return sv.derive(mechanism, sv.Program({"y": y - ca.sin(q.t)}), keep=["x"])


def moved(model, length, *method, x=1e-3, **options):
    """A run of a length [s] from x, with its internal dynamics."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        run = sv.simulate(model, model.start(x=x, dx=0.0), (0.0, length), *method, **options)
    return run, sv.internal_dynamics(run)


def mathieu(depth, damping=0.1):
    return lambda x, v, t: -damping * v - (1 + depth * ca.cos(2 * t)) * x


def fundamental(length, depth, damping=0.1):
    """The propagator of Mathieu's equation, integrated by itself."""

    def rates(t, Y):
        return np.concatenate([Y[2:], -damping * Y[2:] - (1 + depth * np.cos(2 * t)) * Y[:2]])

    return solve_ivp(rates, (0.0, length), np.eye(2).ravel(), rtol=1e-11, atol=1e-13).y[:, -1].reshape(2, 2)


@pytest.mark.parametrize(
    "samples",
    [
        None,
        np.linspace(0.0, 120.0, 4),
        pi * np.arange(39),  # one phase of the period alone
        [120.0],
    ],
    ids=["default", "few", "one phase", "last"],
)
def test_parametric_resonance_is_unstable_though_all_frozen_eigenvalues_are_stable(samples):
    run, found = moved(passive(mathieu(0.6)), 120.0, t_eval=samples)
    assert run.internal["verdict"] == "unstable"
    exact = np.linalg.norm(fundamental(120.0, 0.6), 2)
    assert exact / 1.3 < run.internal["growth"] < exact * 1.3
    if samples is None:
        assert np.abs(run["x"]).max() == pytest.approx(84.0, rel=0.01)
        assert found.verdict == "unstable" and found.eigenvalues.real.max() < -0.04
        assert "frozen eigenvalues" in repr(found) and "over these 120 s" in repr(found)


def test_spans_of_whole_periods_are_judged_like_others():
    verdicts = {moved(passive(mathieu(depth)), 32 * pi)[1].verdict for depth in (0.6, 0.8)}
    assert verdicts == {"unstable"}


@pytest.mark.parametrize("depth, verdict", [(0.6, "unstable"), (0.15, "stable")])
def test_multipliers_are_those_of_the_propagator_over_a_period(depth, verdict):
    model = passive(mathieu(depth))
    run, _ = moved(model, 20.0)
    found = sv.internal_dynamics(run, period=pi)
    expected = np.linalg.eigvals(fundamental(pi, depth))
    expected = expected[np.argsort(-np.abs(expected))]
    assert np.sort(np.abs(found.multipliers)) == pytest.approx(np.sort(np.abs(expected)), rel=2e-3)
    assert np.prod(found.multipliers) == pytest.approx(np.exp(-0.1 * pi), rel=2e-3)  # Liouville
    assert found.verdict == verdict and "multipliers" in repr(found)


def test_a_period_that_is_none_is_refused():
    model = passive(mathieu(0.6))
    run, _ = moved(model, 20.0)
    with refused(sv.errors.SpecificationError, "3 s", period=3.0):
        sv.internal_dynamics(run, period=3.0)
    with refused(sv.errors.SpecificationError, "30 s", period=30.0):
        sv.internal_dynamics(run, period=30.0)
    with refused(sv.errors.SpecificationError, "period"):
        sv.internal_dynamics(run, period=-1.0)


@pytest.mark.parametrize(
    "acceleration, scale, length, verdict, growth",
    [
        (lambda x, v, t: 0 * x, 1e-6, 50.0, "neutral", (1.0, 2.0)),  # adrift
        (lambda x, v, t: -1e4 * x, 1e6, 3.0, "neutral", (1.0, 1.1)),  # quick
        (lambda x, v, t: -1e-4 * x, 1.0, 10.0, "neutral", (1.0, 2.0)),  # slow
        (lambda x, v, t: -0.3 * v - x, 1e-6, 40.0, "stable", (1.0, 1.1)),
        (lambda x, v, t: 4 * x, 1e6, 5.0, "unstable", (np.exp(10.0) / 1.05, np.exp(10.0) * 1.05)),
        (lambda x, v, t: 4 * x, 1.0, 0.1, "neutral", (1.0, 1.5)),  # for so short a time nothing grows
        (lambda x, v, t: -0.3 * v - (-1 + 34 * ca.cos(15 * t)) * x, 1e-6, 40.0, "stable", (1.0, 10.0)),  # Kapitza's pendulum
        (lambda x, v, t: -2 * v - (3 - 6 / (1 + ca.exp(-2 * (t - 10)))) * x, 1e6, 20.0, "unstable", (8e3, 2e4)),  # later
        (lambda x, v, t: -0.3 * v - x + 25 * ca.exp(-(((t - 50) / 0.5) ** 8)) * x, 1.0, 100.0, "unstable", (20, 100)),  # once
    ],
)
def test_growth_is_that_of_the_motion_in_any_units(acceleration, scale, length, verdict, growth):
    _, found = moved(passive(acceleration, scale), length, x=scale)
    assert found.verdict == verdict and growth[0] <= found.growth <= growth[1]


@pytest.mark.parametrize("growth, verdict", [(5.0, "neutral"), (20.0, "unstable")])
def test_exponential_growth_is_unstable_above_ten(growth, verdict):
    _, found = moved(passive(lambda x, v, t: 4 * x), np.log(growth) / 2)
    assert found.verdict == verdict and found.growth == pytest.approx(growth, rel=0.03)


@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-5])
@pytest.mark.parametrize("x", [1.0, 0.0])
def test_what_grows_within_a_pulse_of_a_path_is_unstable(width, x):
    """By λ sinh(λ width) of a speed at λ = 3/width, also where the body itself stays at rest."""
    q = sv.coordinates("x y")
    rate = 3 / width
    pulse = q.references(pulse=sv.paths.polynomials([0.0, 0.4, 0.4 + width, 1.0], [[0.0, rate**2, 0.0]])).pulse
    accelerations = sum(a**2 for a in q.d(2)) / 2
    mechanism = sv.Mechanism(q, gibbs=accelerations, forces={"x": (pulse - 1) * q["x"]}, actuators={"F": q["y"]})
    model = sv.derive(mechanism, sv.Program({"y": q["y"] - ca.sin(q.t)}, jumps=True), keep=["x"])
    with warned("Internal dynamics unstable"):
        run = sv.simulate(model, model.start(x=x, dx=0.0), (0.0, 1.0))
    assert run.internal["growth"] == pytest.approx(rate * np.sinh(3), rel=0.1)


def test_a_pole_that_falls_is_unstable_over_any_longer_time():
    """On a cart that moves by a metre; errors grow twentyfold while it falls, and no more when it swings below."""
    q = sv.coordinates("x theta")
    x, theta = q
    bob = ca.vertcat(x + 0.6 * ca.sin(theta), 0.6 * ca.cos(theta))
    S = sv.particle(q, 2.0, x) + sv.particle(q, 0.5, bob)
    cart = sv.Mechanism(q, S, potential=0.5 * 9.81 * bob[1], actuators={"motor": x})
    path = q.references(cart=sv.paths.rest_to_rest(0.0, 1.0, duration=1.5, smoothness=4)).cart
    model = sv.derive(cart, sv.Program({"cart": x - path}, by="actuators"))
    for length in (0.75, 1.5, 4.0):
        with warned("unstable"):
            run = sv.simulate(model, model.start(), (0.0, length))
        assert run.internal["verdict"] == "unstable" and 15 < run.internal["growth"] < 25


@pytest.mark.parametrize("length", [2.0, 3.0, 4.0])
def test_a_pendulum_that_is_driven_by_its_speed_is_unstable(length):
    """x'' = x' + 10 sin x: areas grow by e^t, but errors in the second half less than in the first."""
    _, found = moved(passive(lambda x, v, t: v + 10 * ca.sin(x)), length, x=0.1)
    assert found.verdict == "unstable" and found.growth > 50


def test_the_plan_of_a_parametric_resonance_is_refused_by_inverse_dynamics():
    model = passive(mathieu(0.6))
    run, found = moved(model, 120.0)
    plant = sv.plant(run.model.reduction.mechanism)
    with refused(sv.errors.UnstableInternalDynamics, "lqr", verdict="unstable", growth=found.growth, states=("x", "dx")):
        sv.computed(run, plant)
    run, _ = moved(passive(mathieu(0.15)), 120.0)
    assert sv.computed(run, sv.plant(run.model.reduction.mechanism)).name == "computed"


def test_stiff_and_backward_motions_are_judged(c_compiler):
    stiff, found = moved(passive(lambda x, v, t: -1e4 * v - 1e4 * (1 + 0.5 * ca.sin(t)) * x), 10.0, "RadauIIA")
    assert found.verdict == "stable" and found.growth < 1.1
    model = passive(lambda x, v, t: -v - x)
    with warned("unstable"):  # what decays forwards grows backwards
        sv.simulate(model, model.start(t=10.0, x=1e-3, dx=0.0), (10.0, 0.0))


def test_growth_is_that_of_a_perturbed_twin():
    model = sv.derive(*vtol("centre"))
    runs = []
    for theta in (0.0, 1e-7):
        with warned("unstable"):
            runs.append(sv.simulate(model, model.start(theta=theta, dtheta=0.0), (0.0, 0.5), rtol_method()))
    apart = np.abs(runs[1]["theta"] - runs[0]["theta"])
    assert runs[0].internal["growth"] / 3 < apart.max() / 1e-7 < runs[0].internal["growth"] * 1.1


def rtol_method():
    return sv.methods.Adaptive("DOP853", 1e-13, 1e-15)


def test_phases_that_drift_apart_are_no_instability():
    """Errors of a speed grow linearly: 20 times in 20 s, and nothing is unstable."""
    q = sv.coordinates("x y")
    (x, y), (d2x, d2y) = q, q.d(2)
    mechanism = sv.Mechanism(q, gibbs=(d2x**2 + d2y**2) / 2, potential=(x**2 + y**2) ** 2 / 4)
    model = sv.derive(mechanism, sv.Program({"plane": 0.6 * x + 0.8 * y}, by="ideal"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        run = sv.simulate(model, model.start(guess={"x": 0.8, "y": -0.6}, dx=0.0), (0.0, 40.0), drift="project")
    found = sv.internal_dynamics(run)
    assert found.verdict == "neutral" and 10 < found.growth < 100


@pytest.mark.parametrize("order, verdict", [(4, "neutral"), (5, "neutral"), (7, "neutral"), (8, "unstable")])
def test_high_derivatives_grow_as_powers_of_time(order, verdict):
    """Up to 1e4 that is neutral."""
    model = sv.derive(*spiral(order))
    straight = {f"d{k}{axis}": 0.0 for k in range(2, order) for axis in "xy"}
    start = model.start(x=0.0, y=0.0, dx=1.0, dy=0.0, guess=straight)
    with warnings.catch_warnings():
        warnings.simplefilter("error" if verdict == "neutral" else "ignore", RuntimeWarning)
        run = sv.simulate(model, start, (0.0, 2.0), drift="project")
    assert run.internal["verdict"] == verdict and run.internal["growth"] > 10


# spaces that turn ----------------------------------------------------------------------------------------------------


def ball_on_a_table(radius=0.1, mass=1.0, table=2.0):
    """A ball that rolls on a turning table: unit quaternion and angular velocity in space. It is exactly neutral."""
    names = sv.coordinates("X Y phi e0 e1 e2 e3")
    X, Y, _, e0, e1, e2, e3 = names
    spin = ca.vertcat(ca.horzcat(-e1, -e2, -e3), ca.horzcat(e0, e3, -e2), ca.horzcat(-e3, e0, e1), ca.horzcat(e2, -e1, e0))
    V = ca.diagcat(ca.SX.eye(3), spin / 2)
    unit = e0**2 + e1**2 + e2**2 + e3**2 - 1
    q = names.with_quasi_velocities("vx vy s w1 w2 w3", V, invariants={"unit": unit})
    (vx, vy, s, w1, w2, _), a = q.w(), q.gamma(2)
    gibbs = mass * (a[0] ** 2 + a[1] ** 2) / 2 + table * a[2] ** 2 / 2
    gibbs += 0.2 * mass * radius**2 * (a[3] ** 2 + a[4] ** 2 + a[5] ** 2)
    rolling = {"roll x": vx - radius * w2 + s * Y, "roll y": vy + radius * w1 - s * X}
    mechanism = sv.Mechanism(q, gibbs=gibbs, actuators={"motor": (0, 0, 1, 0, 0, 0)}, constraints=rolling)
    return sv.derive(mechanism, sv.Program({"table": s - 1.4}))


@pytest.mark.parametrize("length", [60.0])
def test_a_ball_on_a_turning_table_is_neutral(length):
    model = ball_on_a_table()
    start = model.start(X=0.5, Y=0.0, phi=0.0, e0=1.0, e1=0.0, e2=0.0, e3=0.0, vx=0.0, vy=0.3, w3=0.2)
    run = sv.simulate(model, start, (0.0, length), drift="project")
    found = sv.internal_dynamics(run)
    assert run["e0"].min() < 0 < run["e0"].max()
    assert found.verdict == "neutral" and found.growth < 3


@pytest.mark.parametrize(("tilt", "samples"), [((0.0, 0.0, 0.0), 5), ((-0.6, 0.1, 0.7), 1001)], ids=str)
def test_a_tilted_ball_in_its_own_axes_is_neutral(tilt, samples):
    """With body-fixed angular velocities: its centre moves in a circle at constant speed, at 2/7 of the table's rate."""
    table, names = 0.7, sv.coordinates("X Y e0 e1 e2 e3")
    X, Y, e0, e1, e2, e3 = names
    spin = ca.vertcat(ca.horzcat(-e1, -e2, -e3), ca.horzcat(e0, -e3, e2), ca.horzcat(e3, e0, -e1), ca.horzcat(-e2, e1, e0))
    unit = e0**2 + e1**2 + e2**2 + e3**2 - 1
    q = names.with_quasi_velocities("vx vy w1 w2 w3", ca.diagcat(ca.SX.eye(2), spin / 2), invariants={"unit": unit})
    vx, vy, *w = q.w()
    Wx = ca.dot(ca.vertcat(1 - 2 * (e2**2 + e3**2), 2 * (e1 * e2 - e0 * e3), 2 * (e1 * e3 + e0 * e2)), ca.vertcat(*w))
    Wy = ca.dot(ca.vertcat(2 * (e1 * e2 + e0 * e3), 1 - 2 * (e1**2 + e3**2), 2 * (e2 * e3 - e0 * e1)), ca.vertcat(*w))
    gibbs = sum(weight * a**2 / 2 for weight, a in zip((1, 1, 0.4, 0.4, 0.4), q.gamma(2), strict=True))
    rolling = {"roll x": vx - Wy + table * Y, "roll y": vy + Wx - table * X}
    model = sv.derive(sv.Mechanism(q, gibbs=gibbs), sv.Program(rolling, by="ideal"))
    values = dict(zip(("e1", "e2", "e3"), tilt, strict=True))
    start = model.start(X=1.0, Y=0.0, vx=0.0, vy=0.3, w3=0.0, guess={"e0": 1.0}, **values)
    run = sv.simulate(model, start, (0.0, 30.0), t_eval=np.linspace(0.0, 30.0, samples))
    assert run["vx"] + 1j * run["vy"] == pytest.approx(0.3j * np.exp(2j / 7 * table * run.t), abs=1e-7)
    assert run.internal["verdict"] == sv.internal_dynamics(run).verdict == "neutral"


@pytest.mark.parametrize("length", [60.0])
def test_a_spinning_satellite_is_neutral(length):
    example = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "quaternion.py"), run_name="example")
    model = sv.derive(example["mechanism"], example["program"])
    run = sv.simulate(model, model.start(w3=0.5, guess={"e0": 1.0}), (0.0, length), drift="project")
    found = sv.internal_dynamics(run)
    assert found.verdict == "neutral" and found.growth < 3


# what carries the verdict --------------------------------------------------------------------------------------------


def test_runs_carry_the_verdict_and_flat_ones_need_none(tmp_path, gallery_model):
    model = gallery_model("vtol-centre")
    with warned("unstable over these 1 s"):
        run = sv.simulate(model, model.start(**gallery["vtol-centre"].start), (0.0, 1.0))
    assert "internal dynamics unstable over these 1 s: errors grow by" in repr(run)
    assert run.internal["growth"] == sv.internal_dynamics(run).growth > 100
    loaded = sv.load(run.save(tmp_path / "run"))
    assert loaded.internal == run.internal and loaded.internal["text"] in repr(loaded)
    flat = sv.derive(*cars())
    assert sv.simulate(flat, flat.start(), (0.0, 0.5)).internal == {}


def test_a_motion_that_grows_beyond_its_tolerance_says_how_long_it_is_good():
    model = passive(lambda x, v, t: 4 * x)
    with warned("good for 6.9 s"):  # 1e-9 e^(2 t) = 1e-3
        run = sv.simulate(model, model.start(x=1e-3, dx=0.0), (0.0, 12.0))
    assert run.internal["good for"] == pytest.approx(np.log(1e6) / 2, rel=0.02)
    assert sv.internal_dynamics(run).good_for(1e-12) == pytest.approx(np.log(1e9) / 2, rel=0.02)


def test_a_stopped_motion_carries_the_verdict_too():
    model = sv.derive(*passive_arm(0.6))
    with pytest.raises(sv.errors.SingularProgram) as caught:
        sv.simulate(model, model.start(q2=0.0, dq2=0.0), (0.0, 1.0))
    assert caught.value.run.internal["verdict"] == "unstable"


def test_what_swings_too_often_is_inconclusive():
    """Along five thousand periods of the linearisation, two instants in each tell nothing."""
    run, found = moved(passive(lambda x, v, t: -0.1 * v - (1 + 5e3 * ca.cos(250 * t)) * x), 120.0)
    assert found.verdict == run.internal["verdict"] == "inconclusive" and np.isnan(found.growth)
    assert "8192 intervals" in repr(found) and "a shorter time" in repr(found)
    assert sv.internal_dynamics(moved(run.model, 5.0)[0]).verdict != "inconclusive"


# the bound that settles whether there is anything to warn of ----------------------------------------------------------


QUIET = sorted({*CERTIFIED, "reaction-wheels", "trailers"} - {"vtol-centre", "appell-hamel-squared", "constant-speed-horizontal"})


@pytest.mark.parametrize("name", QUIET)
def test_a_bound_of_the_growth_settles_what_is_quiet(name, gallery_model, monkeypatch):
    """No propagators in `simulate`; the verdict when it is read is that of `sv.internal_dynamics`."""
    model, scene, calls = gallery_model(name), gallery[name], []
    real = simulation.internal_dynamics
    monkeypatch.setattr(simulation, "internal_dynamics", lambda *a: calls.append(a) or real(*a))
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)
    assert not calls and (model.flat or growth_bound(run, few_tangents(run)) < 10)
    if not model.flat:
        assert dict(run.internal) == real(run).facts() and run.internal == run.internal and len(calls) == 1
        assert run.internal["growth"] < 10


def bursts(rate, at, width):
    """Deviations grow at a rate near one instant, and shrink slowly at others."""
    return lambda x, v, t: (rate * ca.exp(-(((t - at) / width) ** 2)) - 1) * x - 0.5 * v


LOUD = {
    "unstable": (lambda x, v, t: x, 10.0),
    "parametric resonance": (mathieu(0.6), 120.0),
    "resonance at a low depth": (mathieu(0.4), 200.0),
    "a burst": (bursts(60.0, 4.0, 1.0), 12.0),
    "a late burst": (bursts(300.0, 11.0, 0.4), 12.0),
    "negative damping": (lambda x, v, t: -4 * x + 0.5 * v, 20.0),
    "of fast oscillations": (lambda x, v, t: -400 * x + 0.4 * v, 30.0),
}


@pytest.mark.parametrize("name", LOUD)
@pytest.mark.parametrize("samples", [None, 2, 5, 50], ids=str)
def test_what_is_unstable_is_warned_of_whatever_the_samples(name, samples):
    acceleration, length = LOUD[name]
    model = passive(acceleration)
    times = None if samples is None else np.linspace(0.0, length, samples)
    with warned("Internal dynamics unstable"):
        run = sv.simulate(model, model.start(x=1e-3, dx=0.0), (0.0, length), t_eval=times)
    assert run.internal["verdict"] == "unstable"


@pytest.mark.parametrize("seed", range(4))
def test_the_bound_is_one_of_the_propagator(seed):
    """Random linear motions of two coordinates, forth and back: exp ∫ μ is above the norm in the balanced states."""
    random = np.random.default_rng(seed)
    K, D, B = random.normal(size=(3, 2, 2))
    K, rate = K @ K.T + np.eye(2), random.uniform(0.5, 3.0)
    q = sv.coordinates("x y z")
    (x, y, z), (dx, dy, _) = q, q.d(1)
    force = -(K + 0.3 * ca.cos(rate * q.t) * B) @ ca.vertcat(x, y) - 0.2 * D @ ca.vertcat(dx, dy)
    mechanism = sv.Mechanism(
        q, gibbs=sum(a**2 for a in q.d(2)) / 2, forces={"x": force[0], "y": force[1]}, actuators={"F": z}
    )
    model = sv.derive(mechanism, sv.Program({"z": z - ca.sin(q.t)}), keep=["x", "y"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for span in ((0.0, 2.0), (2.0, 0.0)):
            start = model.start(t=span[0], x=1.0, y=0.5, dx=0.0, dy=0.0)
            run = sv.simulate(model, start, span, t_eval=np.linspace(*span, 41))
            assert run.internal["growth"] <= 1.05 * growth_bound(run, few_tangents(run))


def test_the_verdict_is_computed_when_it_is_read(tmp_path, gallery_model):
    model, start = gallery_model("pendubot"), gallery["pendubot"].start
    run = sv.simulate(model, model.start(**start), (0.0, 1.0), t_eval=[0.5, 1.0])
    assert "_internal" not in vars(run)
    copied = pickle.loads(pickle.dumps(run))
    assert copied.internal == run.internal and run.internal["verdict"] == "stable"  # that of the whole motion
    assert pickle.loads(pickle.dumps(run)).internal == run.internal
    assert run.internal["seconds"] == 1.0 and sv.load(run.save(tmp_path / "run")).internal == run.internal
    with pytest.raises(TypeError):
        run.internal["verdict"] = "unstable"
    assert sv.simulate(model, model.start(**start), (0.0, 1.0)).internal["verdict"] == "stable"


@pytest.mark.parametrize("length", [9.0, 20.0])
@pytest.mark.parametrize("samples", [41, 201, 1001, 4001])
def test_blocks_of_unequal_times_do_not_make_growth_exponential(length, samples, gallery_model):
    """Over 9 s the wheel's errors grow by 2.97 in twice the time at most: three times would be exponential."""
    model = gallery_model("appell-hamel").with_parameters(m=1.0, M=5.0, I_x=0.1125, I_y=0.225, a=0.3, b=0.1, rho=0.2)
    start = model.start(x=0.0, y=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = sv.simulate(model, start, (0.0, length), t_eval=np.linspace(0.0, length, samples))
    found = sv.internal_dynamics(run)
    assert run.internal["verdict"] == "neutral"
    assert found.growth == pytest.approx({9.0: 33.5, 20.0: 80.0}[length], rel=0.05)
    if samples > 41 or length > 9.0:  # 41 samples give 3.01, within the two percent of growth by longer steps
        assert found.verdict == "neutral"


def test_few_intervals_that_are_long_for_the_linearisation_have_no_propagators(gallery_model, monkeypatch):
    model, scene = gallery_model("elastic-link"), gallery["elastic-link"]
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span, "RadauIIA")
    monkeypatch.setattr(growth, "_steps", None)
    assert not growth.quiet(run)
