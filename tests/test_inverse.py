"""The inverse that the verdict chooses: which one, why, and that no unstable plan comes in silence."""

import contextlib
from math import pi

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from refusals import refused, warned
from scenes import KINDS
from scipy.integrate import solve_ivp, trapezoid
from test_bounded import aircraft, arm, flexible_link
from test_report import FLAT, KINKS, beside, cart, crane, mathieu

import servoctl as sv
from servoctl.control.nonlinear import IPOPT
from servoctl.gallery import gallery, overhead_crane


def specification(model):
    return model.reduction.mechanism, model.reduction.program


def said(run):
    """What a run's message says of the choice: which inverse and why."""
    return run.message.split("; inverse: ")[1]


HYPERBOLIC = ("vtol-centre", "cart-pole", "fixed-rope-crane")
SINGULAR_LATER = ("appell-hamel-squared", "constant-speed-horizontal")  # these motions end in a singular state


@pytest.mark.parametrize("name", [*KINDS, "cart-pole", "fixed-rope-crane", "flexible-joint", "elastic-link", "hopper"])
def test_every_scene_has_an_inverse_or_an_end(name):
    scene = gallery[name]
    mechanism, program = scene.build()
    span = (0.0, 4.0) if name == "vtol-centre" else scene.t_span
    ends = refused(sv.errors.SingularProgram) if name in SINGULAR_LATER else contextlib.nullcontext()
    swings = warned("marginal", "dx2") if name == "two-cars-ideal" else contextlib.nullcontext()
    with ends, swings:
        run = sv.inverse(mechanism, program, span, start={**scene.guess, **scene.start})
        way = "instant by instant" if name in FLAT else "bounded" if name in HYPERBOLIC else "forward"
        assert said(run).startswith(f"{way}, as the program is ")
        assert run.success and run.internal.get("verdict") != "unstable"
        assert sv.verify(run).passed


def test_a_flat_program_is_solved_instant_by_instant():
    run = sv.inverse(*overhead_crane(), (0.0, 8.0), start={"l": 4.0})
    exact = cf.overhead_crane(run.t)
    assert run.method == "algebraic"
    for name in ("trolley", "hoist"):
        assert run[name] == pytest.approx(exact[name], abs=1e-6)


def test_a_minimum_phase_program_is_integrated_from_its_rest():
    mechanism, program = gallery["mass-on-car"].build()
    run = sv.inverse(mechanism, program, (0.0, 6.0))
    assert "minimum phase" in said(run) and run.start["s"] == pytest.approx(0.0, abs=1e-12)
    exact = cf.mass_on_car(run.t, pi / 4, 1.0)
    assert run["force"] == pytest.approx(exact["force"], abs=1e-5)


@pytest.mark.parametrize(
    ("make", "span", "name", "value"),
    [(lambda: arm(0.5), (0.0, 2.0), "torque", 48.88454), (aircraft, (0.0, 3.0), "u1", 485.9057)],
    ids=["arm", "aircraft"],
)
def test_a_hyperbolic_program_gets_its_bounded_motion(make, span, name, value):
    run = sv.inverse(*specification(make()), span)
    assert run.method == "bounded" and "hyperbolic" in said(run)
    peaks = [v for signal in run.model.actuators for _, v in run.extrema(signal)]
    assert max(peaks) == pytest.approx(value, abs=1e-4)
    assert sv.verify(run).passed


def test_a_flexible_link_of_eight_segments_gets_its_bounded_motion():
    """Its mean angle as output; eigenvalues from the linear equations about the straight link, written down by hand."""
    n, m, l, k, d = 8, 0.1, 0.15, 60.0, 0.05
    mechanism, program = flexible_link(n, m, l, k, d)
    lever = np.maximum(0.0, l * (np.arange(n)[:, None] - np.arange(n) + 0.5))  # of segment i about joint j
    M = m * lever.T @ lever
    onto = np.vstack([-(n - np.arange(1, n)) / n, np.eye(n - 1)])  # joints from the free ones, the mean angle at rest
    inertia = np.linalg.inv(M[1:] @ onto)
    A = np.block([[np.zeros((n - 1, n - 1)), np.eye(n - 1)], [-k * inertia, -d * inertia]])
    report = sv.report(sv.derive(mechanism, program))
    assert report.verdict == "non-minimum phase (hyperbolic)"
    exact = np.sort(np.linalg.eigvals(A).real)
    assert np.sort(report.eigenvalues["start"].real) == pytest.approx(exact, rel=1e-6)

    run = sv.inverse(mechanism, program, (0.0, 2.2))
    assert run.method == "bounded" and run.counters["intervals"] < 2000
    assert sv.verify(run).passed
    assert np.abs([run[f"q{i}"][0] for i in range(n)]).max() < 1e-6


def test_a_program_that_is_singular_at_rest_gets_a_relaxed_plan():
    mechanism, program = crane()
    run = sv.inverse(mechanism, program, (0.0, 6.0))
    assert said(run).startswith("relaxed, as the program is singular at rest")
    target = cf.rest_to_rest(run.t, 0, 0.0, 5.0, 6.0, 4)
    load = run["x"] + 4 * np.sin(run["theta"])
    assert np.abs(load - target).max() < 1e-3 * 5.0
    assert np.abs(run["theta"][[0, -1]]).max() < 1e-9 and np.abs(run["dtheta"][[0, -1]]).max() < 1e-9
    assert np.abs(run["F"]).max() == pytest.approx(132.97, abs=0.1)  # its limit for small weights
    assert np.degrees(np.abs(run["theta"]).max()) < 7.665


def test_a_start_near_a_rest_serves_relaxed_plans_too():
    """A load on an elastic rope, whose rest is stretched by m g/k = 98.1 mm."""
    q = sv.coordinates("x l theta")
    x, l, theta = q
    load = (x + l * ca.sin(theta), -l * ca.cos(theta))
    S = sv.particle(q, 10.0, (x, 0)) + sv.particle(q, 100.0, load)
    V = 981.0 * load[1] + 1e4 * (l - 4.0) ** 2 / 2
    mechanism = sv.Mechanism(q, gibbs=S, potential=V, forces={"l": -200.0 * q.d(1)[1]}, actuators={"F": x})
    program = sv.Program({"X": load[0] - q.references(X=sv.paths.rest_to_rest(0.0, 3.0, 6.0)).X})
    run = sv.inverse(mechanism, program, (0.0, 6.0), start={"l": 4.0})
    assert said(run).startswith("relaxed, as the program is singular at rest")
    assert run["l"][[0, -1]] == pytest.approx(4.0 + 981.0 / 1e4, abs=1e-9)
    assert np.abs(run.residual["X"]).max() < 3e-3 and sv.verify(run).passed


def test_a_marginal_program_is_integrated_forward_and_says_that_it_swings_on():
    """The pole of 0.7 m on a cart that moves by a metre in 2 s: 0.7 a'' = -(g sin a + x'' cos a), by SciPy."""
    with warned("marginal", "goes on", "da = -1.3", "method='relaxed'"):
        run = sv.inverse(*hanging(), (0.0, 2.0))
    assert said(run).startswith("forward, as the program is marginal") and "with da = -1.3" in said(run)
    assert np.abs(run.residual["X"]).max() < 1e-8 and np.abs(run["F"]).max() < 7.0

    def rates(t, y):
        pull = cf.rest_to_rest(np.array([t]), 2, 0.0, 1.0, 2.0, 4)[0]
        return [y[1], -(9.81 * np.sin(y[0]) + pull * np.cos(y[0])) / 0.7]

    other = solve_ivp(rates, (0.0, 2.0), [0.0, 0.0], "DOP853", rtol=1e-10, atol=1e-12)
    assert [run["a"][-1], run["da"][-1]] == pytest.approx(other.y[:, -1].tolist(), abs=1e-7)
    assert sv.verify(run).passed


def test_a_marginal_program_that_comes_to_rest_is_not_warned_about(recwarn):
    """A path of many swings excites none."""
    mechanism, _ = hanging()
    x, _ = mechanism.q
    r = mechanism.q.references(slow=sv.paths.rest_to_rest(0.0, 1.0, duration=20.02, smoothness=4))
    program = sv.Program({"X": x - r.slow})
    run = sv.inverse(mechanism, program, (0.0, 20.02))
    assert said(run).startswith("forward, as the program is marginal") and "goes on" not in run.message
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


def test_a_program_with_unstable_modes_beside_swinging_ones_is_not_integrated_forward():
    q = sv.coordinates("x a b")
    x, a, b = q
    S = sum(sv.particle(q, 1.0, each) for each in q)
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"F": x}, forces={"a": -4.0 * a + x, "b": 9.0 * b + x})
    r = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=4))
    program = sv.Program({"X": x - r.X})
    run = sv.inverse(mechanism, program, (-3.0, 5.0))
    assert said(run).startswith("relaxed, as the program is non-minimum phase (at both ends eigenvalues 3, 0 ± 2i, -3")
    assert "swing on" in said(run) and np.abs(run["F"]).max() < 2.5  # the path alone takes 1.9 N
    assert np.abs(run.residual["X"]).max() < 1e-4 and np.abs(run["b"]).max() == pytest.approx(1 / 9, rel=1e-4)
    t = np.linspace(0.0, 5.0, 8001)  # a'' = x - 4 a from rest
    swing = trapezoid(cf.rest_to_rest(t, 0, 0.0, 1.0, 2.0, 4) * np.sin(2 * (5.0 - t)) / 2, t)
    assert run["a"][-1] == pytest.approx(swing, abs=1e-3)


def test_a_rough_path_gets_a_relaxed_plan():
    mechanism, _ = overhead_crane()
    x, l, theta = mechanism.q
    path = sv.paths.rest_to_rest((0.0, 4.0), (5.0, 2.0), duration=6.0, smoothness=2)
    r = mechanism.q.references(across=path[0], below=path[1])
    program = sv.Program({"X": x + l * ca.sin(theta) - r.across, "Z": l * ca.cos(theta) - r.below})
    assert sv.inverse(mechanism, program, (0.0, 6.0), start={"l": 4.0}).method == "algebraic"  # its end is not passed
    run = sv.inverse(mechanism, program, (0.0, 7.0), start={"l": 4.0})
    assert run.method == "relaxed" and "C^2" in said(run) and "needs 4" in said(run)
    assert np.abs(run.residual["X"][0]).max() < 1e-2


def test_limits_within_which_the_exact_plan_lies_change_nothing():
    run = sv.inverse(*overhead_crane(), (0.0, 8.0), start={"l": 4.0}, limits={"trolley": 140.0}, bounds={"tension": (0, None)})
    assert run.method == "algebraic"


def test_limits_beyond_which_the_exact_plan_lies_give_a_relaxed_one():
    mechanism, program = crane(cart)
    upright = {"start": {"theta": pi}, "t_span": (0.0, 6.0)}
    exact = sv.inverse(mechanism, program, **upright)
    limit = 0.95 * max(abs(value) for _, value in exact.extrema("F"))
    with warned("misses X", "wider limits"):
        run = sv.inverse(mechanism, program, limits={"F": limit}, **upright)
    assert exact.method == "bounded" and run.method == "relaxed" and "the exact plan needs F = " in said(run)
    assert np.abs(run["F"]).max() <= limit * (1 + 1e-7)  # IPOPT widens bounds by 1e-8


def test_growth_along_a_forward_plan_is_not_silent():
    """Beside the driven mass x'' + 0.1 x' + (1 + 0.6 cos 2t) x = 0; an ideal reaction has no other inverse."""
    mechanism, program = specification(mathieu())
    with warned("errors grow by"):
        run = sv.inverse(mechanism, sv.Program(program.residuals, by="ideal"), (0.0, 60.0), start={"x": 1e-3})
    assert "non-minimum phase" in said(run) and run.internal["verdict"] == "unstable"


# plans that miss their program ----------------------------------------------------------------------------------------


def hanging():
    """A cart of 2 kg with a hanging pole of 0.5 kg and 0.7 m; the cart moves by 1 m in 2 s."""
    q = sv.coordinates("x a")
    x, a = q
    S = sv.particle(q, 2.0, (x, 0)) + sv.particle(q, 0.5, (x + 0.7 * ca.sin(a), -0.7 * ca.cos(a)))
    mechanism = sv.Mechanism(q, gibbs=S, potential=-0.5 * 9.81 * 0.7 * ca.cos(a), actuators={"F": x})
    r = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=4))
    return mechanism, sv.Program({"X": x - r.X})


@pytest.mark.parametrize("span, missed", [((-3.0, 5.0), "0.0356")])
def test_a_marginal_plan_that_is_forced_to_rest_says_how_far_it_misses(span, missed):
    """A longer dwell leaves less."""
    with warned(f"misses X by {missed}", "dwell", "swings on"):
        run = sv.inverse(*hanging(), span, method="relaxed")
    assert run.method == "relaxed" and f"misses X by {missed}" in run.message
    assert abs(run["a"][-1]) < 1e-9 and abs(run["da"][-1]) < 1e-9


def test_a_plan_between_rests_of_other_stability_says_how_far_it_misses():
    mechanism, program = beside(lambda x, y, v: -y + (0.5 - y**2) * v - x)
    with warned("misses X by 1.46", "dwell"):
        run = sv.inverse(mechanism, program, (0.0, 2.0))
    assert "non-minimum phase" in said(run)


def test_plans_that_meet_their_program_are_not_warned_about(recwarn):
    sv.inverse(*crane(), (0.0, 6.0))
    mechanism, _ = beside(lambda x, y, v: -y - 0.2 * v - x)
    path = mechanism.q.references(V=sv.paths.rest_to_rest(0.0, 1.0, duration=2.0, smoothness=4)).V
    run = sv.inverse(mechanism, sv.Program({"V": mechanism.q.d(1)[0] - path}), (0.0, 2.0), method="relaxed")
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]
    assert "its end is open" in said(run) and run["dx"][-1] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("k, T", [(2500.0, 6.0)])
def test_an_unstable_program_that_never_rests_gets_a_plan_that_does_not_grow(k, T):
    """y'' = k y + x with x = sin t has the bounded motion y = -sin t/(k + 1), which begins with dy = -1/(k + 1).

    At the end a layer of the unstable mode is left, in which y comes to its quasi-static value -sin t/k.
    """
    mechanism, _ = beside(lambda x, y, v: k * y + x)
    x, _ = mechanism.q
    program = sv.Program({"X": x - ca.sin(mechanism.q.t)})
    run = sv.inverse(mechanism, program, (0.0, T), start={"dy": -1 / (k + 1)})
    assert said(run).startswith("relaxed, as the program is non-minimum phase") and "its end is open" in said(run)
    error = np.abs(run["y"] + np.sin(run.t) / (k + 1))
    layer = np.exp(-np.sqrt(k) * (T - run.t)) / k  # of the quasi-static value's error
    assert np.all(error < 1.5 * layer / k**0.5 + 1e-4 / k)
    assert np.abs(run.residual["X"]).max() < 1e-3 and sv.verify(run).passed


@pytest.mark.parametrize(("k", "start"), [(4.0, {"y": 0.3})])
def test_a_plan_that_begins_in_motion_begins_on_its_bounded_motion(k, start, recwarn):
    """y'' = k y + x from values off it: y = -sin t/(k + 1) + c e^(-√k t), where √k y + y' leaves only c."""
    mechanism, _ = beside(lambda x, y, v: k * y + x)
    program = sv.Program({"X": [*mechanism.q][0] - ca.sin(mechanism.q.t)})
    run = sv.inverse(mechanism, program, (0.0, 6.0), start=start)
    assert "begins on its bounded motion" in run.message and not recwarn.list
    assert np.sqrt(k) * run["y"][0] + run["dy"][0] == pytest.approx(-1 / (k + 1), abs=1e-5 / k)
    c = (np.sqrt(k) * start.get("y", 0.0) - 1 / (k + 1)) / (2 * np.sqrt(k))  # √k y - dy is that of the start
    early = run.t < 6.0 - 8 / np.sqrt(k)
    exact = -np.sin(run.t) / (k + 1) + c * np.exp(-np.sqrt(k) * run.t)
    assert run["y"][early] == pytest.approx(exact[early], abs=1e-3 / k)
    assert np.abs(run.residual["X"]).max() < 1e-3 and sv.verify(run).passed


def sway():
    """An upright pole of 0.2 kg and 0.5 m on a cart of 1 kg that sways by 0.3 m."""
    q = sv.coordinates("x a")
    x, a = q
    S = sv.particle(q, 1.0, (x, 0)) + sv.particle(q, 0.2, (x + 0.5 * ca.sin(a), 0.5 * ca.cos(a)))
    mechanism = sv.Mechanism(q, gibbs=S, potential=0.2 * 9.81 * 0.5 * ca.cos(a), actuators={"F": x})
    return mechanism, sv.Program({"x": x - 0.3 * ca.sin(2 * q.t)})


def test_an_upright_pole_leans_from_the_first_instant_of_a_sway(recwarn):
    """0.5 a'' = g sin a + 1.2 sin 2t cos a: a = -A sin 2t + O(A³) with A = 1.2/(g + 2)."""
    mechanism, program = sway()
    run = sv.inverse(mechanism, program, (0.0, 6.0))
    late = (run.t > 2.0) & (run.t < 4.0)
    assert run["a"][late] == pytest.approx(-1.2 / 11.81 * np.sin(2 * run.t[late]), abs=2e-3)
    assert np.abs(run.residual["x"]).max() < 1e-3 * 0.6 and np.abs(run["F"]).max() < 1.5
    assert not recwarn.list and sv.verify(run).passed


def test_an_upright_pole_falls_along_a_forward_plan_and_has_a_relaxed_one(recwarn):
    """At a speed of 1 + 0.2 sin 3t m/s: 0.5 a'' = g sin a - 0.6 cos 3t cos a, |a| about 0.6/(g + 4.5)."""
    mechanism, _ = sway()
    program = sv.Program({"v": mechanism.q.d(1)[0] - 1 - 0.2 * ca.sin(3 * mechanism.q.t)})
    for choice in ({}, {"method": "relaxed"}):
        run = sv.inverse(mechanism, program, (0.0, 6.0), start={"dx": 1.0}, **choice)
        assert np.abs(run["a"][run.t > 2.0]).max() == pytest.approx(0.6 / 14.31, rel=0.02) and "begins on" in run.message
        assert np.abs(run.residual["v"]).max() < 1e-3 * 0.4 and not recwarn.list
    assert "unstable over these 6 s" in sv.inverse(mechanism, program, (0.0, 6.0), start={"dx": 1.0}).message


def test_a_state_from_which_a_plan_begins_is_kept():
    mechanism, program = sway()
    start = sv.derive(mechanism, program).start(a=0.0, da=0.0)
    with warned("misses x by", "bounded motion"):
        run = sv.inverse(mechanism, program, (0.0, 6.0), start=start)
    assert [run["a"][0], run["da"][0]] == [0.0, 0.0] and "begins on" not in run.message


def test_an_unstable_program_without_a_plan_names_its_verdict(monkeypatch):
    monkeypatch.setitem(IPOPT, "max_wall_time", 1e-3)
    mechanism, _ = beside(lambda x, y, v: 25 * y + x)
    x, _ = mechanism.q
    with refused(sv.errors.IntegrationStopped, "non-minimum phase", "errors grow", verdict="non-minimum phase"):
        sv.inverse(mechanism, sv.Program({"X": x - ca.sin(mechanism.q.t)}), (0.0, 10.0), start={"dy": -1 / 26})


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("name", ["one-sided spring", "Coulomb friction", "a spring that unloads"])
def test_plans_from_a_rest_on_a_kink_are_not_called_stable(name):
    run = sv.inverse(*beside(KINKS[name]), (0.0, 2.0))
    assert "minimum phase" not in said(run) and "on a switch" in said(run)


# a method by hand -----------------------------------------------------------------------------------------------------


def test_a_forward_integration_of_an_unstable_program_is_warned_about_with_its_number():
    mechanism, program = gallery["vtol-centre"].build()
    with warned("DOP853", "hyperbolic", "15.0406", "the bounded motion"):
        run = sv.inverse(mechanism, program, (0.0, 1.0), method="DOP853")
    assert run.method == "DOP853" and run.internal["verdict"] == "unstable"


def test_the_method_of_the_verdict_by_hand_is_not_warned_about(recwarn):
    mechanism, program = gallery["passive-arm"].build()
    sv.inverse(mechanism, program, (0.0, 2.0), method="Taylor")
    sv.inverse(mechanism, program, (0.0, 2.0), method=sv.methods.Bounded())
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


@pytest.mark.usefixtures("c_compiler")
def test_limits_are_compared_with_a_method_by_hand():
    mechanism, program = gallery["passive-arm"].build()
    with warned("RadauIIA", "torque", "the limit is -5"):
        sv.inverse(mechanism, program, (0.0, 2.0), method="RadauIIA", limits={"torque": 5.0})


# refusals -------------------------------------------------------------------------------------------------------------


def test_what_has_no_inverse_is_refused():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={"F": x})
    with refused(sv.errors.NotRealisable, residuals=["x", "y"]):
        sv.inverse(mechanism, sv.Program({"x": x - q.t, "y": y}), (0.0, 1.0))


def test_a_span_that_cuts_a_bounded_motion_short_names_the_one_of_the_path():
    mechanism, program = gallery["vtol-centre"].build()
    with refused(sv.errors.SpecificationError, "(0, 4)", span=(0.0, 1.0)):
        sv.inverse(mechanism, program, (0.0, 1.0))


@pytest.mark.parametrize(
    ("options", "kind"),
    [
        ({"t_span": (1.0, 0.0)}, sv.errors.SpecificationError),
        ({"limits": {"trolly": 1.0}}, sv.errors.NameUnknown),
        ({"limits": {"trolley": -1.0}}, sv.errors.SpecificationError),
        ({"bounds": {"tensions": (0, None)}}, sv.errors.NameUnknown),
        ({"method": "Tailor"}, sv.errors.NameUnknown),
        ({"start": {"rope": 4.0}}, sv.errors.NameUnknown),
        ({"start": "hanging"}, sv.errors.SpecificationError),
        ({"start": {"l": "long"}}, sv.errors.SpecificationError),
        ({"start": arm(0.5).start()}, sv.errors.SpecificationError),
        ({"weight": -1.0}, sv.errors.SpecificationError),
        ({"weight": {"Y": 1.0}}, sv.errors.NameUnknown),
        ({"method": np.ones(3)}, sv.errors.NameUnknown),
        ({"mechanism": None}, sv.errors.SpecificationError),
        ({"program": "path"}, sv.errors.SpecificationError),
    ],
)
def test_bad_arguments_are_refused(options, kind):
    mechanism, program = overhead_crane()
    given = {"mechanism": mechanism, "program": program, "t_span": (0.0, 8.0), "start": {"l": 4.0}}
    with refused(kind):
        sv.inverse(**given | options)


def test_a_program_without_a_start_says_why():
    with refused(sv.errors.InconsistentStart):
        sv.inverse(*gallery["spiral"].build(), (0.0, 1.0))
