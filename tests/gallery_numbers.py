"""Numbers of scenes: a pair for each run, as measured and by a closed form or a computation without servoctl."""

import re
from itertools import product
from math import cos, pi, sin, sqrt

import closed_forms
import numpy as np
import pytest
from closed_forms import GRAVITY
from scipy.special import ellipj

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.gallery.six_axes import AXES, HOME


def _largest(run, name):
    return max(abs(value) for _, value in run.extrema(name))


def trailers(run):
    """On circles about one centre, an axle lies at a right angle to the bar that pulls it: radii add up by squares."""
    bends = np.cos(run["theta0"][-1] - run["theta1"][-1]) * np.cos(run["theta1"][-1] - run["theta2"][-1])
    return run["v"][-1] / bends / run["r"][-1], sqrt(2.0**2 + 0.8**2 + 0.8**2)


def rolling_disc(run):
    """The centre's circle from the balance of moments about the centre, A = m a²/4 and C = m a²/2.

    With u from the contact to the centre, e along the motion, n = u × e the axle and s the rate about it, the angular
    momentum A Ω cos λ u + C s n turns at Ω about the vertical: -Ω cos λ (A Ω sin λ + C s) e. The contact's force
    m (g up + Ω a s left) has the moment m a (Ω a s cos λ - g sin λ) e.
    """
    lean, turn, a = 0.35, 1.5, 0.3
    s = (GRAVITY * sin(lean) - turn**2 * a * cos(lean) * sin(lean) / 4) / (1.5 * a * turn * cos(lean))
    return np.ptp(run["y"]) / 2, a * s / turn


def ball_on_turntable(run):
    """m a' = F, 2/5 m a² ω' = -a up × F and rolling give v' = 2/7 Ω up × v."""
    heading = np.unwrap(np.arctan2(run["dy"], run["dx"]))
    return np.ptp(heading) / np.ptp(run.t), 2 / 7 * 3.0


def _slung(load):
    """Thrust from the load's path y(k), (d, N) arrays, height last: the rope carries the load, the rotors both."""
    up = np.zeros((len(load(0)), 1))
    up[-1] = GRAVITY
    f, df, d2f = load(2) + up, load(3), load(4)
    r = np.linalg.norm(f, axis=0)
    n = f / r
    dr = (n * df).sum(0)
    dn = (df - dr * n) / r
    d2r = (n * d2f).sum(0) + (dn * df).sum(0)
    d2n = (d2f - d2r * n - 2 * dr * dn) / r
    return np.linalg.norm(1.0 * (f + 1.2 * d2n) + 0.5 * f, axis=0)


def slung_load(run):
    def load(k):
        return closed_forms.rest_to_rest(run.t, k, (0.0, -1.2), (4.0, 0.3), 4.0, 6)

    return run["thrust"].max(), _slung(load).max()


def slung_load_3d(run):
    def load(k):
        return closed_forms.quarter_turn(run.t, k, 2.0, -1.2, -0.2, 5.0, 6)

    return run["thrust"].max(), _slung(load).max()


def flexible_joint(run):
    """motor = link + (I link'' + m g l cos link + c tanh(link'/w))/k, and so on for the torque."""
    m, l, inertia, J, k, c, w = 5.0, 0.5, 1.7, 0.2, 500.0, 2.0, 0.1
    a, da, d2a, d3a, d4a = (closed_forms.rest_to_rest(run.t, i, -pi / 2, 0.0, 1.0, 4) for i in range(5))
    rubbing = np.tanh(da / w)
    slope = (1 - rubbing**2) / w
    twist = inertia * d2a + m * GRAVITY * l * np.cos(a) + c * rubbing
    dtwist = inertia * d3a - m * GRAVITY * l * np.sin(a) * da + c * slope * d2a
    d2twist = inertia * d4a - m * GRAVITY * l * (np.cos(a) * da**2 + np.sin(a) * d2a)
    d2twist += c * (slope * d3a - 2 * rubbing * slope / w * d2a**2)
    torque = J * (d2a + d2twist / k) + twist + c / 2 * np.tanh((da + dtwist / k) / w)
    return run["torque"].max(), torque.max()


def elastic_link(run):
    return _slowest(run), np.abs(link_poles().imag).min()


def link_poles():
    """Eight poles of four rods with springs and dampers between them, for small angles [1/s]."""
    n, m, l, tau = 4, 2.0 / 4, 1.0 / 4, 0.002
    angles = np.tril(np.ones((n, n)))  # of the rods, by those of the springs
    middles = [l * (angles[:i].sum(0) + angles[i] / 2) for i in range(n)]
    mass = sum(m * (np.outer(y, y) + l**2 / 12 * np.outer(a, a)) for y, a in zip(middles, angles, strict=True))
    spring = np.linalg.solve(mass, np.diag([160.0, 80.0, 80.0, 80.0]))
    return np.linalg.eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [-spring, -tau * spring]]))


def double_pendulum(run):
    return _slowest(run), sqrt((2 - sqrt(2)) * GRAVITY / 0.8)


def _slowest(run):
    """The slowest mode of the internal dynamics at the start [rad/s]."""
    return np.abs(sv.internal_dynamics(run).eigenvalues[:, 0].imag).min()


def four_bar(run):
    """Crank a and coupler b in line, b + a and b - a from the crank's joint to the end of the rocker."""
    a, b, c, d = 0.2, 0.6, 0.5, 0.6
    folded, stretched = (np.arccos((d**2 + c**2 - r**2) / (2 * d * c)) for r in (b - a, b + a))
    (_, low), (_, high) = run.extrema("rocker")
    return high - low, stretched - folded


def cable_robot(run):
    """Of all tensions with W t = (m (a + g), J ω') those nearest to 500 N, along the motion."""
    y = [closed_forms.rest_to_rest(run.t, k, (0.0,) * 4, (0.3, 0.2, 0.3, 0.1), 3.0, 2) for k in (0, 2)]
    largest = 0.0
    for (*place, yaw), (*acceleration, turned) in zip(*(values.T for values in y), strict=True):
        wrench = np.array([*(20.0 * (np.array(acceleration) + [0, 0, GRAVITY])), 0.0, 0.0, 1.0 * turned])
        W, wish = wrenches(place, yaw), np.full(8, 500.0)
        largest = max(largest, (wish + np.linalg.pinv(W) @ (wrench - W @ wish)).max())
    return max(run[f"rope{i}"].max() for i in range(1, 9)), largest


def wrenches(place, yaw):
    """Forces and moments about the centre of the platform by unit tensions of its ropes, (6, 8)."""
    rotation = np.array([[cos(yaw), -sin(yaw), 0], [sin(yaw), cos(yaw), 0], [0, 0, 1]])
    ropes = []
    for up, side, front in product((1, -1), repeat=3):
        arm = rotation @ [0.4 * front * up, 0.3 * side, -0.15 * up]
        along = np.array([2.0 * front, 1.5 * side, 1.5 * up]) - place - arm
        ropes.append([*along, *np.cross(arm, along)] / np.linalg.norm(along))
    return np.array(ropes).T


def reaction_wheels(run):
    """J3 ω3 + J_w s3 = 0, and ω = (1, 2, 2)/3 times the rate of the turn, 15/8 of its mean at most."""
    return _largest(run, "s3"), 50.0 * 2 / 3 * 15 / 8 * (2 * pi / 3) / 20.0 / 0.1


def free_rates(t):
    """Rates of J = (30, 40, 50) without torque, by Jacobi's functions, of energy 4 J; (0.25, 0, 0.35) at the start."""
    (a, b, c), twice, square = (30.0, 40.0, 50.0), 8.0, (30.0 * 0.25) ** 2 + (50.0 * 0.35) ** 2
    near, far = twice * c - square, square - twice * a
    sn, cn, dn, _ = ellipj(sqrt((c - b) * far / (a * b * c)) * t, (b - a) * near / ((c - b) * far))
    return sqrt(near / (a * (c - a))) * cn, sqrt(near / (b * (c - b))) * sn, sqrt(far / (c * (c - a))) * dn


def tumbling_satellite(run):
    """With the torques -0.1 J ω the rates are exp(-0.1 t) times those of the free body at (1 - exp(-0.1 t))/0.1."""
    slowed = np.exp(-0.1 * run.t[-1])
    return run["w2"][-1], slowed * free_rates((1 - slowed) / 0.1)[1]


def six_axis_arm(run):
    """The gradient of the potential energy of the six bodies, by differences."""

    def energy(lift):
        rotation, place, total = np.eye(3), np.zeros(3), 0.0
        for name, joint, axis, mass, centre, *_ in AXES:
            place = place + rotation @ np.array(joint.split(), float)
            angle = lift if name == "lift" else HOME[name]
            c, s = cos(angle), sin(angle)
            rotation = rotation @ ([[c, -s, 0], [s, c, 0], [0, 0, 1]] if axis == "0 0 1" else [[c, 0, s], [0, 1, 0], [-s, 0, c]])
            total += mass * GRAVITY * (place + rotation @ np.array(centre.split(), float))[2]
        return total

    h = 1e-5
    return -run["torque_lift"][0], -(energy(HOME["lift"] + h) - energy(HOME["lift"] - h)) / (2 * h)


def constant_jerk(run):
    """a - g = (1 + J t) e with e = (0.6, 0.8)."""
    return run["x"][-1], 1.0 * 2.0 + 0.6 * (2.0**2 / 2 + 2.0 * 2.0**3 / 6)


def rotary_crane(run):
    """The load at (3 + s) exp(i π s/2), 5 - s below: the rope carries m (g - a)."""
    s, ds, d2s = (closed_forms.rest_to_rest(run.t, k, 0.0, 1.0, 8.0, 6) for k in range(3))
    turn, radius, w = np.exp(0.5j * pi * s), 3 + s, 0.5j * pi
    across = turn * ((1 + w * radius) * d2s + (2 * w + w**2 * radius) * ds**2)
    return run["tension"].max(), 100.0 * np.hypot(np.abs(across), GRAVITY + d2s).max()


def beam_crane(run):
    """Parallel ropes along g - a, from the height of the rail down to the beam."""
    (_, Z), (across, down) = (closed_forms.rest_to_rest(run.t, k, (1.0, 4.0), (5.0, 3.0), 6.0, 4) for k in (0, 2))
    return np.abs(run["x1"] - run["X"] + 1.0).max(), np.abs(Z * across / (GRAVITY - down)).max()


def hopper(run):
    """Angular momentum about the centre of mass, zero: it depends on the limbs' angles alone, and is integrated once."""
    m, l = np.array([5.0, 1.5, 1.5]), np.array([0.4, 0.35, 0.35])
    start, by = np.array([[-1.57], [2.6], [0.5]]), np.array([[1.2], [0.6], [0.6]])
    nodes, weights = np.polynomial.legendre.leggauss(40)
    t, weights = 0.25 * (nodes + 1), 0.25 * weights
    angles = start + by * closed_forms.rest_to_rest(t, 0, 0.0, 1.0, 0.5, 4)
    rates = by * closed_forms.rest_to_rest(t, 1, 0.0, 1.0, 0.5, 4)
    common = np.cos(angles[:, None] - angles) * (m * l)[:, None, None] * (m * l)[:, None] / (20.0 + m.sum())
    limbs = np.einsum("i,ik->k", m * l**2, rates) - np.einsum("ijk,jk->k", common, rates)
    return -run["phi"][-1], weights @ (limbs / (0.6 + m @ l**2 - common.sum(axis=(0, 1))))


def clothoid_arm(run):
    """Speed 0.25 m/s and the heading 4 · 0.25 t²/2 from that at the start."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    chord = 0.25 * abs(weights @ np.exp(0.5j * (nodes + 1) ** 2))
    return np.hypot(run["X"][-1] - run["X"][0], run["Y"][-1] - run["Y"][0]), chord


def bicycle(run):
    """The curvature of (8 sin w t, 4 sin 2 w t)."""
    w, t = 2 * pi / 16.0, run.t
    dx, dy = 8 * w * np.cos(w * t), 8 * w * np.cos(2 * w * t)
    d2x, d2y = -8 * w**2 * np.sin(w * t), -16 * w**2 * np.sin(2 * w * t)
    return np.abs(run["delta"]).max(), np.arctan(1.1 * np.abs(dx * d2y - dy * d2x) / np.hypot(dx, dy) ** 3).max()


def acrobot_poles():
    """With p1 = k q2 and dp1/dt = -A q1 - B (q1 + q2) about the hanging pose."""
    g1, g2 = GRAVITY * (4.0 * 0.3 + 3.0 * 0.6), GRAVITY * 3.0 * 0.25
    m11, m12, k = 0.12 + 4.0 * 0.09 + 0.07 + 3.0 * 0.85**2, 0.07 + 3.0 * 0.25 * 0.85, -2.0
    bend = np.array([-(g1 + g2), -g2]) / k
    return np.linalg.eigvals([(np.array([0.0, k]) - m12 * bend) / m11, bend])


def _poles(run, sample):
    """Eigenvalues of the internal dynamics at a sample."""
    return sv.internal_dynamics(run).eigenvalues[:, sample]


def furuta_pendulum(run):
    """m l² θ'' + d θ' + m g l θ = 0 while the arm is at rest."""
    inertia = 0.2 * 0.3**2
    return _poles(run, 0).imag.max(), sqrt(GRAVITY / 0.3 - (0.005 / inertia / 2) ** 2)


def steady_satellite(run):
    return np.hypot(run["d2x"], run["d2y"])[-1], 3.986e14 / 7e6**2


def largest(signal, closed_form):
    """The largest magnitude of a signal, by a function of time that returns it by name."""
    return lambda run: (np.abs(run[signal]).max(), np.abs(closed_form(run.t)[signal]).max())


def decay(run):
    """The slowest decay of the internal dynamics, at the start [1/s]."""
    return -sv.internal_dynamics(run).eigenvalues[:, 0].real.max()


def swing(run):
    """Frequency [rad/s] of the pendubot's second link about the hanging pose, m2 g l2/2 over I2 + m2 l2²/4."""
    inertia, damping = 0.07 + 3.0 * 0.25**2, 0.05
    rate = np.sqrt(3.0 * 9.81 * 0.25 / inertia - (damping / inertia / 2) ** 2)
    return np.abs(sv.internal_dynamics(run).eigenvalues[:, 0].imag).max(), rate


def three_cars(t):
    return closed_forms.cars(t, (1.0, 1.0, 2.0), (1.0, 1.0), (0.5, 0.5))


def mass_on_car(t):
    return closed_forms.mass_on_car(t, pi / 4, 1.0)


NUMBERS = {
    "overhead-crane": largest("hoist", closed_forms.overhead_crane),
    "winch-crane": largest("winch", closed_forms.winch_crane),
    "crane-3d": largest("tension", closed_forms.crane_3d),
    "two-cars": largest("force", closed_forms.cars),
    "three-cars": largest("force", three_cars),
    "vtol": largest("u1", closed_forms.vtol),
    "overhead-crane-redundant": largest("trolley", closed_forms.overhead_crane),
    "winch-crane-redundant": largest("tension", closed_forms.winch_crane),
    "crane-3d-redundant": largest("hoist", closed_forms.crane_3d),
    "mass-on-car-absolute": largest("force", mass_on_car),
    "mass-on-car": lambda run: (decay(run), -closed_forms.mass_on_car_poles(pi / 4).real.max()),
    "passive-arm": lambda run: (decay(run), -closed_forms.passive_arm_poles(0.3, 10.0, 1.0).real.max()),
    "pendubot": swing,
    "vtol-centre": lambda run: (-decay(run), closed_forms.vtol_rate()),
    "two-link-arm": lambda run: (run["q2"][0], np.arccos((0.6**2 + 0.4**2 - 0.6**2 - 0.5**2) / (2 * 0.6 * 0.5))),
    "appell-hamel": largest("tension", closed_forms.appell_hamel),
    "two-cars-ideal": lambda run: (
        np.abs(run.signals("reaction")[1][0]).max(), np.abs(closed_forms.cars_ideal(run.t)["reaction"]).max(),
    ),  # fmt: skip
    "constant-speed": lambda run: (-run["y"][-1], -closed_forms.constant_speed(run.t)["y"][-1]),
    "spiral": lambda run: (run["y"][-1], closed_forms.spiral(run.t, 3)["y"][-1]),
    "wheeled-robot": lambda run: (run["curvature"].max(), pi / 4),
    "rotary-crane": rotary_crane,
    "beam-crane": beam_crane,
    "hopper": hopper,
    "clothoid-arm": clothoid_arm,
    "bicycle": bicycle,
    "acrobot": lambda run: (-_poles(run, -1).real.max(), -acrobot_poles().real.max()),
    "furuta-pendulum": furuta_pendulum,
    "steady-satellite": steady_satellite,
    "ball-and-beam": lambda run: (run["d2r"][-1], 5 / 7 * GRAVITY * sin(0.05)),
    "cart-pole": lambda run: (_poles(run, 0).real.max(), sqrt(GRAVITY / 0.5)),
    "fixed-rope-crane": lambda run: (_poles(run, 0).real.max(), sqrt(GRAVITY / (5.0 - 4.0))),
    "trailers": trailers,
    "rolling-disc": rolling_disc,
    "ball-on-turntable": ball_on_turntable,
    "slung-load": slung_load,
    "slung-load-3d": slung_load_3d,
    "flexible-joint": flexible_joint,
    "elastic-link": elastic_link,
    "double-pendulum": double_pendulum,
    "four-bar": four_bar,
    "cable-robot": cable_robot,
    "reaction-wheels": reaction_wheels,
    "six-axis-arm": six_axis_arm,
    "constant-jerk": constant_jerk,
    "tumbling-satellite": tumbling_satellite,
    "jerkless-trolley": lambda run: (_largest(run, "theta"), 2 * np.arctan(4.0 / GRAVITY)),
}
ENDS = {"appell-hamel-squared": closed_forms.WHEEL_STOPS, "constant-speed-horizontal": 5.0 / GRAVITY}  # s


def quoted(name, number):
    """Whether the sentence of a scene about its number has it, to the digits that it shows."""
    printed = re.findall(r"\d+(?:\.\d+)?", gallery[name].number)
    return any(float(text) == pytest.approx(number, rel=5e-4) for text in printed)
