"""Where paths switch, and programs that need more derivatives than their paths have."""

import math

import casadi as ca
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import SpecificationError
from servoctl.gallery import cars, overhead_crane
from servoctl.model.model import derive, knots_within


def follower(path):
    """Two cars and a spring: the actuation holds the fourth derivative of the path."""
    p = sv.parameters(m=1.0, k=1.0, T=2.0, t0=1.0)
    q = sv.coordinates("x1 x2")
    x1, x2 = q
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m, x1) + sv.particle(q, 2 * p.m, x2),
        potential=p.k * (x1 - x2) ** 2 / 2,
        actuators={"f": x2},
        parameters=p,
    )
    return derive(mechanism, sv.Program({"X": x1 - path(q.t, p)}))


def move(t, smoothness=4, t_start=0.0, duration=2.0):
    return sv.paths.rest_to_rest(t, 0, 1, duration, smoothness=smoothness, t_start=t_start)


def rate(path, t, k, smoothness):
    """The k-th derivative of a path, by Taylor arithmetic: of class C^(smoothness - k)."""
    q = sv.coordinates("x")
    return ca.substitute(q.dt(path(q.t, smoothness), k), q.t, t)


def S9(s):
    return 126 * s**5 - 420 * s**6 + 540 * s**7 - 315 * s**8 + 70 * s**9


HUNDRED = [6 * k / 99 for k in range(100)]
VIA = ([0.5, 1.5, 2.0, 4.0], [0.0, 1.0, 0.5, 2.0])
SMOOTH = {
    "rest_to_rest": (lambda t, p: move(t), [0, 2]),
    "later": (lambda t, p: move(t, t_start=3.0), [3, 5]),
    "twice": (lambda t, p: move(t) - move(t, t_start=5.0), [0, 2, 5, 7]),
    "parameters": (lambda t, p: move(t, duration=p.T, t_start=p.t0), [1, 3]),
    "trapezoid": (lambda t, p: sv.paths.trapezoid(t, 2.0, 6.0, 1.5, smoothness=4, t_start=1.0), [1, 2.5, 5.5, 7]),
    "spline, rest": (lambda t, p: sv.paths.spline(t, *VIA, smoothness=4), VIA[0]),
    "spline, natural": (lambda t, p: sv.paths.spline(t, *VIA, smoothness=4, ends="natural"), [1.5, 2.0]),
    "spline through 100 points of a slow departure": (
        lambda t, p: sv.paths.spline(t, HUNDRED, [4 - 2 * S9(k / 99) for k in range(100)], smoothness=4), HUNDRED
    ),
    "if_else": (lambda t, p: ca.if_else(t < 3, 0, (t - 3) ** 5), [3]),
    "a window": (lambda t, p: ca.if_else(ca.logic_and(t > 1, t < 2), (t - 1) ** 5 * (2 - t) ** 5, 0), [1, 2]),
    "fabs": (lambda t, p: ca.fabs(t - 1) ** 5, [1]),
    "fmax": (lambda t, p: ca.fmax(2 * t - 3, 0) ** 5, [1.5]),
    "sign": (lambda t, p: ca.sign(t - 1) * (t - 1) ** 5, [1]),
    "a sine": (lambda t, p: ca.sin(t), []),
    "far from zero": (lambda t, p: 1e6 + 1e-3 * move(t), [0, 2]),
    "a time law in a time law": (
        lambda t, p: move(sv.paths.trapezoid(t, 1, 4.0, 1.0, smoothness=4), duration=0.5, t_start=0.25),
        [0, 1, 1.25, 2.75, 3, 4],
    ),
    "held at its end": (lambda t, p: ca.if_else(t < 2, S9(t / 2), 1), [2]),
    "held at its end by fmin": (lambda t, p: S9(ca.fmin(t / 2, 1)), [2]),
    "differentiated": (lambda t, p: rate(move, t, 1, 5), [0, 2]),
    "differentiated twice": (lambda t, p: rate(move, t, 2, 6), [0, 2]),
    "three in one": (
        lambda t, p: sv.paths.spline(move(move(t), duration=1.0), [0, 0.5, 1], [0, 2, 1], 4, "natural"), [0, 1, 2]
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SMOOTH)
def test_paths_of_the_needed_class_are_accepted_with_their_knots(name):
    path, knots = SMOOTH[name]
    model = follower(path)
    assert model.reduction.needs == {"X": 4}
    assert model.knots == pytest.approx(knots, abs=1e-9)
    assert model.reduction.knots.classes == {}


def test_knots_of_a_curved_time_law_are_found_by_scanning():
    knots = follower(
        lambda t, p: sv.paths.spline(move(t), [0, 0.3, 0.7, 1.0], [0, 1, 0.5, 2], smoothness=4, ends="natural")
    ).knots
    t = ca.SX.sym("t")
    law = ca.Function("law", [t], [move(t)])
    assert len(knots) == 4 and (knots[0], knots[3]) == pytest.approx((0, 2), abs=1e-9)
    assert [float(law(k)) for k in knots[1:3]] == pytest.approx([0.3, 0.7], abs=1e-9)


ROUGH = {
    "rest_to_rest 3": (lambda t, p: move(t, 3), 3, 0.0),
    "rest_to_rest 2, later": (lambda t, p: move(t, 2, t_start=3.0), 2, 3.0),
    "rest_to_rest 0": (lambda t, p: move(t, 0), 0, 0.0),
    "trapezoid 3": (lambda t, p: sv.paths.trapezoid(t, 2.0, 6.0, 1.5, smoothness=3, t_start=1.0), 3, 1.0),
    "spline 3": (lambda t, p: sv.paths.spline(t, *VIA, smoothness=3), 3, 0.5),
    "natural spline 2": (lambda t, p: sv.paths.spline(t, *VIA, smoothness=2, ends="natural"), 2, 1.5),
    "if_else": (lambda t, p: ca.if_else(t < 3, 0, (t - 3) ** 3), 2, 3.0),
    "fabs": (lambda t, p: ca.fabs(t - 1) ** 3, 2, 1.0),
    "differentiated": (lambda t, p: rate(move, t, 2, 4), 2, 0.0),
    "a jump": (lambda t, p: ca.if_else(t < 3, 0, 1), -1, 3.0),
    "a small jump": (lambda t, p: move(t) + 1e-4 * (t > 1), -1, 1.0),
    "the roughest of two": (lambda t, p: move(t) + ca.fmax(t - 1.5, 0) ** 2 + ca.fmax(t - 1, 0) ** 4, 1, 1.5),
    "far apart": (lambda t, p: ca.fmax(t - 1, 0) ** 5 + ca.fmax(t - 100, 0) ** 4, 3, 100.0),
    "far from zero": (lambda t, p: 1e6 + 1e-3 * move(t, 3), 3, 0.0),
    "a curved time law": (
        lambda t, p: sv.paths.spline(move(t), [0, 0.5, 0.7, 1.0], [0, 1, 0.5, 2], smoothness=2, ends="natural"), 2, 1.0
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ROUGH)
def test_paths_below_the_needed_class_are_refused_with_class_and_instant(name):
    path, has, when = ROUGH[name]
    with refused(SpecificationError, needs=4) as caught:
        follower(path)
    text, details = str(caught.value), caught.value.details
    assert ("a jump" if has < 0 else f"has C^{has}") in text and f"at t = {when:g}" in text and "'X'" in text
    assert (details["name"], details["needs"], details["has"]) == ("X", 4, has)
    assert details["t"] == pytest.approx(when, abs=1e-6)


def test_the_refusal_reads_as_promised():
    with refused(SpecificationError, needs=4, has=2, t=3.0) as caught:
        follower(lambda t, p: move(t, 2, t_start=3.0))
    assert "smoothness=4" in str(caught.value)


@pytest.mark.parametrize("smoothness", range(1, 6))
@pytest.mark.parametrize(("by", "need"), [("actuators", 4), ("ideal", 2)])
def test_exactly_the_needed_class_is_enough(smoothness, by, need):
    mechanism, _ = cars(2)
    x1, _ = mechanism.q
    program = sv.Program({"car 1": x1 - move(mechanism.q.t, smoothness)}, by=by)
    if smoothness >= need:
        assert derive(mechanism, program).reduction.needs == {"car 1": need}
    else:
        with refused(SpecificationError, needs=need, has=smoothness, t=0.0):
            derive(mechanism, program)


def test_each_residual_is_judged_by_its_own_need():
    """A path in velocity needs one derivative less."""
    mechanism, _ = overhead_crane()
    q = mechanism.q
    x, l, theta = q
    X, Z = x + l * ca.sin(theta), l * ca.cos(theta)
    height = 4 - 2 * move(q.t, duration=6.0)
    model = derive(mechanism, sv.Program({"speed": q.dt(X) - move(q.t, 3, duration=6.0), "Z": Z - height}))
    assert model.reduction.needs == {"speed": 3, "Z": 4}
    with refused(SpecificationError, name="speed", needs=3, has=2):
        derive(mechanism, sv.Program({"speed": q.dt(X) - move(q.t, 2, duration=6.0), "Z": Z - height}))


def test_a_material_constraint_that_moves_is_judged_too():
    """A rail that is lifted by a C^1 law has accelerations that jump."""
    q = sv.coordinates("x y")
    x, y = q
    S = sv.particle(q, 1.0, (x, y))

    def lifted(smoothness):
        mechanism = sv.Mechanism(
            q, gibbs=S, actuators={"a": x}, constraints={"rail": y - move(q.t, smoothness, t_start=1.0)}
        )  # fmt: skip
        return derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}), keep=["y"])

    assert lifted(2).knots == pytest.approx([1, 3])
    with refused(SpecificationError, name="rail", needs=2, has=1, t=1.0):
        lifted(1)


def test_knots_move_with_parameters():
    model = follower(SMOOTH["parameters"][0])
    assert model.with_parameters(T=5.0).knots == pytest.approx([1.0, 6.0])
    assert model.with_parameters(t0=-1.0).knots == pytest.approx([-1.0, 1.0])
    assert model.knots == pytest.approx([1.0, 3.0])


def test_a_parameter_can_make_a_path_too_rough():
    model = follower(lambda t, p: ca.if_else(t < 3, 0, (p.k - 1) * (t - 3) ** 2))
    with refused(SpecificationError, has=1, t=3.0):
        model.with_parameters(k=2.0)


@pytest.mark.parametrize("span", [(0.0, 8.0), (0.0, 7.0), (0.5, 3.3), (1.0, 3.0)])
def test_switches_that_are_not_affine_are_found_within_a_span(span):
    """t² = 4 at t = 2, wherever the scan's own grid happens to lie."""
    model = follower(lambda t, p: ca.if_else(t**2 < 4, 0, (t - 2) ** 3))
    with refused(SpecificationError, has=2, t=2.0):
        knots_within(model, span)


def test_a_switch_between_knots_is_found_wherever_it_lies():
    with refused(SpecificationError, has=-1, t=2.0):
        follower(lambda t, p: ca.if_else(t**2 < 4, 0, 1) + move(t, duration=8.0))


@pytest.mark.parametrize("exponent", [4.5, 5.0])
def test_real_powers_that_start_from_zero_are_as_smooth_as_they_are(exponent):
    """max(t - 1, 0)^4.5 is of class C^4."""
    model = follower(lambda t, p: ca.power(ca.fmax(t - 1, 0), exponent))
    assert model.knots == pytest.approx([1.0])


def test_a_residual_may_be_named_like_a_force():
    """Two cars need C^4 of the path, whatever its residual is called."""
    q = sv.coordinates("x1 x2")
    x1, x2 = q
    S = sv.particle(q, 1.0, x1) + sv.particle(q, 1.0, x2)
    mechanism = sv.Mechanism(q, gibbs=S, potential=(x1 - x2) ** 2 / 2, actuators={"force": x2})
    path = sv.paths.rest_to_rest(q.t, 0.0, 1.0, duration=2.0, smoothness=2)
    with pytest.raises(SpecificationError) as caught:
        derive(mechanism, sv.Program({"the force on x1": x1 - path}))
    assert caught.value.details["name"] == "the force on x1"
    assert (caught.value.details["needs"], caught.value.details["has"]) == (4, 2)


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("included", [False, True])
@pytest.mark.parametrize("options", [{"method": "Taylor"}, {"method": sv.methods.Taylor(jets=4)}, {"accuracy": 1e-6}, {}])
def test_a_sample_on_a_jump_of_a_force_has_the_acceleration_of_that_instant(options, included, backwards):
    q = sv.coordinates("x y")
    x, y = q
    on = q.t >= 1.3 if included else q.t > 1.3
    gibbs = sum(a**2 for a in q.d(2)) / 2
    mechanism = sv.Mechanism(q, gibbs=gibbs, forces={"y": -y + ca.if_else(on, 5.0, 0.0)}, actuators={"F": x})
    model = derive(mechanism, sv.Program({"x": x - ca.sin(q.t)}), keep=["y"])
    span = (2.0, 0.0) if backwards else (0.0, 2.0)
    run = sv.simulate(model, model.start(t=span[0], y=1.0, dy=0.0), span, **options)
    late = run.t >= 1.3 if included else run.t > 1.3
    assert 1.3 in run.t and run["d2y"] == pytest.approx(5.0 * late - run["y"], abs=1e-9)
    assert sv.verify(run).passed


def test_remembered_knots_are_those_of_their_numbers_and_span():
    """Switches of max(0, sin t - h) lie at arcsin h and π - arcsin h of every turn within the span."""
    q, p = sv.coordinates("x"), sv.parameters(h=0.5, m=1.0)
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, (x,)), actuators={"F": x}, parameters=p)
    model = derive(mechanism, sv.Program({"X": x - ca.fmax(0, ca.sin(q.t) - p.h) ** 4}))

    def crossings(h, end):
        turns = [2 * math.pi * k + a for k in range(3) for a in (math.asin(h), math.pi - math.asin(h))]
        return [t for t in turns if t < end]

    for _ in range(2):  # the second time they are remembered
        for h in (0.5, 0.6):
            for end in (2.0, 9.0, 5.0):
                other = model.with_parameters(h=h, m=1.0 + h)
                assert knots_within(other, (0.0, end)) == pytest.approx(crossings(h, end), abs=4e-15)
