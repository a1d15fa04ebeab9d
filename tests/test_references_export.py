"""C of a model with references: the paths as tables beside the functions, or their jets as an argument."""

import ctypes

import numpy as np
import pytest
import referred
from refusals import refused
from test_export_c import Exported, close

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.export.c import export_c

pytestmark = pytest.mark.usefixtures("c_compiler")


@pytest.fixture(scope="module")
def model():
    return referred.crane()


@pytest.fixture(scope="module")
def cart():
    return referred.cart()


def jets_of(model, plan, t):
    """What a controller passes: the references at t in the order of the enum of the header."""
    order = len(plan.indices("ref")) // len(model.paths)
    return np.concatenate(
        [path.held().jets([t], 15)[:order, 0, 0][:, None] for path in model.paths.values()], 1
    ).ravel()


@pytest.mark.parametrize("form", ["table", "argument"])
def test_feedforward_along_references_is_the_run(form, model, tmp_path):
    times = np.linspace(-0.5, 6.5, 71)
    start = model.start(-0.5, guess={"l": 4.0})
    run = sv.simulate(model, start, (-0.5, 6.5), t_eval=times)
    plan = Exported(export_c(model, tmp_path, name="plan", start=start, references=form), "plan")
    x, z, u = start.values.copy(), np.empty(len(model.jet_names)), np.empty(2)
    p, residuals = plan.constant("p", 3), np.empty(len(plan.indices("r")))
    assert np.array_equal(p, model.parameters)
    for k, t in enumerate(times):
        first = [t, *([jets_of(model, plan, t)] if form == "argument" else [])]
        assert plan("feedforward", *first, x, p, z, u) >= 0
        assert close(z, run.jets[:, k]) and close(u, np.array([run["trolley"][k], run["hoist"][k]]))
        plan("residuals", *first, z, p, residuals)
        assert close(residuals, model.signals("residuals")[1](t, z, model.p))
    if form == "argument":
        assert list(plan.indices("ref")) == ["X", "Z", "dX", "dZ", "d2X", "d2Z", "d3X", "d3Z", "d4X", "d4Z"]
        assert plan("feedforward", 1.0, np.full(10, np.nan), x, p, z, u) == -1


def test_no_address_is_written(model, tmp_path):
    texts = [export_c(model, tmp_path / form, references=form)[0].read_text() for form in ("table", "argument")]
    assert all(repr(model.p[0]).split(".")[0] not in text for text in texts)
    assert export_c(model, tmp_path / "again")[0].read_text() == texts[0]


@pytest.mark.parametrize("form", ["table", "argument"])
def test_a_plan_with_motion_of_its_own_follows_references(form, cart, tmp_path):
    run = sv.simulate(cart, cart.start(theta=0.1, dtheta=0.0), (0.0, 1.5), "RK4", t_eval=np.linspace(0.0, 1.5, 61))
    plan = Exported(export_c(cart, tmp_path, name="plan", references=form), "plan")
    z, u, p = np.empty(len(cart.jet_names)), np.empty(1), cart.parameters.copy()
    for k, t in enumerate(run.t):
        x = run.jets[: len(cart.state_names), k].copy()
        first = [t, *([jets_of(cart, plan, t)] if form == "argument" else [])]
        assert plan("feedforward", *first, x, p, z, u) == 0
        assert close(z, run.jets[:, k]) and close(u, run["force"][k])
    assert ("plan_advance" in plan.header) == (form == "table")


def test_advance_takes_the_path_at_all_its_instants(cart, tmp_path):
    plan = Exported(export_c(cart, tmp_path, name="plan"), "plan")
    x, p = cart.start(theta=0.1, dtheta=0.0).values.copy(), cart.parameters.copy()
    for k in range(1000):
        assert plan("advance", k / 1000, 1e-3, x, p) == 0
    run = sv.simulate(cart, cart.start(theta=0.1, dtheta=0.0), (0.0, 1.0), sv.methods.RungeKutta(4, step=1e-3))
    assert close(x, run.jets[: len(x), -1])


@pytest.mark.parametrize("rule", ["hold", "continue", "periodic", None])
def test_outside_its_breaks_the_table_does_what_the_path_says(rule, model, tmp_path):
    sides = {} if rule is None else {"before": rule, "after": rule}
    wave = sv.paths.polynomials([0.0, 1.0, 3.0], [[0.1, 0.2], [0.3, -0.1], [0.0, 0.2], [1.0, 1.4]], **sides)
    other = model.with_references(X=wave)
    plan = Exported(export_c(other, tmp_path, name="plan"), "plan")
    residual = model.signals("residuals")[1]
    z, p, r = np.linspace(0.3, 1.2, len(model.jet_names)), model.parameters.copy(), np.empty(len(plan.indices("r")))
    for t in (-3.7, -0.25, 0.0, 0.5, 1.0, 2.5, 3.0, 3.2, 9.9):
        plan("residuals", t, z, p, r)
        if rule is None and not 0.0 <= t <= 3.0:
            assert np.isnan(r).any()
        else:
            assert close(r, residual(t, z, other.p))


@pytest.mark.parametrize("real", ["double", "float"])
def test_where_a_path_rests_the_table_has_the_same_zeros(real, model, tmp_path):
    """At its ends, at breaks on the way and beyond: of derivatives that vanish no rounding is left."""
    there = sv.paths.rest_to_rest(0.1, 3**0.5, 4.0)
    path = there.then(sv.paths.rest_to_rest(3**0.5, 3**0.5, 1.0)).then(sv.paths.rest_to_rest(3**0.5, 12**0.5, 3.0))
    other = model.with_references(X=path, Z=-path)
    plan = Exported(export_c(other, tmp_path, name="plan", real=real), "plan")
    kind = np.float32 if real == "float" else float
    z, p, r = np.zeros(len(model.jet_names), kind), model.parameters.astype(kind), np.empty(len(plan.indices("r")), kind)
    for t in (-1.0, *path.breaks[path.classes < 100], 9.0):
        plan("residuals", ctypes.c_float(t) if real == "float" else t, z, p, r)
        rates = [k for k, name in enumerate(plan.indices("r")) if "D" in name]
        assert len(rates) >= 2 and not r[rates].any()


def test_in_floats_a_table_has_the_digits_of_floats(model, tmp_path):
    plan = Exported(export_c(model, tmp_path, name="plan", real="float"), "plan")
    z, p = np.linspace(0.3, 1.2, len(model.jet_names)), model.parameters
    r = np.empty(len(plan.indices("r")), np.float32)
    plan("residuals", ctypes.c_float(1.7), z.astype(np.float32), p.astype(np.float32), r)
    expected = model.signals("residuals")[1](1.7, z, model.p)
    assert np.abs(r - expected).max() < 2e-5 * np.abs(expected).max()
    late = sv.paths.polynomials([1e5, 1e5 + 1e-3, 1e5 + 1.0], [[1.0, 1.0]])
    with refused(SpecificationError, "'X'", "one instant"):
        export_c(model.with_references(X=late), tmp_path, real="float")


def test_what_cannot_be_exported_is_refused(model, tmp_path):
    mechanism, X, Z = referred.crane_parts()
    r = mechanism.q.references(X=None)
    open_model = sv.derive(mechanism, sv.Program({"X": X - r.X, "Z": Z + 4.0}, by="actuators"))
    with refused(SpecificationError, "No path was given for X"):
        export_c(open_model, tmp_path)
    assert export_c(open_model, tmp_path, references="argument")
    with refused(NameUnknown, "'tables'"):
        export_c(model, tmp_path, references="tables")
    plain = sv.derive(mechanism, sv.Program({"X": X, "Z": Z + 4.0}, by="actuators"))
    with refused(SpecificationError, "references"):
        export_c(plain, tmp_path, references="argument")


@pytest.mark.parametrize("form", ["table", "argument"])
def test_a_mass_without_parameters_under_a_force_with_a_reference_of_its_own(form, tmp_path):
    """x = r under a wind w: the force is 2 r'' - w."""
    q = sv.coordinates("x")
    r = q.references(r=sv.paths.rest_to_rest(0.0, 3.0, 2.0), w=sv.paths.polynomials([0.0, 2.0], [[0.5], [1.0]]))
    mechanism = sv.Mechanism(q, sv.particle(q, 2.0, [q[0], 0]), 0, {"force": q[0]}, forces={"x": r.w})
    model = sv.derive(mechanism, sv.Program({"X": q[0] - r.r}, by="actuators"))
    plan = Exported(export_c(model, tmp_path, name="plan", references=form), "plan")
    x, z, u, t = np.zeros(2), np.empty(3), np.empty(1), 0.7
    (place, _, second), wind = model.paths["r"].jets([t], 2)[:, 0, 0], model.paths["w"](t)
    first = [
        t,
        *([np.array([place, wind, *model.paths["r"].jets([t], 1)[1, 0], 0.5, second, 0.0])] * (form == "argument")),
    ]
    assert plan("feedforward", *first, x, np.zeros(1), z, u) >= 0
    assert close(u, 2.0 * second - wind) and close(x[0], place)
