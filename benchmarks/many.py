"""Many motions: the Appell-Hamel mechanism for 10 s with 1,000 pairs of masses, each end within 1e-6, on one thread.

For everyone the fastest setting that meets the error is taken. Peers solve the 7 equations reduced by hand.
"""

from functools import cache, partial

import numpy as np
from appell_hamel import COARSE, DURATION, START, P, constrained, ladder, rolling
from harness import Missing, Row, fastest, installed

import servoctl as sv
from servoctl.methods.lanes import OF_A_CASE, integrate

CASES, WITHIN, BATCH = 1000, 1e-6, 8
NAMES = ("x", "y", "z", "phi", "theta")
SETTINGS = [(last, rtol) for last, rtol in COARSE if last > 8]


@cache
def masses():
    """m and M of the cases [kg]."""
    spread = np.random.default_rng(11).uniform(0.8, 1.2, (2, CASES))
    return {"m": P["m"] * spread[0], "M": P["M"] * spread[1]}


@cache
def coefficients():
    """Those of the reduced equations dphi' = c_0 dtheta^2 - c_1, dtheta' = -c_2 dphi dtheta, (3, CASES)."""
    m, M = masses().values()
    along, weight = m * P["a"] * P["rho"], P["b"] * m * P["g"]
    A = P["I_y"] + P["a"] ** 2 * (M + m) + P["b"] ** 2 * m
    return np.array([along / A, weight / A, along / (P["I_x"] + m * P["rho"] ** 2)])


def rates(state):
    _, _, _, _, theta, dphi, dtheta = state
    s, c, (c_0, c_1, c_2) = np.sin(theta), np.cos(theta), coefficients()
    return np.array([
        0.3 * dphi * c - 0.2 * dtheta * s, 0.3 * dphi * s + 0.2 * dtheta * c, -0.1 * dphi, dphi, dtheta,
        c_0 * dtheta**2 - c_1, -c_2 * dphi * dtheta,
    ])  # fmt: skip


@cache
def ends(steps=4000):
    """The reduced states after 10 s, (7, CASES), by RK4 in steps of 2.5 ms, to 1e-11."""
    x, h = np.tile(START[:, None], CASES), DURATION / steps
    for _ in range(steps):
        k1 = rates(x)
        k2 = rates(x + h / 2 * k1)
        k3 = rates(x + h / 2 * k2)
        k4 = rates(x + h * k3)
        x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
    return x


def error(found):
    return np.abs(found - ends()).max()


# ours ----------------------------------------------------------------------------------------------------------------


def lanes(scene, last, rtol):
    model, start = scene()
    p, names = np.tile(model.parameters, (CASES, 1)), list(model.numbers)
    for name, values in masses().items():
        p[:, names.index(name)] = values
    cases = np.tile(start.values, (CASES, 1)), p, np.full(CASES, rtol)
    velocities = [model.state_names.index(name) for name in model.state_names if name.endswith(("phi", "theta"))][2:]
    columns = [*range(len(NAMES)), *velocities]

    def call():
        x, *_ = integrate(model, last, (0.0, DURATION), cases, rtol, np.zeros(0), threads=1)
        return np.where(x[:, 0] == 1, x[:, len(OF_A_CASE) :][:, : start.values.size].T, np.nan)[columns]

    return call


def simulated(last, rtol):
    model, start = constrained()
    columns = [f"final {name}" for name in (*NAMES, "dphi", "dtheta")]

    def call():
        method = sv.methods.Taylor(last - 1, rtol=rtol, atol=rtol)
        many = sv.simulate_many(model, start, masses(), (0.0, DURATION), method, executor=1)
        return np.array([many[name] for name in columns])

    return call


# peers ---------------------------------------------------------------------------------------------------------------


def heyoka_batch(tolerance, fast_math=False):
    import heyoka as hy

    x, y, z, phi, theta, dphi, dtheta = hy.make_vars("x", "y", "z", "phi", "theta", "dphi", "dtheta")
    s, c, (c_0, c_1, c_2) = hy.sin(theta), hy.cos(theta), (hy.par[i] for i in range(3))
    system = [
        (x, 0.3 * dphi * c - 0.2 * dtheta * s), (y, 0.3 * dphi * s + 0.2 * dtheta * c), (z, -0.1 * dphi),
        (phi, dphi), (theta, dtheta), (dphi, c_0 * dtheta * dtheta - c_1), (dtheta, -c_2 * dphi * dtheta),
    ]  # fmt: skip
    start, result = np.tile(START[:, None], BATCH), np.empty((7, CASES))
    integrator = hy.taylor_adaptive_batch(system, start, tol=tolerance, pars=np.zeros((3, BATCH)), fast_math=fast_math)

    def call():
        for i in range(0, CASES, BATCH):
            integrator.set_time(0.0)
            integrator.state[:], integrator.pars[:] = start, coefficients()[:, i : i + BATCH]
            integrator.propagate_until(DURATION)
            result[:, i : i + BATCH] = integrator.state
        return result

    return call


@cache
def numba_loop():
    from math import cos, sin

    import numba

    @numba.njit(fastmath=True, inline="always")
    def slope(theta, dphi, dtheta, c, i):
        s, k = sin(theta), cos(theta)
        forward, across = 0.3 * dphi, 0.2 * dtheta
        up, turning = c[0, i] * dtheta * dtheta - c[1, i], -c[2, i] * dphi * dtheta
        return forward * k - across * s, forward * s + across * k, up, turning

    @numba.njit(fastmath=True)
    def loop(start, c, steps, h, out):
        for i in range(c.shape[1]):
            x, y, z, phi, theta, u, v = start
            for _ in range(steps):
                x1, y1, u1, v1 = slope(theta, u, v, c, i)
                ua, va = u + h / 2 * u1, v + h / 2 * v1
                x2, y2, u2, v2 = slope(theta + h / 2 * v, ua, va, c, i)
                ub, vb = u + h / 2 * u2, v + h / 2 * v2
                x3, y3, u3, v3 = slope(theta + h / 2 * va, ub, vb, c, i)
                uc, vc = u + h * u3, v + h * v3
                x4, y4, u4, v4 = slope(theta + h * vb, uc, vc, c, i)
                turned = h / 6 * (u + 2 * (ua + ub) + uc)
                x, y = x + h / 6 * (x1 + 2 * (x2 + x3) + x4), y + h / 6 * (y1 + 2 * (y2 + y3) + y4)
                z, phi, theta = z - 0.1 * turned, phi + turned, theta + h / 6 * (v + 2 * (va + vb) + vc)
                u, v = u + h / 6 * (u1 + 2 * (u2 + u3) + u4), v + h / 6 * (v1 + 2 * (v2 + v3) + v4)
            out[:, i] = x, y, z, phi, theta, u, v

    return loop


def numba_rk4(steps):
    loop, result, start = numba_loop(), np.empty((7, CASES)), tuple(START.tolist())

    def call():
        loop(start, coefficients(), steps, DURATION / steps, result)
        return result

    return call


def peers():
    makes = {
        "heyoka, batches of 8, 7 equations by hand": ("heyoka", heyoka_batch, ladder(4, 8)),
        "heyoka, the same with fast_math": ("heyoka", partial(heyoka_batch, fast_math=True), ladder(4, 8)),
        "numba, RK4 by hand, fastmath": ("numba", numba_rk4, [(n,) for n in range(200, 601, 50)]),
    }
    return {
        name: fastest(make, settings, error, WITHIN) if installed(module) else Missing("not installed")
        for name, (module, make, settings) in makes.items()
    }


BARS = {"heyoka, batches of 8, 7 equations by hand": 3, "numba, RK4 by hand, fastmath": 20}


def row(make, settings, title):
    return Row(f"Appell-Hamel 10 s, 1,000 pairs of masses, {title}", fastest(make, settings, error, WITHIN), peers(),
               error, WITHIN, BARS)  # fmt: skip


ROWS = {
    "many": partial(row, partial(lanes, constrained), SETTINGS, "in lanes, constraints as given"),
    "many-rolling": partial(row, partial(lanes, rolling), SETTINGS, "in lanes, rolling as quasi-velocities"),
    "many-simulate": partial(row, simulated, [(12, 1e-6), (14, 3e-7), (12, 1e-7)], "all of sv.simulate_many"),
}
