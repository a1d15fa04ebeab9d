"""What vanishes where a model is derived and comes alive at other numbers, later, or elsewhere."""

import functools

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import solve_ivp

import servoctl as sv
from servoctl.errors import SingularProgram, SpecificationError
from servoctl.gallery import gallery
from servoctl.jets.identity import spread, vanish
from servoctl.model import model as models
from servoctl.model import store

pytestmark = pytest.mark.filterwarnings("ignore:No C compiler")
T, X, Y = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("y")


def late(start, power):
    """The path that is zero before an instant and a power of the time since afterwards."""
    table = np.column_stack([np.zeros(power + 1), np.eye(power + 1, 1)])
    return sv.paths.polynomials([start - 1.0, start, start + 1.0], table, before="hold", after="continue")


BLENDS = {  # of (t, x): zero, or below rounding, at first
    "fmax in time": lambda t, x: 0.5 * ca.fmax(0, t - 4) ** 5 * x,
    "tanh in time": lambda t, x: 0.25 * (1 + ca.tanh(40 * (t - 3))) * x,
    "erf in time": lambda t, x: 0.2 * (1 + ca.erf(8 * (t - 3))) * x,
    "bump in time": lambda t, x: 0.3 * ca.exp(-100 * (t - 4) ** 2) * x,
    "cam with dwell": lambda t, x: 0.1 * ca.fmax(0, x - 2) ** 4,
    "if_else in place": lambda t, x: ca.if_else(x > 2, 0.1 * (x - 2) ** 4, 0),
    "fabs in place": lambda t, x: 0.05 * (ca.fabs(x - 2) + (x - 2)) ** 4,
    "tanh in place": lambda t, x: 0.2 * (1 + ca.tanh(40 * (x - 3))) * x,
    "logistic in place": lambda t, x: 0.4 * (1 - 1 / (1 + ca.exp(60 * (x - 3)))) * x,
    "bump in place": lambda t, x: 0.3 * ca.exp(-100 * (x - 5) ** 2),
    "root far away in time": lambda t, x: 1e-3 * ((t - 40) + ca.sqrt((t - 40) ** 2 + 1e-10)) ** 3 * x,
    "root in place": lambda t, x: 0.1 * ((x - 3) + ca.sqrt((x - 3) ** 2 + 1e-20)) ** 3,
}


# identities -----------------------------------------------------------------------------------------------------------

IDENTITIES = (
    ca.sin(X) ** 2 + ca.cos(X) ** 2 - 1,
    ca.cos(X - Y) - ca.cos(X) * ca.cos(Y) - ca.sin(X) * ca.sin(Y),
    (X + Y) ** 3 - X**3 - 3 * X**2 * Y - 3 * X * Y**2 - Y**3,
    X**2 / (X**2 + Y**2) + Y**2 / (X**2 + Y**2) - 1,
    ca.sqrt(1 + X**2) ** 2 - 1 - X**2,
    (ca.sqrt(1 - X**2) + 1) ** 2 - 2 * ca.sqrt(1 - X**2) - 2 + X**2,
    (X**2 + Y**2) ** 1.5 / ca.sqrt(X**2 + Y**2) - X**2 - Y**2,
    ca.tan(X) * ca.cos(X) - ca.sin(X),
    ca.fmax(X, Y) * T - T * ca.fmax(X, Y),
    (ca.tanh(X) + Y) ** 2 - ca.tanh(X) ** 2 - 2 * Y * ca.tanh(X) - Y**2,
    ca.if_else(X > 2, Y, 0) - ca.if_else(X > 2, Y, 0),
)


def test_identities_vanish():
    assert vanish(spread(list(IDENTITIES))).all()


@pytest.mark.parametrize("name", BLENDS)
def test_what_comes_alive_does_not_vanish(name):
    blend = BLENDS[name](T, X)
    entries = [blend, ca.jacobian(blend, X), ca.jacobian(ca.jacobian(blend, X), X)]
    assert not vanish(spread([e for e in entries if not e.is_zero()])).any()


@pytest.mark.parametrize(
    "expression",
    [
        ca.fmax(0, T - 1e6), ca.fmin(0, X + 40), ca.sign(X) - 1, ca.fabs(X) - X, ca.exp(-(X**2) * 1e6), 1 - ca.tanh(9 + X**2),
        ca.log(X**2) - ca.log(X**2 + 1e-9), ca.sqrt(X - 50) * Y, ca.if_else(ca.logic_and(X > 7, Y > 7), X, 0),
        ca.atan(1e9 * (X - 90)) + ca.pi / 2, 1e-9 * X * Y, X - Y,
        (X - 500) + ca.sqrt((X - 500) ** 2 + 1e-20), ((T - 6e3) ** 2 + 1e-12) ** 1.5 + (T - 6e3) ** 3, 1 - 1 / (1 + (X / 1e7) ** 8),
    ],
)  # fmt: skip
def test_what_is_small_flat_or_without_a_value_at_most_points_does_not_vanish(expression):
    assert not vanish(spread([expression])).any()


# The beam's two ropes, its level and its hidden balance cancel by numbers: with others the orders are decided again.
@pytest.mark.parametrize("name", [name for name in gallery if name != "beam-crane"])
def test_the_orders_of_the_gallery_rest_on_identities_alone(name, gallery_model):
    assert not gallery_model(name).reduction.rests


# other numbers --------------------------------------------------------------------------------------------------------


def eccentric(e=0.0, k=0.0):
    """A wheel on a cart, its mass m at an eccentricity; forces on both; a stop of stiffness k at x = 2."""
    p, q = sv.parameters(m=1.0, M=2.0, J=0.5, e=e, k=k), sv.coordinates("x phi")
    (x, phi), (dx, dphi) = q, q.d(1)
    speed = (dx - p.e * ca.sin(phi) * dphi) ** 2 + (p.e * ca.cos(phi) * dphi) ** 2
    mechanism = sv.Mechanism(
        q, kinetic=(p.M * dx**2 + p.J * dphi**2 + p.m * speed) / 2, potential=p.k * ca.fmax(0, x - 2) ** 3,
        parameters=p, actuators={"F": x, "torque": phi},
    )  # fmt: skip
    path = {"X": x - 0.3 * ca.sin(2 * q.t), "P": phi - 0.5 * q.t * ca.sin(q.t)}
    return mechanism, sv.Program(path, by="actuators")


def inertia(e, phi, dphi, u, m=1.0, M=2.0, J=0.5):
    """Accelerations of the eccentric wheel, from its two equations as they are in books."""
    matrix = [[M + m, -m * e * np.sin(phi)], [-m * e * np.sin(phi), J + m * e**2]]
    return np.linalg.solve(matrix, np.array(u) + [m * e * np.cos(phi) * dphi**2, 0.0])


@pytest.mark.parametrize("e", [0.2, -0.35, 1e-5])
@pytest.mark.parametrize("state", [(0.1, 0.7, 0.3, 0.4), (1.0, -2.0, 0.0, 3.0)])
def test_a_plant_has_the_coupling_of_its_numbers(e, state):
    plant = sv.plant(eccentric()[0], e=e)
    assert plant.rates(0.3, state, [1.0, 2.0])[2:] == pytest.approx(inertia(e, state[1], state[3], [1, 2]), rel=1e-12)
    if e == 0.2 and state[0] == 0.1:
        assert plant.rates(0.3, state, [1.0, 2.0])[2:] == pytest.approx([0.506, 3.824], abs=5e-4)


@pytest.mark.parametrize("name", ["lqr", "pd", "computed", "feedforward"])
def test_loops_do_not_depend_on_whether_a_number_is_the_default(name):
    runs, law = [], getattr(sv, name)
    for e in (0.0, 0.2):
        mechanism, program = eccentric(e)
        model = sv.derive(mechanism, program).with_parameters(e=0.1)
        plan = sv.simulate(model, model.start(), (0.0, 1.0))
        assert sv.verify(plan).passed
        plant = sv.plant(mechanism, e=0.1)
        runs.append(sv.close(sv.plant(mechanism, e=0.2), law(plan, plant, rate=100.0), plan.state(0.0), (0.0, 1.0)))
        assert sv.verify(runs[-1]).passed
    assert np.abs(runs[0].states - runs[1].states).max() < 1e-12
    assert max(np.abs(runs[0].residual[row]).max() for row in "XP") > 1e-6


def test_many_loops_are_those_of_their_own_plants():
    mechanism, program = eccentric()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(), (0.0, 1.0))
    law, span = sv.lqr(plan, sv.plant(mechanism), rate=100.0), (0.0, 1.0)
    cases = [0.0, 0.1, 0.2, -0.3]
    many = sv.close_many(sv.close(sv.plant(mechanism), law, plan.state(0.0), span), {"e": cases})
    for i, e in enumerate(cases):
        own = sv.close(sv.plant(eccentric(e)[0]), law, plan.state(0.0), span)
        for row in "XP":
            assert many[f"max |residual {row}|"][i] == pytest.approx(np.abs(own.residual[row][0]).max(), rel=1e-6)
    assert many["max |residual P|"][2] > 10 * many["max |residual P|"][0]


@pytest.mark.parametrize("given", [False, True], ids=["kinetic", "balance"])
def test_a_loop_into_a_stop_whose_stiffness_is_zero_by_default_keeps_its_power_balance(given):
    mechanism, _ = eccentric()
    if given:
        q, p = mechanism.q, mechanism.parameters
        x, (a, b) = next(iter(q)), q.d(2)
        balance = ca.vertcat((p.M + p.m) * a + 3 * p.k * ca.fmax(0, x - 2) ** 2, p.J * b)
        mechanism = sv.Mechanism(q, balance=balance, parameters=p, actuators={"F": x, "torque": (0, 1)})
    run = sv.close(
        sv.plant(mechanism, e=0.0 if given else 0.2, k=3.0), lambda t, y: {"F": 1.0, "torque": 0.1},
        [1.0, 0.0, 0.5, 0.0], (0.0, 4.0), timing=sv.Timing(rate=100.0),
    )  # fmt: skip
    assert run["x"].max() > 2.3 and sv.verify(run).passed


def by_parameter(e, where):
    """Two masses with a parameter in a residual, in the directions of the force, or in quasi-velocities."""
    p, q = sv.parameters(e=e), sv.coordinates("x y")
    x, y = q
    if where == "velocities":
        q = q.with_quasi_velocities("u v", [[1, p.e], [0, 1]])
        x, y = q
    dx, rates = q.d(1)[0], q.d(2)
    residual = {"residual": y - p.e * x**2, "order": y - p.e * dx}.get(where, x - ca.sin(2 * q.t))
    return sv.Mechanism(
        q, gibbs=sum(a**2 for a in rates) / 2, potential=x**2 / 2 + y**2 - x * y / 2, parameters=p,
        actuators={"F": ca.vertcat(1, p.e)} if where != "velocities" else {"F": ca.vertcat(1, 0)},
    ), sv.Program({"P": residual}, by="ideal" if where in ("residual", "order") else "actuators")  # fmt: skip


@pytest.mark.parametrize("where", ["residual", "order", "actuator", "velocities"])
def test_other_parameters_give_the_model_that_they_give_as_defaults(where):
    ends = []
    for e in (0.0, 0.3):
        model = sv.derive(*by_parameter(e, where)).with_parameters(e=0.3)
        start = {name: 0.2 for name in ("x", "dx") if name in model.state_names}
        if where in ("actuator", "velocities"):
            start = {"y": 0.2}
        run = sv.simulate(model, model.start(guess=start), (0.0, 1.0), t_eval=[0.0, 0.5, 1.0])
        ends.append((model.free, run["x"], run["y"]))
        assert np.abs(run.residual["P"]).max() < 1e-7
    assert ends[0][0] == ends[1][0]
    assert np.array(ends[0][1:]) == pytest.approx(np.array(ends[1][1:]), abs=1e-9)


@pytest.mark.parametrize("where", ["residual", "order", "actuator", "velocities"])
def test_a_sweep_through_zero_has_the_models_of_its_numbers(where):
    model = sv.derive(*by_parameter(0.0, where))
    for e in (-0.3, -1e-6, -1e-9, 0.0, 1e-9, 1e-6, 0.3):
        own, other = sv.derive(*by_parameter(e, where)), model.with_parameters(e=e)
        assert other.free == own.free
        assert [row.order for row in other.reduction.rows] == [row.order for row in own.reduction.rows]


def test_a_pivot_that_other_parameters_nearly_cancel_is_chosen_again():
    p, q = sv.parameters(a=1.0, b=0.01), sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(
        q, gibbs=sum(a**2 for a in q.d(2)) / 2, potential=(x**2 + y**2) / 2, parameters=p, actuators={"F": x, "G": y}
    )
    program = sv.Program({"A": p.a * x + p.b * y - ca.sin(q.t), "B": p.b * x + 0.02 * y - x**2}, by="actuators")
    for a in (0.0, 1e-9, 1e-13):
        model = sv.derive(mechanism, program).with_parameters(a=a)
        run = sv.simulate(model, model.start(guess={"x": 0.0, "y": 0.0}), (0.0, 0.5), "DOP853")
        fastest = np.abs(run.jets[4:]).max()  # 8e6 m/s² near t = 0, where rounding of b y'' leaves A'' no smaller
        limits = 1e-12 + np.array([0.0, 0.0, np.finfo(float).eps * 0.01 * fastest])
        assert sv.verify(run).passed and np.all(np.abs(run.residual["A"]).max(axis=1) < limits)


def weighted(a=1.0, e=0.0):
    """Three masses; a material constraint with a parameter as its first slope, or one in velocities if e is not zero."""
    p, q = sv.parameters(a=a, e=e), sv.coordinates("x y z")
    x, y, z = q
    return sv.Mechanism(
        q, gibbs=sum((i + 1) * a**2 for i, a in enumerate(q.d(2))) / 2, parameters=p, actuators={"F": x},
        constraints={"rod": p.a * x + 0.01 * y + 0.01 * z**2 - ca.sin(q.t), "slide": z - p.e * q.d(1)[1]},
    )  # fmt: skip


@pytest.mark.parametrize("numbers", [{"a": 1e-10}, {"a": 0.0}, {"e": 0.3}, {"a": 2.0, "e": -0.1}])
def test_a_plant_decides_its_pivots_and_orders_at_its_numbers(numbers):
    state = [0.1, 0.2, 0.0, 0.3, 0.4, 0.0]
    here, own = sv.plant(weighted(), **numbers), sv.plant(weighted(**numbers))
    assert here.constraint_names() == own.constraint_names()
    assert here.rates(0.3, state, [1.0]) == pytest.approx(own.rates(0.3, state, [1.0]), rel=1e-9)
    assert sv.plant(weighted()).constraint_names() != sv.plant(weighted(), e=0.3).constraint_names()


def test_a_memoised_derivation_keeps_what_its_orders_rest_on(monkeypatch, tmp_path):
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path))
    monkeypatch.delenv("SERVOCTL_MEMO", raising=False)
    monkeypatch.setattr(store, "_stamp", lambda: "these sources")
    derived, reduce = [], models.reduce
    monkeypatch.setattr(models, "reduce", lambda *given: derived.append(given) or reduce(*given))
    for count in (2, 2):  # as it is, and with the other order; then both are read
        model = sv.derive(*by_parameter(0.0, "order"))
        assert model.reduction.rests and model.free == 2
        assert model.with_parameters(e=0.3).free == 3
        assert len(derived) == count


# other instants and places --------------------------------------------------------------------------------------------


FOLLOWED = {"fmax in time": lambda q, x: 0.5 * q.references(late=late(4.0, 5)).late * x}


def blended(blend, followed=None):
    """Three unit masses beside a 2 s path, y = blend(t, x): the model, and (x, dx)' of the one free coordinate.

    Where the blend switches in time, `followed` has it of (q, x) for the model, along a path.
    """
    q = sv.coordinates("x y z")
    x, y, z = q
    mechanism = sv.Mechanism(q, gibbs=sum(a**2 for a in q.d(2)) / 2, potential=x**2 / 2 + y)
    to = q.references(Z=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0)).Z
    place = blend(q.t, x) if followed is None else followed(q, x)
    model = sv.derive(mechanism, sv.Program({"Y": y - place, "Z": z - to}, by="ideal"))
    v, g = ca.SX.sym("v"), blend(T, X)
    slope, rate = ca.jacobian(g, X), ca.jacobian(g, T)
    drift = ca.jacobian(slope, X) * v**2 + 2 * ca.jacobian(slope, T) * v + ca.jacobian(rate, T)
    acceleration = -(X + slope * (drift + 1)) / (1 + slope**2)
    return model, ca.Function("f", [T, ca.vertcat(X, v)], [ca.vertcat(v, acceleration)])


FLAT = {  # where a motion starts: even their rates are zero to all digits there
    "narrow bump": lambda t, x: 0.3 * ca.exp(-((100 * (t - 3)) ** 2)) * x,
    "steep in time": lambda t, x: 0.3 * (1 + ca.tanh(200 * (t - 4))) * x,
}


def moved(f, span, start):
    """The end of the motion by SciPy, in steps shorter than what comes alive."""
    found = solve_ivp(
        lambda t, s: f(t, s).full().ravel(), span, start, "DOP853", rtol=1e-10, atol=1e-13, max_step=0.005
    )
    return found.y[:, -1]


@functools.cache
def scene(name):
    """A model, its span, the start and the end of its motion."""
    model, f = blended({**BLENDS, **FLAT}[name], FOLLOWED.get(name))
    start = (1.0, 0.0) if "place" not in name and "dwell" not in name else (1.0, 6.0 if "bump" in name else 3.5)
    span = (0.0, 42.0 if "far" in name else 5.0)
    return model, span, start, moved(f, span, start)


ALIVE = (
    "fmax in time", "tanh in time", "cam with dwell", "fabs in place", "logistic in place", "bump in place",
    "root in place",
)  # fmt: skip


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        *((name, {}) for name in (*ALIVE, *FLAT)),
        ("cam with dwell", {"method": "Taylor"}),
        ("root far away in time", {"method": "Taylor"}),
        ("narrow bump", {"accuracy": 1e-7}),
    ],
    ids=str,
)
def test_what_comes_alive_later_or_elsewhere_acts(name, settings):
    model, span, start, end = scene(name)
    run = sv.simulate(model, model.start(x=start[0], dx=start[1]), span, **settings)
    assert [run["x"][-1], run["dx"][-1]] == pytest.approx(end, abs=2e-6)
    assert np.abs(run.residual["Y"][0]).max() < (5e-7 if "method" in settings else 1e-7)


@functools.cache
def resting():
    """A motion that rests until a bump, and where it ends."""
    model, f = blended(lambda t, x: 0.3 * ca.exp(-((100 * (t - 33.3)) ** 2)) * x)
    return model, moved(f, (33.0, 40.0), (0.0, 0.0))


@pytest.mark.parametrize("method", ["LSODA", "Taylor"])
def test_a_bump_while_the_motion_rests_is_not_stepped_over(method):
    """The steps of a motion at rest are the longest; the bump, 0.03 s of 40 s, is narrower than any of them."""
    model, end = resting()
    run = sv.simulate(model, model.start(x=0.0, dx=0.0), (0.0, 40.0), method)
    assert abs(end[0]) > 1e-3 and abs(run["x"][-1] - end[0]) < 1e-8


TANH = (lambda q: (1 + ca.tanh(40 * (q.t - 3))) / 2, lambda t: (1 + np.tanh(40 * (t - 3))) / 2)


@pytest.mark.parametrize(("blend", "turn"), [(lambda q: q.references(late=late(3.0, 5)).late, late(3.0, 5)), TANH])
def test_a_force_that_turns_drives_what_it_turns_to(blend, turn):
    q = sv.coordinates("x y z")
    x, y, z = q
    mechanism = sv.Mechanism(
        q, gibbs=sum(a**2 for a in q.d(2)) / 2, potential=(x**2 + z**2) / 2 + y**2,
        actuators={"F": ca.vertcat(1, 0.4 * blend(q), 0), "G": z},
    )  # fmt: skip
    path = q.references(Z=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0)).Z
    model = sv.derive(mechanism, sv.Program({"X": x - ca.sin(2 * q.t), "Z": z - path}, by="actuators"))
    run = sv.simulate(model, model.start(y=0.5, dy=0.0), (0.0, 4.0))
    reference = solve_ivp(
        lambda t, s: [s[1], -2 * s[0] - 1.2 * float(turn(t)) * np.sin(2 * t)], (0.0, 4.0), [0.5, 0.0],
        rtol=1e-10, atol=1e-12, max_step=0.02,
    )  # fmt: skip
    assert [run["y"][-1], run["dy"][-1]] == pytest.approx(reference.y[:, -1], abs=1e-6)
    assert sv.verify(run).passed


def coupled(kind, blend):
    """Two masses and a spring, the second on a path of 2 s, with what ties them closer from some instant on."""
    q = sv.coordinates("a b")
    (a, b), (da, db), (d2a, d2b) = q, q.d(1), q.d(2)
    s, inertia = 0.3 * blend(q), d2a**2 / 2 + d2b**2
    path = q.references(P=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=5)).P + 0.3 * ca.sin(q.t)
    spring, program = {"potential": 2.5 * (a - b) ** 2}, sv.Program({"P": b - path}, by="actuators")
    match kind:
        case "force":
            return sv.Mechanism(q, gibbs=inertia, actuators={"F": ca.vertcat(1, s)}, **spring), program
        case "mass":
            kinetic = da**2 / 2 + db**2 + s * da * db
            return sv.Mechanism(q, kinetic=kinetic, actuators={"F": a}, **spring), program
        case "damper":
            return sv.Mechanism(q, gibbs=inertia, actuators={"F": a}, forces={"b": -s * da}, **spring), program
    return sv.Mechanism(q, gibbs=inertia, **spring), sv.Program({"P": b - path - s * da}, by="ideal")


ORDERS = {"force": (0, 2), "mass": (0, 2), "damper": (0, 1), "residual": (2, 3)}


@pytest.mark.parametrize("kind", ORDERS)
def test_a_motion_ends_where_a_row_takes_another_order(kind):
    model = sv.derive(*coupled(kind, TANH[0]))
    before, after = ORDERS[kind]
    assert model.free == before
    start = model.start(guess={"a": 0.0, "da": 0.0})
    with refused(SingularProgram, free=after, expected=before) as caught:
        sv.simulate(model, start, (0.0, 4.0))
    run, t = caught.value.run, caught.value.details["t"]
    assert 2.7 < t < 3.4 and not run.success and run.t[-1] == pytest.approx(t, abs=0.005)
    assert sv.simulate(model, start, (0.0, 2.5)).success


@pytest.mark.parametrize("kind", ORDERS)
def test_no_motion_starts_where_a_path_that_is_zero_takes_a_row_its_order(kind):
    """Orders are those of any value of a path; where it vanishes the program is singular."""
    model = sv.derive(*coupled(kind, lambda q: q.references(late=late(3.0, 7)).late))
    assert model.free == ORDERS[kind][1]
    why = "gradient of row 'P' vanishes" if kind == "residual" else "relative degrees differ"
    with refused(SingularProgram, why, t=0.0):
        sv.simulate(model, model.start(guess={"a": 0.0, "da": 0.0}), (0.0, 4.0))


def test_a_motion_ends_where_a_residual_begins_to_hold_velocities():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sum(a**2 for a in q.d(2)) / 2, potential=x**2 / 2)
    residual = y - 0.1 * ca.fmax(0, x - 2) ** 4 * q.d(1)[0]
    model = sv.derive(mechanism, sv.Program({"Y": residual}, by="ideal"))
    with refused(SingularProgram, row="Y", free=3, expected=2) as caught:
        sv.simulate(model, model.start(x=1.0, dx=2.5), (0.0, 3.0))
    assert 1.9 < caught.value.run["x"][-1] < 2.1
    slow = sv.simulate(model, model.start(x=1.0, dx=1.0), (0.0, 3.0))  # stays below x = 2
    assert slow.success and sv.verify(slow).passed


@pytest.mark.parametrize("by", ["ideal", "actuators", "material"])
def test_a_row_takes_another_order_also_where_its_motion_rests(by):
    """At rest its residual is zero in either order, but the reaction of a row in velocities has another direction."""
    q = sv.coordinates("x y z")
    x, y, z = q
    row = {"Y": y - (1 + ca.tanh(40 * (q.t - 3))) / 2 * q.d(1)[0]}
    inertia = {"gibbs": sum(a**2 for a in q.d(2)) / 2, "potential": 9.81 * y + x**2 / 2}
    path = {"Z": z - ca.sin(q.t)}
    if by == "material":
        parts = sv.Mechanism(q, constraints=row, actuators={"F": z}, **inertia), sv.Program(path, by="actuators")
    elif by == "actuators":
        parts = sv.Mechanism(q, actuators={"F": z, "G": y}, **inertia), sv.Program(path | row, by="actuators")
    else:
        parts = sv.Mechanism(q, **inertia), sv.Program(path | row, by="ideal")
    model = sv.derive(*parts)
    with refused(SingularProgram, row="Y") as caught:
        sv.simulate(model, model.start(x=0.0, dx=0.0), (0.0, 6.0))
    assert 2.7 < caught.value.run.t[-1] < 3.4


def test_a_row_that_becomes_nonlinear_in_its_highest_derivative_is_solved_as_such():
    q = sv.coordinates("x y")
    (x, y), (d2x, d2y) = q, q.d(2)
    mechanism = sv.Mechanism(q, gibbs=(d2x**2 + d2y**2) / 2, potential=x**2 / 2)
    ramp = sv.paths.polynomials([0.0, 1.0, 2.0, 5.0], [[0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
    r = q.references(ramp=ramp, late=late(4.0, 5))
    residual = d2y + y - 0.1 * r.late * d2y**2 - r.ramp**7
    model = sv.derive(mechanism, sv.Program({"Y": residual}, by="ideal"), keep=["x"])
    start = model.start(x=1.0, dx=0.0, y=0.1, dy=0.0, guess={"d2y": -0.1, "d2x": -1.0})
    run = sv.simulate(model, start, (0.0, 5.0))
    bend = 0.1 * np.maximum(run.t - 4, 0) ** 5
    force = (0.1 * np.clip(run.t - 1, 0, 1)) ** 7
    assert run["d2y"] + run["y"] - bend * run["d2y"] ** 2 == pytest.approx(force, abs=1e-8)
    assert np.abs(bend * run["d2y"] ** 2).max() > 1e-5


def test_drifted_a_slope_ends_a_motion_above_1e_6_of_the_terms_of_its_row():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sum(a**2 for a in q.d(2)) / 2, potential=x**2 / 2)

    def run(weak):
        residual = y - x - weak * (1 + ca.tanh(40 * (q.t - 3))) / 2 * q.d(1)[0]
        model = sv.derive(mechanism, sv.Program({"Y": residual}, by="ideal"))
        return sv.simulate(model, model.start(x=1.0, dx=0.0), (0.0, 6.0))

    assert run(4e-7).success
    with refused(SingularProgram, row="Y"):
        run(8e-6)


def test_a_loop_ends_where_a_material_constraint_takes_another_order():
    q = sv.coordinates("x y")
    x, y = q
    inertia = {"gibbs": sum(a**2 for a in q.d(2)) / 2, "potential": x**2 / 2, "actuators": {"F": x}}
    push, timing = (lambda t, y: {"F": 1.0}), sv.Timing(rate=100.0)
    cam = ca.fmax(0, x - 2) ** 4
    place = sv.close(
        sv.plant(sv.Mechanism(q, constraints={"cam": y - cam}, **inertia)), push, [1.0, 0.0, 1.5, 0.0], (0.0, 4.0),
        timing=timing,
    )  # fmt: skip
    assert place["y"].max() > 0.01 and sv.verify(place).passed
    with refused(SingularProgram, row="cam") as caught:
        sv.close(
            sv.plant(sv.Mechanism(q, constraints={"cam": y - cam * q.d(1)[0]}, **inertia)), push, [1.0, 0.0, 1.5, 0.0],
            (0.0, 4.0), timing=timing,
        )  # fmt: skip
    assert not caught.value.run.success


@pytest.mark.parametrize("numbers", [{}, {"k": 20.0}])
def test_a_flat_plan_presses_on_a_spring_stop(numbers):
    p, q = sv.parameters(m=1.0, M=2.0, c=5.0, k=0.0 if numbers else 20.0), sv.coordinates("a b")
    (a, b), (d2a, d2b) = q, q.d(2)
    mechanism = sv.Mechanism(
        q, gibbs=(p.m * d2a**2 + p.M * d2b**2) / 2, parameters=p, actuators={"F": a},
        potential=p.c * (a - b) ** 2 / 2 + p.k * ca.fmax(0, b - 0.5) ** 7,
    )  # fmt: skip
    path = q.references(P=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=5)).P
    model = sv.derive(mechanism, sv.Program({"P": b - path}, by="actuators")).with_parameters(**numbers)
    run = sv.simulate(model, model.start(), (0.0, 2.0))
    assert sv.verify(run).passed
    stop = 7 * 20.0 * 0.5**6
    assert run["F"][-1] == pytest.approx(stop, rel=1e-9)  # at rest on the stop: F = V'(b)
    assert run["a"][-1] == pytest.approx(1.0 + stop / 5.0, rel=1e-9)


def test_many_loops_whose_constraint_could_change_its_order_are_judged_one_by_one():
    mechanism = weighted()
    x = next(iter(mechanism.q))
    model = sv.derive(mechanism, sv.Program({"X": x - 0.1 * ca.sin(mechanism.q.t)}, by="actuators"))
    plan = sv.simulate(model, model.start(), (0.0, 0.5))
    run = sv.close(sv.plant(mechanism), sv.lqr(plan, sv.plant(mechanism), rate=50.0), plan.state(0.0), (0.0, 0.5))
    assert run.plant.equations.rests
    many = sv.close_many(run, {"a": [1.0, 1.0]}, record=["x"])
    assert many.trace["x"][:, 0] == pytest.approx(run["x"], abs=1e-12)
    with refused(SpecificationError):
        sv.close_many(run, {"e": [0.0, 0.3]})


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA", "RK4"])
def test_a_plant_without_constraints_crosses_switches(method):
    q = sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    kinetic = (dx**2 + dy**2) / 2 + 0.3 * ca.tanh(BLENDS["cam with dwell"](q.t, x)) * dx * dy
    mechanism = sv.Mechanism(q, kinetic=kinetic, potential=x**2 / 20, actuators={"F": x, "G": y})
    inputs = {"F": lambda t: 0.3 * ca.sin(t), "G": 0.2}
    assert sv.simulate(sv.plant(mechanism), [1.0, 0.0, 1.5, 0.4], (0.0, 3.0), method, inputs=inputs).success


def far_blend(name):
    """A coupling that is zero to all digits where it is derived."""
    return {"split logistic": lambda x: 0.5 * (1 - 1 / (1 + np.exp(-90.0) * ca.exp(30 * x))),
            "far away": lambda x: 0.5 * (1 - 1 / (1 + (x / 1e8) ** 8))}[name]  # fmt: skip


@pytest.mark.parametrize(("name", "x", "dx"), [("split logistic", 1.0, 1.5), ("far away", 1.0, 1e8)])
def test_what_a_small_number_hides_acts(name, x, dx):
    """The accelerations of two masses with an inertial coupling c(x), whose balance is written by hand."""
    q, blend = sv.coordinates("x y"), far_blend(name)
    kinetic = (q.d(1)[0] ** 2 + q.d(1)[1] ** 2) / 2 + blend(q["x"]) * q.d(1)[0] * q.d(1)[1]
    plant = sv.plant(sv.Mechanism(q, kinetic=kinetic, actuators={"F": q["x"], "G": q["y"]}))
    X = ca.SX.sym("x")
    c, slope = (ca.Function("c", [X], [e]) for e in (blend(X), ca.jacobian(blend(X), X)))
    for place in (x, 3.1 if name == "split logistic" else 1.2e8):
        coupling, rate = float(c(place)), float(slope(place))
        expected = np.linalg.solve([[1.0, coupling], [coupling, 1.0]], [0.3, 0.2 - rate * dx**2])
        assert plant.rates(0.0, [place, 0.0, dx, 0.0], [0.3, 0.2])[2:] == pytest.approx(expected, rel=1e-9)
