"""One name, one signal: a coordinate keeps its name, what bears it too is read by a longer one, everywhere the same.

The machine is two masses that do not touch. Everything is called by the coordinates' names, crosswise, so that a name
that is taken for another signal gives other numbers; all expected ones are closed forms.
"""

import pickle
import re

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv

HALF = np.arccos(0.5)  # s, where cos t = 0.5
SPAN = (0.0, 2.0)


def machine(names="x m1", **renamed):
    """Masses m1 and m2 at coordinates that are named alike; residuals, outputs and actuators are crossed."""
    p, q = sv.parameters(m1=2.0, m2=3.0), sv.coordinates(names)
    (x, y), (first, second) = q, names.split()
    S = p.m1 * q.d(2)[0] ** 2 / 2 + p.m2 * q.d(2)[1] ** 2 / 2
    mechanism = sv.Mechanism(
        q, S, actuators=renamed.get("actuators", {first: x, second: y}), parameters=p,
        outputs=renamed.get("outputs", {first: x + y}),
    )  # fmt: skip
    return mechanism, {second: x - ca.cos(q.t), first: y - ca.sin(q.t) / 2}


@pytest.fixture(scope="module")
def plan():
    mechanism, residuals = machine()
    model = sv.derive(mechanism, sv.Program(residuals))
    return sv.simulate(model, model.start(), SPAN, t_eval=np.linspace(*SPAN, 201))


def motions(t, m1=2.0):
    """What each name means, in closed form."""
    x, y = np.cos(t), np.sin(t) / 2
    return {
        "x": x, "m1": y, "dx": -np.sin(t), "d2m1": -y, "x_input": -m1 * x, "m1_input": -3.0 * y, "x_output": x + y,
        "dx_output": -np.sin(t) + np.cos(t) / 2, "dx_input": m1 * np.sin(t), "x_residual": 0.0 * t, "m1_residual": 0.0 * t,
    }  # fmt: skip


# what is read --------------------------------------------------------------------------------------------------------


def test_runs_read_the_closed_forms_by_each_name(plan, tmp_path):
    run = sv.simulate(plan.model, plan.start, SPAN, sv.methods.Taylor(jets=3), t_eval=plan.t)
    for name, values in motions(run.t).items():
        assert np.abs(run[name] - values).max() < 1e-9, name
    for name in ("x", "x_residual"):
        assert np.array_equal(run.residual[name], run.residual["x"])
    run["x_residual"].sum(), run.extrema("x_output")
    loaded = sv.load(run.save(tmp_path / "run"))
    for name in ("x", "x_input", "x_output", "x_residual", "m1_residual"):
        assert np.array_equal(loaded[name], run[name]), name
    header, first, *_ = run.csv(tmp_path / "run.csv").read_text().splitlines()
    row = dict(zip(re.findall(r"[\w ]+(?= \[|,|$)", header), map(float, first.split(",")), strict=False))
    assert len(row) > 5 and (row["x"], row["x_input"], row["x_output"]) == pytest.approx((1.0, -2.0, 1.0))
    with refused(sv.errors.NameUnknown, "x_residual", match="x_input"):
        run["x_inputs"]
    with refused(sv.errors.NameUnknown, "m1_residual", match="m1_input"):
        run["m1_inpt"]


EVENTS = [  # signal, value, instant by hand
    ("x", 0.5, HALF),
    ("m1", 0.25, np.pi / 6),
    ("x_input", -1.0, HALF),
    ("dx", -0.5, np.pi / 6),
    ("x_output", 0.5 * np.sqrt(1.25), np.arctan(0.5) + np.pi / 3),
    ("m1_input", -0.75, np.pi / 6),
    ("x_residual", 0.5, None),
    ("m1_residual", 0.25, None),
]


@pytest.mark.parametrize(("signal", "value", "instant"), EVENTS)
def test_events_fire_where_run_of_the_same_name_crosses(plan, signal, value, instant):
    run = sv.simulate(plan.model, plan.start, SPAN, events=sv.Event(signal, value, terminal=True))
    (times,) = run.t_events.values()
    assert times.tolist() == ([] if instant is None else [pytest.approx(instant, abs=1e-9)])
    assert run.t[-1] == pytest.approx(SPAN[1] if instant is None else instant, abs=1e-9)


@pytest.mark.parametrize("names", ["x y", "x energy_y", "dd y"])
def test_the_finding(names):
    q = sv.coordinates(names)
    x, name = q[0], names.split()[0]
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, q), actuators={"F": x, "G": q[1]})
    model = sv.derive(mechanism, sv.Program({name: x - ca.cos(q.t), "other": q[1]}))
    run = sv.simulate(model, model.start(), (0.0, 3.0), events=sv.Event(name, 0.5, terminal=True))
    assert run.t[-1] == pytest.approx(1.0472, abs=1e-4)
    assert f"{name}_residual" in str(model) and "other_residual" not in str(model)


BOUNDS = [("dx", 0.5), ("x_output", 0.8)]


@pytest.mark.parametrize(("name", "most"), BOUNDS)
def test_bounds_hold_for_the_signal_of_the_same_name(name, most):
    mechanism, residuals = machine()
    q, plant = mechanism.q, sv.plant(mechanism)
    path = sv.paths.rest_to_rest(0.0, 1.0, 1.0, smoothness=4).then(sv.paths.rest_to_rest(1.0, 0.0, 1.0))
    (s,) = q.references(s=path)
    program = sv.Program({"m1": q[0] - s, "x": q[1] - s / 2})
    run = sv.relaxed(plant, program, SPAN, weight=1e-7, bounds={name: (None, most)})
    free = sv.relaxed(plant, program, SPAN, weight=1e-7)
    assert np.max(free[name]) > 1.05 * most and np.max(run[name]) == pytest.approx(most, rel=1e-2)
    assert np.abs(run["x_residual"] - (run["m1"] - path(run.t) / 2)).max() < 1e-12


def test_residuals_have_bounds_by_their_longer_name():
    mechanism, _ = machine()
    q, plant = mechanism.q, sv.plant(mechanism)
    s = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, 2.0, smoothness=4)).s
    program = sv.Program({"m1": q[0] - s, "x": q[1] - s / 2})
    limited = sv.relaxed(plant, program, SPAN, weight=1e-7, limits={"x": 3.0, "m1": 20.0})  # can mean actuators alone
    assert np.abs(limited["x_input"]).max() == pytest.approx(3.0, rel=1e-6)
    free = sv.relaxed(plant, program, SPAN, weight=1e-3)
    most = np.abs(free["m1_residual"]).max() / 2
    run = sv.relaxed(plant, program, SPAN, weight=1e-3, bounds={"m1_residual": most})
    assert np.abs(run["m1_residual"]).max() == pytest.approx(most, rel=1e-2)
    with refused(sv.errors.SpecificationError, "limits", name="x_input"):
        sv.relaxed(plant, program, SPAN, bounds={"x_input": 1.0})
    with refused(sv.errors.NameUnknown, match="x_residual"):
        sv.relaxed(plant, program, SPAN, bounds={"x_residua": 1.0})


# feedback ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("integral", "held", "free"), [
    ("x", "x", "m1"), ("x_residual", "m1", "x"), ("m1", "m1", "x"), ("m1_residual", "x", "m1"),
])  # fmt: skip
def test_integrals_hold_the_signal_of_the_same_name(plan, integral, held, free):
    plan = sv.simulate(plan.model, plan.start, (0.0, 8.0))
    plant = sv.plant(plan.model.reduction.mechanism)
    law = sv.lqr(plan, plant, integral={integral: 1e4})
    assert law.state_names == (f"integral of {integral}",)
    run = sv.close(plant, law, plan.state(0.0), (0.0, 8.0), disturbance={"x": 3.0, "m1": 3.0})
    assert abs(run.error[held][-1]) < 1e-4 < 1e-3 < abs(run.error[free][-1])
    assert np.array_equal(run["x_residual"], run.residual["x"][0]) and np.array_equal(run["x"], run.states[0])
    assert np.array_equal(run["x_input"], run.input["x_input"])
    assert np.array_equal(run.to_run()["x_residual"], run["x_residual"])


def test_integrals_of_the_program_keep_their_names(plan):
    plant = sv.plant(plan.model.reduction.mechanism)
    law = sv.lqr(plan, plant, integral=True)
    again = sv.lqr(plan, plant, integral=dict.fromkeys(law.info["integrated"], 1e4))
    assert law.info["integrated"] == ("m1_residual", "x_residual")
    assert np.array_equal(law.schedule, again.schedule)
    assert law.state_names == sv.output_feedback(law, plant, {"x": 1e-3, "m1": 1e-3}).state_names[-2:]


def test_actuators_go_by_either_name_where_nothing_else_is_meant(plan):
    mechanism = plan.model.reduction.mechanism
    plants = [sv.plant(mechanism, limits={name: 10.0}, lag={name: 0.1}, m1=5.0) for name in ("x", "x_input")]
    assert plants[0] == plants[1] and plants[0].limits == {"x_input": (-10.0, 10.0)}
    assert plants[0].state_names == ("x", "m1", "dx", "dm1", "x_input") and plants[0].parameters[0] == 5.0
    plant = sv.plant(mechanism)
    laws = [sv.lqr(plan, plant, R={name: 0.1}) for name in ("x", "x_input")]
    assert np.array_equal(laws[0].schedule, laws[1].schedule)
    driven = [sv.simulate(plant, np.zeros(4), SPAN, inputs={name: 1.0}) for name in ("x", "x_input")]
    assert all(np.abs(run["x"] - run.t**2 / 4).max() < 1e-9 for run in driven)
    at_once = sv.inverse(mechanism, plan.model.reduction.program, SPAN, limits={"x": 3.0, "dm1": 9.0})
    assert np.abs(at_once["x_input"]).max() == pytest.approx(2.0)
    with refused(sv.errors.SpecificationError, "twice", name="x_input"):
        sv.plant(mechanism, limits={"x_input": 1.0, "x": 2.0})
    with refused(sv.errors.NameUnknown, valid=("x_input", "m1_input")):
        sv.plant(mechanism, limits={"y": 1.0})


@pytest.mark.parametrize("name", ["x", "x_input"])
def test_weights_and_wishes_are_of_actuators(name):
    mechanism, _ = machine()
    q = mechanism.q
    program = sv.Program({"x": q[0] + q[1] - q.t**2 / 2}, weights={name: 4.0}, toward={name: 0.5 * q.t})
    model = sv.derive(mechanism, program)
    run = sv.simulate(model, model.start(x=0.0, dx=0.0), SPAN)
    # least 4 (u - w)² + v² with u / 2 + v / 3 = 1: v = λ / 3, u = w + λ / 8
    rate = (1.0 - 0.25 * run.t) / (1 / 16 + 1 / 9)
    assert np.abs(run["x_input"] - 0.5 * run.t - rate / 8).max() < 1e-9
    assert np.abs(run["m1_input"] - rate / 3).max() < 1e-9


# numbers -------------------------------------------------------------------------------------------------------------


def test_parameters_go_by_their_longer_name_among_initial_values(plan):
    model = plan.model
    found = sv.sensitivity(plan, of=["x", "x_input", "x_output"], to="m1_parameter")
    for name, slope in (("x", 0.0), ("x_input", -np.cos(plan.t)), ("x_output", 0.0)):
        assert np.abs(found[name, "m1_parameter"] - slope).max() < 1e-9, name
    with refused(sv.errors.SpecificationError):  # the initial value of the coordinate, which the program determines
        sv.sensitivity(plan, of="x_input", to="m1")
    assert model.numbers == {"m1_parameter": 2.0, "m2": 3.0}
    assert model.with_parameters(m1=4.0) == model.with_parameters(m1_parameter=4.0) != model
    many = sv.simulate_many(model, plan.start, {"m1": [2.0, 4.0]}, SPAN, t_eval=plan.t)
    for i, m1 in enumerate(many.study["m1_parameter"]):
        for name, values in motions(plan.t, m1).items():
            if not name.startswith("dx_"):
                assert np.abs(many.trace[name][:, i] - values).max() < 1e-9, name
    with refused(sv.errors.SpecificationError, "twice", name="m1_parameter"):
        model.with_parameters(m1=1.0, m1_parameter=2.0)


def test_free_motions_differ_by_parameter_and_by_initial_value():
    p, q = sv.parameters(x=2.0), sv.coordinates("x")
    mechanism = sv.Mechanism(q, p.x * q.d(2)[0] ** 2 / 2, potential=p.x * q[0], parameters=p, actuators={"x": q[0]})
    plant = sv.plant(mechanism, x=4.0)
    model = sv.derive(mechanism, sv.Program({"x": q.d(1)[0] + q[0] - p.x}))  # x = p + (x0 - p) e^-t
    run = sv.simulate(model, model.start(x=1.0), SPAN)
    found, decay = sv.sensitivity(run, of="x", to=["x", "x_parameter"]), np.exp(-run.t)
    assert np.abs(run["x"] - (2.0 - decay)).max() < 1e-7 and plant.parameters[0] == 4.0
    assert np.abs(found["x", "x"] - decay).max() < 1e-6 and np.abs(found["x", "x_parameter"] - (1 - decay)).max() < 1e-6


def test_copies_of_other_processes_have_the_same_names(plan):
    model, mechanism = plan.model, plan.model.reduction.mechanism
    assert pickle.loads(pickle.dumps(mechanism)) == mechanism
    copy = pickle.loads(pickle.dumps(model))
    assert copy == model == sv.derive(mechanism, sv.Program(model.reduction.program.with_turns)) and str(copy) == str(
        model
    )
    plant = pickle.loads(pickle.dumps(sv.plant(mechanism)))  # other symbols of the same names
    again, law = (sv.lqr(plan, one, integral={"x_residual": 1.0}) for one in (plant, sv.plant(mechanism)))
    assert np.array_equal(law.schedule, again.schedule)


def test_files_of_c_name_each_signal(plan, tmp_path):
    _, header = sv.export_c(plan.model, tmp_path, name="crane")
    text = header.read_text()
    for name in ("P_m1_parameter", "U_x_input", "U_m1_input", "Y_x_output"):
        assert f"CRANE_{name} " in text, text


# what is said, and refused -------------------------------------------------------------------------------------------


def test_the_print_says_the_longer_names(plan):
    mechanism = plan.model.reduction.mechanism
    for value, names in (
        (mechanism, "x_input, m1_input, x_output, m1_parameter"),
        (plan.model, "m1_residual, x_residual"),
    ):
        (line,) = (line for line in str(value).splitlines() if "longer names" in line)
        assert names in line and len(line) <= 120 and len(str(value).splitlines()) <= 8


def test_a_residual_of_an_output_has_its_line_in_the_details():
    mechanism, _ = machine(outputs={"X": ca.SX(7.0)}, actuators={"F": [1.0, 0.0], "G": [0.0, 1.0]})
    q = mechanism.q
    model = sv.derive(mechanism, sv.Program({"X": q[0] - ca.cos(q.t), "Y": q[1]}))
    run = sv.simulate(model, model.start(), SPAN)
    assert (
        (run["X"] == 7.0).all()
        and np.abs(run["X_residual"]).max() < 1e-9
        and np.array_equal(run["Y"], run.residual["Y"][0])
    )
    assert "X_residual" in model.details and "X_residual" not in str(model)
    events = {"output": sv.Event("X", 7.0), "row": sv.Event("X_residual", 0.5), "other": sv.Event("Y", 0.5)}
    assert not any(len(t) for t in sv.simulate(model, run.start, SPAN, events=events).t_events.values())


NAMES = [  # kind, name, the name under which it is read
    ("actuators", "x", "x_input"),
    ("actuators", "d2x", "d2x_input"),
    ("actuators", "d4u", "d4u_input"),
    ("actuators", "energy", "energy_input"),
    ("actuators", "t", "t_input"),
    ("actuators", "force", "force"),
    ("actuators", "multiplier_a", "multiplier_a_input"),
    ("outputs", "u", "u_output"),
    ("outputs", "dx", "dx_output"),
    ("outputs", "energy", "energy_output"),
    ("outputs", "F", "F_output"),
    ("outputs", "dF", "dF_output"),
    ("outputs", "place", "place"),
]


@pytest.mark.parametrize(("kind", "name", "read"), NAMES)
def test_what_bears_the_name_of_a_signal_is_read_by_a_longer_one(kind, name, read):
    plain = sv.coordinates("x")
    q = plain.with_quasi_velocities("u", [[2.0]])
    parts = {"actuators": {"F": [1.0]}}
    parts |= {kind: {name: [1.0] if kind == "actuators" else 7.0 + q[0]}}
    mechanism = sv.Mechanism(q, q.w(1)[0] ** 2 / 2, **parts)
    model = sv.derive(mechanism, sv.Program({"u": q.w()[0] - 1.0}))  # u = 1, x = 2 t
    run = sv.simulate(model, model.start(x=0.0), SPAN)
    of_read = run[read]
    assert np.abs(of_read - (0.0 if kind == "actuators" else 7.0 + 2.0 * run.t)).max() < 1e-8
    assert (read in str(mechanism)) and ("longer names" in str(mechanism)) == (read != name)
    if read != name and name in ("x", "u", "dx", "energy"):  # the signal that keeps the name
        expected = {"x": 2.0 * run.t, "u": 1.0, "dx": 2.0, "energy": 0.5}[name]
        assert np.abs(run[name] - expected).max() < 1e-8


AMBIGUOUS = [
    {"names": "x m1", "actuators": {"x": 0, "x_input": 1}},
    {"names": "x x_input", "actuators": {"x": 0, "m": 1}},
    {"names": "x y", "outputs": {"y": 0, "y_output": 1}},
    {"names": "m1 m1_parameter", "outputs": {}},
    {"names": "x y", "outputs": {"x_residual": 0}},
    {"names": "y y_residual", "outputs": {}},
]


@pytest.mark.parametrize("given", AMBIGUOUS)
def test_only_what_stays_ambiguous_is_refused(given):
    q = sv.coordinates(given["names"])
    parts = {k: {n: q[i] for n, i in v.items()} for k, v in given.items() if k != "names"}
    S, p = sv.particle(q, 1.0, q), sv.parameters(m1=1.0)
    first = given["names"].split()[0]
    with refused(sv.errors.SpecificationError, "is taken"):
        mechanism = sv.Mechanism(q, S, parameters=p, **{"actuators": {"F": q[0], "G": q[1]}} | parts)
        sv.derive(mechanism, sv.Program({first: q[0] - ca.cos(q.t), "other": q[1]}))


# coordinates as columns ----------------------------------------------------------------------------------------------

M = np.array([[2.0, 0.3], [0.3, 1.0]])
COLUMNS = [  # expression, and the same by scalars a, b of what is taken
    (lambda v: ca.vertcat(v), lambda a, b: (a, b)),
    (lambda v: ca.vertcat(*v), lambda a, b: (a, b)),
    (lambda v: v.T @ M @ v, lambda a, b: 2 * a * a + 0.6 * a * b + b * b),
    (lambda v: v.T @ ca.SX(M) @ v, lambda a, b: 2 * a * a + 0.6 * a * b + b * b),
    (lambda v: ca.SX(M) @ v, lambda a, b: (2 * a + 0.3 * b, 0.3 * a + b)),
    (lambda v: ca.sumsqr(v), lambda a, b: a * a + b * b),
    (lambda v: ca.dot(v, v), lambda a, b: a * a + b * b),
    (lambda v: np.array([[1.0, 2.0]]) @ ca.diag(v) - 1, lambda a, b: (a - 1, 2 * b - 1)),
    (lambda v: v[0] - 2 * v[-1], lambda a, b: a - 2 * b),
    (lambda v: v[1:], lambda a, b: b),
    (lambda v: ca.vertcat(*v[::-1]), lambda a, b: (b, a)),
]


@pytest.mark.parametrize(("expression", "scalars"), COLUMNS)
@pytest.mark.parametrize("part", ["q", "d0", "d1", "w", "d2", "rates"])
def test_coordinates_and_their_rates_are_columns_that_unpack(part, expression, scalars):
    q = sv.coordinates("x y")
    frame = q.with_quasi_velocities("u v", [[1.0, q[0]], [0.0, 2.0]])
    of = {"q": q, "d0": q.d(0), "d1": q.d(1), "w": frame.w(), "d2": q.d(2), "rates": frame.d(1)}[part]
    a, b = of
    assert len(of) == len(list(of)) == 2
    given = scalars(a, b)
    given = given if isinstance(given, tuple) else (given,)
    difference = ca.vec(expression(of)) - ca.vertcat(*given)
    symbols = ca.symvar(ca.vertcat(a, b, difference))
    values = ca.Function("f", symbols, [difference])(*np.linspace(0.3, 1.3, len(symbols)))
    assert np.abs(np.array(values)).max() < 1e-14


def test_coordinates_are_read_by_name_and_by_place():
    q = sv.coordinates("x y z")
    assert [s.name() for s in (q["y"], q[0], q[-1], *q[:2], *q.d(1)[1:])] == ["y", "x", "z", "x", "y", "dy", "dz"]
    assert (2 * q.d(1)).shape == (3, 1) == (q.d(1) + q.d(2)).shape
    for place in (3, -4, "w", True, None):
        with refused(sv.errors.NameUnknown, "x, y, z", name=place):
            q[place]
    with pytest.raises(TypeError):
        q.d(1)[0] = 1.0
