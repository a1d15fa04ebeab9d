"""The rank along motions: quiet steps, badly chosen pivots, and ranks that are lost."""

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.methods.bulk import BulkSteps
from servoctl.methods.choice import as_method
from servoctl.methods.lost_rank import singular
from servoctl.methods.pieces import DEFAULT, Tolerance
from servoctl.methods.rank import DEGRADED, Fine, Rank, Singular, Stretch, Weak


@pytest.fixture(scope="module")
def circle():
    """A particle kept on the unit circle."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)))
    return sv.derive(mechanism, sv.Program({"circle": x**2 + y**2 - 1.0}, by="ideal"))


def functions(model):
    """Pivots and γ'' at (t, X)."""
    f, p, n_x, n = model.function("ode"), model.p, len(model.state_names), model.n
    return lambda t, x: f(t, x, p)[n_x:], lambda t, x: f(t, x, p)[n_x - n : n_x]


def round_the_circle(t):
    return np.array([np.cos(t), np.sin(t), -np.sin(t), np.cos(t)])


def rank_from(model, t, x):
    return Rank(model, t, x, Tolerance(model, x, *DEFAULT))


def begun(model, t, x):
    rank = rank_from(model, t, x)
    rank.begin(model, t, functions(model)[0](t, x))
    return rank


def linear(t, x):
    """States between samples, linearly."""
    return lambda k, s: x[:, k] + (s - t[k]) / (t[k + 1] - t[k]) * (x[:, k + 1] - x[:, k])


def sampled(model, t, x, dense=None, **options):
    values = np.array([functions(model)[0](s, column) for s, column in zip(t[1:], x.T[1:], strict=True)]).T
    return Stretch(t, x, np.ones(1), values[:, :, None], dense or linear(t, x), **options)


def test_a_program_that_is_singular_at_its_start_says_by_how_much():
    """The actuator moves x by its lever sin(y - 0.4) alone, which is zero at the start."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={"f": (ca.sin(y - 0.4), 1.0)})
    model = sv.derive(mechanism, sv.Program({"a": x - 0.1 * q.t**2}), guess={"y": 0.4})
    state = np.zeros(len(model.state_names))
    state[model.state_names.index("y")] = 0.4
    rank = rank_from(model, 0.0, state)
    error = singular(rank, 0.0, state, "its lever is zero")
    assert rank.measure(0.0, state) < 1e-9 and error.details["measure"] < 1e-9
    assert "from the first instant on" in str(error) and "1.0e+00" not in str(error)


def test_quiet_steps_are_fine(circle):
    t = np.linspace(0.0, 0.7, 15)
    assert begun(circle, 0.0, round_the_circle(0.0)).inspect(sampled(circle, t, round_the_circle(t))) == Fine(14)
    none = Stretch(t[:1], round_the_circle(t[:1]), np.ones(1), np.zeros((1, 0, 1)), None)
    assert begun(circle, 0.0, round_the_circle(0.0)).inspect(none) == Fine(0)


@pytest.mark.parametrize("scene", ["overhead-crane", "appell-hamel"])
def test_a_motion_with_strong_pivots_decomposes_no_matrix(scene, gallery_model, monkeypatch):
    model, (start, guess) = gallery_model(scene), (gallery[scene].start, gallery[scene].guess)
    calls, real = [], Rank.along
    monkeypatch.setattr(Rank, "along", lambda *a: calls.append(a) or real(*a))
    run = sv.simulate(model, model.start(**start, guess=guess), gallery[scene].t_span)
    assert run.success and not calls
    start = run.t[0], run.jets[: len(model.state_names), 0]
    assert rank_from(model, *start).measure(*start) == pytest.approx(1.0) and calls


def test_what_was_inspected_in_two_parts_is_what_was_inspected_at_once(circle):
    t = np.linspace(0.0, 2.0, 201)
    rank = begun(circle, 0.0, round_the_circle(0.0))
    at_once = rank.inspect(sampled(circle, t, round_the_circle(t)))
    rank = begun(circle, 0.0, round_the_circle(0.0))
    assert rank.inspect(sampled(circle, t[:61], round_the_circle(t[:61]))) == Fine(60)
    later = rank.inspect(sampled(circle, t[60:], round_the_circle(t[60:])))
    assert isinstance(later, Weak) and (later.steps + 60, later.t) == (at_once.steps, at_once.t)


@pytest.mark.parametrize("crosses", [False, True])
def test_a_pivot_that_degrades_or_changes_its_sign_is_replaced(crosses, circle):
    fine = np.linspace(0.0, 2.0, 201)  # the pivot x degrades below 0.02 at t = 1.56
    outcome = begun(circle, 0.0, round_the_circle(0.0)).inspect(sampled(circle, fine, round_the_circle(fine)))
    assert isinstance(outcome, Weak) and outcome.steps == np.flatnonzero(fine == outcome.t)[0]
    assert fine[outcome.steps] == outcome.t == pytest.approx(np.pi / 2, abs=2 * DEGRADED)
    coarse = np.array([0.0, 1.2, 1.9, 2.6])
    x = round_the_circle(coarse)
    outcome = begun(circle, 0.0, x[:, 0]).inspect(sampled(circle, coarse, x, lambda k, s: round_the_circle(s), crosses=crosses))
    assert isinstance(outcome, Weak) and (outcome.steps, outcome.t) == ((2, 1.9) if crosses else (1, 1.2))
    np.testing.assert_array_equal(outcome.x, x[:, outcome.steps])


def test_a_lost_rank_is_singular_where_it_is_lost(gallery_model):
    """States of the linear program, which passes, seen by the squared one, which is singular where the wheel stops."""
    linear, squared = gallery_model("appell-hamel"), gallery_model("appell-hamel-squared")
    start = linear.start(dphi=1.0, dtheta=2.0, x=0.0, y=0.0, phi=0.0, theta=0.0)
    run = sv.simulate(linear, start, (0.0, 1.0), "Taylor", t_eval=np.linspace(0.0, 1.0, 101))
    names = list(squared.state_names)
    x, order = np.array([run[name] for name in names]), [linear.state_names.index(name) for name in names]
    outcome = begun(squared, 0.0, x[:, 0]).inspect(sampled(squared, run.t, x, lambda k, s: run.at(s)[: len(names)][order]))
    assert isinstance(outcome, Singular) and run.t[outcome.steps] <= outcome.t <= run.t[outcome.steps + 1]
    assert abs(outcome.t - cf.WHEEL_STOPS) < 1e-6
    assert abs(outcome.x[names.index("dphi")]) < 1e-2


OUTWARD = {  # angular speed of a bead, whose gradient falls as 1/r, and the same row with a further factor
    "speed 2": (lambda x, y, dx, dy: (x * dy - y * dx) / (x**2 + y**2) - 2.0, 2.0, 3.5),
    "speed 5": (lambda x, y, dx, dy: (x * dy - y * dx) / (x**2 + y**2) - 5.0, 5.0, 3.0),
    "over r²": (lambda x, y, dx, dy: ((x * dy - y * dx) / (x**2 + y**2) - 2.0) / (x**2 + y**2), 2.0, 1.8),
}


@pytest.mark.parametrize(
    ("row", "method"), [("speed 2", "DOP853"), ("speed 2", "RK8"), ("speed 5", "Taylor"), ("over r²", "RadauIIA")]
)
@pytest.mark.filterwarnings("ignore:Internal dynamics unstable")
def test_a_gradient_that_falls_along_the_motion_is_no_lost_rank(row, method):
    """r'' = w² r from r = 1 with r' = 1/2; the pivots change their signs at every half turn."""
    q = sv.coordinates("x y")
    residual, w, end = OUTWARD[row]
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(ca.vertcat(*q.d(2))) / 2)
    model = sv.derive(mechanism, sv.Program({"p": residual(*q, *q.d(1))}, by="ideal"))
    run = sv.simulate(model, model.start(x=1.0, y=0.0, dx=0.5), (0.0, end), method, t_eval=[0.0, end])
    radius = np.cosh(w * end) + 0.5 / w * np.sinh(w * end)
    assert np.hypot(run["x"], run["y"])[-1] == pytest.approx(radius, rel=1e-7)


def a_gradient_that_vanishes():
    """(x - 20) y' = cos t."""
    q = sv.coordinates("x y")
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(ca.vertcat(*q.d(2))) / 2)
    return sv.derive(mechanism, sv.Program({"p": (q.jet(0)[0] - 20.0) * q.jet(1)[1] - ca.cos(q.t)}, by="ideal"))


@pytest.mark.parametrize("method", ["DOP853", "Taylor", "RK8", "RadauIIA"])
def test_a_rank_that_is_lost_after_a_long_way_is_lost(method):
    """(x - 20) y' = cos t at x = 1 + 8 t: a gradient that falls to zero linearly, at 19/8 s."""
    model = a_gradient_that_vanishes()
    with pytest.raises(sv.errors.SingularProgram) as error:
        sv.simulate(model, model.start(x=1.0, y=0.0, dx=8.0), (0.0, 4.0), method)
    assert error.value.details["t"] == pytest.approx(19 / 8, abs=1e-3)


@pytest.mark.parametrize("method, distance", [("DOP853", 1e-3), ("Taylor", 0.1), ("RadauIIA", 1e-2)])
@pytest.mark.filterwarnings("ignore:Internal dynamics unstable")
def test_a_zero_of_a_pivot_next_to_a_singular_state_is_passed(method, distance):
    """s y' + ε z' = cos t with s = 8 t - 19: the entry of y' vanishes at 19/8 s, where the gradient is ε."""
    q = sv.coordinates("x y z")
    x, _, _ = q
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(ca.vertcat(*q.d(2))) / 2)
    _, dy, dz = q.d(1)
    program = sv.Program({"p": (x - 20.0) * dy + distance * dz - ca.cos(q.t)}, by="ideal")
    model = sv.derive(mechanism, program)
    start = model.start(x=1.0, y=0.0, z=0.0, dx=8.0, dz=0.3)
    run = sv.simulate(model, start, (0.0, 3.0), method, t_eval=[0.0, 3.0])

    def rates(t, v):
        gradient = np.array([8.0 * t - 19.0, distance])
        return -gradient * (np.sin(t) + 8.0 * v[0]) / (gradient @ gradient)

    ends = [run["dy"][0], run["dz"][0]]
    assert ends == pytest.approx([(0.3 * distance - 1.0) / 19.0, 0.3])
    true = solve_ivp(rates, (0.0, 3.0), ends, "Radau", rtol=1e-10, atol=1e-12).y[:, -1]
    assert [run["dy"][1], run["dz"][1]] == pytest.approx(true, rel=1e-5)


def test_steps_that_miss_the_equations_where_the_rank_is_lost_end_the_motion(monkeypatch):
    """Rounding of accelerations grows towards a singular state, where steps of any length then miss the equations."""
    model = a_gradient_that_vanishes()
    ordinary, tries = BulkSteps._doubted, []

    def doubted(self, stretch):
        if stretch.t[-1] < 19 / 8 - 1e-4:
            return ordinary(self, stretch)
        tries.append(stretch.t[1] - stretch.t[0])
        assert len(tries) < 40
        return 0, stretch.t[0] + tries[-1] / 10

    monkeypatch.setattr(BulkSteps, "_doubted", doubted)
    with pytest.raises(sv.errors.SingularProgram) as error:
        sv.simulate(model, model.start(x=1.0, y=0.0, dx=8.0), (0.0, 4.0), "DOP853")
    assert error.value.details["t"] == pytest.approx(19 / 8, abs=1e-3) and tries


def a_turn_at_low_speed(least):
    """A particle whose velocity is (t - 1, least): the gradient of its squared speed is least at 1 s."""
    q = sv.coordinates("x y")
    dx, dy = q.d(1)
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(ca.vertcat(*q.d(2))) / 2)
    rows = {"speed": dx**2 + dy**2 - least**2 - (q.t - 1.0) ** 2, "direction": least * dx - (q.t - 1.0) * dy}
    model = sv.derive(mechanism, sv.Program(rows, by="ideal"))
    return model, model.start(x=0.0, y=0.0, guess={"dx": -1.0, "dy": least})


@pytest.mark.parametrize("method", ["Taylor", "DOP853", "RadauIIA", "RK4"])
@pytest.mark.parametrize("least", [1e-2, 1e-3, 1e-4])
def test_a_gradient_that_nearly_vanishes_is_passed(least, method):
    model, start = a_turn_at_low_speed(least)
    run = sv.simulate(model, start, (0.0, 2.0), method, t_eval=np.linspace(0.0, 2.0, 21))
    velocity = np.array([run.t - 1.0, np.full(21, least)])
    np.testing.assert_allclose([run["dx"], run["dy"]], velocity, atol=1e-7)


@pytest.mark.parametrize("method", ["Taylor", "DOP853", "RadauIIA", "LSODA", "RK4"])
def test_a_gradient_that_vanishes_and_comes_back_is_lost(method):
    """The squared speed is (t - 1)²: beyond 1 s nothing says where the particle turns."""
    q = sv.coordinates("x y")
    dx, dy = q.d(1)
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(ca.vertcat(*q.d(2))) / 2)
    model = sv.derive(mechanism, sv.Program({"speed": dx**2 + dy**2 - (q.t - 1.0) ** 2}, by="ideal"))
    with pytest.raises(sv.errors.SingularProgram) as error:
        sv.simulate(model, model.start(x=0.0, y=0.0, dx=-1.0, dy=0.0), (0.0, 2.0), method)
    assert error.value.details["t"] == pytest.approx(1.0, abs=1e-5)


def arm_to_its_reach(gap, by_rates):
    """A 2R arm of links of 1 m whose tip comes as near as `gap` to the edge of its reach, at 1 s; and its start."""
    q = sv.coordinates("a b")
    (a, b), (da, db) = q, q.d(1)
    tip = ca.vertcat(ca.cos(a) + ca.cos(a + b), ca.sin(a) + ca.sin(a + b))
    elbow = ca.vertcat(ca.cos(a), ca.sin(a))
    gibbs = sv.particle(q, 1.0, elbow) + sv.particle(q, 1.0, tip)
    mechanism = sv.Mechanism(q, gibbs=gibbs, actuators={"u1": a, "u2": b})
    r, angle = 2.0 - gap - 0.3 * (q.t - 1.0) ** 2, 0.2 * q.t
    velocity = ca.jacobian(tip, ca.vertcat(a, b)) @ ca.vertcat(da, db)
    rates = {
        "radius": ca.dot(tip, velocity) + 0.6 * (q.t - 1.0) * r,
        "angle": tip[0] * velocity[1] - tip[1] * velocity[0] - 0.2 * ca.sumsqr(tip),
    }
    places = {"x": tip[0] - r * ca.cos(angle), "y": tip[1] - r * ca.sin(angle)}
    model = sv.derive(mechanism, sv.Program(rates if by_rates else places), guess={"a": -0.5, "b": 1.0})
    bent = np.arccos((1.7 - gap) ** 2 / 2.0 - 1.0)
    start = {"a": -bent / 2.0, "b": bent}
    return model, model.start(**start) if by_rates else model.start(guess=start), bent


REACHES = [(False, None, 1e-4), *((True, method, 1e-4) for method in ("Taylor", "DOP853", "RadauIIA", "LSODA"))]


@pytest.mark.parametrize(("by_rates", "method", "within"), REACHES)
def test_an_arm_that_nearly_reaches_its_edge_turns_and_one_beyond_it_ends_there(by_rates, method, within):
    method = method and as_method(method, rtol=1e-9, atol=1e-11)
    for gap in (1e-3, 1e-5, 1e-7):
        model, start, bent = arm_to_its_reach(gap, by_rates)
        assert sv.simulate(model, start, (0.0, 2.0), method, t_eval=[0.0, 2.0])["b"][-1] == pytest.approx(bent, abs=within)
    for gap in (-1e-6, -1e-3):
        model, start, _ = arm_to_its_reach(gap, by_rates)
        with pytest.raises(sv.errors.SingularProgram) as error:
            sv.simulate(model, start, (0.0, 2.0), method)
        assert error.value.details["t"] == pytest.approx(1.0 - np.sqrt(-gap / 0.3), abs=2e-6)


@pytest.mark.parametrize("method", ["Taylor", "DOP853", "RadauIIA"])
@pytest.mark.parametrize("knot", [1.0, 1.0 - 1e-7, 1.0 + 1e-7, 1.0 - 1e-3])
def test_a_zero_at_or_beside_the_end_of_a_step_is_located(knot, method):
    """(x - 1) y' = x - 1 + (x - 1)² at x = t: the gradient is zero at 1 s, and y' = x has a limit there."""
    q = sv.coordinates("x y")
    (x, _), (dx, dy) = q, q.d(1)
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(ca.vertcat(*q.d(2))) / 2)
    rows = {"pace": dx - 1.0, "row": (x - 1.0) * (dy - x)}
    model = sv.derive(mechanism, sv.Program(rows, by="ideal"))
    start = model.start(x=0.0, y=0.0)
    with pytest.raises(sv.errors.SingularProgram) as error:
        sv.simulate(model, start, (0.0, 2.0), method, t_eval=[0.0, knot, 2.0])
    assert error.value.details["t"] == pytest.approx(1.0, abs=1e-6)
