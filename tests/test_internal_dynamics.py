"""Internal dynamics: growth against the variational equation and closed forms, whatever the coordinates and samples."""

import pickle
import runpy
import warnings
from dataclasses import replace
from functools import reduce
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
from servoctl.growth import growth_bound
from servoctl.methods import flow
from servoctl.methods.flow import active_states
from servoctl.methods.taylor import last_index


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


@pytest.mark.parametrize("most", [64, 128, 256])
def test_what_is_unstable_before_nothing_resolves_it_is_unstable(most, monkeypatch):
    """In the end it turns faster than few instants resolve."""
    monkeypatch.setattr(growth, "MOST", most)
    model = passive(lambda x, v, t: v + 10 * ca.sin(x))
    with warned("unstable"):
        run = sv.simulate(model, model.start(x=0.1, dx=0.0), (0.0, 6.0))
    assert growth._resolved(model, run) is None
    found = sv.internal_dynamics(run)
    assert found.verdict == "unstable" and found.length < 6.0 and 10 < found.growth < 1e3


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


def test_samples_that_resolve_nothing_are_inconclusive():
    model = passive(mathieu(0.6))
    run, _ = moved(model, 120.0)
    jets = run.jets.copy()
    jets[:, ::2] *= 1.5  # no motion
    found = sv.internal_dynamics(replace(run, jets=jets))
    assert found.verdict == "inconclusive" and np.isnan(found.growth) and "t_eval" in repr(found)


# the bound that settles whether there is anything to warn of ----------------------------------------------------------


QUIET = sorted({*CERTIFIED, "reaction-wheels", "trailers"} - {"vtol-centre", "appell-hamel-squared", "constant-speed-horizontal"})


@pytest.mark.parametrize("name", QUIET)
def test_a_bound_of_the_growth_settles_what_is_quiet(name, gallery_model, monkeypatch):
    """No propagators in `simulate`; the verdict when it is read is that of `sv.internal_dynamics`."""
    model, scene, calls = gallery_model(name), gallery[name], []
    real = simulation.internal_dynamics
    monkeypatch.setattr(simulation, "internal_dynamics", lambda *a: calls.append(a) or real(*a))
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)
    assert not calls and (model.flat or growth_bound(model, run) < 10)
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
            assert run.internal["growth"] <= 1.05 * growth_bound(run.model, run)


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


def along(model, last, cuts, x, size, names=(), instants=()):
    """Deviations from a motion that begin as unit vectors of some states, or as tangents of the constraints."""
    moving = flow.Deviations(model, last, cuts, x, size, instants)
    if names:
        moving.Q[:] = np.eye(len(x))[[model.state_names.index(name) for name in names]]
    else:
        assert moving.begin()
    return moving


@pytest.mark.usefixtures("c_compiler")
@pytest.mark.parametrize("span", [(0.0, 12.0), (12.0, 0.0), (0.0, 0.05)], ids=str)
@pytest.mark.parametrize("scale", [1.0, 1e6], ids=str)
def test_deviations_moved_by_series_are_those_of_mathieus_equation(span, scale):
    model, depth, instants = passive(mathieu(0.6), scale), 0.6, np.linspace(*span, 9)
    x = model.start(t=span[0], x=1e-3 * scale, dx=0.0).values
    size = np.where(np.char.find(model.state_names, "x") >= 0, scale, 1.0)
    t, Q, R = along(model, 17, instants, x, size, ["x", "dx"]).by_step()
    assert np.isin(instants, t).all() and np.all(np.diff(t) * (span[1] - span[0]) > 0)
    for basis in Q:
        assert basis.T @ basis == pytest.approx(np.eye(2), abs=1e-12)

    def rates(t, Y):
        return np.concatenate([Y[2:], -0.1 * Y[2:] - (1 + depth * np.cos(2 * t)) * Y[:2]])

    rows = [model.state_names.index(name) for name in ("x", "dx")]
    exact = solve_ivp(rates, span, np.eye(2).ravel(), t_eval=instants, rtol=1e-11, atol=1e-13).y.reshape(2, 2, -1)
    close = {"rel": 1e-4, "abs": 1e-4 * np.abs(exact[:, :, -1]).max()}
    assert (Q[-1] @ reduce(lambda P, R: R @ P, R))[rows] == pytest.approx(exact[:, :, -1], **close)
    free = along(model, 17, span, x, size, ["x", "dx"], instants)
    assert free.move() and free.Q @ free.Q.T == pytest.approx(np.eye(2), abs=1e-12)
    assert free.Z[:, rows, :9].swapaxes(0, 1) == pytest.approx(exact, **close)


def test_series_that_are_too_short_for_deviations_take_shorter_steps():
    """At rest the steps of the state are those of the slow motion of y; deviations swing at 30 rad/s."""
    model = passive(lambda x, v, t: -900 * x)
    moving = along(model, 17, [0.0, 0.5], model.start(x=0.0, dx=0.0).values, np.ones(4), ["x", "dx"])
    _, Q, R = moving.by_step()
    moved = (Q[-1] @ reduce(lambda P, R: R @ P, R))[[model.state_names.index(name) for name in ("x", "dx")]]
    c, s = np.cos(15.0), np.sin(15.0)
    assert len(R) > 3 and moved == pytest.approx(np.array([[c, s / 30], [-30 * s, c]]), abs=3e-2)


def test_deviations_take_no_more_steps_than_they_may():
    model, size = passive(lambda x, v, t: -x), np.ones(4)
    x = model.start(x=1.0, dx=0.0).values
    assert along(model, 17, np.linspace(0.0, 8.0, 33), x, size, ["x", "dx"]).move()
    assert not along(model, 17, np.linspace(0.0, 2e4, 33), x, size, ["x", "dx"]).move()
    assert not along(model, 17, np.linspace(0.0, 8.0, flow.MOST_ALONG + 2), x, size, ["x", "dx"]).move()


@pytest.mark.parametrize("name", ["appell-hamel", "passive-arm"])
def test_tangents_span_the_kernel_of_the_gradients(name, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    x = model.start(**scene.start, guess=scene.guess).values
    size = 1 + np.arange(float(len(x)))
    moving, N = along(model, 12, [0.0], x, size), growth._kernel(model, np.zeros(1), x[:, None], size)[0][0]
    assert moving.Q.T @ moving.Q == pytest.approx(N @ N.T, abs=1e-12) and moving.defect() < 1e-12
    beyond = np.linalg.qr(np.column_stack([N, np.eye(len(x))]))[0][:, N.shape[1]]
    moving.Q[0] = beyond
    assert moving.defect() == pytest.approx(1.0, abs=1e-12)


def test_errors_of_states_on_which_nothing_depends_stay(gallery_model):
    model = gallery_model("appell-hamel")
    assert [name for name, active in zip(model.state_names, active_states(model), strict=True) if not active] == ["x", "y"]
    assert active_states(gallery_model("pendubot")).all()
    x = model.start(x=0.0, y=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=0.5).values
    kept = along(model, 18, np.linspace(0.0, 10.0, 33), x, 1 + np.arange(10.0))
    first = kept.Q[:2].copy()
    _, Q, R = kept.by_step()
    assert np.array_equal(Q[:, :, :2], np.broadcast_to(first.T, (len(Q), 10, 2))) and (R[:, :2, :2] == np.eye(2)).all()


COMPARED = {
    "appell-hamel": ((0.0, 10.0), 24),
    "backwards": ((10.0, 0.0), 24),
    "one second": ((0.0, 1.0), 24),
    "low order": ((0.0, 10.0), 10),
    "long": ((0.0, 60.0), 18),
}


@pytest.mark.parametrize("name", COMPARED)
def test_the_growth_between_all_instants_is_that_of_products_of_propagators(name, gallery_model):
    (t0, t1), last = COMPARED[name]
    model = gallery_model("appell-hamel").with_parameters(I_x=0.1125, I_y=0.225)
    x = model.start(t=t0, x=0.0, y=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=0.5).values
    size, cuts = 1 + np.arange(10.0), np.linspace(t0, t1, 33)
    t, Q, R = along(model, last, cuts, x, size).by_step()
    ends = np.flatnonzero(np.isin(t, cuts))
    corners = growth.Tangents(model.state_names, t, size, Q, Q)
    _, exact, scale = growth._growth(corners, growth._propagators(R, ends))
    moving = along(model, last, [t0, t1], x, size, instants=cuts)
    assert moving.move()
    quiet, other, within = flow.growth(moving.Z, len(cuts), growth._SETTINGS)
    single = growth._within(exact)[1] > np.log(growth.UNSTABLE)  # a block that only Python takes apart
    assert quiet == (not single and not growth._unstable(corners, R, ends, exact, scale)) and single == (name == "long")
    assert other == pytest.approx(scale, rel=1e-3)
    assert within == pytest.approx(growth._within(exact), abs=0.03)
    assert not flow.growth(moving.Z, len(cuts), (1.0, *growth._SETTINGS[1:]))[0]  # no propagator is as moderate as this


def test_propagators_that_shrink_beyond_rounding_are_multiplied_one_by_one():
    model = passive(lambda x, v, t: -40 * v - 400 * x)
    x, instants = model.start(x=1.0, dx=0.0).values, np.linspace(0.0, 4.0, 33)
    moving = along(model, 17, [0.0, 4.0], x, np.ones(4), ["x", "dx"], instants)
    assert moving.move() and not flow.growth(moving.Z, 33, growth._SETTINGS)[0]
    _, _, R = along(model, 17, [0.0, 4.0], x, np.ones(4), ["x", "dx"]).by_step()
    assert np.linalg.norm(reduce(lambda P, R: R @ P, R)) < 1e-20
    run = sv.simulate(model, model.start(x=1.0, dx=0.0), (0.0, 4.0), "Taylor")
    assert growth.no_growth_by_series(model, run, 17)


@pytest.mark.usefixtures("c_compiler")
@pytest.mark.parametrize("span, t_eval", [((0.0, 10.0), None), ((10.0, 0.0), None), ((0.0, 10.0), [5.0, 10.0])], ids=str)
def test_neutral_growth_above_ten_takes_no_linearisation(span, t_eval, gallery_model, monkeypatch):
    """The wheel of Appell and Hamel turns back; its errors grow thirtyfold, but not exponentially."""
    model = gallery_model("appell-hamel").with_parameters(I_x=0.1125, I_y=0.225)
    start = model.start(t=span[0], x=0.0, y=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=0.5)
    calls, real = [], simulation.internal_dynamics
    monkeypatch.setattr(simulation, "internal_dynamics", lambda *a: calls.append(a) or real(*a))
    run = sv.simulate(model, start, span, t_eval=t_eval)
    assert growth_bound(model, run) > 10 or t_eval
    assert not calls and 30 < sv.internal_dynamics(run).growth < 52


def test_what_takes_less_time_tells_first_that_growth_is_harmless(gallery_model, monkeypatch):
    """The bound is silent on 10 s of the wheel, the series on a run whose series are too coarse."""
    model, tried = gallery_model("appell-hamel").with_parameters(I_x=0.1126, I_y=0.225), []
    start = model.start(x=0.0, y=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=0.5)
    for name in ("growth_bound", "no_growth_by_series"):
        real = getattr(simulation, name)
        monkeypatch.setattr(simulation, name, lambda *a, name=name, real=real: tried.append(name) or real(*a))

    def judged_by(end, method):
        tried.clear()
        verdict = sv.simulate(model, start, (0.0, end), method).internal["verdict"]
        return verdict, tuple(tried)

    bound, series = "growth_bound", "no_growth_by_series"
    assert judged_by(10.0, "Taylor") == ("neutral", (series,))
    assert judged_by(10.0, sv.methods.Taylor(2, rtol=1e-9)) == ("neutral", (bound, series))  # many steps
    assert judged_by(0.5, sv.methods.Taylor(2, rtol=1e-9)) == ("neutral", (bound,))
    assert judged_by(10.0, "DOP853") == ("neutral", (bound,))


def test_deviations_that_shrink_stay_in_the_tangent_space(gallery_model, monkeypatch):
    """Errors of differences along the constraints do not shrink: one-sided differences leave the tangent space here."""
    model, scene = gallery_model("passive-arm"), gallery["passive-arm"]
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span, "Taylor")
    assert growth.no_growth_by_series(model, run, last_index(model, sv.methods.Taylor()))
    monkeypatch.setattr(flow, "of_any_size", lambda *_: None)  # as where this unit alone could not be compiled
    assert growth.no_growth_by_series(model, run, last_index(model, sv.methods.Taylor()))


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
