"""Published problems: digits against CPU seconds, the default and our methods by name, SciPy's methods beside them.

::

    python benchmarks/published.py                        # all problems
    python benchmarks/published.py pendulum "car axis"    # some
    python benchmarks/published.py --truths               # own truths, computed again by two methods each

Digits are -log10 of the worst error at the end of the span: of each entry relative to its truth as in the IVP test set,
or of the whole relative to its largest entry. Truths are digits that were published, closed forms, or motions of
equations reduced by hand, which two methods of SciPy integrate to their last digits. CPU seconds are medians of repeats
of one process; `first` is the first call, with what it compiles, in processes of its own, too. SciPy's methods get our
rates X', as the pivots at the start give them.
"""

import argparse
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.special import ellipj

import servoctl as sv
from servoctl.plants.driven import driven
from servoctl.study.converged import cpu_seconds

G = 9.81  # m/s^2


@dataclass(frozen=True)
class Problem:
    """A problem with the state at its end.

    Parameters
    ----------
    source : str
        Where it was published, and where its truth comes from.
    scene : callable
        Takes nothing, returns a `Plant`, or a Mechanism and a Program.
    start : dict of str to float
        All of the state of a plant, or what `model.start` takes.
    until : float
        End of the span [s], which begins at 0.
    truth : callable
        Takes nothing, returns a dict of values at the end by name.
    relative : bool
        Whether errors are those of each entry relative to its truth.
    without : tuple of str
        Methods that are not measured, as compiling or steps would take minutes.
    """

    source: str
    scene: Callable
    start: dict
    until: float
    truth: Callable
    relative: bool = False
    without: tuple = ()

    def digits(self, values):
        """Digits of a dict of values by name, or of anything that gives them by name."""
        truth = self.truth()
        names = list(truth)
        true, found = np.array([truth[name] for name in names]), np.array([values[name] for name in names])
        sizes = np.abs(true) if self.relative else np.abs(true).max()
        return float(-np.log10(max((np.abs(found - true) / sizes).max(), 1e-17)))


def prepared(problem):
    """Model and start of a problem."""
    scene = problem.scene()
    if isinstance(scene, tuple):
        model = sv.derive(*scene)
        return model, model.start(**problem.start)
    model = driven(scene)
    return model, scene.state(problem.start)


# the pendulum in Cartesian coordinates, A01 of the IFToMM's library of benchmarks -------------------------------------


def pendulum():
    q = sv.coordinates("x y")
    bar = {"bar": ca.sumsqr(ca.vertcat(*q)) - 1}
    S = sv.particle(q, 1.0, ca.vertcat(*q))
    return sv.plant(sv.Mechanism(q, S, potential=G * q[1], constraints=bar))


def pendulum_truth(t):
    """From rest at 90 degrees: sin of half the angle is sin(45 degrees) cd(sqrt(g) t)."""
    sn, cn, dn, _ = ellipj(np.sqrt(G) * t, 0.5)
    half = -np.sqrt(0.5) * cn / dn
    return {"x": 2 * half * np.sqrt(1 - half**2), "y": 2 * half**2 - 1}


# the IVP test set -----------------------------------------------------------------------------------------------------


def car_axis():
    mass, length, rest = 10.0 * 0.01**2 / 2, 1.0, 0.5
    q = sv.coordinates("xl yl xr yr")
    left, right = ca.vertcat(*q[:2]), ca.vertcat(*q[2:])
    yb = 0.1 * ca.sin(10 * q.t)
    axle = ca.vertcat(ca.sqrt(length**2 - yb**2), yb)
    stretched = (ca.norm_2(left) - rest, ca.norm_2(right - axle) - rest)
    potential = sum(s**2 for s in stretched) / 2 + mass * (left[1] + right[1])  # g = 1
    rows = {"square": ca.dot(axle, left), "bar": ca.sumsqr(left - right) - length**2}
    S = sv.particle(q, mass, left) + sv.particle(q, mass, right)
    return sv.plant(sv.Mechanism(q, S, potential=potential, constraints=rows))


CAR_AXIS_START = {"xl": 0.0, "yl": 0.5, "xr": 1.0, "yr": 0.5, "dxl": -0.5, "dyl": 0.0, "dxr": -0.5, "dyr": 0.0}
CAR_AXIS = {
    "xl": 0.493455784275402809122e-1, "yl": 0.496989460230171153861, "xr": 1.04174252488542151681,
    "yr": 0.373911027265361256927, "dxl": -0.770583684040972357970e-1, "dyl": 0.744686658723778553466e-2,
    "dxr": 0.175568157537232222276e-1, "dyr": 0.770341043779251976443,
}  # fmt: skip

ANGLES = "beta theta gamma phi delta omega eps"


def andrews():
    q = sv.coordinates(ANGLES)
    be, th, ga, ph, de, om, ep = q
    d, da, e, ea, rr, ra, l0 = 28e-3, 115e-4, 2e-2, 1421e-5, 7e-3, 92e-5, 7785e-5
    sa, sb, sc, sd, ss, ta, tb = 1874e-5, 1043e-5, 18e-3, 2e-2, 35e-3, 2308e-5, 916e-5
    u, ua, ub, zf, zt, fa = 4e-2, 1228e-5, 449e-5, 2e-2, 4e-2, 1421e-5
    (xa, ya), (xb, yb), (xc, yc) = (-0.06934, -0.00227), (-0.03635, 0.03273), (0.014, 0.072)
    m = [0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498]
    i = [2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5]
    M = ca.SX.zeros(7, 7)
    M[0, 0] = m[0] * ra**2 + m[1] * (rr**2 - 2 * da * rr * ca.cos(th) + da**2) + i[0] + i[1]
    M[0, 1] = M[1, 0] = m[1] * (da**2 - da * rr * ca.cos(th)) + i[1]
    M[1, 1] = m[1] * da**2 + i[1]
    M[2, 2] = m[2] * (sa**2 + sb**2) + i[2]
    M[3, 3] = m[3] * (e - ea) ** 2 + i[3]
    M[3, 4] = M[4, 3] = m[3] * ((e - ea) ** 2 + zt * (e - ea) * ca.sin(ph)) + i[3]
    M[4, 4] = m[3] * (zt**2 + 2 * zt * (e - ea) * ca.sin(ph) + (e - ea) ** 2) + m[4] * (ta**2 + tb**2) + i[3] + i[4]
    M[5, 5] = m[5] * (zf - fa) ** 2 + i[5]
    M[5, 6] = M[6, 5] = m[5] * ((zf - fa) ** 2 - u * (zf - fa) * ca.sin(om)) + i[5]
    M[6, 6] = m[5] * ((zf - fa) ** 2 - 2 * u * (zf - fa) * ca.sin(om) + u**2) + m[6] * (ua**2 + ub**2) + i[5] + i[6]
    end = ca.vertcat(rr * ca.cos(be) - d * ca.cos(be + th), rr * ca.sin(be) - d * ca.sin(be + th))
    rows = [
        end + ca.vertcat(-ss * ca.sin(ga) - xb, ss * ca.cos(ga) - yb),
        end + ca.vertcat(-e * ca.sin(ph + de) - zt * ca.cos(de) - xa, e * ca.cos(ph + de) - zt * ca.sin(de) - ya),
        end + ca.vertcat(-zf * ca.cos(om + ep) - u * ca.sin(ep) - xa, -zf * ca.sin(om + ep) + u * ca.cos(ep) - ya),
    ]
    spring = ca.vertcat(sd * ca.cos(ga) + sc * ca.sin(ga) + xb - xc, sd * ca.sin(ga) - sc * ca.cos(ga) + yb - yc)
    v = ca.vertcat(*q.d(1))
    mechanism = sv.Mechanism(
        q,
        kinetic=v.T @ M @ v / 2,
        potential=4530.0 * (ca.norm_2(spring) - l0) ** 2 / 2,
        forces={"beta": 0.033},
        constraints={f"g{k}": row for k, row in enumerate(ca.vertcat(*rows).elements(), 1)},
    )
    return sv.plant(mechanism)


ANDREWS_START = {
    "beta": -0.0617138900142764496358948458001, "theta": 0.0, "gamma": 0.455279819163070380255912382449,
    "phi": 0.222668390165885884674473185609, "delta": 0.487364979543842550225598953530,
    "omega": -0.222668390165885884674473185609, "eps": 1.23054744454982119249735015568,
} | {f"d{name}": 0.0 for name in ANGLES.split()}  # fmt: skip
ANDREWS = {
    "beta": 15.81077119629904, "theta": -15.75637105984298, "gamma": 0.04082224013073101, "phi": -0.5347301163226948,
    "delta": 0.5244099658805304, "omega": 0.5347301163226948, "eps": 1.048080741042263,
    "dbeta": 1139.920302151208, "dtheta": -1424.379294994111, "dgamma": 11.03291221937134, "dphi": 19.29337464421385,
    "ddelta": 0.5735699284790808, "domega": -19.29337464421385, "deps": 0.3231791658026955,
}  # fmt: skip


def crank():
    """The flexible slider crank with the linear stiffness, without damping: two lateral modes, two nodes along it."""
    q = sv.coordinates("phi1 phi2 x3 q1 q2 q3 q4")
    e, v, a = ca.vertcat(*q[3:]), ca.vertcat(*q.d(1)), ca.vertcat(*q.d(2))
    M, f, K = crank_matrices(q)
    l1, l2 = 0.15, 0.30
    rows = {
        "height": l1 * ca.sin(q[0]) + (l2 + q[6]) * ca.sin(q[1]),
        "slider": q[2] - l1 * ca.cos(q[0]) - (l2 + q[6]) * ca.cos(q[1]),
        "speed": q[0] - 150.0 * q.t,
    }
    balance = M @ a - f(v) + ca.vertcat(0, 0, 0, K @ e)
    return sv.plant(sv.Mechanism(q, balance=balance, constraints=rows))


def crank_matrices(q):
    """Mass matrix, quadratic forces of velocities and stiffness, as Simeon (1996) gives them."""
    m2, m3, l1, l2, j1, j2 = 0.151104, 0.075552, 0.15, 0.30, 0.002727, 0.0045339259
    b, rho, young, pi = 0.008, 7870.0, 0.2e12, 3.1415927
    fm, fk, fb = rho * b * b * l2, young * b * b / l2, b * b * l2
    MQ = fm * ca.DM([[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 8, 1], [0, 0, 1, 2]])
    bend = pi**4 / 24 * (b / l2) ** 2
    K = fk * ca.DM([[bend, 0, 0, 0], [0, 16 * bend, 0, 0], [0, 0, 16 / 3, -8 / 3], [0, 0, -8 / 3, 7 / 3]])
    c13, c14, c24 = 16 / pi**3, 8 / pi**3 - 1 / pi, 0.5 / pi
    B = fb * ca.DM([[0, 0, -c13, c14], [0, 0, 0, c24], [c13, 0, 0, 0], [-c14, -c24, 0, 0]])
    c1, c2 = fb * ca.DM([0, 0, 2 / 3, 1 / 6]), fb * ca.DM([2 / pi, 0, 0, 0])
    c12, c21 = l2 * fb * ca.DM([0, 0, 1 / 3, 1 / 6]), l2 * fb * ca.DM([1 / pi, -0.5 / pi, 0, 0])
    e = ca.vertcat(*q[3:])
    cos, sin = ca.cos(q[0] - q[1]), ca.sin(q[0] - q[1])
    M = ca.SX.zeros(7, 7)
    M[0, 0] = j1 + m2 * l1**2
    M[0, 1] = M[1, 0] = l1 * l2 * m2 * cos / 2 + rho * l1 * (sin * ca.dot(c2, e) + cos * ca.dot(c1, e))
    M[1, 1] = j2 + ca.dot(e, MQ @ e) + 2 * rho * ca.dot(c12, e)
    M[2, 2] = m3
    M[0, 3:] = rho * l1 * (cos * c2 - sin * c1).T
    M[1, 3:] = rho * (c21 + B.T @ e).T
    M[3:, 0], M[3:, 1], M[3:, 3:] = M[0, 3:].T, M[1, 3:].T, MQ

    def forces(v):
        v1, v2, de = v[0], v[1], v[3:]
        f1 = -l1 * l2 * m2 * v2**2 * sin / 2 + rho * l1 * v2**2 * (cos * ca.dot(c2, e) - sin * ca.dot(c1, e))
        f1 -= 2 * rho * l1 * v2 * (cos * ca.dot(c1, de) + sin * ca.dot(c2, de))
        f2 = l1 * l2 * m2 * v1**2 * sin / 2 + rho * l1 * v1**2 * (sin * ca.dot(c1, e) - cos * ca.dot(c2, e))
        f2 -= 2 * rho * v2 * ca.dot(c12, de) + 2 * v2 * ca.dot(de, MQ @ e) + rho * ca.dot(de, B @ de)
        fe = v2**2 * (MQ @ e) + rho * (v2**2 * c12 + l1 * v1**2 * (cos * c1 + sin * c2) + 2 * v2 * (B @ de))
        return ca.vertcat(f1, f2, 0, fe)

    return M, forces, K


CRANK_START = {
    "phi1": 0.0, "phi2": 0.0, "x3": 0.450016933, "q1": 0.0, "q2": 0.0, "q3": 0.103339863e-4, "q4": 0.169327969e-4,
    "dphi1": 150.0, "dphi2": -74.9957670, "dx3": -0.268938672e-5, "dq1": 0.444896105, "dq2": 0.463434311e-2,
    "dq3": -0.178591076e-5, "dq4": -0.268938672e-5,
}  # fmt: skip
# Published digits hold for a start with all of its digits; it was printed with nine, from which the rates of the rod's
# modes differ in the fifth. These are of the printed start, by RadauIIA and DOP853, which agree to 1e-12.
CRANK = {
    "phi1": 15.0, "phi2": -0.3311734946276, "x3": 0.1697373332526, "q1": 1.893192938164e-4, "q2": 2.375751323353e-5,
    "q3": -5.323896758448e-6, "q4": -8.363313255463e-6, "dphi1": 150.0, "dphi2": 60.2534675063, "dx3": -8.753116402858,
}  # fmt: skip

RINGS = ((3, 13, 3 / 8), (7, 29, 1 / 8), (6, 7, -2 / 15), (4, 17, -3 / 10))  # points, 1/turn, height, in parts of pi


def fekete():
    q = sv.coordinates(" ".join(f"{c}{i}" for i in range(20) for c in "xyz"))
    points = [ca.vertcat(*q[3 * i : 3 * i + 3]) for i in range(20)]
    apart = [ca.log(ca.sumsqr(a - b)) / 2 for i, a in enumerate(points) for b in points[:i]]
    forces = {name: -0.5 * v for name, v in zip(q.names, q.d(1), strict=True)}
    rows = {f"sphere{i}": ca.sumsqr(p) - 1 for i, p in enumerate(points)}
    S = sum(sv.particle(q, 1.0, p) for p in points)
    return sv.plant(sv.Mechanism(q, S, potential=-sum(apart), forces=forces, constraints=rows))


def fekete_start():
    start, i = {}, 0
    for k, (count, turn, height) in enumerate(RINGS):
        for j in range(count):
            alpha = 2 * np.pi * (j + (k < 3)) / count + np.pi / turn  # the last ring begins at zero
            values = (np.cos(alpha) * np.cos(np.pi * height), np.sin(alpha) * np.cos(np.pi * height))
            start |= dict(zip((f"x{i}", f"y{i}", f"z{i}"), (*values, np.sin(np.pi * height)), strict=True))
            i += 1
    return start | {f"d{name}": 0.0 for name in start}


FEKETE = dict(
    zip((f"{c}{i}" for i in range(5) for c in "xyz"), (
        -0.4070263380333202, 0.3463758772791802, 0.8451942450030429, 0.7752934752521549e-1, -0.2628662719972299,
        0.9617122871829146, 0.7100577833343567, 0.1212948055586120, 0.6936177005172217, 0.2348267744557627,
        0.7449277976923311, 0.6244509285956391, -0.4341114738782885, 0.8785430442262876, 0.1992720444237660,
    ), strict=True)
)  # fmt: skip


# the stiff flyball governor, A05 of the IFToMM's library --------------------------------------------------------------

GOVERNOR = {"offset": 0.05, "rod": 0.3, "ball": 5.0, "slider": 3.0, "spin": 0.3 * 2e-4 / 12 + 3.0 * 0.02 / 12}
SPRING, DAMPER, REST = 8e5, 4e4, 0.5  # N/m, N s/m, m
ROD = ((0.0, 0.3 / 6), (0.5, 4 * 0.3 / 6), (1.0, 0.3 / 6 + 5.0))  # a thin rod and its ball: masses at parts of 1 m


def governor():
    """Coordinates: angle of the shaft, angles of both rods from below [rad], height of the slider [m]."""
    q = sv.coordinates("psi a b s")
    psi, a, b, s = q
    S, potential, forces = sv.particle(q, 3.0, ca.vertcat(0, 0, s)), 3.0 * G * s, 0
    S += GOVERNOR["spin"] * q.d(2)[0] ** 2 / 2
    for angle, side in ((a, 1.0), (b, -1.0)):
        for part, mass in ROD:
            r = side * (GOVERNOR["offset"] + part * ca.sin(angle))
            point = ca.vertcat(r * ca.cos(psi), r * ca.sin(psi), 1.0 - part * ca.cos(angle))
            S, potential = S + sv.particle(q, mass, point), potential + mass * G * point[2]
        length = ca.norm_2(ca.vertcat(ca.sin(angle) / 2, 1.0 - ca.cos(angle) / 2 - s))
        potential += SPRING * (length - REST) ** 2 / 2
        forces -= DAMPER * q.dt(length) * ca.gradient(length, ca.vertcat(*q))
    return sv.plant(sv.Mechanism(q, S, potential=potential, forces=forces))


GOVERNOR_START = {
    "psi": 0.0, "a": np.pi / 3, "b": np.pi / 3, "s": 0.5, "dpsi": 2 * np.pi, "da": 0.0, "db": 0.0, "ds": 0.0,
}  # fmt: skip


def governor_rates(t, y):
    """The symmetric motion of (psi, a, s, a', s'), with the spin from its conserved angular momentum."""
    psi, a, s, da, ds = y

    def spin(angle):
        return GOVERNOR["spin"] + 2 * sum(m * (GOVERNOR["offset"] + u * np.sin(angle)) ** 2 for u, m in ROD)

    dpsi = 2 * np.pi * spin(np.pi / 3) / spin(a)
    across, along = np.sin(a) / 2, 1.0 - np.cos(a) / 2 - s
    length = np.hypot(across, along)
    by_a, by_s = (across * np.cos(a) + along * np.sin(a)) / (2 * length), -along / length
    pull = SPRING * (length - REST) + DAMPER * (by_a * da + by_s * ds)
    turn = sum(m * u * ((GOVERNOR["offset"] + u * np.sin(a)) * np.cos(a) * dpsi**2 - G * np.sin(a)) for u, m in ROD)
    return np.array([dpsi, da, ds, (turn - pull * by_a) / sum(m * u**2 for u, m in ROD), -G - 2 * pull * by_s / 3.0])


# the rattleback of Kane and Levinson (1982) ---------------------------------------------------------------------------

HALF_AXES, ABOVE, SPREAD, DRAG = (0.2, 0.03, 0.02), 0.01, (2e-4, 16e-4, 17e-4, -0.2e-4), 1e-4  # m, m, m^2, m^2/s


def rattleback():
    """Of 1 kg, rolling on its ellipsoid; angles of turns about the vertical (down), axis 1 and axis 2; body rates."""
    plain = sv.coordinates("x y alpha beta gamma")
    alpha, beta, gamma = plain[2:]
    (ca_, sa), (cb, sb) = ((ca.cos(angle), ca.sin(angle)) for angle in (alpha, beta))
    down = ca.vertcat(-ca_ * sb, sa, ca_ * cb)
    squares = ca.DM(HALF_AXES) ** 2
    contact = squares * down / ca.sqrt(ca.dot(squares, down**2)) - ca.vertcat(0, 0, ABOVE)
    turn = sv.rotations.turn
    R = turn(gamma, (0, 0, 1)) @ turn(alpha, (1, 0, 0)) @ turn(beta, (0, 1, 0))
    rates = ca.vertcat(
        ca.horzcat(cb, 0, sb),
        ca.horzcat(sb * sa / ca_, 1, -cb * sa / ca_),
        ca.horzcat(-sb / ca_, 0, cb / ca_),
    )
    q = plain.with_quasi_velocities("w1 w2 w3", ca.vertcat((R @ ca.skew(contact))[:2, :], rates))
    A, B, C, D = SPREAD
    inertia = ca.DM([[A, D, 0], [D, B, 0], [0, 0, C]])
    height = ca.dot(down, contact)
    S = sv.rigid_body(q, 1.0, inertia, position=ca.vertcat(*q[:2], -height), rates=q.w())
    drag = {name: -DRAG * w for name, w in zip(q.velocity_names, q.w(), strict=True)}
    return sv.plant(sv.Mechanism(q, S, potential=G * height, forces=drag))


RATTLEBACK_START = dict.fromkeys(("x", "y", "gamma", "w1", "w2"), 0.0) | {
    "alpha": np.radians(0.5), "beta": np.radians(0.5), "w3": -5.0,
}  # fmt: skip


def rattleback_rates(t, y):
    """(alpha, beta, gamma, body rates): moments about the point of contact."""
    w = y[3:]
    (ca_, sa), (cb, sb) = ((np.cos(angle), np.sin(angle)) for angle in y[:2])
    down, squares = np.array([-ca_ * sb, sa, ca_ * cb]), np.square(HALF_AXES)
    e = np.sqrt(squares @ down**2)
    r = squares * down / e - [0, 0, ABOVE]
    turned = np.cross(down, w)
    moved = squares * (turned / e - down * (squares @ (down * turned)) / e**3)
    A, B, C, D = SPREAD
    inertia = np.array([[A, D, 0], [D, B, 0], [0, 0, C]])
    # acceleration of the centre: (r x w)' + w x (r x w), of which r x w' is the part with w'
    known = np.cross(moved, w) + np.cross(w, np.cross(r, w))
    moment = G * np.cross(down, r) - DRAG * w - np.cross(w, inertia @ w) + np.cross(r, known)
    skew = np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])
    dw = np.linalg.solve(inertia - skew @ skew, moment)
    dalpha, dgamma = w[0] * cb + w[2] * sb, (w[2] * cb - w[0] * sb) / ca_
    return np.array([dalpha, w[1] - dgamma * sa, dgamma, *dw])


# the snakeboard of Ostrowski, Lewis, Murray and Burdick (1994) --------------------------------------------------------

BOARD, BODY, ROTOR, WHEELS, HALF = 6.0, 0.016, 0.072, 0.0013, 0.2  # kg, kg m^2 each, m
ROTOR_SWING, WHEEL_SWING = 0.7, 0.3  # rad, both by sin(t): the gait that drives it ahead


def snakeboard():
    q = sv.coordinates("x y theta psi phi")
    x, y, theta, psi, phi = q
    d2 = q.d(2)
    S = sv.particle(q, BOARD, ca.vertcat(x, y)) + BODY * d2[2] ** 2 / 2 + ROTOR * (d2[2] + d2[3]) ** 2 / 2
    S += WHEELS * ((d2[2] + d2[4]) ** 2 + (d2[2] - d2[4]) ** 2) / 2
    rows = {}
    for name, side in (("front", 1), ("back", -1)):
        axle = ca.vertcat(x + side * HALF * ca.cos(theta), y + side * HALF * ca.sin(theta))
        heading = theta + side * phi
        rows[name] = ca.dot(ca.vertcat(-ca.sin(heading), ca.cos(heading)), q.dt(axle))
    mechanism = sv.Mechanism(q, S, actuators={"rotor": psi, "steering": phi}, constraints=rows)
    gait = {"rotor": psi - ROTOR_SWING * ca.sin(q.t), "steering": phi - WHEEL_SWING * ca.sin(q.t)}
    return mechanism, sv.Program(gait)


def snakeboard_rates(t, y):
    """(x, y, theta, speed ahead): the row along the one free direction."""
    theta, u = y[2:]
    phi, dphi, spin = WHEEL_SWING * np.sin(t), WHEEL_SWING * np.cos(t), -ROTOR_SWING * np.sin(t)
    turn, inertia = np.tan(phi) / HALF, BODY + ROTOR + 2 * WHEELS
    lean = dphi / np.cos(phi) ** 2 / HALF
    du = -(turn * ROTOR * spin + inertia * turn * lean * u) / (BOARD + inertia * turn**2)
    return np.array([u * np.cos(theta), u * np.sin(theta), turn * u, du])


# the rectangular Bricard mechanism, A04 of the IFToMM's library -------------------------------------------------------

EDGES = ((1, 0, 0), (0, -1, 0), (0, 0, 1), (-1, 0, 0), (0, 1, 0))  # of five rods; the sixth is the ground
AXES = ((0, 1, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1))  # of the joints at their beginnings; the last along x
THICK = 0.1  # m


def bricard_parts():
    """Coordinates, Gibbs-Appell function, height and five rows, of which four are independent."""
    q = sv.coordinates("a1 a2 a3 a4 a5")
    R, end, S, height = ca.SX.eye(3), ca.SX.zeros(3), 0, 0
    for angle, edge, axis in zip(q, EDGES, AXES, strict=True):
        R = R @ sv.rotations.turn(angle, axis)
        rod = R @ ca.DM(edge)
        J = [(THICK**2 + (THICK if e else 1.0) ** 2) / 12 for e in edge]
        S, height = S + sv.rigid_body(q, 1.0, J, position=end + rod / 2, rotation=R), height + end[1] + rod[1] / 2
        end = end + rod
    return q, S, height, {"X": end[0], "Y": end[1], "Z": end[2] - 1.0, "tilt": R[1, 0], "turn": R[2, 0]}


def bricard():
    q, S, height, rows = bricard_parts()
    del rows["tilt"]
    return sv.plant(sv.Mechanism(q, S, potential=G * height, constraints=rows))


BRICARD_START = {f"{d}a{i}": 0.0 for d in ("", "d") for i in range(1, 6)}


@cache
def bricard_rates():
    """Rates of (angles, their rates) by least squares of all five rows."""
    q, S, height, rows = bricard_parts()
    v, a, g = ca.vertcat(*q.d(1)), ca.vertcat(*q.d(2)), ca.vertcat(*rows.values())
    balance = ca.gradient(S, a) + G * ca.gradient(height, ca.vertcat(*q))
    M, rest = ca.jacobian(balance, a), ca.substitute(balance, a, ca.SX.zeros(5))
    J = ca.jacobian(g, ca.vertcat(*q))
    f = ca.Function("f", [ca.vertcat(*q), v], [M, rest, J, ca.jtimes(J @ v, ca.vertcat(*q), v)])

    def rates(t, y):
        M, rest, J, bent = (np.array(part) for part in f(y[:5], y[5:]))
        left = np.block([[M, J.T], [J, np.zeros((5, 5))]])
        return np.concatenate([y[5:], np.linalg.lstsq(left, -np.vstack([rest, bent])[:, 0], rcond=1e-9)[0][:5]])

    return rates


# the robot arm with a flexible joint of De Luca and Isidori (1987), of index 5 ----------------------------------------


def flexible_arm():
    """Two links of 1 m with 1 kg at their ends, the second one driven through a spring; both follow given angles."""
    q = sv.coordinates("x1 x2 x3")
    x1, x2, x3 = q
    elbow = ca.vertcat(ca.cos(x1), ca.sin(x1))
    S = sv.particle(q, 1.0, elbow) + sv.particle(q, 1.0, elbow + ca.vertcat(ca.cos(x1 + x3), ca.sin(x1 + x3)))
    S += (q.d(2)[0] + q.d(2)[1]) ** 2 / 2  # the rotor, on the first link
    mechanism = sv.Mechanism(q, S, potential=(x3 - x2) ** 2 / 2, actuators={"u1": x1, "u2": x2})
    e = ca.exp(q.t)
    return mechanism, sv.Program({"first": x1 - (1 - e), "second": x3 - (e - q.t)})


def flexible_arm_truth(t):
    """The balance of the second link gives x2, that of the rotor u2: by automatic differentiation."""
    s = ca.SX.sym("t")
    x1, x3 = 1 - ca.exp(s), ca.exp(s) - s

    def rate(x):
        return ca.jacobian(x, s)

    pull = (1 + ca.cos(x3)) * rate(rate(x1)) + rate(rate(x3)) + ca.sin(x3) * rate(x1) ** 2
    x2 = pull + x3
    values = {"x1": x1, "x2": x2, "x3": x3, "dx2": rate(x2), "u2": rate(rate(x1 + x2)) + pull}
    return {name: float(ca.evalf(ca.substitute(value, s, t))) for name, value in values.items()}


# all problems ---------------------------------------------------------------------------------------------------------

PENDULUM_START = {"x": -1.0, "y": 0.0, "dx": 0.0, "dy": 0.0}
GOVERNOR_END = {
    "psi": 55.93539999404, "a": 1.180719278363, "s": 0.619619822412, "da": -0.80846941919, "ds": -0.74760451854,
}  # fmt: skip
RATTLEBACK_END = {
    "alpha": 0.01724994923, "beta": -2.649403645e-5, "gamma": 36.3129019016, "w1": -0.320211712894,
    "w2": 0.026466125545, "w3": 1.524851985675,
}  # fmt: skip
SNAKEBOARD_END = {"x": 11.88197360018, "y": -0.010956722500, "theta": -0.604740264942}
BRICARD_END = {
    "a1": 0.235697968378, "a2": -0.190462461318, "a3": 0.235697968378, "da1": -0.997092378002, "da2": 0.648918925858,
}  # fmt: skip

TEST_SET, LIBRARY = "IVP test set, release 2.4", "IFToMM's library of benchmarks, González et al. (2006)"
PROBLEMS = {
    f"pendulum {t:g} s": Problem(
        f"A01, {LIBRARY}; Jacobi's functions", pendulum, PENDULUM_START, t, lambda t=t: pendulum_truth(t)
    )
    for t in (10.0, 100.0, 1000.0)
} | {
    "car axis": Problem(TEST_SET, car_axis, CAR_AXIS_START, 3.0, lambda: CAR_AXIS, relative=True),
    "andrews": Problem(TEST_SET, andrews, ANDREWS_START, 0.03, lambda: ANDREWS, relative=True),
    "slider crank": Problem(TEST_SET, crank, CRANK_START, 0.1, lambda: CRANK, relative=True),
    "fekete": Problem(TEST_SET, fekete, fekete_start(), 1000.0, lambda: FEKETE, without=("Taylor", "RK8", "LSODA")),
    "governor": Problem(f"A05, {LIBRARY}; by hand", governor, GOVERNOR_START, 10.0, lambda: GOVERNOR_END),
    "bricard": Problem(
        f"A04, {LIBRARY}; by hand", bricard, BRICARD_START, 9.5, lambda: BRICARD_END, without=("Taylor",)
    ),
    "rattleback": Problem("Kane, Levinson (1982); by hand", rattleback, RATTLEBACK_START, 20.0, lambda: RATTLEBACK_END),
    "snakeboard": Problem(
        "Ostrowski et al. (1994), ten gaits; by hand", snakeboard, {}, 20 * np.pi, lambda: SNAKEBOARD_END
    ),
    "flexible arm": Problem(
        "De Luca, Isidori (1987); closed form", flexible_arm, {}, 1.0, lambda: flexible_arm_truth(1.0)
    ),
}  # fmt: skip

BY_HAND = {
    "governor": (governor_rates, [0.0, np.pi / 3, 0.5, 0.0, 0.0], list(GOVERNOR_END)),
    "rattleback": (rattleback_rates, [*np.radians([0.5, 0.5]), 0.0, 0.0, 0.0, -5.0], list(RATTLEBACK_END)),
    "snakeboard": (snakeboard_rates, [0.0] * 4, list(SNAKEBOARD_END)),
    "bricard": (lambda t, y: bricard_rates()(t, y), [0.0] * 10, [f"{d}a{i}" for d in ("", "d") for i in range(1, 6)]),
}


def truths():
    """Print own truths by two methods each."""
    for name, (rates, start, entries) in BY_HAND.items():
        for method, rtol in (("Radau" if name == "governor" else "DOP853", 1e-12), ("LSODA", 1e-13)):
            end = solve_ivp(rates, (0.0, PROBLEMS[name].until), start, method, rtol=rtol, atol=1e-14).y[:, -1]
            print(name, method, {entry: float(value) for entry, value in zip(entries, end, strict=False)}, flush=True)


# measuring ------------------------------------------------------------------------------------------------------------

REPEATS, ENOUGH = 5, 4.0  # the second or later calls, fewer where they take more CPU s than this
PATIENCE = 6.0  # CPU s, after which a method of SciPy is given up
RTOLS = (1e-5, 1e-7, 1e-9, 1e-11)  # of which 1e-9 is the default
STEPS = (500, 2000, 8000, 32000)  # of RK8
ONE_AS_GOOD = 0.3  # digits, by which another setting may be worse and counts as good


def settings(problem):
    """The default, and own methods by name with their settings: a list of (label, method)."""
    ladder = [("default", None)]
    for rtol in RTOLS:
        ladder += [(f"Taylor, {rtol:.0e}", sv.methods.Taylor(rtol=rtol))]
        ladder += [(f"RadauIIA, {rtol:.0e}", sv.methods.RadauIIA(rtol=rtol))]
        ladder += [(f"DOP853, {rtol:.0e}", sv.methods.Adaptive("DOP853", rtol))]
    ladder += [(f"RK8, {n} steps", sv.methods.RungeKutta(8, problem.until / n)) for n in STEPS]
    return [(label, method) for label, method in ladder if not label.startswith(problem.without or " ")]


def ours(problem, model, start, method):
    """A call, which returns the values at the end by name, and the run's message."""

    def call():
        run = sv.simulate(model, start, (0.0, problem.until), method, compiled=True)
        return {name: float(run[name][-1]) for name in problem.truth()}, run.message

    return call


def peers(problem, model, start):
    """SciPy's methods on our rates, with the pivots that a motion begins with: a list of (label, call)."""
    x0 = np.array(getattr(start, "values", start), dtype=float)
    model = sv.simulate(model, start, (0.0, problem.until * 1e-3)).variant(0)
    f, names, p, until = model.function("ode"), list(model.state_names), model.p, problem.until

    def call(method, rtol):
        latest = cpu_seconds() + PATIENCE

        def rates(t, x):
            if cpu_seconds() > latest:
                raise TimeoutError(f"more than {PATIENCE:g} CPU s until t = {t:.2g} s")
            return f(t, x, p)[: len(x0)]

        end = solve_ivp(rates, (0.0, until), x0, method, rtol=rtol, atol=1e-2 * rtol)
        return {name: end.y[names.index(name), -1] for name in problem.truth()}, "" if end.success else end.message

    methods = [method for method in ("DOP853", "LSODA", "Radau") if method not in problem.without]
    some = [(method, rtol) for rtol in RTOLS for method in methods]
    return [(f"scipy {m}, {rtol:.0e}", lambda m=m, rtol=rtol: call(m, rtol)) for m, rtol in some]


def timed(call, problem):
    """Digits, median CPU s, CPU s of the first call, and what was said; None for digits where a call fails."""
    began = cpu_seconds()
    try:
        values, message = call()
    except Exception as error:
        return None, cpu_seconds() - began, cpu_seconds() - began, f"{type(error).__name__}: {error}"
    first, samples = cpu_seconds() - began, []
    while len(samples) < REPEATS and sum(samples) < ENOUGH and first < 30.0:
        began = time.process_time()
        call()
        samples.append(time.process_time() - began)
    return problem.digits(values), statistics.median(samples or [first]), first, message


def measure(name, with_peers):
    """Print the table of one problem, and the default beside the best of the others at its error."""
    problem, began = PROBLEMS[name], cpu_seconds()
    model, start = prepared(problem)
    derived = cpu_seconds() - began
    print(f"\n{name} ({problem.source}), t = {problem.until:g} s; derived in {derived:.2f} CPU s", flush=True)
    print("| method | digits | CPU s | first | |\n|---|---|---|---|---|", flush=True)
    calls = [(label, ours(problem, model, start, method)) for label, method in settings(problem)]
    found = {}
    others = peers(problem, model, start) if with_peers and not model.flat else []
    for label, call in calls + others:
        digits, seconds, first, message = timed(call, problem)
        shown = "" if digits is None else f"{digits:.1f}"
        print(f"| {label} | {shown} | {seconds:.4f} | {first:.2f} | {message[:90]} |", flush=True)
        found[label] = digits, seconds
    wanted, took = found["default"]
    if wanted is None:
        return
    for whose, theirs in (("own", False), ("SciPy's", True)):
        good = [
            (seconds, label) for label, (digits, seconds) in found.items()
            if label.startswith("scipy") == theirs and digits is not None and digits >= wanted - ONE_AS_GOOD
        ]  # fmt: skip
        if good:
            print(f"default / best {whose} at its error: {took / min(good)[0]:.2f} ({min(good)[1]})", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("problems", nargs="*", help=f"of {', '.join(PROBLEMS)}")
    parser.add_argument("--truths", action="store_true", help="print own truths, computed again")
    parser.add_argument("--ours", action="store_true", help="leave out SciPy's methods")
    args = parser.parse_args()
    if args.truths:
        return truths()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in args.problems or PROBLEMS:
            measure(name, not args.ours)


if __name__ == "__main__":
    main()
