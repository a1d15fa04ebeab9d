"""Tables in C for splines: the numbers of the sums, at the cost of one piece."""

import ctypes
import pickle
import re
import shlex
import subprocess
from copy import copy

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.interpolate import make_interp_spline

import servoctl as sv
from servoctl.codegen import compiler, emit
from servoctl.codegen import function as functions
from servoctl.codegen.function import compiled
from servoctl.codegen.interpreted import MANY_POINTS, Interpreter
from servoctl.export import c as export
from servoctl.jets import lookup
from servoctl.jets.pieces import by_pieces
from servoctl.jets.series import Series
from servoctl.jets.tape import Tape
from servoctl.methods.taylor import TaylorSteps, last_index, series_loop
from servoctl.spec.paths import expressions as paths

T, X, P = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("p", 1)
RNG = np.random.default_rng(7)
EVEN = np.linspace(0.0, 6.0, 40)
UNEVEN = np.cumsum(10.0 ** RNG.uniform(-1.0, 0.0, 30))
GROWING = np.geomspace(1e-3, 1e3, 25)
EVENTS = 1e9 + np.cumsum(RNG.uniform(0.5, 1.5, 20))


def points(times, dim=2):
    return np.random.default_rng(len(times)).normal(size=(len(times), dim))


def linear(s, times):
    return sv.paths.piecewise(s, times, np.random.default_rng(3).normal(size=(2, len(times) - 1, 2)))


PATHS = {
    "jumping, knots of very different distances": (lambda: linear(T, GROWING), GROWING),
    "far from zero": (lambda: linear(T, EVENTS), EVENTS),
    "along a time law": (
        lambda: sv.paths.spline(sv.paths.rest_to_rest(T, 0.0, 6.0, 6.0), EVEN, points(EVEN)), EVEN),
    "spline of a spline": (
        lambda: linear(sv.paths.spline(T, EVEN, 3.0 + points(EVEN, 1), 2), np.linspace(0.0, 6.0, 9)), EVEN),
    "along a state": (lambda: sv.paths.spline(X[0], EVEN, points(EVEN)) * X[1], EVEN),
    "two splines": (
        lambda: sv.paths.spline(T, EVEN, points(EVEN)) + 3.0 * sv.paths.spline(T, UNEVEN, points(UNEVEN), ends="natural"), EVEN),
    "points of parameters": (
        lambda: sv.paths.spline(T, EVEN[:6], [P[0] * c for c in range(6)]) * ca.SX.ones(2), EVEN[:6]),
    "constants that are equal to numbers of values": (
        lambda: ca.vertcat(*(sum(float(k) * (T >= k) for k in range(1, 30)) * 3.0 + 7.0, T / 4.0 + 5.0)), EVEN),
    "pieces without a value": (lambda: ca.vertcat(T / sum(float(k) * (T >= k) for k in range(1, 30)), T), EVEN),
    "a switch": (lambda: ca.vertcat(ca.if_else(T < 2.0, T, X[0]), ca.fmax(T, 3.0)), EVEN),
}  # fmt: skip


def instants(knots):
    """Knots, the numbers on both sides of them, points between and outside, and what is no number."""
    inside = RNG.uniform(knots[0], knots[-1], 50)
    width = knots[-1] - knots[0]
    near = [*knots, *np.nextafter(knots, np.inf), *np.nextafter(knots, -np.inf), *inside]
    return np.array([*near, knots[0] - width, knots[-1] + width, -np.inf, np.inf, np.nan])


@pytest.fixture
def uncontracted(tmp_path, monkeypatch, c_compiler):
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path))
    monkeypatch.setenv("CC", "cc -ffp-contract=off")
    monkeypatch.setattr(functions, "GRID_POINTS", 0)


@pytest.mark.parametrize("name", PATHS)
def test_lookups_equal_the_sums_to_the_last_bit_one_by_one_and_in_lanes(uncontracted, name):
    build, knots = PATHS[name]
    path = build()
    f = ca.Function("f", [T, X, P], [ca.densify(ca.vertcat(path, ca.vec(ca.jacobian(path, ca.vertcat(T, X)))))])
    model, t = compiled(f, "f"), instants(knots)
    x = np.array([t[::-1], RNG.normal(size=t.size)])
    expected = np.array([np.asarray(f(*row)).ravel() for row in zip(t, x.T, np.full(t.size, 1.5), strict=True)]).T
    alone = np.hstack([model.grid(t[k : k + 7], x[:, k : k + 7], [1.5]) for k in range(0, t.size, 7)])  # not in lanes
    np.testing.assert_array_equal(alone, expected)
    np.testing.assert_array_equal(model.grid(t, x, [1.5]), expected)
    assert ("table_" in model.source()) == (name not in ("points of parameters", "a switch"))


@pytest.mark.parametrize("name", [*PATHS, "a table of data"])
def test_many_points_that_casadi_evaluates_at_once_have_the_bits_of_single_points(name):
    times = np.linspace(0.0, 6.0, 300)
    build, knots = PATHS.get(name, (lambda: sv.paths.spline(T, times, points(times)), times))
    f = ca.Function("f", [T, X, P], [ca.densify(build())])
    t, evaluator = instants(knots), Interpreter(f)
    x, p = RNG.uniform(0.0, 6.0, (2, len(t))), np.array([1.7])
    once = np.array([evaluator._value(*at, p) for at in zip(t, x.T, strict=True)]).T
    again = np.empty_like(once)
    for _ in range(1 + MANY_POINTS // len(t)):
        evaluator.grid(t, x, p, again)
    np.testing.assert_array_equal(again, once)
    assert bool(lookup.lookups(f)) == (name == "a table of data")
    assert evaluator._machine is None or not lookup.lookups(f)


def test_what_a_point_costs_does_not_depend_on_the_number_of_via_points():
    def operations(n):
        t = np.linspace(0.0, 6.0, n)
        path = sv.paths.spline(T, t, points(t), 4)
        motion = [path]
        for _ in range(4):
            motion.append(ca.jtimes(motion[-1], T, 1.0))
        return emit.operations(ca.Function("f", [T, X, P], [ca.vertcat(*motion)]))

    assert operations(40) == operations(5)
    assert operations(30_000) == operations(400) < 1.05 * operations(5)  # the entries of large tables are scaled


def test_functions_of_one_unit_share_a_table_and_the_text_depends_on_content_alone():
    f, again = (ca.Function("f", [T, X, P], [sv.paths.spline(T, EVEN, points(EVEN))]) for _ in range(2))
    text = emit.emit(f, "f", ("rk",), others={"other": again})
    assert len(set(re.findall(r"#define HAS_(table_\w+)", text))) == 1
    assert text == emit.emit(again, "f", ("rk",), others={"other": f})


def test_a_plan_along_100_points_has_the_forces_of_the_spline():
    q = sv.coordinates("x y")
    x, y = q
    p = sv.parameters(m=2.0)
    t = np.linspace(0.0, 6.0, 100)
    via = np.array([np.sin(t), np.cos(2 * t)]).T
    path = sv.paths.spline(q.t, t, via, 3, "natural")
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.m, ca.vertcat(x, y)), actuators={"Fx": x, "Fy": y}, parameters=p
    )
    model = sv.derive(mechanism, sv.Program({"X": x - path[0], "Y": y - path[1]}, by="actuators"))
    run = sv.simulate(model, model.start(), t_span=(0.0, 6.0), t_eval=np.linspace(0.0, 6.0, 3001))
    zeros = [(order, np.zeros(2)) for order in (3, 4)]
    curve = make_interp_spline(t, via, k=5, bc_type=(zeros, zeros))
    expected = 2.0 * curve(run.t, nu=2)
    np.testing.assert_allclose(np.array([run["Fx"], run["Fy"]]).T, expected, atol=1e-8)
    assert compiler.compiler() is None or "table_" in model.function("path").source()


def test_series_by_pieces_are_those_of_the_sums():
    inside = sv.paths.spline(T, UNEVEN, points(UNEVEN), ends="natural")
    path = ca.vertcat(inside, ca.sin(inside[0]) * (T >= UNEVEN[3]), sum(float(k) * (T >= k) for k in range(9)), ca.exp(-T))
    tape = Tape([T], path.elements())
    short = copy(tape)
    short.nodes = by_pieces(tape, (a for a, _ in tape.switches))
    t = instants(UNEVEN)[:-3].astype(np.longdouble)
    results = []
    for some in (tape, short):
        series = Series(some, [[t, 1.0, *[0.0] * 5]])
        for _ in range(6):
            series.advance()
        results.append(np.array([[np.broadcast_to(c, t.shape) for c in output] for output in series.outputs]))
    size = np.abs(results[0]).max(axis=2, keepdims=True)
    np.testing.assert_allclose(results[1] / (size + 1.0), results[0] / (size + 1.0), atol=1e-13)
    assert sum(node.kind != "const" for node in short.nodes) < len(tape.nodes) / 4


@pytest.mark.parametrize("real", ["double", "float"])
def test_an_exported_plan_has_the_tables(real, tmp_path, c_compiler):
    q = sv.coordinates("a")
    (a,) = q
    p = sv.parameters(m=2.0)
    path = sv.paths.spline(q.t, EVEN, points(EVEN, 1)[:, 0])
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, a), actuators={"F": a}, parameters=p)
    model = sv.derive(mechanism, sv.Program({"X": a - path}, by="actuators"))
    source, _ = sv.export_c(model, tmp_path, start=model.start(), real=real)
    strict = "-std=c99 -O1 -Wall -Wextra -Wconversion -Wdouble-promotion -pedantic -Werror -fPIC -shared"
    library = tmp_path / "model.so"
    subprocess.run([*shlex.split(compiler.compiler()), *strict.split(), source, "-o", library, "-lm"], check=True)
    number = ctypes.c_double if real == "double" else ctypes.c_float
    x, parameters, z, u = (np.zeros(k, number) for k in (2, 1, 3, 1))
    parameters[:] = 2.0
    run = sv.simulate(model, model.start(), t_span=(0.0, 6.0), t_eval=np.linspace(0.0, 6.0, 97))
    step = ctypes.CDLL(str(library)).model_feedforward
    for t, force in zip(run.t, run["F"], strict=True):
        assert step(number(t), *(a.ctypes.data_as(ctypes.c_void_p) for a in (x, parameters, z, u))) >= 0
        assert abs(u[0] - force) < (1e-10 if real == "double" else 1e-3) * np.abs(run["F"]).max()
    assert source.read_text(encoding="utf-8").count("static double row(") + source.read_text(encoding="utf-8").count("static float row(") == 1


# tables of data --------------------------------------------------------------------------------------------------------


def in_both_forms(monkeypatch, build):
    """The values of a builder with coefficients in sums, and with coefficients as data."""
    results = []
    for most in (10**6, 8):
        monkeypatch.setattr(paths, "MOST_SUMMED", most)
        results.append(build())
    return results


def pendulum_cart(path):
    """A cart that follows a path under a pendulum, whose motion is free."""
    q = sv.coordinates("x theta")
    x, theta = q
    p = sv.parameters(M=2.0, m=0.5, L=1.0, g=9.81)
    bob = ca.vertcat(x + p.L * ca.sin(theta), -p.L * ca.cos(theta))
    gibbs = sv.particle(q, p.M, x) + sv.particle(q, p.m, bob)
    machine = sv.Mechanism(q, gibbs=gibbs, potential=p.m * p.g * bob[1], actuators={"F": x}, parameters=p)
    return sv.derive(machine, sv.Program({"X": x - path(q.t)}, by="actuators"))


def along_a_law(s):
    times = np.linspace(0.0, 1.0, 12)
    return sv.paths.spline(s, times, np.sin(3.0 * times), 3, "natural")


def in_time(t):
    times = np.linspace(0.0, 6.0, 12)
    return sv.paths.spline(t, times, 0.2 * np.sin(times), 3)


def turning(t):
    return along_a_law(0.5 + 0.4 * ca.sin(t))


MOVING = {
    None: in_time,
    "DOP853": lambda t: along_a_law(sv.paths.rest_to_rest(t, 0.0, 1.0, 6.0, 6)),
    "RadauIIA": turning,
}


@pytest.mark.parametrize("name", PATHS)
def test_tables_of_data_equal_the_sums_at_and_between_knots(uncontracted, monkeypatch, name):
    build, knots = PATHS[name]
    t = instants(knots)[:-3]
    x, values = np.array([t[::-1], np.cos(np.arange(t.size))]), []
    for path in in_both_forms(monkeypatch, build):
        slopes = ca.vec(ca.jacobian(path, ca.vertcat(T, X)))
        f = ca.Function("f", [T, X, P], [ca.densify(ca.vertcat(path, slopes, ca.jtimes(ca.jtimes(path, T, 1.0), T, 1.0)))])
        model = compiled(f, "f")
        alone = np.hstack([model.grid(t[k : k + 7], x[:, k : k + 7], [1.5]) for k in range(0, t.size, 7)])
        by_casadi = np.array([np.asarray(f(*row)).ravel() for row in zip(t, x.T, np.full(t.size, 1.5), strict=True)]).T
        values.append((model.grid(t, x, [1.5]), alone, by_casadi))
    size = np.nanmax(np.where(np.isfinite(values[0][0]), np.abs(values[0][0]), 0.0), axis=1, keepdims=True) + 1e-300
    for one in (*values[0], *values[1]):
        np.testing.assert_allclose(one / size, values[0][0] / size, atol=1e-15)


@pytest.mark.parametrize("method", MOVING)
def test_motions_on_tables_of_data_are_those_on_sums(monkeypatch, method):
    def motion():
        model = pendulum_cart(MOVING[method])
        return sv.simulate(model, model.start(theta=0.1, dtheta=0.0), method=method, t_span=(0.0, EVEN[19]), t_eval=EVEN[:20])

    sums, data = in_both_forms(monkeypatch, motion)
    assert data.method == sums.method
    np.testing.assert_allclose(data["theta"], sums["theta"], atol=1e-12)
    np.testing.assert_allclose(data["F"], sums["F"], atol=1e-9)
    assert sv.verify(data).passed


def test_series_end_where_a_time_law_reaches_the_knots_of_a_table(monkeypatch):
    monkeypatch.setattr(paths, "MOST_SUMMED", 8)
    model = pendulum_cart(turning)
    knots = np.linspace(0.0, 1.0, 12)[1:-1]
    first = np.arcsin((knots[np.abs(knots - 0.5) < 0.4] - 0.5) / 0.4)
    expected = np.sort([*(first % (2 * np.pi)), *(np.pi - first)])
    np.testing.assert_allclose(model.reduction.switches.ends_of_pieces(model.parameters, (0.0, 2 * np.pi)), expected[expected <= 2 * np.pi], atol=1e-13)


@pytest.mark.parametrize("law", [lambda t: t, lambda t: sv.paths.rest_to_rest(t, 0.0, 6.0, 6.0, 6)])
def test_a_table_of_too_low_a_class_is_refused_as_sums_are(monkeypatch, law):
    def refusal():
        with pytest.raises(sv.errors.SpecificationError) as caught:
            model = pendulum_cart(lambda t: sv.paths.spline(law(t), EVEN[::4], np.sin(EVEN[::4]), 0, "natural"))
            sv.simulate(model, model.start(theta=0.1, dtheta=0.0), t_span=(0.0, 6.0))
        return caught.value.details

    sums, data = in_both_forms(monkeypatch, refusal)
    assert data["has"] == sums["has"] == 0
    assert data["needs"] == sums["needs"] == 2


def test_tables_travel_to_processes_that_have_not_made_them(monkeypatch):
    monkeypatch.setattr(paths, "MOST_SUMMED", 8)
    model = pendulum_cart(in_time)
    f = model.function("ode")
    here = f.grid(EVEN, np.ones((4, EVEN.size)), model.parameters)
    content = pickle.dumps(model)
    monkeypatch.setattr(lookup, "made", {})
    monkeypatch.setattr(lookup, "_contents", {})
    there = pickle.loads(content).function("ode")
    np.testing.assert_array_equal(there.grid(EVEN, np.ones((4, EVEN.size)), model.parameters), here)
    assert there.source() == f.source()


def test_a_loop_on_a_plan_with_tables_of_data_is_that_with_sums(monkeypatch):
    def closed():
        q = sv.coordinates("a")
        (a,) = q
        p = sv.parameters(m=2.0)
        machine = sv.Mechanism(q, gibbs=sv.particle(q, p.m, a), actuators={"F": a}, parameters=p)
        model = sv.derive(machine, sv.Program({"X": a - in_time(q.t)}, by="actuators"))
        plan = sv.simulate(model, model.start(), t_span=(0.0, 6.0), t_eval=np.linspace(0.0, 6.0, 301))
        plant = sv.plant(machine)
        return sv.close(plant, sv.lqr(plan, plant, rate=50.0), plan.state(0.0), (0.0, 6.0))

    sums, data = in_both_forms(monkeypatch, closed)
    np.testing.assert_allclose(data["a"], sums["a"], atol=1e-11)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 9, 10, 999, 10_001])
def test_a_process_without_the_numbers_reads_them_from_the_function(monkeypatch, n):
    rng = np.random.default_rng(n)
    entries, knots = np.rint(rng.normal(size=n) * 2.0**79), np.sort(rng.normal(size=n))
    of_entries, of_knots = lookup.Lookup.of_entries(entries), lookup.Lookup.of_knots(knots)
    monkeypatch.setattr(lookup, "_contents", {})
    np.testing.assert_array_equal(lookup.Lookup(of_entries.function).numbers, entries)
    np.testing.assert_array_equal(lookup.Lookup(of_knots.function).numbers, knots)
    s = np.concatenate([knots, np.nextafter(knots, -9.0), np.nextafter(knots, 9.0), [-1e20, 1e20]])
    by_casadi = np.array(of_knots.function.call([ca.DM(s[None])])[0]).ravel()
    np.testing.assert_array_equal(by_casadi, np.searchsorted(knots, s, "right"))


def test_a_saved_table_takes_little_more_than_its_numbers():
    def saved(n):
        return len(pickle.dumps(lookup.Lookup.of_entries(np.arange(float(n))).function))

    assert saved(40_000) - saved(20_000) < 17 * 20_000  # CasADi writes two characters for a byte


def test_what_a_derivation_holds_does_not_depend_on_the_number_of_samples():
    def sizes(n):
        times = np.linspace(0.0, 6.0, n)
        model = pendulum_cart(lambda t: sv.paths.spline(t, times, np.sin(times), 3, "natural"))
        run = sv.simulate(model, model.start(t=1.0, theta=0.1, dtheta=0.0), t_span=(1.0, 1.01))
        return len(model.reduction.switches.tape.nodes), model.function("ode").operations, run["F"][0]

    few, many = sizes(300), sizes(20_000)
    assert few[:2] == many[:2]
    np.testing.assert_allclose(few[2], many[2], rtol=1e-6)


def test_steps_end_at_knots_without_a_call_for_each(monkeypatch, c_compiler):
    knots = np.linspace(0.0, 6.0, 600)
    model = pendulum_cart(lambda t: sv.paths.spline(t, knots, np.sin(knots), 3, "natural"))
    library, ends = series_loop(model, last_index(model, sv.methods.Taylor()))._library, []
    steps = library.taylor
    monkeypatch.setattr(library, "taylor", lambda *given: ends.append(steps(*given)[1:, 0]) or steps(*given))
    start = model.start(theta=0.1, dtheta=0.0)
    run = sv.simulate(model, start, (0.0, 6.0), "Taylor", t_eval=np.linspace(0.0, 6.0, 61))
    assert np.isin(knots[1:], np.concatenate(ends)).all()
    assert len(ends) <= 1 + run.counters["steps"] // TaylorSteps.most
    assert sv.verify(run).passed



def test_an_exported_plan_holds_its_tables_of_data(monkeypatch, tmp_path, c_compiler):
    monkeypatch.setattr(paths, "MOST_SUMMED", 8)
    for real in ("double", "float"):
        (tmp_path / real).mkdir()
        test_an_exported_plan_has_the_tables(real, tmp_path / real, c_compiler)


def test_floats_count_the_places_of_a_table(monkeypatch, tmp_path):
    assert int(np.float32(export.COUNTED - 1)) == export.COUNTED - 1
    assert int(np.float32(export.COUNTED + 1)) != export.COUNTED + 1
    monkeypatch.setattr(paths, "MOST_SUMMED", 8)
    model = pendulum_cart(lambda t: sv.paths.spline(t, EVEN, np.sin(EVEN), 5))
    most = max(len(table.numbers) for table in lookup.lookups(model.signals("residuals")[1].expression))
    monkeypatch.setattr(export, "COUNTED", most)
    sv.export_c(model, tmp_path, real="float")
    monkeypatch.setattr(export, "COUNTED", most - 1)
    sv.export_c(model, tmp_path)
    with refused(sv.errors.SpecificationError, numbers=most, most=most - 1):
        sv.export_c(model, tmp_path, real="float")
