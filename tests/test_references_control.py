"""Laws, loops and plants along references against the same scenes with formulas of q.t, and against closed forms."""

import pickle
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
import referred
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.spec.shapes import heights, moved

ROUNDING = 1e-11  # of each signal's largest value, after 200 samples under a law
OF_FILTER = 1e-9  # the same, where the steady solution of a filter's Riccati equation amplifies it
SPAN = (0.0, 2.0)


def same(a, b, names, within=ROUNDING):
    """Signals of two runs are equal to rounding."""
    for name in names:
        size = max(np.abs(b[name]).max(), 1e-9)
        assert np.abs(a[name] - b[name]).max() <= within * size, name


def planned(mechanism, residual, **start):
    model = sv.derive(mechanism, sv.Program({"X": residual}, by="actuators"))
    run = sv.simulate(model, model.start(**start), SPAN)
    first = np.array([run[name][0] for name in sv.plant(mechanism).state_names])
    return SimpleNamespace(mechanism=mechanism, model=model, run=run, first=first)


def carriage(path):
    """A cart with a pendulum below, whose cart follows a reference with the name of its coordinate, or a formula."""
    q, p = sv.coordinates("x theta"), sv.parameters(M=1.0, m=0.1, L=0.5, g=9.81)
    x, theta = q
    load = ca.vertcat(x + p.L * ca.sin(theta), -p.L * ca.cos(theta))
    bodies = sv.particle(q, p.M, [x, 0]) + sv.particle(q, p.m, load)
    mechanism = sv.Mechanism(q, bodies, p.m * p.g * load[1], {"force": x}, p)
    return planned(mechanism, x - path(q, "x", 0.0, 1.0, 2.0), theta=0.1, dtheta=0.0)


def beam(path):
    """A cart with a pendulum on a sloping beam whose support moves, in a wind that freshens."""
    q, p = sv.coordinates("x z theta"), sv.parameters(M=2.0, m=0.5, L=0.7, g=9.81, c=0.4)
    x, z, theta = q
    B, W = path(q, "B", 0.0, 0.4, 2.0), path(q, "W", 0.0, 3.0, 2.0)
    load = ca.vertcat(x + p.L * ca.sin(theta), z - p.L * ca.cos(theta))
    mechanism = sv.Mechanism(
        q,
        sv.particle(q, p.M, [x, z]) + sv.particle(q, p.m, load),
        p.M * p.g * z + p.m * p.g * load[1],
        {"drive": x},
        p,
        constraints={"beam": z - B - 0.1 * x},
        forces={"x": p.c * (W - q.d()[0])},
        outputs={"gap": load[1] - B},
    )
    return planned(mechanism, x - path(q, "X", 0.0, 1.0, 2.0), theta=0.0, dtheta=0.0)


def followed(q, name, start, end, duration):
    return q.references(**{name: sv.paths.rest_to_rest(start=start, end=end, duration=duration)})[name]


def formula(q, _name, start, end, duration):
    return referred.polynomial(q.t, start, end, duration)


@pytest.fixture(scope="module", params=[carriage, beam], ids=["carriage", "beam"])
def both(request):
    """The scene with references, and with formulas."""
    return [request.param(path) for path in (followed, formula)]


@pytest.fixture(scope="module")
def cart():
    return carriage(followed)


@pytest.fixture(scope="module")
def supported():
    return beam(followed)


def limited(scene, plant):
    """Feedback within limits of an actuator, and of the reaction of the beam where there is one."""
    plant = sv.plant(scene.mechanism, limits={plant.inputs[0]: 30.0})
    bounds = {"multiplier_beam": (24.0, None)} if plant.constrained else None
    return sv.limited(sv.lqr(scene.run, plant), plant, bounds=bounds)


def pushed(scene, law):
    """The loop of a law from beside the plan."""
    x0 = scene.first.copy()
    x0[scene.mechanism.q.names.index("theta")] += 0.05
    plant = sv.plant(scene.mechanism)
    return sv.close(plant, law(scene, plant), x0, SPAN)


LAWS = {
    "lqr": lambda s, plant: sv.lqr(s.run, plant, integral={"X": 1.0}, varying=True),
    "computed": lambda s, plant: sv.computed(s.run, plant),
    "estimated": lambda s, plant: sv.output_feedback(
        sv.lqr(s.run, plant, integral={"X": 1.0}), plant, {"x": 1e-3, "theta": 1e-3}
    ),
    "limited": limited,
}


@pytest.mark.parametrize("law", LAWS)
def test_loops_as_along_formulas(both, law):
    new, old = (pushed(scene, LAWS[law]) for scene in both)
    within = OF_FILTER if law == "estimated" else ROUNDING
    same(new, old, old.names, within)
    assert list(new.residual) == list(old.residual)
    for name, values in old.residual.items():
        assert np.abs(new.residual[name] - values).max() < within / 10
    assert np.abs(new.signals - old.signals).max(initial=0.0) < 10 * within
    if law == "limited" and new.plant.constrained:
        assert 0 < np.mean(new.signal["bound multiplier_beam"] != 0) < 1


def test_limits_without_a_compiler(both, monkeypatch):
    compiled = pushed(both[0], limited)
    monkeypatch.setenv("SERVOCTL_COMPILER", "none")
    same(pushed(both[0], limited), compiled, compiled.names)


def test_many_loops_as_along_formulas(both):
    masses, traces = {"m": np.linspace(0.08, 0.12, 3)}, []
    for scene in both:
        closed = pushed(scene, LAWS["lqr"])
        batch = sv.close_many(closed, masses | {"theta": np.zeros(3)}, record=["residual X", "theta"])
        traces.append(np.concatenate([batch.trace["residual X"], batch.trace["theta"]]))
    assert np.abs(traces[0] - traces[1]).max() < 1e-12


def test_residuals_follow_the_path_of_the_plan(cart):
    """Models that differ in paths alone are different, for what is derived once for a model and a plant, too."""
    path, plant = sv.paths.rest_to_rest(start=0.0, end=0.5, duration=2.0), sv.plant(cart.mechanism)
    other = cart.model.with_references(x=path)
    assert other != cart.model
    assert other.with_references(x=cart.model.paths["x"]) == cart.model
    pushed(cart, LAWS["lqr"]).residual  # noqa: B018
    run = sv.simulate(other, other.start(theta=0.1, dtheta=0.0), SPAN)
    closed = sv.close(plant, sv.lqr(run, plant, integral={"X": 1.0}), cart.first, SPAN)
    assert np.abs(closed.residual["X"][0] - (closed["x"] - path(closed.t))).max() < 1e-15
    sv.close_many(pushed(cart, LAWS["lqr"]), {"m": [0.1]})
    many = sv.close_many(closed, {"m": [0.1]}, record=["residual X"])
    assert np.abs(many.trace["residual X"][:, 0] - closed.residual["X"][0]).max() < 1e-12


def test_integral_of_a_residual(cart):
    """z+ = z + Ts φ with φ = x - r at each sample, r in the schedule."""
    closed = pushed(cart, LAWS["lqr"])
    expected = np.cumsum(closed["x"] - cart.model.paths["x"](closed.t)) / closed.law.rate
    assert np.abs(closed.signal["integral of X"][1:] - expected[:-1]).max() < 1e-14


def test_copies_that_were_pickled_apart(cart, supported):
    for scene in (cart, supported):
        plant = sv.plant(scene.mechanism)
        run, copy = (pickle.loads(pickle.dumps(one)) for one in (scene.run, plant))
        for law in (lambda run, plant: sv.lqr(run, plant, integral={"X": 1.0}), sv.computed):
            assert np.array_equal(law(run, copy).schedule, law(scene.run, plant).schedule)


def test_a_moving_support_and_other_paths(supported):
    path, plant = sv.paths.rest_to_rest(start=0.0, end=0.2, duration=1.0), sv.plant(supported.mechanism)
    assert list(plant.paths) == ["B", "W"]
    other = plant.with_references(B=path)
    closed = sv.close(other, sv.feedforward(supported.run, plant), supported.first, SPAN)
    assert np.abs(closed["z"] - path(closed.t) - 0.1 * closed["x"]).max() < 1e-12
    driven = sv.simulate(other, dict(zip(plant.state_names, supported.first, strict=True)), SPAN)
    assert np.abs(driven["z"] - path(driven.t) - 0.1 * driven["x"]).max() < 1e-9
    x = closed.states[:, 50]
    assert np.allclose(other.near(0.5, x).rates(0.5, x, [1.0]), other.rates(0.5, x, [1.0]), rtol=1e-12, atol=1e-12)


def test_blocks_that_are_not_full(supported):
    """CasADi evaluates 128 points at once; parameters of points beyond the last one have a place of paths, too."""
    plant, run = sv.plant(supported.mechanism), supported.run
    f, x = plant.function("accelerations"), run.jets[: plant.n_x]
    for n in (256, 100):
        t, p = run.t[:n], plant.p(run["drive"][None, :n])
        expected = [f(t[k], x[:, k], p[:, k]) for k in range(n)]
        assert np.abs(f.grid(t, x[:, :n], p) - np.transpose(expected)).max() < 1e-12


def test_a_loop_keeps_no_place_in_memory(supported):
    plant = sv.plant(supported.mechanism)
    closed = sv.close(plant, sv.lqr(supported.run, plant), supported.first, (0.0, 0.5))
    copy = pickle.loads(pickle.dumps(closed))
    assert copy == closed and copy.plant.place != plant.place
    assert np.array_equal(copy["gap"], closed["gap"])
    assert sv.verify(copy).passed


def test_a_mass_in_a_wind():
    """M x'' = W: the speed is the integral of W, the jerk W'/M."""
    q, p = sv.coordinates("x"), sv.parameters(M=2.0)
    (x,), W = q, q.references(W=None).W
    mechanism = sv.Mechanism(q, sv.particle(q, p.M, [x]), 0, {"u": x}, p, forces={"x": W}, outputs={"jerk": q.d(3)[0]})
    plant, conditions = sv.plant(mechanism), {"t_span": (0.0, 1.0), "timing": sv.Timing(rate=200.0)}
    with refused(SpecificationError, "W", missing=["W"]):
        sv.close(plant, lambda t, y: [0.0], [0.0, 0.0], **conditions)
    path = sv.paths.rest_to_rest(start=0.0, end=3.0, duration=1.0)
    closed = sv.close(plant.with_references(W=path), lambda t, y: [0.0], [0.0, 0.0], **conditions)
    assert closed["dx"][-1] == pytest.approx(0.75, rel=1e-9)
    assert np.abs(closed["jerk"] - path.jets(closed.t, 1)[1, 0] / 2).max() < 1e-12
    with refused(SpecificationError, "W", references=("W",)):
        sv.identify(plant, [closed], ["M"])
    with refused(SpecificationError, "W", references=("W",)):
        sv.relaxed(plant, sv.Program({"X": x}, by="actuators"), (0.0, 1.0))
    with refused(NameUnknown, "V", "W"):
        plant.with_references(V=path)


def test_exact_linearisation_needs_smooth_paths():
    q, p = sv.coordinates("x"), sv.parameters(M=1.0)
    (x,), r = q, q.references(X=sv.paths.rest_to_rest(start=0.0, end=1.0, duration=1.0, smoothness=2)).X
    mechanism = sv.Mechanism(q, sv.particle(q, p.M, [x]), 0, {"u": x}, p)
    scene = planned(mechanism, x - r)
    assert sv.computed(scene.run, sv.plant(mechanism)).info["orders"] == {"X": 2}
    with refused(SpecificationError, "X", reference="X", needs=3, has=2, t=0.0):
        sv.computed(scene.run, sv.plant(mechanism, lag={"u": 0.1}))


def test_shapes_and_heights_along_references():
    """A target is drawn where the path is; a weight that hangs from a moving support shows what is up."""
    q, p = sv.coordinates("x z"), sv.parameters(M=1.0, g=9.81)
    x, z = q
    path = sv.paths.rest_to_rest(start=0.0, end=1.0, duration=1.0)
    X, B = q.references(X=path, B=path)
    mechanism = sv.Mechanism(
        q,
        sv.particle(q, p.M, [x, z]),
        p.M * p.g * (z + B),
        {"u": x, "v": z},
        p,
        outputs={"height": z + B},
        shapes={"target": [(X, 0), (x, z)]},
    )
    model = sv.derive(mechanism, sv.Program({"X": x - X, "Z": z}, by="actuators"))
    other = model.with_references(X=2 * path)
    run, t = sv.simulate(other, other.start(), (0.0, 1.0)), np.array([0.0, 0.5, 1.0])
    drawn = moved(mechanism, t, np.zeros((2, 3)), model.parameters, other.paths)["target"]
    assert np.array_equal(drawn[:, 0], [2 * path(t), np.zeros(3)])
    assert heights(mechanism, ["height"], run.t, run.jets[:2], run.model.parameters, run.model.paths) == [1]
    closed = sv.close(sv.plant(mechanism), sv.lqr(run, sv.plant(mechanism)), run.jets[:4, 0], (0.0, 0.5))
    for motion in (run, closed):
        assert sv.figures.stroboscope(motion) is not None
