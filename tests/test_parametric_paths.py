"""Paths with parameters: their derivatives against differences, and what motions along them make of these."""

import pickle

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from test_design import crane_forces, crane_through
from test_design import curve as spline

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.interop import linearise, nlsys

p = sv.parameters(T=6.0, end=5.0, scale=1.3, begin=0.4, ramp=1.1, when=1.4, via=0.7)


def differences(f, name, numbers, h=1e-4):
    """The derivative of f(numbers) by one of these, by differences of order 4."""
    a, b, c, d = (f(numbers | {name: numbers[name] + k * h}) for k in (-2, -1, 1, 2))
    return (a - 8 * b + 8 * c - d) / (12 * h)


# paths ---------------------------------------------------------------------------------------------------------------

FIXED = sv.paths.spline([0.0, 1.0, 2.5], [0.0, 1.0, 0.5], smoothness=3)
REPEATED = sv.paths.polynomials([0.0, 1.0, 2.0], [[1.0, -1.0], [0.0, 1.0]], before="periodic", after="periodic")
PATHS = {
    "ends and times": sv.paths.rest_to_rest((0.0, 4.0), (p.end, p.scale), p.T, t_start=p.begin),
    "a component": sv.paths.rest_to_rest((0.0, p.scale), (p.end * p.scale, 2.0), p.T * p.scale)[1],
    "trapezoid": sv.paths.trapezoid((p.end, 1.0), 6.0, 1.1, t_start=p.begin),
    "via points": sv.paths.spline([0, 1.4, 3, 6], [[0, 1], [p.via, 1], [1, 2], [2, 3]], smoothness=4).at_rate(6 / p.T),
    "natural": sv.paths.spline([0, 0.3, 0.5, 1], [0, p.via, 1, 2], smoothness=3, ends="natural").at_rate(1 / p.T),
    "sums and multiples": 3.0 - p.scale * sv.paths.rest_to_rest(0.0, 1.0, p.T) + 2 * p.via,
    "a path of numbers": p.scale * FIXED.at_rate(p.ramp) - p.via,
    "another clock": FIXED.at_rate(p.ramp, p.when),
    "repeated": p.scale * REPEATED,
}  # fmt: skip


@pytest.mark.parametrize("what", PATHS)
def test_derivatives_of_paths_are_differences(what):
    """Of value, first and second derivative, inside and outside, beside breaks, where they jump."""
    path = PATHS[what]
    numbers = {name: p.defaults[name] for name in path.names}
    made = path.at(**numbers)
    t = np.linspace(made.breaks[0] - 1.0, made.breaks[-1] + 1.0, 137)
    t = t[np.abs(t[:, None] - made.breaks).min(axis=1) > 1e-2]
    for name, rate in zip(path.names, path.rates(numbers, path.names), strict=True):
        exact = rate.held().jets(t, 2)
        wanted = differences(lambda n: path.at(**n).held().jets(t, 2), name, numbers)
        size = np.abs(made.held().jets(t, 2)).max(axis=(1, 2)) + np.abs(exact).max(axis=(1, 2))
        assert (np.abs(exact - wanted).max(axis=(1, 2)) <= 1e-9 * size).all(), name


def test_a_path_with_parameters_is_a_value():
    path = PATHS["via points"]
    again = sv.paths.spline([0, 1.4, 3, 6], [[0, 1], [p.via, 1], [1, 2], [2, 3]], smoothness=4).at_rate(6 / p.T)
    assert path == again == pickle.loads(pickle.dumps(path)) and path != PATHS["natural"]
    assert (len(path), path.dim, path.names) == (2, 2, ("via", "T")) and "via" in repr(path)
    first, second = path
    numbers = {"T": 5.0, "via": 0.2}
    alone, together = first.at(**numbers)([0.5, 2.0]), path.at(**numbers)([0.5, 2.0])[0]
    np.testing.assert_allclose(alone, together, rtol=1e-14)  # LAPACK may round one right side otherwise than two
    assert second.names == ("T",) and second.at(T=5.0)(5.0) == pytest.approx(3.0, rel=1e-14)
    same = sv.paths.spline(np.array([0, 1.4, 3, 6]) * 5 / 6, [[0, 1], [0.2, 1], [1, 2], [2, 3]], smoothness=4)
    np.testing.assert_allclose(path.at(**numbers)([0.5, 2.0]), same([0.5, 2.0]), rtol=1e-13)


def test_expressions_without_parameters_are_numbers():
    made = sv.paths.rest_to_rest(0.0, ca.SX(2.0), 0.5 * ca.SX(4.0))
    assert made == sv.paths.rest_to_rest(0.0, 2.0, 2.0) and made * ca.SX(3.0) == 3.0 * made
    assert 0 * p.end + made == made


one = sv.paths.rest_to_rest(0.0, p.end, 1.0)
BAD = {
    "no number": (lambda: one.at(), SpecificationError, {"missing": ["end"]}),
    "another name": (lambda: one.at(ende=1.0), NameUnknown, {"match": "end"}),
    "not finite": (lambda: one.at(end=np.nan), SpecificationError, {}),
    "no such path": (lambda: PATHS["another clock"].at(ramp=-1.0, when=1.0), SpecificationError, {"names": ("when", "ramp")}),
    "values": (lambda: one(0.5), SpecificationError, {"names": ("end",)}),
    "jets": (lambda: one.jets(0.5, 2), SpecificationError, {"names": ("end",)}),
    "breaks": (lambda: one.breaks, SpecificationError, {"names": ("end",)}),
    "then": (lambda: one.then(FIXED), SpecificationError, {"names": ("end",)}),
    "a sum of paths": (lambda: one + FIXED, SpecificationError, {}),
    "samples": (lambda: sv.paths.fit(range(7), [0, 1, 2, 3, 4, 5, p.end], tolerance=1.0), SpecificationError, {}),
    "limits": (lambda: sv.paths.s_curve(0.0, 1.0, p.end, 1.0, 1.0), SpecificationError, {"name": "speed"}),
    "polynomials": (lambda: sv.paths.polynomials([0, 1], [[p.end]]), SpecificationError, {}),
    "a class": (lambda: sv.paths.rest_to_rest(0.0, 1.0, 1.0, smoothness=p.end), SpecificationError, {}),
    "a ramp": (lambda: sv.paths.trapezoid(1.0, 2.0, p.ramp), SpecificationError, {"name": "ramp"}),
    "instants": (lambda: sv.paths.spline([0, p.when, p.T], [0, 0.3, 1]), SpecificationError, {}),
    "sizes": (lambda: sv.paths.rest_to_rest((0.0, 1.0), p.end, 1.0), SpecificationError, {}),
    "rows": (lambda: sv.paths.spline([0, 1], [[0, 1], [p.end]]), SpecificationError, {}),
    "a bend": (
        lambda: sv.paths.rest_to_rest(0.0, 1.0, p.T, smoothness=0).rates({"T": 1.0}, ["T"]),
        SpecificationError,
        {"names": ("T",)},
    ),
    "a period": (lambda: REPEATED.at_rate(p.ramp).rates({"ramp": 1.0}, ["ramp"]), SpecificationError, {}),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_is_refused(case):
    ask, kind, details = BAD[case]
    with refused(kind, **details):
        ask()


# motions -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def crane():
    return crane_through()[0]


def moved(model, t_span=(0.0, 6.0), **settings):
    return sv.simulate(model, model.start(guess={"l": 4.0}), t_span, **settings)


def test_forces_of_the_crane_by_the_numbers_of_its_path(crane):
    run = moved(crane)
    s = sv.sensitivity(run, to=["via_x", "via_z", "T"])
    inside = (run.t < 5.9) & (np.abs(run.t - 3.0) > 0.1)  # where a break moves, the highest derivative jumps
    for name in s.to:
        for of in ("trolley", "hoist"):

            def force(numbers, of=of):
                return crane_forces(**numbers, t=run.t)[of]

            wanted = differences(force, name, {"via_x": 2.0, "via_z": 2.5, "T": 6.0}, 1e-3)
            assert np.abs(wanted - s[of, name])[inside].max() < 1e-7 * np.abs(s[of, name]).max(), (of, name)


def test_another_duration_is_followed_without_a_derivation(crane):
    """Breaks and values are those of the path with these numbers, also after another reference was given."""
    for model in (crane.with_parameters(T=5.0, via_x=1.5), pickle.loads(pickle.dumps(crane)).with_parameters(T=5.0, via_x=1.5)):
        assert model.reduction is crane.reduction or model == crane.with_parameters(T=5.0, via_x=1.5)
        assert model.paths["X"].breaks[-1] == 5.0 and model.paths["X"](2.5) == pytest.approx(1.5, rel=1e-14)
        run = moved(model, (0.0, 5.0))
        forces = crane_forces(1.5, 2.5, 5.0, run.t)
        assert np.abs(run["trolley"] - forces["trolley"]).max() < 1e-8 * np.abs(forces["hoist"]).max()
        assert sv.verify(run).passed
    fixed = crane.with_references(X=sv.paths.rest_to_rest(0.0, 1.0, 6.0)).with_parameters(T=5.0)
    assert fixed.paths["X"].breaks[-1] == 6.0 and fixed.paths["Z"].breaks[-1] == 5.0
    with refused(SpecificationError):
        crane.with_parameters(T=-1.0)


def test_arithmetic_on_the_path_of_a_model_keeps_its_parameters(crane):
    """Also components and reflected operations; what cannot keep them is refused."""
    given, fixed = crane.paths["X"], sv.paths.rest_to_rest(0.0, 1.0, 2.0)
    for made in (2 * given, given[0], -given, 1.0 - given, given - 1.0, given + 1.0, given.at_rate(2.0)):
        assert made.names == given.source.names
    other = crane.with_references(X=given[0] * 0.5).with_parameters(T=5.0)
    assert other.paths["X"].breaks[-1] == 5.0 and other.paths["X"](5.0) == pytest.approx(2.5, rel=1e-14)
    for refuse in (lambda: fixed - given, lambda: fixed + given, lambda: given.then(fixed)):
        with refused(SpecificationError):
            refuse()


def test_a_run_is_saved_and_loaded_with_its_path(crane, tmp_path):
    run = moved(crane)
    run.save(tmp_path / "run.npz")
    again = sv.load(tmp_path / "run.npz", crane)
    np.testing.assert_array_equal(sv.sensitivity(again, "trolley", "T")["trolley", "T"], sv.sensitivity(run, "trolley", "T")["trolley", "T"])
    with refused(SpecificationError):
        sv.load(tmp_path / "run.npz", crane.with_parameters(T=5.0))


def test_each_case_follows_its_own_path(crane):
    """As `simulate` does one after the other; where there is no path the case has the error."""
    cases = {"T": [5.0, 6.0, -1.0, 7.0], "via_x": [2.0, 1.0, 2.0, 3.0]}
    many = sv.simulate_many(crane, crane.start(guess={"l": 4.0}), cases, (0.0, 8.0), t_eval=[1.0, 4.0])
    assert [bool(error) for error in many["error"]] == [False, False, True, False]
    for i in (0, 1, 3):
        model = crane.with_parameters(T=cases["T"][i], via_x=cases["via_x"][i])
        run = moved(model, (0.0, 8.0), t_eval=[1.0, 4.0, 8.0])
        np.testing.assert_allclose(many.trace["trolley"][:, i], run["trolley"][:2], atol=1e-9)
        assert many["final x"][i] == pytest.approx(5.0, abs=1e-9)
    paths = {"X": [crane.paths["X"].source, sv.paths.rest_to_rest(0.0, 3.0, 5.0)]}
    both = sv.simulate_many(crane, crane.start(guess={"l": 4.0}), {"T": [5.0, 5.0]}, (0.0, 8.0), paths=paths)
    assert both["final x"] == pytest.approx([5.0, 3.0], abs=1e-9)


def pendulum_on_a_cart(smoothness=4, jumps=False, up=False):
    """The cart goes to `end` in T from `begin` on; the pendulum is free."""
    p = sv.parameters(M=1.0, m=0.1, L=0.5, g=9.81, T=1.0, end=1.0, begin=0.2)
    x, theta = q = sv.coordinates("x theta")
    tip = [x + p.L * ca.sin(theta), (1 if up else -1) * p.L * ca.cos(theta)]
    S = sv.particle(q, p.M, [x, 0]) + sv.particle(q, p.m, tip)
    machine = sv.Mechanism(q, S, p.m * p.g * tip[1], {"force": x}, p)
    r = q.references(X=sv.paths.rest_to_rest(0.0, p.end, p.T, t_start=p.begin, smoothness=smoothness))
    return sv.derive(machine, sv.Program({"X": x - r.X}, jumps=jumps))


def swung(model, t):
    method = sv.methods.Taylor(rtol=1e-13, atol=1e-14)
    return sv.simulate(model, model.start(theta=0.1, dtheta=0.0), (0.0, 2.0), method, t_eval=t)


def balanced(model, t):
    return sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(window=14.0, rtol=1e-11), t_eval=t)


@pytest.mark.parametrize(
    ("options", "motion"),
    [
        ({}, swung),
        ({"smoothness": 2}, swung),
        ({"smoothness": 1, "jumps": True}, swung),  # forces jump at instants that move
        ({"up": True}, balanced),
    ],
)
def test_motions_of_what_is_free_by_the_numbers_of_the_path(options, motion):
    model = pendulum_on_a_cart(**options)
    t = np.linspace(0.0, 1.9, 39) + 0.013
    s = sv.sensitivity(motion(model, t), ["theta", "dtheta", "x", "force"])
    for name in ("T", "end", "begin", "L"):
        for of in s.of:

            def signal(numbers, of=of):
                return motion(model.with_parameters(**numbers), t)[of]

            wanted = differences(signal, name, model.numbers, 1e-3)
            assert np.abs(wanted - s[of, name]).max() < 1e-7 * np.abs(s[of, name]).max() + 1e-10, (of, name)


def test_breaks_that_meet_and_part_with_a_parameter_are_refused():
    """Two forces jump at t = 1; one of the instants moves."""
    p = sv.parameters(T=1.0)
    x, y = q = sv.coordinates("x y")
    off = sv.paths.polynomials([0.0, 1.0, 2.0], [[1.0, 0.0]])
    r = q.references(a=off.at_rate(1 / p.T), b=off)
    plant = sv.plant(sv.Mechanism(q, sv.particle(q, 1.0, (x, y)), forces={"x": r.a, "y": r.b}, parameters=p))
    run = sv.simulate(plant, dict.fromkeys(("x", "y", "dx", "dy"), 0.0), (0.0, 2.0), "DOP853")
    with refused(SpecificationError, t=1.0, name="T"):
        sv.sensitivity(run, "x", "T")
    apart = plant.with_references(b=off.at_rate(1 / 1.5))
    run = sv.simulate(apart, dict.fromkeys(("x", "y", "dx", "dy"), 0.0), (0.0, 2.0), "DOP853")
    s = sv.sensitivity(run, ["x", "y"], "T")
    assert s["x", "T"][-1] == pytest.approx(1.0, abs=1e-8) and np.abs(s["y", "T"]).max() < 1e-12


# plants, and what changes parameters along one path ------------------------------------------------------------------


@pytest.fixture(scope="module")
def supported():
    """A damped pendulum on a support that moves by A in T."""
    p = sv.parameters(m=1.0, L=0.5, g=9.81, T=1.0, A=0.3, d=0.1)
    (theta,) = q = sv.coordinates("theta")
    r = q.references(B=sv.paths.rest_to_rest(0.0, p.A, p.T))
    tip = [r.B + p.L * ca.sin(theta), -p.L * ca.cos(theta)]
    forces = {"theta": -p.d * q.d(1)[0]}
    return sv.Mechanism(q, sv.particle(q, p.m, tip), p.m * p.g * tip[1], {"motor": theta}, p, forces=forces)


def test_a_support_moves_by_the_numbers_of_its_plant(supported):
    plant = sv.plant(supported, T=0.8)
    assert plant.paths["B"].breaks[-1] == 0.8 and pickle.loads(pickle.dumps(plant)) == plant

    def swing(numbers):
        plant = sv.plant(supported, **numbers)
        return sv.simulate(plant, {"theta": 0.2, "dtheta": 0.0}, (0.0, 2.0), sv.methods.Taylor(rtol=1e-13, atol=1e-14), t_eval=T)

    T = np.linspace(0.013, 1.9, 39)
    s = sv.sensitivity(swing({"T": 0.8}), "theta", ["T", "A", "L"])
    for name in s.to:
        wanted = differences(lambda n: swing(n)["theta"], name, {"T": 0.8, "A": 0.3, "L": 0.5}, 1e-3)
        assert np.abs(wanted - s["theta", name]).max() < 1e-7 * np.abs(s["theta", name]).max(), name


def test_parameters_of_paths_that_change_on_the_way_are_refused(supported, crane, tmp_path):
    plant, names = sv.plant(supported), {"name": "B", "names": ["T"]}
    with refused(SpecificationError, **names):
        linearise(plant, 0.5, {"theta": 0.2, "dtheta": 0.0}, disturbed="T")
    system = nlsys(plant)
    rates = system.dynamics(0.5, [0.2, 0.0], [0.0], params=dict(plant.equations.mechanism.parameters.defaults))
    assert np.isfinite(rates).all()
    with refused(SpecificationError, **names):
        system.dynamics(0.5, [0.2, 0.0], [0.0], params=plant.equations.mechanism.parameters.defaults | {"T": 2.0})
    with refused(SpecificationError, name="X", names=["T"]):
        sv.minimum_phase(pendulum_on_a_cart(up=True), "T", (0.5, 1.5))
    with refused(SpecificationError, name="X"):
        sv.export_c(crane, tmp_path)
    numbers = {name: crane.numbers[name] for name in ("via_x", "via_z", "T")}
    fixed = crane.with_references(**{name: path.source.at(**{n: numbers[n] for n in path.source.names}) for name, path in crane.paths.items()})
    assert sv.export_c(fixed, tmp_path)


def test_a_duration_that_is_not_positive_names_the_path_and_its_parameters(crane):
    with refused(SpecificationError, "The path of the reference 'X'", "T = -1", "lasts for -1 s", "Change"):
        crane.with_parameters(T=-1.0)


def test_parameters_that_the_mechanism_does_not_have_are_refused(crane):
    with refused(SpecificationError, name="X", names=["end"]):
        crane.with_references(X=one)
    with refused(SpecificationError, name="X", components=2):
        crane.with_references(X=PATHS["via points"])


def test_closed_form_splines_are_those_of_the_paths():
    """The truth of the crane's forces above."""
    made = PATHS["via points"].at(via=0.7, T=5.0)
    t = np.linspace(0.0, 5.0, 50)
    points = [[0, 1], [0.7, 1], [1, 2], [2, 3]]
    np.testing.assert_allclose(made(t), spline(np.array([0, 1.4, 3, 6]) * 5 / 6, points, 4)(t).T, atol=1e-12)
