"""Actuation that a program leaves open: nearest to a wish, also with singular decoupling, and the self-motion with it."""

import pickle

import casadi as ca
import numpy as np
import pytest
from conftest import motion, signal
from refusals import refused
from test_export_c import exported
from test_redundant_actuation import constrained_minimum, ship

import servoctl as sv
from servoctl.errors import NameUnknown, NotRealisable, SpecificationError
from servoctl.gallery import overhead_crane, vtol

JOINTS = ("shoulder", "elbow", "wrist")


def arm(weights=None, toward=None, friction=0.0, gravity=9.81, frame=None, end=(0.8, 1.6), keys="XY"):
    """Three links of 1 kg and 1 m, a motor in each joint; the tip follows a path of 2 s."""
    q = sv.coordinates("a b c")
    if frame is not None:
        q = q.with_quasi_velocities("u v w", frame(q))
    rates = q.d(1)
    S = U = 0
    tip, angle, spin = ca.SX.zeros(2), 0, 0
    for joint, rate in zip(q, rates, strict=True):
        angle, spin = angle + joint, spin + rate
        along = ca.vertcat(ca.cos(angle), ca.sin(angle))
        S += sv.rigid_body(q, 1.0, (0, 0, 1 / 12), position=tip + along / 2, rates=(0, 0, spin))
        U += gravity * (tip + along / 2)[1]
        tip += along
    drag = ca.vertcat(*(-friction * rate for rate in rates))
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=U, forces=q.V.T @ drag, actuators=dict(zip(JOINTS, q, strict=True)),
    )  # fmt: skip
    path = sv.paths.rest_to_rest((1.5, 1.0), end, duration=2.0, smoothness=2)
    r = q.references(X=path[0], Y=path[1])
    residuals = {"X": tip[0] - r.X, "Y": tip[1] - r.Y}
    wishes = toward(q) if toward else None
    return mechanism, sv.Program({key: residuals[key] for key in keys}, weights=weights, toward=wishes)


def damping(q, d=2.0):
    return {name: -d * rate for name, rate in zip(JOINTS, q.d(1), strict=True)}


def posture(q):
    return {"wrist": -8.0 * (list(q)[2] - 0.9) - 3.0 * q.d(1)[2], "elbow": 1.0 + ca.sin(q.t)}


def elbow_up(model, **held):
    return model.start(c=0.8, guess={"a": 0.1, "b": 0.5}, **held)


def wished_numbers(program, mechanism, values):
    """u_wish at a state by name."""
    q = mechanism.q
    symbols = [q.t, *q, *q.gamma(1)]
    wishes = ca.vertcat(*(ca.SX(program.toward.get(name, 0.0)) for name in mechanism.actuators))
    names = ["t", *q.names, *q.jet_names(1)]
    return ca.Function("wish", symbols, [wishes])(*(values[name] for name in names)).full().ravel()


# three motors on two rows ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("toward", [None, damping, posture])
@pytest.mark.parametrize("weights", [None, {"shoulder": 3.0, "wrist": 0.2}])
def test_three_loaded_motors_on_two_rows_have_the_constrained_minimum(weights, toward):
    """(u - u_wish)ᵀW(u - u_wish) least under φ'' = 0: for v = u - u_wish the machine has the further forces E u_wish."""
    mechanism, program = arm(weights, toward)
    model = sv.derive(mechanism, program)
    for t in (0.3, 1.1, 1.9):
        z = motion(model, t, c=0.8, dc=-0.3, guess={"a": 0.1, "b": 0.5})
        values = dict(zip([name for k in range(3) for name in mechanism.q.jet_names(k)], z, strict=True)) | {"t": t}
        wish = wished_numbers(program, mechanism, values)
        shifted = sv.Mechanism(mechanism.q, balance=mechanism.balance - mechanism.E @ wish,
                               actuators=dict(zip(JOINTS, mechanism.q, strict=True)))  # fmt: skip
        w = [(weights or {}).get(name, 1.0) for name in JOINTS]
        acceleration, v = constrained_minimum(shifted, program, z, t, w)
        u = list(signal(model, "actuation", t, z).values())
        assert u == pytest.approx(wish + v, rel=1e-12, abs=1e-12 * np.abs(u).max())
        assert z[-3:] == pytest.approx(acceleration, rel=1e-11, abs=1e-11)


def test_quasi_velocities_do_not_change_the_actuation():
    """Absolute rates of the links, and a frame that turns with the arm."""
    frames = {
        "absolute": lambda q: ca.SX([[1, 0, 0], [-1, 1, 0], [0, -1, 1]]),
        "turning": lambda q: ca.vertcat(
            ca.horzcat(1, 0.3 * ca.sin(list(q)[1]), 0), ca.horzcat(0, 1, 0), ca.horzcat(0.2 * ca.cos(list(q)[0]), 0, 1)
        ),
    }
    t_eval = np.linspace(0.0, 2.5, 26)
    method = sv.methods.Adaptive(rtol=1e-11, atol=1e-12)
    runs = {}
    for name, frame in {"plain": None, **frames}.items():
        model = sv.derive(*arm({"elbow": 2.0}, posture, frame=frame))
        runs[name] = sv.simulate(model, elbow_up(model), (0.0, 2.5), method, t_eval=t_eval)
        assert sv.verify(runs[name]).passed
    for name in frames:
        for joint in JOINTS:
            assert runs[name][joint] == pytest.approx(runs["plain"][joint], abs=1e-6)


@pytest.fixture(scope="module")
def precise():
    """The arm's motion by an integration that is finer than those compared with it."""
    model = sv.derive(*arm({"elbow": 2.0}, posture))
    method, t_eval = sv.methods.Adaptive(rtol=1e-12, atol=1e-13), np.linspace(0.0, 2.5, 11)
    return sv.simulate(model, elbow_up(model), (0.0, 2.5), method, t_eval=t_eval)


@pytest.mark.parametrize(
    "options",
    [
        {"method": "Taylor"}, {"method": "RadauIIA"}, {"method": "RK4", "drift": 0.05},
        {"method": "DOP853", "drift": "project"}, {"method": "LSODA"}, {"accuracy": 1e-6},
    ],
    ids=lambda o: "-".join(map(str, o.values())),
)  # fmt: skip
def test_every_method_integrates_the_same_self_motion(options, precise):
    run = sv.simulate(precise.model, precise.start, (0.0, 2.5), t_eval=precise.t, **options)
    assert run["wrist"] == pytest.approx(precise["wrist"], abs=2e-5) and sv.verify(run).passed


# singular decoupling --------------------------------------------------------------------------------------------------


def two_trolleys(weights=None, toward=None, rope="relative"):
    """The overhead crane with a second trolley s of 20 kg: a motor of the crane's trolley, one between both, one of s.

    The decoupling matrix of X and Z has rank 1. Hidden rows make the trolley's force F determined: motor + between = F.
    """
    mechanism, program = overhead_crane(coordinates=rope)
    old, q = mechanism.q, sv.coordinates(f"{' '.join(mechanism.q.names)} s")
    s = list(q)[-1]
    (ours, theirs), levels = (q.references(**old.family.paths), old.family), range(3)
    known = ca.vertcat(old.t, *old, *old.gamma(1), *old.gamma(2), *(theirs.jet(n, k) for k in levels for n in ours.names))
    new = (x for k in levels for x in (list(q) if k == 0 else q.gamma(k))[: old.n])
    new = ca.vertcat(q.t, *new, *(r for k in levels for r in ours.d(k)))
    constraints = {name: ca.substitute(e, known, new) for name, e in mechanism.constraints.items()}
    machine = sv.Mechanism(
        q, balance=ca.vertcat(ca.substitute(mechanism.balance, known, new), 20.0 * q.d(2)[-1]), constraints=constraints,
        parameters=mechanism.parameters,
        actuators={"motor": list(q)[0], "between": list(q)[0] - s, "hoist": list(q)[1], "cart": s},
    )  # fmt: skip
    residuals = {name: ca.substitute(e, known, new) for name, e in program.residuals.items()}
    return machine, sv.Program(residuals, weights=weights, toward=toward(q) if toward else None)


def share(force, weights, wish):
    """Motor, between and cart of least norm with motor + between = force."""
    w = {name: (weights or {}).get(name, 1.0) for name in ("motor", "between", "cart")}
    wish = {name: wish.get(name, 0.0) for name in w}
    rest = force - wish["motor"] - wish["between"]
    flexibility = 1 / w["motor"] + 1 / w["between"]
    part = {name: wish[name] + rest / w[name] / flexibility for name in ("motor", "between")}
    return part | {"cart": wish["cart"] + 0 * force}


@pytest.mark.parametrize("rope", ["relative", "redundant"])
@pytest.mark.parametrize("weights", [None, {"motor": 4.0}, {"motor": 0.5, "between": 3.0, "cart": 2.0}])
def test_the_choice_follows_hidden_rows_where_the_decoupling_is_singular(weights, rope, crane_plan):
    model = sv.derive(*two_trolleys(weights, lambda q: {"cart": -40.0 * q.d(1)[-1] - 30.0 * list(q)[-1]}, rope),
                      guess={"l": 4.0, "Z": 4.0} if rope == "redundant" else {"l": 4.0})  # fmt: skip
    assert model.free == 2 and len(model.reduction.hidden) == 1
    start = model.start(guess={"l": 4.0, "Z": 4.0} if rope == "redundant" else {"l": 4.0}, s=0.2)
    run = sv.simulate(model, start, (0.0, 6.0), sv.methods.Adaptive(rtol=1e-11, atol=1e-12), t_eval=np.linspace(0.0, 6.0, 61))
    one = sv.simulate(crane_plan.model, crane_plan.model.start(guess={"l": 4.0}), (0.0, 6.0), t_eval=run.t)
    expected = share(one["trolley"], weights, {"cart": -40.0 * run["ds"] - 30.0 * run["s"]})
    for name, values in expected.items():
        assert run[name] == pytest.approx(values, rel=1e-9, abs=1e-7), name
    assert run["hoist"] == pytest.approx(one["hoist"], rel=1e-9)
    assert sv.verify(run).passed


def plant_derivatives(mechanism, program, highest):
    """φ'', ..., φ^(highest) along the plant as a function of (t, x, [u; u'; ...]), and their Jacobian in u, u', ..."""
    q, m = mechanism.q, len(mechanism.actuators)
    inputs = [ca.SX.sym(f"u{j}", m) for j in range(highest - 1)]
    x = ca.vertcat(*q, *q.gamma(1))
    at_zero = ca.substitute(mechanism.balance, q.jet(2), ca.SX.zeros(q.n))
    rate = ca.vertcat(q.V @ q.jet(1), ca.solve(mechanism.mass, mechanism.E @ inputs[0] - at_zero))
    levels = [ca.vertcat(*program.residuals.values())]
    for _ in range(highest):
        known = ca.vertcat(q.t, x, *inputs[:-1])
        levels.append(ca.jtimes(levels[-1], known, ca.vertcat(1, rate, *inputs[1:])))
    rows, symbols = ca.vertcat(*levels[2:]), ca.vertcat(*inputs)
    return ca.Function("rows", [q.t, x, symbols], [rows, ca.jacobian(rows, symbols)])


def least_norm_gap(rows, t, x, u, wish, weights):
    """How far u is from satisfying the rows with some u', u'', ..., and from the least norm among all that do (KKT)."""
    m = len(u)
    inputs = np.concatenate([u, np.zeros(rows.size1_in(2) - m)])
    for _ in range(20):
        values, J = (np.array(part) for part in rows(t, x, inputs))
        inputs[m:] -= np.linalg.lstsq(J[:, m:], values.ravel(), rcond=1e-10)[0]
    values, J = (np.array(part) for part in rows(t, x, inputs))
    gradient = np.concatenate([weights * (u - wish), np.zeros(len(inputs) - m)])
    multipliers = np.linalg.lstsq(J.T, gradient, rcond=1e-10)[0]
    scale = np.maximum(np.abs(J).max(axis=1), 1.0)
    return np.abs(values.ravel() / scale).max(), np.abs(J.T @ multipliers - gradient).max()


def test_the_least_norm_by_the_derivative_array_of_the_plant():
    """A crane with a fan on its trolley's spring-borne mass: of all (u, u', u'') with φ^(4) = 0 the least u at a state.

    Independent of hidden rows: the plant's own derivatives, up to the fourth, and their KKT condition.
    """
    q = sv.coordinates("x l theta s")
    x, l, theta, s = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    S = sv.particle(q, 10.0, x) + sv.particle(q, 5.0, l) + sv.particle(q, 20.0, load) + sv.particle(q, 3.0, s)
    U = -20 * 9.81 * load[1] + 40.0 * (s - x) ** 2
    actuators = {"motor": x, "hoist": l, "fan": s - 0.5 * x, "tilt": s + 0.3 * l}
    mechanism = sv.Mechanism(q, gibbs=S, potential=U, actuators=actuators)
    residuals = {"X": load[0] - 0.3 * ca.sin(q.t), "Z": load[1] - 4 - 0.2 * ca.cos(q.t)}
    weights = {"motor": 3.0, "fan": 0.5}
    program = sv.Program(residuals, weights=weights, toward={"fan": 2.0 - 0.4 * q.d(1)[3], "motor": 0.3 * q.t})
    model = sv.derive(mechanism, program, guess={"l": 4.0})
    assert model.free == 2
    start = model.start(guess={"l": 4.0}, s=0.1, ds=0.2)
    run = sv.simulate(model, start, (0.0, 0.6), t_eval=np.linspace(0.0, 0.6, 13))
    assert sv.verify(run).passed
    rows = plant_derivatives(mechanism, program, 4)
    w = np.array([weights.get(name, 1.0) for name in actuators])
    for k in range(0, 13, 3):
        u = np.array([run[name][k] for name in actuators])
        wish = np.array([0.3 * run.t[k], 0.0, 2.0 - 0.4 * run["ds"][k], 0.0])
        assert max(least_norm_gap(rows, run.t[k], run.jets[:8, k], u, wish, w)) < 1e-8
        other = u + np.array([0.1, 0.0, 0.1, -0.1])  # the condition tells others apart
        assert max(least_norm_gap(rows, run.t[k], run.jets[:8, k], other, wish, w)) > 1e-3


def hovercraft(weights=None, toward=None):
    """Thrust along the heading, a yaw motor against the ground and a reaction wheel, on an ellipse."""
    q = sv.coordinates("x y psi phi")
    x, y, psi, phi = q
    S = sv.rigid_body(q, 3.0, (0, 0, 0.4), position=(x, y), rates=(0, 0, q.d(1)[2]))
    S += sv.rigid_body(q, 1.0, (0, 0, 0.05), position=(x, y), rates=(0, 0, q.d(1)[2] + q.d(1)[3]))
    actuators = {"thrust": (ca.cos(psi), ca.sin(psi), 0, 0), "yaw": psi, "wheel": phi}
    program = {"X": x - 2 * ca.cos(q.t), "Y": y - ca.sin(q.t)}
    return sv.Mechanism(q, gibbs=S, actuators=actuators), sv.Program(program, weights=weights, toward=toward(q))


def test_the_determined_combinations_change_along_a_turn():
    """The heading follows the acceleration all around: X and Y in turn see no thrust, and other rows are chosen.

    Thrust 4 |a|; yaw - wheel = 0.4 ψ'', and least yaw² + 3 (wheel - w)² gives wheel = (3 w - 0.4 ψ'')/4.
    """
    model = sv.derive(*hovercraft({"wheel": 3.0}, lambda q: {"wheel": -0.3 * q.d(1)[3]}), guess={"psi": 3.1, "x": 2.0})
    start = model.start(guess={"psi": 3.14, "dpsi": 0.5, "x": 2.0}, phi=0.1, dphi=2.0)
    run = sv.simulate(model, start, (0.0, 10.0))
    assert sv.verify(run).passed and run["psi"][-1] > 12.0
    a = np.array([-2 * np.cos(run.t), -np.sin(run.t)])
    assert np.cos(run["psi"]) * a[1] - np.sin(run["psi"]) * a[0] == pytest.approx(np.zeros(len(run.t)), abs=1e-7)
    assert run["thrust"] == pytest.approx(4 * np.hypot(*a), rel=1e-7)
    wheel = (-0.9 * run["dphi"] - 0.4 * run["d2psi"]) / 4
    assert run["wheel"] == pytest.approx(wheel, abs=1e-9)
    assert run["yaw"] == pytest.approx(wheel + 0.4 * run["d2psi"], abs=1e-9)
    assert model.structure(run).zeros_at_infinity == (2, 4)
    machine = sv.plant(model.reduction.mechanism)
    for law in (sv.lqr(run, machine, rate=200.0), sv.feedforward(run, machine)):
        loop = sv.close(machine, law, run.state(0.0), (0.0, 10.0))
        assert max(np.abs(values[0]).max() for values in loop.residual.values()) < 1e-3


def test_exact_linearisation_extends_and_shares():
    """Before the turn ends: orders 4 and 4 by an integrator of the thrust, the wheel shares as in the plan."""
    model = sv.derive(*hovercraft({"wheel": 3.0}, lambda q: {"wheel": -0.3 * q.d(1)[3]}), guess={"psi": 3.1, "x": 2.0})
    start = model.start(0.3, guess={"psi": 3.3, "dpsi": 0.5, "x": 2.0})
    run = sv.simulate(model, start, (0.3, 1.2))
    machine = sv.plant(model.reduction.mechanism)
    law = sv.computed(run, machine, rate=200.0)
    assert sorted(law.info["orders"].values()) == [4, 4]
    loop = sv.close(machine, law, run.state(0.3), (0.3, 1.2))
    assert max(np.abs(values[0]).max() for values in loop.residual.values()) < 1e-4
    assert np.abs(np.interp(loop.t, run.t, run["wheel"]) - loop["wheel"]).max() < 0.02


def single():
    """The same vehicle without a wheel: as many inputs as residuals."""
    q = sv.coordinates("x y psi")
    x, y, psi = q
    S = sv.rigid_body(q, 4.0, (0, 0, 0.45), position=(x, y), rates=(0, 0, q.d(1)[2]))
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"thrust": (ca.cos(psi), ca.sin(psi), 0), "yaw": psi})
    return mechanism, sv.Program({"X": x - 2 * ca.cos(q.t), "Y": y - ca.sin(q.t)})


@pytest.mark.parametrize(
    ("machine", "span"), [("single", (0.0, 7.0)), ("wheel", (0.0, 3.0)), ("weights", (1.0, 9.0))]
)
def test_exact_linearisation_goes_round_a_full_turn(machine, span):
    """Neither X nor Y sees the thrust all the way round: the thrust gets the integrators, from the plan's values on."""
    if machine == "single":
        mechanism, program = single()
    else:
        weights = {"wheel": 3.0} if machine == "wheel" else {"yaw": 0.2}
        mechanism, program = hovercraft(weights, lambda q: {"wheel": -0.3 * q.d(1)[3]})
    heading = np.arctan2(-np.sin(span[0]), -2 * np.cos(span[0])) % (2 * np.pi)
    guess = {"psi": heading, "dpsi": 0.5, "x": 2 * np.cos(span[0])}
    model = sv.derive(mechanism, program, guess={"psi": 3.1, "x": 2.0})
    run = sv.simulate(model, model.start(span[0], guess=guess), span)
    plant = sv.plant(mechanism)
    law = sv.computed(run, plant, rate=200.0)
    assert law.info["orders"] == {"X": 4, "Y": 4}
    a, jerk = 4 * np.array([-2 * np.cos(span[0]), -np.sin(span[0])]), 4 * np.array([2 * np.sin(span[0]), -np.cos(span[0])])
    assert law.state == pytest.approx([np.hypot(*a), a @ jerk / np.hypot(*a)], abs=1e-6)
    loop = sv.close(plant, law, run.state(span[0]), span)
    assert max(np.abs(values[0]).max() for values in loop.residual.values()) < 1e-3
    for name in plant.inputs:
        assert np.abs(np.interp(loop.t, run.t, run[name]) - loop[name])[:-1].max() < 0.02 * np.abs(run["thrust"]).max()
    beside = run.state(span[0]).copy()
    beside[0] += 0.02
    errors = sv.close(plant, law, beside, span).residual
    assert max(np.abs(values[0][-200:]).max() for values in errors.values()) < 2e-3


def test_two_forces_normal_to_the_body_are_flat_after_extension():
    """Without tilt and lift of the thrusters: X and Z see the sum of the thrusts alone, along the body's normal."""
    mechanism, program = vtol("centre")
    model = sv.derive(mechanism, program).with_parameters(tilt=0.0, h=0.0)
    structure = model.structure()
    assert model.flat and structure.decoupling_rank == 1 and structure.realisation == "mixed"
    assert structure.zeros_at_infinity == (2, 4) and structure.essential_orders == (4, 4) and structure.index == 5
    assert "no vector relative degree" in repr(structure) and "flat" in repr(model)
    run = sv.simulate(model, model.start(guess={"theta": 0.0}), (0.0, 4.0))
    assert sv.verify(run).passed
    told = repr(sv.report(run))
    assert told.startswith("Report: flat") and "index 5; mixed realisation" in told
    # tanθ = -X''/(Z'' + g), u1 + u2 = M |(X'', Z'' + g)|
    assert np.tan(run["theta"]) == pytest.approx(-run["d2x"] / (run["d2z"] + 9.81), abs=1e-9)
    assert run["u1"] + run["u2"] == pytest.approx(50.0 * np.hypot(run["d2x"], run["d2z"] + 9.81), rel=1e-9)
    machine = sv.plant(mechanism, tilt=0.0, h=0.0)
    law = sv.computed(run, machine, rate=200.0)
    assert law.info["orders"] == {"X": 4, "Z": 4} or sorted(law.info["orders"].values()) == [4, 4]
    loop = sv.close(machine, law, run.state(0.0), (0.0, 4.0))
    assert max(np.abs(values[0]).max() for values in loop.residual.values()) < 1e-3


def test_a_third_force_normal_to_the_body_shares_and_leaves_no_self_motion():
    mechanism, program = vtol("centre")
    x, z, theta = mechanism.q
    p = mechanism.parameters
    along = ca.vertcat(-ca.sin(theta), ca.cos(theta))
    actuators = {name: ca.vertcat(along, lever) for name, lever in (("left", 1.0), ("right", -1.0), ("middle", 0.2))}
    three = sv.Mechanism(mechanism.q, balance=mechanism.balance, parameters=p, actuators=actuators)
    model = sv.derive(three, sv.Program(program.residuals, weights={"middle": 2.0}, toward={"middle": 100.0}))
    assert model.flat and "no self-motion" in repr(model)
    run = sv.simulate(model, model.start(), (0.0, 4.0))
    thrust, moment = 50.0 * np.hypot(run["d2x"], run["d2z"] + 9.81), 25.0 * run["d2theta"]
    E, inverse, wish = np.array([[1, 1, 1], [1, -1, 0.2]]), np.diag([1, 1, 0.5]), np.array([[0.0], [0.0], [100.0]])
    short = np.array([thrust, moment]) - E @ wish
    u = wish + inverse @ E.T @ np.linalg.solve(E @ inverse @ E.T, short)
    assert np.array([run[name] for name in actuators]) == pytest.approx(u, rel=1e-8, abs=1e-6)
    assert sv.verify(run).passed


def test_rows_that_no_actuator_moves_stay_refused():
    """Redundant motors on one cart, and a program of a free one."""
    q = sv.coordinates("x y s")
    x, y, s = q
    S = sv.particle(q, 1.0, x) + sv.particle(q, 1.0, y) + sv.particle(q, 1.0, s)
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"a": x, "b": y})
    with refused(NotRealisable, rows=["S", "balance of s"]):
        sv.derive(mechanism, sv.Program({"S": s - ca.sin(q.t)}))


def test_a_rank_that_falls_along_the_motion_ends_it():
    """The arm is pulled straight: beyond 3 m there is no actuation, and none is handed out."""
    model = sv.derive(*arm(None, damping, end=(2.6, 1.9)))
    with pytest.raises(sv.errors.ServoError) as caught:
        sv.simulate(model, elbow_up(model), (0.0, 3.0))
    assert caught.value.run is not None and 0.3 < caught.value.run.t[-1] < 2.0
    reach = np.hypot(1.5 + 1.1, 1.0 + 0.9)
    assert reach > 3.0


# self-motion ----------------------------------------------------------------------------------------------------------


def test_self_motion_is_told_and_whether_it_is_damped():
    told = {
        "undamped": arm(), "undamped at rest": arm(friction=0.0, toward=lambda q: {"wrist": -9.0 * list(q)[2]}),
        "decays": arm(friction=0.5), "decays with": arm(toward=damping),
    }  # fmt: skip
    for text, specification in told.items():
        model = sv.derive(*specification)
        assert "3 actuators for 2 residuals" in repr(model) and "self-motion of 1 velocity" in repr(model)
        assert text in repr(model)
        assert all(len(line) <= 118 for line in repr(model).splitlines())
    two = sv.derive(*arm(keys="X"))
    assert "self-motion of 2 velocities" in repr(two)


def test_the_rate_of_a_self_motion_is_that_of_its_linearisation():
    """A point mass of 2 kg in the plane, X prescribed, with one motor on each axis and one askew, drag 3 N s/m on y."""
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    actuators = {"a": (1, 0), "b": (0, 1), "c": (1, 1)}
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)), forces=(0, -3.0 * dy), actuators=actuators)
    model = sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}, toward={"b": -1.0 * dy}))
    # u = wish + Pᵀμ with P = [1, 0, 1]: 2 y'' + 3 y' = -y' + μ, μ = x''·2/2
    assert "4 N" not in repr(model) and f"at least {4 / 2:.3g} 1/s" in repr(model)
    run = sv.simulate(model, model.start(y=0.0, dy=1.0), (0.0, 4.0))
    other = sv.simulate(model, model.start(y=0.0, dy=0.0), (0.0, 4.0), t_eval=run.t)
    assert run["dy"] - other["dy"] == pytest.approx(np.exp(-2.0 * run.t), abs=1e-7)


@pytest.mark.parametrize(("d", "damped"), [(1e-6, True), (1e-8, True), (1e-10, False), (0.0, False)])
def test_damped_self_motion_decays_above_1e_9_of_its_fastest_rate(d, damped):
    q = sv.coordinates("x y z")
    x, y, z = q
    _, dy, dz = q.d(1)
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 1.0, ca.vertcat(x, y, z)), forces=(0, -dy, -d * dz), actuators={"a": x, "b": y, "c": z}
    )
    text = repr(sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)})))
    assert ("undamped" not in text) == damped and "2 velocities" in text


def test_a_wish_that_damps_makes_the_run_stable():
    """The free arm keeps what it has; with the wish the same error of 0.1 rad/s dies out."""
    ends = {}
    for name, toward in (("open", None), ("damped", lambda q: damping(q, 6.0))):
        model = sv.derive(*arm(toward=toward, gravity=0.0))
        run = sv.simulate(model, elbow_up(model), (0.0, 6.0))
        ends[name] = sv.internal_dynamics(run)
    assert ends["damped"].verdict in ("stable", "neutral") and ends["damped"].left < ends["open"].left


# what follows a program -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reaching():
    model = sv.derive(*arm({"elbow": 2.0}, posture, friction=0.5))
    return sv.simulate(model, elbow_up(model), (0.0, 3.0))


@pytest.mark.parametrize("law", [sv.lqr, sv.computed])
def test_laws_follow_a_plan_with_wishes(reaching, law):
    machine = sv.plant(reaching.model.reduction.mechanism)
    loop = sv.close(machine, law(reaching, machine, rate=500.0), reaching.state(0.0), (0.0, 3.0))
    assert max(np.abs(values[0]).max() for values in loop.residual.values()) < 1e-4
    for name in JOINTS:
        inside = np.interp(loop.t, reaching.t, reaching[name])
        assert np.abs(loop[name] - inside)[5:].max() < 0.02 * np.abs(inside).max()
    assert sv.verify(loop).passed


def test_a_computed_law_shares_as_the_wish_says_beside_the_plan():
    """From 0.05 rad beside the plan W(u - u_wish(measured)) is normal to M ker G: to what moves no residual."""
    weights = {"elbow": 2.0}
    mechanism, program = arm(weights, posture, friction=0.5)
    q, model = mechanism.q, sv.derive(mechanism, program)
    plan = sv.simulate(model, elbow_up(model), (0.0, 3.0))
    machine = sv.plant(mechanism)
    x0 = np.array([plan.state(0.0)[i] + 0.05 * (i == 2) for i in range(6)])
    loop = sv.close(machine, sv.computed(plan, machine, rate=1000.0), x0, (0.0, 0.5))
    gradients = ca.jacobian(ca.vertcat(*program.residuals.values()), q.jet(0))
    matrices = ca.Function("matrices", [q.t, *q], [mechanism.mass, gradients])
    sizes, gaps = [], []
    for k in (0, 50, 200):
        now = {name: float(loop[name][k]) for name in (*q.names, *q.jet_names(1))} | {"t": float(loop.t[k])}
        M, G = (np.array(part) for part in matrices(now["t"], *(now[name] for name in q.names)))
        open_ = M @ np.linalg.svd(G)[2][-1]
        u = np.array([loop[name][k] for name in JOINTS])
        wish = wished_numbers(program, mechanism, now)
        gaps.append(abs(open_ @ (np.array([1.0, 2.0, 1.0]) * (u - wish))))
        sizes.append(np.linalg.norm(open_) * np.linalg.norm(u))
    assert max(gaps) < 2e-3 * min(sizes)


def test_feedforward_sweeps_and_files_know_wishes(reaching, tmp_path):
    model = reaching.model
    sv.feedforward(reaching, sv.plant(model.reduction.mechanism))
    copy = pickle.loads(pickle.dumps(model))
    again = sv.simulate(copy, elbow_up(copy), (0.0, 3.0), t_eval=reaching.t)
    assert again["wrist"] == pytest.approx(reaching["wrist"], rel=1e-12, abs=1e-12)
    reaching.save(tmp_path / "run.npz")
    loaded = sv.load(tmp_path / "run.npz", model=model)
    assert sv.verify(loaded).passed


def test_the_exported_feedforward_has_the_wish(reaching, tmp_path, c_compiler):
    model = reaching.model
    plan = exported(model, tmp_path, start=elbow_up(model))
    p, z, u = model.parameters, np.empty(len(model.jet_names)), np.empty(3)
    for k in (0, 400, 1000):
        plan("feedforward", reaching.t[k], reaching.jets[: len(model.state_names), k].copy(), p, z, u)
        assert u == pytest.approx([reaching[name][k] for name in JOINTS], rel=1e-9, abs=1e-9)


def test_wishes_hold_parameters_that_change():
    p = sv.parameters(w=4.0, d=2.0)
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 2.0, ca.vertcat(x, y)), actuators={"a": x, "b": y, "c": (1, 1)}, parameters=p
    )
    model = sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}, weights={"c": p.w}, toward={"b": -p.d * dy}))
    for numbers, m in (((4.0, 2.0), model), ((1.0, 5.0), model.with_parameters(w=1.0, d=5.0))):
        w, d = numbers
        u = signal(m, "actuation", 0.7, motion(m, 0.7, y=0.2, dy=0.3))
        force = -2 * np.sin(0.7)  # P = [1, 0, 1]: a = μ, c = μ/w
        assert u["a"] + u["c"] == pytest.approx(force) and u["c"] == pytest.approx(u["a"] / w)
        assert u["b"] == pytest.approx(-d * 0.3)


def test_parameters_that_make_the_decoupling_singular_and_back():
    """A mass on an inclined guide of a driven car, a second car beside: level, the relative degree is 4, else 2."""

    def cars(alpha):
        p = sv.parameters(alpha=alpha)
        q = sv.coordinates("x s c")
        x, s, c = q
        mass = ca.vertcat(x + s * ca.cos(p.alpha), s * ca.sin(p.alpha))
        S = sv.particle(q, 1.0, x) + sv.particle(q, 2.0, mass) + sv.particle(q, 1.5, c)
        U = 5 * s**2 / 2 + 3 * (c - x) ** 2 / 2
        actuators = {"F": x, "G": c, "H": x - 0.5 * c}
        mechanism = sv.Mechanism(q, gibbs=S, potential=U, actuators=actuators, parameters=p)
        return mechanism, sv.Program({"Z": mass[0] - ca.sin(q.t)}, toward={"G": -0.4 * q.d(1)[2]})

    for first, then, free in ((0.0, 0.8, 4), (0.8, 0.0, 2)):
        changed, fresh = sv.derive(*cars(first)).with_parameters(alpha=then), sv.derive(*cars(then))
        start = {"c": 0.2, "dc": 0.1} | ({"s": 0.1, "ds": 0.05} if free == 4 else {})
        runs = [sv.simulate(m, m.start(**start), (0.0, 2.0), t_eval=np.linspace(0, 2, 21)) for m in (changed, fresh)]
        assert changed.free == fresh.free == free and sv.verify(runs[0]).passed
        for name in "FGH":
            assert runs[0][name] == pytest.approx(runs[1][name], rel=1e-9, abs=1e-9)


def test_slower_programs_slow_the_time_of_wishes_alone():
    q = sv.coordinates("x")
    (x,), (dx,) = q, q.d(1)
    program = sv.Program({"X": x - q.t}, toward={"push": ca.sin(q.t) - 3.0 * dx, "pull": 2.0})
    slower = program.slowed(q, 2.0, at=1.0)
    at = ca.Function("at", [q.t, dx], [slower.toward["push"]])
    assert float(at(3.0, 0.5)) == pytest.approx(np.sin(2.0) - 1.5) and float(ca.SX(slower.toward["pull"])) == 2.0


def test_a_switch_in_a_wish_is_located():
    """A brake that acts on one side alone: the motion is that of the two halves."""
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, ca.vertcat(x, y)), actuators={"a": x, "b": y})
    wish = {"b": ca.if_else(y > 0.5, -2.0 * dy, 0.0)}
    model = sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}, toward=wish))
    run = sv.simulate(model, model.start(y=0.0, dy=1.0), (0.0, 2.0))
    later = np.maximum(run.t - 0.5, 0.0)
    assert run["dy"] == pytest.approx(np.exp(-2.0 * later), abs=1e-7)
    assert run["y"] == pytest.approx(np.minimum(run.t, 0.5) + (1 - np.exp(-2.0 * later)) / 2, abs=1e-7)


def test_two_motors_on_one_trolley_have_the_sum_of_one(crane_plan):
    mechanism, program = overhead_crane()
    x, l, _ = mechanism.q
    double = sv.Mechanism(mechanism.q, balance=mechanism.balance, parameters=mechanism.parameters,
                          actuators={"one": x, "two": x, "hoist": l})  # fmt: skip
    toward = {"one": 20.0 * ca.sin(mechanism.q.t)}
    for weights, wish in ((None, None), ({"one": 3.0}, None), ({"one": 3.0}, toward)):
        model = sv.derive(double, sv.Program(program.residuals, weights=weights, toward=wish))
        run = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0), t_eval=crane_plan.t)
        size = np.abs(crane_plan["trolley"]).max()
        assert np.abs(run["one"] + run["two"] - crane_plan["trolley"]).max() < 1e-10 * size
        wanted = 20.0 * np.sin(run.t) if wish else 0.0
        heavy = 3.0 if weights else 1.0
        assert heavy * (run["one"] - wanted) == pytest.approx(run["two"], abs=1e-9 * size)


# bad input ------------------------------------------------------------------------------------------------------------


def test_wishes_of_unknown_actuators_show_the_nearest():
    mechanism, program = ship(3, ("X", "Y"))
    with refused(NameUnknown, name="foer", match="fore"):
        sv.derive(mechanism, sv.Program(program.residuals, toward={"foer": 1.0}))


@pytest.mark.parametrize("wish", [np.nan, np.inf, "much", None, 1j, [1.0, 2.0], True])
def test_wishes_that_are_no_actuation_are_refused(wish):
    _, program = ship(3, ("X", "Y"))
    with refused(SpecificationError, name="fore"):
        sv.Program(program.residuals, toward={"fore": wish})


def test_wishes_of_accelerations_are_refused():
    mechanism, program = ship(3, ("X", "Y"))
    with refused(SpecificationError, what="The wish of 'fore'", order=2):
        sv.derive(mechanism, sv.Program(program.residuals, toward={"fore": mechanism.q.d(2)[0]}))


def test_wishes_where_nothing_is_open_are_refused():
    mechanism, program = ship(3, ("X", "Y", "heading"))
    with refused(SpecificationError, wishes=["fore"]):
        sv.derive(mechanism, sv.Program(program.residuals, toward={"fore": 1.0}))
    with refused(SpecificationError, "by='ideal'", options=["toward"]):
        sv.Program(program.residuals, by="ideal", toward={"fore": 1.0})


def test_wishes_with_unknown_symbols_are_refused():
    mechanism, program = ship(3, ("X", "Y"))
    with refused(SpecificationError, "stray"):
        sv.derive(mechanism, sv.Program(program.residuals, toward={"fore": ca.SX.sym("stray")}))


@pytest.mark.parametrize(("weights", "norm"), [(None, "norm"), ("inertia", "weighted norm"), ({"shoulder": 2.0}, "weighted norm")])
def test_a_model_names_the_norm_that_is_least(weights, norm):
    assert f": of least {norm};" in repr(sv.derive(*arm(weights)))
