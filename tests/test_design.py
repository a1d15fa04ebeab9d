"""Parameters of programs of least actuation or time: closed forms, brute force on closed forms, limits, bad input."""

from dataclasses import FrozenInstanceError

import casadi as ca
import closed_forms as known
import numpy as np
import pytest
from refusals import refused, warned
from scipy.integrate import trapezoid
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize_scalar

import servoctl as sv
from servoctl.gallery.two_links import two_link_arm
from servoctl.inversion.design import Motions, Search, _span


def curve(times, points, k):
    """The spline of class C^k at rest at both ends, by scipy."""
    rest = [(j, np.zeros(np.shape(points)[1:])) for j in range(1, k + 1)]
    return make_interp_spline(times, np.asarray(points, dtype=float), k=2 * k + 1, bc_type=(rest, rest))


def mass(path, scale=lambda p: 1.0, **values):
    """A driven mass, of which x follows scale(p) times path(p)."""
    p = sv.parameters(m=2.0, **values)
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, x), actuators={"push": x}, parameters=p)
    return sv.derive(mechanism, sv.Program({"X": x - scale(p) * q.references(X=path(p)).X})), p


def through(times=(0.0, 0.8, 2.0), smoothness=2):
    """From 0 to 1 m through a via point."""
    return mass(lambda p: sv.paths.spline(times, [0.0, p.via, 1.0], smoothness=smoothness), via=0.9)


@pytest.fixture(scope="module")
def crane():
    return crane_through()


def crane_through():
    """The crane's model and parameters: its load goes from (0, 4) through (via_x, via_z) in the middle of a time T to (5, 2) m."""
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81, via_x=2.0, via_z=2.5, T=6.0)
    q = sv.coordinates("x l theta")
    x, l, theta = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    S = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load)
    potential = -p.m_load * p.g * load[1]
    mechanism = sv.Mechanism(q, S, potential=potential, actuators={"trolley": x, "hoist": l}, parameters=p)
    points = [[0.0, 4.0], [p.via_x, p.via_z], [5.0, 2.0]]
    path = sv.paths.spline([0.0, 0.5, 1.0], points, smoothness=4).at_rate(1 / p.T)
    r = q.references(X=path[0], Z=path[1])
    return sv.derive(mechanism, sv.Program({"X": load[0] - r.X, "Z": load[1] - r.Z})), p


def crane_forces(via_x, via_z, T=6.0, t=None):
    """Forces of the crane's trolley and hoist in closed form."""
    t = np.linspace(0.0, T, 601) if t is None else t
    spline = curve(np.array([0.0, 0.5, 1.0]) * T, [[0.0, 4.0], [via_x, via_z], [5.0, 2.0]], 4)
    c = known.crane(lambda k: spline(t, nu=k).T, [10.0], 5.0, 100.0)
    return {"trolley": c["force"][0], "hoist": c["hoist"]}


def aircraft():
    """The centre of mass of the aircraft passes a via point: hyperbolic internal dynamics, a bounded motion."""
    p = sv.parameters(M=50.0, J=25.0, l=1.0, h=0.1, tilt=np.radians(5.0), g=9.81, via=0.6, T=4.0)
    q = sv.coordinates("x z theta")
    x, z, theta = q
    across, along = ca.vertcat(ca.cos(theta), ca.sin(theta)), ca.vertcat(-ca.sin(theta), ca.cos(theta))
    arm = p.l * ca.cos(p.tilt) + p.h * ca.sin(p.tilt)
    thrust = {
        f"u{i}": ca.vertcat(along + side * ca.sin(p.tilt) * across, side * arm) for i, side in ((1, 1.0), (2, -1.0))
    }
    body = sv.rigid_body(q, p.M, (0, 0, p.J), position=(x, z), rates=(0, 0, q.d(1)[2]))
    mechanism = sv.Mechanism(q, gibbs=body, potential=p.M * p.g * z, actuators=thrust, parameters=p)
    path = sv.paths.spline([0.0, 0.5, 1.0], [[0.0, 0.0], [2.5, p.via], [5.0, 2.0]], smoothness=4).at_rate(1 / p.T)
    r = q.references(X=path[0], Z=path[1])
    return sv.derive(mechanism, sv.Program({"X": x - r.X, "Z": z - r.Z})), p


def hanging():
    """A cart pulls a damped pendulum: internal dynamics that are stable, integrated forward."""
    p = sv.parameters(M=2.0, m=1.0, l=0.5, g=9.81, d=0.3, via=0.4, T=2.0)
    q = sv.coordinates("x theta")
    x, theta = q
    bob = ca.vertcat(x + p.l * ca.sin(theta), -p.l * ca.cos(theta))
    S = sv.particle(q, p.M, x) + sv.particle(q, p.m, bob)
    forces = {"theta": -p.d * q.d(1)[1]}
    mechanism = sv.Mechanism(
        q, S, potential=p.m * p.g * bob[1], forces=forces, actuators={"pull": x}, parameters=p
    )  # fmt: skip
    r = q.references(X=sv.paths.spline([0.0, 0.5, 1.0], [0.0, p.via, 1.0], smoothness=3).at_rate(1 / p.T))
    return sv.derive(mechanism, sv.Program({"X": x - r.X})), p


def wheel_on_a_line():
    """A wheel that rolls, with its rate as quasi-velocity; forces depend on speed."""
    p = sv.parameters(m=2.0, r=0.5, via=0.7, T=2.0)
    q = sv.coordinates("x").with_quasi_velocities("spin", [[0.5]])
    (spin,) = q.w()
    mechanism = sv.Mechanism(
        q, kinetic=1.5 * p.m * (p.r * spin) ** 2 / 2, forces={"spin": -(spin**3)}, actuators={"motor": [1.0]}, parameters=p
    )  # fmt: skip
    r = q.references(X=sv.paths.spline([0.0, 0.5, 1.0], [0.0, p.via, 1.0], smoothness=3).at_rate(1 / p.T))
    return sv.derive(mechanism, sv.Program({"X": list(q)[0] - r.X})), p


# closed forms --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("smoothness", [2, 3])
def test_the_via_point_of_least_rms_is_a_projection(smoothness):
    """u = m (a'' + v b''): v = -<a'', b''>/<b'', b''>, with splines a through (0, 0, 1) and b through (0, 1, 0)."""
    model, _ = through(smoothness=smoothness)
    found = sv.design(model, {"via": (-1.0, 2.0)}, (0.0, 2.0))
    x, w = np.polynomial.legendre.leggauss(20)
    t = np.concatenate([0.4 + 0.4 * x, 1.4 + 0.6 * x])
    w = np.concatenate([0.4 * w, 0.6 * w])
    a, b = (curve((0.0, 0.8, 2.0), points, smoothness)(t, nu=2) for points in ((0, 0, 1), (0, 1, 0)))
    via = -(w @ (a * b)) / (w @ b**2)
    assert found.values["via"] == pytest.approx(via, abs=1e-9)
    assert found.cost == pytest.approx(2.0 * np.sqrt(w @ (a + via * b) ** 2 / 2.0), rel=1e-10)
    assert found.before == pytest.approx(2.0 * np.sqrt(w @ (a + 0.9 * b) ** 2 / 2.0), rel=1e-10)
    assert found.gain < 1e-8 and not found.binding and found.proof.passed


def test_the_via_point_of_least_peak_is_that_of_a_fine_grid():
    model, _ = through()
    found = sv.design(model, {"via": (-1.0, 2.0)}, (0.0, 2.0), "peak", of={"push": 4.0})
    t = np.linspace(0.0, 2.0, 40001)
    a, b = (curve((0.0, 0.8, 2.0), points, 2)(t, nu=2) for points in ((0, 0, 1), (0, 1, 0)))
    least = minimize_scalar(lambda v: np.abs(2.0 * (a + v * b)).max() / 4.0, bounds=(-1.0, 2.0), method="bounded",
                            options={"xatol": 1e-12})  # fmt: skip
    assert found.cost == pytest.approx(least.fun, rel=1e-6)
    assert found.values["via"] == pytest.approx(least.x, abs=1e-5)
    assert max(abs(v) for _, v in found.plan.extrema("push")) == pytest.approx(4.0 * found.cost, rel=1e-12)


@pytest.mark.parametrize("first", [3.0, 9.0])
def test_the_duration_under_a_force_limit_is_the_closed_form(first):
    """S7 over d in T needs m d c/T², c = max |S''|: from a duration that is too short, or too long."""
    model, p = mass(lambda p: sv.paths.rest_to_rest(0.0, 3.0, p.T, smoothness=3), T=first)
    found = sv.design(model, {"T": (1.0, 20.0)}, (0.0, p.T), "time", limits={"push": 4.0})
    c = np.abs(known.blend(np.linspace(0.0, 1.0, 200_001), 2, 3)).max()
    assert found.cost == found.values["T"] == pytest.approx(np.sqrt(2.0 * 3.0 * c / 4.0), rel=1e-6)
    assert {("push", "lower"), ("push", "upper")} >= set(found.binding) and found.binding
    assert found.before == first and np.abs(found.plan["push"]).max() <= 4.0
    assert found.plan.t[-1] == found.cost and found.proof.passed


def test_least_rms_under_a_limit():
    """The via point goes as far towards the free minimum as a limit of the push to one side lets it."""
    model, _ = through()
    free = sv.design(model, {"via": (-1.0, 2.0)}, (0.0, 2.0))
    most = 0.95 * free.plan["push"].max()
    found = sv.design(model, {"via": (-1.0, 2.0)}, (0.0, 2.0), limits={"push": (None, most)})
    assert found.plan["push"].max() <= most and found.binding == (("push", "upper"),) and found.cost > free.cost
    t = np.linspace(0.0, 2.0, 4001)
    a, b = (curve((0.0, 0.8, 2.0), points, 2)(t, nu=2) for points in ((0, 0, 1), (0, 1, 0)))
    allowed = [v for v in np.linspace(-1.0, 2.0, 6001) if 2.0 * (a + v * b).max() <= most]
    assert found.values["via"] == pytest.approx(min(allowed, key=lambda v: abs(v - free.values["via"])), abs=1e-3)


# exact derivatives ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, signals, names",
    [
        ("crane", {"trolley": 1.0, "hoist": 1.0, "dtheta": 1.0}, ("via_x", "T", "m_load")),
        ("aircraft", {"u1": 1.0, "theta": 1.0}, ("via", "T")),
        ("hanging", {"pull": 1.0, "theta": 1.0}, ("via", "T", "d")),
        ("wheel", {"motor": 1.0, "x": 1.0, "spin": 1.0, "dspin": 1.0}, ("via", "T")),
    ],
)
def test_derivatives_equal_differences(name, signals, names, request):
    """Of mean squares and of signals at nodes that move with the duration: flat, bounded, forward, quasi-velocities."""
    make = {"aircraft": aircraft, "hanging": hanging, "wheel": wheel_on_a_line}
    model, p = make[name]() if name in make else request.getfixturevalue(name)
    motions = Motions(model, names, _span(model, (0.0, p.T), dict.fromkeys(names)), ({}, {"l": 4.0} if name == "crane" else None))
    ranges = motions.numbers[:, None] * [[0.8, 1.2]]
    search, h = Search(motions, ranges, "peak", signals, {}), 1e-3
    at = search.at(middle := np.full(len(names), 0.5))
    for i, step in enumerate(h * np.eye(len(names))):
        beyond = {s: search.at(middle + s * step) for s in (-2, -1, 1, 2)}
        for value, slope in (("squares", at.square_slopes[:, i]), ("values", at.slopes[:, :, i])):
            y = {s: getattr(local, value) for s, local in beyond.items()}
            difference = (8 * (y[1] - y[-1]) - (y[2] - y[-2])) / (12 * h)
            assert np.abs(difference - slope).max() < 1e-6 * np.abs(slope).max(), (names[i], value)


# brute force ---------------------------------------------------------------------------------------------------------


def test_the_crane_is_as_good_as_a_grid_of_its_closed_form(crane):
    model, _ = crane
    vary = {"via_x": (0.5, 4.5), "via_z": (2.0, 3.5)}
    for minimise, cost in (
        ("rms", lambda u: np.sqrt(np.mean((u[1:] ** 2 + u[:-1] ** 2) / 2))),
        ("peak", lambda u: np.abs(u).max()),
    ):
        found = sv.design(model, vary, (0.0, 6.0), minimise, of="trolley", guess={"l": 4.0})
        best, centre, width = np.inf, np.array([2.5, 2.75]), np.array([2.0, 0.75])
        for _ in range(8):  # each grid finer, about the best point of the one before
            axes = [np.clip(c + w * np.linspace(-1, 1, 7), *vary[n]) for c, w, n in zip(centre, width, vary, strict=True)]
            grid = [(cost(crane_forces(x, z)["trolley"]), x, z) for x in axes[0] for z in axes[1]]
            best, *centre = min(grid)
            centre, width = np.array(centre), width / 2
        assert found.cost < found.before and found.cost == pytest.approx(best, rel=1e-4)
        assert [found.values[n] for n in vary] == pytest.approx(centre, abs=0.05)
        assert ("via_z", "upper") in found.binding
        forces = crane_forces(*found.values.values(), t=found.plan.t)
        assert np.abs(found.plan["trolley"] - forces["trolley"]).max() < 1e-8 * np.abs(forces["hoist"]).max()


def test_the_least_time_of_the_crane_is_that_of_a_grid(crane):
    """For each via point the duration is stretched until a force meets its limit."""
    model, p = crane
    limits = {"trolley": 200.0, "hoist": (-1400.0, 0.0)}
    vary = {"via_x": (0.5, 4.5), "via_z": (2.0, 3.5), "T": (2.0, 10.0)}
    found = sv.design(model, vary, (0.0, p.T), "time", limits=limits, guess={"l": 4.0})
    assert np.abs(found.plan["trolley"]).max() <= 200.0 and found.plan["hoist"].min() >= -1400.0
    assert {name for name, _ in found.binding} & set(limits) and found.cost < 6.0

    def within(x, z, T):
        u = crane_forces(x, z, T)
        return np.abs(u["trolley"]).max() <= 200.0 and -1400.0 <= u["hoist"].min() <= u["hoist"].max() <= 0.0

    x, z, T = found.values.values()
    assert within(x, z, T * (1 + 1e-4)) and not within(x, z, T * (1 - 1e-4))
    near = [(x + a, np.clip(z + b, 2.0, 3.5)) for a in (-0.1, -0.01, 0, 0.01, 0.1) for b in (-0.1, -0.01, 0, 0.01)]
    anywhere = [(a, b) for a in np.linspace(0.5, 4.5, 17) for b in np.linspace(2.0, 3.5, 7)]
    assert not any(within(a, b, T * (1 - 1e-4)) for a, b in near + anywhere)


def arm_torques(via):
    """Torques (2, N) of the gallery's arm, whose end goes from (0.6, 0.4) through a via point to (0.2, 0.9) in 1 s."""
    t = np.linspace(0.0, 1.0, 401)
    end = curve((0.0, 0.5, 1.0), [[0.6, 0.4], via, [0.2, 0.9]], 2)
    m1, m2, l1, l2, I1, I2, g = 4.0, 3.0, 0.6, 0.5, 0.12, 0.07, 9.81
    x, y = end(t).T
    c2 = (x**2 + y**2 - l1**2 - l2**2) / (2 * l1 * l2)
    if np.abs(c2).max() >= 1.0:
        return np.full((2, 1), np.inf)
    q2 = np.arccos(c2)
    q1 = np.arctan2(y, x) - np.arctan2(l2 * np.sin(q2), l1 + l2 * c2)
    a, b = l1 * np.exp(1j * q1), l2 * np.exp(1j * (q1 + q2))
    v, acceleration = (end(t, nu=k) @ [1.0, 1j] for k in (1, 2))
    J = np.array([[-(a + b).imag, -b.imag], [(a + b).real, b.real]])
    w = np.linalg.solve(J.transpose(2, 0, 1), np.array([v.real, v.imag]).T[:, :, None])[:, :, 0].T
    rest = acceleration + a * w[0] ** 2 + b * (w[0] + w[1]) ** 2
    d2 = np.linalg.solve(J.transpose(2, 0, 1), np.array([rest.real, rest.imag]).T[:, :, None])[:, :, 0].T
    r1, r2 = l1 / 2, l2 / 2
    h = m2 * l1 * r2 * np.sin(q2)
    M12 = I2 + m2 * (r2**2 + l1 * r2 * c2)
    M11 = I1 + I2 + m1 * r1**2 + m2 * (l1**2 + r2**2 + 2 * l1 * r2 * c2)
    fall2 = m2 * g * r2 * np.cos(q1 + q2)
    shoulder = M11 * d2[0] + M12 * d2[1] - h * w[1] * (2 * w[0] + w[1]) + (m1 * r1 + m2 * l1) * g * np.cos(q1) + fall2
    return np.array([shoulder, M12 * d2[0] + (I2 + m2 * r2**2) * d2[1] + h * w[0] ** 2 + fall2])


@pytest.fixture(scope="module")
def arm():
    """The model of this arm; its reach is 1.1 m."""
    mechanism, _ = two_link_arm()
    mechanism.parameters = p = mechanism.parameters.extended(vx=0.5, vy=0.6)
    path = sv.paths.spline([0.0, 0.5, 1.0], [[0.6, 0.4], [p.vx, p.vy], [0.2, 0.9]], smoothness=2)
    r, ends = mechanism.q.references(via_x=path[0], via_y=path[1]), mechanism.outputs
    return sv.derive(mechanism, sv.Program({"X": ends["X_end"] - r.via_x, "Y": ends["Y_end"] - r.via_y}))


def test_the_via_point_of_least_peak_torque_is_that_of_a_grid(arm):
    """Of the shoulder at 100 and the elbow at 40 N m; part of the range is beyond the reach of the arm."""
    sizes, guess = {"shoulder": 100.0, "elbow": 40.0}, {"q1": 0.2, "q2": 1.0}
    found = sv.design(arm, {"vx": (0.2, 0.9), "vy": (0.4, 0.9)}, (0.0, 1.0), "peak", of=sizes, guess=guess)

    def peak(via):
        return (np.abs(arm_torques(via)).max(axis=1) / [100.0, 40.0]).max()

    best = min((peak((x, y)), x, y) for x in np.linspace(0.2, 0.9, 15) for y in np.linspace(0.4, 0.9, 11))
    for width in 0.05 * 0.5 ** np.arange(8):  # each grid finer, about the best point of the one before
        offsets = width * np.linspace(-1.0, 1.0, 7)
        best = min((peak((best[1] + a, best[2] + b)), best[1] + a, best[2] + b) for a in offsets for b in offsets)
    assert best[0] * (1 - 1e-4) <= found.cost <= best[0] * (1 + 1e-4)
    assert found.cost == pytest.approx(peak(tuple(found.values.values())), rel=1e-4)


def test_a_search_goes_round_parameters_without_a_motion(monkeypatch):
    """The cost 1 + (√(via - 0.5) - 0.1)² of a distance is least at 0.51, and Newton's steps lead below 0.5."""
    missed, at = [], Search.at

    def recorded(self, v):
        try:
            return at(self, v)
        except sv.errors.ServoError:
            missed.append(v)
            raise

    monkeypatch.setattr(Search, "at", recorded)
    model, _ = mass(lambda p: sv.paths.rest_to_rest(0, 1 + (ca.sqrt(p.via - 0.5) - 0.1) ** 2, 2.0), via=2.0)
    found = sv.design(model, {"via": (-5.0, 5.0)}, (0.0, 2.0))
    assert missed and found.proof.passed and found.values["via"] == pytest.approx(0.51, abs=1e-5)


def test_parameters_without_a_motion_at_the_start_are_refused():
    model, _ = mass(lambda p: sv.paths.rest_to_rest(0, 1, 2.0), lambda p: ca.sqrt(p.via - 0.5), via=2.0)
    with refused(sv.errors.InconsistentStart):
        sv.design(model.with_parameters(via=0.4), {"via": (-5.0, 5.0)}, (0.0, 2.0))
    model, _ = mass(lambda p: sv.paths.rest_to_rest(0, ca.sqrt(p.via - 0.5), 2.0), via=2.0)
    with refused(sv.errors.SpecificationError):
        model.with_parameters(via=0.4)


# bounded and forward motions, ideal programs --------------------------------------------------------------------------


def test_bounded_motions_are_designed():
    """The plan begins ahead of the program; its limits hold over the whole window."""
    model, _ = aircraft()
    found = sv.design(model, {"via": (0.0, 2.0)}, (0.0, 4.0), "peak")
    limited = sv.design(found.model, {"via": (0.0, 2.0)}, (0.0, 4.0), "peak", limits={"theta": (None, 0.322)})
    assert found.plan["theta"].max() > 0.322 >= limited.plan["theta"].max() and limited.cost > found.cost
    assert found.plan.method == "bounded" and found.plan.t[0] < 0.0 and found.proof.passed
    peaks = []
    for via in found.values["via"] + np.array([-0.02, 0.02]):
        other = model.with_parameters(via=via)
        run = sv.simulate(other, found.plan.start, (0.0, 4.0), "bounded")
        peaks.append(max(np.abs(run[u]).max() for u in ("u1", "u2")))
    assert found.cost < min(peaks) and found.cost < found.before


def test_forward_motions_are_designed():
    model, _ = hanging()
    found = sv.design(model, {"via": (0.0, 1.0)}, (0.0, 2.0), limits={"theta": np.radians(30.0)})
    costs = []
    for via in found.values["via"] + np.array([-0.01, 0.0, 0.01]):
        other = model.with_parameters(via=via)
        run = sv.simulate(other, other.start(), (0.0, 2.0))
        costs.append(np.sqrt(trapezoid(run["pull"] ** 2, run.t) / 2.0))
    assert found.cost == pytest.approx(costs[1], rel=1e-5) and costs[1] < min(costs[0], costs[2])
    assert np.abs(found.plan["theta"]).max() <= np.radians(30.0)


def test_ideal_programs_are_designed_by_their_reaction():
    q = sv.coordinates("x")
    p = sv.parameters(via=0.9)
    (x,) = q
    r = q.references(X=sv.paths.spline((0.0, 1.0, 2.0), [0.0, p.via, 1.0]))
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, x), parameters=p)
    model = sv.derive(mechanism, sv.Program({"X": x - r.X}, by="ideal"))
    found = sv.design(model, {"via": (0.0, 1.0)}, (0.0, 2.0))
    assert found.values["via"] == pytest.approx(0.5, abs=1e-9) and found.proof.passed


def cart(upright):
    """A cart with a pendulum without damping, which moves steadily from t = 0 on."""
    p = sv.parameters(M=2.0, m=1.0, l=0.5, g=9.81, v=0.3)
    q = sv.coordinates("x theta")
    x, theta = q
    bob = ca.vertcat(x + p.l * ca.sin(theta), -p.l * ca.cos(theta))
    S = sv.particle(q, p.M, x) + sv.particle(q, p.m, bob)
    mechanism = sv.Mechanism(q, S, potential=p.m * p.g * bob[1], actuators={"pull": x}, parameters=p)
    return sv.derive(mechanism, sv.Program({"X": x - p.v * ca.sin(3 * q.t)})), {"theta": np.pi if upright else 0.0}


def test_unstable_motions_without_a_rest_are_refused_and_marginal_ones_designed():
    model, guess = cart(upright=True)
    with refused(sv.errors.UnstableInternalDynamics, "dwell"):
        sv.design(model, {"v": (0.1, 0.5)}, (0.0, 3.0), guess=guess)
    model, guess = cart(upright=False)
    found = sv.design(model, {"v": (0.1, 0.5)}, (0.0, 3.0), guess=guess)
    assert found.values["v"] == pytest.approx(0.1) and found.binding == (("v", "lower"),) and found.proof.passed


def test_units_and_the_begin_of_the_span_do_not_matter():
    """Millimetres and milliseconds; from 1 to 1 + T, with dwells before and after it; by symmetry through 0.5."""
    u, s = 1e3, 1e-3
    model, p = mass(
        lambda p: sv.paths.spline([s, 1.0 + s, 2.0 + s], [0.0, p.via, u], smoothness=3).at_rate(2 / p.T),
        T=3.0 * s,
        via=0.6 * u,
    )
    ranges, span = {"T": (s, 20.0 * s), "via": (0.0, u)}, (0.5 * s, 1.5 * s + p.T)
    found = sv.design(model, ranges, span, "time", limits={"push": 4.0 * u / s**2})
    peak = np.abs(curve((0.0, 0.5, 1.0), (0.0, 0.5, 1.0), 3)(np.linspace(0.0, 1.0, 200_001), nu=2)).max()
    assert found.values["T"] / s == pytest.approx(np.sqrt(2.0 * peak / 4.0), rel=1e-6)
    assert found.values["via"] / u == pytest.approx(0.5, abs=1e-6)
    assert found.plan.t[-1] == pytest.approx(1.5 * s + found.values["T"], rel=1e-12)


# the result ----------------------------------------------------------------------------------------------------------


def test_a_design_is_a_value_with_its_model_and_plan():
    model, _ = through()
    found = sv.design(model, {"via": (-1.0, 2.0)}, (0.0, 2.0))
    assert found.model.numbers == model.numbers | found.values
    again = sv.simulate(found.model, found.model.start(), (0.0, 2.0))
    assert np.abs(again["push"] - found.plan["push"]).max() < 1e-12
    assert 1 <= len(repr(found).splitlines()) <= 12 and "local minimum" in repr(found) and "via" in repr(found)
    with pytest.raises(FrozenInstanceError):
        found.cost = 0.0
    assert sv.design(found.model, {"via": (-1.0, 2.0)}, (0.0, 2.0)).motions < found.motions


def test_a_kink_at_the_minimum_is_not_called_one():
    model, _ = mass(lambda p: (1.0 + ca.fabs(p.via)) * sv.paths.rest_to_rest(0.0, 1.0, 2.0, smoothness=2), via=0.9)
    with warned("inconclusive"):
        found = sv.design(model, {"via": (-1.0, 2.0)}, (0.0, 2.0))
    assert "inconclusive" in found.message and found.cost <= found.before


def test_a_force_that_jumps_between_knots_is_integrated():
    """A narrow blend of a load, 5 N from 1 s on, where no knot is: u = x'' + 5, orthogonal to no path."""
    p = sv.parameters(via=0.9)
    q = sv.coordinates("x")
    (x,) = q
    load = {"x": -2.5 * (1 + ca.tanh((q.t - 1.0) / 1e-6))}
    mechanism = sv.Mechanism(q, sv.particle(q, 1.0, x), forces=load, actuators={"push": x}, parameters=p)
    r = q.references(X=sv.paths.spline((0.0, 0.8, 2.0), [0.0, p.via, 1.0]))
    found = sv.design(sv.derive(mechanism, sv.Program({"X": x - r.X})), {"via": (-2.0, 2.0)}, (0.0, 2.0))
    t = (np.arange(200_000) + 0.5) * 1e-5
    a, b = (curve((0.0, 0.8, 2.0), points, 2)(t, nu=2) for points in ((0, 0, 1), (0, 1, 0)))
    via = -((a + 5.0 * (t > 1.0)) @ b) / (b @ b)
    assert found.values["via"] == pytest.approx(via, abs=1e-3)
    assert found.cost == pytest.approx(np.sqrt(np.mean((a + via * b + 5.0 * (t > 1.0)) ** 2)), rel=1e-3)


def test_limits_that_no_parameters_keep_are_refused_with_the_least_excess():
    model, _ = through()
    least = sv.design(model, {"via": (-1.0, 2.0)}, (0.0, 2.0), "peak").cost
    with refused(sv.errors.LimitExceeded, name="push") as caught:
        sv.design(model, {"via": (-1.0, 2.0)}, (0.0, 2.0), limits={"push": 0.9 * least})
    assert caught.value.details["excess"] == pytest.approx(1.0 / 0.9 - 1.0, rel=1e-3)


def test_bad_input_is_refused():
    model, p = through()
    span, vary = (0.0, 2.0), {"via": (-1.0, 2.0)}
    for arguments, kind, details in (
        (({}, span), sv.errors.SpecificationError, {}),
        (({"via": (1.0, 2.0)}, span), sv.errors.SpecificationError, {"name": "via", "value": 0.9, "range": (1.0, 2.0)}),
        (({"via": (None, 2.0)}, span), sv.errors.SpecificationError, {"name": "via"}),
        (({"vai": (0.0, 2.0)}, span), sv.errors.NameUnknown, {"name": "vai", "match": "via"}),
        ((vary, span, "energy"), sv.errors.NameUnknown, {"name": "energy"}),
        ((vary, span, "rms", "pull"), sv.errors.NameUnknown, {"name": "pull"}),
        ((vary, span, "rms", {"push": 0.0}), sv.errors.SpecificationError, {}),
        ((vary, span, "time"), sv.errors.SpecificationError, {"minimise": "time"}),
        ((vary, span, "rms", None, {"pull": 1.0}), sv.errors.NameUnknown, {"name": "pull"}),
        ((vary, span, "rms", None, {"push": (2.0, 1.0)}), sv.errors.SpecificationError, {"name": "push"}),
        ((vary, 2.0), sv.errors.SpecificationError, {"t_span": 2.0}),
        ((vary, (0.0, "end")), sv.errors.SpecificationError, {}),
        ((vary, (0.0, ca.SX.sym("T"))), sv.errors.NameUnknown, {"name": "T"}),
        ((vary, (0.0, -p.via)), sv.errors.SpecificationError, {"t1": -0.9}),
    ):
        with refused(kind, **details):
            sv.design(model, *arguments)
    with refused(sv.errors.SpecificationError, name="model"):
        sv.design(model.reduction, vary, span)
