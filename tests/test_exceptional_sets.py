"""A residual vanishes only where its condition holds: half turns, antipodes, zero vectors, quaternions of any length."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from robots import bodies
from scipy.spatial.transform import Rotation

import servoctl as sv

UP = {"base_qw": 1.0}
SIX = np.eye(6).tolist()
AXES = [
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (1, 2, 2),
    (3, 4, 0),
    (-0.7, 0.1, 0.2),
    (0.577350269, 0.577350269, 0.577350269),
]


def half_turn(axis):
    """2 n nᵀ - E, symmetric to the last digit."""
    n = np.array(axis) / np.linalg.norm(axis)
    return 2 * np.outer(n, n) - np.eye(3)


def values_of(rows, symbols, numbers):
    return ca.Function("f", [symbols], [ca.vertcat(*rows.values())])(numbers).full().ravel()


def nowhere_zero(values):
    """Whether a residual is far from zero or has no value."""
    with np.errstate(invalid="ignore"):
        return not np.all(np.abs(values) < 1.0)


# rotations ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", AXES)
def test_no_half_turn_is_a_zero_of_the_orientation(axis):
    R = ca.SX.sym("R", 3, 3)
    rows = sv.programs.orientation("o", R, np.eye(3))
    exact = half_turn(axis)
    rounded = Rotation.from_rotvec(np.pi * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    digits = 2 * np.outer(axis, axis) - np.eye(3) if np.isclose(np.linalg.norm(axis), 1.0) else exact  # nine digits
    for turned in (exact, rounded, digits, exact @ rounded @ exact):
        assert nowhere_zero(values_of(rows, ca.vec(R), turned.T.ravel()))


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 0.5, 2.0, 3.0, 3.14159, np.pi - 1e-7, np.pi - 1e-10])
def test_the_orientation_is_twice_the_tangent_of_half_the_angle(angle):
    R, axis = ca.SX.sym("R", 3, 3), np.array([2.0, -1.0, 2.0]) / 3
    found = values_of(
        {"o": sv.rotations.vector(R)}, ca.vec(R), Rotation.from_rotvec(angle * axis).as_matrix().T.ravel()
    )
    left = max(np.pi - angle, 1e-16)
    assert found == pytest.approx(2 * np.tan(angle / 2) * axis, rel=1e-13 + 1e-15 / left)


def test_the_zero_of_a_program_is_the_wished_orientation_alone():
    """Of 200 seeded rotations and their half turns about principal axes."""
    R, random = ca.SX.sym("R", 3, 3), Rotation.random(200, random_state=3).as_matrix()
    for wished in random[:20]:
        rows = sv.programs.orientation("o", R, wished)
        assert values_of(rows, ca.vec(R), wished.T.ravel()) == pytest.approx(np.zeros(3), abs=1e-14)
        for axis in AXES:
            assert nowhere_zero(values_of(rows, ca.vec(R), (wished @ half_turn(axis)).T.ravel()))
    sizes = [np.linalg.norm(values_of(rows, ca.vec(R), turned.T.ravel())) for turned in random]
    angles = [Rotation.from_matrix(wished.T @ turned).magnitude() for turned in random]
    assert sizes == pytest.approx([2 * np.tan(a / 2) for a in angles], rel=1e-9)


# programs -------------------------------------------------------------------------------------------------------------


def moving(point, speed=(0, 0), acceleration=(0, 0)):
    return [*point, *speed, *acceleration]


EXCEPTIONAL = {  # at which x, y, x', y', x'', y'' residuals of programs must not vanish
    "distance": (lambda q, x: sv.programs.distance("p", x, (0, 0), 2.0), moving((0, 0))),
    "speed": (lambda q, x: sv.programs.constant_speed("p", q, x, 2.0), moving((1, 0))),
    "acceleration": (lambda q, x: sv.programs.acceleration_norm("p", q, x, 2.0), moving((1, 0), (1, 0))),
    "curvature at rest": (lambda q, x: sv.programs.curvature("p", q, x, 0.5), moving((1, 0))),
    "curvature as it begins": (lambda q, x: sv.programs.curvature("p", q, x, 0.5), moving((1, 0), (0, 0), (2, 1))),
    "curvature of a straight line": (
        lambda q, x: sv.programs.curvature("p", q, x, 2.0), moving((1, 0), (1, 2), (2, 4))
    ),
    "perpendicular at rest": (
        lambda q, x: sv.programs.perpendicular_velocities("p", q, x, (x[1], x[0])), moving((1, 0))
    ),
    "perpendicular but one rests": (
        lambda q, x: sv.programs.perpendicular_velocities("p", q, x, (x[1], 0.0)), moving((1, 0), (1, 0))
    ),
    "perpendicular but parallel": (
        lambda q, x: sv.programs.perpendicular_velocities("p", q, x, x), moving((1, 0), (1e-9, 1e-9))
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", EXCEPTIONAL)
def test_no_exceptional_place_is_a_zero_of_a_program(case):
    make, at = EXCEPTIONAL[case]
    q = sv.coordinates("x y")
    found = values_of(make(q, ca.vertcat(*q)), ca.vertcat(*q, *q.d(1), *q.d(2)), at)
    assert nowhere_zero(found * 2)  # the least of them is 0.75


# robots: held, loop, starts -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def free_body():
    return sv.urdf(bodies("body"), base="free")


@pytest.mark.parametrize("posture", [{}, {"base_qx": 0.6, "base_qw": 0.8}, {"base_qy": -1.0, "base_qw": 0.0}])
@pytest.mark.parametrize("axis", AXES[:5])
def test_a_held_pose_is_no_zero_half_a_turn_away(free_body, posture, axis):
    q, rows = free_body.q, sv.held(free_body, ["body"], posture)
    held = free_body.posture(posture)
    away = np.r_[held[:3], (Rotation.from_quat(held[3:]) * Rotation.from_matrix(half_turn(axis))).as_quat()]
    for sign in (1, -1):  # antipodes are one orientation
        here = np.r_[held[:3], sign * held[3:]]
        assert values_of(rows, ca.vertcat(*q), here) == pytest.approx(np.zeros(6), abs=1e-14)
        assert nowhere_zero(values_of(rows, ca.vertcat(*q), np.r_[away[:3], sign * away[3:]]))
    half = np.r_[away[:3], np.round(away[3:], 15)]  # the product with the held quaternion is 0 to the last digit
    assert nowhere_zero(values_of(rows, ca.vertcat(*q), half))
    assert not np.isfinite(values_of(rows, ca.vertcat(*q), np.r_[held[:3], 0, 0, 0, 0])).all()


def test_the_rows_of_a_loop_are_no_zero_half_a_turn_away():
    arm = sv.urdf(bodies("base", "a", "b", axes=("0 0 1", "0 0 1")))
    q, rows = arm.q, sv.loop(arm.frame("base"), arm.frame("b"), "pose")
    angles = {"ja": 0.4, "jb": -0.4}
    turned = values_of({n: r for n, r in rows.items() if n.endswith("rz")}, ca.vertcat(*q), [0.4, np.pi - 0.4])
    assert list(rows)[-1] == "loop_rz" and nowhere_zero(turned)
    closed = values_of({n: r for n, r in rows.items() if n.endswith("rz")}, ca.vertcat(*q), list(angles.values()))
    assert closed == pytest.approx([0.0], abs=1e-14)


GUESSES = [
    {},
    UP,
    {"base_z": 1.0},
    {"base_qx": 0.9, "base_qw": 0.1},
    {"base_qx": 1.0, "base_qw": 0.0},
    {"base_qy": -0.99},
]


@pytest.mark.parametrize("guess", GUESSES)
@pytest.mark.parametrize("derived", [UP, None])
def test_a_start_is_at_the_wished_orientation(free_body, guess, derived):
    m = free_body.mechanism(actuators={f"f{i}": e for i, e in enumerate(SIX)})
    wished = Rotation.from_rotvec([0.1, -0.4, 0.3])
    rows = sv.programs.pose("o", free_body.frame("body"), (0, 0, 1), wished.as_matrix())
    start = sv.derive(m, sv.Program(rows), guess=derived).start(guess=guess)
    here = Rotation.from_quat([start[f"base_q{e}"] for e in "xyzw"])
    assert (wished.inv() * here).magnitude() < 1e-9


@pytest.mark.parametrize("posture", [{}, {"base_qx": 0.6, "base_qw": 0.8}, {"base_z": 1.0, "base_qw": -1.0}])
def test_a_held_base_has_a_plant(posture):
    """The arm falls about its joint: its rate of rotation by hand."""
    robot = sv.urdf(bodies("base", "arm", axes=("0 1 0",), centre="0.3 0 0"), base="free")
    plant = sv.plant(robot.mechanism(sv.held(robot, ["base"], posture), actuators=("ja",)))
    x = np.zeros(len(plant.state_names))
    x[: robot.q.nq] = robot.posture(posture)
    gravity = Rotation.from_quat(x[3:7]).inv().apply([0, 0, -9.81])
    by_hand = np.cross([0.3, 0, 0], gravity)[1] / (0.3**2 + 0.01)
    assert plant.rates(0.0, x, [0.0])[-1] == pytest.approx(by_hand, rel=1e-12)


def test_an_arm_on_a_ship():
    """Joint acceleration on a deck that heaves and rolls, by Newton and Euler for the arm in the deck's axes."""
    robot = sv.urdf(bodies("base", "arm", axes=("0 1 0",), centre="0.3 0 0"), base="free")
    t, axis = robot.q.t, np.array([1.0, 2.0, 0.0]) / np.sqrt(5)
    rolling = sv.rotations.turn(0.2 * ca.sin(2 * t), axis)
    deck = sv.programs.pose("deck", robot.frame("base"), (0, 0, 0.3 * ca.sin(1.5 * t)), rolling)
    plant = sv.plant(robot.mechanism(deck, actuators=("ja",)))
    y, joint, rate = np.array([0.0, 1, 0]), 0.3, 0.1
    for at in (0.0, 0.5, 1.0):
        turned = Rotation.from_rotvec(0.2 * np.sin(2 * at) * axis)
        spin, change = 0.4 * np.cos(2 * at) * axis, -0.8 * np.sin(2 * at) * axis  # of the deck, along its own axes, too
        lifted = turned.inv().apply([0, 0, 9.81 - 0.675 * np.sin(1.5 * at)])
        centre = Rotation.from_rotvec(joint * y).apply([0.3, 0, 0])

        def moment(acceleration, spin=spin, change=change, lifted=lifted, centre=centre):
            omega, alpha = spin + rate * y, change + acceleration * y + np.cross(spin, rate * y)
            a = lifted + np.cross(alpha, centre) + np.cross(omega, np.cross(omega, centre))
            return (np.cross(centre, a) + 0.01 * alpha) @ y

        speed = turned.inv().apply([0, 0, 0.45 * np.cos(1.5 * at)])
        x = np.r_[0, 0, 0.3 * np.sin(1.5 * at), turned.as_quat(), joint, speed, spin, rate]
        by_hand = -moment(0.0) / (moment(1.0) - moment(0.0))
        assert plant.rates(at, x, [0.0])[-1] == pytest.approx(by_hand, rel=1e-10)


def standing(posture):
    """A body held at two points beside each other, which may swing about the line through them; a wheel on it."""
    robot = sv.urdf(bodies("body", "wheel", axes=("1 0 0",), points={"a": "0.1 0 0", "b": "-0.1 0 0"}), base="free")
    rows = sv.held(robot, {"a": "position", "b": "position"}, posture)
    m = robot.mechanism(rows, actuators=("ja",))
    r = robot.q.references(spin=sv.paths.rest_to_rest(0.0, 1.0, 1.0))
    spin = sv.Program({"spin": robot.q["ja"] - r.spin})
    return robot, rows, sv.derive(m, spin, guess=posture)


@pytest.mark.parametrize(
    "posture", [{"base_z": 1.0}, {"base_x": -0.2, "base_z": 0.3}, {"base_qx": 0.6, "base_qw": 0.8}]
)
def test_rows_left_out_hold_where_a_start_is_found(posture):
    robot, rows, model = standing(posture)
    assert len(rows) == 5 and len(rows.followers) == 1
    assert len(({"x": robot.q["ja"]} | rows).followers) == len((rows | {"x": robot.q["ja"]}).followers) == 1
    for further in ({}, {"base_qw": 0.0, "base_qz": 1.0}, {"base_qw": 0.2, "base_qz": 0.98, "base_qx": 0.0}):
        start = model.start(guess=posture | further)
        q = [start[name] for name in robot.q.names]
        for point in "ab":
            here = ca.Function("f", [ca.vertcat(*robot.q)], [robot.frame(point).position])(q).full().ravel()
            assert here == pytest.approx(robot.at(posture, point)[0], abs=1e-9)
    start = model.start(guess=posture)  # a posture is completed by one rule
    assert [start[name] for name in robot.q.names] == pytest.approx(robot.posture(posture), abs=1e-12)


def test_a_quaternion_and_its_antipode_are_one_branch():
    robot, _, model = standing({"base_x": 0.3, "base_z": 1.0})
    start = model.start(guess={"base_x": 0.3, "base_z": 1.0, "base_qx": 0.1})
    assert len(start.branches) == 1 and start["base_qw"] > 0.99


# formulas of quaternions off the unit sphere ----------------------------------------------------------------------------


def rotor(unit, world):
    """A quadrotor by a user's own quaternion: orthonormal on the unit sphere alone, velocities along either axes."""
    plain = sv.coordinates("x y z e1 e2 e3 e0")
    x, y, z, e1, e2, e3, e0 = plain
    spin = ca.vertcat(
        ca.horzcat(e0, -e3, e2), ca.horzcat(e3, e0, -e1), ca.horzcat(-e2, e1, e0), ca.horzcat(-e1, -e2, -e3)
    )
    two = 2 if unit else 2 / (e0**2 + e1**2 + e2**2 + e3**2)
    vector = ca.vertcat(e1, e2, e3)
    R = ca.SX.eye(3) + two * (e0 * ca.skew(vector) + ca.skew(vector) @ ca.skew(vector))
    V = ca.diagcat(ca.SX.eye(3) if world else R, spin / 2)
    norm = {"unit": e0**2 + e1**2 + e2**2 + e3**2 - 1}
    q = plain.with_quasi_velocities("vx vy vz wx wy wz", V, invariants=norm)
    S = sv.rigid_body(q, 1.325, (0.0365, 0.0254, 0.0609), position=(x, y, z), rates=q.w()[3:])
    thrust = [*(R[:, 2] if world else ca.SX([0, 0, 1])).elements(), 0, 0, 0]
    m = sv.Mechanism(
        q, S, 1.325 * 9.81 * z, actuators={"f": thrust} | dict(zip(("mx", "my", "mz"), SIX[3:], strict=True))
    )
    return m, q, R, "e0", "x y z".split()


def quadrotor():
    robot = sv.urdf(bodies("body", mass=1.325, moments=(0.0365, 0.0254, 0.0609)), base="free")
    m = robot.mechanism(actuators=dict(zip(("f", "mx", "my", "mz"), SIX[2:], strict=True)))
    return m, robot.q, robot.frame("body").rotation, "base_qw", ["base_x", "base_y", "base_z"]


@pytest.mark.parametrize(
    "make", [quadrotor, lambda: rotor(True, False), lambda: rotor(True, True), lambda: rotor(False, False)]
)
def test_a_quadrotor_from_hover_is_flat_with_any_velocities(make):
    m, q, R, scalar, places = make()
    path = sv.paths.rest_to_rest(0.0, 1.0, 3.0, smoothness=6)
    (s,) = q.references(s=path)
    targets = [2 * s, 4 * s * (1 - s), 0.5 * s]
    rows = {name: q[place] - target for name, place, target in zip("XYZ", places, targets, strict=True)}
    program = sv.Program(rows | {"yaw": ca.atan2(R[1, 0], R[0, 0])})
    model = sv.derive(m, program, guess={scalar: 1.0})
    assert model.flat
    run = sv.simulate(model, model.start(guess={scalar: 1.0}), (0.0, 4.0))
    s, ds, d2s = path.jets(run.t, 2)[:, 0]
    up = [2 * d2s, 4 * d2s * (1 - 2 * s) - 8 * ds**2, 0.5 * d2s + 9.81]
    by_hand = 1.325 * np.linalg.norm(up, axis=0)
    assert run["f"] == pytest.approx(by_hand, rel=1e-9)
    assert (by_hand.min(), by_hand.max()) == pytest.approx((12.62906, 16.50965), abs=1e-5)


def test_expressions_are_extended_along_the_rays_of_invariants_that_are_spheres():
    plain = sv.coordinates("c s z")
    c, s, z = plain
    q = plain.with_quasi_velocities("w v", [[-s, 0], [c, 0], [0, 1]], invariants={"circle": c**2 + s**2 - 4})
    extended = ca.Function("f", [ca.vertcat(c, s, z)], [q.on_spheres(1 - c**2 / 2 + z), q.on_spheres(c / s + z)])
    for length in (1.0, 2.0, 7.0):
        first, second = extended([0.6 * length, 0.8 * length, 0.3])
        assert [float(first), float(second)] == pytest.approx([1 - 1.2**2 / 2 + 0.3, 0.75 + 0.3], rel=1e-14)
    other = plain.with_quasi_velocities("w v", [[-s, 0], [c, 0], [0, 1]], invariants={"curve": c**2 + s - 4})
    assert other.spheres == () and other.on_spheres(c**2) is not None


# bad input --------------------------------------------------------------------------------------------------------------


def test_a_zero_quaternion_is_refused(free_body):
    zero = dict.fromkeys(("base_qx", "base_qy", "base_qz", "base_qw"), 0.0)
    with refused(sv.errors.SpecificationError, "length 0", "base_qw=1"):
        sv.held(free_body, ["body"], zero)
    m = free_body.mechanism(actuators={f"f{i}": e for i, e in enumerate(SIX)})
    model = sv.derive(m, sv.Program(sv.programs.follow_point("p", free_body.frame("body").position, (0, 0, 1))))
    for guess in (zero, {"base_qw": 0.0}):
        with refused(sv.errors.SpecificationError, "length 0"):
            model.start(guess=guess)
