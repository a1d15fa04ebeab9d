"""Coordinates that play no part in a program are left out: the same bits, operations and verdicts as without them."""

import pickle

import casadi as ca
import numpy as np
import pytest
from refusals import refused, warned

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.model.model import including
from servoctl.reduction.idle import needed

SPAN = (0.0, 8.0)


def crane(count=0, upright=False, motors=False, outputs=None, coupling=0.0):
    """The overhead crane beside pendulums, of masses of their own, hanging or upright."""
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81, **{f"m{i}": 1 + i / 10 for i in range(count)})
    q = sv.coordinates(" ".join(["x l theta", *(f"phi{i}" for i in range(count))]))
    x, l, theta, *others = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    S = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load)
    U = -p.m_load * p.g * load[1]
    side = -1 if upright else 1
    for m, phi in zip(p.symbols[4:], others, strict=True):
        S += sv.particle(q, m, ca.vertcat(ca.sin(phi), side * ca.cos(phi)))
        U -= m * p.g * side * ca.cos(phi)
    U += coupling * sum((phi - theta) ** 2 for phi in others) / 2
    path = sv.paths.rest_to_rest(start=(0.0, 4.0), end=(5.0, 2.0), duration=6.0, smoothness=4)
    r = q.references(X=path[0], Z=path[1])
    actuators = {"trolley": x, "hoist": l} | ({f"motor{i}": phi for i, phi in enumerate(others)} if motors else {})
    reported = {name: others[int(name[-1])] for name in outputs or ()}
    mechanism = sv.Mechanism(q, gibbs=S, potential=U, actuators=actuators, parameters=p, outputs=reported)
    return mechanism, sv.Program({"X": load[0] - r.X, "Z": load[1] - r.Z})


def planned(model):
    return sv.simulate(model, model.start(guess={"l": 4.0}), SPAN)


@pytest.fixture(scope="module")
def alone():
    mechanism, program = crane()
    model = sv.derive(mechanism, program)
    return mechanism, model, planned(model)


@pytest.fixture(scope="module")
def beside():
    """The crane beside an upright pendulum."""
    mechanism, program = crane(1, upright=True)
    model = sv.derive(mechanism, program)
    return mechanism, model, planned(model)


def test_a_crane_beside_200_pendulums_is_the_crane(alone):
    model = sv.derive(*crane(200))
    run, (_, model_alone, run_alone) = planned(model), alone
    assert len(model.reduction.left_out) == 200 and "200 coordinates" in repr(model)
    assert run.jet_names == run_alone.jet_names and np.array_equal(run.jets, run_alone.jets)
    for name in ("trolley", "hoist", "energy"):
        assert np.array_equal(run[name], run_alone[name])
    assert all(np.array_equal(run.residual[name], run_alone.residual[name]) for name in run_alone.residual)
    assert model.function("path").operations == model_alone.function("path").operations
    assert repr(model).splitlines()[2:] == repr(model_alone).splitlines()[1:]


def test_laws_and_loops_do_without_an_upright_pendulum(alone, beside):
    """Both the design for the whole machine and the loop about it; the loop from a whole state has all of it."""
    (machine, _, plan), (machine_alone, _, plan_alone) = (beside, alone)
    push = {"theta": 20.0}
    for design in (sv.lqr, sv.computed, sv.feedforward):
        law, law_alone = design(plan, sv.plant(machine), 100.0), design(plan_alone, sv.plant(machine_alone), 100.0)
        heavy, heavy_alone = (sv.plant(m, m_load=115.0) for m in (machine, machine_alone))
        loop = sv.close(heavy, law, plan.state(0.0), SPAN, disturbance=push)
        loop_alone = sv.close(heavy_alone, law_alone, plan_alone.state(0.0), SPAN, disturbance=push)
        assert law.measures == law_alone.measures and np.array_equal(loop.states, loop_alone.states)
    start = dict(zip(loop.plant.state_names, plan.state(0.0), strict=True)) | {"phi0": 0.1, "dphi0": 0.0}
    law = sv.lqr(plan, sv.plant(machine), 100.0)
    whole = sv.close(sv.plant(machine), law, start, SPAN)
    assert np.ptp(whole["phi0"]) > 1.0, "it falls"
    assert np.abs(whole["theta"] - sv.close(sv.plant(machine), law, plan.state(0.0), SPAN)["theta"]).max() < 1e-12


def test_inverses_and_reports_have_the_verdicts_of_the_crane(alone, beside):
    assert sv.report(beside[1]).verdict == sv.report(alone[1]).verdict == "flat"
    run = sv.inverse(beside[0], beside[1].reduction.program, (0.0, 1.0), start={"l": 4.0})
    assert run.jet_names == alone[2].jet_names and "as the program is flat" in run.message
    assert sv.verify(beside[2], segments=1).passed


def test_two_of_twenty_pendulums_are_a_flat_plan():
    q = sv.coordinates(" ".join(f"a{i}" for i in range(20)))
    S = sum(sv.particle(q, 1.0, ca.vertcat(ca.sin(a), ca.cos(a))) for a in q)
    mechanism = sv.Mechanism(
        q, gibbs=S / 2, potential=-9.81 * sum(map(ca.cos, q)), actuators={"m0": q.d(0)[0], "m1": q.d(0)[1]}
    )
    path = sv.paths.rest_to_rest((0.0, 0.0), (1.0, 2.0), duration=2.0, smoothness=4)
    r = q.references(A=path[0], B=path[1])
    program = sv.Program({"A": q.d(0)[0] - r.A, "B": q.d(0)[1] - r.B})
    model = sv.derive(mechanism, program)
    assert model.flat and model.reduction.mechanism.q.names == ("a0", "a1") and len(model.reduction.left_out) == 18
    run = sv.simulate(model, model.start(), (0.0, 2.0))
    assert np.abs(run["m0"] - (run["d2a0"] / 2 + 9.81 * np.sin(run["a0"]))).max() < 1e-12
    assert sv.derive(mechanism, program, keep=q.names).free == 36


def test_all_of_a_chain_plays_a_part():
    q = sv.coordinates(" ".join(f"x{i}" for i in range(20)))
    x = list(q)
    springs = sum((b - a) ** 2 for a, b in zip(x, x[1:], strict=False))
    mechanism = sv.Mechanism(q, gibbs=sum(sv.particle(q, 1.0, e) for e in x), potential=springs, actuators={"f": x[0]})
    assert needed(mechanism, sv.Program({"X": x[0] - ca.sin(q.t)})) is mechanism


@pytest.mark.parametrize("name", gallery)
def test_all_of_a_scene_of_the_gallery_plays_a_part(name):
    mechanism, program = gallery[name].build()
    assert needed(mechanism, program) is mechanism


WHOLE = {
    "an actuator": (crane(2, motors=True), {}),
    "an output": (crane(2, outputs=("end0", "end1")), {}),
    "a spring": (crane(2, coupling=5.0), {}),
    "kept": (crane(2), {"keep": ["phi0", "phi1"]}),
    "guessed": (crane(2), {"guess": {"phi0": 0.1, "dphi1": 0.2}}),
}


@pytest.mark.parametrize("what", WHOLE)
def test_what_is_driven_reported_coupled_or_named_is_not_left_out(what):
    (mechanism, program), options = WHOLE[what]
    assert sv.derive(mechanism, program, **options).reduction.left_out == ()


def test_one_of_two_is_restored_by_name():
    mechanism, program = crane(2, outputs=("end1",))
    assert sv.derive(mechanism, program).reduction.left_out == ("phi0",)
    assert sv.derive(*crane(2), keep="phi0").reduction.left_out == ("phi1",)


ABSENT = {
    "signal": lambda m, run: run["phi0"],
    "derivative": lambda m, run: run["d2phi0"],
    "start of a copy": lambda m, run: pickle.loads(pickle.dumps(run.model)).start(phi0=0.1),
    "condition": lambda m, run: run.model.start(hold={"c": m.q.d(0)[3] - 0.1}),
    "disturbance": lambda m, run: sv.close(
        sv.plant(m), sv.lqr(run, sv.plant(m)), run.state(0.0), SPAN, disturbance={"phi0": 1.0}
    ),
}


@pytest.mark.parametrize("what", ABSENT)
def test_an_absent_name_says_how_to_include_it(beside, what):
    mechanism, _, run = beside
    with refused(sv.errors.NameUnknown, "keep=['phi0']", left_out="phi0"):
        ABSENT[what](mechanism, run)


def test_a_start_that_names_a_coordinate_includes_it(beside):
    """The pendulum swings beside the same plan of the crane, and all that takes the model takes the motion."""
    _, model, run = beside
    start = model.start(guess={"l": 4.0}, phi0=0.1)
    with warned("unstable"):
        swung = sv.simulate(model, start, (0.0, 2.0))
    assert swung.model.reduction.left_out == () and swung["phi0"][-1] > 0.5
    assert swung["hoist"] == pytest.approx(np.interp(swung.t, run.t, run["hoist"]), abs=1e-2)
    assert sv.internal_dynamics(swung).verdict == "unstable" and sv.verify(swung).passed
    assert sv.report(swung).verdict.startswith("non-minimum phase")
    assert model.structure(swung).index == model.structure(run).index
    assert np.any([*sv.sensitivity(swung, to=["phi0"], of=["d2phi0"]).values.values()])
    many = sv.simulate_many(model, {"l": 4.0, "phi0": [0.1, 0.2]}, None, (0.0, 0.5))
    assert many["final phi0"].min() > 0.1
    assert including(including(model, ["phi0"]), ["phi0"]).reduction.left_out == () and model.reduction.left_out == ("phi0",)


def test_keep_names_coordinates():
    with refused(sv.errors.NameUnknown, name="phy0", match="phi0"):
        sv.derive(*crane(1), keep=["phy0"])


def test_a_model_without_a_pendulum_pickles(beside):
    _, model, run = beside
    copy = pickle.loads(pickle.dumps(model))
    assert copy == model and copy.reduction.left_out == ("phi0",) and np.array_equal(planned(copy).jets, run.jets)


def test_other_formulations_are_parted_alike():
    """Kinetic energy, a balance, quasi-velocities, and idle pendulums in redundant coordinates."""
    q = sv.coordinates("x y X Z")
    x, y, X, Z = q
    dx, dy, dX, dZ = q.d(1)
    T = (2 * dx**2 + 3 * dy**2 + dX**2 + dZ**2) / 2
    r = ca.vertcat(*(m * a for m, a in zip((2, 3, 1, 1), q.d(2), strict=True))) + ca.vertcat(4 * x, y, 0, -9.81)
    w = q.with_quasi_velocities("u v s r", ca.diagcat(ca.SX([[1, 0.5], [0, 1]]), ca.SX([[0, 1], [1, 0]])))
    rod, push = {"rod": X**2 + Z**2 - 1}, {"push": x}
    S = (2 * q.d(2)[0] ** 2 + 3 * q.d(2)[1] ** 2) / 2 + sv.particle(q, 1.0, (X, Z))
    program = sv.Program({"X": x - ca.sin(q.t)})
    for mechanism in (
        sv.Mechanism(q, kinetic=T, potential=2 * x**2 + y**2 / 2 - 9.81 * Z, actuators=push, constraints=rod),
        sv.Mechanism(q, S, 2 * x**2 + y**2 / 2 - 9.81 * Z, push, constraints=rod),
        sv.Mechanism(q, balance=r, actuators=push, constraints=rod),
    ):
        model = sv.derive(mechanism, program)
        assert model.reduction.left_out == ("y", "X", "Z") and model.flat
        run = sv.simulate(model, model.start(), (0.0, 1.0))
        assert np.abs(run["push"] - 2 * np.sin(run.t)).max() < 1e-12
    rates = w.d(1)
    coupled = sv.Mechanism(w, kinetic=sum(m * rate**2 for m, rate in zip((2, 3, 1, 1), rates, strict=True)) / 2,
                           actuators=push, constraints=rod)  # fmt: skip
    model = sv.derive(coupled, program)
    assert model.reduction.left_out == ("X", "Z") and model.reduction.mechanism.q.velocity_names == ("u", "v")


@pytest.mark.parametrize(
    "fault",
    [
        {"constraints": lambda y: {"rail": y - 1, "guide": 3 * y - 3}},
        {"constraints": lambda y: {"rail": y - 1, "guide": y - 2}},
        {"mass": 0.0},
    ],
)
def test_what_is_wrong_with_an_idle_coordinate_is_still_said(fault):
    q = sv.coordinates("x y")
    x, y = q
    constraints = fault.get("constraints", lambda y: {})(y)
    S = sv.particle(q, 1.0, x) + sv.particle(q, fault.get("mass", 1.0), y)
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"a": x}, constraints=constraints)
    with pytest.raises(sv.errors.SpecificationError):
        sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}))
