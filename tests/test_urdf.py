"""Robots from URDF files: inertia, forces and frames against pinocchio and closed forms; what is refused."""

from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
import robots
from refusals import refused, warned

import servoctl as sv

OWN = ("six_axis_arm", "seven_axis_arm", "quadruped", "pendubot", "four_bar", "scara")
CASES = [
    *((name, "fixed") for name in OWN), ("quadruped", "free"), ("scara", "free"),
    ("ur5", "fixed"), ("ur5", "free"), ("panda", "fixed"), ("solo12", "free"), ("talos", "free"), ("talos", "fixed"),
]  # fmt: skip
STATES = 100
BAR = """<robot name="bar"><link name="ground"/><link name="bar">{inertial}</link>
<joint name="hinge" type="{kind}"><parent link="ground"/><child link="bar"/>{inside}</joint>{more}</robot>"""
INERTIAL = '<inertial><mass value="2"/><inertia ixx="1" iyy="2" izz="2.5"/></inertial>'


@lru_cache
def robot(name, base="fixed"):
    return sv.urdf(robots.file_of(name), base=base)


def bar(inertial=INERTIAL, kind="revolute", inside='<axis xyz="0 1 0"/>', more=""):
    return BAR.format(inertial=inertial, kind=kind, inside=inside, more=more)


# against pinocchio ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name, base", CASES)
def test_forces_and_mass_matrix_equal_pinocchio(name, base):
    arm = robot(name, base)
    mechanism, other = arm.mechanism(friction=0.0), robots.Pinocchio(arm, robots.file_of(name), base)
    viscous = arm._resistance(0.0)
    evaluate = robots.function_of(arm, mechanism.balance + viscous, mechanism.mass, mechanism.q.dt(mechanism.energy))
    random, rows = np.random.default_rng(1), other.rows
    for _ in range(STATES):
        q, v, a = robots.random_state(arm, random)
        forces, mass, _ = evaluate(q, v, a)
        theirs = other.configuration(q)
        wanted = other.pin.rnea(other.model, other.data, theirs, v[rows], a[rows])
        assert np.abs(forces[rows] - wanted).max() < 1e-12 * np.abs(wanted).max()
        matrix = np.triu(other.pin.crba(other.model, other.data, theirs))
        matrix += np.triu(matrix, 1).T
        assert np.abs(mass[np.ix_(rows, rows)] - matrix).max() < 1e-12 * np.abs(matrix).max()


@pytest.mark.parametrize("name, base", [("six_axis_arm", "fixed"), ("quadruped", "free"), ("talos", "free")])
def test_frames_and_their_jacobians_equal_pinocchio(name, base):
    arm = robot(name, base)
    other = robots.Pinocchio(arm, robots.file_of(name), base)
    links, random = arm.links[1:: max(1, len(arm.links) // 8)], np.random.default_rng(2)
    parts = [part for link in links for part in vars(arm.frame(link)).values() if isinstance(part, ca.SX)]
    evaluate = robots.function_of(arm, *parts)
    for _ in range(5):
        q, v, a = robots.random_state(arm, random)
        values = evaluate(q, v, a)
        other.pin.forwardKinematics(other.model, other.data, other.configuration(q), v[other.rows])
        other.pin.updateFramePlacements(other.model, other.data)
        for i, link in enumerate(links):
            number = other.model.getFrameId(link, other.pin.BODY)
            position, rotation, jacobian = values[3 * i : 3 * i + 3]
            assert np.abs(position - other.data.oMf[number].translation).max() < 1e-12
            assert np.abs(rotation - other.data.oMf[number].rotation).max() < 1e-12
            aligned = other.pin.LOCAL_WORLD_ALIGNED
            wanted = other.pin.getFrameVelocity(other.model, other.data, number, aligned).vector
            assert np.abs(jacobian @ v - wanted).max() < 1e-12 * max(1.0, np.abs(wanted).max())


# against closed forms ------------------------------------------------------------------------------------------------


def test_a_pendulum_has_its_textbook_balance():
    arm = sv.urdf(bar(inside='<origin xyz="0 0 1"/><axis xyz="0 2 0"/><dynamics damping="0.3"/>'))
    arm = sv.urdf(bar(INERTIAL.replace("<mass", '<origin xyz="0 0 -0.4"/><mass'), inside='<axis xyz="0 2 0"/><dynamics damping="0.3"/>'))
    mechanism = arm.mechanism()
    q, v, a = 0.7, 1.3, -0.4
    (balance, energy) = robots.function_of(arm, mechanism.balance, mechanism.energy)(q, v, a)
    inertia = 2.0 + 2 * 0.4**2
    assert balance == pytest.approx(inertia * a + 2 * 9.81 * 0.4 * np.sin(q) + 0.3 * v, rel=1e-14)
    assert energy == pytest.approx(inertia * v**2 / 2 - 2 * 9.81 * 0.4 * np.cos(q), rel=1e-14)
    assert mechanism.actuators == ("torque_hinge",)


def test_a_planar_joint_moves_in_its_plane():
    """A body on a frictionless table: accelerations are forces over the mass, and the angle turns about its origin."""
    arm = sv.urdf(bar(INERTIAL.replace("<mass", '<origin xyz="0.2 0 0"/><mass'), "planar", '<axis xyz="0 0 1"/>'))
    assert arm.q.names == ("hinge_x", "hinge_y", "hinge_angle")
    frame = arm.frame("bar")
    x, y, angle = arm.q
    turned = ca.vertcat(ca.horzcat(ca.cos(angle), -ca.sin(angle), 0), ca.horzcat(ca.sin(angle), ca.cos(angle), 0),
                        ca.horzcat(0, 0, 1))  # fmt: skip
    mechanism = arm.mechanism()
    body = sv.Mechanism(
        arm.q, gibbs=sv.rigid_body(arm.q, 2.0, (1.0, 2.0, 2.5), position=ca.vertcat(x, y, 0) + turned @ ca.vertcat(0.2, 0, 0),
                                   rotation=turned),
    )  # fmt: skip
    assert mechanism.is_zero((mechanism.balance - body.balance).elements())
    assert mechanism.is_zero((frame.position - ca.vertcat(x, y, 0)).elements())
    assert mechanism.is_zero((frame.rotation - turned).elements())


def test_a_floating_joint_inside_the_tree_is_a_free_body():
    """On a moving parent: forces of a body with a floating joint, from velocities in the parent's axes by q.dt."""
    text = """<robot name="two"><link name="ground"/><link name="cart"/><link name="body">INERTIAL</link>
      <joint name="slide" type="prismatic"><parent link="ground"/><child link="cart"/><axis xyz="1 0 0"/></joint>
      <joint name="loose" type="floating"><parent link="cart"/><child link="body"/></joint></robot>""".replace(
        "INERTIAL", INERTIAL.replace("<mass", '<origin xyz="0.1 0.2 0"/><mass')
    )
    arm = sv.urdf(text)
    frame, q = arm.frame("body"), arm.q
    centre = frame.position + frame.rotation @ ca.DM([0.1, 0.2, 0.0])
    gibbs = sv.rigid_body(q, 2.0, (1.0, 2.0, 2.5), position=centre, rates=frame.rotation.T @ frame.jacobian[3:, :] @ q.jet(1))
    body = sv.Mechanism(q, gibbs=gibbs, potential=2 * 9.81 * centre[2])
    evaluate = robots.function_of(arm, arm.mechanism().balance - body.balance)
    random = np.random.default_rng(3)
    values, v, a = random.normal(size=q.nq), random.normal(size=q.n), random.normal(size=q.n)
    place = q.names.index("loose_qx")
    values[place : place + 4] /= np.linalg.norm(values[place : place + 4])
    assert np.abs(evaluate(values, v, a)[0]).max() < 1e-12


def test_the_mass_matrix_by_composite_bodies_takes_fewer_operations():
    for name, base in (("six_axis_arm", "fixed"), ("quadruped", "free")):
        arm = robot(name, base)
        mechanism = arm.mechanism()
        slope = ca.jacobian(mechanism.balance, arm.q.jet(2))
        count = [ca.Function("f", [ca.vertcat(*arm.q), arm.q.jet(1)], [m], {"cse": True}).n_instructions()
                 for m in (mechanism.mass, slope)]  # fmt: skip
        assert count[0] < 0.75 * count[1]


# what a file may hold ------------------------------------------------------------------------------------------------


def test_joints_that_mimic_follow_through_chains_and_locks():
    chain = "".join(
        f'<link name="l{i}">{INERTIAL}</link><joint name="j{i}" type="revolute"><parent link="{"bar" if i == 0 else f"l{i - 1}"}"/>'
        f'<child link="l{i}"/><mimic joint="{"hinge" if i == 0 else f"j{i - 1}"}" multiplier="2" offset="0.1"/></joint>'
        for i in range(2)
    )
    arm = sv.urdf(bar(more=chain))
    assert arm.q.names == ("hinge",)
    locked = sv.urdf(bar(more=chain, inside='<axis xyz="0 1 0"/>'), lock={"hinge": 0.25}, base="free")
    turn = {"hinge": 0.25, "j0": 0.6, "j1": 1.3}
    bare = bar(more=chain.replace('<mimic joint="hinge" multiplier="2" offset="0.1"/>', "").replace(
        '<mimic joint="j0" multiplier="2" offset="0.1"/>', ""))  # fmt: skip
    by_hand = sv.urdf(bare, lock=turn, base="free")
    for ours, wanted in ((locked, by_hand),):
        difference = ours.frame("l1").position - ca.substitute(
            wanted.frame("l1").position, ca.vertcat(*wanted.q), ca.vertcat(*ours.q)
        )
        assert ours.mechanism().is_zero(difference.elements())
    forces = robots.function_of(arm, arm.mechanism().balance)(0.3, 0.0, 1.0)[0]
    free = sv.urdf(bare)
    rows = robots.function_of(free, free.mechanism().balance)([0.3, 0.7, 1.5], np.zeros(3), [1.0, 2.0, 4.0])[0]
    assert forces == pytest.approx(rows @ [1.0, 2.0, 4.0], rel=1e-13)


def test_names_become_identifiers_and_keep_apart():
    more = '<link name="l"/><joint name="d2.x" type="fixed"><parent link="bar"/><child link="l"/></joint>'
    arm = sv.urdf(bar(more=more).replace('name="hinge"', 'name="8 hinge-a"'))
    assert arm.q.names == ("j_8_hinge_a",)
    assert arm.joints == {"j_8_hinge_a": "8 hinge-a"}
    two = bar(more=f'<link name="l">{INERTIAL}</link><joint name="dx" type="revolute"><parent link="bar"/><child link="l"/></joint>')
    assert sv.urdf(two.replace('name="hinge"', 'name="x"')).q.names == ("x", "dx_")


def test_symbolic_links_have_the_numbers_of_the_file():
    fixed, symbolic = robot("six_axis_arm"), sv.urdf(robots.file_of("six_axis_arm"), symbolic=("flange", "tool"))
    p = symbolic.parameters
    assert p.defaults["flange_mass"] == 0.3
    assert p.defaults["tool_mass"] == 0.0
    assert p.defaults["flange_cz"] == pytest.approx(0.01)
    assert p.defaults["flange_ixx"] == pytest.approx(3e-4)
    values = list(p.defaults.values())
    a, b = fixed.mechanism(), symbolic.mechanism()
    q, v, w = robots.random_state(fixed, np.random.default_rng(4))
    balance = ca.Function("b", [ca.vertcat(*symbolic.q), symbolic.q.jet(1), symbolic.q.jet(2), ca.vertcat(*p.symbols)],
                          [b.balance])  # fmt: skip
    wanted = robots.function_of(fixed, a.balance)(q, v, w)[0]
    assert np.abs(np.array(balance(q, v, w, values)).ravel() - wanted).max() < 1e-12
    values[p.names.index("tool_mass")] = 2.0
    heavier = np.array(balance(q, v, w, values)).ravel()
    place = robots.function_of(fixed, fixed.frame("tool").jacobian, fixed.q.dt(fixed.frame("tool").position, 2))
    jacobian, acceleration = place(q, v, w)
    load = 2.0 * jacobian[:3].T @ (acceleration + [0.0, 0.0, 9.81])
    assert np.abs(heavier - wanted - load).max() < 1e-11


@pytest.mark.parametrize("encoding", ["utf-8", "iso-8859-1", "utf-16"])
def test_encodings_that_a_file_declares(tmp_path, encoding):
    path = tmp_path / "bar.urdf"
    path.write_bytes((f'<?xml version="1.0" encoding="{encoding}"?>' + bar().replace('"bar"', '"größe"')).encode(encoding))
    assert sv.urdf(path).links == ("ground", "größe")
    assert sv.urdf('<?xml version="1.0" encoding="iso-8859-1"?>' + bar().replace('"bar"', '"größe"')).links[1] == "größe"


def test_limits_and_damping_reach_the_plant():
    arm = robot("scara")
    assert arm.effort == {"torque_shoulder": 100.0, "torque_elbow": 60.0, "force_lift": 80.0, "force_grip_left": 10.0}
    assert arm.velocity["lift"] == 1.0
    assert arm.position["lift"] == (0.0, 0.2)
    assert arm.damping == {"shoulder": 0.2, "elbow": 0.1, "lift": 5.0}
    plant = sv.plant(arm.mechanism(), limits=arm.effort)
    assert plant.limits["force_lift"] == (-80.0, 80.0)


def test_limits_of_zero_are_none():
    """Files of some exporters have effort="0" where nothing was stated."""
    with warned("hinge"):
        arm = sv.urdf(bar(inside='<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="0" velocity="0"/>'))
    assert (arm.effort, arm.velocity, arm.position) == ({}, {}, {"hinge": (-1.0, 1.0)})


def test_dry_friction_is_smooth_or_refused():
    text = bar(inside='<axis xyz="0 1 0"/><dynamics friction="0.5"/>')
    with refused(sv.errors.SpecificationError, "hinge", "friction=0.01", joints=["hinge"]):
        sv.urdf(text).mechanism()
    arm = sv.urdf(text)
    rest, smooth = (robots.function_of(arm, arm.mechanism(friction=f).balance)(0.0, 0.3, 0.0)[0] for f in (0.0, 0.1))
    assert smooth - rest == pytest.approx(0.5 * np.tanh(3.0))
    with refused(sv.errors.SpecificationError, "-1"):
        arm.mechanism(friction=-1.0)


# what is refused -----------------------------------------------------------------------------------------------------

LOOP = (
    '<link name="a"/><link name="b"/><joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint>'
)
REFUSED = {
    "an entity": ('<!DOCTYPE robot [<!ENTITY a "b">]>' + bar(), "DOCTYPE", {"doctype": "robot"}),
    "a file of the system": ('<!DOCTYPE r SYSTEM "file:///etc/passwd"><robot/>', "DOCTYPE", {}),
    "xacro": (bar(more='<xacro:macro name="m"/>'), "xacro:macro", {}),
    "an expression": (bar(more='<link name="${x}"/>'), "${x}", {}),
    "no XML": ("<robot", "no XML", {}),
    "another root": ("<sdf/>", "<sdf>", {"tag": "sdf"}),
    "no link": ("<robot/>", "no link", {}),
    "a link twice": (bar(more='<link name="bar"/>'), "'bar'", {"name": "bar"}),
    "two roots": (bar(more='<link name="other"/>'), "other", {"roots": ["ground", "other"]}),
    "a loop": (bar(more=LOOP), "a, b", {"links": ["a", "b"]}),
    "two parents": (bar(more='<joint name="again" type="fixed"><parent link="ground"/><child link="bar"/></joint>'), "again",
                    {"link": "bar"}),
    "a type of joint": (bar(kind="revolut"), "revolute", {"type": "revolut"}),
    "an axis of zero": (bar(inside='<axis xyz="0 0 0"/>'), "0 0 0", {}),
    "a number": (bar(inside='<axis xyz="0 one 0"/>'), "0 one 0", {"value": "0 one 0"}),
    "NaN": (bar(inside='<dynamics damping="nan"/>'), "nan", {}),
    "a negative mass": (bar(INERTIAL.replace('"2"/>', '"-2"/>')), "-2", {"name": "the mass of link 'bar'", "value": -2.0}),
    "no mass": (bar('<inertial><inertia ixx="1"/></inertial>'), "bar", {}),
    "the triangle rule": (bar(INERTIAL.replace("2.5", "3.5")), "3.5", {"link": "bar"}),
    "a negative moment": (bar(INERTIAL.replace('ixx="1"', 'ixx="-1"')), "-1", {"link": "bar"}),
    "nothing that moves": (bar(kind="fixed"), "no joint that moves", {}),
    "a joint without inertia": (bar("<!-- -->"), "lock={'hinge': 0.0}", {"joint": "hinge"}),
    "a mimic of itself": (bar(inside='<mimic joint="hinge"/>'), "itself", {"joint": "hinge"}),
    "negative damping": (bar(inside='<dynamics damping="-1"/>'), "-1", {}),
    "an encoding of several bytes": (b'<?xml version="1.0" encoding="shift_jis"?>' + bar().encode(), "multi-byte", {}),
    "half a character": (bar().replace('"bar"', '"\udc80"'), "no XML", {}),
    "a mass beyond numbers": (bar(INERTIAL.replace('"2"/>', '"1e308"/>').replace("<mass", '<origin xyz="9 0 0"/><mass')),
                              "range", {"link": "bar"}),
    "moments beyond numbers": (bar(INERTIAL.replace('"1"', '"1e308"').replace('"2.5"', '"1e308"').replace(
        'iyy="2"', 'iyy="1e308"')), "range", {"link": "bar"}),
    "reversed limits": (bar(inside='<limit lower="2" upper="1"/>'), "lower=1, upper=2", {"limits": [2.0, 1.0]}),
    "a mimic of nothing": (bar(inside='<mimic multiplier="2"/>'), "None", {}),
    "a floating joint that mimics": (bar(kind="floating", inside='<mimic joint="j"/>'), "floating", {}),
    "a planar joint that mimics": (bar(kind="planar", inside='<mimic joint="j"/>'), "planar", {}),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_robot_is_refused(case):
    text, fact, details = REFUSED[case]
    with refused(sv.errors.SpecificationError, fact, **details):
        sv.urdf(text)


def test_the_nearest_possible_inertia_is_possible():
    with refused(sv.errors.SpecificationError, "Nearest") as caught:
        sv.urdf(bar(INERTIAL.replace("2.5", "3.5")))
    moments = np.linalg.eigvalsh(np.array(caught.value.details["possible"]))
    assert moments[2] <= moments[0] + moments[1] + 1e-12


def test_names_that_do_not_exist_are_answered_with_the_nearest():
    arm = robot("six_axis_arm")
    for call, name, match in (
        (lambda: arm.frame("tol"), "tol", "tool"),
        (lambda: sv.urdf(bar(), lock={"hing": 0.0}), "hing", "hinge"),
        (lambda: sv.urdf(bar(), symbolic=("baar",)), "baar", "bar"),
        (lambda: arm.mechanism(actuators=("pam",)), "pam", "pan"),
        (lambda: sv.urdf(bar(), base="fre"), "fre", "free"),
        (lambda: sv.urdf(bar(more='<joint name="k" type="fixed"><parent link="baar"/><child link="bar"/></joint>')), "baar", "bar"),
        (lambda: arm.q["lit"], "lit", "lift"),
    ):  # fmt: skip
        with refused(sv.errors.NameUnknown, name, match=match):
            call()


def test_a_huge_file_is_refused_unread(tmp_path):
    path = tmp_path / "huge.urdf"
    with path.open("wb") as file:
        file.truncate(30_000_000)
    with refused(sv.errors.SpecificationError, "30000000", size=30_000_000):
        sv.urdf(path)
    with refused(sv.errors.SpecificationError, "none.urdf"):
        sv.urdf(tmp_path / "none.urdf")


def test_a_mass_matrix_that_is_not_that_of_the_balance_is_refused():
    q = sv.coordinates("x y")
    balance = ca.vertcat(2 * q.d(2)[0] + q.d(2)[1], q.d(2)[0] + 3 * q.d(2)[1])
    right = ca.SX(ca.DM([[2, 1], [1, 3]]))
    assert sv.Mechanism(q, balance=balance, mass=right).mass is not None
    with refused(sv.errors.SpecificationError, "d2y", components=["d2y", "d2y"]):
        sv.Mechanism(q, balance=balance, mass=ca.SX(ca.DM([[2, 1], [1, 4]])))


# names that meet, and documents as they come ---------------------------------------------------------------------------


def link(name, inertial=INERTIAL):
    return f'<link name="{name}">{inertial}</link>'


def joint(name, parent, child, kind="revolute", inside='<axis xyz="0 1 0"/>'):
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def assembled(*parts, **options):
    return sv.urdf(f'<robot name="r">{"".join(parts)}</robot>', **options)


DAMPED = '<axis xyz="0 1 0"/><dynamics damping="3"/>'
ROOT = link("root", "")
MEETING = {  # robots whose names meet, and the same ones whose names do not
    "a joint named as the free base": (
        lambda name: assembled(link("root"), link("b"), joint(name, "root", "b", inside=DAMPED), base="free"), "base"),
    "a joint named as a part of a planar one": (
        lambda name: assembled(ROOT, link("a"), link("b"), joint("p", "root", "a", "planar"),
                               joint(name, "a", "b", inside=DAMPED)), "p_x"),
    "a joint named as a rate": (
        lambda name: assembled(link("root"), link("a"), link("b"), joint("h", "root", "a"),
                               joint(name, "a", "b", inside=DAMPED), base="free"), "h_rate"),
    "a joint named as an actuator": (
        lambda name: assembled(ROOT, link("a"), link("b"), joint("h", "root", "a"), joint(name, "a", "b", inside=DAMPED)),
        "torque_h"),
    "a joint named as a parameter": (
        lambda name: assembled(ROOT, link("a"), link("b"), joint("h", "root", "a"), joint(name, "a", "b", inside=DAMPED),
                               symbolic=("a",)), "a_mass"),
}  # fmt: skip


@pytest.mark.parametrize("case", MEETING)
def test_names_that_meet_change_no_equation(case):
    make, name = MEETING[case]
    ours, plain = make(name), make("other")
    assert name in ours.joints.values()
    assert len(set(ours.joints.values())) == len(set(plain.joints.values()))
    assert list(ours.damping.values()) == list(plain.damping.values()) == [3.0]
    assert len(ours.mechanism().actuators) == len(plain.mechanism().actuators)
    state = robots.random_state(plain, np.random.default_rng(8))
    numbers = list(plain.parameters.defaults.values())
    values = []
    for arm in (ours, plain):
        symbols = [ca.vertcat(*arm.q), arm.q.jet(1), arm.q.jet(2), ca.vertcat(*arm.parameters.symbols)]
        values.append(np.array(ca.Function("b", symbols, [arm.mechanism().balance])(*state, numbers)))
    assert np.abs(values[0] - values[1]).max() < 1e-14


def test_links_whose_names_are_one_identifier_keep_apart():
    parts = (ROOT, link("a.b"), link("a_b"), joint("j", "root", "a.b"), joint("k", "a.b", "a_b", "prismatic"))
    arm = assembled(*parts, symbolic=("a.b", "a_b", "a.b"))
    assert len(arm.parameters.names) == 20
    rows = sv.held(arm, ["a.b", "a_b"], {})
    assert set(rows) == {"a_b_ry", "a_b__y"}


def test_a_quaternion_is_that_of_the_base_and_a_unit_one():
    arm = assembled(link("root"), link("b"), joint("arm_qw", "root", "b"), base="free")
    assert dict(zip(arm.q.names, arm.posture({}), strict=True))["arm_qw"] == 0.0
    with refused(sv.errors.SpecificationError, "base_qz=0.3", "Nearest", length=pytest.approx(np.hypot(1.0, 0.3))) as caught:
        sv.held(arm, ["b"], {"base_qz": 0.3})
    assert caught.value.details["unit"] == pytest.approx(np.array([0, 0, 0.3, 1.0]) / np.hypot(1.0, 0.3))
    assert len(sv.held(arm, ["b"], {"base_qz": 0.6, "base_qw": 0.8})) == 6


def test_a_joint_and_what_mimics_it_move_mass_together():
    follower = '<axis xyz="0 1 0"/><mimic joint="j" multiplier="-2"/>'
    driven = assembled(ROOT, link("a", ""), link("b"), joint("j", "root", "a"), joint("f", "root", "b", inside=follower))
    assert robots.function_of(driven, driven.mechanism().mass)(0.0, 0.0, 0.0)[0] == pytest.approx(4 * 2.0)
    assembled(ROOT, link("a"), link("b", ""), joint("j", "root", "a"), joint("f", "root", "b", inside=follower))
    with refused(sv.errors.SpecificationError, "j", joint="j"):
        assembled(ROOT, link("a", ""), link("b", ""), joint("j", "root", "a"), joint("f", "root", "b", inside=follower))
    with refused(sv.errors.SpecificationError, "free base", joint=None):
        assembled(link("root", ""), base="free")


@pytest.mark.parametrize("change", [
    lambda text: "\ufeff" + text, lambda text: text.replace("\n", "\r\n"), lambda text: f'\n  <?xml version="1.0"?>{text}',
    lambda text: text.replace("<robot ", '<robot xmlns="http://a.org" xmlns:xacro="http://b.org" '),
    lambda text: text.replace("<link", "<!-- <xacro:m/> ${x} --><link"), lambda text: text.encode("utf-16"),
    lambda text: text.replace('"0 1 0"', '"0 1e308 0"'), lambda text: text.replace('"0 1 0"', '"0 1e-300 0"'),
], ids=["BOM", "CRLF", "blanks first", "namespaces", "comments", "utf-16", "long axis", "short axis"])  # fmt: skip
def test_documents_are_read_as_they_come(change):
    arm = sv.urdf(change(bar()))
    assert arm.q.names == ("hinge",)
    turned = robots.function_of(arm, arm.frame("bar").rotation)(0.3, 0.0, 0.0)[0]
    assert turned[0] == pytest.approx([np.cos(0.3), 0.0, np.sin(0.3)])


@pytest.mark.parametrize("kind", ["fixed", "planar", "floating"])
def test_joints_without_one_position_are_not_locked(kind):
    with refused(sv.errors.SpecificationError, kind, "hinge", joint="hinge"):
        sv.urdf(bar(kind=kind), lock={"hinge": 0.3})


def test_a_file_without_end_is_refused():
    with refused(sv.errors.SpecificationError, "bytes"):
        sv.urdf("/dev/zero")
