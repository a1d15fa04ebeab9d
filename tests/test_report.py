"""Verdicts and reports: every scene of the gallery against values derived by hand, traps, refusals."""

import contextlib
import json
from math import pi

import casadi as ca
import closed_forms as cf
import gallery_numbers
import numpy as np
import pytest
from refusals import refused, warned
from scipy.integrate import trapezoid

import servoctl as sv
from servoctl.gallery import gallery, mass_on_car
from servoctl.inversion.verdict import eigenvalues, verdict
from servoctl.methods.bounded import End

# The internal dynamics of every scene, by hand:
# - cranes, cars, the flat point, the driven arm: the load, the first car, the point or the hand determines all.
# - mass on car at 45°: m₂ sin²α s'' + d s' + k s = forcing, section by section of Seifried and Blajer.
# - two cars, ideal: the reaction acts on car 1, and car 2 swings on its spring, ω² = k/m₂.
# - passive arm: Γ < 0.4; centre of mass of the aircraft: θ'' = ω² sin θ with ω from the tilt.
# - pendubot: the second link hangs from the elbow, (I₂ + m₂ l₂²/4) δ'' + d δ' + m₂ g l₂/2 δ = 0, at both ends.
# - Appell-Hamel: φ'' = A θ'² - B, θ'' = -C φ'θ' conserve an energy; x, y and the angles only drift.
# - constant speed: positions and heading drift; the horizontal thrust leaves the free fall y'' = -g.
# - spiral and wheeled robot: place, heading and speed of the path drift.
PENDULUM = 0.07 + 3.0 * 0.5**2 / 4
HANGING = np.roots([PENDULUM, 0.05, 3.0 * 9.81 * 0.5 / 2])
AIRCRAFT = np.array([1.0, -1.0]) * cf.vtol_rate()
FLAT = (
    "overhead-crane", "overhead-crane-redundant", "winch-crane", "winch-crane-redundant", "crane-3d",
    "crane-3d-redundant", "two-cars", "three-cars", "vtol", "two-link-arm",
)  # fmt: skip
RESTING = {
    "mass-on-car": ("minimum phase", cf.mass_on_car_poles(pi / 4)),
    "mass-on-car-absolute": ("minimum phase", cf.mass_on_car_poles(pi / 4)),
    "two-cars-ideal": ("marginal", np.array([1j, -1j]) * np.sqrt(1.0 / 2.0)),
    "passive-arm": ("minimum phase", cf.passive_arm_poles(0.3, 10.0, 1.0)),
    "pendubot": ("minimum phase", HANGING),
    "vtol-centre": ("non-minimum phase (hyperbolic)", AIRCRAFT),
}
DRIFTING = (
    "appell-hamel", "appell-hamel-squared", "spiral", "constant-speed", "constant-speed-horizontal", "wheeled-robot",
)  # fmt: skip
# - double pendulum: two modes; elastic link: four damped ones.
# - ball on a turntable: the circle at 2/7 of the table's rate; the rest drifts, as wheels of a satellite do.
FLAT += ("slung-load", "slung-load-3d", "flexible-joint", "four-bar", "six-axis-arm")
RESTING |= {
    "double-pendulum": ("marginal", np.sqrt((2 + np.array([1, 1, -1, -1]) * np.sqrt(2)) * 9.81 / 0.8) * [1j, -1j, 1j, -1j]),
    "elastic-link": ("minimum phase", gallery_numbers.link_poles()),
}
FLAT += ("rotary-crane", "beam-crane")
RESTING |= {
    "cart-pole": ("non-minimum phase (hyperbolic)", np.array([1.0, -1.0]) * np.sqrt(9.81 / 0.5)),
    "fixed-rope-crane": ("non-minimum phase (hyperbolic)", np.array([1.0, -1.0]) * np.sqrt(9.81 / (5.0 - 4.0))),
    "furuta-pendulum": ("minimum phase", np.roots([0.2 * 0.3**2, 0.005, 0.2 * 9.81 * 0.3])),
    "acrobot": ("minimum phase", gallery_numbers.acrobot_poles()),
}
DRIFTING += ("hopper", "clothoid-arm", "bicycle", "steady-satellite")
DRIFTING += ("constant-jerk", "rolling-disc", "trailers")
CIRCLING = ("ball-on-turntable", "reaction-wheels")
OTHERS = ("cable-robot", "ball-and-beam", "tumbling-satellite", "jerkless-trolley")  # each has a test of its own


def scene_start(name, model):
    return model.start(guess=gallery[name].guess, **gallery[name].start)


RUNS = {}  # of scenes, so that each is simulated once


def scene_run(name, model):
    """The run of a scene, up to its stop."""
    if name not in RUNS:
        try:
            with warned("unstable") if name == "vtol-centre" else contextlib.nullcontext():
                RUNS[name] = sv.simulate(model, scene_start(name, model), gallery[name].t_span)
        except sv.errors.SingularProgram as error:
            RUNS[name] = error.run
    return RUNS[name]


def test_every_scene_has_a_verdict_by_hand():
    assert {*FLAT, *RESTING, *DRIFTING, *CIRCLING, *OTHERS} == {*gallery}


@pytest.mark.parametrize("name", FLAT)
def test_flat_scenes(name, gallery_model):
    model = gallery_model(name)
    assert verdict(model, scene_start(name, model)).word == "flat"


@pytest.mark.parametrize("name", RESTING)
def test_scenes_that_rest(name, gallery_model):
    word, expected = RESTING[name]
    found = verdict(gallery_model(name), scene_start(name, gallery_model(name)))
    assert found.word == word
    assert {*found.rest} == ({"start"} if name == "acrobot" else {"start", "end"})  # its program does not contain time
    for end in found.rest.values():
        there, here = (v[np.lexsort((v.imag, v.real.round(6)))] for v in (end.eigenvalues, expected))
        assert there == pytest.approx(here, abs=1e-7)


@pytest.mark.parametrize("name", DRIFTING)
def test_scenes_that_never_rest_are_judged_along_a_run(name, gallery_model):
    model = gallery_model(name)
    before = verdict(model, scene_start(name, model))
    assert before.word == "inconclusive" and "run" in before.do and not before.rest
    found = verdict(model, scene_run(name, model))
    assert found.word == "marginal" and found.internal.verdict == "neutral"


@pytest.mark.parametrize("name", CIRCLING)
def test_scenes_whose_rests_go_on_are_marginal(name, gallery_model):
    found = verdict(gallery_model(name), scene_run(name, gallery_model(name)))
    circle = [2 / 7 * 3.0, 2 / 7 * 3.0] if name == "ball-on-turntable" else [0.0, 0.0]
    assert found.word == "marginal" and found.internal.verdict == "neutral"
    eigenvalues = found.rest["end"].eigenvalues
    assert np.abs(np.sort_complex(eigenvalues)) == pytest.approx([circle[0], 0, 0, 0, 0, circle[1]], abs=1e-6)


def test_ropes_beyond_what_a_program_determines_are_undetermined(gallery_model):
    found = verdict(gallery_model("cable-robot"), scene_start("cable-robot", gallery_model("cable-robot")))
    assert found.word == "undetermined" and "flat" in found.reason and "determines 6" in found.reason


def test_a_satellite_that_loses_energy_alone_is_undetermined(gallery_model):
    model = gallery_model("tumbling-satellite")
    found = verdict(model, scene_run("tumbling-satellite", model))
    assert found.word == "undetermined" and "determines 1" in found.reason and "marginal" in found.reason
    assert found.internal.verdict == "neutral"


def test_a_rod_on_a_trolley_without_jerk_swings_as_it_hangs(gallery_model):
    """By 3 g/(2 l); the zero of x is triple, known to the cube root of rounding."""
    model = gallery_model("jerkless-trolley")
    found = verdict(model, scene_run("jerkless-trolley", model))
    assert found.word == "marginal" and found.internal.verdict == "neutral" and {*found.rest} == {"start", "end"}
    for end in found.rest.values():
        first, *middle, last = end.eigenvalues[np.argsort(end.eigenvalues.imag)]
        assert [first, last] == pytest.approx(np.array([-1j, 1j]) * np.sqrt(1.5 * 9.81), abs=1e-7)
        assert middle == pytest.approx([0, 0, 0], abs=1e-5)


def test_a_ball_rests_on_a_level_beam_alone(gallery_model):
    found = verdict(gallery_model("ball-and-beam"), scene_start("ball-and-beam", gallery_model("ball-and-beam")))
    assert found.word == "marginal" and {*found.rest} == {"start"}
    assert found.rest["start"].eigenvalues == pytest.approx([0.0, 0.0], abs=1e-6)


# traps ----------------------------------------------------------------------------------------------------------------


def crane(output=lambda x, theta: x + 4 * ca.sin(theta), path=None, end=5.0):
    """A cart of 10 kg with a load of 100 kg on a rope of 4 m; by default the load's x goes to 5 m in 6 s."""
    q = sv.coordinates("x theta")
    x, theta = q
    S = sv.particle(q, 10.0, (x, 0)) + sv.particle(q, 100.0, (x + 4 * ca.sin(theta), 4 * ca.cos(theta)))
    mechanism = sv.Mechanism(q, gibbs=S, potential=-3924.0 * ca.cos(theta), actuators={"F": x})
    if path is None:
        path = q.references(X=sv.paths.rest_to_rest(0.0, end, duration=6.0, smoothness=4)).X
    else:
        path = path(q.t)
    return mechanism, sv.Program({"X": output(x, theta) - path})


def cart(x, _):
    return x


def test_a_crane_of_fixed_rope_is_singular_at_rest():
    """X'' = x'' sin²θ - g sin θ cos θ - L θ'² sin θ: relative degree 2 in motion; 4 of the linearisation at θ = 0."""
    model = sv.derive(*crane())
    for start in (None, model.start(), model.start(theta=0.1, dtheta=0.0)):
        found = verdict(model, start)
        assert found.word == "singular at rest"
        assert "X 4" in found.reason and "X 2" in found.reason and "theta = 0" in found.reason
    ranks = sv.report(model).ranks
    assert [local.zeros_at_infinity for local in ranks.values()] == [(2,), (4,)]


def test_ball_and_beam_is_singular_at_rest():
    """r'' = r a'² - g sin a: the torque appears in r''' with the factor 2 r a', and at rest in r'''' alone."""
    q = sv.coordinates("r a")
    r, a = q
    S = sv.particle(q, 0.1, (r * ca.cos(a), r * ca.sin(a))) + 0.02 * q.d(2)[1] ** 2 / 2
    mechanism = sv.Mechanism(q, gibbs=S, potential=0.981 * r * ca.sin(a), actuators={"torque": a})
    path = q.references(r=sv.paths.rest_to_rest(0.1, 0.4, duration=3.0, smoothness=4)).r
    found = verdict(sv.derive(mechanism, sv.Program({"r": r - path})))
    assert found.word == "singular at rest" and "r 4" in found.reason and "r 3" in found.reason


@pytest.mark.parametrize(
    ("pose", "word", "rate"), [(0.0, "marginal", 1j), (pi, "non-minimum phase (hyperbolic)", 1.0)], ids=["down", "up"]
)
def test_the_pose_of_a_pendulum_on_a_cart_decides(pose, word, rate):
    model = sv.derive(*crane(cart))
    found = verdict(model, model.start(theta=pose, dtheta=0.0))
    expected = np.sort_complex(np.array([1.0, -1.0]) * rate * np.sqrt(9.81 / 4))
    assert found.word == word
    assert np.sort_complex(found.rest["end"].eigenvalues) == pytest.approx(expected, abs=1e-9)


def test_a_double_zero_eigenvalue_is_on_the_axis():
    """The angle of the rope is programmed: the cart may stand anywhere, x'' = f(θ), and runs away where θ stays."""
    found = verdict(sv.derive(*crane(lambda x, theta: theta, end=0.3)))
    assert found.word == "marginal" and found.rest["end"].moving and not found.rest["start"].moving


def mathieu():
    """A driven mass, and beside it x'' + 0.1 x' + (1 + 0.6 cos 2t) x = 0, whose frozen eigenvalues are all stable."""
    q = sv.coordinates("y x")
    y, x = q
    forces = {"x": -0.1 * q.d(1)[1] - (1 + 0.6 * ca.cos(2 * q.t)) * x}
    S = sv.particle(q, 1.0, (y, 0)) + sv.particle(q, 1.0, (x, 0))
    path = q.references(y=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=4)).y
    mechanism = sv.Mechanism(q, gibbs=S, forces=forces, actuators={"F": y}, outputs={"free": x})
    return sv.derive(mechanism, sv.Program({"y": y - path}))


def test_frozen_eigenvalues_are_no_verdict():
    model = mathieu()
    start = model.start(x=1e-3, dx=0.0)
    assert verdict(model, start).word == "inconclusive"
    with warned("unstable"):
        run = sv.simulate(model, start, (0.0, 120.0))
    assert verdict(model, run).word == "non-minimum phase"


def test_a_program_that_oscillates_is_judged_along_its_run():
    model = sv.derive(*crane(cart, lambda t: 0.1 * ca.sin(3 * t)))
    assert verdict(model).word == "inconclusive"
    assert verdict(model, sv.simulate(model, model.start(), (0.0, 20.0))).word == "marginal"


@pytest.mark.parametrize("angle", [0.5, 2.0, 2.5])
def test_a_run_is_not_judged_by_an_unstable_rest_far_from_it(angle):
    """An undamped pendulum swings about its lower rest, also from above the horizontal."""
    model = sv.derive(*crane(cart))
    run = sv.simulate(model, model.start(theta=angle, dtheta=0.0), (0.0, 20.0))
    assert verdict(model, run).word == "marginal"


def test_a_run_from_an_unstable_rest_is():
    model = sv.derive(*crane(cart))
    with warned("unstable"):
        run = sv.simulate(model, model.start(theta=pi, dtheta=0.0), (0.0, 6.0))
    assert verdict(model, run).word == "non-minimum phase (hyperbolic)"


def test_more_actuators_than_residuals_are_undetermined():
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, (x, 0, 0)), actuators={"left": x, "right": x})
    path = q.references(x=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=4)).x
    found = verdict(sv.derive(mechanism, sv.Program({"x": x - path})))
    assert found.word == "undetermined" and found.dynamics == "flat" and "left, right" in found.reason


def test_a_program_without_actuators_is_not_realisable():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={"F": x})
    report = sv.report(mechanism, sv.Program({"x": x - q.t, "y": y}))
    assert report.verdict == "not realisable" and "F" in report.reason
    assert set(report.residuals) == {"x", "y"} and report.as_dict()["verdict"] == "not realisable"


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("upright", [True, False])
def test_units_change_no_verdict(unit, upright):
    q = sv.coordinates("x a")
    x, a = q
    S = sv.particle(q, 1.0, (x, 0)) + sv.particle(q, 0.2, (x + 0.5 * unit * ca.sin(a), 0.5 * unit * ca.cos(a)))
    sign = 1 if upright else -1
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=sign * 0.2 * 9.81 * unit * 0.5 * unit * ca.cos(a), actuators={"F": x},
        forces={"a": -0.01 * unit**2 * q.d(1)[1]},
    )  # fmt: skip
    path = unit * q.references(x=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=4)).x
    found = verdict(sv.derive(mechanism, sv.Program({"x": x - path})))
    expected = np.roots([1.0, 0.2, -sign * 9.81 / 0.5])
    assert found.word == ("non-minimum phase (hyperbolic)" if upright else "minimum phase")
    assert np.sort_complex(found.rest["start"].eigenvalues) == pytest.approx(np.sort_complex(expected), rel=1e-8)


STIFF = np.array([[0.0, 1.0], [-1e9, -1.0]])


@pytest.mark.parametrize(
    ("A", "size", "count"),
    [
        (np.eye(4, k=1) + 1e-16 * np.eye(4, k=-3), 1.0, 4),  # a chain of integrators, which rounding splits by 1e-4
        (np.diag([1e3, 1.0], k=1) + 1e-17 * np.eye(3, k=-2), 1.0, 3),
        (np.array([[0.0, 1.0], [1e-17, 0.0]]), 1.0, 2),
        (np.array([[0.0, 1.0], [-1.0, 0.0]]), 1.0, 2),
        (np.array([[0.0, 1.0], [-1.0, -1e-10]]), 1.0, 2),
        (np.array([[0.0, 1.0], [-1.0, -1e-9]]), 1.0, 0),
        (np.array([[0.0, 1e7], [-1e-7, -1e-7]]), np.array([1e7, 1.0]), 0),
        (np.diag([1.0, -1e-8]), 1.0, 0),
        (STIFF, 1.0, 0),
        (np.diag([-1e6, -1e-5]), 1.0, 0),
        (np.array([[0.0, 1.0], [-10.0, -1e6]]), 1.0, 0),
        (np.array([[0.0, 1.0], [1.0, -1e6]]), 1.0, 0),
        (np.array([[0.0, 1.0], [0.0, -1e9]]), 1.0, 1),
        (np.diag([-1e6, -1e-9]), 1.0, 1),  # 1e-15 of the fastest: the rounding of zero
        (np.diag([-0.01, -0.01]) + np.eye(2, k=1), 1.0, 0),
    ],
)
def test_eigenvalues_on_the_axis(A, size, count):
    """One on the axis within rounding, however rounding has split it; slow, stiff or slightly damped modes are not."""
    assert len(End(0.0, np.zeros(len(A)), A, size * np.ones(len(A))).on_axis) == count


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_rounding_of_zero_is_printed_as_zero(unit):
    """Of two integrators, whose double eigenvalue rounding splits, and of an oscillator, whose frequency is none."""
    A = np.array([[0.0, unit], [-1e-30 * unit, 0.0]])
    assert eigenvalues(End(0.0, np.zeros(2), A, np.ones(2))) == "eigenvalues 0, 0 1/s"
    slow = np.array([[0.0, 1.0], [-(1e-6**2), 0.0]])
    assert eigenvalues(End(0.0, np.zeros(2), slow, np.ones(2))) == "eigenvalues 0 ± 1e-06i 1/s"


def test_a_run_backwards_has_the_same_rests():
    model = sv.derive(*gallery["passive-arm"].build())
    run = sv.simulate(model, model.start(t=2.0, q2=0.0, dq2=0.0), (2.0, 1.9))
    found = verdict(model, run)
    assert [end.t for end in found.rest.values()] == [2.0] and "start" in found.rest


def test_a_plant_under_inputs_has_no_verdict():
    plant = sv.plant(crane()[0])
    run = sv.simulate(plant, {"x": 0.0, "theta": 0.1, "dx": 0.0, "dtheta": 0.0}, (0.0, 1.0), inputs={"F": 1.0})
    report = sv.report(run)
    assert report.verdict == "inconclusive" and len(repr(report).splitlines()) <= 8


@pytest.mark.parametrize("name", ["winch-crane", "crane-3d"])
def test_samples_near_a_rest_claim_no_other_zeros_at_infinity(name, gallery_model):
    """At 0.12 s of 6 s the rope's angle is about 1e-10: its relative error makes matrices of low rank regular."""
    model = gallery_model(name)
    run = sv.simulate(model, scene_start(name, model), gallery[name].t_span)
    structure = model.structure(run)
    assert {local.zeros_at_infinity for _, local in structure.at} <= {structure.zeros_at_infinity, ()}
    assert structure.zeros_at_infinity == ((2, 4) if name == "winch-crane" else (2, 4, 4))


# what a report holds --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [pi / 6, pi / 4, 1.2])
def test_the_angle_between_actuator_and_normal(alpha):
    """cos = (G M⁻¹ E)/√((G M⁻¹ Gᵀ)(Eᵀ M⁻¹ E)) = m₂ sin²α/√(m₂ (m₂ sin²α + m₁ cos²α)), in any coordinates."""
    expected = 2 * np.sin(alpha) ** 2 / np.sqrt(2 * (2 * np.sin(alpha) ** 2 + np.cos(alpha) ** 2))
    for coordinates in ("relative", "absolute"):
        found = sv.report(sv.derive(*mass_on_car(alpha, coordinates=coordinates))).directions
        assert found.cosines == pytest.approx([expected], rel=1e-12)
        assert found.actuators == found.residuals == ()


@pytest.mark.parametrize(("alpha", "idle"), [(6e-4, ()), (1.9e-4, ("force",))])
def test_weak_directions_act_above_1e_7(alpha, idle):
    """cos = √2 α²: 5.1e-7 and 5.1e-8."""
    found = sv.report(sv.derive(*mass_on_car(alpha))).directions
    assert found.cosines == pytest.approx([np.sqrt(2) * alpha**2], rel=1e-5) and found.actuators == idle


def test_directions_without_effect_are_named(gallery_model):
    model = gallery_model("crane-3d")
    found = sv.report(model, scene_start("crane-3d", model)).directions
    assert found.cosines == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)  # the hoist lifts; a hanging load does not move aside
    assert found.actuators == ("bridge", "trolley") and found.residuals == ("X", "Y")


def test_the_report_of_a_crane(crane_plan):
    report = sv.report(crane_plan, limits={"trolley": (-200.0, 140.0)})
    assert (report.verdict, report.index, report.realisation, report.free) == ("flat", 5, "mixed", 0)
    expected = {"order": 0, "raised": 2, "relative degree": 2, "class": 4}
    assert report.residuals == {"X": expected, "Z": expected}
    trolley = report.efforts["trolley"]
    assert trolley.peak == pytest.approx(-137.991607, abs=1e-6) and trolley.peak_at == pytest.approx(4.155, abs=1e-3)
    assert trolley.limit == 140.0 and trolley.room == pytest.approx(140.0 - 134.331943, abs=1e-6)
    t = np.linspace(0.0, 8.0, 20001)
    exact = cf.overhead_crane(t)["trolley"]
    assert trolley.rms == pytest.approx(np.sqrt(trapezoid(exact**2, t) / 8.0), rel=1e-5)
    assert trolley.rate == pytest.approx(-np.abs(np.gradient(exact, t)).max(), rel=1e-3)
    assert report.margin[0] > 0.5 and len(report.ranks) == 3
    degrees = [local.relative_degree for local in report.ranks.values()]
    assert degrees == [(2, 2), (4, 2), (2, 2)]  # hanging at the start, and moving


def test_rates_are_exact_where_the_run_has_the_jets(crane_plan):
    model = crane_plan.model
    run = sv.simulate(model, crane_plan.start, (0.0, 8.0), sv.methods.Algebraic())
    sampled = sv.report(run).efforts["trolley"]
    finer = sv.simulate(model, crane_plan.start, (0.0, 8.0), t_eval=np.linspace(0.0, 8.0, 8001))
    assert sampled.rate == pytest.approx(sv.report(finer).efforts["trolley"].rate, rel=1e-4)


@pytest.mark.parametrize(
    "name", ["crane-3d-redundant", "vtol-centre", "two-cars-ideal", "appell-hamel-squared", "cable-robot"]
)
def test_reports_are_short_and_serve_json(name, gallery_model):
    model = gallery_model(name)
    for what in (model, scene_run(name, model)):
        report = sv.report(what)
        lines = repr(report).splitlines()
        assert 1 <= len(lines) <= 8 and not any(line.endswith("...") for line in lines)
        assert json.loads(json.dumps(report.as_dict(), allow_nan=False)) == report.as_dict()


@pytest.mark.parametrize("name", ["overhead-crane", "two-cars-ideal"])
def test_the_figure_of_a_report(name, gallery_model, tmp_path):
    model = gallery_model(name)
    for what in (model, scene_run(name, model)):
        report = sv.report(what)
        figure = report.plot()
        drawn = [ax for ax in figure.axes if ax.axison]
        assert len(drawn) >= len(report.efforts) and report.verdict in figure.get_suptitle()
        figure.savefig(tmp_path / "report.png")


# refusals -------------------------------------------------------------------------------------------------------------


def test_what_is_no_specification_is_refused(gallery_model, crane_plan):
    model = gallery_model("two-cars")
    for given in ((None,), ("two-cars",), (model, 3.0), (model, crane_plan), (model, crane_plan.start)):
        with refused(sv.errors.SpecificationError):
            sv.report(*given)
    with refused(sv.errors.SpecificationError, "sv.Program"):
        sv.report(gallery["two-cars"].build()[0])


def test_limits_need_a_run_and_an_actuator(crane_plan):
    with refused(sv.errors.SpecificationError, "trolley"):
        sv.report(crane_plan.model, None, {"trolley": 100.0})
    with refused(sv.errors.NameUnknown, match="trolley"):
        sv.report(crane_plan, limits={"troley": 100.0})
    with refused(sv.errors.SpecificationError, name="trolley"):
        sv.report(crane_plan, limits={"trolley": -1.0})


@pytest.mark.parametrize("friction, said", [(0.0, "undamped at rest"), (3.0, "decays with at least 1.5 1/s at rest")])
def test_self_motion_is_reported_and_whether_it_is_damped(friction, said):
    """A mass of 2 kg in a plane with a force along each axis, of which the program prescribes one."""
    q = sv.coordinates("x y")
    x, y = q
    S, forces = sv.particle(q, 2.0, ca.vertcat(x, y)), {"y": -friction * q.d(1)[1]}
    mechanism = sv.Mechanism(q, gibbs=S, forces=forces, actuators={"Fx": x, "Fy": y})
    report = sv.report(mechanism, sv.Program({"x": x - q.references(x=sv.paths.rest_to_rest(0.0, 1.0, 1.0)).x}))
    assert f"self-motion of 1 velocity, {said}" in str(report)
    facts = report.as_dict()["self_motion"]
    assert facts["velocities"] == 1 and facts["rate"] == pytest.approx(-friction / 2)


def test_a_program_for_each_actuator_leaves_no_self_motion():
    report = sv.report(*gallery["overhead-crane"].build())
    assert report.self_motion is None and "self-motion" not in str(report)


# kinks ----------------------------------------------------------------------------------------------------------------


def beside(force, path=None):
    """A driven mass beside a free one, y'' = force(x, y, y')."""
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    S = sv.particle(q, 1.0, x) + sv.particle(q, 1.0, y)
    free = {"free": y}  # an output, so that no free mass is left out
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"F": x}, forces=ca.vertcat(0, force(x, y, dy)), outputs=free)
    if path is None:
        path = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=4)).X
    return mechanism, sv.Program({"X": x - path})


KINKS = {
    "one-sided spring": lambda x, y, v: -ca.fmax(y, 0) - 0.2 * v - 0.3 * x,
    "modulus": lambda x, y, v: -ca.fabs(y) - 0.2 * v,
    "Coulomb friction": lambda x, y, v: -y - 0.1 * ca.sign(v),
    "two stiffnesses": lambda x, y, v: -ca.if_else(y > 0, y, 2 * y) - 0.2 * v,
    "a spring that unloads": lambda x, y, v: -ca.fmax(y + 1, 0) + 1 - ca.fmax(y, 0) - 0.2 * v,
}
SMOOTH_THERE = {
    "Hertz": (lambda x, y, v: -y - ca.fmax(y, 0) ** 2 - 0.2 * v, [-0.1 + 0.99499j, -0.1 - 0.99499j]),
    "stop away": (lambda x, y, v: -y - ca.fmax(y - 0.5, 0) - 0.2 * v, [-0.1 + 0.99499j, -0.1 - 0.99499j]),
    "saturation": (lambda x, y, v: -ca.fmin(ca.fmax(y, -1), 1) - 0.2 * v, [-0.1 + 0.99499j, -0.1 - 0.99499j]),
    "drag": (lambda x, y, v: -y - ca.fabs(v) * v, [1j, -1j]),
    "of the driven mass": (lambda x, y, v: -y - 0.2 * v + ca.fabs(x), [-0.1 + 0.99499j, -0.1 - 0.99499j]),
}


@pytest.mark.parametrize("name", ["modulus", "Coulomb friction", "a spring that unloads"])
def test_a_run_that_stays_on_a_kink_is_inconclusive(name):
    """At rest on a kink CasADi's slope is that of one side."""
    model = sv.derive(*beside(KINKS[name], ca.SX(0)), keep=["y"])
    run = sv.simulate(model, model.start(), (0.0, 3.0))
    assert run.internal["verdict"] == "inconclusive" and "stays on a switch" in run.internal["text"]
    mechanism, program = beside(KINKS[name], ca.SX(0))
    with refused(sv.errors.UnstableInternalDynamics, "switch", verdict="inconclusive"):
        sv.computed(run, sv.plant(mechanism), rate=100.0)


@pytest.mark.parametrize("name", ["Hertz", "drag", "of the driven mass"])
def test_a_run_that_stays_beside_kinks_is_judged(name):
    model = sv.derive(*beside(SMOOTH_THERE[name][0], ca.SX(0)), keep=["y"])
    run = sv.simulate(model, model.start(), (0.0, 20.0))
    assert run.internal["verdict"] == ("neutral" if name == "drag" else "stable")


@pytest.mark.parametrize("name", KINKS)
def test_a_rest_on_a_kink_has_no_eigenvalues(name):
    found = verdict(sv.derive(*beside(KINKS[name]), keep=["y"]))
    assert found.word == "inconclusive" and not found.rest
    assert "on a switch" in found.reason and "tanh" in found.do and "run" in found.do


@pytest.mark.parametrize("name", SMOOTH_THERE)
def test_a_rest_on_a_switch_without_a_kink_has_eigenvalues(name):
    force, expected = SMOOTH_THERE[name]
    found = verdict(sv.derive(*beside(force), keep=["y"]))
    assert found.word == ("marginal" if name == "drag" else "minimum phase")
    assert found.rest["start"].eigenvalues == pytest.approx(expected, abs=1e-5)


def test_a_smoothed_kink_has_a_verdict():
    found = verdict(sv.derive(*beside(lambda x, y, v: -y - 0.1 * ca.tanh(v / 0.1)), keep=["y"]))
    assert found.word == "minimum phase"
    assert found.rest["start"].eigenvalues == pytest.approx(np.roots([1, 1, 1]), abs=1e-9)


def test_output_redefinition_refuses_an_equilibrium_on_a_kink():
    p = sv.parameters(a=0.5)
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    S = sv.particle(q, 1.0, x) + sv.particle(q, 1.0, y)
    mechanism = sv.Mechanism(
        q, gibbs=S, actuators={"F": x}, forces=ca.vertcat(0, -p.a * ca.fmax(y, 0) - dy), parameters=p
    )
    with refused(sv.errors.InconsistentStart, switch="y = 0"):
        sv.minimum_phase(sv.derive(mechanism, sv.Program({"X": x}), keep=["y"]), "a", (0.1, 1.0))


def test_output_redefinition_takes_an_equilibrium_beside_a_kink():
    p = sv.parameters(a=0.5)
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    S = sv.particle(q, 1.0, x) + sv.particle(q, 1.0, y)
    forces = ca.vertcat(0, -p.a * y - ca.fmax(y - 0.5, 0) - dy)
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"F": x}, forces=forces, parameters=p)
    result = sv.minimum_phase(sv.derive(mechanism, sv.Program({"X": x}), keep=["y"]), "a", (0.1, 1.0))
    assert [r.verdict for r in result.ranges] == ["stable"]


# constants of integrals, on which nothing depends ---------------------------------------------------------------------


def ballbot(roll, gravity=9.81):
    """A ball of radius 0.2 m under a body that stands on it, driven by the torque between both."""
    q = sv.coordinates("x phi a")
    x, phi, a = q
    S = sv.particle(q, 1.0, x) + 0.01 * q.d(2)[1] ** 2 + sv.particle(q, 1.0, (x + 0.6 * ca.sin(a), 0.6 * ca.cos(a)))
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=gravity * 0.6 * ca.cos(a), actuators={"T": phi - a}, constraints={"roll": roll(q)}
    )
    path = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=4)).X
    return sv.derive(mechanism, sv.Program({"X": x - path}))


def on_velocities(q):
    return q.d(1)[0] - 0.2 * q.d(1)[1]


def on_coordinates(q):
    x, phi, _ = q
    return x - 0.2 * phi


@pytest.mark.parametrize("gravity", [9.81, -9.81])
def test_the_constant_of_a_rolling_constraint_is_named(gravity):
    written, integrated = verdict(ballbot(on_velocities, gravity)), verdict(ballbot(on_coordinates, gravity))
    assert written.word == integrated.word == ("marginal" if gravity < 0 else "non-minimum phase (hyperbolic)")
    assert "0 is the constant of phi, on which nothing depends" in written.reason
    assert "constant" not in integrated.reason
    others = [z for z in written.rest["start"].eigenvalues if abs(z) > 1e-6]
    assert others == pytest.approx(list(integrated.rest["start"].eigenvalues), abs=1e-6)


def test_a_place_on_which_nothing_depends_is_named_and_stays_marginal():
    found = verdict(sv.derive(*beside(lambda x, y, v: -0.2 * v - x), keep=["y"]))
    assert found.word == "marginal" and "constant of y, on" in found.reason
    mechanism, _ = beside(lambda x, y, v: -0.2 * v)
    found = verdict(sv.derive(mechanism, sv.Program({"V": mechanism.q.d(1)[0]}), keep=["y"]))
    assert found.word == "marginal" and "constant of x, y, on" in found.reason


def test_an_angle_of_90_degrees_has_no_cosine_of_1():
    """The force on x moves the first residual directly, and the second, y, through its spring alone."""
    q = sv.coordinates("x y z")
    x, y, z = q
    S = sv.particle(q, 1.0, x) + sv.particle(q, 1.0, y) + sv.particle(q, 1.0, z)
    mechanism = sv.Mechanism(q, gibbs=S, potential=(y - z) ** 2 / 2, actuators={"F": x, "G": y})
    text = repr(sv.report(sv.derive(mechanism, sv.Program({"X": x, "Z": z}))))
    assert "90° apart (least cosine of the others 1)" in text
