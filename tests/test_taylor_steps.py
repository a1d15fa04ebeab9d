"""Steps of the Taylor method: their length, compiled and interpreted alike, and jets within them."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

import servoctl as sv
from servoctl.codegen import emit
from servoctl.codegen.interpreted import rough_log2
from servoctl.gallery import gallery
from servoctl.methods.independent import in_independent
from servoctl.methods.taylor import TaylorSteps, series_loop, taylor_coefficients
from servoctl.model.variants import without_choice
from servoctl.simulation import simulated


def test_the_logarithm_of_steps_is_within_a_hundredth():
    numbers = np.geomspace(1e-300, 1e300, 20_001)
    assert np.abs(rough_log2(numbers) - np.log2(numbers)).max() < 0.01
    assert rough_log2(0.0) == -1023 and rough_log2(np.inf) == 1024 and rough_log2(np.nan) > 1024


@pytest.mark.parametrize("order", [4, 5, 9, 12, 13, 20])
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_coefficient_that_vanishes_does_not_lengthen_the_step(order, speed, oscillator):
    """At the turning point of x'' = -x every odd coefficient vanishes, where it passes zero every even one."""
    f, x0 = series_loop(oscillator, order + 1), oscillator.start(x=1.0 - speed, dx=speed).values
    log = f.taylor(0.0, x0, 10.0, np.append(oscillator.p, 5.0), 1e-8, 1e-8, 10_000)
    t, x = log[:, 0], log[:, 1]
    assert t[-1] == 10.0 and np.abs(x - (np.cos(t) * (1.0 - speed) + np.sin(t) * speed)).max() < 1e-6
    assert t[1] < 1.3 * np.diff(t)[1:-1].max()


@pytest.fixture(scope="module")
def oscillator():
    """x'' = -x, and y that is held."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=x**2 / 2)
    return sv.derive(mechanism, sv.Program({"held": y}, by="ideal"), keep=["x"])


@pytest.mark.parametrize("unlike", [False, True])
@pytest.mark.parametrize("name", ["appell-hamel", "wheeled-robot"])
@pytest.mark.parametrize("span", [(0.0, 0.5), (0.5, 0.0)])
def test_compiled_and_interpreted_steps_are_the_same(name, span, unlike, gallery_model, c_compiler):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(t=span[0], **scene.start, guess=scene.guess)
    f, top = series_loop(model, 11), model.reduction.top
    p = np.append(model.p, 0.25)
    atol = np.geomspace(1e-9, 1e-13, len(start.values)) if unlike else 1e-9
    log = f.taylor(span[0], start.values, span[1], p, 1e-7, atol, 100)
    f._place(f._interpreter, span[0], start.values, p)
    weights = atol.min() / atol if unlike else None
    ends = np.array([span[1]])
    again = f._interpreter.taylor(ends, 1e-7, atol.min() if unlike else atol, 0, 100, weights)
    n_x = len(start.values)
    np.testing.assert_allclose(again[:, : 1 + n_x], log[:, : 1 + n_x], rtol=1e-11, atol=1e-11)
    t = np.linspace(*span, 41)
    k = np.clip(np.searchsorted(abs(log[:, 0] - span[0]), abs(t - span[0]), "right") - 1, 0, len(log) - 2)
    z, other = f.jets(log, k, t, p, top + 2), np.empty((model.nq + (top + 2) * model.n, 41))
    f._interpreter.jets(log, k, t, p, (top + 2, 0), other)
    np.testing.assert_allclose(z, other, rtol=1e-12, atol=1e-12 * np.abs(other).max())
    ends = f.jets(log, np.arange(len(log) - 1), log[1:, 0], p, top, by_rows=True)[:n_x]
    np.testing.assert_allclose(ends, log[1:, 1 : 1 + n_x].T, rtol=1e-12, atol=1e-12)


def test_the_accuracy_of_steps_follows_the_tolerance(gallery_model):
    """Errors at the end, relative to the state: at most the tolerance on these scenes, and not a millionth of it."""
    for name in ("appell-hamel", "wheeled-robot"):
        scene, model = gallery[name], gallery_model(name)
        start = model.start(**scene.start, guess=scene.guess)

        def end(rtol, order=None, model=model, start=start):
            method = sv.methods.Taylor(order, rtol=rtol, atol=rtol)
            return simulated(model, start, (0.0, 1.0), method, t_eval=[1.0]).jets[: len(start.values), -1]

        exact = end(1e-15, 20)
        for rtol in (1e-4, 1e-6, 1e-8):
            error = np.abs(end(rtol) - exact).max() / max(1.0, np.abs(exact).max())
            assert 1e-6 * rtol < error < rtol


# rates that rows determine --------------------------------------------------------------------------------------------


def trailer():
    """A car with a trailer, its speed and its turning as programs: rows of order 1 determine all velocities."""
    q = sv.coordinates("x y theta alpha")
    (x, y, theta, alpha), (dx, dy, dtheta, _) = q, q.d(1)
    p = sv.parameters(m=10.0, M=5.0, I=1.0, J=0.7, L=1.2)
    behind = x - p.L * ca.cos(alpha), y - p.L * ca.sin(alpha)
    S = sv.particle(q, p.m, (x, y)) + sv.particle(q, p.M, behind) + p.I * q.d(2)[2] ** 2 / 2 + p.J * q.d(2)[3] ** 2 / 2
    wheels = {
        "car": dy * ca.cos(theta) - dx * ca.sin(theta),
        "trailer": q.dt(behind[1]) * ca.cos(alpha) - q.dt(behind[0]) * ca.sin(alpha),
    }
    program = {"speed": dx * ca.cos(theta) + dy * ca.sin(theta) - 1.0, "turn": dtheta - 0.5 * ca.sin(q.t)}
    model = sv.derive(sv.Mechanism(q, gibbs=S, parameters=p, constraints=wheels), sv.Program(program, by="ideal"))
    return model, model.start(x=0.0, y=0.0, theta=0.1, alpha=0.3)


def sled():
    """A blade that turns through all directions: the entries of its row vanish in turn."""
    q = sv.coordinates("x y theta")
    (x, y, theta), (dx, dy, dtheta) = q, q.d(1)
    p = sv.parameters(m=2.0, I=0.3)
    S = sv.particle(q, p.m, (x, y)) + p.I * q.d(2)[2] ** 2 / 2
    blade = {"blade": dy * ca.cos(theta) - dx * ca.sin(theta)}
    mechanism = sv.Mechanism(q, gibbs=S, potential=2 * p.m * x, parameters=p, constraints=blade)
    model = sv.derive(mechanism, sv.Program({"turn": dtheta - 1.0}, by="ideal"))
    return model, model.start(x=0.0, y=0.0, theta=0.1, dx=1.0)


def driven():
    """A row that depends on time, of particles on springs."""
    q = sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    p = sv.parameters(m=1.0, k=4.0, c=0.7)
    row = {"drive": dx - p.c * ca.sin(3 * q.t) * dy - ca.cos(q.t)}
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, (x, y)), potential=p.k * (x**2 + y**2) / 2, parameters=p)
    model = sv.derive(mechanism, sv.Program(row, by="ideal"))
    return model, model.start(x=0.1, y=0.2, dy=1.0)


def bead():
    """A bead on a circle, given by its position, that moves a driven mass: a row of order 0, and a change of pivots."""
    q = sv.coordinates("x y s")
    (x, y, s), p = q, sv.parameters(m=1.0, l=1.0)
    S = sv.particle(q, p.m, (x, y)) + q.d(2)[2] ** 2 / 2
    rod = {"rod": x**2 + y**2 - p.l**2}
    potential = 9.81 * p.m * y + 2 * s**2 + x * s
    mechanism = sv.Mechanism(q, gibbs=S, potential=potential, parameters=p, constraints=rod)
    model = sv.derive(mechanism, sv.Program({"drive": q.d(1)[2] - 0.3 * ca.cos(q.t)}, by="ideal"))
    return model, model.start(x=0.6, s=0.1, dx=0.5, guess={"y": -0.8})


def disc(by_hand):
    """A disc that rolls down a slope; by hand its rolling is a choice of quasi-velocities."""
    q, p = sv.coordinates("x y psi phi"), sv.parameters(m=1.0, R=0.5, I=0.2, J=0.125)
    x, y, psi, _ = q
    if by_hand:
        V = [[0, p.R * ca.cos(psi)], [0, p.R * ca.sin(psi)], [1, 0], [0, 1]]
        q = q.with_quasi_velocities("w_psi w_phi", V)
        turn, (dw_psi, dw_phi) = q.w(0)[0], q.w(1)
        S, rolling = (p.I * dw_psi**2 + (p.J + p.m * p.R**2) * dw_phi**2) / 2, {}
        velocities = {"w_phi": 1.5}
    else:
        dx, dy, turn, dphi = q.d(1)
        S = sv.particle(q, p.m, (x, y)) + p.I * q.d(2)[2] ** 2 / 2 + p.J * q.d(2)[3] ** 2 / 2
        rolling = {"along": dx - p.R * dphi * ca.cos(psi), "across": dy - p.R * dphi * ca.sin(psi)}
        velocities = {"dphi": 1.5}
    mechanism = sv.Mechanism(q, gibbs=S, potential=-p.m * x, parameters=p, constraints=rolling)
    model = sv.derive(mechanism, sv.Program({"turn": turn - 0.8}, by="ideal"))
    return model, model.start(x=0.0, y=0.0, psi=0.2, phi=0.0, **velocities)


def disc_as_given():
    return disc(by_hand=False)


def appell_hamel():
    """The mechanism of the gallery while its wheel turns."""
    model = sv.derive(*gallery["appell-hamel"].build())
    return model, model.start(x=0.0, y=0.0, phi=0.0, theta=0.3, dphi=1.0, dtheta=0.5)


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("scene", [trailer, sled, driven, bead])
def test_rates_that_rows_determine_satisfy_them_to_rounding(scene, rtol=1e-7):
    model, start = scene()
    t = np.linspace(0.0, 2.5, 23)
    run = simulated(model, start, (0.0, 2.5), sv.methods.Taylor(rtol=rtol, atol=rtol), t_eval=t)
    exact = simulated(model, start, (0.0, 2.5), sv.methods.Adaptive("DOP853", rtol=1e-12, atol=1e-13), t_eval=t)
    n_x = len(start.values)
    size = np.abs(exact.jets[:n_x]).max()
    np.testing.assert_allclose(run.jets[:n_x], exact.jets[:n_x], rtol=0.0, atol=10 * rtol * size)
    for name, row in model.reduction.original.items():
        first = 1 if row.order == 0 else 0  # positions are integrated, and their rates follow from the row with them
        left = np.abs(run.residual[name][first:]).max()
        by_rows = first == 0 and not run.counters.get("pivot_changes")  # pivots of definite matrices determine no rates
        assert left < (1e-13 if by_rows else 10 * rtol) * max(1.0, np.abs(run.jets).max()), name


def test_a_mechanism_as_given_takes_the_steps_of_one_reduced_by_hand():
    """Rates that rows determine neither drift nor set the length of steps."""
    steps, ends = [], []
    for by_hand in (False, True):
        model, start = disc(by_hand)
        run = simulated(model, start, (0.0, 8.0), sv.methods.Taylor(12, rtol=1e-8, atol=1e-8), t_eval=[8.0])
        steps.append(run.counters["steps"])
        ends.append([run[name][-1] for name in ("x", "y", "psi", "phi")])
    assert steps[0] <= steps[1]
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-7)


def pinned():
    """A bar by the place of its centre and its angle, on a pin, beside a cart whose speed is prescribed."""
    q, p = sv.coordinates("x y theta s"), sv.parameters(m=2.0, l=0.7, I=0.1, k=3.0)
    x, y, theta, s = q
    S = sv.particle(q, p.m, (x, y)) + p.I * q.d(2)[2] ** 2 / 2 + q.d(2)[3] ** 2 / 2
    pin = {"across": x - s - p.l * ca.sin(theta), "down": y + p.l * ca.cos(theta)}
    potential = 9.81 * p.m * y + p.k * theta**2 / 2
    mechanism = sv.Mechanism(q, gibbs=S, potential=potential, parameters=p, constraints=pin)
    model = sv.derive(mechanism, sv.Program({"speed": q.d(1)[3] - 0.4}, by="ideal"))
    return model, model.start(theta=0.4, s=0.0, dtheta=1.0, guess={"x": 0.3, "y": -0.6})


@pytest.mark.parametrize("scene", [appell_hamel, disc_as_given, pinned])
def test_balances_in_independent_velocities_give_the_same_series_by_fewer_products(scene, monkeypatch):
    model, start = scene()
    e, p = model.equations, np.append(model.parameters, 0.25)
    few = taylor_coefficients(e, 12)
    assert in_independent(e) is not None
    monkeypatch.setattr("servoctl.methods.taylor.in_independent", lambda equations: None)
    many = taylor_coefficients(e, 12)
    assert emit.operations(few) < 0.85 * emit.operations(many)
    determined = 1 - np.array(series_loop(model, 12).sizes["free"])
    off = np.append(np.zeros(model.nq), 0.1 * determined)  # what rows determine plays no part, whatever the state says
    exact, found = (np.array(f(0.0, start.values + off, p)).ravel() for f in (many, few))
    first = model.nq * 12 * (not model.reduction.mechanism.q.plain)
    gamma = [np.reshape(y[first : first + 12 * model.n], (12, model.n)) for y in (exact, found)]
    np.testing.assert_allclose(gamma[1], gamma[0], rtol=0, atol=1e-13 * np.abs(gamma[0]).max())
    np.testing.assert_allclose(found, exact, rtol=1e-10, atol=1e-12)


def test_balances_stay_as_given_where_nothing_is_gained_or_no_pivots_are_chosen(gallery_model):
    assert in_independent(gallery_model("mass-on-car").equations) is None
    model, _ = appell_hamel()
    assert in_independent(without_choice(model).equations) is None


def test_a_motion_without_change_takes_one_step():
    """All coefficients vanish but that of the speed, for 1e9 s."""
    q = sv.coordinates("x y")
    x, y = q
    program = sv.Program({"rest": y}, by="ideal")
    model = sv.derive(sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y))), program, keep=["x"])
    run = simulated(model, model.start(x=0.0, dx=2.0), (0.0, 1e9), sv.methods.Taylor(8, rtol=1e-6), t_eval=[1e9])
    assert run.counters["steps"] == 1 and run["x"][-1] == 2e9


def test_what_rates_do_between_states_is_seen():
    """A pulse in a rate that the program prescribes, 0.05 s wide, at an instant far from the start."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=0.5 * y**2)
    speed = 1.0 + ca.exp(-((20 * (q.t - 3.0)) ** 2))
    model = sv.derive(mechanism, sv.Program({"speed": q.d(1)[0] - speed}, by="ideal"), keep=["y"])
    method = sv.methods.Taylor(rtol=1e-9, atol=1e-9)
    run = simulated(model, model.start(x=0.0, y=1.0, dy=0.0), (0.0, 6.0), method, t_eval=[6.0])
    assert run["x"][-1] == pytest.approx(6.0 + np.sqrt(np.pi) / 20, abs=1e-7)


@pytest.mark.parametrize("scene", [trailer, sled])
def test_interpreted_samples_satisfy_the_rows(scene, c_compiler):
    model, start = scene()
    f, top, p = series_loop(model, 12), model.reduction.top, np.append(model.parameters, 0.5)
    log = f.taylor(0.0, start.values, 1.0, p, 1e-6, 1e-6, 100)
    k, t, n_x = np.zeros(5, dtype=int), np.linspace(0.0, log[1, 0], 5), len(start.values)
    z, other = f.jets(log, k, t, p, top + 1, by_rows=True), np.empty((model.nq + (top + 1) * model.n, 5))
    f._interpreter.jets(log, k, t, p, (top + 1, n_x + model.n), other)
    np.testing.assert_allclose(z, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("span", [(0.0, 6.0), (6.0, 0.0)], ids=str)
def test_matrices_have_the_velocities_that_rows_determine(span):
    """A skate of given speed: dy = a(t, z) dx. The gradient 2 (dx, dy) of the row of the speed has this dy.

    Then s = ∫ dx = ∫ v / sqrt(1 + a²) in quadrature, and series do not depend on the dy of the state.
    """
    q = sv.coordinates("x y z")
    z, (dx, dy, _) = q["z"], q.d(1)
    mechanism = sv.Mechanism(
        q, gibbs=sum(a**2 for a in q.d(2)) / 2, potential=z**2 / 2, constraints={"skate": dy - ca.sin(z + q.t) * dx}
    )
    model = sv.derive(mechanism, sv.Program({"speed": dx**2 + dy**2 - 4.0}, by="ideal"), guess={"dx": 1.5, "dy": 1.0})
    start = model.start(t=span[0], x=0.0, y=0.0, z=0.4, dz=0.0, guess={"dx": 1.5})
    run = sv.simulate(model, start, span, t_eval=np.linspace(*span, 50))
    assert run.method == "Taylor"
    assert run["dx"] ** 2 * (1 + np.sin(run["z"] + run.t) ** 2) == pytest.approx(4.0, abs=1e-8)
    assert run["z"] == pytest.approx(0.4 * np.cos(run.t - span[0]), abs=1e-8)
    speed = lambda t, _: [2 / np.sqrt(1 + np.sin(0.4 * np.cos(t - span[0]) + t) ** 2)]  # noqa: E731
    exact = solve_ivp(speed, span, [0.0], rtol=1e-11, atol=1e-12)
    assert run["x"][-1] == pytest.approx(exact.y[0, -1], abs=1e-8)
    f, p, state = series_loop(model, 8), np.append(model.p, 3.0), start.values
    assert f.others, "no velocity is determined by rows"
    moved = state.copy()
    moved[f.sizes["nq"] :] += 0.1 * (1 - np.array(f.sizes["free"]))
    assert f(span[0], moved, p) == pytest.approx(f(span[0], state, p), rel=1e-13, abs=1e-13)
    assert f.others["settled"](span[0], moved, p) == pytest.approx(f.others["settled"](span[0], state, p))


ONE_CALL = {  # scene, span, samples
    "wheel": ("appell-hamel", None, None),
    "backwards": ("appell-hamel", (2.0, 0.0), None),
    "few samples, backwards": ("appell-hamel", (2.0, 0.0), [0.5, 1.0, 1.5]),
    "one sample": ("appell-hamel", (0.0, 2.0), [1.0]),
    "no row determines velocities": ("pendubot", None, None),
    "a knot": ("passive-arm", None, None),
    "a knot, backwards": ("double-pendulum", (5.0, 3.0), None),
    "to a knot": ("double-pendulum", (0.0, 4.0), None),
    "few samples beside a knot": ("ball-and-beam", None, [0.25, 0.5, 1.5]),
}


@pytest.mark.usefixtures("c_compiler")
@pytest.mark.parametrize("case", ONE_CALL)
def test_a_motion_in_one_call_is_that_by_inspected_steps(case, gallery_model, monkeypatch):
    name, span, times = ONE_CALL[case]
    model, scene, calls = gallery_model(name), gallery[name], []
    span = scene.t_span if span is None else span
    start = model.start(t=span[0], **scene.start, guess=scene.guess)
    real = TaylorSteps._in_one_call
    monkeypatch.setattr(TaylorSteps, "_in_one_call", lambda *a: calls.append(real(*a)) or calls[-1])
    whole = sv.simulate(model, start, span, "Taylor", t_eval=times)
    monkeypatch.setattr(TaylorSteps, "_in_one_call", lambda *a: False)
    inspected = sv.simulate(model, start, span, "Taylor", t_eval=times)
    assert calls and all(calls)
    assert np.array_equal(whole.t, inspected.t) and np.array_equal(whole.jets, inspected.jets)
    assert whole == inspected and whole.counters == inspected.counters and whole.internal == inspected.internal


@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize("natural", [True, False])
def test_one_call_over_many_knots_has_the_bits_of_a_call_for_each_piece(forward, natural, c_compiler):
    q = sv.coordinates("x theta")
    x, theta = q
    bob = (x + ca.sin(theta), -ca.cos(theta))
    gibbs = sv.particle(q, 2.0, (x, 0.0)) + sv.particle(q, 0.5, bob)
    machine = sv.Mechanism(q, gibbs=gibbs, potential=4.9 * bob[1], actuators={"F": x})
    knots = np.linspace(0.0, 6.0, 60 if natural else 300)
    path = sv.paths.spline(knots, np.sin(knots), smoothness=3, ends="natural" if natural else "rest")
    model = sv.derive(machine, sv.Program({"X": x - q.references(X=path).X}, by="actuators"))
    ends = knots[(knots > 1.0) & (knots < 4.0)].tolist()
    ends = [*ends, 4.0] if forward else [*ends[::-1], 1.0]
    t = first = 1.0 if forward else 4.0
    start, f, top = model.start(t=first, theta=0.1, dtheta=0.0).values, series_loop(model, 11), model.reduction.top
    p, state, rows = np.append(model.p, np.nan), start, []
    for end in ends:
        piece = f.taylor(t, state, end, p, 1e-8, 1e-9, 100)
        rows, t, state = [*rows, *piece[:-1]], end, piece[-1, 1 : 1 + start.size]
    at_once = f.taylor(first, start, ends, p, 1e-8, 1e-9, 10_000)
    np.testing.assert_array_equal(at_once[:-1], rows)
    np.testing.assert_array_equal(at_once[-1, : 1 + start.size], [t, *state])
    f._place(f._interpreter, first, start, p)
    again = f._interpreter.taylor(np.array(ends), 1e-8, 1e-9, 0, 10_000)
    np.testing.assert_allclose(again[:, : 1 + start.size], at_once[:, : 1 + start.size], rtol=1e-10, atol=1e-10)
    k = np.arange(len(rows))
    middle = (at_once[1:, 0] + at_once[:-1, 0]) / 2
    expected = f.jets(at_once, k, middle, p, top, by_rows=True)
    compared = np.empty_like(expected)
    f._interpreter.jets(at_once, k, middle, p, (top, start.size + model.n), compared)
    np.testing.assert_allclose(compared, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize(("samples", "span"), [(300, (0.0, 6.0)), (30, (5.9, 0.3))])
def test_a_robot_that_turns_at_measured_rates_has_their_integral(samples, span, c_compiler):
    """Velocities that rows determine, on both sides of knots: theta' is the spline, and theta its antiderivative."""
    q = sv.coordinates("x y theta")
    (x, y, theta), (dx, dy, dtheta) = q, q.d(1)
    times = np.linspace(0.0, 6.0, samples)
    rates = 0.4 * np.sin(2.0 * times) + 0.2
    turn = q.references(turn=sv.paths.spline(times, rates, smoothness=3, ends="natural")).turn
    S = sv.particle(q, 2.0, (x, y)) + 0.3 * q.d(2)[2] ** 2 / 2
    wheel = {"wheel": dy * ca.cos(theta) - dx * ca.sin(theta)}
    program = {"speed": dx * ca.cos(theta) + dy * ca.sin(theta) - 1.0, "turn": dtheta - turn}
    model = sv.derive(sv.Mechanism(q, gibbs=S, constraints=wheel), sv.Program(program, by="ideal"))
    start = model.start(t=span[0], x=0.0, y=0.0, theta=0.1)
    t_eval = np.unique(np.concatenate([np.linspace(*sorted(span), 41), times[(times > 0.3) & (times < 5.9)]]))
    run = sv.simulate(model, start, span, sv.methods.Taylor(rtol=1e-10), t_eval=t_eval[:: 1 if span[0] < span[1] else -1])
    curve = make_interp_spline(times, rates[:, None], k=5, bc_type=([(3, [0.0]), (4, [0.0])],) * 2)
    angle = curve.antiderivative()
    heading = 0.1 + angle(run.t)[:, 0] - angle(span[0])[0]
    assert run.status == 0 and sv.verify(run).passed
    np.testing.assert_allclose(run["theta"], heading, atol=1e-9)
    np.testing.assert_allclose(run["dtheta"], curve(run.t)[:, 0], atol=1e-12)
    np.testing.assert_allclose(run["dx"], np.cos(heading), atol=1e-9)
    np.testing.assert_allclose(run["d2theta"], curve(run.t, nu=1)[:, 0], atol=1e-10)
    middle = float(heading.min() + heading.max()) / 2
    ends = sv.Event("theta", middle, terminal=True)
    ended = sv.simulate(model, start, span, sv.methods.Taylor(rtol=1e-10), events=ends)
    reached = 0.1 + angle(ended.t[-1])[0] - angle(span[0])[0]
    assert ended["theta"][-1] == pytest.approx(middle, abs=1e-9) and reached == pytest.approx(middle, abs=1e-9)
