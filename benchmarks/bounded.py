"""The bounded motion of an arm with a passive joint, whose internal dynamics are unstable, from rest to rest.

`sv.simulate` with `sv.Bounded()` against scipy's solve_bvp on the same equations, written by hand for NumPy.
"""

from math import pi

import casadi as ca
import numpy as np
from harness import Row

import servoctl as sv

M, L, I, C, D, GAMMA, T = 6.875, 1.0, 0.57, 50.0, 0.25, 0.5, 2.0  # kg, m, kg m^2, N m/rad, N m s/rad, 1, s
INSTANTS = np.linspace(0.0, T, 101)
ANCHORS = {25: -0.308555247, 75: 0.312284407}  # q2 at 0.5 and 1.5 s
WINDOW = 1.6  # s before and after the path for solve_bvp: 15 time constants


def along():
    """The passive joint's angle at the instants, by the toolkit."""
    q = sv.coordinates("q1 q2")
    (q1, q2), (dq1, dq2) = q, q.d(1)
    links = [ca.vertcat(ca.cos(a), ca.sin(a)) for a in (q1, q1 + q2)]
    S = sv.rigid_body(q, M, (0, 0, I), position=L / 2 * links[0], rates=(0, 0, dq1))
    S += sv.rigid_body(q, M, (0, 0, I), position=L * links[0] + L / 2 * links[1], rates=(0, 0, dq1 + dq2))
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=C * q2**2 / 2, forces={"q2": -D * dq2}, actuators={"torque": q1}
    )
    path = sv.paths.rest_to_rest(q.t, 0.0, pi / 2, duration=T, smoothness=4)
    model = sv.derive(mechanism, sv.Program({"angle": q1 + GAMMA * q2 - path}))
    start = model.start()
    return lambda: sv.simulate(model, start, (0.0, T), sv.Bounded(), t_eval=INSTANTS)["q2"]


def path(t, k):
    """The k-th derivative of the programmed angle."""
    from numpy.polynomial import Polynomial

    s9 = Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
    inside = (t > 0) & (t < T)
    return np.where(inside, pi / 2 * s9.deriv(k)(np.clip(t / T, 0, 1)) / T**k, 0.0)


def rates(t, y):
    """(q2', q2'') from the balance of the passive joint, with q1 = path - Γ q2."""
    q2, dq2 = y
    a, b = I + M * L**2 / 4, M * L**2 / 2
    coupling = a + b * np.cos(q2)
    turning = path(t, 1) - GAMMA * dq2
    force = -coupling * path(t, 2) - b * np.sin(q2) * turning**2 - C * q2 - D * dq2
    return np.array([dq2, force / (a - GAMMA * coupling)])


def general():
    """The same by scipy's solve_bvp, with the eigenvectors at rest as boundary rows."""
    from scipy.integrate import solve_bvp

    a, b = I + M * L**2 / 4, M * L**2 / 2
    effective = a - GAMMA * (a + b)
    stable, unstable = np.sort(np.roots([effective, D, C]).real)

    def ends(first, last):
        return np.array([first[1] - unstable * first[0], last[1] - stable * last[0]])

    mesh = np.unique(np.concatenate([np.linspace(-WINDOW, T + WINDOW, 401), [0.0, T]]))

    def call():
        return solve_bvp(rates, ends, mesh, np.zeros((2, len(mesh))), tol=1e-9, max_nodes=10**6).sol(INSTANTS)[0]

    return call


def error(q2):
    """Largest difference from the known values [rad]."""
    return max(abs(q2[k] - value) for k, value in ANCHORS.items())


def row():
    return Row(
        "Bounded motion of a passive arm, 101 instants, error 1e-9",
        along(),
        {"scipy solve_bvp, NumPy by hand": general()},
        error,
        1e-9,
        {"scipy solve_bvp, NumPy by hand": 100},
        {"scipy solve_bvp, NumPy by hand": 1e-7},
    )


ROWS = {"bounded": row}
