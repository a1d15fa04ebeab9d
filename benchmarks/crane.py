"""The inverse of a crane with a winch, 3,001 points: the actuation with which the load follows its path.

Blajer's data: the load goes from (0, 4) to (5, 1) m in 3 s, Z down, on a straight line, by the polynomial of degree 9.
The actuation has a closed form; errors of the force and of the torque are relative to the largest size of each.
"""

from functools import cache, partial
from math import cos, sin

import casadi as ca
import numpy as np
from harness import Row

import servoctl as sv

T, G = 3.0, 9.81  # s, m/s^2
FIRST, LAST = np.array([0.0, 4.0]), np.array([5.0, 1.0])  # m
M_TROLLEY, J, R, M_LOAD = 10.0, 0.1, 0.1, 100.0  # kg, kg m^2, m, kg
M_WINCH = J / R**2  # kg, in the rope's length
TIMES = np.linspace(0.0, T, 3001)
S9 = np.polynomial.Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
S9_RATES = [S9.deriv(k).coef[max(5 - k, 0) :][::-1] / T**k for k in range(5)]  # without the factor sigma^(5 - k)


# the closed form, in NumPy --------------------------------------------------------------------------------------------


def closed_form():
    """Force of the trolley and torque of the winch: the pull on the load, m (g e_z - p''), lies along the rope."""
    sigma = TIMES / T
    s0, s1, s2, s3, s4 = (S9.deriv(k)(sigma) / T**k for k in range(5))
    to_x, to_z = LAST - FIRST
    pull_x, pull_x1, pull_x2 = -to_x * s2, -to_x * s3, -to_x * s4
    pull_z, pull_z1, pull_z2 = G - to_z * s2, -to_z * s3, -to_z * s4
    size2 = pull_x**2 + pull_z**2
    angle = np.arctan2(pull_x, pull_z)
    angle1 = (pull_x1 * pull_z - pull_z1 * pull_x) / size2
    turn1 = pull_x2 * pull_z - pull_z2 * pull_x
    angle2 = (turn1 - 2 * angle1 * (pull_x * pull_x1 + pull_z * pull_z1)) / size2
    c, s = np.cos(angle), np.sin(angle)
    length = (FIRST[1] + to_z * s0) / c
    rate = (to_z * s1 + length * s * angle1) / c
    rate1 = (to_z * s2 + 2 * rate * s * angle1 + length * (c * angle1**2 + s * angle2)) / c
    x2 = to_x * s2 - (rate1 * s + 2 * rate * c * angle1 + length * (c * angle2 - s * angle1**2))
    tension = M_LOAD * np.sqrt(size2)
    return np.array([M_TROLLEY * x2 + M_LOAD * to_x * s2, R * (M_WINCH * rate1 - tension)])


def blend(sigma):
    """S and its first four time derivatives."""
    power = sigma
    powers = [power, power := sigma * power, power := sigma * power, power := sigma * power, sigma * power]
    for k, coefficients in enumerate(S9_RATES):
        value = coefficients[0] * sigma
        for c in coefficients[1:-1]:
            value += c
            value *= sigma
        value += coefficients[-1]
        value *= powers[4 - k]
        yield value


def tuned_closed_form():
    """The same without trigonometric functions, and with the polynomials by Horner's rule in place."""
    s0, s1, s2, s3, s4 = blend(TIMES / T)
    to_x, to_z = LAST - FIRST
    z0, z1, z2 = FIRST[1] + to_z * s0, to_z * s1, to_z * s2
    vertical, vertical1, vertical2 = G - z2, -to_z * s3, -to_z * s4
    w0 = -to_x * s2 / vertical  # tangent of the rope's angle
    w1 = (-to_x * s3 - w0 * vertical1) / vertical
    w2 = (-to_x * s4 - 2 * w1 * vertical1 - w0 * vertical2) / vertical
    side0, side1, side2 = z0 * w0, z1 * w0 + z0 * w1, z2 * w0 + 2 * z1 * w1 + z0 * w2
    length = np.sqrt(side0 * side0 + z0 * z0)
    rate = (side0 * side1 + z0 * z1) / length
    rate1 = (side1 * side1 + z1 * z1 + side0 * side2 + z0 * z2 - rate * rate) / length
    tension = M_LOAD * vertical * np.sqrt(1.0 + w0 * w0)
    force = M_TROLLEY * (to_x * s2 - side2) + M_LOAD * to_x * s2
    return np.array([force, R * (M_WINCH * rate1 - tension)])


@cache
def truth():
    """The closed form at TIMES in extended precision, by the same steps with a path from the definition."""
    t = TIMES.astype(np.longdouble) / np.longdouble(T)
    s = [sum((np.longdouble(c) * t**j for j, c in enumerate(S9.deriv(k).coef)), 0 * t) / T**k for k in range(5)]
    p = [np.outer(LAST - FIRST, s[k]) + (FIRST[:, None] if k == 0 else 0.0) for k in range(5)]
    pull = [np.array([-p[2][0], G - p[2][1]]), -p[3], -p[4]]
    angle = [np.arctan2(pull[0][0], pull[0][1])]
    size2, turn = (pull[0] ** 2).sum(axis=0), pull[1][0] * pull[0][1] - pull[0][0] * pull[1][1]
    angle.append(turn / size2)
    turn1 = pull[2][0] * pull[0][1] - pull[0][0] * pull[2][1]
    angle.append((turn1 - 2 * angle[1] * (pull[0] * pull[1]).sum(axis=0)) / size2)
    c, s = np.cos(angle[0]), np.sin(angle[0])
    length = p[0][1] / c
    rate = (p[1][1] + length * s * angle[1]) / c
    rate1 = (p[2][1] + 2 * rate * s * angle[1] + length * (c * angle[1] ** 2 + s * angle[2])) / c
    x2 = p[2][0] - (rate1 * s + 2 * rate * c * angle[1] + length * (c * angle[2] - s * angle[1] ** 2))
    tension = M_LOAD * np.sqrt(size2)
    return np.array([M_TROLLEY * x2 + M_LOAD * p[2][0], R * (M_WINCH * rate1 - tension)]).astype(float)


def error(actuation):
    """Largest error of each input relative to its own largest size; a coarser grid is compared where it has points."""
    exact = truth()[:, :: (len(TIMES) - 1) // (actuation.shape[1] - 1)]
    return (np.abs(actuation - exact).max(axis=1) / np.abs(truth()).max(axis=1)).max()


# ours ----------------------------------------------------------------------------------------------------------------


@cache
def scene():
    """Model and start."""
    p = sv.parameters(m_trolley=M_TROLLEY, J=J, r=R, m_load=M_LOAD, g=G)
    q = sv.coordinates("x beta theta")
    x, beta, theta = q
    load = ca.vertcat(x + p.r * beta * ca.sin(theta), p.r * beta * ca.cos(theta))
    S = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.J, beta) + sv.particle(q, p.m_load, load)
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=-p.m_load * p.g * load[1], actuators={"trolley": x, "winch": beta}, parameters=p
    )
    path = sv.paths.rest_to_rest(start=FIRST, end=LAST, duration=T, smoothness=4)
    r = q.references(X=path[0], Z=path[1])
    program = sv.Program({"X": load[0] - r.X, "Z": load[1] - r.Z}, by="actuators")
    model = sv.derive(mechanism, program)
    return model, model.start(guess={"beta": FIRST[1] / R})


def along_the_path():
    model, start = scene()
    path, (_, actuation) = model.function("path"), model.signals("actuation")
    path.native("newton"), actuation.native("grid")  # compiled now
    q0, p = start.values[:3], model.p

    def call():
        nodes, _ = path.continuation(TIMES[[0, -1]], q0, p, T / 50, 1000)
        jets, _ = path.newton(TIMES, nodes, p)
        return actuation.grid(TIMES, jets, p)  # of q, q', q''

    return call


def simulated():
    model, start = scene()

    def call():
        run = sv.simulate(model, start, (0.0, T), t_eval=TIMES, progress=False)
        return np.array([run["trolley"], run["winch"]])

    return call


# backward Euler on the servo DAE of index 5, projected to index 3 (Blajer and Kolodziejczyk 2004) ----------------


def load_path(t, k=0):
    return (FIRST if k == 0 else 0.0) + (LAST - FIRST) * S9.deriv(k)(t / T) / T**k


def backward_euler(steps):
    """Unknowns (q, q', u) with a NumPy residual, solved by scipy's fsolve from the last step's values.

    D' (M q'' - f - B u) = 0 by differences with C D = 0; C M^-1 (f + B u) = p'' - C' q' and c(q, t) = 0.
    """
    from scipy.optimize import fsolve

    h, inputs = T / steps, np.array([[1.0, 0.0], [0.0, 1.0 / R], [0.0, 0.0]])

    def residual(z, q0, v0, goal, d2goal):
        q, v, u = z[:3], z[3:6], z[6:]
        (x, l, theta), (_, dl, dtheta) = q.tolist(), v.tolist()
        s, c = sin(theta), cos(theta)
        mass = np.array([
            [M_TROLLEY + M_LOAD, M_LOAD * s, M_LOAD * l * c], [M_LOAD * s, M_WINCH + M_LOAD, 0.0],
            [M_LOAD * l * c, 0.0, M_LOAD * l * l],
        ])  # fmt: skip
        turning, coupling = l * dtheta * dtheta, 2 * dl * dtheta
        force = inputs @ u
        force += (M_LOAD * (s * turning - c * coupling), M_LOAD * (turning + G * c), -M_LOAD * l * (coupling + G * s))
        C, D = np.array([[1.0, s, l * c], [0.0, c, -l * s]]), np.array([-l, l * s, c])
        out = np.empty(8)
        out[:3] = q - q0 - h * v
        out[3] = D @ (mass @ (v - v0) - h * force)
        out[4:6] = C @ np.linalg.solve(mass, force) - d2goal
        out[4] += c * coupling - s * turning
        out[5] += -s * coupling - c * turning
        out[6:] = x + l * s - goal[0], l * c - goal[1]
        return out

    def call():
        z, actuation = np.array([0.0, FIRST[1], 0.0, 0.0, 0.0, 0.0, 0.0, -M_LOAD * G * R]), np.empty((2, steps + 1))
        actuation[:, 0] = z[6:]
        times = h * np.arange(steps + 1)[:, None]
        for k, (goal, d2goal) in enumerate(zip(load_path(times[1:]), load_path(times[1:], 2), strict=True), 1):
            z = fsolve(residual, z, (z[:3], z[3:6], goal, d2goal))
            actuation[:, k] = z[6:]
        return actuation

    return call


LITERATURE = "backward Euler on the servo DAE, NumPy + fsolve, 300 steps"
CLOSED = "closed form by hand, NumPy over all points"
TUNED = "the same without trigonometric functions, polynomials in place"


def row(make, title):
    peers = {LITERATURE: backward_euler(300), CLOSED: closed_form, TUNED: tuned_closed_form}
    bars, looser = {LITERATURE: 400, CLOSED: 0.8}, {LITERATURE: 5e-2}
    return Row(f"Crane inverse, 3,001 points, error 1e-10: {title}", make(), peers, error, 1e-10, bars, looser)


ROWS = {
    "crane": partial(row, along_the_path, "Newton along the path, then the actuation"),
    "crane-simulate": partial(row, simulated, "all of sv.simulate and two signals"),
}
