"""Compiled functions: emitted C against CasADi's evaluation, loops against numpy and closed forms."""

import copy
import ctypes
import gc
import itertools
import pickle
import re
import sys
import threading
import tracemalloc
import weakref

import casadi as ca
import numpy as np
import pytest
from refusals import refused

from servoctl.codegen import compiler, emit, native
from servoctl.codegen import function as functions
from servoctl.codegen.function import compiled
from servoctl.codegen.interpreted import MANY_POINTS, Interpreter
from servoctl.codegen.machine import ENOUGH, TOGETHER, Machine
from servoctl.errors import SpecificationError
from servoctl.jets.branches import contains
from servoctl.methods.runge_kutta import tableau
from servoctl.values import same

of_numpy_2 = pytest.mark.skipif(not hasattr(np, "_core"), reason="NumPy 1 has another interface: points stay with CasADi")

T, X2, P1 = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("p", 1)
RK4 = tableau("RK4")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def own_cache(cache, monkeypatch):
    """A cache of this module's own: its tests share compiled libraries among themselves only."""
    monkeypatch.setenv("SERVOCTL_CACHE", str(cache))


def function(*outputs, x=X2, p=P1):
    return ca.Function("f", [T, x, p], [ca.vertcat(*outputs)])


def pendulum(loops=()):
    return compiled(function(X2[1], -P1 * ca.sin(X2[0]) + ca.cos(T), X2[0] ** 2 + T), "pendulum", loops)


def random_function(n):
    """About n operations, values near 1, long and short lives."""
    rng = np.random.default_rng(3)
    values = [T, *ca.vertsplit(X2), P1]
    while len(values) < n:
        a, b = (values[max(0, len(values) - 1 - int(rng.exponential(life)))] for life in (40, 300))
        values.append([a + 0.3 * b, a * b / (1 + a * a), ca.sin(a) - b, ca.cos(b) * a, ca.sqrt(1 + a * a) - b / 3,
                       ca.tanh(a - b)][rng.integers(6)])
    return function(*values[-20:], *values[4::400])


# --- the emitted operations


UNARY = ("neg sq twice inv sqrt exp log expm1 log1p sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh fabs "
         "floor ceil sign not erf erfinv").split()
BINARY = ("add sub mul div pow fmin fmax fmod remainder atan2 copysign hypot lt le eq ne and or if_else_zero").split()
CONSTANTS = (np.inf, -np.inf, np.nan, -3.25, 0.1, 1 / 3, 5e-324, -1.7976931348623157e308, 6.02214076e23)
EDGES = (0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 0.7, -0.7, 2.0, -2.0, 3.0, np.inf, -np.inf, np.nan, 1e-308, 5e-324, 1e308,
         -1e308, 1e-8, 1 - 2**-53, 2**-53 - 1, 1 + 2**-52, 1e5, 700.0, -750.0)


def in_buffer(model, t, x, p):
    """Outputs (n_y,) at a point, in compiled code."""
    at, state, parameters, y, call = model.buffer()
    at[0], state[:], parameters[:] = t, x, p
    call()
    return y.copy()


def every_operation():
    """A function of all operations, their expressions, and states (2, n) at and between their edges."""
    a, b = X2[0], X2[1]
    expressions = [*(ca.SX.unary(getattr(ca, f"OP_{name.upper()}"), a) for name in UNARY),
                   *(ca.SX.binary(getattr(ca, f"OP_{name.upper()}"), a, b) for name in BINARY),
                   *(ca.SX.binary(ca.OP_CONSTPOW, a, c) for c in (2.5, -1.5, 0.5, 3, -2, 1 / 3)),
                   *(a + c for c in CONSTANTS), *CONSTANTS, T, a, P1]
    rng = np.random.default_rng(0)
    x = np.hstack([np.array(list(itertools.product(EDGES, EDGES))).T, rng.normal(size=(2, 1000)),
                   1e3 * rng.normal(size=(2, 500)), rng.uniform(-1, 1, (2, 500))])
    return expressions, x


def without_erfinv(expressions):
    """The expressions whose operations have the bits of CasADi in C."""
    other = ca.SX.unary(ca.OP_ERFINV, X2[0])
    return [e for e in expressions if not ca.is_equal(ca.SX(e), other, 2)]


def test_every_operation_equals_casadi(monkeypatch, c_compiler):
    monkeypatch.setattr(functions, "MANY_POINTS", 0)
    expressions, x = every_operation()
    f = function(*expressions)
    emitted = {f.instruction_id(k) for k in range(f.n_instructions())}
    assert {getattr(ca, f"OP_{name.upper()}") for name in (*UNARY, *BINARY, "constpow")} <= emitted
    n = x.shape[1]
    reference = np.asarray(f.map(n)(np.full((1, n), 2.5), x, np.full((1, n), 1.5)))
    model = compiled(f, "operations")
    y = model.grid(2.5, x, [1.5])
    assert model.backend == "c"
    alone = np.array([in_buffer(model, 2.5, column, [1.5]) for column in x.T]).T
    for values in (y, alone):
        for row, expected, expression in zip(values, reference, expressions, strict=True):
            np.testing.assert_array_equal(np.isnan(row), np.isnan(expected), err_msg=str(expression))
            np.testing.assert_array_max_ulp(row, expected, maxulp=2)


@pytest.mark.parametrize("with_compiler", [True, False])
def test_operations_on_many_points_at_once_have_the_bits_of_single_points(with_compiler, monkeypatch, c_compiler):
    if not with_compiler:
        monkeypatch.setenv("SERVOCTL_COMPILER", "none")
    expressions, x = every_operation()
    f, (a, b) = function(*expressions), X2.elements()
    guarded = function(ca.if_else(a > 0, b, 3.0), ca.copysign(2.0, 2.0) * a, a - a, 0.0, -0.0, T, x=X2)
    rng, n = np.random.default_rng(8), x.shape[1]
    every = f, function(*without_erfinv(expressions)), guarded, random_function(900)
    for g, p in itertools.product(every, (np.array([1.5]), rng.normal(size=(1, n)))):
        once, again, t = np.empty((g.numel_out(0), n)), np.empty((g.numel_out(0), n)), rng.normal(size=n)
        evaluator = Interpreter(g)
        for k in range(n):
            once[:, k] = evaluator._value(t[k], x[:, k], p[:, k] if p.ndim == 2 else p)
        while "_machine" not in vars(evaluator):
            evaluator.grid(t, x, p, again)
        again[:] = np.inf
        evaluator.grid(t, x, p, again)
        by_operations = with_compiler and not contains(g, ca.OP_ERFINV)
        assert isinstance(evaluator._machine, Machine) == by_operations
        np.testing.assert_array_equal(again, once)
        zeros = once == 0
        np.testing.assert_array_equal(np.signbit(again[zeros]), np.signbit(once[zeros]))


def test_a_function_is_written_for_many_points_at_once_when_many_were_evaluated():
    evaluator, y = Interpreter(random_function(50)), np.empty((21, MANY_POINTS // 2))
    t, x, p = np.zeros(y.shape[1]), np.zeros((2, y.shape[1])), np.zeros(1)
    made = []
    for _ in range(3):
        evaluator.grid(t, x, p, y)
        made.append(evaluator._machine is not None)
    assert made == [False, True, True]


@pytest.mark.parametrize("n", [1, ENOUGH - 1, ENOUGH, TOGETHER - 1, TOGETHER, TOGETHER + 1, 3 * TOGETHER + ENOUGH])
def test_a_list_of_operations_fills_what_it_is_given_and_no_more(n, c_compiler, monkeypatch):
    calls, run = [], Machine.grid
    monkeypatch.setattr(Machine, "grid", lambda self, t, *rest: (calls.append(t.size), run(self, t, *rest)))
    g, rng = random_function(60), np.random.default_rng(n)
    evaluator = Interpreter(g)
    evaluator.grid(np.zeros(MANY_POINTS), np.zeros((2, MANY_POINTS)), np.zeros(1), np.empty((21, MANY_POINTS)))
    t, x = rng.normal(size=n), rng.normal(size=(n, 2)).T  # the numbers of a point next to each other
    around = np.full((n + 2, 23), np.pi)
    evaluator.grid(t, x, np.array([0.3]), around[1:-1, 1:-1].T)
    once = np.array([evaluator._value(t[k], x[:, k].copy(), np.array([0.3])) for k in range(n)])
    np.testing.assert_array_equal(around[1:-1, 1:-1], once)
    around[1:-1, 1:-1] = np.pi
    assert np.all(around == np.pi)
    assert calls == [MANY_POINTS] + [n] * (n >= ENOUGH)


def test_constants_are_exact(monkeypatch, c_compiler):
    monkeypatch.setattr(functions, "MANY_POINTS", 0)
    model = compiled(function(*CONSTANTS), "constants")
    y = model.grid(0.0, np.zeros((2, 20)), [0.0])
    assert model.backend == "c"
    np.testing.assert_array_equal(y[:, -1], CONSTANTS)


def test_chunks_equal_one_function_and_casadi_to_the_last_bit(monkeypatch, c_compiler):
    monkeypatch.setenv("CC", "cc -ffp-contract=off")
    f = random_function(2600)
    assert emit.operations(f) > 5000
    row = np.concatenate([[0.3, 0.5, -0.7, 1.1], np.zeros(f.numel_out())])
    results = []
    for chunk in (100, emit.CHUNK, 10**9):
        text = emit.emit(f, "f", chunk=chunk)
        assert ("double w[" in text) == (chunk < 10**9)
        compiler.library(text)["f_point"](ctypes.c_void_p(row.ctypes.data))
        results.append(row[4:].copy())
    expected = np.asarray(f(0.3, [0.5, -0.7], 1.1)).ravel()
    for result in results:
        np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize("chunk", [100, 10**9])
def test_phases_equal_one_function_to_the_last_bit_after_other_corrections(monkeypatch, c_compiler, chunk):
    monkeypatch.setenv("CC", "cc -ffp-contract=off")
    f = random_function(2600)
    text = emit.emit(f, "f", ("newton",), chunk=chunk) + """
void f_again(double t, const double *x, const double *other, const double *p, double *y)
{
    double w[WORK];
    f_instant(t, x, p, y, w);
    f_correction(t, other, p, y, w);
    f_correction(t, x, p, y, w);
    f_rest(t, x, p, y, w);
}
"""
    library, x, other, p, y = compiler.library(text), *map(np.array, ([0.5, -0.7], [3.0, 1e200], [1.1])), np.zeros(f.numel_out())
    library.f_again(ctypes.c_double(0.3), *(ctypes.c_void_p(a.ctypes.data) for a in (x, other, p, y)))
    np.testing.assert_array_equal(y, np.asarray(f(0.3, x, p)).ravel())
    np.testing.assert_array_equal(in_buffer(compiled(f, "f", ("rk",)), 0.3, x, p), y)


@pytest.mark.parametrize(("name", "share"), [("overhead-crane", 0.27), ("crane-3d", 0.2), ("slung-load", 0.26)])
def test_a_newton_correction_takes_few_of_the_operations_of_a_point(gallery_model, name, share):
    f = gallery_model(name).function("path")
    text = emit.phases(f.expression, "f", emit.by_phase(f.expression, f.n_x), chunk=10**9)
    body = dict(zip(emit.PHASES, re.split(r"void f_\w+\(", text)[1:], strict=True))
    lines = {phase: body[phase].count("const double a") for phase in emit.PHASES}
    every = sum(lines.values())
    assert lines["correction"] < share * every and every < 0.85 * f.operations
    assert not re.search(r"\bt [-+*/]|\(t\b", body["correction"].split("\n", 1)[1]), "nothing of t alone is repeated"


def test_the_work_vector_uses_its_places_again():
    text = emit.emit(random_function(2000), "f", chunk=100)
    places = int(text.split("double w[")[1].split("]")[0])
    assert places < text.count("    w[") / 2


def test_operations_counts_arithmetic_only():
    a, b = X2[0], X2[1]
    assert emit.operations(function(a, 3.0, T)) == 0
    assert emit.operations(function(a * b + ca.sin(T) - 2.0 * P1, b)) == 5


def test_text_depends_on_content_only():
    f = random_function(500)
    again = ca.Function.deserialize(f.serialize())
    assert emit.emit(f, "f", ("rk",)) == emit.emit(again, "f", ("rk",))


def test_an_operation_without_c_is_named():
    with refused(SpecificationError, operation="OP_PRINTME"):
        compiled(function(X2[0].printme(X2[1])), "talkative")
    with refused(SpecificationError, operation="OP_PRINTME"):
        compiled(function(X2), "quiet", ("rk",), function(X2[0].printme(X2[1])))


# --- points and grids


def test_point_and_grid_agree_in_both_backends(backend):
    model = pendulum()
    rng = np.random.default_rng(1)
    n = 201
    t, x, p = rng.normal(size=n), rng.normal(size=(2, n)), rng.normal(size=(1, n))
    expected = np.array([x[1], -p[0] * np.sin(x[0]) + np.cos(t), x[0] ** 2 + t])
    np.testing.assert_allclose(model.grid(t, x, p), expected, rtol=1e-15, atol=1e-15)
    assert model.backend == backend
    np.testing.assert_allclose(model.grid(t, x, p[:, 0])[0], expected[0])
    np.testing.assert_allclose(model.grid(0.5, x, p)[2], x[0] ** 2 + 0.5)
    columns = np.array([model(t[k], x[:, k], p[:, k]) for k in range(5)]).T
    np.testing.assert_allclose(columns, expected[:, :5], rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(model(1, [1, 2], [3]), model(1.0, np.array([1.0, 2.0]), np.array([3.0])))


def test_each_call_returns_its_own_array(backend):
    model = pendulum()
    first = model(0.0, np.array([0.1, 0.2]), np.array([1.0]))
    kept = first.copy()
    model(1.0, np.array([3.0, 4.0]), np.array([1.0]))
    np.testing.assert_array_equal(first, kept)


def often(monkeypatch, model, t=0.0):
    """The model after so many calls that its points are compiled."""
    monkeypatch.setattr(functions, "CALLS", model._calls + 1)
    model(t, np.zeros(model.n_x), np.zeros(model.n_p))
    return model


def test_points_of_a_function_called_often_are_compiled_with_the_bits_of_casadi(monkeypatch, c_compiler):
    expressions, x = every_operation()
    a, b = X2[0], X2[1]
    sums = a * b + P1, T * b - a * a, a / (b + 3) + T / (b + 3), ca.sin(a * b) ** 2 + ca.cos(a * b) ** 2, a**2.0 * b
    for f in (function(*without_erfinv([*expressions, *sums])), random_function(1500)):
        model, n = compiled(f, "points"), x.shape[1]
        reference = np.asarray(f.map(n)(np.full((1, n), 2.5), x, np.full((1, n), 1.5)))
        often(monkeypatch, model)
        assert model._builtin
        y = np.array([model(2.5, column, np.array([1.5])) for column in x.T.copy()]).T
        np.testing.assert_array_equal(y, reference)
        np.testing.assert_array_equal(np.signbit(y[y == 0]), np.signbit(reference[y == 0]))


@of_numpy_2
def test_compiled_points_take_what_others_take(monkeypatch, c_compiler):
    model, many = pendulum(), np.array([[0.3, 9.0, 1.2], [8.0, 7.0, 6.0]])
    forms = [(2.0, many[0, ::2], [1.5]), (2, [0.3, 1.2], (1.5,)), (np.float64(2), np.float64([0.3, 1.2]), np.ones(1) * 1.5),
             (np.array(2.0), many[:1, ::2].ravel(), np.array(["1.5"])), (True + 1, (0.3, 1.2), np.array([1.5], ">f8")),
             (2.0, np.array([0.3, 1.2]), np.frombuffer(b"-" + np.float64(1.5).tobytes(), offset=1))]  # not aligned
    before = [model(*form) for form in forms]
    often(monkeypatch, model)
    assert model._builtin
    for form, y in zip(forms, before, strict=True):
        np.testing.assert_array_equal(model(*form), y)
    whole = np.array([1, 2])  # not numbers of double precision, of the same size
    np.testing.assert_array_equal(model(0.0, whole, [1.0]), compiled(model.expression, "other")(0.0, whole, [1.0]))
    first, second = model(0.0, [0.1, 0.2], [1.0]), model(0.0, [0.3, 0.4], [1.0])
    assert first.flags.owndata and not np.shares_memory(first, second)
    for x, p in (([0.1], [1.0]), (np.zeros((2, 1)), [1.0]), (np.zeros(2), np.zeros(2))):
        with refused(SpecificationError):
            model(0.0, x, p)
    copied = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(copied(*forms[0]), before[0])
    assert model == copied == model and same([model], [copied]) and same(copied, model)


def test_arrays_of_every_kind_reach_compiled_points(monkeypatch, c_compiler):
    class Own(np.ndarray):
        pass

    class Emptying:  # shrinks the array beside it when it is read as a number
        def __float__(self):
            x.resize(0, refcheck=False)
            return 2.0

    model, x, p = often(monkeypatch, pendulum()), np.array([0.3, 1.2]), np.array([1.5])
    y, grid = model(2.0, x, p), np.array([[0.3, 1.2], [7.0, 8.0]])
    swapped, read_only = x.astype(">f8"), x.copy()
    read_only.flags.writeable = False
    forms = (x.view(Own), read_only, pickle.loads(pickle.dumps(x)), swapped, x.astype(np.dtype("f8").newbyteorder("=")),
            x[::-1].copy()[::-1], np.asfortranarray(grid)[0], grid[0], np.broadcast_to(x, (1, 2))[0], x.astype(np.longdouble),
            x.astype(np.dtype("f8", metadata={"unit": "m"})), x.astype(object), memoryview(x), x.view("V8").view(float))
    for form in forms:
        assert type(result := model(2.0, form, p)) is np.ndarray
        np.testing.assert_array_equal(result, y)
    result = model(p=p, t=2.0, x=x)
    np.testing.assert_array_equal(result, y)
    assert result.flags.owndata and result.flags.carray and result.dtype is y.dtype and result.dtype == float
    assert np.isfinite(model(-1.0, x, p)).all()  # as the C function gives an error of Python
    for arguments in ((2.0, x.astype(np.float32)[:1], p), (2.0, grid, p), (2.0, x, p[:0])):
        with refused(SpecificationError):
            model(*arguments)
    for arguments in ((2.0, x), (2.0, x, p, p), ("two", x, p), (None, x, p)):
        with pytest.raises((TypeError, ValueError)):
            model(*arguments)
    with refused(SpecificationError):
        model(Emptying(), x, p)


def test_compiled_points_leave_no_reference_behind(monkeypatch, c_compiler):
    model, t, x, p = often(monkeypatch, pendulum()), 1.25, np.array([0.3, 1.2]), np.array([1.5])
    kept = (t, x, p, x.dtype, np.ndarray, model, model._builtin)
    before = [sys.getrefcount(one) for one in kept]
    y = model(t, x, p)
    assert sys.getrefcount(y) == 2
    del y
    tracemalloc.start()
    for _ in range(1000):
        model(t, x, p)
        model(t, [0.3, 1.2], p)
    start = tracemalloc.get_traced_memory()[0]
    for _ in range(20_000):
        model(t, x, p)
    grown = tracemalloc.get_traced_memory()[0] - start
    tracemalloc.stop()
    assert [sys.getrefcount(one) for one in kept] == before
    assert grown < 20_000
    gone = weakref.ref(model)
    del model, kept
    gc.collect()
    assert gone() is None


@of_numpy_2
@pytest.mark.parametrize("missing", ["table", "version", "header"])
def test_points_stay_with_casadi_where_numpy_is_another(monkeypatch, c_compiler, missing):
    if missing == "table":
        monkeypatch.delattr(np._core._multiarray_umath, "_ARRAY_API")
    monkeypatch.setattr(native, "_ABI", native._ABI + (missing == "version"))
    monkeypatch.setattr(native, "_HEADER", native._HEADER + 8 * (missing == "header"))
    model = often(monkeypatch, pendulum())
    assert not model._builtin
    np.testing.assert_array_equal(model(2.0, [0.3, 1.2], [1.5]), pendulum()(2.0, [0.3, 1.2], [1.5]))


def test_points_stay_with_casadi_without_a_compiler_or_a_function_of_c(monkeypatch, c_compiler):
    other = often(monkeypatch, compiled(function(ca.SX.unary(ca.OP_ERFINV, X2[0]), X2[1]), "other"))
    monkeypatch.setenv("SERVOCTL_COMPILER", "none")
    for model in (other, often(monkeypatch, pendulum())):
        assert not model._builtin
        assert np.isfinite(model(0.0, [0.5, 0.1], [1.0])).all()


def test_a_buffer_is_written_called_and_read(backend):
    model = pendulum()
    t, x, p, y, call = model.buffer()
    for now in (0.0, 0.4):
        t[0], x[:], p[:] = now, (0.3, -0.2), 2.0
        call()
        kept = y.copy()
        np.testing.assert_allclose(kept, model(now, [0.3, -0.2], [2.0]), rtol=1e-15)
    assert model.backend == backend


def test_empty_state_and_parameters(backend):
    model = compiled(function(T**2, 1.0, x=ca.SX.sym("x", 0), p=ca.SX.sym("p", 0)), "of_time")
    assert model.n_x == model.n_p == 0
    np.testing.assert_array_equal(model(3.0, [], []), [9.0, 1.0])
    t = np.linspace(0, 1, 201)
    np.testing.assert_array_equal(model.grid(t, np.empty((0, t.size)), []), [t**2, np.ones(t.size)])
    assert model.backend == backend


def test_threads_do_not_share_memory(backend):
    model = pendulum(("rk",))
    model.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    wrong = []

    def work(k):
        x, p = np.array([k, -k], dtype=float), np.array([2.0])
        expected = [-k, -2 * np.sin(k) + np.cos(k), k * k + k]
        wrong.extend(y for _ in range(2000) if not np.allclose(y := model(float(k), x, p), expected, rtol=1e-14))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert model.backend == backend
    assert not wrong


@pytest.mark.parametrize("call", [
    lambda m: m(0.0, [1.0], [1.0]), lambda m: m(0.0, [[1.0], [2.0]], [1.0]), lambda m: m(0.0, [1.0, 2.0], []),
    lambda m: m.grid([0.0, 1.0], np.zeros((2, 3)), [1.0]), lambda m: m.grid(0.0, np.zeros((3, 2)), [1.0]),
    lambda m: m.grid(0.0, np.zeros((2, 3)), np.zeros((1, 2))), lambda m: m.rk(0.0, [1.0], 0.1, 5, [1.0], RK4),
    lambda m: m.rk(0.0, [1.0, 0.0], 0.1, -1, [1.0], RK4), lambda m: m.rk(0.0, [1.0, 0.0], 0.1, 5, [1.0], RK4, every=0),
    lambda m: m.continuation([0.0], [1.0, 0.0], [1.0], 1.0, 1),
])
def test_wrong_arguments_are_refused(call):
    with pytest.raises(SpecificationError):
        call(pendulum(("rk",)))


# --- Runge-Kutta


def numpy_rk4(t, x, h, n, p):
    def rate(t, x):
        return np.array([x[1], -p * np.sin(x[0]) + np.cos(t)])
    states = [x]
    for k in range(n):
        tk = t + k * h
        k1 = rate(tk, x)
        k2 = rate(tk + h / 2, x + h / 2 * k1)
        k3 = rate(tk + h / 2, x + h / 2 * k2)
        k4 = rate(tk + h, x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(x)
    return np.array(states).T


def test_rk_equals_a_numpy_loop(backend):
    model = pendulum(("rk",))
    expected = numpy_rk4(0.2, np.array([0.5, -0.1]), 0.01, 300, 9.81)
    t, x, guards = model.rk(0.2, [0.5, -0.1], 0.01, 300, [9.81], RK4)
    assert model.backend == backend
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(t, 0.2 + 0.01 * np.arange(301))
    np.testing.assert_allclose(guards, [x[0] ** 2 + t], rtol=0, atol=1e-14)


@pytest.mark.parametrize(("n", "every", "logged"), [(10, 3, [0, 3, 6, 9, 10]), (9, 3, [0, 3, 6, 9]), (2, 5, [0, 2]),
                                                    (0, 1, [0])])
def test_rk_logs_the_start_every_few_steps_and_the_end(backend, n, every, logged):
    model = pendulum(("rk",))
    t, x, guards = model.rk(1.0, [0.3, 0.0], 0.1, n, [2.0], RK4, every=every)
    t_all, x_all, guards_all = model.rk(1.0, [0.3, 0.0], 0.1, n, [2.0], RK4)
    np.testing.assert_array_equal(t, t_all[logged])
    np.testing.assert_array_equal(x, x_all[:, logged])
    np.testing.assert_array_equal(guards, guards_all[:, logged])


def test_rk_has_order_4():
    model = pendulum(("rk",))
    steps = 2 ** np.arange(5, 10)
    fine = model.rk(0.0, [1.0, 0.0], 2.0 / 2**14, 2**14, [4.0], RK4, every=2**14)[1][:, -1]
    errors = [np.abs(model.rk(0.0, [1.0, 0.0], 2.0 / n, n, [4.0], RK4)[1][:, -1] - fine).max() for n in steps]
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert abs(order - 4.0) < 0.1


def test_rk_ends_at_the_last_finite_state(backend):
    model = compiled(function(X2[0] ** 2, 1.0), "escape", ("rk",))
    t, x, guards = model.rk(0.0, [1.0, 0.0], 0.01, 1000, [0.0], RK4)
    assert 1.0 < t[-1] < 1.2
    assert np.isfinite(x).all() and x.shape == (2, t.size) and guards.shape == (0, t.size)
    t, x, _ = model.rk(0.0, [1.0, 0.0], 0.01, 1000, [0.0], RK4, every=50)
    assert t[-1] == 1.0 and np.isfinite(x).all()
    assert model.rk(0.0, [np.nan, 0.0], 0.01, 1000, [0.0], RK4)[1].shape == (2, 0)


# --- Newton along a path


def newton_model(residual, x, name, *others, pivots=0):
    jacobian = ca.jacobian(residual, x)
    delta, rate = -ca.solve(jacobian, residual), -ca.solve(jacobian, ca.jacobian(residual, T))
    second = ca.jacobian(rate, T) + ca.jtimes(rate, x, rate)
    return compiled(function(delta, rate, second, *others, x=x), name, ("newton",), sizes={"pivots": pivots})


def along(model, t, x0, p, most=4000):
    """Solutions at t (N,), outputs there, and all evaluations, from x0 at t[0]."""
    span = [t[0], t[-1]] if t[0] != t[-1] else [t[0]]
    nodes, first = model.continuation(span, x0, p, abs(t[-1] - t[0]) / 50, most)
    if not len(nodes):
        return np.empty((model.n_x, 0)), np.empty((model.n_y, 0)), first
    solved = t[np.abs(t - t[0]) <= abs(nodes[-1, 0] - t[0])]
    z, second = model.newton(solved, nodes, p)
    x = z[: model.n_x]
    return x, np.concatenate([np.zeros_like(x), z[model.n_x :]]), first + second


def test_newton_on_a_cubic(backend):
    x = ca.SX.sym("x")
    model = newton_model(x**3 + P1 * x - ca.sin(T), x, "cubic", x**2)
    t = np.linspace(0, 10, 501)
    solution, y, iterations = along(model, t, [0.3], [3.0])
    assert model.backend == backend
    expected = 2 * np.sinh(np.arcsinh(np.sin(t) / 2) / 3)
    np.testing.assert_allclose(solution[0], expected, rtol=0, atol=4e-16)
    np.testing.assert_allclose(y[1], np.cos(t) / (3 * expected**2 + 3), rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(y[3], expected**2, rtol=1e-14, atol=1e-15)
    assert iterations <= 4 * t.size


def test_newton_on_three_equations(backend):
    x = ca.SX.sym("x", 3)
    path = ca.vertcat(ca.cos(T), 2 + ca.sin(2 * T), ca.exp(-T))

    def mixed(v):
        return ca.vertcat(v[0] + v[1] ** 2, v[1] * v[2] - v[0], v[2] + v[0] * v[1] / 5)

    model = newton_model(mixed(x) - mixed(path), x, "three")
    t = np.linspace(0, 2, 101)
    solution, y, _ = along(model, t, [1.1, 1.9, 0.9], [0.0])
    np.testing.assert_allclose(solution, [np.cos(t), 2 + np.sin(2 * t), np.exp(-t)], rtol=0, atol=1e-14)
    np.testing.assert_allclose(y[3:6], [-np.sin(t), 2 * np.cos(2 * t), -np.exp(-t)], rtol=0, atol=1e-12)


def test_newton_halves_a_step_that_is_too_long(backend):
    x = ca.SX.sym("x")
    model = newton_model(ca.atan(x - 50 * ca.sin(T)), x, "narrow")       # Newton converges within 1.39 of the root only
    t = np.arange(0.0, 6.0, 0.5)
    solution, _, iterations = along(model, t, [0.1], [0.0])
    np.testing.assert_allclose(solution[0], 50 * np.sin(t), rtol=0, atol=1e-13)
    assert iterations > 10 * t.size


@pytest.mark.parametrize("count", (41, 401))  # the end within a block of instants solved together, too
def test_newton_keeps_what_it_solved_where_the_solution_ends(backend, count):
    x = ca.SX.sym("x")
    model = newton_model(x**2 - (1 - T), x, "fold")
    t = np.linspace(0, 2, count)
    solution, y, _ = along(model, t, [0.9], [0.0])
    solved = int(np.sum(t < 1 - 1e-9))
    assert solution.shape[1] in (solved, solved + 1) and y.shape == (3, solution.shape[1])
    exact = np.sqrt(1 - t[:solved])
    assert np.all(np.abs(solution[0, :solved] - exact) <= 1e-15 / exact)
    assert along(model, t, [np.nan], [0.0])[0].shape == (1, 0)
    assert along(model, t, [1e12], [0.0])[0].shape == (1, 0)


def test_both_backends_count_the_same_iterations(monkeypatch, c_compiler):
    x = ca.SX.sym("x")
    t = np.arange(0.0, 6.0, 0.5)
    results = []
    for chosen in ("", "none"):
        monkeypatch.setenv("SERVOCTL_COMPILER", chosen)
        monkeypatch.setattr(compiler, "_warned", True)
        model = newton_model(ca.atan(x - 50 * ca.sin(T)), x, "narrow")
        results.append((along(model, t, [0.1], [0.0])[2], model.backend))
    (in_c, _), (in_python, _) = results
    assert [backend for _, backend in results] == ["c", "casadi"]
    assert abs(in_c - in_python) <= 0.02 * in_c


# --- moving elsewhere


def test_pickles_and_copies(backend):
    model = pendulum(("rk",))
    t, x, guards = model.rk(0.0, [0.1, 0.0], 0.1, 5, [1.0], RK4)
    for other in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        assert (other.name, other.loops, other.n_x, other.n_p, other.n_y) == ("pendulum", ("rk",), 2, 1, 3)
        np.testing.assert_array_equal(other.rk(0.0, [0.1, 0.0], 0.1, 5, [1.0], RK4)[1], x)
        assert other.backend == backend
        assert repr(other) == repr(model)


def test_a_copy_knows_its_operations_without_counting(monkeypatch):
    """Which method suits a model is decided by them, in each process."""
    model = pendulum(("rk",))
    content = pickle.dumps(model)
    monkeypatch.setattr(emit, "operations", None)
    assert pickle.loads(content).operations == model.operations > 0
