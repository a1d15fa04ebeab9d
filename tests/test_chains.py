"""Short chains of operations: the same values as the given statements, of which the last follows sooner."""

import ctypes
import itertools
import re

import casadi as ca
import numpy as np
import pytest
from conftest import lean

import servoctl as sv
from servoctl import gallery
from servoctl.codegen import emit
from servoctl.codegen.chains import Constant, short_chains, time_of
from servoctl.codegen.collecting import ways
from servoctl.codegen.compiler import library
from servoctl.codegen.paths import jets_at
from servoctl.tolerances import EXTENDED

extended = pytest.mark.skipif(not EXTENDED, reason="what is compared with is computed in extended precision")

T, X, P = ca.SX.sym("t"), ca.SX.sym("x", 4), ca.SX.sym("p", 3)
SINE, COSINE = ca.sin(X[0]), ca.cos(X[0])
A, B, C = P.elements()


def function(*outputs):
    return ca.Function("f", [T, X, P], [ca.densify(ca.vertcat(*outputs))])


def statements(f, chained=True):
    dialect = emit.SCALAR_CHAINED if chained else emit.SCALAR_INLINE
    return emit._prepared(f, dialect)


def compiled(f, chained=True):
    """The function of (t, x, p) in C, as the loop of `sv.close` has it."""
    dialect = emit.SCALAR_CHAINED if chained else emit.SCALAR_INLINE
    call = library(emit.unit({"NAME": "f"}) + emit.function(f, "f", dialect), "-O1").f
    call.restype = None

    def evaluate(t, x, p):
        y = np.empty(f.numel_out(0))
        x, p = (np.array(v, dtype=float) for v in (x, p))
        call(ctypes.c_double(t), *(ctypes.c_void_p(v.ctypes.data) for v in (x, p, y)))
        return y

    return evaluate


def chain(statements):
    """Operations in the longest chain from the entries of x whose rates are computed to an output."""
    late = {"x" + target[1:] for target, _, operands in statements if isinstance(target, str) and type(operands[0]) is int}
    length = dict.fromkeys(late, 0)
    for target, _, operands in statements:
        before = [length[v] for v in operands if v in length]
        if before:
            length[target] = max(before) + isinstance(target, int)
    return max(n for target, n in length.items() if str(target).startswith("y"))


EXPRESSIONS = {
    "products of powers": X[0] * X[0] * A * X[3] * X[3] * (2 * B) * 0.5 * X[0] * X[1] * C * X[2] * X[2],
    "quotients": (X[0] / A + X[1] / A - X[2] / (A * X[0])) / (1 / X[3]),
    "signs": -(-X[0] - (A - (X[1] - 2 * (X[2] - 0.25 * X[3])))) - B,
    "sums read twice": (X[0] + X[1] + A) * X[2] - (X[0] + X[1] + A) * (X[3] - X[0] - X[1]),
    "one circle": A * X[3] * SINE**2 + B + A * X[3] * COSINE**2,
    "a unit circle": SINE**2 + COSINE**2 + SINE * SINE * X[1] + COSINE * COSINE * X[1],
    "circles of halves": 2 * A * SINE**2 + X[2] + 2 * A * COSINE**2 - 0.5 * COSINE**2 * B - 0.5 * SINE**2 * B,
    "no circle: two angles": A * SINE**2 + A * ca.cos(X[1]) ** 2,
    "no circle: a difference": A * SINE**2 - A * COSINE**2,
    "no circle: two factors": A * SINE**2 + B * COSINE**2,
    "no circle: one power": A * SINE + A * COSINE + A * SINE**3 + A * COSINE**3,
    "no circle: two sines": A * SINE**2 + A * ca.sin(X[1]) ** 2,
    "constants": 3 * (0.1 * (X[0] * 7)) / 0.3 + 0 * X[1] + 1 * X[2] - 1 * X[3] + ca.SX(2) ** 0.5,
    "branches": ca.if_else(X[0] > A, X[1] * X[2] * X[3], ca.fabs(X[1]) / ca.sqrt(X[2] * X[2] + 1)) * A * X[1],
    "many factors": ca.exp(X[1]) * ca.sumsqr(X) * np.prod([X[i % 4] + i for i in range(14)]),
    "inputs": X[2],
    "a number": ca.SX(3),
}  # fmt: skip


@pytest.mark.parametrize("name", EXPRESSIONS)
@pytest.mark.usefixtures("c_compiler")
def test_values_are_those_of_the_given_order(name):
    f = function(EXPRESSIONS[name], X[3], EXPRESSIONS[name] * X[2] - A / X[3])
    evaluate, rng = compiled(f), np.random.default_rng(len(name))
    for _ in range(20):
        x, p = rng.normal(size=4), rng.uniform(0.5, 2, 3)
        exact = np.array(f(0.3, x, p)).ravel()
        np.testing.assert_allclose(evaluate(0.3, x, p), exact, rtol=1e-14, atol=1e-13)


@pytest.mark.parametrize("circles, name", [(True, name) for name in list(EXPRESSIONS)[4:7]]
                         + [(False, name) for name in list(EXPRESSIONS)[7:12]])  # fmt: skip
def test_a_circle_needs_no_sine(circles, name):
    operations = {operation for _, operation, _ in statements(function(EXPRESSIONS[name]))}
    assert (not operations & {ca.OP_SIN, ca.OP_COS}) == circles


@pytest.mark.usefixtures("c_compiler")
def test_what_is_not_finite_stays_so():
    evaluate = compiled(function(X[0] * X[1] * X[2], X[0] / X[1], A * SINE**2 + A * COSINE**2 + X[0]))
    assert np.isinf(evaluate(0, [1e200, 1e200, 1, 1], [1, 1, 1])[0])
    for x in (np.nan, np.inf):
        assert not np.isfinite(evaluate(0, [x, 1, 1, 1], [1, 1, 1])).any()


@pytest.mark.parametrize("product", [X[3] * A * B * X[0] * C * X[3], A * B * X[0] * C * X[3] * X[3],
                                     X[3] * (X[3] * (X[0] * (A * (B * C))))])  # fmt: skip
def test_what_is_known_last_is_multiplied_and_added_last(product):
    """v' = A B C q v² + A v + q + B: the square, its factor, and two additions follow v."""
    f = function(X[2], X[3], 0, product + X[3] * A + X[0] + B)
    assert chain(statements(f)) <= 4
    f = function(X[2], X[3], 0, (((X[3] * A + X[0]) + B) + C) + X[1])
    assert (chain(statements(f, chained=False)), chain(statements(f))) == (5, 2)


SCENES = ("overhead_crane", "double_pendulum", "crane_3d", "furuta_pendulum", "rolling_disc", "slung_load", "cart_pole")


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.usefixtures("c_compiler")
def test_rates_of_plants_have_shorter_chains_and_the_same_values(scene):
    plant = sv.plant(getattr(gallery, scene)()[0])
    f = plant.function("ode").expression
    given, short = statements(f, chained=False), statements(f)
    assert chain(short) <= chain(given)
    assert len(short) < len(given) and time_of(short) < time_of(short_chains(given))
    evaluate, rng = compiled(f), np.random.default_rng(3)
    for _ in range(20):
        x, p = rng.normal(size=f.numel_in(1)), plant.p() * rng.uniform(0.5, 2, f.numel_in(2))
        exact = np.array(f(0.3, x, p)).ravel()
        np.testing.assert_allclose(evaluate(0.3, x, p), exact, rtol=0, atol=1e-12 * np.abs(exact).max())


@lean
def test_the_chain_of_the_crane_is_two_thirds():
    f = sv.plant(gallery.overhead_crane()[0]).function("ode").expression
    assert (chain(statements(f, chained=False)), chain(statements(f))) == (18, 12)


OPERATIONS = {"overhead_crane": (80, 55), "furuta_pendulum": (134, 56), "rolling_disc": (128, 59), "bicycle": (97, 58)}


@pytest.mark.parametrize("scene", OPERATIONS)
def test_like_terms_of_an_elimination_are_collected(scene):
    f = sv.plant(getattr(gallery, scene)()[0]).function("ode").expression
    before, after = OPERATIONS[scene]
    assert len(statements(f, chained=False)) >= before and len(statements(f)) <= after


@pytest.mark.parametrize("scene, number", [("overhead_crane", 2), ("double_pendulum", 2), ("crane_3d", 2), ("furuta_pendulum", 2)])
def test_the_fastest_way_is_taken(scene, number):
    """As measured, of the ways by number: 57, 48, 46, 46; 81, 74, 69, 76; 110, 103, 103, 109; 90, 82, 49, 49 ns a step."""
    f = sv.plant(getattr(gallery, scene)()[0]).function("ode").expression
    given = emit._statements(f, emit.SCALAR_CHAINED)
    times = [time_of(short_chains(way)) for way in ways(given)]
    assert times.index(min(times)) == number
    assert statements(f) == short_chains(ways(given)[number])


LIKE = {
    "cancelling products": ((A * (SINE * X[1] + COSINE * X[2]) * COSINE - A * (COSINE * X[1] - SINE * X[2]) * SINE), 2),
    "a quotient of products": (A * B * X[0] * X[1] / (B * X[0] * X[1] * X[1]), 2),
    "a quotient of equal sums": ((A + X[1]) * X[2] / ((A + X[1]) * X[3]), 2),
    "a difference of equal sums": ((A + X[1]) * X[2] - (A + X[1] - X[3]) * X[2], 1),
    "one angle": (A + B - A * COSINE**2 - B * SINE**2 - B * COSINE**2, 3),
    "a common factor": (A * X[1] * X[2] + A * X[1] * X[3] - A * X[1] * B, 4),
    "nothing": (X[0] * X[1] - X[0] * X[1], 0),
    "a product of sums": ((A + X[1]) * (B + X[2]) * (C + X[3]), 5),
}  # fmt: skip


@pytest.mark.parametrize("name", LIKE)
@pytest.mark.usefixtures("c_compiler")
def test_no_more_operations_are_left_than_needed(name):
    expression, most = LIKE[name]
    f = function(expression)
    arithmetic = [s for s in statements(f) if isinstance(s[0], int) and s[1] not in (ca.OP_SIN, ca.OP_COS)]
    assert len(arithmetic) <= most
    evaluate, rng = compiled(f), np.random.default_rng(len(name))
    for _ in range(20):
        x, p = rng.normal(size=4), rng.uniform(0.5, 2, 3)
        np.testing.assert_allclose(evaluate(0.3, x, p), np.array(f(0.3, x, p)).ravel(), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("scene", SCENES)
def test_all_ways_give_the_same_values(scene):
    """In CasADi's arithmetic, as what the lanes of a batch compute is split off expressions."""
    f = sv.plant(getattr(gallery, scene)()[0]).function("ode").expression
    rng = np.random.default_rng(4)
    x, p = rng.normal(size=f.numel_in(1)), rng.uniform(0.5, 2, f.numel_in(2))
    exact = np.array(f(0.3, x, p)).ravel()
    others = emit.other_ways(f)
    assert len(others) == len(ways(statements(f, chained=False))) - 1
    for way in others:
        values = np.array(ca.Function("way", f.sx_in(), [way])(0.3, x, p)).ravel()
        np.testing.assert_allclose(values, exact, rtol=0, atol=1e-12 * np.abs(exact).max())


IN_LONG_NUMBERS = {
    ca.OP_ADD: np.add, ca.OP_SUB: np.subtract, ca.OP_MUL: np.multiply, ca.OP_DIV: np.divide, ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square, ca.OP_TWICE: lambda a: 2 * a, ca.OP_INV: lambda a: 1 / a, ca.OP_SIN: np.sin, ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan, ca.OP_ATAN: np.arctan, ca.OP_ATAN2: np.arctan2, ca.OP_SQRT: np.sqrt, ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax, ca.OP_FABS: np.abs, ca.OP_SIGN: np.sign, ca.OP_LT: np.less, ca.OP_LE: np.less_equal,
    ca.OP_NE: np.not_equal, ca.OP_NOT: np.logical_not, ca.OP_CONSTPOW: np.power,
    ca.OP_IF_ELSE_ZERO: lambda a, b: np.where(a, b, 0.0 * b),
}  # fmt: skip


def evaluated(given, t, x, p, jets=()):
    """The outputs of statements, in the type of x and p."""
    arrays, outputs = {"x": x, "p": p, "w": jets}, {}
    values = {"t": t} | {f"{name}[{i}]": v for name, array in arrays.items() for i, v in enumerate(array)}
    for target, operation, operands in given:
        operands = [v.value if isinstance(v, Constant) else values[v] for v in operands]
        if isinstance(target, str):
            outputs[int(target[2:-1])] = operands[0] + 0 * x[0]
        else:
            values[target] = IN_LONG_NUMBERS[operation](*operands)
    return np.array([outputs[i] for i in range(len(outputs))])


@extended
@pytest.mark.parametrize("scene", (*SCENES, "planar_arm", "trailers", "bicycle", "four_bar"))
def test_collected_rates_are_as_accurate_in_all_units(scene):
    """Against extended precision, with states and parameters of all sizes."""
    plant = sv.plant(getattr(gallery, scene)()[0])
    f, rng = plant.function("ode").expression, np.random.default_rng(5)
    x = rng.normal(size=(f.numel_in(1), 2000)) * 10 ** rng.uniform(-3, 1, 2000)
    p = (plant.p() + 10.0 * (plant.p() == 0))[:, None] * 10 ** rng.uniform(-1, 1, (f.numel_in(2), 2000))
    given = statements(f, chained=False)
    exact = evaluated(given, 0.3, x.astype(np.longdouble), p.astype(np.longdouble))

    def error(some):
        errors = (np.abs(evaluated(some, 0.3, x, p) - exact) / np.abs(exact).max(axis=0)).max(axis=0).astype(float)
        return np.median(errors), np.percentile(errors, 99)

    for own, reference in zip(error(statements(f)), error(given), strict=True):
        assert own <= 2 * reference + np.finfo(float).eps


@extended
@np.errstate(all="ignore")
@pytest.mark.parametrize("scene", ("overhead-crane", "vtol", "slung-load", "beam-crane"))
def test_collected_equations_of_a_path_are_as_accurate(scene, gallery_model):
    """Against extended precision, at states near the path and at its breaks."""
    model = gallery_model(scene)
    f, nq, rng = model.function("path").expression, model.nq, np.random.default_rng(6)
    given = gallery.gallery[scene]
    run = sv.simulate(model, model.start(**given.start, guess=given.guess), given.t_span)
    t, x = run.t, run.jets[:nq] * (1 + 1e-4 * rng.normal(size=(nq, len(run.t))))
    p, r = np.broadcast_to(model.p[:, None], (len(model.p), len(t))), jets_at(f, t, model.p)
    given = emit._statements(f, emit.SCALAR)
    exact = evaluated(given, *(part.astype(np.longdouble) for part in (t, x, p, r)))
    finite = np.isfinite(exact).all(axis=0)  # elsewhere a pivot is zero
    size = np.abs(exact[:, finite]).max(axis=1, keepdims=True)
    assert finite.mean() > 0.99

    def error(some):
        off = np.abs(evaluated(some, t, x, p, r) - exact)[:, finite]
        return (off / np.where(size > 0, size, 1.0)).max(axis=0).astype(float)

    own, reference = error([*itertools.chain(*emit.by_phase(f, nq))]), error(emit._with_reciprocals(given))
    for some in (np.median, np.max):
        assert some(own) <= 2 * some(reference) + np.finfo(float).eps


def test_conditions_are_evaluated_once():
    """Derivatives of a clamped path repeat its conditions; these keep their operations, so that they change alike."""
    late, beyond = T / 3 <= 0, T / 3 > 1
    clamped = ca.if_else(late, 0, ca.if_else(beyond, 1, T / 3))
    f = function(ca.jacobian(clamped**3 * X[0], T), ca.jacobian(ca.jacobian(clamped**3, T), T) * X[1])
    given, *collected = ways(statements(f, chained=False))
    assert [operation for _, operation, _ in given].count(ca.OP_IF_ELSE_ZERO) == 11
    for some in collected:
        operations = [operation for _, operation, _ in some]
        assert operations.count(ca.OP_NE) == 0 and operations.count(ca.OP_LE) + operations.count(ca.OP_LT) == 2
        assert (operations.count(ca.OP_DIV), operations.count(ca.OP_IF_ELSE_ZERO)) == (1, 6)
        for t in (-1.0, 0.0, 1.3, 3.0, np.nextafter(3.0, 4.0), 5.0):
            x = np.array([0.3, -2.0, 0.0, 0.0])
            np.testing.assert_allclose(evaluated(some, t, x, np.ones(3)), np.array(f(t, x, 1)).ravel(), rtol=1e-14, atol=0)


def test_small_differences_keep_their_digits():
    """What is multiplied out has no differences of larger terms than before."""
    f = function((X[0] - X[1]) * (X[0] + X[1]) * A + (X[0] - X[1]) ** 2 * B, (X[0] - X[1]) * A + (X[1] - X[0]) * B,
                 1e6 * (X[1] - 1) + A * X[2] + B * X[3])
    x, p = np.array([1.0, 1.0 + 1e-12, 0, 0]), [1.0, 3.0, 1.0]
    values = [np.array(ca.Function("way", f.sx_in(), [way])(0, x, p)).ravel() for way in emit.other_ways(f)]
    d = x[0] - x[1]
    for value in values:
        np.testing.assert_allclose(value, [d * (x[0] + x[1]) + 3 * d**2, -2 * d, -1e6 * d], rtol=1e-14)


def test_a_long_function_is_left_as_it_is():
    f = function(sum(ca.sin(X[0] * k) * A * X[3] * k for k in range(emit.CHUNK)))
    assert statements(f) == statements(f, chained=False) and emit.other_ways(f) == []


def test_the_text_of_a_loop_is_always_the_same():
    f = sv.plant(gallery.crane_3d()[0]).function("ode").expression
    assert emit.emit(f, "f", ("closed",)) == emit.emit(f, "f", ("closed",))
    assert short_chains(statements(f, chained=False)) == short_chains(statements(f, chained=False))


def test_vectors_of_a_block_compute_alike():
    """Statements of several vectors alternate: those of one are those of the others, in the same order."""
    f = sv.plant(gallery.crane_3d()[0]).function("ode").expression
    text = emit.function_of_several(f, "rates", emit.LANES_INLINE, ("", "1"))
    lines = [line.strip() for line in text[text.index("{\n") :].splitlines()[2:-1]]
    one, other = lines[::2], [re.sub(r"\b([xpya])1(_?)(?=[\[\d])", r"\1\2", line) for line in lines[1::2]]
    assert len(one) == len(emit._prepared(f, emit.LANES_INLINE)) and one == other
