"""Bounded motions of programs with unstable internal dynamics, from rest to rest.

`sv.simulate` with `sv.methods.Bounded()` against scipy's solve_bvp: on the functions of the model, called for one
instant or for all instants at a time, and for the arm with a passive joint on its equations written by hand for
NumPy. A peer solves for the free entries of the state that we chose for it, with the eigenvectors at rest as its
boundary rows and our tolerance.
"""

from math import pi

import casadi as ca
import numpy as np
from harness import Row

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.model.equations import invariant_names

M, L, I, C, D, GAMMA = 6.875, 1.0, 0.57, 50.0, 0.25, 0.5  # kg, m, kg m^2, N m/rad, N m s/rad, 1
WINDOW = 15.0  # time constants before and after the path for solve_bvp
WITHIN = 1e-9  # rad, at the known values and at all instants
TOLERANCE = sv.methods.Bounded().rtol  # 1e-9; peers are right from 1e-7 on, in a third to a half of the time
ONE, ALL, HAND = (f"scipy solve_bvp, {on}" for on in ("model by instants", "model by arrays", "NumPy by hand"))


def arm():
    """Two links with a torque on the first: the model, the path's duration [s], the free angle, known values."""
    q = sv.coordinates("q1 q2")
    (q1, q2), (dq1, dq2) = q, q.d(1)
    links = [ca.vertcat(ca.cos(a), ca.sin(a)) for a in (q1, q1 + q2)]
    S = sv.rigid_body(q, M, (0, 0, I), position=L / 2 * links[0], rates=(0, 0, dq1))
    S += sv.rigid_body(q, M, (0, 0, I), position=L * links[0] + L / 2 * links[1], rates=(0, 0, dq1 + dq2))
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=C * q2**2 / 2, forces={"q2": -D * dq2}, actuators={"torque": q1}
    )
    r = q.references(angle=sv.paths.rest_to_rest(0.0, pi / 2, duration=2.0, smoothness=4))
    model = sv.derive(mechanism, sv.Program({"angle": q1 + GAMMA * q2 - r.angle}))
    return model, 2.0, "q2", {0.5: -0.308555247, 1.5: 0.312284407}


def aircraft():
    """As `arm`: the centre of mass of the gallery's aircraft, from (0, 0) to (10, 5) m."""
    mechanism, _ = gallery["vtol-centre"].build()
    x, z, _ = mechanism.q
    path = sv.paths.rest_to_rest((0.0, 0.0), (10.0, 5.0), duration=3.0, smoothness=4)
    X, Z = mechanism.q.references(across=path[0], up=path[1])
    model = sv.derive(mechanism, sv.Program({"X": x - X, "Z": z - Z}))
    return model, 3.0, "theta", {0.75: -0.563010398, 2.25: 1.033108370}


def motion(scene, tolerance=None):
    """The free angle at the instants, by the toolkit."""
    model, duration, name, _ = scene
    start, method = model.start(), sv.methods.Bounded() if tolerance is None else sv.methods.Bounded(rtol=tolerance)
    return lambda: sv.simulate(model, start, (0.0, duration), method, t_eval=instants(duration))[name]


def instants(duration):
    return np.linspace(0.0, duration, 101)


def by_arrays(model):
    """X' and the invariants with their Jacobian at instants (N,) and states (n_x, N)."""
    ode, invariants, p = model.function("ode"), model.function("invariants"), model.p
    return lambda t, x: (ode.grid(t, x, p), invariants.grid(t, x, p))


def by_instants(model):
    """As `by_arrays`, by one call for each instant."""
    ode, invariants, p = model.function("ode"), model.function("invariants"), model.p

    def values(t, x):
        return [np.array([f(s, each, p) for s, each in zip(t, x.T, strict=True)]).T for f in (ode, invariants)]

    return values


def of_model(scene, values):
    """The free angle by solve_bvp, with the rates of the free joint on the invariants of the model."""
    model, duration, name, _ = scene
    x0, n, m = np.asarray(model.start().values), len(model.state_names), len(invariant_names(model))
    free = [model.state_names.index(each) for each in (name, f"d{name}")]
    solved = [i for i in range(n) if i not in free]
    values = values(model)

    def rates(t, z):
        x = np.repeat(x0[:, None], len(t), axis=1)
        x[free] = z
        for _ in range(12):  # of Newton's method, onto the invariants
            y = values(t, x)[1]
            slopes = y[m:].T.reshape(len(t), n, m).swapaxes(1, 2)[:, :, solved]
            step = np.linalg.solve(slopes, y[:m].T[:, :, None])[:, :, 0].T
            x[solved] -= step
            if np.abs(step).max() < 1e-13:
                break
        return values(t, x)[0][:n][free]

    return general(rates, x0[free], duration)


def by_hand(scene):
    """The free angle of the arm by solve_bvp, from the balance of the passive joint with q1 = path - Γ q2."""
    from numpy.polynomial import Polynomial

    T, s9 = scene[1], Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
    a, b = I + M * L**2 / 4, M * L**2 / 2

    def path(t, k):
        return np.where((t > 0) & (t < T), pi / 2 * s9.deriv(k)(np.clip(t / T, 0, 1)) / T**k, 0.0)

    def rates(t, y):
        q2, dq2 = y
        coupling = a + b * np.cos(q2)
        turning = path(t, 1) - GAMMA * dq2
        force = -coupling * path(t, 2) - b * np.sin(q2) * turning**2 - C * q2 - D * dq2
        return np.array([dq2, force / (a - GAMMA * coupling)])

    return general(rates, np.zeros(2), T)


def general(rates, rest, duration):
    """z' = rates(t, z) of two entries by solve_bvp: stable ones are zero before the path, unstable ones after it."""
    from scipy.integrate import solve_bvp

    def call():
        small, one = 1e-6, np.eye(2)
        t = np.zeros(2)
        A = (rates(t, rest[:, None] + small * one) - rates(t, rest[:, None] - small * one)) / (2 * small)
        values, vectors = np.linalg.eig(A.T)
        stable, unstable = vectors.T[values < 0], vectors.T[values > 0]

        def ends(first, last):
            return np.concatenate([stable @ (first - rest), unstable @ (last - rest)])

        window = WINDOW / np.abs(values).min()
        mesh = np.unique(np.concatenate([np.linspace(-window, duration + window, 401), [0.0, duration]]))
        guess = np.repeat(rest[:, None], len(mesh), axis=1)
        return solve_bvp(rates, ends, mesh, guess, tol=TOLERANCE, max_nodes=10**6).sol(instants(duration))[0]

    return call


def compared(title, scene, hand=False):
    """The row of a scene."""
    _, duration, _, known = scene
    fine, places = motion(scene, 1e-12)(), {int(np.argmin(abs(instants(duration) - t))): v for t, v in known.items()}

    def error(angle):
        return max(np.abs(angle - fine).max(), *(abs(angle[k] - value) for k, value in places.items()))

    peers = {ONE: of_model(scene, by_instants), ALL: of_model(scene, by_arrays)}
    peers |= {HAND: by_hand(scene)} if hand else {}
    return Row(title, motion(scene), peers, error, WITHIN, {ONE: 100})


ROWS = {
    "bounded": lambda: compared("Bounded motion of a passive arm, 101 instants, error 1e-9", arm(), hand=True),
    "bounded-aircraft": lambda: compared("Bounded motion of an aircraft, 101 instants, error 1e-9", aircraft()),
}
