"""The parameter of a curve as an unknown of the program: a coordinate of unit inertia with an actuator, and its law."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import solve_ivp

import servoctl as sv

M, G = 2.0, 9.81  # kg, m/s^2


def along(curve, law, g=0.0, **values):
    """A driven mass on curve(s), whose parameter s follows from a residual law(q)."""
    q = sv.coordinates("x y s")
    x, y, s = q
    S = sv.particle(q, M, (x, y)) + q.d(2)[2] ** 2 / 2
    mechanism = sv.Mechanism(q, S, potential=M * g * y, actuators={"fx": x, "fy": y, "pace": s})
    place = curve(s)
    model = sv.derive(mechanism, sv.Program({"X": x - place[0], "Y": y - place[1], "law": law(q)}), guess={"ds": 1.0})
    at = ca.Function("at", [s], [place, ca.jacobian(place, s)])
    (x0, y0), (dx, dy) = (np.array(part).ravel() for part in at(values["s"]))
    speed = values.get("ds", 1.0)
    guess = {"x": x0, "y": y0, "dx": dx * speed, "dy": dy * speed, "ds": speed}
    return model, model.start(guess=guess, **values)


def circle(s):
    return sv.curves.circle(s, (0.0, 0.0), 2.0)


def ellipse(s):
    return ca.vertcat(3.0 * ca.cos(s), ca.sin(s))


def wave(s):
    """A spline, whose knots are crossed where the motion reaches them."""
    points = [[0, 0], [1, 1], [2, 0], [3, 0.5], [4, 0]]
    spline = sv.paths.spline([0, 1, 2, 3, 4], points, smoothness=4, ends="natural")
    pieces = zip(spline.breaks[:-1], spline.breaks[1:], spline.coefficients, strict=True)
    pieces = [(high, horner((2 * s - low - high) / (high - low), c)) for low, high, c in pieces]
    place = pieces[-1][1]
    for high, piece in reversed(pieces[:-1]):
        place = ca.if_else(s < high, piece, place)
    return place


def horner(tau, coefficients):
    """The polynomials with coefficients (dim, size) at tau."""
    value = ca.SX.zeros(len(coefficients))
    for c in coefficients.T[::-1]:
        value = value * tau + ca.DM(c)
    return value


def speed(v):
    return lambda q: q.d(1)[0] ** 2 + q.d(1)[1] ** 2 - v**2


def power(p, g=0.0):
    """The actuators do the work p per second [W]."""
    return lambda q: M * (q.d(2)[0] * q.d(1)[0] + (q.d(2)[1] + g) * q.d(1)[1]) - p


def test_a_circle_at_constant_speed_takes_the_centripetal_force():
    model, start = along(circle, speed(1.5), s=0.0)
    run = sv.simulate(model, start, (0.0, 5.0))
    force = -M * 1.5**2 / 2.0 * np.array([np.cos(0.75 * run.t), np.sin(0.75 * run.t)])
    assert np.abs(run["s"] - 0.75 * run.t).max() < 1e-7
    assert np.abs(np.array([run["fx"], run["fy"]]) - force).max() < 1e-6
    assert sv.verify(run).passed


@pytest.mark.parametrize("curve, start", [(ellipse, 0.3), (wave, 0.1)])
def test_constant_power_gives_kinetic_energy_in_proportion_to_time(curve, start):
    model, begin = along(curve, power(0.7), s=start, ds=0.8)
    run = sv.simulate(model, begin, (0.0, 2.0))
    energy = M * (run["dx"] ** 2 + run["dy"] ** 2) / 2
    assert np.abs(energy - energy[0] - 0.7 * run.t).max() < 1e-7 * energy.max()
    assert np.abs(run["fx"] * run["dx"] + run["fy"] * run["dy"] - 0.7).max() < 1e-7
    places = ca.Function("places", [model.reduction.mechanism.q.d(0)[2]], [curve(model.reduction.mechanism.q.d(0)[2])])
    assert np.abs(np.array(places(run["s"][None])) - np.array([run["x"], run["y"]])).max() < 1e-8
    assert sv.verify(run).passed


def normal_force(q):
    """The actuators do no work, also where the mass turns back and any force has no power."""
    s = list(q)[2]
    return -3.0 * ca.sin(s) * q.d(2)[0] + ca.cos(s) * (q.d(2)[1] + G)


def test_without_work_an_ellipse_in_gravity_is_a_bead_on_a_wire():
    """The force is normal to the curve, and s'' that of Lagrange's equation with one coordinate; it turns back."""
    model, begin = along(ellipse, normal_force, G, s=-1.4, ds=1.0)
    run = sv.simulate(model, begin, (0.0, 3.0))

    def bead(t, z):
        s, ds = z
        metric, half_slope = 9.0 * np.sin(s) ** 2 + np.cos(s) ** 2, 8.0 * np.sin(s) * np.cos(s)
        return [ds, (-G * np.cos(s) - half_slope * ds**2) / metric]

    expected = solve_ivp(bead, (0.0, 3.0), [-1.4, 1.0], "DOP853", run.t, rtol=1e-12, atol=1e-12).y
    assert np.abs(run["s"] - expected[0]).max() < 1e-7 and np.abs(run["ds"] - expected[1]).max() < 1e-6
    normal = run["fx"] * -3.0 * np.sin(run["s"]) + run["fy"] * np.cos(run["s"])
    assert np.abs(normal).max() < 1e-6 * np.abs(run["fy"]).max()
    assert np.ptp(M * (run["dx"] ** 2 + run["dy"] ** 2) / 2 + M * G * run["y"]) < 1e-6
    assert run["ds"].min() < 0.0


def test_a_law_of_power_ends_where_the_mass_turns_back():
    model, begin = along(ellipse, power(0.0, G), G, s=-1.4, ds=1.0)
    with refused(sv.errors.SingularProgram, "law"):
        sv.simulate(model, begin, (0.0, 3.0))


def crane(law):
    """The load of a crane on a curve that falls by 2 m along the way; its parameter s follows from a law."""
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=G)
    q = sv.coordinates("x l theta s")
    x, l, theta, s = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    S = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load) + q.d(2)[3] ** 2 / 2
    mechanism = sv.Mechanism(
        q, S, potential=-p.m_load * p.g * load[1], actuators={"trolley": x, "hoist": l, "pace": s}, parameters=p,
        outputs={"Xdot": q.dt(load[0]), "X": load[0], "Z": load[1]},
    )  # fmt: skip
    residuals = {"X": load[0] - s, "Z": load[1] - 3.0 + ca.tanh(s - 2.5), "law": law(q, p, load)}
    return sv.derive(mechanism, sv.Program(residuals), guess={"l": 4.0})


def test_a_load_follows_a_curve_under_a_constant_force_of_the_trolley():
    """The horizontal momentum of trolley and load grows by F t."""
    model = crane(lambda q, p, load: p.m_trolley * q.d(2)[0] + p.m_load * q.dt(load[0], 2) - 60.0)
    run = sv.simulate(model, model.start(s=0.0, ds=0.0, x=0.0, dx=0.0, guess={"l": 4.0}), (0.0, 3.0))
    assert np.abs(run["trolley"] - 60.0).max() < 1e-8
    assert np.abs(10.0 * run["dx"] + 100.0 * run["Xdot"] - 60.0 * run.t).max() < 1e-6
    assert np.abs(run["Z"] - 3.0 + np.tanh(run["X"] - 2.5)).max() < 1e-8 and run["X"][-1] > 2.0
    assert sv.verify(run).passed


def test_the_speed_along_a_curve_is_designed():
    """The speed on the circle for which the force is 4.5 N is v = √(F r/m), found as a parameter of the law."""
    q = sv.coordinates("x y s")
    x, y, s = q
    p = sv.parameters(v=1.0)
    mechanism = sv.Mechanism(
        q, sv.particle(q, M, (x, y)) + q.d(2)[2] ** 2 / 2, actuators={"fx": x, "fy": y, "pace": s}, parameters=p
    )  # fmt: skip
    place = circle(s)
    program = sv.Program({"X": x - place[0], "Y": y - place[1], "law": s - p.v * q.t / 2.0})
    model = sv.derive(mechanism, program)
    found = sv.design(model, {"v": (0.5, 5.0)}, (0.0, 2 * np.pi * 2.0 / p.v), "time", limits={"fx": 4.5, "fy": 4.5})
    assert found.values["v"] == pytest.approx(np.sqrt(4.5 * 2.0 / M), rel=1e-5)
    assert found.proof.passed


def test_a_parameter_without_inertia_is_refused_with_the_remedy():
    q = sv.coordinates("x y s")
    x, y, s = q
    mechanism = sv.Mechanism(q, sv.particle(q, M, (x, y)), actuators={"fx": x, "fy": y})
    place = circle(s)
    with refused(sv.errors.SpecificationError, "parameter of a path", names=["ds"]):
        sv.derive(mechanism, sv.Program({"X": x - place[0], "Y": y - place[1]}))
