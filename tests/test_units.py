"""Units stay in the specification: they follow to rates and forces, and reach axes, tables, pages, files and C."""

import copy
import csv
import pickle
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import needs
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, ServoError, SpecificationError
from servoctl.gallery import Scene, gallery, overhead_crane, wheeled_robot
from servoctl.markup import digits
from servoctl.units import rate_unit, unit_of, unit_of_column

ROBOTS = Path(__file__).parents[1] / "examples" / "robots"
CRANE_UNITS = {"x": "m", "l": "m", "theta": "rad", "trolley": "N", "hoist": "N", "tension": "N", "X": "m", "Z": "m"}


@pytest.fixture(scope="module")
def plan():
    model = sv.derive(*overhead_crane())
    return sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 1.0), t_eval=np.linspace(0.0, 1.0, 11))


@pytest.fixture(scope="module")
def loop(plan):
    plant = sv.plant(plan.model.reduction.mechanism, limits={"trolley": 15.0})
    return sv.close(plant, sv.lqr(plan, plant, 100.0), plan.state(0.0), (0.0, 0.5))


# --- what follows from what


@pytest.mark.parametrize(
    ("unit", "k", "rate"),
    [
        ("m", 1, "m/s"), ("rad", 3, "rad/s^3"), ("m/s", 1, "m/s^2"), ("m/s^2", 2, "m/s^4"), ("N m", 1, "N m/s"),
        ("1/m", 1, "1/(m s)"), ("1/(m s)", 2, "1/(m s^3)"), ("J", 1, "J/s"), ("1", 1, "1/s"), ("m", 0, "m"), ("", 2, ""),
    ],
)  # fmt: skip
def test_the_unit_of_a_rate(unit, k, rate):
    assert rate_unit(unit, k) == rate


def test_units_of_derived_signals():
    units = {"x": "m", "theta": "rad", "u": "N", "v": "m/s"}
    expected = {
        "dx": "m/s", "d3theta": "rad/s^3", "du": "N/s", "dv": "m/s^2", "energy": "J", "denergy": "J/s",
        "reaction_x": "N", "reaction_theta": "N m", "reaction_v": "N", "command u": "N", "measured dtheta": "rad/s",
        "y": "", "drift": "", "reaction_y": "",
    }  # fmt: skip
    assert {name: unit_of(name, units) for name in expected} == expected
    columns = {"u_max": "N", "dx_end": "m/s", "final theta": "rad", "x": "m", "error": "", "worst": "", "max |u|": "N"}
    columns |= {"rms dx": "m/s", "max |residual x|": "", "residual x": ""}
    assert {name: unit_of_column(name, units) for name in columns} == columns
    assert unit_of_column("energy", {}) == ""  # of a trade-off it is an error, relative


def driven(displacement, units="m m rad", **given):
    q = sv.coordinates("x y theta", units=units)
    x, y, theta = q
    S = sum(sv.particle(q, 1.0, each) for each in q)
    return sv.Mechanism(q, S, actuators={"u": displacement(x, y, theta)}, **given).units.get("u")


def test_the_unit_of_an_actuator_follows_where_that_is_certain():
    """Power is u times the rate of the displacement; a number that is no sign may hide a length."""
    assert driven(lambda x, y, theta: x) == "N" and driven(lambda x, y, theta: theta) == "N m"
    assert driven(lambda x, y, theta: y - x) == "N" and driven(lambda x, y, theta: (0, 0, -1)) == "N m"
    for unclear in (lambda x, y, a: 0.3 * a, lambda x, y, a: x + a, lambda x, y, a: x * ca.cos(a)):
        assert driven(unclear) is None
    assert driven(lambda x, y, theta: x, units=None) is None
    assert driven(lambda x, y, theta: x, units={"x": "m"}) == "N"
    assert driven(lambda x, y, theta: theta, units="m m 1") is None


def test_units_of_quasi_velocities_are_those_that_are_given():
    mechanism, _ = wheeled_robot()
    assert {mechanism.units[name] for name in ("v", "drive")} == {"m/s", "N"}
    assert (mechanism.units["r"], mechanism.units["steer"], mechanism.units["curvature"]) == ("rad/s", "N m", "1/m")


# --- what is refused


def test_units_that_do_not_fit_are_refused():
    for units, count in (("m m", 2), ("m m rad m", 4), (["m"], 1), ("", 0)):
        with refused(SpecificationError, "x, l, theta", units=count, names=3):
            sv.coordinates("x l theta", units=units)
    for units in (3, {"x": 1}, ["m", "m", None]):
        with refused(SpecificationError):
            sv.coordinates("x l theta", units=units)
    with refused(NameUnknown, name="thetta", match="theta"):
        sv.coordinates("x l theta", units={"thetta": "rad"})


def test_units_of_nothing_and_two_units_are_refused():
    q = sv.coordinates("x", units="m")
    S, p = sv.particle(q, 1.0, *q), sv.parameters(mass=1.0)
    with refused(NameUnknown, name="forse", match="force"):
        sv.Mechanism(q, S, actuators={"force": q["x"]}, units={"forse": "N"})
    with refused(NameUnknown, name="dx"):  # it follows
        sv.Mechanism(q, S, units={"dx": "m/s"})
    with refused(SpecificationError, name="x", units=("m", "mm")):
        sv.Mechanism(q, S, units={"x": "mm"})
    rail = {"constraints": {"rail": q["x"]}, "units": {"multiplier_rail": "N", "mass": "kg", "x": "m"}}
    assert sv.Mechanism(q, S, parameters=p, **rail).units == rail["units"]


# --- what carries them


def test_units_belong_to_the_value():
    mechanism = overhead_crane()[0]
    assert mechanism.units == CRANE_UNITS
    for twin in (pickle.loads(pickle.dumps(mechanism)), copy.copy(mechanism)):
        assert twin.units == CRANE_UNITS and twin == mechanism
    q = sv.coordinates("x", units="m")
    other = sv.coordinates("x")
    metres, bare = (sv.Mechanism(each, sv.particle(each, 1.0, *each)) for each in (q, other))
    assert metres != bare and pickle.loads(pickle.dumps(q)).units == {"x": "m"}


def test_a_pickled_frame_keeps_its_units():
    q = wheeled_robot()[0].q
    assert pickle.loads(pickle.dumps(q)).units == q.units == {"x": "m", "y": "m", "psi": "rad"}


def test_parts_plants_and_loops_keep_units(plan, loop, tmp_path):
    mechanism, program = overhead_crane()
    q = sv.coordinates("x z idle", units="m m rad")
    two = sv.Mechanism(q, sum(sv.particle(q, 1.0, each) for each in q), actuators={"push": q["x"], "lift": q["z"]})
    model = sv.derive(two, sv.Program({"X": q["x"] - q.t**4, "Z": q["z"] - q.t**4}, by="actuators"))
    assert "idle" not in model.reduction.mechanism.q.names and model.reduction.mechanism.units["push"] == "N"
    assert loop.units == plan.units == CRANE_UNITS and loop.unit("d2theta") == "rad/s^2"
    for value in (plan, loop):
        again = sv.load(value.save(tmp_path / "value.npz"))
        assert again.units == CRANE_UNITS and again.unit("dX") == "m/s"
    assert sv.load(plan.save(tmp_path / "plan.npz"), plan.model).unit("trolley") == "N"
    assert loop.to_run().unit("command trolley") == "N" and loop.to_run().unit("law x") == ""


def test_a_derivation_on_disk_serves_the_units_of_its_reader():
    """The same equations with other units: what is read back has those of the mechanism that is derived."""
    def moved(units):
        q = sv.coordinates("x", units=units)
        mechanism = sv.Mechanism(q, sv.particle(q, 1.0, *q), actuators={"force": q["x"]})
        return sv.derive(mechanism, sv.Program({"X": q["x"] - q.t**4}, by="actuators")).reduction.mechanism.units

    assert [moved("m"), moved("rad"), moved(None)] == [{"x": "m", "force": "N"}, {"x": "rad", "force": "N m"}, {}]


@pytest.mark.parametrize("name", gallery)
def test_every_signal_of_a_scene_has_a_unit(name):
    mechanism, _ = gallery[name].build()
    signals = (*mechanism.q.jet_names(2), *mechanism.actuators, *mechanism.outputs)
    assert not [signal for signal in signals if not unit_of(signal, mechanism.units)]


# --- where they are shown


def test_axes_have_units(plan):
    assert [ax.get_ylabel() for ax in sv.figures.actuation(plan)] == ["trolley [N]", "hoist [N]"]
    (ax,) = sv.figures.signals(plan, "d2x", "d2l")
    assert ax.get_ylabel() == "d2x, d2l [m/s$^{2}$]"
    assert sv.figures.signals(plan, "x", units={"x": "mm"})[0].get_ylabel() == "x [mm]"


def test_printed_values_have_units(plan, loop):
    shown = {name: line for line in repr(plan).splitlines() for name in ("trolley", "X") if line.startswith(f"  {name}:")}
    assert "  trolley: 0 N .. " in shown["trolley"] and " N (t = " in shown["trolley"] and " m (t = " in shown["X"]
    assert " N; limited during " in next(line for line in repr(loop).splitlines() if line.startswith("  trolley: "))


def test_headers_in_c_have_units(plan, loop, tmp_path):
    sv.export_c(plan.model, tmp_path, name="crane")
    header = (tmp_path / "crane.h").read_text(encoding="utf-8")
    assert "CRANE_X_dtheta = 5, /* [rad/s] */" in header and "CRANE_U_trolley = 0, /* [N] */" in header
    sv.export_c(loop.law, tmp_path, name="law")
    assert "LAW_Y_dl = 4, /* [m/s] */" in (tmp_path / "law.h").read_text(encoding="utf-8")


# --- tables


@pytest.fixture(params=["plan", "loop", "study"])
def table(request):
    if request.param != "study":
        return request.getfixturevalue(request.param)
    return sv.types.Study("many", {"x": [1.0, 2.0], "trolley_max": [3.0, np.nan], "error": ["", "=1"]}, {"units": CRANE_UNITS})


def test_tables_have_the_same_columns_and_units(table, tmp_path):
    needs("pandas")
    needs("xarray")
    frame, data = table.to_pandas(), table.to_xarray()
    study = isinstance(table, sv.types.Study)
    names = list(table.columns if study else table.names)
    assert list(frame.columns) == names and frame.index.name == (None if study else "t")
    assert {name: data[name].attrs.get("units", "") for name in names} == {name: table.unit(name) for name in names}
    units = frame.attrs["units"]
    assert {name: units.get(name, "") for name in names} == {name: table.unit(name) for name in names}
    for name in names:
        assert np.array_equal(frame[name].to_numpy(), data[name].values) or frame[name].isna().any()
        assert frame[name].tolist() == pytest.approx(list(table[name]), nan_ok=True) if name != "error" else True
    with open(table.csv(tmp_path / "table.csv"), newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    expected = [f"{name} [{table.unit(name)}]" if table.unit(name) else name for name in names]
    assert head == (expected if study else ["t [s]", *expected]) and len(rows) == len(frame)
    column = names.index("x") + (not study)
    assert [float(row[column]) for row in rows] == table["x"].tolist()
    assert not study or [row[2] for row in rows] == ["", "'=1"]


def test_without_pandas_or_xarray_it_says_what_to_do(table, monkeypatch):
    for package, method in (("pandas", table.to_pandas), ("xarray", table.to_xarray)):
        monkeypatch.setitem(sys.modules, package, None)
        with refused(ServoError, package, "servoctl[io]", "csv", package=package):
            method()


# --- notebooks


def test_values_are_small_tables_in_a_notebook(plan, loop, table):
    model = plan.model
    verification = sv.verify(plan)
    values = [
        plan, loop, table, model, plan.start, verification, sv.report(plan), model.structure(), loop.law, loop.plant,
        model.reduction.mechanism,
    ]  # fmt: skip
    for value in values:
        shown = value._repr_html_()
        assert shown.startswith("<p><b>") and shown.count("<table>") == shown.count("</table>") >= 1
        assert len(shown) < 8000
    assert "<td>trolley</td>" in plan._repr_html_() and "<td>N</td>" in plan._repr_html_()
    assert f"<td class=n>{verification.numbers['balance']:.2g}</td>" in verification._repr_html_()


def test_a_zero_has_no_sign():
    assert (digits(-0.0), digits(-1e-3), digits(1.23456e-9, 2), digits(None)) == ("0", "-0.001", "1.2e-09", "–")


def test_what_a_notebook_shows_is_escaped():
    study = sv.types.Study("many", {"<b>": ["<script>", "&"]}, {})
    shown = study._repr_html_()
    assert "<script>" not in shown and "&lt;script&gt;" in shown and "<th>&lt;b&gt;</th>" in shown
    assert "&lt;script&gt;" in sv.types.Study("<script>", {"a": [1]})._repr_html_()
    assert "<table>" not in sv.types.Study("empty", {})._repr_html_()


# --- robots


def test_a_robot_has_the_units_of_its_joints():
    fixed = sv.urdf(ROBOTS / "scara.urdf").mechanism()
    kinds = {unit for name, unit in fixed.units.items() if name in fixed.q.names}
    assert kinds == {"rad", "m"} and {fixed.units[name] for name in fixed.actuators} == {"N", "N m"}
    free = sv.urdf(ROBOTS / "six_axis_arm.urdf", base="free").mechanism()
    units = [unit_of(name, free.units) for name in (*free.q.names, *free.q.velocity_names)]
    assert units[:7] == ["m"] * 3 + ["1"] * 4 and units[13:19] == ["m/s"] * 3 + ["rad/s"] * 3
    assert units[7:13] == ["rad"] * 6 and units[19:] == ["rad/s"] * 6
    assert {free.units[name] for name in free.actuators} == {"N m"}
    assert pickle.loads(pickle.dumps(free)).units == free.units


def test_a_scene_may_have_further_units():
    scene = Scene(overhead_crane, "A crane.", units={"m_load": "kg", "trolley": "kN"})
    assert scene.build()[0].units == CRANE_UNITS | {"m_load": "kg", "trolley": "kN"}
    assert scene.build(coordinates="redundant")[0].q.names == ("x", "l", "X", "Z")
