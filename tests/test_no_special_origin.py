"""Another origin, zero of an angle, unit or order of names changes no start, verdict, method or force."""

import casadi as ca
import numpy as np
import pytest
from moved import moved, values

import servoctl as sv
from servoctl.gallery import gallery

FLAT, INTEGRATED = 1e-9, 1e-7  # of a signal's size: instant by instant; ten times the tolerance of an integration


def rest_to_rest(q, start, end, duration=6.0):
    path = sv.paths.rest_to_rest(start, end, duration=duration, smoothness=4)
    return [*q.references(**{f"r{i}": path[i] for i in range(path.dim)})]


def crab_crane(at=0.0, zero=0.0, unit=1.0, inertia=200.0, damping=50.0):
    """A trolley whose rod of 5 m swings: the rail has no origin."""
    q = sv.coordinates("x th")
    x, angle, g = q["x"] / unit, q["th"] + zero, 9.81
    load = ca.vertcat(x + 5 * ca.sin(angle), -5 * ca.cos(angle))
    rates = (0, 0, q.d(1)[1])
    S = sv.particle(q, 2.5, x) + sv.rigid_body(q, 60.0, (0, 0, inertia), position=load, rates=rates)
    return sv.Mechanism(
        q, S, potential=60 * g * load[1], forces={"th": -damping * q.d(1)[1]}, actuators={"f": ca.vertcat(1 / unit, 0)}
    ), sv.Program({"load": load[0] - rest_to_rest(q, at, at + 3.0)[0]})


def damped_crane(at=0.0, rail=0.0):
    """The README's crane with one line of damping, and its rail anywhere."""
    q = sv.coordinates("x l theta")
    x, l, theta = q
    load = ca.vertcat(x + l * ca.sin(theta), rail - l * ca.cos(theta))
    mechanism = sv.Mechanism(
        q, sv.particle(q, 10.0, x) + sv.particle(q, 100.0, load), potential=100 * 9.81 * load[1],
        forces={"theta": -5 * q.d(1)[2]}, actuators={"trolley": x, "hoist": l},
    )  # fmt: skip
    path = rest_to_rest(q, (at, rail - 4.0), (at + 5.0, rail - 2.0))
    return mechanism, sv.Program({"X": load[0] - path[0], "Z": load[1] - path[1]})


def redundant_crane(rail=0.0):
    q = sv.coordinates("x l X Z")
    x, l, X, Z = q
    S = sv.particle(q, 10.0, ca.vertcat(X, Z)) + sv.particle(q, 12.0, x) + 0.05 * q.d(2)[1] ** 2
    rope = {"rope": (X - x) ** 2 + (rail - Z) ** 2 - l**2}
    mechanism = sv.Mechanism(q, S, potential=98.1 * Z, actuators={"trolley": x, "hoist": l}, constraints=rope)
    path = rest_to_rest(q, (0.0, rail - 4.0), (5.0, rail - 2.0))
    return mechanism, sv.Program({"X": X - path[0], "Z": Z - path[1]})


def tool_below(at=0.0, zero=0.0):
    """A tool 1 m below a load that swings on 4 m of rope."""
    q = sv.coordinates("x th")
    x, angle = q["x"], q["th"] + zero
    load, tool = (ca.vertcat(x + length * ca.sin(angle), -length * ca.cos(angle)) for length in (4.0, 5.0))
    S = sv.particle(q, 5.0, x) + sv.particle(q, 20.0, load)
    mechanism = sv.Mechanism(q, S, potential=20 * 9.81 * load[1], actuators={"f": x})
    return mechanism, sv.Program({"tool": tool[0] - rest_to_rest(q, at, at + 2.0)[0]})


def passive_arm(at=0.0):
    """A driven base, an elbow on a spring, in a horizontal plane."""
    q = sv.coordinates("base elbow")
    base, elbow = q
    tip = ca.vertcat(ca.cos(base), ca.sin(base)) + 0.3 * ca.vertcat(ca.cos(base + elbow), ca.sin(base + elbow))
    S = sv.particle(q, 2.0, ca.vertcat(ca.cos(base), ca.sin(base))) + sv.particle(q, 1.0, tip)
    mechanism = sv.Mechanism(
        q, S, potential=2.0 * elbow**2, forces={"elbow": -0.3 * q.d(1)[1]}, actuators={"tau": base}
    )
    return mechanism, sv.Program({"y": base + 0.2 * elbow - rest_to_rest(q, at, at + 1.0, 3.0)[0]})


def forces(plan):
    return np.array([plan[name] for name in plan.model.actuators])


def same(plan, other, tolerance, factor=1.0):
    a, b = forces(plan), forces(other)
    return np.abs(a - b * factor).max() <= tolerance * np.abs(a).max()


@pytest.mark.parametrize(
    "other",
    [{"at": 5.0}, {"at": 2.0}, {"at": -100.0}, {"zero": np.pi / 2}, {"zero": 0.3}, {"zero": 6.0},
     {"zero": -1.2, "at": 10.0}, {"unit": 1e3, "at": 0.3}, {"unit": 1e-3, "at": 40.0}],
)  # fmt: skip
def test_the_crab_crane_needs_the_same_forces_everywhere(other):
    """-46.138 .. 45.222 N by SciPy on th'' = -(L m (x'' cos th + g sin th) + c th')/(m L^2 + I), x'' from the path."""
    plan = sv.inverse(*crab_crane(**other), (0.0, 6.0))
    assert (plan["f"].min(), plan["f"].max()) == pytest.approx((-46.1374, 45.2222), abs=2e-3)
    assert "minimum phase" in plan.message and sv.verify(plan).passed


@pytest.mark.parametrize("make, options, others", [
    (crab_crane, {"inertia": 1.5, "damping": 0.0}, [{"at": 2.0}, {"at": 7.0, "zero": 1.2}]),
    (crab_crane, {"inertia": 0.0}, [{"at": 1.0}, {"at": -4.0}]),
    (tool_below, {}, [{"at": 2.0}, {"at": 3.0}, {"at": 10.0}, {"zero": -np.pi / 2}]),
    (passive_arm, {}, [{"at": 3.0}, {"at": 6.0}]),
    (damped_crane, {}, [{"at": 3.0}, {"rail": 20.0}, {"at": -12.0, "rail": -7.0}]),
    (redundant_crane, {}, [{"rail": 20.0}, {"rail": -3.0}]),
])  # fmt: skip
@pytest.mark.filterwarnings("ignore:The program is marginal")
def test_machines_need_the_same_forces_everywhere(make, options, others):
    start = {"start": {"l": 4.0}} if "crane" in make.__name__ and make is not crab_crane else {}
    span = (0.0, 3.0) if make is passive_arm else (0.0, 6.0)
    plan = sv.inverse(*make(**options), span, **start)
    for other in others:
        moved_plan = sv.inverse(*make(**options, **other), span, **start)
        assert moved_plan.message.split("inverse")[1] == plan.message.split("inverse")[1]
        tolerance = FLAT if plan.model.flat else 1e-6 if plan.method == "relaxed" else INTEGRATED
        assert same(plan, moved_plan, tolerance), other


@pytest.mark.parametrize("guess", [{"l": 4.0, "x": 0.05}, {"l": 4.0}, {"l": 5.2, "x": -1.5, "dx": 2.0}])
def test_a_damped_crane_starts_at_rest(guess):
    """A force of 308,000 N from a guess 5 cm off; the quasi-static path needs m_t X'' + m (g tan) = 134 N at most."""
    model = sv.derive(*damped_crane())
    start = model.start(guess=guess)
    assert start.values.tolist() == pytest.approx([0, 4, 0, 0, 0, 0], abs=1e-12)
    plan = sv.simulate(model, start, (0.0, 6.0))
    assert np.abs(plan["trolley"]).max() < 150


@pytest.mark.parametrize("rail", [0.0, 20.0])
@pytest.mark.parametrize("guess", [{"l": 4.0}, {"l": 3.5}, {"l": 4.0, "x": 0.3}, {"l": 5.0, "X": 1.0}])
def test_a_rope_keeps_the_sign_of_its_guess(rail, guess):
    model = sv.derive(*redundant_crane(rail), guess=guess)
    plan = sv.simulate(model, model.start(guess=guess), (0.0, 6.0))
    assert plan["l"][0] == pytest.approx(4.0, rel=1e-12) and plan["hoist"][0] == pytest.approx(-98.1, rel=1e-10)


def test_what_is_held_stays_and_what_is_guessed_gives_way():
    """With the trolley held 5 cm off there is no rest: the start moves, as was asked for."""
    model = sv.derive(*damped_crane())
    start = model.start(guess={"l": 4.0}, x=0.05)
    assert start["x"] == 0.05 and abs(start["dx"]) > 1
    assert model.start(guess={"l": 4.0, "x": 0.05}, dx=0.0)["x"] == pytest.approx(0.0, abs=1e-12)


SCENES = {  # scenes in plain coordinates, each through one change
    "overhead-crane": ({"x": 10.0, "theta": 0.3}, {}), "crane-3d": ({"x": -1.0, "y": 100.0}, {"l": 1e-3}),
    "two-cars": ({"x1": 10.0}, {}), "vtol": ({"x": 100.0, "theta": 6.0}, {}),
    "flexible-joint": ({"q": np.pi}, {}), "rotary-crane": ({}, {"r": 1e3, "l": 1e3}),
    "mass-on-car": ({}, {"x1": 1e-3, "s": 1e-3}), "pendubot": ({"q1": np.pi / 2}, {}),
    "vtol-centre": ({"theta": 0.3}, {"z": 1e3}), "double-pendulum": ({"x": -10.0}, {"x": -1.0}),
    "cart-pole": ({"x": 1.0, "theta": 6.0}, {}), "slung-load": ({"x": -10.0, "z": -10.0}, {}),
    "furuta-pendulum": ({"phi": 6.0}, {}), "ball-and-beam": ({"r": -1.0}, {"r": 1e-3}),
    "two-link-arm": ({"q1": np.pi, "q2": 0.3}, {}), "winch-crane": ({"x": 1.0}, {"x": 1e-3}),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_scenes_need_the_same_forces_in_other_coordinates(name):
    scene = gallery[name]
    mechanism, program = scene.build()
    shifts, scales = SCENES[name]
    shifts, scales = ({n: v for n, v in some.items() if n in mechanism.q.names} for some in (shifts, scales))
    machine, residuals, names = moved(mechanism, program, shifts, scales, reverse=True)
    plans = []
    for built, known in (((mechanism, program), lambda some: some or {}),
                         ((machine, residuals), lambda some: values(some, names, shifts, scales))):  # fmt: skip
        model = sv.derive(*built, known(scene.guess) or None)
        plans.append(
            sv.simulate(model, model.start(scene.t_span[0], known(scene.guess), **known(scene.start)), scene.t_span)
        )
    assert plans[1].model.flat == plans[0].model.flat
    assert same(*plans, FLAT if plans[0].model.flat else INTEGRATED)


@pytest.mark.parametrize("shift", [-10.0, 100.0])
def test_places_and_headings_are_as_exact_anywhere(shift):
    """A step of the bicycle's had errors of rtol times its place, 100 m: 1e-7 m, and also 1e-7 rad of its heading."""
    scene, plans = gallery["bicycle"], []
    for shifts in ({}, {"x": shift, "y": shift}):
        *built, names = moved(*scene.build(), shifts)
        start, guess = (values(some, names, shifts, {}) for some in (scene.start, scene.guess))
        model = sv.derive(*built, {**start, **guess})
        plans.append(sv.simulate(model, model.start(0.0, guess, **start), scene.t_span))
    for name, c in {"nx": shift, "ny": shift, "npsi": 0.0, "ndelta": 0.0}.items():
        assert plans[1][name] + c == pytest.approx(plans[0][name], abs=1e-9 * np.abs(plans[0][name]).max()), name


@pytest.mark.parametrize("shift", [10.0, 100.0])
def test_a_program_is_flat_wherever_its_pivots_were_chosen(shift):
    """Those of an aircraft derived far from its path vanish where it hovers; "singular at rest", said the verdict."""
    mechanism, program = gallery["vtol"].build()
    machine, residuals, _ = moved(mechanism, program, {"x": shift, "z": shift})
    plans = [sv.inverse(*built, (0.0, 4.0)) for built in ((mechanism, program), (machine, residuals))]
    assert plans[1].method == "algebraic" and same(*plans, FLAT)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_rest_after_a_path_is_where_the_path_ends(unit):
    """Newton's method took steps of one unit at most, 40 in all: 40 mm of 5 m."""
    machine, program, names = moved(*gallery["vtol-centre"].build(), scales={"x": unit, "z": unit})
    model = sv.derive(machine, program)
    rest = sv.report(model, model.start()).basis.rest["end"]
    assert (unit * rest.x[:2]).tolist() == pytest.approx([5.0, 2.0], rel=1e-12)


@pytest.mark.parametrize("shift", [0.0, 1.0, -1.0, 1e3, 1e5, 1e6])
def test_the_orders_of_a_satellite_do_not_hang_on_where_the_earth_lies(shift):
    """What falls with a power of the distance has no usual size: a guess of y that is small led 1e27 m away."""
    p, q = sv.parameters(m=100.0, mu=3.986e14), sv.coordinates("x y")
    place, acceleration = ca.vertcat(*q) + shift, q.dt(ca.vertcat(*q), 2)
    mechanism = sv.Mechanism(q, sv.particle(q, p.m, place), potential=-p.m * p.mu / ca.norm_2(place), parameters=p)
    program = sv.Program({"steady": ca.dot(acceleration, q.dt(ca.vertcat(*q), 3))}, by="ideal")
    known = {"x": 7e6 - shift, "y": -shift, "dx": 0.0, "dy": 8266.372624, "d2y": 0.0}
    model = sv.derive(mechanism, program, {**known, "d2x": -8.13})
    assert [row.order for row in model.reduction.rows] == [3, 2]
    assert model.start(guess={"d2x": -8.13}, **known).free == ("d2x",)


@pytest.mark.parametrize("method, tolerance", [("Taylor", 1e-9), ("DOP853", 1e-8), ("RadauIIA", 1e-9)])
def test_tolerances_do_not_hang_on_where_a_machine_lies(method, tolerance):
    """At 100 km from the origin they were those of a motion as large: 3.8e-6 of a hopper's size by DOP853."""
    scene, runs, shifts = gallery["hopper"], [], {"x": 1e5, "y": 1e5}
    for some in ({}, shifts):
        *built, names = moved(*scene.build(), some)
        start, guess = (values(known, names, some, {}) for known in (scene.start, scene.guess))
        model = sv.derive(*built, {**start, **guess})
        runs.append(sv.simulate(model, model.start(0.0, guess, **start), scene.t_span, method))
    assert abs(runs[1].counters["steps"] - runs[0].counters["steps"]) <= 1
    for name, there in names.items():
        size = np.abs(runs[0][there]).max()
        assert runs[1][there] + shifts.get(name, 0.0) == pytest.approx(runs[0][there], abs=tolerance * size), name


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_coordinates_with_constant_directions_are_the_dependent_ones_in_all_units(unit):
    """In mm angles were, and equations divided by the cosine of one: the motion went on by DOP853."""
    scene = gallery["appell-hamel"]
    mechanism, program = scene.build()
    scales = dict.fromkeys("xyz", unit)
    machine, residuals, names = moved(mechanism, program, scales=scales)
    model = sv.derive(machine, residuals, values(scene.start, names, {}, scales))
    assert model.reduction.realisation.dependent == (0, 1, 2)
    run = sv.simulate(model, model.start(0.0, **values(scene.start, names, {}, scales)), scene.t_span)
    assert run.method == "Taylor" and run.message == "finished"


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_verdict_on_a_start_in_motion_is_the_same_in_all_units(unit):
    """In km other entries of a disc's state were free, and the verdict was that of an upright disc at rest."""
    scene, verdicts = gallery["rolling-disc"], []
    for scales in ({}, dict.fromkeys("xyz", unit)):
        *built, names = moved(*scene.build(), scales=scales)
        start, guess = (values(known, names, {}, scales) for known in (scene.start, scene.guess))
        model = sv.derive(*built, {**start, **guess})
        verdicts.append(sv.report(model, model.start(0.0, guess, **start)).verdict)
    assert verdicts == ["inconclusive", "inconclusive"]
