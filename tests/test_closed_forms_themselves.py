"""The references themselves: against printed numbers, and against the equations that they solve."""

import closed_forms as cf
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar
from scipy.special import fresnel

CARS_3 = {"masses": (1.0, 1.0, 2.0), "stiffnesses": (1.0, 1.0), "gaps": (0.5, 0.5)}


def extremum(signal, t_span, sign):
    """Largest (sign = 1) or smallest (-1) value of a signal, refined between samples, and its instant."""
    t = np.linspace(*t_span, 2001)
    i = int(np.argmax(sign * signal(t)))
    refined = minimize_scalar(
        lambda instant: -sign * float(signal(np.array([instant]))[0]),
        bounds=(t[max(i - 1, 0)], t[min(i + 1, 2000)]),
        method="bounded",
        options={"xatol": 1e-12},
    )
    return -sign * refined.fun, refined.x


def derivative(t, values, k):
    """k-th derivative of a smooth signal sampled at Chebyshev points."""
    return np.polynomial.Chebyshev.fit(t, values, 50).deriv(k)(t)


def chebyshev(start, end):
    return (start + end) / 2 + (end - start) / 2 * np.polynomial.chebyshev.chebpts1(121)


def signal(motion, name, **arguments):
    return lambda t: motion(t, **arguments)[name]


@pytest.mark.parametrize("smoothness, degree_9", [(4, [126, -420, 540, -315, 70]), (6, None)])
def test_blend_is_the_rest_to_rest_polynomial(smoothness, degree_9):
    sigma = np.linspace(0.0, 1.0, 11)
    coefficients = degree_9 or [1716, -9009, 20020, -24024, 16380, -6006, 924]
    polynomial = np.polynomial.Polynomial([0] * (smoothness + 1) + coefficients)
    for order in range(smoothness + 1):
        expected = polynomial.deriv(order)(sigma)
        assert cf.blend(sigma, order, smoothness) == pytest.approx(expected, abs=1e-10 * max(1, abs(expected).max()))


def test_appell_hamel_states_as_printed():
    motion = cf.appell_hamel(np.array(list(cf.APPELL_HAMEL_STATES)))
    names = ("x", "y", "z", "phi", "theta", "dphi", "dtheta")
    printed = np.array(list(cf.APPELL_HAMEL_STATES.values())).T
    assert np.array([motion[name] for name in names]) == pytest.approx(printed, abs=1e-10)
    stop = brentq(lambda t: cf.appell_hamel(t)["dphi"][0], 0.6, 0.8, xtol=1e-13)
    assert stop == pytest.approx(cf.WHEEL_STOPS, abs=1e-10)


def test_appell_hamel_against_extended_precision():
    def rates(_, state):
        p, (theta, dphi, dtheta) = cf.APPELL_HAMEL, state[4:]
        inertia = p["I_y"] + p["a"] ** 2 * (p["M"] + p["m"]) + p["b"] ** 2 * p["m"]
        return [
            p["a"] * dphi * mpmath.cos(theta) - p["rho"] * dtheta * mpmath.sin(theta),
            p["a"] * dphi * mpmath.sin(theta) + p["rho"] * dtheta * mpmath.cos(theta),
            -p["b"] * dphi,
            dphi,
            dtheta,
            p["m"] * (p["a"] * p["rho"] * dtheta**2 - p["b"] * p["g"]) / inertia,
            -p["m"] * p["a"] * p["rho"] * dphi * dtheta / (p["I_x"] + p["m"] * p["rho"] ** 2),
        ]

    with mpmath.workdps(20):
        state = mpmath.odefun(rates, 0, [0, 0, 0, 0, 0, 1, 2])(2)
    motion = cf.appell_hamel(2.0)
    names = ("x", "y", "z", "phi", "theta", "dphi", "dtheta")
    assert [motion[name][0] for name in names] == pytest.approx([float(value) for value in state], abs=1e-12)


def test_paper_equations_hold_at_random_consistent_states():
    p, rng = cf.APPELL_HAMEL, np.random.default_rng(4)
    theta, dphi, dtheta = rng.uniform(-3, 3, (3, 50))
    dphi += np.sign(dphi)
    state = np.array([*np.zeros((4, 50)), theta, dphi, dtheta])
    dx, dy, _, _, _, d2phi, d2theta = cf.appell_hamel_rates(state, p)
    sine, cosine = np.sin(theta), np.cos(theta)
    d2x = (p["a"] * d2phi - p["rho"] * dtheta**2) * cosine - (p["a"] * dphi * dtheta + p["rho"] * d2theta) * sine
    d2y = (p["a"] * d2phi - p["rho"] * dtheta**2) * sine + (p["a"] * dphi * dtheta + p["rho"] * d2theta) * cosine
    accelerations = (d2x, d2y, -p["b"] * d2phi, d2phi, d2theta)
    assert cf.paper_4_4(theta, dx, dy, dphi, dtheta) == pytest.approx(0, abs=1e-12)
    assert cf.paper_4_6(theta, dx, dy, dphi, dtheta, d2phi, d2theta) == pytest.approx(np.array([d2x, d2y]), abs=1e-12)
    assert cf.paper_4_8(theta, dx, dy, dphi, accelerations) == pytest.approx(0, abs=1e-12)
    assert cf.paper_4_9(theta, dx, dy, dphi, dtheta, accelerations) == pytest.approx(0, abs=1e-12)
    misprint = p["rho"] * sine * cosine * dy * (dtheta - d2theta) / (cosine * dx + sine * dy)
    assert abs(misprint).max() > 1e-2  # what the fourth row of (4.9) would be off by as printed


@pytest.mark.parametrize("order", range(3, 13))
def test_spiral_ends_at_one_radian(order):
    end = cf.spiral(np.array([2.0]), order)
    assert end["heading"] == pytest.approx(1.0, abs=1e-15)
    exact = mpmath.quad(lambda t: mpmath.expj((t / 2) ** (order - 1)), [0, 2])
    assert [end["x"][0], end["y"][0]] == pytest.approx([float(exact.real), float(exact.imag)], abs=1e-14)


def test_spiral_of_order_3_is_fresnel():
    t, scale = np.linspace(0.1, 2.0, 20), np.sqrt(np.pi)
    sine, cosine = fresnel(t / scale)
    end = cf.spiral(t, 3, c=1.0)
    assert end["x"] == pytest.approx(scale * cosine, abs=1e-14)
    assert end["y"] == pytest.approx(scale * sine, abs=1e-14)


def test_constant_speed():
    end = cf.constant_speed(1.0)
    assert [end["x"], end["y"]] == pytest.approx([3.2912149476, -3.2834403089], abs=1e-10)
    t = chebyshev(0.0, 0.4)
    fall = cf.constant_speed_horizontal(t)
    assert derivative(t, fall["x"], 1) == pytest.approx(fall["dx"], abs=1e-9)
    assert derivative(t, fall["x"], 2) == pytest.approx(fall["thrust"], abs=1e-6)
    assert 5.0 / cf.GRAVITY == pytest.approx(0.5096840, abs=5e-8)


def test_cars_operators_as_printed():
    assert cf.cars_operator((1.0, 2.0), (1.0,))[1] == pytest.approx([0, 3, 2])
    assert cf.cars_operator((1.0, 1.0, 2.0), (1.0, 1.0))[1] == pytest.approx([0, 4, 7, 2])


@pytest.mark.parametrize(
    "arguments, sign, value, instant",
    [
        ({}, 1, 316.175102075, 1.248527),
        ({}, -1, -316.175102075, 0.751473),
        (CARS_3, 1, 11774.676981887, 0.762319),
    ],
)
def test_cars_force_as_printed(arguments, sign, value, instant):
    found, t = extremum(signal(cf.cars, "force", **arguments), (0.0, 2.0), sign)
    assert found == pytest.approx(value, abs=1e-9 * abs(value))
    assert t == pytest.approx(instant, abs=1e-6)


def test_four_cars_obey_newton():
    masses, k, gaps = (1.0, 2.0, 0.5, 3.0), (4.0, 9.0, 2.0), (0.5, 0.4, 0.3)
    t = chebyshev(0.2, 1.8)
    motion = cf.cars(t, masses, k, gaps, smoothness=8)
    x = np.array([motion[f"x{i}"] for i in range(1, 5)])
    pull = np.vstack([0 * t, np.array(k)[:, None] * (x[:-1] - x[1:] - np.array(gaps)[:, None]), -motion["force"]])
    for i, mass in enumerate(masses):
        assert mass * derivative(t, x[i], 2) == pytest.approx(pull[i] - pull[i + 1], abs=1e-7 * abs(pull).max())


def test_two_cars_by_an_ideal_reaction():
    def rates(t, state):
        y = cf.rest_to_rest(np.array([t]), 0, 0.5, 2.5, 2.0, 6)[0]
        return [state[1], (y - state[0] - 0.5) / 2.0]

    t = np.linspace(0.0, 10.0, 41)
    numerical = solve_ivp(rates, (0, 10), [0, 0], t_eval=t, method="DOP853", rtol=1e-12, atol=1e-13, max_step=0.05)
    assert cf.cars_ideal(t)["x2"] == pytest.approx(numerical.y[0], abs=1e-10)
    force, instant = extremum(signal(cf.cars_ideal, "reaction"), (0.0, 2.0), 1)
    assert [force, instant] == [pytest.approx(6.852059, abs=5e-7), pytest.approx(0.7091, abs=5e-5)]
    assert extremum(signal(cf.cars_ideal, "x2"), (2.0, 12.0), 1)[0] - 2.0 == pytest.approx(1.966911, abs=5e-7)


@pytest.mark.parametrize(
    "name, sign, value, instant",
    [
        ("trolley", -1, -35.6165157, 3.929903),
        ("trolley", 1, 36.0179308, 2.052399),
        ("winch", -1, -102.2085881, None),
        ("winch", 1, -94.1617080, None),
        ("tension", -1, 945.1070630, None),
        ("tension", 1, 1018.2600127, None),
    ],
)
def test_winch_crane_as_printed(name, sign, value, instant):
    found, t = extremum(signal(cf.winch_crane, name), (0.0, 6.0), sign)
    assert found == pytest.approx(value, abs=5.1e-8)
    assert instant is None or t == pytest.approx(instant, abs=1e-6)


@pytest.mark.parametrize(
    "name, sign, value, digits",
    [
        ("trolley", -1, -137.991607, 5.1e-7),
        ("trolley", 1, 134.331943, 5.1e-7),
        ("hoist", -1, -1044.370897, 5.1e-7),
        ("hoist", 1, -935.793762, 5.1e-7),
        ("tension", -1, 938.008880, 5.1e-7),
        ("theta", -1, np.deg2rad(-7.1814), 1e-6),
        ("theta", 1, np.deg2rad(7.9766), 1e-6),
    ],
)
def test_overhead_crane_as_printed(name, sign, value, digits):
    assert extremum(signal(cf.overhead_crane, name), (0.0, 6.0), sign)[0] == pytest.approx(value, abs=digits)


def test_crane_3d_obeys_newton():
    t = chebyshev(0.5, 5.5)
    motion = cf.crane_3d(t)
    load = np.array([motion[name] for name in "XYZ"])
    trolley = np.array([motion["x"], motion["y"], 0 * t])
    assert np.linalg.norm(load - trolley, axis=0) == pytest.approx(motion["l"], abs=1e-12)
    rope = (load - trolley) / motion["l"]
    weight = np.array([0.0, 0.0, cf.GRAVITY])[:, None]
    d2load = np.array([derivative(t, row, 2) for row in load])
    assert 100.0 * (d2load - weight) == pytest.approx(-motion["tension"] * rope, abs=1e-5)
    for name, mass, force, pull in (
        ("x", 20.0, "bridge", rope[0]),
        ("y", 10.0, "trolley", rope[1]),
        ("l", 5.0, "hoist", 1.0),
    ):
        newton = mass * derivative(t, motion[name], 2) - motion["tension"] * pull
        assert newton == pytest.approx(motion[force], abs=1e-5)
    theta, phi = motion["theta"], motion["phi"]
    along = np.array([np.sin(theta), np.cos(theta) * np.sin(phi), np.cos(theta) * np.cos(phi)])
    assert along == pytest.approx(rope, abs=1e-12)


@pytest.mark.parametrize("alpha", [0.0, np.pi / 6, np.pi / 4, np.pi / 2])
@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_mass_on_car_obeys_its_equations(alpha, damping):
    t = chebyshev(0.1, 2.9)
    motion = cf.mass_on_car(t, alpha, damping)
    d2x, d2s, ds = derivative(t, motion["x"], 2), derivative(t, motion["s"], 2), derivative(t, motion["s"], 1)
    z = cf.rest_to_rest(t, 0, 0.5, 2.5, 3.0, 6)
    assert motion["x"] + motion["s"] * np.cos(alpha) == pytest.approx(z, abs=1e-12)
    assert 3.0 * d2x + 2.0 * np.cos(alpha) * d2s == pytest.approx(motion["force"], abs=1e-5)
    spring = 5.0 * motion["s"] + damping * ds
    assert 2.0 * np.cos(alpha) * d2x + 2.0 * d2s == pytest.approx(-spring, abs=1e-5)


@pytest.mark.parametrize(
    "alpha, poles", [(0.0, [-5.0]), (np.pi / 4, [-0.5 + 2.17945j]), (np.pi / 2, [-0.25 + 1.56125j])]
)
def test_mass_on_car_poles_as_printed(alpha, poles):
    found = cf.mass_on_car_poles(alpha)
    assert found[found.imag >= 0] == pytest.approx(poles, abs=5e-6)


def test_passive_arm_as_printed():
    link = {"m": 6.875, "l": 1.0, "inertia": 0.57}
    assert cf.passive_arm_critical() == pytest.approx(0.4, abs=1e-15)
    assert cf.passive_arm_critical(**link) == pytest.approx(0.3996943899, abs=5e-11)
    assert np.rad2deg(cf.passive_arm_lost(0.5)) == pytest.approx(48.1897, abs=5e-5)
    assert np.rad2deg(cf.passive_arm_lost(0.5, **link)) == pytest.approx(48.254875, abs=5e-7)
    assert cf.passive_arm_poles(0.5, 50.0, 0.25, **link) == pytest.approx([-9.115030, 9.550286], abs=5e-7)
    coupling, passive = cf.passive_arm_inertia(0.7)
    assert passive - 0.4 * coupling == pytest.approx(0.2 * (1 - np.cos(0.7)), abs=1e-15)


def test_vtol_as_printed():
    assert cf.vtol_rate() == pytest.approx(15.0405993, abs=5e-8)
    assert cf.vtol_flat_point() == pytest.approx(0.0433649377, abs=5e-11)


def test_vtol_obeys_its_equations():
    p, t = cf.VTOL, chebyshev(0.2, 3.8)
    motion = cf.vtol(t)
    total, difference = motion["u1"] + motion["u2"], (motion["u1"] - motion["u2"]) * np.sin(p["tilt"])
    sine, cosine = np.sin(motion["theta"]), np.cos(motion["theta"])
    arm = p["l"] * np.cos(p["tilt"]) + p["h"] * np.sin(p["tilt"])
    assert p["M"] * derivative(t, motion["x"], 2) == pytest.approx(cosine * difference - sine * total, abs=2e-5)
    lift = cosine * total + sine * difference - p["M"] * p["g"]
    assert p["M"] * derivative(t, motion["z"], 2) == pytest.approx(lift, abs=2e-5)
    turn = (motion["u1"] - motion["u2"]) * arm
    assert p["J"] * derivative(t, motion["theta"], 2) == pytest.approx(turn, abs=2e-5)
