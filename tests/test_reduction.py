"""Final orders, hidden constraints, dependent and contradictory rows, squares; who acts."""

import warnings
from functools import partial
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from conftest import motion, signal
from refusals import refused, warned

import servoctl as sv
from servoctl.errors import InconsistentStart, NotRealisable, SingularProgram, SpecificationError
from servoctl.gallery import cars, gallery, mass_on_car, overhead_crane, passive_arm, spiral
from servoctl.methods.choice import Adaptive
from servoctl.model.equations import invariant_names
from servoctl.model.model import derive
from servoctl.reduction import hidden
from servoctl.simulation import simulate
from servoctl.study.many import simulate_many
from servoctl.tolerances import EXTENDED
from servoctl.verification import verify


def orders(model):
    return [row.order for row in model.reduction.rows]


# final orders and needs: the table of systems with known structure ----------------------------------------------------

CAR_ON_RAIL = ((0, 0.0, 0, 4), (0, 1.0, 1, 3), (45, 0.0, 2, 2), (45, 1.0, 2, 2), (90, 1.0, 2, 2))
TABLE = {
    "four cars": (lambda: cars(4), [0, 0, 0, 0], {"car 1": 8}),
    "arm, 0.5": (lambda: passive_arm(0.5), [0, 2], {"angle": 2}),
    "spiral of order 5": (lambda: spiral(5), [5, 2], {"curvature": 0}),
    **{
        f"mass on car, {coordinates}, {degrees}°, d={damping}": (
            partial(mass_on_car, np.deg2rad(degrees), damping, coordinates), [0, *guide, last], {"z": need},
        )
        for coordinates, guide in (("relative", []), ("absolute", [0]))
        for degrees, damping, last, need in CAR_ON_RAIL
    },
}  # fmt: skip


@pytest.mark.parametrize("system", TABLE)
def test_orders_free_values_and_needs(system):
    build, final, needs = TABLE[system]
    model = derive(*build())
    assert orders(model) == final
    assert model.free == sum(final) and model.flat == (sum(final) == 0)
    assert model.reduction.needs == needs
    assert model.reduction.rank.clear


GALLERY = {
    "appell-hamel": ([1, 1, 0, 2, 2], {"x_c": 1, "y_c": 1, "string": 2}),
    "appell-hamel-squared": ([1, 1, 0, 2, 2], {"speed": 1, "direction": 1, "string": 2}),
    "overhead-crane": ([0] * 3, {"X": 4, "Z": 4}),
    "overhead-crane-redundant": ([0] * 4, {"X": 4, "Z": 4}),
    "winch-crane": ([0] * 3, {"X": 4, "Z": 4}),
    "winch-crane-redundant": ([0] * 4, {"X": 4, "Z": 4}),
    "crane-3d": ([0] * 5, {"X": 4, "Y": 4, "Z": 4}),
    "crane-3d-redundant": ([0] * 6, {"X": 4, "Y": 4, "Z": 4}),
    "two-cars": ([0, 0], {"car 1": 4}),
    "two-cars-ideal": ([0, 2], {"car 1": 2}),
    "three-cars": ([0, 0, 0], {"car 1": 6}),
    "mass-on-car": ([0, 2], {"z": 2}),
    "mass-on-car-absolute": ([0, 0, 2], {"z": 2}),
    "spiral": ([3, 2], {"curvature": 0}),
    "constant-speed": ([1, 2], {"speed": 1}),
    "constant-speed-horizontal": ([1, 2], {"speed": 1}),
    "passive-arm": ([0, 2], {"angle": 2}),
    "vtol": ([0, 0, 0], {"X": 4, "Z": 4}),
    "vtol-centre": ([0, 0, 2], {"X": 2, "Z": 2}),
    "two-link-arm": ([0, 0], {"X": 2, "Y": 2}),
    "pendubot": ([0, 2], {"angle": 2}),
    "wheeled-robot": ([1, 2], {"speed": 1, "clothoid": 0}),
    "slung-load": ([0] * 4, {"across": 6, "up": 6}),
    "slung-load-3d": ([0] * 8, {"load_x": 6, "load_y": 6, "load_z": 6, "heading": 2}),
    "flexible-joint": ([0] * 2, {"angle": 4}),
    "four-bar": ([0] * 3, {"turn": 2}),
    "double-pendulum": ([0, 2, 2], {"cart": 2}),
    "elastic-link": ([0, 2, 2, 2, 2], {"angle": 2}),
    "six-axis-arm": ([0] * 6, {"tool_x": 2, "tool_y": 2, "tool_z": 2, "tool_rx": 2, "tool_ry": 2, "tool_rz": 2}),
    "cable-robot": ([0] * 6, {"x": 2, "y": 2, "z": 2, "roll": 2, "pitch": 2, "yaw": 2}),
    "reaction-wheels": ([0, 0, 0, 2, 2, 2], {"turn_rx": 2, "turn_ry": 2, "turn_rz": 2}),
    "rolling-disc": ([0, 1, 1, 2, 2, 2], {"height": 2, "rolling_x": 1, "rolling_y": 1}),
    "constant-jerk": ([3, 3], {"jerk": 0}),
    "jerkless-trolley": ([3, 2], {"jerk": 0}),
    "tumbling-satellite": ([1, 2, 2], {"energy": 1}),
    "trailers": ([0, 1], {"curvature": 2, "speed": 2}),
    "ball-on-turntable": ([0, 1, 1, 2, 2], {"rate": 2}),
    "rotary-crane": ([0] * 5, {"X": 4, "Y": 4, "Z": 4}),
    "beam-crane": ([0] * 7, {"X": 4, "Z": 4, "level": 2, "apart": 2}),
    "cart-pole": ([0, 2], {"X": 2}),
    "fixed-rope-crane": ([0, 2], {"tool": 2}),
    "furuta-pendulum": ([0, 2], {"angle": 2}),
    "ball-and-beam": ([0, 2], {"tilt": 2}),
    "acrobot": ([1, 1], {"momentum": 2}),
    "hopper": ([0, 0, 0, 2, 2, 2], {"leg": 2, "left": 2, "right": 2}),
    "clothoid-arm": ([1, 3], {"speed": 1, "clothoid": 0}),
    "steady-satellite": ([3, 2], {"steady": 0}),
    "bicycle": ([1, 0], {"speed": 1, "curvature": 2}),
}
ROLLED = {"wheeled-robot": 1, "trailers": 3, "bicycle": 2}  # coordinates beyond the velocities, which start anywhere


@pytest.mark.parametrize("name", gallery)
def test_orders_free_values_and_needs_of_the_gallery(name, gallery_model):
    model, (final, needs) = gallery_model(name), GALLERY[name]
    assert orders(model) == final
    assert model.free == sum(final) + ROLLED.get(name, 0) and model.flat == (model.free == 0)
    assert model.free == len(model.state_names) - len(invariant_names(model))
    assert {key: model.reduction.needs[key] for key in needs} == needs
    assert sum(model.reduction.raised.values()) == model.reduction.top * model.n - sum(final)


def test_where_velocities_alone_are_determined_the_motion_is_integrated():
    """x' = v cos ψ, y' = v sin ψ, ψ' = r with x and ψ programmed: y starts anywhere, and y' = tan ψ x'."""
    plane = sv.coordinates("x y psi")
    psi = list(plane)[2]
    q = plane.with_quasi_velocities("v r", [[ca.cos(psi), 0], [ca.sin(psi), 0], [0, 1]])
    x, y, _ = q
    body = sv.rigid_body(q, 20.0, (0, 0, 1.5), position=(x, y), rates=(0, 0, q.w()[1]))
    mechanism = sv.Mechanism(q, gibbs=body, actuators={"drive": (1, 0), "steer": (0, 1)})
    model = derive(mechanism, sv.Program({"along": x - q.t, "heading": psi - q.t}))
    assert model.free == 1 and not model.flat and "flat" not in repr(model)
    start, last = model.start(y=0.5), 0.5 - np.log(np.cos(0.7))
    runs = [simulate(model, start, (0.0, 0.7), **options) for options in ({}, {"method": "RK4", "t_eval": [0.3, 0.7]})]
    assert [run["y"][-1] for run in runs] == pytest.approx([last] * 2, rel=1e-9)
    assert runs[0]["v"] == pytest.approx(1 / np.cos(runs[0].t), rel=1e-9)
    many = simulate_many(model, {"y": [0.5, 1.5]}, None, (0.0, 0.7), t_eval=[0.3])
    assert many["final y"] == pytest.approx([last, last + 1], rel=1e-9)
    assert many.trace["drive"][0] == pytest.approx(runs[1]["drive"][0], rel=1e-9)


@pytest.mark.parametrize("alpha", [1e-5, 1e-6, *([2e-7] if EXTENDED else [])])  # sin²α is above the noise of pivots
def test_a_nearly_singular_car_is_called_ill_conditioned(alpha):
    with refused(SingularProgram, "z", "balance of s", kept=pytest.approx(1.0, abs=1e-3)) as caught:
        derive(*mass_on_car(alpha=alpha))
    assert caught.value.details["dropped"] < 1e-10


@pytest.mark.parametrize("alpha", [5e-8, 1e-8])
def test_a_car_that_is_singular_up_to_rounding_is_level_and_its_margin_is_told(alpha):
    """The pivot sin²α lies within the rounding of constants: the guide is level, and the report holds the pivot."""
    model, level = derive(*mass_on_car(alpha=alpha)), derive(*mass_on_car(alpha=0.0))
    assert orders(model) == orders(level) and model.free == level.free == 1
    assert model.reduction.rank.dropped == pytest.approx(alpha**2, rel=0.02)
    assert f"largest dropped {model.reduction.rank.dropped:.1e}" in model.details


# decimal factors -----------------------------------------------------------------------------------------------------

DECIMALS = [(0.7, 0.9, 0.31, 0.3), (0.63, 0.54, 0.56, 0.9), (0.28, 0.81, 0.67, 0.1), (0.853, 0.064, 0.917, 0.77)]


def decimal_residual(q, a, b, c):
    x, y, z = q
    return a * x + b * y + c * z - 0.2 * ca.sin(q.t)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("a, b, c, k", DECIMALS)
def test_a_hidden_row_behind_decimal_factors_is_found(a, b, c, k, order, turned):
    """k f^(order) + 0.7 f + 0.5 z - 0.1 t beside f: 0.5 z = 0.1 t is hidden, whatever the roundings of k a, k b, k c."""
    q = sv.coordinates("x y z")
    if turned:
        z = list(q)[2]
        q = q.with_quasi_velocities("u v w", [[ca.cos(z), -ca.sin(z), 0], [ca.sin(z), ca.cos(z), 0], [0, 0, 1]])
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q)))
    f = decimal_residual(q, a, b, c)
    program = sv.Program({"f": f, "g": k * q.dt(f, order) + 0.7 * f + 0.5 * list(q)[2] - 0.1 * q.t}, by="ideal")
    model = derive(mechanism, program)
    assert model.free == 2 and len(model.reduction.hidden) == 1
    jets = dict(zip(model.jet_names, motion(model, 0.4, x=0.1), strict=True))
    assert jets["z"] == pytest.approx(0.08, abs=1e-13)
    assert a * 0.1 + b * jets["y"] + c * 0.08 == pytest.approx(0.2 * np.sin(0.4), abs=1e-13)


def test_decimal_factors_as_parameters_are_decided_again():
    q = sv.coordinates("x y z")
    p = sv.parameters(a=0.7, b=0.9, c=0.31, k=0.3)
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q)), parameters=p)
    f = decimal_residual(q, p.a, p.b, p.c)
    model = derive(mechanism, sv.Program({"f": f, "g": p.k * q.dt(f) + 0.5 * list(q)[2] - 0.1 * q.t}, by="ideal"))
    for a, b, c, k in DECIMALS:
        assert model.with_parameters(a=a, b=b, c=c, k=k).free == 2


@pytest.mark.parametrize("a, b, c, k", DECIMALS)
def test_a_row_that_is_a_decimal_multiple_is_called_dependent(a, b, c, k):
    q = sv.coordinates("x y z")
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q)))
    f = decimal_residual(q, a, b, c)
    with refused(SpecificationError, "vanishes identically", rows=["f", "g"]):
        derive(mechanism, sv.Program({"f": f, "g": k * f}, by="ideal"))
    with refused(SpecificationError, "vanishes identically", rows=["f", "g"]):
        derive(mechanism, sv.Program({"f": f, "g": k * q.dt(f)}, by="ideal"))


@pytest.mark.parametrize("tilt", [5.0, 3.7, 11.3])
def test_a_flat_point_given_as_a_number_is_flat(tilt):
    """The point of the aircraft whose motion determines everything, its distance rounded to a double."""
    q = sv.coordinates("x z theta")
    x, z, theta = q
    M, J, l, h, tilt = 50.0, 25.0, 1.0, 0.1, np.radians(tilt)
    arm = l * np.cos(tilt) + h * np.sin(tilt)
    across, along = ca.vertcat(ca.cos(theta), ca.sin(theta)), ca.vertcat(-ca.sin(theta), ca.cos(theta))
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.rigid_body(q, M, (0, 0, J), position=(x, z), rates=(0, 0, q.d(1)[2])),
        potential=M * 9.81 * z,
        actuators={
            "u1": ca.vertcat(along + np.sin(tilt) * across, arm),
            "u2": ca.vertcat(along - np.sin(tilt) * across, -arm),
        },
    )
    distance = J * np.sin(tilt) / (M * arm)
    for e in (distance, np.nextafter(distance, 1.0), np.nextafter(distance, 0.0)):
        X, Z = x - e * ca.sin(theta), z + e * ca.cos(theta)
        path = 0.3 * ca.sin(q.t)
        assert derive(mechanism, sv.Program({"X": X - path, "Z": Z - path})).flat


# factors that vanish ------------------------------------------------------------------------------------------------


CURVES = {  # points of the parameter u, and their heading
    "wave": (lambda m, u: (u, m.sin(u)), lambda u: np.arctan(np.cos(u))),
    "parabola": (lambda m, u: (u, u**2), lambda u: np.arctan(2 * u)),
    "circle": (lambda m, u: (2 * m.cos(u), 2 * m.sin(u)), lambda u: u + np.pi / 2),
}


@pytest.mark.parametrize(("kind", "speed"), [("wave", "forward"), ("parabola", "squared"), ("circle", "forward")])
def test_a_geometric_path_beside_rolling_is_followed(kind, speed):
    """Rolling beside a path by its geometry leaves the speed times an angle; the angle is the hidden row."""
    q = sv.coordinates("x y psi u")
    (x, y, psi, u), (dx, dy, *_) = q, q.d(1)
    curve, heading = CURVES[kind]
    X, Y = curve(ca, u)
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, 1.0, (x, y)) + sv.particle(q, 0.1, psi) + sv.particle(q, 1e-3, u),
        constraints={"slip": dx * ca.sin(psi) - dy * ca.cos(psi)},
    )
    rate = dx**2 + dy**2 - 1.0 if speed == "squared" else dx * ca.cos(psi) + dy * ca.sin(psi) - 1.0
    model = derive(mechanism, sv.Program({"X": x - X, "Y": y - Y, "speed": rate}, by="ideal"), guess={"du": 1.0})
    assert model.free == 1 and [row.name for row in model.reduction.hidden] == ["slip"]
    start = model.start(u=0.3, guess={"du": 0.8, "psi": heading(0.3)})
    run = simulate(model, start, (0.0, 2.0))
    assert run["psi"] == pytest.approx(heading(run["u"]), abs=1e-7)
    assert np.hypot(run["dx"], run["dy"]) == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("expanded", [False, True])
def test_a_residual_with_a_speed_for_a_factor_is_refused(expanded):
    q = sv.coordinates("u psi")
    (u, psi), (du, _) = q, q.d(1)
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (u, u**2)) + sv.particle(q, 0.1, psi))
    slip = 2 * u * ca.cos(psi) - ca.sin(psi)
    times_speed = 2 * du * u * ca.cos(psi) - du * ca.sin(psi) if expanded else du * slip
    speed = du**2 * (1 + 4 * u**2) - 1.0
    for guess in (None, {"du": 1.0}):
        with refused(SingularProgram, "'slip'", row="slip"):
            derive(mechanism, sv.Program({"slip": times_speed, "speed": speed}, by="ideal"), guess=guess)
    assert derive(mechanism, sv.Program({"slip": slip, "speed": speed}, by="ideal")).free == 1


def steered(base=1.1):
    """A car of unit inertias that is driven and steered, in velocities v along its axis and s of its steering."""
    p = sv.coordinates("x y psi delta")
    psi, delta = list(p)[2:]
    turn = ca.tan(delta) / base
    q = p.with_quasi_velocities("v s", [[ca.cos(psi), 0], [ca.sin(psi), 0], [turn, 0], [0, 1]])
    v, s = q.w()
    gibbs = sv.particle(q, 1.0, tuple(q)[:2]) + (q.dt(turn * v) ** 2 + q.dt(s) ** 2) / 2
    return sv.Mechanism(q, gibbs=gibbs, actuators={"F": (1, 0), "T": (0, 1)})


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(
    ("scale", "factor", "by"),
    [(1.0, 1.0, "ideal"), (1e-3, -3.0, "actuators")],
)
def test_the_rate_of_a_constant_heading_of_a_moving_car_holds_its_steering_straight(scale, factor, by):
    """With v tan(δ)/a = 0 and v = c, δ = 0 and x is straight; every multiple of zero is zero, whatever it is beside."""
    mechanism = steered(1.1 * scale)
    q, (v, _) = mechanism.q, mechanism.q.w()
    program = sv.Program({"heading": q.dt(factor * (q["psi"] - 0.3)), "speed": v - scale}, by=by)
    with warned("'heading'", "product", "tan(delta) or v"):
        model = derive(mechanism, program)
    run = simulate(model, model.start(x=0.0, y=0.0, psi=0.3), (0.0, 3.0))
    assert model.free == 3 and run.message == "finished" and verify(run).passed
    assert run["x"][-1] == pytest.approx(3.0 * scale * np.cos(0.3), rel=1e-12)
    assert run["psi"] == pytest.approx(0.3, abs=1e-12) and run["delta"] == pytest.approx(0.0, abs=1e-12)


PRODUCTS = {  # residuals a and b of x, y, their rates and t: a keeps a factor of b at zero
    "two residuals": lambda x, y, dx, dy, t: (x - t, (x - t) * (y - ca.sin(t))),
    "in a fraction": lambda x, y, dx, dy, t: (x - t, -2 * (x - t) * (y - t) / (2 + ca.cos(y))),
    "a square": lambda x, y, dx, dy, t: (x - t, (x - t) ** 2 * y),
    "a rate that stays": lambda x, y, dx, dy, t: (x - 1.0, dx * (dy - 1.0)),
    "a rate and a rate": lambda x, y, dx, dy, t: (dx - 1.0, (dx - 1.0) * (dy - ca.sin(t))),
    "a rate and a coordinate": lambda x, y, dx, dy, t: (x - t, (dx - 1.0) * (y - ca.sin(t))),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_a_residual_with_a_factor_that_another_keeps_at_zero_is_refused(name):
    q = sv.coordinates("x y z")
    a, b = PRODUCTS[name](*list(q)[:2], *q.d(1)[:2], q.t)
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q)))
    with refused(SpecificationError, "b") as caught:
        derive(mechanism, sv.Program({"a": a, "b": b}, by="ideal"))
    assert "b" in caught.value.details["rows"]


@pytest.mark.parametrize("power", [2, 3])
def test_the_factor_of_a_square_is_named(power):
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)))
    with refused(SingularProgram, "(x-t)", row="a", factor="(x-t)"):
        derive(mechanism, sv.Program({"a": (x - q.t) ** power}, by="ideal"))


EXTREMA = {  # residuals of x, y, their rates and t, with an extremum or a kink where they hold
    "a cosine": lambda x, y, dx, dy, t: 1 - ca.cos(y - t),
    "a cosine of a multiple": lambda x, y, dx, dy, t: 1 - ca.cos(2 * (y - t)),
    "a hyperbolic cosine at zero": lambda x, y, dx, dy, t: ca.cosh(y) - 1,
    "an exponential": lambda x, y, dx, dy, t: ca.exp(y**2) - 1,
    "a logarithm": lambda x, y, dx, dy, t: ca.log(1 + (y - t) ** 2),
    "a root": lambda x, y, dx, dy, t: ca.sqrt((y - t) ** 2),
    "a distance": lambda x, y, dx, dy, t: ca.sqrt((x - t) ** 2 + (y - 2) ** 2),
    "a length less a coordinate": lambda x, y, dx, dy, t: ca.sqrt(1 + (y - t) ** 2) - 1,
    "an absolute value": lambda x, y, dx, dy, t: ca.fabs(y - t),
    "a sum of squares": lambda x, y, dx, dy, t: (x - t) ** 2 + (y - t) ** 2,
    "a curve and a path": lambda x, y, dx, dy, t: (y - ca.sin(x)) ** 2 + (x - t) ** 2,
    "an inflection": lambda x, y, dx, dy, t: x - ca.sin(x),
    "a cosine of a speed": lambda x, y, dx, dy, t: 1 - ca.cos(dy - 0.5),
    "squares of speeds": lambda x, y, dx, dy, t: (dx - 1) ** 2 + (dy - 1) ** 2,
    "a long path": lambda x, y, dx, dy, t: 1 - ca.cos(y - (t + t**2 + ca.sin(t) + t * ca.cos(3 * t) * ca.exp(t))),
}


@pytest.mark.parametrize("name", EXTREMA)
def test_a_residual_without_a_gradient_at_its_solutions_is_refused(name):
    q = sv.coordinates("x y")
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q)))
    with refused(SingularProgram, "'a'", row="a"):
        derive(mechanism, sv.Program({"a": EXTREMA[name](*q, *q.d(1), q.t)}, by="ideal"))


@pytest.mark.parametrize("level", [1e-6, 1e-3, 0.1])
def test_a_residual_near_an_extremum_has_a_gradient(level):
    """cosh y = 1 + level: y = ±arcosh(1 + level)."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)))
    model = derive(mechanism, sv.Program({"a": ca.cosh(y) - 1 - level}, by="ideal"))
    assert abs(model.start()["y"]) == pytest.approx(np.arccosh(1 + level), rel=1e-9)


def plane_products():
    """A free point in the plane, with x, y, dx, dy and t."""
    q = sv.coordinates("x y")
    return sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q))), (*q, *q.d(1), q.t)


SEVERAL_ZEROS = {  # residuals that are products, and the factors that have zeros near x = y = 0
    "coordinates": (lambda x, y, dx, dy, t: x * y, ("x", "y")),
    "a speed": (lambda x, y, dx, dy, t: dx * (dy - 0.1), ("dx", "(dy-0.1)")),
    "multiplied out": (lambda x, y, dx, dy, t: 2 * dx * dy - 0.1 * dx + dx * x, ("dx", "the rest")),
    "with a constant and a quotient": (lambda x, y, dx, dy, t: -x * (y - t / 4) / 2, ("x", "(y-(t/4))")),
    "a square among them": (lambda x, y, dx, dy, t: x**2 * (y - t), ("x", "(y-t)")),
    "a function": (lambda x, y, dx, dy, t: ca.sin(x) * (y - t), ("sin(x)", "(y-t)")),
}


@pytest.mark.parametrize("name", SEVERAL_ZEROS)
def test_a_residual_that_holds_by_either_of_its_factors_is_told_with_them(name):
    mechanism, symbols = plane_products()
    residual, factors = SEVERAL_ZEROS[name]
    with warned("'a'", "product", *factors):
        derive(mechanism, sv.Program({"a": residual(*symbols)}, by="ideal"))


ONE_ZERO = {  # residuals of which one factor alone has zeros near x = y = 0
    "a cosine": lambda x, y, dx, dy, t: ca.cos(x) * (y - t),
    "a positive factor": lambda x, y, dx, dy, t: (1 + x**2) * (y - t),
    "a speed without direction": lambda x, y, dx, dy, t: ca.sqrt(dx**2 + dy**2) * (y - t),
    "a number": lambda x, y, dx, dy, t: -2 * (y - t),
    "a time": lambda x, y, dx, dy, t: (t + 1) * (y - ca.sin(t)),
    "a quotient": lambda x, y, dx, dy, t: (y - t) / (3 + x),
    "a jet that all terms share": lambda x, y, dx, dy, t: x + x * y**2,
    "no product": lambda x, y, dx, dy, t: dx * ca.sin(x) - dy * ca.cos(x),
}


@pytest.mark.parametrize("name", ONE_ZERO)
def test_a_residual_that_holds_by_one_factor_is_no_cause_for_a_warning(name):
    mechanism, symbols = plane_products()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        derive(mechanism, sv.Program({"a": ONE_ZERO[name](*symbols)}, by="ideal"))


def test_a_guess_far_from_the_zeros_of_a_factor_decides():
    """A rope of about 4 m times the angle that follows a path."""
    mechanism, (length, angle, *_, t) = plane_products()
    program = sv.Program({"a": length * (angle - ca.sin(t))}, by="ideal")
    with warned("'a'", "x or (y-sin(t))"):
        derive(mechanism, program)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        derive(mechanism, program, guess={"x": 4.0})


@pytest.mark.parametrize("name", gallery)
def test_no_scene_of_the_gallery_has_a_residual_that_holds_by_either_of_two_factors(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = gallery[name]
        derive(*scene.build())


CONTRADICTIONS = {  # residuals that no state satisfies
    "circles": lambda q, x, y: (x**2 + y**2 - 1, x**2 + y**2 - 4),
    "a circle by its root": lambda q, x, y: (x**2 + y**2 - 1, ca.sqrt(x**2 + y**2) - 2),
    "a rate": lambda q, x, y: (ca.sin(x) + y - ca.sin(q.t), q.dt(ca.sin(x) + y) - 2 * ca.cos(q.t)),
    "a rate with the residual": lambda q, x, y: (
        ca.sin(x) + y * x - ca.sin(q.t),
        0.3 * q.dt(ca.sin(x) + y * x - ca.sin(q.t)) + 0.3 * (ca.sin(x) + y * x - ca.sin(q.t)) - 0.1 * q.t,
    ),
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_bent_constraints_that_contradict_each_other_are_told_so(name):
    q = sv.coordinates("x y z")
    a, b = CONTRADICTIONS[name](q, *list(q)[:2])
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q)))
    with refused(SpecificationError, "contradict", rows=["a", "b"]):
        derive(mechanism, sv.Program({"a": a, "b": b}, by="ideal"))


# programs with a turn ------------------------------------------------------------------------------------------------


def particle(names="x y", **options):
    q = sv.coordinates(names)
    x, y, *_ = q
    return q, sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q)), actuators={"a": x, "b": y}, **options)


@pytest.mark.parametrize("by", ["ideal", "actuators"])
def test_rows_that_depend_at_their_top_orders(by):
    """x'-y' = 0 with x''-y''+x = 0: x = 0 is hidden, and y stays where it is."""
    q, mechanism = particle()
    (x, _), (dx, dy), (ddx, ddy) = q, q.d(1), q.d(2)
    model = derive(mechanism, sv.Program({"rate": dx - dy, "swing": ddx - ddy + x}, by=by))
    assert sorted(orders(model)) == [0, 1] and model.free == 1
    assert len(model.reduction.hidden) == 1
    z = dict(zip(model.jet_names, motion(model, 0.0, y=0.7), strict=True))
    assert [z[name] for name in ("x", "dx", "d2x", "y", "dy", "d2y")] == pytest.approx([0, 0, 0, 0.7, 0, 0], abs=1e-12)


def test_an_ideal_knife_edge_pushes_at_right_angles():
    q = sv.coordinates("x y psi")
    (x, y, psi), (dx, dy, dpsi) = q, q.d(1)
    S = sv.rigid_body(q, 2.0, (0, 0, 0.5), position=(x, y), rates=(0, 0, dpsi))
    model = derive(sv.Mechanism(q, gibbs=S), sv.Program({"edge": dx * ca.sin(psi) - dy * ca.cos(psi)}, by="ideal"))
    assert model.free == 5
    z = motion(model, 0.0, x=0.0, y=0.0, psi=0.4, dpsi=0.7, dx=1.1)
    values = dict(zip(model.jet_names, z, strict=True))
    v = values["dx"] / np.cos(0.4)
    assert values["d2psi"] == pytest.approx(0, abs=1e-14)
    assert [values["d2x"], values["d2y"]] == pytest.approx([-v * 0.7 * np.sin(0.4), v * 0.7 * np.cos(0.4)], rel=1e-12)
    reaction = signal(model, "reaction", 0.0, z)
    assert [reaction["reaction_x"], reaction["reaction_y"]] == pytest.approx([2 * values["d2x"], 2 * values["d2y"]])


@pytest.mark.parametrize("by", ["ideal", "actuators"])
def test_a_residual_nonlinear_in_its_highest_derivative_is_raised_once(by):
    """Ideal, x''y'' = 1 asks for a reaction along (y'', x''): x'' = y''. By a force on x, y'' = -9.81 falls free."""
    q = sv.coordinates("x y")
    (x, y), (ddx, ddy) = q, q.d(2)
    U = 0 if by == "ideal" else 9.81 * y
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=U, actuators={"a": x})
    model = derive(mechanism, sv.Program({"product": ddx * ddy - 1}, by=by))
    assert orders(model) == [2, 2] and model.reduction.top == 3
    assert not next(row for row in model.reduction.rows if row.name == "product").affine
    held = {"x": 0.0, "y": 0.0, "dx": 1.0, "dy": 0.0}
    guess = {"d2x": 1.1, "d2y": 0.9} if by == "ideal" else {"d2x": -0.1, "d2y": -9.0}
    z = dict(zip(model.jet_names, motion(model, 0.0, guess=guess, **held), strict=True))
    expected = (1.0, 1.0) if by == "ideal" else (-1 / 9.81, -9.81)
    assert (z["d2x"], z["d2y"]) == pytest.approx(expected, rel=1e-12)
    assert (z["d3x"], z["d3y"]) == pytest.approx((0, 0), abs=1e-12)


def test_a_reaction_along_the_acceleration_itself_determines_nothing():
    """x''² + y''² = 4, ideal: every acceleration of that size is admissible."""
    q, mechanism = particle()
    ddx, ddy = q.d(2)
    with refused(NotRealisable, "acceleration", rows=["balance of y", "acceleration"]):
        derive(mechanism, sv.Program({"acceleration": ddx**2 + ddy**2 - 4}, by="ideal"))


@pytest.mark.parametrize("by", ["ideal", "actuators"])
def test_a_machine_of_one_coordinate_that_is_driven_has_no_row_of_3_18(by):
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, x), actuators={"a": x})
    model = derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}, by=by))
    assert orders(model) == [0]
    u = signal(model, "actuation" if by == "actuators" else "reaction", 0.7, motion(model, 0.7))
    assert list(u.values()) == pytest.approx([-2 * np.sin(0.7)], rel=1e-12)


@pytest.mark.parametrize("by", ["ideal", "actuators"])
@pytest.mark.parametrize(
    "second",
    [
        lambda x, y, q: x - ca.sin(q.t),
        lambda x, y, q: 1e6 * (x - ca.sin(q.t)),
        lambda x, y, q: q.d(1)[0] - ca.cos(q.t),
        lambda x, y, q: (x - ca.sin(q.t)) * (2 + y**2),
    ],
)
def test_redundant_constraints_are_named(by, second):
    q, mechanism = particle("x y z")
    x, y, _ = q
    with refused(SpecificationError, "dependent", rows=["first", "second"]) as caught:
        derive(mechanism, sv.Program({"first": x - ca.sin(q.t), "second": second(x, y, q)}, by=by))
    assert "first" in str(caught.value) and "second" in str(caught.value)
    assert set(caught.value.details["rows"]) == {"first", "second"}


@pytest.mark.parametrize("by", ["ideal", "actuators"])
@pytest.mark.parametrize(
    "second",
    [
        lambda x, q: x - 2,
        lambda x, q: 1e-6 * (x - 2),
        lambda x, q: q.d(1)[0] - 3,
        lambda x, q: q.d(2)[0] - ca.cos(q.t),
    ],
)
def test_contradictory_constraints_are_named(by, second):
    q, mechanism = particle("x y z")
    x, *_ = q
    with refused(SpecificationError, "contradict", rows=["first", "second"]) as caught:
        derive(mechanism, sv.Program({"first": x - 1, "second": second(x, q)}, by=by))
    assert "first" in str(caught.value) and "second" in str(caught.value)


def test_only_the_constraints_that_depend_are_named():
    q, mechanism = particle("x y z")
    x, y, z = q
    program = {"height": z - 1, "sum": x + y - 1, "difference": x - y, "both": 3 * x + y - 2}
    with refused(SpecificationError, "dependent", rows=["sum", "difference", "both"]) as caught:
        derive(mechanism, sv.Program(program, by="ideal"))
    assert set(caught.value.details["rows"]) == {"sum", "difference", "both"}
    assert "height" not in str(caught.value)


@pytest.mark.parametrize("by", ["ideal", "actuators"])
@pytest.mark.parametrize(
    "square", [lambda x, y: x**2, lambda x, y: (x - y) ** 2, lambda x, y: x**2 + y**2, lambda x, y: x**4]
)
def test_squares_are_refused_as_singular(by, square):
    q, mechanism = particle()
    with refused(SingularProgram, row="squared") as caught:
        derive(mechanism, sv.Program({"squared": square(*q)}, by=by))
    assert "squared" in str(caught.value)
    assert caught.value.details["row"] == "squared"


@pytest.mark.parametrize("beside", [False, True])
def test_a_squared_velocity_constraint_is_refused_as_singular(beside):
    q, mechanism = particle("x y z")
    dx, dy, dz = q.d(1)
    program = {"squared": (dx - 2 * dy) ** 2} | ({"slope": dz - dx} if beside else {})
    with refused(SingularProgram, row="squared"):
        derive(mechanism, sv.Program(program, by="ideal"))


def test_a_program_without_a_solution_is_no_consistent_start():
    q, mechanism = particle()
    x, y = q
    with refused(InconsistentStart, rows=["circle"]) as caught:
        derive(mechanism, sv.Program({"circle": x**2 + y**2 + 1}, by="ideal"))
    assert caught.value.details["rows"] == ["circle"]


def test_a_guess_leads_to_a_solution_that_is_far_away():
    q, mechanism = particle()
    x, y = q
    program = sv.Program({"far": (x - 1e4) ** 2 + y**2 - 1}, by="ideal")
    assert derive(mechanism, program, guess={"x": 1e4}).free == 2


# who acts ------------------------------------------------------------------------------------------------------------


def test_too_few_actuators_name_both_sets():
    q = sv.coordinates("x y z")
    x, y, z = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y, z)), actuators={"left": x, "right": 2 * x})
    with pytest.raises(NotRealisable) as caught:
        derive(mechanism, sv.Program({"X": x - q.t, "Y": y}))
    facts = ("X", "Y", "left", "right", "2 residuals", "1 independent")
    assert [fact for fact in facts if fact not in str(caught.value)] == []
    assert caught.value.details["residuals"] == ["X", "Y"]
    assert caught.value.details["actuators"] == ["left", "right"]


def test_an_actuator_that_never_reaches_the_program():
    q, mechanism = particle("x y z")
    x, _, z = q
    with refused(NotRealisable, rows=["height", "balance of z"]) as caught:
        derive(mechanism, sv.Program({"height": z - ca.sin(q.t), "X": x}))
    assert "height" in str(caught.value)


def test_an_actuator_on_what_a_material_constraint_holds_is_refused():
    """The actuator pushes straight against a rail."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={"push": y}, constraints={"rail": y - 1})
    with pytest.raises(NotRealisable) as caught:
        derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}))
    assert "push" in str(caught.value) and "X" in str(caught.value)


def test_a_residual_that_a_material_constraint_already_holds_is_refused():
    q = sv.coordinates("x y")
    x, y = q
    S = sv.particle(q, 1.0, (x, y))
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"a": x, "b": y}, constraints={"rail": y - 1})
    for by in ("ideal", "actuators"):
        with pytest.raises((SpecificationError, NotRealisable)) as caught:
            derive(mechanism, sv.Program({"height": 2 * y - 2}, by=by))
        assert "height" in str(caught.value) and "rail" in str(caught.value)


def test_one_name_for_a_residual_and_a_material_constraint_is_refused():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={"a": x}, constraints={"same": y - 1})
    with refused(SpecificationError, "'same'"):
        derive(mechanism, sv.Program({"same": x - q.t}))


def test_a_force_that_jumps_is_as_rough_as_a_path():
    """The actuation holds the second derivative of the force on car 1, which a jump does not have."""
    q = sv.coordinates("x1 x2")
    x1, x2 = q
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, 1.0, x1) + sv.particle(q, 2.0, x2),
        potential=(x1 - x2) ** 2 / 2,
        forces={"x1": q.references(push=sv.paths.polynomials([0.0, 1.0, 2.0], [[0.0, 1.0]])).push},
        actuators={"f": x2},
    )
    model = derive(mechanism, sv.Program({"X": x1 - ca.sin(q.t)}))
    with refused(SpecificationError, "push", "a jump", needs=2, has=-1, t=1.0):
        sv.simulate(model, model.start(), (0.0, 2.0))


# other roads into a reduction ----------------------------------------------------------------------------------------


def test_a_mechanism_by_kinetic_energy_or_balance_reduces_alike():
    mechanism, program = overhead_crane()
    q, p = mechanism.q, mechanism.parameters
    x, l, theta = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    (dx, dl, _), v = q.d(1), q.dt(load)
    T = (p.m_trolley * dx**2 + p.m_hoist * dl**2 + p.m_load * ca.dot(v, v)) / 2
    machine = {"actuators": {"trolley": x, "hoist": l}, "parameters": p}
    found = []
    for other in (
        mechanism,
        sv.Mechanism(q, kinetic=T, potential=-p.m_load * p.g * load[1], **machine),
        sv.Mechanism(q, balance=mechanism.balance, **machine),
    ):
        model = derive(other, program)
        found.append(list(signal(model, "actuation", 2.0, motion(model, 2.0, guess={"l": 4.0})).values()))
    assert found[1] == pytest.approx(found[0], rel=1e-10)
    assert found[2] == pytest.approx(found[0], rel=1e-10)


def test_a_quaternion_attitude_program_by_three_torques():
    """A body turned about a fixed axis by three body-fixed torques: u = Jω' + ω×Jω."""
    plain = sv.coordinates("e0 e1 e2 e3")
    e0, e1, e2, e3 = plain
    V = [[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]]
    unit = {"unit": sum(e**2 for e in plain) - 1}
    q = plain.with_quasi_velocities("p q r", [[v / 2 for v in row] for row in V], invariants=unit)
    J, axis, half = np.array([2.0, 1.5, 1.0]), np.array([2.0, -1.0, 2.0]) / 3, 0.2 * ca.sin(q.t)
    torques = {"a": (1, 0, 0), "b": (0, 1, 0), "c": (0, 0, 1)}
    mechanism = sv.Mechanism(q, gibbs=sv.rigid_body(q, 0, tuple(J), rates=q.w()), actuators=torques)
    program = sv.Program({f"turn {i + 1}": e - axis[i] * ca.sin(half) for i, e in enumerate((e1, e2, e3))})
    model = derive(mechanism, program, guess={"e0": 1.0})
    assert orders(model) == [0, 0, 0] and model.flat
    t = 0.9
    jets = motion(model, t, guess={"e0": 1.0})
    z = dict(zip(model.jet_names, jets, strict=True))
    angle, omega, alpha = 0.4 * np.sin(t), 0.4 * np.cos(t) * axis, -0.4 * np.sin(t) * axis
    assert [z[n] for n in q.names] == pytest.approx([np.cos(angle / 2), *(axis * np.sin(angle / 2))], abs=1e-12)
    assert [z[n] for n in q.velocity_names] == pytest.approx(omega, abs=1e-11)
    u = signal(model, "actuation", t, jets)
    assert list(u.values()) == pytest.approx(J * alpha + np.cross(omega, J * omega), abs=1e-10)


def test_a_rolling_disk_with_material_constraints():
    """An upright disk that rolls and turns under two torques; the ground holds it."""
    q = sv.coordinates("x y psi phi")
    (x, y, psi, phi), (dx, dy, dpsi, dphi) = q, q.d(1)
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.rigid_body(q, 2.0, (0.1, 0.25, 0.1), position=(x, y), rates=(0, dphi, dpsi)),
        actuators={"drive": phi, "steer": psi},
        constraints={"roll_x": dx - 0.5 * dphi * ca.cos(psi), "roll_y": dy - 0.5 * dphi * ca.sin(psi)},
    )
    model = derive(mechanism, sv.Program({"spin": dphi - 2 * q.t, "turn": psi - 0.3 * q.t**2}))
    assert sorted(orders(model)) == [0, 1, 1, 1] and model.free == 3
    jets = motion(model, 0.5, x=0.0, y=0.0, phi=0.0)
    u = signal(model, "actuation", 0.5, jets)
    assert u == pytest.approx({"drive": (0.25 + 2.0 * 0.25) * 2.0, "steer": 0.1 * 0.6}, rel=1e-12)
    z = dict(zip(model.jet_names, jets, strict=True))
    held = signal(model, "multipliers", 0.5, jets)
    expected = {"multiplier_roll_x": 2.0 * z["d2x"], "multiplier_roll_y": 2.0 * z["d2y"]}
    assert held == pytest.approx(expected, rel=1e-12)


def test_a_load_lifted_straight_up_hides_the_constraint_that_it_does_not_swing():
    """On the manifold sin θ is zero wherever it appears; the combination is found about the motion."""
    mechanism, program = overhead_crane()
    x, l, theta = mechanism.q
    path = mechanism.q.references(below=sv.paths.rest_to_rest(2.0, 6.0, duration=3.0, smoothness=4)).below
    lift = sv.Program({"X": x + l * ca.sin(theta), "Z": l * ca.cos(theta) - path})
    model = derive(mechanism, lift)
    assert orders(model) == [0, 0, 0] and model.reduction.needs == {"X": 4, "Z": 4}
    for t in (0.0, 0.7, 1.9):
        jets = motion(model, t, guess={"l": 3.0})
        named = dict(zip(model.jet_names, jets, strict=True))
        assert abs(named["theta"]) < 1e-15
        force = signal(model, "actuation", t, jets)
        assert force["trolley"] == pytest.approx(0.0, abs=1e-9)
        assert force["hoist"] == pytest.approx(105.0 * named["d2l"] - 100.0 * 9.81, abs=1e-9)


@pytest.mark.parametrize("names", ["a b", "b a"])
def test_a_hidden_row_replaces_one_of_the_dynamics_and_not_the_residual(names):
    """A mass b is moved by a spring from a: the acceleration of b is that of the residual if k (a - b) = m b''."""
    q = sv.coordinates(names)
    position, acceleration = (dict(zip(names.split(), symbols, strict=True)) for symbols in (q, q.d(2)))
    a, b = position["a"], position["b"]
    gibbs = sv.particle(q, 1.0, a) + sv.particle(q, 2.0, b)
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=3.0 * (a - b) ** 2 / 2, actuators={"f": a})
    r = derive(mechanism, sv.Program({"B": acceleration["b"] + ca.sin(q.t)})).reduction
    written, hidden = r.rows
    assert (written.name, written.order, written.derivation) == ("B", 2, "")
    assert (hidden.kind, hidden.order) == ("dynamics", 0) and "B" in hidden.derivation
    assert r.free == 2


@pytest.mark.parametrize("turned", [0.0, 0.7, np.pi / 2])
def test_a_jet_that_is_zero_in_every_motion_divides_no_row(turned):
    """A force along φ_γ'' cannot carry a weight across it: of d2x² + d2y² = 100 only motions along gravity are left.

    M γ'' + (0, m g) = μ (2 x'', 2 y'') has x'' (m - 2 μ) = 0, and y'' (m - 2 μ) = -m g rules out m = 2 μ.
    """
    q = sv.coordinates("x y")
    x, y = q
    cosine, sine = np.cos(turned), np.sin(turned)
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, (x, y)), potential=2.0 * 9.81 * (cosine * y - sine * x))
    guess = {"d2x": -10 * sine, "d2y": 10 * cosine}
    model = derive(mechanism, sv.Program({"a": q.d(2)[0] ** 2 + q.d(2)[1] ** 2 - 100.0}, by="ideal"), guess=guess)
    run = simulate(model, model.start(x=0.0, y=0.0, dx=1.0, dy=0.0, guess=guess), (0.0, 1.0))
    assert run["x"] == pytest.approx(run.t - 5 * sine * run.t**2, abs=1e-9)
    assert run["y"] == pytest.approx(5 * cosine * run.t**2, abs=1e-9)
    assert verify(run).passed


def test_a_ball_rolls_from_the_identity():
    """On a table that turns by Ω, a ball with J = 2/5 m r² moves on a circle at 2/7 Ω; half the pivots are zero here."""
    plain = sv.coordinates("x y e0 e1 e2 e3")
    x, y, e0, e1, e2, e3 = plain
    turn = [[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]]
    V = [[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], *([0, 0, *(c / 2 for c in row)] for row in turn)]
    unit = {"unit": e0**2 + e1**2 + e2**2 + e3**2 - 1}
    q = plain.with_quasi_velocities("vx vy w1 w2 w3", V, invariants=unit)
    vx, vy, *w = q.w()
    rows = [
        [1 - 2 * (e2**2 + e3**2), 2 * (e1 * e2 - e0 * e3), 2 * (e1 * e3 + e0 * e2)],
        [2 * (e1 * e2 + e0 * e3), 1 - 2 * (e1**2 + e3**2), 2 * (e2 * e3 - e0 * e1)],
    ]
    W = [sum(r * s for r, s in zip(row, w, strict=True)) for row in rows]
    rates = q.w(1)
    gibbs = (rates[0] ** 2 + rates[1] ** 2) / 2 + 0.4 * (rates[2] ** 2 + rates[3] ** 2 + rates[4] ** 2) / 2
    program = sv.Program({"rx": vx - W[1] + 0.7 * y, "ry": vy + W[0] - 0.7 * x}, by="ideal")
    model = derive(sv.Mechanism(q, gibbs=gibbs), program)
    start = model.start(x=1.0, y=0.0, vx=0.0, vy=0.3, e1=0.0, e2=0.0, e3=0.0, w3=0.0, guess={"e0": 1.0})
    run = simulate(model, start, (0.0, 5.0), Adaptive(rtol=1e-10, atol=1e-12))
    velocity = run["vx"] + 1j * run["vy"]
    assert velocity == pytest.approx(0.3j * np.exp(0.2j * run.t), abs=1e-7)


def test_a_rolling_machine_of_few_velocities_is_programmed_by_rates():
    """Both wheels of a robot drive it along its heading: x and y are independent, but move along v alone."""
    xy = sv.coordinates("x y psi")
    psi = list(xy)[2]
    q = xy.with_quasi_velocities("v w", [[ca.cos(psi), 0], [ca.sin(psi), 0], [0, 1]])
    x, y, _ = q
    gibbs = sv.rigid_body(q, 20.0, (0, 0, 1.5), position=(x, y), rates=(0, 0, q.w()[1]))
    mechanism = sv.Mechanism(q, gibbs=gibbs, actuators={"left": (1, -0.2), "right": (1, 0.2)})
    path = {"x": x - q.t, "y": y - 0.1 * q.t**2}
    with refused(SpecificationError, "q.dt(residual, 1)", rows=["x", "y"], velocities=("v", "w")):
        derive(mechanism, sv.Program(path))
    model = derive(mechanism, sv.Program({name: q.dt(residual, 1) for name, residual in path.items()}))
    run = simulate(model, model.start(x=0.0, y=0.0, guess={"v": 1.0}), (0.0, 2.0))
    assert run["x"] == pytest.approx(run.t, abs=1e-9) and run["y"] == pytest.approx(0.1 * run.t**2, abs=1e-9)
    assert run["v"] == pytest.approx(np.hypot(1, 0.2 * run.t), abs=1e-9) and verify(run).passed


def test_rows_that_depend_at_a_point_are_no_rows_to_combine_by():
    rows = [SimpleNamespace(name=name) for name in "abc"]
    with refused(SingularProgram, rows=["a", "b"]):
        hidden._combine(None, rows, 2, [0, 1], 2, np.ones((3, 3, 2)), None)
