"""Levels of modelling: errors against closed forms, advice that holds on the motion, predictions against measurements."""

from functools import cache, partial

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import quad

import servoctl as sv
from servoctl.errors import LimitExceeded, NameUnknown, SingularProgram, SpecificationError
from servoctl.figures.work_precision import COLOURS
from servoctl.gallery import gallery
from servoctl.study.levels import ERRORS
from servoctl.study.modelling import _signal_sizes
from servoctl.study.power_law import power_law

# --- scenes, each with a parameter that its reference has more than its simple level


def lift(rope="rigid", smoothness=6):
    """A winch lifts a mass on a rope that is rigid or a spring."""
    p = sv.parameters(m=100.0, M=20.0, k=2e5, g=9.81)
    q = sv.coordinates("h y" if rope == "elastic" else "h")
    h, y = tuple(q)[0], tuple(q)[-1]
    path = sv.paths.rest_to_rest(q.t, 0.0, 2.0, duration=3.0, smoothness=smoothness)
    mechanism = sv.Mechanism(
        q,
        sv.particle(q, p.M, h) + sv.particle(q, p.m, y),
        potential=p.m * p.g * y + p.k * (y - h) ** 2 / 2,
        actuators={"winch": h},
        outputs={"load": y},
        parameters=p,
    )
    return mechanism, sv.Program({"load": y - path}, by="actuators")


def drive(tau=None):
    """A mass on a line, under a force that follows its input at once or with a lag."""
    p, q = sv.parameters(m=2.0), sv.coordinates("x")
    (x,) = q
    path = sv.paths.rest_to_rest(q.t, 0.0, 1.0, duration=1.0, smoothness=4)
    mechanism = sv.Mechanism(q, sv.particle(q, p.m, x), actuators={"force": x}, parameters=p)
    machine = mechanism if tau is None else sv.plant(mechanism, lag={"force": tau})
    return machine, sv.Program({"x": x - path}, by="actuators")


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
    path = sv.paths.rest_to_rest(q.t, 0.0, 1.5, duration=1.0, smoothness=6)
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
    path = p.distance * sv.paths.rest_to_rest(q.t, 0.0, 1.0, duration=2.0, smoothness=4)
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
    path = sv.paths.rest_to_rest(q.t, (0.3, 0.5), (1.2, 1.4), duration=1.0, smoothness=4)
    return mechanism, sv.Program({"a": a - path[0], "b": b - path[1]}, by="actuators")


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
    path = sv.paths.rest_to_rest(q.t, (0.0, 4.0), (5.0, 2.0), duration=6.0, smoothness=6)
    return mechanism, sv.Program({"X": load[0] - path[0], "Z": load[1] - path[1]}, by="actuators")


@cache
def derived(build, *kind):
    """The model of a scene, derived once for all tests."""
    return sv.derive(*build(*kind))


ROPES = {name: partial(derived, lift, name) for name in ("rigid", "elastic")}
PENDULA = {
    "linear": partial(derived, cart, False, True), "plain": partial(derived, cart), "friction": partial(derived, cart, True),
}  # fmt: skip
SCENES = {  # levels, the simple one, reference, span, parameter, measured values, predicted values, error, options
    "elastic rope": (ROPES, "rigid", "elastic", 3.0, "k", (1e5, 2e5, 4e5), (6e4, 7e5), "modelling", {}),
    "elastic rope of a crane": (
        {name: partial(derived, crane, name) for name in ("rigid", "elastic")}, "rigid", "elastic", 6.0,
        "EA", (5e5, 1e6, 2e6), (3e5, 3.5e6), "modelling", {"start": lambda model: model.start(guess={"l": 4.0})},
    ),
    "lag": (
        {"none": lambda: drive(), "lag": drive}, "none", "lag", 1.0,
        "tau", (0.01, 0.02, 0.04), (0.006, 0.07), "in_loop", {"law": partial(sv.feedforward, rate=1000.0)},
    ),
    "elastic joint": (
        {name: partial(derived, joint, name) for name in ("rigid", "elastic")}, "rigid", "elastic", 1.0,
        "k", (1e3, 2e3, 4e3), (600.0, 7e3), "actuation", {},
    ),
    "friction": (PENDULA, "plain", "friction", 4.0, "d", (0.02, 0.05, 0.1), (0.03, 0.2), "modelling", {}),
    "body": (
        {name: partial(derived, arm, name) for name in ("point", "body")}, "point", "body", 1.0,
        "J", (0.02, 0.05, 0.1), (0.03, 0.2), "actuation", {},
    ),
    "small angles": (
        PENDULA, "linear", "plain", 4.0,
        "distance", (0.4, 0.7, 1.0), (0.3, 1.5), "modelling", {},
    ),
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def timed_briefly():
    """No test asserts a time: the fewest rounds will do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("servoctl.study.modelling.ROUNDS_FOR", 0.0)
        yield


@pytest.fixture(scope="module")
def pendula():
    return sv.levels(PENDULA, (0.0, 4.0), reference="friction", law=partial(sv.feedforward, rate=500.0))


@pytest.fixture(scope="module")
def ropes():
    return sv.levels(ROPES, (0.0, 3.0), reference="elastic", cases={"k": [1e5, 2e5, 4e5]})


def instants(t1, count=2001):
    return np.linspace(0.0, t1, count)


# --- errors


def test_a_rigid_rope_errs_by_its_stretch(ropes):
    """h = y + m (y'' + g)/k; the winch's force differs by M m y''''/k."""
    t, m, M = instants(3.0), 100.0, 20.0
    path = sv.simulate(*planned(derived(lift)), (0.0, 3.0), t_eval=t)
    y, d2y, d4y = path["h"], path["d2h"], derivative(4, t)
    for k in (1e5, 2e5, 4e5):
        row = ropes.where(level="rigid", k=k).rows()[0]
        stretch = m * (d2y + 9.81) / k
        assert row["modelling"] == row["error"] == pytest.approx(stretch.max() / (y + stretch).max(), rel=1e-3)
        force = M * (d2y + m * d4y / k) + m * (d2y + 9.81)
        assert row["actuation"] == pytest.approx(np.abs(M * m * d4y / k).max() / force.max(), rel=1e-3)


def planned(model):
    return model, model.start()


def derivative(order, t):
    q = sv.coordinates("x")
    path = sv.paths.rest_to_rest(q.t, 0.0, 2.0, duration=3.0, smoothness=6)
    for _ in range(order):
        path = ca.jacobian(path, q.t)
    return ca.Function("path", [q.t], [path])(t[None, :]).full()[0]


def test_a_lag_errs_by_the_response_of_its_filter():
    """Under u(t) = F(t) the machine has m x'' = F filtered, and its position is the filtered path."""
    study = sv.levels(
        {"none": lambda: drive(), "lag": drive}, (0.0, 1.0), reference="lag", cases={"tau": [0.02]},
        law=partial(sv.feedforward, rate=2000.0),
    )  # fmt: skip
    model, start = planned(derived(drive))
    path = sv.simulate(model, start, (0.0, 1.0), t_eval=instants(1.0, 4001))
    t, x = path.t, path["x"]

    def filtered(until):
        return quad(lambda s: np.exp(-(until - s) / 0.02) / 0.02 * np.interp(s, t, x), 0.0, until, limit=200)[0]

    off = max(abs(filtered(until) - np.interp(until, t, x)) for until in np.linspace(0.4, 0.7, 31))
    lost, own = (study.where(level=name)["in_loop"][0] for name in ("none", "lag"))
    assert lost == pytest.approx(off, rel=1e-3) and own < 1e-6
    assert np.all(study["error"] <= study.uncertainty), "the plans are the same"


def test_the_same_machine_in_other_coordinates_has_no_error():
    """Relative and redundant coordinates, with a material constraint: outputs of one are coordinates of the other."""
    builds = {name: partial(gallery["overhead-crane"].build, coordinates=name) for name in ("relative", "redundant")}
    study = sv.levels(builds, (0.0, 8.0), reference="relative", start=lambda model: model.start(guess={"l": 4.0}))
    assert study.meta["outputs"] == ["x", "l", "tension", "X", "Z"] and study.meta["actuators"] == ["trolley", "hoist"]
    assert np.all(study["modelling"] < 1e-11) and np.all(study["actuation"] < 1e-11)


def test_modelling_and_integration_are_errors_of_their_own(pendula):
    for level in ("linear", "plain"):
        rows = pendula.where(level=level)
        assert np.ptp(rows["modelling"]) == 0 and rows["modelling"][0] > 1e-2
        assert rows["integration"][-1] < 1e-9 and rows["error"][-1] == pytest.approx(rows["modelling"][0], rel=1e-6)
        assert np.all(np.abs(rows["error"] - rows["modelling"]) <= rows["integration"] + 1e-15)  # rounding
    own = pendula.where(level="friction")
    assert np.all(own["modelling"] == 0) and np.array_equal(own["error"], own["integration"])
    assert own["integration"][0] > 1e3 * own["integration"][-1]


def test_operations_do_not_depend_on_the_machine_and_order_the_levels(pendula, ropes):
    for study, order in ((pendula, ("linear", "plain", "friction")), (ropes, ("rigid", "elastic"))):
        counts = [set(study.where(level=level)["operations"]) for level in order]
        assert all(len(count) == 1 for count in counts) and counts == sorted(counts, key=min)
    assert np.all(np.isfinite(pendula["seconds"])) and np.all(pendula["evaluations"] > 0)


def test_a_stiff_level_is_measured_by_an_implicit_method_too():
    """A damped spring with a time constant of 0.5 ms: 2,000 of them in the span."""
    def coupled(stiff=True):
        q = sv.coordinates("x y")
        x, y = q
        pull = 2e3 * (q.d(1)[1] - q.d(1)[0]) + 1e5 * (y - x)
        mechanism = sv.Mechanism(
            q, sv.particle(q, 2.0, x) + sv.particle(q, 1.0, y), actuators={"u": x},
            forces={"x": pull if stiff else y - x, "y": -pull if stiff else x - y},
        )  # fmt: skip
        path = sv.paths.rest_to_rest(q.t, 0.0, 1.0, 1.0, smoothness=4)
        return mechanism, sv.Program({"x": x - path}, by="actuators")

    study = sv.levels({"stiff": coupled, "soft": partial(coupled, False)}, (0.0, 1.0), reference="stiff")
    stiff = study.where(level="stiff")
    assert list(dict.fromkeys(stiff["method"])) == ["Taylor", "RadauIIA"] and set(study["failure"]) == {""}
    assert set(study.where(level="soft")["method"]) == {"Taylor"}
    implicit = stiff.where(method="RadauIIA")
    assert implicit["steps"].max() < stiff.where(method="Taylor")["steps"].min() / 10
    assert np.all(implicit["integration"] < [1e-2, 1e-5, 1e-8])


def test_sizes_make_errors_absolute():
    study = sv.levels(ROPES, (0.0, 3.0), reference="elastic", outputs={"h": 1e-3})
    d2y = derivative(2, instants(3.0))
    assert study.where(level="rigid")["error"][0] == pytest.approx(1e3 * (100 * (d2y + 9.81) / 2e5).max(), rel=1e-3)
    exact = sv.levels(ROPES, (0.0, 3.0), reference="elastic", outputs="load")
    assert np.all(exact["error"] < 1e-12), "the program holds the load at every level"


def test_levels_start_alike():
    """Values held by name, in those levels that have them; what is free is near the start of the reference."""
    study = sv.levels(
        {name: PENDULA[name] for name in ("plain", "friction")}, (0.0, 1.0), reference="friction", start={"theta": 0.3},
        cases={"d": [0.0, 0.05]},
    )  # fmt: skip
    assert np.all(study.where(d=0.0)["modelling"] < 1e-11), "without friction both are one motion"
    assert np.all(study.where(d=0.05, level="plain")["modelling"] > 1e-4)
    with refused(NameUnknown, name="thetta", match="theta"):
        sv.levels({"plain": PENDULA["plain"]}, (0.0, 1.0), reference="plain", start={"thetta": 0.3})


def test_coordinates_that_play_no_part_are_compared_on_demand():
    def build():
        q = sv.coordinates("x y")
        x, y = q
        S, path = sv.particle(q, 1.0, x) + sv.particle(q, 2.0, y), sv.paths.rest_to_rest(q.t, 0.0, 1.0, 1.0, smoothness=4)
        return sv.Mechanism(q, S, potential=2 * y**2, actuators={"u": x}), sv.Program({"x": x - path}, by="actuators")

    assert sv.levels({"a": build}, (0.0, 1.0), reference="a").meta["outputs"] == ["x"]
    assert sv.levels({"a": build}, (0.0, 1.0), reference="a", outputs=["x", "y"]).meta["outputs"] == ["x", "y"]


def test_ideal_programs_compare_reactions():
    wheel = gallery["appell-hamel"]
    start = {"dphi": 1.0, "dtheta": 2.0}
    heavy = sv.derive(*wheel.build()).with_parameters(I_x=0.25)
    study = sv.levels({"light": wheel.build, "heavy": heavy}, (0.0, 1.0), reference="heavy", start=start)
    assert study.meta["actuators"] == [f"reaction_{name}" for name in ("x", "y", "z", "phi", "theta")]
    light = study.where(level="light")
    assert np.all(light["error"] > 1e-3) and np.all(light["actuation"] > 1e-3) and np.all(np.isnan(light["in_loop"]))


# --- what a level cannot do


def test_what_a_level_cannot_do_is_a_row():
    def lost():
        q = sv.coordinates("h y")
        h, y = q
        path = sv.paths.rest_to_rest(q.t, 0.0, 2.0, duration=3.0, smoothness=6)
        mechanism = sv.Mechanism(q, sv.particle(q, 1.0, h) + sv.particle(q, 1.0, y), actuators={"winch": h})
        return mechanism, sv.Program({"load": y - path}, by="actuators")

    study = sv.levels({"lost": lost, **ROPES, "rough": partial(lift, "elastic", 3)}, (0.0, 3.0), reference="elastic")
    assert study["level"].tolist() == ["lost", "rigid", "elastic", "rough"]
    assert [failure[:14] for failure in study["failure"]] == ["NotRealisable:", "", "", "SpecificationE"]
    assert study.recommend(error=0.1).row["level"] in ROPES
    with refused(LimitExceeded, limit=1e-20) as caught:
        study.recommend(error=1e-20)
    assert "Nearest: elastic" in str(caught.value)


def test_a_level_that_ends_early_is_a_row_and_a_reference_that_does_is_refused():
    speed = gallery["constant-speed-horizontal"]
    vertical = gallery["constant-speed"]
    builds = {"horizontal": speed.build, "ideal": vertical.build}
    start = dict(vertical.start)
    study = sv.levels(builds, (0.0, 0.8), reference="ideal", start=start)
    assert study.where(level="horizontal")["failure"][0].startswith("SingularProgram")
    assert np.isnan(study.where(level="horizontal")["error"][0])
    with pytest.raises(SingularProgram):
        sv.levels(builds, (0.0, 0.8), reference="horizontal", start=start)


def test_a_case_that_the_reference_cannot_do_is_a_row_for_each_level():
    """In the second case the load has no mass; in the first one there would be nothing to compare with."""
    study = sv.levels(ROPES, (0.0, 3.0), reference="elastic", cases={"m": [100.0, -1.0, 50.0]})
    lost = [failure.startswith("the reference: SpecificationError") for failure in study["failure"]]
    assert lost == [False, False, True, True, False, False]
    with refused(SpecificationError):
        sv.levels(ROPES, (0.0, 3.0), reference="elastic", cases={"m": [-1.0, 100.0]})


def test_a_loop_that_cannot_be_closed_leaves_the_other_numbers():
    study = sv.levels({"plain": PENDULA["plain"]}, (0.0, 1.0), reference="plain", law=partial(sv.feedforward, rate=0.7))
    assert np.all(np.isfinite(study["error"])) and np.all(np.isnan(study["in_loop"]))
    assert all(failure.startswith("in the loop: SpecificationError") for failure in study["failure"])


def test_inputs_are_refused_in_words():
    span = (0.0, 3.0)
    with refused(NameUnknown, name="elastik", match="elastic"):
        sv.levels(ROPES, span, reference="elastik")
    with refused(NameUnknown, name="laod", match="load"):
        sv.levels(ROPES, span, reference="elastic", outputs=["laod"])
    with refused(NameUnknown, name="K", match="k"):
        sv.levels(ROPES, span, reference="elastic", cases={"K": [1.0]})
    with refused(SpecificationError, name="value"):
        sv.levels(ROPES, span, reference="elastic", cases={"value": [1.0]})
    with refused(SpecificationError, "lag", name="lag"):
        sv.levels({"lag": partial(drive, 0.1)}, (0.0, 1.0), reference="lag")
    with refused(SpecificationError, name="one", type="int"):
        sv.levels({"one": 1}, span, reference="one")
    with refused(SpecificationError, type="str"):
        sv.levels(ROPES, span, reference="elastic", law="lqr")
    with refused(SpecificationError, levels=["rope", "cart"]):
        sv.levels({"rope": lift, "cart": drive}, (0.0, 1.0), reference="rope")


# --- advice


def test_a_recommendation_holds_at_all_instants(pendula):
    """The recommended motion is compared with the reference's where nothing was measured."""
    t = np.sort(np.random.default_rng(5).uniform(0.0, 4.0, 3000))
    model, start = planned(PENDULA["friction"]())
    exact = sv.simulate(model, start, (0.0, 4.0), sv.Taylor(rtol=1e-15, atol=1e-15), drift="project", t_eval=t)
    for error in (0.5, 0.2, 1e-4, 1e-6, 1e-9):
        best = pendula.recommend(error=error)
        run = sv.simulate(*planned(PENDULA[best.row["level"]]()), (0.0, 4.0), t_eval=t, **best)
        off = max(np.abs(run[name] - exact[name]).max() / np.abs(exact[name]).max() for name in ("x", "theta"))
        assert off <= error and off <= 1.02 * best.row["error"]


def test_the_front_and_the_advice_follow_from_the_rows(pendula):
    for of in ERRORS:
        front = pendula.pareto(of=of)
        assert np.all(np.diff(front["seconds"]) > 0) and np.all(np.diff(front[of]) < 0) or len(front) == 1
    fast = pendula.recommend(seconds=1.0)
    assert fast.row["level"] == "friction" and fast.row["error"] == pendula["error"].min()
    best = pendula.recommend(error=1e-4, of="in_loop")
    assert best.row["level"] == "friction" and best.row["in_loop"] <= 1e-4
    for options in ({}, {"error": 1.0, "seconds": 1.0}, {"error": -1.0}):
        with refused(SpecificationError):
            pendula.recommend(**options)
    with refused(NameUnknown, name="modeling", match="modelling"):
        pendula.recommend(error=1.0, of="modeling")


def test_advice_for_other_parameters_uses_the_upper_end_of_the_prediction(ropes):
    measured = ropes.where(level="rigid")["error"]
    assert ropes.recommend(error=1.01 * measured.max()).row["level"] in ROPES
    assert ropes.recommend(error=0.99 * measured.max()).row["level"] == "elastic", "it holds for all cases"
    known = ropes.recommend(error=1.01 * measured[2], parameters={"k": 4e5})
    assert known.row["k"] == 4e5
    high = ropes.predict("rigid", {"k": 3e5}, of="error").high
    assert ropes.recommend(error=0.99 * high, parameters={"k": 3e5}).row["level"] == "elastic"
    with refused(NameUnknown, name="K", match="k"):
        ropes.recommend(error=0.1, parameters={"K": 3e5})


# --- predictions


@pytest.mark.parametrize("name", SCENES)
def test_a_prediction_is_within_a_factor_of_two_of_what_is_measured(name):
    builds, level, reference, end, parameter, values, others, of, options = SCENES[name]
    builds = {key: builds[key] for key in (level, reference)}
    cases = {parameter: [*values, *others]}
    every = sv.levels(builds, (0.0, end), reference=reference, cases=cases, **options)
    study = every.take([i for i, case in enumerate(every["case"]) if case < len(values)])
    for value in others:
        measured = every.where(level=level).where(**{parameter: value})[of][-1]
        found = study.predict(level, {parameter: value}, of=of)
        assert found.conclusive and found.low <= measured <= found.high, str(found)
        assert 0.5 < found.value / measured < 2.0
        assert abs(abs(found.exponents[parameter]) - (2.0 if parameter == "distance" else 1.0)) < 0.05


def test_two_parameters_have_a_law_each():
    cases = sv.grid(k=[1e5, 3e5], m=[80.0, 120.0])
    study = sv.levels(ROPES, (0.0, 3.0), reference="elastic", cases=cases)
    found = study.predict("rigid", {"k": 2e5, "m": 100.0})
    d2y = derivative(2, instants(3.0))
    y = derivative(0, instants(3.0))
    stretch = 100.0 * (d2y + 9.81) / 2e5
    assert found.conclusive and found.value == pytest.approx(stretch.max() / (y + stretch).max(), rel=0.02)
    assert found.exponents["k"] == pytest.approx(-1.0, abs=0.02) and found.exponents["m"] == pytest.approx(1.0, abs=0.02)


def test_a_reference_has_no_error_of_modelling(ropes):
    inside, outside = (ropes.predict("elastic", {"k": k}) for k in (2e5, 1e7))
    assert inside.conclusive and inside.value == 0.0 and inside.high == ropes.uncertainty
    assert not outside.conclusive and outside.high == np.inf


def test_vibrations_have_no_law():
    """The plan of a rigid rope excites a soft one: how much depends on the path's duration in periods."""
    cases = {"k": [600.0, 1000.0, 1800.0]}
    law = partial(sv.feedforward, rate=200.0)
    study = sv.levels(ROPES, (0.0, 3.0), reference="elastic", cases=cases, law=law)
    found = study.predict("rigid", {"k": 1400.0}, of="in_loop")
    assert not found.conclusive and "courses in time" in found.message
    assert study["in_loop_like"].min() < 0.9 < 0.98 < study.where(level="rigid")["modelling_like"].min()


@pytest.mark.parametrize("cases, errors, at, likeness", [
    ([1.0, 2.0], [1.0, 2.0], 1.5, 1.0),  # no case left to check the law
    ([1.0, 2.0, 4.0], [1.0, 2.0, 4.0], -1.0, 1.0),
    ([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], 1.0, 1.0),
    ([1.0, 2.0, 4.0], [1e-12, 2.0, 4.0], 3.0, 1.0),  # one below the floor
    ([1.0, 2.0, 4.0], [1.0, 2.0, 4.0], 3.0, -0.99),  # an error that changed its sign
    ([1.0, 2.0, 4.0], [1.0, 0.1, 1.0], 3.0, 1.0),  # no power law
    ([1.0, 2.0, 4.0], [1.0, 2.0, 4.0], 17.0, 1.0),  # too far
])  # fmt: skip
def test_what_the_cases_do_not_show_is_inconclusive(cases, errors, at, likeness):
    found = power_law(np.array(cases)[:, None], np.array(errors), {"k": at}, 1e-9, likeness)
    assert not found.conclusive and found.message and "inconclusive" in str(found)
    assert not found.low > 0 or found.high > 2 * found.value


@pytest.mark.parametrize("law", [
    lambda a, s: a**s, lambda a, s: 1 + s**2 * a, lambda a, s: a / (1 + s**2 * a), lambda a, s: a**2 + s**2,
])  # fmt: skip
def test_conclusive_predictions_of_smooth_laws_are_within_a_factor_of_two(law):
    rng, conclusive = np.random.default_rng(7), 0
    for _ in range(300):
        s, values, at = rng.uniform(-3, 3), np.array([0.5, 1.0, 2.0]), np.exp(rng.uniform(-2.0, 2.0))
        found = power_law(values[:, None], law(values, s), {"a": at}, 1e-15)
        conclusive += found.conclusive
        assert found.low <= law(at, s) * (1 + 1e-9) and law(at, s) <= found.high * (1 + 1e-9)
        assert not found.conclusive or 0.5 < found.value / law(at, s) < 2.0
    assert conclusive > 10


@pytest.mark.parametrize("curvature, at, likeness, conclusive", [
    (0.08, 1.0, 1.0, True), (0.095, 1.0, 1.0, False),  # each case differs by 2 c from what the others predict
    (0.0, 3.9, 1.0, True), (0.0, 4.1, 1.0, False), (0.0, 0.26, 1.0, True), (0.0, 0.24, 1.0, False),
    (0.0, 1.0, 0.985, True), (0.0, 1.0, 0.975, False),
])  # fmt: skip
def test_a_prediction_is_conclusive_within_bounds(curvature, at, likeness, conclusive):
    values = np.array([0.5, 1.0, 2.0])
    errors = np.exp(curvature * np.array([1.0, 0.0, 1.0]))
    found = power_law(values[:, None], errors, {"k": at}, 1e-15, likeness)
    assert found.conclusive == conclusive


def test_the_size_of_a_signal_that_is_rounding_is_one():
    run = {"x": np.array([0.0, 2.0]), "side": np.array([1e-12, -1e-13]), "small": np.array([1e-8, 0.0]), "y": np.zeros(2)}
    sizes = _signal_sizes(run, ("x", "side", "small", "y"), ["x", "y"])
    assert sizes == {"x": 2.0, "side": 1.0, "small": 1e-8, "y": 2e-3}


def test_a_prediction_needs_all_parameters_of_the_cases(ropes, pendula):
    with refused(SpecificationError, missing=["k"]):
        ropes.predict("rigid", {})
    with refused(NameUnknown, name="rigd", match="rigid"):
        ropes.predict("rigd", {"k": 1e5})
    with refused(NameUnknown, name="d"):
        pendula.predict("plain", {"d": 1.0})
    named = sv.levels({"joint": joint}, (0.0, 1.0), reference="joint", cases={"kind": ["rigid", "elastic"]})
    with refused(SpecificationError, name="kind"):
        named.predict("joint", {"kind": 1.0})


# --- the table


@pytest.mark.parametrize("calls, rows", [(1, 0), (4, 2)])
def test_an_interrupted_study_has_the_cases_that_were_finished(calls, rows):
    seen = []

    def start(model):
        seen.append(model)
        if len(seen) == calls:
            raise KeyboardInterrupt
        return model.start()

    study = sv.levels(ROPES, (0.0, 3.0), reference="elastic", cases={"k": [1e5, 2e5]}, start=start)
    assert study.meta["message"] == "interrupted" and len(study) == rows
    assert "interrupted" in repr(study) and len(repr(study).splitlines()) <= 12


def test_a_study_of_levels_is_saved_printed_and_drawn(pendula, ropes, tmp_path):
    for study in (pendula, ropes):
        again = sv.load_study(study.save(tmp_path / "levels"))
        assert type(again) is sv.Levels and repr(again) == repr(study)
        assert "0x" not in study.meta["law"]
        lines = repr(study).splitlines()
        assert len(lines) <= 12 and max(map(len, lines)) <= 120
    axes = pendula.plot(title="pendula")
    filled = {line.get_label() for line in axes.get_lines() if line.get_color() in COLOURS}
    assert set(pendula.pareto()["level"]) <= filled
    labels = {text.get_text() for text in axes.get_legend().get_texts()}
    assert set(PENDULA) <= labels
    with refused(NameUnknown, name="price"):
        pendula.plot(cost="price")
