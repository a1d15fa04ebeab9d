"""Bounds of steps and of sampled feedback: the table of the theory, simulated loops, measured divergence."""

import re
import warnings
from math import comb, factorial

import casadi as ca
import numpy as np
import pytest
from refusals import refused, warned

import servoctl as sv
from servoctl.gallery import mass_on_car
from servoctl.methods import stability as bounds
from servoctl.methods.accuracy import motion_error
from servoctl.methods.choice import ORDERS, as_method


@pytest.mark.parametrize(
    ("delay", "table"),
    [(0, {1: 2.0, 2: 1.0, 3: 0.6752, 4: 0.5111, 5: 0.4116}), (1, {1: 1.0, 2: 0.4262, 3: 0.2703, 4: 0.1979, 5: 0.1561})],
)
def test_sampled_bounds_are_those_of_the_table(delay, table):
    found = {rho: sv.sampled_bound(rho, delay) for rho in table}
    assert found == pytest.approx(table, abs=5.1e-5)


def sampled_loop(rho, delay, p):
    """Spectral radius of the chain of integrators under held state feedback, h = 1, from its matrices."""
    A = np.array([[1.0 / factorial(j - i) if j >= i else 0.0 for j in range(rho)] for i in range(rho)])
    B = np.array([1.0 / factorial(rho - i) for i in range(rho)])
    K = np.array([comb(rho, k) * p ** (rho - k) for k in range(rho)])
    F = np.zeros((rho * (delay + 1),) * 2)
    F[:rho, :rho] = A
    F[:rho, rho * delay :] -= np.outer(B, K)
    F[rho:, :-rho] += np.eye(rho * delay) if delay else 0.0
    return np.abs(np.linalg.eigvals(F)).max()


@pytest.mark.parametrize("delay", [0, 1, 2, 5])
@pytest.mark.parametrize("rho", [1, 2, 3, 4, 6])
def test_a_sampled_loop_is_stable_below_the_bound_and_unstable_above(rho, delay):
    bound = sv.sampled_bound(rho, delay)
    assert sampled_loop(rho, delay, 0.999 * bound) < 1 < sampled_loop(rho, delay, 1.001 * bound)


@pytest.mark.parametrize("given", [{"rho": 0}, {"rho": 2.0}, {"rho": 13}, {"rho": 2, "delay": -1}])
def test_a_bound_of_something_else_is_refused(given):
    with refused(sv.errors.SpecificationError, f"{list(given)[-1]}={list(given.values())[-1]}"):
        sv.sampled_bound(**given)


REAL_LIMITS = {"RK4": 2.785293563405, "RK45": 3.306567892635}


@pytest.mark.parametrize("method", REAL_LIMITS)
def test_real_limits_are_the_known_ones(method):
    assert bounds.largest_explicit(method) == pytest.approx(REAL_LIMITS[method], rel=1e-11)


def test_imaginary_limits_are_the_known_ones():
    limits = {method: bounds.largest_explicit(method, None, np.pi / 2) for method in ("RK4", "RK45")}
    assert limits["RK4"] == pytest.approx(np.sqrt(8), abs=1e-9) and 0 < limits["RK45"] < 1


@pytest.mark.parametrize("direction", [np.pi, 0.75 * np.pi, 0.5 * np.pi])
def test_no_step_of_radau_amplifies_what_decays(direction):
    assert bounds.largest_explicit("Radau", None, direction) == np.inf
    for order in (1, 5, 9, 13):
        assert bounds.largest_explicit("RadauIIA", order, direction) == np.inf


def test_radau_has_its_known_fraction():
    above, below = bounds.stability_function("Radau")
    assert above == pytest.approx([1, 2 / 5, 1 / 20])
    assert below == pytest.approx([1, -3 / 5, 3 / 20, -1 / 60])


@pytest.mark.parametrize("method", [*ORDERS, "Taylor", "RadauIIA"])
def test_the_stability_function_is_the_exponential_to_the_order(method):
    order = {"Taylor": 9, "RadauIIA": 9}.get(method)
    above, below = bounds.stability_function(method, order)
    order = order or ORDERS[method]
    exponential = np.array([1 / factorial(k) for k in range(order + 2)])
    product = np.convolve(exponential, below)[: order + 2]
    difference = np.abs(product - np.pad(above, (0, 20))[: order + 2])
    assert difference[: order + 1].max() < 1e-14
    assert difference[order + 1] > 1e-12  # and no further


def test_multistep_methods_and_idle_orders_are_refused():
    with refused(sv.errors.NameUnknown, name="LSODA"):
        bounds.stability_function("LSODA")
    with refused(sv.errors.SpecificationError, "order", "Taylor"):
        bounds.stability_function("Taylor")
    for given in (("RK4", 4), ("RadauIIA", 4), ("RadauIIA", None), ("Taylor", 0)):
        with refused(sv.errors.SpecificationError, "order"):
            bounds.stability_function(*given)


@pytest.fixture(scope="module")
def sine():
    """A particle whose program is x = sin t, raised twice."""
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, x))
    return sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}, by="ideal"))


def sine_error(model, pole, method="RK4"):
    run = sv.simulate(model, model.start(), (0.0, 100.0), as_method(method, step=0.05), drift=1 / pole)
    return np.abs(run["x"] - np.sin(run.t)).max()


@pytest.mark.filterwarnings("ignore:Steps of:RuntimeWarning")
@pytest.mark.parametrize("method", ORDERS)
def test_poles_diverge_in_simulation_where_the_bound_says(sine, method):
    fastest = bounds.largest_explicit(method) / 0.05
    assert sine_error(sine, 0.98 * fastest, method) < 1.0
    assert not sine_error(sine, 1.02 * fastest, method) < 1e6


def test_a_choice_beyond_the_bound_is_warned_about_with_its_number(sine):
    with warned("'X'", "-60 1/s", "= 3 ", "2.785", "0.04642 s") as caught:
        assert sine_error(sine, 60.0) > 1e6
    assert caught[0].filename == __file__


def test_a_choice_beyond_the_bound_is_warned_about_backwards_in_time(sine):
    with warned(" 60 1/s", "= 3 ", "2.785"):
        sv.simulate(sine, sine.start(), (0.0, -1.0), sv.methods.RungeKutta(4, step=0.05), drift=sv.methods.Poles({"X": [60.0, 60.0]}))


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_poles_that_ask_for_a_hundred_thousand_adaptive_steps_are_warned_about(sine, direction):
    """DOP853 is stable for steps of 6.4 over the pole: 1.6e6 of them in a second at 1e7 1/s."""
    fast, slow = (sv.methods.Poles({"X": [-direction * rate] * 2}) for rate in (1e7, 10.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sv.simulate(sine, sine.start(), (0.0, direction), "DOP853", drift=slow)
        with refused(RuntimeWarning, "'X'", "DOP853", "2e+06 steps"):
            sv.simulate(sine, sine.start(), (0.0, direction), "DOP853", drift=fast)


def test_complex_poles_are_judged_in_their_own_direction(sine):
    pair = {"X": [-20 + 45j, -20 - 45j]}  # |λ|h = 2.46, where the limit along this ray is 2.79
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sv.simulate(sine, sine.start(), (0.0, 1.0), sv.methods.RungeKutta(4, step=0.05), drift=sv.methods.Poles(pair))
    with warned("RK4"):
        sv.simulate(sine, sine.start(), (0.0, 1.0), sv.methods.RungeKutta(4, step=0.06), drift=sv.methods.Poles(pair))


def test_no_choice_within_the_bound_is_warned_about(sine):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sine_error(sine, 45.0) < 1e-2
        warnings.filterwarnings("ignore", "Steps of .* do not resolve")  # dx is off by 28 times its size
        assert sine_error(sine, 55.0) < 1.0


@pytest.mark.parametrize(("method", "step"), [("RK4", 0.05), ("RK8", 0.1), ("RK4", 0.02)])
def test_steps_too_long_for_the_internal_dynamics_are_warned_about(method, step, c_compiler):
    model = sv.derive(*mass_on_car(damping=1000.0))
    start = model.start(s=0.0, ds=0.0)
    largest = sv.stability(model, sv.simulate(model, start, (0.0, 1.0), method="RadauIIA")).largest_step(method)
    with warned(f"{step:g} s", method, "resolve") as caught:
        sv.simulate(model, start, (0.0, 1.0), method=as_method(method, step=step))
    bound = float(re.search(r"largest stable step there is about (\S+) s", str(caught[0].message))[1])
    assert bound == pytest.approx(largest, rel=0.05)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sv.simulate(model, start, (0.0, 1.0), method=as_method(method, step=0.9 * largest))


def test_stable_steps_that_do_not_resolve_the_motion_are_warned_about(c_compiler):
    """Radau IIA of order 5 is stable with any step; steps of 3 s are wrong by six times the motion."""
    model, span = sv.derive(*mass_on_car()), (0.0, 6.0)
    exact = sv.simulate(model, model.start(), span, accuracy=1e-9)

    def error(step):
        run = sv.simulate(model, model.start(), span, method=sv.methods.RadauIIA(order=5, step=step))
        assert run.counters["steps"] == 6.0 / step
        return motion_error(model, run.jets, exact.jets)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert error(0.5) < 0.01
    with warned("3 s", "RadauIIA", "resolve") as caught:
        assert error(3.0) > 1.0
    assert "stable" not in str(caught[0].message) and caught[0].filename == __file__


def test_steps_that_do_not_resolve_the_motion_before_a_knot_are_warned_about():
    """The path ends at 3 s: the mass at rest behind it does not tell what went before."""
    model, span = sv.derive(*mass_on_car(damping=10.0)), (0.0, 6.0)
    start = model.start(s=0.0, ds=0.0)
    with warned("RK4", "resolve"):
        sv.simulate(model, start, span, method=sv.methods.RungeKutta(4, step=0.3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sv.simulate(model, start, span, method=sv.methods.RungeKutta(4, step=0.15))


def test_steps_over_a_singularity_end_there():
    """A point on a circle follows x = t, which ends at t = 1 s; long explicit steps do not jump over that."""
    q = sv.coordinates("s x y")
    s, x, y = q
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, 1.0, (x, y)) + sv.particle(q, 2.0, (s,)),
        actuators={"pull": x},
        constraints={"circle": x**2 + y**2 - 1.0},
    )
    model = sv.derive(mechanism, sv.Program({"path": x - q.t}), guess={"y": -1.0}, keep=["s"])
    start = model.start(s=0.0, ds=1.0, guess={"y": -1.0})
    for drift in (None, 0.5, "project"):
        with refused(sv.errors.SingularProgram, rows=["path", "circle"]) as caught:
            sv.simulate(model, start, (0.0, 1.5), method=sv.methods.RungeKutta(4, step=0.3), drift=drift)
        assert caught.value.details["t"] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("step, span", [(None, 50.0), (0.05, 20.0)])
def test_fixed_steps_that_drift_off_the_program_are_warned_about(step, span):
    """A pendulum of 1 m as a circle that is kept by its second derivative alone."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=9.81 * y)
    model = sv.derive(mechanism, sv.Program({"rod": x**2 + y**2 - 1}, by="ideal"))
    start = model.start(x=1.0, y=0.0, dx=0.0, dy=0.0)
    with warned("'rod'", "drift='project'"):
        run = sv.simulate(model, start, (0.0, span), sv.methods.RungeKutta(4, step))
    assert np.abs(run.residual["rod"]).max() > 0.01
    kept = sv.simulate(model, start, (0.0, span), sv.methods.RungeKutta(4, step), drift="project")
    assert np.abs(kept.residual["rod"]).max() < 1e-12
