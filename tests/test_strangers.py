"""Three machines as a stranger wrote them, from three guesses each: forces against references written by hand."""

import warnings

import casadi as ca
import numpy as np
import pytest
from numpy.polynomial import chebyshev

import servoctl as sv

FLAT, INTEGRATED = 1e-9, 1e-7  # of a force's size: instant by instant; ten times the tolerance of an integration
G = 9.81


def planned(machine, guess, duration):
    """The plan of a machine's program from a guess, which passes, and what is said of it."""
    model = sv.derive(*machine, guess)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        plan = sv.simulate(model, model.start(guess=guess), (0.0, duration))
    verified = sv.verify(plan)
    assert verified.passed and len(caught) == len(verified.remarks)
    return plan, verified.remarks


def blend(t, duration):
    """From 0 to 1 with four derivatives at rest, SX, for 0 <= t <= duration."""
    s = t / duration
    return s**5 * (126 - 420 * s + 540 * s**2 - 315 * s**3 + 70 * s**4)


def rate(e, t, y=None, f=None):
    """The total time derivative of an expression of t, and of y with y' = f."""
    return ca.jacobian(e, t) + (0 if y is None else ca.jtimes(e, y, f))


def collocated(ode, begin, ends, times, degree=60):
    """The solution of a stiff y' = ode(t, y), at the times, by Chebyshev polynomials between ends; `begin` is y there."""
    nodes, n, found = -np.cos(np.pi * np.arange(1, degree + 1) / degree), len(begin), []
    for a, b in zip(ends[:-1], ends[1:], strict=True):
        c, values = ca.MX.sym("c", degree + 1, n), ca.DM(chebyshev.chebvander(nodes, degree))
        slopes = ca.DM(chebyshev.chebvander(nodes, degree - 1) @ chebyshev.chebder(np.eye(degree + 1))) * 2 / (b - a)
        left = slopes @ c - ode.map(degree)(a + (b - a) * (1 + nodes[None]) / 2, (values @ c).T).T
        rows = ca.vertcat(ca.vec(left), (ca.DM(chebyshev.chebvander(-1.0, degree)) @ c).T - begin)
        solution = ca.rootfinder(
            "c",
            "newton",
            {"x": ca.vec(c), "g": rows},
            {"abstol": 1e-15, "abstolStep": 1e-17, "max_iter": 12, "error_on_fail": False},
        )(x0=0.0)["x"]
        here = times[(times >= a) & ((times < b) | (b == ends[-1]))]
        series = np.array(solution).reshape(n, -1).T
        found.append(chebyshev.chebval(2 * (here - a) / (b - a) - 1, series))
        begin = chebyshev.chebval(1.0, series)
    return np.hstack(found)


def off(plan, names, values):
    """The largest difference of forces (m, N) from those of a plan, beside the size of each."""
    forces = np.array([plan[name] for name in names])
    return (np.abs(forces - values).max(axis=1) / np.abs(values).max(axis=1)).max()


# a crane that slews and luffs, its rope damped in both angles ---------------------------------------------------------

BOOM, M_BOOM, M_LOAD, J_SLEW, M_DRUM, C = 6.0, 80.0, 100.0, 500.0, 10.0, 2.0
BEGIN, END, LASTS = (4.0, 0.0, 1.5), (1.5, 3.5, 2.5), 6.0


def rope(theta, phi):
    return ca.vertcat(ca.sin(theta), -ca.cos(theta) * ca.sin(phi), -ca.cos(theta) * ca.cos(phi))


def slewing_crane(damping=C):
    q = sv.coordinates("slew luff l theta phi")
    slew, luff, l, theta, phi = q
    head = BOOM * ca.vertcat(ca.cos(luff) * ca.cos(slew), ca.cos(luff) * ca.sin(slew), ca.sin(luff))
    load = head + l * rope(theta, phi)
    S = sv.particle(q, M_BOOM, head / 2) + sv.particle(q, M_LOAD, load) + sv.particle(q, M_DRUM, l)
    S += 0.5 * J_SLEW * q.d(2)[0] ** 2
    mechanism = sv.Mechanism(
        q, S, potential=G * (M_BOOM * head[2] / 2 + M_LOAD * load[2]),
        forces={"theta": -damping * q.d(1)[3], "phi": -damping * q.d(1)[4]},
        actuators={"slew": slew, "luff": luff, "hoist": l},
    )  # fmt: skip
    path = sv.paths.rest_to_rest(BEGIN, END, duration=LASTS, smoothness=4)
    r = q.references(X=path[0], Y=path[1], Z=path[2])
    return mechanism, sv.Program({name: load[i] - r[name] for i, name in enumerate("XYZ")})


def crane_forces(times):
    """The balances of the angles, c θ' = -m l (a + g)·∂e/∂θ, by collocation; the others by differentiation."""
    t, y = ca.SX.sym("t"), ca.SX.sym("y", 2)
    load = ca.DM(BEGIN) + blend(t, LASTS) * (ca.DM(END) - ca.DM(BEGIN))
    pull = M_LOAD * (rate(rate(load, t), t) + ca.DM([0, 0, G]))
    e = rope(y[0], y[1])
    along = ca.dot(load, e)
    l = along + ca.sqrt(along**2 - ca.dot(load, load) + BOOM**2)  # the lower of both, |load - l e| = BOOM
    f = -l / C * ca.jacobian(e, y).T @ pull
    head = load - l * e
    luff, slew = ca.asin(head[2] / BOOM), ca.atan2(head[1], head[0])
    d2slew, d2l = (rate(rate(part, t, y, f), t, y, f) for part in (slew, l))
    arm = rate(rate(head / 2, t, y, f), t, y, f) + ca.DM([0, 0, G])
    slopes = [ca.vertcat(-head[1], head[0], 0), ca.vertcat(
        -ca.sin(luff) * ca.cos(slew), -ca.sin(luff) * ca.sin(slew), ca.cos(luff)) * BOOM]  # fmt: skip
    torques = [ca.dot(M_BOOM * arm / 2 + pull, slope) for slope in slopes]
    forces = ca.vertcat(torques[0] + J_SLEW * d2slew, torques[1], ca.dot(pull, e) + M_DRUM * d2l)
    angles = collocated(ca.Function("f", [t, y], [f]), np.zeros(2), (0.0, 0.02, LASTS), times)
    return np.array(ca.Function("u", [t, y], [forces])(times[None], angles))


@pytest.mark.parametrize("guess", [
    {"l": 3.0, "luff": 0.8}, {"l": 3.3, "luff": 0.7, "slew": 0.1}, {"l": 3.0, "luff": 0.84, "theta": 0.05, "dl": 1.0},
])  # fmt: skip
def test_a_slewing_crane_starts_at_rest_and_has_the_forces_of_its_damped_ropes(guess):
    """From a luff of 0.80, right 0.841, it once started with dl = 127 m/s, M_luff = -1.7e7 N m."""
    plan, remarks = planned(slewing_crane(), guess, LASTS)
    assert not remarks and not plan.jets[5:, 0].any()
    assert off(plan, ("slew_input", "luff_input", "hoist"), crane_forces(plan.t)) < INTEGRATED


# arms of two links, point masses at the elbow and at the tip ----------------------------------------------------------

LINKS, MASSES = (0.8, 0.6), (4.0, 2.0)


def links(q1, q2):
    elbow = LINKS[0] * ca.vertcat(ca.cos(q1), ca.sin(q1))
    return elbow, elbow + LINKS[1] * ca.vertcat(ca.cos(q1 + q2), ca.sin(q1 + q2))


def arm_posture(t, tip, bend):
    """Angles of both joints, and the torques that move the links, from the tip as an expression of t."""
    a, b = LINKS
    q2 = bend * ca.acos((ca.dot(tip, tip) - a**2 - b**2) / (2 * a * b))
    q1 = ca.atan2(tip[1], tip[0]) - ca.atan2(b * ca.sin(q2), a + b * ca.cos(q2))
    elbow = a * ca.vertcat(ca.cos(q1), ca.sin(q1))
    pulls = [m * (rate(rate(r, t), t) + ca.DM([0, G])) for m, r in zip(MASSES, (elbow, tip), strict=True)]
    about = [r[0] * f[1] - r[1] * f[0] for r, f in zip((elbow, tip, tip - elbow), (*pulls, pulls[1]), strict=True)]
    return ca.vertcat(q1, q2), ca.vertcat(about[0] + about[1], about[2])


STIFF, ROTOR = (400.0, 250.0), (0.3, 0.2)
LINE, STROKE = ((0.9, 0.3), (0.3, 0.9)), 2.0


def elastic_arm():
    """Each joint is driven through a spring; the tip follows a line."""
    q = sv.coordinates("shoulder elbow motor1 motor2")
    S = sum(sv.particle(q, m, r) for m, r in zip(MASSES, links(q[0], q[1]), strict=True))
    S += sum(0.5 * j * q.d(2)[2 + i] ** 2 for i, j in enumerate(ROTOR))
    heights = [m * G * r[1] for m, r in zip(MASSES, links(q[0], q[1]), strict=True)]
    U = sum(heights) + sum(0.5 * k * (q[i] - q[2 + i]) ** 2 for i, k in enumerate(STIFF))
    mechanism = sv.Mechanism(q, S, potential=U, actuators={"motor1": q[2], "motor2": q[3]})
    path = sv.paths.rest_to_rest(*LINE, duration=STROKE, smoothness=4)
    r = q.references(x=path[0], y=path[1])
    tip = links(q[0], q[1])[1]
    return mechanism, sv.Program({"x": tip[0] - r.x, "y": tip[1] - r.y})


def elastic_forces(times, bend):
    t = ca.SX.sym("t")
    tip = ca.DM(LINE[0]) + blend(t, STROKE) * (ca.DM(LINE[1]) - ca.DM(LINE[0]))
    angles, torques = arm_posture(t, tip, bend)
    motors = angles + torques / ca.DM(STIFF)
    return np.array(ca.Function("u", [t], [ca.DM(ROTOR) * rate(rate(motors, t), t) + torques])(times[None]))


@pytest.mark.parametrize("guess", [
    {"elbow": 1.0}, {"shoulder": -0.3, "elbow": 1.5, "motor1": 0.0}, {"shoulder": 1.0, "elbow": -1.2, "dmotor1": 1.0},
])  # fmt: skip
def test_an_elastic_arm_takes_the_elbow_of_its_guess(guess):
    plan, remarks = planned(elastic_arm(), guess, STROKE)
    bend = np.sign(guess["elbow"])
    assert plan.model.flat and not remarks and np.sign(plan["elbow"][0]) == bend
    assert off(plan, ("motor1_input", "motor2_input"), elastic_forces(plan.t, bend)) < FLAT


CENTRE, RADIUS, SPEED = (0.7, 0.3), 0.3, 1.5
CIRCLE = {"shoulder": -0.2, "elbow": 1.2}


def arm_on_a_circle():
    """The tip runs on a circle, and its angular rate w follows the jerk law w'' + 3 w' + 2 (w - SPEED) = 0."""
    q = sv.coordinates("shoulder elbow")
    both = links(*q)
    S = sum(sv.particle(q, m, r) for m, r in zip(MASSES, both, strict=True))
    U = sum(m * G * r[1] for m, r in zip(MASSES, both, strict=True))
    arm = both[1] - ca.DM(CENTRE)
    v = q.dt(arm)
    w = (arm[0] * v[1] - arm[1] * v[0]) / RADIUS**2
    speed = q.dt(w, 2) + 3 * q.dt(w) + 2 * (w - SPEED)
    mechanism = sv.Mechanism(q, S, potential=U, actuators={"shoulder": q[0], "elbow": q[1]})
    return mechanism, sv.Program({"circle": ca.dot(arm, arm) - RADIUS**2, "speed": speed})


def circle_forces(times, state):
    """From the angle, its rate and its acceleration of a state: w = SPEED + A exp(-t) + B exp(-2 t)."""
    t = ca.SX.sym("t")
    q = [sum(state[f"{d}{name}"] * t**k / (1 + (k > 1)) for k, d in enumerate(("", "d", "d2"))) for name in CIRCLE]
    arm = links(*q)[1] - ca.DM(CENTRE)
    slope = rate(arm, t)
    w = (arm[0] * slope[1] - arm[1] * slope[0]) / ca.dot(arm, arm)
    angle, w0, dw0 = map(float, ca.Function("a", [t], [ca.atan2(arm[1], arm[0]), w, rate(w, t)])(0.0))
    B = SPEED - w0 - dw0
    A = w0 - SPEED - B
    angle += SPEED * t + A * (1 - ca.exp(-t)) + B * (1 - ca.exp(-2 * t)) / 2
    tip = ca.DM(CENTRE) + RADIUS * ca.vertcat(ca.cos(angle), ca.sin(angle))
    return np.array(ca.Function("u", [t], [arm_posture(t, tip, 1)[1]])(times[None]))


@pytest.mark.parametrize("guess, transient", [
    (CIRCLE, False), (CIRCLE | {"dshoulder": 0.5}, True),
    (CIRCLE | {"dshoulder": -0.5, "d2shoulder": 2.0}, True),
])  # fmt: skip
def test_an_arm_under_a_jerk_law_has_the_plan_of_its_start(guess, transient):
    """A start in motion is near the guess, which is off the circle; it has a transient, the warning one without."""
    plan, remarks = planned(arm_on_a_circle(), guess, 6.0)
    assert [plan[name][0] - guess[name] for name in ("shoulder", "elbow")] == pytest.approx([0.0, 0.0], abs=0.24)
    assert plan["dshoulder"][0] == pytest.approx(guess.get("dshoulder", 0.0), abs=1e-12)
    assert off(plan, ("shoulder_input", "elbow_input"), circle_forces(plan.t, plan.start)) < INTEGRATED
    assert len(remarks) == transient
    if transient:
        assert "shoulder_input has a first transient" in remarks[0]
        other = eval(remarks[0].partition("Start without it: ")[2], {"model": plan.model})
        sizes = np.abs(sv.simulate(plan.model, other, (0.0, 6.0))["shoulder_input"])
        assert sizes[0] < np.abs(plan["shoulder_input"])[100:].max()
