"""Bodies and mechanisms: the balance against Lagrange, Euler and Newton; actuators, forces, refusals."""

import casadi as ca
import numpy as np
import pytest
from conftest import at_random, numbers
from frames import UNIT, boat, euler_angles, quaternion, same
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError

# bodies and balances -------------------------------------------------------------------------------------------------


def balances(q, gibbs, kinetic, p=None, **options):
    by = {"gibbs": gibbs}, {"kinetic": kinetic}
    return [sv.Mechanism(q, parameters=p, **energy, **options).balance for energy in by]


def test_planar_pendulum_by_appell_and_by_lagrange():
    p = sv.parameters(m=2.0, l=0.7, g=9.81)
    q = sv.coordinates("theta")
    (theta,), (dtheta,), (ddtheta,) = q, q.d(1), q.d(2)
    U = -p.m * p.g * p.l * ca.cos(theta)
    S = sv.particle(q, p.m, (p.l * ca.sin(theta), -p.l * ca.cos(theta)))
    appell, lagrange = balances(q, S, p.m * p.l**2 * dtheta**2 / 2, p, potential=U)
    same(appell, p.m * p.l**2 * ddtheta + p.m * p.g * p.l * ca.sin(theta), q, p)
    same(lagrange, appell, q, p)


def test_pendulum_on_a_moving_support():
    q = sv.coordinates("theta")
    (theta,), (ddtheta,) = q, q.d(2)
    support = 0.3 * ca.sin(2 * q.t)
    position = ca.vertcat(support + 0.7 * ca.sin(theta), -0.7 * ca.cos(theta))
    velocity = q.dt(position)
    appell, lagrange = balances(q, sv.particle(q, 2.0, position), ca.dot(velocity, velocity))
    same(appell, 2 * 0.49 * ddtheta + 2 * 0.7 * ca.cos(theta) * q.dt(support, 2), q)
    same(lagrange, appell, q)


def test_spherical_pendulum_by_appell_and_by_lagrange():
    p = sv.parameters(m=1.3, l=0.9, g=9.81)
    q = sv.coordinates("theta phi")
    theta, phi = q
    dtheta, dphi = q.d(1)
    position = p.l * ca.vertcat(ca.sin(theta) * ca.cos(phi), ca.sin(theta) * ca.sin(phi), -ca.cos(theta))
    T = p.m * p.l**2 * (dtheta**2 + (ca.sin(theta) * dphi) ** 2) / 2
    appell, lagrange = balances(q, sv.particle(q, p.m, position), T, p, potential=p.m * p.g * position[2])
    same(appell, lagrange, q, p)


def test_free_body_with_euler_angles_by_appell_and_by_lagrange():
    plain, rotation, _ = euler_angles()
    J = [[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 1.1]]
    omega = sv.body_rates(plain, rotation)
    appell, lagrange = balances(
        plain, sv.rigid_body(plain, 0, J, rotation=rotation), ca.dot(omega, ca.SX(J) @ omega) / 2
    )  # fmt: skip
    same(appell, lagrange, plain, rel=1e-11)


def test_body_rates_of_a_rotation_matrix():
    plain, rotation, frame = euler_angles()
    frame = ca.vertcat(*(ca.horzcat(*row) for row in frame))
    same(frame @ sv.body_rates(plain, rotation), ca.vertcat(*plain.d(1)), plain)
    q, by_quaternion = quaternion()
    same(sv.body_rates(q, by_quaternion), ca.vertcat(*q.w()), q, **UNIT)
    spin = sv.coordinates("a")
    (a,) = spin
    about_z = ca.vertcat(ca.horzcat(ca.cos(a), -ca.sin(a), 0), ca.horzcat(ca.sin(a), ca.cos(a), 0), ca.horzcat(0, 0, 1))
    same(sv.body_rates(spin, about_z), ca.vertcat(0, 0, *spin.d(1)), spin)


def euler_equations(q, J):
    omega, alpha = ca.vertcat(*q.w()), ca.vertcat(*q.w(1))
    return J @ alpha + ca.cross(omega, J @ omega)


J_FULL = ca.SX([[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 1.1]])


@pytest.mark.parametrize("kind", ["rates", "rotation", "kinetic"])
@pytest.mark.parametrize("frame", ["angles", "quaternion"])
def test_free_body_with_body_rates_obeys_euler(kind, frame):
    if frame == "angles":
        plain, rotation, V = euler_angles()
        q, point = plain.with_quasi_velocities("p q r", V), {}
    else:
        (q, rotation), point = quaternion(), UNIT
    omega = ca.vertcat(*q.w())
    options = {
        "rates": lambda: {"gibbs": sv.rigid_body(q, 0, J_FULL, rates=omega)},
        "rotation": lambda: {"gibbs": sv.rigid_body(q, 0, J_FULL, rotation=rotation)},
        "kinetic": lambda: {"kinetic": ca.dot(omega, J_FULL @ omega) / 2},
    }[kind]()
    same(sv.Mechanism(q, **options).balance, euler_equations(q, J_FULL), q, rel=1e-11, **point)


def test_a_quaternion_takes_both_a_gibbs_function_and_a_kinetic_energy():
    q, rotation = quaternion()
    omega = ca.vertcat(*q.w())
    T = ca.dot(omega, J_FULL @ omega) / 2
    both = sv.Mechanism(q, gibbs=sv.rigid_body(q, 0, J_FULL, rates=omega), kinetic=T)
    same(both.balance, euler_equations(q, J_FULL), q)


def test_inertia_may_be_a_diagonal_a_list_or_an_array():
    q, _ = quaternion()
    rates = q.w()
    full = sv.rigid_body(q, 0, ca.diag(ca.SX([1.0, 2.0, 3.0])), rates=rates)
    for inertia in ((1.0, 2.0, 3.0), [1.0, 2.0, 3.0], ca.SX([1, 2, 3]), np.diag([1.0, 2, 3]), np.array([1.0, 2, 3]),
                    [[1, 0, 0], [0, 2, 0], [0, 0, 3]], ca.DM([1, 2, 3])):  # fmt: skip
        same(sv.rigid_body(q, 0, inertia, rates=rates), full, q)


def test_a_body_has_the_inertia_of_its_mass_and_of_its_rotation():
    q = sv.coordinates("x y z yaw pitch roll")
    x, y, z, *angles = q
    _, rotation, _ = euler_angles()
    rotation = ca.substitute(rotation, ca.vertcat(*ca.symvar(rotation)), ca.vertcat(*angles))
    order = [s.name() for s in ca.symvar(euler_angles()[1])]
    assert sorted(order) == ["pitch", "roll", "yaw"]
    S = sv.rigid_body(q, 3.0, J_FULL, position=(x, y, z), rotation=rotation)
    parts = sv.particle(q, 3.0, (x, y, z)) + sv.rigid_body(q, 0, J_FULL, rotation=rotation)
    same(S, parts, q)


def disk(q, R):
    """A disk of radius 0.5 that rolls on the plane; heading psi, lean theta, spin phi."""
    x, y, psi, theta, phi = q
    c, s = ca.cos, ca.sin
    Rz = ca.vertcat(ca.horzcat(c(psi), -s(psi), 0), ca.horzcat(s(psi), c(psi), 0), ca.horzcat(0, 0, 1))
    Rx = ca.vertcat(ca.horzcat(1, 0, 0), ca.horzcat(0, c(theta), -s(theta)), ca.horzcat(0, s(theta), c(theta)))
    Ry = ca.vertcat(ca.horzcat(c(phi), 0, s(phi)), ca.horzcat(0, 1, 0), ca.horzcat(-s(phi), 0, c(phi)))
    rotation = Rz @ Rx @ Ry
    up = Rz @ Rx @ ca.SX([0, 0, 1])
    centre = ca.vertcat(x, y, 0) + R * up
    spin = q.dt(rotation) @ rotation.T
    omega = ca.vertcat(spin[2, 1], spin[0, 2], spin[1, 0])
    slip = q.dt(centre) - ca.cross(omega, R * up)
    return rotation, centre, slip


def test_rolling_disk_by_appell_and_by_lagrange():
    q = sv.coordinates("x y psi theta phi")
    p = sv.parameters(m=2.0, A=0.25, C=0.5, R=0.5, g=9.81)
    rotation, centre, _ = disk(q, p.R)
    J = ca.vertcat(p.A, p.C, p.A)
    omega, v = sv.body_rates(q, rotation), q.dt(centre)
    T = p.m * ca.dot(v, v) / 2 + ca.dot(omega, J * omega) / 2
    S = sv.rigid_body(q, p.m, J, position=centre, rotation=rotation)
    appell, lagrange = balances(q, S, T, p, potential=p.m * p.g * centre[2])
    same(appell, lagrange, q, p, rel=1e-11)
    both = sv.Mechanism(q, gibbs=S, kinetic=T, parameters=p)
    assert both.mass.shape == (5, 5)


def rolling_coin():
    """An upright coin whose quasi-velocities, spin and turning rate, can only roll."""
    plain = sv.coordinates("x y psi phi")
    _, _, psi, _ = plain
    q = plain.with_quasi_velocities("spin turn", [[0.5 * ca.cos(psi), 0], [0.5 * ca.sin(psi), 0], [0, 1], [1, 0]])
    return q


def test_rolling_coin_with_quasi_velocities_that_roll():
    q = rolling_coin()
    spin, turn = q.w()
    x, y, *_ = q
    S = sv.rigid_body(q, 2.0, (0.1, 0.25, 0.1), position=(x, y), rates=(0, spin, turn))
    same(sv.Mechanism(q, gibbs=S).balance, ca.vertcat((0.25 + 2.0 * 0.25) * q.w(1)[0], 0.1 * q.w(1)[1]), q)


def test_a_kinetic_energy_on_a_frame_that_is_not_integrable_is_refused():
    q = rolling_coin()
    spin, turn = q.w()
    with refused(SpecificationError, "Gibbs") as caught:
        sv.Mechanism(q, kinetic=0.375 * spin**2 + 0.05 * turn**2)
    assert "Gibbs" in str(caught.value)


def test_a_kinetic_energy_on_an_integrable_frame_is_lagrange_on_its_leaf():
    """A pendulum in Cartesian coordinates, moved along its circle."""
    plain = sv.coordinates("x y")
    x, y = plain
    q = plain.with_quasi_velocities("omega", [[-y], [x]])
    (omega,) = q.w()
    mechanism = sv.Mechanism(q, kinetic=2.0 * (x**2 + y**2) * omega**2 / 2, potential=2.0 * 9.81 * y)
    same(mechanism.balance, 2.0 * (x**2 + y**2) * q.w(1)[0] + 2.0 * 9.81 * x, q)


def test_a_kinetic_energy_in_a_square_frame_with_drift():
    """A particle in a turning frame: the body-fixed velocities with V a rotation and h = t-dependent wind."""
    plain = sv.coordinates("x y")
    a = 0.7 * plain.t
    V = ca.vertcat(ca.horzcat(ca.cos(a), -ca.sin(a)), ca.horzcat(ca.sin(a), ca.cos(a)))
    q = plain.with_quasi_velocities("u v", V, h=(ca.sin(plain.t), 0.2 * next(iter(plain))))
    velocity = ca.vertcat(*q.d(1))
    appell, lagrange = balances(q, sv.particle(q, 3.0, tuple(q)), 1.5 * ca.dot(velocity, velocity))
    same(appell, lagrange, q)


def test_gibbs_and_kinetic_that_disagree_are_refused_with_the_component():
    q = sv.coordinates("x theta")
    dx, dtheta = q.d(1)
    S = sv.particle(q, 2.0, tuple(q))
    assert sv.Mechanism(q, gibbs=S, kinetic=dx**2 + dtheta**2).mass.shape == (2, 2)
    with refused(SpecificationError, components=["d2theta"]) as caught:
        sv.Mechanism(q, gibbs=S, kinetic=dx**2 + 1.0000001 * dtheta**2)
    assert caught.value.details["components"] == ["d2theta"]


def test_an_integer_mass_position_or_a_number_makes_a_body():
    q = sv.coordinates("x")
    (x,) = q
    same(sv.particle(q, 2, x), q.d(2)[0] ** 2, q)
    same(sv.particle(q, ca.SX(2), [x, 0]), q.d(2)[0] ** 2, q)
    same(sv.particle(q, np.float64(2), np.array([x, 0])), q.d(2)[0] ** 2, q)


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda q: sv.particle(q, 1.0, q.d(1)[0]), ["order 1"]),
        (lambda q: sv.particle(q, 1.0, "x"), ["str"]),
        (lambda q: sv.particle(q, 1.0, None), ["NoneType"]),
        (lambda q: sv.particle(q, 1.0, [0, 0, 0, 0]), ["4"]),
        (lambda q: sv.particle(q, 1.0, []), ["0"]),
        (lambda q: sv.rigid_body(q, 1.0, (1, 1, 1)), ["neither", "rotation", "rates"]),
        (lambda q: sv.rigid_body(q, 1.0, (1, 1, 1), rates=(0, 0, 1), rotation=ca.SX.eye(3)), ["both"]),
        (lambda q: sv.rigid_body(q, 1.0, (1, 1), rates=(0, 0, 1)), ["(2, 1)"]),
        (lambda q: sv.rigid_body(q, 1.0, (1, 1, 1), rates=(0, 1)), ["rates", "2 entries", "3"]),
        (lambda q: sv.rigid_body(q, 1.0, (1, 1, 1), rotation=ca.SX.eye(2)), ["(2, 2)", "(3, 3)"]),
    ],
)
def test_bodies_of_wrong_shape_are_refused(make, facts):
    with pytest.raises(SpecificationError) as caught:
        make(sv.coordinates("x y"))
    assert [fact for fact in facts if fact not in str(caught.value)] == []


# mechanism -----------------------------------------------------------------------------------------------------------


def test_actuators_by_displacement_and_by_direction():
    q = sv.coordinates("x theta")
    x, theta = q
    S = sv.particle(q, 1.0, tuple(q))
    tip = x + 0.5 * ca.sin(theta)
    by_displacement = sv.Mechanism(q, gibbs=S, actuators={"rail": x, "tip": tip})
    by_direction = sv.Mechanism(q, gibbs=S, actuators={"rail": (1, 0), "tip": ca.vertcat(1, 0.5 * ca.cos(theta))})
    assert by_displacement.actuators == ("rail", "tip")
    same(ca.vec(by_displacement.E), ca.vec(by_direction.E), q)
    as_array = sv.Mechanism(q, gibbs=S, actuators={"rail": np.array([1.0, 0.0])})
    same(as_array.E, ca.SX([1, 0]), q)


def test_an_actuator_works_on_quasi_velocities_through_the_frame():
    q = boat()
    x, y, psi = q
    S = sv.rigid_body(q, 1.0, (0, 0, 1), position=(x, y), rates=(0, 0, q.w()[2]))
    mechanism = sv.Mechanism(q, gibbs=S, potential=9.81 * y, actuators={"rope": x}, forces={"u": -3 * q.w()[0]})
    values = at_random(q)
    c, s = np.cos(values["psi"]), np.sin(values["psi"])
    assert numbers([mechanism.E], values) == pytest.approx([c, -s, 0])
    at_rest = values | {"u": 2.0, "v": 0.0, "r": 0.0, "du": 0.0, "dv": 0.0, "dr": 0.0}
    assert numbers([mechanism.balance], at_rest) == pytest.approx([9.81 * s + 6.0, 9.81 * c, 0])


@pytest.mark.parametrize("one", [lambda e: [e], lambda e: (e,)])
def test_a_direction_with_one_coordinate_is_a_sequence(one):
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, x), actuators={"a": one(2 * x), "b": x**2})
    same(mechanism.E, ca.horzcat(2 * x, 2 * x), q)


def test_forces_by_name_and_by_column():
    q = sv.coordinates("x y")
    x, y = q
    dx, dy = q.d(1)
    S = sv.particle(q, 1.0, (x, y))
    named = sv.Mechanism(q, gibbs=S, forces={"y": -2 * dy})
    column = sv.Mechanism(q, gibbs=S, forces=(0, -2 * dy))
    same(named.balance, ca.vertcat(q.d(2)[0], q.d(2)[1] + 2 * dy), q)
    same(named.balance, column.balance, q)
    with refused(NameUnknown, name="ya") as caught:
        sv.Mechanism(q, gibbs=S, forces={"ya": dx})
    assert caught.value.details["match"] == "y"


def test_forces_on_quasi_velocities_go_by_their_names():
    q = boat()
    S = sv.particle(q, 1.0, tuple(q))
    with refused(NameUnknown, name="psi"):
        sv.Mechanism(q, gibbs=S, forces={"psi": 1.0})


def test_a_balance_from_elsewhere_takes_the_place_of_a_gibbs_function():
    q = sv.coordinates("x theta")
    (x, theta), (ddx, ddtheta) = q, q.d(2)
    given = ca.vertcat(3 * ddx + ddtheta * ca.cos(theta), ddx * ca.cos(theta) + 2 * ddtheta)
    mechanism = sv.Mechanism(q, balance=given, potential=5 * x**2, forces={"theta": -q.d(1)[1]})
    same(mechanism.balance, given + ca.vertcat(10 * x, q.d(1)[1]), q)
    same(ca.vec(mechanism.mass), ca.vertcat(3, ca.cos(theta), ca.cos(theta), 2), q)
    with refused(SpecificationError, "balance", "accelerations"):
        sv.Mechanism(q, balance=ca.vertcat(ddx**3, ddtheta))
    with refused(SpecificationError, "3", "2", what="the balance"):
        sv.Mechanism(q, balance=ca.vertcat(ddx, ddtheta, x))


def test_energy_is_kinetic_plus_potential():
    p = sv.parameters(m=2.0, l=0.7, g=9.81)
    q = sv.coordinates("theta")
    (theta,), (dtheta,) = q, q.d(1)
    S = sv.particle(q, p.m, (p.l * ca.sin(theta), -p.l * ca.cos(theta)))
    U = -p.m * p.g * p.l * ca.cos(theta)
    same(sv.Mechanism(q, gibbs=S, potential=U, parameters=p).energy, p.m * p.l**2 * dtheta**2 / 2 + U, q, p)


def test_a_quadratic_gibbs_function_in_disguise_is_accepted():
    q = sv.coordinates("x y")
    ddx, ddy = q.d(2)
    S = ((ddx + ddy) ** 3 - ddx**3 - 3 * ddx**2 * ddy - 3 * ddx * ddy**2 - ddy**3) + ddx**2 + ddy**2
    same(sv.Mechanism(q, gibbs=S).balance, ca.vertcat(2 * ddx, 2 * ddy), q, rel=1e-10)


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({}, ["inertia", "gibbs", "kinetic", "balance"]),
        ({"potential": "dx"}, ["potential", "order 1"]),
        ({"kinetic": "d2x"}, ["kinetic", "order 2"]),
        ({"gibbs": "d3x"}, ["Gibbs", "order 3"]),
        ({"gibbs": "S", "constraints": {"rail": "d3x"}}, ["rail", "order 3"]),
        ({"gibbs": "S", "actuators": {"rail": "dx"}}, ["order 1"]),
        ({"gibbs": "S", "actuators": {"rail": (1, 0)}}, ["'rail' along dx has 2 entries"]),
        ({"gibbs": "S", "actuators": 3}, ["The actuators are 3"]),
        ({"gibbs": "S", "actuators": {"rail": "t"}}, ["rail", "no coordinate"]),
        ({"gibbs": "S", "actuators": {"x": "x", "x_input": "x"}}, ["'x'", "'x_input'", "actuator"]),
        ({"gibbs": "S", "actuators": {"d2x": "x", "d2x_input": "x"}}, ["'d2x'", "'d2x_input'"]),
        ({"gibbs": "S", "actuators": {"a": "x"}, "outputs": {"a": "x", "a_output": "x"}}, ["'a'", "output"]),
        ({"gibbs": "S", "outputs": {"m": "x"}, "parameters": sv.parameters(m=1.0, m_parameter=1.0)}, ["'m'"]),
        ({"gibbs": "S", "parameters": {"m": 1.0}}, ["dict", "sv.parameters"]),
    ],
)
def test_mechanisms_that_contradict_themselves_are_refused(options, facts):
    q = sv.coordinates("x")
    known = {"x": q.d(0)[0], "t": q.t, "S": sv.particle(q, 1.0, q.d(0)[0])} | {f"d{k}x": q.d(k)[0] for k in (2, 3)}
    known["dx"] = q.d(1)[0]

    def filled(value):
        return {k: filled(v) for k, v in value.items()} if isinstance(value, dict) else known.get(value, value)

    options = {k: v if k == "parameters" else filled(v) for k, v in options.items()}
    with pytest.raises(SpecificationError) as caught:
        sv.Mechanism(q, **options)
    assert [fact for fact in facts if fact not in str(caught.value)] == []


def test_a_mechanism_starts_from_coordinates():
    with refused(SpecificationError, "list"):
        sv.Mechanism(["x"])
