"""Redundant actuation in the metric of the inertia: Gauss's principle, wishes of accelerations, postures."""

from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
import robots
from refusals import refused

import servoctl as sv

HOME = dict(zip((f"joint_{i}" for i in range(1, 8)), (0.2, 0.5, 0.1, 1.6, 0.2, 1.3, 0.1), strict=True))
LEG = {"front_hip": 0.5, "front_knee": -1.0, "front_ankle": 0.3}
MOVE = sv.paths.rest_to_rest(0.0, 1.0, 2.0)


@lru_cache
def arm_and_pose():
    arm = sv.urdf(robots.file_of("seven_axis_arm"))
    position, rotation = arm.at(HOME, "tool")
    (s,) = arm.q.references(s=MOVE)
    line = sv.curves.line(s, position, position + [0.05, -0.15, -0.1])
    pose = sv.programs.pose("tool", arm.frame("tool"), line, sv.rotations.turn(0.4 * s, (0, 0, 1), rotation))
    return arm, arm.mechanism(), pose


@lru_cache
def leg_and_place():
    """Three joints in a plane, whose foot follows a line: one of self-motion."""
    arm = sv.urdf(robots.two_legs(), lock=dict.fromkeys(("hind_hip", "hind_knee", "hind_ankle"), 0.0))
    position, _ = arm.at(LEG, "front_foot")
    (s,) = arm.q.references(s=MOVE)
    line = sv.curves.line(s, position, position + [0.05, 0.0, 0.04])
    place = sv.programs.follow_point("foot", arm.frame("front_foot").position, line)
    return arm, arm.mechanism(), {name: place[name] for name in ("foot_x", "foot_z")}


@lru_cache
def motion(kind):
    arm, mechanism, pose = arm_and_pose() if kind == "posture" else leg_and_place()
    wishes = {
        "least": lambda: sv.programs.wish(mechanism),
        "self-motion": lambda: sv.programs.wish(mechanism, {"front_knee": 0.3 * ca.sin(2 * arm.q.t)}),
        "posture": lambda: sv.programs.posture(mechanism, HOME, 3.0),
    }
    model = sv.derive(mechanism, sv.Program(pose, weights="inertia", toward=wishes[kind]()))
    return model, sv.simulate(model, model.start(guess=HOME if kind == "posture" else LEG), (0.0, 4.0))


@pytest.mark.parametrize("kind", ["least", "self-motion", "posture"])
def test_accelerations_are_nearest_to_the_wish_in_the_metric_of_the_inertia(kind):
    """Of all accelerations with J q'' = b, from the equations of least squares with the inertia's Cholesky factor."""
    arm, mechanism, pose = arm_and_pose() if kind == "posture" else leg_and_place()
    _, run = motion(kind)
    q = arm.q
    wanted = {"least": 0 * q.jet(1), "posture": -9.0 * (q.jet(0) - ca.DM(arm.posture(HOME if kind == "posture" else {}))) - 6.0 * q.jet(1)}.get(kind)
    if wanted is None:
        wanted = ca.vertcat(0, 0.3 * ca.sin(2 * q.t), 0)
    second = ca.vertcat(*(q.dt(row, 2) for row in pose.values()))
    jacobian = ca.jacobian(second, q.jet(2))
    rest = ca.substitute(second, q.jet(2), ca.SX.zeros(q.n))
    parts = [ca.densify(ca.SX(e)) for e in (mechanism.mass, jacobian, rest, wanted)]
    s = ca.vertcat(*(q.family.jet("s", k) for k in range(3)))
    f = ca.Function("f", [q.t, s, q.jet(0), q.jet(1)], parts)
    for k in range(50, 1000, 150):
        at = [np.array([run[name][k] for name in q.jet_names(level)]) for level in range(3)]
        M, J, b, a = (np.array(value) for value in f(run.t[k], MOVE.jets(run.t[k], 2)[:, 0], at[0], at[1]))
        root = np.linalg.cholesky(M).T  # |root (q'' - a)| least with J q'' = -b
        change = np.linalg.pinv(J @ np.linalg.inv(root)) @ (-b - J @ a)
        nearest = (a + np.linalg.solve(root, change)).ravel()
        assert np.abs(at[2] - nearest).max() < 1e-8 * max(1.0, np.abs(nearest).max())


def test_the_task_is_kept_and_the_self_motion_ends():
    model, run = motion("posture")
    assert max(np.abs(values[0]).max() for values in run.residual.values()) < 1e-8
    assert sv.verify(run).verdict == "passed"
    assert max(abs(run[f"d{name}"][-1]) for name in HOME) < 0.02
    fine = sv.simulate(model, model.start(guess=HOME), (0.0, 4.0), drift="project")
    assert max(np.abs(values[0]).max() for values in fine.residual.values()) < 1e-10


def test_a_wish_is_the_actuation_of_its_accelerations():
    arm, mechanism, _ = arm_and_pose()
    wish = sv.programs.wish(mechanism, {"joint_2": 1.5})
    accelerations = ca.vertcat(0, 1.5, 0, 0, 0, 0, 0)
    balance = ca.substitute(mechanism.balance, arm.q.jet(2), accelerations)
    assert mechanism.is_zero((ca.vertcat(*wish.values()) - balance).elements())
    assert list(wish) == list(mechanism.actuators)


@pytest.mark.usefixtures("uncompiled")
def test_actuators_in_another_order_and_scale_give_the_same_motion():
    q = sv.coordinates("a b c")
    S = sum(sv.particle(q, m, (x, ca.sin(q["a"]) * q["b"])) for m, x in ((1.0, q["a"]), (2.0, q["b"] + q["c"]), (3.0, q["c"])))
    directions = {"u": [0, 2.0, 0], "v": [1.0, 0, 0.5], "w": [0, 0, -1.0]}
    runs = []
    for actuators in (dict(zip("uvw", q, strict=True)), directions):
        mechanism = sv.Mechanism(q, gibbs=S, actuators=actuators)
        program = sv.Program({"X": q["a"] + q["b"] * q["c"] - 0.5 - 0.1 * ca.sin(q.t)}, weights="inertia")
        model = sv.derive(mechanism, program)
        runs.append(sv.simulate(model, model.start(b=0.5, c=0.4, db=0.1, dc=0.0, guess={"a": 0.3}), (0.0, 2.0)))
    for name in "abc":
        assert np.abs(runs[0][name] - runs[1][name]).max() < 1e-6


def test_slower_programs_keep_the_metric():
    q = arm_and_pose()[0].q
    program = sv.Program({"turn": q["joint_1"] - 0.1 * ca.sin(q.t)}, weights="inertia")
    assert program.slowed(q, 2.0).metric == program.slower(q, 2.0, 0.0).metric == "inertia"


def test_what_has_no_such_metric_is_refused():
    arm, mechanism, pose = arm_and_pose()
    some = arm.mechanism(actuators=[f"joint_{i}" for i in range(1, 7)])
    with refused(sv.errors.SpecificationError, "6 actuators"):
        sv.derive(some, sv.Program(dict(list(pose.items())[:3]), weights="inertia"))
    with refused(sv.errors.SpecificationError, "6 actuators"):
        sv.programs.wish(some)
    with refused(sv.errors.NameUnknown, "joint_8", match="joint_7"):
        sv.programs.posture(mechanism, {"joint_8": 0.0}, 1.0)
    with refused(sv.errors.SpecificationError, "weights"):
        sv.Program(pose, by="ideal", weights="inertia")
