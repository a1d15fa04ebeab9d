"""Levels of modelling in one trade-off: errors against closed forms, advice that holds on the motion."""

from functools import cache, partial

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import LimitExceeded, NameUnknown, SingularProgram, SpecificationError
from servoctl.figures.work_precision import COLOURS
from servoctl.gallery import gallery
from servoctl.model.model import including
from servoctl.study.tradeoff import ERRORS

# --- scenes, each with a parameter that its reference has more than its simple level


def lift(rope="rigid", smoothness=6):
    """A winch lifts a mass on a rope that is rigid or a spring."""
    p = sv.parameters(m=100.0, M=20.0, k=2e5, g=9.81)
    q = sv.coordinates("h y" if rope == "elastic" else "h")
    h, y = tuple(q)[0], tuple(q)[-1]
    path = q.references(load=sv.paths.rest_to_rest(0.0, 2.0, duration=3.0, smoothness=smoothness)).load
    mechanism = sv.Mechanism(
        q,
        sv.particle(q, p.M, h) + sv.particle(q, p.m, y),
        potential=p.m * p.g * y + p.k * (y - h) ** 2 / 2,
        actuators={"winch": h},
        outputs={"load": y},
        parameters=p,
    )
    return mechanism, sv.Program({"load": y - path}, by="actuators")


def joint(kind="rigid"):
    """A link in gravity on a joint that is rigid or elastic."""
    p = sv.parameters(J=0.5, J_motor=0.1, k=2000.0, mgl=5.0)
    q = sv.coordinates("motor link" if kind == "elastic" else "motor")
    motor, link = tuple(q)[0], tuple(q)[-1]
    mechanism = sv.Mechanism(
        q,
        sv.particle(q, p.J_motor, motor) + sv.particle(q, p.J, link),
        potential=-p.mgl * ca.cos(link) + p.k * (motor - link) ** 2 / 2,
        actuators={"torque": motor},
        outputs={"angle": link},
        parameters=p,
    )
    path = q.references(angle=sv.paths.rest_to_rest(0.0, 1.5, duration=1.0, smoothness=6)).angle
    return mechanism, sv.Program({"angle": link - path}, by="actuators")


def cart(friction=False, linear=False):
    """A cart follows a path and carries a pendulum, with friction in its joint or none, for small angles or all."""
    p = sv.parameters(m=1.0, M=2.0, l=1.0, g=9.81, d=0.05, distance=1.0)
    q = sv.coordinates("x theta")
    x, theta = q
    bob = ca.vertcat(x + p.l * ca.sin(theta), -p.l * ca.cos(theta))
    swinging = sv.particle(q, p.m, x + p.l * theta if linear else bob)
    mechanism = sv.Mechanism(
        q,
        sv.particle(q, p.M, x) + swinging,
        potential=p.m * p.g * (p.l * theta**2 / 2 if linear else bob[1]),
        forces={"theta": -p.d * q.d(1)[1]} if friction else {},
        actuators={"force": x},
        parameters=p,
    )
    path = p.distance * q.references(x=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=4)).x
    return mechanism, sv.Program({"x": x - path}, by="actuators")


def arm(payload="point"):
    """A two-link arm whose payload is a point or a body."""
    p = sv.parameters(m=2.0, M=3.0, J=0.05, l=0.8, g=9.81)
    q = sv.coordinates("a b")
    a, b = q
    elbow = p.l * ca.vertcat(ca.cos(a), ca.sin(a))
    tip = elbow + p.l * ca.vertcat(ca.cos(a + b), ca.sin(a + b))
    S = sv.particle(q, p.m, elbow) + sv.particle(q, p.M, tip)
    mechanism = sv.Mechanism(
        q,
        S + sv.particle(q, p.J, a + b) if payload == "body" else S,
        potential=p.g * (p.m * elbow[1] + p.M * tip[1]),
        actuators={"shoulder": a, "elbow": b},
        parameters=p,
    )
    path = sv.paths.rest_to_rest((0.3, 0.5), (1.2, 1.4), duration=1.0, smoothness=4)
    r = q.references(a=path[0], b=path[1])
    return mechanism, sv.Program({"a": a - r.a, "b": b - r.b}, by="actuators")


def crane(rope="rigid"):
    """An overhead crane on a rope that is rigid or elastic."""
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81, EA=1e6)
    q = sv.coordinates("x l theta s" if rope == "elastic" else "x l theta")
    x, l, theta, *stretch = q
    length = l + sum(stretch)
    load = ca.vertcat(x + length * ca.sin(theta), length * ca.cos(theta))
    mechanism = sv.Mechanism(
        q,
        sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load),
        potential=-p.m_load * p.g * load[1] + sum(p.EA / l * s**2 / 2 for s in stretch),
        actuators={"trolley": x, "hoist": l},
        outputs={"X": load[0], "Z": load[1]},
        parameters=p,
    )
    path = sv.paths.rest_to_rest((0.0, 4.0), (5.0, 2.0), duration=6.0, smoothness=6)
    r = q.references(X=path[0], Z=path[1])
    return mechanism, sv.Program({"X": load[0] - r.X, "Z": load[1] - r.Z}, by="actuators")


@cache
def derived(build, *kind):
    """The model of a scene, derived once for all tests."""
    return sv.derive(*build(*kind))


def ropes(k=2e5, smoothness=6, **options):
    """The trade-off between an elastic rope, the reference, and a rigid one."""
    models = {name: derived(lift, name).with_parameters(k=k) for name in ("elastic", "rigid")}
    return sv.tradeoff(models, models["elastic"].start(), (0.0, 3.0), **options)


def pendula(*others, start=None, span=(0.0, 4.0), reference="friction", **options):
    """The trade-off between pendula on a cart."""
    models = {name: PENDULA[name]() for name in (reference, *others)}
    return sv.tradeoff(models, models[reference].start(**start or {}), span, **options)


PENDULA = {
    "linear": partial(derived, cart, False, True), "plain": partial(derived, cart), "friction": partial(derived, cart, True),
}  # fmt: skip
TOLERANCES = (1e-3, 1e-6, 1e-9)


@pytest.fixture(scope="module")
def three():
    return pendula("plain", "linear", methods={"Taylor": TOLERANCES})


def instants(t1, count=2001):
    return np.linspace(0.0, t1, count)


def derivative(order, t):
    path = sv.paths.rest_to_rest(0.0, 2.0, duration=3.0, smoothness=6)
    return path.jets(t, order)[order, 0]


# --- errors


@pytest.mark.parametrize("k", [1e5, 4e5])
def test_a_rigid_rope_errs_by_its_stretch(k):
    """h = y + m (y'' + g)/k; the winch's force differs by M m y''''/k."""
    t, m, M = instants(3.0), 100.0, 20.0
    y, d2y, d4y = (derivative(order, t) for order in (0, 2, 4))
    rigid = ropes(k, outputs=["h"]).where(model="rigid").rows()[0]
    stretch = m * (d2y + 9.81) / k
    assert rigid["error"] == pytest.approx(stretch.max() / (y + stretch).max(), rel=1e-3)
    force = M * (d2y + m * d4y / k) + m * (d2y + 9.81)
    assert rigid["actuation"] == pytest.approx(np.abs(M * m * d4y / k).max() / force.max(), rel=1e-3)
    assert rigid["integration"] < 1e-12, "it is an error of modelling alone"


def test_the_same_machine_in_other_coordinates_has_no_error():
    """Relative and redundant coordinates, with a material constraint."""
    models = {name: sv.derive(*gallery["overhead-crane"].build(coordinates=name)) for name in ("relative", "redundant")}
    start = models["relative"].start(guess={"l": 4.0})
    study = sv.tradeoff(models, start, (0.0, 8.0), {"algebraic": 0.1})
    assert {"x", "l", "dx", "dl"} <= set(study.meta["outputs"])
    assert np.all(study["error"] < 1e-11) and np.all(study["actuation"] < 1e-11)
    outputs = sv.tradeoff(models, start, (0.0, 8.0), {"algebraic": 0.1}, outputs=["x", "l", "tension", "X", "Z"])
    assert np.all(outputs["error"] < 1e-11)


def test_errors_of_modelling_and_of_integration_are_told_apart(three):
    for model in ("linear", "plain"):
        rows = three.where(model=model)
        assert rows["error"].min() > 1e-2 and rows["integration"][-1] < 1e-9
        assert np.all(np.abs(rows["error"] - rows["error"][-1]) <= rows["integration"] + 1e-9)
    own = three.where(model="friction")
    assert np.array_equal(own["error"], own["integration"])
    assert own["integration"][0] > 1e3 * own["integration"][-1]


def test_operations_do_not_depend_on_the_machine_and_order_the_models(three):
    for study, order in ((three, ("linear", "plain", "friction")), (ropes(methods={"algebraic": 0.1}), ("rigid", "elastic"))):
        counts = [set(study.where(model=model)["operations"]) for model in order]
        assert all(len(count) == 1 for count in counts) and counts == sorted(counts, key=min)
    assert np.all(np.isfinite(three["seconds"])) and np.all(three["evaluations"] > 0)


def test_a_stiff_model_is_measured_by_an_implicit_method_too():
    """A damped spring with a time constant of 0.5 ms: 2,000 of them in the span."""
    def coupled(stiff=True):
        q = sv.coordinates("x y")
        x, y = q
        pull = 2e3 * (q.d(1)[1] - q.d(1)[0]) + 1e5 * (y - x)
        mechanism = sv.Mechanism(
            q, sv.particle(q, 2.0, x) + sv.particle(q, 1.0, y), actuators={"u": x},
            forces={"x": pull if stiff else y - x, "y": -pull if stiff else x - y},
        )  # fmt: skip
        path = q.references(x=sv.paths.rest_to_rest(0.0, 1.0, 1.0, smoothness=4)).x
        return sv.derive(mechanism, sv.Program({"x": x - path}, by="actuators"))

    models = {"stiff": coupled(), "soft": coupled(False)}
    study = sv.tradeoff(models, models["stiff"].start(), (0.0, 1.0), budget=5.0)
    assert list(dict.fromkeys(study.where(model="soft")["method"])) == ["Taylor", "RadauIIA"]
    stiff = study.where(model="stiff").take(np.flatnonzero(np.isfinite(study.where(model="stiff")["error"])))
    implicit, series = stiff.where(method="RadauIIA", value=1e-5), stiff.where(method="Taylor", value=1e-5)
    assert implicit["steps"][0] < series["steps"][0] / 10 and implicit["error"][0] < 1e-4


def test_sizes_make_errors_absolute():
    d2y = derivative(2, instants(3.0))
    rigid = ropes(outputs={"h": 1e-3}).where(model="rigid")
    assert rigid["error"][0] == pytest.approx(1e3 * (100 * (d2y + 9.81) / 2e5).max(), rel=1e-3)
    held = ropes(outputs="load", methods={"algebraic": 0.1})
    assert np.all(held["error"] < 1e-12), "the program holds the load in every model"


@pytest.mark.usefixtures("uncompiled")
def test_models_start_alike():
    """What the start of the reference holds is held where it exists; the rest is as near as possible to it."""
    model = PENDULA["friction"]()
    for d, alike in ((0.0, True), (0.05, False)):
        models = {"friction": model.with_parameters(d=d), "plain": PENDULA["plain"]()}
        start = models["friction"].start(theta=0.3)
        plain = sv.tradeoff(models, start, (0.0, 1.0), {"Taylor": 1e-12}).where(model="plain")
        assert plain["error"][0] < 1e-11 if alike else plain["error"][0] > 1e-4


def test_coordinates_that_play_no_part_are_compared_on_demand():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, x) + sv.particle(q, 2.0, y), potential=2 * y**2, actuators={"u": x})
    r = q.references(x=sv.paths.rest_to_rest(0.0, 1.0, 1.0, smoothness=4))
    model = sv.derive(mechanism, sv.Program({"x": x - r.x}, by="actuators"))
    assert "y" not in sv.tradeoff(model, model.start(), (0.0, 1.0)).meta["outputs"]
    whole = including(model, ["y"])
    study = sv.tradeoff(whole, whole.start(y=0.1), (0.0, 1.0), {"Taylor": 1e-9}, "project", outputs=["x", "y"])
    assert study.meta["outputs"] == ["x", "y"] and study["error"][0] < 1e-8


def test_ideal_programs_compare_reactions():
    wheel = gallery["appell-hamel"]
    light = sv.derive(*wheel.build())
    models = {"heavy": light.with_parameters(I_x=0.25), "light": light}
    study = sv.tradeoff(models, models["heavy"].start(dphi=1.0, dtheta=2.0), (0.0, 1.0), {"Taylor": [1e-3, 1e-9]})
    light = study.where(model="light")
    assert np.all(light["error"] > 1e-3) and np.all(light["actuation"] > 1e-3)
    assert study.where(model="heavy")["actuation"][-1] < 1e-8


# --- what a model cannot do


def test_what_no_row_reaches_names_the_nearest_model():
    study = ropes()
    assert study.recommend(error=0.1).row["model"] in ("rigid", "elastic")
    with refused(LimitExceeded, limit=1e-20) as caught:
        study.recommend(error=1e-20)
    assert "Nearest: elastic" in str(caught.value)


def test_a_model_that_ends_early_is_a_row_and_a_reference_that_does_is_refused():
    scenes = {"ideal": gallery["constant-speed"], "horizontal": gallery["constant-speed-horizontal"]}
    models = {name: sv.derive(*scene.build()) for name, scene in scenes.items()}
    held = dict(scenes["ideal"].start)
    study = sv.tradeoff(models, models["ideal"].start(**held), (0.0, 0.8), {"Taylor": 1e-6})
    assert study.where(model="horizontal")["failure"][0].startswith("SingularProgram")
    assert np.isnan(study.where(model="horizontal")["error"][0])
    with pytest.raises(SingularProgram):
        sv.tradeoff(dict(reversed(models.items())), models["horizontal"].start(**held), (0.0, 0.8))


def test_inputs_are_refused_in_words():
    elastic, span = derived(lift, "elastic"), (0.0, 3.0)
    start = elastic.start()
    with refused(NameUnknown, name="laod", match="load"):
        sv.tradeoff(elastic, start, span, outputs=["laod"])
    with refused(SpecificationError, name="model 'one'", type="int"):
        sv.tradeoff({"elastic": elastic, "one": 1}, start, span)
    for outputs in ([], {}, 3):
        with refused(SpecificationError):
            sv.tradeoff(elastic, start, span, outputs=outputs)
    with refused(SpecificationError, models=0):
        sv.tradeoff({}, start, span)
    with refused(SpecificationError, models=["rope", "joint"]):
        sv.tradeoff({"rope": elastic, "joint": derived(joint)}, start, (0.0, 1.0))


# --- advice


def test_a_recommendation_holds_at_all_instants(three):
    """The recommended motion is compared with the reference's where nothing was measured."""
    t = np.sort(np.random.default_rng(5).uniform(0.0, 4.0, 3000))
    model = PENDULA["friction"]()
    exact = sv.simulate(model, model.start(), (0.0, 4.0), sv.methods.Taylor(rtol=1e-15, atol=1e-15), drift="project", t_eval=t)
    for error in (0.5, 0.2, 1e-4, 1e-6, 1e-9):
        best = three.recommend(error=error)
        model = PENDULA[best.row["model"]]()
        run = sv.simulate(model, model.start(), (0.0, 4.0), t_eval=t, **best)
        off = max(np.abs(run[name] - exact[name]).max() / np.abs(exact[name]).max() for name in ("x", "theta"))
        assert off <= error and off <= 1.02 * best.row["error"]


def test_the_front_and_the_advice_follow_from_the_rows(three):
    for of in ERRORS:
        front = three.pareto(of=of)
        assert np.all(np.diff(front["seconds"]) > 0) and np.all(np.diff(front[of]) < 0) or len(front) == 1
    fast = three.recommend(seconds=1.0)
    assert fast.row["model"] == "friction" and fast.row["error"] == three["error"].min()
    best = three.recommend(error=1e-4, of="actuation")
    assert best.row["model"] == "friction" and best.row["actuation"] <= 1e-4
    with refused(NameUnknown, name="aktuation", match="actuation"):
        three.recommend(error=1.0, of="aktuation")


# --- the table


def test_a_study_of_models_is_saved_printed_and_drawn(three, tmp_path):
    again = sv.load(three.save(tmp_path / "models"))
    assert type(again) is sv.types.TradeOff and repr(again) == repr(three)
    lines = repr(three).splitlines()
    assert len(lines) <= 12 and max(map(len, lines)) <= 120 and lines[4].split()[0] == "model"
    axes = three.plot(title="pendula")
    legend = axes.get_legend()
    labels = {key.get_text(): line.get_color() for key, line in zip(legend.get_texts(), legend.get_lines(), strict=True)}
    best = set(three.pareto()["model"])
    assert {name for name, colour in labels.items() if colour in COLOURS} == best
    assert all(any(name in label for label in labels) for name in PENDULA)
    assert "actuation" in three.plot(of="actuation").get_ylabel()
    with refused(NameUnknown, name="price"):
        three.plot(cost="price")
