"""Two descriptions of one quantity agree, or one follows from the other: inertia, forces, rates, limits of a file."""

import casadi as ca
import numpy as np
import pytest
from frames import quaternion
from refusals import refused, warned
from robots import OWN, bodies
from scipy.integrate import solve_ivp

import servoctl as sv

# inertia that forces contain ------------------------------------------------------------------------------------------

ARM = bodies("base", "arm", axes=("0 1 0",), centre="0.5 0 0")  # 0.26 kg m^2 about its joint
TWO = bodies("base", "arm", "hand", axes=("0 0 1", "0 0 1"), centre="0.5 0 0")
ROTOR = (
    '<transmission name="t"><type>SimpleTransmission</type><joint name="ja"/><actuator name="m">'
    '<drake:rotor_inertia value="0.005"/><drake:gear_ratio value="10"/></actuator></transmission>'
)


def by_force(robot):
    return robot.mechanism(forces={"ja": -0.5 * robot.q.d(2)[0]})


def by_balance(robot):
    """The same inertia in a Gibbs function, gravity as a potential."""
    q = robot.q
    (angle,) = q
    place = 0.5 * ca.vertcat(ca.cos(angle), -ca.sin(angle))
    S = sv.particle(q, 1.0, place) + 0.01 * q.d(2)[0] ** 2 / 2
    return sv.Mechanism(q, S, 9.81 * place[1], {"torque_ja": angle}, forces={"ja": -0.5 * q.d(2)[0]})


ROTORS = {
    "force": (ARM, by_force),
    "force beside a Gibbs function": (ARM, by_balance),
    "armature": (ARM, lambda robot: robot.mechanism(armature={"ja": 0.5})),
    "file": (ARM.replace("</robot>", f"{ROTOR}</robot>"), lambda robot: robot.mechanism()),
    "in place of the file's": (
        ARM.replace("</robot>", f"{ROTOR.replace('10', '3')}</robot>"),
        lambda robot: robot.mechanism(armature={"ja": 0.5}),
    ),
}


@pytest.mark.parametrize("case", ROTORS)
def test_inertia_in_a_force_reaches_plan_plant_and_loop(case):
    text, make = ROTORS[case]
    robot = sv.urdf(text)
    q, m = robot.q, make(robot)
    plant = sv.plant(m)
    assert plant.rates(0.0, [np.pi / 2, 0.0], [1.0])[1] == pytest.approx(1 / 0.76, rel=1e-12)  # hangs
    path = q.references(J=sv.paths.rest_to_rest(0.0, 1.0, 1.0, smoothness=3)).J
    model = sv.derive(m, sv.Program({"J": q["ja"] - path}))
    plan = sv.simulate(model, model.start(), (0.0, 1.0))
    by_hand = 0.76 * plan["d2ja"] - 0.5 * 9.81 * np.cos(plan["ja"])
    assert plan["torque_ja"] == pytest.approx(by_hand, rel=1e-10, abs=1e-10)
    assert sv.verify(plan).verdict == "passed"
    loop = sv.close(plant, sv.feedforward(plan, plant), plan.state(0.0), (0.0, 1.0))
    assert abs(loop["ja"][-1] - 1.0) < 1e-4 and sv.verify(loop).verdict == "passed"


def test_rotors_of_a_follower_and_of_two_joints():
    """The joint jb turns twice as fast as ja: its rotor counts fourfold."""
    follows = TWO.replace('<child link="hand"/>', '<child link="hand"/><mimic joint="ja" multiplier="2"/>')
    rotor = ROTOR.replace('"ja"', '"jb"').replace("</robot>", "")
    plain, more = map(sv.urdf, (follows, follows.replace("</robot>", f"{rotor}</robot>")))
    masses = [ca.Function("f", [r.q.jet(0)], [r.mechanism().mass])(0.3) for r in (plain, more)]
    assert float(masses[1] - masses[0]) == pytest.approx(4 * 0.5, rel=1e-12)
    two = sv.urdf(TWO)
    added = two.mechanism(armature={"ja": 0.5, "jb": 0.25}).mass - two.mechanism().mass
    f = ca.Function("f", [ca.vertcat(*two.q)], [ca.densify(added)])
    assert np.array(f([0.3, 0.4])) == pytest.approx(np.diag([0.5, 0.25]), abs=1e-14)


def test_forces_whose_inertia_is_not_symmetric_are_refused():
    for robot in (sv.urdf(TWO),):
        with refused(sv.errors.SpecificationError, "d2ja", "d2jb"):
            robot.mechanism(forces={"ja": -0.5 * robot.q.d(2)[1]})
    q = sv.coordinates("x y")
    S = sv.particle(q, 1.0, ca.vertcat(*q))
    with refused(sv.errors.SpecificationError, "d2x", "d2y"):
        sv.Mechanism(q, S, forces={"x": -0.5 * q.d(2)[1]})
    both = {"x": -0.5 * q.d(2)[1], "y": -0.5 * q.d(2)[0]}
    mass = ca.evalf(sv.Mechanism(q, S, forces=both).mass)
    assert np.array(mass) == pytest.approx(np.array([[1.0, 0.5], [0.5, 1.0]]))


def pieces():
    arm = sv.urdf(OWN / "six_axis_arm.urdf")
    m = arm.mechanism()
    without = m.balance + m.forces - arm.q.V.T @ ca.gradient(m.potential, ca.vertcat(*arm.q))
    return arm.q, m, without


def test_a_balance_with_gravity_or_damping_is_not_given_them_again():
    q, m, without = pieces()
    gravity = ca.gradient(m.potential, ca.vertcat(*q))
    spring = ca.vertcat(3.0 * q["pan"], ca.SX.zeros(5))
    for balance, beside in (
        (m.balance, {"potential": m.potential}),
        (m.balance, {"forces": m.forces}),
        (m.balance, {"potential": m.potential, "forces": m.forces}),
        (without + gravity + spring, {"potential": m.potential}),
        (without + gravity, {"forces": -gravity}),
        (without - m.forces, {"potential": m.potential, "forces": m.forces}),
    ):
        with refused(sv.errors.SpecificationError, "balance", "lift"):
            sv.Mechanism(q, balance=balance, **beside)
    at = ca.Function("f", [q.jet(0), q.jet(1), q.jet(2)], [m.balance])
    numbers = [np.linspace(0.2, 1.1, 6), np.linspace(-1, 1, 6), np.linspace(2, -1, 6)]
    for options in (
        {"balance": m.balance},
        {"balance": m.balance, "mass": m.mass},
        {"balance": without, "potential": m.potential, "forces": m.forces},
        {"balance": without + gravity, "forces": m.forces},
        {"balance": without - m.forces, "potential": m.potential},
        {"balance": without + gravity - spring, "forces": m.forces - spring},
    ):
        other = sv.Mechanism(q, **options).balance
        same = ca.Function("f", [q.jet(0), q.jet(1), q.jet(2)], [other])
        assert np.array(same(*numbers)) == pytest.approx(np.array(at(*numbers)), rel=1e-12)


@pytest.mark.parametrize("factor, different", [(1.0, []), (2.0, ["d2x", "d2th"]), ("no coupling", ["d2x", "d2th"])])
def test_a_kinetic_energy_beside_a_balance_has_its_inertia(factor, different):
    q = sv.coordinates("x th")
    (x, th), (dx, dth), (d2x, d2th) = q, q.d(1), q.d(2)
    balance = [3 * d2x + ca.cos(th) * d2th - ca.sin(th) * dth**2, ca.cos(th) * d2x + d2th + 9.81 * ca.sin(th)]
    kinetic = 1.5 * dx**2 + 0.5 * dth**2 + ca.cos(th) * dx * dth
    kinetic = kinetic - ca.cos(th) * dx * dth if isinstance(factor, str) else factor * kinetic
    options = {"kinetic": kinetic, "balance": balance, "actuators": {"f": x}}
    if different:
        with refused(sv.errors.SpecificationError, components=different):
            sv.Mechanism(q, **options)
    else:
        assert sv.Mechanism(q, **options).energy.is_scalar()


@pytest.mark.parametrize("twice", [{"balance", "gibbs"}, {"gibbs", "mass"}, {"kinetic", "mass"}])
def test_inertia_given_twice_is_refused(twice):
    q = sv.coordinates("x")
    a, v = q.d(2)[0], q.d(1)[0]
    given = {"gibbs": a**2, "balance": 3 * a, "mass": ca.SX(4), "kinetic": v**2}
    with refused(sv.errors.SpecificationError, *twice):
        sv.Mechanism(q, **{name: given[name] for name in twice})


# rates of rotations -----------------------------------------------------------------------------------------------------

J = (0.02, 0.05, 0.03)
q = sv.coordinates("a b c")  # z-y-x angles
A, B, C = q
da, db, dc = q.d(1)
S, K = ca.sin, ca.cos


def turned(rate=da):
    """Body rates of z-y-x angles, `rate` of the first."""
    return [dc - rate * S(B), db * K(C) + rate * K(B) * S(C), -db * S(C) + rate * K(B) * K(C)]


BODY = turned()
INERTIAL = [dc * K(B) * K(A) - db * S(A), dc * K(B) * S(A) + db * K(A), da - dc * S(B)]
RATES = {  # rates, moments of inertia, and whether they are those of the inertial axes; None: of a body
    "body": (BODY, J, None),
    "inertial": (INERTIAL, J, True),
    "left-handed order": ([BODY[1], BODY[0], BODY[2]], J, True),
    "one axis reversed": ([-BODY[0], BODY[1], BODY[2]], J, True),
    "turned by 90 degrees": ([BODY[1], -BODY[0], BODY[2]], J, None),
    "inertial, of a ball": (INERTIAL, (0.02, 0.02, 0.02), None),
    "inertial, of a top": (INERTIAL, (0.02, 0.02, 0.05), True),
    "a sign wrong": ([dc + da * S(B), *BODY[1:]], J, False),
    "rates of angles": ([dc, db, da], J, False),
    "about one axis": ([0, 0, da], (0, 0, 1), None),
    "twice as fast": ([0, 2 * da, 0], J, None),
    "about one axis, of no angle": ([0, 0, A * db], (0, 0, 1), False),
    "upright disc": ([0, da, db], (0.1, 0.25, 0.1), None),
    "driven": (turned(3.0), J, None),
    "driven by time": (turned(K(q.t)), J, None),
    "driven, a sign wrong": ([BODY[0], *turned(-3.0)[1:]], J, False),
    "driven, inertial": ([dc * K(B) * K(3 * q.t) - db * S(3 * q.t), dc * K(B) * S(3 * q.t) + db * K(3 * q.t), 3.0 - dc * S(B)], J, True),
}  # fmt: skip


@pytest.mark.parametrize("case", RATES)
def test_rates_are_those_of_a_rotation_along_the_bodys_axes(case):
    rates, moments, inertial = RATES[case]
    if inertial is not None:
        with refused(sv.errors.SpecificationError, "rates", inertial=inertial):
            sv.rigid_body(q, 0, moments, rates=rates)
        return
    S = sv.rigid_body(q, 0, moments, rates=rates)
    omega = ca.vertcat(*rates)
    energy = ca.dot(omega, ca.SX(moments) * omega) / 2
    sv.Mechanism(q, S, kinetic=energy, forces={name: -w for name, w in zip("abc", q.d(1), strict=True)})  # agree


def frame(columns):
    """Angles with quasi-velocities that are these rates."""
    return q.with_quasi_velocities("p q r", ca.inv(ca.jacobian(ca.vertcat(*columns), q.jet(1))))


def world():
    """A quaternion with rates along the inertial axes."""
    e0, e1, e2, e3 = plain = sv.coordinates("e0 e1 e2 e3")
    V = [[-e1, -e2, -e3], [e0, e3, -e2], [-e3, e0, e1], [e2, -e1, e0]]
    return plain.with_quasi_velocities("p q r", ca.vertcat(*(ca.horzcat(*row) for row in V)) / 2,
                                       invariants={"unit": e0**2 + e1**2 + e2**2 + e3**2 - 1})  # fmt: skip


@pytest.mark.parametrize("make, right", [
    (lambda: frame(BODY), True), (lambda: frame(INERTIAL), False), (lambda: quaternion()[0], True), (world, False),
])  # fmt: skip
def test_quasi_velocities_are_those_of_the_bodys_axes(make, right):
    moved = make()
    if right:
        sv.rigid_body(moved, 0, J, rates=moved.w())
        return
    with refused(sv.errors.SpecificationError, "rates", inertial=True):
        sv.rigid_body(moved, 0, J, rates=moved.w())


def test_body_rates_of_a_rotation_are_taken():
    moved, R = quaternion()
    sv.rigid_body(moved, 0, J, rates=sv.body_rates(moved, R))
    sv.rigid_body(moved, 0, J, rates=R.T @ R @ ca.vertcat(*moved.w()))
    with refused(sv.errors.SpecificationError, "rates"):
        sv.rigid_body(moved, 0, J, rates=R @ ca.vertcat(*moved.w()))


def test_a_body_that_tumbles_by_its_body_rates():
    """Against Euler's equations, in body rates, by SciPy."""
    m = sv.Mechanism(q, sv.rigid_body(q, 0, J, rates=BODY))
    start = [0.3, 0.2, 0.1, 1.0, 0.5, 2.0]
    run = sv.simulate(sv.plant(m), start, (0.0, 2.0), "Taylor")
    rates = ca.Function("w", [q.jet(0), q.jet(1)], [ca.vertcat(*BODY), ca.jacobian(ca.vertcat(*BODY), q.jet(1))])
    first = np.array(rates(start[:3], start[3:])[0]).ravel()

    def euler(_, x):
        w = x[3:]
        matrix = np.array(rates(x[:3], np.zeros(3))[1])
        return [*np.linalg.solve(matrix, w), *(-np.cross(w, np.multiply(J, w)) / J)]

    by_euler = solve_ivp(euler, (0.0, 2.0), [*start[:3], *first], rtol=1e-11, atol=1e-12).y[:3, -1]
    assert [run[name][-1] for name in "abc"] == pytest.approx(by_euler, abs=1e-7)


# what files say ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effort, velocity", [("-1", "5"), ("0", "5"), ("10", "0"), ("10", "-1")])
def test_limits_that_limit_nothing_are_named(effort, velocity):
    text = bodies("base", "arm", axes=("0 1 0",), inside=f'<limit effort="{effort}" velocity="{velocity}"/>')
    with warned("ja", "0 or less"):
        robot = sv.urdf(text)
    assert bool(robot.effort) == (float(effort) > 0) and bool(robot.velocity) == (float(velocity) > 0)


def test_limits_of_joints_that_are_not_driven_hold_by_themselves():
    robot = sv.urdf(bodies("base", "arm", "hand", axes=("0 1 0",) * 2, inside='<limit effort="7" velocity="5"/>'))
    plant = sv.plant(robot.mechanism(actuators=("ja",)), limits=robot.effort)
    assert plant.limits == {"torque_ja": (-7.0, 7.0)}
    with refused(sv.errors.NameUnknown, "torque_jc"):
        sv.plant(robot.mechanism(actuators=("ja",)), limits={"torque_jc": 1.0})


FILES = {
    "two masses": ('<mass value="1.0"/>', '<mass value="1.0"/><mass value="2.0"/>', ["'arm'", "2 elements <mass>"]),
    "two inertials": ("</inertial></link><joint", '</inertial><inertial><mass value="1"/></inertial></link><joint',
                      ["'arm'", "2 elements <inertial>"]),
    "two axes": ('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><axis xyz="1 0 0"/>', ["'ja'", "2 elements <axis>"]),
    "two limits": ('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><limit effort="1"/><limit effort="2"/>', ["'ja'", "<limit>"]),
    "no mass": ('<mass value="1.0"/>', "", ["<mass>", "'arm'"]),
    "a rotor of no joint": ("</robot>", ROTOR.replace('"ja"', '"jz"') + "</robot>", ["'jz'"]),
    "a negative rotor": ("</robot>", ROTOR.replace("0.005", "-1") + "</robot>", ["'t'", "-1"]),
    "two ratios": ("</robot>", ROTOR.replace("</actuator>", '<drake:gear_ratio value="3"/></actuator>') + "</robot>",
                   ["'t'", "drake:gear_ratio"]),
}  # fmt: skip


@pytest.mark.parametrize("case", FILES)
def test_files_that_say_a_thing_twice_or_of_nothing_are_refused(case):
    old, new, facts = FILES[case]
    kind = sv.errors.NameUnknown if "no joint" in case else sv.errors.SpecificationError
    assert old in ARM
    with refused(kind, *facts):
        sv.urdf(ARM.replace(old, new))


@pytest.mark.parametrize("armature, kind", [({"ja": -0.1}, sv.errors.SpecificationError), ({"jb": 1.0}, sv.errors.NameUnknown)])
def test_a_negative_rotor_and_one_of_no_joint_are_refused(armature, kind):
    with refused(kind, *armature):
        sv.urdf(ARM).mechanism(armature=armature)


# chains whose files have five digits --------------------------------------------------------------------------------------


def four_bar(crank, rocker, aside=0.0):
    """A planar four-bar whose base has two joints turned by these angles about x."""
    text = bodies("crank", "coupler", axes=("0 0 1",), mass=2.0, centre="0.25 0 0", points={"none": "0 0 0"})
    text = text.replace('<robot name="bodies">', '<robot name="bodies"><link name="ground"/>')
    text = text.replace('<axis xyz="0 0 1"/></joint>', '<axis xyz="0 0 1"/><origin xyz="0.2 0 0"/></joint>')
    link = bodies("rocker", mass=1.5, centre="0.2 0 0").split(">", 1)[1].removesuffix("</robot>")
    place = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="{4}" rpy="{5} 0 0"/><axis xyz="0 0 1"/></joint>'
    more = link + '<link name="end"/><link name="tip"/>' + "".join((
        place.format("a", "continuous", "ground", "crank", "0 0 0", crank),
        place.format("c", "continuous", "ground", "rocker", "0.45 0 0", rocker),
        place.format("e", "fixed", "coupler", "end", f"0.5 0 {aside}", 0),
        place.format("d", "fixed", "rocker", "tip", "0.4 0 0", 0),
    ))  # fmt: skip
    robot = sv.urdf(text.replace("</robot>", f"{more}</robot>"))
    return robot, sv.loop(robot.frame("end"), robot.frame("tip"), "position")


def torque(crank, rocker):
    robot, rows = four_bar(crank, rocker)
    assert len(rows) == 2
    model = sv.derive(
        robot.mechanism(rows, actuators=("a",)),
        sv.Program({"A": robot.q["a"] - 0.5 - robot.q.references(A=sv.paths.rest_to_rest(0.0, 1.0, 1.0)).A}),
    )
    return sv.simulate(model, model.start(guess={"a": 0.5, "ja": 0.5, "c": 1.5}), (0.0, 1.0))["torque_a"]


def test_angles_of_five_digits_make_a_planar_linkage():
    exact = torque("1.5707963267948966", "1.5707963267948966")
    for crank, rocker in (("1.5708", "1.5707963"), ("1.570796", "1.5708")):
        assert torque(crank, rocker) == pytest.approx(exact, rel=1e-5, abs=1e-5 * np.abs(exact).max())


def test_a_chain_a_tenth_of_a_millimetre_beside_its_plane_is_refused_with_its_gap():
    with refused(sv.errors.SpecificationError, "loop_z", row="loop_z") as caught:
        four_bar("1.5708", "1.5708", 1e-4)
    assert abs(caught.value.details["value"]) == pytest.approx(1e-4, rel=1e-6) and "kind=" not in str(caught.value)


# constants of rolling with quasi-velocities -------------------------------------------------------------------------------


@pytest.mark.parametrize("V", [np.eye(3), [[1, 0.5, 0], [0, 1, 0.2], [0, 0, 1]]])
def test_the_constant_of_rolling_is_named_with_quasi_velocities(V):
    """A ball of radius 0.2 m rolls under a body that stands on it: where it has turned to is the constant."""
    plain = sv.coordinates("x phi a")
    x, phi, a = plain
    moved = plain.with_quasi_velocities("u v w", ca.DM(np.array(V)))
    dx, dphi, _ = moved.d(1)
    body = sv.particle(moved, 1.0, (x + 0.6 * ca.sin(a), 0.6 * ca.cos(a)))
    S = sv.particle(moved, 1.0, x) + 0.01 * moved.d(2)[1] ** 2 + body
    m = sv.Mechanism(
        moved, S, 9.81 * 0.6 * ca.cos(a), {"T": phi - a}, constraints={"roll": dx - 0.2 * dphi}
    )  # fmt: skip
    path = plain.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=4)).X
    found = sv.report(sv.derive(m, sv.Program({"X": x - path})))
    assert "0 is the constant of phi" in found.reason
