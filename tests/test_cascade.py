"""Deep hidden constraints by blocks: operations, forces against series, and the rows of one expression each.

The references are truncated series in extended precision: each body's balance gives the place of the next one.
"""

import pickle
from math import factorial

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.gallery import cars, gallery
from servoctl.model.jets import extended
from servoctl.reduction import triangular

SPAN = (0.0, 2.0)
TIMES = np.linspace(*SPAN, 41)
SHORT = (0.0, 0.5)
VALUES = {"m": 1.3, "k": 2.0, "c": 0.7, "d": 0.4}


# mechanisms ----------------------------------------------------------------------------------------------------------


def chain(N, potential, gravity=None, damper=None, frame=None, relative=False):
    """N bodies on a line, joined by springs; the first follows a sine, the last is driven."""
    p = sv.parameters(**VALUES)
    q = sv.coordinates(" ".join(f"x{i}" for i in range(1, N + 1)))
    if frame is not None:
        q = q.with_quasi_velocities(" ".join(f"v{i}" for i in range(1, N + 1)), frame(list(q)))
    m, k, c, d = p.symbols
    x = [sum(list(q)[: i + 1]) for i in range(N)] if relative else list(q)
    stretches = [x[i] - x[i + 1] for i in range(N - 1)]
    U = sum(potential(e, k, c) for e in stretches) + (sum(map(gravity, x)) if gravity else 0.0)
    forces = ca.SX.zeros(q.n)
    if damper is not None:
        forces -= (ca.jacobian(stretches[damper], ca.vertcat(*q)) @ q.V).T * d * q.dt(stretches[damper])
    gibbs = sum(sv.particle(q, m, e) for e in x)
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=U, forces=forces, actuators={"force": x[-1]}, parameters=p)
    return mechanism, sv.Program({"first": x[0] - 0.5 - ca.sin(0.6 * q.t)})


def linear(e, k, c):
    return k * e**2 / 2


def cubic(e, k, c):
    return k * e**2 / 2 + c * e**4 / 4


def by_place(x):
    return ca.diag(ca.vertcat(*(1.0 / (1.5 + ca.sin(e)) for e in x)))


def differences(x):
    return ca.tril(ca.DM.ones(len(x), len(x)))


def weight(x):
    return -1.1 * ca.cos(x)


def crane(N, behind=True):
    """A crane whose trolley N cars draw by springs; or, not `behind`, whose load draws N cars, the last of them led."""
    q = sv.coordinates("x l theta " + " ".join(f"x{i}" for i in range(1, N + 1)))
    x, l, theta, *c = q
    X, Z = x + l * ca.sin(theta), -l * ca.cos(theta)
    row = [x if behind else X, *c]
    U = 98.1 * Z + sum(200.0 * (a - b - 0.5) ** 2 for a, b in zip(row[:-1], row[1:], strict=True))
    gibbs = sv.particle(q, 30.0, x) + sv.particle(q, 10.0, (X, Z)) + sum(sv.particle(q, 5.0, e) for e in c)
    actuators = {"force": row[-1] if behind else x, "winch": l}
    led = X if behind else c[-1]
    program = {"led": led - ca.sin(0.5 * q.t), "Z": Z + 4 - 0.5 * ca.sin(0.7 * q.t)}
    return sv.Mechanism(q, gibbs=gibbs, potential=U, actuators=actuators), sv.Program(program)


# series --------------------------------------------------------------------------------------------------------------


def sine(t, rate, size=1.0, order=40):
    """Taylor coefficients (order + 1, N) of size sin(rate t)."""
    waves = [np.sin(rate * t), np.cos(rate * t), -np.sin(rate * t), -np.cos(rate * t)]
    return np.array([size * rate**j * waves[j % 4] / factorial(j) for j in range(order + 1)], dtype=np.longdouble)


def times(a, b):
    return np.array([sum(a[i] * b[j - i] for i in range(j + 1)) for j in range(min(len(a), len(b)))])


def over(a, b):
    result = []
    for j in range(min(len(a), len(b))):
        result.append((a[j] - sum(result[i] * b[j - i] for i in range(j))) / b[0])
    return np.array(result)


def second(a):
    return np.array([(j + 2) * (j + 1) * a[j + 2] for j in range(len(a) - 2)])


def sine_of(a):
    s, c = [np.sin(a[0])], [np.cos(a[0])]
    for j in range(1, len(a)):
        s.append(sum(i * a[i] * c[j - i] for i in range(1, j + 1)) / j)
        c.append(-sum(i * a[i] * s[j - i] for i in range(1, j + 1)) / j)
    return np.array(s)


def stretched(pull, hard):
    """The stretch e with k e + c e³ = pull."""
    k, c = VALUES["k"], VALUES["c"]
    e = pull / k
    for _ in range(60 if hard else 0):
        square = times(e, e)
        slope = 3 * c * square
        slope[0] += k
        e = e - over(k * e + c * times(square, e) - pull, slope)
    return e


def chain_by_series(N, hard=False, heavy=False):
    """Places by name and the force on the last of N bodies."""
    x, pull, found = sine(TIMES, 0.6), 0.0, {}
    x[0] += 0.5
    for i in range(1, N + 1):
        found[f"x{i}"] = x[0]
        change = VALUES["m"] * second(x) + (1.1 * sine_of(x)[:-2] if heavy else 0.0)
        pull = change + (pull[: len(change)] if i > 1 else 0.0)
        if i < N:
            e = stretched(-pull, hard)
            x = x[: len(e)] - e
    return found | {"force": pull[0]}


def crane_by_series(N):
    X, Z = sine(TIMES, 0.5), sine(TIMES, 0.7, 0.5)
    Z[0] -= 4.0
    vertical = second(Z)
    vertical[0] += 9.81
    x = X[:-2] - times(Z[:-2], over(second(X), vertical))
    found, pull, mass, load = {"x": x[0]}, 0.0, 30.0, 10.0 * second(X)
    for i in range(1, N + 1):
        change = mass * second(x)
        pull = change + (pull[: len(change)] if i > 1 else load[: len(change)])
        x, mass = x[: len(pull)] + pull / 400.0, 5.0
        x[0] -= 0.5
        found[f"x{i}"] = x[0]
    return found | {"force": (pull[: len(x) - 2] + 5.0 * second(x))[0]}


DEEP = {
    "cubic springs": (lambda N: chain(N, cubic), lambda N: chain_by_series(N, hard=True), 8, 9000),
    "discs": (lambda N: chain(N, linear, weight), lambda N: chain_by_series(N, heavy=True), 8, 5500),
    "crane and cars": (crane, crane_by_series, 5, 20000),
}


@pytest.mark.parametrize("name", DEEP)
def test_a_deep_plan_takes_few_operations_and_agrees_with_series(name):
    build, reference, N, most = DEEP[name]
    few = sv.derive(*build(N // 2)).function("path").operations
    model = sv.derive(*build(N))
    run = sv.simulate(model, model.start(), SPAN, t_eval=TIMES)
    assert model.flat and model.function("path").operations <= min(most, few * (N / (N // 2)) ** 3.2)
    for signal, values in reference(N).items():
        assert np.abs(run[signal] - values).max() < 1e-11 * np.abs(values).max(), signal
    assert sv.verify(run).passed


# the same as by one expression of each row ---------------------------------------------------------------------------


ALIKE = {
    "cubic springs": lambda: chain(3, cubic),
    "discs": lambda: chain(3, linear, weight),
    "velocities by place": lambda: chain(3, linear, frame=by_place),
    "distances": lambda: chain(4, linear, relative=True),
    "velocities between cars": lambda: chain(3, cubic, frame=differences),
    "first damper": lambda: chain(4, linear, damper=0),
    "last damper": lambda: chain(4, linear, damper=2),
    "crane before a car": lambda: crane(1),
    "crane behind a car": lambda: crane(1, behind=False),
}


@pytest.fixture(scope="module")
def pairs():
    """A function from a name to the model by blocks and the model by expressions."""
    known = {}

    def pair(name):
        if name not in known:
            by_blocks = sv.derive(*ALIKE[name]())
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(triangular, "SHALLOW", None)
                known[name] = by_blocks, sv.derive(*ALIKE[name]())
        return known[name]

    return pair


def moved(model, method=None, drift=None):
    method = method or ("algebraic" if model.flat else sv.methods.Adaptive("DOP853", rtol=1e-10, atol=1e-12))
    return sv.simulate(model, model.start(), SHORT, method, drift=drift, t_eval=np.linspace(*SHORT, 6))


@pytest.mark.parametrize(
    "name", ["discs", "velocities by place", "velocities between cars", "distances", "crane behind a car"]
)
def test_rows_and_motions_are_those_of_one_expression_for_each_row(name, pairs):
    by_blocks, by_expressions = pairs(name)
    assert by_blocks.reduction.cascade is not None and by_expressions.reduction.cascade is None
    for row, other in zip(by_blocks.reduction.rows, by_expressions.reduction.rows, strict=True):
        parts = "name", "kind", "order", "derivation", "affine", "uses"
        assert [getattr(row, part) for part in parts] == [getattr(other, part) for part in parts]
    run, other = moved(by_blocks), moved(by_expressions)
    tolerance = 1e-13 if by_blocks.flat else 1e-9
    size = np.abs(other.jets).max(axis=1, keepdims=True) + 1.0
    assert np.abs((run.jets - other.jets) / size).max() < 10 * tolerance
    for u in by_blocks.actuators:
        assert np.abs(run[u] - other[u]).max() < 10 * tolerance * np.abs(other[u]).max()


def test_a_function_of_the_state_takes_what_is_not_replaced_from_it():
    """A nonlinear spring before a damper is beyond combinations of expressions, which leave x2'' squared."""
    model = sv.derive(*chain(4, cubic, damper=1))
    run = sv.simulate(model, model.start(), SPAN, t_eval=TIMES)
    assert model.free == 1 and sv.verify(run).passed


@pytest.mark.parametrize(("name", "method"), [("last damper", "Taylor"), ("first damper", "RadauIIA")])
def test_integrators_agree(name, method, pairs):
    model = pairs(name)[0]
    assert moved(model, method)["force"] == pytest.approx(moved(model)["force"], rel=1e-6)


@pytest.mark.parametrize("drift", ["project", sv.methods.Poles(5.0)])
def test_drift_is_treated(drift, pairs):
    by_blocks, by_expressions = pairs("first damper")
    forces = [moved(model, drift=drift)["force"] for model in (by_blocks, by_expressions)]
    assert forces[0] == pytest.approx(forces[1], rel=1e-8)


@pytest.mark.parametrize("name", ["velocities by place"])
def test_sensitivities_agree(name, pairs):
    forces, parameters = pairs(name)[0].actuators, pairs(name)[0].numbers
    by_blocks, by_expressions = (sv.sensitivity(moved(model)) for model in pairs(name))
    for pair in ((force, p) for force in forces for p in parameters):
        size = np.abs(by_expressions[pair]).max()
        assert by_blocks[pair] == pytest.approx(by_expressions[pair], abs=1e-8 * size + 1e-12)


@pytest.mark.parametrize("name", ["cubic springs", "first damper", "crane behind a car"])
def test_starts_structure_and_higher_jets_agree(name, pairs):
    by_blocks, by_expressions = pairs(name)
    starts = [model.start(0.3) for model in (by_blocks, by_expressions)]
    assert starts[0].values == pytest.approx(starts[1].values, abs=1e-11)
    assert starts[0].free == starts[1].free
    parts = "relative_degree", "zeros_at_infinity", "essential_orders", "index"
    structures = [model.structure(start) for model, start in zip((by_blocks, by_expressions), starts, strict=True)]
    assert [getattr(structures[0], part) for part in parts] == [getattr(structures[1], part) for part in parts]
    run = moved(by_expressions)
    size = len(run.jets) + 2 * by_blocks.n
    jets = [extended(model, run.t, run.jets, size) for model in (by_blocks, by_expressions)]
    known = np.isfinite(jets[1])
    assert np.abs(jets[0] - jets[1])[known].max() < 1e-8 * np.abs(jets[1][known]).max()


def test_other_parameters_and_copies(pairs):
    model = pairs("cubic springs")[0]
    other = model.with_parameters(m=1.5)
    copied = pickle.loads(pickle.dumps(other))
    fresh = sv.derive(*chain(3, cubic)).with_parameters(m=1.5)
    assert copied.reduction.cascade is not None
    for run in (moved(copied), moved(fresh)):
        assert np.array_equal(run.jets, moved(other).jets)


def test_residuals_of_hidden_rows_are_those_of_the_motion(pairs):
    by_blocks, by_expressions = pairs("crane before a car")
    run = moved(by_blocks)
    names, function = by_blocks.signals("residuals")
    assert names == by_expressions.signals("residuals")[0]
    wrong = run.jets.copy()
    wrong[3] += 1e-3  # the car's place, which its hidden row determines
    values = [np.abs(function.grid(run.t, jets, by_blocks.p)).max() for jets in (run.jets, wrong)]
    assert values[0] < 1e-8 < 1e-4 < values[1]


def test_a_spring_that_yields_ends_the_motion():
    """Its tangent stiffness vanishes at 0.13 m, where the balance no longer determines the next car."""
    model = sv.derive(*chain(3, lambda e, k, c: k * (e**2 / 2 - 5 * e**4)))
    assert model.reduction.cascade is not None
    with refused(sv.errors.SingularProgram, "balance of x1"):
        sv.simulate(model, model.start(), SPAN)


# where there is no cascade -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", gallery)
def test_shallow_rows_are_one_expression_each(name, gallery_model):
    deep = ("three-cars", "slung-load", "slung-load-3d")
    assert (gallery_model(name).reduction.cascade is None) == (name not in deep)


def test_cars_far_beyond_ordinary_numbers():
    """The eighth car follows from the sixteenth derivative of a path of two seconds: it is 1e14 m away."""
    assert len(sv.derive(*cars(8)).reduction.cascade.blocks) == 8
