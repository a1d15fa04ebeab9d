"""Consistent starts: held values, outputs and conditions; other states with the same held values; refusals."""

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import unknown
from servoctl.gallery import gallery, trailers
from servoctl.model.start import State


def two_link_arm():
    """Unit links with unit masses at the elbow and the tip; S, the position of the tip, and q."""
    q = sv.coordinates("q1 q2")
    a, b = q
    elbow = ca.vertcat(ca.cos(a), ca.sin(a))
    tip = elbow + ca.vertcat(ca.cos(a + b), ca.sin(a + b))
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 1.0, elbow) + sv.particle(q, 1.0, tip), potential=9.81 * (elbow[1] + tip[1]),
        actuators={"shoulder": a, "elbow": b}, outputs={"X": tip[0], "Y": tip[1]},
    )  # fmt: skip
    return mechanism, tip


def curvature(q, position):
    (vx, vy), (ax, ay) = (q.dt(position, k).elements() for k in (1, 2))
    return (vx * ay - vy * ax) / (vx**2 + vy**2) ** 1.5


@pytest.fixture(scope="module")
def clothoid_arm():
    """The tip's curvature changes at a constant rate per length, ideally: order 3, one linear equation in q''."""
    mechanism, tip = two_link_arm()
    kappa = curvature(mechanism.q, tip)
    speed = ca.sqrt(ca.sumsqr(mechanism.q.dt(tip)))
    model = sv.derive(mechanism, sv.Program({"clothoid": mechanism.q.dt(kappa) - 0.1 * speed}, by="ideal"))
    jets = [mechanism.q.jet(k) for k in range(3)]
    slope = ca.jacobian(kappa, jets[2])
    return model, ca.Function("work", jets, [mechanism.balance[0] * slope[1] - mechanism.balance[1] * slope[0]])


@pytest.mark.parametrize("guess", [{"d2q1": 0.0}, {}])
def test_every_start_of_an_arm_with_given_positions_and_velocities_exists(clothoid_arm, guess):
    """The reaction r is along the gradient of the curvature in q'': r1 G2 - r2 G1 = 0."""
    model, work = clothoid_arm
    rng = np.random.default_rng(1)
    for _ in range(261):
        held = dict(zip(("q1", "q2", "dq1", "dq2"), rng.uniform(-3.0, 3.0, 4), strict=True))
        start = model.start(guess=guess, **held)
        assert {name: start[name] for name in held} == held and start.residual < 1e-12
        parts = np.split(start.values, 3)
        scale = np.abs(parts[2]).max() + np.abs(parts[1]).max() ** 2 + 9.81
        assert abs(float(work(*parts))) < 1e-8 * scale**2 and len(start.branches) == 1


# outputs and conditions ----------------------------------------------------------------------------------------------


def free_point(program, by="ideal"):
    """A particle of 2 kg in the plane with its speed, heading and curvature as outputs."""
    q = sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    outputs = {"speed": ca.sqrt(dx**2 + dy**2), "heading": ca.atan2(dy, dx), "kappa": curvature(q, ca.vertcat(x, y))}
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)), outputs=outputs | {"east": x})
    return sv.derive(mechanism, sv.Program(program(q, outputs), by=by))


@pytest.fixture(scope="module")
def clothoid():
    return free_point(lambda q, outputs: {"clothoid": q.dt(outputs["kappa"]) - 0.2 * outputs["speed"]})


@pytest.fixture(scope="module")
def constant_speed():
    return free_point(lambda q, outputs: {"speed of 4": outputs["speed"] ** 2 - 16})


@pytest.mark.parametrize("degrees", [30.0, 143.0, 175.0, -90.0, 0.0])
@pytest.mark.parametrize("kappa", [0.5, -2.0, 0.0])
def test_a_start_holds_outputs_by_name(clothoid, degrees, kappa):
    """The ideal reaction is across the path: x'' = v² κ n."""
    angle = np.radians(degrees)
    start = clothoid.start(east=1.0, y=2.0, speed=3.0, heading=angle, kappa=kappa)
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    assert start.values == pytest.approx([1.0, 2.0, *(3 * along), *(9 * kappa * across)], abs=1e-12)
    assert start.held == ("east", "y", "speed", "heading", "kappa") and start.free == ()


def test_a_start_holds_expressions_by_name(clothoid):
    q = clothoid.reduction.mechanism.q
    dx, dy = q.d(1)
    conditions = {"momentum": 2 * dx - 3.0, "diagonal": dy - dx, "turn": curvature(q, ca.vertcat(*q)) - 0.5}
    start = clothoid.start(x=0.0, y=0.0, hold=conditions)
    assert start.values[2:4] == pytest.approx([1.5, 1.5]) and start.held[2:] == ("momentum", "diagonal", "turn")
    assert start.values[4:] == pytest.approx(0.5 * 4.5 / np.sqrt(2) * np.array([-1.0, 1.0]))  # v² κ n


def test_momentum_zero_in_an_actuated_program():
    """A cart whose pendulum follows a path: the start at which both together have no momentum along x."""
    q = sv.coordinates("x theta")
    x, theta = q
    load = ca.vertcat(x + ca.sin(theta), -ca.cos(theta))
    momentum = 2.0 * q.dt(x) + q.dt(load)[0]
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 2.0, x) + sv.particle(q, 1.0, load), potential=9.81 * load[1],
        actuators={"force": x}, outputs={"momentum": momentum},
    )  # fmt: skip
    model = sv.derive(mechanism, sv.Program({"swing": theta - 0.3 * ca.sin(q.t)}))
    start = model.start(t=0.5, x=0.1, momentum=0.0)
    rate = 0.3 * np.cos(0.5) * np.cos(0.3 * np.sin(0.5))
    assert start["dx"] == pytest.approx(-rate / 3, rel=1e-12)


def test_conditions_may_contain_higher_derivatives_than_the_state():
    """A damped spring: its acceleration and its jerk are no entries of the state."""
    q = sv.coordinates("x theta")
    x, theta = q
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 2.0, x) + sv.particle(q, 1.0, theta), actuators={"force": x},
        forces={"theta": -0.8 * q.dt(theta) - 3.0 * theta}, outputs={"second": q.dt(theta, 2)},
    )  # fmt: skip
    model = sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}))
    start = model.start(theta=0.2, second=0.4)
    assert start["dtheta"] == pytest.approx(-(0.4 + 3 * 0.2) / 0.8) and start.names == model.state_names
    start = model.start(theta=0.2, hold={"jerk": q.dt(theta, 3) - 1.0})
    assert -0.8 * (-0.8 * start["dtheta"] - 0.6) - 3 * start["dtheta"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("kind", "arguments", "details"),
    [
        (sv.errors.NameUnknown, {"spead": 1.0}, {"match": "speed"}),
        (sv.errors.NameUnknown, {"d3x": 1.0}, {"match": "d2x"}),
        (sv.errors.NameUnknown, {"d9y": 1.0}, {"match": "d2y"}),
        (sv.errors.SpecificationError, {"speed": np.nan}, {"name": "speed"}),
        (sv.errors.SpecificationError, {"hold": [1.0]}, {"what": "The conditions"}),
        (sv.errors.SpecificationError, {"hold": {"a": 3.0}}, {"name": "a"}),
        (sv.errors.SpecificationError, {"hold": {"a": "x"}}, {"type": "str"}),
        (sv.errors.SpecificationError, {"hold": {"a": ca.SX.sym("z")}}, {"name": "z"}),
        (sv.errors.InconsistentStart, {"x": 1.0, "east": 0.0}, {"held": "x", "nearest_value": 0.0}),
        (sv.errors.InconsistentStart, {"x": 0.0, "speed": -1.0}, {"held": "speed", "value": -1.0}),
    ],
)
def test_what_cannot_be_held_is_refused(clothoid, kind, arguments, details):
    with refused(kind, **details):
        clothoid.start(**arguments)


@pytest.mark.parametrize("name", ["speed", "x"])
def test_a_condition_does_not_take_the_name_of_a_state_or_an_output(clothoid, name):
    x, _ = clothoid.reduction.mechanism.q
    with refused(sv.errors.SpecificationError, f"{name}=", name=name):
        clothoid.start(hold={name: x - 1.0})


def test_an_output_that_the_dynamics_forbid_is_refused(constant_speed):
    """A free particle of constant speed goes straight on."""
    with refused(sv.errors.InconsistentStart, "kappa = 0.5", held="kappa") as caught:
        constant_speed.start(x=0.0, y=0.0, kappa=0.5)
    assert caught.value.details["nearest_value"] == pytest.approx(0.0, abs=1e-9)


def test_coordinates_do_not_take_names_of_a_starts_arguments():
    with refused(sv.errors.SpecificationError, "hold", name="hold"):
        sv.coordinates("x hold")


@pytest.mark.parametrize("names", ["x, y", "x,y", "x,y,", "x ,y"])
def test_names_with_commas_are_refused_with_the_names_as_they_should_be(names):
    with refused(sv.errors.SpecificationError, "'x y'", "blanks", names=names):
        sv.coordinates(names)
    with refused(sv.errors.SpecificationError, "'x y'", names=names):
        sv.coordinates("a b").with_quasi_velocities(names, np.eye(2))


@pytest.mark.parametrize("begins, rests", [
    (lambda q, x: x - q.t**3, True),
    (lambda q, x: x - (10 * q.t**3 - 15 * q.t**4 + 6 * q.t**5), True),
    (lambda q, x: q.dt(x, 2) - 6 * q.t, False),
    (lambda q, x: x - q.t**2, False),
])  # fmt: skip
def test_a_program_rests_where_its_residual_does_to_first_order(begins, rests):
    """The load of a crane hangs down where its trolley begins with a jump of the jerk, and where it does not it swings."""
    q = sv.coordinates("x theta")
    x, theta = q
    load = ca.vertcat(x + ca.sin(theta), -ca.cos(theta))
    crane = sv.Mechanism(
        q, gibbs=sv.particle(q, 10.0, x) + sv.particle(q, 100.0, load), potential=981.0 * load[1], actuators={"trolley": x}
    )
    start = sv.derive(crane, sv.Program({"path": begins(q, x)})).start(guess={"theta": 0.3})
    assert start["theta"] == pytest.approx(0.0 if rests else 0.3, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "valid", "nearest"),
    [
        ("d3q1", ("q1", "dq1", "d2q1", "d2q2"), "d2q1"),
        ("d2q1", ("q1", "dq1", "dq2"), "dq1"),
        ("ddq1", ("q1", "dq1", "d2q1", "d2q2"), "d2q1"),
        ("ddq1", ("q1", "dq1", "dq2"), "dq1"),
        ("dq1", ("q1", "q2"), "q1"),
        ("delta", ("beta", "deltas"), "deltas"),
    ],
)
def test_the_nearest_name_of_a_derivative_has_the_nearest_order(name, valid, nearest):
    assert unknown(name, valid, "state").details["match"] == nearest


# other states with the same held values ------------------------------------------------------------------------------


def test_both_signs_of_a_speed_are_named(constant_speed):
    start = constant_speed.start(x=0.0, y=0.0, dx=0.0)
    assert sorted(start.branches[:, 3]) == pytest.approx([-4.0, 4.0]) and start.branches[0, 3] == start["dy"]
    assert "dy = -4" in repr(start) and "2 branches" in repr(start)
    for guess in (3.0, -3.0):
        chosen = constant_speed.start(x=0.0, y=0.0, dx=0.0, guess={"dy": guess})
        assert chosen["dy"] == pytest.approx(np.copysign(4.0, guess)) and "branches" not in repr(chosen)


def test_both_elbows_of_an_arm_are_named():
    mechanism, tip = two_link_arm()
    t = mechanism.q.t
    model = sv.derive(mechanism, sv.Program({"X": tip[0] - 1.2 - 0.1 * t, "Y": tip[1] - 0.5}))
    start = model.start()
    bend = np.arccos((1.2**2 + 0.5**2 - 2) / 2)
    assert sorted(start.branches[:, 1]) == pytest.approx([-bend, bend])
    for branch in start.branches:  # the tip's velocity is (0.1, 0) on both
        a, b, da, db = branch[:4]
        J = np.array([[-np.sin(a) - np.sin(a + b), -np.sin(a + b)], [np.cos(a) + np.cos(a + b), np.cos(a + b)]])
        assert J @ [da, db] == pytest.approx([0.1, 0.0], abs=1e-9)


def line(polynomial):
    """x at a root of a polynomial, and y = x."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, ca.vertcat(x, y)), actuators={"a": x, "b": y})
    return sv.derive(mechanism, sv.Program({"root": polynomial(x), "line": y - x}), guess={"x": 1.1})


def test_only_roots_that_are_about_as_near_zero_are_named():
    start = line(lambda x: (x**2 - 1) * (x - 3)).start()
    assert sorted(start.branches[:, 0]) == pytest.approx([-1.0, 1.0], abs=1e-12)
    assert start.branches[:, 1] == pytest.approx(start.branches[:, 0])


def test_a_root_at_zero_is_a_clear_choice():
    start = line(lambda x: x * (x - 1) * (x + 2)).start()
    assert start["x"] == pytest.approx(0.0, abs=1e-12) and len(start.branches) == 1


@pytest.mark.parametrize("name", ["appell-hamel", "two-cars", "three-cars", "mass-on-car", "vtol", "overhead-crane"])
def test_no_branches_where_the_guess_or_the_equations_leave_one(name, gallery_model):
    scene = gallery[name]
    start = gallery_model(name).start(t=scene.t_span[0], guess=scene.guess, **scene.start)
    assert len(start.branches) == 1 and "branches" not in repr(start)


def test_turns_of_an_angle_are_no_branches():
    q = sv.coordinates("x theta")
    x, theta = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, ca.vertcat(x, theta)), actuators={"a": x, "b": theta})
    start = sv.derive(mechanism, sv.Program({"X": x + ca.sin(theta), "angle": ca.cos(theta) - 0.2})).start()
    assert sorted(np.cos(start.branches[:, 1])) == pytest.approx([0.2, 0.2]) and len(start.branches) == 2


def test_a_quaternion_and_its_opposite_are_one_start():
    """e and -e are the same attitude."""
    q = sv.coordinates("e0 e1 e2 e3")
    e = ca.vertcat(*q)
    e0, e1, e2, e3 = q
    V = [[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]]
    q = q.with_quasi_velocities("p q r", [[v / 2 for v in row] for row in V], invariants={"unit": ca.dot(e, e) - 1})
    gibbs = ca.sumsqr(ca.vertcat(*q.w(1)) * ca.DM([1.0, 1.1, 1.2])) / 2
    mechanism = sv.Mechanism(q, gibbs=gibbs, actuators={f"torque {k}": ca.SX.eye(3)[:, k] for k in range(3)})
    attitude = {"a": e1 * e0 - 0.1, "b": e2 * e0 - 0.2, "c": e3 * e0 + 0.1}
    start = sv.derive(mechanism, sv.Program(attitude), guess={"e0": 1.0}).start(guess={"e1": 0.1})
    assert len(start.branches) == 1 and start["e0"] * start["e2"] == pytest.approx(0.2)


# machines that roll, at rest -----------------------------------------------------------------------------------------


def path_from_rest(q, speed=0.0):
    """3 s, sin 2s along s, which begins with the slope 2/3 and the curvature 0."""
    s = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=4.0, smoothness=5)).s + speed * q.t
    return 3 * s, ca.sin(2 * s)


def wheels(speed=0.0):
    """Two driven wheels: no slip across the heading psi."""
    q = sv.coordinates("x y psi")
    (x, y, psi), (dx, dy, dpsi) = q, q.d(1)
    mechanism = sv.Mechanism(
        q, gibbs=sv.rigid_body(q, 10.0, (0, 0, 1.0), position=(x, y), rates=(0, 0, dpsi)),
        constraints={"slip": -dx * ca.sin(psi) + dy * ca.cos(psi)},
        actuators={"push": ca.vertcat(ca.cos(psi), ca.sin(psi), 0), "turn": psi},
    )  # fmt: skip
    path = path_from_rest(q, speed)
    return sv.derive(mechanism, sv.Program({"X": x - path[0], "Y": y - path[1]}))


def bicycle(speed=0.0):
    """Rear and front wheel, 1 m apart; the front one turns by delta."""
    q = sv.coordinates("x y psi delta")
    (x, y, psi, delta), (dx, dy, dpsi, _) = q, q.d(1)
    rolling = {
        "rear": -dx * ca.sin(psi) + dy * ca.cos(psi),
        "front": -dx * ca.sin(psi + delta) + dy * ca.cos(psi + delta) + dpsi * ca.cos(delta),
    }
    gibbs = sv.rigid_body(q, 10.0, (0, 0, 1.0), position=(x, y), rates=(0, 0, dpsi)) + 0.05 * q.d(2)[3] ** 2
    drive = ca.vertcat(ca.cos(psi), ca.sin(psi), 0, 0)
    mechanism = sv.Mechanism(q, gibbs=gibbs, constraints=rolling, actuators={"drive": drive, "steer": delta})
    path = path_from_rest(q, speed)
    return sv.derive(mechanism, sv.Program({"X": x - path[0], "Y": y - path[1]}))


def trailer(speed=0.0):
    """Two wheels with a trailer, whose axle follows the path."""
    q = sv.coordinates("x y psi theta")
    (x, y, psi, theta), (dx, dy, dpsi, dtheta) = q, q.d(1)
    behind = ca.vertcat(x - ca.cos(theta), y - ca.sin(theta))
    vx, vy = q.dt(behind).elements()
    rolling = {"slip": -dx * ca.sin(psi) + dy * ca.cos(psi), "trailer": -vx * ca.sin(theta) + vy * ca.cos(theta)}
    gibbs = sv.rigid_body(q, 10.0, (0, 0, 1.0), position=(x, y), rates=(0, 0, dpsi))
    gibbs += sv.rigid_body(q, 5.0, (0, 0, 0.5), position=(behind[0], behind[1]), rates=(0, 0, dtheta))
    push = ca.vertcat(ca.cos(psi), ca.sin(psi), 0, 0)
    mechanism = sv.Mechanism(q, gibbs=gibbs, constraints=rolling, actuators={"push": push, "turn": psi})
    path = path_from_rest(q, speed)
    program = sv.Program({"X": behind[0] - path[0], "Y": behind[1] - path[1]})
    return sv.derive(mechanism, program, guess={"x": 1.0, "theta": 0.5, "psi": 0.5})


ROLLING = {"wheels": (wheels, ("psi",)), "bicycle": (bicycle, ("psi", "delta")), "trailer": (trailer, ("psi", "theta"))}


@pytest.mark.parametrize("name", ROLLING)
def test_a_machine_that_rolls_starts_from_rest_at_the_limit_of_its_motion(name):
    """The heading of the path, atan 2/3, and no curvature."""
    build, open_at_rest = ROLLING[name]
    start = build().start()
    assert set(start.at_rest) == set(open_at_rest) and "at rest" in repr(start)
    heading = {angle: np.arctan2(2, 3) for angle in ("psi", "theta")} | {"delta": 0.0}
    assert [start[angle] for angle in open_at_rest] == pytest.approx([heading[a] for a in open_at_rest], abs=2e-7)
    assert start.values[len(start.names) // 2 :] == pytest.approx(0.0, abs=1e-12) and start.residual < 1e-12


@pytest.mark.parametrize("name", ["wheels"])
def test_a_machine_that_stays_at_rest_has_no_limit(name):
    build, open_at_rest = ROLLING[name]
    with refused(sv.errors.SingularProgram, "stands still", *open_at_rest, t=5.0, nearest_time=None):
        build().start(t=5.0)


@pytest.mark.parametrize("name", ["bicycle"])
def test_a_simulation_from_rest_says_that_the_machine_stands_still(name):
    build, open_at_rest = ROLLING[name]
    model = build()
    with refused(sv.errors.SingularProgram, "stands still", *open_at_rest, t=0.0) as caught:
        sv.simulate(model, model.start(), (0.0, 3.0))
    assert "square" not in str(caught.value) and 0 < caught.value.details["nearest_time"] < 0.3


def pushed_car(residuals):
    """A car that does not skid, pushed along its heading and turned, under residuals of its coordinates."""
    q = sv.coordinates("x y psi")
    (x, y, psi), (dx, dy, dpsi) = q, q.d(1)
    gibbs = sv.rigid_body(q, 2.0, (0, 0, 0.5), position=(x, y), rates=(0, 0, dpsi))
    push = ca.vertcat(ca.cos(psi), ca.sin(psi), 0)
    skid = {"skid": -dx * ca.sin(psi) + dy * ca.cos(psi)}
    mechanism = sv.Mechanism(q, gibbs=gibbs, constraints=skid, actuators={"push": push, "turn": psi})
    return sv.derive(mechanism, sv.Program(residuals(q)))


def turning_back(q):
    """A path that turns back at t = 1 s, along a line or a curve, by position or by velocity."""
    s, c, s3 = q.t - q.t**2 / 2, ca.cos(0.3 * q.t), ca.sin(0.3 * q.t)
    return {
        "line": {"X": q["x"] - s, "Y": q["y"] - 0.2 * s},
        "cusp": {"X": q["x"] - s, "Y": q["y"] - s**2},
        "velocity": {"X": q.d(1)[0] - (1 - q.t), "Y": q.d(1)[1] - 0.2 * (1 - q.t)},
        "turning": {"V": c * q.d(1)[0] + s3 * q.d(1)[1] - (1 - q.t), "H": c * q.d(1)[1] - s3 * q.d(1)[0]},
    }


@pytest.mark.parametrize("along", ["line", "cusp", "velocity", "turning"])
def test_a_car_that_turns_back_is_told_to_stand_still_there(along):
    model = pushed_car(lambda q: turning_back(q)[along])
    with refused(sv.errors.SingularProgram, "stands still", "psi", "skid", rows=["skid"], coordinates=("psi",)) as caught:
        sv.simulate(model, model.start(guess={"dx": 1.0}), (0.0, 2.0))
    assert caught.value.details["t"] == pytest.approx(1.0, abs=1e-9)
    assert caught.value.details["nearest_time"] == pytest.approx(1.001)
    assert "square" not in str(caught.value) and caught.value.run.t[-1] <= 1.0


def test_a_car_at_rest_whose_speed_is_free_is_told_to_start_in_motion():
    model = pushed_car(lambda q: {"across": q.dt(q["y"] - 0.3)})
    with refused(sv.errors.SingularProgram, "stands still", "psi", "model.start(dx=", rows=["skid"], nearest_time=None) as caught:
        sv.simulate(model, model.start(), (0.0, 2.0))
    assert caught.value.details["rates"] == ("dx",)


def test_a_car_at_rest_is_told_so_whatever_swings_on_it():
    """A pendulum's rate is free, too, and moves no car; the first motion ends where the car has come to rest."""
    q = sv.coordinates("x y psi phi")
    (x, y, psi, phi), (dx, dy, dpsi, _) = q, q.d(1)
    bob = sv.particle(q, 1.0, ca.vertcat(x + 0.3 * ca.sin(phi), y, -0.3 * ca.cos(phi)))
    mechanism = sv.Mechanism(
        q,
        sv.rigid_body(q, 20.0, (0, 0, 1.5), position=(x, y), rates=(0, 0, dpsi)) + bob,
        actuators={"drive": (ca.cos(psi), ca.sin(psi), 0, 0), "steer": psi},
        constraints={"no slip": dx * ca.sin(psi) - dy * ca.cos(psi)},
        potential=-9.81 * 0.3 * ca.cos(phi),
    )
    path = sv.paths.rest_to_rest((0.0, 0.0), (3**0.5, 1.0), duration=4.0, smoothness=6)
    r = q.references(X=path[0], Y=path[1])
    model = sv.derive(mechanism, sv.Program({"X": x - r.X, "Y": y - r.Y}, by="actuators"))
    for t, remedy in ((0.1, ""), (4.5, "End the motion before")):  # rounding decides how near it the first one comes
        with refused(sv.errors.SingularProgram, "stands still", remedy, rates=()):
            sv.simulate(model, model.start(t=t), (t, 6.0))
    start = model.start(phi=0.3, dphi=1.0)
    assert [start[name] for name in ("psi", "phi", "dphi", "dx")] == pytest.approx([np.pi / 6, 0.3, 1.0, 0.0], abs=1e-6)


def test_a_path_beyond_the_reach_of_an_arm_is_told_to_keep_within():
    """Unit links reach 2 m, where the arm is stretched out."""
    q = sv.coordinates("a b")
    a, b = q
    hand = ca.vertcat(ca.cos(a) + ca.cos(a + b), ca.sin(a) + ca.sin(a + b))
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, hand), actuators={"shoulder": a, "elbow": b})
    path = sv.paths.rest_to_rest(1.0, 2.3, 2.0)
    model = sv.derive(mechanism, sv.Program({"X": hand[0] - q.references(X=path).X, "Y": hand[1]}), guess={"a": 1.0, "b": -2.0})
    with refused(sv.errors.SingularProgram, "'X'", "reaches", rows=["X"]) as caught:
        sv.simulate(model, model.start(guess={"a": 1.0, "b": -2.0}), (0.0, 2.0))
    assert path(caught.value.details["t"]) == pytest.approx(2.0, abs=1e-6)


def test_an_actuator_that_acts_on_no_residual_is_not_told_to_write_residuals_otherwise():
    """With y held the car points along x, where its push does not act on y."""
    model = pushed_car(lambda q: {"across": q.dt(q["y"] - 0.3)})
    with refused(sv.errors.SingularProgram, "'push'", "2", rows=["push"]) as caught:
        sv.simulate(model, model.start(dx=1.0), (0.0, 2.0))
    assert "square" not in str(caught.value)


def rolled(path, duration=4.0):
    """The bicycle of `bicycle` along a path of smoothness 6 from rest."""
    model = bicycle()
    q = model.reduction.mechanism.q
    x, y, *_ = q
    X, Y = path(q.references(along=sv.paths.rest_to_rest(0.0, 1.0, duration=duration, smoothness=6)).along)
    return sv.derive(model.reduction.mechanism, sv.Program({"X": x - X, "Y": y - Y}))


ROLLED = {  # the path and its duration; heading and steering angle at rest, tan δ = curvature times 1 m
    "a slow arc": (lambda s: (3 * ca.sin(s), 3 - 3 * ca.cos(s)), 60.0, (0.0, np.arctan(1 / 3))),
    "backwards": (lambda s: (-3 * s, -s), 4.0, (np.arctan2(1, 3), 0.0)),
}


@pytest.mark.parametrize("name", ROLLED)
def test_a_machine_starts_and_moves_as_the_refusal_says(name):
    path, duration, angles = ROLLED[name]
    model = rolled(path, duration)
    start = model.start()
    assert [start["psi"], start["delta"]] == pytest.approx(angles, abs=1e-5) and "once it moves" in repr(start)
    with refused(sv.errors.SingularProgram, "model.start(t=", "guess=", t=0.0) as caught:
        sv.simulate(model, start, (0.0, 0.9 * duration))
    t = caught.value.details["nearest_time"]
    moving = model.start(t=t, guess={"psi": start["psi"], "delta": start["delta"]})
    run = sv.simulate(model, moving, (t, 0.9 * duration))
    assert sv.verify(run).passed and run["psi"][0] == pytest.approx(start["psi"], abs=1e-3)


def test_the_motion_after_rest_begins_where_the_start_is():
    model = wheels()
    run = sv.simulate(model, model.start(t=0.01), (0.01, 3.9))
    assert run["psi"][0] == pytest.approx(model.start()["psi"], abs=1e-9) and sv.verify(run).passed


@pytest.mark.parametrize("name", ROLLING)
def test_a_machine_in_motion_has_an_ordinary_start(name):
    model = ROLLING[name][0](speed=0.2)
    start = model.start(guess={"x": 1.0, "theta": 0.5, "psi": 0.5} if name == "trailer" else {"psi": 0.5})
    assert start.at_rest == () and start["psi"] == pytest.approx(np.arctan2(2, 3), abs=1e-8)


def test_a_heading_that_is_given_at_rest_is_kept():
    start = wheels().start(psi=0.1)
    assert start["psi"] == 0.1 and start.at_rest == ()


@pytest.mark.parametrize("name", ["two-cars", "mass-on-car", "vtol", "crane-3d", "two-link-arm", "wheeled-robot"])
def test_other_machines_at_rest_leave_nothing_open(name, gallery_model):
    scene = gallery[name]
    assert gallery_model(name).start(t=scene.t_span[0], guess=scene.guess, **scene.start).at_rest == ()


# hidden constraints that divide by zero, and rates of residuals -------------------------------------------------------


def car():
    """A car without lean, 1.1 m long, by the speed v of its rear axle and its steering rate s."""
    plain = sv.coordinates("x y psi delta")
    x, y, psi, delta = plain
    ahead, turn = ca.vertcat(ca.cos(psi), ca.sin(psi)), ca.tan(delta) / 1.1
    q = plain.with_quasi_velocities("v s", [[ahead[0], 0], [ahead[1], 0], [turn, 0], [0, 1]])
    v, s = q.w()
    gibbs = sv.rigid_body(q, 80.0, (0, 0, 8.0), position=ca.vertcat(x, y), rates=(0, 0, v * turn))
    gibbs += sv.rigid_body(q, 0.0, (0, 0, 0.2), rates=(0, 0, v * turn + s))
    return sv.Mechanism(q, gibbs=gibbs, actuators={"drive": (1, 0), "steer": (0, 1)})


def follower():
    """A robot with one trailer, hitched at its axle, by the trailer's speed v and the robot's yaw rate r."""
    plain = sv.coordinates("X Y a b")
    X, Y, a, b = plain
    turn = ca.tan(a - b)
    q = plain.with_quasi_velocities("v r", [[ca.cos(b), 0], [ca.sin(b), 0], [0, 1], [turn, 0]])
    v, r = q.w()
    gibbs = sv.rigid_body(q, 10.0, (0, 0, 1.0), position=ca.vertcat(X, Y), rates=(0, 0, turn * v))
    gibbs += sv.rigid_body(q, 5.0, (0, 0, 1.0), position=ca.vertcat(X + ca.cos(b), Y + ca.sin(b)), rates=(0, 0, r))
    return sv.Mechanism(q, gibbs=gibbs, actuators={"push": (1 / ca.cos(a - b), 0), "turn": (0, 1)})


def bent(q):
    return q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=4.0, smoothness=6)).s


def headed(mechanism, angle, target=bent, rate=False):
    """A program of one direction and of the speed, 2 m/s; by the rate of the direction on request."""
    q = mechanism.q
    error = dict(zip(q.names, q, strict=True))[angle] - target(q)
    return mechanism, sv.Program({"heading": q.dt(error) if rate else error, "speed": q.w()[0] - 2.0}, by="actuators")


def curved():
    """The trailers of the gallery by the curvature itself, in place of its rate."""
    mechanism, _ = trailers()
    q = mechanism.q
    _, _, _, first, last = q
    return mechanism, sv.Program({"heading": ca.tan(first - last) / 0.8 - bent(q) / 2, "speed": q.w()[0] - 1.0})


UNDIVIDED = {  # the specification, a time at which its direction does not change, and whether it changes later
    "a car": (lambda: headed(car(), "psi"), 0.0, True),
    "a car at the end of its path": (lambda: headed(car(), "psi"), 4.0, False),
    "a car between two bends": (lambda: headed(car(), "psi", lambda q: 0.3 * ca.sin(q.t)), np.pi / 2, True),
    "a trailer": (lambda: headed(follower(), "b"), 0.0, True),
    "two trailers": (curved, 0.0, True),
}


@pytest.mark.parametrize("name", UNDIVIDED)
def test_a_hidden_constraint_that_divides_by_zero_is_refused_with_its_divisor(name):
    """v tan δ = ψ' says nothing of v on a straight line, and the program of ψ and v leaves no other equation for it."""
    build, t, changes = UNDIVIDED[name]
    model = sv.derive(*build())
    with refused(sv.errors.SingularProgram, "divides by", "q.dt(heading, 1)", rows=["speed"], residuals=["heading"]) as caught:
        model.start(t)
    later = caught.value.details["nearest_time"]
    assert (later is not None) == changes
    if changes:
        assert model.start(later).residual < 1e-10


@pytest.mark.parametrize(("build", "angle"), [(car, "psi"), (follower, "b")])
def test_the_rate_of_the_residual_leads_on_where_the_residual_itself_is_singular(build, angle):
    model = sv.derive(*headed(build(), angle, rate=True))
    run = sv.simulate(model, model.start(), (0.0, 5.0), t_eval=np.linspace(0.0, 5.0, 101))
    assert run[angle] == pytest.approx(np.ravel(cf.rest_to_rest(run.t, 0, 0.0, 1.0, 4.0, 6)), abs=1e-7)
    assert sv.verify(run).passed


@pytest.mark.parametrize("curvature", [0.3])
def test_a_constant_curvature_is_programmed_by_its_rate(curvature):
    """θ1 - θ2 changes by the speed times what vanishes on the circle: no velocity moves it there."""
    mechanism, _ = trailers()
    q = mechanism.q
    _, _, _, first, last = q
    error, speed = ca.tan(first - last) / 0.8 - curvature, {"speed": q.w()[0] - 1.0}
    with refused(sv.errors.SpecificationError, "q.dt(residual, 1)", rows=["curvature"]):
        sv.derive(mechanism, sv.Program({"curvature": error} | speed))
    model = sv.derive(mechanism, sv.Program({"curvature": q.dt(error)} | speed))
    run = sv.simulate(model, model.start(theta1=np.arctan(0.8 * curvature), theta2=0.0), (0.0, 3.0))
    assert np.tan(run["theta1"] - run["theta2"]) / 0.8 == pytest.approx(curvature, abs=1e-12)
    assert run["theta2"] - run["theta2"][0] == pytest.approx(curvature * run.t, abs=1e-9) and sv.verify(run).passed


def by_rates(speed=0.0):
    """The car along the parabola (s, s²/3), by the rates of its place."""
    mechanism = car()
    q = mechanism.q
    x, y, _, _ = q
    s = 3 * bent(q) + speed * q.t
    return sv.derive(mechanism, sv.Program({"X": q.dt(x - s), "Y": q.dt(y - s**2 / 3)}))


def test_a_car_by_rates_of_its_place_starts_from_rest_at_the_limit_of_its_motion():
    start = by_rates().start()
    assert set(start.at_rest) == {"psi", "delta"} and start.values[4:] == pytest.approx(0.0, abs=1e-12)
    assert [start["psi"], start["delta"]] == pytest.approx([0.0, np.arctan(1.1 * 2 / 3)], abs=1e-4)


@pytest.mark.parametrize("t", [0.032, 0.08])
def test_a_start_where_the_divisor_of_a_hidden_constraint_is_faint_is_refused(t):
    """Just after rest and before it: directions that depend on squares of the speed would be rounding."""
    model = by_rates()
    with refused(sv.errors.SingularProgram, "divides by", "of its usual size", rows=["X"]) as caught:
        model.start(t)
    later = caught.value.details["nearest_time"]
    assert caught.value.details["size"] < 1e-6 and (later is None) == (t > 3)
    for good in (0.12, later or 2.0):  # δ follows from the curvature of y = x²/3
        x, delta = 3 * np.ravel(cf.rest_to_rest([good], 0, 0.0, 1.0, 4.0, 6))[0], model.start(good, x=0.0)["delta"]
        assert delta == pytest.approx(np.arctan(1.1 * 2 / 3 / (1 + 4 * x**2 / 9) ** 1.5), abs=1e-8)


def test_a_car_at_rest_with_given_directions_is_refused_as_it_stands_still():
    """Its hidden constraints are 0/0 at rest."""
    with refused(sv.errors.SingularProgram, "stands still", "psi", "delta", t=0.0) as caught:
        by_rates().start(psi=0.0, delta=0.0)
    assert 0 < caught.value.details["nearest_time"] < 1.0


def test_a_program_that_determines_velocities_but_not_all_coordinates_is_integrated():
    model = by_rates(speed=1.0)
    assert model.free == len(model.start().free) == 2
    run = sv.simulate(model, model.start(), (0.0, 3.0))
    s = 3 * np.ravel(cf.rest_to_rest(run.t, 0, 0.0, 1.0, 4.0, 6)) + run.t
    assert run["x"] == pytest.approx(s, abs=1e-7) and run["y"] == pytest.approx(s**2 / 3, abs=1e-7)
    assert sv.verify(run).passed


def test_a_search_that_ends_where_an_equation_has_no_gradient_says_so():
    """max(x - 1, 0) = 1 has the solution x = 2, and below x = 1, where the search begins, no gradient."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)))
    model = sv.derive(mechanism, sv.Program({"edge": ca.fmax(x - 1.0, 0.0) - 1.0}, by="ideal"), guess={"x": 3.0})
    assert model.start(guess={"x": 3.0})["x"] == pytest.approx(2.0)
    with refused(sv.errors.InconsistentStart, "'edge' has no gradient", invariant="edge"):
        model.start()


def test_a_printed_state_has_zeros_for_rounding_and_held_values_as_they_are():
    values, names = np.array([2.0, -1.8e-17, 1e-9, 1e-20]), ("x", "y", "z", "w")
    assert "x = 2, y = 0, z = 1e-09, w = 1e-20" in repr(State(0.0, values, names, ("w",), (), 0.0))
    assert "x = 2e-06, y = 0, z = 1e-15, w = 0" in repr(State(0.0, 1e-6 * values, names, (), (), 0.0))


# what a start says of values that it was given -----------------------------------------------------------------------


def on_a_circle():
    """A bead that is driven round a circle of 1 m at 1 m/s."""
    q = sv.coordinates("x y", units="m m")
    (x, y), (dx, dy) = q, q.d(1)
    ring = {"ring": x**2 + y**2 - 1}
    bead = sv.Mechanism(q, sv.particle(q, 1.0, (x, y)), actuators={"drive": [-y, x]}, constraints=ring)
    return sv.derive(bead, sv.Program({"speed": dx * y - dy * x - 1.0}))


@pytest.mark.parametrize("held, parties, nearest", [
    ({"x": 2.0}, ["ring"], 1.0), ({"x": 0.5, "y": 0.5}, ["y = 0.5", "ring"], np.sqrt(0.75)),
    ({"x": 0.6, "dx": 0.7}, ["x = 0.6"], 0.8), ({"hold": (0.5, 0.6)}, ["a = 0", "b = 0"], 0.1),
])  # fmt: skip
def test_held_values_that_contradict_each_other_are_all_named(held, parties, nearest):
    model = on_a_circle()
    x = model.reduction.mechanism.q["x"]
    if "hold" in held:
        held = {"hold": {name: x - value for name, value in zip("ab", held["hold"], strict=True)}}
    with refused(sv.errors.InconsistentStart, *parties) as caught:
        model.start(**held)
    details = caught.value.details
    assert details["nearest_value"] == pytest.approx(nearest, abs=1e-9)
    if "hold" not in held:  # what is offered is accepted with the others
        assert model.start(**held | {details["held"]: details["nearest_value"]}).residual < 1e-9


def test_the_nearest_value_is_the_one_that_goes_with_the_others():
    q = sv.coordinates("x y")
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, ca.vertcat(*q)), actuators={"f": q["x"]})
    model = sv.derive(mechanism, sv.Program({"sum": q["x"] + q["y"] - q.t}))
    with refused(sv.errors.InconsistentStart, "x = 1", "y = 1", nearest_value=-1.0):
        model.start(x=1.0, y=1.0)
    assert model.start(x=-1.0, y=1.0)["dx"] == pytest.approx(0.5)


@pytest.mark.parametrize("by", ["output", "condition", "coordinate"])
def test_an_output_that_is_held_at_a_standstill(by):
    """A wheeled robot at rest has any heading; one that is held is kept, however it is named."""
    q = sv.coordinates("x y psi")
    (x, y, psi), (dx, dy, dpsi) = q, q.d(1)
    robot = sv.Mechanism(
        q, sv.rigid_body(q, 20.0, (0, 0, 1.5), position=(x, y), rates=(0, 0, dpsi)), outputs={"heading": 2 * psi},
        actuators={"drive": (ca.cos(psi), ca.sin(psi), 0), "steer": psi},
        constraints={"no slip": dx * ca.sin(psi) - dy * ca.cos(psi)},
    )  # fmt: skip
    path = sv.paths.rest_to_rest((0.0, 0.0), (3**0.5, 1.0), duration=4.0, smoothness=4)
    r = q.references(X=path[0], Y=path[1])
    model = sv.derive(robot, sv.Program({"X": x - r.X, "Y": y - r.Y}))
    held = {"output": {"heading": 0.6}, "condition": {"hold": {"angle": psi - 0.3}}, "coordinate": {"psi": 0.3}}[by]
    assert model.start(**held)["psi"] == pytest.approx(0.3)


def test_a_guess_that_no_state_is_near_is_printed_with_its_distance():
    model = on_a_circle()
    assert "guess" not in str(model.start(guess={"x": 0.6, "y": 0.8}))
    start = model.start(guess={"x": 10.0, "y": 5.0})
    assert start["x"] / start["y"] == pytest.approx(2.0)
    assert "9.106 off the guess: x = 0.8944, guessed 10" in str(start)


def test_an_angle_that_looks_like_degrees_is_printed_in_radians():
    model = sv.derive(*gallery["overhead-crane"].build(), guess={"l": 4.0})
    assert "45 degrees are 0.7854" in str(model.start(guess={"l": 4.0, "theta": 45.0}))
    assert "degrees" not in str(model.start(guess={"l": 40.0, "theta": 2.5}))
