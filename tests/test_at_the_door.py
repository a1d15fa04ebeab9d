"""Plans and laws at the door: starts, edges of disturbances, quadratures, orders of optima, numbers that are none."""

import itertools

import casadi as ca
import numpy as np
import pytest
from conftest import needs
from numpy.polynomial import Polynomial
from refusals import refused
from scipy.special import ellipj
from test_export_c import Exported

import servoctl as sv
from servoctl.checks import column, matrix
from servoctl.export.c import export_c
from servoctl.gallery import gallery
from servoctl.inversion.verdict import verdict

# a projected start ----------------------------------------------------------------------------------------------------

G = 9.81  # m/s^2


@pytest.fixture(scope="module")
def pendulum():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, ca.vertcat(x, y)), potential=G * y)
    return sv.derive(mechanism, sv.Program({"rod": x**2 + y**2 - 1}, by="ideal"))


def swinging(angle, t):
    """The place x [m] of a pendulum of 1 m released at rest, in closed form."""
    k = np.sin(angle / 2)
    _, cn, dn, _ = ellipj(np.sqrt(G) * t, k**2)
    half = k * cn / dn
    return 2 * half * np.sqrt(1 - half**2)


STARTS = {  # x, y, x', y' off the circle; the issue's two places, and two more
    "near": (0.6, -0.81, 0.0, 0.0),
    "far": (0.6, -1.6, 0.0, 0.0),
    "inside": (0.3, -0.4, 0.0, 0.0),
    "along the rod": (0.6, -0.8, 0.3, -0.4),
}


@pytest.mark.parametrize("method", [None, "Taylor", "RadauIIA", "DOP853", "Radau", "RK4"])
@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS)
def test_projection_begins_with_the_start(start, method, pendulum):
    run = sv.simulate(pendulum, start, (0.0, 1.0), method, drift="project", t_eval=[0.0, 1.0])
    on_circle = np.array(start[:2]) / np.hypot(*start[:2])
    assert np.abs([run["x"][0] - on_circle[0], run["y"][0] - on_circle[1], run["dx"][0], run["dy"][0]]).max() < 1e-15
    assert (run.start.values == run.jets[:4, 0]).all()
    assert run["x"][-1] == pytest.approx(swinging(np.arctan2(start[0], -start[1]), 1.0), abs=1e-8)


def test_the_least_change_of_a_start_is_that_of_its_masses():
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, x) + sv.particle(q, 3.0, y), potential=-8.0 * x)
    model = sv.derive(mechanism, sv.Program({"together": x - y}, by="ideal"))
    run = sv.simulate(model, [0.0, 1.0, 2.0, 0.0], (0.0, 2.0), drift="project")
    assert [run["x"][0], run["dy"][0]] == pytest.approx([0.75, 0.5], abs=1e-15)  # the centre and its velocity
    assert run["y"][-1] == pytest.approx(0.75 + 0.5 * 2 + 8 / 4 * 2, abs=1e-9)


def test_a_start_that_projection_does_not_bring_to_the_constraint_is_refused(pendulum):
    with refused(sv.errors.InconsistentStart, "model.start", invariant="rod"):
        sv.simulate(pendulum, [0.0, 0.0, 0.0, 0.0], (0.0, 1.0), drift="project")


# edges of disturbances -----------------------------------------------------------------------------------------------

MASS, FREE, SPAN = 10.0, sv.coordinates("x"), 2.0  # kg; m; s


@pytest.fixture(scope="module")
def free():
    """A mass on a rail, and a law that lets go of it."""
    (x,) = FREE
    mechanism = sv.Mechanism(FREE, sv.particle(FREE, MASS, x), actuators={"F": x})
    model, plant = sv.derive(mechanism, sv.Program({"rest": x}, by="actuators")), sv.plant(mechanism)
    return plant, sv.feedforward(sv.simulate(model, model.start(), (0.0, SPAN)), plant)


def told(f, **what):
    """A function that says what integration must know of it."""
    vars(f).update(what)
    return f


def noisy(std, bandwidth, seed):
    """The disturbance, and the impulse of its harmonics, in closed form."""
    force, random = sv.disturbances.noise(std, bandwidth, seed), np.random.default_rng(seed)
    f = (np.arange(64) + random.uniform(size=64)) * bandwidth / 64
    phase = random.uniform(0, 2 * np.pi, 64)
    swings = (np.sin(2 * np.pi * f * SPAN + phase) - np.sin(phase)) / (2 * np.pi * f)
    return force, std * np.sqrt(2 / 64) * swings.sum()


GUST, STEP = sv.disturbances.gust, sv.disturbances.step
PUSHES = {  # force, its impulse [N s]; the issue's gust at eight instants, and others
    **{f"gust at {t0}": (GUST(2000.0, t0, t0 + 2e-3), 4.0) for t0 in (1.0, 1.001, 1.0033, 1.0055, 1.006, 1.0099, 0.0)},
    "gust to the end": (GUST(2000.0, SPAN - 3e-3, SPAN + 3.0), 6.0),
    "smooth gust": (GUST(2000.0, 1.0031, 1.0051, rise=1e-3), 2.0),
    "ramps over samples": (GUST(50.0, 0.5037, 1.1111, rise=0.2003), 50.0 * (1.1111 - 0.5037 - 0.2003)),
    "step": (STEP(100.0, 0.7137), 100.0 * (SPAN - 0.7137)),
    "own pulse": (told(lambda t: 2000.0 * (1.0033 < t < 1.0053), edges=(1.0033, 1.0053)), 4.0),
    "own bump": (told(lambda t: 2e3 * np.exp(-(((t - 1.0033) / 4e-4) ** 2)), longest=2e-4), 0.8 * np.sqrt(np.pi)),
    "fast noise": noisy(50.0, 500.0, 3),
}


@pytest.mark.parametrize("name", PUSHES)
def test_a_push_has_its_impulse_wherever_it_lies(name, free, backend):
    (plant, law), (force, impulse) = free, PUSHES[name]
    loop = sv.close(plant, law, {"x": 0.0, "dx": 0.0}, (0.0, SPAN), disturbance={"x": force})
    size = {"fast noise": 1e-5}.get(name, 1e-9)  # by Simpson's rule
    assert loop["dx"][-1] * MASS == pytest.approx(impulse, abs=size * max(1.0, abs(impulse)))
    many = sv.close_many(loop, {"wind": [1.0, -0.5]}, scale={"x": "wind"})
    assert many["final dx"] * MASS == pytest.approx([impulse, -impulse / 2], abs=size * max(1.0, abs(impulse)))
    assert sv.verify(loop).passed


def test_a_push_has_its_impulse_in_mujoco(free):
    mujoco = needs("mujoco")
    scene = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>'
        '<geom size="0.1" mass="10"/></body></worldbody><actuator><motor name="F" joint="x"/></actuator></mujoco>'
    )
    plant, law = free
    push = {"x": GUST(2000.0, 1.0033, 1.0053)}
    loop = sv.interop.mujoco(scene, law, {"x": 0.0, "dx": 0.0}, (0.0, SPAN), plant=plant, disturbance=push)
    assert loop["dx"][-1] == pytest.approx(0.4, abs=1e-9)
    assert scene.opt.timestep == 0.01


# numbers that are none -----------------------------------------------------------------------------------------------

COMPLEX = [2 + 3j, np.complex64(2 + 3j), np.complex128(2), np.clongdouble(2 + 3j), np.array(2 + 3j, np.complex64)]
(X,) = FREE
DOORS = {
    "parameter": lambda v: sv.parameters(m=v),
    "mass": lambda v: sv.particle(FREE, v, X),
    "potential": lambda v: sv.Mechanism(FREE, sv.particle(FREE, 1.0, X), potential=v),
    "gibbs": lambda v: sv.Mechanism(FREE, v),
    "residual": lambda v: sv.Program({"X": X - FREE.t, "Y": v}),
    "slowed program": lambda v: sv.Program({"X": X - FREE.t}).slowed(FREE, v),
    "path": lambda v: sv.paths.rest_to_rest(0.0, v, 1.0),
    "points of a path": lambda v: sv.paths.spline([0.0, 1.0, 2.0], [0.0, v, 1.0]),
    "gust": lambda v: GUST(v, 0.0, 1.0),
    "rate": lambda v: sv.Timing(rate=v),
    "tolerance": lambda v: sv.methods.Taylor(rtol=v),
    "axes of a circle": lambda v: sv.curves.circle(FREE.t, (0.0, 0.0), 1.0, axes=v),
}


@pytest.mark.parametrize("value", COMPLEX, ids=lambda v: type(v).__name__)
@pytest.mark.parametrize("door", DOORS)
def test_a_complex_number_is_refused(door, value):
    with pytest.raises(sv.errors.SpecificationError):
        DOORS[door](value)


@pytest.mark.parametrize("kind", [np.longdouble, np.float16, np.int8])
def test_numbers_of_numpy_are_those_of_python(kind):
    """CasADi has no place for those that are longer than doubles."""
    array = np.array([0, 2], kind)
    for value in (kind(2), array[1:], [kind(2)]):
        assert [float(entry) for entry in column(value, "it")] == [2.0]
    assert np.array_equal(ca.DM(matrix([list(array), list(array)], "it")), [[0, 2], [0, 2]])


@pytest.mark.parametrize("name", ["overhead-crane", "passive-arm", "vtol-centre"])  # by Newton, by states
def test_exported_c_answers_numbers_or_its_error(name, gallery_model, tmp_path, c_compiler):
    scene, model = gallery[name], gallery_model(name)
    start, answered = model.start(**scene.start, guess=scene.guess), []
    plan = Exported(export_c(model, tmp_path, name="plan", start=start), "plan")
    for k in range(len(model.parameters)):
        for bad in (np.nan, np.inf):
            x, p = start.values.copy(), model.parameters.copy()
            p[k] = bad
            z, u = np.full(len(model.jet_names), 7.0), np.full(len(model.actuators), 7.0)
            code = plan("feedforward", start.t, x, p, z, u)
            answered.append(code)
            assert np.isfinite(z).all() and np.isfinite(u).all()
            assert code >= 0 or set(z) == {7.0} and set(u) == {7.0}
            if not model.flat:
                assert plan("advance", start.t, 0.01, x, p) in (0, -1) and np.isfinite(x).all()
    assert -1 in answered


# integrals of a program ----------------------------------------------------------------------------------------------


def cart_and_pole(by, damping=0.0):
    """The tutorial's machine, programmed by its place, by its speed, or by the speed of the bob."""
    p, q = sv.parameters(M=2.0, m=0.5, L=0.6, g=G), sv.coordinates("x theta")
    (x, theta), (dx, _) = q, q.d(1)
    bob = ca.vertcat(x + p.L * ca.sin(theta), p.L * ca.cos(theta))
    mechanism = sv.Mechanism(
        q, sv.particle(q, p.M, x) + sv.particle(q, p.m, bob), potential=p.m * p.g * bob[1], actuators={"F": x},
        forces={"x": -damping * dx}, parameters=p,
    )  # fmt: skip
    r = q.references(path=sv.paths.rest_to_rest(0.0, 1.0, 1.5, smoothness=4))
    residual = {"place": x - r.path, "speed": dx - r.d(1)[0]}
    return mechanism, sv.Program(residual if by is None else {by: residual[by]})


@pytest.mark.parametrize("damping", [0.0, 3.0])
def test_a_program_of_a_speed_has_the_inverse_of_its_place(damping):
    place, speed = (sv.inverse(*cart_and_pole(by, damping), (0.0, 1.5)) for by in ("place", "speed"))
    assert "inverse: bounded" in speed.message and "0 is the constant of x" in speed.message
    assert damping or np.abs(place["F"]).max() == pytest.approx(9.28, abs=5e-3)  # N, of the tutorial
    for name in ("F", "x", "theta"):
        assert np.abs(speed[name] - place[name]).max() < 1e-9 * np.abs(place[name]).max()
    assert sv.verify(speed).passed
    slopes = [sv.sensitivity(run, ("F", "theta"), ("m", "L")) for run in (speed, place)]
    for pair in itertools.product(("F", "theta"), ("m", "L")):
        assert np.abs(slopes[0][pair] - slopes[1][pair]).max() < 1e-8 * (0.01 + np.abs(slopes[1][pair]).max())


@pytest.mark.parametrize("damping", [0.0, 3.0])
def test_a_cart_whose_speed_goes_on_has_the_inverse_of_its_place(damping):
    """From rest to 1 m/s: the place is the integral of the speed, 126 u⁵ - 420 u⁶ + 540 u⁷ - 315 u⁸ + 70 u⁹."""
    mechanism, _ = cart_and_pole("speed", damping)
    (x, _), (dx, _) = mechanism.q, mechanism.q.d(1)
    rising = [1.5 * c / 1.5**k for k, c in zip(range(10, 5, -1), (7.0, -35.0, 67.5, -60.0, 21.0), strict=True)]
    place = sv.paths.polynomials(
        [0.0, 1.5, 3.0], np.transpose([rising + 6 * [0.0], 9 * [0.0] + [1.0, 0.75]]), after="continue"
    )
    r = mechanism.q.references(along=place, rate=sv.paths.rest_to_rest(0.0, 1.0, 1.5, smoothness=4))
    residuals = {"place": x - r.along, "speed": dx - r.rate}
    place, speed = (sv.inverse(mechanism, sv.Program({by: e}), (0.0, 1.5)) for by, e in residuals.items())
    assert "inverse: bounded" in speed.message and "0 is the constant of x" in speed.message
    for name in ("F", "x", "theta"):
        assert np.abs(speed[name] - place[name]).max() < 1e-9 * np.abs(place[name]).max()
    assert sv.verify(speed).passed


def segway(by):
    """Two wheels of 0.25 m that roll without slipping, and a body that stands on their axle."""
    q = sv.coordinates("x y psi a left right")
    (x, y, psi, a, left, right), (dx, dy, dpsi, _, dleft, dright) = q, q.d(1)
    forward, side = ca.vertcat(ca.cos(psi), ca.sin(psi), 0), ca.vertcat(-ca.sin(psi), ca.cos(psi), 0)
    axle = ca.vertcat(x, y, 0.25)
    body = axle + 0.7 * ca.sin(a) * forward + ca.vertcat(0, 0, 0.7 * ca.cos(a))
    spins = 0.75 * q.d(2)[2] ** 2 + 0.03 * (q.d(2)[4] ** 2 + q.d(2)[5] ** 2)
    v = dx * ca.cos(psi) + dy * ca.sin(psi)
    rolling = {"l": v - 0.3 * dpsi - 0.25 * dleft, "r": v + 0.3 * dpsi - 0.25 * dright}
    mechanism = sv.Mechanism(
        q, spins + sv.particle(q, 30.0, body) + sum(sv.particle(q, 2.0, axle + s * side) for s in (-0.3, 0.3)),
        potential=30.0 * G * body[2], constraints={"slide": dy * ca.cos(psi) - dx * ca.sin(psi), **rolling},
        actuators={"L": left - a, "R": right - a},
    )  # fmt: skip
    path = sv.paths.rest_to_rest((0.0, 0.0), (3.0, 1.2), 3.0, smoothness=5)
    r = q.references(along=path[0], turn=path[1])
    heading = {"heading": psi - r.turn} if by == "heading" else {"rate": dpsi - r.d(1)[1]}
    return mechanism, sv.Program({"speed": v - r.d(1)[0], **heading})


def test_a_segway_by_its_speed_and_its_rate_of_turn_stays_upright_and_exact():
    heading, speed = (sv.inverse(*segway(by), (0.0, 3.0)) for by in ("heading", "rate"))
    assert "inverse: bounded" in speed.message and "constant of x, y, psi, left, right" in speed.message
    for name in ("L", "R", "a", "x", "y", "psi"):
        assert np.abs(speed[name] - heading[name]).max() < 1e-8 * np.abs(heading[name]).max()
    way = 3.0 * np.array([np.sin(1.2), 1.0 - np.cos(1.2)]) / 1.2  # as both follow the same blend
    assert [speed["x"][-1], speed["y"][-1]] == pytest.approx(way, abs=1e-9)
    assert sv.verify(speed).passed


@pytest.mark.parametrize(("gravity", "word"), [(G, "non-minimum phase (hyperbolic)"), (-G, "marginal")])
def test_what_depends_on_nothing_leaves_the_splitting_alone(gravity, word):
    """A pole on a cart by the cart's speed; hanging it swings, on the imaginary axis."""
    mechanism, program = cart_and_pole("speed")
    hanging = sv.derive(mechanism, program).with_parameters(g=gravity)
    assert verdict(hanging).word == word


def test_an_angle_that_matters_in_motion_is_no_integral():
    """A free link in the horizontal plane: at rest its angle is an eigenvalue 0, along the path its rates depend on it."""
    q = sv.coordinates("x theta")
    x, theta = q
    tip = ca.vertcat(x + ca.cos(theta), ca.sin(theta))
    mechanism = sv.Mechanism(q, sv.particle(q, 2.0, x) + sv.particle(q, 1.0, tip), actuators={"F": x})
    path = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, 1.5, smoothness=4)).X
    found = verdict(sv.derive(mechanism, sv.Program({"X": x - path})))
    assert found.word == "marginal" and "constant" not in found.reason


# minima of second order ----------------------------------------------------------------------------------------------


def over_a_hill(v, ranges, centre=0.5, **options):
    """A point that moves along a line over a hill, or around it by a bow v."""
    p, q = sv.parameters(v=v), sv.coordinates("x y")
    x, y = q
    s = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, 2.0, smoothness=4)).s
    mechanism = sv.Mechanism(
        q, sv.particle(q, 1.0, ca.vertcat(x, y)), potential=30 * ca.exp(-((x - centre) ** 2 + y**2) / 0.02),
        actuators={"F": x, "G": y}, parameters=p,
    )  # fmt: skip
    model = sv.derive(mechanism, sv.Program({"X": x - s, "Y": y - p.v * 16 * s**2 * (1 - s) ** 2}))
    return sv.design(model, {"v": ranges}, (0.0, 2.0), **options)


def least_over_a_hill(ranges, centre=0.5, minimise="rms", **_):
    """The least cost on a grid of v, from the path's own formula."""
    t, v = np.linspace(0.0, 2.0, 2001), np.linspace(*ranges, 401)[:, None]
    s = Polynomial([0.0] * 5 + [126.0, -420.0, 540.0, -315.0, 70.0])  # of class C^4
    bow, (x, dx, ddx) = Polynomial([0.0, 0.0, 16.0, -32.0, 16.0]), (s.deriv(k)(t / 2) / 2**k for k in range(3))
    y, ddy = v * bow(x), v * (bow.deriv(2)(x) * dx**2 + bow.deriv()(x) * ddx)
    slope = 30.0 * np.exp(-((x - centre) ** 2 + y**2) / 0.02) / 0.01
    forces = np.array([ddx - (x - centre) * slope, ddy - y * slope])
    costs = np.abs(forces).max(axis=(0, 2)) if minimise == "peak" else np.sqrt(np.mean(forces**2, axis=2).sum(axis=0))
    return costs.min()


HILLS = {
    "the issue's": ((0.0, (-1.0, 1.0)), {}), "on one side": ((0.0, (0.0, 1.0)), {}),
    "another place": ((0.0, (-1.0, 1.0)), {"centre": 0.4}), "of a peak": ((0.0, (-1.0, 1.0)), {"minimise": "peak"}),
    "within limits": ((0.0, (-1.0, 1.0)), {"limits": {"G": 400.0}}),
}  # fmt: skip


@pytest.mark.parametrize("case", HILLS)
def test_a_design_leaves_a_stationary_point_for_less_cost(case):
    given, options = HILLS[case]
    found = over_a_hill(*given, **options)
    assert found.cost == pytest.approx(least_over_a_hill(given[1], **options), rel=2e-3)
    assert found.cost < found.before / 5
    assert "a local minimum" in found.message and found.proof.passed


@pytest.mark.parametrize(("first", "minimise"), [(0.7, "peak"), (0.1, "rms"), (0.1 + 1e-9, "rms")])
def test_a_least_cost_of_zero_is_a_minimum(first, minimise):
    p, q = sv.parameters(a=first), sv.coordinates("x")
    (x,) = q
    way = (p.a - 0.1) * q.references(s=sv.paths.rest_to_rest(0.0, 1.0, 2.0, smoothness=4)).s
    model = sv.derive(sv.Mechanism(q, sv.particle(q, 1.0, x), actuators={"F": x}, parameters=p), sv.Program({"X": x - way}))
    found = sv.design(model, {"a": (-1.0, 1.0)}, (0.0, 2.0), minimise)
    assert "a local minimum" in found.message and found.values["a"] == pytest.approx(0.1, abs=1e-7)
