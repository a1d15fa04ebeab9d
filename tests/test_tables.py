"""Tables in C for splines: the numbers of the sums, at the cost of one piece."""

import ctypes
import re
import shlex
import subprocess
from copy import copy

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import servoctl as sv
from servoctl.codegen import compiler, emit
from servoctl.codegen import function as functions
from servoctl.codegen.function import compiled
from servoctl.jets.pieces import by_pieces
from servoctl.jets.series import Series
from servoctl.jets.tape import Tape

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
    assert source.read_text().count("static double row(") + source.read_text().count("static float row(") == 1
