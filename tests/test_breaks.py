"""Breaks of paths: where steps end, paths that have too few derivatives, forces that jump, paths of many pieces."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.interpolate import make_interp_spline

import servoctl as sv
from servoctl.errors import SpecificationError
from servoctl.gallery import overhead_crane
from servoctl.methods.taylor import TaylorSteps, last_index, series_loop

VIA = ([0.5, 1.5, 2.0, 4.0], [0.0, 1.0, 0.5, 2.0])


def move(smoothness=4, t_start=0.0, duration=2.0):
    return sv.paths.rest_to_rest(0.0, 1.0, duration, smoothness=smoothness, t_start=t_start)


def after(t, power, end=9.0):
    """max(time - t, 0)^power."""
    table = np.column_stack([np.zeros(power + 1), np.eye(power + 1, 1)])
    return sv.paths.polynomials([-1.0, t, end], table, before="hold", after="continue")


def cars(by="actuators"):
    """Two cars and a spring: the actuation holds the fourth derivative of the path."""
    q = sv.coordinates("x1 x2")
    x1, x2 = q
    S = sv.particle(q, 1.0, x1) + sv.particle(q, 2.0, x2)
    mechanism = sv.Mechanism(q, gibbs=S, potential=(x1 - x2) ** 2 / 2, actuators={"f": x2})
    return sv.derive(mechanism, sv.Program({"the force on x1": x1 - q.references(X=None).X}, by=by))


@pytest.fixture(scope="module")
def two_cars():
    return cars()


def moved(model, path, span=(-1.0, 9.0)):
    along = model.with_references(X=path)
    return sv.simulate(along, along.start(span[0]), span)


SMOOTH = {  # a path, and its breaks at which steps end: those where a motion by polynomials has a kink
    "twice": (move() - move(t_start=5.0), [0, 2, 5, 7]),
    "trapezoid": (sv.paths.trapezoid(2.0, 6.0, 1.5, smoothness=4, t_start=1.0), [1, 2.5, 5.5, 7]),
    "spline, rest": (sv.paths.spline(*VIA, smoothness=4), [0.5, 4.0]),  # of class 8 between them
    "far from zero": (1e6 + 1e-3 * move(), [0, 2]),
    "a power": (after(1.0, 5), [1]),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_paths_of_the_needed_class_are_followed_from_break_to_break(name, two_cars):
    path, breaks = SMOOTH[name]
    run = moved(two_cars, path)
    assert run.knots == pytest.approx(breaks, abs=1e-12)
    d2x1, d4x1 = path.jets(run.t, 4)[[2, 4], 0]
    expected = 2.0 * (d4x1 + d2x1) + d2x1  # of x2 = x1 + x1'': f = 2 x2'' + x1''
    assert np.abs(run["f"] - expected).max() < 1e-9 * np.abs(expected).max() and sv.verify(run).passed


ROUGH = {  # a path, its class, and the first instant at which it is too low
    "rest_to_rest 3": (move(3), 3, 0.0),
    "rest_to_rest 2, later": (move(2, t_start=3.0), 2, 3.0),
    "rest_to_rest 0": (move(0), 0, 0.0),
    "trapezoid 3": (sv.paths.trapezoid(2.0, 6.0, 1.5, smoothness=3, t_start=1.0), 3, 1.0),
    "spline 3": (sv.paths.spline(*VIA, smoothness=3), 3, 0.5),
    "natural spline 2": (sv.paths.spline(*VIA, smoothness=2, ends="natural"), 2, 1.5),
    "a cubic": (after(3.0, 3), 2, 3.0),
    "a jump": (after(3.0, 0), -1, 3.0),
    "a small jump": (move() + 1e-4 * after(1.0, 0), -1, 1.0),
    "the first of two": (move() + after(1.5, 2) + after(1.0, 4), 3, 1.0),
    "late": (after(1.0, 5, 200.0) + after(100.0, 4, 200.0), 3, 100.0),
    "far from zero": (1e6 + 1e-3 * move(3), 3, 0.0),
}


@pytest.mark.parametrize("name", ROUGH)
def test_paths_below_the_needed_class_are_refused_with_class_and_instant(name, two_cars):
    path, has, when = ROUGH[name]
    said = "a jump" if has < 0 else f"has C^{has}"
    with refused(SpecificationError, said, f"at t = {when:g} s", "smoothness=4", name="X", needs=4, has=has) as caught:
        moved(two_cars, path, (-1.0, max(9.0, when + 5.0)))
    assert caught.value.details["t"] == pytest.approx(when, abs=1e-12)


@pytest.mark.parametrize(("by", "need"), [("actuators", 4), ("ideal", 2)])
def test_exactly_the_needed_class_is_enough(by, need):
    model = cars(by)
    assert model.reduction.follows == {"X": need}
    for smoothness in range(1, 6):
        if smoothness >= need:
            assert sv.verify(moved(model, move(smoothness))).passed
        else:
            with refused(SpecificationError, needs=need, has=smoothness, t=0.0):
                moved(model, move(smoothness))


def test_each_path_is_judged_by_its_own_need():
    """A path in velocity needs one derivative less."""
    mechanism, _ = overhead_crane()
    q = mechanism.q
    x, l, theta = q
    r = q.references(speed=move(3, t_start=1.0), below=4 - 2 * move(duration=6.0))
    rows = {"speed": q.dt(x + l * ca.sin(theta)) - r.speed, "Z": l * ca.cos(theta) - r.below}
    model = sv.derive(mechanism, sv.Program(rows))
    assert model.reduction.follows == {"speed": 3, "below": 4}
    start = model.start(x=0.0, guess={"l": 4.0})
    assert sv.verify(sv.simulate(model, start, (0.0, 5.0))).passed
    with refused(SpecificationError, name="speed", needs=3, has=2, t=1.0):
        sv.simulate(model.with_references(speed=move(2, t_start=1.0)), start, (0.0, 5.0))


def test_a_material_constraint_that_moves_is_judged_too():
    """A rail that is lifted by a C^1 law has accelerations that jump."""
    q = sv.coordinates("x y")
    x, y = q
    rail = {"rail": y - q.references(rail=move(2, t_start=1.0)).rail}
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={"a": x}, constraints=rail)
    model = sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}), keep=["y"])
    run = sv.simulate(model, model.start(), (0.0, 4.0))
    assert run.knots == pytest.approx([1.0, 3.0]) and sv.verify(run).passed
    with refused(SpecificationError, name="rail", needs=2, has=1, t=1.0):
        sv.simulate(model.with_references(rail=move(1, t_start=1.0)), model.start(), (0.0, 4.0))


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("options", [{"method": "Taylor"}, {"method": sv.methods.Taylor(jets=4)}, {"accuracy": 1e-6}, {}])
def test_a_sample_on_a_jump_of_a_force_has_the_acceleration_of_that_instant(options, backwards):
    """At a break the piece that begins counts."""
    q = sv.coordinates("x y")
    x, y = q
    push = q.references(push=sv.paths.polynomials([0.0, 1.3, 2.0], [[0.0, 5.0]])).push
    gibbs = sum(a**2 for a in q.d(2)) / 2
    mechanism = sv.Mechanism(q, gibbs=gibbs, forces={"y": push - y}, actuators={"F": x})
    model = sv.derive(mechanism, sv.Program({"x": x - ca.sin(q.t)}), keep=["y"])
    span = (2.0, 0.0) if backwards else (0.0, 2.0)
    run = sv.simulate(model, model.start(t=span[0], y=1.0, dy=0.0), span, **options)
    assert 1.3 in run.t and run["d2y"] == pytest.approx(5.0 * (run.t >= 1.3) - run["y"], abs=1e-9)
    assert sv.verify(run).passed


# paths of many pieces -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [100, 10_000])
def test_a_plan_along_samples_has_the_forces_of_their_spline(count):
    q = sv.coordinates("x y")
    x, y = q
    p = sv.parameters(m=2.0)
    t = np.linspace(0.0, 6.0, count)
    via = np.array([np.sin(t), np.cos(2 * t)]).T
    path = sv.paths.spline(t, via, smoothness=3, ends="natural")
    r = q.references(X=path[0], Y=path[1])
    mechanism = sv.Mechanism(q, sv.particle(q, p.m, ca.vertcat(x, y)), actuators={"Fx": x, "Fy": y}, parameters=p)
    model = sv.derive(mechanism, sv.Program({"X": x - r.X, "Y": y - r.Y}, by="actuators"))
    run = sv.simulate(model, model.start(), (0.0, 6.0), t_eval=np.linspace(0.0, 6.0, 3001))
    zeros = [(order, np.zeros(2)) for order in (3, 4)]
    curve = make_interp_spline(t * count / 6.0, via, k=5, bc_type=(zeros, zeros))  # in intervals, as SciPy solves best
    expected = 2.0 * (count / 6.0) ** 2 * curve(run.t * count / 6.0, nu=2).T
    assert np.abs([run["Fx"], run["Fy"]] - expected).max() < 1e-8 + 1e-15 * count**2


def test_steps_end_at_breaks_without_a_call_for_each(monkeypatch, c_compiler):
    breaks = np.linspace(0.0, 6.0, 600)
    q = sv.coordinates("x theta")
    x, theta = q
    bob = ca.vertcat(x + ca.sin(theta), -ca.cos(theta))
    S = sv.particle(q, 2.0, x) + sv.particle(q, 0.5, bob)
    machine = sv.Mechanism(q, gibbs=S, potential=0.5 * 9.81 * bob[1], actuators={"F": x})
    path = sv.paths.spline(breaks, np.sin(breaks), smoothness=3, ends="natural")
    model = sv.derive(machine, sv.Program({"X": x - q.references(X=path).X}, by="actuators"))
    library, ends = series_loop(model, last_index(model, sv.methods.Taylor()))._library, []
    steps = library.taylor
    monkeypatch.setattr(library, "taylor", lambda *given: ends.append(steps(*given)[1:, 0]) or steps(*given))
    run = sv.simulate(model, model.start(theta=0.1, dtheta=0.0), (0.0, 6.0), "Taylor", t_eval=np.linspace(0.0, 6.0, 61))
    assert np.isin(breaks[1:], np.concatenate(ends)).all()
    assert len(ends) <= 1 + run.counters["steps"] // TaylorSteps.most
    assert sv.verify(run).passed
