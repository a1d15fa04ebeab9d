"""References: symbols whose values are paths; one model for every path."""

import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
import referred
from scipy.interpolate import PPoly, make_interp_spline

import servoctl as sv
from servoctl.codegen import compiler, interpreted
from servoctl.codegen.function import compiled
from servoctl.codegen.paths import Followed
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.model import store
from servoctl.spec.references import function_of

PATH = sv.paths.rest_to_rest(start=(0.0, 4.0), end=(5.0, 2.0), duration=6.0, smoothness=4)
HANGING = {"l": 4.0}


def crane():
    q = sv.coordinates("x l theta")
    x, length, theta = q
    p = sv.parameters(m_trolley=10.0, m_load=100.0, g=9.81)
    load = ca.vertcat(x + length * ca.sin(theta), -length * ca.cos(theta))
    gibbs = sv.particle(q, p.m_trolley, [x, 0]) + sv.particle(q, p.m_load, load)
    return sv.Mechanism(q, gibbs, p.m_load * p.g * load[1], {"trolley": x, "hoist": length}, p), load


def followed(path=PATH, **options):
    mechanism, load = crane()
    r = mechanism.q.references(X=path[0], Z=path[1])
    program = sv.Program({"X": load[0] - r.X, "Z": load[1] + r.Z}, by="actuators", **options)
    return sv.derive(mechanism, program)


def spelled():
    """The crane with its path as a formula of time."""
    mechanism, load = crane()
    path = referred.polynomial(mechanism.q.t, (0.0, 4.0), (5.0, 2.0), 6.0)
    return sv.derive(mechanism, sv.Program({"X": load[0] - path[0], "Z": load[1] + path[1]}, by="actuators"))


def cart_pole(reference):
    """A cart-pole; `reference(q)` is what the cart follows."""
    q = sv.coordinates("x theta")
    x, theta = q
    p = sv.parameters(M=1.0, m=0.1, L=0.5, g=9.81)
    tip = ca.vertcat(x + p.L * ca.sin(theta), p.L * ca.cos(theta))
    gibbs = sv.particle(q, p.M, [x, 0]) + sv.particle(q, p.m, tip)
    mechanism = sv.Mechanism(q, gibbs, p.m * p.g * tip[1], {"force": x}, p)
    return sv.derive(mechanism, sv.Program({"cart": x - reference(q)}, by="actuators"))


def same(run, other, within):
    for name in other.names:
        assert np.abs(run[name] - other[name]).max() <= within * max(1.0, np.abs(other[name]).max()), name


def test_derivatives_of_expressions_are_those_along_the_path():
    q = sv.coordinates("x")
    r = q.references(X=None, x=None)
    expression = ca.sin(r.X * r["x"]) + r.d(1)[0] * q.t + r.X**3
    rates = q.derivatives([expression], 4)
    a, b = np.polynomial.Polynomial([0.3, 1.0, -0.5, 0.2]), np.polynomial.Polynomial([1.0, -0.4, 0.1, 0.05])
    symbols = [q.t, *(s for k in range(6) for s in r.d(k))]
    f = ca.Function("f", symbols, [ca.vertcat(*(level[0] for level in rates))])
    t = ca.SX.sym("t")
    along = ca.sin(ca.polyval(a.coef[::-1], t) * ca.polyval(b.coef[::-1], t)) + ca.polyval(a.coef[::-1], t) ** 3
    along += ca.polyval(a.deriv().coef[::-1], t) * t
    exact = [along]
    for _ in range(4):
        exact.append(ca.jacobian(exact[-1], t))
    numbers = ca.Function("exact", [t], [ca.vertcat(*exact)])(0.7).full().ravel()
    jets = [float(poly.deriv(k)(0.7)) if k else float(poly(0.7)) for k in range(6) for poly in (a, b)]
    assert np.allclose(f(0.7, *jets).full().ravel(), numbers, rtol=1e-13)


def test_symbols_are_named_once_and_read_by_their_names():
    q = sv.coordinates("x y")
    r = q.references(X=PATH[0], Y=None)
    assert (r.names, len(r), repr(r)) == (("X", "Y"), 2, "References(X Y)")
    X, Y = r
    assert q.where(X) == ("r", 0, 0) and q.where(r.d(2)[1]) == ("r", 2, 1) and Y.is_symbolic() and not q.is_jet(X)
    assert q.order(r.d(3)[0]) == -1
    with pytest.raises(SpecificationError, match="The reference 'X' is a reference already"):
        q.references(X=PATH[0])
    with pytest.raises(AttributeError, match="No reference is named 'Z'; there are X, Y"):
        _ = r.Z
    with pytest.raises(SpecificationError, match="has 2 components"):
        q.references(P=PATH)
    with pytest.raises(SpecificationError, match="order=41"):
        r.d(41)


def test_a_flat_plan_is_that_of_the_formula():
    new, old = followed(), spelled()
    assert new.reduction.needs == old.reduction.needs and new.reduction.follows == {"X": 4, "Z": 4}
    assert "follows X, Z, each with its derivatives up to order 4" in str(new)
    run, other = (sv.simulate(m, m.start(guess=HANGING), (0.0, 6.0)) for m in (new, old))
    same(run, other, 1e-13)
    assert sv.verify(run).passed
    assert np.array_equal(run["X"], PATH[0](run.t)) and np.abs(run["X_residual"]).max() < 1e-14
    assert new.function("path").operations < 0.8 * old.function("path").operations


@pytest.mark.parametrize("method", ["Taylor", "RadauIIA", "RK8", "DOP853"])
def test_integrated_motions_are_those_of_formulas_piece_by_piece(method):
    """Upright at rest before the path, which then is a polynomial, and afterwards a number."""
    path = sv.paths.rest_to_rest(start=0.0, end=1.0, duration=1.0)
    new = cart_pole(lambda q: q.references(x=path).x)
    moving, held = cart_pole(lambda q: referred.polynomial(q.t, 0.0, 1.0, 1.0)), cart_pole(lambda q: 1.0)
    t = np.linspace(-0.2, 1.2, 29)
    run = sv.simulate(new, new.start(-0.2, theta=0.0, dtheta=0.0), (-0.2, 1.2), method, t_eval=t)
    during = sv.simulate(moving, moving.start(theta=0.0, dtheta=0.0), (0.0, 1.0), method, t_eval=t[4:25])
    end = {name: during[name][-1] for name in ("theta", "dtheta")}
    after = sv.simulate(held, held.start(1.0, **end), (1.0, 1.2), method, t_eval=t[24:])
    for name in ("x", "theta", "dtheta", "force"):
        assert not run[name][:4].any()
        for other, part in ((during, run[name][4:25]), (after, run[name][24:])):
            assert np.abs(part - other[name]).max() <= 1e-10 * max(1.0, np.abs(other[name]).max()), name
    assert np.array_equal(run["x_reference"], path(run.t)) and run["x"] is not run["x_reference"]


def test_another_path_derives_compiles_and_writes_nothing(monkeypatch, tmp_path):
    model = followed()
    first = sv.simulate(model, model.start(guess=HANGING), (0.0, 6.0))
    for name in first.names:
        first[name]
    interpreted.machine(model.signals("actuation")[1].expression, 100)  # of many points, one unit for all functions
    monkeypatch.setattr(store, "_write", None)
    monkeypatch.setattr(compiler, "library", lambda *_, **__: pytest.fail("compiled"))
    monkeypatch.setattr(interpreted, "MANY_POINTS", np.inf)
    monkeypatch.setattr(type(model), "_of", None)
    other = model.with_references(X=0.5 * PATH[0], Z=sv.paths.rest_to_rest(4.0, 3.0, 2.0, smoothness=6))
    run = sv.simulate(other, other.start(guess=HANGING), (0.0, 6.0))
    assert run["trolley"].max() < 0.6 * first["trolley"].max()
    assert run.knots == (0.0, 6.0)  # where C^6 begins, as the plan needs, no step ends
    same(sv.simulate(model, model.start(guess=HANGING), (0.0, 6.0)), first, 0.0)


def test_a_model_follows_what_scipy_makes():
    t = np.linspace(0.0, 6.0, 61)
    points = np.column_stack([2.5 * (1 - np.cos(np.pi * t / 6)), 3 + np.cos(np.pi * t / 6)])
    spline = sv.paths.as_path(make_interp_spline(t, points, k=9))
    model = followed().with_references(X=spline[0], Z=spline[1])
    run = sv.simulate(model, model.start(guess=HANGING), (0.0, 6.0))
    assert sv.verify(run).passed and np.abs(run["x"] + run["l"] * np.sin(run["theta"]) - spline[0](run.t)).max() < 1e-12
    quadratic = PPoly(np.array([[0.05], [0.0], [4.0]]), [0.0, 6.0])  # of another degree, continued on both sides
    falling = sv.paths.as_path(quadratic, before="continue", after="continue")
    model = model.with_references(X=0.0 * falling, Z=falling)
    run = sv.simulate(model, model.start(guess=HANGING), (0.0, 2.0))
    assert np.abs(run["hoist"] + 100.0 * (9.81 - 0.1)).max() < 1e-9  # free of swing: m (g - Z'')


@pytest.mark.parametrize("smoothness", [2, 3, 4])
@pytest.mark.parametrize("jumps", [False, True])
def test_paths_have_as_many_derivatives_as_the_actuation(smoothness, jumps):
    path = sv.paths.rest_to_rest(start=(0.0, 4.0), end=(1.0, 3.0), duration=3.0, smoothness=smoothness)
    model = followed(path, jumps=jumps)
    assert sv.verify(sv.simulate(model, model.start(guess=HANGING), (0.0, 3.0))).passed  # its end is not passed
    if smoothness + jumps < 4:
        with pytest.raises(SpecificationError, match=rf"needs C\^4, has C\^{smoothness} at t = 3 s"):
            sv.simulate(model, model.start(guess=HANGING), (0.0, 4.0))
    else:
        assert sv.verify(sv.simulate(model, model.start(guess=HANGING), (0.0, 4.0))).passed


@pytest.mark.parametrize("method", ["Taylor", "RadauIIA", "RK4", "DOP853"])
def test_a_jerk_may_jump(method):
    q, p = sv.coordinates("x"), sv.parameters(m=2.0)
    mechanism = sv.Mechanism(q, sv.particle(q, p.m, [q[0]]), None, {"F": q[0]}, p)
    r = q.references(J=sv.paths.polynomials([0.0, 1.0, 2.5, 4.0], np.array([[1.0, -2.0, 0.5]])))
    model = sv.derive(mechanism, sv.Program({"jerk": q.d(3)[0] - r.J}, by="actuators"))
    assert model.reduction.follows == {"J": -1}
    run = sv.simulate(model, model.start(x=0.0, dx=0.0, d2x=0.0), (0.0, 4.0), method)
    exact = np.interp(run.t, [0.0, 1.0, 2.5, 4.0], np.cumsum([0.0, 1.0, -3.0, 0.75]))
    assert np.abs(run["F"] - 2.0 * exact).max() < 3e-12


def test_a_support_and_a_wind_are_followed():
    def pendulum(base, wind):
        q, p = sv.coordinates("b theta"), sv.parameters(m=1.0, L=1.0, g=9.81)
        b, theta = q
        tip = ca.vertcat(b + p.L * ca.sin(theta), -p.L * ca.cos(theta))
        gibbs = sv.particle(q, p.m, tip) + sv.particle(q, p.m, [b, 0])
        constraints, forces = {"support": b - base(q)}, {"theta": wind(q)}
        actuators = {"torque": theta}
        mechanism = sv.Mechanism(q, gibbs, p.m * p.g * tip[1], actuators, p, constraints=constraints, forces=forces)
        program = sv.Program({"level": theta - 0.3}, by="actuators")
        model = sv.derive(mechanism, program)
        return sv.simulate(model, model.start(), (0.0, 1.0))

    move = {"start": 0.0, "end": 0.5, "duration": 1.0}
    new = pendulum(
        lambda q: q.references(B=sv.paths.rest_to_rest(**move)).B,
        lambda q: q.references(W=sv.paths.rest_to_rest(**move)).W,
    )
    old = pendulum(*2 * [lambda q: referred.polynomial(q.t, **move)])
    same(new, old, 1e-13)


def test_programs_of_place_speed_and_acceleration_follow_one_path():
    path = sv.paths.rest_to_rest(start=0.0, end=1.0, duration=1.0, smoothness=4)
    q, p = sv.coordinates("x y z"), sv.parameters(m=2.0)
    mechanism = sv.Mechanism(q, sv.particle(q, p.m, list(q)), None, None, p)
    r = q.references(r=path)
    residuals = {"place": q[0] - r.r, "speed": q.d(1)[1] - r.d(1)[0], "acceleration": q.d(2)[2] - r.d(2)[0]}
    model = sv.derive(mechanism, sv.Program(residuals, by="ideal"))
    run = sv.simulate(model, model.start(y=0.0, z=0.0, dz=0.0), (0.0, 1.0))
    assert max(np.abs(run[name] - path(run.t)).max() for name in "xyz") < 1e-11
    back = sv.simulate(model, model.start(1.0, y=1.0, z=1.0, dz=0.0), (1.0, 0.0))
    assert max(np.abs(back[name] - path(back.t)).max() for name in "xyz") < 1e-11


def test_models_pickle_with_their_paths(tmp_path):
    model = followed().with_references(X=0.5 * PATH[0])
    (tmp_path / "model").write_bytes(pickle.dumps(model))
    code = (
        "import pickle, sys, servoctl as sv; m = pickle.load(open(sys.argv[1], 'rb'));"
        "print(repr(float(sv.simulate(m, m.start(guess={'l': 4.0}), (0.0, 6.0))['trolley'].max())))"
    )
    printed = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "model"], capture_output=True, text=True, check=True
    )
    run = sv.simulate(model, model.start(guess=HANGING), (0.0, 6.0))
    assert float(printed.stdout) == pytest.approx(run["trolley"].max(), rel=1e-12)


def test_what_is_missing_or_wrong_is_said():
    mechanism, load = crane()
    r = mechanism.q.references(X=None, Z=PATH[1])
    model = sv.derive(mechanism, sv.Program({"X": load[0] - r.X, "Z": load[1] + r.Z}, by="actuators"))
    with pytest.raises(SpecificationError, match=r"No path was given for X.*with_references\(X=\.\.\.\)"):
        model.start(guess=HANGING)
    with pytest.raises(NameUnknown, match="No reference is named 'Y'"):
        model.with_references(Y=PATH[0])
    with pytest.raises(SpecificationError, match="has 2 components"):
        model.with_references(X=PATH)
    open_ended = sv.paths.polynomials([0.0, 6.0], np.array([[1.0], [0.0]]))
    other = model.with_references(X=open_ended)
    with pytest.raises(SpecificationError, match="nothing was said of it after t = 6 s"):
        sv.simulate(other, other.start(guess=HANGING), (0.0, 7.0))
    mechanism, load = crane()
    mass = mechanism.q.references(m_load=PATH[0]).m_load
    with pytest.raises(SpecificationError, match="A reference and a parameter are both named 'm_load'"):
        sv.derive(mechanism, sv.Program({"X": load[0] - mass, "Z": load[1] + 4}, by="actuators"))


def test_compiled_jets_are_those_of_the_path():
    """Of a path whose coefficients lie in memory in another order, too, and on either side of breaks."""
    knots = sorted(np.random.default_rng(3).uniform(0.0, 6.0, 9))
    c = np.random.default_rng(4).normal(size=(6, 8, 2))
    path = sv.paths.polynomials(knots, c, before="hold", after="continue")
    q = sv.coordinates("x")
    r = q.references(a=path[0], b=path[1])
    jets = [s for k in range(7) for s in r.d(k)]
    f = compiled(function_of(q, r.names, "jets", q[0], ca.SX(0, 1), ca.vertcat(*jets, q[0])), "jets", ("rk",))
    parts = [part._with(coefficients=np.asfortranarray(part.coefficients)) for part in path]
    paths, t = Followed(parts), np.concatenate([np.linspace(-1.0, 8.0, 5001), knots])
    values = f.grid(t, np.zeros((1, len(t))), np.array([paths.address]))[:-1].reshape(7, 2, -1)
    exact = path.jets(t, 6)
    assert f.backend == "c" and np.all(np.abs(values - exact) <= 1e-13 * np.abs(exact).max(axis=2, keepdims=True))


def joined(before, after):
    """Two motions with rests between them, and one that begins and ends in motion."""
    there = sv.paths.rest_to_rest((0.0, 0.1), (3**0.5, 1.0), 4.0, smoothness=4)
    waits = sv.paths.rest_to_rest((3**0.5, 1.0), (3**0.5, 1.0), 1.0)
    path = there.then(waits).then(sv.paths.rest_to_rest((3**0.5, 1.0), (12**0.5, -0.3), 3.0, smoothness=2))
    knots, c = [0.1, 0.7, 1.9], np.random.default_rng(4).normal(size=(6, 2, 2))
    return path._with(before=before, after=after), sv.paths.polynomials(knots, c, before=before, after=after)


@pytest.mark.parametrize("n", [1, 64])
@pytest.mark.parametrize("sides", [("hold", "hold"), ("continue", "hold"), ("hold", "continue"), ("periodic",) * 2])
def test_compiled_jets_vanish_where_those_of_the_path_do(n, sides):
    """At breaks, at ends and beyond them: the same zeros, and elsewhere the same numbers."""
    q = sv.coordinates("x")
    r = q.references(a=None, b=None)
    jets = [s for k in range(7) for s in r.d(k)]
    f = compiled(function_of(q, r.names, "jets", q[0], ca.SX(0, 1), ca.vertcat(*jets, q[0])), "jets", ("rk",))
    for path in joined(*sides):
        a, b = path.breaks[[0, -1]]
        t = np.concatenate([path.breaks, [a - 1.0, b + 1.0, 2 * a - b, 2 * b - a, (a + b) / 2]])
        paths, exact, zeros = Followed(path), path.jets(t, 6), 0
        for i, instant in enumerate(t):
            found = f.grid(np.full(n, instant), np.zeros((1, n)), np.array([paths.address]))[:-1].reshape(7, 2, n)
            here = exact[:, :, i, None]
            assert np.all((found == 0) == (here == 0)), (instant, found[..., 0], here[..., 0])
            assert np.all(np.abs(found - here) <= 4e-15 * np.abs(exact).max(axis=2, keepdims=True))
            zeros += (here == 0).sum()
        assert f.backend == "c" and (zeros > 4 or "hold" not in sides)


@pytest.mark.parametrize("sides", [("hold", "hold"), ("continue", "hold"), ("hold", "continue"), ("periodic",) * 2])
def test_jets_by_the_library_have_the_bits_of_those_by_numpy(sides, monkeypatch):
    for path in joined(*sides):
        t = np.concatenate([np.linspace(-2.0, 9.0, 301), path.breaks, [np.nan, np.inf, -np.inf]])
        other = np.roll(t, 1)
        paths, alone = Followed([path[0], path[-1]]), Followed([path[0], path[-1]])
        monkeypatch.setitem(vars(alone), "_library", None)
        for order in (0, 1, 7, 40):
            for instants in (None, other):
                found, expected = (some.jets(t, order, instants) for some in (paths, alone))
                assert np.array_equal(found, expected, equal_nan=True)
                known = np.isfinite(t) & np.isfinite(t if instants is None else instants)
                assert np.array_equal(np.isnan(found).all(axis=0), ~known) and found.shape == (2 * (order + 1), len(t))


@pytest.mark.skipif(compiler.compiler() is None, reason="needs a compiler")
def test_rates_take_no_jets_from_numpy_one_by_one(monkeypatch):
    model = cart_pole(lambda q: q.references(X=PATH[0]).X)
    start, counted, taylor = model.start(theta=0.01), [], sv.paths.Path._taylor
    monkeypatch.setattr(sv.paths.Path, "_taylor", lambda *given: counted.append(given) or taylor(*given))
    found = []
    for length in (0.2, 2.0):
        run = sv.simulate(model, start, (0.0, length), "DOP853")
        found.append((run.counters["nfev"], len(counted)))
        counted.clear()
    (few, first), (many, second) = found
    assert many > 2 * few and second <= first + 2 and second < 20  # not one by one


def test_equal_mechanisms_that_travelled_keep_references_of_their_own():
    """An equal mechanism without references, or along other paths, came first: the copy is not taken for it."""
    bare, _ = crane()
    models = [followed(), followed(0.5 * PATH)]
    copies = [pickle.loads(pickle.dumps(value)) for value in (bare, *models)][1:]
    for model, copy in zip(models, copies, strict=True):
        assert copy == model and copy.paths == model.paths
        assert copy.reduction.mechanism.q.family.paths == model.reduction.mechanism.q.family.paths
        run, other = (sv.simulate(m, m.start(guess={"l": float(m.paths["Z"](0.0))}), (0.0, 6.0)) for m in (model, copy))
        same(other, run, 1e-12)


def test_what_is_no_instant_has_no_jets(backend):
    """As where a step fails: neither an error nor a number."""
    q = sv.coordinates("x")
    r = q.references(a=PATH[0])
    f = compiled(function_of(q, r.names, "jets", q[0], ca.SX(0, 1), ca.vertcat(r.a, *r.d(2))), "jets", ("rk",))
    paths, t = Followed([PATH[0]]), np.array([0.5, np.nan, 2.0, np.inf])
    values = f.grid(np.tile(t, 64), np.zeros((1, 256)), np.array([paths.address]))[:2]
    assert f.backend == backend and np.isnan(values[:, 1::4]).all()
    assert np.abs(values[:, ::2][:, ::2] - np.tile(PATH[0].jets([0.5], 2)[[0, 2], 0], 64)).max() < 1e-13
