"""Robots under programs: held frames, closed chains, poses; plans verified, and forces equal to pinocchio's."""

from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
import robots
from refusals import refused

import servoctl as sv

HOME = {"pan": 0.3, "lift": 0.2, "elbow": 1.4, "roll": 0.2, "bend": 0.9, "turn": 0.4}
LEGS = ("front_left", "front_right", "hind_left", "hind_right")
STANDING = {"base_z": 0.3} | {f"{leg}_{joint}": angle for leg in LEGS for joint, angle in (("flexion", 0.7), ("knee", -1.4))}


def place(robot, link, posture):
    """Position and rotation of a link in a posture, arrays."""
    numbers = [posture.get(name, 1.0 if name == "base_qw" else 0.0) for name in robot.q.names]
    frame = robot.frame(link)
    parts = ca.Function("f", [ca.vertcat(*robot.q)], [frame.position, frame.rotation]).call([ca.DM(numbers)])
    return [np.array(part) for part in parts]


@lru_cache
def arm_plan(duration=2.0):
    """The six-axis arm along a line with a turn."""
    arm = sv.urdf(robots.file_of("six_axis_arm"))
    s = arm.q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration)).s
    position, rotation = place(arm, "tool", HOME)
    line = sv.curves.line(s, position.ravel(), position.ravel() + [0.05, -0.15, -0.1])
    pose = sv.programs.pose("tool", arm.frame("tool"), line, sv.rotations.turn(0.6 * s, (0, 0, 1), rotation))
    mechanism = arm.mechanism()
    model = sv.derive(mechanism, sv.Program(pose))
    return arm, mechanism, model, sv.simulate(model, model.start(guess=HOME), (0.0, duration))


@lru_cache
def quadruped_plan():
    """The quadruped on four point feet moves its trunk."""
    robot = sv.urdf(robots.file_of("quadruped"), base="free")
    rows = sv.held(robot, {f"{leg}_foot": "position" for leg in LEGS}, STANDING)
    s = robot.q.references(s=sv.paths.rest_to_rest(0.0, 1.0, 1.2)).s
    line, turn = sv.curves.line(s, (0, 0, 0.3), (0.03, 0.02, 0.26)), sv.rotations.turn(0.15 * s, (0, 0, 1))
    mechanism = robot.mechanism(rows)
    model = sv.derive(mechanism, sv.Program(sv.programs.pose("trunk", robot.frame("trunk"), line, turn)))
    return robot, mechanism, model, sv.simulate(model, model.start(guess=STANDING | {"base_qw": 1.0}), (0.0, 1.2))


def constrained_torques(robot, other, run, k, jacobian, driven):
    """Least torques of the driven rows at sample k, from pinocchio's rnea and the Jacobian of what is held."""
    q = robot.q
    values = np.array([run[name][k] for name in q.names])
    v, a = (np.array([run[name][k] for name in q.jet_names(level)]) for level in (1, 2))
    configuration, rows = other.configuration(values), other.rows
    forces = np.zeros(q.n)
    forces[rows] = other.pin.rnea(other.model, other.data, configuration, v[rows], a[rows])
    S = np.zeros((q.n, len(driven)))
    S[list(driven), range(len(driven))] = 1.0
    held = np.array(jacobian(values))
    outside = np.eye(q.n) - held.T @ np.linalg.pinv(held.T)  # what the reactions cannot carry
    return np.linalg.pinv(outside @ S, rcond=1e-9) @ (outside @ forces)


# plans ---------------------------------------------------------------------------------------------------------------


def test_a_pose_program_of_six_axes_is_flat_and_verified():
    _, _, model, run = arm_plan()
    assert model.flat
    assert sv.verify(run).verdict == "passed"


def test_torques_of_the_arm_equal_pinocchio():
    arm, mechanism, _, run = arm_plan()
    other = robots.Pinocchio(arm, robots.file_of("six_axis_arm"), "fixed")
    for k in range(0, len(run.t), 100):
        q, v, a = (np.array([run[name][k] for name in arm.q.jet_names(level)]) for level in (0, 1, 2))
        wanted = other.pin.rnea(other.model, other.data, q, v, a) + v * list(arm.damping.values())
        ours = [run[name][k] for name in mechanism.actuators]
        assert np.abs(ours - wanted).max() < 1e-12 * np.abs(wanted).max()


def test_least_torques_of_a_standing_quadruped_equal_pinocchio():
    robot, mechanism, model, run = quadruped_plan()
    assert len(mechanism.constraints) == 12
    assert sv.verify(run, segments=4).verdict == "passed"
    other = robots.Pinocchio(robot, robots.file_of("quadruped"), "free")
    rows = ca.vertcat(*(robot.frame(f"{leg}_foot").jacobian[:3, :] for leg in LEGS))
    jacobian = ca.Function("J", [ca.vertcat(*robot.q)], [ca.densify(rows)])
    for k in range(0, len(run.t), 200):
        viscous = np.array([robot.damping[name.removeprefix("torque_")] for name in mechanism.actuators])
        rates = np.array([run[f"{name.removeprefix('torque_')}_rate"][k] for name in mechanism.actuators])
        ours = np.array([run[name][k] for name in mechanism.actuators])
        wanted = constrained_torques(robot, other, run, k, jacobian, range(6, 18))
        # damping works on driven joints alone, so it shifts torques by itself, projected as the rest
        shift = constrained_shift(jacobian, run, robot, k, viscous * rates)
        assert np.abs(ours - wanted - shift).max() < 1e-9 * np.abs(ours).max()


def constrained_shift(jacobian, run, robot, k, torques):
    """What least torques become through joint torques that are needed in addition."""
    values = np.array([run[name][k] for name in robot.q.names])
    held = np.array(jacobian(values))
    outside = np.eye(18) - held.T @ np.linalg.pinv(held.T)
    S = np.eye(18)[:, 6:]
    return np.linalg.pinv(outside @ S, rcond=1e-9) @ (outside @ S @ torques)


def test_a_four_bar_is_closed_in_its_plane():
    arm = sv.urdf(robots.file_of("four_bar"))
    ends = arm.frame("coupler_end"), arm.frame("rocker_end")
    assert list(sv.loop(*ends, "position")) == ["loop_x", "loop_z"]
    assert list(sv.loop(*ends, "pose")) == ["loop_x", "loop_z", "loop_ry"]
    mechanism = arm.mechanism(sv.loop(*ends, "position"), actuators=("crank_joint",))
    s = arm.q.references(s=sv.paths.rest_to_rest(0.0, 1.0, 2.0)).s
    model = sv.derive(mechanism, sv.Program({"crank": arm.q["crank_joint"] + 1.0 + 2.0 * s}))
    start = model.start(guess={"crank_joint": -1.0, "coupler_joint": 1.0, "rocker_joint": -1.2})
    run = sv.simulate(model, start, (0.0, 2.0))
    assert sv.verify(run).verdict == "passed"
    other = robots.Pinocchio(arm, robots.file_of("four_bar"), "fixed")
    rows = (ends[0].jacobian - ends[1].jacobian)[[0, 2], :]
    jacobian = ca.Function("J", [ca.vertcat(*arm.q)], [ca.densify(rows)])
    for k in range(0, len(run.t), 100):
        (wanted,) = constrained_torques(arm, other, run, k, jacobian, [arm.q.names.index("crank_joint")])
        assert run["torque_crank_joint"][k] == pytest.approx(wanted, rel=1e-9, abs=1e-9)


FIVE_BAR = """<robot name="five_bar"><link name="ground"/>{sides}</robot>"""
SIDE = """<link name="{s}_crank">{rod}</link><link name="{s}_coupler">{rod}</link><link name="{s}_end"/>
<joint name="{s}_motor" type="continuous"><origin xyz="{x} 0 0"/><parent link="ground"/><child link="{s}_crank"/>
<axis xyz="0 1 0"/></joint>
<joint name="{s}_elbow" type="continuous"><origin xyz="0.3 0 0"/><parent link="{s}_crank"/><child link="{s}_coupler"/>
<axis xyz="0 1 0"/></joint>
<joint name="{s}_tip" type="fixed"><origin xyz="0.4 0 0"/><parent link="{s}_coupler"/><child link="{s}_end"/></joint>"""
ROD = (
    '<inertial><origin xyz="0.17 0 0"/><mass value="0.8"/>'
    '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.008" iyz="0" izz="0.008"/></inertial>'
)


def test_a_parallel_robot_takes_the_torques_of_pinocchio(tmp_path):
    """Two cranks move the point where two chains meet: along a line, by the motors at the ground alone."""
    path = tmp_path / "five_bar.urdf"
    path.write_text(FIVE_BAR.format(sides="".join(SIDE.format(s=s, x=x, rod=ROD) for s, x in (("left", -0.1), ("right", 0.1)))), encoding="utf-8")
    robot = sv.urdf(path)
    ends = robot.frame("left_end"), robot.frame("right_end")
    mechanism = robot.mechanism(sv.loop(*ends, "position"), actuators=("left_motor", "right_motor"))
    home = {"left_motor": -2.2, "left_elbow": 1.2, "right_motor": -0.9, "right_elbow": -1.2}
    s = robot.q.references(s=sv.paths.rest_to_rest(0.0, 1.0, 1.5)).s
    line = sv.curves.line(s, (0.0, 0.56), (0.08, 0.5))
    point = ends[0].position[[0, 2]]
    model = sv.derive(mechanism, sv.Program({"X": point[0] - line[0], "Z": point[1] - line[1]}))
    run = sv.simulate(model, model.start(guess=home), (0.0, 1.5))
    assert model.flat
    assert sv.verify(run).verdict == "passed"
    other = robots.Pinocchio(robot, str(path), "fixed")
    rows = (ends[0].jacobian - ends[1].jacobian)[[0, 2], :]
    jacobian = ca.Function("J", [ca.vertcat(*robot.q)], [ca.densify(rows)])
    driven = [robot.q.names.index(name) for name in ("left_motor", "right_motor")]
    for k in range(0, len(run.t), 100):
        wanted = constrained_torques(robot, other, run, k, jacobian, driven)
        ours = [run["torque_left_motor"][k], run["torque_right_motor"][k]]
        assert ours == pytest.approx(wanted, rel=1e-9, abs=1e-9)


def test_frames_that_cannot_meet_are_refused():
    text = open(robots.file_of("four_bar"), encoding="utf-8").read().replace('xyz="0.5 0 0"', 'xyz="0.5 0.1 0"')
    arm = sv.urdf(text)
    with refused(sv.errors.SpecificationError, "loop_y", row="loop_y"):
        sv.loop(arm.frame("coupler_end"), arm.frame("rocker_end"), "position")
    other = sv.urdf(robots.file_of("pendubot"))
    with refused(sv.errors.SpecificationError, "different robots", frames=["coupler_end", "tip"]):
        sv.loop(arm.frame("coupler_end"), other.frame("tip"))
    with refused(sv.errors.NameUnknown, "psition", match="position"):
        sv.loop(arm.frame("coupler_end"), arm.frame("rocker_end"), "psition")


def test_held_frames_have_independent_rows():
    arm = sv.urdf(robots.file_of("four_bar"))
    bent, straight = {"crank_joint": 0.4, "coupler_joint": 0.5}, {"crank_joint": 0.4}
    assert list(sv.held(arm, ["coupler_end"], bent)) == ["coupler_end_x", "coupler_end_z"]
    assert list(sv.held(arm, ["coupler_end"], straight)) == ["coupler_end_x", "coupler_end_ry"], "x and z are dependent"
    robot = sv.urdf(robots.file_of("quadruped"), base="free")
    assert len(sv.held(robot, ["front_left_foot"], STANDING)) == 6
    with refused(sv.errors.NameUnknown, "fron_left_foot", match="front_left_foot"):
        sv.held(robot, ["fron_left_foot"], STANDING)
    with refused(sv.errors.NameUnknown, "bse_z", match="base_z"):
        sv.held(robot, ["front_left_foot"], {"bse_z": 0.3})


# programs by name ----------------------------------------------------------------------------------------------------


def test_an_orientation_does_not_vanish_at_half_a_turn():
    q = sv.coordinates("a")
    rotation = sv.rotations.turn(q["a"], (0, 0, 1))
    residual = sv.programs.orientation("r", rotation, np.eye(3))["r_rz"]
    f = ca.Function("f", [q["a"]], [residual])
    assert [float(f(angle)) for angle in (1e-3, 1.0)] == pytest.approx([2 * np.tan(5e-4), 2 * np.tan(0.5)], rel=1e-12)
    assert abs(float(f(np.pi - 1e-6))) > 1e6


def moving_point():
    q = sv.coordinates("x y")
    random = np.random.default_rng(5)
    jets = {s: random.uniform(0.5, 1.5) for k in range(4) for s in q.jet(k).elements()}
    return q, lambda e: float(ca.Function("f", [ca.vertcat(*jets)], [e])(list(jets.values())))


def test_programs_are_the_residuals_that_they_say():
    q, value = moving_point()
    x, y = q
    (dx, dy), (d2x, d2y), (d3x, d3y) = (q.d(k) for k in (1, 2, 3))
    point, programs = ca.vertcat(x, y), sv.programs
    speed = ca.sqrt(dx**2 + dy**2)
    curvature = (dx * d2y - dy * d2x) / speed**3
    by_hand = {
        "follow": (programs.follow_point("p", point, (1.0, 2.0))["p_y"], y - 2.0),
        "path": (programs.follow_path("p", point, lambda s: ca.vertcat(s, s**2), q.t)["p_x"], x - q.t),
        "distance": (programs.distance("p", point, (0, 0), 2.0)["p"], (x**2 + y**2 - 4) / 4),
        "speed": (programs.constant_speed("p", q, point, 2.0)["p"], (dx**2 + dy**2 - 4) / 4),
        "acceleration": (programs.acceleration_norm("p", q, point, 2.0)["p"], (d2x**2 + d2y**2 - 4) / 4),
        "jerk": (programs.jerk_norm("p", q, point, 2.0)["p"], (d3x**2 + d3y**2 - 4) / 4),
        "curvature": (programs.curvature("p", q, point, 0.3)["p"], curvature - 0.3),
        "rate": (programs.curvature_rate("p", q, point, 0.3)["p"], q.dt(curvature) - 0.3),
        "perpendicular": (programs.perpendicular_velocities("p", q, point, (y, x))["p"], 2 * dx * dy / speed**2),
        "formation": (programs.formation("p", point, {"b": (y, x)}, {"b": (1.0, 2.0)})["p_b_x"], y - x - 1.0),
    }
    for name, (ours, wanted) in by_hand.items():
        assert value(ca.substitute(ours - wanted, q.t, 0.7)) == pytest.approx(0.0, abs=1e-12), name


def test_energy_and_momentum_are_those_of_the_mechanism():
    q, value = moving_point()
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, (x, ca.sin(y))), potential=3 * x)
    dx, dy = q.d(1)
    assert value(sv.programs.energy("e", mechanism, 1.0)["e"] - (dx**2 + (ca.cos(y) * dy) ** 2 + 3 * x - 1)) == pytest.approx(0)
    assert value(sv.programs.momentum("p", mechanism, "y", x)["p"] - (2 * ca.cos(y) ** 2 * dy - x)) == pytest.approx(0)


def test_an_acrobot_under_a_momentum_program_keeps_it():
    """The momentum of the passive first joint as a function of the angles: order 1, which gravity then answers."""
    arm = sv.urdf(robots.file_of("pendubot"))
    mechanism = arm.mechanism(actuators=("elbow",))
    program = sv.programs.momentum("p", mechanism, "elbow", 0.05 * ca.sin(arm.q["elbow"]) + 0.02)
    model = sv.derive(mechanism, sv.Program(program))
    run = sv.simulate(model, model.start(shoulder=0.3, elbow=0.4, dshoulder=0.2), (0.0, 1.0))
    assert sv.verify(run).verdict == "passed"


def test_a_free_path_is_kept_at_the_speed_that_forces_give():
    """A point on an ellipse whose parameter is a coordinate of its own: residuals of order 0 and a free parameter."""
    q = sv.coordinates("x y s")
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 1.0, (q["x"], q["y"])) + sv.particle(q, 1.0, (q["s"],)),
        actuators={"fx": q["x"], "fy": q["y"], "fs": q["s"]},
    )  # fmt: skip
    path = sv.programs.follow_path("p", (q["x"], q["y"]), lambda s: ca.vertcat(2 * ca.cos(s), ca.sin(s)), q["s"])
    speed = sv.programs.constant_speed("v", q, (q["x"], q["y"]), 0.8)
    model = sv.derive(mechanism, sv.Program(path | speed))
    run = sv.simulate(model, model.start(s=0.1, guess={"x": 2.0, "ds": 0.5}), (0.0, 3.0))
    assert np.abs((run["x"] / 2) ** 2 + run["y"] ** 2 - 1).max() < 1e-8
    assert np.abs(np.hypot(run["dx"], run["dy"]) - 0.8).max() < 1e-8


@pytest.mark.parametrize(
    "call, fact",
    [
        (lambda q: sv.programs.distance("p", (q["x"],), (0,), 0.0), "0"),
        (lambda q: sv.programs.constant_speed("p", q, (q["x"],), -1.0), "-1"),
        (lambda q: sv.programs.constant_speed("p", q, (q["x"],), ca.DM(0.0)), "0"),
        (lambda q: sv.programs.jerk_norm("p", q, (q["x"],), ca.SX(2.0) - 3.0), "-1"),
        (lambda q: sv.programs.orientation("p", sv.rotations.turn(q["x"], (0, 0, 1)), 2.0 * np.eye(3)), "no rotation"),
        (lambda q: sv.programs.orientation("p", sv.rotations.turn(q["x"], (0, 0, 1)), np.diag([1, 1, -1])), "no rotation"),
        (lambda q: sv.rotations.turn(q["x"], (0, 0, 1), np.zeros((3, 3))), "no rotation"),
        (lambda q: sv.rotations.vectors(np.zeros((0, 3, 3))), "rotation"),
        (lambda q: sv.programs.follow_point("p", (q["x"], q["y"]), (1,)), "2 entries with 1"),
        (lambda q: sv.programs.curvature("p", q, (q["x"], q["y"], 0), 1.0), "3 entries"),
        (lambda q: sv.programs.follow_path("p", (q["x"],), q["y"], q.t), "follow_point"),
        (lambda q: sv.programs.follow_path("p", (q["x"],), sv.paths.rest_to_rest(0.0, 1.0, 2.0), q.t), "curve of 'p' is a Path"),
        (lambda q: sv.programs.pose("p", q["x"], (0, 0, 0), np.eye(3)), "Frame"),
        (lambda q: sv.programs.orientation("p", np.eye(2), np.eye(3)), "(2, 2)"),
        (lambda q: sv.programs.formation("p", (q["x"],), {"a": (q["y"],)}, {}), "a"),
    ],
)
def test_programs_refuse_what_they_cannot_mean(call, fact):
    with refused(sv.errors.SpecificationError, fact):
        call(sv.coordinates("x y"))


# rotations -----------------------------------------------------------------------------------------------------------


def numbers_of(rotation, symbol, values):
    f = ca.Function("f", [symbol], [rotation])
    return [np.array(f(value)) for value in values]


def test_turns_and_slerps_are_rotations_at_an_even_rate():
    s = ca.SX.sym("s")
    start = np.array(ca.DM(ca.evalf(sv.rotations.turn(0.4, (1, 2, 3)))))
    end = np.array(ca.DM(ca.evalf(sv.rotations.turn(2.5, (0, 1, -1), start))))
    values = numbers_of(sv.rotations.slerp(s, start, end), s, np.linspace(0, 1, 7))
    assert np.abs(values[0] - start).max() < 1e-14
    assert np.abs(values[-1] - end).max() < 1e-14
    angles = [np.arccos((np.trace(a.T @ b) - 1) / 2) for a, b in zip(values, values[1:], strict=False)]
    assert angles == pytest.approx([2.5 / 6] * 6, rel=1e-9)
    assert max(np.abs(r.T @ r - np.eye(3)).max() for r in values) < 1e-14


def test_a_path_passes_through_measured_rotations():
    """Rotations at given times, as three references about the middle one, and a body that is told to follow them."""
    times, turns = [0.0, 1.0, 1.5, 3.0], [(0.1, 0.1), (0.9, 0.9), (1.4, 1.4), (-0.5, -0.5)]
    through = [np.array(ca.DM(ca.evalf(sv.rotations.turn(angle, (1, x, 0.3))))) for angle, x in turns]
    vectors, middle = sv.rotations.vectors(through)
    path = sv.paths.spline(times, vectors, smoothness=3)
    q = sv.coordinates("a b c")
    r = q.references(rx=path[0], ry=path[1], rz=path[2])
    rotation = middle @ sv.rotations.from_vector([*r])
    at = ca.Function("at", [ca.vertcat(*r)], [rotation])
    for t, wanted in zip(times, through, strict=True):
        assert np.abs(np.array(at(path(t))) - wanted).max() < 1e-12
    for t in np.linspace(-0.5, 3.5, 9):
        value = np.array(at(path(t)))
        assert np.abs(value.T @ value - np.eye(3)).max() < 1e-13
        assert np.abs(np.array(ca.DM(sv.rotations.vector(middle.T @ value))).ravel() - path(t)).max() < 1e-13

    axes = sv.rotations.turn(q["a"], (0, 0, 1)) @ sv.rotations.turn(q["b"], (0, 1, 0)) @ sv.rotations.turn(q["c"], (1, 0, 0))
    body = sv.Mechanism(q, sv.rigid_body(q, 0.0, (1, 2, 3), rates=sv.body_rates(q, axes)), actuators=dict(zip("uvw", q, strict=True)))
    model = sv.derive(body, sv.Program(sv.programs.orientation("turned", axes, rotation), by="actuators"))
    run = sv.simulate(model, model.start(), (0.0, 3.0), t_eval=times)
    followed = ca.Function("followed", [ca.vertcat(*q)], [axes])
    for k, wanted in enumerate(through):
        assert np.abs(np.array(followed([run[name][k] for name in "abc"])) - wanted).max() < 1e-10


def test_rotations_refuse_half_turns_and_what_is_none():
    half = np.diag([1.0, -1.0, -1.0])
    with refused(sv.errors.SpecificationError, "half a turn"):
        sv.rotations.slerp(0.5, np.eye(3), half)
    with refused(sv.errors.SpecificationError, "rotations[0]", "half a turn"):
        sv.rotations.vectors([half, np.eye(3)])
    with refused(sv.errors.SpecificationError, "start"):
        sv.rotations.slerp(0.5, np.diag([1.0, 1.0, -1.0]), np.eye(3))
    with refused(sv.errors.SpecificationError, "axis", axis=[0, 0, 0]):
        sv.rotations.turn(0.5, (0, 0, 0))


TWO_LEGS = {f"{leg}_{joint}": angle for leg in ("front", "hind") for joint, angle in (("hip", 0.7), ("knee", -1.4), ("ankle", 0.7))}


def test_rows_of_two_soles_are_those_of_their_plane():
    """With one sole held, the other moves in the plane of the legs alone, though in no posture at random."""
    robot = sv.urdf(robots.two_legs(), base="free")
    rows = sv.held(robot, ["front_foot", "hind_foot"], TWO_LEGS | {"base_z": 0.3})
    assert list(rows)[6:] == ["hind_foot_x", "hind_foot_z", "hind_foot_ry"]
    turned = {"base_qz": np.sin(np.pi / 4), "base_qw": np.cos(np.pi / 4)}
    rows = sv.held(robot, ["hind_foot", "front_foot"], TWO_LEGS | turned)  # rotations in the axes of the foot
    assert list(rows)[6:] == ["front_foot_y", "front_foot_z", "front_foot_ry"]
    frames = robot.frame("front_foot"), robot.frame("hind_foot")
    assert list(sv.loop(*frames)) == ["loop_x", "loop_z", "loop_ry"]
    arm = sv.urdf(robots.file_of("six_axis_arm"))
    assert len(sv.held(arm, ["tool"], {})) == 6, "a stretched arm that cannot move has all rows"
