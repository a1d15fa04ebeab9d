"""Where pivots are weak: the same rows without a choice of pivots, else rows that are derived once, kept in the process and on disk."""

import pickle

import casadi as ca
import numpy as np
import pytest
from conftest import on_manifold, relative

import servoctl as sv
from servoctl.codegen import compiler
from servoctl.gallery import gallery
from servoctl.jets.tape import Plan
from servoctl.methods.motion import Stepping
from servoctl.methods.rank import Rank
from servoctl.methods.taylor import series_loop
from servoctl.model import model as models
from servoctl.model import store
from servoctl.model.pivots import pivot_strength, pivots_at
from servoctl.model.points import place_of as paths_through
from servoctl.model.points import with_place
from servoctl.model.variants import derived_near, place_of, variant_at, without_choice
from servoctl.reduction.ranks import eliminate, orthogonal


def arm(program, by="actuators", unit=1.0, weights=None, order=0, constraint=None):
    """A planar arm of four links, lengths in units of 1/unit m, with some of its end point's motions programmed."""
    q = sv.coordinates("a b c d")
    angles = [sum(list(q)[: i + 1]) for i in range(4)]
    gibbs, point = 0, ca.SX.zeros(2)
    for angle in angles:
        link = 0.5 * unit * ca.vertcat(ca.cos(angle), ca.sin(angle))
        gibbs += sv.particle(q, 1.0 / unit**2, point + link) + 0.02 * q.dt(angle, 2) ** 2
        point = point + 2 * link
    s = ca.sin(1.5 * q.t)
    targets = {
        "X": point[0] / unit - 1.2 - 0.5 * s, "Y": point[1] / unit - 0.8 + 0.6 * s, "turn": angles[-1] - 1.5 * s,
    }  # fmt: skip
    residuals = {name: q.dt(targets[name], order) if order else targets[name] for name in program}
    actuators = {f"u{i}": np.eye(4)[i] for i in range(4)} if by == "actuators" else None
    constraints = {"bar": constraint(*q)} if constraint else None
    mechanism = sv.Mechanism(q, gibbs, 3.0 * sum(map(ca.sin, angles)), actuators, constraints=constraints)
    return mechanism, sv.Program(residuals, by=by, weights=weights)


START = {"a": 0.9, "b": -1.1, "c": 1.3, "d": -0.7}
ARMS = {
    "ideal": {"program": ["X", "Y", "turn"], "by": "ideal"},
    "ideal point": {"program": ["X", "Y"], "by": "ideal"},
    "ideal rates": {"program": ["X", "Y"], "by": "ideal", "order": 1},
    "ideal accelerations": {"program": ["X", "turn"], "by": "ideal", "order": 2},
    "least torque": {"program": ["X", "Y"], "weights": {"u0": 3.0}},
    "least torque beside a bar": {"program": ["X", "turn"], "constraint": lambda a, b, c, d: b + c - 0.2},
    "millimetres": {"program": ["X", "Y"], "by": "ideal", "unit": 1e3},
}


def begun(which):
    model = sv.derive(*arm(**ARMS[which]))
    return model, model.start(guess=START)


@pytest.fixture
def counted(monkeypatch, tmp_path):
    """Derivations and compilations from now on; both are kept under `tmp_path`."""
    counts, reduce, compile_ = {"derived": 0, "compiled": 0}, models.reduce, compiler._compile

    def count(name, f):
        def counting(*given):
            counts[name] += 1
            return f(*given)

        return counting

    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path))
    monkeypatch.delenv("SERVOCTL_MEMO", raising=False)
    monkeypatch.setattr(store, "_stamp", lambda: "these sources")
    monkeypatch.setattr(models, "reduce", count("derived", reduce))
    monkeypatch.setattr(compiler, "_compile", count("compiled", compile_))
    return counts


def solver(solve, matrix, numbers):
    """A solver as a function of a matrix, of its right side ones: solution and pivots."""
    n = matrix.shape[0]
    return ca.Function("f", [matrix], [ca.vertcat(a, *b) for a, b in [solve(matrix, ca.SX.ones(n), numbers)]])


@pytest.mark.parametrize("n", [1, 2, 3, 6, 12])
def test_orthogonal_rows_are_as_well_conditioned_as_the_matrix(n):
    """Beside the SVD: the solution errs by the condition number, and the product of the pivots is the determinant."""
    rng, a = np.random.default_rng(n), ca.SX.sym("a", n, n)
    numbers = rng.standard_normal((n, n, 3))
    f = solver(orthogonal, a, numbers)
    for smallest in (1.0, 1e-3, 1e-6):
        u, s, v = np.linalg.svd(rng.standard_normal((n, n)))
        s[-1] = smallest * s[0]
        matrix = u * s @ v
        y = np.array(f(matrix)).ravel()
        exact = v.T @ ((u.T @ np.ones(n)) / s)
        assert np.abs(y[:n] - exact).max() < 200 * np.finfo(float).eps * s[0] / s[-1] * np.abs(exact).max()
        scale = np.array(f(np.eye(n))).ravel()[n:].prod()  # of the columns, by numbers at the points
        assert y[n:].prod() == pytest.approx(scale * np.linalg.det(matrix), rel=1e-12 / smallest)
        assert (y[n:-1] > 0).all()


def test_no_pivot_of_orthogonal_rows_vanishes_where_chosen_ones_do():
    """A rotation: its entries vanish in turn, its determinant never, and the last pivot changes its sign with that alone."""
    angle, mirror = ca.SX.sym("angle"), ca.SX.sym("mirror")
    c, s = ca.cos(angle), ca.sin(angle)
    matrix, numbers = ca.vertcat(ca.horzcat(c, -s), mirror * ca.horzcat(s, c)), np.eye(2)[:, :, None]
    chosen, free = (
        ca.Function("f", [angle, mirror], [ca.vertcat(*solve(matrix, ca.SX(2, 0), numbers)[1])]) for solve in (eliminate, orthogonal)
    )
    angles = np.linspace(0.0, 2 * np.pi, 201)
    for side in (1.0, -1.0, 1e-3):
        pivots = np.array(free(angles[None], side))
        np.testing.assert_allclose(pivots, [[1.0] * 201, [side] * 201], rtol=1e-12)
    assert np.abs(np.array(chosen(angles[None], 1.0))).min() < 1e-12
    assert np.all(np.array(free(0.0, 0.0)).ravel() == [1.0, 0.0])


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("name", list(gallery))
def test_without_a_choice_rates_are_the_same(name, gallery_model):
    """At points of the manifold, where the chosen pivots are strong."""
    model = gallery_model(name)
    free, points = without_choice(model), model.reduction.points
    functions = [m.function("ode") for m in (model, free)]
    t, p = points.t.astype(float), with_place(paths_through(model, functions), model.parameters)
    x = on_manifold(model, t, np.vstack([points.jet(k) for k in range(model.reduction.top)]).astype(float), p)
    one, two = (f.grid(t, x, p)[: len(x)] for f in functions)
    assert np.isfinite(one).all() and np.all(np.abs(one - two).max(axis=0) < 1e-11 * np.abs(one).max(axis=0))
    assert without_choice(free) is free is without_choice(model) and free.free == model.free
    assert {name for name, _ in free.reduction.pivots} <= {name for name, _ in model.reduction.pivots}


@pytest.mark.parametrize("which", ["ideal rates", "ideal accelerations", "least torque beside a bar", "millimetres"])
def test_without_a_choice_the_motion_and_its_forces_are_the_same(which):
    model, start = begun(which)
    other, p, x = without_choice(model), model.p, start.values
    one, two = (m.function("ode")(start.t, x, p)[: len(x)] for m in (model, other))
    assert relative(one, two) < 1e-10
    one, two = (series_loop(m, 6)(start.t, x, np.append(p, start.t))[: 6 * model.n] for m in (model, other))
    assert relative(one, two) < 1e-8
    jets = np.append(x, model.function("ode")(start.t, x, p)[len(x) - model.n : len(x)])
    for kind in ("inputs", "all_multipliers"):
        one, two = (m.signals(kind)[1](start.t, jets, p) for m in (model, other))
        assert relative(one, two) < 1e-10


def test_where_actuators_reach_every_balance_no_pivot_chooses_among_these():
    """Four torques and a bar: nothing is divided by a choice of balances, so none may stop a motion by vanishing."""
    model, _ = begun("least torque beside a bar")
    assert not [name for name, _ in model.reduction.pivots if "unreached" in name]


@pytest.mark.parametrize("which", ["ideal", "least torque beside a bar"])
def test_error_dynamics_are_the_same_with_them(which):
    model, start = begun(which)
    x = start.values + 1e-3 * np.cos(np.arange(len(start.values)))
    p = np.append(model.p, np.full(sum(model.reduction.raised.values()), 3.0))
    one, two = (m.function("ode_poles")(start.t, x, p)[: len(x)] for m in (model, without_choice(model)))
    assert relative(one, two) < 1e-10


@pytest.mark.filterwarnings("ignore:Internal dynamics unstable")
@pytest.mark.parametrize(("which", "method"), [("ideal", "Taylor"), ("least torque", "DOP853")])
def test_a_redundant_arm_changes_its_pivots_once(which, method, counted):
    model, start = begun(which)
    counted["derived"] = 0
    runs = [sv.simulate(model, start, (0.0, 2.0), method) for _ in range(2)]
    assert counted["derived"] == 0 and np.array_equal(*(run.jets for run in runs))
    assert runs[0].counters["pivot_changes"] == 1
    assert sv.verify(runs[0]).passed


def two_links(order=0):
    """Two links whose end point goes round its base."""
    q = sv.coordinates("a b")
    a, b = q
    elbow = ca.vertcat(ca.cos(a), ca.sin(a))
    end = elbow + ca.vertcat(ca.cos(a + b), ca.sin(a + b))
    gibbs = sv.particle(q, 2.0, elbow) + sv.particle(q, 1.0, end)
    mechanism = sv.Mechanism(q, gibbs, actuators={"u": a, "v": b})
    residuals = {"X": end[0] - ca.cos(q.t) - 0.1, "Y": end[1] - ca.sin(q.t)}
    return mechanism, sv.Program({name: q.dt(e, order) if order else e for name, e in residuals.items()})


ROUND = [(0, "algebraic"), (1, "Taylor"), (2, "RK4")]


def on_the_circle(order):
    model, path = sv.derive(*two_links(order)), sv.derive(*two_links())
    start = path.start(guess={"a": -1.0, "b": 2.0})
    held = dict(zip(start.names, start.values, strict=True))
    return model, model.start(**{name: held[name] for name in model.state_names}) if order else start


@pytest.mark.parametrize(("order", "method"), ROUND)
def test_pivots_change_without_a_derivation(order, method, counted):
    model, start = on_the_circle(order)
    counted["derived"] = 0
    run = sv.simulate(model, start, (0.0, 12.0), sv.methods.RungeKutta(4, step=4e-3) if method == "RK4" else method)
    variants = {id(variant) for *_, variant in run.variants}
    assert counted["derived"] == 0 and run.counters["pivot_changes"] == 1 and len(variants) == 2
    assert max(np.abs(run.residual[name]).max() for name in ("X", "Y")) < 1e-6


@pytest.mark.filterwarnings("ignore:Internal dynamics unstable")
@pytest.mark.parametrize("which", ["ideal", "least torque", "round"])
def test_another_process_derives_and_compiles_nothing(which, counted):
    def simulated():
        model, start = on_the_circle(1) if which == "round" else begun(which)
        return sv.simulate(model, start, (0.0, 2.0), "DOP853")

    first = simulated()
    for name in counted:
        counted[name] = 0
    again = simulated()
    assert counted == {"derived": 0, "compiled": 0} and np.array_equal(first.jets, again.jets)
    assert first.counters == again.counters and len(first.variants) > 1


@pytest.mark.filterwarnings("ignore:Internal dynamics unstable")
@pytest.mark.parametrize("which", ["ideal", "round"])
def test_runs_with_other_pivots_are_saved_and_pickled(which, tmp_path):
    model, start = on_the_circle(1) if which == "round" else begun(which)
    run = sv.simulate(model, start, (0.0, 2.0), "DOP853")
    assert len(run.variants) > 1
    loaded = sv.load(run.save(tmp_path / "run"), model)
    assert loaded == run and [place_of(v) for *_, v in loaded.variants] == [place_of(v) for *_, v in run.variants]
    variant = run.variants[-1][2]
    copy = pickle.loads(pickle.dumps(variant))
    x, p = start.values, model.p
    assert copy == variant != model and place_of(copy) == place_of(variant)
    assert np.array_equal(copy.function("ode")(0.0, x, p), variant.function("ode")(0.0, x, p))


@pytest.mark.filterwarnings("ignore:Internal dynamics unstable")
def test_a_start_at_which_the_same_rows_have_no_pivots_is_derived_again(monkeypatch):
    """A symmetric stance: rows that divide by a choice of actuators have no value there, whatever solves them."""
    model, start = begun("ideal point")
    usual, chosen, repivot = sv.simulate(model, start, (0.0, 0.5), "DOP853"), [], Stepping._repivot

    def noted(stepping, t, x):
        chosen.append(stepping.model.reduction.orthogonal)
        return repivot(stepping, t, x)

    without = iter([True, False])
    monkeypatch.setattr(Stepping, "_repivot", noted)
    monkeypatch.setattr(Rank, "bad_choice", lambda *_: True)
    monkeypatch.setattr(Rank, "without_value", lambda *_: next(without, False))
    run = sv.simulate(model, start, (0.0, 0.5), "DOP853")
    assert chosen[:2] == [False, True] and run.success
    assert np.abs(run.jets - usual.jets).max() < 1e-6 * np.abs(usual.jets).max()


def test_parameters_change_with_other_pivots():
    q, p = sv.coordinates("x y z"), sv.parameters(m=1.0, l=1.0)
    mechanism = sv.Mechanism(q, sv.particle(q, p.m, ca.vertcat(*q)), 9.81 * p.m * q.jet(0)[2], parameters=p)
    program = sv.Program({"rod": ca.sumsqr(ca.vertcat(*q)) - p.l**2}, by="ideal")
    model = sv.derive(mechanism, program)
    other = without_choice(model).with_parameters(l=2.0)
    start = model.with_parameters(l=2.0).start(x=2.0, dz=1.0, dy=0.5)
    rates = other.function("ode")(0.0, start.values, other.p)
    assert other.reduction.realisation.definite and rates[3:6] == pytest.approx([-1.25 / 2, 0.0, -9.81], abs=1e-12)


def test_the_inertia_comes_first_where_it_and_the_constraints_give_accelerations():
    """Then balances divide by no choice of coordinates. With ideal reactions G M⁻¹B is definite, with others only regular."""
    forms = {"vtol-centre": (True, False), "appell-hamel": (True, True), "overhead-crane": (False, False), "spiral": (False, False)}
    for name, (first, definite) in forms.items():
        free = without_choice(sv.derive(*gallery[name].build()))
        assert (free.equations.range_space, free.reduction.realisation.definite) == (first, definite)
        assert not (first and any("choice of dependent" in name for name, _ in free.equations.all_pivots))


@pytest.mark.parametrize("place", ["diagonal", [[0, 1], [1, 0]]])
def test_places_of_other_pivots_of_the_same_rows_are_solved_without(place):
    """As files of runs have them that pivots of the same rows were chosen for."""
    model = sv.derive(*two_links(1))
    assert variant_at(model, [place]) is without_choice(model)
    near = variant_at(model, [0.1, dict.fromkeys(model.jet_names, 0.5), {}, place])
    assert near.reduction.orthogonal and place_of(near)[:3] == (0.1, dict.fromkeys(model.jet_names, 0.5), {})


def springs(stages, order=0):
    """Two links whose end point goes round its base, moved through springs in series: by blocks from two stages on."""
    q = sv.coordinates(" ".join(f"{letter}{k}" for k in range(stages + 1) for letter in "ab"))
    a, b, *others = x = list(q)
    elbow = ca.vertcat(ca.cos(a), ca.sin(a))
    end = elbow + ca.vertcat(ca.cos(a + b), ca.sin(a + b))
    gibbs = sv.particle(q, 2.0, elbow) + sv.particle(q, 1.0, end) + sum(0.25 * q.dt(e, 2) ** 2 for e in others)
    stretches = [d - c for c, d in zip(x, others, strict=False)]
    potential = sum(100.0 * e**2 + 12.5 * e**4 for e in stretches)
    mechanism = sv.Mechanism(q, gibbs, potential, actuators={"u": x[-2], "v": x[-1]})
    residuals = {"X": end[0] - ca.cos(q.t) - 0.1, "Y": end[1] - ca.sin(q.t)}
    program = sv.Program({name: q.dt(e, order) if order else e for name, e in residuals.items()})
    return mechanism, program, {e.name(): -1.0 if e.name()[0] == "a" else 2.0 for e in x}


@pytest.mark.parametrize(("stages", "order", "derived", "changes"), [(2, 0, 0, 1), (1, 0, 1, 7), (1, 1, 1, 7)])
def test_blocks_and_hidden_rows_change_their_pivots(stages, order, derived, changes, counted, tmp_path):
    """Blocks are solved without a choice; rows that divide are derived once for each choice."""
    *specification, guess = springs(stages, order)
    model = sv.derive(*specification)
    if order:
        plan = sv.derive(*springs(stages)[:2]).start(guess=guess)
        held = dict(zip(plan.names, plan.values, strict=True))
        start = model.start(**{name: held[name] for name in model.state_names})
    else:
        start = model.start(guess=guess)
    counted["derived"] = 0
    method = "Taylor" if order else None
    run = sv.simulate(model, start, (0.0, 12.0), method)
    assert counted["derived"] == derived
    assert changes <= run.counters["pivot_changes"] <= (1 if changes == 1 else changes + 3)  # a choice may take two
    assert len({id(variant) for *_, variant in run.variants}) <= 4
    assert sv.verify(run).passed
    loaded = sv.load(run.save(tmp_path / "run"), model)
    assert loaded == run and [place_of(v) for *_, v in loaded.variants] == [place_of(v) for *_, v in run.variants]
    again = sv.simulate(model, start, (0.0, 12.0), method)
    assert counted["derived"] == derived and np.array_equal(run.jets, again.jets)


@pytest.mark.filterwarnings("ignore:Internal dynamics unstable")
@pytest.mark.parametrize(("name", "derived", "variants"), [("vtol-centre", 0, 2), ("steady-satellite", 1, 2)])
def test_a_choice_of_pivots_that_returns_is_derived_once(name, derived, variants, counted):
    scene = gallery[name]
    model = sv.derive(*scene.build())
    for expected in (derived, 0):
        counted["derived"] = 0
        run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)
        assert counted["derived"] == expected and len({id(variant) for *_, variant in run.variants}) <= variants
        assert run.success and sv.verify(run).passed


def test_other_parameters_take_over_the_pivots_of_a_start(counted):
    """A hovering aircraft: rows that divide by the inclination of its rope are derived once, whatever its masses."""
    scene = gallery["slung-load-3d"]
    model, runs = sv.derive(*scene.build()), []
    for derived, changes in ((1, {}), (0, {"m": 9.0, "J": 0.3})):
        counted["derived"] = 0
        other = model.with_parameters(**changes)
        runs.append(sv.simulate(other, other.start(**scene.start, guess=scene.guess), (0.0, 0.5)))
        assert counted["derived"] == derived and sv.verify(runs[-1]).passed
    alone = pickle.loads(pickle.dumps(other))
    again = sv.simulate(alone, alone.start(**scene.start, guess=scene.guess), (0.0, 0.5))
    assert np.array_equal(runs[-1].jets, again.jets)
    shorter = model.with_parameters(L=0.8)  # coordinates that are zero but for rounding have their usual sizes
    run = sv.simulate(shorter, shorter.start(**scene.start, guess=scene.guess), (0.0, 0.5))
    assert run.success and sv.verify(run).passed


def test_other_paths_take_over_the_pivots_of_a_start(counted):
    """A load that hangs at rest: rows that divide by the inclination of its rope are derived once, whatever its path."""
    scene = gallery["crane-3d"]
    model = sv.derive(*scene.build())
    for derived, end in ((1, 1.0), (0, 0.5)):
        counted["derived"] = 0
        other = model.with_references(s=sv.paths.rest_to_rest(0.0, end, duration=6.0, smoothness=6))
        run = sv.simulate(other, other.start(guess=scene.guess), scene.t_span)
        assert counted["derived"] == derived and sv.verify(run).passed


@pytest.mark.parametrize(("slope", "derived"), [(3.0, 0), (1.0, 0), (0.02, 1)])
def test_a_variant_that_does_not_serve_other_parameters_is_derived_with_these(slope, derived, counted):
    """A bead on a bar that is inclined at first: with a small slope the pivot of the variant nearly vanishes."""
    q, p = sv.coordinates("x y"), sv.parameters(m=1.0, slope=3.0)
    x, y = q
    mechanism = sv.Mechanism(q, sv.particle(q, p.m, ca.vertcat(x, y)), 9.81 * p.m * y, parameters=p)
    model = sv.derive(mechanism, sv.Program({"bar": ca.sin(x) + p.slope * y * (1.0 + x**2)}, by="ideal"))
    jets = np.zeros(len(model.jet_names))
    derived_near(model, 0.0, jets)
    counted["derived"] = 0
    other = model.with_parameters(slope=slope)
    near = derived_near(other, 0.0, jets)
    assert counted["derived"] == derived and pivot_strength(near, 0.0, jets) > 0.3
    assert near is derived_near(other, 0.0, -jets)  # the sign of a zero is no other place
    rates = near.function("ode")(0.0, jets[: len(model.state_names)], near.p)
    assert rates[2:4] == pytest.approx(9.81 / (1 + slope**2) * np.array([slope, -1.0]), rel=1e-12)


def test_pivots_at_a_state_ask_for_no_sizes(gallery_model, monkeypatch):
    model, scene = gallery_model("steady-satellite"), gallery["steady-satellite"]
    start = model.start(**scene.start, guess=scene.guess)
    y = model.function("ode")(start.t, start.values, model.p)
    monkeypatch.setattr(Plan, "sizes", None)
    jets = np.append(start.values, y[len(start.values) - model.n : len(start.values)])
    np.testing.assert_allclose(pivots_at(model, start.t, jets), y[len(start.values) :], rtol=1e-9)
