"""More actuators than residuals: the least weighted norm, against numpy's constrained minimum."""

import casadi as ca
import numpy as np
import pytest
from conftest import along, motion, numbers, signal
from refusals import refused

import servoctl as sv
from servoctl import close, computed, lqr, plant, simulate, verify
from servoctl.errors import NameUnknown, NotRealisable, SpecificationError
from servoctl.gallery import overhead_crane
from servoctl.model.model import derive

THRUSTERS = {
    "fore": (0.3, (0.4, 0.1)), "aft": (2.8, (-0.5, 0.2)), "port": (1.5, (0.0, 0.6)), "bow": (-1.2, (0.5, -0.1)),
}  # fmt: skip


def ship(count, keys, weights=None, first_order=(), constraints=None):
    """A planar body with thrusters fixed to it; some of X, Y and heading follow sines."""
    q = sv.coordinates("x y psi")
    (x, y, psi), (dx, _, dpsi) = q, q.d(1)
    turn = ca.vertcat(ca.horzcat(ca.cos(psi), -ca.sin(psi)), ca.horzcat(ca.sin(psi), ca.cos(psi)))
    actuators = {}
    for name, (angle, place) in list(THRUSTERS.items())[:count]:
        force, arm = turn @ ca.SX([np.cos(angle), np.sin(angle)]), turn @ ca.SX(place)
        actuators[name] = ca.vertcat(force, arm[0] * force[1] - arm[1] * force[0])
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.rigid_body(q, 2.0, (0, 0, 0.3), position=(x, y), rates=(0, 0, dpsi)),
        forces={"x": -0.4 * dx, "psi": -0.2 * dpsi * ca.fabs(dpsi)},
        actuators=actuators,
        constraints=constraints(q) if constraints else None,
    )
    targets = {"X": x - ca.sin(q.t), "Y": y - 0.5 * ca.cos(q.t), "heading": psi - 0.3 * ca.sin(2 * q.t)}
    residuals = {key: q.dt(targets[key]) if key in first_order else targets[key] for key in keys}
    return mechanism, sv.Program(residuals, weights=weights)


def constrained_minimum(mechanism, program, z, t, weights):
    """γ'' and the least uᵀWu with φ'' = 0 and material constraints: the KKT system in (γ'', u, λ; μ), by numpy."""
    q, n, m = mechanism.q, mechanism.q.n, len(mechanism.actuators)
    values = dict(zip([name for k in range(3) for name in q.jet_names(k)], z, strict=True)) | {"t": t}
    values |= dict(zip(mechanism.parameters.names, mechanism.parameters.values(), strict=True))
    at_zero = values | dict.fromkeys(q.jet_names(2), 0.0)
    acceleration = ca.vertcat(*q.gamma(2))

    def matrix(e):
        return numbers([ca.vec(ca.densify(e))], values).reshape(e.shape[::-1]).T

    def second(named):
        if not named:
            return np.zeros((0, n)), np.zeros(0)
        e = along(q, ca.vertcat(*(q.dt(e, 2 - max(q.order(e), 0)) for e in named.values())), t)
        return matrix(ca.jacobian(e, acceleration)), numbers([e], at_zero)

    (G, c), (G_m, c_m) = second(program.residuals), second(mechanism.constraints)
    mass, E, rest = matrix(mechanism.mass), matrix(mechanism.E), numbers([mechanism.balance], at_zero)
    k_m = len(G_m)
    A = np.block([[mass, -E, -G_m.T], [G, np.zeros((len(G), m + k_m))], [G_m, np.zeros((k_m, m + k_m))]])
    H = np.zeros((n + m + k_m,) * 2)
    H[n : n + m, n : n + m] = np.diag(weights)
    kkt = np.block([[H, A.T], [A, np.zeros((len(A), len(A)))]])
    solution = np.linalg.solve(kkt, np.concatenate([np.zeros(len(H)), -rest, -c, -c_m]))
    return solution[:n], solution[n : n + m]


def assert_least(mechanism, program, weights, t=0.8, free=None):
    model = derive(mechanism, program)
    z = motion(model, t, **(free or {}))
    found = signal(model, "actuation", t, z)
    w = [(weights or {}).get(name, 1.0) for name in found]
    acceleration, u = constrained_minimum(mechanism, program, z, t, w)
    assert list(found.values()) == pytest.approx(u, rel=1e-12, abs=1e-12 * np.abs(u).max())
    assert z[-3:] == pytest.approx(acceleration, rel=1e-11, abs=1e-11)
    return model


@pytest.mark.parametrize("weights", [None, {"fore": 3.0, "port": 0.2}])
@pytest.mark.parametrize(
    ("count", "keys", "first_order", "free"),
    [
        (3, ("X", "Y"), (), {"psi": 0.5, "dpsi": -0.3}),
        (4, ("X", "Y"), (), {"psi": 0.5, "dpsi": -0.3}),
        (4, ("X", "Y", "heading"), (), {}),
        (4, ("heading",), (), {"x": 0.1, "y": 0.4, "dx": 0.3, "dy": 0.2}),
        (3, ("X", "heading"), ("X",), {"x": 0.1, "y": 0.4, "dy": 0.2}),
        (4, ("X", "Y", "heading"), ("Y", "heading"), {"y": 0.1, "psi": 0.4}),
    ],
)
def test_redundant_actuators_share_by_least_weighted_norm(count, keys, first_order, free, weights):
    model = assert_least(*ship(count, keys, weights, first_order), weights, free=free)
    assert model.free == 2 * (3 - len(keys)) + len(first_order) == len(free)


@pytest.mark.parametrize("weights", [None, {"aft": 5.0}])
def test_redundant_actuators_beside_a_material_constraint(weights):
    def edge(q):
        (_, _, psi), (dx, dy, _) = q, q.d(1)
        return {"edge": dx * ca.sin(psi) - dy * ca.cos(psi)}

    model = assert_least(*ship(3, ("X",), weights, constraints=edge), weights, free={"psi": 0.4, "dpsi": 0.3, "y": 0.1})
    assert model.free == 3


def test_weights_may_be_expressions_of_parameters():
    p = sv.parameters(w=4.0)
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, x), actuators={"a": x, "b": 3 * x}, parameters=p)
    model = derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}, weights={"b": p.w}))
    for w, m in ((4.0, model), (9.0, model.with_parameters(w=9.0))):
        u = signal(m, "actuation", 0.7, motion(m, 0.7))
        assert u["a"] + 3 * u["b"] == pytest.approx(-2 * np.sin(0.7), rel=1e-12)
        assert u["b"] / u["a"] == pytest.approx(3 / w, rel=1e-12)


def test_weights_of_inertia_with_all_coordinates_driven_are_the_ideal_case():
    """W = M⁻¹ with E = 1: u is the ideal reaction."""
    q = sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    S = sv.particle(q, 2.0, x) + sv.particle(q, 5.0, y)
    mechanism = sv.Mechanism(q, gibbs=S, potential=9.81 * y, actuators={"a": (1, 0), "b": (0, 1)})
    speed = {"speed": dx**2 + dy**2 - 25}
    driven = derive(mechanism, sv.Program(speed, weights={"a": 1 / 2, "b": 1 / 5}))
    ideal = derive(mechanism, sv.Program(speed, by="ideal"))
    z = [motion(model, 0.0, x=0.0, y=0.0, dx=3.0, guess={"dy": 4.0}) for model in (driven, ideal)]
    assert z[0] == pytest.approx(z[1], rel=1e-12)
    u, reaction = signal(driven, "actuation", 0.0, z[0]), signal(ideal, "reaction", 0.0, z[1])
    assert list(u.values()) == pytest.approx(list(reaction.values()), rel=1e-12)


def test_redundant_actuators_that_reach_the_program_late():
    """Two cars pull a third through springs: P = ∂φ^(4)/∂u = (k2/m2, k3/m3)/m1, and u = W⁻¹Pᵀμ."""
    q = sv.coordinates("x1 x2 x3")
    x1, x2, x3 = q
    S = sv.particle(q, 1.0, x1) + sv.particle(q, 2.0, x2) + sv.particle(q, 1.5, x3)
    U = (1.0 * (x1 - x2) ** 2 + 3.0 * (x1 - x3) ** 2) / 2
    mechanism = sv.Mechanism(q, gibbs=S, potential=U, actuators={"two": x2, "three": x3})
    model = derive(mechanism, sv.Program({"X": x1 - ca.sin(q.t)}, weights={"three": 4.0}))
    assert model.free == 2 and model.reduction.needs == {"X": 4}
    t = 0.6
    jets = motion(model, t, x2=0.3, dx2=-0.2)
    u, z = signal(model, "actuation", t, jets), dict(zip(model.jet_names, jets, strict=True))
    P = np.array([1.0 / 2.0, 3.0 / 1.5])
    assert u["three"] / u["two"] == pytest.approx(P[1] / 4.0 / P[0], rel=1e-12)
    assert 2.0 * z["d2x2"] + 1.0 * (z["x2"] - z["x1"]) == pytest.approx(u["two"], abs=1e-11)
    assert 1.5 * z["d2x3"] + 3.0 * (z["x3"] - z["x1"]) == pytest.approx(u["three"], abs=1e-11)
    assert (z["x1"], z["d2x1"]) == pytest.approx((np.sin(t), -np.sin(t)), abs=1e-12)
    assert -4.0 * z["d2x1"] + z["d2x2"] + 3.0 * z["d2x3"] == pytest.approx(np.sin(t), abs=1e-11)  # x1 to the fourth


def test_an_actuator_that_reaches_the_program_later_than_another_rests():
    """Cars 1-2-3 in a row, driven at 2 and 3: the fourth derivative of the first holds the force on the second only."""
    q = sv.coordinates("x1 x2 x3")
    x1, x2, x3 = q
    S = sv.particle(q, 1.0, x1) + sv.particle(q, 2.0, x2) + sv.particle(q, 1.5, x3)
    U = (1.0 * (x1 - x2) ** 2 + 3.0 * (x2 - x3) ** 2) / 2
    mechanism = sv.Mechanism(q, gibbs=S, potential=U, actuators={"near": x2, "far": x3})
    model = derive(mechanism, sv.Program({"X": x1 - ca.sin(q.t)}))
    jets = motion(model, 0.6, x3=0.3, dx3=-0.2)
    u = signal(model, "actuation", 0.6, jets)
    assert u["far"] == pytest.approx(0, abs=1e-12) and abs(u["near"]) > 0.1


# as many independent actuators as residuals: E u is determined, and u of least norm ----------------------------------


def doubled_crane(weights=None, **motors):
    """The overhead crane with other motors, by their share in the trolley's and the hoist's force."""
    mechanism, program = overhead_crane()
    x, l, _ = mechanism.q
    actuators = {name: a * x + b * l for name, (a, b) in motors.items()}
    mechanism = sv.Mechanism(
        mechanism.q, balance=mechanism.balance, parameters=mechanism.parameters, actuators=actuators
    )
    return derive(mechanism, sv.Program(program.residuals, weights=weights))


MOTORS = {
    "two on the trolley": {"one": (1, 0), "two": (2, 0), "hoist": (0, 1)},
    "two on each": {"one": (1, 0), "two": (1, 0), "left": (0, 1), "right": (0, 3)},
    "opposed": {"one": (1, 0), "two": (-1, 0), "hoist": (0, 1)},
    "geared": {"one": (1, 0), "two": (1, 1), "three": (1, -1)},
    "five": {"one": (1, 0), "two": (1, 1), "three": (1, -1), "four": (0, 2), "five": (2, 3)},
}


@pytest.mark.parametrize(
    ("name", "weights"),
    [
        ("two on the trolley", None),
        ("opposed", {"one": 4.0}),
        ("two on each", {"one": 0.2, "two": 3.0}),
        ("geared", {"one": 4.0}),
        ("five", {"one": 0.2, "two": 3.0}),
    ],
)
def test_motors_in_dependent_directions_share_by_least_weighted_norm(name, weights, crane_plan):
    """W⁻¹Eᵀ(E W⁻¹Eᵀ)⁻¹ of the single trolley's and hoist's forces."""
    model = doubled_crane(weights, **MOTORS[name])
    run = simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0), t_eval=crane_plan.t)
    E = np.array(list(MOTORS[name].values()), dtype=float).T
    inverse = np.diag([1 / (weights or {}).get(motor, 1.0) for motor in MOTORS[name]])
    forces = np.array([crane_plan["trolley"], crane_plan["hoist"]])
    expected = inverse @ E.T @ np.linalg.solve(E @ inverse @ E.T, forces)
    found = np.array([run[motor] for motor in MOTORS[name]])
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-8 * np.abs(expected).max())
    assert verify(run).passed and model.structure().index == 5


def test_laws_share_between_two_motors_as_the_plan_does():
    model = doubled_crane({"one": 4.0}, **MOTORS["two on the trolley"])
    run = simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0))
    machine = plant(model.reduction.mechanism)
    for law in (lqr(run, machine), computed(run, machine)):
        loop = close(machine, law, run.state(0.0), (0.0, 8.0))
        assert max(np.abs(values[0]).max() for values in loop.residual.values()) < 1e-4
        assert loop["two"] / 8 == pytest.approx(loop["one"], rel=1e-2, abs=0.05)
        assert verify(loop).passed


def test_three_ropes_hold_a_load_in_the_plane():
    """Directions that change with the place, three for two residuals: the pseudoinverse of E."""
    q = sv.coordinates("x y")
    x, y = q
    ends = {"left": (-3.0, 4.0), "middle": (0.0, 5.0), "right": (3.0, 4.0)}
    ropes = {name: -ca.sqrt((x - a) ** 2 + (y - b) ** 2) for name, (a, b) in ends.items()}
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)), potential=2 * 9.81 * y, actuators=ropes)
    model = derive(mechanism, sv.Program({"X": x - ca.sin(q.t), "Y": y - 0.5 * ca.cos(q.t)}, weights={"middle": 2.0}))
    assert model.flat
    for t in (0.0, 0.7, 2.0):
        place = np.array([np.sin(t), 0.5 * np.cos(t)])
        E = np.array([(np.array(end) - place) / np.linalg.norm(np.array(end) - place) for end in ends.values()]).T
        W = np.diag([1.0, 0.5, 1.0])
        force = 2 * (-place + np.array([0.0, 9.81]))
        u = signal(model, "actuation", t, motion(model, t))
        assert list(u.values()) == pytest.approx(W @ E.T @ np.linalg.solve(E @ W @ E.T, force), rel=1e-11)


def test_two_motors_beside_a_guide_leave_its_multiplier_true():
    """One motor pulls along the guide x = y, the other askew: the guide takes what is across, the sum is determined."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)), potential=3.0 * y, constraints={"guide": x - y},
        actuators={"along": (1, 1), "askew": (1, 0)},
    )  # fmt: skip
    model = derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}, weights={"askew": 2.0}))
    t = 0.6
    jets = motion(model, t)
    u, acceleration = signal(model, "actuation", t, jets), -np.sin(t)
    assert 2 * u["along"] + u["askew"] == pytest.approx(4 * acceleration + 3.0)
    assert u["askew"] * 2 / u["along"] == pytest.approx(1 / 2)
    guide = signal(model, "multipliers", t, jets)["multiplier_guide"]
    assert abs(2 * acceleration - u["along"] - u["askew"]) == pytest.approx(abs(guide))


def test_least_forces_on_a_ring_are_tangential_all_the_way_round():
    """u = (F·τ)τ; each entry of the ring's gradient (2x, 2y), by which displacements are divided, vanishes twice."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)), potential=3.0 * y, constraints={"ring": x**2 + y**2 - 1},
        actuators={"right": (1, 0), "up": (0, 1)},
    )  # fmt: skip
    angle = 0.4 + q.t + 0.3 * ca.sin(q.t)
    model = derive(mechanism, sv.Program({"ray": y * ca.cos(angle) - x * ca.sin(angle)}))
    run = simulate(model, model.start(guess={"x": 1.0, "y": 0.4}), (0.0, 2 * np.pi))
    at = 0.4 + run.t + 0.3 * np.sin(run.t)
    along = np.array([-np.sin(at), np.cos(at)])
    force = 2.0 * -0.3 * np.sin(run.t) + 3.0 * np.cos(at)
    assert np.array([run["right"], run["up"]]) == pytest.approx(force * along, abs=1e-9)
    assert run.counters["pivot_changes"] > 1 and verify(run).passed


def standing(legs, weights=None):
    """A planar body on legs of two links, whose feet are held; its place and its pitch follow sines."""
    q = sv.coordinates(" ".join(["x z pitch", *(f"hip{i} knee{i}" for i in range(legs))]))
    x, z, pitch = list(q)[:3]
    p = sv.parameters(**{f"m{i}": 0.6 for i in range(legs)})
    S, U, feet, guess = sv.rigid_body(q, 5.0, (0, 0.3, 0), position=(x, 0, z), rates=(0, q.d(1)[2], 0)), 5.0 * z, {}, {}
    for i in range(legs):
        hip, knee = list(q)[3 + 2 * i :][:2]
        at, place = 0.4 * i - 0.2 * (legs - 1), ca.vertcat(x, z)
        place += at * ca.vertcat(ca.cos(pitch), -ca.sin(pitch))
        for angle, mass in ((pitch + hip, p.symbols[i]), (pitch + hip + knee, 0.3)):
            place -= 0.5 * ca.vertcat(ca.sin(angle), ca.cos(angle))
            S, U = S + sv.particle(q, mass, place), U + mass * place[1]
        feet |= {f"foot{i}_x": place[0] - at, f"foot{i}_z": place[1]}
        guess |= {f"hip{i}": 0.6, f"knee{i}": -1.2}
    wishes = {"X": x - 0.05 * ca.sin(q.t), "Z": z - 0.8 - 0.03 * ca.sin(2 * q.t), "pitch": pitch - 0.1 * ca.sin(q.t)}
    motors = {f"motor_{name}": e for name, e in list(zip(q.names, q, strict=True))[3:]}
    mechanism = sv.Mechanism(q, gibbs=S, potential=9.81 * U, constraints=feet, actuators=motors, parameters=p)
    return mechanism, sv.Program(wishes, weights=weights), guess | {"z": 0.8}


@pytest.mark.parametrize("weights", [None, {"motor_hip0": 4.0, "motor_knee1": 0.3}])
def test_least_torques_of_a_body_on_three_legs(weights):
    mechanism, program, guess = standing(3, weights)
    model = derive(mechanism, program)
    jets = motion(model, 0.8, guess)
    found = signal(model, "actuation", 0.8, jets)
    w = [(weights or {}).get(name, 1.0) for name in found]
    acceleration, u = constrained_minimum(mechanism, program, jets, 0.8, w)
    assert list(found.values()) == pytest.approx(u, rel=1e-11, abs=1e-11 * np.abs(u).max())
    assert jets[-model.n :] == pytest.approx(acceleration, rel=1e-10, abs=1e-11)


def test_the_motion_of_a_body_on_legs_and_its_pivots_are_free_of_masses():
    """Neither displacements that feet allow nor the rows of a flat program contain the inertia."""
    counts = []
    for legs in (2, 4, 8):
        mechanism, program, _ = standing(legs)
        path = derive(mechanism, program).function("path")
        assert path.n_p == legs and not path.expression.sparsity_jac(2, 0).nnz()
        counts.append(path.operations)
    few, some, many = counts
    assert many - some < 2.3 * (some - few)


def test_fewer_independent_actuators_than_residuals_are_refused():
    """Two motors on the trolley and none on the hoist, for X and Z."""
    with refused(NotRealisable, independent=1):
        doubled_crane(one=(1, 0), two=(2, 0))


def test_weights_that_name_no_actuator_show_the_nearest():
    mechanism, program = ship(3, ("X", "Y"))
    with refused(NameUnknown, name="for", match="fore") as caught:
        derive(mechanism, sv.Program(program.residuals, weights={"for": 2.0}))
    assert caught.value.details["match"] == "fore"


@pytest.mark.parametrize("weight", [0.0, -1.0, np.nan, np.inf, "heavy", None, 1j, [1.0, 2.0]])
def test_weights_that_are_not_positive_numbers_are_refused(weight):
    """uᵀWu has a least value for W > 0 only."""
    mechanism, program = ship(3, ("X", "Y"))
    with refused(SpecificationError, name="fore"):
        derive(mechanism, sv.Program(program.residuals, weights={"fore": weight}))
