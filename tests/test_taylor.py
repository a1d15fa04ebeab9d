"""Taylor arithmetic: total derivatives against nested differentiation and mpmath, sizes of terms, cost, refusals."""

from math import factorial

import casadi as ca
import mpmath
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import SpecificationError
from servoctl.jets.series import Series, _Grouped
from servoctl.jets.tape import REAL, Tape, evaluate
from servoctl.methods.taylor import taylor_coefficients
from servoctl.spec.coordinates import coordinates

RNG = np.random.default_rng(31)
DEEPEST = 6

UNARY = {
    "sin": lambda x, y: ca.sin(x * y),
    "cos": lambda x, y: ca.cos(x - 2 * y),
    "sin and cos of one argument": lambda x, y: ca.sin(x * y) * ca.cos(x * y) + ca.cos(x * y) ** 2,
    "tan": lambda x, y: ca.tan(x * y),
    "asin": lambda x, y: ca.asin(x * y / 2),
    "acos": lambda x, y: ca.acos(x * y / 2),
    "atan": lambda x, y: ca.atan(x - y**2),
    "sinh": lambda x, y: ca.sinh(x * y) + y * ca.cosh(x * y),
    "cosh": lambda x, y: ca.cosh(x + y) / y,
    "tanh": lambda x, y: ca.tanh(x - y),
    "asinh": lambda x, y: ca.asinh(x * y),
    "acosh": lambda x, y: ca.acosh(2 + x * y),
    "atanh": lambda x, y: ca.atanh(x * y / 3),
    "exp": lambda x, y: ca.exp(x * y),
    "log": lambda x, y: ca.log(x + y**2),
    "expm1": lambda x, y: ca.expm1(x * y),
    "log1p": lambda x, y: ca.log1p(x * y),
    "sqrt": lambda x, y: ca.sqrt(1 + x * y),
    "erf": lambda x, y: ca.erf(x * y),
    "square": lambda x, y: (x * y) ** 2,
    "negative": lambda x, y: -(x**2) - y,
    "twice": lambda x, y: 2 * (x * y),
    "inverse": lambda x, y: 1 / (x + y),
}
BINARY = {
    "integer power": lambda x, y: (x + y) ** 7,
    "negative integer power": lambda x, y: (x + y) ** -3,
    "real power": lambda x, y: (x * y) ** 1.5,
    "negative real power": lambda x, y: (x**2 + y**2) ** -2.5,
    "power of an expression": lambda x, y: x ** (y + 1),
    "constant to a power": lambda x, y: 2.5 ** (x * y),
    "quotient": lambda x, y: (x - y) / (1 + x * y),
    "constant by an expression": lambda x, y: 3 / (x * y),
    "product": lambda x, y: x * y * (x + y),
    "atan2": lambda x, y: ca.atan2(x * y, x - 3 * y),
    "hypot": lambda x, y: ca.hypot(x, x * y),
    "fabs, negative inside": lambda x, y: ca.fabs(x - 5 * y) * y,
    "fabs, positive inside": lambda x, y: ca.fabs(x + 5 * y) * y,
    "fmin": lambda x, y: ca.fmin(x**2, 5 + y),
    "fmin, second": lambda x, y: ca.fmin(5 + x**2, y**3),
    "fmax": lambda x, y: ca.fmax(x**2, 5 + y**2),
    "if_else, true": lambda x, y: ca.if_else(x > -1, x * y, x - y),
    "if_else, false": lambda x, y: ca.if_else(x * y < -1, x * y, ca.sin(x - y)),
    "logic": lambda x, y: ca.if_else(ca.logic_and(x > 0, ca.logic_not(y > 9)), x * y**2, x - y),
    "logic or, equal, not equal": lambda x, y: ca.if_else(ca.logic_or(x == 9, y != 9), x**2 * y, x),
    "sign": lambda x, y: ca.sign(x - 9) * x * y,
}
OPERATIONS = UNARY | BINARY


def nested(q, expression, k):
    """The k-th total derivative by k nested directional derivatives."""
    for _ in range(k):
        level = max(q.order(expression), 0)
        jets = ca.vertcat(*q, *(s for j in range(1, level + 1) for s in q.gamma(j)), q.t)
        rates = ca.vertcat(*(s for j in range(1, level + 2) for s in q.gamma(j)), 1)
        expression = ca.jtimes(expression, jets, rates)
    return expression


def numbers(expressions, values):
    """Values of SX expressions for a dict from symbol names to numbers."""
    expressions = ca.vertcat(*expressions)
    symbols = ca.symvar(expressions)
    return np.array(ca.Function("f", symbols, [expressions])(*(values[s.name()] for s in symbols))).ravel()


def jets_at_random(q, level, rng, low=0.4, high=1.1):
    names = ["t", *(name for k in range(level + 1) for name in q.jet_names(k))]
    return dict(zip(names, rng.uniform(low, high, len(names)), strict=True))


def operations(expression):
    """Arithmetic operations after elimination of common sub-expressions."""
    expression = ca.cse(expression)
    f = ca.Function("f", [ca.vertcat(*ca.symvar(expression))], [expression])
    return sum(
        f.instruction_id(k) not in (ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST) for k in range(f.n_instructions())
    )  # fmt: skip


def curvature(q):
    (dx, dy), (ddx, ddy) = q.d(1), q.d(2)
    return (dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5


@pytest.mark.parametrize("name", OPERATIONS)
def test_derivatives_equal_nested_differentiation(name):
    q = coordinates("x y")
    expression = OPERATIONS[name](*q) * (1 + q.t / 3)
    levels = [level[0] for level in q.derivatives([expression], DEEPEST)]
    reference = [nested(q, expression, k) for k in range(DEEPEST + 1)]
    rng = np.random.default_rng(2 + len(name))
    for _ in range(3):
        values = jets_at_random(q, DEEPEST, rng)
        found, expected = numbers(levels, values), numbers(reference, values)
        assert np.all(np.isfinite(expected))
        assert found == pytest.approx(expected, rel=1e-13, abs=1e-13 * np.abs(expected).max())
    assert numbers([q.dt(expression, DEEPEST)], values) == pytest.approx(found[-1:], rel=1e-15)


def test_derivatives_of_a_deep_composition():
    q = coordinates("x y")
    x, y = q
    dx, dy = q.d(1)
    expression = ca.sqrt(1 + ca.exp(ca.sin(x * dy)) ** 2) / (1 + ca.atan2(dx, y) ** 2) - ca.log(ca.cosh(x - q.t * y))
    levels = [level[0] for level in q.derivatives([expression], DEEPEST)]
    values = jets_at_random(q, DEEPEST + 1, RNG)
    expected = numbers([nested(q, expression, k) for k in range(DEEPEST + 1)], values)
    assert numbers(levels, values) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize(
    ("casadi", "exact"),
    [
        (lambda t: ca.exp(ca.sin(3 * t)), lambda t: mpmath.exp(mpmath.sin(3 * t))),
        (lambda t: ca.sqrt(1 + t**2) * ca.atan(2 * t), lambda t: mpmath.sqrt(1 + t**2) * mpmath.atan(2 * t)),
        (lambda t: ca.atan2(ca.sin(t), 1 + t**2), lambda t: mpmath.atan2(mpmath.sin(t), 1 + t**2)),
        (lambda t: ca.erf(t) * ca.tan(t / 2), lambda t: mpmath.erf(t) * mpmath.tan(t / 2)),
        (lambda t: (1 + t) ** -2.5 + (2 + t) ** 9, lambda t: (1 + t) ** mpmath.mpf(-2.5) + (2 + t) ** 9),
        (lambda t: ca.acosh(2 + t) / ca.tanh(1 + t), lambda t: mpmath.acosh(2 + t) / mpmath.tanh(1 + t)),
        (lambda t: ca.log1p(t) * ca.asin(t / 2), lambda t: mpmath.log(1 + t) * mpmath.asin(t / 2)),
    ],
)
def test_derivatives_to_order_16_against_mpmath(casadi, exact):
    q = coordinates("x")
    levels = [level[0] for level in q.derivatives([casadi(q.t)], 16)]
    with mpmath.workdps(60):
        expected = [float(c) * factorial(k) for k, c in enumerate(mpmath.taylor(exact, mpmath.mpf(0.6), 16))]
    assert numbers(levels, {"t": 0.6}) == pytest.approx(expected, rel=1e-12)


def quaternion():
    names = coordinates("e0 e1 e2 e3")
    e0, e1, e2, e3 = names
    V = [[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]]
    e = ca.vertcat(*names)
    V = [[v / 2 for v in row] for row in V]
    return names.with_quasi_velocities("p q r", V, invariants={"unit": ca.dot(e, e) - 1})


def test_quaternion_with_body_rates_keeps_its_norm_at_every_order():
    q = quaternion()
    assert (q.nq, q.n, len(q)) == (4, 3, 4)
    e = ca.vertcat(*q)
    levels = [level[0] for level in q.derivatives([ca.dot(e, e) - 1], 10)]
    rng = np.random.default_rng(8)
    values = jets_at_random(q, 10, rng)
    unit = rng.normal(size=4)
    values |= dict(zip(q.names, unit / np.linalg.norm(unit), strict=True))
    sizes = np.abs(numbers([level[0] for level in q.derivatives([e[0] ** 2 + 1], 10)], values))
    assert np.all(np.abs(numbers(levels, values)) < 1e-13 * np.maximum(1, sizes))


def test_quasi_velocities_follow_the_kinematics():
    """q' = V w + h by nested differentiation along V w + h."""
    plain = coordinates("x y psi")
    _, y, psi = plain
    V = [[ca.cos(psi), 0], [ca.sin(psi), ca.sin(plain.t)], [0, 1 + y**2]]
    q = plain.with_quasi_velocities("u r", V, h=(plain.t**2, ca.cos(psi), 0.3))
    x, y, psi = q
    u, r = q.w()
    expression = x * ca.sin(psi) * u + y * psi**2 * r + q.t
    levels = [level[0] for level in q.derivatives([expression], 5)]
    reference, rate = [expression], q.V @ ca.vertcat(u, r) + q.h
    for _ in range(5):
        e, level = reference[-1], max(q.order(reference[-1]), 1)
        jets = ca.vertcat(*q, *(s for k in range(1, level + 1) for s in q.gamma(k)), q.t)
        rates = ca.vertcat(rate, *(s for k in range(2, level + 2) for s in q.gamma(k)), 1)
        reference.append(ca.jtimes(e, jets, rates))
    values = jets_at_random(q, 7, np.random.default_rng(12))
    assert numbers(levels, values) == pytest.approx(numbers(reference, values), rel=1e-13)
    rates = [numbers(q.d(k), values) for k in (0, 1, 2, 3)]
    assert rates[1] == pytest.approx(numbers([rate], values), rel=1e-15)
    assert rates[3] == pytest.approx(numbers([q.dt(ca.vertcat(*q), 3)], values), rel=1e-15)


def test_derivative_of_a_column_keeps_its_shape():
    q = coordinates("x y")
    x, y = q
    assert q.dt(ca.vertcat(x, x * y)).shape == (2, 1)
    assert q.dt(ca.horzcat(x, y, x * y)).shape == (1, 3)
    matrix = q.dt(ca.SX([[0, 1], [0, 0]]) * x + y)
    assert matrix.shape == (2, 2)
    values = {"dx": 2.0, "dy": 3.0}
    assert numbers([ca.vec(matrix)], values) == pytest.approx([3, 3, 5, 3])
    assert q.dt(x**2, 0).is_zero() is False
    assert numbers([q.dt(x**2, 0)], {"x": 3.0}) == pytest.approx([9.0])


@pytest.mark.parametrize("name", OPERATIONS)
def test_series_on_numbers_equal_series_on_symbols(name):
    q = coordinates("x y")
    tape = Tape(list(q), [OPERATIONS[name](*q)])
    rng = np.random.default_rng(5)
    coefficients = rng.uniform(0.4, 1.1, (2, 7, 11)).astype(np.longdouble)
    symbols = [[ca.SX.sym(f"c{i}{k}") for k in range(7)] for i in range(2)]
    outputs = []
    for inputs in (symbols, [list(c) for c in coefficients]):
        series = Series(tape, inputs)
        for _ in range(7):
            series.advance()
        outputs.append(series.outputs[0])
    flat = [s for row in symbols for s in row]
    f = ca.Function("f", [ca.vertcat(*flat)], [ca.vertcat(*outputs[0])])
    expected = np.array(f.map(11)(coefficients.reshape(14, 11).astype(float)))
    found = np.array([np.broadcast_to(c, 11) for c in outputs[1]]).astype(float)
    assert found == pytest.approx(expected, rel=1e-13, abs=1e-13 * np.abs(expected).max())


def test_replacing_the_last_coefficient_equals_giving_it_at_once():
    q = coordinates("x y")
    tape = Tape(list(q), [OPERATIONS["quotient"](*q), OPERATIONS["atan2"](*q)])
    rng = np.random.default_rng(6)
    exact, wrong = rng.uniform(0.4, 1.1, (2, 2, 4, 3))
    wrong[:, :3] = exact[:, :3]
    series = [Series(tape, [list(row) for row in c]) for c in (exact, wrong)]
    for one in series:
        for _ in range(4):
            one.advance()
    series[1].replace_last({i: exact[i, 3] for i in range(2)})
    assert np.array(series[1].outputs) == pytest.approx(np.array(series[0].outputs), rel=1e-15)


@pytest.mark.parametrize("name", OPERATIONS)
def test_sizes_bound_rounding(name):
    q = coordinates("x y")
    expression = OPERATIONS[name](*q)
    combined = (expression * (2 + q.t) + 1e6 * ca.exp(q.t)) / (2 + q.t) - 1e6 * ca.exp(q.t) / (2 + q.t)
    tape = Tape([*q, q.t], [expression, combined])
    points = np.random.default_rng(7).uniform(0.4, 1.1, (3, 200))
    values, sizes = evaluate(tape, points)
    exact, _ = evaluate(tape, points.astype(np.longdouble))
    assert values.dtype == np.float64 and exact.dtype == np.longdouble
    assert np.all(np.abs(values - exact) < 50 * np.finfo(float).eps * sizes)
    assert np.all(sizes >= np.abs(values) * (1 - 1e-12))
    assert np.median(sizes[0] / np.abs(values[0])) < 30, "a size far above its value would hide what is not zero"


def test_an_exact_cancellation_is_zero_in_the_size_of_its_terms():
    q = coordinates("x y")
    x, y = q
    angle = 3 * x + y
    zero = 1e8 * (ca.cos(2 * angle) + 2 * ca.sin(angle) ** 2 - 1)
    small = 1e-9 * x
    points = np.random.default_rng(9).uniform(0.4, 1.1, (2, 100)).astype(np.longdouble)
    values, sizes = evaluate(Tape([x, y], [zero, small]), points)
    assert np.all(np.abs(values[0]) < 1e-15 * sizes[0])
    assert np.all(np.abs(values[1]) > 0.1 * sizes[1])


def test_sizes_do_not_grow_along_a_chain_of_rotations():
    """Errors of components turn with them: a cancellation behind a hundred rotations is zero, a small entry is not."""
    q = coordinates(" ".join(f"a{i}" for i in range(100)))
    x, y = ca.SX(1), ca.SX(0)
    for angle in q:
        x, y = ca.cos(angle) * x - ca.sin(angle) * y, ca.sin(angle) * x + ca.cos(angle) * y
    whole = ca.sum1(ca.vertcat(*q))
    expressions = [x - ca.cos(whole), x, 1e-6 * y]
    points = np.random.default_rng(9).uniform(-3.0, 3.0, (100, 20)).astype(np.longdouble)
    values, sizes = evaluate(Tape(list(q), expressions), points)
    assert np.all(np.abs(values[0]) < 1e-15 * sizes[0]) and np.all(sizes[:2] < 300)
    assert np.all(np.abs(values[1:]) > 1e-12 * sizes[1:])


def growth(expression, q, orders):
    return np.polyfit(np.log(orders), [np.log(operations(q.dt(expression, k))) for k in orders], 1)[0]


@pytest.mark.parametrize(
    "build",
    [
        curvature,
        lambda q: ca.exp(ca.sin(q.d(0)[0] * q.d(0)[1])),
        lambda q: ca.sqrt(1 + ca.atan2(*q.d(1)) ** 2),
        lambda q: (q.d(0)[0] ** 2 + q.d(0)[1] ** 2) ** 1.5 / ca.cosh(q.d(0)[0]),
    ],
)
def test_cost_grows_quadratically(build):
    q = coordinates("x y")
    assert growth(build(q), q, np.arange(4, 17, 2)) < 2.3


SINE, COSINE = (np.array([phase[k % 4] / factorial(k) for k in range(10)]) for phase in ((0, 1, 0, -1), (1, 0, -1, 0)))
COEFFICIENTS = {  # a residual in x, y, y' and t, a start, and the series of y
    "order 0": (lambda x, y, dy, t: y - ca.sin(t), {}, SINE),
    "order 1": (lambda x, y, dy, t: dy - x, {"y": 0.5}, SINE + (2 * (np.arange(10) == 0) - COSINE) / 2),
}


@pytest.mark.parametrize("row", COEFFICIENTS)
def test_coefficients_of_a_series_are_those_of_the_motion(row):
    """A mass on a spring, x'' = -x, whose y is moved by an actuator of its own."""
    residual, start, series = COEFFICIENTS[row]
    q = coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(ca.vertcat(*q.d(2))) / 2, potential=x**2 / 2, actuators={"u": y})
    model = sv.derive(mechanism, sv.Program({"p": residual(x, y, q.d(1)[1], q.t)}), keep=["x"])
    state = model.start(x=1.0, dx=0.5, **start).values
    f = taylor_coefficients(model.equations, 9)
    computed = np.array(f(0.0, state, 0.0)).ravel()[:18].reshape(9, 2)
    assert computed[:, 0] == pytest.approx((COSINE + SINE / 2)[1:], abs=1e-15)
    assert computed[:, 1] == pytest.approx(series[1:], abs=1e-15)


def test_cost_with_quasi_velocities_grows_quadratically():
    q = quaternion()
    e0, e1, e2, e3 = q
    assert growth(e0 * e1 + e2 * e3, q, np.arange(4, 17, 3)) < 2.3


def test_the_curvature_program_of_order_12_costs_at_most_8_times_that_of_order_5():
    """κ has order 2: the program of order s is its derivative s - 2. Nested differentiation passes 60 at order 11."""
    q = coordinates("x y")
    program = {s: operations(q.dt(curvature(q), s - 2)) for s in (5, 12)}
    raised = {s: operations(q.dt(curvature(q), s - 1)) for s in (5, 12)}
    assert program[12] <= 8 * program[5]
    assert raised[12] <= 8 * raised[5]
    assert operations(nested(q, curvature(q), 9)) > 60 * operations(nested(q, curvature(q), 3))


def test_high_orders_are_finite_and_right():
    q = coordinates("x y")
    expression = q.dt(curvature(q), 12)
    values = jets_at_random(q, 14, np.random.default_rng(3))
    found = numbers([expression], values)[0]
    jets = [[mpmath.mpf(values[q.jet_names(k)[i]]) for k in range(15)] for i in range(2)]

    def kappa(t):
        (dx, ddx), (dy, ddy) = (
            [sum(c[k] * t ** (k - j) / factorial(k - j) for k in range(j, 15)) for j in (1, 2)] for c in jets
        )
        return (dx * ddy - dy * ddx) / (dx**2 + dy**2) ** mpmath.mpf(1.5)

    with mpmath.workdps(80):
        exact = mpmath.taylor(kappa, 0, 12)[12] * factorial(12)
    assert np.isfinite(found)
    assert found == pytest.approx(float(exact), rel=1e-10)


S = ca.MX.sym("s")
CALLED = ca.Function("f", [S], [ca.interpolant("table", "linear", [[0.0, 1.0]], [0.0, 2.0])(S)], {"never_inline": True})


@pytest.mark.parametrize(
    ("build", "word"),
    [
        (lambda x, y: ca.floor(x) + y, "floor"),
        (lambda x, y: ca.ceil(x) * y, "ceil"),
        (lambda x, y: ca.fmod(x, y), "fmod"),
        (lambda x, y: ca.remainder(x, y), "remainder"),
        (lambda x, y: ca.copysign(x, y), "copysign"),
        (lambda x, y: ca.erfinv(x), "erfinv"),
        (lambda x, y: CALLED.call([x])[0], "interpolant"),
    ],
)
def test_operations_without_a_derivative_are_refused_by_name(build, word):
    q = coordinates("x y")
    with refused(SpecificationError, word) as caught:
        q.dt(build(*q))
    own = {"interpolant": "sv.paths.spline"}
    assert own.get(word, "if_else") in str(caught.value) and (word not in own or "if_else" not in str(caught.value))


def test_if_else_differentiates_the_branch_it_is_on():
    q = coordinates("x")
    (x,) = q
    (dx,) = q.d(1)
    rate = q.dt(ca.if_else(x > 0, x**2, -3 * x))
    assert numbers([rate], {"x": 2.0, "dx": 5.0}) == pytest.approx([20.0])
    assert numbers([rate], {"x": -2.0, "dx": 5.0}) == pytest.approx([-15.0])
    safe = q.dt(ca.if_else(x > 0, ca.sqrt(ca.fmax(x, 1e-300)), 0.0), 2)
    assert numbers([safe], {"x": -1.0, "dx": 1.0, "d2x": 1.0}) == pytest.approx([0.0])


@pytest.mark.parametrize("exponent", [2.0, 3.0])
def test_powers_whose_exponent_is_a_symbol_hold_for_negative_bases(exponent):
    """CasADi's own pow(-1.5, 2) is 2.25: the value and its derivative must not become NaN by way of a logarithm."""
    q = coordinates("x")
    (x,) = q
    n = ca.SX.sym("n")
    values, _ = evaluate(Tape([x, n], [x**n]), np.array([[-1.5], [exponent]]))
    assert values[0, 0] == pytest.approx((-1.5) ** exponent)
    rate = numbers([q.dt(x**n)], {"x": -1.5, "dx": 1.0, "n": exponent})
    assert rate == pytest.approx([exponent * (-1.5) ** (exponent - 1)])


@pytest.mark.parametrize("exponent", [np.inf, -np.inf])
def test_infinite_exponents_do_not_leak_an_overflow(exponent):
    q = coordinates("x")
    (x,) = q
    try:
        q.dt(ca.power(x, exponent))
    except SpecificationError:
        pass


def test_order_40_is_derived_at_all():
    """x = e^t to its fortieth derivative: D^40 log(x) = 0 from terms of size 39!."""
    q = coordinates("x")
    (x,) = q
    values = {name: 1.0 for k in range(41) for name in q.jet_names(k)}
    assert abs(numbers([q.dt(ca.log(x), 40)], values)[0]) < 1e-13 * factorial(39)
    assert operations(q.dt(ca.log(x), 40)) < 40**2 * 2


def coefficients(tape, inputs, first, count):
    """Coefficients (outputs, count, N) one operation at a time, and a group of equal operations at a time."""
    single, grouped = Series(tape, inputs), _Grouped(tape, inputs, first, len(inputs[0][0]))
    with np.errstate(all="ignore"):
        for _ in range(count):
            single.advance()
            grouped.advance()
    outputs = tape.outputs[:first]
    one_by_one = [[np.broadcast_to(c, len(inputs[0][0])) for c in single.c[i]] for i in outputs]
    return np.array(one_by_one, dtype=REAL), np.stack(grouped.values, axis=1)[grouped.plan.place[outputs]]


def test_groups_of_operations_have_the_series_of_single_ones():
    """All operations on one tape, some of which overflow, and some that follow the first outputs."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    switching = [ca.fmin(x, y) * ca.fabs(x - y), ca.if_else(x > 1, x * y, ca.atan2(x, y)), ca.SX(3)]
    overflowing = [x / (1 + ca.exp(20_000 * y)), ca.sqrt(x) / ca.exp(300 * x), x / y]
    tape = Tape([x, y], [*(make(x, y) for make in UNARY.values()), *switching, *overflowing])
    curved, straight = ([RNG.uniform(0.3, 1.4, 7).astype(REAL) for _ in range(5)] for _ in "xy")
    inputs = [curved, [straight[0], 1.0, 0.0, 0.0, 0.0]]
    for first in (None, 1, 9):
        single, grouped = coefficients(tape, inputs, first, 5)
        assert single.shape == (len(tape.outputs[:first]), 5, 7)
        np.testing.assert_allclose(grouped, single, rtol=9_000 * np.finfo(REAL).eps)


def test_a_comparison_that_gates_a_term_is_compared_once():
    """Every derivative of a gate has its condition, not that of the condition being true, and so on."""
    q = coordinates("x")
    (x,) = q
    f = ca.Function("f", [], [q.dt(ca.if_else(x > 1, x**3, x), 4)], {"allow_free": True})
    codes = [f.instruction_id(k) for k in range(f.n_instructions())]
    assert ca.OP_IF_ELSE_ZERO in codes
    assert ca.OP_NE not in codes
