"""Motions and forces known in closed form, written without servoctl: what the tests compare with.

Every function takes instants `t` (array, s) and returns a dict of arrays under the names that the gallery's scenes
use (SI, radians).  A reference is given as a callable `y(k)`: its k-th time derivative at those instants.
"""

from functools import partial
from math import comb, factorial

import numpy as np

GRAVITY = 9.81  # m/s^2
NODES, WEIGHTS = np.polynomial.legendre.leggauss(100)


# paths ---------------------------------------------------------------------------------------------------------------


def blend(sigma, order, smoothness):
    """Derivative of the polynomial S_(2k+1) of class C^k from 0 to 1, by its mirror image beyond one half."""
    k = smoothness
    polynomial = np.polynomial.Polynomial(
        [0] * (k + 1) + [(-1) ** j * comb(k + j, j) * comb(2 * k + 1, k - j) for j in range(k + 1)]
    )
    value = polynomial.deriv(order)
    near, far = value(np.minimum(sigma, 0.5)), value(1 - np.maximum(sigma, 0.5))
    return np.where(sigma <= 0.5, near, (1.0 if order == 0 else 0.0) - (-1) ** order * far)


def rest_to_rest(t, order, start, end, duration, smoothness):
    """`order`-th derivative of the path from `start` to `end` in `duration` [s]; (d, N) if these have d entries."""
    sigma = np.clip(np.asarray(t, float) / duration, 0.0, 1.0)
    value = blend(sigma, order, smoothness) / duration**order
    first, last = np.asarray(start, float)[..., None], np.asarray(end, float)[..., None]
    return (first if order == 0 else 0.0) + (last - first) * value


def quarter_turn(t, order, radius, start, end, duration, smoothness):
    """A quarter circle in plan, (0, 0) to (radius, radius), while the third entry goes from `start` to `end`."""
    phi = [rest_to_rest(t, k, 0.0, np.pi / 2, duration, smoothness) / factorial(k) for k in range(order + 1)]
    sine, cosine = [np.sin(phi[0])], [np.cos(phi[0])]
    for k in range(1, order + 1):
        sine.append(sum(j * phi[j] * cosine[k - j] for j in range(1, k + 1)) / k)
        cosine.append(-sum(j * phi[j] * sine[k - j] for j in range(1, k + 1)) / k)
    plan = factorial(order) * np.array([sine[order], -cosine[order]]) * radius
    plan[1] += radius if order == 0 else 0.0
    return np.vstack([plan, rest_to_rest(t, order, start, end, duration, smoothness)[None]])


# the Appell-Hamel mechanism ------------------------------------------------------------------------------------------

APPELL_HAMEL = {"m": 1.0, "M": 2.0, "I_x": 0.2, "I_y": 0.25, "a": 0.5, "b": 0.2, "rho": 0.3, "g": GRAVITY}
APPELL_HAMEL_STATES = {  # (x, y, z, phi, theta, dphi, dtheta) from rest positions 0, dphi = 1, dtheta = 2
    0.5: (0.0319727678, 0.2954591857, -0.0653856446, 0.3269282232, 0.9061260409, 0.2941642246, 1.6888475537),
    1.0: (-0.1974199455, 0.3336476801, -0.0577323796, 0.2886618981, 1.7454659644, -0.4458690776, 1.7226077945),
    2.0: (0.0937497219, -0.2692972364, 0.1619778260, -0.8098891302, 3.9504768171, -1.6103273411, 3.0406014808),
}
WHEEL_STOPS = 0.6983110523  # s


def appell_hamel_rates(state, p):
    """Time derivative of (x, y, z, phi, theta, dphi, dtheta) from the linear constraints, reduced by hand."""
    _, _, _, _, theta, dphi, dtheta = state
    sine, cosine = np.sin(theta), np.cos(theta)
    return np.array(
        [
            p["a"] * dphi * cosine - p["rho"] * dtheta * sine,
            p["a"] * dphi * sine + p["rho"] * dtheta * cosine,
            -p["b"] * dphi,
            dphi,
            dtheta,
            (p["m"] * p["a"] * p["rho"] * dtheta**2 - p["b"] * p["m"] * p["g"])
            / (p["I_y"] + p["a"] ** 2 * (p["M"] + p["m"]) + p["b"] ** 2 * p["m"]),
            -p["m"] * p["a"] * p["rho"] * dphi * dtheta / (p["I_x"] + p["m"] * p["rho"] ** 2),
        ]
    )


def appell_hamel(t, dphi=1.0, dtheta=2.0, p=APPELL_HAMEL):
    """Motion from zero positions, integrated far below the tests' tolerances; (N,) arrays by coordinate."""
    from scipy.integrate import solve_ivp

    instants = np.atleast_1d(np.asarray(t, float))
    solution = solve_ivp(
        lambda _, state: appell_hamel_rates(state, p), (0.0, max(instants.max(), 1e-3)), [0, 0, 0, 0, 0, dphi, dtheta],
        method="DOP853", rtol=3e-14, atol=1e-15, max_step=0.02, dense_output=True,
    )  # fmt: skip
    state = solution.sol(instants)
    rates = np.array([appell_hamel_rates(column, p) for column in state.T]).T
    names = ("x", "y", "z", "phi", "theta")
    motion = dict(zip(names, state[:5], strict=False)) | {f"d{name}": rates[i] for i, name in enumerate(names)}
    return motion | {"d2phi": rates[5], "d2theta": rates[6], "tension": p["m"] * (p["g"] + p["b"] * rates[5])}


def paper_4_4(theta, dx, dy, dphi, dtheta, p=APPELL_HAMEL):
    """Residuals of (4.4): the squared speed and the direction of the wheel's centre."""
    sine, cosine = np.sin(theta), np.cos(theta)
    speed = (dx + p["rho"] * dtheta * sine) ** 2 + (dy - p["rho"] * dtheta * cosine) ** 2 - (p["a"] * dphi) ** 2
    return np.array([speed, dx * sine - dy * cosine + p["rho"] * dtheta])


def paper_4_6(theta, dx, dy, dphi, dtheta, d2phi, d2theta, p=APPELL_HAMEL):
    """(d2x, d2y) of (4.6), as printed."""
    a, rho, sine, cosine = p["a"], p["rho"], np.sin(theta), np.cos(theta)
    d2x = -(
        sine * dy**2 * dtheta + rho * sine**2 * dy * d2theta
        + cosine * dx * (dy * dtheta + rho * sine * d2theta) - a**2 * cosine * dphi * d2phi
    ) / (cosine * dx + sine * dy)  # fmt: skip
    d2y = (
        cosine * dx**2 * dtheta + dx * (sine * dy * dtheta + rho * cosine**2 * d2theta)
        + sine * (rho * cosine * dy * d2theta + a**2 * dphi * d2phi)
    ) / (cosine * dx + sine * dy)  # fmt: skip
    return np.array([d2x, d2y])


def paper_4_8(theta, dx, dy, dphi, accelerations, p=APPELL_HAMEL):
    """The two rows of (4.8), S of (4.7); `accelerations` = (d2x, d2y, d2z, d2phi, d2theta), z down."""
    d2x, d2y, d2z, d2phi, d2theta = accelerations
    sine, cosine = np.sin(theta), np.cos(theta)
    along = cosine * dx + sine * dy
    balance = p["m"] * np.array([d2x, d2y, d2z - p["g"]])  # dS/d(gamma_i'') - Gamma_i, i = 1, 2, 3
    by_phi = np.array([p["a"] ** 2 * cosine * dphi / along, p["a"] ** 2 * sine * dphi / along, -p["b"] + 0 * along])
    by_theta = np.array(
        [
            -(p["rho"] * sine**2 * dy + p["rho"] * sine * cosine * dx) / along,
            (p["rho"] * cosine**2 * dx + p["rho"] * sine * cosine * dy) / along,
            0 * along,
        ]
    )
    row_phi = (p["I_y"] + p["a"] ** 2 * p["M"]) * d2phi + (balance * by_phi).sum(axis=0)
    return np.array([row_phi, p["I_x"] * d2theta + (balance * by_theta).sum(axis=0)])


def paper_4_9(theta, dx, dy, dphi, dtheta, accelerations, p=APPELL_HAMEL):
    """The five residuals of (4.9); in the fourth the printed d(theta)/dt is d2(theta)/dt2, as in (4.6)."""
    d2x, d2y, d2z, d2phi, d2theta = accelerations
    m, rho, sine, cosine = p["m"], p["rho"], np.sin(theta), np.cos(theta)
    d2x_c, d2y_c = paper_4_6(theta, dx, dy, dphi, dtheta, d2phi, d2theta, p)
    return np.array(
        [
            p["I_x"] * d2theta + m * rho * cosine * d2y - m * rho * sine * d2x,
            p["a"] ** 2 * m * dphi * (cosine * d2x + sine * d2y)
            + (cosine * dx + sine * dy) * (p["b"] * m * (p["g"] - d2z) + (p["I_y"] + p["a"] ** 2 * p["M"]) * d2phi),
            d2x - d2x_c,
            d2y - d2y_c,
            d2z + p["b"] * d2phi,
        ]
    )


# spirals, constant speed ---------------------------------------------------------------------------------------------


def spiral(t, order, c=None):
    """Particle of speed 1 from rest curvature under d^n(kappa)/dt^n = c, n = order - 2; position by quadrature."""
    n = order - 2
    c = factorial(n + 1) / 2 ** (n + 1) if c is None else c
    t = np.asarray(t, float)

    def heading(time):
        return c * time ** (n + 1) / factorial(n + 1)

    nodes = heading(t[..., None] * (NODES + 1) / 2)
    x, y = (t / 2 * (function(nodes) @ WEIGHTS) for function in (np.cos, np.sin))
    return {"x": x, "y": y, "dx": np.cos(heading(t)), "dy": np.sin(heading(t)), "heading": heading(t)}


def constant_speed(t, v=5.0, g=GRAVITY):
    """Ideal constant speed in gravity (y up), started horizontally: heading -arcsin tanh(g t / v)."""
    t = np.asarray(t, float)
    turn = np.arcsin(np.tanh(g * t / v))
    return {
        "x": v**2 / g * turn, "y": -(v**2) / g * np.log(np.cosh(g * t / v)),
        "dx": v * np.cos(turn), "dy": -v * np.sin(turn), "heading": -turn,
    }  # fmt: skip


def constant_speed_horizontal(t, v=5.0, g=GRAVITY, m=1.0):
    """The same program by a horizontal force, for t < v/g, where the force grows without bound."""
    t = np.asarray(t, float)
    dx = np.sqrt(v**2 - (g * t) ** 2)
    x = t * dx / 2 + v**2 / (2 * g) * np.arcsin(g * t / v)
    return {"x": x, "y": -g * t**2 / 2, "dx": dx, "dy": -g * t, "thrust": -m * g**2 * t / dx}


# cars and springs, mass on car ---------------------------------------------------------------------------------------


def cars_operator(masses, stiffnesses):
    """Coefficients, by even order of derivative, of each car's motion and of the force in the first car's motion."""
    size = len(masses) + 1
    motions, pull = [np.eye(size)[0]], np.zeros(size)  # pull = sum of m_i x_i'' over the cars so far
    for mass, k in zip(masses, stiffnesses, strict=False):
        pull = pull + mass * np.roll(motions[-1], 1)
        motions.append(motions[-1] + pull / k)
    return np.array(motions), pull + masses[-1] * np.roll(motions[-1], 1)


def cars(t, masses=(1.0, 2.0), stiffnesses=(1.0,), gaps=(0.5,), start=0.5, end=2.5, duration=2.0, smoothness=6):
    """Cars joined by springs, the first follows S, the last is driven: positions x1, x2, ... and the force."""
    y = partial(rest_to_rest, t, start=start, end=end, duration=duration, smoothness=smoothness)
    motions, force = cars_operator(masses, stiffnesses)
    even = np.array([y(2 * j) for j in range(len(masses) + 1)])
    positions = motions @ even - np.concatenate([[0.0], np.cumsum(gaps)])[:, None]
    return {f"x{i + 1}": x for i, x in enumerate(positions)} | {"force": force @ even}


def response(t, coefficients, forcing, duration):
    """(s, s') of a0 s + a1 s' + a2 s'' = forcing(t), from rest, forcing zero beyond `duration`: Duhamel's integral."""
    a0, a1, a2 = coefficients
    t = np.asarray(t, float)
    poles = np.roots([a2, a1, a0]) if a2 else np.array([-a0 / a1])
    weights = [1 / (a2 * (poles[0] - poles[1])), 1 / (a2 * (poles[1] - poles[0]))] if a2 else [1 / a1]
    upper = np.clip(t, 0.0, duration)[..., None]
    tau = upper * (NODES + 1) / 2
    s, ds = np.zeros(t.shape, complex), np.zeros(t.shape, complex)
    for pole, weight in zip(poles.astype(complex), weights, strict=False):
        integrand = weight * np.exp(pole * (t[..., None] - tau)) * forcing(tau)
        s += upper[..., 0] / 2 * (integrand @ WEIGHTS)
        ds += upper[..., 0] / 2 * (integrand @ WEIGHTS) * pole
    return s.real, ds.real + (0.0 if a2 else forcing(t) / a1)


def cars_ideal(t, masses=(1.0, 2.0), k=1.0, gap=0.5, start=0.5, end=2.5, duration=2.0, smoothness=6):
    """Two cars under the same program, realised ideally: the reaction acts on car 1, car 2 swings."""
    y = partial(rest_to_rest, start=start, end=end, duration=duration, smoothness=smoothness)
    stretch, _ = response(t, (k, 0.0, masses[1]), lambda tau: masses[1] * y(tau, 2), duration)
    return {"x1": y(t, 0), "x2": y(t, 0) - gap - stretch, "reaction": masses[0] * y(t, 2) + k * stretch}


def mass_on_car(t, alpha, damping, m_1=1.0, m_2=2.0, k=5.0, start=0.5, end=2.5, duration=3.0, smoothness=6):
    """Mass on an inclined guide of a car, z = x + s cos(alpha) follows S, from rest: x, s and the force on the car."""
    z = partial(rest_to_rest, start=start, end=end, duration=duration, smoothness=smoothness)
    sine, cosine = np.sin(alpha), np.cos(alpha)
    if abs(sine) < 1e-12 and damping == 0.0:
        s, d2s = -m_2 * z(t, 2) / k, -m_2 * z(t, 4) / k
    elif abs(sine) < 1e-12:
        s, ds = response(t, (k, damping, 0.0), lambda tau: -m_2 * z(tau, 2), duration)
        d2s = -(m_2 * z(t, 3) + k * ds) / damping
    else:
        inertia = m_2 * sine**2
        s, ds = response(t, (k, damping, inertia), lambda tau: -m_2 * cosine * z(tau, 2), duration)
        d2s = -(m_2 * cosine * z(t, 2) + damping * ds + k * s) / inertia
    force = (m_1 + m_2) * (z(t, 2) - d2s * cosine) + m_2 * cosine * d2s
    return {"x": z(t, 0) - s * cosine, "s": s, "force": force}


def mass_on_car_poles(alpha, m_2=2.0, k=5.0, damping=1.0):
    """Poles of the internal dynamics m_2 sin^2(alpha) s'' + d s' + k s."""
    return np.roots(np.trim_zeros([m_2 * np.sin(alpha) ** 2 if abs(np.sin(alpha)) > 1e-12 else 0.0, damping, k], "f"))


# cranes --------------------------------------------------------------------------------------------------------------


def crane(p, masses, m_hoist, m_load, g=GRAVITY):
    """Flat crane of 2 or 3 dimensions: load p(k) = (d, N) with its last entry down, trolley at height 0.

    `masses` (d - 1,) move with the trolley's coordinates.  The pull on the load, m (g e - p''), lies along the rope.
    """
    lean_n, lean_d = [-p(2 + j)[:-1] for j in range(3)], [(g if j == 0 else 0.0) - p(2 + j)[-1] for j in range(3)]
    w = lean_n[0] / lean_d[0]  # horizontal over vertical part of the rope
    dw = (lean_n[1] - w * lean_d[1]) / lean_d[0]
    d2w = (lean_n[2] - 2 * dw * lean_d[1] - w * lean_d[2]) / lean_d[0]
    z, dz, d2z = (p(k)[-1] for k in range(3))
    rope = [np.vstack([z * w, z]), np.vstack([dz * w + z * dw, dz])]
    rope.append(np.vstack([d2z * w + 2 * dz * dw + z * d2w, d2z]))
    trolley = [p(k)[:-1] - rope[k][:-1] for k in range(3)]
    length = np.sqrt((rope[0] ** 2).sum(axis=0))
    rate = (rope[0] * rope[1]).sum(axis=0) / length
    d2length = ((rope[1] ** 2).sum(axis=0) + (rope[0] * rope[2]).sum(axis=0) - rate**2) / length
    tension = m_load * np.sqrt((lean_n[0] ** 2).sum(axis=0) + lean_d[0] ** 2)
    force = np.asarray(masses, float)[:, None] * trolley[2] + m_load * p(2)[:-1]
    return {
        "trolley": trolley[0], "length": length, "dlength": rate, "d2length": d2length, "direction": rope[0] / length,
        "tension": tension, "force": force, "hoist": m_hoist * d2length - tension,
    }  # fmt: skip


def overhead_crane(t, m_trolley=10.0, m_hoist=5.0, m_load=100.0, start=(0.0, 4.0), end=(5.0, 2.0), duration=6.0, k=4):
    """The crane of the gallery: load from (0, 4) to (5, 2) m by S9 in 6 s; trolley and hoist forces [N]."""
    p = partial(rest_to_rest, t, start=start, end=end, duration=duration, smoothness=k)
    c = crane(p, [m_trolley], m_hoist, m_load)
    load = p(0)
    return {
        "x": c["trolley"][0], "l": c["length"], "theta": np.arcsin(c["direction"][0]), "X": load[0], "Z": load[1],
        "trolley": c["force"][0], "hoist": c["hoist"], "tension": c["tension"],
    }  # fmt: skip


def winch_crane(t, m_trolley=10.0, J=0.1, r=0.1, m_load=100.0):
    """Crane with a winch, load from (0, 4) to (1, 5) m by S13 in 6 s: force [N] and torque, positive pays out [N m]."""
    p = partial(rest_to_rest, t, start=(0.0, 4.0), end=(1.0, 5.0), duration=6.0, smoothness=6)
    c = crane(p, [m_trolley], J / r**2, m_load)
    load = p(0)
    return {
        "x": c["trolley"][0], "beta": c["length"] / r, "theta": np.arcsin(c["direction"][0]), "X": load[0],
        "Z": load[1], "trolley": c["force"][0], "winch": r * c["hoist"], "tension": c["tension"],
    }  # fmt: skip


def crane_3d(t, m_bridge=20.0, m_trolley=10.0, m_hoist=5.0, m_load=100.0, k=6):
    """The gallery's 3-D crane: a quarter turn of 3 m in 6 s, 5 to 3 m below; m_bridge moves with x, m_trolley with y."""
    p = partial(quarter_turn, t, radius=3.0, start=5.0, end=3.0, duration=6.0, smoothness=k)
    c = crane(p, [m_bridge, m_trolley], m_hoist, m_load)
    load, e = p(0), c["direction"]
    return {
        "x": c["trolley"][0], "y": c["trolley"][1], "l": c["length"],
        "theta": np.arcsin(e[0]), "phi": np.arctan2(e[1], e[2]), "X": load[0], "Y": load[1], "Z": load[2],
        "bridge": c["force"][0], "trolley": c["force"][1], "hoist": c["hoist"], "tension": c["tension"],
    }  # fmt: skip


# internal dynamics of the passive-joint arm and of the VTOL aircraft ---------------------------------------------------


def passive_arm_inertia(q2, m=1.0, l=1.0, inertia=1 / 12):
    """(M12, M22) of two equal links, inertia about their centres at l/2, relative angles."""
    passive = inertia + m * l**2 / 4
    return passive + m * l**2 / 2 * np.cos(q2), passive


def passive_arm_critical(**link):
    """Gamma at which q1 + Gamma q2 loses relative degree 2 in the straight pose: minimum phase below it."""
    coupling, passive = passive_arm_inertia(0.0, **link)
    return passive / coupling


def passive_arm_lost(gamma, m=1.0, l=1.0, inertia=1 / 12):
    """Angle q2 [rad] at which the relative degree of q1 + gamma q2 is lost."""
    passive = inertia + m * l**2 / 4
    return np.arccos((passive / gamma - passive) / (m * l**2 / 2))


def passive_arm_poles(gamma, c, d, **link):
    """Poles of the internal dynamics at q2 = 0: (M22 - gamma M12) s^2 + d s + c."""
    coupling, passive = passive_arm_inertia(0.0, **link)
    return np.sort(np.roots([passive - gamma * coupling, d, c]))


VTOL = {"M": 50.0, "J": 25.0, "l": 1.0, "h": 0.1, "tilt": np.deg2rad(5.0), "g": GRAVITY}


def vtol_rate(p=VTOL):
    """Zero dynamics of the centre of mass at hover, +- this value [1/s]."""
    arm = p["l"] * np.cos(p["tilt"]) + p["h"] * np.sin(p["tilt"])
    return np.sqrt(p["M"] * p["g"] * arm / (p["J"] * np.sin(p["tilt"])))


def vtol_flat_point(p=VTOL):
    """Height [m] of the flat output above the centre of mass."""
    arm = p["l"] * np.cos(p["tilt"]) + p["h"] * np.sin(p["tilt"])
    return p["J"] * np.sin(p["tilt"]) / (p["M"] * arm)


def vtol(t, p=VTOL):
    """The flat point from (0, 0) to (5, 2) m by S9 in 4 s: the pull is along the axis through it."""
    point = partial(rest_to_rest, t, start=(0.0, 0.0), end=(5.0, 2.0), duration=4.0, smoothness=4)
    arm = p["l"] * np.cos(p["tilt"]) + p["h"] * np.sin(p["tilt"])
    height = vtol_flat_point(p)
    pull, dpull, d2pull = point(2) + np.array([[0.0], [p["g"]]]), point(3), point(4)
    size2, turn = (pull**2).sum(axis=0), pull[0] * dpull[1] - pull[1] * dpull[0]
    theta, dtheta = np.arctan2(-pull[0], pull[1]), turn / size2
    d2theta = (pull[0] * d2pull[1] - pull[1] * d2pull[0] - 2 * dtheta * (pull * dpull).sum(axis=0)) / size2
    total, difference = p["M"] * (np.sqrt(size2) + height * dtheta**2), p["J"] * d2theta / arm
    x, z = point(0) + height * np.array([np.sin(theta), -np.cos(theta)])
    return {"x": x, "z": z, "theta": theta, "u1": (total + difference) / 2, "u2": (total - difference) / 2}
