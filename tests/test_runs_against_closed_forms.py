"""Runs against motions and forces known in closed form (theory, section 7)."""

import contextlib
from functools import cache, partial

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from conftest import relative
from refusals import warned
from scipy.optimize import brentq, minimize_scalar

import servoctl as sv
from servoctl.gallery import cars, gallery, mass_on_car, passive_arm, spiral, vtol
from servoctl.methods.choice import as_method
from servoctl.model.equations import invariant_names

TIGHT = {"rtol": 1e-12, "atol": 1e-13}


def peak(reference, signal, near, sign):
    """Extremum of a closed form about an instant: its value."""
    found = minimize_scalar(
        lambda t: -sign * float(reference(np.array([t]))[signal][0]),
        bounds=(near - 5e-3, near + 5e-3),
        method="bounded",
        options={"xatol": 1e-10},
    )
    return -sign * found.fun


def internal_poles(model, state):
    """Eigenvalues of the reduced motion about an equilibrium, on the tangent of its invariants."""
    f, invariants, p = model.function("ode"), model.function("invariants"), model.p
    x, n = state.values, len(state.values)
    step = 1e-6 * (1.0 + np.abs(x))
    ends = [[f(state.t, x + s * step[i] * e, p)[:n] for s in (1, -1)] for i, e in enumerate(np.eye(n))]
    matrix = np.array([(a - b) / (2 * h) for (a, b), h in zip(ends, step, strict=True)]).T
    m = len(invariant_names(model))
    jacobian = invariants(state.t, x, p)[m:].reshape(n, m).T
    tangent = np.linalg.svd(jacobian)[2][np.linalg.matrix_rank(jacobian) :].T
    return np.sort_complex(np.linalg.eigvals(tangent.T @ matrix @ tangent))


# spirals -------------------------------------------------------------------------------------------------------------

@cache
def spiral_model(order):
    return sv.derive(*spiral(order))


def spiral_start(order):
    model = spiral_model(order)
    straight = {f"d{k}{axis}": 0.0 for k in range(2, order) for axis in "xy"}
    return model, model.start(x=0.0, y=0.0, dx=1.0, dy=0.0, guess=straight)


@pytest.mark.parametrize(
    ("order", "method"),
    [*((order, sv.methods.Adaptive(rtol=1e-10, atol=1e-12)) for order in (3, 4, 12)), (8, "RK4")],
)
def test_spirals_end_at_one_radian(order, method):
    model, start = spiral_start(order)
    assert model.free == order + 2  # the program's order, and 2 of (3.18)
    with warned("errors grow by") if order >= 8 else contextlib.nullcontext():
        run = sv.simulate(model, start, (0.0, 2.0), method, t_eval=np.linspace(0, 2, 9))
    reference = cf.spiral(run.t, order)
    for name in ("x", "y", "dx", "dy"):
        assert np.max(np.abs(run[name] - reference[name])) < 1e-9
    assert np.arctan2(run["dy"][-1], run["dx"][-1]) == pytest.approx(1.0, abs=1e-9)
    assert np.hypot(run["dx"], run["dy"]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("terms", [13])
def test_spirals_by_series_of_which_every_third_coefficient_is_zero(terms):
    order = 4
    model, start = spiral_start(order)
    run = sv.simulate(model, start, (0.0, 2.0), method=sv.methods.Taylor(order=terms, **TIGHT), t_eval=np.linspace(0, 2, 9))
    reference = cf.spiral(run.t, order)
    assert max(np.max(np.abs(run[name] - reference[name])) for name in ("x", "y", "dx", "dy")) < 1e-9


def test_operations_grow_slowly_with_the_order():
    def count(order):
        return spiral_model(order).function("ode").operations

    assert count(12) <= 8 * count(5)


def test_operations_of_the_programs_derivative_grow_slowly():
    def count(order):
        mechanism, program = spiral(order)
        derivative = mechanism.q.dt(program.residuals["curvature"])
        inputs = ca.symvar(derivative)
        f = ca.Function("f", inputs, [ca.cse(derivative)])
        moves = (ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST)
        return sum(f.instruction_id(i) not in moves for i in range(f.n_instructions()))

    assert count(12) <= 8 * count(5)


# cars ----------------------------------------------------------------------------------------------------------------


def row_of_cars(N):
    return {
        "masses": (1.0,) * (N - 1) + (2.0,),
        "stiffnesses": (1.0,) * (N - 1),
        "gaps": (0.5,) * (N - 1),
        "smoothness": max(6, 2 * N),
    }


@pytest.mark.parametrize("N", [2, 3, 4])
def test_cars_force(N, gallery_model):
    model = gallery_model({2: "two-cars", 3: "three-cars"}[N]) if N < 4 else sv.derive(*cars(N))
    run = sv.simulate(model, model.start(), (0.0, 2.0))
    reference = partial(cf.cars, **row_of_cars(N))
    assert model.flat and run.method == "algebraic" and run.counters.get("nfev", 0) == 0
    assert model.structure().index == 2 * N + 1
    for name, expected in reference(run.t).items():
        assert relative(run[name], expected) < 1e-10
    for sign, (t, value) in zip((-1, 1), run.extrema("force"), strict=True):
        assert value == pytest.approx(peak(reference, "force", t, sign), rel=1e-9)
    printed = {2: (316.175102075, 1.248527), 3: (11774.676981887, 0.762319)}
    if N in printed:
        t, value = run.extrema("force")[1]
        assert value == pytest.approx(printed[N][0], rel=1e-9) and t == pytest.approx(printed[N][1], abs=1e-6)


def test_two_cars_by_an_ideal_reaction_are_another_motion(gallery_model):
    model = gallery_model("two-cars-ideal")
    run = sv.simulate(model, model.start(x2=0.0, dx2=0.0), (0.0, 12.0), sv.methods.Adaptive(**TIGHT))
    t, value = run.extrema("reaction_x1")[1]
    assert value == pytest.approx(6.852059, abs=5e-7) and t == pytest.approx(0.7091, abs=5e-5)
    assert run.extrema("x2")[1][1] - 2.0 == pytest.approx(1.966911, abs=5e-7)
    assert relative(run["x2"], cf.cars_ideal(run.t)["x2"]) < 1e-10
    assert np.abs(run["reaction_x2"]).max() < 1e-12


# cranes --------------------------------------------------------------------------------------------------------------

CRANES = {"overhead-crane": cf.overhead_crane, "winch-crane": cf.winch_crane, "crane-3d": cf.crane_3d}
PRINTED = {
    "overhead-crane": {
        "trolley": (-137.991607, 134.331943),
        "hoist": (-1044.370897, -935.793762),
        "tension": (938.008880, None),
        "theta": (np.deg2rad(-7.1814), np.deg2rad(7.9766)),
    },
    "winch-crane": {
        "trolley": (-35.6165157, 36.0179308),
        "winch": (-102.2085881, -94.1617080),
        "tension": (945.1070630, 1018.2600127),
    },
}


@pytest.fixture(scope="module")
def crane_run(gallery_model):
    runs = {}

    def run(name):
        if name not in runs:
            model = gallery_model(name)
            runs[name] = sv.simulate(model, model.start(guess=gallery[name].guess), (0.0, 6.0))
        return runs[name]

    return run


@pytest.mark.parametrize("coordinates", ["", "-redundant"])
@pytest.mark.parametrize("name", CRANES)
def test_cranes_are_flat_and_follow_their_closed_form(name, coordinates, crane_run):
    run = crane_run(name + coordinates)
    assert run.model.flat and run.model.free == 0 and run.method == "algebraic"
    reference = CRANES[name](run.t)
    compared = [signal for signal in reference if signal in run.names]
    assert len(compared) >= 6
    for signal in compared:
        assert relative(run[signal], reference[signal]) < 1e-8


@pytest.mark.parametrize("name", ["overhead-crane", "winch-crane-redundant"])
def test_the_report_tells_that_cranes_are_flat(name, gallery_model):
    model = gallery_model(name)
    report = repr(model)
    assert "flat: the program determines the whole motion" in report and "hidden constraint" in report
    assert "index 5" in repr(model.structure())


@pytest.mark.parametrize("name", CRANES)
def test_relative_and_redundant_cranes_need_equal_forces(name, crane_run):
    minimal, redundant = crane_run(name), crane_run(f"{name}-redundant")
    for actuator in (*minimal.model.actuators, "tension"):
        assert relative(minimal[actuator], redundant[actuator]) < 1e-8


@pytest.mark.parametrize("coordinates", ["", "-redundant"])
@pytest.mark.parametrize(("name", "signal"), [(name, signal) for name in PRINTED for signal in PRINTED[name]])
def test_extrema_as_printed(name, signal, coordinates, crane_run):
    run = crane_run(name + coordinates)
    if signal == "theta" and coordinates:
        values = np.arcsin((run["X"] - run["x"]) / run["l"])
        found = [values.min(), values.max()]
    else:
        found = [value for _, value in run.extrema(signal)]
    for value, expected in zip(found, PRINTED[name][signal], strict=True):
        assert expected is None or value == pytest.approx(expected, abs=1e-6)


def test_extrema_of_the_winch_crane_come_when_printed(crane_run):
    (t_low, _), (t_high, _) = crane_run("winch-crane").extrema("trolley")
    assert [t_low, t_high] == pytest.approx([3.929903, 2.052399], abs=1e-6)


@pytest.mark.parametrize("name", CRANES)
def test_extrema_are_refined_between_few_samples(name, gallery_model):
    model = gallery_model(name)
    run = sv.simulate(model, model.start(guess=gallery[name].guess), (0.0, 6.0), t_eval=np.linspace(0, 6, 201))
    for actuator in model.actuators:
        for sign, (t, value) in zip((-1, 1), run.extrema(actuator), strict=True):
            assert value == pytest.approx(peak(CRANES[name], actuator, t, sign), rel=1e-6)


# mass on car ---------------------------------------------------------------------------------------------------------

MASS_ON_CAR = [  # alpha, damping, free initial values, index
    (0.0, 0.0, 0, 5),
    (0.0, 1.0, 1, 4),
    (np.pi / 4, 1.0, 2, 3),
    (np.pi / 2, 1.0, 2, 3),
]


@cache
def sliding_mass(alpha, damping, coordinates):
    return sv.derive(*mass_on_car(alpha, damping, coordinates))


def at_rest(model, alpha, coordinates, t=0.0, z=0.5):
    """The equilibrium at which the spring is relaxed."""
    names = {"relative": ("s", "ds"), "absolute": ("y_m", "dy_m") if alpha > 1.5 else ("x", "dx")}[coordinates]
    values = dict(zip(names, (z if names[0] == "x" else 0.0, 0.0), strict=True))
    held = {name: values[name] for name in names[: model.free]}
    return model.start(t, guess={"x": z}, **held)


@pytest.mark.parametrize("coordinates", ["relative", "absolute"])
@pytest.mark.parametrize(("alpha", "damping", "free", "index"), MASS_ON_CAR)
def test_mass_on_car(alpha, damping, free, index, coordinates):
    model = sliding_mass(alpha, damping, coordinates)
    assert model.free == free and model.structure().index == index
    start = at_rest(model, alpha, coordinates)
    run = sv.simulate(model, start, (0.0, 6.0), None if model.flat else sv.methods.Adaptive(**TIGHT))
    reference = cf.mass_on_car(run.t, alpha, damping)
    if coordinates == "absolute":
        along = (run["x_m"] - run["x"]) * np.cos(alpha) + run["y_m"] * np.sin(alpha)
    else:
        along = run["s"]
    assert np.max(np.abs(run["x"] - reference["x"])) < 1e-10
    assert np.max(np.abs(along - reference["s"])) < 1e-10
    assert relative(run["force"], reference["force"]) < 1e-10


@pytest.mark.parametrize("coordinates", ["relative", "absolute"])
@pytest.mark.parametrize(
    ("alpha", "expected"),
    [(0.0, [-5.0]), (np.pi / 4, [-0.5 - 2.17945j, -0.5 + 2.17945j]), (np.pi / 2, [-0.25 - 1.56125j, -0.25 + 1.56125j])],
)
def test_poles_of_the_sliding_mass(alpha, expected, coordinates):
    model = sliding_mass(alpha, 1.0, coordinates)
    found = internal_poles(model, at_rest(model, alpha, coordinates, t=10.0, z=2.5))
    assert found == pytest.approx(np.array(expected), abs=5e-6)
    assert found == pytest.approx(np.sort_complex(cf.mass_on_car_poles(alpha)), abs=1e-7)


# passive-joint arm, VTOL aircraft ------------------------------------------------------------------------------------

LINKS = {"unit": {}, "steel": {"m": 6.875, "l": 1.0, "I": 0.57, "c": 50.0, "d": 0.25}}
CRITICAL = {"unit": 0.4, "steel": 0.3996943899}


@cache
def arm(links, Gamma=0.5):
    return sv.derive(*passive_arm(0.5)).with_parameters(Gamma=Gamma, **LINKS[links])


def arm_poles(links, Gamma):
    model = arm(links, Gamma)
    return internal_poles(model, model.start(t=10.0, q2=0.0, dq2=0.0))


def arm_determinant(links, Gamma, q2):
    """Determinant of the leading matrix at rest."""
    model = arm(links, Gamma)
    x = np.zeros(4)
    x[[model.state_names.index("q1"), model.state_names.index("q2")]] = np.pi / 2 - Gamma * q2, q2
    return np.linalg.det(model.function("matrices")(10.0, x, model.p)[:4].reshape(2, 2))


@pytest.mark.parametrize("links", LINKS)
@pytest.mark.parametrize("Gamma", [0.3, 0.35, 0.45, 0.5])
def test_poles_of_the_passive_arm(Gamma, links):
    steel = {"m": 6.875, "inertia": 0.57} if links == "steel" else {}
    c, d = (50.0, 0.25) if links == "steel" else (10.0, 1.0)
    found = arm_poles(links, Gamma)
    assert found == pytest.approx(np.sort_complex(cf.passive_arm_poles(Gamma, c, d, **steel)), rel=1e-6)
    assert (found.real.max() < 0) == (Gamma < CRITICAL[links])


def test_poles_of_the_steel_arm_as_printed():
    assert arm_poles("steel", 0.5) == pytest.approx([-9.115030, 9.550286], abs=5e-6)


@pytest.mark.parametrize("links", LINKS)
def test_stability_changes_at_the_critical_output(links):
    found = brentq(lambda Gamma: arm_determinant(links, Gamma, 0.0), 0.35, 0.45, xtol=1e-14)
    assert found == pytest.approx(CRITICAL[links], abs=5e-11)
    below, above = (arm_poles(links, CRITICAL[links] + shift).real.max() for shift in (-1e-3, 1e-3))
    assert below < 0 < above


@pytest.mark.parametrize(("links", "degrees"), [("unit", 48.1897), ("steel", 48.254875)])
def test_relative_degree_is_lost_at_an_angle(links, degrees):
    lost = brentq(lambda q2: arm_determinant(links, 0.5, q2), 0.5, 1.2, xtol=1e-14)
    assert np.rad2deg(lost) == pytest.approx(degrees, abs=5e-5 if links == "unit" else 5e-7)


@pytest.mark.parametrize("method", ["DOP853", "Taylor", "RK4"])
def test_the_unstable_arm_stops_where_the_relative_degree_is_lost(method):
    model = arm("unit")
    options = {"step": 1e-3} if method == "RK4" else {}
    with pytest.raises(sv.errors.SingularProgram) as caught:
        sv.simulate(model, model.start(q2=0.0, dq2=0.0), (0.0, 2.0), method=as_method(method, **options))
    run = caught.value.run
    q2 = np.interp(caught.value.details["t"], run.t[-2:], run["q2"][-2:])
    assert abs(np.rad2deg(run["q2"]).max()) < 48.19 and run.t[-1] > 0.3
    assert abs(np.rad2deg(q2)) < 48.3


@pytest.mark.parametrize("method", ["DOP853", "Taylor", "RK4"])
def test_the_critical_arm_is_ill_conditioned_where_it_is_straight(method):
    model = arm("unit", 0.4)
    with pytest.raises(sv.errors.SingularProgram):
        sv.simulate(model, model.start(q2=0.0, dq2=0.0), (0.0, 1.0), method=method)


def test_zero_dynamics_of_the_vtol_centre(gallery_model):
    model = gallery_model("vtol-centre")
    found = internal_poles(model, model.start(t=10.0, theta=0.0, dtheta=0.0))
    assert found == pytest.approx([-15.0405993, 15.0405993], abs=1e-6)


@pytest.mark.parametrize(("shift", "free"), [(0.0, 0), (1e-4, 2), (-1e-4, 2)])
def test_only_the_flat_point_of_the_vtol_is_flat(shift, free):
    mechanism, _ = vtol("centre")
    x, z, theta = mechanism.q
    p = mechanism.parameters
    height = p.J * ca.sin(p.tilt) / (p.M * (p.l * ca.cos(p.tilt) + p.h * ca.sin(p.tilt))) * (1 + shift)
    assert float(ca.substitute(height, ca.vertcat(*p.symbols), p.values())) / (1 + shift) == pytest.approx(
        0.0433649377, abs=5e-11
    )
    path = sv.paths.rest_to_rest((0.0, 0.0), (5.0, 2.0), duration=4.0, smoothness=4)
    r = mechanism.q.references(across=path[0], up=path[1])
    point = ca.vertcat(x - height * ca.sin(theta), z + height * ca.cos(theta))
    model = sv.derive(mechanism, sv.Program({"X": point[0] - r.across, "Z": point[1] - r.up}))
    assert model.free == free


def test_the_flat_vtol_follows_its_closed_form(gallery_model):
    model = gallery_model("vtol")
    run = sv.simulate(model, model.start(), (0.0, 4.0))
    reference = cf.vtol(run.t)
    assert model.flat
    for name in ("x", "z", "theta", "u1", "u2"):
        assert relative(run[name], reference[name]) < 1e-10
