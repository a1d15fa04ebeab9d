"""Units from micrometres to megametres, orders up to 16, poles from far too slow to far too fast."""

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from conftest import pendulum
from refusals import refused
from scenes import KINDS
from units import in_units, scale

import servoctl as sv
from servoctl.gallery import gallery, spiral
from servoctl.methods.accuracy import unlike
from servoctl.methods.choice import as_method

UNITS = (1e-6, 1e6)  # units per metre: megametres to micrometres
LENGTHS = {"a": 1, "b": 1, "rho": 1, "g": 1, "I_x": 2, "I_y": 2}  # of the Appell-Hamel mechanism, by power of length


@pytest.mark.parametrize(
    ("method", "drift", "unit"), [("DOP853", "project", 1e-6), ("Taylor", "project", 1e6), ("RK4", None, 1e-6)]
)
def test_appell_hamel_in_any_unit(method, drift, unit, gallery_model):
    model = gallery_model("appell-hamel")
    names = model.reduction.mechanism.parameters.names
    numbers = dict(zip(names, model.parameters.tolist(), strict=True))
    scaled = model.with_parameters(**{name: numbers[name] * unit**power for name, power in LENGTHS.items()})
    start = scaled.start(x=0.0, y=0.0, z=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=2.0)
    options = {"step": 1e-3} if method == "RK4" else {"rtol": 1e-12, "atol": 1e-14 * min(unit, 1.0)}
    run = sv.simulate(scaled, start, (0.0, 2.0), method=as_method(method, **options), drift=drift, t_eval=[1.0, 2.0])
    reference = cf.appell_hamel(run.t)
    for name in ("x", "y", "z"):
        assert run[name] / unit == pytest.approx(reference[name], abs=1e-9)
    for name in ("phi", "theta", "dphi", "dtheta"):
        assert run[name] == pytest.approx(reference[name], abs=1e-9)


def crane(unit):
    """The overhead crane with lengths in 1/unit metres."""
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81 * unit)
    q = sv.coordinates("x l theta")
    x, l, theta = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    path = sv.paths.rest_to_rest((0.0, 4.0 * unit), (5.0 * unit, 2.0 * unit), duration=6.0, smoothness=4)
    r = q.references(X=path[0], Z=path[1])
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load),
        potential=-p.m_load * p.g * load[1],
        actuators={"trolley": x, "hoist": l},
        parameters=p,
    )
    return sv.derive(mechanism, sv.Program({"X": load[0] - r.X, "Z": load[1] - r.Z}), guess={"l": 4.0 * unit})


@pytest.mark.parametrize("unit", UNITS)
def test_a_crane_in_any_unit(unit):
    model = crane(unit)
    assert model.flat and model.structure().index == 5
    run = sv.simulate(model, model.start(guess={"l": 4.0 * unit}), (0.0, 6.0), t_eval=np.linspace(0.0, 6.0, 61))
    reference = cf.overhead_crane(run.t)
    assert run["theta"] == pytest.approx(reference["theta"], abs=1e-10)
    for name in ("trolley", "hoist"):
        assert run[name] / unit == pytest.approx(reference[name], abs=1e-9 * np.abs(reference[name]).max())


@pytest.mark.parametrize(("unit", "guess"), [(1e-6, True), (1e6, False)])
def test_a_pendulum_goes_round_in_any_unit(unit, guess, c_compiler):
    """Pivots change where the rod passes a horizontal or a vertical, however long it is."""
    model = pendulum(unit, guess)
    assert model.free == 2 and "2 free" in repr(model)
    start = model.start(x=0.0, y=-unit, dx=7.0 * unit)
    reference = pendulum(1.0, guess)
    plain = sv.simulate(
        reference, reference.start(x=0.0, y=-1.0, dx=7.0), (0.0, 2.0), sv.methods.Adaptive(rtol=1e-12, atol=1e-14)
    )
    for method in ("DOP853", "Taylor", "RadauIIA", "RK4"):
        options = {"step": 1e-3} if method == "RK4" else {"rtol": 1e-12, "atol": 1e-14 * unit}
        run = sv.simulate(model, start, (0.0, 2.0), method=as_method(method, **options), t_eval=plain.t)
        assert run.success and run.counters["pivot_changes"] >= 1
        for name in ("x", "y"):
            assert run[name] / unit == pytest.approx(plain[name], abs=1e-7)


def rod(length, guess=None):
    """A point mass on a rod, ideal, in x and y; gravity grows with the length, so that its period is the same."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=9.81 * length * y)
    return sv.derive(mechanism, sv.Program({"rod": x**2 + y**2 - length**2}, by="ideal"), guess=guess)


ROD_STARTS = [{"x": 1.0, "dy": 0.0}, {"x": 1.0, "dy": 0.5}, {"y": 0.0, "dy": 0.0}, {"x": 0.0, "dx": 7.0}]


@pytest.mark.parametrize(("start", "guessed"), [*zip(ROD_STARTS, (False, True, False, True), strict=True)], ids=str)
def test_the_rank_of_a_rod_does_not_depend_on_its_length(start, guessed):
    """Rows of (3.18) hold quotients of pivots, which go to infinity each time the rod is level or upright."""
    ends = []
    for length in (1.0, 1e-3, 1e6):
        model = rod(length, {"y": -length} if guessed else None)
        below = {"x": 0.5 * length, "y": -0.5 * length}
        state = model.start(guess=below, **{name: value * length for name, value in start.items()})
        run = sv.simulate(model, state, (0.0, 3.0), t_eval=[1.354, 3.0])
        energy = (run["dx"] ** 2 + run["dy"] ** 2) / 2 + 9.81 * length * run["y"]
        assert energy[1] == pytest.approx(energy[0], rel=1e-6, abs=1e-6 * length**2)
        ends.append(np.abs([run["x"], run["y"]]) / length)
    for end in ends[1:]:
        assert end == pytest.approx(ends[0], abs=1e-6)


@pytest.mark.parametrize(("method", "length"), [("DOP853", 1e-9), ("LSODA", 1e-6), ("Taylor", 1e6), ("RadauIIA", 1e-9)])
def test_motions_of_any_size_have_the_same_relative_error(method, length):
    """At the defaults: absolute tolerances follow the size of the motion."""
    runs = []
    for unit in (1.0, length):
        model = rod(unit, {"y": -unit})
        start = model.start(x=0.6 * unit, dy=0.0, guess={"y": -0.8 * unit})
        runs.append(sv.simulate(model, start, (0.0, 3.0), method, t_eval=np.linspace(0.0, 3.0, 31))["x"] / unit)
    assert runs[1] == pytest.approx(runs[0], abs=1e-7)


def test_an_absolute_tolerance_of_the_user_is_kept():
    model = rod(1e-9, {"y": -1e-9})
    start = model.start(x=0.6e-9, dy=0.0, guess={"y": -0.8e-9})
    loose, default = (sv.simulate(model, start, (0.0, 3.0), sv.methods.Adaptive(atol=atol)) for atol in (1e-11, None))
    assert loose.counters["steps"] < default.counters["steps"]


def chained(target):
    """A cart that pulls a mass by a spring; the mass follows a path."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 2.0, (x,)) + sv.particle(q, 1.0, (y,)), potential=50.0 * (x - y) ** 2 / 2,
        forces={"y": -3.0 * q.dt(y)}, actuators={"force": x},
    )  # fmt: skip
    return mechanism, sv.Program({"y": y - target(q)})


def fixed_path():
    return chained(lambda q: q.references(y=sv.paths.rest_to_rest(0.0, 1.0, duration=3.0, smoothness=4)).y)


def oscillator():
    return chained(lambda q: 0.3 * ca.sin(2.0 * q.t))


SCALES = [(1e6, 1e3, 1.0), (1e-6, 1e-3, 1.0), (1.0, 1.0, 1e-6), (1.0, 1.0, 1e6)]  # units per metre, kilogram and second
# Pivots are chosen again at these states, with speeds of 1e-6 or at rest, and fail: refused, not wrong.
REFUSED = {("spiral", 1e-6, 1e-3, 1.0), ("spiral", 1.0, 1.0, 1e6)}


@pytest.mark.parametrize("name", [*KINDS, "hopper", "reaction-wheels", "trailers"])
@pytest.mark.usefixtures("uncompiled")
def test_a_scene_moves_alike_in_any_unit(name):
    """From micrometres to megametres, grams to tonnes, microseconds to megaseconds, along the whole motion."""
    scene = gallery[name]
    mechanism, program = scene.build()
    q = mechanism.q

    def moved(length, mass, time):
        guess, span = scaled(scene.guess, length, time), tuple(time * s for s in scene.t_span)
        changed = sv.derive(*in_units(mechanism, program, mechanism.units, length, mass, time), guess=guess)
        start = changed.start(span[0], guess=guess, **scaled(scene.start, length, time))
        return sv.simulate(changed, start, span, t_eval=np.linspace(*span, 51))

    def ended(*units):  # some scenes end by design
        try:
            return moved(*units)
        except sv.errors.SingularProgram as error:
            return error.run

    def scaled(values, length, time):
        return {key: value * scale(key, q, mechanism.units, length, time) for key, value in values.items()}

    reference = ended(1.0, 1.0, 1.0)
    for length, mass, time in SCALES:
        if (name, length, mass, time) in REFUSED:
            with pytest.raises(sv.errors.ServoError):
                moved(length, mass, time)
            continue
        run = ended(length, mass, time)
        assert abs(len(run.t) - len(reference.t)) <= 1, (length, mass, time)
        count = min(len(run.t), len(reference.t)) - (not reference.success)  # the last sample is next to the stop
        for key in q.names:
            expected = reference[key][:count]
            found = run[key][:count] / scale(key, q, mechanism.units, length, time)
            limit = 1e-6 * max(np.abs(expected).max(), 1e-3)
            assert found == pytest.approx(expected, abs=limit), (key, length, mass, time)


@pytest.mark.parametrize("method", [None, sv.methods.Taylor(atol=1e-11)], ids=["default", "atol"])
@pytest.mark.parametrize("offset", [1e3, 1e6])
def test_a_vehicle_far_from_the_origin_turns_as_at_it(offset, method, gallery_model):
    """Trailers along a curvature: the equations do not know where they are."""
    model, t = gallery_model("trailers"), np.linspace(0.0, 4.0, 21)
    near, far = ({"X": d, "Y": -d, "theta1": 0.0, "theta2": 0.0} for d in (0.0, offset))
    runs = [sv.simulate(model, model.start(**start), (0.0, 4.0), method, t_eval=t) for start in (near, far)]
    for name, moved in {"X": offset, "Y": -offset, "theta0": 0.0, "theta1": 0.0, "theta2": 0.0}.items():
        assert runs[1][name] - moved == pytest.approx(runs[0][name], abs=1e-6), name
    many = sv.simulate_many(model, far, None, (0.0, 4.0), t_eval=t)
    assert many.trace["theta1"][:, 0] == pytest.approx(runs[0]["theta1"], abs=1e-6)


def test_the_rounding_of_a_coordinate_at_rest_is_no_small_motion():
    levels, sizes = np.array([0, 0]), np.ones(2)
    assert unlike(levels, np.array([1.0, 1e-5]), sizes) and not unlike(levels, np.array([1.0, 1e-11]), sizes)
    assert unlike(levels, np.array([1.0, 1e-11]), np.array([1.0, 1e-11])) and not unlike(levels, np.array([1.0, 0.0]), sizes)


@pytest.mark.parametrize(("length", "time"), [(1e6, 1.0), (1e6, 1e6), (1e-6, 1e-6), (1e-6, 1.0)])
def test_sizes_of_jets_are_found_from_the_specification(length, time):
    """Of a crane in micrometres and in megametres, with the guessed length of its rope; in SI all are ordinary."""
    scene = gallery["overhead-crane"]
    mechanism, program = scene.build()
    assert sv.derive(mechanism, program, guess={"l": 4.0}).reduction.context.scales is None
    other = in_units(mechanism, program, mechanism.units, length, 1.0, time)
    found = sv.derive(*other, guess={"l": 4.0 * length}).reduction.context.scales
    expected = np.array([length, length, 1.0, time])
    assert np.abs(np.log10([*found.coordinates, found.time] / expected)).max() < 2


@pytest.mark.parametrize("time", [1e-6, 1e-3, 1e3, 1e6])
@pytest.mark.parametrize("build", [fixed_path, oscillator], ids=["path", "sine"])
def test_the_reduction_is_the_same_in_any_unit_of_time(build, time):
    mechanism, program = build()
    units = dict.fromkeys(mechanism.q.names, "m")
    plain, other = sv.derive(mechanism, program), sv.derive(*in_units(mechanism, program, units, 1.0, 1.0, time))
    assert other.free == plain.free and [r.order for r in other.reduction.rows] == [r.order for r in plain.reduction.rows]


@pytest.mark.parametrize(("length", "mass"), [(1e-6, 1.0), (1e-3, 1e-9), (1e6, 1e3)])
def test_the_size_of_a_balance_decides_nothing(length, mass):
    """All coordinates are angles; the torques, and with them the rows of the balance, are 1e-15 to 1e15 times SI's."""
    mechanism, program = gallery["flexible-joint"].build()
    plain = sv.derive(mechanism, program)
    other = sv.derive(*in_units(mechanism, program, mechanism.units, length, mass))
    assert [(r.derivation, r.order) for r in other.reduction.rows] == [(r.derivation, r.order) for r in plain.reduction.rows]
    x = plain.start(t=0.4).values
    assert other.start(t=0.4).values == pytest.approx(x, abs=1e-9 * np.abs(x).max())


@pytest.mark.parametrize("unit", [1e-6, 1.0])
@pytest.mark.parametrize("square", [False, True])
def test_a_squared_constraint_is_told_from_a_small_one(square, unit):
    q = sv.coordinates("x y")
    x, y = q
    circle = x**2 + y**2 - unit**2
    program = sv.Program({"circle": circle**2 if square else circle}, by="ideal")
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)))
    if square:
        with refused(sv.errors.SingularProgram, row="circle"):
            sv.derive(mechanism, program)
    else:
        assert sv.derive(mechanism, program).free == 2


# orders --------------------------------------------------------------------------------------------------------------


def test_a_spiral_of_order_16():
    model = sv.derive(*spiral(16))
    straight = {f"d{k}{axis}": 0.0 for k in range(2, 16) for axis in "xy"}
    start = model.start(x=0.0, y=0.0, dx=1.0, dy=0.0, guess=straight)
    assert model.free == 18
    run = sv.simulate(model, start, (0.0, 2.0), sv.methods.Adaptive(rtol=1e-7, atol=1e-9), t_eval=np.linspace(0, 2, 9))
    reference = cf.spiral(run.t, 16)
    for name in ("x", "y", "dx", "dy"):
        assert np.abs(run[name] - reference[name]).max() < 1e-7


# poles ---------------------------------------------------------------------------------------------------------------

STEP = 1e-2  # s


@pytest.mark.parametrize("speed", [0.01, 0.1, 1.0, 2.5])
def test_poles_within_the_stability_of_rk4_keep_the_motion(speed, gallery_model):
    model = gallery_model("appell-hamel")
    start = model.start(x=0.0, y=0.0, z=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=2.0)
    run = sv.simulate(model, start, (0.0, 2.0), method=sv.methods.RungeKutta(4, step=STEP), drift=sv.methods.Poles(STEP / speed))
    assert np.abs(run["theta"] - cf.appell_hamel(run.t)["theta"]).max() < 1e-6
    assert np.abs(run.residual["string"][0]).max() < 1e-6


@pytest.mark.filterwarnings("ignore")  # the warning is another test's
@pytest.mark.parametrize("speed", [3.0, 10.0, 1e2, 1e4])
def test_poles_beyond_it_are_told(speed, gallery_model):
    model = gallery_model("appell-hamel")
    start = model.start(x=0.0, y=0.0, z=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=2.0)
    with pytest.raises(sv.errors.ServoError) as caught:
        sv.simulate(model, start, (0.0, 10.0), method=sv.methods.RungeKutta(4, step=STEP), drift=sv.methods.Poles(STEP / speed))
    assert "poles" in str(caught.value)


@pytest.mark.parametrize("speed", [1e4])
def test_an_implicit_method_bears_any_poles(speed, gallery_model):
    model = gallery_model("appell-hamel")
    start = model.start(x=0.0, y=0.0, z=0.0, phi=0.0, theta=0.0, dphi=1.0, dtheta=2.0)
    run = sv.simulate(
        model,
        start,
        (0.0, 2.0),
        method=sv.methods.Adaptive("Radau", rtol=1e-8, atol=1e-10),
        drift=sv.methods.Poles(STEP / speed),
        t_eval=[1.0, 2.0],
    )
    assert run["theta"] == pytest.approx(cf.appell_hamel(run.t)["theta"], abs=1e-6)
    assert np.abs(run.residual["string"][0]).max() < 1e-12
